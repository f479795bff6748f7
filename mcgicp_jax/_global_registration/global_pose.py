"""Poses from any start: matches of features, hypotheses, and their verification; what `global_pose` does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._clouds.point_cloud import PointCloud, Values
from mcgicp_jax._clouds.preprocess import finite_rows, voxels, with_neighbors
from mcgicp_jax._compute.argument_checks import check_positive
from mcgicp_jax._compute.blocks import BLOCK, blocks, map_rows
from mcgicp_jax._compute.concrete import AnyArray, computed_now
from mcgicp_jax._global_registration.fpfh import NUM_NEIGHBORS, comparable, histograms_of, normals_of, statistics_of
from mcgicp_jax._global_registration.robust_pose_fit import (
    APART,
    NUM_MATCHES,
    TOLERANCE,
    Matches,
    Poses,
    hypotheses,
    refined,
)
from mcgicp_jax._math.poses import Pose, nearest_rotation
from mcgicp_jax._methods.base import GICP, AbstractMethod, MultiChannelGICP
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.result import Registration, is_usable
from mcgicp_jax._search.positions import nearest_in_position

# Rows of the source and rows of the target that match.
RowMatches: TypeAlias = tuple[Any, Any]
# `register_with`.
Registering: TypeAlias = Callable[[PointCloud, PointCloud, AbstractMethod, Pose, Options], Registration]

# Voxels of the smaller cloud, of the larger one, and largest fraction of the points: with 6,000 voxels a scene has
# about a thousand mutual matches, and 20,000 bound the time. With 5,000 to 8,000 the same real pairs are found. Half of
# the points: voxels must not be finer than the points.
_VOXELS, _MOST_VOXELS, _FRACTION = 6000, 20_000, 0.5
# Stride of the points of which voxels are counted first.
_SAMPLE = 4
# Voxel sizes are 2^(j/8) metres, the same for all pairs; this many steps below the extent of the clouds are tried.
_STEPS_PER_OCTAVE, _NUM_STEPS = 8, 120
# Maximum correspondence distances of the registration that verifies a pose, in voxels, and its number of iterations.
_VERIFIED_WITHIN, _VERIFIED_ITERATIONS = (4.0, TOLERANCE), 40
# Number of neighbours for that registration, the default of `preprocess`.
_NUM_NEIGHBORS = 20
# A success has at least this evidence (inliers × overlap) per √n of n matches, and this many inliers. Different scenes
# have up to 1.2 √n (streets of the same kind); real pairs that overlap have 1.6 √n or more, without channels.
_LEAST_EVIDENCE, _MIN_INLIERS = 1.4, 10
# A pose with at least these fractions of the inliers and the overlap of the best one is a rival, which makes the result
# ambiguous. Scans of a road have up to 0.75 of the inliers, with 0.83 of the overlap, at another place along it.
_RIVAL, _RIVAL_OVERLAP = 0.5, 0.9


@dataclass(frozen=True, eq=False)
class Candidate:
    """One pose found by `global_pose`, after the registration that verifies it.

    Attributes:
        matrix: (4, 4) float64, T_target_source, metres.
        num_inliers: number of matches that it maps to within 1.5 voxels of each other.
        overlap: fraction of the source's voxels with a voxel of the target within 1.5 voxels.
    """

    matrix: Float[np.ndarray, "4 4"]
    num_inliers: int
    overlap: float

    @property
    def evidence(self) -> float:
        """Inliers × overlap, by which poses are ranked."""
        return self.num_inliers * self.overlap

    def rivals(self, best: Candidate) -> bool:
        """Whether this pose is about as good as the best one."""
        return self.num_inliers >= _RIVAL * best.num_inliers and self.overlap >= _RIVAL_OVERLAP * best.overlap


@dataclass(frozen=True, eq=False)
class GlobalPose:
    """Result of `global_pose`.

    Attributes:
        matrix: (4, 4) float64, T_target_source, metres; accurate to a fraction of a voxel. The identity if no pose was
            found.
        success: whether to trust the pose: it has more inliers and overlap than clouds of different scenes reach by
            chance, and the result is not `ambiguous`.
        ambiguous: whether another pose is about as good as the best one, as in symmetric or repetitive scenes. False if
            the best pose has too few inliers.
        num_inliers, overlap: number of inliers and overlap of the best pose; see `Candidate`.
        num_matches: number of matches, inliers and outliers.
        runner_up: the second-best pose, among those that differ from the best one by more than five voxels. None if no
            such pose had at least half as many inliers as the best one before the verification.
        voxel_size: metres; size of the voxels from which features are computed.
    """

    matrix: Float[np.ndarray, "4 4"]
    success: bool
    ambiguous: bool
    num_inliers: int
    num_matches: int
    overlap: float
    runner_up: Candidate | None
    voxel_size: float

    def __repr__(self) -> str:
        verdict = "success" if self.success else "ambiguous" if self.ambiguous else "no success"
        return (
            f"GlobalPose({verdict}: {self.num_inliers} inliers of {self.num_matches} matches, overlap "
            f"{self.overlap:.0%}, voxels of {self.voxel_size:.3g} m)"
        )


def find_pose(
    source: PointCloud | Values,
    target: PointCloud | Values,
    voxel_size: float | None,
    correspondences: RowMatches | None,
    register: Registering,
) -> GlobalPose:
    """`global_pose`, with the function that registers two clouds from the poses to verify."""
    if voxel_size is not None:
        check_positive("voxel_size", voxel_size)
    source, target = _cloud("source", source), _cloud("target", target)
    chosen = None if correspondences is None else _checked(correspondences, source, target)
    (one, from_center), (other, to_center) = _centred("source", source), _centred("target", target)
    if one.channels.shape[1] != other.channels.shape[1]:
        one, other = PointCloud(one.points), PointCloud(other.points)
    clouds, centers = (one, other), (from_center, to_center)
    size = _voxel_size(clouds) if voxel_size is None else float(voxel_size)
    prepared = None if size is None else _prepared(clouds, size)
    if prepared is None or size is None:
        return GlobalPose(np.eye(4), False, False, 0, 0, 0.0, None, 0.0 if size is None else size)
    with computed_now():
        if chosen is None:
            matches = _matches_of_features(*prepared, size)
        else:
            matches = _given_matches(source, target, chosen, centers)
        return _answer(matches, prepared, centers, size, register)


def _cloud(name: str, cloud: PointCloud | Values) -> PointCloud:
    try:
        return cloud if isinstance(cloud, PointCloud) else PointCloud(cloud)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _checked(correspondences: RowMatches, source: PointCloud, target: PointCloud) -> Int[np.ndarray, "2 n"]:
    try:
        rows = np.stack([np.asarray(each) for each in correspondences])
    except (TypeError, ValueError) as error:
        raise ValueError("correspondences: expected two arrays of rows, of one length") from error
    sizes = np.array([[source.points.shape[0]], [target.points.shape[0]]])
    if rows.ndim != 2 or rows.shape[0] != 2 or rows.dtype.kind not in "iu" or np.any((rows < 0) | (rows >= sizes)):
        raise ValueError(
            f"correspondences: expected integer rows (source_rows, target_rows) of clouds of {sizes[0, 0]} and "
            f"{sizes[1, 0]} points, got shape {rows.shape} of {rows.dtype}"
        )
    return rows


def _centred(name: str, cloud: PointCloud) -> tuple[PointCloud, Float[np.ndarray, "3"]]:
    """The finite points, in float32 about the middle of their extent, as a raw cloud; and that middle, metres."""
    try:
        cloud = finite_rows(cloud.replace_rows(covariances=None))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    points = cloud.coordinates
    # Working by columns takes a tenth of the time.
    columns = np.ascontiguousarray(points.T)
    center = 0.5 * (columns.min(axis=1) + columns.max(axis=1))
    channels = np.asarray(cloud.channels, np.float32)
    valid = None if cloud.channel_valid is None else np.asarray(cloud.channel_valid)
    return PointCloud((points - center).astype(np.float32), channels, channel_valid=valid), center


def _voxel_size(clouds: tuple[PointCloud, ...]) -> float | None:
    """The smallest size with few enough voxels, metres; None if a cloud has no extent."""
    columns = [np.ascontiguousarray(np.asarray(cloud.points, np.float64).T) for cloud in clouds]
    extent = max(float(np.ptp(each, axis=1).max()) for each in columns)
    if not 0 < extent < np.inf:
        return None
    most = [max(min(_MOST_VOXELS, _FRACTION * len(cloud)), 8) for cloud in clouds]

    def few(step: int, stride: int) -> bool:
        counts = [len(voxels(each[:, ::stride], 2.0 ** (step / _STEPS_PER_OCTAVE))[1]) for each in columns]
        return min(counts) <= _VOXELS and all(count <= limit for count, limit in zip(counts, most, strict=True))

    high = int(np.ceil(_STEPS_PER_OCTAVE * np.log2(extent))) + 1
    low = high - _NUM_STEPS
    # Some of the points have fewer voxels, so that the size is not larger; a few sizes more are counted exactly.
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if few(middle, _SAMPLE) else (middle, high)
    while not few(high, 1):
        high += 1
    return float(2.0 ** (high / _STEPS_PER_OCTAVE))


def _prepared(clouds: tuple[PointCloud, ...], voxel_size: float) -> tuple[PointCloud, PointCloud] | None:
    """The voxels with their neighbours; None if a cloud has too few."""
    try:
        found = [with_neighbors(cloud, voxel_size, NUM_NEIGHBORS) for cloud in clouds]
    except ValueError:
        return None
    return found[0], found[1]


def _matches_of_features(source: PointCloud, target: PointCloud, voxel_size: float) -> Matches:
    """The mutual nearest neighbours among the features; the most distinct ones, if there are many."""
    clouds = source, target
    normals = [normals_of(cloud, voxel_size) for cloud in clouds]
    histograms = [histograms_of(cloud, each, voxel_size) for cloud, each in zip(clouds, normals, strict=True)]
    statistics = None
    if source.channels.shape[1]:
        statistics = statistics_of(source, voxel_size), statistics_of(target, voxel_size)
    features = comparable((histograms[0], histograms[1]), statistics)
    rows, target_rows = mutual_nearest(*features, NUM_MATCHES)
    return _padded(
        np.asarray(source.points)[rows],
        np.asarray(target.points)[target_rows],
        normals[0][rows],
        normals[1][target_rows],
    )


def _given_matches(
    source: PointCloud, target: PointCloud, rows: Int[np.ndarray, "2 n"], centers: tuple[np.ndarray, ...]
) -> Matches:
    points = [
        cloud.coordinates[each] - center for cloud, each, center in zip((source, target), rows, centers, strict=True)
    ]
    finite = np.flatnonzero(np.isfinite(points).all(axis=(0, 2)))
    if finite.size > NUM_MATCHES:
        finite = finite[np.arange(NUM_MATCHES) * finite.size // NUM_MATCHES]
    unknown = np.zeros((finite.size, 3), np.float32)
    return _padded(*(each[finite].astype(np.float32) for each in points), unknown, unknown)


def _padded(*columns: Float[np.ndarray, "n 3"]) -> Matches:
    """The first `NUM_MATCHES` matches."""
    count = min(len(columns[0]), NUM_MATCHES)
    padded = np.zeros((4, NUM_MATCHES, 3), np.float32)
    for array, column in zip(padded, columns, strict=True):
        array[:count] = column[:count]
    points, targets, normals, target_normals = padded
    return Matches(points, targets, normals, target_normals, np.arange(NUM_MATCHES) < count)


def mutual_nearest(
    source: Float[np.ndarray, "N L"], target: Float[np.ndarray, "M L"], most: int
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Rows of features that are nearest to each other, ties to the first row; the most distinct ones first.

    All of them, or at least the first `most`.

    Distinct are those whose squared distance is small relative to that of the second nearest target. All pairs of rows
    are compared in blocks: trees are no faster in so many dimensions.
    """
    nearest, squares = _two_nearest(source, target)
    order = np.argsort(squares[:, 0] / np.maximum(squares[:, 1], 1), kind="stable")
    matched = nearest[order, 0]
    # Targets that are nearest to any source, in this order: those of the most distinct matches may be enough.
    hit, first, number = np.unique(matched, return_index=True, return_inverse=True)
    wanted = np.argsort(first)
    back = np.full(len(hit), -1)
    for start in range(0, len(hit), BLOCK):
        rows = wanted[start : start + BLOCK]
        back[rows] = _two_nearest(target[hit[rows]], source)[0][:, 0]
        known = first[wanted[start + BLOCK]] if start + BLOCK < len(hit) else len(order)
        mutual = np.flatnonzero(back[number[:known]] == order[:known])
        if len(mutual) >= most:
            break
    return order[mutual], matched[mutual]


