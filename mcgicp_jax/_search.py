"""Nearest neighbours on the host, and the correspondences that they make.

The only module that knows SciPy. Everything in it that a callback may run is NumPy alone.
"""

from __future__ import annotations

import abc
import collections
import hashlib
import threading
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._pose import rotation_from_quaternion

# How many candidates, as a multiple of those asked for, are looked at to break a tie by row number.
_TIE_CANDIDATES = 8


# Points (3, N), descriptors (N, D), valid (N,).
Rows: TypeAlias = tuple[Float[Array, "3 _N"], Float[Array, "_N D"], Bool[Array, "_N"]]


class Correspondences(eqx.Module):
    """For each source point, its match in the target; a pytree.

    To autodiff the row numbers are constants: gradients are taken with the matches held.

    Attributes:
        indices: (N,) rows of the target; or (m, N), nearest first, if several candidates were asked for.
        distances: (N,) metres between the moved source point and its match (position only, not channels).
        valid: (N,) whether the pair counts: both points exist and lie within `max_distance` of each other.
    """

    indices: Int[Array, "*batch N"]
    distances: Float[Array, "*batch N"]
    valid: Bool[Array, "*batch N"]

    def __repr__(self) -> str:
        return f"Correspondences({self.indices.shape[-1]} source rows)"


class AbstractIndex(abc.ABC):
    """Target points, laid out to be searched."""

    @abc.abstractmethod
    def nearest(
        self,
        pose: Float[ArrayLike, "7"],
        points: Float[ArrayLike, "3 N"],
        descriptors: Float[ArrayLike, "N D"],
        valid: Bool[ArrayLike, "N"],
        max_distance: Float[ArrayLike, ""],
        num_candidates: int = 1,
    ) -> Int[np.ndarray, "m N"]:
        """Rows of the m nearest target points of each source point, moved by a pose; descriptors do not move.

        Args:
            pose: quaternion wxyz and translation, as in `jaxlie.SE3.wxyz_xyz`.
            max_distance: metres; −1 may stand for a target point that lies further away.

        Returns:
            Nearest first; −1 where there is none.
        """


class AbstractSearch(eqx.Module):
    """A way to find nearest neighbours."""

    @abc.abstractmethod
    def index(
        self, points: Float[ArrayLike, "3 M"], descriptors: Float[ArrayLike, "M D"], valid: Bool[ArrayLike, "M"]
    ) -> AbstractIndex:
        """Lay out the valid target rows for searching."""

    @abc.abstractmethod
    def nearest_traced(
        self,
        pose: Float[Array, "7"],
        source: Rows,
        target: Rows,
        max_distance: Float[Array, ""],
        running: Bool[Array, ""],
        num_candidates: int = 1,
    ) -> Int[Array, "m N"]:
        """`AbstractIndex.nearest` inside a transformation; clouds are points, descriptors, valid.

        Where not `running`, as in a lane of a batch that is done, the answer is not used and may be anything.
        """

    @abc.abstractmethod
    def neighbors(self, points: Float[np.ndarray, "N 3"], num_neighbors: int) -> Int[np.ndarray, "N k"]:
        """The k nearest points of every point, itself among them, nearest first; −1 where there are fewer."""


class KDTreeSearch(AbstractSearch):
    """Exact search with SciPy's k-d tree on the host. Equal distances are ordered by row, so that results repeat.

    Attributes:
        workers: threads of one query; −1 takes all cores.
    """

    workers: int = eqx.field(static=True, default=-1)

    def index(
        self, points: Float[ArrayLike, "3 M"], descriptors: Float[ArrayLike, "M D"], valid: Bool[ArrayLike, "M"]
    ) -> KDTreeIndex:
        return KDTreeIndex(np.asarray(points), np.asarray(descriptors), np.asarray(valid), self.workers)

    def nearest_traced(
        self,
        pose: Float[Array, "7"],
        source: Rows,
        target: Rows,
        max_distance: Float[Array, ""],
        running: Bool[Array, ""],
        num_candidates: int = 1,
    ) -> Int[Array, "m N"]:
        return jax.pure_callback(
            partial(_nearest_callback, self.workers, num_candidates),
            jax.ShapeDtypeStruct((num_candidates, *source[2].shape), jnp.int32),
            pose,
            source,
            target,
            max_distance,
            running,
            vmap_method="expand_dims",
        )

    def neighbors(self, points: Float[np.ndarray, "N 3"], num_neighbors: int) -> Int[np.ndarray, "N k"]:
        found = _nearest(_tree(points), points, num_neighbors, self.workers)
        missing = num_neighbors - found.shape[1]
        return np.pad(found, [(0, 0), (0, missing)], constant_values=-1)


