"""Nearest neighbours by comparing every point with every other, in XLA alone: for accelerators.

And the choice of a search where none is asked for.
"""

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

from mcgicp_jax._cloud import size_class
from mcgicp_jax._kdtree import KDTreeSearch
from mcgicp_jax._search import AbstractIndex, AbstractSearch, Rows


def default_search(workers: int = -1) -> AbstractSearch:
    """`DenseSearch` where JAX computes on an accelerator, `KDTreeSearch` on a CPU."""
    return KDTreeSearch(workers) if jax.default_backend() == "cpu" else DenseSearch()


class DenseSearch(AbstractSearch):
    """Exact search that compares all points with all, for GPUs and TPUs; equal distances are ordered by row.

    Distances are sums of squared differences, reduced as they are computed, so that no table of pairs is ever stored.
    (As a product of matrices, |a|² − 2ab + |b|², such a table would have to be written and read, and in float32 it
    would lose a near neighbour's distance to cancellation.) They are those of the clouds' precision, where
    `KDTreeSearch` computes in float64: where two distances agree to the last digits, another point may be chosen.
    """

    def index(self, target: Rows) -> DenseIndex:
        return DenseIndex(target)

    def nearest_traced(
        self,
        pose: Float[Array, "7"],
        source: Rows,
        target: Rows,
        max_distance: Float[Array, ""],
        running: Bool[Array, ""],
        num_candidates: int = 1,
    ) -> Int[Array, "m N"]:
        return _nearest(pose, source, target, num_candidates)

    def neighbors(self, points: Float[np.ndarray, "N 3"], num_neighbors: int) -> Int[np.ndarray, "N k"]:
        size, count = size_class(len(points)), len(points)
        rows = Rows(
            points=np.pad(points.T, [(0, 0), (0, size - count)]),
            descriptors=np.zeros((size, 0), points.dtype),
            valid=np.arange(size) < count,
        )
        at_rest = jaxlie.SE3.identity().wxyz_xyz.astype(points.dtype)
        return np.asarray(_nearest(at_rest, rows, rows, num_neighbors)).T[:count]


class DenseIndex(AbstractIndex):
    """The target as it is: there is nothing to lay out."""

    def __init__(self, target: Rows):
        self._target = target

    def nearest(
        self, pose: Float[ArrayLike, "7"], source: Rows, max_distance: Float[ArrayLike, ""], num_candidates: int = 1
    ) -> Int[Array, "m N"]:
        return _nearest(jnp.asarray(pose, source.points.dtype), source, self._target, num_candidates)

    def follow(
        self, source: Rows, max_distance: Float[ArrayLike, ""]
    ) -> Callable[[Float[ArrayLike, "7"]], Int[Array, "N"]]:
        return lambda pose: self.nearest(pose, source, max_distance)[0]


@partial(jax.jit, static_argnames="num_candidates")
def _nearest(pose: Float[Array, "7"], source: Rows, target: Rows, num_candidates: int) -> Int[Array, "m N"]:
    rotation = jaxlie.SO3(pose[:4]).as_matrix().astype(pose.dtype)
    moved = jnp.dot(rotation, source.points, precision="highest") + pose[4:, None]
    queries = eqx.tree_at(lambda rows: rows.points, source, moved)
    rows = jnp.arange(target.valid.size, dtype=jnp.int32)

    def following(
        before: tuple[Float[Array, "N"], Int[Array, "N"]], _: None
    ) -> tuple[tuple[Float[Array, "N"], Int[Array, "N"]], Int[Array, "N"]]:
        """The nearest of those that come after `before` in the order of distance and row."""
        # The barrier, or else the compiler takes the distances, which are always the same, out of the loop, and stores
        # a table of them.
        before, *again = jax.lax.optimization_barrier((before, queries, target, rows))
        square = _squares(*again[:2])
        numbers = jnp.broadcast_to(again[2], square.shape)
        distance, row = (values[:, None] for values in before)
        # False for what is not a number.
        after = (square > distance) | ((square == distance) & (numbers > row))
        least, nearest = jax.lax.reduce(
            (jnp.where(after & target.valid, square, jnp.inf), numbers),
            (jnp.asarray(jnp.inf, square.dtype), jnp.int32(rows.size)),
            _nearer,
            dimensions=(1,),
        )
        return (least, nearest), jnp.where(jnp.isfinite(least) & source.valid, nearest, -1)

    nobody = (jnp.full(source.valid.size, -1, moved.dtype), jnp.full(source.valid.size, -1, jnp.int32))
    return jax.lax.scan(following, nobody, length=num_candidates)[1]


def _squares(source: Rows, target: Rows) -> Float[Array, "N M"]:
    """Squared distance of every source row to every target row, metres²; never stored if it is reduced at once."""
    square = jnp.zeros((source.valid.size, target.valid.size), jnp.asarray(source.points).dtype)
    for query, point in zip(source.points, target.points, strict=True):
        square = square + (query[:, None] - point) ** 2
    for column in range(source.descriptors.shape[1]):
        added = (source.descriptors[:, column, None] - target.descriptors[:, column]) ** 2
        for rows, axis in ((source, 1), (target, 0)):
            if rows.absence is not None:
                absence = jnp.expand_dims(rows.absence[:, column], axis)
                added = jnp.where(absence > 0, absence, added)
        square = square + added
    return square


def _nearer(one: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
    first = (one[0] < other[0]) | ((one[0] == other[0]) & (one[1] < other[1]))
    return jnp.where(first, one[0], other[0]), jnp.where(first, one[1], other[1])
