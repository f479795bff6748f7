"""The derivative of a pose by the implicit function theorem: the pose is a root of g(T) = Σ w JᵀM d = 0."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from mcgicp_jax._compute.concrete import AnyArray, numpy_for
from mcgicp_jax._compute.linear_maps import differentiable_once, is_symbolic_zero
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._math.poses import parameters_by_twist, units
from mcgicp_jax._pose_solver.matched import Matched, Motion, linearize_at
from mcgicp_jax._pose_solver.pose_measurements import Fusion
from mcgicp_jax._terms.base import AbstractTerm

# Iteration limit. Newton's method, which starts at the pose of the loop and converges quadratically, takes 3 or 4.
MAX_NEWTON_STEPS = 8


class ImplicitRoot(eqx.Module):
    """Scaling of g(T) = Σ w Jᵀ M(R) d = 0, the equation that defines the pose and its derivative.

    Every GICP recomputes M between updates, so the loop converges to a root of g, not to a minimum of the cost F. The
    derivative of the pose follows from g, including the dependence of M and w on the pose.

    Where directions are unconstrained, the loop converges to a root of Pᵀ g: the columns of P are twists along the
    constrained directions, and the pose moves along these alone, as in `solve_update`. P is a constant to autodiff, as
    the matches are: what it contributes is the forces along unconstrained directions, which are arbitrary, times its
    own change.

    Attributes:
        center, radius: `Sums.center` and `Sums.radius` at the returned pose, metres.
        scale: tr(Σ K) · radius²; g is divided by it to be dimensionless.
        usable: whether a root is to be searched; if False, the derivative is zero.
        columns: P, lengths in units of the radius, with zeros for unconstrained directions. If there are none, I.
        rows: Pᵀ; with `Fusion`, whose g is given in its basis, rows of I.
    """

    center: Float[Array, "3"]
    radius: Float[Array, ""]
    scale: Float[Array, ""]
    usable: Bool[Array, ""]
    columns: Float[Array, "6 6"]
    rows: Float[Array, "6 6"]

    def within(self, slope: Float[AnyArray, "6 6"]) -> Float[AnyArray, "6 6"]:
        """Pᵀ (∂g/∂ξ) P, with 1 on the diagonal for unconstrained directions, so that it has an inverse."""
        xp = numpy_for(slope)
        return self.rows @ slope @ self.columns + xp.diag(1.0 * ~xp.any(self.rows, axis=1))


class Model(NamedTuple):
    """The differentiable inputs of g; `fusion` with tie points or a prior."""

    matched: Matched
    terms: tuple[AbstractTerm, ...]
    fusion: Fusion | None


@jax.custom_jvp
def with_derivative(pose: Float[Array, "7"], root: ImplicitRoot, model: Model) -> Float[Array, "7"]:
    """Return the pose, with the derivative −P (Pᵀ ∂g/∂ξ P)⁻¹ Pᵀ ∂g/∂θ of the nearby root of Pᵀ g (implicit function
    theorem).

    The derivative is evaluated at the root, which Newton's method finds from the pose. It is zero if `root.usable` is
    False or Newton's method does not converge. A second derivative raises `NotImplementedError`. The pose,
    `jaxlie.SE3.wxyz_xyz`, is a constant to autodiff; the model is θ.
    """
    return pose


@partial(with_derivative.defjvp, symbolic_zeros=True)
@with_settings_of_package
def _with_derivative_jvp(
    primals: tuple[Float[Array, "7"], ImplicitRoot, Model], tangents: tuple[Any, Any, Any]
) -> tuple[Float[Array, "7"], Float[Array, "7"]]:
    pose, root, model = primals
    leaves, structure = jax.tree.flatten(model)
    slopes = jax.tree.leaves(tangents[2], is_leaf=is_symbolic_zero)
    moving = [i for i, slope in enumerate(slopes) if not is_symbolic_zero(slope)]
    if not moving:
        return pose, jnp.zeros_like(pose)
    leaves = [differentiable_once(leaf) if jnp.issubdtype(leaf.dtype, jnp.inexact) else leaf for leaf in leaves]
    start, root, constants = jax.lax.stop_gradient((pose, root, leaves))
    at_root, inverse = _newton(start, root, jax.tree.unflatten(structure, constants))

    def balance_of(values: list[Array]) -> Float[Array, "6"]:
        changed = list(constants)
        for i, value in zip(moving, values, strict=True):
            changed[i] = value
        return _balance(jnp.zeros_like(at_root[:6]), at_root, root, jax.tree.unflatten(structure, changed))

    _, change = jax.jvp(balance_of, ([leaves[i] for i in moving],), ([slopes[i] for i in moving],))
    return pose, _along(start, -inverse @ change, root)


def _along(pose: Float[Array, "7"], twist: Float[Array, "6"], root: ImplicitRoot) -> Float[Array, "7"]:
    """First-order change of the pose parameters `wxyz_xyz` along a twist (in units of the radius); linear in it."""
    slope = parameters_by_twist(pose, root.center).astype(pose.dtype)
    return jnp.matmul(slope, twist * units(root.radius), precision="highest")


def _newton(
    start: Float[Array, "7"], root: ImplicitRoot, model: Model
) -> tuple[Float[Array, "7"], Float[Array, "6 6"]]:
    """The root near a pose, and P (Pᵀ ∂g/∂ξ P)⁻¹ Pᵀ before the last step; that pose and 0 if the method diverged."""
    small = jnp.sqrt(float(jnp.finfo(start.dtype).eps))
    still, identity = jnp.zeros_like(start[:6]), jnp.eye(6, dtype=start.dtype)

    def step(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        count, pose, _, _ = carry
        balance, jacobian = value_and_jacobian(lambda twist: _balance(twist, pose, root, model), still)
        jacobian = jnp.where(root.usable, jacobian, identity)
        inverse = root.columns @ jnp.linalg.inv(root.within(jacobian)) @ root.rows
        twist = jnp.where(root.usable, -inverse @ balance, 0)
        size = jnp.max(jnp.abs(twist))
        moved = pose + _along(pose, twist, root)
        moved = moved.at[:4].divide(jnp.sqrt(jnp.sum(moved[:4] ** 2)))
        # Reverse mode multiplies by what follows from pose and inverse, so that they must never be NaN.
        moved = jnp.where((size <= small) | (count + 1 < MAX_NEWTON_STEPS), moved, start)
        return count + 1, moved, inverse, size

    def unfinished(carry: tuple[Array, Array, Array, Array]) -> Bool[Array, ""]:
        count, _, _, size = carry
        # Convergence is quadratic: after a step below √eps the remaining error is rounding.
        return (count < MAX_NEWTON_STEPS) & ~(size <= small)

    initial = jnp.int32(0), start, identity, jnp.asarray(jnp.inf, start.dtype)
    _, at_root, inverse, size = jax.lax.while_loop(unfinished, step, initial)
    return at_root, jnp.where(root.usable & (size <= small), inverse, 0)


def value_and_jacobian(
    function: Callable[[Float[Array, "6"]], Float[Array, "6"]], twist: Float[Array, "6"]
) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """A sum over points at a twist, and its derivative. In forward mode the program takes fifteen times as long."""
    value, vjp = jax.vjp(function, twist)
    return value, jax.vmap(lambda row: vjp(row)[0])(jnp.eye(6, dtype=twist.dtype))


def _balance(twist: Float[Array, "6"], pose: Float[Array, "7"], root: ImplicitRoot, model: Model) -> Float[Array, "6"]:
    """`score_at`, or `Fusion.balance`, at a pose `moved_along` a twist."""
    motion = moved_along(twist, pose, root)
    score = score_at(motion, root, model.matched, model.terms)
    return score if model.fusion is None else model.fusion.balance(score, motion)


def score_at(
    motion: Motion, root: ImplicitRoot, matched: Matched, terms: tuple[AbstractTerm, ...]
) -> Float[Array, "6"]:
    """g / scale, sums of forces and torques."""
    # Without a usable root, ignoring all correspondences keeps values and derivatives finite.
    matched = replace(matched, valid=matched.valid & root.usable)
    posed, total, _ = linearize_at(motion, matched, terms)
    arms = jnp.where(matched.valid, posed.moved - root.center[:, None], 0)
    torque = jnp.cross(arms, total.force, axis=0)
    return jnp.concatenate([jnp.sum(total.force, axis=1) * root.radius, jnp.sum(torque, axis=1)]) / root.scale


def moved_along(twist: Float[Array, "6"], pose: Float[Array, "7"], root: ImplicitRoot) -> Motion:
    """The pose moved to first order along a twist (in units of the radius)."""
    rotation = jaxlie.SO3(pose[:4]).as_matrix().astype(pose.dtype)
    v, omega = twist[:3] * root.radius, twist[3:]
    turned = rotation + jnp.cross(omega[:, None], rotation, axis=0)
    return Motion(turned, pose[4:] + v + jnp.cross(omega, pose[4:] - root.center))
