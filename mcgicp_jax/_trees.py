"""Nearest neighbours by trees on the host.

`AbstractTreeSearch` owns what every tree needs: ties, padding, missing channels, threads, following a source from pose
to pose, the callback inside transformations and its cache. A tree is `build` and `query`; `KDTreeSearch` is SciPy's.
What a callback runs is NumPy alone.
"""

from __future__ import annotations

import abc
import collections
import hashlib
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._pose import rotation_from_quaternion
from mcgicp_jax._search import AbstractIndex, AbstractSearch, Rows, on_host
from mcgicp_jax._threads import num_cores, side_by_side

# Candidates that are looked at, at most, to break a tie by row number: a multiple of those asked for, and at least so
# many. Beyond, which of equal rows is taken is up to the tree.
_TIE_CANDIDATES = 8
_LEAST_TIE_CANDIDATES = 64
# Queries that are worth being given to another thread, and how many such parts there are, at most, for each thread:
# several, since a thread may come late. At 2,000 to 100,000 queries, a factor of two in either hardly matters.
_LEAST_PART, _PARTS_PER_THREAD = 1000, 8
# A tree of more points falls out of a processor's caches, and is searched faster by queries that lie side by side: a
# million points in half the time.
_LARGEST_UNORDERED = 50_000
# Bytes of an array that JAX copies on the spot for a callback: below 100 KiB in jaxlib 0.10.2.
_LARGEST_PIECE = 64 * 1024
# Rows of all trees that are kept for callbacks: hundreds of scans, some hundred megabytes.
_CACHED_ROWS = 2_000_000


class AbstractTreeSearch(AbstractSearch):
    """Exact search with a tree on the host. Equal distances are ordered by row, so that results repeat.

    Attributes:
        workers: threads of one registration, at most; −1 takes all cores.
    """

    workers: int = eqx.field(static=True, default=-1)

    @abc.abstractmethod
    def build(self, points: Float[np.ndarray, "M D"]) -> Any:
        """A tree of finite points, at least one; D is 3 or more."""

    @abc.abstractmethod
    def query(
        self, tree: Any, queries: Float[np.ndarray, "N D"], k: int, bound: float
    ) -> tuple[Float[np.ndarray, "N k"], Int[np.ndarray, "N k"]]:
        """Distances and rows of the k nearest points of finite queries, nearest first, equal ones in any order.

        Where fewer than k points lie within the bound, the distance is infinite and the row the number of points.
        Called by several threads at once.
        """

    def leaf_order(self, tree: Any, num_points: int) -> Int[np.ndarray, "M"]:
        """An order of the tree's points in which neighbours follow each other: queries in it are quicker."""
        return np.arange(num_points)

    @property
    def num_threads(self) -> int | None:
        return None if self.workers == -1 else self.workers

    def index(self, target: Rows) -> TreeIndex:
        return TreeIndex(self, on_host(target))

    def nearest_traced(
        self,
        pose: Float[Array, "7"],
        source: Rows,
        target: Rows,
        max_distance: Float[Array, ""],
        running: Bool[Array, ""],
        num_candidates: int = 1,
    ) -> Int[Array, "m N"]:
        arguments = jax.tree.map(_pieces, (pose, source, target, max_distance, running))
        return jax.pure_callback(
            partial(_nearest_callback, self, num_candidates),
            jax.ShapeDtypeStruct((num_candidates, source.valid.shape[0]), jnp.int32),
            *arguments,
            # One lane at a time: a batch of pieces would be large again.
            vmap_method="sequential",
        )

    def neighbors(self, points: Float[np.ndarray, "N 3"], num_neighbors: int) -> Int[np.ndarray, "N k"]:
        tree = self.build(points)
        # In the order of the leaves, each query finds in the processor's caches what the one before has read.
        order = self.leaf_order(tree, len(points))
        found, _ = _nearest(self, tree, len(points), points[order], num_neighbors)
        neighbors = np.full((len(points), num_neighbors), -1, np.int32)
        neighbors[order, : found.shape[1]] = found
        return neighbors


class KDTreeSearch(AbstractTreeSearch):
    """Exact search with SciPy's k-d tree on the host. Equal distances are ordered by row, so that results repeat.

    Attributes:
        workers: threads of one registration, at most; −1 takes all cores.
    """

    def build(self, points: Float[np.ndarray, "M D"]) -> scipy.spatial.cKDTree:
        # Unbalanced trees build faster and are searched as fast; compact nodes pay for themselves with 20 neighbours,
        # and with one from the second query on. Leaves of 32 are a few percent faster than SciPy's of 16.
        return scipy.spatial.cKDTree(points, leafsize=32, balanced_tree=False, compact_nodes=True)

    def query(
        self, tree: scipy.spatial.cKDTree, queries: Float[np.ndarray, "N D"], k: int, bound: float
    ) -> tuple[Float[np.ndarray, "N k"], Int[np.ndarray, "N k"]]:
        return tree.query(queries, k=np.arange(1, k + 1), distance_upper_bound=bound)

    def leaf_order(self, tree: scipy.spatial.cKDTree, num_points: int) -> Int[np.ndarray, "M"]:
        return np.asarray(tree.indices)


