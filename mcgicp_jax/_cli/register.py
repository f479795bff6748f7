"""`mcgicp register SOURCE TARGET`, `mcgicp compare SOURCE TARGET` and `mcgicp demo`."""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
import tyro
from jaxtyping import Float

import mcgicp_jax as mcg
from mcgicp_jax import datasets, io, metrics, plot
from mcgicp_jax._cli import options as cli
from mcgicp_jax._cli.choices import Choices, with_channels
from mcgicp_jax._compute.messages import warn, warnings_named
from mcgicp_jax._compute.threads import side_by_side
from mcgicp_jax._local_geometry.cloud_statistics import point_spacing
from mcgicp_jax._methods.surfaces import resolved
from mcgicp_jax._pairs.register import doubt_of_global_pose
from mcgicp_jax._pose_solver.degeneracy import as_text
from mcgicp_jax._registration.options import Options as RegistrationOptions
from mcgicp_jax._registration.register_pair import prepared, rows_to_match
from mcgicp_jax._registration.result import verified
from mcgicp_jax._registration.settings import default_distances
from mcgicp_jax.extend import METHODS, AbstractMethod
from mcgicp_jax.io.clouds import format_of

Source: TypeAlias = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
Target: TypeAlias = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TARGET")]

# The components of ξ, for --fix.
_DIRECTIONS = ("x", "y", "z", "roll", "pitch", "yaw")
# Variance of the directions that --fix leaves free, metres² or radians²: far above what any cloud leaves unknown.
_UNKNOWN = 1e12
# Methods of the demo: two that use geometry alone, two that use channels. Each compiles for seconds.
_DEMO = ("point-to-plane", "gicp", "color-icp", "mc-gicp")


class PreparedPair:
    """Two preprocessed clouds with the channels that they have in common."""

    def __init__(self, source: Path, target: Path, options: cli.PairOptions):
        # Raise for unknown formats and missing files before any work is done.
        for path in (source, target):
            format_of(path)
            path.stat()
        self.options = options
        self.start = np.eye(4) if options.init in (None, "global") else _read_pose("init", Path(options.init))
        self.verified = True
        read = partial(io.read, columns=options.columns)
        self.raw = read(source), read(target)
        names = str(source), str(target)
        self.choices = Choices(options, names, self.raw)
        self.preprocessed = self.choices.preprocessed
        in_source, in_target = (f"{len(self.preprocessed[side]):,} of {len(self.raw[side]):,}" for side in (0, 1))
        print(f"points:    source {in_source}, target {in_target} ({self.choices.voxels})")

    def print_distances(self) -> None:
        target = self.preprocessed[1]
        distances = self.options.max_distance or default_distances(point_spacing(target), target)
        print(f"matches:   up to {' m, then '.join(f'{float(distance):.3g}' for distance in distances)} m apart")

    def find_start(self) -> None:
        if self.options.init != "global":
            return
        result = mcg.global_pose(*(with_channels(cloud, self.choices.channels) for cloud in self.raw))
        if not result.num_inliers:
            raise ValueError(doubt_of_global_pose(result))
        verdict = "found" if result.success else "ambiguous" if result.ambiguous else "unsure"
        print(f"start:     {verdict}, {result.num_inliers:,} of {result.num_matches:,} features match")
        self.start, self.verified = result.matrix, result.success
        if not result.success:
            warn(doubt_of_global_pose(result))

    def method(self, name: str) -> AbstractMethod:
        """The method with parameters from the options, or else from the data as in `mcgicp_jax.register`."""
        options = RegistrationOptions(max_source_points=self.options.registration()["max_source_points"])
        source, target = self.preprocessed
        pair = prepared(source, target, self.choices.method(name), options)
        return resolved(pair.method, pair.source, pair.target, rows_to_match(pair.source, options))

    def errors(self, pose: Float[np.ndarray, "4 4"], true_pose: Float[np.ndarray, "4 4"]) -> str:
        """Translation error in mm at the centroid of the source, and rotation error in degrees, as two columns."""
        centroid = np.asarray(self.preprocessed[0].unpad().points, np.float64).mean(axis=0)
        translation, rotation = metrics.pose_error(pose, true_pose, at=centroid)
        return f"{1e3 * float(translation):9.2f}  {np.degrees(rotation):11.3f}"

    def register(self, name: str, method: AbstractMethod) -> mcg.RegistrationResult:
        # Cells are made of all points.
        source, target = self.preprocessed
        if "source" in method.needs_covariances:
            source = with_channels(self.raw[0], self.choices.channels)
        if "target" in method.needs_covariances:
            target = with_channels(self.raw[1], self.choices.channels)
        init = None if self.options.init is None else self.start
        return verified(mcg.register(source, target, method, init=init, **self.arguments(name)), self.verified)

    def arguments(self, name: str) -> dict[str, Any]:
        arguments = self.choices.arguments(name)
        if self.options.fix:
            variances = np.where(np.isin(_DIRECTIONS, sum(self.options.fix, ())), 0, _UNKNOWN)
            arguments["prior"] = self.start, np.diag(variances)
        return arguments

    def draw(self, results: dict[str, mcg.RegistrationResult]) -> None:
        if self.options.plot is not None:
            poses: dict[str, Any] = {name: result.matrix for name, result in results.items()}
            if self.options.init != "global":
                poses = {"start": self.start, **poses}
            plot.before_after(*self.raw, poses, path=self.options.plot)
            print(f"picture:   {self.options.plot}")


