"""Voxel Gaussians: clouds of cells, each with the mean and the covariance of the points in it."""

from __future__ import annotations

from types import ModuleType
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax import _algebra as alg
from mcgicp_jax._checks import check_integer, check_positive, is_number
from mcgicp_jax._cloud import PointCloud, Values
from mcgicp_jax._methods import GICP
from mcgicp_jax._pose import AnyArray
from mcgicp_jax._preprocess import MIN_POINTS, finite_rows, preprocess, voxels
from mcgicp_jax._surfaces import covariances_of

# Fewest points in a cell, and smallest ratio of its eigenvalues: those of the Point Cloud Library.
_MIN_POINTS, _MIN_RATIO = 6, 0.01
# Smallest standard deviation of the points in a cell, in voxels. Some scanners report each beam without an echo as a
# point at the origin; such a cell is no surface.
_LEAST_EXTENT = 1e-4


def gaussians(
    cloud: PointCloud | Values,
    voxel_size: float,
    *,
    min_points: int = _MIN_POINTS,
    min_ratio: float = _MIN_RATIO,
    channel_size: Values | None = None,
    of: Literal["points", "covariances"] = "points",
) -> PointCloud:
    """Replace the points of each voxel by one Gaussian: their mean position and channels, and a covariance.

    The result is the input of `NDT` and `D2DNDT`, or with `of="covariances"` that of voxelised GICP (Koide et al.
    2021). Runs on the host, in float64.

    Args:
        cloud: raw or preprocessed cloud, or (N, 3) array in metres, of all points: not downsampled.
        voxel_size: edge of a voxel, metres.
        min_points: cells with fewer points are left out, as are those whose points coincide; at least 3.
        min_ratio: eigenvalues of a covariance below this fraction of its largest one are raised to it, so that the
            cells of planes and lines are kept; 0 to 1.
        channel_size: splits each voxel by its channels into cells of this size, in channel units, one number or one per
            channel (infinity: not by this one); then each Gaussian has one colour, as in the NDT of Huhle & Magnusson
            (2008). The points of a cell have or lack the same channels. None: one cell per voxel.
        of: "points": the covariance of the points (m², n − 1). "covariances": the mean of the covariances of the
            points, dimensionless: those given with the cloud, or GICP's.

    Returns:
        Preprocessed cloud with one point per cell, and its covariances.

    Raises:
        ValueError: if an argument is out of range, the cloud is traced, or fewer than four cells are left.
    """
    if of not in ("points", "covariances"):
        raise ValueError(f'of: expected "points" or "covariances", got {of!r}')
    if not (is_number(min_ratio) and 0 <= min_ratio <= 1):
        raise ValueError(f"min_ratio: expected a number from 0 to 1, got {min_ratio!r}")
    cloud = finite_rows(cloud)
    if of == "covariances" and cloud.covariances is None:
        cloud = cloud.replace(covariances=covariances_of(GICP(), preprocess(cloud)).astype(cloud.points.dtype))
    cells, kept, means, spread = _grouped(cloud, voxel_size, min_points, channel_size)
    if kept.sum() < MIN_POINTS:
        raise ValueError(
            f"voxel_size: expected a size that leaves at least {MIN_POINTS} cells of {min_points} points, got "
            f"{voxel_size} m, which leaves {kept.sum()}"
        )
    if of == "covariances":
        matrices = cells.mean(np.asarray(cloud.covariances, np.float64).reshape(-1, 9))[kept].reshape(-1, 3, 3)
    else:
        matrices = _floored(spread[kept], min_ratio)
    known = np.ones(cloud.channels.shape, bool) if cloud.channel_valid is None else np.asarray(cloud.channel_valid)
    # Missing values are stored as 0 and do not add to the sum.
    counts = cells.sum(known.astype(np.float64))[kept]
    channels = cells.sum(np.asarray(cloud.channels, np.float64))[kept] / np.maximum(counts, 1)
    dtype = cloud.points.dtype
    return preprocess(
        PointCloud(
            means[kept].astype(dtype),
            channels.astype(dtype),
            channel_valid=None if cloud.channel_valid is None else counts > 0,
            covariances=matrices.astype(dtype),
            channel_names=cloud.channel_names,
        )
    )


def voxel_cells(
    cloud: PointCloud | Values,
    voxel_size: float,
    *,
    min_points: int = _MIN_POINTS,
    channel_size: Values | None = None,
) -> Int[np.ndarray, "N"]:
    """The cell of each point, as `gaussians` numbers its cells; input of `cell_moments`.

    Args:
        cloud: cloud of finite points, or (N, 3) array in metres.
        voxel_size, min_points, channel_size: as in `gaussians`.

    Returns:
        (N,) numbers from 0; −1 for points in cells that are left out.

    Raises:
        ValueError: if an argument is out of range.
    """
    cloud = cloud if isinstance(cloud, PointCloud) else PointCloud(cloud)
    cells, kept, _, _ = _grouped(cloud, voxel_size, min_points, channel_size)
    return np.where(kept, np.cumsum(kept) - 1, -1)[cells.number].astype(np.int32)


