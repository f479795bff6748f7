"""What a registration says: the pose, how it ended, and how good the fit is."""

from __future__ import annotations

import enum
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from mcgicp_jax._pose import is_concrete, rotation_from_quaternion


class Status(enum.IntEnum):
    """How a registration ended. Only CONVERGED is success."""

    CONVERGED = 0
    """The last update moved the pose by less than both tolerances, and the pairs hold every direction."""
    MAX_ITERATIONS = 1
    """The pose was still moving when the iterations ran out."""
    TOO_FEW_CORRESPONDENCES = 2
    """Fewer than four source points have a match within `max_distance`: no overlap, or a start too far away."""
    DEGENERATE = 3
    """The pose came to rest, but the pairs leave at least one direction free; it is where the start had it."""
    NON_FINITE = 4
    """The numbers overflowed or became NaN."""
    INVALID_INPUT = 5
    """The pair is one that `register` raises an error for; in a batch only. Its pose is NaN."""
    LOST = 6
    """The worker that had the pair died or failed, and another one too; in a batch only. Its pose is NaN."""


class Registration(eqx.Module):
    """The outcome of `register` or `align`; a pytree. Everything in it belongs to the returned pose.

    After a host call the numbers are NumPy's; inside a transformation, and with a batch dimension, they are arrays.
    There, and from `align`, the pose alone is refined further, by about a tolerance at most, and it alone carries a
    gradient: to differentiate a cost, call `mahalanobis_cost` at the pose.

    Attributes:
        T_target_source: maps source coordinates into the target's frame, b ≈ T a. Its precision is that of the clouds;
            at large (UTM) coordinates use `matrix`, or inside a transformation in float32 `centred`.
        status_code: value of the `Status`.
        num_iterations: updates of the pose.
        num_inliers: pairs within `max_distance`.
        cost: Σ ρ(dᵀ M d) over them.
        rmse: root mean square distance of the pairs, metres; mostly the spacing of the points. NaN without pairs.
        information: (6, 6) Σ Jᵀ M J for the twist ξ = (v, ω) of T exp(ξ), metres and radians, in the source's frame.
            It weighs directions against each other; its scale is that of GICP's relative covariances, so its inverse
            is *not* a covariance of the pose.
        history: before each update, and last at the returned pose: "cost", "rmse", "num_inliers", and the length of
            the update from there, "translation_step" (metres, at the centroid of the pairs) and "rotation_step"
            (radians). Inside a transformation the length is fixed, and NaN fills what was not needed.
        source_origin, target_origin: what the clouds had taken off, `PointCloud.origin`.
        centred: the pose between those origins, which `matrix` is made from.
    """

    T_target_source: jaxlie.SE3
    status_code: Int[ArrayLike, "*batch"]
    num_iterations: Int[ArrayLike, "*batch"]
    num_inliers: Int[ArrayLike, "*batch"]
    cost: Float[ArrayLike, "*batch"]
    rmse: Float[ArrayLike, "*batch"]
    information: Float[Array, "*batch 6 6"] | Float[np.ndarray, "*batch 6 6"]
    history: dict[str, Any]
    source_origin: Float[Array, "*batch 3"] | Float[np.ndarray, "*batch 3"]
    target_origin: Float[Array, "*batch 3"] | Float[np.ndarray, "*batch 3"]
    centred: jaxlie.SE3

    @classmethod
    def without_pose(cls, status: Status) -> Registration:
        """What stands for a pair that was not registered: every number that cannot be had is NaN."""
        nowhere = jaxlie.SE3(jnp.full(7, jnp.nan))
        nan = np.full((), np.nan)[()]
        return cls(
            T_target_source=nowhere,
            status_code=np.int32(status),
            num_iterations=np.int32(0),
            num_inliers=np.int32(0),
            cost=nan,
            rmse=nan,
            information=np.zeros((6, 6)),
            history={},
            source_origin=np.zeros(3),
            target_origin=np.zeros(3),
            centred=nowhere,
        )

    @property
    def status(self) -> Any:
        """The `Status`; an array of its values inside a transformation or for a batch."""
        if is_concrete(self.status_code) and np.ndim(self.status_code) == 0:
            return Status(int(np.asarray(self.status_code)))
        return self.status_code

    @property
    def converged(self) -> Any:
        """Whether the status is CONVERGED."""
        return self.status == Status.CONVERGED

    @property
    def matrix(self) -> Float[np.ndarray, "*batch 4 4"] | Float[Array, "*batch 4 4"]:
        """T_target_source as (4, 4); float64 NumPy outside a transformation, with all digits at large coordinates."""
        return pose_in_user_frame(self.centred, self.source_origin, self.target_origin)

    def __repr__(self) -> str:
        if not is_concrete(self) or np.ndim(self.status_code):
            return f"Registration(batch of shape {np.shape(self.status_code)})"
        translation = np.array2string(np.asarray(self.matrix)[:3, 3], precision=4, suppress_small=True)
        angle = np.degrees(float(jnp.linalg.norm(self.centred.rotation().log())))
        return (
            f"Registration({self.status.name}: translation {translation} m, rotation {angle:.3f}°, "
            f"{self.num_iterations} iterations, {self.num_inliers} inliers, rmse {np.asarray(self.rmse):.4g} m)"
        )


def pose_in_user_frame(
    centred: jaxlie.SE3, source_origin: Array | np.ndarray, target_origin: Array | np.ndarray
) -> Array | np.ndarray:
    """T(o_t) · T · T(−o_s)."""
    if is_concrete(centred, source_origin, target_origin):
        parameters = np.asarray(centred.wxyz_xyz, np.float64)
        rotation = rotation_from_quaternion(parameters[..., :4])
        offset = target_origin - source_origin - np.einsum("...ij,...j->...i", rotation - np.eye(3), source_origin)
        matrix = np.zeros((*rotation.shape[:-2], 4, 4))
        matrix[..., :3, :3] = rotation
        matrix[..., :3, 3] = parameters[..., 4:] + offset
        matrix[..., 3, 3] = 1
        return matrix
    traced = centred.as_matrix().astype(centred.wxyz_xyz.dtype)
    turned = jnp.einsum("...ij,...j->...i", traced[..., :3, :3] - jnp.eye(3), source_origin, precision="highest")
    shift = target_origin - source_origin - turned
    return traced.at[..., :3, 3].add(shift.astype(traced.dtype))
