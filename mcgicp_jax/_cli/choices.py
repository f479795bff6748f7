"""What the options leave open and the clouds decide: channels, voxels, the method and its parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax._cli.options import MethodName, Options
from mcgicp_jax._clouds.color_spaces import COLOR_SPACES
from mcgicp_jax._clouds.columns import COLORS
from mcgicp_jax._clouds.point_cloud import Voxels
from mcgicp_jax._clouds.voxel_size import voxels_for
from mcgicp_jax._local_geometry.cloud_statistics import point_spacing
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._registration.settings import default_distances
from mcgicp_jax.extend import METHODS

# Preprocessed source and target, made when they are needed.
Ready: TypeAlias = Callable[[], tuple[mcg.PointCloud, mcg.PointCloud]]


@dataclass(frozen=True)
class Choices:
    """The user's options, the names of the channels to use, and the voxels in which raw clouds are averaged."""

    options: Options
    channels: tuple[str, ...]
    voxels: Voxels

    @classmethod
    def of(cls, options: Options, *clouds: mcg.PointCloud) -> Choices:
        """The choices for raw clouds, of which the first two decide on the channels."""
        common = [name for name in clouds[0].channel_names if all(name in each.channel_names for each in clouds[:2])]
        voxels = voxels_for(None if options.voxel_size == "off" else options.voxel_size, *clouds)
        return cls(options, options.channels or tuple(common), voxels)

    def method_name(self, given: MethodName | None, clouds: Mapping[str, mcg.PointCloud]) -> MethodName:
        """The method that the user gave or else suits the channels, which are printed."""
        name = given or ("mc-gicp" if self.channels else "gicp")
        if METHODS[name].kind.uses_channels and not self.channels:
            raise ValueError(
                f"{name} needs channels in common, but {_having(clouds)}; use gicp instead (--method gicp)"
            )
        self.options.check(name)
        self.print_channels(clouds, "" if given or self.channels else " in common, therefore gicp")
        return name

    def print_channels(self, clouds: Mapping[str, mcg.PointCloud], words: str = "") -> None:
        """Print the channels that are used, and those of each cloud if these differ."""
        differ = not self.options.channels and len({cloud.channel_names for cloud in clouds.values()}) > 1
        print(f"channels:  {listed(self.channels)}{words}{f' ({_having(clouds)})' if differ else ''}")

    def preprocess(self, cloud: mcg.PointCloud) -> mcg.PointCloud:
        """A raw cloud with the chosen channels, ready to register."""
        # Where the user asks for all points, `preprocess` warns of neighbourhoods that do not span the surface.
        voxels = None if self.options.voxel_size == "off" else self.voxels
        return mcg.preprocess(with_channels(cloud, self.channels), voxels, self.options.num_neighbors)

    def method(self, name: MethodName, ready: Ready) -> AbstractMethod:
        """The method with the user's parameters; Color ICP's weights, if not given, come from the data."""
        given = self.options.parameters_of(name)
        if issubclass(METHODS[name].kind, mcg.ColorICP) and not given:
            # As mc-gicp chooses them.
            resolved: Any = mcg.MultiChannelGICP().resolve(*ready())
            given["channel_weights"] = resolved.channel_weights
        return METHODS[name](**given)

    def arguments(self, name: MethodName, ready: Ready) -> dict[str, Any]:
        """Keyword arguments of `mcgicp_jax.register`; sizes of cells, if not given, come from the target."""
        arguments = self.options.registration()
        if METHODS[name].kind.needs_covariances and not self.options.voxel_sizes:
            _, target = ready()
            spacing = float(point_spacing(target))
            # With 8 spacings, a cell has some tens of points.
            arguments["voxel_sizes"] = tuple(float(f"{times * spacing:.2g}") for times in (32, 16, 8))
        return arguments


def distance_in_words(options: Options, target: mcg.PointCloud) -> str:
    """`max_distance` in words."""
    distances = options.max_distance or default_distances(point_spacing(target), target)
    return " m, then ".join(f"{float(distance):.3g}" for distance in distances) + " m"


def _having(clouds: Mapping[str, mcg.PointCloud]) -> str:
    return ", ".join(f"{name} has {listed(cloud.channel_names)}" for name, cloud in clouds.items())


def with_channels(cloud: mcg.PointCloud, names: Sequence[str]) -> mcg.PointCloud:
    """The cloud with only the named channels, in this order; a colour space is computed from red, green and blue."""
    needed = [name for each in names for name in (COLORS if each in COLOR_SPACES else (each,))]
    missing = [name for name in dict.fromkeys(needed) if name not in cloud.channel_names]
    if missing:
        raise ValueError(f"no channel {', '.join(missing)}; there are {listed(cloud.channel_names)}")
    columns = [cloud.channel_names.index(name) for name in needed]
    channels, measured, chosen = np.asarray(cloud.channels)[:, columns], cloud.channel_valid, list[str]()
    measured = None if measured is None else np.asarray(measured)[:, columns]
    for name in names:
        three = slice(len(chosen), len(chosen) + len(COLORS))
        if name in COLOR_SPACES:
            channels[:, three] = COLOR_SPACES[name](channels[:, three])
            if measured is not None:
                measured[:, three] = measured[:, three].all(axis=1, keepdims=True)
        chosen += [f"{name}_{i}" for i in range(len(COLORS))] if name in COLOR_SPACES else [name]
    return mcg.PointCloud(
        cloud.points, channels, channel_valid=measured, covariances=cloud.covariances, channel_names=chosen
    ).replace_rows(times=cloud.times)


def listed(names: Sequence[str]) -> str:
    return ", ".join(names) if names else "no channels"
