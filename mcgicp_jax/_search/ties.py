"""The k nearest points by any kind of tree, on several threads: ordered by distance, and ties by row."""

from __future__ import annotations

import abc
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mcgicp_jax._compute.threads import num_cores, side_by_side
from mcgicp_jax._math.statistics import equal_rows

# Largest number of candidates per query with which the tree breaks a tie by row: a multiple of the neighbours wanted,
# but at least the second number. Longer ties are left to brute force.
_TIE_CANDIDATES = 8
_MIN_TIE_CANDIDATES = 64
# Number of equal points that a tree holds, or one more than the neighbours wanted if that is larger: further ones are
# never among the nearest, and n of them in one leaf would cost n². 40,000 points of which half are equal take 1.7 times
# as long as different ones; with 64, 1.9 times.
_MOST_EQUAL = 32
# Smallest number of queries that a thread is given at a time, and largest number of such parts per thread: several,
# since a thread may start late. With 2,000 to 100,000 queries, a factor of two in either hardly matters.
_MIN_PART, _PARTS_PER_THREAD = 1000, 8


class TreeBackend(abc.ABC):
    """A kind of tree: how it is built and queried."""

    # Largest number of threads that query it; −1 for all cores.
    workers: int

    @abc.abstractmethod
    def build(self, points: Float[np.ndarray, "M D"]) -> Any:
        """A tree of (M, D) finite points, metres; M is at least 1, D at least 3."""

    @abc.abstractmethod
    def query(
        self, tree: Any, queries: Float[np.ndarray, "N D"], k: int, bound: float
    ) -> tuple[Float[np.ndarray, "N k"], Int[np.ndarray, "N k"]]:
        """The k nearest points of each query. Several threads may call this function at once.

        Args:
            tree: from `build`, of M points.
            queries: (N, D) finite points, metres.
            k: number of neighbours, at most M.
            bound: metres in all D dimensions; only neighbours nearer than this are reported.

        Returns:
            (N, k) distances in metres and rows, nearest first, ties in any order. Where fewer than k points lie within
            the bound, the distance is infinite and the row is M.
        """

    def leaf_order(self, tree: Any, num_points: int) -> Int[np.ndarray, "M"]:
        """An order of the tree's points in which neighbouring points follow each other, for faster queries."""
        return np.arange(num_points)


class TiedTree:
    """A tree of finite points, metres, with the same answers whatever its kind: ordered by distance, ties by row."""

    def __init__(self, trees: TreeBackend, points: Float[np.ndarray, "M D"], most_equal: int = _MOST_EQUAL):
        self.points = points
        self._trees, self._most_equal = trees, most_equal
        # equinox creates an object whenever it binds a method.
        self._query = trees.query
        self._threads = num_cores() if trees.workers == -1 else trees.workers
        positions = equal_rows(points, most_equal)
        # The rows of a smaller tree, and M for none; None: the tree has all rows.
        self._rows = None
        if positions is not None:
            rows = np.argsort(positions, kind="stable")
            ordered = positions[rows]
            rows = np.sort(rows[np.arange(len(rows)) - np.searchsorted(ordered, ordered) < most_equal])
            self._rows, points = np.append(rows, len(points)), points[rows]
        self._tree_points, self._tree = points, trees.build(points)

    def leaf_order(self) -> Int[np.ndarray, "M"]:
        size = len(self.points)
        return np.arange(size) if self._rows is not None else self._trees.leaf_order(self._tree, size)

    def query(
        self, queries: Float[np.ndarray, "N D"], k: int, bound: float = np.inf
    ) -> tuple[Float[np.ndarray, "N k"], Int[np.ndarray, "N k"]]:
        """Distances and rows of the tree as from `TreeBackend.query`, on several threads."""
        count = 1 if self._threads == 1 else min(_PARTS_PER_THREAD * self._threads, len(queries) // _MIN_PART)
        if count <= 1:
            return self._query(self._tree, queries, k, bound)
        parts = np.array_split(queries, count)
        calls = [partial(self._query, self._tree, part, k, bound) for part in parts]
        distances, rows = zip(*side_by_side(calls, self._threads), strict=True)
        return np.concatenate(distances), np.concatenate(rows)

    def nearest(
        self, queries: Float[np.ndarray, "N D"], k: int, bound: float = np.inf
    ) -> tuple[Int[np.ndarray, "N k"], Float[np.ndarray, "N"]]:
        """Rows of the k nearest points of each query (all points if there are fewer), ordered by distance and then row;
        M for none within `bound`. And the slack: half the gap between the k-th nearest and the next, which is taken to
        lie at the bound if none is within it; 0 without a k-th nearest.

        Trees return ties in any order. Searching for k + 1 neighbours reveals ties, which are then resolved.
        """
        if self._rows is not None and k >= self._most_equal:
            return TiedTree(self._trees, self.points, k + 1).nearest(queries, k, bound)
        size = len(self._tree_points)
        k = min(k, size)
        num_candidates = min(k + 1, size)
        max_candidates = min(max(_TIE_CANDIDATES * (k + 1), _MIN_TIE_CANDIDATES), size)
        distances, rows = self.query(queries, num_candidates, bound)
        nearest = rows[:, :k].astype(np.int32)
        farthest = distances[:, k - 1]
        slack = slack_of(farthest, np.minimum(distances[:, num_candidates - 1], bound))
        equal = distances[:, 1:] == distances[:, :-1]
        # Usually none are equal, and one check of all takes a tenth of the time of one per query.
        tied = np.flatnonzero(equal.any(axis=1) & np.isfinite(distances[:, 0])) if equal.any() else np.arange(0)
        distances, rows = distances[tied], rows[tied]
        while tied.size:
            order = np.lexsort((rows, distances), axis=1)
            nearest[tied] = np.take_along_axis(rows, order, axis=1)[:, :k]
            # A tie that includes the last candidate may extend beyond it.
            tied = tied[np.isfinite(distances[:, -1]) & (distances[:, k - 1] == distances[:, -1])]
            if num_candidates == max_candidates:
                break
            num_candidates = min(2 * num_candidates, max_candidates)
            if tied.size:
                distances, rows = self.query(queries[tied], num_candidates, bound)
        if tied.size and num_candidates < size:
            # Brute force, for queries with long ties. Such queries mostly coincide, too.
            distinct, first, number = np.unique(queries[tied], axis=0, return_index=True, return_inverse=True)
            in_all = np.empty((len(distinct), k), np.int32)
            for i, (query, limit) in enumerate(zip(distinct, farthest[tied][first], strict=True)):
                squares = np.zeros(size)
                # In float64, as trees compute.
                for column, value in zip(self._tree_points.T.astype(np.float64), query, strict=True):
                    squares += (column - value) ** 2
                # A part in a billion covers rounding.
                near = np.flatnonzero(squares <= limit**2 * (1 + 1e-9))
                in_all[i] = near[np.lexsort((near, squares[near]))[:k]]
            nearest[tied] = in_all[number.ravel()]
        return nearest if self._rows is None else self._rows[nearest].astype(np.int32), slack


def slack_of(farthest: Float[np.ndarray, "N"], following: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    """Metres that a query may move before its k nearest rows can change: half the gap to the following distance."""
    # The margin of 1e-6 covers rounding. Without a k-th nearest row the gap is NaN or −inf, and the slack 0.
    with np.errstate(invalid="ignore"):
        return 0.5 * (1 - 1e-6) * np.fmax(following - farthest, 0)
