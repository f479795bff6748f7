"""The derivative of the pose of concrete clouds, outside `jit`.

A pose has six degrees of freedom, so its derivative by all n numbers of the inputs is a (6, n) matrix, of which a
gradient needs one combination of the rows. The pose is a root of g, see `_pose_solver.implicit_derivative`: the sum of
a row function of the matched rows of both surfaces, which are row functions of the clouds.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._compute.linear_maps import AbstractLinearMap, SideBySide, primal, with_derivative
from mcgicp_jax._compute.programs import quickly_compiled
from mcgicp_jax._compute.row_functions import Input, RowFunction, Rows, blockwise
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._math.poses import parameters_by_twist, translation_adjoint, turn_by_quaternion
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._methods.base import AbstractMethod, with_unset_from
from mcgicp_jax._methods.surfaces import differentiable_inputs
from mcgicp_jax._pose_solver import implicit_derivative
from mcgicp_jax._pose_solver.implicit_derivative import ImplicitRoot
from mcgicp_jax._pose_solver.matched import Motion, matched_rows
from mcgicp_jax._pose_solver.pose_measurements import Fusion, PoseForm, Prior, TiePoints, form_at
from mcgicp_jax._registration.loop import LoopResult, Problem, State, root_of
from mcgicp_jax._search.base import AbstractSearch
from mcgicp_jax._terms.base import with_numbers_of


class Inputs(NamedTuple):
    """The arguments of a registration by which its pose can be differentiated.

    Attributes:
        source, target: preprocessed clouds; raw ones where the method makes cells of them.
        method: its parameters may be unset.
        tie_points, prior: relative to the origins of the clouds.
        temperature: of a soft assignment, metres.
        source_rows: rows of the source that are matched; None for all.
        gains: (C,) by which the channels of the source were multiplied, constant to autodiff; None unless equalised.
    """

    source: PointCloud
    target: PointCloud
    method: AbstractMethod
    robust: AbstractKernel | None = None
    tie_points: TiePoints | None = None
    prior: Prior | None = None
    temperature: Any = None
    source_rows: Any = None
    gains: Any = None

    def values(self) -> Inputs:
        """Without traces, see `primal`. Concrete clouds stay the same objects, with which derived values are cached."""
        return self if is_concrete(self) else Inputs(*map(primal, self))


class Run(NamedTuple):
    """A registration that has ended.

    `loop` is constant to autodiff, and so are `inputs` outside `jit`. `executor` is a `HostExecutor`; None inside
    `jit`. `doubt` says why a pose is UNVERIFIED, outside `jit`.
    """

    inputs: Inputs
    problem: Problem
    loop: LoopResult
    search: AbstractSearch | None
    executor: Any
    doubt: str = ""


class PoseDerivative(AbstractLinearMap):
    """The derivative of the parameters `jaxlie.SE3.wxyz_xyz` of a final pose, 0 if there is none, by `arrays` among the
    `inputs`; by default, by all that are traced. Those of `run` are the same inputs, concrete."""

    def __init__(self, inputs: Inputs, run: Run, arrays: Sequence[Any] = ()):
        fixed, problem, loop = run.inputs, run.problem, run.loop
        self._pose, self._fusion = np.asarray(loop.state.pose.wxyz_xyz), problem.fusion
        root = _root_on_host(loop.state._replace(record=None), self._fusion)
        self._scaling: ImplicitRoot = jax.tree.map(np.asarray, root)
        fusion: Any = self._fusion
        form = None if fusion is None else fusion.form
        if fusion is not None and not is_concrete(inputs.tie_points, inputs.prior):
            place = fusion.rotation, fusion.translation, fusion.center, fusion.radius
            form = _form_at(*place, inputs.tie_points, inputs.prior)
        self._form = jax.tree.leaves(form)
        equalized = any(term.estimates_gains for term in problem.terms)
        terms = inputs.method.terms(fixed.source, fixed.target, inputs.robust, equalized)
        matches = run.executor.differentiable_matches(loop)
        tables = differentiable_inputs(
            *inputs[:3],
            terms,
            fixed[:3],
            matches.indices.T,
            source_rows=inputs.source_rows,
            observed=problem.source.observed,
            soft=matches.temperature is not None,
        )
        temperature = matches.temperature if inputs.temperature is None else inputs.temperature
        numbers = Motion.of(self._pose), self._scaling, with_numbers_of(terms, loop.terms), temperature
        # g, without tie points and prior.
        self._scored = RowFunction(_score_of_rows, numbers, tables, matches.indices.shape[1], total=True)
        traced = [leaf for leaf in self._form if not is_concrete(leaf)]
        self.arrays = list(arrays) or self._scored.tracers + traced

    def jvp(self, tangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        slopes = {id(self.arrays[i]): tangent for i, tangent in zip(moving, tangents, strict=True)}
        pose, inverse, _ = self._root
        score, count = self._scored.at(Motion.of(pose)), len(tangents[0])
        change = np.broadcast_to(score.jvp(slopes), (count, 6))
        if self._fusion is not None:
            by_score, by_form = self._by_balance(np.eye(6))
            change = change @ by_score.T
            for leaf, by in zip(self._form, by_form, strict=True):
                if id(leaf) in slopes:
                    change = change + slopes[id(leaf)].reshape(count, -1) @ by.reshape(6, -1).T
        return [-change @ (self._by_twist(self._pose) @ inverse).T]

    def vjp(self, cotangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        pose, inverse, _ = self._root
        by_form: list[np.ndarray] = []
        by_score = -(cotangents[0] @ self._by_twist(self._pose)) @ inverse
        if self._fusion is not None:
            by_score, by_form = self._by_balance(by_score)
        arrays = [self.arrays[i] for i in moving]
        # The score has six numbers, so more cotangents of it are combinations of six.
        rows = by_score if len(by_score) <= 6 else np.eye(6)
        slopes = self._scored.at(Motion.of(pose)).cotangents(rows.astype(pose.dtype), arrays)
        slopes = slopes if rows is by_score else [np.tensordot(by_score, slope, 1) for slope in slopes]
        by_leaf = {id(leaf): by for leaf, by in zip(self._form, by_form, strict=True)}
        return [by_leaf.get(id(array), slope) for array, slope in zip(arrays, slopes, strict=True)]

    def _by_balance(self, cotangents: Float[np.ndarray, "c 6"]) -> tuple[np.ndarray, list[np.ndarray]]:
        """Cotangents of the score and of the leaves of the form, from those of the equation with both."""
        pose, _, score = self._root
        slopes = _vjp_of_balance(pose, self._scaling, self._fusion, score, cotangents.astype(pose.dtype))
        by_score, by_form = jax.tree.map(np.asarray, slopes)
        return by_score, jax.tree.leaves(by_form) if self._form else []

    @cached_property
    def _root(self) -> tuple[Float[np.ndarray, "7"], Float[np.ndarray, "6 6"], Float[np.ndarray, "6"]]:
        """The root near the final pose, by Newton's method, and P (Pᵀ ∂g/∂ξ P)⁻¹ Pᵀ and g there; 0 if there is none."""
        pose, root = self._pose, self._scaling
        for _ in range(implicit_derivative.MAX_NEWTON_STEPS if root.usable else 0):
            score, by_motion = self._scored.at(Motion.of(pose)).value_and_jacobian((0, 1))
            # Derivative of rotation matrix and translation by a twist.
            rotation, by_twist = Motion.of(pose.astype(np.float64)).rotation, self._by_twist(pose)
            motion_by_twist = np.zeros((12, 6))
            motion_by_twist[:9, 3:] = np.cross(np.eye(3)[:, :, None], rotation[None], axis=1).reshape(3, 9).T
            motion_by_twist[9:] = by_twist[4:]
            slopes = np.column_stack([slope.reshape(6, -1) for slope in by_motion]) @ motion_by_twist
            both = np.column_stack([score, slopes])
            if self._fusion is not None:
                both = np.asarray(_balance_and_slope(pose, root, self._fusion, both.astype(pose.dtype)), np.float64)
            balance, slope = np.split(both, [1], axis=1)
            within = root.within(slope)
            if not np.linalg.cond(within) < 1 / np.finfo(slope.dtype).eps:
                break
            inverse = np.asarray(root.columns @ np.linalg.inv(within) @ root.rows)
            twist = -(inverse @ balance)[:, 0]
            moved = pose + by_twist @ twist
            moved[:4] /= np.linalg.norm(moved[:4])
            pose = moved.astype(pose.dtype)
            # Convergence is quadratic: after a step below √eps the remaining error is rounding.
            if np.abs(twist).max() <= np.sqrt(np.finfo(pose.dtype).eps):
                return pose, inverse, score.astype(pose.dtype)
        return self._pose, np.zeros((6, 6)), np.zeros(6, pose.dtype)

    def _by_twist(self, pose: Float[np.ndarray, "7"]) -> Float[np.ndarray, "7 6"]:
        """Derivative of pose parameters by a twist about the centre, lengths in units of the radius."""
        lengths = np.array([self._scaling.radius] * 3 + [1.0] * 3)
        return parameters_by_twist(pose.astype(np.float64), np.asarray(self._scaling.center)) * lengths


