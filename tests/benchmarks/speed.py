"""Time to preprocess and align one pair, compared with small_gicp and Open3D, for clouds of several sizes.

Run `python -m tests.benchmarks.speed`; see README.md. All libraries get the same clouds and take turns in one process;
ratios are computed within one turn. Open3D is left out if it is not installed.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import importlib.util
import itertools
import os
import pathlib
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax._clouds.voxel_size import voxels_for

DATA = pathlib.Path(os.environ.get("MCGICP_DATA", pathlib.Path(__file__).parents[3] / "shared" / "data"))
NUM_TURNS = 9
# small_gicp's defaults, used for all
TOLERANCES = {"translation_tolerance": 1e-3, "rotation_tolerance": np.radians(0.1)}
MAX_ITERATIONS = 20
NUM_NEIGHBORS = 20
# Of the source of `million`, metres
SHIFT = np.array([0.3, -0.2, 0.1])
THREADS = concurrent.futures.ThreadPoolExecutor(2)

Stages = tuple[float, float, np.ndarray]


def lidar_pair() -> tuple[np.ndarray, np.ndarray]:
    return tuple(
        np.asarray(mcg.io.read(DATA / "lidar_pair" / f"{name}.ply").points, float) for name in ("source", "target")
    )


def kitti() -> tuple[np.ndarray, np.ndarray]:
    folder = DATA / "kitti" / "sequences" / "04" / "velodyne"
    target, source = (np.asarray(mcg.io.read(path).points, float) for path in sorted(folder.glob("*.bin"))[:2])
    return source, target


def million() -> tuple[np.ndarray, np.ndarray]:
    """Two samples of an undulating surface, a million points each, 0.4 m apart."""
    clouds = []
    for seed in (0, 1):
        x, y = np.random.default_rng(seed).random((2, 1_000_000)) * 200
        clouds.append(np.stack([x, y, 3 * np.sin(x / 7) * np.cos(y / 5) + np.sin(x + y / 3)], axis=1))
    return clouds[0] + SHIFT, clouds[1]


CASES: dict[str, tuple[Callable[[], tuple[np.ndarray, np.ndarray]], float | None, float, int]] = {
    "lidar_pair, 0.5 m": (lidar_pair, 0.5, 1.0, NUM_TURNS),
    "lidar_pair, 0.25 m": (lidar_pair, 0.25, 1.0, NUM_TURNS),
    "lidar_pair, 0.1 m": (lidar_pair, 0.1, 1.0, NUM_TURNS),
    "kitti, 0.25 m": (kitti, 0.25, 2.5, NUM_TURNS),
    "kitti, all": (kitti, None, 2.5, 3),
    "a million": (million, None, 1.0, 1),
}


def ours(backend: str | None) -> Callable[..., Stages]:
    search = mcg.KDTreeSearch(backend=backend)

    def prepared(cloud: np.ndarray, voxel: float | None) -> mcg.PointCloud:
        return mcg.preprocess(cloud.astype(np.float32), voxel, NUM_NEIGHBORS, search=search)

    def run(source: np.ndarray, target: np.ndarray, voxel: float | None, max_distance: float) -> Stages:
        begin = time.perf_counter()
        # Preprocess the two clouds in parallel.
        clouds = list(THREADS.map(prepared, (source, target), (voxel, voxel)))
        ready = time.perf_counter()
        options = {"max_distance": max_distance, "max_iterations": MAX_ITERATIONS, "search": search, **TOLERANCES}
        result = mcg.register(*clouds, mcg.GICP(), **options)
        return ready - begin, time.perf_counter() - ready, np.asarray(result.matrix)

    return run


def small(num_threads: int) -> Callable[..., Stages]:
    import small_gicp

    def prepared(points: np.ndarray, voxel: float | None) -> tuple[Any, Any]:
        if voxel is not None:
            return small_gicp.preprocess_points(points, voxel, num_neighbors=NUM_NEIGHBORS, num_threads=num_threads)
        cloud = small_gicp.PointCloud(points)
        tree = small_gicp.KdTree(cloud, num_threads=num_threads)
        small_gicp.estimate_covariances(cloud, tree, NUM_NEIGHBORS, num_threads)
        return cloud, tree

    def run(source: np.ndarray, target: np.ndarray, voxel: float | None, max_distance: float) -> Stages:
        begin = time.perf_counter()
        (a, _), (b, tree) = (prepared(cloud, voxel) for cloud in (source, target))
        ready = time.perf_counter()
        result = small_gicp.align(
            b,
            a,
            tree,
            np.eye(4),
            max_correspondence_distance=max_distance,
            num_threads=num_threads,
            max_iterations=MAX_ITERATIONS,
        )
        return ready - begin, time.perf_counter() - ready, np.asarray(result.T_target_source)

    return run


def open3d(source: np.ndarray, target: np.ndarray, voxel: float | None, max_distance: float) -> Stages:
    import open3d as o3d

    pipeline = o3d.pipelines.registration
    begin = time.perf_counter()
    clouds = []
    for points in (source, target):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud = cloud if voxel is None else cloud.voxel_down_sample(voxel)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NUM_NEIGHBORS))
        clouds.append(cloud)
    ready = time.perf_counter()
    result = pipeline.registration_generalized_icp(
        *clouds,
        max_distance,
        np.eye(4),
        pipeline.TransformationEstimationForGeneralizedICP(),
        pipeline.ICPConvergenceCriteria(max_iteration=MAX_ITERATIONS),
    )
    return ready - begin, time.perf_counter() - ready, np.asarray(result.transformation)


def colored() -> None:
    """MC-GICP with its defaults and Open3D's colored ICP at one scale, on six raw pairs of a flat table."""
    import open3d as o3d

    from tests.benchmarks import accuracy

    pairs, voxel = list(accuracy.table("_flat")), 0.01
    theirs = accuracy.colored_icp((1,))

    def run_ours(pair: accuracy.Pair) -> np.ndarray:
        clouds = list(THREADS.map(lambda cloud: mcg.preprocess(cloud, voxel), (pair.source, pair.target)))
        return mcg.register(*clouds, mcg.MultiChannelGICP()).matrix

    def run_theirs(pair: accuracy.Pair) -> np.ndarray:
        clouds = [accuracy.as_open3d(cloud).voxel_down_sample(voxel) for cloud in (pair.source, pair.target)]
        return theirs(*clouds, np.eye(4), voxel)

    ratios, times, errors = [], [], []
    for turn in range(NUM_TURNS + 1):
        for pair in pairs:
            row = []
            for run in (run_ours, run_theirs):
                begin = time.perf_counter()
                pose = run(pair)
                row.append((time.perf_counter() - begin, mcg.metrics.pose_error(pose, pair.truth)[0]))
            if turn:
                (a, _), (b, _) = row
                ratios.append(a / b)
                times.append((a, b))
                errors.append([error for _, error in row])
    a, b = 1e3 * np.median(times, axis=0)
    first, second = 1e3 * np.mean(errors, axis=0)
    print(
        f"\nflat table, whole: MC-GICP {a:.0f} ms, colored ICP of Open3D {o3d.__version__} at one scale {b:.0f} ms, ",
        end="",
    )
    print(f"ratio {statistics.median(ratios):.2f}; mean errors {first:.1f} and {second:.1f} mm")


