"""Edges from registrations, and loop closure: registration to earlier frames where the sensor returns to a known place.

The covariance of the motion between two frames is summed along the most certain path of edges between them: an upper
bound, without solving for the whole graph.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._local_geometry.cloud_statistics import point_spacing
from mcgicp_jax._math.poses import adjoint, exponential, inverse, logarithm
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pose_graph.edge import Edge
from mcgicp_jax._pose_graph.graph import PoseGraph
from mcgicp_jax._pose_graph.optimize import optimize_poses
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.register_pair import register_pair
from mcgicp_jax._registration.result import RegistrationResult, Status

# Least overlap of a registration that becomes an edge: with less, a wrong local minimum looks like a right one.
LEAST_OVERLAP_OF_LOOP = 0.4
# Standard deviation assumed along unconstrained directions: the length of the motion, and at least this number of point
# spacings, the default coarse distance. With twice the range instead, loops are sought all over a corridor, whose poses
# slide by 1 m instead of 0.1 m.
_LEAST_ASSUMED = 10.0
# Two frames may close a loop if their distance is at most this many median ranges of the points, plus this many
# standard deviations of the distance (99 % of χ² with three degrees of freedom); the overlap decides. In simulation, a
# range factor of 1 leaves 14 mm in the street instead of 9, and no more in the room.
_RANGES, _DEVIATIONS = 2.0, 3.37
# A loop is tried if the variance of the motion between two frames, the geometric mean over the six directions, is more
# than this multiple of that of a registration.
_GAIN = 4.0
# Squared Mahalanobis distance beyond which a loop contradicts the path: 99 % of χ² with six degrees of freedom.
_CONTRADICTION = 16.8
# All poses are optimised where a loop contradicts the path, or if the number of frames has grown by this factor since
# the last time, so that all optimisations take as long as a few of the last. Other loops move the last pose alone.
_GROWTH = 1.1
# Largest number of registrations per frame.
_TRIES = 2


def edge_from(i: int, j: int, result: RegistrationResult, *, uncertain: bool = False) -> Edge | None:
    """The edge of a registration of cloud j to cloud i, with no information along unconstrained directions. None unless
    the status is CONVERGED or DEGENERATE, the overlap is at least 40 % and the covariance is known."""
    overlap = float(np.asarray(result.overlap))
    if result.status not in (Status.CONVERGED, Status.DEGENERATE) or overlap < LEAST_OVERLAP_OF_LOOP:
        return None
    covariance, directions = np.asarray(result.covariance, np.float64), result.directions
    if directions is None or not np.isfinite(covariance).all():
        return None
    constrained = np.asarray(directions.constrained)
    if not constrained.any():
        return None
    block = np.ix_(constrained, constrained)
    # Coordinates along the six directions: the constrained ones do not depend on the others.
    coordinates = np.linalg.inv(np.asarray(directions.twists, np.float64).T)
    variances, vectors = np.linalg.eigh((coordinates @ covariance @ coordinates.T)[block])
    # The coordinates are lengths. No registration is more precise than the rounding of the points. The covariance of
    # equal clouds is smaller, or even negative by rounding of its own.
    radius = np.asarray(directions.radius)
    rounding = np.finfo(radius.dtype).eps * float(radius)
    information = np.zeros((6, 6))
    information[block] = (vectors / np.maximum(variances, rounding**2)) @ vectors.T
    information = coordinates.T @ information @ coordinates
    return Edge(i, j, result.matrix, 0.5 * (information + information.T), uncertain=uncertain)


class Trajectory:
    """The poses of a sensor, its clouds, and the edges between them, extended frame by frame."""

    def __init__(self, method: AbstractMethod, options: Options):
        self._method, self._options = method, options
        self._clouds: list[PointCloud] = []
        self._poses = np.zeros((0, 4, 4))
        self._edges: list[Edge] = []
        # Row of the edge between two frames, in either order.
        self._edge_between: dict[tuple[int, int], int] = {}
        # For each edge: its frames, its covariance for twists of frame j and of the world, and the geometric mean of
        # the variances over the six directions.
        self._ends = np.zeros((2, 0), np.int32)
        self._covariances = np.zeros((0, 6, 6))
        self._world_covariances = np.zeros((0, 6, 6))
        self._variances = np.zeros(0)
        # The last such mean of an edge with information; 0 before there is one.
        self._usual_variance = 0.0
        # For each edge, whether the last optimisation accepted it or it is newer.
        self._accepted = np.zeros(0, bool)
        # Whether loops were closed since the last optimisation, and the number of frames then.
        self._stale, self._num_optimized = False, 0

    def graph(self, num_frames: int | None = None, num_edges: int | None = None) -> PoseGraph:
        """The poses of the first frames, corrected by the loops so far, and the first edges."""
        if self._stale:
            self._optimize()
        return PoseGraph(self._poses[:num_frames], self._edges[:num_edges])

    @property
    def size(self) -> tuple[int, int]:
        return len(self._clouds), len(self._edges)

    def add(
        self, cloud: PointCloud, pose: Float[np.ndarray, "4 4"], result: RegistrationResult | None
    ) -> Float[np.ndarray, "4 4"]:
        """Add a frame with its registration to the previous one, close a loop if there is one, and return the pose."""
        last = len(self._clouds)
        self._clouds.append(cloud)
        self._poses = np.concatenate([self._poses, pose[None]])
        if result is not None:
            edge = edge_from(last - 1, last, result)
            if edge is None:
                # The assumed motion becomes an edge without information, which connects the poses.
                edge = Edge(last - 1, last, inverse(self._poses[-2]) @ pose, np.zeros((6, 6)))
            self._connect(edge)
            self._close_loop(last)
        # A view would keep the poses of all frames until then in memory.
        return self._poses[-1].copy()

    def _connect(self, edge: Edge) -> None:
        i, j, information = int(edge.i), int(edge.j), np.asarray(edge.information)
        # A lost frame may be anywhere within twice the range of the sensor, turned by half a turn.
        range_j = self._range(j)
        deviations = range_j, np.pi
        if information.any():
            spacing = float(point_spacing(self._clouds[j]))
            size = max(float(np.linalg.norm(edge.T_i_j[:3, 3])), _LEAST_ASSUMED * spacing)
            deviations = size, size / range_j
        assumed = np.repeat(deviations, 3) ** -2.0
        covariance = np.linalg.inv(information + np.diag(assumed))
        variance = float(np.exp(np.linalg.slogdet(covariance)[1] / 6))
        self._edge_between[i, j] = self._edge_between[j, i] = len(self._edges)
        self._edges.append(edge)
        self._ends = np.append(self._ends, np.array([[i], [j]], np.int32), axis=1)
        self._covariances = np.append(self._covariances, covariance[None], axis=0)
        world_covariance = _transported(covariance, self._poses[j])
        self._world_covariances = np.append(self._world_covariances, world_covariance[None], axis=0)
        self._variances = np.append(self._variances, variance)
        self._accepted = np.append(self._accepted, True)
        if information.any():
            self._usual_variance = variance

    def _range(self, frame: int) -> float:
        return _RANGES * float(np.median(np.linalg.norm(self._clouds[frame].coordinates, axis=1)))

    def _close_loop(self, last: int) -> None:
        """Register the last frame to a near one if the motion between them is uncertain, and correct the poses."""
        from scipy.sparse.csgraph import dijkstra

        edges = self._variances[self._accepted], self._ends[:, self._accepted]
        graph = coo_array(edges, (last + 1, last + 1)).tocsr()
        variances, predecessors = dijkstra(graph, directed=False, indices=last, return_predecessors=True)
        distances = np.linalg.norm(self._poses[:, :3, 3] - self._poses[last, :3, 3], axis=1)
        distances[variances <= _GAIN * self._usual_variance] = np.inf
        # The nearest frame in each range of gaps: the nearest ones of all would be the latest ones of a slow sensor.
        nearest = [rows.start + int(np.argmin(distances[rows.start : rows.stop])) for rows in rows_before(last)]
        num_tries = 0
        for i in sorted((i for i in nearest if np.isfinite(distances[i])), key=lambda i: -variances[i]):
            path = [i]
            while path[-1] != last:
                path.append(int(predecessors[path[-1]]))
            rows = [self._edge_between[ends] for ends in itertools.pairwise(path)]
            covariance = _transported(np.sum(self._world_covariances[rows], axis=0), inverse(self._poses[last]))
            sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
            if distances[i] > self._range(last) + _DEVIATIONS * sigma:
                continue
            # The coarse `max_distance` covers the uncertainty of the motion.
            options = replace(self._options, min_coarse_distance=_DEVIATIONS * sigma)
            init = inverse(self._poses[i]) @ self._poses[last]
            result = register_pair(self._clouds[last], self._clouds[i], self._method, init, options)
            edge = edge_from(i, last, result, uncertain=True)
            num_tries += 1
            if edge is not None:
                self._connect(edge)
                # Correct all poses, or the last one alone. `covariance` is that of the motion without the loop.
                self._stale, pose = True, self._poses[last]
                residual = logarithm(inverse(self._poses[i] @ np.asarray(edge.T_i_j)) @ pose)
                total = covariance + self._covariances[-1]
                contradicts = residual @ np.linalg.solve(total, residual) > _CONTRADICTION
                if contradicts or len(self._poses) >= _GROWTH * self._num_optimized:
                    self._optimize()
                else:
                    gain = np.linalg.solve(total, covariance).T
                    self._poses[last] = pose @ exponential(-gain @ residual)
            if edge is not None or num_tries == _TRIES:
                return

    def _optimize(self) -> None:
        result = optimize_poses(PoseGraph(self._poses, self._edges))
        self._poses, self._accepted = np.array(result.poses), np.asarray(result.kept)
        self._stale, self._num_optimized = False, len(self._poses)
        self._world_covariances = _transported(self._covariances, self._poses[self._ends[1]])


def _transported(
    covariances: Float[np.ndarray, "*m 6 6"], poses: Float[np.ndarray, "*m 4 4"]
) -> Float[np.ndarray, "*m 6 6"]:
    """Covariances of twists of frames, for twists of the world, by the poses of the frames."""
    change = adjoint(poses)
    return change @ covariances @ change.swapaxes(-1, -2)


def rows_before(last: int) -> list[range]:
    """The rows 2 to 3, 4 to 7, 8 to 15, … before the last one."""
    gaps = [2**octave for octave in range(1, last.bit_length())]
    return [range(max(last + 1 - 2 * gap, 0), last + 1 - gap) for gap in gaps]
