"""Constrained and unconstrained directions of motion of a pose, for the loop and as text.

In the loop, twists ξ = (v, ω) turn about the centroid of the matched points, in the target's frame, with lengths in
units of the radius of the matched points (`Sums.radius`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from mcgicp_jax._compute.concrete import AnyArray
from mcgicp_jax._math.poses import adjoint_to_source, units
from mcgicp_jax._pose_solver.sums import Sums
from mcgicp_jax._pose_solver.update import twist_form

# Smallest observed fraction of the points' squared motion for a direction to count as constrained. Geometry: measured
# below 0.0016 in flat scenes (posters on a wall, a road, a table with 2 mm noise) and from 0.1 on in others; GICP's
# artificial in-plane stiffness equals a true fraction of ε, 0.001 by default. Channels: 0.003 from noise alone, from
# 0.008 on with the markings of a road.
LEAST_BY_GEOMETRY, LEAST_BY_CHANNELS = 2e-3, 5e-3
# At right poses, the slopes of the channels at matched points agree to at least 0.7 of what each cloud observes (walls
# and tables); at poses 0.2 to 0.4 m off, on walls and a road, to 0.3 at most.
_AGREE = 0.5
# Surplus of gradients across the lines of sight, over their agreement, below which a sensor carries the pattern along.
# A texture whose gradients all have the direction of the motion x has at least −1/64, the minimum of
# (t·x)⁴ − (t·x)² / 4. Tables had at least 0.04, posters and corridors 0.15, a bare road at the pose of no motion at
# most −0.13, in voxels of up to 0.1 m; in voxels of 0.2 m, which mix the beams, 0.
_PATTERN = -1 / 16
# Smallest information of tie points and prior for a direction to count as constrained: a standard deviation of one
# radius of the matched points. Useful tie points and priors are far above it.
_LEAST_BY_TIES = 1.0
_IDENTITY = np.array([1, 0, 0, 1, 0, 1])
# A direction is named a translation if its rotation causes at most this fraction of the points' motion (rms).
_PURE = 0.3


class Directions(eqx.Module):
    """Six directions of motion of a pose, and how well geometry and channels observe each.

    Attributes:
        twists: (6, 6), one direction per row, scaled so that the matched points move by 1 (root mean square).
        geometry: (6,) fraction of that squared motion that the shape of the surfaces observes, 0 to 1; slightly
            negative where it is less than what noise, or cells, observe on average.
        channels: (6,) fraction that the channels observe; 0 for the directions that geometry constrains, negative where
            the channels of matched points do not agree.
        ties: (6,) information of tie points and prior, one over the squared standard deviation in radii of that motion;
            0 for the directions that geometry or channels constrain, infinite for those that the prior fixes. None
            without tie points and prior.
        center: (3,) centroid of the matched source points, metres.
        radius: root mean square distance of these points from it, metres.
    """

    twists: Float[AnyArray, "*batch 6 6"]
    geometry: Float[AnyArray, "*batch 6"]
    channels: Float[AnyArray, "*batch 6"]
    center: Float[AnyArray, "*batch 3"]
    radius: Float[ArrayLike, "*batch"]
    ties: Float[AnyArray, "*batch 6"] | None = None

    @property
    def free(self) -> Bool[AnyArray, "*batch 6"]:
        """Which directions geometry does not constrain."""
        return ~(self.geometry >= LEAST_BY_GEOMETRY)

    @property
    def fixed(self) -> Bool[AnyArray, "*batch 6"]:
        """Which directions the prior fixes."""
        return (0 * self.geometry if self.ties is None else self.ties) == np.inf

    @property
    def constrained_by_channels(self) -> Bool[AnyArray, "*batch 6"]:
        """Which directions are constrained by the channels alone; not those that are fixed."""
        return self.free & (self.channels >= LEAST_BY_CHANNELS) & ~self.fixed

    @property
    def constrained_by_matches(self) -> Bool[AnyArray, "*batch 6"]:
        """Which directions are constrained by geometry or by the channels; not those that are fixed."""
        return (~self.free & ~self.fixed) | self.constrained_by_channels

    @property
    def constrained(self) -> Bool[AnyArray, "*batch 6"]:
        """Which directions are constrained, by geometry, by the channels, or by tie points and prior."""
        by_matches = self.constrained_by_matches
        return by_matches if self.ties is None else by_matches | (self.ties >= _LEAST_BY_TIES)


def find_directions(sums: Sums, constraints: Float[Array, "6 6"] | None = None) -> Directions:
    """Eigenvectors of the observed fraction of the points' motion: by the geometry, and among the directions that
    geometry does not constrain, by the channels. Fractions do not depend on units or on the origin.

    Args:
        constraints: rows that are orthogonal to the free twists, and rows of zeros. Eigenvectors are those within the
            free twists; the other directions are fixed. None if all are free.
    """
    if sums.mass is None or sums.observability is None or sums.common is None:
        raise ValueError("sums: expected those of surfaces with observability")
    center, radius = sums.center, sums.radius
    total = jnp.where(sums.mass[3, 3] > 0, sums.mass[3, 3], 1)
    motion = twist_form(_IDENTITY.astype(total.dtype)[:, None, None] * (sums.mass / total), radius)
    geometry, common = (twist_form(moments / total, radius) for moments in (sums.observability, sums.common))
    # Each decomposition needs the result of the last: concurrent batched LAPACK calls can deadlock XLA's thread pool.
    # The floor: points on a line do not move when they turn about it, so that rotation is not observed.
    values, vectors = jnp.linalg.eigh(motion)
    floor = 1e-5 * jnp.max(values)
    basis = vectors / jnp.sqrt(jnp.maximum(values, jnp.where(floor > 0, floor, 1)))
    ties, fixed = None, jnp.zeros(6, bool)
    if constraints is not None:
        rows = constraints @ basis
        sizes = jnp.linalg.norm(rows, axis=1, keepdims=True)
        rows = rows / jnp.where(sizes > 0, sizes, 1)
        basis = basis @ jnp.linalg.eigh(rows.T @ rows)[1]
        fixed = jnp.arange(6) >= 6 - jnp.sum(sizes > 0)
        ties = jnp.where(fixed, jnp.inf, 0)
    # 2 and 3, above any fraction, sort the other directions last.
    moving = jnp.outer(~fixed, ~fixed)
    basis = basis @ jnp.linalg.eigh(jnp.where(moving, basis.T @ geometry @ basis, jnp.diag(2.0 * fixed)))[1]
    # The directions stay those along which the pose was updated; geometry constrains what both clouds observe.
    # bᵀ F b for each column b of the basis and both forms F.
    by_geometry = jnp.minimum(*(jnp.sum(basis * (form @ basis), axis=0) for form in (geometry, common)))
    channels = jnp.zeros_like(by_geometry)
    if sums.channel_observability is not None and sums.agreement is not None and sums.surplus is not None:
        # Diagonalise the channels within the free directions.
        free = ~(by_geometry >= LEAST_BY_GEOMETRY) & ~fixed
        within = basis.T @ twist_form(sums.channel_observability / total, radius) @ basis
        observed, turn = jnp.linalg.eigh(jnp.where(jnp.outer(free, free), within, jnp.diag(2.0 * ~free + fixed)))
        basis = basis @ turn
        forms = geometry, common, *(twist_form(moments / total, radius) for moments in (sums.agreement, sums.surplus))
        by_mean, by_common, agreed, surplus = (jnp.sum(basis * (form @ basis), axis=0) for form in forms)
        by_geometry = jnp.minimum(by_mean, by_common)
        agreed = jnp.where(surplus < _PATTERN * agreed, 0, agreed)
        channels = jnp.where((observed > 0) & (agreed < _AGREE * observed), agreed - _AGREE * observed, observed)
        channels = jnp.where(observed > 1.5, 0, channels)
    return Directions(basis.T, by_geometry, channels, center, radius, ties)


def directions_at_source(directions: Directions, pose: jaxlie.SE3) -> Directions:
    """The directions as twists ξ of T exp(ξ), metres and radians, that move the matched points by 1 m (rms)."""
    center, radius = jnp.asarray(directions.center), jnp.asarray(directions.radius)
    change = adjoint_to_source(pose, center) * units(radius) / radius
    return replace(directions, twists=directions.twists @ change.T, center=pose.inverse() @ center)


@dataclass(frozen=True, eq=False)
class UnconstrainedDirection:
    """A direction of motion that the shape of the clouds does not constrain.

    Attributes:
        twist: (6,) ξ = (v, ω) of T exp(ξ), metres and radians, scaled so that the matched points move by 1 m (root mean
            square).
        constrained_by_channels: whether the channels constrain the direction.
        constrained_by_ties: whether tie points or a prior do. If neither is True, the direction is unconstrained.
        axis: (3,) unit vector in the source's frame: direction of the translation, or axis of the rotation.
        is_rotation: False if the direction is named a translation: rotation causes at most 0.3 of the points' motion.
    """

    twist: Float[np.ndarray, "6"]
    constrained_by_channels: bool
    axis: Float[np.ndarray, "3"]
    is_rotation: bool
    constrained_by_ties: bool = False

    def __repr__(self) -> str:
        by_ties = "constrained by tie points or prior" if self.constrained_by_ties else "unconstrained"
        reason = "constrained by channels" if self.constrained_by_channels else by_ties
        return f"{self.name} ({reason})"

    @property
    def name(self) -> str:
        """For instance "translation along (1, 0, 0)"; the axis in the source's frame."""
        axis = self.axis * np.sign(self.axis[np.argmax(np.abs(self.axis))])
        x, y, z = np.round(axis, 2) + 0.0
        return f"{'rotation about' if self.is_rotation else 'translation along'} ({x:g}, {y:g}, {z:g})"


