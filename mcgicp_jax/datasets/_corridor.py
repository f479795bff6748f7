"""A long corridor: its walls hold a pose across it, and nothing but what is painted on them holds it along."""

from __future__ import annotations

from functools import partial

import numpy as np
from jaxtyping import Float

from mcgicp_jax._cloud import PointCloud
from mcgicp_jax.datasets._frame import (
    SyntheticFrames,
    check_noise,
    check_points_per_frame,
    rotation_from_vector,
    scene_and_path_rng,
)
from mcgicp_jax.datasets._raycast import Box, cast, patches, random_cells, random_rays, swaying_rotation

# Metres: half of the width, and the height; how far the sensor sees, and where it is.
_HALF_WIDTH, _HEIGHT, _WALL = 1.2, 2.5, 0.2
_REACH, _SENSOR_HEIGHT, _SWAY = 12.0, 1.3, 0.3
_TILT, _TILT_PHASE, _YAW = np.deg2rad(2.0), 0.7, np.deg2rad(3.0)
_RANGE_NOISE, _INTENSITY_NOISE = 0.01, 0.02
_PERIOD = 0.1
# Metres: patches of paint, and panels of the walls.
_PATCHES, _PANEL = ((1.0, 0.15), (0.3, 0.12)), np.array([0.9, 2 * _HALF_WIDTH, 1.25])


def corridor(
    num_frames: int = 2,
    *,
    points_per_frame: int = 5000,
    step: float = 0.2,
    textured: bool = True,
    noise: float = 1.0,
    seed: int = 0,
) -> SyntheticFrames:
    """A sensor moves along a corridor without doors or ends, 2.4 m wide and 2.5 m high.

    Its shape is the same everywhere along the axis x, so that geometry alone leaves that direction free, exactly. It
    sees in all directions alike, up to 12 m; every frame has fresh rays. From frame to frame it moves by `step` along
    the axis, by at most a third of that across it, and sways by some degrees.

    Args:
        points_per_frame: rays; the few that reach further than 12 m give no point.
        step: metres along the axis between consecutive frames.
        textured: whether the intensity tells one place of the walls from another, or is the same everywhere.
        noise: scales the standard deviations: 0.01 m of the range, 0.02 of the intensity. 0 for none.
        seed: the same seed gives the same paint, path, rays and noise. `observe` draws the latter two anew.

    Returns:
        Frames whose clouds have the channel intensity, from 0 to 1. The world's z axis points up.

    Raises:
        ValueError: if a number is out of its range.
    """
    check_noise(noise)
    check_points_per_frame(points_per_frame, 10_000_000)
    scene_rng, path_rng = scene_and_path_rng(seed)
    pattern = int(scene_rng.integers(2**31)) if textured else None
    observer = partial(_observe, pattern, points_per_frame, noise)
    path = partial(_pose, step, *path_rng.uniform(0, 2 * np.pi, 3))
    return SyntheticFrames(num_frames, path, observer, _PERIOD, seed)


def _pose(step: float, sway: float, yaw: float, tilt: float, index: int) -> Float[np.ndarray, "4 4"]:
    # The sideways speed is largest where the cosine is steepest.
    phase = index * step / 3 / _SWAY
    pose = np.eye(4)
    heading = rotation_from_vector(np.array([0, 0, _YAW * np.sin(yaw + index / 3)]))
    pose[:3, :3] = heading @ swaying_rotation(_TILT, tilt + index * _TILT_PHASE)
    pose[:3, 3] = index * step, _SWAY * np.cos(sway + phase), _SENSOR_HEIGHT
    return pose


def _observe(
    pattern: int | None, size: int, noise: float, rng: np.random.Generator, pose: Float[np.ndarray, "4 4"]
) -> PointCloud:
    rotation, center = pose[:3, :3], pose[:3, 3]
    hits = cast(center, random_rays(rng, size) @ rotation.T, _walls(center[0]), _REACH)
    intensity = np.full(len(hits.points), 0.5)
    if pattern is not None:
        intensity += patches(hits.points, _PATCHES, pattern)
        # From just inside the wall, so that no panel ends in the wall itself.
        panel = np.floor((hits.points - 1e-6 * hits.normals) / _PANEL + 0.5).astype(int)
        intensity += 0.3 * (random_cells(panel, pattern + len(_PATCHES)) - 0.5)
    distance = hits.distance + noise * _RANGE_NOISE * rng.normal(size=hits.distance.shape)
    intensity += noise * _INTENSITY_NOISE * rng.normal(size=intensity.shape)
    return PointCloud(distance[:, None] * (hits.rays @ rotation), np.clip(intensity, 0, 1), channel_names=["intensity"])


def _walls(along: float) -> list[Box]:
    """Floor, ceiling and walls as far as the sensor sees."""
    start, end = along - 2 * _REACH, along + 2 * _REACH
    y, z = _HALF_WIDTH, _HEIGHT
    corners = [
        ((-y, -_WALL), (y, 0)),
        ((-y, z), (y, z + _WALL)),
        ((-y - _WALL, -_WALL), (-y, z + _WALL)),
        ((y, -_WALL), (y + _WALL, z + _WALL)),
    ]
    return [Box(np.array([start, *low]), np.array([end, *high])) for low, high in corners]
