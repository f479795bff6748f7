"""Covariance of a pose, from the scatter of the forces that the correspondences exert.

The sandwich A⁻¹ (Σ_c u_c u_cᵀ) A⁻¹ of a root of g = Σ w JᵀMd (Huber 1967). The scores of neighbouring correspondences
are not independent, since they share targets and covariances: u_c is their sum over a cell about as large as a
neighbourhood. A is the Jacobian of g with respect to the pose. Of M as a whole, only the fraction K that observability leaves takes
part, since matches follow: A = Σ JᵀMKJ. What the rest, M(I − K)d, sums up to is a bias of the nearest neighbours upon
the whole cloud; it counts as one more score. (The derivative of M with respect to the rotation was tried in A; it made
no difference of 1 %.)

Three steps: medians over sampled rows (`discounts`), scores of all rows (`scores_of`), and 6×6 algebra
(`sandwich`). The first two work row by row, in blocks or over whole arrays.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax import _algebra as alg
from mcgicp_jax._directions import Directions
from mcgicp_jax._kernels import AbstractKernel
from mcgicp_jax._methods import AbstractMethod
from mcgicp_jax._pose import AnyArray, AnyScalar
from mcgicp_jax._search import Rows
from mcgicp_jax._solve import adjoint_to_source, twist_form, units
from mcgicp_jax._statistics import median, namespace
from mcgicp_jax._sums import Matched, forces_at, mean_observability, move_rows, powers
from mcgicp_jax._surface import noise_of, normal_of, points_of, reach_of, roughness_of

# Scores are summed over cells of this many distances to the farthest neighbour: 1 to 4 hardly differ.
_CELL = 2.0
# Radii of the matched points: the standard deviation of a direction that nothing constrains.
_UNKNOWN = 10.0
# Least fraction of a motion that is taken to show: medians of few rows may come out as 0.
_LEAST_FRACTION = 0.2
# Medians of the square of a normal variate, and of the mean of two such squares.
_MEDIAN_SQUARE, _MEDIAN_MEAN_OF_TWO = 0.455, 0.693
# Multipliers of the hash of a cell: primes of Teschner et al. 2003, and one more.
_HASH = np.array([73856093, 19349663, 83492791, 50331653], np.int32)


class Details(NamedTuple):
    """`Surface.details` of correspondences: rows of the source, and the matched rows of the target."""

    source: Float[AnyArray, "n 6"]
    target: Float[AnyArray, "n 6"]


def discount_rows(
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    matched: Matched,
    details: Details,
    source: Rows,
    target: Rows,
) -> Float[Array, "n 3"]:
    """What `discounts` takes medians of: squared residual across the surface, what roughness lets expect of it, and the
    squared difference of the descriptors by what their noise lets expect of it. NaN without a match.

    Args:
        source, target: matched rows, as a search sees them.
    """
    residual = points_of(matched.target) - move_rows(rotation, translation, matched.source)
    across = jnp.dot(rotation, normal_of(details.source), precision="highest")
    seen = alg.inner(across, residual) ** 2
    expected = roughness_of(details.source) + roughness_of(details.target)
    complete = jnp.asarray(matched.valid)
    for penalty in (source.penalty, target.penalty):
        if penalty is not None:
            complete = complete & jnp.all(penalty == 0, axis=1)
    noise = noise_of(details.source) + noise_of(details.target)
    difference = source.descriptors - target.descriptors
    # Match by match, since edges are noisier than what lies between them.
    quotient = jnp.sum(difference * difference, axis=1) / jnp.where(noise > 0, noise, jnp.nan)
    columns = (jnp.where(matched.valid, seen, jnp.nan), jnp.where(matched.valid, expected, jnp.nan))
    return jnp.stack([*columns, jnp.where(complete, quotient, jnp.nan)], axis=1)


def discounts(rows: Float[AnyArray, "n 3"], num_channels: Int[AnyScalar, ""]) -> Float[AnyArray, "2"]:
    """By how much less of a motion shows than observability says: across the surface, and in the channels; 0.2 to 1.

    Across the surface: among rough neighbours the nearest is one whose height is much like that of the point. If
    heights b = βa + e of matches follow those of their points so, and both are as rough as each other, then the
    variance of b − a is 1 − β of what the two roughnesses add up to; and when the point moves, its match makes up for
    β of it. Likewise among neighbours with noisy channels. Medians, since planes do not fit at edges.

    Args:
        rows: of `discount_rows`.
        num_channels: how many channels weigh anything.
    """
    xp = namespace(rows, num_channels)
    seen, expected, quotient = median(xp.asarray(rows).T)
    geometry = (seen / _MEDIAN_SQUARE) / (xp.where(expected > 0, expected, xp.nan) / _MEDIAN_MEAN_OF_TWO)
    # The median of a sum of C squares of normal variates, divided by C (Wilson & Hilferty 1931).
    channels = quotient / (1 - 2 / (9 * xp.maximum(num_channels, 1))) ** 3
    ratios = xp.stack([geometry, channels])
    return xp.where(xp.isfinite(ratios), xp.clip(ratios, _LEAST_FRACTION, 1), 1).astype(rows.dtype)


class Scores(NamedTuple):
    """What `sandwich` needs of correspondences.

    Attributes:
        rows: (n, 7) force and torque of each, lengths in units of the radius, and whether it counts.
        cells: (n,) number of the cell that each falls into; None: every correspondence is a cell of its own.
        jacobian: (6, 10) Σ (M K) ⊗ h hᵀ about the centre.
        bias: (6,) Σ of the forces and torques that observability leaves out.
    """

    rows: Float[AnyArray, "n 7"]
    cells: Int[AnyArray, "n"] | None
    jacobian: Float[AnyArray, "6 10"]
    bias: Float[AnyArray, "6"]


def scores_of(
    pose: tuple[Float[Array, "3 3"], Float[Array, "3"]],
    center: Float[Array, "3"],
    radius: Float[Array, ""],
    matched: Matched,
    details: Details | None,
    discount: Float[Array, "2"],
    num_cells: Int[AnyScalar, ""],
    method: AbstractMethod,
    robust: AbstractKernel | None,
) -> Scores:
    """The scores of correspondences at a pose.

    Args:
        pose: rotation and translation.
        center, radius: metres, of the sums over all correspondences.
        details: None where observability is not known; all of a stiffness counts then.
        discount: of `discounts`.
        num_cells: cells of space share so many numbers.
    """
    moved, forces, counts = forces_at(*pose, matched, method, robust)
    arms = jnp.where(matched.valid, (moved - center[:, None]) / radius, 0)
    stiffness = (
        forces.stiffness if robust is None else _tangent_stiffness(pose[0], moved, matched, counts, method, robust)
    )
    bias, cells = jnp.zeros(6, moved.dtype), None
    if details is not None:
        geometry, *channels = mean_observability(pose[0], matched)
        shown = discount[0] * geometry
        for each in channels:
            # K = A (I + A)⁻¹ with an A that is smaller by the discount.
            trace = each[0] + each[3] + each[5]
            shown = shown + discount[1] * each / (1 - (1 - discount[1]) * jnp.clip(trace, 0, 1))
        left_out = forces.force - alg.multiply(forces.stiffness, alg.multiply(shown, forces.residual))
        bias = jnp.sum(_wrench(arms, left_out), axis=1)
        stiffness = alg.symmetric_product(stiffness, shown)
        size = _CELL * 0.5 * (reach_of(details.source) + reach_of(details.target))
        cells = _cells(moved, matched.valid, size, num_cells)
    rows = jnp.concatenate([_wrench(arms, forces.force), matched.valid[None].astype(moved.dtype)]).T
    return Scores(rows, cells, jnp.dot(stiffness, powers(arms * radius).T, precision="highest"), bias)


def _wrench(arms: Float[Array, "3 N"], force: Float[Array, "3 N"]) -> Float[Array, "6 N"]:
    """Force and torque."""
    return jnp.concatenate([force, jnp.cross(arms, force, axis=0)])


def _tangent_stiffness(
    rotation: Float[Array, "3 3"],
    moved: Float[Array, "3 N"],
    matched: Matched,
    counts: Float[Array, "N"],
    method: AbstractMethod,
    robust: AbstractKernel,
) -> Float[Array, "6 N"]:
    """How a force answers to a shift of its point: a robust weight falls as its correspondence is pulled apart."""

    def force(shift: Float[Array, "3"]) -> Float[Array, "3 N"]:
        shifted = moved + shift[:, None]
        return method.forces(matched.source, matched.target, shifted, rotation, matched.valid, robust).force

    still = jnp.zeros(3, moved.dtype)
    columns = [-counts * jax.jvp(force, (still,), (axis,))[1] for axis in jnp.eye(3, dtype=moved.dtype)]
    return jnp.stack([0.5 * (columns[j][i] + columns[i][j]) for i in range(3) for j in range(i, 3)])


def _cells(
    moved: Float[Array, "3 N"], valid: Bool[Array, "N"], size: Float[Array, "N"], num_cells: Int[AnyScalar, ""]
) -> Int[Array, "N"]:
    """The number of the cell that each point lies in. Sizes are rounded to powers of two: cells are small where points
    are dense. Two cells may share a number by chance, which does no harm: being independent, they do not correlate.
    """
    level = jnp.round(jnp.log2(jnp.where(valid & (size > 0), size, 1)))
    cell = jnp.floor(jnp.where(valid, moved / 2.0**level, 0)).astype(jnp.int32)
    keys = (*cell, level.astype(jnp.int32))
    return jnp.abs(sum((key * prime for key, prime in zip(keys, _HASH, strict=True)), jnp.int32(0))) % num_cells


def scatter_of(scores: Scores, num_cells: int) -> tuple[Float[AnyArray, "6 6"], Int[AnyScalar, ""]]:
    """Σ_c u_c u_cᵀ, and how many cells there are."""
    xp = namespace(scores)
    rows = scores.rows
    if scores.cells is not None and xp is np:
        columns = [np.bincount(scores.cells, column, num_cells) for column in rows.T]
        rows = np.stack(columns, axis=1)
    elif scores.cells is not None:
        # In rows, so that what is scattered is seven numbers at a time.
        rows = jnp.zeros_like(rows, shape=(num_cells, 7)).at[scores.cells].add(rows)
    sums = rows[:, :6]
    product = sums.T @ sums if xp is np else jnp.dot(sums.T, sums, precision="highest")
    return product, xp.sum(rows[:, 6] > 0)


def sandwich(
    pose: jaxlie.SE3,
    center: Float[Array, "3"],
    radius: Float[Array, ""],
    jacobian: Float[Array, "6 10"],
    bias: Float[Array, "6"],
    scatter: Float[Array, "6 6"],
    num_cells: Int[Array, ""],
    directions: Directions | None,
) -> Float[Array, "6 6"]:
    """Covariance of ξ in T exp(ξ), metres and radians."""
    # Six of the cells' freedoms went into the pose.
    count = num_cells.astype(scatter.dtype)
    scatter = scatter * count / jnp.where(count > 6, count - 6, jnp.nan) + jnp.outer(bias, bias)
    response = twist_form(jacobian, radius) * radius
    basis, held = jnp.eye(6, dtype=scatter.dtype), jnp.ones(6, bool)
    if directions is not None:
        basis, held = jnp.asarray(directions.twists).T, jnp.asarray(directions.held)
    both = jnp.outer(held, held)
    response = jnp.where(both, basis.T @ response @ basis, jnp.diag(1.0 * ~held))
    scatter = jnp.where(both, basis.T @ scatter @ basis, jnp.diag(_UNKNOWN**2 * ~held))
    # One LAPACK call, and no second beside it.
    inverse = jnp.linalg.inv(response)
    covariance = basis @ inverse @ scatter @ inverse.T @ basis.T
    change = adjoint_to_source(pose, center) * units(radius)
    covariance = change @ covariance @ change.T
    return 0.5 * (covariance + covariance.T)
