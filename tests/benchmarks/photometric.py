"""What the photometric term does besides accuracy: thirty walls, useless channels, far starts, and its time.

Run `python -m tests.benchmarks.photometric`; see README.md.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time
from collections.abc import Callable

import numpy as np

import mcgicp_jax as mcg
from tests.benchmarks import accuracy
from tests.benchmarks.calibration import normalised, twist_error

METHODS = {"without": mcg.MultiChannelGICP(), "with": mcg.MultiChannelGICP(photometric=True)}
NUM_WALLS = 30
# Walls and metres along the wall: 30 starts.
FAR_WALLS, FAR = range(6), (0.05, 0.1, 0.15, 0.2, 0.3)
FOUND = 0.01
NUM_TURNS = 5


def wall(seed: int) -> accuracy.Pair:
    target, source = mcg.datasets.poster_wall(2, seed=seed)
    return accuracy.pair_of(source, target)


def walls() -> None:
    print("\nThirty walls from the identity")
    for name, method in METHODS.items():
        degenerate, squares, errors = [], [], []
        for seed in range(NUM_WALLS):
            pair = wall(seed)
            result = mcg.register(pair.source, pair.target, method)
            if result.status is not mcg.Status.CONVERGED:
                degenerate.append(f"{seed} {result.status.name}")
            error = twist_error(result.matrix, pair.truth)
            squares.append(normalised(error, np.asarray(result.covariance), result.directions))
            errors.append(1e3 * np.linalg.norm(error[:3]))
        print(
            f"{name:>8}: not converged: {degenerate or 'none'}; normalised squared error {np.mean(squares):.2f}", end=""
        )
        print(f"; rms error {np.sqrt(np.mean(np.square(errors))):.2f} mm")


def channels() -> None:
    print("\nChange of the pose of five walls, with the term")
    rng = np.random.default_rng(0)

    def scaled(cloud: mcg.PointCloud) -> np.ndarray:
        return 255 * np.asarray(cloud.channels)

    def with_noise(cloud: mcg.PointCloud) -> np.ndarray:
        noise = rng.normal(size=(len(cloud), 1)).astype(np.float32)
        return np.concatenate([cloud.channels, noise], axis=1)

    changes: dict[str, Callable[[mcg.PointCloud], np.ndarray]] = {"times 255": scaled, "a channel of noise": with_noise}
    for name, change in changes.items():
        apart = []
        for seed in range(5):
            pair = wall(seed)
            others = [mcg.PointCloud(cloud.points, change(cloud)) for cloud in (pair.source, pair.target)]
            before = mcg.register(pair.source, pair.target, METHODS["with"]).matrix
            apart.append(1e3 * mcg.metrics.pose_error(mcg.register(*others, METHODS["with"]).matrix, before)[0])
        print(f"{name:>20}: {min(apart):.4f} to {max(apart):.4f} mm")


def basin() -> None:
    print(f"\nStarts {FAR[0]} to {FAR[-1]} m along the wall from which the error falls below {1e3 * FOUND:.0f} mm")
    for label, scales in (("one scale", ()), ("three scales", (0.1, 0.05))):
        for name, method in METHODS.items():
            found = 0
            for seed, far in itertools.product(FAR_WALLS, FAR):
                target, source = mcg.datasets.poster_wall(2, seed=seed)
                pair = accuracy.pair_of(source, target)
                start = pair.truth.copy()
                start[:3, 3] += far * target.pose[0, :3]
                result = mcg.register(pair.source, pair.target, method, init=start, voxel_sizes=scales)
                found += mcg.metrics.pose_error(result.matrix, pair.truth)[0] < FOUND
            print(f"{label:>12}, {name:>7}: {found} of {len(FAR_WALLS) * len(FAR)}")


def times() -> None:
    print("\nTime with the term over that without it: register, and with preprocessing; medians")
    for name in ("posters", "kitti, intensity", "flat", "recorded", "7-scenes"):
        make, voxel, options = accuracy.SETS[name]
        ratios = []
        for pair in itertools.islice(make(), 3):
            for turn in range(NUM_TURNS + 1):
                row = []
                for method in METHODS.values():
                    begin = time.perf_counter()
                    clouds = [mcg.preprocess(cloud, voxel) for cloud in (pair.source, pair.target)]
                    ready = time.perf_counter()
                    mcg.register(*clouds, method, init=pair.start, **options)
                    row.append((time.perf_counter() - ready, time.perf_counter() - begin))
                # The first turn compiles.
                if turn:
                    ratios.append([mine / other for other, mine in zip(*row, strict=True)])
        alone, whole = (statistics.median(column) for column in zip(*ratios, strict=True))
        print(f"{name:>20}: {alone:.2f}, {whole:.2f}")


PARTS = {"walls": walls, "channels": channels, "basin": basin, "times": times}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", help=f"which of {', '.join(PARTS)}; all by default")
    for name in parser.parse_args().parts or PARTS:
        PARTS[name]()


if __name__ == "__main__":
    main()
