"""LAS and LAZ files, by laspy and lazrs."""

from __future__ import annotations

import struct
from typing import Any, BinaryIO

import numpy as np

from mcgicp_jax._clouds.columns import COLORS, ORDER
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.messages import optional_module
from mcgicp_jax.io.files import check_size, cloud_of

# Points per chunk: bounds the memory that laspy needs beyond the columns that are kept.
_LAS_ROWS_AT_ONCE = 100_000
# Number of LASzip layers per point format, each stored with its length; formats below 6 have no layers.
_LAZ_LAYERS = {6: 9, 7: 10, 8: 11, 9: 10, 10: 12}


def read_las(file: BinaryIO, size: int) -> PointCloud:
    laspy = optional_module("laspy", "io", "reading .las and .laz files")
    head = file.read(104)
    if len(head) < 104 or head[:4] != b"LASF":
        raise ValueError("no LAS header")
    start, records = struct.unpack_from("<II", head, 96)
    # laspy reads as many variable-length records as the header claims, at least 54 bytes each, even past the end.
    check_size(max(start, 54 * records), size)
    file.seek(0)
    with laspy.open(file, closefd=False, read_evlrs=False, laz_backend=laspy.LazBackend.Lazrs) as reader:
        header = reader.header
        if header.are_points_compressed:
            _check_laz(file, header, size)
        else:
            check_size(start + header.point_count * header.point_format.size, size)
        names = {"X", "Y", "Z", "intensity", "gps_time", *COLORS} & set(header.point_format.dimension_names)
        chunks = [{name: np.array(chunk[name]) for name in names} for chunk in reader.chunk_iterator(_LAS_ROWS_AT_ONCE)]
    if not chunks:
        raise ValueError("it has no points")
    columns = {name: np.concatenate([chunk[name] for chunk in chunks]) for name in names}
    with np.errstate(over="raise"):
        for axis, scale, offset in zip("XYZ", header.scales, header.offsets, strict=True):
            columns[axis] = columns[axis] * scale + offset
    # Where the format has fields that were not measured, they are 0 everywhere.
    for group in (("intensity",), COLORS):
        if not any(columns[name].any() for name in group if name in columns):
            columns = {name: values for name, values in columns.items() if name not in group}
    if "red" in columns and max(columns[name].max() for name in COLORS) < 256:
        columns |= {name: columns[name].astype(np.uint8) for name in COLORS}
    return cloud_of(columns)


def _check_laz(file: BinaryIO, header: Any, size: int) -> None:
    """Check the chunk table: lazrs allocates the sizes claimed there and aborts the process if it cannot."""
    lazrs = optional_module("lazrs", "io", "reading .laz files")
    item_bytes = lazrs.LazVlr(header.vlrs.get("LasZipVlr")[0].record_data).item_size()
    start, row_bytes = header.offset_to_point_data, header.point_format.size
    if item_bytes != row_bytes:
        raise ValueError(f"the LAS header claims {row_bytes} bytes per point, the LASzip record {item_bytes}")
    file.seek(start)
    (table,) = struct.unpack("<q", file.read(8))
    if table == -1:  # written to a stream: the offset of the table is at the end of the file
        file.seek(size - 8)
        (table,) = struct.unpack("<q", file.read(8))
    file.seek(table)
    _, num_chunks = struct.unpack("<II", file.read(8))
    check_size(num_chunks * row_bytes, size)
    if layers := _LAZ_LAYERS.get(header.point_format.id):
        layers += header.point_format.num_extra_bytes
        end, num_points = start + 8, 0
        for _ in range(num_chunks):
            file.seek(end + row_bytes)
            count, *lengths = struct.unpack(f"<{1 + layers}I", file.read(4 + 4 * layers))
            num_points += count
            end = file.tell() + sum(lengths)
            check_size(end, size)
        if num_points != header.point_count:
            raise ValueError(f"the header claims {header.point_count} points, the file has {num_points}")
    file.seek(start)


def write_las(file: BinaryIO, cloud: PointCloud, compress: bool) -> None:
    use = f"writing {'.laz' if compress else '.las'} files"
    laspy = optional_module("laspy", "io", use)
    if compress:
        optional_module("lazrs", "io", use)
    names = set(cloud.channel_names)
    if len(names) < len(cloud.channel_names) or names not in (set(), {"intensity"}, set(COLORS), set(ORDER)):
        raise ValueError(
            f"channel_names: LAS holds intensity and red, green, blue, got {cloud.channel_names}; .ply holds others"
        )
    if not np.isfinite(cloud.points).all():
        raise ValueError("points: LAS holds only finite coordinates; .ply also holds NaN and infinity")
    points = cloud.points.astype(np.float64)
    header = laspy.LasHeader(version="1.2", point_format=2 if "red" in names else 0)
    header.offsets = np.floor(points.min(axis=0))
    extent = np.maximum(points.max(axis=0) - header.offsets, 1)
    header.scales = 10.0 ** np.ceil(np.log10(extent / (2**31 - 1)))
    las = laspy.LasData(header)
    las.xyz = points
    for name, values in zip(cloud.channel_names, cloud.channels.T, strict=True):
        # Means of whole intensities are rounded; intensities from 0 to 1 would be lost.
        scaled = np.rint(values if name == "intensity" else values.astype(np.float64) * 65535)
        lost = name == "intensity" and values.max(initial=0) <= 1 and (scaled != values).any()
        if lost or not ((scaled >= 0) & (scaled <= 65535)).all():
            unit = "whole numbers from 0 to 65535" if name == "intensity" else "colours from 0 to 1"
            raise ValueError(f"channels: LAS holds {name} as {unit}; .ply holds any number")
        las[name] = scaled.astype(np.uint16)
    if "red" in names and 0 < max(las[name].max() for name in COLORS) < 256:
        raise ValueError("channels: colours this dark would be read as 8-bit values from LAS; .ply holds them")
    las.write(file, do_compress=compress, laz_backend=laspy.LazBackend.Lazrs)
