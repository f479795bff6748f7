"""Covariance of a pose, from the scatter of the scores (force and torque) of its correspondences.

The sandwich estimate A⁻¹ (Σ_c u_c u_cᵀ) A⁻ᵀ for the root of g = Σ w JᵀMd (Huber 1967). Scores of neighbouring
correspondences are correlated, since they share targets and covariances, so u_c is the sum of the scores in a cell
about as large as a neighbourhood, or smaller where there would be few cells. A is the Jacobian of g with respect to
the pose. When the pose moves, the matches follow along the surface, so only the observable fraction O of a motion
changes the residuals: A = Σ w JᵀMOJ. The rest of the forces, w M(I − O)d, sums to a bias of nearest-neighbour matching,
which enters as one more score. Cells of `voxel_gaussians` stand still instead: A = Σ w JᵀMJ (`matches_slide`).
(Including the derivative of M with respect to the rotation in A changed the result by less than 1 %.)

Three steps: medians over sampled rows (`discounts_and_radius`), scores of all rows (`scores_of`), and 6×6 algebra
(`sandwich`). The first two work row by row, in blocks or over whole arrays.
"""

from __future__ import annotations

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Int

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, numpy_for
from mcgicp_jax._local_geometry.local_geometry import SurfaceNoise, searched
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.poses import adjoint_to_source, units
from mcgicp_jax._math.statistics import cell_numbers, median
from mcgicp_jax._pose_solver.degeneracy import Directions
from mcgicp_jax._pose_solver.matched import Matched, Motion, linearize_at
from mcgicp_jax._pose_solver.sums import moments_of, observability
from mcgicp_jax._pose_solver.update import twist_form
from mcgicp_jax._terms.base import AbstractTerm, PosedMatches, linearize

# Standard deviation of an unconstrained direction, in radii of the matched points: large compared with their extent.
UNKNOWN = 10.0
# Lower bound of the factors that reduce observability, dimensionless: a median of few rows may be 0.
_LEAST_FRACTION = 0.2
# The least number of cells along the radius of the matched points. Of ten cells in all, the sums hardly scatter in one
# direction, whose variance was 14 (rooms) to 75 times (spheres) too small with the photometric term. Two along the
# radius make some fifty in all, with which it was at most 2.2 times too small.
_LEAST_CELLS = 2.0
# Medians of the square of a standard normal variate, and of the mean of two such squares.
_MEDIAN_SQUARE, _MEDIAN_MEAN_OF_TWO = 0.455, 0.693


class NoiseSample(NamedTuple):
    """Per match, the statistics whose medians are taken; NaN where there is no match.

    Attributes:
        residual: squared residual along the normal, metres².
        expected: its variance expected from roughness, metres².
        quotient: squared descriptor difference over its variance expected from channel noise; NaN also where a point
            lacks a channel.
        neighborhood_radius: mean distance of both points to their farthest neighbours, metres.
    """

    residual: Float[AnyArray, "n"]
    expected: Float[AnyArray, "n"]
    quotient: Float[AnyArray, "n"]
    neighborhood_radius: Float[AnyArray, "n"]


def noise_sample(motion: Motion, matched: Matched) -> NoiseSample:
    """The statistics of matches whose surfaces have `noise` and `search`."""
    source, target = cast(SurfaceNoise, matched.source.noise), cast(SurfaceNoise, matched.target.noise)
    residual = matched.target.points.T - motion.move(matched.source.points)
    normal = jnp.dot(motion.rotation, source.normal.T, precision="highest")
    rows, rows_there = searched(matched.source), searched(matched.target)
    difference, variance = rows.descriptors - rows_there.descriptors, source.descriptors + target.descriptors
    # A quotient per match rather than one of medians: noise is higher at edges.
    quotient = jnp.sum(difference * difference, axis=1) / jnp.where(variance > 0, variance, jnp.nan)
    for penalty in (rows.penalty, rows_there.penalty):
        if penalty is not None:
            quotient = jnp.where(jnp.all(penalty == 0, axis=1), quotient, jnp.nan)
    radius = 0.5 * (source.neighborhood_radius + target.neighborhood_radius)
    columns = alg.inner(normal, residual) ** 2, source.roughness + target.roughness, quotient, radius
    return NoiseSample(*(jnp.where(matched.valid, column, jnp.nan) for column in columns))


