"""All data sets and simulated scenes by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mcgicp_jax.datasets._box_room import box_room
from mcgicp_jax.datasets._ford import ford_campus
from mcgicp_jax.datasets._frames import AbstractFrames
from mcgicp_jax.datasets._kitti import kitti
from mcgicp_jax.datasets._poster_wall import poster_wall
from mcgicp_jax.datasets._seven_scenes import seven_scenes
from mcgicp_jax.datasets._street import street
from mcgicp_jax.datasets._tum_rgbd import tum_rgbd


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
