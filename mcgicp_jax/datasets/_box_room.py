"""A furnished room, whose geometry constrains all six degrees of freedom."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.random import Generator

from mcgicp_jax._clouds.columns import COLORS
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax.datasets._frames import Colors, Matrix, SyntheticFrames, check_scene, pose_of, scene_and_path_rng
from mcgicp_jax.datasets._raycast import Box, cast, patches, random_rays, sensor_rotation

# The constants of this module define the scene.
# Metres: length, width and height of the room, and the thickness of its walls.
_SIZE, _WALL = np.array([8.0, 6.0, 2.8]), 0.2
_NUM_BOXES = 14
# Metres: height of the sensor, above the furniture; radius of its circle; maximum height of the furniture.
_SENSOR_HEIGHT, _RADIUS, _HIGHEST_BOX = 1.7, 1.6, 1.4
# Radians: the tilt of the sensor, and the rotation of the tilt axis from frame to frame.
_TILT, _TILT_PHASE = np.deg2rad(2.0), 0.7
# Standard deviations: metres, and colour from 0 to 1.
_POINT_NOISE, _COLOR_NOISE = 0.01, 0.02
# Seconds between frames.
_PERIOD = 0.1
# Width of the patches, metres, and amplitude, per layer; and the effect of the pattern on red, green and blue.
_PAINT = ((0.6, 0.12), (0.2, 0.08))
_PAINT_COLOR = np.array([1.0, 0.6, -0.5])


def box_room(
    num_frames: int = 2,
    *,
    points_per_frame: int = 5000,
    step: float = 0.1,
    noise: float = 1.0,
    along_rays: bool = False,
    seed: int = 0,
) -> SyntheticFrames:
    """A sensor moves through a closed room, 8 × 6 × 2.8 m, furnished with boxes; all surfaces have a colour pattern.

    The rays are uniform over the sphere and drawn anew for every frame, so that no two frames sample the same points.
    From frame to frame the sensor moves by `step` on a circle of radius 1.6 m, keeps its heading tangential to the
    circle, and tilts by 2° in varying directions.

    Args:
        num_frames: number of frames.
        points_per_frame: exact number of points of each frame.
        step: metres between consecutive frames.
        noise: factor on the standard deviations, 0.01 m of the points and 0.02 of each colour; 0 for none.
        along_rays: whether the noise displaces points only along their rays, rather than isotropically.
        seed: determines the room, path, rays and noise. `observe` draws the latter two anew.

    Returns:
        Frames whose clouds have the channels red, green and blue, from 0 to 1. The world's z axis points up.

    Raises:
        ValueError: if `num_frames`, `points_per_frame` or `noise` is out of range.
    """
    check_scene(points_per_frame, noise)
    rng, path_rng = scene_and_path_rng(seed)
    boxes = []
    # Floor, ceiling and four walls, overlapping at their edges.
    for axis in range(3):
        for start, end in ((-_WALL, 0.0), (_SIZE[axis], _SIZE[axis] + _WALL)):
            low, high = np.full(3, -_WALL), _SIZE + _WALL
            low[axis], high[axis] = start, end
            boxes.append(Box(low, high))
    # Furniture on the floor, most of it against the walls; boxes may intersect.
    for _ in range(_NUM_BOXES):
        size = rng.uniform((0.3, 0.3, 0.3), (1.6, 1.0, _HIGHEST_BOX))
        if rng.uniform() < 0.5:
            size[:2] = size[1::-1]
        low = np.append(rng.uniform(0, _SIZE[:2] - size[:2]), 0)
        if rng.uniform() < 0.7:
            axis = int(rng.integers(2))
            low[axis] = rng.choice([0, _SIZE[axis] - size[axis]])
        boxes.append(Box(low, low + size))
    colors = rng.uniform(0.25, 0.75, (len(boxes), 3))
    observer = partial(_observe, boxes, colors, int(rng.integers(2**31)), points_per_frame, noise, along_rays)
    path = partial(_pose, step, *path_rng.uniform(0, 2 * np.pi, 2))
    return SyntheticFrames(num_frames, path, observer, _PERIOD, seed)


def _pose(step: float, start: float, tilt_start: float, index: int) -> Matrix:
    angle = start + index * step / _RADIUS
    x, y = _SIZE[:2] / 2 + _RADIUS * np.array([np.cos(angle), np.sin(angle)])
    rotation = sensor_rotation(angle + np.pi / 2, _TILT, tilt_start + index * _TILT_PHASE)
    return pose_of(rotation, (x, y, _SENSOR_HEIGHT))


def _observe(
    boxes: list[Box], colors: Colors, seed: int, size: int, noise: float, along_rays: bool, rng: Generator, pose: Matrix
) -> PointCloud:
    hits = cast(pose, random_rays(rng, size), boxes, np.inf)
    rays = hits.sensor_rays
    error = rng.normal(size=(len(rays), 1)) * rays if along_rays else rng.normal(size=rays.shape)
    points = hits.distance[:, None] * rays + noise * _POINT_NOISE * error
    paint = colors[hits.solid] + patches(hits.points, _PAINT, seed)[:, None] * _PAINT_COLOR
    channels = np.clip(paint + noise * _COLOR_NOISE * rng.normal(size=paint.shape), 0, 1)
    return PointCloud(points, channels, channel_names=COLORS)
