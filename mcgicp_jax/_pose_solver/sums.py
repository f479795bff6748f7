"""Sums over correspondences: a pose update needs nothing else of the points.

With the residual d = b − T a and the robust weight w, each correspondence has a force f = w M d (3), a stiffness
K = w M (3×3) and a cost. About a centre c, with p = T a − c and h = (p, 1), the sums are G = Σ f hᵀ (12 numbers),
Q = Σ K ⊗ h hᵀ (60) and e = Σ dᵀ f. Observability O (3×3 per correspondence, see `_observability`) adds Σ w O ⊗ h hᵀ.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar
from mcgicp_jax._local_geometry.records import Surface, Table, gathered, observability_of, points_of
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._math.statistics import sampled_rows
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._search.base import Correspondences, SearchPoints
from mcgicp_jax._terms.base import Forces
from mcgicp_jax._terms.photometric import Term

_UPPER = np.triu_indices(4)


class Matched(eqx.Module):
    """Gathered table rows of both sides of n correspondences; n = m N for m candidates of N source points.

    Attributes:
        source, target: (n, L) rows of the surfaces' tables; the first candidates of all source points come first.
        valid: (n,) False for correspondences to ignore.
        apart: (n,) squared distance of the descriptors α · channel, metres²; only for soft assignment.
        temperature: of the soft assignment, metres; None otherwise.
        num_candidates: m.
    """

    source: Table
    target: Table
    valid: Bool[AnyArray, "n"]
    apart: Float[AnyArray, "n"] | None = None
    temperature: Float[AnyScalar, ""] | None = None
    num_candidates: int = eqx.field(static=True, default=1)


def matched_rows(
    source: Surface, target: Surface, matches: Correspondences, temperature: Float[Array, ""] | None = None
) -> Matched:
    """Gather the source and target rows of the matches; pure JAX."""
    candidates = jnp.asarray(matches.indices).reshape(-1, source.rows.valid.size)
    indices, valid = candidates.reshape(-1), jnp.asarray(matches.valid).reshape(-1)
    tiled = (
        source if len(candidates) == 1 else jax.tree.map(lambda rows: jnp.concatenate([rows] * len(candidates)), source)
    )
    apart = None if temperature is None else _square_apart(tiled.rows, target.rows, indices)
    tables = jax.tree.map(jnp.asarray, (tiled.table, target.table))
    return Matched(tables[0], gathered(tables[1], indices), valid, apart, temperature, len(candidates))


def _square_apart(source: SearchPoints, target: SearchPoints, indices: Int[Array, "n"]) -> Float[Array, "n"]:
    square = (jnp.asarray(source.descriptors) - jnp.asarray(target.descriptors)[indices]) ** 2
    penalties = (source.penalty, None if target.penalty is None else jnp.asarray(target.penalty)[indices])
    for penalty in penalties:
        if penalty is not None:
            square = jnp.where(penalty > 0, penalty, square)
    return jnp.sum(square, axis=1)


def move_rows(rotation: Float[Array, "3 3"], translation: Float[Array, "3"], table: Table) -> Float[Array, "3 n"]:
    """T a for each row of a surface's table."""
    return jnp.dot(rotation, points_of(table), precision="highest") + translation[:, None]


def within(
    moved: Float[Array, "3 n"], target: Table, found: Bool[AnyArray, "n"], max_distance: Float[Array, ""]
) -> tuple[Bool[Array, "n"], Float[Array, "n"]]:
    """Which matches lie within `max_distance`, and the distance of each, both in metres of position: channels affect
    which match is found, but not whether it is accepted."""
    apart = points_of(target) - moved
    distances = jnp.sqrt(alg.inner(apart, apart))
    return found & (distances <= max_distance), distances


def estimates_at(
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    matched: Matched,
    valid: Bool[AnyArray, "N"],
    term: Term | None,
) -> Term | None:
    """`AbstractMethod.estimates` from the residuals at a pose; constant to autodiff, and None if there are none.

    Args:
        valid: which source points are no padding.
    """
    if term is None:
        return None
    rows, counts = sampled_rows(valid)
    source, target = gathered(matched.source, rows), gathered(matched.target, rows)
    evidence = term.evidence(
        source, target, move_rows(rotation, translation, source), rotation, jnp.asarray(matched.valid)[rows]
    )
    return jax.lax.stop_gradient(term.estimated(evidence, counts, valid))


