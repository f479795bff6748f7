"""Neighbourhoods of points and their statistics: covariance, normal, linear fits of the channels."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import AnyArray
from mcgicp_jax._local_geometry.observability import geometry_observability
from mcgicp_jax._local_geometry.records import Local, Neighborhoods, local_of
from mcgicp_jax._math import symmetric_matrices as alg

# Rank of the neighbour that roughness is measured with (0 is the point itself). The nearest neighbours are selected for
# similar heights, and the heights of far ones include the curvature of the surface.
_ROUGHNESS_RANK = 5
# Added to the diagonal of Σ_w scaled to trace 1, so that it is nonsingular for collinear neighbours. Much larger values
# would bias small eigenvalues of Ω; with this one, rounding in float32 leaves two digits of Ω along a line.
_REGULARISATION = 1e-6

# One (k, N) array per coordinate. Kept apart on purpose: jaxlib 0.10.2 on CPUs miscompiles, in float32, the reduction
# of a (3, k, N) array over its middle axis where the result is broadcast back and subtracted.
Offsets: TypeAlias = tuple[Float[Array, "k N"], Float[Array, "k N"], Float[Array, "k N"]]

NO_NEIGHBORS = "cloud: expected one with neighbors or covariances; make it with mcgicp_jax.preprocess"


def check_neighbors(cloud: PointCloud) -> AnyArray:
    """The (N, k) neighbours of a cloud; raises `ValueError` if it was not preprocessed."""
    if cloud.neighbors is None:
        raise ValueError(NO_NEIGHBORS)
    return cloud.neighbors


def gatherer(cloud: PointCloud, with_channels: bool, xp: ModuleType) -> Callable[[Any], Neighborhoods]:
    """A function that maps rows (a slice or an array of row numbers) to their neighbourhoods.

    Args:
        xp: NumPy on the host, `jax.numpy` where the rows may be traced.
    """
    check_neighbors(cloud)
    neighbors, points, channels = (xp.asarray(array) for array in (cloud.neighbors, cloud.points, cloud.channels))
    points, channels = points.T, channels.T if with_channels else channels.T[:0]
    if xp is np:
        # Gathers along the last axis are contiguous for each coordinate.
        points, channels = np.ascontiguousarray(points), np.ascontiguousarray(channels)
    known = None
    if with_channels and cloud.channel_valid is not None:
        known = xp.asarray(cloud.channel_valid).T

    def gather(rows: Any) -> Neighborhoods:
        chosen = neighbors[rows].T
        present = chosen >= 0
        near = xp.where(present, chosen, 0)
        own_known = near_known = other = None
        if known is not None:
            own_known = known[:, rows]
            near_known = present & xp.take(known, near, axis=1) & own_known[:, None]
            other = present & (xp.arange(cloud.points.shape[0])[rows] != near)
        pairs = (points[:, rows], xp.take(points, near, axis=1), channels[:, rows], xp.take(channels, near, axis=1))
        return Neighborhoods(*pairs, present, own_known, near_known, other)

    return gather


def describe(around: Neighborhoods) -> Local:
    """Local statistics of neighbourhoods, which do not depend on the method."""
    offsets = _offsets(around)
    covariance = weighted_covariance(offsets, around.present.astype(offsets[0].dtype))
    normal = alg.smallest_eigenvector(covariance)
    return local_of(covariance, normal, *_observed(around, offsets, covariance, normal))


def _observed(
    around: Neighborhoods, offsets: Offsets, covariance: Float[Array, "6 n"], normal: Float[Array, "3 n"]
) -> tuple[Array, Array, Array, Array]:
    """Observability from geometry, roughness, reach, and the fits of the channels, of `Local`; constant to autodiff."""
    around, offsets, covariance, normal = jax.lax.stop_gradient((around, offsets, covariance, normal))
    count = jnp.maximum(jnp.sum(around.present, axis=0), 1).astype(normal.dtype)
    basis = alg.orthonormal_basis(normal)
    rank = min(_ROUGHNESS_RANK, offsets[0].shape[0] - 1)
    height = sum(offset[rank] * axis for offset, axis in zip(offsets, normal, strict=True))
    fits = jnp.zeros((0, height.size), height.dtype)
    if around.num_channels:
        x, y = (sum(offset * b for offset, b in zip(offsets, axis, strict=True)) for axis in basis)
        fits = jnp.concatenate([_channel_fit(around, x, y, channel) for channel in range(around.num_channels)])
    reach = jnp.sqrt(jnp.max(sum(offset * offset for offset in offsets), axis=0))
    return geometry_observability(covariance, normal, basis, count), 0.5 * height**2, reach, fits.T


def _channel_fit(
    around: Neighborhoods, x: Float[Array, "k n"], y: Float[Array, "k n"], channel: int
) -> Float[Array, "6 n"]:
    known = around.present if around.near_known is None else around.near_known[channel]
    fit = fit_linear(x, y, around.difference(channel), known.astype(x.dtype))
    enough = fit.weight > 3 if around.own_known is None else (fit.weight > 3) & around.own_known[channel]
    residual = jnp.where(enough, fit.residual, jnp.nan)
    gradient, inverse = jnp.where(enough, jnp.stack(fit.gradient), 0), jnp.where(enough, fit.inverse, 0)
    return jnp.concatenate([gradient, residual[None], inverse])


def _offsets(around: Neighborhoods) -> Offsets:
    return around.offset(0), around.offset(1), around.offset(2)


def weighted_covariance(offsets: Offsets, weights: Float[Array, "k N"]) -> Float[Array, "6 N"]:
    """Weighted covariance about the weighted mean; zero where all weights are zero."""
    total = jnp.sum(weights, axis=0)
    weights = weights / jnp.where(total > 0, total, 1)
    x, y, z = (offset - jnp.sum(weights * offset, axis=0) for offset in offsets)
    pairs = ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))
    return jnp.stack([jnp.sum(weights * p * q, axis=0) for p, q in pairs])


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


def channel_kernel(around: Neighborhoods, covariance: Float[Array, "..."]) -> Float[Array, "k n"]:
    """Channel similarity λ_j of each neighbour and its point: exp(−½ Δᵀ Λ⁻¹ Δ) (Servos & Waslander 2014, eq. 7).

    Where points lack channels, Δ is restricted to the channels that both have, with the marginal of Λ. For each channel
    that a neighbour lacks, λ_j is multiplied by the mean single-channel kernel of the neighbours that have it (1 if
    none has). A factor of 1 would treat the neighbour as similar, and stretch Ω across the border of a camera's view;
    ignoring the neighbour would shrink Ω there. Measured at artificial borders through scans with complete channels,
    this choice leaves Ω the least biased.

    Args:
        covariance: Λ, scalar or (C,) variances or (C, C), channel units².
    """
    count = around.num_channels
    differences = [around.difference(channel) for channel in range(count)]
    matrix = covariance if covariance.ndim == 2 else jnp.diag(jnp.broadcast_to(covariance, (count,)))
    if around.near_known is None:
        return jnp.exp(-0.5 * _marginal_square(differences, None, matrix, covariance.ndim == 2))
    common, others = list(around.near_known), around.other
    differences = [jnp.where(both, each, 0) for each, both in zip(differences, common, strict=True)]
    kernel = jnp.exp(-0.5 * _marginal_square(differences, common, matrix, covariance.ndim == 2))
    for i, both in enumerate(common):
        known = both & others
        number = jnp.sum(known, axis=0)
        alike = jnp.exp(-0.5 * differences[i] ** 2 / matrix[i, i])
        average = jnp.sum(jnp.where(known, alike, 0), axis=0) / jnp.maximum(number, 1)
        kernel = kernel * jnp.where(both, 1, jnp.where(number > 0, average, 1))
    return kernel


def _marginal_square(
    differences: list[Float[Array, "k N"]],
    common: list[Bool[Array, "k N"]] | None,
    covariance: Float[Array, "C C"],
    correlated: bool,
) -> Float[Array, "k N"]:
    """Δᵀ Λ⁻¹ Δ over the common channels: for the others, Λ is replaced by the identity and Δ must be 0.

    Solved by the Cholesky recurrence, unrolled over the channels, so that LAPACK is not called.
    """
    if not correlated:
        squares = [difference * difference / covariance[i, i] for i, difference in enumerate(differences)]
        return sum(squares[1:], start=squares[0])
    root: list[list[Array]] = []
    solution: list[Array] = []
    for i, difference in enumerate(differences):
        row: list[Array] = []
        for j in range(i):
            entry = covariance[i, j] if common is None else jnp.where(common[i] & common[j], covariance[i, j], 0)
            row.append((entry - sum(a * b for a, b in zip(row, root[j], strict=False))) / root[j][j])
        variance = covariance[i, i] if common is None else jnp.where(common[i], covariance[i, i], 1)
        pivot = jnp.sqrt(variance - sum(a * a for a in row))
        solution.append((difference - sum(a * y for a, y in zip(row, solution, strict=True))) / pivot)
        root.append([*row, pivot])
    return sum((y * y for y in solution[1:]), start=solution[0] * solution[0])


def plane_covariance(local: Local, epsilon: Float[Array, ""]) -> Float[Array, "6 N"]:
    """GICP's covariance I − (1−ε) n nᵀ: 1 within the surface, ε along n (Segal et al., Generalized-ICP, RSS 2009).

    It is the identity where all neighbours coincide, so that there is no normal.
    """
    covariance = local.covariance
    spread = covariance[0] + covariance[3] + covariance[5] > 0
    identity = jnp.array([[1.0], [0.0], [0.0], [1.0], [0.0], [1.0]], covariance.dtype)
    return identity - jnp.where(spread, (1 - epsilon) * alg.outer(local.normal), 0)


def multichannel_covariance(
    around: Neighborhoods,
    local: Local,
    kernel: Float[Array, "k N"],
    epsilon: Float[Array, ""],
    min_eigenvalue: Float[Array, ""],
) -> Float[Array, "6 N"]:
    """MC-GICP's covariance: Ω in the tangent plane, ε along the normal (Servos & Waslander 2014, eqs. 6-10).

    Args:
        kernel: λ_j of the neighbours, from `channel_kernel`.
        min_eigenvalue: floor for the eigenvalues of Ω, which approach 0 where no neighbour has similar channels.

    Ω = Σ_w^{-1/2} Σ_t Σ_w^{-1/2} (Σ_t weighted by λ, Σ_w unweighted) is computed as I + Σ_w^{-1/2} (Σ_t − Σ_w)
    Σ_w^{-1/2}, to give GICP's covariance for uniform channels.
    """
    alike = weighted_covariance(_offsets(around), jnp.where(around.present, kernel, 0))
    u, v = alg.orthonormal_basis(local.normal)
    unweighted, weighted = alg.project(local.covariance, u, v), alg.project(alike, u, v)
    trace = unweighted[0] + unweighted[2]
    spread = trace > 0
    scale = 1 / jnp.where(spread, trace, 1)
    regular = unweighted * scale + _REGULARISATION * jnp.array([[1.0], [0.0], [1.0]], alike.dtype)
    regular = jnp.where(spread, regular, jnp.array([[1.0], [0.0], [1.0]], alike.dtype))
    change = alg.sandwich(alg.inverse_square_root(regular), (weighted - unweighted) * scale)
    inside = alg.embed(alg.floor_eigenvalues(change, min_eigenvalue - 1), u, v)
    return plane_covariance(local, epsilon) + inside
