"""Convert the final state of the loop to a `RegistrationResult` in the user's frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool

from mcgicp_jax._clouds.origins import pose_in_user_frame
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import AnyArray, constant, is_concrete, numpy_for
from mcgicp_jax._compute.lazy import Held, Lazy
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._math.poses import se3_from_matrix, translation_adjoint
from mcgicp_jax._registration.assessment import Assessment
from mcgicp_jax._registration.result import Constraints, RegistrationResult, Uncertainty
from mcgicp_jax._registration.step import Record, State


def registration_of(
    state: State,
    assessment: Assessment,
    records: Record,
    source: PointCloud,
    target: PointCloud,
    used: Bool[AnyArray, "n"],
    derivative: Callable[[str, str], np.ndarray] | None = None,
) -> RegistrationResult:
    """Build the `RegistrationResult` of a final state, in the user's frames; NumPy where everything is concrete.

    Args:
        used: which source points could be matched; False for padding.
        derivative: computes `RegistrationResult.jacobian`.
    """
    history: dict[str, Any] = records._asdict()
    # Outside `jit`, the derivative of the pose, by the origins too, is all that may be traced.
    pose, source_origin, target_origin = state.pose, source.origin, target.origin
    state, source, target = map(primal, (state, source, target))
    concrete = is_concrete(state, history)
    if concrete:
        # Reading NumPy arrays compiles nothing.
        state, history = jax.tree.map(np.asarray, (state, history))
        pose = state.pose if is_concrete(pose) else pose
    matrix = pose_in_user_frame(pose, source_origin, target_origin)
    numbers: Any = {
        "status_code": state.status,
        "num_iterations": state.num_iterations,
        "num_inliers": state.record.num_inliers,
        "cost": state.record.cost,
        "rmse": state.record.rmse,
        "history": history,
    }
    if is_concrete(numbers, used):
        # NumPy scalars print as numbers, arrays without dimensions do not.
        numbers, used = jax.tree.map(lambda number: np.asarray(number)[()], (numbers, used))
    numbers["num_inliers"] = numbers["num_inliers"].astype(np.int32)
    numbers["overlap"] = (numbers["num_inliers"] / used.sum()).astype(numbers["rmse"].dtype)
    far = not is_concrete(source_origin, target_origin) or np.any(source_origin) or np.any(target_origin)
    return RegistrationResult.build(
        T_target_source=se3_from_matrix(matrix, pose.wxyz_xyz.dtype) if far else pose,
        source_origin=source_origin,
        target_origin=target_origin,
        centred=pose,
        constraints=_later(lambda: _constraints(assessment, source.origin), concrete),
        uncertainty=_later(lambda: _uncertainty(assessment, state, source.origin), concrete),
        derivative=Held(derivative),
        **numbers,
    )


def _later(compute: Callable[[], Any], concrete: bool) -> Lazy[Any]:
    """Deferred where concrete; traced values must be computed before the trace ends."""
    return Lazy(compute) if concrete else Lazy.of(compute())


def _read(deferred: Lazy[Any]) -> Any:
    """The value, as NumPy arrays where concrete: arithmetic with a large origin needs float64."""
    value = deferred.value
    return jax.tree.map(np.asarray, value) if is_concrete(value) else value


def _constraints(assessment: Assessment, origin: Any) -> Constraints:
    """Information matrix and directions in the frame of the user's source."""
    information, directions = _read(assessment.constraints)
    if is_concrete(origin) and not np.any(origin):
        return Constraints(information, directions)
    to_centred, from_centred = translation_adjoint(-origin), translation_adjoint(origin)
    # Non-finite values belong to the status NON_FINITE; NumPy need not warn of them.
    with np.errstate(invalid="ignore", over="ignore"):
        if directions is not None:
            moved = directions.twists @ from_centred.T, directions.center + origin
            directions = eqx.tree_at(lambda d: (d.twists, d.center), directions, moved)
        return Constraints(to_centred.T @ information @ to_centred, directions)


def _uncertainty(assessment: Assessment, state: State, origin: Any) -> Uncertainty:
    """The covariance in the frame of the user's source, and the deviations at the centroid of the matched points."""
    pose, center = constant((state.pose, state.sums.center))
    covariance = _read(assessment.covariance)
    xp = numpy_for(covariance, pose, center)
    with np.errstate(invalid="ignore", over="ignore"):
        matrix = pose_in_user_frame(pose, np.zeros(3), np.zeros(3))
        # In the target's axes T exp(ξ) turns by R ω, and moves the centre c by R v + (t − c) × R ω.
        to_center = translation_adjoint(matrix[:3, 3] - center) @ xp.kron(xp.eye(2), matrix[:3, :3])
        variances = xp.diagonal(to_center @ covariance @ to_center.T)
        # On noise-free points a variance is 0, up to rounding.
        deviations = xp.sqrt(xp.maximum(variances, 0)).astype(covariance.dtype)
        if is_concrete(origin) and not np.any(origin):
            return Uncertainty(covariance, deviations)
        from_centred = translation_adjoint(origin)
        return Uncertainty(from_centred @ covariance @ from_centred.T, deviations)
