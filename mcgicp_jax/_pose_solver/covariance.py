"""Covariance of a pose, from the scatter of the scores (force and torque) of its correspondences.

The sandwich estimate A⁻¹ (Σ_c u_c u_cᵀ) A⁻ᵀ for the root of g = Σ w JᵀMd (Huber 1967). Scores of neighbouring
correspondences are correlated, since they share targets and covariances, so u_c is the sum of the scores in a cell
about as large as a neighbourhood. A is the Jacobian of g with respect to the pose. When the pose moves, the matches
follow along the surface, so only the observable fraction O of a motion changes the residuals: A = Σ w JᵀMOJ. The rest
of the forces, w M(I − O)d, sums to a bias of nearest-neighbour matching, which enters as one more score. Cells of
`gaussians` stand still instead: A = Σ w JᵀMJ (`matches_slide`). (Including the derivative of M with respect to the
rotation in A changed the result by less than 1 %.)

Three steps: medians over sampled rows (`discounts`), scores of all rows (`scores_of`), and 6×6 algebra (`sandwich`).
The first two work row by row, in blocks or over whole arrays.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, numpy_for
from mcgicp_jax._local_geometry.records import noise_of, normal_of, points_of, reach_of, roughness_of
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.poses import adjoint_to_source, units
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._math.statistics import cell_numbers, median
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pose_solver.degeneracy import Directions
from mcgicp_jax._pose_solver.sums import Matched, forces_at, mean_observability, move_rows, powers
from mcgicp_jax._pose_solver.update import twist_form
from mcgicp_jax._search.base import SearchPoints
from mcgicp_jax._terms.photometric import Term

# Edge of a cell in distances to the farthest neighbour; values from 1 to 4 hardly differ.
_CELL = 2.0
# The same with the photometric term: both points of a correspondence contribute fits over their neighbourhoods. With 2,
# 4 and 8, the squared errors on thirty walls of posters were 2.8, 1.8 and 1.6 times their variance (with half of the
# shift in `_photometric`); with 12, where some walls have few cells, 1.7.
_CELL_OF_FITS = 8.0
# Standard deviation of an unconstrained direction, in radii of the matched points: large beside their extent.
UNKNOWN = 10.0
# Lower bound of the factors that reduce observability, dimensionless: medians of few rows may be 0.
_LEAST_FRACTION = 0.2
# Medians of the square of a standard normal variate, and of the mean of two such squares.
_MEDIAN_SQUARE, _MEDIAN_MEAN_OF_TWO = 0.455, 0.693


class Details(NamedTuple):
    """Rows of `Surface.details` of both sides of n correspondences."""

    source: Float[AnyArray, "n 6"]
    target: Float[AnyArray, "n 6"]


def discount_rows(
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    matched: Matched,
    details: Details,
    source: SearchPoints,
    target: SearchPoints,
) -> Float[Array, "n 3"]:
    """Per match, the statistics whose medians `discounts` takes; NaN where there is no match.

    Args:
        source, target: matched rows with descriptors; channels that a point lacks invalidate the third column.

    Returns:
        Columns: squared residual along the normal, metres²; its variance expected from roughness, metres²; squared
        descriptor difference divided by its variance expected from channel noise.
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
    # A quotient per match rather than one of medians: noise is higher at edges.
    quotient = jnp.sum(difference * difference, axis=1) / jnp.where(noise > 0, noise, jnp.nan)
    columns = (jnp.where(matched.valid, seen, jnp.nan), jnp.where(matched.valid, expected, jnp.nan))
    return jnp.stack([*columns, jnp.where(complete, quotient, jnp.nan)], axis=1)


