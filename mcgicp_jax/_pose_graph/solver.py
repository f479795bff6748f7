"""The solver of pose graphs, on the host; NumPy and SciPy only, so that it may run inside callbacks.

Outliers among the uncertain measurements are rejected by graduated non-convexity: truncated squares min(r², c²) are
approached from a function whose convex part contains the largest residual (Yang, Antonante, Tzoumas & Carlone, RA-L
2020).
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._math.poses import matrices_of, parameters_of
from mcgicp_jax._math.robust_kernels import truncated_weights
from mcgicp_jax._pose_graph.edge import WORLD, Edge, motion_jacobians
from mcgicp_jax._pose_graph.graph import unmeasured
from mcgicp_jax._pose_graph.levenberg_marquardt import (
    Minimum,
    NormalEquations,
    PerMeasurement,
    Poses,
    factored,
    minimize,
    normal_blocks,
    refine,
    settle,
    typical_information,
)
from mcgicp_jax._pose_graph.marginal_covariances import pose_covariances, propagated
from mcgicp_jax._registration.result import Status

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
# A direction of motion is unconstrained if its information is less than this multiple of the least damping.
_UNCONSTRAINED = 10.0
# Inverse iterations for the least constrained direction: unconstrained ones stand out by factors of 1e3 and more.
_INVERSE_ITERATIONS = 4

# All measurements of a graph by kind, `AbstractFactor`s; the first are the edges.
Factors: TypeAlias = tuple[Any, ...]


def robust_minimum(
    equations: NormalEquations, start: Poses, uncertain: Bool[np.ndarray, "m"], max_iterations: int
) -> tuple[NormalEquations, Minimum, PerMeasurement]:
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


def thresholds(equations: NormalEquations) -> PerMeasurement:
    """Squared Mahalanobis distances beyond which measurements are rejected: 99 % quantiles of χ²."""
    from scipy.special import chdtri

    sizes = [np.full(len(f.information), f.information.shape[-1]) for f in equations.factors]
    return chdtri(np.concatenate(sizes), _LEVEL)


def _wrongly_rejected(equations: NormalEquations, found: Minimum, weights: PerMeasurement) -> Int[np.ndarray, "k"]:
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


class Solution(NamedTuple):
    """The solution of a graph.

    Attributes:
        equations: of the measurements that are kept.
        found: the minimum, in the world whose origin is `origin`.
        weights: 1 for the measurements that are kept, 0 for the others.
        origin: metres.
        status: CONVERGED, MAX_ITERATIONS, DEGENERATE or NON_FINITE.
        cost: ½ Σ w rᵀΛr.
    """

    equations: NormalEquations
    found: Minimum
    weights: PerMeasurement
    origin: Float[np.ndarray, "3"]
    status: Status
    cost: float

    @property
    def residuals(self) -> PerMeasurement:
        """√(rᵀΛr) of every measurement."""
        return np.sqrt(np.maximum(self.found.terms.squares, 0))

    def poses(self, number: int) -> Float[np.ndarray, "number 4 4"]:
        """The poses of the graph, without that of the world."""
        poses = self.found.poses[:number].copy()
        poses[:, :3, 3] += self.origin
        return poses

    def covariances(self, number: int) -> Float[np.ndarray, "number 6 6"]:
        """The covariances of the poses of the graph."""
        return pose_covariances(self.equations, self.found, self.weights)[:number]


def solve(poses: Poses, factors: Factors, robust: bool, max_iterations: int, exact: bool = False) -> Solution:
    """Minimise ½ Σ w rᵀΛr from the given poses, to rounding if `exact`; all arrays are NumPy's."""
    # Overflow is a status.
    with np.errstate(over="ignore", invalid="ignore"):
        poses, factors, origin = _centred(poses, factors)
        uncertain = np.concatenate([np.asarray(factor.uncertain) for factor in factors]) & robust
        anchors = unmeasured(factors[0], poses, typical_information(*factors)[: len(factors[0])])
        equations, found, weights = _minimum(poses, factors, anchors, uncertain, max_iterations)
        status = _status(equations, found, weights, anchors)
        if exact and status == Status.CONVERGED:
            found = refine(equations, found, weights)
        return Solution(equations, found, weights, origin, status, found.terms.cost(weights))


