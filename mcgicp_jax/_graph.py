"""Optimisation of pose graphs: least squares over all edges, with false loops rejected."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._checks import check_integer
from mcgicp_jax._deferred import Deferred
from mcgicp_jax._graph_traced import optimize_traced
from mcgicp_jax._normal_equations import (
    UNCONSTRAINED,
    Minimum,
    NormalEquations,
    factored,
    minimize,
    relative_twists,
)
from mcgicp_jax._pose import is_concrete, matrices_of, parameters_of
from mcgicp_jax._pose_graph import WORLD, Edge, PoseGraph
from mcgicp_jax._result import Status
from mcgicp_jax._sparse_inverse import inverse_blocks

# Squared Mahalanobis distance beyond which a loop is rejected: the 99 % quantile of χ² with six degrees of freedom.
LARGEST_SQUARE = 16.811893829770927
# Factor by which the non-convexity grows, with one step at each. In ten grids with 30 % of false loops, 1.4
# (Yang et al. 2020) keeps the same loops; with 4, 0.4 % of the true loops more are lost. The first steps cannot be
# left out: if the non-convexity begins 32 times as large, errors grow by a factor of 30 in the garage of 1,600 poses.
_GROWTH = 2.0
# During the graduation, loops of less weight need not take part in the factorisation, see `minimize`.
_CORE = 0.5
# Largest number of times that the loops are chosen anew at the minimum, which ends when the choice repeats itself.
_CHOICES = 5
# Rejected loops are looked at again if their squared residual is below this multiple of the threshold: other edges
# alone would have to know the motion half as well as the loop.
_NEAR = 4.0
# Inverse iterations for the least constrained direction: unconstrained ones stand out by factors of 1e3 and more.
_INVERSE_ITERATIONS = 4


class PoseGraphResult(eqx.Module):
    """Result of `optimize_poses`; a pytree.

    Attributes:
        poses: (n, 4, 4), sensor to world, metres; without priors, the first one is that of the graph.
        edges: the m edges of the graph, rejected ones included.
        status_code: integer value of `status`.
        num_iterations: number of Levenberg-Marquardt steps.
        cost: ½ Σ w rᵀΛr, with r = log(T_i_j⁻¹ T_i⁻¹ T_j), the information Λ of each edge, and w = `weights`.
        residuals: (m,) √(rᵀΛr), the Mahalanobis distance of each edge, in standard deviations.
        weights: (m,) 1 for edges that were used and 0 for loops that were rejected.
        uncertainty: deferred value of `covariance`.
    """

    poses: Float[Array, "n 4 4"] | Float[np.ndarray, "n 4 4"]
    edges: Edge
    status_code: Int[ArrayLike, ""]
    num_iterations: Int[ArrayLike, ""]
    cost: Float[ArrayLike, ""]
    residuals: Float[Array, "m"] | Float[np.ndarray, "m"]
    weights: Float[Array, "m"] | Float[np.ndarray, "m"]
    uncertainty: Deferred[Any]

    @classmethod
    def build(cls, **fields: Any) -> PoseGraphResult:
        """Construct from fields without equinox's constructor, which would compute the deferred one."""
        result = object.__new__(cls)
        for name, value in fields.items():
            object.__setattr__(result, name, value)
        return result

    @property
    def kept(self) -> Bool[Array, "m"] | Bool[np.ndarray, "m"]:
        """(m,) False for loops that were rejected."""
        return self.weights > 0.5

    @property
    def covariance(self) -> Float[Array, "n 6 6"] | Float[np.ndarray, "n 6 6"]:
        """(n, 6, 6) covariance of every pose: of ξ = (v, ω) in T exp(ξ), metres and radians.

        It is relative to the first pose or, with priors, to the world.
        The inverse of the Gauss-Newton matrix of the edges that were used. It is right if the information of the edges
        is, and does not cover the risk that a false loop was kept or a true one rejected. Computed when first read. The
        diagonal is infinite for poses that no edges connect with the first pose or, with priors, the world.
        """
        return self.uncertainty.value

    @property
    def status(self) -> Any:
        """The `Status`; inside a transformation the array `status_code`.

        CONVERGED; MAX_ITERATIONS; NON_FINITE: poses or residuals overflow; DEGENERATE: the edges do not connect all
        poses with each other or with the world, or leave a direction of motion of at least one pose unconstrained.
        Along unconstrained directions the motion between poses stays near that of the start.
        """
        return Status(int(np.asarray(self.status_code))) if is_concrete(self.status_code) else self.status_code

    @property
    def converged(self) -> Any:
        """Whether the status is CONVERGED."""
        return self.status == Status.CONVERGED

    def __repr__(self) -> str:
        if not is_concrete(self.poses):
            return f"PoseGraphResult({len(self.poses)} poses, traced)"
        rejected = int((~np.asarray(self.kept)).sum())
        return (
            f"PoseGraphResult({self.status.name}: {len(self.poses)} poses, {len(self.edges)} edges, "
            f"{rejected} rejected, cost {np.asarray(self.cost):.4g}, {self.num_iterations} iterations)"
        )


