"""Readers and writers of the file formats of `mcgicp_jax.io`, based on one third-party library per format.

Headers of damaged files can claim arbitrary sizes. Each reader therefore compares the claimed size with that of the
file before a third-party library allocates memory.
"""

from __future__ import annotations

import functools
import importlib
import io
import itertools
import math
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np
from jaxtyping import Float, Shaped
from numpy.lib import format as npy

from mcgicp_jax._clouds.point_cloud import PointCloud

Columns: TypeAlias = dict[str, Shaped[np.ndarray, "N"]]

_COLOURS = ("red", "green", "blue")
_ORDER = {name: place for place, name in enumerate(("intensity", *_COLOURS))}
_INTENSITIES = ("intensity", "intensities", "i", "reflectance", "reflectivity", "remission")
_ALIASES = dict.fromkeys(_INTENSITIES, "intensity") | {
    alias: colour for colour in _COLOURS for alias in (colour, colour[0], f"diffuse_{colour}")
}
_RGB_ARRAYS = ("rgb", "color", "colors", "colour", "colours")
_NOT_CHANNELS = re.compile(
    "[xyz_]|rgba?|a|(diffuse_)?alpha|n[xyz]|normal_[xyz]|curvature|vp_[xyz]|label|class|classification|object|instance|"
    "id|index|ring|line|tag|row|column|range|t|time|timestamp|gps_time|offset_time"
)
# Metres: float32 resolves 8 mm at this distance; larger coordinates are not written, nor accepted as a KITTI scan.
_KITTI_LIMIT = 1e5
# Points per chunk: bounds the memory that laspy needs beyond the columns that are kept.
_LAS_ROWS_AT_ONCE = 100_000
# Number of LASzip layers per point format, each stored with its length; formats below 6 have no layers.
_LAZ_LAYERS = {6: 9, 7: 10, 8: 11, 9: 10, 10: 12}
# Bytes searched for the end of a PLY header, far more than the header of a cloud needs.
_PLY_HEADER_BYTES = 2**20
# Bounds on the compression ratios of the formats: three bytes of LZF expand to at most 264; deflate reaches 1032.
_LZF_RATIO, _DEFLATE_RATIO = 100, 1032


