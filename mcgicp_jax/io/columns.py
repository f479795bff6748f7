"""Names of the columns of a file, and the channels that they become."""

from __future__ import annotations

import re
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Shaped

from mcgicp_jax._clouds.point_cloud import PointCloud

Columns: TypeAlias = dict[str, Shaped[np.ndarray, "N"]]

COLORS = ("red", "green", "blue")
ORDER = {name: place for place, name in enumerate(("intensity", *COLORS))}
INTENSITIES = ("intensity", "intensities", "i", "reflectance", "reflectivity", "remission")
_ALIASES = dict.fromkeys(INTENSITIES, "intensity") | {
    alias: colour for colour in COLORS for alias in (colour, colour[0], f"diffuse_{colour}")
}
_RGB_ARRAYS = ("rgb", "color", "colors", "colour", "colours")
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


def cloud_of(columns: Columns) -> PointCloud:
    """Build a cloud from the named columns of a file, which must include x, y and z."""
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
    return PointCloud(points, np.column_stack([channels[n] for n in names]) if names else None, channel_names=names)


def _channel(name: str, values: Shaped[np.ndarray, "N"], dtype: np.dtype) -> Float[np.ndarray, "N"]:
    """Convert to floating point without loss of precision; integer colours are scaled to 0..1."""
    if values.dtype.kind == "f":
        return values
    scale = 1 if name not in COLORS else 65535 if values.dtype.itemsize == 2 else 255
    return values.astype(np.result_type(values.dtype, dtype)) / scale


def columns_of(cloud: PointCloud) -> Columns:
    """The named columns to write for a cloud; colours as uint8 if that is lossless."""
    names = cloud.channel_names
    for name in names:
        if not re.fullmatch(r"[A-Za-z0-9_.\-]+", name) or names.count(name) > 1:
            raise ValueError(
                f"channel_names: expected unique names of letters, digits, _ . -, got {name!r}; .npz can hold it"
            )
    columns = dict(zip("xyz", cloud.points.T, strict=True))
    columns |= {column_name(name): values for name, values in zip(names, cloud.channels.T, strict=True)}
    colours = {name: columns[name] for name in COLORS if name in columns}
    whole = {name: np.rint(np.clip(values, 0, 1) * 255) for name, values in colours.items()}
    if all(np.array_equal(whole[name].astype(cloud.points.dtype) / 255, colours[name]) for name in colours):
        columns |= {name: values.astype(np.uint8) for name, values in whole.items()}
    return columns


def column_name(channel: str) -> str:
    return channel if channel_name(channel) == channel else f"channel_{channel}"
