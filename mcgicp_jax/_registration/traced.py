"""The registration loop inside transformations: one program, compiled for the shapes of the clouds.

Matches come from a host callback, or from XLA alone (`DenseSearch`). Pose and matches are constants to autodiff within
the loop; the implicit derivative is attached to the pose that the loop returns.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.row_functions import whole
from mcgicp_jax._pose_solver.covariance import Moments, Scores, scores_of
from mcgicp_jax._pose_solver.implicit_derivative import Model, with_derivative
from mcgicp_jax._pose_solver.matched import Matches, Motion, inputs_of, match_surfaces, of_matches
from mcgicp_jax._pose_solver.sums import Sums, sums_of
from mcgicp_jax._registration.assessment import Assessment, assessment_of, moments_of
from mcgicp_jax._registration.loop import AbstractExecutor, LoopResult, Problem, State, root_of
from mcgicp_jax._registration.settings import COARSE, RUNNING, SETTLED, either
from mcgicp_jax._search.base import AbstractSearch, SearchPoints, by_position
from mcgicp_jax._terms.base import AbstractTerm, with_numbers_of


class TracedExecutor(AbstractExecutor):
    """Whole arrays inside transformations. Without `search`, matches are fixed."""

    def __init__(self, problem: Problem, search: Any, max_iterations: int):
        super().__init__(problem)
        self._search, self._max_iterations = search, max_iterations

    def run(self, max_updates: Any = None) -> LoopResult:
        """The loop at its end, or after `max_updates`, with a negative status."""
        problem, first = self.problem, self.problem.first_state
        nowhere = jnp.full((problem.num_candidates, problem.source.num_points), -1, jnp.int32)
        matches = problem.matches or Matches(nowhere, jnp.zeros_like(problem.settings.fine_distance))
        loop = LoopResult(first, matches, jax.tree.map(jnp.asarray, problem.terms), None)
        # The loop carries a whole state from the beginning.
        after = jax.eval_shape(lambda: super(TracedExecutor, self).step(loop).state)
        state = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), after)
        # One entry per update, and one at the returned pose.
        history = jax.tree.map(lambda leaf: jnp.full(self._max_iterations + 1, jnp.nan, leaf.dtype), state.record)
        loop = loop._replace(state=state._replace(pose=first.pose, status=first.status), history=history)

        def unfinished(loop: LoopResult) -> Bool[Array, ""]:
            return (loop.state.status < 0) & (max_updates is None or loop.state.num_iterations < max_updates)

        return jax.lax.while_loop(unfinished, self.step, loop)

    def step(self, loop: LoopResult) -> LoopResult:
        loop = super().step(loop)
        state = loop.state
        # `num_iterations` counts this update, if it was one.
        place = state.num_iterations - (state.status < 0)
        history = jax.tree.map(lambda entries, entry: entries.at[place].set(entry), loop.history, state.record)
        return loop._replace(history=history)

    def match(self, state: State, before: Matches) -> Matches:
        problem, status, settings = self.problem, state.status, self.problem.settings
        # Under `vmap` the body also runs for registrations that have ended: no search for them.
        running = (status < 0) & (status != SETTLED)
        source, target = problem.source.search, problem.target.search
        # Rows that are not in the stride are marked as invalid, so that they match nothing.
        taken = jnp.arange(source.valid.size) % settings.stride(status, state.num_iterations) == 0
        source = source._replace(valid=source.valid & taken)
        if any(term.by_position for term in problem.terms):
            # In the fine phase, in position alone.
            factor = jnp.where(status != COARSE, 0, 1).astype(source.points.dtype)
            source, target = (
                side._replace(
                    descriptors=factor * side.descriptors,
                    penalty=None if side.penalty is None else factor * side.penalty,
                )
                for side in (source, target)
            )
        limit, pose = settings.max_distance, state.pose.wxyz_xyz
        indices = self._search.nearest_traced(pose, source, target, limit, running, problem.num_candidates)
        limit = either(status == COARSE, settings.max_distance, settings.fine_distance)
        matches = Matches.of(source, target, indices, limit)
        return matches._replace(indices=jnp.where(running, matches.indices, before.indices))

    def nearest(
        self, pose: Float[Array, "7"], source: SearchPoints, alone: bool = True, num_candidates: int = 1
    ) -> Int[Array, "m n"]:
        target, limit = self.problem.target.search, self.problem.settings.fine_distance
        target = by_position(target) if alone else target
        return self._search.nearest_traced(pose, source, target, limit, jnp.bool_(True), num_candidates)

    def adapt(self, state: State, matches: Matches, before: tuple[AbstractTerm, ...]) -> tuple[AbstractTerm, ...]:
        return jax.tree.map(partial(jnp.where, state.status == RUNNING), super().adapt(state, matches, before), before)

    def rows(self, function: Any, motion: Motion, matches: Matches, *arguments: Any, with_noise: bool = False) -> Any:
        inputs = inputs_of(self.problem.source, self.problem.target, matches, with_noise, with_search=with_noise)
        numbers = motion, matches.max_distance, matches.temperature, arguments
        return of_matches(function)(numbers, *map(whole, inputs))

    def sums(self, motion: Motion, matches: Matches, terms: tuple[AbstractTerm, ...], last: Bool[Array, ""]) -> Sums:
        problem = self.problem
        arguments = terms, problem.settings.near, last
        sums = self.rows(sums_of, motion, matches, *arguments, with_noise=problem.source.observes_channels)
        if sums.channel_observability is None or sums.agreement is None or sums.surplus is None:
            return sums
        agreement = jnp.where(last, sums.agreement, sums.channel_observability)
        return sums._replace(agreement=agreement, surplus=jnp.where(last, sums.surplus, 0))

    def scores(self, motion: Motion, matches: Matches, *arguments: Any) -> Scores:
        return self.rows(scores_of, motion, matches, *arguments, with_noise=self.problem.source.observed)


@partial(jax.jit, static_argnames="max_iterations")
def run_traced(problem: Problem, search: AbstractSearch | None, max_iterations: int) -> LoopResult:
    return TracedExecutor(problem, search, max_iterations).run()


@jax.jit
def assess(loop: LoopResult, problem: Problem, search: AbstractSearch | None) -> Assessment:
    return assessment_of(TracedExecutor(problem, search, 0), loop)


@jax.jit
def moments_traced(loop: LoopResult, problem: Problem, search: AbstractSearch | None) -> Moments:
    return moments_of(TracedExecutor(problem, search, 0), loop)


@jax.jit
def differentiable(loop: LoopResult, problem: Problem, search: AbstractSearch | None) -> State:
    """The final state with the implicit derivative by the problem attached to its pose, see `with_derivative`."""
    loop, fixed = jax.lax.stop_gradient((loop, problem))
    executor, state = TracedExecutor(fixed, search, 0), loop.state
    matches = executor.differentiable_matches(loop)
    if problem.matches is not None:
        matches = matches._replace(temperature=problem.matches.temperature)
    source, target = (surface._replace(noise=None) for surface in (problem.source, problem.target))
    model = Model(match_surfaces(source, target, matches), with_numbers_of(problem.terms, loop.terms), problem.fusion)
    pose = with_derivative(state.pose.wxyz_xyz, root_of(state, fixed.fusion), model)
    return state._replace(pose=jaxlie.SE3(pose))
