"""Cost of a gradient, compared with unrolled autograd of PyPose's ICP and with registration without a gradient.

Run `python -m tests.benchmarks.gradients`; see README.md. Every library and size has its own process, which waits while
another runs; libraries take turns, and ratios are computed within one turn.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import importlib.util
import multiprocessing
import os
import resource
import statistics
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

# Numbers of points and runs: PyPose takes seconds for 5,000.
AGAINST_PYPOSE = {1000: 7, 2000: 7, 5000: 3}
AGAINST_PLAIN = {2000: 15, 6000: 15, 20000: 9}
# max_distance, metres. PyPose rejects no match, nor do we at 10 m: the scene is 2 m wide.
KEEP_ALL = 10.0
MAX_DISTANCE = 0.4
NOISE = 0.02
STEP = 1e-6
NUM_DIFFERENCES = 30

Worker = Callable[..., dict[str, Any]]


# Measuring


def _status(name: str) -> float:
    """Value of a line of /proc/self/status in MB; the peak memory on systems other than Linux."""
    with contextlib.suppress(OSError), open("/proc/self/status", encoding="ascii") as lines:
        for line in lines:
            if line.startswith(name):
                return int(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _peak(function: Callable[[], Any]) -> float:
    """Peak memory of this process during a call, above that before it; MB."""
    gc.collect()
    # Return freed memory to the system, and reset the peak.
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w", encoding="ascii") as file:
        file.write("5")
    before = _status("VmRSS")
    function()
    return _status("VmHWM") - before


def _timed(function: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    answer = function()
    return time.perf_counter() - start, answer


# Processes


class Process:
    """A process with one library and its clouds, compiled and warm, that computes on request."""

    def __init__(self, build: Callable[..., Worker], *args: Any):
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, build, args), daemon=True)
        self._process.start()
        theirs.close()
        self._connection.recv()

    def __call__(self, *args: Any) -> dict[str, Any]:
        self._connection.send(args)
        return self._connection.recv()

    def close(self) -> None:
        self._connection.send(None)
        self._process.join()


def _serve(connection: Any, build: Callable[..., Worker], args: tuple[Any, ...]) -> None:
    answer = build(*args)
    connection.send(None)
    while (request := connection.recv()) is not None:
        connection.send(answer(*request))


def pypose_worker(source: np.ndarray, target: np.ndarray, truth: np.ndarray) -> Worker:
    """PyPose's ICP with a given number of iterations, and the gradient by autograd through all of them."""
    import torch
    from pypose.module import ICP
    from pypose.utils import ReduceToBason

    true = torch.tensor(truth, dtype=torch.tensor(source).dtype)
    fixed = torch.tensor(target)

    def pose_of(T: Any, reader: str) -> Any:
        if reader == "matrix":
            return T.matrix()
        # From the quaternion's entries, without PyPose's own operations: see README.md.
        x, y, z, w = T.tensor()[3:]
        rotation = [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
            *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
            *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
        ]
        return torch.cat([torch.stack(rotation).reshape(3, 3), T.tensor()[:3, None]], dim=1)

    def value_and_gradient(points: Any, iterations: int, reader: str) -> tuple[Any, Any, Any]:
        # Never stop early: zero tolerance, and more patience than iterations.
        icp = ICP(stepper=ReduceToBason(steps=iterations, patience=iterations + 1, tol=0))
        points = points.requires_grad_()
        matrix = pose_of(icp(points, fixed), reader)
        left = true[:3, :3].T @ matrix[:3, :3]
        sine = torch.stack([left[2, 1] - left[1, 2], left[0, 2] - left[2, 0], left[1, 0] - left[0, 1]]) / 2
        angle = torch.atan2(torch.linalg.norm(sine), (torch.trace(left) - 1) / 2)
        loss = torch.linalg.norm(matrix[:3, 3] - true[:3, 3]) + angle
        loss.backward()
        return loss, points.grad, matrix

    def answer(points: np.ndarray | None, iterations: int, memory: bool = False, reader: str = "tensor") -> Any:
        points = torch.tensor(source if points is None else points)
        if memory:
            return {"peak": _peak(lambda: value_and_gradient(points, iterations, reader))}
        seconds, (loss, gradient, matrix) = _timed(lambda: value_and_gradient(points, iterations, reader))
        matrix = np.vstack([matrix.detach().numpy(), [0, 0, 0, 1]])
        return {"seconds": seconds, "loss": loss.item(), "gradient": gradient.numpy(), "matrix": matrix}

    answer(source, 2)
    return answer


