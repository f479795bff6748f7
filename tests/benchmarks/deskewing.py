"""Odometry of a spinning LiDAR that measures while it moves, with and without deskewing, beside KISS-ICP.

    python -m tests.benchmarks.deskewing [--seeds 3] [--frames 15]

Simulated streets at 1, 10 and 20 m/s, and at 5 m/s in a curve of 90° per second. "at rest": the same scans, measured
all at once at their poses. Errors are mean translations from frame to frame, millimetres, without the first two pairs,
in which KISS-ICP does not know its velocity yet.
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


def frames_of(step: float, turn: float, count: int, seed: int, spin: bool) -> list[mcg.datasets.Frame]:
    """Frames of a street; with `turn`, the sensor also turns about its vertical axis."""
    frames: Any = mcg.datasets.street(count, step=step, seed=seed, spin=True)
    straight = frames.path

    def turning(time: float) -> np.ndarray:
        cosine, sine = np.cos(turn * time), np.sin(turn * time)
        rotation = np.eye(4)
        rotation[:2, :2] = [[cosine, -sine], [sine, cosine]]
        return straight(time) @ rotation

    frames.path = turning
    frames.num_poses = frames.num_poses if spin else 1
    return list(frames)


def ours(**options: Any) -> Callable[[list[mcg.datasets.Frame]], list[np.ndarray]]:
    def run(frames: list[mcg.datasets.Frame]) -> list[np.ndarray]:
        return [step.pose for step in mcg.odometry(frames, mcg.GICP(), max_distance=(2.5, 0.6), **options)]

    return run


def kiss(frames: list[mcg.datasets.Frame]) -> list[np.ndarray]:
    """KISS-ICP at its defaults, with its own deskewing where there are times."""
    pipeline, poses = KissICP(load_config(None)), []
    for frame in frames:
        times = np.zeros(0) if frame.cloud.times is None else np.asarray(frame.cloud.times, np.float64)
        pipeline.register_frame(np.asarray(frame.cloud.points, np.float64), times)
        poses.append(np.array(pipeline.last_pose))
    return poses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=15)
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
