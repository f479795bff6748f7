"""Registration of two clouds."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float, Int

from mcgicp_jax._channels import eagerly_if, neighbors_of, point_spacing, with_channels_matched
from mcgicp_jax._cloud import PointCloud, Values
from mcgicp_jax._cost import AbstractKernel, centred_pose, check_matches
from mcgicp_jax._dense import default_search
from mcgicp_jax._evidence import Evidence, look
from mcgicp_jax._loop import (
    Assessment,
    Problem,
    Settings,
    State,
    align_traced,
    assess,
    gate,
    refine,
    run_on_host,
    run_traced,
)
from mcgicp_jax._methods import AbstractMethod, MultiChannelGICP, PointToPoint, Surface, prepare
from mcgicp_jax._pose import Pose, is_concrete, pose_matrix, se3_from_matrix
from mcgicp_jax._preprocess import preprocess
from mcgicp_jax._result import Registration, pose_in_user_frame
from mcgicp_jax._search import AbstractSearch, Correspondences
from mcgicp_jax._threads import side_by_side

# Metres; or coarse and fine.
Distance: TypeAlias = ArrayLike | tuple[ArrayLike, ArrayLike]

MAX_ITERATIONS = 64
# Gates as multiples of the target's spacing. With the wide one the pose is found from a start several points away;
# at rest, its pairs across edges and across the border of the overlap pull, and the narrow one leaves those out.
_COARSE_SPACINGS, _FINE_SPACINGS = 10.0, 2.5
# Rows of the source, at least, that find the pose until it is nearly at rest; then all do.
_COARSE_ROWS = 4096
# Nearest-neighbour matches often end in a small cycle; real scans were seen to circle within 0.2 mm and 0.4 mrad.
TRANSLATION_TOLERANCE = 5e-4
ROTATION_TOLERANCE = 5e-4


def find_correspondences(
    source: PointCloud,
    target: PointCloud,
    pose: Pose | None,
    method: AbstractMethod,
    *,
    max_distance: ArrayLike,
    num_candidates: int = 1,
    search: AbstractSearch | None = None,
) -> Correspondences:
    """The match of every source point at a pose: nearest in position and α · channel (Servos & Waslander 2014, IV-A).

    Args:
        source, target: preprocessed clouds.
        pose: T_target_source, `jaxlie.SE3` or (4, 4); None is the identity.
        method: its channel weights span the space that is searched.
        max_distance: metres of position; pairs further apart do not count.
        num_candidates: m, how many target points to find for each source point; more than one for the soft matches of
            `align` and `mahalanobis_cost`. The arrays are then (m, N), nearest first.

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
    if num_candidates < 1:
        raise ValueError(f"num_candidates: expected at least 1, got {num_candidates}")
    indices = _find(search or default_search(), start, source_surface, target_surface, limit, num_candidates)
    return _gate(start, source_surface, target_surface, indices, limit)


_gate = jax.jit(gate)


def _find(
    search: AbstractSearch, pose: jaxlie.SE3, source: Surface, target: Surface, max_distance: Array, num_candidates: int
) -> Int[Array, "*candidates N"]:
    if is_concrete(pose, source, target):
        index = search.index(target.rows)
        found = jnp.asarray(index.nearest(pose.wxyz_xyz, source.rows, max_distance, num_candidates))
    else:
        rows = source.rows, target.rows
        found = search.nearest_traced(pose.wxyz_xyz, *rows, max_distance, jnp.bool_(True), num_candidates)
    return found if num_candidates > 1 else found[0]


