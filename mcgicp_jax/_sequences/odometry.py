"""Odometry: registration of each frame to the previous one, or to a map of the previous frames."""

from __future__ import annotations

import collections
import weakref
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Unpack

import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.deskew import deskew as deskew_scan
from mcgicp_jax._clouds.point_cloud import Frame, PointCloud, Values, Voxels, as_cloud, check_several
from mcgicp_jax._clouds.preprocess import check_preprocessing, preprocess
from mcgicp_jax._clouds.voxel_map import VoxelMap
from mcgicp_jax._clouds.voxel_size import NUM_NEIGHBORS, VoxelSize, voxels_for
from mcgicp_jax._compute.cache import Lazy
from mcgicp_jax._compute.messages import check_concrete, check_positive, messages_named, warn
from mcgicp_jax._compute.threads import ReadAhead
from mcgicp_jax._local_geometry.cloud_statistics import point_spacing
from mcgicp_jax._local_geometry.local_geometry import geometry_table
from mcgicp_jax._math.poses import Pose, checked_pose_matrix, exponential, logarithm, nearest_rotation
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pairs.register import doubt_of
from mcgicp_jax._pose_graph.graph import PoseGraph
from mcgicp_jax._registration.options import GivenOptions, Options, check_method, options_of
from mcgicp_jax._registration.register_pair import register_pair, rows_to_match
from mcgicp_jax._registration.result import RegistrationResult, computed, is_usable, verified
from mcgicp_jax._registration.tie_points_and_prior import GivenPrior
from mcgicp_jax._sequences.loop_closure import Trajectory
from mcgicp_jax._sequences.relocalization import Relocalizer, map_target

# A scan is deskewed again if the motion that deskewed it and the measured one displace the points differently by more
# than this fraction of their spacing (rms); at most this number of registrations per frame, since a constant velocity
# during the scan is an approximation itself.
_SAME_MOTION, _ROUNDS = 0.3, 3
# The error of a motion moves all points that are deskewed by it, half as far on average, and so goes into the next
# motions, unless scan and target are deskewed by nearly the same one. The deskewing motion therefore follows the
# measured ones by this fraction only, and displacements below the noise of the motions do not deskew a scan again;
# tests/benchmarks has the errors of other fractions.
_FOLLOWED = 0.5


@dataclass(frozen=True, eq=False)
class OdometryStep:
    """One frame of `odometry`.

    Attributes:
        pose: (4, 4) float64, sensor to world, metres.
        cloud: the preprocessed cloud, in the sensor's frame.
        lost: whether the motion to this frame is unknown and was extrapolated; poses after it in the world have its
            error. With `recover`, also whether the pose is derived from such a one, until a frame is found again.
        deferred_registration, deferred_graph: values of the properties.
    """

    pose: Float[np.ndarray, "4 4"]
    cloud: PointCloud
    deferred_registration: Lazy[RegistrationResult] | None
    lost: bool = False
    deferred_graph: Lazy[PoseGraph] | None = None

    def __repr__(self) -> str:
        position = ", ".join(f"{coordinate:.3f}" for coordinate in self.pose[:3, 3])
        return f"OdometryStep(position ({position}) m{', lost' if self.lost else ''}, {self.cloud!r})"

    @property
    def registration(self) -> RegistrationResult | None:
        """Registration of this frame, None for the first; check its `converged`.

        Its matrix maps to the world with `against="map"` or where `recover` found the frame again; otherwise, and for a
        lost frame, to the previous frame. The registration with which tracking was lost is reported, but not used.
        """
        return None if self.deferred_registration is None else self.deferred_registration.value

    @property
    def graph(self) -> PoseGraph | None:
        """With `loops`, the poses of all frames so far and the edges between them, made when first read; else None.

        Loops that were closed until then have corrected the poses. `optimize_poses(step.graph)` computes covariances.
        """
        return None if self.deferred_graph is None else self.deferred_graph.value