def _two_nearest(
    queries: Float[np.ndarray, "N L"], rows: Float[np.ndarray, "M L"]
) -> tuple[Int[np.ndarray, "N 2"], Float[np.ndarray, "N 2"]]:
    """The two nearest rows of each query, the first one first where distances tie; and the squared distances."""
    counted = [
        np.ones(BLOCK, bool) if isinstance(index, slice) else _unrepeated(index) for _, index in blocks(len(rows))
    ]

    def search(index: Any) -> list[tuple[Array, Array]]:
        parts = zip(blocks(len(rows)), counted, strict=True)
        return [_nearest(queries[index], rows[other], known) for (_, other), known in parts]

    found = map_rows(search, len(queries), None)
    squares = np.hstack([square for square, _ in found])
    numbers = np.hstack([number + i * BLOCK for i, (_, number) in enumerate(found)])
    best = np.argsort(squares, axis=1, kind="stable")[:, :2]
    return np.take_along_axis(numbers, best, axis=1), np.take_along_axis(squares, best, axis=1)


def _unrepeated(index: Int[np.ndarray, "BLOCK"]) -> Bool[np.ndarray, "BLOCK"]:
    """False for rows that are repeated to fill the last block."""
    return np.append(True, index[1:] != index[:-1])


@jax.jit
def _nearest(
    queries: Float[AnyArray, "n L"], rows: Float[AnyArray, "n L"], counted: Bool[AnyArray, "n"]
) -> tuple[Float[Array, "n 2"], Int[Array, "n 2"]]:
    """Squared distances and numbers of the two nearest rows. Of integers, all terms are exact."""
    squares = [jnp.sum(each * each, axis=1) for each in (queries, rows)]
    product = jnp.matmul(queries, rows.T, precision="highest")
    square = squares[0][:, None] + jnp.where(counted, squares[1], jnp.inf) - 2 * product
    # XLA's top_k takes a third of the time of its argmin.
    nearest, numbers = jax.lax.top_k(-square, 2)
    return -nearest, numbers


