"""Surfaces of clouds for one method, computed from neighbourhoods or from covariances given with a cloud."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.blocks import map_rows
from mcgicp_jax._compute.cache import cached_with
from mcgicp_jax._compute.concrete import AnyArray, is_concrete, numpy_for
from mcgicp_jax._compute.threads import side_by_side
from mcgicp_jax._local_geometry.covariances import gatherer
from mcgicp_jax._local_geometry.local_statistics import joined, locals_of, over_rows, share_a_body, split
from mcgicp_jax._local_geometry.observability import channel_observability
from mcgicp_jax._local_geometry.records import Extended, Local, Neighborhoods, Surface, Table, covariance_of
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._search.base import SearchPoints


def surfaces_of(
    method: AbstractMethod,
    source: PointCloud,
    target: PointCloud,
    *,
    observed: bool,
    num_threads: int | None = 1,
) -> tuple[AbstractMethod, Surface, Surface]:
    """The method with its unset parameters chosen from the data, and the surfaces of both clouds.

    Concrete clouds are processed on the host in blocks, and the results cached with each cloud. Inside transformations
    both clouds share one compiled body, unless they are large.

    Args:
        observed: whether to compute observability, which `register` needs and the cost of given matches does not.
        num_threads: largest number of threads on the host; None for no limit.

    Returns:
        The resolved method, the surface of the source, and that of the target.
    """
    is_open = method.is_open(source, target)
    locals: tuple[Any, Any] = (None, None)
    if observed or is_open or (source.neighbors is not None and target.neighbors is not None):
        locals = locals_of(source, target, method.uses_channels, num_threads)
    if is_open:
        method = method.chosen(source, target, locals)
    sides = list(zip((source, target), locals, strict=True))
    if is_concrete(method, source, target):
        calls = [partial(surface_on_host, method, cloud, local, observed, num_threads) for cloud, local in sides[::-1]]
        found_target, found_source = side_by_side(calls, num_threads)
        return method, found_source, found_target
    rows = [searchable(method, cloud) for cloud in (source, target)]
    found = _traced(method, source, target, locals, observed)
    seen, there = (Surface(row, *each) for row, each in zip(rows, found, strict=True))
    return method, seen, there


def covariances_of(method: AbstractMethod, cloud: PointCloud) -> Float[np.ndarray, "N 3 3"]:
    """Covariances of a method at the points of a concrete cloud; unset parameters are chosen from the cloud."""
    _, surface, _ = surfaces_of(method, cloud, cloud, observed=False)
    return np.asarray(alg.matrix_from_symmetric(jnp.asarray(covariance_of(surface.table))))


def searchable(method: AbstractMethod, cloud: PointCloud) -> SearchPoints:
    """The cloud as the input of a search: positions, descriptors α · channel, and penalties for missing channels."""
    xp = numpy_for(method, cloud)
    points, channels = xp.asarray(cloud.points), xp.asarray(cloud.channels)
    weights = method.weights(channels.shape[-1])
    if weights is None:
        return SearchPoints(points, xp.zeros((points.shape[0], 0), points.dtype), xp.asarray(cloud.valid))
    weights, penalty = xp.asarray(weights), None
    if cloud.channel_valid is not None:
        # The expected squared difference in a true match: on average, a missing channel makes a match neither nearer
        # nor farther.
        with np.errstate(over="ignore", invalid="ignore"):
            expected = weights**2 * xp.asarray(method.missing_variances(channels.shape[-1]))
        penalty = xp.where(xp.asarray(cloud.channel_valid), 0, expected.astype(points.dtype))
    return SearchPoints(points, channels * weights.astype(points.dtype), xp.asarray(cloud.valid), penalty)


def surface_on_host(
    method: AbstractMethod, cloud: PointCloud, local: Local | None, observed: bool, num_threads: int | None
) -> Surface:
    """The surface of a concrete cloud as NumPy arrays, cached for this cloud and method."""

    def make() -> Surface:
        block = partial(_block, method, cloud, local, observed)
        table, details = map_rows(block(), cloud.points.shape[0], num_threads)
        return Surface(searchable(method, cloud), table, details)

    # A surface does not depend on numbers that are estimated from matches.
    leaves, structure = jax.tree.flatten(method.with_estimates(None))
    key = (structure, *(np.asarray(leaf).tobytes() for leaf in leaves), observed)
    return cached_with(cloud, "surface", key, make)


def _block(method: AbstractMethod, cloud: PointCloud, local: Local | None, observed: bool) -> Any:
    gather = gatherer(cloud, method.uses_channels, np) if local is not None and method.uses_neighborhoods else None
    points, given = np.asarray(cloud.points), cloud.covariances
    given = None if given is None else np.asarray(given)

    def table(rows: Any) -> tuple[Any, Any]:
        around = None if gather is None else gather(rows)
        here = None if local is None else jax.tree.map(lambda array: array[rows], local)
        return _tables(method, points[rows], None if given is None else given[rows], around, here, observed)

    return table


def _traced(
    method: AbstractMethod,
    source: PointCloud,
    target: PointCloud,
    locals: tuple[Local | None, Local | None],
    observed: bool,
) -> Any:
    """Table and details of each cloud, from one compiled body if both have the same inputs and are not large."""
    alike = None not in locals and (source.covariances is None) == (target.covariances is None)
    if not alike or not share_a_body(source, target):
        sides = zip((source, target), locals, strict=True)
        return [_rows_of(method, cloud, cloud.covariances, local, observed) for cloud, local in sides]
    cloud = joined(source, target, method.uses_channels)
    local = jax.tree.map(lambda *rows: jnp.concatenate(rows), *locals)
    given = None
    if source.covariances is not None:
        given = jnp.concatenate([jnp.asarray(cloud.covariances) for cloud in (source, target)])
    return split(_rows_of(method, cloud, given, local, observed), source.points.shape[0])


def _rows_of(method: AbstractMethod, cloud: PointCloud, given: Any, local: Local | None, observed: bool) -> Any:
    gather = gatherer(cloud, method.uses_channels, jnp) if local is not None and method.uses_neighborhoods else None
    points, given = jnp.asarray(cloud.points), None if given is None else jnp.asarray(given)

    def table(rows: Any) -> Any:
        around = None if gather is None else gather(rows)
        here = None if local is None else jax.tree.map(lambda array: jnp.asarray(array)[rows], local)
        return tables(method, points[rows], None if given is None else given[rows], around, here, observed)

    return over_rows(table, points.shape[0])


def tables(
    method: AbstractMethod,
    points: Float[AnyArray, "n 3"],
    given: Float[AnyArray, "n 3 3"] | None,
    around: Neighborhoods | None,
    local: Local | None,
    observed: bool,
) -> tuple[Table, Float[Array, "n 6"] | None]:
    """`Surface.table` as a tuple of column groups, and `Surface.details` (None without observability), for n points.

    The arguments are those of `AbstractMethod.covariance`; `observed` is that of `surfaces_of`.
    """
    points = jnp.asarray(points).T
    covariances = None if given is None else alg.symmetric_from_matrix(jnp.asarray(given))
    local = None if local is None else method.described(local, covariances)
    columns = [points, method.covariance(points, around, local, covariances)]
    features = method.features(around, local)

    def table(*columns: Any) -> Table:
        plain = tuple(column.T for column in columns)
        return plain if features is None else Extended(plain, features.T)

    if not observed or local is None:
        return table(*columns), None
    noise = jnp.zeros_like(points[0])
    columns.append(local.geometry)
    if method.uses_channels and local.num_channels:
        weights = jnp.asarray(jax.lax.stop_gradient(method.weights(local.num_channels)), points.dtype)
        channels, noise = channel_observability(local, weights)
        columns.append(channels)
    details = jnp.concatenate([noise[None], local.normal, local.roughness[None], local.reach[None]])
    # Observability is constant to autodiff.
    fixed = [jax.lax.stop_gradient(column) for column in columns[2:]]
    return table(*columns[:2], *fixed), jax.lax.stop_gradient(details).T


@partial(jax.jit, static_argnums=5)
def _tables(*arguments: Any) -> tuple[Table, Float[Array, "n 6"] | None]:
    table, details = tables(*arguments)
    if isinstance(table, Extended):
        return Extended(jnp.concatenate(table.table, axis=1), table.features), details
    return jnp.concatenate(table, axis=1), details
