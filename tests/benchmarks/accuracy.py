"""Translation errors in mm on real and simulated pairs with known truth: every method with its defaults, and Open3D.

    python -m tests.benchmarks.accuracy [--only flat recorded ...] [--methods MC-GICP ...] [--space lab]

All start from the identity (the road: 0.3 m ahead of the truth) on the same downsampled clouds. Our methods have
default settings, except that Color ICP gets the α that MC-GICP chooses. Open3D's colored ICP has documented settings:
λ 0.968, normals from 30 neighbours. At three scales it has voxels of 4, 2 and 1 times the size and a max_distance of
twice that; at one scale a max_distance of ten voxels, as large as ours.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import pathlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax import datasets
from mcgicp_jax.datasets import _poster_wall as posters
from mcgicp_jax.datasets._frames import bilinear, scene_and_path_rng
from tests.benchmarks.global_pose import desk, living_room

try:
    import open3d
except ImportError:
    open3d = None

DATA = pathlib.Path(os.environ.get("MCGICP_DATA", pathlib.Path(__file__).parents[3] / "shared" / "data"))
RGB = ("red", "green", "blue")
SPACES: dict[str, Callable[..., Any]] = {"lab": mcg.rgb_to_lab, "hsv": mcg.rgb_to_hsv, "yuv": mcg.rgb_to_yuv}
STEPS = (0.01, 0.02, 0.03, 0.04, 0.05)


@dataclass(frozen=True)
class Pair:
    source: mcg.PointCloud
    target: mcg.PointCloud
    truth: np.ndarray
    start: np.ndarray


def pair_of(source: Any, target: Any) -> Pair:
    return Pair(source.cloud, target.cloud, np.linalg.inv(target.pose) @ source.pose, np.eye(4))


def table(suffix: str) -> Iterator[Pair]:
    for path in sorted((DATA / "planar_table").glob("pair_*.npz")):
        arrays = np.load(path)
        clouds = []
        for side in ("source", "target"):
            colors = arrays[f"{side}_rgb"].astype(np.float32)
            colors = colors / 255 if arrays[f"{side}_rgb"].dtype == np.uint8 else colors
            clouds.append(mcg.PointCloud(arrays[f"{side}_points{suffix}"], colors, channel_names=RGB))
        yield Pair(*clouds, arrays["T_target_source"], np.eye(4))


def consecutive(frames: Any) -> Iterator[Pair]:
    for i in range(len(frames) - 1):
        yield pair_of(frames[i + 1], frames[i])


def kitti(names: tuple[str, ...]) -> Iterator[Pair]:
    for pair in consecutive(datasets.kitti(DATA / "kitti/sequences/04")):
        yield Pair(only(pair.source, names), only(pair.target, names), pair.truth, pair.start)


def only(cloud: mcg.PointCloud, names: tuple[str, ...]) -> mcg.PointCloud:
    columns = [cloud.channel_names.index(name) for name in names]
    mask = None if cloud.channel_valid is None else np.asarray(cloud.channel_valid)[:, columns]
    return mcg.PointCloud(cloud.points, np.asarray(cloud.channels)[:, columns], channel_valid=mask, channel_names=names)


def road() -> Iterator[Pair]:
    ahead = np.eye(4)
    ahead[0, 3] = 0.3
    for pair in kitti(("intensity",)):
        yield Pair(ground(pair.source), ground(pair.target), pair.truth, ahead @ pair.truth)


def ground(cloud: mcg.PointCloud) -> mcg.PointCloud:
    """Points within 25 m, 6 m to the sides, and 6 cm of the ground plane, which is found by sampling planes."""
    points = np.asarray(cloud.points, float)
    near = (np.hypot(*points[:, :2].T) < 25) & (np.abs(points[:, 1]) < 6) & (points[:, 2] < -1)
    low, rng = points[near], np.random.default_rng(0)
    best = np.zeros(len(low), bool)
    for _ in range(300):
        a, b, c = low[rng.choice(len(low), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        normal /= max(np.linalg.norm(normal), 1e-12)
        inside = np.abs((low - a) @ normal) < 0.05
        if abs(normal[2]) > 0.95 and inside.sum() > best.sum():
            best = inside
    center = low[best].mean(axis=0)
    normal = np.linalg.svd(low[best] - center, full_matrices=False)[2][2]
    kept = near & (np.abs((points - center) @ normal) < 0.06)
    return mcg.PointCloud(points[kept], np.asarray(cloud.channels)[kept], channel_names=cloud.channel_names)


def wall(gain: float) -> Iterator[Pair]:
    for seed in range(20):
        target, source = datasets.poster_wall(2, step=STEPS[seed % len(STEPS)], seed=seed)
        pair = pair_of(source, target)
        dark = pair.source.replace(channels=np.asarray(pair.source.channels) * gain)
        yield Pair(dark, pair.target, pair.truth, pair.start)


def converted(cloud: mcg.PointCloud, space: Callable[..., Any] | None) -> mcg.PointCloud:
    """The cloud with its colours in another space."""
    return cloud if space is None else cloud.replace(channels=space(np.asarray(cloud.channels)))


# Name: pairs, voxel size in metres, further arguments of `register`.
SETS: dict[str, tuple[Callable[[], Iterator[Pair]], float | None, dict[str, Any]]] = {
    "flat": (lambda: table("_flat"), 0.01, {}),
    "recorded": (lambda: table(""), 0.01, {}),
    "7-scenes": (lambda: consecutive(datasets.seven_scenes(DATA / "sevenscenes_redkitchen")), 0.03, {}),
    "living room": (lambda: consecutive(living_room()), 0.03, {}),
    "tum": (lambda: consecutive(desk()), 0.03, {}),
    "posters": (lambda: wall(1.0), None, {}),
    "posters, 20 % darker": (lambda: wall(0.8), None, {"equalize_channels": True}),
    "kitti, intensity": (lambda: kitti(("intensity",)), 0.25, {}),
    "kitti, intensity + rgb": (lambda: kitti(("intensity", *RGB)), 0.25, {}),
    "kitti road": (road, 0.1, {}),
}


def ours(method: Callable[..., Any], settings: dict[str, Any]) -> Callable[..., np.ndarray]:
    def run(source: mcg.PointCloud, target: mcg.PointCloud, start: np.ndarray, _: Any) -> np.ndarray:
        return mcg.register(source, target, method(source, target), init=start, **settings).matrix

    return run


def cells(method: Callable[..., Any]) -> Callable[..., np.ndarray]:
    """With cells of 16, 8 and 4 voxels."""

    def run(source: mcg.PointCloud, target: mcg.PointCloud, start: np.ndarray, voxel: float) -> np.ndarray:
        scales = tuple(times * voxel for times in (16, 8, 4))
        return mcg.register(source, target, method(source, target), init=start, voxel_sizes=scales).matrix

    return run


def color_ndt(source: mcg.PointCloud, target: mcg.PointCloud) -> Any:
    return mcg.ColorNDT(mcg.MultiChannelGICP().resolve(source, target).channel_weights)


def color_icp(source: mcg.PointCloud, target: mcg.PointCloud) -> Any:
    return mcg.ColorICP(mcg.MultiChannelGICP().resolve(source, target).channel_weights)


def colored_icp(scales: tuple[int, ...]) -> Callable[..., np.ndarray]:
    def run(source: mcg.PointCloud, target: mcg.PointCloud, start: np.ndarray, voxel: float) -> np.ndarray:
        registration = open3d.pipelines.registration
        clouds = [
            as_open3d(cloud.unpad()) if isinstance(cloud, mcg.PointCloud) else cloud for cloud in (source, target)
        ]
        for scale in scales:
            pair = [cloud.voxel_down_sample(scale * voxel) if scale > 1 else cloud for cloud in clouds]
            for cloud in pair:
                cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(30))
            # Open3D raises if it finds no matches; keep the pose then.
            with contextlib.suppress(RuntimeError):
                start = registration.registration_colored_icp(
                    *pair,
                    2 * scale * voxel if len(scales) > 1 else 10 * voxel,
                    start,
                    registration.TransformationEstimationForColoredICP(),
                    registration.ICPConvergenceCriteria(1e-6, 1e-6, 50),
                ).transformation
        return np.asarray(start)

    return run


def as_open3d(cloud: mcg.PointCloud) -> Any:
    result = open3d.geometry.PointCloud()
    result.points = open3d.utility.Vector3dVector(np.asarray(cloud.points, float))
    colors = np.asarray(cloud.channels, float)[:, -3:]
    colors = colors if colors.shape[1] == 3 else np.repeat(colors[:, :1], 3, axis=1)
    result.colors = open3d.utility.Vector3dVector(colors)
    return result


def cramer_rao(seed: int, blur: float) -> float:
    """Lower bound in metres of the rms translation error of an unbiased estimate, from the depth noise across the wall
    and the colour noise along it in both frames, if the picture on the wall is known down to details of `blur` metres.
    """
    target = datasets.poster_wall(2, step=STEPS[seed % len(STEPS)], seed=seed)[1]
    picture = posters._paint_wall(scene_and_path_rng(seed)[0])
    rays = np.asarray(target.cloud.points, float)
    depth = rays[:, 2]
    arms = rays @ target.pose[:3, :3].T
    hits = (arms + target.pose[:3, 3])[:, :2]
    slopes = []
    for axis in np.eye(2):
        places = [(hits + sign * blur / 2 * axis) / posters._TEXEL for sign in (1, -1)]
        ends = [bilinear(picture, place, "grid-wrap") for place in places]
        slopes.append((ends[0] - ends[1]) / blur)
    rows = np.concatenate([np.eye(3)[None].repeat(len(arms), 0), -cross(arms)], axis=2)
    color = np.einsum("anc,nad->ncd", np.array(slopes), rows[:, :2]) / (np.sqrt(2) * posters._COLOR_NOISE)
    across = rows[:, 2] / (np.sqrt(2) * (0.0012 + 0.0019 * (depth - 0.4) ** 2))[:, None]
    information = np.einsum("ncd,nce->de", color, color) + across.T @ across
    return float(np.sqrt(np.trace(np.linalg.inv(information)[:3, :3])))


def cross(vectors: np.ndarray) -> np.ndarray:
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", choices=SETS, default=list(SETS))
    parser.add_argument("--methods", nargs="*", help="such as MC-GICP; by default all")
    parser.add_argument("--space", choices=SPACES, help="colour space to convert the channels to")
    arguments = parser.parse_args()
    chosen, space = arguments.only, SPACES.get(arguments.space)
    print(
        "|                    set | pairs |               method |   mean |    rms | median |    max |\n"
        + "|---:" * 7
        + "|"
    )
    for name in chosen:
        make, voxel, settings = SETS[name]
        pairs = [
            (
                *(mcg.preprocess(converted(cloud, space), voxel) for cloud in (pair.source, pair.target)),
                pair.truth,
                pair.start,
            )
            for pair in make()
        ]
        spacing = voxel or 0.013
        methods: dict[str, Callable[..., np.ndarray]] = {
            "MC-GICP": ours(lambda *_: mcg.MultiChannelGICP(), settings),
            "MC-GICP, photometric": ours(lambda *_: mcg.MultiChannelGICP(photometric=True), settings),
            "GICP": ours(lambda *_: mcg.GICP(), {}),
            "Color ICP": ours(color_icp, settings),
            "NDT": cells(lambda *_: mcg.NDT()),
            "colour NDT": cells(color_ndt),
            "D2D-NDT": cells(lambda *_: mcg.D2DNDT()),
        }
        if open3d is not None:
            methods |= {"Open3D, one scale": colored_icp((1,)), "Open3D, three scales": colored_icp((4, 2, 1))}
        for label in arguments.methods or methods:
            run = methods[label]
            errors = 1e3 * np.array(
                [mcg.metrics.pose_error(run(s, t, start, spacing), truth)[0] for s, t, truth, start in pairs]
            )
            numbers = errors.mean(), np.sqrt(np.mean(errors**2)), np.median(errors), errors.max()
            print(
                f"| {name:>22} | {len(pairs):5} | {label:>20} | " + " | ".join(f"{n:6.2f}" for n in numbers) + " |",
                flush=True,
            )
        if name == "posters":
            for blur in (2 * posters._TEXEL, spacing):
                bounds = [1e3 * cramer_rao(seed, blur) for seed in range(len(pairs))]
                print(
                    f"Cramér-Rao bound, details from {1e3 * blur:.0f} mm: rms {np.sqrt(np.mean(np.square(bounds))):.3f}"
                )


if __name__ == "__main__":
    main()
