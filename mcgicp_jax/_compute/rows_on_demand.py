"""Tables whose rows are computed when they are first needed."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import jax
import numpy as np
from jaxtyping import Int

Tree = TypeVar("Tree")


class RowsOnDemand(Generic[Tree]):
    """A pytree of arrays, each row of which is computed once, when it is first needed. Threads may share it.

    Args:
        compute: maps row numbers, or None for all rows, and the largest number of threads to a pytree of NumPy arrays.
            A row must not depend on the others that are computed with it.
        num_rows: number of rows, at least 1.
    """

    def __init__(self, compute: Callable[[Any, int | None], Tree], num_rows: int):
        self._compute, self._lock = compute, threading.Lock()
        self._missing = np.ones(num_rows, bool)
        # The arrays are never replaced, since views of them are in use.
        self._tree: Any = None

    def known(self, rows: slice | Int[np.ndarray, "*n"] | None = None, num_threads: int | None = 1) -> Tree:
        """The whole arrays, in which these rows (None: all), or any, are computed, and others may not be."""
        with self._lock:
            missing = self._missing
            if rows is not None:
                missing = np.zeros_like(self._missing)
                missing[rows] = True
                missing &= self._missing
            some = np.flatnonzero(missing)
            if self._tree is None and not some.size:
                some = np.zeros(1, np.intp)
            if some.size == missing.size:
                self._tree = self._compute(None, num_threads)
            elif some.size:
                self._fill(some, self._compute(some, num_threads))
            self._missing[some] = False
            return self._tree

    def _fill(self, rows: Int[np.ndarray, "n"], found: Tree) -> None:
        if self._tree is None:
            size = self._missing.size
            self._tree = jax.tree.map(lambda array: np.zeros((size, *array.shape[1:]), array.dtype), found)
        for whole, part in zip(jax.tree.leaves(self._tree), jax.tree.leaves(found), strict=True):
            whole[rows] = part
