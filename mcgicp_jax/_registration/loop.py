"""The registration loop: find matches at this pose; sum their forces; update the pose; stop when it no longer moves.

The way of a source point from `PointCloud` to `RegistrationResult`, in eight sentences. `preprocess` finds the k
nearest neighbours of the point. `describe` computes its `LocalGeometry` from this neighbourhood: covariance, normal,
channel fits. `surface_of` turns these into a row of a `Surface`: position, the covariance of the method, observability.
Both are row functions (`_compute.row_functions`): on the host their rows are computed when they are first gathered, and
gathered rows are `Rows`. The search finds the target point nearest to the moved point in position and α · channel, and
the rows of both are `Matched`, from which each term computes a `Linearization`: the cost of the correspondence, its
force (−gradient/2) and stiffness (Hessian/2). `sums_of` adds them over all correspondences to `Sums`, `update` computes
the next `State` from the sums, and search, sums and update repeat until the pose converges. At the final pose
`scores_of` computes the contribution of each correspondence to the covariance of the pose.

The loop is written once. An executor says how its parts are done: blocks of rows on the host, whole arrays inside
transformations, lanes of a vectorised batch.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jaxlie
from jaxtyping import Bool, Int

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar
from mcgicp_jax._pose_solver.adaptation import adapted, sample_of_term
from mcgicp_jax._pose_solver.covariance import Scores
from mcgicp_jax._pose_solver.matched import Motion
from mcgicp_jax._registration.step import SETTLED, Problem, State, update
from mcgicp_jax._search.base import SearchPoints
from mcgicp_jax._terms.base import AbstractTerm, is_adaptive

Result = TypeVar("Result")


class LoopResult(NamedTuple):
    """The loop after some steps.

    Attributes:
        state: after the last step.
        matches: at the pose before the last update, as the executor keeps them.
        terms: as they were at that pose.
        history: of the steps; a list, or arrays with one entry for each possible step.
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

    @property
    def first_status(self) -> Int[AnyScalar, ""]:
        return self.problem.first_status

    @abc.abstractmethod
    def begin(self) -> LoopResult:
        """The loop before its first step."""

    @abc.abstractmethod
    def repeat(self, step: Callable[[LoopResult], LoopResult], loop: LoopResult) -> LoopResult:
        """Repeat the step while the status is negative."""

    @abc.abstractmethod
    def record(self, history: Any, state: State) -> Any:
        """The history with the record of the step that led to this state."""

    @abc.abstractmethod
    def motion(self, pose: jaxlie.SE3) -> Motion:
        """The pose in the precision of the points."""

    @abc.abstractmethod
    def match(self, state: State, before: Any) -> Any:
        """The matches at the pose of a state. If its status is `SETTLED`, the previous matches, `before`."""

    @abc.abstractmethod
    def nearest(self, motion: Motion, matches: Any) -> Any:
        """The nearest candidate of each source point alone."""

    @abc.abstractmethod
    def source_of(self, matches: Any) -> SearchPoints:
        """The source points that are matched: in the coarse phase on the host, every `coarse_stride`-th."""

    @abc.abstractmethod
    def over_rows(
        self,
        function: Callable[..., Result],
        motion: Motion,
        matches: Any,
        rows: Int[AnyArray, "n"],
        *arguments: Any,
        with_noise: bool = False,
    ) -> Result:
        """Apply a function that returns one row per correspondence to the matches of some source points.

        Args:
            rows: of `source_of` the matches.
            with_noise: whether the surfaces include `noise` and `search`.
        """

    @abc.abstractmethod
    def over_rematched(
        self,
        function: Callable[..., Result],
        motion: Motion,
        pose: jaxlie.SE3,
        rows: Int[AnyArray, "n"],
        counts: Bool[AnyArray, "n"],
        *arguments: Any,
    ) -> Result:
        """As `over_rows`, for new matches at another pose, nearest in position alone.

        Args:
            motion: the other pose, with the rotation of `pose`.
            rows: of the source.
            counts: False for rows to leave unmatched.
        """

    @abc.abstractmethod
    def sums(self, motion: Motion, matches: Any, terms: tuple[AbstractTerm, ...], last: Bool[AnyScalar, ""]) -> Any:
        """`sums_of` all correspondences, as the executor keeps them while the loop runs.

        Args:
            last: whether the channels of matched points must agree. Far from the right pose they do not, and there the
                channels that each cloud observes guide the pose.
        """

    def update(self, state: State, sums: Any) -> State:
        """The state after an update of the pose, without the sums."""
        problem = self.problem
        return update(state.pose, state.status, state.num_iterations, sums, problem.settings, problem.fusion)

    @abc.abstractmethod
    def scores(self, motion: Motion, matches: Any, *arguments: Any) -> Scores:
        """`scores_of` all correspondences; further arguments are those of that function."""

    @abc.abstractmethod
    def each(self, function: Callable[[Any], Result], items: Any) -> Result:
        """The results of a function for each item along the first axis, stacked."""

    def adapt(self, state: State, matches: Any, before: tuple[AbstractTerm, ...]) -> tuple[AbstractTerm, ...]:
        """The terms with their numbers estimated at the pose of a state, from a sample of the matches.

        They are estimated anew, not from those `before`, which an executor keeps outside the fine phase.
        """
        terms = self.problem.terms
        if not is_adaptive(terms):
            return terms
        motion, valid = self.motion(state.pose), self.source_of(matches).valid
        return adapted(terms, valid, lambda term, rows: self.over_rows(sample_of_term, motion, matches, rows, term))


def iterate(executor: AbstractExecutor) -> LoopResult:
    """Run the loop: find matches at this pose; sum their forces; update the pose; stop when it no longer moves."""
    return executor.repeat(partial(step, executor), executor.begin())


def step(executor: AbstractExecutor, loop: LoopResult) -> LoopResult:
    """One step of the loop."""
    state = loop.state
    matches = executor.match(state, loop.matches)
    terms = executor.adapt(state, matches, loop.terms)
    sums = executor.sums(executor.motion(state.pose), matches, terms, state.status == SETTLED)
    state = executor.update(state, sums)
    # Not an output of the compiled update, which would copy the sums.
    state = state._replace(sums=sums)
    return LoopResult(state, matches, terms, executor.record(loop.history, state))
