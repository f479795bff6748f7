"""Matched points: the rows of both surfaces side by side, and the numbers that terms estimate from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, constant, is_concrete, numpy_for
from mcgicp_jax._compute.row_functions import Input, Rows, whole
from mcgicp_jax._local_geometry.local_geometry import Surface, SurfaceNoise
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.poses import rotated, rotation_from_quaternion
from mcgicp_jax._math.statistics import sampled_rows
from mcgicp_jax._methods.surfaces import NOISE, SEARCH, SURFACE, AnySurface, input_of
from mcgicp_jax._search.base import Correspondences, SearchPoints
from mcgicp_jax._terms.base import AbstractAdaptiveTerm, AbstractTerm, Linearization, PosedMatches, linearize


class Motion(NamedTuple):
    """T_target_source as a rotation matrix and a translation vector, metres."""

    rotation: Float[AnyArray, "3 3"]
    translation: Float[AnyArray, "3"]

    @staticmethod
    def of(parameters: Float[AnyArray, "7"]) -> Motion:
        """The motion of a pose `jaxlie.SE3.wxyz_xyz`, in its precision."""
        dtype = parameters.dtype
        if is_concrete(parameters):
            wxyz = np.asarray(parameters[:4], np.float64)
            return Motion(rotation_from_quaternion(wxyz).astype(dtype), np.asarray(parameters[4:]))
        return Motion(jaxlie.SO3(parameters[:4]).as_matrix().astype(dtype), parameters[4:])

    def move(self, points: Float[AnyArray, "n 3"]) -> Float[AnyArray, "3 n"]:
        if isinstance(self.rotation, np.ndarray) and isinstance(points, np.ndarray):
            return (rotated(points, self.rotation) + self.translation).T
        return jnp.dot(self.rotation, jnp.asarray(points).T, precision="highest") + self.translation[:, None]


class Matches(NamedTuple):
    """Candidates in the target for n source points.

    Attributes:
        indices: target rows of the m candidates; −1 where there is none, or a point does not count.
        max_distance: metres; applied when the matches are used, so that they may follow a pose.
        rows: the source points among all rows; None for all of them.
        temperature: of a soft assignment, metres; None without one.
    """

    indices: Int[AnyArray, "m n"]
    max_distance: Float[AnyScalar, ""]
    rows: Any = None
    temperature: Any = None

    @staticmethod
    def of(
        source: SearchPoints,
        target: SearchPoints,
        indices: Int[AnyArray, "m n"],
        max_distance: Float[AnyScalar, ""],
        rows: Any = None,
    ) -> Matches:
        """Matches found by a search, without those of padding."""
        xp = numpy_for(source, target, indices)
        valid = (indices >= 0) & source.valid & xp.asarray(target.valid)[xp.maximum(indices, 0)]
        return Matches(xp.where(valid, indices, -1), max_distance, rows)

    @staticmethod
    def given(matches: Correspondences, temperature: Any = None) -> Matches:
        """Matches that do not change with the pose."""
        xp = numpy_for(matches)
        indices = xp.where(xp.asarray(matches.valid), xp.asarray(matches.indices), -1)
        infinite = np.asarray(np.inf, matches.distances.dtype)
        return Matches(indices.reshape(-1, indices.shape[-1]), infinite, temperature=temperature)

    def some(self, rows: Int[AnyArray, "n"]) -> Matches:
        return self._replace(indices=self.indices[:, rows], rows=rows if self.rows is None else self.rows[rows])


class Matched(eqx.Module):
    """Both sides of n correspondences; n = m N for m candidates of N source points.

    Attributes:
        source, target: rows of the surfaces; the first candidates of all source points come first.
        valid: (n,) False for correspondences to ignore.
        descriptor_distances: (n,) squared distances of descriptors α · channel, with the penalties for missing
            channels, metres²; only for soft assignment.
        temperature: of the soft assignment, metres; None otherwise.
        num_candidates: m.
    """

    source: Surface
    target: Surface
    valid: Bool[AnyArray, "n"]
    descriptor_distances: Float[AnyArray, "n"] | None = None
    temperature: Float[AnyScalar, ""] | None = None
    num_candidates: int = eqx.field(static=True, default=1)

    def at(self, motion: Motion) -> PosedMatches:
        moved = motion.move(self.source.points)
        return PosedMatches(self.source, self.target, moved, motion.rotation, self.valid)


def match_surfaces(source: Surface, target: Surface, matches: Matches) -> Matched:
    """Gather the matched rows of both surfaces, for their derivative; pure JAX."""
    # Points without a match are filled with the rows of other matches in turn, see `whole`.
    indices = jnp.asarray(matches.indices).reshape(-1)
    (matched,) = jnp.nonzero(indices >= 0, size=indices.size)
    others = indices[matched[jnp.arange(indices.size) % jnp.maximum(jnp.sum(indices >= 0), 1)]]
    filled = jnp.where(indices >= 0, indices, others).reshape(matches.indices.shape)
    rows = list(map(whole, inputs_of(source, target, matches._replace(indices=filled))))
    rows[1::2] = [part._replace(index=matches.indices) for part in rows[1::2]]
    return matched_rows(rows, matches.temperature)


def inputs_of(
    source: AnySurface, target: AnySurface, matches: Matches, with_noise: bool = False, with_search: bool = False
) -> list[Input]:
    """The surfaces of matched points as inputs of a row function, for `matched_rows`."""
    with_search = with_search or matches.temperature is not None
    parts = [SURFACE] + [NOISE] * with_noise + [SEARCH] * with_search
    sides = (source, matches.rows), (target, matches.indices.T)
    return [input_of(surface, part, rows) for part in parts for surface, rows in sides]


@cache
def of_matches(function: Callable[..., Any], total: bool = True) -> Callable[..., Any]:
    """A function of a motion, `Matched` and others as a row function of `inputs_of`: a sum, or one tree of rows."""

    def of_rows(numbers: tuple[Motion, Any, Any, tuple[Any, ...]], *rows: Rows) -> Any:
        motion, max_distance, temperature, arguments = numbers
        matched = matched_rows(rows, temperature)
        _, near = distances_within(motion.move(matched.source.points), matched.target.points, max_distance)
        result = function(motion, replace(matched, valid=matched.valid & near), *arguments)
        return result if total else (result,)

    of_rows.__name__ = function.__name__
    return of_rows


def matched_rows(rows: Sequence[Rows], temperature: Float[AnyScalar, ""] | None = None) -> Matched:
    """Matches from rows gathered from `inputs_of`; the index in the target is −1 for correspondences to ignore."""
    index = rows[1].index
    count = len(index) if index.ndim == 2 else 1
    # Each source point once for each of its candidates.
    repeated, candidates = [part.tree for part in rows[::2]], [part.tree for part in rows[1::2]]
    repeated = jax.tree.map(lambda leaf: jnp.tile(leaf, (count, *[1] * (leaf.ndim - 1))), repeated)
    candidates = jax.tree.map(lambda leaf: leaf.reshape(index.size, *leaf.shape[index.ndim :]), candidates)
    source, target = (
        surface._replace(**{"noise" if isinstance(part, SurfaceNoise) else "search": part for part in parts})
        for surface, *parts in (repeated, candidates)
    )
    descriptor_distances = None
    if temperature is not None:
        square = (source.search.descriptors - target.search.descriptors) ** 2
        for penalty in (source.search.penalty, target.search.penalty):
            if penalty is not None:
                square = jnp.where(penalty > 0, penalty, square)
        descriptor_distances = jnp.sum(square, axis=-1)
        source, target = source._replace(search=None), target._replace(search=None)
    return Matched(source, target, index.reshape(-1) >= 0, descriptor_distances, temperature, count)


def distances_within(
    moved: Float[Array, "3 n"], target: Float[Array, "n 3"], max_distance: Float[Array, ""]
) -> tuple[Float[Array, "n"], Bool[Array, "n"]]:
    """Distance of each match in position, and whether it is at most `max_distance`, metres. Channels do not count."""
    residual = target.T - moved
    distances = jnp.sqrt(alg.inner(residual, residual))
    return distances, distances <= max_distance


def linearize_at(
    motion: Motion, matched: Matched, terms: tuple[AbstractTerm, ...]
) -> tuple[PosedMatches, Linearization, Float[Array, "n"]]:
    """The matches at a pose, the sum of the terms, and soft-assignment weights (1 for valid, 0 for invalid matches)."""
    posed = matched.at(motion)
    total = linearize(terms, posed)
    counts = jnp.asarray(matched.valid).astype(posed.moved.dtype)
    if matched.temperature is not None and matched.descriptor_distances is not None:
        square = alg.inner(total.residual, total.residual) + matched.descriptor_distances
        shape = (matched.num_candidates, -1)
        # Softmax over the valid candidates of each source point.
        logits, valid = (-0.5 * square / matched.temperature**2).reshape(shape), matched.valid.reshape(shape)
        highest = jax.lax.stop_gradient(jnp.max(jnp.where(valid, logits, -jnp.inf), axis=0))
        shifted = jnp.where(valid, logits - jnp.where(jnp.isfinite(highest), highest, 0), 0)
        counts = normalized(jnp.where(valid, jnp.exp(shifted), 0))
    return posed, total.scaled(counts), counts


def normalized(weights: Float[Array, "m N"]) -> Float[Array, "n"]:
    """The weights of the candidates of each source point, divided by their sum; 0 for points without any."""
    total = jnp.sum(weights, axis=0)
    return (weights / jnp.where(total > 0, total, 1)).reshape(-1)


def adapted(
    terms: tuple[AbstractTerm, ...],
    valid: Bool[AnyArray, "N"],
    sample: Callable[[AbstractAdaptiveTerm, Int[AnyArray, "n"]], Any],
) -> tuple[AbstractTerm, ...]:
    """The terms with numbers estimated, constants to autodiff; `sample` is `sample_of_term` for some source points."""
    rows, counts = sampled_rows(valid)
    xp = numpy_for(counts, valid)
    fraction = xp.sum(counts) / xp.maximum(xp.sum(valid), 1)

    def without_padding(column: Float[AnyArray, "n *_"]) -> Float[AnyArray, "n *_"]:
        mask = counts.reshape(-1, *[1] * (column.ndim - 1))
        return numpy_for(column, counts).where(mask, column, np.asarray(np.nan, column.dtype))

    # Huge coordinates or channels lead to the status NON_FINITE; NumPy need not warn of them.
    with np.errstate(over="ignore", invalid="ignore"):
        return tuple(
            constant(term.adapt(jax.tree.map(without_padding, sample(term, rows)), fraction))
            if isinstance(term, AbstractAdaptiveTerm)
            else term
            for term in terms
        )


def sample_of_term(motion: Motion, matched: Matched, term: AbstractAdaptiveTerm) -> Any:
    return term.sample(matched.at(motion))
