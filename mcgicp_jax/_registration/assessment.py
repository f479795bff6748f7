"""The end of a registration: certainty of the final pose, and the `RegistrationResult` in the frames of the user."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float

from mcgicp_jax._clouds.origins import are_zero, pose_in_user_frame
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.cache import Held, Lazy
from mcgicp_jax._compute.concrete import AnyArray, constant, is_concrete, numpy_for
from mcgicp_jax._compute.linear_maps import primal, without_derivative
from mcgicp_jax._compute.programs import quickly_compiled
from mcgicp_jax._math.poses import adjoint_to_center, se3_from_matrix, translation_adjoint, units
from mcgicp_jax._math.statistics import sampled_rows
from mcgicp_jax._pose_solver.covariance import (
    Frame,
    Moments,
    discounts_and_radius,
    moments_from,
    noise_sample,
    sandwich,
)
from mcgicp_jax._pose_solver.degeneracy import directions_at_source
from mcgicp_jax._pose_solver.fusion import fused_covariance
from mcgicp_jax._pose_solver.matched import Motion, sample_of_term
from mcgicp_jax._pose_solver.pose_measurements import Fusion
from mcgicp_jax._registration.loop import AbstractExecutor, LoopResult, Record, State
from mcgicp_jax._registration.result import Constraints, RegistrationResult, Status, Uncertainty
from mcgicp_jax._terms.base import AbstractAdaptiveTerm, AbstractTerm, is_adaptive

_NO_DERIVATIVE = (
    "RegistrationResult: only the pose has a derivative, not cost, rmse, covariance or deviations; for that of the "
    "cost, call mahalanobis_cost at the pose, with the matches of find_correspondences"
)


class Assessment(NamedTuple):
    """Certainty of the final pose, deferred where the arrays are concrete."""

    constraints: Lazy[Constraints]
    covariance: Lazy[Float[AnyArray, "*batch 6 6"]]


def assessment_of(executor: AbstractExecutor, loop: LoopResult, with_covariance: bool = True) -> Assessment:
    """The assessment of a loop; traced ones without covariance, which takes most of the time, have NaN for it."""
    state = loop.state

    def covariance() -> Float[AnyArray, "6 6"]:
        fusion = executor.problem.fusion
        weights = moments_of(executor, loop) if fusion is None else fusion
        if not is_concrete(state):
            return covariance_of_pose(state, weights)
        # In float64: unconstrained directions have large variances, next to which others would be lost to rounding.
        with jax.enable_x64(True):
            return np.asarray(_covariance_on_host(*as_float64((state._replace(record=None), weights))))

    if is_concrete(state):
        return Assessment(Lazy(lambda: jax.tree.map(np.asarray, _constraints_on_host(state))), Lazy(covariance))
    constraints = Lazy.of(constraints_of(state))
    return Assessment(constraints, Lazy.of(covariance() if with_covariance else jnp.full((6, 6), jnp.nan)))


def moments_of(executor: AbstractExecutor, loop: LoopResult) -> Moments:
    problem, state, motion = executor.problem, loop.state, Motion.of(loop.state.pose.wxyz_xyz)
    search, matched_rows = problem.source.search, loop.matches.rows
    if matched_rows is not None:
        # In the coarse phase on the host.
        search = jax.tree.map(lambda array: array[matched_rows], search)
    xp, one = numpy_for(search.valid), np.ones((), problem.source.points.dtype)
    # Padding does not change which cells share a sum.
    num_cells = xp.maximum(search.valid.sum(), 1).astype(np.int32)
    frame = Frame(state.sums.center, state.sums.radius, np.tile(one, 2), one, num_cells)
    if problem.source.observed:
        rows, counts = sampled_rows(search.valid)
        # The nearest candidate of each source point alone; followed candidates are in any order.
        sampled = loop.matches.some(rows)
        first = executor.distances(motion, sampled).argmin(axis=0)[None]
        nearest = sampled._replace(indices=numpy_for(first).take_along_axis(sampled.indices, first, axis=0))
        sample = executor.rows(noise_sample, motion, nearest, with_noise=True)
        sample = jax.tree.map(lambda column: xp.where(counts, column, np.asarray(np.nan, column.dtype)), sample)
        num_channels = xp.sum(xp.any(search.descriptors != 0, axis=0))
        discount, neighborhood_radius = discounts_and_radius(sample, num_channels)
        frame = frame._replace(discount=discount, neighborhood_radius=neighborhood_radius)
    responding = None
    # Fixed matches do not respond to a motion.
    if problem.matches is None and is_adaptive(loop.terms):
        responding = tuple(_with_response(term, executor, loop) for term in loop.terms)
    scores = executor.scores(motion, loop.matches, frame, loop.terms, responding)
    ours, theirs = problem.settings.rounding
    rounding = (motion.rotation * ours) @ motion.rotation.T + numpy_for(theirs).diag(theirs)
    return moments_from(scores, search.valid.size)._replace(rounding=rounding)


def _with_response(term: AbstractTerm, executor: AbstractExecutor, loop: LoopResult) -> AbstractTerm:
    """An adaptive term with its response, from a sample of the source points that is shifted and matched anew."""
    if not isinstance(term, AbstractAdaptiveTerm):
        return term
    rows, counts = sampled_rows(executor.problem.source.search.valid)

    def sample(shift: Float[AnyArray, "3"]) -> Any:
        return executor.rows(sample_of_term, *executor.rematched(loop.state.pose, shift, rows, counts), term)

    with np.errstate(over="ignore", invalid="ignore"):
        if is_concrete(term.shifts):
            samples = jax.tree.map(lambda *results: np.stack(results), *map(sample, np.asarray(term.shifts)))
        else:
            samples = jax.lax.map(sample, term.shifts)
        return term.with_response(samples)


def as_float64(tree: Any) -> Any:
    arrays = jax.tree.map(np.asarray, tree)
    return jax.tree.map(lambda array: array.astype(np.float64) if array.dtype == np.float32 else array, arrays)


def constraints_of(state: State) -> Constraints:
    """Information matrix and directions at the final pose, for ξ in T exp(ξ), metres and radians."""
    sums, directions = state.sums, state.directions
    adjoint = adjoint_to_center(state.pose, sums.center) / units(sums.radius)[:, None]
    information = adjoint.T @ (state.information * sums.radius**2) @ adjoint
    at_source = None if directions is None else directions_at_source(directions, state.pose)
    return Constraints(information, at_source)


def covariance_of_pose(state: State, weights: Moments | Fusion) -> Float[Array, "6 6"]:
    """Covariance of the final pose, for ξ in T exp(ξ), metres and radians; NaN if the status allows none."""
    exists = (state.status != Status.TOO_FEW_CORRESPONDENCES) & (state.status != Status.NON_FINITE)
    if state.directions is None:
        exists = exists & (state.status != Status.DEGENERATE)
    center, radius = state.sums.center, state.sums.radius
    if isinstance(weights, Fusion):
        covariance = fused_covariance(state.pose, weights)
    else:
        covariance = sandwich(state.pose, center, radius, weights, state.directions)
    return jnp.where(exists, covariance, jnp.nan)


_constraints_on_host = quickly_compiled(constraints_of, level=0)
_covariance_on_host = quickly_compiled(covariance_of_pose, level=0)


def registration_of(
    state: State,
    assessment: Assessment,
    records: Record,
    source: PointCloud,
    target: PointCloud,
    matchable: Bool[AnyArray, "n"],
    derivative: Callable[[str, str], np.ndarray] | None = None,
    inputs: Any = None,
) -> RegistrationResult:
    """The result of a final state, in the user's frames; NumPy where everything is concrete. `matchable`: the source
    points that could be matched. Only the pose has a derivative by traced `inputs`."""
    # Outside `jit`, only the pose and the origins may be traced, by differentiation.
    pose, source_origin = state.pose, source.origin
    fixed_pose, origin = primal((pose, source_origin))
    concrete = is_concrete(state.status)
    numbers: Any = state.status, state.num_iterations, state.record, records._asdict(), matchable
    if concrete:
        # Reading NumPy arrays compiles nothing, and NumPy scalars, unlike arrays without axes, print as numbers.
        numbers = jax.tree.map(itemgetter(()), jax.tree.map(np.asarray, numbers))
    status, num_iterations, record, history, matchable = numbers
    num_inliers, center = record.num_inliers.astype(np.int32), state.sums.center

    def constraints() -> Constraints:
        information, directions = assessment.constraints.value
        to_centred, from_centred = translation_adjoint(-origin), translation_adjoint(origin)
        # Non-finite values belong to the status NON_FINITE; NumPy need not warn of them.
        with np.errstate(invalid="ignore", over="ignore"):
            if directions is not None:
                moved = directions.twists @ from_centred.T, directions.center + origin
                directions = eqx.tree_at(lambda d: (d.twists, d.center), directions, moved)
            return Constraints(to_centred.T @ information @ to_centred, directions)

    uncertainty = partial(_uncertainty_in_user_frame, assessment, fixed_pose, center, origin)
    constant_by = partial(without_derivative, inputs=inputs, message=_NO_DERIVATIVE)
    return RegistrationResult.build(
        status_code=status,
        num_iterations=num_iterations,
        num_inliers=num_inliers,
        cost=constant_by(record.cost),
        rmse=constant_by(record.rmse),
        overlap=(num_inliers / matchable.sum().clip(1)).astype(record.rmse.dtype),
        history=history,
        constraints=assessment.constraints if are_zero(origin) else _later(constraints, concrete),
        uncertainty=_later(uncertainty, concrete, constant_by),
        derivative=Held(derivative),
        **fields_of_pose(pose, source_origin, target.origin),
    )


def fields_of_pose(pose: jaxlie.SE3, source_origin: Any, target_origin: Any) -> dict[str, Any]:
    """Those of a `RegistrationResult` that follow from the pose and the origins of both clouds."""
    user = pose
    if not are_zero(source_origin, target_origin):
        user = se3_from_matrix(pose_in_user_frame(pose, source_origin, target_origin), pose.wxyz_xyz.dtype)
    return {"T_target_source": user, "source_origin": source_origin, "target_origin": target_origin, "centred": pose}


def with_traced_pose(
    result: RegistrationResult, pose: jaxlie.SE3, source_origin: Any, target_origin: Any, inputs: Any
) -> RegistrationResult:
    """A result of values, with a centred pose that has a derivative by traced `inputs`."""
    constant_by = partial(without_derivative, inputs=inputs, message=_NO_DERIVATIVE)
    fields = fields_of_pose(pose, source_origin, target_origin)
    fields |= {"cost": constant_by(result.cost), "rmse": constant_by(result.rmse)}
    fields["uncertainty"] = _later(lambda: result.uncertainty.value, True, constant_by)
    return result.build(**vars(result) | fields)


def _later(compute: Callable[[], Any], concrete: bool, constant_by: Callable[[Any], Any] = lambda value: value) -> Lazy:
    """Deferred where concrete; traced values must be computed before the trace ends."""

    def finish(values: Any) -> Any:
        try:
            return constant_by(values)
        except jax.errors.UnexpectedTracerError:
            # Read after the end of the differentiation.
            return values

    def read_only() -> Any:
        values = compute()
        # Arrays that a result keeps must not change.
        for array in jax.tree.leaves(values):
            if isinstance(array, np.ndarray):
                array.setflags(write=False)
        return values

    return Lazy(read_only, finish) if concrete else Lazy.of(constant_by(compute()))


def _uncertainty_in_user_frame(assessment: Assessment, pose: jaxlie.SE3, center: Any, origin: Any) -> Uncertainty:
    """The covariance in the frame of the user's source, and the deviations at the centroid of the matched points."""
    pose, center = constant((pose, center))
    covariance = assessment.covariance.value
    xp = numpy_for(covariance, pose, center)
    with np.errstate(invalid="ignore", over="ignore"):
        matrix = pose_in_user_frame(pose, np.zeros(3), np.zeros(3))
        # In the target's axes T exp(ξ) turns by R ω, and moves the centre c by R v + (t − c) × R ω.
        to_center = translation_adjoint(matrix[:3, 3] - center) @ xp.kron(xp.eye(2), matrix[:3, :3])
        variances = xp.diagonal(to_center @ covariance @ to_center.T)
        # On noise-free points a variance is 0, up to rounding.
        deviations = xp.sqrt(xp.maximum(variances, 0)).astype(covariance.dtype)
        if are_zero(origin):
            return Uncertainty(covariance, deviations)
        from_centred = translation_adjoint(origin)
        return Uncertainty(from_centred @ covariance @ from_centred.T, deviations)
