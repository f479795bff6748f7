"""A flat wall of posters seen by a noisy RGB-D camera: only the colours constrain motion along the wall."""

from __future__ import annotations

from functools import partial
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mcgicp_jax._clouds.columns import COLORS
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax.datasets._frames import Matrix, SyntheticFrames, bilinear, check_scene, pose_of, scene_and_path_rng

# The constants of this module define the scene and the camera.
# First-generation Kinect: image size and focal length, pixels.
_WIDTH, _HEIGHT, _FOCAL = 640, 480, 525.0
# Standard deviation of each colour, from 0 to 1.
_COLOR_NOISE = 0.02
# Seconds between frames.
_PERIOD = 1 / 30

# Metres: mean distance from the wall, and the amplitude of its variation.
_DISTANCE, _DISTANCE_SWAY = 1.35, 0.12
# Radians: the tilt vector moves on a circle of this radius, by a phase that rotates the camera by 1.5° per frame.
_TILT, _TILT_PHASE = np.deg2rad(2.0), 2 * np.arcsin(0.375)

# Metres: finer than the 2.3 mm that a pixel covers on a wall 1.2 m away.
_TEXEL = 0.0015
# Metres and counts: the wall is a periodic grid of cells with one poster each.
_CELL_WIDTH, _CELL_HEIGHT, _COLUMNS, _ROWS = 0.84, 0.75, 4, 3
# Metres: frame around each poster.
_BORDER = 0.015
_WALL_COLOR = np.array([0.72, 0.70, 0.66])
# Colours away from 0 and 1, so that noise is rarely clipped.
_PALETTE = np.array(
    [
        [0.85, 0.20, 0.18],
        [0.93, 0.62, 0.15],
        [0.90, 0.85, 0.30],
        [0.25, 0.60, 0.30],
        [0.15, 0.55, 0.60],
        [0.16, 0.28, 0.62],
        [0.50, 0.25, 0.55],
        [0.90, 0.88, 0.84],
        [0.12, 0.12, 0.15],
        [0.55, 0.38, 0.25],
    ]
)
_DESIGNS = ("gradient", "stripes", "text", "discs", "diamonds")

# Metres to the right and downwards along the wall.
Offset: TypeAlias = Float[np.ndarray, "2"]
Grid: TypeAlias = Float[np.ndarray, "h w"]
Image: TypeAlias = Float[np.ndarray, "h w 3"]
Colors: TypeAlias = Float[np.ndarray, "colors 3"]


def poster_wall(
    num_frames: int = 2,
    *,
    points_per_frame: int = 12_000,
    step: float = 0.03,
    heading: float | None = None,
    noise: float = 1.0,
    seed: int = 0,
) -> SyntheticFrames:
    """A camera moves along a flat wall of posters; only the colours constrain the motion along the wall.

    The wall is the plane z = 0 of the world; the camera (x right, y down, z ahead; 640 × 480 pixels, focal length 525)
    looks at it from 1.23 to 1.47 m. From frame to frame it moves by `step` in a constant direction along the wall and
    by at most 0.3 `step` across it, and rotates by 1.5°. Every frame has its own rays. The posters repeat every 3.36 m
    horizontally and 2.25 m vertically.

    Args:
        num_frames: number of frames.
        points_per_frame: approximate number of points, spread over the whole image; 1 to 307,200.
        step: metres along the wall between consecutive frames.
        heading: direction of motion in radians, clockwise from the right: π moves from right to left, as in Fig. 3 of
            Servos & Waslander (2014). None: random, determined by the seed.
        noise: factor on the standard deviations, 1 for a Kinect, 0 for none: 0.0012 + 0.0019 (z − 0.4)² metres of the
            depth, along the ray, and 0.02 of each colour.
        seed: determines the posters, path, rays and noise. `observe` draws the latter two anew.

    Returns:
        Frames whose clouds have the channels red, green and blue, from 0 to 1.

    Raises:
        ValueError: if `num_frames`, `points_per_frame` or `noise` is out of range.
    """
    check_scene(points_per_frame, noise, _WIDTH * _HEIGHT)
    scene_rng, path_rng = scene_and_path_rng(seed)
    observer = partial(_observe, _paint_wall(scene_rng), points_per_frame, noise)
    start = path_rng.uniform(0, 1, 2) * (_COLUMNS * _CELL_WIDTH, _ROWS * _CELL_HEIGHT)
    any_heading, tilt, sway = path_rng.uniform(0, 2 * np.pi, 3)
    tilt_axes = np.linalg.qr(path_rng.normal(size=(3, 2)))[0]
    heading = any_heading if heading is None else heading
    path = partial(_pose, start, step * np.array([np.cos(heading), np.sin(heading)]), tilt, tilt_axes, sway)
    return SyntheticFrames(num_frames, path, observer, _PERIOD, seed)


