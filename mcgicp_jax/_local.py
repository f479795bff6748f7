"""Local statistics of clouds: on the host in blocks, inside transformations over the whole arrays."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from mcgicp_jax._blocks import map_rows
from mcgicp_jax._cloud import PointCloud
from mcgicp_jax._kept import keep
from mcgicp_jax._neighborhoods import describe, gatherer
from mcgicp_jax._pose import is_concrete
from mcgicp_jax._surface import Local
from mcgicp_jax._threads import side_by_side

Tree = TypeVar("Tree")

# Neighbourhoods of more points than that are gone through block by block inside transformations, too: on CPUs XLA sums
# over the first axis of tables of more columns column by column, which is twenty times slower.
_LARGEST_WHOLE = 16_000
_LARGEST_BLOCK = 8192


def locals_of(
    source: PointCloud, target: PointCloud, with_channels: bool, num_threads: int | None = 1
) -> tuple[Local, Local]:
    """Local statistics of two preprocessed clouds.

    Args:
        with_channels: whether the method uses the channels; otherwise they select no program.
        num_threads: on the host, at most; None for as many as there is use for.
    """
    if is_concrete(source, target):
        calls = [partial(local_on_host, cloud, with_channels, num_threads) for cloud in (target, source)]
        found_target, found_source = side_by_side(calls, num_threads)
        return found_source, found_target
    # Of a concrete cloud beside a traced one as well: that costs no program of its own.
    if not share_a_body(source, target):
        return _traced(source, with_channels), _traced(target, with_channels)
    return split(_traced(joined(source, target, with_channels), with_channels), source.points.shape[0])


def local_on_host(cloud: PointCloud, with_channels: bool, num_threads: int | None = 1) -> Local:
    """Local statistics of a concrete cloud, kept as long as it is used; NumPy arrays."""

    def make() -> Local:
        gather = gatherer(cloud, with_channels, np)
        return map_rows(lambda rows: _describe(gather(rows)), cloud.points.shape[0], num_threads)

    return keep(cloud, "local", with_channels, make)


_describe = jax.jit(describe)


def _traced(cloud: PointCloud, with_channels: bool) -> Local:
    gather = gatherer(cloud, with_channels, jnp)
    return over_rows(lambda rows: describe(gather(rows)), cloud.points.shape[0])


def share_a_body(source: PointCloud, target: PointCloud) -> bool:
    """Whether both clouds go through one compiled body, row beside row: unless that costs more than it saves."""
    return source.points.shape[0] + target.points.shape[0] <= _LARGEST_WHOLE


def over_rows(function: Callable[[Any], Tree], num_rows: int) -> Tree:
    """What a function makes of rows, inside transformations; many rows are gone through block by block.

    Args:
        function: takes a slice or row numbers; its arrays have the rows as their first dimension.
    """
    if num_rows <= _LARGEST_WHOLE:
        return function(slice(None))
    num_blocks = -(-num_rows // _LARGEST_BLOCK)
    size = -(-num_rows // num_blocks)
    padded = jnp.minimum(jnp.arange(num_blocks * size), num_rows - 1).reshape(num_blocks, size)
    found = jax.lax.map(function, padded)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:num_rows], found)


def joined(source: PointCloud, target: PointCloud, with_channels: bool) -> PointCloud:
    """Both clouds in one, so that one compiled body serves both; of arrays for neighbourhoods alone."""
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
        neighbors=jnp.concatenate(padded),
        covariances=None,
        origin=None,
        channel_names=(),
    )


def split(both: Tree, size: int) -> tuple[Tree, Tree]:
    """The rows of the source, and those of the target."""
    return jax.tree.map(lambda rows: rows[:size], both), jax.tree.map(lambda rows: rows[size:], both)
