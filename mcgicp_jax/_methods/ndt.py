"""Normal-distributions transforms: voxel Gaussians, registration to them, and of them to each other."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Shaped

from mcgicp_jax._clouds.point_cloud import PointCloud, Values, as_cloud
from mcgicp_jax._clouds.preprocess import MIN_POINTS, finite_rows, preprocess, with_neighbors
from mcgicp_jax._clouds.voxel_size import NUM_NEIGHBORS
from mcgicp_jax._clouds.voxels import grid_of, voxel_order
from mcgicp_jax._compute.concrete import AnyArray, is_concrete, numpy_for
from mcgicp_jax._compute.linear_maps import averaged
from mcgicp_jax._compute.messages import check_integer, check_positive, is_number
from mcgicp_jax._compute.row_functions import Input, Rows, blockwise
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._local_geometry.local_geometry import LocalGeometry
from mcgicp_jax._local_geometry.neighborhoods import Neighborhoods
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.robust_kernels import AbstractKernel, Welsch, positive_scalar
from mcgicp_jax._methods.base import AbstractGeneralized, AbstractMethod, AbstractOneSided, identity
from mcgicp_jax._methods.icp import GICP, ColorICP
from mcgicp_jax._methods.surfaces import covariances_of
from mcgicp_jax._terms.base import AbstractTerm, Mahalanobis

# Smallest number of points in a cell, and smallest ratio of its eigenvalues, as in the Point Cloud Library.
_MIN_POINTS, _MIN_RATIO = 6, 0.01
# Smallest standard deviation of the points in a cell, in voxels. Some scanners report each beam without an echo as a
# point at the origin; such a cell is no surface.
_MIN_EXTENT = 1e-4
# Scale k of the kernel, standard deviations. The usual score is −exp(−d₂ s²/2), so that k² = 2/d₂; Magnusson's formula
# for d₂ (2009), with the usual 55 % of outliers and cells of 1 m. For cells against cells: Constants in
# `tests/benchmarks/README.md`.
_SCALE = 2.15
# Number of the target's cells that a cell is matched with: the voxels of the two clouds are not aligned, and the pose
# follows the nearest cells of the other grid (60 mm with one on KITTI, 14 with 4 or 7). Points need one.
_NUM_CANDIDATES = 4


@overload
def voxel_gaussians(
    cloud: PointCloud | Values,
    voxel_size: float,
    *,
    min_points: int = ...,
    min_ratio: float = ...,
    channel_size: Values | None = ...,
    of: Literal["points", "covariances"] = ...,
    return_counts: Literal[False] = ...,
) -> PointCloud: ...


@overload
def voxel_gaussians(
    cloud: PointCloud | Values,
    voxel_size: float,
    *,
    min_points: int = ...,
    min_ratio: float = ...,
    channel_size: Values | None = ...,
    of: Literal["points", "covariances"] = ...,
    return_counts: Literal[True],
) -> tuple[PointCloud, Int[np.ndarray, "M"]]: ...


@with_settings_of_package
def voxel_gaussians(
    cloud: PointCloud | Values,
    voxel_size: float,
    *,
    min_points: int = _MIN_POINTS,
    min_ratio: float = _MIN_RATIO,
    channel_size: Values | None = None,
    of: Literal["points", "covariances"] = "points",
    return_counts: bool = False,
) -> PointCloud | tuple[PointCloud, Int[np.ndarray, "M"]]:
    """Replace the points of each voxel by one Gaussian: their mean position and channels, and a covariance.

    The result is the input of `NDT` and `D2DNDT`, or with `of="covariances"` the input of voxelised GICP (`GICP`; Koide
    et al. 2021). Runs on the host, in float64.

    Args:
        cloud: raw or preprocessed cloud, or (N, 3) array in metres, of all points: not downsampled.
        voxel_size: edge of a voxel, metres. The grid of voxels is turned, differently for each cloud, as in
            `preprocess`: errors of the cells of a plane along the grid are common to all of them.
        min_points: cells with fewer points are left out, as are those whose points coincide; at least 3.
        min_ratio: eigenvalues of a covariance below this fraction of its largest one are raised to it, so that the
            cells of planes and lines are kept; 0 to 1.
        channel_size: splits each voxel by its channels into cells of this size, in channel units: one number, or one
            per channel (infinity: no split by this channel). Each Gaussian then has one colour, as in the NDT of Huhle
            & Magnusson (2008). All points of a cell have the same channels. None: one cell per voxel.
        of: "points": sample covariance of the points, m². "covariances": mean of the covariances of the points, either
            given with the cloud or GICP's; dimensionless.
        return_counts: also return the number of points in each cell.

    Returns:
        Preprocessed cloud with one point and one covariance per cell. With `return_counts`, a tuple of this cloud and
        the number of points of each cell, (M,) integers.

    Raises:
        ValueError: if an argument is out of range, the cloud is traced, or fewer than four cells are left.
    """
    if of not in ("points", "covariances"):
        raise ValueError(f'of: expected "points" or "covariances", got {of!r}')
    if not (is_number(min_ratio) and 0 <= min_ratio <= 1):
        raise ValueError(f"min_ratio: expected a number from 0 to 1, got {min_ratio!r}")
    cloud = finite_rows(cloud)
    if of == "covariances" and cloud.covariances is None:
        covariances = covariances_of(GICP(), with_neighbors(cloud, None, NUM_NEIGHBORS))
        cloud = cloud.replace(covariances=covariances.astype(cloud.points.dtype))
    cells = _Cells(cloud, voxel_size, min_points, channel_size)
    kept, dtype = cells.kept, cloud.points.dtype
    if kept.sum() < MIN_POINTS:
        raise ValueError(
            f"voxel_size: expected a size that leaves at least {MIN_POINTS} cells of {min_points} points, got "
            f"{voxel_size} m, which leaves {kept.sum()}"
        )
    if of == "covariances":
        matrices = (cells.sum(np.asarray(cloud.covariances).reshape(-1, 9)) / cells.counts).T.reshape(-1, 3, 3)[kept]
    else:
        values, vectors = np.linalg.eigh(cells.spread[:, kept][[0, 1, 2, 1, 3, 4, 2, 4, 5]].T.reshape(-1, 3, 3))
        raised = np.maximum(values, min_ratio * values[:, -1:])
        matrices = (vectors * raised[:, None]) @ vectors.swapaxes(1, 2)
    counts = cells.counts if cloud.channel_valid is None else cells.sum(cloud.channel_valid)
    # Missing values are stored as 0 and do not add to the sum.
    channels = cells.sum(cloud.channels) / np.maximum(counts, 1)
    gaussians = preprocess(
        PointCloud(
            cells.means[:, kept].T.astype(dtype),
            channels[:, kept].T.astype(dtype),
            channel_valid=None if cloud.channel_valid is None else counts[:, kept].T > 0,
            covariances=matrices.astype(dtype),
            channel_names=cloud.channel_names,
        )
    )
    return (gaussians, cells.counts[kept]) if return_counts else gaussians


def voxel_cells(
    cloud: PointCloud | Values, voxel_size: float, *, min_points: int = _MIN_POINTS, channel_size: Values | None = None
) -> Int[np.ndarray, "N"]:
    """The cell of each point, as `voxel_gaussians` numbers its cells; input of `cell_moments`.

    Args:
        cloud: cloud of finite points, or (N, 3) array in metres.
        voxel_size, min_points, channel_size: as in `voxel_gaussians`.

    Returns:
        (N,) numbers from 0; −1 for points in cells that are left out.

    Raises:
        ValueError: if an argument is out of range.
    """
    cells = _Cells(as_cloud("cloud", cloud), voxel_size, min_points, channel_size)
    number = np.empty(len(cells.order), np.int32)
    number[cells.order] = np.repeat(np.where(cells.kept, np.cumsum(cells.kept) - 1, -1), cells.counts)
    return number


class _Cells:
    """The points of a cloud sorted by cell, and the moments of each cell.

    Attributes:
        order: (N,) point numbers, sorted by cell.
        counts: (M,) number of points in each cell.
        kept: (M,) False for cells that are left out.
        means, spread: (3, M), and (6, M) covariances as rows xx, xy, xz, yy, yz, zz.
    """

    def __init__(self, cloud: PointCloud, voxel_size: float, min_points: int, channel_size: Values | None):
        check_positive("voxel_size", voxel_size)
        check_integer("min_points", min_points, 3)
        points = np.asarray(cloud.coordinates if np.any(cloud.origin) else cloud.points)
        # Working by columns takes a third of the time of working by rows.
        points = np.ascontiguousarray(points.T, np.float64)
        self.order, self._starts = voxel_order(grid_of(points.T).columns, voxel_size)
        if channel_size is not None:
            # Splits each voxel by the levels of its channels.
            sizes = np.asarray(channel_size, np.float64)
            if sizes.shape not in ((), (cloud.channels.shape[1],)) or not np.all(sizes > 0):
                expected = "one positive number, or one per channel"
                raise ValueError(f"channel_size: expected {expected}, got {channel_size!r}")
            levels = np.floor(np.asarray(cloud.channels, np.float64)[self.order] / sizes)
            if cloud.channel_valid is not None:
                # Points that lack a channel get a level of their own.
                levels = np.where(np.asarray(cloud.channel_valid)[self.order], levels, -np.inf)
            columns = [np.cumsum(np.bincount(self._starts, minlength=len(self.order))), *levels.T]
            by_cell = np.lexsort(columns[::-1])
            changes = np.any([column[by_cell][1:] != column[by_cell][:-1] for column in columns], axis=0)
            self.order, self._starts = self.order[by_cell], np.flatnonzero(np.append(True, changes))
        self.counts = np.diff(self._starts, append=len(self.order))
        points = np.take(points, self.order, axis=1)
        self.means = np.add.reduceat(points, self._starts, axis=1) / self.counts
        x, y, z = points - np.repeat(self.means, self.counts, axis=1)
        products = np.stack([x * x, x * y, x * z, y * y, y * z, z * z])
        self.spread = np.add.reduceat(products, self._starts, axis=1) / np.maximum(self.counts - 1, 1)
        extended = self.spread[[0, 3, 5]].sum(axis=0) > (_MIN_EXTENT * voxel_size) ** 2
        self.kept = (self.counts >= min_points) & extended

    def sum(self, rows: Shaped[AnyArray, "N D"]) -> Float[np.ndarray, "D M"]:
        columns = np.ascontiguousarray(np.asarray(rows).T, np.float64)
        return np.add.reduceat(np.take(columns, self.order, axis=1), self._starts, axis=1)


@with_settings_of_package
def cell_moments(
    points: Float[AnyArray, "N 3"],
    channels: Float[AnyArray, "N C"],
    cells: Int[np.ndarray, "N"],
    min_ratio: float = _MIN_RATIO,
) -> tuple[Float[AnyArray, "M 3"], Float[AnyArray, "M C"], Float[AnyArray, "M 3 3"]]:
    """Mean position, mean channels and covariance (m²) of each cell, as in `voxel_gaussians`; differentiable.

    To let gradients reach the points of a cloud, replace `points`, `channels` and `covariances` of its
    `voxel_gaussians` by these. The cells are constants.

    Args:
        points, channels: of the cloud; metres and channel units.
        cells: from `voxel_cells`; concrete.
        min_ratio: as in `voxel_gaussians`.

    Raises:
        ValueError: if the shape or dtype of an array is wrong, or `cells` is traced.
    """
    if not is_concrete(cells):
        raise ValueError("cells: expected concrete integers, got tracers")
    points, channels, cells = (numpy_for(rows).asarray(rows) for rows in (points, channels, cells))
    count = len(points) if points.ndim else 0
    for name, array, fits, kind in (
        ("points: expected (N, 3) numbers", points, points.shape == (count, 3), np.number),
        (f"channels: expected ({count}, C) numbers", channels, channels.shape[:-1] == (count,), np.number),
        (f"cells: expected ({count},) integers", cells, cells.shape == (count,), np.integer),
    ):
        if not (fits and jnp.issubdtype(array.dtype, kind)):
            raise ValueError(f"{name}, got {array.dtype} of shape {array.shape}")
    dtype = jax.dtypes.canonicalize_dtype(np.result_type(points.dtype, np.float32))
    points, channels = points.astype(dtype), channels.astype(dtype)
    means, counts = averaged(points, cells), np.bincount(cells[cells >= 0])
    # In two passes: one would lose digits far from zero.
    (products,) = blockwise(_products, (), Input(points), Input(means, cells))
    unbiased = (counts / np.maximum(counts - 1, 1)).astype(points.dtype)
    (covariances,) = blockwise(_raised, min_ratio, Input((averaged(products, cells), unbiased)))
    return means, averaged(channels, cells), covariances


def _products(_: Any, own: Rows, mean: Rows) -> tuple[Float[Array, "n 6"]]:
    return (alg.outer((own.tree - mean.tree).T).T,)


def _raised(min_ratio: Any, own: Rows) -> tuple[Float[Array, "n 3 3"]]:
    """Covariances of cells from their mean products, with eigenvalues of at least `min_ratio` times the largest."""
    symmetric, unbiased = own.tree
    symmetric = symmetric.T * unbiased
    normal = alg.smallest_eigenvector(symmetric)
    u, v = alg.orthonormal_basis(normal)
    within = alg.project(symmetric, u, v)
    a, b, c = within
    square = 0.25 * (a - c) ** 2 + b * b
    radius = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    floor = min_ratio * (0.5 * (a + c) + radius)
    across = jnp.maximum(jnp.sum(normal * alg.multiply(symmetric, normal), axis=0), floor)
    raised = alg.embed(alg.floor_eigenvalues(within, floor), u, v) + across * alg.outer(normal)
    return (alg.matrix_from_symmetric(raised),)


class AbstractNDT(AbstractMethod):
    """Methods for clouds of `voxel_gaussians`, whose covariances are in m².

    Attributes:
        scale: k of the Welsch kernel, in standard deviations, if `register` is not given another kernel; None: none.
    """

    scale: Float[Array, ""] | None

    def covariance(self, around: Neighborhoods, local: LocalGeometry | None) -> Float[Array, "6 n"]:
        """The covariances given with the cloud."""
        return identity(around) if around.given_covariance is None else around.given_covariance

    def terms(
        self, source: PointCloud, target: PointCloud, robust: AbstractKernel | None, equalize_channels: bool
    ) -> tuple[AbstractTerm, ...]:
        if robust is None and self.scale is not None:
            robust = Welsch(self.scale)
        return (Mahalanobis(self, robust=robust),)


class NDT(AbstractNDT, AbstractOneSided):
    """Normal-distributions transform (Biber & Strasser 2003; Magnusson 2009): points against cells, M = C⁻¹.

    C is the covariance of the target's cell, from `voxel_gaussians`. Each point is matched to the nearest cell: the sum
    over several cells takes longer and is no more accurate. With `voxel_sizes`, all registrations but the last are by
    `GICP`.

    Args:
        scale: k of the Welsch kernel, in standard deviations, if `register` is not given another kernel; None: none.
    """

    needs_covariances: ClassVar[tuple[str, ...]] = ("target",)

    def __init__(self, scale: ArrayLike | None = _SCALE):
        """Raises `ValueError` unless `scale` is positive."""
        self.scale = None if scale is None else positive_scalar("scale", scale)

    def information(
        self, target: Float[Array, "6 N"], source: Float[Array, "6 N"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        return alg.inverse(target)


class ColorNDT(NDT, ColorICP):
    """NDT whose matches are nearest in position and channels, as the colour NDT of Huhle & Magnusson (2008).

    For cells of one colour each: `voxel_gaussians` with `channel_size`. With `voxel_sizes`, a cell extends as far in
    α · channel as in position.

    Args:
        channel_weights, missing_variance: as of `ColorICP`.
        scale: as of `NDT`.
    """

    def __init__(
        self, channel_weights: Values, scale: ArrayLike | None = _SCALE, missing_variance: Values | None = None
    ):
        """Raises `ValueError` as `ColorICP` and `NDT` do."""
        ColorICP.__init__(self, channel_weights, missing_variance)
        NDT.__init__(self, scale)


class D2DNDT(AbstractNDT, AbstractGeneralized):
    """Distribution-to-distribution NDT (Stoyanov et al. 2012): cells against cells, M = (C^B + R C^A Rᵀ)⁻¹.

    The cost of a cell is the sum over the nearest cells of the target, each with its own weight.

    Args:
        scale: k of the Welsch kernel, in standard deviations, if `register` is not given another kernel; None: none.
        num_candidates: number of cells of the target that are matched with each cell of the source.
    """

    needs_covariances: ClassVar[tuple[str, ...]] = ("source", "target")
    num_candidates: int = eqx.field(static=True)  # type: ignore[misc]

    def __init__(self, scale: ArrayLike | None = _SCALE, num_candidates: int = _NUM_CANDIDATES):
        """Raises `ValueError` unless `scale` is positive and `num_candidates` at least 1."""
        check_integer("num_candidates", num_candidates, 1)
        self.scale = None if scale is None else positive_scalar("scale", scale)
        self.num_candidates = num_candidates
