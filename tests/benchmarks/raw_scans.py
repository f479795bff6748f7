"""Errors of raw clouds with all defaults, beside those of the best voxel size chosen by hand, and of peers' defaults.

    python -m tests.benchmarks.raw_scans [--only kitti lidar ...] [--quick]

Nothing is chosen for a set: `register(source, target, method)` from the identity, on the bare road from 0.3 m ahead of
the truth. Each line has the largest and the median error of a set in mm, how many poses are CONVERGED but wrong (off by
more than 5 cm and 5 deviations), and the processor time that the choice of the voxel size adds, as a fraction of the
whole call. "by hand" has the errors in the voxels, of the sizes listed, whose median error is the smallest of the set;
a pair is good if its error is at most 1.3 times that of the same pair by hand, or below the noise of the truth.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax import datasets
from mcgicp_jax._clouds.voxel_size import voxels_for
from mcgicp_jax.metrics import pose_error
from tests.benchmarks.accuracy import DATA, Pair, pair_of, road, table
from tests.benchmarks.global_pose import desk, living_room

METHODS: dict[str, Callable[[], mcg.AbstractMethod]] = {
    "point-to-plane": mcg.PointToPlane,
    "GICP": mcg.GICP,
    "MC-GICP": mcg.MultiChannelGICP,
}
# A wrong pose: off by more than this, metres, and by more than so many deviations of its translation.
WRONG, WRONG_DEVIATIONS = 0.05, 5.0
# A good error: at most this multiple of the smallest by hand.
GOOD = 1.3


def apart(frames: Any, gaps: tuple[int, ...]) -> Iterator[Pair]:
    frames = list(frames)
    for gap in gaps:
        for i in range(len(frames) - gap):
            yield pair_of(frames[i + gap], frames[i])


def lidar(keep: Callable[[mcg.PointCloud], np.ndarray]) -> Iterator[Pair]:
    clouds = [mcg.io.read(DATA / "lidar_pair" / f"{name}.ply") for name in ("source", "target")]
    some = []
    for cloud in clouds:
        rows = keep(cloud)
        some.append(mcg.PointCloud(cloud.points[rows], cloud.channels[rows], channel_names=cloud.channel_names))
    yield Pair(*some, np.loadtxt(DATA / "lidar_pair" / "T_target_source.txt"), np.eye(4))


def every(k: int) -> Iterator[Pair]:
    yield from lidar(lambda cloud: np.arange(0, len(cloud), k))


def beams(k: int) -> Iterator[Pair]:
    """Every k-th of 128 bins of elevation, as a sensor with fewer beams would see."""

    def keep(cloud: mcg.PointCloud) -> np.ndarray:
        x, y, z = np.asarray(cloud.points, float).T
        elevation = np.arctan2(z, np.hypot(x, y))
        low, high = np.quantile(elevation, [0.001, 0.999])
        return np.flatnonzero(np.floor((elevation - low) / (high - low) * 128) % k == 0)

    yield from lidar(keep)


INDOOR = (0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4)
HANDHELD = (0.01, 0.014, 0.02, 0.028, 0.04, 0.056)
# Name: pairs, voxel sizes by hand and noise of the truth, metres.
SETS: dict[str, tuple[Callable[[], Iterator[Pair]], tuple[float, ...], float]] = {
    "kitti": (lambda: apart(datasets.kitti(DATA / "kitti/sequences/04"), (1, 2, 3)), (0.15, 0.25, 0.35, 0.5), 0.03),
    **{f"lidar, every {k}": (lambda k=k: every(k), INDOOR, 0.02) for k in (1, 2, 4, 8)},
    **{f"lidar, 1/{k} of beams": (lambda k=k: beams(k), INDOOR, 0.02) for k in (2, 4, 8)},
    "7-scenes": (lambda: apart(datasets.seven_scenes(DATA / "sevenscenes_redkitchen"), (1, 2)), HANDHELD, 0.004),
    "tum": (lambda: apart(desk(), (1,)), HANDHELD, 0.01),
    "living room": (lambda: apart(living_room(), (1,)), HANDHELD, 0.0),
    "table": (lambda: table(""), HANDHELD, 0.004),
    "table, flat": (lambda: table("_flat"), HANDHELD, 0.004),
    "kitti, bare road": (road, (0.2,), 0.03),
}


def registered(pair: Pair, method: mcg.AbstractMethod, size: Any) -> tuple[float, str, bool]:
    """Error in metres, status, and whether it is CONVERGED but wrong; all defaults without a voxel size."""
    source, target = pair.source, pair.target
    if size is not None:
        source, target = (mcg.preprocess(cloud, size) for cloud in (source, target))
    result = mcg.register(source, target, method, init=pair.start)
    error = pose_error(result.matrix, pair.truth)[0] if np.isfinite(result.matrix).all() else np.inf
    deviation = float(np.linalg.norm(np.asarray(result.deviations)[:3])) if result.converged else np.inf
    return error, result.status.name, bool(result.converged and error > max(WRONG, WRONG_DEVIATIONS * deviation))


def small_gicp(pair: Pair, kind: str) -> tuple[float, str]:
    import small_gicp as peer

    points = [np.asarray(cloud.points, np.float64) for cloud in (pair.target, pair.source)]
    result = peer.align(*points, pair.start, registration_type=kind, num_threads=2)
    return pose_error(result.T_target_source, pair.truth)[0], "CONVERGED" if result.converged else "no"


def report(name: str, method: str, errors: list[float], wrong: int, converged: int, others: str = "") -> Counter[str]:
    """Prints a line and returns its counts."""
    count = len(errors)
    millimetres = 1e3 * np.array(errors)
    print(
        f"{name:20} {method:16} {np.median(millimetres):7.1f} {millimetres.max():8.1f} mm"
        f"  wrong {wrong}/{count}  converged {converged}/{count}{others}",
        flush=True,
    )
    return Counter(pairs=count, converged=converged, wrong=wrong)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=list(SETS))
    parser.add_argument("--quick", action="store_true", help="without voxel sizes by hand and peers")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    totals: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for name in (name for name in SETS if any(name.startswith(part) for part in options.only)):
        pairs, sizes, noise = SETS[name]
        pairs = list(pairs())
        for method_name, method in METHODS.items():
            errors, wrong, converged, fractions = [], 0, 0, []
            for pair in pairs:
                registered(pair, method(), None)
                voxels = voxels_for("auto", pair.source, pair.target)
                begin = time.process_time()
                registered(pair, method(), voxels)
                middle = time.process_time()
                error, status, bad = registered(pair, method(), None)
                fractions.append(1 - (middle - begin) / (time.process_time() - middle))
                errors.append(error)
                wrong, converged = wrong + bad, converged + (status == "CONVERGED")
            others = f"  choice {np.median(fractions):.0%} of the time  {voxels}"
            if not options.quick:
                by_size = {size: [registered(pair, method(), size) for pair in pairs] for size in sizes}
                size = min(sizes, key=lambda size: np.median([error for error, *_ in by_size[size]]))
                hand = np.array([error for error, *_ in by_size[size]])
                good = int(np.sum(np.array(errors) <= np.maximum(GOOD * hand, noise)))
                by_hand = f"{1e3 * np.median(hand):.1f} {1e3 * hand.max():.1f} in {size} m"
                by_hand += f" (wrong {sum(bad for *_, bad in by_size[size])})"
                others = f"  by hand {by_hand}  good {good}/{len(pairs)}{others}"
            totals[method_name].update(report(name, method_name, errors, wrong, converged, others))
        if not options.quick:
            for kind in ("GICP", "PLANE_ICP"):
                found = [small_gicp(pair, kind) for pair in pairs]
                errors = [error for error, _ in found]
                converged = sum(status == "CONVERGED" for _, status in found)
                wrong = sum(error > WRONG and status == "CONVERGED" for error, status in found)
                label = f"small_gicp {kind[:5]}"
                totals[label].update(report(name, label, errors, wrong, converged))
    for method_name, total in totals.items():
        print(f"all sets: {method_name:16}", ", ".join(f"{what} {count}" for what, count in total.items()))


if __name__ == "__main__":
    main()
