"""Odometry: each frame of a sequence registered to the one before; and the map that the frames make."""

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

# Voxel numbers are packed into one 64-bit key, 21 bits each, from −2²⁰ on.
_HALF_RANGE = 2**20


@dataclass(frozen=True, eq=False)
class Step:
    """One frame of an odometry.

    Attributes:
        cloud: as it was registered: preprocessed, in the sensor's frame.
        pose: (4, 4) float64, sensor to world.
        registration: to the frame before, None for the first; look at its `converged`.
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
    """Register each frame to the one before, starting from the motion before (constant velocity).

    Lazy: frames are taken one by one and none but the last is kept, so that a sequence may be longer than memory.
    `tqdm.tqdm(odometry(frames, ...), total=len(frames))` shows the progress. A registration that ends with too few
    pairs or without finite numbers is replaced by the motion before; its `registration` says so.

    Args:
        frames: frames of a data set, clouds or (N, 3) arrays; what is preprocessed already is taken as it is.
        method: numbers that it leaves open are chosen from the data of every pair.
        voxel_size, num_neighbors: for `preprocess`.
        init: T_target_source to start the first pair from, whose motion is not yet known; the identity by default, and
            then `max_distance` must be more than the motion.
        start: pose of the first frame in the world; the identity by default.
        options: any option of `register`.

    Yields:
        A step for every frame, the first among them.

    Raises:
        ValueError: if a cloud or an argument does not fit.
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
            # Products of thousands of rounded rotations would drift from being one.
            pose = nearest_rotation(pose @ motion)
            yield Step(cloud, pose, computed(result))
        before = cloud


def aggregate(clouds: Iterable[PointCloud | Values], poses: Iterable[Pose], voxel_size: float) -> PointCloud:
    """One map of many clouds: the mean of all points, and of their channels, in each voxel of the world.

    Clouds are taken one by one; memory grows with the map, not with their number.

    Args:
        clouds: or (N, 3) arrays, in their sensors' frames, with the same channels.
        poses: one for each, sensor to world.
        voxel_size: metres.

    Returns:
        A raw cloud in the world, float64.

    Raises:
        ValueError: if there are no clouds or not one pose for each, their channels differ, or the map is wider than
            2²⁰ voxels from the world's origin.
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
    """Channels, 0 where there are none; and 1 or 0 for whether there are."""
    channels = np.asarray(cloud.channels, np.float64)
    if cloud.channel_valid is None:
        return channels, np.ones_like(channels)
    return channels, np.asarray(cloud.channel_valid, np.float64)


def _voxels(points: Float[np.ndarray, "N 3"], voxel_size: float) -> np.ndarray:
    cells = np.floor(points / voxel_size)
    if np.abs(cells).max(initial=0) >= _HALF_RANGE:
        raise ValueError(
            f"voxel_size: {voxel_size} m puts points {np.abs(cells).max():.0f} voxels from the origin, expected fewer "
            f"than {_HALF_RANGE}; choose a larger one, or poses that start nearer to it"
        )
    x, y, z = (cells.astype(np.int64) + _HALF_RANGE).T
    return (x << 42) | (y << 21) | z


def _merge(keys: np.ndarray, rows: Float[np.ndarray, "N D"]) -> tuple[np.ndarray, Float[np.ndarray, "M D"]]:
    """Rows of one key added up."""
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    starts = np.flatnonzero(np.concatenate([np.ones(min(len(keys), 1), bool), keys[1:] != keys[:-1]]))
    return keys[starts], np.add.reduceat(rows[order], starts, axis=0) if len(starts) else rows
