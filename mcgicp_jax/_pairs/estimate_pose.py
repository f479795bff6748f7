"""The pose for given matches, for losses and custom loops. Pure JAX."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from mcgicp_jax._clouds.origins import centred_pose
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._math.poses import Pose, se3_from_matrix
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._methods.surfaces import surface_pair
from mcgicp_jax._pose_solver.matched import match_surfaces
from mcgicp_jax._registration.input_checks import check_clouds, check_matches
from mcgicp_jax._registration.make_result import registration_of
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.result import RegistrationResult
from mcgicp_jax._registration.settings import settings_for
from mcgicp_jax._registration.step import Problem
from mcgicp_jax._registration.traced import assess_alignment, differentiable, estimate_pose_traced
from mcgicp_jax._search.base import Correspondences


def estimate_pose(
    source: PointCloud,
    target: PointCloud,
    matches: Correspondences,
    method: AbstractMethod,
    *,
    init: Pose | None = None,
    max_iterations: int = Options.max_iterations,
    translation_tolerance: ArrayLike | None = None,
    rotation_tolerance: ArrayLike = Options.rotation_tolerance,
    robust: AbstractKernel | None = None,
    temperature: ArrayLike | None = None,
) -> RegistrationResult:
    """Compute the pose for fixed matches: update the pose, recompute M, and repeat until the pose converges. Pure JAX.

    Works under `jit`, `vmap`, `grad` and `jvp`. The first derivative follows from the implicit function theorem for
    the root of Σ w JᵀM d = 0 near the returned pose (d = b − T a, J = ∂(T a)/∂ξ, robust weight w). Matches, neighbours
    and estimated parameters are constants. The derivative is exact with respect to points, channels, given covariances,
    given parameters of the method (α: only with `temperature`) and the robust scale. It is zero with respect to `init`,
    because the root does not depend on it. It is zero, never NaN, if there are too few matches, if `information` is
    singular, or if Newton's method does not converge from the returned pose. Second derivatives raise
    `NotImplementedError`.

    Args:
        source, target: preprocessed clouds.
        matches: from `find_correspondences`.
        method: as in `register`.
        init: initial T_target_source, `jaxlie.SE3` or (4, 4); the identity by default.
        max_iterations: maximum number of pose updates.
        translation_tolerance, rotation_tolerance: metres and radians, as in `register`.
        robust: kernel ρ applied to the Mahalanobis distance of each match, as in `register`.
        temperature: metres; soft assignment of several candidates per source point, as in `mahalanobis_cost`.

    Returns:
        The pose with its status; check `converged`. `directions` is None: unconstrained directions, such as motion
        along a plane, are not detected.

    Raises:
        ValueError: if an argument is malformed; failures on well-formed input show in `RegistrationResult.status`.
    """
    options = Options(
        max_distance=np.inf,
        max_iterations=max_iterations,
        translation_tolerance=translation_tolerance,
        rotation_tolerance=rotation_tolerance,
        hold_unconstrained=False,
        robust=robust,
    )
    check_matches(matches, source, method, temperature)
    check_clouds(source, target, method)
    pair = surface_pair(method, source, target, observed=False, robust=robust)
    dtype = source.points.dtype
    start = se3_from_matrix(centred_pose(init, source, target), dtype)
    softness = None if temperature is None else jnp.asarray(temperature, dtype)
    settings = settings_for(options, pair.method, target, 1, dtype)
    problem = Problem(start, pair.source, pair.target, pair.terms, settings)
    fixed, fixed_softness = jax.lax.stop_gradient((problem, softness))
    loop = estimate_pose_traced(fixed, matches, fixed_softness, max_iterations)
    matched = match_surfaces(pair.source, pair.target, matches, softness)
    state = differentiable(loop, matched, pair.terms)
    return registration_of(state, assess_alignment(loop, fixed, fixed_softness), loop.history, source, target)
