"""Reading and writing of point clouds and poses."""

from __future__ import annotations

import contextlib
import os
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._math.poses import pose_matrix
from mcgicp_jax._pose_graph.edge import Edge
from mcgicp_jax._pose_graph.graph import PoseGraph
from mcgicp_jax.io.formats import READERS, WRITERS, by_suffix
from mcgicp_jax.io.g2o import graph_of, lines_of


def read(path: str | os.PathLike[str]) -> PointCloud:
    """Read a raw cloud from a file.

    Every numeric column with one value per point becomes a channel, except coordinates, normals and per-point metadata
    (label, ring, time, index and the like). The channels are, in this order:

    - "intensity", in the file's unit; aliases such as reflectance, reflectivity and remission are recognised;
    - "red", "green", "blue", also from r, g, b, diffuse_* or packed rgb; integers are scaled to 0..1 (divided by 65535
      if 16-bit, else by 255), floating-point colours are unchanged;
    - all other columns under their own names, in file order. A column `channel_NAME`, as `write` uses it, is read as
      NAME where a column NAME would be skipped or renamed.

    LAS: an intensity of 0 everywhere means that the file has none, by definition of the format. Colours that are all
    below 256 are taken as 8-bit values that the exporter failed to scale to 16 bits, a common mistake. Text: colours
    are integers if the column holds whole numbers without a decimal point; a first line may name the columns, which
    are otherwise x, y, z, channel_0, ... as in `.npy` (N, 3 + C). `.npz`: `points` (N, 3), with `channels` (N, C) and
    `channel_names`, or with `intensity` (N,) and `rgb` or `colors` (N, 3).

    In every format, NaN in a channel means that the point lacks the channel; see `PointCloud.channel_valid`.

    Args:
        path: the suffix, in any case, selects the format: `.ply`, `.pcd`, `.las`, `.laz`, `.bin` (KITTI), `.npy`,
            `.npz`, `.xyz`, `.txt` or `.csv`.

    Returns:
        Cloud of NumPy arrays: points (N, 3), metres, float64 if the file stores float64 (always for LAS and text);
        channels (N, C). Points with non-finite coordinates are kept.

    Raises:
        OSError: if the file cannot be opened.
        ImportError: if the format needs a package that is not installed.
        ValueError: if the file is not a valid cloud or has no points; the message starts with the path.
    """
    path = Path(path)
    reader = by_suffix(READERS, path)
    with open(path, "rb") as file:
        try:
            size = os.fstat(file.fileno()).st_size
            if size == 0:
                raise ValueError("the file is empty")
            cloud = reader(file, size)
            if len(cloud) == 0:
                raise ValueError("it has no points")
            missing = np.isnan(cloud.channels)
            if missing.any():
                cloud = cloud.replace(channel_valid=~missing)
        except ImportError:
            raise
        except BaseException as error:
            # The libraries raise arbitrary exceptions; lazrs raises Rust's PanicException, a BaseException.
            if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
                raise
            reason = "it is not text" if isinstance(error, UnicodeError) else str(error) or type(error).__name__
            raise ValueError(f"{path}: cannot be read as {path.suffix.lower()}: {reason}") from error
    return cloud