def _answer(
    matches: Matches,
    clouds: tuple[PointCloud, PointCloud],
    centers: tuple[np.ndarray, ...],
    voxel_size: float,
    register: Registering,
) -> GlobalPose:
    points = np.asarray(clouds[0].points, np.float64)
    # The root mean square distance from the centre, about which the poses turn.
    radius = float(np.sqrt(np.mean(np.sum(points * points, axis=1))))
    poses = hypotheses(matches, np.float32(voxel_size), np.float32(radius))
    poses = jax.tree.map(np.asarray, refined(poses, matches, np.float32(voxel_size)))
    found = _verified(poses, matches, clouds, voxel_size, radius, register)
    num_matches = int(matches.valid.sum())
    if not found:
        return GlobalPose(np.eye(4), False, False, 0, num_matches, 0.0, None, voxel_size)
    best, *others = sorted(found, key=lambda pose: -pose.evidence)
    best, *others = (replace(pose, matrix=_moved(pose.matrix, centers)) for pose in (best, *others))
    enough = best.num_inliers >= _MIN_INLIERS and best.evidence >= _LEAST_EVIDENCE * np.sqrt(num_matches)
    rivals = any(other.rivals(best) for other in others)
    return GlobalPose(
        matrix=best.matrix,
        success=bool(enough and not rivals),
        ambiguous=bool(enough and rivals),
        num_inliers=best.num_inliers,
        num_matches=num_matches,
        overlap=best.overlap,
        runner_up=others[0] if others else None,
        voxel_size=voxel_size,
    )


