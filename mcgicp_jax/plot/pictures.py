"""Clouds seen from above and in three dimensions, and covariances drawn on a surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Int

import mcgicp_jax.plot.drawing as drawing
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._methods.surfaces import covariances_of
from mcgicp_jax.plot.drawing import (
    Figure,
    File,
    Points,
    View,
    drawable,
    has_everywhere,
    optional_module,
    rgb_of,
)

# These constants affect only how figures look: pixels along the longer side of a map, and width of a figure in inches.
_PIXELS, _WIDTH = 1400, 12


def maps(
    maps: Mapping[str, PointCloud], *, limits: Float[np.ndarray, "2 2"] | None = None, path: File = None
) -> Figure:
    """Draw clouds of a common world, one panel each, along the thinnest principal axis of the first cloud.

    Clouds with the channels red, green and blue are drawn in colour; others in grey, by intensity or height.

    Args:
        maps: clouds by name, for instance maps from `merge_clouds`.
        limits: (2, 2), rows: lower and upper limit along the horizontal and vertical axis of the picture, in metres
            from the centroid of the first cloud; by default 96 % of its points along each axis, plus a margin.
        path: file to save the figure to; its suffix selects the format.

    Raises:
        ValueError: if there are no clouds, or the first has fewer than 3 points.
        ImportError: if matplotlib is missing.
    """
    drawn = {name: drawing.drawable(cloud) for name, cloud in maps.items()}
    if not drawn or len(next(iter(drawn.values()))) < 3:
        raise ValueError("maps: expected at least one cloud, the first with at least 3 points")
    view = drawing.view_onto(np.asarray(next(iter(drawn.values())).points), _PIXELS, limits)
    wide = view.width > 1.5 * view.height
    shape = (len(drawn), 1) if wide else (1, len(drawn))
    aspect = view.height / view.width
    width = _WIDTH if wide else _WIDTH / len(drawn)
    figure = drawing.new_figure(width * shape[1], (width * aspect + 0.35) * shape[0])
    for panel, (name, cloud) in zip(figure.subplots(*shape, squeeze=False).ravel(), drawn.items(), strict=True):
        picture = np.nan_to_num(drawing.paint(view, np.asarray(cloud.points), _shades(cloud, view)), nan=1)
        extent = (0, view.width * view.pixel, 0, view.height * view.pixel)
        panel.imshow(picture, origin="lower", interpolation="nearest", extent=extent)
        panel.set_title(name, fontsize="medium")
        panel.tick_params(labelsize="x-small")
    return drawing.saved(figure, path, bbox_inches="tight")


def surface_covariances(
    cloud: PointCloud,
    covariances: Mapping[str, AbstractMethod | Float[ArrayLike, "N 3 3"]],
    *,
    indices: Sequence[int] | Int[np.ndarray, "M"],
    limits: Float[np.ndarray, "2 2"] | None = None,
    path: File = None,
) -> Figure:
    """Draw covariances in a flat surface as ellipses over its picture, one panel per name.

    All ellipses have the same scale, at which those with a standard deviation of 1 just do not overlap.

    Args:
        cloud: points on a nearly flat surface.
        covariances: by name, (N, 3, 3) for the rows of `cloud.points`, dimensionless; or a method that computes them
            from the preprocessed cloud.
        indices: rows to draw.
        limits: (2, 2), the part of the surface to draw, as in `maps`.
        path: file to save the figure to; its suffix selects the format.

    Raises:
        ValueError: if covariances have the wrong shape.
        ImportError: if matplotlib is missing.
    """
    raw, rows = drawing.drawable(cloud), np.asarray(indices, int)
    view = drawing.view_onto(np.asarray(raw.points), _PIXELS, limits)
    # The indices refer to the rows of `cloud`; `raw`, which the picture shows, lacks padding and non-finite points.
    centers = cloud.coordinates[rows]
    offsets = ((centers - view.center) @ view.axes)[:, :2] - view.low
    extent = float(np.ptp(np.asarray(raw.points), axis=0).max())
    distances = np.linalg.norm(centers[:, None] - centers, axis=-1)
    np.fill_diagonal(distances, np.inf)
    room = min(float(np.median(distances.min(axis=1))), extent / 5)
    picture = np.nan_to_num(drawing.paint(view, np.asarray(raw.points), _shades(raw, view)), nan=1)
    width = _WIDTH / len(covariances)
    figure = drawing.new_figure(_WIDTH, width * view.height / view.width + 0.35)
    panels = figure.subplots(1, len(covariances), squeeze=False)[0]
    for panel, (name, values) in zip(panels, covariances.items(), strict=True):
        given = covariances_of(values, cloud) if isinstance(values, AbstractMethod) else values
        matrices, size = np.asarray(given, np.float64), cloud.points.shape[0]
        if matrices.shape != (size, 3, 3):
            raise ValueError(f"covariances[{name!r}]: expected shape ({size}, 3, 3), got {matrices.shape}")
        flat = view.axes[:, :2].T @ matrices[rows] @ view.axes[:, :2]
        panel.imshow(picture, origin="lower", extent=(0, view.width * view.pixel, 0, view.height * view.pixel))
        _add_ellipses(panel, offsets, flat, room)
        panel.set_title(name, fontsize="medium")
        panel.set(xticks=[], yticks=[], xlim=(0, view.width * view.pixel), ylim=(0, view.height * view.pixel))
    return drawing.saved(figure, path)


def _add_ellipses(
    panel: Any, offsets: Float[np.ndarray, "M 2"], covariances: Float[np.ndarray, "M 2 2"], scale: float
) -> None:
    """Draw ellipses at `offsets`, metres, whose axes are `scale` metres long per standard deviation."""
    sizes, vectors = np.linalg.eigh(covariances)
    lengths = scale * np.sqrt(np.maximum(sizes, 0))
    angles = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    style = {"units": "xy", "facecolors": "none", "edgecolors": "black", "linewidths": 1.2}
    ellipses = drawing.optional_module("matplotlib.collections").EllipseCollection
    panel.add_collection(ellipses(*lengths.T[::-1], angles, offsets=offsets, transOffset=panel.transData, **style))


def _shades(cloud: PointCloud, view: View) -> Points:
    """Colours of the points from red, green and blue if present, else grey from intensity or height."""
    colors = drawing.rgb_of(cloud)
    if colors is not None:
        return np.nan_to_num(colors, nan=0.5)
    if "intensity" in cloud.channel_names:
        values = np.asarray(cloud.channels)[:, cloud.channel_names.index("intensity")]
    else:
        values = view.project(np.asarray(cloud.points))[1]
    low, high = np.nanpercentile(values, [2, 98])
    grey = np.clip((values - low) / max(high - low, np.finfo(float).tiny), 0, 1)
    return np.repeat(0.85 * np.nan_to_num(grey, nan=0.5)[:, None], 3, axis=1)


if TYPE_CHECKING:
    import plotly.graph_objects

# These constants affect only how figures look: points drawn in one figure, and colours of clouds without channels.
_MOST_POINTS = 50_000
_COLORS = ("#1f77d0", "#e8741c", "#2b9c5a", "#b03a8c", "#7a5230", "#707070")


def clouds(*clouds: PointCloud, names: Sequence[str] | None = None) -> plotly.graph_objects.Figure:
    """Show clouds in one 3-D view, coloured by red, green and blue, else by intensity, else in one colour per cloud.

    If the clouds have more than 50,000 points in total, a reproducible random subset of that size is drawn.

    Args:
        clouds: clouds in a common frame.
        names: one per cloud, for the legend.

    Raises:
        ValueError: if the number of names differs from that of the clouds.
        ImportError: if plotly is missing.
    """
    graphs = optional_module("plotly.graph_objects")
    if names is None:
        names = [f"cloud {i}" for i in range(len(clouds))]
    if len(names) != len(clouds):
        raise ValueError(f"names: expected {len(clouds)}, one per cloud, got {len(names)}")
    fraction = min(1.0, _MOST_POINTS / max(sum(len(cloud) for cloud in clouds), 1))
    layout = {"scene": {"aspectmode": "data"}, "legend": {"itemsizing": "constant"}, "margin": dict.fromkeys("lrtb", 0)}
    figure = graphs.Figure(layout=layout)
    for i, (cloud, name) in enumerate(zip(clouds, names, strict=True)):
        figure.add_trace(_scatter(graphs, cloud, name, _COLORS[i % len(_COLORS)], fraction))
    return figure


def _scatter(graphs: Any, cloud: PointCloud, name: str, color: str, fraction: float) -> Any:
    """Draw a reproducible random fraction of the points, in `color` if the cloud has neither colours nor intensity."""
    cloud = drawable(cloud)
    kept = np.random.default_rng(0).permutation(len(cloud))[: round(fraction * len(cloud))]
    rgb = rgb_of(cloud)
    marker: dict[str, Any] = {"size": 1.5, "color": color}
    if rgb is not None:
        marker["color"] = [f"rgb({r},{g},{b})" for r, g, b in np.round(255 * rgb[kept]).astype(int)]
    elif has_everywhere(cloud, ("intensity",)) and len(cloud):
        intensity = np.asarray(cloud.channels)[:, cloud.channel_names.index("intensity")]
        low, high = np.nanpercentile(intensity, [2, 98])
        marker |= {"color": intensity[kept], "colorscale": "Viridis", "cmin": low, "cmax": high}
    x, y, z = np.asarray(cloud.points)[kept].T
    return graphs.Scatter3d(x=x, y=y, z=z, mode="markers", name=name, marker=marker, showlegend=True)