def forces_at(
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    matched: Matched,
    method: AbstractMethod,
    robust: AbstractKernel | None,
) -> tuple[Float[Array, "3 n"], Forces, Float[Array, "n"]]:
    """T a, the forces at a pose, and the soft-assignment weights (1 for valid and 0 for invalid hard matches)."""
    moved = move_rows(rotation, translation, matched.source)
    forces = method.forces(matched.source, matched.target, moved, rotation, matched.valid, robust)
    counts = jnp.asarray(matched.valid).astype(moved.dtype)
    if matched.temperature is not None and matched.apart is not None:
        far = alg.inner(forces.residual, forces.residual) + matched.apart
        shape = (matched.num_candidates, -1)
        counts = _softmax((-0.5 * far / matched.temperature**2).reshape(shape), matched.valid.reshape(shape))
    return moved, forces.scaled(counts), counts


def _softmax(logits: Float[Array, "m N"], valid: Bool[Array, "m N"]) -> Float[Array, "n"]:
    """Softmax over the valid candidates of each source point; 0 for source points without any."""
    highest = jax.lax.stop_gradient(jnp.max(jnp.where(valid, logits, -jnp.inf), axis=0))
    shifted = jnp.where(valid, logits - jnp.where(jnp.isfinite(highest), highest, 0), 0)
    exponentials = jnp.where(valid, jnp.exp(shifted), 0)
    total = jnp.sum(exponentials, axis=0)
    return (exponentials / jnp.where(total > 0, total, 1)).reshape(-1)


class Sums(NamedTuple):
    """Sums over correspondences, see the module. The centre c is the centroid of the moved, matched source points.

    Taken about this centre and at the current pose, the sums remain precise in float32.

    Attributes:
        center: (3,) c, metres.
        totals: (6,) number of correspondences, Σ |p|², e, Σ cost, Σ |d|² (of the mean over the candidates of a source
            point), number of source points with a match.
        first: (3, 4) G.
        second: (6, 10), (13, 10) or (19, 10): Q; where observability is known, followed by Σ w h hᵀ and by
            Σ w O ⊗ h hᵀ for the geometry and, if used, the channels. Symmetric factors are stored as upper triangles.
    """

    center: Float[AnyArray, "*batch 3"]
    totals: Float[AnyArray, "*batch 6"]
    first: Float[AnyArray, "*batch 3 4"]
    second: Float[AnyArray, "*batch M 10"]

    @property
    def radius(self) -> Float[AnyScalar, ""]:
        """Root mean square distance of the moved, matched points from the centre, metres; 1 if it is 0."""
        square = self.totals[1] / jnp.maximum(self.totals[0], 1)
        return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 1)

    @property
    def constant(self) -> Float[AnyScalar, ""]:
        """e."""
        return self.totals[2]

    @property
    def cost(self) -> Float[AnyScalar, ""]:
        return self.totals[3]

    @property
    def num_inliers(self) -> Int[Array, ""]:
        """Number of source points with a match; exact in float32 up to 2²⁴."""
        return self.totals[5].astype(jnp.int32)

    @property
    def rmse(self) -> Float[AnyScalar, ""]:
        """Root mean square correspondence distance, metres; NaN without matches."""
        return jnp.sqrt(self.totals[4] / self.totals[5])

    @property
    def stiffness(self) -> Float[AnyArray, "6 10"]:
        """Q."""
        return self.second[:6]

    @property
    def mass(self) -> Float[AnyArray, "10"]:
        return self.second[6]

    @property
    def observability(self) -> list[Float[AnyArray, "6 10"]]:
        """Σ w O ⊗ h hᵀ for the geometry and for the channels, or as many of these as are known."""
        return [self.second[start : start + 6] for start in range(7, self.second.shape[0], 6)]


