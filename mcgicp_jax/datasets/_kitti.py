"""The KITTI odometry data set."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mcgicp_jax import io
from mcgicp_jax._clouds.point_cloud import Frame, PointCloud
from mcgicp_jax.datasets._frames import AbstractFrames
from mcgicp_jax.datasets._images import Picture, look_up, read_image


def kitti(folder: str | os.PathLike[str]) -> KITTIFrames:
    """A sequence of the KITTI odometry data set (Geiger et al. 2012), such as `dataset/sequences/04`.

    Args:
        folder: contains `velodyne/*.bin`, `calib.txt`, `times.txt` and optionally `image_2/*.png`, the left colour
            camera. Known poses are in `dataset/poses/04.txt`.

    Returns:
        Frames of the Velodyne (x ahead, y left, z up) with the channel intensity, from 0 to 0.99, and, if there are
        images, red, green and blue, from 0 to 1. Colours are valid where a point projects into the image, about a sixth
        of a scan; points occluded from the camera are not detected. Poses map the Velodyne to the world, the
        frame of camera 0 at the start.

    Raises:
        OSError: if a file is missing; for a scan or image, when its frame is read.
        ValueError: if there are no scans, or a file has the wrong format.
    """
    return KITTIFrames(Path(folder))


class KITTIFrames(AbstractFrames):
    """See `kitti`."""

    def __init__(self, folder: Path):
        self.folder = folder
        # Scans, images, times and poses are matched by number, since a copy may contain only some of the scans.
        self._scans = sorted(scan for scan in (folder / "velodyne").glob("*.bin") if scan.stem.isdecimal())
        if not self._scans:
            raise ValueError(f"{folder}: expected scans in velodyne/*.bin, found none")
        super().__init__(len(self._scans))
        calibration = _read_calibration(folder / "calib.txt")
        # Transform from the Velodyne to camera 0, and projection to the pixels of camera 2.
        self._to_camera = np.vstack([calibration["Tr"], [0, 0, 0, 1]])
        self._projection = calibration["P2"] @ self._to_camera
        self._times = _read_times(folder / "times.txt")
        poses = folder.absolute().parents[1] / "poses" / f"{folder.absolute().name}.txt"
        self._poses = io.read_poses(poses) if poses.is_file() else None
        self._colored = (folder / "image_2").is_dir()

    def _frame(self, index: int) -> Frame:
        scan = self._scans[index]
        number = int(scan.stem)
        cloud = io.read(scan)
        image = pixels = None
        if self._colored:
            image = read_image(self.folder / "image_2" / f"{scan.stem}.png")
            cloud, pixels = self._paint(cloud, image)
        pose = None
        if self._poses is not None and number < len(self._poses):
            pose = np.linalg.inv(self._to_camera) @ self._poses[number] @ self._to_camera
        time = float(self._times[number]) if number < len(self._times) else None
        return Frame(cloud, pose, time, image, pixels)

    def _paint(self, cloud: PointCloud, image: Picture) -> tuple[PointCloud, Float[np.ndarray, "N 2"]]:
        """Append the colours of the image as channels; with the pixels, NaN outside of the image."""
        homogeneous = cloud.points @ self._projection[:, :3].T + self._projection[:, 3]
        ahead = homogeneous[:, 2:] > 0
        pixels = np.where(ahead, homogeneous[:, :2] / np.where(ahead, homogeneous[:, 2:], 1), -1)
        colors, inside = look_up(image, pixels)
        valid = np.column_stack([np.ones(len(inside), bool), *[inside] * 3])
        painted = PointCloud(
            cloud.points,
            np.hstack([cloud.channels, colors.astype(np.float32)]),
            channel_valid=valid,
            channel_names=("intensity", "red", "green", "blue"),
        )
        return painted, np.where(inside[:, None], pixels, np.nan)


def _read_times(path: Path) -> Float[np.ndarray, "N"]:
    """Read the times in seconds, one per line."""
    try:
        return np.array(path.read_text().split(), float)
    except ValueError as error:
        raise ValueError(f"{path}: expected a number of seconds in each line: {error}") from error


def _read_calibration(path: Path) -> dict[str, Float[np.ndarray, "3 4"]]:
    """Read the 3×4 matrices of calib.txt by name."""
    matrices = {}
    for line in path.read_text().splitlines():
        name, _, numbers = line.partition(":")
        try:
            values = np.array(numbers.split(), float)
        except ValueError:
            continue  # such as the date of a calibration
        if values.size == 12:
            matrices[name] = values.reshape(3, 4)
    for name in ("P2", "Tr"):
        if name not in matrices:
            raise ValueError(f"{path}: expected a line {name}: with 12 numbers, found {', '.join(matrices) or 'none'}")
    return matrices
