"""What a registration says: the pose, how it ended, and how good the fit is."""

from __future__ import annotations

import enum
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from mcgicp_jax._deferred import Deferred
from mcgicp_jax._directions import Directions, FreeDirection, describe, free_directions
from mcgicp_jax._pose import AnyArray, canonical_float, is_concrete, rotation_from_quaternion, se3


class Status(enum.IntEnum):
    """How a registration ended. Only CONVERGED is success.

    Attributes:
        CONVERGED: the last update moved the pose by less than both tolerances, and the pairs hold every direction.
        MAX_ITERATIONS: the pose was still moving when the iterations ran out.
        TOO_FEW_CORRESPONDENCES: fewer than four of the source points that were looked for have a match within
            `max_distance`: no overlap, or a start too far away.
        DEGENERATE: the pose came to rest, but nothing holds at least one direction: see
            `Registration.free_directions`. There it is where the start had it, unless `hold_free_directions` was off.
        NON_FINITE: the numbers overflowed or became NaN.
        INVALID_INPUT: the pair is one that `register` raises an error for; in a batch only. Its pose is NaN.
        LOST: the worker that had the pair died or failed, and another one too; in a batch only. Its pose is NaN.
    """

    CONVERGED = 0
    MAX_ITERATIONS = 1
    TOO_FEW_CORRESPONDENCES = 2
    DEGENERATE = 3
    NON_FINITE = 4
    INVALID_INPUT = 5
    LOST = 6

    # Printed by name, which an IntEnum is not.
    __str__ = enum.Enum.__str__
    __format__ = enum.Enum.__format__  # type: ignore[assignment]


class Registration(eqx.Module):
    """The outcome of `register` or `align`; a pytree. Everything in it belongs to the returned pose.

    After a host call the numbers are NumPy's; inside a transformation, and with a batch dimension, they are arrays.
    There the pose alone carries a gradient: to differentiate a cost, call `mahalanobis_cost` at the pose.

    Attributes:
        T_target_source: maps source coordinates into the target's frame, b ≈ T a. Its precision is that of the clouds;
            at large (UTM) coordinates use `matrix`, or inside a transformation in float32 `centred`.
        status_code: value of the `Status`.
        num_iterations: updates of the pose.
        num_inliers: pairs within `max_distance`.
        cost: Σ ρ(dᵀ M d) over them.
        rmse: root mean square distance of the pairs, metres; mostly the spacing of the points. NaN without pairs.
        overlap: share of the source points that have a match, 0 to 1; the others are rejected, as too far away. Little
            overlap, or a share below what is known of the scene, is the one sign that a wrong minimum gives of itself.
        history: before each update, and last at the returned pose: "cost", "rmse", "num_inliers", and the length of
            the update from there, "translation_step" (metres, at the centroid of the pairs) and "rotation_step"
            (radians). Of a large source, the first entries are of the points that find the pose (see `register`).
            Inside a transformation the length is fixed, and NaN fills what was not needed.
        source_origin, target_origin: what the clouds had taken off, `PointCloud.origin`.
        centred: the pose between those origins, which `matrix` is made from.
        constraints, uncertainty: `information` and `directions`, `covariance` and `deviations`, computed when they are
            first read.
    """

    T_target_source: jaxlie.SE3
    status_code: Int[ArrayLike, "*batch"]
    num_iterations: Int[ArrayLike, "*batch"]
    num_inliers: Int[ArrayLike, "*batch"]
    cost: Float[ArrayLike, "*batch"]
    rmse: Float[ArrayLike, "*batch"]
    overlap: Float[ArrayLike, "*batch"]
    history: dict[str, Any]
    source_origin: Float[Array, "*batch 3"] | Float[np.ndarray, "*batch 3"]
    target_origin: Float[Array, "*batch 3"] | Float[np.ndarray, "*batch 3"]
    centred: jaxlie.SE3
    constraints: Deferred[tuple[Any, Directions | None]]
    uncertainty: Deferred[tuple[Any, Any]]

    @classmethod
    def build(cls, **fields: Any) -> Registration:
        """A result of finished fields, past equinox's constructor, which would compute what is deferred."""
        result = object.__new__(cls)
        for name, value in fields.items():
            object.__setattr__(result, name, value)
        return result

    @classmethod
    def without_pose(cls, status: Status) -> Registration:
        """What stands for a pair that was not registered: every number that cannot be had is NaN."""
        nowhere = se3(np.full(7, np.nan, canonical_float()))
        nan = np.full((), np.nan)[()]
        return cls.build(
            T_target_source=nowhere,
            status_code=np.int32(status),
            num_iterations=np.int32(0),
            num_inliers=np.int32(0),
            cost=nan,
            rmse=nan,
            overlap=np.float64(0),
            history={},
            source_origin=np.zeros(3),
            target_origin=np.zeros(3),
            centred=nowhere,
            constraints=Deferred.of((np.zeros((6, 6)), None)),
            uncertainty=Deferred.of((np.full((6, 6), np.nan), np.full(6, np.nan))),
        )

    @property
    def information(self) -> Float[AnyArray, "*batch 6 6"]:
        """(6, 6) Σ Jᵀ M J for the twist ξ = (v, ω) of T exp(ξ), metres and radians, in the source's frame.

        It weighs directions against each other; its scale is that of GICP's relative covariances, so its inverse is
        *not* a covariance of the pose.
        """
        return self.constraints.value[0]

    @property
    def directions(self) -> Directions | None:
        """Six directions and what constrains each, see `free_directions`; None from `align`."""
        return self.constraints.value[1]

    @property
    def covariance(self) -> Float[AnyArray, "*batch 6 6"]:
        """(6, 6) of ξ, in the same order and frame as `information`, estimated from how the matches disagree (see
        `_uncertainty`).

        ξ turns about the origin of the source's coordinates. Where that is far from the points, as with UTM, a small
        rotation displaces them far, and the first three variances are large: `deviations` refer to the points.

        It covers the noise and the sampling of the points. It does not know of a wrong minimum, of errors that all
        points share (calibration, motion during a scan), or of things that moved. A direction that nothing constrains
        has a standard deviation of 10 times the radius of the matched points. NaN where there is no pose, or too few
        matches to tell.
        """
        return self.uncertainty.value[0]

    @property
    def deviations(self) -> Float[AnyArray, "*batch 6"]:
        """(6,) standard deviations along and about the target's axes: of the position of the centroid of the matched
        points, metres, and of the rotation, radians.

        From `covariance`, with what is said there.
        """
        return self.uncertainty.value[1]

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

    @property
    def free_directions(self) -> tuple[FreeDirection, ...]:
        """The directions in which the shape of the clouds lets the pose slide, and whether the channels hold it.

        Empty where geometry holds all six, and for `align`. For one registration outside of transformations; inside,
        and for a batch, use `directions`.
        """
        if not is_concrete(self.directions) or np.ndim(self.status_code):
            raise ValueError("free_directions: expected a single registration outside of jit; use directions")
        if self.directions is None or self.status in (Status.TOO_FEW_CORRESPONDENCES, Status.NON_FINITE):
            return ()
        return free_directions(self.directions)

    def __repr__(self) -> str:
        if not is_concrete(self.centred, self.history) or np.ndim(self.status_code):
            return f"Registration(batch of shape {np.shape(self.status_code)})"
        if np.any(self.source_origin):
            # Far from zero, the translation says little: it is the motion of a point that is nowhere near.
            origin = np.append(self.source_origin, 1)
            moved, where = (np.asarray(self.matrix) @ origin - origin)[:3], "of the source's origin "
        else:
            moved, where = np.asarray(self.matrix)[:3, 3], ""
        translation = np.array2string(moved, precision=4, suppress_small=True)
        cosine = (np.trace(np.asarray(self.matrix)[:3, :3]) - 1) / 2
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        free = describe(self.free_directions)
        return (
            f"Registration({self.status.name}: translation {where}{translation} m, rotation {angle:.3f}°, "
            f"{self.num_iterations} iterations, {self.num_inliers} inliers ({self.overlap:.0%}), "
            f"rmse {np.asarray(self.rmse):.4g} m{'; free by geometry: ' if free else ''}{free})"
        )


