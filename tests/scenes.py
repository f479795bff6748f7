"""Small synthetic clouds with known motion, shared by the tests; of few sizes, since every size compiles."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax._methods.surfaces import searchable, surface_pair, surface_table
from mcgicp_jax._pose_solver.matched import Matches, Motion, match_surfaces
from tests.reference import pose


def motion(twist=(0.05, -0.03, 0.04, 0.02, -0.03, 0.05)) -> np.ndarray:
    """A rigid motion, (4, 4) float64, from its translation and rotation vector."""
    return pose(twist[3:], twist[:3])


def room_corner(size: int, noise: float = 0.01, channel_noise: float = 0.02, seed: int = 0, channels: int = 2):
    """Points (N, 3) on three faces of a 2 m cube, with channels (N, C) that vary smoothly over them."""
    rng = np.random.default_rng(seed)
    face = rng.integers(0, 3, size)
    points = rng.random((size, 3)) * 2
    points[np.arange(size), face] = 0
    x, y, z = points.T
    paint = np.stack([np.sin(5 * x) * np.cos(4 * y) + z, np.sin(3 * z + x), np.cos(4 * y + 2 * z)], axis=1)[
        :, :channels
    ]
    return points + noise * rng.normal(size=points.shape), paint + channel_noise * rng.normal(size=paint.shape)


def wall(size: int, noise: float = 0.002, seed: int = 0):
    """Points on a flat 2 m wall, with three channels that vary smoothly over it."""
    rng = np.random.default_rng(seed)
    x, y = 2 * rng.random((2, size))
    points = np.stack([x, y, noise * rng.normal(size=size)], axis=1)
    paint = np.stack([np.sin(7 * x), np.cos(6 * y + x), np.sin(5 * (x + y))], axis=1)
    return points, paint + 0.01 * rng.normal(size=paint.shape)


def raw_pair(scene=room_corner, size: int = 2000, truth: np.ndarray | None = None, seed: int = 1, **settings):
    """Source and target, sampled independently, and the true T_target_source."""
    truth = motion() if truth is None else truth
    points, channels = scene(size, seed=seed, **settings)
    source = mcg.PointCloud((points - truth[:3, 3]) @ truth[:3, :3], channels)
    return source, mcg.PointCloud(*scene(size, seed=seed + 1, **settings)), truth


def pair(*arguments, **settings):
    """Those of `raw_pair`, preprocessed."""
    source, target, truth = raw_pair(*arguments, **settings)
    return mcg.preprocess(source), mcg.preprocess(target), truth


def prepare(method, cloud, observed=False):
    """The surface that a resolved method computes for one concrete cloud."""
    surface, *_ = surface_table(cloud, method, (), cloud.neighbors is not None, observed).trees()
    return surface._replace(search=searchable(method, cloud))


def covariances(method, cloud):
    """Packed covariances (6, N) of a resolved method, for concrete and traced clouds."""
    return surface_pair(method, cloud, cloud, observed=False).whole().source.covariance.T


def matched_at(source, target, method, pose, matches, robust=None, temperature=None):
    """The matched surfaces of a method, both surfaces with the terms, and the motion of a pose."""
    both = surface_pair(method, source, target, observed=False, robust=robust).whole()
    pose = jnp.asarray(pose, source.points.dtype)
    matched = jax.jit(match_surfaces)(both.source, both.target, Matches.given(matches, temperature))
    return matched, both, Motion(pose[:3, :3], pose[:3, 3])


Side = tuple[Sequence[float], Sequence[float], Sequence[float]]
"""A rectangle, by a corner and two edges."""


def rects(rng: np.random.Generator, count: int, sides: Sequence[Side]) -> np.ndarray:
    """Points (count, 3) spread evenly over rectangles."""
    corners, first, second = (np.array(part, float) for part in zip(*sides, strict=True))
    areas = np.linalg.norm(np.cross(first, second), axis=1)
    rows = rng.choice(len(areas), count, p=areas / areas.sum())
    along, across = rng.random((2, count, 1))
    return corners[rows] + along * first[rows] + across * second[rows]


def rectangles(*sides: Side) -> Callable[..., np.ndarray]:
    """A function that samples rectangles evenly, with noise in units of the spacing."""

    def sample(rng: np.random.Generator, count: int, noise: float) -> np.ndarray:
        points, area = rects(rng, count, sides), sum(np.linalg.norm(np.cross(*edges)) for _, *edges in sides)
        return points + noise * np.sqrt(area / count) * rng.normal(size=points.shape)

    return sample


CORRIDOR: list[Side] = [
    *(((-10, -1, z), (20, 0, 0), (0, 2, 0)) for z in (0, 2.5)),
    *(((-10, y, 0), (20, 0, 0), (0, 0, 2.5)) for y in (-1, 1)),
]
SURFACES = {
    "plane": rectangles(((-5, -5, 0), (10, 0, 0), (0, 10, 0))),
    "floor and wall": rectangles(((-10, 0, 0), (20, 0, 0), (0, 4, 0)), ((-10, 0, 0), (20, 0, 0), (0, 0, 3))),
    "corridor": rectangles(*CORRIDOR),
    "crossing planes": rectangles(((-10, -2, 0), (20, 0, 0), (0, 4, 0)), ((-10, -1, -1.7), (20, 0, 0), (0, 2, 3.4))),
    "room": rectangles(
        ((-3, -2, 0), (6, 0, 0), (0, 4, 0)),
        *(((-3, y, 0), (6, 0, 0), (0, 0, 2.5)) for y in (-2, 2)),
        *(((x, -2, 0), (0, 4, 0), (0, 0, 2.5)) for x in (-3, 3)),
    ),
}