def align(
    source: PointCloud,
    target: PointCloud,
    matches: Correspondences,
    method: AbstractMethod,
    *,
    init: Pose | None = None,
    max_iterations: int = MAX_ITERATIONS,
    translation_tolerance: ArrayLike = TRANSLATION_TOLERANCE,
    rotation_tolerance: ArrayLike = ROTATION_TOLERANCE,
    robust: AbstractKernel | None = None,
    temperature: ArrayLike | None = None,
) -> Registration:
    """The pose that balances given matches: updates with M renewed, until the pose rests. Pure JAX.

    Works under `jit`, `vmap`, `grad` and `jvp`. The returned pose is refined to the root of Σ w JᵀM(R) d = 0, and its
    derivative is that of the root: exact for fixed matches and neighbours, with respect to points, channels, given
    covariances, the method's numbers and the robust scale; zero with respect to `init`, on which a root does not
    depend.

    Args:
        source, target: preprocessed clouds.
        matches: from `find_correspondences`.
        method: open numbers are chosen from the data.
        init: T_target_source to start from; the identity by default.
        translation_tolerance, rotation_tolerance: metres and radians; the update that is below both is the last.
        robust: kernel of each pair's Mahalanobis distance.
        temperature: metres; softens several candidates per source point, as in `mahalanobis_cost`.

    Raises:
        ValueError: if an argument does not fit; outcomes of well-formed input are told by `Registration.status`.
    """
    _check_loop(max_iterations, translation_tolerance, rotation_tolerance)
    check_matches(matches, source, temperature)
    method, source_surface, target_surface = _surfaces(source, target, method)
    dtype = source_surface.points.dtype
    start = se3_from_matrix(centred_pose(pose_matrix(init), source, target), dtype)
    settings = _settings(jnp.inf, translation_tolerance, rotation_tolerance, max_iterations, dtype)
    softness = None if temperature is None else jnp.asarray(temperature, dtype)
    model = (source_surface, target_surface, matches, method, robust, softness)
    pose, state, history = align_traced(start, model, settings, max_iterations)
    return registration_of(pose, state, assess(state, model, None), history, source, target)


def register(
    source: PointCloud | Values,
    target: PointCloud | Values,
    method: AbstractMethod,
    *,
    init: Pose | None = None,
    max_distance: Distance | None = None,
    max_iterations: int = MAX_ITERATIONS,
    translation_tolerance: ArrayLike = TRANSLATION_TOLERANCE,
    rotation_tolerance: ArrayLike = ROTATION_TOLERANCE,
    robust: AbstractKernel | None = None,
    search: AbstractSearch | None = None,
    hold_free_directions: bool = True,
    match_channels: bool = False,
    scales: Sequence[float] = (),
) -> Registration:
    """Register two clouds: find matches, update the pose, repeat until it rests.

    Of a large source, some thousands of points find the pose until it is nearly at rest; then all of them do.

    With numbers it runs on the host, between compiled steps. Inside `jit`, `vmap` or `grad` it is one loop whose
    matches come from a callback; its derivatives are those of `align` at the final matches.

    Args:
        source, target: clouds from `preprocess`. Raw clouds and (N, 3) arrays are preprocessed with its defaults, and
            without voxels.
        method: `MultiChannelGICP()`, `GICP()`, `PointToPlane()`, `PointToPoint()` or `ColorICP(...)`.
        init: T_target_source to start from, `jaxlie.SE3` or (4, 4); the identity by default.
        max_distance: metres of position; pairs further apart do not count. Two numbers are one to find the pose with,
            and a smaller one to refine it with once it is nearly at rest. None: 10 and 2.5 times the median distance
            between neighbouring points of the target. A start that is further off needs more.
        max_iterations: how often, at most, matches are found and the pose is updated.
        translation_tolerance, rotation_tolerance: metres (at the centroid of the pairs) and radians; the update that is
            below both is the last.
        robust: kernel of each pair's Mahalanobis distance: `Huber`, `Cauchy`, `GemanMcClure`, `Tukey`.
        search: how matches are found; by default SciPy's k-d tree, on an accelerator `DenseSearch`.
        hold_free_directions: leave the pose where `init` has it in the directions that nothing holds, neither the shape
            of the clouds nor, for the methods that use them, their channels. If False it goes where the nearest
            neighbours pull it. The status is DEGENERATE either way.
        match_channels: whether the source's channels are scaled and shifted to be distributed like the target's, as
            where exposures differ: at first by all points, and once a pose is found, by those that both clouds see
            there; the pose is then found anew from there.
        scales: voxel sizes, metres, coarse to fine, for a start that is far off: the clouds are registered in each of
            them first, with its own default of `max_distance`, and each pose that is found starts the next. With
            numbers alone, outside of transformations.

    Returns:
        The pose and how it ended: see `Registration`; check `converged`.

    Raises:
        ValueError: if an argument does not fit: shapes, dtypes, channel counts, fewer than four finite points.
    """
    check_settings(method, max_distance, max_iterations, translation_tolerance, rotation_tolerance)
    source, target = _ready("source", source), _ready("target", target)
    if match_channels:
        source = _matched(source, target, method)
    for voxel_size in scales:
        found = register(
            _coarser(source, voxel_size),
            _coarser(target, voxel_size),
            method,
            init=init,
            max_iterations=max_iterations,
            robust=robust,
            search=search,
            hold_free_directions=hold_free_directions,
        )
        init = found.matrix if found.converged else init
    search = search or default_search()
    options = max_distance, max_iterations, translation_tolerance, rotation_tolerance, robust, hold_free_directions
    problem = pose_problem(source, target, method, init, *options, search.most_threads)
    state, matches, history = _run(problem, search, max_iterations)
    if match_channels:
        source = _matched(source, target, method, _nearest_points(source, target, problem, state, search))
        problem = pose_problem(source, target, method, None, *options, search.most_threads)
        problem = eqx.tree_at(lambda problem: problem.start, problem, state.pose)
        state, matches, history = _run(problem, search, max_iterations)
    differentiable = problem.source, problem.target, problem.method, problem.robust
    model = problem.model(matches)
    pose = state.pose if is_concrete(differentiable) else refine(state, model)
    return registration_of(pose, state, assess(state, model, problem.evidence), history, source, target)


