"""Pose graphs inside transformations: one dense program per size of graph, and the derivative of the minimum.

The loop is that of `_normal_equations`. The world is one more pose, the last one, which is held. Whether an edge starts
there may not be known when the program is compiled; if none does, the first pose is held too: its rows and columns of
all matrices are those of the identity. The poses are the root of g = ∂(½ Σ rᵀΛr)/∂ξ, so their derivative is
−(∂g/∂ξ)⁻¹ ∂g/∂θ with the full Hessian: that of one Newton step from the minimum in which all but g is a constant.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._normal_equations import (
    DAMPING_FACTOR,
    LEAST_DAMPING,
    LEAST_DECREASE,
    START_DAMPING,
    UNCONSTRAINED,
    residual_of,
)
from mcgicp_jax._pose import AnyArray
from mcgicp_jax._pose_graph import WORLD, Edge
from mcgicp_jax._result import Status

# Tolerance of the loop on the host, in units of the precision: derivatives are right to the root of it at least.
_TOLERANCE_IN_EPS = 10.0


class _Edges(NamedTuple):
    """Edges with motions as quaternions wxyz and translations; `i` is the number of poses for edges from the world."""

    i: Int[Array, "m"]
    j: Int[Array, "m"]
    motions: Float[Array, "m 7"]
    information: Float[Array, "m 6 6"]
    of_world: Bool[Array, "m"]


class Found(NamedTuple):
    """Poses, differentiable; squared residuals, status, number of steps, and covariances."""

    poses: Float[Array, "n 4 4"]
    squares: Float[Array, "m"]
    status: Int[Array, ""]
    num_iterations: Int[Array, ""]
    covariance: Float[Array, "n 6 6"]


class _Sums(NamedTuple):
    """½ Σ rᵀΛr, its gradient g, the Gauss-Newton matrix H and the metric D, without the world."""

    cost: Float[Array, ""]
    gradient: Float[Array, "k"]
    matrix: Float[Array, "k k"]
    metric: Float[Array, "k k"]


class _State(NamedTuple):
    poses: Float[Array, "n 7"]
    sums: _Sums
    damping: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Any


def optimize_traced(matrices: Float[AnyArray, "n 4 4"], edges: Edge, max_iterations: int) -> Found:
    """Minimise Σ rᵀΛr from the given poses; differentiable by the edges, not by the start."""
    dtype, n = jnp.result_type(matrices, edges.T_i_j, edges.information), len(matrices)
    with jax.default_matmul_precision("highest"):
        of_world = jnp.asarray(edges.i) == WORLD
        # Far from the origin, rounding would decide what the loop does.
        origin = jax.lax.stop_gradient(jnp.asarray(matrices, dtype)[0, :3, 3])
        matrices = jnp.asarray(matrices, dtype).at[:, :3, 3].add(-origin)
        motions = jnp.asarray(edges.T_i_j, dtype).at[:, :3, 3].add(jnp.where(of_world[:, None], -origin, 0))
        given = _Edges(
            jnp.where(of_world, n, edges.i),
            jnp.asarray(edges.j),
            _parameters(motions, dtype),
            jnp.asarray(edges.information, dtype),
            of_world,
        )
        whole = jnp.concatenate([matrices, jnp.eye(4, dtype=dtype)[None]])
        start, fixed = jax.lax.stop_gradient((_parameters(whole, dtype), given))
        state = _minimized(start, fixed, max_iterations)
        gradient = _summed(_forces(state.poses, given), given, n)
        step = _solved(_assembled(_force_derivatives(state.poses, fixed), fixed, n), gradient)
        # No derivative where the loop did not converge.
        step = jnp.where(state.converged, step, 0)
        matrix, metric = state.sums.matrix, state.sums.metric
        blocks = jnp.linalg.inv(matrix + LEAST_DAMPING * metric).reshape(n, 6, n, 6)
        rows = jnp.arange(n)
        residuals = _residuals(state.poses, fixed)
        return Found(
            jaxlie.SE3(_moved(state.poses, step)[:n]).as_matrix().astype(dtype).at[:, :3, 3].add(origin),
            jnp.einsum("mi,mij,mj->m", residuals, fixed.information, residuals),
            _status(state),
            state.steps,
            jnp.where(_moves(fixed, n)[:, None, None], blocks[rows, :, rows], 0),
        )


def _status(state: _State) -> Int[Array, ""]:
    # The difference is positive definite if every direction has more than the least information.
    definite = jnp.all(jnp.isfinite(jnp.linalg.cholesky(state.sums.matrix - UNCONSTRAINED * state.sums.metric)))
    status = jnp.where(state.converged, Status.CONVERGED, Status.MAX_ITERATIONS)
    status = jnp.where(definite, status, Status.DEGENERATE)
    return jnp.where(jnp.isfinite(state.sums.cost), status, Status.NON_FINITE).astype(jnp.int32)


def _minimized(start: Float[Array, "n 7"], edges: _Edges, max_iterations: int) -> _State:
    eps = float(jnp.finfo(start.dtype).eps)
    rounding = 4 * eps * len(edges.i)
    size = 6 * len(start) - 6

    def goes_on(state: _State) -> Any:
        return ~state.converged & (state.steps < max_iterations)

    def step(state: _State) -> _State:
        sums = state.sums
        move = _solved(sums.matrix + state.damping * sums.metric, sums.gradient)
        poses = _moved(state.poses, move)
        there = _sums(poses, edges)
        accepted = there.cost <= sums.cost * (1 + rounding) + LEAST_DECREASE
        small = -0.5 * jnp.sum(sums.gradient * move) <= _TOLERANCE_IN_EPS * eps * sums.cost + LEAST_DECREASE
        factor = jnp.where(accepted & (state.steps > 0), 1 / DAMPING_FACTOR, jnp.where(accepted, 1, DAMPING_FACTOR))
        damping = jnp.maximum(state.damping * factor, LEAST_DAMPING)
        poses, sums = jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old), (poses, there), (state.poses, state.sums)
        )
        return _State(poses, sums, damping, state.steps + 1, accepted & small & (state.steps > 0))

    # The first step has no length: it evaluates the sums at the start. Written so, the loop compiles them once.
    zero, one = jnp.zeros((size, size), start.dtype), jnp.eye(size, dtype=start.dtype)
    before = _Sums(jnp.asarray(jnp.inf, start.dtype), zero[:, 0], one, zero)
    damping = jnp.asarray(START_DAMPING, start.dtype)
    state = jax.lax.while_loop(goes_on, step, _State(start, before, damping, jnp.int32(0), jnp.bool_(False)))
    return state._replace(steps=state.steps - 1)


@partial(jax.vmap, in_axes=(0, None))
def _parameters(matrix: Float[AnyArray, "4 4"], dtype: DTypeLike) -> Float[Array, "7"]:
    return jaxlie.SE3.from_matrix(jnp.asarray(matrix, dtype)).normalize().wxyz_xyz.astype(dtype)


def _linearized(poses: Float[Array, "n 7"], edges: _Edges) -> Any:
    """`residual_of` for all edges."""
    return jax.vmap(residual_of)(poses[edges.i], poses[edges.j], edges.motions)


def _residuals(poses: Float[Array, "n 7"], edges: _Edges) -> Float[Array, "m 6"]:
    return _linearized(poses, edges)[0]


def _sums(poses: Float[Array, "n 7"], edges: _Edges) -> _Sums:
    residuals, by_end, change = _linearized(poses, edges)
    jacobians = jnp.concatenate([by_end @ change, by_end], axis=2)
    forces = jnp.einsum("mij,mj->mi", edges.information, residuals)
    gradient, n = jnp.einsum("mia,mi->ma", jacobians, forces), len(poses) - 1
    matrix, metric = (
        _assembled(jnp.einsum("mia,mij,mjb->mab", jacobians, each, jacobians), edges, n)
        for each in (edges.information, _typical(edges))
    )
    return _Sums(0.5 * jnp.sum(residuals * forces), _summed(gradient, edges, n), matrix, metric)


def _forces(poses: Float[Array, "n 7"], edges: _Edges) -> Float[Array, "m 12"]:
    """JᵀΛr by the twists of both ends."""

    def force(
        start: Float[Array, "7"], end: Float[Array, "7"], motion: Float[Array, "7"], information: Float[Array, "6 6"]
    ) -> Float[Array, "12"]:
        residual, by_end, change = residual_of(start, end, motion)
        at_end = by_end.T @ (information @ residual)
        return jnp.concatenate([change.T @ at_end, at_end])

    return jax.vmap(force)(poses[edges.i], poses[edges.j], edges.motions, edges.information)


def _force_derivatives(poses: Float[Array, "n 7"], edges: _Edges) -> Float[Array, "m 12 12"]:
    """∂(JᵀΛr)/∂ξ of every edge, by the twists of both ends. Their sum is the Hessian, where g is 0."""
    m = len(edges.i)

    def moved(twists: Float[Array, "m 12"]) -> Float[Array, "m 12"]:
        ends = jnp.stack([poses[edges.i], poses[edges.j]], axis=1).reshape(-1, 7)
        ends = _moved_by(ends, twists.reshape(-1, 6))
        pairs = edges._replace(i=2 * jnp.arange(m), j=2 * jnp.arange(m) + 1)
        return _forces(ends, pairs)

    def push(axis: Float[Array, "12"]) -> Float[Array, "m 12"]:
        return jax.jvp(moved, (jnp.zeros((m, 12), poses.dtype),), (jnp.broadcast_to(axis, (m, 12)),))[1]

    return jax.vmap(push, out_axes=-1)(jnp.eye(12, dtype=poses.dtype))


def _typical(edges: _Edges) -> Float[Array, "m 6 6"]:
    """S of the damping, as on the host: the median information of the edges, and that of those from the world."""
    diagonal = jnp.diagonal(edges.information, axis1=1, axis2=2).reshape(-1, 2, 3).mean(axis=2)
    typical = jnp.ones_like(diagonal)
    for counted, chosen in ((~edges.of_world, True), (edges.of_world, edges.of_world)):
        known = counted[:, None] & (diagonal > 0)
        found = jnp.nanmedian(jnp.where(known, diagonal, jnp.nan), axis=0)
        typical = jnp.where(jnp.isfinite(found) & jnp.asarray(chosen)[..., None], found, typical)
    return jnp.repeat(typical, 3, axis=1)[:, :, None] * jnp.eye(6, dtype=typical.dtype)


def _moves(edges: _Edges, num_poses: int) -> Bool[Array, "n"]:
    """Which poses are not held."""
    return (jnp.arange(num_poses) > 0) | jnp.any(edges.of_world)


def _summed(rows: Float[Array, "m 12"], edges: _Edges, num_poses: int) -> Float[Array, "k"]:
    """Rows of the edges added up by pose, 0 for those that are held, without the world."""
    total = jnp.zeros((num_poses + 1, 6), rows.dtype).at[edges.i].add(rows[:, :6]).at[edges.j].add(rows[:, 6:])
    return jnp.where(_moves(edges, num_poses)[:, None], total[:-1], 0).reshape(-1)


def _assembled(blocks: Float[Array, "m 12 12"], edges: _Edges, num_poses: int) -> Float[Array, "k k"]:
    """The dense matrix of the 12×12 blocks of all edges, without the world."""
    ends = jnp.stack([edges.i, edges.j], axis=1)
    places = (6 * ends[:, :, None] + jnp.arange(6)).reshape(-1, 12)
    whole = jnp.zeros((6 * num_poses + 6, 6 * num_poses + 6), blocks.dtype)
    whole = whole.at[places[:, :, None], places[:, None, :]].add(blocks)[:-6, :-6]
    moves = jnp.repeat(_moves(edges, num_poses), 6)
    return jnp.where(moves[:, None] & moves, whole, jnp.eye(len(whole), dtype=whole.dtype) * ~moves)


def _solved(matrix: Float[Array, "k k"], gradient: Float[Array, "k"]) -> Float[Array, "k"]:
    """−H⁻¹ g; the matrix is a constant to autodiff."""
    return -jnp.linalg.solve(jax.lax.stop_gradient(matrix), gradient)


@jax.vmap
def _moved_by(pose: Float[Array, "7"], twist: Float[Array, "6"]) -> Float[Array, "7"]:
    return (jaxlie.SE3(pose) @ jaxlie.SE3.exp(twist)).normalize().wxyz_xyz.astype(pose.dtype)


def _moved(poses: Float[Array, "n 7"], twists: Float[Array, "k"]) -> Float[Array, "n 7"]:
    return _moved_by(poses, jnp.concatenate([twists.reshape(-1, 6), jnp.zeros((1, 6), twists.dtype)]))
