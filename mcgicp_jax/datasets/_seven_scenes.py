"""The RGB-D data set 7-Scenes."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from mcgicp_jax import io
from mcgicp_jax._clouds.point_cloud import Frame, PointCloud
from mcgicp_jax.datasets._frames import AbstractFrames
from mcgicp_jax.datasets._images import back_project, look_up, read_depth, read_image

# Pixels: focal lengths of the depth and colour cameras, and their common principal point.
_DEPTH_FOCAL, _COLOR_FOCAL, _CENTER = 585.0, 525.0, (320.0, 240.0)
# Transform from the depth to the colour camera, (3, 4), metres, which the data set does not include: the calibration of
# a Kinect that is generally used with it (LIRIS). With it the colours of two frames at their true poses differ by 24 %
# less than if depth and colour images are taken to be aligned pixel by pixel.
_TO_COLOR = np.array(
    [
        [9.9996518012567637e-01, 2.6765126468950343e-03, -7.9041012313000904e-03, -2.5558943178152542e-02],
        [-2.7409311281316700e-03, 9.9996302803027592e-01, -8.1504520778013286e-03, 1.0109636268061706e-04],
        [7.8819942130445332e-03, 8.1718328771890631e-03, 9.9993554558014031e-01, 2.0318321729487039e-03],
    ]
)
# Seconds between frames.
_PERIOD = 1 / 30
# Value of pixels without depth.
_NO_DEPTH = 65535


def seven_scenes(folder: str | os.PathLike[str]) -> SevenScenesFrames:
    """A sequence of 7-Scenes (Shotton et al. 2013), such as `redkitchen/seq-03`.

    Args:
        folder: contains `frame-XXXXXX.depth.png`, `.color.png` (or `.jpg`) and `.pose.txt`. Times follow from the
            frame number at 30 Hz.

    Returns:
        Frames of the depth camera (x right, y down, z ahead), one point per pixel with a depth, with the channels red,
        green and blue, from 0 to 1. The colour camera is offset by 26 mm; colours are looked up with a generic
        calibration of the sensor, accurate to a few pixels, and valid where a point projects into the colour image.

    Raises:
        OSError: if a file is missing, when its frame is read.
        ValueError: if there are no frames, or a file has the wrong format.
    """
    return SevenScenesFrames(Path(folder))


class SevenScenesFrames(AbstractFrames):
    """See `seven_scenes`."""

    def __init__(self, folder: Path):
        self._depths = sorted(folder.glob(f"frame-{6 * '[0-9]'}.depth.png"))
        if not self._depths:
            raise ValueError(f"{folder}: expected images frame-XXXXXX.depth.png, found none")
        super().__init__(len(self._depths))

    def _frame(self, index: int) -> Frame:
        path = self._depths[index]
        name = path.name.removesuffix(".depth.png")
        depth = read_depth(path)
        metres = np.where(depth == _NO_DEPTH, 0, depth) / 1000
        points, _ = back_project(metres, (_DEPTH_FOCAL, _DEPTH_FOCAL), _CENTER)
        in_camera = points @ _TO_COLOR[:, :3].T + _TO_COLOR[:, 3]
        pixels = _COLOR_FOCAL * in_camera[:, :2] / in_camera[:, 2:] + _CENTER
        file = path.with_name(f"{name}.color.png")
        image = read_image(file if file.is_file() else file.with_suffix(".jpg"))
        colors, inside = look_up(image, pixels)
        cloud = PointCloud(
            points.astype(np.float32),
            colors.astype(np.float32),
            channel_valid=np.repeat(inside[:, None], 3, axis=1),
            channel_names=("red", "green", "blue"),
        )
        poses = io.read_poses(path.with_name(f"{name}.pose.txt"))
        time = _PERIOD * int(name.removeprefix("frame-"))
        return Frame(cloud, poses[0], time, image, np.where(inside[:, None], pixels, np.nan))
