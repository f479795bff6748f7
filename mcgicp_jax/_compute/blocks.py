"""Execution on the host: compiled programs over blocks of rows.

JAX compiles a program for every shape of its arguments. So that clouds of every size run the same programs, pointwise
computations are called with blocks of a fixed number of rows. They return either rows, which are concatenated, or sums,
which the caller adds in float64 in the order of the blocks: results are bitwise identical for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from mcgicp_jax._compute.concrete import outside_trace
from mcgicp_jax._compute.threads import side_by_side

# Rows of a block. One size for all clouds, so that few programs are compiled. Measured with 34,000 rows: blocks of
# 2,048 to 8,192 rows take equally long, blocks of 1,024 a fifth more. Larger blocks mean more padding for small clouds.
BLOCK = 2048
# The same where each row has its neighbourhood. Measured with 20 neighbours of 34,000 points: blocks of 512 to 4,096
# rows take 236, 208, 230 and 277 µs per 1,000 rows, with two channels 371, 353, 444 and 466 (caches of 1 MB per core).
NEIGHBORHOOD_BLOCK = 1024

Block = tuple[slice, slice | Int[np.ndarray, "BLOCK"]]


def blocks(num_rows: int, size: int = BLOCK) -> list[Block]:
    """Cut rows into blocks.

    Returns:
        For each block, the slice of rows that it covers, and an index that selects exactly `BLOCK` rows: the last block
        is padded by repeating the last row.
    """
    cut: list[Block] = []
    for start in range(0, num_rows, size):
        stop = start + size
        if stop <= num_rows:
            cut.append((slice(start, stop), slice(start, stop)))
        else:
            cut.append((slice(start, num_rows), np.minimum(np.arange(start, stop), num_rows - 1)))
    return cut


def map_blocks(
    function: Callable[[Any], Any], num_rows: int, num_threads: int | None = 1, size: int = BLOCK
) -> list[tuple[slice, Any]]:
    """Call a function on each block of rows.

    Args:
        function: maps an index of `size` rows (see `blocks`) to a pytree of arrays; no trace may be active.
        num_threads: largest number of threads that call it; None for one per block.
        size: number of rows of a block; another size needs other programs.

    Returns:
        For each block, in order, the slice of rows that it covers and the result. Programs are dispatched
        asynchronously: their results may not be computed yet.
    """
    cut = blocks(num_rows, size)
    results = side_by_side([partial(function, index) for _, index in cut], num_threads) if cut else []
    return [(rows, result) for (rows, _), result in zip(cut, results, strict=True)]


def map_rows(function: Callable[[Any], Any], num_rows: int, num_threads: int | None = 1, size: int = BLOCK) -> Any:
    """Call a function on each block of rows and concatenate the rows that it returns.

    Args:
        function: maps an index of `size` rows (see `blocks`) to a pytree of arrays with `size` rows.
        num_threads, size: as in `map_blocks`.

    Returns:
        A pytree of NumPy arrays with `num_rows` rows, at least 1.
    """
    # Worker threads run outside a trace that is active in this thread; this thread leaves it for the same results.
    with outside_trace():
        results = map_blocks(function, num_rows, num_threads, size)
    leaves = [jax.tree.leaves(result) for _, result in results]
    structure = jax.tree.structure(results[0][1])
    whole = [np.empty((num_rows, *leaf.shape[1:]), leaf.dtype) for leaf in leaves[0]]
    for (rows, _), block in zip(results, leaves, strict=True):
        for array, leaf in zip(whole, block, strict=True):
            array[rows] = np.asarray(leaf)[: rows.stop - rows.start]
    return jax.tree.unflatten(structure, whole)
