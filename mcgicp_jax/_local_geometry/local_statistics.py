"""Local geometry of clouds: on the host in blocks, inside transformations over the whole arrays."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.cache import cached_with_cloud
from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._compute.packing import Packed
from mcgicp_jax._compute.rows_on_demand import RowsOnDemand, in_blocks
from mcgicp_jax._compute.threads import side_by_side
from mcgicp_jax._local_geometry.local_geometry import LocalGeometry, describe
from mcgicp_jax._local_geometry.neighborhoods import Neighborhoods, check_neighbors, gatherer, has_few_points

Tree = TypeVar("Tree")

# Points. Inside transformations, neighbourhoods of more points are processed in blocks, too: on CPUs XLA sums over the
# first axis of a wider table column by column, which is twenty times slower.
_LARGEST_WHOLE = 16_000
# Largest number of points in such a block; below the limit above.
_LARGEST_BLOCK = 8192


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
            partial(local_geometry_on_host, cloud, with_channels, num_threads, rows)
            for cloud, rows in ((target, None), (source, source_rows))
        ]
        of_target, of_source = side_by_side(calls, num_threads)
        return of_source, of_target
    # A concrete cloud beside a traced one is traced as well, which needs no program of its own.
    if source_rows is not None or not share_a_body(source, target):
        return _traced(source, with_channels, source_rows), _traced(target, with_channels)
    few = jnp.concatenate([has_few_points(cloud, jnp) for cloud in (source, target)])
    return split(_traced(joined(source, target, with_channels), with_channels, few=few), source.points.shape[0])


def local_geometry_on_host(
    cloud: PointCloud, with_channels: bool, num_threads: int | None = 1, among: Any = None
) -> LocalGeometry:
    """Local geometry of a concrete cloud as NumPy arrays.

    Args:
        among: (n,) rows of the cloud; None for all.
    """
    table = geometry_table(cloud, with_channels)
    return (table.known(None, num_threads) if among is None else table.rows(among, num_threads)).tree


@cached_with_cloud
def geometry_table(cloud: PointCloud, with_channels: bool) -> RowsOnDemand[Packed[LocalGeometry]]:
    """Local geometry of a concrete cloud, cached with the cloud."""
    neighbors, gather = check_neighbors(cloud), gatherer(cloud, with_channels, np)
    size = cloud.points.shape[0]

    def compute(rows: Any, num_threads: int | None) -> Packed[LocalGeometry]:
        # Neighbours are found of all rows at once.
        neighbors[slice(None) if rows is None else rows]
        return in_blocks(lambda index: _describe(gather(index)), rows, size, num_threads)

    return RowsOnDemand(compute, size)


@jax.jit
def _describe(around: Neighborhoods) -> Packed[LocalGeometry]:
    """`describe` as one array: to return many takes longer than to use them."""
    return Packed.of(describe(around))


def _traced(cloud: PointCloud, with_channels: bool, among: Any = None, few: Any = None) -> LocalGeometry:
    gather = gatherer(cloud, with_channels, jnp, few=few)
    if among is None:
        return over_rows(lambda rows: describe(gather(rows)), cloud.points.shape[0])
    return over_rows(lambda rows: describe(gather(among[rows])), among.size)


def share_a_body(source: PointCloud, target: PointCloud) -> bool:
    """Whether both clouds are concatenated for one compiled body; for large clouds this costs more than it saves."""
    return source.points.shape[0] + target.points.shape[0] <= _LARGEST_WHOLE


def over_rows(function: Callable[[Any], Tree], num_rows: int) -> Tree:
    """The result of a function for all rows, inside transformations; many rows are processed in blocks.

    Args:
        function: maps a slice or an array of row numbers to a pytree of arrays whose first axis are these rows.
    """
    if num_rows <= _LARGEST_WHOLE:
        return function(slice(None))
    num_blocks = -(-num_rows // _LARGEST_BLOCK)
    size = -(-num_rows // num_blocks)
    padded = jnp.minimum(jnp.arange(num_blocks * size), num_rows - 1).reshape(num_blocks, size)
    found = jax.lax.map(function, padded)
    return jax.tree.map(lambda leaf: leaf.reshape(padded.size, *leaf.shape[2:])[:num_rows], found)


def joined(source: PointCloud, target: PointCloud, with_channels: bool) -> PointCloud:
    """Both clouds concatenated, for one compiled body; with only the arrays that neighbourhoods need."""
    size = source.points.shape[0]

    def both(name: str) -> Any:
        return jnp.concatenate([jnp.asarray(getattr(cloud, name)) for cloud in (source, target)])

    neighbors = [jnp.asarray(cloud.neighbors) for cloud in (source, target)]
    most = max(rows.shape[1] for rows in neighbors)
    neighbors[1] = jnp.where(neighbors[1] >= 0, neighbors[1] + size, -1)
    padded = [jnp.pad(rows, [(0, 0), (0, most - rows.shape[1])], constant_values=-1) for rows in neighbors]
    valid = None
    if with_channels and (source.channel_valid is not None or target.channel_valid is not None):
        masks = [
            jnp.ones(cloud.channels.shape, bool) if cloud.channel_valid is None else jnp.asarray(cloud.channel_valid)
            for cloud in (source, target)
        ]
        valid = jnp.concatenate(masks)
    return source.replace_rows(
        points=both("points"),
        channels=both("channels") if with_channels else jnp.zeros((both("points").shape[0], 0), source.points.dtype),
        channel_valid=valid,
        valid=None,
        deferred_neighbors=jnp.concatenate(padded),
        covariances=None,
        origin=None,
        channel_names=(),
    )


def split(both: Tree, size: int) -> tuple[Tree, Tree]:
    """The rows of the source (the first `size`) and of the target, after `joined`."""
    return jax.tree.map(lambda rows: rows[:size], both), jax.tree.map(lambda rows: rows[size:], both)
