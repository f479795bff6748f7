"""What can be trusted of a pose: the directions that nothing holds, and the covariance of the others.

Inside, twists ξ = (v, ω) turn about the centroid of the matched pairs, in the target's frame, and their lengths are in
units of the pairs' radius.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax import _covariance as cov
from mcgicp_jax._cost import AbstractKernel, Model, Pairs, evaluate_pairs, powers
from mcgicp_jax._evidence import Evidence
from mcgicp_jax._solve import adjoint_to_source, twist_form, units

# Shares of the points' motion below which a direction is not held. The geometry of flat scenes (posters on a wall, a
# road, a table with 2 mm noise) came to less than 0.0016, that of others to 0.1 and more; GICP's fake pull within the
# surface is as strong as a true share of ε, 0.001 by default. Noise alone made 0.003 of the channels, the markings of
# a road 0.008 and more.
GEOMETRY_HOLDS, CHANNELS_HOLD = 2e-3, 5e-3
# Scores are summed over cells of this many distances to the farthest neighbour.
_CELL = 2.0
# Radii of the pairs: the standard deviation that a direction has which nothing holds.
_UNKNOWN = 10.0
_LEAST_SHARE = 0.2
_IDENTITY = np.array([1, 0, 0, 1, 0, 1])
_HASH = np.array([73856093, 19349663, 83492791, 50331653], np.int32)


class Felt(eqx.Module):
    """Moments of the evidence over the matched pairs, as `Moments.Q`: Σ w K ⊗ h hᵀ.

    Attributes:
        geometry, channels: (6, 10); channels None where a method uses none.
        mass: (10,) Σ w h hᵀ.
    """

    geometry: Float[Array, "6 10"]
    channels: Float[Array, "6 10"] | None
    mass: Float[Array, "10"]


class Directions(eqx.Module):
    """Six directions in which a pose could move, and by what each is held.

    Attributes:
        twists: (6, 6), a direction in each row, scaled so that the matched points move by 1 (root mean square).
        geometry: (6,) share of that motion that the shape of the surfaces holds.
        channels: (6,) share that the channels hold; told for the directions that geometry leaves free, 0 for others.
        center: (3,) centroid of the matched source points, metres.
        radius: their root mean square distance from it, metres.
    """

    twists: Float[Array, "*batch 6 6"] | Float[np.ndarray, "*batch 6 6"]
    geometry: Float[Array, "*batch 6"] | Float[np.ndarray, "*batch 6"]
    channels: Float[Array, "*batch 6"] | Float[np.ndarray, "*batch 6"]
    center: Float[Array, "*batch 3"] | Float[np.ndarray, "*batch 3"]
    radius: Float[ArrayLike, "*batch"]

    @property
    def free(self) -> Bool[Array, "*batch 6"] | Bool[np.ndarray, "*batch 6"]:
        """Whether geometry leaves the direction free."""
        return ~(self.geometry >= GEOMETRY_HOLDS)

    @property
    def held(self) -> Bool[Array, "*batch 6"] | Bool[np.ndarray, "*batch 6"]:
        """Whether anything holds the direction: geometry, or else the channels."""
        return ~self.free | (self.channels >= CHANNELS_HOLD)


def pair_evidence(
    evidence: tuple[Evidence, Evidence], rotation: Float[Array, "3 3"], indices: Int[Array, "N"]
) -> tuple[Float[Array, "6 N"], Float[Array, "6 N"] | None]:
    """The mean of what the two points of each pair know, in the target's frame: geometry, channels."""
    source, target = evidence

    def mean(source: Float[Array, "6 N"], target: Float[Array, "6 M"]) -> Float[Array, "6 N"]:
        return 0.5 * (cov.rotate(rotation, source) + target[:, indices])

    geometry = mean(source.geometry, target.geometry)
    if source.channels is None or target.channels is None:
        return geometry, None
    return geometry, mean(source.channels, target.channels)


