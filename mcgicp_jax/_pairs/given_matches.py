"""Cost of given matches, and the pose for them, for losses and custom loops."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from mcgicp_jax._clouds.origins import centred_pose
from mcgicp_jax._clouds.point_cloud import PointCloud, with_constants
from mcgicp_jax._compute import concrete
from mcgicp_jax._compute.concrete import AnyArray, constant, is_concrete, numpy_for
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.row_functions import Input, Rows, blockwise
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._local_geometry.local_geometry import searched
from mcgicp_jax._local_geometry.neighborhoods import of_rows
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.poses import Pose
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._methods.base import AbstractGeneralized, AbstractMethod, with_unset_from
from mcgicp_jax._methods.multichannel_gicp import MultiChannelGICP
from mcgicp_jax._methods.surfaces import differentiable_inputs, surface_pair
from mcgicp_jax._pose_solver.matched import Matches, Motion, adapted, linearize_at, matched_rows, sample_of_term
from mcgicp_jax._registration.input_checks import check_matches, warn_of_estimated_parameters
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.pose_derivative import Inputs, Run
from mcgicp_jax._registration.register_pair import problem_of, result_of, run_loop
from mcgicp_jax._registration.result import RegistrationResult
from mcgicp_jax._search.base import Correspondences
from mcgicp_jax._terms.base import AbstractAdaptiveTerm


@with_settings_of_package
@concrete.constants_computed
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
    Waslander 2014, eq. 3, which omits the inverse). M is (C^B)⁻¹ for `NDT` and `ColorNDT`, and I or n nᵀ for
    `PointToPoint`, `PointToPlane` and `ColorICP`.

    Differentiable with respect to all inputs but the matches, also inside `jit` and `vmap`. Outside of these, the cost
    and its gradient compile nothing for another size of clouds, and second derivatives raise `NotImplementedError`.
    Here M is a function of the rotation R, whereas `estimate_pose`, like every GICP, keeps M fixed during each update:
    its pose is not exactly the minimum of F. With `photometric=True`, the standard deviations of the residuals are
    estimated at the given pose, as constants to autodiff, so that values at different poses do not compare.

    Args:
        pose: T_target_source, `jaxlie.SE3` or (4, 4).
        source, target: preprocessed clouds.
        matches: from `find_correspondences`.
        method: defines M; parameters left None are estimated from the clouds, as constants to autodiff.
        robust: kernel ρ applied to the Mahalanobis distance of each match, as in `register`. None: that of the method,
            such as `Welsch` of `NDT`, or else ρ(s²) = s².
        temperature: metres. Weighs the candidates of each source point (`num_candidates`) by a softmax of
            −½ (distance / temperature)², with distances in position and α · channel; this gives α a gradient. As it
            tends to 0, only the nearest candidate counts. Required if there are several candidates, except for methods
            that sum over them (`D2DNDT`).
        log_determinant: add Σ log det (C^B + R C^A Rᵀ), which makes F (for squared distances) twice a Gaussian negative
            log-likelihood. Without it, a loss that learns covariances (or ε, or Λ) falls as these are inflated. For
            `GICP`, `D2DNDT`, and `MultiChannelGICP` without `photometric`.

    Returns:
        F, a scalar; in metres² for dimensionless covariances such as GICP's.

    Raises:
        ValueError: if `pose` is not a rigid motion, the shape of `matches` does not fit the source, `temperature` is
            missing or not positive, a cloud lacks the neighbours that the method needs, or `log_determinant` is set for
            another method.
    """
    check_matches(matches, source, target, method, temperature)
    source, target, matches = with_constants(source), with_constants(target), concrete.with_numpy_constants(matches)
    photometric = isinstance(method, MultiChannelGICP) and method.photometric
    if log_determinant and (photometric or not isinstance(method, AbstractGeneralized)):
        name = type(method).__name__ + "(photometric=True)" * photometric
        raise ValueError(f"log_determinant: expected a method that weighs distances by covariances, got {name}")
    warn_of_estimated_parameters(method, source, target, soft=temperature is not None)
    matrix, dtype = centred_pose(pose, source, target, "pose"), source.points.dtype
    motion = Motion(matrix[:3, :3].astype(dtype), matrix[:3, 3].astype(dtype))
    temperature = None if temperature is None else numpy_for(temperature).asarray(temperature, dtype)
    fixed = primal((source, target, method))
    constants = primal((motion, temperature, matches))
    indices = Matches.given(constants[2]).indices.T
    if is_concrete(fixed, constants):
        method = with_unset_from(method, fixed[2].resolve(*fixed[:2]))
        terms, soft = method.terms(fixed[0], fixed[1], robust, False), temperature is not None
        inputs = differentiable_inputs(source, target, method, terms, (*fixed[:2], primal(method)), indices, soft=soft)
    else:
        pair = surface_pair(method, source, target, observed=False, robust=robust).whole()
        terms, both = pair.terms, ((pair.source, None), (pair.target, indices))
        inputs = [Input(surface._replace(search=None), rows) for surface, rows in both]
        if temperature is not None:
            inputs += [Input(searched(surface), rows) for surface, rows in both]

    def sample(term: AbstractAdaptiveTerm, rows: Int[AnyArray, "n"]) -> Any:
        (values,) = blockwise(_sample, constant(primal((motion, term))), *of_rows(inputs, rows))
        return primal(values)

    numbers = motion, adapted(terms, fixed[0].valid, sample), temperature
    return blockwise(_likelihood if log_determinant else _cost, numbers, *inputs, total=True)


def _sample(numbers: tuple[Motion, AbstractAdaptiveTerm], *rows: Rows) -> tuple[Any]:
    motion, term = numbers
    return (sample_of_term(motion, matched_rows(rows), term),)


def _cost(numbers: Any, *rows: Rows) -> Float[Array, ""]:
    motion, terms, temperature = numbers
    _, linearization, _ = linearize_at(motion, matched_rows(rows, temperature), terms)
    return jnp.sum(linearization.cost)


def _likelihood(numbers: Any, *rows: Rows) -> Float[Array, ""]:
    motion, terms, temperature = numbers
    matched = matched_rows(rows, temperature)
    _, linearization, counts = linearize_at(motion, matched, terms)
    determinant = jnp.where(matched.valid, alg.determinant(linearization.information), 1)
    return jnp.sum(linearization.cost) - jnp.sum(counts * jnp.log(determinant))


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
    warn_of_estimated_parameters(method, source, target, soft=temperature is not None)
    source, target, matches = with_constants(source), with_constants(target), concrete.with_numpy_constants(matches)
    softness = None if temperature is None else numpy_for(temperature).asarray(temperature, source.points.dtype)
    inputs = Inputs(source, target, method, robust, temperature=softness)
    return result_of(inputs, _estimate, Matches.given(primal(matches)), primal(init), options)


def _estimate(inputs: Inputs, matches: Matches, init: Pose | None, options: Options, traced: bool = False) -> Run:
    problem, inputs = problem_of(inputs, init, options, 1, matches._replace(temperature=inputs.temperature))
    return run_loop(inputs, problem, None, options.max_iterations, traced)
