"""A street of houses, seen by a spinning LiDAR with a panoramic camera."""

from __future__ import annotations

from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.random import Generator

import mcgicp_jax.datasets._raycast as raycast
from mcgicp_jax._clouds.columns import COLORS
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax.datasets._frames import Colors, Mask, Matrix, SyntheticFrames, check_scene, pose_of, scene_and_path_rng

# The constants of this module define the scene and the sensor.
# The LiDAR, a Velodyne HDL-64E on the roof of a car: beams and their elevations, radians; range and height, metres;
# period, seconds.
_BEAMS, _LOWEST, _HIGHEST = 64, np.deg2rad(-24.8), np.deg2rad(2.0)
_MAX_RANGE, _SENSOR_HEIGHT, _PERIOD = 80.0, 1.9, 0.1
# Path of the car: middle of its lane and amplitude of the sideways motion, metres; amplitudes of heading and of tilt,
# radians.
_LANE, _SWAY, _YAW, _TILT = -1.6, 0.25, np.deg2rad(1.5), np.deg2rad(0.8)
# Poses during one turn: the beams within 4° are measured at once. Frames per radian of the smooth path: velocities
# change by a tenth from frame to frame, as those of a car on a road do.
_POSES_OF_A_TURN, _SMOOTH = 90, 10
# Standard deviations: range, metres; intensity, absolute and relative; colours.
_RANGE_NOISE, _INTENSITY_NOISE, _INTENSITY_SPECKLE, _COLOR_NOISE = 0.02, 0.01, 0.05, 0.02
# Metres: range at which the intensity has fallen to half.
_HALF_INTENSITY = 40.0

# Metres from the middle of the street: parking bays, kerb, façades; height of the kerb; depth of the buildings.
_PARKING, _KERB, _FACADE, _KERB_HEIGHT, _DEPTH = 3.0, 5.0, 8.5, 0.12, 12.0
# Direction towards the sun, and colours of walls, cars and windows: red, green and blue from 0 to 1.
_SUN = np.array([0.35, -0.5, 0.79])
_WALLS = np.array([[0.72, 0.45, 0.36], [0.80, 0.74, 0.62], [0.62, 0.60, 0.58], [0.86, 0.82, 0.76], [0.55, 0.36, 0.30]])
_CARS = np.array([[0.75, 0.10, 0.10], [0.90, 0.90, 0.90], [0.08, 0.08, 0.10], [0.15, 0.25, 0.55], [0.55, 0.57, 0.60]])
_GLASS = np.array([0.16, 0.20, 0.26])
# Surface patterns: width of the patches, metres, and amplitude, per layer.
_ASPHALT = ((2.5, 0.035), (0.5, 0.03), (0.12, 0.02))
_PLASTER = ((3.0, 0.06), (0.5, 0.05), (0.15, 0.03))
# Metres: sizes of the slabs of the pavement, the repaired pieces of the road, and the shop signs.
_SLAB, _PIECE, _SIGN = 0.6, np.array([3.1, 1.55]), 3.7


class _Thing(NamedTuple):
    """An object of the scene; colour and reflectance are without the pattern."""

    kind: Literal["ground", "pavement", "building", "car", "pole", "bin"]
    solid: raycast.Solid
    color: Float[np.ndarray, "3"]
    reflectance: float  # at the wavelength of the laser, 0 to 1
    # Of buildings: pitch along the façade, pitch upwards, width, height and recess; metres. Of others: NaN.
    windows: Float[np.ndarray, "5"] = np.full(5, np.nan)


