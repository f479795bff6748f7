"""Poses found from any start: `global_pose` and peers. Whether they are a success: see `global_pose_verdicts`.

    python -m tests.benchmarks.global_pose [--only kitti rgbd parts flat]

The source is moved away: LiDAR scans by a yaw and 10 m, RGB-D frames by any rotation and 10 m, flat surfaces by any
rotation within the plane and 0.5 m. A pose is found if `register` (MC-GICP, or GICP without channels) ends within a
voxel and 2° of the truth when it starts there. All methods have voxels of one size, ours. Peers get normals that point
to the sensor, with Open3D's usual radii: 2 voxels for normals, 5 for FPFH, matches within 1.5. Those that are not
installed are left out.
"""

from __future__ import annotations

import argparse
import itertools
import os
import pathlib
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import mcgicp_jax as mcg
from mcgicp_jax import datasets
from mcgicp_jax.metrics import pose_error

try:
    import open3d
except (ImportError, OSError):
    open3d = None
try:
    import kiss_matcher
except ImportError:
    kiss_matcher = None

DATA = pathlib.Path(os.environ.get("MCGICP_DATA", pathlib.Path(__file__).parents[3] / "shared" / "data"))
RGB = ("red", "green", "blue")


class Pair(NamedTuple):
    """The moved source, the target, the true pose, and where the sensor of the source is."""

    name: str
    source: mcg.PointCloud
    target: mcg.PointCloud
    truth: np.ndarray
    sensor: np.ndarray


def moved(name: str, source: Any, target: Any, away: np.ndarray) -> Pair:
    truth = np.linalg.inv(target.pose) @ source.pose @ np.linalg.inv(away)
    return Pair(name, source.cloud.transform(away), target.cloud, truth, away[:3, 3])


def displaced(generator: np.random.Generator, rotation: Any, distance: float) -> np.ndarray:
    shift, pose = generator.normal(size=3), np.eye(4)
    pose[:3, :3] = rotation.as_matrix()
    pose[:3, 3] = distance * shift / np.linalg.norm(shift)
    return pose


def all_gaps(name: str, frames: list[Any], level: bool) -> Iterator[Pair]:
    generator = np.random.default_rng(1)
    for gap in range(1, len(frames)):
        for target, source in zip(frames, frames[gap:], strict=False):
            yaw = Rotation.from_euler("z", generator.uniform(-np.pi, np.pi))
            rotation = yaw if level else Rotation.random(random_state=generator)
            yield moved(f"{name}, gap {gap}", source, target, displaced(generator, rotation, 10.0))


def colored(points: np.ndarray, colors: np.ndarray) -> mcg.PointCloud:
    colors = colors.astype(np.float32) / (255 if colors.dtype == np.uint8 else 1)
    return mcg.PointCloud(points.astype(np.float32), colors, channel_names=RGB)


def living_room() -> list[Any]:
    folder = DATA / "icl_livingroom1"
    arrays = (np.load(path) for path in sorted(folder.glob("*.npz")))
    clouds = [colored(each["points"], each["rgb"]) for each in arrays]
    poses = mcg.io.read_poses(folder / "poses.txt")
    return [datasets.Frame(cloud, pose) for cloud, pose in zip(clouds, poses, strict=False)]


def desk() -> list[Any]:
    """The pair of TUM fr1/xyz, whose files have no lists."""
    from mcgicp_jax.datasets._frames import read_depth, read_image

    frames, camera = [], (517.3, 516.5, 318.6, 255.3)
    for name in ("prev", "curr"):
        depth = read_depth(DATA / "tum_fr1_xyz" / f"dep_{name}.png")
        numbers = np.loadtxt(DATA / "tum_fr1_xyz" / f"pose_{name}.txt").ravel()[-7:]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat(numbers[3:]).as_matrix(), numbers[:3]
        image = read_image(DATA / "tum_fr1_xyz" / f"img_{name}.png")
        frames.append(datasets.Frame(mcg.PointCloud.from_depth(depth, camera, image, scale=5000), pose))
    return frames


def kitchen() -> list[Any]:
    return list(datasets.seven_scenes(DATA / "sevenscenes_redkitchen"))


