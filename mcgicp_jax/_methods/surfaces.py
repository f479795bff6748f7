"""Surfaces of clouds for one method, computed from neighbourhoods or from covariances given with a cloud."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, partial
from operator import itemgetter
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.cache import cached_with_cloud
from mcgicp_jax._compute.concrete import is_concrete, numpy_for
from mcgicp_jax._compute.row_functions import ComputedTable, GivenTable, Input, Rows, over_both
from mcgicp_jax._compute.threads import side_by_side
from mcgicp_jax._local_geometry import local_geometry as geo
from mcgicp_jax._local_geometry.local_geometry import LocalGeometry, Surface
from mcgicp_jax._local_geometry.neighborhoods import PointRows, inputs_of_neighbors, neighborhoods, of_rows
from mcgicp_jax._local_geometry.observability import channel_observability
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._search.base import SearchPoints
from mcgicp_jax._terms.base import AbstractTerm

# Terms that define `columns`, by class: columns do not depend on the numbers of a term.
Kinds = tuple[type[AbstractTerm], ...]

# The parts of a surface that row functions get as inputs of their own.
SURFACE, NOISE, SEARCH = range(3)


@dataclass(frozen=True, eq=False)
class SurfaceTable:
    """The surface of a concrete cloud, whose rows are computed when they are used.

    Attributes:
        table: of `Surface`, and of its `noise` if `observed`.
        rows: (n,) those that are used; None for all.
        search: the points, those of `rows`, as input of the search.
    """

    table: ComputedTable
    rows: Any
    search: SearchPoints
    observed: bool

    @cached_property
    def search_table(self) -> GivenTable:
        return GivenTable(self.search)

    @property
    def observes_channels(self) -> bool:
        return self.table.computed(np.zeros(0, int))[0].tree.channel_observability is not None

    @property
    def points(self) -> Float[np.ndarray, "n 3"]:
        return self.search.points

    @property
    def num_points(self) -> int:
        return self.search.valid.size

    def whole(self) -> Surface:
        return _surface_in(self.table.trees(self.rows), self.search)


# Inside transformations a `Surface`, else a table.
if TYPE_CHECKING:
    AnySurface: TypeAlias = Any
else:
    AnySurface = Surface | SurfaceTable


class SurfacePair(NamedTuple):
    """Two clouds as the input of a registration.

    Attributes:
        method: with its unset parameters chosen from the data.
        source, target: the surfaces of both clouds; tables if everything is concrete.
    """

    method: AbstractMethod
    terms: tuple[AbstractTerm, ...]
    source: AnySurface
    target: AnySurface

    def whole(self) -> SurfacePair:
        return self._replace(source=whole_surface(self.source), target=whole_surface(self.target))


def input_of(surface: AnySurface, part: int, rows: Any) -> Input:
    """One part of a surface as the input of a row function; of some rows, or of all (None)."""
    if isinstance(surface, Surface):
        return Input((surface._replace(noise=None, search=None), surface.noise, surface.search)[part], rows)
    if part == SEARCH:
        return Input(surface.search_table, rows)
    if surface.rows is not None:
        rows = surface.rows if rows is None else surface.rows[rows]
    return Input(surface.table, rows, part)


def whole_surface(surface: AnySurface) -> Surface:
    return surface.whole() if isinstance(surface, SurfaceTable) else surface


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

    Rows of concrete clouds are computed on the host when they are used, and are cached with each cloud. Inside
    transformations both clouds share one compiled body, unless they are large.

    Args:
        observed: whether to compute observability, which `register` needs and the cost of given matches does not.
        source_rows: the rows of the surface of the source, with neighbours among all points; None for all rows.
    """
    matched = source if source_rows is None else _some_rows(source, source_rows)
    whole = cache(partial(geo.local_geometries, source, target, method.uses_channels, (source_rows, None), num_threads))
    method = resolved(method, source, target, source_rows, num_threads, whole)
    terms = method.terms(matched, target, robust, equalize_channels)
    kinds = tuple(type(term) for term in terms if term.name)
    # Raises an error if observability is needed and a cloud has no neighbours.
    with_geometry = observed or (source.deferred_neighbors is not None and target.deferred_neighbors is not None)
    if is_concrete(method, source, target):
        tables = [surface_table(cloud, method, kinds, with_geometry, observed) for cloud in (source, target)]
        if source_rows is None:
            # At once, and side by side: most rows are used.
            side_by_side([partial(table.computed, None, num_threads) for table in tables[::-1]], num_threads)
        of_source = SurfaceTable(tables[0], source_rows, searchable(method, matched), observed)
        of_target = SurfaceTable(tables[1], None, searchable(method, target), observed)
        return SurfacePair(method, terms, of_source, of_target)
    inputs = [of_rows(_inputs(method, source, with_geometry), source_rows), _inputs(method, target, with_geometry)]
    if with_geometry:
        inputs = [[*rows, *map(Input, geo.separated(local))] for rows, local in zip(inputs, whole(), strict=True)]
    parts = over_both(surface_of(kinds, observed, with_geometry), method, *inputs)
    surfaces = _surface_in(parts[0], searchable(method, matched)), _surface_in(parts[1], searchable(method, target))
    return SurfacePair(method, terms, *surfaces)


