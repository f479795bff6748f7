"""Local geometry of clouds: on the host when it is used, inside transformations over the whole arrays."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.cache import cached_with_cloud
from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._compute.row_functions import ComputedTable, Rows, over_both
from mcgicp_jax._compute.threads import side_by_side
from mcgicp_jax._local_geometry.local_geometry import LocalGeometry, describe
from mcgicp_jax._local_geometry.neighborhoods import neighborhoods, of_rows, with_near


def local_geometries(
    source: PointCloud,
    target: PointCloud,
    with_channels: bool,
    num_threads: int | None = 1,
    source_rows: Any = None,
) -> tuple[LocalGeometry, LocalGeometry]:
    """Local geometry of two preprocessed clouds.

    Args:
        with_channels: whether the method uses the channels; if not, the programs do not depend on their number.
        num_threads: largest number of threads on the host; None for no limit.
        source_rows: (n,) rows of the source to describe; None for all.

    Returns:
        Of the source and of the target.
    """
    if is_concrete(source, target):
        calls = [
            partial(geometry_table(cloud, with_channels).trees, rows, num_threads)
            for cloud, rows in ((target, None), (source, source_rows))
        ]
        (of_target,), (of_source,) = side_by_side(calls, num_threads)
        return of_source, of_target
    # A concrete cloud beside a traced one is traced as well, which needs no program of its own.
    of_rows_of_source = of_rows(with_near(source, with_channels), source_rows)
    (of_source,), (of_target,) = over_both(_geometry, None, of_rows_of_source, with_near(target, with_channels))
    return of_source, of_target


@cached_with_cloud
def geometry_table(cloud: PointCloud, with_channels: bool) -> ComputedTable:
    """Local geometry of a concrete cloud, cached with the cloud."""
    return _table(cloud, with_channels, cloud)


def differentiable_geometry(cloud: PointCloud, with_channels: bool, fixed: PointCloud) -> ComputedTable:
    """Local geometry of a cloud whose points differentiation may trace, with the values of the same, concrete cloud."""
    return _table(cloud, with_channels, fixed, geometry_table(fixed, with_channels))


def _table(
    cloud: PointCloud, with_channels: bool, fixed: PointCloud, values: ComputedTable | None = None
) -> ComputedTable:
    # Another array: the local geometry has no derivative by channels.
    channels = np.asarray(fixed.channels).view()
    inputs = with_near(cloud.replace_rows(channels=channels), with_channels)
    return ComputedTable(_geometry, None, inputs, cloud.points.shape[0], values)


def _geometry(_: None, own: Rows, near: Rows) -> tuple[LocalGeometry]:
    return (describe(neighborhoods(own, near)),)
