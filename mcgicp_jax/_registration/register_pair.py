"""Registration of two clouds: `register`, its start `global_pose`, and its parts `find_correspondences` and `align`."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from mcgicp_jax._clouds.point_cloud import PointCloud, Values
from mcgicp_jax._clouds.preprocess import preprocess
from mcgicp_jax._compute.argument_checks import check_integer, check_positive
from mcgicp_jax._compute.cache import cached_with
from mcgicp_jax._compute.concrete import constant, is_concrete, numpy_for, outside_trace
from mcgicp_jax._global_registration.global_pose import GlobalPoseResult, RowMatches, find_pose
from mcgicp_jax._local_geometry.spacing_and_noise import grid_spacing, warn_of_units, with_channels_matched
from mcgicp_jax._math.poses import Pose, se3_from_matrix
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._math.statistics import median, sampled_rows
from mcgicp_jax._methods.base import GICP, AbstractMethod, MultiChannelGICP, PointToPoint
from mcgicp_jax._methods.surface import searchable, surfaces_of
from mcgicp_jax._pose_solver.covariance import Moments
from mcgicp_jax._pose_solver.sums import matched_rows, move_rows, within
from mcgicp_jax._registration.cost import centred_pose, check_matches
from mcgicp_jax._registration.measurements import GivenPrior, GivenTiePoints, fusion_of, known
from mcgicp_jax._registration.on_host import correspondences_at, register_on_host
from mcgicp_jax._registration.options import ROTATION_TOLERANCE, Distance, Options, check_method
from mcgicp_jax._registration.outcome import registration_of
from mcgicp_jax._registration.result import Registration, Status, is_usable, pose_in_user_frame
from mcgicp_jax._registration.step import Assessment, Problem, Settings, State
from mcgicp_jax._registration.traced import align_traced, assess, differentiable, moments_of, register_traced
from mcgicp_jax._search.base import AbstractIndex, AbstractSearch, Correspondences
from mcgicp_jax._search.brute_force import default_search

# Default maximum correspondence distances of the coarse and the fine phase, in spacings of the target. With the larger
# one, starts several spacings off converge, but matches across edges and the border of the overlap bias the final pose;
# the smaller one rejects these. The coarse phase needs the spacing between scan lines, too: with that along the lines
# alone, raw scans of KITTI, 1.3 m apart, stayed at the identity.
_COARSE_SPACINGS, _FINE_SPACINGS = 10.0, 2.5
# Smallest and largest trace, relative to that of GICP's covariances (2: they are 1 within the surface), of covariances
# given with one of the clouds, for which no warning is issued. That of cells in m² is a sixth of their squared edge.
_LEAST_TRACE, _LARGEST_TRACE = 0.25, 4.0
# Default translation tolerance, in spacings of the target: 0.5 mm at 0.1 m, chosen like `ROTATION_TOLERANCE`.
_TOLERANCE_IN_SPACINGS = 0.005
# Tolerances of the coarse phase, in tolerances, of which the default ones are the least: with tighter ones, the small
# cycles of matching would keep the coarse phase from ending.
_COARSE_TOLERANCE = 10.0
# Least number of source points in a subsampled coarse phase: enough to find a pose nearly as well as all.
_COARSE_ROWS = 4096


def global_pose(
    source: PointCloud | Values,
    target: PointCloud | Values,
    *,
    voxel_size: float | None = None,
    correspondences: RowMatches | None = None,
) -> GlobalPoseResult:
    """Estimate the pose between two clouds without an initial pose. To refine it, pass its `matrix` to `register`.

    The steps are: (1) describe each voxel by FPFH (Rusu et al. 2009) and, if both clouds have the same number of
    channels, by the means and standard deviations of the channels around it; (2) match voxels that are mutual nearest
    neighbours in these features, of which most may be wrong; (3) compute poses from triplets of matches that agree with
    each other; (4) refine them by graduated non-convexity (Yang et al. 2020); (5) verify the best by a coarse
    registration, which uses the channels. The same clouds give the same result, to the last bit. Runs on the host, with
    programs whose shapes do not depend on the clouds.

    Args:
        source, target: raw or preprocessed clouds, or (N, 3) arrays in metres; they may lie anywhere, in any rotation.
        voxel_size: metres. By default the smallest size at which the smaller cloud has at most 6,000 voxels, the larger
            one at most 20,000, and each at most half as many voxels as points.
        correspondences: integer arrays (n,) of source rows and (n,) of target rows that replace steps 1 and 2, such as
            those of `image_matches`. At most 1,024 matches are used, evenly spaced; most may be wrong.

    Returns:
        The pose, with `success` to tell whether to trust it.

    Raises:
        ValueError: if a cloud has fewer than four finite points, or an argument is malformed. Failures on well-formed
            clouds show in `success`.
    Warns:
        UserWarning: if points with NaN or infinity are left out.
    """
    return find_pose(source, target, voxel_size, correspondences, register_with)


def find_correspondences(
    source: PointCloud,
    target: PointCloud,
    pose: Pose | None,
    method: AbstractMethod,
    *,
    max_distance: ArrayLike,
    num_candidates: int | None = None,
    search: AbstractSearch | None = None,
) -> Correspondences:
    """Find the target point nearest to each moved source point in position and α · channel (Servos & Waslander, IV-A).

    Args:
        source, target: preprocessed clouds.
        pose: T_target_source, `jaxlie.SE3` or (4, 4); None is the identity.
        method: defines α, the channel weights of the search; without α the search is in position alone.
        max_distance: maximum correspondence distance, metres of position; matches beyond it are not `valid`.
        num_candidates: m, number of target points to find for each source point; more than one for the soft assignment
            of `align` and `mahalanobis_cost`. None: as many as the method matches, one but for NDT.
        search: nearest-neighbour search; by default `KDTreeSearch` on CPUs and `DenseSearch` on accelerators.

    Returns:
        One match per source row; for m > 1 arrays of shape (m, N), nearest first. Constant to autodiff.

    Raises:
        ValueError: if `max_distance` is not positive, `num_candidates` is below 1, `pose` is not a rigid motion, or
            channels or dtypes do not fit.
    """
    search = search or default_search()
    _check_clouds(source, target, method)
    method = method.resolve(source, target)
    check_positive("max_distance", max_distance)
    num_candidates = method.num_candidates if num_candidates is None else num_candidates
    check_integer("num_candidates", num_candidates, 1)
    matrix = centred_pose(pose, source, target, "pose")
    matrix, max_distance, method = constant((matrix, max_distance, method))
    rows, target_rows = (searchable(method, constant(cloud)) for cloud in (source, target))
    dtype = rows.points.dtype
    start = se3_from_matrix(matrix, dtype).wxyz_xyz
    if is_concrete(matrix, max_distance, rows, target_rows):
        gate = float(np.asarray(max_distance))
        nearest = _index(search, method, target).nearest(np.asarray(start), rows, gate, num_candidates)
        matches = correspondences_at(np.asarray(matrix), rows, target_rows, nearest, gate)
        return _unless_several(matches, num_candidates)
    limit = jnp.asarray(max_distance, dtype)
    found = search.nearest_traced(start, rows, target_rows, limit, jnp.bool_(True), num_candidates)
    here = jnp.maximum(found, 0)
    moved = move_rows(
        jnp.asarray(matrix[:3, :3], dtype), jnp.asarray(matrix[:3, 3], dtype), (jnp.asarray(rows.points),)
    )
    there = (found >= 0) & rows.valid & jnp.asarray(target_rows.valid)[here]
    targets = jnp.asarray(target_rows.points)[here]
    gated = [within(moved, (target,), valid, limit) for target, valid in zip(targets, there, strict=True)]
    valid, distances = (jnp.stack(each) for each in zip(*gated, strict=True))
    return _unless_several(Correspondences(here, distances, valid), num_candidates)


def _unless_several(matches: Correspondences, num_candidates: int) -> Correspondences:
    return matches if num_candidates > 1 else jax.tree.map(lambda rows: rows[0], matches)


def align(
    source: PointCloud,
    target: PointCloud,
    matches: Correspondences,
    method: AbstractMethod,
    *,
    init: Pose | None = None,
    max_iterations: int = Options.max_iterations,
    translation_tolerance: ArrayLike | None = None,
    rotation_tolerance: ArrayLike = Options.rotation_tolerance,
    robust: AbstractKernel | None = None,
    temperature: ArrayLike | None = None,
) -> Registration:
    """Compute the pose for fixed matches: update the pose, recompute M, and repeat until it converges. Pure JAX.

    Works under `jit`, `vmap`, `grad` and `jvp`. The first derivative is that of the root of Σ w JᵀM d = 0 near the
    returned pose (d = b − T a, J = ∂(T a)/∂ξ, robust weight w), by the implicit function theorem. Matches, neighbours
    and estimated parameters are constants. It is exact with respect to points, channels, given covariances, given
    parameters of the method (α: only with `temperature`) and the robust scale, and zero with respect to `init`, on
    which a root does not depend. All of it is zero, never NaN, with too few matches, with singular `information`, or if
    Newton's method does not converge from the returned pose. Second derivatives raise `NotImplementedError`.

    Args:
        source, target: preprocessed clouds.
        matches: from `find_correspondences`.
        method: as in `register`.
        init: T_target_source to start from, `jaxlie.SE3` or (4, 4); the identity by default.
        max_iterations: maximum number of pose updates.
        translation_tolerance, rotation_tolerance: metres and radians, as in `register`.
        robust: kernel ρ applied to the Mahalanobis distance of each match, as in `register`.
        temperature: metres; soft assignment of several candidates per source point, as in `mahalanobis_cost`.

    Returns:
        The pose with its status; check `converged`. `directions` is None: sliding, as of GICP along a plane, is not
        detected.

    Raises:
        ValueError: if an argument is malformed; failures on well-formed input show in `Registration.status`.
    """
    options = Options(
        max_distance=np.inf,
        max_iterations=max_iterations,
        translation_tolerance=translation_tolerance,
        rotation_tolerance=rotation_tolerance,
        hold_free_directions=False,
        robust=robust,
    )
    check_matches(matches, source, method, temperature)
    _check_clouds(source, target, method)
    method, seen, there = surfaces_of(method, source, target, observed=False)
    dtype = source.points.dtype
    robust = method.default_kernel() if robust is None else robust
    start = se3_from_matrix(centred_pose(init, source, target), dtype)
    softness = None if temperature is None else jnp.asarray(temperature, dtype)
    settings = _settings(options, method, target, 1, dtype)
    state, history, estimates = align_traced(
        start, seen, there, matches, softness, method, robust, settings, max_iterations
    )
    method = method.with_estimates(estimates)
    fixed, softness = jax.lax.stop_gradient((Problem(start, seen, there, method, robust, settings), softness))
    matched = matched_rows(fixed.source, fixed.target, matches, softness)
    assessment = assess(jax.lax.stop_gradient(state), fixed, matched, matches)
    return registration_of(state, assessment, history, source, target)


def register(
    source: PointCloud | Values,
    target: PointCloud | Values,
    method: AbstractMethod,
    *,
    init: Pose | Literal["global"] | None = None,
    max_distance: Distance | None = None,
    max_iterations: int = Options.max_iterations,
    translation_tolerance: ArrayLike | None = None,
    rotation_tolerance: ArrayLike = Options.rotation_tolerance,
    robust: AbstractKernel | None = None,
    search: AbstractSearch | None = None,
    hold_free_directions: bool = True,
    match_channels: bool = False,
    scales: Sequence[float] = (),
    tie_points: GivenTiePoints | None = None,
    prior: GivenPrior | None = None,
) -> Registration:
    """Register two clouds: find matches at the current pose, update the pose, and repeat until it converges.

    A coarse phase uses the larger `max_distance`, and of a source of 8,192 points or more an even subset of at least
    4,096. Near convergence, a fine phase with all points and the smaller `max_distance` takes over.

    With concrete arrays (outside `jit`, `vmap`, `grad`) the loop runs on the host and calls compiled programs whose
    shapes do not depend on the sizes of the clouds. Inside, it is one program per size of clouds, whose matches come
    from host callbacks, one batch element at a time (with `DenseSearch`, from XLA). The pose is the same up to
    rounding; its derivative is that of `align` at the final matches.

    Args:
        source, target: clouds from `preprocess`. Raw clouds and (N, 3) arrays, metres, are preprocessed with the
            defaults of `preprocess`; not inside `jit`.
        method: `MultiChannelGICP()`, `GICP()`, `PointToPlane()`, `PointToPoint()`, `ColorICP(...)`; for clouds of
            `gaussians` or with `scales`, `NDT()`, `ColorNDT(...)`, `D2DNDT()`. Parameters left None are estimated.
        init: T_target_source to start from, `jaxlie.SE3` or (4, 4); the identity by default. "global": the result of
            `global_pose`; without its `success` the status is TOO_FEW_CORRESPONDENCES, and the pose NaN. Not available
            inside transformations.
        max_distance: maximum correspondence distance, metres of position; matches beyond it are rejected. One number,
            or two, for the coarse and the fine phase. None: 10 and 2.5 times the spacing of the target (its median
            nearest-neighbour distance; the edge of its cells), and the first at least 10 times the spacing of a square
            grid as dense as the target, which in LiDAR scans reaches from line to line. If `init` is further off, pass
            a larger value.
        max_iterations: maximum number of pose updates in both phases together.
        translation_tolerance, rotation_tolerance: metres (at the centroid of the matches) and radians; the loop has
            converged when an update is below both. `translation_tolerance` None: 0.5 % of the spacing of the target.
        robust: kernel of each match's Mahalanobis distance: `Huber`, `Cauchy`, `GemanMcClure`, `Tukey`, `Welsch`. None:
            that of the method (NDT: `Welsch`), or none. With `photometric=True` of each residual in
            standard deviations.
        search: nearest-neighbour search; by default `KDTreeSearch` on CPUs and `DenseSearch` on accelerators.
        hold_free_directions: do not update the pose along unconstrained directions, which neither the shape of the
            clouds nor the channels (if the method uses them) constrain. If False, arbitrary nearest-neighbour matches
            decide there. The status is DEGENERATE in either case.
        match_channels: scale and shift each channel of the source to the distribution of the target's, for scans with
            different exposure or gain: first from the values of all points, then, in a second registration that starts
            at the pose of the first, from those of matched points. With `MultiChannelGICP(photometric=True)` gains and
            offsets are estimated with the pose instead, from interpolated channels.
        scales: voxel sizes, metres, from coarse to fine, for a start that is far off: the clouds are first registered
            at each voxel size, in this order, each time from the pose before and with the default `max_distance`; the
            one given is for the last registration. For NDT, the sizes of its cells: the clouds are raw ones, the last
            size gives the result, and at the others `GICP` registers voxels of a quarter of the size. Not available
            inside transformations.
        tie_points: (source_points, target_points, covariances), metres: points (n, 3) known to be the same, such as
            surveyed targets or image features (Huhle & Jenke 2008), and the covariances (n, 3, 3) of b − T a, in the
            target's axes. n may be 1 or 2. They are no start: if `init` is far off, pass a better one.
        prior: (pose, covariance): a measurement of T_target_source, as by GNSS or an IMU, `jaxlie.SE3` or (4, 4), and
            its covariance (6, 6), metres and radians, of ξ = (v, ω) in T = pose · exp(ξ): in the order and frame of
            `Registration.covariance`. ξ acts at the origin of the source, along its axes: for a covariance Σ of the
            position along the target's axes, as from GNSS, v has Rᵀ Σ R; and far from the clouds an uncertain rotation
            leaves their position unknown, so move clouds with UTM coordinates first. Give what the prior does not tell
            a large finite variance. Without `init` it is the start.

    With tie points or a prior, a first registration without them measures the covariance of the score of the matches,
    and a second one, which starts at its pose, weighs all by their covariances (Hansen 1982, generalised method of
    moments). The result is that of the second one; its `covariance` and `information` include tie points and prior.
    They also constrain directions that the clouds leave free (`FreeDirection.held_by_ties`). The pose is differentiable
    with respect to points, pose and covariances; the weights of the matches are constants to autodiff. Contradictions
    are averaged, not detected. Inside transformations, covariances are not checked.

    Returns:
        The pose with its status, quality of the fit and uncertainty; check `converged`.

    Raises:
        ValueError: if an argument is malformed, for instance in shape or dtype, numbers of channels differ where they
            are used, a cloud has fewer than four finite points, or `init` is not a rigid motion. The message names the
            argument. Failures to register well-formed clouds show in `Registration.status`.
    Warns:
        UserWarning: if points with NaN or infinity are left out, `MultiChannelGICP` gets clouds without channels, the
            values of a channel are so different in the two clouds that their units probably are, too, or `GICP` gets
            one cloud with covariances that are not dimensionless.
    """
    options = Options(
        max_distance=max_distance,
        max_iterations=max_iterations,
        translation_tolerance=translation_tolerance,
        rotation_tolerance=rotation_tolerance,
        robust=robust,
        search=search,
        hold_free_directions=hold_free_directions,
        match_channels=match_channels,
        scales=scales,
    )
    if tie_points is None and prior is None:
        return register_with(source, target, method, init, options)
    if not hold_free_directions:
        raise ValueError("hold_free_directions: expected True with tie_points or prior, got False")
    return register_with(source, target, method, init, options, tie_points, prior)


def register_with(
    source: PointCloud | Values,
    target: PointCloud | Values,
    method: AbstractMethod,
    init: Any,
    options: Options,
    tie_points: GivenTiePoints | None = None,
    prior: GivenPrior | None = None,
) -> Registration:
    """`register` with its options as one object."""
    check_method(method)
    if isinstance(init, str):
        start = start_from_anywhere(init, source, target)
        if not start.success:
            return Registration.without_pose(Status.TOO_FEW_CORRESPONDENCES)
        return register_with(source, target, method, start.matrix, options, tie_points, prior)
    source, target = (
        _ready(name, cloud, options.takes_raw(method, name)) for name, cloud in (("source", source), ("target", target))
    )
    if options.scales and not (source.covariances is None and target.covariances is None):
        raise ValueError("scales: expected none for clouds with covariances, which cannot be averaged in voxels")
    if isinstance(method, GICP) and is_concrete(source, target):
        _warn_of_covariances(source, target)
    if options.match_channels:
        source = _matched(source, target, method)
    elif method.uses_channels and is_concrete(source, target):
        warn_of_units(source, target)
    *before, (method, source, target) = method.stages(source, target, options.scales)
    ties, belief = known(tie_points, prior, source, target)
    if init is None and prior is not None:
        init = prior[0]
    search = options.search or default_search()
    once = replace(options, max_distance=None)
    for coarse_method, coarse, coarse_target in before:
        run = _solved(coarse, coarse_target, coarse_method, init, once, search)
        found = registration_of(*run.finish(), coarse, coarse_target)
        init = found.matrix if is_usable(found) else init
    run = _solved(source, target, method, init, options, search)
    if options.match_channels and run.problem.method.estimates is None:
        source = _matched(source, target, method, _nearest_points(source, target, run, search))
        init = constant(pose_in_user_frame(run.state.pose, source.origin, target.origin))
        run = _solved(source, target, method, init, options, search)
    if not (ties is None and belief is None):
        fusion = fusion_of(run.state, run.moments(), ties, belief)
        problem = replace(run.problem, start=constant(run.state.pose), fusion=fusion)
        run = _run(problem, target, search, options.max_iterations)
    return registration_of(*run.finish(), source, target)


def start_from_anywhere(init: str, source: PointCloud | Values, target: PointCloud | Values) -> GlobalPoseResult:
    """The start of a registration with `init="global"`."""
    if init != "global":
        raise ValueError(f'init: expected a pose, "global" or None, got {init!r}')
    if not is_concrete(source, target):
        raise ValueError('init: expected a pose inside transformations, got "global"')
    return global_pose(source, target)


class _Run(NamedTuple):
    """A problem that has been run.

    Attributes:
        state: the final one, a constant to autodiff.
        finish: function for the arguments of `registration_of`: the differentiable state, assessment and history.
        moments: function for the sums over the scores.
    """

    problem: Problem
    state: State
    finish: Callable[[], tuple[State, Assessment, dict[str, Any]]]
    moments: Callable[[], Moments]


def _warn_of_covariances(source: PointCloud, target: PointCloud) -> None:
    """Warn if one cloud brings covariances whose unit is not that of GICP's, which the other one gets."""
    for name, cloud, other in (("source", source, target), ("target", target, source)):
        if cloud.covariances is not None and other.covariances is None:
            rows, _ = sampled_rows(cloud.valid)
            trace = float(median(np.trace(np.asarray(cloud.covariances)[rows], axis1=1, axis2=2)))
            if not _LEAST_TRACE <= trace / 2 <= _LARGEST_TRACE:
                warnings.warn(
                    f"{name}: its covariances have a median trace of {trace:.2g}, those of GICP are dimensionless and "
                    'have 2; for cells in m² use NDT or D2DNDT, or make them by gaussians(..., of="covariances")',
                    UserWarning,
                    stacklevel=4,
                )