def discounts_and_radius(
    sample: NoiseSample, num_channels: Int[AnyScalar, ""]
) -> tuple[Float[AnyArray, "2"], Float[AnyScalar, ""]]:
    """(2,) factors, 0.2 to 1, by which observability must be reduced: of the geometry and of the channels; and the
    median distance to the farthest neighbour, metres.

    On a rough surface the nearest neighbour is one whose height resembles that of the point. Model the height b of a
    match as b = βa + e, with equal roughness on both sides. Then var(b − a) is (1 − β) times the sum of both
    roughnesses, and the match follows a fraction β of any motion. The ratio of observed to expected variance therefore
    estimates the observable fraction 1 − β. The same holds for noisy channels. Medians, since the plane fits fail at
    edges.

    `num_channels` is that of channels with a nonzero weight α.
    """
    xp = numpy_for(sample, num_channels)
    residual, expected, quotient, neighborhood_radius = median(xp.stack([xp.asarray(column) for column in sample]))
    geometry = (residual / _MEDIAN_SQUARE) / (xp.where(expected > 0, expected, xp.nan) / _MEDIAN_MEAN_OF_TWO)
    # Divided by the median of χ²/C with C degrees of freedom, after Wilson & Hilferty 1931.
    channels = quotient / (1 - 2 / (9 * xp.maximum(num_channels, 1))) ** 3
    ratios = xp.stack([geometry, channels])
    factors = xp.where(xp.isfinite(ratios), xp.clip(ratios, _LEAST_FRACTION, 1), 1)
    neighborhood_radius = xp.where(neighborhood_radius > 0, neighborhood_radius, 1)
    return factors.astype(sample.residual.dtype), neighborhood_radius.astype(sample.residual.dtype)


class Scores(NamedTuple):
    """Forces and torques of correspondences (arms in units of the radius), and sums over them for `sandwich`.

    Attributes:
        cells: number of the cell of each correspondence; None: each is a cell of its own.
        jacobian: Σ (K O) ⊗ h hᵀ about the centre, K O symmetrised; K = w M, or the tangent of a robust force.
        bias: Σ of force and torque of w M(I − O)d; 0 where observability is not known.
    """

    wrenches: Float[AnyArray, "n 6"]
    valid: Float[AnyArray, "n"]
    cells: Int[AnyArray, "n"] | None
    jacobian: Float[AnyArray, "6 4 4"]
    bias: Float[AnyArray, "6"]


class Frame(NamedTuple):
    """What scores depend on besides correspondences: `Sums.center` and `Sums.radius` over all of them, the results of
    `discounts_and_radius`, and the size of the hash table of cells."""

    center: Float[AnyArray, "3"]
    radius: Float[AnyScalar, ""]
    discount: Float[AnyArray, "2"]
    neighborhood_radius: Float[AnyScalar, ""]
    num_cells: Int[AnyScalar, ""]


def scores_of(
    motion: Motion,
    matched: Matched,
    frame: Frame,
    terms: tuple[AbstractTerm, ...],
    responding: tuple[AbstractTerm, ...] | None,
) -> Scores:
    """The scores of correspondences at a pose; O = I for surfaces without `noise`.

    `responding` are the terms with their response (`AbstractAdaptiveTerm.with_response`), whose stiffness replaces K O,
    and whose forces replace w M O d. None for terms that do not adapt, and where matches are fixed.
    """
    posed, total, counts = linearize_at(motion, matched, terms)
    moved = posed.moved
    arms = jnp.where(matched.valid, (moved - frame.center[:, None]) / frame.radius, 0)
    bias, cells, stiffness = jnp.zeros(6, moved.dtype), None, total.stiffness
    if matched.source.noise is not None:
        edge = max(term.correlation_length for term in (responding or terms))
        source, target = cast(SurfaceNoise, matched.source.noise), cast(SurfaceNoise, matched.target.noise)
        # In units of the data about their centre, so that cells do not depend on the unit of length or on the origin.
        relative = 0.5 * (source.neighborhood_radius + target.neighborhood_radius) / frame.neighborhood_radius
        per_radius = jnp.maximum(frame.radius / (edge * frame.neighborhood_radius), _LEAST_CELLS)
        # Cell sizes follow the point density, rounded to powers of two.
        level = jnp.round(jnp.log2(jnp.where(matched.valid & (relative > 0), relative, 1)))
        cell = jnp.floor(jnp.where(matched.valid, arms * per_radius / 2.0**level, 0)).astype(jnp.int32)
        cells = cell_numbers((*cell, level.astype(jnp.int32)), frame.num_cells)
    if responding is not None:
        response = linearize_at(motion, matched, responding)[1]
        stiffness, bias = response.stiffness, jnp.sum(_wrench(arms, total.force - response.force), axis=1)
    else:
        if any(term.robust is not None for term in terms):
            # The symmetric part of −∂f/∂(T a), which includes the decrease of w with the residual.
            def force_at(shift: Float[Array, "3"]) -> Float[Array, "3 N"]:
                return linearize(terms, posed._replace(moved=moved + shift[:, None])).force

            zero = jnp.zeros(3, moved.dtype)
            columns = [-counts * jax.jvp(force_at, (zero,), (axis,))[1] for axis in jnp.eye(3, dtype=zero.dtype)]
            stiffness = jnp.stack([0.5 * (columns[j][i] + columns[i][j]) for i in range(3) for j in range(i, 3)])
        if matched.source.noise is not None:
            observable = _discounted_observability(posed, frame.discount, terms)
            observed_force = alg.multiply(total.stiffness, alg.multiply(observable, total.residual))
            bias = jnp.sum(_wrench(arms, total.force - observed_force), axis=1)
            if all(term.matches_slide for term in terms):
                stiffness = alg.symmetric_product(stiffness, observable)
    jacobian = moments_of(stiffness, arms * frame.radius)
    return Scores(_wrench(arms, total.force).T, matched.valid.astype(moved.dtype), cells, jacobian, bias)


