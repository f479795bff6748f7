"""Generated pose graphs with exact truth, shaped like the usual benchmarks."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import mcgicp_jax as mcg
from mcgicp_jax.extend import AbstractFactor
from tests.scenes import motion


def moved(poses, twists):
    """T exp(ξ)-like motions: (v, ω) applied as translation and rotation vector."""
    change = np.tile(np.eye(4), (len(twists), 1, 1))
    change[:, :3, :3] = Rotation.from_rotvec(twists[:, 3:]).as_matrix()
    change[:, :3, 3] = twists[:, :3]
    return poses @ change


def sphere(turns=50, per_turn=50, radius=50.0):
    """A spiral over a sphere; loops to the pose one turn before."""
    poses = []
    n = turns * per_turn
    for k in range(n):
        latitude, longitude = np.pi * ((k + 0.5) / n - 0.5), 2 * np.pi * k / per_turn
        up = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
        ahead = np.array([-np.sin(longitude), np.cos(longitude), 0])
        matrix = np.eye(4)
        matrix[:3] = np.column_stack([ahead, np.cross(up, ahead), up, radius * up])
        poses.append(matrix)
    return np.array(poses), [(k, k + per_turn) for k in range(n - per_turn)]


def grid(side=5, step=1.0):
    """A path through all cells of a cube, back and forth; loops to most neighbours."""
    rng = np.random.default_rng(5)
    cells = []
    for z in range(side):
        for y in range(side)[:: 1 if z % 2 == 0 else -1]:
            cells += [(x, y, z) for x in range(side)[:: 1 if (y + z) % 2 == 0 else -1]]
    cells = np.array(cells)
    poses = np.array([motion((*(step * cell), *(0.5 * rng.normal(size=3)))) for cell in cells])
    steps = np.abs(cells[:, None] - cells).sum(axis=2)
    return poses, [(i, j) for i, j in np.argwhere(steps == 1) if j > i + 1 and rng.random() < 0.9]


def garage(floors=4, per_floor=400, size=(60.0, 30.0)):
    """A car drives round on each floor of a garage, ramps between; loops to the same place one and two floors down."""
    poses = []
    for k in range(floors * per_floor):
        angle = 2 * np.pi * k / per_floor
        place = np.array([size[0] * np.cos(angle), size[1] * np.sin(angle), 3.0 * k / per_floor])
        poses.append(motion((*place, 0, 0, np.arctan2(size[1] * np.cos(angle), -size[0] * np.sin(angle)))))
    n = len(poses)
    return np.array(poses), [
        (k, k + per_floor + d) for k in range(n - per_floor) for d in (-1, 0, 1) if k + per_floor + d < n
    ]


def measured(poses, loops, deviations=(0.05, 0.02), seed=0, false=0.0):
    """A graph with noisy odometry and loops, started from odometry, and which edges are true.

    Args:
        false: fraction of the loops that are wrong, added to the true ones.
    """
    rng = np.random.default_rng(seed)
    sigma = np.repeat(deviations, 3)
    i, j = np.array([(k, k + 1) for k in range(len(poses) - 1)] + list(loops)).T
    motions = moved(np.linalg.inv(poses[i]) @ poses[j], sigma * rng.normal(size=(len(i), 6)))
    number = round(len(loops) * false / (1 - false))
    a = rng.integers(0, len(poses), number)
    b = (a + rng.integers(2, len(poses) - 2, number)) % len(poses)
    extent = np.ptp(poses[:, :3, 3], axis=0).max()
    wrong = moved(np.tile(np.eye(4), (number, 1, 1)), np.repeat([0.3 * extent, 1.0], 3) * rng.normal(size=(number, 6)))
    edges = mcg.Edge(
        np.concatenate([i, a]),
        np.concatenate([j, b]),
        np.concatenate([motions, wrong]),
        np.tile(np.diag(sigma**-2.0), (len(i) + number, 1, 1)),
        uncertain=np.arange(len(i) + number) >= len(poses) - 1,
    )
    start = [poses[0]]
    for step in motions[: len(poses) - 1]:
        start.append(start[-1] @ step)
    return mcg.PoseGraph(np.array(start), edges), np.arange(len(edges)) < len(i)


def with_priors(graph, truth, seed=7):
    """The graph with positions of every other pose, without rotations, and one full prior; 0.1 m and 0.05 rad."""
    rng = np.random.default_rng(seed)
    sigma = np.repeat((0.1, 0.05), 3)
    rows = np.append(np.arange(1, len(truth), 2), len(truth) - 1)
    information = np.tile(np.diag(sigma**-2.0), (len(rows), 1, 1))
    information[:-1, 3:] = 0
    priors = mcg.Edge(
        np.full(len(rows), mcg.WORLD), rows, moved(truth[rows], sigma * rng.normal(size=(len(rows), 6))), information
    )
    return mcg.PoseGraph(graph.poses, joined(graph.edges, priors))


def joined(*edges):
    return jax.tree.map(lambda *values: np.concatenate(values), *edges)


def with_gtsam(graph, weights=None, covariances=False):
    """Poses and cost at the minimum of gtsam's Levenberg-Marquardt from the same start, and seconds that it took.

    With `covariances`, those of the poses instead of the seconds.
    """
    import time

    import gtsam

    factors, values, edges = gtsam.NonlinearFactorGraph(), gtsam.Values(), graph.edges
    for k, matrix in enumerate(graph.poses):
        values.insert(k, gtsam.Pose3(matrix))
    # gtsam's tangent has the rotation first.
    order = [3, 4, 5, 0, 1, 2]
    for k in range(len(edges)) if weights is None else np.flatnonzero(weights):
        noise = gtsam.noiseModel.Gaussian.Information(edges.information[k][np.ix_(order, order)])
        motion, j = gtsam.Pose3(edges.T_i_j[k]), int(edges.j[k])
        if edges.i[k] == mcg.WORLD:
            factors.add(gtsam.PriorFactorPose3(j, motion, noise))
        else:
            factors.add(gtsam.BetweenFactorPose3(int(edges.i[k]), j, motion, noise))
    if not np.any(edges.i == mcg.WORLD):
        factors.add(gtsam.NonlinearEqualityPose3(0, gtsam.Pose3(graph.poses[0])))
    start = time.perf_counter()
    optimizer = gtsam.LevenbergMarquardtOptimizer(factors, values)
    found = optimizer.optimize()
    seconds = time.perf_counter() - start
    poses = np.array([found.atPose3(k).matrix() for k in range(len(graph.poses))])
    if covariances:
        marginals = gtsam.Marginals(factors, found)
        own = [np.ix_(order, order)] * len(poses)
        return poses, factors.error(found), np.array([marginals.marginalCovariance(k)[o] for k, o in enumerate(own)])
    return poses, factors.error(found), seconds


SMALL = {"sphere": sphere(6, 10), "grid": grid(3), "garage": garage(2, 40)}


def correlated(graph, seed=1, rank=3):
    """The graph with full information matrices, the last one of that rank."""
    rng = np.random.default_rng(seed)
    roots = (np.eye(6) + 0.3 * rng.normal(size=(len(graph.edges), 6, 6))) * [20, 20, 20, 50, 50, 50]
    roots[-1, rank:] = 0
    edges = graph.edges
    return mcg.PoseGraph(
        graph.poses, mcg.Edge(edges.i, edges.j, edges.T_i_j, roots.swapaxes(1, 2) @ roots, uncertain=edges.uncertain)
    )


def shifted(graph, origin):
    """The graph with its world's origin moved to the negative of a position."""
    poses, motions = graph.poses.copy(), graph.edges.T_i_j.copy()
    poses[:, :3, 3] += origin
    motions[graph.edges.i == mcg.WORLD, :3, 3] += origin
    edges = mcg.Edge(graph.edges.i, graph.edges.j, motions, graph.edges.information, uncertain=graph.edges.uncertain)
    return mcg.PoseGraph(poses, edges)