def _extra(module: str, use: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{use} files needs {module}: pip install 'mcgicp_jax[io]'") from error


def _check_room(claimed: int, size: int) -> None:
    if claimed > size:
        raise ValueError(f"the header claims more than the file can hold ({claimed} bytes in {size})")


def _channel_name(column: str) -> str | None:
    """The name of the channel that a column holds; None if the column is not a channel."""
    bare = column.removeprefix("channel_")
    if bare != column and _channel_name(bare) != bare:
        return bare
    known = column.lower().removeprefix("scalar_")
    return None if _NOT_CHANNELS.fullmatch(known) else _ALIASES.get(known, column)


def _cloud(columns: Columns) -> PointCloud:
    """Build a cloud from the named columns of a file, which must include x, y and z."""
    columns = {column: values for column, values in columns.items() if values.dtype.kind in "fiu"}
    axes = {column.lower(): values for column, values in columns.items() if column.lower() in ("x", "y", "z")}
    if len(axes) < 3:
        raise ValueError(f"it has no numeric columns x, y, z; found {', '.join(columns) or 'no numeric columns'}")
    points = np.column_stack([axes[axis] for axis in "xyz"])
    points = points if points.dtype.kind == "f" else points.astype(np.float64)
    channels: dict[str, np.ndarray] = {}
    # Exact names before aliases: if a file has intensity and reflectivity, the former becomes "intensity".
    for column in sorted(columns, key=lambda column: column not in _ORDER and _channel_name(column) in _ORDER):
        name = _channel_name(column)
        if name is not None:
            channels[column if name in channels else name] = _channel(name, columns[column], points.dtype)
    names = sorted(channels, key=lambda name: _ORDER.get(name, len(_ORDER)))
    return PointCloud(points, np.column_stack([channels[n] for n in names]) if names else None, channel_names=names)


def _channel(name: str, values: Shaped[np.ndarray, "N"], dtype: np.dtype) -> Float[np.ndarray, "N"]:
    """Convert to floating point without loss of precision; integer colours are scaled to 0..1."""
    if values.dtype.kind == "f":
        return values
    scale = 1 if name not in _COLOURS else 65535 if values.dtype.itemsize == 2 else 255
    return values.astype(np.result_type(values.dtype, dtype)) / scale


def _columns(cloud: PointCloud) -> Columns:
    """The named columns to write for a cloud; colours as uint8 if that is lossless."""
    names = cloud.channel_names
    for name in names:
        if not re.fullmatch(r"[A-Za-z0-9_.\-]+", name) or names.count(name) > 1:
            raise ValueError(
                f"channel_names: expected unique names of letters, digits, _ . -, got {name!r}; .npz can hold it"
            )
    columns = dict(zip("xyz", cloud.points.T, strict=True))
    columns |= {_column_name(name): values for name, values in zip(names, cloud.channels.T, strict=True)}
    colours = {name: columns[name] for name in _COLOURS if name in columns}
    whole = {name: np.rint(np.clip(values, 0, 1) * 255) for name, values in colours.items()}
    if all(np.array_equal(whole[name].astype(cloud.points.dtype) / 255, colours[name]) for name in colours):
        columns |= {name: values.astype(np.uint8) for name, values in whole.items()}
    return columns


def _column_name(channel: str) -> str:
    return channel if _channel_name(channel) == channel else f"channel_{channel}"


def _read_ply(file: BinaryIO, size: int) -> PointCloud:
    plyfile = _extra("plyfile", "reading .ply")
    head, end, _ = file.read(_PLY_HEADER_BYTES).partition(b"end_header")
    if not end:
        raise ValueError("no PLY header")
    text = (head + end).decode("ascii").replace("\r\n", "\n").replace("\r", "\n") + "\n"
    # plyfile allocates what the header claims, so the header is first parsed alone, with all counts set to 0.
    element = re.compile(r"^(\s*element\s+\S+\s+)(\S+)", re.MULTILINE)
    counts = [int(count) for _, count in element.findall(text)]
    layout = plyfile.PlyData.read(io.BytesIO(element.sub(r"\g<1>0", text).encode()))
    claimed = sum(count * _ply_row_bytes(part, layout.text) for count, part in zip(counts, layout, strict=True))
    _check_room(claimed, size - len(head))
    if "vertex" not in layout:
        raise ValueError("it has no vertices")
    file.seek(0)
    with io.TextIOWrapper(file, "ascii") if layout.text else file as stream:
        vertex: Any = np.array(plyfile.PlyData.read(stream)["vertex"].data)  # copied, since plyfile maps the file
    return _cloud({name: vertex[name] for name in vertex.dtype.names})


def _ply_row_bytes(element: Any, text: bool) -> int:
    """The smallest size of one row in bytes: empty lists; in text, one digit and one separator per number."""
    if text:
        return 2 * len(element.properties)
    return sum(np.dtype(getattr(prop, "len_dtype", prop.val_dtype)).itemsize for prop in element.properties)


def _write_ply(file: BinaryIO, cloud: PointCloud) -> None:
    plyfile = _extra("plyfile", "writing .ply")
    columns = _columns(cloud)
    rows = np.empty(len(cloud), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order="<").write(file)


def _read_pcd(file: BinaryIO, size: int) -> PointCloud:
    pypcd4 = _extra("pypcd4", "reading .pcd")
    metadata = pypcd4.MetaData.parse_header(_pcd_header(file))
    if metadata.points == 0:
        raise ValueError("it has no points")
    widths = [width * count for width, count in zip(metadata.size, metadata.count, strict=True)]
    if metadata.data == pypcd4.Encoding.ASCII:
        _check_room(2 * metadata.points * sum(metadata.count), size + 1)
        # pypcd4's own ASCII reader accepts only single spaces between numbers.
        rows = np.loadtxt(file, metadata.build_dtype(), ndmin=1)
    else:
        if metadata.data == pypcd4.Encoding.BINARY:
            _check_room(metadata.points * sum(widths), size - file.tell())
        else:
            _check_lzf(file, metadata.points * sum(widths), size)
        file.seek(0)
        rows = pypcd4.PointCloud.from_fileobj(file).pc_data
    if len(rows) != metadata.points:
        raise ValueError(f"the header claims {metadata.points} points, the file has {len(rows)}")
    # pypcd4 names padding fields "#" plus a random suffix, and renames fields with several values per point.
    names = [name for name in metadata.fields if name in rows.dtype.names and not name.startswith("#")]
    columns = {name: rows[name] for name in names}
    for packed in columns.keys() & {"rgb"} or columns.keys() & {"rgba"}:
        colours = pypcd4.PointCloud.decode_rgb(columns.pop(packed))
        columns |= dict(zip(_COLOURS, colours.T, strict=True))
    return _cloud(columns)


def _pcd_header(file: BinaryIO) -> list[str]:
    """The header lines in the form that pypcd4 parses: at most ten, without comments."""
    lines: list[str] = []
    while len(lines) < 10 and not (lines and lines[-1].startswith("DATA")):
        line = file.readline()
        if not line:
            raise ValueError("no complete PCD header")
        lines += [text for text in [line.decode().strip()] if text and not text.startswith("#")]
    return lines


def _check_lzf(file: BinaryIO, claimed: int, size: int) -> None:
    """Check the two lengths at the start of a compressed block; pypcd4 allocates the second without a check."""
    compressed, raw = struct.unpack("<II", file.read(8))
    _check_room(compressed, size - file.tell())
    _check_room(raw, _LZF_RATIO * compressed)
    if raw != claimed:
        raise ValueError(f"the header claims {claimed} bytes of points, the compressed data {raw}")


def _write_pcd(file: BinaryIO, cloud: PointCloud) -> None:
    pypcd4 = _extra("pypcd4", "writing .pcd")
    columns = _columns(cloud)
    if all(name in columns and columns[name].dtype == np.uint8 for name in _COLOURS):
        colours = np.column_stack([columns.pop(name) for name in _COLOURS])
        columns["rgb"] = pypcd4.PointCloud.encode_rgb(colours)
    values = list(columns.values())
    pcd = pypcd4.PointCloud.from_points(values, list(columns), [column.dtype for column in values])
    pcd.save(file, pypcd4.Encoding.BINARY)


def _read_las(file: BinaryIO, size: int) -> PointCloud:
    laspy = _extra("laspy", "reading .las and .laz")
    head = file.read(104)
    if len(head) < 104 or head[:4] != b"LASF":
        raise ValueError("no LAS header")
    start, records = struct.unpack_from("<II", head, 96)
    # laspy reads as many variable-length records as the header claims, at least 54 bytes each, even past the end.
    _check_room(max(start, 54 * records), size)
    file.seek(0)
    with laspy.open(file, closefd=False, read_evlrs=False, laz_backend=laspy.LazBackend.Lazrs) as reader:
        header = reader.header
        if header.are_points_compressed:
            _check_laz(file, header, size)
        else:
            _check_room(start + header.point_count * header.point_format.size, size)
        names = {"X", "Y", "Z", "intensity", *_COLOURS} & set(header.point_format.dimension_names)
        chunks = [{name: np.array(chunk[name]) for name in names} for chunk in reader.chunk_iterator(_LAS_ROWS_AT_ONCE)]
    if not chunks:
        raise ValueError("it has no points")
    columns = {name: np.concatenate([chunk[name] for chunk in chunks]) for name in names}
    with np.errstate(over="raise"):
        for axis, scale, offset in zip("XYZ", header.scales, header.offsets, strict=True):
            columns[axis] = columns[axis] * scale + offset
    if not columns["intensity"].any():
        del columns["intensity"]
    if "red" in columns and max(columns[name].max() for name in _COLOURS) < 256:
        columns |= {name: columns[name].astype(np.uint8) for name in _COLOURS}
    return _cloud(columns)


def _check_laz(file: BinaryIO, header: Any, size: int) -> None:
    """Check the chunk table: lazrs allocates the sizes claimed there and aborts the process if it cannot."""
    lazrs = _extra("lazrs", "reading .laz")
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
    _check_room(num_chunks * row_bytes, size)
    if layers := _LAZ_LAYERS.get(header.point_format.id):
        layers += header.point_format.num_extra_bytes
        end, num_points = start + 8, 0
        for _ in range(num_chunks):
            file.seek(end + row_bytes)
            count, *lengths = struct.unpack(f"<{1 + layers}I", file.read(4 + 4 * layers))
            num_points += count
            end = file.tell() + sum(lengths)
            _check_room(end, size)
        if num_points != header.point_count:
            raise ValueError(f"the header claims {header.point_count} points, the file has {num_points}")
    file.seek(start)


def _write_las(file: BinaryIO, cloud: PointCloud, compress: bool) -> None:
    use = "writing .laz" if compress else "writing .las"
    laspy = _extra("laspy", use)
    if compress:
        _extra("lazrs", use)
    names = set(cloud.channel_names)
    if len(names) < len(cloud.channel_names) or names not in (set(), {"intensity"}, set(_COLOURS), set(_ORDER)):
        raise ValueError(
            f"channel_names: LAS holds intensity and red, green, blue, got {cloud.channel_names}; .ply holds others"
        )
    if not np.isfinite(cloud.points).all():
        raise ValueError("points: LAS holds only finite coordinates; .ply also holds NaN and infinity")
    points = cloud.points.astype(np.float64)
    columns = dict(zip(cloud.channel_names, cloud.channels.T, strict=True))
    header = laspy.LasHeader(version="1.2", point_format=2 if "red" in names else 0)
    header.offsets = np.floor(points.min(axis=0))
    extent = np.maximum(points.max(axis=0) - header.offsets, 1)
    header.scales = 10.0 ** np.ceil(np.log10(extent / (2**31 - 1)))
    las = laspy.LasData(header)
    las.xyz = points
    for name, values in columns.items():
        las[name] = _las_integers(name, values)
    if "red" in names and 0 < max(las[name].max() for name in _COLOURS) < 256:
        raise ValueError("channels: colours this dark would be read as 8-bit values from LAS; .ply holds them")
    las.write(file, do_compress=compress, laz_backend=laspy.LazBackend.Lazrs)


def _las_integers(name: str, values: Float[np.ndarray, "N"]) -> Shaped[np.ndarray, "N"]:
    scaled = values if name == "intensity" else np.rint(values.astype(np.float64) * 65535)
    if not ((scaled >= 0) & (scaled <= 65535) & (scaled == np.rint(scaled))).all():
        unit = "whole numbers from 0 to 65535" if name == "intensity" else "colours from 0 to 1"
        raise ValueError(f"channels: LAS holds {name} as {unit}; .ply holds any number")
    return scaled.astype(np.uint16)


def _read_kitti(file: BinaryIO, size: int) -> PointCloud:
    data = file.read()
    if size % 16:
        raise ValueError(f"expected rows of four float32 values, got {size} bytes")
    rows = np.frombuffer(data, "<f4").reshape(-1, 4)
    # The format has no signature. Text is recognised by its bytes, most other files by implausibly large coordinates.
    if (data.isascii() and b"\0" not in data) or _beyond_kitti(rows[:, :3]):
        raise ValueError("it does not hold float32 coordinates in metres")
    rows = rows.astype(np.float32)
    return PointCloud(rows[:, :3], rows[:, 3], channel_names=["intensity"])


def _beyond_kitti(points: Float[np.ndarray, "N 3"]) -> bool:
    return bool((np.abs(points[np.isfinite(points)]) > _KITTI_LIMIT).any())


def _write_kitti(file: BinaryIO, cloud: PointCloud) -> None:
    if cloud.channels.shape[1] != 1:
        raise ValueError(f"channels: .bin holds exactly one, got {cloud.channel_names}; .ply holds any number")
    if _beyond_kitti(np.asarray(cloud.points)):
        raise ValueError(f"points: .bin holds float32, too coarse beyond {_KITTI_LIMIT:.0f} m; .ply holds float64")
    file.write(np.column_stack([cloud.points, cloud.channels]).astype("<f4").tobytes())


def _read_npy(file: BinaryIO, size: int) -> PointCloud:
    array = _read_array(file, size)
    if array.ndim != 2 or array.shape[1] < 3:
        raise ValueError(f"expected an array of shape (N, 3 + C), got {array.shape}")
    return PointCloud(array[:, :3], array[:, 3:])


def _read_array(file: Any, size: int) -> Shaped[np.ndarray, "..."]:
    headers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    shape, _, dtype = headers[npy.read_magic(file)](file)
    _check_room(math.prod(shape) * dtype.itemsize, size)
    file.seek(0)
    return npy.read_array(file, allow_pickle=False)


def _write_npy(file: BinaryIO, cloud: PointCloud) -> None:
    np.save(file, np.column_stack([cloud.points, cloud.channels]), allow_pickle=False)


def _read_npz(file: BinaryIO, size: int) -> PointCloud:
    with zipfile.ZipFile(file) as archive:

        def load(name: str) -> Shaped[np.ndarray, "..."]:
            entry = archive.getinfo(f"{name}.npy")
            with archive.open(entry) as stream:
                return _read_array(stream, min(entry.file_size, _DEFLATE_RATIO * size))

        names = [name.removesuffix(".npy") for name in archive.namelist()]
        if "points" not in names:
            raise ValueError(f"it has no array 'points'; found {', '.join(names)}")
        points = np.asarray(PointCloud(load("points")).points)
        if "channels" in names:
            return PointCloud(
                points,
                load("channels"),
                covariances=load("covariances") if "covariances" in names else None,
                channel_names=load("channel_names").astype(str).tolist() if "channel_names" in names else None,
            )
        columns = dict(zip("xyz", points.T, strict=True))
        columns |= {name: load(name).ravel() for name in names if name.lower() in _INTENSITIES}
        for name in [name for name in names if name.lower() in _RGB_ARRAYS]:
            columns |= dict(zip(_COLOURS, load(name)[:, :3].T, strict=True))
        return _cloud(columns)


def _write_npz(file: BinaryIO, cloud: PointCloud) -> None:
    arrays: dict[str, Any] = {
        "points": cloud.points,
        "channels": cloud.channels,
        "channel_names": np.array(cloud.channel_names, str),
    }
    if cloud.covariances is not None:
        arrays["covariances"] = cloud.covariances
    np.savez(file, **arrays)


def _read_text(file: BinaryIO, size: int) -> PointCloud:
    with io.TextIOWrapper(file, "utf-8-sig") as text:
        names, line, cells = _text_start(text)
        delimiter = next((mark for mark in ",;" if mark in line), None)
        table = np.loadtxt(itertools.chain([line], text), delimiter=delimiter, ndmin=2)
    names = names or ["x", "y", "z", *(f"channel_{i}" for i in range(table.shape[1] - 3))]
    columns = dict(zip(names, table.T, strict=True))
    whole = [name for name, cell in zip(names, cells, strict=True) if cell.isdigit()]
    colours = [name for name in whole if _channel_name(name) in _COLOURS]
    values = np.array([columns[name] for name in colours])
    if colours and ((values == np.rint(values)) & (values >= 0) & (values <= 65535)).all():
        integers = values.astype(np.uint8 if values.max() < 256 else np.uint16)
        columns |= dict(zip(colours, integers, strict=True))
    return _cloud(columns)


def _text_start(text: io.TextIOWrapper) -> tuple[list[str], str, list[str]]:
    """The column names, if given, the first line of numbers, and its cells."""
    names: list[str] = []
    for line in text:
        comment = line.startswith(("#", "//"))
        cells = re.split(r"[,;\s]+", line.strip("#/,; \t\r\n"))
        if not comment and all(map(_is_number, cells)):
            return names, line, cells
        if {"x", "y", "z"} <= {cell.lower() for cell in cells}:
            names = cells
        elif not comment and cells != [""]:
            raise ValueError(f"expected numbers or column names with x, y, z, got {line.strip()[:60]!r}")
    raise ValueError("it has no row of numbers")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _write_text(file: BinaryIO, cloud: PointCloud, delimiter: str, mark: str) -> None:
    _columns(cloud)
    names = ["x", "y", "z", *map(_column_name, cloud.channel_names)]
    # "%s" prints the shortest number that is exact in its own dtype, so all values are converted to float64 first.
    table = np.column_stack([cloud.points, cloud.channels]).astype(np.float64)
    np.savetxt(file, table, fmt="%s", delimiter=delimiter, header=delimiter.join(names), comments=mark)


def by_suffix(table: dict[str, Callable[..., Any]], path: Path) -> Callable[..., Any]:
    """The reader or writer for the suffix of a path; raises `ValueError` for an unknown suffix."""
    try:
        return table[path.suffix.lower()]
    except KeyError:
        raise ValueError(f"{path}: unknown suffix {path.suffix!r}; expected one of {', '.join(table)}") from None


READERS: dict[str, Callable[[BinaryIO, int], PointCloud]] = {
    ".ply": _read_ply,
    ".pcd": _read_pcd,
    ".las": _read_las,
    ".laz": _read_las,
    ".bin": _read_kitti,
    ".npy": _read_npy,
    ".npz": _read_npz,
    ".xyz": _read_text,
    ".txt": _read_text,
    ".csv": _read_text,
}
WRITERS: dict[str, Callable[[BinaryIO, PointCloud], None]] = {
    ".ply": _write_ply,
    ".pcd": _write_pcd,
    ".las": functools.partial(_write_las, compress=False),
    ".laz": functools.partial(_write_las, compress=True),
    ".bin": _write_kitti,
    ".npy": _write_npy,
    ".npz": _write_npz,
    ".xyz": functools.partial(_write_text, delimiter=" ", mark="# "),
    ".txt": functools.partial(_write_text, delimiter=" ", mark="# "),
    ".csv": functools.partial(_write_text, delimiter=",", mark=""),
}