def street(
    num_frames: int = 50,
    *,
    points_per_frame: int = 30_000,
    step: float = 1.0,
    noise: float = 1.0,
    seed: int = 0,
    spin: bool = False,
) -> SyntheticFrames:
    """A car drives along a street of houses with a spinning 64-beam LiDAR and a panoramic camera on its roof.

    The scene has a road with markings, kerbs, façades with recessed windows, parked cars, poles and bins. From frame to
    frame the car moves by `step` along the world's x axis and by at most a sixth of that across it, with small
    rotations about all axes. Camera and LiDAR have the same centre, so every point has a colour.

    Args:
        num_frames: number of frames.
        points_per_frame: number of rays, rounded to a multiple of the 64 beams; the few that hit nothing within 80 m
            give no point.
        step: metres along the street between consecutive frames.
        noise: factor on the standard deviations: 0.02 m of the range; of the intensity, 0.01 and 5 % of its value; 0.02
            of each colour. 0 for none.
        seed: determines the street, path, rays and noise. `observe` draws the latter two anew.
        spin: the car moves while the LiDAR turns: the points of a frame are measured one after the other, as their
            `times` say, from the pose of the frame before to that of the frame; see `deskew`. The path is smoother.

    Returns:
        Frames whose clouds have the channels intensity, red, green and blue, from 0 to 1. The intensity decreases with
        range and angle of incidence. The world's z axis points up, the sensor's x axis ahead.

    Raises:
        ValueError: if `num_frames`, `points_per_frame` or `noise` is out of range.
    """
    check_scene(points_per_frame, noise)
    rng, path_rng = scene_and_path_rng(seed)
    start, end = min(0, num_frames * step) - 2 * _MAX_RANGE, max(0, num_frames * step) + 2 * _MAX_RANGE
    road = raycast.Box(np.array([start, -60.0, -1.0]), np.array([end, 60.0, 0.0]))
    things = [_Thing("ground", road, np.full(3, 0.33), 0.2)]
    for side, side_rng in zip((-1, 1), rng.spawn(2), strict=True):
        things += _side_of_street(side_rng, side, start, end)
    observer = partial(_observe, things, int(rng.integers(2**31)), points_per_frame, noise)
    path = partial(_pose, spin, step, *path_rng.uniform(0, 2 * np.pi, 3))
    return SyntheticFrames(num_frames, path, observer, _PERIOD, seed, _POSES_OF_A_TURN if spin else 1)


def _pose(smooth: bool, step: float, sway: float, yaw: float, tilt: float, time: float | int) -> Matrix:
    """The pose at a time in frames."""
    if smooth:
        sway_phase = yaw_phase = tilt_phase = time / _SMOOTH
    else:
        sway_phase, yaw_phase, tilt_phase = time * step / (6 * _SWAY), time / 4, 0.7 * time
    rotation = raycast.sensor_rotation(_YAW * np.sin(yaw + yaw_phase), _TILT, tilt + tilt_phase)
    return pose_of(rotation, (time * step, _LANE + _SWAY * np.sin(sway + sway_phase), _SENSOR_HEIGHT))


def _observe(
    things: list[_Thing], pattern: int, size: int, noise: float, rng: Generator, poses: Float[np.ndarray, "*poses 4 4"]
) -> PointCloud:
    # One turn of the LiDAR. As in a real one, each beam has its own offset. Multiples of the golden ratio spread them
    # evenly over a column.
    columns, beam = max(round(size / _BEAMS), 1), np.arange(_BEAMS)
    azimuth = 2 * np.pi / columns * (np.arange(columns)[:, None] + rng.uniform() + 0.618034 * beam % 1)
    elevation = np.broadcast_to(np.linspace(_LOWEST, _HIGHEST, _BEAMS), azimuth.shape)
    x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    rays = np.stack([x, y, np.sin(elevation)], axis=-1).reshape(-1, 3)
    # Each pose of the turn measures one sector of the rays.
    poses, solids = poses.reshape(-1, 4, 4), [thing.solid for thing in things]
    rays_by_pose = zip(poses, np.array_split(rays, len(poses)), strict=True)
    sectors = [raycast.cast(pose, sector, solids, _MAX_RANGE) for pose, sector in rays_by_pose]
    hits = raycast.Hits(*map(np.concatenate, zip(*sectors, strict=True)))
    times = None if len(poses) == 1 else np.repeat(np.arange(len(poses)), [len(sector.rays) for sector in sectors])

    hits, glass = _into_windows(hits, things)
    colors, reflectance = _paint(hits, glass, things, pattern)
    incidence = np.abs(np.sum(hits.rays * hits.normals, axis=1))
    intensity = reflectance * np.sqrt(incidence) / (1 + (hits.distance / _HALF_INTENSITY) ** 2)
    light = 0.5 + 0.5 * np.maximum(hits.normals @ _SUN, 0)
    channels = np.column_stack([intensity, light[:, None] * colors])
    sigma = np.full_like(channels, _COLOR_NOISE)
    sigma[:, 0] = np.hypot(_INTENSITY_NOISE, _INTENSITY_SPECKLE * intensity)
    channels = np.clip(channels + noise * sigma * rng.normal(size=channels.shape), 0, 1)
    distance = hits.distance + noise * _RANGE_NOISE * rng.normal(size=hits.distance.shape)
    points = distance[:, None] * hits.sensor_rays
    return PointCloud(points, channels, channel_names=("intensity", *COLORS), times=times)


