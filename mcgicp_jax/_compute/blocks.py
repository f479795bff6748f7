"""Blocks of rows, of a fixed number: programs over them are compiled once for clouds of every size."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

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
