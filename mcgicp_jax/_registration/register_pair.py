"""The registration of one pair of clouds with all its options, from a given initial pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
from jaxtyping import Int

from mcgicp_jax._clouds.origins import centred_pose, pose_in_user_frame
from mcgicp_jax._clouds.point_cloud import PointCloud, Values, Voxels, as_cloud
from mcgicp_jax._clouds.preprocess import preprocessed_in
from mcgicp_jax._clouds.voxel_size import NUM_NEIGHBORS, VoxelSize, voxels_and_grids
from mcgicp_jax._compute.cache import Lazy
from mcgicp_jax._compute.concrete import AnyArray, constant, is_concrete, numpy_for, outside_trace
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.messages import messages_named
from mcgicp_jax._compute.threads import in_new_thread, with_settings_of_package
from mcgicp_jax._local_geometry.cloud_statistics import (
    warn_of_exposure,
    warn_of_units,
    with_channels_matched,
)
from mcgicp_jax._math.poses import Pose, se3_from_matrix
from mcgicp_jax._math.statistics import spread_rows
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._methods.icp import GICP, PointToPoint
from mcgicp_jax._methods.surfaces import surface_pair
from mcgicp_jax._pose_solver.covariance import Moments
from mcgicp_jax._pose_solver.matched import Matches
from mcgicp_jax._registration.assessment import Assessment, assessment_of, moments_of, registration_of
from mcgicp_jax._registration.correspondences import find_correspondences, index_of
from mcgicp_jax._registration.input_checks import (
    check_channels,
    check_clouds,
    warn_of_constant_weights,
    warn_of_covariances,
)
from mcgicp_jax._registration.loop import LoopResult, iterate
from mcgicp_jax._registration.measurements import GivenPrior, GivenTiePoints, fusion_of, known, measured
from mcgicp_jax._registration.multi_scale import at_scales
from mcgicp_jax._registration.on_host import HostExecutor
from mcgicp_jax._registration.options import Options, check_method
from mcgicp_jax._registration.pose_derivative import Inputs, differentiated, jacobian, with_derivatives
from mcgicp_jax._registration.result import RegistrationResult, is_usable
from mcgicp_jax._registration.step import Problem, State, settings_for
from mcgicp_jax._registration.traced import assess, differentiable, moments_traced, run_traced
from mcgicp_jax._search.base import AbstractIndex, AbstractSearch, Correspondences
from mcgicp_jax._search.brute_force import default_search

# Smallest number of source points in a subsampled coarse phase: enough for nearly the pose of all points.
_COARSE_ROWS = 4096


class Run(NamedTuple):
    """A registration that has ended.

    Attributes:
        inputs: of the problem, constant to autodiff outside `jit`.
        loop: its end, constant to autodiff.
        executor: of the loop; None inside `jit`.
        state: computes the final state, whose pose is differentiable inside `jit`.
        assessment, moments: compute these of the final pose.
    """

    inputs: Inputs
    problem: Problem
    loop: LoopResult
    executor: HostExecutor | None
    state: Callable[[], State]
    assessment: Callable[[], Assessment]
    moments: Callable[[], Moments]


@with_settings_of_package
def register_pair(
    source: PointCloud | Values,
    target: PointCloud | Values,
    method: AbstractMethod,
    init: Pose | None,
    options: Options,
    tie_points: GivenTiePoints | None = None,
    prior: GivenPrior | None = None,
) -> RegistrationResult:
    """`register` from a given initial pose, with its options as one object."""
    given = prepared(source, target, method, options, tie_points, prior)
    if init is None and prior is not None:
        init = prior[0]
    values, init = given.values(), primal(init)
    if not is_concrete(values, init, options.numbers):
        values = given
    register = partial(run_pair, values, init, options)
    # Differentiation is a transformation, too: inside it, calls of programs take longer.
    run = register() if values is given or is_concrete(given) else in_new_thread(register)
    (result,) = results_of([run], [given])
    return result


def prepared(
    source: PointCloud | Values,
    target: PointCloud | Values,
    method: AbstractMethod,
    options: Options,
    tie_points: GivenTiePoints | None = None,
    prior: GivenPrior | None = None,
) -> Inputs:
    """The arguments of a registration, checked; and the clouds, see `preprocessed`."""
    check_method(method)
    warn_of_constant_weights(method)
    sides = {"source": as_cloud("source", source), "target": as_cloud("target", target)}
    source, target = preprocessed(sides, method, options)
    if options.voxel_sizes and not (source.covariances is None and target.covariances is None):
        raise ValueError("voxel_sizes: expected none for clouds with covariances, which cannot be averaged in voxels")
    if options.voxel_sizes and method.needs_covariances and not is_concrete(source, target):
        raise ValueError("voxel_sizes: expected none for derivatives with cells; make these with voxel_gaussians")
    return Inputs(source, target, method, options.robust, *known(tie_points, prior, source, target))


@with_settings_of_package
def run_pair(given: Inputs, init: Pose | None, options: Options) -> Run:
    """Register arrays that are all concrete, or some of which `jit` or `vmap` trace."""
    search = options.search or default_search(given, init, options.numbers)
    *coarse, inputs = at_scales(_with_comparable_channels(given, options), options.voxel_sizes)
    for each in coarse:
        (found,) = results_of([_solved(each, init, replace(options, max_distance=None), search)], [None])
        init = found.matrix if is_usable(found) else init
    run = _with_exposure_of_matches(_solved(inputs, init, options, search), inputs.method, options, search)
    return run if given.tie_points is None and given.prior is None else _fused(run, options, search)


def _with_comparable_channels(given: Inputs, options: Options) -> Inputs:
    """The inputs with equalised channels, if that is wanted; else warns of different units."""
    concrete = is_concrete(given.source, given.target)
    if isinstance(given.method, GICP) and concrete:
        warn_of_covariances(given.source, given.target)
    if options.equalize_channels:
        return _equalized(given)
    if given.method.uses_channels and concrete:
        warn_of_units(given.source, given.target)
    return given


def _with_exposure_of_matches(run: Run, method: AbstractMethod, options: Options, search: AbstractSearch) -> Run:
    """The registration again with channels equalised by its matches, if that is wanted; else warns of exposure.

    Args:
        method: as it was given: parameters left None are chosen anew, from the channels as they are then.
    """
    inputs, state = run.inputs, run.loop.state
    if options.equalize_channels:
        if any(term.estimates_gains for term in run.problem.terms):
            return run
        pose = constant(pose_in_user_frame(state.pose, inputs.source.origin, inputs.target.origin))
        again = _equalized(inputs._replace(method=method), _nearest_points(run, search))
        return _solved(again, pose, options, search)
    if inputs.method.uses_channels and is_concrete(inputs.source, inputs.target, state.pose):
        warn_of_exposure(inputs.source, inputs.target, lambda: _nearest_points(run, search))
    return run


def _fused(run: Run, options: Options, search: AbstractSearch) -> Run:
    """The registration again from its pose, with tie points and prior weighed by its covariance."""
    state, inputs = run.loop.state, run.inputs
    fusion = fusion_of(state, run.moments(), inputs.tie_points, inputs.prior)
    problem = replace(run.problem, start=constant(state.pose), measurements=fusion)
    return run_loop(inputs, problem, search, options.max_iterations)


@with_settings_of_package
def results_of(runs: Sequence[Run], givens: Sequence[Inputs | None]) -> list[RegistrationResult]:
    """The results of registrations.

    Args:
        givens: the arguments of each, or None. Outside `jit`, the poses get derivatives by those arrays of these
            arguments that are traced. All derivatives are computed side by side.
    """
    traced = [
        None if given is None or run.executor is None else differentiated(given, run.inputs, run.executor, run.loop)
        for run, given in zip(runs, givens, strict=True)
    ]
    states = with_derivatives([run.state() for run in runs], traced)
    results = []
    for state, run, given in zip(states, runs, givens, strict=True):
        by = None if run.executor is None else partial(jacobian, run.inputs, run.executor, run.loop)
        # Traced origins are those of the inputs, as cells, which may have others, are made of concrete clouds alone.
        traces_origins = given is not None and not is_concrete(given.source.origin, given.target.origin)
        source, target = (given if given is not None and traces_origins else run.inputs)[:2]
        used = run.problem.source.search.valid
        results.append(registration_of(state, run.assessment(), run.loop.history, source, target, used, by))
    return results


def _solved(given: Inputs, init: Pose | None, options: Options, search: AbstractSearch) -> Run:
    """Pose and run the problem."""
    problem, inputs = pose_problem(given, init, options, search.num_threads)
    if not (given.tie_points is None and given.prior is None):
        problem = measured(problem, given.tie_points, given.prior)
    return run_loop(inputs, problem, search, options.max_iterations)


def run_loop(inputs: Inputs, problem: Problem, search: AbstractSearch | None, max_iterations: int) -> Run:
    """Run the loop on the host or inside `jit`.

    Args:
        search: None for a problem with fixed matches.
    """
    if not is_concrete(inputs, problem):
        problem = problem.whole()
        # Gradients stop here, so that autodiff does not enter the compiled functions.
        fixed = jax.lax.stop_gradient(problem)
        loop = run_traced(fixed, search, max_iterations)
        state = partial(differentiable, loop, problem)
        ended = loop, fixed, search
        return Run(inputs, problem, loop, None, state, partial(assess, *ended), partial(moments_traced, *ended))

    def index(position_alone: bool) -> AbstractIndex:
        if search is None:
            raise ValueError("matches: expected a registration that searches for them")
        return index_of(search, PointToPoint() if position_alone else inputs.method, inputs.target)

    executor = HostExecutor(problem, index, 1 if search is None else search.num_threads)
    with outside_trace():
        loop = iterate(executor)
    moments = Lazy(lambda: moments_of(executor, loop))
    assessment = assessment_of(executor, loop, None if problem.fusion is not None else moments)
    return Run(inputs, problem, loop, executor, lambda: loop.state, lambda: assessment, lambda: moments.value)


@with_settings_of_package
def pose_problem(
    given: Inputs, init: Pose | None, options: Options, num_threads: int | None, matches: Matches | None = None
) -> tuple[Problem, Inputs]:
    """The problem for preprocessed clouds, NumPy arrays where everything is concrete; and its inputs, with the
    parameters of the method chosen.

    Args:
        matches: those at every pose; None to search for them.
    """
    source, target, method = given[:3]
    check_clouds(source, target, method)
    rows = rows_to_match(source, options)
    pair = surface_pair(
        method,
        source,
        target,
        observed=matches is None,
        robust=given.robust,
        equalize_channels=options.equalize_channels,
        num_threads=num_threads,
        source_rows=rows,
    )
    dtype, valid = source.points.dtype, pair.source.search.valid
    xp = numpy_for(valid)
    stride = xp.maximum(xp.sum(xp.asarray(valid)) // _COARSE_ROWS, 1) if matches is None else 1
    problem = Problem(
        se3_from_matrix(centred_pose(init, source, target), dtype),
        pair.source,
        pair.target,
        pair.terms,
        settings_for(options, pair.method, target, stride, dtype),
        matches=matches,
        num_candidates=pair.method.num_candidates,
    )
    return problem, given._replace(method=pair.method, source_rows=rows)


def rows_to_match(source: PointCloud, options: Options) -> Int[AnyArray, "n"] | None:
    """The source rows that `max_source_points` leaves; None for all."""
    most = options.max_source_points
    return None if most is None or most >= source.valid.size else spread_rows(source.valid, most)


def _equalized(given: Inputs, matches: Correspondences | None = None) -> Inputs:
    check_channels(given.source, given.target, given.method)
    source, gains = with_channels_matched(given.source, given.target, matches)
    return given._replace(source=source, gains=gains if given.gains is None else given.gains * gains)


def _nearest_points(run: Run, search: AbstractSearch) -> Correspondences:
    """Nearest matches in position at the final pose."""
    source, target = run.inputs[:2]
    pose = constant(pose_in_user_frame(run.loop.state.pose, source.origin, target.origin))
    distance = run.problem.settings.fine_distance
    return find_correspondences(source, target, pose, PointToPoint(), max_distance=distance, search=search)


def preprocessed(
    sides: dict[str, PointCloud],
    method: AbstractMethod,
    options: Options,
    voxel_size: VoxelSize | Voxels = "auto",
    num_neighbors: int = NUM_NEIGHBORS,
) -> list[PointCloud]:
    """The clouds "source" and "target", preprocessed with one voxel size. Where the method makes cells of raw points,
    clouds stay raw."""
    points = {name: cloud for name, cloud in sides.items() if not options.takes_raw(method, name)}
    voxels, grids = voxels_and_grids(voxel_size, *points.values())
    for (name, cloud), grid in zip(points.items(), grids, strict=True):
        if cloud.deferred_neighbors is None:
            with messages_named(name):
                sides[name] = preprocessed_in(grid, cloud, voxels, num_neighbors, options.search)
    return list(sides.values())
