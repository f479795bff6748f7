"""Evidence: how much of a motion each point would feel, by the shape of the surface around it and by its channels.

GICP's in-plane variance of 1 makes every pair hold every direction a little, and nearest neighbours do pull; but when
the pose slides along a plane, so do the matches, and nothing holds it. Evidence leaves such pulls out.
"""

from __future__ import annotations

from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mcgicp_jax import _covariance as cov
from mcgicp_jax._cloud import PointCloud
from mcgicp_jax._methods import AbstractMethod

_ROUGHNESS_RANK = 5


class Evidence(eqx.Module):
    """Symmetric 3×3 matrices K: xᵀ K x is the share, 0 to 1, of a motion along the unit vector x that is felt there.

    Single points may be a little below 0: noise is taken off on average.

    Attributes:
        geometry: (6, N), by the normal: n nᵀ, less what the noise of normals makes of a flat surface.
        channels: (6, N), by the gradient of the channels within the surface; None where a method uses none.
        normal: (3, N) unit vectors.
        roughness: (N,) square of a neighbour's height over the point, across the surface, halved: metres².
        reach: (N,) metres, the distance to the farthest neighbour.
    """

    geometry: Float[Array, "6 N"]
    channels: Float[Array, "6 N"] | None
    normal: Float[Array, "3 N"]
    roughness: Float[Array, "N"]
    reach: Float[Array, "N"]


@jax.jit
def find_evidence(method: AbstractMethod, cloud: PointCloud) -> Evidence:
    """The evidence that a resolved method finds in a preprocessed cloud; constant to autodiff."""
    method, cloud = jax.lax.stop_gradient((method, cloud))
    points = jnp.asarray(cloud.points).T
    offsets, present = cov.gather(points, jnp.asarray(cloud.neighbors))
    count = jnp.maximum(jnp.sum(present, axis=0), 1).astype(points.dtype)
    local = cov.weighted_covariance(offsets, present.astype(points.dtype))
    normal = cov.smallest_eigenvector(local)
    basis = cov.orthonormal_basis(normal)
    # The very nearest lie near because their heights are alike; far ones may be higher because the surface bends.
    rank = min(_ROUGHNESS_RANK, offsets[0].shape[0] - 1)
    smallest = jnp.maximum(jnp.sum(normal * cov.multiply(local, normal), axis=0), 0)
    return Evidence(
        geometry=_geometry(local, normal, smallest, basis, count),
        channels=_channels(method, cloud, offsets, present, basis) if method.uses_channels else None,
        normal=normal,
        roughness=0.5 * sum(offset[rank] * axis for offset, axis in zip(offsets, normal, strict=True)) ** 2,
        reach=jnp.sqrt(jnp.max(sum(offset * offset for offset in offsets), axis=0)),
    )


Basis: TypeAlias = tuple[Float[Array, "3 N"], Float[Array, "3 N"]]


def _geometry(
    local: Float[Array, "6 N"],
    normal: Float[Array, "3 N"],
    smallest: Float[Array, "N"],
    basis: Basis,
    count: Float[Array, "N"],
) -> Float[Array, "6 N"]:
    """n nᵀ without the variance of n.

    The eigenvector of the smallest eigenvalue λ₀ of a sample covariance has the variance λ₀ λ / (k (λ − λ₀)²) towards
    the eigenvector of λ (Anderson 1963): large for a line of points, where the normal may point anywhere across it.
    Saturated, λ₀ λ / (k (λ − λ₀)² + λ₀ λ), it stays a share; and a normal that is little known counts little.
    """
    a, b, c = cov.project(local, *basis)
    scale = 1 / jnp.where(a + c > 0, a + c, 1)
    a, b, c, smallest = a * scale, b * scale, c * scale, smallest * scale
    gap = jnp.stack([a - smallest, b, c - smallest])
    x, y, z = gap
    square = jnp.stack([x * x + y * y, x * y + y * z, y * y + z * z])
    noise = smallest * jnp.stack([a, b, c])
    p, q, r = count * square + noise
    determinant = p * r - q * q
    known = determinant > 64 * jnp.finfo(local.dtype).eps * (p + r) ** 2
    inverse = jnp.stack([r, -q, p]) / jnp.where(known, determinant, 1)
    # Polynomials of one and the same matrix commute, so that their product is symmetric.
    x, y, z = noise
    i, j, k = inverse
    variance = jnp.stack([x * i + y * j, x * j + y * k, y * j + z * k])
    certain = jnp.where(known, jnp.maximum(1 - variance[0] - variance[2], 0), 0)
    return certain * (cov.outer(normal) - _embed(variance, basis))


