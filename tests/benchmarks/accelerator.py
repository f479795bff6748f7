"""Many pairs on JAX's default device: from raw arrays to poses, and `jit(vmap(...))` with its gradient.

Run `python -m tests.benchmarks.accelerator` on a machine with a GPU; see README.md. On a CPU it runs, too, and says so
(`--scale 16` for a sixteenth of the pairs).
"""

from __future__ import annotations

import argparse
import os
import time
import warnings
from collections.abc import Callable
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax._registration import chunks
from tests.benchmarks.accuracy import DATA

# small_gicp's tolerances.
OPTIONS = {"max_distance": 2.0, "translation_tolerance": 1e-3, "rotation_tolerance": np.radians(0.1)}
TURNS = 3
# Name: pairs, and the fewest and most points of a cloud.
SETS = {
    "64 × 2,000": (64, 2000, 2000),
    "1,024 × 2,000": (1024, 2000, 2000),
    "512 × 6,000": (512, 6000, 6000),
    "256 × 700 to 6,000": (256, 700, 6000),
}
METHODS = {"GICP": mcg.GICP(), "MC-GICP": mcg.MultiChannelGICP()}
# Pairs whose poses are compared with those of trees.
COMPARED = 16
COLUMNS = [
    "pairs",
    "method",
    "first call",
    "pairs/s",
    "chunks",
    "device busy",
    "host per pair, chunk",
    "apart, median, largest",
    "other statuses",
]
BY_JIT = ["pairs", "method", "first call", "pairs/s", "with gradient: first call", "pairs/s"]


def random_pairs(count: int, fewest: int, most: int) -> list[tuple[mcg.PointCloud, mcg.PointCloud]]:
    """Random points of two scans of KITTI averaged in voxels of 0.25 m: source and target."""
    folder = DATA / "kitti" / "sequences" / "04" / "velodyne"
    target, source = (mcg.preprocess(mcg.io.read(folder / f"00000{i}.bin"), 0.25) for i in (0, 1))
    rng = np.random.default_rng(0)

    def some(cloud: mcg.PointCloud) -> mcg.PointCloud:
        rows = rng.permutation(len(cloud))[: rng.integers(fewest, most + 1)]
        return mcg.PointCloud(np.asarray(cloud.points)[rows], np.asarray(cloud.channels)[rows])

    return [(some(source), some(target)) for _ in range(count)]


def timed(function: Callable[[], Any]) -> tuple[float, float, Any]:
    """Seconds of the first call and of the quickest of the others, and the last result."""
    times = []
    for _ in range(TURNS + 1):
        begin = time.perf_counter()
        result = jax.block_until_ready(function())
        times.append(time.perf_counter() - begin)
    return times[0], min(times[1:]), result


def batch_row(name: str, method_name: str, pairs: list[Any]) -> list[str]:
    """`register_batch` of raw clouds, on the device whatever it is."""
    method = METHODS[method_name]
    options: Any = {"voxel_size": None, "covariances": False, **OPTIONS}
    sources, targets = map(list, zip(*pairs, strict=True))

    def batch() -> list[mcg.RegistrationResult]:
        return mcg.register_batch(sources, targets, method, search=mcg.DenseSearch(), **options)

    first, seconds, results = timed(batch)
    # The device's own time: each chunk alone, awaited.
    device: list[float] = []
    program = chunks._registered

    def awaited(*arguments: Any, **named: Any) -> Any:
        arguments = jax.block_until_ready(arguments)
        begin = time.perf_counter()
        result = jax.block_until_ready(program(*arguments, **named))
        device.append(time.perf_counter() - begin)
        return result

    with mock.patch.object(chunks, "_registered", awaited):
        batch()
    host = max(0, seconds - sum(device))
    options.pop("covariances")
    apart, others = [], 0
    for (source, target), result in zip(pairs[:COMPARED], results, strict=False):
        clouds = (mcg.preprocess(cloud, None) for cloud in (source, target))
        options.pop("voxel_size", None)
        alone = mcg.register(*clouds, method, search=mcg.KDTreeSearch(1), **options)
        apart.append(max(mcg.metrics.pose_error(result.matrix, alone.matrix)))
        others += result.status is not alone.status
    return [
        name,
        method_name,
        f"{first:.1f} s",
        f"{len(pairs) / seconds:.0f}",
        str(len(device)),
        f"{min(1, sum(device) / seconds):.0%}",
        f"{1e3 * host / len(pairs):.2f}, {1e3 * host / len(device):.0f} ms",
        f"{np.median(apart):.1e}, {max(apart):.1e}",
        f"{others} of {len(apart)}",
    ]


