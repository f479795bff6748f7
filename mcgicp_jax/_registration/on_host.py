"""The registration loop on the host: compiled programs over blocks of rows, with searches for matches in between.

The way of a source point from `PointCloud` to `Registration`, in ten sentences. `preprocess` finds the k nearest
neighbours of the point. `describe` computes local statistics from the neighbourhood: covariance, normal, channel fits.
`method.covariance` and `channel_observability` turn these into the point's row of a `Surface`: position, covariance,
observability. The search finds the target point nearest to the moved point in position and α · channel. NumPy gathers
the surface row of this target point. `method.forces` computes from the two rows the cost of the correspondence, its
force (−gradient/2) and stiffness (Hessian/2). `sums_of` adds them over a block of correspondences, and `combine` adds
the blocks. `update` computes the next pose from the sums, and search, sums and update repeat until the pose converges.
At the final pose, `scores_of` computes the contribution of each correspondence to the covariance. `Registration` holds
the pose, its status and its covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._compute.blocks import map_blocks, map_rows
from mcgicp_jax._compute.concrete import AnyArray, AnyScalar
from mcgicp_jax._compute.lazy import Lazy
from mcgicp_jax._local_geometry.records import Extended, Surface, Table, gathered
from mcgicp_jax._math.poses import rotation_from_quaternion
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._math.statistics import sampled_rows
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pose_solver.covariance import Details, Moments, Scores, discount_rows, discounts, scatter_of, scores_of
from mcgicp_jax._pose_solver.sums import Matched, Sums, combine, move_rows, sums_of, within
from mcgicp_jax._registration.step import (
    COARSE,
    RUNNING,
    SETTLED,
    Assessment,
    Problem,
    State,
    constraints_of,
    covariance_of_pose,
    history_of,
    update,
)
from mcgicp_jax._search.base import AbstractIndex, Correspondences, SearchPoints, by_position
from mcgicp_jax._terms.photometric import Term

if TYPE_CHECKING:
    Candidates: TypeAlias = Any
else:
    # Table rows of the m candidates of each of N points.
    Candidates = Float[AnyArray, "m N L"] | Extended

# Rotation matrix and translation (metres) of a pose.
Moving: TypeAlias = tuple[Float[AnyArray, "3 3"], Float[AnyArray, "3"]]


def register_on_host(
    problem: Problem, index_of: Callable[[bool], AbstractIndex], num_threads: int | None
) -> tuple[State, Assessment, dict[str, np.ndarray], Lazy[Moments]]:
    """Find matches at this pose; sum their forces; update the pose; stop when it no longer moves.

    Args:
        index_of: the index of the target, for a search in position alone if called with True.

    Returns:
        Final state, information matrix and covariance, history, and sums over the scores.
    """
    pose, settings, records = problem.start, problem.settings, []
    term = problem.method.estimates
    coarse = settings.fine_distance < settings.max_distance or settings.coarse_stride > 1 or term is not None
    status: Any = np.int32(COARSE if coarse else RUNNING)
    num_iterations: Any = np.int32(0)
    followed: tuple[int, bool] | None = None
    while status < 0:
        last = num_iterations >= settings.max_iterations
        stride = int(settings.coarse_stride) if status == COARSE and not last else 1
        alone = term is not None and status != COARSE
        if status != SETTLED and (stride, alone) != followed:
            followed, source = (stride, alone), _every(stride, problem.source)
            rows = by_position(source.rows) if alone else source.rows
            nearest = index_of(alone).follow(rows, float(settings.max_distance), problem.method.num_candidates)
        if status != SETTLED:
            matches = _Matches(source, problem.target, nearest(pose.wxyz_xyz))
        gate = settings.max_distance if status == COARSE else settings.fine_distance
        if term is not None and status == RUNNING:
            problem = replace(problem, method=problem.method.with_estimates(_estimated(pose, matches, gate, term)))
        sums = _measure(pose, matches, gate, problem)
        state = update(pose, status, num_iterations, sums, settings, problem.fusion)
        pose, num_iterations, status = state.pose, np.asarray(state.num_iterations), np.asarray(state.status)
        records.append(state.record)
    moments = Lazy(partial(_moments, state, matches, gate, problem, index_of, num_threads))
    assessment = Assessment(Lazy(partial(constraints_of, state)), Lazy(partial(_covariance, state, moments, problem)))
    return state, assessment, history_of(np.stack([np.asarray(record) for record in records])), moments


def _every(stride: int, source: Surface) -> Surface:
    """Every `stride`-th row of a surface."""
    return source if stride == 1 else jax.tree.map(lambda array: np.ascontiguousarray(array[::stride]), source)


class _Matches:
    """Source rows, the m target rows matched with each, and whether there are any."""

    def __init__(self, source: Surface, target: Surface, indices: Int[np.ndarray, "m N"]):
        self.source, self.target, self.indices = source, target, indices
        self.rows = np.maximum(indices, 0)
        self.found = (indices >= 0) & source.rows.valid & target.rows.valid[self.rows]
        self.size = indices.shape[1]

    def nearest(self, moving: Moving) -> _Matches:
        """Of each source row the nearest candidate alone; they are followed from pose to pose in any order."""
        rotation, translation = moving
        apart = self.target.rows.points[self.rows] - (self.source.rows.points @ rotation.T + translation)
        order = np.argmin(np.where(self.found, np.einsum("mni,mni->mn", apart, apart), np.inf), axis=0)
        return _Matches(self.source, self.target, np.take_along_axis(self.indices, order[None], axis=0))

    def rows_at(self, index: Any) -> tuple[Table, Candidates, np.ndarray]:
        """Table rows of source and target, and which of the latter are matches."""
        return (
            gathered(self.source.table, index),
            gathered(self.target.table, self.rows[:, index]),
            self.found[:, index],
        )

    def block(self, index: Any) -> tuple[Table, Candidates, np.ndarray]:
        """`rows_at` for a block; rows repeated to fill the last block count as unmatched."""
        source, target, found = self.rows_at(index)
        if not isinstance(index, slice):
            found[:, self.size - index[0] :] = False
        return source, target, found

    def details(self, index: Any) -> tuple[np.ndarray, np.ndarray]:
        """Rows of `Surface.details` of source and target."""
        source: Any = self.source.details
        target: Any = self.target.details
        return source[index], target[self.rows[:, index]]


def _moving(pose: jaxlie.SE3, dtype: Any) -> Moving:
    """Rotation matrix and translation of a pose, computed with NumPy."""
    parameters = np.asarray(pose.wxyz_xyz)
    return rotation_from_quaternion(parameters[:4].astype(np.float64)).astype(dtype), parameters[4:]


def _measure(pose: jaxlie.SE3, matches: _Matches, gate: Float[AnyScalar, ""], problem: Problem) -> Sums:
    """The sums at a pose over the matches within the maximum correspondence distance `gate`, metres."""
    dtype = matches.source.rows.points.dtype
    moving = _moving(pose, dtype)

    def sums(index: Any) -> Sums:
        return _sums(moving, *matches.block(index), gate, problem.method, problem.robust)

    parts = map_blocks(sums, matches.size)
    return combine([part for _, part in parts], dtype)


def _estimated(pose: jaxlie.SE3, matches: _Matches, gate: Float[AnyScalar, ""], term: Term) -> Term:
    """The term with its numbers from a sample of the matches at a pose."""
    moving = _moving(pose, matches.source.rows.points.dtype)
    some, counts = sampled_rows(matches.source.rows.valid)
    evidence = _evidence_at(moving, matches, some, gate, term)
    # Huge coordinates or channels lead to the status NON_FINITE; NumPy need not warn of them.
    with np.errstate(over="ignore", invalid="ignore"):
        return term.estimated(evidence, counts, matches.source.rows.valid)


def _evidence_at(
    moving: Moving, matches: _Matches, rows: Int[np.ndarray, "n"], gate: Float[AnyScalar, ""], term: Term
) -> Float[np.ndarray, "n L"]:
    """`Term.evidence` for some source points."""

    def evidence(index: Any) -> Any:
        return _evidence(moving, *matches.rows_at(rows[index]), gate, term)

    return map_rows(evidence, rows.size)


@jax.jit
def _evidence(
    moving: Moving,
    source: Table,
    target: Candidates,
    found: Bool[AnyArray, "m N"],
    gate: Float[AnyScalar, ""],
    term: Term,
) -> Float[AnyArray, "n L"]:
    matched = _matched(moving, source, target, found, gate)
    moved = move_rows(*moving, matched.source)
    return term.evidence(matched.source, matched.target, moved, moving[0], matched.valid)


@jax.jit
def _sums(
    moving: Moving,
    source: Table,
    target: Candidates,
    found: Bool[AnyArray, "m N"],
    gate: Float[AnyScalar, ""],
    method: AbstractMethod,
    robust: AbstractKernel | None,
) -> Sums:
    return sums_of(*moving, _matched(moving, source, target, found, gate), method, robust)


def _matched(
    moving: Moving,
    source: Table,
    target: Candidates,
    found: Bool[AnyArray, "m N"],
    gate: Float[AnyScalar, ""],
) -> Matched:
    sides = _flat(source, target)
    valid, _ = within(move_rows(*moving, sides[0]), sides[1], found.reshape(-1), gate)
    return Matched(*sides, valid, num_candidates=len(found))


def _flat(source: Any, target: Any) -> tuple[Any, Any]:
    """Rows (N, L) and (m, N, L) as one row per correspondence, m N; first candidates of all source rows come first."""
    num_candidates = len(jax.tree.leaves(target)[0])
    tiled = jax.tree.map(lambda rows: jnp.tile(rows, (num_candidates, 1)), source)
    return tiled, jax.tree.map(lambda rows: jnp.reshape(rows, (-1, rows.shape[-1])), target)


def _covariance(state: State, moments: Lazy[Moments], problem: Problem) -> Float[np.ndarray, "6 6"]:
    """Covariance of the final pose, float64."""
    known = moments.value if problem.fusion is None else problem.fusion
    # In float64: beside the variances of unconstrained directions, those of the others would be lost to rounding.
    with jax.enable_x64(True):
        return np.asarray(covariance_of_pose(*as_float64((state, known))))


def _moments(
    state: State,
    matches: _Matches,
    gate: Float[AnyScalar, ""],
    problem: Problem,
    index_of: Callable[[bool], AbstractIndex],
    num_threads: int | None,
) -> Moments:
    """Sums over the scores of all correspondences at the final pose, float64."""
    source, target = matches.source, matches.target
    moving = _moving(state.pose, source.rows.points.dtype)
    nearest = matches.nearest(moving)
    some, counts = sampled_rows(source.rows.valid)

    def discount(index: Any) -> Any:
        rows = some[index]
        sides = (
            jax.tree.map(lambda array: array[rows], source.rows),
            jax.tree.map(lambda array: array[nearest.rows[0, rows]], target.rows),
        )
        return _discount_rows(moving, *nearest.rows_at(rows), gate, nearest.details(rows), *sides)

    rows = map_rows(discount, some.size, num_threads)
    num_channels = np.sum(np.any(source.rows.descriptors != 0, axis=0))
    discount_of_all = discounts(np.where(counts[:, None], rows, np.nan), num_channels)

    term = problem.method.estimates
    responding = None if term is None else _responding(state.pose, matches, gate, term, index_of)

    def scores(index: Any) -> Scores:
        weighing = (problem.method, problem.robust, discount_of_all, np.int32(matches.size), responding)
        return _scores(moving, state.sums, *matches.block(index), gate, matches.details(index), *weighing)

    parts = map_blocks(scores, matches.size, num_threads)
    jacobian, bias = (
        np.sum([np.asarray(getattr(part, name), np.float64) for _, part in parts], axis=0)
        for name in ("jacobian", "bias")
    )
    # Rows that pad the last block have no matches; their scores are 0.
    rows, cells = (np.concatenate([getattr(part, name) for _, part in parts]) for name in ("rows", "cells"))
    scatter, num_cells = scatter_of(Scores(rows, cells, jacobian, bias), matches.size)
    return Moments(jacobian, bias, scatter, np.int32(num_cells))


def as_float64(tree: Any) -> Any:
    def convert(leaf: Any) -> np.ndarray:
        array = np.asarray(leaf)
        return array.astype(np.float64) if array.dtype == np.float32 else array

    return jax.tree.map(convert, tree)


@jax.jit
def _discount_rows(
    moving: Moving,
    source: Table,
    target: Candidates,
    found: Bool[AnyArray, "m N"],
    gate: Float[AnyScalar, ""],
    details: tuple[Float[AnyArray, "n 6"], Float[AnyArray, "m n 6"]],
    source_rows: SearchPoints,
    target_rows: SearchPoints,
) -> Float[AnyArray, "n 3"]:
    matched = _matched(moving, source, target, found, gate)
    return discount_rows(*moving, matched, Details(*_flat(*details)), source_rows, target_rows)


@jax.jit
def _scores(
    moving: Moving,
    sums: Sums,
    source: Table,
    target: Candidates,
    found: Bool[AnyArray, "m N"],
    gate: Float[AnyScalar, ""],
    details: tuple[Float[AnyArray, "n 6"], Float[AnyArray, "m n 6"]],
    method: AbstractMethod,
    robust: AbstractKernel | None,
    discount: Float[AnyArray, "2"],
    num_cells: Int[AnyScalar, ""],
    responding: Term | None,
) -> Scores:
    matched = _matched(moving, source, target, found, gate)
    flat = Details(*_flat(*details))
    return scores_of(moving, sums.center, sums.radius, matched, flat, discount, num_cells, method, robust, responding)


def _responding(
    pose: jaxlie.SE3,
    matches: _Matches,
    gate: Float[AnyScalar, ""],
    term: Term,
    index_of: Callable[[bool], AbstractIndex],
) -> Term:
    """`Term.responding` for a sample of the source points."""
    some, counts = sampled_rows(matches.source.rows.valid)
    source = jax.tree.map(lambda array: array[some], matches.source)
    rotation, translation = _moving(pose, source.rows.points.dtype)
    found = []
    for shift in np.asarray(term.shifts):
        moved = np.concatenate([np.asarray(pose.wxyz_xyz)[:4], translation + shift])
        indices = index_of(True).nearest(moved, by_position(source.rows), float(gate))
        again = _Matches(source, matches.target, indices)
        again.found &= counts
        everything = np.arange(some.size)
        found.append(_evidence_at((rotation, translation + shift), again, everything, gate, term))
    with np.errstate(over="ignore", invalid="ignore"):
        return term.responding(np.stack(found))


def correspondences_at(
    matrix: Float[np.ndarray, "4 4"],
    source: SearchPoints,
    target: SearchPoints,
    indices: Int[np.ndarray, "m N"],
    gate: float,
) -> Correspondences:
    """Matches at a pose, valid within `gate` metres of position; NumPy, so that nothing is compiled."""
    rows, dtype = np.maximum(indices, 0), source.points.dtype
    with np.errstate(invalid="ignore"):
        moved = source.points.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        distances = np.linalg.norm(target.points[rows] - moved, axis=-1).astype(dtype)
        valid = (indices >= 0) & source.valid & target.valid[rows] & (distances <= gate)
    return Correspondences(rows.astype(np.int32), distances, valid)
