"""Multiway registration: all overlapping pairs of many clouds are registered, and a pose graph joins the results."""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Sized
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias, Unpack

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array, csr_array

from mcgicp_jax._clouds.point_cloud import PointCloud, Values, as_cloud, check_several
from mcgicp_jax._clouds.preprocess import check_preprocessing, preprocess
from mcgicp_jax._clouds.voxel_map import merge_clouds
from mcgicp_jax._clouds.voxel_size import NUM_NEIGHBORS, VoxelSize, voxels_for
from mcgicp_jax._clouds.voxels import wrapped_keys
from mcgicp_jax._compute.messages import check_concrete, messages_named, warnings_named
from mcgicp_jax._local_geometry.cloud_statistics import point_spacing
from mcgicp_jax._math.poses import Pose, exponential, logarithm, pose_matrices, rotated
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pairs.batch import register_batch
from mcgicp_jax._pairs.batch_executors import GivenExecutor
from mcgicp_jax._pose_graph.edge import Edge
from mcgicp_jax._pose_graph.graph import PoseGraph
from mcgicp_jax._pose_graph.levenberg_marquardt import typical_information
from mcgicp_jax._pose_graph.optimize import PoseGraphResult, optimize_poses
from mcgicp_jax._registration.options import GivenOptions, Options, check_method, options_of
from mcgicp_jax._registration.register_pair import register_pair
from mcgicp_jax._registration.result import RegistrationResult, Status, computed, is_usable
from mcgicp_jax._sequences.loop_closure import LEAST_OVERLAP_OF_LOOP, edge_from, rows_before

# Size of the cells in which overlap is counted, in spacings of the points: two samples of one surface then occupy
# nearly the same cells.
_CELL = 5.0
# Largest variance of a pose whose directions are all constrained, as a multiple of that of a typical edge: chains of n
# edges have n, and unconstrained directions 1e9.
_LARGEST_VARIANCE = 1e6
# Largest number of rounds of registration. From the second on, only newly overlapping pairs are registered.
_ROUNDS = 5

_Poses: TypeAlias = Float[np.ndarray, "n 4 4"]
_Registrations: TypeAlias = dict[tuple[int, int], RegistrationResult]


@dataclass(frozen=True, eq=False)
class MultiwayResult:
    """The result of `multiway`.

    Attributes:
        clouds: the n preprocessed clouds, each in its own frame.
        graph: result of `optimize_poses`: the poses of the clouds with status and covariances, and the edges.
        registrations: maps each pair (i, j) to the registration of cloud j to cloud i. Those that failed or overlap by
            less than 40 % have no edge in `graph`.
        statuses: of each cloud: CONVERGED; TOO_FEW_CORRESPONDENCES if it has no edge; DEGENERATE if at least half of
            its edges contradict the others, or its edges leave a direction of its pose, in the frame of the first
            cloud, unconstrained. A cloud of another place does not disturb the others, and is often CONVERGED itself,
            at a wrong pose with low overlap.
        voxel_size: of the map, metres: that of the clouds, or their median point spacing.
    """

    clouds: list[PointCloud]
    graph: PoseGraphResult
    registrations: dict[tuple[int, int], RegistrationResult]
    statuses: tuple[Status, ...]
    voxel_size: float

    @cached_property
    def map(self) -> PointCloud:
        """All clouds in the world's frame, averaged per voxel; made when first read."""
        return merge_clouds(self.clouds, self.poses, self.voxel_size)

    @property
    def poses(self) -> Float[np.ndarray, "n 4 4"]:
        """(n, 4, 4), cloud to world, metres."""
        return np.asarray(self.graph.poses)

    @property
    def converged(self) -> bool:
        """Whether the optimisation of the graph converged, and the status of each cloud is CONVERGED."""
        return bool(self.graph.converged) and all(status == Status.CONVERGED for status in self.statuses)


