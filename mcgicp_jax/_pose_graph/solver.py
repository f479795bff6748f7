"""The solver of pose graphs, on the host; NumPy and SciPy only, so that it may run inside callbacks.

Outliers among the uncertain measurements are rejected by graduated non-convexity: truncated squares min(r², c²) are
approached from a function whose convex part contains the largest residual (Yang, Antonante, Tzoumas & Carlone, RA-L
2020).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._compute.concrete import AnyArray
from mcgicp_jax._math.poses import matrices_of, parameters_of
from mcgicp_jax._math.robust_kernels import truncated_weights
from mcgicp_jax._pose_graph.edge import WORLD, Edge, Factors, motion_jacobians
from mcgicp_jax._pose_graph.graph import about_start, unmeasured
from mcgicp_jax._pose_graph.levenberg_marquardt import (
    LEAST_DAMPING,
    GraphState,
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

# Probability that a true measurement exceeds the threshold on its squared Mahalanobis distance, a quantile of χ².
_LEVEL = 0.01
# Factor by which the non-convexity grows, with one step at each: 1.4 (Yang et al. 2020) keeps the same loops, 4 loses
# 0.4 % of the true ones (ten grids, 30 % of false loops). Without the first steps, errors are 30 times as large in a
# garage of 1,600 poses.
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


class GraphPoses(NamedTuple):
    """The solution of a graph in the user's frame. Only poses have derivatives."""

    poses: Float[AnyArray, "n 4 4"]
    residuals: Float[AnyArray, "m"]
    weights: Float[AnyArray, "m"]
    cost: Float[AnyArray, ""]
    status: Int[AnyArray, ""]
    num_iterations: Int[AnyArray, ""]


def solve(
    start: Poses, factors: Factors, robust: bool, max_iterations: int, exact: bool = False
) -> tuple[GraphPoses, GraphState]:
    """Minimise ½ Σ w rᵀΛr, to rounding if `exact`; NumPy arrays. The state refers to another origin of the world."""
    # Overflow is a status.
    with np.errstate(over="ignore", invalid="ignore"):
        centred, factors, origin = _centred(start, factors)
        uncertain = np.concatenate([np.asarray(factor.uncertain) for factor in factors]) & robust
        anchors = unmeasured(factors, centred)
        state = _minimum(centred, factors, anchors, uncertain, max_iterations)
        if not (np.isfinite(state.poses).all() and np.isfinite(state.terms.squares).all()):
            status = Status.NON_FINITE
        elif _is_degenerate(state, anchors):
            status = Status.DEGENERATE
        else:
            status = Status.CONVERGED if state.converged else Status.MAX_ITERATIONS
        if exact and status == Status.CONVERGED:
            state = refine(state)
        poses = state.poses[: len(start)].copy()
        poses[:, :3, 3] += origin
        residuals, cost = np.sqrt(np.maximum(state.terms.squares, 0)), np.float64(state.cost)
        counts = np.int32(status), np.int32(state.num_iterations)
        return GraphPoses(poses, residuals, state.weights, cost, *counts), state


def covariances_at(poses: Poses, factors: Factors, weights: PerMeasurement) -> Float[np.ndarray, "n 6 6"]:
    """The covariances of the poses at a minimum that is known."""
    with np.errstate(over="ignore", invalid="ignore"):
        centred, factors, _ = _centred(poses, factors)
        equations = NormalEquations(factors, centred, weights > 0)
        return uncertainty(GraphState.at(equations, weights, centred))[: len(poses)]


def uncertainty(state: GraphState) -> Float[np.ndarray, "n 6 6"]:
    """Covariances of the poses. Information that leaks into unmeasured directions (see `unmeasured`) does not count.

    For a degenerate graph they are (H + E)⁻¹ + 2 ε/λ ((H + E)⁻¹ − (H + 2E)⁻¹), with information E of relative size ε
    along the unmeasured directions alone, and the least damping λ: 1/λ where H is far less than E, H⁻¹ where E is 0.
    """
    factors = state.equations.factors
    anchors = unmeasured(factors, state.poses)
    if not (anchors.information.any() and _is_degenerate(state, anchors)):
        return pose_covariances(state)
    equations, accepted = NormalEquations((*factors, anchors), state.poses), state.weights[: len(anchors)] > 0
    weights = [np.append(state.weights, times * accepted) for times in (1.0, 2.0)]
    once, twice = (pose_covariances(GraphState.at(equations, w, state.poses)) for w in weights)
    share = about_start(typical_information(factors)[: len(anchors)])[anchors.i != WORLD][0]
    difference = np.subtract(once, twice, out=np.zeros_like(once), where=np.isfinite(once))
    return once + 2 * share / LEAST_DAMPING * difference


def _centred(poses: Poses, factors: Factors) -> tuple[Float[np.ndarray, "_ 4 4"], Factors, Float[np.ndarray, "3"]]:
    """Exact rigid poses and edges about the first position or the median of the priors, and that origin.

    At UTM coordinates, rounding would hide differences of the cost next to the minimum. Measurements of other kinds may
    depend on the origin, which then stays. With measurements in the world's frame, the pose of the world is appended.
    """
    edges, *others = factors
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