def odometry(
    frames: Iterable[Frame | PointCloud | Values],
    method: AbstractMethod,
    *,
    voxel_size: VoxelSize = "auto",
    num_neighbors: int = NUM_NEIGHBORS,
    init: Pose | None = None,
    start: Pose | None = None,
    against: Literal["previous", "map"] = "previous",
    map_radius: float | None = None,
    recover: bool = False,
    loops: bool = False,
    deskew: bool = False,
    priors: Iterable[GivenPrior | None] | None = None,
    **options: Unpack[GivenOptions],
) -> Iterator[OdometryStep]:
    """Register each frame to the previous one, or to a map, starting from the previous motion (constant velocity).

    If a registration has too few matches or non-finite values, or is UNVERIFIED because another pose fits as well, its
    result is not used: the sensor is taken to repeat the previous motion. Frames after that are registered to this one,
    so that their poses in the world have its error.

    Args:
        frames: iterable of `datasets.Frame`, `PointCloud` or (N, 3) arrays in metres; consumed lazily: while a frame is
            registered, the next one is read and preprocessed in a thread. Preprocessed clouds are used unchanged.
        method: registration method.
        voxel_size, num_neighbors: arguments of `preprocess`. "auto": the size chosen for the first raw frame applies to
            all. The map has the same voxel size, or if there is none, the point spacing of the first frame.
        init: motion of the sensor between the first two frames, to start from, `jaxlie.SE3` or (4, 4); the identity by
            default.
        start: pose of the first frame, sensor to world; the identity by default.
        against: "previous": register to the previous frame. "map": to the points of all previous frames within
            `map_radius` of the last pose, averaged per voxel, so that errors accumulate more slowly.
        map_radius: metres; by default the distance of the farthest point of the first frame from its sensor.
        recover: relocalise after a jump: if a registration does not converge, its overlap drops by a fifth, or the
            distances along the normals double, in units of the thickness of the neighbourhoods, find the frame by
            `global_pose` in a map of all previous frames, which is kept in memory. If that fails and the registration
            has too few matches or such distances, tracking is lost: the pose is extrapolated with constant velocity,
            and the next frames are registered to the previous one, outside of the map, until one is relocalised. A
            place whose surfaces coincide with known ones cannot be told from these.
        loops: close loops: register frames to earlier ones nearby, within the uncertainty of the poses, and correct all
            poses by `optimize_poses`. Steps keep the pose known at their time; the `graph` of the last step has the
            corrected ones. All clouds are kept in memory. Not with `against="map"` or `recover`.
        deskew: undo the motion of the sensor during each scan, by `mcgicp_jax.deskew`: first with the previous motion,
            and if the registration measures another one, again with that. Frames must be raw and have
            `PointCloud.times`, scans follow each other without gaps, and poses are those at the ends of the scans. The
            first scan is deskewed by `init`, or without it, in hindsight by the motion to the second.
        priors: for each frame, a measurement of the motion from the frame before, as by wheels or an IMU, in the form
            of the `prior` of `register`, or None. The registration starts from this pose and weighs it; variances of 0
            fix directions, such as height, roll and pitch of a robot on a floor. The first is not used.
        options: options of `register`, except for `tie_points` and `prior`.

    Returns:
        Iterator over one `OdometryStep` per frame, including the first.

    Raises:
        ValueError: if an argument is invalid or traced; on iteration, if a cloud is. The message names the frame, and
            the iteration may go on with the next one: that one is registered to the last valid frame.

    Warns:
        UserWarning: on iteration without `recover`, if the result of a frame is not used, or if less than 10 % of its
            points have a match (UNVERIFIED, but used). The next one is registered to it all the same.
    """
    check_preprocessing(voxel_size, num_neighbors)
    check_method(method)
    check_several("frames", frames)
    for name, value in {"init": init, "start": start, "method": method, **options}.items():
        check_concrete(name, value)
    if against not in ("previous", "map"):
        raise ValueError(f'against: expected "previous" or "map", got {against!r}')
    if map_radius is not None:
        check_positive("map_radius", map_radius)
        if against != "map":
            raise ValueError(f'map_radius: expected None without against="map", got {map_radius}')
    if loops and (against == "map" or recover):
        expected = 'against="previous" and no recover: registrations to the previous frame become edges'
        raise ValueError(f"loops: expected {expected}")
    settings = options_of(odometry, options)
    if priors is not None and not settings.hold_unconstrained:
        raise ValueError("hold_unconstrained: expected True with priors, got False")
    remaining_priors = None if priors is None else iter(priors)
    reader = _Reader(enumerate(frames), method, settings, voxel_size, num_neighbors, deskew, remaining_priors)
    return _Sensor(
        reader,
        against_map=against == "map",
        radius=map_radius,
        recover=recover,
        loops=loops,
        in_hindsight=deskew and init is None,
        pose=np.asarray(checked_pose_matrix(start, "start")),
        motion=checked_pose_matrix(init),
    )


