"""Placeholders: rows of raw clouds that sensors report for rays without return.

Many sensors write (0, 0, 0), others one far place, such as 999 m in each coordinate, or the largest range on each ray.
Matched to each other, these rows fix the pose at the identity; a single one at 999 m fixes the rotation of a room of
5,000 points. Placeholders are exactly equal, or so far from all other points that they are no surface.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._clouds.point_cloud import LARGEST, PointCloud
from mcgicp_jax._math.statistics import equal_rows, upper_median
from mcgicp_jax._search.kd_tree import KDTreeSearch

# A position is a placeholder if more than `_MANY` rows share it, and more than `_MANY` times as many as share any of
# the `_NEAR` nearest positions: where coordinates are rounded to steps, or clouds are concatenated, these numbers are
# alike. (At most 4 times as many in rooms, streets and KITTI on grids of 0.01 to 0.5 m; the zeros of a LiDAR that
# reports them: 20 times on grids up to 0.3 m, 2,500 times without a grid.)
_MANY, _NEAR = 5, 8
# A point is no surface if its distance from the middle exceeds `_FAR` times the median distance, and if its `_SURFACE`
# nearest others, as many as a covariance is computed from, extend over more than half of the way to the middle.
# (Facades of 25 points 30 to 300 m from a room extend over a third of it at most. KITTI and streets extend over 7 to 15
# medians. Up to 20 nearer points at fixed places in both clouds of a room of 5,000 points move the pose by 0.1 mm.)
_FAR, _SURFACE = 20, 20
# Points from which the middle and the median are computed.
_SAMPLE = 10_000


def measured_rows(cloud: PointCloud, complete: Bool[np.ndarray, "N"] | None = None) -> Bool[np.ndarray, "N"]:
    """Which valid and finite points of a concrete cloud are measurements. Of points at (0, 0, 0), where a sensor may
    be, only the first is one. `complete`: rows to consider, all finite; None: the valid ones."""
    points, finite = np.asarray(cloud.points), np.asarray(cloud.valid) if complete is None else complete
    # One check of all values is much faster than one per row.
    if complete is None and not (np.abs(points) <= LARGEST).all():
        finite = np.logical_and.reduce([finite, *(np.abs(column) <= LARGEST for column in points.T)])
    rows = np.flatnonzero(finite)
    points = points if rows.size == len(points) else points.take(rows, axis=0)
    # Along columns NumPy reduces several times as fast.
    columns = np.ascontiguousarray(points.T, np.float64)
    zeros = np.flatnonzero(~columns.any(axis=0))
    left_out = np.zeros(len(points), bool)
    left_out[zeros[1:]] = True
    # Further zeros, which are frequent, take no part in the numbering of positions, which is slow.
    others = np.flatnonzero(~left_out)
    positions = equal_rows((columns.take(others, axis=1) if zeros.size > 1 else columns).T, _MANY)
    if (positions is None and zeros.size <= 1) or (columns[:, :1] == columns).all():
        # Points that are all at one place stay.
        return _without_far(columns, rows, finite)
    if positions is not None:
        counts = np.bincount(positions)
        zero = positions[np.searchsorted(others, zeros[:1])]
        counts[zero] = zeros.size
        many = np.flatnonzero(counts > _MANY)
        # At any other position; no tree is needed if these are few.
        around = np.delete(counts, counts.argmax()).max()
        if many.size > 1 or counts.max() <= _MANY * around:
            places = np.empty((len(counts), 3))
            places[positions] = columns.take(others, axis=1).T
            search = KDTreeSearch(workers=1)
            _, near = search.query(search.build(places), places[many], min(1 + _NEAR, len(places)), np.inf)
            # The nearest is the position itself.
            around = counts[near[:, 1:]].max(axis=1)
        repeated = np.zeros(len(counts), bool)
        repeated[many] = counts[many] > _MANY * around
        repeated[zero] = False
        left_out[others] = repeated[positions]
    measured = finite.copy()
    measured[rows[left_out]] = False
    return _without_far(columns.compress(~left_out, axis=1), rows[~left_out], measured)


def _without_far(
    columns: Float[np.ndarray, "3 n"], rows: Int[np.ndarray, "n"], measured: Bool[np.ndarray, "N"]
) -> Bool[np.ndarray, "N"]:
    """`measured` without the `rows` whose coordinates, in `columns`, are far from all others."""
    if rows.size <= 2 * _SURFACE:
        return measured
    stride = 1 + rows.size // _SAMPLE
    columns = columns - upper_median(columns[:, ::stride])[:, None]
    distance = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    limit = _FAR * upper_median(distance[::stride])
    far = np.flatnonzero(distance > limit)
    if not far.size or limit == 0:
        return measured
    # Others within half of the way are at least half as far.
    outer = columns[:, distance >= limit / 2].T
    search = KDTreeSearch(workers=1)
    distances, _ = search.query(search.build(outer), columns[:, far].T, min(1 + _SURFACE, len(outer)), np.inf)
    isolated = (distances[:, -1] > distance[far] / 2) | (len(outer) <= _SURFACE)
    measured = measured.copy()
    measured[rows[far[isolated]]] = False
    return measured
