"""Pictures of two clouds before and after registration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

import mcgicp_jax.plot.drawing as drawing
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._clouds.voxel_size import raw_spacing
from mcgicp_jax._math.poses import Pose, pose_matrix
from mcgicp_jax.plot.drawing import Figure, File, Map, Picture, Points, View

# The constants affect only how figures look.
# Most rows below each other; maximum width of a row and height of a panel, inches; pixels and tiles along the longer
# side of a panel; fraction of each side that the detail shows; most pixels of a point of the sparser cloud.
_MOST_ROWS, _WIDEST, _HIGHEST, _PIXELS, _TILES, _DETAIL, _LARGEST_POINT = 5, 12, 4.5, 500, 12, 0.25, 9


def before_after(source: PointCloud, target: PointCloud, poses: Mapping[str, Pose], *, path: File = None) -> Figure:
    """Compare poses: one row per pose shows the transformed source with the target, along the target's thinnest axis.

    More than five rows are laid out side by side.

    If all points have the channels red, green and blue, target and source alternate in a checkerboard, in which
    patterns continue across tiles where the pose is right; a further panel shows the colour difference. Otherwise the
    clouds are overlaid, the target in blue and the source in orange, black where both are, points of the sparser cloud
    larger by the ratio of the spacings. Upright surfaces are drawn
    dark and flat ones pale, since the rings of a LiDAR on the ground move with the sensor. The detail shows the region
    where the poses differ most.

    Args:
        source, target: clouds in their own frames.
        poses: `T_target_source` by name, for instance of the method. The first row, "start", is the identity unless
            `poses` has a "start".
        path: file to save the figure to; its suffix selects the format.

    Raises:
        ValueError: if a pose is no rigid motion, or the target has fewer than 3 points.
        ImportError: if matplotlib is missing.
    """
    named = {name: pose_matrix(pose, f"poses[{name!r}]") for name, pose in ({"start": np.eye(4)} | dict(poses)).items()}
    source, target = drawing.drawable(source), drawing.drawable(target)
    if len(target) < 3:
        raise ValueError(f"target: expected at least 3 points, got {len(target)}")
    moved = [np.asarray(source.transform(matrix).unpad().points) for matrix in named.values()]
    source_colors, target_colors = drawing.rgb_of(source), drawing.rgb_of(target)
    target_points = np.asarray(target.points)
    view = drawing.view_onto(target_points, _PIXELS)
    if source_colors is not None and target_colors is not None:
        rows = _chess_boards(view, target_points, target_colors, moved, source_colors)
        headings = ["target and source in alternate tiles", "detail", "difference of colour"]
    else:
        spacings = np.maximum([raw_spacing(target), raw_spacing(source)], np.finfo(float).tiny)
        rows = _overlays(view, target_points, moved, *np.minimum(spacings / spacings.min(), _LARGEST_POINT))
        headings = ["target blue, source orange, both black", "detail"]
    detail = _where_they_differ([difference for _, difference in rows])
    headings[1] = f"detail, {(detail[0].stop - detail[0].start) * view.pixel:.2g} m wide"

    width = min(_WIDEST / len(headings), _HIGHEST * view.width / view.height)
    height = width * view.height / view.width + 0.3
    beside = -(-len(rows) // _MOST_ROWS)
    below = -(-len(rows) // beside)
    figure = drawing.new_figure(beside * (len(headings) * width + 0.3), below * height + 0.3)
    columns = figure.subplots(below, beside * len(headings), squeeze=False)
    panels = np.concatenate(np.split(columns, beside, axis=1))
    for first in panels[::below]:
        for panel, heading in zip(first, headings, strict=True):
            panel.set_title(heading)
    for row, name, (picture, difference) in zip(panels, named, rows, strict=False):
        _draw_row(row, name, picture, difference, detail)
    for panel in panels[len(rows) :].flat:
        panel.set_visible(False)
    return drawing.saved(figure, path)


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


def _chess_boards(
    view: View,
    target: Float[np.ndarray, "M 3"],
    target_colors: Float[np.ndarray, "M 3"],
    moved: Sequence[Points],
    source_colors: Points,
) -> list[tuple[Picture, Map]]:
    """For each moved source a checkerboard picture, and the colour difference, NaN where either cloud has no points."""
    tile = max(view.width, view.height) // _TILES + 1
    row, column = np.mgrid[: view.height, : view.width] // tile
    target_tiles = ((row + column) % 2 == 0)[..., None]
    ours = drawing.paint(view, target, target_colors)
    ours_smooth, boards = _smooth(ours), []
    for points in moved:
        theirs = drawing.paint(view, points, source_colors)
        picture = np.nan_to_num(np.where(target_tiles, ours, theirs), nan=1)
        boards.append((picture, np.abs(ours_smooth - _smooth(theirs)).mean(axis=-1)))
    return boards


def _smooth(picture: Picture) -> Picture:
    """Mean over a window a little larger than the point spacing, so that differences do not show the sampling."""
    half = drawing.PIXELS_PER_SPACING // 2 + 1
    padded = np.pad(picture, ((half, half), (half, half), (0, 0)), mode="edge")
    for axis in (0, 1):
        padded = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis).mean(axis=-1)
    return padded


def _overlays(
    view: View, target: Float[np.ndarray, "M 3"], moved: Sequence[Points], target_size: float, source_size: float
) -> list[tuple[Picture, Map]]:
    """For each moved source a picture of both clouds, whose points have these sizes in pixels, and the difference of
    their inks."""
    ours = _ink(view, target, target_size)
    overlays = []
    for points in moved:
        theirs = _ink(view, points, source_size)
        # Subtractive colours: the target removes all red, the source all blue, and each half of the green.
        picture = 1 - np.stack([ours, 0.5 * ours + 0.5 * theirs, theirs], axis=-1)
        overlays.append((picture, np.abs(ours - theirs)))
    return overlays


def _ink(view: View, points: Points, size: float) -> Map:
    """Ink per pixel: 0 without points, 0.15 on flat surfaces, 1 where the points are at least four pixels high."""
    from scipy.ndimage import maximum_filter, minimum_filter

    pixels, height = view.project(points)
    lowest, highest = np.full(view.height * view.width, np.inf), np.full(view.height * view.width, -np.inf)
    inside = pixels >= 0
    np.minimum.at(lowest, pixels[inside], height[inside])
    np.maximum.at(highest, pixels[inside], height[inside])
    pixels_wide = round(size)
    highest = maximum_filter(highest.reshape(view.height, view.width), pixels_wide)
    lowest = minimum_filter(lowest.reshape(view.height, view.width), pixels_wide)
    stands = np.clip((highest - lowest) / (4 * view.pixel), 0.15, 1)
    return np.where(highest >= lowest, stands, 0)


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
