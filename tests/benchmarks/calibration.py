"""Calibration of the covariance of a pose: errors of simulated registrations compared with their covariances.

    python -m tests.benchmarks.calibration [--pairs 84]

Three scenes with exact truth (a furnished room, a street, a wall of posters), two noise levels, fresh rays and noise
for every pair. The table has the normalised estimation error squared per degree of freedom, eᵀ C⁻¹ e / d, averaged over
the pairs: 1 if C is right, above if too small, below if too large. d is the number of constrained directions.
For comparison with `RegistrationResult.covariance`, C is also the inverse Hessian: unscaled, scaled by the variance of
the residuals, and small_gicp's for the same clouds.

    python -m tests.benchmarks.calibration --seeds 20

One pair of each of many scenes instead, raw, with all defaults, from the identity: the mean over the CONVERGED ones.
NDT and D2D-NDT have the cells of above and start at the truth; their errors hardly differ between pairs of one scene.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
import small_gicp

import mcgicp_jax as mcg
from mcgicp_jax import datasets
from mcgicp_jax._pose_solver.degeneracy import Directions


def box_room(noise: float) -> datasets.SyntheticFrames:
    return datasets.box_room(2, points_per_frame=5000, noise=noise)


def street(noise: float) -> datasets.SyntheticFrames:
    return datasets.street(2, points_per_frame=12_000, noise=noise)


def wall(noise: float) -> datasets.SyntheticFrames:
    return datasets.poster_wall(2, noise=noise)


# Scene, max_distance and size of cells in metres
SCENES: dict[str, tuple[Callable[[float], datasets.SyntheticFrames], float, float]] = {
    "box room": (box_room, 0.5, 0.5),
    "street": (street, 1.5, 1.0),
    "poster wall": (wall, 0.08, 0.2),
}
METHODS = {
    "GICP": mcg.GICP(),
    "MC-GICP": mcg.MultiChannelGICP(),
    "photometric": mcg.MultiChannelGICP(photometric=True),
    "NDT": mcg.NDT(),
    "D2D-NDT": mcg.D2DNDT(),
}


def twist_error(matrix: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """ξ in T = T_true exp(ξ), to first order."""
    left = np.linalg.inv(truth) @ matrix
    rotation = left[:3, :3]
    omega = 0.5 * np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return np.append(left[:3, 3], omega)


def normalised(error: np.ndarray, covariance: np.ndarray, directions: Directions) -> float:
    """eᵀ C⁻¹ e / d in the subspace of the constrained directions."""
    coefficients = np.linalg.inv(np.asarray(directions.twists, np.float64).T)[np.asarray(directions.constrained)]
    error, covariance = coefficients @ error, coefficients @ covariance @ coefficients.T
    return float(error @ np.linalg.solve(covariance, error) / len(error))


def peers_hessian(
    source: np.ndarray, target: np.ndarray, truth: np.ndarray, max_distance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Error and H⁻¹ of small_gicp for the twist ξ = (v, ω)."""
    clouds = [small_gicp.preprocess_points(points, 0.001, num_neighbors=20)[0] for points in (target, source)]
    tree = small_gicp.KdTree(clouds[0])
    result = small_gicp.align(
        *clouds, tree, init_T_target_source=truth, registration_type="GICP", max_correspondence_distance=max_distance
    )
    # small_gicp orders the twist as (ω, v).
    order = [3, 4, 5, 0, 1, 2]
    return twist_error(result.T_target_source, truth), np.linalg.inv(result.H[np.ix_(order, order)])


def calibrate(scene: str, noise: float, pairs: int) -> dict[str, list[float]]:
    make, max_distance, cell = SCENES[scene]
    frames = make(noise)
    claims: dict[str, list[float]] = {}
    for seed in range(pairs):
        target, source = (frames.observe(i, noise_seed=2 * seed + i) for i in (0, 1))
        truth = np.linalg.inv(target.pose) @ source.pose
        clouds = [mcg.preprocess(frame.cloud) for frame in (source, target)]
        for name, method in METHODS.items():
            if method.needs_covariances:
                cells = [mcg.voxel_gaussians(frame.cloud, cell) for frame in (source, target)]
                moving = cells[0] if "source" in method.needs_covariances else clouds[0]
                result = mcg.register(moving, cells[1], method, init=truth)
            else:
                result = mcg.register(*clouds, method, init=truth, max_distance=max_distance)
            error = twist_error(result.matrix, truth)
            held = result.directions
            variance = float(result.cost) / (3 * int(result.num_inliers))
            inverse = np.linalg.pinv(np.asarray(result.information, np.float64))
            claims.setdefault(f"{name} covariance", []).append(normalised(error, np.asarray(result.covariance), held))
            claims.setdefault(f"{name} H⁻¹", []).append(normalised(error, inverse, held))
            claims.setdefault(f"{name} σ² H⁻¹", []).append(normalised(error, variance * inverse, held))
            claims.setdefault(f"{name} constrained", []).append(np.sum(held.constrained))
            if name == "GICP":
                raw = [np.asarray(frame.cloud.points, np.float64) for frame in (source, target)]
                error, inverse = peers_hessian(*raw, truth, max_distance)
                claims.setdefault("small_gicp H⁻¹", []).append(normalised(error, inverse, held))
    return claims


MANY: dict[str, Callable[[int], datasets.SyntheticFrames]] = {
    "box room": lambda seed: datasets.box_room(2, seed=seed, points_per_frame=5000),
    "street": lambda seed: datasets.street(2, seed=seed),
    "poster wall": lambda seed: datasets.poster_wall(2, seed=seed),
}


def many(seeds: int) -> None:
    print("| scene | method | CONVERGED | NEES | largest error, mm |\n|---|---|---|---|---|")
    for scene, make in MANY.items():
        rows: dict[str, list[tuple[float, float]]] = {}
        for seed in range(100, 100 + seeds):
            target, source = make(seed)
            truth = np.linalg.inv(target.pose) @ source.pose
            for name, method in METHODS.items():
                clouds = [
                    mcg.voxel_gaussians(frame.cloud, SCENES[scene][2])
                    if side in method.needs_covariances
                    else frame.cloud
                    for side, frame in (("source", source), ("target", target))
                ]
                result = mcg.register(*clouds, method, init=truth if method.needs_covariances else None)
                if result.converged:
                    error = twist_error(result.matrix, truth)
                    nees = normalised(error, np.asarray(result.covariance), result.directions)
                    rows.setdefault(name, []).append((nees, mcg.metrics.pose_error(result.matrix, truth)[0]))
        for name, found in rows.items():
            nees, errors = np.array(found).T
            row = f"{len(found)}/{seeds} | {np.mean(nees):.2f} | {1e3 * errors.max():.1f}"
            print(f"| {scene} | {name} | {row} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=84, help="per scene and noise level")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--seeds", type=int, help="number of scenes of each kind, raw and from the identity")
    arguments = parser.parse_args()
    if arguments.seeds is not None:
        many(arguments.seeds)
        return
    columns: list[str] = []
    for scene in arguments.scenes:
        for noise in (1.0, 2.0):
            claims = calibrate(scene, noise, arguments.pairs)
            if not columns:
                columns = list(claims)
                print("| scene | noise | pairs | " + " | ".join(columns) + " |")
                print("|---" * (len(columns) + 3) + "|")
            means = " | ".join(f"{np.mean(claims[name]):.2f}" for name in columns)
            print(f"| {scene} | {noise:g} | {arguments.pairs} | {means} |", flush=True)


if __name__ == "__main__":
    main()
