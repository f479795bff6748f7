"""One pose update from 73 numbers, and the root that carries the gradient."""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax import _covariance as cov
from mcgicp_jax._cost import Model, Moments, evaluate_pairs
from mcgicp_jax._pose import cast_pose

# optimistix starts at damping 1: the form is scaled so that this is small beside its eigenvalues.
_HESSIAN_SCALE = 1e4
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
        information: (6, 6) Σ JᵀMJ in the same twist.
        degenerate: whether a direction is held by nothing.
    """

    twist: Float[Array, "6"]
    information: Float[Array, "6 6"]
    degenerate: Bool[Array, ""]


def solve_update(moments: Moments, radius: Float[Array, ""], basis: Float[Array, "6 6"]) -> Update:
    """Minimise Σ w (d − D h)ᵀ M (d − D h) over the change of pose, M held, to full convergence.

    Levenberg-Marquardt on 13 residuals, a square root of the (13, 13) quadratic form in (D, 1): its cost does not
    depend on the number of points. Lengths are measured in units of the points' radius, so that translations and
    rotations, millimetres and kilometres, weigh alike.

    Args:
        radius: metres; `Moments.radius`, and 1 where that is 0.
        basis: the twists, in units of the radius, that the pose may move along: columns; those to be held are zero.
    """
    dtype = moments.e.dtype
    eps = float(jnp.finfo(dtype).eps)
    form = _quadratic_form(moments, radius)
    unit_information = twist_form(moments.Q, radius)
    trace = jnp.trace(unit_information)
    scale = _HESSIAN_SCALE / jnp.where(trace > 0, trace / 6, 1)
    root, _ = _semidefinite_root(form * scale)
    # optimistix computes its step sizes in the default precision, and wants no other beside it.
    root, columns = root.astype(float), basis.astype(float)
    solution = _least_squares(root, columns)
    _, pivots = _semidefinite_root(unit_information)
    metres = units(radius)
    return Update(
        twist=(basis @ solution.value.astype(dtype)) * metres,
        information=unit_information * radius**2 / (metres[:, None] * metres),
        degenerate=~jnp.all(pivots > 64 * eps * jnp.max(jnp.diagonal(unit_information))),
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


def _quadratic_form(moments: Moments, radius: Float[Array, ""]) -> Float[Array, "13 13"]:
    """The form in (vec D, 1), lengths in units of the radius; M keeps its unit."""
    quadratic, lengths = _unit_quadratic(moments.Q, radius), _unit_lengths(radius)
    linear = (moments.G * lengths / radius).reshape(12)
    constant = moments.e / radius**2
    return jnp.block([[quadratic, -linear[:, None]], [-linear[None, :], constant[None, None]]])


def _unit_quadratic(moments: Float[Array, "6 10"], radius: Float[Array, ""]) -> Float[Array, "12 12"]:
    lengths = _unit_lengths(radius)
    rows = jnp.asarray(_SYMMETRIC_3)[:, None, :, None]
    columns = jnp.asarray(_SYMMETRIC_4)[None, :, None, :]
    quadratic = moments[rows, columns] * lengths[None, :, None, None] * lengths[None, None, None, :]
    return quadratic.reshape(12, 12)


def _unit_lengths(radius: Float[Array, ""]) -> Float[Array, "4"]:
    """What h = (p, 1) is divided by: lengths in units of the radius."""
    return jnp.stack([1 / radius, 1 / radius, 1 / radius, jnp.ones_like(radius)])


def twist_form(moments: Float[Array, "6 10"], radius: Float[Array, ""]) -> Float[Array, "6 6"]:
    """Σ w JᵀKJ from the moments Σ w K ⊗ h hᵀ of any symmetric K, for twists with lengths in units of the radius."""
    tangent = jnp.asarray(_TANGENT, moments.dtype)
    return tangent.T @ _unit_quadratic(moments, radius) @ tangent


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
    root, basis = args
    twist = basis @ along
    rotation = _rotation(twist) - jnp.eye(3, dtype=twist.dtype)
    change = jnp.concatenate([rotation, twist[:3, None]], axis=1)
    return root.T @ jnp.append(change.reshape(12), 1)


def _rotation(twist: Float[Array, "6"]) -> Float[Array, "3 3"]:
    return jaxlie.SO3.exp(twist[3:]).as_matrix().astype(twist.dtype)


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


def balance(
    twist: Float[Array, "6"], args: tuple[jaxlie.SE3, Float[Array, "3"], Float[Array, ""], Model]
) -> Float[Array, "6"]:
    """g(T) = Σ w Jᵀ M(R) d at the pose moved by a twist, lengths in units of the radius: forces and torques in balance.

    Every GICP renews M between updates, so its answer is the root of g, not the minimum of F: derivatives of the pose
    follow from g with the dependence of M and of the weights on the pose kept.
    """
    pose, center, radius, model = args
    moved = move_pose(pose, twist * units(radius), center)
    rotation = moved.rotation().as_matrix().astype(twist.dtype)
    pairs = evaluate_pairs(rotation, moved.translation(), *model)
    force = pairs.weight * cov.multiply(pairs.information, pairs.residual)
    torque = jnp.cross(pairs.moved - center[:, None], force, axis=0)
    return jnp.concatenate([jnp.sum(force, axis=1) * radius, jnp.sum(torque, axis=1)])


def units(radius: Float[Array, ""]) -> Float[Array, "6"]:
    """Metres and radians of a twist whose lengths are in units of the radius."""
    return jnp.stack([radius] * 3 + [jnp.ones_like(radius)] * 3)


def refine_pose(pose: jaxlie.SE3, usable: Bool[Array, ""], moments: Moments, model: Model) -> jaxlie.SE3:
    """The root of g near a pose, which carries the gradient of the answer by the implicit function theorem.

    The pose that comes in is a constant to autodiff. Where it is not `usable` it comes back as it is, with a gradient
    of zero.
    """
    pose, moments = jax.lax.stop_gradient((pose, moments))
    source, target, matches, *weighing = model
    # Where there is no root to be found, the identity without pairs keeps every number and derivative finite.
    matches = eqx.tree_at(lambda m: m.valid, matches, matches.valid & usable)
    start = jaxlie.SE3(jnp.where(usable, pose.wxyz_xyz, jaxlie.SE3.identity().wxyz_xyz.astype(pose.wxyz_xyz.dtype)))
    radius = jnp.where(usable & (moments.radius > 0), moments.radius, 1)
    center = jnp.where(usable, moments.center, 0)
    # The trace of Σ w M, in the unit of g: makes a tolerance on g mean something.
    scale = jnp.where(usable, jnp.sum(moments.Q[jnp.array([0, 3, 5]), 9]) * radius**2, 1)
    eps = float(jnp.finfo(pose.wxyz_xyz.dtype).eps)
    solution: optx.Solution = optx.root_find(
        _scaled_balance,
        optx.Newton(rtol=4 * eps, atol=4 * eps),
        jnp.zeros(6, pose.wxyz_xyz.dtype),
        (usable, scale, (start, center, radius, (source, target, matches, *weighing))),
        max_steps=_MAX_NEWTON_STEPS,
        throw=False,
    )
    refined = move_pose(start, solution.value * units(radius), center)
    return jaxlie.SE3(jnp.where(usable, refined.wxyz_xyz, pose.wxyz_xyz))


def _scaled_balance(twist: Float[Array, "6"], args: tuple[Any, ...]) -> Float[Array, "6"]:
    usable, scale, balance_args = args
    return jnp.where(usable, balance(twist, balance_args) / scale, twist)