def _solved(
    source: PointCloud,
    target: PointCloud,
    method: AbstractMethod,
    init: Pose | None,
    options: Options,
    search: AbstractSearch,
) -> _Run:
    """Pose and run the problem."""
    problem = pose_problem(source, target, method, init, options, search.num_threads)
    return _run(problem, target, search, options.max_iterations)


def _run(problem: Problem, target: PointCloud, search: AbstractSearch, max_iterations: int) -> _Run:
    """Run the loop."""
    if is_concrete(problem):

        def index_of(position_alone: bool) -> AbstractIndex:
            return _index(search, PointToPoint() if position_alone else problem.method, target)

        with outside_trace():
            state, assessment, history, sums = register_on_host(problem, index_of, search.num_threads)
        return _Run(problem, state, lambda: (state, assessment, history), lambda: sums.value)
    # Gradients stop here, so that autodiff does not enter the compiled functions.
    fixed = jax.lax.stop_gradient(problem)
    state, matches, history, estimates = register_traced(fixed, search, max_iterations)
    method = problem.method.with_estimates(estimates)

    found = replace(fixed, method=jax.lax.stop_gradient(method))

    def finish() -> tuple[State, Assessment, dict[str, Any]]:
        assessment = assess(state, found, matched_rows(fixed.source, fixed.target, matches), matches, search)
        matched = matched_rows(problem.source, problem.target, matches)
        return differentiable(state, matched, method, problem.robust, problem.fusion), assessment, history

    def moments() -> Moments:
        return moments_of(state, found, matched_rows(fixed.source, fixed.target, matches), matches, search)

    return _Run(problem, state, finish, moments)


