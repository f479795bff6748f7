"""The pose update from sums over correspondences, and the derivative of the pose as the root of g(T) = 0."""

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

from mcgicp_jax._math.poses import units
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pose_solver.pose_measurements import Fusion
from mcgicp_jax._pose_solver.sums import Matched, Sums, forces_at

# Mean eigenvalue that the information matrix is scaled to, dimensionless: large beside 1, the damping that optimistix
# starts with.
_HESSIAN_SCALE = 1e4
# Iteration limits. Levenberg-Marquardt was seen to take at most 16, with noisy data; Newton's method, which starts at
# the pose of the loop and converges quadratically, takes 3 or 4.
_MAX_STEPS = 32
_MAX_NEWTON_STEPS = 8
# Row and column of each stored entry of the symmetric 3×3 and 4×4 matrices.
_SYMMETRIC_3 = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
_SYMMETRIC_4 = ((0, 1, 2, 3), (1, 4, 5, 6), (2, 5, 7, 8), (3, 6, 8, 9))
# (12, 6) derivative at the identity of vec D by ξ = (v, ω): D = [ω× | v], flattened row by row.
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
    """Result of one pose update.

    Attributes:
        twist: (6,) ξ = (v, ω), metres and radians: the moved points turn by exp(ω) about the centre and shift by v.
        information: (6, 6) Σ JᵀKJ for ξ, lengths in units of the radius.
        degenerate: whether `information` is singular to rounding.
    """

    twist: Float[Array, "6"]
    information: Float[Array, "6 6"]
    degenerate: Bool[Array, ""]


def solve_update(sums: Sums, basis: Float[Array, "6 6"]) -> Update:
    """Minimise Σ w (d − D h)ᵀ M (d − D h) = e − 2⟨D, G⟩ + ⟨D, Q(D)⟩ (letters as in `_sums`) over the pose change D =
    [ΔR − I | Δt], with M and w fixed.

    Levenberg-Marquardt runs on 13 residuals, a square root of the (13, 13) quadratic form in (vec D, 1), so its time
    does not depend on the number of points. Lengths are in units of `Sums.radius`, which puts translation and rotation
    on the same scale for clouds of any size.

    Args:
        basis: (6, 6), columns: twists along which the pose may move, lengths in units of the radius. Zero columns
            keep the pose fixed along their directions.
    """
    radius, dtype = sums.radius, sums.totals.dtype
    eps = float(jnp.finfo(dtype).eps)
    form = _quadratic_form(sums, radius)
    unit_information = twist_form(sums.stiffness, radius)
    trace = jnp.trace(unit_information)
    scale = _HESSIAN_SCALE / jnp.where(trace > 0, trace / 6, 1)
    # Both square roots in one loop, which compiles faster.
    padded = jnp.zeros_like(form).at[:6, :6].set(unit_information)
    roots, pivots = jax.vmap(_semidefinite_root)(jnp.stack([form * scale, padded]))
    # optimistix keeps its step sizes in the default precision, and fails on float32 data where x64 is on.
    root, columns = roots[0].astype(float), basis.astype(float)
    twist = basis @ _least_squares(root, columns).value.astype(dtype)
    return Update(
        twist=jnp.concatenate([twist[:3] * radius, _rotation_vector(twist[3:])]),
        information=unit_information,
        degenerate=~jnp.all(pivots[1, :6] > 64 * eps * jnp.max(jnp.diagonal(unit_information))),
    )


def _least_squares(root: Float[Array, "13 13"], basis: Float[Array, "6 6"]) -> optx.Solution:
    # The residuals are sums of terms up to √_HESSIAN_SCALE = 100 and rounded accordingly: with a smaller tolerance the
    # steps would never fall below it.
    tolerance = 64 * float(jnp.finfo(root.dtype).eps)
    solver: optx.LevenbergMarquardt = optx.LevenbergMarquardt(
        rtol=tolerance, atol=tolerance, linear_solver=lx.Normal(lx.Cholesky())
    )
    solver = eqx.tree_at(lambda solver: solver.search, solver, _TrustRegion(solver.search))
    return optx.least_squares(_residuals, solver, jnp.zeros(6), (root, basis), max_steps=_MAX_STEPS, throw=False)


