"""Registration: one step, and the drivers that repeat it.

Find matches at this pose; weigh them; update the pose; stop when it no longer moves.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._cloud import PointCloud, Values
from mcgicp_jax._cost import AbstractKernel, Moments, centred_pose, evaluate_pairs, match_residual, moments
from mcgicp_jax._methods import AbstractMethod, Surface, prepare
from mcgicp_jax._pose import Pose, is_concrete, pose_matrix, se3_from_matrix
from mcgicp_jax._preprocess import preprocess
from mcgicp_jax._result import Registration, Status, pose_in_user_frame
from mcgicp_jax._search import AbstractSearch, Correspondences, KDTreeSearch
from mcgicp_jax._solve import information_at_source, move_pose, refine_pose, solve_update

_RUNNING = -1
_MIN_CORRESPONDENCES = 4
_MAX_ITERATIONS = 64
_TRANSLATION_TOLERANCE = 1e-4
_ROTATION_TOLERANCE = 1e-5


class Settings(eqx.Module):
    """Numbers of the loop, as arrays: changing one compiles nothing."""

    max_distance: Float[Array, ""]
    translation_tolerance: Float[Array, ""]
    rotation_tolerance: Float[Array, ""]
    max_iterations: Int[Array, ""]


class Measurement(eqx.Module):
    """What one pass over the matched pairs finds at a pose."""

    moments: Moments
    num_inliers: Int[Array, ""]
    cost: Float[Array, ""]
    rmse: Float[Array, ""]


class State(eqx.Module):
    """Where the loop stands.

    Attributes:
        pose: the next pose while the loop runs; the one that was measured when it ends.
        status: value of a `Status`, or `_RUNNING`.
        num_iterations: measurements so far.
        measured: at the pose before.
        information: (6, 6) at the pose before.
        record: one number per entry of `Registration.history`.
    """

    pose: jaxlie.SE3
    status: Int[Array, ""]
    num_iterations: Int[Array, ""]
    measured: Measurement
    information: Float[Array, "6 6"]
    record: dict[str, Float[Array, ""]]


Carry: TypeAlias = tuple[State, Correspondences, dict[str, Array]]


def gate(
    pose: jaxlie.SE3, source: Surface, target: Surface, indices: Int[Array, "N"], max_distance: Float[Array, ""]
) -> Correspondences:
    """Keep the pairs within `max_distance`, metres of position: channels choose a match, but do not gate it."""
    rotation = pose.rotation().as_matrix().astype(source.points.dtype)
    _, residual = match_residual(rotation, pose.translation(), source, target, indices)
    distances = jnp.sqrt(jnp.sum(residual * residual, axis=0))
    valid = source.valid & target.valid[indices] & (distances <= max_distance)
    return Correspondences(indices=indices, distances=distances, valid=valid)


@jax.jit
def measure(
    pose: jaxlie.SE3,
    matches: Correspondences,
    source: Surface,
    target: Surface,
    method: AbstractMethod,
    robust: AbstractKernel | None,
) -> Measurement:
    """Weigh the matches at the pose: the only part of a step that touches the points."""
    rotation = pose.rotation().as_matrix().astype(source.points.dtype)
    pairs = evaluate_pairs(rotation, pose.translation(), source, target, matches, method, robust)
    num_inliers = jnp.sum(matches.valid)
    square = jnp.sum(pairs.residual * pairs.residual, axis=0)
    return Measurement(
        moments=moments(pairs, matches),
        num_inliers=num_inliers,
        cost=jnp.sum(pairs.cost),
        rmse=jnp.sqrt(jnp.sum(square) / jnp.maximum(num_inliers, 1)),
    )


@jax.jit
def match_and_measure(
    pose: jaxlie.SE3,
    indices: Int[Array, "N"],
    source: Surface,
    target: Surface,
    method: AbstractMethod,
    robust: AbstractKernel | None,
    settings: Settings,
) -> tuple[Correspondences, Measurement]:
    matches = gate(pose, source, target, indices, settings.max_distance)
    return matches, measure(pose, matches, source, target, method, robust)


@jax.jit
def update(pose: jaxlie.SE3, num_iterations: Int[Array, ""], measured: Measurement, settings: Settings) -> State:
    """Update the pose unless it has come to rest. Compiled once, whatever the size of the clouds."""
    change = solve_update(measured.moments)
    moved = move_pose(pose, change.twist, measured.moments.center)
    num_iterations = num_iterations + 1
    translation_step = jnp.linalg.norm(change.twist[:3])
    rotation_step = jnp.linalg.norm(change.twist[3:])
    at_rest = (translation_step <= settings.translation_tolerance) & (rotation_step <= settings.rotation_tolerance)
    finite = jnp.isfinite(measured.moments.e) & jnp.all(jnp.isfinite(moved.wxyz_xyz))
    outcomes: tuple[tuple[Array, Status], ...] = (
        (measured.num_inliers < _MIN_CORRESPONDENCES, Status.TOO_FEW_CORRESPONDENCES),
        (~finite, Status.NON_FINITE),
        (at_rest & change.degenerate, Status.DEGENERATE),
        (at_rest, Status.CONVERGED),
        (num_iterations >= settings.max_iterations, Status.MAX_ITERATIONS),
    )
    conditions, codes = zip(*outcomes, strict=True)
    status = jnp.select(list(conditions), [jnp.int32(code) for code in codes], jnp.int32(_RUNNING))
    record = {
        "cost": measured.cost,
        "rmse": measured.rmse,
        "num_inliers": measured.num_inliers.astype(measured.rmse.dtype),
        "translation_step": translation_step,
        "rotation_step": rotation_step,
    }
    return State(
        # The pose that all this was measured at is the one that is returned.
        pose=jaxlie.SE3(jnp.where(status == _RUNNING, moved.wxyz_xyz, pose.wxyz_xyz)),
        status=status,
        num_iterations=num_iterations,
        measured=measured,
        information=information_at_source(change.information, pose, measured.moments.center),
        record=record,
    )


def _run_on_host(
    pose: jaxlie.SE3,
    source: Surface,
    target: Surface,
    method: AbstractMethod,
    robust: AbstractKernel | None,
    settings: Settings,
    search: AbstractSearch,
) -> tuple[State, Correspondences, dict[str, np.ndarray]]:
    """The loop for concrete inputs: matches from the host's tree between compiled steps."""
    index = search.index(target.points, target.descriptors, target.valid)
    num_iterations = jnp.int32(0)
    records = []
    while True:
        indices = index.nearest(pose.wxyz_xyz, source.points, source.descriptors, source.valid, settings.max_distance)
        matches, measured = match_and_measure(pose, indices, source, target, method, robust, settings)
        state = update(pose, num_iterations, measured, settings)
        records.append(state.record)
        if state.status != _RUNNING:
            break
        pose, num_iterations = state.pose, state.num_iterations
    records = jax.device_get(records)
    return state, matches, {name: np.array([record[name] for record in records]) for name in records[0]}


