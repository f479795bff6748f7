"""How far a pose, or a trajectory, is from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import Any, Literal, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mcgicp_jax._pose import Pose, is_concrete, pose_matrix

Scalar: TypeAlias = float | Float[Array, ""]
Poses: TypeAlias = Float[np.ndarray, "N 4 4"] | Sequence[Any]

# Metres: the lengths of path of the KITTI benchmark.
_KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)


def pose_error(T: Pose, T_true: Pose, *, at: ArrayLike | None = None) -> tuple[Scalar, Scalar]:
    """How far the pose takes a point from where it belongs, and the angle of the rotation that is left over.

    Concrete poses are compared in float64. Under `jit`, `grad` and `vmap` the errors have the precision of the traced
    pose; both are differentiable, with gradient 0 where the error itself is 0.

    Args:
        T: `jaxlie.SE3` or (4, 4).
        T_true: `jaxlie.SE3` or (4, 4).
        at: (3,), metres, the point in the source's frame; the origin by default, whose error is that of the
            translations, and the length of `T_true⁻¹ T`. Take one in the cloud, such as its centroid, where that lies
            far from the origin: at UTM coordinates 1e-8 rad move the origin by 5 cm, and the cloud by nothing.

    Returns:
        Translation in metres and rotation in radians, 0 to π: plain floats, or JAX scalars where a pose is traced.

    Raises:
        ValueError: if a pose has another shape or is no rigid motion, or the point another shape; the message names it.
    """
    matrix, true = pose_matrix(T, "T"), pose_matrix(T_true, "T_true")
    point: Any = np.zeros(3) if at is None else at
    if np.shape(point) != (3,):
        raise ValueError(f"at: expected a point of shape (3,), got {np.shape(point)}")
    if is_concrete(matrix, true, point):
        translation, rotation = _errors(matrix, true, np.asarray(point, np.float64), np)
        return float(translation), float(rotation)
    dtype = jnp.result_type(*(each.dtype for each in (matrix, true, point) if not is_concrete(each)))
    with jax.default_matmul_precision("highest"):
        return _errors(jnp.asarray(matrix, dtype), jnp.asarray(true, dtype), jnp.asarray(point, dtype), jnp)


def ate(poses: Poses, true_poses: Poses, alignment: Literal["umeyama", "first"] = "umeyama") -> float:
    """Absolute trajectory error (Sturm et al. 2012): root mean square distance of the positions from the true ones.

    Args:
        poses, true_poses: N of each, sensor to world, in worlds of their own.
        alignment: what brings the two worlds together. "umeyama": the rigid motion (no scale) that makes the error
            smallest, in closed form; "first": the first pose.

    Returns:
        Metres.

    Raises:
        ValueError: if there are not as many poses as true ones, or one is no rigid motion.
    """
    estimated, true = _trajectories(poses, true_poses)
    if alignment not in ("umeyama", "first"):
        raise ValueError(f"alignment: expected 'umeyama' or 'first', got {alignment!r}")
    positions, true_positions = estimated[:, :3, 3], true[:, :3, 3]
    if alignment == "umeyama":
        rotation = _best_rotation(positions, true_positions)
        aligned = (positions - positions.mean(axis=0)) @ rotation.T + true_positions.mean(axis=0)
    else:
        aligned = (true[0] @ np.linalg.inv(estimated[0]) @ estimated)[:, :3, 3]
    return float(np.sqrt(((aligned - true_positions) ** 2).sum(axis=1).mean()))


def rpe(poses: Poses, true_poses: Poses, delta: int = 1) -> tuple[Float[np.ndarray, "M"], Float[np.ndarray, "M"]]:
    """Relative pose errors (Sturm et al. 2012): `pose_error` of every motion from frame i to frame i + `delta`.

    Args:
        poses, true_poses: N of each, sensor to world, in worlds of their own.

    Returns:
        Translations in metres and rotations in radians, N − `delta` of each.

    Raises:
        ValueError: if there are not as many poses as true ones, or no more than `delta`, or one is no rigid motion.
    """
    estimated, true = _trajectories(poses, true_poses)
    if not 1 <= delta < len(true):
        raise ValueError(f"delta: expected 1 to {len(true) - 1} for {len(true)} poses, got {delta}")
    first = np.arange(len(true) - delta)
    return _relative_errors(estimated, true, first, first + delta)


def kitti_errors(
    poses: Poses, true_poses: Poses, *, lengths: Sequence[float] = _KITTI_LENGTHS, step: int = 10
) -> tuple[float, float]:
    """The errors of the KITTI odometry benchmark (Geiger et al. 2012): drift over stretches of path.

    A stretch starts at every `step`-th frame and ends with the first that is further along the true path than a length.
    The mean is over all stretches of all lengths.

    Args:
        poses, true_poses: N of each, sensor to world, in worlds of their own.
        lengths: metres.

    Returns:
        Translation, percent of the length, and rotation, degrees per metre.

    Raises:
        ValueError: if there are not as many poses as true ones, one is no rigid motion, or the path is shorter than the
            shortest length.
    """
    estimated, true = _trajectories(poses, true_poses)
    along = np.concatenate([[0], np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).cumsum()])
    first, length = (part.ravel() for part in np.meshgrid(np.arange(0, len(true), step), np.asarray(lengths, float)))
    last = np.searchsorted(along, along[first] + length, side="right")
    there = last < len(true)
    if not there.any():
        raise ValueError(f"lengths: expected one below {along[-1]:.1f} m, the length of the path, got {tuple(lengths)}")
    translation, rotation = _relative_errors(estimated, true, first[there], last[there])
    return (
        float(100 * np.mean(translation / length[there])),
        float(np.degrees(np.mean(rotation / length[there]))),
    )


def _trajectories(poses: Poses, true_poses: Poses) -> tuple[Float[np.ndarray, "N 4 4"], Float[np.ndarray, "N 4 4"]]:
    estimated, true = (
        np.array([pose_matrix(pose, f"{name}[{i}]") for i, pose in enumerate(each)]).reshape(-1, 4, 4)
        for name, each in (("poses", poses), ("true_poses", true_poses))
    )
    if len(estimated) != len(true) or not len(true):
        raise ValueError(f"poses: expected as many as true_poses, at least one, got {len(estimated)} and {len(true)}")
    return estimated, true


def _relative_errors(
    estimated: Float[np.ndarray, "N 4 4"], true: Float[np.ndarray, "N 4 4"], first: np.ndarray, last: np.ndarray
) -> tuple[Float[np.ndarray, "M"], Float[np.ndarray, "M"]]:
    moved, moved_truly = (np.linalg.inv(each[first]) @ each[last] for each in (estimated, true))
    errors = [
        _errors(matrix, matrix_true, np.zeros(3), np) for matrix, matrix_true in zip(moved, moved_truly, strict=True)
    ]
    translation, rotation = np.array(errors).reshape(-1, 2).T
    return translation, rotation


def _best_rotation(points: Float[np.ndarray, "N 3"], onto: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation that fits centred points onto others best (Umeyama 1991)."""
    left, _, right = np.linalg.svd((onto - onto.mean(axis=0)).T @ (points - points.mean(axis=0)))
    sign = np.sign(np.linalg.det(left) * np.linalg.det(right))
    return left @ np.diag([1, 1, sign]) @ right


def _errors(matrix: Any, true: Any, point: Any, numpy: ModuleType) -> tuple[Any, Any]:
    """For float arrays of `numpy`, which is NumPy or `jax.numpy`."""
    left = true[:3, :3].T @ matrix[:3, :3]
    # sin(angle) · axis and cos(angle): unlike either alone, the two together are accurate at every angle.
    sine = numpy.stack([left[2, 1] - left[1, 2], left[0, 2] - left[2, 0], left[1, 0] - left[0, 1]]) / 2
    cosine = (numpy.trace(left) - 1) / 2
    # Differences first: at large coordinates each of the two moved points alone has lost digits.
    shift = matrix[:3, 3] - true[:3, 3] + (matrix[:3, :3] - true[:3, :3]) @ point
    return _norm(shift, numpy), numpy.arctan2(_norm(sine, numpy), cosine)


def _norm(vector: Any, numpy: ModuleType) -> Any:
    """The Euclidean norm, whose gradient at 0 is 0 rather than NaN."""
    squared = (vector**2).sum()
    positive = squared > 0
    return numpy.where(positive, numpy.sqrt(numpy.where(positive, squared, 1)), 0)
