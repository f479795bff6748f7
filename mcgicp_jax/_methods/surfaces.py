"""Surfaces of clouds for one method, computed from neighbourhoods or from covariances given with a cloud."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.cache import cached_with_cloud
from mcgicp_jax._compute.concrete import is_concrete, numpy_for
from mcgicp_jax._compute.packing import Packed
from mcgicp_jax._compute.rows_on_demand import RowsOnDemand, in_blocks
from mcgicp_jax._compute.threads import side_by_side
from mcgicp_jax._local_geometry.cells import geometry_of_cells
from mcgicp_jax._local_geometry.local_geometry import LocalGeometry
from mcgicp_jax._local_geometry.local_statistics import (
    geometry_table,
    joined,
    local_geometries,
    over_rows,
    share_a_body,
    split,
)
from mcgicp_jax._local_geometry.neighborhoods import Neighborhoods, gatherer, points_alone
from mcgicp_jax._local_geometry.observability import channel_observability
from mcgicp_jax._local_geometry.surface import Surface, SurfaceNoise
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._search.base import SearchPoints
from mcgicp_jax._terms.base import AbstractTerm

# Terms that define `columns`, by class: columns do not depend on the numbers of a term.
Kinds = tuple[type[AbstractTerm], ...]


class SurfacePair(NamedTuple):
    """Two clouds as the input of a registration.

    Attributes:
        method: with its unset parameters chosen from the data.
        terms: the residuals of each correspondence.
        source, target: the surfaces of both clouds.
        describe_target: computes rows of `target` (None: all) before they are used; None if all are computed.
    """

    method: AbstractMethod
    terms: tuple[AbstractTerm, ...]
    source: Surface
    target: Surface
    describe_target: Callable[[Int[np.ndarray, "*n"] | None], Any] | None = None


def surface_pair(
    method: AbstractMethod,
    source: PointCloud,
    target: PointCloud,
    *,
    observed: bool,
    robust: AbstractKernel | None = None,
    equalize_channels: bool = False,
    num_threads: int | None = 1,
    source_rows: Any = None,
) -> SurfacePair:
    """Choose unset parameters from two clouds, and compute their surfaces.

    Concrete clouds are processed on the host in blocks, and the results are cached with each cloud. Inside
    transformations both clouds share one compiled body, unless they are large.

    Args:
        observed: whether to compute observability, which `register` needs and the cost of given matches does not.
        robust, equalize_channels: as in `AbstractMethod.terms`.
        num_threads: largest number of threads on the host; None for no limit.
        source_rows: the rows of the surface of the source, with neighbours among all points; None for all rows. If
            given, the rows of a concrete target are computed when they are used: most are not.
    """
    geometries = cache(partial(local_geometries, source, target, method.uses_channels, num_threads, source_rows))
    used = source if source_rows is None else _some_rows(source, source_rows)
    method = method.resolve(used, target, geometries)
    terms = method.terms(used, target, robust, equalize_channels)
    kinds = tuple(type(term) for term in terms if term.name)
    # Raises an error if observability is needed and a cloud has no neighbours.
    described = observed or (source.deferred_neighbors is not None and target.deferred_neighbors is not None)
    if is_concrete(method, source, target):
        on_host = partial(
            surface_on_host, method, kinds, described=described, observed=observed, num_threads=num_threads
        )
        if source_rows is not None:
            describe = partial(surface_table(target, method, kinds, described, observed).known, num_threads=num_threads)
            columns = describe(np.zeros(0, int))
            # Columns of another dtype are copies, not views of the table.
            if any(columns[0].layout.dtypes):
                columns = describe(None)
            of_target = _surface_in(columns, method, target)
            return SurfacePair(method, terms, on_host(cloud=source, among=source_rows), of_target, describe)
        of_target, of_source = side_by_side([partial(on_host, cloud=cloud) for cloud in (target, source)], num_threads)
        return SurfacePair(method, terms, of_source, of_target)
    locals = geometries() if described else (None, None)
    surfaces = _traced(method, kinds, source, target, locals, observed, source_rows)
    of_source, of_target = (
        surface._replace(search=searchable(method, cloud))
        for surface, cloud in zip(surfaces, (used, target), strict=True)
    )
    return SurfacePair(method, terms, of_source, of_target)


def covariances_of(method: AbstractMethod, cloud: PointCloud) -> Float[np.ndarray, "N 3 3"]:
    """Covariances of a method at the points of a concrete cloud; unset parameters are chosen from the cloud."""
    surface = surface_pair(method, cloud, cloud, observed=False).source
    return np.asarray(alg.matrix_from_symmetric(jnp.asarray(surface.covariance.T)))


def _some_rows(cloud: PointCloud, rows: Any) -> PointCloud:
    """Some rows of a cloud, without neighbours, which are rows of the whole cloud."""
    xp = numpy_for(cloud, rows)
    names = ("points", "channels", "channel_valid", "valid", "covariances")
    some = {name: xp.asarray(getattr(cloud, name))[rows] for name in names if getattr(cloud, name) is not None}
    return cloud.replace_rows(deferred_neighbors=None, **some)


def searchable(method: AbstractMethod, cloud: PointCloud) -> SearchPoints:
    """The cloud as the input of a search."""
    numbers = search_numbers(method, cloud.channels, cloud.channel_valid)
    return search_rows(*numbers, cloud.points, cloud.channels, cloud.channel_valid, cloud.valid)


def search_numbers(method: AbstractMethod, channels: Any, channel_valid: Any) -> tuple[Any, Any]:
    """α and the expected squared differences of missing channels; None for what a search does not need."""
    count = channels.shape[-1]
    weights = method.weights(count)
    return weights, None if weights is None or channel_valid is None else method.missing_variances(count)


def search_rows(
    weights: Any, missing_variances: Any, points: Any, channels: Any, channel_valid: Any, valid: Any
) -> SearchPoints:
    """Rows of a cloud as the input of a search: positions, descriptors α · channel, penalties for missing channels."""
    xp = numpy_for(weights, missing_variances, points, channels, channel_valid, valid)
    points, channels, valid = xp.asarray(points), xp.asarray(channels), xp.asarray(valid)
    if weights is None:
        return SearchPoints(points, xp.zeros((points.shape[0], 0), points.dtype), valid)
    weights, penalty = xp.asarray(weights), None
    if channel_valid is not None:
        # The expected squared difference in a true match: on average, a missing channel makes a match neither nearer
        # nor farther.
        with np.errstate(over="ignore", invalid="ignore"):
            expected = weights**2 * xp.asarray(missing_variances)
        penalty = xp.where(xp.asarray(channel_valid), 0, expected.astype(points.dtype))
    return SearchPoints(points, channels * weights.astype(points.dtype), valid, penalty)


def surface_on_host(
    method: AbstractMethod,
    kinds: Kinds,
    cloud: PointCloud,
    described: bool,
    observed: bool,
    num_threads: int | None,
    among: Any = None,
) -> Surface:
    """The surface of a concrete cloud as NumPy arrays.

    Args:
        described: whether the cloud has neighbours, whose local geometry is used.
        among: (n,) rows of the cloud; None for all.
    """
    table = surface_table(cloud, method, kinds, described, observed)
    if among is None:
        return _surface_in(table.known(None, num_threads), method, cloud)
    return _surface_in(table.rows(among, num_threads), method, _some_rows(cloud, among))


# The columns that a step of the loop uses, and the noise.
_Columns = tuple[Packed[Surface], Packed[SurfaceNoise] | None]


@cached_with_cloud
def surface_table(
    cloud: PointCloud, method: AbstractMethod, kinds: Kinds, described: bool, observed: bool
) -> RowsOnDemand[_Columns]:
    """The surface of a concrete cloud, cached with the cloud; arguments as of `surface_on_host`."""
    geometry = geometry_table(cloud, method.uses_channels) if described else None
    gather, size = _gatherer(method, cloud, described, np), cloud.points.shape[0]

    def compute(rows: Any, num_threads: int | None) -> _Columns:
        statistics = None if geometry is None else geometry.known(rows, num_threads)

        def block(index: Any) -> _Columns:
            here = None if statistics is None else statistics.rows(index)
            return _surface_of_block(method, kinds, gather(index), here, observed)

        return in_blocks(block, rows, size, num_threads)

    return RowsOnDemand(compute, size)


def _surface_in(columns: _Columns, method: AbstractMethod, cloud: PointCloud) -> Surface:
    """The columns, views of one array, from which the executor on the host gathers rows; with the search."""
    surface, noise = columns[0].tree, columns[1]
    return surface._replace(noise=None if noise is None else noise.tree, search=searchable(method, cloud))


def _gatherer(method: AbstractMethod, cloud: PointCloud, described: bool, xp: Any) -> Callable[[Any], Neighborhoods]:
    if method.uses_neighborhoods and described:
        return gatherer(cloud, method.uses_channels, xp, with_given=True)
    return points_alone(cloud, xp)


def _traced(
    method: AbstractMethod,
    kinds: Kinds,
    source: PointCloud,
    target: PointCloud,
    locals: tuple[LocalGeometry | None, LocalGeometry | None],
    observed: bool,
    source_rows: Any,
) -> tuple[Surface, Surface]:
    """Both surfaces, from one compiled body if both clouds have the same inputs and are not large."""
    alike = None not in locals and (source.covariances is None) == (target.covariances is None) and source_rows is None
    if not alike or not share_a_body(source, target):
        of_source, of_target = (
            _whole(method, kinds, cloud, local, observed, among)
            for cloud, local, among in zip((source, target), locals, (source_rows, None), strict=True)
        )
        return of_source, of_target
    cloud = joined(source, target, method.uses_channels)
    if source.covariances is not None:
        given = jnp.concatenate([jnp.asarray(cloud.covariances) for cloud in (source, target)])
        cloud = cloud.replace_rows(covariances=given)
    local = jax.tree.map(lambda *rows: jnp.concatenate(rows), *locals)
    return split(_whole(method, kinds, cloud, local, observed), source.points.shape[0])


def _whole(
    method: AbstractMethod,
    kinds: Kinds,
    cloud: PointCloud,
    local: LocalGeometry | None,
    observed: bool,
    among: Any = None,
) -> Surface:
    gather = _gatherer(method, cloud, local is not None, jnp)

    def surface(rows: Any) -> Surface:
        here = None if local is None else jax.tree.map(lambda array: jnp.asarray(array)[rows], local)
        return surface_of(method, kinds, gather(rows if among is None else among[rows]), here, observed)

    return over_rows(surface, cloud.points.shape[0] if among is None else among.size)


def surface_of(
    method: AbstractMethod, kinds: Kinds, around: Neighborhoods, local: LocalGeometry | None, observed: bool
) -> Surface:
    """The surface at n points, without `search`.

    Args:
        around, local: as in `AbstractMethod.covariance`.
        observed: as in `surface_pair`.
    """
    given = around.given_covariance
    if local is not None and method.needs_covariances and given is not None:
        local = geometry_of_cells(local, given, method.num_candidates)
    surface = Surface(
        points=jnp.asarray(around.own).T,
        covariance=method.covariance(around, local).T,
        observability=None,
        channel_observability=None,
        columns={kind.name: kind.columns(around, local) for kind in kinds},
    )
    if not observed or local is None:
        return surface
    by_channels, slopes, noise = None, None, jnp.zeros_like(around.own[0])
    if method.uses_channels and local.fits.residual.shape[1]:
        weights = jax.lax.stop_gradient(method.weights(local.fits.residual.shape[1]))
        weights = jnp.asarray(weights, around.own.dtype)
        by_channels, slopes, noise = channel_observability(local.fits, local.normal, weights)
        by_channels = by_channels.T
        if method.needs_covariances:
            # Slopes between cells are not those between points.
            slopes = None
    # Observability is constant to autodiff.
    details = SurfaceNoise(noise, local.normal, local.roughness, local.reach, slopes)
    by_shape, by_channels, details = jax.lax.stop_gradient((local.observability, by_channels, details))
    return surface._replace(observability=by_shape, channel_observability=by_channels, noise=details)


@partial(jax.jit, static_argnums=(1, 4))
def _surface_of_block(
    method: AbstractMethod, kinds: Kinds, around: Neighborhoods, local: Packed[LocalGeometry] | None, observed: bool
) -> tuple[Packed[Surface], Packed[SurfaceNoise] | None]:
    """`surface_of` as two arrays: the columns that a step of the loop uses, and the noise."""
    surface = surface_of(method, kinds, around, None if local is None else local.tree, observed)
    return Packed.of(surface._replace(noise=None)), None if surface.noise is None else Packed.of(surface.noise)
