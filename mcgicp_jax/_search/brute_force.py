"""Brute-force nearest-neighbour search in XLA, for accelerators; and the default search of each platform."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.devices import on_accelerator
from mcgicp_jax._compute.programs import size_class
from mcgicp_jax._search.base import IDENTITY, AbstractIndex, AbstractSearch, SearchPoints, on_host, search_points
from mcgicp_jax._search.kd_tree import KDTreeSearch

# Rows of a run and of a part of it: on an H200, 20 neighbours of 6,144 points took 0.2 ms by these, and 1.45 ms by
# passes over all distances. Fewer than eight runs exclude nothing.
_RUN, _PART, _LEAST_FOR_RUNS = 64, 8, 512
# Queries whose distances to the rows of parts are stored at a time: 14 MB for 20 neighbours and five dimensions.
_QUERIES = 512


def default_search(traced: bool = False, workers: int = -1) -> AbstractSearch:
    """`DenseSearch` for traced arrays on an accelerator, else `KDTreeSearch(workers)`."""
    return DenseSearch() if traced and on_accelerator() else KDTreeSearch(workers)


class DenseSearch(AbstractSearch):
    """Brute-force search for GPUs and TPUs, exact up to rounding; ties are broken by row.

    Squared differences are summed and reduced at once, so that the N × M table of distances is never stored. (A matrix
    product for |a|² − 2ab + |b|² would have to store it, and in float32 would lose the distances of near neighbours to
    cancellation.) Distances are computed in the clouds' precision, in `KDTreeSearch` in float64: the two may choose
    different points where two distances agree to rounding. `register` searches concrete clouds on the CPU, where
    `KDTreeSearch` is faster.
    """

    def index(self, target: SearchPoints) -> DenseIndex:
        return DenseIndex(target)

    def nearest_traced(
        self,
        pose: Float[Array, "7"],
        source: SearchPoints,
        target: SearchPoints,
        max_distance: Float[Array, ""],
        running: Bool[Array, ""],
        num_candidates: int = 1,
    ) -> Int[Array, "m N"]:
        return _nearest(pose, source, target, num_candidates)

    def neighbors(self, points: Float[np.ndarray, "N 3"], num_neighbors: int) -> Int[np.ndarray, "N k"]:
        rows = search_points(points)
        return self.index(rows).nearest(IDENTITY, rows, np.inf, num_neighbors).T


class DenseIndex(AbstractIndex):
    """The target's rows, padded to a size class; brute force needs no data structure."""

    def __init__(self, target: SearchPoints):
        self._target = _padded(target)

    def nearest(
        self, pose: Float[ArrayLike, "7"], source: SearchPoints, max_distance: float, num_candidates: int = 1
    ) -> Int[np.ndarray, "m N"]:
        pose = jnp.asarray(pose, source.points.dtype)
        return np.asarray(_nearest(pose, _padded(source), self._target, num_candidates))[:, : source.valid.size]

    def follow(
        self, source: SearchPoints, max_distance: float, num_candidates: int = 1
    ) -> Callable[[Float[ArrayLike, "7"]], Int[np.ndarray, "m N"]]:
        return lambda pose: self.nearest(pose, source, max_distance, num_candidates)


def _padded(rows: SearchPoints) -> SearchPoints:
    """The rows padded to their size class: clouds of all sizes run few programs."""
    rows = on_host(rows)
    missing = size_class(rows.valid.size) - rows.valid.size
    return jax.tree.map(lambda array: np.pad(array, [(0, missing)] + [(0, 0)] * (array.ndim - 1)), rows)


@partial(jax.jit, static_argnames="num_candidates")
def _nearest(
    pose: Float[Array, "7"], source: SearchPoints, target: SearchPoints, num_candidates: int
) -> Int[Array, "m N"]:
    rotation = jaxlie.SO3(pose[:4]).as_matrix().astype(pose.dtype)
    moved = jnp.dot(source.points, rotation.T, precision="highest") + pose[4:]
    queries = eqx.tree_at(lambda rows: rows.points, source, moved)
    complete = source.penalty is None and target.penalty is None
    if num_candidates > 1 and complete and target.valid.size >= _LEAST_FOR_RUNS:
        return _nearest_by_runs(queries, target, num_candidates)
    rows = jnp.arange(target.valid.size, dtype=jnp.int32)
    square, nearest = _first(_squares, (queries, target, rows), source.valid.size, num_candidates)
    return jnp.where(jnp.isfinite(square) & source.valid, nearest, -1)


