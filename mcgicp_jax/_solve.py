"""One pose update from the sums over correspondences, and the derivative of the pose as a root."""

from __future__ import annotations

from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._kernels import AbstractKernel
from mcgicp_jax._methods import AbstractMethod
from mcgicp_jax._pose import cast_pose
from mcgicp_jax._sums import Matched, Sums, forces_at

# optimistix starts at damping 1: the form is scaled so that this is small beside its eigenvalues.
_HESSIAN_SCALE = 1e4
# Steps of Levenberg-Marquardt, of which at most 16 were seen, at noisy data; and of Newton's method from a pose of the
# loop, which converges quadratically, in 3 or 4.
_MAX_STEPS = 32
_MAX_NEWTON_STEPS = 8
# Row and column of each stored entry of the symmetric 3×3 and 4×4 matrices.
_SYMMETRIC_3 = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
_SYMMETRIC_4 = ((0, 1, 2, 3), (1, 4, 5, 6), (2, 5, 7, 8), (3, 6, 8, 9))
# dD/dξ at the identity, (12, 6): D = [ω× | v] by rows, ξ = (v, ω).
_TANGENT = (
    (0, 0, 0, 0, 0, 0),
    (0, 0, 0, 0, 0, -1),
    (0, 0, 0, 0, 1, 0),
    (1, 0, 0, 0, 0, 0),
    (0, 0, 0, 0, 0, 1),
    (0, 0, 0, 0, 0, 0),
    (0, 0, 0, -1, 0, 0),
    (0, 1, 0, 0, 0, 0),
    (0, 0, 0, 0, -1, 0),
    (0, 0, 0, 1, 0, 0),
    (0, 0, 0, 0, 0, 0),
    (0, 0, 1, 0, 0, 0),
)


class Update(eqx.Module):
    """What one update found.

    Attributes:
        twist: (6,) ξ = (v, ω), metres and radians: points turn by exp(ω) about the centre and move by v.
        information: (6, 6) Σ JᵀMJ in the same twist, lengths in units of the radius.
        degenerate: whether a direction is constrained by nothing.
    """

    twist: Float[Array, "6"]
    information: Float[Array, "6 6"]
    degenerate: Bool[Array, ""]


def solve_update(sums: Sums, basis: Float[Array, "6 6"]) -> Update:
    """Minimise e − 2⟨D, G⟩ + ⟨D, Q(D)⟩ = Σ w (d − D h)ᵀ M (d − D h) over the change of pose D = [ΔR − I | Δt], M held,
    to full convergence.

    Levenberg-Marquardt on 13 residuals, a square root of the (13, 13) quadratic form in (D, 1): its cost does not
    depend on the number of points. Lengths are measured in units of the points' radius, so that translations and
    rotations, millimetres and kilometres, weigh alike.

    Args:
        basis: the twists, in units of the radius, that the pose may move along: columns; those to be held are zero.
    """
    radius, dtype = sums.radius, sums.totals.dtype
    eps = float(jnp.finfo(dtype).eps)
    form = _quadratic_form(sums, radius)
    unit_information = twist_form(sums.stiffness, radius)
    trace = jnp.trace(unit_information)
    scale = _HESSIAN_SCALE / jnp.where(trace > 0, trace / 6, 1)
    # Both square roots in one loop, for the sake of compilation.
    padded = jnp.zeros_like(form).at[:6, :6].set(unit_information)
    roots, pivots = jax.vmap(_semidefinite_root)(jnp.stack([form * scale, padded]))
    # optimistix computes its step sizes in the default precision, and wants no other beside it.
    root, columns = roots[0].astype(float), basis.astype(float)
    twist = basis @ _least_squares(root, columns).value.astype(dtype)
    return Update(
        twist=jnp.concatenate([twist[:3] * radius, _rotation_vector(twist[3:])]),
        information=unit_information,
        degenerate=~jnp.all(pivots[1, :6] > 64 * eps * jnp.max(jnp.diagonal(unit_information))),
    )


def _least_squares(root: Float[Array, "13 13"], basis: Float[Array, "6 6"]) -> optx.Solution:
    # The residuals are sums of numbers up to the root of the scale, 100, and rounded accordingly: with less, steps
    # of the last digits would go on for ever.
    tolerance = 64 * float(jnp.finfo(root.dtype).eps)
    solver: optx.LevenbergMarquardt = optx.LevenbergMarquardt(
        rtol=tolerance, atol=tolerance, linear_solver=lx.Normal(lx.Cholesky())
    )
    solver = eqx.tree_at(lambda solver: solver.search, solver, _TrustRegion(solver.search))
    return optx.least_squares(_residuals, solver, jnp.zeros(6), (root, basis), max_steps=_MAX_STEPS, throw=False)


