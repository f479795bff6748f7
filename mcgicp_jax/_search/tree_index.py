"""The index of a target by trees: descriptors, missing channels, and matches reused from pose to pose."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Int

from mcgicp_jax._compute.cache import Cache
from mcgicp_jax._math.poses import rotated, rotation_from_quaternion
from mcgicp_jax._search.base import AbstractIndex, Matcher, SearchPoints
from mcgicp_jax._search.ties import TiedTree, TreeBackend, slack_of

# Number of sets of missing channels of queries whose trees, of all target rows each, are kept: two cameras, each of
# which sees a point or not, make four. Trees of further sets are built anew for each pose.
_MAX_SETS = 16
# Points. A larger tree does not fit into a processor's caches; queries are then sorted so that neighbours follow each
# other: 20 neighbours of 60,000 points then take 0.6 of the time, of a million points a quarter.
LARGEST_UNORDERED = 50_000


class TreeIndex(AbstractIndex):
    """An index over the finite rows: one tree, or where rows lack channels, one per set of channels in common."""

    def __init__(self, trees: TreeBackend, target: SearchPoints):
        target = jax.tree.map(np.asarray, target)
        points = np.hstack([target.points, target.descriptors])
        # Trees reject non-finite points; the sums at the pose lead to the status NON_FINITE.
        self._rows = np.flatnonzero(target.valid & np.isfinite(points).all(axis=1)).astype(np.int32)
        self._points = points[self._rows]
        penalty = np.zeros_like(target.descriptors) if target.penalty is None else target.penalty
        self._patterns, self._which = _patterns(penalty[self._rows])
        self.trees = trees
        # Lists of trees by the penalties of the queries. Threads that need the same ones at once may each build them.
        self._parts = Cache(_MAX_SETS)

    @property
    def num_rows(self) -> int:
        """Total number of rows in all trees, as a measure of memory."""
        return self._rows.size * min(len(self._patterns), _MAX_SETS)

    def nearest(
        self, pose: Float[ArrayLike, "7"], source: SearchPoints, max_distance: float, num_candidates: int = 1
    ) -> Int[np.ndarray, "m N"]:
        source = jax.tree.map(np.asarray, source)
        queries = np.hstack([_moved(pose, np.asarray(source.points, np.float64)), source.descriptors])
        queries[~source.valid] = np.nan
        return self.nearest_of(queries, source.penalty, max_distance, num_candidates)[0].T

    def follow(self, source: SearchPoints, max_distance: float, num_candidates: int = 1) -> Matcher:
        return _MatchTracker(self, jax.tree.map(np.asarray, source), max_distance, num_candidates).nearest

    def nearest_of(
        self, queries: Float[np.ndarray, "N D"], penalty: Float[np.ndarray, "N C"] | None, max_distance: float, k: int
    ) -> tuple[Int[np.ndarray, "N k"], Float[np.ndarray, "N"]]:
        """The k nearest target rows of each query (position and descriptors, metres), −1 for none; and the slack: the
        distance, metres, that a query may move before these rows can change, but for their order. Queries that are not
        finite have no neighbours."""
        indices, slack = np.full((len(queries), k), -1, np.int32), np.zeros(len(queries))
        if not self._rows.size:
            return indices, slack
        finite = np.isfinite(queries)
        # Usually all are finite: then `all()` is quicker than a test by row, and a slice copies nothing.
        active: slice | Int[np.ndarray, "n"] = slice(None) if finite.all() else np.flatnonzero(finite.all(axis=1))
        # The maximum correspondence distance refers to the position and is applied by the caller; the margin covers
        # rounding. With descriptors it does not bound the search distance, so the whole space is searched.
        bound = np.inf if queries.shape[1] > 3 else 1.001 * max_distance
        rows = np.arange(len(queries))[active]
        if penalty is None:
            patterns, which = np.zeros((1, queries.shape[1] - 3)), np.zeros(rows.size, np.intp)
        else:
            patterns, which = _patterns(penalty[active])
        groups = [active] if len(patterns) == 1 else [rows[which == i] for i in range(len(patterns))]
        for group, pattern in zip(groups, patterns, strict=True):
            trees, of_group = self._parts.get(pattern.tobytes(), partial(self._built, pattern)), queries[group]
            if len(trees) == 1:
                nearest, slack[group] = trees[0].nearest(of_group, k, bound)
            else:
                # One more of each tree: the slack depends on the next nearest row.
                parts = zip(*(tree.nearest_and_squares(of_group, k + 1, bound) for tree in trees), strict=True)
                candidates, squares = map(np.hstack, parts)
                order = np.lexsort((candidates, squares), axis=1)[:, : k + 1]
                nearest, squares = (np.take_along_axis(table, order, axis=1) for table in (candidates, squares))
                nearest = nearest[:, :k]
                slack[group] = slack_of(*np.sqrt(squares[:, [min(k, squares.shape[1]) - 1, -1]]).T)
            indices[group, : nearest.shape[1]] = nearest
        return indices, slack

    def _built(self, penalty: Float[np.ndarray, "C"]) -> list[_TreeForChannels]:
        """The trees for queries of one penalty: one for each set of channels in common."""
        common, numbers = _patterns(np.maximum(self._patterns, penalty))
        which = numbers[self._which]
        groups = [slice(None) if len(common) == 1 else which == i for i in range(len(common))]
        return [
            _TreeForChannels(self.trees, self._points[group], self._rows[group], pattern)
            for group, pattern in zip(groups, common, strict=True)
        ]


class _TreeForChannels:
    """A tree of the target rows that have one set of channels in common with the queries."""

    def __init__(
        self,
        trees: TreeBackend,
        points: Float[np.ndarray, "M D"],
        rows: Int[np.ndarray, "M"],
        penalty: Float[np.ndarray, "C"],
    ):
        common = np.concatenate([np.ones(3, bool), penalty == 0])
        # Maps tree indices to cloud rows; the last entry is −1 (no neighbour).
        self._rows = np.append(rows, np.int32(-1))
        self._columns = slice(None) if common.all() else np.flatnonzero(common)
        self._penalty = penalty.sum()
        self._tree = TiedTree(trees, points[:, self._columns])

    def nearest(
        self, queries: Float[np.ndarray, "N D"], k: int, bound: float
    ) -> tuple[Int[np.ndarray, "N m"], Float[np.ndarray, "N"]]:
        """Cloud rows of the k nearest (fewer if the tree has fewer), −1 for none; and the slack."""
        numbers, slack = self._tree.nearest(queries[:, self._columns], k, bound)
        return self._rows[numbers], slack

    def nearest_and_squares(
        self, queries: Float[np.ndarray, "N D"], k: int, bound: float
    ) -> tuple[Int[np.ndarray, "N m"], Float[np.ndarray, "N m"]]:
        """Cloud rows, and the squared search distances with the penalties for missing channels, metres²."""
        rows, points = self._tree.nearest(queries[:, self._columns], k, bound)[0], self._tree.points
        difference = queries[:, None, self._columns] - points[np.minimum(rows, len(points) - 1)]
        squares = np.sum(difference * difference, axis=2) + self._penalty
        return self._rows[rows], np.where(rows < len(points), squares, np.inf)


class _MatchTracker:
    """The k nearest target rows of one source, pose after pose. They are provably the same while a point has moved by
    less than its slack since its last search; after the first poses this holds for most points."""

    def __init__(self, index: TreeIndex, source: SearchPoints, max_distance: float, k: int):
        self._index, self._max_distance = index, max_distance
        # Valid source rows, for large clouds sorted by neighbourhood. All arrays below are in this order.
        order: Int[np.ndarray, "n"] = np.flatnonzero(source.valid)
        if order.size > LARGEST_UNORDERED:
            points = np.nan_to_num(source.points[order], posinf=0, neginf=0)
            order = order[TiedTree(index.trees, points).leaf_order()]
        self._order = order
        self._points = np.asarray(source.points[order], np.float64)
        # Positions at the current pose, and descriptors.
        self._queries = np.concatenate([self._points, source.descriptors[order]], axis=1)
        self._penalty = None if source.penalty is None else source.penalty[order]
        # Position of each point at its last search, and the distance that it may move from there.
        self._searched: Float[np.ndarray, "n 3"] = np.full((order.size, 3), np.nan)
        self._slack: Float[np.ndarray, "n"] = np.zeros(order.size)
        self._rows: Int[np.ndarray, "k N"] = np.full((k, source.valid.size), -1, np.int32)

    def nearest(self, pose: Float[ArrayLike, "7"]) -> Int[np.ndarray, "k N"]:
        moved = _moved(pose, self._points)
        shift = moved - self._searched
        # Comparisons with NaN, which marks points not yet searched for, are false.
        unchanged = np.einsum("ij,ij->i", shift, shift) < self._slack**2
        stale = np.flatnonzero(~unchanged)
        self._queries[:, :3] = moved
        penalty = None if self._penalty is None else self._penalty[stale]
        # `take` takes a quarter of the time of an index array.
        rows, self._slack[stale] = self._index.nearest_of(
            self._queries.take(stale, axis=0), penalty, self._max_distance, len(self._rows)
        )
        self._searched = np.where(unchanged[:, None], self._searched, moved)
        # Arrays returned earlier must not change.
        self._rows = self._rows.copy()
        self._rows[:, self._order[stale]] = rows.T
        return self._rows


def _patterns(penalty: Float[np.ndarray, "N C"]) -> tuple[Float[np.ndarray, "P C"], Int[np.ndarray, "N"]]:
    """The distinct rows of penalties (sets of missing channels), and the number of its set for each row."""
    which = np.zeros(len(penalty), np.intp)
    # Sets are renumbered after each channel, so that numbers stay below twice the number of rows. `np.unique` would
    # sort the rows, which takes most of the time of a search.
    for column in (penalty > 0).T:
        which = 2 * which + column
        which = (np.cumsum(np.bincount(which) > 0) - 1)[which]
    example = np.zeros(which.max(initial=-1) + 1, np.intp)
    example[which] = np.arange(len(penalty))
    return penalty[example], which


def _moved(pose: Float[ArrayLike, "7"], points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    pose = np.asarray(pose, np.float64)
    # A non-finite pose gives NaN; the status of the registration reports it.
    with np.errstate(invalid="ignore"):
        return rotated(points, rotation_from_quaternion(pose[:4])) + pose[4:]
