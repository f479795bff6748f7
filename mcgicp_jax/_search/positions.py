"""The nearest point in position alone."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from mcgicp_jax._compute.concrete import AnyArray
from mcgicp_jax._search.base import IDENTITY, search_points
from mcgicp_jax._search.kd_tree import KDTreeSearch


def nearest_in_position(
    queries: Float[AnyArray, "N 3"], points: Float[AnyArray, "M 3"], max_distance: float
) -> Int[np.ndarray, "N"]:
    """Row of the point nearest to each query; −1 if none is within `max_distance`, metres. NaN matches nothing."""
    queries, points = np.asarray(queries), np.asarray(points)
    if not len(points):
        return np.full(len(queries), -1, np.int32)
    (nearest,) = KDTreeSearch().index(search_points(points)).nearest(IDENTITY, search_points(queries), max_distance)
    distances = np.linalg.norm(points[nearest] - queries, axis=1)
    return np.where(distances <= max_distance, nearest, -1)
