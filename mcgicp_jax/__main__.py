"""The command line: `mcgicp demo`, `mcgicp register SOURCE TARGET` and `mcgicp compare SOURCE TARGET`."""

from __future__ import annotations

import bisect
import os
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import jax
import numpy as np
import platformdirs
import tyro
from jaxtyping import Float

import mcgicp_jax as mcg
from mcgicp_jax import datasets, io, metrics, plot
from mcgicp_jax._methods import AbstractMethod

MethodName: TypeAlias = Literal["mc-gicp", "gicp", "color-icp", "point-to-plane", "point-to-point"]
Source: TypeAlias = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
Target: TypeAlias = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TARGET")]
File: TypeAlias = Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
Numbers: TypeAlias = Annotated[tuple[float, ...], tyro.conf.arg(help_behavior_hint="(default: from the data)")]
Epsilon: TypeAlias = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="(default: 0.001)")]

_METHODS: dict[MethodName, type[AbstractMethod]] = {
    "mc-gicp": mcg.MultiChannelGICP,
    "gicp": mcg.GICP,
    "color-icp": mcg.ColorICP,
    "point-to-plane": mcg.PointToPlane,
    "point-to-point": mcg.PointToPoint,
}
_MOST_POINTS = 20_000
_VOXELS_PER_DISTANCE = 6
_ADVICE = {
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

    def numbers(self) -> dict[str, Any]:
        """The methods' numbers that were given."""
        given: dict[str, Any] = {} if self.epsilon is None else {"epsilon": self.epsilon}
        for name in ("channel_covariance", "channel_weights"):
            if values := getattr(self, name):
                given[name] = values[0] if len(values) == 1 else values
        return given


class Pair:
    """Two clouds with their common channels, ready to register."""

    def __init__(self, source: Path, target: Path, options: Options):
        self.options = options
        self.start = np.eye(4) if options.init is None else _read_pose(options.init)
        self.whole = io.read(source), io.read(target)
        names = [cloud.channel_names for cloud in self.whole]
        self.channels = [name for name in names[0] if name in names[1]]
        self.difference = f"{source} has {_listed(names[0])}, {target} has {_listed(names[1])}"
        voxel_size, self.max_distance = _scales(self.whole, options)
        self.source, self.target = (
            _preprocess(path, cloud, self.channels, voxel_size, options.num_neighbors)
            for path, cloud in zip((source, target), self.whole, strict=True)
        )
        counts = [
            f"{len(c):,} of {len(whole):,}" for c, whole in zip((self.source, self.target), self.whole, strict=True)
        ]
        voxels = "all kept" if voxel_size is None else f"voxels of {voxel_size:g} m"
        print(f"points:    source {counts[0]}, target {counts[1]} ({voxels})")
        print(f"pairs:     up to {self.max_distance:g} m apart")
        print(f"channels:  {_listed(self.channels)}" + (f" ({self.difference})" if names[0] != names[1] else ""))

    def method(self, name: MethodName) -> AbstractMethod:
        """The method, with its numbers from the options or else from the data."""
        kind = _METHODS[name]
        if kind.uses_channels and not self.channels:
            raise ValueError(
                f"{name} needs channels in common, but {self.difference}; use gicp instead (--method gicp)"
            )
        fields = kind.__dataclass_fields__
        numbers = {field: value for field, value in self.options.numbers().items() if field in fields}
        if kind is mcg.ColorICP and not numbers:
            numbers = {"channel_weights": mcg.MultiChannelGICP().resolve(self.source, self.target).channel_weights}
        return kind(**numbers).resolve(self.source, self.target)

    def register(self, method: AbstractMethod) -> mcg.Registration:
        return mcg.register(
            self.source,
            self.target,
            method,
            init=self.start,
            max_distance=self.max_distance,
            max_iterations=self.options.max_iterations,
        )

    def draw(self, results: dict[MethodName, mcg.Registration]) -> None:
        if self.options.plot is not None:
            poses: dict[str, Any] = {"start": self.start, **{name: result.matrix for name, result in results.items()}}
            plot.before_after(*self.whole, poses, path=self.options.plot)
            print(f"picture:   {self.options.plot}")


def register(
    source: Source,
    target: Target,
    shared: Options,
    method: MethodName = "mc-gicp",
    output: File = None,
    aligned: File = None,
) -> int:
    """Find the pose T_target_source that moves SOURCE onto TARGET.

    Clouds are .ply, .pcd, .las, .laz, .bin (KITTI), .npy, .npz, .xyz, .txt or .csv files. The exit code is 0 only if
    the registration converged; output files are written in any case.

    Args:
        source: Cloud to move.
        target: Cloud that stays.
        method: mc-gicp and color-icp use channels (intensity, colours, ...), the others geometry alone.
        output: File for the pose: the upper three rows of its matrix, in one row (KITTI).
        aligned: File for the moved source cloud, all its points, such as out.ply.
    """
    unknown = shared.numbers().keys() - _METHODS[method].__dataclass_fields__.keys()
    if unknown:
        raise ValueError(f"{method} has no {' and no '.join(sorted(unknown))}")
    pair = Pair(source, target, shared)
    chosen = pair.method(method)
    print(f"method:    {method}{_described(chosen)}")
    result = pair.register(chosen)
    plural = "" if result.num_iterations == 1 else "s"
    print(f"status:    {_words(result)} after {result.num_iterations} iteration{plural}")
    print(f"inliers:   {result.num_inliers:,} of {len(pair.source):,}, rmse {result.rmse:.4g} m")
    print("T_target_source:")
    for row in result.matrix:
        print("".join(f"{number:16.8f}" for number in row))
    if output is not None:
        io.write_poses(output, [result.matrix])
    if aligned is not None:
        io.write(aligned, pair.whole[0].transform(result.matrix))
    pair.draw({method: result})
    return _verdict({method: result})


def compare(source: Source, target: Target, shared: Options, truth: File = None) -> int:
    """Register SOURCE to TARGET with every method, and print a table.

    Methods that use channels are left out where there are none. The exit code is 0 only if all others converged.

    Args:
        source: Cloud to move.
        target: Cloud that stays.
        truth: The true pose T_target_source, for the errors.
    """
    return _verdict(_compare(source, target, shared, truth))


def demo(output: Path = Path("mcgicp_demo")) -> int:
    """Register two views of a flat wall of posters, made up as a noisy RGB-D camera sees it, with every method.

    Args:
        output: Folder for the two clouds, the true pose and a picture.
    """
    output.mkdir(parents=True, exist_ok=True)
    target, source = datasets.poster_wall(2)
    source_file, target_file, truth_file = (output / name for name in ("source.npz", "target.npz", "truth.txt"))
    io.write(source_file, source.cloud)
    io.write(target_file, target.cloud)
    io.write_poses(truth_file, [np.linalg.inv(target.pose) @ source.pose])
    options = Options(voxel_size="off", max_distance=0.08, plot=output / "before_after.png")
    _compare(source_file, target_file, options, truth_file)
    print(
        "Geometry alone slides along the flat wall: gicp, point-to-plane and point-to-point may come to rest, but in"
        "\ntheir rows of the picture the posters do not fit. The channels red, green and blue hold the other two."
        f"\nThe clouds are in {output}; try: mcgicp register {source_file} {target_file}"
    )
    return 0


def _compare(source: Path, target: Path, options: Options, truth: Path | None) -> dict[MethodName, mcg.Registration]:
    pair = Pair(source, target, options)
    true_pose = None if truth is None else _read_pose(truth)
    results: dict[MethodName, mcg.Registration] = {}
    measures = "inliers      rmse, m" if true_pose is None else "error, mm   error, deg"
    print(f"\n{'method':15}  {measures:>22}  iterations  time, ms  status")
    if true_pose is not None:
        print(f"{'(start)':15}  {_errors(pair.start, true_pose)}")
    for name, kind in _METHODS.items():
        if kind.uses_channels and not pair.channels:
            print(f"{name:15}  left out, needs channels in common")
            continue
        method = pair.method(name)
        pair.register(method)
        begin = time.perf_counter()
        result = results[name] = pair.register(method)
        milliseconds = 1e3 * (time.perf_counter() - begin)
        values = f"{result.num_inliers:9,}  {result.rmse:11.4g}"
        if true_pose is not None:
            values = _errors(np.asarray(result.matrix), true_pose)
        print(f"{name:15}  {values}  {result.num_iterations:10}  {milliseconds:8.0f}  {_words(result)}")
    print("(time of a second call: without compiling, preparing the clouds, choosing numbers)\n")
    pair.draw(results)
    return results


def _errors(pose: Float[np.ndarray, "4 4"], true_pose: Float[np.ndarray, "4 4"]) -> str:
    translation, rotation = metrics.pose_error(pose, true_pose)
    return f"{1e3 * float(translation):9.2f}  {np.degrees(rotation):11.3f}"


def _read_pose(path: Path) -> Float[np.ndarray, "4 4"]:
    poses = io.read_poses(path)
    if len(poses) != 1:
        raise ValueError(f"{path}: expected one pose, got {len(poses)}")
    return poses[0]


def _preprocess(
    path: Path, cloud: mcg.PointCloud, channels: Sequence[str], voxel_size: float | None, num_neighbors: int
) -> mcg.PointCloud:
    values = np.asarray(cloud.channels)[:, [cloud.channel_names.index(name) for name in channels]]
    try:
        cloud = mcg.PointCloud(cloud.points, values, covariances=cloud.covariances, channel_names=channels)
        return mcg.preprocess(cloud, voxel_size, num_neighbors)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _scales(clouds: Sequence[mcg.PointCloud], options: Options) -> tuple[float | None, float]:
    """The voxel size, if any, and the largest distance of a pair, by the rules in the help; metres."""
    size, distance = options.voxel_size, options.max_distance
    largest = max(map(len, clouds))
    # Covariances cannot be averaged.
    few = largest <= _MOST_POINTS or any(cloud.covariances is not None for cloud in clouds)
    if size == "off" or (size == "auto" and few):
        return None, _VOXELS_PER_DISTANCE * _round_voxel_size(clouds, largest // 2) if distance == "auto" else distance
    if size == "auto":
        size = _round_voxel_size(clouds, _MOST_POINTS)
    return size, _VOXELS_PER_DISTANCE * size if distance == "auto" else distance


def _round_voxel_size(clouds: Sequence[mcg.PointCloud], most: int) -> float:
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


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) if names else "no channels"


def _described(method: AbstractMethod) -> str:
    shown = [name for name in ("channel_covariance", "channel_weights", "epsilon") if hasattr(method, name)]
    numbers = [(name, np.atleast_1d(getattr(method, name))) for name in shown]
    return "".join(f", {name} {' '.join(f'{value:.3g}' for value in values)}" for name, values in numbers)


def _status(result: mcg.Registration) -> mcg.Status:
    return mcg.Status(int(np.asarray(result.status_code)))


def _words(result: mcg.Registration) -> str:
    return _status(result).name.lower().replace("_", " ")


def _verdict(results: dict[MethodName, mcg.Registration]) -> int:
    """The exit code; what did not converge goes to stderr."""
    failed = {name: result for name, result in results.items() if not result.converged}
    for name, result in failed.items():
        advice = _ADVICE[_status(result)]
        print(f"mcgicp: {name} did not converge ({_words(result)}): {advice}", file=sys.stderr)
    return 1 if failed else 0


def _keep_compiled_programs() -> None:
    """So that a second run starts fast. A folder that the user gave JAX is taken; without one to write to, none."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        try:
            folder = platformdirs.user_cache_path("mcgicp_jax", ensure_exists=True)
        except OSError:
            return
        jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"mcgicp: {message}", file=sys.stderr)


def _explanation(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


def main(args: Sequence[str] | None = None) -> int:
    """Returns the exit code: 0, 1 if a registration did not converge, 2 if the input was wrong."""
    _keep_compiled_programs()
    commands: dict[str, Callable[..., int]] = {"demo": demo, "register": register, "compare": compare}
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        try:
            return tyro.extras.subcommand_cli_from_dict(
                commands,
                prog="mcgicp",
                description="Registration of point clouds with channels.",
                args=args,
                config=(tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone),
            )
        except (ValueError, OSError, ImportError) as error:
            print(f"mcgicp: {_explanation(error)}", file=sys.stderr)
            return 2


if __name__ == "__main__":
    sys.exit(main())