def _channels(
    method: AbstractMethod, cloud: PointCloud, offsets: cov.Offsets, present: Bool[Array, "k N"], basis: Basis
) -> Float[Array, "6 N"]:
    """What a match in position and α · channel gives way by when its point moves within the surface.

    Where α · channel has the gradients g, the nearest target point to one that has moved by x lies at (I + A)⁻¹ x, with
    A = Σ g gᵀ: the share A (I + A)⁻¹ of the motion is felt. The variance of a fitted gradient is taken off A.
    """
    descriptors = method.descriptors(cloud)
    x, y = (sum(offset * b for offset, b in zip(offsets, axis, strict=True)) for axis in basis)
    rows = jnp.where(present, jnp.asarray(cloud.neighbors).T, 0)
    total = jnp.zeros((3, descriptors.shape[0]), descriptors.dtype)
    noise = total
    for i, descriptor in enumerate(descriptors.T):
        known = present if cloud.channel_valid is None else present & jnp.asarray(cloud.channel_valid)[:, i][rows]
        (gx, gy), variance = _slope(x, y, descriptor[rows], known.astype(x.dtype))
        total = total + jnp.stack([gx * gx, gx * gy, gy * gy])
        noise = noise + variance
    return _embed((total - noise) / (1 + total[0] + total[2]), basis)


def _slope(
    x: Float[Array, "k N"], y: Float[Array, "k N"], values: Float[Array, "k N"], weights: Float[Array, "k N"]
) -> tuple[tuple[Float[Array, "N"], Float[Array, "N"]], Float[Array, "3 N"]]:
    """The gradient of values in the plane, by least squares, and its variance; both 0 where there is no telling."""
    count = jnp.sum(weights, axis=0)

    def centred(values: Float[Array, "k N"]) -> Float[Array, "k N"]:
        return weights * (values - jnp.sum(weights * values, axis=0) / jnp.maximum(count, 1))

    x, y, values = centred(x), centred(y), centred(values)
    xx, xy, yy = jnp.sum(x * x, axis=0), jnp.sum(x * y, axis=0), jnp.sum(y * y, axis=0)
    determinant = xx * yy - xy * xy
    planar = (determinant > 1e-6 * (xx + yy) ** 2) & (count > 3)
    determinant = jnp.where(planar, determinant, 1)
    xc, yc = jnp.sum(x * values, axis=0), jnp.sum(y * values, axis=0)
    gx, gy = (yy * xc - xy * yc) / determinant, (xx * yc - xy * xc) / determinant
    square = jnp.maximum(jnp.sum(values * values, axis=0) - gx * xc - gy * yc, 0) / jnp.maximum(count - 3, 1)
    variance = square / determinant * jnp.stack([yy, -xy, xx])
    return (jnp.where(planar, gx, 0), jnp.where(planar, gy, 0)), jnp.where(planar, variance, 0)


def _embed(symmetric: Float[Array, "3 N"], basis: Basis) -> Float[Array, "6 N"]:
    """B A Bᵀ: a 2×2 matrix of the tangent plane as a 3×3 one."""
    (a, b, c), (u, v) = symmetric, basis
    cross = jnp.stack([2 * u[i] * v[j] if i == j else u[i] * v[j] + u[j] * v[i] for i in range(3) for j in range(i, 3)])
    return a * cov.outer(u) + b * cross + c * cov.outer(v)
