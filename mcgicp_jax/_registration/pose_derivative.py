"""The derivative of the pose of concrete clouds, outside `jit`: programs over blocks, which no size compiles anew.

A pose has six degrees of freedom, so its derivative by all n numbers of the inputs is a (6, n) matrix, of which a
gradient needs one combination of the rows. The pose is a root of g, see `_pose_solver.implicit_derivative`. Newton's
method finds the root and ∂g/∂ξ by sums over blocks. A cotangent of the pose then becomes one of g, of the matched rows
of both surfaces, and of the points and channels in the neighbourhood of each row. NumPy adds the latter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_array

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.blocks import blocks
from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._compute.linear_maps import AbstractLinearMap, SideBySide, primal, with_derivative
from mcgicp_jax._compute.packing import Packed
from mcgicp_jax._compute.threads import num_cores, side_by_side
from mcgicp_jax._local_geometry.local_statistics import local_geometry_on_host
from mcgicp_jax._local_geometry.neighborhoods import Neighborhoods, gatherer, points_alone
from mcgicp_jax._math.poses import (
    parameters_by_twist,
    rotation_from_quaternion,
    translation_adjoint,
    turn_by_quaternion,
)
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._methods.base import AbstractMethod, with_unset_from
from mcgicp_jax._pose_solver.implicit_derivative import MAX_NEWTON_STEPS, ImplicitRoot
from mcgicp_jax._pose_solver.matched import Motion
from mcgicp_jax._pose_solver.pose_measurements import PoseForm, Prior, TiePoints, form_at
from mcgicp_jax._registration.derivative_programs import (
    Block,
    Columns,
    balance_and_slope,
    pull_balance,
    pull_surface,
    score_and_pull,
)
from mcgicp_jax._registration.loop import LoopResult
from mcgicp_jax._registration.on_host import HostExecutor
from mcgicp_jax._registration.step import State, root_of
from mcgicp_jax._terms.base import AbstractTerm, with_numbers_of

# An input: the cloud and its field, or the parameter and the number of the leaf.
Name = tuple[str, Any]
_FIELDS = ("points", "channels", "covariances")


class Inputs(NamedTuple):
    """The differentiable inputs of a registration.

    Attributes:
        source, target: preprocessed clouds.
        method: with its unset parameters chosen.
        terms: the residuals of each correspondence.
        form: of tie points and prior; None without them.
        temperature: of a soft assignment, metres; None without one.
        source_rows: (n,) rows of the source that are matched; None for all.
    """

    source: PointCloud
    target: PointCloud
    method: AbstractMethod
    terms: tuple[AbstractTerm, ...]
    form: PoseForm | None = None
    temperature: Any = None
    source_rows: Any = None

    def traced(self) -> dict[Name, Any]:
        """The arrays that differentiation traces."""
        leaves: dict[Name, Any] = {
            (side, field): getattr(getattr(self, side), field) for side in ("source", "target") for field in _FIELDS
        }
        for name in ("method", "terms", "form", "temperature"):
            leaves |= {(name, i): leaf for i, leaf in enumerate(_numbers(getattr(self, name)))}
        return {name: leaf for name, leaf in leaves.items() if not is_concrete(leaf)}


class Given(NamedTuple):
    """The arguments of a registration by which its pose can be differentiated; parameters of `method` may be unset."""

    source: PointCloud
    target: PointCloud
    method: AbstractMethod
    robust: AbstractKernel | None = None
    tie_points: TiePoints | None = None
    prior: Prior | None = None
    temperature: Any = None

    def values(self) -> Given:
        """The arguments without the traces of differentiation, see `primal`. Concrete clouds remain the same objects,
        with which derived quantities are cached."""
        return Given(*map(primal, self))


class PoseDerivative(AbstractLinearMap):
    """The derivative of the parameters `jaxlie.SE3.wxyz_xyz` of a final pose by some inputs; 0 if there is none.

    Args:
        names: of these inputs.
        inputs: of the registration, concrete.
        executor, loop: the registration.
        gains: by which the channels of the source were multiplied; None for 1.
    """

    def __init__(self, names: Sequence[Name], inputs: Inputs, executor: HostExecutor, loop: LoopResult, gains: Any):
        self._names, self._inputs, self._gains = names, inputs, gains
        self._matches, self._valid = executor.correspondences(loop)
        self._num_threads, problem = executor.num_threads or num_cores(), executor.problem
        self._pose, self._fusion = np.asarray(loop.state.pose.wxyz_xyz), problem.fusion
        self._scaling: ImplicitRoot = jax.tree.map(np.asarray, root_of(loop.state._replace(record=None), self._fusion))
        self._parameters = with_numbers_of(inputs.terms, loop.terms), inputs.temperature
        self._kinds = tuple(type(term) for term in inputs.terms if term.name)
        soft = inputs.temperature is not None
        columns = [Columns.of(each, each.search if soft else None) for each in (problem.source, problem.target)]
        self._columns = [Packed.of(each) for each in columns]
        self._jacobians: dict[tuple[int, ...], list[np.ndarray]] = {}

    def push(self, tangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        pairs = zip(tangents, self.jacobian(moving), strict=True)
        return [sum(each.reshape(len(each), -1) @ by.reshape(7, -1).T for each, by in pairs)]

    def pull(self, cotangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        (each,) = cotangents
        # One program for any number of cotangents but one.
        return (
            self._pull(each, moving) if len(each) == 1 else [np.tensordot(each, by, 1) for by in self.jacobian(moving)]
        )

    def jacobian(self, moving: tuple[int, ...]) -> list[np.ndarray]:
        """(7, ...) derivative of the pose parameters by each input with one of these numbers."""
        if moving not in self._jacobians:
            self._jacobians[moving] = self._pull(np.eye(7), moving)
        return self._jacobians[moving]

    def _pull(self, cotangents: Float[np.ndarray, "k 7"], moving: tuple[int, ...]) -> list[np.ndarray]:
        names = [self._names[i] for i in moving]
        pose, inverse = self._root
        found: dict[Name, np.ndarray] = {}
        by_score = np.asarray(-(cotangents @ self._by_twist(self._pose)) @ inverse, pose.dtype)
        if self._fusion is not None:
            pulled, by_form = pull_balance(pose, self._scaling, self._fusion, by_score)
            by_score = np.asarray(pulled)
            found |= {("form", i): np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(by_form))}
        tables, by_parameters = self._pull_matches(pose, by_score)
        for parameter, tree in zip(("terms", "temperature"), by_parameters, strict=True):
            found |= {(parameter, i): leaf for i, leaf in enumerate(jax.tree.leaves(tree))}
        by_method = any(parameter == "method" for parameter, _ in names)
        for side, table in zip(("source", "target"), tables, strict=True):
            fields = tuple(field for field in _FIELDS if (side, field) in names) + ("method",) * by_method
            for name, values in self._pull_surface(side, table, fields).items() if fields else ():
                found[name] = found[name] + values if name in found else values
        if self._gains is not None and ("source", "channels") in found:
            found["source", "channels"] *= self._gains
        return [found[name] for name in names]

    @cached_property
    def _root(self) -> tuple[Float[np.ndarray, "7"], Float[np.ndarray, "6 6"]]:
        """The root near the final pose, by Newton's method, and P (Pᵀ ∂g/∂ξ P)⁻¹ Pᵀ there; 0 if there is none."""
        pose, root = self._pose, self._scaling
        for _ in range(MAX_NEWTON_STEPS if root.usable else 0):
            known: Any = np.zeros((6, 13))
            for _, (score, (motion, *_)) in self._over_matches(pose):
                known += np.column_stack([score, *(np.asarray(each).reshape(6, -1) for each in motion)])
            known = np.column_stack([known[:, :1], known[:, 1:] @ self._motion_by_twist(pose)])
            if self._fusion is not None:
                known = np.asarray(balance_and_slope(pose, root, self._fusion, known.astype(pose.dtype)), np.float64)
            balance, slope = np.split(known, [1], axis=1)
            within = root.within(slope)
            if not np.linalg.cond(within) < 1 / np.finfo(slope.dtype).eps:
                break
            inverse = np.asarray(root.columns @ np.linalg.inv(within) @ root.rows)
            twist = -(inverse @ balance)[:, 0]
            moved = pose + self._by_twist(pose) @ twist
            moved[:4] /= np.linalg.norm(moved[:4])
            pose = moved.astype(pose.dtype)
            # Convergence is quadratic: after a step below √eps the remaining error is rounding.
            if np.abs(twist).max() <= np.sqrt(np.finfo(pose.dtype).eps):
                return pose, inverse
        return self._pose, np.zeros((6, 6))

    def _by_twist(self, pose: Float[np.ndarray, "7"]) -> Float[np.ndarray, "7 6"]:
        """Derivative of pose parameters by a twist about the centre, lengths in units of the radius."""
        lengths = np.array([self._scaling.radius] * 3 + [1.0] * 3)
        return parameters_by_twist(pose.astype(np.float64), np.asarray(self._scaling.center)) * lengths

    def _motion_by_twist(self, pose: Float[np.ndarray, "7"]) -> Float[np.ndarray, "12 6"]:
        """Derivative of rotation matrix and translation by the same twist."""
        identity, found = np.eye(3), np.zeros((12, 6))
        rotation = rotation_from_quaternion(pose[:4].astype(np.float64))
        found[:9, 3:] = np.cross(identity[:, :, None], rotation[None], axis=1).reshape(3, 9).T
        found[9:] = self._by_twist(pose)[4:]
        return found

    def _over_matches(self, pose: Float[np.ndarray, "7"]) -> Iterator[tuple[slice, Any]]:
        """The results of `score_and_pull` for each block of matches, in order."""
        motion = Motion(rotation_from_quaternion(pose[:4].astype(np.float64)).astype(pose.dtype), pose[4:])

        def call(rows: slice, index: Any) -> Any:
            valid = self._valid[:, index].copy()
            valid[:, rows.stop - rows.start :] = False
            source, target = self._columns
            block = Block(source.rows(index), target.rows(self._matches[:, index]), valid)
            return score_and_pull(self._parameters, self._scaling, motion, block)

        return self._in_order(call, self._matches.shape[1])

    def _in_order(self, call: Callable[[slice, Any], Any], num_rows: int) -> Iterator[tuple[slice, Any]]:
        """Results for blocks of rows, in order; only as many at once as there are threads, which bounds the memory."""
        cut = blocks(num_rows)
        for start in range(0, len(cut), self._num_threads):
            some = cut[start : start + self._num_threads]
            results = side_by_side([partial(call, *block) for block in some], self._num_threads)
            yield from ((rows, result) for (rows, _), result in zip(some, results, strict=True))

    def _pull_matches(
        self, pose: Float[np.ndarray, "7"], by_score: Float[np.ndarray, "k 6"]
    ) -> tuple[list[Float[np.ndarray, "N k L"]], Any]:
        """Cotangents of the tables of both clouds and of the parameters."""
        shapes = [each.table.shape for each in self._columns]
        tables = [np.zeros((size, len(by_score), width), by_score.dtype) for size, width in shapes]
        total: Any = None
        for rows, (_, (_, *found)) in self._over_matches(pose):
            source, target, numbers = jax.tree.map(lambda rows: np.tensordot(by_score, rows, 1), found)
            count = rows.stop - rows.start
            tables[0][rows] = source[:, :count].swapaxes(0, 1)
            _add_rows(tables[1], self._matches[:, rows], np.moveaxis(target[:, :, :count], 0, 2))
            numbers = jax.tree.map(lambda leaf: leaf.astype(np.float64), numbers)
            total = numbers if total is None else jax.tree.map(np.add, total, numbers)
        return tables, total

    def _pull_surface(
        self, side: str, table: Float[np.ndarray, "N k L"], fields: tuple[str, ...]
    ) -> dict[Name, np.ndarray]:
        """Cotangents of fields of a cloud, and of the method, from those of its table."""
        cloud, method = getattr(self._inputs, side), self._inputs.method
        some = self._inputs.source_rows if side == "source" else None
        among = np.arange(len(cloud.points)) if some is None else some
        gather, soft, local = _gatherer(cloud, method), self._inputs.temperature is not None, None
        if cloud.deferred_neighbors is not None and "points" not in fields:
            local = Packed.of(local_geometry_on_host(cloud, method.uses_channels, self._num_threads, some))
        valid = None if cloud.channel_valid is None else np.asarray(cloud.channel_valid)

        def call(rows: slice, index: Any) -> Any:
            masks = (None if valid is None else valid[index], np.asarray(cloud.valid)[index]) if soft else None
            by_rows = table[index].copy()
            by_rows[rows.stop - rows.start :] = 0
            here = None if local is None else local.rows(index)
            return pull_surface(self._kinds, fields, method, gather(among[index]), here, masks, by_rows)

        count, num_channels = table.shape[1], cloud.channels.shape[1] if method.uses_channels else 0
        widths = {"points": 3 * ("points" in fields), "channels": num_channels * ("channels" in fields)}
        columns = np.zeros((len(cloud.points), count, sum(widths.values())))
        found: dict[Name, Any] = {}
        if "covariances" in fields:
            found[side, "covariances"] = np.zeros((count, len(cloud.points), 3, 3))
        for places, (own, near, given, numbers) in self._in_order(call, len(table)):
            size, rows = places.stop - places.start, among[places]
            if own is not None:
                columns[rows] += np.asarray(own)[:size].reshape(size, *columns.shape[1:])
            if near is not None:
                _add_rows(columns, np.asarray(cloud.neighbors)[rows].T, np.asarray(near)[:, :size])
            if given is not None:
                found[side, "covariances"][:, rows] = np.asarray(given)[:, :size]
            for i, leaf in enumerate(jax.tree.leaves(numbers)):
                found["method", i] = found.get(("method", i), 0) + np.asarray(leaf, np.float64)
        columns = columns.swapaxes(0, 1)
        if "points" in fields:
            found[side, "points"] = columns[..., :3]
        if "channels" in fields:
            found[side, "channels"] = (
                columns[..., widths["points"] :] if num_channels else np.zeros((count, *cloud.channels.shape))
            )
        return found