def _pose(
    start: Offset, move: Offset, tilt_start: float, tilt_axes: Float[np.ndarray, "3 2"], sway_start: float, index: int
) -> Matrix:
    tilt = tilt_start + index * _TILT_PHASE
    sway = sway_start + 0.3 * np.linalg.norm(move) / _DISTANCE_SWAY * index
    rotation = Rotation.from_rotvec(tilt_axes @ (_TILT * np.array([np.cos(tilt), np.sin(tilt)])))
    return pose_of(rotation, (*(start + index * move), -_DISTANCE + _DISTANCE_SWAY * np.sin(sway)))


def _observe(wall: Image, size: int, noise: float, rng: np.random.Generator, pose: Matrix) -> PointCloud:
    # Rays (x, y, 1) on a regular image grid with a random offset, each jittered within its pixel.
    columns = max(round(np.sqrt(size * _WIDTH / _HEIGHT)), 1)
    rows = max(round(size / columns), 1)
    u, v = np.meshgrid(np.arange(columns) + rng.uniform(), np.arange(rows) + rng.uniform())
    pixels = np.stack([u.ravel() * _WIDTH / columns, v.ravel() * _HEIGHT / rows], axis=1)
    pixels += rng.uniform(-0.5, 0.5, pixels.shape)
    xy = (pixels - (_WIDTH / 2, _HEIGHT / 2)) / _FOCAL
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)

    rotation, center = pose[:3, :3], pose[:3, 3]
    depth = -center[2] / (rays @ rotation[2])
    hits = (depth[:, None] * rays) @ rotation.T + center
    # The wall is periodic in both directions.
    colors = bilinear(wall, hits[:, :2] / _TEXEL, "grid-wrap")
    depth_noise = noise * (0.0012 + 0.0019 * (depth - 0.4) ** 2)
    depth = depth + depth_noise * rng.normal(size=depth.shape)
    colors = np.clip(colors + noise * _COLOR_NOISE * rng.normal(size=colors.shape), 0, 1)
    return PointCloud(depth[:, None] * rays, colors, channel_names=COLORS)


def _paint_wall(rng: np.random.Generator) -> Image:
    cell = np.array([round(_CELL_WIDTH / _TEXEL), round(_CELL_HEIGHT / _TEXEL)])
    wall = np.empty((_ROWS * cell[1], _COLUMNS * cell[0], 3), np.float32)
    wall[:] = _WALL_COLOR
    for i, number in enumerate(rng.permutation(_ROWS * _COLUMNS)):
        size = (cell * rng.uniform(0.62, 0.92, 2)).astype(int)
        left, top = cell * (i % _COLUMNS, i // _COLUMNS) + rng.integers(0, cell - size)
        width, height = size * _TEXEL
        x, y = np.meshgrid((np.arange(size[0]) + 0.5) * _TEXEL, (np.arange(size[1]) + 0.5) * _TEXEL)
        frame, *colors = rng.permutation(_PALETTE)
        poster = _poster(_DESIGNS[number % len(_DESIGNS)], rng, x, y, np.array(colors))
        poster[np.minimum(np.minimum(x, width - x), np.minimum(y, height - y)) < _BORDER] = frame
        wall[top : top + size[1], left : left + size[0]] = poster
    return wall


def _poster(design: str, rng: np.random.Generator, x: Grid, y: Grid, colors: Colors) -> Image:
    if design == "text":
        # Words are solid blocks; the first line is a larger headline.
        ink, paper = sorted(colors[:4], key=np.sum)[::3]
        letters = np.zeros(x.shape, bool)
        top, height = 0.04, 0.07
        while top < y.max():
            line = (y >= top) & (y < top + height) & (x > 0.04) & (x < x.max() - 0.04)
            letters |= line & (_bands(rng, x, 0.4 * height, 3 * height) % 2 == 0)
            top += 1.6 * height
            height = rng.uniform(0.018, 0.032)
        return np.where(letters[..., None], ink, paper)
    if design == "discs":
        label = np.zeros(x.shape, int)
        for i in range(14):
            radius = rng.uniform(0.03, 0.12)
            center_x, center_y = rng.uniform(0, x.max()), rng.uniform(0, y.max())
            label[np.hypot(x - center_x, y - center_y) < radius] = 1 + i % (len(colors) - 1)
        return colors[label]
    if design == "diamonds":
        # Bands at 45° across bands at −45°.
        return colors[(_bands(rng, x + y, 0.08, 0.25) + 2 * _bands(rng, x - y, 0.08, 0.25)) % 5]
    angle = rng.uniform(0, 2 * np.pi)
    along = np.cos(angle) * x + np.sin(angle) * y
    if design == "stripes":
        return colors[_bands(rng, along, 0.02, 0.10) % 4]
    fraction = (along - along.min()) / np.ptp(along)
    return np.stack([np.interp(fraction, [0, 0.5, 1], channel) for channel in colors[:3].T], axis=-1)


def _bands(rng: np.random.Generator, along: Grid, narrowest: float, widest: float) -> Int[np.ndarray, "h w"]:
    """The index of the band of a coordinate that is cut into bands of random width."""
    count = int(np.ptp(along) / narrowest) + 1
    edges = along.min() + np.cumsum(rng.uniform(narrowest, widest, count))
    return np.searchsorted(edges, along)