def _minimum(poses: Poses, factors: Factors, anchors: Edge, uncertain: Bool[np.ndarray, "m"], limit: int) -> GraphState:
    """`_robust_minimum`; with `anchors`, edges to the start, if the measurements do not constrain all poses alone."""
    if not anchors.information.any():
        return _robust_minimum(NormalEquations(factors, poses), poses, uncertain, limit)
    with_anchors = NormalEquations((*factors, anchors), poses)
    anchored = _robust_minimum(with_anchors, poses, np.append(uncertain, anchors.uncertain), limit)
    weights = anchored.weights[: len(uncertain)]
    state = GraphState.at(NormalEquations(factors, poses, weights > 0), weights, anchored.poses)
    state = state._replace(num_iterations=anchored.num_iterations, damping=anchored.damping)
    if not _is_degenerate(state, anchors):
        return minimize(state, limit)
    if anchored.converged:
        settled = settle(anchored, np.arange(len(with_anchors.rows)) >= len(uncertain))
        state = state._replace(poses=settled, terms=state.equations.terms(settled), converged=True)
    return state


def _robust_minimum(
    equations: NormalEquations, start: Poses, uncertain: Bool[np.ndarray, "m"], max_iterations: int
) -> GraphState:
    """The minimum over the measurements that are kept, whose weight is 1; that of the others is 0."""
    from scipy.special import chdtri

    state = GraphState.at(equations, np.ones(len(uncertain)), start)
    sizes = [np.full(len(factor.information), factor.information.shape[-1]) for factor in equations.factors]
    limits = chdtri(np.concatenate(sizes), _LEVEL)
    largest = (state.terms.squares / limits)[uncertain].max(initial=0)
    if not largest > 1:
        return minimize(state, max_iterations)
    control = 1 / (2 * largest - 1)
    while True:
        ratio = np.sqrt(limits / np.maximum(state.terms.squares, np.finfo(float).tiny))
        weights = np.where(uncertain, truncated_weights(ratio, control), 1)
        if np.all((weights == 0) | (weights == 1)):
            break
        state = minimize(state.weighted(weights), 1)
        control *= _GROWTH
    for _ in range(_SELECTIONS):
        state = minimize(state.weighted(weights), max_iterations)
        weights = np.where(uncertain, 1.0 * (state.terms.squares <= limits), 1)
        weights[_wrongly_rejected(state, limits)] = 1
        if np.array_equal(weights, state.weights):
            break
    return state


def _wrongly_rejected(state: GraphState, limits: PerMeasurement) -> Bool[np.ndarray, "m"]:
    """Which rejected measurements have a residual within the threshold, given the combined uncertainty of the
    measurement and of the remaining graph."""
    squares, equations = state.terms.squares, state.equations
    wrong = (state.weights == 0) & (squares > limits) & (squares <= _NEAR * limits)
    of_kinds = map(equations.split, (equations.rows, wrong, limits))
    for factor, rows, tested, factor_limits in zip(equations.factors, *of_kinds, strict=True):
        if not tested.any():
            continue
        measurements = jax.tree.map(lambda values, tested=tested: np.asarray(values)[tested], factor)
        residuals, jacobians = measurements.linearize(state.poses[rows[tested]])
        covariances = propagated(state, rows[tested], jacobians)
        # rᵀ(Λ⁻¹ + Σ)⁻¹r without the inverse of Λ, which may be singular. An infinite Σ leaves 0.
        finite = np.isfinite(covariances).all(axis=(1, 2))
        covariances[~finite] = 0
        system = np.eye(covariances.shape[-1]) + measurements.information @ covariances
        inner = np.linalg.solve(system, measurements.information @ residuals[..., None])[..., 0]
        combined = np.where(finite, np.einsum("ki,ki->k", residuals, inner), 0)
        # A view of `wrong`.
        tested[tested] = combined <= factor_limits[tested]
    return wrong


def _is_degenerate(state: GraphState, anchors: Edge) -> bool:
    """Whether poses are not connected, or H along some direction is less than that of `anchors`, or than damping.

    By inverse iteration with the least damping: that of the last step may be too large to tell.
    """
    equations = state.equations
    if np.any(equations.parts != equations.parts[equations.root]):
        return True
    if not equations.size:
        return False
    hessian, blocks, number = state.hessian, np.zeros_like(state.terms.blocks), len(anchors)
    jacobians = motion_jacobians(state.poses[equations.rows[:number]])
    blocks[:number] = normal_blocks(jacobians, np.asarray(anchors.information)) / _UNCONSTRAINED
    least = equations.damped(equations.weighted(blocks, state.weights))
    try:
        solver = factored(hessian + least)
    except RuntimeError:
        return True
    direction = np.random.default_rng(0).normal(size=equations.size)
    for _ in range(_INVERSE_ITERATIONS):
        force = least @ direction
        direction = solver.solve(force / np.sqrt(direction @ force))
    return bool(direction @ (hessian @ direction) < _UNCONSTRAINED * (direction @ (least @ direction)))
