"""PCD files, by pypcd4."""

from __future__ import annotations

import io
import struct
from typing import BinaryIO

import numpy as np

from mcgicp_jax._clouds.columns import COLORS, with_unpacked_colors
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.messages import optional_module
from mcgicp_jax.io.files import check_size, cloud_of, columns_of, plain_numbers

# Bound on the compression ratio of LZF, whose blocks of three bytes expand to at most 264.
_LZF_RATIO = 100


def read_pcd(file: BinaryIO, size: int) -> PointCloud:
    pypcd4 = optional_module("pypcd4", "io", "reading .pcd files")
    header, start = _pcd_header(file), file.tell()
    try:
        metadata = pypcd4.MetaData.parse_header(header)
        columns = zip(metadata.fields, metadata.size, metadata.type, metadata.count, strict=True)
        widths = [count * np.dtype(f"{kind}{size}".lower()).itemsize for _, size, kind, count in columns]
    except (ValueError, TypeError) as error:
        # Those of pydantic have several lines.
        raise ValueError("its header is damaged") from error
    if metadata.points == 0:
        raise ValueError("it has no points")
    num_bytes = metadata.points * sum(widths)
    if metadata.data == pypcd4.Encoding.ASCII:
        check_size(2 * metadata.points * sum(metadata.count), size + 1)
        # pypcd4's own ASCII reader accepts only single spaces between numbers.
        text = plain_numbers(file.read().decode("ascii", errors="replace"))
        rows = np.loadtxt(text.splitlines(), metadata.build_dtype(), ndmin=1)
        for name in rows.dtype.names:
            if rows[name].dtype.kind == "f":
                # The bits of a colour that the text does not have.
                rows[name][np.isnan(rows[name])] = np.nan
    else:
        if metadata.data == pypcd4.Encoding.BINARY:
            check_size(num_bytes, size - file.tell())
        else:
            # pypcd4 allocates the second of the two lengths at the start of a compressed block without a check.
            compressed, raw = struct.unpack("<II", file.read(8))
            check_size(compressed, size - file.tell())
            check_size(raw, _LZF_RATIO * compressed)
            if raw != num_bytes:
                raise ValueError(f"the header claims {num_bytes} bytes of points, the compressed data {raw}")
        file.seek(start)
        # With a header of today's version.
        rows = pypcd4.PointCloud.from_fileobj(io.BytesIO(metadata.compose_header().encode() + file.read())).pc_data
    if len(rows) != metadata.points:
        raise ValueError(f"the header claims {metadata.points} points, the file has {len(rows)}")
    # pypcd4 names padding fields "#" plus a random suffix, and renames fields with several values per point.
    names = [name for name in metadata.fields if name in rows.dtype.names and not name.startswith("#")]
    return cloud_of(with_unpacked_colors({name: rows[name] for name in names}))


def _pcd_header(file: BinaryIO) -> list[str]:
    """The header lines in the form that pypcd4 parses: at most ten, without comments. Versions .5 and .6 differ from .7
    in what they may omit: the viewpoint and, in some files, the counts."""
    lines: list[str] = []
    while len(lines) < 10 and not (lines and lines[-1].startswith("DATA")):
        if not (line := file.readline()):
            raise ValueError("no complete PCD header")
        text = line.decode("utf-8-sig", "replace").strip()
        if text and not text.startswith("#"):
            lines.append(text)
    columns = {key: values for key, *values in map(str.split, lines) if not key.startswith("VERSION")}
    counts = columns.setdefault("COUNT", ["1"] * len(columns.get("FIELDS", [])))
    # Fields without values take no place in the rows.
    filled = [number for number, count in enumerate(counts) if count != "0"]
    for key in ("FIELDS", "SIZE", "TYPE", "COUNT"):
        if len(columns.get(key, [])) == len(counts):
            columns[key] = [columns[key][number] for number in filled]
    return [" ".join([key, *values]) for key, values in columns.items()]


def write_pcd(file: BinaryIO, cloud: PointCloud) -> None:
    pypcd4 = optional_module("pypcd4", "io", "writing .pcd files")
    columns = columns_of(cloud)
    if all(name in columns and columns[name].dtype == np.uint8 for name in COLORS):
        colours = np.column_stack([columns.pop(name) for name in COLORS])
        columns["rgb"] = pypcd4.PointCloud.encode_rgb(colours)
    values = list(columns.values())
    pcd = pypcd4.PointCloud.from_points(values, list(columns), [column.dtype for column in values])
    pcd.save(file, pypcd4.Encoding.BINARY)
