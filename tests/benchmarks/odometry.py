"""Odometry over the KITTI frames beside KISS-ICP: time per frame and trajectory error.

Run `python -m tests.benchmarks.odometry`; see README.md. The methods take turns; compilation is not counted.
"""

from __future__ import annotations

import os
import pathlib
import statistics
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from kiss_icp.config import load_config
from kiss_icp.kiss_icp import KissICP

import mcgicp_jax as mcg
from mcgicp_jax import metrics

DATA = pathlib.Path(os.environ.get("MCGICP_DATA", pathlib.Path(__file__).parents[3] / "shared" / "data"))
NUM_TURNS = 5
VOXEL = 0.25


def ours(method: mcg.AbstractMethod, **options: object) -> Callable[[list[mcg.datasets.Frame]], list[np.ndarray]]:
    def run(frames: list[mcg.datasets.Frame]) -> list[np.ndarray]:
        steps = mcg.odometry(frames, method, voxel_size=VOXEL, max_distance=(2.5, 0.6), **options)
        return [step.pose for step in steps]

    return run


def kiss(frames: list[mcg.datasets.Frame], voxel: float | None = None) -> list[np.ndarray]:
    """KISS-ICP at its defaults, or with voxels of another size in metres than 1 % of its maximum range, 100 m."""
    config = load_config(None)
    config.mapping.voxel_size = voxel or config.mapping.voxel_size
    # The frames are without motion distortion already.
    config.data.deskew = False
    pipeline, poses = KissICP(config), []
    for frame in frames:
        pipeline.register_frame(np.asarray(frame.cloud.points, np.float64), np.zeros(0))
        poses.append(np.array(pipeline.last_pose))
    return poses


def main() -> None:
    frames = list(mcg.datasets.kitti(DATA / "kitti" / "sequences" / "04"))
    truth = [frame.pose for frame in frames]
    methods = {
        "GICP": ours(mcg.GICP()),
        "GICP, against the map": ours(mcg.GICP(), against="map"),
        "MC-GICP": ours(mcg.MultiChannelGICP()),
        "NDT, against the map": ours(mcg.NDT(), against="map", voxel_sizes=(2.0, 1.0)),
        "KISS-ICP": kiss,
        "KISS-ICP, 0.25 m": partial(kiss, voxel=VOXEL),
    }
    rates: dict[str, list[float]] = {name: [] for name in methods}
    processor: dict[str, list[float]] = {name: [] for name in methods}
    poses = {}
    for turn in range(NUM_TURNS + 1):
        for name, run in methods.items():
            started, busy = time.perf_counter(), time.process_time()
            poses[name] = run(frames)
            if turn:
                rates[name].append(len(frames) / (time.perf_counter() - started))
                processor[name].append(1e3 * (time.process_time() - busy) / len(frames))
    print(f"{len(frames)} frames, load {os.getloadavg()[0]:.1f}")
    print(
        f"{'':>24} {'frames/s':>9} {'/ KISS-ICP':>11} {'processor, ms':>14} {'ATE, mm':>8} {'from first, mm':>15} "
        f"{'per frame, mm':>14}"
    )
    for name, found in poses.items():
        ratio = statistics.median(a / b for a, b in zip(rates[name], rates["KISS-ICP"], strict=True))
        error = 1e3 * metrics.ate(found, truth)
        first = 1e3 * metrics.ate(found, truth, alignment="first")
        drift = 1e3 * float(np.mean(metrics.rpe(found, truth)[0]))
        rate, busy = statistics.median(rates[name]), statistics.median(processor[name])
        print(f"{name:>24} {rate:9.1f} {ratio:11.2f} {busy:14.0f} {error:8.1f} {first:15.1f} {drift:14.1f}")


if __name__ == "__main__":
    main()
