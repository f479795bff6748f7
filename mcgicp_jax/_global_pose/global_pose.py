"""Global registration: poses from putative matches, without an initial pose, and their verification."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.point_cloud import PointCloud, Values, as_cloud, same_channels
from mcgicp_jax._clouds.preprocess import finite_rows, with_neighbors
from mcgicp_jax._clouds.voxels import grid_of, voxel_order
from mcgicp_jax._compute.concrete import DeferredRows, outside_trace
from mcgicp_jax._compute.messages import check_positive, messages_named
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._global_pose import robust_pose_fit as fit
from mcgicp_jax._global_pose.features import NUM_NEIGHBORS, matches_of_features, matches_of_rows
from mcgicp_jax._global_pose.free_space import View
from mcgicp_jax._local_geometry.surface_agreement import spreads, surface_agreement
from mcgicp_jax._math.poses import inverse, nearest_rotation
from mcgicp_jax._methods.icp import GICP
from mcgicp_jax._methods.multichannel_gicp import MultiChannelGICP
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.register_pair import prepared, results_of, run_pair
from mcgicp_jax._registration.result import is_usable
from mcgicp_jax._search.kd_tree import nearest_in_position

# Maximum number of voxels of the smaller and of the larger cloud, and as a fraction of the points. With 6,000 voxels a
# scene has about a thousand mutual matches; 5,000 to 8,000 register the same real pairs. 20,000 bound the time. With
# more voxels than half the points, most would hold one point.
_VOXELS, _MAX_VOXELS, _MAX_FRACTION = 6000, 20_000, 0.5
# Stride of the points whose voxels are counted first.
_STRIDE = 4
# Voxel sizes are 2^(j/8) metres, the same for all pairs; this many steps below the extent of the clouds are tried.
_STEPS_PER_OCTAVE, _NUM_STEPS = 8, 120
# The registration that verifies a pose: maximum correspondence distances, in voxels; number of iterations; and number
# of neighbours, the default of `preprocess`.
_VERIFIED_WITHIN, _VERIFIED_ITERATIONS, _NUM_NEIGHBORS = (4.0, fit.TOLERANCE), 40, 20
# Smallest i/√n (a/m)² of a success (see `GlobalPoseResult.support`), in general and where the shape of the clouds
# leaves a direction unconstrained, and smallest number of inliers: from the development half of
# `tests/benchmarks/global_pose_verdicts`.
_LEAST, _LEAST_UNCONSTRAINED, MIN_INLIERS = 0.21, 0.7, 10
# For each of these numbers that exceeds the number N of voxels, a success needs (number / N)^1.5 times as much. Where
# walls coincide at a wrong pose, 15 to 60 matches are inliers by chance, however few there are, and furniture is no
# larger than a neighbourhood of a sparse cloud. 3,000: on the development half no wrong pose is accepted with powers of
# 1.5 to 2 and 3,000 to 4,000 voxels; larger values accept fewer right poses. 1,400: in 900 to 990 voxels of a room with
# nearly the same furniture after half a turn, the turned pose reaches 1.7 times what suffices without this number, with
# two to five times the inliers of the right pose, which is then no rival.
_SPARSE, _SPARSE_POWER = np.array([3000, 1400]), 1.5
# Smallest fractions of the best pose's inliers, overlap and (a/m)² with which another pose is a rival, which makes the
# result ambiguous; and of its support, with which any inliers and overlap do. Scans of a road reach 0.75 of the inliers
# with 0.83 of the overlap at another place along it. Parts of a furnished room reach 0.5 to 1.9 of the inliers with up
# to twice the overlap after half a turn, but 0.3 to 0.75 of (a/m)²; the two poses of halls that are the same after half
# a turn reach 0.86 to 1.2. Where furniture is nearly the same after half a turn, the right pose had 0.4 of the inliers
# and 0.45 of the overlap of the wrong one, but 1.7 times its (a/m)² and the same support.
_RIVAL_INLIERS, _RIVAL_OVERLAP, _RIVAL_AGREEMENT, _RIVAL_SUPPORT = 0.5, 0.9, 0.8, 0.9
# A pose is also a rival if it has at least these fractions of the best pose's overlap and (a/m)², and at most this
# fraction of its points in free space. Scans of simulated halls, whose walls are the same after half a turn, have 0.5
# to 16 % of their points in free space at the turned pose, 0 to 0.1 % at the right one, which has 0.55 of the overlap
# and 0.14 of (a/m)², with hardly an inlier. At right poses, moving cars are up to 1 % of KITTI's points and the roof of
# the recording car 9 % of `lidar_pair`'s, at turned poses as well.
_FREER_OVERLAP, _FREER_AGREEMENT, _FREER_POINTS = 0.5, 0.1, 0.15
# Fraction of points in free space from which on half turns of the best pose are verified, 20 of 8,000 points; and least
# number of points in directions that are seen, by which it is estimated.
_IN_FREE_SPACE, _LEAST_SEEN = 0.0025, 1000
# Number of normals that the axes of half turns are computed from, as many as `surface_agreement` compares.
_NORMALS = 2048


@dataclass(frozen=True, eq=False)
class Candidate:
    """One pose found by `global_pose`, after the registration that verifies it.

    Attributes:
        matrix: (4, 4) float64, T_target_source, metres.
        num_inliers: number of matches whose points are at most 1.5 voxels apart at this pose.
        overlap: fraction of the source's voxels with a voxel of the target within 1.5 voxels.
        agreement, support: (a/m)² and the support, see `GlobalPoseResult.support`.
        in_free_space: fraction of both scans' points that lie where the other scan saw through, see `View`;
            computed if it matters. NaN if the scans hardly see each other's directions.
    """

    matrix: Float[np.ndarray, "4 4"]
    num_inliers: int
    overlap: float
    agreement: float
    support: float
    in_free_space: float = 0.0

    @property
    def evidence(self) -> float:
        """Inliers × agreement, by which poses are ranked. Overlap does not count: it is larger where the walls of two
        parts of a room coincide after half a turn than at the right pose."""
        return self.num_inliers * self.agreement

    @property
    def is_supported(self) -> bool:
        return self.num_inliers >= MIN_INLIERS and self.support >= 1

    def rivals(self, best: Candidate) -> bool:
        """Whether this pose makes the best one ambiguous."""
        as_many = self.num_inliers >= _RIVAL_INLIERS * best.num_inliers
        as_much = as_many and self.overlap >= _RIVAL_OVERLAP * best.overlap
        as_good = self.agreement >= _RIVAL_AGREEMENT * best.agreement and (
            as_much or self.support >= _RIVAL_SUPPORT * best.support
        )
        is_freer = (
            best.in_free_space >= _IN_FREE_SPACE
            and self.in_free_space <= _FREER_POINTS * best.in_free_space
            and self.overlap >= _FREER_OVERLAP * best.overlap
            and self.agreement >= _FREER_AGREEMENT * best.agreement
        )
        return as_good or is_freer


@dataclass(frozen=True, eq=False)
class GlobalPoseResult:
    """Result of `global_pose`.

    Attributes:
        matrix: (4, 4) float64, T_target_source, metres; accurate to a fraction of a voxel. The identity if no pose was
            found.
        success: whether to trust the pose: it has at least ten inliers and a `support` of 1, which clouds of different
            scenes did not reach in `tests/benchmarks`, and the result is not `ambiguous`.
        ambiguous: whether another pose is about as good as the best one, as in symmetric or repetitive scenes, or has
            far fewer points in space that the other scan saw through. False if the best pose has too little support.
        num_inliers, overlap: number of inliers of the best pose, and the overlapping fraction of the source.
        num_matches: number of matches, inliers and outliers.
        support: i/√n (a/m)² of the best pose, for i inliers of the n matches within the overlap; a, the fraction of
            normals that agree within 30°; and m, at least 1, the 90 % quantile of the distances along the normals, in
            thicknesses of the neighbourhoods. a and m weigh all directions of surfaces equally. Divided by what wrong
            poses do not reach: 0.21; (3000 / N)^1.5 times that for N < 3000 voxels of the smaller cloud, which show
            little but walls, and (1400 / N)^1.5 times that for N < 1400; and at least 0.7 where the shape of the clouds
            leaves a direction of motion unconstrained, as on a plane or in a corridor, so that surfaces coincide at
            wrong poses, too.
        runner_up: the second-best pose that differs from the best one by more than five voxels; one that makes it
            ambiguous, if there is any. None if no other pose was verified.
        voxel_size: metres; edge of the voxels for which features are computed.
    """

    matrix: Float[np.ndarray, "4 4"]
    success: bool
    ambiguous: bool
    num_inliers: int
    num_matches: int
    overlap: float
    support: float
    runner_up: Candidate | None
    voxel_size: float

    def __repr__(self) -> str:
        verdict = "success" if self.success else "ambiguous" if self.ambiguous else "no success"
        return (
            f"GlobalPoseResult({verdict}: {self.num_inliers} inliers of {self.num_matches} matches, overlap "
            f"{self.overlap:.0%}, support {self.support:.2g}, voxels of {self.voxel_size:.3g} m)"
        )


@with_settings_of_package
def global_pose(
    source: PointCloud | Values,
    target: PointCloud | Values,
    *,
    voxel_size: float | None = None,
    correspondences: tuple[Any, Any] | None = None,
) -> GlobalPoseResult:
    """Estimate the pose between two clouds without an initial pose. To refine it, pass its `matrix` to `register`.

    The steps are: (1) describe each voxel by FPFH (Rusu et al. 2009) and, if both clouds have the same channels, by the
    means and standard deviations of the channels around it; (2) match voxels that are mutual nearest neighbours in
    these features, of which most may be wrong; (3) compute poses from triplets of matches that agree with each other;
    (4) refine them by graduated non-convexity (Yang et al. 2020); (5) verify the best by a coarse registration, which
    uses the channels. If points of one scan lie where the other saw through, half turns of the best pose are verified,
    too. On one machine, the same clouds give the same result, to the last bit. Runs on the host, with programs whose
    shapes do not depend on the clouds.

    Args:
        source, target: raw or preprocessed clouds, or (N, 3) arrays in metres; they may lie anywhere, in any rotation.
            What space a scan saw through is judged from (0, 0, 0) of its coordinates: for this, pass scans in the
            frames of their sensors.
        voxel_size: metres. By default the smallest size at which the smaller cloud has at most 6,000 voxels, the larger
            one at most 20,000, and each at most half as many voxels as points.
        correspondences: integer arrays (n,) of source rows and (n,) of target rows that replace steps 1 and 2, such as
            those of `image_matches`. At most 1,024 matches are used, evenly spaced; most may be wrong. With fewer than
            ten, none succeeds.

    Returns:
        The pose, with `success` to tell whether to trust it.

    Raises:
        ValueError: if a cloud has fewer than four finite points, or an argument is malformed. Failures on well-formed
            clouds show in `success`.
    Warns:
        UserWarning: if points with NaN or infinity are left out.
    """
    if voxel_size is not None:
        check_positive("voxel_size", voxel_size)
    source, target = as_cloud("source", source), as_cloud("target", target)
    if correspondences is not None:
        try:
            rows = np.stack([np.asarray(side) for side in correspondences])
        except (TypeError, ValueError) as error:
            raise ValueError("correspondences: expected two arrays of rows, of one length") from error
        sizes = np.array([[source.points.shape[0]], [target.points.shape[0]]])
        if rows.ndim != 2 or rows.shape[0] != 2 or rows.dtype.kind not in "iu" or np.any((rows < 0) | (rows >= sizes)):
            raise ValueError(
                f"correspondences: expected integer rows (source_rows, target_rows) of clouds of {sizes[0, 0]} and "
                f"{sizes[1, 0]} points, got shape {rows.shape} of {rows.dtype}"
            )
    centred = _centred("source", source), _centred("target", target)
    clouds, centers = [cloud for cloud, _ in centred], [center for _, center in centred]
    if not same_channels(source, target):
        clouds = [PointCloud(cloud.points) for cloud in clouds]
    size = _voxel_size(clouds) if voxel_size is None else float(voxel_size)
    if not size:
        return _no_pose(0, size)
    try:
        voxels = [with_neighbors(cloud, size, NUM_NEIGHBORS) for cloud in clouds]
    except ValueError:
        # A cloud has too few voxels.
        return _no_pose(0, size)
    with outside_trace():
        if correspondences is None:
            matches = matches_of_features(voxels[0], voxels[1], size)
        else:
            matches = matches_of_rows(source.coordinates - centers[0], target.coordinates - centers[1], rows)
        for side, cloud in enumerate(voxels):
            neighbors = np.ascontiguousarray(np.asarray(cloud.neighbors)[:, :_NUM_NEIGHBORS])
            voxels[side] = cloud.replace_rows(deferred_neighbors=DeferredRows.of(neighbors))
        positions = np.asarray(voxels[0].points, np.float64)
        radius = float(np.sqrt(np.mean(np.sum(positions * positions, axis=1))))
        views = [View(np.asarray(cloud.points), -center) for cloud, center in zip(clouds, centers, strict=True)]
        return _best_pose(_Scene(matches, voxels[0], voxels[1], size, radius, *views), *centers)


def _no_pose(num_matches: int, voxel_size: float) -> GlobalPoseResult:
    return GlobalPoseResult(np.eye(4), False, False, 0, num_matches, 0.0, 0.0, None, voxel_size)


def _centred(name: str, cloud: PointCloud) -> tuple[PointCloud, Float[np.ndarray, "3"]]:
    """The finite points, in float32 about the middle of their extent, as a raw cloud; and the middle, metres."""
    with messages_named(name):
        cloud = finite_rows(cloud.replace_rows(covariances=None))
    points = cloud.coordinates
    # Working by columns takes a tenth of the time.
    columns = np.ascontiguousarray(points.T)
    center = 0.5 * (columns.min(axis=1) + columns.max(axis=1))
    channels = np.asarray(cloud.channels, np.float32)
    valid = None if cloud.channel_valid is None else np.asarray(cloud.channel_valid)
    return PointCloud((points - center).astype(np.float32), channels, channel_valid=valid), center


def _voxel_size(clouds: list[PointCloud]) -> float:
    """The smallest size with few enough voxels, metres; 0 if the clouds have no finite extent."""
    grids = [grid_of(np.asarray(cloud.points)).columns for cloud in clouds]
    extent = max(float(np.ptp(columns, axis=1).max()) for columns in grids)
    if not 0 < extent < np.inf:
        return 0.0
    limits = [max(min(_MAX_VOXELS, _MAX_FRACTION * len(cloud)), 8) for cloud in clouds]

    def few(step: int, stride: int) -> bool:
        size = 2.0 ** (step / _STEPS_PER_OCTAVE)
        counts = [len(voxel_order(columns[:, ::stride], size)[1]) for columns in grids]
        return min(counts) <= _VOXELS and all(count <= limit for count, limit in zip(counts, limits, strict=True))

    high = int(np.ceil(_STEPS_PER_OCTAVE * np.log2(extent))) + 1
    low = high - _NUM_STEPS
    # A subsample occupies fewer voxels, so its size is a lower bound; from there, all points are counted.
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if few(middle, _STRIDE) else (middle, high)
    while not few(high, 1):
        high += 1
    return float(2.0 ** (high / _STEPS_PER_OCTAVE))


class _Scene(NamedTuple):
    """Matches of two centred clouds of voxels."""

    matches: fit.PutativeMatches
    source: PointCloud
    target: PointCloud
    voxel_size: float
    # Root mean square distance of the source's points from the centre, about which poses turn, metres.
    radius: float
    source_view: View
    target_view: View

    def are_same(self, a: Float[np.ndarray, "4 4"], b: Float[np.ndarray, "4 4"]) -> bool:
        square = fit.squared_separation((a - b)[:3, :3], (a - b)[:3, 3], self.radius)
        return bool(square <= (fit.MIN_SEPARATION * self.voxel_size) ** 2)

    def candidate(self, matrix: Float[np.ndarray, "4 4"], constrained: bool) -> Candidate:
        """The pose with its support: see `GlobalPoseResult.support`."""
        distance, valid = fit.TOLERANCE * self.voxel_size, np.asarray(self.matches.valid)
        matched, targets = (np.asarray(side, np.float64)[valid] for side in (self.matches.source, self.matches.target))
        voxels = np.asarray(self.source.points, np.float64)
        moved, moved_voxels = (points @ matrix[:3, :3].T + matrix[:3, 3] for points in (matched, voxels))
        inliers = int(np.sum(np.linalg.norm(moved - targets, axis=1) <= distance))
        # Matches within the overlap, and the overlap.
        num_within = int(np.sum(nearest_in_position(moved, self.target.points, distance) >= 0))
        overlap = float(np.mean(nearest_in_position(moved_voxels, self.target.points, distance) >= 0))
        misfit, same = surface_agreement(matrix, self.source, self.target, distance)
        agreement = (same / max(misfit, 1.0)) ** 2
        num_voxels = min(len(cloud.points) for cloud in (self.source, self.target))
        support = inliers / np.sqrt(max(num_within, 1)) * agreement
        least = _LEAST * float(np.prod(np.maximum(_SPARSE / num_voxels, 1))) ** _SPARSE_POWER
        if not constrained:
            least = max(least, _LEAST_UNCONSTRAINED)
        return Candidate(matrix, inliers, overlap, agreement, float(support / least))

    def in_free_space(self, matrix: Float[np.ndarray, "4 4"]) -> float:
        """See `Candidate`."""
        source, target, size = self.source_view, self.target_view, self.voxel_size
        free, seen = target.sees_through(source, matrix, size) + source.sees_through(target, inverse(matrix), size)
        return float(free / seen) if seen >= _LEAST_SEEN else np.nan

    def half_turns(self, matrix: Float[np.ndarray, "4 4"]) -> Iterator[Float[np.ndarray, "4 4"]]:
        """The pose after half a turn about each principal axis of the normals, through the middle of both clouds.

        Walls and ground coincide after half a turn about these axes, unless other surfaces outweigh them.
        """
        points = np.asarray(self.target.points, np.float64)
        rows = np.arange(0, len(points), 1 + len(points) // _NORMALS)
        normals = spreads(points, self.target.deferred_neighbors, rows)[2]
        moved = np.asarray(self.source.points, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        axes = np.linalg.eigh(normals.T @ normals)[1]
        both = np.concatenate([points, moved]) @ axes
        center = axes @ (0.5 * (both.min(axis=0) + both.max(axis=0)))
        for axis in axes.T:
            turn = np.eye(4)
            turn[:3, :3] = 2 * np.outer(axis, axis) - np.eye(3)
            turn[:3, 3] = center - turn[:3, :3] @ center
            yield turn @ matrix


def _best_pose(scene: _Scene, source_center: np.ndarray, target_center: np.ndarray) -> GlobalPoseResult:
    """The best of the verified poses, in the frames of the user's clouds."""
    verified, num_matches = _verified(scene), int(scene.matches.valid.sum())
    if not verified:
        return _no_pose(num_matches, scene.voxel_size)
    for pose in verified:
        pose.matrix[:3, 3] += target_center - pose.matrix[:3, :3] @ source_center
    best, *others = sorted(verified, key=lambda pose: -pose.evidence)
    runner_up = max(others, key=lambda pose: (pose.rivals(best), pose.evidence), default=None)
    rivalled = runner_up is not None and runner_up.rivals(best)
    return GlobalPoseResult(
        matrix=best.matrix,
        success=bool(best.is_supported and not rivalled),
        ambiguous=bool(best.is_supported and rivalled),
        num_inliers=best.num_inliers,
        num_matches=num_matches,
        overlap=best.overlap,
        support=best.support,
        runner_up=runner_up,
        voxel_size=scene.voxel_size,
    )


