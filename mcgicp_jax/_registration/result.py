"""The result of a registration: pose, status, quality of the fit and uncertainty."""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jaxlie
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from mcgicp_jax._clouds.origins import pose_in_user_frame
from mcgicp_jax._compute.cache import Held, Lazy
from mcgicp_jax._compute.concrete import AnyArray, canonical_float, is_concrete, numpy_for
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._math.poses import se3
from mcgicp_jax._pose_solver.degeneracy import Directions, UnconstrainedDirection, as_text, unconstrained_directions


class Status(enum.IntEnum):
    """Outcome of a registration. Only CONVERGED is success.

    Attributes:
        CONVERGED: the last update was below both tolerances, and every direction of motion is constrained.
        MAX_ITERATIONS: the updates were still above the tolerances after `max_iterations` updates.
        TOO_FEW_CORRESPONDENCES: fewer than four source points (in the coarse phase: of the subset) have a match within
            `max_distance`: the clouds do not overlap, or the initial pose is too far off. With `init="global"`, also if
            `global_pose` finds no pose, which is then NaN.
        DEGENERATE: the last update was below both tolerances, but at least one direction of motion is unconstrained
            (see `RegistrationResult.unconstrained_directions`). With `hold_unconstrained`, updates move the pose only
            along directions that are constrained when they are made: along others it remains the initial one. Tie
            points or a prior constrain a direction if its standard deviation is then below the radius of the clouds.
            Source points within a fifth of their median distance from the sensor, the origin of their frame, constrain
            nothing: they may be the sensor's own vehicle. The derivative of the pose is that within the constrained
            directions, and 0 along the others.
        NON_FINITE: the pose or the sums overflowed or became NaN.
        INVALID_INPUT: `register` would raise a `ValueError` for this pair. Only in batches; the pose is NaN.
        WORKER_FAILED: two workers in turn failed with this pair. Only in batches; the pose is NaN.
        UNVERIFIED: the pose is registered, but it may be wrong (outside of transformations a warning says why): less
            than 10 % of the source points have a match; less than 60 % lie on the target, and with a smaller
            `max_distance` the same start leads to another pose; the surfaces coincide about as well at that other pose;
            with the coarse `max_distance` the registration does not converge; with `init="global"`, `global_pose` had
            no success; the pose contradicts the `prior` or the `tie_points`, by more standard deviations than in one of
            a million right cases; or channels alone hold it along some direction, and are so simple a function of
            position that they may move with the sensor, or outside of transformations, differ at matched points as by
            another exposure.
    """

    CONVERGED = 0
    MAX_ITERATIONS = 1
    TOO_FEW_CORRESPONDENCES = 2
    DEGENERATE = 3
    NON_FINITE = 4
    INVALID_INPUT = 5
    WORKER_FAILED = 6
    UNVERIFIED = 7

    # Print the name: an IntEnum prints its number.
    __str__ = enum.Enum.__str__
    __format__ = enum.Enum.__format__

    @property
    def advice(self) -> str:
        """What has happened and what to try, in a few words; "" for CONVERGED."""
        return _ADVICE[self]


_ADVICE = {
    Status.CONVERGED: "",
    Status.MAX_ITERATIONS: "the pose was still changing after the last iteration; "
    "try a better initial pose, another max_distance, or a larger max_iterations",
    Status.TOO_FEW_CORRESPONDENCES: "fewer than four points have a match; "
    "are both clouds in metres? If so, they need an initial pose at which they overlap; a global search may find one",
    Status.DEGENERATE: "the pose is unconstrained in at least one direction; try clouds that show more of the scene, "
    "channels that vary along it (MC-GICP), or fix that direction if the initial pose is right in it",
    Status.NON_FINITE: "numerical overflow; are the coordinates in metres?",
    Status.INVALID_INPUT: "register raises an error for this pair; see its warning",
    Status.WORKER_FAILED: "two workers failed with this pair; try register, or smaller clouds",
    Status.UNVERIFIED: "the clouds may not show the same place, few points match, other poses fit as well, the prior "
    "or tie points contradict it, or channels hold it that may move with the sensor or have another exposure; look at "
    "the clouds at this pose, or try clouds that show more of the scene",
}


