"""The solver of pose graphs, on the host; NumPy and SciPy only, so that it may run inside callbacks.

Outliers among the uncertain measurements are rejected by graduated non-convexity: the first cost function is convex up
to the largest residual, and later ones approach the truncated squares min(r², c²) (Yang, Antonante, Tzoumas & Carlone,
RA-L 2020).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array

from mcgicp_jax._compute.concrete import AnyArray
from mcgicp_jax._math.poses import inverse, matrices_of, parameters_of
from mcgicp_jax._math.robust_kernels import truncated_weights
from mcgicp_jax._pose_graph import levenberg_marquardt as lm
from mcgicp_jax._pose_graph.edge import WORLD, Edge, Factors, motion_jacobians
from mcgicp_jax._pose_graph.graph import UNMEASURED
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
# Least fraction of the uncertain edges between two parts of a graph that must be kept, if nothing else joins the parts.
# After lost frames, wrong loops agree with each other where places look alike. Of simulated rounds through a town
# without 3 or 6 of 64 frames, 0.1 to 0.54 were kept at wrong poses, 0.67 to 1 at right ones.
_AGREEING = 0.6
# Rejected measurements are tested again if their squared residual is below this multiple of the threshold: beyond, the
# other measurements would have to be half as certain as the rejected one.
_NEAR = 4.0
# A direction of motion is unconstrained if its information is less than this multiple of the least damping.
_UNCONSTRAINED = 10.0
# Inverse iterations for the least constrained direction: unconstrained ones stand out by factors of 1e3 and more.
_INVERSE_ITERATIONS = 4
# Information of anchors, as a multiple of what leaks into unmeasured directions, and at most as a fraction of that of a
# typical edge: poses slide least in corridors with multiples of 30 to 100.
_OF_LEAK, _MOST = 30.0, 1e-2
# Weight of the anchors where poses settle. Poses in corridors slide by 0.49 m without, and by 0.12, 0.03 and 0.01 m
# with 1, 2 and 3; errors of a sphere that loops correct are 8.8 m without, and 7.8, 10.5 and 12.7 m.
_ANCHOR_WEIGHT = 2.0
# Largest number of steps from a minimum to one that is exact to rounding, each of which reduces the error by a factor
# of 10 or more, and the relative size of the last one.
_REFINEMENTS, _ROUNDING = 10, 1e-13
# Radians to which an edge knows the axes of its unmeasured directions at best: registrations in corridors, whose
# rotation is known to 0.2 mrad, differ by 2 mrad.
_AXES = 2e-3


class GraphPoses(NamedTuple):
    """The solution of a graph in the user's frame. Only poses have derivatives."""

    poses: Float[AnyArray, "n 4 4"]
    residuals: Float[AnyArray, "m"]
    weights: Float[AnyArray, "m"]
    cost: Float[AnyArray, ""]
    status: Int[AnyArray, ""]
    num_iterations: Int[AnyArray, ""]


def solve(
    start: lm.Poses, factors: Factors, robust: bool, max_iterations: int, exact: bool = False
) -> tuple[GraphPoses, lm.GraphState]:
    """Minimise ½ Σ w rᵀΛr, to rounding if `exact`; NumPy arrays. The poses of the state are centred."""
    # Overflow is a status.
    with np.errstate(over="ignore", invalid="ignore"):
        centred, factors, origin = _centred(start, factors)
        uncertain = np.concatenate([np.asarray(factor.uncertain) for factor in factors]) & robust
        anchors = _anchors(factors, centred)
        state = _minimum(centred, factors, anchors, uncertain, max_iterations)
        if not (np.isfinite(state.poses).all() and np.isfinite(state.terms.squares).all()):
            status = Status.NON_FINITE
        elif _is_degenerate(state, anchors) or _is_disputed(state, anchors, uncertain):
            status = Status.DEGENERATE
        else:
            status = Status.CONVERGED if state.converged else Status.MAX_ITERATIONS
        if exact and status == Status.CONVERGED:
            # By more Gauss-Newton steps: derivatives are only as exact as the poses.
            for _ in range(_REFINEMENTS):
                before, count = state.poses, state.num_iterations
                state = lm.minimize(state._replace(damping=lm.LEAST_DAMPING), 1)
                state = state._replace(num_iterations=count, converged=True)
                if np.abs(state.poses - before).max() <= _ROUNDING * np.abs(state.poses).max():
                    break
        poses = state.poses[: len(start)].copy()
        poses[:, :3, 3] += origin
        residuals, cost = np.sqrt(np.maximum(state.terms.squares, 0)), np.float64(state.cost)
        counts = np.int32(status), np.int32(state.num_iterations)
        return GraphPoses(poses, residuals, state.weights, cost, *counts), state


