"""The registration loop on the host: compiled programs over blocks of rows, with searches for matches in between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from operator import attrgetter
from typing import Any, cast

import jax
import numpy as np
from jaxtyping import Float, Int

from mcgicp_jax._compute.programs import quickly_compiled
from mcgicp_jax._compute.row_functions import RowFunction
from mcgicp_jax._compute.tables import Packed
from mcgicp_jax._pose_solver.covariance import Scores, scores_of
from mcgicp_jax._pose_solver.degeneracy import Directions
from mcgicp_jax._pose_solver.matched import Matches, Motion, inputs_of, of_matches
from mcgicp_jax._pose_solver.sums import Sums, combine, sums_of
from mcgicp_jax._registration.loop import AbstractExecutor, LoopResult, Problem, Record, State, update
from mcgicp_jax._registration.settings import COARSE, RUNNING, SETTLED, Settings, either
from mcgicp_jax._search.base import AbstractIndex, SearchPoints, by_position
from mcgicp_jax._terms.base import AbstractTerm


class HostExecutor(AbstractExecutor):
    """Blocks of rows on the host, for concrete clouds. `index_of(True)` is for a search in position alone."""

    def __init__(self, problem: Problem, index_of: Callable[[bool], AbstractIndex], num_threads: int | None):
        super().__init__(problem)
        self._index_of, self._num_threads = index_of, num_threads
        # Which source rows are followed from pose to pose, and the function that finds their matches.
        self._followed: tuple[int, bool] | None = None
        self._follow: Callable[[Any], Int[np.ndarray, "m N"]] | None = None
        self._settings = Packed.of(problem.settings, num_axes=0)

    def run(self) -> LoopResult:
        problem, history = self.problem, []
        loop = LoopResult(problem.first_state, problem.matches, problem.terms, None)
        while loop.state.status < 0:
            loop = self.step(loop)
            history.append(loop.state.record)
        # Frees the tree: deferred parts of the result keep the executor.
        self._followed = self._follow = None
        sums: Packed[Sums] = Packed(np.asarray(loop.state.sums.table), loop.state.sums.layout)
        records = Record(*map(np.stack, zip(*history, strict=True)))
        return loop._replace(state=loop.state._replace(sums=sums.tree), history=records)

    def match(self, state: State, before: Any) -> Matches:
        status, settings, problem = state.status, self.problem.settings, self.problem
        if status == SETTLED:
            return before
        stride = int(settings.stride(status, state.num_iterations))
        alone = bool(status != COARSE and any(map(attrgetter("by_position"), problem.terms)))
        source: SearchPoints = problem.source.search
        rows = None
        if stride > 1:
            rows = np.arange(problem.source.num_points)[::stride]
            source = jax.tree.map(lambda array: array[::stride], source)
        if self._follow is None or (stride, alone) != self._followed:
            followed = jax.tree.map(np.ascontiguousarray, by_position(source) if alone else source)
            index, limit = self._index_of(alone), float(settings.max_distance)
            self._follow, self._followed = index.follow(followed, limit, problem.num_candidates), (stride, alone)
        indices = self._follow(state.pose.wxyz_xyz)
        limit = either(status == COARSE, settings.max_distance, settings.fine_distance)
        return Matches.of(source, problem.target.search, indices, limit, rows)

    def nearest(
        self, pose: Float[np.ndarray, "7"], source: SearchPoints, alone: bool = True, num_candidates: int = 1
    ) -> Int[np.ndarray, "m n"]:
        return self._index_of(alone).nearest(pose, source, float(self.problem.settings.fine_distance), num_candidates)

    def adapt(self, state: State, matches: Matches, before: tuple[AbstractTerm, ...]) -> tuple[AbstractTerm, ...]:
        return super().adapt(state, matches, before) if state.status == RUNNING else before

    def rows(self, function: Any, motion: Motion, matches: Matches, *arguments: Any, with_noise: bool = False) -> Any:
        applied = self._over(function, motion, matches, arguments, with_noise, total=False)
        return applied.rows(None, self._num_threads if with_noise else 1)[0].tree

    def _over(
        self, function: Any, motion: Motion, matches: Matches, arguments: Any, with_noise: bool, total: bool = True
    ) -> RowFunction:
        """A function of matches, such as `sums_of`, as a row function with its arguments; a sum if `total`."""
        inputs = inputs_of(self.problem.source, self.problem.target, matches, with_noise, with_noise and not total)
        numbers = motion, matches.max_distance, matches.temperature, arguments
        return RowFunction(of_matches(function, total), numbers, inputs, matches.indices.shape[1], total)

    def sums(self, motion: Motion, matches: Matches, terms: tuple[AbstractTerm, ...], last: Any) -> Packed[Sums]:
        # Packed until the loop ends: to pass and to return dozens of arrays takes longer than to use them. Not awaited:
        # `update` is dispatched while they are computed, which saves half of the hand-overs between threads.
        with_slopes = bool(last) and self.problem.source.observes_channels
        arguments = terms, self.problem.settings.near, np.bool_(last)
        applied = self._over(sums_of, motion, matches, arguments, with_slopes)
        first, *others = applied.sums(self._num_threads if with_slopes else 1)
        if not others:
            return first
        tables = np.stack([part.table for part in (first, *others)])
        with np.errstate(over="ignore"):
            sums = combine(Packed(tables.astype(np.float64), first.layout).tree)
            table = np.concatenate([leaf.ravel() for leaf in jax.tree.leaves(sums)]).astype(tables.dtype)
        return Packed(table, first.layout)

    def update(self, state: State, sums: Packed[Sums]) -> State:
        updated = _update(state[:5], sums, self._settings, self.problem.measurements, self.problem.fixed)
        return Packed(np.asarray(updated.table), updated.layout).tree

    def directions_by_all_points(self, loop: LoopResult) -> Directions:
        """The directions at the end of a loop, if points near the sensor counted as all others do."""
        settings = self.problem.settings
        settings = settings._replace(near=np.zeros_like(settings.near))
        other = HostExecutor(replace(self.problem, settings=settings), self._index_of, self._num_threads)
        sums = other.sums(Motion.of(loop.state.pose.wxyz_xyz), loop.matches, loop.terms, True)
        return cast(Directions, other.update(loop.state, sums).directions)

    def scores(self, motion: Motion, matches: Matches, *arguments: Any) -> Scores:
        applied = self._over(scores_of, motion, matches, arguments, self.problem.source.observed)
        parts: list[Scores] = [jax.tree.map(np.asarray, part) for part in applied.sums(self._num_threads, packed=False)]
        # Rows that pad the last block have no matches; their scores are 0.
        rows = jax.tree.map(lambda *blocks: np.concatenate(blocks), *(part[:3] for part in parts))
        sums = jax.tree.map(lambda *blocks: np.sum(blocks, axis=0, dtype=np.float64), *(part[3:] for part in parts))
        return Scores(*rows, *sums)


@partial(quickly_compiled, level=1)
def _update(state: tuple[Any, ...], sums: Packed[Sums], settings: Packed[Settings], *measured: Any) -> Packed[State]:
    return Packed.of(update(*state, sums.tree, settings.tree, *measured), num_axes=0)
