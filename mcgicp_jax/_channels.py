"""What the channels of clouds are like: their noise, how two measurements of one spot differ, gain and offset."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax import _covariance as cov
from mcgicp_jax._cloud import PointCloud
from mcgicp_jax._kdtree import KDTreeSearch
from mcgicp_jax._pose import Pose, pose_matrix
from mcgicp_jax._preprocess import preprocess
from mcgicp_jax._search import Correspondences, Rows

# Shares of the values below which gain and offset are read off.
_QUANTILES = tuple(share / 20 for share in range(1, 20))
# Fewer differences than this tell no variance.
_MIN_DIFFERENCES = 10


def estimate_channel_covariance(
    clouds: Sequence[PointCloud], poses: Sequence[Pose], *, max_distance: float | None = None
) -> Float[np.ndarray, "C C"]:
    """Λ with its cross terms, measured: the covariance of the difference between two measurements of one spot.

    For `MultiChannelGICP(channel_covariance=...)`, from clouds of known poses (Servos & Waslander 2014, IV-C). Each
    cloud is compared with the next: every point with the nearest one, if it is near enough to be the same spot. The
    mean difference of two clouds, as of their exposures, does not count. An entry of Λ is taken over the differences
    that have both of its channels.

    Args:
        clouds: at least two, in any order in which neighbours overlap; prepared, or raw ones that are used as they are.
        poses: sensor to world, `jaxlie.SE3` or (4, 4), one per cloud.
        max_distance: metres; by default half the median distance between neighbouring points.

    Returns:
        (C, C), channel units², float64, symmetric and positive definite.

    Raises:
        ValueError: if there is not one pose for each cloud, the channels differ, or fewer than ten spots were seen
            twice in a channel.
    """
    if len(clouds) < 2 or len(clouds) != len(poses):
        raise ValueError(f"poses: expected one for each of two clouds or more, got {len(poses)} for {len(clouds)}")
    matrices = [np.asarray(pose_matrix(pose, f"poses[{i}]")) for i, pose in enumerate(poses)]
    ready = [cloud if cloud.neighbors is not None else preprocess(cloud) for cloud in clouds]
    names = ready[0].channel_names
    for i, cloud in enumerate(ready):
        if cloud.channel_names != names:
            raise ValueError(f"clouds[{i}]: expected the channels {names}, got {cloud.channel_names}")
    products, counts = np.zeros((len(names), len(names))), np.zeros((len(names), len(names)))
    for target, source in itertools.pairwise(zip(ready, matrices, strict=True)):
        limit = 0.5 * float(point_spacing(target[0])) if max_distance is None else max_distance
        differences, known = _differences(*source, *target, limit)
        number = np.maximum(known.sum(axis=0), 1)
        differences = np.where(known, differences - differences.sum(axis=0) / number, 0)
        products += differences.T @ differences
        counts += known.T.astype(float) @ known
    if counts.size and np.diagonal(counts).min() < _MIN_DIFFERENCES:
        least = names[int(np.diagonal(counts).argmin())]
        raise ValueError(
            f"clouds: expected {_MIN_DIFFERENCES} spots or more that were seen twice, got "
            f"{np.diagonal(counts).min():.0f} with the channel {least!r}; check the poses, or raise max_distance"
        )
    # Where no differences have both of two channels, nothing is known of their covariance.
    return _positive_definite(products / np.maximum(counts, 1))


def _differences(
    source: PointCloud,
    source_pose: Float[np.ndarray, "4 4"],
    target: PointCloud,
    target_pose: Float[np.ndarray, "4 4"],
    max_distance: float,
) -> tuple[Float[np.ndarray, "N C"], Bool[np.ndarray, "N C"]]:
    """Differences between channels of the same spots, 0 where one is missing, and where there are any."""
    matrix = np.linalg.inv(target_pose) @ source_pose
    moved, fixed = source.transform(matrix).unpad(), target.unpad()
    rows = [
        Rows(points=np.asarray(cloud.points).T, descriptors=np.zeros((len(cloud), 0)), valid=np.ones(len(cloud), bool))
        for cloud in (moved, fixed)
    ]
    at_rest = np.array([1.0, 0, 0, 0, 0, 0, 0])
    (nearest,) = KDTreeSearch().index(rows[1]).nearest(at_rest, rows[0], max_distance)
    distances = np.linalg.norm(np.asarray(fixed.points)[nearest] - np.asarray(moved.points), axis=1)
    near = (nearest >= 0) & (distances <= max_distance)
    pair = [(moved, np.flatnonzero(near)), (fixed, nearest[near])]
    known = np.ones((near.sum(), moved.channels.shape[1]), bool)
    for cloud, chosen in pair:
        if cloud.channel_valid is not None:
            known &= np.asarray(cloud.channel_valid)[chosen]
    values = [np.asarray(cloud.channels, np.float64)[chosen] for cloud, chosen in pair]
    return np.where(known, values[0] - values[1], 0), known


def _positive_definite(covariance: Float[np.ndarray, "C C"]) -> Float[np.ndarray, "C C"]:
    """The same but for eigenvalues that are not positive: channels that never differ, entries from different spots."""
    deviations = np.sqrt(np.maximum(np.diagonal(covariance), np.finfo(np.float32).tiny))
    values, vectors = np.linalg.eigh(covariance / np.outer(deviations, deviations))
    return (vectors * np.maximum(values, 1e-6)) @ vectors.T * np.outer(deviations, deviations)


@jax.jit
def with_channels_matched(source: PointCloud, target: PointCloud, matches: Correspondences | None = None) -> PointCloud:
    """The source, each channel scaled and shifted so that its values are distributed like the target's.

    By the quantiles from 5 to 95 %: robust against what only one of the clouds sees, as long as that is little; with
    matches, by the matched points alone. Not pair by pair: noise, and pairs across edges, would make the gain too
    small. Gain and offset are constants to autodiff.
    """
    source_values, target_values = jax.lax.stop_gradient((_known_values(source), _known_values(target)))
    if matches is not None:
        target_values = target_values[matches.indices]
        paired = matches.valid[:, None] & jnp.isfinite(source_values) & jnp.isfinite(target_values)
        # A few points tell no distribution.
        paired = paired & (jnp.sum(paired, axis=0) > len(_QUANTILES))
        source_values, target_values = (jnp.where(paired, values, jnp.nan) for values in (source_values, target_values))
    shares = jnp.asarray(_QUANTILES, source_values.dtype)
    quantiles = [jnp.nanquantile(values, shares, axis=0) for values in (source_values, target_values)]
    means = [jnp.mean(values, axis=0) for values in quantiles]
    spreads = [jnp.std(values, axis=0) for values in quantiles]
    telling = (spreads[0] > 0) & (spreads[1] > 0)
    gain = jnp.where(telling, spreads[1] / jnp.where(telling, spreads[0], 1), 1)
    offset = means[1] - gain * means[0]
    known = jnp.isfinite(gain) & jnp.isfinite(offset)
    channels = jnp.asarray(source.channels)
    return source.replace(channels=jnp.where(known, gain, 1) * channels + jnp.where(known, offset, 0))


def _known_values(cloud: PointCloud) -> Float[Array, "N C"]:
    """Channels, NaN where there are none."""
    valid = jnp.asarray(cloud.valid)[:, None]
    if cloud.channel_valid is not None:
        valid = valid & jnp.asarray(cloud.channel_valid)
    return jnp.where(valid, jnp.asarray(cloud.channels), jnp.nan)


def eagerly_if(concrete: bool) -> contextlib.AbstractContextManager[None]:
    return jax.ensure_compile_time_eval() if concrete else contextlib.nullcontext()


def check_neighbors(cloud: PointCloud) -> None:
    if cloud.neighbors is None:
        raise ValueError("cloud: expected one with neighbors or covariances; make it with mcgicp_jax.preprocess")


def neighbors_of(cloud: PointCloud) -> Array:
    check_neighbors(cloud)
    return jnp.asarray(cloud.neighbors)


@jax.jit
def channel_noise(
    source: PointCloud, target: PointCloud
) -> tuple[Float[Array, "C"], Bool[Array, "C"], Float[Array, ""]]:
    """σ per channel, which channels are constant (theirs is 1), and the variance of points across the surface, λ₀."""
    residuals, values, across = [], [], []
    for cloud in (source, target):
        valid = jnp.asarray(cloud.valid)
        # Where points lack channels, few may have one.
        rows, counts = (jnp.arange(valid.size), valid) if cloud.channel_valid is not None else cov.some_rows(valid)
        residual, variance = _fit_residuals(cloud, rows)
        known = _known_values(cloud)
        residuals.append(jnp.where(counts[:, None] & ~jnp.isnan(known[rows]), residual, jnp.nan))
        values.append(known)
        across.append(jnp.where(counts, variance, jnp.nan))
    sigma = cov.median(jnp.concatenate(residuals).T)
    everything = jnp.concatenate(values)
    spread = jnp.nanstd(everything, axis=0)
    constant = ~(spread > 1e3 * jnp.finfo(spread.dtype).eps * jnp.nanmax(jnp.abs(everything), axis=0, initial=0))
    # Rendered channels have no noise; a thousandth of their spread keeps Λ and α finite.
    return jnp.where(constant, 1, jnp.fmax(sigma, 1e-3 * spread)), constant, cov.median(jnp.concatenate(across))


def _fit_residuals(cloud: PointCloud, rows: Int[Array, "n"]) -> tuple[Float[Array, "n C"], Float[Array, "n"]]:
    """Of some rows: standard deviation of each channel about its linear fit over the neighbourhood's tangent plane, NaN
    where too few neighbours have the channel; and the variance of the neighbours across that plane, metres²."""
    points = jnp.asarray(cloud.points).T

    def fit(around: cov.Neighborhoods) -> tuple[Float[Array, "n"], ...]:
        normal, present = around.normal, around.present
        basis = cov.orthonormal_basis(normal)
        x, y = (sum(offset * b for offset, b in zip(around.offsets, axis, strict=True)) for axis in basis)
        near = jnp.where(present, around.neighbors.T, 0)
        residuals = []
        for i, channel in enumerate(jnp.asarray(cloud.channels).T):
            known = present if cloud.channel_valid is None else present & jnp.asarray(cloud.channel_valid)[:, i][near]
            linear = cov.fit_linear(x, y, channel[near], known.astype(x.dtype))
            residuals.append(jnp.where(linear.weight > 3, jnp.sqrt(linear.residual), jnp.nan))
        return jnp.sum(normal * cov.multiply(around.covariance, normal), axis=0), *residuals

    across, *residuals = cov.by_neighborhoods(fit, points, neighbors_of(cloud)[rows], rows)
    return jnp.stack(residuals, axis=-1) if residuals else jnp.zeros((rows.size, 0), points.dtype), across


@jax.jit
def point_spacing(cloud: PointCloud) -> Float[Array, ""]:
    """Median distance to the nearest neighbour that lies elsewhere, metres; 0 if all lie in one place.

    Some files hold points twice, and some scanners report each beam without an echo as a point at the origin.
    """
    rows, counts = cov.some_rows(jnp.asarray(cloud.valid))
    neighbors = neighbors_of(cloud)[rows]
    present = counts[:, None] & (neighbors >= 0)
    square = jnp.zeros(neighbors.shape, cloud.points.dtype)
    for coordinate in jnp.asarray(cloud.points).T:
        square = square + (coordinate[jnp.maximum(neighbors, 0)] - coordinate[rows, None]) ** 2
    nearest = jnp.min(jnp.where(present & (square > 0), square, jnp.inf), axis=1)
    return jnp.nan_to_num(cov.median(jnp.where(jnp.isfinite(nearest), jnp.sqrt(nearest), jnp.nan)))
