"""Nearest neighbours by trees on the host: the interface for kinds of trees, and k-d trees.

`AbstractTreeSearch` handles what is common to all trees: ties, padding, missing channels, threads, reuse of matches
from pose to pose, and the callback with its cache inside transformations. A subclass implements `build` and `query`;
`KDTreeSearch` uses SciPy's tree or, where it is installed and faster, pykdtree's. Callbacks run NumPy code only.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.cache import MAX_ROWS, Cache
from mcgicp_jax._compute.concrete import DeferredRows
from mcgicp_jax._compute.programs import call_host
from mcgicp_jax._search.base import IDENTITY, AbstractSearch, SearchPoints, search_points
from mcgicp_jax._search.ties import TiedTree, TreeBackend
from mcgicp_jax._search.tree_index import LARGEST_UNORDERED, TreeIndex

# A tree of SciPy, or of pykdtree, which may not be installed.
Tree: TypeAlias = Any
# Where pykdtree is quicker than SciPy's tree, see Constants in `tests/benchmarks/README.md`. Up to seven dimensions the
# distances of both agree to the last bit, since both add the squared differences in the same order.
MAX_DIMENSIONS = 4
# Indices by the content of their target: a pure callback keeps no state, and each tree is built only once.
_indices = Cache(MAX_ROWS, lambda index: index.num_rows)


@functools.cache
def has_pykdtree() -> bool:
    """Whether pykdtree can be used: it and threadpoolctl, which limits its threads, are installed."""
    return all(importlib.util.find_spec(name) for name in ("pykdtree", "threadpoolctl"))


def _by_one_thread(call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Call with one thread of OpenMP: queries are divided among our own, and a forked process has no others."""
    before = [(library, library.get_num_threads()) for library in _openmp()]
    for library, _ in before:
        library.set_num_threads(1)
    try:
        return call(*arguments, **named)
    finally:
        for library, number in before:
            library.set_num_threads(number)


@functools.cache
def _openmp() -> list[Any]:
    # `ThreadpoolController.limit` would search for the loaded libraries at each call.
    import pykdtree.kdtree  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return [library for library in ThreadpoolController().lib_controllers if library.user_api == "openmp"]


class AbstractTreeSearch(AbstractSearch, TreeBackend):
    """Exact search with a tree on the host. Ties are broken by row, so that results are reproducible.

    Attributes:
        workers: largest number of threads per registration; −1 uses all cores.
    """

    workers: int = eqx.field(static=True, default=-1)

    @property
    def num_threads(self) -> int | None:
        return None if self.workers == -1 else self.workers

    def index(self, target: SearchPoints) -> TreeIndex:
        return TreeIndex(self, target)

    def nearest_traced(
        self,
        pose: Float[Array, "7"],
        source: SearchPoints,
        target: SearchPoints,
        max_distance: Float[Array, ""],
        running: Bool[Array, ""],
        num_candidates: int = 1,
    ) -> Int[Array, "m N"]:
        shape = (num_candidates, source.valid.shape[0])

        def nearest(pose: Any, source: Any, target: Any, max_distance: Any, running: Any) -> Int[np.ndarray, "m N"]:
            if not running:
                return np.full(shape, -1, np.int32)
            arrays = jax.tree.leaves(target)
            digest = hashlib.blake2b(repr([self, *((array.shape, array.dtype) for array in arrays)]).encode())
            for array in arrays:
                digest.update(np.ascontiguousarray(array).data)
            index = _indices.get(digest.digest(), partial(self.index, target))
            return index.nearest(pose, source, float(max_distance), num_candidates)

        result = jax.ShapeDtypeStruct(shape, jnp.int32)
        return call_host(nearest, result, pose, source, target, max_distance, running)

    def neighbors(self, points: Float[np.ndarray, "N 3"], num_neighbors: int) -> Int[np.ndarray, "N k"]:
        return self.neighbors_on_demand(points, num_neighbors).whole

    def neighbors_on_demand(self, points: Float[np.ndarray, "N 3"], num_neighbors: int) -> DeferredRows:
        tree = functools.cache(partial(TiedTree, self, points))

        def find(rows: Any, _: int | None) -> Int[np.ndarray, "n k"]:
            # In the order of the leaves, each query finds the nodes it needs in the processor's caches.
            order = tree().leaf_order() if rows is None else rows
            nearest = tree().nearest(points[order], num_neighbors)[0]
            neighbors = np.full((len(order), num_neighbors), -1, np.int32)
            neighbors[order if rows is None else slice(None), : nearest.shape[1]] = nearest
            return neighbors

        # A search whose class is defined inside a function cannot be pickled.
        local = "<locals>" in type(self).__qualname__
        anew = None if local else partial(self.neighbors_on_demand, points, num_neighbors)
        return DeferredRows(find, (len(points), num_neighbors), anew)


