"""Odometry of a spinning LiDAR that measures while it moves, with and without deskewing, beside KISS-ICP.

    python -m tests.benchmarks.deskewing [--seeds 2] [--frames 10]

Simulated streets at 1, 10 and 20 m/s, and at 5 m/s in a curve of 90° per second. "at rest": the same scans, measured
all at once at their poses. Errors are mean translations from frame to frame, millimetres, without the first two pairs.

KISS-ICP gets the true first motion, without which it takes the faster cars for standing ones, and voxels of 0.3 m, with
which it is better here than with those of 0.5 m or 1 m, its default.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from kiss_icp.config import load_config
from kiss_icp.kiss_icp import KissICP

import mcgicp_jax as mcg
from mcgicp_jax import metrics

# Name, metres and radians between frames, of which there are ten a second.
DRIVES = (("1 m/s", 0.1, 0.0), ("10 m/s", 1.0, 0.0), ("20 m/s", 2.0, 0.0), ("5 m/s, 90°/s", 0.5, np.pi / 20))
_FIRST = 2
_POINTS = 15_000
_KISS_VOXEL = 0.3


def frames_of(step: float, turn: float, count: int, seed: int, spin: bool) -> list[mcg.datasets.Frame]:
    """Frames of a street; with `turn`, the car drives in a circle of step / turn metres, with the same sway."""
    frames: Any = mcg.datasets.street(count, points_per_frame=_POINTS, step=step, seed=seed, spin=True)
    straight = frames.path

    def curved(time: float) -> np.ndarray:
        cosine, sine = np.cos(turn * time), np.sin(turn * time)
        ahead, aside = (step * time, 0.0) if turn == 0 else (step / turn * sine, step / turn * (1 - cosine))
        pose = np.eye(4)
        pose[:2, [0, 1, 3]] = [[cosine, -sine, ahead], [sine, cosine, aside]]
        sway = straight(time)
        sway[0, 3] -= step * time
        return pose @ sway

    frames.path = curved
    frames.num_poses = frames.num_poses if spin else 1
    return list(frames)


def ours(**options: Any) -> Callable[[list[mcg.datasets.Frame]], list[np.ndarray]]:
    def run(frames: list[mcg.datasets.Frame]) -> list[np.ndarray]:
        return [step.pose for step in mcg.odometry(frames, mcg.GICP(), max_distance=(2.5, 0.6), **options)]

    return run


def kiss(frames: list[mcg.datasets.Frame]) -> list[np.ndarray]:
    """KISS-ICP with its own deskewing where there are times; see the module about its settings."""
    config = load_config(None)
    config.mapping.voxel_size = _KISS_VOXEL
    pipeline, poses = KissICP(config), []
    pipeline.last_delta = np.linalg.inv(frames[0].pose) @ frames[1].pose
    for frame in frames:
        times = np.zeros(0) if frame.cloud.times is None else np.asarray(frame.cloud.times, np.float64)
        pipeline.register_frame(np.asarray(frame.cloud.points, np.float64), times)
        poses.append(np.array(pipeline.last_pose))
    return poses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--frames", type=int, default=10)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    methods: dict[str, tuple[bool, Callable[[list[mcg.datasets.Frame]], list[np.ndarray]]]] = {
        "as measured": (True, ours()),
        "deskewed": (True, ours(deskew=True)),
        "at rest": (False, ours()),
        "map, deskewed": (True, ours(deskew=True, against="map")),
        "map, at rest": (False, ours(against="map")),
        "KISS-ICP, deskewed": (True, kiss),
        "KISS-ICP, at rest": (False, kiss),
    }
    print(f"| drive | {' | '.join(methods)} |\n|---{'|---' * len(methods)}|")
    for drive, step, turn in DRIVES:
        errors: dict[str, list[float]] = {name: [] for name in methods}
        for seed in range(arguments.seeds):
            kinds = {spin: frames_of(step, turn, arguments.frames, seed, spin) for spin in (True, False)}
            for name, (spin, run) in methods.items():
                truth = [frame.pose for frame in kinds[spin]]
                errors[name].append(1e3 * float(metrics.rpe(run(kinds[spin]), truth)[0][_FIRST:].mean()))
        print(f"| {drive} | {' | '.join(f'{np.mean(each):.1f}' for each in errors.values())} |", flush=True)


if __name__ == "__main__":
    main()
