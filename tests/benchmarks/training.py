"""Whether derivatives by channels are those of the whole registration, and whether they train. Part of `gradients`."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import mcgicp_jax as mcg
from tests.benchmarks import accuracy

# Steps of the differences: how far they move the descriptors α · channel, root mean square, in spacings of the target.
# Shorter ones measure single matches that change, longer ones other minima.
STEPS = (0.5, 1.0, 2.0)
TIGHT = {"translation_tolerance": 1e-7, "rotation_tolerance": 1e-7, "max_iterations": 200}
# Name: matches are soft, photometric term.
DERIVATIVES = {"hard": (False, False), "soft": (True, False), "photometric": (False, True)}
LUMINANCE = np.array([[0.299], [0.587], [0.114]])
# Pairs of a training step, at most so many errors of which count, metres + radians: lost pairs teach nothing.
LARGEST_ERROR = 0.1
NUM_STEPS, RATE, SEEDS = 60, 0.02, (0, 1, 2)


class Pair(NamedTuple):
    source: Any
    target: Any
    truth: np.ndarray


# The clouds


def with_lamp(cloud: Any) -> Any:
    """The cloud as if lit by a lamp on the sensor, which is brightest beside the middle of the view."""
    distance = np.linalg.norm(cloud.points, axis=1, keepdims=True)
    beside = cloud.points[:, :2] / cloud.points[:, 2:] - np.array([0.08, 0])
    light = (0.35 + 0.9 * np.exp(-(beside**2).sum(axis=1, keepdims=True) / 0.09)) * (1.2 / distance) ** 2
    return mcg.PointCloud(cloud.points, cloud.channels * light)


def with_falling_gain(cloud: Any) -> Any:
    """The cloud within 40 m, with an intensity that falls with range."""
    distance = np.linalg.norm(cloud.points, axis=1, keepdims=True)
    near = (distance[:, 0] > 3) & (distance[:, 0] < 40)
    return mcg.PointCloud(cloud.points[near], (cloud.channels[:, :1] * 10 / (10 + distance))[near])


def grey(cloud: Any) -> Any:
    return cloud.replace(channels=cloud.channels @ LUMINANCE, channel_names=())


def pairs_of(pairs: Iterator[Any], change: Callable[[Any], Any], voxel_size: float | None) -> Iterator[Pair]:
    for pair in pairs:
        clouds = (
            cloud.replace(points=np.asarray(cloud.points, np.float64), channels=np.asarray(cloud.channels, np.float64))
            for cloud in (pair.source, pair.target)
        )
        yield Pair(*(mcg.preprocess(change(cloud), voxel_size) for cloud in clouds), pair.truth)


def tables(suffix: str) -> Iterator[Pair]:
    return pairs_of(accuracy.table(suffix), lambda cloud: with_lamp(grey(cloud)), 0.02)


SETS: dict[str, Callable[[], Iterator[Pair]]] = {
    "flat tables": lambda: tables("_flat"),
    "tables as recorded": lambda: tables(""),
    "posters": lambda: pairs_of(itertools.islice(accuracy.wall(1.0), 4), with_lamp, None),
    "LiDAR": lambda: pairs_of(itertools.islice(accuracy.kitti(("intensity",)), 0, 8, 2), with_falling_gain, 0.5),
}


# Cosines


def fields(pair: Pair) -> Iterator[np.ndarray]:
    """Ten smooth changes of the source's channels: gains and offsets, even and along both of its long axes."""
    points, channels = np.asarray(pair.source.points), np.asarray(pair.source.channels)
    x, y = ((points - points.mean(axis=0)) / points.std(axis=0)).T[np.argsort(-points.std(axis=0))[:2], :, None]
    for along in (1 + 0 * x, x, y, x * y):
        yield from (along * channels, along * channels.std(axis=0))
    yield from ((along**2 - 1) * channels for along in (x, y))


def error_of(pair: Pair, method: Any, channels: Any, **options: Any) -> Any:
    """Error of the pose, metres + radians."""
    moved = pair.source.replace(channels=channels)
    result = mcg.register(moved, pair.target, method, **{"init": pair.truth} | TIGHT | options)
    return sum(mcg.metrics.pose_error(result.matrix, pair.truth))


def cosines(make: Callable[[Any], Any], names: Sequence[str]) -> list[list[str]]:
    """Rows of a table: derivatives along smooth fields, against differences of the whole registration from the truth.

    `make` makes the method from the resolved one of a pair.
    """
    import jax

    rows = []
    for name in names:
        found: dict[str, list[float]] = {each: [] for each in ("differences", *DERIVATIVES)}
        for pair in SETS[name]():
            resolved = mcg.MultiChannelGICP().resolve(pair.source, pair.target)
            channels, weights = np.asarray(pair.source.channels), np.asarray(resolved.channel_weights)
            spacing = np.median(
                np.linalg.norm(pair.target.points[pair.target.neighbors[:, 1]] - pair.target.points, axis=1)
            )
            scaled = [spacing / np.sqrt(((weights * field) ** 2).sum(axis=1).mean()) * field for field in fields(pair)]
            error = partial(error_of, pair, make(resolved))
            for field in scaled:
                slopes = [(error(channels + s * field) - error(channels - s * field)) / (2 * s) for s in STEPS]
                found["differences"].append(float(np.mean(slopes)))
            start = mcg.register(pair.source, pair.target, make(resolved), init=pair.truth, **TIGHT).matrix
            for label, (soft, photometric) in DERIVATIVES.items():
                method = mcg.MultiChannelGICP(photometric=True) if photometric else make(resolved)
                loss = partial(error_of, pair, method, soft_matches=soft, init=pair.truth if photometric else start)
                gradient = np.asarray(jax.grad(loss)(channels))
                found[label] += [float((gradient * field).sum()) for field in scaled]
        expected = np.array(found.pop("differences"))
        for label, slopes in found.items():
            ours = np.array(slopes)
            lengths = np.linalg.norm(ours), np.linalg.norm(expected)
            cosine = ours @ expected / max(lengths[0] * lengths[1], 1e-300)
            same = f"{(ours * expected > 0).sum()} of {len(ours)}"
            rows.append(
                [name, type(make(resolved)).__name__, label, f"{cosine:.2f}", f"{lengths[0] / lengths[1]:.2f}", same]
            )
    return rows
