"""The five methods as settings of one machine: which covariance a point has, and in which space matches are sought."""

from __future__ import annotations

import abc
import contextlib
import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from mcgicp_jax import _covariance as cov
from mcgicp_jax._cloud import PointCloud, Values
from mcgicp_jax._pose import is_concrete
from mcgicp_jax._search import Rows


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
    def covariance(self, cloud: PointCloud) -> Float[Array, "6 N"]:
        """What this method knows of the surface at each point."""

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

    def covariance(self, cloud: PointCloud) -> Float[Array, "6 N"]:
        return _identity(cloud)


class PointToPlane(AbstractOneSided):
    """Point-to-plane ICP (Chen & Medioni 1991): M = n nᵀ with the target's normals."""

    def covariance(self, cloud: PointCloud) -> Float[Array, "6 N"]:
        if cloud.covariances is not None:
            local = cov.symmetric_from_matrix(jnp.asarray(cloud.covariances))
        else:
            local = cov.local_covariance(jnp.asarray(cloud.points).T, _neighbors(cloud))
        return cov.outer(cov.smallest_eigenvector(local))


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

    def covariance(self, cloud: PointCloud) -> Float[Array, "6 N"]:
        return _identity(cloud)

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

    def covariance(self, cloud: PointCloud) -> Float[Array, "6 N"]:
        if cloud.covariances is not None:
            return cov.symmetric_from_matrix(jnp.asarray(cloud.covariances))
        local = cov.local_covariance(jnp.asarray(cloud.points).T, _neighbors(cloud))
        return cov.plane_covariance(local, cov.smallest_eigenvector(local), self.epsilon.astype(local.dtype))


class MultiChannelGICP(AbstractGeneralized):
    """Multi-channel generalized ICP (Servos & Waslander, ICRA 2014).

    The covariance of a point is ε across its surface and Ω within it (eqs. 6-10): small in the directions in which the
    channels tell the point from its neighbours. Matches are nearest in position and α · channel.

    Attributes:
        channel_covariance: Λ of eq. 7, scalar or (C,) variances or (C, C), channel units²; how far the channel values
            of two measurements of one and the same spot lie apart. None: from the data, see `resolve`.
        channel_weights: α, scalar or (C,), metres per channel unit. None: from the data, see `resolve`.
        epsilon: ε, as in `GICP`.
        min_eigenvalue: floor of Ω's eigenvalues, which keeps a covariance regular where nothing nearby looks alike.
    """

    uses_channels: ClassVar[bool] = True

    channel_covariance: Float[Array, "..."] | None
    channel_weights: Float[Array, "..."] | None
    epsilon: Float[Array, ""]
    min_eigenvalue: Float[Array, ""]

    def __init__(
        self,
        channel_covariance: Values | None = None,
        channel_weights: Values | None = None,
        epsilon: ArrayLike = 1e-3,
        min_eigenvalue: ArrayLike = 1e-3,
    ):
        """Raises `ValueError` if Λ is not positive definite, a weight is negative, or ε or the floor not positive."""
        self.channel_covariance = None if channel_covariance is None else _covariance(channel_covariance)
        self.channel_weights = None if channel_weights is None else _weights(channel_weights)
        self.epsilon = _epsilon(epsilon)
        self.min_eigenvalue = _positive_scalar("min_eigenvalue", min_eigenvalue)

    def resolve(self, source: PointCloud, target: PointCloud) -> MultiChannelGICP:
        """Λ and α from the data, where they were left open; constants to autodiff.

        σ, the noise of a channel, is the median residual of a linear fit of the channel over the tangent plane of each
        neighbourhood, over both clouds. Λ = 2σ², since a difference of two measurements has twice the variance; and
        α = spacing/σ, with the median distance between neighbouring target points: one σ weighs as much as one point
        spacing. A channel that is constant says nothing: its α is 0.
        """
        if self.channel_covariance is not None and self.channel_weights is not None:
            return self
        source, target = jax.lax.stop_gradient((source, target))
        # What is known now is computed now: a compiler that folds a median as a constant takes seconds, and complains.
        with _eagerly_if(is_concrete(source, target)):
            sigma, constant = _channel_noise(source, target)
        covariance, weights = self.channel_covariance, self.channel_weights
        if covariance is None:
            covariance = 2 * sigma**2
        if weights is None:
            with _eagerly_if(is_concrete(target)):
                spacing = _spacing(target)
            weights = jnp.where(constant, 0, spacing / sigma)
        return eqx.tree_at(
            lambda method: (method.channel_covariance, method.channel_weights),
            self,
            (covariance, weights),
            is_leaf=lambda leaf: leaf is None,
        )

    def covariance(self, cloud: PointCloud) -> Float[Array, "6 N"]:
        if cloud.covariances is not None:
            return cov.symmetric_from_matrix(jnp.asarray(cloud.covariances))
        points = jnp.asarray(cloud.points)
        if self.channel_covariance is None:
            raise ValueError("channel_covariance: not chosen yet; call method.resolve(source, target) first")
        neighbors, epsilon = _neighbors(cloud), self.epsilon.astype(points.dtype)
        channels, covariance = jnp.asarray(cloud.channels), self.channel_covariance.astype(points.dtype)
        _check_covariance_fits(covariance, channels.shape[-1])
        if channels.shape[-1] == 0:
            return GICP(self.epsilon).covariance(cloud)
        if cloud.channel_valid is None:
            kernel = cov.channel_kernel(_whiten(channels, covariance), neighbors)
        else:
            kernel = cov.partial_channel_kernel(channels, jnp.asarray(cloud.channel_valid), covariance, neighbors)
        return cov.multichannel_covariance(
            points.T, kernel, neighbors, epsilon, self.min_eigenvalue.astype(points.dtype)
        )

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
    points = jnp.asarray(cloud.points)
    return Surface(
        points=points.T,
        covariance=method.covariance(cloud),
        descriptors=method.descriptors(cloud),
        valid=jnp.asarray(cloud.valid),
        absence=method.absence(cloud),
    )


