"""Neighbourhoods of points, and linear fits of their channels over the tangent plane."""

from __future__ import annotations

from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import AnyArray, is_deferred, numpy_for
from mcgicp_jax._compute.row_functions import Input, Rows
from mcgicp_jax._math import symmetric_matrices as alg

# Number of points of a cloud below which normals of halves of the neighbours are not used: their mean over 50
# neighbourhoods of 20 points scatters by more than what counts as constrained. Random points in a cube seemed
# unconstrained with 100 to 500 points, but not with 1,000.
FEW_POINTS = 1000

NO_NEIGHBORS = "cloud: expected one with neighbors or covariances; make it with mcgicp_jax.preprocess"


class Neighborhoods(NamedTuple):
    """Positions and channels of n points of a cloud and of their k nearest neighbours.

    Positions and channels are separate arrays, so that a derivative with respect to one does not involve the other.
    All but `own` and `given` are None where only the points themselves are needed.

    Attributes:
        own: (3, n) positions of the points, metres.
        given: (n, 3, 3) covariances that were given with the cloud; None if there are none.
        near: (3, k, n) positions of their neighbours, metres, nearest first; the point itself is one of them.
        own_channels: (C, n) channels of the points; C is 0 where channels are not used.
        near_channels: (C, k, n) channels of their neighbours.
        present: (k, n) which neighbours exist.
        own_measured: (C, n) which channels the points have; None if no point lacks any.
        near_measured: (C, k, n) which channels both a point and its neighbour have; None if no point lacks any.
        other: (k, n) which neighbours exist and are not the point itself; None if no point lacks a channel.
        few: (n,) whether the cloud of a point has fewer points than `FEW_POINTS`.
    """

    own: Float[AnyArray, "3 n"]
    given: Any = None
    near: Any = None
    own_channels: Any = None
    near_channels: Any = None
    present: Any = None
    own_measured: Any = None
    near_measured: Any = None
    other: Any = None
    few: Any = None

    @property
    def num_channels(self) -> int:
        return 0 if self.own_channels is None else self.own_channels.shape[0]

    @property
    def given_covariance(self) -> Float[AnyArray, "6 n"] | None:
        return None if self.given is None else alg.symmetric_from_matrix(jnp.asarray(self.given))

    def offset(self, axis: int) -> Float[AnyArray, "k n"]:
        """Coordinate of each neighbour minus that of the point, metres; 0 where there is no neighbour."""
        if self.near is None:
            raise ValueError(NO_NEIGHBORS)
        return jnp.where(self.present, self.near[axis] - self.own[axis], 0)

    def difference(self, channel: int) -> Float[AnyArray, "k n"]:
        """Channel of each neighbour minus that of the point, channel units; 0 where there is no neighbour."""
        return jnp.where(self.present, self.near_channels[channel] - self.own_channels[channel], 0)

    def measured(self, channel: int) -> Bool[AnyArray, "k n"]:
        """Which neighbours have a channel that the point also has."""
        return self.present if self.near_measured is None else self.near_measured[channel]


def check_neighbors(cloud: PointCloud, xp: ModuleType) -> Any:
    """The (N, k) neighbours of a cloud, on the host perhaps `DeferredRows`; a raw cloud raises `ValueError`."""
    deferred = cloud.deferred_neighbors
    if deferred is None:
        raise ValueError(NO_NEIGHBORS)
    return deferred if xp is np and is_deferred(deferred) else xp.asarray(deferred.whole)


class PointRows(NamedTuple):
    """The columns of a cloud from which its surface is computed; None where not needed."""

    points: Any  # (N, 3), metres
    channels: Any = None  # (N, C)
    measured: Any = None  # (N, C) which channels the points have; None if no point lacks any
    given: Any = None  # (N, 3, 3) covariances that were given with the cloud
    few: Any = None  # (N,) whether the cloud has fewer points than `FEW_POINTS`


def inputs_of_neighbors(cloud: PointCloud, with_channels: bool, with_given: bool = False) -> list[Input]:
    """The points and their neighbours as inputs of a row function, for `neighborhoods`. Without channels, the programs
    do not depend on their number. `with_given` includes the covariances given with the cloud."""
    # Neighbours and `valid`, which differentiation does not trace.
    xp = numpy_for(cloud.deferred_neighbors, cloud.valid)
    neighbors, valid = check_neighbors(cloud, xp), xp.asarray(cloud.valid)
    if with_channels:
        near = PointRows(cloud.points, cloud.channels, cloud.channel_valid)
    else:
        near = PointRows(cloud.points, np.zeros((cloud.points.shape[0], 0), cloud.points.dtype))
    few = xp.broadcast_to(xp.sum(valid) < FEW_POINTS, valid.shape)
    own = near._replace(given=cloud.covariances if with_given else None, few=few)
    return [Input(own), Input(near, neighbors)]


def of_rows(inputs: list[Input], rows: Any) -> list[Input]:
    if rows is None:
        return inputs
    return [entry._replace(index=rows if entry.index is None else entry.index[rows]) for entry in inputs]


