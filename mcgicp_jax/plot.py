"""Figures of clouds and registrations: matplotlib to print, plotly to turn in 3-D. Both are imported on demand.

Every function returns its figure; none shows a window or changes matplotlib's state.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Int

from mcgicp_jax._cloud import PointCloud
from mcgicp_jax._directions import CHANNELS_HOLD, GEOMETRY_HOLDS, shares
from mcgicp_jax._pose import Pose, pose_matrix
from mcgicp_jax._result import Registration

if TYPE_CHECKING:
    import matplotlib.figure
    import plotly.graph_objects

Points: TypeAlias = Float[np.ndarray, "N 3"]
Picture: TypeAlias = Float[np.ndarray, "height width 3"]
Map: TypeAlias = Float[np.ndarray, "height width"]

_CLOUD_COLORS = ("#1f77d0", "#e8741c", "#2b9c5a", "#b03a8c", "#7a5230", "#707070")
_MOST_POINTS = 50_000

# before_after: inches at most, all panels across and one panel up; pixels and tiles along the longer side of a panel;
# the share of a side that the detail shows.
_WIDEST, _HIGHEST, _PIXELS, _TILES, _DETAIL = 12, 4.5, 500, 12, 0.25
# Pixels along the longer side of a map.
_MAP_PIXELS = 1400
# Pixels are this much finer than the points lie apart, as far as _PIXELS allows.
_PIXELS_PER_SPACING = 3


def before_after(
    source: PointCloud, target: PointCloud, poses: Mapping[str, Pose], *, path: str | os.PathLike[str] | None = None
) -> matplotlib.figure.Figure:
    """What each pose makes of the source, seen in the direction in which the target is thinnest; a row per pose.

    Clouds whose points all have the channels red, green and blue alternate like the squares of a chess board, target
    beside moved source: a pattern that runs through unbroken is one that fits. Next to it is the difference of the
    colours. Other clouds are laid over each other, the target in blue and the source in orange: black is where both
    are. What stands upright is drawn dark and what lies flat pale, since the rings that a LiDAR draws on the ground
    move with it. The detail shows where the poses differ most.

    Args:
        poses: `T_target_source` by the name of its method. The first row is the identity, "start", or the poses' own
            "start" if they have one.
        path: a file to save the figure in; its ending tells the format.

    Raises:
        ValueError: if a pose is no pose, or the target has fewer than 3 points.
        ImportError: if matplotlib is missing.
    """
    figures = _module("matplotlib.figure")
    named = {name: pose_matrix(pose, f"poses[{name!r}]") for name, pose in ({"start": np.eye(4)} | dict(poses)).items()}
    source, target = _drawable(source), _drawable(target)
    if len(target) < 3:
        raise ValueError(f"target: expected at least 3 points, got {len(target)}")
    moved = [np.asarray(source.transform(matrix).unpad().points) for matrix in named.values()]
    source_colors, target_colors = _rgb(source), _rgb(target)
    target_points = np.asarray(target.points)
    view = _view(target_points)
    if source_colors is not None and target_colors is not None:
        rows = _chess_boards(view, target_points, target_colors, moved, source_colors)
        headings = ["target and source in alternate tiles", "detail", "difference of colour"]
    else:
        rows = _overlays(view, target_points, moved)
        headings = ["target blue, source orange, both black", "detail"]
    detail = _where_they_differ([difference for _, difference in rows])
    headings[1] = f"detail, {(detail[0].stop - detail[0].start) * view.pixel:.2g} m wide"

    width = min(_WIDEST / len(headings), _HIGHEST * view.width / view.height)
    height = width * view.height / view.width + 0.3
    figure = figures.Figure((len(headings) * width + 0.3, len(rows) * height + 0.3), layout="constrained")
    panels = figure.subplots(len(rows), len(headings), squeeze=False)
    for panel, heading in zip(panels[0], headings, strict=True):
        panel.set_title(heading)
    for row, name, (picture, difference) in zip(panels, named, rows, strict=True):
        _draw_row(row, name, picture, difference, detail)
    if path is not None:
        figure.savefig(path, dpi=120)
    return figure


def _draw_row(panels: np.ndarray, name: str, picture: Picture, difference: Map, detail: tuple[slice, slice]) -> None:
    columns, rows = detail
    left, right, bottom, top = columns.start, columns.stop, rows.start, rows.stop
    # Pixel i reaches from i to i + 1, as the slices count.
    options = {"origin": "lower", "interpolation": "nearest", "extent": (0, picture.shape[1], 0, picture.shape[0])}
    for panel in panels[:2]:
        panel.imshow(picture, **options)
    panels[0].plot([left, right, right, left, left], [bottom, bottom, top, top, bottom], color="black", linewidth=1)
    panels[0].set_ylabel(name, fontsize="large", fontweight="bold")
    panels[1].set(xlim=(left, right), ylim=(bottom, top))
    if len(panels) > 2:
        panels[2].imshow(difference, **options, cmap="magma", vmin=0, vmax=0.4)
        both = np.isfinite(difference)
        panels[2].set_xlabel(f"mean {difference[both].mean():.3f}" if both.any() else "no overlap")
    for panel in panels:
        panel.set(xticks=[], yticks=[])


@dataclass(frozen=True)
class _View:
    """A picture plane: points become pixels, and heights above the plane."""

    center: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    low: Float[np.ndarray, "2"]
    pixel: float
    width: int
    height: int

    def project(self, points: Points) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N"]]:
        """For each point the pixel, numbered along the rows, −1 if it is outside; and the height in metres."""
        local = (points - self.center) @ self.axes
        column, row = np.floor((local[:, :2] - self.low) / self.pixel).astype(int).T
        inside = (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        return np.where(inside, row * self.width + column, -1), local[:, 2]


def _view(
    points: Points,
    most_pixels: int = _PIXELS,
    limits: Float[np.ndarray, "2 2"] | None = None,
) -> _View:
    """The two longest principal axes of the points, seen from the side of the origin: of the sensor, mostly."""
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
    pixel = max(spacing / _PIXELS_PER_SPACING, extent.max() / most_pixels)
    width, height = np.ceil(extent / pixel).astype(int)
    return _View(center, axes, low, float(pixel), int(width), int(height))


def _chess_boards(
    view: _View,
    target: Float[np.ndarray, "M 3"],
    target_colors: Float[np.ndarray, "M 3"],
    moved: Sequence[Points],
    source_colors: Points,
) -> list[tuple[Picture, Map]]:
    """For each moved source alternate tiles in one picture, and the difference of colour, NaN where one is unseen."""
    tile = max(view.width, view.height) // _TILES + 1
    row, column = np.mgrid[: view.height, : view.width] // tile
    target_tiles = ((row + column) % 2 == 0)[..., None]
    ours = _paint(view, target, target_colors)
    ours_smooth, boards = _smooth(ours), []
    for points in moved:
        theirs = _paint(view, points, source_colors)
        picture = np.nan_to_num(np.where(target_tiles, ours, theirs), nan=1)
        boards.append((picture, np.abs(ours_smooth - _smooth(theirs)).mean(axis=-1)))
    return boards


def _paint(view: _View, points: Points, colors: Points) -> Picture:
    """The mean colour of the points in each pixel, spread over the gaps between them; NaN further away."""
    pixels, _ = view.project(points)
    size = view.height * view.width
    inside = pixels >= 0
    count = np.bincount(pixels[inside], minlength=size)
    sums = [np.bincount(pixels[inside], channel, minlength=size) for channel in colors[inside].T]
    picture = np.stack(sums, axis=-1) / np.where(count > 0, count, np.nan)[:, None]
    picture = picture.reshape(view.height, view.width, 3)
    for _ in range(_PIXELS_PER_SPACING):
        for axis in (0, 1):
            for shift in (1, -1):
                picture = np.where(np.isnan(picture), _shifted(picture, shift, axis), picture)
    return picture


def _shifted(picture: Picture, shift: int, axis: int) -> Picture:
    """The picture moved by one pixel, the last row or column staying."""
    rows = np.clip(np.arange(picture.shape[axis]) - shift, 0, picture.shape[axis] - 1)
    return np.take(picture, rows, axis)


def _smooth(picture: Picture) -> Picture:
    """The mean over squares a little larger than the points lie apart: what is left of a difference is not sampling."""
    reach = _PIXELS_PER_SPACING // 2 + 1
    padded = np.pad(picture, ((reach, reach), (reach, reach), (0, 0)), mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, (2 * reach + 1,) * 2, (0, 1)).mean(axis=(-1, -2))


def _overlays(view: _View, target: Float[np.ndarray, "M 3"], moved: Sequence[Points]) -> list[tuple[Picture, Map]]:
    """For each moved source both clouds in one picture, and the difference of their inks."""
    ours = _ink(view, target)
    overlays = []
    for points in moved:
        theirs = _ink(view, points)
        # Ink takes light away: the target all of the red, the source all of the blue, each half of the green.
        picture = 1 - np.stack([ours, 0.5 * ours + 0.5 * theirs, theirs], axis=-1)
        overlays.append((picture, np.abs(ours - theirs)))
    return overlays


def _ink(view: _View, points: Points) -> Map:
    """From 0 to 1: none without points, little where they lie flat, full where they stand four pixels high."""
    pixels, height = view.project(points)
    lowest, highest = np.full(view.height * view.width, np.inf), np.full(view.height * view.width, -np.inf)
    inside = pixels >= 0
    np.minimum.at(lowest, pixels[inside], height[inside])
    np.maximum.at(highest, pixels[inside], height[inside])
    stands = np.clip((highest - lowest) / (4 * view.pixel), 0.15, 1)
    return np.where(highest >= lowest, stands, 0).reshape(view.height, view.width)


def _where_they_differ(differences: Sequence[Map]) -> tuple[slice, slice]:
    """The columns and rows of the detail: where the poses with most and with least difference are furthest apart."""
    shape = np.array(differences[0].shape)
    size = np.maximum((_DETAIL * shape).astype(int), 1)
    sums = []
    for difference in differences:
        table = np.pad(np.nan_to_num(difference), ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
        across = table[:, size[1] :] - table[:, : -size[1]]
        sums.append(across[size[0] :] - across[: -size[0]])
    row, column = np.unravel_index(np.argmax(np.ptp(sums, axis=0)), sums[0].shape)
    return slice(int(column), int(column + size[1])), slice(int(row), int(row + size[0]))


def convergence(
    histories: Mapping[str, Sequence[float] | ArrayLike], *, ylabel: str = "cost"
) -> matplotlib.figure.Figure:
    """How cost or rmse fell, by method.

    Args:
        histories: one number per iteration, by the name of its method.
        ylabel: what the numbers are, with their unit.

    Raises:
        ValueError: if a history is not one-dimensional.
        ImportError: if matplotlib is missing.
    """
    figures = _module("matplotlib.figure")
    figure = figures.Figure((6, 4), layout="constrained")
    panel = figure.subplots()
    for name, history in histories.items():
        values = np.asarray(history)
        if values.ndim != 1:
            raise ValueError(f"histories[{name!r}]: expected one number per iteration, got shape {values.shape}")
        panel.plot(values, marker="o", markersize=3, label=name)
    panel.set(xlabel="iteration", ylabel=ylabel, yscale="log")
    panel.xaxis.get_major_locator().set_params(integer=True)
    panel.grid(alpha=0.3)
    panel.legend()
    return figure


def localizability(result: Registration, *, path: str | os.PathLike[str] | None = None) -> matplotlib.figure.Figure:
    """What holds each of six directions: the share of the points' motion that geometry feels, and that channels do.

    Dashed are the shares from which on a direction counts as held. The channels' share is told of the directions that
    geometry leaves free.

    Args:
        result: of `register`, a single one.
        path: a file to save the figure in; its ending tells the format.

    Raises:
        ValueError: if the result has no directions, as one of `align`.
        ImportError: if matplotlib is missing.
    """
    if result.directions is None or np.ndim(result.status_code):
        raise ValueError("result: expected a single one of `register`, got one without directions, or a batch")
    figures = _module("matplotlib.figure")
    figure = figures.Figure((7.5, 3.2), layout="constrained")
    panel = figure.subplots()
    lowest = 1e-4
    rows = np.arange(6)
    names, *values = zip(*shares(result.directions), strict=True)
    bars = (
        ("geometry", values[0], GEOMETRY_HOLDS, _CLOUD_COLORS[0], -0.2),
        ("channels", values[1], CHANNELS_HOLD, _CLOUD_COLORS[1], 0.2),
    )
    for name, share, threshold, color, offset in bars:
        panel.barh(rows + offset, np.maximum(share, lowest) - lowest, 0.38, lowest, color=color, label=name)
        panel.axvline(threshold, color=color, linestyle="--", linewidth=1)
    panel.set(xscale="log", xlim=(lowest, 1), xlabel="share of the points' motion that is felt")
    panel.set_yticks(rows, names)
    panel.invert_yaxis()
    panel.set_title(result.status.name, loc="left", fontsize="medium")
    figure.legend(loc="outside upper right", ncols=2, frameon=False)
    if path is not None:
        figure.savefig(path, dpi=120)
    return figure


def trajectories(
    trajectories: Mapping[str, Sequence[Pose] | Float[np.ndarray, "N 4 4"]],
    *,
    path: str | os.PathLike[str] | None = None,
) -> matplotlib.figure.Figure:
    """The ways that poses take, laid over each other in the plane in which the first of them is widest.

    Args:
        trajectories: poses, sensor to one world, by name.
        path: a file to save the figure in; its ending tells the format.

    Raises:
        ValueError: if there are no poses under a name, or one is no pose.
        ImportError: if matplotlib is missing.
    """
    figures = _module("matplotlib.figure")
    figure = figures.Figure((7, 5), layout="constrained")
    panel = figure.subplots()
    plane, start = None, None
    for name, poses in trajectories.items():
        places = np.array([pose_matrix(pose, f"trajectories[{name!r}][{i}]")[:3, 3] for i, pose in enumerate(poses)])
        if not len(places):
            raise ValueError(f"trajectories[{name!r}]: expected at least one pose, got none")
        if plane is None or start is None:
            start = places[0]
            plane = np.linalg.svd(places - places.mean(axis=0))[2][:2]
            # The first axis the way that the sensor goes.
            plane[0] *= 1 if (places[-1] - start) @ plane[0] >= 0 else -1
        along, across = plane @ (places - start).T
        panel.plot(along, across, marker=".", markersize=4, linewidth=1, label=name)
    panel.set(xlabel="metres", ylabel="metres", aspect="equal", adjustable="datalim")
    panel.grid(alpha=0.3)
    panel.legend()
    if path is not None:
        figure.savefig(path, dpi=120)
    return figure


def maps(
    maps: Mapping[str, PointCloud],
    *,
    limits: Float[np.ndarray, "2 2"] | None = None,
    path: str | os.PathLike[str] | None = None,
) -> matplotlib.figure.Figure:
    """Clouds in one world, a panel for each, seen in the direction in which the first of them is thinnest.

    Clouds with the channels red, green and blue are drawn in these; others in grey, by their intensity or height.

    Args:
        maps: clouds, as from `aggregate`, by name.
        limits: from where to where, along the two axes of the picture, in metres from the middle of the first cloud;
            by default all of it.
        path: a file to save the figure in; its ending tells the format.

    Raises:
        ValueError: if there is none, or the first has fewer than 3 points.
        ImportError: if matplotlib is missing.
    """
    figures = _module("matplotlib.figure")
    drawn = {name: _drawable(cloud) for name, cloud in maps.items()}
    if not drawn or len(next(iter(drawn.values()))) < 3:
        raise ValueError("maps: expected at least one, the first of at least 3 points")
    view = _view(np.asarray(next(iter(drawn.values())).points), _MAP_PIXELS, limits)
    wide = view.width > 1.5 * view.height
    shape = (len(drawn), 1) if wide else (1, len(drawn))
    aspect = view.height / view.width
    width = _WIDEST if wide else _WIDEST / len(drawn)
    figure = figures.Figure((width * shape[1], (width * aspect + 0.35) * shape[0]), layout="constrained")
    for panel, (name, cloud) in zip(figure.subplots(*shape, squeeze=False).ravel(), drawn.items(), strict=True):
        picture = np.nan_to_num(_paint(view, np.asarray(cloud.points), _shades(cloud, view)), nan=1)
        extent = (0, view.width * view.pixel, 0, view.height * view.pixel)
        panel.imshow(picture, origin="lower", interpolation="nearest", extent=extent)
        panel.set_title(name, fontsize="medium")
        panel.tick_params(labelsize="x-small")
    if path is not None:
        figure.savefig(path, dpi=120, bbox_inches="tight")
    return figure


def _shades(cloud: PointCloud, view: _View) -> Points:
    """The colours of a cloud, or grey."""
    colors = _rgb(cloud)
    if colors is not None:
        return np.nan_to_num(colors, nan=0.5)
    if "intensity" in cloud.channel_names:
        values = np.asarray(cloud.channels)[:, cloud.channel_names.index("intensity")]
    else:
        values = view.project(np.asarray(cloud.points))[1]
    low, high = np.nanpercentile(values, [2, 98])
    grey = np.clip((values - low) / max(high - low, np.finfo(float).tiny), 0, 1)
    return np.repeat(0.85 * np.nan_to_num(grey, nan=0.5)[:, None], 3, axis=1)


def surface_covariances(
    cloud: PointCloud,
    covariances: Mapping[str, Float[ArrayLike, "N 3 3"]],
    *,
    indices: Sequence[int] | Int[np.ndarray, "M"],
    path: str | os.PathLike[str] | None = None,
) -> matplotlib.figure.Figure:
    """Covariances within a flat surface as ellipses over its picture, a panel for each name.

    All are drawn to one scale, at which a standard deviation of 1 just has room among the others.

    Args:
        covariances: (N, 3, 3) for the rows of `cloud.points`, by name.
        indices: the rows to draw.
        path: a file to save the figure in; its ending tells the format.

    Raises:
        ValueError: if covariances have another shape.
        ImportError: if matplotlib is missing.
    """
    figures, collections = _module("matplotlib.figure"), _module("matplotlib.collections")
    raw, rows = _drawable(cloud), np.asarray(indices, int)
    view = _view(np.asarray(raw.points), _MAP_PIXELS)
    # The cloud as the covariances go by, and what its picture is painted from.
    centers = cloud.coordinates[rows]
    places = ((centers - view.center) @ view.axes)[:, :2] - view.low
    room = 2 * _room(centers, float(np.ptp(np.asarray(raw.points), axis=0).max()))
    picture = np.nan_to_num(_paint(view, np.asarray(raw.points), _shades(raw, view)), nan=1)
    width = _WIDEST / len(covariances)
    figure = figures.Figure((_WIDEST, width * view.height / view.width + 0.35), layout="constrained")
    panels = figure.subplots(1, len(covariances), squeeze=False)[0]
    for panel, (name, values) in zip(panels, covariances.items(), strict=True):
        matrices = np.asarray(values, float)
        if matrices.shape != (cloud.points.shape[0], 3, 3):
            raise ValueError(
                f"covariances[{name!r}]: expected shape ({cloud.points.shape[0]}, 3, 3), got {matrices.shape}"
            )
        flat = view.axes[:, :2].T @ matrices[rows] @ view.axes[:, :2]
        sizes, vectors = np.linalg.eigh(flat)
        lengths = room * np.sqrt(np.maximum(sizes, 0))
        angles = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
        ellipses = collections.EllipseCollection(
            lengths[:, 1],
            lengths[:, 0],
            angles,
            units="xy",
            offsets=places,
            transOffset=panel.transData,
            facecolors="none",
            edgecolors="black",
            linewidths=1.2,
        )
        panel.imshow(picture, origin="lower", extent=(0, view.width * view.pixel, 0, view.height * view.pixel))
        panel.add_collection(ellipses)
        panel.set_title(name, fontsize="medium")
        panel.set(xticks=[], yticks=[], xlim=(0, view.width * view.pixel), ylim=(0, view.height * view.pixel))
    if path is not None:
        figure.savefig(path, dpi=120)
    return figure


# In three dimensions


def clouds(*clouds: PointCloud, names: Sequence[str] | None = None) -> plotly.graph_objects.Figure:
    """Clouds in one 3-D view, in their own colours (red, green, blue), else by intensity, else in a colour per cloud.

    Of more than 50,000 points in all, so many are drawn, chosen at random but always the same.

    Args:
        names: one per cloud, for the legend.

    Raises:
        ValueError: if there are not as many names as clouds.
        ImportError: if plotly is missing.
    """
    graphs = _module("plotly.graph_objects")
    if names is None:
        names = [f"cloud {i}" for i in range(len(clouds))]
    if len(names) != len(clouds):
        raise ValueError(f"names: expected {len(clouds)}, one per cloud, got {len(names)}")
    share = min(1.0, _MOST_POINTS / max(sum(len(cloud) for cloud in clouds), 1))
    figure = _figure(graphs)
    for i, (cloud, name) in enumerate(zip(clouds, names, strict=True)):
        figure.add_trace(_scatter(graphs, cloud, name, _CLOUD_COLORS[i % len(_CLOUD_COLORS)], share))
    return figure


def covariances(
    cloud: PointCloud, covariances: Float[ArrayLike, "N 3 3"], *, indices: Sequence[int] | Int[np.ndarray, "M"]
) -> plotly.graph_objects.Figure:
    """Covariances as ellipsoids about some of the points, as in the paper's Fig. 1.

    An ellipsoid's semi-axes are the standard deviations, all of them drawn to one scale at which neighbours among the
    ellipsoids just have room.

    Args:
        covariances: (N, 3, 3), for the rows of `cloud.points`.
        indices: the rows to draw.

    Raises:
        ValueError: if the covariances have another shape, or an index is out of range.
        ImportError: if plotly is missing.
    """
    graphs = _module("plotly.graph_objects")
    matrices, rows = np.asarray(covariances, float), np.asarray(indices, int)
    size = cloud.points.shape[0]
    if matrices.shape != (size, 3, 3):
        raise ValueError(f"covariances: expected shape ({size}, 3, 3), got {matrices.shape}")
    if rows.ndim != 1 or rows.size == 0 or rows.min() < 0 or rows.max() >= size:
        raise ValueError(f"indices: expected rows of the cloud, from 0 to {size - 1}, got {indices}")
    centers = cloud.coordinates[rows]
    extent = float(np.ptp(_drawable(cloud).points, axis=0).max())
    figure = _figure(graphs)
    figure.add_trace(_scatter(graphs, cloud, "points", "#a0a0a0", min(1.0, _MOST_POINTS / max(len(cloud), 1))))
    figure.add_trace(_ellipsoids(graphs, centers, matrices[rows], _room(centers, extent)))
    return figure


def _figure(graphs: Any) -> plotly.graph_objects.Figure:
    layout = {"scene": {"aspectmode": "data"}, "legend": {"itemsizing": "constant"}, "margin": dict.fromkeys("lrtb", 0)}
    return graphs.Figure(layout=layout)


def _scatter(graphs: Any, cloud: PointCloud, name: str, color: str, share: float) -> Any:
    cloud = _drawable(cloud)
    kept = np.random.default_rng(0).permutation(len(cloud))[: round(share * len(cloud))]
    rgb = _rgb(cloud)
    marker: dict[str, Any] = {"size": 1.5, "color": color}
    if rgb is not None:
        marker["color"] = [f"rgb({r},{g},{b})" for r, g, b in np.round(255 * rgb[kept]).astype(int)]
    elif _everywhere(cloud, ("intensity",)) and len(cloud):
        intensity = np.asarray(cloud.channels)[:, cloud.channel_names.index("intensity")]
        low, high = np.nanpercentile(intensity, [2, 98])
        marker |= {"color": intensity[kept], "colorscale": "Viridis", "cmin": low, "cmax": high}
    x, y, z = np.asarray(cloud.points)[kept].T
    return graphs.Scatter3d(x=x, y=y, z=z, mode="markers", name=name, marker=marker, showlegend=True)


def _ellipsoids(
    graphs: Any, centers: Float[np.ndarray, "M 3"], matrices: Float[np.ndarray, "M 3 3"], room: float
) -> Any:
    """One mesh of them all, the longest semi-axis `room` metres."""
    sphere, faces = _sphere()
    values, vectors = np.linalg.eigh(matrices)
    axes = vectors * np.sqrt(np.maximum(values, 0))[:, None, :]
    scale = room / np.sqrt(max(values.max(), np.finfo(float).tiny))
    vertices = centers[:, None] + scale * sphere @ np.swapaxes(axes, 1, 2)
    i, j, k = (faces + len(sphere) * np.arange(len(centers))[:, None, None]).reshape(-1, 3).T
    x, y, z = vertices.reshape(-1, 3).T
    return graphs.Mesh3d(
        x=x, y=y, z=z, i=i, j=j, k=k, name="covariances", color=_CLOUD_COLORS[1], opacity=0.7, showlegend=True
    )


def _room(centers: Float[np.ndarray, "M 3"], extent: float) -> float:
    """Half the median distance from a centre to the next, but no more than a tenth of the extent; metres."""
    distances = np.linalg.norm(centers[:, None] - centers, axis=-1)
    np.fill_diagonal(distances, np.inf)
    return min(float(np.median(distances.min(axis=1))) / 2, extent / 10)


def _sphere(rings: int = 8, segments: int = 16) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Vertices on the unit sphere, and triangles between them."""
    polar, azimuth = np.meshgrid(
        np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, segments, endpoint=False), indexing="ij"
    )
    vertices = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    ring, segment = np.mgrid[:rings, :segments]
    here, beside = ring * segments + segment, ring * segments + (segment + 1) % segments
    below, across = here + segments, beside + segments
    faces = np.concatenate([np.stack([here, below, beside], -1), np.stack([beside, below, across], -1)])
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def _drawable(cloud: PointCloud) -> PointCloud:
    """The finite points and their channels, as NumPy arrays in float64."""
    cloud = cloud.unpad()
    points = np.asarray(cloud.points, np.float64)
    finite = np.isfinite(points).all(axis=1)
    return PointCloud(
        points[finite],
        np.asarray(cloud.channels)[finite],
        channel_valid=None if cloud.channel_valid is None else np.asarray(cloud.channel_valid)[finite],
        channel_names=cloud.channel_names,
    )