def feel(
    pairs: Pairs,
    center: Float[Array, "3"],
    evidence: tuple[Evidence, Evidence],
    rotation: Float[Array, "3 3"],
    indices: Int[Array, "N"],
) -> Felt:
    """How much the matched pairs would feel, by direction."""
    geometry, channels = pair_evidence(evidence, rotation, indices)
    hh = powers(jnp.where(pairs.valid, pairs.moved - center[:, None], 0))
    return Felt(
        geometry=jnp.dot(pairs.weight * geometry, hh.T, precision="highest"),
        channels=None if channels is None else jnp.dot(pairs.weight * channels, hh.T, precision="highest"),
        mass=jnp.sum(pairs.weight * hh, axis=1),
    )


def find_directions(moments: Felt, center: Float[Array, "3"], radius: Float[Array, ""]) -> Directions:
    """Eigenvectors of the share of the points' motion that geometry holds; where that is none, of the channels' share.

    A share of motion knows no unit: metres and radians, or another origin, change nothing.
    """
    total = jnp.where(moments.mass[9] > 0, moments.mass[9], 1)
    motion = twist_form(jnp.outer(_IDENTITY.astype(total.dtype), moments.mass / total), radius)
    geometry = twist_form(moments.geometry / total, radius)
    # One decomposition waits for the other: two batched LAPACK calls at once can dead-lock XLA's thread pool.
    # Points on a line do not move when they turn about it: what does not move is not held.
    values, vectors = jnp.linalg.eigh(motion)
    floor = 1e-5 * jnp.max(values)
    basis = vectors / jnp.sqrt(jnp.maximum(values, jnp.where(floor > 0, floor, 1)))
    shares, turn = jnp.linalg.eigh(basis.T @ geometry @ basis)
    basis = basis @ turn
    free = ~(shares >= GEOMETRY_HOLDS)
    if moments.channels is None:
        channels = jnp.zeros_like(shares)
        return Directions(twists=basis.T, geometry=shares, channels=channels, center=center, radius=radius)
    # Among the free directions, those that the channels tell apart; 2, beyond any share, keeps the others aside.
    among = jnp.outer(free, free)
    channels = jnp.where(among, basis.T @ twist_form(moments.channels / total, radius) @ basis, jnp.diag(2.0 * ~free))
    held, turn = jnp.linalg.eigh(channels)
    basis = basis @ turn
    shares = jnp.sum(basis * (geometry @ basis), axis=0)
    channels = jnp.where(held > 1.5, 0, held)
    return Directions(twists=basis.T, geometry=shares, channels=channels, center=center, radius=radius)