def _moved(matrix: Float[np.ndarray, "4 4"], centers: tuple[np.ndarray, ...]) -> Float[np.ndarray, "4 4"]:
    """The pose between the user's frames."""
    matrix = matrix.copy()
    matrix[:3, 3] += centers[1] - matrix[:3, :3] @ centers[0]
    return matrix


def _verified(
    poses: Poses,
    matches: Matches,
    clouds: tuple[PointCloud, PointCloud],
    voxel_size: float,
    radius: float,
    register: Registering,
) -> list[Candidate]:
    """The best pose and its rivals, registered; without repetitions."""
    near = [np.ascontiguousarray(np.asarray(cloud.neighbors)[:, :_NUM_NEIGHBORS]) for cloud in clouds]
    source, target = (cloud.replace_rows(neighbors=rows) for cloud, rows in zip(clouds, near, strict=True))
    method = MultiChannelGICP() if source.channels.shape[1] else GICP()
    options = Options(
        max_distance=(_VERIFIED_WITHIN[0] * voxel_size, _VERIFIED_WITHIN[1] * voxel_size),
        max_iterations=_VERIFIED_ITERATIONS,
    )
    found: list[Candidate] = []
    started: list[np.ndarray] = []
    for matrix in _rivals(poses):
        if any(_same(matrix, other, voxel_size, radius) for other in started):
            continue
        started.append(matrix)
        result = register(source, target, method, matrix, options)
        # A registration that fails, as of clouds with a few coincident points, is no evidence against the matches.
        matrix = np.asarray(result.matrix) if is_usable(result) else matrix
        if not any(_same(matrix, other.matrix, voxel_size, radius) for other in found):
            overlap = _overlap(matrix, source, target, voxel_size)
            found.append(Candidate(matrix, _num_inliers(matrix, matches, voxel_size), overlap))
    return found


