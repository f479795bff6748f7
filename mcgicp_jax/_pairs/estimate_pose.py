"""The pose for given matches, for losses and custom loops."""

from __future__ import annotations

import numpy as np
from jax.typing import ArrayLike

from mcgicp_jax._clouds.point_cloud import PointCloud, with_constants
from mcgicp_jax._compute.concrete import numpy_for, with_numpy_constants
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._math.poses import Pose
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pose_solver.matched import Matches
from mcgicp_jax._registration.input_checks import check_clouds, check_matches, warn_of_estimated_parameters
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.pose_derivative import Inputs
from mcgicp_jax._registration.register_pair import Run, problem_of, result_of, run_loop
from mcgicp_jax._registration.result import RegistrationResult
from mcgicp_jax._search.base import Correspondences


@with_settings_of_package
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
    """Compute the pose for fixed matches: update the pose, recompute M, and repeat until the pose converges.

    Works under `jit`, `vmap`, `grad` and `jvp`. The first derivative follows from the implicit function theorem for the
    root of Σ w JᵀM d = 0 near the returned pose (d = b − T a, J = ∂(T a)/∂ξ, robust weight w). Matches, neighbours and
    estimated parameters are constants. The derivative is exact with respect to points, channels, given covariances,
    given parameters of the method (α: only with `temperature`) and the robust scale; with `photometric=True`, by points
    and channels it is approximate. It is zero with respect to `init`, because the root does not depend on it. If
    `information` is singular (DEGENERATE), it is zero along the directions that the matches leave free, and exact
    within the others. It is zero, never NaN, if there are too few matches or if Newton's method does not converge from
    the returned pose. Second derivatives raise `NotImplementedError`.

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
        max_source_points=None,
    )
    check_matches(matches, source, target, method, temperature)
    check_clouds(source, target, method)
    warn_of_estimated_parameters(method, source, target, soft=temperature is not None)
    source, target, matches = with_constants(source), with_constants(target), with_numpy_constants(matches)
    softness = None if temperature is None else numpy_for(temperature).asarray(temperature, source.points.dtype)
    inputs = Inputs(source, target, method, robust, temperature=softness)
    return result_of(inputs, _estimate, Matches.given(primal(matches)), primal(init), options)


def _estimate(inputs: Inputs, matches: Matches, init: Pose | None, options: Options, traced: bool = False) -> Run:
    problem, inputs = problem_of(inputs, init, options, 1, matches._replace(temperature=inputs.temperature))
    return run_loop(inputs, problem, None, options.max_iterations, traced)