def unconstrained_directions(directions: Directions) -> tuple[UnconstrainedDirection, ...]:
    """Directions that geometry does not constrain: unconstrained ones first, translations before rotations."""
    masks = directions.free, directions.constrained, directions.constrained_by_matches
    free, constrained, by_matches = map(np.asarray, masks)
    twists, center = (np.asarray(array, np.float64) for array in (directions.twists, directions.center))
    radius = np.asarray(directions.radius)
    # Motion of the centroid, and by rotation about it, both in metres of rms motion.
    motions = np.concatenate([twists[:, :3] + np.cross(twists[:, 3:], center), radius * twists[:, 3:]], axis=1)
    unconstrained: list[UnconstrainedDirection] = []
    for by_channels, by_ties in ((False, False), (False, True), (True, False)):
        group = motions[free & (by_matches == by_channels) & ((constrained & ~by_matches) == by_ties)]
        if not len(group):
            continue
        # An orthogonal matrix mixes motions so that translations come first, along coordinate axes where possible.
        # Motions stay orthogonal in the mean motion of the points.
        mixing = np.linalg.svd(group[:, 3:])[0].T[::-1]
        ordered = mixing @ group
        flat = np.linalg.norm(ordered[:, 3:], axis=1) <= _PURE * np.linalg.norm(ordered, axis=1)
        if flat.sum() == 2:
            along = np.argmax(np.linalg.norm(ordered[flat, :3], axis=0))
            cosine, sine = ordered[flat, along] / np.linalg.norm(ordered[flat, along])
            mixing[flat] = np.array([[cosine, sine], [-sine, cosine]]) @ mixing[flat]
        for motion in mixing @ group:
            turning = bool(np.linalg.norm(motion[3:]) > _PURE * np.linalg.norm(motion))
            axis, omega = motion[3:] if turning else motion[:3], motion[3:] / radius
            twist, axis = np.concatenate([motion[:3] - np.cross(omega, center), omega]), axis / np.linalg.norm(axis)
            unconstrained.append(UnconstrainedDirection(twist, by_channels, axis, turning, by_ties))
    return tuple(unconstrained)


def as_text(directions: Sequence[UnconstrainedDirection]) -> str:
    """The names of free directions and which of them the channels constrain; "" if there are none."""
    if not directions:
        return ""
    names = ", ".join(direction.name for direction in directions)
    by_channels = ", ".join(direction.name for direction in directions if direction.constrained_by_channels)
    by_ties = ", ".join(direction.name for direction in directions if direction.constrained_by_ties)
    verdict = "all" if by_channels == names else by_channels or "none"
    return f"{names}; constrained by channels: {verdict}{'; by tie points or prior: ' if by_ties else ''}{by_ties}"
