"""Point clouds as files; the suffix selects the format."""

from __future__ import annotations

import gzip
import io
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO
from zipfile import ZipFile

import numpy as np

import mcgicp_jax.io.arrays as arrays
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.messages import check_integer
from mcgicp_jax.io.files import reason_of, replacing
from mcgicp_jax.io.las import read_las, write_las
from mcgicp_jax.io.pcd import read_pcd, write_pcd
from mcgicp_jax.io.ply import read_ply, write_ply
from mcgicp_jax.io.text import is_text_cloud, read_text, write_text


@dataclass(frozen=True)
class Format:
    """Functions of a file format.

    Attributes:
        read: reads a cloud from an open file, given its size in bytes.
        write: writes a cloud without padding, with NaN for missing channels, to an open file.
        is_cloud: whether an open file with this suffix is a cloud, for suffixes that other kinds of files have, too.
    """

    read: Callable[[BinaryIO, int], PointCloud]
    write: Callable[[BinaryIO, PointCloud], None]
    is_cloud: Callable[[BinaryIO], bool] = lambda _: True


def _not_written(file: BinaryIO, cloud: PointCloud) -> None:
    raise ValueError("path: files of this kind are only read; .ply holds any cloud")


_SPACES = Format(read_text, partial(write_text, delimiter=" ", mark="# "), is_text_cloud)
# By lower-case suffix.
FORMATS = {
    ".ply": Format(read_ply, write_ply),
    ".pcd": Format(read_pcd, write_pcd),
    ".las": Format(read_las, partial(write_las, compress=False)),
    ".laz": Format(read_las, partial(write_las, compress=True)),
    ".bin": Format(arrays.read_kitti, arrays.write_kitti),
    ".pcd.bin": Format(arrays.read_nuscenes, _not_written),
    ".npy": Format(arrays.read_npy, arrays.write_npy, arrays.is_npy_cloud),
    ".npz": Format(arrays.read_npz, arrays.write_npz, lambda file: "points.npy" in ZipFile(file).namelist()),
    ".xyz": _SPACES,
    ".txt": _SPACES,
    ".csv": Format(read_text, partial(write_text, delimiter=",", mark=""), is_text_cloud),
}


def format_of(path: Path, columns: int | None = None) -> Format:
    """The format for the suffix of a path; raises `ValueError` for an unknown suffix. `columns` as in `read`."""
    file_format = _known_format(path, columns)
    if file_format is None:
        kind = "a folder" if path.is_dir() else f"unknown suffix {path.suffix!r}"
        raise ValueError(f"{path}: {kind}; expected one of {', '.join(FORMATS)}")
    return file_format


