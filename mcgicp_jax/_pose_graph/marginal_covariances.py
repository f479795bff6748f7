"""Covariances of poses and of functions of poses, from the factors of the sparse Gauss-Newton matrix.

The diagonal blocks of the inverse follow from Takahashi's equations, which give the entries of the inverse where the
factor L has entries. For M = L D Lᵀ in blocks, with N the rows of L below block k and Y = L[N, k], they are
Z[N, k] = −Z[N, N] Y and Z[k, k] = D[k]⁻¹ − Yᵀ Z[N, k]. The first row of N, the parent of k, has all others below it,
too. So Z[N, N] is known if the blocks are visited from the last to the first (Erisman & Tinney, CACM 1975; Kaess &
Dellaert, RAS 2009).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mcgicp_jax._pose_graph.levenberg_marquardt import Minimum, NormalEquations, PerMeasurement, factored

# Unknowns of a block, a pose.
_SIZE = 6
# Numbers in the right-hand sides that are solved for at once: 80 MB.
_SOLVED_AT_ONCE = 10_000_000


def pose_covariances(equations: NormalEquations, found: Minimum, weights: PerMeasurement) -> Float[np.ndarray, "n 6 6"]:
    """Covariances of all poses relative to the root; infinite if not connected with it, NaN if H is singular."""
    covariances = np.zeros((len(found.poses), 6, 6))
    if equations.size:
        try:
            factor = factored(equations.damped(equations.weighted(found.terms.blocks, weights)))
            covariances[~equations.fixed] = inverse_blocks(factor)[equations.place[~equations.fixed]]
        except (RuntimeError, np.linalg.LinAlgError):
            covariances[:] = np.nan
    covariances[equations.parts != equations.parts[equations.root]] = np.diag(np.full(6, np.inf))
    return covariances


def propagated(
    equations: NormalEquations,
    found: Minimum,
    weights: PerMeasurement,
    rows: Int[np.ndarray, "q 2"],
    jacobians: Float[np.ndarray, "q 2 d 6"],
) -> Float[np.ndarray, "q d d"]:
    """Covariances JΣJᵀ of functions of two poses each, by their Jacobians.

    Infinite if the poses are not connected with each other, NaN if H is singular.
    """
    number, d = len(rows), jacobians.shape[2]
    covariances = np.zeros((number, d, d))
    try:
        solver: Any = (
            factored(equations.damped(equations.weighted(found.terms.blocks, weights))) if equations.size else None
        )
    except RuntimeError:
        return np.full_like(covariances, np.nan)
    step = max(_SOLVED_AT_ONCE // max(equations.size * d, 1), 1)
    for start in range(0, number if solver else 0, step):
        q = slice(start, start + step)
        columns = np.zeros((len(found.poses), 6, len(rows[q]), d))
        each = np.arange(len(rows[q]))
        for row, jacobian in zip(rows[q].T, jacobians[q].swapaxes(0, 1), strict=True):
            columns[row, :, each] += jacobian.swapaxes(1, 2)
        gathered = equations.gathered(columns.reshape(*columns.shape[:2], -1)).reshape(equations.size, -1)
        solved = equations.spread(solver.solve(gathered)).reshape(columns.shape)
        for row, jacobian in zip(rows[q].T, jacobians[q].swapaxes(0, 1), strict=True):
            covariances[q] += jacobian @ solved[row, :, each]
    first, second = equations.parts[rows].T
    covariances[first != second] = np.diag(np.full(d, np.inf))
    return covariances


def inverse_blocks(factor: Any) -> Float[np.ndarray, "n 6 6"]:
    """The diagonal 6×6 blocks of the inverse.

    Args:
        factor: `scipy.sparse.linalg.SuperLU` of a symmetric matrix in symmetric mode, with pivots on the diagonal.

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
    diagonal = np.empty((number, _SIZE, _SIZE))
    children = np.bincount([rows[0] for rows in below if len(rows)], minlength=number)
    fronts: dict[int, tuple[Any, Any]] = {}
    here, there = slice(0, _SIZE), slice(_SIZE, None)
    for k in reversed(range(number)):
        rows = below[k]
        inner, outer = _panel(lower, k, rows)
        front = np.empty((_SIZE * (len(rows) + 1),) * 2)
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
        if children[k]:
            fronts[k] = (np.append(k, rows), front)
    return diagonal[place]


def _rows_below(lower: Any, number: int) -> list[Int[np.ndarray, "_"]]:
    """For every block, the rows of blocks below it in L; all but the first are below that one, too."""
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
