"""Scenes whose noise is as large as the spacing of their points: which directions count as constrained.

    python -m tests.benchmarks.noise_scenes [--seeds 8] [--points 3000 10000 30000 100000]

Two noisy samples of the same surfaces, 3 cm apart, are registered by GICP from the identity, raw, with the voxel
size chosen automatically and with all points. The first four scenes are unconstrained along some directions: no
registration of them may be CONVERGED. The room and the street are constrained, and may not be DEGENERATE. NEES:
normalised estimation error squared per degree of freedom among the constrained directions, 1 where the covariance is
right.
"""

from __future__ import annotations

import argparse
import sys
import warnings

import jaxlie
import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax import datasets
from tests.benchmarks.calibration import normalised, twist_error
from tests.scenes import SURFACES

NOISES = (0.1, 0.25, 0.5, 0.75, 1.0, 1.5)


def street(rng: np.random.Generator, count: int, noise: float) -> np.ndarray:
    """A street, noise-free and dense, of which points are drawn; the spacing is that of the drawn points."""
    frames = datasets.street(1, points_per_frame=120_000, noise=0.0, seed=7)
    points = np.asarray(frames[0].cloud.points, np.float64)
    points = points[rng.choice(len(points), count, replace=False)]
    tree = mcg.KDTreeSearch()
    distance, _ = tree.query(tree.build(points), points, 2, np.inf)
    # The nearest of randomly scattered points is half a spacing, 1/√density, away (Clark and Evans 1954).
    return points + noise * 2 * np.median(distance[:, 1]) * rng.normal(size=points.shape)


FREE = {name: SURFACES[name] for name in ("plane", "floor and wall", "corridor", "crossing planes")}
HELD = {"room": SURFACES["room"], "street": street}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--points", type=int, nargs="*", default=[3000, 10_000, 30_000, 100_000])
    parser.add_argument("--scenes", nargs="*", default=[*FREE, *HELD])
    parser.add_argument("--noises", type=float, nargs="*", default=NOISES)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    truth = jaxlie.SE3.exp(np.array([0.02, -0.02, 0.01, 0.002, -0.001, 0.003]))
    apart = np.asarray(truth.as_matrix(), np.float64)
    print("| scene | points | noise, spacings | voxels | CONVERGED | DEGENERATE | NEES | smallest fraction |")
    print("|---" * 8 + "|")
    wrong = 0
    for scene in arguments.scenes:
        sample = (FREE | HELD)[scene]
        for count in arguments.points:
            for noise in arguments.noises:
                found: dict[str, list[tuple[mcg.RegistrationResult, float]]] = {"auto": [], "off": []}
                for seed in range(arguments.seeds):
                    rng = np.random.default_rng(seed)
                    target, moved = (sample(rng, count, noise) for _ in range(2))
                    source = (moved - apart[:3, 3]) @ apart[:3, :3]
                    all_points = [mcg.preprocess(points, None) for points in (source, target)]
                    for name, clouds in (("auto", [source, target]), ("off", all_points)):
                        result = mcg.register(*clouds, mcg.GICP())
                        found[name].append((result, normalised_error(result, apart)))
                for name, results in found.items():
                    statuses = [result.status for result, _ in results]
                    converged = statuses.count(mcg.Status.CONVERGED)
                    degenerate = statuses.count(mcg.Status.DEGENERATE)
                    wrong += converged if scene in FREE else degenerate
                    least = [float(np.min(result.directions.geometry)) for result, _ in results]
                    edge = max(least) if scene in FREE else min(least)
                    nees = np.nanmean([each for _, each in results])
                    print(
                        f"| {scene} | {count:,} | {noise:g} | {name} | {converged}/{arguments.seeds} "
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