def sums_of(
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    matched: Matched,
    method: AbstractMethod,
    robust: AbstractKernel | None,
) -> Sums:
    """Compute the sums at a pose in one pass over the correspondences, the only part of a step that touches points."""
    moved, forces, counts = forces_at(rotation, translation, matched, method, robust)
    mask = jnp.asarray(matched.valid).astype(moved.dtype)
    count = jnp.sum(mask)
    center = jnp.sum(mask * moved, axis=1) / jnp.maximum(count, 1)
    p = mask * (moved - center[:, None])
    h = jnp.concatenate([p, jnp.ones_like(p[:1])])
    rows = [forces.stiffness]
    if observability_of(matched.source):
        rows.append(forces.weight[None])
        rows += [forces.weight * mean for mean in mean_observability(rotation, matched, method)]
    num_inliers = jnp.sum(jnp.any(jnp.asarray(matched.valid).reshape(matched.num_candidates, -1), axis=0))
    totals = (
        count,
        jnp.sum(p * p),
        jnp.sum(forces.residual * forces.force),
        jnp.sum(forces.cost),
        jnp.sum(_share(counts, matched.num_candidates) * alg.inner(forces.residual, forces.residual)),
        num_inliers.astype(moved.dtype),
    )
    return Sums(
        center=center,
        totals=jnp.stack(totals),
        first=jnp.dot(forces.force, h.T, precision="highest"),
        second=jnp.dot(jnp.concatenate(rows), powers(p).T, precision="highest"),
    )


def _share(counts: Float[Array, "n"], num_candidates: int) -> Float[Array, "n"]:
    """The weights of the candidates of each source point, divided by their sum; 0 for points without any."""
    each = counts.reshape(num_candidates, -1)
    total = jnp.sum(each, axis=0)
    return (each / jnp.where(total > 0, total, 1)).reshape(-1)


def mean_observability(
    rotation: Float[Array, "3 3"], matched: Matched, method: AbstractMethod
) -> list[Float[Array, "6 n"]]:
    """O per correspondence, in the target's frame: mean over its two points; of the geometry, then of the channels."""
    sides = zip(observability_of(matched.source), observability_of(matched.target), strict=True)
    geometry, *channels = [0.5 * (alg.rotate(rotation, source) + target) for source, target in sides]
    matches = matched.source, matched.target, rotation
    return [geometry, *(method.channel_observability(mean, *matches) for mean in channels)]


def powers(p: Float[Array, "3 N"]) -> Float[Array, "10 N"]:
    """The upper triangle of h hᵀ with h = (p, 1)."""
    x, y, z = p
    return jnp.stack([x * x, x * y, x * z, x, y * y, y * z, y, z * z, z, jnp.ones_like(x)])


def combine(parts: Sequence[Sums], dtype: Any) -> Sums:
    """Add the sums of blocks, in float64 and in block order, after moving them to the common centroid. NumPy."""
    centers, totals, first, second = (
        np.stack([np.asarray(getattr(part, name), np.float64) for part in parts])
        for name in ("center", "totals", "first", "second")
    )
    # Non-finite values propagate into the status NON_FINITE; NumPy need not warn of them.
    with np.errstate(invalid="ignore", over="ignore"):
        center = totals[:, 0] @ centers / max(totals[:, 0].sum(), 1)
        if len(parts) > 1:
            offset = centers - center
            totals[:, 1] += totals[:, 0] * np.einsum("bi,bi->b", offset, offset)
            shift = np.tile(np.eye(4), (len(parts), 1, 1))
            shift[:, :3, 3] = offset
            first = np.einsum("bij,bkj->bik", first, shift)
            full = np.empty((*second.shape[:2], 4, 4))
            full[..., _UPPER[0], _UPPER[1]] = full[..., _UPPER[1], _UPPER[0]] = second
            full = shift[:, None] @ full @ shift[:, None].swapaxes(-1, -2)
            second = full[..., _UPPER[0], _UPPER[1]]
        sums = (center, totals.sum(axis=0), first.sum(axis=0), second.sum(axis=0))
        return Sums(*(array.astype(dtype) for array in sums))
