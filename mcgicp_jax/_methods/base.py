"""Registration methods: their covariances and information matrices, and the space of the search."""

from __future__ import annotations

import abc
from collections.abc import Iterator, Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from mcgicp_jax._clouds.point_cloud import PointCloud, Values
from mcgicp_jax._clouds.preprocess import preprocess
from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, canonical_float, constant, is_concrete, numpy_for
from mcgicp_jax._local_geometry.covariances import NO_NEIGHBORS as _NO_NEIGHBORS
from mcgicp_jax._local_geometry.covariances import (
    channel_kernel,
    check_neighbors,
    multichannel_covariance,
    plane_covariance,
)
from mcgicp_jax._local_geometry.local_statistics import locals_of
from mcgicp_jax._local_geometry.records import Local, Neighborhoods, Table, covariance_of, points_of
from mcgicp_jax._local_geometry.spacing_and_noise import channel_noise, point_spacing
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.robust_kernels import AbstractKernel, Numbers
from mcgicp_jax._terms.base import Forces, weighed
from mcgicp_jax._terms.photometric import Term, correlated_slopes, features_of_points

# Ratio. Between aligned real scans (RGB-D and LiDAR), the standard deviation of the channels' differences was 0.9 to
# 2.6 times the value expected from the noise within each scan; this is the geometric mean.
_SPREAD = 1.5
# In spacings of the target: α σ, the position offset that weighs as much as one σ of a channel.
_OFFSET_PER_SIGMA = 2.5
# Floor of Ω's eigenvalues, relative to GICP's in-plane variance of 1: default, and least value chosen from the data.
_MIN_EIGENVALUE = 5e-3
# Variance of a match along each tangent axis, spacing²: 1/(2 ln 2) for randomly placed points (Poisson process), whose
# squared nearest-neighbour distance r² has the mean E and the median E ln 2.
_MATCH_VARIANCE = 0.72


