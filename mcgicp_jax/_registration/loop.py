"""The registration loop: find matches at this pose; sum their forces; update the pose; stop when it no longer moves.

The way of a source point from `PointCloud` to `RegistrationResult`, in eight sentences. `preprocess` finds the k
nearest neighbours of the point. `local_geometry_of` computes its `LocalGeometry` from this neighbourhood: covariance,
normal, channel fits. `surface_of` turns these into a row of a `Surface`: position, the covariance of the method,
observability. Both are row functions (`_compute.row_functions`): on the host their rows are computed when they are
first gathered, and gathered rows are `Rows`. The search finds the target point nearest to the moved point in position
and α · channel, as `Matches`, and the rows of both are `Matched`, from which each term computes a `Linearization`: the
cost of the correspondence, its force (−gradient/2) and stiffness (Hessian/2). `sums_of` adds them over all
correspondences to `Sums`, `update` computes the next `State` from the sums, and search, sums and update repeat until
the pose converges. At the final pose `scores_of` computes the contribution of each correspondence to the covariance of
the pose.

The loop is written once. An executor says how its parts are done: blocks of rows on the host, whole arrays inside
transformations and in chunks of pairs on accelerators. The status is decided in `update`.
"""

from __future__ import annotations

import abc
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, numpy_for
from mcgicp_jax._math.poses import move_pose, units
from mcgicp_jax._methods.surfaces import AnySurface
from mcgicp_jax._pose_solver.covariance import Scores
from mcgicp_jax._pose_solver.degeneracy import Directions, find_directions
from mcgicp_jax._pose_solver.fusion import first_force, fused_update
from mcgicp_jax._pose_solver.implicit_derivative import ImplicitRoot
from mcgicp_jax._pose_solver.matched import Matches, Motion, adapted, sample_of_term
from mcgicp_jax._pose_solver.pose_measurements import (
    Fusion,
    PoseMeasurements,
    Prior,
    constraints_at,
    with_fixed_directions,
)
from mcgicp_jax._pose_solver.sums import Sums
from mcgicp_jax._pose_solver.update import Update, rounding, solve_update
from mcgicp_jax._registration.result import Status
from mcgicp_jax._registration.settings import COARSE, RUNNING, SETTLED, Settings, either
from mcgicp_jax._search.base import SearchPoints, by_position
from mcgicp_jax._terms.base import AbstractTerm, is_adaptive

# The coarse phase ends with an update below its tolerances that moves the points by at most this fraction of the fine
# maximum correspondence distance. It need not converge further: the fine phase starts from its pose.
_FRACTION_OF_GATE = 0.25
# Squared standard deviations of a prior beyond which a pose contradicts it: a right one in one of a million cases (χ²
# with six degrees of freedom).
CONTRADICTION = 38.3
# Three points determine a pose; a fourth makes residuals possible.
_MIN_CORRESPONDENCES = 4
# Candidates of each source point in soft matches. Their weights fall off with a temperature of one spacing of the
# target, so that on a surface 2 π of its points weigh like the nearest one. With 16, derivatives of flat tables were
# the same within a tenth.
_SOFT_CANDIDATES = 8