def covariances_at(poses: lm.Poses, factors: Factors, weights: lm.PerMeasurement) -> Float[np.ndarray, "n 6 6"]:
    with np.errstate(over="ignore", invalid="ignore"):
        centred, factors, _ = _centred(poses, factors)
        return uncertainty(lm.GraphState.at(factors, weights, centred))[: len(poses)]


def uncertainty(state: lm.GraphState) -> Float[np.ndarray, "n 6 6"]:
    """Covariances of the poses. Information that leaks into unmeasured directions (see `_anchors`) does not count.

    For a degenerate graph they are (H + E)⁻¹ + 2 ε/λ ((H + E)⁻¹ − (H + 2E)⁻¹), with the information E of anchors, of
    relative size ε, and the least damping λ: 1/λ where H is far less than E, H⁻¹ where E is 0.
    """
    factors = state.equations.factors
    anchors = _anchors(factors, state.poses)
    if not (anchors.information.any() and _is_degenerate(state, anchors)):
        return pose_covariances(state)
    accepted = state.weights[: len(anchors)] > 0
    weights = np.append(state.weights, 1.0 * accepted)
    single = lm.GraphState.at((*factors, anchors), weights, state.poses)
    double = single._replace(weights=np.append(state.weights, 2.0 * accepted))
    with_single, with_double = pose_covariances(single), pose_covariances(double)
    fraction = _anchor_information(lm.typical_information(factors)[: len(anchors)])[anchors.i != WORLD][0]
    difference = np.zeros_like(with_single)
    np.subtract(with_single, with_double, out=difference, where=np.isfinite(with_single))
    return with_single + 2 * fraction / lm.LEAST_DAMPING * difference


def _anchors(factors: Factors, poses: lm.Poses) -> Edge:
    """Edges between the same poses as the given ones that measure the motions at `poses` along unmeasured directions.

    The axes of an edge are known only to its standard deviation σ of rotation, in radians, and at best to 2 mrad: a
    fraction σ² of its information leaks into the directions that it does not measure. Poses would slide along these by
    many metres to explain the noise in the others. Priors get no anchor, since the world's axes are exact.
    """
    edges = factors[0]
    typical = lm.typical_information(factors)[: len(edges)]
    between, roots = edges.i != WORLD, np.sqrt(typical)
    i = np.where(between, edges.i, edges.j)
    eigenvalues, vectors = np.linalg.eigh(np.nan_to_num(edges.information) / (roots[:, :, None] * roots[:, None]))
    unmeasured = between[:, None] & (eigenvalues <= UNMEASURED * eigenvalues[:, -1:])
    scaled = roots[:, :, None] * vectors
    information = (scaled * (unmeasured * _anchor_information(typical)[:, None])[:, None]) @ scaled.swapaxes(1, 2)
    return Edge(edges.i, edges.j, inverse(poses[i]) @ poses[edges.j], information)


def _anchor_information(typical: Float[np.ndarray, "m 6"]) -> Float[np.ndarray, "m"]:
    """As a fraction of that of a typical edge."""
    return np.minimum(_OF_LEAK * np.maximum(1 / typical[:, 5], _AXES**2), _MOST)