# For type checkers, those of one registration outside of transformations.
if TYPE_CHECKING:
    OneStatus: TypeAlias = Status
    OneBool: TypeAlias = bool
else:
    OneStatus = OneBool = Any


class Constraints(NamedTuple):
    """Values of `RegistrationResult.information` and `directions`."""

    information: Float[AnyArray, "*batch 6 6"]
    directions: Directions | None


class Uncertainty(NamedTuple):
    """Values of `RegistrationResult.covariance` and `deviations`."""

    covariance: Float[AnyArray, "*batch 6 6"]
    deviations: Float[AnyArray, "*batch 6"]


class RegistrationResult(eqx.Module):
    """Result of `register` or `estimate_pose`; a pytree. Read first: `status`, `matrix`, `deviations`, `overlap`.

    All fields are evaluated at the returned pose, with the matches of the last update. They are NumPy scalars and
    arrays; inside `jit`, `vmap` or `grad`, and when returned by these, JAX arrays. Only the pose carries a gradient;
    that of cost, rmse, covariance and deviations raises `NotImplementedError`, and is NaN in forward mode. For the
    gradient of a cost, call `mahalanobis_cost` at the pose.

    The result of a call outside of transformations keeps both clouds and their surfaces in memory for the deferred
    values and `jacobian`: 10 MB for two clouds of 20,000 points. `copy.deepcopy(result)`, like a pickle, holds the
    deferred values instead, and no clouds.

    Attributes:
        T_target_source: maps source coordinates into the target's frame, b ≈ T a; in the precision of the clouds. At
            large (UTM) coordinates use `matrix`, or in float32 under `jit`, `centred`.
        status_code: value of the `Status`.
        num_iterations: number of pose updates.
        num_inliers: number of source points used in the last phase with a match within its `max_distance`.
        cost: Σ ρ(dᵀ M d) over the matches.
        rmse: root mean square correspondence distance, metres. Usually of the order of the point spacing, because the
            two clouds sample different points of the surface. NaN without matches.
        overlap: fraction of the source points that have a match within the fine `max_distance`, 0 to 1. Where this
            distance spans the gaps between the points, as in voxels of one size, a value below the known overlap of
            the scans is a sign of a wrong local minimum. In raw LiDAR scans many points have no match.
        history: arrays with one entry before each update and one at the returned pose: "cost", "rmse", "num_inliers",
            and the size of the update computed there: "translation_step" (metres, at the centroid of the matches) and
            "rotation_step" (radians). In the coarse phase they cover the subsampled source. Inside a transformation
            the length is `max_iterations` + 1, and unused entries are NaN.
        source_origin, target_origin: (3,) `PointCloud.origin` of both clouds, metres.
        centred: the pose between coordinates relative to these origins.
        constraints, uncertainty: deferred values of `information` and `directions`, and of `covariance` and
            `deviations`, computed on first access.
        derivative: computes `jacobian`; empty in copies.
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
    constraints: Lazy[Constraints]
    uncertainty: Lazy[Uncertainty]
    derivative: Held[Callable[[str, str], np.ndarray]]

    @classmethod
    def build(cls, **fields: Any) -> RegistrationResult:
        """Construct from fields without equinox's constructor, which would compute the deferred ones."""
        result = object.__new__(cls)
        for name, value in fields.items():
            object.__setattr__(result, name, value)
        return result

    @classmethod
    def without_pose(cls, status: Status) -> RegistrationResult:
        """The result of a pair that could not be registered: pose, cost, rmse and covariance are NaN."""
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
            constraints=Lazy.of(Constraints(np.zeros((6, 6)), None)),
            uncertainty=unknown_uncertainty(),
            derivative=Held(),
        )

    @property
    def information(self) -> Float[AnyArray, "*batch 6 6"]:
        """(6, 6) Σ w Jᵀ M J, the Gauss-Newton Hessian of half the cost in ξ.

        ξ = (v, ω) is the twist of T exp(ξ), in the source's frame, metres and radians. The matrix has the scale of
        GICP's relative covariances: it compares directions with each other, but its inverse is *not* a covariance of
        the pose. The information of tie points and a prior is converted to this scale and added.
        """
        return self.constraints.value.information

    @property
    def directions(self) -> Directions | None:
        """Six directions of motion and how well each is constrained; None from `estimate_pose`."""
        return self.constraints.value.directions

    @property
    def covariance(self) -> Float[AnyArray, "*batch 6 6"]:
        """(6, 6) covariance of ξ, in the order and frame of `information`: a sandwich estimate from the scatter of the
        matches (Huber 1967; see `_pose_solver.covariance`).

        ξ rotates about the origin of the source's coordinates. If that is far from the points, as in UTM coordinates, a
        small rotation moves the points far and the first three variances are large: use `deviations` there.

        The estimate covers the noise and the sampling of the points, as checked on 504 simulated pairs: the squared
        error is 0.4 to 1.4 times what it says (GICP, MC-GICP), 0.7 to 1.5 times with `photometric`; for `NDT` and
        `D2DNDT`, on the average of many scenes, 0.8 to 1.2 times, but 1.7 times for the few cells of a wall
        (`python -m tests.benchmarks.calibration`). It scatters: turning both clouds changes variances by 10 to 30 %,
        some by 75 %. It does not cover a wrong local minimum, errors common to all points (calibration, motion during a
        scan), or moving objects. An unconstrained direction gets a standard deviation of 10 times the radius of the
        matched points, next to which float32 would round the others away: the matrix is float64, except inside
        transformations and from `DenseSearch` in batches. NaN for too few matches, a NON_FINITE status, or a degenerate
        alignment.
        """
        return self.uncertainty.value.covariance

    @property
    def deviations(self) -> Float[AnyArray, "*batch 6"]:
        """(6,) standard deviations in the target's axes: position of the centroid of the matches (m), rotation (rad).

        Derived from `covariance`, with the same limitations; unconstrained directions inflate all entries they touch.
        """
        return self.uncertainty.value.deviations

    def jacobian(
        self, cloud: Literal["source", "target"], field: Literal["points", "channels", "covariances"] = "points"
    ) -> Float[np.ndarray, "6 N ..."]:
        """Derivative of the pose by an array of a preprocessed cloud, as that of `register`; see `mcgicp_jax.guide`.

        Errors of the array with the covariance Σ cause the error J Σ Jᵀ of the pose.

        Args:
            cloud, field: names of the cloud and of its array, such as "source" and "points", whose shape is (N, 3).

        Returns:
            (6, *shape of the array): of ξ = (v, ω) in T exp(ξ), metres and radians, as in `covariance`, per unit of the
            array. 0 where the derivative of `register` is, and by channels that are 0 in all rows.

        Raises:
            ValueError: in copies, such as the results of batches and odometry, and inside transformations.
        """
        if self.derivative.value is None:
            raise ValueError(
                "jacobian: expected the result of register or estimate_pose itself, outside of transformations, got a "
                "copy or a traced result"
            )
        if cloud not in ("source", "target") or field not in ("points", "channels", "covariances"):
            raise ValueError(f'jacobian: expected an array such as ("source", "points"), got {(cloud, field)!r}')
        return self.derivative.value(cloud, field)

    @property
    def status(self) -> OneStatus:
        """The `Status`; inside a transformation or for a batch, the array `status_code`."""
        if is_concrete(self.status_code) and np.ndim(self.status_code) == 0:
            return Status(int(np.asarray(self.status_code)))
        code: Any = self.status_code
        return code

    @property
    def converged(self) -> OneBool:
        """Whether the status is CONVERGED; inside a transformation or for a batch, an array."""
        return self.status == Status.CONVERGED

    @property
    def matrix(self) -> Float[np.ndarray, "*batch 4 4"] | Float[Array, "*batch 4 4"]:
        """T_target_source as (4, 4); outside of transformations float64 NumPy, exact also at large coordinates."""
        return pose_in_user_frame(self.centred, self.source_origin, self.target_origin)

    @property
    def unconstrained_directions(self) -> tuple[UnconstrainedDirection, ...]:
        """Directions of motion that the shape of the clouds does not constrain, and whether channels or tie points do.

        Empty if geometry constrains all six directions, and for `estimate_pose`.

        Raises:
            ValueError: inside a transformation or for a batch; use `directions` there.
        """
        if not is_concrete(self.directions) or np.ndim(self.status_code):
            raise ValueError("unconstrained_directions: expected a single registration outside of jit; use directions")
        if self.directions is None or self.status in (Status.TOO_FEW_CORRESPONDENCES, Status.NON_FINITE):
            return ()
        return unconstrained_directions(self.directions)

    def __repr__(self) -> str:
        # Leaves may be no arrays, as after `jax.eval_shape` or `jax.tree.map`.
        if not isinstance(self.status_code, int | np.generic | np.ndarray | jax.Array):
            return f"RegistrationResult(status_code={self.status_code!r})"
        if not is_concrete(primal(self.centred), self.history) or np.ndim(self.status_code):
            return f"RegistrationResult(batch of shape {np.shape(self.status_code)})"
        matrix, origin = np.asarray(primal(self.matrix)), np.append(np.asarray(primal(self.source_origin)), 1)
        # At large coordinates, the translation column would be the motion of a far point.
        where = "of the source's origin " if np.any(origin[:3]) else ""
        translation = np.array2string((matrix @ origin - origin)[:3], precision=4, suppress_small=True)
        cosine = (np.trace(matrix[:3, :3]) - 1) / 2
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        free = as_text(self.unconstrained_directions)
        return (
            f"RegistrationResult({self.status.name}: translation {where}{translation} m, rotation {angle:.3f}°, "
            f"{self.num_iterations} iterations, {self.num_inliers} inliers ({self.overlap:.0%}), "
            f"rmse {np.asarray(primal(self.rmse)):.4g} m{'; unconstrained by geometry: ' if free else ''}{free})"
        )


