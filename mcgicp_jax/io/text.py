"""Text files with a row of numbers per point, with or without names of the columns."""

from __future__ import annotations

import io
import itertools
import re
from typing import BinaryIO

import numpy as np

from mcgicp_jax._clouds.columns import COLORS, channel_name
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax.io.files import cloud_of, column_name, columns_of
from mcgicp_jax.io.poses import are_poses

# Number of lines from which poses are recognised: so many points are not in order of their first coordinate with unit
# normals by chance.
_MOST_LINES = 1000


def read_text(file: BinaryIO, size: int) -> PointCloud:
    with io.TextIOWrapper(file, "utf-8-sig") as text:
        names, line, cells = _text_start(text)
        delimiter = next((mark for mark in ",;" if mark in line), None)
        table = np.loadtxt(itertools.chain([line], text), delimiter=delimiter, ndmin=2)
    names = names or ["x", "y", "z", *(f"channel_{i}" for i in range(table.shape[1] - 3))]
    columns = dict(zip(names, table.T, strict=True))
    whole = [name for name, cell in zip(names, cells, strict=True) if cell.isdigit()]
    colours = [name for name in whole if channel_name(name) in COLORS]
    values = np.array([columns[name] for name in colours])
    if colours and ((values == np.rint(values)) & (values >= 0) & (values <= 65535)).all():
        integers = values.astype(np.uint8 if values.max() < 256 else np.uint16)
        columns |= dict(zip(colours, integers, strict=True))
    return cloud_of(columns)


def is_text_cloud(file: BinaryIO) -> bool:
    """Whether the first lines are rows of coordinates, and not of poses, a log or another table."""
    with io.TextIOWrapper(file, "utf-8-sig") as text:
        try:
            names, line, cells = _text_start(text)
        except ValueError:
            return False
        return len(cells) >= 3 and (bool(names) or not are_poses([line, *itertools.islice(text, _MOST_LINES)]))


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


def write_text(file: BinaryIO, cloud: PointCloud, delimiter: str, mark: str) -> None:
    columns_of(cloud)
    names = ["x", "y", "z", *map(column_name, cloud.channel_names)]
    # "%s" prints the shortest number that is exact in its own dtype, so all values are converted to float64 first.
    table = np.column_stack([cloud.points, cloud.channels]).astype(np.float64)
    np.savetxt(file, table, fmt="%s", delimiter=delimiter, header=delimiter.join(names), comments=mark)
