"""Pose graphs beside gtsam, false loops, loops of simulated sensors, and multiway registration beside Open3D.

Run `python -m tests.benchmarks.graph`; see README.md. Peers that are not installed are left out. Ours and gtsam take
turns; compilation is not counted.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import os
import pathlib
import statistics
import time
from collections.abc import Callable, Sequence

import jaxlie
import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax import datasets, metrics
from mcgicp_jax._sequences.loop_closure import edge_from
from tests.benchmarks.global_pose import desk
from tests.corridor import corridor as simulated_corridor
from tests.graphs import garage, grid, measured, moved, sphere, with_gtsam

DATA = pathlib.Path(os.environ.get("MCGICP_DATA", pathlib.Path(__file__).parents[3] / "shared" / "data"))
GRAPHS = {"grid": grid, "sphere": sphere, "garage": garage}
NUM_TURNS = 5
# Ten small graphs of each kind with false loops, and one large one. Sides of the grid, turns of the sphere and poses in
# each, floors of the garage and poses on each.
SMALL = {"grid": grid(5), "sphere": sphere(12, 20), "garage": garage(4, 60)}
# Noise of the starts: metres, radians.
NOISES = ((0.05, 0.02), (0.1, 0.1), (0.2, 0.3))


def sizes() -> None:
    """Cost and time of the minimum, from odometry."""
    print(
        f"{'':>8} {'poses':>6} {'edges':>6} {'steps':>6} {'ours, s':>8} {'gtsam, s':>9} {'ratio':>6} {'cost':>8} "
        "relative, covariances, s"
    )
    for name, make in GRAPHS.items():
        graph, _ = measured(*make())
        mcg.optimize_poses(graph, robust=False)
        times, costs = [], []
        for _ in range(NUM_TURNS):
            start = time.perf_counter()
            found = mcg.optimize_poses(graph, robust=False)
            ours = time.perf_counter() - start
            _, cost, theirs = with_gtsam(graph)
            times.append((ours, theirs, ours / theirs))
            costs.append(found.cost / cost - 1)
        ours, theirs, ratio = (statistics.median(each) for each in zip(*times, strict=True))
        size = f"{len(graph.poses):6d} {len(graph.edges):6d} {found.num_iterations:6d}"
        start = time.perf_counter()
        found.covariance  # noqa: B018
        spent = time.perf_counter() - start
        numbers = f"{ours:8.3f} {theirs:9.3f} {ratio:6.1f} {found.cost:8.1f} {costs[0]:.0e} {spent:.1f}"
        print(f"{name:>8} {size} {numbers}", flush=True)


def first_poses() -> None:
    """Steps and cost from odometry, and from the edges alone where loops are trusted."""
    for (name, make), deviations in itertools.product(GRAPHS.items(), NOISES):
        graph, _ = measured(*make(), deviations=deviations)
        edges = graph.edges
        trusted = mcg.Edge(edges.i, edges.j, edges.T_i_j, edges.information)
        cells = []
        for poses in (graph.poses, None):
            found = mcg.optimize_poses(mcg.PoseGraph(poses, trusted), robust=False)
            cells.append(f"{found.status.name}, {found.num_iterations} steps, cost {found.cost:.0f}")
        print(f"{name:>8} {deviations}: odometry {cells[0]}; relaxation {cells[1]}", flush=True)


def false_loops() -> None:
    """Share of loops kept rightly, and the error of the poses, with false loops added."""
    print(f"{'':>8} {'poses':>6} {'false':>6} {'ATE / clean':>12} {'precision':>10} {'recall':>8} {'s':>6}")
    large = [(name, make(), 1) for name, make in GRAPHS.items() if name != "grid"]
    graphs = [*((name, made, 10) for name, made in SMALL.items()), *large]
    for (name, (poses, loops), number), fraction in itertools.product(graphs, (0.1, 0.3, 0.5)):
        rows = []
        for seed in range(number):
            clean, _ = measured(poses, loops, seed=seed)
            best = metrics.ate(mcg.optimize_poses(clean).poses, poses, alignment="first")
            graph, true = measured(poses, loops, seed=seed, false=fraction)
            start = time.perf_counter()
            found = mcg.optimize_poses(graph)
            spent = time.perf_counter() - start
            kept, right = found.kept & graph.edges.uncertain, true & graph.edges.uncertain
            error = metrics.ate(found.poses, poses, alignment="first")
            rows.append((error / best, (kept & right).sum() / kept.sum(), (kept & right).sum() / right.sum(), spent))
        ratio, precision, recall, spent = np.array(rows).T
        numbers = f"{ratio.max():12.3f} {precision.mean():10.4f} {recall.mean():8.4f} {spent.mean():6.1f}"
        print(f"{name:>8} {len(poses):6d} {fraction:6.0%} {numbers}", flush=True)


def scenes() -> None:
    """A room that is gone round in 50 of 60 frames, and a street that is driven up and down again."""
    room = list(datasets.box_room(60, points_per_frame=2000, step=2 * np.pi * 1.6 / 50))
    street = datasets.street(31, points_per_frame=10_000)
    there_and_back = [street.observe(k if k < 30 else 60 - k, k) for k in range(60)]
    for name, frames, options in (
        ("box room", room, {"max_distance": 0.5}),
        ("street", there_and_back, {"max_distance": (2.0, 0.5), "voxel_size": 0.2}),
    ):
        truth = np.array([frame.pose for frame in frames])
        # The car stops and reverses: the motion before is no start for the next one, but within the distance.
        steps = list(mcg.odometry(frames, mcg.GICP(), start=truth[0], **options))
        looped = list(mcg.odometry(frames, mcg.GICP(), start=truth[0], loops=True, **options))[-1].graph
        found = mcg.optimize_poses(looped)
        edges = looped.edges
        unit = mcg.Edge(
            edges.i, edges.j, edges.T_i_j, np.tile(np.eye(6), (len(edges), 1, 1)), uncertain=edges.uncertain
        )
        identity = mcg.optimize_poses(mcg.PoseGraph(looped.poses, unit), robust=False)
        errors = [
            metrics.ate(poses, truth, alignment="first")
            for poses in ([s.pose for s in steps], found.poses, identity.poses)
        ]
        print(
            f"{name}: ATE {1e3 * errors[0]:.1f} mm by odometry, {1e3 * errors[1]:.1f} with "
            f"{found.kept[edges.uncertain].sum()} of {edges.uncertain.sum()} loops, {1e3 * errors[2]:.1f} with the "
            f"identity as information; NEES per dof {nees(found, truth):.2f}; {found}",
            flush=True,
        )


def nees(found: mcg.PoseGraphResult, truth: np.ndarray) -> float:
    """eᵀC⁻¹e / 6, mean over the poses."""
    squares = []
    for pose, true, covariance in list(zip(found.poses, truth, found.covariance, strict=True))[1:]:
        error = np.asarray((jaxlie.SE3.from_matrix(pose).inverse() @ jaxlie.SE3.from_matrix(true)).log())
        squares.append(error @ np.linalg.solve(covariance, error))
    return float(np.mean(squares)) / 6


def corridor() -> None:
    """A corridor whose steps are 5 % too long in the start; GICP edges, and one loop from its end by intensity."""
    number = 20
    frames = simulated_corridor(number + 1, points_per_frame=3000)
    clouds = [mcg.preprocess(frame.cloud) for frame in frames]
    truth = np.array([frame.pose for frame in frames])
    start = truth.copy()
    start[:, 0, 3] *= 1.05
    # The loop from the end to the start: the true motion, a millimetre uncertain.
    edges = []
    for k in range(number):
        init = np.linalg.inv(start[k]) @ start[k + 1]
        edges.append(
            edge_from(k, k + 1, mcg.register(clouds[k + 1], clouds[k], mcg.GICP(), init=init, max_distance=0.5))
        )
    known = np.linalg.inv(truth[0]) @ truth[-1]
    end = mcg.Edge(0, number, moved(known[None], 1e-3 * np.ones((1, 6)))[0], 1e6 * np.eye(6), uncertain=True)
    along = [(edge.T_i_j[:3, :3].T @ truth[edge.i][:3, :3].T @ [1, 0, 0]) for edge in edges]
    told = [axis @ edge.information[:3, :3] @ axis for axis, edge in zip(along, edges, strict=True)]
    across = [np.trace(edge.information[:3, :3]) for edge in edges]
    found = mcg.optimize_poses(mcg.PoseGraph(start, [*edges, end]))
    print(f"corridor: information along / across {max(np.array(told) / across):.1e}; {found}")
    for name, poses in (("start", start), ("optimised", np.asarray(found.poses))):
        error = 1e3 * metrics.ate(poses, truth, alignment="first")
        most = 1e3 * np.abs(poses - truth)[:, :3, 3].max(axis=0)
        print(f"{name:>10}: ATE {error:.1f} mm, at most {most.round(1)} mm along the axes")


def rgbd() -> None:
    """All frames at hand: odometry, multiway, and Open3D's multiway registration."""
    kitchen = [(frame.cloud, frame.pose) for frame in datasets.seven_scenes(DATA / "sevenscenes_redkitchen")]
    names = ("red", "green", "blue")
    files = [np.load(path) for path in sorted((DATA / "icl_livingroom1").glob("*.npz"))]
    room = [mcg.PointCloud(file["points"], file["rgb"], channel_names=names) for file in files]
    sets = {
        "7-Scenes": kitchen,
        "ICL": list(zip(room, mcg.io.read_poses(DATA / "icl_livingroom1" / "poses.txt"), strict=True)),
        "TUM": [(frame.cloud, frame.pose) for frame in desk()],
    }
    for name, frames in sets.items():
        raw, truth = zip(*frames, strict=True)
        clouds = [mcg.preprocess(cloud, 0.03) for cloud in raw]
        # Two positions fit each other after any rotation.
        alignment = "umeyama" if len(truth) > 2 else "first"
        cells = []
        for method in (mcg.GICP(), mcg.MultiChannelGICP()):
            steps = [step.pose for step in mcg.odometry(clouds, method)]
            found = mcg.multiway(clouds, method)
            errors = [1e3 * metrics.ate(poses, truth, alignment) for poses in (steps, found.poses)]
            cells.append(f"{type(method).__name__} {errors[0]:.3f} by odometry, {errors[1]:.3f} by multiway")
        if importlib.util.find_spec("open3d"):
            cells.append(f"Open3D {1e3 * metrics.ate(open3d_multiway(clouds, 0.03), truth, alignment):.3f}")
        print(f"{name}, {len(clouds)} frames, ATE in mm: " + "; ".join(cells), flush=True)


