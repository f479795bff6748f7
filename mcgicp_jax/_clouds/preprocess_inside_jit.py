"""Preprocessing of traced clouds, inside `jit` and `vmap`: all shapes are known before the points are."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._clouds.point_cloud import LARGEST, PointCloud, Voxels
from mcgicp_jax._clouds.voxels import TURN, VARIATION
from mcgicp_jax._compute.concrete import DeferredRows, is_concrete
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._search.base import IDENTITY, AbstractSearch, SearchPoints
from mcgicp_jax._search.default_search import default_search


@with_settings_of_package
def preprocess_traced(
    cloud: PointCloud, voxel_size: Any, num_neighbors: int, search: AbstractSearch | None, size: int | None
) -> PointCloud:
    edge = voxel_size.size if isinstance(voxel_size, Voxels) else voxel_size
    if isinstance(edge, str) or not is_concrete(edge):
        raise ValueError(f"voxel_size: expected a Python number or None inside jit and vmap, got {edge!r}")
    if cloud.points.ndim != 2:
        raise ValueError(f"cloud: expected a single cloud, got a batch of shape {cloud.points.shape}; use jax.vmap")
    if not cloud.points.shape[0]:
        raise ValueError("cloud: expected points, got none")
    arrays = [array for array in (cloud.points, cloud.channels, cloud.covariances) if array is not None]
    valid = jnp.asarray(cloud.valid)
    for array in arrays:
        valid = valid & jnp.all(jnp.abs(array) <= LARGEST, axis=tuple(range(1, array.ndim)))
    cloud = cloud.replace_rows(times=None, deferred_neighbors=None, valid=valid)
    if edge is None:
        cloud = _valid_first(cloud)
        cloud = cloud if size is None else cloud.pad(size)
    else:
        if cloud.covariances is not None:
            raise ValueError("voxel_size: expected None for a cloud with covariances, which cannot be averaged")
        if size is None:
            raise ValueError("size: expected a number of rows with a voxel_size inside jit and vmap, got None")
        cloud = _averaged(cloud, float(edge), size)
    neighbors = traced_neighbors(cloud, num_neighbors, search or default_search(traced=True))
    return cloud.replace_rows(deferred_neighbors=DeferredRows.of(neighbors), voxels=Voxels(edge))


def traced_neighbors(cloud: PointCloud, num_neighbors: int, search: AbstractSearch) -> Int[Array, "N k"]:
    """Rows of the nearest neighbours of each valid point; −1 where there is none."""
    points = jax.lax.stop_gradient(jnp.asarray(cloud.points))
    rows = SearchPoints(points, points[:, :0], jnp.asarray(cloud.valid))
    pose, everywhere = jnp.asarray(IDENTITY, points.dtype), jnp.asarray(jnp.inf, points.dtype)
    return search.nearest_traced(pose, rows, rows, everywhere, jnp.bool_(True), num_neighbors).T


def _valid_first(cloud: PointCloud) -> PointCloud:
    """The cloud with its valid rows first, in their order; the last of them fills the others."""
    valid = jnp.asarray(cloud.valid)
    place = jnp.arange(valid.size)
    rows = jnp.argsort(~valid, stable=True)[jnp.minimum(place, jnp.maximum(jnp.sum(valid) - 1, 0))]
    arrays: dict[str, Any] = {}
    for name in ("points", "channels", "channel_valid", "covariances"):
        array = getattr(cloud, name)
        if array is not None:
            # A cloud without any valid row has zeros, whose derivative is 0.
            mask = valid[rows].reshape(-1, *[1] * (array.ndim - 1))
            values = jnp.asarray(array)[rows]
            arrays[name] = jnp.where(mask, values, jnp.zeros((), values.dtype))
    return cloud.replace_rows(valid=place < jnp.sum(valid), **arrays)


def _averaged(cloud: PointCloud, voxel_size: float, size: int) -> PointCloud:
    """The mean points and channels of each voxel, sorted by voxel; no row is valid if there are more than `size`."""
    points, valid = jnp.asarray(cloud.points), jnp.asarray(cloud.valid)
    order, numbers, count = _voxels_of(jax.lax.stop_gradient(points), valid, voxel_size)

    def means(array: Float[Array, "N D"], counts: Bool[Array, "N D"]) -> tuple[Array, Bool[Array, "M D"]]:
        values, weights = jnp.where(counts, array, 0)[order], counts[order].astype(points.dtype)
        # Rows beyond the last voxel are dropped.
        total, weight = (jax.ops.segment_sum(rows, numbers, size) for rows in (values, weights))
        return total / jnp.maximum(weight, 1), weight > 0

    channels = jnp.asarray(cloud.channels)
    measured = jnp.ones_like(channels, bool) if cloud.channel_valid is None else jnp.asarray(cloud.channel_valid)
    mean, occupied = means(points, jnp.broadcast_to(valid[:, None], points.shape))
    mean_channels, channel_valid = means(channels, measured & valid[:, None])
    mask = None if cloud.channel_valid is None else channel_valid
    valid = occupied[:, 0] & (count <= size)
    return _valid_first(cloud.replace_rows(points=mean, channels=mean_channels, channel_valid=mask, valid=valid))


def _voxels_of(
    points: Float[Array, "N 3"], valid: Bool[Array, "N"], voxel_size: float
) -> tuple[Int[Array, "N"], Int[Array, "N"], Int[Array, ""]]:
    """Order of rows by voxel, invalid ones last; their voxel numbers in it (invalid: beyond all); number of voxels."""
    # The grid is turned like those of `grid_of`, but by other random numbers.
    low = jnp.min(jnp.where(valid[:, None], points, jnp.inf), axis=0)
    middle = 0.5 * (low + jnp.max(jnp.where(valid[:, None], points, -jnp.inf), axis=0))
    key = jax.random.key(0)
    for number in (jnp.sum(valid), *jnp.sum(valid[:, None] & (points > middle), axis=0)):
        key = jax.random.fold_in(key, number)
    angles = TURN / np.sqrt(3) + jax.random.uniform(key, (3,), points.dtype, -VARIATION, VARIATION)
    turn = jaxlie.SO3.exp(angles).as_matrix().astype(points.dtype)
    x, y, z = jnp.floor(jnp.dot(points, turn.T, precision="highest") / voxel_size).T
    order = jnp.lexsort((z, y, x, ~valid))
    cells = jnp.stack([x, y, z, ~valid])[:, order]
    begins = jnp.any(cells[:, 1:] != cells[:, :-1], axis=0)
    numbers = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(begins, dtype=jnp.int32)])
    count = jnp.max(jnp.where(valid[order], numbers + 1, 0))
    return order, jnp.where(valid[order], numbers, np.iinfo(np.int32).max), count
