"""Registration at several voxel sizes, from coarse to fine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._clouds.preprocess import finite_rows, preprocess, with_neighbors
from mcgicp_jax._clouds.voxel_size import NUM_NEIGHBORS
from mcgicp_jax._compute.concrete import numpy_for
from mcgicp_jax._compute.messages import messages_named
from mcgicp_jax._local_geometry.neighborhoods import check_neighbors
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._methods.icp import GICP
from mcgicp_jax._methods.ndt import voxel_gaussians
from mcgicp_jax._registration.pose_derivative import Inputs

# Edge of the voxels in edges of a cell, at all scales but the last, where GICP registers the voxels. Cells against
# cells would pull partially overlapping clouds over each other: from 1.3 m and 10° off, two views of a yard with an
# overlap of three quarters ended 4 m off, and GICP ends at 0 m. On KITTI, from 5 m and 30° off, GICP found 7 of 8
# poses, cells 4.
_COARSE_VOXEL = 0.25


def at_scales(given: Inputs, voxel_sizes: Sequence[float]) -> Iterator[Inputs]:
    """The inputs of the registrations for these voxel sizes, metres; the last one gives the result.

    Methods that need cells use cells of the last size; for the other sizes, GICP registers smaller voxels. Other
    methods register the voxels of each size, and then the clouds.
    """

    def with_clouds(each: Callable[[str, PointCloud], PointCloud], method: AbstractMethod) -> Inputs:
        return given._replace(source=each("source", given.source), target=each("target", given.target), method=method)

    method = given.method
    if method.needs_covariances and len(voxel_sizes):
        for size in voxel_sizes[:-1]:
            yield with_clouds(partial(_in_voxels, _COARSE_VOXEL * size), GICP())
        yield with_clouds(partial(_in_cells, method, voxel_sizes[-1]), method)
        return
    for size in voxel_sizes:
        yield with_clouds(partial(_smaller, size), method)
    yield given


def _in_cells(method: AbstractMethod, size: float, name: str, cloud: PointCloud) -> PointCloud:
    if name not in method.needs_covariances:
        return cloud
    channel_size: Any = None
    if method.uses_channels:
        # A cell extends as far in α · channel as in position.
        with np.errstate(divide="ignore"):
            channel_size = size / np.asarray(method.weights(cloud.channels.shape[1]), np.float64)
    with messages_named(name):
        return voxel_gaussians(cloud, size, channel_size=channel_size)


def _in_voxels(size: float, name: str, cloud: PointCloud) -> PointCloud:
    with messages_named(name):
        return with_neighbors(finite_rows(cloud), size, NUM_NEIGHBORS)


def _smaller(size: float, _: str, cloud: PointCloud) -> PointCloud:
    return preprocess(cloud, size, check_neighbors(cloud, numpy_for(cloud)).shape[-1])
