"""The voxel size of raw clouds, chosen from the shape of their neighbourhoods and from their number of points.

The k nearest neighbours of a point describe the surface only if points are spread over it. Along a scan line they lie
on a line, and where points are closer together than their noise they fill a ball. Averages per voxel have neither
fault, if the voxels are large enough; larger ones lose detail. Hence the smallest voxels that suffice are chosen.
"""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal, NamedTuple, TypeAlias, cast

import numpy as np
from jaxtyping import Bool, Float

from mcgicp_jax._clouds.point_cloud import PLANAR_ADVICE, PointCloud, Voxels
from mcgicp_jax._clouds.rays_without_return import measured_rows
from mcgicp_jax._clouds.voxels import VOXELS_PER_AXIS, Grid, grid_of
from mcgicp_jax._compute.concrete import is_concrete, is_tracer
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.messages import warn
from mcgicp_jax._compute.threads import side_by_side
from mcgicp_jax._search.kd_tree import KDTreeSearch

# Metres; "auto": chosen from the data; None: every point is kept.
VoxelSize: TypeAlias = float | Literal["auto"] | None

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
# Where no size reaches that, the fewest must be this part of what there was, since in a planar scan all remain. The
# smallest size with at most `_NEARLY` times the fewest is taken, since posts and edges are lines in any voxels
# (measured: Constants in `tests/benchmarks/README.md`).
_FEWER, _NEARLY = 0.5, 1.5
# Median thickness of neighbourhoods (third extent over the second) from which larger voxels are tried. Raw corridors
# that noise made look constrained had 0.4 and more, and 20 points that fill a ball have 0.77. Voxels that leave few
# lines are no larger than this allows, either: in a forest few are lines only where voxels mix trunks with the ground.
_THICK = 0.3
# Larger voxels are used if the thickness falls below `_THICK`, and to the fraction `_THINNER` or less per doubling;
# they are given up if it rises by the factor `_THICKER` (measured: Constants in `tests/benchmarks/README.md`).
_THINNER, _THICKER = 0.6, 1.1
# Sizes per decade: those of the preferred numbers R10 of ISO 3, 26 % apart.
_STEPS = 10
# Number of steps by which sizes double.
_DOUBLE = 3
# Sizes considered: four decades below the extent of the clouds, and for noise up to four doublings. The extent is that
# between two quantiles of the coordinates, since a few points may be far away.
_DECADES, _DOUBLINGS, _INNER = 4, 4, (0.05, 0.95)
# Number of points whose neighbourhoods are examined: a fraction of 5 % is known to within 1.3 %.
_SAMPLE = 300
# Raw clouds are warned of above this fraction of lines or this thickness; a plane above that fraction is a planar scan.
_MANY_LINES, _AS_THICK_AS_WIDE = 0.1, 0.6
_MOSTLY_LINES = 0.5


class Shape(NamedTuple):
    """The neighbourhoods of a cloud: the fraction that are lines, the median of third over second extent, and the
    median distance of the nearest neighbour, metres."""

    lines: float
    thickness: float
    spacing: float


def voxels_for(voxel_size: VoxelSize | Voxels, *clouds: PointCloud) -> Voxels:
    """The voxels for the raw clouds among these; "auto": those of the first preprocessed cloud, if there is one."""
    return voxels_and_grids(voxel_size, *clouds)[0]


