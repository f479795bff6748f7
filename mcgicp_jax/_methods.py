"""The five methods as settings of one machine: which covariance a point has, and in which space matches are sought."""

from __future__ import annotations

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from mcgicp_jax import _algebra as alg
from mcgicp_jax._channels import channel_noise, point_spacing
from mcgicp_jax._cloud import PointCloud, Values
from mcgicp_jax._forces import Forces, weighed
from mcgicp_jax._kernels import AbstractKernel, Numbers
from mcgicp_jax._local import locals_of
from mcgicp_jax._neighborhoods import NO_NEIGHBORS as _NO_NEIGHBORS
from mcgicp_jax._neighborhoods import channel_kernel, multichannel_covariance, plane_covariance
from mcgicp_jax._pose import AnyArray, canonical_float, is_concrete
from mcgicp_jax._statistics import constant, namespace
from mcgicp_jax._surface import Local, Neighborhoods, Table, covariance_of, points_of

# Between aligned real scans (RGB-D and LiDAR), the standard deviation of the channels' differences was 0.9 to 2.6 times
# what the noise within each scan gives, in the geometric mean this.
_SPREAD = 1.5
# In spacings of the target.
_REACH = 2.5
# The least floor of Ω, and the variance of a match along each axis of a surface whose points lie at random, spacing².
_MIN_EIGENVALUE = 5e-3
_MATCH_VARIANCE = 0.72