def turns(chart: pathlib.Path | None, chosen: list[str]) -> None:
    libraries: dict[str, Callable[..., Stages]] = {
        "ours": ours(None),
        "SciPy's tree": ours("scipy"),
        "small 1": small(1),
        "small 2": small(2),
    }
    if importlib.util.find_spec("open3d") is not None:
        libraries["open3d"] = open3d
    print("\nMilliseconds: prepare + align, medians; and ours / the better of small_gicp, median of the turns")
    print("work: processor time of the whole, ours / small_gicp with one thread; / scipy: to ours without `fast`")
    header = "".join(f"{name:>20}" for name in libraries)
    ratios_header = f"{'prepare':>8} {'align':>6} {'whole':>6} {'/ scipy':>8} {'/ open3d':>9} {'work':>6} {'apart':>8}"
    print(f"{'clouds':>20} {'points':>9}{header} {ratios_header}")
    drawn: dict[str, list[tuple[int, float]]] = {name: [] for name in libraries}
    for case in chosen:
        load, voxel, max_distance, count = CASES[case]
        source, target = load()
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in libraries}
        work: dict[str, list[float]] = {name: [] for name in libraries}
        poses = {}
        for turn in range(count + 1):
            for name, run in libraries.items():
                begin = time.process_time()
                *stages, poses[name] = run(source, target, voxel, max_distance)
                # The first turn compiles and warms caches.
                if turn:
                    times[name].append((stages[0], stages[1]))
                    work[name].append(time.process_time() - begin)
        size = len(mcg.preprocess(source.astype(np.float32), voxel))
        cells = []
        for name, stages in times.items():
            prepare, align = (1e3 * statistics.median(column) for column in zip(*stages, strict=True))
            cells.append(f"{f'{prepare:.0f} + {align:.0f}':>20}")
            drawn[name].append((size, prepare + align))
        ratios = [_ratio(times, stage) for stage in (slice(0, 1), slice(1, 2), slice(0, 2))]
        scipy_ratio = _ratio_to(times, "SciPy's tree")
        beside = _ratio_to(times, "open3d") if "open3d" in times else float("nan")
        effort = statistics.median(a / b for a, b in zip(work["ours"], work["small 1"], strict=True))
        apart = 1e3 * np.linalg.norm(poses["ours"][:3, 3] - poses["small 1"][:3, 3])
        print(f"{case:>20} {size:9,}{''.join(cells)} ", end="")
        print(
            f"{ratios[0]:8.2f} {ratios[1]:6.2f} {ratios[2]:6.2f} {scipy_ratio:8.2f} {beside:9.2f} {effort:6.2f}"
            f" {apart:5.1f} mm",
            flush=True,
        )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory of the process, all libraries: {peak:.0f} MB")
    if chart is not None:
        _draw(chart, drawn)


