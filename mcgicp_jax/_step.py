"""One step of the loop of registration: from the sums at a pose to the next pose, or to an outcome."""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._deferred import Deferred
from mcgicp_jax._directions import Directions, directions_at_source, find_directions
from mcgicp_jax._kernels import AbstractKernel
from mcgicp_jax._methods import AbstractMethod
from mcgicp_jax._pose import AnyArray, AnyScalar
from mcgicp_jax._result import Status
from mcgicp_jax._solve import adjoint_to_center, move_pose, solve_update, units
from mcgicp_jax._sums import Sums
from mcgicp_jax._surface import Surface
from mcgicp_jax._uncertainty import sandwich

# The pose still moves: in the coarse phase with far matches too, and with every n-th source point; then, nearly
# converged, with the near matches of all. Or its last update was below the tolerances, and one measurement more ends
# the loop.
COARSE, RUNNING, SETTLED = -3, -1, -2
# An update below so many tolerances, that moves the points by less than this fraction of the narrow gate, ends the
# coarse phase, whose pose will not be the last.
_NEARLY_CONVERGED, _FRACTION_OF_GATE = 10.0, 0.25
# Three points hold a pose; with a fourth their distances can disagree.
_MIN_CORRESPONDENCES = 4
RECORDED = ("cost", "rmse", "num_inliers", "translation_step", "rotation_step")


class Settings(eqx.Module):
    """Numbers of the loop, as arrays: changing one compiles nothing.

    Attributes:
        max_distance: metres; matches further apart do not count.
        fine_distance: metres; the same after the coarse phase.
        coarse_stride: every so many-th source point takes part in the coarse phase: some thousands find a pose nearly
            as well as all.
        translation_tolerance, rotation_tolerance: metres and radians, of the update that is the last.
        max_iterations: in both phases together.
        hold_free_directions: whether the pose stays as it is along directions that nothing constrains.
    """

    max_distance: Float[AnyArray, "*batch"]
    fine_distance: Float[AnyArray, "*batch"]
    coarse_stride: Int[AnyArray, "*batch"]
    translation_tolerance: Float[AnyArray, "*batch"]
    rotation_tolerance: Float[AnyArray, "*batch"]
    max_iterations: Int[AnyArray, "*batch"]
    hold_free_directions: Bool[AnyArray, "*batch"]

    def gate(self, status: Int[AnyScalar, ""]) -> Float[AnyScalar, ""]:
        """How far apart matches may lie at this status, metres."""
        return jnp.where(status == COARSE, self.max_distance, self.fine_distance)

    def stride(self, status: Int[AnyScalar, ""], num_iterations: Int[AnyScalar, ""]) -> Int[AnyScalar, ""]:
        """Every so many-th point takes part now. What is measured last is measured with all."""
        return jnp.where((status == COARSE) & (num_iterations < self.max_iterations), self.coarse_stride, 1)

    def first_status(self) -> Int[AnyScalar, ""]:
        coarse = (self.fine_distance < self.max_distance) | (self.coarse_stride > 1)
        return jnp.where(coarse, np.int32(COARSE), np.int32(RUNNING))


class Problem(eqx.Module):
    """Inputs of the registration loop."""

    start: jaxlie.SE3
    source: Surface
    target: Surface
    method: AbstractMethod
    robust: AbstractKernel | None
    settings: Settings


class State(eqx.Module):
    """Where the loop stands.

    Attributes:
        pose: the next pose while the loop goes on; the one that was measured when it ends.
        status: value of a `Status`, `COARSE`, `RUNNING` or `SETTLED`.
        num_iterations: updates so far.
        sums: at the pose before.
        information: (6, 6) at the pose before, about the centroid, lengths in units of the radius.
        directions: at the pose before, about the centroid; None for matches that were given.
        record: one number per entry of `Registration.history`, in the order of `RECORDED`.
    """

    pose: jaxlie.SE3
    status: Int[AnyArray, "*batch"]
    num_iterations: Int[AnyArray, "*batch"]
    sums: Sums
    information: Float[AnyArray, "*batch 6 6"]
    directions: Directions | None
    record: Float[AnyArray, "*batch 5"]


class Assessment(NamedTuple):
    """What is told of a loop that has ended: information and directions of its pose, and its covariance."""

    constraints: Deferred[tuple[Float[AnyArray, "6 6"], Directions | None]]
    covariance: Deferred[Float[AnyArray, "6 6"]]


