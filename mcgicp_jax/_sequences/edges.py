"""Edges of pose graphs from registrations."""

from __future__ import annotations

import numpy as np

from mcgicp_jax._pose_graph.edge import Edge
from mcgicp_jax._registration.result import RegistrationResult, Status

# Least overlap of a registration that becomes an edge: with less, a wrong local minimum looks like a right one.
LEAST_OVERLAP = 0.4
# Ratio of the information along unconstrained directions to that along constrained ones. The directions are known to
# δ = 2 mrad, so that a fraction δ² = 4e-6 of the constrained information leaks into them. With ratios below that, poses
# slide along a corridor to correct millimetres across it. With ratios from 1e-2 on, the edges of a corridor that is 5 %
# too long in the start contradict the loop at its end, which is then rejected. Errors with this loop, in three
# simulated corridors: 134 to 291 mm with 1e-6, 46 to 85 with 1e-5, 6 to 13 with 1e-4, 3 to 5 with 1e-3, 117 from 1e-2.
_UNCONSTRAINED_RATIO = 1e-4


def edge_from(i: int, j: int, result: RegistrationResult, *, uncertain: bool = False) -> Edge | None:
    """The edge that a registration of cloud j to cloud i measures.

    The information matrix is the inverse covariance within the constrained directions, and a small fraction of it along
    the others, so that DEGENERATE registrations contribute as well.

    Returns:
        The edge; None unless the status is CONVERGED or DEGENERATE, the overlap is at least 40 % and the covariance is
        known.
    """
    overlap = float(np.asarray(result.overlap))
    if result.status not in (Status.CONVERGED, Status.DEGENERATE) or overlap < LEAST_OVERLAP:
        return None
    covariance, directions = np.asarray(result.covariance, np.float64), result.directions
    if directions is None or not np.isfinite(covariance).all():
        return None
    held = np.asarray(directions.held)
    # Coordinates along the six directions: the constrained ones do not depend on the others.
    coordinates = np.linalg.inv(np.asarray(directions.twists, np.float64).T)
    inner = (coordinates @ covariance @ coordinates.T)[np.ix_(held, held)]
    if not held.any():
        return None
    # The coordinates are lengths. No registration is more precise than the rounding of the points. The covariance of
    # equal clouds is smaller, or even negative by rounding of its own.
    radius = np.asarray(directions.radius)
    rounding = np.finfo(radius.dtype).eps * float(radius)
    values, vectors = np.linalg.eigh(inner)
    known = np.zeros((6, 6))
    known[np.ix_(held, held)] = (vectors / np.maximum(values, rounding**2)) @ vectors.T
    known[~held, ~held] = _UNCONSTRAINED_RATIO * np.median(np.linalg.eigvalsh(known[np.ix_(held, held)]))
    information = coordinates.T @ known @ coordinates
    return Edge(i, j, result.matrix, 0.5 * (information + information.T), uncertain=uncertain)
