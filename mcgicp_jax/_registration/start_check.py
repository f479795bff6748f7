"""Whether a registration has left its initial pose for a worse one.

The coarse phase is made for initial poses that are several spacings off. Where the clouds are parts of a scene that
were cut, it may leave a right initial pose: all points beyond the cut match its border, and pull it to themselves. At
such a pose more points have matches than at the right one, but the surfaces do not coincide. Where views have little in
common, the surfaces may coincide there, too, and neither pose can be promised.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, cast

import jaxlie
import numpy as np
from jaxtyping import Float

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, numpy_for
from mcgicp_jax._local_geometry.local_geometry import LocalGeometry, local_geometries
from mcgicp_jax._local_geometry.surface_agreement import THINNEST, agreement_of
from mcgicp_jax._math.statistics import sampled_rows
from mcgicp_jax._pose_solver.degeneracy import Directions
from mcgicp_jax._pose_solver.matched import Motion
from mcgicp_jax._registration.loop import AbstractExecutor, LoopResult, State
from mcgicp_jax._registration.pose_derivative import Inputs, Run
from mcgicp_jax._registration.result import USABLE, Status
from mcgicp_jax._registration.settings import Settings

# `surface_fit` below which a registration with at least so many matches may have left a right pose. It was at most
# 0.073 at 53 wrong poses of rooms that were cut, KITTI, another LiDAR and simulated streets. At right poses it was 0.17
# or more in these rooms, 0.27 in furnished ones and in streets, 0.25 on KITTI; but less in 18 of 128 registrations of
# raw scans, where another one, which is not better, costs its time alone.
_LEAST_FIT, _MANY = 0.08, 4000
# The same for fewer matches, whose thick neighbourhoods fit wrong poses better: up to 0.29 in rooms of 330 to 2,000
# points. A pose with more matches than the one that it replaces must fit so well, too. Scan lines match themselves at
# the initial pose, where more points have matches, the fit was up to 0.16, and the evidence up to 3.2 times as large as
# at the right pose (a LiDAR with an eighth of its beams); cut rooms have fewer matches at the right pose.
_GOOD_FIT = 0.3
# A pose with less is no better than any other. It was at most 0.022 at wrong poses of a planar scan, whose surfaces
# coincide nowhere (0.001 at the right one), and at least 0.044 at right poses of the sparsest rooms.
_SOME_FIT = 0.03
# Another pose is better if its evidence, overlap times fit, is at least so many times as large. It was 1.65 to 226
# times as large at right poses that replace wrong ones, and at most 1.04 times at wrong poses: on a plane, where any
# pose fits. In between neither is promised; and with few matches neither if the other pose is not this much worse.
_BETTER = 1.3
# With few matches, a third registration with this fraction of the fine `max_distance`, 1.5 spacings, is compared as
# well: where spacings are nearly as large as furniture, the fine distance leads from a right pose to a wrong one, too.
# Of 576 registrations of such rooms, 22 were CONVERGED and off by more than six deviations with a second one alone, and
# now none.
_CLOSE = 0.6
# With few matches and no channel that constrains the pose, a DEGENERATE pose, or one that is further from the initial
# pose than this fraction of the coarse `max_distance`, is compared however well its surfaces coincide: in a corridor
# they coincide at many poses, and more points have matches where one cloud lies over the other. Of 288 registrations of
# 300 to 3,000 points of corridors and rooms, half to three quarters in common, from starts within 0.3 m, 50 were
# CONVERGED and off by more than six deviations, and now 11; 37 were DEGENERATE and had slid by more than 0.5 m, and now
# four.
_FAR = 0.5
# Fraction of the source points that lie on the target, in position, below which views have little in common. A pose at
# which more points lie on surfaces may then win, though these coincide: of 160 views of rooms from 46 to 63° apart, six
# were CONVERGED up to 1.3 m off, at 0.25 to 0.44. (Now none, and of 73 right ones, five are UNVERIFIED. Right poses of
# KITTI and tables had at least 0.75, of 7-Scenes and of another LiDAR 0.42; the smaller distance led to them, too.)
LITTLE_IN_COMMON = 0.6
# Number of matches that are compared. Four times as many do not separate poses any better.
_SAMPLE = 1024


class SurfaceFit(NamedTuple):
    """How well the surfaces of two clouds coincide at a pose.

    Attributes:
        fit: (a/m)², for the agreement a and the misfit m, at least 1, of the surfaces of matched points, see
            `agreement_of`; 0 without matches.
        overlap: fraction of the source points that lie on the target, in position.
    """

    fit: AnyScalar
    overlap: AnyScalar

    def exceeds(self, other: SurfaceFit, factor: float) -> bool:
        """Whether the evidence for this pose, overlap times fit, is more than `factor` times that for another one. Of
        more matches, which may lie beyond a cut, it is not, unless they fit well."""
        least = _SOME_FIT if self.overlap <= other.overlap else _GOOD_FIT
        return bool(self.fit > least and self.fit * self.overlap > factor * other.fit * other.overlap)


class Doubt(NamedTuple):
    """Why a registration may have left a right initial pose.

    Attributes:
        moved: how far it has moved the points, metres.
        little: whether the views have little in common.
        by_shape: whether there are few matches, and no channel constrains the pose.
        changing: whether the one reason is that its pose is still changing.
        distances: the `max_distance` of the registrations that are to be compared with it, metres.
    """

    fit: SurfaceFit
    moved: float
    little: bool
    few: bool
    by_shape: bool
    changing: bool
    distances: list[float]


class _Candidate(NamedTuple):
    """A registration from the initial pose.

    Attributes:
        moved: how far it has moved the points, metres.
        max_distance: that it used, metres: the coarse and the fine one, or one for both.
    """

    run: Run
    state: State
    fit: SurfaceFit
    moved: float
    max_distance: tuple[float, ...]

    @property
    def limit(self) -> str:
        """The `max_distance` as an argument."""
        numbers = ", ".join(f"{distance:.2g}" for distance in self.max_distance)
        return f"({numbers})" if len(self.max_distance) > 1 else numbers


def retried_if_start_was_left(run: Run, start: jaxlie.SE3 | None, closely: Callable[[float], Run]) -> tuple[Run, str]:
    """The registration, or `closely(max_distance)` from the same start if it may have left a right initial pose and
    surfaces coincide better there (see `doubt_of_start`); and why its pose is ambiguous, or nothing. `start`: the
    initial pose of several scales, of which `run` is the last; None if `run` started there."""
    problem, state, at_scales = run.problem, run.loop.state, start is not None
    start, settings = problem.start if start is None else start, problem.settings
    doubt = doubt_of_start(start, state, settings, lambda: surface_fit(run.inputs, run.executor, run.loop), at_scales)
    if doubt is None:
        return run, ""
    fine = float(settings.fine_distance)
    candidates = [_Candidate(run, state, doubt.fit, doubt.moved, (float(settings.max_distance), fine))]
    for distance in doubt.distances:
        other = closely(distance)
        if other.loop.state.status in USABLE:
            # All are measured within the same distance.
            fit, moved = surface_fit(run.inputs, run.executor, other.loop), distance_moved(start, other.loop.state)
            candidates.append(_Candidate(other, other.loop.state, fit, moved, (distance,)))
    return _choice_of(candidates, doubt, fine)


def doubt_of_start(
    start: jaxlie.SE3, state: State, settings: Settings, measure_fit: Callable[[], SurfaceFit], at_scales: bool = False
) -> Doubt | None:
    """The doubt of a registration, if there is any; `measure_fit` computes the `surface_fit` at its pose.

    It may have left a right initial pose if it has moved the points by more than the fine `max_distance`, and surfaces
    do not coincide at its pose, or have little in common, or the pose is still changing; and if shape alone decides,
    also if it has moved them far, or is DEGENERATE. (At several scales the initial pose is known to be far off, where
    the fine distance leads nowhere.)
    """
    if not (at_scales or settings.max_distance > settings.fine_distance) or state.status not in USABLE:
        return None
    moved, fine = distance_moved(start, state), float(settings.fine_distance)
    if moved <= settings.fine_distance:
        return None
    fit = measure_fit()
    few = bool(state.record.num_inliers < _MANY)
    little = bool(fit.overlap < LITTLE_IN_COMMON) and not at_scales
    far = bool(moved > _FAR * settings.max_distance)
    by_shape = (few or far) and not np.any(cast(Directions, state.directions).constrained_by_channels)
    slid = far or state.status == Status.DEGENERATE
    left = fit.fit < (_GOOD_FIT if few else _LEAST_FIT) or little or (by_shape and slid and not at_scales)
    changing = not (left or at_scales) and state.status == Status.MAX_ITERATIONS
    distances = [fine, _CLOSE * fine] if few and not little else [fine]
    return Doubt(fit, moved, little, few, by_shape, changing, distances) if left or changing else None


def surface_fit(inputs: Inputs, executor: AbstractExecutor, loop: LoopResult) -> SurfaceFit:
    """At the pose of a loop, matched within the fine `max_distance` of the executor."""
    points, others = executor.problem.source.points, executor.problem.target.points
    rows, counts = sampled_rows(executor.problem.source.search.valid, _SAMPLE)
    # In position alone: matches in position and channels lie further apart, also at right poses.
    motion, matches = executor.rematched(loop.state.pose, np.zeros(3, points.dtype), rows, counts)
    targets = executor.within(motion, matches).indices[0]
    matched, xp = targets >= 0, numpy_for(targets)
    targets = xp.maximum(targets, 0)
    both_rows = rows if inputs.source_rows is None else inputs.source_rows[rows], targets
    source, target = local_geometries(inputs.source, inputs.target, inputs.method.uses_channels, both_rows)
    turned = motion._replace(translation=np.zeros(3, points.dtype)).move(source.normal).T
    offsets, thicknesses = others[targets] - motion.move(points[rows]).T, (_thickness(source), _thickness(target))
    misfit, agreement = agreement_of(offsets, (turned, target.normal), thicknesses, matched)
    return SurfaceFit((agreement / xp.maximum(misfit, 1)) ** 2, xp.sum(matched) / xp.maximum(xp.sum(counts), 1))


def _thickness(local: LocalGeometry) -> Float[AnyArray, "n"]:
    """Standard deviations of neighbourhoods along their normals, metres."""
    xp, (x, y, z) = numpy_for(local), local.normal.T
    variance = xp.sum(local.covariance.T * xp.stack([x * x, 2 * x * y, 2 * x * z, y * y, 2 * y * z, z * z]), axis=0)
    # A disc extends to twice its standard deviation.
    least = 0.5 * THINNEST * local.neighborhood_radius
    return xp.maximum(xp.sqrt(xp.maximum(variance, 0)), xp.maximum(least, np.finfo(np.float32).tiny))


def distance_moved(start: jaxlie.SE3, state: State) -> float:
    """How far a registration has moved points at the radius of the matched ones, at most, metres."""
    directions = cast(Directions, state.directions)
    before, after = (Motion.of(np.asarray(pose.wxyz_xyz)) for pose in (start, state.pose))
    turn, arm = after.rotation @ before.rotation.T, directions.center - after.translation
    shift = arm - turn.T @ arm + after.translation - before.translation
    angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    return float(np.linalg.norm(shift) + directions.radius * angle)


def _choice_of(candidates: list[_Candidate], doubt: Doubt, fine: float) -> tuple[Run, str]:
    """The best registration, and why its pose is ambiguous, or nothing. The first candidate is the one in doubt, with
    the fine `max_distance` `fine`, metres."""
    best, *others = candidates
    for other in others:
        best = other if other.fit.exceeds(best.fit, _BETTER) else best

    def is_nearer(other: _Candidate) -> bool:
        """Whether shape alone decides, and surfaces coincide, or do about as well as at the best pose, at one nearer to
        the initial pose. With more matches they have to coincide: scan lines match themselves at the initial pose."""
        has_more_matches = other.fit.overlap > best.fit.overlap
        least = _GOOD_FIT if has_more_matches else max(_SOME_FIT, min(_GOOD_FIT, best.fit.fit / _BETTER))
        return doubt.by_shape and other.moved < best.moved - fine and bool(other.fit.fit > least)

    changing = candidates[0] if doubt.changing else None
    if best.state.status == Status.DEGENERATE:
        # Along what nothing constrains, the pose keeps its initial value.
        best = next(filter(is_nearer, candidates), best)
    elif best.state.status == Status.MAX_ITERATIONS:
        # A pose that has converged, where surfaces coincide about as well, replaces one that is changing.
        converged = [other for other in candidates if other.state.status == Status.CONVERGED]
        alike = [other for other in converged if _BETTER * other.fit.fit >= best.fit.fit]
        changing, best = best, (alike or [best])[0]
    margin = 1 / _BETTER if doubt.few else 1.0
    rivals = [
        other
        for other in candidates
        if doubt.little or other is changing or other.fit.exceeds(best.fit, margin) or is_nearer(other)
    ]
    # Why the pose of the best one is ambiguous, and what to pass.
    common = f"fewer than {LITTLE_IN_COMMON:.0%} of the source points lie on the target, and " if doubt.little else ""
    if doubt.little and len(rivals) == 1:
        return best.run, f"{common}registration with a smaller max_distance fails; pass a better initial pose"
    distances = [distance_moved(best.state.pose, rival.state) for rival in rivals]
    distance = max(distances, default=0.0)
    if distance <= fine:
        return best.run, ""
    rival = rivals[distances.index(distance)]
    nearest = min(best, rival, key=lambda candidate: candidate.moved)
    unsettled = rival.state.status == Status.MAX_ITERATIONS
    another = "another that is still changing" if unsettled else "another"
    coincide = "" if unsettled or doubt.little else ", where the surfaces coincide about as well"
    # Two distances would lead to the same doubt.
    advice = f"max_distance={nearest.limit} if the initial pose is off by less than that, or else "
    return best.run, (
        f"{common}max_distance={best.limit} leads to this pose, which moves points by {best.moved:.2g} m, but "
        f"max_distance={rival.limit} to {another}, {distance:.2g} m from this one{coincide}. Pass "
        f"{advice if len(nearest.max_distance) == 1 else ''}a better init"
    )
