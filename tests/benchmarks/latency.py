"""Latency for users: first calls, clouds of new sizes, gradients, batches, the command line.

Run `python -m tests.benchmarks.latency`; see README.md. Every part runs in new processes with its own cache
folder; compilations are counted with `jax.monitoring`.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import textwrap
import time

DATA = pathlib.Path(os.environ.get("MCGICP_DATA", pathlib.Path(__file__).parents[3] / "shared" / "data"))
ROOT = pathlib.Path(__file__).parents[2]

_COMMON = f"""
    import json, sys, time
    import jax, numpy as np
    import mcgicp_jax as mcg
    sys.path.insert(0, {str(ROOT)!r})
    from tests.scenes import room_corner

    compiled = []
    def listen(event, duration, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(duration)
    jax.monitoring.register_event_duration_secs_listener(listen)

    def clouds(size, seed=0):
        return [mcg.PointCloud(*room_corner(size, seed=2 * seed + i, channels=3)) for i in (0, 1)]

    def timed(function):
        count, begin = len(compiled), time.perf_counter()
        answer = function()
        return time.perf_counter() - begin, len(compiled) - count, answer

    def maps():
        try:
            return len(open("/proc/self/maps").readlines())
        except OSError:
            return 0
"""

_FIRST = """
    method = getattr(mcg, sys.argv[1])()
    for size in (6000, 6000, 5000, 5000):
        raw = clouds(size)
        seconds, count, result = timed(lambda: mcg.register(*raw, method, max_distance=0.3))
        print(json.dumps([size, seconds, count]))
    seconds, count, _ = timed(lambda: (result.covariance, repr(result)))
    print(json.dumps(["covariance and repr", seconds, count]))
"""

_GRADIENT = """
    import jax.numpy as jnp
    source, target = (mcg.preprocess(cloud, None) for cloud in clouds(int(sys.argv[2])))

    def loss(channels):
        result = mcg.register(source.replace(channels=channels), target, mcg.MultiChannelGICP(), max_distance=0.2)
        translation, rotation = mcg.metrics.pose_error(result.matrix, np.eye(4))
        return translation + rotation

    channels = jnp.asarray(source.channels)
    if sys.argv[1] == "grad":
        function = jax.jit(jax.grad(loss))
    else:
        function = jax.jit(jax.vmap(jax.value_and_grad(loss)))
        channels = jnp.stack([channels * (1 + 0.01 * i) for i in range(16)])
    seconds, _, program = timed(lambda: function.lower(channels).compile())
    jax.block_until_ready(program(channels))
    times = [timed(lambda: jax.block_until_ready(program(channels)))[0] for _ in range(9)]
    print(json.dumps([seconds, float(np.median(times))]))
"""

_EAGER = """
    import jax.numpy as jnp
    import resource
    several = {size: [mcg.preprocess(cloud, None) for cloud in clouds(size)] for size in (9000, 8000, 34000)}

    def loss(channels, points, pair):
        arrays = {"channels": channels} if points is None else {"channels": channels, "points": points}
        result = mcg.register(pair[0].replace(**arrays), pair[1], mcg.MultiChannelGICP(), max_distance=0.2)
        return jnp.sum(result.matrix[:3, 3])

    def forward(size):
        # A new cloud each time, as in training.
        channels = np.asarray(several[size][0].channels) + 0
        return timed(lambda: loss(channels, None, several[size]))

    def gradient(size, by_points=False):
        channels, points = (jnp.asarray(array) for array in (several[size][0].channels, several[size][0].points))
        function = jax.value_and_grad(loss, (0, 1) if by_points else 0)
        return timed(lambda: jax.block_until_ready(function(channels, points if by_points else None, several[size])))

    def again(function, *arguments):
        return float(np.median([function(*arguments)[0] for _ in range(9)]))

    first = forward(9000)[0]
    once = gradient(9000)[0]
    same, plain = again(gradient, 9000), again(forward, 9000)
    other, count, _ = gradient(8000)
    gradient(9000, True)
    points = again(gradient, 9000, True)
    forward(34000)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    gradient(34000, True)
    memory = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(json.dumps([first, once, plain, same, other, again(gradient, 8000), count, points, memory]))
"""

_COST = """
    import jax.numpy as jnp
    method = mcg.MultiChannelGICP(0.05, 0.3)

    def prepared(size):
        source, target = (mcg.preprocess(cloud, None) for cloud in clouds(size))
        return source, target, mcg.find_correspondences(source, target, np.eye(4), method, max_distance=0.3)

    def cost(channels, pose, problem):
        source, target, matches = problem
        return mcg.mahalanobis_cost(pose, source.replace(channels=channels), target, matches, method)

    def value(problem):
        return timed(lambda: cost(np.asarray(problem[0].channels) + 0, np.eye(4), problem))

    def gradient(problem):
        function = jax.value_and_grad(cost, (0, 1))
        channels = jnp.asarray(problem[0].channels)
        return timed(lambda: jax.block_until_ready(function(channels, jnp.eye(4), problem)))

    problems = {size: prepared(size) for size in (2500, 2400)}
    first = value(problems[2500])[0], gradient(problems[2500])[0]
    other, count, _ = gradient(problems[2400])
    again = [float(np.median([function(problems[2400])[0] for _ in range(9)])) for function in (value, gradient)]
    print(json.dumps([*first, other, count, *again]))
"""

_EPOCH = """
    import jax.numpy as jnp
    sizes = np.random.default_rng(0).integers(2000, 10_000, 60)
    pairs = [clouds(int(size), i) for i, size in enumerate(sizes)]
    sources, targets = zip(*[[mcg.preprocess(cloud, None) for cloud in pair] for pair in pairs])
    channels = [jnp.asarray(source.channels) for source in sources]

    def loss(channels):
        moved = [source.replace(channels=each) for source, each in zip(sources, channels)]
        results = mcg.register_batch(moved, list(targets), mcg.MultiChannelGICP(), max_distance=0.2)
        return sum(jnp.sum(result.matrix[:3, 3]) for result in results)

    plain = timed(lambda: loss([np.asarray(each) + 0 for each in channels]))[0]
    first = timed(lambda: jax.value_and_grad(loss)(channels))[0]
    times = [
        (timed(lambda: loss([np.asarray(each) + 0 for each in channels]))[0],
         timed(lambda: jax.value_and_grad(loss)(channels))[0])
        for _ in range(3)
    ]
    ratio = float(np.median([gradient / forward for forward, gradient in times]))
    print(json.dumps([plain, first, *times[-1], ratio]))
"""

_BATCH = """
    scan = mcg.io.read(sys.argv[1])
    other = mcg.io.read(sys.argv[2])
    rng = np.random.default_rng(0)

    def some(cloud, size):
        return mcg.PointCloud(np.asarray(cloud.points)[np.sort(rng.choice(len(cloud.points), size, replace=False))])

    sizes = rng.integers(2000, 20_000, 60)
    pairs = [(some(scan, size), some(other, size)) for size in sizes]
    for turn in range(2):
        seconds, count, results = timed(
            lambda: mcg.register_batch(*zip(*pairs, strict=True), mcg.GICP(), max_distance=1.0)
        )
        converged = sum(bool(result.converged) for result in results)
        print(json.dumps([seconds, count, converged, maps()]))
"""

_STREAM = """
    sizes = np.random.default_rng(0).permutation(np.arange(300, 800))
    methods = mcg.GICP(), mcg.MultiChannelGICP()
    for i, size in enumerate(sizes):
        source, target = clouds(int(size), seed=i)
        mcg.register(source, target, methods[i % 2], max_distance=0.5).covariance
    print(json.dumps([len(sizes), len(compiled), maps()]))
"""


def _run(code: str, *arguments: str, cache: pathlib.Path | None = None) -> list[list]:
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    if cache is not None:
        environment |= {
            "JAX_COMPILATION_CACHE_DIR": str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
    code = textwrap.dedent(_COMMON) + textwrap.dedent(code)
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(done.stderr)
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]


def first() -> None:
    for method in ("GICP", "MultiChannelGICP"):
        with tempfile.TemporaryDirectory() as folder:
            for state in ("empty", "filled"):
                print(f"\nfirst `register` of a process, {method}, cache {state}: s, compilations")
                for what, seconds, count in _run(_FIRST, method, cache=pathlib.Path(folder)):
                    print(f"{what:>20}  {seconds:7.3f}  {count:4}", flush=True)


def gradients() -> None:
    """Outside and inside of `jit`."""
    with tempfile.TemporaryDirectory() as folder:
        for state in ("empty", "filled"):
            (numbers,) = _run(_EAGER, cache=pathlib.Path(folder))
            first, once, plain, same, other, again, count, points, memory = numbers
            print(f"value_and_grad(register) by channels, MC-GICP, 9,000 points, not jitted, cache {state}:")
            print(f"  first call {first:.2f} s and then the first gradient {once:.2f} s, together {first + once:.2f} s")
            print(f"  forward {1e3 * plain:.0f} ms; gradient {1e3 * same:.0f} ms, {same / plain:.2f} times")
            print(f"  8,000 points: {1e3 * other:.0f} ms with {count} compilations, again {1e3 * again:.0f} ms")
            print(f"  by points too: {1e3 * points:.0f} ms, {points / plain:.2f} times")
            print(f"  34,000 points: peak memory {memory:.0f} MB above that of the forward call", flush=True)
            (numbers,) = _run(_COST, cache=pathlib.Path(folder) / "cost")
            value, once, other, count, plain, again = numbers
            print(f"value_and_grad(mahalanobis_cost) by 7,500 channel values and the pose, MC-GICP, cache {state}:")
            print(
                f"  first value {value:.2f} s and then the first gradient {once:.2f} s, together {value + once:.2f} s"
            )
            print(
                f"  another size {1e3 * other:.0f} ms with {count} compilations, again {1e3 * again:.0f} ms", end=", "
            )
            print(f"{again / plain:.2f} times the value", flush=True)
        ((plain, first, *times, ratio),) = _run(_EPOCH, cache=pathlib.Path(folder))
        print(
            f"60 pairs of 2,000 to 10,000 points: batch {plain:.1f} s, values and gradients {first:.1f} s; again",
            end=" ",
        )
        print(f"{times[0]:.1f} and {times[1]:.1f} s, {ratio:.2f} times", flush=True)
    for name, what, size in (
        ("jit(grad(register)), 9,000 points", "grad", "9000"),
        ("jit(vmap(value_and_grad(register))), 16 pairs of 600 points", "vmap", "600"),
    ):
        ((seconds, run),) = _run(_GRADIENT, what, size)
        print(f"{name}: compile {seconds:.1f} s, run {1e3 * run:.0f} ms", flush=True)


def batch() -> None:
    files = [str(DATA / "lidar_pair" / f"{name}.ply") for name in ("source", "target")]
    with tempfile.TemporaryDirectory() as folder:
        turns = _run(_BATCH, *files, cache=pathlib.Path(folder))
    for turn, (seconds, count, converged, maps) in zip(("first", "again"), turns, strict=True):
        print(f"60 pairs of 2,000 to 20,000 points, {turn}: {seconds:.1f} s, {count} compilations,", end=" ")
        print(f"{converged} converged, {maps} memory maps", flush=True)
    ((size, count, maps),) = _run(_STREAM)
    print(f"{size} pairs of {size} sizes, GICP and MC-GICP: {count} compilations, {maps} memory maps", flush=True)


def commands() -> None:
    scans = sorted((DATA / "kitti" / "sequences" / "04" / "velodyne").glob("*.bin"))
    pair = [str(DATA / "lidar_pair" / f"{name}.ply") for name in ("source", "target")]
    with tempfile.TemporaryDirectory() as folder:
        clouds = pathlib.Path(folder) / "clouds"
        clouds.mkdir()
        for scan in scans[:5]:
            shutil.copy(scan, clouds)
        lines = {
            "mcgicp odometry kitti, 10 frames": ["odometry", "kitti", str(DATA / "kitti" / "sequences" / "04")],
            "mcgicp batch, 4 pairs": ["batch", str(clouds), "--voxel-size", "0.5", "--output", "OUT.csv"],
            "mcgicp register on lidar_pair": ["register", *pair],
        }
        for name, arguments in lines.items():
            cache = tempfile.mkdtemp(dir=folder)
            seconds = []
            for turn in range(3):
                given = [argument.replace("OUT", f"{folder}/{turn}") for argument in arguments]
                begin = time.perf_counter()
                subprocess.run(
                    [sys.executable, "-m", "mcgicp_jax", *given],
                    env=os.environ | {"JAX_COMPILATION_CACHE_DIR": cache},
                    capture_output=True,
                    check=False,
                )
                seconds.append(time.perf_counter() - begin)
            print(f"{name}: first {seconds[0]:.1f} s, again {min(seconds[1:]):.1f} s", flush=True)


def main() -> None:
    parts = {"first": first, "gradients": gradients, "batch": batch, "commands": commands}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", help=f"which of {', '.join(parts)}; all by default")
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before")
    for name in parser.parse_args().parts or parts:
        parts[name]()
    print(f"load {os.getloadavg()[0]:.1f} after")


if __name__ == "__main__":
    main()
