"""Channels that move with the sensor, such as distance, time, vignetting or the gain of each beam: they match
perfectly at the pose of no motion and constrain it, even where the sensor has moved.

Such a channel is a simple function of a point's place in the frame of the sensor, and a texture is not. Two shares of
the variance of a channel, in which each half of a sample is predicted from the other, tell them apart. *By angles*: the
largest share explained by a function of range alone, of elevation alone or of azimuth alone, about the origin and the z
axis of the cloud (a small share where these are not those of a sensor). *Smooth*: the share explained by a polynomial
of position, which does not depend on the choice of coordinates.
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.cache import cached_with_cloud
from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, constant, is_concrete, numpy_for
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.messages import warn
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.statistics import median, sampled_rows

# Share of the variance above which a channel is no texture. By angles, nine patterns on three scenes have 0.82 to 1.00
# (gains of beams with tiles of ± 5 % beside them 0.74); tables, posters, streets, KITTI and TUM at most 0.47. Smooth,
# all patterns but the gains of beams have 0.80 to 1.00; tables, posters, streets and KITTI at most 0.54, a wall with
# two periods of a sine 0.59. Tables under a lamp that moves with the camera have 0.71 to 0.97, errors 3 to 140 mm.
_NO_TEXTURE = 0.7
# Share by angles above which a channel is left out: distance, elevation, azimuth and time have at least 0.96.
_LEFT_OUT = 0.9
# Share of the variance of the mask of equal values above which they are a part such as that outside of an image. Views
# cut to a disc, a box or a half, and the camera's view in KITTI's scans, have 0.73 to 0.98 (half of the points or
# more); posters, streets and intensities below a quantile at most 0.38.
_ONE_PART = 0.55
# Neighbours of the part that count as its rim: a point itself and those around it.
_RIM = 7
# Bins of range, elevation and azimuth, of equally many points, and least number of points of each, half of which
# predict. 64 and 256 bins separate patterns from textures as well, but 64 less so for narrow beams.
_BINS, _PER_BIN = 128, 16
# Distance of the origin from the centroid, in root mean square radii of the cloud, beyond which the origin is no
# sensor: from there range, elevation and azimuth are like Cartesian coordinates, of which a texture of stripes may be a
# function. A view of 28° has 4.
_FARTHEST = 4.0
# Degree of the polynomial: 3 explains jumps (time) to 0.77 only, 5 textures to 0.88. Ridge, as a fraction of the mean
# eigenvalue of the normal equations, for float32; 1e-6 to 1e-3 give the same.
_DEGREE, _RIDGE = 4, 1e-4
# Bound of a prediction, standard deviations: a polynomial diverges where the other half has no points.
_LARGEST = 3.0
# Distance from the centroid, in median distances, at which the coordinates of the polynomial level off, so that a few
# far points do not decide it.
_LEVEL = 2.0


class Explained(NamedTuple):
    """Shares of the variance of each channel; 0 and 1 for constant channels."""

    by_angles: Float[AnyArray, "C"]
    smooth: Float[AnyArray, "C"]


class _Sample(NamedTuple):
    """Evenly spaced rows of a cloud, whose first and second halves predict each other. Channels are standardised, and 0
    where missing; weights are 1 where present, else 0, in one row for all channels if none is missing."""

    points: Float[AnyArray, "3 n"]
    present: Bool[AnyArray, "n"]
    channels: Float[AnyArray, "C n"]
    weights: Float[AnyArray, "W n"]


def channels_may_move(source: PointCloud) -> Bool[AnyScalar, ""]:
    """Whether no channel is a texture, so that a pose that only they constrain may be that of no motion."""
    by_angles, smooth = explained(source)
    return ((by_angles > _NO_TEXTURE) | (smooth > _NO_TEXTURE)).all()


def doubt_of_patterns(source: PointCloud) -> str:
    largest = [max(both) for both in zip(*explained(source), strict=True)]
    shares = [f"{share:.0%} of {name}" for name, share in zip(source.channel_names, largest, strict=True) if share < 1]
    return (
        f"channels: a smooth function of position, or one of range, elevation or azimuth, explains "
        f"{', '.join(shares) or 'them'} (variance); such channels may move with the sensor, and the pose is UNVERIFIED"
    )


def without_patterns(source: PointCloud, target: PointCloud) -> list[PointCloud]:
    """Set channels to 0 that are a function of range, elevation or azimuth in the source (the target may be a map)."""
    if not source.channels.shape[1] or source.channels.shape[1] != target.channels.shape[1]:
        return [source, target]
    by_angles = explained(primal(source)).by_angles
    left_out = by_angles > _LEFT_OUT
    if is_concrete(left_out):
        if not left_out.any():
            return [source, target]
        for name, share in zip(source.channel_names, by_angles, strict=True):
            if share > _LEFT_OUT:
                warn(
                    f"channel {name}: {share:.0%} of its variance is a function of range, elevation or azimuth about "
                    "the origin; it seems to move with the sensor, and is left out"
                )
    return [_blank(cloud, left_out) for cloud in (source, target)]


# The cached copy is the same each time, with all that is cached of it.
@cached_with_cloud
def _blank(cloud: PointCloud, left_out: Bool[AnyArray, "C"]) -> PointCloud:
    return cloud.replace_rows(channels=numpy_for(cloud.channels, left_out).where(left_out, 0, cloud.channels))


def without_constant_part(cloud: PointCloud) -> PointCloud:
    """Mark a constant part, such as black outside of an image, as missing: its edge may move with the sensor."""
    if not cloud.channels.shape[1]:
        return cloud
    part = _constant_part(primal(cloud))
    if is_concrete(part):
        if not part.any():
            return cloud
        names = [name for name, rows in zip(cloud.channel_names, part.T, strict=True) if rows.any()]
        warn(
            f"channels {', '.join(names)}: {part.any(axis=1).sum()} of {len(part)} points lie together and have one "
            "value, as outside of an image; it counts as missing. Mark missing channels by channel_valid"
        )
    return _missing(cloud, part)


@cached_with_cloud
def _constant_part(cloud: PointCloud) -> Bool[AnyArray, "N C"]:
    xp = numpy_for(cloud)
    channels, (rows, valid) = xp.asarray(cloud.channels), sampled_rows(xp.asarray(cloud.valid))
    # More than half of the points have one value: the median.
    ordered = xp.sort(xp.where(valid[:, None], channels[rows], xp.inf), axis=0)
    middle = xp.take_along_axis(ordered, xp.full((1, channels.shape[1]), xp.sum(valid) // 2), axis=0)
    part = channels == middle
    share = xp.sum(part[rows] & valid[:, None], axis=0) / xp.maximum(xp.sum(valid), 1)
    masks = cloud.replace_rows(channels=part.astype(channels.dtype))
    constant_channels = (share > 0.5) & (share < 1) & (xp.maximum(*explained(masks)) > _ONE_PART)
    together = (part | ~constant_channels).all(axis=1) & constant_channels.any()
    if cloud.deferred_neighbors is not None and (xp is not np or together.any()):
        # Voxels across the edge hold means of both sides.
        near = xp.asarray(cloud.neighbors)[:, :_RIM]
        together = together | (together[near] & (near >= 0)).any(axis=1)
    return constant_channels & together[:, None]


@cached_with_cloud
def _missing(cloud: PointCloud, part: Bool[AnyArray, "N C"]) -> PointCloud:
    present = ~part if cloud.channel_valid is None else cloud.channel_valid & ~part
    return cloud.replace_rows(channel_valid=present)


@cached_with_cloud
def explained(cloud: PointCloud) -> Explained:
    # Huge values overflow; comparisons with shares that are not finite are False.
    with np.errstate(all="ignore"):
        cloud = constant(cloud)
        xp = numpy_for(cloud)
        rows, present = sampled_rows(xp.asarray(cloud.valid))
        # Every second row, then the others.
        order = np.argsort(np.arange(rows.size) % 2, stable=True)
        rows, present = rows[order], present[order]
        dtype = np.float64 if xp is np else cloud.points.dtype
        points, channels = (xp.asarray(array)[rows].astype(dtype).T for array in (cloud.points, cloud.channels))
        present = present & xp.isfinite(points).all(axis=0)
        weights = present[None].astype(dtype)
        if cloud.channel_valid is not None:
            weights = weights * xp.asarray(cloud.channel_valid)[rows].T
        counts = xp.maximum(weights.sum(axis=1, keepdims=True), 1)
        channels = xp.where(weights > 0, channels, 0)
        channels = weights * (channels - channels.sum(axis=1, keepdims=True) / counts)
        deviations = xp.sqrt((channels**2).sum(axis=1, keepdims=True) / counts)
        channels = channels / xp.where(deviations > 0, deviations, 1)
        sample = _Sample(xp.where(present, points, 0), present, channels, weights)
        return Explained(_by_angles(sample), _smooth(sample))


def _share(sample: _Sample, predicted: Float[AnyArray, "C n"]) -> Float[AnyArray, "C"]:
    """The share of the variance that a prediction explains; 1 for constant channels."""
    total = (sample.channels**2).sum(axis=1)
    unexplained = (sample.weights * (sample.channels - predicted) ** 2).sum(axis=1)
    return 1 - unexplained / numpy_for(total).where(total > 0, total, 1)


def _by_angles(sample: _Sample) -> Float[AnyArray, "C"]:
    xp = numpy_for(sample)
    x, y, z = sample.points
    distance = xp.sqrt(x * x + y * y + z * z)
    half = (np.arange(x.size) >= (x.size + 1) // 2).astype(int)
    count = sample.present.sum()
    num_bins = xp.clip(count // _PER_BIN, 1, _BINS)
    rows = xp.concatenate([sample.channels, xp.broadcast_to(sample.weights, sample.channels.shape)])
    shares = []
    for coordinate in (distance, z / xp.where(distance > 0, distance, 1), xp.arctan2(y, x)):
        ranks = xp.argsort(xp.argsort(xp.where(sample.present, coordinate, xp.inf)))
        bins = xp.minimum(ranks * num_bins // xp.maximum(count, 1), _BINS - 1)
        # Sums per bin and half; each point is predicted from its bin in the other half.
        keys = half * _BINS + bins
        if is_concrete(rows, keys):
            sums: Any = np.stack([np.bincount(keys, row, 2 * _BINS) for row in rows])
        else:
            sums = jnp.zeros((len(rows), 2 * _BINS), rows.dtype).at[:, keys].add(rows)
        totals, counts = xp.split(sums[:, (1 - half) * _BINS + bins], 2)
        # The mean of all points, 0, counts as one more point of each bin.
        shares.append(_share(sample, totals / (counts + 1)))
    # A sensor far from the cloud sees angles that are like Cartesian coordinates, see `_FARTHEST`.
    center = sample.points.sum(axis=1) / xp.maximum(count, 1)
    radius = xp.sqrt((sample.present * ((sample.points.T - center) ** 2).sum(axis=1)).sum() / xp.maximum(count, 1))
    near = xp.sqrt((center**2).sum()) <= _FARTHEST * radius
    varies = (sample.channels != 0).any(axis=1)
    return xp.where(near & varies, xp.stack(shares).max(axis=0), 0)


def _smooth(sample: _Sample) -> Float[AnyArray, "C"]:
    xp = numpy_for(sample)
    # Coordinates about the centroid, which level off far from it.
    offset = sample.points - sample.points.sum(axis=1, keepdims=True) / xp.maximum(sample.present.sum(), 1)
    square = (offset * offset).sum(axis=0)
    level = _LEVEL * median(xp.where(sample.present, xp.sqrt(square), xp.nan))
    level = xp.where(level > 0, level, 1)
    bounded = sample.present * offset / xp.sqrt(level**2 + square)
    # Products of up to `_DEGREE` of them, with a root mean square of 1.
    products: dict[tuple[int, ...], Any] = {(): xp.ones_like(square)}
    for degree in range(1, _DEGREE + 1):
        for axes in combinations_with_replacement(range(3), degree):
            products[axes] = products[axes[1:]] * bounded[axes[0]]
    basis = xp.stack(list(products.values()))
    sizes = xp.sqrt((basis * basis).mean(axis=1, keepdims=True))
    basis = basis / xp.where(sizes > 0, sizes, 1)
    middle = (square.size + 1) // 2
    halves = [xp.split(array, [middle], axis=1) for array in (basis, sample.weights, sample.channels)]
    # The normal equations of each half, for each channel.
    equations = [
        (xp.stack([(row * part) @ part.T for row in weights]), values @ part.T)
        for part, weights, values in zip(*halves, strict=True)
    ]
    matrix, side = (xp.stack(parts) for parts in zip(*equations, strict=True))
    scale = xp.trace(matrix, axis1=-2, axis2=-1)[..., None, None] / len(basis)
    matrix = matrix + _RIDGE * xp.where(scale > 0, scale, 1) * np.eye(len(basis), dtype=matrix.dtype)
    matrix = xp.broadcast_to(matrix, (*side.shape, len(basis)))
    second, first = alg.solve(matrix, side)
    predicted = xp.concatenate([first @ halves[0][0], second @ halves[0][1]], axis=1)
    return _share(sample, xp.clip(predicted, -_LARGEST, _LARGEST))
