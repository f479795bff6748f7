"""Λ measured: how two measurements of one spot differ, over clouds of known poses."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from mcgicp_jax._channels import point_spacing
from mcgicp_jax._cloud import PointCloud
from mcgicp_jax._pose import Pose, pose_matrix
from mcgicp_jax._preprocess import preprocess
from mcgicp_jax._search import Rows
from mcgicp_jax._trees import KDTreeSearch

# Fewer differences than this tell no variance: its relative error would be 45 %.
_MIN_DIFFERENCES = 10


def estimate_channel_covariance(
    clouds: Sequence[PointCloud], poses: Sequence[Pose], *, max_distance: float | None = None
) -> Float[np.ndarray, "C C"]:
    """Λ with its cross terms, measured: the covariance of the difference between two measurements of one spot.

    For `MultiChannelGICP(channel_covariance=...)`, from clouds of known poses (Servos & Waslander 2014, IV-C). Each
    cloud is compared with the next: every point with the nearest one, if it is near enough to be the same spot. The
    mean difference of two clouds, as of their exposures, does not count. An entry of Λ is taken over the differences
    that have both of its channels.

    Args:
        clouds: at least two, in any order in which neighbours overlap; prepared, or raw ones that are used as they are.
        poses: sensor to world, `jaxlie.SE3` or (4, 4), one per cloud.
        max_distance: metres; by default half the median distance between neighbouring points.

    Returns:
        (C, C), channel units², float64, symmetric and positive definite.

    Raises:
        ValueError: if there is not one pose for each cloud, the channels differ, or fewer than ten spots were seen
            twice in a channel.
    """
    if len(clouds) < 2 or len(clouds) != len(poses):
        raise ValueError(f"poses: expected one for each of two clouds or more, got {len(poses)} for {len(clouds)}")
    matrices = [np.asarray(pose_matrix(pose, f"poses[{i}]")) for i, pose in enumerate(poses)]
    ready = [cloud if cloud.neighbors is not None else preprocess(cloud) for cloud in clouds]
    names = ready[0].channel_names
    for i, cloud in enumerate(ready):
        if cloud.channel_names != names:
            raise ValueError(f"clouds[{i}]: expected the channels {names}, got {cloud.channel_names}")
    products, counts = np.zeros((len(names), len(names))), np.zeros((len(names), len(names)))
    for target, source in itertools.pairwise(zip(ready, matrices, strict=True)):
        limit = 0.5 * float(point_spacing(target[0])) if max_distance is None else max_distance
        differences, known = _differences(*source, *target, limit)
        number = np.maximum(known.sum(axis=0), 1)
        differences = np.where(known, differences - differences.sum(axis=0) / number, 0)
        products += differences.T @ differences
        counts += known.T.astype(float) @ known
    if counts.size and np.diagonal(counts).min() < _MIN_DIFFERENCES:
        least = names[int(np.diagonal(counts).argmin())]
        raise ValueError(
            f"clouds: expected {_MIN_DIFFERENCES} spots or more that were seen twice, got "
            f"{np.diagonal(counts).min():.0f} with the channel {least!r}; check the poses, or raise max_distance"
        )
    # Where no differences have both of two channels, nothing is known of their covariance.
    return _positive_definite(products / np.maximum(counts, 1))


def _differences(
    source: PointCloud,
    source_pose: Float[np.ndarray, "4 4"],
    target: PointCloud,
    target_pose: Float[np.ndarray, "4 4"],
    max_distance: float,
) -> tuple[Float[np.ndarray, "N C"], Bool[np.ndarray, "N C"]]:
    """Differences between channels of the same spots, 0 where one is missing, and where there are any."""
    matrix = np.linalg.inv(target_pose) @ source_pose
    moved, fixed = source.transform(matrix).unpad(), target.unpad()
    rows = [
        Rows(points=np.asarray(cloud.points), descriptors=np.zeros((len(cloud), 0)), valid=np.ones(len(cloud), bool))
        for cloud in (moved, fixed)
    ]
    at_rest = np.array([1.0, 0, 0, 0, 0, 0, 0])
    (nearest,) = KDTreeSearch().index(rows[1]).nearest(at_rest, rows[0], max_distance)
    distances = np.linalg.norm(np.asarray(fixed.points)[nearest] - np.asarray(moved.points), axis=1)
    near = (nearest >= 0) & (distances <= max_distance)
    pair = [(moved, np.flatnonzero(near)), (fixed, nearest[near])]
    known = np.ones((near.sum(), moved.channels.shape[1]), bool)
    for cloud, chosen in pair:
        if cloud.channel_valid is not None:
            known &= np.asarray(cloud.channel_valid)[chosen]
    values = [np.asarray(cloud.channels, np.float64)[chosen] for cloud, chosen in pair]
    return np.where(known, values[0] - values[1], 0), known


def _positive_definite(covariance: Float[np.ndarray, "C C"]) -> Float[np.ndarray, "C C"]:
    """The same but for eigenvalues that are not positive: channels that never differ, entries from different spots."""
    deviations = np.sqrt(np.maximum(np.diagonal(covariance), np.finfo(np.float32).tiny))
    values, vectors = np.linalg.eigh(covariance / np.outer(deviations, deviations))
    return (vectors * np.maximum(values, 1e-6)) @ vectors.T * np.outer(deviations, deviations)
