"""Share of starts from which the pose is found, against the start's error, for our methods and peers.

Run `python -m tests.benchmarks.starts`; see README.md. A pose is found if its errors are below a voxel of the coarsest
scale, here 0.5 m, and 2°. Peers that are not installed are left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import pathlib
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

import mcgicp_jax as mcg
from mcgicp_jax.metrics import pose_error

DATA = pathlib.Path(os.environ.get("MCGICP_DATA", pathlib.Path(__file__).parents[3] / "shared" / "data"))
# Metres and degrees.
STARTS = ((0.5, 5.0), (2.0, 10.0), (4.0, 20.0), (5.0, 30.0), (5.0, 40.0))
FOUND = (0.5, np.radians(2.0))
VOXEL = 0.25
# Coarse to fine, metres.
SCALES = (4.0, 2.0, 1.0, 0.5)

Pair: TypeAlias = tuple[mcg.PointCloud, mcg.PointCloud, np.ndarray]
Solver: TypeAlias = Callable[[mcg.PointCloud, mcg.PointCloud, np.ndarray], np.ndarray]


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


def ours(method: mcg.AbstractMethod, scales: tuple[float, ...] = ()) -> Solver:
    """Points are thinned to voxels, cells are made of all points; preprocessing counts."""

    def run(source: mcg.PointCloud, target: mcg.PointCloud, start: np.ndarray) -> np.ndarray:
        clouds = [
            cloud if name in method.needs_covariances else mcg.preprocess(cloud, VOXEL)
            for name, cloud in (("source", source), ("target", target))
        ]
        return np.asarray(mcg.register(*clouds, method, init=start, scales=scales).matrix)

    return run


def small_gicp(kind: str) -> Solver:
    import small_gicp as peer

    def run(source: mcg.PointCloud, target: mcg.PointCloud, start: np.ndarray) -> np.ndarray:
        points = [np.asarray(cloud.points, np.float64) for cloud in (target, source)]
        result = peer.align(
            *points,
            start,
            registration_type=kind,
            voxel_resolution=1.0,
            downsampling_resolution=VOXEL,
            max_correspondence_distance=2.5,
            num_threads=2,
        )
        return np.asarray(result.T_target_source)

    return run


def open3d_ndt() -> Solver:
    import open3d

    def run(source: mcg.PointCloud, target: mcg.PointCloud, start: np.ndarray) -> np.ndarray:
        clouds = []
        for cloud in (source, target):
            made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.asarray(cloud.points, np.float64)))
            clouds.append(made.voxel_down_sample(VOXEL))
        return np.asarray(open3d.pipelines.registration.registration_ndt(*clouds, 2.0, start).transformation)

    return run


def displaced(generator: np.random.Generator, metres: float, degrees: float) -> np.ndarray:
    """A motion of that length, mostly level, and that angle, mostly about the vertical."""
    shift, axis = generator.normal(size=3) * [1, 1, 0.1], generator.normal(size=3) * [0.2, 0.2, 1]
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    pose[:3, 3] = metres * shift / np.linalg.norm(shift)
    return pose


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", choices=["kitti", "lidar_pair"], default=["kitti", "lidar_pair"])
    sets = parser.parse_args().only
    solvers: dict[str, Solver] = {
        "GICP": ours(mcg.GICP()),
        "GICP, scales 1, 0.5": ours(mcg.GICP(), (1.0, 0.5)),
        "GICP, scales 2, 1, 0.5": ours(mcg.GICP(), (2.0, 1.0, 0.5)),
        "MC-GICP, scales 2, 1, 0.5": ours(mcg.MultiChannelGICP(), (2.0, 1.0, 0.5)),
        "NDT, scales 4 to 0.5": ours(mcg.NDT(), SCALES),
        "D2D-NDT, scales 4 to 0.5": ours(mcg.D2DNDT(), SCALES),
        "D2D-NDT, scale 0.5": ours(mcg.D2DNDT(), SCALES[-1:]),
    }
    if importlib.util.find_spec("small_gicp"):
        solvers |= {f"small_gicp, {kind}": small_gicp(kind) for kind in ("GICP", "VGICP")}
    if importlib.util.find_spec("open3d"):
        solvers["Open3D, NDT"] = open3d_ndt()
    for name in sets:
        pairs = list({"kitti": kitti, "lidar_pair": lidar_pair}[name]())
        pairs = [(*(only_intensity(cloud) for cloud in pair[:2]), pair[2]) for pair in pairs]
        print(f"\n{name}: found of {len(pairs)} by the start's error; median error where found, mm; time per pair, ms")
        print(f"{'':>28}", *(f"{metres:g} m, {degrees:g}°".rjust(12) for metres, degrees in STARTS))
        for label, solver in solvers.items():
            solver(*pairs[0][:2], pairs[0][2])
            cells = []
            for metres, degrees in STARTS:
                generator, errors, started = np.random.default_rng(1), [], time.perf_counter()
                for source, target, truth in pairs:
                    found = solver(source, target, displaced(generator, metres, degrees) @ truth)
                    error: Any = pose_error(found, truth)
                    errors += [1e3 * float(error[0])] if error[0] < FOUND[0] and error[1] < FOUND[1] else []
                spent = 1e3 * (time.perf_counter() - started) / len(pairs)
                middle = f"{statistics.median(errors):.0f}" if errors else "-"
                cells.append(f"{len(errors)} {middle} {spent:.0f}".rjust(12))
            print(f"{label:>28}", *cells, flush=True)


def only_intensity(cloud: mcg.PointCloud) -> mcg.PointCloud:
    column = cloud.channel_names.index("intensity")
    return mcg.PointCloud(cloud.points, np.asarray(cloud.channels)[:, [column]], channel_names=("intensity",))


if __name__ == "__main__":
    main()