def voxels_and_grids(
    voxel_size: VoxelSize | Voxels, *clouds: PointCloud, measured: bool = False
) -> tuple[Voxels, Sequence[Grid | None]]:
    """`voxels_for`, and the grids of the clouds from which a size was chosen, with the voxels numbered; else None.
    `measured`: the clouds are `finite_rows`, of which a second look would leave out more as far from the others."""
    none = [None] * len(clouds)
    if isinstance(voxel_size, Voxels):
        return voxel_size, none
    if is_tracer(voxel_size):
        raise ValueError(f"voxel_size: expected a number that is not traced, as voxels are constants, got {voxel_size}")
    if voxel_size != "auto":
        return Voxels(voxel_size), none
    for cloud in clouds:
        if cloud.voxel_size is not None:
            return cloud.voxels, none
    if not is_concrete(primal(clouds)):
        # `preprocess` says what is expected.
        return Voxels(), none
    raw = {row: cloud for row, cloud in enumerate(clouds) if cloud.deferred_neighbors is None}
    points = [(np.asarray(cloud.points), None) if measured else _finite_points(cloud) for cloud in raw.values()]
    counts = [len(finite) for finite, _ in points]
    # Clouds with covariances cannot be averaged.
    if any(cloud.covariances is not None for cloud in raw.values()) or (
        max(counts, default=0) < _LEAST_VOXELS or min(counts) < NUM_NEIGHBORS
    ):
        return Voxels(), none
    grids = side_by_side([partial(grid_of, finite, rows) for finite, rows in points])
    grid_of_row = dict(zip(raw, grids, strict=True))
    return _suitable_voxels(grids), [grid_of_row.get(row) for row in range(len(clouds))]


def map_voxel_size(cloud: PointCloud) -> float:
    """Voxel size of a map from its first cloud, metres."""
    return voxels_for("auto", cloud).size or raw_spacing(cloud) or 1.0


def raw_spacing(cloud: PointCloud) -> float:
    """Median distance of the nearest neighbour of a sample of the finite points, metres; 0 for a single point."""
    points, _ = _finite_points(cloud)
    return _shape_of(points.T).spacing if len(points) > 1 else 0.0


def warn_of_shape(cloud: PointCloud, all_points: bool) -> None:
    """Warn of planar scans, and if the user asked for `all_points`, of neighbourhoods that do not span the surface."""
    points, neighbors = np.asarray(cloud.points), cast(Any, cloud.deferred_neighbors)
    constant = (points == points[0]).all(axis=0)
    planar, examined = constant.sum() == 1, all_points and len(cloud) >= _LEAST_VOXELS
    if not examined and not planar:
        return
    # Fewer neighbours are often lines by chance.
    shape = _shape_of(points.T.astype(np.float64), neighbors if neighbors.shape[1] >= NUM_NEIGHBORS else None)
    if planar and shape.lines > _MOSTLY_LINES:
        warn(f"points: all have the same {'xyz'[int(constant.argmax())]}, and most lie on lines; {PLANAR_ADVICE}")
        return
    defects = []
    if shape.lines > _MANY_LINES:
        defects.append(f"{shape.lines:.0%} of the neighbourhoods are lines")
    if shape.thickness > _AS_THICK_AS_WIDE:
        defects.append(f"the neighbourhoods are {shape.thickness:.2f} times as thick as wide")
    if defects and examined:
        warn(f'voxel_size: without voxels, {" and ".join(defects)}, so they do not describe the surface; use "auto"')


