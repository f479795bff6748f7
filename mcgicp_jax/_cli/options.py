"""Options that the commands share, their names in messages, and checks of files."""

from __future__ import annotations

import contextlib
import errno
import inspect
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from fnmatch import fnmatch
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

import numpy as np
import tyro

import mcgicp_jax as mcg
from mcgicp_jax import datasets, plot
from mcgicp_jax._clouds.preprocess import check_preprocessing
from mcgicp_jax._compute.messages import check_integer, check_positive, messages_named
from mcgicp_jax._registration.options import ROTATION_TOLERANCE
from mcgicp_jax._registration.options import Options as RegistrationOptions
from mcgicp_jax.extend import COLOR_SPACES, FORMATS, KERNELS, METHODS
from mcgicp_jax.io.clouds import format_of, is_cloud
from mcgicp_jax.io.text import read_text

Documented = TypeVar("Documented")


def shown(metavar: str | None = None, default: str = "") -> Any:
    """How the help shows an option: its value, and what applies without it."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=default and f"(default: {default})")


File: TypeAlias = Annotated[Path | None, shown("FILE")]
# For a `Literal | None`, tyro would list the choices in random order, and None among them.
_METHOD = tyro.constructors.PrimitiveConstructorSpec[str | None](
    nargs=1,
    metavar=f"{{{','.join(METHODS)}}}",
    instance_from_str=lambda words: words[0],
    is_instance=lambda value: value is None or value in METHODS,
    str_from_instance=lambda value: [str(value)],
    choices=tuple(METHODS),
)
Method: TypeAlias = Annotated[str | None, _METHOD, shown(default="mc-gicp; gicp for clouds without common channels")]
Numbers: TypeAlias = Annotated[tuple[float, ...], shown(default="from the data")]


def _kernel(words: list[str]) -> tuple[str, float]:
    with contextlib.suppress(ValueError):
        name, scale = words
        if name in KERNELS:
            return name, float(scale)
    expected = f"{enumerated(list(KERNELS), 'or')}, and a scale, such as huber 1.0"
    raise ValueError(f"expected {expected}; got {' '.join(words)}")


_KERNEL = tyro.constructors.PrimitiveConstructorSpec[tuple[str, float] | None](
    nargs=(1, 2),
    metavar="KERNEL SCALE",
    instance_from_str=_kernel,
    is_instance=lambda value: value is None or isinstance(value, tuple),
    str_from_instance=lambda value: [str(value)],
)
_DEFAULT = inspect.signature(mcg.GICP).parameters["epsilon"].default
_EPSILON = f"{_DEFAULT}; mc-gicp: from the noise, unless --channel-covariance is given"
# Suffixes of clouds that are not text; a text file, such as poses, has none of these.
_BINARY = {suffix for suffix, cloud_format in FORMATS.items() if cloud_format.read is not read_text}
# Largest number of files that a message lists.
_MOST_NAMES = 5
# Parameters of methods for which there is an option.
PARAMETERS = ("channel_covariance", "channel_weights", "epsilon")
# Values of arguments in messages.
_VALUE = r'\([\d., ]+\)|"\w+"|[\d.]*\d|True|N'
# Not within paths, also those of files such as max_distance=(1, 0.2).npz.
_ARGUMENT = re.compile(rf"(?<![\w./-])([a-z_]+)(?:=({_VALUE})(?!:))?(?![\w/=-]|\.\w)")


def enumerated(names: Sequence[str], last: str = "and") -> str:
    return f" {last} ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def with_names(documented: Documented, **others: str) -> Documented:
    """Fill `others` and the names in the registries into the help text of a command or of its options."""
    kinds = {name: method.kind for name, method in METHODS.items()}
    documented.__doc__ = (documented.__doc__ or "").format(
        formats=enumerated(list(FORMATS), "or"),
        spaces=enumerated(list(COLOR_SPACES), "or"),
        kernels=enumerated(list(KERNELS), "or"),
        channel_methods=enumerated([name for name, kind in kinds.items() if kind.uses_channels]),
        cell_methods=enumerated([name for name, kind in kinds.items() if kind.needs_covariances]),
        **{
            parameter: enumerated([name for name, kind in kinds.items() if parameter in kind.__dataclass_fields__])
            for parameter in PARAMETERS
        },
        **others,
    )
    return documented


@with_names
@dataclass(frozen=True)
class Options:
    """Options of preprocessing and registration.

    Attributes:
        channels: Channels to use, such as intensity, or red green blue, or {spaces} computed from these three. By
            default those that the first two clouds have in common.
        voxel_size: Metres; the points of each voxel are averaged. auto: from the clouds (odometry: the first two,
            batch: each pair), the smallest size at which few neighbourhoods are lines or noise and at most 40,000
            voxels remain. off: all points are kept.
        num_neighbors: Number of neighbours from which the covariance of a point is computed.
        max_distance: Metres; largest distance between matched points. Two numbers: one to find the pose, and a smaller
            one to refine it.
        max_iterations: Largest number of pose updates.
        translation_tolerance: Metres; registration has converged once an update is below both tolerances.
        rotation_tolerance: Radians.
        robust: Robust kernel ({kernels}) and its scale in units of the Mahalanobis distance, such as huber 1.0.
        hold_unconstrained: Keep the initial pose in directions that neither geometry nor channels constrain.
        equalize_channels: Scale and shift the channels of the source to the distribution of those of the target.
        voxel_sizes: Voxel sizes in metres, coarse to fine, at which to register first if the initial pose is far off.
            For {cell_methods} the sizes of the cells; by default 32, 16 and 8 times the spacing of the points.
        max_source_points: Largest number of points of the source that are matched, evenly spread.
        channel_covariance: For {channel_covariance}: one variance for all channels, or one for each; channel units
            squared.
        channel_weights: For {channel_weights}: one weight for all channels, or one for each; metres per channel unit.
        epsilon: For {epsilon}: variance along the normal relative to that within the surface.
        columns: Number of float32 values of each point of .bin files, the first of which are x, y, z and intensity.
    """

    channels: Annotated[tuple[str, ...], shown("NAMES", "all in common")] = ()
    voxel_size: float | Literal["auto", "off"] = "auto"
    num_neighbors: int = 20
    max_distance: Annotated[tuple[float, ...], shown(default="10 spacings or more, then 2.5 spacings")] = ()
    max_iterations: int = RegistrationOptions.max_iterations
    translation_tolerance: Annotated[float | None, shown("FLOAT", "0.005 spacings")] = None
    rotation_tolerance: float = ROTATION_TOLERANCE
    robust: Annotated[tuple[str, float] | None, _KERNEL, shown(default="none")] = None
    hold_unconstrained: bool = True
    equalize_channels: bool = False
    voxel_sizes: Annotated[tuple[float, ...], shown(default="none")] = ()
    max_source_points: int | Literal["all"] | None = RegistrationOptions.max_source_points
    channel_covariance: Numbers = ()
    channel_weights: Numbers = ()
    epsilon: Annotated[float | None, shown("FLOAT", _EPSILON)] = None
    columns: Annotated[int | None, shown("INT", "recognised")] = None

    def check(self, method: str | None = None) -> None:
        """Raise `ValueError` or `OSError` for invalid options, or parameters that the method lacks; reads no cloud."""
        if self.columns is not None:
            check_integer("columns", self.columns, 3)
        if not isinstance(self.voxel_size, str):
            check_positive("voxel_size", self.voxel_size, "a positive number, auto or off")
        check_preprocessing(None, self.num_neighbors)
        parameters = self.parameters()
        mcg.MultiChannelGICP(**parameters)
        RegistrationOptions(**self.registration())
        if unknown := parameters.keys() - self.parameters(method).keys():
            raise ValueError(f"{method} has no {' and no '.join(sorted(unknown))}")

    def parameters(self, method: str | None = None) -> dict[str, Any]:
        """The user's parameters of methods; with a method, only those that it has."""
        parameters = {}
        for name in PARAMETERS:
            value = getattr(self, name)
            applies = method is None or name in METHODS[method].kind.__dataclass_fields__
            if applies and value not in (None, ()):
                parameters[name] = value[0] if np.shape(value) == (1,) else value
        return parameters

    def registration(self) -> dict[str, Any]:
        """Keyword arguments of `mcgicp_jax.register`."""
        if len(self.max_distance) > 2:
            raise ValueError(f"max_distance: expected one or two numbers, got {self.max_distance}")
        names = [field.name for field in fields(RegistrationOptions) if hasattr(self, field.name)]
        options = {name: getattr(self, name) for name in names if name != "max_distance"}
        options["max_source_points"] = None if self.max_source_points == "all" else self.max_source_points
        if self.max_distance:
            options["max_distance"] = self.max_distance if len(self.max_distance) == 2 else self.max_distance[0]
        if self.robust is not None:
            name, scale = self.robust
            with messages_named("robust"):
                options["robust"] = KERNELS[name](scale)
        return options


