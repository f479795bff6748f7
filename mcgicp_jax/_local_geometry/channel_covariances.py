"""Covariances of neighbourhoods: of their positions, GICP's, and MC-GICP's with its kernel on the channels."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from mcgicp_jax._local_geometry.local_geometry import LocalGeometry, offsets_of, weighted_covariance
from mcgicp_jax._local_geometry.neighborhoods import Neighborhoods
from mcgicp_jax._math import symmetric_matrices as alg

# Added to the diagonal of Σ_w scaled to trace 1, so that it is nonsingular for collinear neighbours. Much larger values
# would bias small eigenvalues of Ω; with this one, rounding in float32 leaves two digits of Ω along a line.
_REGULARISATION = 1e-6


def channel_kernel(around: Neighborhoods, covariance: Float[Array, "..."]) -> Float[Array, "k n"]:
    """Channel similarity λ_j of each neighbour and its point: exp(−½ Δᵀ Λ⁻¹ Δ) (Servos & Waslander 2014, eq. 7).

    `covariance` is Λ, channel units²: scalar, (C,) variances or (C, C). Where points lack channels, Δ is restricted to
    the channels that both have, with the marginal of Λ. For each channel that a neighbour lacks, λ_j is multiplied by
    the mean single-channel kernel of the neighbours that have it (1 if none has). A factor of 1 would stretch Ω across
    the border of a camera's view; ignoring the neighbour would shrink Ω there. At artificial borders through scans with
    complete channels, this choice biased Ω the least.
    """
    count, correlated = around.num_channels, covariance.ndim == 2
    differences = [around.difference(channel) for channel in range(count)]
    matrix = covariance if correlated else jnp.diag(jnp.broadcast_to(covariance, (count,)))
    common = None if around.near_measured is None else list(around.near_measured)
    if common is not None:
        differences = [jnp.where(both, difference, 0) for difference, both in zip(differences, common, strict=True)]
    if not correlated:
        squares = [difference * difference / matrix[i, i] for i, difference in enumerate(differences)]
    else:
        # The Cholesky recurrence, unrolled over the channels, so that LAPACK is not called. For the marginal of Λ, the
        # rows of channels that are not common are replaced by those of the identity.
        root: list[list[Array]] = []
        solution: list[Array] = []
        for i, difference in enumerate(differences):
            row: list[Array] = []
            for j in range(i):
                entry = matrix[i, j] if common is None else jnp.where(common[i] & common[j], matrix[i, j], 0)
                row.append((entry - sum(a * b for a, b in zip(row, root[j], strict=False))) / root[j][j])
            variance = matrix[i, i] if common is None else jnp.where(common[i], matrix[i, i], 1)
            pivot = jnp.sqrt(variance - sum(a * a for a in row))
            solution.append((difference - sum(a * y for a, y in zip(row, solution, strict=True))) / pivot)
            root.append([*row, pivot])
        squares = [y * y for y in solution]
    kernel = jnp.exp(-0.5 * sum(squares[1:], start=squares[0]))
    for i, both in enumerate(common or []):
        others = both & around.other
        number = jnp.sum(others, axis=0)
        similarity = jnp.exp(-0.5 * differences[i] ** 2 / matrix[i, i])
        mean = jnp.sum(jnp.where(others, similarity, 0), axis=0) / jnp.maximum(number, 1)
        kernel = kernel * jnp.where(both, 1, jnp.where(number > 0, mean, 1))
    return kernel


def plane_covariance(local: LocalGeometry, epsilon: Float[Array, ""]) -> Float[Array, "6 N"]:
    """GICP's covariance I − (1−ε) n nᵀ (Segal et al., RSS 2009); the identity where all neighbours coincide."""
    covariance = local.covariance.T
    spread = covariance[0] + covariance[3] + covariance[5] > 0
    identity = jnp.array([[1.0], [0.0], [0.0], [1.0], [0.0], [1.0]], covariance.dtype)
    return identity - jnp.where(spread, (1 - epsilon) * alg.outer(local.normal.T), 0)


def multichannel_covariance(
    around: Neighborhoods,
    local: LocalGeometry,
    kernel: Float[Array, "k N"],
    epsilon: Float[Array, ""],
    min_eigenvalue: Float[Array, ""],
) -> Float[Array, "6 N"]:
    """MC-GICP's covariance: Ω in the tangent plane, ε along the normal (Servos & Waslander 2014, eqs. 6-10).

    To give GICP's covariance for uniform channels, Ω = Σ_w^{-1/2} Σ_t Σ_w^{-1/2} (Σ_t weighted by λ of
    `channel_kernel`, Σ_w unweighted) is computed as I + Σ_w^{-1/2} (Σ_t − Σ_w) Σ_w^{-1/2}.
    """
    weighted_by_kernel = weighted_covariance(offsets_of(around), jnp.where(around.present, kernel, 0))
    u, v = alg.orthonormal_basis(local.normal.T)
    unweighted, weighted = alg.project(local.covariance.T, u, v), alg.project(weighted_by_kernel, u, v)
    trace = unweighted[0] + unweighted[2]
    spread = trace > 0
    scale = 1 / jnp.where(spread, trace, 1)
    identity = jnp.array([[1.0], [0.0], [1.0]], weighted.dtype)
    regular = jnp.where(spread, unweighted * scale + _REGULARISATION * identity, identity)
    change = alg.congruence(alg.inverse_square_root(regular), (weighted - unweighted) * scale)
    inside = alg.embed(alg.floor_eigenvalues(change, min_eigenvalue - 1), u, v)
    return plane_covariance(local, epsilon) + inside