def _eagerly_if(concrete: bool) -> contextlib.AbstractContextManager[None]:
    return jax.ensure_compile_time_eval() if concrete else contextlib.nullcontext()


def _identity(cloud: PointCloud) -> Float[Array, "6 N"]:
    identity = jnp.array([[1.0], [0.0], [0.0], [1.0], [0.0], [1.0]], cloud.points.dtype)
    return jnp.broadcast_to(identity, (6, cloud.points.shape[0]))


def _neighbors(cloud: PointCloud) -> Array:
    if cloud.neighbors is None:
        raise ValueError("cloud: expected one with neighbors or covariances; make it with mcgicp_jax.preprocess")
    return jnp.asarray(cloud.neighbors)


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


@jax.jit
def _channel_noise(source: PointCloud, target: PointCloud) -> tuple[Float[Array, "C"], Bool[Array, "C"]]:
    """σ per channel, and which channels are constant (theirs is 1)."""
    residuals, values = [], []
    for cloud in (source, target):
        valid = jnp.asarray(cloud.valid)[:, None]
        if cloud.channel_valid is not None:
            valid = valid & jnp.asarray(cloud.channel_valid)
        residuals.append(jnp.where(valid, _fit_residual(cloud), jnp.nan))
        values.append(jnp.where(valid, jnp.asarray(cloud.channels), jnp.nan))
    sigma = jnp.nanmedian(jnp.concatenate(residuals), axis=0)
    everything = jnp.concatenate(values)
    spread = jnp.nanstd(everything, axis=0)
    constant = ~(spread > 1e3 * jnp.finfo(spread.dtype).eps * jnp.nanmax(jnp.abs(everything), axis=0, initial=0))
    # Rendered channels have no noise; a thousandth of their spread keeps Λ and α finite.
    return jnp.where(constant, 1, jnp.fmax(sigma, 1e-3 * spread)), constant


def _fit_residual(cloud: PointCloud) -> Float[Array, "N C"]:
    """Standard deviation of each channel about its linear fit over each neighbourhood's tangent plane."""
    points, neighbors = jnp.asarray(cloud.points).T, _neighbors(cloud)
    offsets, present = cov.gather(points, neighbors)
    basis = cov.orthonormal_basis(
        cov.smallest_eigenvector(cov.weighted_covariance(offsets, present.astype(points.dtype)))
    )
    x, y = (sum(offset * b for offset, b in zip(offsets, axis, strict=True)) for axis in basis)
    rows = jnp.where(present, neighbors.T, 0)
    residuals = []
    for i, channel in enumerate(jnp.asarray(cloud.channels).T):
        known = present if cloud.channel_valid is None else present & jnp.asarray(cloud.channel_valid)[:, i][rows]
        residuals.append(_residual_of_line(x, y, channel[rows], known.astype(x.dtype)))
    return jnp.stack(residuals, axis=-1) if residuals else jnp.zeros((points.shape[1], 0), points.dtype)


def _residual_of_line(
    x: Float[Array, "k N"], y: Float[Array, "k N"], values: Float[Array, "k N"], weights: Float[Array, "k N"]
) -> Float[Array, "N"]:
    """Standard deviation of values about their fit a + b x + c y; NaN where there are too few."""
    count = jnp.sum(weights, axis=0)

    def centred(values: Float[Array, "k N"]) -> Float[Array, "k N"]:
        return weights * (values - jnp.sum(weights * values, axis=0) / jnp.maximum(count, 1))

    x, y, values = centred(x), centred(y), centred(values)
    xx, xy, yy = jnp.sum(x * x, axis=0), jnp.sum(x * y, axis=0), jnp.sum(y * y, axis=0)
    determinant = xx * yy - xy * xy
    planar = determinant > 1e-6 * (xx + yy) ** 2
    safe = jnp.where(planar, determinant, 1)
    xc, yc = jnp.sum(x * values, axis=0), jnp.sum(y * values, axis=0)
    explained = jnp.where(planar, (yy * xc * xc - 2 * xy * xc * yc + xx * yc * yc) / safe, 0)
    square = jnp.maximum(jnp.sum(values * values, axis=0) - explained, 0)
    return jnp.where(count > 3, jnp.sqrt(square / jnp.maximum(count - 3, 1)), jnp.nan)


@jax.jit
def _spacing(cloud: PointCloud) -> Float[Array, ""]:
    """Median distance to the nearest other point, metres."""
    points, neighbors = jnp.asarray(cloud.points), _neighbors(cloud)
    second = neighbors[:, min(1, neighbors.shape[1] - 1)]
    distances = jnp.linalg.norm(points[jnp.maximum(second, 0)] - points, axis=-1)
    return jnp.nanmedian(jnp.where(jnp.asarray(cloud.valid) & (second >= 0), distances, jnp.nan))


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
