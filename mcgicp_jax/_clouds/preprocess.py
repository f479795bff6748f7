"""Preprocessing of raw clouds: finite points, voxel downsampling, origin and neighbours."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, cast

import jax
import numpy as np
from jaxtyping import Bool

from mcgicp_jax._clouds.coordinate_steps import harmful_steps
from mcgicp_jax._clouds.point_cloud import LARGEST, PointCloud, Values, Voxels, as_cloud, is_far
from mcgicp_jax._clouds.preprocess_inside_jit import preprocess_traced
from mcgicp_jax._clouds.rays_without_return import measured_rows
from mcgicp_jax._clouds.voxel_size import NUM_NEIGHBORS, VoxelSize, voxels_and_grids, warn_of_shape
from mcgicp_jax._clouds.voxels import Grid, grid_of
from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._compute.linear_maps import RowAverage, primal, with_derivative
from mcgicp_jax._compute.messages import check_concrete, check_integer, check_positive, warn
from mcgicp_jax._math.statistics import median, sampled_rows
from mcgicp_jax._search.base import AbstractSearch
from mcgicp_jax._search.default_search import default_search

# Fewest finite points of a cloud: the fewest that are not always coplanar.
MIN_POINTS = 4
# Number of points among which duplicates are counted: half of them is known to within 2 %.
_SAMPLE = 500


def preprocess(
    cloud: PointCloud | Values,
    voxel_size: VoxelSize | Voxels = "auto",
    num_neighbors: int = NUM_NEIGHBORS,
    *,
    search: AbstractSearch | None = None,
    size: int | None = None,
) -> PointCloud:
    """Prepare a cloud for registration: drop points with NaN or infinity, downsample to voxels, find neighbours.

    A NaN drops the point in a channel as well, unless `channel_valid` says that the channel is missing. The neighbours
    of a point are found when they are first needed.

    Preprocess each cloud once and register it as often as needed. Points, channels and covariances of the result can be
    differentiated by those of the raw cloud; voxels and neighbours are constants.

    Runs on the host, or inside `jit` and `vmap`. There, `voxel_size` is None or a number, the grid is turned by other
    angles, coordinates are not centred, points that are not finite become padding, all others are kept, and nothing is
    warned of.

    Args:
        cloud: raw cloud, or (N, 3) array in metres. Padding and old neighbours are dropped first.
        voxel_size: metres. Points and channels are averaged per voxel, each channel over the points that have it. The
            grid of voxels is turned, differently for each cloud, so that planes along the axes are not biased.
            "auto": the smallest size at which at most 5 % of the neighbourhoods are lines, such as scan lines, and at
            most 40,000 voxels remain; a larger one where noise makes neighbourhoods thicker than 0.3 of their width.
            Posts and edges are lines at any size. Where they are more than 5 %, or fewer lines would be thicker than
            that, the smallest size with at most 1.5 times the fewest lines, if lines fall to half.
            Points that are spread evenly are kept as they are, as are clouds of fewer than 500 points or with
            covariances. The repr of the result says what was chosen and why. None keeps every point.
        num_neighbors: number k of neighbours, including the point itself, from which a covariance is computed; at
            least 3. All points are used if the cloud has fewer.
        search: neighbour search; by default `KDTreeSearch`, and inside `jit` or `vmap` on accelerators `DenseSearch`.
        size: number of rows of the result, which is padded to it by copies of the last point; sums over rows must leave
            those out that are not `valid`. Inside `jit` and `vmap`, it must be given with a `voxel_size`; if more
            voxels are occupied, no row of the result is valid, and registrations with it have the status
            TOO_FEW_CORRESPONDENCES. Without voxels it must be at least the number of rows.

    Returns:
        Cloud with read-only NumPy arrays, float64 if the input is and JAX's x64 is on, else float32. If the
        coordinates are large relative to the cloud's size, they are centred and `PointCloud.origin` keeps the offset.

    Raises:
        ValueError: if fewer than four points are finite (or remain after downsampling), outside of `jit` more than
            `size` remain, a cloud with covariances is to be downsampled, the cloud is a batch, or an argument is out
            of range.

    Warns:
        UserWarning: once per call, if points with NaN or infinity were left out, or points that share exactly one
            place, as sensors report rays without return (the first at (0, 0, 0) is kept), or lie so far from the others
            that they are no surface, if downsampling leaves fewer points than `num_neighbors`, if more than half of the
            points lie exactly on another one, if coordinates are rounded to steps of more than a third of the points'
            spacing, or if `voxel_size` is None and more than a tenth of the neighbourhoods are lines, or most are more
            than 0.6 times as thick as wide.
    """
    cloud = as_cloud("cloud", cloud)
    if size is not None:
        check_integer("size", size, 1)
    if not is_concrete(primal(cloud)):
        check_preprocessing(voxel_size, num_neighbors)
        return preprocess_traced(cloud, voxel_size, num_neighbors, search, size)
    preprocessed = preprocessed_in(None, cloud, voxel_size, num_neighbors, search)
    return preprocessed if size is None else preprocessed.pad(size)


def preprocessed_in(
    grid: Grid | None,
    cloud: PointCloud,
    voxel_size: VoxelSize | Voxels,
    num_neighbors: int,
    search: AbstractSearch | None,
    checked: bool = True,
) -> PointCloud:
    """`preprocess` with the grid of `voxels_and_grids`, if known. `checked`: look at neighbourhoods, for warnings."""
    check_preprocessing(voxel_size, num_neighbors)
    if not is_concrete(cloud):
        values = primal(cloud)
        if is_concrete(values):
            preprocessed = preprocessed_in(grid, values, voxel_size, num_neighbors, search, checked)
            return _differentiable(preprocessed, cloud, values)
        raise ValueError(
            "cloud: expected a preprocessed cloud inside jit and vmap; call preprocess(cloud, voxel_size, size=...), "
            "or preprocess(cloud, None) for all points"
        )
    cloud = finite_rows(cloud, None if grid is None else grid.measured)
    if grid is not None and grid.columns.shape[1] != len(cloud):
        # Rows with a channel that is not finite were left out.
        grid = None
    preprocessed = with_neighbors(cloud, voxel_size, num_neighbors, search, grid)
    if checked:
        _warn_of_loss(cloud, preprocessed, num_neighbors)
    if checked and preprocessed.covariances is None:
        warn_of_shape(preprocessed, all_points=voxel_size is None)
    return preprocessed


def _differentiable(preprocessed: PointCloud, cloud: PointCloud, values: PointCloud) -> PointCloud:
    """The preprocessed cloud with the derivative by the traced arrays of the raw `cloud`, whose values are `values`."""
    raw = values.unpad()
    measured = measured_rows(raw, _is_finite(raw))
    rows, voxels = np.flatnonzero(np.asarray(values.valid))[measured], np.arange(np.sum(measured))
    if preprocessed.voxel_size is not None:
        voxels, _ = grid_of(np.asarray(raw.points)[measured]).numbers(preprocessed.voxel_size)
    arrays: dict[str, Any] = {}
    for name in ("points", "channels", "covariances"):
        array = getattr(cloud, name)
        if name == "points" and not is_concrete(cloud.origin):
            # The sum is what was averaged; the origin of the result is a constant.
            array = array + cloud.origin
        if not is_concrete(array):
            mask = raw.channel_valid if name == "channels" else None
            counted = np.ones((len(rows), 1)) if mask is None else mask[measured]
            average = RowAverage(rows, voxels, counted, (array.shape[0], len(preprocessed.points)))
            (arrays[name],) = with_derivative([getattr(preprocessed, name)], average, [array])
    return preprocessed.replace_rows(**arrays)


def with_neighbors(
    cloud: PointCloud,
    voxel_size: VoxelSize | Voxels,
    num_neighbors: int,
    search: AbstractSearch | None = None,
    grid: Grid | None = None,
) -> PointCloud:
    """`preprocess` for a cloud of `finite_rows`, whose grid may be known."""
    voxels, (own_grid,) = voxels_and_grids(voxel_size, cloud, measured=True)
    if voxels.size is not None:
        cloud = _downsampled(cloud, grid or own_grid or grid_of(np.asarray(cloud.points)), voxels.size)
    points, channel_valid, covariances = np.asarray(cloud.points), cloud.channel_valid, cloud.covariances
    dtype = jax.dtypes.canonicalize_dtype(points.dtype)
    # Clouds far from zero are centred, at a float32 origin, which has the same value inside a transformation.
    columns = np.ascontiguousarray(points.T)
    low, high = columns.min(axis=1).astype(np.float64), columns.max(axis=1).astype(np.float64)
    center = (0.5 * (low + high)).astype(np.float32).astype(np.float64)
    origin = center if is_far(center, float(np.linalg.norm(high - low))) else np.zeros(3)
    points = (points - origin).astype(dtype)
    arrays = {
        "points": points,
        "channels": np.asarray(cloud.channels, dtype),
        # Without missing channels the mask is None, so that all complete clouds share compiled programs.
        "channel_valid": None if channel_valid is None or np.all(channel_valid) else np.asarray(channel_valid),
        "valid": np.ones(len(points), bool),
        # Searched among the rounded coordinates, which are those of the registration.
        "deferred_neighbors": (search or default_search()).neighbors_on_demand(points, num_neighbors),
        "covariances": None if covariances is None else np.asarray(covariances, dtype),
        # Averages of points have no time: `deskew` comes first.
        "times": None,
        "origin": origin,
    }
    for array in arrays.values():
        if isinstance(array, np.ndarray):
            # Quantities derived from these arrays are cached, so the arrays must not change. They are copies.
            array.setflags(write=False)
    return cloud.replace_rows(**arrays, voxels=voxels)


def _warn_of_loss(raw: PointCloud, preprocessed: PointCloud, num_neighbors: int) -> None:
    """Warn of coordinates that are rounded to coarse steps, of duplicates and of few voxels."""
    points, neighbors = np.asarray(preprocessed.points), cast(Any, preprocessed.deferred_neighbors)
    # Among the rows from which the spacing of a target is computed. Each point is its own first neighbour.
    rows, counts = sampled_rows(np.asarray(preprocessed.valid))
    rows = rows[counts][:: 1 + rows.size // _SAMPLE]
    near = neighbors[rows][:, 1:]
    with np.errstate(over="ignore", invalid="ignore"):
        distances = np.linalg.norm(points[near] - points[rows, None], axis=2)
    # Without coincident neighbours; the spacing is 0 if all coincide.
    nearest = np.where((distances > 0) & (near >= 0), distances, np.inf).min(axis=1)
    spacing = float(np.nan_to_num(median(np.where(np.isfinite(nearest), nearest, np.nan))))
    steps = harmful_steps(preprocessed, spacing)
    if steps.any():
        names = "" if steps.all() else " " + " and ".join(np.array(["x", "y", "z"])[steps > 0])
        warn(
            f"points: coordinates{names} are rounded to steps of {steps.max():.2g} m, and neighbours are {spacing:.2g} "
            "m apart; read them as float64 and with all digits, subtract an offset before float32, or average them: "
            "preprocess(cloud, voxel_size=...)"
        )
    duplicates = np.mean(distances[:, 0] == 0)
    if duplicates > 0.5:
        warn(
            f"points: {duplicates:.0%} lie exactly on another one, so that neighbourhoods do not span the surface; "
            "average them: preprocess(cloud, voxel_size=...)"
        )
    if len(preprocessed) < min(len(raw), num_neighbors):
        warn(
            f"voxel_size: {preprocessed.voxel_size} m leaves {len(preprocessed)} of {len(raw)} points, fewer than the "
            f"{num_neighbors} neighbours from which a covariance is computed; choose a smaller size"
        )


def check_preprocessing(voxel_size: VoxelSize | Voxels, num_neighbors: int) -> None:
    automatic = isinstance(voxel_size, str) and voxel_size == "auto"
    if not (automatic or voxel_size is None or isinstance(voxel_size, Voxels)):
        check_positive("voxel_size", voxel_size, 'a positive number, "auto" or None')
    check_integer("num_neighbors", num_neighbors, 3)


def finite_rows(cloud: PointCloud | Values, measured: Bool[np.ndarray, "N"] | None = None) -> PointCloud:
    """A raw cloud without padding, non-finite rows and placeholders; warns of the latter two. `measured`: if known."""
    cloud = as_cloud("cloud", cloud)
    check_concrete("cloud", cloud)
    if cloud.points.ndim != 2:
        raise ValueError(f"cloud: expected a single cloud, got a batch of shape {cloud.points.shape}")
    measured = None if measured is None else measured[np.asarray(cloud.valid)]
    cloud = cloud.unpad()
    points, finite = np.asarray(cloud.points), _is_finite(cloud)
    keep = measured_rows(cloud, finite) if measured is None or not finite.all() else measured
    if len(keep) >= MIN_POINTS and keep.all():
        return cloud
    others = np.sum((np.abs(points[~finite]) <= LARGEST).all(axis=1))
    advice = f", {others} of them with finite coordinates; mark missing channels by channel_valid" if others else ""
    placeholders = finite & ~keep
    if keep.sum() < MIN_POINTS:
        left = f", left out {np.sum(~keep)}{advice}" if others or placeholders.any() else ""
        raise ValueError(f"cloud: expected at least {MIN_POINTS} finite points, got {keep.sum()} of {keep.size}{left}")
    if not finite.all():
        warn(f"left out {np.sum(~finite)} of {keep.size} points with a NaN or infinity{advice}")
    if placeholders.any():
        x, y, z = points[np.argmax(placeholders)]
        warn(
            f"left out {placeholders.sum()} of {keep.size} points that lie at exactly one place or far from all "
            f"others, such as ({x:g}, {y:g}, {z:g}), as sensors report rays without return"
        )
    return cloud.replace_rows(valid=keep, times=None).unpad()


def _is_finite(cloud: PointCloud) -> Bool[np.ndarray, "N"]:
    """Which rows are finite in all arrays. Values that overflow float32 count as infinite."""
    arrays = [array for array in (cloud.points, cloud.channels, cloud.covariances) if array is not None]
    masks = [np.abs(array) <= LARGEST for array in arrays]
    # Most clouds are finite throughout, and one check of all values is much faster than one per row.
    if all(mask.all() for mask in masks):
        return np.ones(len(cloud.points), bool)
    return np.all([mask.all(axis=tuple(range(1, mask.ndim))) for mask in masks], axis=0)


def _downsampled(cloud: PointCloud, grid: Grid, voxel_size: float) -> PointCloud:
    """The mean points and channels of each voxel, summed in float64, sorted by voxel."""
    if cloud.covariances is not None:
        raise ValueError("voxel_size: expected None for a cloud with covariances, which cannot be averaged")
    voxels, size = grid.numbers(voxel_size)
    if size < MIN_POINTS:
        raise ValueError(
            f"voxel_size: expected a size that leaves at least {MIN_POINTS} points, got {voxel_size} m, "
            f"which leaves {size}"
        )

    def total(columns: Iterable[np.ndarray]) -> np.ndarray:
        sums = [np.bincount(voxels, column, size) for column in columns]
        return np.stack(sums, axis=1) if sums else np.zeros((size, 0))

    counts = np.bincount(voxels)[:, None]
    means = (total(np.asarray(cloud.points).T) / counts).astype(cloud.points.dtype)
    channels, channel_valid = np.asarray(cloud.channels), None
    if cloud.channel_valid is not None:
        # Missing values are stored as 0 and do not add to the sum.
        counts = total(np.asarray(cloud.channel_valid).T)
        counts, channel_valid = np.maximum(counts, 1), counts > 0
    channels = (total(channels.T) / counts).astype(channels.dtype)
    return PointCloud(means, channels, channel_valid=channel_valid, channel_names=cloud.channel_names)