def resolved(
    method: AbstractMethod,
    source: PointCloud,
    target: PointCloud,
    source_rows: Any = None,
    num_threads: int | None = 1,
    whole: Callable[[], tuple[LocalGeometry, LocalGeometry]] | None = None,
) -> AbstractMethod:
    """Choose unset parameters as a registration of `source_rows` does; `whole` gives the geometry of traced clouds."""

    def geometries(rows: tuple[Any, Any]) -> tuple[LocalGeometry, LocalGeometry]:
        if whole is None or is_concrete(source, target):
            rows = rows if source_rows is None else (source_rows[rows[0]], rows[1])
            return geo.local_geometries(source, target, method.uses_channels, rows, num_threads)
        # Inside transformations all rows are needed anyway.
        of_source, of_target = (jax.tree.map(itemgetter(i), local) for local, i in zip(whole(), rows, strict=True))
        return of_source, of_target

    return method.resolve(source if source_rows is None else _some_rows(source, source_rows), target, geometries)


def covariances_of(method: AbstractMethod, cloud: PointCloud) -> Float[np.ndarray, "N 3 3"]:
    surface = whole_surface(surface_pair(method, cloud, cloud, observed=False).source)
    return np.asarray(alg.matrix_from_symmetric(jnp.asarray(surface.covariance.T)))


def _some_rows(cloud: PointCloud, rows: Any) -> PointCloud:
    """Some rows of a cloud, without neighbours, which are rows of the whole cloud."""
    xp = numpy_for(cloud, rows)
    names = ("points", "channels", "channel_valid", "valid", "covariances")
    columns = {name: xp.asarray(getattr(cloud, name))[rows] for name in names if getattr(cloud, name) is not None}
    return cloud.replace_rows(deferred_neighbors=None, **columns)


def searchable(method: AbstractMethod, cloud: PointCloud) -> SearchPoints:
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


@cached_with_cloud
def surface_table(
    cloud: PointCloud, method: AbstractMethod, kinds: Kinds, with_geometry: bool, observed: bool
) -> ComputedTable:
    """The surface of a concrete cloud, with `noise` if `observed`, whose rows are cached with the cloud."""
    geometry = geo.geometry_table(cloud, method.uses_channels) if with_geometry else None
    inputs = _inputs(method, cloud, with_geometry, geometry)
    return ComputedTable(surface_of(kinds, observed, with_geometry), method, inputs, cloud.points.shape[0])


