"""Channels that move with the sensor, such as distance, time, vignetting or the gain of each beam, and hold a pose where
the sensor has not moved.

Such a channel is a function of a point's place in the frame of the sensor, a texture is not. Two shares of the variance
of a channel, each predicted from the other half of a sample, tell them apart. *By angles*: the largest of those that a
function of range alone, of elevation alone or of azimuth alone explains, each about the origin and the z axis of the
cloud's own coordinates: those of its sensor, or else of no meaning, and then they explain little. *Smooth*: the share
that a polynomial of position explains, whatever the coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.cache import cached_with_cloud
from mcgicp_jax._compute.concrete import AnyArray, constant, is_concrete, numpy_for
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.messages import warn
from mcgicp_jax._math.statistics import median, sampled_rows

# Share of the variance above which a channel is no texture. By angles: nine patterns on three scenes have 0.84 to 1.00
# (with tiles of ± 5 % beside them, down to 0.76), tables, 7-Scenes, TUM, KITTI, posters, streets and rooms at most 0.61.
# Smooth: all of these patterns but beams 0.80 to 1.00; tables, posters, streets and KITTI at most 0.53, a wall of sines
# of two periods 0.59. 7-Scenes and rooms, which geometry constrains, have up to 0.84.
_EXPLAINED = 0.7
# Bins of range, elevation and azimuth, of equally many points, and least number of points of each, half of which
# predict. With 64 and 256 bins, patterns and textures are as far apart, but narrow beams less so with 64.
_BINS, _PER_BIN = 128, 16
# Root mean square radii of a cloud from its centroid beyond which the origin is no sensor: from there range, elevation
# and azimuth are coordinates, of which a texture of stripes may be a function. A view of 28° has 4.
_FARTHEST = 4.0
# Rows of the sample: half of that for medians, with the same shares to 0.03.
_ROWS = 2049
# Degree of the polynomial: with 3, jumps (time) are explained to 0.77, with 5, textures to 0.88. Ridge, as a fraction of
# the mean eigenvalue of the normal equations, for float32; 1e-6 to 1e-3 give the same.
_DEGREE, _RIDGE = 4, 1e-4
# Bound of a prediction, standard deviations: a polynomial diverges where the other half has no points.
_LARGEST = 3.0
# Median distances from the centroid at which the coordinates of the polynomial level off, so that a few far points do
# not decide it.
_LEVEL = 2.0


class Explained(NamedTuple):
    """Shares of the variance of each channel, by angles and smooth, and which channels vary at all."""

    by_angles: Float[AnyArray, "*clouds C"]
    smooth: Float[AnyArray, "*clouds C"]
    varies: Bool[AnyArray, "*clouds C"]


class _Sample(NamedTuple):
    """Evenly spaced rows of a cloud. Channels have the mean 0 and the deviation 1, and are 0 where they are missing;
    weights are 1 where they are present, else 0, with one row for all channels if none is missing."""

    points: Float[AnyArray, "3 n"]
    present: Bool[AnyArray, "n"]
    channels: Float[AnyArray, "C n"]
    weights: Float[AnyArray, "W n"]
    varies: Bool[AnyArray, "C"]


def channels_constrain(source: PointCloud, target: PointCloud) -> Bool[AnyArray, ""]:
    """Whether any channel is a texture, which may constrain a motion that geometry does not."""
    if not source.channel_names:
        return np.bool_(True)
    _, smooth, varies = _explained(source, target)
    return (varies & ~(smooth > _EXPLAINED)).any()


def without_patterns(source: PointCloud, target: PointCloud) -> list[PointCloud]:
    """The clouds with each channel set to 0 that is a function of range, elevation or azimuth in one of them."""
    if not source.channel_names or len(source.channel_names) != len(target.channel_names):
        return [source, target]
    by_angles = _explained(*primal((source, target))).by_angles
    left_out = by_angles > _EXPLAINED
    if is_concrete(left_out):
        if not left_out.any():
            return [source, target]
        for name, share in zip(source.channel_names, by_angles, strict=True):
            if share > _EXPLAINED:
                warn(
                    f"channel {name}: {share:.0%} of its variance is a function of range, elevation or azimuth about "
                    "the origin; it seems to move with the sensor, and is left out"
                )
    blank = _cached_blank if is_concrete(source, target, left_out) else _blank
    return [blank(cloud, left_out) for cloud in (source, target)]


def _blank(cloud: PointCloud, left_out: Bool[AnyArray, "C"]) -> PointCloud:
    return cloud.replace_rows(channels=numpy_for(cloud.channels, left_out).where(left_out, 0, cloud.channels))


# The same copy each time, with all that is cached of it.
_cached_blank = cached_with_cloud(_blank)


def _explained(source: PointCloud, target: PointCloud) -> Explained:
    """The larger shares of both clouds; cached with concrete clouds, and constants to autodiff."""
    if is_concrete(source, target):
        found = [_of_one(cloud) for cloud in (source, target)]
    else:
        # In one call for both: concurrent batched LAPACK calls can deadlock.
        found = _of_each(constant([source, target]))
    by_angles, smooth, varies = (numpy_for(each).stack(each) for each in zip(*found, strict=True))
    return Explained(by_angles.max(axis=0), smooth.max(axis=0), varies.any(axis=0))


@cached_with_cloud
def _of_one(cloud: PointCloud) -> Explained:
    return _of_each([cloud])[0]


def _of_each(clouds: Sequence[PointCloud]) -> list[Explained]:
    # Huge values overflow; shares that are not finite explain nothing.
    with np.errstate(all="ignore"):
        samples = [_sample(cloud) for cloud in clouds]
        smooth = _smooth(samples)
        return [
            Explained(_by_angles(sample), share, sample.varies) for sample, share in zip(samples, smooth, strict=True)
        ]


def _sample(cloud: PointCloud) -> _Sample:
    xp = numpy_for(cloud)
    rows, present = sampled_rows(xp.asarray(cloud.valid))
    # Every second row first: the halves that predict each other.
    some = np.arange(0, rows.size, 1 + rows.size // _ROWS)
    some = np.concatenate([some[::2], some[1::2]])
    rows, present = rows[some], present[some]
    dtype = np.float64 if xp is np else cloud.points.dtype
    points, channels = (xp.asarray(each)[rows].astype(dtype).T for each in (cloud.points, cloud.channels))
    present = present & xp.isfinite(points).all(axis=0)
    weights = present[None].astype(dtype)
    if cloud.channel_valid is not None:
        weights = weights * xp.asarray(cloud.channel_valid)[rows].T
    counts = xp.maximum(weights.sum(axis=1, keepdims=True), 1)
    channels = xp.where(weights > 0, channels, 0)
    channels = weights * (channels - channels.sum(axis=1, keepdims=True) / counts)
    deviations = xp.sqrt((channels**2).sum(axis=1, keepdims=True) / counts)
    varies = deviations > 0
    channels = channels / xp.where(varies, deviations, 1)
    return _Sample(xp.where(present, points, 0), present, channels, weights, varies[:, 0])


def _share(sample: _Sample, predicted: Float[AnyArray, "C n"]) -> Float[AnyArray, "C"]:
    """The fraction of the variance that a prediction explains."""
    total = (sample.channels**2).sum(axis=1)
    left = (sample.weights * (sample.channels - predicted) ** 2).sum(axis=1)
    return 1 - left / numpy_for(total).where(total > 0, total, 1)


def _by_angles(sample: _Sample) -> Float[AnyArray, "C"]:
    xp = numpy_for(sample)
    x, y, z = sample.points
    distance = xp.sqrt(x * x + y * y + z * z)
    half = (np.arange(x.size) >= _middle(x.size)).astype(int)
    count = sample.present.sum()
    num_bins = xp.clip(count // _PER_BIN, 1, _BINS)
    rows = xp.concatenate([sample.channels, xp.broadcast_to(sample.weights, sample.channels.shape)])
    shares = []
    for place in (distance, z / xp.where(distance > 0, distance, 1), xp.arctan2(y, x)):
        ranks = xp.argsort(xp.argsort(xp.where(sample.present, place, xp.inf)))
        bins = xp.minimum(ranks * num_bins // xp.maximum(count, 1), _BINS - 1)
        sums = _sums(rows, half * _BINS + bins, 2 * _BINS)
        totals, counts = xp.split(sums[:, (1 - half) * _BINS + bins], 2)
        # A bin counts the mean of all as one more point.
        shares.append(_share(sample, totals / (counts + 1)))
    # From afar, coordinates are angles.
    center = sample.points.sum(axis=1) / xp.maximum(count, 1)
    radius = xp.sqrt((sample.present * ((sample.points.T - center) ** 2).sum(axis=1)).sum() / xp.maximum(count, 1))
    near = xp.sqrt((center**2).sum()) <= _FARTHEST * radius
    return xp.where(near, xp.stack(shares).max(axis=0), 0)


def _sums(rows: Float[AnyArray, "R n"], keys: Int[AnyArray, "n"], size: int) -> Float[AnyArray, "R size"]:
    """The sum of each row over the columns of each key."""
    if numpy_for(rows, keys) is np:
        return np.stack([np.bincount(keys, row, size) for row in rows])
    return jnp.zeros((len(rows), size), rows.dtype).at[:, keys].add(rows)


def _smooth(samples: Sequence[_Sample]) -> list[Float[AnyArray, "C"]]:
    xp = numpy_for(samples)
    bases, matrices, sides = [], [], []
    for sample in samples:
        basis = _monomials(sample)
        middle = [_middle(basis.shape[1])]
        rows = zip(*(xp.split(each, middle, axis=1) for each in (basis, sample.weights, sample.channels)), strict=True)
        pairs = [(xp.stack([(w * part) @ part.T for w in weights]), values @ part.T) for part, weights, values in rows]
        bases.append(basis)
        matrices.append(xp.stack([matrix for matrix, _ in pairs], axis=1))
        sides.append(xp.stack([side for _, side in pairs], axis=1)[..., None])
    matrix, side = xp.stack(matrices), xp.stack(sides)
    scale = xp.trace(matrix, axis1=-2, axis2=-1)[..., None, None] / matrix.shape[-1]
    matrix = matrix + _RIDGE * xp.where(scale > 0, scale, 1) * np.eye(matrix.shape[-1], dtype=matrix.dtype)
    matrix = xp.broadcast_to(matrix, (*side.shape[:-1], side.shape[-2]))
    shares = []
    for sample, basis, solution in zip(samples, bases, xp.linalg.solve(matrix, side)[..., 0], strict=True):
        first, second = xp.split(basis, [_middle(basis.shape[1])], axis=1)
        predicted = xp.concatenate([solution[:, 1] @ first, solution[:, 0] @ second], axis=1)
        shares.append(_share(sample, xp.clip(predicted, -_LARGEST, _LARGEST)))
    return shares


def _middle(count: int) -> int:
    """Number of rows in the first half of a sample."""
    return (count + 1) // 2


def _monomials(sample: _Sample) -> Float[AnyArray, "m n"]:
    """Products of up to `_DEGREE` coordinates about the centroid that level off far from it; root mean squares of 1."""
    xp = numpy_for(sample)
    count = xp.maximum(sample.present.sum(), 1)
    offset = sample.points - sample.points.sum(axis=1, keepdims=True) / count
    square = (offset * offset).sum(axis=0)
    level = _LEVEL * median(xp.where(sample.present, xp.sqrt(square), xp.nan))
    level = xp.where(level > 0, level, 1)
    bounded = sample.present * offset / xp.sqrt(level**2 + square)
    found = {(): xp.ones_like(square)}
    for degree in range(1, _DEGREE + 1):
        for axes in combinations_with_replacement(range(3), degree):
            found[axes] = found[axes[1:]] * bounded[axes[0]]
    rows = xp.stack(list(found.values()))
    size = xp.sqrt((rows * rows).mean(axis=1, keepdims=True))
    return rows / xp.where(size > 0, size, 1)
