"""Errors of poses and trajectories against the ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import Any, Literal, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._compute.messages import check_integer, check_positive
from mcgicp_jax._math.poses import Pose, checked_pose_matrix, matrix_of

__all__ = ["ate", "kitti_errors", "pose_error", "rpe"]

Scalar: TypeAlias = float | Float[Array, ""]
Matrices: TypeAlias = Float[np.ndarray, "N 4 4"]
Poses: TypeAlias = Matrices | Sequence[Any]

# Metres: the segment lengths of the KITTI odometry benchmark.
KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)


def pose_error(T: Pose, T_true: Pose, *, at: ArrayLike | None = None) -> tuple[Scalar, Scalar]:
    """Translation and rotation error of a pose: |T p − T_true p| at a point p, and the angle of `T_true⁻¹ T`.

    Concrete poses are compared in float64. Inside `jit`, `grad` and `vmap` the errors have the precision of the traced
    pose. Both are differentiable, with gradient 0 where the error is 0.

    Args:
        T: estimated pose, `jaxlie.SE3` or (4, 4).
        T_true: true pose, `jaxlie.SE3` or (4, 4).
        at: (3,), metres, the point p in the source frame. By default the origin, where the error is the distance
            between the translations. If the cloud lies far from the origin, use a point in it, such as its centroid:
            at UTM coordinates a rotation of 1e-8 rad about the cloud moves the origin by 5 cm, but the cloud by ≈ 0.

    Returns:
        Translation in metres and rotation in radians, 0 to π: Python floats, or JAX scalars if an argument is traced.
        NaN if `T` is, as that of a failed registration.

    Raises:
        ValueError: if an argument has the wrong shape or a pose is no rigid motion; the message names the argument.
    """
    true = checked_pose_matrix(T_true, "T_true")
    estimate = matrix_of(T)
    failed = is_concrete(estimate) and np.shape(estimate) == (4, 4) and np.isnan(estimate[:3]).all()
    matrix = np.full((4, 4), np.nan) if failed else checked_pose_matrix(T, "T")
    point: Any = np.zeros(3) if at is None else at
    if np.shape(point) != (3,):
        raise ValueError(f"at: expected a point of shape (3,), got {np.shape(point)}")
    if is_concrete(matrix, true, point):
        translation, rotation = _errors(matrix, true, np.asarray(point, np.float64), np)
        return float(translation), float(rotation)
    dtype = jnp.result_type(*(value.dtype for value in (matrix, true, point) if not is_concrete(value)))
    with jax.default_matmul_precision("highest"):
        return _errors(jnp.asarray(matrix, dtype), jnp.asarray(true, dtype), jnp.asarray(point, dtype), jnp)


def ate(poses: Poses, true_poses: Poses, alignment: Literal["umeyama", "first"] = "umeyama") -> float:
    """Absolute trajectory error (Sturm et al. 2012): root mean square distance between estimated and true positions.

    Args:
        poses, true_poses: N poses each, sensor to world; the two world frames may differ.
        alignment: how the world frames are aligned. "umeyama": by the rigid motion (no scale) that minimises the
            error, in closed form (Umeyama 1991); "first": so that the first poses coincide.

    Returns:
        Metres.

    Raises:
        ValueError: if the trajectories are empty or differ in length, a pose is no rigid motion, or the alignment is
            unknown.
    """
    estimated, true = _trajectories(poses, true_poses)
    if alignment not in ("umeyama", "first"):
        raise ValueError(f"alignment: expected 'umeyama' or 'first', got {alignment!r}")
    positions, true_positions = estimated[:, :3, 3], true[:, :3, 3]
    if alignment == "umeyama":
        # The least-squares rotation about the centroids, without a reflection (Umeyama 1991).
        centered, center = positions - positions.mean(axis=0), true_positions.mean(axis=0)
        left, _, right = np.linalg.svd((true_positions - center).T @ centered)
        sign = np.sign(np.linalg.det(left) * np.linalg.det(right))
        aligned = centered @ (left @ np.diag([1, 1, sign]) @ right).T + center
    else:
        aligned = (true[0] @ np.linalg.inv(estimated[0]) @ estimated)[:, :3, 3]
    return float(np.sqrt(((aligned - true_positions) ** 2).sum(axis=1).mean()))


def rpe(poses: Poses, true_poses: Poses, delta: int = 1) -> tuple[Float[np.ndarray, "M"], Float[np.ndarray, "M"]]:
    """Relative pose errors (Sturm et al. 2012): `pose_error` of every motion from frame i to frame i + `delta`.

    Args:
        poses, true_poses: N poses each, sensor to world; the two world frames may differ.
        delta: number of frames, 1 to N − 1.

    Returns:
        Translations in metres and rotations in radians, (N − `delta`,) each.

    Raises:
        ValueError: if the trajectories are empty or differ in length, `delta` is out of range, or a pose is no rigid
            motion.
    """
    estimated, true = _trajectories(poses, true_poses)
    if not 1 <= delta < len(true):
        raise ValueError(f"delta: expected 1 to {len(true) - 1} for {len(true)} poses, got {delta}")
    first = np.arange(len(true) - delta)
    translation, rotation = _relative_errors(estimated, true, first, first + delta)
    return translation, rotation


def kitti_errors(
    poses: Poses, true_poses: Poses, *, lengths: Sequence[float] = KITTI_LENGTHS, step: int = 10
) -> tuple[float, float]:
    """The errors of the KITTI odometry benchmark (Geiger et al. 2012): mean drift over segments of the path.

    A segment of each length starts at every `step`-th frame and ends at the first frame that is further than that
    length along the true path. The mean is over all segments of all lengths.

    Args:
        poses, true_poses: N poses each, sensor to world; the two world frames may differ.
        lengths: segment lengths, metres.
        step: number of frames between the starts of segments.

    Returns:
        Translation error in percent of the segment length, and rotation error in degrees per metre.

    Raises:
        ValueError: if the trajectories are empty or differ in length, a pose is no rigid motion, a length or the step
            is not positive, or the path is no longer than the shortest segment.
    """
    check_integer("step", step, 1)
    for segment in lengths:
        check_positive("lengths", segment, "positive numbers")
    estimated, true = _trajectories(poses, true_poses)
    along = np.concatenate([[0], np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).cumsum()])
    first, length = np.meshgrid(np.arange(0, len(true), step), np.asarray(lengths, float))
    first, length = first.ravel(), length.ravel()
    last = np.searchsorted(along, along[first] + length, side="right")
    complete = last < len(true)
    if not complete.any():
        raise ValueError(f"lengths: expected one below {along[-1]:.1f} m, the length of the path, got {tuple(lengths)}")
    translation, rotation = _relative_errors(estimated, true, first[complete], last[complete]) / length[complete]
    return float(100 * np.mean(translation)), float(np.degrees(np.mean(rotation)))


def _trajectories(poses: Poses, true_poses: Poses) -> tuple[Matrices, Matrices]:
    estimated, true = (
        np.array([checked_pose_matrix(pose, f"{name}[{i}]") for i, pose in enumerate(trajectory)]).reshape(-1, 4, 4)
        for name, trajectory in (("poses", poses), ("true_poses", true_poses))
    )
    if len(estimated) != len(true) or not len(true):
        raise ValueError(f"poses: expected as many as true_poses, at least one, got {len(estimated)} and {len(true)}")
    return estimated, true


def _relative_errors(estimated: Matrices, true: Matrices, first: Any, last: Any) -> Float[np.ndarray, "2 M"]:
    motions = (np.linalg.inv(poses[first]) @ poses[last] for poses in (estimated, true))
    return np.array([_errors(motion, truth, np.zeros(3), np) for motion, truth in zip(*motions, strict=True)]).T


def _errors(matrix: Any, true: Any, point: Any, numpy: ModuleType) -> tuple[Any, Any]:
    """Translation and rotation error at a point; `numpy` is NumPy or `jax.numpy`."""
    left = true[:3, :3].T @ matrix[:3, :3]
    # sin(angle) · axis and cos(angle): arctan2 of the two is accurate at every angle, unlike arcsin or arccos.
    sine = numpy.stack([left[2, 1] - left[1, 2], left[0, 2] - left[2, 0], left[1, 0] - left[0, 1]]) / 2
    cosine = (numpy.trace(left) - 1) / 2
    # Subtract the matrices first: at large coordinates each transformed point alone has lost digits.
    shift = matrix[:3, 3] - true[:3, 3] + (matrix[:3, :3] - true[:3, :3]) @ point
    return _norm(shift, numpy), numpy.arctan2(_norm(sine, numpy), cosine)


def _norm(vector: Any, numpy: ModuleType) -> Any:
    """Euclidean norm with gradient 0, rather than NaN, at 0."""
    squared = (vector**2).sum()
    nonzero = squared != 0  # true for NaN, which is returned
    return numpy.where(nonzero, numpy.sqrt(numpy.where(nonzero, squared, 1)), 0)
