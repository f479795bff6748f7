"""Named columns of numbers, as of files and structured arrays, and the channels that they become."""

from __future__ import annotations

import re
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Shaped

Columns: TypeAlias = dict[str, Shaped[np.ndarray, "N"]]

COLORS = ("red", "green", "blue")
ORDER = {name: place for place, name in enumerate(("intensity", *COLORS))}
INTENSITIES = ("intensity", "intensities", "i", "reflectance", "reflectivity", "remission")
_ALIASES = dict.fromkeys(INTENSITIES, "intensity") | {
    alias: colour for colour in COLORS for alias in (colour, colour[0], f"diffuse_{colour}")
}
_NOT_CHANNELS = re.compile(
    "[xyz_]|rgba?|a|(diffuse_)?alpha|n[xyz]|normal_[xyz]|curvature|vp_[xyz]|label|class|classification|object|instance|"
    "id|index|ring|line|tag|row|column|range|t|time|timestamp|gps_time|offset_time"
)


def channel_name(column: str) -> str | None:
    """The name of the channel that a column holds; None if the column is not a channel."""
    bare = column.removeprefix("channel_")
    if bare != column and channel_name(bare) != bare:
        return bare
    known = column.lower().removeprefix("scalar_")
    return None if _NOT_CHANNELS.fullmatch(known) else _ALIASES.get(known, column)


def arrays_of_columns(columns: Columns) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N C"], list[str]]:
    """Points, channels and their names, from columns that include x, y and z."""
    columns = {column: values for column, values in columns.items() if values.dtype.kind in "fiu"}
    axes = {column.lower(): values for column, values in columns.items() if column.lower() in ("x", "y", "z")}
    if len(axes) < 3:
        raise ValueError(f"it has no numeric columns x, y, z; found {', '.join(columns) or 'no numeric columns'}")
    points = np.column_stack([axes[axis] for axis in "xyz"])
    points = points if points.dtype.kind == "f" else points.astype(np.float64)
    channels: dict[str, np.ndarray] = {}
    # Exact names before aliases: if a file has intensity and reflectivity, the former becomes "intensity".
    for column in sorted(columns, key=lambda column: column not in ORDER and channel_name(column) in ORDER):
        name = channel_name(column)
        if name is not None:
            channels[column if name in channels else name] = _channel(name, columns[column], points.dtype)
    names = sorted(channels, key=lambda name: ORDER.get(name, len(ORDER)))
    values = np.column_stack([channels[name] for name in names]) if names else np.zeros((len(points), 0), points.dtype)
    return points, values, names


def _channel(name: str, values: Shaped[np.ndarray, "N"], dtype: np.dtype) -> Float[np.ndarray, "N"]:
    """Convert to floating point without loss of precision; integer colours are scaled to 0..1."""
    if values.dtype.kind == "f":
        return values
    scale = 1 if name not in COLORS else 65535 if values.dtype.itemsize == 2 else 255
    return values.astype(np.result_type(values.dtype, dtype)) / scale


def with_unpacked_colors(columns: Columns) -> Columns:
    """The columns with `rgb`, or else `rgba`, split into colours where the bits of four bytes hold them, as in PCL."""
    for packed in columns.keys() & {"rgb"} or columns.keys() & {"rgba"}:
        if columns[packed].dtype.itemsize == 4:
            bits = np.ascontiguousarray(columns[packed]).view(np.uint32)
            colors = {name: (bits >> shift).astype(np.uint8) for name, shift in zip(COLORS, (16, 8, 0), strict=True)}
            columns = {name: values for name, values in columns.items() if name != packed} | colors
    return columns