class _TrustRegion(optx.AbstractSearch):
    """optimistix's trust region, and steps that change the cost by no more than rounding are taken.

    At the minimum it is chance whether a step lowers the rounded cost. Where it came out low, no other step would be,
    and shorter and shorter ones would be tried and refused, some twenty of them. (Conn, Gould & Toint, Trust-Region
    Methods, 2000, section 17.4.2.)
    """

    inner: Any

    def init(self, y: Array, f_info_struct: Any) -> Any:
        return self.inner.init(y, f_info_struct)

    def step(
        self, first_step: Bool[Array, ""], y: Array, y_eval: Array, f_info: Any, f_eval_info: Any, state: Any
    ) -> tuple[Array, Bool[Array, ""], Any, Any]:
        size, accept, result, after = self.inner.step(first_step, y, y_eval, f_info, f_eval_info, state)
        cost = f_info.as_min()
        level = jnp.abs(f_eval_info.as_min() - cost) <= 8 * jnp.finfo(cost.dtype).eps * cost
        # A refusal would have raised the damping.
        before = state.step_size, state
        size, after = jax.tree.map(partial(jnp.where, level & ~accept), before, (size, after))
        return size, accept | level, result, after


def _quadratic_form(sums: Sums, radius: Float[Array, ""]) -> Float[Array, "13 13"]:
    """The form in (vec D, 1), lengths in units of the radius; M keeps its unit."""
    quadratic, lengths = _unit_quadratic(sums.stiffness, radius), _unit_lengths(radius)
    linear = (sums.first * lengths / radius).reshape(12)
    constant = sums.constant / radius**2
    return jnp.block([[quadratic, -linear[:, None]], [-linear[None, :], constant[None, None]]])


def _unit_quadratic(second: Float[Array, "6 10"], radius: Float[Array, ""]) -> Float[Array, "12 12"]:
    lengths = _unit_lengths(radius)
    rows = jnp.asarray(_SYMMETRIC_3)[:, None, :, None]
    columns = jnp.asarray(_SYMMETRIC_4)[None, :, None, :]
    quadratic = second[rows, columns] * lengths[None, :, None, None] * lengths[None, None, None, :]
    return quadratic.reshape(12, 12)


def _unit_lengths(radius: Float[Array, ""]) -> Float[Array, "4"]:
    """What h = (p, 1) is divided by: lengths in units of the radius."""
    return jnp.stack([1 / radius, 1 / radius, 1 / radius, jnp.ones_like(radius)])


def twist_form(second: Float[Array, "6 10"], radius: Float[Array, ""]) -> Float[Array, "6 6"]:
    """Σ JᵀKJ from Σ K ⊗ h hᵀ of any symmetric K, for twists with lengths in units of the radius."""
    tangent = jnp.asarray(_TANGENT, second.dtype)
    return tangent.T @ _unit_quadratic(second, radius) @ tangent


