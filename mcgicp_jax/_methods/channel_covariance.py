"""Estimation of the channel covariance Λ from clouds of known poses."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._clouds.preprocess import preprocess
from mcgicp_jax._compute.threads import without_checks_of_jax
from mcgicp_jax._local_geometry.cloud_statistics import point_spacing
from mcgicp_jax._math.poses import Pose, pose_matrix
from mcgicp_jax._search.kd_tree import nearest_in_position

# Smallest number n of differences per channel: the relative standard error of a variance is √(2/n), 45 % for 10.
_MIN_DIFFERENCES = 10
# Default maximum distance of a match, in spacings: any other target point is then more than half a spacing away.
_SAME_SURFACE = 0.5
# Smallest eigenvalue of the correlation matrix, dimensionless: eight float32 epsilons keep Λ positive definite.
_MIN_EIGENVALUE = 1e-6


@without_checks_of_jax
def estimate_channel_covariance(
    clouds: Sequence[PointCloud], poses: Sequence[Pose], *, max_distance: float | None = None
) -> Float[np.ndarray, "C C"]:
    """Estimate the channel covariance Λ, with cross terms, from overlapping clouds of known poses.

    Λ is the covariance of the difference between two measurements of one surface point (Servos & Waslander 2014,
    IV-C); pass it to `MultiChannelGICP(channel_covariance=...)`. Each point is matched to the nearest point of the
    preceding cloud. The mean difference of two clouds, caused for instance by their exposures, is removed. Each entry
    of Λ is computed from the matches that have both of its channels.

    Args:
        clouds: at least two, ordered so that consecutive clouds overlap; preprocessed, or raw (then not downsampled).
        poses: one per cloud, sensor to world, `jaxlie.SE3` or (4, 4).
        max_distance: maximum correspondence distance, metres; by default half the median nearest-neighbour
            distance of the preceding cloud.

    Returns:
        (C, C), channel units², float64, symmetric and positive definite.

    Raises:
        ValueError: if there are fewer than two clouds, the number of poses differs, the channels differ, or a channel
            has fewer than ten matches.
    """
    if len(clouds) < 2 or len(clouds) != len(poses):
        raise ValueError(f"poses: expected one per cloud and at least two, got {len(poses)} for {len(clouds)} clouds")
    matrices = [np.asarray(pose_matrix(pose, f"poses[{i}]")) for i, pose in enumerate(poses)]
    ready = [cloud if cloud.deferred_neighbors is not None else preprocess(cloud, None) for cloud in clouds]
    names = ready[0].channel_names
    for i, cloud in enumerate(ready):
        if cloud.channel_names != names:
            raise ValueError(f"clouds[{i}]: expected the channels {names}, got {cloud.channel_names}")
    products, counts = np.zeros((len(names), len(names))), np.zeros((len(names), len(names)))
    for target, source in itertools.pairwise(zip(ready, matrices, strict=True)):
        limit = _SAME_SURFACE * float(point_spacing(target[0])) if max_distance is None else max_distance
        differences, present = _differences(*source, *target, limit)
        number = np.maximum(present.sum(axis=0), 1)
        differences = np.where(present, differences - differences.sum(axis=0) / number, 0)
        products += differences.T @ differences
        counts += present.T.astype(float) @ present
    if counts.size and np.diagonal(counts).min() < _MIN_DIFFERENCES:
        scarcest = names[int(np.diagonal(counts).argmin())]
        raise ValueError(
            f"clouds: expected at least {_MIN_DIFFERENCES} matches per channel, got "
            f"{np.diagonal(counts).min():.0f} for {scarcest!r}; check the poses, or raise max_distance"
        )
    # The covariance of two channels that no match has in common is unknown, and set to 0.
    return _positive_definite(products / np.maximum(counts, 1))


def _differences(
    source: PointCloud,
    source_pose: Float[np.ndarray, "4 4"],
    target: PointCloud,
    target_pose: Float[np.ndarray, "4 4"],
    max_distance: float,
) -> tuple[Float[np.ndarray, "N C"], Bool[np.ndarray, "N C"]]:
    """Channel differences of the matches, 0 where either value is missing, and the mask of those present."""
    matrix = np.linalg.inv(target_pose) @ source_pose
    moved, fixed = source.transform(matrix).unpad(), target.unpad()
    nearest = nearest_in_position(moved.points, fixed.points, max_distance)
    matched = [(moved, np.flatnonzero(nearest >= 0)), (fixed, nearest[nearest >= 0])]
    present = np.ones((len(matched[0][1]), moved.channels.shape[1]), bool)
    for cloud, rows in matched:
        if cloud.channel_valid is not None:
            present &= np.asarray(cloud.channel_valid)[rows]
    values = [np.asarray(cloud.channels, np.float64)[rows] for cloud, rows in matched]
    return np.where(present, values[0] - values[1], 0), present


def _positive_definite(covariance: Float[np.ndarray, "C C"]) -> Float[np.ndarray, "C C"]:
    """Raise the eigenvalues of the correlation matrix to a positive minimum.

    They can be 0 or negative if a channel never differs, or because the entries come from different matches.
    """
    deviations = np.sqrt(np.maximum(np.diagonal(covariance), np.finfo(np.float32).tiny))
    values, vectors = np.linalg.eigh(covariance / np.outer(deviations, deviations))
    return (vectors * np.maximum(values, _MIN_EIGENVALUE)) @ vectors.T * np.outer(deviations, deviations)
