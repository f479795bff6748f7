"""What the commands share: methods by name, options, voxels chosen from the clouds, outcomes in words."""

from __future__ import annotations

import bisect
import errno
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
import tyro

import mcgicp_jax as mcg
from mcgicp_jax import plot
from mcgicp_jax._formats import READERS, WRITERS, by_suffix
from mcgicp_jax._methods import AbstractMethod
from mcgicp_jax._options import Options as Chosen
from mcgicp_jax._preprocess import check_preprocessing

MethodName: TypeAlias = Literal["mc-gicp", "gicp", "color-icp", "point-to-plane", "point-to-point"]
File: TypeAlias = Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
Numbers: TypeAlias = Annotated[tuple[float, ...], tyro.conf.arg(help_behavior_hint="(default: from the data)")]
Epsilon: TypeAlias = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="(default: 0.001)")]

VERSION = mcg.__version__
METHODS: dict[MethodName, type[AbstractMethod]] = {
    "mc-gicp": mcg.MultiChannelGICP,
    "gicp": mcg.GICP,
    "color-icp": mcg.ColorICP,
    "point-to-plane": mcg.PointToPlane,
    "point-to-point": mcg.PointToPoint,
}
_MOST_POINTS = 20_000
_VOXELS_PER_DISTANCE = 6
ADVICE = {
    mcg.Status.MAX_ITERATIONS: "the pose was still moving when the iterations ran out; "
    "try a larger --max-iterations, or --init with a pose nearer to the answer",
    mcg.Status.TOO_FEW_CORRESPONDENCES: "fewer than four points have a match; "
    "try --init with a pose at which the clouds overlap, or a larger --max-distance",
    mcg.Status.DEGENERATE: "nothing holds the pose in at least one direction; "
    "try clouds that show more of the scene, or mc-gicp if they have channels",
    mcg.Status.NON_FINITE: "the numbers overflowed; are the coordinates metres?",
}


@dataclass(frozen=True)
class Options:
    """How the clouds are prepared, matched and drawn.

    Attributes:
        voxel_size: Metres; the points of one voxel are averaged. auto: the smallest of 1, 1.5, 2, 3, 5, 7, 10, ...
            times a power of ten that leaves neither cloud more than 20,000 points; all points are kept if neither has
            more. off: all points are kept.
        max_distance: Metres; points further apart make no pair. auto: 6 voxel sizes; if all points are kept, 6 of such
            voxels as would leave at most half of the larger cloud.
        num_neighbors: Neighbours that the covariance of a point is computed from.
        max_iterations: Of finding matches and updating the pose.
        init: The pose to start from, T_target_source: a 4x4 matrix, or 12 numbers (KITTI) or 8 (TUM) in one row. The
            identity if not given.
        channel_covariance: For mc-gicp: one variance for all channels, or one for each; channel units squared.
        channel_weights: For mc-gicp and color-icp: one weight for all channels, or one for each; metres per channel
            unit.
        epsilon: For mc-gicp and gicp: variance across the surface relative to that within it.
        plot: Picture to draw of the clouds before and after, such as out.png.
    """

    voxel_size: float | Literal["auto", "off"] = "auto"
    max_distance: float | Literal["auto"] = "auto"
    num_neighbors: int = 20
    max_iterations: int = 64
    init: File = None
    channel_covariance: Numbers = ()
    channel_weights: Numbers = ()
    epsilon: Epsilon = None
    plot: File = None

    def check(self) -> None:
        """Raise `ValueError` or `OSError` for what no clouds would fit, before any is read."""
        check_preprocessing(None if isinstance(self.voxel_size, str) else self.voxel_size, self.num_neighbors)
        distance = None if self.max_distance == "auto" else self.max_distance
        mcg.MultiChannelGICP(**self.numbers())
        Chosen(max_distance=distance, max_iterations=self.max_iterations)
        check_outputs(picture=self.plot)

    def numbers(self) -> dict[str, Any]:
        """The methods' numbers that were given."""
        given: dict[str, Any] = {} if self.epsilon is None else {"epsilon": self.epsilon}
        for name in ("channel_covariance", "channel_weights"):
            if values := getattr(self, name):
                given[name] = values[0] if len(values) == 1 else values
        return given