@dataclass(frozen=True)
class PairOptions(Options):
    """Options for one pair of clouds.

    Attributes:
        init: File with the initial pose T_target_source: a 4x4 matrix, or 12 numbers (KITTI) or 8 (TUM) on one line. By
            default the identity. global: the pose is found from any start by local features.
        fix: Directions in which the pose stays the initial one: along and about the axes of the source.
            For a planar motion, z roll pitch.
        plot: File for a picture of the clouds before and after registration, such as out.png.
    """

    init: Annotated[Literal["global"] | Path | None, shown("{FILE,global}")] = None
    # Repeated options add up.
    fix: Annotated[
        tuple[tuple[Literal["x", "y", "z", "roll", "pitch", "yaw"], ...], ...],
        tyro.conf.UseAppendAction,
        shown(default="none"),
    ] = ()
    plot: File = None


def check_outputs(
    *files: Path | None, cloud: Path | None = None, picture: Path | None = None, inputs: Sequence[Path] = ()
) -> None:
    """Raise for outputs that cannot or must not be written. `files` are texts. `inputs` are clouds, which `cloud` may
    not replace, or folders, in which it may not be."""
    for path in files:
        # Whether an existing text file is a cloud depends on its content.
        if path is not None and (path.suffix.lower() in _BINARY or (path.is_file() and is_cloud(path))):
            raise ValueError(f"{path}: expected a text file, such as poses.txt, instead of a cloud")
    for path in inputs:
        if cloud is not None and cloud.resolve().is_relative_to(path.resolve()):
            raise ValueError(f"{cloud}: expected a file outside of the input, {path}")
    written = [path for path in (*files, cloud, picture) if path is not None]
    if len({path.resolve() for path in written}) < len(written):
        raise ValueError(f"output: expected a file for each output, got {', '.join(map(str, written))}")
    for path in written:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not path.parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, f"the folder {path.parent} does not exist", str(path))
    if cloud is not None:
        format_of(cloud)
    if picture is not None:
        plot.check_picture(picture)


