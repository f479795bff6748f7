"""The Mahalanobis cost of given matches, for losses and custom loops. Pure JAX."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from mcgicp_jax._clouds.origins import centred_pose
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._local_geometry.surface import searched
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.poses import Pose
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._methods.base import AbstractGeneralized, AbstractMethod
from mcgicp_jax._methods.surfaces import SurfacePair, surface_pair
from mcgicp_jax._pose_solver.adaptation import adapted, sample_of_term
from mcgicp_jax._pose_solver.matched import Matched, Motion, linearize_at, match_surfaces, surface_rows
from mcgicp_jax._registration.input_checks import check_matches
from mcgicp_jax._search.base import Correspondences
from mcgicp_jax._terms.base import AbstractTerm


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

    Pure JAX, differentiable with respect to all inputs but the matches. Unlike `register`, it and its gradient compile
    for every size of clouds, also outside `jit`. Here M is a function of the rotation R, whereas `estimate_pose`, like
    every GICP, holds M fixed during each update: its pose is not exactly the minimum of F. With `photometric=True`, the
    standard deviations of the residuals are estimated at the given pose, as constants to autodiff, so that values at
    different poses do not compare.

    Args:
        pose: T_target_source, `jaxlie.SE3` or (4, 4).
        source, target: preprocessed clouds.
        matches: from `find_correspondences`.
        method: defines M; parameters left None are estimated from the clouds, as constants to autodiff.
        robust: kernel ρ applied to the Mahalanobis distance of each match, as in `register`; without any, ρ(s²) = s².
        temperature: metres. Weighs the candidates of each source point (`num_candidates`) by a softmax of
            −½ (distance / temperature)², with distances in position and α · channel; this gives α a gradient. As it
            tends to 0, only the nearest candidate counts. Required if there are several candidates, except for methods
            that sum over them (`D2DNDT`).
        log_determinant: add Σ log det (C^B + R C^A Rᵀ), which makes F (for squared distances) twice a Gaussian negative
            log-likelihood. Without it, a loss that learns covariances (or ε, or Λ) falls as these are inflated. For
            `GICP` and `MultiChannelGICP`.

    Returns:
        F, a scalar; in metres² for dimensionless covariances such as GICP's.

    Raises:
        ValueError: if `pose` is not a rigid motion, the shape of `matches` does not fit the source, `temperature` is
            missing or not positive, a cloud lacks the neighbours that the method needs, or `log_determinant` is set for
            a method without covariances.
    """
    check_matches(matches, source, method, temperature)
    if log_determinant and not isinstance(method, AbstractGeneralized):
        raise ValueError(f"log_determinant: expected a method with covariances, got {type(method).__name__}")
    surfaces = surface_pair if is_concrete(method, source, target) else _surface_pair_in_jit
    pair = surfaces(method, source, target, observed=False, robust=robust)
    dtype = source.points.dtype
    matrix = centred_pose(pose, source, target, "pose")
    rotation, translation = jnp.asarray(matrix[:3, :3], dtype), jnp.asarray(matrix[:3, 3], dtype)
    temperature = None if temperature is None else jnp.asarray(temperature, dtype)
    return _total_cost(Motion(rotation, translation), pair, matches, temperature, log_determinant)


# Without it, a gradient outside `jit` would compile each of some hundred operations alone.
_surface_pair_in_jit = jax.jit(surface_pair, static_argnames="observed")


@partial(jax.jit, static_argnames="log_determinant")
def _total_cost(
    motion: Motion,
    pair: SurfacePair,
    matches: Correspondences,
    temperature: Float[Array, ""] | None,
    log_determinant: bool,
) -> Float[Array, ""]:
    matched = match_surfaces(pair.source, pair.target, matches, temperature)

    def sample(term: AbstractTerm, rows: Int[Array, "n"]) -> Any:
        some = Matched(surface_rows(matched.source, rows), surface_rows(matched.target, rows), matched.valid[rows])
        return sample_of_term(motion, some, term)

    terms = adapted(pair.terms, searched(pair.source).valid, sample)
    _, found, counts = linearize_at(motion, matched, terms)
    cost = jnp.sum(found.cost)
    if log_determinant:
        determinant = jnp.where(matched.valid, alg.determinant(found.information), 1)
        cost = cost - jnp.sum(counts * jnp.log(determinant))
    return cost
