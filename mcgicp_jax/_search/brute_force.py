"""Brute-force nearest-neighbour search in XLA, for accelerators."""

from __future__ import annotations

import functools
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.size_classes import size_class
from mcgicp_jax._search.base import IDENTITY, AbstractIndex, AbstractSearch, Matcher, SearchPoints, search_points

# Coordinates and descriptors of rows, each with its penalties.
Coordinates: TypeAlias = list[tuple[Array, Array | None]]
# Rows of a run. Of a run the nearest row alone is stored: a sixteenth of the table of distances.
_RUN = 16
# Numbers of a group, among which the smallest are found by groups. To sort the 384 runs of a cloud of 6,144 rows, and
# then the 320 rows of 20 runs, for each row, took a third of the time in which an H200 registered a pair.
_GROUP = 4
# Distances to runs that are stored at a time: 64 MB in float32, those of all queries of clouds of 16,384 rows.
_STORED = 2**24


class DenseSearch(AbstractSearch):
    """Brute-force search for GPUs and TPUs, exact up to rounding; ties are broken by row.

    The nearest row of each run of rows is found first, so that the N × M table of distances is never stored. (A matrix
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

    def follow(self, source: SearchPoints, max_distance: float, num_candidates: int = 1) -> Matcher:
        return lambda pose: self.nearest(pose, source, max_distance, num_candidates)


def _padded(rows: SearchPoints) -> SearchPoints:
    """The rows padded to their size class: clouds of all sizes run few programs."""
    missing = size_class(rows.valid.size) - rows.valid.size
    return jax.tree.map(lambda array: np.pad(array, [(0, missing)] + [(0, 0)] * (array.ndim - 1)), rows)


@partial(jax.jit, static_argnames="num_candidates")
def _nearest(
    pose: Float[Array, "7"], source: SearchPoints, target: SearchPoints, num_candidates: int
) -> Int[Array, "m N"]:
    """Search the m runs whose nearest rows are nearest. Exact: these m rows come before any row of another run."""
    rotation = jaxlie.SO3(pose[:4]).as_matrix().astype(pose.dtype)
    moved = jnp.dot(source.points, rotation.T, precision="highest") + pose[4:]
    queries, targets = _coordinates(source._replace(points=moved)), _coordinates(target)
    # Rows to ignore are infinitely far. One with NaN would be nearest.
    valid = target.valid & ~jnp.isnan(sum(value for value, _ in targets))
    targets = [(jnp.where(valid, value, jnp.inf), penalty) for value, penalty in targets]
    targets = _in_blocks(targets, _RUN, jnp.inf)
    num_runs = len(targets[0][0])
    # With the compiler's own choice of layout, GPUs would read the rows of a run far apart.
    by_row = jax.lax.optimization_barrier(jax.tree.map(jnp.transpose, targets))

    def nearest(queries: Coordinates) -> Int[Array, "m n"]:
        # Written out: on GPUs a reduction over so few rows takes several times as long.
        of_rows = (_squares(_at(queries, np.s_[:, None]), _at(by_row, row)) for row in range(_RUN))
        # In the order of rows, by which ties are broken.
        runs = jnp.sort(_smallest(functools.reduce(jnp.minimum, of_rows), num_candidates), axis=1)
        rows = (runs[:, :, None] * _RUN + jnp.arange(_RUN)).reshape(len(runs), runs.shape[1] * _RUN)
        squares = _squares(_at(queries, np.s_[:, None, None]), _at(targets, runs)).reshape(rows.shape)
        places = _smallest(squares, num_candidates)
        square, row = (jnp.take_along_axis(table, places, axis=1) for table in (squares, rows))
        row = jnp.where(jnp.isfinite(square), row, -1).astype(jnp.int32)
        return jnp.pad(row, [(0, 0), (0, num_candidates - row.shape[1])], constant_values=-1).T

    count = source.valid.size
    block = max(1, _STORED // max(num_runs, num_candidates * _RUN * len(targets)))
    if count <= block:
        rows = nearest(queries)
    else:
        rows = jax.lax.map(nearest, _in_blocks(queries, block, 0.0)).swapaxes(0, 1).reshape(num_candidates, -1)
    return jnp.where(source.valid, rows[:, :count], -1)


def _coordinates(rows: SearchPoints) -> Coordinates:
    values = [*rows.points.T, *rows.descriptors.T]
    penalties = [None] * len(values) if rows.penalty is None else [None, None, None, *rows.penalty.T]
    return list(zip(values, penalties, strict=True))


def _in_blocks(rows: Coordinates, size: int, last: float) -> Coordinates:
    """Coordinates as (n, size); the value `last` fills up the last block."""
    return jax.tree.map(
        lambda values: jnp.pad(values, (0, -values.size % size), constant_values=last).reshape(-1, size), rows
    )


def _at(rows: Coordinates, index: Any) -> Coordinates:
    return jax.tree.map(lambda values: values[index], rows)


def _squares(queries: Coordinates, targets: Coordinates) -> Float[Array, "*rows"]:
    """Squared search distances, metres², of rows whose axes broadcast."""
    squares = []
    for (query, query_penalty), (target, target_penalty) in zip(queries, targets, strict=True):
        square = (query - target) ** 2
        for penalty in (query_penalty, target_penalty):
            if penalty is not None:
                square = jnp.where(penalty > 0, penalty, square)
        squares.append(square)
    return sum(squares[1:], squares[0])


def _smallest(numbers: Float[Array, "N M"], count: int) -> Int[Array, "N m"]:
    """Places of the smallest numbers of each row, ties by place."""
    size = numbers.shape[1]
    if count == 1:
        return jnp.argmin(numbers, axis=1, keepdims=True)
    if size <= 2 * _GROUP * count:
        return jax.lax.top_k(-numbers, min(count, size))[1]
    # In those groups whose smallest numbers are smallest, for the same reason as in runs.
    numbers = jnp.pad(numbers, ((0, 0), (0, -size % _GROUP)), constant_values=jnp.inf)
    least = functools.reduce(jnp.minimum, (numbers[:, place::_GROUP] for place in range(_GROUP)))
    groups = jnp.sort(_smallest(least, count), axis=1)
    places = (groups[:, :, None] * _GROUP + jnp.arange(_GROUP)).reshape(len(numbers), count * _GROUP)
    smallest = _smallest(jnp.take_along_axis(numbers, places, axis=1), count)
    return jnp.take_along_axis(places, smallest, axis=1)
