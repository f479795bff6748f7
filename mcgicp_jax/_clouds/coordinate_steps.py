"""The step to which coordinates are rounded, whatever wrote them: voxel centres, integers, few digits, float32.

Points on a lattice as coarse as their spacing match the lattice of another cloud rather than its surfaces. A step shows
in the gaps between the sorted coordinates along an axis, which are multiples of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import AnyScalar, numpy_for
from mcgicp_jax._math.statistics import sampled_rows

# Steps below this fraction of the spacing do no harm: in rooms of 5,000 points, errors are those without steps up to
# 0.35, three times as large at 0.5, and with deviations that are seven times too small.
_HARMFUL = 1 / 3
# Coordinates closer than this many roundings of the largest one are equal.
_ROUNDINGS = 8
# The step is this quantile (one in so many) of the gaps. Of the gaps below `_MULTIPLES` steps, the fraction `_FIT` must
# be within `_TOLERANCE` steps of a multiple; of arbitrary gaps, a fifth is, so that ten on three axes, of which three
# are the steps themselves, fit by chance in one of 0.2⁻⁷ = 80,000 clouds.
_QUANTILE, _MULTIPLES, _FIT, _TOLERANCE, _LEAST_GAPS = 10, 10, 0.95, 0.1, 10
# Ratio of the steps of two axes from which they are different.
_DIFFERENT = 1.5


def harmful_step(cloud: PointCloud, spacing: Float[AnyScalar, ""]) -> Float[AnyScalar, ""]:
    """The step of the coordinates of a cloud, the largest of the axes, metres; 0 if it is below a third of the spacing.

    Counted are coarse steps of all axes, different ones of two, as with six digits of UTM, and those of float32. One or
    two axes with another step are those of a regular sample of surfaces, such as a height map, whose points are exact.
    """
    xp = numpy_for(cloud.points, cloud.valid, spacing)
    rows, counts = sampled_rows(xp.asarray(cloud.valid))
    values = xp.where(counts, xp.asarray(cloud.points)[rows].T, xp.nan)
    largest = xp.max(xp.where(xp.isfinite(values), xp.abs(values), 0), axis=1, keepdims=True)
    # Coordinates that overflow, or are missing, leave no gap.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        gaps = xp.diff(xp.sort(values, axis=1), axis=1)
        apart = gaps > _ROUNDINGS * xp.finfo(gaps.dtype).eps * largest
        number: Any = xp.sum(apart, axis=1, keepdims=True)
        ordered = xp.sort(xp.where(apart, gaps, xp.inf), axis=1)
        step = xp.take_along_axis(ordered, number // _QUANTILE, axis=1)
        multiple = xp.where(apart, gaps, 0) / step
        fits = xp.abs(multiple - xp.round(multiple)) < _TOLERANCE
        near = apart & (multiple < _MULTIPLES)
        # Rounded coordinates repeat.
        coarse = (step > _HARMFUL * spacing) & xp.isfinite(step) & (number > 1) & (2 * number < xp.sum(counts))
        coarse = coarse & (xp.sum(near) >= _LEAST_GAPS)
        coarse = coarse & (xp.sum(near & fits, axis=1, keepdims=True) >= _FIT * xp.sum(near, axis=1, keepdims=True))
        # The step of float32 at these coordinates, by its 23 bits of fraction.
        place = xp.max(xp.where(counts, xp.abs(values + xp.asarray(cloud.origin)[:, None]), 0), axis=1, keepdims=True)
        float32 = coarse & (xp.abs(step * 2.0 ** (23 - xp.floor(xp.log2(place))) - 1) < _TOLERANCE)
    axes, widest = xp.sum(coarse), xp.max(xp.where(coarse, step, 0))
    narrowest = xp.min(xp.where(coarse, step, xp.inf))
    counted = (axes == 3) | ((axes == 2) & (widest > _DIFFERENT * narrowest)) | xp.any(float32)
    return xp.where(counted, widest, 0).astype(gaps.dtype)
