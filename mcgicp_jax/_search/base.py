"""Correspondences and the interface of nearest-neighbour searches."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import equinox as eqx
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.concrete import AnyArray, DeferredRows


class SearchPoints(NamedTuple):
    """The points of a cloud, as input to a search; NumPy or JAX arrays.

    Attributes:
        points: (N, 3), metres.
        descriptors: (N, D), channels in metres (α · channel), searched along with the position; D may be 0.
        valid: (N,), False for rows to ignore, both as queries and as matches.
        penalty: (N, D), metres²: 0 where a row has the channel; else the penalty for the missing channel, which
            replaces the squared difference of the descriptors in the squared search distance. It is the same for all
            rows that lack the channel. None: no row lacks a channel.
    """

    points: Float[AnyArray, "*batch N 3"]
    descriptors: Float[AnyArray, "*batch N D"]
    valid: Bool[AnyArray, "*batch N"]
    penalty: Float[AnyArray, "*batch N D"] | None = None


# The identity, as the searches take poses.
IDENTITY = np.array([1.0, 0, 0, 0, 0, 0, 0])


def search_points(points: Float[np.ndarray, "N 3"]) -> SearchPoints:
    return SearchPoints(points, np.zeros((len(points), 0), points.dtype), np.ones(len(points), bool))


def by_position(rows: SearchPoints) -> SearchPoints:
    return SearchPoints(rows.points, rows.descriptors[:, :0], rows.valid)


class Correspondences(eqx.Module):
    """For each source point, its match in the target; a pytree.

    The indices are constants to autodiff: gradients are taken with the matches held fixed.

    Attributes:
        indices: (N,) rows of the target, meaningless where `valid` is False; (m, N), nearest first, if
            `num_candidates` m > 1 were requested. `distances` and `valid` have the same shape.
        distances: correspondence distances, metres: from the moved source point to its match, in position only.
        valid: whether the match counts: both points are valid and at most `max_distance` apart.
    """

    indices: Int[AnyArray, "*batch N"]
    distances: Float[AnyArray, "*batch N"]
    valid: Bool[AnyArray, "*batch N"]

    def __repr__(self) -> str:
        return f"Correspondences({self.indices.shape[-1]} source rows)"


# Maps a pose to target rows, as `AbstractIndex.nearest` does.
Matcher: TypeAlias = Callable[[Float[ArrayLike, "7"]], Int[np.ndarray, "m N"]]


class AbstractIndex(abc.ABC):
    """An index over target points, such as a k-d tree."""

    @abc.abstractmethod
    def nearest(
        self, pose: Float[ArrayLike, "7"], source: SearchPoints, max_distance: float, num_candidates: int = 1
    ) -> Int[np.ndarray, "m N"]:
        """The target rows nearest to each source point in position and descriptors, the positions moved by a pose.

        Args:
            pose: T_target_source as (7,) quaternion wxyz and translation, like `jaxlie.SE3.wxyz_xyz`.
            source: the N query points.
            max_distance: metres of position; matches further apart may be reported as −1.
            num_candidates: m, the number of target rows per source row.

        Returns:
            (m, N) target rows, nearest first; −1 where there is none.
        """

    @abc.abstractmethod
    def follow(self, source: SearchPoints, max_distance: float, num_candidates: int = 1) -> Matcher:
        """A function that maps a pose to the rows that `nearest` returns, several candidates in any order.

        It serves one registration, and may reuse the results of earlier poses.
        """


class AbstractSearch(eqx.Module):
    """An algorithm for nearest-neighbour search."""

    # As in `PointCloud`.
    __getattribute__ = object.__getattribute__

    @property
    def num_threads(self) -> int | None:
        """Largest number of host threads that one registration may use; None for no limit."""
        return None

    @abc.abstractmethod
    def index(self, target: SearchPoints) -> AbstractIndex:
        """Build an index over the valid rows of a target of concrete arrays."""

    @abc.abstractmethod
    def nearest_traced(
        self,
        pose: Float[Array, "7"],
        source: SearchPoints,
        target: SearchPoints,
        max_distance: Float[Array, ""],
        running: Bool[Array, ""],
        num_candidates: int = 1,
    ) -> Int[Array, "m N"]:
        """`AbstractIndex.nearest` for traced arrays.

        Args:
            target: the points to search; the other arguments and the result are those of `AbstractIndex.nearest`.
            running: False if the result will not be used, as of a registration that has ended under `vmap`; it is
                arbitrary then.
        """

    @abc.abstractmethod
    def neighbors(self, points: Float[np.ndarray, "N 3"], num_neighbors: int) -> Int[np.ndarray, "N k"]:
        """Rows of the k nearest neighbours of every point, nearest first, including the point itself.

        The points are finite, in metres. The row is −1 where there are fewer than k points.
        """

    def neighbors_on_demand(self, points: Float[np.ndarray, "N 3"], num_neighbors: int) -> DeferredRows:
        """`neighbors`, perhaps found when they are needed."""
        neighbors = self.neighbors(points, num_neighbors).astype(np.int32, copy=False)
        neighbors.setflags(write=False)
        return DeferredRows.of(neighbors)
