"""Voxels: cubes of space with a corner at the origin, each with one integer key.

The grid in which a cloud is averaged is turned, differently for each cloud. A plane along a grid cuts all its voxels at
the same place: if these hold few points, their means are biased to one side, by up to half the noise. In parallel
grids, two scans of a surface share this pattern of errors, which favours the pose at which the grids coincide: the
error of the pose was up to twice as large as with different grids, and its covariance did not show it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._math.poses import rotated

# Number of voxels along an axis: three 21-bit indices fit into one 63-bit key.
VOXELS_PER_AXIS = 2**21
# Angles in radians by which grids are turned: `TURN` about the diagonal puts the axes of a grid 48 degrees from those
# of the cloud, along which scenes often lie; up to `VARIATION` about each axis makes grids differ. The axes then come
# no nearer than 18 degrees. Variations of 0.1 to 0.3, and grids of any direction, give the same errors.
TURN, VARIATION = np.pi / 3, 0.3


def voxel_keys(
    points: Float[np.ndarray, "N 3"], voxel_size: float, first: Float[np.ndarray, "3"] | float
) -> Int[np.ndarray, "N"]:
    """Keys counted from the voxel `first`; `ValueError` if a point lies 2²⁰ or more voxels from it along an axis."""
    cells = np.floor(points / voxel_size) - first
    if np.abs(cells).max(initial=0) >= VOXELS_PER_AXIS // 2:
        worst = points[np.argmax(np.abs(cells).max(axis=1))]
        raise ValueError(
            f"the point {worst} lies {np.abs(cells).max():.0f} voxels of {voxel_size:g} m from the first one, expected "
            f"fewer than {VOXELS_PER_AXIS // 2}; leave far points out, or choose a larger voxel_size"
        )
    return _packed(cells + VOXELS_PER_AXIS // 2)


def wrapped_keys(points: Float[np.ndarray, "N 3"], voxel_size: float) -> Int[np.ndarray, "N"]:
    """Keys of the voxels that contain the points, modulo 2²¹ voxels along each axis."""
    return _packed(np.mod(np.floor(points / voxel_size), VOXELS_PER_AXIS))


def _packed(cells: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, "N"]:
    """One key of three indices in [0, 2²¹)."""
    x, y, z = cells.astype(np.int64).T
    return (x << 42) | (y << 21) | z


def voxel_order(
    columns: Float[np.ndarray, "3 N"], voxel_size: float
) -> tuple[Int[np.ndarray, "N"], Int[np.ndarray, "M"]]:
    """Order of points by voxel, and where each voxel starts in it; `ValueError` beyond 2²¹ voxels along an axis."""
    # Unlike in `voxel_keys`, the indices take no more bits than the extent of the points needs.
    key, num_keys = np.zeros(columns.shape[1], np.int64), 1
    for column in columns:
        cell = np.floor(column / voxel_size)
        cell -= cell.min()
        extent = cell.max() + 1
        if extent > VOXELS_PER_AXIS:
            raise ValueError(
                f"voxel_size: expected at most {VOXELS_PER_AXIS} voxels along an axis, got {extent:.0f} "
                f"with {voxel_size} m; choose a larger size"
            )
        key = key * int(extent) + cell.astype(np.int64)
        num_keys *= int(extent)
    order = np.arange(len(key))
    # NumPy sorts 16-bit integers by radix: one pass for each 16 bits takes a third of the time of sorting the keys.
    for shift in range(0, (num_keys - 1).bit_length(), 16):
        order = order[np.argsort((key[order] >> shift).astype(np.uint16), kind="stable")]
    return order, starts_of(key[order])


class Grid:
    """Points along the axes of their grid, `columns`, metres; `measured`: which rows of a cloud they are, None: all."""

    def __init__(self, columns: Float[np.ndarray, "3 N"], measured: Bool[np.ndarray, "M"] | None = None):
        self.columns, self.measured = columns, measured
        self._numbers: dict[float, tuple[Int[np.ndarray, "N"], int]] = {}

    def numbers(self, voxel_size: float) -> tuple[Int[np.ndarray, "N"], int]:
        """The voxel number of each point, in the order of `voxel_order`, and the number of occupied voxels; cached."""
        if voxel_size not in self._numbers:
            order, starts = voxel_order(self.columns, voxel_size)
            numbers = np.empty_like(order)
            numbers[order] = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(order))))
            self._numbers[voxel_size] = numbers, len(starts)
        return self._numbers[voxel_size]


def grid_of(points: Float[np.ndarray, "N 3"], measured: Bool[np.ndarray, "M"] | None = None) -> Grid:
    """The turned grid of finite points. Its angles are seeded by the numbers of points on either side of the middle, so
    that they differ between clouds, but not with the order of the points."""
    # Imported late: it takes a fifth of the import time of the package.
    from scipy.spatial.transform import Rotation

    # Working by columns takes a third of the time of working by rows.
    columns = np.ascontiguousarray(points.T, np.float64)
    middle = 0.5 * (columns.min(axis=1) + columns.max(axis=1))
    sides = [int(np.sum(column > value)) for column, value in zip(columns, middle, strict=True)]
    variation = np.random.default_rng([len(points), *sides]).uniform(-VARIATION, VARIATION, 3)
    return Grid(rotated(columns.T, Rotation.from_rotvec(TURN / np.sqrt(3) + variation).as_matrix()).T, measured)


def starts_of(sorted_keys: Int[np.ndarray, "N"]) -> Int[np.ndarray, "M"]:
    first = np.ones(len(sorted_keys), bool)
    np.not_equal(sorted_keys[1:], sorted_keys[:-1], out=first[1:])
    return np.flatnonzero(first)
