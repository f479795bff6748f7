"""Poses as text files, and pose graphs as g2o files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mcgicp_jax._math.poses import checked_pose_matrix, matrices_of, parameters_of, pose_matrices
from mcgicp_jax._pose_graph.edge import WORLD, Edge
from mcgicp_jax._pose_graph.graph import PoseGraph
from mcgicp_jax.io.files import open_text, replacing

# Quaternions are commonly written with four digits.
_UNIT_TOLERANCE = 1e-3
# Tags of the lines. A prior has a vertex and the number of the sensor's offset, which has a line of its own.
_VERTEX, _EDGE, _PRIOR, _OFFSET = "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", "EDGE_SE3_PRIOR", "PARAMS_SE3OFFSET"
# Per tag: number of integers at the start of a line, and total number of values.
_WIDTHS = {_VERTEX: (1, 8), _EDGE: (2, 30), _PRIOR: (2, 30), _OFFSET: (1, 8)}


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
    with open_text(path, "poses") as file:
        # Blank lines and comments are removed because loadtxt warns if no data remain.
        lines = [line for line in file if line.split("#")[0].strip()]
        poses = _poses_of(np.loadtxt(lines, ndmin=2) if lines else np.empty((0, 0)))
    for i, pose in enumerate(poses):
        checked_pose_matrix(pose, f"{path}: pose {i}")
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
    matrices = np.array([checked_pose_matrix(pose, f"poses[{i}]") for i, pose in enumerate(poses)]).reshape(-1, 4, 4)
    rows = matrices[:, :3].reshape(-1, 12)
    if timestamps is not None:
        times = np.asarray(timestamps, np.float64)
        if times.shape != (len(rows),):
            raise ValueError(f"timestamps: expected shape ({len(rows)},) to go with poses, got {times.shape}")
        quaternions = Rotation.from_matrix(matrices[:, :3, :3]).as_quat(canonical=True)
        rows = np.column_stack([times, matrices[:, :3, 3], quaternions])
    with replacing(path) as file:
        np.savetxt(file, rows, fmt="%.17g")


def read_g2o(path: str | os.PathLike[str]) -> PoseGraph:
    """Read a pose graph of `VERTEX_SE3:QUAT`, `EDGE_SE3:QUAT` and `EDGE_SE3_PRIOR` lines; others are ignored.

    A line holds x y z qx qy qz qw and the upper triangle of the information matrix. As in GTSAM and Ceres, the matrix
    refers to ξ = (v, ω). g2o itself uses the vector part of the quaternion, half of ω, in place of ω.

    Args:
        path: the file. Vertices may have any numbers; they become rows in ascending order. Edges between vertices whose
            numbers are not consecutive are loops. Priors become edges from the world.

    Raises:
        OSError: if the file cannot be opened.
        ValueError: if a line has the wrong format, or the graph is not valid; the message starts with the path.
    """
    with open_text(path, "a pose graph") as file:
        words = [(number, line.split()) for number, line in enumerate(file, 1)]
        (_, vertices), (edge_lines, edges), (prior_lines, priors), (_, offsets) = (_rows(words, tag) for tag in _WIDTHS)
        if not len(vertices):
            others = ", ".join(sorted({line[0] for _, line in words if line})[:4])
            raise ValueError(f"expected lines {_VERTEX}, poses in space, got {others or 'none'}")
        if len(priors) and np.any(offsets[:, 1:] != [0, 0, 0, 0, 0, 0, 1]):
            raise ValueError(f"expected priors of the poses themselves, got {_OFFSET} other than the identity")
        ends, values = np.concatenate([edges[:, :2], priors[:, [0, 0]]]), np.concatenate([edges, priors])
        numbers, first = np.unique(vertices[:, 0], return_index=True)
        rows = np.searchsorted(numbers, ends).clip(max=len(numbers) - 1)
        missing = np.argwhere(numbers[rows] != ends)
        if len(missing):
            line = [*edge_lines, *prior_lines][missing[0, 0]]
            raise ValueError(f"line {line}: expected a vertex for each end, got none of number {ends[*missing[0]]:g}")
        upper, information = np.triu_indices(6), np.zeros((len(values), 6, 6))
        information[:, *upper] = information[:, *upper[::-1]] = values[:, 9:]
        of_world = np.arange(len(values)) >= len(edges)
        loop = ~of_world & (np.abs(ends[:, 0] - ends[:, 1]) != 1)
        i = np.where(of_world, WORLD, rows[:, 0])
        # x y z qx qy qz qw, with quaternions of any norm.
        poses, motions = (matrices_of(p[:, [6, 3, 4, 5, 0, 1, 2]]) for p in (vertices[first, 1:], values[:, 2:9]))
        return PoseGraph(poses, Edge(i, rows[:, 1], motions, information, uncertain=loop))


def write_g2o(path: str | os.PathLike[str], graph: PoseGraph | Any) -> None:
    """Write a pose graph, or the result of `optimize_poses` without the loops that it rejected, as `read_g2o` reads it.

    Raises:
        OSError: if the file cannot be written.
        ValueError: if `graph` is neither, or has factors that are not edges, for which the format has no lines.
    """
    if not isinstance(getattr(graph, "edges", None), Edge):
        raise ValueError(f"graph: expected a PoseGraph or a PoseGraphResult, got {type(graph).__name__}")
    if others := getattr(graph, "factors", None) or getattr(graph, "factor_weights", None):
        raise ValueError(f"graph: expected edges alone, which g2o files can hold, got {len(others)} further factors")
    edges, poses = graph.edges[np.asarray(getattr(graph, "kept", np.ones(len(graph.edges), bool)))], graph.poses
    i, j, motions = np.asarray(edges.i), np.asarray(edges.j), np.asarray(edges.T_i_j)
    upper, none = np.asarray(edges.information)[:, *np.triu_indices(6)], np.zeros((len(poses), 0))
    of_world = i == WORLD
    lines = [
        (_VERTEX, np.arange(len(poses))[:, None], poses, none),
        (_EDGE, np.column_stack([i, j])[~of_world], motions[~of_world], upper[~of_world]),
    ]
    if of_world.any():
        lines.append((_OFFSET, np.zeros((1, 1)), np.eye(4)[None], none[:1]))
        lines.append((_PRIOR, np.column_stack([j, 0 * j])[of_world], motions[of_world], upper[of_world]))
    with replacing(path) as file:
        for tag, numbers, matrices, information in lines:
            parameters = parameters_of(np.asarray(matrices, np.float64))[:, [4, 5, 6, 1, 2, 3, 0]]
            whole, width = _WIDTHS[tag]
            form = " ".join([tag, *["%d"] * whole, *["%.17g"] * (width - whole)])
            np.savetxt(file, np.column_stack([numbers, parameters, information]), fmt=form)


def _rows(lines: list[tuple[int, list[str]]], tag: str) -> tuple[list[int], Float[np.ndarray, "N _"]]:
    whole, width = _WIDTHS[tag]
    line_numbers, rows = [], []
    for line, words in lines:
        if words[:1] == [tag]:
            try:
                row = [float(word) for word in words[1:]]
            except ValueError as error:
                raise ValueError(f"line {line}: {error}") from error
            if len(row) != width:
                raise ValueError(f"line {line}: expected {width} numbers after {tag}, got {len(row)}")
            if not (np.isfinite(row).all() and any(row[whole + 3 : whole + 7])):
                raise ValueError(f"line {line}: expected finite numbers and a quaternion other than 0, got {row}")
            if any(abs(number) >= 2**53 for number in row[:whole]):
                raise ValueError(f"line {line}: expected vertex numbers below 2^53, got {words[1]}; number them anew")
            line_numbers.append(line)
            rows.append(row)
    return line_numbers, np.array(rows).reshape(-1, width)