def defaults() -> None:
    """Raw arrays to pose with all defaults, small_gicp in the same voxels, and small_gicp with its own defaults."""
    import small_gicp

    frames = list(itertools.islice(mcg.datasets.kitti(DATA / "kitti" / "sequences" / "04"), 2))
    shift = np.eye(4)
    shift[:3, 3] = -SHIFT
    cases = (
        ("lidar_pair", lidar_pair, np.loadtxt(DATA / "lidar_pair" / "T_target_source.txt")),
        ("kitti", kitti, np.linalg.inv(frames[0].pose) @ frames[1].pose),
        ("a million", million, shift),
    )
    print("\nRaw arrays, all defaults: ms, medians of 9 turns; ratio to small_gicp in the same voxels; errors in mm")
    columns = f"{'ours':>6} {'small':>6} {'own':>6}"
    print(f"{'clouds':>20} {'points':>9} {'voxels':>9} {'size, m':>8} {columns} {'ratio':>6} {columns}")
    for name, load, truth in cases:
        source, target = (cloud.astype(np.float32) for cloud in load())
        voxel = voxels_for("auto", mcg.PointCloud(source), mcg.PointCloud(target)).size
        points = source.astype(float), target.astype(float)
        calls: list[Callable[[], np.ndarray]] = [
            lambda source=source, target=target: mcg.register(source, target, mcg.GICP()).matrix,
            lambda points=points, voxel=voxel: small(2)(*points, voxel, 10 * (voxel or 1))[-1],
            lambda points=points: small_gicp.align(points[1], points[0], num_threads=2).T_target_source,
        ]
        rows = []
        for _ in range(NUM_TURNS + 1):
            row, poses = [], []
            for call in calls:
                begin = time.perf_counter()
                poses.append(call())
                row.append(1e3 * (time.perf_counter() - begin))
            rows.append(row)
        ours_, same, own = np.median(rows[1:], axis=0)
        ratio = statistics.median(row[0] / row[1] for row in rows[1:])
        size = len(mcg.preprocess(source, voxel))
        mine, theirs, their_own = (1e3 * mcg.metrics.pose_error(pose, truth)[0] for pose in poses)
        print(
            f"{name:>20} {len(source):9,} {size:9,} {voxel or 0:8.2g} {ours_:6.0f} {same:6.0f} {own:6.0f} {ratio:6.2f}"
            f" {mine:6.1f} {theirs:6.1f} {their_own:6.1f}"
        )


def _ratio(times: dict[str, list[tuple[float, float]]], stage: slice) -> float:
    """Median ratio, within turns, of our time to the better of small_gicp with one and two threads."""
    rows = zip(times["ours"], times["small 1"], times["small 2"], strict=True)
    return statistics.median(sum(a[stage]) / min(sum(b[stage]), sum(c[stage])) for a, b, c in rows)