def open3d_multiway(clouds: Sequence[mcg.PointCloud], voxel_size: float) -> list[np.ndarray]:
    """As in Open3D's tutorial: point-to-plane ICP of all pairs, coarse and fine, and its global optimisation."""
    import open3d

    registration = open3d.pipelines.registration
    made = []
    for cloud in clouds:
        made.append(open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.asarray(cloud.points, np.float64))))
        made[-1].estimate_normals(open3d.geometry.KDTreeSearchParamKNN(20))
    graph, pose, kind = registration.PoseGraph(), np.eye(4), registration.TransformationEstimationPointToPlane()
    graph.nodes.append(registration.PoseGraphNode(pose))
    for i, j in itertools.combinations(range(len(made)), 2):
        motion = np.eye(4)
        for distance in (15 * voxel_size, 1.5 * voxel_size):
            motion = registration.registration_icp(made[i], made[j], distance, motion, kind).transformation
        information = registration.get_information_matrix_from_point_clouds(made[i], made[j], 1.5 * voxel_size, motion)
        if j == i + 1:
            pose = motion @ pose
            graph.nodes.append(registration.PoseGraphNode(np.linalg.inv(pose)))
        graph.edges.append(registration.PoseGraphEdge(i, j, motion, information, uncertain=j != i + 1))
    option = registration.GlobalOptimizationOption(1.5 * voxel_size, 0.25, 1.0, 0)
    registration.global_optimization(
        graph,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        option,
    )
    return [np.asarray(node.pose) for node in graph.nodes]


def main() -> None:
    parts: dict[str, Callable[[], None]] = {
        "sizes": sizes,
        "first-poses": first_poses,
        "false-loops": false_loops,
        "scenes": scenes,
        "corridor": corridor,
        "rgbd": rgbd,
    }
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=list(parts), metavar="PART", help=f"some of {', '.join(parts)}")
    for name in parser.parse_args().parts:
        parts[name]()


if __name__ == "__main__":
    main()