def check_outputs(*files: Path | None, cloud: Path | None = None, picture: Path | None = None) -> None:
    """Raise `ValueError` or `OSError` for files that could not be written in the end, before the work is done."""
    for path in (*files, cloud, picture):
        if path is not None and path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if path is not None and not path.parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, f"{os.strerror(errno.ENOENT)}: {path.parent}", str(path))
    if cloud is not None:
        by_suffix(WRITERS, cloud)
    if picture is not None:
        plot.check_picture(picture)


def check_inputs(*clouds: Path) -> None:
    """The same for clouds that could not be read, before the first of them is."""
    for path in clouds:
        by_suffix(READERS, path)
        path.stat()


def scales(clouds: Sequence[mcg.PointCloud], options: Options) -> tuple[float | None, float]:
    """The voxel size, if any, and the largest distance of a pair, by the rules in the help; metres."""
    size, distance = options.voxel_size, options.max_distance
    largest = max(map(len, clouds))
    # Covariances cannot be averaged.
    few = largest <= _MOST_POINTS or any(cloud.covariances is not None for cloud in clouds)
    if size == "off" or (size == "auto" and few):
        return None, _VOXELS_PER_DISTANCE * round_voxel_size(clouds, largest // 2) if distance == "auto" else distance
    if size == "auto":
        size = round_voxel_size(clouds, _MOST_POINTS)
    return size, _VOXELS_PER_DISTANCE * size if distance == "auto" else distance


def round_voxel_size(clouds: Sequence[mcg.PointCloud], most: int) -> float:
    """The smallest of 1, 1.5, 2, 3, 5, 7, 10, ... times a power of ten that leaves each `most` points; metres."""
    finite = [np.asarray(cloud.points, np.float64)[np.isfinite(cloud.points).all(axis=1)] for cloud in clouds]
    extent = max((np.ptp(points, axis=0).max() for points in finite if len(points)), default=0.0)
    if extent == 0:
        return 1.0
    exponent = int(np.floor(np.log10(extent)))
    sizes = [float(f"{digits}e{exponent + i}") for i in range(-14, 1) for digits in (1, 1.5, 2, 3, 5, 7, 10)]

    def occupied(size: float) -> int:
        cells = [np.floor(points / size) for points in finite if len(points)]
        # Each voxel as one number, as distinct as it needs to be
        numbers = [(cell - cell.min(axis=0)).astype(np.int64) @ [1, 2**21, 2**42] for cell in cells]
        return max(len(np.unique(number)) for number in numbers)

    return sizes[bisect.bisect_left(sizes, -most, key=lambda size: -occupied(size))]


def with_channels(cloud: mcg.PointCloud, names: Sequence[str]) -> mcg.PointCloud:
    """The cloud with some of its channels."""
    missing = [name for name in names if name not in cloud.channel_names]
    if missing:
        raise ValueError(f"no channel {', '.join(missing)}; there are {listed(cloud.channel_names)}")
    columns = [cloud.channel_names.index(name) for name in names]
    return mcg.PointCloud(
        cloud.points,
        np.asarray(cloud.channels)[:, columns],
        channel_valid=None if cloud.channel_valid is None else np.asarray(cloud.channel_valid)[:, columns],
        covariances=cloud.covariances,
        channel_names=names,
    )


def weights_from(source: mcg.PointCloud, target: mcg.PointCloud) -> Any:
    """α from the data, as mc-gicp chooses it."""
    chosen: Any = mcg.MultiChannelGICP().resolve(source, target)
    return chosen.channel_weights


def listed(names: Sequence[str]) -> str:
    return ", ".join(names) if names else "no channels"


def described(method: AbstractMethod) -> str:
    shown = [name for name in ("channel_covariance", "channel_weights", "epsilon") if hasattr(method, name)]
    numbers = [(name, np.atleast_1d(getattr(method, name))) for name in shown]
    return "".join(f", {name} {' '.join(f'{value:.3g}' for value in values)}" for name, values in numbers)


def status_of(result: mcg.Registration) -> mcg.Status:
    return mcg.Status(int(np.asarray(result.status_code)))


def words(result: mcg.Registration) -> str:
    return status_of(result).name.lower().replace("_", " ")