def multiway(
    clouds: Iterable[PointCloud | Values],
    method: AbstractMethod,
    pairs: Sequence[tuple[int, int]] | None = None,
    *,
    init: Sequence[Pose] | Float[np.ndarray, "n 4 4"] | None = None,
    voxel_size: VoxelSize = "auto",
    num_neighbors: int = NUM_NEIGHBORS,
    executor: GivenExecutor = None,
    **options: Unpack[GivenOptions],
) -> MultiwayResult:
    """Register many clouds of one scene with each other and find one pose for each.

    Registrations of overlapping pairs, with their covariances, become the edges of a pose graph, which `optimize_poses`
    solves. Pairs that overlap only at the new poses are registered next, in up to five rounds. All edges are uncertain:
    those that contradict the others are rejected, unless a cloud has no others.

    Args:
        clouds: n clouds or (N, 3) arrays, metres. Preprocessed clouds are used unchanged.
        method: registration method.
        pairs: pairs (i, j) of rows of the clouds to register; no others are. By default each cloud is paired with the
            one before it, and with the cloud of largest overlap among those 2 to 3 places before it, 4 to 7, 8 to 15,
            and so on, if that overlap is at least 40 %. More pairs would add little: the errors of edges that share a
            cloud are not independent.
        init: n poses to start from, cloud to world, `jaxlie.SE3` or (4, 4), metres. By default the clouds are
            registered in order, each to the two before it, and again in the opposite order; the better fits are used.
        voxel_size, num_neighbors: arguments of `preprocess`. "auto": one size for all clouds.
        executor: see `register_batch`, which registers the pairs.
        options: options of `register`, except for `tie_points` and `prior`.

    Returns:
        Clouds, poses, registrations and map.

    Raises:
        ValueError: if there is no cloud, or a cloud or an argument is invalid or traced; the message names it. Failures
            to register show in the status of the graph and of the registrations.
    """
    check_method(method)
    check_preprocessing(voxel_size, num_neighbors)
    check_several("clouds", clouds)
    settings = options_of(multiway, options)
    ready = [as_cloud(f"clouds[{k}]", cloud) for k, cloud in enumerate(clouds)]
    if not ready:
        raise ValueError("clouds: expected at least one, got none")
    arguments = {f"clouds[{k}]": cloud for k, cloud in enumerate(ready)} | {"init": init, "method": method}
    for name, value in (arguments | options).items():
        check_concrete(name, value)
    voxels = voxels_for(voxel_size, *ready)
    for k, cloud in enumerate(ready):
        if cloud.deferred_neighbors is None:
            with messages_named(f"clouds[{k}]"):
                ready[k] = preprocess(cloud, voxels, num_neighbors)
    if pairs is not None:
        for k, pair in enumerate(pairs):
            valid = [isinstance(row, int | np.integer) and 0 <= row < len(ready) for row in pair]
            if len(pair) != 2 or not all(valid) or pair[0] == pair[1]:
                raise ValueError(f"pairs[{k}]: expected two different rows from 0 to {len(ready) - 1}, got {pair}")
        pairs = list(dict.fromkeys((int(i), int(j)) for i, j in pairs))
    poses, registrations = _initial_poses(init, ready, method, settings)
    if pairs is not None:
        registrations = {pair: result for pair, result in registrations.items() if pair in pairs}
    spacing = float(np.median([point_spacing(cloud) for cloud in ready]))
    for _ in range(_ROUNDS if pairs is None else 1):
        overlapping = _overlapping(ready, poses, _CELL * spacing) if pairs is None else pairs
        new = [pair for pair in overlapping if pair not in registrations]
        results = register_batch(
            [ready[j] for _, j in new],
            [ready[i] for i, _ in new],
            method,
            init=[np.linalg.inv(poses[i]) @ poses[j] for i, j in new],
            executor=executor,
            **options,
        )
        registrations |= dict(zip(new, results, strict=True))
        graph, statuses = _solved(poses, registrations)
        poses = np.asarray(graph.poses)
        if not new:
            break
    return MultiwayResult(ready, graph, registrations, statuses, voxels.size or spacing)


def _initial_poses(
    init: Any, clouds: list[PointCloud], method: AbstractMethod, options: Options
) -> tuple[_Poses, _Registrations]:
    """`init`, checked, or poses from registrations in order, and these registrations."""
    if init is None:
        poses, registrations, fit = _chained(clouds, method, options)
        # Also from the other end: a wrong first motion, as to a cloud of another place, may spoil those that follow.
        backward, _, backward_fit = _chained(clouds[::-1], method, options)
        if backward_fit > fit:
            return np.linalg.inv(backward[-1]) @ backward[::-1], {}
        return poses, {pair: computed(result) for pair, result in registrations.items()}
    if isinstance(init, str) or not isinstance(init, Sized):
        raise ValueError(f"init: expected one pose per cloud, got {init!r}; global_pose finds poses of pairs")
    if len(init) != len(clouds):
        raise ValueError(f"init: expected one pose per cloud, {len(clouds)}, got {len(init)}")
    return pose_matrices(init, "init[{}]"), {}


