"""Directions that edges do not measure, along which poses stay near the start.

The axes of an edge are only known to its standard deviation σ of rotation, in radians, so that a fraction σ² of its
information leaks into the directions that it does not measure: poses would slide along these by many metres to explain
the noise in the others.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mcgicp_jax._math.poses import inverse
from mcgicp_jax._pose_graph.edge import Edge
from mcgicp_jax._pose_graph.factors import WORLD

# Information below this fraction of an edge's largest is none: it has no weight in comparison with others.
BLIND = 1e-6
# Information about the start, as a multiple of what leaks, and at most as a fraction of that of a typical edge. Largest
# slides in corridors of 3 to 40 poses, with σ = 0.02: 559 m without, 0.8 m with a multiple of 10, 0.4 m with 30 or 100.
_OF_LEAK, _MOST = 30.0, 1e-2


def unmeasured(edges: Edge, poses: Float[np.ndarray, "n 4 4"], typical: Float[np.ndarray, "m 6"]) -> Edge:
    """Edges between the same poses that measure the motions at the start, along unmeasured directions alone.

    Args:
        edges: those of the graph. Priors get no information, since the world's axes are exact.
        poses: at the start.
        typical: `typical_information` of the edges.
    """
    between, roots = edges.i != WORLD, np.sqrt(typical)
    i = np.where(between, edges.i, edges.j)
    values, vectors = np.linalg.eigh(np.nan_to_num(edges.information) / (roots[:, :, None] * roots[:, None]))
    blind = between[:, None] & (values <= BLIND * values[:, -1:])
    some = np.minimum(_OF_LEAK / typical[:, 5:], _MOST)
    scaled = roots[:, :, None] * vectors
    information = (scaled * (blind * some)[:, None]) @ scaled.swapaxes(1, 2)
    return Edge(edges.i, edges.j, inverse(poses[i]) @ poses[edges.j], information)
