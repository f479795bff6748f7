"""The registration of one pair of clouds with all its options, from a given initial pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
from jaxtyping import Float, Int

from mcgicp_jax._clouds.origins import centred_pose, pose_in_user_frame
from mcgicp_jax._clouds.point_cloud import PointCloud, Values, Voxels, as_cloud
from mcgicp_jax._clouds.preprocess import preprocessed_in
from mcgicp_jax._clouds.voxel_size import NUM_NEIGHBORS, VoxelSize, voxels_and_grids
from mcgicp_jax._compute.cache import Lazy
from mcgicp_jax._compute.concrete import AnyArray, constant, is_concrete, numpy_for, outside_trace
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.messages import messages_named
from mcgicp_jax._compute.threads import in_new_thread, without_checks_of_jax
from mcgicp_jax._local_geometry.channel_equalization import (
    warn_of_exposure,
    warn_of_units,
    with_channels_matched,
)
from mcgicp_jax._math.poses import Pose, se3_from_matrix
from mcgicp_jax._math.statistics import spread_rows
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._methods.gicp import GICP
from mcgicp_jax._methods.icp import PointToPoint
from mcgicp_jax._methods.surfaces import surface_pair
from mcgicp_jax._pose_solver.covariance import Moments
from mcgicp_jax._pose_solver.matched import Matches
from mcgicp_jax._pose_solver.pose_measurements import Prior
from mcgicp_jax._registration.assessment import Assessment, assessment_of, moments_of, registration_of
from mcgicp_jax._registration.correspondences import find_correspondences, index_of
from mcgicp_jax._registration.input_checks import (
    check_channels,
    check_clouds,
    warn_of_constant_weights,
    warn_of_covariances,
)
from mcgicp_jax._registration.loop import LoopResult, iterate
from mcgicp_jax._registration.measurements import (
    GivenPrior,
    GivenTiePoints,
    fixed_in,
    fusion_of,
    is_better,
    known,
    with_precise_fixed,
)
from mcgicp_jax._registration.multi_scale import stages_of
from mcgicp_jax._registration.on_host import HostExecutor
from mcgicp_jax._registration.options import Options, check_method
from mcgicp_jax._registration.pose_derivative import Given, Inputs, differentiated, jacobian, with_derivatives
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
        gains: by which the channels of the source were multiplied; None unless equalised.
        loop: its end, constant to autodiff.
        executor: of the loop; None inside `jit`.
        state: computes the final state, whose pose is differentiable inside `jit`.
        assessment, moments: compute these of the final pose.
    """

    inputs: Inputs
    gains: Float[AnyArray, "C"] | None
    problem: Problem
    loop: LoopResult
    executor: HostExecutor | None
    state: Callable[[], State]
    assessment: Callable[[], Assessment]
    moments: Callable[[], Moments]


@without_checks_of_jax
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
) -> Given:
    """The arguments of a registration, checked; clouds preprocessed unless the method makes cells of raw ones."""
    check_method(method)
    warn_of_constant_weights(method)
    sides = {"source": as_cloud("source", source), "target": as_cloud("target", target)}
    source, target = preprocessed(sides, method, options)
    if options.voxel_sizes and not (source.covariances is None and target.covariances is None):
        raise ValueError("voxel_sizes: expected none for clouds with covariances, which cannot be averaged in voxels")
    if options.voxel_sizes and method.needs_covariances and not is_concrete(source, target):
        raise ValueError("voxel_sizes: expected none for derivatives with cells; make these with voxel_gaussians")
    return Given(source, target, method, options.robust, *known(tie_points, prior, source, target))


@without_checks_of_jax
def run_pair(given: Given, init: Pose | None, options: Options) -> Run:
    """Register arrays that are all concrete, or some of which `jit` or `vmap` trace."""
    source, target, method, robust, ties, belief, _ = given
    options, gains = replace(options, robust=robust), None
    if isinstance(method, GICP) and is_concrete(source, target):
        warn_of_covariances(source, target)
    if options.equalize_channels:
        source, gains = _equalized(source, target, method)
    elif method.uses_channels and is_concrete(source, target):
        warn_of_units(source, target)
    *before, (method, source, target) = stages_of(method, source, target, options.voxel_sizes)
    search = options.search or default_search()
    once = replace(options, max_distance=None)
    for stage in before:
        run = _solved(stage.source, stage.target, stage.method, init, once, search, belief)
        (found,) = results_of([run], [None])
        init = found.matrix if is_usable(found) else init
    run = _solved(source, target, method, init, options, search, belief)
    if options.equalize_channels and not any(term.estimates_gains for term in run.problem.terms):
        source, more = _equalized(source, target, method, _nearest_points(source, target, run, search))
        gains = gains * more
        init = constant(pose_in_user_frame(run.loop.state.pose, source.origin, target.origin))
        run = _solved(source, target, method, init, options, search, belief)
    elif not options.equalize_channels and method.uses_channels and is_concrete(source, target, run.loop.state.pose):
        warn_of_exposure(source, target, lambda: _nearest_points(source, target, run, search))
    if not (ties is None and belief is None):
        fusion = fusion_of(run.loop.state, run.moments(), ties, belief)
        problem = replace(run.problem, start=constant(run.loop.state.pose), fusion=fusion)
        run = run_loop(run.inputs._replace(form=fusion.form), problem, search, options.max_iterations)
    return run._replace(gains=gains)


