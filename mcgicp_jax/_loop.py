"""The loop of registration: one step, and the two drivers that repeat it.

Find matches at this pose; weigh them; update the pose; stop when it no longer moves. On the host the matches come from
a tree between compiled steps; inside a transformation the whole loop is one program.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax import _covariance as cov
from mcgicp_jax._cost import AbstractKernel, Model, Moments, evaluate_pairs, moments, move_points
from mcgicp_jax._evidence import Evidence
from mcgicp_jax._methods import AbstractMethod, Surface
from mcgicp_jax._result import Status
from mcgicp_jax._search import AbstractSearch, Correspondences, Rows
from mcgicp_jax._solve import adjoint_to_center, move_pose, refine_pose, solve_update
from mcgicp_jax._uncertainty import (
    Directions,
    Felt,
    directions_at_source,
    estimate_covariance,
    feel,
    find_directions,
)

# The pose still moves: at first with far pairs too, and with some of the points; once it is nearly at rest with those,
# with the near pairs of all. Or its last update was below the tolerances, and one more measurement ends the loop.
_COARSE, _RUNNING, _SETTLED = -3, -1, -2
# An update below so many tolerances, that moves the points by less than this share of the narrow gate, ends the coarse
# part, whose pose will not be the last.
_NEARLY_AT_REST, _SHARE_OF_GATE = 10.0, 0.25
_MIN_CORRESPONDENCES = 4
_RECORDED = ("cost", "rmse", "num_inliers", "translation_step", "rotation_step")


class Settings(eqx.Module):
    """Numbers of the loop, as arrays: changing one compiles nothing.

    Attributes:
        max_distance: metres; pairs further apart do not count.
        fine_distance: metres; the same once the pose is nearly at rest, until it rests.
        coarse_stride: until then, one row of so many takes part, since some thousands find a pose nearly as well.
        translation_tolerance, rotation_tolerance: metres and radians, of an update after which the pose is at rest.
        max_iterations: in both parts together.
    """

    max_distance: Float[Array, ""]
    fine_distance: Float[Array, ""]
    coarse_stride: Int[Array, ""]
    translation_tolerance: Float[Array, ""]
    rotation_tolerance: Float[Array, ""]
    max_iterations: Int[Array, ""]
    hold_free_directions: Bool[Array, ""]


class Measurement(eqx.Module):
    """What one pass over the matched pairs finds at a pose; `felt` is None for matches that were given."""

    moments: Moments
    felt: Felt | None
    num_inliers: Int[Array, ""]
    cost: Float[Array, ""]
    rmse: Float[Array, ""]


class State(eqx.Module):
    """Where the loop stands.

    Attributes:
        pose: the next pose while the loop goes on; the one that was measured when it ends.
        status: value of a `Status`, `_COARSE`, `_RUNNING` or `_SETTLED`.
        num_iterations: updates so far.
        measured: at the pose before.
        information: (6, 6) at the pose before.
        directions: at the pose before, about the centroid; None for matches that were given.
        record: one number per entry of `Registration.history`, in the order of `_RECORDED`.
    """

    pose: jaxlie.SE3
    status: Int[Array, ""]
    num_iterations: Int[Array, ""]
    measured: Measurement
    information: Float[Array, "6 6"]
    directions: Directions | None
    record: Float[Array, "5"]


# And the records so far.
Carry: TypeAlias = tuple[State, Correspondences, Float[Array, "... 5"]]
# Finds pairs at a pose, or keeps those whose target rows are given, and weighs them.
Match: TypeAlias = Callable[[jaxlie.SE3, Int[Array, ""], Int[Array, ""], Array], tuple[Correspondences, Measurement]]
# What the source and the target know of what holds a pose.
Evidences: TypeAlias = tuple[Evidence, Evidence]
# The covariance of a pose, (6, 6), and the directions that it could move in.
Assessment: TypeAlias = tuple[Array | np.ndarray, Directions | None]


class Problem(eqx.Module):
    """What the loop of `register` is about."""

    start: jaxlie.SE3
    source: Surface
    target: Surface
    method: AbstractMethod
    robust: AbstractKernel | None
    settings: Settings
    evidence: Evidences

    def model(self, matches: Correspondences) -> Model:
        """All that weighs a pose, for these matches."""
        return self.source, self.target, matches, self.method, self.robust, None


def gate(
    pose: jaxlie.SE3,
    source: Surface,
    target: Surface,
    indices: Int[Array, "*candidates N"] | Int[np.ndarray, "*candidates N"],
    max_distance: Float[Array, ""],
) -> Correspondences:
    """Keep the pairs within `max_distance`, metres of position: channels choose a match, but do not gate it."""
    rotation = pose.rotation().as_matrix().astype(source.points.dtype)
    found, indices = jnp.asarray(indices) >= 0, jnp.maximum(indices, 0)
    square = jnp.zeros(indices.shape, source.points.dtype)
    for moved, coordinate in zip(move_points(rotation, pose.translation(), source), target.points, strict=True):
        square = square + (coordinate[indices] - moved) ** 2
    distances = jnp.sqrt(square)
    valid = found & source.valid & target.valid[indices] & (distances <= max_distance)
    return Correspondences(indices=indices, distances=distances, valid=valid)


@jax.jit
def measure(pose: jaxlie.SE3, model: Model, evidence: Evidences | None) -> Measurement:
    """Weigh the matches at the pose: the only part of a step that touches the points."""
    source, _, matches, *_ = model
    rotation = pose.rotation().as_matrix().astype(source.points.dtype)
    pairs = evaluate_pairs(rotation, pose.translation(), *model)
    found = moments(pairs)
    num_inliers = jnp.sum(jnp.any(pairs.valid.reshape(-1, source.valid.size), axis=0))
    square = pairs.share * cov.inner(pairs.residual, pairs.residual)
    return Measurement(
        moments=found,
        felt=None if evidence is None else feel(pairs, found.center, evidence, rotation, matches.indices),
        num_inliers=num_inliers,
        cost=jnp.sum(pairs.cost),
        # 0/0 is NaN on purpose: no pairs are no fit.
        rmse=jnp.sqrt(jnp.sum(square) / num_inliers),
    )


@jax.jit
def _first_status(settings: Settings) -> Int[Array, ""]:
    coarse = (settings.fine_distance < settings.max_distance) | (settings.coarse_stride > 1)
    return jnp.where(coarse, jnp.int32(_COARSE), jnp.int32(_RUNNING))


@jax.jit
def _stride(status: Int[ArrayLike, ""], num_iterations: Int[ArrayLike, ""], settings: Settings) -> Int[Array, ""]:
    """One row of so many takes part now. What is measured last is measured with all."""
    coarse = (status == _COARSE) & (num_iterations < settings.max_iterations)
    return jnp.where(coarse, settings.coarse_stride, 1)


@jax.jit
def match_and_measure(
    pose: jaxlie.SE3, status: Int[Array, ""], indices: Int[Array, "N"] | Int[np.ndarray, "N"], problem: Problem
) -> tuple[Correspondences, Measurement]:
    settings = problem.settings
    distance = jnp.where(status == _COARSE, settings.max_distance, settings.fine_distance)
    matches = gate(pose, problem.source, problem.target, indices, distance)
    return matches, measure(pose, problem.model(matches), problem.evidence)


@jax.jit
def update(
    pose: jaxlie.SE3, status: Int[Array, ""], num_iterations: Int[Array, ""], measured: Measurement, settings: Settings
) -> State:
    """Update the pose, unless it has come to rest. Compiled once, whatever the size of the clouds."""
    radius = jnp.where(measured.moments.radius > 0, measured.moments.radius, 1)
    directions, basis = None, jnp.eye(6, dtype=radius.dtype)
    degenerate = jnp.bool_(False)
    with jax.default_matmul_precision("highest"):
        if measured.felt is not None:
            directions = find_directions(measured.felt, measured.moments.center, radius)
            degenerate = ~jnp.all(directions.held)
            # What nothing holds would follow the nearest neighbours' pull: it stays where the start has it.
            basis = jnp.asarray(directions.twists).T * (directions.held | ~settings.hold_free_directions)
        change = solve_update(measured.moments, radius, basis)
    moved = move_pose(pose, change.twist, measured.moments.center)
    coarse, settled = status == _COARSE, status == _SETTLED
    translation_step = jnp.linalg.norm(change.twist[:3])
    rotation_step = jnp.linalg.norm(change.twist[3:])

    def below(times: float) -> Bool[Array, ""]:
        return (translation_step <= times * settings.translation_tolerance) & (
            rotation_step <= times * settings.rotation_tolerance
        )

    motion = translation_step + radius * rotation_step
    nearly = below(_NEARLY_AT_REST) & (motion <= _SHARE_OF_GATE * settings.fine_distance)
    at_rest = below(1.0) | (coarse & nearly)
    finite = jnp.isfinite(measured.moments.e) & jnp.all(jnp.isfinite(moved.wxyz_xyz))
    outcomes: tuple[tuple[Array, int], ...] = (
        (measured.num_inliers < _MIN_CORRESPONDENCES, Status.TOO_FEW_CORRESPONDENCES),
        (~finite, Status.NON_FINITE),
        (settled & (change.degenerate | degenerate), Status.DEGENERATE),
        (settled, Status.CONVERGED),
        (num_iterations >= settings.max_iterations, Status.MAX_ITERATIONS),
        (coarse & ~at_rest, _COARSE),
        (at_rest & ~coarse, _SETTLED),
    )
    conditions, codes = zip(*outcomes, strict=True)
    status = jnp.select(list(conditions), [jnp.int32(code) for code in codes], jnp.int32(_RUNNING))
    record = (measured.cost, measured.rmse, measured.num_inliers, translation_step, rotation_step)
    adjoint = adjoint_to_center(pose, measured.moments.center)
    return State(
        # The pose that all this was measured at is the one that is returned.
        pose=jaxlie.SE3(jnp.where(status < 0, moved.wxyz_xyz, pose.wxyz_xyz)),
        status=status,
        num_iterations=num_iterations + (status < 0),
        measured=measured,
        information=adjoint.T @ change.information @ adjoint,
        directions=directions,
        record=jnp.stack([number.astype(measured.rmse.dtype) for number in record]),
    )


def history_of(records: Float[Array, "*batch T 5"] | Float[np.ndarray, "*batch T 5"]) -> dict[str, Any]:
    """By name."""
    return {name: records[..., i] for i, name in enumerate(_RECORDED)}


def run_on_host(problem: Problem, search: AbstractSearch) -> tuple[State, Correspondences, dict[str, np.ndarray]]:
    """The loop for concrete inputs: matches from the host's tree between compiled steps."""
    pose, settings = problem.start, problem.settings
    index, source = search.index(problem.target.rows), problem.source.rows
    status, num_iterations = np.asarray(_first_status(settings)), np.asarray(0, np.int32)
    followed, records = 0, []
    while status < 0:
        if status != _SETTLED:
            stride = int(_stride(status, num_iterations, settings)) if status == _COARSE else 1
            if stride != followed:
                followed, part = stride, source if stride == 1 else _part(stride, source)
                nearest = index.follow(part, settings.max_distance)
            indices = nearest(pose.wxyz_xyz)
        matches, measured = match_and_measure(pose, status, indices, problem)
        state = update(pose, status, num_iterations, measured, settings)
        pose, num_iterations = state.pose, state.num_iterations
        # As a number of the host's: comparing arrays would be a program of its own, each time.
        status = np.asarray(state.status)
        records.append(state.record)
    return state, matches, history_of(np.stack([np.asarray(record) for record in records]))