def jacobian(
    inputs: Inputs, executor: HostExecutor, loop: LoopResult, gains: Any, cloud: str, field: str
) -> Float[np.ndarray, "6 ..."]:
    """The derivative of the final pose by an array of a cloud, see `RegistrationResult.jacobian`."""
    if getattr(getattr(inputs, cloud), field) is None:
        raise ValueError(f"{field}: expected a {cloud} that has some, got None")
    (by_array,) = PoseDerivative([(cloud, field)], inputs, executor, loop, gains).jacobian((0,))
    pose, rotation = np.asarray(loop.state.pose.wxyz_xyz, np.float64), executor.motion(loop.state.pose).rotation
    twist = np.zeros((6, 7))
    twist[:3, 4:], twist[3:, :4] = rotation.T, rotation.T @ turn_by_quaternion(pose[:4])
    return np.tensordot(translation_adjoint(np.asarray(inputs.source.origin)) @ twist, by_array, 1)


class Differentiated(NamedTuple):
    """A pose, and the arrays that differentiation traces, by which it has a derivative."""

    derivative: PoseDerivative
    arrays: list[Any]


def differentiated(
    given: Given, inputs: Inputs, executor: HostExecutor, loop: LoopResult, gains: Any
) -> Differentiated | None:
    """The final pose of a registration and the traced arrays among its arguments on which it depends; None if there
    are none. Origins are added later, see `pose_in_user_frame`."""
    if is_concrete(given):
        return None
    method = with_unset_from(given.method, inputs.method)
    equalized = any(term.estimates_gains for term in inputs.terms)
    terms = method.terms(inputs.source, inputs.target, given.robust, equalized)
    fusion, form = executor.problem.fusion, None
    if fusion is not None:
        form = _form_at(fusion.rotation, fusion.translation, fusion.center, fusion.radius, *given[4:6])
    traced = Inputs(given.source, given.target, method, terms, form, given.temperature).traced()
    if not traced:
        return None
    return Differentiated(PoseDerivative(list(traced), inputs, executor, loop, gains), list(traced.values()))