class Problem(eqx.Module):
    """Inputs of the registration loop.

    Attributes:
        start: the initial pose.
        terms: the residuals of each correspondence, before any number is adapted.
        measurements: tie points and prior: weighed by the residuals in a first registration, then as a `Fusion`; None
            if there are none.
        fixed: the prior if it fixes directions, else None.
        matches: those of `estimate_pose`, at every pose; None if the loop searches for them.
        num_candidates: number of target points that a source point is matched with.
        temperature: of the soft matches by which the final pose is differentiated, metres; None for those of the loop.
        widens_kernels: whether kernels are wide in the coarse phase: those of the user, not those of a method.
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
    temperature: Any = None
    widens_kernels: bool = eqx.field(static=True, default=False)
    # As in `PointCloud`.
    __getattribute__ = object.__getattribute__

    @property
    def fusion(self) -> Fusion | None:
        """The equation of the pose; None in a first registration."""
        return self.measurements if isinstance(self.measurements, Fusion) else None

    @property
    def first_state(self) -> State:
        """The status is `COARSE` if that phase differs from the fine one, and always for terms that adapt."""
        settings, dtype = self.settings, self.start.wxyz_xyz.dtype
        coarse: Any = (settings.fine_distance < settings.max_distance) | (settings.coarse_stride > 1)
        coarse = coarse | (is_adaptive(self.terms) and self.matches is None)
        status = numpy_for(coarse).where(coarse, np.int32(COARSE), np.int32(RUNNING))
        return State(self.start, status, np.int32(0), np.zeros(6, dtype), np.zeros((), dtype))

    def widened(self, terms: tuple[AbstractTerm, ...], status: Int[AnyScalar, ""]) -> tuple[AbstractTerm, ...]:
        """The terms with kernels that are wide in the coarse phase: residuals grow with the distance of the matches,
        and a kernel that redescends would ignore all that could move the pose."""
        width = either(status == COARSE, self.settings.max_distance / self.settings.fine_distance, 1.0)

        def scaled(scale: Any) -> AnyScalar:
            return numpy_for(scale, width).asarray(scale) * width

        return tuple(
            term if term.robust is None else eqx.tree_at(lambda term: term.robust.scale, term, replace_fn=scaled)
            for term in terms
        )


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
        since: (6,) sum of the updates since the last iteration whose number is a power of two, metres and radians.
        extent: largest cost, over these updates, of moving the matched points by `since`.
        sums: at the pose before the update; this and the following are None before the first step on the host.
        information: (6, 6) at the pose before the update, about the centroid, lengths in units of the radius.
        directions: at the pose before the update, about the centroid; None for `estimate_pose`.
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


class LoopResult(NamedTuple):
    """The loop after some steps.

    Attributes:
        matches: at the pose before the last update; None before the first, unless they are given.
        terms: as they were at that pose.
        history: records of the steps; arrays with one entry for each possible step inside transformations.
    """

    state: State
    matches: Any
    terms: tuple[AbstractTerm, ...]
    history: Any


class AbstractExecutor(abc.ABC):
    """How the parts of the loop are done for one problem. Functions that it applies to correspondences are defined at
    module level; they map a `Motion`, `Matched` and further arguments to a pytree of arrays."""

    def __init__(self, problem: Problem):
        self.problem, self._adapts = problem, is_adaptive(problem.terms)

    @abc.abstractmethod
    def run(self) -> LoopResult:
        """Repeat the step while the status is negative, and keep the history."""

    def step(self, loop: LoopResult) -> LoopResult:
        """One step: find matches at this pose; sum their forces; update the pose."""
        state = loop.state
        matches = self.match(state, loop.matches) if self.problem.matches is None else loop.matches
        terms = self.adapt(state, matches, loop.terms) if self._adapts else loop.terms
        acting = self.problem.widened(terms, state.status) if self.problem.widens_kernels else terms
        sums = self.sums(Motion.of(state.pose.wxyz_xyz), matches, acting, state.status == SETTLED)
        # The sums are not an output of the compiled update, which would copy them.
        return LoopResult(self.update(state, sums)._replace(sums=sums), matches, terms, loop.history)

    @abc.abstractmethod
    def match(self, state: State, before: Any) -> Matches:
        """The matches found at the pose of a state. If its status is `SETTLED`, the previous matches, `before`."""

    @abc.abstractmethod
    def nearest(
        self, pose: Float[AnyArray, "7"], source: SearchPoints, alone: bool = True, num_candidates: int = 1
    ) -> Int[AnyArray, "m n"]:
        """Target rows nearest in position, and unless `alone`, in channels; −1 for none within the fine distance."""

    @abc.abstractmethod
    def rows(self, function: Any, motion: Motion, matches: Matches, *arguments: Any, with_noise: bool = False) -> Any:
        """Apply a function that returns one row per correspondence, to surfaces with `noise` and `search` if asked."""

    @abc.abstractmethod
    def sums(self, motion: Motion, matches: Matches, terms: tuple[AbstractTerm, ...], last: Bool[AnyScalar, ""]) -> Any:
        """`sums_of` all correspondences, as the executor keeps them while the loop runs. In the `last` step alone,
        shapes and channels of matched points must agree: far from the right pose they do not, and what each cloud
        observes guides the pose."""

    def update(self, state: State, sums: Any) -> State:
        """The state after an update of the pose, without the sums."""
        problem = self.problem
        return update(*state[:5], sums, problem.settings, problem.measurements, problem.fixed)

    @abc.abstractmethod
    def scores(self, motion: Motion, matches: Matches, *arguments: Any) -> Scores:
        """`scores_of` all correspondences; further arguments are those of that function."""

    def adapt(self, state: State, matches: Matches, before: tuple[AbstractTerm, ...]) -> tuple[AbstractTerm, ...]:
        """Adaptive terms with numbers estimated from a sample of the matches; outside the fine phase, `before`."""
        motion, valid = Motion.of(state.pose.wxyz_xyz), self.problem.source.search.valid
        valid = valid if matches.rows is None else valid[matches.rows]

        def sample(term: AbstractTerm, rows: Int[AnyArray, "n"]) -> Any:
            return self.rows(sample_of_term, motion, matches.some(rows), term)

        return adapted(self.problem.terms, valid, sample)

    def rematched(
        self, pose: jaxlie.SE3, shift: Float[AnyArray, "3"], rows: Int[AnyArray, "n"], counts: Bool[AnyArray, "n"]
    ) -> tuple[Motion, Matches]:
        """A pose moved by `shift` metres, and new matches of the source points that count, in position alone."""
        source, target, xp = self.problem.source.search, self.problem.target.search, numpy_for(rows, counts)
        motion = Motion.of(pose.wxyz_xyz)
        motion = motion._replace(translation=motion.translation + shift)
        points = by_position(jax.tree.map(lambda array: xp.asarray(array)[rows], source))
        indices = self.nearest(xp.concatenate([pose.wxyz_xyz[:4], motion.translation]), points)
        limit = self.problem.settings.fine_distance
        return motion, Matches.of(points, target, xp.where(counts, indices, -1), limit, rows)

    def distances(self, motion: Motion, matches: Matches) -> Float[AnyArray, "m n"]:
        """Distances of all matches, metres; infinite where there is none."""
        xp = numpy_for(motion, matches, self.problem.source.points)
        points, targets = xp.asarray(self.problem.source.points), xp.asarray(self.problem.target.points)
        with np.errstate(invalid="ignore", over="ignore"):
            moved = motion.move(points if matches.rows is None else points[matches.rows]).T
            residual = targets[xp.maximum(matches.indices, 0)] - moved
            return xp.where(matches.indices >= 0, xp.linalg.norm(residual, axis=-1), np.inf)

    def differentiable_matches(self, loop: LoopResult) -> Matches:
        """The matches by which the final pose is differentiated: those of the loop, or soft ones at this pose."""
        problem, pose, matches = self.problem, loop.state.pose.wxyz_xyz, loop.matches
        if problem.temperature is not None:
            source, target = problem.source.search, problem.target.search
            indices = self.nearest(pose, source, alone=False, num_candidates=_SOFT_CANDIDATES)
            matches = Matches.of(source, target, indices, problem.settings.fine_distance)
            matches = matches._replace(temperature=problem.temperature)
        return self.within(Motion.of(pose), matches)

    def within(self, motion: Motion, matches: Matches) -> Matches:
        near = self.distances(motion, matches) <= matches.max_distance
        return matches._replace(indices=numpy_for(near).where(near, matches.indices, -1))


def _change(
    pose: jaxlie.SE3, sums: Sums, settings: Settings, measurements: PoseMeasurements | None, fixed: Prior | None
) -> tuple[Update, Directions | None, Bool[AnyScalar, ""]]:
    """The change of the pose, the directions in which it is constrained, and whether some are not."""
    directions, basis = None, jnp.eye(6, dtype=sums.center.dtype)
    degenerate: AnyScalar = np.bool_(False)
    if sums.observability is not None:
        by_prior = None if fixed is None else constraints_at(pose, sums.center, sums.radius, fixed)
        directions = find_directions(sums, by_prior)
        degenerate = ~jnp.all(directions.constrained)
        # Along unconstrained directions an update would follow arbitrary nearest-neighbour matches.
        moving = (directions.constrained | ~settings.hold_unconstrained) & ~directions.fixed
        basis = jnp.asarray(directions.twists).T * moving
    if isinstance(measurements, Fusion):
        directions, change = fused_update(pose, sums, cast(Directions, directions), measurements)
        degenerate = ~jnp.all(directions.constrained)
    elif measurements is None or directions is None:
        change = solve_update(sums, basis)
    else:
        change = solve_update(sums, basis, first_force(pose, sums, directions, measurements))
    # Matches need not constrain what is fixed.
    return change, directions, degenerate | (change.degenerate & (fixed is None))


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
    deviation, estimated as if residuals were independent, which is smaller than that of the pose.
    """
    change, directions, degenerate = _change(pose, sums, settings, measurements, fixed)
    moved = move_pose(pose, change.twist, sums.center)
    moved = moved if fixed is None else with_fixed_directions(moved, fixed)
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
    by_channels = False if directions is None else jnp.any(directions.constrained_by_channels)
    doubtful = settings.channels_may_move & by_channels
    from_prior, from_ties = squared_residuals(pose, measurements)
    most = np.inf if measurements is None else measurements.form.most
    contradicted = (from_prior > CONTRADICTION) | (from_ties > most)
    outcomes: tuple[tuple[Array, int], ...] = (
        (sums.num_inliers < _MIN_CORRESPONDENCES, Status.TOO_FEW_CORRESPONDENCES),
        (~finite, Status.NON_FINITE),
        (settled & degenerate, Status.DEGENERATE),
        (settled & (contradicted | doubtful), Status.UNVERIFIED),
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


def squared_residuals(
    pose: jaxlie.SE3, measurements: PoseMeasurements | None
) -> tuple[Float[AnyScalar, ""], Float[AnyScalar, ""]]:
    """Squared standard deviations of the prior, and of the tie points, at a pose, once they are weighed; else 0."""
    if not isinstance(measurements, Fusion):
        return np.float32(0), np.float32(0)
    motion = Motion(pose.rotation().as_matrix().astype(measurements.center.dtype), pose.translation())
    residual, _ = measurements.prior_residual(motion)
    return residual @ measurements.form.prior.information @ residual, measurements.cost_of_ties(motion)


def root_of(state: State, fusion: Fusion | None) -> ImplicitRoot:
    """The equation that defines the final pose, for its derivative."""
    sums = state.sums
    converged = (state.status == Status.CONVERGED) | (state.status == Status.UNVERIFIED)
    usable = converged | (state.status == Status.DEGENERATE) | (state.status == Status.MAX_ITERATIONS)
    if fusion is not None:
        basis, constrained = fusion.twists_at(Motion.of(state.pose.wxyz_xyz)), fusion.constrained
    elif state.directions is not None:
        basis, constrained = jnp.asarray(state.directions.twists).T, state.directions.constrained
    else:
        values, basis = jnp.linalg.eigh(state.information)
        constrained = converged | (values > rounding(values))
    identity, degenerate = jnp.eye(6, dtype=sums.center.dtype), usable & ~jnp.all(constrained)
    columns = jnp.where(degenerate, basis * constrained, identity)
    if fusion is not None:
        radius, rows = jnp.asarray(fusion.radius), jnp.where(degenerate, jnp.diag(1.0 * constrained), identity)
        return ImplicitRoot(jnp.asarray(fusion.center), radius, radius, usable, columns, rows)
    radius = jnp.where(usable, sums.radius, 1)
    # The trace of Σ K, in the unit of g.
    scale = jnp.sum(sums.stiffness[jnp.array([0, 3, 5]), 3, 3]) * radius**2
    center, scale = jnp.where(usable, sums.center, 0), jnp.where(usable, scale, 1)
    return ImplicitRoot(center, radius, scale, usable, columns, columns.T)
