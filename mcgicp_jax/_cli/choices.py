"""Defaults that depend on the clouds: channels, voxels, the method and its parameters."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax._cli.options import Options
from mcgicp_jax._clouds.columns import COLORS
from mcgicp_jax._clouds.point_cloud import Voxels
from mcgicp_jax._clouds.voxel_size import voxels_for
from mcgicp_jax._compute.messages import messages_named
from mcgicp_jax._local_geometry.cloud_statistics import point_spacing
from mcgicp_jax.extend import COLOR_SPACES, METHODS, AbstractMethod


class Choices:
    """The user's options, completed from the raw clouds; messages call the first two of these by `names`.

    Of these two, row `target` is the target and the other one the source; a single cloud is both.
    """

    def __init__(self, options: Options, names: Sequence[str], clouds: Sequence[mcg.PointCloud], target: int = 1):
        self.options, self.names, self.clouds, self.target = options, names, clouds[:2], target
        common = [name for name in clouds[0].channel_names if all(name in cloud.channel_names for cloud in self.clouds)]
        self.channels = options.channels or tuple(common)
        self.voxels: Voxels = voxels_for(None if options.voxel_size == "off" else options.voxel_size, *clouds)

    def method_name(self, method: str | None) -> str:
        """The method of the options, or else one that suits the channels; prints the channels."""
        name = method or ("mc-gicp" if self.channels else "gicp")
        if METHODS[name].kind.uses_channels and not self.channels:
            raise ValueError(
                f"{name} needs channels in common, but {self._channels_of_each()}; use gicp instead (--method gicp)"
            )
        self.options.check(name)
        self.print_channels("" if method or self.channels else " in common, therefore gicp")
        return name

    def print_channels(self, consequence: str = "") -> None:
        differ = not self.options.channels and len({cloud.channel_names for cloud in self.clouds}) > 1
        details = f" ({self._channels_of_each()})" if differ else ""
        print(f"channels:  {listed(self.channels)}{consequence}{details}")

    def _channels_of_each(self) -> str:
        # Both may be the same file.
        by_name = dict(zip(self.names, self.clouds, strict=False))
        return ", ".join(f"{name} has {listed(cloud.channel_names)}" for name, cloud in by_name.items())

    def preprocess(self, name: str, cloud: mcg.PointCloud) -> mcg.PointCloud:
        """The preprocessed cloud; warnings and errors name it."""
        # Where the user asks for all points, `preprocess` warns of neighbourhoods that do not span the surface.
        voxels = None if self.options.voxel_size == "off" else self.voxels
        with messages_named(name):
            return mcg.preprocess(with_channels(cloud, self.channels), voxels, self.options.num_neighbors)

    @cached_property
    def preprocessed(self) -> list[mcg.PointCloud]:
        """The first two clouds."""
        return list(map(self.preprocess, self.names, self.clouds))

    def method(self, name: str) -> AbstractMethod:
        """The method with the user's parameters; the default weights of Color ICP are those of mc-gicp."""
        parameters = self.options.parameters(name)
        if issubclass(METHODS[name].kind, mcg.ColorICP) and not parameters:
            source, target = self.preprocessed[self.target - 1], self.preprocessed[self.target]
            resolved: Any = mcg.MultiChannelGICP().resolve(source, target)
            parameters["channel_weights"] = resolved.channel_weights
        return METHODS[name](**parameters)

    def arguments(self, name: str) -> dict[str, Any]:
        """Keyword arguments of `mcgicp_jax.register`; default sizes of cells come from the target."""
        arguments = self.options.registration()
        if METHODS[name].kind.needs_covariances and not self.options.voxel_sizes:
            spacing = float(point_spacing(self.preprocessed[self.target]))
            # With 8 spacings, a cell has some tens of points.
            arguments["voxel_sizes"] = tuple(float(f"{times * spacing:.2g}") for times in (32, 16, 8))
        return arguments

    def method_and_arguments(self, name: str, **defaults: Any) -> tuple[AbstractMethod, dict[str, Any]]:
        """`method` and `arguments`; prints the method, and its distances unless these follow from the clouds."""
        method, arguments = self.method(name), defaults | self.arguments(name)
        distances = " m, then ".join(f"{distance:g}" for distance in np.atleast_1d(arguments.get("max_distance", ())))
        print(f"method:    {name}{f', matches up to {distances} m apart' if distances else ''}")
        return method, arguments


def with_channels(cloud: mcg.PointCloud, names: Sequence[str]) -> mcg.PointCloud:
    """The cloud with only the named channels, in this order; a colour space is computed from red, green and blue."""
    needed = [channel for name in names for channel in (COLORS if name in COLOR_SPACES else (name,))]
    missing = [name for name in dict.fromkeys(needed) if name not in cloud.channel_names]
    if missing:
        raise ValueError(f"no channel {', '.join(missing)}; there are {listed(cloud.channel_names)}")
    columns = [cloud.channel_names.index(name) for name in needed]
    channels = np.asarray(cloud.channels)[:, columns]
    valid = None if cloud.channel_valid is None else np.asarray(cloud.channel_valid)[:, columns]
    new_names: list[str] = []
    for name in names:
        if name not in COLOR_SPACES:
            new_names.append(name)
            continue
        colors = slice(len(new_names), len(new_names) + len(COLORS))
        channels[:, colors] = COLOR_SPACES[name](channels[:, colors])
        if valid is not None:
            valid[:, colors] = valid[:, colors].all(axis=1, keepdims=True)
        new_names += [f"{name}_{i}" for i in range(len(COLORS))]
    return mcg.PointCloud(
        cloud.points, channels, channel_valid=valid, covariances=cloud.covariances, channel_names=new_names
    ).replace_rows(times=cloud.times)


def listed(names: Sequence[str]) -> str:
    return ", ".join(names) if names else "no channels"