def _rivals(poses: Poses) -> Iterator[Float[np.ndarray, "4 4"]]:
    order = np.argsort(-poses.score, kind="stable")
    for i in order:
        if poses.score[i] > 0 and poses.score[i] >= _RIVAL * poses.score[order[0]]:
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = poses.rotation[i], poses.translation[i]
            yield nearest_rotation(matrix)


def _same(a: Float[np.ndarray, "4 4"], b: Float[np.ndarray, "4 4"], voxel_size: float, radius: float) -> bool:
    square = np.sum((a - b)[:3, 3] ** 2) + 0.5 * radius**2 * np.sum((a - b)[:3, :3] ** 2)
    return bool(square <= (APART * voxel_size) ** 2)


def _num_inliers(matrix: Float[np.ndarray, "4 4"], matches: Matches, voxel_size: float) -> int:
    moved = np.asarray(matches.source, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    distances = np.linalg.norm(moved - matches.target, axis=1)
    return int(np.sum(np.asarray(matches.valid) & (distances <= TOLERANCE * voxel_size)))


def _overlap(matrix: Float[np.ndarray, "4 4"], source: PointCloud, target: PointCloud, voxel_size: float) -> float:
    moved = np.asarray(source.points, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    return float(np.mean(nearest_in_position(moved, target.points, TOLERANCE * voxel_size) >= 0))
