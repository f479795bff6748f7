"""Tie points and a pose prior as costs of the pose, in squared standard deviations.

A tie point has the residual b − T a. Let D = [ΔR − I | Δt] be the change from a fixed pose T₀ about a fixed centre c:
T a − c = ΔR (T₀ a − c) + Δt. Then the cost of all tie points is e − 2 ⟨D, G⟩ + ⟨D, Q D⟩ with constant Q (12, 12) and
G (12), for any number of them. A prior P has the residual ξ = log(P⁻¹ T), a twist about any fixed source point: here
the one at c, so that far origins do not enter the arithmetic.

A prior may fix directions: T = P exp(ξ) with F ξ = 0, where the rows of F are `Prior.fixed`. For free directions that
form a group, such as x, y and yaw, these are the poses P H of that group. Otherwise the poses depend on the
parametrisation by one exponential: with yaw fixed, say, its component of log(P⁻¹ T) stays 0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, numpy_for
from mcgicp_jax._math.poses import adjoint_to_source, translation_adjoint, units
from mcgicp_jax._math.symmetric_matrices import inverse_3, inverse_6
from mcgicp_jax._pose_solver.matched import Motion

# Probability with which right tie points seem to be contradicted; and rounding of their residuals in steps of float32.
_UNLIKELY, _ROUNDING = 1e-6, 4


class TiePoints(NamedTuple):
    """Points that are the same: b = T a up to an error with the given covariance, in the target's axes, metres²."""

    source: Float[AnyArray, "n 3"]
    target: Float[AnyArray, "n 3"]
    covariances: Float[AnyArray, "n 3 3"]


class Prior(NamedTuple):
    """The pose is R, t times exp(ξ) with ξ = (v, ω) of the given information, metres and radians.

    `fixed`: (6, 6), rows f with f · ξ = 0 and rows of zeros; None if no direction is fixed. A constant to autodiff.
    """

    rotation: Float[AnyArray, "3 3"]
    translation: Float[AnyArray, "3"]
    information: Float[AnyArray, "6 6"]
    fixed: Any = None


class PoseForm(NamedTuple):
    """Costs of tie points and of a prior.

    Attributes:
        stiffness, force: Q and G, with D flattened row by row and Δt in units of the radius.
        energy: e.
        prior: relative to the source point at c and to c, lengths in units of the radius; without one its information
            is 0.
        most: the cost that right tie points exceed in one of a million cases (χ² with 3 n degrees of freedom); infinite
            without tie points.
    """

    stiffness: Float[AnyArray, "12 12"]
    force: Float[AnyArray, "12"]
    energy: Float[AnyScalar, ""]
    prior: Prior
    most: Float[AnyScalar, ""]


def form_at(
    rotation: Float[AnyArray, "3 3"],
    translation: Float[AnyArray, "3"],
    center: Float[AnyArray, "3"],
    radius: Float[AnyScalar, ""],
    ties: TiePoints | None,
    prior: Prior | None,
) -> PoseForm:
    """The costs relative to the pose R, t, about a centre. NumPy where everything is concrete."""
    xp = numpy_for(rotation, translation, center, radius, ties, prior)
    stiffness, force, energy, most = xp.zeros((12, 12)), xp.zeros(12), xp.zeros(()), np.inf
    if ties is not None:
        information = inverse_3(ties.covariances)
        moved = ties.source @ rotation.T + translation
        arms = xp.concatenate([moved - center, xp.broadcast_to(radius, (len(moved), 1))], axis=1)
        forces = xp.einsum("nij,nj->ni", information, ties.target - moved)
        stiffness = stiffness + xp.einsum("nij,nk,nl->ikjl", information, arms, arms).reshape(12, 12)
        force = force + xp.einsum("ni,nk->ik", forces, arms).reshape(12)
        energy = energy + xp.sum(forces * (ties.target - moved))
        # Imported late, like all of SciPy but its trees.
        import scipy.special

        # Coordinates are rounded to float32, which very precise tie points show.
        reach = xp.max(xp.abs(moved), initial=0) + xp.max(xp.abs(center))
        rounding = _ROUNDING * np.finfo(np.float32).eps * reach
        stiffest = xp.sum(xp.trace(information, axis1=1, axis2=2))
        most = (scipy.special.chdtri(3 * len(moved), _UNLIKELY) if len(moved) else np.inf) + stiffest * rounding**2
    most = xp.asarray(most, energy.dtype)
    if prior is None:
        return PoseForm(stiffness, force, energy, Prior(rotation, xp.zeros(3), xp.zeros((6, 6))), most)
    point = rotation.T @ (center - translation)
    offset = (prior.rotation @ point + prior.translation - center) / radius
    # ξ about the origin of the source from ξ about the point, with lengths in units of the radius.
    change = translation_adjoint(point) * units(radius)
    fixed = None if prior.fixed is None else prior.fixed @ change
    prior = Prior(prior.rotation, offset, change.T @ prior.information @ change, fixed)
    return PoseForm(stiffness, force, energy, prior, most)