def clouds_in(folder: Path, glob: str = "*", map: File = None, columns: int | None = None) -> datasets.CloudFiles:
    """The clouds of a folder; `map`, a file that the command writes, may not be among them."""
    if map is not None and map.resolve().parent == folder.resolve() and fnmatch(map.name, glob):
        raise ValueError(f"{map}: expected a map outside of {folder}, where it would be one of the clouds")
    files = datasets.clouds(folder, glob, columns=columns)
    if len(files) < 2:
        raise ValueError(f"{folder}: expected at least 2 clouds, found {len(files)} among {glob!r}")
    if files.left_out:
        names = [path.name for path in files.left_out]
        more = f" and {len(names) - _MOST_NAMES:,} more" if len(names) > _MOST_NAMES else ""
        print(f"left out:  {', '.join(names[:_MOST_NAMES])}{more} (not clouds)")
    return files


def with_flags(message: str, args: Sequence[str] = ()) -> str:
    """The message with arguments of Python, such as max_distance=(1, 0.2), as options of the command line; also the
    name with which it begins, if that is an option among `args`."""
    name, *rest = message.split(": ", maxsplit=1)
    option = f"--{name.replace('_', '-')}"
    if any(argument.split("=")[0] == option for argument in args):
        message = ": ".join([option, *rest])

    def flag(match: re.Match[str]) -> str:
        name, value = match.groups("")
        # Some names are words, too.
        if name not in {*PairOptions.__dataclass_fields__, "recover"} or not (value or "_" in name):
            return match[0]
        value = re.sub(r'[(),"]|True', "", value)
        return f"--{name.replace('_', '-')} {value}".rstrip()

    return _ARGUMENT.sub(flag, message)