def optimize_poses(graph: PoseGraph, *, robust: bool = True, max_iterations: int = 100) -> PoseGraphResult:
    """Find the poses that minimise Σ rᵀΛr over the edges, with r = log(T_i_j⁻¹ T_i⁻¹ T_j) and their information Λ.

    Runs Levenberg-Marquardt from the poses of the graph. The first pose is held, unless there are edges from the world
    (priors). Concrete graphs are solved on the host by sparse factorisation, and graphs of other sizes compile nothing
    new. Inside transformations the solver is dense and compiles for every size, which suits some hundreds of poses. The
    poses are then differentiable with respect to the motions and the information of the edges, by the implicit function
    theorem, but not with respect to the start. The derivative is 0 if the solver does not converge.

    Args:
        graph: poses and edges.
        robust: whether edges with `loop` may be rejected as outliers: those with a Mahalanobis distance above 4.1 at
            the minimum (99 % of χ² with six degrees of freedom). They are found by graduated non-convexity with
            truncated squares (Yang et al. 2020). The threshold presumes that the information of the edges is right.
            Inside transformations `robust` must be False: optimise once outside, and pass `edges[result.kept]`.
        max_iterations: largest number of steps, at least 1. Steps of the graduated non-convexity are not limited by it.

    Returns:
        The poses with status and covariances, and the residual and weight of each edge.

    Raises:
        ValueError: if `graph` is not a `PoseGraph`, `max_iterations` is not an integer of at least 1, or `robust` is
            true inside a transformation. Failures on well-formed graphs show in the status.
    """
    if not isinstance(graph, PoseGraph):
        raise ValueError(f"graph: expected a PoseGraph, got {type(graph).__name__}")
    check_integer("max_iterations", max_iterations, 1)
    if not is_concrete(graph):
        return _traced(graph, robust, int(max_iterations))
    loops = np.asarray(graph.edges.loop) & bool(robust)
    # Overflow is a status.
    with np.errstate(over="ignore", invalid="ignore"):
        edges, start, origin = _centred(graph)
        equations = NormalEquations(edges, start)
        equations, found, weights = _robust_minimum(equations, start, loops, int(max_iterations))
        status, cost = _status(equations, found, weights), found.terms.cost(weights)
        poses = matrices_of(found.poses[: len(graph.poses)])
        poses[:, :3, 3] += origin
    return PoseGraphResult.build(
        poses=poses,
        edges=graph.edges,
        status_code=np.int32(status),
        num_iterations=np.int32(found.num_iterations),
        cost=np.float64(cost),
        residuals=np.sqrt(np.maximum(found.terms.squares, 0)),
        weights=weights,
        uncertainty=Deferred(lambda: _covariances(equations, found, weights)[: len(graph.poses)]),
    )


def _centred(graph: PoseGraph) -> tuple[Edge, Float[np.ndarray, "_ 7"], Float[np.ndarray, "3"]]:
    """Edges and parameters of the poses about another origin of the world, and that origin.

    It is the first position or, with priors, their median: at UTM coordinates, 1e-9 m are lost to rounding, and costs
    next to the minimum could not be told apart. With priors, the last parameters are those of the world.
    """
    edges, of_world = graph.edges, np.asarray(graph.edges.i) == WORLD
    poses, motions = np.array(graph.poses, np.float64), np.array(edges.T_i_j, np.float64)
    origin = np.median(motions[of_world, :3, 3] if of_world.any() else poses[:1, :3, 3], axis=0)
    poses[:, :3, 3] -= origin
    motions[of_world, :3, 3] -= origin
    if of_world.any():
        poses = np.concatenate([poses, np.eye(4)[None]])
    return Edge(edges.i, edges.j, motions, edges.information, loop=edges.loop), parameters_of(poses), origin


