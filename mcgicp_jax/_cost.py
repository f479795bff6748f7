"""The Mahalanobis cost of given matches, for losses and loops of one's own. Pure JAX."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mcgicp_jax import _algebra as alg
from mcgicp_jax._cloud import PointCloud
from mcgicp_jax._kernels import AbstractKernel
from mcgicp_jax._methods import AbstractGeneralized, AbstractMethod
from mcgicp_jax._pose import Pose, is_concrete, pose_matrix
from mcgicp_jax._search import Correspondences
from mcgicp_jax._sums import forces_at, matched_rows
from mcgicp_jax._surface import Surface
from mcgicp_jax._surfaces import surfaces_of


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
    """F(T) = Σ ρ(dᵀ M d) with d = b − T a and M = (C^B + R C^A Rᵀ)⁻¹ (Servos & Waslander 2014, eq. 3, whose inverse is
    missing in print).

    Pure JAX, differentiable in everything but the matches. M follows the rotation here, so that F is the cost itself;
    the pose that `align` returns holds M during an update, as every GICP does, and is not exactly F's minimum.

    Args:
        pose: T_target_source, `jaxlie.SE3` or (4, 4).
        source, target: preprocessed clouds.
        matches: from `find_correspondences`.
        method: which covariances; open numbers are chosen from the data.
        robust: kernel of each pair's Mahalanobis distance.
        temperature: metres; with several candidates per source point (`num_candidates`), each pair counts by a softmax
            of −½ (distance / temperature)², distances in position and α · channel. This gives α a gradient. Towards 0
            the nearest candidate alone counts.
        log_determinant: add Σ log det (C^B + R C^A Rᵀ). Together with the squared distance that is a Gaussian
            likelihood; without it, a loss that learns covariances (or ε, or Λ) is lowered by inflating them. For `GICP`
            and `MultiChannelGICP`.

    Returns:
        The cost; metres² for the methods with M = I, otherwise in units of GICP's relative covariances.

    Raises:
        ValueError: if the matches do not belong to the source, a cloud lacks the neighbours that the method needs, or
            the method has no determinant.
    """
    check_matches(matches, source, temperature)
    if log_determinant and not isinstance(method, AbstractGeneralized):
        raise ValueError(f"log_determinant: expected a method with covariances, got {type(method).__name__}")
    method, *surfaces = surfaces_of(method, source, target, observed=False)
    dtype = source.points.dtype
    matrix = centred_pose(pose, source, target, "pose")
    rotation, translation = jnp.asarray(matrix[:3, :3], dtype), jnp.asarray(matrix[:3, 3], dtype)
    temperature = None if temperature is None else jnp.asarray(temperature, dtype)
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
    _, forces, counts = forces_at(rotation, translation, matched, method, robust)
    cost = jnp.sum(forces.cost)
    if log_determinant:
        determinant = jnp.where(matched.valid, alg.determinant(forces.information), 1)
        cost = cost - jnp.sum(counts * jnp.log(determinant))
    return cost


def check_matches(matches: Correspondences, source: PointCloud, temperature: ArrayLike | None) -> None:
    """Raise `ValueError` unless there is a match, or a softened choice of candidates, for every source row."""
    rows = source.points.shape[0]
    if matches.indices.ndim > 2 or matches.indices.shape[-1] != rows:
        raise ValueError(f"matches: expected one per source row ({rows}), got shape {matches.indices.shape}")
    if matches.indices.ndim == 2 and temperature is None:
        raise ValueError(f"temperature: expected metres to go with {matches.indices.shape[0]} candidates, got None")
    if temperature is not None and is_concrete(temperature) and not np.asarray(temperature) > 0:
        raise ValueError(f"temperature: expected a positive number of metres, got {temperature!r}")


def centred_pose(pose: Pose | None, source: PointCloud, target: PointCloud, name: str = "init") -> Array | np.ndarray:
    """The same motion between the clouds' own origins: T(−o_t) · T · T(o_s), in the precision that it comes in.

    Raises:
        ValueError: as `pose_matrix`; `name` is that of the argument.
    """
    distance = 0.0
    if is_concrete(source.origin, source.points) and np.any(source.origin):
        radius = np.abs(np.asarray(source.points)).max(initial=0.0)
        distance = float(np.linalg.norm(source.origin) / max(radius, np.finfo(np.float64).tiny))
    matrix = pose_matrix(pose, name, distance)
    rotation, translation = matrix[:3, :3], matrix[:3, 3]
    # In this order two far origins cancel before they meet the rotation.
    shifted = (rotation - np.eye(3)) @ source.origin + (source.origin - target.origin) + translation
    if isinstance(shifted, np.ndarray) and isinstance(matrix, np.ndarray):
        result = matrix.copy()
        result[:3, 3] = shifted
        return result
    return jnp.asarray(matrix).at[:3, 3].set(shifted)
