"""Errors of poses by clouds, tie points and a prior, and whether their covariances are right.

    python -m tests.benchmarks.tie_points

GICP on 40 simulated pairs of a room and of a bare corridor, with six tie points and a prior, from starts 3 cm off. Root
mean square of the errors as motion of the matched points, in mm, and normalised estimation error squared per degree of
freedom, which is 1 where the covariance is right.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

import mcgicp_jax as mcg
from tests.corridor import corridor
from tests.scenes import motion

OPTIONS = {"max_distance": 0.5}


def covariance(rng, size, deviation):
    root = rng.normal(size=(size, size))
    return deviation**2 * (root @ root.T / size + 0.3 * np.eye(size))


def tie_points(truth, points, deviation, count=6, seed=0):
    """Some of the points and where they are in the target, with errors."""
    rng = np.random.default_rng(seed)
    points = np.asarray(points, float)[rng.permutation(len(points))[:count]]
    covariances = np.array([covariance(rng, 3, deviation) for _ in range(count)]).reshape(count, 3, 3)
    errors = [rng.multivariate_normal(np.zeros(3), each) for each in covariances]
    return points, points @ truth[:3, :3].T + truth[:3, 3] + np.reshape(errors, (count, 3)), covariances


def measured(truth, deviations, seed=0):
    """A measurement P of a pose T = P exp(ξ), and its covariance."""
    given = np.diag(np.square(deviations))
    return truth @ motion(-np.random.default_rng(seed).normal(size=6) * deviations), given


def twist_error(matrix, truth):
    left = np.linalg.inv(truth) @ matrix
    return np.append(left[:3, 3], Rotation.from_matrix(left[:3, :3]).as_rotvec())


def aligned(ties):
    """The pose of least squares of the tie points alone."""
    (source, target), fit = (each - each.mean(axis=0) for each in ties[:2]), np.eye(4)
    fit[:3, :3] = Rotation.align_vectors(target, source)[0].as_matrix()
    fit[:3, 3] = ties[1].mean(axis=0) - fit[:3, :3] @ ties[0].mean(axis=0)
    return fit


def simulate(scene, count):
    """Errors in metres and normalised errors squared by what is used, the share CONVERGED with ties or prior."""
    make = mcg.datasets.box_room(2, points_per_frame=5000) if scene == "room" else corridor(2, textured=False)
    near, deviations = (2e-3, (7e-4, 4e-4)) if scene == "room" else (0.01, (3e-3, 1e-3))
    squares, nees, converged = {}, {}, []
    for seed in range(count):
        target, source = (make.observe(i, noise_seed=2 * seed + i) for i in (0, 1))
        truth = np.linalg.inv(target.pose) @ source.pose
        clouds = [mcg.preprocess(frame.cloud) for frame in (source, target)]
        ties = tie_points(truth, source.cloud.points, near, seed=seed)
        prior = measured(truth, np.repeat(deviations, 3), seed=1000 + seed)
        start = truth @ motion(np.random.default_rng(seed).normal(size=6) * (0.03, 0.03, 0.03, 0, 0, 0))
        given = {"clouds alone": {}, "tie points": {"tie_points": ties}, "prior": {"prior": prior}}
        given["both"] = given["tie points"] | given["prior"]
        for name, options in given.items():
            result = mcg.register(*clouds, mcg.GICP(), init=start, **options, **OPTIONS)
            coordinates = np.linalg.inv(np.asarray(result.directions.twists, float).T)
            constrained = np.asarray(result.directions.constrained)
            error = coordinates @ twist_error(result.matrix, truth)
            spread = (coordinates @ np.asarray(result.covariance) @ coordinates.T)[np.ix_(constrained, constrained)]
            value = error[constrained] @ np.linalg.solve(spread, error[constrained]) / constrained.sum()
            nees.setdefault(name, []).append(value)
            squares.setdefault(name, []).append(error @ error)
            if options:
                converged.append(result.converged)
        for name, matrix in (("tie points alone", aligned(ties)), ("prior alone", prior[0])):
            squares.setdefault(name, []).append(np.sum((coordinates @ twist_error(matrix, truth)) ** 2))
    errors = {name: float(np.sqrt(np.mean(each))) for name, each in squares.items()}
    return errors, {name: float(np.mean(each)) for name, each in nees.items()}, float(np.mean(converged))


def main() -> None:
    for scene in ("room", "corridor"):
        errors, nees, converged = simulate(scene, 40)
        print(f"{scene}: {converged:.0%} of the poses with tie points or prior are CONVERGED")
        for name, error in errors.items():
            print(f"{name:>18}  {1e3 * error:6.2f} mm  {nees.get(name, np.nan):5.2f}")


if __name__ == "__main__":
    main()