def is_usable(result: Registration) -> bool:
    """Whether the pose may start another registration: it comes from matches, and is finite.

    So it does with the status DEGENERATE, where free directions are as they were at the start, and MAX_ITERATIONS.
    """
    return result.status in (Status.CONVERGED, Status.DEGENERATE, Status.MAX_ITERATIONS)


def computed(result: Registration) -> Registration:
    """The result with everything computed: it holds nothing of its clouds any more."""
    return jax.tree.map(lambda leaf: leaf, result)


def pose_in_user_frame(
    centred: jaxlie.SE3, source_origin: Array | np.ndarray, target_origin: Array | np.ndarray
) -> Array | np.ndarray:
    """T(o_t) · T · T(−o_s)."""
    if is_concrete(centred, source_origin, target_origin):
        parameters = np.asarray(centred.wxyz_xyz, np.float64)
        rotation = rotation_from_quaternion(parameters[..., :4])
        # Origins that come out of `jit` are float32, exactly; what is made from them here must not be.
        start, end = np.asarray(source_origin, np.float64), np.asarray(target_origin, np.float64)
        offset = end - start - np.einsum("...ij,...j->...i", rotation - np.eye(3), start)
        matrix = np.zeros((*rotation.shape[:-2], 4, 4))
        matrix[..., :3, :3] = rotation
        matrix[..., :3, 3] = parameters[..., 4:] + offset
        matrix[..., 3, 3] = 1
        return matrix
    traced = centred.as_matrix().astype(centred.wxyz_xyz.dtype)
    turned = jnp.einsum("...ij,...j->...i", traced[..., :3, :3] - jnp.eye(3), source_origin, precision="highest")
    shift = target_origin - source_origin - turned
    return traced.at[..., :3, 3].add(shift.astype(traced.dtype))
