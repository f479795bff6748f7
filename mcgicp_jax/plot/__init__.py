"""Figures of clouds and registrations: 2-D with matplotlib, interactive 3-D with plotly, both imported on demand.

Every function returns its figure; none opens a window or changes matplotlib's global state.
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

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._math.poses import Pose, pose_matrix
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._methods.surfaces import covariances_of
from mcgicp_jax._pose_graph.factors import WORLD
from mcgicp_jax._pose_graph.optimize import PoseGraphResult
from mcgicp_jax._pose_solver.degeneracy import CHANNELS_HOLD, GEOMETRY_HOLDS, shares
from mcgicp_jax._registration.result import Registration

if TYPE_CHECKING:
    import matplotlib.figure
    import plotly.graph_objects

Points: TypeAlias = Float[np.ndarray, "N 3"]
Picture: TypeAlias = Float[np.ndarray, "height width 3"]
Map: TypeAlias = Float[np.ndarray, "height width"]

# The constants of this module affect only how figures look.
_CLOUD_COLORS = ("#1f77d0", "#e8741c", "#2b9c5a", "#b03a8c", "#7a5230", "#707070")
# Points drawn in one 3-D figure.
_MOST_POINTS = 50_000

# before_after: most rows below each other; maximum width of a row and height of a panel, inches; pixels and tiles along
# the longer side of a panel; fraction of each side that the detail shows.
_MOST_ROWS, _WIDEST, _HIGHEST, _PIXELS, _TILES, _DETAIL = 5, 12, 4.5, 500, 12, 0.25
# Residual at the end of the colour scale of a graph, standard deviations: beyond it, uncertain edges are rejected.
_LARGEST_RESIDUAL = 4.1
# Pixels along the longer side of a map.
_MAP_PIXELS = 1400
# Pixels per point spacing, unless the limit on the pixels of a picture makes them coarser.
_PIXELS_PER_SPACING = 3


def before_after(
    source: PointCloud, target: PointCloud, poses: Mapping[str, Pose], *, path: str | os.PathLike[str] | None = None
) -> matplotlib.figure.Figure:
    """Compare poses: one row per pose shows the transformed source with the target, along the target's thinnest axis.

    More than five rows are laid out side by side.

    If all points have the channels red, green and blue, target and source alternate in a checkerboard, in which
    patterns continue across tiles where the pose is right; a further panel shows the colour difference. Otherwise the
    clouds are overlaid, the target in blue and the source in orange, black where both are. Upright surfaces are drawn
    dark and flat ones pale, since the rings of a LiDAR on the ground move with the sensor. The detail shows the region
    where the poses differ most.

    Args:
        source, target: clouds in their own frames.
        poses: `T_target_source` by name, such as that of the method. The first row, "start", is the identity unless
            `poses` has a "start".
        path: file to save the figure to; its suffix selects the format.

    Raises:
        ValueError: if a pose is no rigid motion, or the target has fewer than 3 points.
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
    beside = -(-len(rows) // _MOST_ROWS)
    below = -(-len(rows) // beside)
    figure = figures.Figure((beside * (len(headings) * width + 0.3), below * height + 0.3), layout="constrained")
    columns = figure.subplots(below, beside * len(headings), squeeze=False)
    panels = np.concatenate(np.split(columns, beside, axis=1))
    for first in panels[::below]:
        for panel, heading in zip(first, headings, strict=True):
            panel.set_title(heading)
    for row, name, (picture, difference) in zip(panels, named, rows, strict=False):
        _draw_row(row, name, picture, difference, detail)
    for panel in panels[len(rows) :].flat:
        panel.set_visible(False)
    if path is not None:
        figure.savefig(path, dpi=120)
    return figure


def _draw_row(panels: np.ndarray, name: str, picture: Picture, difference: Map, detail: tuple[slice, slice]) -> None:
    columns, rows = detail
    left, right, bottom, top = columns.start, columns.stop, rows.start, rows.stop
    # Pixel i extends from i to i + 1, in agreement with the slices.
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
    """An orthographic projection of points to the pixels of a plane.

    Attributes:
        center: (3,), metres, a point of the plane.
        axes: (3, 3), columns: right, up, and the normal towards the viewer.
        low: (2,), metres, the lower left corner in the plane.
        pixel: side of a pixel, metres.
        width, height: pixels.
    """

    center: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    low: Float[np.ndarray, "2"]
    pixel: float
    width: int
    height: int

    def project(self, points: Points) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N"]]:
        """The row-major pixel index of each point, −1 if outside, and its height above the plane in metres."""
        local = (points - self.center) @ self.axes
        column, row = np.floor((local[:, :2] - self.low) / self.pixel).astype(int).T
        inside = (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        return np.where(inside, row * self.width + column, -1), local[:, 2]


def _view(
    points: Points,
    most_pixels: int = _PIXELS,
    limits: Float[np.ndarray, "2 2"] | None = None,
) -> _View:
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
    """For each moved source a checkerboard picture, and the colour difference, NaN where either cloud has no points."""
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
    """The mean colour of the points in each pixel, extended into the gaps between points; NaN further away."""
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
    """The picture shifted by one pixel, with the edge row or column repeated."""
    rows = np.clip(np.arange(picture.shape[axis]) - shift, 0, picture.shape[axis] - 1)
    return np.take(picture, rows, axis)


def _smooth(picture: Picture) -> Picture:
    """Mean over a window a little larger than the point spacing, so that differences do not show the sampling."""
    half = _PIXELS_PER_SPACING // 2 + 1
    padded = np.pad(picture, ((half, half), (half, half), (0, 0)), mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, (2 * half + 1,) * 2, (0, 1)).mean(axis=(-1, -2))


def _overlays(view: _View, target: Float[np.ndarray, "M 3"], moved: Sequence[Points]) -> list[tuple[Picture, Map]]:
    """For each moved source a picture of both clouds, and the difference of their inks."""
    ours = _ink(view, target)
    overlays = []
    for points in moved:
        theirs = _ink(view, points)
        # Subtractive colours: the target removes all red, the source all blue, and each half of the green.
        picture = 1 - np.stack([ours, 0.5 * ours + 0.5 * theirs, theirs], axis=-1)
        overlays.append((picture, np.abs(ours - theirs)))
    return overlays


def _ink(view: _View, points: Points) -> Map:
    """Ink per pixel: 0 without points, 0.15 on flat surfaces, 1 where the points are at least four pixels high."""
    pixels, height = view.project(points)
    lowest, highest = np.full(view.height * view.width, np.inf), np.full(view.height * view.width, -np.inf)
    inside = pixels >= 0
    np.minimum.at(lowest, pixels[inside], height[inside])
    np.maximum.at(highest, pixels[inside], height[inside])
    stands = np.clip((highest - lowest) / (4 * view.pixel), 0.15, 1)
    return np.where(highest >= lowest, stands, 0).reshape(view.height, view.width)


def _where_they_differ(differences: Sequence[Map]) -> tuple[slice, slice]:
    """Columns and rows of the detail: the window whose summed difference varies most between the poses."""
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
    """Plot the cost or RMSE per iteration, on a logarithmic scale.

    Args:
        histories: one number per iteration, by the name of the method.
        ylabel: label of the y axis: the quantity and its unit.

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
    """Plot how well each of six directions is constrained: the observed fraction of squared motion.

    The fraction refers to the motion of the matched points. One bar is for the geometry and one for the channels, which
    count only in directions that the geometry leaves free. Dashed lines mark the fractions above which a direction
    counts as constrained.

    Args:
        result: a single result of `register`.
        path: file to save the figure to; its suffix selects the format.

    Raises:
        ValueError: if the result is a batch or has no directions, such as a result of `align`.
        ImportError: if matplotlib is missing.
    """
    if result.directions is None or np.ndim(result.status_code):
        raise ValueError("result: expected a single result of `register`, got a batch or one without directions")
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
    panel.set(xscale="log", xlim=(lowest, 1), xlabel="observed fraction of the points' squared motion")
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
    """Plot trajectories in the principal plane of the first one.

    Args:
        trajectories: poses by name, sensor to a common world, metres.
        path: file to save the figure to; its suffix selects the format.

    Raises:
        ValueError: if a trajectory is empty, or a pose is no rigid motion.
        ImportError: if matplotlib is missing.
    """
    figures = _module("matplotlib.figure")
    figure = figures.Figure((7, 5), layout="constrained")
    panel = figure.subplots()
    plane, start = None, None
    for name, poses in trajectories.items():
        positions = np.array([pose_matrix(pose, f"trajectories[{name!r}][{i}]")[:3, 3] for i, pose in enumerate(poses)])
        if not len(positions):
            raise ValueError(f"trajectories[{name!r}]: expected at least one pose, got none")
        if plane is None or start is None:
            start = positions[0]
            plane = np.linalg.svd(positions - positions.mean(axis=0))[2][:2]
            # The first axis points in the direction of travel.
            plane[0] *= 1 if (positions[-1] - start) @ plane[0] >= 0 else -1
        along, across = plane @ (positions - start).T
        panel.plot(along, across, marker=".", markersize=4, linewidth=1, label=name)
    panel.set(xlabel="metres", ylabel="metres", aspect="equal", adjustable="datalim")
    panel.grid(alpha=0.3)
    panel.legend()
    if path is not None:
        figure.savefig(path, dpi=120)
    return figure


def graph(graph: PoseGraphResult, *, path: str | os.PathLike[str] | None = None) -> matplotlib.figure.Figure:
    """Plot the poses of a graph in their principal plane, and its edges coloured by residual in standard deviations.

    Rejected edges are dashed. A prior is drawn from the position that it measured.

    Args:
        graph: result of `optimize_poses`, such as `MultiwayResult.graph`.
        path: file to save the figure to; its suffix selects the format.

    Raises:
        ImportError: if matplotlib is missing.
    """
    figures, collections = _module("matplotlib.figure"), _module("matplotlib.collections")
    positions = np.asarray(graph.poses)[:, :3, 3]
    centre = positions.mean(axis=0)
    # The eigenvectors of the two largest eigenvalues, which come last.
    axes = np.linalg.eigh((positions - centre).T @ (positions - centre))[1][:, :0:-1]
    kept, residuals, i = np.asarray(graph.kept), np.asarray(graph.residuals), np.asarray(graph.edges.i)
    priors = (i == WORLD)[:, None]
    starts = np.where(priors, np.asarray(graph.edges.T_i_j)[:, :3, 3], positions[np.where(priors[:, 0], 0, i)])
    segments = (np.stack([starts, positions[np.asarray(graph.edges.j)]], axis=1) - centre) @ axes
    figure = figures.Figure((7, 5), layout="constrained")
    panel = figure.subplots()
    for chosen, style in ((kept, "solid"), (~kept, "dashed")):
        lines = collections.LineCollection(segments[chosen], linestyles=style, linewidths=1, cmap="viridis")
        lines.set_array(residuals[chosen])
        lines.set_clim(0, _LARGEST_RESIDUAL)
        panel.add_collection(lines)
        if style == "solid":
            figure.colorbar(lines, ax=panel, label="residual, standard deviations", extend="max")
    panel.plot(*((positions - centre) @ axes).T, marker=".", markersize=4, linestyle="none", color="black")
    panel.set(xlabel="metres", ylabel="metres", aspect="equal", adjustable="datalim")
    panel.grid(alpha=0.3)
    if path is not None:
        figure.savefig(path, dpi=120)
    return figure


def maps(
    maps: Mapping[str, PointCloud],
    *,
    limits: Float[np.ndarray, "2 2"] | None = None,
    path: str | os.PathLike[str] | None = None,
) -> matplotlib.figure.Figure:
    """Draw clouds of a common world, one panel each, along the thinnest principal axis of the first cloud.

    Clouds with the channels red, green and blue are drawn in colour; others in grey, by intensity or height.

    Args:
        maps: clouds by name, such as those of `aggregate`.
        limits: (2, 2), rows: lower and upper limit along the horizontal and vertical axis of the picture, in metres
            from the centroid of the first cloud; by default 96 % of its points along each axis, plus a margin.
        path: file to save the figure to; its suffix selects the format.

    Raises:
        ValueError: if there are no clouds, or the first has fewer than 3 points.
        ImportError: if matplotlib is missing.
    """
    figures = _module("matplotlib.figure")
    drawn = {name: _drawable(cloud) for name, cloud in maps.items()}
    if not drawn or len(next(iter(drawn.values()))) < 3:
        raise ValueError("maps: expected at least one cloud, the first with at least 3 points")
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
    """Colours of the points from red, green and blue if present, else grey from intensity or height."""
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
    covariances: Mapping[str, AbstractMethod | Float[ArrayLike, "N 3 3"]],
    *,
    indices: Sequence[int] | Int[np.ndarray, "M"],
    limits: Float[np.ndarray, "2 2"] | None = None,
    path: str | os.PathLike[str] | None = None,
) -> matplotlib.figure.Figure:
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
    figures = _module("matplotlib.figure")
    raw, rows = _drawable(cloud), np.asarray(indices, int)
    view = _view(np.asarray(raw.points), _MAP_PIXELS, limits)
    # The indices refer to the rows of `cloud`; `raw`, which the picture shows, lacks padding and non-finite points.
    centers = cloud.coordinates[rows]
    offsets = ((centers - view.center) @ view.axes)[:, :2] - view.low
    room = 2 * _room(centers, float(np.ptp(np.asarray(raw.points), axis=0).max()))
    picture = np.nan_to_num(_paint(view, np.asarray(raw.points), _shades(raw, view)), nan=1)
    width = _WIDEST / len(covariances)
    figure = figures.Figure((_WIDEST, width * view.height / view.width + 0.35), layout="constrained")
    panels = figure.subplots(1, len(covariances), squeeze=False)[0]
    for panel, (name, values) in zip(panels, covariances.items(), strict=True):
        matrices = np.asarray(
            covariances_of(values, cloud) if isinstance(values, AbstractMethod) else values, np.float64
        )
        if matrices.shape != (cloud.points.shape[0], 3, 3):
            raise ValueError(
                f"covariances[{name!r}]: expected shape ({cloud.points.shape[0]}, 3, 3), got {matrices.shape}"
            )
        flat = view.axes[:, :2].T @ matrices[rows] @ view.axes[:, :2]
        panel.imshow(picture, origin="lower", extent=(0, view.width * view.pixel, 0, view.height * view.pixel))
        _add_ellipses(panel, offsets, flat, room)
        panel.set_title(name, fontsize="medium")
        panel.set(xticks=[], yticks=[], xlim=(0, view.width * view.pixel), ylim=(0, view.height * view.pixel))
    if path is not None:
        figure.savefig(path, dpi=120)
    return figure


def _add_ellipses(
    panel: Any, offsets: Float[np.ndarray, "M 2"], covariances: Float[np.ndarray, "M 2 2"], scale: float
) -> None:
    """Draw ellipses at `offsets`, metres, whose axes are `scale` metres long per standard deviation."""
    sizes, vectors = np.linalg.eigh(covariances)
    lengths = scale * np.sqrt(np.maximum(sizes, 0))
    ellipses = _module("matplotlib.collections").EllipseCollection(
        lengths[:, 1],
        lengths[:, 0],
        np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])),
        units="xy",
        offsets=offsets,
        transOffset=panel.transData,
        facecolors="none",
        edgecolors="black",
        linewidths=1.2,
    )
    panel.add_collection(ellipses)


# In three dimensions


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
    graphs = _module("plotly.graph_objects")
    if names is None:
        names = [f"cloud {i}" for i in range(len(clouds))]
    if len(names) != len(clouds):
        raise ValueError(f"names: expected {len(clouds)}, one per cloud, got {len(names)}")
    fraction = min(1.0, _MOST_POINTS / max(sum(len(cloud) for cloud in clouds), 1))
    figure = _figure(graphs)
    for i, (cloud, name) in enumerate(zip(clouds, names, strict=True)):
        figure.add_trace(_scatter(graphs, cloud, name, _CLOUD_COLORS[i % len(_CLOUD_COLORS)], fraction))
    return figure


def covariances(
    cloud: PointCloud, covariances: Float[ArrayLike, "N 3 3"], *, indices: Sequence[int] | Int[np.ndarray, "M"]
) -> plotly.graph_objects.Figure:
    """Show covariances of selected points as ellipsoids, as in Fig. 1 of Servos & Waslander (2014).

    The semi-axes are proportional to the standard deviations, with a common scale at which neighbouring ellipsoids
    just do not overlap.

    Args:
        cloud: raw or preprocessed cloud.
        covariances: (N, 3, 3) for the rows of `cloud.points`, dimensionless.
        indices: rows to draw.

    Raises:
        ValueError: if the covariances have the wrong shape, or an index is out of range.
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


def _scatter(graphs: Any, cloud: PointCloud, name: str, color: str, fraction: float) -> Any:
    """Draw a reproducible random fraction of the points, in `color` if the cloud has neither colours nor intensity."""
    cloud = _drawable(cloud)
    kept = np.random.default_rng(0).permutation(len(cloud))[: round(fraction * len(cloud))]
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
    """One mesh of all ellipsoids, scaled so that the longest semi-axis has `room` metres."""
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
    """Half the median distance from a centre to its nearest neighbour, at most a tenth of `extent`; metres."""
    distances = np.linalg.norm(centers[:, None] - centers, axis=-1)
    np.fill_diagonal(distances, np.inf)
    return min(float(np.median(distances.min(axis=1))) / 2, extent / 10)


def _sphere(rings: int = 8, segments: int = 16) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Vertices and triangles of a mesh of the unit sphere."""
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
    """Colours in 0..1 from channels in 0..1, 0..255 or 0..65535; None unless every point has a colour."""
    names = ("red", "green", "blue")
    if not _everywhere(cloud, names):
        return None
    channels = np.asarray(cloud.channels, float)[:, [cloud.channel_names.index(name) for name in names]]
    largest = channels.max(initial=0)
    full_scale = next((scale for scale in (1, 255) if largest <= scale), 65535)
    return np.clip(channels / full_scale, 0, 1)


def check_picture(path: str | os.PathLike[str]) -> None:
    """Raise `ValueError` if matplotlib cannot save figures to a file with this suffix."""
    kinds = _module("matplotlib.figure").Figure().canvas.get_supported_filetypes()
    suffix = os.path.splitext(path)[1]
    if suffix.lower().removeprefix(".") not in kinds:
        raise ValueError(f"{os.fspath(path)}: unknown suffix {suffix!r}; expected one of .{', .'.join(kinds)}")


def _module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"plotting needs {name.partition('.')[0]}: pip install 'mcgicp_jax[plot]'") from error
