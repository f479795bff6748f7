"""Named columns of numbers, of files, structured arrays and clouds of other libraries, and the channels they become."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from typing import Any, TypeAlias

import jax
import numpy as np
from jaxtyping import Float, Shaped

Columns: TypeAlias = dict[str, Shaped[np.ndarray, "N"]]

COLORS = ("red", "green", "blue")
ORDER = {name: place for place, name in enumerate(("intensity", *COLORS))}
INTENSITIES = ("intensity", "intensities", "i", "reflectance", "reflectivity", "remission")
_ALIASES = {alias: colour for colour in COLORS for alias in (colour, colour[0], f"diffuse_{colour}")}
_ALIASES |= dict.fromkeys(INTENSITIES, "intensity")
_TIMES = re.compile("t|time|time_?stamp|adjusted_?time|gps_?time|offset_?time")
# Geometry, and what files say of a point besides its colour: by PCL, LAS, VeloView, Autoware, Livox and Ouster.
_NOT_CHANNELS = re.compile(
    f"{_TIMES.pattern}|[xyz_]|rgba?|a|(diffuse_)?alpha|n[xyz]|normal_[xyz]|curvature|vp_[xyz]|label|class|object|index|"
    "(raw_?)?classification|instance|id|ring|line|tag|row|column|range|distance|depth|azimuth|elevation|laser_?id|"
    "(vertical|horizontal)_?angle|scan_?angle(_?rank)?|scan_?direction_?flag|scanner_?channel|bit_fields|user_?data|"
    "point_?(source_?)?id|return_?(type|number)|num(ber_?of)?_?returns|edge_?of_?flight_?line|key_?point|synthetic|"
    "withheld|overlap"
)
# The bits of NaN in float32, which mark a missing packed colour.
_NO_COLOR = np.float32(np.nan).view(np.uint32)


def channel_name(column: str) -> str | None:
    bare = column.removeprefix("channel_")
    if bare != column and channel_name(bare) != bare:
        return bare
    name = column.lower().removeprefix("scalar_")
    return None if _NOT_CHANNELS.fullmatch(name) else _ALIASES.get(name, column)


def arrays_of_columns(columns: Columns) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N C"], list[str]]:
    columns = {column: values for column, values in columns.items() if values.dtype.kind in "fiu"}
    axes = {column.lower(): values for column, values in columns.items() if column.lower() in ("x", "y", "z")}
    if len(axes) < 3:
        raise ValueError(f"it has no numeric columns x, y, z; found {', '.join(columns) or 'no numeric columns'}")
    points = np.column_stack([axes[axis] for axis in "xyz"])
    points = points if points.dtype.kind == "f" else points.astype(np.float64)
    channels: dict[str, np.ndarray] = {}
    # Exact names before aliases: if a file has intensity and reflectivity, the former becomes "intensity".
    for column in sorted(columns, key=lambda column: column not in ORDER and channel_name(column) in ORDER):
        if (name := channel_name(column)) is not None:
            column_values = columns[column]
            if column_values.dtype.kind != "f":
                # Without loss of precision; integer colours are scaled to 0..1.
                scale = 1 if name not in COLORS else 65535 if column_values.dtype.itemsize == 2 else 255
                column_values = column_values.astype(np.result_type(column_values.dtype, points.dtype)) / scale
            channels[column if name in channels else name] = column_values
    names = sorted(channels, key=lambda name: ORDER.get(name, len(ORDER)))
    values = np.column_stack([channels[name] for name in names]) if names else np.zeros((len(points), 0), points.dtype)
    return points, values, names


def times_of(columns: Columns) -> Shaped[np.ndarray, "N"] | None:
    """The first column of times that differ, in any unit; None if there is none."""
    for column, values in columns.items():
        timed = values.dtype.kind in "fiu" and _TIMES.fullmatch(column.lower().removeprefix("scalar_"))
        if timed and np.isfinite(values).all() and (values != values[:1]).any():
            return values
    return None


def with_unpacked_colors(columns: Columns) -> Columns:
    """Split the column `rgb`, or else `rgba`, into colours if its four bytes are packed ones, as in PCL."""
    packed = "rgb" if "rgb" in columns else "rgba"
    if packed not in columns or columns[packed].dtype.itemsize != 4:
        return columns
    bits = np.ascontiguousarray(columns[packed]).view(np.uint32)
    colors = {name: (bits >> shift).astype(np.uint8) for name, shift in zip(COLORS, (16, 8, 0), strict=True)}
    missing = bits == _NO_COLOR
    if missing.any():
        colors = {name: np.where(missing, np.nan, values / np.float32(255)) for name, values in colors.items()}
    return {name: values for name, values in columns.items() if name != packed} | colors


def arrays_of(points: Any) -> tuple[Any, Any, Sequence[str] | None]:
    """Points, channels and names of an Open3D cloud (legacy, tensor), structured array or pandas table, whose columns
    besides x, y and z become channels as in files. Other arrays are returned unchanged, without channels."""
    if isinstance(points, str | os.PathLike):
        raise ValueError(f"points: expected coordinates, got a path; mcgicp_jax.io.read({str(points)!r}) reads a file")
    for member, advice in (("point_format", "las.xyz"), ("covs", "cloud.points()[:, :3]")):
        # Of laspy and small_gicp.
        if hasattr(points, member):
            raise ValueError(f"points: expected coordinates, got {type(points).__name__}; pass {advice}")
    if hasattr(points, "to_records"):
        # A table of pandas with named columns.
        points = points.to_records(index=False)
    if hasattr(points, "point") and hasattr(points.point, "positions"):
        # A cloud of Open3D's tensors.
        if "colors" not in points.point:
            return points.point.positions.numpy(), None, None
        colors = points.point.colors.numpy()
        full_scale = np.iinfo(colors.dtype).max if colors.dtype.kind == "u" else 1
        return points.point.positions.numpy(), colors / np.float32(full_scale), COLORS
    fields = getattr(getattr(points, "dtype", None), "names", None)
    if fields is not None:
        if not {"x", "y", "z"} <= {field.lower() for field in fields}:
            raise ValueError(f"points: expected the fields x, y and z, got {', '.join(fields)}")
        if "point_source_id" in fields and all(points.dtype[axis].kind in "iu" for axis in "XYZ" if axis in fields):
            raise ValueError("points: expected metres, got the whole numbers of LAS without their scale; pass las.xyz")
        if any(np.ma.getmaskarray(points)[field].any() for field in fields):
            raise ValueError("points: expected no masked fields in a structured array; pass points and channels apart")
        flat = np.asarray(points).reshape(-1)
        return arrays_of_columns(with_unpacked_colors({name: flat[name] for name in fields if flat[name].ndim == 1}))
    if hasattr(points, "points") and not isinstance(points, np.ndarray | jax.Array):
        if hasattr(points, "channels"):
            raise ValueError("points: expected coordinates, got a PointCloud; use it as it is, or PointCloud.replace")
        coordinates, colors = np.asanyarray(points.points), np.asanyarray(getattr(points, "colors", ()))
        # An uncoloured cloud of Open3D has colours of shape (0, 3).
        colored = colors.shape == coordinates.shape and len(colors) > 0
        return coordinates, *((colors, COLORS) if colored else (None, None))
    if not (hasattr(points, "__len__") or hasattr(points, "__array__")) or isinstance(points, dict):
        advice = "pass its cloud" if hasattr(points, "cloud") else "pass coordinates as an array"
        raise ValueError(f"points: expected (N, 3), got {type(points).__name__}; {advice}")
    return points, None, None
