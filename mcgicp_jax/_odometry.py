"""Odometry by registration of consecutive frames, or of each frame to a map of those before."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from mcgicp_jax._channels import point_spacing
from mcgicp_jax._cloud import PointCloud, Values
from mcgicp_jax._loops import Trajectory
from mcgicp_jax._map import VoxelMap
from mcgicp_jax._methods import AbstractMethod
from mcgicp_jax._options import Options, check_method, check_positive
from mcgicp_jax._pose import Pose, nearest_rotation, pose_matrix
from mcgicp_jax._pose_graph import PoseGraph
from mcgicp_jax._preprocess import check_preprocessing, preprocess
from mcgicp_jax._register import register_with
from mcgicp_jax._result import Registration, computed, is_usable
from mcgicp_jax.datasets import Frame


@dataclass(frozen=True, eq=False)
class Step:
    """The result of `odometry` for one frame.

    Attributes:
        cloud: the preprocessed cloud, in the sensor's frame.
        pose: (4, 4) float64, sensor to world, metres.
        registration: registration of this frame to the previous one (or with `against="map"` to the map, in the
            world's frame), None for the first; check its `converged`.
        graph: with `loops`, the poses of all frames so far, corrected by the loops, and the edges between them; see
            `optimize_poses` for their covariances. None otherwise.
    """

    cloud: PointCloud
    pose: Float[np.ndarray, "4 4"]
    registration: Registration | None
    graph: PoseGraph | None = None


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
    loops: bool = False,
    **options: Any,
) -> Iterator[Step]:
    """Register each frame to the previous one, or to a map, starting from the previous motion (constant velocity).

    Frames are processed lazily and without `loops` only the latest is kept, so a sequence may be larger than memory.
    For a progress bar, use `tqdm.tqdm(odometry(frames, ...), total=len(frames))`. If a registration ends with too few
    matches or non-finite values, the previous motion is used instead; `Step.registration` keeps the failed result.

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
        loops: whether to look for frames that see again what an earlier one saw, within the uncertainty of the poses,
            register the two, and correct all poses; the poses of `Step.graph` of the last step are then better than
            those of the single steps. Keeps all clouds.
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
    if loops and against == "map":
        raise ValueError('loops: expected against="previous", whose registrations become the edges of a graph')
    chosen = Options(**options)
    trajectory = Trajectory(method, chosen) if loops else None
    motion = pose_matrix(init)
    pose = np.asarray(pose_matrix(start, "start"))
    before: PointCloud | None = None
    world: VoxelMap | None = None
    for i, frame in enumerate(frames):
        try:
            cloud = _prepared(frame, voxel_size, num_neighbors)
        except ValueError as error:
            raise ValueError(f"frames[{i}]: {error}") from error
        result = None
        if before is not None:
            target = before if world is None else _target(world, method, chosen, num_neighbors)
            result = register_with(cloud, target, method, motion if world is None else pose @ motion, chosen)
            if is_usable(result):
                motion = np.asarray(result.matrix) if world is None else np.linalg.solve(pose, result.matrix)
            # The product of thousands of rounded rotations would drift away from a rotation.
            pose = nearest_rotation(pose @ motion)
        if against == "map":
            if world is None:
                world = VoxelMap(voxel_size or float(point_spacing(cloud)))
                farthest = float(np.linalg.norm(cloud.coordinates, axis=1).max())
                radius = farthest if map_radius is None else map_radius
            world.add(f"frames[{i}]", cloud, pose)
            world.forget(pose[:3, 3], radius)
        before = cloud
        if trajectory is not None:
            pose = trajectory.add(cloud, pose, result)
        graph = None if trajectory is None else trajectory.graph
        yield Step(cloud, pose, None if result is None else computed(result), graph)


def _prepared(frame: Frame | PointCloud | Values, voxel_size: float | None, num_neighbors: int) -> PointCloud:
    cloud = frame.cloud if isinstance(frame, Frame) else frame
    cloud = cloud if isinstance(cloud, PointCloud) else PointCloud(cloud)
    return cloud if cloud.neighbors is not None else preprocess(cloud, voxel_size, num_neighbors)


def _target(world: VoxelMap, method: AbstractMethod, options: Options, num_neighbors: int) -> PointCloud:
    """The map as a target; raw if the method makes cells of it."""
    cloud = world.cloud()
    return cloud if options.takes_raw(method, "target") else preprocess(cloud, num_neighbors=num_neighbors)
