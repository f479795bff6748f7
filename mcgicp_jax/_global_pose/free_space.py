"""Points in the space that another scan saw through."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from mcgicp_jax._math.statistics import spread_rows

# Sizes of the samples of the scan that sees, and of the one that is seen.
_RAYS, _POINTS = 20_000, 4000
# A point is in free space if each of the `_AROUND` nearest rays ends beyond (1 + `_FARTHER`) times its range, and a
# voxel. With eight rays, most of which are of one scan line, points at edges count at the right pose, and objects at
# turned ones do not.
_AROUND, _FARTHER = 24, 0.1
# A direction is seen if its `_AROUND` rays are not farther away than this quantile of the same distance in the scan.
_SEEN = 0.9


class View:
    """What a scan saw from its origin.

    Args:
        points: (N, 3) metres.
        origin: (3,) position of the sensor, metres. If the sensor was not there, as in maps, right poses have points in
            free space, too.
    """

    def __init__(self, points: Float[np.ndarray, "N 3"], origin: Float[np.ndarray, "3"]):
        self.points, self._origin = points, origin

    @cached_property
    def _rays(self) -> tuple[KDTree, Float[np.ndarray, "n"], float]:
        """Directions and lengths of rays, and the largest distance to the rays of a direction that is seen."""
        directions, ranges = self._polar(_sample(self.points, _RAYS))
        tree = KDTree(directions)
        around = tree.query(_sample(directions, _POINTS), k=[min(_AROUND, len(ranges))])[0]
        return tree, ranges, float(np.quantile(around, _SEEN))

    def _polar(self, points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
        offsets = points - self._origin
        ranges = np.linalg.norm(offsets, axis=1)
        return offsets / np.maximum(ranges, np.finfo(np.float32).tiny)[:, None], ranges

    def sees_through(self, other: View, matrix: Float[np.ndarray, "4 4"], margin: float) -> Int[np.ndarray, "2"]:
        """Numbers of a sample of the other scan's points that are in free space, and in directions that this one sees.

        `matrix` is the pose of the other scan in this one's frame; `margin`, metres, is the least distance behind.
        """
        tree, lengths, seen = self._rays
        directions, ranges = self._polar(_sample(other.points, _POINTS) @ matrix[:3, :3].T + matrix[:3, 3])
        distances, rays = tree.query(directions, k=np.arange(1, 1 + min(_AROUND, len(lengths))))
        inside = distances[:, -1] <= seen
        free = lengths[rays].min(axis=1) > (1 + _FARTHER) * ranges + margin
        return np.array([np.sum(free & inside), np.sum(inside)])


def _sample(points: Float[np.ndarray, "N 3"], count: int) -> Float[np.ndarray, "n 3"]:
    return points[spread_rows(np.ones(len(points), bool), count)] if len(points) > count else points
