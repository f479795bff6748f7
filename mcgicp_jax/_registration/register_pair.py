"""The registration of one pair of clouds with all its options, from a given initial pose."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, cast

import jax
import numpy as np
from jaxtyping import Int

from mcgicp_jax._clouds.origins import centred_pose, pose_in_user_frame
from mcgicp_jax._clouds.point_cloud import PointCloud, Values, Voxels, as_cloud
from mcgicp_jax._clouds.preprocess import finite_rows, preprocess, preprocessed_in, with_neighbors
from mcgicp_jax._clouds.voxel_size import NUM_NEIGHBORS, VoxelSize, voxels_and_grids
from mcgicp_jax._compute.concrete import AnyArray, constant, is_concrete, numpy_for, outside_trace
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.messages import messages_named, warn
from mcgicp_jax._compute.threads import in_new_thread, with_settings_of_package
from mcgicp_jax._local_geometry.cloud_statistics import changes_of_exposure, with_channels_matched
from mcgicp_jax._local_geometry.neighborhoods import check_neighbors
from mcgicp_jax._local_geometry.sensor_patterns import (
    channels_may_move,
    doubt_of_patterns,
    without_constant_part,
    without_patterns,
)
from mcgicp_jax._math.poses import Pose, se3_from_matrix
from mcgicp_jax._math.statistics import spread_rows
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._methods.icp import GICP, PointToPoint
from mcgicp_jax._methods.multichannel_gicp import MultiChannelGICP
from mcgicp_jax._methods.ndt import voxel_gaussians
from mcgicp_jax._methods.surfaces import surface_pair, whole_surface
from mcgicp_jax._pose_solver.matched import Matches
from mcgicp_jax._registration import input_checks
from mcgicp_jax._registration.assessment import assessment_of, moments_of, registration_of
from mcgicp_jax._registration.correspondences import find_correspondences, index_of
from mcgicp_jax._registration.loop import CONTRADICTION, Problem, squared_residuals
from mcgicp_jax._registration.on_host import HostExecutor
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.pose_derivative import Inputs, Run, jacobian, with_derivatives
from mcgicp_jax._registration.result import USABLE, RegistrationResult, Status
from mcgicp_jax._registration.settings import settings_for, spacing_of
from mcgicp_jax._registration.start_check import (
    LITTLE_IN_COMMON,
    distance_moved,
    retried_if_start_was_left,
    surface_fit,
)
from mcgicp_jax._registration.tie_points_and_prior import (
    GivenPrior,
    GivenTiePoints,
    checked_measurements,
    fusion_of,
    measured,
)
from mcgicp_jax._registration.traced import assess, differentiable, moments_traced, run_traced
from mcgicp_jax._search.base import AbstractIndex, AbstractSearch, Correspondences
from mcgicp_jax._search.default_search import default_search

# Smallest number of source points in a subsampled coarse phase: enough for nearly the pose of all points.
_COARSE_ROWS = 4096
# Edge of the voxels in edges of a cell, at all scales but the last, where GICP registers the voxels. Cells against
# cells would pull partially overlapping clouds over each other: from 1.3 m and 10° off, two views of a yard with an
# overlap of three quarters ended 4 m off, and GICP ends at 0 m. On KITTI, from 5 m and 30° off, GICP found 7 of 8
# poses, cells 4.
_COARSE_VOXEL = 0.25


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
    inputs = prepared(source, target, method, options, tie_points, prior)
    init = prior[0] if init is None and prior is not None else init
    return result_of(inputs, run_pair, primal(init), options)


def result_of(given: Inputs, run: Callable[..., Run], *arguments: Any) -> RegistrationResult:
    """The result of `run`, such as `run_pair`, on the host or traced, as is decided here; differentiable by `given`."""
    values = given.values()
    numbers = [argument.numbers if isinstance(argument, Options) else argument for argument in arguments]
    if not is_concrete(values, numbers):
        # Inside `jit` or `vmap`, whose tracers have no values.
        ended = run(given, *arguments, traced=True)
        loop, problem, search = ended.loop, ended.problem, ended.search
        state = differentiable(loop, problem, search)
        assessment = assess(loop, jax.lax.stop_gradient(problem), search)
        return registration_of(state, assessment, loop.history, *given[:2], problem.source.search.valid, inputs=given)
    if is_concrete(given):
        # Inside `jit`, the constants of a program.
        with outside_trace():
            ended = run(given, *arguments)
    else:
        # Inside `grad` or `jvp`: the values are registered, and `results_of` adds the derivative. In a thread, since
        # calls of programs take longer inside transformations.
        ended = in_new_thread(partial(run, values, *arguments))
    if ended.doubt:
        warn(ended.doubt)
    (result,) = results_of([ended], [given])
    return result


def prepared(
    source: PointCloud | Values,
    target: PointCloud | Values,
    method: AbstractMethod,
    options: Options,
    tie_points: GivenTiePoints | None = None,
    prior: GivenPrior | None = None,
    channels_checked: bool = True,
) -> Inputs:
    """The arguments, checked; clouds are `preprocessed`, and if `channels_checked`, `without_sensor_patterns`."""
    sides = {"source": as_cloud("source", source), "target": as_cloud("target", target)}
    source, target = preprocessed(sides, method, options)
    if options.soft_matches is False:
        input_checks.warn_of_hard_matches(method, source, target)
    if channels_checked and method.uses_channels:
        source, target = without_sensor_patterns(source, target, method)
    if options.voxel_sizes and not (source.covariances is None and target.covariances is None):
        raise ValueError("voxel_sizes: expected none for clouds with covariances, which cannot be averaged in voxels")
    if options.voxel_sizes and not is_concrete(primal((source, target))):
        advice = "where preprocess(cloud, voxel_size, size=...) averages points"
        raise ValueError(f"voxel_sizes: expected none inside jit and vmap, {advice}")
    if options.voxel_sizes and method.needs_covariances and not is_concrete(source, target):
        raise ValueError("voxel_sizes: expected none for derivatives with cells; make these with voxel_gaussians")
    measurements = checked_measurements(tie_points, prior, source, target)
    return Inputs(source, target, method, options.robust, *measurements)


def without_sensor_patterns(
    source: PointCloud, target: PointCloud, method: AbstractMethod
) -> tuple[PointCloud, PointCloud]:
    """The clouds for a method that uses channels, without what moves with the sensor."""
    source, target = without_patterns(source, target)
    if isinstance(method, MultiChannelGICP) and method.photometric:
        return without_constant_part(source), without_constant_part(target)
    return source, target


@with_settings_of_package
def run_pair(given: Inputs, init: Pose | None, options: Options, traced: bool = False) -> Run:
    """Register arrays that are all concrete, or some of which `jit` or `vmap` trace."""
    search = options.search or default_search(traced)
    measures = not (given.tie_points is None and given.prior is None)

    def solve(inputs: Inputs, init: Pose | None, options: Options = options) -> Run:
        problem, inputs = problem_of(inputs, init, options, search.num_threads)
        if measures:
            limits = options.max_distance is None
            problem = measured(problem, given.tie_points, given.prior, traced, limits)
        return run_loop(inputs, problem, search, options.max_iterations, traced)

    if not traced:
        input_checks.warn_of_inputs(given.source, given.target, given.method, options.equalize_channels)
    equalizes = options.equalize_channels and given.source.channels.shape[-1] > 0
    *coarse, inputs = _at_scales(_equalized(given) if equalizes else given, options.voxel_sizes)
    start = init
    for scale in coarse:
        run = solve(scale, start, replace(options, max_distance=None))
        start = _final_pose(run) if run.loop.state.status in USABLE else start
    run = solve(inputs, start)
    doubt = ""
    if not traced and options.has_two_distances:
        first = se3_from_matrix(centred_pose(init, *inputs[:2]), inputs.source.points.dtype) if coarse else None
        run, doubt = retried_if_start_was_left(
            run, first, lambda limit: solve(inputs, init, replace(options, max_distance=limit))
        )
    if equalizes and not any(term.estimates_gains for term in run.problem.terms):
        # Parameters left None are chosen anew, from the channels as equalised by the matches.
        again = _equalized(run.inputs._replace(method=inputs.method), _nearest_points(run))
        run = solve(again, _final_pose(run), replace(options, max_coarse_distance=0.0))
    elif not traced and given.method.uses_channels and not options.equalize_channels:
        directions = run.loop.state.directions
        by_channels = directions is not None and bool(np.any(directions.constrained_by_channels))
        changes = changes_of_exposure(inputs.source, inputs.target, lambda: _nearest_points(run), by_channels)
        if by_channels and not doubt and run.loop.state.status == Status.CONVERGED:
            doubt = "; ".join(changes)
        else:
            for change in changes:
                warn(change)
    if measures:
        run = _fused(run, options, traced)
        limit = run.problem.settings.fine_distance
        if doubt and distance_moved(run.problem.start, run.loop.state) > limit:
            # It was about another pose; where views have little in common, it is about this one, too.
            overlap = surface_fit(run.inputs, run.executor, run.loop).overlap
            doubt = doubt if overlap < LITTLE_IN_COMMON else ""
    return run if traced else _with_doubt(run, doubt, measures)


def _fused(run: Run, options: Options, traced: bool) -> Run:
    """A registration again from its pose, with tie points and prior weighed by its covariance."""
    state, settings = run.loop.state, run.problem.settings
    if traced:
        moments = moments_traced(run.loop, jax.lax.stop_gradient(run.problem), run.search)
    else:
        with outside_trace():
            moments = moments_of(run.executor, run.loop)
    fusion = fusion_of(state, moments, run.inputs.tie_points, run.inputs.prior, traced)
    if options.max_distance is None:
        settings = settings._replace(max_distance=settings.fine_distance)
    problem = replace(run.problem, start=constant(state.pose), settings=settings, measurements=fusion)
    return run_loop(run.inputs, problem, run.search, options.max_iterations, traced)


def _with_doubt(run: Run, doubt: str, measures: bool) -> Run:
    """A run on the host with the reason why its pose is UNVERIFIED, as is a converged one with a `doubt`; warns if near
    points make it DEGENERATE."""
    state, measurements = run.loop.state, run.problem.measurements
    if state.status == Status.UNVERIFIED:
        from_prior, from_ties = squared_residuals(state.pose, measurements)
        if from_prior > CONTRADICTION:
            doubt = f"prior: the pose is {np.sqrt(from_prior):.2g} standard deviations away from it, and UNVERIFIED"
        elif measurements is not None and from_ties > measurements.form.most:
            doubt = (
                f"tie_points: their squared residuals add up to {from_ties:.2g} squared standard deviations, those of "
                f"right ones to at most {measurements.form.most:.2g}, and the pose is UNVERIFIED; some may be wrong, "
                "or more uncertain"
            )
        else:
            doubt = doubt_of_patterns(run.inputs.source)
        return run._replace(doubt=doubt)
    if state.status == Status.CONVERGED and doubt:
        state = state._replace(status=np.asarray(Status.UNVERIFIED, np.int32))
        return run._replace(loop=run.loop._replace(state=state), doubt=f"the pose is UNVERIFIED: {doubt}")
    if measures or state.status != Status.DEGENERATE or state.directions is None:
        return run
    points, near = np.asarray(run.inputs.source.points)[run.inputs.source.valid], run.problem.settings.near
    with np.errstate(over="ignore"):
        are_near = np.square(points).sum(axis=1) < near**2
    constrained = state.directions.constrained.sum()
    if are_near.any() and run.executor.directions_by_all_points(run.loop).constrained.sum() > constrained:
        warn(
            f"source: little but points within {float(near):.2g} m of the origin constrains the pose in some "
            "direction. They may be the sensor's own vehicle, which moves with it, so the status is DEGENERATE; leave "
            "them out by PointCloud.crop, pass a prior, or move the clouds if the sensor is not at their origin"
        )
    return run


@with_settings_of_package
def results_of(runs: Sequence[Run], givens: Sequence[Inputs]) -> list[RegistrationResult]:
    """The results of runs on the host; poses get derivatives by traced arrays of `givens`, computed side by side."""
    results = []
    for state, run, given in zip(with_derivatives(runs, givens), runs, givens, strict=True):
        # Cells, whose origin may differ, are made of concrete clouds alone: a traced origin is that of the argument.
        traces_origins = not is_concrete(given.source.origin, given.target.origin)
        clouds, matchable = (given if traces_origins else run.inputs)[:2], run.problem.source.search.valid
        ended = state, assessment_of(run.executor, run.loop), run.loop.history, *clouds, matchable
        results.append(registration_of(*ended, partial(jacobian, run), given))
    return results


def run_loop(inputs: Inputs, problem: Problem, search: AbstractSearch | None, max_iterations: int, traced: bool) -> Run:
    """Run the loop on the host or inside `jit`; without a search for a problem with fixed matches."""
    if traced:
        problem = replace(problem, source=whole_surface(problem.source), target=whole_surface(problem.target))
        # Gradients stop here, so that autodiff does not enter the compiled functions.
        loop = run_traced(jax.lax.stop_gradient(problem), search, max_iterations)
        return Run(inputs, problem, loop, search, executor=None)

    def index(position_alone: bool) -> AbstractIndex:
        method = PointToPoint() if position_alone else inputs.method
        return index_of(cast(AbstractSearch, search), method, inputs.target)

    executor = HostExecutor(problem, index, 1 if search is None else search.num_threads)
    with outside_trace():
        loop = executor.run()
        if loop.state.status == Status.NON_FINITE:
            input_checks.warn_of_extensions(inputs.method, executor, loop)
    return Run(inputs, problem, loop, search, executor)


@with_settings_of_package
def problem_of(
    given: Inputs, init: Pose | None, options: Options, num_threads: int | None, matches: Matches | None = None
) -> tuple[Problem, Inputs]:
    """The problem, in NumPy where everything is concrete; and its inputs, with the method's parameters chosen."""
    source, target, method = given[:3]
    input_checks.check_clouds(source, target, method)
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
    valid = pair.source.search.valid
    xp = numpy_for(valid)
    stride = xp.maximum(xp.sum(xp.asarray(valid)) // _COARSE_ROWS, 1) if matches is None else 1
    soft = options.soft_matches
    if soft is None:
        # By points, too, soft matches are better where channels are compared, and hard ones where they are not.
        compared = method.uses_channels and target.channels.shape[-1] > 0
        soft = compared and matches is None and not any(term.by_position for term in pair.terms)
    observes_channels = method.uses_channels and matches is None and source.channels.shape[-1]
    may_move = channels_may_move(source) if observes_channels else False
    problem = Problem(
        se3_from_matrix(centred_pose(init, source, target), source.points.dtype),
        pair.source,
        pair.target,
        pair.terms,
        settings_for(options, pair.method, source, target, stride, may_move),
        matches=matches,
        num_candidates=pair.method.num_candidates,
        temperature=constant(spacing_of(pair.method, target)) if soft else None,
        widens_kernels=given.robust is not None and matches is None,
    )
    return problem, given._replace(method=pair.method, source_rows=rows)


def rows_to_match(source: PointCloud, options: Options) -> Int[AnyArray, "n"] | None:
    limit = options.max_source_points
    return None if limit is None or limit >= source.valid.size else spread_rows(source.valid, limit)


def _equalized(inputs: Inputs, matches: Correspondences | None = None) -> Inputs:
    input_checks.check_channels(*inputs[:3])
    source, gains = with_channels_matched(*inputs[:2], matches)
    return inputs._replace(source=source, gains=gains if inputs.gains is None else inputs.gains * gains)


def _final_pose(run: Run) -> Pose:
    """In the user's frames, constant to autodiff."""
    return constant(pose_in_user_frame(run.loop.state.pose, run.inputs.source.origin, run.inputs.target.origin))


def _nearest_points(run: Run) -> Correspondences:
    source, target = run.inputs[:2]
    limit = run.problem.settings.fine_distance
    return find_correspondences(source, target, _final_pose(run), PointToPoint(), max_distance=limit, search=run.search)


def preprocessed(
    sides: dict[str, PointCloud],
    method: AbstractMethod,
    options: Options,
    voxel_size: VoxelSize | Voxels = "auto",
    num_neighbors: int = NUM_NEIGHBORS,
    checked: bool = True,
) -> list[PointCloud]:
    """The sides "source" and "target", preprocessed with one voxel size; raw where the method makes cells of them."""
    points = {name: cloud for name, cloud in sides.items() if not options.takes_raw(method, name)}
    voxels, grids = voxels_and_grids(voxel_size, *points.values())
    for (name, cloud), grid in zip(points.items(), grids, strict=True):
        if cloud.deferred_neighbors is None:
            with messages_named(name):
                sides[name] = preprocessed_in(grid, cloud, voxels, num_neighbors, options.search, checked)
    return list(sides.values())


def _at_scales(given: Inputs, voxel_sizes: Sequence[float]) -> Iterator[Inputs]:
    """The inputs of the registrations for these voxel sizes, metres; the last one gives the result. Cells have the last
    size, and GICP registers smaller voxels at the others. Methods without cells register the voxels of each size, and
    then the clouds."""
    method, sides = given.method, {"source": given.source, "target": given.target}
    if method.needs_covariances and len(voxel_sizes):
        for size in voxel_sizes[:-1]:
            voxels = dict[str, PointCloud]()
            for name, cloud in sides.items():
                with messages_named(name):
                    voxels[name] = with_neighbors(finite_rows(cloud), _COARSE_VOXEL * size, NUM_NEIGHBORS)
            yield given._replace(source=voxels["source"], target=voxels["target"], method=GICP())
        size = voxel_sizes[-1]
        for name in method.needs_covariances:
            channel_size: Any = None
            if method.uses_channels:
                # A cell extends as far in α · channel as in position.
                with np.errstate(divide="ignore"):
                    weights = method.weights(sides[name].channels.shape[1])
                    channel_size = size / np.asarray(weights, np.float64)
            with messages_named(name):
                sides[name] = voxel_gaussians(sides[name], size, channel_size=channel_size)
        yield given._replace(source=sides["source"], target=sides["target"])
        return
    for size in voxel_sizes:
        source, target = (
            preprocess(cloud, size, check_neighbors(cloud, numpy_for(cloud)).shape[-1]) for cloud in given[:2]
        )
        yield given._replace(source=source, target=target)
    yield given
