"""Covariances of poses and of functions of poses, from the factors of the sparse Gauss-Newton matrix.

Takahashi's equations give the blocks of the inverse Z where the factor L has entries. For M = L D Lᵀ in blocks, with
the rows N of L below block k and Y = L[N, k], they are Z[N, k] = −Z[N, N] Y and Z[k, k] = D[k]⁻¹ − Yᵀ Z[N, k]. The
first row of N is the parent of k, and the column of the parent contains the other rows of N. So Z[N, N] is known if
blocks are visited from the last to the first (Erisman & Tinney, CACM 1975; Kaess & Dellaert, RAS 2009).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mcgicp_jax._pose_graph.levenberg_marquardt import GraphState, factored

# Unknowns of a block, a pose.
_SIZE = 6
# Numbers in the right-hand sides that are solved for at once: 80 MB.
_SOLVED_AT_ONCE = 10_000_000


def pose_covariances(state: GraphState) -> Float[np.ndarray, "n 6 6"]:
    """Covariances of all poses relative to the root; infinite if not connected with it, NaN if H is singular."""
    equations, covariances = state.equations, np.zeros((len(state.poses), 6, 6))
    if equations.size:
        try:
            factor = factored(equations.damped(state.hessian))
            covariances[equations.order] = _inverse_blocks(factor)
        except (RuntimeError, np.linalg.LinAlgError):
            covariances[:] = np.nan
    covariances[equations.parts != equations.parts[equations.root]] = np.diag(np.full(6, np.inf))
    return covariances


def propagated(
    state: GraphState, rows: Int[np.ndarray, "q 2"], jacobians: Float[np.ndarray, "q 2 d 6"]
) -> Float[np.ndarray, "q d d"]:
    """JΣJᵀ; infinite if the two poses are not connected, NaN if H is singular."""
    equations, (number, _, d, _) = state.equations, jacobians.shape
    covariances = np.zeros((number, d, d))
    if equations.size:
        try:
            solver = factored(equations.damped(state.hessian))
        except RuntimeError:
            return np.full_like(covariances, np.nan)
        step = max(_SOLVED_AT_ONCE // (equations.size * d), 1)
        for start in range(0, number, step):
            q = slice(start, start + step)
            functions = np.arange(len(rows[q]))
            first_and_second = list(zip(rows[q].T, jacobians[q].swapaxes(0, 1), strict=True))
            # Jᵀ, H⁻¹Jᵀ and JH⁻¹Jᵀ.
            right = np.zeros((len(state.poses), 6, len(functions), d))
            for row, jacobian in first_and_second:
                right[row, :, functions] += jacobian.swapaxes(1, 2)
            unknowns = right[equations.order].reshape(equations.size, -1)
            solved = equations.spread(solver.solve(unknowns)).reshape(right.shape)
            for row, jacobian in first_and_second:
                covariances[q] += jacobian @ solved[row, :, functions]
    first, second = equations.parts[rows].T
    covariances[first != second] = np.diag(np.full(d, np.inf))
    return covariances


def _inverse_blocks(factor: Any) -> Float[np.ndarray, "n 6 6"]:
    """Diagonal blocks of the inverse, from a symmetric `SuperLU`. Raises `RuntimeError` for pivots off the diagonal."""
    place = factor.perm_c[::_SIZE] // _SIZE
    ordered = (_SIZE * place[:, None] + np.arange(_SIZE)).reshape(-1)
    if not (np.array_equal(factor.perm_c, ordered) and np.array_equal(factor.perm_r, ordered)):
        raise RuntimeError("the factors are not those of a symmetric matrix in blocks")
    number, pivots = len(place), factor.U.diagonal().reshape(-1, _SIZE)
    columns = factor.L.T.tobsr((_SIZE, _SIZE))
    columns.sort_indices()
    entries = np.split(columns.indices, columns.indptr[1:-1])
    blocks = np.split(columns.data.swapaxes(1, 2), columns.indptr[1:-1])
    # N of every block: rows with entries in L, and those of its children, which Z[N, N] of the children needs.
    below = [rows[rows > k] for k, rows in enumerate(entries)]
    for rows in below:
        if len(rows) > 1:
            below[rows[0]] = np.union1d(below[rows[0]], rows[1:])
    diagonal = np.empty((number, _SIZE, _SIZE))
    children = np.bincount([rows[0] for rows in below if len(rows)], minlength=number)
    # For each block k with children still to be visited: the rows k and N, and Z between these rows.
    fronts: dict[int, tuple[Any, Any]] = {}
    here, there = slice(0, _SIZE), slice(_SIZE, None)
    for k in reversed(range(number)):
        rows, members = below[k], np.append(k, below[k])
        # The columns of L of block k.
        panel = np.zeros((len(members), _SIZE, _SIZE))
        panel[np.searchsorted(members, entries[k])] = blocks[k]
        inner, outer = panel[0], panel[1:].reshape(-1, _SIZE)
        front = np.empty((_SIZE * len(members),) * 2)
        front[here, here] = np.linalg.inv((inner * pivots[k]) @ inner.T)
        if len(rows):
            parent = int(rows[0])
            parent_members, inverse = fronts[parent]
            places = (_SIZE * np.searchsorted(parent_members, rows)[:, None] + np.arange(_SIZE)).reshape(-1)
            ratio = np.linalg.solve(inner.T, outer.T).T
            front[there, there] = inverse[places[:, None], places]
            front[there, here] = -front[there, there] @ ratio
            front[here, there] = front[there, here].T
            front[here, here] -= ratio.T @ front[there, here]
            children[parent] -= 1
            if not children[parent]:
                del fronts[parent]
        diagonal[k] = front[here, here]
        if children[k]:
            fronts[k] = members, front
    return diagonal[place]
