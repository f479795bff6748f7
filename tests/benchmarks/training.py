"""Whether derivatives by channels are those of the whole registration, and whether they train. Part of `gradients`."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

import mcgicp_jax as mcg
from tests.benchmarks import accuracy

# Steps of the differences: how far they move the descriptors α · channel, root mean square, in spacings of the target.
# Shorter ones measure single matches that change, longer ones other minima.
STEPS = (0.5, 1.0, 2.0)
TIGHT = {"translation_tolerance": 1e-7, "rotation_tolerance": 1e-7, "max_iterations": 200}
COLUMNS = ["clouds", "method", "matches", "cosine", "ratio of norms", "same sign", "steps agree"]
TRAINING_COLUMNS = ["trained", "seed", "loss at first", "at last", "test before", "after", "goal", "fell by", "a step"]
# By the resolved method of a pair.
METHODS: dict[str, Callable[[Any], Any]] = {
    "MC-GICP": lambda resolved: resolved,
    "Color ICP": lambda resolved: mcg.ColorICP(resolved.channel_weights),
    "photometric": lambda _: mcg.MultiChannelGICP(photometric=True),
    "Color NDT": lambda resolved: mcg.ColorNDT(resolved.channel_weights),
}
# Metres: cells of the tables for Color NDT, two voxels wide.
CELL = 0.04
LUMINANCE = np.array([[0.299], [0.587], [0.114]])
# Training: pairs of the table that are kept for the test of a seed (of twelve: six views, each flat and as recorded),
# which all seeds together test; steps; and seeds of the network.
NUM_TEST, NUM_STEPS, SEEDS = 4, 60, (0, 1, 2)
# Adam's step; the largest error of a pair that counts, metres + radians, since lost pairs teach nothing.
RATE, LARGEST_ERROR = 0.02, 0.1
# Four inputs, hidden units and one output: 199 weights.
HIDDEN = 33
# How far off the parameters of the method begin: factors of those chosen from the data.
START = {"α": 0.1, "Λ": 100.0}


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
    return cloud.replace(channels=cloud.channels @ LUMINANCE)


def pairs_of(pairs: Iterator[Any], change: Callable[[Any], Any], voxel_size: float | None) -> Iterator[Pair]:
    for pair in pairs:
        clouds = (
            cloud.replace(points=np.asarray(cloud.points, np.float64), channels=np.asarray(cloud.channels, np.float64))
            for cloud in (pair.source, pair.target)
        )
        yield Pair(*(mcg.preprocess(change(cloud), voxel_size) for cloud in clouds), pair.truth)


def tables(suffix: str) -> Iterator[Pair]:
    return pairs_of(accuracy.table(suffix), lambda cloud: with_lamp(grey(cloud)), 0.02)


# Name: pairs, and `max_distance`.
SETS: dict[str, tuple[Callable[[], Iterator[Pair]], float | None]] = {
    "flat tables": (lambda: tables("_flat"), 0.05),
    "tables as recorded": (lambda: tables(""), 0.05),
    "posters": (lambda: pairs_of(itertools.islice(accuracy.wall(1.0), 4), with_lamp, None), None),
    "LiDAR": (
        lambda: pairs_of(itertools.islice(accuracy.kitti(("intensity",)), 0, 8, 2), with_falling_gain, 0.5),
        None,
    ),
}


# Cosines


def fields(pair: Pair) -> Iterator[np.ndarray]:
    """Ten smooth changes of the source's channels: gains and offsets, even and along both of its long axes."""
    points, channels = np.asarray(pair.source.points), np.asarray(pair.source.channels)
    x, y = ((points - points.mean(axis=0)) / points.std(axis=0)).T[np.argsort(-points.std(axis=0))[:2], :, None]
    for along in (1 + 0 * x, x, y, x * y):
        yield from (along * channels, along * channels.std(axis=0))
    yield from ((along**2 - 1) * channels for along in (x, y))


def slopes(pair: Pair, method: Any, resolved: Any, options: dict[str, Any]) -> dict[str, list[Any]] | None:
    """Slopes of the pose error (metres + radians) along the fields: differences of whole registrations from the truth,
    and derivatives by hard and by soft matches. None for a pair that is lost, whose error counts no more."""
    channels, weights = np.asarray(pair.source.channels), np.asarray(resolved.channel_weights)
    points, nearest = pair.target.points, pair.target.neighbors[:, 1]
    spacing = np.median(np.linalg.norm(points[nearest] - points, axis=1))
    moves = [spacing / np.sqrt(np.mean(np.sum((weights * each) ** 2, axis=1))) * each for each in fields(pair)]

    def registered(channels: Any, **given: Any) -> Any:
        moved = pair.source.replace(channels=channels)
        return mcg.register(moved, pair.target, method, **{"init": pair.truth} | TIGHT | options | given)

    def error(channels: Any, **given: Any) -> Any:
        return sum(mcg.metrics.pose_error(registered(channels, **given).matrix, pair.truth))

    def differences(move: np.ndarray) -> list[float]:
        return [float(error(channels + step * move) - error(channels - step * move)) / (2 * step) for step in STEPS]

    pose = registered(channels).matrix
    if sum(mcg.metrics.pose_error(pose, pair.truth)) > LARGEST_ERROR:
        return None
    found: dict[str, Any] = {"differences": [differences(move) for move in moves]}
    for name, soft in (("hard", False), ("soft", True)):
        gradient = np.asarray(jax.grad(partial(error, init=pose, soft_matches=soft))(channels))
        found[name] = [float((gradient * move).sum()) for move in moves]
    return found