def differentiable_inputs(
    source: PointCloud,
    target: PointCloud,
    method: AbstractMethod,
    terms: tuple[AbstractTerm, ...],
    fixed: tuple[PointCloud, PointCloud, AbstractMethod],
    indices: Int[np.ndarray, "n m"],
    *,
    source_rows: Any = None,
    observed: bool = False,
    soft: bool = False,
) -> list[Input]:
    """The surfaces of matched points on the host, as inputs of a row function with `matched_rows`; with descriptors if
    `soft`. `fixed`: the clouds and the resolved method without traces of differentiation, see `primal`. `indices`: −1
    where there is no match."""
    fixed_source, fixed_target, fixed_method = fixed
    sides = ((source, fixed_source, source_rows), (target, fixed_target, indices))
    with_geometry = observed or all(cloud.deferred_neighbors is not None for cloud in (source, target))
    matched, kinds = [], tuple(type(term) for term in terms if term.name)
    function = surface_of(kinds, observed, with_geometry)
    for cloud, same, rows in sides:
        geometry = geo.differentiable_geometry(cloud, same, method.uses_channels) if with_geometry else None
        inputs = _inputs(method, cloud, with_geometry, geometry)
        values = surface_table(same, fixed_method, kinds, with_geometry, observed)
        matched.append(Input(ComputedTable(function, method, inputs, values.size, values), rows))
    if soft:
        for cloud, _, rows in sides:
            points = Input(PointRows(cloud.points, cloud.channels, cloud.channel_valid))
            matched.append(Input(ComputedTable(_descriptors, method, [points], cloud.points.shape[0]), rows))
    return matched


def _descriptors(method: AbstractMethod, own: Rows) -> tuple[SearchPoints]:
    """Descriptors and penalties of `searchable`, for the derivative of a soft assignment."""
    points, channels, measured, *_ = own.tree
    numbers, valid = search_numbers(method, channels, measured), jnp.ones(len(points), bool)
    # A mask is no number, and positions are in the surface already.
    return (search_rows(*numbers, points, channels, measured, valid)._replace(points=None, valid=None),)


def _surface_in(parts: tuple[Any, ...], search: SearchPoints) -> Surface:
    """The surface with its noise and search points. Arrays of a table are views: do not modify them."""
    surface, *noise = parts
    return surface._replace(noise=noise[0] if noise else None, search=search)


def _inputs(
    method: AbstractMethod, cloud: PointCloud, with_geometry: bool, geometry: ComputedTable | None = None
) -> list[Input]:
    """Inputs of the row function `surface_of`: the cloud, and its geometry if a table of it is passed."""
    if method.uses_neighborhoods and with_geometry:
        inputs = inputs_of_neighbors(cloud, method.uses_channels, with_given=True)
    else:
        inputs = [Input(PointRows(cloud.points, given=cloud.covariances))]
    return inputs if geometry is None else [*inputs, Input(geometry), Input(geometry, part=1)]


@cache
def surface_of(kinds: Kinds, observed: bool, with_geometry: bool) -> Callable[..., Any]:
    """The row function of surfaces without `search`; their `noise` is the second tree if `observed`. See
    `AbstractMethod.covariance` and `surface_pair`."""

    def surface(method: AbstractMethod, own: Rows, *rest: Rows) -> tuple[Any, ...]:
        near, local = (rest[:-2], geo.joined(*(part.tree for part in rest[-2:]))) if with_geometry else (rest, None)
        around = neighborhoods(own, *near)
        covariance = around.given_covariance
        if local is not None and method.needs_covariances and covariance is not None:
            local = geo.geometry_of_cells(local, covariance, method.num_candidates)
        result = Surface(
            points=jnp.asarray(around.own).T,
            covariance=method.covariance(around, local).T,
            observability=None,
            channel_observability=None,
            columns={kind.name: kind.columns(around, local) for kind in kinds},
        )
        if not observed or local is None:
            return (result,)
        by_channels, slopes, noise = None, None, jnp.zeros_like(around.own[0])
        if method.uses_channels and local.fits.residual.shape[1]:
            weights = jax.lax.stop_gradient(method.weights(local.fits.residual.shape[1]))
            weights = jnp.asarray(weights, around.own.dtype)
            by_channels, slopes, noise = channel_observability(local.fits, local.normal, weights)
            by_channels = by_channels.T
            if method.needs_covariances:
                # Slopes between cells are not those between points.
                slopes = None
        details = geo.SurfaceNoise(noise, local.normal, local.roughness, local.neighborhood_radius, slopes)
        # Observability is constant to autodiff.
        by_shape, by_channels, details = jax.lax.stop_gradient((local.observability, by_channels, details))
        return result._replace(observability=by_shape, channel_observability=by_channels), details

    return surface
