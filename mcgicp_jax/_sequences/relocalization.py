"""Relocalisation: lost frames are found again in a map of all frames whose poses are known."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._clouds.preprocess import with_neighbors
from mcgicp_jax._clouds.voxel_map import VoxelMap
from mcgicp_jax._global_pose.global_pose import global_pose
from mcgicp_jax._global_pose.surface_agreement import spreads
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.register_pair import register_pair
from mcgicp_jax._registration.result import RegistrationResult, Status, is_usable
from mcgicp_jax._search.kd_tree import nearest_in_position

# Fraction of the previous overlap below which a frame is also looked for in the map. At constant speed the overlap
# hardly changes; after jumps in simulated rooms and streets and on KITTI it fell to 0.5 to 0.7 of the previous one.
_DOUBTFUL = 0.8
# Multiple of the previous misfit above which a pose is wrong. On KITTI and 7-Scenes and in simulated rooms, streets and
# corridors, right poses had misfits of at most 2.9 and 1.3 times the one before; after jumps to a street that was never
# seen, misfits were 6.3 to 23, and at least 2.7 times the one before.
_WRONG = 2.0
# Misfit of a right pose if both clouds are equally noisy: √2 times the 90 % quantile of |x| for normal x. A sensor at
# rest that repeats its frames has less.
_LEAST_MISFIT = 2.3
# Number of points whose misfit is measured; a match is on the same surface if it is within this multiple of the
# standard deviation of the neighbourhood along the surface.
_SAMPLE, _WITHIN = 2048, 3.0


class Relocalizer:
    """A map of all frames whose poses are known, in which a lost frame is found again.

    Attributes:
        is_lost: whether tracking is lost at the last frame.
    """

    def __init__(self, voxel_size: float):
        self._world = VoxelMap(voxel_size)
        self._overlap, self._misfit = 0.0, np.inf
        self.is_lost = False

    def corrected(
        self,
        cloud: PointCloud,
        target: PointCloud,
        result: RegistrationResult,
        method: AbstractMethod,
        options: Options,
        num_neighbors: int,
    ) -> RegistrationResult | None:
        """The registration of a frame to the map, in the world's frame, if the given one is doubtful and worse.

        Args:
            target: that of the given registration.
        """
        overlap, misfit = float(np.asarray(result.overlap)), misfit_of(cloud, target, result)
        most = _WRONG * max(self._misfit, _LEAST_MISFIT)
        settled = result.status in (Status.CONVERGED, Status.DEGENERATE) and misfit <= most
        if settled and not self.is_lost and overlap >= _DOUBTFUL * self._overlap:
            self._overlap, self._misfit = overlap, misfit
            return None
        known = self._world.cloud()
        start = global_pose(cloud, known)
        if start.success:
            target = map_target(known, method, options, num_neighbors)
            found = register_pair(cloud, target, method, start.matrix, options)
            if misfit_of(cloud, target, found) <= most and (
                self.is_lost or not settled or float(np.asarray(found.overlap)) > overlap
            ):
                self.is_lost = False
                return found
        self.is_lost = self.is_lost or misfit > most
        if not self.is_lost:
            # Else every frame after a rest of the sensor would be looked for in the map.
            self._overlap, self._misfit = overlap, misfit
        return None

    def add(self, name: str, cloud: PointCloud, pose: Float[np.ndarray, "4 4"]) -> None:
        """Add a frame to the map; `name` is for error messages."""
        self._world.add(name, cloud, pose)


def misfit_of(source: PointCloud, target: PointCloud, result: RegistrationResult) -> float:
    """The 90 % quantile of the distances along normals between matches, in thicknesses of the source's neighbourhoods.

    Parts of the source that the target does not show do not count. Infinite if the pose is not usable.
    """
    if not is_usable(result):
        return np.inf
    points, rows = source.coordinates, np.flatnonzero(np.asarray(source.valid))
    rows = rows[np.random.default_rng(0).integers(0, len(rows), _SAMPLE)]
    thin, along, normals = spreads(points, source.deferred_neighbors, rows)
    matrix, known = np.asarray(result.matrix), target.coordinates[np.asarray(target.valid)]
    moved = points[rows] @ matrix[:3, :3].T + matrix[:3, 3]
    matches = nearest_in_position(moved, known, float(_WITHIN * along.max()))
    residuals = (known[matches] - moved) @ matrix[:3, :3]
    matched = (matches >= 0) & (np.linalg.norm(residuals, axis=1) <= _WITHIN * along)
    across = np.abs(np.sum(residuals * normals, axis=1)) / thin
    return float(np.quantile(across[matched], 0.9)) if matched.any() else np.inf


def map_target(cloud: PointCloud, method: AbstractMethod, options: Options, num_neighbors: int) -> PointCloud:
    """The map as a target: preprocessed, or raw if the method computes voxel cells from it."""
    return cloud if options.takes_raw(method, "target") else with_neighbors(cloud, None, num_neighbors)