def _squares(
    source: SearchPoints, target: SearchPoints, rows: Int[Array, "M"]
) -> tuple[Float[Array, "N M"], Int[Array, "N M"]]:
    """Squared search distance of every source row to every target row, metres²; and the target rows."""
    square = jnp.zeros((source.valid.size, target.valid.size), jnp.asarray(source.points).dtype)
    for query, point in zip(source.points.T, target.points.T, strict=True):
        square = square + (query[:, None] - point) ** 2
    for column in range(source.descriptors.shape[1]):
        added = (source.descriptors[:, column, None] - target.descriptors[:, column]) ** 2
        for side, axis in ((source, 1), (target, 0)):
            if side.penalty is not None:
                penalty = jnp.expand_dims(side.penalty[:, column], axis)
                added = jnp.where(penalty > 0, penalty, added)
        square = square + added
    square = jnp.where(target.valid, square, jnp.inf)
    return square, jnp.broadcast_to(rows, square.shape)


def _first(
    numbered: Callable[..., tuple[Float[Array, "N M"], Int[Array, "N M"]]], arguments: Any, size: int, count: int
) -> tuple[Float[Array, "m N"], Int[Array, "m N"]]:
    """The `count` smallest squares of each of N rows, and their numbers, by which ties are broken.

    `numbered(*arguments)` computes the table of squares and numbers, which is not stored.
    """

    def following(before: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """The next after `before` in the order of (square, number)."""
        # Without the barrier the compiler would hoist the loop-invariant squares out of the loop and store them.
        before, table = jax.lax.optimization_barrier((before, arguments))
        square, numbers = numbered(*table)
        least, number = (values[:, None] for values in before)
        # False where the square is NaN.
        after = (square > least) | ((square == least) & (numbers > number))
        smallest = jax.lax.reduce(
            (jnp.where(after, square, jnp.inf), numbers),
            (jnp.asarray(jnp.inf, square.dtype), jnp.int32(np.iinfo(np.int32).max)),
            _nearer,
            dimensions=(1,),
        )
        return smallest, smallest

    dtype = jax.eval_shape(numbered, *arguments)[0].dtype
    start = (jnp.full(size, -1, dtype), jnp.full(size, -1, jnp.int32))
    return jax.lax.scan(following, start, length=count)[1]


def _nearer(one: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
    first = (one[0] < other[0]) | ((one[0] == other[0]) & (one[1] < other[1]))
    return jnp.where(first, one[0], other[0]), jnp.where(first, one[1], other[1])


def _given(square: Float[Array, "N M"], numbers: Int[Array, "N M"]) -> tuple[Array, Array]:
    return square, numbers


def _nearest_by_runs(queries: SearchPoints, target: SearchPoints, num_candidates: int) -> Int[Array, "m N"]:
    """The m nearest target rows: first the m nearest runs of rows, then of these the m nearest parts, then the rows.

    Exact: m rows, the nearest of each of the m nearest runs, come before any row of another run; likewise for parts.
    """

    def column_of(array: Float[Array, "n"], multiple: int) -> Float[Array, "m"]:
        return jnp.pad(array, (0, -array.size % multiple), constant_values=jnp.nan)

    pairs = zip((queries, target), (_QUERIES, _RUN), strict=True)
    blocks, columns = (
        [column_of(column, multiple) for column in (*rows.points.T, *rows.descriptors.T)] for rows, multiple in pairs
    )
    # A run with NaN would be no nearest one.
    valid = jnp.pad(target.valid, (0, -target.valid.size % _RUN)) & ~jnp.isnan(sum(columns[1:], columns[0]))
    columns = [jnp.where(valid, column, jnp.inf) for column in columns]

    def of_block(block: list[Float[Array, "n"]]) -> Int[Array, "m n"]:
        numbers = jnp.broadcast_to(jnp.arange(valid.size // _RUN, dtype=jnp.int32), (_QUERIES, valid.size // _RUN))
        for width, finer in ((_RUN, _PART), (_PART, 1)):
            # Distances of all rows of these runs, or parts, reduced at once.
            groups = slice(None) if width == _RUN else numbers
            squares = [
                (query[:, None, None] - column.reshape(-1, width)[groups]) ** 2
                for query, column in zip(block, columns, strict=True)
            ]
            least = jnp.min(sum(squares[1:], squares[0]), axis=2)
            _, nearest = _first(_given, (least, numbers), _QUERIES, num_candidates)
            # Where no further run is left, the number is the largest int32.
            nearest = jnp.minimum(nearest.T, valid.size // width - 1)
            within = jnp.arange(width // finer, dtype=jnp.int32)
            numbers = (nearest[:, :, None] * (width // finer) + within).reshape(_QUERIES, -1)
        squares = [(query[:, None] - column[numbers]) ** 2 for query, column in zip(block, columns, strict=True)]
        square, rows = _first(_given, (sum(squares[1:], squares[0]), numbers), _QUERIES, num_candidates)
        return jnp.where(jnp.isfinite(square), rows, -1)

    rows = jax.lax.map(of_block, [block.reshape(-1, _QUERIES) for block in blocks])
    rows = rows.transpose(1, 0, 2).reshape(num_candidates, -1)[:, : queries.valid.size]
    return jnp.where(queries.valid, rows, -1)
