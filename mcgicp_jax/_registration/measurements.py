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
from mcgicp_jax._compute.concrete import AnyArray, constant, is_concrete, numpy_for, outside_trace
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._math.poses import matrix_of, skew, translation_adjoint
from mcgicp_jax._math.symmetric_matrices import inverse_6
from mcgicp_jax._pose_solver.covariance import Moments
from mcgicp_jax._pose_solver.degeneracy import Directions
from mcgicp_jax._pose_solver.fixed_directions import with_fixed_directions
from mcgicp_jax._pose_solver.fusion import fuse
from mcgicp_jax._pose_solver.pose_measurements import Fusion, Prior, TiePoints, form_at
from mcgicp_jax._registration.assessment import as_float64
from mcgicp_jax._registration.result import Status
from mcgicp_jax._registration.step import Problem, State

# Largest asymmetry of a correlation matrix, as rounding to float32 causes; and smallest eigenvalue with which the
# inverse of a correlation matrix keeps four digits in float64. Below it, a direction of a prior counts as fixed.
_ASYMMETRY, _LEAST_EIGENVALUE = 1e-5, 1e-12
# Directions whose standard deviation in a prior, as motion of the source points (rms), is below this fraction of the
# fine maximum correspondence distance can be fixed on the way: the error is corrected afterwards.
_PRECISE = 0.1
# Relative increase of the squared motion of the points, so that it has an inverse for points on a line.
_RIDGE = 1e-5
# Largest rounding of the information of a prior, with lengths in units of the cloud: a standard deviation of 3 %.
_LARGEST_ERROR = 1e3
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
    covariance = _numbers("prior: covariance", covariance, (6, 6))
    if is_concrete(covariance, source.points, source.origin):
        return Prior(matrix[:3, :3], matrix[:3, 3], *_information(covariance, source))
    fixed, root, given = None, None, primal(covariance)
    if is_concrete(given):
        root, fixed = _root_and_fixed(*_principal_rows(np.asarray(given, np.float64)))
    return Prior(matrix[:3, :3], matrix[:3, 3], *_information_traced(covariance, fixed, root, source.origin))


@jax.jit
def _information_traced(
    covariance: Float[AnyArray, "6 6"], fixed: Any, root: Any, origin: Float[AnyArray, "3"]
) -> tuple[Float[AnyArray, "6 6"], Any, Any]:
    change, back = translation_adjoint(-origin), translation_adjoint(origin)
    root = None if root is None else root @ back
    if fixed is None:
        return inverse_6(change @ covariance @ change.T), None, root
    across = fixed.T @ fixed
    within = (jnp.eye(6) - across) @ back
    return within.T @ inverse_6(covariance + across) @ within, fixed @ back, root


def _principal_rows(covariance: Float[np.ndarray, "6 6"]) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6 6"]]:
    """Eigenvalues of the correlations, and rows with which ξ has these variances."""
    scale, correlations = _correlations(0.5 * (covariance + covariance.T))
    values, vectors = np.linalg.eigh(correlations)
    return values, vectors.T / scale


def _root_and_fixed(
    values: Float[np.ndarray, "6"],
    rows: Float[np.ndarray, "6 6"],
    lengths: Float[np.ndarray, "6"] | float = 1.0,
    largest: float = np.inf,
) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6 6"] | None]:
    """`Prior.root` and `Prior.fixed`, orthogonal for ξ in these units, from `_principal_rows`.

    Args:
        largest: of the singular values of the root.
    """
    fixed, rows = values <= _LEAST_EIGENVALUE, rows * lengths
    roots = np.where(fixed, 0, 1 / np.sqrt(np.maximum(values, _LEAST_EIGENVALUE)))
    _, sizes, vectors = np.linalg.svd(roots[:, None] * rows)
    root = np.minimum(sizes, largest)[:, None] * vectors / lengths
    if not np.any(fixed):
        return root, None
    across = np.linalg.svd(rows[fixed] / np.linalg.norm(rows[fixed], axis=1, keepdims=True))[2][::-1]
    last = np.arange(6)[:, None] >= 6 - np.sum(fixed)
    return np.where(last, 0, root), np.where(last, across, 0) / lengths


