"""Pairs per second of `register_batch` and of small_gicp with one process per core, memory of a stream, and gradients.

`ours` is by threads. Called by default, a batch begins with these; processes take over where they pay.

Run `python -m tests.benchmarks.batch`; see README.md. Libraries take turns; ratios are computed within one turn.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import pathlib
import resource
import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

DATA = pathlib.Path(os.environ.get("MCGICP_DATA", pathlib.Path(__file__).parents[3] / "shared" / "data"))
NUM_TURNS = 5
MAX_DISTANCE = 1.0
# small_gicp's defaults, used for both
TOLERANCES = {"translation_tolerance": 1e-3, "rotation_tolerance": np.radians(0.1)}

Pair = tuple[np.ndarray, np.ndarray, np.ndarray]


def lidar_pairs(count: int, keep: float | tuple[float, float], thinned: float | None) -> list[Pair]:
    """Random resamplings and rigid motions of one pair of downsampled scans: source, target and the true pose.

    Args:
        keep: the fraction of points to keep, or the range from which each pair's is drawn.
    """
    import mcgicp_jax as mcg

    folder = DATA / "lidar_pair"
    source, target = (np.asarray(mcg.io.read(folder / f"{name}.ply").points, float) for name in ("source", "target"))
    if thinned is not None:
        source, target = (mcg.preprocess(cloud, thinned).unpad().points.astype(float) for cloud in (source, target))
    truth = np.loadtxt(folder / "T_target_source.txt")
    rng = np.random.default_rng(0)
    pairs = []
    for _ in range(count):
        moved = np.eye(4)
        moved[:3, :3] = Rotation.from_rotvec(0.01 * rng.normal(size=3)).as_matrix()
        moved[:3, 3] = 0.2 * rng.normal(size=3)
        share = rng.uniform(*keep) if isinstance(keep, tuple) else keep
        a, b = (cloud[rng.random(len(cloud)) < share] for cloud in (source, target))
        pairs.append(((a @ moved[:3, :3].T + moved[:3, 3]).astype(np.float32), b, truth @ np.linalg.inv(moved)))
    return pairs


def ours(pairs: list[Pair], voxel: float | None, executor: Any = None) -> list[np.ndarray]:
    import mcgicp_jax as mcg

    sources, targets = ([pair[side].astype(np.float32) for pair in pairs] for side in (0, 1))
    results = mcg.register_batch(
        sources, targets, mcg.GICP(), max_distance=MAX_DISTANCE, voxel_size=voxel, executor=executor, **TOLERANCES
    )
    return [np.asarray(result.matrix) for result in results]


def theirs(pairs: list[Pair], voxel: float | None) -> list[np.ndarray]:
    import small_gicp

    poses = []
    for source, target, _ in pairs:
        (a, _), (b, tree) = (_prepared(cloud.astype(float), voxel) for cloud in (source, target))
        result = small_gicp.align(b, a, tree, np.eye(4), max_correspondence_distance=MAX_DISTANCE, num_threads=1)
        poses.append(np.asarray(result.T_target_source))
    return poses


def _prepared(points: np.ndarray, voxel: float | None) -> tuple[Any, Any]:
    import small_gicp

    if voxel is not None:
        return small_gicp.preprocess_points(points, voxel, num_neighbors=20, num_threads=1)
    cloud = small_gicp.PointCloud(points)
    tree = small_gicp.KdTree(cloud)
    small_gicp.estimate_covariances(cloud, tree, num_neighbors=20, num_threads=1)
    return cloud, tree


def _serve(connection: Any, pairs: list[Pair], voxel: float | None) -> None:
    connection.send(None)
    while connection.recv():
        connection.send(theirs(pairs, voxel))


class Processes:
    """small_gicp in several processes that divide the pairs among them."""

    def __init__(self, pairs: list[Pair], voxel: float | None, count: int):
        context = multiprocessing.get_context("spawn")
        self._connections = []
        for i in range(count):
            mine, other = context.Pipe()
            context.Process(target=_serve, args=(other, pairs[i::count], voxel), daemon=True).start()
            self._connections.append(mine)
        for connection in self._connections:
            connection.recv()

    def __call__(self) -> list[np.ndarray]:
        for connection in self._connections:
            connection.send(True)
        parts = [connection.recv() for connection in self._connections]
        poses: list[Any] = [None] * sum(map(len, parts))
        for i, part in enumerate(parts):
            poses[i :: len(parts)] = part
        return poses

    def close(self) -> None:
        for connection in self._connections:
            connection.send(False)


def _timed(function: Callable[[], Any]) -> tuple[float, float, Any]:
    """Wall time, processor time of this process alone, and the return value."""
    wall, cpu = time.perf_counter(), time.process_time()
    answer = function()
    return time.perf_counter() - wall, time.process_time() - cpu, answer


def rates() -> None:
    from mcgicp_jax._pairs.processes import Processes as Workers

    cores = len(os.sched_getaffinity(0))
    print(f"\nPairs per second, preprocessing included, {cores} cores, GICP, medians of {NUM_TURNS} turns")
    print(f"{'pairs':>12} {'points':>8} {'ours':>8} {'processes':>10} {'small_gicp':>11} {'ratio':>7}", end="")
    print(f" {'of processes':>13} {'over the turns':>15} {'processor time ratio':>21} {'poses apart':>12}")
    # The last: 2,000 to 20,000 points per cloud.
    for count, voxel, keep, thinned in ((384, None, 0.77, 0.5), (64, 0.25, 0.95, None), (60, None, (0.1, 1), 0.08)):
        pairs = lidar_pairs(count, keep, thinned)
        timed = partial(_timed_ours, pairs, voxel)
        processes, workers = Processes(pairs, voxel, cores), Workers(cores)
        timed("threads")
        workers.shutdown(cancel_futures=True)
        by_default = timed(None)[0]
        workers.shutdown(cancel_futures=True)
        start = timed(workers)[0] - timed(workers)[0]
        processes()
        turns = []
        for _ in range(NUM_TURNS):
            wall, cpu, found = timed("threads")
            wall_processes, _, _ = timed(workers)
            wall_theirs, _, other = _timed(processes)
            _, cpu_theirs, _ = _timed(lambda pairs=pairs, voxel=voxel: theirs(pairs[:16], voxel))
            walls = np.array([wall, wall_processes, wall_theirs])
            turns.append((*(count / walls), *(wall_theirs / walls[:2]), cpu_theirs * count / 16 / cpu))
        mine, in_processes, rate, ratio, ratio_processes, cpu_ratio = np.median(turns, axis=0)
        ratios = sorted(turn[4] for turn in turns)
        apart = max(np.linalg.norm(a[:3, 3] - b[:3, 3]) for a, b in zip(found, other, strict=True))
        processes.close()
        size = _size(pairs[0], voxel)
        print(f"{count:12} {size:8,} {mine:8.1f} {in_processes:10.1f} {rate:11.1f} {ratio:7.2f}", end="")
        print(f" {ratio_processes:13.2f} {ratios[0]:7.2f} to {ratios[-1]:.2f} {cpu_ratio:21.2f} {1e3 * apart:9.2f} mm")
        one = Workers(1)
        timed(one)
        alone = count / statistics.median(timed(one)[0] for _ in range(3))
        print(
            f"{'':12} one worker {alone:.1f}, efficiency of {cores} {in_processes / alone / cores:.2f}; start", end=""
        )
        print(f" {start:.1f} s, which pays off from {start / (1 / mine - 1 / in_processes):,.0f} pairs")
        print(
            f"{'':12} by default, no process waiting: {count / by_default:.1f}, {count / by_default / rate:.2f} of",
            end="",
        )
        print(" small_gicp")


def gradients() -> None:
    """Value and gradient of a batch in processes by the points of its sources, relative to the batch alone."""
    import jax
    import jax.numpy as jnp

    import mcgicp_jax as mcg

    pairs = lidar_pairs(60, (0.1, 1), 0.08)
    targets = [pair[1].astype(np.float32) for pair in pairs]
    options = {"max_distance": MAX_DISTANCE, "voxel_size": None, "executor": "processes", **TOLERANCES}

    def loss(sources: list[Any]) -> Any:
        results = mcg.register_batch(sources, targets, mcg.GICP(), **options)
        return sum(jnp.sum(result.matrix[:3, 3]) for result in results)

    ratios = []
    for turn in range(NUM_TURNS + 1):
        forward = _timed(lambda: loss([pair[0] for pair in pairs]))[0]
        gradient = _timed(lambda: jax.block_until_ready(jax.grad(loss)([jnp.asarray(pair[0]) for pair in pairs])))[0]
        # The first turn starts the workers and compiles.
        if turn:
            ratios.append(gradient / forward)
    print(f"\ngradient of a batch of {len(pairs)} ragged pairs in processes:", end=" ")
    print(f"{statistics.median(ratios):.2f} times its forward call ({min(ratios):.2f} to {max(ratios):.2f})")


def _timed_ours(pairs: list[Pair], voxel: float | None, executor: Any) -> tuple[float, float, Any]:
    return _timed(lambda: ours(pairs, voxel, executor))


def _size(pair: Pair, voxel: float | None) -> int:
    import mcgicp_jax as mcg

    return len(mcg.preprocess(pair[0], voxel))


def memory() -> None:
    """Peak memory of streams of clouds that are generated as they are consumed."""
    import mcgicp_jax as mcg

    rng = np.random.default_rng(0)

    def clouds(count: int) -> Iterator[np.ndarray]:
        for _ in range(count):
            points = rng.random((300, 3)).astype(np.float32)
            points[np.arange(300), np.arange(300) % 3] = 0
            yield points

    print("\nPeak memory of the process after a stream of pairs of 300 points, GICP")
    target = next(clouds(1))
    for count in (100, 1000, 10000):
        wall = time.perf_counter()
        completed = mcg.register_as_completed(clouds(count), target, mcg.GICP(), max_distance=0.2, max_iterations=8)
        statuses: dict[str, int] = {}
        for _, result in completed:
            statuses[result.status.name] = statuses.get(result.status.name, 0) + 1
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(
            f"{count:8,} pairs {peak:8.0f} MB {count / (time.perf_counter() - wall):8.0f} pairs per second {statuses}"
        )


def main() -> None:
    parts = {"rates": rates, "memory": memory, "gradients": gradients}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", help=f"which of {', '.join(parts)}; all by default")
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before")
    with contextlib.suppress(KeyboardInterrupt):
        for name in parser.parse_args().parts or parts:
            parts[name]()
    print(f"load {os.getloadavg()[0]:.1f} after")


if __name__ == "__main__":
    main()