def _semidefinite_root(form: Float[Array, "D D"]) -> tuple[Float[Array, "D D"], Float[Array, "D"]]:
    """L with L Lᵀ = form and the pivots, by Cholesky's recurrence; a pivot lost to rounding leaves its column zero.

    Written out, because LAPACK's answer for a semidefinite matrix is NaN, and because its batched calls are avoided.
    """
    size = form.shape[0]
    floor = size * jnp.finfo(form.dtype).eps * jnp.diagonal(form)
    rows = jnp.arange(size)

    def eliminate(i: Int[Array, ""], carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        form, root, pivots = carry
        pivot = form[i, i]
        regular = pivot > floor[i]
        # Rows above the pivot hold what rounding left of the zeros there.
        column = jnp.where(regular & (rows >= i), form[:, i] / jnp.sqrt(jnp.where(regular, pivot, 1)), 0)
        return form - jnp.outer(column, column), root.at[:, i].set(column), pivots.at[i].set(pivot)

    # A loop rather than an unrolled chain: it compiles four times faster.
    _, root, pivots = jax.lax.fori_loop(0, size, eliminate, (form, jnp.zeros_like(form), jnp.zeros_like(floor)))
    return root, pivots


@jax.jit
def _residuals(along: Float[Array, "6"], args: tuple[Float[Array, "13 13"], Float[Array, "6 6"]]) -> Float[Array, "13"]:
    """Square roots of the terms of the cost, whose rotation is given by half of its Rodrigues vector s = tan(θ/2) a.

    ΔR − I = 2 (S + S²) / (1 + s·s) with S = [s]× (Cayley): without the square roots and cases of the exponential map,
    whose derivatives would be half of what an update compiles. To first order 2 s is the rotation vector.
    """
    root, basis = args
    twist = basis @ along
    half = 0.5 * twist[3:]
    cross = jnp.cross(half[:, None], jnp.eye(3, dtype=half.dtype), axis=0)
    rotation = 2 / (1 + half @ half) * (cross + cross @ cross)
    change = jnp.concatenate([rotation, twist[:3, None]], axis=1)
    return root.T @ jnp.append(change.reshape(12), 1)


def _rotation_vector(twice: Float[Array, "3"]) -> Float[Array, "3"]:
    """Axis times angle, of twice half the Rodrigues vector."""
    square = 0.25 * (twice @ twice)
    turned = square > 0
    tangent = jnp.sqrt(jnp.where(turned, square, 1))
    return twice * jnp.where(turned, jnp.arctan(tangent) / tangent, 1)


def move_pose(pose: jaxlie.SE3, twist: Float[Array, "6"], center: Float[Array, "3"]) -> jaxlie.SE3:
    """The pose whose points p = T a have gone to c + exp(ω)(p − c) + v."""
    turn = jaxlie.SO3.exp(twist[3:])
    rotation = (turn @ pose.rotation()).normalize()
    translation = center + turn @ (pose.translation() - center) + twist[:3]
    return cast_pose(jaxlie.SE3.from_rotation_and_translation(rotation, translation), pose.wxyz_xyz.dtype)


def adjoint_to_center(pose: jaxlie.SE3, center: Float[Array, "3"]) -> Float[Array, "6 6"]:
    """From ξ of T exp(ξ), the twist of the source's frame, to the twist about the centre in the target's frame."""
    to_center = jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.identity(), -center) @ pose
    return to_center.adjoint().astype(pose.wxyz_xyz.dtype)


def adjoint_to_source(pose: jaxlie.SE3, center: Float[Array, "3"]) -> Float[Array, "6 6"]:
    """The way back."""
    to_center = jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.identity(), -center) @ pose
    return to_center.inverse().adjoint().astype(pose.wxyz_xyz.dtype)


def units(radius: Float[Array, ""]) -> Float[Array, "6"]:
    """Metres and radians of a twist whose lengths are in units of the radius."""
    return jnp.stack([radius] * 3 + [jnp.ones_like(radius)] * 3)


class Root(eqx.Module):
    """Where the derivative of a pose is taken: the pose is the root of g(T) = Σ w Jᵀ M(R) d near it.

    Every GICP renews M between updates, so its answer is the root of g, not the minimum of F: derivatives of the pose
    follow from g with the dependence of M and of the weights on the pose kept.

    Attributes:
        center, radius: metres, of the sums at the pose.
        scale: of g, so that a tolerance on it means something.
        usable: whether there is a root; where there is none, the derivative is zero.
    """

    center: Float[Array, "3"]
    radius: Float[Array, ""]
    scale: Float[Array, ""]
    usable: Bool[Array, ""]


def root_near(sums: Sums, usable: Bool[Array, ""]) -> Root:
    """What the derivative needs to know of the sums at a pose."""
    radius = jnp.where(usable, sums.radius, 1)
    # The trace of Σ w M, in the unit of g.
    scale = jnp.sum(sums.stiffness[jnp.array([0, 3, 5]), 9]) * radius**2
    return Root(
        center=jnp.where(usable, sums.center, 0), radius=radius, scale=jnp.where(usable, scale, 1), usable=usable
    )


Model: TypeAlias = tuple[Matched, AbstractMethod, AbstractKernel | None]


@jax.custom_jvp
def with_derivative(pose: Float[Array, "7"], root: Root, model: Model) -> Float[Array, "7"]:
    """The pose, whose derivative is that of the root of g next to it: −(∂g/∂ξ)⁻¹ ∂g/∂θ, by the implicit function
    theorem.

    Newton's method goes from the pose to the root, where the derivative is taken; the pose itself stays what the loop
    has found. Where the root is not usable, or Newton's method does not reach it, the derivative is zero.

    Args:
        pose: `jaxlie.SE3.wxyz_xyz`; a constant to autodiff.
        model: matched rows, method and kernel, by which everything differentiable comes in.
    """
    return pose