@jax.jit
def _part(stride: Int[ArrayLike, ""], source: Rows) -> Rows:
    """One row of so many; the others match nothing."""
    part = jnp.arange(source.valid.size) % stride == 0
    return eqx.tree_at(lambda rows: rows.valid, source, source.valid & part)


def _measure_and_update(
    pose: jaxlie.SE3,
    status: Int[Array, ""],
    num_iterations: Int[Array, ""],
    indices: Int[Array, "*candidates N"],
    match: Match,
    settings: Settings,
) -> tuple[State, Correspondences]:
    matches, measured = match(pose, status, num_iterations, indices)
    return update(pose, status, num_iterations, measured, settings), matches


def _begin(pose: jaxlie.SE3, match: Match, shape: tuple[int, ...], settings: Settings, max_iterations: int) -> Carry:
    """The loop before its first step, with room for all of its history."""
    first, zero = _first_status(settings), jnp.int32(0)
    step = partial(_measure_and_update, match=match, settings=settings)
    shapes = jax.eval_shape(step, pose, first, zero, jnp.zeros(shape, jnp.int32))
    state, matches = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    state = eqx.tree_at(lambda state: (state.pose, state.status), state, (pose, first))
    # One for each update, and one for the measurement at the end.
    return state, matches, jnp.full((max_iterations + 1, len(_RECORDED)), jnp.nan, state.record.dtype)


