"""Which directions of motion constrain a pose: for the loop, and in words for people.

Inside, twists ξ = (v, ω) turn about the centroid of the matched points, in the target's frame, and their lengths are in
units of the points' radius.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from mcgicp_jax._solve import adjoint_to_source, twist_form, units
from mcgicp_jax._sums import Sums

# Shares of the points' motion below which a direction is not held. The geometry of flat scenes (posters on a wall, a
# road, a table with 2 mm noise) came to less than 0.0016, that of others to 0.1 and more; GICP's fake pull within the
# surface is as strong as a true share of ε, 0.001 by default. Noise alone made 0.003 of the channels, the markings of
# a road 0.008 and more.
GEOMETRY_HOLDS, CHANNELS_HOLD = 2e-3, 5e-3
_IDENTITY = np.array([1, 0, 0, 1, 0, 1])
# A direction counts as a translation where turning moves its points less than this share of what moves them in all.
_PURE = 0.3


class Directions(eqx.Module):
    """Six directions in which a pose could move, and by what each is held.

    Attributes:
        twists: (6, 6), a direction in each row, scaled so that the matched points move by 1 (root mean square).
        geometry: (6,) share of that motion that the shape of the surfaces holds.
        channels: (6,) share that the channels hold; told for the directions that geometry leaves free, 0 for others.
        center: (3,) centroid of the matched source points, metres.
        radius: their root mean square distance from it, metres.
    """

    twists: Float[Array, "*batch 6 6"] | Float[np.ndarray, "*batch 6 6"]
    geometry: Float[Array, "*batch 6"] | Float[np.ndarray, "*batch 6"]
    channels: Float[Array, "*batch 6"] | Float[np.ndarray, "*batch 6"]
    center: Float[Array, "*batch 3"] | Float[np.ndarray, "*batch 3"]
    radius: Float[ArrayLike, "*batch"]

    @property
    def free(self) -> Bool[Array, "*batch 6"] | Bool[np.ndarray, "*batch 6"]:
        """Whether geometry leaves the direction free."""
        return ~(self.geometry >= GEOMETRY_HOLDS)

    @property
    def held(self) -> Bool[Array, "*batch 6"] | Bool[np.ndarray, "*batch 6"]:
        """Whether anything holds the direction: geometry, or else the channels."""
        return ~self.free | (self.channels >= CHANNELS_HOLD)


def find_directions(sums: Sums) -> Directions:
    """Eigenvectors of the fraction of the points' motion that shows in the geometry; where none does, in the channels.

    A fraction of motion knows no unit: metres and radians, or another origin, change nothing.
    """
    center, radius, observed = sums.center, sums.radius, sums.observability
    total = jnp.where(sums.mass[9] > 0, sums.mass[9], 1)
    motion = twist_form(jnp.outer(_IDENTITY.astype(total.dtype), sums.mass / total), radius)
    geometry = twist_form(observed[0] / total, radius)
    # One decomposition waits for the other: two batched LAPACK calls at once can dead-lock XLA's thread pool.
    # Points on a line do not move when they turn about it: what does not move is not held.
    values, vectors = jnp.linalg.eigh(motion)
    floor = 1e-5 * jnp.max(values)
    basis = vectors / jnp.sqrt(jnp.maximum(values, jnp.where(floor > 0, floor, 1)))
    shares, turn = jnp.linalg.eigh(basis.T @ geometry @ basis)
    basis = basis @ turn
    free = ~(shares >= GEOMETRY_HOLDS)
    if len(observed) == 1:
        channels = jnp.zeros_like(shares)
        return Directions(twists=basis.T, geometry=shares, channels=channels, center=center, radius=radius)
    # Among the free directions, those that the channels tell apart; 2, beyond any share, keeps the others aside.
    among = jnp.outer(free, free)
    channels = jnp.where(among, basis.T @ twist_form(observed[1] / total, radius) @ basis, jnp.diag(2.0 * ~free))
    held, turn = jnp.linalg.eigh(channels)
    basis = basis @ turn
    shares = jnp.sum(basis * (geometry @ basis), axis=0)
    channels = jnp.where(held > 1.5, 0, held)
    return Directions(twists=basis.T, geometry=shares, channels=channels, center=center, radius=radius)


def directions_at_source(directions: Directions, pose: jaxlie.SE3) -> Directions:
    """With twists ξ of T exp(ξ), metres and radians, that move the points by 1 m (root mean square)."""
    center, radius = jnp.asarray(directions.center), jnp.asarray(directions.radius)
    change = adjoint_to_source(pose, center) * units(radius) / radius
    center = pose.inverse() @ center
    return eqx.tree_at(lambda d: (d.twists, d.center), directions, (directions.twists @ change.T, center))


@dataclass(frozen=True, eq=False)
class FreeDirection:
    """A motion that the shape of the clouds allows.

    Attributes:
        twist: (6,) ξ = (v, ω) of T exp(ξ), metres and radians, scaled so that the matched points move by 1 m (root mean
            square).
        held_by_channels: whether the channels hold it; if not, nothing does.
        axis: (3,) unit vector, in the source's frame: along it for a translation, about it for a rotation.
        is_rotation: which of the two; a free direction that is neither alone is called by its larger part.
    """

    twist: Float[np.ndarray, "6"]
    held_by_channels: bool
    axis: Float[np.ndarray, "3"]
    is_rotation: bool

    def __repr__(self) -> str:
        held = "held by the channels" if self.held_by_channels else "held by nothing"
        return f"{self.name} ({held})"

    @property
    def name(self) -> str:
        """Such as "translation along (1, 0, 0)"."""
        axis = self.axis * np.sign(self.axis[np.argmax(np.abs(self.axis))])
        x, y, z = np.round(axis, 2) + 0.0
        return f"{'rotation about' if self.is_rotation else 'translation along'} ({x:g}, {y:g}, {z:g})"


def free_directions(directions: Directions) -> tuple[FreeDirection, ...]:
    """Of a single registration: those that nothing holds before those that the channels do, translations first."""
    free, held = np.asarray(directions.free), np.asarray(directions.held)
    motions = _motions(directions)
    found: list[FreeDirection] = []
    for by_channels in (False, True):
        group = motions[free & (held == by_channels)]
        found += [_named(motion, directions, by_channels) for motion in _separate(group) @ group]
    return tuple(found)


def shares(directions: Directions) -> list[tuple[str, float, float]]:
    """Name, share of geometry and share of the channels of six directions: the free ones first."""
    free, motions = np.asarray(directions.free), _motions(directions)
    geometry, channels = np.asarray(directions.geometry), np.asarray(directions.channels)
    found: list[tuple[str, float, float]] = []
    for group in (free, ~free):
        mixing = _separate(motions[group])
        names = [_named(motion, directions, False).name for motion in mixing @ motions[group]]
        # The shares are eigenvalues, and the mixing is orthogonal.
        found += zip(names, mixing**2 @ geometry[group], mixing**2 @ channels[group], strict=True)
    return [(name, float(by_geometry), float(by_channels)) for name, by_geometry, by_channels in found]


def _motions(directions: Directions) -> Float[np.ndarray, "6 6"]:
    """How the points move, root mean square: with their centroid, and by turning about it."""
    twists = np.asarray(directions.twists, np.float64)
    center, radius = np.asarray(directions.center, np.float64), np.asarray(directions.radius)
    return np.concatenate([twists[:, :3] + np.cross(twists[:, 3:], center), radius * twists[:, 3:]], axis=1)


def _named(motion: Float[np.ndarray, "6"], directions: Directions, by_channels: bool) -> FreeDirection:
    center, radius = np.asarray(directions.center, np.float64), np.asarray(directions.radius)
    turning = np.linalg.norm(motion[3:]) > _PURE * np.linalg.norm(motion)
    axis, omega = motion[3:] if turning else motion[:3], motion[3:] / radius
    return FreeDirection(
        twist=np.concatenate([motion[:3] - np.cross(omega, center), omega]),
        held_by_channels=by_channels,
        axis=axis / np.linalg.norm(axis),
        is_rotation=bool(turning),
    )


def _separate(motions: Float[np.ndarray, "m 6"]) -> Float[np.ndarray, "m m"]:
    """How to mix motions so that translations come first, along the axes of the frame as far as there is a choice.

    Orthogonal, since the motions are, in the mean motion of the points.
    """
    if not len(motions):
        return np.zeros((0, 0))
    mixing = np.linalg.svd(motions[:, 3:])[0].T[::-1]
    ordered = mixing @ motions
    flat = np.linalg.norm(ordered[:, 3:], axis=1) <= _PURE * np.linalg.norm(ordered, axis=1)
    if flat.sum() == 2:
        axis = np.argmax(np.linalg.norm(ordered[flat, :3], axis=0))
        cosine, sine = ordered[flat, axis] / np.linalg.norm(ordered[flat, axis])
        mixing[flat] = np.array([[cosine, sine], [-sine, cosine]]) @ mixing[flat]
    return mixing


def describe(found: Sequence[FreeDirection]) -> str:
    """All of them, and what holds which; empty if there are none."""
    if not found:
        return ""
    held = [direction for direction in found if direction.held_by_channels]
    everything = ", ".join(direction.name for direction in found)
    if not held:
        verdict = "held by nothing"
    elif len(held) == len(found):
        verdict = "held by the channels: all"
    else:
        verdict = "held by the channels: " + ", ".join(direction.name for direction in held)
    return f"{everything}; {verdict}"
