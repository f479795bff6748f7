"""Relocalisation: lost frames are found again in a map of all frames whose poses are known."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._clouds.preprocess import with_neighbors
from mcgicp_jax._clouds.voxel_map import VoxelMap
from mcgicp_jax._global_pose.global_pose import global_pose
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.register_pair import register_pair
from mcgicp_jax._registration.result import RegistrationResult, Status, is_usable

# Fractions of the previous overlap. At constant speed the overlap hardly changes; after jumps in simulated rooms and
# streets and on KITTI it fell to 0.5 to 0.7 of the previous one. Below the first fraction, the frame is also looked for
# in the map; below the second, tracking is lost if the frame is not found there.
_DOUBTFUL, _LOST = 0.8, 0.5


class Relocalizer:
    """A map of all frames whose poses are known, in which a lost frame is found again.

    Attributes:
        is_lost: whether tracking is lost at the last frame.
    """

    def __init__(self, voxel_size: float):
        self._world = VoxelMap(voxel_size)
        self._overlap = 0.0
        self.is_lost = False

    def corrected(
        self,
        cloud: PointCloud,
        result: RegistrationResult,
        method: AbstractMethod,
        options: Options,
        num_neighbors: int,
    ) -> RegistrationResult | None:
        """The registration of a frame to the map, in the world's frame, if the given one is doubtful and worse."""
        overlap = float(np.asarray(result.overlap))
        settled = result.status in (Status.CONVERGED, Status.DEGENERATE)
        if settled and not self.is_lost and overlap >= _DOUBTFUL * self._overlap:
            self._overlap = overlap
            return None
        known = self._world.cloud()
        start = global_pose(cloud, known)
        if start.success:
            target = map_target(known, method, options, num_neighbors)
            found = register_pair(cloud, target, method, start.matrix, options)
            if is_usable(found) and (self.is_lost or not settled or float(np.asarray(found.overlap)) > overlap):
                self.is_lost = False
                return found
        self.is_lost = self.is_lost or not is_usable(result) or overlap < _LOST * self._overlap
        if not self.is_lost:
            # Else every frame after a rest of the sensor would be looked for in the map.
            self._overlap = overlap
        return None

    def add(self, name: str, cloud: PointCloud, pose: Float[np.ndarray, "4 4"]) -> None:
        """Add a frame to the map; `name` is for error messages."""
        self._world.add(name, cloud, pose)


def map_target(cloud: PointCloud, method: AbstractMethod, options: Options, num_neighbors: int) -> PointCloud:
    """The map as a target: preprocessed, or raw if the method computes voxel cells from it."""
    return cloud if options.takes_raw(method, "target") else with_neighbors(cloud, None, num_neighbors)
