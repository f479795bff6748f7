"""Points of depth images."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

# Besides 0, the value of pixels without depth in 16-bit images of Kinect v1 (7-Scenes).
_NO_DEPTH = 65535


def back_project(
    depth: Any, intrinsics: Any, scale: int | float | None = None, max_depth: int | float | None = None
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 2"]]:
    """Points (x right, y down, z ahead; metres) and pixels (column, row), row by row, as in `PointCloud.from_depth`."""
    depth = np.asarray(depth)
    if depth.ndim != 2 or depth.dtype.kind not in "fiu":
        raise ValueError(f"depth: expected numbers of shape (height, width), got {depth.dtype} of shape {depth.shape}")
    camera = np.asarray(intrinsics, np.float64)
    if camera.shape == (3, 3):
        camera = camera[[0, 1, 0, 1], [0, 1, 2, 2]]
    if camera.shape != (4,) or not (np.isfinite(camera).all() and (camera[:2] > 0).all()):
        raise ValueError(f"intrinsics: expected (fx, fy, cx, cy) or a (3, 3) camera matrix, pixels, got {intrinsics!r}")
    scale = (1.0 if depth.dtype.kind == "f" else 1000.0) if scale is None else scale
    if not scale > 0:
        raise ValueError(f"scale: expected a positive number of depth units per metre, got {scale}")
    measured = np.isfinite(depth) & (depth > 0)
    if depth.dtype == np.uint16:
        measured &= depth != _NO_DEPTH
    if max_depth is not None:
        measured &= depth <= max_depth * scale
    row, column = np.nonzero(measured)
    pixels = np.stack([column, row], axis=1).astype(float)
    distance = depth[row, column, None] / scale
    return np.hstack([(pixels - camera[2:]) / camera[:2] * distance, distance]), pixels
