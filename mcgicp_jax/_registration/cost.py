"""The Mahalanobis cost of given matches, for losses and custom loops. Pure JAX."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._local_geometry.records import Surface
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.poses import Pose, pose_matrix
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._methods.base import AbstractGeneralized, AbstractMethod
from mcgicp_jax._methods.surface import surfaces_of
from mcgicp_jax._pose_solver.sums import estimates_at, forces_at, matched_rows
from mcgicp_jax._search.base import Correspondences


def mahalanobis_cost(
    pose: Pose,
    source: PointCloud,
    target: PointCloud,
    matches: Correspondences,
    method: AbstractMethod,
    *,
    robust: AbstractKernel | None = None,
    temperature: ArrayLike | None = None,
    log_determinant: bool = False,
) -> Float[Array, ""]:
    """Compute the cost F(T) = Σ ρ(dᵀ M d) of given matches, with d = b − T a and M = (C^B + R C^A Rᵀ)⁻¹ (Servos &
    Waslander 2014, eq. 3, which omits the inverse); M = I or n nᵀ for the methods without covariances.

    Pure JAX, differentiable with respect to everything but the matches. M is a function of the rotation R here. `align`
    holds M fixed during each update, as every GICP does, so its pose is not exactly the minimum of F.

    Args:
        pose: T_target_source, `jaxlie.SE3` or (4, 4).
        source, target: preprocessed clouds.
        matches: from `find_correspondences`.
        method: defines M; parameters left None are estimated from the clouds.
        robust: kernel ρ applied to the Mahalanobis distance of each match, as in `register`; without any, ρ(s²) = s².
        temperature: metres. Weighs the candidates of each source point (`num_candidates`) by a softmax of
            −½ (distance / temperature)², with distances in position and α · channel; this gives α a gradient. As it
            tends to 0, only the nearest candidate counts. Required if there are several candidates, but for NDT, whose
            cost is the sum over all of them.
        log_determinant: add Σ log det (C^B + R C^A Rᵀ), which makes F (for squared distances) twice a Gaussian negative
            log-likelihood. Without it, a loss that learns covariances (or ε, or Λ) falls as these are inflated. For
            `GICP` and `MultiChannelGICP`.

    Returns:
        F, a scalar. For dimensionless covariances, as GICP's are, in metres².

    Raises:
        ValueError: if `pose` is not a rigid motion, the shape of `matches` does not fit the source, `temperature` is
            missing or not positive, a cloud lacks the neighbours that the method needs, or `log_determinant` is set for
            a method without covariances.
    """
    check_matches(matches, source, method, temperature)
    if log_determinant and not isinstance(method, AbstractGeneralized):
        raise ValueError(f"log_determinant: expected a method with covariances, got {type(method).__name__}")
    method, *surfaces = surfaces_of(method, source, target, observed=False)
    dtype = source.points.dtype
    matrix = centred_pose(pose, source, target, "pose")
    rotation, translation = jnp.asarray(matrix[:3, :3], dtype), jnp.asarray(matrix[:3, 3], dtype)
    temperature = None if temperature is None else jnp.asarray(temperature, dtype)
    robust = method.default_kernel() if robust is None else robust
    return _total_cost(rotation, translation, *surfaces, matches, method, robust, temperature, log_determinant)


@partial(jax.jit, static_argnames="log_determinant")
def _total_cost(
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    source: Surface,
    target: Surface,
    matches: Correspondences,
    method: AbstractMethod,
    robust: AbstractKernel | None,
    temperature: Float[Array, ""] | None,
    log_determinant: bool,
) -> Float[Array, ""]:
    matched = matched_rows(source, target, matches, temperature)
    method = method.with_estimates(estimates_at(rotation, translation, matched, source.rows.valid, method.estimates))
    _, forces, counts = forces_at(rotation, translation, matched, method, robust)
    cost = jnp.sum(forces.cost)
    if log_determinant:
        determinant = jnp.where(matched.valid, alg.determinant(forces.information), 1)
        cost = cost - jnp.sum(counts * jnp.log(determinant))
    return cost


def check_matches(
    matches: Correspondences, source: PointCloud, method: AbstractMethod, temperature: ArrayLike | None
) -> None:
    """Raise `ValueError` unless there is one match per source row, or several and a positive `temperature` or a method
    that uses several."""
    rows = source.points.shape[0]
    if matches.indices.ndim > 2 or matches.indices.shape[-1] != rows:
        raise ValueError(f"matches: expected one per source row ({rows}), got shape {matches.indices.shape}")
    if matches.indices.ndim == 2 and temperature is None and method.num_candidates == 1:
        raise ValueError(f"temperature: expected metres to go with {matches.indices.shape[0]} candidates, got None")
    if temperature is not None and is_concrete(temperature) and not np.asarray(temperature) > 0:
        raise ValueError(f"temperature: expected a positive number of metres, got {temperature!r}")


def centred_pose(pose: Pose | None, source: PointCloud, target: PointCloud, name: str = "init") -> Array | np.ndarray:
    """T(−o_t) · T · T(o_s), (4, 4): the pose between coordinates relative to the clouds' origins, in its own precision.

    Raises:
        ValueError: as `pose_matrix`; `name` is the argument's name for the message.
    """
    distance = 0.0
    if is_concrete(source.origin, source.points) and np.any(source.origin):
        radius = float(np.abs(np.asarray(source.points)).max(initial=0))
        distance = float(np.linalg.norm(source.origin)) / radius if radius > 0 else 0.0
    matrix = pose_matrix(pose, name, distance)
    rotation, translation = matrix[:3, :3], matrix[:3, 3]
    # In this form two far origins cancel exactly, before the rotation is applied to either.
    shifted = (rotation - np.eye(3)) @ source.origin + (source.origin - target.origin) + translation
    if isinstance(shifted, np.ndarray) and isinstance(matrix, np.ndarray):
        result = matrix.copy()
        result[:3, 3] = shifted
        return result
    return jnp.asarray(matrix).at[:3, 3].set(shifted)