def motion_covariances(
    graph: PoseGraph, i: Int[np.ndarray, "k"], j: Int[np.ndarray, "k"]
) -> Float[np.ndarray, "k 6 6"]:
    """Covariances of ξ in T_i⁻¹ T_j exp(ξ), at the poses of the graph, taken to be its minimum.

    Loops that do not fit there do not count.
    """
    edges, poses, _ = _centred(graph)
    squares = NormalEquations(edges, poses).terms(poses).squares
    weights = np.where(np.asarray(edges.loop), 1.0 * (squares <= LARGEST_SQUARE), 1)
    none = np.zeros((len(i), 6, 6))
    return _motion_covariances(edges, poses, weights, Edge(i, j, none[:, :4, :4], none))


def _traced(graph: PoseGraph, robust: bool, max_iterations: int) -> PoseGraphResult:
    if robust:
        raise ValueError(
            "robust: expected False inside transformations; optimize once outside, and pass the kept edges"
        )
    found = optimize_traced(graph.poses, graph.edges, max_iterations)
    return PoseGraphResult.build(
        poses=found.poses,
        edges=graph.edges,
        status_code=found.status,
        num_iterations=found.num_iterations,
        cost=0.5 * jnp.sum(found.squares),
        residuals=jnp.sqrt(jnp.maximum(found.squares, 0)),
        weights=jnp.ones_like(found.squares),
        uncertainty=Deferred.of(found.covariance),
    )


def _robust_minimum(
    equations: NormalEquations, start: Float[np.ndarray, "n 7"], loops: Bool[np.ndarray, "m"], max_iterations: int
) -> tuple[NormalEquations, Minimum, Float[np.ndarray, "m"]]:
    """The equations of the edges that are kept, the minimum, and the weights of all edges.

    Truncated squares min(r², c²) are approached from a function of which the largest residual is in the convex part.
    """
    found = Minimum(start, equations.terms(start))
    largest = found.terms.squares[loops].max(initial=0)
    if not largest > LARGEST_SQUARE:
        weights = np.ones(len(loops))
        return equations, minimize(equations, found, weights, max_iterations), weights
    control = LARGEST_SQUARE / (2 * largest - LARGEST_SQUARE)
    while True:
        weights = np.where(loops, _truncated_weights(found.terms.squares, control), 1)
        if np.all((weights == 0) | (weights == 1)):
            break
        equations = equations.restricted(weights > 0)
        found = minimize(equations, found, weights, 1, core=weights > _CORE)
        control *= _GROWTH
    chosen = weights
    for _ in range(_CHOICES):
        weights, equations = chosen, equations.restricted(chosen > 0)
        found = minimize(equations, found, weights, max_iterations)
        chosen = np.where(loops, 1.0 * (found.terms.squares <= LARGEST_SQUARE), 1)
        chosen[_wrongly_rejected(equations, found, weights)] = 1
        if np.array_equal(chosen, weights):
            break
    return equations, found, weights


def _wrongly_rejected(
    equations: NormalEquations, found: Minimum, weights: Float[np.ndarray, "m"]
) -> Int[np.ndarray, "k"]:
    """Rejected loops that would raise the cost by less than the threshold: whose residual is within its own
    uncertainty, that of the loop and of the other edges together.
    """
    squares = found.terms.squares
    near = np.flatnonzero((weights == 0) & (squares > LARGEST_SQUARE) & (squares <= _NEAR * LARGEST_SQUARE))
    if not len(near):
        return near
    residuals = equations.residuals(found.poses, near)
    between = _motion_covariances(equations.edges, found.poses, weights, equations.edges[near])
    # rᵀ(Λ⁻¹ + Σ)⁻¹r without the inverse of Λ, which may be singular.
    information = equations.information[near]
    inner = np.linalg.solve(np.eye(6) + information @ between, information @ residuals[..., None])[..., 0]
    return near[np.einsum("ki,ki->k", residuals, inner) <= LARGEST_SQUARE]


