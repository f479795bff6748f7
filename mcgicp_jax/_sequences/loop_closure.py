"""Loop closure: registration to earlier frames where the sensor returns to a known place.

The uncertainty of the motion between two frames is that along the most certain path of edges between them, an upper
bound, for which no equations need to be solved.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._math.poses import adjoint, inverse
from mcgicp_jax._math.twists import logarithm
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pose_graph.edge import Edge
from mcgicp_jax._pose_graph.graph import PoseGraph
from mcgicp_jax._pose_graph.optimize import optimize_poses
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.register_pair import register_pair
from mcgicp_jax._registration.result import RegistrationResult
from mcgicp_jax._sequences.edges import edge_from

# Two frames may close a loop if their distance is at most this many median ranges of the points, plus this many
# standard deviations of the distance (99 % of χ² with three degrees of freedom); the overlap decides. In the benchmark,
# a range factor of 1 leaves 14 mm in the street instead of 9, and no more in the room.
_RANGES, _DEVIATIONS = 2.0, 3.37
# A loop is tried if the motion between two frames is less certain than a registration: its variance is larger by this
# factor, in the geometric mean over the six directions.
_GAIN = 4.0
# Squared Mahalanobis distance of a loop beyond which all poses are optimised at once, and not when they are read: 99 %
# of χ² with six degrees of freedom.
_CONTRADICTION = 16.8
# Largest number of registrations per frame.
_TRIES = 2


class Trajectory:
    """The poses of a sensor, its clouds, and the edges between them, extended frame by frame."""

    def __init__(self, method: AbstractMethod, options: Options):
        self._method, self._options = method, options
        self._clouds: list[PointCloud] = []
        self._poses = np.zeros((0, 4, 4))
        self._edges: list[Edge] = []
        # Of each edge, its frames, its covariance and its geometric mean over the six directions.
        self._ends: list[tuple[int, int]] = []
        self._covariances: list[Float[np.ndarray, "6 6"]] = []
        self._variances: list[float] = []
        # Which edges the last optimisation kept; later ones are.
        self._kept = np.zeros(0, bool)
        # Whether loops were closed since the last optimisation.
        self._stale = False
        self._between: dict[tuple[int, int], int] = {}

    def graph(self, num_frames: int | None = None, num_edges: int | None = None) -> PoseGraph:
        """The poses of the first frames, corrected by the loops so far, and the first edges."""
        self._optimize()
        return PoseGraph(self._poses[:num_frames], self._edges[:num_edges])

    @property
    def size(self) -> tuple[int, int]:
        """The numbers of frames and edges."""
        return len(self._clouds), len(self._edges)

    def add(
        self, cloud: PointCloud, pose: Float[np.ndarray, "4 4"], result: RegistrationResult | None
    ) -> Float[np.ndarray, "4 4"]:
        """Add a frame with its registration to the previous one, close loops with earlier ones, and return its pose."""
        number = len(self._clouds)
        self._clouds.append(cloud)
        self._poses = np.concatenate([self._poses, pose[None]])
        if result is not None:
            edge = edge_from(number - 1, number, result)
            if edge is None:
                # The assumed motion becomes an edge without information, which connects the poses.
                edge = Edge(number - 1, number, inverse(self._poses[-2]) @ pose, np.zeros((6, 6)))
            self._connect(edge)
            loop = self._loop(number)
            if loop is not None:
                self._connect(loop)
                self._stale = True
                residual = logarithm(inverse(np.asarray(loop.T_i_j)) @ inverse(self._poses[int(loop.i)]) @ pose)
                if residual @ loop.information @ residual > _CONTRADICTION:
                    self._optimize()
        return self._poses[-1]

    def _optimize(self) -> None:
        if self._stale:
            found = optimize_poses(PoseGraph(self._poses, self._edges))
            self._poses, self._kept, self._stale = np.asarray(found.poses), np.asarray(found.kept), False

    def _connect(self, edge: Edge) -> None:
        i, j = int(edge.i), int(edge.j)
        # An assumed motion is right to the reach of the sensor and to half a turn.
        least = np.repeat([self._reach(j), np.pi], 3) ** -2.0
        self._ends.append((i, j))
        self._between[i, j] = self._between[j, i] = len(self._edges)
        self._edges.append(edge)
        self._covariances.append(np.linalg.inv(np.asarray(edge.information) + np.diag(least)))
        self._variances.append(float(np.exp(np.linalg.slogdet(self._covariances[-1])[1] / 6)))

    def _reach(self, frame: int) -> float:
        return _RANGES * float(np.median(np.linalg.norm(self._clouds[frame].coordinates, axis=1)))

    def _loop(self, number: int) -> Edge | None:
        """An edge to an earlier frame nearby, if the motion between the two is less certain than a registration."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import dijkstra

        kept = np.append(self._kept, np.ones(len(self._edges) - len(self._kept), bool))
        edges = np.array(self._variances)[kept], np.array(self._ends)[kept].T
        graph = coo_array(edges, (number + 1, number + 1)).tocsr()
        variances, before = dijkstra(graph, directed=False, indices=number, return_predecessors=True)
        informed = (k for k in reversed(range(len(self._edges))) if np.any(self._edges[k].information))
        usual = self._variances[next(informed, 0)]
        distances = np.linalg.norm(self._poses[:, :3, 3] - self._poses[number, :3, 3], axis=1)
        tries = 0
        for i in _candidates(variances > _GAIN * usual, distances, variances):
            sigma = self._deviation(number, i, before)
            if distances[i] <= self._reach(number) + _DEVIATIONS * sigma:
                edge = self._registered(i, number, sigma)
                tries += 1
                if edge is not None or tries == _TRIES:
                    return edge
        return None

    def _deviation(self, number: int, i: int, before: Int[np.ndarray, "n"]) -> float:
        """Largest standard deviation of the position of a frame in the frame of another, metres."""
        path = [i]
        while path[-1] != number:
            path.append(int(before[path[-1]]))
        rows = [self._between[ends] for ends in itertools.pairwise(path)]
        ends = [self._ends[row][1] for row in rows]
        moved = adjoint(inverse(self._poses[number]) @ self._poses[ends])[:, :3]
        total = np.einsum("mij,mjk,mlk->il", moved, np.array([self._covariances[row] for row in rows]), moved)
        return float(np.sqrt(np.linalg.eigvalsh(total)[-1]))

    def _registered(self, i: int, j: int, sigma: float) -> Edge | None:
        """The edge of a registration whose coarse `max_distance` covers the uncertainty of the motion."""
        init = inverse(self._poses[i]) @ self._poses[j]
        options = replace(self._options, reach=_DEVIATIONS * sigma)
        result = register_pair(self._clouds[j], self._clouds[i], self._method, init, options)
        return edge_from(i, j, result, uncertain=True)


def _candidates(
    chosen: Bool[np.ndarray, "n"], distances: Float[np.ndarray, "n"], variances: Float[np.ndarray, "n"]
) -> list[int]:
    """Of the chosen frames 2 to 3, 4 to 7, 8 to 15, ... before the last one, the nearest; the least certain ones first.

    The nearest frames of all would be the latest ones of a slow sensor.
    """
    last = len(chosen) - 1
    found = []
    for gap in (2**octave for octave in range(1, last.bit_length())):
        rows = np.arange(max(last + 1 - 2 * gap, 0), last + 1 - gap)
        rows = rows[chosen[rows]]
        if len(rows):
            found.append(int(rows[np.argmin(distances[rows])]))
    return sorted(found, key=lambda row: -variances[row])
