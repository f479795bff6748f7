"""The registration loop on the host: compiled programs over blocks of rows, with searches for matches in between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.blocks import map_blocks, map_rows
from mcgicp_jax._compute.packing import Layout, layout_of, packed, packed_numbers, unpacked
from mcgicp_jax._local_geometry.surface import Surface, SurfaceNoise, searched
from mcgicp_jax._math.poses import rotation_from_quaternion
from mcgicp_jax._pose_solver.covariance import Scores, scores_of
from mcgicp_jax._pose_solver.matched import Matched, Motion
from mcgicp_jax._pose_solver.sums import Sums, combine, sums_of
from mcgicp_jax._registration.loop import AbstractExecutor, LoopResult
from mcgicp_jax._registration.step import COARSE, SETTLED, Problem, Record, State, update
from mcgicp_jax._search.base import AbstractIndex, SearchPoints, by_position
from mcgicp_jax._terms.base import AbstractTerm


class _Packed(NamedTuple):
    """A surface whose rows lie side by side in one array, so that they are gathered at once, see `packing`."""

    surface: Surface
    table: Float[np.ndarray, "N L"]
    layout: Layout

    @staticmethod
    def of(surface: Surface) -> _Packed:
        columns = surface._replace(noise=None, search=None)
        return _Packed(surface, packed(columns), layout_of(columns))

    def every(self, stride: int) -> _Packed:
        """Every `stride`-th row."""
        if stride == 1:
            return self
        some = jax.tree.map(lambda array: np.ascontiguousarray(array[::stride]), self.surface)
        return _Packed(some, np.ascontiguousarray(self.table[::stride]), self.layout)


@dataclass(frozen=True)
class _Matches:
    """Target rows `indices` (m, N) of the m candidates of each source row, −1 where there is none.

    `found` says which of them are matches of points that are no padding; `max_distance` is applied when they are used.
    """

    source: _Packed
    target: _Packed
    indices: Int[np.ndarray, "m N"]
    found: Bool[np.ndarray, "m N"]
    max_distance: Any

    @property
    def layouts(self) -> tuple[Layout, Layout]:
        return self.source.layout, self.target.layout

    @cached_property
    def rows(self) -> Int[np.ndarray, "m N"]:
        return np.maximum(self.indices, 0)

    def gathered(self, index: Any, with_noise: bool) -> _Gathered:
        """The matched rows of some source rows."""
        chosen = self.rows[:, index]
        tables = self.source.table[index], self.target.table[chosen]
        gathered = _Gathered(*tables, self.found[:, index], self.max_distance)
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
    def of(source: _Packed, target: _Packed, indices: Int[np.ndarray, "m N"], max_distance: Any) -> _Matches:
        valid, among = searched(source.surface).valid, searched(target.surface).valid
        found = (indices >= 0) & valid & among[np.maximum(indices, 0)]
        return _Matches(source, target, indices, found, max_distance)


class _Gathered(NamedTuple):
    """Matched rows as arguments of a compiled program: surfaces packed, see `packing`."""

    source: Float[Any, "n L"]
    target: Float[Any, "m n L"]
    found: Bool[Any, "m n"]
    max_distance: Any
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
        self._index_of, self._num_threads = index_of, num_threads
        # Which source rows are followed from pose to pose, and the function that finds their matches.
        self._followed: tuple[int, bool] | None = None
        self._whole, self._target = _Packed.of(problem.source), _Packed.of(problem.target)
        self._source = self._whole
        self._nearest: Callable[[Any], Int[np.ndarray, "m N"]]
        # The last sums, packed.
        self._sums: tuple[Layout, Float[np.ndarray, "L"]]

    def begin(self) -> LoopResult:
        state = State(self.problem.start, np.asarray(self.first_status), np.int32(0))
        return LoopResult(state, None, self.problem.terms, [])

    def repeat(self, step: Callable[[LoopResult], LoopResult], loop: LoopResult) -> LoopResult:
        while loop.state.status < 0:
            loop = step(loop)
            state = loop.state
            # As NumPy arrays, comparing them compiles nothing.
            state = state._replace(status=np.asarray(state.status), num_iterations=np.asarray(state.num_iterations))
            loop = loop._replace(state=state)
        records = [jax.tree.map(np.asarray, record) for record in loop.history]
        return loop._replace(history=jax.tree.map(lambda *entries: np.stack(entries), *records))

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
        matches = _Matches.of(_Packed.of(source), self._target, indices, limit)
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
        program = _program(function, matches.layouts)

        def block(index: Any) -> Any:
            return program(motion, matches.gathered(rows[index], with_noise), *arguments)

        return map_rows(block, rows.size, self._num_threads if with_noise else 1)

    def sums(self, motion: Motion, matches: _Matches, terms: tuple[AbstractTerm, ...]) -> Sums:
        source, parts = matches.source.surface, self._over_blocks(_packed_sums, motion, matches, terms)
        layout = _layout_of_sums(source.observability is not None, source.channel_observability is not None)
        (total,) = parts if len(parts) == 1 else (self._combined(np.stack(parts), layout),)
        self._sums = layout, total
        return unpacked(total, layout)

    def _combined(self, parts: Float[np.ndarray, "b L"], layout: Layout) -> Float[np.ndarray, "L"]:
        with np.errstate(over="ignore"):
            sums = combine(unpacked(parts.astype(np.float64), layout))
            return np.concatenate([each.ravel() for each in jax.tree.leaves(sums)]).astype(parts.dtype)

    def update(self, state: State, sums: Sums) -> State:
        # In one array: to pass a dozen to a program takes longer than to use them.
        layout, total = self._sums
        problem = self.problem
        return _update(layout, state.pose, state.status, state.num_iterations, total, problem.settings, problem.fusion)

    def scores(self, motion: Motion, matches: _Matches, *arguments: Any) -> Scores:
        parts: list[Scores] = self._over_blocks(scores_of, motion, matches, *arguments, with_noise=True)
        jacobian, bias = (
            np.sum([np.asarray(getattr(part, name), np.float64) for part in parts], axis=0)
            for name in ("jacobian", "bias")
        )
        # Rows that pad the last block have no matches; their scores are 0.
        wrenches, valid, cells = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("wrenches", "valid", "cells")
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
        size, program = matches.indices.shape[1], _program(function, matches.layouts)

        def block(index: Any) -> Any:
            chosen = matches.gathered(index, with_noise)
            if not isinstance(index, slice):
                chosen.found[:, size - index[0] :] = False
            return program(motion, chosen, *arguments)

        return [part for _, part in map_blocks(block, size, self._num_threads if with_noise else 1)]


@cache
def _program(function: Callable[..., Any], layouts: tuple[Layout, Layout]) -> Callable[..., Any]:
    """A function of correspondences as a compiled program for gathered rows."""

    @jax.jit
    def program(motion: Motion, gathered: _Gathered, *arguments: Any) -> Any:
        matched = _matched(gathered, layouts)
        return function(motion, matched.within(motion.move(matched.source.points), gathered.max_distance), *arguments)

    return program


def _matched(gathered: _Gathered, layouts: tuple[Layout, Layout]) -> Matched:
    """One row per correspondence, m N; the first candidates of all source rows come first."""
    count = len(gathered.found)

    def tiled(tree: Any) -> Any:
        return jax.tree.map(lambda rows: jnp.tile(rows, (count, *[1] * (rows.ndim - 1))), tree)

    def flat(tree: Any) -> Any:
        return jax.tree.map(lambda rows: rows.reshape(len(rows) * rows.shape[1], *rows.shape[2:]), tree)

    source = unpacked(tiled(gathered.source), layouts[0])
    target = unpacked(flat(gathered.target), layouts[1])
    source = source._replace(noise=tiled(gathered.source_noise), search=tiled(gathered.source_search))
    target = target._replace(noise=flat(gathered.target_noise), search=flat(gathered.target_search))
    return Matched(source, target, gathered.found.reshape(-1), num_candidates=count)


def _packed_sums(motion: Motion, matched: Matched, terms: tuple[AbstractTerm, ...]) -> Array:
    return packed_numbers(sums_of(motion, matched, terms))


@partial(jax.jit, static_argnums=0)
def _update(layout: Layout, pose: jaxlie.SE3, status: Any, num_iterations: Any, sums: Array, *others: Any) -> State:
    """`update` with packed sums."""
    return update(pose, status, num_iterations, unpacked(sums, layout), *others)


@cache
def _layout_of_sums(observed: bool, by_channels: bool) -> Layout:
    number, matrix = np.zeros(()), np.zeros((6, 10))
    sums = Sums(np.zeros(3), number, number, number, number, number, number, np.zeros((3, 4)), matrix)
    if observed:
        sums = sums._replace(mass=np.zeros(10), observability=matrix)
    if by_channels:
        sums = sums._replace(channel_observability=matrix)
    return layout_of(sums, num_axes=0)