def _with_derivative_jvp(
    primals: tuple[Float[Array, "7"], Root, Model], tangents: tuple[Any, Any, Any]
) -> tuple[Float[Array, "7"], Float[Array, "7"]]:
    pose, root, model = primals
    leaves, structure = jax.tree.flatten(model)
    slopes = jax.tree.leaves(tangents[2], is_leaf=_is_symbolic_zero)
    moving = [i for i, slope in enumerate(slopes) if not _is_symbolic_zero(slope)]
    if not moving:
        return pose, jnp.zeros_like(pose)
    constants = jax.lax.stop_gradient((pose, root, leaves))
    at_root, inverse, found = _newton(constants[0], constants[1], jax.tree.unflatten(structure, constants[2]))

    def balance_of(values: list[Array]) -> Float[Array, "6"]:
        changed = list(constants[2])
        for i, value in zip(moving, values, strict=True):
            changed[i] = value
        return _balance(jnp.zeros_like(at_root[:6]), at_root, constants[1], jax.tree.unflatten(structure, changed))

    _, change = jax.jvp(balance_of, ([leaves[i] for i in moving],), ([slopes[i] for i in moving],))
    twist = jnp.where(found, -inverse @ change, 0) * units(constants[1].radius)
    return pose, _along(constants[0], twist, constants[1].center)


with_derivative.defjvp(_with_derivative_jvp, symbolic_zeros=True)


def _along(pose: Float[Array, "7"], twist: Float[Array, "6"], center: Float[Array, "3"]) -> Float[Array, "7"]:
    """How the parameters of a pose change along a twist about a centre, to first order; linear in the twist."""
    rotation = jaxlie.SO3(jnp.append(jnp.zeros(1, twist.dtype), 0.5 * twist[3:])) @ jaxlie.SO3(pose[:4])
    translation = twist[:3] + jnp.cross(twist[3:], pose[4:] - center)
    return jnp.concatenate([rotation.wxyz.astype(pose.dtype), translation])


def _is_symbolic_zero(tangent: object) -> bool:
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


def _newton(
    pose: Float[Array, "7"], root: Root, model: Model
) -> tuple[Float[Array, "7"], Float[Array, "6 6"], Bool[Array, ""]]:
    """The root of g next to a pose, the inverse of ∂g/∂ξ there, and whether it was reached."""
    eps = float(jnp.finfo(pose.dtype).eps)
    identity = jnp.eye(6, dtype=pose.dtype)

    def step(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        count, pose, _, _ = carry
        balance, push = jax.linearize(lambda twist: _balance(twist, pose, root, model), jnp.zeros_like(pose[:6]))
        jacobian = jnp.where(root.usable, jax.vmap(push, out_axes=1)(identity), identity)
        inverse = jnp.linalg.inv(jacobian)
        twist = jnp.where(root.usable, -inverse @ balance, 0)
        moved = pose + _along(pose, twist * units(root.radius), root.center)
        moved = moved.at[:4].divide(jnp.sqrt(jnp.sum(moved[:4] ** 2)))
        return count + 1, moved, inverse, jnp.max(jnp.abs(twist))

    def unfinished(carry: tuple[Array, Array, Array, Array]) -> Bool[Array, ""]:
        count, _, _, size = carry
        # Newton's method squares the error: after a step of the root of a rounding error, the rest is rounding.
        return (count < _MAX_NEWTON_STEPS) & ~(size <= jnp.sqrt(eps))

    start = jnp.int32(0), pose, identity, jnp.asarray(jnp.inf, pose.dtype)
    _, at_root, inverse, size = jax.lax.while_loop(unfinished, step, start)
    return at_root, inverse, root.usable & (size <= jnp.sqrt(eps))


def _balance(twist: Float[Array, "6"], pose: Float[Array, "7"], root: Root, model: Model) -> Float[Array, "6"]:
    """g at a pose moved along a twist, to first order in it; lengths in units of the radius: forces and torques."""
    matched, method, robust = model
    rotation = jaxlie.SO3(pose[:4]).as_matrix().astype(pose.dtype)
    v, omega = twist[:3] * root.radius, twist[3:]
    turned = rotation + jnp.cross(omega[:, None], rotation, axis=0)
    translation = pose[4:] + v + jnp.cross(omega, pose[4:] - root.center)
    # Where there is no root to be found, no correspondence keeps every number and derivative finite.
    matched = eqx.tree_at(lambda matched: matched.valid, matched, matched.valid & root.usable)
    moved, forces, _ = forces_at(turned, translation, matched, method, robust)
    arms = jnp.where(matched.valid, moved - root.center[:, None], 0)
    torque = jnp.cross(arms, forces.force, axis=0)
    return jnp.concatenate([jnp.sum(forces.force, axis=1) * root.radius, jnp.sum(torque, axis=1)]) / root.scale
