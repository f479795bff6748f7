"""Rejection of outliers among the uncertain measurements, by graduated non-convexity.

Truncated squares min(r², c²) are approached from a function whose convex part contains the largest residual (Yang,
Antonante, Tzoumas & Carlone, RA-L 2020).
"""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._math.robust_kernels import truncated_weights
from mcgicp_jax._pose_graph.levenberg_marquardt import Minimum, minimize
from mcgicp_jax._pose_graph.marginal_covariances import propagated
from mcgicp_jax._pose_graph.normal_equations import NormalEquations

# Probability that a true measurement exceeds the threshold on its squared Mahalanobis distance.
_LEVEL = 0.01
# Factor by which the non-convexity grows, with one step at each. In ten grids with 30 % of false loops, 1.4
# (Yang et al. 2020) keeps the same loops; with 4, 0.4 % of the true loops more are lost. The first steps cannot be
# left out: if the non-convexity begins 32 times as large, errors grow by a factor of 30 in the garage of 1,600 poses.
_GROWTH = 2.0
# Largest number of selections at the minimum, which end when a selection repeats itself.
_SELECTIONS = 5
# Rejected measurements are tested again if their squared residual is below this multiple of the threshold: beyond, the
# other measurements would have to be half as certain as the rejected one.
_NEAR = 4.0


def robust_minimum(
    equations: NormalEquations, start: Float[np.ndarray, "n 4 4"], uncertain: Bool[np.ndarray, "m"], max_iterations: int
) -> tuple[NormalEquations, Minimum, Float[np.ndarray, "m"]]:
    """The equations of the measurements that are kept, the minimum, and the weights of all measurements, 0 or 1."""
    found, limits = Minimum(start, equations.terms(start)), thresholds(equations)
    largest = (found.terms.squares / limits)[uncertain].max(initial=0)
    if not largest > 1:
        weights = np.ones(len(uncertain))
        return equations, minimize(equations, found, weights, max_iterations), weights
    control = 1 / (2 * largest - 1)
    while True:
        ratio = np.sqrt(limits / np.maximum(found.terms.squares, np.finfo(float).tiny))
        weights = np.where(uncertain, truncated_weights(ratio, control), 1)
        if np.all((weights == 0) | (weights == 1)):
            break
        equations = equations.restricted(weights > 0)
        found = minimize(equations, found, weights, 1)
        control *= _GROWTH
    selected = weights
    for _ in range(_SELECTIONS):
        weights, equations = selected, equations.restricted(selected > 0)
        found = minimize(equations, found, weights, max_iterations)
        selected = np.where(uncertain, 1.0 * (found.terms.squares <= limits), 1)
        selected[_wrongly_rejected(equations, found, weights)] = 1
        if np.array_equal(selected, weights):
            break
    return equations, found, weights


def thresholds(equations: NormalEquations) -> Float[np.ndarray, "m"]:
    """Squared Mahalanobis distances beyond which measurements are rejected: 99 % quantiles of χ²."""
    from scipy.special import chdtri

    sizes = [np.full(len(f.information), f.information.shape[-1]) for f in equations.factors]
    return chdtri(np.concatenate(sizes), _LEVEL)


def _wrongly_rejected(
    equations: NormalEquations, found: Minimum, weights: Float[np.ndarray, "m"]
) -> Int[np.ndarray, "k"]:
    """Rejected measurements whose residual is within the threshold, given the combined uncertainty of the measurement
    and of the remaining graph.
    """
    squares, limits = found.terms.squares, thresholds(equations)
    near = (weights == 0) & (squares > limits) & (squares <= _NEAR * limits)
    accepted = []
    values = (equations.split(each) for each in (equations.rows, near, limits))
    for factor, all_rows, chosen, all_limits in zip(equations.factors, *values, strict=True):
        within = np.zeros(len(chosen), bool)
        if chosen.any():
            part, rows = (
                jax.tree.map(lambda values, chosen=chosen: np.asarray(values)[chosen], factor),
                all_rows[chosen],
            )
            residuals, jacobians = part.linearize(found.poses[rows])
            spread = propagated(equations, found, weights, rows, jacobians)
            # rᵀ(Λ⁻¹ + Σ)⁻¹r without the inverse of Λ, which may be singular. An infinite Σ leaves 0.
            finite = np.isfinite(spread).all(axis=(1, 2))
            spread[~finite] = 0
            system = np.eye(spread.shape[-1]) + part.information @ spread
            inner = np.linalg.solve(system, part.information @ residuals[..., None])[..., 0]
            combined = np.where(finite, np.einsum("ki,ki->k", residuals, inner), 0)
            within[chosen] = combined <= all_limits[chosen]
        accepted.append(within)
    return np.flatnonzero(np.concatenate(accepted))
