"""Text files with a row of numbers per point, with or without names of the columns."""

from __future__ import annotations

import io
import itertools
import re
from typing import BinaryIO

import numpy as np

from mcgicp_jax._clouds.columns import COLORS, channel_name
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax.io.files import cloud_of, columns_of, plain_numbers
from mcgicp_jax.io.poses import are_poses

# Number of lines from which poses are recognised: so many points are not in order of their first coordinate with unit
# normals by chance.
_MOST_LINES = 1000


def read_text(file: BinaryIO, size: int) -> PointCloud:
    with _as_text(file) as text:
        names, first, line, cells = _text_start(text)
        lines = plain_numbers(line + text.read())
    mark = _delimiter(line)
    if mark is not None:
        lines = re.sub(rf"^[ \t]*(?={mark})|(?<={mark})[ \t]*(?={mark}|$)", "nan", lines, flags=re.MULTILINE)
    try:
        table = np.loadtxt(lines.splitlines(), delimiter=mark, ndmin=2)
    except ValueError as error:
        # Its row number is not that of the line in the file.
        for number, row in enumerate(lines.splitlines(), first):
            plain = row.partition("#")[0].strip()
            try:
                count = len([float(cell) for cell in plain.split(mark)])
            except ValueError:
                count = 0
            if plain and count != len(cells):
                raise ValueError(f"line {number}: expected {len(cells)} numbers, got {row.strip()[:60]!r}") from error
        raise
    if not names and table.shape[1] < 3:
        raise ValueError(f"expected at least three columns, x, y and z, got {table.shape[1]}")
    names = names or ["x", "y", "z", *(f"channel_{i}" for i in range(table.shape[1] - 3))]
    columns = dict(zip(names, table.T, strict=True))
    colours = [name for name, cell in zip(names, cells, strict=True) if cell.isdigit() and channel_name(name) in COLORS]
    values = np.array([columns[name] for name in colours])
    if colours and ((values == np.rint(values)) & (values >= 0) & (values <= 65535)).all():
        integers = values.astype(np.uint8 if values.max() < 256 else np.uint16)
        columns |= dict(zip(colours, integers, strict=True))
    return cloud_of(columns)


def _as_text(file: BinaryIO) -> io.TextIOWrapper:
    """Comments may have any encoding. UTF-16, as PowerShell writes it, has a mark."""
    marked = file.read(2) in (b"\xff\xfe", b"\xfe\xff")
    file.seek(0)
    return io.TextIOWrapper(file, "utf-16" if marked else "utf-8-sig", errors="replace")


def _delimiter(line: str) -> str | None:
    return next((mark for mark in ",;" if mark in line), None)


def is_text_cloud(file: BinaryIO) -> bool:
    """Whether the first lines are rows of coordinates, and not of poses, a log or another table."""
    with _as_text(file) as text:
        try:
            names, _, line, cells = _text_start(text)
        except ValueError:
            return False
        return len(cells) >= 3 and (bool(names) or not are_poses([line, *itertools.islice(text, _MOST_LINES)]))


def _text_start(text: io.TextIOWrapper) -> tuple[list[str], int, str, list[str]]:
    """The column names, if their number is that of the columns; number, text and cells of the first line of numbers.

    A comment may have names after a colon. Units in brackets are no part of a name. A name that is missing, first, is
    that of the index of pandas or R. A first line with one number is that of the points.
    """
    names: list[str] = []
    commented = counted = False
    for number, line in enumerate(text, 1):
        comment = line.startswith(("#", "//"))
        plain = plain_numbers(line).strip("#/ \t\r\n" if comment else " \t\r\n")
        cells = [cell.strip() for cell in plain.split(_delimiter(plain))]
        try:
            numbers = [float(cell or "nan") for cell in cells]
        except ValueError:
            numbers = []
        if numbers and any(cells) and not comment:
            if len(cells) == 1 and cells[0].isdigit() and not counted:
                counted = True
                continue
            if len(names) == len(cells) - 1 and not commented and names:
                names = ["index", *names]
            if len(names) != len(cells) and names and not commented:
                raise ValueError(f"it names {len(names)} columns, and its rows have {len(cells)}")
            return names if len(names) == len(cells) else [], number, line, cells
        if comment:
            cells = cells[1 + max((i for i, cell in enumerate(cells) if cell.endswith(":")), default=-1) :]
        else:
            cells = [re.sub(r"\s*[\[(].*[\])]$", "", cell) for cell in cells]
        if {"x", "y", "z"} <= {cell.lower() for cell in cells}:
            names, commented = [cell or "index" for cell in cells], comment
        elif not comment and any(cells):
            raise ValueError(f"expected numbers or column names with x, y, z, got {line.strip()[:60]!r}")
    raise ValueError("it has no row of numbers")


def write_text(file: BinaryIO, cloud: PointCloud, delimiter: str, mark: str) -> None:
    times = [] if cloud.times is None else [np.asarray(cloud.times)]
    # "%s" prints the shortest number that is exact in its own dtype, so all values are converted to float64 first.
    table = np.column_stack([cloud.points, cloud.channels, *times]).astype(np.float64)
    np.savetxt(file, table, fmt="%s", delimiter=delimiter, header=delimiter.join(columns_of(cloud)), comments=mark)