@without_checks_of_jax
def results_of(runs: Sequence[Run], givens: Sequence[Given | None]) -> list[RegistrationResult]:
    """The results of registrations.

    Args:
        givens: the arguments of each, or None. Outside `jit`, the poses get derivatives by those arrays of these
            arguments that are traced. All derivatives are computed side by side.
    """
    traced = [
        None
        if given is None or run.executor is None
        else differentiated(given, run.inputs, run.executor, run.loop, run.gains)
        for run, given in zip(runs, givens, strict=True)
    ]
    states = with_derivatives([run.state() for run in runs], traced)
    results = []
    for state, run, given in zip(states, runs, givens, strict=True):
        by = None if run.executor is None else partial(jacobian, run.inputs, run.executor, run.loop, run.gains)
        # Traced origins are those of the inputs, as cells, which may have others, are made of concrete clouds alone.
        traces_origins = given is not None and not is_concrete(given.source.origin, given.target.origin)
        source, target = (given if given is not None and traces_origins else run.inputs)[:2]
        used = run.problem.source.search.valid
        results.append(registration_of(state, run.assessment(), run.loop.history, source, target, used, by))
    return results


def _solved(
    source: PointCloud,
    target: PointCloud,
    method: AbstractMethod,
    init: Pose | None,
    options: Options,
    search: AbstractSearch,
    prior: Prior | None,
) -> Run:
    """Pose and run the problem, with no more of the prior than the directions that it fixes.

    If it ends better elsewhere with precise directions fixed, too, that is the basin of convergence. Otherwise
    the pose, from which the weights of the prior follow, is that of the matches alone from `init`.
    """
    problem, inputs = pose_problem(source, target, method, init, options, search.num_threads)
    problem = problem if prior is None or prior.fixed is None else fixed_in(problem, prior)
    run = run_loop(inputs, problem, search, options.max_iterations)
    guided = None if prior is None else with_precise_fixed(problem, prior)
    if guided is not None:
        state = run_loop(inputs, guided, search, options.max_iterations).loop.state
        if is_better(state, run.loop.state, problem):
            run = run_loop(inputs, replace(problem, start=state.pose), search, options.max_iterations)
    return run


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
        return Run(inputs, None, problem, loop, None, state, partial(assess, *ended), partial(moments_traced, *ended))

    def index(position_alone: bool) -> AbstractIndex:
        if search is None:
            raise ValueError("matches: expected a registration that searches for them")
        return index_of(search, PointToPoint() if position_alone else inputs.method, inputs.target)

    executor = HostExecutor(problem, index, 1 if search is None else search.num_threads)
    with outside_trace():
        loop = iterate(executor)
    moments = Lazy(lambda: moments_of(executor, loop))
    assessment = assessment_of(executor, loop, None if problem.fusion is not None else moments)
    return Run(inputs, None, problem, loop, executor, lambda: loop.state, lambda: assessment, lambda: moments.value)


@without_checks_of_jax
def pose_problem(
    source: PointCloud,
    target: PointCloud,
    method: AbstractMethod,
    init: Pose | None,
    options: Options,
    num_threads: int | None,
    matches: Matches | None = None,
) -> tuple[Problem, Inputs]:
    """Inputs of the loop for preprocessed clouds, NumPy arrays where everything is concrete; and what these were
    computed from.

    Args:
        matches: those at every pose; None to search for them.
    """
    check_clouds(source, target, method)
    rows = rows_to_match(source, options)
    pair = surface_pair(
        method,
        source,
        target,
        observed=matches is None,
        robust=options.robust,
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
    temperature = None if matches is None else matches.temperature
    return problem, Inputs(source, target, pair.method, pair.terms, temperature=temperature, source_rows=rows)


def rows_to_match(source: PointCloud, options: Options) -> Int[AnyArray, "n"] | None:
    """The source rows that `max_source_points` leaves; None for all."""
    most = options.max_source_points
    return None if most is None or most >= source.valid.size else spread_rows(source.valid, most)


def _equalized(
    source: PointCloud, target: PointCloud, method: AbstractMethod, matches: Correspondences | None = None
) -> tuple[PointCloud, Float[AnyArray, "C"]]:
    check_channels(source, target, method)
    return with_channels_matched(source, target, matches)


def _nearest_points(source: PointCloud, target: PointCloud, run: Run, search: AbstractSearch) -> Correspondences:
    """Nearest matches in position at the final pose."""
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
    """The clouds "source" and "target", preprocessed with one voxel size unless the method makes cells of raw ones."""
    points = {name: cloud for name, cloud in sides.items() if not options.takes_raw(method, name)}
    voxels, grids = voxels_and_grids(voxel_size, *points.values())
    for (name, cloud), grid in zip(points.items(), grids, strict=True):
        if cloud.deferred_neighbors is None:
            with messages_named(name):
                sides[name] = preprocessed_in(grid, cloud, voxels, num_neighbors, options.search)
    return list(sides.values())
