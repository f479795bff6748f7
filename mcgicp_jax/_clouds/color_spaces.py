"""Colour spaces for channels: Lab, HSV and YUV from RGB."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.point_cloud import Values
from mcgicp_jax._compute.concrete import AnyArray, canonical_float, numpy_for

# IEC 61966-2-1 (sRGB): below the limit the transfer function is linear, above it a power.
_SRGB_LIMIT, _SRGB_SLOPE, _SRGB_OFFSET, _SRGB_POWER = 0.04045, 12.92, 0.055, 2.4
# The same standard: XYZ of linear RGB for the white point D65, each row divided by the coordinate of white.
_XYZ = np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])
_XYZ_OF_WHITE = _XYZ / np.array([[0.950456], [1.0], [1.088754]])
# CIE 15:2004: (6/29)³, below which the cube root of Lab is replaced by its linear part 841/108 t + 4/29.
_LAB_LIMIT, _LAB_SLOPE, _LAB_OFFSET = (6 / 29) ** 3, 841 / 108, 4 / 29
# ITU-R BT.601: weights of luma, and factors of the colour differences blue − luma and red − luma.
_LUMA, _BLUE, _RED = np.array([0.299, 0.587, 0.114]), 0.492, 0.877


def rgb_to_lab(rgb: Values) -> Float[AnyArray, "*batch 3"]:
    """CIE L*a*b* of sRGB colours for the white point D65 (CIE 15:2004): Euclidean distances are perceptual.

    Pure and differentiable: the gradient is finite everywhere, also at black, where both curves are linear.

    Args:
        rgb: (..., 3) red, green and blue with the sRGB transfer function, as in image files, 0 to 1.

    Returns:
        (..., 3) L from 0 to 100, and a and b, 0 for greys.

    Raises:
        ValueError: if the last axis does not have three entries.
    """
    colors, xp = _colors(rgb)
    power = colors > _SRGB_LIMIT
    base = (xp.where(power, colors, 1) + _SRGB_OFFSET) / (1 + _SRGB_OFFSET)
    linear = xp.where(power, base**_SRGB_POWER, colors / _SRGB_SLOPE)
    xyz = xp.stack([_weighted(row, linear) for row in _XYZ_OF_WHITE])
    root = xyz > _LAB_LIMIT
    x, y, z = xp.where(root, xp.cbrt(xp.where(root, xyz, 1)), _LAB_SLOPE * xyz + _LAB_OFFSET)
    return xp.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def rgb_to_hsv(rgb: Values) -> Float[AnyArray, "*batch 3"]:
    """Hue h, saturation s and value v as (s cos h, s sin h, v) (Smith 1978): unlike h itself, continuous at red.

    Pure; derivatives are finite everywhere. Saturation is a ratio: noise of dark colours (v → 0) is amplified by 1/v.
    At greys, where the hue is undefined, and where two colours are equal, derivatives are one-sided; 0 at black.

    Args:
        rgb: (..., 3) red, green and blue, 0 to 1.

    Returns:
        (..., 3) s cos h and s sin h, each −1 to 1, and v, 0 to 1.

    Raises:
        ValueError: if the last axis does not have three entries.
    """
    (red, green, blue), xp = _colors(rgb)
    value = xp.maximum(xp.maximum(red, green), blue)
    chroma = value - xp.minimum(xp.minimum(red, green), blue)
    colored, bright = chroma > 0, value > 0
    scale = xp.where(colored, chroma, 1)
    # Multiples of 60°: red 0, green 2, blue 4.
    green_or_blue = xp.where(value == green, 2 + (blue - red) / scale, 4 + (red - green) / scale)
    sixths = xp.where(value == red, (green - blue) / scale, green_or_blue)
    saturation = xp.where(bright, chroma / xp.where(bright, value, 1), 0)
    hue = np.pi / 3 * sixths
    return xp.stack([saturation * xp.cos(hue), saturation * xp.sin(hue), value], -1)


def rgb_to_yuv(rgb: Values) -> Float[AnyArray, "*batch 3"]:
    """Luma and two colour differences (ITU-R BT.601): Y, U = 0.492 (B − Y), V = 0.877 (R − Y). Linear.

    Args:
        rgb: (..., 3) red, green and blue, 0 to 1.

    Returns:
        (..., 3) Y from 0 to 1, U from −0.44 to 0.44, V from −0.61 to 0.61.

    Raises:
        ValueError: if the last axis does not have three entries.
    """
    colors, xp = _colors(rgb)
    luma = _weighted(_LUMA, colors)
    red, _, blue = colors
    return xp.stack([luma, _BLUE * (blue - luma), _RED * (red - luma)], -1)


# By the name that stands for the three channels in options.
COLOR_SPACES = {"lab": rgb_to_lab, "hsv": rgb_to_hsv, "yuv": rgb_to_yuv}


def _colors(rgb: Values) -> tuple[Any, Any]:
    """The checked red, green and blue in floating point, (3, ...), and their array module: `jax.numpy` if traced."""
    xp = numpy_for(rgb)
    colors: Any = xp.asarray(rgb)
    if colors.ndim == 0 or colors.shape[-1] != 3:
        raise ValueError(f"rgb: expected shape (..., 3), got {colors.shape}")
    if colors.dtype.kind in "ui":
        raise ValueError(f"rgb: expected numbers from 0 to 1, got {colors.dtype}; divide images by 255")
    colors = colors if colors.dtype in (np.float32, np.float64) else colors.astype(canonical_float())
    return xp.moveaxis(colors, -1, 0), xp


def _weighted(weights: Float[np.ndarray, "3"], colors: Any) -> Any:
    first, second, third = weights.tolist()
    red, green, blue = colors
    return first * red + second * green + third * blue