def _centred(poses: lm.Poses, factors: Factors) -> tuple[Float[np.ndarray, "_ 4 4"], Factors, Float[np.ndarray, "3"]]:
    """Exact rigid poses and edges relative to an origin, the median of the priors or else the first position.

    At UTM coordinates, rounding would hide differences of the cost next to the minimum. With measurements of other
    kinds, which may depend on the origin, it is 0. With any in the world's frame, the pose of the world is appended.
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
    edges = Edge(edges.i, edges.j, motions, edges.information, uncertain=edges.uncertain)
    return poses, (edges, *others), origin


def _rigid(matrices: np.ndarray) -> Float[np.ndarray, "_ 4 4"]:
    """The matrices in float64 with exact rotations (float32 has seven digits); NaN stays."""
    matrices = np.array(matrices, np.float64)
    finite = np.isfinite(matrices).all(axis=(1, 2))
    matrices[finite] = matrices_of(parameters_of(matrices[finite]))
    return matrices


def _minimum(poses: lm.Poses, factors: Factors, anchors: Edge, uncertain: lm.Mask, limit: int) -> lm.GraphState:
    """`_robust_minimum`, with `anchors` if edges have unmeasured directions and the others do not constrain these.

    The drift that noise causes along such directions is then undone. Anchors have information ε there, and the
    measurements leak information μ, so they would weigh μ/ε against anchors. If ε is imaginary, the real part of the
    step is −(μg + ε²b)/(μ² + ε²), for gradients g of the measurements and εb of the anchors: at its root, measurements
    weigh (μ/ε)². Along measured directions, anchors weigh at most (ε/μ)².
    """
    if not anchors.information.any():
        return _robust_minimum(factors, poses, uncertain, limit)
    anchored = _robust_minimum((*factors, anchors), poses, np.append(uncertain, anchors.uncertain), limit)
    state = lm.GraphState.at(factors, anchored.weights[: len(uncertain)], anchored.poses, poses)
    state = state._replace(num_iterations=anchored.num_iterations, damping=anchored.damping)
    if not _is_degenerate(state, anchors):
        return lm.minimize(state, limit)
    if not anchored.converged:
        return state
    equations, last = anchored.equations, np.inf
    is_anchor = np.arange(len(anchored.weights)) >= len(uncertain)
    measured, anchoring = anchored.weights * ~is_anchor, _ANCHOR_WEIGHT * is_anchor
    for _ in range(_REFINEMENTS):
        system = equations.matrix(anchored.terms.blocks, measured + 1j * anchoring)
        gradient = equations.gradient(anchored.terms, measured) + 1j * equations.gradient(anchored.terms, anchoring)
        step = -lm.factored(equations.damped(system)).solve(gradient).real
        largest = np.abs(step).max()
        # The steps have reached rounding, or do not contract.
        if not largest < last:
            break
        anchored, last = anchored.moved(step), largest
    return state._replace(poses=anchored.poses, terms=state.equations.terms(anchored.poses), converged=True)


def _robust_minimum(factors: Factors, start: lm.Poses, uncertain: lm.Mask, limit: int) -> lm.GraphState:
    """The minimum over the kept measurements, whose weight is 1; rejected ones have the weight 0."""
    from scipy.special import chdtri

    state = lm.GraphState.at(factors, np.ones(len(uncertain)), start)
    sizes = [np.full(len(factor.information), factor.information.shape[-1]) for factor in factors]
    thresholds = chdtri(np.concatenate(sizes), _LEVEL)
    largest = (state.terms.squares / thresholds)[uncertain].max(initial=0)
    if not largest > 1:
        return lm.minimize(state, limit)
    control = 1 / (2 * largest - 1)
    while True:
        ratio = np.sqrt(thresholds / np.maximum(state.terms.squares, np.finfo(float).tiny))
        weights = np.where(uncertain, truncated_weights(ratio, control), 1)
        if np.all((weights == 0) | (weights == 1)):
            break
        state = lm.minimize(state.weighted(weights), 1)
        control *= _GROWTH
    for _ in range(_SELECTIONS):
        state = lm.minimize(state.weighted(weights), limit)
        weights = np.where(uncertain, 1.0 * (state.terms.squares <= thresholds), 1)
        weights[_wrongly_rejected(state, thresholds)] = 1
        if np.array_equal(weights, state.weights):
            break
    return state


def _wrongly_rejected(state: lm.GraphState, thresholds: lm.PerMeasurement) -> lm.Mask:
    """Which rejected measurements pass the threshold given their uncertainty and that of the remaining graph."""
    squares, equations = state.terms.squares, state.equations
    wrong = (state.weights == 0) & (squares > thresholds) & (squares <= _NEAR * thresholds)
    by_factor = map(equations.split, (equations.rows, wrong, thresholds))
    for factor, rows, tested, factor_thresholds in zip(equations.factors, *by_factor, strict=True):
        if not tested.any():
            continue
        measurements = jax.tree.map(lambda values, tested=tested: np.asarray(values)[tested], factor)
        residuals, jacobians = measurements.linearize(state.poses[rows[tested]])
        covariances = propagated(state, rows[tested], jacobians)
        # rᵀ(Λ⁻¹ + Σ)⁻¹r without the inverse of Λ, which may be singular; 0 if Σ is infinite.
        finite = np.isfinite(covariances).all(axis=(1, 2))
        covariances[~finite] = 0
        system = np.eye(covariances.shape[-1]) + measurements.information @ covariances
        inner = np.linalg.solve(system, measurements.information @ residuals[..., None])[..., 0]
        combined = np.where(finite, np.einsum("ki,ki->k", residuals, inner), 0)
        # `tested` is a view of `wrong`.
        tested[tested] = combined <= factor_thresholds[tested]
    return wrong


def _is_disputed(state: lm.GraphState, anchors: Edge, uncertain: lm.Mask) -> bool:
    """Whether uncertain edges, of which too many are rejected, join two parts of a graph that nothing else joins."""
    from scipy.sparse.csgraph import connected_components

    if state.weights.all():
        return False
    factors, rows, size, number = state.equations.factors, state.equations.rows, len(state.poses), len(anchors)

    def components(pairs: Int[np.ndarray, "_ 2"]) -> Int[np.ndarray, "n"]:
        graph = coo_array((np.ones(len(pairs)), tuple(pairs.T)), (size, size))
        return connected_components(graph, directed=False)[1]

    # Certain measurements of all six directions.
    joining = np.concatenate([np.linalg.matrix_rank(factor.information, hermitian=True) >= 6 for factor in factors])
    joining &= ~uncertain
    joining[:number] &= ~anchors.information.any(axis=(1, 2))
    ends = np.sort(components(rows[joining])[rows[:number]], axis=1)
    between = uncertain[:number] & (ends[:, 0] != ends[:, 1])
    keys, numbers = np.unique(ends[between] @ [size, 1], return_inverse=True)
    pairs = np.stack(np.divmod(keys, size), axis=1)
    num_accepted, total = np.bincount(numbers, state.weights[:number][between], len(pairs)), np.bincount(numbers)
    joined = components(pairs[num_accepted >= _AGREEING * total])
    if not np.any((num_accepted > 0) & (joined[pairs[:, 0]] != joined[pairs[:, 1]])):
        return False
    # Certain measurements of some directions, such as positions of all poses, may suffice together.
    return _is_degenerate(lm.GraphState.at(factors, 1.0 * ~uncertain, state.poses), anchors)


def _is_degenerate(state: lm.GraphState, anchors: Edge) -> bool:
    """Whether poses are not connected, or H along some direction is less than that of `anchors` or than the least
    damping (that of the last step may be too large to tell)."""
    equations = state.equations
    if np.any(equations.parts != equations.parts[equations.root]):
        return True
    if not equations.size:
        return False
    hessian, blocks, number = state.hessian, np.zeros_like(state.terms.blocks), len(anchors)
    jacobians = motion_jacobians(state.poses[equations.rows[:number]])
    blocks[:number] = lm.normal_blocks(jacobians, np.asarray(anchors.information)) / _UNCONSTRAINED
    least = equations.damped(equations.matrix(blocks, state.weights))
    try:
        solver = lm.factored(hessian + least)
    except RuntimeError:
        return True
    direction = np.random.default_rng(0).normal(size=equations.size)
    for _ in range(_INVERSE_ITERATIONS):
        force = least @ direction
        direction = solver.solve(force / np.sqrt(direction @ force))
    return bool(direction @ (hessian @ direction) < _UNCONSTRAINED * (direction @ (least @ direction)))
