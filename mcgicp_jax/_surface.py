"""What registration knows of a cloud, as tables with a row for each point.

A point's way: `Neighborhoods` (it and its neighbours, gathered) → `Local` (covariance, normal, fits of the channels:
no method takes part) → `Surface` (as one method sees it). Rows come first, since matched rows are gathered; inside,
formulas work on structures of arrays, which the properties and functions here give.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from mcgicp_jax._pose import AnyArray
from mcgicp_jax._search import Rows

# Columns of a surface's table.
_POINTS, _COVARIANCE, _GEOMETRY, _CHANNELS = slice(0, 3), slice(3, 9), slice(9, 15), slice(15, 21)
# Columns of `Local.observed`: geometry, roughness, reach; then six for each channel.
_FIXED, _PER_CHANNEL = 8, 6


if TYPE_CHECKING:
    Table: TypeAlias = Any
else:
    Table = Float[AnyArray, "*batch N L"] | tuple[Float[AnyArray, "*batch N _"], ...]


class Neighborhoods(NamedTuple):
    """Some points of a cloud and their nearest neighbours, gathered.

    Positions and channels are kept apart, so that a derivative with respect to one does not go through the other.

    Attributes:
        own: (3, n) positions of the points, metres.
        near: (3, k, n) those of their neighbours.
        own_channels: (C, n) channels of the points; C is 0 where channels are not used.
        near_channels: (C, k, n) those of their neighbours.
        present: (k, n) which neighbours there are.
        own_known: (C, n) which channels the points have; None if no point lacks any.
        near_known: (C, k, n) which channels both a point and its neighbour have; None likewise.
        other: (k, n) which neighbours are not the point itself; None likewise.
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
        """Neighbour less point, metres; 0 where there is no neighbour."""
        return jnp.where(self.present, self.near[axis] - self.own[axis], 0)

    def difference(self, channel: int) -> Float[AnyArray, "k n"]:
        """Neighbour less point; 0 where there is no neighbour."""
        return jnp.where(self.present, self.near_channels[channel] - self.own_channels[channel], 0)


class Local(NamedTuple):
    """Statistics of neighbourhoods, whatever the method.

    Attributes:
        shape: (N, 9): covariance of the neighbours about their mean (symmetric, metres²), and normal, the unit
            eigenvector of its smallest eigenvalue.
        observed: (N, 8 + 6 C), constant to autodiff: see the properties.
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
        """Observability by the normal, symmetric, see `_observability`."""
        return self.observed[:, :6].T

    @property
    def roughness(self) -> Float[AnyArray, "N"]:
        """Half the squared height of a neighbour over the point, across the surface, metres²."""
        return self.observed[:, 6]

    @property
    def reach(self) -> Float[AnyArray, "N"]:
        """Distance to the farthest neighbour, metres."""
        return self.observed[:, 7]

    def fit(self, channel: int) -> Float[AnyArray, "6 N"]:
        """Linear fit of a channel over the tangent plane: gradient (2), residual variance (1), inverse (3) of the
        normal equations; the residual is NaN, the rest 0, where too few neighbours have the channel."""
        start = _FIXED + _PER_CHANNEL * channel
        return self.observed[:, start : start + _PER_CHANNEL].T


class Surface(NamedTuple):
    """A cloud as a method sees it.

    Attributes:
        rows: what a search sees.
        table: columns of each point, 9, 15 or 21: position, covariance (symmetric; its meaning is the method's
            affair), and where observability is known, that of geometry and of the channels (symmetric). On the host
            in one array, so that matched rows are gathered at once; inside transformations (N, 3), (N, 6), ..., so
            that a derivative goes through nothing but what moves.
        details: (N, 6) for the covariance of the pose: variance of the descriptors about their linear fits (metres²),
            normal (3), roughness, reach; None where observability is not known.
    """

    rows: Rows
    table: Table
    details: Float[AnyArray, "*batch N 6"] | None


def points_of(table: Table) -> Float[AnyArray, "3 N"]:
    return table[0].T if isinstance(table, tuple) else table[:, _POINTS].T


def covariance_of(table: Table) -> Float[AnyArray, "6 N"]:
    return table[1].T if isinstance(table, tuple) else table[:, _COVARIANCE].T


def observability_of(table: Table) -> list[Float[AnyArray, "6 N"]]:
    """Of geometry, and of the channels: as many as the table knows."""
    if isinstance(table, tuple):
        return [columns.T for columns in table[2:]]
    return [table[:, columns].T for columns in (_GEOMETRY, _CHANNELS) if columns.stop <= table.shape[1]]


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
