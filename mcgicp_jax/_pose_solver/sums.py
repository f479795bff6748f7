"""Sums over correspondences, the only input of a pose update that depends on the points.

With the residual d = b − T a and the robust weight w, each correspondence has a force f = w M d (3), a stiffness
K = w M (3×3) and a cost. About a centre c, with p = T a − c and h = (p, 1), the sums are G = Σ f hᵀ (12 numbers),
Q = Σ K ⊗ h hᵀ (60) and e = Σ dᵀ f. With the observability O of each correspondence (3×3, see
`_local_geometry.observability`), Σ w O ⊗ h hᵀ is added.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._pose_solver.matched import Matched, Motion, linearize_at
from mcgicp_jax._terms.base import AbstractTerm, PosedMatches, channel_observability

_UPPER = np.triu_indices(4)
# Fields of `Sums` that are sums over h hᵀ.
_SECOND_MOMENTS = ("stiffness", "mass", "observability", "channel_observability")


class Sums(NamedTuple):
    """Sums over correspondences, see the module. The centre c is the centroid of the moved, matched source points.

    Taken about this centre and at the current pose, the sums remain precise in float32. Symmetric matrices are stored
    as upper triangles: 6 entries of 3×3, 10 of h hᵀ.

    Attributes:
        center: c, metres.
        count: number of correspondences; every candidate counts.
        square_extent: Σ |p|², metres².
        energy: e.
        cost: Σ ρ.
        square_distance: Σ |d|² of the mean over the candidates of a source point, metres².
        num_matched: number of source points with a match.
        force: G.
        stiffness: Q.
        mass: Σ w h hᵀ; None where observability is not known.
        observability: Σ w O ⊗ h hᵀ by the shape of the surfaces; None where it is not known.
        channel_observability: the same by the channels; None also where they are not used.
    """

    center: Float[AnyArray, "*batch 3"]
    count: Float[AnyArray, "*batch"]
    square_extent: Float[AnyArray, "*batch"]
    energy: Float[AnyArray, "*batch"]
    cost: Float[AnyArray, "*batch"]
    square_distance: Float[AnyArray, "*batch"]
    num_matched: Float[AnyArray, "*batch"]
    force: Float[AnyArray, "*batch 3 4"]
    stiffness: Float[AnyArray, "*batch 6 10"]
    mass: Float[AnyArray, "*batch 10"] | None = None
    observability: Float[AnyArray, "*batch 6 10"] | None = None
    channel_observability: Float[AnyArray, "*batch 6 10"] | None = None

    @property
    def radius(self) -> Float[AnyScalar, ""]:
        """Root mean square distance of the moved, matched points from the centre, metres; 1 if it is 0."""
        square = self.square_extent / jnp.maximum(self.count, 1)
        return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 1)

    @property
    def num_inliers(self) -> Int[Array, ""]:
        """Number of source points with a match; exact in float32 up to 2²⁴."""
        return self.num_matched.astype(jnp.int32)

    @property
    def rmse(self) -> Float[AnyScalar, ""]:
        """Root mean square correspondence distance, metres; NaN without matches."""
        return jnp.sqrt(self.square_distance / self.num_matched)


def sums_of(motion: Motion, matched: Matched, terms: tuple[AbstractTerm, ...]) -> Sums:
    """Compute the sums at a pose in one pass over the correspondences, the only part of a step that touches points."""
    posed, found, counts = linearize_at(motion, matched, terms)
    moved = posed.moved
    mask = jnp.asarray(matched.valid).astype(moved.dtype)
    count = jnp.sum(mask)
    center = jnp.sum(mask * moved, axis=1) / jnp.maximum(count, 1)
    p = mask * (moved - center[:, None])
    h = jnp.concatenate([p, jnp.ones_like(p[:1])])
    shown = mean_observability(posed, terms)
    # One product for all sums over h hᵀ.
    rows = [found.stiffness]
    if shown:
        rows += [found.weight[None], *(found.weight * each for each in shown)]
    sums = jnp.dot(jnp.concatenate(rows), powers(p).T, precision="highest")
    stiffness, *others = jnp.split(sums, np.cumsum([len(row) for row in rows])[:-1])
    num_matched = jnp.sum(jnp.any(jnp.asarray(matched.valid).reshape(matched.num_candidates, -1), axis=0))
    square = alg.inner(found.residual, found.residual)
    return Sums(
        center=center,
        count=count,
        square_extent=jnp.sum(p * p),
        energy=jnp.sum(found.residual * found.force),
        cost=jnp.sum(found.cost),
        square_distance=jnp.sum(_share(counts, matched.num_candidates) * square),
        num_matched=num_matched.astype(moved.dtype),
        force=jnp.dot(found.force, h.T, precision="highest"),
        stiffness=stiffness,
        mass=others[0][0] if shown else None,
        observability=others[1] if shown else None,
        channel_observability=others[2] if len(shown) > 1 else None,
    )


def _share(counts: Float[Array, "n"], num_candidates: int) -> Float[Array, "n"]:
    """The weights of the candidates of each source point, divided by their sum; 0 for points without any."""
    each = counts.reshape(num_candidates, -1)
    total = jnp.sum(each, axis=0)
    return (each / jnp.where(total > 0, total, 1)).reshape(-1)


def mean_observability(posed: PosedMatches, terms: tuple[AbstractTerm, ...]) -> list[Float[Array, "6 n"]]:
    """O per correspondence, in the target's frame: mean over its two points; by shape, then by channels if known."""
    source, target, rotation = posed.source, posed.target, posed.rotation
    if source.observability is None or target.observability is None:
        return []
    found = [0.5 * (alg.rotate(rotation, source.observability.T) + target.observability.T)]
    if source.channel_observability is not None and target.channel_observability is not None:
        mean = 0.5 * (alg.rotate(rotation, source.channel_observability.T) + target.channel_observability.T)
        found.append(channel_observability(terms, mean, posed))
    return found


