"""Clouds of other libraries as arrays."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from mcgicp_jax._clouds.columns import COLORS, arrays_of_columns, with_unpacked_colors


def arrays_of(points: Any) -> tuple[Any, Any, Sequence[str] | None]:
    """Points, channels and their names: of a structured array or a table of pandas with the columns x, y and z, whose
    other numbers become channels as in files, or of a cloud of Open3D, also of tensors. Anything else is returned as it
    is.

    Raises:
        ValueError: if it is a path, a `PointCloud`, an object without points, or a structured array with masked fields.
    """
    if isinstance(points, str | os.PathLike):
        raise ValueError(f"points: expected coordinates, got a path; mcgicp_jax.io.read({str(points)!r}) reads a file")
    if hasattr(points, "to_records"):
        # A table of pandas with named columns.
        points = points.to_records(index=False)
    if hasattr(points, "point") and hasattr(points.point, "positions"):
        # A cloud of Open3D's tensors.
        colors = points.point.colors.numpy() if "colors" in points.point else None
        scale = 255 if colors is not None and colors.dtype == np.uint8 else 1
        colors = None if colors is None else colors / np.float32(scale)
        return points.point.positions.numpy(), colors, None if colors is None else COLORS
    fields = getattr(getattr(points, "dtype", None), "names", None)
    if fields is not None:
        if not {"x", "y", "z"} <= {field.lower() for field in fields}:
            raise ValueError(f"points: expected the fields x, y and z, got {', '.join(fields)}")
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
        advice = "pass its cloud" if hasattr(points, "cloud") else "pass its coordinates as an array"
        raise ValueError(f"points: expected (N, 3), got {type(points).__name__}; {advice}")
    return points, None, None