def discounts(rows: Float[AnyArray, "n 3"], num_channels: Int[AnyScalar, ""]) -> Float[AnyArray, "2"]:
    """(2,) factors, 0.2 to 1, by which observability must be reduced: of the geometry and of the channels.

    On a rough surface the nearest neighbour is one whose height resembles that of the point. If the heights of matches
    are b = βa + e with equal roughness on both sides, the variance of b − a is 1 − β times the sum of both roughnesses,
    and when the point moves, its match follows by β of the motion: so 1 − β is both the ratio of observed to expected
    variance, estimated here, and the observable fraction. The same holds for noisy channels. Medians, since the plane
    fits fail at edges.

    Args:
        rows: from `discount_rows`.
        num_channels: number of channels with a nonzero weight α.
    """
    xp = numpy_for(rows, num_channels)
    seen, expected, quotient = median(xp.asarray(rows).T)
    geometry = (seen / _MEDIAN_SQUARE) / (xp.where(expected > 0, expected, xp.nan) / _MEDIAN_MEAN_OF_TWO)
    # Divided by the median of χ²/C with C degrees of freedom, after Wilson & Hilferty 1931.
    channels = quotient / (1 - 2 / (9 * xp.maximum(num_channels, 1))) ** 3
    ratios = xp.stack([geometry, channels])
    return xp.where(xp.isfinite(ratios), xp.clip(ratios, _LEAST_FRACTION, 1), 1).astype(rows.dtype)