def _step(carry: Carry, match: Match, settings: Settings) -> Carry:
    before, matches, records = carry
    count = before.num_iterations
    state, matches = _measure_and_update(before.pose, before.status, count, matches.indices, match, settings)
    return state, matches, records.at[count].set(state.record)


def _while_loop(
    pose: jaxlie.SE3, match: Match, shape: tuple[int, ...], settings: Settings, max_iterations: int
) -> Carry:
    """The loop inside a transformation."""
    start = _begin(pose, match, shape, settings, max_iterations)
    return jax.lax.while_loop(lambda carry: carry[0].status < 0, partial(_step, match=match, settings=settings), start)


@partial(jax.jit, static_argnames="max_iterations")
def run_traced(
    problem: Problem, search: AbstractSearch, max_iterations: int
) -> tuple[State, Correspondences, dict[str, Array]]:
    """The loop of `register` for traced inputs; pose and matches are constants to autodiff."""
    shape = problem.source.valid.shape
    match = _matching(problem, search)
    state, matches, records = _while_loop(problem.start, match, shape, problem.settings, max_iterations)
    return state, matches, history_of(records)


def _matching(problem: Problem, search: AbstractSearch) -> Match:
    def match(
        pose: jaxlie.SE3, status: Int[Array, ""], num_iterations: Int[Array, ""], indices: Int[Array, "N"]
    ) -> tuple[Correspondences, Measurement]:
        running = status != _SETTLED
        stride = _stride(status, num_iterations, problem.settings)
        rows = _part(stride, problem.source.rows), problem.target.rows
        found = search.nearest_traced(pose.wxyz_xyz, *rows, problem.settings.max_distance, running)[0]
        return match_and_measure(pose, status, jnp.where(running, found, indices), problem)

    return match