def _run(
    problem: Problem, search: AbstractSearch, max_iterations: int
) -> tuple[State, Correspondences, dict[str, Any]]:
    """The loop; pose and matches are constants to autodiff."""
    if not is_concrete(problem):
        problem = jax.lax.stop_gradient(problem)
        # Where nothing but a derivative was asked for there are numbers now.
        if not is_concrete(problem):
            return run_traced(problem, search, max_iterations)
    return run_on_host(problem, search)


def pose_problem(
    source: PointCloud,
    target: PointCloud,
    method: AbstractMethod,
    init: Pose | None,
    max_distance: Distance | None,
    max_iterations: int,
    translation_tolerance: ArrayLike,
    rotation_tolerance: ArrayLike,
    robust: AbstractKernel | None,
    hold_free_directions: bool,
    most_threads: int | None,
) -> Problem:
    """What the loop of `register` is about, for prepared clouds."""
    method = _checked(source, target, method)
    seen = _look_at_both(method, source, target, most_threads)
    (source_surface, source_evidence), (target_surface, target_evidence) = seen
    dtype = source_surface.points.dtype
    distances = _usual_distances(target) if max_distance is None else max_distance
    xp = np if is_concrete(source.valid) else jnp
    stride = xp.maximum(xp.sum(xp.asarray(source.valid)) // _COARSE_ROWS, 1)
    return Problem(
        start=se3_from_matrix(centred_pose(pose_matrix(init), source, target), dtype),
        source=source_surface,
        target=target_surface,
        method=method,
        robust=robust,
        settings=_settings(
            distances, translation_tolerance, rotation_tolerance, max_iterations, dtype, hold_free_directions, stride
        ),
        evidence=(source_evidence, target_evidence),
    )


def _look_at_both(
    method: AbstractMethod, source: PointCloud, target: PointCloud, most_threads: int | None
) -> tuple[tuple[Surface, Evidence], tuple[Surface, Evidence]]:
    if not is_concrete(method, source, target):
        return look(method, source), look(method, target)
    # On CPUs a program runs on the thread that calls it, by and large: two threads take half of the time.
    x64, device = jax.enable_x64.value, jax.default_device.value

    def look_at_source() -> tuple[Surface, Evidence]:
        # What a user has set for a block of code holds in that block's thread alone.
        with jax.enable_x64(x64), jax.default_device(device):
            return jax.block_until_ready(look(method, source))

    def look_at_target() -> tuple[Surface, Evidence]:
        return jax.block_until_ready(look(method, target))

    seen_target, seen_source = side_by_side([look_at_target, look_at_source], most_threads)
    return seen_source, seen_target


def _matched(
    source: PointCloud, target: PointCloud, method: AbstractMethod, matches: Correspondences | None = None
) -> PointCloud:
    _check_channels(source, target, method)
    # The channels alone: the origin would come out of the compiled function in float32.
    return source.replace_rows(channels=with_channels_matched(source, target, matches).channels)


def _nearest_points(
    source: PointCloud, target: PointCloud, problem: Problem, state: State, search: AbstractSearch
) -> Correspondences:
    """Which points both clouds see at a pose, whatever their channels."""
    pose = jax.lax.stop_gradient(pose_in_user_frame(state.pose, source.origin, target.origin))
    distance = problem.settings.fine_distance
    return find_correspondences(source, target, pose, PointToPoint(), max_distance=distance, search=search)


def _coarser(cloud: PointCloud, voxel_size: float) -> PointCloud:
    return preprocess(cloud.replace(covariances=None), voxel_size, neighbors_of(cloud).shape[-1])


def _usual_distances(target: PointCloud) -> Float[Array, "2"]:
    with eagerly_if(is_concrete(target)):
        return point_spacing(target) * jnp.array([_COARSE_SPACINGS, _FINE_SPACINGS], target.points.dtype)


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
    method = _checked(source, target, method)
    return method, prepare(method, source), prepare(method, target)


def _checked(source: PointCloud, target: PointCloud, method: AbstractMethod) -> AbstractMethod:
    """The method with its open numbers chosen, for clouds that fit each other and it."""
    _check_method(method)
    for name, cloud in (("source", source), ("target", target)):
        if cloud.points.ndim != 2:
            raise ValueError(
                f"{name}: expected a single cloud, got shape {cloud.points.shape}; use jax.vmap for a batch"
            )
    if method.uses_channels:
        _check_channels(source, target, method)
        if isinstance(method, MultiChannelGICP) and source.channels.shape[-1] == 0:
            warnings.warn("the clouds have no channels: MultiChannelGICP is GICP then", UserWarning, stacklevel=4)
    if source.points.dtype != target.points.dtype:
        raise ValueError(
            f"points: expected one precision in both clouds, got {source.points.dtype} in the source and "
            f"{target.points.dtype} in the target; make them alike before preprocess, as by points.astype(np.float32)"
        )
    return method.resolve(source, target)


def _check_channels(source: PointCloud, target: PointCloud, method: AbstractMethod) -> None:
    if source.channels.shape[-1] != target.channels.shape[-1]:
        raise ValueError(
            f"channels: expected as many in the source as in the target for {type(method).__name__}, "
            f"got {source.channels.shape[-1]} and {target.channels.shape[-1]}"
        )


# Compiled, since as many small calls take ten times as long.
@partial(jax.jit, static_argnames="dtype")
def _settings(
    max_distance: Distance,
    translation_tolerance: ArrayLike,
    rotation_tolerance: ArrayLike,
    max_iterations: ArrayLike,
    dtype: DTypeLike,
    hold_free_directions: ArrayLike = False,
    coarse_stride: ArrayLike = 1,
) -> Settings:
    coarse, fine = jnp.broadcast_to(jnp.asarray(max_distance, dtype), (2,))
    return Settings(
        max_distance=coarse,
        fine_distance=fine,
        coarse_stride=jnp.asarray(coarse_stride, jnp.int32),
        translation_tolerance=jnp.asarray(translation_tolerance, dtype),
        rotation_tolerance=jnp.asarray(rotation_tolerance, dtype),
        max_iterations=jnp.asarray(max_iterations, jnp.int32),
        hold_free_directions=jnp.asarray(hold_free_directions, bool),
    )


def registration_of(
    pose: jaxlie.SE3,
    state: State,
    assessed: Assessment,
    history: dict[str, Any],
    source: PointCloud,
    target: PointCloud,
) -> Registration:
    """The result in the user's frames; NumPy where everything is concrete."""
    matrix = pose_in_user_frame(pose, source.origin, target.origin)
    measured = state.measured
    covariance, directions = assessed
    numbers: Any = {
        "status_code": state.status,
        "num_iterations": state.num_iterations,
        "num_inliers": measured.num_inliers,
        "cost": measured.cost,
        "rmse": measured.rmse,
        "information": state.information,
        "covariance": covariance,
        "directions": directions,
        "history": history,
    }
    valid = source.valid
    if is_concrete(numbers, valid):
        # NumPy's scalars, rather than arrays without dimensions, print as numbers.
        numbers, valid = jax.tree.map(lambda number: np.asarray(number)[()], (numbers, valid))
    numbers["overlap"] = (numbers["num_inliers"] / valid.sum()).astype(numbers["rmse"].dtype)
    if not is_concrete(source.origin) or np.any(source.origin):
        to_centred, from_centred = _translation_adjoint(-source.origin), _translation_adjoint(source.origin)
        # What was not finite stays so, and the status tells.
        with np.errstate(invalid="ignore", over="ignore"):
            numbers["information"] = to_centred.T @ numbers["information"] @ to_centred
            numbers["covariance"] = from_centred @ numbers["covariance"] @ from_centred.T
            if directions is not None:
                moved = numbers["directions"].twists @ from_centred.T, numbers["directions"].center + source.origin
                numbers["directions"] = eqx.tree_at(lambda d: (d.twists, d.center), numbers["directions"], moved)
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


def check_settings(
    method: AbstractMethod,
    max_distance: Distance | None,
    max_iterations: int,
    translation_tolerance: ArrayLike,
    rotation_tolerance: ArrayLike,
) -> None:
    """Raise `ValueError` for what is wrong with `register`'s arguments whatever the clouds."""
    _check_method(method)
    if max_distance is not None:
        _check_distances(max_distance)
    _check_loop(max_iterations, translation_tolerance, rotation_tolerance)


def _check_method(method: AbstractMethod) -> None:
    if not isinstance(method, AbstractMethod):
        raise ValueError(f"method: expected one such as MultiChannelGICP(), got {method!r}")


def _check_positive(name: str, value: ArrayLike) -> None:
    if is_concrete(value) and not (_is_number(value) and np.asarray(value) > 0):
        raise ValueError(f"{name}: expected a positive number, got {value!r}")


def _check_distances(distances: Any) -> None:
    if np.shape(distances) != (2,):
        _check_positive("max_distance", distances)
    elif is_concrete(distances):
        coarse, fine = distances
        if not (_is_number(coarse) and _is_number(fine) and coarse >= fine > 0):
            raise ValueError(f"max_distance: expected a positive number and then a smaller one, got {distances!r}")


def _is_number(value: object) -> bool:
    return np.ndim(value) == 0 and np.asarray(value).dtype.kind in "fiu"  # type: ignore[arg-type]


def _check_loop(max_iterations: int, translation_tolerance: ArrayLike, rotation_tolerance: ArrayLike) -> None:
    if not _is_number(max_iterations) or max_iterations < 1:
        raise ValueError(f"max_iterations: expected at least 1, got {max_iterations!r}")
    for name, value in (("translation_tolerance", translation_tolerance), ("rotation_tolerance", rotation_tolerance)):
        if is_concrete(value) and not (_is_number(value) and np.asarray(value) >= 0):
            raise ValueError(f"{name}: expected a number of at least 0, got {value!r}")