def _run_traced(
    pose: jaxlie.SE3,
    match: Callable[[jaxlie.SE3, Bool[Array, ""]], tuple[Correspondences, Measurement]],
    settings: Settings,
    max_iterations: int,
) -> Carry:
    """The loop inside a transformation. `match(pose, running)` finds the pairs and weighs them."""

    def advance(pose: jaxlie.SE3, num_iterations: Array, running: Array) -> tuple[State, Correspondences]:
        matches, measured = match(pose, running)
        return update(pose, num_iterations, measured, settings), matches

    def body(carry: Carry) -> Carry:
        before, _, history = carry
        state, matches = advance(before.pose, before.num_iterations, before.status == _RUNNING)
        history = {name: values.at[before.num_iterations].set(state.record[name]) for name, values in history.items()}
        return state, matches, history

    shapes = jax.eval_shape(advance, pose, jnp.int32(0), jnp.bool_(True))
    state, matches = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    state = eqx.tree_at(lambda state: (state.pose, state.status), state, (pose, jnp.int32(_RUNNING)))
    history = {name: jnp.full(max_iterations, jnp.nan, value.dtype) for name, value in state.record.items()}
    return jax.lax.while_loop(lambda carry: carry[0].status == _RUNNING, body, (state, matches, history))


def find_correspondences(
    source: PointCloud,
    target: PointCloud,
    pose: Pose | None,
    method: AbstractMethod,
    *,
    max_distance: ArrayLike,
    search: AbstractSearch | None = None,
) -> Correspondences:
    """The match of every source point at a pose: nearest in position and α · channel (Servos & Waslander 2014, IV-A).

    Args:
        source, target: preprocessed clouds.
        pose: T_target_source, `jaxlie.SE3` or (4, 4); None is the identity.
        method: its channel weights span the space that is searched.
        max_distance: metres of position; pairs further apart do not count.

    Raises:
        ValueError: if `max_distance` is not positive or the clouds' channels do not fit each other or the method.
    """
    method, source_surface, target_surface = _surfaces(source, target, method)
    dtype = source_surface.points.dtype
    matrix = centred_pose(pose_matrix(pose, "pose"), source, target)
    _check_positive("max_distance", max_distance)
    args = jax.lax.stop_gradient((se3_from_matrix(matrix, dtype), source_surface, target_surface))
    start, source_surface, target_surface = args
    limit = jnp.asarray(max_distance, dtype)
    indices = _find(search or KDTreeSearch(), start, source_surface, target_surface, limit)
    return _gate(start, source_surface, target_surface, indices, limit)