def _suitable_voxels(grids: Sequence[Grid]) -> Voxels:
    """One voxel size for several raw clouds, by the rules of `preprocess`; None where points are spread evenly."""
    # Sizes are numbered, ten for each decade of metres; None stands for all points.
    step: int | None = None
    reason = ""
    samples = [grid.columns[:, :: 1 + grid.columns.shape[1] // _SAMPLE] for grid in grids]
    inner = max(float(np.ptp(np.quantile(sample, _INNER, axis=1), axis=0).max()) for sample in samples)
    whole = max(float(np.ptp(grid.columns, axis=1).max()) for grid in grids)
    largest = _step_of(inner or whole or 1.0)
    # 1 %, since sizes are rounded to two digits.
    smallest = max(largest - _STEPS * _DECADES, _step_of(1.01 * whole / VOXELS_PER_AXIS or 1.0))
    # A size that suffices for the largest cloud mostly suffices for the others.
    clouds = [_Averages(grid) for grid in sorted(grids, key=lambda grid: grid.columns.shape[1], reverse=True)]
    most = clouds[0].count(None)
    if most > _MOST_VOXELS:
        # The search begins at the size at which a square as large as the clouds has as many voxels.
        first, step = smallest, largest - round(_STEPS / 2 * np.log10(_MOST_VOXELS))
        for cloud in clouds:
            first = step = cloud.first_with_few(range(first, largest), step)
        reason = f"at most {_MOST_VOXELS:,} of {most:,} points"
        side_by_side([partial(cloud.average, step) for cloud in clouds])
        if not all(cloud.shows_scene(step) for cloud in clouds):
            return Voxels()
    shape = _worst_shape(clouds, step)
    # Voxels below the spacing would average nothing.
    start = max(smallest, _step_of(shape.spacing or 1.0)) if step is None else step
    if shape.lines > _MOST_LINES:
        larger = _without_lines(clouds, step, range(start, largest))
        if larger is not None:
            step, reason = larger, f"{shape.lines:.0%} of the neighbourhoods were lines"
    thickness = _worst_shape(clouds, step).thickness
    if thickness > _THICK:
        thinner = _thinner(clouds, thickness, start if step is None else step)
        if thinner is not None:
            step, reason = thinner, f"the neighbourhoods were {thickness:.2f} times as thick as wide"
    return Voxels(None if step is None else _size(step), reason)


class _Averages:
    """The means of a cloud in voxels of each numbered size, and the shapes of the neighbourhoods of these means."""

    def __init__(self, grid: Grid):
        # Points (step None), or their means in voxels of the size number `_step`, whose own means are the same.
        self._grid = grid
        self._step: int | None = None
        self._least = min(_LEAST_VOXELS, grid.columns.shape[1] // 2)
        self._shapes: dict[int | None, Shape] = {}

    def average(self, step: int) -> None:
        """Replace the points by these means: larger voxels are then examined in a third of the time."""
        self._grid, self._step = Grid(self._means(step)), step

    def count(self, step: int | None) -> int:
        if step is None or step == self._step:
            return self._grid.columns.shape[1]
        return self._grid.numbers(_size(step))[1]

    def shows_scene(self, step: int) -> bool:
        return self.count(step) >= self._least

    def shape(self, step: int | None) -> Shape:
        if step not in self._shapes:
            self._shapes[step] = _shape_of(self._means(step))
        return self._shapes[step]

    def first_with_few(self, steps: range, guess: int) -> int:
        """The first step with at most `_MOST_VOXELS` voxels; the end of the range if there is none."""
        low, high = steps.start, steps.stop
        while low < high:
            guess = min(max(guess, low), high - 1)
            count = self.count(guess)
            low, high = (low, guess) if count <= _MOST_VOXELS else (guess + 1, high)
            # The number of voxels goes with 1 / size along scan lines, with 1 / size² on surfaces.
            guess += round(_STEPS * np.log10(count / _MOST_VOXELS))
        return low

    def _means(self, step: int | None) -> Float[np.ndarray, "3 M"]:
        if step is None or step == self._step:
            return self._grid.columns
        numbers, count = self._grid.numbers(_size(step))
        sums = np.stack([np.bincount(numbers, column, count) for column in self._grid.columns])
        return sums / np.bincount(numbers)


def _worst_shape(clouds: Sequence[_Averages], step: int | None) -> Shape:
    shapes = side_by_side([partial(cloud.shape, step) for cloud in clouds])
    return Shape(*np.max(shapes, axis=0).tolist())


def _without_lines(clouds: Sequence[_Averages], step: int | None, steps: range) -> int | None:
    """The smallest size with few lines, or else with nearly the fewest of all sizes, at which all clouds show the scene
    and neighbourhoods are no thicker than `_THICK`, or than they are at `step`. None: there is none, or half of the
    lines remain."""

    def suffices(cloud: _Averages, larger: int) -> bool:
        return not cloud.shows_scene(larger) or cloud.shape(larger).lines <= _MOST_LINES

    # A size that suffices for the cloud with the most lines mostly suffices for the others, or the next one does.
    worst, *others = sorted(clouds, key=lambda cloud: cloud.shape(step).lines, reverse=True)
    larger = bisect.bisect_left(steps, True, key=partial(suffices, worst)) + steps.start
    for cloud in others:
        while larger < steps.stop and not suffices(cloud, larger):
            larger += 1
    before = _worst_shape(clouds, step)

    def shown(size: int) -> bool:
        return all(cloud.shows_scene(size) for cloud in clouds)

    def thin(size: int) -> bool:
        return _worst_shape(clouds, size).thickness <= max(_THICK, before.thickness)

    if larger < steps.stop and shown(larger) and thin(larger):
        return larger
    lines = {size: _worst_shape(clouds, size).lines for size in itertools.takewhile(shown, steps) if thin(size)}
    fewest = min(lines.values(), default=1.0)
    if fewest > max(_MOST_LINES, _FEWER * before.lines):
        return None
    return next(size for size, fraction in lines.items() if fraction <= max(_MOST_LINES, _NEARLY * fewest))


def _thinner(clouds: Sequence[_Averages], thickness: float, start: int) -> int | None:
    """The smallest size with clearly thinner neighbourhoods than `thickness`, from `start` by doubling, or None."""
    for larger in range(start + _DOUBLE, start + _DOUBLE * _DOUBLINGS + 1, _DOUBLE):
        if not all(cloud.shows_scene(larger) for cloud in clouds):
            return None
        before, thickness = thickness, _worst_shape(clouds, larger).thickness
        if thickness > _THICKER * before:
            return None
        if thickness <= min(_THICK, _THINNER * before):
            between = range(larger - _DOUBLE + 1, larger)
            return next((finer for finer in between if _worst_shape(clouds, finer).thickness <= _THICK), larger)
    return None


def _shape_of(columns: Float[np.ndarray, "3 N"], neighbors: Any = None) -> Shape:
    """The shape of a sample of the neighbourhoods: of (N, k) rows or `DeferredRows`; searched if None."""
    size = columns.shape[1]
    rows = np.random.default_rng(0).integers(0, size, _SAMPLE)
    if neighbors is None:
        points, search = np.ascontiguousarray(columns.T), KDTreeSearch(workers=1)
        _, nearest = search.query(search.build(points), points[rows], min(NUM_NEIGHBORS, size), np.inf)
    else:
        nearest = neighbors[rows]
    # Neighbours come before samples, so that NumPy's loops run over the samples.
    near = columns[:, nearest.T]
    distances = np.linalg.norm(near[:, 1] - near[:, 0], axis=0)
    offsets = near - near.mean(axis=1, keepdims=True)
    squares = np.linalg.eigvalsh(np.einsum("ikn,jkn->ijn", offsets, offsets).T)
    thin, second, first = np.sqrt(np.maximum(squares.T, np.finfo(float).tiny))
    return Shape(float(np.mean(second < _LINE * first)), float(np.median(thin / second)), float(np.median(distances)))


def _step_of(size: float) -> int:
    """Number of the smallest voxel size that is not below this one."""
    return int(np.ceil(_STEPS * np.log10(size)))


def _size(step: int) -> float:
    return float(f"{10 ** (step / _STEPS):.2g}")


def _finite_points(cloud: PointCloud) -> tuple[Float[np.ndarray, "N 3"], Bool[np.ndarray, "M"]]:
    """The finite points without placeholders, float64, and which rows they are."""
    cloud = primal(cloud)
    points, measured = np.asarray(cloud.points, np.float64), measured_rows(cloud)
    return points if measured.all() else points.compress(measured, axis=0), measured