def _minimum(
    poses: Poses, factors: Factors, anchors: Edge, uncertain: Bool[np.ndarray, "m"], limit: int
) -> tuple[NormalEquations, Minimum, PerMeasurement]:
    """`robust_minimum`; with `anchors`, edges to the start, if the measurements do not constrain all poses alone."""
    if not anchors.information.any():
        return robust_minimum(NormalEquations(factors, poses), poses, uncertain, limit)
    both = NormalEquations((*factors, anchors), poses)
    both, first, all_weights = robust_minimum(both, poses, np.append(uncertain, anchors.uncertain), limit)
    weights = all_weights[: len(uncertain)]
    equations = NormalEquations(factors, poses, weights > 0)
    found = first._replace(terms=equations.terms(first.poses))
    if not _is_degenerate(equations, found, weights, anchors):
        found = minimize(equations, found, weights, limit)
    elif first.converged:
        settled = settle(both, first, all_weights, np.arange(len(all_weights)) >= len(uncertain)).poses
        found = found._replace(poses=settled, terms=equations.terms(settled))
    return equations, found, weights


def covariances_at(poses: Poses, factors: Factors, weights: PerMeasurement) -> Float[np.ndarray, "n 6 6"]:
    """`Solution.covariances` of a solution that is known."""
    with np.errstate(over="ignore", invalid="ignore"):
        centred, factors, _ = _centred(poses, factors)
        equations = NormalEquations(factors, centred, weights > 0)
        found = Minimum(centred, equations.terms(centred))
        return pose_covariances(equations, found, weights)[: len(poses)]


def _centred(poses: Poses, factors: Factors) -> tuple[Float[np.ndarray, "_ 4 4"], Factors, Float[np.ndarray, "3"]]:
    """Exact rigid poses and edges about another origin of the world, and that origin.

    It is the first position or, with priors, their median: at UTM coordinates, 1e-9 m are lost to rounding, and costs
    next to the minimum could not be told apart. Measurements of other kinds may depend on the origin, which then stays.
    If there are measurements in the world's frame, the pose of the world is appended.
    """
    edges, others = factors[0], factors[1:]
    poses, motions = _rigid(poses), _rigid(edges.T_i_j)
    of_world = np.asarray(edges.i) == WORLD
    origin = np.zeros(3)
    if not others:
        origin = np.median(motions[of_world, :3, 3] if of_world.any() else poses[:1, :3, 3], axis=0)
    poses[:, :3, 3] -= origin
    motions[of_world, :3, 3] -= origin
    if any(np.any(np.asarray(factor.rows) == WORLD) for factor in factors):
        poses = np.concatenate([poses, np.eye(4)[None]])
    information = np.asarray(edges.information, np.float64)
    return poses, (Edge(edges.i, edges.j, motions, information, uncertain=edges.uncertain), *others), origin


def _rigid(matrices: np.ndarray) -> Float[np.ndarray, "_ 4 4"]:
    """The matrices in float64 with exact rotations, of which float32 has seven digits; NaN stays."""
    matrices = np.array(matrices, np.float64)
    finite = np.isfinite(matrices).all(axis=(1, 2))
    matrices[finite] = matrices_of(parameters_of(matrices[finite]))
    return matrices


def _status(equations: NormalEquations, found: Minimum, weights: PerMeasurement, anchors: Edge) -> Status:
    if not (np.isfinite(found.poses).all() and np.isfinite(found.terms.squares).all()):
        return Status.NON_FINITE
    if _is_degenerate(equations, found, weights, anchors):
        return Status.DEGENERATE
    return Status.CONVERGED if found.converged else Status.MAX_ITERATIONS


def _is_degenerate(equations: NormalEquations, found: Minimum, weights: PerMeasurement, anchors: Edge) -> bool:
    """Whether poses are not connected, or H along some direction is less than that of `anchors`, or than damping.

    By inverse iteration with the least damping: that of the last step may be too large to tell.
    """
    if np.any(equations.parts != equations.parts[equations.root]):
        return True
    if not equations.size:
        return False
    matrix = equations.weighted(found.terms.blocks, weights)
    blocks = np.zeros_like(found.terms.blocks)
    ends = found.poses[equations.rows[: len(anchors)]]
    blocks[: len(anchors)] = normal_blocks(motion_jacobians(ends), np.asarray(anchors.information)) / _UNCONSTRAINED
    least = equations.damped(equations.weighted(blocks, weights))
    try:
        factors = factored(matrix + least)
    except RuntimeError:
        return True
    vector = np.random.default_rng(0).normal(size=equations.size)
    for _ in range(_INVERSE_ITERATIONS):
        pushed = least @ vector
        vector = factors.solve(pushed / np.sqrt(vector @ pushed))
    return bool(vector @ (matrix @ vector) < _UNCONSTRAINED * (vector @ (least @ vector)))
