"""Multi-channel GICP, and estimation of its channel covariance from clouds of known poses."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mcgicp_jax._clouds.point_cloud import PointCloud, Values
from mcgicp_jax._clouds.preprocess import preprocess
from mcgicp_jax._compute.concrete import AnyArray, constant, numpy_for
from mcgicp_jax._compute.devices import put_on_cpu
from mcgicp_jax._compute.messages import check_concrete
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._local_geometry.channel_covariances import channel_kernel, multichannel_covariance, plane_covariance
from mcgicp_jax._local_geometry.cloud_statistics import channel_noise, point_spacing
from mcgicp_jax._local_geometry.local_geometry import Geometries, LocalGeometry, local_geometries
from mcgicp_jax._local_geometry.neighborhoods import NO_NEIGHBORS, Neighborhoods
from mcgicp_jax._math.poses import Pose, checked_pose_matrix
from mcgicp_jax._math.robust_kernels import AbstractKernel, positive_scalar
from mcgicp_jax._methods import base
from mcgicp_jax._search.kd_tree import nearest_in_position
from mcgicp_jax._terms.base import AbstractTerm, Mahalanobis
from mcgicp_jax._terms.photometric import Photometric

# Ratio. Between aligned real scans (RGB-D and LiDAR), the standard deviation of the channels' differences was 0.9 to
# 2.6 times the value expected from the noise within each scan; this is the geometric mean.
_SPREAD = 1.5
# In spacings of the target: α σ, the position offset that weighs as much as one σ of a channel.
_OFFSET_PER_SIGMA = 2.5
# ε and floor of Ω's eigenvalues, relative to GICP's in-plane variance of 1: defaults, and least values chosen from the
# data. ε is that of GICP.
_EPSILON, _MIN_EIGENVALUE = 1e-3, 5e-3
# Variance of a match along each tangent axis, spacing²: 1/(2 ln 2) for randomly placed points (Poisson process), whose
# squared nearest-neighbour distance r² has the mean E and the median E ln 2.
_MATCH_VARIANCE = 0.72
# Smallest number n of differences per channel: the relative standard error of a variance is √(2/n), 45 % for 10.
_MIN_DIFFERENCES = 10
# Default maximum distance of a match, in spacings: any other target point is then more than half a spacing away.
_SAME_SURFACE = 0.5
# Smallest eigenvalue of the correlation matrix, dimensionless: eight float32 epsilons keep Λ positive definite.
_LEAST_CORRELATION = 1e-6


class MultiChannelGICP(base.AbstractGeneralized):
    """Multi-channel generalized ICP (Servos & Waslander, ICRA 2014).

    The covariance of a point is ε along the normal and Ω within the surface (eqs. 6-10): small in the directions in
    which the channels distinguish the point from its neighbours. Matches are nearest in position and α · channel.

    Attributes:
        channel_covariance: Λ of eq. 7, scalar or (C,) variances or (C, C), channel units²: the covariance of the
            difference between two measurements of one surface point. None: chosen from the data, see `resolve`.
        channel_weights: α, scalar or (C,), metres per channel unit. None: chosen from the data, see `resolve`.
        epsilon: ε, as in `GICP`. None: chosen from the noise of the surfaces, see `resolve`; 0.001 if Λ is given.
        min_eigenvalue: floor of Ω's eigenvalues, reached where no neighbour has similar channels. Since the target is
            sampled, a match is less accurate within the surface than along the normal, whatever the channels. None:
            chosen along with Λ, see `resolve`; 0.005 if Λ is given.
        photometric: if True, Ω and α are used in the coarse phase only. The fine phase matches by position and
            minimises point-to-plane residuals and differences of interpolated channels, each divided by its estimated
            standard deviation (see `_terms.photometric`), which is mostly more accurate. A kernel `robust` then acts in
            the fine phase only. Its scale and `information` are in standard deviations. The numbers estimated from
            the residuals are constants to autodiff, so the derivative by points and channels is approximate: for noise
            on walls of posters, it is off by half and more. A value that more than half of the points have is missing
            where these lie together, such as black outside of an image.
    """

    uses_channels: ClassVar[bool] = True
    uses_neighborhoods: ClassVar[bool] = True

    channel_covariance: Float[Array, "..."] | None
    channel_weights: Float[Array, "..."] | None
    epsilon: Float[Array, ""] | None
    min_eigenvalue: Float[Array, ""] | None
    photometric: bool = eqx.field(static=True)

    def __init__(
        self,
        channel_covariance: Values | None = None,
        channel_weights: Values | None = None,
        epsilon: ArrayLike | None = None,
        min_eigenvalue: ArrayLike | None = None,
        photometric: bool = False,
    ):
        """Raises `ValueError` unless Λ is symmetric and positive definite, α finite and not negative, ε positive and
        large enough for the precision, and the floor positive; or if a shape is wrong."""
        self.channel_covariance = None if channel_covariance is None else base.covariance_of(channel_covariance)
        self.channel_weights = None if channel_weights is None else base.weights_of(channel_weights)
        self.epsilon = None if epsilon is None else base.epsilon_of(epsilon)
        self.min_eigenvalue = None if min_eigenvalue is None else positive_scalar("min_eigenvalue", min_eigenvalue)
        if not isinstance(photometric, bool | np.bool_):
            raise ValueError(f"photometric: expected True or False, got {photometric!r}")
        self.photometric = bool(photometric)

    @with_settings_of_package
    def resolve(self, source: PointCloud, target: PointCloud, geometries: Geometries | None = None) -> MultiChannelGICP:
        """The method with unset parameters chosen from the data; constants to autodiff.

        σ, the noise of a channel, is the median over both clouds' points of the residual deviation of linear fits in
        the tangent plane. Noise alone gives the difference of two measurements the variance 2 σ². In real scans its
        standard deviation is 1.5 times that, because of edges and changes: Λ = 2 (1.5 σ)². α = 2.5 spacing/σ; the
        spacing is the target's median nearest-neighbour distance. A difference of one σ then weighs as much as 2.5
        spacings, the fine `max_distance`, so that channels choose among the points within it. The α of constant
        channels is 0.

        ε is chosen if neither it nor Λ is given: the 25 % quantile over neighbourhoods of λ₀/v, at least 0.001. λ₀ is
        the smallest eigenvalue, and v the mean variance within the surface. The flattest neighbourhoods show the noise
        without edges and curvature. With a smaller ε, noise of the normals displaces the points within the surface more
        than channels hold them. If all channels are constant, ε is 0.001.

        The floor is chosen if neither it nor Λ is given. Between randomly placed points, a match has the variance 0.72
        spacing² along each tangent axis, and 2 λ₀ along the normal, with the median λ₀. The floor is 0.001, or the
        given (not the chosen) ε, times the ratio of the two, limited to 0.005 to 1. As λ₀ includes the curvature of the
        surface, the true ratio may be larger, so the estimate is used to raise the floor above 0.005 (as for rendered
        scenes), but not to lower it.
        """
        if self.channel_covariance is not None and self.channel_weights is not None:
            return self
        noise = channel_noise(source, target, geometries or partial(local_geometries, source, target, True))
        epsilon = jnp.asarray(_EPSILON) if self.epsilon is None else self.epsilon
        # Not of the clouds, whose concrete arrays would be traced, too.
        (sigma, uniform, across, ratio), spacing, epsilon = constant((noise, point_spacing(target), epsilon))
        xp = numpy_for(source, target, sigma, across, epsilon)
        with np.errstate(over="ignore", invalid="ignore"):
            within = xp.asarray(epsilon, spacing.dtype) * _MATCH_VARIANCE * spacing**2
            smooth = ~(2 * across > within)
            floor = xp.where(smooth, 1, xp.maximum(within / xp.where(smooth, 1, 2 * across), _MIN_EIGENVALUE))
            thickness = xp.where(xp.all(uniform), epsilon, xp.fmax(epsilon, ratio))
            weights = xp.where(uniform, 0, _OFFSET_PER_SIGMA * spacing / sigma)
            numbers = [2 * (_SPREAD * sigma) ** 2, weights, thickness, floor]
        covariance, weights, thickness, floor = (put_on_cpu(xp.asarray(number, epsilon.dtype)) for number in numbers)
        if self.channel_covariance is not None:
            thickness, floor = self.epsilon, self.min_eigenvalue
        resolved = eqx.tree_at(
            lambda method: (method.channel_covariance, method.channel_weights, method.epsilon, method.min_eigenvalue),
            self,
            (covariance, weights, thickness, floor),
            is_leaf=lambda leaf: leaf is None,
        )
        return base.with_unset_from(self, resolved)

    def terms(
        self, source: PointCloud, target: PointCloud, robust: AbstractKernel | None, equalize_channels: bool
    ) -> tuple[AbstractTerm, ...]:
        count = source.channels.shape[-1]
        if not self.photometric or count == 0:
            return super().terms(source, target, robust, equalize_channels)
        spacing = constant(point_spacing(target))
        # The scale of `robust` is that of the photometric residuals, not of the Mahalanobis distance.
        return (Photometric.before_estimate(spacing, count, Mahalanobis(self), robust, equalize_channels),)

    def covariance(self, around: Neighborhoods, local: LocalGeometry | None) -> Float[Array, "6 n"]:
        if around.given_covariance is not None:
            return around.given_covariance
        if around.near is None:
            raise ValueError(NO_NEIGHBORS)
        local, dtype = base.known_geometry(local), around.own.dtype
        epsilon = jnp.asarray(_EPSILON if self.epsilon is None else self.epsilon, dtype)
        covariance = self._covariance_for(around.num_channels).astype(dtype)
        if around.num_channels == 0:
            return plane_covariance(local, epsilon)
        floor = jnp.asarray(_MIN_EIGENVALUE if self.min_eigenvalue is None else self.min_eigenvalue, dtype)
        return multichannel_covariance(around, local, channel_kernel(around, covariance), epsilon, floor)

    def weights(self, num_channels: int) -> Float[AnyArray, "C"]:
        if self.channel_weights is None:
            raise ValueError("channel_weights: not chosen yet; call method.resolve(source, target) first")
        return base.per_channel("channel_weights", self.channel_weights, num_channels)

    def missing_variances(self, num_channels: int) -> Float[AnyArray, "C"]:
        covariance = self._covariance_for(num_channels)
        xp = numpy_for(covariance)
        return xp.broadcast_to(xp.diagonal(covariance) if covariance.ndim == 2 else covariance, (num_channels,))

    def _covariance_for(self, count: int) -> Float[Array, "..."]:
        """Λ, which must be chosen and fit clouds of `count` channels."""
        if self.channel_covariance is None:
            raise ValueError("channel_covariance: not chosen yet; call method.resolve(source, target) first")
        if self.channel_covariance.shape not in ((), (count,), (count, count)):
            raise ValueError(
                f"channel_covariance: expected a scalar, shape ({count},) or ({count}, {count}), for clouds of {count} "
                f"channels, got {self.channel_covariance.shape}"
            )
        return self.channel_covariance


@with_settings_of_package
def estimate_channel_covariance(
    clouds: Sequence[PointCloud], poses: Sequence[Pose], *, max_distance: float | None = None
) -> Float[np.ndarray, "C C"]:
    """Estimate the channel covariance Λ, with cross terms, from overlapping clouds of known poses.

    Λ is the covariance of the difference between two measurements of one surface point (Servos & Waslander 2014,
    IV-C); pass it to `MultiChannelGICP(channel_covariance=...)`. Each point is matched to the nearest point of the
    preceding cloud. The mean difference of two clouds, caused for instance by their exposures, is removed. Each entry
    of Λ is computed from the matches that have both of its channels.

    Args:
        clouds: at least two, ordered so that consecutive clouds overlap; preprocessed, or raw (then not downsampled).
        poses: one per cloud, sensor to world, `jaxlie.SE3` or (4, 4).
        max_distance: maximum correspondence distance, metres; by default half the median nearest-neighbour
            distance of the preceding cloud.

    Returns:
        (C, C), channel units², float64, symmetric and positive definite.

    Raises:
        ValueError: if there are fewer than two clouds, the number of poses differs, the channels differ, a channel has
            fewer than ten matches, or an array is traced.
    """
    if len(clouds) < 2 or len(clouds) != len(poses):
        raise ValueError(f"poses: expected one per cloud and at least two, got {len(poses)} for {len(clouds)} clouds")
    for i, (cloud, pose) in enumerate(zip(clouds, poses, strict=True)):
        check_concrete(f"clouds[{i}]", cloud)
        check_concrete(f"poses[{i}]", pose)
    matrices = [np.asarray(checked_pose_matrix(pose, f"poses[{i}]")) for i, pose in enumerate(poses)]
    ready = [cloud if cloud.deferred_neighbors is not None else preprocess(cloud, None) for cloud in clouds]
    names = ready[0].channel_names
    for i, cloud in enumerate(ready):
        if cloud.channel_names != names:
            raise ValueError(f"clouds[{i}]: expected the channels {names}, got {cloud.channel_names}")
    products, counts = np.zeros((len(names), len(names))), np.zeros((len(names), len(names)))
    for (target, target_pose), (source, source_pose) in itertools.pairwise(zip(ready, matrices, strict=True)):
        limit = _SAME_SURFACE * float(point_spacing(target)) if max_distance is None else max_distance
        moved, fixed = source.transform(np.linalg.inv(target_pose) @ source_pose).unpad(), target.unpad()
        nearest = nearest_in_position(moved.points, fixed.points, limit)
        matched = (moved, np.flatnonzero(nearest >= 0)), (fixed, nearest[nearest >= 0])
        values = [np.asarray(cloud.channels, np.float64)[rows] for cloud, rows in matched]
        present = np.ones(values[0].shape, bool)
        for cloud, rows in matched:
            if cloud.channel_valid is not None:
                present &= np.asarray(cloud.channel_valid)[rows]
        differences = np.where(present, values[0] - values[1], 0)
        number = np.maximum(present.sum(axis=0), 1)
        differences = np.where(present, differences - differences.sum(axis=0) / number, 0)
        products += differences.T @ differences
        counts += present.T.astype(float) @ present
    if counts.size and np.diagonal(counts).min() < _MIN_DIFFERENCES:
        scarcest = names[int(np.diagonal(counts).argmin())]
        raise ValueError(
            f"clouds: expected at least {_MIN_DIFFERENCES} matches per channel, got "
            f"{np.diagonal(counts).min():.0f} for {scarcest!r}; check the poses, or raise max_distance"
        )
    # The covariance of two channels that no match has in common is unknown, and set to 0.
    covariance = products / np.maximum(counts, 1)
    deviations = np.sqrt(np.maximum(np.diagonal(covariance), np.finfo(np.float32).tiny))
    scale = np.outer(deviations, deviations)
    # Eigenvalues of the correlations can be 0 or negative if a channel never differs, or because the entries come from
    # different matches.
    eigenvalues, vectors = np.linalg.eigh(covariance / scale)
    return (vectors * np.maximum(eigenvalues, _LEAST_CORRELATION)) @ vectors.T * scale
