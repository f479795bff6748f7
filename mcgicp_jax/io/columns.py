"""The columns of a file, from and to clouds."""

from __future__ import annotations

import re

import numpy as np

from mcgicp_jax._clouds.columns import COLORS, Columns, arrays_of_columns, channel_name
from mcgicp_jax._clouds.point_cloud import PointCloud


def cloud_of(columns: Columns) -> PointCloud:
    """Build a cloud from the named columns of a file, which must include x, y and z."""
    points, channels, names = arrays_of_columns(columns)
    return PointCloud(points, channels, channel_names=names)


def columns_of(cloud: PointCloud) -> Columns:
    """The named columns to write for a cloud; colours as uint8 if that is lossless."""
    names = cloud.channel_names
    for name in names:
        if not re.fullmatch(r"[A-Za-z0-9_.\-]+", name) or names.count(name) > 1:
            raise ValueError(
                f"channel_names: expected unique names of letters, digits, _ . -, got {name!r}; .npz can hold it"
            )
    columns = dict(zip("xyz", cloud.points.T, strict=True))
    columns |= {column_name(name): values for name, values in zip(names, cloud.channels.T, strict=True)}
    colours = {name: columns[name] for name in COLORS if name in columns}
    whole = {name: np.rint(np.clip(values, 0, 1) * 255) for name, values in colours.items()}
    if all(np.array_equal(whole[name].astype(cloud.points.dtype) / 255, colours[name]) for name in colours):
        columns |= {name: values.astype(np.uint8) for name, values in whole.items()}
    return columns


def column_name(channel: str) -> str:
    return channel if channel_name(channel) == channel else f"channel_{channel}"
