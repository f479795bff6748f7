"""The registration loop inside transformations: one program, compiled for the shapes of the clouds.

Find matches at this pose; sum their forces; update the pose; stop when it no longer moves. Matches come from a host
callback, or from XLA alone (`DenseSearch`). Pose and matches are constants to autodiff within the loop; the implicit
derivative is attached to the pose that the loop returns.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int

from mcgicp_jax._compute.lazy import Lazy
from mcgicp_jax._local_geometry.records import Surface, gathered
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._math.statistics import sampled_rows
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pose_solver.covariance import Details, Moments, discount_rows, discounts, scatter_of, scores_of
from mcgicp_jax._pose_solver.pose_measurements import Fusion
from mcgicp_jax._pose_solver.sums import Matched, Sums, estimates_at, matched_rows, move_rows, sums_of, within
from mcgicp_jax._pose_solver.update import root_near, with_derivative
from mcgicp_jax._registration.result import Status
from mcgicp_jax._registration.step import (
    COARSE,
    RECORDED,
    RUNNING,
    SETTLED,
    Assessment,
    Problem,
    Settings,
    State,
    constraints_of,
    covariance_of_pose,
    history_of,
    rotation_and_translation,
    update,
)
from mcgicp_jax._search.base import AbstractSearch, Correspondences, SearchPoints, by_position
from mcgicp_jax._terms.photometric import Term

# State of the loop, its matches, the history so far, and `AbstractMethod.estimates`.
Carry: TypeAlias = tuple[State, Correspondences, Float[Array, "... 5"], Any]
# From pose, status, number of updates, last matches and estimates: the matches at the pose, the sums over them, and the
# estimates from them.
Measure: TypeAlias = Callable[[jaxlie.SE3, Int[Array, ""], Int[Array, ""], Correspondences, Any], Any]


@partial(jax.jit, static_argnames="max_iterations")
def register_traced(
    problem: Problem, search: AbstractSearch, max_iterations: int
) -> tuple[State, Correspondences, dict[str, Array], Any]:
    """The loop of `register`: final state, matches, history and estimates."""
    carry = begin(problem, search, max_iterations)
    state, matches, records, estimates = jax.lax.while_loop(
        lambda carry: carry[0].status < 0, partial(_step, measure=_measuring(problem, search), problem=problem), carry
    )
    return state, cleaned(matches), history_of(records), estimates


def cleaned(matches: Correspondences) -> Correspondences:
    """Replace index −1 (no match) by 0; `valid` is False there."""
    return eqx.tree_at(lambda matches: matches.indices, matches, jnp.maximum(matches.indices, 0))


@partial(jax.jit, static_argnames="max_iterations")
def align_traced(
    start: jaxlie.SE3,
    source: Surface,
    target: Surface,
    matches: Correspondences,
    temperature: Float[Array, ""] | None,
    method: AbstractMethod,
    robust: AbstractKernel | None,
    settings: Settings,
    max_iterations: int,
) -> tuple[State, dict[str, Array], Any]:
    """The loop of `align`, with fixed matches: final state, whose pose carries the derivative, history, estimates."""
    matched = matched_rows(source, target, matches, temperature)
    start, fixed, method_fixed, robust_fixed, settings = jax.lax.stop_gradient(
        (start, matched, method, robust, settings)
    )
    problem = Problem(start, source, target, method_fixed, robust_fixed, settings)

    def measure(
        pose: jaxlie.SE3,
        status: Int[Array, ""],
        num_iterations: Int[Array, ""],
        before: Correspondences,
        estimates: Any,
    ) -> tuple[Correspondences, Sums, Any]:
        moving = rotation_and_translation(pose, pose.wxyz_xyz.dtype)
        estimates = _renewed(status, estimates, estimates_at(*moving, fixed, source.rows.valid, method_fixed.estimates))
        now = method_fixed.with_estimates(estimates)
        return before, sums_of(*moving, fixed, now, robust_fixed), estimates

    carry = _begin(problem, settings.first_status(), measure, jax.tree.map(jnp.asarray, matches), max_iterations)
    state, _, records, estimates = jax.lax.while_loop(
        lambda carry: carry[0].status < 0, partial(_step, measure=measure, problem=problem), carry
    )
    method = method.with_estimates(estimates)
    return differentiable(state, matched, method, robust), history_of(records), estimates


@jax.jit
def differentiable(
    state: State,
    matched: Matched,
    method: AbstractMethod,
    robust: AbstractKernel | None,
    fusion: Fusion | None = None,
) -> State:
    """Attach the implicit derivative to the pose of a final state; see `with_derivative`."""
    usable = (state.status == Status.CONVERGED) | (state.status == Status.MAX_ITERATIONS)
    if state.directions is not None:
        # Along an unconstrained direction the root of g (see `_solve.Root`) is arbitrary.
        usable = usable & jnp.all(state.directions.held)
    if fusion is not None:
        usable = usable & jnp.all(fusion.held)
    with jax.default_matmul_precision("highest"):
        root = jax.lax.stop_gradient(root_near(state.sums, usable, fusion))
        model = (matched, method, robust, fusion)
        pose = with_derivative(jax.lax.stop_gradient(state.pose.wxyz_xyz), root, model)
    return eqx.tree_at(lambda state: state.pose.wxyz_xyz, state, pose)


@jax.jit
def assess(
    state: State, problem: Problem, matched: Matched, matches: Correspondences, search: AbstractSearch | None = None
) -> Assessment:
    """Information matrix, directions and covariance at the final pose; `search` is None if the matches are fixed."""
    known = moments_of(state, problem, matched, matches, search) if problem.fusion is None else problem.fusion
    return Assessment(Lazy.of(constraints_of(state)), Lazy.of(covariance_of_pose(state, known)))


@jax.jit
def moments_of(
    state: State, problem: Problem, matched: Matched, matches: Correspondences, search: AbstractSearch | None = None
) -> Moments:
    """Sums over the scores of all correspondences at the final pose; `search` is None if the matches are fixed."""
    dtype = state.pose.wxyz_xyz.dtype
    pose = rotation_and_translation(state.pose, dtype)
    details, discount = None, jnp.ones(2, dtype)
    source, target = problem.source, problem.target
    if source.details is not None and target.details is not None:
        indices = matches.indices.reshape(-1)
        details = Details(jnp.tile(source.details, (matched.num_candidates, 1)), jnp.asarray(target.details)[indices])
        rows, counts = sampled_rows(source.rows.valid)
        # Of the nearest candidates, which come first.
        some = Matched(gathered(matched.source, rows), gathered(matched.target, rows), matched.valid[rows] & counts)
        discount = discounts(
            discount_rows(
                *pose,
                some,
                jax.tree.map(lambda table: table[rows], details),
                jax.tree.map(lambda array: array[rows], source.rows),
                jax.tree.map(lambda array: array[indices[rows]], target.rows),
            ),
            jnp.sum(jnp.any(source.rows.descriptors != 0, axis=0)),
        )
    num_cells, term = source.rows.valid.size, problem.method.estimates
    scores = scores_of(
        pose,
        state.sums.center,
        state.sums.radius,
        matched,
        details,
        discount,
        num_cells,
        problem.method,
        problem.robust,
        None if search is None or term is None else _responding(pose, state, problem, term, search),
    )
    scatter, num_cells = scatter_of(scores, num_cells)
    return Moments(scores.jacobian, scores.bias, scatter, num_cells)


def _responding(
    pose: tuple[Float[Array, "3 3"], Float[Array, "3"]],
    state: State,
    problem: Problem,
    term: Term,
    search: AbstractSearch,
) -> Term:
    """`Term.responding` for a sample of the source points."""
    source, target = problem.source, problem.target
    rows, counts = sampled_rows(source.rows.valid)
    some, table = jax.tree.map(lambda array: jnp.asarray(array)[rows], (by_position(source.rows), source.table))
    gate = problem.settings.fine_distance

    def evidence(shift: Float[Array, "3"]) -> Float[Array, "n L"]:
        moving = pose[0], pose[1] + shift
        shifted = state.pose.wxyz_xyz.at[4:].add(shift)
        found = search.nearest_traced(shifted, some, by_position(target.rows), gate, jnp.bool_(True))[0]
        here = jnp.maximum(found, 0)
        there = gathered(jax.tree.map(jnp.asarray, target.table), here)
        moved = move_rows(*moving, table)
        valid, _ = within(moved, there, (found >= 0) & counts & some.valid & jnp.asarray(target.rows.valid)[here], gate)
        return term.evidence(table, there, moved, moving[0], valid)

    return term.responding(jax.lax.map(evidence, jnp.asarray(term.shifts)))


def begin(problem: Problem, search: AbstractSearch, max_iterations: int) -> Carry:
    """Initial carry of the loop of `register`, with arrays for `max_iterations` + 1 history entries."""
    shape, dtype = (problem.method.num_candidates, problem.source.rows.valid.size), problem.start.wxyz_xyz.dtype
    nothing = Correspondences(jnp.full(shape, -1, jnp.int32), jnp.zeros(shape, dtype), jnp.zeros(shape, bool))
    settings = problem.settings
    first = settings.first_status() if problem.method.estimates is None else jnp.int32(COARSE)
    return _begin(problem, first, _measuring(problem, search), nothing, max_iterations)


def step_of_lane(carry: Carry, problem: Problem, search: AbstractSearch) -> Carry:
    """One step of the loop of `register`, for a lane of a batch."""
    return _step(carry, _measuring(problem, search), problem)


def _begin(
    problem: Problem, first: Int[AnyScalar, ""], measure: Measure, matches: Correspondences, max_iterations: int
) -> Carry:
    zero, estimates = jnp.int32(0), jax.tree.map(jnp.asarray, problem.method.estimates)

    def shapes() -> State:
        sums = measure(problem.start, first, zero, matches, estimates)[1]
        return update(problem.start, first, zero, sums, problem.settings, problem.fusion)

    state = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(shapes))
    state = eqx.tree_at(lambda state: (state.pose, state.status), state, (problem.start, first))
    # One entry per update, and one at the returned pose.
    return state, matches, jnp.full((max_iterations + 1, len(RECORDED)), jnp.nan, state.record.dtype), estimates


def _step(carry: Carry, measure: Measure, problem: Problem) -> Carry:
    before, matches, records, estimates = carry
    count = before.num_iterations
    matches, sums, estimates = measure(before.pose, before.status, count, matches, estimates)
    state = update(before.pose, before.status, count, sums, problem.settings, problem.fusion)
    return state, matches, records.at[count].set(state.record), estimates


def _renewed(status: Int[Array, ""], before: Any, estimates: Any) -> Any:
    """The new estimates in the fine phase, else those before."""
    return jax.tree.map(partial(jnp.where, status == RUNNING), estimates, before)


def _measuring(problem: Problem, search: AbstractSearch) -> Measure:
    def measure(
        pose: jaxlie.SE3,
        status: Int[Array, ""],
        num_iterations: Int[Array, ""],
        before: Correspondences,
        estimates: Any,
    ) -> tuple[Correspondences, Sums, Any]:
        settings, source, target = problem.settings, problem.source, problem.target
        # Under `vmap` the body also runs for finished lanes: no search for them.
        running = (status < 0) & (status != SETTLED)
        rows, target_rows = _every(settings.stride(status, num_iterations), source.rows), target.rows
        if estimates is not None:
            rows, target_rows = (_searched(status, each) for each in (rows, target_rows))
        limit, num_candidates = settings.max_distance, problem.method.num_candidates
        found = search.nearest_traced(pose.wxyz_xyz, rows, target_rows, limit, running, num_candidates)
        indices = jnp.where(running, found, before.indices)
        moving = rotation_and_translation(pose, pose.wxyz_xyz.dtype)
        here = jnp.maximum(indices, 0)
        there = (indices >= 0) & source.rows.valid & jnp.asarray(target.rows.valid)[here]
        matched = matched_rows(source, target, Correspondences(here, before.distances, there))
        moved = move_rows(*moving, matched.source)
        valid, distances = within(moved, matched.target, matched.valid, settings.gate(status))
        matched = eqx.tree_at(lambda matched: matched.valid, matched, valid)
        estimates = _renewed(
            status, estimates, estimates_at(*moving, matched, source.rows.valid, problem.method.estimates)
        )
        sums = sums_of(*moving, matched, problem.method.with_estimates(estimates), problem.robust)
        valid, distances = valid.reshape(indices.shape), distances.reshape(indices.shape)
        # Index −1 marks a missing match until the loop ends, see `cleaned`.
        return Correspondences(indices, distances, valid), sums, estimates

    return measure


def _searched(status: Int[Array, ""], rows: SearchPoints) -> SearchPoints:
    """The rows for a search in position alone after the coarse phase: without descriptors, none is missing either."""
    factor = (status == COARSE).astype(rows.points.dtype)
    penalty = None if rows.penalty is None else factor * rows.penalty
    return SearchPoints(rows.points, factor * rows.descriptors, rows.valid, penalty)


def _every(stride: Int[Array, ""], source: SearchPoints) -> SearchPoints:
    """Mark all but every `stride`-th row as invalid, so that they match nothing."""
    chosen = jnp.arange(source.valid.size) % stride == 0
    return eqx.tree_at(lambda rows: rows.valid, source, source.valid & chosen)