def _score_of_rows(numbers: tuple[Motion, ImplicitRoot, Any, Any], *rows: Rows) -> Float[Array, "6"]:
    motion, root, terms, temperature = numbers
    return implicit_derivative.score_at(motion, root, matched_rows(rows, temperature), terms)


@quickly_compiled
def _balance_and_slope(
    pose: Float[Array, "7"], root: ImplicitRoot, fusion: Fusion, matches: Float[Array, "6 7"]
) -> Float[Array, "6 7"]:
    """The equation with tie points and a prior, and its derivative by a twist, from those of the matches, g first."""

    def balance(twist: Float[Array, "6"]) -> Float[Array, "6"]:
        motion = implicit_derivative.moved_along(twist, pose, root)
        return fusion.balance(matches[:, 0] + matches[:, 1:] @ twist, motion)

    value, slope = implicit_derivative.value_and_jacobian(balance, jnp.zeros_like(pose[:6]))
    return jnp.concatenate([value[:, None], slope], axis=1)


@quickly_compiled
def _vjp_of_balance(
    pose: Float[Array, "7"], root: ImplicitRoot, fusion: Fusion, score: Float[Array, "6"], rows: Float[Array, "m 6"]
) -> tuple[Float[Array, "m 6"], PoseForm]:
    def balance(score: Float[Array, "6"], form: PoseForm) -> Float[Array, "6"]:
        motion = implicit_derivative.moved_along(jnp.zeros_like(score), pose, root)
        return eqx.tree_at(lambda fusion: fusion.form, fusion, form).balance(score, motion)

    _, vjp = jax.vjp(balance, score, fusion.form)
    return jax.vmap(vjp)(rows)


