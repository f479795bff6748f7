"""Optimisation of pose graphs: least squares over all edges, with false loops rejected."""

from __future__ import annotations

import contextlib
from typing import Any

import equinox as eqx
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
from mcgicp_jax._pose_graph import Edge, PoseGraph
from mcgicp_jax._result import Status

# Squared Mahalanobis distance beyond which a loop is rejected: the 99 % quantile of χ² with six degrees of freedom.
LARGEST_SQUARE = 16.811893829770927
# Factor by which the non-convexity grows, and steps of the minimisation at each. In ten grids with 30 % of false loops,
# a factor of 1.4 (Yang et al. 2020) and one step keep the same loops in as many steps; with 4, 0.4 % of the true loops
# more are lost.
_GROWTH, _STEPS = 2.0, 2
# Largest number of times that the loops are chosen anew at the minimum, which ends when the choice repeats itself.
_CHOICES = 5
# Rejected loops are looked at again if their squared residual is below this multiple of the threshold: other edges
# alone would have to know the motion half as well as the loop.
_NEAR = 4.0
# Inverse iterations for the least constrained direction: unconstrained ones stand out by factors of 1e3 and more.
_INVERSE_ITERATIONS = 4
# Unknowns up to which covariances come from the dense inverse: for 300 poses it is seven times as quick as SuperLU.
_DENSE = 1800
# Columns of the inverse computed at once, to bound memory.
_COLUMNS = 252


class PoseGraphResult(eqx.Module):
    """Result of `optimize_poses`; a pytree.

    Attributes:
        poses: (n, 4, 4), sensor to world, metres; the first one is that of the graph.
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
        """(n, 6, 6) covariance of every pose relative to the first: of ξ = (v, ω) in T exp(ξ), metres and radians.

        The inverse of the Gauss-Newton matrix of the edges that were used. It is right if the information of the edges
        is, and does not cover the risk that a false loop was kept or a true one rejected. Computed when first read. The
        diagonal is infinite for poses that no edges connect with the first.
        """
        return self.uncertainty.value

    @property
    def status(self) -> Any:
        """The `Status`; inside a transformation the array `status_code`.

        CONVERGED; MAX_ITERATIONS; NON_FINITE: poses or residuals overflow; DEGENERATE: the edges do not connect all
        poses, or leave a direction of motion of at least one pose unconstrained. Along unconstrained directions the
        motion between poses stays near that of the start.
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

    Runs Levenberg-Marquardt from the poses of the graph; the first pose is held. Concrete graphs are solved on the host
    by sparse factorisation, and graphs of other sizes compile nothing new. Inside transformations the solver is dense
    and compiles for every size, which suits some hundreds of poses. The poses are then differentiable with respect to
    the motions and the information of the edges, by the implicit function theorem, but not with respect to the start.
    The derivative is 0 if the solver does not converge.

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
    edges, start = graph.edges, parameters_of(np.asarray(graph.poses))
    loops = np.asarray(edges.loop) & bool(robust)
    # Overflow is a status.
    with np.errstate(over="ignore", invalid="ignore"):
        equations = NormalEquations(edges, start)
        found, weights = _robust_minimum(equations, start, loops, int(max_iterations))
        status, cost = _status(equations, found, weights), found.terms.cost(weights)
    return PoseGraphResult.build(
        poses=matrices_of(found.poses),
        edges=edges,
        status_code=np.int32(status),
        num_iterations=np.int32(found.num_iterations),
        cost=np.float64(cost),
        residuals=np.sqrt(np.maximum(found.terms.squares, 0)),
        weights=weights,
        uncertainty=Deferred(lambda: Certainty(equations, found, weights).covariances()),
    )


def certainty_of(graph: PoseGraph) -> Certainty:
    """Certainty at the poses of the graph, taken to be its minimum; of the edges that fit there."""
    poses = parameters_of(np.asarray(graph.poses))
    equations = NormalEquations(graph.edges, poses)
    terms = equations.terms(poses)
    weights = np.where(np.asarray(graph.edges.loop), 1.0 * (terms.squares <= LARGEST_SQUARE), 1)
    return Certainty(equations, Minimum(poses, terms), weights)


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
) -> tuple[Minimum, Float[np.ndarray, "m"]]:
    """The minimum and the weights of the edges.

    Truncated squares min(r², c²) are approached from a function of which the largest residual is in the convex part.
    """
    found = Minimum(start, equations.terms(start))
    largest = found.terms.squares[loops].max(initial=0)
    if not largest > LARGEST_SQUARE:
        weights = np.ones(len(loops))
        return minimize(equations, found, weights, max_iterations), weights
    control = LARGEST_SQUARE / (2 * largest - LARGEST_SQUARE)
    while True:
        weights = np.where(loops, _truncated_weights(found.terms.squares, control), 1)
        if np.all((weights == 0) | (weights == 1)):
            break
        found = minimize(equations, found, weights, _STEPS)
        control *= _GROWTH
    for _ in range(_CHOICES):
        found = minimize(equations, found, weights, max_iterations)
        chosen = np.where(loops, 1.0 * (found.terms.squares <= LARGEST_SQUARE), 1)
        chosen[_wrongly_rejected(equations, found, weights)] = 1
        if np.array_equal(chosen, weights):
            break
        weights = chosen
    return found, weights


