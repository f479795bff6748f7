"""Free directions for people: which motions they are, and in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mcgicp_jax._uncertainty import Directions

# A direction counts as a translation where turning moves its points less than this share of what moves them in all.
_PURE = 0.3


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
        return f"{self._motion()} ({held})"

    def _motion(self) -> str:
        axis = self.axis * np.sign(self.axis[np.argmax(np.abs(self.axis))])
        x, y, z = np.round(axis, 2) + 0.0
        return f"{'rotation about' if self.is_rotation else 'translation along'} ({x:g}, {y:g}, {z:g})"


def free_directions(directions: Directions) -> tuple[FreeDirection, ...]:
    """Of a single registration: translations first, those that nothing holds before those that the channels do."""
    free, held = np.asarray(directions.free), np.asarray(directions.held)
    twists = np.asarray(directions.twists, np.float64)
    # The motion of the points: of their centroid, and by turning about it.
    center, radius = np.asarray(directions.center, np.float64), float(np.asarray(directions.radius))
    motions = np.concatenate([twists[:, :3] + np.cross(twists[:, 3:], center), radius * twists[:, 3:]], axis=1)
    found: list[FreeDirection] = []
    for by_channels in (False, True):
        rows = motions[free & (held == by_channels)]
        if not len(rows):
            continue
        for motion in _separate(rows):
            turning = np.linalg.norm(motion[3:]) > _PURE * np.linalg.norm(motion)
            axis = motion[3:] if turning else motion[:3]
            omega = motion[3:] / radius
            found.append(
                FreeDirection(
                    twist=np.concatenate([motion[:3] - np.cross(omega, center), omega]),
                    held_by_channels=by_channels,
                    axis=axis / np.linalg.norm(axis),
                    is_rotation=bool(turning),
                )
            )
    return tuple(found)


def _separate(motions: Float[np.ndarray, "m 6"]) -> Float[np.ndarray, "m 6"]:
    """Other motions of the same span: translations first, along the axes of the frame as far as there is a choice."""
    # Rows are orthonormal in the mean motion of the points, and stay so.
    turning, _, _ = np.linalg.svd(motions[:, 3:])
    ordered = (turning.T @ motions)[::-1]
    flat = np.linalg.norm(ordered[:, 3:], axis=1) <= _PURE * np.linalg.norm(ordered, axis=1)
    if flat.sum() == 2:
        pair = ordered[flat]
        axis = np.argmax(np.linalg.norm(pair[:, :3], axis=0))
        cosine, sine = pair[:, axis] / np.linalg.norm(pair[:, axis])
        ordered[flat] = np.array([[cosine, sine], [-sine, cosine]]) @ pair
    return ordered


def describe(found: Sequence[FreeDirection]) -> str:
    """In one sentence; empty if geometry holds everything."""
    if not found:
        return ""
    held = [direction for direction in found if direction.held_by_channels]
    everything = ", ".join(direction._motion() for direction in found)
    if not held:
        verdict = "held by nothing"
    elif len(held) == len(found):
        verdict = "held by the channels: all"
    else:
        verdict = "held by the channels: " + ", ".join(direction._motion() for direction in held)
    return f"free by geometry: {everything}; {verdict}"
