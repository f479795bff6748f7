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

# Square of the edge of a cell over the trace of its covariance, if it is a square filled uniformly: 2 edge²/12.
_SQUARE_EDGE = 6.0
# Number of points that the normal of a cell is taken to be estimated from: that of a neighbourhood.
_COUNT = 20


def cell_edge(cells: PointCloud) -> Float[AnyScalar, ""]:
    """The median edge of the cells, metres. (Where a plane lies between two layers of voxels, cells lie close together,
    so that their distance is smaller.)"""
    xp = numpy_for(cells)
    rows, counts = sampled_rows(xp.asarray(cells.valid))
    traces = xp.trace(xp.asarray(cells.covariances)[rows], axis1=1, axis2=2)
    return median(xp.where(counts, xp.sqrt(_SQUARE_EDGE * traces), xp.nan))


def geometry_of_cells(local: LocalGeometry, given: Float[Array, "6 n"], num_candidates: int) -> LocalGeometry:
    """Local geometry of cells: the fits of the channels of their neighbourhoods, and the rest from their covariances.

    Args:
        local: of the neighbourhoods.
        given: covariances of the cells, metres².
        num_candidates: number of cells that a point or cell is matched with.
    """
    given = jax.lax.stop_gradient(given)
    normal = alg.smallest_eigenvector(given)
    across = alg.inner(normal, alg.multiply(given, normal))
    count = jnp.full_like(across, _COUNT)
    return LocalGeometry(
        covariance=given.T,
        normal=normal.T,
        observability=geometry_observability(given, normal, alg.orthonormal_basis(normal), count).T,
        roughness=across,
        reach=0.5 * jnp.sqrt(num_candidates * _SQUARE_EDGE * (given[0] + given[3] + given[5])),
        fits=local.fits,
    )
