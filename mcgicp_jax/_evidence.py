"""Evidence: how much of a motion each point would feel, by the shape of the surface around it and by its channels.

GICP's in-plane variance of 1 makes every pair hold every direction a little, and nearest neighbours do pull; but when
the pose slides along a plane, so do the matches, and nothing holds it. Evidence leaves such pulls out.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mcgicp_jax import _covariance as cov
from mcgicp_jax._cloud import PointCloud
from mcgicp_jax._methods import AbstractMethod, Surface, surface

_ROUGHNESS_RANK = 5


class Evidence(eqx.Module):
    """Symmetric 3×3 matrices K: xᵀ K x is the share, 0 to 1, of a motion along the unit vector x that is felt there.

    Single points may be a little below 0: noise is taken off on average.

    Attributes:
        geometry: (6, N), by the normal: n nᵀ, less what the noise of normals makes of a flat surface.
        channels: (6, N), by the gradient of the channels within the surface; None where none are used.
        noise: (N,) variance of all descriptors about their gradients, metres²; 0 where a method uses none.
        normal: (3, N) unit vectors.
        roughness: (N,) square of a neighbour's height over the point, across the surface, halved: metres².
        reach: (N,) metres, the distance to the farthest neighbour.
    """

    geometry: Float[Array, "6 N"]
    channels: Float[Array, "6 N"] | None
    noise: Float[Array, "N"]
    normal: Float[Array, "3 N"]
    roughness: Float[Array, "N"]
    reach: Float[Array, "N"]


@jax.jit
def look(method: AbstractMethod, cloud: PointCloud) -> tuple[Surface, Evidence]:
    """The surface and the evidence that a resolved method finds in a preprocessed cloud.

    Both look at the same neighbourhoods. Evidence is constant to autodiff.
    """
    covariance, find = method.covariance_around(cloud), _evidence_of(*jax.lax.stop_gradient((method, cloud)))

    def both(around: cov.Neighborhoods) -> tuple[Float[Array, "6 n"], Evidence]:
        return covariance(around), find(jax.lax.stop_gradient(around))

    covariances, evidence = cov.by_neighborhoods(both, jnp.asarray(cloud.points).T, jnp.asarray(cloud.neighbors))
    return surface(method, cloud, covariances), evidence


def _evidence_of(method: AbstractMethod, cloud: PointCloud) -> Callable[[cov.Neighborhoods], Evidence]:
    descriptors = method.descriptors(cloud) if method.uses_channels and cloud.channels.shape[-1] else None
    channel_valid = None if cloud.channel_valid is None else jnp.asarray(cloud.channel_valid)

    def find(around: cov.Neighborhoods) -> Evidence:
        offsets, local, normal = around.offsets, around.covariance, around.normal
        count = jnp.maximum(jnp.sum(around.present, axis=0), 1).astype(normal.dtype)
        basis = cov.orthonormal_basis(normal)
        # The very nearest lie near because their heights are alike; far ones may be higher because the surface bends.
        rank = min(_ROUGHNESS_RANK, offsets[0].shape[0] - 1)
        smallest = jnp.maximum(jnp.sum(normal * cov.multiply(local, normal), axis=0), 0)
        channels, noise = None, jnp.zeros_like(smallest)
        if descriptors is not None:
            channels, noise = _channels(descriptors, channel_valid, around, basis)
        return Evidence(
            geometry=_geometry(local, normal, smallest, basis, count),
            channels=channels,
            noise=noise,
            normal=normal,
            roughness=0.5 * sum(offset[rank] * axis for offset, axis in zip(offsets, normal, strict=True)) ** 2,
            reach=jnp.sqrt(jnp.max(sum(offset * offset for offset in offsets), axis=0)),
        )

    return find


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
    return certain * (cov.outer(normal) - cov.embed(variance, *basis))


def _channels(
    descriptors: Float[Array, "M C"],
    channel_valid: Bool[Array, "M C"] | None,
    around: cov.Neighborhoods,
    basis: Basis,
) -> tuple[Float[Array, "6 N"], Float[Array, "N"]]:
    """What a match in position and α · channel gives way by when its point moves within the surface.

    Where α · channel has the gradients g, the nearest target point to one that has moved by x lies at (I + A)⁻¹ x, with
    A = Σ g gᵀ: the share A (I + A)⁻¹ of the motion is felt; written A / (1 + tr A), which is the same for one gradient,
    and less for several. The variance of a fitted gradient is taken off A. The second answer is the variance of the
    descriptors about their gradients.
    """
    present, near = around.present, jnp.where(around.present, around.neighbors.T, 0)
    x, y = (sum(offset * b for offset, b in zip(around.offsets, axis, strict=True)) for axis in basis)
    total = jnp.zeros((3, around.rows.size), descriptors.dtype)
    uncertain = total
    noise = total[0]
    for i, descriptor in enumerate(descriptors.T):
        known = present if channel_valid is None else present & channel_valid[:, i][near]
        fit = cov.fit_linear(x, y, descriptor[near], known.astype(x.dtype))
        gx, gy = fit.gradient
        told = fit.weight > 3 if channel_valid is None else (fit.weight > 3) & channel_valid[:, i][around.rows]
        total = total + jnp.where(told, jnp.stack([gx * gx, gx * gy, gy * gy]), 0)
        uncertain = uncertain + jnp.where(told, fit.residual * fit.inverse, 0)
        noise = noise + jnp.where(told, fit.residual, 0)
    return cov.embed((total - uncertain) / (1 + total[0] + total[2]), *basis), noise
