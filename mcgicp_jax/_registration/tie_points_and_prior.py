"""Tie points and priors as users give them: checked, and relative to the origins of the clouds."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.origins import centred_pose
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, constant, is_concrete, numpy_for, outside_trace
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._math.poses import matrix_of, translation_adjoint
from mcgicp_jax._math.symmetric_matrices import inverse_6
from mcgicp_jax._pose_solver import pose_measurements
from mcgicp_jax._pose_solver.covariance import Moments
from mcgicp_jax._pose_solver.degeneracy import Directions
from mcgicp_jax._pose_solver.fusion import fuse
from mcgicp_jax._pose_solver.pose_measurements import Fusion, PoseMeasurements, Prior, TiePoints
from mcgicp_jax._registration.assessment import as_float64
from mcgicp_jax._registration.loop import Problem, State

# Largest asymmetry of a correlation matrix, as rounding to float32 causes; and smallest eigenvalue with which the
# inverse of a correlation matrix keeps four digits in float64. Below it, a direction of a prior counts as fixed.
_ASYMMETRY, _LEAST_EIGENVALUE = 1e-5, 1e-12
# Rounding of the information of a prior at the standard deviation σ₀, with lengths in units of the cloud: a standard
# deviation of 3 %. A variance v becomes v + σ₀² (1 + v/σ₀²)⁻⁸, nearly the larger of v and σ₀², and at least 0.42 σ₀².
_LARGEST_ERROR, _SHARPNESS = 1e3, 8
# Standard deviations of a prior, of the motion of a point, within which the right pose is expected.
_DEVIATIONS = 3.0
# Source points (n, 3), target points (n, 3) and covariances (n, 3, 3); pose and covariance (6, 6).
if TYPE_CHECKING:
    GivenTiePoints: TypeAlias = tuple[Any, Any, Any]
    GivenPrior: TypeAlias = tuple[Any, Any]
else:
    # Not checked at run time: `checked_measurements` has better messages.
    GivenTiePoints = GivenPrior = Any


def checked_measurements(
    tie_points: GivenTiePoints | None, prior: GivenPrior | None, source: PointCloud, target: PointCloud
) -> tuple[TiePoints | None, Prior | None]:
    ties = None
    if tie_points is not None:
        form = "(source_points, target_points, covariances)"
        points, targets, covariances = _parts("tie_points", tie_points, form, 3)
        count = np.shape(points)[0] if np.ndim(points) else 0
        points = _numbers("tie_points: source_points", points, (count, 3))
        targets = _numbers("tie_points: target_points", targets, (count, 3))
        covariances = _numbers("tie_points: covariances", covariances, (count, 3, 3))
        if is_concrete(covariances):
            _, correlations = _correlations(covariances)
            definite = bool(np.linalg.eigvalsh(correlations).min(initial=1) > _LEAST_EIGENVALUE)
            _require("tie_points: covariances", correlations, definite, "positive definite")
        ties = TiePoints(points - source.origin, targets - target.origin, covariances)
    if prior is None:
        return ties, None
    pose, covariance = _parts("prior", prior, "(pose, covariance)", 2)
    matrix = centred_pose(pose, source, target, "prior: pose")
    covariance = _numbers("prior: covariance", covariance, (6, 6))
    # The points only scale the least deviations: while they are differentiated, their values suffice.
    cloud = primal(source)
    if is_concrete(covariance, cloud.points, source.origin):
        return ties, Prior(matrix[:3, :3], matrix[:3, 3], *_information(covariance, cloud))
    fixed, value = None, primal(covariance)
    if is_concrete(value):
        values, rows = _principal_rows(np.asarray(value, np.float64))
        fixed = _orthonormal(rows[values <= _LEAST_EIGENVALUE])
    lengths, least = _units(cloud)
    information = _information_traced(covariance, fixed, source.origin, (lengths * least) ** 2)
    return ties, Prior(matrix[:3, :3], matrix[:3, 3], *information)


def _units(source: PointCloud) -> tuple[Float[AnyArray, "6"], float]:
    """Units of ξ in which its components move the points of the cloud by similar distances; and in these σ₀, see
    `_LARGEST_ERROR`: rounding of more precise directions would spoil the others."""
    xp = numpy_for(source.points)
    radius = xp.maximum(xp.max(xp.abs(source.points), initial=0), 1e-30)
    least = float(np.sqrt(np.finfo(source.points.dtype).eps / _LARGEST_ERROR))
    return xp.repeat(xp.stack([radius, xp.ones_like(radius)]), 3), least


@jax.jit
def _information_traced(
    covariance: Float[AnyArray, "6 6"],
    fixed: Float[AnyArray, "6 6"] | None,
    origin: Float[AnyArray, "3"],
    least_variances: Float[AnyArray, "6"],
) -> tuple[Float[AnyArray, "6 6"], Float[AnyArray, "6 6"] | None]:
    """See `_information`."""

    def inverse(covariance: Float[AnyArray, "6 6"]) -> Float[AnyArray, "6 6"]:
        deviations = jnp.sqrt(jnp.diagonal(covariance))
        scale = deviations[:, None] * deviations
        return inverse_6(covariance / scale) / scale

    def information(covariance: Float[AnyArray, "6 6"], least: Float[AnyArray, "6 6"]) -> Float[AnyArray, "6 6"]:
        return inverse(covariance + jnp.linalg.matrix_power(least @ inverse(covariance + least), _SHARPNESS) @ least)

    if fixed is None:
        change = translation_adjoint(-origin)
        return information(change @ covariance @ change.T, jnp.diag(least_variances)), None
    back, across = translation_adjoint(origin), fixed.T @ fixed
    within = (jnp.eye(6) - across) @ back
    return within.T @ information(covariance + across, (back * least_variances) @ back.T) @ within, fixed @ back


def _principal_rows(covariance: Float[np.ndarray, "6 6"]) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6 6"]]:
    """Eigenvalues of the correlations, and rows with which ξ has these variances."""
    scale, correlations = _correlations(0.5 * (covariance + covariance.T))
    values, vectors = np.linalg.eigh(correlations)
    return values, vectors.T / scale


def _orthonormal(
    rows: Float[np.ndarray, "m 6"], lengths: Float[np.ndarray, "6"] | float = 1.0
) -> Float[np.ndarray, "6 6"] | None:
    """Rows that span the same space, orthonormal for ξ in these units, and rows of zeros; None if there are none."""
    rows = rows * lengths
    vectors = np.linalg.svd(rows / np.linalg.norm(rows, axis=1, keepdims=True))[2]
    return np.where(np.arange(6)[:, None] < len(rows), vectors, 0) / lengths if len(rows) else None


def _information(
    covariance: Float[np.ndarray, "6 6"], source: PointCloud
) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6 6"] | None]:
    """Information of ξ about the origin of the cloud, from its covariance about that of the user's coordinates; and the
    fixed directions, see `Prior`.

    One of the two has correlations that rounding does not spoil: the first for a pose that was measured at the cloud,
    the second for one measured at a far origin. A root of the information has twice the digits of the information.
    """
    references = []
    for offset in (source.origin, np.zeros(3)):
        change = translation_adjoint(-np.asarray(offset, np.float64))
        references.append((offset, *_principal_rows(change @ covariance @ change.T)))
    # Rounding lets directions look fixed that are not.
    offset, values, rows = max(references, key=lambda item: sorted(np.where(item[1] > _LEAST_EIGENVALUE, item[1], 0)))
    definite = bool(values[0] >= -_LEAST_EIGENVALUE and np.all(np.diagonal(covariance) >= 0))
    _require("prior: covariance", _correlations(covariance)[1], definite, "positive semidefinite")
    fixed = values <= _LEAST_EIGENVALUE
    rows = rows @ translation_adjoint(source.origin - offset)
    root = np.where(fixed, 0, 1 / np.sqrt(np.maximum(values, _LEAST_EIGENVALUE)))[:, None] * rows
    lengths, least = _units(source)
    lengths = np.asarray(lengths, np.float64)
    _, values, vectors = np.linalg.svd(root * lengths)
    ratios = (values * least) ** 2
    root = (values / np.sqrt(1 + ratios * (ratios / (1 + ratios)) ** _SHARPNESS))[:, None] * vectors / lengths
    return root.T @ root, _orthonormal(rows[fixed], lengths)


def measured(problem: Problem, ties: TiePoints | None, prior: Prior | None, traced: bool, limits: bool) -> Problem:
    """The problem of a first registration with tie points and a prior. If the prior `limits` it, the coarse
    `max_distance` is at most what the prior leaves between the initial pose and the right one."""
    dtype, (start, ties, prior) = problem.start.wxyz_xyz.dtype, constant((problem.start, ties, prior))
    rows = problem.source.search
    xp: Any = jnp if traced else np

    def as_dtype(tree: Any) -> Any:
        return jax.tree.map(lambda array: xp.asarray(array, dtype), tree)

    fixed = None if prior is None or prior.fixed is None else as_dtype(prior)
    if fixed is not None:
        with nullcontext() if traced else outside_trace():
            start = jax.tree.map(xp.asarray, pose_measurements.with_fixed_directions(start, fixed))
    matrix, valid = matrix_of(start), rows.valid[:, None]
    count = xp.maximum(xp.sum(valid), 1)
    mean = xp.sum(xp.where(valid, rows.points, 0), axis=0) / count
    square = xp.sum(xp.where(valid, rows.points - mean, 0) ** 2) / count
    rotation, translation, radius = matrix[:3, :3], matrix[:3, 3], xp.sqrt(xp.where(square > 0, square, 1))
    place = rotation, translation, rotation @ mean + translation, radius
    form, settings = pose_measurements.form_at(*place, ties, prior), problem.settings
    if limits and prior is not None:
        most = xp.asarray(radius * _distance_to_prior(rotation, form.prior), dtype)
        nearer = xp.maximum(xp.minimum(settings.max_distance, most), settings.fine_distance)
        settings = settings._replace(max_distance=xp.asarray(nearer))
    measurements = as_dtype(PoseMeasurements(*place, form))
    return replace(problem, start=start, measurements=measurements, fixed=fixed, settings=settings)


def _distance_to_prior(rotation: Float[AnyArray, "3 3"], prior: Prior) -> Float[AnyScalar, ""]:
    """Largest probable distance of a pose with this rotation, to which `PoseForm.prior` refers, from the right one, in
    units of the radius; infinite if some direction is not known."""
    xp = numpy_for(rotation, prior)
    fixed = 0.0 if prior.fixed is None else prior.fixed.T @ prior.fixed
    # Fixed directions count as if they were the most certain ones.
    variance = xp.trace(inverse_6(prior.information + fixed * (1 + xp.trace(prior.information))))
    turn = xp.linalg.norm(prior.rotation - rotation) / np.sqrt(2)
    is_known = xp.isfinite(variance) & (variance > 0)
    deviation = xp.sqrt(xp.where(is_known, variance, 1))
    return xp.where(is_known, xp.linalg.norm(prior.translation) + turn + _DEVIATIONS * deviation, xp.inf)


def fusion_of(state: State, moments: Moments, ties: TiePoints | None, prior: Prior | None, traced: bool) -> Fusion:
    """The equation of the pose with tie points and prior, from the final state of a first registration."""
    state, moments = constant((state, moments))
    dtype, matrix = state.pose.wxyz_xyz.dtype, matrix_of(state.pose)
    center, directions = state.sums.center, cast(Directions, state.directions)
    if not traced:
        # Reading NumPy arrays compiles nothing.
        center, directions = jax.tree.map(np.asarray, (center, directions))
    form = pose_measurements.form_at(matrix[:3, :3], matrix[:3, 3], center, directions.radius, ties, prior)
    if traced:
        # The form alone has a derivative.
        fusion = fuse(state.pose, center, directions, moments, constant(form))
        fusion = eqx.tree_at(lambda fusion: fusion.form, fusion, form)
    else:
        with jax.enable_x64(True), outside_trace():
            fusion = fuse(*as_float64((state.pose, center, directions, moments, form)))
        fusion = jax.tree.map(np.asarray, fusion)
    return jax.tree.map(lambda array: array if array.dtype == bool else array.astype(dtype), fusion)


def _parts(name: str, value: Any, form: str, count: int) -> Any:
    if isinstance(value, tuple | list) and len(value) == count:
        return value
    got = f"{len(value)} items" if isinstance(value, tuple | list) else type(value).__name__
    raise ValueError(f"{name}: expected {form}, got {got}")


def _numbers(name: str, value: Any, shape: tuple[int, ...]) -> Any:
    """The array, in float64 if it is concrete."""
    concrete = is_concrete(value)
    try:
        array = np.asarray(value, np.float64) if concrete else jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected numbers of shape {shape}, got {type(value).__name__}") from error
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")
    if concrete and not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")
    return array


def _correlations(covariances: Float[np.ndarray, "*n d d"]) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations and correlations, in which metres and radians may be of any size."""
    deviations = np.sqrt(np.maximum(np.einsum("...ii->...i", covariances), 0))
    deviations = np.where(deviations > 0, deviations, 1)
    return deviations, covariances / (deviations[..., :, None] * deviations[..., None, :])


def _require(name: str, correlations: Float[np.ndarray, "*n d d"], definite: bool, kind: str) -> None:
    symmetric = np.abs(correlations - correlations.swapaxes(-1, -2)).max(initial=0) < _ASYMMETRY
    if not (symmetric and definite):
        got = f"one that is not {kind if symmetric else 'symmetric'}"
        raise ValueError(f"{name}: expected symmetric {kind} matrices, got {got}")