def _everywhere(cloud: PointCloud, names: tuple[str, ...]) -> bool:
    """Whether every point has all of these channels."""
    if not set(names) <= set(cloud.channel_names):
        return False
    columns = [cloud.channel_names.index(name) for name in names]
    return cloud.channel_valid is None or bool(np.asarray(cloud.channel_valid)[:, columns].all())


def _rgb(cloud: PointCloud) -> Points | None:
    """Colours in 0..1 from channels in 0..1, 0..255 or 0..65535; None if not every point has one."""
    names = ("red", "green", "blue")
    if not _everywhere(cloud, names):
        return None
    channels = np.asarray(cloud.channels, float)[:, [cloud.channel_names.index(name) for name in names]]
    largest = channels.max(initial=0)
    full_scale = next((scale for scale in (1, 255) if largest <= scale), 65535)
    return np.clip(channels / full_scale, 0, 1)


def check_picture(path: str | os.PathLike[str]) -> None:
    """Raise `ValueError` for a file that no picture can be saved in, by its ending."""
    kinds = _module("matplotlib.figure").Figure().canvas.get_supported_filetypes()
    suffix = os.path.splitext(path)[1]
    if suffix.lower().removeprefix(".") not in kinds:
        raise ValueError(f"{os.fspath(path)}: unknown suffix {suffix!r}; there are .{', .'.join(kinds)}")


def _module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"plotting needs {name.partition('.')[0]}: pip install 'mcgicp_jax[plot]'") from error
