"""The RGB-D data sets TUM and 7-Scenes."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped
from scipy.spatial.transform import Rotation, Slerp

from mcgicp_jax import io
from mcgicp_jax._clouds.depth_images import back_project
from mcgicp_jax._clouds.point_cloud import Frame, PointCloud
from mcgicp_jax.datasets._frames import AbstractFrames, colored_cloud, look_up, pose_of, read_depth, read_image

# Pixels: focal lengths and principal point of the three calibrated cameras, and the default of the camera driver.
_CAMERAS = {"1": (517.3, 516.5, 318.6, 255.3), "2": (520.9, 521.0, 325.1, 249.7), "3": (535.4, 539.2, 320.1, 247.6)}
_OTHER_CAMERA = (525.0, 525.0, 319.5, 239.5)
# Units of the depth images per metre.
_DEPTH_SCALE = 5000
# Seconds: maximum difference between a depth image and its colour image, and maximum gap between two measured poses.
_MAX_DIFFERENCE, _MAX_GAP = 0.02, 0.1
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


def tum_rgbd(folder: str | os.PathLike[str]) -> TUMFrames:
    """A sequence of the TUM RGB-D data set (Sturm et al. 2012), such as `rgbd_dataset_freiburg1_xyz`.

    Each depth image is combined with the colour image nearest in time; depth images without one within 20 ms are left
    out. The pose is interpolated between the measured poses before and after it, and None if these are more than 0.1 s
    apart.

    Args:
        folder: contains `depth.txt` and `rgb.txt`, lines of time stamp and file name, and optionally `groundtruth.txt`.
            freiburg1, 2 or 3 in its name selects the camera calibration; otherwise it is the default of the driver.

    Returns:
        Frames of the camera (x right, y down, z ahead), one point per pixel with a depth, with the channels red, green
        and blue, from 0 to 1. Colour and depth images of this data set are aligned pixel by pixel.

    Raises:
        OSError: if a file is missing; for an image, when its frame is read.
        ValueError: if no depth image has a colour image, or a file has the wrong format.
    """
    return TUMFrames(Path(folder))


class TUMFrames(AbstractFrames):
    """See `tum_rgbd`."""

    def __init__(self, folder: Path):
        self.folder = folder
        number = re.search(r"(?:freiburg|fr)(\d)", folder.absolute().name)
        self._camera = _CAMERAS.get(number[1] if number else "", _OTHER_CAMERA)
        times, depths = _read_list(folder / "depth.txt")
        color_times, colors = _read_list(folder / "rgb.txt")
        nearest = np.abs(times[:, None] - color_times).argmin(axis=1)
        colored = np.abs(times - color_times[nearest]) <= _MAX_DIFFERENCE
        if not colored.any():
            raise ValueError(f"{folder}: expected depth and colour images within {_MAX_DIFFERENCE} s, found none")
        self._times = times[colored]
        super().__init__(len(self._times))
        self._depths, self._colors = depths[colored], colors[nearest[colored]]
        truth = folder / "groundtruth.txt"
        self._pose_times, self._poses = np.empty(0), np.empty((0, 4, 4))
        if truth.is_file():
            # read_poses runs before loadtxt because its errors name the file.
            self._poses = io.read_poses(truth)
            self._pose_times = np.loadtxt(truth, usecols=0, ndmin=1)

    def _frame(self, index: int) -> Frame:
        depth = read_depth(self.folder / self._depths[index])
        image = read_image(self.folder / self._colors[index])
        cloud = PointCloud.from_depth(depth, self._camera, image, scale=_DEPTH_SCALE)
        _, pixels = back_project(depth, self._camera)
        # The measured pose, or one interpolated between the two around the time if there is no gap.
        time, times, poses, pose = float(self._times[index]), self._pose_times, self._poses, None
        after = int(np.searchsorted(times, time))
        if after < len(times) and times[after] == time:
            pose = poses[after]
        elif 0 < after < len(times) and times[after] - times[after - 1] <= _MAX_GAP:
            around = slice(after - 1, after + 1)
            rotation = Slerp(times[around], Rotation.from_matrix(poses[around, :3, :3]))(time)
            pose = pose_of(rotation, [np.interp(time, times[around], values) for values in poses[around, :3, 3].T])
        return Frame(cloud, pose, time, image, pixels)


def _read_list(path: Path) -> tuple[Float[np.ndarray, "N"], Shaped[np.ndarray, "N"]]:
    """Time stamps in seconds, and file names."""
    rows = [line.split() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    if not rows:
        raise ValueError(f"{path}: expected lines of a time stamp and a file name, found none")
    try:
        return np.array([float(time) for time, _ in rows]), np.array([name for _, name in rows])
    except ValueError as error:
        raise ValueError(f"{path}: expected lines of a time stamp and a file name: {error}") from error


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
        points, _ = back_project(read_depth(path), (_DEPTH_FOCAL, _DEPTH_FOCAL, *_CENTER))
        in_camera = points @ _TO_COLOR[:, :3].T + _TO_COLOR[:, 3]
        pixels = _COLOR_FOCAL * in_camera[:, :2] / in_camera[:, 2:] + _CENTER
        file = path.with_name(f"{name}.color.png")
        image = read_image(file if file.is_file() else file.with_suffix(".jpg"))
        colors, inside = look_up(image, pixels)
        cloud = colored_cloud(points.astype(np.float32), colors, inside)
        poses = io.read_poses(path.with_name(f"{name}.pose.txt"))
        time = _PERIOD * int(name.removeprefix("frame-"))
        return Frame(cloud, poses[0], time, image, np.where(inside[:, None], pixels, np.nan))
