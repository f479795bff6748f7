"""The registration loop on the host: compiled programs over blocks of rows, with searches for matches in between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._compute.blocks import map_blocks, map_rows
from mcgicp_jax._compute.packing import Packed
from mcgicp_jax._compute.quick_compilation import quickly_compiled
from mcgicp_jax._local_geometry.surface import Surface, SurfaceNoise, searched
from mcgicp_jax._math.poses import rotation_from_quaternion
from mcgicp_jax._pose_solver.covariance import Scores, scores_of
from mcgicp_jax._pose_solver.matched import Matched, Motion, square_apart
from mcgicp_jax._pose_solver.pose_measurements import Fusion
from mcgicp_jax._pose_solver.sums import Sums, combine, sums_of
from mcgicp_jax._registration.loop import AbstractExecutor, LoopResult
from mcgicp_jax._registration.step import COARSE, SETTLED, Problem, Record, Settings, State, update
from mcgicp_jax._search.base import AbstractIndex, Correspondences, SearchPoints, by_position
from mcgicp_jax._terms.base import AbstractTerm


class _Rows(NamedTuple):
    """The rows of a surface, and those that a step of the loop uses in one array, so that they are gathered at once.

    `describe` computes rows before they are used; None if all are.
    """

    surface: Surface
    columns: Packed[Surface]
    describe: Callable[[Int[np.ndarray, "*n"] | None], Any] | None = None

    @staticmethod
    def of(surface: Surface, describe: Callable[[Int[np.ndarray, "*n"] | None], Any] | None = None) -> _Rows:
        columns = Packed.of(surface._replace(noise=None, search=None))
        if describe is not None and not np.shares_memory(columns.table, surface.covariance):
            # Of a copy, rows that are computed later would not be seen.
            describe(None)
            return _Rows.of(surface)
        return _Rows(surface, columns, describe)

    def every(self, stride: int) -> _Rows:
        """Every `stride`-th row."""
        return self if stride == 1 else jax.tree.map(lambda array: np.ascontiguousarray(array[::stride]), self)


@dataclass(frozen=True)
class _Matches:
    """Target rows `indices` (m, N) of the m candidates of each source row, −1 where there is none.

    `found` says which of them are matches of points that are no padding; `max_distance` is applied when they are used.
    `apart` and `temperature` are those of `Matched`.
    """

    source: _Rows
    target: _Rows
    indices: Int[np.ndarray, "m N"]
    found: Bool[np.ndarray, "m N"]
    max_distance: Any
    apart: Float[np.ndarray, "m N"] | None = None
    temperature: Any = None

    @cached_property
    def rows(self) -> Int[np.ndarray, "m N"]:
        return np.maximum(self.indices, 0)

    def gathered(self, index: Any, with_noise: bool) -> _Gathered:
        """The matched rows of some source rows."""
        chosen = self.rows[:, index]
        columns = self.source.columns.rows(index), self.target.columns.rows(chosen)
        apart = None if self.apart is None else self.apart[:, index]
        gathered = _Gathered(*columns, self.found[:, index], self.max_distance, apart, self.temperature)
        if not with_noise:
            return gathered
        source, target = self.source.surface, self.target.surface
        source_noise, source_search = jax.tree.map(lambda array: array[index], (source.noise, source.search))
        target_noise, target_search = jax.tree.map(lambda array: array[chosen], (target.noise, target.search))
        return gathered._replace(
            source_noise=source_noise,
            source_search=source_search,
            target_noise=target_noise,
            target_search=target_search,
        )

    @staticmethod
    def of(source: _Rows, target: _Rows, indices: Int[np.ndarray, "m N"], max_distance: Any) -> _Matches:
        valid, among, rows = searched(source.surface).valid, searched(target.surface).valid, np.maximum(indices, 0)
        if target.describe is not None:
            target.describe(rows)
        return _Matches(source, target, indices, (indices >= 0) & valid & among[rows], max_distance)


class _Gathered(NamedTuple):
    """Matched rows as arguments of a compiled program: n of the source, (m, n) of the target."""

    source: Packed[Surface]
    target: Packed[Surface]
    found: Bool[Any, "m n"]
    max_distance: Any
    apart: Float[Any, "m n"] | None
    temperature: Any
    source_noise: SurfaceNoise | None = None
    target_noise: SurfaceNoise | None = None
    source_search: SearchPoints | None = None
    target_search: SearchPoints | None = None


class HostExecutor(AbstractExecutor):
    """Blocks of rows on the host for one pair of concrete clouds.

    Args:
        index_of: the index of the target; for a search in position alone if called with True.
        num_threads: largest number of threads; None for no limit.
    """

    def __init__(self, problem: Problem, index_of: Callable[[bool], AbstractIndex], num_threads: int | None):
        super().__init__(problem)
        self._index_of, self.num_threads = index_of, num_threads
        # Which source rows are followed from pose to pose, and the function that finds their matches.
        self._followed: tuple[int, bool] | None = None
        self._whole, self._target = _Rows.of(problem.source), _Rows.of(problem.target, problem.describe_target)
        self._source = self._whole
        self._nearest: Callable[[Any], Int[np.ndarray, "m N"]]
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
        if (stride, alone) != self._followed:
            self._followed, self._source = (stride, alone), self._whole.every(stride)
            rows, limit = searched(self._source.surface), float(settings.max_distance)
            rows = by_position(rows) if alone else rows
            self._nearest = self._index_of(alone).follow(rows, limit, problem.num_candidates)
        indices = self._nearest(state.pose.wxyz_xyz)
        return _Matches.of(self._source, self._target, indices, settings.distance(status))

    def adapt(self, state: State, matches: Any, before: tuple[AbstractTerm, ...]) -> tuple[AbstractTerm, ...]:
        return before if state.status in (COARSE, SETTLED) else super().adapt(state, matches, before)

    def source_of(self, matches: _Matches) -> Surface:
        return matches.source.surface

    def correspondences(self, loop: LoopResult) -> tuple[Int[np.ndarray, "m N"], Bool[np.ndarray, "m N"]]:
        """Target rows matched with all source points at the final pose, and whether the matches count."""
        matches, motion = loop.matches, self.motion(loop.state.pose)
        moved = matches.source.surface.points @ motion.rotation.T + motion.translation
        with np.errstate(invalid="ignore", over="ignore"):
            distances = np.linalg.norm(matches.target.surface.points[matches.rows] - moved, axis=-1)
        return matches.rows, matches.found & (distances <= matches.max_distance)

    def over_rematched(
        self,
        function: Callable[..., Any],
        motion: Motion,
        pose: jaxlie.SE3,
        rows: Int[np.ndarray, "n"],
        counts: Bool[np.ndarray, "n"],
        *arguments: Any,
    ) -> Any:
        source = jax.tree.map(lambda array: array[rows], self.problem.source)
        limit = self.problem.settings.fine_distance
        parameters = np.concatenate([np.asarray(pose.wxyz_xyz)[:4], motion.translation])
        indices = self._index_of(True).nearest(parameters, by_position(searched(source)), float(limit))
        matches = _Matches.of(_Rows.of(source), self._target, indices, limit)
        matches = replace(matches, found=matches.found & counts)
        return self.over_rows(function, motion, matches, np.arange(rows.size), *arguments)

    def nearest(self, motion: Motion, matches: _Matches) -> _Matches:
        """Followed candidates are in any order, so the nearest one is searched."""
        moved = matches.source.surface.points @ motion.rotation.T + motion.translation
        apart = matches.target.surface.points[matches.rows] - moved
        order = np.argmin(np.where(matches.found, np.einsum("mni,mni->mn", apart, apart), np.inf), axis=0)
        indices = np.take_along_axis(matches.indices, order[None], axis=0)
        return _Matches.of(matches.source, matches.target, indices, matches.max_distance)

    def over_rows(
        self,
        function: Callable[..., Any],
        motion: Motion,
        matches: _Matches,
        rows: Int[np.ndarray, "n"],
        *arguments: Any,
        with_noise: bool = False,
    ) -> Any:
        program = _program(function)

        def block(index: Any) -> Any:
            return program(motion, matches.gathered(rows[index], with_noise), *arguments)

        return map_rows(block, rows.size, self.num_threads if with_noise else 1)

    def sums(self, motion: Motion, matches: _Matches, terms: tuple[AbstractTerm, ...], last: Any) -> Packed[Sums]:
        # Packed until the loop ends: to pass and to return dozens of arrays takes longer than to use them. Not awaited:
        # `update` is dispatched while they are computed, which saves half of the hand-overs between threads.
        with_slopes = bool(last) and self.problem.source.channel_observability is not None
        parts: list[Packed[Sums]] = self._over_blocks(_packed_sums, motion, matches, terms, with_noise=with_slopes)
        return parts[0] if len(parts) == 1 else _combined(parts)

    def update(self, state: State, sums: Packed[Sums]) -> State:
        updated = _update(state.pose, state.status, state.num_iterations, sums, self._settings, self.problem.fusion)
        return Packed(np.asarray(updated.table), updated.layout).tree

    def scores(self, motion: Motion, matches: _Matches, *arguments: Any) -> Scores:
        parts: list[Scores] = self._over_blocks(scores_of, motion, matches, *arguments, with_noise=True)
        parts = [jax.tree.map(np.asarray, part) for part in parts]
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

    def _over_blocks(
        self,
        function: Callable[..., Any],
        motion: Motion,
        matches: _Matches,
        *arguments: Any,
        with_noise: bool = False,
    ) -> list[Any]:
        """Apply a function to blocks of correspondences; those repeated to fill the last block count as unmatched."""
        size, program = matches.indices.shape[1], _program(function)

        def block(index: Any) -> Any:
            chosen = matches.gathered(index, with_noise)
            if not isinstance(index, slice):
                chosen.found[:, size - index[0] :] = False
            return program(motion, chosen, *arguments)

        return [part for _, part in map_blocks(block, size, self.num_threads if with_noise else 1)]


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
        fixed = _Matches.of(self._whole, self._target, indices, np.asarray(np.inf, problem.source.points.dtype))
        if temperature is not None:
            source, target = searched(problem.source), searched(problem.target)
            apart = square_apart(source, jax.tree.map(lambda rows: rows[fixed.rows], target))
            fixed = replace(fixed, apart=apart, temperature=np.asarray(temperature))
        self._fixed = fixed

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
def _program(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of correspondences as a compiled program for gathered rows."""

    @quickly_compiled
    def program(motion: Motion, gathered: _Gathered, *arguments: Any) -> Any:
        matched = _matched(gathered)
        return function(motion, matched.within(motion.move(matched.source.points), gathered.max_distance), *arguments)

    return program


def _matched(gathered: _Gathered) -> Matched:
    """One row per correspondence, m N; the first candidates of all source rows come first."""
    count = len(gathered.found)

    def tiled(tree: Any) -> Any:
        return jax.tree.map(lambda rows: jnp.tile(rows, (count, *[1] * (rows.ndim - 1))), tree)

    def flat(tree: Any) -> Any:
        return jax.tree.map(lambda rows: rows.reshape(len(rows) * rows.shape[1], *rows.shape[2:]), tree)

    source, target = tiled(gathered.source).tree, flat(gathered.target).tree
    source = source._replace(noise=tiled(gathered.source_noise), search=tiled(gathered.source_search))
    target = target._replace(noise=flat(gathered.target_noise), search=flat(gathered.target_search))
    apart = None if gathered.apart is None else gathered.apart.reshape(-1)
    return Matched(source, target, gathered.found.reshape(-1), apart, gathered.temperature, num_candidates=count)


def _packed_sums(motion: Motion, matched: Matched, terms: tuple[AbstractTerm, ...]) -> Packed[Sums]:
    return Packed.of(sums_of(motion, matched, terms), num_axes=0)


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
