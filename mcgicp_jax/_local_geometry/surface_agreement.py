"""How well the surfaces of two clouds coincide at a pose."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, numpy_for
from mcgicp_jax._math.poses import rotated
from mcgicp_jax._math.statistics import sampled_rows
from mcgicp_jax._search.kd_tree import nearest_in_position

# Least thickness of a neighbourhood, as a fraction of its standard deviation along the surface: √ε of GICP. Planes
# without noise have the thickness 0, by which the misfit would be rounding.
THINNEST = 0.032
# Numbers of points that are compared, and of normals by which directions of surfaces are counted. Twice as many points
# cost 2 % of the time of `global_pose`.
_SAMPLE, _NUM_NORMALS = 2048, 400
# Cosines of the largest angles between normals that agree (30°) and that count as one direction (26°).
_AGREES, _SAME_DIRECTION = 0.866, 0.9
# Quantile of the distances that is the misfit. A median would not do: in two different streets or rooms, most surfaces
# coincide by their ground and walls alone.
_QUANTILE = 0.9


def surface_agreement(
    matrix: Float[np.ndarray, "4 4"], source: PointCloud, target: PointCloud, max_distance: float
) -> tuple[float, float]:
    """`agreement_of` preprocessed clouds at a pose, matched within `max_distance`, metres; ∞ and 0 without matches."""
    points, others = (np.asarray(cloud.points, np.float64) for cloud in (source, target))
    count = min(len(points), _SAMPLE)
    rows = np.arange(count) * len(points) // count
    rotation = matrix[:3, :3]
    moved = rotated(points[rows], rotation) + matrix[:3, 3]
    matches = nearest_in_position(moved, target.points, max_distance)
    matched = matches >= 0
    if not matched.any():
        return np.inf, 0.0
    rows, matches, offsets = rows[matched], matches[matched], others[matches[matched]] - moved[matched]
    thin, _, normals = spreads(points, source.deferred_neighbors, rows)
    other_thin, _, other_normals = spreads(others, target.deferred_neighbors, matches)
    both_normals = rotated(normals, rotation), other_normals
    misfit, agreement = agreement_of(offsets, both_normals, (thin, other_thin), matched[matched])
    return float(misfit), float(agreement)


def agreement_of(
    offsets: Float[AnyArray, "n 3"],
    both_normals: tuple[Float[AnyArray, "n 3"], Float[AnyArray, "n 3"]],
    thicknesses: tuple[Float[AnyArray, "n"], Float[AnyArray, "n"]],
    matched: Bool[AnyArray, "n"],
) -> tuple[AnyScalar, AnyScalar]:
    """Misfit of matches and agreement of their normals, which are in one frame; ∞ and 0 if none are `matched`.

    The misfit is a quantile of the distances along the normals, in thicknesses of the neighbourhoods; the agreement is
    the fraction of normals that agree. Both weigh each direction of surfaces equally, so that the ground does not
    outvote the few surfaces that distinguish a place. Offsets and thicknesses are in metres.
    """
    xp = numpy_for(offsets, both_normals, thicknesses, matched)
    normals, other_normals = both_normals
    across = [xp.abs(xp.sum(offsets * axes, axis=1)) for axes in both_normals]
    thickness = xp.sqrt(0.5 * (xp.square(thicknesses[0]) + xp.square(thicknesses[1])))
    distances = xp.where(matched, xp.maximum(*across) / thickness, np.inf)
    rows, counts = sampled_rows(matched, _NUM_NORMALS)
    sample = xp.argsort(~matched, stable=True)[rows]
    same = (xp.abs(xp.einsum("ik,jk->ij", normals[sample], normals)) > _SAME_DIRECTION) & counts[:, None]
    # A normal that resembles none of the sample counts as a direction of its own.
    weights = matched / (1 + xp.sum(same, axis=0))
    order = xp.argsort(distances, stable=True)
    cumulative = xp.cumsum(weights[order])
    misfit = distances[order[xp.searchsorted(cumulative, _QUANTILE * cumulative[-1])]]
    agrees = xp.abs(xp.sum(normals * other_normals, axis=1)) > _AGREES
    return misfit, xp.sum(weights * agrees) / xp.maximum(cumulative[-1], 1e-9)


def spreads(
    points: Float[np.ndarray, "N 3"], neighbors: Any, rows: Int[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Standard deviations of neighbourhoods across and along the surface (the smaller one), metres; and normals."""
    near = neighbors[rows]
    offsets = np.where(near[..., None] >= 0, points[near] - points[rows][:, None], 0)
    offsets -= offsets.mean(axis=1, keepdims=True)
    squares, axes = np.linalg.eigh(offsets.swapaxes(1, 2) @ offsets / near.shape[1])
    thin, along, _ = np.sqrt(np.maximum(squares.T, np.finfo(np.float32).tiny))
    return np.maximum(thin, THINNEST * along), along, axes[:, :, 0]