_gate = jax.jit(gate)


def _find(
    search: AbstractSearch, pose: jaxlie.SE3, source: Surface, target: Surface, max_distance: Array
) -> Int[Array, "N"]:
    if is_concrete(pose, source, target):
        index = search.index(target.points, target.descriptors, target.valid)
        return jnp.asarray(index.nearest(pose.wxyz_xyz, source.points, source.descriptors, source.valid, max_distance))
    return _nearest_traced(search, pose, source, target, max_distance, jnp.bool_(True))


def _nearest_traced(
    search: AbstractSearch,
    pose: jaxlie.SE3,
    source: Surface,
    target: Surface,
    max_distance: Float[Array, ""],
    running: Bool[Array, ""],
) -> Int[Array, "N"]:
    source_rows, target_rows = ((cloud.points, cloud.descriptors, cloud.valid) for cloud in (source, target))
    return search.nearest_traced(pose.wxyz_xyz, source_rows, target_rows, max_distance, running)


def align(
    source: PointCloud,
    target: PointCloud,
    matches: Correspondences,
    method: AbstractMethod,
    *,
    init: Pose | None = None,
    max_iterations: int = _MAX_ITERATIONS,
    translation_tolerance: ArrayLike = _TRANSLATION_TOLERANCE,
    rotation_tolerance: ArrayLike = _ROTATION_TOLERANCE,
    robust: AbstractKernel | None = None,
) -> Registration:
    """The pose that balances given matches: updates with M renewed, until the pose rests. Pure JAX.

    Works under `jit`, `vmap`, `grad` and `jvp`. The returned pose is refined to the root of Σ w JᵀM(R) d = 0, and its
    derivative is that of the root: exact for fixed matches and neighbours, with respect to points, channels, given
    covariances, the method's numbers and the robust scale; zero with respect to `init`, on which a root does not depend.

    Args:
        source, target: preprocessed clouds.
        matches: from `find_correspondences`.
        method: open numbers are chosen from the data.
        init: T_target_source to start from; the identity by default.
        translation_tolerance, rotation_tolerance: metres and radians; the pose rests once an update is below
            both.
        robust: kernel of each pair's Mahalanobis distance.

    Raises:
        ValueError: if an argument does not fit; outcomes of well-formed input are told by `Registration.status`.
    """
    _check_loop(max_iterations, translation_tolerance, rotation_tolerance)
    if matches.indices.shape != source.points.shape[:1]:
        raise ValueError(
            f"matches: expected one per source row ({source.points.shape[0]}), got shape {matches.indices.shape}"
        )
    method, source_surface, target_surface = _surfaces(source, target, method)
    dtype = source_surface.points.dtype
    start = se3_from_matrix(centred_pose(pose_matrix(init), source, target), dtype)
    settings = _settings(jnp.inf, translation_tolerance, rotation_tolerance, max_iterations, dtype)
    pose, state, history = _align(
        start, source_surface, target_surface, matches, method, robust, settings, max_iterations
    )
    return _registration(pose, state, history, source, target)


