"""Loop closure: registration to earlier frames where the sensor returns to a known place."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pose_graph.edge import Edge
from mcgicp_jax._pose_graph.graph import PoseGraph
from mcgicp_jax._pose_graph.optimize import optimize_poses
from mcgicp_jax._pose_graph.solver import motion_covariances
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.register_pair import register_pair
from mcgicp_jax._registration.result import RegistrationResult
from mcgicp_jax._registration.settings import default_distances, matching_spacing
from mcgicp_jax._sequences.edges import edge_from

# Two frames may close a loop if their distance is at most this many median ranges of the points, plus this many
# standard deviations of the distance (99 % of χ² with three degrees of freedom); the overlap decides. In the benchmark,
# a range factor of 1 leaves 14 mm in the street instead of 9, and no more in the room.
_RANGES, _DEVIATIONS = 2.0, 3.37
# A loop is tried if the motion between two frames is less certain than a registration: its variance is larger by this
# factor, in the geometric mean over the six directions.
_GAIN = 4.0
# Number of nearest frames whose uncertainty is computed, and largest number of registrations per frame.
_CANDIDATES, _TRIES = 16, 2


class Trajectory:
    """The poses of a sensor, its clouds, and the edges between them, extended frame by frame.

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
        self, cloud: PointCloud, pose: Float[np.ndarray, "4 4"], result: RegistrationResult | None
    ) -> Float[np.ndarray, "4 4"]:
        """Add a frame with its registration to the previous one, close loops with earlier ones, and return its pose."""
        number = len(self._clouds)
        self._clouds.append(cloud)
        self._poses.append(pose)
        if result is not None:
            edge = edge_from(number - 1, number, result)
            if edge is None:
                # The assumed motion becomes an edge without information, which connects the poses.
                edge = Edge(number - 1, number, np.linalg.inv(self._poses[-2]) @ pose, np.zeros((6, 6)))
            self._edges.append(edge)
            loop = self._loop(number)
            if loop is not None:
                self._edges.append(loop)
                self._poses = list(np.asarray(optimize_poses(self.graph).poses))
        return self._poses[-1]

    def _loop(self, number: int) -> Edge | None:
        """An edge to an earlier frame nearby, if the motion between the two is less certain than a registration."""
        positions = np.array(self._poses)[:, :3, 3]
        distances = np.linalg.norm(positions[: number - 1] - positions[number], axis=1)
        nearest = np.argsort(distances, kind="stable")[:_CANDIDATES]
        if not len(nearest):
            return None
        covariances = motion_covariances(self.graph, nearest, np.full(len(nearest), number))
        rows, covariances = self._worthwhile(number, nearest, distances[nearest], covariances)
        for i, covariance in list(zip(rows, covariances, strict=True))[:_TRIES]:
            edge = self._registered(int(i), number, covariance)
            if edge is not None:
                return edge
        return None

    def _worthwhile(
        self,
        number: int,
        frames: Int[np.ndarray, "k"],
        distances: Float[np.ndarray, "k"],
        covariances: Float[np.ndarray, "k 6 6"],
    ) -> tuple[Int[np.ndarray, "m"], Float[np.ndarray, "m 6 6"]]:
        """The frames that may see the same place and whose motion is uncertain, the most uncertain first."""
        sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[:, :3, :3])[:, -1], 0))
        reach = _RANGES * float(np.median(np.linalg.norm(self._clouds[number].coordinates, axis=1)))
        within = distances <= reach + _DEVIATIONS * sigma
        last = next((edge for edge in reversed(self._edges) if np.any(edge.information)), None)
        gain = np.zeros(len(frames)) if last is None else np.linalg.slogdet(covariances)[1] + _log_information(last)
        chosen = within & (gain > 6 * np.log(_GAIN))
        order = np.flatnonzero(chosen)[np.argsort(-gain[chosen], kind="stable")]
        return frames[order], covariances[order]

    def _registered(self, i: int, j: int, covariance: Float[np.ndarray, "6 6"]) -> Edge | None:
        """The edge of a registration whose coarse `max_distance` covers the uncertainty of the motion."""
        init = np.linalg.inv(self._poses[i]) @ self._poses[j]
        sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
        given: Any = self._options.max_distance
        if given is None:
            given = default_distances(matching_spacing(self._method, self._clouds[i]), self._clouds[i])
        coarse, fine = given if np.ndim(given) else (given, given)
        options = replace(self._options, max_distance=(max(float(coarse), _DEVIATIONS * sigma), float(fine)))
        result = register_pair(self._clouds[j], self._clouds[i], self._method, init, options)
        return edge_from(i, j, result, uncertain=True)


def _log_information(edge: Edge) -> float:
    """log det of the information matrix within its range."""
    values = np.linalg.eigvalsh(np.asarray(edge.information))
    return float(np.log(values[values > 1e-9 * values[-1]]).sum())
