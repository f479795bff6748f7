"""Edges from registrations, and loops found as a sensor returns to where it has been."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pose_graph.graph import Edge, PoseGraph
from mcgicp_jax._pose_graph.optimize import motion_covariances, optimize_poses
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.register_pair import register_pair
from mcgicp_jax._registration.result import Registration, Status
from mcgicp_jax._registration.settings import default_distances, matching_spacing

# Least overlap of a pair that makes an edge: with less, a wrong local minimum looks like a right one.
LEAST_OVERLAP = 0.4
# Information along unconstrained directions, as a fraction of that along the others, between two bounds. The directions
# are known to δ = 2 mrad only, which lets δ² = 4e-6 of the information across leak into them: with no more than that,
# poses slide along a corridor for the sake of millimetres across it. And drift must remain plausible: from 1e-2 on, the
# edges of a corridor that is 5 % too long in the start contradict the loop at its end, which is rejected. Errors with
# this loop, in three simulated corridors: 134 to 291 mm with 1e-6, 46 to 85 with 1e-5, 6 to 13 with 1e-4, 3 to 5 with
# 1e-3, 117 from 1e-2 on.
_NEXT_TO_NOTHING = 1e-4
# Two frames may close a loop if the sensor was within this many median ranges of the points, give or take the
# deviations of 99 % (χ² with three degrees of freedom); the overlap decides. In the benchmark, 1 leaves 14 mm in the
# street instead of 9, and no more in the room.
_NEAR, _DEVIATIONS = 2.0, 3.37
# A loop is looked for if the graph knows the motion between two frames worse than a registration: the variances, in the
# geometric mean of the six directions, are larger by this factor.
_GAIN = 4.0
# Frames whose certainty is computed, the nearest ones, and of these, registrations tried per frame.
_CANDIDATES, _TRIES = 16, 2


def edge_from(i: int, j: int, result: Registration, *, loop: bool = False) -> Edge | None:
    """The edge that a registration of cloud j to cloud i measures; None unless it has come to rest with an overlap.

    Its information is the inverse of `Registration.covariance` within the constrained directions and next to nothing
    along the others, so that DEGENERATE results, too, tell what they know.
    """
    overlap = float(np.asarray(result.overlap))
    if result.status not in (Status.CONVERGED, Status.DEGENERATE) or overlap < LEAST_OVERLAP:
        return None
    covariance, directions = np.asarray(result.covariance, np.float64), result.directions
    if directions is None or not np.isfinite(covariance).all():
        return None
    held = np.asarray(directions.held)
    # Coordinates along the six directions: what is constrained does not depend on the rest.
    coordinates = np.linalg.inv(np.asarray(directions.twists, np.float64).T)
    inner = (coordinates @ covariance @ coordinates.T)[np.ix_(held, held)]
    if not held.any() or np.linalg.cond(inner) > 1 / np.finfo(float).eps:
        return None
    known = np.zeros((6, 6))
    known[np.ix_(held, held)] = np.linalg.inv(inner)
    known[~held, ~held] = _NEXT_TO_NOTHING * np.median(np.linalg.eigvalsh(known[np.ix_(held, held)]))
    information = coordinates.T @ known @ coordinates
    return Edge(i, j, result.matrix, 0.5 * (information + information.T), loop=loop)


class Trajectory:
    """The poses of a sensor, its clouds, and the edges between them, as they come in.

    Attributes:
        graph: the poses so far, corrected by the loops, and the edges.
    """

    def __init__(self, method: AbstractMethod, options: Options):
        self._method, self._options = method, options
        self._clouds: list[PointCloud] = []
        self._poses: list[Float[np.ndarray, "4 4"]] = []
        self._edges: list[Edge] = []

    @property
    def graph(self) -> PoseGraph:
        return PoseGraph(self._poses, self._edges)

    def add(
        self, cloud: PointCloud, pose: Float[np.ndarray, "4 4"], result: Registration | None
    ) -> Float[np.ndarray, "4 4"]:
        """Add a frame with its registration to the one before, close loops with earlier ones, and return its pose."""
        number = len(self._clouds)
        self._clouds.append(cloud)
        self._poses.append(pose)
        if result is not None:
            edge = edge_from(number - 1, number, result)
            if edge is None:
                # Without a measurement the motion that was assumed stays, as information of next to nothing.
                edge = Edge(number - 1, number, np.linalg.inv(self._poses[-2]) @ pose, np.zeros((6, 6)))
            self._edges.append(edge)
            loops = self._loops(number)
            if loops:
                self._edges += loops
                self._poses = list(np.asarray(optimize_poses(self.graph).poses))
        return self._poses[-1]

    def _loops(self, number: int) -> list[Edge]:
        """At most one edge, to an earlier frame that was near and whose motion is known worse than by registration."""
        positions = np.array(self._poses)[:, :3, 3]
        distances = np.linalg.norm(positions[: number - 1] - positions[number], axis=1)
        nearest = np.argsort(distances, kind="stable")[:_CANDIDATES]
        if not len(nearest):
            return []
        covariances = motion_covariances(self.graph, nearest, np.full(len(nearest), number))
        rows, certainties = self._worthwhile(number, nearest, distances[nearest], covariances)
        for i, covariance in list(zip(rows, certainties, strict=True))[:_TRIES]:
            edge = self._registered(int(i), number, covariance)
            if edge is not None:
                return [edge]
        return []

    def _worthwhile(
        self,
        number: int,
        frames: Int[np.ndarray, "k"],
        distances: Float[np.ndarray, "k"],
        covariances: Float[np.ndarray, "k 6 6"],
    ) -> tuple[Int[np.ndarray, "m"], Float[np.ndarray, "m 6 6"]]:
        """Frames that may see the same place and whose motion is known badly, the worst known first."""
        sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[:, :3, :3])[:, -1], 0))
        reach = _NEAR * float(np.median(np.linalg.norm(self._clouds[number].coordinates, axis=1)))
        within = distances <= reach + _DEVIATIONS * sigma
        last = next((edge for edge in reversed(self._edges) if np.any(edge.information)), None)
        known = np.zeros(len(frames)) if last is None else _log_volume(covariances) + _log_volume_of_information(last)
        chosen = within & (known > 6 * np.log(_GAIN))
        order = np.flatnonzero(chosen)[np.argsort(-known[chosen], kind="stable")]
        return frames[order], covariances[order]

    def _registered(self, i: int, j: int, covariance: Float[np.ndarray, "6 6"]) -> Edge | None:
        init = np.linalg.inv(self._poses[i]) @ self._poses[j]
        sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
        given: Any = self._options.max_distance
        if given is None:
            given = default_distances(matching_spacing(self._method, self._clouds[i]), self._clouds[i])
        coarse, fine = given if np.ndim(given) else (given, given)
        options = replace(self._options, max_distance=(max(float(coarse), _DEVIATIONS * sigma), float(fine)))
        return edge_from(i, j, register_pair(self._clouds[j], self._clouds[i], self._method, init, options), loop=True)


def _log_volume(covariances: Float[np.ndarray, "k 6 6"]) -> Float[np.ndarray, "k"]:
    return np.linalg.slogdet(covariances)[1]


def _log_volume_of_information(edge: Edge) -> float:
    """log det of the information within the directions of which the edge knows."""
    values = np.linalg.eigvalsh(np.asarray(edge.information))
    return float(np.log(values[values > 1e-9 * values[-1]]).sum())