class Distance(AbstractFactor):
    """Distances between two positions, metres."""

    rows: Any
    information: Any
    uncertain: Any
    metres: Any

    def linearize(self, poses):
        between = poses[:, 1, :3, 3] - poses[:, 0, :3, 3]
        length = np.linalg.norm(between, axis=1)
        towards = np.einsum("mi,mkij->mkj", between / length[:, None], poses[:, :, :3, :3]) * [[[-1], [1]]]
        jacobians = np.concatenate([towards, np.zeros_like(towards)], axis=2)
        return (length - self.metres)[:, None], jacobians[:, :, None]


class Height(AbstractFactor):
    """Heights of positions in the world, metres."""

    rows: Any
    information: Any
    uncertain: Any
    metres: Any

    def linearize(self, poses):
        jacobians = np.zeros((len(poses), 2, 1, 6))
        jacobians[:, 1, 0, :3] = poses[:, 1, 2, :3]
        return poses[:, 1, 2, 3:] - self.metres[:, None], jacobians


def with_factors():
    """A graph anchored by a prior, with distances, the last of which is wrong, and heights; and its truth."""
    truth, loops = grid(2)
    graph, _ = measured(truth, loops)
    prior = mcg.Edge(mcg.WORLD, 0, truth[0], 1e4 * np.eye(6))[None]
    a, b = np.array([0, 1, 2]), np.array([6, 5, 7])
    metres = np.linalg.norm(truth[a, :3, 3] - truth[b, :3, 3], axis=1) + np.array([0.003, -0.005, 2.0])
    distances = Distance(np.stack([a, b], axis=1), np.full((3, 1, 1), 1e4), np.ones(3, bool), metres)
    rows = np.stack([np.full(4, mcg.WORLD), np.arange(4, 8)], axis=1)
    heights = Height(rows, np.full((4, 1, 1), 2.5e3), np.zeros(4, bool), truth[4:, 2, 3] + [0.01, -0.02, 0.01, 0.0])
    return mcg.PoseGraph(graph.poses, joined(graph.edges, prior), [distances, heights]), truth
