"""Sequences of frames: synthetic scenes with exact poses, and readers of public data sets."""

from mcgicp_jax._clouds.point_cloud import Frame
from mcgicp_jax.datasets._box_room import box_room
from mcgicp_jax.datasets._ford import ford_campus
from mcgicp_jax.datasets._frames import AbstractFrames, SyntheticFrames
from mcgicp_jax.datasets._kitti import kitti
from mcgicp_jax.datasets._poster_wall import poster_wall
from mcgicp_jax.datasets._registry import DATASETS, CloudFiles, Dataset, clouds
from mcgicp_jax.datasets._seven_scenes import seven_scenes
from mcgicp_jax.datasets._street import street
from mcgicp_jax.datasets._tum_rgbd import tum_rgbd

__all__ = [
    "DATASETS",
    "AbstractFrames",
    "CloudFiles",
    "Dataset",
    "Frame",
    "SyntheticFrames",
    "box_room",
    "clouds",
    "ford_campus",
    "kitti",
    "poster_wall",
    "seven_scenes",
    "street",
    "tum_rgbd",
]