@dataclass
class _Reader:
    """Reads and prepares the frames. The first raw one decides about an automatic voxel size."""

    frames: Iterator[tuple[int, Frame | PointCloud | Values]]
    method: AbstractMethod
    options: Options
    voxel_size: VoxelSize | Voxels
    num_neighbors: int
    deskew: bool
    priors: Iterator[GivenPrior | None] | None

    def __call__(self) -> tuple[str, PointCloud, GivenPrior | None]:
        """Name, cloud and prior of the next frame; the cloud is raw if it is to be deskewed."""
        number, frame = next(self.frames)
        name = f"frames[{number}]"
        missing = "none: there are fewer priors than frames"
        prior = None if self.priors is None else next(self.priors, missing)
        if prior is not None:
            if not isinstance(prior, tuple | list) or len(prior) != 2:
                raise ValueError(f"priors[{number}]: expected (pose, covariance) or None for each frame, got {prior}")
            prior = checked_pose_matrix(prior[0], f"priors[{number}]: pose"), prior[1]
        cloud = as_cloud(name, frame.cloud if isinstance(frame, Frame) else frame)
        check_concrete(name, cloud)
        if self.deskew and cloud.times is None:
            raise ValueError(f"{name}: expected times of the points to deskew, PointCloud(points, times=...), got none")
        return name, cloud if self.deskew else self.prepared(name, cloud), prior

    def prepared(self, name: str, cloud: PointCloud) -> PointCloud:
        """The cloud preprocessed, with the local geometry that a source needs."""
        if cloud.deferred_neighbors is None:
            with messages_named(name):
                self.voxel_size = voxels_for(self.voxel_size, cloud)
                cloud = preprocess(cloud, self.voxel_size, self.num_neighbors)
        if not (self.options.equalize_channels or self.options.takes_raw(self.method, "source")):
            geometry_table(cloud, self.method.uses_channels).computed(rows_to_match(cloud, self.options))
        return cloud

    def deskewed(self, name: str, cloud: PointCloud, motion: Any) -> PointCloud:
        return self.prepared(name, deskew_scan(cloud, motion)) if self.deskew else cloud