# Smallest overlap of a verified pose. Pairs of scans that overlap by 10 to 30 % count as the hardest that can be
# registered (3DLoMatch, Huang et al. 2021).
LEAST_OVERLAP = 0.1
USABLE = (Status.CONVERGED, Status.DEGENERATE, Status.MAX_ITERATIONS)


def is_usable(result: RegistrationResult) -> bool:
    """Whether the pose may start another registration: it is finite and based on enough matches. An UNVERIFIED one may
    not: other registrations would inherit a wrong pose, and end as CONVERGED."""
    return result.status in USABLE


def unknown_uncertainty() -> Lazy[Uncertainty]:
    return Lazy.of(Uncertainty(np.full((6, 6), np.nan), np.full(6, np.nan)))


def computed(result: RegistrationResult) -> RegistrationResult:
    """The result with its deferred fields computed, so that it no longer references the clouds."""
    later = {name: Lazy.of(getattr(result, name).value) for name in ("constraints", "uncertainty")}
    return result.build(**vars(result) | later | {"derivative": Held()})


def verified(result: RegistrationResult, trusted: bool = True) -> RegistrationResult:
    """The result, UNVERIFIED instead of usable if few points match or the start is in doubt. Not part of
    `register_pair`, whose results odometry, loops and global poses compare at any overlap."""
    code: Any = result.status_code
    overlap: Any = result.overlap
    if isinstance(overlap, np.floating) and trusted and overlap >= LEAST_OVERLAP:
        return result
    xp = numpy_for(code, overlap)
    doubtful = xp.isin(code, np.array(USABLE)) & ~(trusted & (overlap >= LEAST_OVERLAP))
    return result.build(**vars(result) | {"status_code": xp.where(doubtful, np.int32(Status.UNVERIFIED), code)[()]})
