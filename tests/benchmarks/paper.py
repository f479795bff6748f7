"""Table I of Servos & Waslander (2014): translation errors of consecutive frames of a street, its road, and KITTI.

    python -m tests.benchmarks.paper

As in the paper, unconstrained directions are not held at the initial pose: the identity, and on the road (points within
6 cm of the ground) 0.3 m ahead of the truth. Mean and standard deviation over all pairs, in mm, and how many CONVERGED.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax import datasets
from tests.benchmarks.accuracy import DATA, RGB, only

COMBINED = ("intensity", *RGB)
ROWS = {
    "Color ICP": RGB,
    "GICP": ("intensity",),
    "MC-GICP, intensity": ("intensity",),
    "MC-GICP, colour": RGB,
    "MC-GICP, combined": COMBINED,
}


def road(frames: Iterable[datasets.Frame]) -> Iterator[datasets.Frame]:
    for frame in frames:
        cloud, world = frame.cloud, np.asarray(frame.cloud.transform(frame.pose).points)
        keep = (np.abs(world[:, 2]) < 0.06) & (np.abs(world[:, 1]) < 6)
        keep &= np.linalg.norm(np.asarray(cloud.points), axis=1) < 25
        cloud = mcg.PointCloud(cloud.points[keep], cloud.channels[keep], channel_names=cloud.channel_names)
        yield datasets.Frame(cloud, frame.pose)


def method_of(name: str, source: mcg.PointCloud, target: mcg.PointCloud) -> mcg.AbstractMethod:
    if name == "GICP":
        return mcg.GICP()
    method = mcg.MultiChannelGICP().resolve(source, target)
    return mcg.ColorICP(method.channel_weights) if name == "Color ICP" else method


def errors_of(
    frames: Iterable[datasets.Frame], name: str, voxel_size: float, max_distance: tuple[float, float], ahead: float
) -> Iterator[tuple[float, bool]]:
    """Translation error in mm of each pair, and whether it CONVERGED."""
    prepared = ((mcg.preprocess(only(frame.cloud, ROWS[name]), voxel_size), frame.pose) for frame in frames)
    for (target, target_pose), (source, source_pose) in pairwise(prepared):
        truth = np.linalg.inv(target_pose) @ source_pose
        start = truth + ahead * np.eye(4, k=3) if ahead else np.eye(4)
        options = {"init": start, "max_distance": max_distance, "hold_unconstrained": False}
        result = mcg.register(source, target, method_of(name, source, target), **options)
        yield 1e3 * mcg.metrics.pose_error(result.matrix, truth)[0], result.converged


def main() -> None:
    street = list(datasets.street(50, points_per_frame=30_000))
    kitti = list(datasets.kitti(DATA / "kitti/sequences/04"))
    for title, frames, *options in (
        ("street", street, 0.2, (2.0, 0.5), 0.0),
        ("road", list(road(street)), 0.1, (0.6, 0.15), 0.3),
        ("KITTI 04", kitti, 0.25, (2.5, 0.6), 0.0),
    ):
        for name in ROWS:
            shifts, converged = np.array(list(errors_of(frames, name, *options))).T
            print(f"{title:10} {name:20} {shifts.mean():7.1f} ± {shifts.std():5.1f} mm", end="")
            print(f"  CONVERGED {converged.sum():.0f} of {len(shifts)}", flush=True)


if __name__ == "__main__":
    main()
