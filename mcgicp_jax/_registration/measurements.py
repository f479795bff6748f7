"""Tie points and priors as users give them: checked, and relative to the origins of the clouds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.origins import centred_pose
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import AnyArray, constant, is_concrete, numpy_for, outside_trace
from mcgicp_jax._math.poses import matrices_of, translation_adjoint
from mcgicp_jax._pose_solver.covariance import Moments
from mcgicp_jax._pose_solver.degeneracy import Directions
from mcgicp_jax._pose_solver.fusion import fuse
from mcgicp_jax._pose_solver.pose_measurements import Fusion, Prior, TiePoints, form_at
from mcgicp_jax._registration.assessment import as_float64
from mcgicp_jax._registration.step import State

# Largest asymmetry of a correlation matrix, as rounding to float32 causes; and smallest eigenvalue with which the
# inverse of a correlation matrix keeps four digits in float64.
_ASYMMETRY, _LEAST_EIGENVALUE = 1e-5, 1e-12
# Source points (n, 3), target points (n, 3) and covariances (n, 3, 3); pose and covariance (6, 6).
if TYPE_CHECKING:
    GivenTiePoints: TypeAlias = tuple[Any, Any, Any]
    GivenPrior: TypeAlias = tuple[Any, Any]
else:
    # Not checked at run time: `known` has better messages.
    GivenTiePoints = GivenPrior = Any


def known(
    tie_points: GivenTiePoints | None, prior: GivenPrior | None, source: PointCloud, target: PointCloud
) -> tuple[TiePoints | None, Prior | None]:
    """Tie points and prior, checked, relative to the origins of the clouds."""
    ties = None if tie_points is None else _centred_tie_points(tie_points, source, target)
    return ties, None if prior is None else _centred_prior(prior, source, target)


def _centred_tie_points(given: GivenTiePoints, source: PointCloud, target: PointCloud) -> TiePoints:
    points, targets, covariances = _parts("tie_points", given, "(source_points, target_points, covariances)", 3)
    count = np.shape(points)[0] if np.ndim(points) else 0
    points, targets = (
        _numbers(f"tie_points: {side}", each, (count, 3))
        for side, each in (("source_points", points), ("target_points", targets))
    )
    covariances = _covariances("tie_points: covariances", covariances, (count, 3, 3))
    return TiePoints(points - source.origin, targets - target.origin, covariances)


def _centred_prior(given: GivenPrior, source: PointCloud, target: PointCloud) -> Prior:
    pose, covariance = _parts("prior", given, "(pose, covariance)", 2)
    matrix = centred_pose(pose, source, target, "prior: pose")
    covariance = _covariances("prior: covariance", covariance, (6, 6))
    if not is_concrete(source.origin) or np.any(source.origin):
        change = translation_adjoint(-source.origin)
        covariance = change @ covariance @ change.T
    return Prior(matrix[:3, :3], matrix[:3, 3], covariance)


def fusion_of(state: State, moments: Moments, ties: TiePoints | None, prior: Prior | None) -> Fusion:
    """The equation of the pose with tie points and prior, from the final state of a registration without them."""
    state, moments = constant((state, moments))
    dtype, matrix = state.pose.wxyz_xyz.dtype, _matrix_of(state.pose)
    center, directions = state.sums.center, cast(Directions, state.directions)
    if is_concrete(state):
        # Reading NumPy arrays compiles nothing.
        center, directions = jax.tree.map(np.asarray, (center, directions))
    form = form_at(matrix[:3, :3], matrix[:3, 3], center, directions.radius, ties, prior)
    if is_concrete(state, moments, form):
        with jax.enable_x64(True), outside_trace():
            fusion = fuse(*as_float64((state.pose, center, directions, moments, form)))
        return jax.tree.map(lambda array: np.asarray(array, None if array.dtype == bool else dtype), fusion)
    form = jax.tree.map(lambda array: jnp.asarray(array, dtype), form)
    fusion = fuse(state.pose, center, directions, moments, constant(form))
    fusion = jax.tree.map(lambda array: array if array.dtype == bool else array.astype(dtype), fusion)
    return eqx.tree_at(lambda fusion: fusion.form, fusion, form)


def _matrix_of(pose: jaxlie.SE3) -> Float[AnyArray, "4 4"]:
    if is_concrete(pose):
        return matrices_of(np.asarray(pose.wxyz_xyz, np.float64))
    return pose.as_matrix()


def _parts(name: str, given: Any, form: str, count: int) -> Any:
    if not isinstance(given, tuple | list) or len(given) != count:
        raise ValueError(f"{name}: expected {form}, got {type(given).__name__}")
    return given


def _numbers(name: str, given: Any, shape: tuple[int, ...]) -> Any:
    """The array, in float64 if it is concrete."""
    try:
        array = numpy_for(given).asarray(given, np.float64 if is_concrete(given) else None)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected numbers of shape {shape}, got {type(given).__name__}") from error
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")
    if is_concrete(array) and not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")
    return array


def _covariances(name: str, given: Any, shape: tuple[int, ...]) -> Float[AnyArray, "*n d d"]:
    """The array, checked to be symmetric and positive definite if it is concrete."""
    array = _numbers(name, given, shape)
    if is_concrete(array):
        deviations = np.sqrt(np.maximum(np.einsum("...ii->...i", array), 0))
        scale = deviations[..., :, None] * deviations[..., None, :]
        # Correlations, so that metres and radians may be of any size.
        correlations = array / np.where(scale > 0, scale, 1)
        symmetric = np.abs(correlations - correlations.swapaxes(-1, -2)).max(initial=0) < _ASYMMETRY
        if not (symmetric and np.linalg.eigvalsh(correlations).min(initial=1) > _LEAST_EIGENVALUE):
            got = "one that is not positive definite" if symmetric else "one that is not symmetric"
            raise ValueError(f"{name}: expected symmetric positive definite matrices, got {got}")
    return array
