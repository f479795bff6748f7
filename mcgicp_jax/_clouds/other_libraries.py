"""Clouds of other libraries as arrays."""

from __future__ import annotations

import os
from typing import Any

import jax
import numpy as np

_AXES, _COLORS = ("x", "y", "z"), ("red", "green", "blue")


def arrays_of(points: Any) -> tuple[Any, Any, tuple[str, ...] | None]:
    """Points, channels and their names: of a structured array with the fields x, y and z, whose other numbers become
    channels, or of an object with `points` and perhaps `colors`, as in Open3D. Anything else is returned as it is.

    Raises:
        ValueError: if it is a path, or an object without points.
    """
    if isinstance(points, str | os.PathLike):
        raise ValueError(f"points: expected coordinates, got a path; mcgicp_jax.io.read({str(points)!r}) reads a file")
    fields = getattr(getattr(points, "dtype", None), "names", None)
    if fields is not None:
        if not set(_AXES) <= set(fields):
            raise ValueError(f"points: expected the fields x, y and z, got {', '.join(fields)}")
        names = tuple(name for name in fields if name not in _AXES and points.dtype[name].kind in "fiub")
        flat = points.reshape(-1)
        columns = [np.stack([flat[name] for name in each], axis=1) for each in (_AXES, names) if each]
        return columns[0], columns[1] if names else None, names or None
    if hasattr(points, "points") and not isinstance(points, np.ndarray | jax.Array):
        colors = np.asarray(getattr(points, "colors", ()))
        return np.asarray(points.points), *((colors, _COLORS) if colors.shape[1:] == (3,) else (None, None))
    if not (hasattr(points, "__len__") or hasattr(points, "__array__")):
        kind = type(points).__name__
        raise ValueError(f"points: expected (N, 3), got {kind}; its coordinates may be np.asarray(cloud.points)")
    return points, None, None