class KDTreeIndex(AbstractIndex):
    def __init__(
        self,
        points: Float[np.ndarray, "3 M"],
        descriptors: Float[np.ndarray, "M D"],
        valid: Bool[np.ndarray, "M"],
        workers: int,
    ):
        rows = np.hstack([points.T, descriptors])
        # The tree refuses what is not finite; the measurement at the pose will say NON_FINITE.
        self._rows = np.flatnonzero(valid & np.isfinite(rows).all(axis=1)).astype(np.int32)
        self._tree = _tree(rows[self._rows]) if self._rows.size else None
        self._workers = workers

    @property
    def num_rows(self) -> int:
        return self._rows.size

    def nearest(
        self,
        pose: Float[ArrayLike, "7"],
        points: Float[ArrayLike, "3 N"],
        descriptors: Float[ArrayLike, "N D"],
        valid: Bool[ArrayLike, "N"],
        max_distance: Float[ArrayLike, ""],
        num_candidates: int = 1,
    ) -> Int[np.ndarray, "m N"]:
        valid, descriptors = np.asarray(valid), np.asarray(descriptors)
        indices = np.full((num_candidates, valid.size), -1, np.int32)
        pose = np.asarray(pose, np.float64)
        if self._tree is None or not np.isfinite(pose).all():
            return indices
        with np.errstate(invalid="ignore"):
            moved = np.asarray(points).T @ rotation_from_quaternion(pose[:4]).T + pose[4:]
        queries = np.hstack([moved, descriptors])
        active = np.flatnonzero(valid & np.isfinite(queries).all(axis=1))
        # With descriptors, the nearest may lie beyond the gate while a pair within it is further in all dimensions:
        # then the whole space is searched. The margin covers rounding; the gate itself is applied to the position.
        bound = np.inf if descriptors.shape[1] else 1.001 * float(np.asarray(max_distance))
        found = _nearest(self._tree, queries[active], num_candidates, self._workers, bound).T
        indices[: len(found), active] = np.append(self._rows, -1)[found]
        return indices


class _IndexCache:
    """The trees of the targets seen last, by content: a callback that is pure still builds each tree only once."""

    def __init__(self, rows: int):
        self._rows = rows
        self._lock = threading.Lock()
        self._indices: collections.OrderedDict[bytes, KDTreeIndex] = collections.OrderedDict()

    def get(self, points: np.ndarray, descriptors: np.ndarray, valid: np.ndarray, workers: int) -> KDTreeIndex:
        digest = hashlib.blake2b(repr((points.shape, descriptors.shape, points.dtype, workers)).encode())
        for array in (points, descriptors, valid):
            digest.update(np.ascontiguousarray(array).data)
        key = digest.digest()
        with self._lock:
            if key in self._indices:
                self._indices.move_to_end(key)
                return self._indices[key]
        index = KDTreeIndex(points, descriptors, valid, workers)
        with self._lock:
            self._indices[key] = index
            while len(self._indices) > 1 and sum(kept.num_rows for kept in self._indices.values()) > self._rows:
                self._indices.popitem(last=False)
        return index


# Enough for hundreds of scans in a batch, some hundred megabytes.
_index_cache = _IndexCache(rows=2_000_000)


def _nearest_callback(
    workers: int,
    num_candidates: int,
    pose: Any,
    source: tuple[Any, Any, Any],
    target: tuple[Any, Any, Any],
    max_distance: Any,
    running: Any,
) -> Int[np.ndarray, "*batch m N"]:
    """`nearest` over any leading batch dimensions, some of them 1 where an argument has no batch."""
    trailing = (1, 2, 2, 1, 2, 2, 1, 0, 0)
    arrays = [np.asarray(array) for array in (pose, *source, *target, max_distance, running)]
    batch = np.broadcast_shapes(*(array.shape[: array.ndim - n] for array, n in zip(arrays, trailing, strict=True)))
    lanes = [
        np.broadcast_to(array, batch + array.shape[array.ndim - n :]) for array, n in zip(arrays, trailing, strict=True)
    ]
    indices = np.full((*batch, num_candidates, lanes[3].shape[-1]), -1, np.int32)
    for lane in np.ndindex(batch):
        # Of each cloud: points, descriptors, valid.
        moving, a, b, c, p, q, r, limit, active = (array[lane] for array in lanes)
        if active:
            index = _index_cache.get(p, q, r, workers)
            indices[lane] = index.nearest(moving, a, b, c, limit, num_candidates)
    return indices


def _tree(rows: Float[np.ndarray, "M D"]) -> scipy.spatial.cKDTree:
    # Unbalanced and uncompacted trees build several times faster and are searched about as fast.
    return scipy.spatial.cKDTree(rows, balanced_tree=False, compact_nodes=False)


def _nearest(
    tree: scipy.spatial.cKDTree, queries: Float[np.ndarray, "N D"], k: int, workers: int, bound: float = np.inf
) -> Int[np.ndarray, "N k"]:
    """Rows of the k nearest, ordered by (distance, row); `tree.n` where nothing lies within `bound`.

    The tree leaves the order of equal distances to chance. One neighbour more than needed shows where there are any.
    """
    k = min(k, tree.n)
    asked = min(k + 1, tree.n)
    distances, rows = tree.query(queries, np.arange(1, asked + 1), workers=workers, distance_upper_bound=bound)
    nearest = rows[:, :k].astype(np.int32)
    tied = np.flatnonzero((distances[:, 1:] == distances[:, :-1]).any(axis=1) & np.isfinite(distances[:, 0]))
    while tied.size:
        order = np.lexsort((rows[tied], distances[tied]), axis=1)
        nearest[tied] = np.take_along_axis(rows[tied], order, axis=1)[:, :k]
        # A tie that the last candidate shares may go on beyond it.
        open_ended = np.isfinite(distances[tied, -1]) & (distances[tied, k - 1] == distances[tied, -1])
        tied = tied[open_ended]
        if asked == min(_TIE_CANDIDATES * (k + 1), tree.n):
            break
        asked = min(2 * asked, _TIE_CANDIDATES * (k + 1), tree.n)
        if tied.size:
            wider = tree.query(queries[tied], np.arange(1, asked + 1), workers=workers, distance_upper_bound=bound)
            distances = np.full((len(queries), asked), np.inf)
            rows = np.full((len(queries), asked), tree.n)
            distances[tied], rows[tied] = wider
    return nearest