class TreeIndex(AbstractIndex):
    """A tree of the finite rows; where rows lack channels, one for each set of channels that matches have in common."""

    def __init__(self, search: AbstractTreeSearch, target: Rows):
        points = np.hstack([target.points, target.descriptors])
        # A tree refuses what is not finite; the sums at the pose will say NON_FINITE.
        self._rows = np.flatnonzero(target.valid & np.isfinite(points).all(axis=1)).astype(np.int32)
        self._points = points[self._rows]
        self._penalty = None if target.penalty is None else target.penalty[self._rows]
        self._search = search
        # Trees are built when first asked for. Threads that ask at the same time build the same.
        self._parts: dict[bytes, list[_Part]] = {}

    @property
    def num_rows(self) -> int:
        return self._rows.size

    def nearest(
        self, pose: Float[ArrayLike, "7"], source: Rows, max_distance: float, num_candidates: int = 1
    ) -> Int[np.ndarray, "m N"]:
        source = on_host(source)
        queries = np.hstack([_moved(pose, np.asarray(source.points, np.float64)), source.descriptors])
        queries[~source.valid] = np.nan
        return self.nearest_of(queries, source.penalty, max_distance, num_candidates)[0].T

    def follow(self, source: Rows, max_distance: float) -> Callable[[Float[ArrayLike, "7"]], Int[np.ndarray, "N"]]:
        return _Follower(self, self._search, on_host(source), max_distance).nearest

    def nearest_of(
        self,
        queries: Float[np.ndarray, "N D"],
        penalty: Float[np.ndarray, "N C"] | None,
        max_distance: float,
        k: int,
    ) -> tuple[Int[np.ndarray, "N k"], Float[np.ndarray, "N"]]:
        """Rows of the k nearest, −1 for none, and how far a query may move, metres, before the nearest is another one.

        Args:
            queries: positions and descriptors; nothing is near to a row that is not finite.
        """
        indices, slack = np.full((len(queries), k), -1, np.int32), np.zeros(len(queries))
        if not self._rows.size:
            return indices, slack
        finite = np.isfinite(queries)
        # Most often all are: asking for all at once is quicker than for each row, and a slice copies nothing.
        active: slice | Int[np.ndarray, "n"] = slice(None) if finite.all() else np.flatnonzero(finite.all(axis=1))
        # With descriptors, the nearest may lie beyond the gate while a match within it is further in all dimensions:
        # then the whole space is searched. The margin covers rounding; the gate itself is applied to the position.
        bound = np.inf if queries.shape[1] > 3 else 1.001 * max_distance
        if penalty is None:
            groups = [(np.zeros(queries.shape[1] - 3), active)]
        else:
            # Few, since a sensor sees a point or does not.
            patterns, which = np.unique(penalty[active], axis=0, return_inverse=True)
            rows = np.arange(len(queries))[active]
            groups = [(pattern, rows[which.ravel() == i]) for i, pattern in enumerate(patterns)]
        for pattern, alike in groups:
            found, slack[alike] = self._nearest(queries[alike], pattern, k, bound)
            indices[alike, : found.shape[1]] = found
        return indices, slack

    def _nearest(
        self, queries: Float[np.ndarray, "N D"], penalty: Float[np.ndarray, "C"], k: int, bound: float
    ) -> tuple[Int[np.ndarray, "N m"], Float[np.ndarray, "N"]]:
        """`nearest_of` for queries that lack the same channels."""
        parts = self._parts_for(penalty)
        answers = [part.nearest(queries, k, bound) for part in parts]
        found = [each for each, _ in answers]
        if len(parts) == 1:
            return parts[0].rows[found[0]], answers[0][1]
        rows = np.hstack([part.rows[each] for part, each in zip(parts, found, strict=True)])
        squares = np.hstack([part.squares(queries, each) for part, each in zip(parts, found, strict=True)])
        nearest = np.take_along_axis(rows, np.lexsort((rows, squares), axis=1)[:, :k], axis=1)
        return nearest, np.zeros(len(queries))

    def _parts_for(self, penalty: Float[np.ndarray, "C"]) -> list[_Part]:
        key = penalty.tobytes()
        if key not in self._parts:
            if self._penalty is None:
                self._parts[key] = [_Part(self._search, self._points, self._rows, penalty)]
            else:
                patterns, which = np.unique(np.maximum(self._penalty, penalty), axis=0, return_inverse=True)
                groups = [which.ravel() == i for i in range(len(patterns))]
                self._parts[key] = [
                    _Part(self._search, self._points[group], self._rows[group], pattern)
                    for group, pattern in zip(groups, patterns, strict=True)
                ]
        return self._parts[key]


