"""The registration loop inside transformations: one program, compiled for the shapes of the clouds.

Matches come from a host callback, or from XLA alone (`DenseSearch`). Pose and matches are constants to autodiff within
the loop; the implicit derivative is attached to the pose that the loop returns.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.concrete import AnyScalar
from mcgicp_jax._compute.lazy import Lazy
from mcgicp_jax._local_geometry.surface import Surface, searched
from mcgicp_jax._pose_solver.covariance import Moments, Scores, scores_of
from mcgicp_jax._pose_solver.implicit_derivative import Model, with_derivative
from mcgicp_jax._pose_solver.matched import Matched, Motion, distances_within, match_surfaces
from mcgicp_jax._pose_solver.pose_measurements import Fusion
from mcgicp_jax._pose_solver.sums import Sums, sums_of
from mcgicp_jax._registration.assessment import Assessment, assessment_of, moments_of
from mcgicp_jax._registration.loop import AbstractExecutor, LoopResult, iterate
from mcgicp_jax._registration.step import COARSE, RUNNING, SETTLED, Problem, State, root_of
from mcgicp_jax._search.base import AbstractSearch, Correspondences, SearchPoints, by_position
from mcgicp_jax._terms.base import AbstractTerm, is_adaptive, with_numbers_of


class TracedExecutor(AbstractExecutor):
    """Whole arrays inside transformations. While the loop runs, index −1 marks a missing match, see `cleaned`.

    Args:
        search: finds the matches.
        max_iterations: static number of updates that the history has room for.
    """

    # Of soft assignment, see `FixedMatches`.
    _temperature: Float[Array, ""] | None = None

    def __init__(self, problem: Problem, search: Any, max_iterations: int):
        super().__init__(problem)
        self._search, self._max_iterations = search, max_iterations

    def first_matches(self) -> Correspondences:
        shape, dtype = (self.problem.num_candidates, self.problem.source.num_points), self.problem.start.wxyz_xyz.dtype
        return Correspondences(jnp.full(shape, -1, jnp.int32), jnp.zeros(shape, dtype), jnp.zeros(shape, bool))

    def begin(self) -> LoopResult:
        problem, first = self.problem, jnp.asarray(self.first_status)
        terms = jax.tree.map(jnp.asarray, problem.terms)
        state = State(problem.start, first, jnp.int32(0))
        loop = LoopResult(state, self.first_matches(), terms, None)
        state = jax.tree.map(
            lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(lambda: self._state_after(loop))
        )
        # One entry per update, and one at the returned pose.
        history = jax.tree.map(lambda leaf: jnp.full(self._max_iterations + 1, jnp.nan, leaf.dtype), state.record)
        return loop._replace(state=state._replace(pose=problem.start, status=first), history=history)

    def _state_after(self, loop: LoopResult) -> State:
        """The state after one step, for its shapes."""
        state = loop.state
        matches = self.match(state, loop.matches)
        sums = self.sums(self.motion(state.pose), matches, loop.terms, jnp.bool_(False))
        return self.update(state, sums)._replace(sums=sums)

    def repeat(self, step: Callable[[LoopResult], LoopResult], loop: LoopResult) -> LoopResult:
        loop = jax.lax.while_loop(lambda loop: loop.state.status < 0, step, loop)
        return loop._replace(matches=cleaned(loop.matches))

    def record(self, history: Any, state: State) -> Any:
        # `num_iterations` counts this update, if it was one.
        place = state.num_iterations - (state.status < 0)
        return jax.tree.map(lambda entries, entry: entries.at[place].set(entry), history, state.record)

    def motion(self, pose: jaxlie.SE3) -> Motion:
        dtype = pose.wxyz_xyz.dtype
        return Motion(pose.rotation().as_matrix().astype(dtype), pose.translation().astype(dtype))

    def match(self, state: State, before: Correspondences) -> Correspondences:
        problem, status, settings = self.problem, state.status, self.problem.settings
        # Under `vmap` the body also runs for finished lanes: no search for them.
        running = (status < 0) & (status != SETTLED)
        source, target = searched(problem.source), searched(problem.target)
        rows, among = _every(settings.stride(status, state.num_iterations), source), target
        if any(term.by_position for term in problem.terms):
            rows, among = (_without_descriptors(status != COARSE, each) for each in (rows, among))
        limit = settings.max_distance
        found = self._search.nearest_traced(state.pose.wxyz_xyz, rows, among, limit, running, problem.num_candidates)
        indices = jnp.where(running, found, before.indices)
        return self._within(self.motion(state.pose), problem.source, indices, settings.distance(status))

    def _within(
        self, motion: Motion, source: Surface, indices: Int[Array, "m N"], max_distance: Float[Array, ""]
    ) -> Correspondences:
        """The matches, valid up to a distance of `max_distance`."""
        target = self.problem.target
        rows = jnp.maximum(indices, 0)
        moved, points = motion.move(source.points), jnp.asarray(target.points)
        distances, near = jax.vmap(lambda row: distances_within(moved, points[row], max_distance))(rows)
        valid = (indices >= 0) & searched(source).valid & jnp.asarray(searched(target).valid)[rows] & near
        return Correspondences(indices, distances, valid)

    def adapt(self, state: State, matches: Any, before: tuple[AbstractTerm, ...]) -> tuple[AbstractTerm, ...]:
        if not is_adaptive(before):
            return before
        return jax.tree.map(partial(jnp.where, state.status == RUNNING), super().adapt(state, matches, before), before)

    def over_rematched(
        self,
        function: Callable[..., Any],
        motion: Motion,
        pose: jaxlie.SE3,
        rows: Int[Array, "n"],
        counts: Bool[Array, "n"],
        *arguments: Any,
    ) -> Any:
        source, among = self._some(rows), by_position(searched(self.problem.target))
        parameters = jnp.concatenate([pose.wxyz_xyz[:4], motion.translation])
        limit = self.problem.settings.fine_distance
        found = self._search.nearest_traced(parameters, by_position(searched(source)), among, limit, jnp.bool_(True))
        matches = self._within(motion, source, found, limit)
        matches = eqx.tree_at(lambda matches: matches.valid, matches, matches.valid & counts)
        return function(motion, self._matched(source, matches, False), *arguments)

    def nearest(self, motion: Motion, matches: Correspondences) -> Correspondences:
        """The first candidates."""
        return jax.tree.map(lambda rows: jnp.asarray(rows).reshape(-1, rows.shape[-1])[:1], matches)

    def over_rows(
        self,
        function: Callable[..., Any],
        motion: Motion,
        matches: Correspondences,
        rows: Int[Array, "n"],
        *arguments: Any,
        with_noise: bool = False,
    ) -> Any:
        some = jax.tree.map(lambda array: jnp.asarray(array)[..., rows], matches)
        return function(motion, self._matched(self._some(rows), some, with_noise), *arguments)

    def sums(
        self, motion: Motion, matches: Correspondences, terms: tuple[AbstractTerm, ...], last: Bool[Array, ""]
    ) -> Sums:
        observed = self.problem.source.channel_observability
        sums = sums_of(motion, self._matched(self.problem.source, matches, observed is not None), terms)
        if sums.channel_observability is None or sums.agreement is None or sums.surplus is None:
            return sums
        agreement = jnp.where(last, sums.agreement, sums.channel_observability)
        return sums._replace(agreement=agreement, surplus=jnp.where(last, sums.surplus, 0))

    def scores(self, motion: Motion, matches: Correspondences, *arguments: Any) -> Scores:
        return scores_of(motion, self._matched(self.problem.source, matches, True), *arguments)

    def each(self, function: Callable[[Any], Any], items: Any) -> Any:
        return jax.lax.map(function, jnp.asarray(items))

    def source_of(self, matches: Correspondences) -> SearchPoints:
        return searched(self.problem.source)

    def _some(self, rows: Int[Array, "n"]) -> Surface:
        return jax.tree.map(lambda array: jnp.asarray(array)[rows], self.problem.source)

    def _matched(self, source: Surface, matches: Correspondences, with_noise: bool) -> Matched:
        target = self.problem.target
        if not with_noise and self._temperature is None:
            source, target = source._replace(noise=None), target._replace(noise=None)
        return match_surfaces(source, target, cleaned(matches), self._temperature, with_search=with_noise)


class FixedMatches(TracedExecutor):
    """Matches that do not change with the pose, as in `estimate_pose`; there is no coarse phase.

    Args:
        matches: used at every pose.
        temperature: of the soft assignment, metres; None for the nearest candidate.
    """

    def __init__(
        self,
        problem: Problem,
        matches: Correspondences,
        temperature: Float[Array, ""] | None,
        max_iterations: int,
    ):
        super().__init__(problem, None, max_iterations)
        self._matches, self._temperature = jax.tree.map(jnp.asarray, matches), temperature

    @property
    def first_status(self) -> Int[AnyScalar, ""]:
        return self.problem.settings.first_status()

    def first_matches(self) -> Correspondences:
        return self._matches

    def match(self, state: State, before: Correspondences) -> Correspondences:
        return before


def cleaned(matches: Correspondences) -> Correspondences:
    """Replace index −1 (no match) by 0; `valid` is False there."""
    return eqx.tree_at(lambda matches: matches.indices, matches, jnp.maximum(matches.indices, 0))


@partial(jax.jit, static_argnames="max_iterations")
def register_traced(problem: Problem, search: AbstractSearch, max_iterations: int) -> LoopResult:
    """The loop of `register`."""
    return iterate(TracedExecutor(problem, search, max_iterations))


@partial(jax.jit, static_argnames="max_iterations")
def estimate_pose_traced(
    problem: Problem, matches: Correspondences, temperature: Float[Array, ""] | None, max_iterations: int
) -> LoopResult:
    """The loop of `estimate_pose`, with fixed matches."""
    return iterate(FixedMatches(problem, matches, temperature, max_iterations))


@jax.jit
def assess(loop: LoopResult, problem: Problem, search: AbstractSearch) -> Assessment:
    """The assessment of the loop of `register`."""
    moments = None if problem.fusion is not None else Lazy.of(moments_traced(loop, problem, search))
    return assessment_of(TracedExecutor(problem, search, 0), loop, moments)


@jax.jit
def moments_traced(loop: LoopResult, problem: Problem, search: AbstractSearch) -> Moments:
    """`moments_of` the loop of `register`."""
    return moments_of(TracedExecutor(problem, search, 0), loop, rematched=True)


@jax.jit
def assess_alignment(loop: LoopResult, problem: Problem, temperature: Float[Array, ""] | None) -> Assessment:
    """The assessment of the loop of `estimate_pose`."""
    executor = FixedMatches(problem, loop.matches, temperature, 0)
    return assessment_of(executor, loop, Lazy.of(moments_of(executor, loop, rematched=False)))


@jax.jit
def differentiable(
    loop: LoopResult, matched: Matched, terms: tuple[AbstractTerm, ...], fusion: Fusion | None = None
) -> State:
    """The final state with the implicit derivative attached to its pose, see `with_derivative`.

    Args:
        matched, terms, fusion: differentiable, and at the matches at which the loop ended.
    """
    state = loop.state
    terms = with_numbers_of(terms, loop.terms)
    with jax.default_matmul_precision("highest"):
        root = jax.lax.stop_gradient(root_of(state, fusion))
        pose = with_derivative(jax.lax.stop_gradient(state.pose.wxyz_xyz), root, Model(matched, terms, fusion))
    return state._replace(pose=jaxlie.SE3(pose))


def _without_descriptors(where: Bool[Array, ""], rows: SearchPoints) -> SearchPoints:
    """Where `where` is True, the rows for a search in position alone: descriptors and penalties are set to 0."""
    factor = jnp.where(where, 0, 1).astype(rows.points.dtype)
    penalty = None if rows.penalty is None else factor * rows.penalty
    return SearchPoints(rows.points, factor * rows.descriptors, rows.valid, penalty)


def _every(stride: Int[Array, ""], source: SearchPoints) -> SearchPoints:
    """Mark all but every `stride`-th row as invalid, so that they match nothing."""
    chosen = jnp.arange(source.valid.size) % stride == 0
    return eqx.tree_at(lambda rows: rows.valid, source, source.valid & chosen)