def neighborhoods(own: Rows, near: Rows | None = None) -> Neighborhoods:
    if near is None:
        return Neighborhoods(own.tree.points.T, own.tree.given)
    present, measured, own_channels = near.index >= 0, own.tree.measured, own.tree.channels.T
    # Without the barrier XLA would gather each number again for each of its uses.
    positions, channels = jax.lax.optimization_barrier(
        (near.tree.points.transpose(2, 0, 1), near.tree.channels.transpose(2, 0, 1))
    )
    around = Neighborhoods(
        own.tree.points.T, own.tree.given, positions, own_channels, channels, present, few=own.tree.few
    )
    if measured is None:
        return around
    both = present & near.tree.measured.transpose(2, 0, 1) & measured.T[:, None]
    return around._replace(own_measured=measured.T, near_measured=both, other=present & (near.index != own.index))


class ChannelFits(NamedTuple):
    """Linear fit of each channel over the tangent plane, in the basis `orthonormal_basis(normal)`; one row per point.

    Where too few neighbours have the channel, the residual is NaN and the other values are 0.

    Attributes:
        gradients: of the fits to every second neighbour, from the first and from the second on, channel units per
            metre. Their noise is independent.
        residual: variance of the channel about the fit, channel units².
        inverse: inverse of the normal matrix (symmetric), 1/metres²: times `residual`, the covariance of the gradient.
    """

    gradients: Float[AnyArray, "*batch N C 2 2"]
    residual: Float[AnyArray, "*batch N C"]
    inverse: Float[AnyArray, "*batch N C 3"]


def fit_channels(around: Neighborhoods, x: Float[Array, "k n"], y: Float[Array, "k n"]) -> ChannelFits:
    """Fit every channel; x and y are the coordinates of the neighbours in the tangent plane, metres, 0 if missing."""
    if not around.num_channels:
        size = around.own.shape[1]
        return ChannelFits(*(jnp.zeros(shape, x.dtype) for shape in ((size, 0, 2, 2), (size, 0), (size, 0, 3))))
    present = around.present.astype(x.dtype)
    count = jnp.maximum(jnp.sum(present, axis=0), 1)
    x, y = (present * (offset - jnp.sum(offset, axis=0) / count) for offset in (x, y))
    sums = []
    for channel in range(around.num_channels):
        rows = x, y, around.difference(channel), around.measured(channel).astype(x.dtype)
        # Every second neighbour, from the first and from the second on. Sums over all are the sums of both halves.
        first, second = (_fit_sums(*(row[i::2] for row in rows)) for i in (0, 1))
        sums.append(jnp.stack([first + second, first, second], axis=1))
    fit = _fit_of(jnp.stack(sums, axis=2))
    enough = fit.weight[0] > 3 if around.own_measured is None else (fit.weight[0] > 3) & around.own_measured
    return ChannelFits(
        jnp.where(enough, fit.gradient[:, 1:], 0).transpose(3, 2, 1, 0),
        jnp.where(enough, fit.residual[0], jnp.nan).T,
        jnp.where(enough, fit.inverse[:, 0], 0).transpose(2, 1, 0),
    )


class LinearFit(NamedTuple):
    """Weighted linear fits over a plane: `inverse` is that of the normal matrix, `weight` the sum of the weights. Where
    the points lie on a line, gradient and inverse are 0; for three points or fewer, the residual is meaningless."""

    gradient: Float[Array, "2 ..."]
    residual: Float[Array, "..."]
    inverse: Float[Array, "3 ..."]
    weight: Float[Array, "..."]


@jax.jit
def fit_linear(
    x: Float[Array, "k N"], y: Float[Array, "k N"], values: Float[Array, "k N"], weights: Float[Array, "k N"]
) -> LinearFit:
    """Fit a + b x + c y to the values of each neighbourhood; weights are 1, or 0 for values to ignore."""
    count = jnp.maximum(jnp.sum(weights, axis=0), 1)
    x, y = (offset - jnp.sum(weights * offset, axis=0) / count for offset in (x, y))
    return _fit_of(_fit_sums(x, y, values, weights))


def _fit_sums(
    x: Float[Array, "k N"], y: Float[Array, "k N"], values: Float[Array, "k N"], weights: Float[Array, "k N"]
) -> Float[Array, "10 N"]:
    """Input of `_fit_of`. With an origin of x and y far from their mean, the fit would be lost to rounding."""
    wx, wy, wv = weights * x, weights * y, weights * values
    products = (weights, wx, wy, wx * x, wx * y, wy * y, wv, wv * x, wv * y, wv * values)
    return jnp.stack([jnp.sum(product, axis=0) for product in products])


def _fit_of(sums: Float[Array, "10 ..."]) -> LinearFit:
    count, x, y, xx, xy, yy, v, xv, yv, vv = sums
    # About the means.
    mean_x, mean_y, mean_v = (total / jnp.maximum(count, 1) for total in (x, y, v))
    xx, xy, yy = xx - mean_x * x, xy - mean_x * y, yy - mean_y * y
    xv, yv, vv = xv - mean_x * v, yv - mean_y * v, vv - mean_v * v
    determinant = xx * yy - xy * xy
    planar = determinant > 1e-6 * (xx + yy) ** 2
    inverse = jnp.where(planar, jnp.stack([yy, -xy, xx]) / jnp.where(planar, determinant, 1), 0)
    p, q, r = inverse
    gx, gy = p * xv + q * yv, q * xv + r * yv
    square = jnp.maximum(vv - gx * xv - gy * yv, 0)
    return LinearFit(jnp.stack([gx, gy]), square / jnp.maximum(count - 3, 1), inverse, count)
