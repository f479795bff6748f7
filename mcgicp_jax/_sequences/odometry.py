"""Odometry: registration of each frame to the previous one, or to a map of the previous frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, Unpack

import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.frame import Frame
from mcgicp_jax._clouds.point_cloud import PointCloud, Values
from mcgicp_jax._clouds.preprocess import check_preprocessing, preprocess
from mcgicp_jax._clouds.voxel_map import VoxelMap
from mcgicp_jax._compute.argument_checks import check_positive
from mcgicp_jax._local_geometry.spacing_and_noise import point_spacing
from mcgicp_jax._math.poses import Pose, nearest_rotation, pose_matrix
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pose_graph.graph import PoseGraph
from mcgicp_jax._registration.options import GivenOptions, Options, check_method, options_of
from mcgicp_jax._registration.register_pair import register_pair
from mcgicp_jax._registration.result import RegistrationResult, computed, is_usable
from mcgicp_jax._sequences.loop_closure import Trajectory
from mcgicp_jax._sequences.relocalization import Relocalizer, map_target


@dataclass(frozen=True, eq=False)
class OdometryStep:
    """One frame of `odometry`.

    Attributes:
        cloud: the preprocessed cloud, in the sensor's frame.
        pose: (4, 4) float64, sensor to world, metres.
        registration: registration of this frame to the previous one (or with `against="map"`, or after a recovery, to
            the map, in the world's frame), None for the first; check its `converged`.
        graph: with `loops`, the poses of all frames so far, corrected by the loops, and the edges between them;
            `optimize_poses(step.graph)` computes their covariances. None otherwise.
    """

    cloud: PointCloud
    pose: Float[np.ndarray, "4 4"]
    registration: RegistrationResult | None
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
    recover: bool = False,
    loops: bool = False,
    **options: Unpack[GivenOptions],
) -> Iterator[OdometryStep]:
    """Register each frame to the previous one, or to a map, starting from the previous motion (constant velocity).

    If a registration has too few matches or non-finite values, its result is not used: the sensor is taken to repeat
    the previous motion.

    Args:
        frames: iterable of `datasets.Frame`, `PointCloud` or (N, 3) arrays in metres; consumed lazily. Preprocessed
            clouds are used unchanged.
        method: registration method.
        voxel_size, num_neighbors: arguments of `preprocess`. The map has the same voxel size, by default the point
            spacing of the first frame.
        init: motion of the sensor between the first two frames, to start from, `jaxlie.SE3` or (4, 4); the identity by
            default.
        start: pose of the first frame, sensor to world; the identity by default.
        against: "previous": register to the previous frame. "map": to the points of all frames before that lie within
            `map_radius` of the last pose, averaged per voxel. Errors then accumulate more slowly.
        map_radius: metres; by default the distance of the farthest point of the first frame from its sensor.
        recover: relocalise after a jump: if a registration does not converge or its overlap drops by a fifth, find the
            frame by `global_pose` in a map of all previous frames, which is kept in memory. If relocalisation fails and
            the registration has too few matches, or less than half of the previous overlap, tracking is lost: poses are
            extrapolated with constant velocity and the map is not updated until a frame is relocalised.
        loops: close loops: register a frame to an earlier one whose position is near, within the uncertainty of the
            poses, and correct all poses by `optimize_poses`. Steps keep the pose known at their time; the corrected
            poses are in the `graph` of the last step. All clouds are kept in memory. Not with `against="map"` or
            `recover`.
        options: options of `register`, except for `tie_points` and `prior`.

    Yields:
        One `OdometryStep` per frame, including the first.

    Raises:
        ValueError: on iteration, if a cloud or an argument is invalid; for a cloud the message names the frame.
    """
    check_preprocessing(voxel_size, num_neighbors)
    check_method(method)
    if against not in ("previous", "map"):
        raise ValueError(f'against: expected "previous" or "map", got {against!r}')
    if map_radius is not None:
        check_positive("map_radius", map_radius)
    if loops and (against == "map" or recover):
        raise ValueError(
            'loops: expected against="previous" and no recover: registrations to the previous frame become edges'
        )
    sensor = _Sensor(
        method, options_of(odometry, options), num_neighbors, pose_matrix(init), np.asarray(pose_matrix(start, "start"))
    )
    for i, frame in enumerate(frames):
        try:
            cloud = _prepared(frame, voxel_size, num_neighbors)
        except ValueError as error:
            raise ValueError(f"frames[{i}]: {error}") from error
        if i == 0:
            voxel = voxel_size or float(point_spacing(cloud))
            farthest = float(np.linalg.norm(cloud.coordinates, axis=1).max())
            sensor.world = VoxelMap(voxel) if against == "map" else None
            sensor.radius = farthest if map_radius is None else map_radius
            sensor.places = Relocalizer(voxel) if recover else None
            sensor.trajectory = Trajectory(method, sensor.options) if loops else None
        yield sensor.add(f"frames[{i}]", cloud)


@dataclass
class _Sensor:
    """The sensor at its last frame, and the maps of the previous frames.

    Attributes:
        motion: (4, 4), between the last two frames.
        pose: (4, 4), sensor to world.
        cloud: the last frame; None before the first.
        world: the map that frames are registered to; None registers them to the previous frame.
        radius: metres around the sensor beyond which points leave the map.
        places: the map in which lost frames are found; None without relocalisation.
        trajectory: poses and edges; None without loop closure.
    """

    method: AbstractMethod
    options: Options
    num_neighbors: int
    motion: Any
    pose: Float[np.ndarray, "4 4"]
    cloud: PointCloud | None = None
    world: VoxelMap | None = None
    radius: float = np.inf
    places: Relocalizer | None = None
    trajectory: Trajectory | None = None

    def add(self, name: str, cloud: PointCloud) -> OdometryStep:
        """Locate the sensor at the next frame, and add the frame to the maps."""
        result = None if self.cloud is None else self._located(cloud, self.cloud)
        if self.places is not None:
            self.places.add(name, cloud, self.pose)
        if self.world is not None:
            self.world.add(name, cloud, self.pose)
            self.world.forget(self.pose[:3, 3], self.radius)
        if self.trajectory is not None:
            self.pose = self.trajectory.add(cloud, self.pose, result)
        self.cloud = cloud
        graph = None if self.trajectory is None else self.trajectory.graph
        return OdometryStep(cloud, self.pose, None if result is None else computed(result), graph)

    def _located(self, cloud: PointCloud, before: PointCloud) -> RegistrationResult:
        """Update motion and pose by a registration."""
        if self.world is None:
            result = register_pair(cloud, before, self.method, self.motion, self.options)
        else:
            target = map_target(self.world.cloud(), self.method, self.options, self.num_neighbors)
            result = register_pair(cloud, target, self.method, self.pose @ self.motion, self.options)
        found = None
        if self.places is not None:
            found = self.places.corrected(cloud, result, self.method, self.options, self.num_neighbors)
        lost = self.places is not None and self.places.is_lost
        if found is None and not lost and is_usable(result):
            relative = self.world is None
            self.motion = np.asarray(result.matrix) if relative else np.linalg.solve(self.pose, result.matrix)
        # The product of thousands of rounded rotations would drift away from a rotation.
        self.pose = nearest_rotation(self.pose @ self.motion if found is None else np.asarray(found.matrix))
        return result if found is None else found


def _prepared(frame: Frame | PointCloud | Values, voxel_size: float | None, num_neighbors: int) -> PointCloud:
    cloud = frame.cloud if isinstance(frame, Frame) else frame
    cloud = cloud if isinstance(cloud, PointCloud) else PointCloud(cloud)
    return cloud if cloud.neighbors is not None else preprocess(cloud, voxel_size, num_neighbors)
