"""Blocks of the inverse of a sparse symmetric matrix, from its factors.

Takahashi's equations give the entries of the inverse where the factor L has entries, without the others. For M = L D Lᵀ
in blocks, with N the rows of L below block k and Y = L[N, k], they are Z[N, k] = −Z[N, N] Y and
Z[k, k] = D[k]⁻¹ − Yᵀ Z[N, k]. The first row of N, the parent of k, has all others below it, too. So Z[N, N] is known if
the blocks are visited from the last to the first (Erisman & Tinney, CACM 1975; Kaess & Dellaert, RAS 2009).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

# Unknowns of a block, a pose.
_SIZE = 6


def inverse_blocks(
    factor: Any, pairs: Int[np.ndarray, "k 2"]
) -> tuple[Float[np.ndarray, "n 6 6"], Float[np.ndarray, "k 6 6"]]:
    """The diagonal 6×6 blocks of the inverse, and those of pairs of different blocks.

    Args:
        factor: `scipy.sparse.linalg.SuperLU` of a symmetric matrix in symmetric mode, with pivots on the diagonal.
        pairs: row and column of blocks that are not 0 in the pattern of the matrix.

    Raises:
        RuntimeError: if pivots are not on the diagonal.
    """
    place = factor.perm_c[::_SIZE] // _SIZE
    ordered = (_SIZE * place[:, None] + np.arange(_SIZE)).reshape(-1)
    if not (np.array_equal(factor.perm_c, ordered) and np.array_equal(factor.perm_r, ordered)):
        raise RuntimeError("the factors are not those of a symmetric matrix in blocks")
    number = len(place)
    lower, pivots = factor.L.tocsc(), factor.U.diagonal().reshape(-1, _SIZE)
    below = _rows_below(lower, number)
    ends = place[pairs]
    wanted: dict[int, list[int]] = {}
    for pair, block in enumerate(ends.min(axis=1, initial=number)):
        wanted.setdefault(int(block), []).append(pair)
    diagonal, others = np.empty((number, _SIZE, _SIZE)), np.empty((len(pairs), _SIZE, _SIZE))
    children = np.bincount([rows[0] for rows in below if len(rows)], minlength=number)
    fronts: dict[int, tuple[Any, Any]] = {}
    for k in reversed(range(number)):
        rows = below[k]
        inner, outer = _panel(lower, k, rows)
        front = np.empty((_SIZE * (len(rows) + 1),) * 2)
        here, there = slice(0, _SIZE), slice(_SIZE, None)
        front[here, here] = np.linalg.inv((inner * pivots[k]) @ inner.T)
        if len(rows):
            parent = int(rows[0])
            members, known = fronts[parent]
            chosen = (_SIZE * np.searchsorted(members, rows)[:, None] + np.arange(_SIZE)).reshape(-1)
            columns = np.linalg.solve(inner.T, outer.T).T
            front[there, there] = known[chosen[:, None], chosen]
            front[there, here] = -front[there, there] @ columns
            front[here, there] = front[there, here].T
            front[here, here] -= columns.T @ front[there, here]
            children[parent] -= 1
            if not children[parent]:
                del fronts[parent]
        diagonal[k] = front[here, here]
        members = np.append(k, rows)
        for pair in wanted.get(k, ()):
            column = _SIZE * int(np.searchsorted(members, ends[pair].max()))
            block = front[here, column : column + _SIZE]
            others[pair] = block if ends[pair, 0] == k else block.T
        if children[k]:
            fronts[k] = (members, front)
    return diagonal[place], others


def _rows_below(lower: Any, number: int) -> list[Int[np.ndarray, "_"]]:
    """Of every block, the rows of blocks below it in L; all but the first are below that one, too."""
    inherited: list[list[Any]] = [[] for _ in range(number)]
    below = []
    for k in range(number):
        own = lower.indices[lower.indptr[_SIZE * k] : lower.indptr[_SIZE * k + _SIZE]] // _SIZE
        rows = np.unique(np.concatenate([own, *inherited[k]]))
        below.append(rows[rows > k])
        if len(below[k]):
            inherited[below[k][0]].append(below[k][1:])
        inherited[k] = []
    return below


def _panel(lower: Any, k: int, rows: Int[np.ndarray, "_"]) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "_ 6"]]:
    """The columns of L of block k: within the block, and below it."""
    pointers = lower.indptr[_SIZE * k : _SIZE * k + _SIZE + 1]
    entries = slice(pointers[0], pointers[-1])
    block, within = np.divmod(lower.indices[entries], _SIZE)
    panel = np.zeros((_SIZE * (len(rows) + 1), _SIZE))
    place = np.where(block == k, 0, 1 + np.searchsorted(rows, block))
    panel[_SIZE * place + within, np.repeat(np.arange(_SIZE), np.diff(pointers))] = lower.data[entries]
    return panel[:_SIZE], panel[_SIZE:]
