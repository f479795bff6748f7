"""One step of the registration loop: from the sums at a pose to the next pose, or to a final status."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, constant, numpy_for
from mcgicp_jax._local_geometry.cloud_statistics import grid_spacing, point_spacing
from mcgicp_jax._local_geometry.local_geometry import cell_edge
from mcgicp_jax._math.poses import move_pose, units
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._methods.surfaces import AnySurface, whole_surface
from mcgicp_jax._pose_solver.degeneracy import Directions, find_directions
from mcgicp_jax._pose_solver.fixed_directions import constraints_at, with_fixed_directions
from mcgicp_jax._pose_solver.fusion import first_pull, fused_update
from mcgicp_jax._pose_solver.implicit_derivative import ImplicitRoot, root_near
from mcgicp_jax._pose_solver.matched import Matches
from mcgicp_jax._pose_solver.pose_measurements import Fusion, PoseMeasurements, Prior
from mcgicp_jax._pose_solver.sums import Sums
from mcgicp_jax._pose_solver.update import rounding, solve_update
from mcgicp_jax._registration.options import ROTATION_TOLERANCE, Options
from mcgicp_jax._registration.result import Status
from mcgicp_jax._terms.base import AbstractTerm, is_adaptive

# Statuses while the loop runs. COARSE: the coarse phase, with every `coarse_stride`-th source point and the larger
# maximum correspondence distance. RUNNING: the fine phase, with all points and the smaller distance. SETTLED: the last
# update was below the tolerances; the sums at its pose remain to be computed.
COARSE, RUNNING, SETTLED = -3, -1, -2
# The coarse phase ends with an update below its tolerances that moves the points by at most this fraction of the fine
# maximum correspondence distance. It need not converge further: the fine phase starts from its pose.
_FRACTION_OF_GATE = 0.25
# Three points determine a pose; a fourth makes residuals possible.
_MIN_CORRESPONDENCES = 4


class Settings(NamedTuple):
    """Numerical settings of the loop, as arrays, so that changing one does not recompile.

    Attributes:
        max_distance: maximum correspondence distance in the coarse phase, metres.
        fine_distance: the same in the fine phase, metres; at most `max_distance`.
        coarse_stride: the coarse phase uses every `coarse_stride`-th source point.
        translation_tolerance, rotation_tolerance: an update below both is the last; metres and radians.
        coarse_translation_tolerance, coarse_rotation_tolerance: an update below both ends the coarse phase.
        max_iterations: maximum number of updates, both phases together.
        hold_unconstrained: whether the pose is kept fixed along unconstrained directions.
    """

    max_distance: Float[AnyArray, "*batch"]
    fine_distance: Float[AnyArray, "*batch"]
    coarse_stride: Int[AnyArray, "*batch"]
    translation_tolerance: Float[AnyArray, "*batch"]
    rotation_tolerance: Float[AnyArray, "*batch"]
    coarse_translation_tolerance: Float[AnyArray, "*batch"]
    coarse_rotation_tolerance: Float[AnyArray, "*batch"]
    max_iterations: Int[AnyArray, "*batch"]
    hold_unconstrained: Bool[AnyArray, "*batch"]

    def distance(self, status: Int[AnyScalar, ""]) -> Float[AnyScalar, ""]:
        """Maximum correspondence distance at this status, metres."""
        return _either(status == COARSE, self.max_distance, self.fine_distance)

    def stride(self, status: Int[AnyScalar, ""], num_iterations: Int[AnyScalar, ""]) -> Int[AnyScalar, ""]:
        """Stride of the source points at this status. Once `max_iterations` are done, all points are measured."""
        coarse = (status == COARSE) & (num_iterations < self.max_iterations)
        return _either(coarse, self.coarse_stride, np.int32(1))

    def first_status(self) -> Int[AnyScalar, ""]:
        """`COARSE` where the coarse phase differs from the fine one."""
        coarse = (self.fine_distance < self.max_distance) | (self.coarse_stride > 1)
        return numpy_for(self).where(coarse, np.int32(COARSE), np.int32(RUNNING))


def _either(condition: Bool[AnyScalar, ""], one: AnyScalar, other: AnyScalar) -> AnyScalar:
    """One number or the other; on the host without a call of NumPy, which would take longer than the rest."""
    if isinstance(condition, np.bool_):
        return one if condition else other
    return jnp.where(condition, one, other)


class Problem(eqx.Module):
    """Inputs of the registration loop.

    Attributes:
        start: the initial pose.
        source, target: the surfaces of both clouds.
        terms: the residuals of each correspondence, before any number is adapted.
        measurements: tie points and prior: weighed by the residuals in a first registration, then as a `Fusion`; None
            if there are none.
        fixed: the prior if it fixes directions, else None.
        matches: those of `estimate_pose`, at every pose; None if the loop searches for them.
        num_candidates: number of target points that a source point is matched with.
    """

    start: jaxlie.SE3
    source: AnySurface
    target: AnySurface
    terms: tuple[AbstractTerm, ...]
    settings: Settings
    measurements: PoseMeasurements | None = None
    fixed: Prior | None = None
    matches: Matches | None = None
    num_candidates: int = eqx.field(static=True, default=1)

    def whole(self) -> Problem:
        """With all rows of both surfaces."""
        return replace(self, source=whole_surface(self.source), target=whole_surface(self.target))

    @property
    def fusion(self) -> Fusion | None:
        """The equation of the pose; None in a first registration."""
        return self.measurements if isinstance(self.measurements, Fusion) else None

    @property
    def first_status(self) -> Int[AnyScalar, ""]:
        adapts = is_adaptive(self.terms) and self.matches is None
        return np.int32(COARSE) if adapts else self.settings.first_status()


class Record(NamedTuple):
    """Entries of `RegistrationResult.history`, recorded before each update."""

    cost: Float[AnyArray, "*batch"]
    rmse: Float[AnyArray, "*batch"]
    num_inliers: Float[AnyArray, "*batch"]
    translation_step: Float[AnyArray, "*batch"]
    rotation_step: Float[AnyArray, "*batch"]


class State(NamedTuple):
    """State of the loop after one step.

    Attributes:
        pose: the updated pose; once the loop has ended, the pose at which `sums` were measured.
        status: `COARSE`, `RUNNING` or `SETTLED` (negative) while the loop runs, then the value of a `Status`.
        num_iterations: number of updates so far.
        since: (6,) sum of the updates since the last iteration whose number is a power of two, metres and radians.
        extent: largest cost, over these updates, of moving the matched points by `since`.
        sums: at the pose before the update; this and the following are None before the first step on the host.
        information: (6, 6) at the pose before the update, about the centroid, lengths in units of the radius.
        directions: at the pose before the update, about the centroid; None for `estimate_pose`.
        record: of this step.
    """

    pose: jaxlie.SE3
    status: Int[AnyArray, "*batch"]
    num_iterations: Int[AnyArray, "*batch"]
    since: Any = None
    extent: Any = None
    sums: Any = None
    information: Any = None
    directions: Directions | None = None
    record: Any = None


@jax.jit
def update(
    pose: jaxlie.SE3,
    status: Int[Array, ""],
    num_iterations: Int[Array, ""],
    since: Float[Array, "6"],
    extent: Float[Array, ""],
    sums: Sums,
    settings: Settings,
    measurements: PoseMeasurements | None = None,
    fixed: Prior | None = None,
) -> State:
    """Update the pose, or end the loop with a status. Its program does not depend on the size of the clouds.

    Matches, and the pose with them, may alternate for ever. The pose then returns to that of the last iteration whose
    number is a power of two (Brent 1980). Such a cycle ends the loop if its poses differ by less than one standard
    deviation, estimated as if the residuals were independent; the deviation of the pose is larger.
    """
    directions, basis = None, jnp.eye(6, dtype=sums.center.dtype)
    degenerate: AnyScalar = np.bool_(False)
    if sums.observability is not None:
        constraints = None if fixed is None else constraints_at(pose, sums.center, sums.radius, fixed)
        directions = find_directions(sums, constraints)
        degenerate = ~jnp.all(directions.held)
        # Along unconstrained directions an update would follow arbitrary nearest-neighbour matches.
        moving = (directions.held | ~settings.hold_unconstrained) & ~directions.fixed
        basis = jnp.asarray(directions.twists).T * moving
    if isinstance(measurements, Fusion):
        directions, change = fused_update(pose, sums, cast(Directions, directions), measurements)
        degenerate = ~jnp.all(directions.held)
    elif measurements is None or directions is None:
        change = solve_update(sums, basis)
    else:
        change = solve_update(sums, basis, first_pull(pose, sums, directions, measurements))
    moved = move_pose(pose, change.twist, sums.center)
    moved = moved if fixed is None else with_fixed_directions(moved, fixed)
    # Matches need not constrain what is fixed.
    degenerate = degenerate | (change.degenerate & (fixed is None))
    coarse, settled = status == COARSE, status == SETTLED
    since = since + change.twist
    sizes = jnp.linalg.norm(jnp.stack([change.twist, since]).reshape(2, 2, 3), axis=2)
    (translation_step, rotation_step), (translation_since, rotation_since) = sizes

    def below(translation: Float[AnyScalar, ""], rotation: Float[AnyScalar, ""]) -> Bool[Array, ""]:
        return (translation_step <= translation) & (rotation_step <= rotation)

    motion_since = since / units(sums.radius)
    extent = jnp.maximum(extent, motion_since @ change.information @ motion_since * sums.radius**2)
    returned = (translation_since <= settings.translation_tolerance) & (rotation_since <= settings.rotation_tolerance)
    cycles = (status == RUNNING) & returned & (extent * sums.count <= sums.cost)
    motion = translation_step + sums.radius * rotation_step
    nearly = below(settings.coarse_translation_tolerance, settings.coarse_rotation_tolerance)
    nearly = nearly & (motion <= _FRACTION_OF_GATE * settings.fine_distance)
    converged = below(settings.translation_tolerance, settings.rotation_tolerance) | (coarse & nearly) | cycles
    finite = jnp.isfinite(sums.energy) & jnp.all(jnp.isfinite(moved.wxyz_xyz))
    outcomes: tuple[tuple[Array, int], ...] = (
        (sums.num_inliers < _MIN_CORRESPONDENCES, Status.TOO_FEW_CORRESPONDENCES),
        (~finite, Status.NON_FINITE),
        (settled & degenerate, Status.DEGENERATE),
        (settled, Status.CONVERGED),
        (num_iterations >= settings.max_iterations, Status.MAX_ITERATIONS),
        (coarse & ~converged, COARSE),
        (converged & ~coarse, SETTLED),
    )
    conditions, codes = zip(*outcomes, strict=True)
    status = jnp.select(list(conditions), [np.int32(code) for code in codes], np.int32(RUNNING))
    record = Record(sums.cost, sums.rmse, sums.num_inliers, translation_step, rotation_step)
    num_iterations = num_iterations + (status < 0)
    restart = num_iterations & (num_iterations - 1) == 0
    return State(
        # The loop returns the pose at which sums, information and directions were measured.
        pose=jaxlie.SE3(jnp.where(status < 0, moved.wxyz_xyz, pose.wxyz_xyz)),
        status=status,
        num_iterations=num_iterations,
        since=jnp.where(restart, 0, since).astype(sums.center.dtype),
        extent=jnp.where(restart, 0, extent).astype(sums.center.dtype),
        information=change.information,
        directions=directions,
        record=Record(*(number.astype(sums.center.dtype) for number in record)),
    )


@jax.jit
def root_of(state: State, fusion: Fusion | None) -> ImplicitRoot:
    """The equation that defines the final pose, for its derivative."""
    converged = state.status == Status.CONVERGED
    usable = converged | (state.status == Status.DEGENERATE) | (state.status == Status.MAX_ITERATIONS)
    if fusion is not None:
        rotation = state.pose.rotation().as_matrix().astype(state.sums.center.dtype)
        basis, held = fusion.twists_at(rotation, state.pose.translation()), fusion.held
    elif state.directions is not None:
        basis, held = jnp.asarray(state.directions.twists).T, state.directions.held
    else:
        values, basis = jnp.linalg.eigh(state.information)
        held = converged | (values > rounding(values))
    return root_near(state.sums, usable, basis, held, fusion)


# Default maximum correspondence distances of the coarse and the fine phase, in spacings of the target. With the larger
# one, initial poses several spacings off converge, but matches across edges and the border of the overlap bias the
# final pose; the smaller one rejects these. The coarse phase also considers the spacing between scan lines: with the
# spacing along the lines alone, raw scans of KITTI, 1.3 m apart, stayed at the identity.
_COARSE_SPACINGS, _FINE_SPACINGS = 10.0, 2.5
# Default translation tolerance, in spacings of the target: 0.5 mm at 0.1 m, chosen like `ROTATION_TOLERANCE`.
_TOLERANCE_IN_SPACINGS = 0.005
# Tolerances of the coarse phase, as a multiple of the tolerances or of their defaults, whichever is larger. With
# smaller ones, the small cycles of nearest-neighbour matching would keep the coarse phase from ending.
_COARSE_TOLERANCE = 10.0


def matching_spacing(method: AbstractMethod, target: PointCloud) -> Float[AnyScalar, ""]:
    """Unit of the default maximum correspondence distances, metres: the edge of the cells for a method that matches
    voxel Gaussians, else the spacing of the points."""
    cells = method.needs_covariances and target.covariances is not None
    return cell_edge(target) if cells else point_spacing(target)


def default_distances(spacing: Any, target: PointCloud) -> tuple[Any, Any]:
    """Default `max_distance` of the coarse and the fine phase, metres, for a target with this spacing."""
    # Cells have the spacing of their grid.
    between = spacing if target.covariances is not None else constant(grid_spacing(target))
    return _COARSE_SPACINGS * numpy_for(spacing, between).maximum(spacing, between), _FINE_SPACINGS * spacing


def settings_for(options: Options, method: AbstractMethod, target: PointCloud, stride: Any, dtype: Any) -> Settings:
    max_distance: Any = options.max_distance
    tolerance: Any = options.translation_tolerance
    # Options are constants to autodiff, even if they are derived from a differentiated cloud.
    spacing = constant(matching_spacing(method, target))
    max_distance = default_distances(spacing, target) if max_distance is None else max_distance
    least = spacing * _TOLERANCE_IN_SPACINGS
    tolerance = least if tolerance is None else tolerance

    def number(value: Any, kind: Any) -> Any:
        xp = numpy_for(value)
        return xp.asarray(value, kind)

    def coarse_tolerance(value: Any, least: Any) -> Any:
        return number(_COARSE_TOLERANCE * numpy_for(value, least).maximum(value, least), dtype)

    coarse, fine = max_distance if isinstance(max_distance, tuple) or np.shape(max_distance) else [max_distance] * 2
    coarse = numpy_for(coarse).maximum(coarse, options.reach)
    return Settings(
        max_distance=number(coarse, dtype),
        fine_distance=number(fine, dtype),
        coarse_stride=number(stride, np.int32),
        translation_tolerance=number(tolerance, dtype),
        rotation_tolerance=number(options.rotation_tolerance, dtype),
        coarse_translation_tolerance=coarse_tolerance(tolerance, least),
        coarse_rotation_tolerance=coarse_tolerance(options.rotation_tolerance, ROTATION_TOLERANCE),
        max_iterations=number(options.max_iterations, np.int32),
        hold_unconstrained=number(options.hold_unconstrained, bool),
    )
