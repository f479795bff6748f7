"""Multiway registration: all overlapping pairs of many clouds are registered, and a pose graph joins the results."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Unpack

import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.point_cloud import PointCloud, Values
from mcgicp_jax._clouds.preprocess import check_preprocessing, preprocess
from mcgicp_jax._clouds.voxel_map import merge_clouds
from mcgicp_jax._clouds.voxels import voxel_keys, voxel_of
from mcgicp_jax._local_geometry.spacing_and_noise import point_spacing
from mcgicp_jax._math.poses import Pose, pose_matrix
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pairs.batch import register_batch
from mcgicp_jax._pose_graph.graph import PoseGraph
from mcgicp_jax._pose_graph.optimize import PoseGraphResult, optimize_poses
from mcgicp_jax._registration.options import GivenOptions, check_method, options_of
from mcgicp_jax._registration.result import RegistrationResult
from mcgicp_jax._sequences.edges import LEAST_OVERLAP, edge_from
from mcgicp_jax._sequences.odometry import odometry

# Size of the cells in which overlap is counted, in spacings of the points: two samples of one surface then occupy
# nearly the same cells.
_CELL = 5.0
# Largest number of rounds of registration. From the second on, only newly overlapping pairs are registered.
_ROUNDS = 5


@dataclass(frozen=True, eq=False)
class MultiwayResult:
    """The result of `multiway`.

    Attributes:
        clouds: the n preprocessed clouds, each in its own frame.
        graph: result of `optimize_poses`: the poses of the clouds with status and covariances, and the edges.
        registrations: maps each pair (i, j) to the registration of cloud j to cloud i. Registrations that failed or
            overlap by less than 40 % are listed here, but have no edge in `graph`.
        map: all clouds in the world's frame, averaged per voxel; the voxel size is `voxel_size`, or the median point
            spacing of the clouds if none was given.
    """

    clouds: list[PointCloud]
    graph: PoseGraphResult
    registrations: dict[tuple[int, int], RegistrationResult]
    map: PointCloud

    @property
    def poses(self) -> Float[np.ndarray, "n 4 4"]:
        """(n, 4, 4), cloud to world, metres."""
        return np.asarray(self.graph.poses)

    @property
    def converged(self) -> bool:
        """Whether the optimisation of the graph converged."""
        return bool(self.graph.converged)


def multiway(
    clouds: Iterable[PointCloud | Values],
    method: AbstractMethod,
    pairs: Sequence[tuple[int, int]] | None = None,
    *,
    init: Sequence[Pose] | Float[np.ndarray, "n 4 4"] | None = None,
    voxel_size: float | None = None,
    num_neighbors: int = 20,
    executor: Executor | None = None,
    **options: Unpack[GivenOptions],
) -> MultiwayResult:
    """Register many clouds of one scene with each other and find one pose for each.

    Pairs of overlapping clouds are registered, and the registrations with their covariances become the edges of a pose
    graph, which `optimize_poses` solves. Pairs that overlap only at the new poses are registered next, in up to five
    rounds. Edges between consecutive clouds are trusted; all others are uncertain and may be rejected.

    Args:
        clouds: n clouds or (N, 3) arrays, metres. Preprocessed clouds are used unchanged.
        method: registration method.
        pairs: pairs (i, j) of rows of the clouds to register; no others are. By default each cloud is paired with the
            one before it, and with the earlier cloud of largest overlap among those 2 to 3 places before it, among
            those 4 to 7 places before it, 8 to 15, and so on, if that overlap is at least 40 %. More pairs would add
            little: the errors of edges that share a cloud are not independent.
        init: n poses to start from, cloud to world, `jaxlie.SE3` or (4, 4), metres. By default the start is that of
            `odometry`: consecutive clouds are registered in order, each from the previous motion.
        voxel_size, num_neighbors: arguments of `preprocess`.
        executor: see `register_batch`, which registers the pairs.
        options: options of `register`, except for `tie_points` and `prior`.

    Returns:
        Clouds, poses, registrations and map.

    Raises:
        ValueError: if there is no cloud, or a cloud or an argument is invalid; the message names it. Failures to
            register show in the status of the graph and of the registrations.
    """
    check_method(method)
    check_preprocessing(voxel_size, num_neighbors)
    options_of(multiway, options)
    ready = [_ready(k, cloud, voxel_size, num_neighbors) for k, cloud in enumerate(clouds)]
    if not ready:
        raise ValueError("clouds: expected at least one, got none")
    given = None if pairs is None else _checked(pairs, len(ready))
    poses, found = _start(ready, method, init, options)
    if given is not None:
        found = {pair: result for pair, result in found.items() if pair in given}
    spacing = float(np.median([point_spacing(cloud) for cloud in ready]))
    for _ in range(_ROUNDS if given is None else 1):
        wanted = _overlapping(ready, poses, _CELL * spacing) if given is None else given
        new = [pair for pair in wanted if pair not in found]
        results = register_batch(
            [ready[j] for _, j in new],
            [ready[i] for i, _ in new],
            method,
            init=[np.linalg.inv(poses[i]) @ poses[j] for i, j in new],
            executor=executor,
            **options,
        )
        found |= dict(zip(new, results, strict=True))
        graph = optimize_poses(_graph(poses, found))
        poses = np.asarray(graph.poses)
        if not new:
            break
    return MultiwayResult(ready, graph, found, merge_clouds(ready, poses, voxel_size or spacing))


def _start(
    clouds: list[PointCloud],
    method: AbstractMethod,
    init: Sequence[Pose] | Float[np.ndarray, "n 4 4"] | None,
    options: GivenOptions,
) -> tuple[Float[np.ndarray, "n 4 4"], dict[tuple[int, int], RegistrationResult]]:
    """Initial poses, and the registrations from which they were computed."""
    if init is None:
        steps = list(odometry(clouds, method, **options))
        found = {(k - 1, k): step.registration for k, step in enumerate(steps) if step.registration is not None}
        return np.array([step.pose for step in steps]), found
    if isinstance(init, str):
        raise ValueError(f"init: expected one pose per cloud, got {init!r}; global_pose finds poses of pairs")
    if len(init) != len(clouds):
        raise ValueError(f"init: expected one pose per cloud, {len(clouds)}, got {len(init)}")
    return np.array([pose_matrix(pose, f"init[{k}]") for k, pose in enumerate(init)]), {}


def _checked(pairs: Sequence[tuple[int, int]], num_clouds: int) -> list[tuple[int, int]]:
    for k, pair in enumerate(pairs):
        if len(pair) != 2 or not all(0 <= row < num_clouds for row in pair) or pair[0] == pair[1]:
            raise ValueError(f"pairs[{k}]: expected two different rows from 0 to {num_clouds - 1}, got {pair}")
    return [(int(i), int(j)) for i, j in pairs]


def _graph(poses: Float[np.ndarray, "n 4 4"], found: dict[tuple[int, int], RegistrationResult]) -> PoseGraph:
    edges = [edge_from(i, j, result, uncertain=abs(i - j) != 1) for (i, j), result in found.items()]
    return PoseGraph(poses, [edge for edge in edges if edge is not None])


def _overlapping(clouds: list[PointCloud], poses: Float[np.ndarray, "n 4 4"], cell: float) -> list[tuple[int, int]]:
    """Each cloud with the previous one, and with the one of largest overlap in each range of gaps 2-3, 4-7, 8-15, …"""
    moved = [cloud.coordinates @ T[:3, :3].T + T[:3, 3] for cloud, T in zip(clouds, poses, strict=True)]
    cells = [np.unique(voxel_keys(points, cell, voxel_of(moved[0][0], cell))) for points in moved]
    pairs = []
    for j in range(1, len(clouds)):
        pairs.append((j - 1, j))
        for gap in (2**octave for octave in range(1, j.bit_length())):
            rows = range(max(j + 1 - 2 * gap, 0), j + 1 - gap)
            overlaps = [
                len(np.intersect1d(cells[i], cells[j], assume_unique=True)) / min(len(cells[i]), len(cells[j]))
                for i in rows
            ]
            if max(overlaps) >= LEAST_OVERLAP:
                pairs.append((rows[int(np.argmax(overlaps))], j))
    return pairs


def _ready(number: int, cloud: PointCloud | Values, voxel_size: float | None, num_neighbors: int) -> PointCloud:
    try:
        cloud = cloud if isinstance(cloud, PointCloud) else PointCloud(cloud)
        return cloud if cloud.neighbors is not None else preprocess(cloud, voxel_size, num_neighbors)
    except ValueError as error:
        raise ValueError(f"clouds[{number}]: {error}") from error