_form_at = jax.jit(form_at)


def with_derivatives(states: Sequence[State], found: Sequence[Differentiated | None]) -> list[State]:
    """The final states; their poses have derivatives, which are computed side by side."""
    some = [(i, each) for i, each in enumerate(found) if each is not None]
    if not some:
        return list(states)
    together = SideBySide([each.derivative for _, each in some], [len(each.arrays) for _, each in some])
    values = [np.asarray(states[i].pose.wxyz_xyz) for i, _ in some]
    poses = with_derivative(values, together, [array for _, each in some for array in each.arrays])
    attached = {i: jaxlie.SE3(pose) for (i, _), pose in zip(some, poses, strict=True)}
    return [state._replace(pose=attached.get(i, state.pose)) for i, state in enumerate(states)]


def _numbers(tree: Any) -> list[Any]:
    """The leaves that can be differentiated by, in the order of `jax.tree.leaves`."""
    return [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)]


def _gatherer(cloud: PointCloud, method: AbstractMethod) -> Callable[[Any], Neighborhoods]:
    """Neighbourhoods of rows, with the covariances that were given, and with channels where the method uses these."""
    if cloud.deferred_neighbors is not None:
        return gatherer(cloud, method.uses_channels, np, with_given=True)
    gather, channels = points_alone(cloud, np), np.asarray(cloud.channels).T
    if not method.uses_channels:
        channels = channels[:0]
    return lambda rows: gather(rows)._replace(own_channels=channels[:, rows])


def _add_rows(
    total: Float[np.ndarray, "N k L"], rows: Int[np.ndarray, "m n"], values: Float[np.ndarray, "m n ..."]
) -> None:
    """Add values to rows that may repeat; negative ones are left out. `np.add.at` takes ten times as long."""
    rows, values = rows.reshape(-1), values.reshape(rows.size, -1)
    weights = (rows >= 0).astype(values.dtype)
    size = rows.size
    some, places = np.unique(np.maximum(rows, 0), return_inverse=True)
    sums = csc_array((weights, places.reshape(-1), np.arange(size + 1)), shape=(len(some), size)) @ values
    total[some] += sums.reshape(len(some), *total.shape[1:])