class _Part:
    """A tree of target rows that all have the same channels in common with a query."""

    def __init__(
        self,
        search: AbstractTreeSearch,
        points: Float[np.ndarray, "M D"],
        rows: Int[np.ndarray, "M"],
        penalty: Float[np.ndarray, "C"],
    ):
        common = np.concatenate([np.ones(3, bool), penalty == 0])
        # Maps tree indices to cloud rows; the last entry is −1 (no neighbour).
        self.rows = np.append(rows, np.int32(-1))
        self._columns = slice(None) if common.all() else np.flatnonzero(common)
        self._points = points[:, self._columns]
        self._penalty = penalty.sum()
        self._search = search
        self._tree = search.build(self._points)

    def nearest(
        self, queries: Float[np.ndarray, "N D"], k: int, bound: float
    ) -> tuple[Int[np.ndarray, "N m"], Float[np.ndarray, "N"]]:
        """Tree indices, nearest first, no more than there are; the number of rows beyond the bound.

        And how far each query may move before its nearest is another one.
        """
        return _nearest(self._search, self._tree, len(self._points), queries[:, self._columns], k, bound)

    def squares(self, queries: Float[np.ndarray, "N D"], found: Int[np.ndarray, "N m"]) -> Float[np.ndarray, "N m"]:
        """Squared distances to rows of this part, with the penalties of the channels that are missing; metres²."""
        difference = queries[:, None, self._columns] - self._points[np.minimum(found, len(self._points) - 1)]
        apart = np.sum(difference * difference, axis=2) + self._penalty
        return np.where(found < len(self._points), apart, np.inf)


class _Follower:
    """Matches of one source, pose after pose.

    A match stands, exactly, as long as its point has moved by less than half the gap between its nearest and its second
    nearest target point, since it was looked for. After the first poses that holds for most.
    """

    def __init__(self, index: TreeIndex, search: AbstractTreeSearch, source: Rows, max_distance: float):
        self._index = index
        self._max_distance = max_distance
        # Valid source rows, close ones one after the other where that pays. All arrays below are in this order.
        order: Int[np.ndarray, "n"] = np.flatnonzero(source.valid)
        if order.size > _LARGEST_UNORDERED:
            points = np.nan_to_num(source.points[order], posinf=0, neginf=0)
            order = order[search.leaf_order(search.build(points), order.size)]
        self._order = order
        self._points = np.asarray(source.points[order], np.float64)
        self._descriptors = source.descriptors[order]
        self._penalty = None if source.penalty is None else source.penalty[order]
        # Where each point was when its match was looked for, and how far it may move from there.
        self._asked: Float[np.ndarray, "n 3"] = np.full((order.size, 3), np.nan)
        self._slack: Float[np.ndarray, "n"] = np.zeros(order.size)
        self._rows: Int[np.ndarray, "N"] = np.full(source.valid.size, -1, np.int32)

    def nearest(self, pose: Float[ArrayLike, "7"]) -> Int[np.ndarray, "N"]:
        moved = _moved(pose, self._points)
        shift = moved - self._asked
        # Written so that NaN is looked for.
        stale = np.flatnonzero(~(np.einsum("ij,ij->i", shift, shift) < self._slack**2))
        queries = np.hstack([moved[stale], self._descriptors[stale]])
        penalty = None if self._penalty is None else self._penalty[stale]
        found, self._slack[stale] = self._index.nearest_of(queries, penalty, self._max_distance, 1)
        self._asked[stale] = moved[stale]
        # What was handed out before stays as it was.
        self._rows = self._rows.copy()
        self._rows[self._order[stale]] = found[:, 0]
        return self._rows


class _IndexCache:
    """The trees of the targets seen last, by content: a callback that is pure still builds each tree only once."""

    def __init__(self, rows: int):
        self._rows = rows
        self._lock = threading.Lock()
        self._indices: collections.OrderedDict[bytes, TreeIndex] = collections.OrderedDict()

    def get(self, search: AbstractTreeSearch, target: Rows) -> TreeIndex:
        arrays = jax.tree.leaves(target)
        digest = hashlib.blake2b(repr([search, *((array.shape, array.dtype) for array in arrays)]).encode())
        for array in arrays:
            digest.update(np.ascontiguousarray(array).data)
        key = digest.digest()
        with self._lock:
            if key in self._indices:
                self._indices.move_to_end(key)
                return self._indices[key]
        index = TreeIndex(search, target)
        with self._lock:
            self._indices[key] = index
            while len(self._indices) > 1 and sum(kept.num_rows for kept in self._indices.values()) > self._rows:
                self._indices.popitem(last=False)
        return index