class _TrustRegion(optx.AbstractSearch):
    """optimistix's trust region, which here also accepts steps that change the cost by no more than rounding.

    At the minimum, rounding decides whether a step lowers the computed cost. Where the current cost was rounded down,
    some twenty ever shorter steps would be rejected in vain. (Conn, Gould & Toint, Trust-Region Methods, 2000, section
    17.4.2.)
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
        # The inner rejection raised the damping: restore it.
        before = state.step_size, state
        size, after = jax.tree.map(partial(jnp.where, level & ~accept), before, (size, after))
        return size, accept | level, result, after


def _quadratic_form(sums: Sums, radius: Float[Array, ""]) -> Float[Array, "13 13"]:
    """The cost of `solve_update` as a form in (vec D, 1), divided by radius²; lengths in units of the radius."""
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
    """Factors that express h = (p, 1) in units of the radius."""
    return jnp.stack([1 / radius, 1 / radius, 1 / radius, jnp.ones_like(radius)])


def twist_form(second: Float[Array, "6 10"], radius: Float[Array, ""]) -> Float[Array, "6 6"]:
    """Σ JᵀKJ from Σ K ⊗ h hᵀ, for symmetric K and twists ξ = (v, ω) with lengths in units of the radius."""
    tangent = jnp.asarray(_TANGENT, second.dtype)
    return tangent.T @ _unit_quadratic(second, radius) @ tangent


def wrench(first: Float[Array, "3 4"], radius: Float[Array, ""]) -> Float[Array, "6"]:
    """Σ of force and torque from Σ f hᵀ, arms in units of the radius."""
    return jnp.asarray(_TANGENT, first.dtype).T @ (first * _unit_lengths(radius)).reshape(12)


def _semidefinite_root(form: Float[Array, "D D"]) -> tuple[Float[Array, "D D"], Float[Array, "D"]]:
    """Cholesky factor L with L Lᵀ = form, and its pivots; a pivot lost to rounding leaves a zero column.

    Not LAPACK's Cholesky, which returns NaN for semidefinite matrices, and whose batched calls can deadlock.
    """
    size = form.shape[0]
    floor = size * jnp.finfo(form.dtype).eps * jnp.diagonal(form)
    rows = jnp.arange(size)

    def eliminate(i: Int[Array, ""], carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        form, root, pivots = carry
        pivot = form[i, i]
        regular = pivot > floor[i]
        # Rows above the pivot are zero but for rounding errors.
        column = jnp.where(regular & (rows >= i), form[:, i] / jnp.sqrt(jnp.where(regular, pivot, 1)), 0)
        return form - jnp.outer(column, column), root.at[:, i].set(column), pivots.at[i].set(pivot)

    # A loop compiles four times faster than the unrolled recurrence.
    _, root, pivots = jax.lax.fori_loop(0, size, eliminate, (form, jnp.zeros_like(form), jnp.zeros_like(floor)))
    return root, pivots


@jax.jit
def _residuals(along: Float[Array, "6"], args: tuple[Float[Array, "13 13"], Float[Array, "6 6"]]) -> Float[Array, "13"]:
    """13 residuals whose squares sum to the quadratic form. The rotation is parametrised by 2 s, with the Rodrigues
    vector s = tan(θ/2) a of angle θ and axis a; to first order, 2 s is the rotation vector.

    ΔR − I = 2 (S + S²) / (1 + s·s) with S = [s]× (Cayley). The exponential map, with square roots and special cases,
    would double what an update compiles.
    """
    root, basis = args
    twist = basis @ along
    half = 0.5 * twist[3:]
    cross = jnp.cross(half[:, None], jnp.eye(3, dtype=half.dtype), axis=0)
    rotation = 2 / (1 + half @ half) * (cross + cross @ cross)
    change = jnp.concatenate([rotation, twist[:3, None]], axis=1)
    return root.T @ jnp.append(change.reshape(12), 1)


def _rotation_vector(twice: Float[Array, "3"]) -> Float[Array, "3"]:
    """Rotation vector θ a of `twice` = 2 s, twice the Rodrigues vector s = tan(θ/2) a."""
    square = 0.25 * (twice @ twice)
    turned = square > 0
    tangent = jnp.sqrt(jnp.where(turned, square, 1))
    return twice * jnp.where(turned, jnp.arctan(tangent) / tangent, 1)


class Root(eqx.Module):
    """Scaling of g(T) = Σ w Jᵀ M(R) d = 0, the equation that defines the pose and its derivative.

    Every GICP recomputes M between updates, so the loop converges to a root of g, not to a minimum of the cost F. The
    derivative of the pose follows from g, including the dependence of M and w on the pose.

    Attributes:
        center, radius: `Sums.center` and `Sums.radius` at the returned pose, metres.
        scale: tr(Σ K) · radius²; g is divided by it to be dimensionless.
        usable: whether a root is to be searched; if False, the derivative is zero.
    """

    center: Float[Array, "3"]
    radius: Float[Array, ""]
    scale: Float[Array, ""]
    usable: Bool[Array, ""]


def root_near(sums: Sums, usable: Bool[Array, ""], fusion: Fusion | None) -> Root:
    """The scaling of g from the sums at the returned pose, or that of the score in `Fusion`."""
    if fusion is not None:
        radius = jnp.asarray(fusion.radius)
        return Root(center=jnp.asarray(fusion.center), radius=radius, scale=radius, usable=usable)
    radius = jnp.where(usable, sums.radius, 1)
    # The trace of Σ K, in the unit of g.
    scale = jnp.sum(sums.stiffness[jnp.array([0, 3, 5]), 9]) * radius**2
    return Root(
        center=jnp.where(usable, sums.center, 0), radius=radius, scale=jnp.where(usable, scale, 1), usable=usable
    )


Model: TypeAlias = tuple[Matched, AbstractMethod, AbstractKernel | None, Fusion | None]


@jax.custom_jvp
def with_derivative(pose: Float[Array, "7"], root: Root, model: Model) -> Float[Array, "7"]:
    """Return the pose, with the derivative −(∂g/∂ξ)⁻¹ ∂g/∂θ of the nearby root of g (implicit function theorem).

    The derivative is evaluated at the root, which Newton's method finds from the pose. It is zero if `root.usable` is
    False or Newton's method does not converge. A second derivative raises `NotImplementedError`.

    Args:
        pose: `jaxlie.SE3.wxyz_xyz`; a constant to autodiff.
        model: θ: matched rows, method, robust kernel, and tie points and prior, which carry everything that is
            differentiated.
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
    leaves = [_once(leaf) if jnp.issubdtype(leaf.dtype, jnp.inexact) else leaf for leaf in leaves]
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