class Scores(NamedTuple):
    """Scores of n correspondences, and the sums over them that `sandwich` needs.

    Attributes:
        rows: (n, 7) force, torque (arms in units of the radius), and 1 for valid correspondences or 0.
        cells: (n,) cell number of each; None: every correspondence is a cell of its own.
        jacobian: (6, 10) Σ (K O) ⊗ h hᵀ about the centre, K O symmetrised; K = w M, or the tangent of a robust force.
        bias: (6,) Σ of force and torque of w M(I − O)d; 0 where observability is not known.
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
    responding: Term | None = None,
) -> Scores:
    """The scores of correspondences at a pose.

    Args:
        pose: rotation and translation.
        center, radius: `Sums.center` and `Sums.radius` over all correspondences, metres.
        details: None where observability is not known; then O = I.
        discount: from `discounts`.
        num_cells: size of the hash table of cells.
        responding: estimates from `Term.responding`. With these, the stiffness of the method replaces K O, and its
            forces replace w M O d. None for methods without estimates, and where matches are fixed.
    """
    moved, forces, counts = forces_at(*pose, matched, method, robust)
    arms = jnp.where(matched.valid, (moved - center[:, None]) / radius, 0)
    stiffness = (
        forces.stiffness if robust is None else _tangent_stiffness(pose[0], moved, matched, counts, method, robust)
    )
    bias, cells = jnp.zeros(6, moved.dtype), None
    if details is not None:
        edge = _CELL if responding is None else _CELL_OF_FITS
        size = 0.5 * edge * (reach_of(details.source) + reach_of(details.target))
        cells = _cells(moved, matched.valid, size, num_cells)
    if responding is not None:
        seen = forces_at(*pose, matched, method.with_estimates(responding), robust)[1]
        stiffness, bias = seen.stiffness, jnp.sum(_wrench(arms, forces.force - seen.force), axis=1)
    elif details is not None:
        geometry, *channels = mean_observability(pose[0], matched, method)
        shown = discount[0] * geometry
        for each in channels:
            # A / (1 + tr A) of `channel_observability`, with A multiplied by the discount.
            trace = each[0] + each[3] + each[5]
            shown = shown + discount[1] * each / (1 - (1 - discount[1]) * jnp.clip(trace, 0, 1))
        left_out = forces.force - alg.multiply(forces.stiffness, alg.multiply(shown, forces.residual))
        bias = jnp.sum(_wrench(arms, left_out), axis=1)
        if method.matches_slide:
            stiffness = alg.symmetric_product(stiffness, shown)
    rows = jnp.concatenate([_wrench(arms, forces.force), matched.valid[None].astype(moved.dtype)]).T
    return Scores(rows, cells, jnp.dot(stiffness, powers(arms * radius).T, precision="highest"), bias)


def _wrench(arms: Float[Array, "3 N"], force: Float[Array, "3 N"]) -> Float[Array, "6 N"]:
    """Force and torque of forces acting at the ends of arms."""
    return jnp.concatenate([force, jnp.cross(arms, force, axis=0)])


def _tangent_stiffness(
    rotation: Float[Array, "3 3"],
    moved: Float[Array, "3 N"],
    matched: Matched,
    counts: Float[Array, "N"],
    method: AbstractMethod,
    robust: AbstractKernel,
) -> Float[Array, "6 N"]:
    """−∂f/∂(T a) of robust correspondences, symmetrised: includes the decrease of w with the residual."""

    def force(shift: Float[Array, "3"]) -> Float[Array, "3 N"]:
        shifted = moved + shift[:, None]
        return method.forces(matched.source, matched.target, shifted, rotation, matched.valid, robust).force

    still = jnp.zeros(3, moved.dtype)
    columns = [-counts * jax.jvp(force, (still,), (axis,))[1] for axis in jnp.eye(3, dtype=moved.dtype)]
    return jnp.stack([0.5 * (columns[j][i] + columns[i][j]) for i in range(3) for j in range(i, 3)])


def _cells(
    moved: Float[Array, "3 N"], valid: Bool[Array, "N"], size: Float[Array, "N"], num_cells: Int[AnyScalar, ""]
) -> Int[Array, "N"]:
    """Hash of the cell that contains each point. Cell sizes follow the point density, rounded to powers of two."""
    level = jnp.round(jnp.log2(jnp.where(valid & (size > 0), size, 1)))
    cell = jnp.floor(jnp.where(valid, moved / 2.0**level, 0)).astype(jnp.int32)
    return cell_numbers((*cell, level.astype(jnp.int32)), num_cells)


def scatter_of(scores: Scores, num_cells: int) -> tuple[Float[AnyArray, "6 6"], Int[AnyScalar, ""]]:
    """Σ_c u_c u_cᵀ, and the number of cells that contain valid correspondences."""
    xp = numpy_for(scores)
    rows = scores.rows
    if scores.cells is not None and xp is np:
        columns = [np.bincount(scores.cells, column, num_cells) for column in rows.T]
        rows = np.stack(columns, axis=1)
    elif scores.cells is not None:
        # Row-major, so that one scatter adds seven numbers.
        rows = jnp.zeros_like(rows, shape=(num_cells, 7)).at[scores.cells].add(rows)
    sums = rows[:, :6]
    product = sums.T @ sums if xp is np else jnp.dot(sums.T, sums, precision="highest")
    return product, xp.sum(rows[:, 6] > 0)


class Moments(NamedTuple):
    """Sums over the scores of all correspondences.

    Attributes:
        jacobian, bias: see `Scores`.
        scatter: Σ_c u_c u_cᵀ.
        num_cells: number of cells with valid correspondences.
    """

    jacobian: Float[AnyArray, "6 10"]
    bias: Float[AnyArray, "6"]
    scatter: Float[AnyArray, "6 6"]
    num_cells: Int[AnyArray, ""]


def response_and_scatter(moments: Moments, radius: Float[Array, ""]) -> tuple[Float[Array, "6 6"], Float[Array, "6 6"]]:
    """A and the covariance B of the score, lengths in units of the radius; B is NaN with six cells or fewer."""
    response = twist_form(moments.jacobian, radius) * radius
    # Small-sample correction: the pose takes six of the cells' degrees of freedom.
    count = moments.num_cells.astype(response.dtype)
    correction = count / jnp.where(count > 6, count - 6, jnp.nan)
    return response, moments.scatter * correction + jnp.outer(moments.bias, moments.bias)


def sandwich(
    pose: jaxlie.SE3,
    center: Float[Array, "3"],
    radius: Float[Array, ""],
    moments: Moments,
    directions: Directions | None,
) -> Float[Array, "6 6"]:
    """(6, 6) covariance of ξ = (v, ω) in T exp(ξ), metres and radians; NaN with six cells or fewer."""
    response, scatter = response_and_scatter(moments, radius)
    basis, held = jnp.eye(6, dtype=scatter.dtype), jnp.ones(6, bool)
    if directions is not None:
        basis, held = jnp.asarray(directions.twists).T, jnp.asarray(directions.held)
    both = jnp.outer(held, held)
    response = jnp.where(both, basis.T @ response @ basis, jnp.diag(1.0 * ~held))
    scatter = jnp.where(both, basis.T @ scatter @ basis, jnp.diag(UNKNOWN**2 * ~held))
    # A single LAPACK call: two batched ones at once can deadlock.
    inverse = jnp.linalg.inv(response)
    covariance = basis @ inverse @ scatter @ inverse.T @ basis.T
    change = adjoint_to_source(pose, center) * units(radius)
    covariance = change @ covariance @ change.T
    return 0.5 * (covariance + covariance.T)
