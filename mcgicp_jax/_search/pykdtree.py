"""k-d trees of pykdtree, an optional dependency. Its licence is the LGPL: the package imports it, and no more."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, Int

# Where pykdtree is quicker than SciPy's tree: two neighbours of 2,000 to 35,000 points take 0.4 to 0.7 of the time in
# three dimensions, 0.5 to 1 in four, and 0.7 to 1.7 in six; 20 neighbours 0.7 to 0.9 in three dimensions. (100 take up
# to 1.5 of the time and 300 up to 3.4, but so many are only asked for to break ties.) Up to seven dimensions the
# distances of both agree to the last bit, since both add the squared differences in the same order.
MAX_DIMENSIONS = 4


@functools.cache
def has_pykdtree() -> bool:
    """Whether pykdtree can be used: it and threadpoolctl, which limits its threads, are installed."""
    return all(importlib.util.find_spec(name) for name in ("pykdtree", "threadpoolctl"))


class PyKDTree:
    """A tree of pykdtree, which answers on the calling thread alone."""

    def __init__(self, points: Float[np.ndarray, "M D"]):
        from pykdtree.kdtree import KDTree

        self.points = np.ascontiguousarray(points, np.float64)
        with _one_thread():
            self._tree = KDTree(self.points)

    def query(
        self, queries: Float[np.ndarray, "N D"], k: int, bound: float
    ) -> tuple[Float[np.ndarray, "N k"], Int[np.ndarray, "N k"]]:
        """As `AbstractTreeSearch.query`."""
        queries = np.ascontiguousarray(queries, np.float64)
        with _one_thread():
            distances, rows = self._tree.query(queries, k=k, distance_upper_bound=bound)
        return distances.reshape(-1, k), rows.reshape(-1, k).astype(np.int64)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """OpenMP with one thread: queries are divided among our own, and a forked process has no others."""
    before = [(library, library.get_num_threads()) for library in _openmp()]
    for library, _ in before:
        library.set_num_threads(1)
    try:
        yield
    finally:
        for library, number in before:
            library.set_num_threads(number)


@functools.cache
def _openmp() -> list[Any]:
    """The loaded OpenMP libraries. (`ThreadpoolController.limit` does the same, and describes them each time.)"""
    import pykdtree.kdtree  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return [library for library in ThreadpoolController().lib_controllers if library.user_api == "openmp"]
