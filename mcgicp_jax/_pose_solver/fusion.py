"""Registration with tie points and a prior: weights from a first registration, pose update, covariance."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from mcgicp_jax._math.poses import adjoint_to_source, translation_adjoint, units
from mcgicp_jax._pose_solver.covariance import UNKNOWN, Moments, response_and_scatter
from mcgicp_jax._pose_solver.degeneracy import Directions
from mcgicp_jax._pose_solver.matched import Motion
from mcgicp_jax._pose_solver.pose_measurements import Fusion, PoseForm, PoseMeasurements
from mcgicp_jax._pose_solver.sums import Sums
from mcgicp_jax._pose_solver.update import Update, rounding, twist_form, wrench

# In a first registration, the standard deviations of tie points and prior count ten times, and they are at most a
# thousand times as stiff as the matches. Planar scans whose prior knows roll, pitch and height to 1e-5 then converge
# from where they do with fixed directions; a prior as precise as the matches moves the pose by 1e-13 of the difference.
_FIRST_WEIGHT, _FIRST_STIFFNESS = 0.01, 1e3


def constrained_by_pose_form(directions: Directions, information: Float[Array, "6 6"]) -> Directions:
    """Add how well tie points and prior constrain the directions that the matches do not, which are rotated to
    diagonalise the information (for twists about the centroid with lengths in units of the radius)."""
    basis, fixed = jnp.asarray(directions.twists).T, jnp.asarray(directions.fixed)
    free = ~(jnp.asarray(directions.constrained_by_matches) | fixed)
    information = basis.T @ information @ basis
    stiffness = jnp.where(jnp.outer(free, free), information, 0)
    scale = jnp.where(jnp.trace(stiffness) > 0, jnp.trace(stiffness), 1)
    # −1 and −2 sort the other directions first.
    values, turn = jnp.linalg.eigh(stiffness / scale + jnp.diag(-1.0 * ~free - fixed))
    squares = turn.T**2
    # What is no more than the rounding of the most precise directions constrains nothing.
    ties = jnp.where(values * scale > rounding(jnp.diagonal(information)), values * scale, 0)
    return replace(
        directions,
        twists=(basis @ turn).T,
        geometry=squares @ directions.geometry,
        channels=squares @ directions.channels,
        ties=jnp.where(values < -1.5, jnp.inf, ties),
    )


@jax.jit
def fuse(
    pose: jaxlie.SE3, center: Float[Array, "3"], directions: Directions, moments: Moments, form: PoseForm
) -> Fusion:
    """Equation of the pose from the end of a first registration; `form` refers to pose and center."""
    radius, motion = jnp.asarray(directions.radius), Motion.of(pose.wxyz_xyz)
    measurements = PoseMeasurements(*motion, center, radius, form)
    directions = constrained_by_pose_form(directions, measurements.force_and_stiffness(motion)[1])
    basis, by_matches = jnp.asarray(directions.twists).T, jnp.asarray(directions.constrained_by_matches)
    both, others = jnp.outer(by_matches, by_matches), jnp.diag(1.0 * ~by_matches)
    response, scatter = response_and_scatter(moments, radius)
    # Equal clouds: no residual is more precise than the rounding of float32.
    scatter = scatter + jnp.finfo(jnp.float32).eps ** 2 * radius * response
    response, scatter = (jnp.where(both, basis.T @ matrix @ basis, others) for matrix in (response, scatter))
    # One LAPACK call after the other: two batched ones at once can deadlock.
    gain = jnp.where(both, response @ jnp.linalg.inv(scatter), 0)
    information = jnp.where(both, gain @ response, 0)
    information = 0.5 * (information + information.T)
    fixed = None
    if form.prior.fixed is not None:
        basis, fixed = measurements.prior_residual(motion)[1].T @ basis, directions.fixed
    return Fusion(*motion, center, radius, form, basis, gain, information, directions.constrained, fixed)


def first_force(
    pose: jaxlie.SE3, sums: Sums, directions: Directions, measurements: PoseMeasurements
) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """Force and stiffness by which tie points and prior act in a first registration, for `solve_update`.

    They keep the pose in the basin of convergence that they know. The mean cost of a match stands for the variance of a
    residual. Let λ be the ratio of their stiffness to that of the matches along a twist: they act with a stiffness of
    `_FIRST_STIFFNESS` (λ / (1 + λ))⁸ times that of the matches, along the directions that these constrain. So the pose
    at which the weights of a `Fusion` are estimated depends on those alone that are far more precise than the matches.
    """
    force, stiffness = measurements.force_and_stiffness(Motion.of(pose.wxyz_xyz))
    # Twists about the centre of the measurements, from those about the centre of the sums.
    adjoint = translation_adjoint(sums.center - measurements.center).astype(sums.center.dtype)
    back = adjoint * units(sums.radius) / units(measurements.radius)[:, None]
    basis, constrained = jnp.asarray(directions.twists).T, jnp.asarray(directions.constrained_by_matches)
    along, weight = back @ basis, _FIRST_WEIGHT * sums.cost / jnp.maximum(sums.count, 1) / sums.radius**2
    both = jnp.outer(constrained, constrained)
    # One LAPACK call after the other: two batched ones at once can deadlock.
    inverse, stiffness = jax.lax.optimization_barrier((jnp.linalg.inv(basis), stiffness))
    stiffness = jnp.where(both, weight * along.T @ stiffness @ along, 0)
    force = jnp.where(constrained, weight * along.T @ force, 0)
    matches = jnp.where(both, basis.T @ twist_form(sums.stiffness, sums.radius) @ basis, jnp.diag(1.0 * ~constrained))
    share = jnp.linalg.solve(matches + stiffness, stiffness).T
    rest = _FIRST_STIFFNESS * (jnp.eye(6, dtype=share.dtype) - share)
    filtered = inverse.T @ jnp.linalg.matrix_power(share, 7) @ rest
    return filtered @ force, filtered @ stiffness @ inverse


def fused_update(pose: jaxlie.SE3, sums: Sums, directions: Directions, fusion: Fusion) -> tuple[Directions, Update]:
    """One Newton step on P s + γ = 0, with the matches and M fixed; and the directions with tie points and prior."""
    radius, motion = fusion.radius, Motion.of(pose.wxyz_xyz)
    pose_force, pose_stiffness = fusion.force_and_stiffness(motion)
    # To twists about the centre of the sums, and back.
    offset, lengths, lengths_at_sums = sums.center - fusion.center, units(radius), units(sums.radius)
    outwards = translation_adjoint(-offset).astype(offset.dtype) * lengths / lengths_at_sums[:, None]
    back = translation_adjoint(offset).astype(offset.dtype) * lengths_at_sums / lengths[:, None]
    centred_stiffness = back.T @ pose_stiffness @ back
    directions = constrained_by_pose_form(directions, centred_stiffness)
    unit_information = twist_form(sums.stiffness, sums.radius)
    # Force and energy of twists in units of the radius: of `fusion` on the left, of the sums on the right.
    ratio = sums.radius / radius
    score = outwards.T @ wrench(sums.force, sums.radius) * ratio
    stiffness = outwards.T @ (unit_information * sums.radius**2) @ outwards / radius
    # The solution waits for the eigenvectors of the directions: two batched LAPACK calls at once can deadlock.
    rotation, _ = jax.lax.optimization_barrier((motion.rotation, directions.twists))
    basis = fusion.twists_at(motion._replace(rotation=rotation))
    free = fusion.constrained if fusion.fixed is None else fusion.constrained & ~fusion.fixed
    slope = fusion.gain @ basis.T @ stiffness @ basis + basis.T @ pose_stiffness @ basis
    force = fusion.gain @ (basis.T @ score) + basis.T @ pose_force
    slope = jnp.where(jnp.outer(free, free), slope, jnp.diag(1.0 * ~free))
    twist = outwards @ (basis @ jnp.linalg.solve(slope, jnp.where(free, force, 0)))
    # The information of tie points and prior in the unit of the matches: divided by the mean of P.
    count = jnp.sum(fusion.information.diagonal() > 0)
    mean = jnp.trace(fusion.gain) / jnp.maximum(count, 1)
    unit = radius / jnp.where(mean > 0, mean, 1) / sums.radius**2
    information = unit_information + unit * centred_stiffness
    return directions, Update(twist * lengths_at_sums, information, ~jnp.all(fusion.constrained))


@jax.jit
def fused_covariance(pose: jaxlie.SE3, fusion: Fusion) -> Float[Array, "6 6"]:
    """Covariance of the pose, for ξ in T exp(ξ), metres and radians."""
    motion = Motion.of(pose.wxyz_xyz)
    _, stiffness = fusion.force_and_stiffness(motion)
    basis = fusion.twists_at(motion)
    total = fusion.information + basis.T @ stiffness @ basis + jnp.diag(~fusion.constrained / UNKNOWN**2)
    change = adjoint_to_source(pose, fusion.center) * units(fusion.radius) @ basis
    if fusion.fixed is not None:
        total = jnp.where(jnp.outer(~fusion.fixed, ~fusion.fixed), total, jnp.diag(1.0 * fusion.fixed))
        change = change * ~fusion.fixed
    covariance = change @ jnp.linalg.inv(total) @ change.T
    return 0.5 * (covariance + covariance.T)