@jax.jit
def estimate_covariance(
    pose: jaxlie.SE3,
    center: Float[Array, "3"],
    radius: Float[Array, ""],
    directions: Directions | None,
    model: Model,
    evidence: tuple[Evidence, Evidence] | None,
) -> Float[Array, "6 6"]:
    """Covariance of ξ in T exp(ξ), metres and radians, from the scatter of the forces that the pairs exert.

    The sandwich A⁻¹ (Σ_c u_c u_cᵀ) A⁻¹ of a root of g = Σ w JᵀMd (Huber 1967). The scores of neighbouring pairs are not
    independent, since they share targets and covariances: u_c is their sum over a cell about as large as a
    neighbourhood. A is how g answers to a motion. Of M as a whole, only the share K that the evidence leaves is
    felt, since matches follow: A = Σ JᵀMKJ. What the rest, M(I − K)d, sums up to is a pull of the nearest neighbours
    upon the whole cloud; it counts as one more score.

    The derivative of M with respect to the rotation was tried in A; it made no difference of 1 %.
    """
    matches, robust = model[2], model[4]
    rotation = pose.rotation().as_matrix().astype(center.dtype)
    pairs = evaluate_pairs(rotation, pose.translation(), *model)
    arms = jnp.where(pairs.valid, (pairs.moved - center[:, None]) / radius, 0)
    force = pairs.weight * cov.multiply(pairs.information, pairs.residual)
    stiffness = pairs.weight * pairs.information + _change_of_weight(pairs, robust)
    pull = jnp.zeros(6, force.dtype)
    if evidence is not None and matches.indices.ndim == 1:
        geometry, channels = pair_evidence(evidence, rotation, matches.indices)
        geometry = _share_across(pairs, model[0].valid, evidence, rotation, matches.indices) * geometry
        if channels is not None:
            # K = A (I + A)⁻¹ with an A that is smaller by the ratio.
            ratio, trace = _channel_ratio(pairs, model, evidence), channels[0] + channels[3] + channels[5]
            channels = ratio * channels / (1 - (1 - ratio) * jnp.clip(trace, 0, 1))
        share = geometry if channels is None else geometry + channels
        stiffness = _symmetric_product(stiffness, share)
        fake = force - pairs.weight * cov.multiply(pairs.information, cov.multiply(share, pairs.residual))
        pull = jnp.sum(_scores(arms, fake), axis=1)
    scores = _scores(arms, force)
    if evidence is None:
        cells = scores
        count = jnp.sum(pairs.valid)
    else:
        reach = 0.5 * (evidence[0].reach + evidence[1].reach[matches.indices])
        cells, count = _sum_over_cells(scores, pairs.moved, pairs.valid, _CELL * reach)
    # Six of the cells' freedoms went into the pose.
    count = count.astype(scores.dtype)
    scatter = jnp.dot(cells, cells.T, precision="highest") * count / jnp.where(count > 6, count - 6, jnp.nan)
    scatter = scatter + jnp.outer(pull, pull)
    answer = twist_form(jnp.dot(stiffness, powers(arms * radius).T, precision="highest"), radius) * radius

    basis, held = jnp.eye(6, dtype=scores.dtype), jnp.ones(6, bool)
    if directions is not None:
        basis, held = jnp.asarray(directions.twists).T, jnp.asarray(directions.held)
    both = jnp.outer(held, held)
    answer = jnp.where(both, basis.T @ answer @ basis, jnp.diag(1.0 * ~held))
    scatter = jnp.where(both, basis.T @ scatter @ basis, jnp.diag(_UNKNOWN**2 * ~held))
    half = jnp.linalg.solve(answer, scatter)
    covariance = basis @ jnp.linalg.solve(answer, half.T) @ basis.T
    change = adjoint_to_source(pose, center) * units(radius)
    covariance = change @ covariance @ change.T
    return 0.5 * (covariance + covariance.T)


def _share_across(
    pairs: Pairs,
    points_valid: Bool[Array, "N"],
    evidence: tuple[Evidence, Evidence],
    rotation: Float[Array, "3 3"],
    indices: Int[Array, "N"],
) -> Float[Array, ""]:
    """The share of a motion across the surface that is felt: less than 1 where surfaces are rough beside their spacing.

    Among rough neighbours the nearest is one whose height is much like that of the point. If heights b = βa + e of
    matches follow those of their points so, and both are as rough as each other, then the variance of b − a is 1 − β
    of what the two roughnesses add up to; and when the point moves, its match makes up for β of it.
    """
    source, target = evidence
    some, valid = cov.some_rows(points_valid)
    valid = valid & pairs.valid[some]
    across = jnp.dot(rotation, source.normal[:, some], precision="highest")
    # Medians, since planes do not fit at edges: of the square of a normal variate, and of the mean of two such squares.
    seen = jnp.where(valid, cov.inner(across, pairs.residual[:, some]) ** 2, jnp.nan)
    expected = jnp.where(valid, source.roughness[some] + target.roughness[indices[some]], jnp.nan)
    ratio = (cov.median(seen) / 0.455) / (cov.median(expected) / 0.693)
    return jnp.where(jnp.isfinite(ratio), jnp.clip(ratio, _LEAST_SHARE, 1), 1)


