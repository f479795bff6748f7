"""Levenberg-Marquardt on pose graphs of any size, on the host.

optimistix solves for its steps inside a compiled program, which cannot contain a factorisation on the host and would be
compiled for every graph; so the loop is written out here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mcgicp_jax._math.poses import exponential
from mcgicp_jax._pose_graph.normal_equations import LEAST_DAMPING, NormalEquations, Terms, factored

# Damping, as a fraction of the information of a typical edge: at the start, the factor by which it changes, and the
# largest one, beyond which the loop ends.
_START_DAMPING, _DAMPING_FACTOR, _MOST_DAMPING = 1e-4, 10.0, 1e12
# A step is the last one if it lowers the cost by less than this fraction, as predicted. Next to the minimum of noisy
# graphs a step was seen to lower it by 1e-2 to 1e-3 of the previous decrease: the cost is then right to 1e-8.
_TOLERANCE = 1e-6
# The same in σ², for graphs without contradiction: a step of a millionth of a standard deviation.
_LEAST_DECREASE = 1e-12
# Largest number of steps of `refine`, each of which reduces the error by a factor of 10 or more, and the relative size
# of the last one.
_REFINEMENTS, _ROUNDING = 10, 1e-13
# Weight of the measurements of the start in `settle`. From an exact start, poses in corridors slide by up to 0.49 m
# without `settle`, and by 0.12, 0.03 and 0.01 m with weights of 1, 2 and 3. More holds back what loops measure: on a
# sphere started from odometry, with edges that know nothing of x, errors are 8.8 m without, and 7.8, 10.5 and 12.7 m.
_START_WEIGHT = 2.0


class Minimum(NamedTuple):
    """State at the end of the loop.

    Attributes:
        poses: those of the graph and, with measurements in the world's frame, the world's.
        terms: of all measurements at these poses.
        num_iterations: number of steps, rejected ones included.
        converged: whether the last step was small.
        damping: λ for a next step.
    """

    poses: Float[np.ndarray, "n 4 4"]
    terms: Terms
    num_iterations: int = 0
    converged: bool = False
    damping: float = _START_DAMPING


def minimize(
    equations: NormalEquations, start: Minimum, weights: Float[np.ndarray, "m"], max_iterations: int
) -> Minimum:
    """Lower ½ Σ w rᵀΛr by Levenberg-Marquardt steps until one lowers it by no more than tolerance and rounding.

    The weights of measurements that are not in use are 0.
    """
    poses, terms, count, _, damping = start
    cost, system = terms.cost(weights), None
    end = count + max_iterations
    if not equations.size:
        return start._replace(converged=True)
    while count < end and damping < _MOST_DAMPING and np.isfinite(cost):
        if system is None:
            gradient, system = equations.gradient(terms, weights), equations.weighted(terms.blocks, weights)
        count += 1
        try:
            step = -factored(equations.damped(system, damping)).solve(gradient)
        except RuntimeError:
            damping *= _DAMPING_FACTOR
            continue
        decrease = -0.5 * float(gradient @ step)
        trial = poses @ exponential(equations.spread(step))
        there = equations.terms(trial)
        after = there.cost(weights)
        small = decrease <= _TOLERANCE * cost + _LEAST_DECREASE
        # Rounding decides whether the computed cost becomes lower by so little.
        if after <= cost * (1 + (_TOLERANCE if small else 1e-14)) + _LEAST_DECREASE:
            poses, terms, cost, system = trial, there, after, None
            damping = max(damping / _DAMPING_FACTOR, LEAST_DAMPING)
            if small:
                return Minimum(poses, terms, count, True, damping)
        else:
            damping *= _DAMPING_FACTOR
    return Minimum(poses, terms, count, False, damping)


def refine(equations: NormalEquations, found: Minimum, weights: Float[np.ndarray, "m"]) -> Minimum:
    """The minimum to rounding, by more Gauss-Newton steps: derivatives are as exact as the poses."""
    for _ in range(_REFINEMENTS):
        after = minimize(equations, found._replace(damping=LEAST_DAMPING), weights, 1)
        step = np.abs(after.poses - found.poses).max()
        found = after._replace(num_iterations=found.num_iterations, converged=True)
        if step <= _ROUNDING * np.abs(found.poses).max():
            break
    return found


def settle(
    equations: NormalEquations, found: Minimum, weights: Float[np.ndarray, "m"], start: Bool[np.ndarray, "m"]
) -> Minimum:
    """Take back what noise has moved along directions that only the measurements of the `start` constrain.

    Against these, measurements that leak information μ there would weigh μ/ε, with ε that of the start. If ε is
    imaginary, the real part of the step is −(μg + ε²b)/(μ² + ε²), for gradients g and εb of both: where it vanishes,
    they weigh (μ/ε)², and the start weighs no more than (ε/μ)² along the directions that are measured.
    """
    size, started = np.inf, _START_WEIGHT * start
    for _ in range(_REFINEMENTS):
        system = equations.weighted(found.terms.blocks, weights * ~start + 1j * started)
        gradient = equations.gradient(found.terms, weights * ~start) + 1j * equations.gradient(found.terms, started)
        step = -factored(equations.damped(system)).solve(gradient).real
        # Rounding, or no contraction.
        if not np.abs(step).max() < size:
            break
        size = np.abs(step).max()
        poses = found.poses @ exponential(equations.spread(step))
        found = found._replace(poses=poses, terms=equations.terms(poses))
    return found
