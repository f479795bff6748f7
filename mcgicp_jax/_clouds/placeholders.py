"""Rows of raw clouds that are no measurements: what sensors report for rays without return.

Many write (0, 0, 0), others one far place, such as 999 m in each coordinate. Matched to each other, these rows hold the
pose at the identity. They are told from measurements by being exactly equal.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from mcgicp_jax._math.statistics import equal_rows
from mcgicp_jax._search.kd_tree import KDTreeSearch

# A position is a placeholder if more rows than `_MANY` share it, and more than so many times as many as share any of
# the `_NEAR` nearest positions: where coordinates are rounded to steps, or clouds are concatenated, these numbers are
# alike. (At most 4 times as many in rooms, streets and KITTI on grids of 0.01 to 0.5 m; the zeros of a LiDAR that
# reports them: 20 times on grids up to 0.3 m, and 2,500 times as they are.)
_MANY, _NEAR = 5, 8


def measured_rows(points: Float[np.ndarray, "N 3"], finite: Bool[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
    """Which of the finite points are measurements; of those at (0, 0, 0), where a sensor may be, the first counts."""
    rows = np.flatnonzero(finite)
    points = points if rows.size == len(points) else points[rows]
    zero = np.flatnonzero((points == 0).all(axis=1))[1:]
    positions = equal_rows(points, _MANY)
    if (positions is None and not zero.size) or (points[:1] == points).all():
        # A cloud at one place is what it is.
        return finite
    left_out = np.zeros(len(points), bool)
    if positions is not None:
        _, first, counts = np.unique(positions, return_index=True, return_counts=True)
        many = np.flatnonzero(counts > _MANY)
        search, places = KDTreeSearch(workers=1), points[first].astype(np.float64)
        _, near = search.query(search.build(places), places[many], min(1 + _NEAR, len(places)), np.inf)
        # The first is the position itself.
        around = counts[near[:, 1:]].max(axis=1)
        left_out = np.isin(positions, many[counts[many] > _MANY * around])
        left_out &= (points != 0).any(axis=1)
    left_out[zero] = True
    measured = finite.copy()
    measured[rows[left_out]] = False
    return measured