def _truncated_weights(squares: Float[np.ndarray, "m"], control: float) -> Float[np.ndarray, "m"]:
    """Weights of Yang et al. 2020, eq. 14: 1 below the threshold, 0 above, and between them a decline that becomes
    steeper as `control` grows.
    """
    ratio = LARGEST_SQUARE / np.maximum(squares, np.finfo(float).tiny)
    between = np.sqrt(ratio * control * (control + 1)) - control
    return np.where(ratio >= (control + 1) / control, 1, np.where(ratio <= control / (control + 1), 0, between))


def _status(equations: NormalEquations, found: Minimum, weights: Float[np.ndarray, "m"]) -> Status:
    if not (np.isfinite(found.poses).all() and np.isfinite(found.terms.squares).all()):
        return Status.NON_FINITE
    if _is_degenerate(equations, found, weights):
        return Status.DEGENERATE
    return Status.CONVERGED if found.converged else Status.MAX_ITERATIONS


def _is_degenerate(equations: NormalEquations, found: Minimum, weights: Float[np.ndarray, "m"]) -> bool:
    """Whether poses are not connected, or the least eigenvalue of H relative to D is not above rounding and damping.

    By inverse iteration with the least damping: that of the last step may be too large to tell.
    """
    if np.any(equations.parts != equations.parts[equations.root]):
        return True
    if not equations.size:
        return False
    matrix = equations.weighted(found.terms, weights)
    try:
        factors = factored(equations.damped(matrix))
    except RuntimeError:
        return True
    vector = np.random.default_rng(0).normal(size=equations.size)
    for _ in range(_INVERSE_ITERATIONS):
        pushed = equations.metric @ vector
        vector = factors.solve(pushed / np.sqrt(vector @ pushed))
    return bool(vector @ (matrix @ vector) < UNCONSTRAINED * (vector @ (equations.metric @ vector)))


def _covariances(
    equations: NormalEquations, found: Minimum, weights: Float[np.ndarray, "m"]
) -> Float[np.ndarray, "n 6 6"]:
    """Of every pose, relative to the root."""
    covariances = _of_poses_and_edges(equations, found, weights, np.zeros(0, int))[0]
    covariances[equations.parts != equations.parts[equations.root]] = np.diag(np.full(6, np.inf))
    return covariances


def _motion_covariances(
    edges: Edge, poses: Float[np.ndarray, "n 7"], weights: Float[np.ndarray, "m"], asked: Edge
) -> Float[np.ndarray, "k 6 6"]:
    """Of ξ in T_i⁻¹ T_j exp(ξ), between the ends of the edges that are asked for; their information does not count."""
    used, number = edges[weights > 0], len(asked)
    asked = Edge(asked.i, asked.j, np.tile(np.eye(4), (number, 1, 1)), np.zeros((number, 6, 6)))
    every = jax.tree.map(lambda *values: np.concatenate(values), used, asked)
    equations = NormalEquations(every, poses)
    found = Minimum(poses, equations.terms(poses))
    weights = np.concatenate([weights[weights > 0], np.ones(number)])
    return _of_poses_and_edges(equations, found, weights, np.arange(len(used), len(every)))[1]


def _of_poses_and_edges(
    equations: NormalEquations, found: Minimum, weights: Float[np.ndarray, "m"], rows: Int[np.ndarray, "k"]
) -> tuple[Float[np.ndarray, "n 6 6"], Float[np.ndarray, "k 6 6"]]:
    """Covariances of the poses and of the motions along some edges; NaN if the matrix is singular."""
    covariances, (i, j) = np.zeros((len(found.poses), 6, 6)), equations.ends(rows)
    crossed = np.zeros((len(rows), 6, 6))
    if equations.size:
        both = ~equations.held[i] & ~equations.held[j]
        pairs = np.column_stack([equations.place[i], equations.place[j]])[both]
        try:
            factor = factored(equations.damped(equations.weighted(found.terms, weights)))
            blocks, crossed[both] = inverse_blocks(factor, pairs)
        except (RuntimeError, np.linalg.LinAlgError):
            return np.full_like(covariances, np.nan), np.full_like(crossed, np.nan)
        covariances[~equations.held] = blocks[equations.place[~equations.held]]
    change = relative_twists(found.poses[i], found.poses[j]) if len(rows) else crossed
    mixed, turned = change @ crossed, change.swapaxes(1, 2)
    return covariances, change @ covariances[i] @ turned + covariances[j] + mixed + mixed.swapaxes(1, 2)
