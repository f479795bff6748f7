"""Directions in which a prior fixes the pose: T = P exp(ξ) with F ξ = 0, where the rows of F are `Prior.fixed`.

For free directions that form a group, such as x, y and yaw, these are the poses P H of that group. Otherwise the poses
depend on the parametrisation by one exponential: with yaw fixed, say, its component of log(P⁻¹ T) stays 0.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from mcgicp_jax._math.poses import adjoint_to_source, units
from mcgicp_jax._math.symmetric_matrices import inverse_6
from mcgicp_jax._pose_solver.pose_measurements import Prior


def constraints_at(
    pose: jaxlie.SE3, center: Float[Array, "3"], radius: Float[Array, ""], prior: Prior
) -> Float[Array, "6 6"]:
    """Derivative of F ξ by a twist about a centre, lengths in units of the radius."""
    slope = _pose_of(prior).inverse().multiply(pose).jlog().astype(center.dtype)
    return prior.fixed @ slope @ (adjoint_to_source(pose, center) * units(radius))


@jax.jit
def with_fixed_directions(pose: jaxlie.SE3, prior: Prior) -> jaxlie.SE3:
    """The pose with ξ projected onto F ξ = 0."""
    fixed = prior.fixed
    twist = _pose_of(prior).inverse().multiply(pose).log()
    gram = fixed @ fixed.T + jnp.diag(1.0 * ~jnp.any(fixed != 0, axis=1))
    twist = twist - fixed.T @ (inverse_6(gram) @ (fixed @ twist))
    moved = _pose_of(prior).multiply(jaxlie.SE3.exp(twist)).normalize()
    # jaxlie promotes to the default precision.
    return jaxlie.SE3(moved.wxyz_xyz.astype(pose.wxyz_xyz.dtype))


def _pose_of(prior: Prior) -> jaxlie.SE3:
    return jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.from_matrix(prior.rotation), prior.translation)
