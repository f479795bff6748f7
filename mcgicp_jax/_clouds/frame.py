"""A cloud with the pose and the time of its sensor, and an image if there is one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from mcgicp_jax._clouds.point_cloud import PointCloud


@dataclass(frozen=True, eq=False)
class Frame:
    """A cloud with the pose and the time of the sensor.

    The true relative pose of two frames is `T_target_source = inv(target.pose) @ source.pose`.

    Attributes:
        cloud: in the sensor's frame, metres.
        pose: (4, 4), sensor to world, metres; None if unknown.
        time: seconds from an arbitrary start; None if unknown.
        image: (height, width, 3) red, green and blue from 0 to 255; None if there is none.
        pixels: (N, 2) column and row of each point in the image, NaN where it is outside; None without an image.
    """

    cloud: PointCloud
    pose: Float[np.ndarray, "4 4"] | None = None
    time: float | None = None
    image: UInt8[np.ndarray, "height width 3"] | None = None
    pixels: Float[np.ndarray, "N 2"] | None = None