def _wrongly_rejected(
    equations: NormalEquations, found: Minimum, weights: Float[np.ndarray, "m"]
) -> Int[np.ndarray, "k"]:
    """Rejected loops that would raise the cost by less than the threshold: whose residual is within its own
    uncertainty, that of the loop and of the other edges together.
    """
    squares = found.terms.squares
    near = np.flatnonzero((weights == 0) & (squares > LARGEST_SQUARE) & (squares <= _NEAR * LARGEST_SQUARE))
    certainty = Certainty(equations, found, weights) if len(near) else None
    if certainty is None:
        return near
    residuals, between = equations.residuals(found.poses, near), certainty.between(*equations.ends(near))
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

    By inverse iteration with the last factorisation of the minimisation.
    """
    if np.any(equations.parts != equations.parts[0]):
        return True
    if not equations.size or found.solve is None:
        return False
    vector = np.random.default_rng(0).normal(size=equations.size)
    for _ in range(_INVERSE_ITERATIONS):
        pushed = equations.metric @ vector
        vector = found.solve(pushed / np.sqrt(vector @ pushed))
    matrix = equations.weighted(found.terms, weights)
    return bool(vector @ (matrix @ vector) < UNCONSTRAINED * (vector @ (equations.metric @ vector)))


class Certainty:
    """Covariances at a minimum, from one factorisation."""

    def __init__(self, equations: NormalEquations, found: Minimum, weights: Float[np.ndarray, "m"]):
        self._equations, self._poses = equations, found.poses
        self._solve: Any = None
        if equations.size:
            matrix = equations.damped(equations.weighted(found.terms, weights))
            with contextlib.suppress(RuntimeError, np.linalg.LinAlgError):
                small = equations.size <= _DENSE
                self._solve = np.linalg.inv(matrix.toarray()).__matmul__ if small else factored(matrix)

    def covariances(self) -> Float[np.ndarray, "n 6 6"]:
        """Of every pose, relative to the first."""
        equations = self._equations
        covariances = np.zeros((len(self._poses), 6, 6))
        if self._solve is None and equations.size:
            return np.full_like(covariances, np.nan)
        rows = np.arange(equations.size).reshape(-1, 6)
        found = np.zeros_like(rows[:, None] + np.zeros((6, 1)))
        for first in range(0, equations.size, _COLUMNS):
            columns = np.arange(first, min(first + _COLUMNS, equations.size))
            right = np.zeros((equations.size, len(columns)))
            right[columns, columns - first] = 1
            blocks = self._solve(right).reshape(-1, 6, len(columns) // 6, 6)
            here = np.arange(len(columns) // 6)
            found[first // 6 + here] = blocks[first // 6 + here, :, here]
        free = ~equations.held
        covariances[free] = equations.spread(found.reshape(-1, 6))[free]
        covariances = 0.5 * (covariances + covariances.swapaxes(1, 2))
        covariances[equations.parts != equations.parts[0]] = np.diag(np.full(6, np.inf))
        return covariances

    def between(self, i: Int[np.ndarray, "k"], j: Int[np.ndarray, "k"]) -> Float[np.ndarray, "k 6 6"]:
        """Of the motion between poses: of ξ in T_i⁻¹ T_j exp(ξ)."""
        change = relative_twists(self._poses[i], self._poses[j])
        right = np.zeros((len(self._poses), 6, 6 * len(i)))
        columns = np.arange(6 * len(i)).reshape(-1, 6)
        for k in range(len(i)):
            right[i[k], :, columns[k]] = change[k]
            right[j[k], :, columns[k]] = np.eye(6)
        vector = self._equations.gathered(right).reshape(self._equations.size, -1)
        products = vector.T @ self._solve(vector)
        return np.array([products[np.ix_(rows, rows)] for rows in columns])
