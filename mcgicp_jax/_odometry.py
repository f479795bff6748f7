"""Odometry by registration of consecutive frames, or of each frame to a map of those before."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mcgicp_jax._channels import point_spacing
from mcgicp_jax._cloud import PointCloud, Values
from mcgicp_jax._map import VoxelMap
from mcgicp_jax._methods import AbstractMethod
from mcgicp_jax._options import Options, check_method, check_positive
from mcgicp_jax._pose import Pose, nearest_rotation, pose_matrix
from mcgicp_jax._preprocess import check_preprocessing, preprocess
from mcgicp_jax._register import global_pose, register_with
from mcgicp_jax._result import Registration, computed, is_usable
from mcgicp_jax.datasets import Frame

# A registration with less than this fraction of the overlap of the one before has lost the way: an order of magnitude,
# since at constant speed the overlap hardly changes.
_LOST = 0.5


@dataclass(frozen=True, eq=False)
class Step:
    """The result of `odometry` for one frame.

    Attributes:
        cloud: the preprocessed cloud, in the sensor's frame.
        pose: (4, 4) float64, sensor to world, metres.
        registration: registration of this frame to the previous one (or with `against="map"`, or after a recovery, to
            the map, in the world's frame), None for the first; check its `converged`.
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
    against: Literal["previous", "map"] = "previous",
    map_radius: float | None = None,
    recover: bool = False,
    **options: Any,
) -> Iterator[Step]:
    """Register each frame to the previous one, or to a map, starting from the previous motion (constant velocity).

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
        against: "previous": register to the previous frame. "map": to the points of all frames before that lie within
            `map_radius` of the last pose, averaged per voxel. Errors then accumulate more slowly.
        map_radius: metres; by default the distance of the farthest point of the first frame from its sensor.
        recover: find a frame that is lost, as after a jump, by `global_pose` in a map of all frames before, which is
            then kept in memory. A frame is lost if its registration has too few matches, non-finite values, or half
            the overlap of the one before; so are the next ones, until one is found. Lost frames do not enter the map.
        options: options of `register`.

    Yields:
        One `Step` per frame, including the first.

    Raises:
        ValueError: if a cloud or an argument is invalid; for a cloud the message names the frame.
    """
    check_preprocessing(voxel_size, num_neighbors)
    check_method(method)
    if against not in ("previous", "map"):
        raise ValueError(f'against: expected "previous" or "map", got {against!r}')
    if map_radius is not None:
        check_positive("map_radius", map_radius)
    chosen = Options(**options)
    motion = pose_matrix(init)
    pose = np.asarray(pose_matrix(start, "start"))
    before: PointCloud | None = None
    world: VoxelMap | None = None
    places: _Places | None = None
    for i, frame in enumerate(frames):
        try:
            cloud = _prepared(frame, voxel_size, num_neighbors)
        except ValueError as error:
            raise ValueError(f"frames[{i}]: {error}") from error
        result = again = None
        if before is not None:
            target = before if world is None else _target(world.cloud(), method, chosen, num_neighbors)
            result = register_with(cloud, target, method, motion if world is None else pose @ motion, chosen)
            if places is not None and places.lose(result):
                again = places.find(cloud, method, chosen, num_neighbors)
            elif is_usable(result):
                motion = np.asarray(result.matrix) if world is None else np.linalg.solve(pose, result.matrix)
            # The product of thousands of rounded rotations would drift away from a rotation.
            pose = nearest_rotation(pose @ motion if again is None else np.asarray(again.matrix))
        if world is None and against == "map":
            world = VoxelMap(voxel_size or float(point_spacing(cloud)))
            farthest = float(np.linalg.norm(cloud.coordinates, axis=1).max())
            radius = farthest if map_radius is None else map_radius
        if places is None and recover:
            places = _Places(voxel_size or float(point_spacing(cloud)))
        if places is not None:
            places.add(f"frames[{i}]", cloud, pose)
        if world is not None:
            world.add(f"frames[{i}]", cloud, pose)
            world.forget(pose[:3, 3], radius)
        before = cloud
        shown = result if again is None else again
        yield Step(cloud, pose, None if shown is None else computed(shown))


class _Places:
    """A map of all frames whose poses are known, in which a lost frame is found again."""

    def __init__(self, voxel_size: float):
        self._world = VoxelMap(voxel_size)
        self._overlap = 0.0
        self._lost = False

    def lose(self, result: Registration) -> bool:
        """Whether the frame is lost by this registration, or one before was and is not found yet."""
        overlap = float(np.asarray(result.overlap))
        self._lost = self._lost or not is_usable(result) or overlap < _LOST * self._overlap
        if not self._lost:
            self._overlap = overlap
        return self._lost

    def find(
        self, cloud: PointCloud, method: AbstractMethod, options: Options, num_neighbors: int
    ) -> Registration | None:
        """The registration of a lost frame to the map, in the world's frame; None if it is not found."""
        known = self._world.cloud()
        start = global_pose(cloud, known)
        if not start.success:
            return None
        result = register_with(cloud, _target(known, method, options, num_neighbors), method, start.matrix, options)
        self._lost = not is_usable(result)
        return None if self._lost else result

    def add(self, name: str, cloud: PointCloud, pose: Float[np.ndarray, "4 4"]) -> None:
        if not self._lost:
            self._world.add(name, cloud, pose)


def _prepared(frame: Frame | PointCloud | Values, voxel_size: float | None, num_neighbors: int) -> PointCloud:
    cloud = frame.cloud if isinstance(frame, Frame) else frame
    cloud = cloud if isinstance(cloud, PointCloud) else PointCloud(cloud)
    return cloud if cloud.neighbors is not None else preprocess(cloud, voxel_size, num_neighbors)


def _target(cloud: PointCloud, method: AbstractMethod, options: Options, num_neighbors: int) -> PointCloud:
    """The map as a target; raw if the method makes cells of it."""
    return cloud if options.takes_raw(method, "target") else preprocess(cloud, num_neighbors=num_neighbors)
