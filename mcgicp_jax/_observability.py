"""Observability: which motions of a point would show, by the shape of the surface around it and by its channels.

GICP's in-plane variance of 1 makes every correspondence constrain every direction a little, and nearest neighbours do
pull; but when the pose slides along a plane, so do the matches, and nothing constrains it. Observability leaves such
pulls out. It is a symmetric 3×3 matrix K for each point: xᵀ K x is the fraction, 0 to 1, of a motion along the unit
vector x that shows. Single points may be a little below 0: noise is taken off on average.
"""

from __future__ import annotations

from typing import TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float

from mcgicp_jax import _algebra as alg
from mcgicp_jax._surface import Local

Basis: TypeAlias = tuple[Float[Array, "3 N"], Float[Array, "3 N"]]


def geometry_observability(
    covariance: Float[Array, "6 N"], normal: Float[Array, "3 N"], basis: Basis, count: Float[Array, "N"]
) -> Float[Array, "6 N"]:
    """n nᵀ less the variance of n.

    The eigenvector of the smallest eigenvalue λ₀ of a sample covariance has the variance λ₀ λ / (k (λ − λ₀)²) towards
    the eigenvector of λ (Anderson 1963): large for a line of points, where the normal may point anywhere across it.
    Saturated, λ₀ λ / (k (λ − λ₀)² + λ₀ λ), it stays a fraction; and a normal that is poorly known counts little.

    Args:
        covariance: of the neighbours about their mean, metres².
        count: k, the number of neighbours.
    """
    smallest = jnp.maximum(jnp.sum(normal * alg.multiply(covariance, normal), axis=0), 0)
    a, b, c = alg.project(covariance, *basis)
    scale = 1 / jnp.where(a + c > 0, a + c, 1)
    a, b, c, smallest = a * scale, b * scale, c * scale, smallest * scale
    gap = jnp.stack([a - smallest, b, c - smallest])
    x, y, z = gap
    square = jnp.stack([x * x + y * y, x * y + y * z, y * y + z * z])
    noise = smallest * jnp.stack([a, b, c])
    p, q, r = count * square + noise
    determinant = p * r - q * q
    known = determinant > 64 * jnp.finfo(covariance.dtype).eps * (p + r) ** 2
    inverse = jnp.stack([r, -q, p]) / jnp.where(known, determinant, 1)
    # Polynomials of one and the same matrix commute, so that their product is symmetric.
    x, y, z = noise
    i, j, k = inverse
    variance = jnp.stack([x * i + y * j, x * j + y * k, y * j + z * k])
    certain = jnp.where(known, jnp.maximum(1 - variance[0] - variance[2], 0), 0)
    return certain * (alg.outer(normal) - alg.embed(variance, *basis))


def channel_observability(local: Local, weights: Float[Array, "C"]) -> tuple[Float[Array, "6 N"], Float[Array, "N"]]:
    """How far a match in position and α · channel gives way when its point moves within the surface.

    Where α · channel has the gradients g, the nearest target point to one that has moved by x lies at (I + A)⁻¹ x, with
    A = Σ g gᵀ: the fraction A (I + A)⁻¹ of the motion shows; written A / (1 + tr A), which is the same for one
    gradient, and less for several. The variance of a fitted gradient is taken off A.

    Args:
        weights: α, metres per channel unit.

    Returns:
        Symmetric matrices, and the variance of the descriptors about their linear fits, metres².
    """
    total = jnp.zeros((3, local.observed.shape[0]), local.observed.dtype)
    uncertain, noise = total, total[0]
    for channel in range(local.num_channels):
        gx, gy, residual, *inverse = local.fit(channel)
        square = weights[channel] ** 2
        residual = square * jnp.where(jnp.isnan(residual), 0, residual)
        total = total + square * jnp.stack([gx * gx, gx * gy, gy * gy])
        uncertain = uncertain + residual * jnp.stack(inverse)
        noise = noise + residual
    # The tangent basis of the fits.
    basis = alg.orthonormal_basis(local.normal)
    return alg.embed((total - uncertain) / (1 + total[0] + total[2]), *basis), noise
