"""How well the surfaces of two clouds coincide at a pose."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._math.poses import rotated
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
    return agreement_of(offsets, (rotated(normals, rotation), other_normals), (thin, other_thin))


def agreement_of(
    offsets: Float[np.ndarray, "n 3"],
    both_normals: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]],
    thicknesses: tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]],
) -> tuple[float, float]:
    """Misfit of matches and agreement of their normals. Offsets and thicknesses are in metres, normals in one frame.

    The misfit is a quantile of the distances along the normals, in thicknesses of the neighbourhoods; the agreement is
    the fraction of normals that agree. Both weigh each direction of surfaces equally, so that the ground does not
    outvote the few surfaces that distinguish a place.
    """
    normals, other_normals = both_normals
    across = [np.abs(np.sum(offsets * axes, axis=1)) for axes in both_normals]
    distances = np.maximum(*across) / np.sqrt(0.5 * np.sum(np.square(thicknesses), axis=0))
    sample = normals[:: -(-len(normals) // _NUM_NORMALS)]
    same = np.abs(np.einsum("ik,jk->ij", sample, normals)) > _SAME_DIRECTION
    # A normal that resembles none of the sample counts as a direction of its own.
    weights = 1 / (1 + np.sum(same, axis=0))
    order = np.argsort(distances, kind="stable")
    cumulative = np.cumsum(weights[order])
    misfit = distances[order[np.searchsorted(cumulative, _QUANTILE * cumulative[-1])]]
    agrees = np.abs(np.sum(normals * other_normals, axis=1)) > _AGREES
    return float(misfit), float(np.sum(weights * agrees) / cumulative[-1])


def spreads(
    points: Float[np.ndarray, "N 3"], neighbors: Any, rows: Int[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """Standard deviations of the neighbourhoods of rows, metres, along the normal and along the surface (the smaller
    one), and the normals. `neighbors` are (N, k) rows, −1 for none."""
    near = neighbors[rows]
    offsets = np.where(near[..., None] >= 0, points[near] - points[rows][:, None], 0)
    offsets -= offsets.mean(axis=1, keepdims=True)
    squares, axes = np.linalg.eigh(offsets.swapaxes(1, 2) @ offsets / near.shape[1])
    thin, along, _ = np.sqrt(np.maximum(squares.T, np.finfo(np.float32).tiny))
    return np.maximum(thin, THINNEST * along), along, axes[:, :, 0]