class KDTreeSearch(AbstractTreeSearch):
    """Exact search with a k-d tree on the host. Ties are broken by row, so that results are reproducible.

    Attributes:
        workers: largest number of threads per registration; −1 uses all cores.
        backend: "scipy", or "pykdtree" (the extra `fast`; LGPL), which is quicker and finds the same; by default
            pykdtree if the extra is installed. SciPy's in more than four dimensions, where pykdtree is no
            quicker.

    Raises:
        ValueError: if `backend` is none of these, or pykdtree is not installed.
    """

    backend: str | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        if self.backend not in ("scipy", "pykdtree", None):
            raise ValueError(f'backend: expected "scipy", "pykdtree" or None, got {self.backend!r}')
        if self.backend == "pykdtree" and not has_pykdtree():
            raise ValueError("backend: pykdtree is not installed; run: pip install 'mcgicp_jax[fast]'")

    def build(self, points: Float[np.ndarray, "M D"]) -> Tree:
        if self.backend != "scipy" and has_pykdtree() and points.shape[1] <= MAX_DIMENSIONS:
            from pykdtree.kdtree import KDTree

            return _by_one_thread(KDTree, np.ascontiguousarray(points, np.float64))
        return _scipy_tree(points)

    def query(
        self, tree: Tree, queries: Float[np.ndarray, "N D"], k: int, bound: float
    ) -> tuple[Float[np.ndarray, "N k"], Int[np.ndarray, "N k"]]:
        if isinstance(tree, scipy.spatial.cKDTree):
            return tree.query(queries, k=np.arange(1, k + 1), distance_upper_bound=bound)
        queries = np.ascontiguousarray(queries, np.float64)
        distances, rows = _by_one_thread(tree.query, queries, k=k, distance_upper_bound=bound)
        return distances.reshape(-1, k), rows.reshape(-1, k).astype(np.int64)

    def leaf_order(self, tree: Tree, num_points: int) -> Int[np.ndarray, "M"]:
        if isinstance(tree, scipy.spatial.cKDTree):
            return np.asarray(tree.indices)
        if num_points <= LARGEST_UNORDERED:
            return np.arange(num_points)
        # pykdtree does not tell its order; building SciPy's tree takes a tenth of the time that the order saves.
        return _scipy_tree(tree.data_pts.reshape(-1, tree.ndim)).indices


def _scipy_tree(points: Float[np.ndarray, "M D"]) -> scipy.spatial.cKDTree:
    # Unbalanced trees are built faster and searched as fast. Compact nodes pay off for 20 neighbours, and for one
    # neighbour from the second query on. Leaves of 32 points are a few percent faster than SciPy's default of 16.
    return scipy.spatial.cKDTree(points, leafsize=32, balanced_tree=False, compact_nodes=True)


def nearest_in_position(
    queries: Float[ArrayLike, "N 3"], points: Float[ArrayLike, "M 3"], max_distance: float
) -> Int[np.ndarray, "N"]:
    """Row of the point nearest to each query; −1 if none is within `max_distance`, metres. NaN matches nothing."""
    queries, points = np.asarray(queries), np.asarray(points)
    if not len(points):
        return np.full(len(queries), -1, np.int32)
    (nearest,) = KDTreeSearch().index(search_points(points)).nearest(IDENTITY, search_points(queries), max_distance)
    distances = np.linalg.norm(points[nearest] - queries, axis=1)
    return np.where(distances <= max_distance, nearest, -1)
