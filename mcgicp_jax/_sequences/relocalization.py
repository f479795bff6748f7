"""Relocalisation: lost frames are found again in a map of all frames whose poses are known."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._clouds.preprocess import with_neighbors
from mcgicp_jax._clouds.voxel_map import VoxelMap
from mcgicp_jax._global_pose.global_pose import global_pose
from mcgicp_jax._local_geometry.surface_agreement import spreads
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.register_pair import register_pair
from mcgicp_jax._registration.result import RegistrationResult, Status, is_usable
from mcgicp_jax._search.kd_tree import nearest_in_position

# Fraction of the previous overlap below which a frame is also looked for in the map: at constant speed the overlap
# hardly changes, and jumps in simulated scenes and on KITTI lower it to 0.5 to 0.7.
_DOUBTFUL = 0.8
# Multiple of the previous misfit above which a pose is wrong. On KITTI, 7-Scenes and simulated scenes, it was at most
# 1.3 at right poses, and at least 2.7 after jumps to a street that was never seen.
_WRONG = 2.0
# Misfit of a right pose if both clouds are equally noisy: √2 times the 90 % quantile of |x| for normal x. A sensor at
# rest that repeats its frames has less.
_LEAST_MISFIT = 2.3
# Number of points whose misfit is measured; and largest distance of a match on the same surface, in standard deviations
# of the neighbourhood along the surface.
_SAMPLE, _SAME_SURFACE = 2048, 3.0


class Relocalizer:
    """A map of all frames whose poses are known. `is_lost`: whether tracking is lost at the last frame."""

    def __init__(self, voxel_size: float, method: AbstractMethod, options: Options, num_neighbors: int):
        self._world, self._settings = VoxelMap(voxel_size), (method, options, num_neighbors)
        self._overlap, self._misfit, self.is_lost = 0.0, np.inf, False

    def add(self, name: str, cloud: PointCloud, pose: Float[np.ndarray, "4 4"]) -> None:
        self._world.add(name, cloud, pose)

    def corrected(self, cloud: PointCloud, target: PointCloud, result: RegistrationResult) -> RegistrationResult | None:
        """The registration of a frame to the map, in the world's frame, if that to the target is doubtful and worse."""
        overlap, misfit = float(np.asarray(result.overlap)), _misfit(cloud, target, result)
        limit = _WRONG * max(self._misfit, _LEAST_MISFIT)
        settled = result.status in (Status.CONVERGED, Status.DEGENERATE) and misfit <= limit
        if self.is_lost or not settled or overlap < _DOUBTFUL * self._overlap:
            world, (method, options, _) = self._world.cloud(), self._settings
            start = global_pose(cloud, world)
            if start.success:
                target = map_target(world, *self._settings)
                to_map = register_pair(cloud, target, method, start.matrix, options)
                better = self.is_lost or not settled or float(np.asarray(to_map.overlap)) > overlap
                if better and _misfit(cloud, target, to_map) <= limit:
                    self.is_lost = False
                    return to_map
            self.is_lost = self.is_lost or misfit > limit
        if not self.is_lost:
            # Even if doubtful: else every frame after a rest of the sensor would be looked for in the map.
            self._overlap, self._misfit = overlap, misfit
        return None


def _misfit(source: PointCloud, target: PointCloud, result: RegistrationResult) -> float:
    """90 % quantile of distances along normals, in thicknesses of neighbourhoods; infinite without matches or pose."""
    if not is_usable(result):
        return np.inf
    points, rows = source.coordinates, np.flatnonzero(np.asarray(source.valid))
    rows = rows[np.random.default_rng(0).integers(0, len(rows), _SAMPLE)]
    thickness, along, normals = spreads(points, source.deferred_neighbors, rows)
    matrix, target_points = np.asarray(result.matrix), target.coordinates[np.asarray(target.valid)]
    moved = points[rows] @ matrix[:3, :3].T + matrix[:3, 3]
    matches = nearest_in_position(moved, target_points, float(_SAME_SURFACE * along.max()))
    residuals = (target_points[matches] - moved) @ matrix[:3, :3]
    matched = (matches >= 0) & (np.linalg.norm(residuals, axis=1) <= _SAME_SURFACE * along)
    across = np.abs(np.sum(residuals * normals, axis=1)) / thickness
    return float(np.quantile(across[matched], 0.9)) if matched.any() else np.inf


def map_target(cloud: PointCloud, method: AbstractMethod, options: Options, num_neighbors: int) -> PointCloud:
    """The map as a target: preprocessed, or raw if the method computes voxel cells from it."""
    return cloud if options.takes_raw(method, "target") else with_neighbors(cloud, None, num_neighbors)
