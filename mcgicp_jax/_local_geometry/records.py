"""Local surfaces of a cloud, as tables with one row per point.

They are computed in three steps: `Neighborhoods` (gathered neighbours) → `Local` (covariance, normal and channel fits,
independent of the method) → `Surface` (the input of one method). Tables are row-major, so that matched rows can be
gathered; formulas work on structures of arrays, (columns, N), which the properties and functions here return.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from mcgicp_jax._compute.concrete import AnyArray
from mcgicp_jax._search.base import SearchPoints

# Columns of a surface's table.
_POINTS, _COVARIANCE, _GEOMETRY, _CHANNELS = slice(0, 3), slice(3, 9), slice(9, 15), slice(15, 21)
# Number of columns of `Local.observed`: for geometry (6), roughness and reach; and for each channel.
_FIXED, _PER_CHANNEL = 8, 6


class Extended(NamedTuple):
    """A table with further columns that a method needs for its forces, see `AbstractMethod.features`.

    Attributes:
        table: `Surface.table` of a method without them.
        features: (N, L).
    """

    table: Any
    features: Float[AnyArray, "*batch N L"]


if TYPE_CHECKING:
    Table: TypeAlias = Any
else:
    Table = Float[AnyArray, "*batch N L"] | tuple[Float[AnyArray, "*batch N _"], ...] | Extended


class Neighborhoods(NamedTuple):
    """Positions and channels of n points of a cloud and of their k nearest neighbours.

    Positions and channels are separate arrays, so that a derivative with respect to one does not involve the other.

    Attributes:
        own: (3, n) positions of the points, metres.
        near: (3, k, n) positions of their neighbours, metres, nearest first; the point itself is one of them.
        own_channels: (C, n) channels of the points; C is 0 where channels are not used.
        near_channels: (C, k, n) channels of their neighbours.
        present: (k, n) which neighbours exist.
        own_known: (C, n) which channels the points have; None if no point lacks any.
        near_known: (C, k, n) which channels both a point and its neighbour have; None if no point lacks any.
        other: (k, n) which neighbours exist and are not the point itself; None if no point lacks a channel.
    """

    own: Float[AnyArray, "3 n"]
    near: Float[AnyArray, "3 k n"]
    own_channels: Float[AnyArray, "C n"]
    near_channels: Float[AnyArray, "C k n"]
    present: Bool[AnyArray, "k n"]
    own_known: Bool[AnyArray, "C n"] | None
    near_known: Bool[AnyArray, "C k n"] | None
    other: Bool[AnyArray, "k n"] | None

    @property
    def num_channels(self) -> int:
        return self.own_channels.shape[0]

    def offset(self, axis: int) -> Float[AnyArray, "k n"]:
        """Coordinate of each neighbour minus that of the point, metres; 0 where there is no neighbour."""
        return jnp.where(self.present, self.near[axis] - self.own[axis], 0)

    def difference(self, channel: int) -> Float[AnyArray, "k n"]:
        """Channel of each neighbour minus that of the point, channel units; 0 where there is no neighbour."""
        return jnp.where(self.present, self.near_channels[channel] - self.own_channels[channel], 0)


class Local(NamedTuple):
    """Statistics of neighbourhoods that do not depend on the method.

    Attributes:
        shape: (N, 9): covariance of the neighbours about their mean (symmetric, metres²), and the normal, the unit
            eigenvector of its smallest eigenvalue.
        observed: (N, 8 + 6 C): inputs of observability and pose covariance, see the properties; constant to autodiff.
    """

    shape: Float[AnyArray, "*batch N 9"]
    observed: Float[AnyArray, "*batch N L"]

    @property
    def num_channels(self) -> int:
        return (self.observed.shape[1] - _FIXED) // _PER_CHANNEL

    @property
    def covariance(self) -> Float[AnyArray, "6 N"]:
        return self.shape[:, :6].T

    @property
    def normal(self) -> Float[AnyArray, "3 N"]:
        return self.shape[:, 6:].T

    @property
    def geometry(self) -> Float[AnyArray, "6 N"]:
        """Observability from the shape of the surface, symmetric 3×3, see `_observability`."""
        return self.observed[:, :6].T

    @property
    def roughness(self) -> Float[AnyArray, "N"]:
        """Roughness, metres²: half the squared height difference along the normal between the point and a neighbour."""
        return self.observed[:, 6]

    @property
    def reach(self) -> Float[AnyArray, "N"]:
        """Distance to the farthest neighbour, metres."""
        return self.observed[:, 7]

    @property
    def fits(self) -> Float[AnyArray, "N _"]:
        """The columns of `fit` of all channels."""
        return self.observed[:, _FIXED:]

    def fit(self, channel: int) -> Float[AnyArray, "6 N"]:
        """Linear fit of a channel over the tangent plane: gradient (2), residual variance (1), and inverse of the
        normal matrix (3). Where too few neighbours have the channel, the variance is NaN and the rest 0."""
        start = _FIXED + _PER_CHANNEL * channel
        return self.observed[:, start : start + _PER_CHANNEL].T


class Surface(NamedTuple):
    """A cloud as the input of one method.

    Attributes:
        rows: input of the search.
        table: per point 9, 15 or 21 numbers: position (3), covariance (6; its meaning depends on the method), and if
            computed, observability from geometry (6) and from channels (6); matrices are symmetric. On the host one
            array, so that matched rows are gathered at once; inside transformations a tuple (N, 3), (N, 6), ..., so
            that derivatives involve only the columns that depend on the differentiated input. `Extended` by the
            features of the method, if it has any.
        details: (N, 6), for the covariance of the pose: variance of the descriptors about their linear fits (metres²),
            normal (3), roughness (metres²), reach (metres); None if observability is not computed.
    """

    rows: SearchPoints
    table: Table
    details: Float[AnyArray, "*batch N 6"] | None


def local_of(
    covariance: Float[AnyArray, "6 n"],
    normal: Float[AnyArray, "3 n"],
    geometry: Float[AnyArray, "6 n"],
    roughness: Float[AnyArray, "n"],
    reach: Float[AnyArray, "n"],
    fits: Float[AnyArray, "n _"],
) -> Local:
    """`Local` from its parts; `fits` are the columns of all channels."""
    observed = jnp.concatenate([geometry.T, roughness[:, None], reach[:, None], fits], axis=1)
    return Local(jnp.concatenate([covariance, normal]).T, observed)


def points_of(table: Table) -> Float[AnyArray, "3 N"]:
    table = _plain(table)
    return table[0].T if isinstance(table, tuple) else table[:, _POINTS].T


def covariance_of(table: Table) -> Float[AnyArray, "6 N"]:
    table = _plain(table)
    return table[1].T if isinstance(table, tuple) else table[:, _COVARIANCE].T


def observability_of(table: Table) -> list[Float[AnyArray, "6 N"]]:
    """Observability from geometry and from channels, each if the table contains it."""
    table = _plain(table)
    if isinstance(table, tuple):
        return [columns.T for columns in table[2:]]
    return [table[:, columns].T for columns in (_GEOMETRY, _CHANNELS) if columns.stop <= table.shape[1]]


def features_of(table: Extended) -> Float[AnyArray, "L N"]:
    return table.features.T


def _plain(table: Table) -> Any:
    return table.table if isinstance(table, Extended) else table


def gathered(table: Table, rows: Any) -> Any:
    return jax.tree.map(lambda columns: columns[rows], table)


def noise_of(details: Float[AnyArray, "N 6"]) -> Float[AnyArray, "N"]:
    return details[:, 0]


def normal_of(details: Float[AnyArray, "N 6"]) -> Float[AnyArray, "3 N"]:
    return details[:, 1:4].T


def roughness_of(details: Float[AnyArray, "N 6"]) -> Float[AnyArray, "N"]:
    return details[:, 4]


def reach_of(details: Float[AnyArray, "N 6"]) -> Float[AnyArray, "N"]:
    return details[:, 5]