def our_worker(
    method_name: str,
    source: tuple[np.ndarray, np.ndarray],
    target: tuple[np.ndarray, np.ndarray],
    truth: np.ndarray,
    settings: dict[str, Any],
    plain: bool = False,
) -> Worker:
    """`register` with its gradient, jitted and eager, and, if `plain`, the same calls without a gradient."""
    os.environ["JAX_PLATFORMS"] = "cpu"
    os.environ["JAX_ENABLE_X64"] = str(int(source[0].dtype == np.float64))
    import jax

    import mcgicp_jax as mcg

    method = getattr(mcg, method_name)()
    moving, fixed = (mcg.preprocess(mcg.PointCloud(*cloud), voxel_size=None) for cloud in (source, target))
    # A row of padding in the target, changed in every call.
    fixed = fixed.pad(len(fixed) + 1)
    stamped = jax.numpy.asarray(fixed.points)

    def loss(points: Any, target_points: Any) -> Any:
        result = mcg.register(moving.replace(points=points), fixed.replace(points=target_points), method, **settings)
        translation, rotation = mcg.metrics.pose_error(result.matrix, truth)
        return translation + rotation, (result.matrix, result.num_iterations, result.status_code)

    functions: dict[str, Any] = {"gradient": jax.value_and_grad(loss, has_aux=True)}
    if plain:
        functions["plain"] = loss
    compiled = {name: jax.jit(f).lower(moving.points, fixed.points).compile() for name, f in functions.items()}
    compiled |= {"host": loss, "eager": functions["gradient"]}
    analysis = compiled["gradient"].memory_analysis()
    stamp = 0

    def answer(points: np.ndarray | None = None, kind: str = "gradient", memory: bool = False) -> dict[str, Any]:
        nonlocal stamp
        # Trees are cached by the content of the target: changing its padding makes every call build a tree.
        stamp += 1
        target_points = jax.block_until_ready(stamped.at[-1, 0].set(stamp))
        start = jax.block_until_ready(jax.numpy.asarray(moving.points if points is None else points))

        def run() -> Any:
            return jax.block_until_ready(compiled[kind](start, target_points))

        if memory:
            program = analysis.temp_size_in_bytes + analysis.argument_size_in_bytes + analysis.output_size_in_bytes
            return {"peak": _peak(run), "program": program / 2**20}
        seconds, found = _timed(run)
        no_gradient = np.zeros((len(moving), 3))
        (value, (matrix, iterations, status)), gradient = (
            found if kind in ("gradient", "eager") else (found, no_gradient)
        )
        return {
            "seconds": seconds,
            "loss": float(value),
            "gradient": np.asarray(gradient),
            "matrix": np.asarray(matrix, np.float64),
            "iterations": int(iterations),
            "status": mcg.Status(int(status)).name,
        }

    for kind in compiled:
        if kind != "host" or plain:
            answer(kind=kind)
    return answer


# The parts


def _clouds(size: int, dtype: type) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Two independent noisy samples of a room's corner, and the motion between them."""
    from tests.scenes import motion, room_corner

    truth = motion()
    points, channels = room_corner(size, noise=NOISE, seed=1)
    source = (points - truth[:3, 3]) @ truth[:3, :3]
    target_points, target_channels = room_corner(size, noise=NOISE, seed=2)
    arrays = [array.astype(dtype) for array in (source, channels, target_points, target_channels)]
    return (arrays[0], arrays[1]), (arrays[2], arrays[3]), truth


