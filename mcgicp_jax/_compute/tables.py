"""Tables of rows: trees of arrays packed in one, rows that are computed when they are needed, and blocks of rows."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

Tree = TypeVar("Tree")


class Layout(NamedTuple):
    """How a tree of arrays lies in one."""

    structure: Any
    shapes: tuple[tuple[int, ...], ...]  # without the axes that they share
    dtypes: tuple[Any, ...]  # None where it is that of the table


@partial(jax.tree_util.register_dataclass, data_fields=("table",), meta_fields=("layout",))
@dataclass(frozen=True)
class Packed(Generic[Tree]):
    """A tree of arrays in one, `table`, (..., L); a pytree, whose layout is static. The dtype is that of the floats, if
    there are any; integers up to 2²⁴ and booleans are exact in it."""

    table: Any
    layout: Layout

    @staticmethod
    def of(tree: Tree, num_axes: int = 1) -> Packed[Tree]:
        """Pack NumPy or traced arrays that share their first `num_axes` axes."""
        leaves, structure = jax.tree.flatten(tree)
        dtypes = [leaf.dtype for leaf in leaves]
        dtype = np.result_type(*([dtype for dtype in dtypes if jnp.issubdtype(dtype, jnp.floating)] or dtypes))
        xp: Any = np if isinstance(leaves[0], np.ndarray) else jnp
        columns, shapes, others = [], [], []
        for leaf in leaves:
            column = xp.asarray(leaf, dtype).reshape((*leaf.shape[:num_axes], -1))
            # XLA joins columns in a fraction of the time if the values of each lie side by side.
            columns.append(column if xp is np else jnp.moveaxis(column, -1, 0))
            shapes.append(leaf.shape[num_axes:])
            others.append(None if leaf.dtype == dtype else leaf.dtype)
        table = np.concatenate(columns, axis=-1) if xp is np else jnp.moveaxis(jnp.concatenate(columns), 0, -1)
        return Packed(table, Layout(structure, tuple(shapes), tuple(others)))

    @property
    def tree(self) -> Tree:
        """The tree of arrays; views of a NumPy array."""
        leaves, start, shared, table = [], 0, self.table.shape[:-1], self.table
        if not isinstance(table, np.ndarray) and table.ndim > 1:
            # The same as in `of`: without the barrier, each use of a column would collect it anew.
            table = jnp.moveaxis(jax.lax.optimization_barrier(jnp.moveaxis(table, -1, 0)), 0, -1)
        for shape, dtype in zip(self.layout.shapes, self.layout.dtypes, strict=True):
            stop = start + math.prod(shape)
            leaf = table[..., start:stop].reshape((*shared, *shape))
            leaves.append(leaf if dtype is None else leaf.astype(dtype))
            start = stop
        return jax.tree.unflatten(self.layout.structure, leaves)

    def rows(self, index: Any) -> Packed[Tree]:
        # `take` takes a quarter of the time of an index array.
        table = self.table[index] if isinstance(index, slice) else self.table.take(index, axis=0)
        return Packed(table, self.layout)


class RowsOnDemand(Generic[Tree]):
    """A pytree of arrays, each row of which is computed once, when it is first needed. Threads may share it.

    `compute` maps row numbers, or None for all rows, and the largest number of threads to a pytree of NumPy arrays. A
    row must not depend on the others that are computed with it; there is at least one.
    """

    def __init__(self, compute: Callable[[Any, int | None], Tree], num_rows: int):
        self._compute, self._lock = compute, threading.Lock()
        self._missing = np.ones(num_rows, bool)
        # The arrays are never replaced, since views of them are in use.
        self._tree: Any = None
        # Whether all rows are computed.
        self.complete = False

    def computed(self, rows: slice | Int[np.ndarray, "*n"] | None = None, num_threads: int | None = 1) -> Tree:
        """The whole arrays, in which these rows (None: all), or any, are computed, and others may not be."""
        if self.complete:
            return self._tree
        with self._lock:
            missing = self._missing
            if rows is not None:
                missing = np.zeros_like(self._missing)
                missing[rows] = True
                missing &= self._missing
            new = np.flatnonzero(missing)
            if self._tree is None and not new.size:
                new = np.zeros(1, np.intp)
            if new.size == missing.size:
                self._tree = self._compute(None, num_threads)
            elif new.size:
                computed = self._compute(new, num_threads)
                if self._tree is None:
                    size = missing.size
                    self._tree = jax.tree.map(lambda array: np.zeros((size, *array.shape[1:]), array.dtype), computed)
                for whole, part in zip(jax.tree.leaves(self._tree), jax.tree.leaves(computed), strict=True):
                    whole[new] = part
            self._missing[new] = False
            self.complete = not self._missing.any()
            return self._tree


# Rows of a block. One size for all clouds, so that few programs are compiled. Measured with 34,000 rows: blocks of
# 2,048 to 8,192 rows take equally long, blocks of 1,024 a fifth more. Larger blocks mean more padding for small clouds.
BLOCK = 2048
# The same where each row has its neighbourhood. Measured with 20 neighbours of 34,000 points: blocks of 512 to 4,096
# rows take 236, 208, 230 and 277 µs per 1,000 rows, with two channels 371, 353, 444 and 466 (caches of 1 MB per core).
NEIGHBORHOOD_BLOCK = 1024

Block = tuple[slice, slice | Int[np.ndarray, "BLOCK"]]


def blocks(num_rows: int, size: int = BLOCK) -> list[Block]:
    """For each block, its slice of rows, and an index of exactly `size` rows that repeats the last row as padding."""
    cut: list[Block] = []
    for start in range(0, num_rows, size):
        places = slice(start, min(start + size, num_rows))
        padded = places.stop - start < size
        cut.append((places, np.minimum(np.arange(start, start + size), num_rows - 1) if padded else places))
    return cut