def _channel_ratio(pairs: Pairs, model: Model, evidence: tuple[Evidence, Evidence]) -> Float[Array, ""]:
    """By how much less channels tell of a motion than their gradients let expect, where they are noisy.

    As in `_share_across`: among neighbours with noisy channels, the nearest is one whose noise is like the point's.
    """
    source, target, matches, *_ = model
    some, complete = cov.some_rows(source.valid)
    indices = matches.indices[some]
    complete = complete & pairs.valid[some]
    for surface, rows in ((source, some), (target, indices)):
        if surface.absence is not None:
            complete = complete & jnp.all(surface.absence[rows] == 0, axis=1)
    difference = source.descriptors[some] - target.descriptors[indices]
    # Pair by pair, since edges are noisier than what lies between them.
    expected = jnp.where(complete, evidence[0].noise[some] + evidence[1].noise[indices], jnp.nan)
    seen = jnp.sum(difference * difference, axis=1) / jnp.where(expected > 0, expected, jnp.nan)
    # The median of a sum of C squares of normal variates, divided by C (Wilson & Hilferty 1931). Channels that are
    # constant, or weigh nothing, are none of them.
    count = jnp.maximum(jnp.sum(jnp.any(source.descriptors != 0, axis=0)), 1)
    median = (1 - 2 / (9 * count)) ** 3
    ratio = cov.median(seen) / median
    return jnp.where(jnp.isfinite(ratio), jnp.clip(ratio, _LEAST_SHARE, 1), 1)


def _scores(arms: Float[Array, "3 N"], force: Float[Array, "3 N"]) -> Float[Array, "6 N"]:
    return jnp.concatenate([force, jnp.cross(arms, force, axis=0)])


def _change_of_weight(pairs: Pairs, robust: AbstractKernel | None) -> Float[Array, "6 N"]:
    """2 dw/d(s²) f fᵀ with f = M d: a robust weight falls as its pair is pulled apart."""
    if robust is None:
        return jnp.zeros_like(pairs.information)
    pull = cov.multiply(pairs.information, pairs.residual)
    square = cov.inner(pairs.residual, pull)
    slope = jax.grad(lambda square: jnp.sum(robust.weight(square)))(square)
    return 2 * pairs.share * slope * cov.outer(pull)


def _symmetric_product(a: Float[Array, "6 N"], b: Float[Array, "6 N"]) -> Float[Array, "6 N"]:
    """(A B + B A) / 2."""
    axes = jnp.eye(3, dtype=a.dtype)[:, :, None]
    columns = [cov.multiply(a, cov.multiply(b, jnp.broadcast_to(axis, (3, a.shape[1])))) for axis in axes]
    return jnp.stack([0.5 * (columns[j][i] + columns[i][j]) for i in range(3) for j in range(i, 3)])


def _sum_over_cells(
    scores: Float[Array, "6 N"], moved: Float[Array, "3 N"], valid: Bool[Array, "N"], size: Float[Array, "N"]
) -> tuple[Float[Array, "6 N"], Int[Array, ""]]:
    """Sums over cells of space, and how many there are. Sizes are rounded to powers of two: cells are small where
    points are dense. Two cells may share a sum by chance, which does no harm: being independent, they do not correlate.
    """
    level = jnp.round(jnp.log2(jnp.where(valid & (size > 0), size, 1)))
    cell = jnp.floor(jnp.where(valid, moved / 2.0**level, 0)).astype(jnp.int32)
    keys = (*cell, level.astype(jnp.int32))
    number = jnp.abs(sum((key * prime for key, prime in zip(keys, _HASH, strict=True)), jnp.int32(0))) % valid.size
    # In rows, so that what is scattered is seven numbers at a time.
    rows = jnp.concatenate([scores, valid[None].astype(scores.dtype)]).T
    *sums, counts = jnp.zeros_like(rows).at[number].add(rows).T
    return jnp.stack(sums), jnp.sum(counts > 0)


def directions_at_source(directions: Directions, pose: jaxlie.SE3) -> Directions:
    """With twists ξ of T exp(ξ), metres and radians, that move the points by 1 m (root mean square)."""
    center, radius = jnp.asarray(directions.center), jnp.asarray(directions.radius)
    change = adjoint_to_source(pose, center) * units(radius) / radius
    center = pose.inverse() @ center
    return eqx.tree_at(lambda d: (d.twists, d.center), directions, (directions.twists @ change.T, center))
