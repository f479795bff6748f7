"""Execution on the host: compiled programs over blocks of rows.

JAX compiles a program for every shape of its arguments. So that clouds of every size run the same programs, whatever
works point by point is called with blocks of a fixed number of rows. What comes out is rows, written in place, or sums,
which the caller adds in float64 in the order of the blocks: results are the same to the last bit for any number of
threads. Knows nothing of clouds or mathematics.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from mcgicp_jax._pose import computed_now
from mcgicp_jax._threads import side_by_side

# Rows of a block. One size for all, so that few programs are compiled. Measured with 34,000 rows: blocks of 2,048 to
# 8,192 rows take equally long, blocks of 1,024 a fifth more. Small clouds waste what they do not fill.
BLOCK = 2048

Block = tuple[slice, slice | Int[np.ndarray, "BLOCK"]]


def blocks(num_rows: int) -> list[Block]:
    """Cut rows into blocks.

    Returns:
        For each block, which rows it stands for, and what to index arrays with to get exactly `BLOCK` rows: in the last
        block, the last row is repeated.
    """
    cut: list[Block] = []
    for start in range(0, num_rows, BLOCK):
        stop = start + BLOCK
        if stop <= num_rows:
            cut.append((slice(start, stop), slice(start, stop)))
        else:
            cut.append((slice(start, num_rows), np.minimum(np.arange(start, stop), num_rows - 1)))
    return cut


def map_blocks(function: Callable[[Any], Any], num_rows: int, num_threads: int | None = 1) -> list[tuple[slice, Any]]:
    """Results of a function for each block of rows, as NumPy arrays, in order.

    Args:
        function: takes what `blocks` says to index arrays with.
        num_threads: how many threads call it, at most; None for one per block.
    """
    cut = blocks(num_rows)

    # Other threads know nothing of a transformation that this one is tracing.
    with computed_now():
        results = side_by_side([partial(function, index) for _, index in cut], num_threads) if cut else []
    # A program runs while the arrays of the next one are gathered: nobody waits for it before all have begun.
    return [(rows, jax.tree.map(np.asarray, result)) for (rows, _), result in zip(cut, results, strict=True)]


def map_rows(function: Callable[[Any], Any], num_rows: int, num_threads: int | None = 1) -> Any:
    """The rows that a function returns for each block, put together: a pytree of arrays of `num_rows` rows.

    Args:
        function: takes what `blocks` says to index arrays with; its arrays have `BLOCK` rows as their first dimension.
        num_threads: as in `map_blocks`.
    """
    results = map_blocks(function, num_rows, num_threads)
    leaves = [jax.tree.leaves(result) for _, result in results]
    structure = jax.tree.structure(results[0][1])
    whole = [np.empty((num_rows, *leaf.shape[1:]), leaf.dtype) for leaf in leaves[0]]
    for (rows, _), block in zip(results, leaves, strict=True):
        for array, leaf in zip(whole, block, strict=True):
            array[rows] = leaf[: rows.stop - rows.start]
    return jax.tree.unflatten(structure, whole)
