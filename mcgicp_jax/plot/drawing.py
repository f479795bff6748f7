"""Shared by the figures: optional packages, files, projections of clouds to pixels, and colours of points."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from mcgicp_jax._clouds.columns import COLORS
from mcgicp_jax._clouds.point_cloud import PointCloud, Values, as_cloud
from mcgicp_jax._compute.messages import optional_module

if TYPE_CHECKING:
    from matplotlib.figure import Figure
else:
    Figure = Any

File: TypeAlias = str | os.PathLike[str] | None
Points: TypeAlias = Float[np.ndarray, "N 3"]
Picture: TypeAlias = Float[np.ndarray, "height width 3"]
Map: TypeAlias = Float[np.ndarray, "height width"]

# Affects only how figures look: pixels per point spacing, unless the limit on the pixels makes them coarser.
PIXELS_PER_SPACING = 3

# From a package of the extra `plot`.
plotting = partial(optional_module, extra="plot", use="plotting")


def new_figure(width: float | int, height: float | int) -> Figure:
    """An empty figure, inches, that belongs to no window."""
    return plotting("matplotlib.figure").Figure((width, height), layout="constrained")


def saved(figure: Figure, path: File, **options: Any) -> Figure:
    if path is not None:
        figure.savefig(path, dpi=120, **options)
    return figure


def check_picture(path: str | os.PathLike[str]) -> None:
    """Raise `ValueError` if matplotlib cannot save figures to a file with this suffix."""
    kinds = plotting("matplotlib.figure").Figure().canvas.get_supported_filetypes()
    suffix = os.path.splitext(path)[1]
    if suffix.lower().removeprefix(".") not in kinds:
        raise ValueError(f"{os.fspath(path)}: unknown suffix {suffix!r}; expected one of .{', .'.join(kinds)}")


@dataclass(frozen=True)
class View:
    """An orthographic projection of points to `height` × `width` pixels of a plane.

    `center` is a point of the plane, `low` the lower left corner in it, and `pixel` the side of a pixel, in metres. The
    columns of `axes` point right, up, and towards the viewer.
    """

    center: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    low: Float[np.ndarray, "2"]
    pixel: float
    width: int
    height: int

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, lower and upper end of a picture from its lower left corner, metres."""
        return 0.0, self.width * self.pixel, 0.0, self.height * self.pixel

    def project(self, points: Points) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N"]]:
        """The row-major pixel index of each point, −1 if outside, and its height above the plane in metres."""
        local = (points - self.center) @ self.axes
        column, row = np.floor((local[:, :2] - self.low) / self.pixel).astype(int).T
        inside = (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        return np.where(inside, row * self.width + column, -1), local[:, 2]


def view_onto(points: Points, most_pixels: int, limits: Float[np.ndarray, "2 2"] | None = None) -> View:
    """The view onto the two longest principal axes of the points, from the side of the origin (usually the sensor)."""
    center = points.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov((points - center).T))
    normal, right = vectors[:, 0], vectors[:, 2]
    normal = normal if normal @ center < 0 else -normal
    right = right if right[np.argmax(np.abs(right))] > 0 else -right
    axes = np.stack([right, np.cross(normal, right), normal], axis=1)
    low, high = np.percentile(((points - center) @ axes)[:, :2], [2, 98], axis=0)
    if limits is not None:
        low, high = limits.T
    margin = np.maximum(0.02 * (high - low), 1e-6)
    low, extent = low - margin, high - low + 2 * margin
    spacing = np.sqrt(extent.prod() / len(points))
    pixel = max(spacing / PIXELS_PER_SPACING, extent.max() / most_pixels)
    width, height = np.ceil(extent / pixel).astype(int)
    return View(center, axes, low, float(pixel), int(width), int(height))


def paint(view: View, points: Points, colors: Points) -> Picture:
    """The mean colour of the points in each pixel, extended into the gaps between points; NaN further away."""
    from scipy.ndimage import distance_transform_edt

    pixels, _ = view.project(points)
    size = view.height * view.width
    inside = pixels >= 0
    count = np.bincount(pixels[inside], minlength=size)
    sums = [np.bincount(pixels[inside], channel, minlength=size) for channel in colors[inside].T]
    picture = np.stack(sums, axis=-1) / np.where(count > 0, count, np.nan)[:, None]
    picture = picture.reshape(view.height, view.width, 3)
    distance, (row, column) = distance_transform_edt(np.isnan(picture[..., 0]), return_indices=True)
    return np.where(distance[..., None] <= PIXELS_PER_SPACING, picture[row, column], np.nan)


def by_name(name: str, values: Any, example: str) -> dict[str, Any]:
    """A mapping as a dictionary; `ValueError` with an example for anything else."""
    if not isinstance(values, Mapping):
        raise ValueError(f"{name}: expected {name} by name, such as {example}, got {type(values).__name__}")
    return dict(values)


def drawable(name: str, cloud: PointCloud | Values) -> PointCloud:
    """The finite points and their channels, as NumPy arrays in float64."""
    cloud = as_cloud(name, cloud).unpad()
    points = np.asarray(cloud.points, np.float64)
    return cloud.replace_rows(points=points, valid=np.isfinite(points).all(axis=1), covariances=None).unpad()


def channels_of(cloud: PointCloud, names: tuple[str, ...]) -> Float[np.ndarray, "N D"] | None:
    """The channels with these names; None unless every point has all of them."""
    if not set(names) <= set(cloud.channel_names):
        return None
    columns = [cloud.channel_names.index(name) for name in names]
    if cloud.channel_valid is not None and not np.asarray(cloud.channel_valid)[:, columns].all():
        return None
    return np.asarray(cloud.channels)[:, columns]


def rgb_of(cloud: PointCloud) -> Points | None:
    """Colours in 0..1 from channels in 0..1, 0..255 or 0..65535; None unless every point has a colour."""
    channels = channels_of(cloud, COLORS)
    if channels is None:
        return None
    largest = channels.max(initial=0)
    full_scale = next((scale for scale in (1, 255) if largest <= scale), 65535)
    return np.clip(channels.astype(float) / full_scale, 0, 1)