class PoseMeasurements(eqx.Module):
    """Tie points and a prior as a force on the pose, γ(T).

    Twists turn about `center`, in the target's frame, with lengths in units of `radius`.

    Attributes:
        rotation, translation: T₀, the pose to which `form` refers.
        center, radius: of the points that are matched there, metres.
    """

    rotation: Float[AnyArray, "3 3"]
    translation: Float[AnyArray, "3"]
    center: Float[AnyArray, "3"]
    radius: Float[AnyScalar, ""]
    form: PoseForm

    def _change(self, motion: Motion) -> tuple[Float[AnyArray, "3 4"], Float[AnyArray, "3"]]:
        """[ΔR | Δt] of a pose, Δt in units of the radius; and Δt in metres."""
        turn = motion.rotation @ self.rotation.T
        shift = motion.translation - self.center - turn @ (self.translation - self.center)
        return jnp.concatenate([turn, shift[:, None] / self.radius], axis=1), shift

    def prior_residual(self, motion: Motion) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
        """ξ at a pose, and its derivative by each of six twists, one per row."""
        _, shift = self._change(motion)
        prior, dtype = self.form.prior, shift.dtype

        def residual_at(twist: Float[Array, "6"]) -> Float[Array, "6"]:
            turned = motion.rotation + jnp.cross(twist[3:, None], motion.rotation, axis=0)
            moved = (shift + jnp.cross(twist[3:], shift)) / self.radius + twist[:3]
            error = jaxlie.SE3.from_rotation_and_translation(
                jaxlie.SO3.from_matrix(prior.rotation.T @ turned), prior.rotation.T @ (moved - prior.translation)
            )
            return error.log().astype(dtype)

        residual, jvp = jax.linearize(residual_at, jnp.zeros(6, dtype))
        return residual, jax.vmap(jvp)(jnp.eye(6, dtype=dtype))

    def cost_of_ties(self, motion: Motion) -> Float[Array, ""]:
        """Cost of the tie points at a pose, squared standard deviations."""
        change, form = (self._change(motion)[0] - jnp.eye(3, 4, dtype=self.center.dtype)).reshape(12), self.form
        return form.energy - 2 * form.force @ change + change @ form.stiffness @ change

    def force_and_stiffness(self, motion: Motion) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
        """γ, and its stiffness JᵀQJ, at a pose."""
        now, _ = self._change(motion)
        axes = jnp.eye(3, dtype=now.dtype)
        along = jnp.concatenate([jnp.zeros((3, 3, 3), now.dtype), axes[:, :, None]], axis=2)
        about = jnp.cross(axes[:, :, None], now[None], axis=1)
        slope = jnp.concatenate([along, about]).reshape(6, 12)
        change = (now - jnp.eye(3, 4, dtype=now.dtype)).reshape(12)
        prior = self.form.prior
        residual, rows = self.prior_residual(motion)
        force = slope @ (self.form.force - self.form.stiffness @ change) - rows @ prior.information @ residual
        return force, slope @ self.form.stiffness @ slope.T + rows @ prior.information @ rows.T


class Fusion(PoseMeasurements):
    """The equation of a pose with tie points or a prior: P s(T) + γ(T) = 0.

    s(T) is the score of the matches, force and torque. At the end of a first registration, the score has the Jacobian A
    and the covariance B (see `covariance`), and P = A B⁻¹: the solution minimises sᵀ B⁻¹ s and the cost of tie points
    and prior together, both in squared standard deviations (generalised method of moments, Hansen 1982). M itself is no
    inverse covariance, so s and γ cannot simply be added. Along directions that the matches do not constrain, P is
    zero. Constants to autodiff: all but `form`.

    Where the prior fixes directions, the equation is that of the free ones, and F ξ = 0 (see the module). The basis is
    then one of ξ, since the free twists at T depend on T and on the prior's pose.

    Attributes:
        basis: twists as columns; changes of ξ if directions are fixed.
        gain, information: P and A B⁻¹ A in this basis.
        constrained: by matches, tie points or prior.
        fixed: by the prior; None if it fixes none.
    """

    basis: Float[AnyArray, "6 6"]
    gain: Float[AnyArray, "6 6"]
    information: Float[AnyArray, "6 6"]
    constrained: Bool[AnyArray, "6"]
    fixed: Bool[AnyArray, "6"] | None = None

    def twists_at(self, motion: Motion) -> Float[AnyArray, "6 6"]:
        if self.fixed is None:
            return self.basis
        return jnp.linalg.solve(self.prior_residual(motion)[1].T, self.basis)

    def balance(self, score: Float[Array, "6"], motion: Motion) -> Float[Array, "6"]:
        """P s + γ, in the basis; F ξ instead for fixed directions."""
        basis, fixed = self.twists_at(motion), self.form.prior.fixed
        forces = self.gain @ (basis.T @ score) + basis.T @ self.force_and_stiffness(motion)[0]
        if self.fixed is None or fixed is None:
            return forces
        return jnp.where(self.fixed, (fixed @ self.basis).T @ (fixed @ self.prior_residual(motion)[0]), forces)


def constraints_at(
    pose: jaxlie.SE3, center: Float[Array, "3"], radius: Float[Array, ""], prior: Prior
) -> Float[Array, "6 6"]:
    """Derivative of F ξ by a twist about a centre, lengths in units of the radius."""
    slope = _pose_of(prior).inverse().multiply(pose).jlog().astype(center.dtype)
    return prior.fixed @ slope @ (adjoint_to_source(pose, center) * units(radius))


@jax.jit
def with_fixed_directions(pose: jaxlie.SE3, prior: Prior) -> jaxlie.SE3:
    """The pose with ξ projected onto F ξ = 0."""
    fixed, prior_pose = prior.fixed, _pose_of(prior)
    twist = prior_pose.inverse().multiply(pose).log()
    gram = fixed @ fixed.T + jnp.diag(1.0 * ~jnp.any(fixed != 0, axis=1))
    twist = twist - fixed.T @ (inverse_6(gram) @ (fixed @ twist))
    moved = prior_pose.multiply(jaxlie.SE3.exp(twist)).normalize()
    # jaxlie promotes to the default precision.
    return jaxlie.SE3(moved.wxyz_xyz.astype(pose.wxyz_xyz.dtype))


def _pose_of(prior: Prior) -> jaxlie.SE3:
    return jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.from_matrix(prior.rotation), prior.translation)
