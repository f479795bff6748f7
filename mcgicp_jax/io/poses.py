"""Poses as text files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from mcgicp_jax._math.poses import pose_matrices, pose_matrix
from mcgicp_jax.io.files import reason_of, replacing

# Quaternions are commonly written with four digits.
_UNIT_TOLERANCE = 1e-3


def read_poses(path: str | os.PathLike[str]) -> Float[np.ndarray, "N 4 4"]:
    """Read poses from a text file.

    Args:
        path: the number of columns selects the format. 12: KITTI, the upper three rows of the matrix. 8: TUM,
            `timestamp tx ty tz qx qy qz qw`; 7: the same without timestamp. Four rows of 4: a single matrix.

    Returns:
        (N, 4, 4) float64, translations in metres.

    Raises:
        OSError: if the file cannot be opened.
        ValueError: if the file has another format, or a pose is no rigid motion; the message starts with the path.
    """
    with open(path, encoding="utf-8-sig") as file:
        try:
            # Blank lines and comments are removed because loadtxt warns if no data remain.
            lines = [line for line in file if line.split("#")[0].strip()]
            poses = _poses_of(np.loadtxt(lines, ndmin=2) if lines else np.empty((0, 0)))
        except ValueError as error:
            raise ValueError(f"{path}: cannot be read as poses: {reason_of(error)}") from error
    for i, pose in enumerate(poses):
        pose_matrix(pose, f"{path}: pose {i}")
    return poses


def are_poses(lines: list[str]) -> bool:
    """Whether lines of a text that may be a cloud are KITTI or TUM poses or a 4×4 matrix."""
    try:
        rows = np.loadtxt(lines, ndmin=2)
        pose_matrices(_poses_of(rows))
    except ValueError:
        return False
    # Point, normal and curvature are seven numbers like a pose, and eight with an intensity.
    timed = rows.shape[1] == 8 and bool((np.diff(rows[:, 0]) > 0).all())
    unit = bool((np.abs(np.linalg.norm(rows[:, -4:], axis=1) - 1) < _UNIT_TOLERANCE).all())
    return rows.shape[1] in (4, 12) or (timed and unit)


def _poses_of(rows: Float[np.ndarray, "R C"]) -> Float[np.ndarray, "N 4 4"]:
    from scipy.spatial.transform import Rotation

    if rows.shape == (4, 4):
        return rows[None]
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if rows.shape[1] == 12:
        poses[:, :3] = rows.reshape(-1, 3, 4)
    elif rows.shape[1] in (7, 8):
        poses[:, :3, 3] = rows[:, -7:-4]
        poses[:, :3, :3] = Rotation.from_quat(rows[:, -4:]).as_matrix()
    else:
        raise ValueError(f"expected rows of 12 (KITTI) or 8 (TUM) numbers or a 4×4 matrix, got {rows.shape}")
    return poses


def write_poses(
    path: str | os.PathLike[str],
    poses: Float[np.ndarray, "N 4 4"] | Sequence[Any],
    timestamps: Float[np.ndarray, "N"] | Sequence[float] | None = None,
) -> None:
    """Write poses to a text file in the KITTI format, or in the TUM format if timestamps are given.

    Args:
        path: any file name.
        poses: (N, 4, 4), or a sequence of `jaxlie.SE3` or (4, 4); translations in metres.
        timestamps: (N,), seconds.

    Raises:
        OSError: if the file cannot be written.
        ValueError: if a pose is no rigid motion, or there are not as many timestamps as poses.
    """
    from scipy.spatial.transform import Rotation

    matrices = np.array([pose_matrix(pose, f"poses[{i}]") for i, pose in enumerate(poses)]).reshape(-1, 4, 4)
    rows = matrices[:, :3].reshape(-1, 12)
    if timestamps is not None:
        times = np.asarray(timestamps, np.float64)
        if times.shape != (len(rows),):
            raise ValueError(f"timestamps: expected shape ({len(rows)},) to go with poses, got {times.shape}")
        quaternions = Rotation.from_matrix(matrices[:, :3, :3]).as_quat(canonical=True)
        rows = np.column_stack([times, matrices[:, :3, 3], quaternions])
    with replacing(path) as file:
        np.savetxt(file, rows, fmt="%.17g")
