"""Neighbourhoods of points: positions and channels of each point and of its nearest neighbours."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import AnyArray, is_deferred
from mcgicp_jax._math import symmetric_matrices as alg

# Number of points below which normals of halves of the neighbours are not used: their mean over 50 neighbourhoods of
# 20 scatters by more than what counts as constrained. 100 to 500 random points in a cube seemed to be free, 1,000 not.
FEW_POINTS = 1000

NO_NEIGHBORS = "cloud: expected one with neighbors or covariances; make it with mcgicp_jax.preprocess"


class Neighborhoods(NamedTuple):
    """Positions and channels of n points of a cloud and of their k nearest neighbours.

    Positions and channels are separate arrays, so that a derivative with respect to one does not involve the other.

    Attributes:
        own: (3, n) positions of the points, metres.
        given: (n, 3, 3) covariances that were given with the cloud; None if there are none.
        near: (3, k, n) positions of their neighbours, metres, nearest first; the point itself is one of them. None, as
            are the following, where only the points themselves are needed.
        own_channels: (C, n) channels of the points; C is 0 where channels are not used.
        near_channels: (C, k, n) channels of their neighbours.
        present: (k, n) which neighbours exist.
        own_known: (C, n) which channels the points have; None if no point lacks any.
        near_known: (C, k, n) which channels both a point and its neighbour have; None if no point lacks any.
        other: (k, n) which neighbours exist and are not the point itself; None if no point lacks a channel.
        few: (n,) whether the cloud of a point has fewer points than `FEW_POINTS`.
    """

    own: Float[AnyArray, "3 n"]
    given: Any = None
    near: Any = None
    own_channels: Any = None
    near_channels: Any = None
    present: Any = None
    own_known: Any = None
    near_known: Any = None
    other: Any = None
    few: Any = None

    @property
    def num_channels(self) -> int:
        return 0 if self.own_channels is None else self.own_channels.shape[0]

    @property
    def given_covariance(self) -> Float[AnyArray, "6 n"] | None:
        """`given` as symmetric matrices."""
        return None if self.given is None else alg.symmetric_from_matrix(jnp.asarray(self.given))

    def offset(self, axis: int) -> Float[AnyArray, "k n"]:
        """Coordinate of each neighbour minus that of the point, metres; 0 where there is no neighbour."""
        if self.near is None:
            raise ValueError(NO_NEIGHBORS)
        return jnp.where(self.present, self.near[axis] - self.own[axis], 0)

    def difference(self, channel: int) -> Float[AnyArray, "k n"]:
        """Channel of each neighbour minus that of the point, channel units; 0 where there is no neighbour."""
        return jnp.where(self.present, self.near_channels[channel] - self.own_channels[channel], 0)

    def known(self, channel: int) -> Bool[AnyArray, "k n"]:
        """Which neighbours have a channel that the point has, too."""
        return self.present if self.near_known is None else self.near_known[channel]


def check_neighbors(cloud: PointCloud, xp: ModuleType = np) -> Any:
    """The (N, k) neighbours of a cloud, on the host perhaps `NeighborsOnDemand`; a raw cloud raises `ValueError`."""
    if cloud.deferred_neighbors is None:
        raise ValueError(NO_NEIGHBORS)
    deferred = cloud.deferred_neighbors
    return deferred if xp is np and is_deferred(deferred) else xp.asarray(cloud.neighbors)


def points_alone(cloud: PointCloud, xp: ModuleType) -> Callable[[Any], Neighborhoods]:
    """A function that maps rows to `Neighborhoods` without neighbours; arguments as of `gatherer`."""
    points, given = xp.asarray(cloud.points), cloud.covariances
    given = None if given is None else xp.asarray(given)

    def gather(rows: Any) -> Neighborhoods:
        return Neighborhoods(points[rows].T, None if given is None else given[rows])

    return gather


def has_few_points(cloud: PointCloud, xp: ModuleType) -> Bool[AnyArray, "N"]:
    """For each row whether the cloud has fewer points than `FEW_POINTS`; padding does not count."""
    valid = xp.asarray(cloud.valid)
    return xp.broadcast_to(xp.sum(valid) < FEW_POINTS, valid.shape)


def gatherer(
    cloud: PointCloud, with_channels: bool, xp: ModuleType, with_given: bool = False, few: Any = None
) -> Callable[[Any], Neighborhoods]:
    """A function that maps rows (a slice or an array of row numbers) to their neighbourhoods.

    Args:
        xp: NumPy on the host, `jax.numpy` where the rows may be traced.
        with_given: whether to include the covariances given with the cloud.
        few: `has_few_points`, for `joined` clouds, which need it to be described; others have their own.
    """
    neighbors, size = check_neighbors(cloud, xp), cloud.points.shape[0]
    if few is None and cloud.valid is not None:
        few = has_few_points(cloud, xp)
    points, channels = xp.asarray(cloud.points), xp.asarray(cloud.channels)
    points, channels = points.T, channels.T if with_channels else channels.T[:0]
    if xp is np:
        # Gathers along the last axis are contiguous for each coordinate.
        points, channels = np.ascontiguousarray(points), np.ascontiguousarray(channels)
    given = xp.asarray(cloud.covariances) if with_given and cloud.covariances is not None else None
    known = None
    if with_channels and cloud.channel_valid is not None:
        known = xp.asarray(cloud.channel_valid).T

    # The function does not refer to the cloud, since it is cached with it.
    def gather(rows: Any) -> Neighborhoods:
        chosen = neighbors[rows].T
        present = chosen >= 0
        near = xp.where(present, chosen, 0)
        around = Neighborhoods(
            own=points[:, rows],
            given=None if given is None else given[rows],
            near=xp.take(points, near, axis=1),
            own_channels=channels[:, rows],
            near_channels=xp.take(channels, near, axis=1),
            present=present,
            few=None if few is None else few[rows],
        )
        if known is None:
            return around
        own_known = known[:, rows]
        return around._replace(
            own_known=own_known,
            near_known=present & xp.take(known, near, axis=1) & own_known[:, None],
            other=present & (xp.arange(size)[rows] != near),
        )

    return gather