@partial(jax.jit, static_argnames="max_iterations")
def _align(
    start: jaxlie.SE3,
    source: Surface,
    target: Surface,
    matches: Correspondences,
    method: AbstractMethod,
    robust: AbstractKernel | None,
    settings: Settings,
    max_iterations: int,
) -> tuple[jaxlie.SE3, State, dict[str, Array]]:
    constants = jax.lax.stop_gradient((matches, source, target, method, robust))

    def match(pose: jaxlie.SE3, running: Bool[Array, ""]) -> tuple[Correspondences, Measurement]:
        return matches, measure(pose, *constants)

    state, _, history = _run_traced(
        jax.lax.stop_gradient(start), match, jax.lax.stop_gradient(settings), max_iterations
    )
    return _refine(state, matches, source, target, method, robust), state, history


def register(
    source: PointCloud | Values,
    target: PointCloud | Values,
    method: AbstractMethod,
    *,
    init: Pose | None = None,
    max_distance: ArrayLike,
    max_iterations: int = _MAX_ITERATIONS,
    translation_tolerance: ArrayLike = _TRANSLATION_TOLERANCE,
    rotation_tolerance: ArrayLike = _ROTATION_TOLERANCE,
    robust: AbstractKernel | None = None,
    search: AbstractSearch | None = None,
) -> Registration:
    """Register two clouds: find matches, update the pose, repeat until it rests.

    With numbers it runs on the host, between compiled steps. Inside `jit`, `vmap` or `grad` it is one loop whose matches
    come from a callback; its derivatives are those of `align` at the final matches.

    Args:
        source, target: clouds from `preprocess`. Raw clouds and (N, 3) arrays are preprocessed with its defaults, and
            without voxels.
        method: `MultiChannelGICP()`, `GICP()`, `PointToPlane()`, `PointToPoint()` or `ColorICP(...)`.
        init: T_target_source to start from, `jaxlie.SE3` or (4, 4); the identity by default.
        max_distance: metres of position; pairs further apart do not count.
        max_iterations: of finding matches and updating.
        translation_tolerance, rotation_tolerance: metres (at the centroid of the pairs) and radians; the pose rests once
            an update is below both.
        robust: kernel of each pair's Mahalanobis distance: `Huber`, `Cauchy`, `GemanMcClure`, `Tukey`.
        search: how matches are found; by default SciPy's k-d tree.

    Returns:
        The pose and how it ended: see `Registration`; check `converged`.

    Raises:
        ValueError: if an argument does not fit: shapes, dtypes, channel counts, fewer than four finite points.
    """
    _check_positive("max_distance", max_distance)
    _check_loop(max_iterations, translation_tolerance, rotation_tolerance)
    source, target = _ready("source", source), _ready("target", target)
    method, source_surface, target_surface = _surfaces(source, target, method)
    dtype = source_surface.points.dtype
    start = se3_from_matrix(centred_pose(pose_matrix(init), source, target), dtype)
    settings = _settings(max_distance, translation_tolerance, rotation_tolerance, max_iterations, dtype)
    search = search or KDTreeSearch()
    differentiable = (source_surface, target_surface, method, robust)
    constants = jax.lax.stop_gradient((start, *differentiable, settings))
    if is_concrete(constants):
        state, matches, history = _run_on_host(*constants, search)
    else:
        state, matches, history = _search_traced(*constants, search, max_iterations)
    if is_concrete(differentiable):
        return _registration(state.pose, state, history, source, target)
    pose = _refine(state, matches, *differentiable)
    return _registration(pose, state, history, source, target)


@partial(jax.jit, static_argnames="max_iterations")
def _search_traced(
    start: jaxlie.SE3,
    source: Surface,
    target: Surface,
    method: AbstractMethod,
    robust: AbstractKernel | None,
    settings: Settings,
    search: AbstractSearch,
    max_iterations: int,
) -> Carry:
    """The loop of `register` for traced inputs; pose and matches are constants to autodiff."""

    def match(pose: jaxlie.SE3, running: Bool[Array, ""]) -> tuple[Correspondences, Measurement]:
        indices = _nearest_traced(search, pose, source, target, settings.max_distance, running)
        return match_and_measure(pose, indices, source, target, method, robust, settings)

    return _run_traced(start, match, settings, max_iterations)


@jax.jit
def _refine(
    state: State,
    matches: Correspondences,
    source: Surface,
    target: Surface,
    method: AbstractMethod,
    robust: AbstractKernel | None,
) -> jaxlie.SE3:
    usable = (state.status == Status.CONVERGED) | (state.status == Status.MAX_ITERATIONS)
    return refine_pose(state.pose, usable, state.measured.moments, source, target, matches, method, robust)