def cosine(left: np.ndarray, right: np.ndarray) -> float:
    return float(left @ right / max(np.linalg.norm(left) * np.linalg.norm(right), 1e-300))


def cosines(name: str, methods: Sequence[str]) -> Iterator[list[str]]:
    """Rows of the table: how the derivatives of all pairs and fields of a set agree with the differences."""
    make, max_distance = SETS[name]
    pairs = [(pair, mcg.MultiChannelGICP().resolve(pair.source, pair.target)) for pair in make()]
    for method in methods:
        if method == "Color NDT":
            pairs = [
                (pair._replace(target=mcg.voxel_gaussians(pair.target, CELL)), resolved) for pair, resolved in pairs
            ]
        each = [
            slopes(pair, METHODS[method](resolved), resolved, {"max_distance": max_distance})
            for pair, resolved in pairs
        ]
        by_step, *others = (
            np.concatenate([found[label] for found in each if found]) for label in ("differences", "hard", "soft")
        )
        expected, agree = by_step.mean(axis=1), cosine(by_step[:, 0], by_step[:, -1])
        for label, ours in zip(("hard", "soft"), others, strict=True):
            ratio = np.linalg.norm(ours) / np.linalg.norm(expected)
            same = f"{(ours * expected > 0).sum()} of {len(ours)}"
            yield [name, method, label, f"{cosine(ours, expected):.2f}", f"{ratio:.2f}", same, f"{agree:.2f}"]


# Training


def weights_of(seed: int) -> dict[str, Any]:
    """A network of 199 weights that changes nothing yet."""
    rng = np.random.default_rng(seed)
    return {
        "in": jnp.asarray(rng.normal(size=(4, HIDDEN))),
        "bias": jnp.zeros(HIDDEN),
        "out": jnp.zeros((HIDDEN, 1)),
        "gain": jnp.zeros(1),
    }


@jax.jit
def gain_of(weights: dict[str, Any], points: Any, channels: Any) -> Any:
    """A factor of the channel of each point, from its place in the view, its distance and its channel."""
    distance = jnp.linalg.norm(points, axis=1, keepdims=True)
    inputs = jnp.concatenate([3 * points[:, :2] / points[:, 2:], distance - 1, channels], axis=1)
    return jnp.exp(jnp.tanh(inputs @ weights["in"] + weights["bias"]) @ weights["out"] + weights["gain"])


def corrected(weights: dict[str, Any], cloud: Any) -> Any:
    return cloud.replace(channels=cloud.channels * gain_of(weights, cloud.points, cloud.channels))


def with_parameters(factors: dict[str, Any], method: Any) -> Any:
    """The method with α and Λ multiplied."""
    return mcg.MultiChannelGICP(
        method.channel_covariance * jnp.exp(factors.get("Λ", 0.0)),
        method.channel_weights * jnp.exp(factors.get("α", 0.0)),
        min_eigenvalue=method.min_eigenvalue,
    )


