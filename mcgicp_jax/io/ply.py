"""PLY files, by plyfile."""

from __future__ import annotations

import codecs
import io
import re
from typing import Any, BinaryIO

import numpy as np

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.messages import optional_module
from mcgicp_jax.io.files import check_size, cloud_of, columns_of

# Bytes searched for the end of a PLY header, far more than the header of a cloud needs.
_PLY_HEADER_BYTES = 2**20


def read_ply(file: BinaryIO, size: int) -> PointCloud:
    plyfile = optional_module("plyfile", "io", "reading .ply files")
    start = file.read(_PLY_HEADER_BYTES)
    end = re.search(rb"(?:^|[\r\n])end_header[ \t]*(?:\r\n|\r|\n)", start)
    if end is None:
        raise ValueError("no PLY header")
    head, rest = start[: end.end()], start[end.end() :]
    header, plain = head, head.isascii() and head.count(b"end_header") == 1
    if not plain:
        # plyfile reads neither comments in other encodings nor a byte order mark.
        lines = head.removeprefix(codecs.BOM_UTF8).splitlines(keepends=True)
        header = b"".join(line for line in lines if line.split()[:1] not in ([b"comment"], [b"obj_info"]))
    text = header.decode("ascii").replace("\r\n", "\n").replace("\r", "\n")
    # plyfile allocates what the header claims, so the header is first parsed alone, with all counts set to 0.
    declaration = re.compile(r"^(\s*element\s+\S+\s+)(\S+)", re.MULTILINE)
    counts = [int(count) for _, count in declaration.findall(text)]
    layout = plyfile.PlyData.read(io.BytesIO(declaration.sub(r"\g<1>0", text).encode()))
    # The smallest size: lists are empty; in text, a number takes one digit and one separator.
    num_bytes = 0
    for count, element in zip(counts, layout, strict=True):
        dtypes = ["S2" if layout.text else getattr(prop, "len_dtype", prop.val_dtype) for prop in element.properties]
        num_bytes += count * sum(np.dtype(dtype).itemsize for dtype in dtypes)
    check_size(num_bytes, size - len(head))
    if "vertex" not in layout:
        raise ValueError("it has no vertices")
    file.seek(0)
    body = file if plain else io.BytesIO(header + rest + file.read()[len(start) :])
    with io.TextIOWrapper(body, "ascii") if layout.text else body as stream:
        vertex: Any = np.array(plyfile.PlyData.read(stream)["vertex"].data)  # copied, since plyfile maps the file
    return cloud_of({name: vertex[name] for name in vertex.dtype.names})


def write_ply(file: BinaryIO, cloud: PointCloud) -> None:
    plyfile = optional_module("plyfile", "io", "writing .ply files")
    columns = columns_of(cloud)
    rows = np.rec.fromarrays(list(columns.values()), [(name, values.dtype) for name, values in columns.items()])
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order="<").write(file)
