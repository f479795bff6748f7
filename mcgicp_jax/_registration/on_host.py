"""The registration loop on the host: compiled programs over blocks of rows, with searches for matches in between."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, cached_property, wraps
from typing import Any, NamedTuple

import jax
import jaxlie
import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._compute.packing import Packed
from mcgicp_jax._compute.quick_compilation import quickly_compiled
from mcgicp_jax._compute.row_functions import GivenTable, Input, RowFunction, Rows
from mcgicp_jax._math.poses import rotation_from_quaternion
from mcgicp_jax._pose_solver.covariance import Scores, scores_of
from mcgicp_jax._pose_solver.matched import Motion, matched_rows
from mcgicp_jax._pose_solver.pose_measurements import Fusion
from mcgicp_jax._pose_solver.sums import Sums, combine, sums_of
from mcgicp_jax._registration.loop import AbstractExecutor, LoopResult
from mcgicp_jax._registration.step import COARSE, SETTLED, Problem, Record, Settings, State, update
from mcgicp_jax._search.base import AbstractIndex, Correspondences, SearchPoints, by_position
from mcgicp_jax._terms.base import AbstractTerm


class _Matches(NamedTuple):
    """Target rows (m, n) of the m candidates of each source point, −1 where there is none or a point is padding.

    `rows` are those of the table of the source (None: all), and `source` these points. `max_distance` is applied when
    the matches are used; `temperature` is that of `Matched`.
    """

    rows: Int[np.ndarray, "n"] | None
    source: SearchPoints
    indices: Int[np.ndarray, "m n"]
    max_distance: Any
    temperature: Any = None

    @staticmethod
    def of(
        rows: Any, source: SearchPoints, target: SearchPoints, indices: Int[np.ndarray, "m n"], max_distance: Any
    ) -> _Matches:
        found = (indices >= 0) & source.valid & target.valid[np.maximum(indices, 0)]
        return _Matches(rows, source, np.where(found, indices, -1), max_distance)


class HostExecutor(AbstractExecutor):
    """Blocks of rows on the host for one pair of concrete clouds.

    Args:
        index_of: the index of the target; for a search in position alone if called with True.
        num_threads: largest number of threads; None for no limit.
    """

    def __init__(self, problem: Problem, index_of: Callable[[bool], AbstractIndex], num_threads: int | None):
        super().__init__(problem)
        self._source, self._target = problem.source, problem.target
        self._index_of, self.num_threads = index_of, num_threads
        # Which source rows are followed from pose to pose, and the function that finds their matches.
        self._followed: tuple[int, bool] | None = None
        self._nearest: Callable[[Any], Int[np.ndarray, "m n"]]
        self._settings = Packed.of(problem.settings, num_axes=0)

    def begin(self) -> LoopResult:
        state = State(self.problem.start, np.asarray(self.first_status), np.int32(0))
        return LoopResult(state, None, self.problem.terms, [])

    def repeat(self, step: Callable[[LoopResult], LoopResult], loop: LoopResult) -> LoopResult:
        while loop.state.status < 0:
            loop = step(loop)
        # Frees the tree: deferred parts of the result keep the executor.
        self._followed, self._nearest = None, _no_matches
        history = Record(*map(np.stack, zip(*loop.history, strict=True)))
        sums: Packed[Sums] = Packed(np.asarray(loop.state.sums.table), loop.state.sums.layout)
        return loop._replace(state=loop.state._replace(sums=sums.tree), history=history)

    def record(self, history: Any, state: State) -> list[Record]:
        return [*history, state.record]

    def motion(self, pose: jaxlie.SE3) -> Motion:
        parameters = np.asarray(pose.wxyz_xyz)
        rotation = rotation_from_quaternion(parameters[:4].astype(np.float64))
        return Motion(rotation.astype(self.problem.source.points.dtype), parameters[4:])

    def match(self, state: State, before: Any) -> _Matches:
        status, settings, problem = state.status, self.problem.settings, self.problem
        if status == SETTLED:
            return before
        stride = int(settings.stride(status, state.num_iterations))
        alone = bool(status != COARSE and any(term.by_position for term in problem.terms))
        every = slice(None, None, stride)
        rows: SearchPoints = jax.tree.map(lambda array: array[every], self._source.search)
        if (stride, alone) != self._followed:
            self._followed, limit = (stride, alone), float(settings.max_distance)
            among = by_position(rows) if alone else rows
            self._nearest = self._index_of(alone).follow(
                jax.tree.map(np.ascontiguousarray, among), limit, problem.num_candidates
            )
        indices = self._nearest(state.pose.wxyz_xyz)
        chosen = None if stride == 1 else np.arange(self._source.num_points)[every]
        return _Matches.of(chosen, rows, self._target.search, indices, settings.distance(status))

    def adapt(self, state: State, matches: Any, before: tuple[AbstractTerm, ...]) -> tuple[AbstractTerm, ...]:
        return before if state.status in (COARSE, SETTLED) else super().adapt(state, matches, before)

    def source_of(self, matches: _Matches) -> SearchPoints:
        return matches.source

    def correspondences(self, loop: LoopResult) -> tuple[Int[np.ndarray, "m N"], Bool[np.ndarray, "m N"]]:
        """Target rows matched with all source points at the final pose, and whether the matches count."""
        matches, rows = loop.matches, np.maximum(loop.matches.indices, 0)
        with np.errstate(invalid="ignore", over="ignore"):
            distances = np.linalg.norm(self._apart(self.motion(loop.state.pose), matches), axis=-1)
        return rows, (matches.indices >= 0) & (distances <= matches.max_distance)

    def _apart(self, motion: Motion, matches: _Matches) -> Float[np.ndarray, "m n 3"]:
        moved = matches.source.points @ motion.rotation.T + motion.translation
        return self._target.points[np.maximum(matches.indices, 0)] - moved

    def over_rematched(
        self,
        function: Callable[..., Any],
        motion: Motion,
        pose: jaxlie.SE3,
        rows: Int[np.ndarray, "n"],
        counts: Bool[np.ndarray, "n"],
        *arguments: Any,
    ) -> Any:
        source: SearchPoints = jax.tree.map(lambda array: array[rows], self._source.search)
        limit = self.problem.settings.fine_distance
        parameters = np.concatenate([np.asarray(pose.wxyz_xyz)[:4], motion.translation])
        indices = self._index_of(True).nearest(parameters, by_position(source), float(limit))
        matches = _Matches.of(rows, source, self._target.search, np.where(counts, indices, -1), limit)
        return self.over_rows(function, motion, matches, np.arange(rows.size), *arguments)

    def nearest(self, motion: Motion, matches: _Matches) -> _Matches:
        """Followed candidates are in any order, so the nearest one is searched."""
        apart = self._apart(motion, matches)
        far = np.where(matches.indices >= 0, np.einsum("mni,mni->mn", apart, apart), np.inf)
        nearest = np.argmin(far, axis=0)[None]
        return matches._replace(indices=np.take_along_axis(matches.indices, nearest, axis=0))

    def over_rows(
        self,
        function: Callable[..., Any],
        motion: Motion,
        matches: _Matches,
        rows: Int[np.ndarray, "n"],
        *arguments: Any,
        with_noise: bool = False,
    ) -> Any:
        chosen = rows if matches.rows is None else matches.rows[rows]
        matches = matches._replace(rows=chosen, indices=matches.indices[:, rows])
        applied = self._applied(_rows_of(function, with_noise), motion, matches, arguments, with_noise, with_noise)
        (found,) = applied.rows(None, self.num_threads if with_noise else 1)
        return found.tree

    def _applied(
        self,
        function: Callable[..., Any],
        motion: Motion,
        matches: _Matches,
        arguments: tuple[Any, ...],
        with_noise: bool,
        with_search: bool = False,
        total: bool = False,
    ) -> RowFunction:
        """A row function of matches with its arguments."""
        source, target = self._source, self._target
        rows, indices = matches.rows, matches.indices.T
        of_table = source.rows if rows is None else rows if source.rows is None else source.rows[rows]
        inputs = [Input(source.table, of_table), Input(target.table, indices)]
        if with_noise:
            inputs += [each._replace(part=1) for each in inputs]
        if with_search or matches.temperature is not None:
            inputs += [Input(self._searches[0], rows), Input(self._searches[1], indices)]
        numbers = motion, matches.max_distance, matches.temperature, arguments
        return RowFunction(function, numbers, inputs, len(indices), total)

    @cached_property
    def _observes_channels(self) -> bool:
        surface = self._source.table.known(np.zeros(0, int))[0].tree
        return surface.channel_observability is not None

    @cached_property
    def _searches(self) -> tuple[GivenTable, GivenTable]:
        return GivenTable(self._source.search), GivenTable(self._target.search)

    def sums(self, motion: Motion, matches: _Matches, terms: tuple[AbstractTerm, ...], last: Any) -> Packed[Sums]:
        # Packed until the loop ends: to pass and to return dozens of arrays takes longer than to use them. Not awaited:
        # `update` is dispatched while they are computed, which saves half of the hand-overs between threads.
        with_slopes = bool(last) and self._observes_channels
        applied = self._applied(_of_matches(sums_of, with_slopes), motion, matches, (terms,), with_slopes, total=True)
        parts: list[Packed[Sums]] = applied.sums(self.num_threads if with_slopes else 1)
        return parts[0] if len(parts) == 1 else _combined(parts)

    def update(self, state: State, sums: Packed[Sums]) -> State:
        updated = _update(state.pose, state.status, state.num_iterations, sums, self._settings, self.problem.fusion)
        return Packed(np.asarray(updated.table), updated.layout).tree

    def scores(self, motion: Motion, matches: _Matches, *arguments: Any) -> Scores:
        noise = self._source.observed
        applied = self._applied(_of_matches(scores_of, noise), motion, matches, arguments, noise, total=True)
        parts: list[Scores] = [jax.tree.map(np.asarray, part) for part in applied.sums(self.num_threads, packed=False)]
        jacobian, bias = (
            np.sum([getattr(part, name).astype(np.float64) for part in parts], axis=0) for name in ("jacobian", "bias")
        )
        # Rows that pad the last block have no matches; their scores are 0.
        wrenches, valid, cells = (
            None if getattr(parts[0], name) is None else np.concatenate([getattr(part, name) for part in parts])
            for name in ("wrenches", "valid", "cells")
        )
        return Scores(wrenches, valid, cells, jacobian, bias)

    def each(self, function: Callable[[Any], Any], items: Any) -> Any:
        return jax.tree.map(lambda *results: np.stack(results), *[function(item) for item in np.asarray(items)])


class FixedMatchesOnHost(HostExecutor):
    """Matches that do not change with the pose, as in `estimate_pose`; there is no coarse phase.

    Args:
        matches: used at every pose.
        temperature: of the soft assignment, metres; None for the nearest candidate.
    """

    def __init__(self, problem: Problem, matches: Correspondences, temperature: Any, num_threads: int | None):
        super().__init__(problem, _no_index, num_threads)
        valid = np.asarray(matches.valid).reshape(-1, problem.source.num_points)
        indices = np.where(valid, np.asarray(matches.indices).reshape(valid.shape), -1)
        infinite = np.asarray(np.inf, problem.source.points.dtype)
        fixed = _Matches.of(None, self._source.search, self._target.search, indices, infinite)
        self._fixed = fixed if temperature is None else fixed._replace(temperature=np.asarray(temperature))

    @property
    def first_status(self) -> Any:
        return self.problem.settings.first_status()

    def match(self, state: State, before: Any) -> _Matches:
        return self._fixed


def _no_matches(pose: Any) -> Int[np.ndarray, "m N"]:
    raise ValueError("matches: expected a loop that has not ended")


def _no_index(position_alone: bool) -> AbstractIndex:
    raise ValueError("matches: expected a registration that searches for them")


@cache
def _of_matches(function: Callable[..., Any], with_noise: bool) -> Callable[..., Any]:
    """A function of a motion, `Matched` and further arguments as a row function."""

    def of_matches(numbers: tuple[Motion, Any, Any, tuple[Any, ...]], *rows: Rows) -> Any:
        motion, max_distance, temperature, arguments = numbers
        matched = matched_rows(rows, temperature, with_noise)
        return function(motion, matched.within(motion.move(matched.source.points), max_distance), *arguments)

    of_matches.__name__ = function.__name__
    return of_matches


@cache
def _rows_of(function: Callable[..., Any], with_noise: bool) -> Callable[..., Any]:
    """The same where the function returns one row for each match."""
    of_matches = _of_matches(function, with_noise)
    return wraps(of_matches)(lambda numbers, *rows: (of_matches(numbers, *rows),))


def _combined(parts: list[Packed[Sums]]) -> Packed[Sums]:
    """The sums of all blocks."""
    tables, dtype = np.stack([part.table for part in parts]), parts[0].table.dtype
    with np.errstate(over="ignore"):
        sums = combine(Packed(tables.astype(np.float64), parts[0].layout).tree)
        table = np.concatenate([each.ravel() for each in jax.tree.leaves(sums)]).astype(dtype)
    return Packed(table, parts[0].layout)


@quickly_compiled
def _update(
    pose: jaxlie.SE3,
    status: Any,
    num_iterations: Any,
    sums: Packed[Sums],
    settings: Packed[Settings],
    fusion: Fusion | None,
) -> Packed[State]:
    """`update` with packed arguments and result."""
    return Packed.of(update(pose, status, num_iterations, sums.tree, settings.tree, fusion), num_axes=0)