@jax.custom_jvp
def _once(value: Array) -> Array:
    """The value, which a derivative has been computed at: a second derivative would be wrong, and is refused."""
    return value


def _once_jvp(primals: tuple[Array], tangents: tuple[Any]) -> tuple[Array, Any]:
    if not _is_symbolic_zero(tangents[0]):
        raise NotImplementedError("poses of register and align have first derivatives only, not second ones")
    return primals[0], jnp.zeros_like(primals[0])


_once.defjvp(_once_jvp, symbolic_zeros=True)


def _along(pose: Float[Array, "7"], twist: Float[Array, "6"], center: Float[Array, "3"]) -> Float[Array, "7"]:
    """First-order change of the pose parameters `wxyz_xyz` along a twist about a centre; linear in the twist."""
    rotation = jaxlie.SO3(jnp.append(jnp.zeros(1, twist.dtype), 0.5 * twist[3:])) @ jaxlie.SO3(pose[:4])
    translation = twist[:3] + jnp.cross(twist[3:], pose[4:] - center)
    return jnp.concatenate([rotation.wxyz.astype(pose.dtype), translation])


def _is_symbolic_zero(tangent: object) -> bool:
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


def _newton(
    pose: Float[Array, "7"], root: Root, model: Model
) -> tuple[Float[Array, "7"], Float[Array, "6 6"], Bool[Array, ""]]:
    """The root of g near a pose, (∂g/∂ξ)⁻¹ before the last step, and whether Newton's method converged."""
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
        # Convergence is quadratic: after a step below √eps the remaining error is rounding.
        return (count < _MAX_NEWTON_STEPS) & ~(size <= jnp.sqrt(eps))

    start = jnp.int32(0), pose, identity, jnp.asarray(jnp.inf, pose.dtype)
    _, at_root, inverse, size = jax.lax.while_loop(unfinished, step, start)
    return at_root, inverse, root.usable & (size <= jnp.sqrt(eps))


def _balance(twist: Float[Array, "6"], pose: Float[Array, "7"], root: Root, model: Model) -> Float[Array, "6"]:
    """g / scale, sums of forces and torques, at a pose moved to first order along a twist (in units of the radius).

    With tie points or a prior, that of `Fusion`.
    """
    matched, method, robust, fusion = model
    rotation = jaxlie.SO3(pose[:4]).as_matrix().astype(pose.dtype)
    v, omega = twist[:3] * root.radius, twist[3:]
    turned = rotation + jnp.cross(omega[:, None], rotation, axis=0)
    translation = pose[4:] + v + jnp.cross(omega, pose[4:] - root.center)
    # Without a usable root, ignoring all correspondences keeps values and derivatives finite.
    matched = eqx.tree_at(lambda matched: matched.valid, matched, matched.valid & root.usable)
    moved, forces, _ = forces_at(turned, translation, matched, method, robust)
    arms = jnp.where(matched.valid, moved - root.center[:, None], 0)
    torque = jnp.cross(arms, forces.force, axis=0)
    score = jnp.concatenate([jnp.sum(forces.force, axis=1) * root.radius, jnp.sum(torque, axis=1)]) / root.scale
    return score if fusion is None else fusion.balance(score, turned, translation)
