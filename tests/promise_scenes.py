"""Scenes of rectangles in which a rule may promise too much: their registrations were once CONVERGED and wrong.

Positions are metres, in a world whose x axis is the direction of the motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import mcgicp_jax as mcg
from tests.scenes import CORRIDOR, Side, rects

# Metres: standard deviation of points, and the true motion along x.
NOISE, STEP = 0.01, 0.3


class Pair(NamedTuple):
    """Two clouds and the true pose (4, 4)."""

    source: mcg.PointCloud
    target: mcg.PointCloud
    T_target_source: np.ndarray


def box(low: Sequence[float], high: Sequence[float], lid: bool = True) -> list[Side]:
    """The sides of a box, without its floor, and with its lid."""
    (x, y, z), (a, b, c) = low, np.subtract(high, low)
    walls = [((x, y, z), (a, 0, 0), (0, 0, c)), ((x, y + b, z), (a, 0, 0), (0, 0, c))]
    walls += [((x, y, z), (0, b, 0), (0, 0, c)), ((x + a, y, z), (0, b, 0), (0, 0, c))]
    return [*walls, ((x, y, z + c), (a, 0, 0), (0, b, 0))] if lid else walls


def translation(*metres: float) -> np.ndarray:
    """A rigid motion (4, 4) without rotation."""
    matrix = np.eye(4)
    matrix[:3, 3] = metres
    return matrix


def moved(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (N, 3) after a rigid motion (4, 4)."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def office(seed: int, count: int = 4000, common: float = 0.8) -> Pair:
    """Two parts of a furnished room of 6 × 4 × 2.5 m, cut as scans are that were merged from many views.

    The target is the part with x < c, the source that with x > −c; they have the fraction `common` of each in common.
    Source coordinates are the target's: the true pose is the identity.
    """
    rng = np.random.default_rng(seed)
    sides = [((-3, -2, 0), (6, 0, 0), (0, 4, 0)), *box((-3, -2, 0), (3, 2, 2.5), lid=False)]
    for _ in range(6):
        size, place = rng.uniform(0.3, 0.8, 3), rng.uniform((-2.6, -1.6), (1.8, 0.8))
        sides += box((*place, 0), (place[0] + size[0], place[1] + size[1], size[2]))
    # A part extends from -3 to c, the common part from -c to c.
    cut = 3 * common / (2 - common)
    target, source = (rects(rng, 3 * count, sides) for _ in range(2))
    target, source = target[target[:, 0] < cut][:count], source[source[:, 0] > -cut][:count]
    clouds = (mcg.PointCloud(part + NOISE * rng.normal(size=part.shape)) for part in (source, target))
    return Pair(*clouds, np.eye(4))


FLOOR_AND_WALL: list[Side] = [((-10, -3, 0), (20, 0, 0), (0, 6, 0)), ((-10, 3, 0), (20, 0, 0), (0, 0, 3))]
ROAD: list[Side] = [((-20, -6, 0), (40, 0, 0), (0, 12, 0))]
SCENES = {"floor and wall": FLOOR_AND_WALL, "corridor": CORRIDOR, "road": ROAD}
# Metres: height of the sensor above the floor, and its maximum range.
_HEIGHT, _MAX_RANGE = 1.2, 9.0

Channel = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""A channel (N,), of points (N, 3) in the sensor's frame, with x forward and z up, and of points in the world."""


def tiles(amplitude: float, size: float = 0.4, seed: int = 0) -> Channel:
    """Reflectance that is fixed to the world: tiles whose values differ by up to ± `amplitude`."""
    table = np.random.default_rng(seed).uniform(-amplitude, amplitude, 4096)

    def value(_: np.ndarray, world: np.ndarray) -> np.ndarray:
        cell = np.floor((world + 1e-3) / size).astype(int)
        return table[(cell @ (73_856_093, 19_349_663, 83_492_791)) % 4096]

    return value


def _range(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points, axis=1)


MOVING_CHANNELS: dict[str, Channel] = {
    # Channels that are functions of a point's place in the frame of the sensor, and say nothing of the world.
    "range": lambda points, _: 1 / (1 + 0.1 * _range(points)),
    "distance": lambda points, _: _range(points),
    "elevation": lambda points, _: np.arcsin(points[:, 2] / _range(points)),
    "azimuth": lambda points, _: np.cos(np.arctan2(points[:, 1], points[:, 0])),
    "time": lambda points, _: (np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)) % 1,
    "vignetting": lambda points, _: np.clip(points[:, 0] / _range(points), 0, 1) ** 4,
    "saturation": lambda points, _: np.minimum(4 / _range(points) ** 2, 1),
    "ring": lambda points, _: np.random.default_rng(3).normal(1, 0.1, 64)[
        (32 * (1 + points[:, 2] / _range(points))).astype(int).clip(0, 63)
    ],
    "coordinate": lambda points, _: points[:, 0],
}


