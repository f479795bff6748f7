"""Correspondences, and what finds them: a search lays out target points and answers for the source's nearest ones."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._pose import AnyArray


class Rows(NamedTuple):
    """The points of a cloud as a search sees them; NumPy or JAX arrays.

    Attributes:
        points: (N, 3), metres.
        descriptors: (N, D), channels in metres (α · channel), searched along with the position; D may be 0.
        valid: (N,), False for rows that match nothing and are no match.
        penalty: (N, D), metres²: 0 where a row has the channel of a descriptor; where it lacks it, what the descriptor
            adds to the squared search distance, the same for all rows. None: no row lacks a channel.
    """

    points: Float[AnyArray, "*batch N 3"]
    descriptors: Float[AnyArray, "*batch N D"]
    valid: Bool[AnyArray, "*batch N"]
    penalty: Float[AnyArray, "*batch N D"] | None = None


class Correspondences(eqx.Module):
    """For each source point, its match in the target; a pytree.

    To autodiff the row numbers are constants: gradients are taken with the matches held.

    Attributes:
        indices: (N,) rows of the target; or (m, N), nearest first, if several candidates were asked for.
        distances: (N,) metres between the moved source point and its match (position only, not channels).
        valid: (N,) whether the match counts: both points exist and lie within `max_distance` of each other.
    """

    indices: Int[AnyArray, "*batch N"]
    distances: Float[AnyArray, "*batch N"]
    valid: Bool[AnyArray, "*batch N"]

    def __repr__(self) -> str:
        return f"Correspondences({self.indices.shape[-1]} source rows)"


class AbstractIndex(abc.ABC):
    """Target points, laid out to be searched."""

    @abc.abstractmethod
    def nearest(
        self, pose: Float[ArrayLike, "7"], source: Rows, max_distance: float, num_candidates: int = 1
    ) -> Int[np.ndarray, "m N"]:
        """Rows of the m nearest target points of each source point, moved by a pose; descriptors do not move.

        Args:
            pose: quaternion wxyz and translation, as in `jaxlie.SE3.wxyz_xyz`.
            max_distance: metres; −1 may stand for a target point that lies further away.

        Returns:
            Nearest first; −1 where there is none.
        """

    @abc.abstractmethod
    def follow(self, source: Rows, max_distance: float) -> Callable[[Float[ArrayLike, "7"]], Int[np.ndarray, "N"]]:
        """For one registration: a function that finds the nearest target row of each source row, pose after pose.

        Its answers are those of `nearest`; it may use what it knows from the pose before.
        """


class AbstractSearch(eqx.Module):
    """A way to find nearest neighbours."""

    @property
    def num_threads(self) -> int | None:
        """How many threads of the host one registration may keep busy; None for as many as it has use for."""
        return None

    @abc.abstractmethod
    def index(self, target: Rows) -> AbstractIndex:
        """Lay out the valid target rows for searching; concrete arrays."""

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
        """`AbstractIndex.nearest` inside a transformation.

        Where not `running`, as in a lane that has finished, the answer is not used and may be anything.
        """

    @abc.abstractmethod
    def neighbors(self, points: Float[np.ndarray, "N 3"], num_neighbors: int) -> Int[np.ndarray, "N k"]:
        """The k nearest points of every point, itself among them, nearest first; −1 where there are fewer."""


def on_host(tree: Rows) -> Rows:
    """The same with NumPy arrays."""
    return jax.tree.map(np.asarray, tree)
