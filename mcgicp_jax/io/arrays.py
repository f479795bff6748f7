"""Arrays without named columns of their own: KITTI scans, .npy and .npz."""

from __future__ import annotations

import math
import zipfile
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float, Shaped
from numpy.lib import format as npy

from mcgicp_jax._clouds.columns import COLORS, INTENSITIES
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax.io.bin_layouts import columns_of_floats
from mcgicp_jax.io.files import check_size, cloud_of

# Metres: float32 resolves 8 mm at this distance; larger coordinates are not written, nor accepted as a KITTI scan.
_KITTI_LIMIT = 1e5
# Bound on the compression ratio of deflate.
DEFLATE_RATIO = 1032
_RGB_ARRAYS = ("rgb", "color", "colors", "colour", "colours")


def read_kitti(file: BinaryIO, size: int, columns: int | None = None) -> PointCloud:
    data = file.read()
    if size % 4:
        raise ValueError(f"expected rows of float32 values, got {size} bytes")
    # The format has no signature. Text is recognised by its bytes, most other files by implausibly large coordinates.
    if data.isascii() and b"\0" not in data:
        raise ValueError("it does not hold float32 coordinates in metres")
    cloud = cloud_of(columns_of_floats(np.frombuffer(data, "<f4").astype(np.float32), columns))
    if _beyond_kitti(np.asarray(cloud.points)):
        raise ValueError("it does not hold float32 coordinates in metres")
    return cloud


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