def trained(name: str, seed: int, raw: Sequence[Any], unlit: Sequence[Any], method: Any) -> list[str]:
    """A row of the table: errors of plain registration of the test pairs from the identity, before and after, and what
    they would be without the lamp, or with the parameters that the data suggest. Pairs are those of `raw`, of which a
    seed tests its own four; of `unlit` without the lamp."""
    corrects = name in ("network", "raw points")
    parameters: Any = weights_of(seed) if corrects else {name: jnp.log(START[name])}
    ready = [Pair(*(mcg.preprocess(cloud, 0.02) for cloud in pair[:2]), pair.truth) for pair in raw]
    pairs = raw if name == "raw points" else ready
    begin_test = NUM_TEST * SEEDS.index(seed)
    test = pairs[begin_test : begin_test + NUM_TEST]
    goal = unlit[begin_test : begin_test + NUM_TEST] if corrects else test
    training = [*pairs[:begin_test], *pairs[begin_test + NUM_TEST :]]

    def errors(parameters: Any, pairs: Sequence[Pair], init: Any, max_distance: float) -> list[Any]:
        given = method if corrects else with_parameters(parameters, method)
        sides: list[Any] = [[pair[side] for pair in pairs] for side in (0, 1)]
        if corrects:
            sides = [[corrected(parameters, cloud) for cloud in clouds] for clouds in sides]
        options = {"init": init, "max_distance": max_distance, "voxel_size": 0.02}
        found = mcg.register_batch(*sides, given, **options)
        return [sum(mcg.metrics.pose_error(each.matrix, pair.truth)) for each, pair in zip(found, pairs, strict=True)]

    @jax.value_and_grad
    def loss(parameters: Any) -> Any:
        found = errors(parameters, training, [pair.truth for pair in training], 0.05)
        return sum(jnp.minimum(error, LARGEST_ERROR) for error in found) / len(found)

    def tested(parameters: Any, pairs: Sequence[Any] = test) -> float:
        return 1e3 * float(np.mean(errors(parameters, pairs, None, 0.1)))

    optimizer = optax.adam(RATE if corrects else 10 * RATE)
    state, before, losses, begin = optimizer.init(parameters), tested(parameters), [], 0.0
    for _ in range(NUM_STEPS):
        value, gradient = loss(parameters)
        change, state = optimizer.update(gradient, state)
        parameters = optax.apply_updates(parameters, change)
        losses.append(1e3 * float(value))
        # The first step compiles.
        begin = begin or time.perf_counter()
    seconds = (time.perf_counter() - begin) / (NUM_STEPS - 1)
    after = tested(parameters)
    fell = f"{100 * (1 - after / before):.0f} %"
    return [
        name,
        str(seed),
        f"{losses[0]:.1f}",
        f"{np.mean(losses[-5:]):.1f}",
        f"{before:.1f}",
        f"{after:.1f}",
        # Weights of a network that change nothing; factors of 1.
        f"{tested(weights_of(seed) if corrects else {}, goal):.1f}",
        fell,
        f"{seconds:.1f} s",
    ]


def step_inside_jit(raw: Sequence[Any], method: Any) -> tuple[float, float]:
    """Seconds of the first and of later steps of the network with eight pairs inside `jit`, padded to one size."""
    ready = [[mcg.preprocess(cloud, 0.02) for cloud in pair[:2]] for pair in raw[NUM_TEST:]]
    size = max(len(cloud) for pair in ready for cloud in pair)
    sources, targets = (mcg.PointCloud.stack([pair[side].pad(size) for pair in ready]) for side in (0, 1))
    truths = jnp.stack([pair.truth for pair in raw[NUM_TEST:]])

    def error(weights: dict[str, Any], source: Any, target: Any, truth: Any) -> Any:
        clouds = [corrected(weights, cloud) for cloud in (source, target)]
        result = mcg.register(*clouds, method, init=truth, max_distance=0.05)
        return jnp.minimum(sum(mcg.metrics.pose_error(result.matrix, truth)), LARGEST_ERROR)

    @jax.jit
    @jax.value_and_grad
    def loss(weights: dict[str, Any]) -> Any:
        return jnp.mean(jax.vmap(error, (None, 0, 0, 0))(weights, sources, targets, truths))

    times = []
    for _ in range(6):
        begin = time.perf_counter()
        jax.block_until_ready(loss(weights_of(0)))
        times.append(time.perf_counter() - begin)
    return times[0], float(np.median(times[1:]))


def training() -> Iterator[list[str]]:
    """Rows of the table of training: eight pairs of four views of the table, tested on four pairs of two others, and
    their means over the seeds, which test all twelve; at last the time of a step of the network inside `jit`."""
    sets = [list(accuracy.table(suffix)) for suffix in ("_flat", "")]
    unlit = [
        Pair(grey(pair.source), grey(pair.target), pair.truth) for both in zip(*sets, strict=True) for pair in both
    ]
    raw = [Pair(with_lamp(pair.source), with_lamp(pair.target), pair.truth) for pair in unlit]
    resolved = [mcg.MultiChannelGICP().resolve(*(mcg.preprocess(cloud, 0.02) for cloud in pair[:2])) for pair in raw]
    method = jax.tree.map(lambda *numbers: np.median(np.stack(numbers), axis=0), *resolved)
    for name in ("network", "raw points", *START):
        rows = [trained(name, seed, raw, unlit, method) for seed in SEEDS]
        before, after, goal = (np.mean([float(row[i]) for row in rows]) for i in (4, 5, 6))
        mean = "", "", f"{before:.1f}", f"{after:.1f}", f"{goal:.1f}", f"{100 * (1 - after / before):.0f} %", ""
        yield from (*rows, [name, "all", *mean])
    first, step = step_inside_jit(raw, method)
    yield ["network inside jit", "", "", "", "", "", "", f"first {first:.0f} s", f"{step:.1f} s"]
