"""Statistics of neighbourhoods that do not depend on the method: covariance, normal, observability, channel fits."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mcgicp_jax._compute.concrete import AnyArray
from mcgicp_jax._local_geometry.channel_fits import ChannelFits, fit_channels
from mcgicp_jax._local_geometry.neighborhoods import Neighborhoods
from mcgicp_jax._local_geometry.observability import geometry_observability
from mcgicp_jax._math import symmetric_matrices as alg

# Rank of the neighbour from which roughness is measured (0 is the point itself). The nearest neighbours are biased
# towards similar heights, and the heights of far ones include the curvature of the surface.
_ROUGHNESS_RANK = 5
# One (k, N) array per coordinate. Kept apart on purpose: jaxlib 0.10.2 on CPUs miscompiles, in float32, the reduction
# of a (3, k, N) array over its middle axis where the result is broadcast back and subtracted.
Offsets: TypeAlias = tuple[Float[Array, "k N"], Float[Array, "k N"], Float[Array, "k N"]]


class LocalGeometry(NamedTuple):
    """The shape of the surface around each point, and the slopes of its channels; one row per point.

    All but `covariance` and `normal` are constants to autodiff.

    Attributes:
        covariance: of the neighbours about their mean, metres² (symmetric).
        normal: unit eigenvector of its smallest eigenvalue.
        observability: by the shape of the surface (symmetric), see `_local_geometry.observability`.
        roughness: half the squared height difference along the normal between the point and a neighbour, metres².
        reach: distance to the farthest neighbour, metres.
        fits: linear fits of the channels.
    """

    covariance: Float[AnyArray, "*batch N 6"]
    normal: Float[AnyArray, "*batch N 3"]
    observability: Float[AnyArray, "*batch N 6"]
    roughness: Float[AnyArray, "*batch N"]
    reach: Float[AnyArray, "*batch N"]
    fits: ChannelFits


def describe(around: Neighborhoods) -> LocalGeometry:
    """Local geometry of neighbourhoods."""
    offsets = offsets_of(around)
    covariance = weighted_covariance(offsets, around.present.astype(offsets[0].dtype))
    normal = alg.smallest_eigenvector(covariance)
    constants = jax.lax.stop_gradient((around, offsets, covariance, normal))
    return _described(covariance, normal, *constants)


def _described(
    covariance: Float[Array, "6 n"],
    normal: Float[Array, "3 n"],
    around: Neighborhoods,
    offsets: Offsets,
    fixed_covariance: Float[Array, "6 n"],
    fixed_normal: Float[Array, "3 n"],
) -> LocalGeometry:
    count = jnp.maximum(jnp.sum(around.present, axis=0), 1).astype(normal.dtype)
    basis = alg.orthonormal_basis(fixed_normal)
    rank = min(_ROUGHNESS_RANK, offsets[0].shape[0] - 1)
    height = sum(offset[rank] * axis for offset, axis in zip(offsets, fixed_normal, strict=True))
    halves = _halves(around, offsets)
    x, y = (sum(offset * b for offset, b in zip(offsets, axis, strict=True)) for axis in basis)
    return LocalGeometry(
        covariance=covariance.T,
        normal=normal.T,
        observability=geometry_observability(fixed_covariance, fixed_normal, count, halves).T,
        roughness=0.5 * height**2,
        reach=jnp.sqrt(jnp.max(sum(offset * offset for offset in offsets), axis=0)),
        fits=fit_channels(around, x, y),
    )


def _halves(
    around: Neighborhoods, offsets: Offsets
) -> tuple[Float[Array, "6 m"], Float[Array, "3 m"], Float[Array, "m"]]:
    """Covariance, normal and number of every second neighbour, from the first on and then from the second on, as one
    array, which compiles once; normals are 0 where there are too few."""
    present = around.present.astype(offsets[0].dtype)
    halves = [[array[first::2] for array in (*offsets, present)] for first in (0, 1)]
    covariances = jnp.concatenate([weighted_covariance((x, y, z), weights) for x, y, z, weights in halves], axis=1)
    counts = jnp.concatenate([jnp.sum(weights, axis=0) for *_, weights in halves])
    used = (counts >= 3) & ~jnp.tile(around.few, 2)
    return covariances, jnp.where(used, alg.smallest_eigenvector(covariances), 0), counts


def offsets_of(around: Neighborhoods) -> Offsets:
    return around.offset(0), around.offset(1), around.offset(2)


def weighted_covariance(offsets: Offsets, weights: Float[Array, "k N"]) -> Float[Array, "6 N"]:
    """Weighted covariance about the weighted mean; zero where all weights are zero."""
    total = jnp.sum(weights, axis=0)
    weights = weights / jnp.where(total > 0, total, 1)
    x, y, z = (offset - jnp.sum(weights * offset, axis=0) for offset in offsets)
    pairs = ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))
    return jnp.stack([jnp.sum(weights * p * q, axis=0) for p, q in pairs])