@with_settings_of_package
def jacobian(run: Run, cloud: str, field: str) -> Float[np.ndarray, "6 ..."]:
    """The derivative of the final pose by an array of a cloud, see `RegistrationResult.jacobian`."""
    side: Any = getattr(run.inputs, cloud)
    array = getattr(side, field)
    if array is None:
        raise ValueError(f"{field}: expected a {cloud} that has some, got None")
    # Arrays are told apart by identity, and the clouds may share this one: a view is another array.
    array = np.asarray(array).view()
    given = run.inputs._replace(**{cloud: side.replace_rows(**{field: array})})
    (by_array,) = parameters_by(given, run, [array])
    if field == "channels":
        # Those that move with the sensor were replaced by 0.
        by_array = by_array * np.any(array, axis=0)
    parameters = run.loop.state.pose.wxyz_xyz
    pose, rotation = np.asarray(parameters, np.float64), Motion.of(parameters).rotation
    twist = np.zeros((6, 7))
    twist[:3, 4:], twist[3:, :4] = rotation.T, rotation.T @ turn_by_quaternion(pose[:4])
    return np.tensordot(translation_adjoint(np.asarray(run.inputs.source.origin)) @ twist, by_array, 1)


def parameters_by(given: Inputs, run: Run, arrays: Sequence[Any]) -> list[Float[np.ndarray, "7 ..."]]:
    """The derivative of the parameters `jaxlie.SE3.wxyz_xyz` of the final pose by concrete arrays among the leaves of
    `given`, the inputs of `run` as they were given."""
    gains, equalized, registered = run.inputs.gains, None, list(arrays)
    if gains is not None:
        equalized = np.asarray(run.inputs.source.channels).view()
        registered = [equalized if array is given.source.channels else array for array in arrays]
    derivative = PoseDerivative(_as_registered(given, run.inputs, equalized), run, registered)
    slopes = derivative.vjp([np.eye(7)], tuple(range(len(arrays))))
    return [slope * gains if moved is equalized else slope for slope, moved in zip(slopes, registered, strict=True)]


def _as_registered(given: Inputs, inputs: Inputs, channels: Any) -> Inputs:
    """What is given, with what the registration has chosen, and with equalised channels of the source, if any."""
    source = given.source if channels is None else given.source.replace_rows(channels=channels)
    method = with_unset_from(given.method, inputs.method)
    return given._replace(source=source, method=method, source_rows=inputs.source_rows)


def _equalized(gains: Float[Array, "C"], channels: Rows, equalized: Rows) -> tuple[Float[Array, "n C"]]:
    """The equalised channels, which have offsets, too, with their derivative by the given channels."""
    return (equalized.tree + gains * (channels.tree - jax.lax.stop_gradient(channels.tree)),)


_form_at = jax.jit(form_at)
_root_on_host = quickly_compiled(root_of, level=0)


def with_derivatives(runs: Sequence[Run], givens: Sequence[Inputs]) -> list[State]:
    """The final states. Poses have derivatives by the traced arrays of `givens` on which they depend, computed side by
    side; origins: see `pose_in_user_frame`."""
    states, derivatives = [run.loop.state for run in runs], dict[int, PoseDerivative]()
    for i, (run, given) in enumerate(zip(runs, givens, strict=True)):
        if is_concrete(given):
            continue
        channels = None if run.inputs.gains is None else run.inputs.source.channels
        if channels is not None and not is_concrete(given.source.channels):
            gains = np.asarray(run.inputs.gains, channels.dtype)
            (channels,) = blockwise(_equalized, gains, Input(given.source.channels), Input(channels))
        derivative = PoseDerivative(_as_registered(given, run.inputs, channels), run)
        if derivative.arrays:
            derivatives[i] = derivative
    if derivatives:
        maps, values = list(derivatives.values()), [np.asarray(states[i].pose.wxyz_xyz) for i in derivatives]
        together = SideBySide(maps, [len(derivative.arrays) for derivative in maps])
        poses = with_derivative(values, together, [array for derivative in maps for array in derivative.arrays])
        for i, pose in zip(derivatives, poses, strict=True):
            states[i] = states[i]._replace(pose=jaxlie.SE3(pose))
    return states