def kitti() -> Iterator[Pair]:
    yield from all_gaps("KITTI", list(datasets.kitti(DATA / "kitti" / "sequences" / "04")), level=True)
    folder = DATA / "lidar_pair"
    clouds = [mcg.io.read(folder / f"{name}.ply") for name in ("target", "source")]
    frames = [
        datasets.Frame(clouds[0], np.eye(4)),
        datasets.Frame(clouds[1], np.loadtxt(folder / "T_target_source.txt")),
    ]
    yield from all_gaps("lidar_pair", frames, level=True)


def rgbd() -> Iterator[Pair]:
    for name, frames in (("7-Scenes", kitchen()), ("living room", living_room()), ("TUM", desk())):
        yield from all_gaps(name, frames, level=False)


def parts() -> Iterator[Pair]:
    """The left 60 % of the source's view and the right 60 % of the target's, at all gaps."""
    generator = np.random.default_rng(3)
    for name, frames in (("7-Scenes", kitchen()), ("living room", living_room()), ("TUM", desk())):
        for target, source in itertools.combinations(frames, 2):
            cut = [
                datasets.Frame(part(frame.cloud, *shares), frame.pose)
                for frame, shares in ((source, (0, 60)), (target, (40, 100)))
            ]
            yield moved(f"{name}, parts", *cut, displaced(generator, Rotation.random(random_state=generator), 10.0))


def part(cloud: mcg.PointCloud, first: float, last: float) -> mcg.PointCloud:
    """The points between two percentiles of the view, from left to right."""
    slope = cloud.coordinates[:, 0] / cloud.coordinates[:, 2]
    low, high = np.percentile(slope, [first, last])
    kept = (slope >= low) & (slope <= high)
    valid = None if cloud.channel_valid is None else cloud.channel_valid[kept]
    return mcg.PointCloud(cloud.coordinates[kept], cloud.channels[kept], channel_valid=valid)


def flat() -> Iterator[Pair]:
    generator = np.random.default_rng(2)
    for path in sorted((DATA / "planar_table").glob("pair_*.npz")):
        arrays = np.load(path)
        clouds = [colored(arrays[f"{side}_points_flat"], arrays[f"{side}_rgb"]) for side in ("source", "target")]
        frames = [datasets.Frame(clouds[0], arrays["T_target_source"]), datasets.Frame(clouds[1], np.eye(4))]
        for _ in range(3):
            yield moved("flat table", *frames, within_plane(generator, clouds[0]))
    for seed in range(20):
        target, source = datasets.poster_wall(2, step=0.01 * (1 + seed % 5), seed=seed)
        yield moved("poster wall", source, target, within_plane(generator, source.cloud))


def within_plane(generator: np.random.Generator, cloud: mcg.PointCloud) -> np.ndarray:
    """A rotation about the normal of the cloud, through its centroid, and 0.5 m within its plane."""
    center = np.mean(cloud.coordinates, axis=0)
    first, second, normal = np.linalg.svd(cloud.coordinates - center, full_matrices=False)[2]
    rotation = Rotation.from_rotvec(generator.uniform(-np.pi, np.pi) * normal).as_matrix()
    angle, pose = generator.uniform(-np.pi, np.pi), np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = center - rotation @ center + 0.5 * (np.cos(angle) * first + np.sin(angle) * second)
    return pose


def bare(cloud: mcg.PointCloud) -> mcg.PointCloud:
    return mcg.PointCloud(cloud.coordinates)


# Solvers map a pair and a voxel size to the start, and whether it calls itself a success.
Solver = Callable[[Pair, float], tuple[np.ndarray, bool]]


def ours(pair: Pair, voxel_size: float) -> tuple[np.ndarray, bool]:
    result = mcg.global_pose(pair.source, pair.target)
    return result.matrix, result.success


def ours_without_channels(pair: Pair, voxel_size: float) -> tuple[np.ndarray, bool]:
    return ours(pair._replace(source=bare(pair.source), target=bare(pair.target)), voxel_size)