def _ready(name: str, cloud: PointCloud | Values) -> PointCloud:
    try:
        if not isinstance(cloud, PointCloud):
            cloud = PointCloud(cloud)
        if cloud.neighbors is None:
            cloud = preprocess(cloud)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    return cloud


def _surfaces(
    source: PointCloud, target: PointCloud, method: AbstractMethod
) -> tuple[AbstractMethod, Surface, Surface]:
    if not isinstance(method, AbstractMethod):
        raise ValueError(f"method: expected one such as MultiChannelGICP(), got {method!r}")
    if method.uses_channels and source.channels.shape[-1] != target.channels.shape[-1]:
        raise ValueError(
            f"channels: expected as many in the source as in the target for {type(method).__name__}, "
            f"got {source.channels.shape[-1]} and {target.channels.shape[-1]}"
        )
    if source.points.dtype != target.points.dtype:
        raise ValueError(
            f"points: expected one precision in both clouds, got {source.points.dtype} and {target.points.dtype}"
        )
    method = method.resolve(source, target)
    return method, prepare(method, source), prepare(method, target)


def _settings(
    max_distance: ArrayLike,
    translation_tolerance: ArrayLike,
    rotation_tolerance: ArrayLike,
    max_iterations: int,
    dtype: DTypeLike,
) -> Settings:
    return Settings(
        max_distance=jnp.asarray(max_distance, dtype),
        translation_tolerance=jnp.asarray(translation_tolerance, dtype),
        rotation_tolerance=jnp.asarray(rotation_tolerance, dtype),
        max_iterations=jnp.int32(max_iterations),
    )


def _registration(
    pose: jaxlie.SE3, state: State, history: dict[str, Any], source: PointCloud, target: PointCloud
) -> Registration:
    """The result in the user's frames; NumPy where everything is concrete."""
    matrix = pose_in_user_frame(pose, source.origin, target.origin)
    measured = state.measured
    numbers: Any = {
        "status_code": state.status,
        "num_iterations": state.num_iterations,
        "num_inliers": measured.num_inliers,
        "cost": measured.cost,
        "rmse": measured.rmse,
        "information": state.information,
        "history": history,
    }
    if is_concrete(numbers):
        # NumPy's scalars, rather than arrays without dimensions, print as numbers.
        numbers = jax.tree.map(lambda number: np.asarray(number)[()], numbers)
    if not is_concrete(source.origin) or np.any(source.origin):
        adjoint = _translation_adjoint(-source.origin)
        numbers["information"] = adjoint.T @ numbers["information"] @ adjoint
    return Registration(
        T_target_source=se3_from_matrix(matrix, pose.wxyz_xyz.dtype),
        source_origin=source.origin,
        target_origin=target.origin,
        centred=pose,
        **numbers,
    )


def _translation_adjoint(offset: Array | np.ndarray) -> Array | np.ndarray:
    """Ad of a pure translation for twists (v, ω)."""
    xp = np if isinstance(offset, np.ndarray) else jnp
    zero = xp.zeros_like(offset[0])
    x, y, z = offset
    cross = xp.stack([xp.stack([zero, -z, y]), xp.stack([z, zero, -x]), xp.stack([-y, x, zero])])
    return xp.block([[xp.eye(3), cross], [xp.zeros((3, 3)), xp.eye(3)]])


def _check_positive(name: str, value: ArrayLike) -> None:
    if is_concrete(value) and not (np.ndim(value) == 0 and np.asarray(value) > 0):
        raise ValueError(f"{name}: expected a positive number, got {value!r}")


def _check_loop(max_iterations: int, translation_tolerance: ArrayLike, rotation_tolerance: ArrayLike) -> None:
    if max_iterations < 1:
        raise ValueError(f"max_iterations: expected at least 1, got {max_iterations!r}")
    for name, value in (("translation_tolerance", translation_tolerance), ("rotation_tolerance", rotation_tolerance)):
        if is_concrete(value) and not (np.ndim(value) == 0 and np.asarray(value) >= 0):
            raise ValueError(f"{name}: expected a number of at least 0, got {value!r}")
