"""The five methods as settings of one machine: which covariance a point has, and in which space matches are sought."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from functools import partial
from typing import ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from mcgicp_jax import _covariance as cov
from mcgicp_jax._channels import channel_noise, check_neighbors, eagerly_if, point_spacing
from mcgicp_jax._cloud import PointCloud, Values
from mcgicp_jax._pose import is_concrete
from mcgicp_jax._search import Rows

# Between aligned real scans (RGB-D and LiDAR), the standard deviation of the channels' differences was 0.9 to 2.6 times
# what the noise within each scan gives, in the geometric mean this.
_SPREAD = 1.5
# In spacings of the target.
_REACH = 2.5
# The least floor of Ω, and the variance of a match along each axis of a surface whose points lie at random, spacing².
_MIN_EIGENVALUE = 5e-3
_MATCH_VARIANCE = 0.72


# From points and what lies around them to symmetric 3×3 matrices, whose meaning is the method's affair.
Covariance: TypeAlias = Callable[[cov.Neighborhoods], Float[Array, "6 n"]]


class Surface(eqx.Module):
    """A cloud as a method sees it, laid out as structures of arrays for the hot step.

    Attributes:
        points: (3, N).
        covariance: (6, N), symmetric 3×3 matrices; what they mean is the method's affair.
        descriptors: (N, D), channels in metres (α · channel), searched along with the position; D is 0 where a method
            matches by position alone.
        valid: (N,).
        absence: (N, D), as in `Rows`; None if no point lacks a channel.
    """

    points: Float[Array, "3 N"]
    covariance: Float[Array, "6 N"]
    descriptors: Float[Array, "N D"]
    valid: Bool[Array, "N"]
    absence: Float[Array, "N D"] | None = None

    @property
    def rows(self) -> Rows:
        """What a search needs to know."""
        return Rows(points=self.points, descriptors=self.descriptors, valid=self.valid, absence=self.absence)


class Numbers(eqx.Module):
    """A module of a few numbers, whose `repr` shows them."""

    def __repr__(self) -> str:
        parts = []
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value is None or not is_concrete(value):
                parts.append(f"{field.name}={value}")
            else:
                parts.append(f"{field.name}={np.array2string(np.asarray(value), precision=4, separator=', ')}")
        return f"{type(self).__name__}({', '.join(parts)})"


class AbstractMethod(Numbers):
    """A registration method. Its numbers are arrays, so that gradients can be taken with respect to a method."""

    uses_channels: ClassVar[bool] = False

    def resolve(self, source: PointCloud, target: PointCloud) -> AbstractMethod:
        """The method with every number that was left open chosen from the data."""
        return self

    @abc.abstractmethod
    def covariance_around(self, cloud: PointCloud) -> Covariance:
        """What this method knows of the surface at points of a cloud, as a function of what lies around them."""

    def covariance(self, cloud: PointCloud) -> Float[Array, "6 N"]:
        """The same at each point: symmetric 3×3 matrices, by their upper triangles."""
        points = jnp.asarray(cloud.points).T
        # Where covariances are given, or none are needed, there may be no neighbours.
        none = jnp.zeros((points.shape[1], 0), jnp.int32)
        neighbors = none if cloud.neighbors is None else jnp.asarray(cloud.neighbors)
        return cov.by_neighborhoods(self.covariance_around(cloud), points, neighbors)

    @abc.abstractmethod
    def information(
        self, target: Float[Array, "6 N"], source: Float[Array, "6 N"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        """M of each pair: the weight matrix of its residual b − T a, in the target's frame."""

    def descriptors(self, cloud: PointCloud) -> Float[Array, "N D"]:
        """Channels as metres, to be searched along with the position."""
        return jnp.zeros((cloud.points.shape[0], 0), cloud.points.dtype)

    def absence(self, cloud: PointCloud) -> Float[Array, "N D"] | None:
        """What the channels that points lack add to squared distances in the search, as in `Rows`."""
        return None