@partial(jax.jit, static_argnames="max_iterations")
def begin_lane(problem: Problem, search: AbstractSearch, max_iterations: int) -> Carry:
    """The loop of `register` before its first step."""
    shape = problem.source.valid.shape
    return _begin(problem.start, _matching(problem, search), shape, problem.settings, max_iterations)


@partial(jax.jit, static_argnames="num_steps")
def run_lanes(problems: Problem, carries: Carry, search: AbstractSearch, num_steps: int) -> Carry:
    """Some steps of many loops at once, whose arrays are stacked; those that have ended stay as they are."""

    def run(problem: Problem, carry: Carry) -> Carry:
        step = partial(_step, match=_matching(problem, search), settings=problem.settings)
        return jax.lax.while_loop(
            lambda counted: (counted[0][0].status < 0) & (counted[1] < num_steps),
            lambda counted: (step(counted[0]), counted[1] + 1),
            (carry, jnp.int32(0)),
        )[0]

    return jax.vmap(run)(problems, carries)


@jax.jit
def assess_lanes(problems: Problem, carries: Carry) -> Assessment:
    def of_lane(problem: Problem, carry: Carry) -> Assessment:
        state, matches, _ = carry
        return assess(state, problem.model(matches), problem.evidence)

    return jax.vmap(of_lane)(problems, carries)


@partial(jax.jit, static_argnames="max_iterations")
def align_traced(
    start: jaxlie.SE3, model: Model, settings: Settings, max_iterations: int
) -> tuple[jaxlie.SE3, State, dict[str, Array]]:
    """The loop of `align`: matches stay. Returns the refined pose too."""
    start, constants, settings = jax.lax.stop_gradient((start, model, settings))
    matches = constants[2]

    def match(
        pose: jaxlie.SE3, status: Int[Array, ""], num_iterations: Int[Array, ""], indices: Array
    ) -> tuple[Correspondences, Measurement]:
        return matches, measure(pose, constants, None)

    state, _, records = _while_loop(start, match, matches.indices.shape, settings, max_iterations)
    return refine(state, model), state, history_of(records)


@jax.jit
def refine(state: State, model: Model) -> jaxlie.SE3:
    """The pose of a loop that has ended, with the gradient of the answer."""
    usable = (state.status == Status.CONVERGED) | (state.status == Status.MAX_ITERATIONS)
    if state.directions is not None:
        # The root of g would slide along a direction that the loop has left alone.
        usable = usable & jnp.all(state.directions.held)
    with jax.default_matmul_precision("highest"):
        return refine_pose(state.pose, usable, state.measured.moments, model)


@jax.jit
def assess(state: State, model: Model, evidence: Evidences | None) -> tuple[Float[Array, "6 6"], Directions | None]:
    """Of a loop that has ended: the covariance of its pose, NaN where there is none to be had, and the directions."""
    state, model = jax.lax.stop_gradient((state, model))
    directions, measured = state.directions, state.measured.moments
    radius = jnp.where(measured.radius > 0, measured.radius, 1)
    found = (state.status != Status.TOO_FEW_CORRESPONDENCES) & (state.status != Status.NON_FINITE)
    if directions is None:
        found = found & (state.status != Status.DEGENERATE)
    with jax.default_matmul_precision("highest"):
        covariance = estimate_covariance(state.pose, measured.center, radius, directions, model, evidence)
        if directions is not None:
            directions = directions_at_source(directions, state.pose)
    return jnp.where(found, covariance, jnp.nan), directions
