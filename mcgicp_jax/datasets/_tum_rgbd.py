"""The TUM RGB-D data set."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mcgicp_jax import io
from mcgicp_jax._cloud import PointCloud
from mcgicp_jax.datasets._frame import AbstractFrames, Frame
from mcgicp_jax.datasets._images import back_project, look_up, read_depth, read_image

# Focal lengths and centre, pixels, of the three cameras and of others with the drivers' default.
_CAMERAS = {
    "1": ((517.3, 516.5), (318.6, 255.3)),
    "2": ((520.9, 521.0), (325.1, 249.7)),
    "3": ((535.4, 539.2), (320.1, 247.6)),
}
_OTHER_CAMERA = ((525.0, 525.0), (319.5, 239.5))
_DEPTH_UNIT = 1 / 5000
# Seconds: between a depth image and its colour image; and between the poses on either side of it.
_MAX_DIFFERENCE, _MAX_GAP = 0.02, 0.1


def tum_rgbd(folder: str | os.PathLike[str]) -> TUMFrames:
    """A sequence of the TUM RGB-D data set (Sturm et al. 2012), such as `rgbd_dataset_freiburg1_xyz`.

    It has `depth.txt` and `rgb.txt`, lines of a time stamp and the name of a file, and may have `groundtruth.txt`. To
    every depth image belongs the colour image nearest in time; depth images without one within 20 ms are left out. The
    pose is interpolated between the two measured around it, and None where they are more than 0.1 s apart. The camera
    is told by freiburg1, 2 or 3 in the name of the folder; otherwise it is the drivers' default.

    Returns:
        Frames of the camera (x right, y down, z ahead), all pixels with a depth, channels red, green and blue from 0 to
        1. Colour images of this data set fit the depth images pixel by pixel.

    Raises:
        OSError: if a file is missing; an image when its frame is read.
        ValueError: if no two images belong together, or a file is no such file.
    """
    return TUMFrames(Path(folder))


class TUMFrames(AbstractFrames):
    """See `tum_rgbd`."""

    def __init__(self, folder: Path):
        self.folder = folder
        number = re.search(r"(?:freiburg|fr)(\d)", folder.absolute().name)
        self._focal, self._center = _CAMERAS.get(number[1] if number else "", _OTHER_CAMERA)
        times, self._depths = _read_list(folder / "depth.txt")
        color_times, colors = _read_list(folder / "rgb.txt")
        nearest = np.abs(times[:, None] - color_times).argmin(axis=1)
        together = np.abs(times - color_times[nearest]) <= _MAX_DIFFERENCE
        if not together.any():
            raise ValueError(f"{folder}: expected depth and colour images within {_MAX_DIFFERENCE} s, found none")
        self._times = times[together]
        self._depths = [self._depths[row] for row in np.flatnonzero(together)]
        self._colors = [colors[row] for row in nearest[together]]
        truth = folder / "groundtruth.txt"
        # Poses are read first: they name the file where it is none.
        poses = io.read_poses(truth) if truth.is_file() else None
        self._truth = None if poses is None else (np.loadtxt(truth, usecols=0, ndmin=1), poses)

    def __len__(self) -> int:
        return len(self._times)

    def _frame(self, index: int) -> Frame:
        depth = read_depth(self.folder / self._depths[index]) * _DEPTH_UNIT
        points, pixels = back_project(depth, self._focal, self._center)
        colors, _ = look_up(read_image(self.folder / self._colors[index]), pixels)
        cloud = PointCloud(points.astype(np.float32), colors.astype(np.float32), channel_names=("red", "green", "blue"))
        return Frame(cloud, self._pose(self._times[index]), float(self._times[index]))

    def _pose(self, time: float) -> Float[np.ndarray, "4 4"] | None:
        if self._truth is None:
            return None
        times, poses = self._truth
        after = int(np.searchsorted(times, time))
        if after < len(times) and times[after] == time:
            return poses[after]
        if not 0 < after < len(times) or times[after] - times[after - 1] > _MAX_GAP:
            return None
        share = (time - times[after - 1]) / (times[after] - times[after - 1])
        pose = (1 - share) * poses[after - 1] + share * poses[after]
        # The rotation nearest to the mean of two: within a tenth of a second, the one in between.
        left, _, right = np.linalg.svd(pose[:3, :3])
        pose[:3, :3] = left @ right
        return pose


def _read_list(path: Path) -> tuple[Float[np.ndarray, "N"], list[str]]:
    """Time stamps, and the files beside them."""
    rows = [line.split() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    try:
        return np.array([float(time) for time, _ in rows]), [name for _, name in rows]
    except ValueError as error:
        raise ValueError(f"{path}: expected lines of a time stamp and a file name: {error}") from error
