"""Share of starts from which the pose is found, against the start's error, for our methods and peers.

Run `python -m tests.benchmarks.starts`; see README.md. A pose is found if its errors are below two voxels and 2°. Peers
that are not installed are left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import pathlib
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

import mcgicp_jax as mcg
from mcgicp_jax.metrics import pose_error

DATA = pathlib.Path(os.environ.get("MCGICP_DATA", pathlib.Path(__file__).parents[3] / "shared" / "data"))
# Radians.
FOUND = np.radians(2.0)

Pair: TypeAlias = tuple[mcg.PointCloud, mcg.PointCloud, np.ndarray]
Solver: TypeAlias = Callable[[mcg.PointCloud, mcg.PointCloud, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Set:
    """Pairs, the voxel that clouds are thinned to (metres), and the errors of the starts, in voxels and degrees."""

    pairs: Callable[[], Iterator[Pair]]
    voxel: float
    starts: tuple[tuple[float, float], ...]


def kitti() -> Iterator[Pair]:
    """Twelve pairs, one or two frames apart."""
    frames = list(mcg.datasets.kitti(DATA / "kitti" / "sequences" / "04"))
    for i, j in [(i + 1, i) for i in range(9)] + [(i + 2, i) for i in range(3)]:
        yield frames[i].cloud, frames[j].cloud, np.linalg.inv(frames[j].pose) @ frames[i].pose


def lidar_pair() -> Iterator[Pair]:
    """One pair, from twelve starts."""
    source, target = (mcg.io.read(DATA / "lidar_pair" / f"{name}.ply") for name in ("source", "target"))
    for _ in range(12):
        yield source, target, np.loadtxt(DATA / "lidar_pair" / "T_target_source.txt")


def kitchen() -> Iterator[Pair]:
    """Twelve pairs of RGB-D frames, one to three frames apart, in metres and colours."""
    frames = list(mcg.datasets.seven_scenes(DATA / "sevenscenes_redkitchen"))
    for gap in range(1, len(frames)):
        for i in range(len(frames) - gap):
            yield frames[i + gap].cloud, frames[i].cloud, np.linalg.inv(frames[i].pose) @ frames[i + gap].pose


LIDAR = ((2.0, 5.0), (8.0, 10.0), (16.0, 20.0), (20.0, 30.0), (20.0, 40.0))
SETS = {
    "kitti": Set(kitti, 0.25, LIDAR),
    "lidar_pair": Set(lidar_pair, 0.25, LIDAR),
    "kitchen": Set(kitchen, 0.03, ((3.0, 5.0), (5.0, 10.0), (10.0, 20.0), (15.0, 30.0), (20.0, 40.0))),
}


def ours(voxel: float, method: mcg.AbstractMethod, *scales: float) -> Solver:
    """Points are thinned to voxels, cells are made of all points; preprocessing counts. Scales are in voxels."""

    def run(source: mcg.PointCloud, target: mcg.PointCloud, start: np.ndarray) -> np.ndarray:
        clouds = [
            cloud if name in method.needs_covariances else mcg.preprocess(cloud, voxel)
            for name, cloud in (("source", source), ("target", target))
        ]
        return np.asarray(
            mcg.register(*clouds, method, init=start, voxel_sizes=[voxel * scale for scale in scales]).matrix
        )

    return run


def small_gicp(voxel: float, kind: str) -> Solver:
    import small_gicp as peer

    def run(source: mcg.PointCloud, target: mcg.PointCloud, start: np.ndarray) -> np.ndarray:
        points = [np.asarray(cloud.points, np.float64) for cloud in (target, source)]
        result = peer.align(
            *points,
            start,
            registration_type=kind,
            voxel_resolution=4 * voxel,
            downsampling_resolution=voxel,
            max_correspondence_distance=10 * voxel,
            num_threads=2,
        )
        return np.asarray(result.T_target_source)

    return run


def open3d_ndt(voxel: float) -> Solver:
    from open3d import geometry, pipelines, utility

    registration = pipelines.registration
    option = registration.NormalDistributionsTransformOption(voxel_size=8 * voxel)

    def run(source: mcg.PointCloud, target: mcg.PointCloud, start: np.ndarray) -> np.ndarray:
        clouds = []
        for cloud in (source, target):
            made = geometry.PointCloud(utility.Vector3dVector(np.asarray(cloud.points, np.float64)))
            clouds.append(made.voxel_down_sample(voxel))
        return np.asarray(registration.registration_ndt(*clouds, option, start).transformation)

    return run


def displaced(generator: np.random.Generator, metres: float, degrees: float) -> np.ndarray:
    """A motion of that length, mostly level, and that angle, mostly about the vertical."""
    shift, axis = generator.normal(size=3) * [1, 1, 0.1], generator.normal(size=3) * [0.2, 0.2, 1]
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    pose[:3, 3] = metres * shift / np.linalg.norm(shift)
    return pose


def solvers_for(voxel: float) -> dict[str, Solver]:
    gicp, cells = mcg.GICP(), (32, 16, 8, 4, 2)
    solvers: dict[str, Solver] = {
        "GICP": ours(voxel, gicp),
        "GICP, scales 4, 2": ours(voxel, gicp, 4, 2),
        "GICP, scales 8, 4, 2": ours(voxel, gicp, 8, 4, 2),
        "MC-GICP, scales 8, 4, 2": ours(voxel, mcg.MultiChannelGICP(), 8, 4, 2),
        "NDT, scales 32 to 2": ours(voxel, mcg.NDT(), *cells),
        "D2D-NDT, scales 32 to 2": ours(voxel, mcg.D2DNDT(), *cells),
        "D2D-NDT, scale 12": ours(voxel, mcg.D2DNDT(), 12),
    }
    if importlib.util.find_spec("small_gicp"):
        solvers |= {f"small_gicp, {kind}": small_gicp(voxel, kind) for kind in ("GICP", "VGICP")}
    if importlib.util.find_spec("open3d"):
        solvers["Open3D, NDT"] = open3d_ndt(voxel)
    return solvers


def row(solver: Solver, pairs: list[Pair], voxel: float, starts: tuple[tuple[float, float], ...]) -> Iterator[str]:
    """For each start: number of poses found, their median error, and the time per pair."""
    solver(*pairs[0])
    for voxels, degrees in starts:
        generator, errors, started = np.random.default_rng(1), [], time.perf_counter()
        for source, target, truth in pairs:
            found = solver(source, target, displaced(generator, voxel * voxels, degrees) @ truth)
            error: Any = pose_error(found, truth)
            errors += [1e3 * float(error[0])] if error[0] < 2 * voxel and error[1] < FOUND else []
        spent = 1e3 * (time.perf_counter() - started) / len(pairs)
        middle = f"{statistics.median(errors):.0f}" if errors else "–"
        yield f"{len(errors)}, {middle}, {spent:.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", choices=list(SETS), default=list(SETS))
    parser.add_argument("--methods", nargs="*", default=[""], help="first words of their rows")
    arguments = parser.parse_args()
    for name in arguments.only:
        chosen = SETS[name]
        pairs = [(*map(without_colour_of_few, pair[:2]), pair[2]) for pair in chosen.pairs()]
        print(f"\n{name}: found of {len(pairs)} by the start's error; median error where found, mm; time per pair, ms")
        print(
            "| | "
            + " | ".join(f"{chosen.voxel * voxels:g} m, {degrees:g}°" for voxels, degrees in chosen.starts)
            + " |"
        )
        for label, solver in solvers_for(chosen.voxel).items():
            if not label.startswith(tuple(arguments.methods)):
                continue
            print(f"| {label} | " + " | ".join(row(solver, pairs, chosen.voxel, chosen.starts)) + " |", flush=True)


def without_colour_of_few(cloud: mcg.PointCloud) -> mcg.PointCloud:
    """Of the channels of a LiDAR scan the intensity alone: the camera sees a sixth of the points."""
    if "intensity" not in cloud.channel_names:
        return cloud
    column = cloud.channel_names.index("intensity")
    return mcg.PointCloud(cloud.points, np.asarray(cloud.channels)[:, [column]], channel_names=("intensity",))


if __name__ == "__main__":
    main()