def _box(low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], side: int) -> raycast.Box:
    """A box on the left of the street (side 1), or its mirror image on the right (−1)."""
    mirror = np.array([1, side, 1])
    return raycast.Box(np.minimum(mirror * low, mirror * high), np.maximum(mirror * low, mirror * high))


def _side_of_street(rng: Generator, side: int, start: float, end: float) -> list[_Thing]:
    """Pavement, buildings, cars, poles and bins of one side (see `_box`), from one x to another.

    Each kind has a generator of its own and is made in order of x, so that a longer street begins like a shorter one.
    """
    buildings, cars, poles, bins = rng.spawn(4)
    low, high = np.array([start, _KERB, -1.0]), np.array([end, 30.0, _KERB_HEIGHT])
    things = [_Thing("pavement", _box(low, high, side), np.full(3, 0.52), 0.3)]

    x = start
    while x < end:
        width, height, setback = buildings.uniform((7, 6, 0), (16, 15, 0.8))
        pitch, opening = buildings.uniform((1.8, 2.9), (3.2, 3.5)), buildings.uniform((0.8, 1.3), (1.4, 1.9))
        # Fit a whole number of windows and storeys, so that no window is cut off.
        pitch = np.array([width, height]) / np.round((width, height) / pitch)
        low, high = np.array([x, _FACADE + setback, 0.0]), np.array([x + width, _FACADE + setback + _DEPTH, height])
        color, reflectance = buildings.choice(_WALLS) * buildings.uniform(0.85, 1.1), buildings.uniform(0.25, 0.55)
        windows = np.array([*pitch, *opening, buildings.uniform(0.08, 0.25)])
        things.append(_Thing("building", _box(low, high, side), color, reflectance, windows))
        # The next building is adjacent, behind a passage, or across a side street.
        x += width + buildings.choice([0, buildings.uniform(1.5, 4), 9], p=[0.7, 0.2, 0.1])

    x = start
    while x < end:
        length, width, sill, roof = cars.uniform((3.6, 1.65, 0.85, 1.40), (4.9, 1.85, 1.05, 1.60))
        y = cars.uniform(_PARKING + 0.1, _KERB - width - 0.05)
        color, reflectance = cars.choice(_CARS), cars.uniform(0.15, 0.6)
        body = _box(np.array([x, y, 0.2]), np.array([x + length, y + width, sill]), side)
        bonnet, boot = cars.uniform((0.8, 0.2), (1.3, 0.8))
        low, high = np.array([x + bonnet, y + 0.12, sill]), np.array([x + length - boot, y + width - 0.12, roof])
        cabin = _Thing("car", _box(low, high, side), 0.5 * color + 0.5 * _GLASS, 0.1)
        things += [_Thing("car", body, color, reflectance), cabin]
        x += length + cars.choice([cars.uniform(0.6, 1.5), cars.uniform(4, 14)])

    x = start
    while x < end:
        radius, height = poles.uniform((0.06, 4.0), (0.18, 8.0))
        cylinder = raycast.Cylinder(np.array([x, side * (_KERB + poles.uniform(0.4, 0.9)), 0.0]), radius, height)
        things.append(_Thing("pole", cylinder, poles.uniform(0.2, 0.5, 3), poles.uniform(0.3, 0.7)))
        x += poles.uniform(8, 22)

    x = start
    while x < end:
        size = bins.uniform((0.4, 0.4, 0.8), (1.2, 0.7, 1.3))
        low = np.array([x, bins.uniform(_KERB + 1.2, _FACADE - 0.9), 0.0])
        box = _box(low, low + size, side)
        things.append(_Thing("bin", box, bins.uniform(0.1, 0.6, 3), bins.uniform(0.2, 0.5)))
        x += bins.uniform(6, 25)
    return things