@dataclass(eq=False)
class _Sensor(Iterator[OdometryStep]):
    """The sensor at its last frame, and maps of the frames so far. A class, since generators end when they raise."""

    reader: _Reader
    against_map: bool
    # Metres around the sensor beyond which points leave the map; None: to be taken from the first frame.
    radius: float | None
    recover: bool
    loops: bool
    # The first frame is deskewed by the motion that the second registration measures, and is kept raw until then.
    in_hindsight: bool
    # Sensor to world.
    pose: Float[np.ndarray, "4 4"]
    # Motion between the last two frames.
    motion: Any
    first: tuple[str, PointCloud] | None = None
    # The last frame, None before the first.
    cloud: PointCloud | None = None
    # The map that frames are registered to, that in which lost frames are found, and the poses to close loops with;
    # None: not used.
    world: Any = None
    relocalizer: Relocalizer | None = None
    trajectory: Trajectory | None = None

    def __post_init__(self) -> None:
        self.frames, self.method, self.options = ReadAhead(self.reader), self.reader.method, self.reader.options
        # Motion by which the next scan is first deskewed.
        self.scan_motion = self.motion
        # Registrations of the last two steps.
        self.unread: collections.deque[Any] = collections.deque(maxlen=2)

    @property
    def is_lost(self) -> bool:
        return self.relocalizer is not None and self.relocalizer.is_lost

    def __next__(self) -> OdometryStep:
        name, cloud, prior = next(self.frames)
        if self.cloud is None:
            result, self.first = None, (name, cloud) if self.in_hindsight else None
            cloud = self.reader.deskewed(name, cloud, self.scan_motion)
            self._begin(name, cloud)
        else:
            cloud, result = self._located(name, cloud, self.cloud, prior)
            if self.relocalizer is None:
                if not is_usable(result):
                    warn(
                        f"{name}: {result.status.name}; the motion of the previous frame is used instead. "
                        "recover=True finds lost frames again"
                    )
                elif doubt := doubt_of(result):
                    warn(f"{name}: {doubt}")
            self._add_to_maps(name, cloud, result)
        if self.world is not None:
            self.world.forget(self.pose[:3, 3], self.radius)
            if not len(self.world):
                raise ValueError(f"map_radius: expected metres within which the sensor sees points, got {self.radius}")
        self.cloud = cloud
        graph = None if self.trajectory is None else Lazy(partial(self.trajectory.graph, *self.trajectory.size))
        if result is None:
            return OdometryStep(self.pose, cloud, None, self.is_lost, graph)
        registration = Lazy(partial(computed, verified(result)))
        # The registration of the step before the last is computed if somebody keeps it, since it refers to two frames.
        # The caller of a loop still holds the last step. What nobody reads is not computed.
        if len(self.unread) == 2 and (before_last := self.unread[0]()) is not None:
            _ = before_last.value
        self.unread.append(weakref.ref(registration))
        return OdometryStep(self.pose, cloud, registration, self.is_lost or not is_usable(result), graph)

    def _begin(self, name: str, cloud: PointCloud) -> None:
        voxel = cloud.voxel_size or float(point_spacing(cloud))
        if self.against_map:
            self.world = VoxelMap(voxel)
        if self.recover:
            self.relocalizer = Relocalizer(voxel, self.method, self.options, self.reader.num_neighbors)
        if self.loops:
            self.trajectory = Trajectory(self.method, self.options)
        if self.radius is None:
            self.radius = float(np.linalg.norm(cloud.coordinates, axis=1).max())
        self._add_to_maps(name, cloud, None)

    def _add_to_maps(self, name: str, cloud: PointCloud, result: RegistrationResult | None) -> None:
        for points in (self.relocalizer, self.world):
            if points is not None and not self.is_lost:
                points.add(name, cloud, self.pose)
        if self.trajectory is not None:
            self.pose = self.trajectory.add(cloud, self.pose, result)

    def _located(
        self, name: str, frame: PointCloud, previous: PointCloud, prior: GivenPrior | None
    ) -> tuple[PointCloud, RegistrationResult]:
        """Update motion and pose by a registration; the frame as it was registered, and the result."""
        was_lost, to_map = self.is_lost, self.against_map and not self.is_lost
        motion, scan_motion = (self.motion, self.scan_motion) if prior is None else (prior[0], prior[0])
        for _ in range(_ROUNDS if self.reader.deskew else 1):
            cloud = self.reader.deskewed(name, frame, scan_motion)
            if self.first is not None:
                # The first frame deskewed by the motion to the second, in maps of its own.
                previous = self.reader.deskewed(*self.first, scan_motion)
                self._begin(self.first[0], previous)
            target, init, prior_of_pair = previous, motion, prior
            if to_map:
                target = map_target(self.world.cloud(), self.method, self.options, self.reader.num_neighbors)
                init = self.pose @ motion
                # The covariance is that of a motion in the source's frame, which the target's does not change.
                prior_of_pair = prior and (self.pose @ prior[0], prior[1])
            result = register_pair(cloud, target, self.method, init, self.options, prior=prior_of_pair)
            if not is_usable(result):
                break
            motion = np.linalg.solve(self.pose, result.matrix) if to_map else np.asarray(result.matrix)
            if not self.reader.deskew:
                break
            # Root mean square distance between the points moved by the motion that was assumed and the measured one.
            change = np.linalg.solve(scan_motion, motion)
            shifts = cloud.coordinates @ (change[:3, :3] - np.eye(3)).T + change[:3, 3]
            if float(np.sqrt(np.mean(np.sum(shifts**2, axis=1)))) <= _SAME_MOTION * point_spacing(cloud):
                break
            scan_motion = motion
        self.first = None
        corrected = None if self.relocalizer is None else self.relocalizer.corrected(cloud, target, result)
        # The result with which tracking is lost is not used, those of the frames that follow are.
        if corrected is None and (was_lost or not self.is_lost) and is_usable(result):
            self.motion = motion
            self.scan_motion = scan_motion @ exponential(_FOLLOWED * logarithm(np.linalg.solve(scan_motion, motion)))
        # The product of thousands of rounded rotations would drift away from a rotation.
        self.pose = nearest_rotation(self.pose @ self.motion if corrected is None else np.asarray(corrected.matrix))
        return cloud, result if corrected is None else corrected
