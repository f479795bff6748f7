"""Arrays without named columns of their own: .bin files of float32 values, such as KITTI scans, .npy and .npz."""

from __future__ import annotations

import math
import zipfile
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float, Shaped
from numpy.lib import format as npy

from mcgicp_jax._clouds.columns import COLORS, INTENSITIES
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax.io.files import check_size, cloud_of

# Metres: float32 resolves 8 mm at this distance; larger coordinates are not written, nor accepted as a KITTI scan.
_KITTI_LIMIT = 1e5
# Bound on the compression ratio of deflate.
DEFLATE_RATIO = 1032
_RGB_ARRAYS = ("rgb", "color", "colors", "colour", "colours")

# Bound of the whole numbers of rings; the densest LiDARs have 128, and some count from 1.
_MOST_RINGS = 256
# In a file of n columns, values differ least from those n places later. A file is not taken to have four columns if
# they differ at one of these other distances by less than this fraction of the difference at four. (At distances other
# than n the ratio is 1.5 and more: KITTI, streets and rooms, in scan order and shuffled.)
_PERIODS, _REPEATS = (3, 5, 6, 7, 9, 10), 0.5
# Number of values that are compared.
_SAMPLE = 120_000
# Numbers of columns that a refusal suggests where they fill the file.
_SIZES = range(3, 11)
# Padding of PCL's points is 0, or the bits of small integers, such as a ring, as float32.
_PADDING = 1e-30


def read_kitti(file: BinaryIO, size: int, columns: int | None = None) -> PointCloud:
    data = file.read()
    if size % 4:
        raise ValueError(f"expected rows of float32 values, got {size} bytes")
    # The format has no signature. Text is recognised by its bytes, most other files by implausibly large coordinates.
    if data.isascii() and b"\0" not in data:
        raise ValueError("it does not hold float32 coordinates in metres")
    cloud = cloud_of(_columns_of_floats(np.frombuffer(data, "<f4").astype(np.float32), columns))
    if _beyond_kitti(np.asarray(cloud.points)):
        raise ValueError("it does not hold float32 coordinates in metres")
    return cloud


def _columns_of_floats(values: Float[np.ndarray, "n"], width: int | None) -> dict[str, Float[np.ndarray, "N"]]:
    """x, y, z and perhaps intensity, by the layout whose columns fit: KITTI (x, y, z, intensity), nuScenes (ring last),
    ring and time last, PCL's points of 32 bytes (x, y, z, padding, intensity, padding), or x, y, z. Of rows of a given
    `width`, the first are x, y, z, and the fourth is the intensity unless it has negative values. Raises
    `ValueError` if none fits."""

    def split(size: int) -> Any:
        return values.reshape(-1, size).T if values.size % size == 0 else None

    def named(columns: Any) -> dict[str, Float[np.ndarray, "N"]]:
        return dict(zip(("x", "y", "z", "intensity"), columns, strict=False))

    columns = split(8) if width in (None, 8) else None
    if columns is not None and (columns[3] == columns[3][:1]).all() and (np.abs(columns[5:]) < _PADDING).all():
        return named([*columns[:3], columns[4]])
    if width is not None:
        columns = split(width)
        if columns is None:
            raise ValueError(f"expected rows of {width} float32 values, got {4 * values.size} bytes")
        has_intensity = width > 3 and not (columns[3] < 0).any()
        return named(columns if has_intensity else columns[:3])
    for size in (6, 5):
        columns = split(size)
        if columns is not None and not (columns[3] < 0).any():
            ring = columns[4]
            is_number = (ring == np.rint(ring)) & (ring >= 0) & (ring < _MOST_RINGS)
            if is_number.all() and (ring != ring[:1]).any():
                return named(columns)
    # Median difference of values to those `size` places later.
    sample, steps = values[:_SAMPLE], {}
    for size in (4, *_PERIODS):
        differences = np.abs(sample[size:] - sample[:-size])
        finite = differences[np.isfinite(differences)]
        steps[size] = float(np.median(finite)) if finite.size else np.inf
    columns = split(4)
    if columns is not None and not (columns[3] < 0).any() and min(steps.values()) >= _REPEATS * steps[4]:
        return named(columns)
    columns = split(3)
    if columns is not None and steps[3] < _REPEATS * min(steps[size] for size in (4, 5, 7, 10)):
        return named(columns)
    fitting = [str(size) for size in _SIZES if values.size % size == 0]
    advice = f"if they begin with x, y, z, say how many there are, columns=N; {', '.join(fitting)} fit"
    raise ValueError(
        "its columns are neither those of KITTI (x, y, z, intensity) nor of another known layout; "
        + (advice if fitting else f"no number of {_SIZES[0]} to {_SIZES[-1]} fills {4 * values.size} bytes")
    )