class AbstractMethod(Numbers):
    """A registration method. Its numbers are arrays, so that gradients can be taken with respect to a method.

    A subclass says which covariance a point has, and how a correspondence is weighed with those of its two points.
    """

    uses_channels: ClassVar[bool] = False
    # Whether `covariance` looks at neighbours one by one, beyond their local statistics.
    uses_neighborhoods: ClassVar[bool] = False

    def is_open(self, source: PointCloud, target: PointCloud) -> bool:
        """Whether a number has been left to be chosen from the data."""
        return False

    def chosen(self, source: PointCloud, target: PointCloud, locals: tuple[Local, Local]) -> AbstractMethod:
        """The method with every open number chosen from the data, given the local statistics of both clouds."""
        return self

    def resolve(self, source: PointCloud, target: PointCloud) -> AbstractMethod:
        """The method with every open number chosen from the data of two preprocessed clouds; constants to autodiff."""
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
        """Symmetric 3×3 matrices of some points, whose meaning is the method's affair.

        Args:
            around: neighbourhoods; None unless the method says `uses_neighborhoods`.
            local: their statistics; None for clouds that were not preprocessed.
            given: covariances that the cloud brings; None if it brings none.
        """

    @abc.abstractmethod
    def information(
        self, target: Float[Array, "6 N"], source: Float[Array, "6 N"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        """M of each correspondence, the weight matrix of its residual b − T a, in the target's frame."""

    def forces(
        self,
        source: Table,
        target: Table,
        moved: Float[Array, "3 N"],
        rotation: Float[Array, "3 3"],
        valid: Bool[Array, "N"],
        robust: AbstractKernel | None,
    ) -> Forces:
        """What each correspondence does to a pose. Terms add: `super().forces(...) + more`.

        Args:
            source, target: matched rows of the surfaces' tables, see `_surface`.
            moved: T a.
            valid: which correspondences count; the residual of the others is 0.
        """
        residual = jnp.where(valid, points_of(target) - moved, 0)
        information = self.information(covariance_of(target), covariance_of(source), rotation)
        return weighed(residual, information, robust)

    def weights(self, num_channels: int) -> Float[AnyArray, "C"] | None:
        """α of each channel, metres per channel unit; None where a method matches by position alone."""
        return None

    def missing_variances(self, num_channels: int) -> Float[AnyArray, "C"]:
        """The variance of a channel's difference in a true match, channel units², for channels that points lack."""
        raise NotImplementedError


class AbstractOneSided(AbstractMethod):
    """Methods whose weight matrix M is known from the target alone."""

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
        return _identity(points)


class PointToPlane(AbstractOneSided):
    """Point-to-plane ICP (Chen & Medioni 1991): M = n nᵀ with the target's normals."""

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
        missing_variance: (C,), channel units²: how far the search takes a channel to differ, squared, where one point
            of a correspondence lacks it. None: from the data if points do, see `chosen`.
    """

    uses_channels: ClassVar[bool] = True

    channel_weights: Float[Array, "..."]
    missing_variance: Float[Array, "..."] | None

    def __init__(self, channel_weights: Values):
        """Raises `ValueError` if a weight is negative or not finite."""
        self.channel_weights = _weights(channel_weights)
        self.missing_variance = None

    def is_open(self, source: PointCloud, target: PointCloud) -> bool:
        lacking = source.channel_valid is not None or target.channel_valid is not None
        return lacking and self.missing_variance is None

    def chosen(self, source: PointCloud, target: PointCloud, locals: tuple[Local, Local]) -> ColorICP:
        """Where points lack channels: the variance of a difference between two measurements of one spot, the Λ that
        `MultiChannelGICP` chooses. Constant to autodiff."""
        variance = MultiChannelGICP(channel_weights=0.0).chosen(source, target, locals).channel_covariance
        return eqx.tree_at(lambda method: method.missing_variance, self, variance, is_leaf=lambda leaf: leaf is None)

    def covariance(
        self,
        points: Float[Array, "3 n"],
        around: Neighborhoods | None,
        local: Local | None,
        given: Float[Array, "6 n"] | None,
    ) -> Float[Array, "6 n"]:
        return _identity(points)

    def weights(self, num_channels: int) -> Float[AnyArray, "C"]:
        return _spread_out(self.channel_weights, num_channels)

    def missing_variances(self, num_channels: int) -> Float[AnyArray, "C"]:
        if self.missing_variance is None:
            raise ValueError("missing_variance: not chosen yet; call method.resolve(source, target) first")
        return _spread_out(self.missing_variance, num_channels)


class AbstractGeneralized(AbstractMethod):
    """Methods that weigh a correspondence with the covariances of both of its points: M = (C^B + R C^A Rᵀ)⁻¹."""

    def information(
        self, target: Float[Array, "6 N"], source: Float[Array, "6 N"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        return alg.inverse(target + alg.rotate(rotation, source))


class GICP(AbstractGeneralized):
    """Generalized ICP (Segal, Haehnel & Thrun 2009), plane to plane.

    Attributes:
        epsilon: ε, the variance across the surface relative to that within it.
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

    The covariance of a point is ε across its surface and Ω within it (eqs. 6-10): small in the directions in which the
    channels tell the point from its neighbours. Matches are nearest in position and α · channel.

    Attributes:
        channel_covariance: Λ of eq. 7, scalar or (C,) variances or (C, C), channel units²; how far the channel values
            of two measurements of one and the same spot lie apart. None: from the data, see `chosen`.
        channel_weights: α, scalar or (C,), metres per channel unit. None: from the data, see `chosen`.
        epsilon: ε, as in `GICP`.
        min_eigenvalue: floor of Ω's eigenvalues, where nothing nearby looks alike. A match is one of the samples, and
            no sample lies just where it should: within the surface it cannot hold as well as across it. None: chosen
            along with Λ, see `chosen`; 0.005 with a Λ that is given.
    """

    uses_channels: ClassVar[bool] = True
    uses_neighborhoods: ClassVar[bool] = True

    channel_covariance: Float[Array, "..."] | None
    channel_weights: Float[Array, "..."] | None
    epsilon: Float[Array, ""]
    min_eigenvalue: Float[Array, ""] | None

    def __init__(
        self,
        channel_covariance: Values | None = None,
        channel_weights: Values | None = None,
        epsilon: ArrayLike = 1e-3,
        min_eigenvalue: ArrayLike | None = None,
    ):
        """Raises `ValueError` if Λ is not positive definite, a weight is negative, or ε or the floor not positive."""
        self.channel_covariance = None if channel_covariance is None else _covariance(channel_covariance)
        self.channel_weights = None if channel_weights is None else _weights(channel_weights)
        self.epsilon = _epsilon(epsilon)
        self.min_eigenvalue = None if min_eigenvalue is None else _positive_scalar("min_eigenvalue", min_eigenvalue)

    def is_open(self, source: PointCloud, target: PointCloud) -> bool:
        return self.channel_covariance is None or self.channel_weights is None

    def chosen(self, source: PointCloud, target: PointCloud, locals: tuple[Local, Local]) -> MultiChannelGICP:
        """Λ and α from the data, where they were left open; constants to autodiff.

        σ, the noise of a channel, is the median residual of a linear fit of the channel over the tangent plane of each
        neighbourhood, over both clouds. A difference of two measurements has twice its variance, and is 1.5 times as
        wide in all, edges and whatever moved between the two with it: Λ = 2 (1.5 σ)². α = 2.5 spacing/σ, with the
        median distance between neighbouring target points: one σ weighs as much as the radius within which matches end
        up, so that channels choose among the points there. A channel that is constant says nothing: its α is 0.

        The floor goes with Λ: along an axis within the surface a match is off by a variance of 0.72 spacing², where
        points lie at random, and across the surface by 2 λ₀, the median smallest eigenvalue of the neighbourhoods
        being λ₀. It is ε times their ratio, from 0.005 to 1. As λ₀ has the bends of the surface in it, the ratio is at
        least that: it can raise the floor, as for rendered scenes, and not lower it.
        """
        source, target, locals, epsilon = constant((source, target, locals, self.epsilon))
        xp = namespace(source, target, locals, epsilon)
        sigma, uniform, across = channel_noise(source, target, locals)
        spacing = point_spacing(target)
        with np.errstate(over="ignore", invalid="ignore"):
            within = xp.asarray(epsilon, spacing.dtype) * _MATCH_VARIANCE * spacing**2
            smooth = ~(2 * across > within)
            floor = xp.where(smooth, 1, xp.maximum(within / xp.where(smooth, 1, 2 * across), _MIN_EIGENVALUE))
            numbers = [2 * (_SPREAD * sigma) ** 2, xp.where(uniform, 0, _REACH * spacing / sigma), floor]
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
        return _spread_out(self.channel_weights, num_channels)

    def missing_variances(self, num_channels: int) -> Float[AnyArray, "C"]:
        if self.channel_covariance is None:
            raise ValueError("channel_covariance: not chosen yet; call method.resolve(source, target) first")
        xp = namespace(self.channel_covariance)
        covariance = xp.asarray(self.channel_covariance)
        return _spread_out(xp.diagonal(covariance) if covariance.ndim == 2 else covariance, num_channels)


def _identity(points: Float[Array, "3 n"]) -> Float[Array, "6 n"]:
    identity = jnp.array([[1.0], [0.0], [0.0], [1.0], [0.0], [1.0]], points.dtype)
    return jnp.broadcast_to(identity, (6, points.shape[1]))


def _known(local: Local | None) -> Local:
    if local is None:
        raise ValueError(_NO_NEIGHBORS)
    return local


def _spread_out(numbers: Float[AnyArray, "..."], num_channels: int) -> Float[AnyArray, "C"]:
    """One number per channel."""
    if numbers.shape not in ((), (num_channels,)):
        raise ValueError(
            f"channel_weights: expected a scalar or shape ({num_channels},), for clouds of {num_channels} channels, "
            f"got {numbers.shape}"
        )
    xp = namespace(numbers)
    return xp.broadcast_to(xp.asarray(numbers), (num_channels,))


def _check_covariance_fits(covariance: Float[AnyArray, "..."], count: int) -> None:
    if covariance.shape not in ((), (count,), (count, count)):
        raise ValueError(
            f"channel_covariance: expected a scalar, shape ({count},) or ({count}, {count}), for clouds of {count} "
            f"channels, got {covariance.shape}"
        )


def _number(name: str, value: Values) -> Array:
    try:
        # By way of NumPy, which compiles nothing.
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
    # 1 − (1 − ε) loses ε to rounding, and the covariance its inverse.
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