@jax.jit
def update(
    pose: jaxlie.SE3, status: Int[Array, ""], num_iterations: Int[Array, ""], sums: Sums, settings: Settings
) -> State:
    """Update the pose, unless it has converged. Compiled once, whatever the clouds."""
    directions, basis = None, jnp.eye(6, dtype=sums.totals.dtype)
    degenerate: AnyScalar = np.bool_(False)
    with jax.default_matmul_precision("highest"):
        if sums.observability:
            directions = find_directions(sums)
            degenerate = ~jnp.all(directions.held)
            # What nothing constrains would follow the nearest neighbours' pull: it stays where the start has it.
            basis = jnp.asarray(directions.twists).T * (directions.held | ~settings.hold_free_directions)
        change = solve_update(sums, basis)
    moved = move_pose(pose, change.twist, sums.center)
    coarse, settled = status == COARSE, status == SETTLED
    translation_step = jnp.linalg.norm(change.twist[:3])
    rotation_step = jnp.linalg.norm(change.twist[3:])

    def below(times: float) -> Bool[Array, ""]:
        return (translation_step <= times * settings.translation_tolerance) & (
            rotation_step <= times * settings.rotation_tolerance
        )

    motion = translation_step + sums.radius * rotation_step
    nearly = below(_NEARLY_CONVERGED) & (motion <= _FRACTION_OF_GATE * settings.fine_distance)
    converged = below(1.0) | (coarse & nearly)
    finite = jnp.isfinite(sums.constant) & jnp.all(jnp.isfinite(moved.wxyz_xyz))
    outcomes: tuple[tuple[Array, int], ...] = (
        (sums.num_inliers < _MIN_CORRESPONDENCES, Status.TOO_FEW_CORRESPONDENCES),
        (~finite, Status.NON_FINITE),
        (settled & (change.degenerate | degenerate), Status.DEGENERATE),
        (settled, Status.CONVERGED),
        (num_iterations >= settings.max_iterations, Status.MAX_ITERATIONS),
        (coarse & ~converged, COARSE),
        (converged & ~coarse, SETTLED),
    )
    conditions, codes = zip(*outcomes, strict=True)
    status = jnp.select(list(conditions), [np.int32(code) for code in codes], np.int32(RUNNING))
    record = (sums.cost, sums.rmse, sums.num_inliers, translation_step, rotation_step)
    return State(
        # The pose that all this was measured at is the one that is returned.
        pose=jaxlie.SE3(jnp.where(status < 0, moved.wxyz_xyz, pose.wxyz_xyz)),
        status=status,
        num_iterations=num_iterations + (status < 0),
        sums=sums,
        information=change.information,
        directions=directions,
        record=jnp.stack([number.astype(sums.totals.dtype) for number in record]),
    )


@jax.jit
def constraints_of(state: State) -> tuple[Float[Array, "6 6"], Directions | None]:
    """Of a loop that has ended: information and directions of ξ in T exp(ξ), metres and radians."""
    sums, directions = state.sums, state.directions
    with jax.default_matmul_precision("highest"):
        adjoint = adjoint_to_center(state.pose, sums.center) / units(sums.radius)[:, None]
        information = adjoint.T @ (state.information * sums.radius**2) @ adjoint
        return information, None if directions is None else directions_at_source(directions, state.pose)


@jax.jit
def covariance_of_pose(
    state: State,
    jacobian: Float[Array, "6 10"],
    bias: Float[Array, "6"],
    scatter: Float[Array, "6 6"],
    num_cells: Int[Array, ""],
) -> Float[Array, "6 6"]:
    """Of a loop that has ended: the covariance of its pose, NaN where there is none to be had."""
    found = (state.status != Status.TOO_FEW_CORRESPONDENCES) & (state.status != Status.NON_FINITE)
    if state.directions is None:
        found = found & (state.status != Status.DEGENERATE)
    center, radius = state.sums.center, state.sums.radius
    with jax.default_matmul_precision("highest"):
        covariance = sandwich(state.pose, center, radius, jacobian, bias, scatter, num_cells, state.directions)
    return jnp.where(found, covariance, jnp.nan)


def history_of(records: Float[AnyArray, "*batch T 5"]) -> dict[str, Any]:
    """By name."""
    return {name: records[..., i] for i, name in enumerate(RECORDED)}


def rotation_and_translation(pose: jaxlie.SE3, dtype: Any) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    return pose.rotation().as_matrix().astype(dtype), pose.translation().astype(dtype)
