"""The pose update from sums over correspondences."""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._math.poses import skew
from mcgicp_jax._pose_solver.sums import Sums

# Mean eigenvalue to which the information matrix is scaled, dimensionless: large compared with 1, optimistix's initial
# damping.
_HESSIAN_SCALE = 1e4
# Iteration limit. Levenberg-Marquardt was seen to take at most 16, with noisy data.
_MAX_STEPS = 32
# Stored entry of each row and column of the symmetric 3×3 matrices.
_SYMMETRIC = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
# (12, 6) derivative at the identity of vec D by ξ = (v, ω): D = [ω× | v], flattened row by row; + 0.0 turns −0 into 0.
_TANGENT = np.concatenate([skew(np.eye(6)[:, 3:]), np.eye(6)[:, :3, None]], axis=2).reshape(6, 12).T + 0.0


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


def solve_update(
    sums: Sums, basis: Float[Array, "6 6"], others: tuple[Float[Array, "6"], Float[Array, "6 6"]] | None = None
) -> Update:
    """Minimise Σ w (d − D h)ᵀ M (d − D h) = e − 2⟨D, G⟩ + ⟨D, Q(D)⟩ (symbols as in `sums`) over the pose change D =
    [ΔR − I | Δt], with M and w fixed.

    Levenberg-Marquardt runs on 13 residuals, a square root of the (13, 13) quadratic form in (vec D, 1) divided by
    radius², so its time does not depend on the number of points. Lengths are in units of `Sums.radius`, which puts
    translation and rotation on the same scale for clouds of any size.

    Args:
        basis: (6, 6), columns: twists along which the pose may move, lengths in units of the radius. Zero columns
            keep the pose fixed along their directions.
        others: force and stiffness of other measurements of the pose, for its twist, lengths in units of the radius.
    """
    radius, dtype = sums.radius, sums.center.dtype
    quadratic = _unit_quadratic(sums.stiffness, radius)
    linear = (sums.force * _unit_lengths(radius) / radius).reshape(12)
    if others is not None:
        force, stiffness = others
        # D is [ω× | v] to first order.
        twist = jnp.asarray(_TANGENT, dtype).T / jnp.asarray([1, 1, 1, 2, 2, 2], dtype)[:, None]
        quadratic, linear = quadratic + twist.T @ stiffness @ twist, linear + force @ twist
    form = jnp.block([[quadratic, -linear[:, None]], [-linear, (sums.energy / radius**2)[None]]])
    unit_information = twist_form(sums.stiffness, radius)
    trace = jnp.trace(unit_information)
    scale = _HESSIAN_SCALE / jnp.where(trace > 0, trace / 6, 1)
    # Both square roots in one loop, which compiles faster.
    padded = jnp.zeros_like(form).at[:6, :6].set(unit_information)
    roots, pivots = jax.vmap(_semidefinite_root)(jnp.stack([form * scale, padded]))
    # optimistix keeps its step sizes in the default precision, and fails on float32 data where x64 is on.
    root, columns = roots[0].astype(float), basis.astype(float)
    # The residuals are sums of terms up to √_HESSIAN_SCALE = 100 and rounded accordingly: with a smaller tolerance the
    # steps would never fall below it.
    tolerance = 64 * float(jnp.finfo(root.dtype).eps)
    solver: optx.LevenbergMarquardt = optx.LevenbergMarquardt(tolerance, tolerance, linear_solver=_NormalEquations())
    solver = eqx.tree_at(lambda solver: solver.search, solver, _TrustRegion(solver.search))
    solution: optx.Solution = optx.least_squares(
        _residuals, solver, jnp.zeros(6), (root, columns), max_steps=_MAX_STEPS, throw=False
    )
    twist = basis @ solution.value.astype(dtype)
    # θ a from 2 s, see `_residuals`.
    square = 0.25 * (twist[3:] @ twist[3:])
    tangent = jnp.sqrt(jnp.where(square > 0, square, 1))
    turn = twist[3:] * jnp.where(square > 0, jnp.arctan(tangent) / tangent, 1)
    return Update(
        twist=jnp.concatenate([twist[:3] * radius, turn]),
        information=unit_information,
        degenerate=~jnp.all(pivots[1, :6] > rounding(jnp.diagonal(unit_information))),
    )


def rounding(diagonal: Float[Array, "6"]) -> Float[Array, ""]:
    """Pivots or eigenvalues of an information matrix up to this one are rounding; from its diagonal or eigenvalues."""
    return 64 * jnp.finfo(diagonal.dtype).eps * jnp.max(diagonal)


class _NormalEquations(lx.AbstractLinearSolver):
    """Least squares by the Cholesky factor of JᵀJ. `lx.Normal(lx.Cholesky())` fails inside `pmap` and `shard_map`."""

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> tuple[Array, Array]:
        jacobian = operator.as_matrix()
        return jacobian, jnp.linalg.cholesky(jnp.dot(jacobian.T, jacobian, precision="highest"))

    def compute(
        self, state: tuple[Array, Array], vector: Any, options: dict[str, Any]
    ) -> tuple[Array, lx.RESULTS, dict[str, Any]]:
        jacobian, root = state
        flat, _ = jax.flatten_util.ravel_pytree(vector)
        # lineax calls this outside of the settings of the package.
        projected = jnp.dot(jacobian.T, flat, precision="highest")
        return jax.scipy.linalg.cho_solve((root, True), projected), lx.RESULTS.successful, {}

    def transpose(self, state: Any, options: dict[str, Any]) -> Any:
        raise NotImplementedError

    conj = transpose

    def assume_full_rank(self) -> bool:
        return True


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


def _unit_quadratic(second: Float[Array, "6 4 4"], radius: Float[Array, ""]) -> Float[Array, "12 12"]:
    lengths = _unit_lengths(radius)
    scaled = second * lengths[:, None] * lengths
    return scaled[jnp.asarray(_SYMMETRIC)].transpose(0, 2, 1, 3).reshape(12, 12)


def _unit_lengths(radius: Float[Array, ""]) -> Float[Array, "4"]:
    """Factors that express h = (p, 1) in units of the radius."""
    return jnp.stack([1 / radius, 1 / radius, 1 / radius, jnp.ones_like(radius)])


def twist_form(second: Float[Array, "6 4 4"], radius: Float[Array, ""]) -> Float[Array, "6 6"]:
    """Σ JᵀKJ from Σ K ⊗ h hᵀ, for symmetric K and twists ξ = (v, ω) with lengths in units of the radius."""
    tangent = jnp.asarray(_TANGENT, second.dtype)
    return tangent.T @ _unit_quadratic(second, radius) @ tangent


def wrench(first: Float[Array, "3 4"], radius: Float[Array, ""]) -> Float[Array, "6"]:
    """Σ of force and torque from Σ f hᵀ, arms in units of the radius."""
    return jnp.asarray(_TANGENT, first.dtype).T @ (first * _unit_lengths(radius)).reshape(12)


def _semidefinite_root(form: Float[Array, "D D"]) -> tuple[Float[Array, "D D"], Float[Array, "D"]]:
    """Cholesky factor and pivots; a pivot lost to rounding leaves a zero column. LAPACK's factor of a semidefinite
    matrix is NaN, and its batched calls can deadlock."""
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
    cross = skew(half)
    rotation = 2 / (1 + half @ half) * (cross + cross @ cross)
    change = jnp.concatenate([rotation, twist[:3, None]], axis=1)
    return root.T @ jnp.append(change.reshape(12), 1)
