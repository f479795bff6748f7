"""Maps: the points of many clouds in one frame, averaged per voxel."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.point_cloud import PointCloud, Values, Voxels, as_cloud
from mcgicp_jax._clouds.voxel_size import map_voxel_size
from mcgicp_jax._clouds.voxels import starts_of, voxel_keys
from mcgicp_jax._compute.messages import check_concrete, check_positive, messages_named
from mcgicp_jax._math.poses import Pose, checked_pose_matrix, rotated


def merge_clouds(
    clouds: Iterable[PointCloud | Values], poses: Iterable[Pose], voxel_size: float | Literal["auto"] = "auto"
) -> PointCloud:
    """Merge clouds into one map: the mean of all points, and of their channels, per voxel of the world.

    Clouds are processed one by one; memory grows with the size of the map, not with the number of clouds.

    Args:
        clouds: clouds or (N, 3) arrays in metres, in their sensor frames, with the same channels. Points with a
            non-finite coordinate or channel are ignored.
        poses: one pose per cloud, sensor to world.
        voxel_size: metres. "auto": that of the first cloud if it is preprocessed, or as `preprocess` chooses it; if
            there is none, the spacing of its points.

    Returns:
        Raw float64 cloud in the world frame.

    Raises:
        ValueError: if there are no clouds, the number of poses differs, a pose is no rigid motion, the channels
            differ, an array is traced, or a point lies more than 2²⁰ voxels from the first one along an axis.
    """
    if voxel_size != "auto":
        check_positive("voxel_size", voxel_size, 'a positive number or "auto"')
    world: Any = None
    # Marks the end of the shorter sequence.
    end: Any = object()
    for i, (cloud, pose) in enumerate(itertools.zip_longest(clouds, poses, fillvalue=end)):
        if cloud is end or pose is end:
            raise ValueError(f"poses: expected one per cloud, got {'more' if cloud is end else f'only {i}'}")
        name = f"clouds[{i}]"
        cloud = as_cloud(name, cloud)
        check_concrete(name, cloud)
        check_concrete(f"poses[{i}]", pose)
        if world is None:
            world = VoxelMap(map_voxel_size(cloud) if voxel_size == "auto" else voxel_size)
        world.add(name, cloud, np.asarray(checked_pose_matrix(pose, f"poses[{i}]")))
    if world is None:
        raise ValueError("clouds: expected at least one, got none")
    return world.cloud()


class VoxelMap:
    """Sums of positions and channels in each occupied voxel of the world."""

    def __init__(self, voxel_size: float):
        self._voxel_size = voxel_size
        # Sorted keys of the voxels; for each, the number of points and the sums of positions, channels and masks.
        self._keys = np.empty(0, np.int64)
        self._sums: Any = None
        self._names: tuple[str, ...] | None = None
        # Voxel of the first point; keys count from it because they have no room for UTM coordinates.
        self._first: Float[np.ndarray, "3"] | None = None

    def __len__(self) -> int:
        return len(self._keys)

    def add(self, name: str, cloud: PointCloud, pose: Float[np.ndarray, "4 4"]) -> None:
        """Add the finite points of a cloud, moved by its pose (sensor to world); `name` is for error messages."""
        if self._names not in (None, cloud.channel_names):
            raise ValueError(f"{name}: expected the channels {self._names}, got {cloud.channel_names}")
        cloud, self._names = cloud.unpad(), cloud.channel_names
        points = rotated(np.asarray(cloud.points, np.float64), pose[:3, :3]) + pose[:3, 3]
        measured = np.ones(cloud.channels.shape) if cloud.channel_valid is None else cloud.channel_valid
        rows = np.hstack([np.ones((len(points), 1)), points, cloud.channels, measured])
        finite = np.isfinite(rows).all(axis=1)
        if self._first is None and finite.any():
            self._first = np.floor(points[finite][0] / self._voxel_size)
        with messages_named(name):
            point_keys = voxel_keys(points[finite], self._voxel_size, 0.0 if self._first is None else self._first)
        # Sum the rows of each voxel, then add the sums to those of the map.
        order = np.argsort(point_keys, kind="stable")
        starts = starts_of(point_keys[order])
        keys, sums = point_keys[order][starts], np.add.reduceat(rows[finite][order], starts, axis=0)
        if self._sums is None:
            self._sums = np.zeros((0, sums.shape[1]))
        places = np.searchsorted(self._keys, keys)
        new = np.append(self._keys, -1)[places] != keys
        self._sums[places[~new]] += sums[~new]
        self._keys = np.insert(self._keys, places[new], keys[new])
        self._sums = np.insert(self._sums, places[new], sums[new], axis=0)

    def forget(self, center: Float[np.ndarray, "3"], radius: float) -> None:
        """Drop the voxels whose mean point is further than `radius`, metres, from a position."""
        if self._sums is not None:
            means = self._sums[:, 1:4] / self._sums[:, :1]
            near = np.linalg.norm(means - center, axis=1) <= radius
            self._keys, self._sums = self._keys[near], self._sums[near]

    def cloud(self) -> PointCloud:
        points = self._sums[:, 1:4] / self._sums[:, :1]
        values, counts = np.split(self._sums[:, 4:], 2, axis=1)
        valid = counts > 0
        mask = None if valid.all() else valid
        cloud = PointCloud(points, values / np.maximum(counts, 1), channel_valid=mask, channel_names=self._names)
        return cloud.replace_rows(voxels=Voxels(self._voxel_size))