class AbstractOneSided(AbstractMethod):
    """Methods whose weight matrix M is known from the target alone."""

    def information(
        self, target: Float[Array, "6 N"], source: Float[Array, "6 N"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        return target


class PointToPoint(AbstractOneSided):
    """Plain ICP (Besl & McKay 1992): M = I."""

    def covariance_around(self, cloud: PointCloud) -> Covariance:
        return _identity


class PointToPlane(AbstractOneSided):
    """Point-to-plane ICP (Chen & Medioni 1991): M = n nᵀ with the target's normals."""

    def covariance_around(self, cloud: PointCloud) -> Covariance:
        if cloud.covariances is not None:
            given = _given(cloud)
            return lambda around: cov.outer(cov.smallest_eigenvector(given(around)))
        check_neighbors(cloud)
        return lambda around: cov.outer(around.normal)


class ColorICP(AbstractOneSided):
    """ICP whose matches are nearest in position and channels (Johnson & Kang 1999): M = I.

    Attributes:
        channel_weights: α, scalar or (C,), metres per channel unit.
        missing_variance: (C,), channel units²: what the search takes a channel to differ by, squared, where one point
            of a pair lacks it. None: from the data if points do, see `resolve`.
    """

    uses_channels: ClassVar[bool] = True

    channel_weights: Float[Array, "..."]
    missing_variance: Float[Array, "..."] | None

    def __init__(self, channel_weights: Values):
        """Raises `ValueError` if a weight is negative or not finite."""
        self.channel_weights = _weights(channel_weights)
        self.missing_variance = None

    def resolve(self, source: PointCloud, target: PointCloud) -> ColorICP:
        """Where points lack channels: the variance of a difference between two measurements of one spot, the Λ that
        `MultiChannelGICP` chooses. Constant to autodiff."""
        if self.missing_variance is not None or (source.channel_valid is None and target.channel_valid is None):
            return self
        variance = MultiChannelGICP(channel_weights=0.0).resolve(source, target).channel_covariance
        return eqx.tree_at(lambda method: method.missing_variance, self, variance, is_leaf=lambda leaf: leaf is None)

    def covariance_around(self, cloud: PointCloud) -> Covariance:
        return _identity

    def descriptors(self, cloud: PointCloud) -> Float[Array, "N D"]:
        return _weighted_channels(cloud, self.channel_weights)

    def absence(self, cloud: PointCloud) -> Float[Array, "N D"] | None:
        if cloud.channel_valid is None:
            return None
        if self.missing_variance is None:
            raise ValueError("missing_variance: not chosen yet; call method.resolve(source, target) first")
        return _absence(cloud, self.channel_weights, self.missing_variance)


class AbstractGeneralized(AbstractMethod):
    """Methods that weigh a pair with the covariances of both of its points: M = (C^B + R C^A Rᵀ)⁻¹."""

    def information(
        self, target: Float[Array, "6 N"], source: Float[Array, "6 N"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        return cov.inverse(target + cov.rotate(rotation, source))


class GICP(AbstractGeneralized):
    """Generalized ICP (Segal, Haehnel & Thrun 2009), plane to plane.

    Attributes:
        epsilon: ε, the variance across the surface relative to that within it.
    """

    epsilon: Float[Array, ""]

    def __init__(self, epsilon: ArrayLike = 1e-3):
        """Raises `ValueError` unless ε is positive, and large enough for the precision (1.2e-5 in float32)."""
        self.epsilon = _epsilon(epsilon)

    def covariance_around(self, cloud: PointCloud) -> Covariance:
        if cloud.covariances is not None:
            return _given(cloud)
        check_neighbors(cloud)
        epsilon = self.epsilon.astype(cloud.points.dtype)
        return lambda around: cov.plane_covariance(around.covariance, around.normal, epsilon)


class MultiChannelGICP(AbstractGeneralized):
    """Multi-channel generalized ICP (Servos & Waslander, ICRA 2014).

    The covariance of a point is ε across its surface and Ω within it (eqs. 6-10): small in the directions in which the
    channels tell the point from its neighbours. Matches are nearest in position and α · channel.

    Attributes:
        channel_covariance: Λ of eq. 7, scalar or (C,) variances or (C, C), channel units²; how far the channel values
            of two measurements of one and the same spot lie apart. None: from the data, see `resolve`.
        channel_weights: α, scalar or (C,), metres per channel unit. None: from the data, see `resolve`.
        epsilon: ε, as in `GICP`.
        min_eigenvalue: floor of Ω's eigenvalues, where nothing nearby looks alike. A match is one of the samples, and
            no sample lies just where it should: within the surface it cannot hold as well as across it. None: chosen
            along with Λ, see `resolve`; 0.005 with a Λ that is given.
    """

    uses_channels: ClassVar[bool] = True

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

    def resolve(self, source: PointCloud, target: PointCloud) -> MultiChannelGICP:
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
        if self.channel_covariance is not None and self.channel_weights is not None:
            return self
        source, target = jax.lax.stop_gradient((source, target))
        # What is known now is computed now: a compiler that folds a median as a constant takes seconds, and complains.
        with eagerly_if(is_concrete(source, target)):
            sigma, constant, across = channel_noise(source, target)
        with eagerly_if(is_concrete(target)):
            spacing = point_spacing(target)
        covariance, weights, floor = _chosen(sigma, constant, across, spacing, jax.lax.stop_gradient(self.epsilon))
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

    def covariance_around(self, cloud: PointCloud) -> Covariance:
        if cloud.covariances is not None:
            return _given(cloud)
        if self.channel_covariance is None:
            raise ValueError("channel_covariance: not chosen yet; call method.resolve(source, target) first")
        check_neighbors(cloud)
        dtype = cloud.points.dtype
        channels, covariance = jnp.asarray(cloud.channels), self.channel_covariance.astype(dtype)
        _check_covariance_fits(covariance, channels.shape[-1])
        if channels.shape[-1] == 0:
            return GICP(self.epsilon).covariance_around(cloud)
        if cloud.channel_valid is None:
            kernel = partial(cov.channel_kernel, _whiten(channels, covariance))
        else:
            kernel = partial(cov.partial_channel_kernel, channels, jnp.asarray(cloud.channel_valid), covariance)
        epsilon = self.epsilon.astype(dtype)
        floor = jnp.asarray(_MIN_EIGENVALUE if self.min_eigenvalue is None else self.min_eigenvalue, dtype)
        return lambda around: cov.multichannel_covariance(around, kernel(around), epsilon, floor)

    def descriptors(self, cloud: PointCloud) -> Float[Array, "N D"]:
        if self.channel_weights is None:
            raise ValueError("channel_weights: not chosen yet; call method.resolve(source, target) first")
        return _weighted_channels(cloud, self.channel_weights)

    def absence(self, cloud: PointCloud) -> Float[Array, "N D"] | None:
        if cloud.channel_valid is None:
            return None
        if self.channel_covariance is None or self.channel_weights is None:
            raise ValueError("channel_covariance: not chosen yet; call method.resolve(source, target) first")
        return _absence(cloud, self.channel_weights, self.channel_covariance)


@jax.jit
def prepare(method: AbstractMethod, cloud: PointCloud) -> Surface:
    """The surface that a resolved method sees in a cloud."""
    return surface(method, cloud, method.covariance(cloud))


def surface(method: AbstractMethod, cloud: PointCloud, covariance: Float[Array, "6 N"]) -> Surface:
    """The surface that a resolved method sees in a cloud, with its own covariances."""
    return Surface(
        points=jnp.asarray(cloud.points).T,
        covariance=covariance,
        descriptors=method.descriptors(cloud),
        valid=jnp.asarray(cloud.valid),
        absence=method.absence(cloud),
    )


@jax.jit
def _chosen(
    sigma: Float[Array, "C"],
    constant: Bool[Array, "C"],
    across: Float[Array, ""],
    spacing: Float[Array, ""],
    epsilon: Float[Array, ""],
) -> tuple[Float[Array, "C"], Float[Array, "C"], Float[Array, ""]]:
    """Λ, α and the floor of Ω, as `MultiChannelGICP.resolve` says."""
    within = epsilon * _MATCH_VARIANCE * spacing**2
    smooth = ~(2 * across > within)
    floor = jnp.where(smooth, 1, jnp.maximum(within / jnp.where(smooth, 1, 2 * across), _MIN_EIGENVALUE))
    return 2 * (_SPREAD * sigma) ** 2, jnp.where(constant, 0, _REACH * spacing / sigma), floor


def _identity(around: cov.Neighborhoods) -> Float[Array, "6 n"]:
    identity = jnp.array([[1.0], [0.0], [0.0], [1.0], [0.0], [1.0]], around.normal.dtype)
    return jnp.broadcast_to(identity, (6, around.rows.size))


def _given(cloud: PointCloud) -> Covariance:
    covariances = cov.symmetric_from_matrix(jnp.asarray(cloud.covariances))
    return lambda around: covariances[:, around.rows]


def _weighted_channels(cloud: PointCloud, weights: Float[Array, "..."]) -> Float[Array, "N C"]:
    count = cloud.channels.shape[-1]
    if weights.shape not in ((), (count,)):
        raise ValueError(
            f"channel_weights: expected a scalar or shape ({count},), for clouds of {count} channels, "
            f"got {weights.shape}"
        )
    return jnp.asarray(cloud.channels) * weights.astype(cloud.channels.dtype)


def _absence(cloud: PointCloud, weights: Float[Array, "..."], covariance: Float[Array, "..."]) -> Float[Array, "N C"]:
    """α² Λ_cc where a point lacks channel c, the expected square of the difference of a true match: a pair is then
    neither nearer nor further for what is not known of it."""
    variances = jnp.diagonal(covariance) if covariance.ndim == 2 else covariance
    expected = (weights**2 * variances).astype(cloud.channels.dtype)
    return jnp.where(jnp.asarray(cloud.channel_valid), 0, expected)


def _check_covariance_fits(covariance: Float[Array, "..."], count: int) -> None:
    if covariance.shape not in ((), (count,), (count, count)):
        raise ValueError(
            f"channel_covariance: expected a scalar, shape ({count},) or ({count}, {count}), for clouds of {count} "
            f"channels, got {covariance.shape}"
        )


def _whiten(channels: Float[Array, "N C"], covariance: Float[Array, "..."]) -> Float[Array, "N C"]:
    """Channels in which Λ is the identity."""
    if covariance.ndim < 2:
        return channels / jnp.sqrt(covariance)
    factor = jnp.linalg.cholesky(covariance)
    return jax.scipy.linalg.solve_triangular(factor, channels.T, lower=True).T


def _number(name: str, value: Values) -> Array:
    try:
        return jnp.asarray(value, float) if is_concrete(value) else jnp.asarray(value)
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