def _known_format(path: Path, columns: int | None = None) -> Format | None:
    """The format for the last two suffixes of a path or the last one, also of a file that gzip compressed."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes[-1:] == [".gz"]:
        inner = _known_format(path.with_suffix(""), columns)
        return inner and Format(
            lambda file, size: inner.read(*_decompressed(file, size)),
            _not_written,
            lambda file: inner.is_cloud(_decompressed(file, os.fstat(file.fileno()).st_size)[0]),
        )
    file_format = FORMATS.get("".join(suffixes[-2:])) or FORMATS.get("".join(suffixes[-1:]))
    if columns is not None and file_format is not None and file_format.read is arrays.read_kitti:
        return replace(file_format, read=partial(arrays.read_kitti, columns=columns))
    return file_format


class _Decompressed(io.BytesIO):
    """`BytesIO` with the two attributes of `BinaryIO` that it lacks."""

    name, mode = "", "rb"


def _decompressed(file: BinaryIO, size: int) -> tuple[BinaryIO, int]:
    data = gzip.GzipFile(fileobj=file).read(arrays.DEFLATE_RATIO * size)
    return _Decompressed(data), len(data)


def is_cloud(path: Path) -> bool:
    """Whether a file is a cloud by its suffix and, where this is not enough, by the start of its content."""
    file_format = _known_format(path)
    if file_format is None:
        return False
    with open(path, "rb") as file:
        try:
            return file_format.is_cloud(file)
        except Exception:
            # Damaged: its reader says so, and names it.
            return True


def read(path: str | os.PathLike[str], *, columns: int | None = None) -> PointCloud:
    """Read a raw cloud from a file.

    Every numeric column with one value per point becomes a channel, except coordinates, normals, alpha (`a`) and
    per-point metadata (label, class, ring, range, depth, time, index and the like). The channels are, in this order:

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

    A column `time`, `t`, `timestamp`, `gps_time`, `offset_time` or the like becomes `PointCloud.times`, and no channel.

    In every format, NaN in a channel means that the point lacks the channel; see `PointCloud.channel_valid`.

    Args:
        path: the suffix, in any case, selects the format: `.ply`, `.pcd`, `.las`, `.laz`, `.bin` (float32: KITTI, or
            nuScenes, with ring and time, PCL's 32 bytes or x, y, z alone where the columns fit), `.pcd.bin` (nuScenes),
            `.npy`, `.npz`, `.xyz`, `.txt` or `.csv`, each also followed by `.gz`.
        columns: number of float32 values of each point of a `.bin` file whose columns fit none of these, at least 3:
            x, y, z, and fourth the intensity, unless it has negative values. Other formats state or show theirs.

    Returns:
        Cloud of NumPy arrays: points (N, 3), metres, float64 if the file stores float64 (always for LAS and text);
        channels (N, C). Points with non-finite coordinates are kept.

    Raises:
        OSError: if the file cannot be opened.
        ImportError: if the format needs a package that is not installed.
        ValueError: if the file is not a valid cloud or has no points; the message starts with the path.
    """
    path = Path(path)
    if columns is not None:
        check_integer("columns", columns, 3)
    reader = format_of(path, columns).read
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
            suffix = "".join(path.suffixes[-2:] if path.suffix.lower() == ".gz" else [path.suffix]).lower()
            raise ValueError(f"{path}: cannot be read as {suffix}: {reason_of(error)}") from error
    return cloud


def write(path: str | os.PathLike[str], cloud: PointCloud) -> None:
    """Write the valid points of a cloud, in the user's frame, to a file.

    `read` restores the cloud within the limits of the format. PLY, PCD and NPZ preserve float32 and float64; colours
    that are all multiples of 1/255 are stored as 8-bit integers. Times are written as a column `time`
    by PLY, PCD, NPZ and text. Only `.npz` preserves the covariances, only `.npz` and
    `.npy` the channel order; `.npy` has no channel names; KITTI is float32. LAS rounds coordinates to a power of ten,
    with an error of at most 5·10⁻⁹ of the cloud's extent, and colours to 16 bits. Missing channels are written as NaN,
    which LAS cannot represent. A failed write leaves an existing file unchanged.

    Args:
        path: the suffix selects the format, as in `read`.
        cloud: one cloud, raw or preprocessed; points in metres.

    Raises:
        OSError: if the file cannot be written.
        ImportError: if the format needs a package that is not installed.
        ValueError: if it is no `PointCloud`, is empty, is a batch, or cannot be represented in the format.
    """
    if not isinstance(cloud, PointCloud):
        raise ValueError(f"cloud: expected a PointCloud, got {type(cloud).__name__}; the order is write(path, cloud)")
    path = Path(path)
    writer = format_of(path).write
    if cloud.points.ndim != 2:
        raise ValueError(f"cloud: expected a single cloud, got points of shape {tuple(cloud.points.shape)}")
    if len(cloud) == 0:
        raise ValueError("cloud: expected at least one point to write, got none")
    cloud = cloud.unpad()
    if cloud.channel_valid is not None:
        channels = np.where(cloud.channel_valid, cloud.channels, np.nan)
        cloud = cloud.replace(channels=channels, channel_valid=None)
    with replacing(path) as file:
        writer(file, cloud)
