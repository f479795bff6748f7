"""A simulated corridor, whose geometry leaves the direction along it unobservable; only the intensity constrains it."""

from functools import partial

import numpy as np

from mcgicp_jax import PointCloud, preprocess
from mcgicp_jax.datasets._frames import Matrix, SyntheticFrames, check_scene, pose_of, scene_and_path_rng
from mcgicp_jax.datasets._raycast import Box, cast, patches, random_cells, random_rays, sensor_rotation

# The constants of this module define the scene.
# Metres: half width and height of the corridor, thickness of its walls.
_HALF_WIDTH, _HEIGHT, _WALL = 1.2, 2.5, 0.2
# Metres: maximum range and height of the sensor, amplitude of its sideways motion.
_MAX_RANGE, _SENSOR_HEIGHT, _SWAY = 12.0, 1.3, 0.3
# Radians: tilt, rotation of the tilt axis from frame to frame, amplitude of the heading.
_TILT, _TILT_PHASE, _YAW = np.deg2rad(2.0), 0.7, np.deg2rad(3.0)
# Standard deviations: range, metres, and intensity from 0 to 1.
_RANGE_NOISE, _INTENSITY_NOISE = 0.01, 0.02
# Seconds between frames.
_PERIOD = 0.1
# Width of the patches, metres, and amplitude, per layer; size of the wall panels along x, y and z, metres.
_PATCHES, _PANEL = ((1.0, 0.15), (0.3, 0.12)), np.array([0.9, 2 * _HALF_WIDTH, 1.25])


def corridor(
    num_frames: int = 2, *, points_per_frame: int = 5000, step: float = 0.2, textured: bool = True, seed: int = 0
) -> SyntheticFrames:
    """A sensor moves along an endless corridor, 2.4 m wide and 2.5 m high, whose axis is x. The z axis is up.

    The rays are uniform over the sphere, up to 12 m long, and drawn anew for every frame; the few that hit nothing give
    no point. From frame to frame the sensor moves by `step` metres along the axis and by at most a third of that across
    it, and rotates by a few degrees. The channel intensity, from 0 to 1, is constant unless `textured`.
    """
    check_scene(points_per_frame, 1.0)
    scene_rng, path_rng = scene_and_path_rng(seed)
    pattern = int(scene_rng.integers(2**31)) if textured else None
    observer = partial(_observe, pattern, points_per_frame)
    path = partial(_pose, step, *path_rng.uniform(0, 2 * np.pi, 3))
    return SyntheticFrames(num_frames, path, observer, _PERIOD, seed)


def _pose(step: float, sway: float, yaw: float, tilt: float, index: int) -> Matrix:
    # The sideways motion per frame is at most _SWAY times the phase increment, a third of `step`.
    phase = index * step / 3 / _SWAY
    rotation = sensor_rotation(_YAW * np.sin(yaw + index / 3), _TILT, tilt + index * _TILT_PHASE)
    return pose_of(rotation, (index * step, _SWAY * np.cos(sway + phase), _SENSOR_HEIGHT))


def bare_pair() -> tuple[PointCloud, PointCloud, Matrix, np.ndarray]:
    """Source and target without texture, the true pose, and the axis of the corridor in the source's frame."""
    target, source = corridor(2, textured=False)
    clouds = preprocess(source.cloud), preprocess(target.cloud)
    return *clouds, np.linalg.inv(target.pose) @ source.pose, source.pose[:3, :3].T @ [1, 0, 0]


def _observe(pattern: int | None, size: int, rng: np.random.Generator, pose: Matrix) -> PointCloud:
    hits = cast(pose, random_rays(rng, size), _walls(pose[0, 3]), _MAX_RANGE)
    intensity = np.full(len(hits.points), 0.5)
    if pattern is not None:
        intensity += patches(hits.points, _PATCHES, pattern)
        # Hits are moved just into the wall, so that rounding does not scatter them over two panels.
        panel = np.floor((hits.points - 1e-6 * hits.normals) / _PANEL + 0.5).astype(int)
        intensity += 0.3 * (random_cells(panel, pattern + len(_PATCHES)) - 0.5)
    distance = hits.distance + _RANGE_NOISE * rng.normal(size=hits.distance.shape)
    intensity += _INTENSITY_NOISE * rng.normal(size=intensity.shape)
    return PointCloud(distance[:, None] * hits.sensor_rays, np.clip(intensity, 0, 1), channel_names=["intensity"])


def _walls(along: float) -> list[Box]:
    """Floor, ceiling and walls within the maximum range of the sensor."""
    start, end = along - 2 * _MAX_RANGE, along + 2 * _MAX_RANGE
    y, z = _HALF_WIDTH, _HEIGHT
    corners = [
        ((-y, -_WALL), (y, 0)),
        ((-y, z), (y, z + _WALL)),
        ((-y - _WALL, -_WALL), (-y, z + _WALL)),
        ((y, -_WALL), (y + _WALL, z + _WALL)),
    ]
    return [Box(np.array([start, *low]), np.array([end, *high])) for low, high in corners]
