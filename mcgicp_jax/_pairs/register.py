"""`register`: one pair of clouds, from a given initial pose or from any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, Never, TypeAlias, cast

import numpy as np
from jax.typing import ArrayLike

from mcgicp_jax._clouds.point_cloud import PointCloud, Values, as_cloud
from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.messages import warn
from mcgicp_jax._global_pose.global_pose import MIN_INLIERS, GlobalPoseResult, global_pose
from mcgicp_jax._math.poses import Pose
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._registration.input_checks import warn_of_estimated_parameters, warn_of_lengths
from mcgicp_jax._registration.options import Distance, Options, check_method, options_of
from mcgicp_jax._registration.register_pair import register_pair
from mcgicp_jax._registration.result import LEAST_OVERLAP, USABLE, RegistrationResult, Status, verified
from mcgicp_jax._registration.tie_points_and_prior import GivenPrior, GivenTiePoints
from mcgicp_jax._search.base import AbstractSearch

# Misspelt options, for a message that names those that exist; type checkers refuse them.
if TYPE_CHECKING:
    Unknown: TypeAlias = Never
else:
    Unknown = Any


def register(
    source: PointCloud | Values,
    target: PointCloud | Values,
    method: AbstractMethod,
    *,
    init: Pose | Literal["global"] | None = None,
    max_distance: Distance | None = None,
    max_iterations: int = Options.max_iterations,
    translation_tolerance: ArrayLike | None = None,
    rotation_tolerance: ArrayLike = Options.rotation_tolerance,
    robust: AbstractKernel | None = None,
    search: AbstractSearch | None = None,
    hold_unconstrained: ArrayLike = True,
    equalize_channels: bool = False,
    voxel_sizes: Sequence[float] = (),
    max_source_points: int | None = Options.max_source_points,
    soft_matches: bool | None = Options.soft_matches,
    tie_points: GivenTiePoints | None = None,
    prior: GivenPrior | None = None,
    **unknown: Unknown,
) -> RegistrationResult:
    """Register two clouds: find matches at the current pose, update the pose, and repeat until it converges.

    A coarse phase, with the larger `max_distance` and an even subset of large clouds, is followed by a fine phase with
    all points and the smaller one. Outside `jit` and `vmap`, a pose that may have left a right `init` is compared with
    that of a second registration. Works under `jit`, `vmap`, `grad` and `jvp`. `help(mcgicp_jax.guide)` explains the
    phases, this comparison, the derivative of the pose, tie points and priors.

    Args:
        source, target: clouds from `preprocess`. Raw clouds and (N, 3) arrays, metres, are preprocessed with the
            defaults of `preprocess` and one voxel size for both, or that of the other cloud; not inside `jit`.
        method: `MultiChannelGICP()`, `GICP()`, `PointToPlane()`, `PointToPoint()`, `ColorICP(...)`; for clouds of
            `voxel_gaussians` or with `voxel_sizes`, `NDT()`, `ColorNDT(...)`, `D2DNDT()`. Parameters left None are
            estimated.
        init: initial T_target_source, `jaxlie.SE3` or (4, 4); None: the pose of the `prior`, or the identity. "global":
            the pose found by `global_pose`, not inside `jit`. If it does not succeed, the status is UNVERIFIED, or if
            it finds no pose at all, TOO_FEW_CORRESPONDENCES, and the pose NaN.
        max_distance: maximum correspondence distance, metres of position; matches beyond it are rejected. Two numbers,
            for the coarse and for the fine phase, or one for both: if it is large, points without a partner pull the
            pose. None: 10 and 2.5 times the spacing of the target (its median nearest-neighbour distance, or the edge
            of its cells); the first is also at least 10 times the spacing of a square grid of the target's density, as
            the lines of LiDAR scans are far apart. From a global pose that succeeds, the default of the first is at
            most a voxel of `global_pose`, and with a prior, at most three of its standard deviations plus the distance
            from its pose to `init`. Pass a larger first one if `init` is further off.
        max_iterations: maximum number of pose updates in both phases together.
        translation_tolerance, rotation_tolerance: metres (at the centroid of the matches) and radians; the loop has
            converged when an update is below both. `translation_tolerance` None: 0.5 % of the spacing of the target.
            In float32, updates below some 1e-7 are rounding: smaller tolerances need float64.
        robust: kernel applied to the Mahalanobis distance of each match: `Huber`, `Cauchy`, `GemanMcClure`, `Tukey` or
            `Welsch`. None: the kernel of the method (NDT: `Welsch`), if it has any. In the coarse phase the scale of a
            given one is multiplied by the ratio of the two `max_distance`. With `photometric=True` the kernel is
            applied to each residual in standard deviations, in the fine phase.
        search: nearest-neighbour search; by default `KDTreeSearch`, and inside `jit` or `vmap` on accelerators
            `DenseSearch`.
        hold_unconstrained: if True, the pose is not updated along directions that neither the shape of the clouds nor
            the channels (if the method uses them) constrain. If False, arbitrary nearest-neighbour matches determine
            it there. The status is DEGENERATE in either case.
        equalize_channels: scale and shift each channel of the source to the distribution of the target's, for scans
            with different exposure or gain. A first registration uses the distributions of all points, and a second
            one from its pose those of matched points. With `MultiChannelGICP(photometric=True)`, gains and offsets are
            estimated from interpolated channels, together with the pose, in place of the second one.
        voxel_sizes: voxel sizes in metres, coarse to fine, for multi-scale registration; not inside `jit`.
            Each scale starts from the pose of the previous one with the default `max_distance`; a given one applies to
            the final registration, at full resolution. For NDT these are cell sizes: the last one gives the result, and
            at the others `GICP` registers voxels of a quarter of the size. Raw clouds have more points per cell than
            preprocessed ones.
        max_source_points: match at most so many points of the source, at least 4, in every phase. The rows are cut into
            that many runs, and one random row of each is used, with a fixed seed. After voxel averaging these rows
            cover space evenly; otherwise they follow the density of the points. Neighbours are among all points, and
            all of the target is used, but covariances, estimated parameters, `num_inliers`, `overlap` and the
            covariance of the pose are of these rows alone, and its derivative is by them and their neighbours. None:
            all points. 10,000 nearly give the pose of all.
        soft_matches: whether the derivative of the pose, which is the same, is that of soft matches. With False matches
            are constants, so that derivatives by channels are far too small. None: True for methods and clouds with
            channels, but not with `photometric=True`.
        tie_points: (source_points, target_points, covariances), metres: points (n, 3) known to be the same, such as
            surveyed targets or image features (Huhle & Jenke 2008), and the covariances (n, 3, 3) of b − T a, in the
            target's axes. n may be 1 or 2. They do not replace a good initial pose.
        prior: (pose, covariance): a measurement of T_target_source, as by GNSS or an IMU, `jaxlie.SE3` or (4, 4), and
            its covariance (6, 6), metres and radians, of (v, ω) at the origin and in the axes of the source, as
            `RegistrationResult.covariance`. A variance of 0 fixes a direction: with zeros for z, roll and pitch the
            motion is planar.

    Returns:
        The pose with its status, quality of the fit and uncertainty; check `converged`.

    Raises:
        ValueError: if an argument is malformed, for instance in shape or dtype, channels that are used differ in number
            or name, a cloud has fewer than four finite points, or `init` is not a rigid motion; or for
            `hold_unconstrained=False` with tie points or a prior. The message names the argument. Failures to register
            well-formed clouds show in `RegistrationResult.status`.

    Warns:
        UserWarning: if points with NaN or infinity are left out; `MultiChannelGICP` gets clouds without channels; the
            values of a channel differ so much between the clouds that its units probably differ; the channels of
            matched points differ, probably because of another exposure, or channels seem to move with the sensor and
            are left out (a pose that such channels alone hold is UNVERIFIED); extent and spacing of the clouds
            differ so much that their units of length probably differ; or `GICP` gets one cloud with covariances that
            are not dimensionless. Outside of `jit`: if the pose is UNVERIFIED, or `global_pose` finds none, why; if
            channels or `channel_weights` are differentiated with `soft_matches=False`; or if channels are
            differentiated while Λ or α of the method is estimated from them.
    """
    check_method(method)
    arguments = {
        "max_distance": max_distance,
        "max_iterations": max_iterations,
        "translation_tolerance": translation_tolerance,
        "rotation_tolerance": rotation_tolerance,
        "robust": robust,
        "search": search,
        "hold_unconstrained": hold_unconstrained,
        "equalize_channels": equalize_channels,
        "voxel_sizes": voxel_sizes,
        "max_source_points": max_source_points,
        "soft_matches": soft_matches,
    }
    options = options_of(register, arguments | unknown)
    if not (tie_points is None and prior is None) and not hold_unconstrained:
        raise ValueError("hold_unconstrained: expected True with tie_points or a prior (--fix), got False")
    source, target = as_cloud("source", source), as_cloud("target", target)
    warn_of_lengths(source, target)
    warn_of_estimated_parameters(method, source, target, soft_matches is not False, equalize_channels)
    trusted, pose = True, cast(Any, init)
    if isinstance(init, str):
        start, distance = start_from_anywhere(init, primal(source), primal(target), options)
        pose, trusted = start.matrix, start.success
        if not trusted:
            warn(doubt_of_global_pose(start))
        if not start.num_inliers:
            return RegistrationResult.without_pose(Status.TOO_FEW_CORRESPONDENCES)
        options = replace(options, max_coarse_distance=distance)
    result = verified(register_pair(source, target, method, pose, options, tie_points, prior), trusted)
    doubt = doubt_of(result)
    if doubt:
        advice = ', such as init="global"' if init is None else ""
        warn(f"{doubt}; pass a better init{advice}")
    return result


def doubt_of_global_pose(start: GlobalPoseResult) -> str:
    if start.success:
        return ""
    if start.ambiguous:
        return "global pose: another pose is about as likely, so that it is UNVERIFIED"
    count = f"{start.num_inliers} of {start.num_matches} matches of features"
    if not start.num_inliers:
        return f"global pose: none found, {count} support one; pass a pose as init"
    evidence = f"{count}, and a support of {start.support:.2g}; {MIN_INLIERS} and 1 are needed"
    return f"global pose: too little evidence ({evidence}), so that it is UNVERIFIED"


def doubt_of(result: RegistrationResult) -> str | None:
    """Why a pose is probably wrong; None if it is no result of matches, or they do not speak against it."""
    if not is_concrete(result.overlap, result.status_code):
        return None
    overlap = float(np.asarray(result.overlap))
    if overlap >= LEAST_OVERLAP or result.status not in (*USABLE, Status.UNVERIFIED):
        return None
    return f"only {100 * overlap:.2g} % of the source points have a match, so the pose is probably wrong"


def start_from_anywhere(
    init: str, source: PointCloud | Values, target: PointCloud | Values, options: Options
) -> tuple[GlobalPoseResult, float]:
    """The result of `global_pose`, without inliers if it found no pose, and the largest coarse `max_distance` from its
    pose, metres; `init` must be "global"."""
    if init != "global":
        raise ValueError(f'init: expected a pose, "global" or None, got {init!r}')
    if not is_concrete(source, target):
        raise ValueError('init: expected a pose inside transformations, got "global"')
    start = global_pose(source, target)
    return start, start.voxel_size if start.success and options.max_distance is None else np.inf