def _into_windows(hits: raycast.Hits, things: list[_Thing]) -> tuple[raycast.Hits, Mask]:
    """Move hits in the opening of a window on to the glass or the reveal, and return the mask of hits on glass."""
    windows = np.array([thing.windows for thing in things])[hits.solid]
    rows = np.flatnonzero(np.isfinite(windows[:, 0]) & (hits.normals[:, 1] != 0))
    pitch, opening, recess = np.split(windows[rows], [2, 4], axis=1)
    corner = np.array([thing.solid.bounds[0] for thing in things])[hits.solid[rows]]
    # Offset from the centre of the window, along the façade and upwards.
    offset = (hits.points[rows] - corner)[:, [0, 2]] % pitch - pitch / 2
    within = (np.abs(offset) < opening / 2).all(axis=1)
    rows, offset, opening, recess = rows[within], offset[within], opening[within], recess[within, 0]

    rays = hits.rays[rows]
    with np.errstate(divide="ignore"):
        # Remaining distance to the plane of the glass, and to the two sides that the ray approaches.
        to_glass = recess / np.abs(rays[:, 1])
        to_sides = (np.sign(rays[:, [0, 2]]) * opening / 2 - offset) / rays[:, [0, 2]]
    remaining = np.column_stack([to_glass, to_sides])
    ray, plane = np.arange(len(rows)), np.argmin(remaining, axis=1)
    depth = remaining[ray, plane]

    distance, points, normals = hits.distance.copy(), hits.points.copy(), hits.normals.copy()
    distance[rows] += depth
    points[rows] += depth[:, None] * rays
    axis = np.array([1, 0, 2])[plane]
    normals[rows] = 0
    normals[rows, axis] = -np.sign(rays[ray, axis])
    glass = np.zeros(len(points), bool)
    glass[rows[plane == 0]] = True
    return hits._replace(distance=distance, points=points, normals=normals), glass


def _paint(hits: raycast.Hits, glass: Mask, things: list[_Thing], pattern: int) -> tuple[Colors, raycast.Distances]:
    """Colour and laser reflectance of the surface at each hit."""
    kinds = np.array([thing.kind for thing in things])
    colors = np.array([thing.color for thing in things])[hits.solid]
    reflectance = np.array([thing.reflectance for thing in things])[hits.solid]

    rows = np.flatnonzero((kinds == "ground")[hits.solid])
    ground = hits.points[rows, :2]
    stain = raycast.patches(ground, _ASPHALT, pattern)
    mended = np.where(raycast.random_cells(np.floor(ground / _PIECE).astype(int), pattern + 3) < 0.15, -0.09, 0)
    # White paint: a dashed centre line, parking bays along the kerbs, and occasional crossings.
    x, y = ground.T
    dashes = (np.abs(y) < 0.08) & (x % 9 < 4)
    bays = (np.abs(np.abs(y) - _PARKING) < 0.06) & (x % 6 < 5.4)
    ends = (np.abs(y) > _PARKING) & (np.abs(y) < _KERB) & (x % 6 < 0.12)
    crossing_x = 4 + 20 * raycast.random_cells(np.floor(x / 30).astype(int)[:, None], pattern + 4)
    crossings = (np.abs(x % 30 - crossing_x) < 1.5) & (y % 1.0 < 0.5) & (np.abs(y) < _KERB)
    marked = dashes | bays | ends | crossings
    colors[rows] = np.where(marked[:, None], 0.85, colors[rows] + (stain + mended)[:, None])
    reflectance[rows] = np.where(marked, 0.85, reflectance[rows] + 0.6 * (stain + mended))

    rows = np.flatnonzero((kinds == "pavement")[hits.solid])
    slab = raycast.random_cells(np.floor(hits.points[rows, :2] / _SLAB).astype(int), pattern + 5) - 0.5
    stain = 0.12 * slab + raycast.patches(hits.points[rows, :2], _ASPHALT, pattern + 6)
    colors[rows] += stain[:, None]
    reflectance[rows] += 0.6 * stain

    rows = np.flatnonzero((kinds == "building")[hits.solid])
    stain = raycast.patches(hits.points[rows], _PLASTER, pattern + 9)
    colors[rows] += stain[:, None]
    reflectance[rows] += stain
    shop = (hits.points[rows, 2] > 2.55) & (hits.points[rows, 2] < 3.05)
    cell = np.stack([np.floor(hits.points[rows, 0] / _SIGN), np.sign(hits.points[rows, 1])], axis=1).astype(int)
    sign = shop & (raycast.random_cells(cell, pattern + 12) < 0.6)
    hue = np.stack([raycast.random_cells(cell, pattern + 13 + channel) for channel in range(3)], axis=1)
    colors[rows] = np.where(sign[:, None], 0.15 + 0.7 * hue, colors[rows])
    reflectance[rows] = np.where(sign, 0.6, reflectance[rows])
    colors[glass] = _GLASS
    reflectance[glass] = 0.06
    return np.clip(colors, 0.03, 0.97), np.clip(reflectance, 0.02, 0.97)
