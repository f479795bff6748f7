"""Pictures of clouds: before and after registration, from above, in three dimensions; covariances on a surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Int

import mcgicp_jax.plot.drawing as drawing
from mcgicp_jax._clouds.point_cloud import PointCloud, Values, as_cloud
from mcgicp_jax._clouds.voxel_size import raw_spacing
from mcgicp_jax._math.poses import Pose, checked_pose_matrix
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._methods.surfaces import covariances_of
from mcgicp_jax.plot.drawing import Figure, File, Map, Picture, Points, View

if TYPE_CHECKING:
    import plotly.graph_objects

# The constants affect only how figures look.
# Most rows below each other; maximum width of a row and height of a panel, inches.
_MOST_ROWS, _WIDEST, _HIGHEST = 5, 12, 4.5
# Pixels and tiles along the longer side of a panel; fraction of each side in the detail; most pixels of a point.
_PANEL_PIXELS, _TILES, _DETAIL, _LARGEST_POINT = 500, 12, 0.25, 9
# Pixels along the longer side of a map, and width of a figure in inches.
_PIXELS, _WIDTH = 1400, 12
# Points drawn in one 3-D figure, and colours there of clouds without channels.
_MOST_POINTS = 50_000
_COLORS = ("#1f77d0", "#e8741c", "#2b9c5a", "#b03a8c", "#7a5230", "#707070")


def before_after(
    source: PointCloud | Values, target: PointCloud | Values, poses: Mapping[str, Pose], *, path: File = None
) -> Figure:
    """Compare poses: one row per pose shows the transformed source with the target, along the target's thinnest axis.

    If all points have the channels red, green and blue, target and source alternate in a checkerboard, in which
    patterns continue across tiles where the pose is right; a further panel shows the colour difference. Otherwise the
    clouds are overlaid, the target in blue and the source in orange, black where both are, points of the sparser cloud
    larger by the ratio of the spacings. Upright surfaces are drawn dark and flat ones pale, since the rings of a LiDAR
    on the ground move with the sensor. The detail shows the region where the poses differ most. More than five rows are
    laid out side by side.

    Args:
        source, target: clouds in their own frames.
        poses: `T_target_source` by name, for instance of the method. The first row, "start", is the identity unless
            `poses` has a "start".
        path: file to save the figure to; its suffix selects the format.

    Raises:
        ValueError: if a pose is no rigid motion, or the target has fewer than 3 points.
        ImportError: if matplotlib is missing.
    """
    poses = {"start": np.eye(4)} | drawing.by_name("poses", poses, '{"GICP": result.matrix}')
    matrices = {name: checked_pose_matrix(pose, f"poses[{name!r}]") for name, pose in poses.items()}
    source, target = drawing.drawable("source", source), drawing.drawable("target", target)
    if len(target) < 3:
        raise ValueError(f"target: expected at least 3 points, got {len(target)}")
    moved = {name: np.asarray(source.transform(matrix).unpad().points) for name, matrix in matrices.items()}
    source_colors, target_colors = drawing.rgb_of(source), drawing.rgb_of(target)
    target_points = np.asarray(target.points)
    view = drawing.view_onto(target_points, _PANEL_PIXELS)
    # Picture and difference of each pose.
    rows: dict[str, tuple[Picture, Map]] = {}
    if source_colors is not None and target_colors is not None:
        # Checkerboards, and the difference of smoothed colours, NaN where either cloud has no points.
        tile = max(view.width, view.height) // _TILES + 1
        row, column = np.mgrid[: view.height, : view.width] // tile
        of_target = ((row + column) % 2 == 0)[..., None]
        target_picture = drawing.paint(view, target_points, target_colors)
        target_smooth = _smooth(target_picture)
        for name, points in moved.items():
            source_picture = drawing.paint(view, points, source_colors)
            board = np.nan_to_num(np.where(of_target, target_picture, source_picture), nan=1)
            rows[name] = board, np.abs(target_smooth - _smooth(source_picture)).mean(axis=-1)
        headings = ["target and source in alternate tiles", "detail", "difference of colour"]
    else:
        spacings = np.maximum([raw_spacing(target), raw_spacing(source)], np.finfo(float).tiny)
        target_size, source_size = np.minimum(spacings / spacings.min(), _LARGEST_POINT)
        target_ink = _ink(view, target_points, target_size)
        for name, points in moved.items():
            source_ink = _ink(view, points, source_size)
            # Subtractive colours: the target removes all red, the source all blue, and each half of the green.
            picture = 1 - np.stack([target_ink, 0.5 * target_ink + 0.5 * source_ink, source_ink], axis=-1)
            rows[name] = picture, np.abs(target_ink - source_ink)
        headings = ["target blue, source orange, both black", "detail"]
    # The detail is the window whose summed difference varies most between the poses.
    high, wide = (max(int(_DETAIL * side), 1) for side in (view.height, view.width))
    sums = []
    for _, difference in rows.values():
        table = np.pad(np.nan_to_num(difference), ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
        across = table[:, wide:] - table[:, :-wide]
        sums.append(across[high:] - across[:-high])
    bottom, left = map(int, np.unravel_index(np.argmax(np.ptp(sums, axis=0)), sums[0].shape))
    headings[1] = f"detail, {wide * view.pixel:.2g} m wide"
    return drawing.saved(_compared(rows, headings, view, (left, left + wide, bottom, bottom + high)), path)


def _compared(
    rows: Mapping[str, tuple[Picture, Map]], headings: Sequence[str], view: View, detail: tuple[int, int, int, int]
) -> Figure:
    """Picture, detail and, if there is a third heading, difference of each pose; `detail`: left, right, bottom, top."""
    width = min(_WIDEST / len(headings), _HIGHEST * view.width / view.height)
    height = width * view.height / view.width + 0.3
    beside = -(-len(rows) // _MOST_ROWS)
    below = -(-len(rows) // beside)
    figure = drawing.new_figure(beside * (len(headings) * width + 0.3), below * height + 0.3)
    columns = figure.subplots(below, beside * len(headings), squeeze=False)
    panels = np.concatenate(np.split(columns, beside, axis=1))
    for top_row in panels[::below]:
        for panel, heading in zip(top_row, headings, strict=True):
            panel.set_title(heading)
    left, right, bottom, top = detail
    for row, (name, (picture, difference)) in zip(panels, rows.items(), strict=False):
        # Pixel i extends from i to i + 1.
        options = {"origin": "lower", "interpolation": "nearest", "extent": (0, view.width, 0, view.height)}
        for panel in row[:2]:
            panel.imshow(picture, **options)
        row[0].plot([left, right, right, left, left], [bottom, bottom, top, top, bottom], color="black", linewidth=1)
        row[0].set_ylabel(name, fontsize="large", fontweight="bold")
        row[1].set(xlim=(left, right), ylim=(bottom, top))
        if len(row) > 2:
            row[2].imshow(difference, **options, cmap="magma", vmin=0, vmax=0.4)
            both = np.isfinite(difference)
            row[2].set_xlabel(f"mean {difference[both].mean():.3f}" if both.any() else "no overlap")
        for panel in row:
            panel.set(xticks=[], yticks=[])
    for panel in panels[len(rows) :].flat:
        panel.set_visible(False)
    return figure


def _smooth(picture: Picture) -> Picture:
    """Mean over a window a little larger than the point spacing, so that differences do not show the sampling."""
    half = drawing.PIXELS_PER_SPACING // 2 + 1
    padded = np.pad(picture, ((half, half), (half, half), (0, 0)), mode="edge")
    for axis in (0, 1):
        padded = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis).mean(axis=-1)
    return padded


def _ink(view: View, points: Points, size: float) -> Map:
    """Ink per pixel: 0 without points, 0.15 on flat surfaces, 1 where the points are at least four pixels high."""
    from scipy.ndimage import maximum_filter, minimum_filter

    pixels, height = view.project(points)
    lowest, highest = np.full(view.height * view.width, np.inf), np.full(view.height * view.width, -np.inf)
    inside = pixels >= 0
    np.minimum.at(lowest, pixels[inside], height[inside])
    np.maximum.at(highest, pixels[inside], height[inside])
    highest = maximum_filter(highest.reshape(view.height, view.width), round(size))
    lowest = minimum_filter(lowest.reshape(view.height, view.width), round(size))
    return np.where(highest >= lowest, np.clip((highest - lowest) / (4 * view.pixel), 0.15, 1), 0)


def maps(
    maps: Mapping[str, PointCloud | Values], *, limits: Float[np.ndarray, "2 2"] | None = None, path: File = None
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
    maps = drawing.by_name("maps", maps, '{"map": cloud}')
    drawn = {name: drawing.drawable(f"maps[{name!r}]", cloud) for name, cloud in maps.items()}
    first = next(iter(drawn.values()), None)
    if first is None or len(first) < 3:
        raise ValueError("maps: expected at least one cloud, the first with at least 3 points")
    view = drawing.view_onto(np.asarray(first.points), _PIXELS, limits)
    shape = (len(drawn), 1) if view.width > 1.5 * view.height else (1, len(drawn))
    width = _WIDTH / shape[1]
    figure = drawing.new_figure(width * shape[1], (width * (view.height / view.width) + 0.35) * shape[0])
    for panel, (name, cloud) in zip(figure.subplots(*shape, squeeze=False).ravel(), drawn.items(), strict=True):
        panel.imshow(_shaded(cloud, view), origin="lower", interpolation="nearest", extent=view.extent)
        panel.set_title(name, fontsize="medium")
        panel.set_xlabel("metres", fontsize="small")
        panel.set_ylabel("metres", fontsize="small")
        panel.tick_params(labelsize="x-small")
    return drawing.saved(figure, path, bbox_inches="tight")


def surface_covariances(
    cloud: PointCloud | Values,
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
    collections = drawing.plotting("matplotlib.collections")
    covariances = drawing.by_name("covariances", covariances, '{"GICP": mcgicp_jax.GICP()}')
    cloud = as_cloud("cloud", cloud)
    raw, rows = drawing.drawable("cloud", cloud), np.asarray(indices, int)
    view = drawing.view_onto(np.asarray(raw.points), _PIXELS, limits)
    # The indices refer to the rows of `cloud`; `raw`, which the picture shows, lacks padding and non-finite points.
    centers = cloud.coordinates[rows]
    offsets = ((centers - view.center) @ view.axes)[:, :2] - view.low
    extent = float(np.ptp(np.asarray(raw.points), axis=0).max())
    distances = np.linalg.norm(centers[:, None] - centers, axis=-1)
    np.fill_diagonal(distances, np.inf)
    room = min(float(np.median(distances.min(axis=1))), extent / 5)
    picture = _shaded(raw, view)
    width = _WIDTH / len(covariances)
    figure = drawing.new_figure(_WIDTH, width * view.height / view.width + 0.35)
    panels = figure.subplots(1, len(covariances), squeeze=False)[0]
    for panel, (name, values) in zip(panels, covariances.items(), strict=True):
        values = covariances_of(values, cloud) if isinstance(values, AbstractMethod) else values
        matrices, size = np.asarray(values, np.float64), cloud.points.shape[0]
        if matrices.shape != (size, 3, 3):
            raise ValueError(f"covariances[{name!r}]: expected shape ({size}, 3, 3), got {matrices.shape}")
        panel.imshow(picture, origin="lower", extent=view.extent)
        variances, vectors = np.linalg.eigh(view.axes[:, :2].T @ matrices[rows] @ view.axes[:, :2])
        # Axes are `room` metres long per standard deviation.
        lengths = room * np.sqrt(np.maximum(variances, 0))
        angles = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
        # Black lines alone would hide on dark surfaces.
        for color, thickness in (("white", 2.4), ("black", 1.2)):
            style = {"units": "xy", "facecolors": "none", "edgecolors": color, "linewidths": thickness}
            place = {"offsets": offsets, "transOffset": panel.transData}
            panel.add_collection(collections.EllipseCollection(*lengths.T[::-1], angles, **place, **style))
        panel.set_title(name, fontsize="medium")
        panel.set(xticks=[], yticks=[], xlim=view.extent[:2], ylim=view.extent[2:])
    return drawing.saved(figure, path)


def _shaded(cloud: PointCloud, view: View) -> Picture:
    """The points in colour if they have red, green and blue, else in grey by intensity or height; on white."""
    points, colors = np.asarray(cloud.points), drawing.rgb_of(cloud)
    if colors is None:
        if "intensity" in cloud.channel_names:
            column = cloud.channel_names.index("intensity")
            values = np.asarray(cloud.channels)[:, column]
            if cloud.channel_valid is not None:
                values = np.where(np.asarray(cloud.channel_valid)[:, column], values, np.nan)
        else:
            values = view.project(points)[1]
        low, high = np.nanpercentile(values, [2, 98]) if np.isfinite(values).any() else (0.0, 1.0)
        grey = np.clip((values - low) / max(high - low, np.finfo(float).tiny), 0, 1)
        colors = np.repeat(0.85 * np.nan_to_num(grey, nan=0.5)[:, None], 3, axis=1)
    return np.nan_to_num(drawing.paint(view, points, np.nan_to_num(colors, nan=0.5)), nan=1)


def clouds(*clouds: PointCloud | Values, names: Sequence[str] | None = None) -> plotly.graph_objects.Figure:
    """Show clouds in one 3-D view, coloured by red, green and blue, else by intensity, else in one colour per cloud.

    If the clouds have more than 50,000 points in total, a reproducible random subset of that size is drawn.

    Args:
        clouds: clouds in a common frame.
        names: one per cloud, for the legend.

    Raises:
        ValueError: if the number of names differs from that of the clouds.
        ImportError: if plotly is missing.
    """
    graphs = drawing.plotting("plotly.graph_objects")
    names = [f"cloud {i}" for i in range(len(clouds))] if names is None else names
    if len(names) != len(clouds):
        raise ValueError(f"names: expected {len(clouds)}, one per cloud, got {len(names)}")
    drawn = [drawing.drawable(f"clouds[{i}]", cloud) for i, cloud in enumerate(clouds)]
    fraction = min(1.0, _MOST_POINTS / max(sum(map(len, drawn)), 1))
    layout = {"scene": {"aspectmode": "data"}, "legend": {"itemsizing": "constant"}, "margin": dict.fromkeys("lrtb", 0)}
    figure = graphs.Figure(layout=layout)
    for i, (cloud, name) in enumerate(zip(drawn, names, strict=True)):
        rows = np.random.default_rng(0).permutation(len(cloud))[: round(fraction * len(cloud))]
        rgb, intensity = drawing.rgb_of(cloud), drawing.channels_of(cloud, ("intensity",))
        marker: dict[str, Any] = {"size": 1.5, "color": _COLORS[i % len(_COLORS)]}
        if rgb is not None:
            marker["color"] = [f"rgb({r},{g},{b})" for r, g, b in np.round(255 * rgb[rows]).astype(int)]
        elif intensity is not None and len(cloud):
            low, high = np.nanpercentile(intensity, [2, 98])
            marker |= {"color": intensity[rows, 0], "colorscale": "Viridis", "cmin": low, "cmax": high}
        x, y, z = np.asarray(cloud.points)[rows].T
        figure.add_trace(graphs.Scatter3d(x=x, y=y, z=z, mode="markers", name=name, marker=marker, showlegend=True))
    return figure