def powers(p: Float[Array, "3 N"]) -> Float[Array, "10 N"]:
    """The upper triangle of h hᵀ with h = (p, 1)."""
    x, y, z = p
    return jnp.stack([x * x, x * y, x * z, x, y * y, y * z, y, z * z, z, jnp.ones_like(x)])


def combine(parts: Sums) -> Sums:
    """Add the sums of blocks, stacked along the first axis, after moving them to the common centroid. NumPy, float64.

    The blocks are added in their order, so that the result does not depend on the number of threads.
    """
    # Non-finite values propagate into the status NON_FINITE; NumPy need not warn of them.
    with np.errstate(invalid="ignore", over="ignore"):
        center = parts.count @ parts.center / max(parts.count.sum(), 1)
        parts = _about(center, parts)
        added = {name: None if each is None else each.sum(axis=0) for name, each in parts._asdict().items()}
        return Sums(**added | {"center": center})


def _about(center: Float[np.ndarray, "3"], parts: Sums) -> Sums:
    """The sums of blocks about another centre."""
    offset = parts.center - center
    shift = np.tile(np.eye(4), (len(offset), 1, 1))
    shift[:, :3, 3] = offset

    # All sums over h hᵀ at once.
    names = [name for name in _SECOND_MOMENTS if getattr(parts, name) is not None]
    rows = [getattr(parts, name).reshape(len(offset), -1, 10) for name in names]
    sums = np.concatenate(rows, axis=1)
    full = np.empty((*sums.shape[:2], 4, 4))
    full[..., _UPPER[0], _UPPER[1]] = full[..., _UPPER[1], _UPPER[0]] = sums
    full = shift[:, None] @ full @ shift[:, None].swapaxes(-1, -2)
    moved = np.split(full[..., _UPPER[0], _UPPER[1]], np.cumsum([each.shape[1] for each in rows])[:-1], axis=1)
    shaped = {name: each.reshape(getattr(parts, name).shape) for name, each in zip(names, moved, strict=True)}
    return parts._replace(
        square_extent=parts.square_extent + parts.count * np.einsum("bi,bi->b", offset, offset),
        force=np.einsum("bij,bkj->bik", parts.force, shift),
        **shaped,
    )
