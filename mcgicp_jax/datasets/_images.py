"""Reading of colour and depth images, colour look-up and back-projection."""

from __future__ import annotations

import os
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8, UInt16

Picture: TypeAlias = UInt8[np.ndarray, "height width 3"]


def read_image(path: str | os.PathLike[str]) -> Picture:
    """Read an image as 8-bit red, green and blue."""
    return np.asarray(_open(path).convert("RGB"))


def read_depth(path: str | os.PathLike[str]) -> UInt16[np.ndarray, "height width"]:
    """Read a 16-bit depth image, in the unit of the file; raises `ValueError` for another kind of image."""
    depth = np.asarray(_open(path))
    if depth.ndim != 2 or depth.dtype != np.uint16:
        raise ValueError(f"{path}: expected a 16-bit depth image, got {depth.dtype} of shape {depth.shape}")
    return depth


def look_up(image: Picture, pixels: Float[np.ndarray, "N 2"]) -> tuple[Float[np.ndarray, "N 3"], Bool[np.ndarray, "N"]]:
    """Bilinear colours from 0 to 1, and the mask of pixels inside the image.

    Pixels are (column, row); the centre of the first is (0, 0).
    """
    height, width, _ = image.shape
    # NaN compares false and is outside.
    inside = np.all((pixels >= 0) & (pixels <= (width - 1, height - 1)), axis=1)
    return bilinear(image, np.where(inside[:, None], pixels, 0), "nearest") / 255, inside


def bilinear(
    image: Shaped[np.ndarray, "height width 3"], pixels: Float[np.ndarray, "N 2"], mode: str
) -> Float[np.ndarray, "N 3"]:
    """Values at pixels (column, row) of an image; `mode` says how SciPy's `map_coordinates` continues it."""
    from scipy.ndimage import map_coordinates

    values = [map_coordinates(each, pixels.T[::-1], float, order=1, mode=mode) for each in np.moveaxis(image, 2, 0)]
    return np.stack(values, axis=1)


def back_project(
    depth: Float[np.ndarray, "height width"], focal: tuple[float, float], center: tuple[float, float]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 2"]]:
    """Points of a pinhole camera (x right, y down, z ahead), and their pixels; depth in metres, 0 if missing."""
    row, column = np.nonzero(depth > 0)
    pixels = np.stack([column, row], axis=1).astype(float)
    distance = depth[row, column, None]
    return np.hstack([(pixels - center) / focal * distance, distance]), pixels


def _open(path: str | os.PathLike[str]) -> Any:
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError("reading images needs pillow: pip install 'mcgicp_jax[io]'") from error
    try:
        return Image.open(path)
    except Image.UnidentifiedImageError as error:
        raise ValueError(f"{path}: cannot be read as an image") from error
