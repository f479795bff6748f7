"""The voxel size of raw clouds, chosen from the shape of their neighbourhoods and from their number of points.

The k nearest neighbours of a point describe the surface only if points are spread over it. Along a scan line they lie
on a line, and where points are closer together than their noise they fill a ball. Averages per voxel have neither
fault, if the voxels are large enough; larger ones lose detail. Hence the smallest voxels that suffice are chosen.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, Literal, NamedTuple, TypeAlias, TypeVar

import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.point_cloud import LARGEST, PointCloud, Voxels
from mcgicp_jax._clouds.voxels import VOXELS_PER_AXIS, turned, voxel_numbers
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.messages import warn
from mcgicp_jax._compute.threads import side_by_side
from mcgicp_jax._search.kd_tree import KDTreeSearch

# Metres; "auto": chosen from the data; None: every point is kept.
VoxelSize: TypeAlias = float | Literal["auto"] | None

Value = TypeVar("Value")

# Default number of neighbours of a point, including itself, from which its covariance is computed (as in small_gicp).
NUM_NEIGHBORS = 20

# Largest number of voxels. It bounds the time; with half of it, the errors of KITTI's scans double.
_MOST_VOXELS = 40_000
# Smallest number of voxels, or half of the points of a smaller cloud. Fewer do not show the scene: of a scan with 957
# voxels (every eighth point of an indoor LiDAR) the pose was right to 14 mm.
_LEAST_VOXELS = 500
# A neighbourhood is a line if its second extent (standard deviation along a principal axis) is below this fraction of
# the first. On a line, GICP's covariance is arbitrary about it; 20 points spread over a square have 0.8.
_LINE = 0.2
# Largest fraction of lines. Raw scans that were registered decimetres to metres off had 29 to 83 %, and 2 to 4 % in
# voxels of the best size.
_MOST_LINES = 0.05
# Where no size reaches that, the fraction must fall to this part of what it was; in a planar scan it does not fall.
_FEWER = 0.5
# Median thickness of neighbourhoods (third extent over the second) from which larger voxels are tried. Raw corridors
# that noise made look constrained had 0.4 and more, and 20 points that fill a ball have 0.77.
_THICK = 0.3
# They are used if the thickness falls below that, and to this fraction or less while they double; they are given up if
# it rises by this factor. Averages over more points have less noise: its thickness rose by 5 % at most, and then fell
# to half or less in doubled voxels. Vegetation and clutter are thicker in larger voxels (by 20 % in KITTI's scans), and
# the thickness of hilly ground, which the grid causes, falls to 0.7.
_THINNER, _THICKER = 0.6, 1.1
# Sizes per decade: those of the preferred numbers R10 of ISO 3, 26 % apart.
_STEPS = 10
# Number of these steps by which sizes double.
_DOUBLE = 3
# Sizes that are considered: four decades below the extent of the clouds, and for noise up to four doublings. The extent
# is that between two quantiles of the coordinates, since a few points may be far away.
_DECADES, _DOUBLINGS, _INNER = 4, 4, (0.05, 0.95)
# Number of points whose neighbourhoods are examined: a fraction of 5 % is known to within 1.3 %.
_SAMPLE = 300
# Bits of the hash by which voxels are counted: of 40,000, 2 % collide. Its multiplier is 2⁶⁴ over the golden ratio
# (Knuth, The Art of Computer Programming, volume 3, 6.4); applied only once, planes collide five times as often.
_HASH_BITS, _HALF, _GOLDEN = 20, np.uint64(32), np.uint64(0x9E3779B97F4A7C15)
# Fractions of lines and thickness from which raw clouds are warned of.
_MANY_LINES, _AS_THICK_AS_WIDE = 0.1, 0.6


class Shape(NamedTuple):
    """The shape of the neighbourhoods of a cloud.

    Attributes:
        lines: fraction of the neighbourhoods that are lines.
        thickness: median of their third extent over the second.
        spacing: median distance of the nearest neighbour, metres.
    """

    lines: float
    thickness: float
    spacing: float


def voxels_for(voxel_size: VoxelSize | Voxels, *clouds: PointCloud) -> Voxels:
    """The voxels for the raw ones of clouds that are registered with each other.

    Chosen automatically, they are those of clouds among them that are preprocessed already and have some.
    """
    if isinstance(voxel_size, Voxels):
        return voxel_size
    if voxel_size != "auto":
        return Voxels(voxel_size)
    given = [cloud.voxels for cloud in clouds if cloud.voxel_size is not None]
    raw = [cloud for cloud in clouds if cloud.deferred_neighbors is None]
    return given[0] if given else _chosen(raw)


def map_voxel_size(cloud: PointCloud) -> float:
    """The voxel size of a map from its first cloud, metres: that of the cloud, or the spacing of its points."""
    return voxels_for("auto", cloud).size or raw_spacing(cloud) or 1.0


def raw_spacing(cloud: PointCloud) -> float:
    """Median distance of the nearest neighbour of some of the finite points, metres; 0 if there is only one."""
    points = _finite_columns(cloud).T
    return _shape_of(points).spacing if len(points) > 1 else 0.0


def warn_of_shape(cloud: PointCloud) -> None:
    """Warn if the neighbourhoods of a preprocessed cloud do not span the surface."""
    if len(cloud) < _LEAST_VOXELS:
        return
    neighbors: Any = cloud.deferred_neighbors
    # Fewer neighbours are often lines by chance.
    found = neighbors if neighbors.shape[1] >= NUM_NEIGHBORS else None
    shape, seen = _shape_of(np.asarray(cloud.points, np.float64), found), []
    if shape.lines > _MANY_LINES:
        seen.append(f"{shape.lines:.0%} of the neighbourhoods are lines")
    if shape.thickness > _AS_THICK_AS_WIDE:
        seen.append(f"the neighbourhoods are {shape.thickness:.2f} times as thick as wide")
    if seen:
        warn(f'voxel_size: without voxels, {" and ".join(seen)}, so they do not describe the surface; use "auto"')


def _chosen(clouds: Sequence[PointCloud]) -> Voxels:
    """One voxel size for some raw clouds, metres, and the reason; None where their points are spread evenly.

    It is the smallest at which no cloud has more than 5 % of linear neighbourhoods or more than 40,000 voxels. If the
    neighbourhoods are thicker than 0.3 of their width, but thinner in larger voxels, it is increased. Clouds with
    covariances, which cannot be averaged, keep all points, as do those of fewer than 500. A constant to autodiff.
    """
    if not clouds or any(cloud.covariances is not None for cloud in clouds):
        return Voxels()
    points = [_finite_columns(cloud) for cloud in clouds]
    counts = [columns.shape[1] for columns in points]
    if max(counts) < _LEAST_VOXELS or min(counts) < NUM_NEIGHBORS:
        return Voxels()
    # Sizes are numbered, ten for each decade of metres; None stands for all points.
    smallest, largest = _range_of(points)
    least = [min(_LEAST_VOXELS, count // 2) for count in counts]
    most = max(counts)
    points = _each(points, turned)
    step: int | None = None
    reason = ""
    if most > _MOST_VOXELS:
        step = _first(range(smallest, largest), lambda step: max(_counts(points, step)) <= _MOST_VOXELS)
        reason = f"at most {_MOST_VOXELS:,} of {most:,} points"
        # Larger voxels are examined on these averages, which takes a third of the time.
        points = _each(points, partial(_means, step=step))
    candidates = _Candidates(points, step, least)
    if step is not None and not candidates.shows_scene(step):
        return Voxels()
    # Voxels below the spacing would average nothing.
    start = max(smallest, _step_of(candidates.spacing or 1.0)) if step is None else step
    lines = candidates.lines(step)
    if lines > _MOST_LINES:
        larger = _first(
            range(start, largest),
            lambda step: not candidates.shows_scene(step) or candidates.lines(step) <= _MOST_LINES,
        )
        larger -= not candidates.shows_scene(larger)
        if larger >= start and candidates.lines(larger) <= max(_MOST_LINES, _FEWER * lines):
            step, reason = larger, f"{lines:.0%} of the neighbourhoods were lines"
    thickness = candidates.thickness(step)
    if thickness > _THICK:
        thinner = candidates.thinner(step, start if step is None else step)
        if thinner is not None:
            step, reason = thinner, f"the neighbourhoods were {thickness:.2f} times as thick as wide"
    return Voxels(None if step is None else _size(step), reason)


def _shape_of(points: Float[np.ndarray, "N 3"], neighbors: Any = None) -> Shape:
    """The shape of a sample of the neighbourhoods.

    Args:
        neighbors: (N, k) rows or `NeighborsOnDemand`; found if None.
    """
    rows = np.random.default_rng(0).integers(0, len(points), _SAMPLE)
    if neighbors is None:
        search, count = KDTreeSearch(workers=1), min(NUM_NEIGHBORS, len(points))
        _, nearest = search.query(search.build(points), points[rows], count, np.inf)
    else:
        nearest = neighbors[rows]
    near = points[nearest]
    distances = np.linalg.norm(near[:, 1] - near[:, 0], axis=1)
    offsets = near - near.mean(axis=1, keepdims=True)
    squares = np.linalg.eigvalsh(offsets.transpose(0, 2, 1) @ offsets)
    thin, second, first = np.sqrt(np.maximum(squares.T, np.finfo(float).tiny))
    return Shape(float(np.mean(second < _LINE * first)), float(np.median(thin / second)), float(np.median(distances)))


class _Candidates:
    """The neighbourhoods of some clouds in voxels of different sizes.

    Args:
        points: (3, N) coordinates of each cloud.
        step: number of the voxel size that they have already; None if they are raw.
        least: smallest number of voxels of each cloud.
    """

    def __init__(self, points: Sequence[Float[np.ndarray, "3 _"]], step: int | None, least: Sequence[int]):
        self._points, self._step, self._least = points, step, least
        self.shapes, self.shows_scene = cache(self._shapes), cache(self._shows_scene)

    def _shapes(self, step: int | None) -> list[Shape]:
        # Means of means in the same voxels would be the same.
        same = None if step == self._step else step
        return _each(self._points, lambda columns: _shape_of(_means(columns, same).T))

    def _shows_scene(self, step: int) -> bool:
        return all(count >= least for count, least in zip(_counts(self._points, step), self._least, strict=True))

    def lines(self, step: int | None) -> float:
        return max(shape.lines for shape in self.shapes(step))

    def thickness(self, step: int | None) -> float:
        return max(shape.thickness for shape in self.shapes(step))

    @property
    def spacing(self) -> float:
        return max(shape.spacing for shape in self.shapes(self._step))

    def thinner(self, step: int | None, start: int) -> int | None:
        """The smallest size in whose voxels the neighbourhoods are clearly thinner; None if there is none.

        Args:
            start: number of the size that is doubled, the current one or the spacing.
        """
        before = self.thickness(step)
        for larger in range(start + _DOUBLE, start + _DOUBLE * _DOUBLINGS + 1, _DOUBLE):
            if not self.shows_scene(larger) or self.thickness(larger) > _THICKER * before:
                return None
            if self.thickness(larger) <= min(_THICK, _THINNER * before):
                between = range(larger - _DOUBLE + 1, larger)
                return next((finer for finer in between if self.thickness(finer) <= _THICK), larger)
            before = self.thickness(larger)
        return None


def _range_of(points: Sequence[Float[np.ndarray, "3 _"]]) -> tuple[int, int]:
    """The numbers of the smallest and of the largest voxel size to consider."""
    samples = [columns[:, :: 1 + columns.shape[1] // _SAMPLE] for columns in points]
    inner = max(float(np.ptp(np.quantile(sample, _INNER, axis=1), axis=0).max()) for sample in samples)
    whole = max(float(np.ptp(columns, axis=1).max()) for columns in points)
    largest = _step_of(inner or whole or 1.0)
    return max(largest - _STEPS * _DECADES, _step_of(whole / VOXELS_PER_AXIS or 1.0)), largest


def _step_of(size: float) -> int:
    """The number of the smallest voxel size that is not below this one."""
    return int(np.ceil(_STEPS * np.log10(size)))


def _size(step: int) -> float:
    """The voxel size with this number, metres, to two digits."""
    return float(f"{10 ** (step / _STEPS):.2g}")


def _first(steps: range, holds: Callable[[int], bool]) -> int:
    """The first step from which on a condition holds; the end of the range if it never does."""
    return steps.start + bisect.bisect_left(steps, True, key=holds)


def _each(points: Sequence[Float[np.ndarray, "3 _"]], function: Callable[[np.ndarray], Value]) -> list[Value]:
    """The values of a function for each cloud, computed side by side."""
    return side_by_side([partial(function, columns) for columns in points])


def _counts(points: Sequence[Float[np.ndarray, "3 _"]], step: int) -> list[int]:
    """The number of voxels of each cloud, or up to 0.4 % more."""

    def count(columns: Float[np.ndarray, "3 N"]) -> int:
        key = np.zeros(columns.shape[1], np.int64)
        for column in columns:
            key = key * VOXELS_PER_AXIS + np.floor(column / _size(step)).astype(np.int64)
        occupied = np.zeros(2**_HASH_BITS, bool)
        mixed = key.view(np.uint64) * _GOLDEN
        occupied[(mixed ^ mixed >> _HALF) * _GOLDEN >> np.uint64(64 - _HASH_BITS)] = True
        # The expected number that collides, and three standard deviations of that.
        number = -occupied.size * np.log1p(-occupied.mean())
        return int(number * (1 + 3 / np.sqrt(2 * occupied.size)))

    return _each(points, count)


def _means(columns: Float[np.ndarray, "3 N"], step: int | None) -> Float[np.ndarray, "3 M"]:
    """The mean of the points of each voxel; all points without a step."""
    if step is None:
        return columns
    numbers, count = voxel_numbers(columns, _size(step))
    return np.stack([np.bincount(numbers, column, count) for column in columns]) / np.bincount(numbers)


def _finite_columns(cloud: PointCloud) -> Float[np.ndarray, "3 N"]:
    """Coordinates of the finite points, float64."""
    columns, kept = np.asarray(primal(cloud.points), np.float64).T, np.asarray(cloud.valid)
    kept = np.logical_and.reduce([kept, *(np.abs(column) <= LARGEST for column in columns)])
    return np.ascontiguousarray(columns if kept.all() else columns[:, kept])