def _information(covariance: Float[np.ndarray, "6 6"], source: PointCloud) -> tuple[Float[np.ndarray, "6 6"], Any, Any]:
    """Information of ξ about the origin of the cloud, from its covariance about that of the user's coordinates; and
    `fixed` and `root` of `Prior`.

    One of the two has correlations that rounding does not spoil: the first for a pose that was measured at the cloud,
    the second for one measured at a far origin. A root of the information has twice the digits of the information.
    """
    known = []
    for offset in (source.origin, np.zeros(3)):
        change = translation_adjoint(-np.asarray(offset, np.float64))
        known.append((offset, *_principal_rows(change @ covariance @ change.T)))
    # Rounding lets directions look fixed that are not.
    offset, values, rows = max(known, key=lambda each: sorted(np.where(each[1] > _LEAST_EIGENVALUE, each[1], 0)))
    definite = bool(values[0] >= -_LEAST_EIGENVALUE and np.all(np.diagonal(covariance) >= 0))
    _require("prior: covariance", _correlations(covariance)[1], definite, "positive semidefinite")
    points = np.asarray(source.points)
    lengths = np.repeat([max(float(np.abs(points).max(initial=0)), 1e-30), 1.0], 3)
    # The rounding of more precise directions would spoil the others.
    largest = float(np.sqrt(_LARGEST_ERROR / np.finfo(points.dtype).eps))
    root, fixed = _root_and_fixed(values, rows @ translation_adjoint(source.origin - offset), lengths, largest)
    return root.T @ root, fixed, root


def with_precise_fixed(problem: Problem, prior: Prior) -> Problem | None:
    """The problem with those directions fixed, too, that the prior knows to a fraction of the fine maximum
    correspondence distance; None if there are none, and inside `jit`."""
    if prior.root is None or not is_concrete(problem, prior):
        return None
    # Squared motion of the points (mean) by a twist.
    second = _second_moments(problem)
    mean, spread = second[:3, 3], second[:3, :3]
    motion = np.block([[np.eye(3), -skew(mean)], [skew(mean), np.trace(spread) * np.eye(3) - spread]])
    motion = motion + _RIDGE * np.diag(np.diagonal(motion))
    limit = _PRECISE * problem.settings.fine_distance
    precise = np.sum(prior.root @ inverse_6(motion) * prior.root, axis=1) * limit**2 >= 1
    fixed = np.where(precise[:, None], prior.root, 0 if prior.fixed is None else prior.fixed)
    return fixed_in(problem, prior._replace(fixed=fixed)) if np.any(precise) else None


def is_better(state: State, other: State, problem: Problem) -> bool:
    """Whether the end of a loop is elsewhere than another, by more than the fine maximum correspondence distance as
    motion of the source points (rms), and has converged or has more matches."""
    change = (matrix_of(state.pose) - matrix_of(other.pose))[:3]
    far = np.sum(change @ _second_moments(problem) * change) > problem.settings.fine_distance**2
    merits = [(end.status == Status.CONVERGED, end.record.num_inliers) for end in (state, other)]
    return bool(far and merits[0] > merits[1])


def _second_moments(problem: Problem) -> Float[np.ndarray, "4 4"]:
    """Mean of h hᵀ over the source points, h = (a, 1)."""
    points = np.asarray(problem.source.search.points, np.float64)[np.asarray(problem.source.search.valid)]
    h = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    return h.T @ h / max(len(points), 1)


def fixed_in(problem: Problem, prior: Prior) -> Problem:
    """The problem with the directions that the prior fixes, from the start on."""
    dtype, (start, prior) = problem.start.wxyz_xyz.dtype, constant((problem.start, prior))
    xp = numpy_for(start, prior)
    prior = jax.tree.map(lambda array: xp.asarray(array, dtype), prior)
    with jax.default_matmul_precision("highest"), outside_trace() if xp is np else nullcontext():
        start = with_fixed_directions(start, prior)
    return replace(problem, start=jax.tree.map(np.asarray, start) if xp is np else start, fixed=prior)


def fusion_of(state: State, moments: Moments, ties: TiePoints | None, prior: Prior | None) -> Fusion:
    """The equation of the pose with tie points and prior, from the final state of a registration without them."""
    state, moments = constant((state, moments))
    dtype, matrix = state.pose.wxyz_xyz.dtype, matrix_of(state.pose)
    center, directions = state.sums.center, cast(Directions, state.directions)
    if is_concrete(state):
        # Reading NumPy arrays compiles nothing.
        center, directions = jax.tree.map(np.asarray, (center, directions))
    form = form_at(matrix[:3, :3], matrix[:3, 3], center, directions.radius, ties, prior)
    fixed = primal(form)
    if is_concrete(state, moments, fixed):
        with jax.enable_x64(True), outside_trace():
            fusion = fuse(*as_float64((state.pose, center, directions, moments, fixed)))
        fusion = jax.tree.map(lambda array: np.asarray(array, None if array.dtype == bool else dtype), fusion)
        if form is fixed:
            return fusion
    else:
        fusion = fuse(state.pose, center, directions, moments, constant(fixed))
        fusion = jax.tree.map(lambda array: array if array.dtype == bool else array.astype(dtype), fusion)
    form = jax.tree.map(lambda array: jnp.asarray(array, dtype), form)
    return eqx.tree_at(lambda fusion: fusion.form, fusion, form)


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
        _, correlations = _correlations(array)
        definite = bool(np.linalg.eigvalsh(correlations).min(initial=1) > _LEAST_EIGENVALUE)
        _require(name, correlations, definite, "positive definite")
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