def seen(
    sides: Sequence[Side],
    seed: int,
    channel: Channel | None = None,
    *,
    count: int = 4000,
    channel_noise: float = 0.01,
    step: float = STEP,
) -> Pair:
    """A sensor sees rectangles from the origin, and again after a step along x; clouds are in the sensor's frame.

    The channel has noise as a fraction of its standard deviation over the target.
    """
    rng = np.random.default_rng(seed)

    def view(along: float) -> tuple[np.ndarray, np.ndarray]:
        at = np.array([along, 0, _HEIGHT])
        world = rects(rng, 6 * count, sides)
        world = world[_range(world - at) < _MAX_RANGE][:count]
        return world - at + NOISE * rng.normal(size=world.shape), world

    target, source = view(0.0), view(step)
    if channel is None:
        return Pair(mcg.PointCloud(source[0]), mcg.PointCloud(target[0]), translation(step, 0, 0))
    values = [channel(*part) for part in (source, target)]
    deviation = channel_noise * np.std(values[1])
    noisy = [part + deviation * rng.normal(size=part.shape) for part in values]
    clouds = (
        mcg.PointCloud(part[0], part_values[:, None]) for part, part_values in zip((source, target), noisy, strict=True)
    )
    return Pair(*clouds, translation(step, 0, 0))


def in_frames(pair: Pair, source: np.ndarray, target: np.ndarray) -> Pair:
    """The same pair after a rigid motion (4, 4) of each cloud's coordinates."""
    clouds = (
        cloud.replace(points=moved(matrix, np.asarray(cloud.points, np.float64)).astype(np.float32))
        for cloud, matrix in ((pair.source, source), (pair.target, target))
    )
    return Pair(*clouds, target @ pair.T_target_source @ np.linalg.inv(source))


# Metres, about the sensor: a vehicle that it stands on.
_VEHICLE = box((-0.4, -0.3, -0.6), (0.4, 0.3, -0.1))


def on_vehicle(pair: Pair, seed: int, fraction: float) -> Pair:
    """The same pair, where a fraction of the points are returns from the sensor's own vehicle."""
    rng = np.random.default_rng(seed)

    def replaced(cloud: mcg.PointCloud) -> mcg.PointCloud:
        points = np.array(cloud.points)
        count = round(fraction * len(points))
        points[:count] = rects(rng, count, _VEHICLE) + NOISE * rng.normal(size=(count, 3))
        return cloud.replace(points=points)

    return Pair(replaced(pair.source), replaced(pair.target), pair.T_target_source)


def stairs(seed: int, count: int = 6000, steps: int = 12, step: float = STEP) -> Pair:
    """Stairs with a period of 0.34 m between two walls, from `step` metres off along them."""
    rng = np.random.default_rng(seed)
    tread, rise = 0.28, 0.19
    sides: list[Side] = []
    for number in range(steps):
        x, z = number * tread, number * rise
        sides += [((x, -0.7, z), (0, 1.4, 0), (0, 0, rise)), ((x, -0.7, z + rise), (tread, 0, 0), (0, 1.4, 0))]
    length, height = steps * tread, steps * rise + 2
    sides += [((-1, y, -0.5), (length + 2, 0, 0), (0, 0, height)) for y in (-0.7, 0.7)]
    along = step * np.array([tread, 0, rise]) / np.hypot(tread, rise)
    target, source = (rects(rng, count, sides) + NOISE * rng.normal(size=(count, 3)) for _ in range(2))
    return Pair(mcg.PointCloud(source - along), mcg.PointCloud(target), translation(*along))


def views(seed: int, field: float = 1.6, turn: float = 1.1, apart: float = 0.5, count: int = 5000) -> Pair:
    """Two views of a furnished room of 10 × 8 × 3 m, with real lines of sight and little in common.

    The sensor sees `field` radians to the sides and one up and down; between the views it turns by `turn` radians and
    moves by `apart` metres. The source is 0.15 m and 2.5° from where the pose is the identity.
    """
    rng = np.random.default_rng(seed)
    boxes = []
    for _ in range(6):
        low = np.r_[rng.uniform((-4, -3), (4, 3)), 0]
        if np.linalg.norm(low[:2]) >= 1.5:
            boxes.append((low, low + rng.uniform(0.4, 1.2, 3)))
    yaw = rng.uniform(0, 2 * np.pi)

    def view(place: np.ndarray, yaw: float) -> np.ndarray:
        azimuth, elevation = yaw + rng.uniform(-field / 2, field / 2, count), rng.uniform(-0.5, 0.5, count)
        flat = np.cos(elevation)
        rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
        # Distances at which rays leave the room, and enter and leave boxes.
        distance = np.where(rays > 0, (np.array([5, 4, 3]) - place) / rays, (np.array([-5, -4, 0]) - place) / rays)
        distance = distance.min(axis=1)
        for low, high in boxes:
            sides = np.sort([(low - place) / rays, (high - place) / rays], axis=0)
            enters, leaves = sides[0].max(axis=1), sides[1].min(axis=1)
            seen = (enters < leaves) & (enters > 0) & (enters < distance)
            distance = np.where(seen, enters, distance)
        return place + rays * (distance + NOISE * rng.normal(size=count))[:, None]

    target = view(np.array([0, 0, 1.2]), yaw)
    source = view(np.array([apart, 0.1, 1.2]), yaw + turn)
    shift, axis = rng.normal(size=(2, 3))
    pose = translation(*(0.15 * shift / np.linalg.norm(shift)))
    pose[:3, :3] = Rotation.from_rotvec(np.deg2rad(2.5) * axis / np.linalg.norm(axis)).as_matrix()
    return Pair(mcg.PointCloud(moved(np.linalg.inv(pose), source)), mcg.PointCloud(target), pose)