def _discounted_observability(
    posed: PosedMatches, discount: Float[Array, "2"], terms: tuple[AbstractTerm, ...]
) -> Float[Array, "6 n"]:
    fractions = observability(posed, terms, np.bool_(True))
    # Of cells alone the mean is biased, see `observability`.
    slide = all(term.matches_slide for term in terms)
    observable = discount[0] * fractions["observability" if slide else "common"]
    channels = fractions.get("channel_observability")
    if channels is not None:
        # Their agreement is unbiased only for matches that are nearest in position.
        if all(term.by_position for term in terms):
            channels = fractions.get("agreement", channels)
        # A / (1 + tr A) with A multiplied by the discount.
        trace = channels[0] + channels[3] + channels[5]
        observable = observable + discount[1] * channels / (1 - (1 - discount[1]) * jnp.clip(trace, 0, 1))
    return observable


def _wrench(arms: Float[Array, "3 N"], force: Float[Array, "3 N"]) -> Float[Array, "6 N"]:
    return jnp.concatenate([force, jnp.cross(arms, force, axis=0)])


class Moments(NamedTuple):
    """Sums over the scores of all correspondences.

    Attributes:
        jacobian, bias: see `Scores`.
        scatter: Σ_c u_c u_cᵀ.
        num_cells: number of cells with valid correspondences.
        rounding: covariance of positions since coordinates are rounded to coarse steps, metres².
    """

    jacobian: Float[AnyArray, "6 4 4"]
    bias: Float[AnyArray, "6"]
    scatter: Float[AnyArray, "6 6"]
    num_cells: Int[AnyArray, ""]
    rounding: Float[AnyArray, "3 3"] = np.zeros((3, 3))


def moments_from(scores: Scores, num_cells: int) -> Moments:
    xp = numpy_for(scores)
    rows = xp.concatenate([scores.wrenches, scores.valid[:, None]], axis=1)
    if scores.cells is not None and xp is np:
        rows = np.stack([np.bincount(scores.cells, column, num_cells) for column in rows.T], axis=1)
    elif scores.cells is not None:
        # Row-major, so that one scatter adds seven numbers. Rows out of bounds, which do not count, are left out: GPUs
        # would add all of them to the same cell, one after the other.
        cells = jnp.where(scores.valid > 0, scores.cells, num_cells)
        rows = jnp.zeros_like(rows, shape=(num_cells, 7)).at[cells].add(rows, mode="drop")
    sums, counts = rows[:, :6], rows[:, 6]
    product = sums.T @ sums if xp is np else jnp.dot(sums.T, sums, precision="highest")
    return Moments(scores.jacobian, scores.bias, product, xp.sum(counts > 0, dtype=np.int32))


def response_and_scatter(moments: Moments, radius: Float[Array, ""]) -> tuple[Float[Array, "6 6"], Float[Array, "6 6"]]:
    """A and the covariance B of the score, lengths in units of the radius; B is NaN with six cells or fewer."""
    response = twist_form(moments.jacobian, radius) * radius
    # Small-sample correction: the pose takes six of the cells' degrees of freedom.
    count = moments.num_cells.astype(response.dtype)
    correction = count / jnp.where(count > 6, count - 6, jnp.nan)
    # A rotation moves points across its axis.
    turning = (jnp.trace(moments.rounding) * np.eye(3) - moments.rounding) / 2
    rounding = jax.scipy.linalg.block_diag(moments.rounding, turning).astype(response.dtype) / radius**2
    scatter = moments.scatter * correction + jnp.outer(moments.bias, moments.bias)
    return response, scatter + response @ rounding @ response.T


def sandwich(
    pose: jaxlie.SE3,
    center: Float[Array, "3"],
    radius: Float[Array, ""],
    moments: Moments,
    directions: Directions | None,
) -> Float[Array, "6 6"]:
    """(6, 6) covariance of ξ = (v, ω) in T exp(ξ), metres and radians; NaN with six cells or fewer."""
    response, scatter = response_and_scatter(moments, radius)
    basis, constrained = jnp.eye(6, dtype=scatter.dtype), jnp.ones(6, bool)
    if directions is not None:
        basis, constrained = jnp.asarray(directions.twists).T, jnp.asarray(directions.constrained)
    both = jnp.outer(constrained, constrained)
    response = jnp.where(both, basis.T @ response @ basis, jnp.diag(1.0 * ~constrained))
    scatter = jnp.where(both, basis.T @ scatter @ basis, jnp.diag(UNKNOWN**2 * ~constrained))
    # A single LAPACK call: two batched ones at once can deadlock.
    inverse = jnp.linalg.inv(response)
    covariance = basis @ inverse @ scatter @ inverse.T @ basis.T
    change = adjoint_to_source(pose, center) * units(radius)
    covariance = change @ covariance @ change.T
    return 0.5 * (covariance + covariance.T)
