"""The registration loop: find matches at this pose; sum their forces; update the pose; stop when it no longer moves.

The way of a source point from `PointCloud` to `RegistrationResult`, in eight sentences. `preprocess` finds the k
nearest neighbours of the point. `describe` computes its `LocalGeometry` from this neighbourhood: covariance, normal,
channel fits. `surface_of` turns these into a row of a `Surface`: position, the covariance of the method, observability.
Both are row functions (`_compute.row_functions`): on the host their rows are computed when they are first gathered, and
gathered rows are `Rows`. The search finds the target point nearest to the moved point in position and α · channel, as
`Matches`, and the rows of both are `Matched`, from which each term computes a `Linearization`: the cost of the
correspondence, its force (−gradient/2) and stiffness (Hessian/2). `sums_of` adds them over all correspondences to
`Sums`, `update` computes the next `State` from the sums, and search, sums and update repeat until the pose converges.
At the final pose `scores_of` computes the contribution of each correspondence to the covariance of the pose.

The loop is written once. An executor says how its parts are done: blocks of rows on the host, whole arrays inside
transformations, lanes of a vectorised batch.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jaxlie
import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, numpy_for
from mcgicp_jax._pose_solver.covariance import Scores
from mcgicp_jax._pose_solver.matched import Matches, Motion, adapted, sample_of_term
from mcgicp_jax._registration.step import SETTLED, Problem, State, update
from mcgicp_jax._search.base import SearchPoints, by_position
from mcgicp_jax._terms.base import AbstractTerm, is_adaptive


class LoopResult(NamedTuple):
    """The loop after some steps.

    Attributes:
        state: after the last step.
        matches: at the pose before the last update; None before the first.
        terms: as they were at that pose.
        history: records of the steps; arrays with one entry for each possible step inside transformations.
    """

    state: State
    matches: Any
    terms: tuple[AbstractTerm, ...]
    history: Any


class AbstractExecutor(abc.ABC):
    """How the parts of the loop are done for one problem.

    Functions that an executor applies to correspondences are defined at module level, take a `Motion`, `Matched` and
    further arguments, and return a pytree of arrays.
    """

    def __init__(self, problem: Problem):
        self.problem = problem

    @abc.abstractmethod
    def run(self, step: Callable[[LoopResult], LoopResult]) -> LoopResult:
        """Repeat the step while the status is negative, and keep the history."""

    @abc.abstractmethod
    def match(self, state: State, before: Any) -> Matches:
        """The matches at the pose of a state. If its status is `SETTLED`, the previous matches, `before`."""

    @abc.abstractmethod
    def nearest(self, pose: Float[AnyArray, "7"], source: SearchPoints) -> Int[AnyArray, "1 n"]:
        """Target rows nearest in position alone, at a pose `jaxlie.SE3.wxyz_xyz`; −1 for none within the fine
        `max_distance`."""

    @abc.abstractmethod
    def rows(
        self, function: Callable[..., Any], motion: Motion, matches: Matches, *arguments: Any, with_noise: bool = False
    ) -> Any:
        """Apply a function that returns one row per correspondence.

        Args:
            with_noise: whether the surfaces include `noise` and `search`.
        """

    @abc.abstractmethod
    def sums(self, motion: Motion, matches: Matches, terms: tuple[AbstractTerm, ...], last: Bool[AnyScalar, ""]) -> Any:
        """`sums_of` all correspondences, as the executor keeps them while the loop runs.

        Args:
            last: whether the channels of matched points must agree. Far from the right pose they do not, and there the
                channels that each cloud observes guide the pose.
        """

    def update(self, state: State, sums: Any) -> State:
        """The state after an update of the pose, without the sums."""
        problem = self.problem
        return update(*state[:5], sums, problem.settings, problem.measurements, problem.fixed)

    @abc.abstractmethod
    def scores(self, motion: Motion, matches: Matches, *arguments: Any) -> Scores:
        """`scores_of` all correspondences; further arguments are those of that function."""

    def adapt(self, state: State, matches: Matches, before: tuple[AbstractTerm, ...]) -> tuple[AbstractTerm, ...]:
        """The terms with their numbers estimated at the pose of a state, from a sample of the matches.

        They are estimated anew, not from those `before`, which an executor keeps outside the fine phase.
        """
        terms = self.problem.terms
        if not is_adaptive(terms):
            return terms
        motion, valid = Motion.of(state.pose.wxyz_xyz), self.source_of(matches).valid
        return adapted(terms, valid, lambda term, rows: self.rows(sample_of_term, motion, matches.some(rows), term))

    def source_of(self, matches: Matches) -> SearchPoints:
        """The source points that have these matches: in the coarse phase on the host, every `coarse_stride`-th."""
        source = self.problem.source.search
        return source if matches.rows is None else jax.tree.map(lambda array: array[matches.rows], source)

    def rematched(
        self, pose: jaxlie.SE3, shift: Float[AnyArray, "3"], rows: Int[AnyArray, "n"], counts: Bool[AnyArray, "n"]
    ) -> tuple[Motion, Matches]:
        """A pose that is moved by `shift` metres, and new matches of some source points there, in position alone.

        Args:
            counts: False for rows to leave unmatched.
        """
        source, target, xp = self.problem.source.search, self.problem.target.search, numpy_for(rows, counts)
        motion = Motion.of(pose.wxyz_xyz)
        motion = motion._replace(translation=motion.translation + shift)
        points = by_position(jax.tree.map(lambda array: xp.asarray(array)[rows], source))
        indices = self.nearest(xp.concatenate([pose.wxyz_xyz[:4], motion.translation]), points)
        limit = self.problem.settings.fine_distance
        return motion, Matches.of(points, target, xp.where(counts, indices, -1), limit, rows)

    def distances(self, motion: Motion, matches: Matches) -> Float[AnyArray, "m n"]:
        """Distances of all matches, metres; infinite where there is none."""
        xp = numpy_for(motion, matches, self.problem.source.points)
        points, targets = xp.asarray(self.problem.source.points), xp.asarray(self.problem.target.points)
        with np.errstate(invalid="ignore", over="ignore"):
            moved = motion.move(points if matches.rows is None else points[matches.rows]).T
            apart = targets[xp.maximum(matches.indices, 0)] - moved
            return xp.where(matches.indices >= 0, xp.linalg.norm(apart, axis=-1), np.inf)

    def nearest_candidates(self, motion: Motion, matches: Matches) -> Matches:
        """The nearest candidate of each source point alone. Followed candidates are in any order."""
        distances = self.distances(motion, matches)
        xp = numpy_for(distances)
        first = xp.argmin(distances, axis=0)[None]
        return matches._replace(indices=xp.take_along_axis(matches.indices, first, axis=0))

    def within(self, motion: Motion, matches: Matches) -> Matches:
        """The matches without those that are further apart than `max_distance`."""
        near = self.distances(motion, matches) <= matches.max_distance
        return matches._replace(indices=numpy_for(near).where(near, matches.indices, -1))


def iterate(executor: AbstractExecutor) -> LoopResult:
    """Run the loop: find matches at this pose; sum their forces; update the pose; stop when it no longer moves."""
    return executor.run(partial(step, executor))


def step(executor: AbstractExecutor, loop: LoopResult) -> LoopResult:
    """One step of the loop."""
    state = loop.state
    matches = executor.match(state, loop.matches)
    terms = executor.adapt(state, matches, loop.terms)
    sums = executor.sums(Motion.of(state.pose.wxyz_xyz), matches, terms, state.status == SETTLED)
    # The sums are not an output of the compiled update, which would copy them.
    state = executor.update(state, sums)._replace(sums=sums)
    return LoopResult(state, matches, terms, loop.history)
