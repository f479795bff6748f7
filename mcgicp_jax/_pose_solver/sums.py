"""Sums over correspondences, the only input of a pose update that depends on the points.

With the residual d = b − T a and the robust weight w, each correspondence has a force f = w M d (3), a stiffness
K = w M (3×3) and a cost. About a centre c, with p = T a − c and h = (p, 1), the sums are G = Σ f hᵀ (12 numbers),
Q = Σ K ⊗ h hᵀ (6 × 16) and e = Σ dᵀ f. With the observability O of each correspondence (3×3, see
`_local_geometry.observability`), Σ w O ⊗ h hᵀ is added.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, numpy_for
from mcgicp_jax._local_geometry.observability import agreement
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._pose_solver.matched import Matched, Motion, linearize_at, normalized
from mcgicp_jax._terms.base import AbstractTerm, PosedMatches

# Observability that cells have in common by chance: planes whose noise is a third to a half of the edge of a cell had
# up to 0.017 along free directions (D2D-NDT), crossing planes 0.0025; yards, streets, rooms and RGB-D at least 0.025.
_BY_CHANCE = 0.02
# Fields of `Sums` that are sums over h hᵀ.
_SECOND_MOMENTS = ("stiffness", "mass", "observability", "common", "channel_observability", "agreement", "surplus")


class Sums(NamedTuple):
    """Sums over correspondences, see the module. The centre c is the centroid of the moved, matched source points.

    Taken about this centre and at the current pose, the sums remain precise in float32. Symmetric 3×3
    matrices are stored as upper triangles, h hᵀ is stored whole.

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
        mass: Σ w h hᵀ without points near the sensor, as the following; None where observability is not known.
        observability: Σ w O ⊗ h hᵀ by the shape of the surfaces, less that of points near the sensor; None where it is
            not known.
        common: Σ w O' ⊗ h hᵀ by the common O' of matched points, see `observability`.
        channel_observability: the same by the channels; None also where they are not used.
        agreement: the same by slopes of the channels that agree in both clouds; `channel_observability` where the
            slopes are not known, as before the last step.
        surplus: the same by the surplus of gradients across the lines of sight; 0 where the slopes are not known.
    """

    center: Float[AnyArray, "*batch 3"]
    count: Float[AnyArray, "*batch"]
    square_extent: Float[AnyArray, "*batch"]
    energy: Float[AnyArray, "*batch"]
    cost: Float[AnyArray, "*batch"]
    square_distance: Float[AnyArray, "*batch"]
    num_matched: Float[AnyArray, "*batch"]
    force: Float[AnyArray, "*batch 3 4"]
    stiffness: Float[AnyArray, "*batch 6 4 4"]
    mass: Float[AnyArray, "*batch 4 4"] | None = None
    observability: Float[AnyArray, "*batch 6 4 4"] | None = None
    common: Float[AnyArray, "*batch 6 4 4"] | None = None
    channel_observability: Float[AnyArray, "*batch 6 4 4"] | None = None
    agreement: Float[AnyArray, "*batch 6 4 4"] | None = None
    surplus: Float[AnyArray, "*batch 6 4 4"] | None = None

    @property
    def radius(self) -> Float[AnyScalar, ""]:
        """Root mean square distance of the moved, matched points from the centre, metres; 1 if it is 0."""
        xp = numpy_for(self.square_extent, self.count)
        square = self.square_extent / xp.maximum(self.count, 1)
        return xp.sqrt(xp.where(square > 0, square, 1))

    @property
    def num_inliers(self) -> Int[Array, ""]:
        """Number of source points with a match; exact in float32 up to 2²⁴."""
        return self.num_matched.astype(jnp.int32)

    @property
    def rmse(self) -> Float[AnyScalar, ""]:
        """Root mean square correspondence distance, metres; NaN without matches."""
        return jnp.sqrt(self.square_distance / self.num_matched)


def sums_of(
    motion: Motion,
    matched: Matched,
    terms: tuple[AbstractTerm, ...],
    near: Float[AnyScalar, ""],
    last: Bool[AnyScalar, ""],
) -> Sums:
    """Compute the sums at a pose in one pass over the correspondences, the only part of a step that touches points.

    All sums but those for the centre are rows of one product with h hᵀ: sums of their own would be programs of several
    loops each, which evaluate the same expressions again.

    Args:
        near: metres; source points within this distance of the sensor, the origin of their frame, may be the sensor's
            own vehicle, which moves with it. By shape they count against a motion, which they would hold wherever
            others say less; their channels do not count.
        last: whether the loop ends with these sums, see `observability`.
    """
    posed, total, counts = linearize_at(motion, matched, terms)
    mask = jnp.asarray(matched.valid).astype(posed.moved.dtype)
    with_one = jnp.concatenate([posed.moved, jnp.ones_like(posed.moved[:1])])
    *position, count = jnp.dot(with_one, mask, precision="highest")
    center = jnp.stack(position) / jnp.maximum(count, 1)
    weights = normalized(counts.reshape(matched.num_candidates, -1))
    square_distances = weights * alg.inner(total.residual, total.residual)
    first = mask
    if matched.num_candidates > 1:
        # 1 for the first valid candidate of each source point.
        by_candidate = mask.reshape(matched.num_candidates, -1)
        first = jnp.where(jnp.cumsum(by_candidate, axis=0) == 1, by_candidate, 0).reshape(-1)
    numbers = jnp.stack([mask, alg.inner(total.residual, total.force), total.cost, square_distances, first])
    rows = {"stiffness": total.stiffness, "force": total.force, "numbers": numbers}
    fractions = observability(posed, terms, last)
    if fractions:
        far = jnp.sum(jnp.square(jnp.asarray(posed.source.points)), axis=1) >= near**2
        evidence = jnp.where(far, total.weight, 0)
        against = jnp.where(far, total.weight, -total.weight)
        rows["mass"] = evidence[None]
        rows |= {name: against * fractions.pop(name) for name in ("observability", "common")}
        rows |= {name: evidence * fraction for name, fraction in fractions.items()}
    ends = np.cumsum([len(row) for row in rows.values()])
    centred = mask * (posed.moved - center[:, None])
    split = jnp.split(moments_of(jnp.concatenate(list(rows.values())), centred), ends[:-1])
    moments = dict(zip(rows, split, strict=True))
    if "mass" in moments:
        moments["mass"] = moments["mass"][0]
    if "channel_observability" in moments:
        moments.setdefault("agreement", moments["channel_observability"])
        moments.setdefault("surplus", jnp.zeros_like(moments["channel_observability"]))
    totals, force = moments.pop("numbers"), moments.pop("force")[:, 3]
    square_extent = jnp.trace(totals[0, :3, :3])
    _, energy, cost, square_distance, num_matched = totals[:, 3, 3]
    return Sums(center, count, square_extent, energy, cost, square_distance, num_matched, force, **moments)


def moments_of(rows: Float[Array, "R n"], points: Float[Array, "3 n"]) -> Float[Array, "R 4 4"]:
    """Σ r h hᵀ for each row r of numbers, with h = (p, 1)."""
    # Without the barrier XLA evaluates h anew for each of the sixteen products.
    h = jax.lax.optimization_barrier(jnp.concatenate([points, jnp.ones_like(points[:1])]))
    products = (h[:, None] * h[None]).reshape(16, -1)
    return jnp.dot(rows, products.T, precision="highest").reshape(-1, 4, 4)


def observability(
    posed: PosedMatches, terms: tuple[AbstractTerm, ...], last: Bool[AnyScalar, ""]
) -> dict[str, Float[Array, "6 n"]]:
    """O per correspondence, in the target's frame, by its name in `Sums`: mean over its two points, by shape, and where
    channels are used, by channels; what both points have in common; and if the surfaces have `noise` with slopes, their
    agreement and its surplus.

    Let A and B be the O of the two points by shape; their traces, from 0 to 1, say how certain the normals are. Their
    common O is (A + B) / 2 − (tr B · A + tr A · B) / 2 + (A B + B A) / 2. It is A where both are equal and of rank one,
    B / 2 where the normal of A is unknown (A = 0), and 0 for two certain normals at right angles. Where one scan shows
    the end of a box and the other does not, points match across the edge, and by the mean alone they constrained the
    slide along the box. Before the `last` sums, the common O is the mean: far from the right pose, the normals of
    matched points are unrelated, and the directions that each cloud observes guide the pose.

    The O of a cell is biased: its normal comes from few points, and is a random one where noise is as large as the
    cell. The common O of cells is therefore the product of both, whose noise is independent, less that of chance.
    """
    source, target, rotation = posed.source, posed.target, posed.rotation
    if source.observability is None or target.observability is None:
        return {}
    ours, theirs = alg.rotate(rotation, source.observability.T), target.observability.T
    mean, common = 0.5 * (ours + theirs), alg.symmetric_product(ours, theirs)
    if all(term.matches_slide for term in terms):
        certain, certain_there = (jnp.clip(side[0] + side[3] + side[5], 0, 1) for side in (ours, theirs))
        common = common + mean - 0.5 * (certain_there * ours + certain * theirs)
    else:
        common = common - _BY_CHANCE * jnp.array([[1], [0], [0], [1], [0], [1]], ours.dtype)
    fractions = {"observability": mean, "common": jnp.where(last, common, mean)}
    if source.channel_observability is not None and target.channel_observability is not None:
        ours, theirs = alg.rotate(rotation, source.channel_observability.T), target.channel_observability.T
        fractions["channel_observability"] = 0.5 * (ours + theirs)
    slopes, slopes_there = (None if side.noise is None else side.noise.slopes for side in (source, target))
    if target.noise is not None and slopes is not None and slopes_there is not None:
        turned = jnp.einsum("ij,ncj->cin", rotation, slopes, precision="highest")
        # The source's sensor is at the origin of its frame; the target may be a map.
        sight = jnp.dot(rotation, source.points.T, precision="highest")
        tangent = jnp.cross(target.noise.normal.T, sight, axis=0)
        length = jnp.sqrt(alg.inner(tangent, tangent))
        across = tangent / jnp.where(length > 0, length, 1)
        fractions["agreement"], fractions["surplus"] = agreement(turned, slopes_there.transpose(1, 2, 0), across)
    return fractions


def combine(parts: Sums) -> Sums:
    """The sums of blocks, stacked along the first axis, about the common centroid. NumPy, float64, added in their
    order, so that the result does not depend on the number of threads."""
    # Non-finite values propagate into the status NON_FINITE; NumPy need not warn of them.
    with np.errstate(invalid="ignore", over="ignore"):
        center = parts.count @ parts.center / max(parts.count.sum(), 1)
        offset = parts.center - center
        shift = np.zeros((len(offset), 4, 4)) + np.eye(4)
        shift[:, :3, 3] = offset
        columns = {name: column for name, column in parts._asdict().items() if column is not None}
        columns["square_extent"] = parts.square_extent + parts.count * np.sum(offset * offset, axis=1)
        columns["force"] = parts.force @ shift.swapaxes(-1, -2)
        # All sums over h hᵀ at once.
        rows = {name: columns[name].reshape(len(offset), -1, 4, 4) for name in _SECOND_MOMENTS if name in columns}
        moved = shift[:, None] @ np.concatenate(list(rows.values()), axis=1) @ shift[:, None].swapaxes(-1, -2)
        split = np.split(moved, np.cumsum([part.shape[1] for part in rows.values()])[:-1], axis=1)
        columns |= {name: part.reshape(columns[name].shape) for name, part in zip(rows, split, strict=True)}
        return Sums(**{name: column.sum(axis=0) for name, column in columns.items()} | {"center": center})
