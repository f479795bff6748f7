"""The step to which coordinates are rounded, whatever wrote them: voxel centres, integers, few digits, float32.

Points on a lattice as coarse as their spacing match the lattice of another cloud rather than its surfaces. A step shows
in the gaps between the sorted coordinates along an axis, which are multiples of it. Depths from whole disparities have
a step in their inverses.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.cache import cached_with_cloud
from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, numpy_for
from mcgicp_jax._math.statistics import median, sampled_rows

# Steps below this fraction of the spacing do no harm: in rooms of 5,000 points, errors are those without steps up to
# 0.35, three times as large at 0.5, and with deviations that are seven times too small.
_HARMFUL = 1 / 3
# Coordinates closer than this many roundings of the largest one are equal.
_ROUNDINGS = 8
# The step is this quantile (one in so many) of the gaps. Of the gaps below `_MULTIPLES` steps, the fraction `_FIT` must
# be within `_TOLERANCE` steps of a multiple; of arbitrary gaps, a fifth is, so that ten on three axes, of which three
# are the steps themselves, fit by chance in one of 0.2⁻⁷ = 80,000 clouds.
_QUANTILE, _MULTIPLES, _FIT, _TOLERANCE, _LEAST_GAPS = 10, 10, 0.95, 0.1, 10
# Least share of points that show a rounding of one or two axes, see `_shows_rounding`: 0.09 to 0.8 where heights are
# rounded in terrains, rooms, streets and KITTI, 0.06 of exact contour lines, and 0 to 0.05 of sections, profiles and
# height maps. Coordinates are the same within a fraction of a step. The spread is the ratio of determinant to squared
# trace, 1/4 for a disc.
_SHARE, _SAME, _SPREAD = 0.08, 0.4, 0.05


def harmful_steps(cloud: PointCloud, spacing: Float[AnyScalar, ""]) -> Float[AnyArray, "3"]:
    """The step of the coordinates on each axis, metres; 0 below a third of the spacing. Steps of one or two axes count
    only if they are those of float32, or the cloud is no exact regular sample (height map, sections, profiles)."""
    step, float32 = _steps(cloud)
    xp = numpy_for(step, spacing)
    coarse = step > _HARMFUL * spacing
    if xp is np and not coarse.any():
        return np.zeros(3, step.dtype)
    counted = coarse.all() | (coarse & float32).any() | _shows_rounding(cloud, coarse, step)
    return xp.where(coarse & counted, step, 0)


@cached_with_cloud
def _steps(cloud: PointCloud) -> tuple[Float[AnyArray, "3"], Bool[AnyArray, "3"]]:
    """The step of the coordinates on each axis, metres (0: none), and whether it is the rounding of float32."""
    rows, counts = sampled_rows(cloud.valid)
    xp = numpy_for(cloud.points, counts)
    values = xp.where(counts, xp.asarray(cloud.points)[rows].T, xp.nan)
    # Coordinates that overflow, or are missing, leave no gap.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        step = _step_between(values)
        if xp is np and np.isnan(step).all():
            return np.zeros(3, values.dtype), np.zeros(3, bool)
        # The step of float32 at these coordinates, by its 23 bits of fraction.
        size = xp.max(xp.where(counts, xp.abs(values + xp.asarray(cloud.origin)[:, None]), 0), axis=1)
        float32 = xp.abs(step * 2.0 ** (23 - xp.floor(xp.log2(size))) - 1) < _TOLERANCE
        # A step s of 1/z is one of z² s at the depth z. Coordinates that are 0 up to rounding, as of a floor, are none.
        largest = xp.max(xp.where(xp.isfinite(values), xp.abs(values), 0), axis=1, keepdims=True)
        depths = xp.where(xp.abs(values) > _ROUNDINGS * xp.finfo(values.dtype).eps * largest, values, xp.nan)
        step = xp.where(step > 0, step, _step_between(1 / depths) * median(values**2))
    return xp.where(step > 0, step, 0).astype(values.dtype), float32


def _step_between(values: Float[AnyArray, "3 n"]) -> Float[AnyArray, "3"]:
    """The step of which the gaps between values are multiples; 0 where there is none, NaN where few values repeat."""
    xp = numpy_for(values)
    finite = xp.isfinite(values)
    largest = xp.max(xp.where(finite, xp.abs(values), 0), axis=1, keepdims=True)
    gaps = xp.diff(xp.sort(values, axis=1), axis=1)
    distinct = gaps > _ROUNDINGS * xp.finfo(gaps.dtype).eps * largest
    number: Any = xp.sum(distinct, axis=1, keepdims=True)
    # Rounded coordinates repeat.
    repeat = (number > 1) & (2 * number < xp.sum(finite, axis=1, keepdims=True))
    if xp is np and not repeat.any():
        return np.full(3, np.nan, gaps.dtype)
    ordered = xp.sort(xp.where(distinct, gaps, xp.inf), axis=1)
    step = xp.take_along_axis(ordered, number // _QUANTILE, axis=1)
    multiple = xp.where(distinct, gaps, 0) / step
    fits = xp.abs(multiple - xp.round(multiple)) < _TOLERANCE
    near = distinct & (multiple < _MULTIPLES)
    rounded = repeat & xp.isfinite(step) & (xp.sum(near) >= _LEAST_GAPS)
    rounded = rounded & (xp.sum(near & fits, axis=1, keepdims=True) >= _FIT * xp.sum(near, axis=1, keepdims=True))
    return xp.where(rounded, step, xp.where(repeat, 0, xp.nan))[:, 0]


def _shows_rounding(cloud: PointCloud, coarse: Bool[AnyArray, "3"], steps: Float[AnyArray, "3"]) -> Any:
    """Whether more points share their coordinates on the coarse axes than in an exact sample of surfaces: a point for
    two axes, a line for one. Copies of a planar scan at several heights are exact. False without neighbours."""
    if cloud.deferred_neighbors is None:
        return False
    rows, counts = sampled_rows(cloud.valid)
    xp = numpy_for(cloud.points, counts, coarse, steps)
    points = xp.asarray(cloud.points)
    # Traced rows need the neighbours of all points.
    neighbors = cloud.deferred_neighbors[rows] if xp is np else xp.asarray(cloud.neighbors)[rows]
    exists = (neighbors >= 0) & counts[:, None]
    offsets = points[neighbors] - points[rows][:, None]
    same = exists & ((xp.abs(offsets) < _SAME * steps) | ~coarse).all(axis=2)
    copied = (exists & ((offsets == 0) | coarse).all(axis=2) & (offsets != 0).any(axis=2)).any(axis=1)
    # Copies that differ on one axis may lie farther apart: sorted by the other two axes first, they follow one another.
    fine = xp.where(coarse, 0, points)
    order = xp.lexsort((xp.where(coarse, points, 0).sum(axis=1), *fine.T))
    copies = (xp.diff(fine[order], axis=0) == 0).all(axis=1) & (xp.diff(points[order], axis=0) != 0).any(axis=1)
    far = (xp.append(copies, False) | xp.append(False, copies))[xp.argsort(order)][rows]
    copied = copied | (far & (xp.sum(coarse) == 1))
    x, y, z = xp.where(same[..., None] & ~coarse, offsets, 0).transpose(2, 0, 1)
    mostly = 2 * xp.sum(same, axis=1) > xp.sum(exists, axis=1)
    # Squares of coordinates up to 1e30 overflow; such clouds are no measurements.
    with np.errstate(over="ignore", invalid="ignore"):
        xx, yy, zz, xy, yz, zx = (xp.sum(a * b, axis=1) for a, b in ((x, x), (y, y), (z, z), (x, y), (y, z), (z, x)))
        minors = xx * yy - xy**2 + yy * zz - yz**2 + zz * xx - zx**2
        rounded = xp.where(xp.sum(coarse) > 1, xx + yy + zz > 0, mostly & (minors > _SPREAD * (xx + yy + zz) ** 2))
    return xp.sum(rounded & ~copied) > _SHARE * xp.sum(counts)
