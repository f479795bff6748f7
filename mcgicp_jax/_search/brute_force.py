"""Brute-force nearest-neighbour search in XLA, for accelerators; and the default search of each platform."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

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
        size, padded = source.valid.size, _padded(source)
        found = _nearest(jnp.asarray(pose, source.points.dtype), padded, self._target, num_candidates)
        return np.asarray(found)[:, :size]

    def follow(
        self, source: SearchPoints, max_distance: float, num_candidates: int = 1
    ) -> Callable[[Float[ArrayLike, "7"]], Int[np.ndarray, "m N"]]:
        return lambda pose: self.nearest(pose, source, max_distance, num_candidates)


def _padded(rows: SearchPoints) -> SearchPoints:
    """The rows padded to their size class, so that clouds of all sizes run few programs."""
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
    rows = jnp.arange(target.valid.size, dtype=jnp.int32)

    def following(
        before: tuple[Float[Array, "N"], Int[Array, "N"]], _: None
    ) -> tuple[tuple[Float[Array, "N"], Int[Array, "N"]], Int[Array, "N"]]:
        """For each query, the target row next after `before` in the order of (squared distance, row)."""
        # Without the barrier the compiler would hoist the loop-invariant distances out of the loop and store them.
        before, *again = jax.lax.optimization_barrier((before, queries, target, rows))
        square = _squares(*again[:2])
        numbers = jnp.broadcast_to(again[2], square.shape)
        distance, row = (values[:, None] for values in before)
        # False where the distance is NaN.
        after = (square > distance) | ((square == distance) & (numbers > row))
        smallest, nearest = jax.lax.reduce(
            (jnp.where(after & target.valid, square, jnp.inf), numbers),
            (jnp.asarray(jnp.inf, square.dtype), jnp.int32(rows.size)),
            _nearer,
            dimensions=(1,),
        )
        return (smallest, nearest), jnp.where(jnp.isfinite(smallest) & source.valid, nearest, -1)

    start = (jnp.full(source.valid.size, -1, moved.dtype), jnp.full(source.valid.size, -1, jnp.int32))
    return jax.lax.scan(following, start, length=num_candidates)[1]


def _squares(source: SearchPoints, target: SearchPoints) -> Float[Array, "N M"]:
    """Squared search distance of every source row to every target row, metres²; not stored if reduced at once."""
    square = jnp.zeros((source.valid.size, target.valid.size), jnp.asarray(source.points).dtype)
    for query, point in zip(source.points.T, target.points.T, strict=True):
        square = square + (query[:, None] - point) ** 2
    for column in range(source.descriptors.shape[1]):
        added = (source.descriptors[:, column, None] - target.descriptors[:, column]) ** 2
        for rows, axis in ((source, 1), (target, 0)):
            if rows.penalty is not None:
                penalty = jnp.expand_dims(rows.penalty[:, column], axis)
                added = jnp.where(penalty > 0, penalty, added)
        square = square + added
    return square


def _nearer(one: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
    first = (one[0] < other[0]) | ((one[0] == other[0]) & (one[1] < other[1]))
    return jnp.where(first, one[0], other[0]), jnp.where(first, one[1], other[1])
