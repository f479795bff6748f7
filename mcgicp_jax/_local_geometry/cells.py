"""The surface in voxel cells, from their own covariances: their neighbours are other cells."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import AnyScalar, numpy_for
from mcgicp_jax._local_geometry.local_geometry import LocalGeometry
from mcgicp_jax._local_geometry.observability import geometry_observability
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.statistics import median, sampled_rows

# Squared edge of a cell over the trace of its covariance, for a uniformly filled square: the trace is 2 edge²/12.
_SQUARE_EDGE = 6.0
# Assumed number of points from which the normal of a cell was estimated: the size of a neighbourhood.
_COUNT = 20


def cell_edge(cells: PointCloud) -> Float[AnyScalar, ""]:
    """The median edge of the cells, metres. (The median distance of cells may be smaller: where a plane lies between
    two layers of voxels, cells are close together.)"""
    xp = numpy_for(cells)
    rows, counts = sampled_rows(xp.asarray(cells.valid))
    traces = xp.trace(xp.asarray(cells.covariances)[rows], axis1=1, axis2=2)
    return median(xp.where(counts, xp.sqrt(_SQUARE_EDGE * traces), xp.nan))


def geometry_of_cells(local: LocalGeometry, given: Float[Array, "6 n"], num_candidates: int) -> LocalGeometry:
    """Local geometry of cells: channel fits from their neighbourhoods, everything else from their covariances.

    Args:
        local: of the neighbourhoods.
        given: covariances of the cells, metres².
        num_candidates: number of cells matched with each point or cell.
    """
    given = jax.lax.stop_gradient(given)
    normal = alg.smallest_eigenvector(given)
    across = alg.inner(normal, alg.multiply(given, normal))
    count = jnp.full_like(across, _COUNT)
    return LocalGeometry(
        covariance=given.T,
        normal=normal.T,
        observability=geometry_observability(given, normal, count).T,
        roughness=across,
        reach=0.5 * jnp.sqrt(num_candidates * _SQUARE_EDGE * (given[0] + given[3] + given[5])),
        fits=local.fits,
    )