def _verified(scene: _Scene) -> list[Candidate]:
    """The best pose and possible rivals, registered; without repetitions."""
    voxel_size = np.float32(scene.voxel_size)
    poses = fit.hypotheses(scene.matches, voxel_size, np.float32(scene.radius))
    poses = jax.tree.map(np.asarray, fit.refined(poses, scene.matches, voxel_size))
    method = MultiChannelGICP() if scene.source.channels.shape[1] else GICP()
    distances = _VERIFIED_WITHIN[0] * scene.voxel_size, _VERIFIED_WITHIN[1] * scene.voxel_size
    options = Options(max_distance=distances, max_iterations=_VERIFIED_ITERATIONS)
    inputs = prepared(scene.source, scene.target, method, options)
    verified: list[Candidate] = []
    started: list[np.ndarray] = []

    def verify(start: Float[np.ndarray, "4 4"]) -> None:
        start = nearest_rotation(start)
        if any(scene.are_same(start, other) for other in started):
            return
        started.append(start)
        # Without the warning that a pose is doubtful: it may not be the one that is returned.
        (result,) = results_of([run_pair(inputs, start, options)], [inputs])
        # A registration that fails, as of clouds with a few coincident points, is no evidence against the matches.
        usable = is_usable(result)
        matrix = np.array(result.matrix if usable else start)
        if not any(scene.are_same(matrix, other.matrix) for other in verified):
            verified.append(scene.candidate(matrix, usable and not result.unconstrained_directions))

    order = np.argsort(-poses.score, kind="stable")
    for i in order:
        if not (poses.score[i] > 0 and poses.score[i] >= _RIVAL_INLIERS * poses.score[order[0]]):
            break
        start = np.eye(4)
        start[:3, :3], start[:3, 3] = poses.rotation[i], poses.translation[i]
        verify(start)
    best = max(verified, key=lambda pose: pose.evidence, default=None)
    if best is None or not best.is_supported or any(pose.rivals(best) for pose in verified if pose is not best):
        return verified
    fraction = scene.in_free_space(best.matrix)
    if not fraction >= _IN_FREE_SPACE:
        return verified
    for start in scene.half_turns(best.matrix):
        verify(start)
    others = [pose for pose in verified if pose is not best]
    fractions = [scene.in_free_space(pose.matrix) for pose in others]
    return [replace(p, in_free_space=f) for p, f in zip([best, *others], [fraction, *fractions], strict=True)]
