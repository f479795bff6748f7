"""Shared by readers and writers: columns, checks, reasons of errors, files that replace others."""

from __future__ import annotations

import contextlib
import os
import re
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, TextIO

import numpy as np

from mcgicp_jax._clouds.columns import COLORS, Columns, arrays_of_columns, channel_name, times_of
from mcgicp_jax._clouds.point_cloud import PointCloud

# Missing numbers as Windows, R and databases write them.
_NO_NUMBER = re.compile(r"[+-]?(?:nan\([^)\s]*\)|1\.#(?:QNAN|SNAN|IND)\d*|\bNA\b|\bNULL\b)", re.IGNORECASE)


def plain_numbers(text: str) -> str:
    """Text without quotes, and with missing numbers as NaN."""
    return _NO_NUMBER.sub("nan", text.replace('"', ""))


def check_size(claimed: int, size: int) -> None:
    """Raise `ValueError` if a header claims more bytes than there are, before a library allocates them."""
    if claimed > size:
        raise ValueError(f"the header claims more than the file can hold ({claimed} bytes in {size})")


def reason_of(error: BaseException) -> str:
    return "it is not text" if isinstance(error, UnicodeError) else str(error) or type(error).__name__


@contextlib.contextmanager
def open_text(path: str | os.PathLike[str], kind: str) -> Iterator[TextIO]:
    """Open a text file of a kind, such as "poses"; a `ValueError` in the block gets the path and the kind."""
    with open(path, encoding="utf-8-sig") as file:
        try:
            yield file
        except ValueError as error:
            raise ValueError(f"{path}: cannot be read as {kind}: {reason_of(error)}") from error


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a temporary file that replaces `path` when the block succeeds."""
    path = Path(path)
    temporary = path.with_name(f".{uuid.uuid4().hex}.tmp")
    try:
        with open(temporary, "x+b") as file:
            yield file
        os.replace(temporary, path)
    except OSError as error:
        if error.filename != str(temporary):
            raise
        raise type(error)(error.errno, error.strerror, str(path)) from None
    finally:
        temporary.unlink(missing_ok=True)


def cloud_of(columns: Columns) -> PointCloud:
    """Build a cloud from the named columns of a file, which must include x, y and z."""
    points, channels, names = arrays_of_columns(columns)
    return PointCloud(points, channels, channel_names=names, times=times_of(columns))


def columns_of(cloud: PointCloud) -> Columns:
    """The named columns to write for a cloud; colours as uint8 if that is lossless."""
    names = cloud.channel_names
    for name in names:
        if not re.fullmatch(r"[A-Za-z0-9_.\-]+", name):
            raise ValueError(f"channel_names: expected letters, digits, _ . -, got {name!r}; .npz can hold it")
    columns = dict(zip("xyz", cloud.points.T, strict=True))
    for name, values in zip(names, cloud.channels.T, strict=True):
        # The prefix keeps names that readers would skip or change.
        columns[name if channel_name(name) == name else f"channel_{name}"] = values
    if cloud.times is not None:
        columns["time"] = np.asarray(cloud.times)
    colours = {name: columns[name] for name in COLORS if name in columns}
    whole = {name: np.rint(np.clip(values, 0, 1) * 255) for name, values in colours.items()}
    if all(np.array_equal(whole[name].astype(cloud.points.dtype) / 255, colours[name]) for name in colours):
        columns |= {name: values.astype(np.uint8) for name, values in whole.items()}
    return columns
