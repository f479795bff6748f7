"""Tie points and a pose prior as one quadratic cost in the entries of the pose.

A tie point has the residual b − T a. A prior P has six residuals: with E = P⁻¹ T, the translation of E, and its
rotation vector to first order, ½ (E − Eᵀ) as a vector (the sine of the angle times the axis). All are linear in the
entries of the pose. Let D = [ΔR − I | Δt] be the change from a fixed pose T₀ about a fixed centre c:
T a − c = ΔR (T₀ a − c) + Δt. Then the cost is e − 2 ⟨D, G⟩ + ⟨D, Q D⟩ with constant Q (12, 12) and G (12), for any
number of tie points.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, numpy_for
from mcgicp_jax._math.symmetric_matrices import inverse_3, inverse_6


class TiePoints(NamedTuple):
    """Points that are the same: b = T a up to an error with the given covariance, in the target's axes, metres²."""

    source: Float[AnyArray, "n 3"]
    target: Float[AnyArray, "n 3"]
    covariances: Float[AnyArray, "n 3 3"]


class Prior(NamedTuple):
    """The pose is R, t times exp(ξ) with ξ = (v, ω) of the given covariance, metres and radians."""

    rotation: Float[AnyArray, "3 3"]
    translation: Float[AnyArray, "3"]
    covariance: Float[AnyArray, "6 6"]


class PoseForm(NamedTuple):
    """Q and G of the cost, in squared standard deviations; D is flattened row by row, Δt in units of the radius."""

    stiffness: Float[AnyArray, "12 12"]
    force: Float[AnyArray, "12"]


def form_at(
    rotation: Float[AnyArray, "3 3"],
    translation: Float[AnyArray, "3"],
    center: Float[AnyArray, "3"],
    radius: Float[AnyScalar, ""],
    ties: TiePoints | None,
    prior: Prior | None,
) -> PoseForm:
    """The form relative to the pose R, t, about a centre. NumPy where everything is concrete."""
    xp = numpy_for(rotation, translation, center, radius, ties, prior)
    stiffness, force = xp.zeros((12, 12)), xp.zeros(12)
    if ties is not None:
        information = inverse_3(ties.covariances)
        moved = ties.source @ rotation.T + translation
        arms = xp.concatenate([moved - center, xp.broadcast_to(radius, (len(moved), 1))], axis=1)
        pull = xp.einsum("nij,nj->ni", information, ties.target - moved)
        stiffness = stiffness + xp.einsum("nij,nk,nl->ikjl", information, arms, arms).reshape(12, 12)
        force = force + xp.einsum("ni,nk->ik", pull, arms).reshape(12)
    if prior is not None:
        changes = np.eye(12).reshape(12, 3, 4)
        turned = xp.einsum("ji,kjl,lm->kim", prior.rotation, changes[:, :, :3], rotation)
        shifts = changes[:, :, :3] @ (translation - center) + changes[:, :, 3] * radius
        slope = xp.concatenate([shifts @ prior.rotation, _rotation_vectors(turned)], axis=1)
        apart = (translation - prior.translation) @ prior.rotation
        residual = xp.concatenate([apart, _rotation_vectors((prior.rotation.T @ rotation)[None])[0]])
        information = inverse_6(prior.covariance)
        stiffness = stiffness + slope @ information @ slope.T
        force = force - slope @ (information @ residual)
    return PoseForm(stiffness, force)


def _rotation_vectors(matrices: Float[AnyArray, "k 3 3"]) -> Float[AnyArray, "k 3"]:
    """½ (M − Mᵀ)ˣ: the rotation vector of a rotation by a small angle."""
    odd = 0.5 * (matrices - matrices.swapaxes(-1, -2))
    return numpy_for(matrices).stack([odd[:, 2, 1], odd[:, 0, 2], odd[:, 1, 0]], axis=-1)


class Fusion(eqx.Module):
    """The equation of a pose with tie points or a prior: P s(T) + γ(T) = 0.

    s(T) is the score of the matches, force and torque, γ the force of tie points and prior. In a first registration
    without them the score has the Jacobian A and the covariance B (see `covariance`), and P = A B⁻¹: the solution
    minimises sᵀ B⁻¹ s and the cost of tie points and prior together, both in squared standard deviations (generalised
    method of moments, Hansen 1982). M itself is no inverse covariance, so s and γ cannot simply be added. Along
    directions that the matches do not constrain, P is zero. Constants to autodiff: all but `form`.

    Twists turn about `center`, in the target's frame, with lengths in units of `radius`.

    Attributes:
        rotation, translation: T₀, the pose of the first registration, to which `form` refers.
        center, radius: of its matched points, metres.
        form: of tie points and prior.
        basis: (6, 6) twists as columns.
        gain, information: P and A B⁻¹ A in this basis.
        held: whether matches, tie points or prior constrain the twist.
    """

    rotation: Float[AnyArray, "3 3"]
    translation: Float[AnyArray, "3"]
    center: Float[AnyArray, "3"]
    radius: Float[AnyScalar, ""]
    form: PoseForm
    basis: Float[AnyArray, "6 6"]
    gain: Float[AnyArray, "6 6"]
    information: Float[AnyArray, "6 6"]
    held: Bool[AnyArray, "6"]

    def pull(
        self, rotation: Float[Array, "3 3"], translation: Float[Array, "3"]
    ) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
        """γ, and its stiffness JᵀQJ, at a pose."""
        turn = rotation @ self.rotation.T
        shift = translation - self.center - turn @ (self.translation - self.center)
        now = jnp.concatenate([turn, shift[:, None] / self.radius], axis=1)
        axes = jnp.eye(3, dtype=now.dtype)
        along = jnp.concatenate([jnp.zeros((3, 3, 3), now.dtype), axes[:, :, None]], axis=2)
        about = jnp.cross(axes[:, :, None], now[None], axis=1)
        slope = jnp.concatenate([along, about]).reshape(6, 12)
        change = (now - jnp.eye(3, 4, dtype=now.dtype)).reshape(12)
        return slope @ (self.form.force - self.form.stiffness @ change), slope @ self.form.stiffness @ slope.T

    def balance(
        self, score: Float[Array, "6"], rotation: Float[Array, "3 3"], translation: Float[Array, "3"]
    ) -> Float[Array, "6"]:
        """P s + γ, in the basis."""
        pull, _ = self.pull(rotation, translation)
        return self.gain @ (self.basis.T @ score) + self.basis.T @ pull
