"""Sequences of frames: synthetic scenes with exact poses, and readers of public data sets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mcgicp_jax._clouds.point_cloud import Frame
from mcgicp_jax.datasets._box_room import box_room
from mcgicp_jax.datasets._frames import AbstractFrames, CloudFiles, SyntheticFrames, clouds
from mcgicp_jax.datasets._lidar import ford_campus, kitti
from mcgicp_jax.datasets._poster_wall import poster_wall
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


@dataclass(frozen=True)
class Dataset:
    """A data set, or a simulated scene, with options of `odometry` that suit its sensor and its motion.

    Attributes:
        frames: function of the folder of a sequence; of the number of frames if `simulated`.
        max_distance: metres, while the pose is being found and when it is refined.
        simulated: whether it is a simulated scene.
    """

    frames: Callable[[Any], AbstractFrames]
    max_distance: tuple[float, float]
    simulated: bool = False


DATASETS = {
    "kitti": Dataset(kitti, (2.5, 0.6)),
    "ford": Dataset(ford_campus, (2.5, 0.6)),
    "tum": Dataset(tum_rgbd, (0.2, 0.06)),
    "7-scenes": Dataset(seven_scenes, (0.2, 0.06)),
    "street": Dataset(street, (2.0, 0.5), simulated=True),
    "box-room": Dataset(box_room, (0.5, 0.25), simulated=True),
    "poster-wall": Dataset(poster_wall, (0.1, 0.04), simulated=True),
}
