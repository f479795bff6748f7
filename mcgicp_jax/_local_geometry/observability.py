"""Observability: per-point evidence of which motions are constrained, from surface shape and from channels.

With GICP's in-plane variance of 1, every correspondence constrains every direction a little. But when the pose slides
along a plane, the matches slide with it, and the plane constrains nothing in that direction. Observability excludes
this apparent information. It is a symmetric 3×3 matrix O per point: of a motion of the point along the unit vector x,
xᵀ O x is the fraction, 0 to 1, that changes the residual instead of the match. The expected contribution of noise is
subtracted, so values of single points may be slightly negative.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mcgicp_jax._compute.concrete import AnyArray
from mcgicp_jax._local_geometry.neighborhoods import ChannelFits
from mcgicp_jax._math import symmetric_matrices as alg

# Fraction of the variance of a fitted gradient that is subtracted from the product of both halves, because the mean
# over few points scatters. Channels of pure noise constrained a direction of 6 of 140 walls (400, 2,000 and 12,000
# points); with 0, of 80.
_MARGIN = 0.2

# κ of `observability_of_halves`: 1/16 makes normals that are nearly right unbiased, 5/16 those of random directions.
# The value between was measured on corridors, planes and a street, see Constants in `tests/benchmarks/README.md`.
_NOISE = 0.22
# The neighbourhood of a scan line that bends, as where wall and floor meet, has a plane across a smooth tunnel, which
# would constrain the pose along it. Such a neighbourhood is thick (third extent over the second) and narrow (second
# over first), but no line. Each pair is a ramp: a half has the weight 0 at the first value and 1 at the second, and the
# largest of the three weights counts. Of 18 tunnels (16 beams, voxels of 0.1 to 0.3 m) 11 were CONVERGED, six of them
# wrong, with shares up to 0.0044; of 52 now four, two of them wrong, with up to 0.0027. Rooms, garages, corridors,
# halls and streets have at least 0.0041. Noise makes thick neighbourhoods, too, but they are as wide as long.
_THICK, _LINE, _NARROW = (0.45, 0.3), (0.25, 0.15), (0.45, 0.65)


def geometry_observability(
    covariance: Float[Array, "6 N"], normal: Float[Array, "3 N"], count: Float[Array, "N"]
) -> Float[Array, "6 N"]:
    """Observability from one normal n: (n nᵀ − V) (1 − tr V), with the covariance V of n.

    `covariance` is that of `count` neighbours about their mean, metres², and n its eigenvector of the smallest
    eigenvalue.
    """
    certain, variance, _ = _certainty(covariance, normal, count)
    return certain * (alg.outer(normal) - variance)


def observability_of_halves(
    covariances: Float[Array, "6 M"], normals: Float[Array, "3 M"], counts: Float[Array, "M"], usable: Bool[Array, "L"]
) -> Float[Array, "6 N"]:
    """Observability from the normals n₁ and n₂ of two halves of the neighbours, whose noise is independent.

    With the projectors Pᵢ = nᵢ nᵢᵀ, the noise in (P₁ P₂ + P₂ P₁) / 2 is the square of that in each of them. It is
    estimated by κ sin²φ (P₁ − P₂)², where φ is the angle between the normals, and subtracted. The rest is multiplied by
    the certainties of both normals, which are also independent: the certainty of the normal of all neighbours would be
    larger where both halves deviate alike. Halves that may be bent scan lines count less or not at all (`_THICK`).
    Where a half is not usable: `geometry_observability` of all neighbours.

    Covariances, normals and counts are as in `geometry_observability`, of all neighbours, of the first and of the
    second halves (M = 3 N); `usable` says of which halves the normals may be used (L = 2 N).
    """
    certain, variance, ratios = _certainty(covariances, normals, counts)
    (normal, first, second), size = jnp.split(normals, 3, axis=1), usable.size // 2
    whole = certain[:size] * (alg.outer(normal) - variance[:, :size])
    thickness, width = ratios[:, size:]
    ramps = ((thickness, _THICK), (width, _LINE), (width, _NARROW))
    weights = [jnp.clip((ratio - zero) / (one - zero), 0, 1) for ratio, (zero, one) in ramps]
    certain = certain[size:] * jnp.max(jnp.stack(weights), axis=0)
    # In terms of n₁ + n₂ and n₁ − n₂, which are orthogonal; the signs of the normals do not matter.
    cosine = jnp.sum(first * second, axis=0)
    by_sum, by_difference = (
        0.25 * sign * cosine - 0.5 * _NOISE * (1 - cosine * cosine) * (1 - sign * cosine) for sign in (1, -1)
    )
    split = by_sum * alg.outer(first + second) + by_difference * alg.outer(first - second)
    both = jnp.all(usable.reshape(2, -1), axis=0)
    return jnp.where(both, certain[:size] * certain[size:] * split, whole)


def _certainty(
    covariance: Float[Array, "6 N"], normal: Float[Array, "3 N"], count: Float[Array, "N"]
) -> tuple[Float[Array, "N"], Float[Array, "6 N"], Float[Array, "2 N"]]:
    """1 − tr V, at least 0, the covariance V of an estimated normal, and the ratios of the third extent of the points
    to the second, and of the second to the first.

    The eigenvector of the smallest eigenvalue λ₀ of a sample covariance of k points has the variance
    λ₀ λ / (k (λ − λ₀)²) towards the eigenvector of λ (Anderson 1963). It is large for points on a line, whose normal is
    undetermined. The saturated form λ₀ λ / (k (λ − λ₀)² + λ₀ λ), used here, is at most 1.
    """
    basis = alg.orthonormal_basis(normal)
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
    regular = determinant > 64 * jnp.finfo(covariance.dtype).eps * (p + r) ** 2
    inverse = jnp.stack([r, -q, p]) / jnp.where(regular, determinant, 1)
    # Both factors are polynomials of the same matrix: they commute, and their product is symmetric.
    x, y, z = noise
    i, j, k = inverse
    variance = jnp.stack([x * i + y * j, x * j + y * k, y * j + z * k])
    certain = jnp.where(regular, jnp.maximum(1 - variance[0] - variance[2], 0), 0)
    # The smaller eigenvalue within the tangent plane, where a + c = 1.
    second = 0.5 - jnp.sqrt(jnp.maximum(0.25 - (a * c - b * b), 0))
    ratios = jnp.sqrt(jnp.stack([smallest / jnp.where(second > 0, second, 1), second / (1 - second)]))
    return certain, alg.embed(variance, *basis), ratios


def channel_observability(
    fits: ChannelFits, normal: Float[AnyArray, "N 3"], weights: Float[Array, "C"]
) -> tuple[Float[Array, "6 N"], Float[Array, "N C 3"], Float[Array, "N"]]:
    """Observability of motions within the surface, from the gradients g of the descriptors α · channel.

    If a point moves by x within the surface, its nearest target point in position and descriptors moves by (I + A)⁻¹ x,
    with A = Σ g gᵀ, and the residual changes by the rest, A (I + A)⁻¹ x. A / (1 + tr A) is used instead, which is equal
    for one channel and smaller for several. A is the mean of g hᵀ and h gᵀ, where g and h are fitted to different
    neighbours: their noise is independent and contributes nothing on average. (Subtracting the variance of one fit from
    its square would also subtract the misfit at sharp edges: on a wall of posters, the sum along a direction that was
    known to a millimetre was negative.) Each half needs three neighbours; with fewer, the observability is 0.

    `weights` are α, metres per channel unit. Also returned are the gradients of the descriptors, means of both fits,
    and the variance of the descriptors about their linear fits, metres², summed over the channels.
    """
    (gx, gy), (hx, hy) = fits.gradients.transpose(2, 3, 1, 0)
    square = (weights * weights)[:, None]
    residual = square * jnp.where(jnp.isnan(fits.residual), 0, fits.residual).T
    product = square * jnp.stack([gx * hx, 0.5 * (gx * hy + gy * hx), gy * hy])
    total = jnp.sum(product - _MARGIN * residual * fits.inverse.transpose(2, 1, 0), axis=1)
    length = jnp.sum(0.5 * square * (gx * gx + gy * gy + hx * hx + hy * hy), axis=0)
    # The same tangent basis as in the linear fits.
    basis = alg.orthonormal_basis(normal.T)
    slopes = jnp.mean(fits.gradients, axis=2) * weights[:, None]
    within = slopes[..., :1] * basis[0].T[:, None] + slopes[..., 1:] * basis[1].T[:, None]
    return alg.embed(total / (1 + length), *basis), within, jnp.sum(residual, axis=0)


def agreement(
    source: Float[Array, "C 3 n"], target: Float[Array, "C 3 n"], tangent: Float[Array, "3 n"]
) -> tuple[Float[Array, "6 n"], Float[Array, "6 n"]]:
    """Observability by the channels of matched points, A / (1 + tr A), where A is the mean of g hᵀ and h gᵀ; and the
    surplus of gradients across the lines of sight.

    g and h are the gradients of the descriptors in the two clouds, in one frame. At a wrong pose they are unrelated,
    however distinct the channels of each cloud are, so that A vanishes on average, unless the sensor carries a pattern
    along: then the gradients agree where it has not moved. Such a pattern (of beams, ranges, angles of incidence) has
    gradients along the lines of sight, a texture in all directions. With the unit tangent t across the line of sight
    (0 where unknown), the surplus is ((t·g) (t·h) − g·h / 4) t tᵀ / (1 + tr A): g·h / 4 > 0 on average over all
    directions of the gradients, and negative for the pattern. A texture as strong as the pattern hides it, even if its
    gradients lie across the motion.
    """
    product = alg.symmetric_outer(source, target)
    scale = 1 / (1 + 0.5 * (jnp.sum(source * source, axis=(0, 1)) + jnp.sum(target * target, axis=(0, 1))))
    across = alg.inner(tangent, alg.multiply(product, tangent))
    quarter = 0.25 * jnp.sum(source * target, axis=(0, 1))
    return scale * product, scale * (across - quarter) * alg.outer(tangent)