def differentiated_row(name: str, method_name: str, pairs: list[Any]) -> list[str]:
    """Value and gradient of `register_batch` by the points of its sources, which the host computes."""
    method, targets = METHODS[method_name], [target for _, target in pairs]

    def loss(points: list[Any]) -> Any:
        sources = [source.replace(points=moved) for (source, _), moved in zip(pairs, points, strict=True)]
        results = mcg.register_batch(sources, targets, method, voxel_size=None, **OPTIONS)
        return sum(jnp.sum(result.matrix[:3, 3] ** 2) for result in results)

    points = [jnp.asarray(source.points) for source, _ in pairs]
    first, seconds, _ = timed(lambda: jax.value_and_grad(loss)(points))
    return [name, method_name, f"{first:.1f} s", f"{len(pairs) / seconds:.0f}"]


def transformed_row(name: str, method_name: str, pairs: list[Any]) -> list[str]:
    """`jit(vmap(register))` of raw points, and its gradient by the source's points."""
    method = METHODS[method_name]
    size = max(len(cloud) for pair in pairs for cloud in pair)
    sources, targets = (mcg.PointCloud.stack([pair[side].pad(size) for pair in pairs]) for side in (0, 1))

    def distance(source: mcg.PointCloud, target: mcg.PointCloud) -> Any:
        clouds = (mcg.preprocess(cloud, None, search=mcg.DenseSearch()) for cloud in (source, target))
        result = mcg.register(*clouds, method, search=mcg.DenseSearch(), **OPTIONS)
        return jnp.sum(result.matrix[:3, 3] ** 2)

    def by_points(source: mcg.PointCloud, target: mcg.PointCloud) -> Any:
        return jax.value_and_grad(lambda points: distance(source.replace(points=points), target))(source.points)

    row = [name, method_name]
    for function in (distance, by_points):
        program = jax.jit(jax.vmap(function))
        first, seconds, _ = timed(lambda program=program: program(sources, targets))
        row += [f"{first:.1f} s", f"{len(pairs) / seconds:.0f}"]
    return row


def print_table(columns: list[str], rows: list[list[str]]) -> None:
    for row in (columns, ["---"] * len(columns), *rows):
        print(f"| {' | '.join(row)} |", flush=True)
    print()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=int, default=1, help="divides the numbers of pairs")
    scale = parser.parse_args().scale
    warnings.simplefilter("ignore")
    print(f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores, JAX {jax.__version__}\n")
    rows = []
    for name, (count, *sizes) in SETS.items():
        for method in METHODS:
            rows.append(batch_row(name, method, random_pairs(max(2, count // scale), *sizes)))
    print_table(COLUMNS, rows)
    # As many at a time as memory allows without thought.
    rows = [
        transformed_row(name, method, random_pairs(max(2, 64 // scale), *SETS[name][1:]))
        for name in ("64 × 2,000", "512 × 6,000")
        for method in METHODS
    ]
    print_table(BY_JIT, rows)
    rows = [
        differentiated_row("64 × 2,000", method, random_pairs(max(2, 64 // scale), 2000, 2000)) for method in METHODS
    ]
    print_table(["gradient of a batch", "method", "first call", "pairs/s"], rows)


if __name__ == "__main__":
    main()