_index_cache = _IndexCache(_CACHED_ROWS)


def _pieces(array: Any) -> list[Any]:
    """An array cut along its rows, for a callback.

    JAX copies what a callback is given, and large arrays by a thread of the pool that programs run on. Where callbacks
    of as many programs as there are threads wait for that, all wait for ever (seen with two programs on two cores).
    """
    array = jnp.asarray(array)
    count = -(-array.nbytes // _LARGEST_PIECE)
    return [array] if count <= 1 else jnp.array_split(array, count)


def _nearest_callback(search: AbstractTreeSearch, num_candidates: int, *arguments: Any) -> Int[np.ndarray, "m N"]:
    """`nearest` of arguments in pieces, which are those of `AbstractSearch.nearest_traced`."""
    whole = jax.tree.map(
        lambda pieces: (
            np.concatenate([np.asarray(piece) for piece in pieces]) if len(pieces) > 1 else np.asarray(pieces[0])
        ),
        arguments,
        is_leaf=lambda node: isinstance(node, list),
    )
    pose, source, target, max_distance, running = whole
    if not running:
        return np.full((num_candidates, source.valid.size), -1, np.int32)
    index = _index_cache.get(search, target)
    return index.nearest(pose, source, float(max_distance), num_candidates)


def _moved(pose: Float[ArrayLike, "7"], points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    pose = np.asarray(pose, np.float64)
    # A pose that is not finite moves points to nowhere; the sums will say so.
    with np.errstate(invalid="ignore"):
        return points @ rotation_from_quaternion(pose[:4]).T + pose[4:]


def _nearest(
    search: AbstractTreeSearch,
    tree: Any,
    num_points: int,
    queries: Float[np.ndarray, "N D"],
    k: int,
    bound: float = np.inf,
) -> tuple[Int[np.ndarray, "N k"], Float[np.ndarray, "N"]]:
    """Tree indices of the k nearest, ordered by (distance, row); `num_points` where nothing lies within `bound`.

    And half the gap between the nearest and the second, which lies at the bound if there is none within; 0 without any.
    Trees leave the order of equal distances to chance. One neighbour more than needed shows where there are any.
    """
    k = min(k, num_points)
    asked = min(k + 1, num_points)
    most = min(max(_TIE_CANDIDATES * (k + 1), _LEAST_TIE_CANDIDATES), num_points)
    distances, rows = _query(search, tree, queries, asked, bound)
    nearest = rows[:, :k].astype(np.int32)
    # A part in a million covers rounding. A single row has no second, and infinity less infinity no meaning.
    second = np.minimum(distances[:, min(1, asked - 1)], bound)
    with np.errstate(invalid="ignore"):
        slack = 0.5 * (1 - 1e-6) * np.nan_to_num(second - distances[:, 0], neginf=0.0)
    tied = np.flatnonzero((distances[:, 1:] == distances[:, :-1]).any(axis=1) & np.isfinite(distances[:, 0]))
    distances, rows = distances[tied], rows[tied]
    while tied.size:
        order = np.lexsort((rows, distances), axis=1)
        nearest[tied] = np.take_along_axis(rows, order, axis=1)[:, :k]
        if asked == most:
            break
        # A tie that the last candidate shares may go on beyond it.
        tied = tied[np.isfinite(distances[:, -1]) & (distances[:, k - 1] == distances[:, -1])]
        asked = min(2 * asked, most)
        if tied.size:
            distances, rows = _query(search, tree, queries[tied], asked, bound)
    return nearest, slack


def _query(
    search: AbstractTreeSearch, tree: Any, queries: Float[np.ndarray, "N D"], k: int, bound: float
) -> tuple[Float[np.ndarray, "N k"], Int[np.ndarray, "N k"]]:
    most = num_cores() if search.workers == -1 else search.workers
    count = 1 if most == 1 else min(_PARTS_PER_THREAD * most, len(queries) // _LEAST_PART)
    if count <= 1:
        return search.query(tree, queries, k, bound)
    parts = np.array_split(queries, count)
    answers = side_by_side([partial(search.query, tree, part, k, bound) for part in parts], most)
    distances, rows = zip(*answers, strict=True)
    return np.concatenate(distances), np.concatenate(rows)
