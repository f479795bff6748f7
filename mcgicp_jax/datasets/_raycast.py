"""Ray casting into scenes of boxes and upright cylinders, random rays, and random surface patterns; in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

Vector: TypeAlias = Float[np.ndarray, "3"]
Rays: TypeAlias = Float[np.ndarray, "N 3"]
Distances: TypeAlias = Float[np.ndarray, "N"]


@dataclass(frozen=True, eq=False)
class Box:
    """An axis-aligned box between its lowest and highest corner; the sensor must be outside of it."""

    low: Vector
    high: Vector

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        return self.low, self.high

    def meet(self, origin: Vector, rays: Rays) -> tuple[Distances, Rays]:
        """Distance along unit rays to their entry into the solid, infinite if they miss; and unit normals."""
        # A ray parallel to a face divides by zero: the result is an infinity of the right sign, or NaN, a miss.
        with np.errstate(divide="ignore", invalid="ignore"):
            to_low, to_high = (self.low - origin) / rays, (self.high - origin) / rays
        near, far = np.minimum(to_low, to_high), np.maximum(to_low, to_high)
        ray, axis = np.arange(len(rays)), np.argmax(near, axis=1)
        entry, leave = near[ray, axis], far.min(axis=1)
        normals = np.zeros_like(rays)
        normals[ray, axis] = -np.sign(rays[ray, axis])
        return np.where((entry > 0) & (entry <= leave), entry, np.inf), normals


@dataclass(frozen=True, eq=False)
class Cylinder:
    """The lateral surface of an upright cylinder, whose lower end is centred at `foot`; see `Box`."""

    foot: Vector
    radius: float
    height: float

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        around = np.array([self.radius, self.radius, 0])
        return self.foot - around, self.foot + around + (0, 0, self.height)

    def meet(self, origin: Vector, rays: Rays) -> tuple[Distances, Rays]:
        offset = origin - self.foot
        square, product = (rays[:, :2] ** 2).sum(axis=1), rays[:, :2] @ offset[:2]
        discriminant = product**2 - square * (offset[:2] @ offset[:2] - self.radius**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            entry = (-product - np.sqrt(discriminant)) / square
            height = offset[2] + entry * rays[:, 2]
            normals = (offset + entry[:, None] * rays) * (1, 1, 0) / self.radius
        return np.where((entry > 0) & (height >= 0) & (height <= self.height), entry, np.inf), normals


Solid: TypeAlias = Box | Cylinder


class Hits(NamedTuple):
    """The hits of rays on solids in the world frame, without the rays that miss."""

    rays: Rays  # unit vectors
    sensor_rays: Rays  # the same in the sensor's frame
    distance: Distances
    points: Rays
    normals: Rays  # unit vectors towards the sensor
    solid: Int[np.ndarray, "N"]  # index of the solid


def cast(pose: Float[np.ndarray, "4 4"], rays: Rays, solids: Sequence[Solid], max_range: float) -> Hits:
    """The nearest hit within `max_range` of each ray, which is in the sensor's frame; ties go to the first solid."""
    rotation, origin = pose[:3, :3], pose[:3, 3]
    rays = rays @ rotation.T
    distance, normals, solid = np.full(len(rays), max_range), np.zeros_like(rays), np.full(len(rays), -1)
    for number, candidate in enumerate(solids):
        # Only the rays in the cone around its bounding sphere may hit the solid.
        low, high = candidate.bounds
        center, radius = (low + high) / 2 - origin, np.linalg.norm(high - low) / 2
        center_distance = np.linalg.norm(center)
        if center_distance - radius > max_range:
            continue
        rows = np.arange(len(rays))
        if center_distance > radius:
            rows = np.flatnonzero(rays @ (center / center_distance) >= np.sqrt(1 - (radius / center_distance) ** 2))
        entry, entry_normals = candidate.meet(origin, rays[rows])
        nearer = entry < distance[rows]
        rows = rows[nearer]
        distance[rows], normals[rows], solid[rows] = entry[nearer], entry_normals[nearer], number
    hit = solid >= 0
    rays, distance = rays[hit], distance[hit]
    points = origin + distance[:, None] * rays
    return Hits(rays, rays @ rotation, distance, points, normals[hit], solid[hit])


def random_rays(rng: np.random.Generator, size: int) -> Rays:
    """Random unit rays, uniform over the sphere."""
    rays = rng.normal(size=(size, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def sensor_rotation(heading: float, tilt: float, direction: float) -> Rotation:
    """A turn by `heading` about z, after a tilt about the horizontal axis in a `direction`; radians."""
    tilted = Rotation.from_rotvec([tilt * np.cos(direction), tilt * np.sin(direction), 0])
    return Rotation.from_euler("z", heading) * tilted


def patches(
    points: Float[np.ndarray, "N D"], layers: Sequence[tuple[float, float]], seed: int
) -> Float[np.ndarray, "N"]:
    """A smooth random pattern: a sum of layers, each with a width of its patches and an amplitude; D is 1, 2 or 3."""
    total = np.zeros(len(points))
    for number, (width, amplitude) in enumerate(layers):
        # Value noise from −1 to 1: random values at the corners of grid cells, interpolated by smoothsteps.
        scaled = np.asarray(points, float) / width
        corner = np.floor(scaled).astype(np.int64)
        fraction = scaled - corner
        fraction = fraction * fraction * (3 - 2 * fraction)
        noise = np.zeros(len(scaled))
        for bits in np.ndindex(*(2,) * scaled.shape[1]):
            weight = np.prod(np.where(bits, fraction, 1 - fraction), axis=1)
            noise += weight * random_cells(corner + bits, seed + number)
        total += amplitude * (2 * noise - 1)
    return total


def random_cells(cells: Int[np.ndarray, "N D"], seed: int) -> Float[np.ndarray, "N"]:
    """A random number from 0 to 1 for each cell of an infinite grid, by hashing its index with SplitMix64."""
    mixed = np.full(len(cells), seed, np.uint64)
    for column in cells.T:
        mixed = (mixed ^ column.astype(np.uint64)) + np.uint64(0x9E3779B97F4A7C15)
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed = mixed ^ (mixed >> np.uint64(31))
    return (mixed >> np.uint64(11)) / 2.0**53