def _relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def _table(title: str, names: list[str], rows: list[list[str]]) -> None:
    print(f"\n{title}\n")
    widths = [max(len(row[i]) for row in [names, *rows]) for i in range(len(names))]
    for row in (names, ["-" * (width - 1) + ":" for width in widths], *rows):
        print("| " + " | ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) + " |")
    print(flush=True)


def against_pypose() -> None:
    """Time and memory of value and gradient, point-to-point ICP, with the same number of iterations."""
    times, memories = [], []
    for size, runs in AGAINST_PYPOSE.items():
        source, target, truth = _clouds(size, np.float32)
        ours = Process(our_worker, "PointToPoint", source, target, truth, {"max_distance": KEEP_ALL})
        theirs = Process(pypose_worker, source[0], target[0], truth)
        pairs = []
        for _ in range(runs):
            mine = ours()
            pairs.append((mine, theirs(None, mine["iterations"]), ours(None, "eager")))
        ratios = [other["seconds"] / mine["seconds"] for mine, other, _ in pairs]
        mine, other, eager = pairs[-1]
        apart = np.linalg.norm(mine["matrix"][:3, 3] - other["matrix"][:3, 3])
        angle = np.linalg.norm(mine["matrix"][:3, :3] - other["matrix"][:3, :3]) / np.sqrt(2)
        times.append(
            [
                f"{size:,}",
                f"{mine['iterations']}, {mine['status']}",
                *(f"{1e3 * statistics.median(turn[i]['seconds'] for turn in pairs):.0f} ms" for i in (0, 2, 1)),
                f"{statistics.median(ratios):.0f}",
                f"{min(ratios):.0f} to {max(ratios):.0f}",
                f"{apart:.0e} m, {angle:.0e} rad",
                f"{_relative(mine['gradient'], other['gradient']):.0e}",
                f"{_relative(eager['gradient'], mine['gradient']):.0e}",
            ]
        )
        memory, other_peak = ours(None, "gradient", True), theirs(None, mine["iterations"], True)["peak"]
        memories.append(
            [f"{size:,}", f"{memory['peak']:.1f} MB", f"{memory['program']:.1f} MB", f"{other_peak:.0f} MB"]
        )
        ours.close()
        theirs.close()
    _table(
        "Value and gradient with respect to all source points, point-to-point, float32",
        [
            *("points", "iterations of both", "jitted", "eager", "PyPose", "PyPose / jitted", "over the runs"),
            *("poses apart", "gradients apart", "jitted and eager"),
        ],
        times,
    )
    _table(
        "Peak memory of one call above that of the warm process",
        ["points", "ours", "of which the program's buffers", "PyPose"],
        memories,
    )


def against_plain() -> None:
    """Cost of value and gradient relative to registration without a gradient."""
    rows = []
    for method in ("GICP", "MultiChannelGICP"):
        for size, runs in AGAINST_PLAIN.items():
            source, target, truth = _clouds(size, np.float32)
            ours = Process(our_worker, method, source, target, truth, {"max_distance": MAX_DISTANCE}, True)
            turns = [{kind: ours(None, kind) for kind in ("gradient", "plain", "host")} for _ in range(runs)]
            memory = ours(None, "gradient", True)
            ours.close()
            seconds = {kind: np.array([turn[kind]["seconds"] for turn in turns]) for kind in turns[0]}
            iterations = {turn[kind]["iterations"] for turn in turns for kind in turn}
            rows.append(
                [
                    method,
                    f"{size:,}",
                    "/".join(map(str, sorted(iterations))),
                    *(f"{1e3 * np.median(seconds[kind]):.0f} ms" for kind in seconds),
                    f"{np.median(seconds['gradient'] / seconds['plain']):.2f}",
                    f"{np.median(seconds['gradient'] / seconds['host']):.2f}",
                    f"{memory['peak']:.1f} MB",
                    f"{memory['program']:.1f} MB",
                ]
            )
    _table(
        "Value and gradient against the same registration without a gradient",
        [
            *("method", "points", "iterations", "gradient", "plain, jitted", "host", "/ jitted", "/ host"),
            *("peak memory", "of which buffers"),
        ],
        rows,
    )


def correctness(with_pypose: bool) -> None:
    """Gradients against central differences of each library's own pose error in some coordinates, float64."""
    import scipy.spatial

    source, target, truth = _clouds(300, np.float64)
    tree = scipy.spatial.cKDTree(target[0])
    chosen = np.random.default_rng(0).choice(source[0].size, NUM_DIFFERENCES, replace=False)

    def matches(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
        return tree.query(points @ matrix[:3, :3].T + matrix[:3, 3])[1]

    settings = {"max_distance": KEEP_ALL, "max_iterations": 100}
    settings |= {"translation_tolerance": 1e-12, "rotation_tolerance": 1e-12}
    ours = Process(our_worker, "PointToPoint", source, target, truth, settings)
    cases: dict[str, Callable[[np.ndarray], dict[str, Any]]] = {"ours": ours}
    iterations = ours()["iterations"]
    processes = [ours]
    if with_pypose:
        theirs = Process(pypose_worker, source[0], target[0], truth)
        processes.append(theirs)
        cases["PyPose"] = lambda points: theirs(points, iterations)
        cases["PyPose, pose read by .matrix()"] = lambda points: theirs(points, iterations, False, "matrix")
    rows = []
    for name, evaluate in cases.items():
        found = evaluate(source[0])
        unperturbed = matches(source[0], found["matrix"])
        differences, changed = [], 0
        for coordinate in chosen:
            values = []
            for step in (STEP, -STEP):
                points = source[0].copy()
                points.flat[coordinate] += step
                moved = evaluate(points)
                changed += np.any(matches(points, moved["matrix"]) != unperturbed)
                values.append(moved["loss"])
            differences.append((values[0] - values[1]) / (2 * STEP))
        error = _relative(found["gradient"].flat[chosen], np.array(differences))
        rows.append([name, f"{error:.1e}", f"{changed} of {2 * NUM_DIFFERENCES}", f"{found['loss']:.6f}"])
    for process in processes:
        process.close()
    _table(
        f"Gradients against central differences: 300 points, float64, {iterations} iterations, "
        f"{NUM_DIFFERENCES} coordinates",
        ["gradient", "relative error", "evaluations with other matches", "pose error"],
        rows,
    )


def training() -> None:
    """Derivatives by channels against whole registrations, and training by them; in this process."""
    import jax

    from tests.benchmarks import training as by_channels

    with warnings.catch_warnings():
        # Of hard matches, which are compared on purpose.
        warnings.simplefilter("ignore", UserWarning)
        _table("Training, float32", by_channels.TRAINING_COLUMNS, list(by_channels.training()))
        jax.config.update("jax_enable_x64", True)
        rows = [row for name in by_channels.SETS for row in by_channels.cosines(name, ["MC-GICP"])]
        rows += by_channels.cosines("flat tables", ["Color ICP", "photometric", "Color NDT"])
        _table("Derivatives by channels against differences of the registration, float64", by_channels.COLUMNS, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("correctness", "pypose", "plain", "training")
    parser.add_argument("parts", nargs="*", help=f"which of {', '.join(parts)}; all but training by default")
    chosen = parser.parse_args().parts or parts[:-1]
    if unknown := set(chosen) - set(parts):
        parser.error(f"unknown parts: {', '.join(sorted(unknown))}")
    with_pypose = importlib.util.find_spec("pypose") is not None
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before")
    if not with_pypose:
        print("PyPose is not installed: its parts are skipped")
    seconds, _ = _timed(lambda: _run(chosen, with_pypose))
    print(f"load {os.getloadavg()[0]:.1f} after {seconds:.0f} s")


def _run(chosen: tuple[str, ...] | list[str], with_pypose: bool) -> None:
    if "correctness" in chosen:
        correctness(with_pypose)
    if "pypose" in chosen and with_pypose:
        against_pypose()
    if "plain" in chosen:
        against_plain()
    if "training" in chosen:
        training()


if __name__ == "__main__":
    main()
