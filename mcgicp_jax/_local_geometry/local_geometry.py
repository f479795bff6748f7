"""Local geometry of neighbourhoods (covariance, normal, observability, channel fits), and the surface around each point
that a method makes of it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import csr_array

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.cache import cached_with_cloud
from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, is_concrete, numpy_for
from mcgicp_jax._compute.row_functions import ComputedTable, GivenTable, Input, Moving, Rows, Slopes, over_both
from mcgicp_jax._compute.tables import Packed
from mcgicp_jax._compute.threads import side_by_side
from mcgicp_jax._local_geometry import neighborhoods as nb
from mcgicp_jax._local_geometry.neighborhoods import ChannelFits, Neighborhoods
from mcgicp_jax._local_geometry.observability import geometry_observability, observability_of_halves
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.statistics import median, sampled_rows
from mcgicp_jax._search.base import SearchPoints

# Rank of the neighbour from which roughness is measured (0 is the point itself). The nearest neighbours are biased
# towards similar heights, and the heights of far ones include the curvature of the surface.
_ROUGHNESS_RANK = 5
# Squared edge of a cell over the trace of its covariance, for a uniformly filled square: the trace is 2 edge²/12.
_SQUARE_EDGE = 6.0
# Assumed number of points from which the normal of a cell was estimated: the fewest of a cell by default.
_CELL_POINTS = 6
# Separate arrays per coordinate: in float32, jaxlib 0.10.2 on CPUs miscompiles the reduction of a (3, k, N) array over
# its middle axis where the result is broadcast back and subtracted.
Offsets: TypeAlias = tuple[Float[Array, "k N"], Float[Array, "k N"], Float[Array, "k N"]]


class LocalGeometry(NamedTuple):
    """The shape of the surface around each point, and the slopes of its channels; one row per point.

    All but `covariance` and `normal` are constants to autodiff.

    Attributes:
        covariance: of the neighbours about their mean, metres² (symmetric).
        normal: unit eigenvector of its smallest eigenvalue.
        observability: by the shape of the surface (symmetric), see `_local_geometry.observability`.
        roughness: half the squared height difference along the normal between the point and a neighbour, metres².
        neighborhood_radius: distance to the farthest neighbour, metres.
        fits: linear fits of the channels.
    """

    covariance: Float[AnyArray, "*batch N 6"]
    normal: Float[AnyArray, "*batch N 3"]
    observability: Float[AnyArray, "*batch N 6"]
    roughness: Float[AnyArray, "*batch N"]
    neighborhood_radius: Float[AnyArray, "*batch N"]
    fits: ChannelFits


# Computes the local geometry of some rows of the source and of the target.
Geometries: TypeAlias = Callable[[tuple[Any, Any]], tuple[LocalGeometry, LocalGeometry]]


def local_geometry_of(around: Neighborhoods) -> LocalGeometry:
    offsets, present = offsets_of(around), around.present.astype(around.own.dtype)
    covariance = weighted_covariance(offsets, present)
    fixed, count = jax.lax.stop_gradient(offsets), jnp.sum(present, axis=0)
    # Covariances of two halves: every second neighbour, from the first and from the second on. About the mean of all,
    # so that the sums over one half and over the other add up to those over all.
    x, y, z = (present * (offset - jnp.sum(offset, axis=0) / jnp.maximum(count, 1)) for offset in fixed)
    rows = (present, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)
    first = jnp.stack([jnp.sum(row[::2], axis=0) for row in rows])
    of_all = [count[None], jnp.zeros_like(first[1:4]), count * jax.lax.stop_gradient(covariance)]
    second = jnp.concatenate(of_all) - first
    means = [sums[1:] / jnp.maximum(sums[0], 1) for sums in (first, second)]
    halves = [mean[3:] - alg.outer(mean[:3]) for mean in means]
    counts = jnp.concatenate([count, first[0], second[0]])
    # One array of whole neighbourhoods and halves compiles faster than three. Without the barriers, XLA would compile
    # the computation of the array again for each use.
    covariances = jax.lax.optimization_barrier(jnp.concatenate([covariance, *halves], axis=1))
    normals = jax.lax.optimization_barrier(alg.smallest_eigenvector(covariances))
    size = covariance.shape[1]
    normal = normals[:, :size]
    fixed_normal, covariances, normals = jax.lax.stop_gradient((normal, covariances, normals))
    usable = (counts[size:] >= 3) & ~jnp.tile(around.few, 2)
    basis = alg.orthonormal_basis(fixed_normal)
    rank = min(_ROUGHNESS_RANK, present.shape[0] - 1)
    height = sum(offset[rank] * axis for offset, axis in zip(fixed, fixed_normal, strict=True))
    x, y = (sum(offset * b for offset, b in zip(fixed, axis, strict=True)) for axis in basis)
    return LocalGeometry(
        covariance=covariance.T,
        normal=normal.T,
        observability=observability_of_halves(covariances, normals, counts, usable).T,
        roughness=0.5 * height**2,
        neighborhood_radius=jnp.sqrt(jnp.max(sum(offset * offset for offset in fixed), axis=0)),
        fits=nb.fit_channels(jax.lax.stop_gradient(around), x, y),
    )


def offsets_of(around: Neighborhoods) -> Offsets:
    return around.offset(0), around.offset(1), around.offset(2)


def weighted_covariance(offsets: Offsets, weights: Float[Array, "k N"]) -> Float[Array, "6 N"]:
    """Weighted covariance about the weighted mean; zero where all weights are zero."""
    total = jnp.sum(weights, axis=0)
    weights = weights / jnp.where(total > 0, total, 1)
    x, y, z = (offset - jnp.sum(weights * offset, axis=0) for offset in offsets)
    pairs = ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))
    return jnp.stack([jnp.sum(weights * p * q, axis=0) for p, q in pairs])


def cell_edge(cells: PointCloud) -> Float[AnyScalar, ""]:
    """Median edge of cells, metres; their distance may be less, where a plane lies between two layers of voxels."""
    xp = numpy_for(cells)
    rows, valid = sampled_rows(xp.asarray(cells.valid))
    traces = xp.trace(xp.asarray(cells.covariances)[rows], axis1=1, axis2=2)
    return median(xp.where(valid, xp.sqrt(_SQUARE_EDGE * traces), xp.nan))


def geometry_of_cells(local: LocalGeometry, covariances: Float[Array, "6 n"], num_candidates: int) -> LocalGeometry:
    """Local geometry of cells, `num_candidates` of which are matched with each point or cell: from their covariances,
    metres²; only the channel fits are those of `local`, the geometry of their neighbourhoods."""
    covariances = jax.lax.stop_gradient(covariances)
    normal = alg.smallest_eigenvector(covariances)
    across = alg.inner(normal, alg.multiply(covariances, normal))
    area = num_candidates * _SQUARE_EDGE * (covariances[0] + covariances[3] + covariances[5])
    return LocalGeometry(
        covariance=covariances.T,
        normal=normal.T,
        observability=geometry_observability(covariances, normal, jnp.full_like(across, _CELL_POINTS)).T,
        roughness=across,
        neighborhood_radius=0.5 * jnp.sqrt(area),
        fits=local.fits,
    )


def local_geometries(
    source: PointCloud,
    target: PointCloud,
    with_channels: bool,
    rows: tuple[Any, Any] = (None, None),
    num_threads: int | None = 1,
) -> tuple[LocalGeometry, LocalGeometry]:
    """Local geometry of rows (None: all) of two preprocessed clouds; on the host by `num_threads` (None: no limit)."""
    sides = list(zip((source, target), rows, strict=True))
    if is_concrete(source, target):
        calls = [partial(geometry_table(cloud, with_channels).trees, part, num_threads) for cloud, part in sides[::-1]]
        of_target, of_source = side_by_side(calls, num_threads)
    else:
        # A concrete cloud beside a traced one is traced as well, which needs no program of its own.
        inputs = [nb.of_rows(nb.inputs_of_neighbors(cloud, with_channels), part) for cloud, part in sides]
        of_source, of_target = over_both(_geometry, None, *inputs)
    return joined(*of_source), joined(*of_target)


@cached_with_cloud
def geometry_table(cloud: PointCloud, with_channels: bool) -> ComputedTable:
    """Local geometry in two trees, see `joined`."""
    return ComputedTable(_geometry, None, nb.inputs_of_neighbors(cloud, with_channels), cloud.points.shape[0])


def differentiable_geometry(cloud: PointCloud, fixed: PointCloud, with_channels: bool) -> ComputedTable:
    """`geometry_table` of a cloud whose points differentiation may trace; `fixed` is the same cloud, concrete."""
    values = geometry_table(fixed, with_channels)
    covariances = _NeighborCovariances(cloud.points, nb.check_neighbors(fixed, np), values)
    return ComputedTable(_with_normal, None, [Input(covariances)], fixed.points.shape[0], values)


def _geometry(_: None, own: Rows, near: Rows) -> tuple[Any, Any]:
    return separated(local_geometry_of(nb.neighborhoods(own, near)))


def separated(local: LocalGeometry) -> tuple[Any, Any]:
    """Covariance and normal, and what is constant to autodiff, as trees of a row function."""
    return local[:2], local[2:]


def joined(shape: Any, constants: Any) -> LocalGeometry:
    return LocalGeometry(*shape, *constants)


def _with_normal(_: None, covariance: Rows) -> tuple[Any]:
    return ((covariance.tree, alg.smallest_eigenvector(covariance.tree.T).T),)


class _NeighborCovariances(GivenTable):
    """The covariances of neighbourhoods as a table that depends on the points; values are those of a geometry table.

    A covariance is Σ w x xᵀ − m mᵀ over the neighbours x, with their mean m = Σ w x. So derivatives are products with
    the sparse matrix of the weights w, in float64; those of a row function of neighbourhoods take five times as long.
    """

    def __init__(self, points: Any, neighbors: Any, values: ComputedTable):
        super().__init__(points)
        self._neighbors, self._values = neighbors, values
        self._points = self._packed[0].table.astype(np.float64)

    def computed(self, rows: Any = None, num_threads: int | None = 1) -> tuple[Packed, ...]:
        covariance, _ = self._values.computed(rows, num_threads)[0].tree
        return (Packed.of(covariance),)

    def vjp(self, cotangents: Any, moving: Moving, into: Slopes, rows: Any = None) -> None:
        weights, of_means = self._weights_and_slopes_of_means(slice(None) if rows is None else rows)
        slopes = cotangents if rows is None else cotangents[rows]
        sums, by_means = (
            (weights.T @ part.reshape(len(part), -1)).reshape(self.size, *part.shape[1:])
            for part in (slopes, slopes @ of_means)
        )
        by_points = sums @ _slopes_of_products(self._points)
        by_points -= by_means
        super().vjp(by_points, moving, into)

    def jvp(self, tangents: Slopes, rows: Any) -> np.ndarray:
        weights, of_means = self._weights_and_slopes_of_means(rows)
        moved = super().jvp(tangents, slice(None))
        products, means = (
            (weights @ part.reshape(self.size, -1)).reshape(len(of_means), *part.shape[1:])
            for part in (moved @ _slopes_of_products(self._points).swapaxes(1, 2), moved)
        )
        return products - means @ of_means.swapaxes(1, 2)

    def _weights_and_slopes_of_means(self, rows: Any) -> tuple[csr_array, Float[np.ndarray, "n 6 3"]]:
        """(n, N) weights, 1/k for each of the k neighbours of a point, and the derivatives of m mᵀ by m."""
        index = np.asarray(self._neighbors[rows])
        present = index >= 0
        weights = present / np.maximum(present.sum(axis=1, keepdims=True), 1)
        ends = np.arange(0, index.size + 1, index.shape[1])
        matrix = csr_array((weights.ravel(), np.maximum(index, 0).ravel(), ends), shape=(len(index), self.size))
        return matrix, _slopes_of_products(matrix @ self._points)


def _slopes_of_products(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 6 3"]:
    """The derivative of the entries of x xᵀ by x."""
    entries, (i, j) = np.arange(6), np.triu_indices(3)
    slopes = np.zeros((len(vectors), 6, 3))
    slopes[:, entries, i] += vectors[:, j]
    slopes[:, entries, j] += vectors[:, i]
    return slopes


class SurfaceNoise(NamedTuple):
    """Values that only the status and the covariance of the final pose need. `descriptors`: variance of α · channel
    about its linear fits, metres², summed over the channels. `slopes`: gradients of α · channel; None without channels
    and for cells. The others are those of `LocalGeometry`."""

    descriptors: Float[AnyArray, "*batch N"]
    normal: Float[AnyArray, "*batch N 3"]
    roughness: Float[AnyArray, "*batch N"]
    neighborhood_radius: Float[AnyArray, "*batch N"]
    slopes: Float[AnyArray, "*batch N C 3"] | None = None


class Surface(NamedTuple):
    """The points of a cloud with the values that a method needs of each; one row per point.

    Rows come first, so that matched points can be gathered; formulas work on the transposes. Symmetric 3×3 matrices are
    stored as upper triangles.

    Attributes:
        points: positions, metres.
        covariance: result of `AbstractMethod.covariance`.
        observability: by the shape of the surface, see `_local_geometry.observability`; None if not needed.
        channel_observability: by the channels; None if not needed, or if the method does not use channels.
        columns: `AbstractTerm.columns` by name of the term, for terms that define them.
        noise: for the covariance of the pose; None if not needed.
        search: the points as input to the search; None for matched rows where it is not needed.
    """

    points: Float[AnyArray, "*batch N 3"]
    covariance: Float[AnyArray, "*batch N 6"]
    observability: Float[AnyArray, "*batch N 6"] | None
    channel_observability: Float[AnyArray, "*batch N 6"] | None
    columns: dict[str, Any]
    noise: SurfaceNoise | None = None
    search: SearchPoints | None = None

    @property
    def num_points(self) -> int:
        return self.points.shape[-2]

    @property
    def observed(self) -> bool:
        return self.observability is not None

    @property
    def observes_channels(self) -> bool:
        return self.channel_observability is not None


def searched(surface: Surface) -> SearchPoints:
    if surface.search is None:
        raise ValueError("surface: expected one with the input of the search")
    return surface.search