def pose_problem(
    source: PointCloud,
    target: PointCloud,
    method: AbstractMethod,
    init: Pose | None,
    options: Options,
    num_threads: int | None,
) -> Problem:
    """Inputs of the loop for preprocessed clouds; NumPy arrays where everything is concrete."""
    _check_clouds(source, target, method)
    method, seen, there = surfaces_of(method, source, target, observed=True, num_threads=num_threads)
    if options.match_channels and method.estimates is not None:
        method = method.with_estimates(replace(method.estimates, compensates=True))
    dtype = source.points.dtype
    xp = numpy_for(source.valid)
    stride = xp.maximum(xp.sum(xp.asarray(source.valid)) // _COARSE_ROWS, 1)
    start = se3_from_matrix(centred_pose(init, source, target), dtype)
    robust = method.default_kernel() if options.robust is None else options.robust
    return Problem(start, seen, there, method, robust, _settings(options, method, target, stride, dtype))


def default_distances(spacing: Any, target: PointCloud) -> tuple[Any, Any]:
    """Default `max_distance` of the coarse and the fine phase, metres, for a target with this spacing."""
    # Cells have the spacing of their grid.
    between = spacing if target.covariances is not None else constant(grid_spacing(target))
    return _COARSE_SPACINGS * numpy_for(spacing, between).maximum(spacing, between), _FINE_SPACINGS * spacing


def _settings(options: Options, method: AbstractMethod, target: PointCloud, stride: Any, dtype: Any) -> Settings:
    max_distance: Any = options.max_distance
    tolerance: Any = options.translation_tolerance
    # Options are constants to autodiff, even if they are derived from a differentiated cloud.
    spacing = constant(method.spacing(target))
    max_distance = default_distances(spacing, target) if max_distance is None else max_distance
    least = spacing * _TOLERANCE_IN_SPACINGS
    tolerance = least if tolerance is None else tolerance

    def number(value: Any, kind: Any) -> Any:
        xp = numpy_for(value)
        return xp.asarray(value, kind)

    def coarse_tolerance(value: Any, least: Any) -> Any:
        return number(_COARSE_TOLERANCE * numpy_for(value, least).maximum(value, least), dtype)

    coarse, fine = max_distance if isinstance(max_distance, tuple) or np.shape(max_distance) else [max_distance] * 2
    return Settings(
        max_distance=number(coarse, dtype),
        fine_distance=number(fine, dtype),
        coarse_stride=number(stride, np.int32),
        translation_tolerance=number(tolerance, dtype),
        rotation_tolerance=number(options.rotation_tolerance, dtype),
        coarse_translation_tolerance=coarse_tolerance(tolerance, least),
        coarse_rotation_tolerance=coarse_tolerance(options.rotation_tolerance, ROTATION_TOLERANCE),
        max_iterations=number(options.max_iterations, np.int32),
        hold_free_directions=number(options.hold_free_directions, bool),
    )


def _index(search: AbstractSearch, method: AbstractMethod, target: PointCloud) -> AbstractIndex:
    """Search index of the target, cached while the cloud lives."""
    count = target.channels.shape[-1]
    numbers = [] if method.weights(count) is None else [method.weights(count)]
    if numbers and target.channel_valid is not None:
        numbers.append(method.missing_variances(count))
    key = (repr(search), *(np.asarray(number).tobytes() for number in numbers))
    return cached_with(target, "index", key, lambda: search.index(searchable(method, target)))


def _matched(
    source: PointCloud, target: PointCloud, method: AbstractMethod, matches: Correspondences | None = None
) -> PointCloud:
    _check_channels(source, target, method)
    return with_channels_matched(source, target, matches)


def _nearest_points(source: PointCloud, target: PointCloud, run: _Run, search: AbstractSearch) -> Correspondences:
    """Nearest matches in position at the final pose."""
    pose = constant(pose_in_user_frame(run.state.pose, source.origin, target.origin))
    distance = run.problem.settings.fine_distance
    return find_correspondences(source, target, pose, PointToPoint(), max_distance=distance, search=search)


def _ready(name: str, cloud: PointCloud | Values, raw: bool = False) -> PointCloud:
    """The cloud, preprocessed unless it may be `raw`."""
    try:
        if not isinstance(cloud, PointCloud):
            cloud = PointCloud(cloud)
        if cloud.neighbors is None and not raw:
            cloud = preprocess(cloud)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    return cloud


def _check_clouds(source: PointCloud, target: PointCloud, method: AbstractMethod) -> None:
    """Raise `ValueError` unless both are single clouds, of one dtype, with channels that fit the method."""
    check_method(method)
    for name, cloud in (("source", source), ("target", target)):
        if cloud.points.ndim != 2:
            raise ValueError(
                f"{name}: expected a single cloud, got shape {cloud.points.shape}; use jax.vmap for a batch"
            )
    for name, cloud in (("source", source), ("target", target)):
        if name in method.needs_covariances and cloud.covariances is None:
            raise ValueError(
                f"{name}: expected a cloud with covariances for {type(method).__name__}; make it with "
                "mcgicp_jax.gaussians, or pass scales to register"
            )
    if method.uses_channels:
        _check_channels(source, target, method)
        if isinstance(method, MultiChannelGICP) and source.channels.shape[-1] == 0:
            warnings.warn("the clouds have no channels: MultiChannelGICP equals GICP", UserWarning, stacklevel=5)
    if source.points.dtype != target.points.dtype:
        raise ValueError(
            f"points: expected one precision in both clouds, got {source.points.dtype} in the source and "
            f"{target.points.dtype} in the target; make them alike before preprocess, as by points.astype(np.float32)"
        )


def _check_channels(source: PointCloud, target: PointCloud, method: AbstractMethod) -> None:
    if source.channels.shape[-1] != target.channels.shape[-1]:
        raise ValueError(
            f"channels: expected as many in the source as in the target for {type(method).__name__}, "
            f"got {source.channels.shape[-1]} and {target.channels.shape[-1]}"
        )