def kiss(pair: Pair, voxel_size: float) -> tuple[np.ndarray, bool]:
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_size))
    result = matcher.estimate(*(cloud.coordinates.astype(np.float32) for cloud in (pair.source, pair.target)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = result.rotation, np.ravel(result.translation)
    return pose, bool(result.valid)


def described(cloud: mcg.PointCloud, sensor: np.ndarray, voxel_size: float) -> tuple[Any, Any]:
    made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.coordinates)).voxel_down_sample(voxel_size)
    search = open3d.geometry.KDTreeSearchParamHybrid
    made.estimate_normals(search(2 * voxel_size, 30))
    made.orient_normals_towards_camera_location(sensor)
    return made, open3d.pipelines.registration.compute_fpfh_feature(made, search(5 * voxel_size, 100))


def by_open3d(kind: str) -> Solver:
    def solve(pair: Pair, voxel_size: float) -> tuple[np.ndarray, bool]:
        registration = open3d.pipelines.registration
        (source, a), (target, b) = (
            described(pair.source, pair.sensor, voxel_size),
            described(pair.target, np.zeros(3), voxel_size),
        )
        if kind == "FGR":
            option = registration.FastGlobalRegistrationOption(maximum_correspondence_distance=1.5 * voxel_size)
            result = registration.registration_fgr_based_on_feature_matching(source, target, a, b, option)
        else:
            result = registration.registration_ransac_based_on_feature_matching(
                *(source, target, a, b, True, 1.5 * voxel_size),
                registration.TransformationEstimationPointToPoint(False),
                3,
                [
                    registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                    registration.CorrespondenceCheckerBasedOnDistance(1.5 * voxel_size),
                ],
                registration.RANSACConvergenceCriteria(100_000, 0.999),
            )
        return np.asarray(result.transformation), True

    return solve


def solvers() -> dict[str, Solver]:
    found: dict[str, Solver] = {"ours": ours, "without channels": ours_without_channels}
    if open3d is not None:
        found |= {"RANSAC": by_open3d("RANSAC"), "FGR": by_open3d("FGR")}
    if kiss_matcher is not None:
        found["KISS-Matcher"] = kiss
    return found


def is_found(pair: Pair, start: np.ndarray, voxel_size: float, channels: bool) -> bool:
    """Whether registration ends at the truth."""
    clouds = [cloud if channels else bare(cloud) for cloud in (pair.source, pair.target)]
    prepared = [mcg.preprocess(cloud, voxel_size) for cloud in clouds]
    method = mcg.MultiChannelGICP() if channels else mcg.GICP()
    try:
        result = mcg.register(*prepared, method, init=start)
    except ValueError:
        # Not a rigid motion.
        return False
    center = np.mean(pair.source.coordinates, axis=0)
    translation, rotation = pose_error(result.matrix, pair.truth, at=center)
    return bool(translation < voxel_size and rotation < np.radians(2))


def compare(pairs: Iterator[Pair]) -> None:
    everyone = solvers()
    counts: dict[str, dict[str, list[Any]]] = {}
    for number, pair in enumerate(pairs):
        size = mcg.global_pose(pair.source, pair.target).voxel_size
        row = counts.setdefault(pair.name, {name: [] for name in everyone})
        for name, solver in everyone.items():
            if number == 0:
                solver(pair, size)
            begin = time.perf_counter()
            start, claimed = solver(pair, size)
            spent = time.perf_counter() - begin
            found = is_found(pair, start, size, channels=name != "without channels")
            row[name].append((found, claimed, spent))
    print(f"{'found, claimed, s':>18}", *(name.rjust(22) for name in everyone))
    for label, row in counts.items():
        cells = []
        for results in row.values():
            found, claimed = sum(each[0] for each in results), sum(each[0] and each[1] for each in results)
            spent = statistics.median(each[2] for each in results)
            cells.append(f"{found} of {len(results)}, {claimed}, {spent:.2f}".rjust(22))
        print(f"{label:>18}", *cells, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    sets = {"kitti": kitti, "rgbd": rgbd, "parts": parts, "flat": flat}
    parser.add_argument("--only", nargs="*", choices=sets, default=sets)
    for name in parser.parse_args().only:
        compare(sets[name]())


if __name__ == "__main__":
    main()