def _ratio_to(times: dict[str, list[tuple[float, float]]], name: str) -> float:
    return statistics.median(sum(a) / sum(b) for a, b in zip(times["ours"], times[name], strict=True))


def _draw(path: pathlib.Path, drawn: dict[str, list[tuple[int, float]]]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for name, points in drawn.items():
        axes.loglog(*zip(*sorted(points), strict=True), marker="o", label=name)
    axes.set(xlabel="points of each cloud", ylabel="whole, ms")
    axes.legend()
    figure.savefig(path)
    print(f"chart: {path}")


# A pair of raw scans of KITTI in a new process: seconds to import a library and to register, and peak memory in KiB.
_FIRST_CALL = """
import sys, time
import numpy as np
source, target = (np.fromfile(path, np.float32).reshape(-1, 4)[:, :3].astype(float) for path in sys.argv[1:])
begin = time.perf_counter()
import {module} as library
imported = time.perf_counter()
{call}
done = time.perf_counter()
with open("/proc/self/status") as status:
    peak, = (line.split()[1] for line in status if line.startswith("VmHWM"))
print(imported - begin, done - imported, peak)
"""
# All defaults; Open3D, which has none for these, in the voxels of the others and with the matches of `CASES`.
_FIRST_CALLS = {
    "mcgicp_jax": "library.register(source, target, library.GICP())",
    "small_gicp": "library.align(target, source, num_threads=2)",
    "open3d": """
clouds = []
for points in (source, target):
    clouds.append(library.geometry.PointCloud(library.utility.Vector3dVector(points)).voxel_down_sample(0.25))
    clouds[-1].estimate_normals(library.geometry.KDTreeSearchParamKNN(20))
library.pipelines.registration.registration_generalized_icp(*clouds, 2.5)
""",
}


def starts(folder: pathlib.Path) -> None:
    """Seconds to import, and import, first call and peak memory beside the other libraries, each in a new process."""

    def run(code: str, *arguments: str, **environment: str) -> list[float]:
        text = subprocess.run(
            [sys.executable, "-c", code, *arguments],
            env=os.environ | environment,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        return [float(number) for number in text.split()]

    bare = "import time; a = time.perf_counter()\nimport jax, optimistix, scipy.spatial\nprint(time.perf_counter() - a)"
    package = "import time; a = time.perf_counter()\nimport mcgicp_jax\nprint(time.perf_counter() - a)"
    rows = [(run(package)[0], run(bare)[0]) for _ in range(5)]
    ratio = statistics.median(a / b for a, b in rows)
    seconds, without = (statistics.median(column) for column in zip(*rows, strict=True))
    print(f"\nimport: {seconds:.2f} s, {ratio:.2f} times `import jax, optimistix, scipy.spatial` ({without:.2f} s)")
    cache = {
        "JAX_COMPILATION_CACHE_DIR": str(folder),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }
    scans = [str(path) for path in sorted((DATA / "kitti/sequences/04/velodyne").glob("*.bin"))[1::-1]]
    print("\nFirst call of a process, a pair of raw scans of KITTI, GICP")
    for name, module in (
        ("mcgicp_jax, empty cache", "mcgicp_jax"),
        ("mcgicp_jax, filled cache", "mcgicp_jax"),
        ("small_gicp", "small_gicp"),
        ("open3d", "open3d"),
    ):
        if importlib.util.find_spec(module) is not None:
            code = _FIRST_CALL.format(module=module, call=_FIRST_CALLS[module])
            seconds, call, peak = run(code, *scans, **cache)
            print(f"{name:>26}: import {seconds:.2f} s, call {call:.2f} s, peak memory {peak / 1024:.0f} MB")


def main() -> None:
    import tempfile

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", help=f"which of {', '.join(CASES)}; all by default")
    parser.add_argument("--chart", type=pathlib.Path, help="picture of time against points, such as speed.png")
    arguments = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before")
    turns(arguments.chart, arguments.cases or list(CASES))
    defaults()
    if importlib.util.find_spec("open3d") is not None and not arguments.cases:
        colored()
    with tempfile.TemporaryDirectory() as folder:
        starts(pathlib.Path(folder))
    print(f"load {os.getloadavg()[0]:.1f} after")


if __name__ == "__main__":
    main()