def write(path: str | os.PathLike[str], cloud: PointCloud) -> None:
    """Write the valid points of a cloud, in the user's frame, to a file.

    `read` restores the cloud within the limits of the format. PLY, PCD and NPZ preserve float32 and float64; colours
    that are all multiples of 1/255 are stored as 8-bit integers. Only `.npz` preserves the channel order and the
    covariances; `.npy` has no channel names; KITTI is float32. LAS rounds coordinates to a power of ten, with an error
    of at most 5·10⁻⁹ of the cloud's extent, and colours to 16 bits. Missing channels are written as NaN, which LAS
    cannot represent. A failed write leaves an existing file unchanged.

    Args:
        path: the suffix selects the format: `.ply`, `.pcd`, `.las`, `.laz`, `.bin` (KITTI), `.npy`, `.npz`, `.xyz`,
            `.txt` or `.csv`.
        cloud: one cloud, raw or preprocessed; points in metres.

    Raises:
        OSError: if the file cannot be written.
        ImportError: if the format needs a package that is not installed.
        ValueError: if the cloud is empty, is a batch, or cannot be represented in the format.
    """
    path = Path(path)
    writer = by_suffix(WRITERS, path)
    if cloud.points.ndim != 2:
        raise ValueError(f"cloud: expected a single cloud, got points of shape {tuple(cloud.points.shape)}")
    if len(cloud) == 0:
        raise ValueError("cloud: expected at least one point to write, got none")
    cloud = cloud.unpad()
    if cloud.channel_valid is not None:
        channels = np.where(cloud.channel_valid, cloud.channels, np.nan)
        cloud = cloud.replace(channels=channels, channel_valid=None)
    with _replacing(path) as file:
        writer(file, cloud)


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
            rows = np.loadtxt(lines, ndmin=2) if lines else np.empty((0, 0))
        except ValueError as error:
            reason = "it is not text" if isinstance(error, UnicodeError) else error
            raise ValueError(f"{path}: cannot be read as poses: {reason}") from error
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if rows.shape == (4, 4):
        poses = rows[None]
    elif rows.shape[1] == 12:
        poses[:, :3] = rows.reshape(-1, 3, 4)
    elif rows.shape[1] in (7, 8):
        poses[:, :3, 3] = rows[:, -7:-4]
        poses[:, :3, :3] = _rotations(rows[:, -4:])
    else:
        raise ValueError(f"{path}: expected rows of 12 (KITTI) or 8 (TUM) numbers or a 4×4 matrix, got {rows.shape}")
    for i, pose in enumerate(poses):
        pose_matrix(pose, f"{path}: pose {i}")
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
        ValueError: if a pose is no rigid motion, or the number of timestamps differs from that of the poses.
    """
    matrices = np.array([pose_matrix(pose, f"poses[{i}]") for i, pose in enumerate(poses)]).reshape(-1, 4, 4)
    rows = matrices[:, :3].reshape(-1, 12)
    if timestamps is not None:
        times = np.asarray(timestamps, np.float64)
        if times.shape != (len(rows),):
            raise ValueError(f"timestamps: expected shape ({len(rows)},) to go with poses, got {times.shape}")
        rows = np.column_stack([times, matrices[:, :3, 3], _quaternions(matrices[:, :3, :3])])
    with _replacing(Path(path)) as file:
        np.savetxt(file, rows, fmt="%.17g")


def read_g2o(path: str | os.PathLike[str]) -> PoseGraph:
    """Read a pose graph of `VERTEX_SE3:QUAT`, `EDGE_SE3:QUAT` and `EDGE_SE3_PRIOR` lines; others are ignored.

    Numbers are x y z qx qy qz qw, and the upper triangle of the information. As in GTSAM and Ceres, the information is
    taken to be that of ξ = (v, ω); g2o itself means the vector part of the quaternion, which is half of ω.

    Args:
        path: the file. Vertices may have any numbers; they become rows in ascending order. Edges between vertices whose
            numbers are not consecutive are uncertain. Priors become edges from the world.

    Raises:
        OSError: if the file cannot be opened.
        ValueError: if a line has the wrong format, or the graph is not valid; the message starts with the path.
    """
    with open(path, encoding="utf-8-sig") as file:
        try:
            return graph_of(file)
        except ValueError as error:
            reason = "it is not text" if isinstance(error, UnicodeError) else error
            raise ValueError(f"{path}: cannot be read as a pose graph: {reason}") from error


def write_g2o(path: str | os.PathLike[str], graph: PoseGraph | Any) -> None:
    """Write a pose graph, or the result of `optimize_poses` without the edges that it rejected, as `read_g2o` reads it.

    Raises:
        OSError: if the file cannot be written.
        ValueError: if `graph` is neither.
    """
    if not isinstance(getattr(graph, "edges", None), Edge):
        raise ValueError(f"graph: expected a PoseGraph or a PoseGraphResult, got {type(graph).__name__}")
    with _replacing(Path(path)) as file:
        for form, rows in lines_of(graph):
            np.savetxt(file, rows, fmt=form)


def _rotations(quaternions: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 3 3"]:
    """Rotations from quaternions (x, y, z, w) of any norm; NaN for norm 0. (jaxlie rounds to float32 without x64.)"""
    with np.errstate(invalid="ignore"):
        unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    cross = np.cross(np.eye(3), unit[:, None, :3])
    return np.eye(3) + 2 * (unit[:, 3, None, None] * cross + cross @ cross)


def _quaternions(rotations: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N 4"]:
    """Unit quaternions (x, y, z, w), w ≥ 0: the longest column of 4 q qᵀ, which is linear in the rotation matrix."""
    trace = np.trace(rotations, axis1=1, axis2=2)[:, None]
    outer = np.empty((len(rotations), 4, 4))
    outer[:, :3, :3] = rotations + rotations.swapaxes(1, 2) + (1 - trace[..., None]) * np.eye(3)
    outer[:, :3, 3] = (rotations - rotations.swapaxes(1, 2))[:, [2, 0, 1], [1, 2, 0]]
    outer[:, 3, :3] = outer[:, :3, 3]
    outer[:, 3, 3:] = 1 + trace
    lengths = np.linalg.norm(outer, axis=1)
    longest = np.argmax(lengths, axis=1)[:, None]
    columns = np.take_along_axis(outer, longest[..., None], axis=2)[..., 0]
    return columns / np.take_along_axis(lengths, longest, axis=1) * np.where(columns[:, 3:] < 0, -1, 1)


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Re-raise `OSError` with the user's path instead of that of the temporary file."""
    try:
        yield
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from None


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file that replaces `path` when the block succeeds."""
    temporary = path.with_name(f".{uuid.uuid4().hex}.tmp")
    try:
        with _named(path):
            file = open(temporary, "x+b")  # noqa: SIM115
        with file:
            yield file
        with _named(path):
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