class AbstractMethod(Numbers):
    """A registration method. Its parameters are arrays, so that gradients can be taken with respect to them.

    A subclass defines the covariance of a point, and the information matrix of a correspondence given those of its two
    points. Parameters that are None are chosen from the data by `resolve`.
    """

    uses_channels: ClassVar[bool] = False
    # Whether `covariance` needs the individual neighbours, beyond their local statistics.
    uses_neighborhoods: ClassVar[bool] = False
    # Number of target points that a source point is matched with. The cost of the source point is the sum over them.
    num_candidates: ClassVar[int] = 1
    # Which of "source" and "target" must have covariances, as from `gaussians`.
    needs_covariances: ClassVar[tuple[str, ...]] = ()
    # Whether matches follow along the surface when the pose moves, as those of points do, and those of cells do not.
    matches_slide: ClassVar[bool] = True

    def is_open(self, source: PointCloud, target: PointCloud) -> bool:
        """Whether a parameter is to be chosen from the data of these clouds."""
        return False

    def chosen(self, source: PointCloud, target: PointCloud, locals: tuple[Local, Local]) -> AbstractMethod:
        """The method with every unset parameter chosen from the data, given the local statistics of both clouds."""
        return self

    def resolve(self, source: PointCloud, target: PointCloud) -> AbstractMethod:
        """The method with every unset parameter chosen from two preprocessed clouds; constants to autodiff.

        Raises:
            ValueError: if a parameter is unset and a cloud was not preprocessed.
        """
        if not self.is_open(source, target):
            return self
        return self.chosen(source, target, locals_of(source, target, with_channels=True))

    @abc.abstractmethod
    def covariance(
        self,
        points: Float[Array, "3 n"],
        around: Neighborhoods | None,
        local: Local | None,
        given: Float[Array, "6 n"] | None,
    ) -> Float[Array, "6 n"]:
        """A symmetric 3×3 matrix for each of n points (positions in metres): the input of `information`.

        Args:
            around: neighbourhoods of the points; None unless the method `uses_neighborhoods`.
            local: their local statistics; None for a cloud that was not preprocessed.
            given: covariances given with the cloud; None if there are none.

        Raises:
            ValueError: if the method needs neighbours or a parameter that are missing.
        """

    @abc.abstractmethod
    def information(
        self, target: Float[Array, "6 N"], source: Float[Array, "6 N"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        """M of each correspondence: the information matrix of its residual b − T a, in the target's frame.

        Args:
            target, source: matrices from `covariance` of the matched points, each in the frame of its own cloud.
            rotation: of T_target_source.
        """

    def forces(
        self,
        source: Table,
        target: Table,
        moved: Float[Array, "3 N"],
        rotation: Float[Array, "3 3"],
        valid: Bool[Array, "N"],
        robust: AbstractKernel | None,
    ) -> Forces:
        """Force, stiffness and cost of each correspondence. A subclass can add terms: `super().forces(...) + more`.

        Args:
            source, target: matched rows of the surfaces' tables, see `_surface`.
            moved: T a, the moved source points, metres.
            rotation: of T_target_source.
            valid: which correspondences count; the residual of the others is 0.
            robust: kernel of the Mahalanobis distance; None for the squared distance.
        """
        residual = jnp.where(valid, points_of(target) - moved, 0)
        information = self.information(covariance_of(target), covariance_of(source), rotation)
        return weighed(residual, information, robust)

    def features(self, around: Neighborhoods | None, local: Local | None) -> Float[Array, "L n"] | None:
        """Further numbers of each point that `forces` needs (`_surface.features_of`); None if there are none."""
        return None

    @property
    def estimates(self) -> Term | None:
        """Numbers that are estimated from the residuals at each pose of the fine phase; None if there are none.

        With such numbers, a coarse phase without them always precedes the fine phase, whose matches are the nearest in
        position alone. They are constants to autodiff.
        """
        return None

    def with_estimates(self, estimates: Term | None) -> AbstractMethod:
        """The method with other `estimates`."""
        return self

    def channel_observability(
        self, mean: Float[Array, "6 N"], source: Table, target: Table, rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        """Observability of correspondences by the channels, see `_observability`, given the mean of their points'."""
        return mean

    def stages(
        self, source: PointCloud, target: PointCloud, scales: Sequence[float]
    ) -> Iterator[tuple[AbstractMethod, PointCloud, PointCloud]]:
        """Method, source and target of each registration for the option `scales`; the last one gives the result.

        Args:
            source, target: preprocessed clouds; also raw ones if the method `needs_covariances`.
            scales: voxel sizes, metres, coarse to fine.
        """
        for voxel_size in scales:
            yield self, _coarser(source, voxel_size), _coarser(target, voxel_size)
        yield self, source, target

    def spacing(self, target: PointCloud) -> Float[AnyScalar, ""]:
        """The distance, metres, in units of which the default maximum correspondence distances are chosen."""
        return point_spacing(target)

    def default_kernel(self) -> AbstractKernel | None:
        """The robust kernel where the caller gives none."""
        return None

    def described(self, local: Local, given: Float[Array, "6 n"] | None) -> Local:
        """The local statistics of points, given those of their neighbourhoods and the covariances of the cloud."""
        return local

    def weights(self, num_channels: int) -> Float[AnyArray, "C"] | None:
        """α of each channel, metres per channel unit; None if the method searches in position alone."""
        return None

    def missing_variances(self, num_channels: int) -> Float[AnyArray, "C"]:
        """Expected squared difference of each channel in a true match, channel units²: the penalty for a missing one.

        A subclass that defines `weights` defines this too.
        """
        raise NotImplementedError(f"{type(self).__name__} defines weights, but not missing_variances")


class AbstractOneSided(AbstractMethod):
    """Methods whose information matrix M depends on the target alone."""

    def information(
        self, target: Float[Array, "6 N"], source: Float[Array, "6 N"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        return target


class PointToPoint(AbstractOneSided):
    """Plain ICP (Besl & McKay 1992): M = I."""

    def covariance(
        self,
        points: Float[Array, "3 n"],
        around: Neighborhoods | None,
        local: Local | None,
        given: Float[Array, "6 n"] | None,
    ) -> Float[Array, "6 n"]:
        return identity(points)


class PointToPlane(AbstractOneSided):
    """Point-to-plane ICP (Chen & Medioni 1991): M = n nᵀ with the normals n of the target."""

    def covariance(
        self,
        points: Float[Array, "3 n"],
        around: Neighborhoods | None,
        local: Local | None,
        given: Float[Array, "6 n"] | None,
    ) -> Float[Array, "6 n"]:
        return alg.outer(_known(local).normal if given is None else alg.smallest_eigenvector(given))


class ColorICP(AbstractOneSided):
    """ICP whose matches are nearest in position and channels (Johnson & Kang 1999): M = I.

    Attributes:
        channel_weights: α, scalar or (C,), metres per channel unit.
        missing_variance: scalar or (C,), channel units²: the squared difference that the search assumes for a channel
            if a point of a correspondence lacks it. Not an argument: set by `chosen` if points lack channels.
    """

    uses_channels: ClassVar[bool] = True

    channel_weights: Float[Array, "..."]
    missing_variance: Float[Array, "..."] | None

    def __init__(self, channel_weights: Values):
        """Raises `ValueError` if a weight is negative or not finite, or has the wrong shape."""
        self.channel_weights = _weights(channel_weights)
        self.missing_variance = None

    def is_open(self, source: PointCloud, target: PointCloud) -> bool:
        lacking = source.channel_valid is not None or target.channel_valid is not None
        return lacking and self.missing_variance is None

    def chosen(self, source: PointCloud, target: PointCloud, locals: tuple[Local, Local]) -> ColorICP:
        """The method with `missing_variance` set to the Λ that `MultiChannelGICP` chooses; constant to autodiff."""
        variance = MultiChannelGICP(channel_weights=0.0).chosen(source, target, locals).channel_covariance
        return eqx.tree_at(lambda method: method.missing_variance, self, variance, is_leaf=lambda leaf: leaf is None)

    def covariance(
        self,
        points: Float[Array, "3 n"],
        around: Neighborhoods | None,
        local: Local | None,
        given: Float[Array, "6 n"] | None,
    ) -> Float[Array, "6 n"]:
        return identity(points)

    def weights(self, num_channels: int) -> Float[AnyArray, "C"]:
        return _per_channel("channel_weights", self.channel_weights, num_channels)

    def missing_variances(self, num_channels: int) -> Float[AnyArray, "C"]:
        if self.missing_variance is None:
            raise ValueError("missing_variance: not chosen yet; call method.resolve(source, target) first")
        return _per_channel("missing_variance", self.missing_variance, num_channels)


class AbstractGeneralized(AbstractMethod):
    """Methods that use the covariances of both points of a correspondence: M = (C^B + R C^A Rᵀ)⁻¹."""

    def information(
        self, target: Float[Array, "6 N"], source: Float[Array, "6 N"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        return alg.inverse(target + alg.rotate(rotation, source))


class GICP(AbstractGeneralized):
    """Generalized ICP (Segal, Haehnel & Thrun 2009), plane to plane.

    Attributes:
        epsilon: ε, the variance along the normal, relative to the variance of 1 within the surface.
    """

    epsilon: Float[Array, ""]

    def __init__(self, epsilon: ArrayLike = 1e-3):
        """Raises `ValueError` unless ε is positive, and large enough for the precision (1.2e-5 in float32)."""
        self.epsilon = _epsilon(epsilon)

    def covariance(
        self,
        points: Float[Array, "3 n"],
        around: Neighborhoods | None,
        local: Local | None,
        given: Float[Array, "6 n"] | None,
    ) -> Float[Array, "6 n"]:
        return plane_covariance(_known(local), self.epsilon.astype(points.dtype)) if given is None else given


class MultiChannelGICP(AbstractGeneralized):
    """Multi-channel generalized ICP (Servos & Waslander, ICRA 2014).

    The covariance of a point is ε along the normal and Ω within the surface (eqs. 6-10): small in the directions in
    which the channels distinguish the point from its neighbours. Matches are nearest in position and α · channel.

    Attributes:
        channel_covariance: Λ of eq. 7, scalar or (C,) variances or (C, C), channel units²: the covariance of the
            difference of two measurements of the same spot. None: chosen from the data, see `chosen`.
        channel_weights: α, scalar or (C,), metres per channel unit. None: chosen from the data, see `chosen`.
        epsilon: ε, as in `GICP`.
        min_eigenvalue: floor of Ω's eigenvalues, reached where no neighbour has similar channels. Since the target is
            sampled, a match is less accurate within the surface than along the normal, whatever the channels. None:
            chosen along with Λ, see `chosen`; 0.005 if Λ is given.
        photometric: whether the fine phase compares channels interpolated at the points, see `_photometric`. Ω and α
            then find the pose of the coarse phase, and have no part in the fine one: its matches are nearest in
            position, it takes from the channels only the residuals of their fits, and across the surface the residual
            along the normals, so that no information counts twice. All residuals are in standard deviations, and so are
            the scale of a kernel `robust`, which acts in the fine phase only, and `information`.
        term: numbers of the photometric term, estimated during registration. Not an argument.
    """

    uses_channels: ClassVar[bool] = True
    uses_neighborhoods: ClassVar[bool] = True

    channel_covariance: Float[Array, "..."] | None
    channel_weights: Float[Array, "..."] | None
    epsilon: Float[Array, ""]
    min_eigenvalue: Float[Array, ""] | None
    photometric: bool = eqx.field(static=True)
    term: Term | None

    def __init__(
        self,
        channel_covariance: Values | None = None,
        channel_weights: Values | None = None,
        epsilon: ArrayLike = 1e-3,
        min_eigenvalue: ArrayLike | None = None,
        photometric: bool = False,
    ):
        """Raises `ValueError` unless Λ is symmetric and positive definite, α finite and not negative, ε positive and
        large enough for the precision, and the floor positive; or if a shape is wrong."""
        self.channel_covariance = None if channel_covariance is None else _covariance(channel_covariance)
        self.channel_weights = None if channel_weights is None else _weights(channel_weights)
        self.epsilon = _epsilon(epsilon)
        self.min_eigenvalue = None if min_eigenvalue is None else _positive_scalar("min_eigenvalue", min_eigenvalue)
        self.photometric, self.term = photometric, None

    def is_open(self, source: PointCloud, target: PointCloud) -> bool:
        without_term = self.photometric and self.term is None
        return self.channel_covariance is None or self.channel_weights is None or without_term

    def chosen(self, source: PointCloud, target: PointCloud, locals: tuple[Local, Local]) -> MultiChannelGICP:
        """The method with unset parameters chosen from the data; constants to autodiff.

        σ, the noise of a channel, is the median over both clouds' points of the residual deviation of linear fits in
        the tangent plane. Noise alone gives the difference of two measurements the variance 2 σ². In real scans its
        standard deviation is 1.5 times that, because of edges and changes: Λ = 2 (1.5 σ)². α = 2.5 spacing/σ; the
        spacing is the target's median nearest-neighbour distance. A difference of one σ then weighs as much as 2.5
        spacings, the fine `max_distance`, so that channels choose among the points within it. The α of constant
        channels is 0.

        The floor is chosen if neither it nor Λ is given. Between randomly placed points, a match has the variance 0.72
        spacing² along each tangent axis, and 2 λ₀ along the normal, where λ₀ is the median smallest eigenvalue of the
        neighbourhoods. The floor is ε times the ratio of the two, limited to 0.005 to 1. As λ₀ includes the
        curvature of the surface, the true ratio may be larger, so the estimate is used to raise the floor above 0.005
        (as for rendered scenes), but not to lower it.
        """
        source, target, locals, epsilon = constant((source, target, locals, self.epsilon))
        xp = numpy_for(source, target, locals, epsilon)
        sigma, uniform, across = channel_noise(source, target, locals)
        spacing = point_spacing(target)
        with np.errstate(over="ignore", invalid="ignore"):
            within = xp.asarray(epsilon, spacing.dtype) * _MATCH_VARIANCE * spacing**2
            smooth = ~(2 * across > within)
            floor = xp.where(smooth, 1, xp.maximum(within / xp.where(smooth, 1, 2 * across), _MIN_EIGENVALUE))
            numbers = [2 * (_SPREAD * sigma) ** 2, xp.where(uniform, 0, _OFFSET_PER_SIGMA * spacing / sigma), floor]
        covariance, weights, floor = (jax.device_put(xp.asarray(number, epsilon.dtype)) for number in numbers)
        if self.channel_covariance is not None or self.min_eigenvalue is not None:
            floor = self.min_eigenvalue
        if self.channel_covariance is not None:
            covariance = self.channel_covariance
        if self.channel_weights is not None:
            weights = self.channel_weights
        return eqx.tree_at(
            lambda method: (method.channel_covariance, method.channel_weights, method.min_eigenvalue),
            self,
            (covariance, weights, floor),
            is_leaf=lambda leaf: leaf is None,
        )._with_term(spacing, source.channels.shape[-1])

    def _with_term(self, spacing: Float[AnyScalar, ""], num_channels: int) -> MultiChannelGICP:
        if not self.photometric or num_channels == 0:
            return self
        return self.with_estimates(Term.off(spacing, num_channels))

    @property
    def estimates(self) -> Term | None:
        return self.term

    def with_estimates(self, estimates: Term | None) -> MultiChannelGICP:
        return eqx.tree_at(lambda method: method.term, self, estimates, is_leaf=lambda leaf: leaf is None)

    def features(self, around: Neighborhoods | None, local: Local | None) -> Float[Array, "L n"] | None:
        if not self.photometric:
            return None
        if around is None:
            raise ValueError(_NO_NEIGHBORS)
        return features_of_points(around, _known(local).normal) if around.num_channels else None

    def channel_observability(
        self, mean: Float[Array, "6 N"], source: Table, target: Table, rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        if self.term is None:
            return mean
        # Far from the pose, slopes of matched points have nothing to do with each other.
        correlated = correlated_slopes(source, target, rotation, self.weights(self.term.gains.shape[0]))
        return jnp.where(self.term.is_on, correlated, mean)

    def forces(
        self,
        source: Table,
        target: Table,
        moved: Float[Array, "3 N"],
        rotation: Float[Array, "3 3"],
        valid: Bool[Array, "N"],
        robust: AbstractKernel | None,
    ) -> Forces:
        plain = super().forces
        if self.term is None:
            return plain(source, target, moved, rotation, valid, robust)
        matched = (source, target, moved, rotation, valid)
        return jax.lax.cond(
            self.term.is_on,
            lambda term: term.forces(term.residuals(*matched), points_of(target) - moved, robust),
            # The scale of `robust` is that of the term's residuals.
            lambda _: plain(*matched, None),
            self.term,
        )

    def covariance(
        self,
        points: Float[Array, "3 n"],
        around: Neighborhoods | None,
        local: Local | None,
        given: Float[Array, "6 n"] | None,
    ) -> Float[Array, "6 n"]:
        if given is not None:
            return given
        if self.channel_covariance is None:
            raise ValueError("channel_covariance: not chosen yet; call method.resolve(source, target) first")
        if around is None:
            raise ValueError(_NO_NEIGHBORS)
        local, epsilon = _known(local), self.epsilon.astype(points.dtype)
        covariance = self.channel_covariance.astype(points.dtype)
        _check_covariance_fits(covariance, around.num_channels)
        if around.num_channels == 0:
            return plane_covariance(local, epsilon)
        floor = jnp.asarray(_MIN_EIGENVALUE if self.min_eigenvalue is None else self.min_eigenvalue, points.dtype)
        return multichannel_covariance(around, local, channel_kernel(around, covariance), epsilon, floor)

    def weights(self, num_channels: int) -> Float[AnyArray, "C"]:
        if self.channel_weights is None:
            raise ValueError("channel_weights: not chosen yet; call method.resolve(source, target) first")
        return _per_channel("channel_weights", self.channel_weights, num_channels)

    def missing_variances(self, num_channels: int) -> Float[AnyArray, "C"]:
        if self.channel_covariance is None:
            raise ValueError("channel_covariance: not chosen yet; call method.resolve(source, target) first")
        xp = numpy_for(self.channel_covariance)
        covariance = xp.asarray(self.channel_covariance)
        _check_covariance_fits(covariance, num_channels)
        return xp.broadcast_to(xp.diagonal(covariance) if covariance.ndim == 2 else covariance, (num_channels,))


def _coarser(cloud: PointCloud, voxel_size: float) -> PointCloud:
    return preprocess(cloud, voxel_size, check_neighbors(cloud).shape[-1])


def identity(points: Float[Array, "3 n"]) -> Float[Array, "6 n"]:
    identity = jnp.array([[1.0], [0.0], [0.0], [1.0], [0.0], [1.0]], points.dtype)
    return jnp.broadcast_to(identity, (6, points.shape[1]))


def _known(local: Local | None) -> Local:
    if local is None:
        raise ValueError(_NO_NEIGHBORS)
    return local


def _per_channel(name: str, numbers: Float[AnyArray, "..."], num_channels: int) -> Float[AnyArray, "C"]:
    """The numbers broadcast to one per channel; `name` is that of the parameter, for the error message."""
    if numbers.shape not in ((), (num_channels,)):
        raise ValueError(
            f"{name}: expected a scalar or shape ({num_channels},), for clouds of {num_channels} channels, "
            f"got {numbers.shape}"
        )
    xp = numpy_for(numbers)
    return xp.broadcast_to(xp.asarray(numbers), (num_channels,))


def _check_covariance_fits(covariance: Float[AnyArray, "..."], count: int) -> None:
    if covariance.shape not in ((), (count,), (count, count)):
        raise ValueError(
            f"channel_covariance: expected a scalar, shape ({count},) or ({count}, {count}), for clouds of {count} "
            f"channels, got {covariance.shape}"
        )


def _number(name: str, value: Values) -> Array:
    try:
        # NumPy converts concrete values without compiling a program.
        return jax.device_put(np.asarray(value, canonical_float())) if is_concrete(value) else jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected numbers, got {value!r}") from error


def _positive_scalar(name: str, value: ArrayLike) -> Float[Array, ""]:
    number = _number(name, value)
    if number.shape != () or (is_concrete(number) and not 0 < float(number) < np.inf):
        raise ValueError(f"{name}: expected one positive number, got {value!r}")
    return number


def _epsilon(value: ArrayLike) -> Float[Array, ""]:
    epsilon = _positive_scalar("epsilon", value)
    # For smaller ε, 1 − (1 − ε) loses it to rounding, and the covariance becomes singular.
    least = 100 * float(jnp.finfo(epsilon.dtype).eps)
    if is_concrete(epsilon) and float(epsilon) < least:
        raise ValueError(f"epsilon: expected at least {least:.2g} in {epsilon.dtype}, got {value!r}")
    return epsilon


def _weights(value: Values) -> Float[Array, "..."]:
    weights = _number("channel_weights", value)
    if weights.ndim > 1:
        raise ValueError(f"channel_weights: expected a scalar or shape (C,), got {weights.shape}")
    if is_concrete(weights) and not np.all((np.asarray(weights) >= 0) & np.isfinite(weights)):
        raise ValueError(f"channel_weights: expected finite numbers of at least 0, got {value!r}")
    return weights


def _covariance(value: Values) -> Float[Array, "..."]:
    covariance = _number("channel_covariance", value)
    if covariance.ndim > 2 or (covariance.ndim == 2 and covariance.shape[0] != covariance.shape[1]):
        raise ValueError(f"channel_covariance: expected a scalar, shape (C,) or (C, C), got {covariance.shape}")
    if is_concrete(covariance):
        matrix = np.asarray(covariance, np.float64)
        matrix = matrix if matrix.ndim == 2 else np.diag(np.atleast_1d(matrix))
        finite = bool(np.isfinite(matrix).all())
        symmetric = finite and np.allclose(matrix, matrix.T, rtol=1e-5, atol=1e-6 * np.abs(matrix).max(initial=0))
        # An empty matrix (no channels) is positive definite; NaN is not.
        if not (symmetric and np.all(np.linalg.eigvalsh(matrix) > 0)):
            raise ValueError(f"channel_covariance: expected it symmetric and positive definite, got {value!r}")
    return covariance
