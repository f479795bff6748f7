"""Scenes whose noise is as large as the spacing of their points: which directions count as constrained.

    python -m tests.benchmarks.noise_scenes [--seeds 8] [--points 3000 10000 30000 100000] [--methods NDT ...]

Two noisy samples of the same surfaces, 3 cm apart, are registered from the identity, raw, with the voxel size chosen
automatically and with all points; NDT and D2D-NDT with cells of four and eight spacings of the points. The first four
scenes are unconstrained along some directions: no registration of them may be CONVERGED. The room and the street are
constrained, and may not be DEGENERATE. NEES: normalised estimation error squared per degree of freedom among the
constrained directions, 1 where the covariance is right.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import warnings
from collections.abc import Iterator

import jaxlie
import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax import datasets
from tests.benchmarks.calibration import normalised, twist_error
from tests.scenes import SURFACES

# Sizes of cells in spacings of the points: some sixteen and sixty points of a plane without noise in each.
CELLS = (4, 8)
NOISES = (0.1, 0.25, 0.5, 0.75, 1.0, 1.5)


def street(rng: np.random.Generator, count: int, noise: float) -> np.ndarray:
    """A street, noise-free and dense, of which points are drawn; the spacing is that of the drawn points."""
    frames = datasets.street(1, points_per_frame=120_000, noise=0.0, seed=7)
    points = np.asarray(frames[0].cloud.points, np.float64)
    points = points[rng.choice(len(points), count, replace=False)]
    return points + noise * spacing(points) * rng.normal(size=points.shape)


def spacing(points: np.ndarray) -> float:
    """Twice the distance to the nearest point, which for randomly scattered ones is half of 1/√density (Clark and Evans
    1954)."""
    tree = mcg.KDTreeSearch()
    distance, _ = tree.query(tree.build(points), points, 2, np.inf)
    return 2 * float(np.median(distance[:, 1]))


FREE = {name: SURFACES[name] for name in ("plane", "floor and wall", "corridor", "crossing planes")}
HELD = {"room": SURFACES["room"], "street": street}


def registered(name: str, source: np.ndarray, target: np.ndarray) -> Iterator[tuple[str, mcg.RegistrationResult]]:
    """Results of a method, each with the words that name its row."""
    if name == "GICP":
        yield "GICP, auto", mcg.register(source, target, mcg.GICP())
        yield "GICP, off", mcg.register(*(mcg.preprocess(points, None) for points in (source, target)), mcg.GICP())
        return
    for times in CELLS:
        size = times * spacing(target)
        yield f"{name}, {times} spacings", mcg.register(source, target, getattr(mcg, name)(), voxel_sizes=(size,))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--points", type=int, nargs="*", default=[3000, 10_000, 30_000, 100_000])
    parser.add_argument("--scenes", nargs="*", default=[*FREE, *HELD])
    parser.add_argument("--noises", type=float, nargs="*", default=NOISES)
    parser.add_argument("--methods", nargs="*", choices=["GICP", "NDT", "D2DNDT"], default=["GICP"])
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    truth = jaxlie.SE3.exp(np.array([0.02, -0.02, 0.01, 0.002, -0.001, 0.003]))
    apart = np.asarray(truth.as_matrix(), np.float64)
    print("| scene | points | noise, spacings | method, voxels | CONVERGED | DEGENERATE | NEES | smallest fraction |")
    print("|---" * 8 + "|")
    wrong = 0
    for scene, count, noise in itertools.product(arguments.scenes, arguments.points, arguments.noises):
        sample = (FREE | HELD)[scene]
        found: dict[str, list[mcg.RegistrationResult]] = {}
        for seed in range(arguments.seeds):
            rng = np.random.default_rng(seed)
            target, moved = (sample(rng, count, noise) for _ in range(2))
            source = (moved - apart[:3, 3]) @ apart[:3, :3]
            for name in arguments.methods:
                for words, result in registered(name, source, target):
                    found.setdefault(words, []).append(result)
        for words, results in found.items():
            statuses = [result.status for result in results]
            converged = statuses.count(mcg.Status.CONVERGED)
            degenerate = statuses.count(mcg.Status.DEGENERATE)
            wrong += converged if scene in FREE else degenerate
            least = [float(np.min(result.directions.geometry)) for result in results]
            edge = max(least) if scene in FREE else min(least)
            nees = np.nanmean([normalised_error(result, apart) for result in results])
            print(
                f"| {scene} | {count:,} | {noise:g} | {words} | {converged}/{arguments.seeds} "
                f"| {degenerate}/{arguments.seeds} | {nees:.2f} | {edge:.4f} |",
                flush=True,
            )
    print(f"\n{wrong} wrong")
    sys.exit(min(wrong, 1))


def normalised_error(result: mcg.RegistrationResult, truth: np.ndarray) -> float:
    """NaN where nothing is constrained or the registration failed."""
    if not np.any(result.directions.constrained) or not np.all(np.isfinite(result.matrix)):
        return float("nan")
    return normalised(twist_error(result.matrix, truth), np.asarray(result.covariance), result.directions)


if __name__ == "__main__":
    main()
