"""Point clouds and poses, read from files and written to them."""

from __future__ import annotations

import contextlib
import os
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float

from mcgicp_jax._cloud import PointCloud
from mcgicp_jax._formats import READERS, WRITERS, by_suffix
from mcgicp_jax._pose import pose_matrix


def read(path: str | os.PathLike[str]) -> PointCloud:
    """Reads a raw cloud; the suffix of the path, in any case, says which format it is.

    `.ply`, `.pcd`, `.las`, `.laz`, `.bin` (KITTI), `.npy`, `.npz`, `.xyz`, `.txt`, `.csv`.

    Channels are every numeric column of the file with one value per point, except coordinates, normals, and what only
    numbers or describes the points (label, ring, time, index and the like). They come in this order:

    - "intensity", also found as reflectance, reflectivity, remission, ...; in the file's unit;
    - "red", "green", "blue", also found as r, g, b, diffuse_* and packed rgb; integers are scaled to 0..1 (by 65535
      if 16-bit, else by 255), floating-point colours stay as they are;
    - all others under their own names, in the order of the file. `channel_NAME` is NAME where NAME alone would not be
      read as such; `write` makes use of it.

    LAS gives its 16-bit colours, and its intensity unless that is 0 everywhere, which the format defines as absent. LAS
    colours that are all below 256 are taken as 8-bit ones that were not scaled up, a common mistake of exporters. In
    text, colours in a column of whole numbers without a decimal point count as integers; columns are named in a first
    line, or else are x, y, z, channel_0, ... as in `.npy`, (N, 3 + C). `.npz` holds `points` (N, 3), and `channels`
    (N, C) with `channel_names`, or `intensity` (N,) and `rgb` or `colors` (N, 3).

    NaN in a channel says, in every format, that the point has no such channel: `PointCloud.channel_valid`.

    Returns:
        A cloud of NumPy arrays: points (N, 3), metres, as float64 where the file holds them so (always in LAS and
        text); channels (N, C). Rows whose coordinates are not finite are kept.

    Raises:
        OSError: if the file cannot be opened.
        ImportError: if the format needs a package that is not installed.
        ValueError: if the file is no cloud, is damaged, or has no points; the message starts with the path.
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
            # The libraries raise whatever comes to them, lazrs even a panic of Rust's, which is no Exception.
            if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
                raise
            reason = "it is no text" if isinstance(error, UnicodeError) else str(error) or type(error).__name__
            raise ValueError(f"{path}: cannot be read as {path.suffix.lower()}: {reason}") from error
    return cloud


def write(path: str | os.PathLike[str], cloud: PointCloud) -> None:
    """Writes the valid rows of a cloud in the user's frame; the suffix of the path says which format.

    `read` gives the same cloud back, with what the format can hold: float32 and float64 stay as they are in PLY, PCD
    and NPZ, colours that are whole 255ths are stored as 8-bit integers; `.npy` keeps no names, `.npz` alone keeps the
    order of the channels and the covariances; KITTI holds float32. LAS rounds coordinates to a power of ten, at worst
    5·10⁻⁹ of the cloud's extent, and colours to 16 bits. Channels that a point does not have become NaN, which LAS
    cannot hold. A failed write leaves an existing file as it was.

    Args:
        path: `.ply`, `.pcd`, `.las`, `.laz`, `.bin` (KITTI), `.npy`, `.npz`, `.xyz`, `.txt` or `.csv`.
        cloud: one cloud, raw or preprocessed; points in metres.

    Raises:
        OSError: if the file cannot be written.
        ImportError: if the format needs a package that is not installed.
        ValueError: if the cloud is empty or a batch, or has what the format cannot hold.
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
    """Reads poses from text; the number of columns says which form it is.

    12: KITTI, the upper three rows of the matrix. 8: TUM, `timestamp tx ty tz qx qy qz qw`; 7: the same without the
    timestamp. Four rows of 4: one matrix.

    Returns:
        (N, 4, 4) float64, translations in metres.

    Raises:
        OSError: if the file cannot be opened.
        ValueError: if the file holds no poses, or one is no rigid motion; the message starts with the path.
    """
    with open(path, encoding="utf-8-sig") as file:
        try:
            # loadtxt only warns of a file without numbers.
            lines = [line for line in file if line.split("#")[0].strip()]
            rows = np.loadtxt(lines, ndmin=2) if lines else np.empty((0, 0))
        except ValueError as error:
            reason = "it is no text" if isinstance(error, UnicodeError) else error
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
    """Writes poses in KITTI's form, or in TUM's if there are timestamps.

    Args:
        path: any name.
        poses: (N, 4, 4) or a sequence of poses, metres.
        timestamps: (N,), seconds.

    Raises:
        OSError: if the file cannot be written.
        ValueError: if a pose is no rigid motion, or there is not one timestamp for each.
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


def _rotations(quaternions: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 3 3"]:
    """Of x y z w, in any scale; NaN for 0. (jaxlie would round to float32 unless x64 is on.)"""
    with np.errstate(invalid="ignore"):
        unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    cross = np.cross(np.eye(3), unit[:, None, :3])
    return np.eye(3) + 2 * (unit[:, 3, None, None] * cross + cross @ cross)


def _quaternions(rotations: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N 4"]:
    """x y z w, w ≥ 0: the longest column of 4 q qᵀ, which the rotation gives without a root."""
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
    """Errors name the file as the user knows it."""
    try:
        yield
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from None


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[BinaryIO]:
    """A file that takes the name `path` once it is complete."""
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
