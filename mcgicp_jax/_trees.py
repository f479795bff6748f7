"""Nearest neighbours by trees on the host.

`AbstractTreeSearch` handles what is common to all trees: ties, padding, missing channels, threads, reuse of matches
from pose to pose, and the callback with its cache inside transformations. A subclass implements `build` and `query`;
`KDTreeSearch` uses SciPy's tree. Callbacks run NumPy code only.
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
from mcgicp_jax._pykdtree import MOST_DIMENSIONS, MOST_NEIGHBORS, PyKDTree, has_pykdtree
from mcgicp_jax._search import AbstractIndex, AbstractSearch, Rows, on_host
from mcgicp_jax._threads import num_cores, side_by_side

# Largest number of candidates per query with which a tie is broken by row: a multiple of the neighbours wanted, but at
# least the second number. Longer ties are mostly due to coincident points, which are then merged and searched again.
_TIE_CANDIDATES = 8
_LEAST_TIE_CANDIDATES = 64
# Largest number of combinations of missing channels (of the queries × of the target) for which a tree each is built:
# two cameras, each of which sees a point or not, make 4 × 4.
_MOST_TREES = 16
# With more combinations: number of neighbours in position that are examined first, and number of (query, neighbour)
# differences in memory at a time.
_FIRST_NEAR = 32
_PAIRS_AT_ONCE = 200_000
# Smallest number of queries that a thread is given at a time, and largest number of such parts per thread: several,
# since a thread may start late. With 2,000 to 100,000 queries, a factor of two in either hardly matters.
_LEAST_PART, _PARTS_PER_THREAD = 1000, 8
# Points. A larger tree does not fit into a processor's caches; queries are then sorted so that neighbours follow each
# other, which halves the time at a million points.
_LARGEST_UNORDERED = 50_000
# Bytes. JAX (jaxlib 0.10.2) copies smaller arrays for a callback in the calling thread, up to 100 KiB; see `_pieces`.
_LARGEST_PIECE = 64 * 1024
# Total number of rows of the trees cached for callbacks: hundreds of scans, some hundred megabytes.
_CACHED_ROWS = 2_000_000


class AbstractTreeSearch(AbstractSearch):
    """Exact search with a tree on the host. Ties are broken by row, so that results are reproducible.

    Attributes:
        workers: largest number of threads per registration; −1 uses all cores.
    """

    workers: int = eqx.field(static=True, default=-1)

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
            # One lane at a time: a batch of small pieces would again be a large array, see `_pieces`.
            vmap_method="sequential",
        )

    def neighbors(self, points: Float[np.ndarray, "N 3"], num_neighbors: int) -> Int[np.ndarray, "N k"]:
        tree = self.build(points)
        # In the order of the leaves, each query finds the nodes it needs in the processor's caches.
        order = self.leaf_order(tree, len(points))
        found, _ = _nearest(self, tree, points, points[order], num_neighbors)
        neighbors = np.full((len(points), num_neighbors), -1, np.int32)
        neighbors[order, : found.shape[1]] = found
        return neighbors


class KDTreeSearch(AbstractTreeSearch):
    """Exact search with a k-d tree on the host. Ties are broken by row, so that results are reproducible.

    Attributes:
        workers: largest number of threads per registration; −1 uses all cores.
        backend: "scipy", or "pykdtree" (the extra `fast`), which is quicker and finds the same; by default pykdtree if
            it is installed.

    Raises:
        ValueError: if `backend` is none of these, or pykdtree is not installed.
    """

    backend: str | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        if self.backend not in ("scipy", "pykdtree", None):
            raise ValueError(f'backend: expected "scipy", "pykdtree" or None, got {self.backend!r}')
        if self.backend == "pykdtree" and not has_pykdtree():
            raise ValueError("backend: pykdtree is not installed; run: pip install 'mcgicp_jax[fast]'")

    def build(self, points: Float[np.ndarray, "M D"]) -> scipy.spatial.cKDTree | PyKDTree:
        if self.backend != "scipy" and has_pykdtree() and points.shape[1] <= MOST_DIMENSIONS:
            return PyKDTree(points)
        return _scipy_tree(points)

    def query(
        self, tree: scipy.spatial.cKDTree | PyKDTree, queries: Float[np.ndarray, "N D"], k: int, bound: float
    ) -> tuple[Float[np.ndarray, "N k"], Int[np.ndarray, "N k"]]:
        if isinstance(tree, PyKDTree) and k <= MOST_NEIGHBORS:
            return tree.query(queries, k, bound)
        tree = _scipy_tree(tree.points) if isinstance(tree, PyKDTree) else tree
        return tree.query(queries, k=np.arange(1, k + 1), distance_upper_bound=bound)

    def leaf_order(self, tree: scipy.spatial.cKDTree | PyKDTree, num_points: int) -> Int[np.ndarray, "M"]:
        if isinstance(tree, PyKDTree):
            # pykdtree does not give its order.
            return _scipy_tree(tree.points).indices if num_points > _LARGEST_UNORDERED else np.arange(num_points)
        return np.asarray(tree.indices)


def _scipy_tree(points: Float[np.ndarray, "M D"]) -> scipy.spatial.cKDTree:
    # Unbalanced trees are built faster and searched as fast. Compact nodes pay off for 20 neighbours, and for one
    # neighbour from the second query on. Leaves of 32 points are a few percent faster than SciPy's default of 16.
    return scipy.spatial.cKDTree(points, leafsize=32, balanced_tree=False, compact_nodes=True)


class TreeIndex(AbstractIndex):
    """An index over the finite rows: one tree, or where rows lack channels, one per set of channels in common.

    With many such sets, a tree of positions yields candidates instead, whose search distances are then computed.
    """

    def __init__(self, search: AbstractTreeSearch, target: Rows):
        points = np.hstack([target.points, target.descriptors])
        # Trees reject non-finite points; the sums at the pose lead to the status NON_FINITE.
        self._rows = np.flatnonzero(target.valid & np.isfinite(points).all(axis=1)).astype(np.int32)
        self._points = points[self._rows]
        penalty = np.zeros_like(target.descriptors) if target.penalty is None else target.penalty
        self._penalty = penalty[self._rows]
        self._patterns, self._which = _patterns(self._penalty)
        self._search = search
        # Trees are built on demand. Threads that need the same tree at once may each build it.
        self._parts: dict[bytes, list[_Part]] = {}
        self._positions: Any = None

    @property
    def num_rows(self) -> int:
        """Total number of rows in all trees, as a measure of memory."""
        return self._rows.size * max(1, len(self._parts) + (self._positions is not None))

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
        """The k nearest rows of each query.

        Args:
            queries: positions and descriptors, metres; rows that are not finite have no neighbours.
            penalty: as in `Rows`, for the queries.

        Returns:
            (N, k) target rows, −1 for none; and (N,) the slack: the distance, metres, that a query may move before its
            nearest row can change.
        """
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
        if len(patterns) * len(self._patterns) > _MOST_TREES:
            groups = [active]
            answers = [self._near_in_position(queries[active], patterns[which], k)]
        else:
            groups = [active] if len(patterns) == 1 else [rows[which == i] for i in range(len(patterns))]
            answers = [
                self._nearest(queries[alike], pattern, k, bound)
                for pattern, alike in zip(patterns, groups, strict=True)
            ]
        for alike, (found, free) in zip(groups, answers, strict=True):
            indices[alike, : found.shape[1]], slack[alike] = found, free
        return indices, slack

    def _nearest(
        self, queries: Float[np.ndarray, "N D"], penalty: Float[np.ndarray, "C"], k: int, bound: float
    ) -> tuple[Int[np.ndarray, "N m"], Float[np.ndarray, "N"]]:
        """`nearest_of` for queries that lack the same channels."""
        parts = self._parts_for(penalty)
        if len(parts) == 1:
            found, slack = parts[0].nearest(queries, k, bound)
            return parts[0].rows[found], slack
        # The slack depends on the second nearest row.
        each = [part.nearest(queries, k + 1, bound)[0] for part in parts]
        rows = np.hstack([part.rows[found] for part, found in zip(parts, each, strict=True)])
        squares = np.hstack([part.squares(queries, found) for part, found in zip(parts, each, strict=True)])
        rows, squares = _ordered(rows, squares, k + 1)
        return rows[:, :k], _slack(*np.sqrt(squares[:, [0, -1]]).T)

    def _near_in_position(
        self, queries: Float[np.ndarray, "N D"], penalty: Float[np.ndarray, "N C"], k: int
    ) -> tuple[Int[np.ndarray, "N m"], Float[np.ndarray, "N"]]:
        """`nearest_of` for queries and points that lack many different sets of channels.

        The number of neighbours in position grows until all other points are too far away in position alone.
        """
        if self._positions is None:
            self._positions = self._search.build(self._points[:, :3])
        size = self._rows.size
        found, slack = np.empty((len(queries), min(k, size)), np.int32), np.empty(len(queries))
        # Penalties that every match of a query incurs: a lower bound on the squared distance beside the position.
        least = penalty.sum(axis=1)
        open, asked = np.arange(len(queries)), min(max(_FIRST_NEAR, k + 1), size)
        while open.size:
            unsure = []
            for some in np.array_split(open, -(-open.size * asked // _PAIRS_AT_ONCE)):
                distances, near = _query(self._search, self._positions, queries[some, :3], asked, np.inf)
                rows, squares = _ordered(self._rows[near], self._squares(queries[some], penalty[some], near), k + 1)
                found[some] = rows[:, :k]
                # The margin of 1e-9 covers rounding in float64.
                others = (1 - 1e-9) * (distances[:, -1] ** 2 + least[some]) if asked < size else np.inf
                slack[some] = _slack(*np.sqrt([squares[:, 0], np.minimum(squares[:, -1], others)]))
                unsure.append(some[~(squares[:, min(k, size) - 1] < others)])
            open, asked = np.concatenate(unsure) if asked < size else open[:0], min(4 * asked, size)
        return found, slack

    def _squares(
        self, queries: Float[np.ndarray, "N D"], penalty: Float[np.ndarray, "N C"], near: Int[np.ndarray, "N m"]
    ) -> Float[np.ndarray, "N m"]:
        """Squared search distances to points, including the penalties for missing channels; metres²."""
        difference = queries[:, None] - self._points[near]
        missing = np.maximum(penalty[:, None], self._penalty[near])
        difference[..., 3:][missing > 0] = 0
        return np.sum(difference * difference, axis=2) + missing.sum(axis=2)

    def _parts_for(self, penalty: Float[np.ndarray, "C"]) -> list[_Part]:
        key = penalty.tobytes()
        if key not in self._parts:
            common, alike = _patterns(np.maximum(self._patterns, penalty))
            which = alike[self._which]
            groups = [slice(None) if len(common) == 1 else which == i for i in range(len(common))]
            self._parts[key] = [
                _Part(self._search, self._points[group], self._rows[group], pattern)
                for group, pattern in zip(groups, common, strict=True)
            ]
        return self._parts[key]


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


def _ordered(
    rows: Int[np.ndarray, "N m"], squares: Float[np.ndarray, "N m"], k: int
) -> tuple[Int[np.ndarray, "N k"], Float[np.ndarray, "N k"]]:
    """The first k rows by squared distance, ties by row, and their squared distances."""
    order = np.lexsort((rows, squares), axis=1)[:, :k]
    return np.take_along_axis(rows, order, axis=1), np.take_along_axis(squares, order, axis=1)


def _slack(first: Float[np.ndarray, "N"], second: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    """Distance that a query may move before its nearest row can change: half the gap to the second, metres."""
    # The margin of 1e-6 covers rounding. Without a nearest row the gap is NaN or −inf, and the slack 0.
    with np.errstate(invalid="ignore"):
        return 0.5 * (1 - 1e-6) * np.nan_to_num(second - first, neginf=0.0)


class _Part:
    """A tree of the target rows that share one set of channels with a query."""

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
        """Tree indices of the k nearest (fewer if the tree has fewer), and the slack, as from `_nearest`."""
        return _nearest(self._search, self._tree, self._points, queries[:, self._columns], k, bound)

    def squares(self, queries: Float[np.ndarray, "N D"], found: Int[np.ndarray, "N m"]) -> Float[np.ndarray, "N m"]:
        """Squared search distances to tree indices, including the penalties for missing channels; metres²."""
        difference = queries[:, None, self._columns] - self._points[np.minimum(found, len(self._points) - 1)]
        apart = np.sum(difference * difference, axis=2) + self._penalty
        return np.where(found < len(self._points), apart, np.inf)


class _Follower:
    """Nearest target rows of one source, for a sequence of poses.

    A match is provably unchanged while its source point has moved by less than half the gap between its nearest and its
    second nearest target point since the last search. After the first poses this holds for most points.
    """

    def __init__(self, index: TreeIndex, search: AbstractTreeSearch, source: Rows, max_distance: float):
        self._index = index
        self._max_distance = max_distance
        # Valid source rows, for large clouds sorted by neighbourhood. All arrays below are in this order.
        order: Int[np.ndarray, "n"] = np.flatnonzero(source.valid)
        if order.size > _LARGEST_UNORDERED:
            points = np.nan_to_num(source.points[order], posinf=0, neginf=0)
            order = order[search.leaf_order(search.build(points), order.size)]
        self._order = order
        self._points = np.asarray(source.points[order], np.float64)
        self._descriptors = source.descriptors[order]
        self._penalty = None if source.penalty is None else source.penalty[order]
        # Position of each point at its last search, and the distance that it may move from there.
        self._asked: Float[np.ndarray, "n 3"] = np.full((order.size, 3), np.nan)
        self._slack: Float[np.ndarray, "n"] = np.zeros(order.size)
        self._rows: Int[np.ndarray, "N"] = np.full(source.valid.size, -1, np.int32)

    def nearest(self, pose: Float[ArrayLike, "7"]) -> Int[np.ndarray, "N"]:
        moved = _moved(pose, self._points)
        shift = moved - self._asked
        # Written so that NaN, which marks points not yet searched for, counts as stale.
        stale = np.flatnonzero(~(np.einsum("ij,ij->i", shift, shift) < self._slack**2))
        queries = np.hstack([moved[stale], self._descriptors[stale]])
        penalty = None if self._penalty is None else self._penalty[stale]
        found, self._slack[stale] = self._index.nearest_of(queries, penalty, self._max_distance, 1)
        self._asked[stale] = moved[stale]
        # Arrays returned earlier must not change.
        self._rows = self._rows.copy()
        self._rows[self._order[stale]] = found[:, 0]
        return self._rows


class _IndexCache:
    """Least-recently-used cache of trees by content: a pure callback keeps no state, yet builds each tree only once."""

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
    """An array split along its rows into pieces that are small enough to be passed to a callback without a deadlock.

    JAX copies the arguments of a callback, large arrays in a thread of the pool that also runs programs. If callbacks
    of as many programs as there are threads wait for such copies, they deadlock (seen with two programs on two cores).
    """
    array = jnp.asarray(array)
    count = -(-array.nbytes // _LARGEST_PIECE)
    return [array] if count <= 1 else jnp.array_split(array, count)


def _nearest_callback(search: AbstractTreeSearch, num_candidates: int, *arguments: Any) -> Int[np.ndarray, "m N"]:
    """`TreeIndex.nearest` for the arguments of `AbstractSearch.nearest_traced`, each split by `_pieces`."""
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
    # A non-finite pose gives NaN; the status of the registration reports it.
    with np.errstate(invalid="ignore"):
        return points @ rotation_from_quaternion(pose[:4]).T + pose[4:]


def _nearest(
    search: AbstractTreeSearch,
    tree: Any,
    points: Float[np.ndarray, "M D"],
    queries: Float[np.ndarray, "N D"],
    k: int,
    bound: float = np.inf,
) -> tuple[Int[np.ndarray, "N k"], Float[np.ndarray, "N"]]:
    """The k nearest points of each query (all points if there are fewer), ordered by distance and then row.

    Trees return ties in any order. Searching for k + 1 neighbours reveals ties, which are then resolved.

    Returns:
        Tree indices, the number of points standing for none within `bound`; and the slack: half the gap between the
        nearest and the second nearest, which is taken to lie at the bound if none is within it; 0 without a nearest.
    """
    k = min(k, len(points))
    asked = min(k + 1, len(points))
    most = min(max(_TIE_CANDIDATES * (k + 1), _LEAST_TIE_CANDIDATES), len(points))
    distances, rows = _query(search, tree, queries, asked, bound)
    nearest = rows[:, :k].astype(np.int32)
    slack = _slack(distances[:, 0], np.minimum(distances[:, min(1, asked - 1)], bound))
    farthest = distances[:, k - 1]
    tied = np.flatnonzero((distances[:, 1:] == distances[:, :-1]).any(axis=1) & np.isfinite(distances[:, 0]))
    distances, rows = distances[tied], rows[tied]
    while tied.size:
        order = np.lexsort((rows, distances), axis=1)
        nearest[tied] = np.take_along_axis(rows, order, axis=1)[:, :k]
        # A tie that includes the last candidate may extend beyond it.
        tied = tied[np.isfinite(distances[:, -1]) & (distances[:, k - 1] == distances[:, -1])]
        if asked == most:
            break
        asked = min(2 * asked, most)
        if tied.size:
            distances, rows = _query(search, tree, queries[tied], asked, bound)
    if tied.size and asked < len(points):
        nearest[tied] = _nearest_in_all(points, queries[tied], farthest[tied], k)
    return nearest, slack


def _nearest_in_all(
    points: Float[np.ndarray, "M D"],
    queries: Float[np.ndarray, "N D"],
    farthest: Float[np.ndarray, "N"],
    k: int,
) -> Int[np.ndarray, "N k"]:
    """The k nearest by brute force, for queries with long ties, e.g. where a sensor reports missing echoes as zeros.

    Args:
        farthest: distance of the k-th neighbour, metres.
    """
    # Such queries mostly coincide, too.
    queries, first, whose = np.unique(queries, axis=0, return_index=True, return_inverse=True)
    nearest = np.empty((len(queries), k), np.int32)
    for i, (query, limit) in enumerate(zip(queries, farthest[first], strict=True)):
        squares = np.zeros(len(points))
        # In float64, as trees compute.
        for column, value in zip(points.T.astype(np.float64), query, strict=True):
            squares += (column - value) ** 2
        # A part in a billion covers rounding.
        near = np.flatnonzero(squares <= limit**2 * (1 + 1e-9))
        nearest[i] = near[np.lexsort((near, squares[near]))[:k]]
    return nearest[whose.ravel()]


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