def _grouped(
    cloud: PointCloud, voxel_size: float, min_points: int, channel_size: Values | None
) -> tuple[_Cells, Bool[np.ndarray, "M"], Float[np.ndarray, "M 3"], Float[np.ndarray, "M 6"]]:
    """All cells, which of them are kept, and their moments."""
    check_positive("voxel_size", voxel_size)
    check_integer("min_points", min_points, 3)
    order, starts = voxels(np.ascontiguousarray(cloud.coordinates.T), voxel_size)
    number = np.empty(len(order), np.int64)
    number[order] = np.cumsum(np.bincount(starts, minlength=len(order))) - 1
    if channel_size is not None:
        number = _split(number, cloud, channel_size)
    cells = _Cells(number, np)
    means, spread = cells.moments(cloud.coordinates)
    extended = spread[:, 0] + spread[:, 3] + spread[:, 5] > (_LEAST_EXTENT * voxel_size) ** 2
    return cells, (cells.counts[:, 0] >= min_points) & extended, means, spread


def _split(cells: Int[np.ndarray, "N"], cloud: PointCloud, channel_size: Values) -> Int[np.ndarray, "N"]:
    """Cells split by the channels of their points."""
    sizes = np.asarray(channel_size, np.float64)
    if sizes.shape not in ((), (cloud.channels.shape[1],)) or not np.all(sizes > 0):
        raise ValueError(f"channel_size: expected one positive number, or one per channel, got {channel_size!r}")
    levels = np.floor(np.asarray(cloud.channels, np.float64) / sizes)
    if cloud.channel_valid is not None:
        # NaN is a level of its own, and sorts last.
        levels = np.where(np.asarray(cloud.channel_valid), levels, np.nan)
    for column in levels.T:
        values, level = np.unique(column, return_inverse=True)
        _, cells = np.unique(cells * len(values) + level, return_inverse=True)
    return cells


def cell_moments(
    points: Float[AnyArray, "N 3"],
    channels: Float[AnyArray, "N C"],
    cells: Int[np.ndarray, "N"],
    min_ratio: float = _MIN_RATIO,
) -> tuple[Float[Array, "M 3"], Float[Array, "M C"], Float[Array, "M 3 3"]]:
    """Mean position, mean channels and covariance (m²) of each cell, as in `gaussians`. Pure JAX, differentiable.

    To let gradients reach the points of a cloud, replace `points`, `channels` and `covariances` of its `gaussians` by
    these. The cells are constants.

    Args:
        points, channels: of the cloud; metres and channel units.
        cells: from `voxel_cells`; concrete.
        min_ratio: as in `gaussians`.
    """
    inside = np.flatnonzero(cells >= 0)
    grouped = _Cells(cells[inside], jnp)
    points, channels = (jnp.asarray(array)[inside] for array in (points, channels))
    means, spread = grouped.moments(points)
    symmetric = spread.T
    normal = alg.smallest_eigenvector(symmetric)
    u, v = alg.orthonormal_basis(normal)
    within = alg.project(symmetric, u, v)
    a, b, c = within
    square = 0.25 * (a - c) ** 2 + b * b
    radius = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    least = min_ratio * (0.5 * (a + c) + radius)
    across = jnp.maximum(jnp.sum(normal * alg.multiply(symmetric, normal), axis=0), least)
    raised = alg.embed(alg.floor_eigenvalues(within, least), u, v) + across * alg.outer(normal)
    return means, grouped.mean(channels), alg.matrix_from_symmetric(raised)


class _Cells:
    """The cell number of each point, and sums over the points of each cell by NumPy or JAX."""

    def __init__(self, number: Int[np.ndarray, "n"], xp: ModuleType):
        self._xp = xp
        self.number = number
        self._size = int(number.max(initial=-1)) + 1
        self.counts = np.bincount(number, minlength=self._size)[:, None]

    def sum(self, values: Float[AnyArray, "n D"]) -> Float[AnyArray, "M D"]:
        if self._xp is jnp:
            return jax.ops.segment_sum(values, self.number, self._size)
        sums = [np.bincount(self.number, weights=column, minlength=self._size) for column in values.T]
        return np.stack(sums, axis=1) if sums else np.zeros((self._size, 0))

    def mean(self, values: Float[AnyArray, "n D"]) -> Float[AnyArray, "M D"]:
        return self.sum(values) / self.counts.astype(values.dtype)

    def moments(self, points: Float[AnyArray, "n 3"]) -> tuple[Float[AnyArray, "M 3"], Float[AnyArray, "M 6"]]:
        """Means, and covariances as columns xx, xy, xz, yy, yz, zz. A single pass would lose digits far from zero."""
        means = self.mean(points)
        x, y, z = (points - means[self.number]).T
        products = self._xp.stack([x * x, x * y, x * z, y * y, y * z, z * z], axis=1)
        return means, self.sum(products) / np.maximum(self.counts - 1, 1).astype(points.dtype)


def _floored(symmetric: Float[np.ndarray, "M 6"], min_ratio: float) -> Float[np.ndarray, "M 3 3"]:
    """Matrices whose eigenvalues are at least `min_ratio` times the largest one."""
    values, vectors = np.linalg.eigh(symmetric[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3))
    raised = np.maximum(values, min_ratio * values[:, -1:])
    return np.einsum("mij,mj,mkj->mik", vectors, raised, vectors)