@cli.with_names
def register(
    source: Source,
    target: Target,
    shared: cli.PairOptions,
    method: cli.Method = None,
    output: cli.File = None,
    aligned: cli.File = None,
) -> int:
    """Estimate the pose T_target_source that moves SOURCE onto TARGET.

    Clouds are {formats} files. The exit code is 0 only if the registration converged; output files are written in any
    case, unless --init global finds no pose.

    Args:
        source: Cloud to move.
        target: Cloud that stays.
        method: {channel_methods} use channels (intensity, colours, ...), the others geometry alone.
        output: File for the pose in KITTI format: the upper three rows of its matrix on one line.
        aligned: File for the whole source cloud moved by the pose, such as out.ply.
    """
    shared.check(method)
    cli.check_outputs(output, cloud=aligned, picture=shared.plot, inputs=(source, target))
    pair = PreparedPair(source, target, shared)
    name = pair.choices.method_name(method)
    pair.find_start()
    resolved_method = pair.method(name)
    print(f"method:    {name}", end="")
    for parameter in cli.PARAMETERS:
        if hasattr(resolved_method, parameter):
            values = np.atleast_1d(getattr(resolved_method, parameter))
            print(f", {parameter} {' '.join(f'{value:.3g}' for value in values)}", end="")
    print()
    if resolved_method.needs_covariances:
        print(f"cells:     of {', '.join(f'{size:g}' for size in pair.arguments(name)['voxel_sizes'])} m")
    else:
        pair.print_distances()
    result = pair.register(name, resolved_method)
    plural = "" if result.num_iterations == 1 else "s"
    print(f"status:    {result.status.name} after {result.num_iterations} iteration{plural}")
    rmse = f", rmse {result.rmse:.4g} m" if result.num_inliers else ""
    print(f"inliers:   {result.num_inliers:,} ({result.overlap:.0%} of the points used){rmse}")
    if result.converged and np.all(np.isfinite(result.deviations)):
        x, y, z, *angles = result.deviations
        roll, pitch, yaw = np.degrees(angles)
        print(f"deviation: x {x:.2g}, y {y:.2g}, z {z:.2g} m; about x {roll:.2g}, y {pitch:.2g}, z {yaw:.2g} degrees")
    if result.unconstrained_directions:
        print(f"unconstr.: {as_text(result.unconstrained_directions)}")
    print("T_target_source:")
    # At UTM coordinates, 1e-8 in a rotation entry moves a point by centimetres.
    form = "22.14f" if np.any(pair.preprocessed[0].origin) else "15.8f"
    for row in result.matrix:
        print("".join(f" {number:{form}}" for number in row))

    if output is not None:
        io.write_poses(output, [result.matrix])
        print(f"pose:      {output}")
    if aligned is not None:
        io.write(aligned, pair.raw[0].transform(result.matrix))
        print(f"aligned:   {aligned}")
    pair.draw({name: result})
    return _verdict({name: result})


def compare(source: Source, target: Target, shared: cli.PairOptions, truth: cli.File = None) -> int:
    """Register SOURCE to TARGET with every method and print a table.

    Methods that use channels are skipped if the clouds have none in common. The exit code is 0 only if all methods that
    ran converged.

    Args:
        source: Cloud to move.
        target: Cloud that stays.
        truth: File with the true pose T_target_source, to print errors: of the position of the centroid of SOURCE, and
            of the rotation.
    """
    shared.check()
    return _verdict(_compare(source, target, shared, truth))


