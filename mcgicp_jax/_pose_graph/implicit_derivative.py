"""Pose graphs inside transformations: the solver runs on the host, and its derivative follows at the solution.

The poses are the root of g(ξ, θ) = Σ w JᵀΛr, so dξ = −(∂g/∂ξ)⁻¹ ∂g/∂θ dθ, with the full Hessian ∂g/∂ξ and with the
measured values and information matrices θ. The host computes both derivatives in float64, numerically and so for all
kinds of measurements alike; JAX only contracts them with tangents.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, Int

from mcgicp_jax._compute.callbacks import call_host
from mcgicp_jax._compute.concrete import AnyArray, is_concrete
from mcgicp_jax._compute.lazy import Lazy
from mcgicp_jax._compute.messages import calling_line, shown_at, warn
from mcgicp_jax._math.twists import exponential
from mcgicp_jax._pose_graph.factors import WORLD, AbstractFactor, check_rows
from mcgicp_jax._pose_graph.normal_equations import factored, typical_information
from mcgicp_jax._pose_graph.solver import Factors, Solution, covariances_at, solve
from mcgicp_jax._registration.result import Status

# Differences of fourth order: step in radians, metres or units of the measured values, its multiples and their
# coefficients. The error is of the order of 1e-12; rounding of positions at 100 m leaves 1e-11.
_STEP = 1e-3
_MULTIPLES, _COEFFICIENTS = np.array([1, -1, 2, -2]), np.array([8, -8, -1, 1]) / (12 * _STEP)
# Measurements that are evaluated at once, so that temporary arrays stay in the processor's caches.
_EVALUATED_AT_ONCE = 4096


class Found(NamedTuple):
    """The solution of a graph. Poses are differentiable, the other fields are constants."""

    poses: Float[AnyArray, "n 4 4"]
    residuals: Float[AnyArray, "m"]
    weights: Float[AnyArray, "m"]
    cost: Float[AnyArray, ""]
    status: Int[AnyArray, ""]
    num_iterations: Int[AnyArray, ""]


class _Sensitivity(NamedTuple):
    """Derivatives at the solution; 0 unless the status is CONVERGED.

    Attributes:
        inverse: (∂g/∂ξ)⁻¹, 0 for held poses.
        forces: for each kind of measurement and each of its arrays of floats, ∂(w JᵀΛr) by the entries of the array.
    """

    inverse: Float[AnyArray, "n 6 n 6"]
    forces: list[list[Float[AnyArray, "m k 6 *entries"]]]


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def solve_traced(poses: Float[AnyArray, "n 4 4"], factors: Factors, robust: bool, max_iterations: int) -> Found:
    """`solver.solve` inside transformations, differentiable by the measurements, not by the initial poses."""
    return _solved(poses, factors, robust, max_iterations, False)[0]


@solve_traced.defjvp
def _derivative(robust: bool, max_iterations: int, primals: Any, tangents: Any) -> tuple[Found, Found]:
    (poses, factors), (_, changes) = primals, tangents
    found, sensitivity = _solved(poses, factors, robust, max_iterations, True)
    moved = _moved(found, sensitivity, [each.rows for each in factors], [_floats(each) for each in changes])
    constants = jax.tree.map(lambda value: jax.custom_derivatives.zero_from_primal(value), found)
    return found, constants._replace(poses=moved)


# Compiled as a whole: outside of `jit`, each of some fifty operations would be compiled alone.
@jax.jit
def _moved(found: Found, sensitivity: _Sensitivity, rows: list[Any], changes: list[list[Any]]) -> Float[Array, "n 4 4"]:
    """Tangents of the poses, given those of the arrays of floats of each kind of measurement."""
    n, dtype = len(found.poses), found.poses.dtype
    gradient = jnp.zeros((n + 1, 6), dtype)
    for index, tangents, forces in zip(rows, changes, sensitivity.forces, strict=True):
        ends = jnp.where(jnp.asarray(index) == WORLD, n, index)
        for tangent, force in zip(tangents, forces, strict=True):
            force = force.reshape(*ends.shape, 6, -1)
            product = jnp.einsum(
                "mkap,mp->mka", force, tangent.reshape(len(ends), -1).astype(dtype), precision="highest"
            )
            gradient = gradient.at[ends].add(product)
    twists = -jnp.einsum("iajb,jb->ia", sensitivity.inverse, gradient[:-1], precision="highest")
    v, (x, y, z) = twists[:, :3], twists[:, 3:].T
    zero = jnp.zeros_like(x)
    turn = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(n, 3, 3)
    generators = jnp.zeros((n, 4, 4), dtype).at[:, :3, :3].set(turn).at[:, :3, 3].set(v)
    moved = jnp.matmul(found.poses, generators, precision="highest")
    # Tangents that are not finite would leave NaN behind a zero derivative.
    return jnp.where(found.status == Status.CONVERGED, moved, 0)


def covariances_traced(poses: Float[AnyArray, "n 4 4"], factors: Factors, weights: Float[AnyArray, "m"]) -> Lazy[Any]:
    """Covariances at a solution, (n, 6, 6), constants; `jit` leaves them out where they are not read."""
    arguments = jax.lax.stop_gradient((poses, factors, weights))
    dtype = jnp.result_type(*_floats(arguments))

    def on_host(*arguments: Any) -> Any:
        return covariances_at(*arguments).astype(dtype)

    if is_concrete(arguments):
        return Lazy(lambda: jnp.asarray(on_host(*jax.tree.map(np.asarray, arguments))))
    return Lazy.of(call_host(on_host, jax.ShapeDtypeStruct((len(poses), 6, 6), dtype), *arguments))


def _floats(tree: Any) -> list[Any]:
    return [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]


def _solved(
    poses: Float[AnyArray, "n 4 4"], factors: Factors, robust: bool, max_iterations: int, differentiated: bool
) -> tuple[Found, Any]:
    """On the host, or by a callback if an argument is traced; with a `_Sensitivity` if differentiated."""
    dtype, n = jnp.result_type(*_floats((poses, factors))), len(poses)
    line = calling_line()

    def on_host(poses: Any, factors: Any) -> Any:
        for k, factor in enumerate(factors):
            # Indices of traced arrays are not known before.
            check_rows(f"factors[{k - 1}]" if k else "edges", np.asarray(factor.rows), n)
        solution = solve(poses, factors, robust, max_iterations, exact=True)
        with shown_at(line):
            _warn_of_rounding(solution.poses(n)[:, :3, 3].astype(dtype), factors)
        numbers: Any = (solution.poses(n), solution.residuals, solution.weights, solution.cost)
        counts: Any = (np.int32(solution.status), np.int32(solution.found.num_iterations))
        found = Found(*(np.asarray(each, dtype) for each in numbers), *counts)
        return found, _sensitivity(solution, n, dtype) if differentiated else None

    if is_concrete(poses, factors):
        return jax.tree.map(jnp.asarray, on_host(*jax.tree.map(np.asarray, (poses, factors))))
    m, number = sum(len(factor.information) for factor in factors), jax.ShapeDtypeStruct((), np.int32)
    shape = partial(jax.ShapeDtypeStruct, dtype=dtype)
    found = Found(shape((n, 4, 4)), shape((m,)), shape((m,)), shape(()), number, number)
    forces = [[shape((*factor.rows.shape, 6, *each.shape[1:])) for each in _floats(factor)] for factor in factors]
    sensitivity = _Sensitivity(shape((n, 6, n, 6)), forces) if differentiated else None
    return call_host(on_host, (found, sensitivity), poses, factors)


def _warn_of_rounding(positions: Float[np.ndarray, "n 3"], factors: Factors) -> None:
    """Warn if the spacing of floats at the positions exceeds the standard deviation of a typical edge."""
    largest, typical = np.abs(positions).max(), typical_information(*factors)[:, 0].max(initial=0)
    # NaN and overflow are a status.
    spacing = np.spacing(largest) if np.isfinite(largest) else 0
    if spacing**2 * typical > 1:
        warn(
            f"optimize_poses: poses up to {largest:.3g} m from the origin are rounded to {spacing:.1g} m in "
            f"{positions.dtype}. Subtract an origin from poses and priors before, or enable jax_enable_x64"
        )


def _sensitivity(solution: Solution, number: int, dtype: DTypeLike) -> _Sensitivity:
    equations, poses = solution.equations, solution.found.poses
    blocks, forces = [], []
    for factor, rows, weights in zip(equations.factors, equations.rows, equations.split(solution.weights), strict=True):
        hessian, *others = _weighted_derivatives(factor, poses[rows], weights * (solution.status == Status.CONVERGED))
        blocks.append(hessian.swapaxes(2, 3).reshape(-1, 6, 6))
        forces.append([each.astype(dtype) for each in others])
    inverse = np.zeros((len(poses), 6, len(poses), 6))
    if equations.size and solution.status == Status.CONVERGED:
        matrix = equations.matrix(np.concatenate(blocks))
        dense = equations.spread(factored(matrix).solve(np.eye(equations.size)))
        inverse = equations.spread(np.moveaxis(dense, 2, 0))
    return _Sensitivity(inverse[:number, :, :number].astype(dtype), forces)


def _weighted_derivatives(
    factor: AbstractFactor, poses: Float[np.ndarray, "m k 4 4"], weights: Float[np.ndarray, "m"]
) -> list[np.ndarray]:
    """Derivatives of w JᵀΛr, (m, k, 6): by the twists, (m, k, 6, k, 6), and by the entries of each array of floats."""
    k, parts = poses.shape[1], []
    step = max(_EVALUATED_AT_ONCE // (4 * 6 * k), 1)
    for start in range(0, max(len(weights), 1), step):
        q = slice(start, start + step)
        part = jax.tree.map(lambda values, q=q: values[q], factor)
        found = [_by_twists(part, poses[q]), *_by_values(part, poses[q])]
        parts.append([np.where(weights[q].reshape(-1, *[1] * (each.ndim - 1)) > 0, each, 0) for each in found])
    return [np.concatenate(each) for each in zip(*parts, strict=True)]


def _by_twists(factor: AbstractFactor, poses: Float[np.ndarray, "m k 4 4"]) -> Float[np.ndarray, "m k 6 k 6"]:
    m, k = poses.shape[:2]
    twists = _STEP * np.multiply.outer(_MULTIPLES, np.eye(6 * k)).reshape(-1, 1, k, 6)
    moved = (poses @ exponential(twists)).reshape(-1, k, 4, 4)
    repeated = jax.tree.map(lambda values: np.concatenate([values] * len(twists)), factor)
    return _differences(repeated, moved, 6 * k).reshape(m, k, 6, k, 6)


def _by_values(factor: AbstractFactor, poses: Float[np.ndarray, "m k 4 4"]) -> list[np.ndarray]:
    leaves, structure = jax.tree.flatten(factor)
    found, (m, k) = [], poses.shape[:2]
    for place, values in enumerate(leaves):
        if values is factor.information:
            residuals, jacobians = factor.linearize(poses)
            found.append(np.einsum("mkia,mj->mkaij", jacobians, residuals))
        elif np.issubdtype(values.dtype, np.floating):
            size = values[0].size if m else 0
            steps = _STEP * np.multiply.outer(_MULTIPLES, np.eye(size)).reshape(-1, 1, *values.shape[1:])
            repeated = [np.concatenate([each] * len(steps)) for each in leaves]
            repeated[place] = (values + steps).reshape(-1, *values.shape[1:])
            many = np.concatenate([poses] * len(steps))
            found.append(
                _differences(jax.tree.unflatten(structure, repeated), many, size).reshape(m, k, 6, *values.shape[1:])
            )
    return found


def _differences(
    factor: AbstractFactor, poses: Float[np.ndarray, "q k 4 4"], number: int
) -> Float[np.ndarray, "m k 6 number"]:
    """Derivatives of JᵀΛr by some numbers; rows are ordered by multiple of the step, number and measurement."""
    residuals, jacobians = factor.linearize(poses)
    forces = (jacobians.swapaxes(2, 3) @ (factor.information @ residuals[..., None])[:, None])[..., 0]
    forces = forces.reshape(len(_MULTIPLES), number, -1, *forces.shape[1:])
    return np.moveaxis(np.tensordot(_COEFFICIENTS, forces, 1), 0, -1)
