"""Compiled programs of `PoseDerivative` over blocks of rows, and over the few numbers of a pose."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mcgicp_jax._compute.packing import Packed
from mcgicp_jax._compute.quick_compilation import quickly_compiled
from mcgicp_jax._local_geometry.local_geometry import LocalGeometry, describe
from mcgicp_jax._local_geometry.neighborhoods import Neighborhoods
from mcgicp_jax._local_geometry.surface import Surface
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._methods.surfaces import Kinds, search_numbers, search_rows, surface_of
from mcgicp_jax._pose_solver.implicit_derivative import ImplicitRoot, balance_along, score_at, value_and_jacobian
from mcgicp_jax._pose_solver.matched import Matched, Motion, square_apart
from mcgicp_jax._pose_solver.pose_measurements import Fusion, PoseForm
from mcgicp_jax._search.base import SearchPoints
from mcgicp_jax._terms.base import AbstractTerm

# The terms, and the temperature of a soft assignment or None.
Parameters = tuple[tuple[AbstractTerm, ...], Any]


class Columns(NamedTuple):
    """The values of the rows of a cloud that a pose depends on; the input of the search for a soft assignment only."""

    surface: Surface
    search: SearchPoints | None

    @staticmethod
    def of(surface: Surface, search: SearchPoints | None) -> Columns:
        surface = surface._replace(observability=None, channel_observability=None, noise=None, search=None)
        # A mask is no number, and positions are in the surface already.
        return Columns(surface, None if search is None else search._replace(points=None, valid=None))


class Block(NamedTuple):
    """A block of n matched rows with m candidates each, (n, L) and (m, n, L), and which matches count."""

    source: Packed[Columns]
    target: Packed[Columns]
    valid: Bool[Any, "m n"]


def _matched(block: Block, temperature: Any) -> Matched:
    count = len(block.valid)
    source = replace(block.source, table=jnp.tile(block.source.table, (count, 1))).tree
    target = replace(block.target, table=block.target.table.reshape(block.valid.size, -1)).tree
    apart = None
    if source.search is not None and target.search is not None:
        apart = square_apart(source.search, target.search)
    return Matched(source.surface, target.surface, block.valid.reshape(-1), apart, temperature, count)


@quickly_compiled
def score_and_pull(
    parameters: Parameters, root: ImplicitRoot, motion: Motion, block: Block
) -> tuple[Float[Array, "6"], tuple[Motion, Float[Array, "6 n L"], Float[Array, "6 m n K"], Any]]:
    """g of a block, and the derivatives of its six numbers by the motion, by the matched rows of both clouds, and by
    the numbers of the parameters. One program for all of them, since it takes half as long to compile as two."""
    numbers, rest = eqx.partition(parameters, eqx.is_inexact_array)

    def score(motion: Motion, source: Array, target: Array, numbers: Any) -> Float[Array, "6"]:
        terms, temperature = eqx.combine(numbers, rest)
        moved = Block(replace(block.source, table=source), replace(block.target, table=target), block.valid)
        return score_at(motion, root, _matched(moved, temperature), terms)

    with jax.default_matmul_precision("highest"):
        found, pull = jax.vjp(score, motion, block.source.table, block.target.table, numbers)
        return found, jax.vmap(pull)(jnp.eye(6, dtype=found.dtype))


@quickly_compiled
def balance_and_slope(
    pose: Float[Array, "7"], root: ImplicitRoot, fusion: Fusion, known: Float[Array, "6 7"]
) -> Float[Array, "6 7"]:
    """The equation with tie points and a prior, and its derivative by a twist.

    Args:
        known: g of all blocks without these, and its derivative by a twist.
    """
    with jax.default_matmul_precision("highest"):
        value, slope = value_and_jacobian(
            lambda twist: balance_along(twist, pose, root, known[:, 0] + known[:, 1:] @ twist, fusion),
            jnp.zeros_like(pose[:6]),
        )
        return jnp.concatenate([value[:, None], slope], axis=1)


@quickly_compiled
def pull_balance(
    pose: Float[Array, "7"], root: ImplicitRoot, fusion: Fusion, cotangents: Float[Array, "m 6"]
) -> tuple[Float[Array, "m 6"], PoseForm]:
    """Cotangents of the score and of the form of tie points and prior, from those of the equation."""

    def balance(score: Float[Array, "6"], form: PoseForm) -> Float[Array, "6"]:
        nowhere = jnp.zeros_like(score)
        return balance_along(nowhere, pose, root, score, eqx.tree_at(lambda fusion: fusion.form, fusion, form))

    with jax.default_matmul_precision("highest"):
        # The equation is linear in the score.
        _, pull = jax.vjp(balance, jnp.zeros_like(pose[:6]), fusion.form)
        return jax.vmap(pull)(cotangents)


class Moving(NamedTuple):
    """The arrays of a block that differentiation moves; None for the others."""

    own: Any
    near: Any
    own_channels: Any
    near_channels: Any
    given: Any
    numbers: Any


@partial(quickly_compiled, static_argnums=(0, 1))
def pull_surface(
    kinds: Kinds,
    fields: tuple[str, ...],
    method: AbstractMethod,
    around: Neighborhoods,
    local: Packed[LocalGeometry] | None,
    masks: tuple[Any, Any] | None,
    cotangents: Float[Array, "n k L"],
) -> tuple[Any, Any, Any, Any]:
    """Cotangents of the inputs of `surface_of` from those of the packed `Columns`.

    Args:
        fields: of a `PointCloud`, or "method".
        around: the neighbourhoods of the rows, with their channels even where there are no neighbours.
        local: of the rows; None if there are no neighbours, and if points are in `fields`, on which it depends.
        masks: `channel_valid` and `valid` of the rows for a soft assignment; None otherwise.

    Returns:
        Of the points themselves (n, k w) and of their q neighbours (q, n, k w), for w = 3 + C positions and channels or
        those of them that are in `fields`; of given covariances (k, n, 3, 3); of the numbers of the method, (k, ...).
        None for what is not in `fields`.
    """
    numbers, rest = eqx.partition(method, eqx.is_inexact_array)
    points, channels = "points" in fields, "channels" in fields and around.num_channels > 0
    moving = Moving(
        around.own if points else None,
        around.near if points else None,
        around.own_channels if channels else None,
        around.near_channels if channels else None,
        around.given if "covariances" in fields else None,
        numbers if "method" in fields else None,
    )

    def rows(moving: Moving) -> Float[Array, "n L"]:
        names = ("own", "near", "own_channels", "near_channels", "given")
        here = around._replace(**{name: getattr(moving, name) for name in names if getattr(moving, name) is not None})
        used = method if moving.numbers is None else eqx.combine(moving.numbers, rest)
        geometry = None if here.near is None else describe(here) if local is None else local.tree
        surface = surface_of(used, kinds, here, geometry, False)
        search = None
        if masks is not None:
            channels = here.own_channels.T
            search = search_rows(*search_numbers(used, channels, masks[0]), here.own.T, channels, *masks)
        return Packed.of(Columns.of(surface, search)).table

    _, pull = jax.vjp(rows, moving)
    (found,) = jax.vmap(pull, in_axes=1)(cotangents)
    own = [each.transpose(2, 0, 1) for each in (found.own, found.own_channels) if each is not None]
    near = [each.transpose(2, 3, 0, 1) for each in (found.near, found.near_channels) if each is not None]

    def side_by_side(parts: list[Array]) -> Any:
        if not parts:
            return None
        whole = jnp.concatenate(parts, axis=-1)
        return whole.reshape(*whole.shape[:-2], -1)

    return side_by_side(own), side_by_side(near), found.given, found.numbers
