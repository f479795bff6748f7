"""Pose graphs inside transformations: the solver runs on the host, its derivative is implicit.

The poses are the root of g(ξ, θ) = Σ w JᵀΛr, so dξ = −(∂g/∂ξ)⁻¹ ∂g/∂θ dθ, with the full Hessian ∂g/∂ξ and the motions
and information matrices θ of the edges. The host computes both derivatives in float64; JAX only contracts them with
tangents.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from mcgicp_jax._compute.cache import Lazy
from mcgicp_jax._compute.concrete import AnyArray, is_concrete
from mcgicp_jax._compute.messages import calling_line, shown_at, warn
from mcgicp_jax._compute.programs import call_host
from mcgicp_jax._math.poses import logarithm_derivative, skew
from mcgicp_jax._pose_graph.edge import WORLD, Factors, check_rows, motion_jacobians
from mcgicp_jax._pose_graph.levenberg_marquardt import GraphState, factored, typical_information
from mcgicp_jax._pose_graph.robust_solver import GraphPoses, covariances_at, solve
from mcgicp_jax._registration.result import Status

# Step of the central differences of `logarithm_derivative`, metres or radians: errors are of the order of 1e-10.
_STEP = 1e-5


class _Sensitivity(NamedTuple):
    """0 unless the status is CONVERGED, and for fixed poses and rejected edges."""

    # (∂g/∂ξ)⁻¹.
    inverse: Float[AnyArray, "n 6 n 6"]
    # Derivative of JᵀΛr by the twist μ of T_i_j exp(μ).
    by_motion: Float[AnyArray, "m 2 6 6"]
    jacobians: Float[AnyArray, "m 2 6 6"]
    residuals: Float[AnyArray, "m 6"]


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def solve_traced(poses: Float[AnyArray, "n 4 4"], factors: Factors, robust: bool, max_iterations: int) -> GraphPoses:
    """`robust_solver.solve`, differentiable with respect to the edges, not to the initial poses."""
    return _solved(poses, factors, robust, max_iterations, False)[0]


@solve_traced.defjvp
def _derivative(robust: bool, max_iterations: int, primals: Any, tangents: Any) -> tuple[GraphPoses, GraphPoses]:
    (poses, factors), (_, (change, *_)) = primals, tangents
    if len(factors) > 1:
        raise ValueError("graph: poses have derivatives only if edges are the only measurements, got further factors")
    solution, sensitivity = _solved(poses, factors, robust, max_iterations, True)
    edges = factors[0]
    tangent = _pose_tangents(solution, sensitivity, edges.rows, edges.T_i_j, change.T_i_j, change.information)
    zeros = jax.tree.map(jax.custom_derivatives.zero_from_primal, solution)
    return solution, zeros._replace(poses=tangent)


# One program: outside of `jit`, each of some fifty operations would be compiled alone.
@jax.jit
def _pose_tangents(
    solution: GraphPoses,
    sensitivity: _Sensitivity,
    rows: Int[AnyArray, "m 2"],
    motions: Float[AnyArray, "m 4 4"],
    motion_change: Float[AnyArray, "m 4 4"],
    information_change: Float[AnyArray, "m 6 6"],
) -> Float[Array, "n 4 4"]:
    n, dtype = len(solution.poses), solution.poses.dtype
    einsum = partial(jnp.einsum, precision="highest")
    local = einsum("mji,mjk->mik", motions[:, :3, :3], motion_change[:, :3]).astype(dtype)
    turn = (local[:, :, :3] - local[:, :, :3].swapaxes(1, 2)) / 2
    twists = jnp.concatenate([local[:, :, 3], turn[:, (2, 0, 1), (1, 2, 0)]], axis=1)
    forces = einsum("mkab,mb->mka", sensitivity.by_motion, twists)
    forces += einsum("mkia,mij,mj->mka", sensitivity.jacobians, information_change.astype(dtype), sensitivity.residuals)
    gradient = jnp.zeros((n + 1, 6), dtype).at[jnp.where(rows == WORLD, n, rows)].add(forces)
    twists = -einsum("iajb,jb->ia", sensitivity.inverse, gradient[:-1])
    generators = jnp.zeros((n, 4, 4), dtype).at[:, :3, :3].set(skew(twists[:, 3:])).at[:, :3, 3].set(twists[:, :3])
    moved = jnp.matmul(solution.poses, generators, precision="highest")
    # Tangents that are not finite would leave NaN behind a zero derivative.
    return jnp.where(solution.status == Status.CONVERGED, moved, 0)


def covariances_traced(poses: Float[AnyArray, "n 4 4"], factors: Factors, weights: Float[AnyArray, "m"]) -> Lazy[Any]:
    """Covariances at a solution, (n, 6, 6), as constants; `jit` removes their computation if they are not read."""
    arguments = jax.lax.stop_gradient((poses, factors, weights))
    dtype = _precision(arguments)

    def on_host(*arguments: Any) -> Any:
        return covariances_at(*arguments).astype(dtype)

    if is_concrete(arguments):
        return Lazy(lambda: jnp.asarray(on_host(*jax.tree.map(np.asarray, arguments))))
    return Lazy.of(call_host(on_host, jax.ShapeDtypeStruct((len(poses), 6, 6), dtype), *arguments))


def _precision(tree: Any) -> Any:
    return jnp.result_type(*[leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)])


def _solved(
    poses: Float[AnyArray, "n 4 4"], factors: Factors, robust: bool, max_iterations: int, differentiated: bool
) -> tuple[GraphPoses, Any]:
    dtype, n, line = _precision((poses, factors)), len(poses), calling_line()

    def on_host(poses: Any, factors: Any) -> Any:
        for k, factor in enumerate(factors):
            # Rows of traced graphs are first known here.
            check_rows(f"factors[{k - 1}]" if k else "edges", np.asarray(factor.rows), n)
        result, state = solve(poses, factors, robust, max_iterations, exact=True)
        result = jax.tree.map(lambda value: value.astype(dtype) if value.dtype.kind == "f" else value, result)
        # Warn if the spacing of floats at the positions exceeds the standard deviation of a typical edge. NaN and
        # overflow are a status.
        farthest = np.abs(result.poses[:, :3, 3]).max()
        spacing = np.spacing(farthest) if np.isfinite(farthest) else 0
        if spacing**2 * typical_information(factors)[:, 0].max(initial=0) > 1:
            with shown_at(line):
                warn(
                    f"optimize_poses: poses up to {farthest:.3g} m from the origin are rounded to {spacing:.1g} m in "
                    f"{dtype}. Subtract an origin from poses and priors before, or enable jax_enable_x64"
                )
        return result, _sensitivity(state, result, dtype) if differentiated else None

    if is_concrete(poses, factors):
        return jax.tree.map(jnp.asarray, on_host(*jax.tree.map(np.asarray, (poses, factors))))
    m, integer = sum(len(factor.information) for factor in factors), jax.ShapeDtypeStruct((), np.int32)
    floats: Any = partial(jax.ShapeDtypeStruct, dtype=dtype)
    result = GraphPoses(floats((n, 4, 4)), floats((m,)), floats((m,)), floats(()), integer, integer)
    shapes = (n, 6, n, 6), (m, 2, 6, 6), (m, 2, 6, 6), (m, 6)
    sensitivity = _Sensitivity(*map(floats, shapes)) if differentiated else None
    return call_host(on_host, (result, sensitivity), poses, factors)


def _sensitivity(state: GraphState, result: GraphPoses, dtype: DTypeLike) -> _Sensitivity:
    equations, poses, n = state.equations, state.poses, len(result.poses)
    inverse = np.zeros((len(poses), 6, len(poses), 6))
    by_edge = [np.zeros((len(equations.rows), *shape)) for shape in ((2, 6, 6), (2, 6, 6), (6,))]
    if result.status == Status.CONVERGED:
        # J = BD, with the inverse B of the right Jacobian of SE(3) at r and the derivative D of T_i⁻¹ T_j by both.
        edges, pairs = equations.factors[0], poses[equations.rows]
        residuals, jacobians = edges.linearize(pairs)
        motion, information = motion_jacobians(pairs), np.asarray(edges.information)
        forces = information @ residuals[..., None]
        steps = _STEP * np.eye(6)[:, None]
        slopes = (logarithm_derivative(residuals + steps) - logarithm_derivative(residuals - steps)) / (2 * _STEP)
        # ∂(BᵀΛr)/∂r, and the derivatives of JᵀΛr by the twists of both poses, (m, 2, 2, 6, 6).
        by_residual = jacobians[:, 1].swapaxes(1, 2) @ information + np.einsum("bmia,mi->mab", slopes, forces[..., 0])
        outer = motion.swapaxes(2, 3) @ by_residual[:, None]
        blocks = outer[:, :, None] @ jacobians[:, None]
        # D depends on the poses, too: dD_i = D_i ad(ξ_i) − ad(ξ_j) D_i.
        first, second = np.moveaxis((jacobians.swapaxes(2, 3) @ forces[:, None])[..., 0], 1, 0)
        blocks[:, 0, 0] += _coadjoint(first)
        blocks[:, 0, 1] -= motion[:, 0].swapaxes(1, 2) @ _coadjoint(second)
        by_motion = outer @ -logarithm_derivative(-residuals)[:, None]
        for values, derivative in zip(by_edge, (by_motion, jacobians, residuals), strict=True):
            values[state.weights > 0] = derivative[state.weights > 0]
        if equations.size:
            # From unknowns to poses: first the rows, then the columns of the inverse.
            columns = equations.spread(factored(equations.matrix(blocks, state.weights)).solve(np.eye(equations.size)))
            inverse = equations.spread(np.moveaxis(columns, 2, 0))
    return _Sensitivity(*(values.astype(dtype) for values in (inverse[:n, :, :n], *by_edge)))


def _coadjoint(forces: Float[np.ndarray, "m 6"]) -> Float[np.ndarray, "m 6 6"]:
    """The matrix C with Cξ = ad(ξ)ᵀf."""
    matrix = np.zeros((len(forces), 6, 6))
    matrix[:, :3, 3:] = matrix[:, 3:, :3] = skew(forces[:, :3])
    matrix[:, 3:, 3:] = skew(forces[:, 3:])
    return matrix
