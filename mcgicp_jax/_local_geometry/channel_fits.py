"""Linear fits of channels over the tangent plane of a point."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mcgicp_jax._compute.concrete import AnyArray
from mcgicp_jax._local_geometry.neighborhoods import Neighborhoods


class ChannelFits(NamedTuple):
    """Linear fit of each channel over the tangent plane, by its basis `orthonormal_basis(normal)`; one row per point.

    Where too few neighbours have the channel, the residual is NaN and the rest 0.

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
    """Fit every channel; x and y are the coordinates of the neighbours in the tangent plane, metres."""
    size = around.own.shape[1]
    gradients, residuals, inverses = [], [], []
    for channel in range(around.num_channels):
        values, known = around.difference(channel), around.known(channel).astype(x.dtype)
        fit = fit_linear(x, y, values, known)
        halves = [fit_linear(*(array[first::2] for array in (x, y, values, known))).gradient for first in (0, 1)]
        enough = fit.weight > 3 if around.own_known is None else (fit.weight > 3) & around.own_known[channel]
        gradients.append(jnp.where(enough, jnp.stack([jnp.stack(half) for half in halves]), 0))
        residuals.append(jnp.where(enough, fit.residual, jnp.nan))
        inverses.append(jnp.where(enough, fit.inverse, 0))
    if not gradients:
        return ChannelFits(*(jnp.zeros(shape, x.dtype) for shape in ((size, 0, 2, 2), (size, 0), (size, 0, 3))))
    # From (C, columns, n) to rows.
    return ChannelFits(
        jnp.stack(gradients).transpose(3, 0, 1, 2), jnp.stack(residuals).T, jnp.stack(inverses).transpose(2, 0, 1)
    )


class LinearFit(NamedTuple):
    """Linear fit of values over a plane, by weighted least squares.

    Attributes:
        gradient: derivatives of the values along x and y; 0 where the points lie on a line.
        residual: variance of the values about the fit; meaningless for three points or fewer.
        inverse: (3, N) inverse normal matrix (symmetric): times `residual`, the covariance of the gradient. 0 on a
            line.
        weight: sum of the weights.
    """

    gradient: tuple[Float[Array, "N"], Float[Array, "N"]]
    residual: Float[Array, "N"]
    inverse: Float[Array, "3 N"]
    weight: Float[Array, "N"]


@jax.jit
def fit_linear(
    x: Float[Array, "k N"], y: Float[Array, "k N"], values: Float[Array, "k N"], weights: Float[Array, "k N"]
) -> LinearFit:
    """Fit a + b x + c y to the values of each neighbourhood; weights are 1, or 0 for values to ignore."""
    count = jnp.sum(weights, axis=0)

    def centred(values: Float[Array, "k N"]) -> Float[Array, "k N"]:
        return weights * (values - jnp.sum(weights * values, axis=0) / jnp.maximum(count, 1))

    x, y, values = centred(x), centred(y), centred(values)
    xx, xy, yy = jnp.sum(x * x, axis=0), jnp.sum(x * y, axis=0), jnp.sum(y * y, axis=0)
    determinant = xx * yy - xy * xy
    planar = determinant > 1e-6 * (xx + yy) ** 2
    inverse = jnp.where(planar, jnp.stack([yy, -xy, xx]) / jnp.where(planar, determinant, 1), 0)
    p, q, r = inverse
    xv, yv = jnp.sum(x * values, axis=0), jnp.sum(y * values, axis=0)
    gx, gy = p * xv + q * yv, q * xv + r * yv
    square = jnp.maximum(jnp.sum(values * values, axis=0) - gx * xv - gy * yv, 0)
    return LinearFit((gx, gy), square / jnp.maximum(count - 3, 1), inverse, count)