def read_nuscenes(file: BinaryIO, size: int) -> PointCloud:
    """Five columns: x, y, z, intensity, ring."""
    if size % 20:
        raise ValueError(f"expected rows of five float32 values, got {size} bytes")
    rows = np.frombuffer(file.read(), "<f4").reshape(-1, 5).astype(np.float32)
    if _beyond_kitti(rows[:, :3]):
        raise ValueError("it does not hold float32 coordinates in metres")
    return PointCloud(rows[:, :3], rows[:, 3], channel_names=["intensity"])


def _beyond_kitti(points: Float[np.ndarray, "N 3"]) -> bool:
    return bool((np.abs(points[np.isfinite(points)]) > _KITTI_LIMIT).any())


def write_kitti(file: BinaryIO, cloud: PointCloud) -> None:
    if cloud.channels.shape[1] != 1:
        raise ValueError(f"channels: .bin holds exactly one, got {cloud.channel_names}; .ply holds any number")
    if cloud.channel_names[0].lower() not in (*INTENSITIES, "channel_0"):
        raise ValueError(f"channels: .bin holds the intensity alone, got {cloud.channel_names[0]!r}; .ply holds any")
    if _beyond_kitti(np.asarray(cloud.points)):
        raise ValueError(f"points: .bin holds float32, too coarse beyond {_KITTI_LIMIT:.0f} m; .ply holds float64")
    file.write(np.column_stack([cloud.points, cloud.channels]).astype("<f4").tobytes())


def read_npy(file: BinaryIO, size: int) -> PointCloud:
    array = _read_array(file, size)
    if array.dtype.names is not None:
        return PointCloud(array)
    if array.ndim != 2 or array.shape[1] < 3:
        raise ValueError(f"expected an array of shape (N, 3 + C), got {array.shape}")
    if array.shape[1] > 10 * array.shape[0]:
        raise ValueError(f"expected an array of shape (N, 3 + C), got {array.shape}; transpose it")
    return PointCloud(array[:, :3], array[:, 3:])


def is_npy_cloud(file: BinaryIO) -> bool:
    """Whether it holds rows of numbers or of named columns, and not a pose or several."""
    shape, dtype = _npy_header(file)
    if dtype.names is not None:
        return {"x", "y", "z"} <= {name.lower() for name in dtype.names}
    return len(shape) == 2 and shape[1] >= 3 and shape != (4, 4)


def _npy_header(file: Any) -> tuple[tuple[int, ...], np.dtype]:
    headers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    shape, _, dtype = headers[npy.read_magic(file)](file)
    return shape, dtype


def _read_array(file: Any, size: int) -> Shaped[np.ndarray, "..."]:
    shape, dtype = _npy_header(file)
    check_size(math.prod(shape) * dtype.itemsize, size)
    file.seek(0)
    return npy.read_array(file, allow_pickle=False)


def write_npy(file: BinaryIO, cloud: PointCloud) -> None:
    np.save(file, np.column_stack([cloud.points, cloud.channels]), allow_pickle=False)


def read_npz(file: BinaryIO, size: int) -> PointCloud:
    with zipfile.ZipFile(file) as archive:

        def load(name: str) -> Shaped[np.ndarray, "..."]:
            entry = archive.getinfo(f"{name}.npy")
            with archive.open(entry) as stream:
                return _read_array(stream, min(entry.file_size, DEFLATE_RATIO * size))

        names = [name.removesuffix(".npy") for name in archive.namelist()]
        if "points" not in names:
            raise ValueError(f"it has no array 'points'; found {', '.join(names)}")
        points = np.asarray(PointCloud(load("points")).points)
        if "channels" in names:
            optional: dict[str, Any] = {name: load(name) for name in ("covariances", "times") if name in names}
            if "channel_names" in names:
                optional["channel_names"] = load("channel_names").astype(str).tolist()
            return PointCloud(points, load("channels"), **optional)
        columns = dict(zip("xyz", points.T, strict=True))
        columns |= {name: load(name).ravel() for name in names if name.lower() in INTENSITIES}
        for name in [name for name in names if name.lower() in _RGB_ARRAYS]:
            columns |= dict(zip(COLORS, load(name)[:, :3].T, strict=True))
        return cloud_of(columns)


def write_npz(file: BinaryIO, cloud: PointCloud) -> None:
    names = np.array(cloud.channel_names, str)
    optional: dict[str, Any] = {"covariances": cloud.covariances, "times": cloud.times}
    optional = {name: array for name, array in optional.items() if array is not None}
    np.savez(file, points=cloud.points, channels=cloud.channels, channel_names=names, **optional)