def _chained(
    clouds: list[PointCloud], method: AbstractMethod, options: Options
) -> tuple[_Poses, _Registrations, float]:
    """Poses of clouds registered in order, the registrations that they follow from, and the sum of the fits. Each cloud
    is registered to both before it, of which one may be of another place; the better fit is used."""
    registrations: _Registrations = {}
    poses, steps, total = [np.eye(4)], [np.zeros(6)], 0.0
    for k in range(1, len(clouds)):
        rows = range(max(k - 2, 0), k)
        starts = [exponential((k - i) * steps[i]) for i in rows]
        targets = zip(rows, starts, strict=True)
        results = []
        for i, start in targets:
            with warnings_named(f"clouds[{k}] to clouds[{i}]"):
                results.append(register_pair(clouds[k], clouds[i], method, start, options))
        # Overlap per distance of the matches, 1/m; 0 without a pose. MAX_ITERATIONS has one: on sparse points, updates
        # may oscillate about the right pose.
        with np.errstate(divide="ignore"):
            fits = [float(np.asarray(r.overlap) / np.asarray(r.rmse)) if is_usable(r) else 0.0 for r in results]
        best = int(np.argmax(fits))
        i, result, total = rows[best], results[best], total + fits[best]
        registrations[i, k] = result
        motion = np.asarray(result.matrix, np.float64) if is_usable(result) else starts[best]
        poses.append(poses[i] @ motion)
        steps.append(logarithm(motion) / (k - i))
    return np.array(poses), registrations, total


def _solved(poses: _Poses, registrations: _Registrations) -> tuple[PoseGraphResult, tuple[Status, ...]]:
    """The poses from all edges, and the status of each cloud. Edges are rejected unless they alone connect clouds."""
    from scipy.sparse.csgraph import minimum_spanning_tree

    measured = [edge_from(i, j, result, uncertain=True) for (i, j), result in registrations.items()]
    graph = PoseGraph(poses, [edge for edge in measured if edge is not None])
    result = optimize_poses(graph)
    edges, accepted, n = graph.edges, np.asarray(result.kept), len(poses)
    costs = np.where(accepted, 1e-3, 1 + np.asarray(result.residuals))
    tree = minimum_spanning_tree(coo_array((costs, (edges.i, edges.j)), (n, n))).toarray()
    needed = ~accepted & (tree[edges.i, edges.j] > 0)
    if needed.any():
        trusted = Edge(edges.i, edges.j, edges.T_i_j, edges.information, uncertain=~needed)
        result = optimize_poses(PoseGraph(result.poses, trusted))
    ends = np.concatenate([edges.i, edges.j])
    agreeing, total = np.bincount(ends, np.tile(accepted, 2), n), np.bincount(ends, minlength=n)
    failed = np.where(total == 0, Status.TOO_FEW_CORRESPONDENCES, Status.DEGENERATE)
    codes = np.where(agreeing > 0.5 * total, Status.CONVERGED, failed) if n > 1 else [Status.CONVERGED]
    if result.status == Status.DEGENERATE and len(edges):
        variances = np.diagonal(result.covariance, 0, 1, 2) * typical_information((edges,))[0]
        unconstrained = ~(variances.max(axis=1) <= _LARGEST_VARIANCE)
        codes = np.where((codes == Status.CONVERGED) & unconstrained, Status.DEGENERATE, codes)
    return result, tuple(Status(int(code)) for code in codes)


def _overlapping(clouds: list[PointCloud], poses: _Poses, cell: float) -> list[tuple[int, int]]:
    """Each cloud with the previous one, and with that of largest overlap in each range of gaps 2-3, 4-7, 8-15, …"""
    # Unique cells of each cloud in the world's frame, and the numbers of cells that two clouds have in common.
    moved = [rotated(cloud.coordinates, T[:3, :3]) + T[:3, 3] for cloud, T in zip(clouds, poses, strict=True)]
    keys = [np.unique(wrapped_keys(points, cell)) for points in moved]
    sizes = np.array([len(cells) for cells in keys])
    columns = np.unique(np.concatenate(keys), return_inverse=True)[1]
    occupied = csr_array((np.ones(len(columns)), columns, np.concatenate([[0], np.cumsum(sizes)])))
    common = csr_array(occupied @ occupied.T)
    pairs = []
    for j in range(1, len(clouds)):
        pairs.append((j - 1, j))
        overlaps = common[[j]].toarray()[0] / np.minimum(sizes, sizes[j])
        for rows in rows_before(j):
            best = max(rows, key=lambda row: overlaps[row])
            if overlaps[best] >= LEAST_OVERLAP_OF_LOOP:
                pairs.append((best, j))
    return pairs
