"""Odometry by registration of consecutive frames, and maps aggregated from the registered frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from mcgicp_jax._cloud import PointCloud, Values
from mcgicp_jax._methods import AbstractMethod
from mcgicp_jax._options import Options, check_method
from mcgicp_jax._pose import Pose, nearest_rotation, pose_matrix
from mcgicp_jax._preprocess import check_preprocessing, preprocess
from mcgicp_jax._register import register_with
from mcgicp_jax._result import Registration, computed, is_usable
from mcgicp_jax.datasets import Frame

# Voxels from the world's origin along each axis: three 21-bit indices, from −2²⁰, are packed into one 64-bit key.
_HALF_RANGE = 2**20


@dataclass(frozen=True, eq=False)
class Step:
    """The result of `odometry` for one frame.

    Attributes:
        cloud: the preprocessed cloud, in the sensor's frame.
        pose: (4, 4) float64, sensor to world, metres.
        registration: registration of this frame to the previous one, None for the first; check its `converged`.
    """

    cloud: PointCloud
    pose: Float[np.ndarray, "4 4"]
    registration: Registration | None


def odometry(
    frames: Iterable[Frame | PointCloud | Values],
    method: AbstractMethod,
    *,
    voxel_size: float | None = None,
    num_neighbors: int = 20,
    init: Pose | None = None,
    start: Pose | None = None,
    **options: Any,
) -> Iterator[Step]:
    """Register each frame to the previous one, starting from the previous motion (constant velocity).

    Frames are processed lazily and only the latest is kept, so a sequence may be larger than memory. For a progress
    bar, use `tqdm.tqdm(odometry(frames, ...), total=len(frames))`. If a registration ends with too few matches or
    non-finite values, the previous motion is used instead; `Step.registration` keeps the failed result.

    Args:
        frames: frames of a data set, clouds or (N, 3) arrays in metres. Preprocessed clouds are used unchanged.
        method: registration method; parameters that it leaves open are chosen from the data of each pair of frames.
        voxel_size, num_neighbors: arguments of `preprocess`.
        init: T_target_source from which the registration of the second frame to the first starts. The default is the
            identity; `max_distance` must then exceed the motion.
        start: pose of the first frame in the world; the identity by default.
        options: options of `register`.

    Yields:
        One `Step` per frame, including the first.

    Raises:
        ValueError: if a cloud or an argument is invalid; for a cloud the message names the frame.
    """
    check_preprocessing(voxel_size, num_neighbors)
    check_method(method)
    chosen = Options(**options)
    motion = pose_matrix(init)
    pose = np.asarray(pose_matrix(start, "start"))
    before: PointCloud | None = None
    for i, frame in enumerate(frames):
        cloud = frame.cloud if isinstance(frame, Frame) else frame
        try:
            cloud = cloud if isinstance(cloud, PointCloud) else PointCloud(cloud)
            if cloud.neighbors is None:
                cloud = preprocess(cloud, voxel_size, num_neighbors)
        except ValueError as error:
            raise ValueError(f"frames[{i}]: {error}") from error
        if before is None:
            yield Step(cloud, pose, None)
        else:
            result = register_with(cloud, before, method, motion, chosen)
            if is_usable(result):
                motion = np.asarray(result.matrix)
            # The product of thousands of rounded rotations would drift away from a rotation.
            pose = nearest_rotation(pose @ motion)
            yield Step(cloud, pose, computed(result))
        before = cloud


def aggregate(clouds: Iterable[PointCloud | Values], poses: Iterable[Pose], voxel_size: float) -> PointCloud:
    """Merge clouds into one map: the mean of all points, and of their channels, per voxel of the world.

    Clouds are processed one by one; memory grows with the size of the map, not with the number of clouds.

    Args:
        clouds: clouds or (N, 3) arrays in metres, in their sensor frames, with the same channels. Points with a
            non-finite coordinate or channel are ignored.
        poses: one pose per cloud, sensor to world.
        voxel_size: metres.

    Returns:
        Raw float64 cloud in the world frame.

    Raises:
        ValueError: if there are no clouds, the number of poses differs, a pose is no rigid motion, the channels
            differ, or a point lies more than 2²⁰ voxels from the world's origin along an axis.
    """
    if not 0 < voxel_size < np.inf:
        raise ValueError(f"voxel_size: expected a positive number of metres, got {voxel_size!r}")
    keys, sums, names = np.empty(0, np.int64), None, None
    for i, (cloud, pose) in enumerate(zip(clouds, poses, strict=True)):
        cloud = cloud.unpad() if isinstance(cloud, PointCloud) else PointCloud(cloud)
        if names is None:
            names = cloud.channel_names
        elif cloud.channel_names != names:
            raise ValueError(f"clouds[{i}]: expected the channels {names}, got {cloud.channel_names}")
        matrix = np.asarray(pose_matrix(pose, f"poses[{i}]"))
        points = np.asarray(cloud.points, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        rows = np.hstack([np.ones((len(points), 1)), points, *_valid_channels(cloud)])
        finite = np.isfinite(rows).all(axis=1)
        keys = np.concatenate([keys, _voxels(points[finite], voxel_size)])
        sums = rows[finite] if sums is None else np.concatenate([sums, rows[finite]])
        keys, sums = _merge(keys, sums)
    if sums is None or names is None:
        raise ValueError("clouds: expected at least one, got none")
    points = sums[:, 1:4] / sums[:, :1]
    values, counts = np.split(sums[:, 4:], 2, axis=1)
    valid = counts > 0
    return PointCloud(
        points,
        values / np.maximum(counts, 1),
        channel_valid=None if valid.all() else valid,
        channel_names=names,
    )


def _valid_channels(cloud: PointCloud) -> tuple[Float[np.ndarray, "N C"], Float[np.ndarray, "N C"]]:
    """Channels, 0 where missing, and their mask as 1 or 0."""
    channels = np.asarray(cloud.channels, np.float64)
    if cloud.channel_valid is None:
        return channels, np.ones_like(channels)
    return channels, np.asarray(cloud.channel_valid, np.float64)


def _voxels(points: Float[np.ndarray, "N 3"], voxel_size: float) -> np.ndarray:
    """One integer key per point for the voxel that contains it."""
    cells = np.floor(points / voxel_size)
    if np.abs(cells).max(initial=0) >= _HALF_RANGE:
        raise ValueError(
            f"voxel_size: {voxel_size} m puts points {np.abs(cells).max():.0f} voxels from the origin, expected fewer "
            f"than {_HALF_RANGE}; choose a larger size, or poses nearer to the origin"
        )
    x, y, z = (cells.astype(np.int64) + _HALF_RANGE).T
    return (x << 42) | (y << 21) | z


def _merge(keys: np.ndarray, rows: Float[np.ndarray, "N D"]) -> tuple[np.ndarray, Float[np.ndarray, "M D"]]:
    """Unique keys, sorted, and the sum of the rows of each key."""
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    starts = np.flatnonzero(np.concatenate([np.ones(min(len(keys), 1), bool), keys[1:] != keys[:-1]]))
    return keys[starts], np.add.reduceat(rows[order], starts, axis=0) if len(starts) else rows
