"""Sequences of frames: synthetic scenes with exact poses, and readers of public data sets."""

from mcgicp_jax._clouds.point_cloud import Frame
from mcgicp_jax.datasets._box_room import box_room
from mcgicp_jax.datasets._frames import AbstractFrames, SyntheticFrames
from mcgicp_jax.datasets._lidar import ford_campus, kitti
from mcgicp_jax.datasets._poster_wall import poster_wall
from mcgicp_jax.datasets._registry import DATASETS, CloudFiles, Dataset, clouds
from mcgicp_jax.datasets._rgbd import seven_scenes, tum_rgbd
from mcgicp_jax.datasets._street import street

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