def demo(output: Path = Path("mcgicp_demo"), *, all_methods: bool = False) -> int:
    """Register two simulated views of a flat wall of posters by a noisy RGB-D camera.

    Args:
        output: Folder for the two clouds, the true pose and a picture.
        all_methods: Register with every method; by default with four of them.
    """
    output.mkdir(parents=True, exist_ok=True)
    frames = datasets.poster_wall(2)
    target, source = frames
    source_file, target_file, truth_file = (output / name for name in ("source.npz", "target.npz", "truth.txt"))
    io.write(source_file, source.cloud)
    io.write(target_file, target.cloud)
    io.write_poses(truth_file, [np.linalg.inv(frames.path(0)) @ frames.path(1)])
    options = cli.PairOptions(plot=output / "before_after.png")
    names = tuple(METHODS) if all_methods else _DEMO
    _compare(source_file, target_file, options, truth_file, names)
    channel_methods = cli.enumerated([name for name in names if METHODS[name].kind.uses_channels])
    print(
        "Geometry does not constrain motion along a flat wall: methods that use it alone report it (DEGENERATE) and"
        "\nkeep the initial pose along it, so in their rows of the picture the posters do not fit."
        f"\n{channel_methods} are constrained by the channels red, green and blue."
        f"\nThe clouds are in {output}; try: mcgicp register {source_file} {target_file}"
    )
    return 0


def _compare(
    source: Path, target: Path, options: cli.PairOptions, truth: Path | None, names: Sequence[str] = tuple(METHODS)
) -> dict[str, mcg.RegistrationResult]:
    cli.check_outputs(picture=options.plot)
    true_pose = None if truth is None else _read_pose("truth", truth)
    pair = PreparedPair(source, target, options)
    pair.print_distances()
    pair.choices.print_channels()
    pair.find_start()
    results: dict[str, mcg.RegistrationResult] = {}
    measures = "inliers      rmse, m" if true_pose is None else "error, mm   error, deg"
    width = max(map(len, names))
    print(f"\n{'method':{width}}  {measures:>22}  iterations  time, ms  status")
    if true_pose is not None:
        print(f"{'(start)':{width}}  {pair.errors(pair.start, true_pose)}")
    methods, reasons = _compiled(pair, names)
    for name in names:
        if name not in methods:
            print(f"{name:{width}}  left out: {reasons.get(name, 'no channels in common')}")
            continue
        # The first call has warned.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pair.register(name, methods[name])
            begin = time.perf_counter()
            result = results[name] = pair.register(name, methods[name])
        milliseconds = 1e3 * (time.perf_counter() - begin)
        values = f"{result.num_inliers:9,}  {result.rmse:11.4g}"
        if true_pose is not None:
            values = pair.errors(np.asarray(result.matrix), true_pose)
        print(f"{name:{width}}  {values}  {result.num_iterations:10}  {milliseconds:8.0f}  {result.status.name}")
    print("(times do not include compilation, preprocessing and the choice of parameters)\n")
    pair.draw(results)
    return results


def _compiled(pair: PreparedPair, names: Sequence[str]) -> tuple[dict[str, AbstractMethod], dict[str, str]]:
    """The methods, each run once to compile its programs; and why others are left out."""
    methods: dict[str, AbstractMethod] = {}
    reasons: dict[str, str] = {}

    def run(uses_channels: bool) -> None:
        for name in names:
            if METHODS[name].kind.uses_channels == uses_channels:
                method = pair.method(name)
                # Clouds may have too few points for cells.
                try:
                    with warnings_named(name):
                        pair.register(name, method)
                    methods[name] = method
                except ValueError as error:
                    reasons[name] = str(error)

    # Methods with and without channels share no programs.
    groups = [True, False] if pair.choices.channels else [False]
    side_by_side([partial(run, uses_channels) for uses_channels in groups])
    if not methods:
        raise ValueError("; ".join(f"{name}: {reason}" for name, reason in reasons.items()))
    return methods, reasons


def _verdict(results: dict[str, mcg.RegistrationResult]) -> int:
    """Print to stderr which methods did not converge, and return the exit code."""
    failed: dict[mcg.Status, list[str]] = {}
    for name, result in results.items():
        if not result.converged:
            failed.setdefault(result.status, []).append(name)
    for status, names in failed.items():
        print(f"mcgicp: {', '.join(names)}: {status.name}: {cli.with_flags(status.advice)}", file=sys.stderr)
    return 1 if failed else 0


def _read_pose(option: str, path: Path) -> Float[np.ndarray, "4 4"]:
    if not path.is_file():
        alternative = ", or global" if option == "init" else ""
        raise ValueError(f"--{option}: expected a file with a pose{alternative}; {path} is no file")
    poses = io.read_poses(path)
    if len(poses) != 1:
        raise ValueError(f"{path}: expected one pose, got {len(poses)}")
    return poses[0]
