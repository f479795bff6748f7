"""The LiDAR data sets KITTI odometry and Ford Campus."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from scipy.spatial.transform import Rotation

from mcgicp_jax import io
from mcgicp_jax._clouds.point_cloud import Frame
from mcgicp_jax.datasets._frames import AbstractFrames, Colors, Matrix, colored_cloud, look_up, pose_of, read_image

# Pose of the laser in the vehicle's frame: roll, pitch, yaw in radians; x, y, z in metres.
_LASER_IN_VEHICLE = pose_of(Rotation.from_euler("xyz", [np.pi, 0, np.pi / 2]), [2.4, -0.01, -2.3])
# Seconds: the unit of the time stamps.
_MICROSECOND = 1e-6
# Seconds between a scan and its images: half the interval of the cameras, which take about eight images a second.
_MAX_DIFFERENCE = 0.0625


def kitti(folder: str | os.PathLike[str]) -> KITTIFrames:
    """A sequence of the KITTI odometry data set (Geiger et al. 2012), such as `dataset/sequences/04`.

    Args:
        folder: contains `velodyne/*.bin`, `calib.txt`, `times.txt` and optionally `image_2/*.png`, the left colour
            camera. Known poses are in `dataset/poses/04.txt`.

    Returns:
        Frames of the Velodyne (x ahead, y left, z up) with the channel intensity, from 0 to 0.99, and, if there are
        images, red, green and blue, from 0 to 1. Colours are valid where a point projects into the image, about a sixth
        of a scan; points occluded from the camera are not detected. Poses map the Velodyne to the world, the
        frame of the Velodyne at the start.

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
        calibration, matrices = folder / "calib.txt", {}
        for line in calibration.read_text().splitlines():
            name, _, numbers = line.partition(":")
            # Other lines are no matrices, such as the date of the calibration.
            with contextlib.suppress(ValueError):
                matrices[name] = np.array(numbers.split(), float).reshape(3, 4)
        for name in ("P2", "Tr"):
            if name not in matrices:
                names = ", ".join(matrices) or "none"
                raise ValueError(f"{calibration}: expected a line {name}: with 12 numbers, found {names}")
        # Transform from the Velodyne to camera 0, and projection to the pixels of camera 2.
        self.to_camera: Matrix = np.vstack([matrices["Tr"], [0, 0, 0, 1]])
        self._projection = matrices["P2"] @ self.to_camera
        times = folder / "times.txt"
        try:
            self._times = np.array(times.read_text().split(), float)
        except ValueError as error:
            raise ValueError(f"{times}: expected a number of seconds in each line: {error}") from error
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
            # Append the colours as channels; pixels outside of the image are NaN in the frame.
            homogeneous = cloud.points @ self._projection[:, :3].T + self._projection[:, 3]
            ahead = homogeneous[:, 2:] > 0
            pixels = np.where(ahead, homogeneous[:, :2] / np.where(ahead, homogeneous[:, 2:], 1), -1)
            colors, inside = look_up(image, pixels)
            cloud = colored_cloud(cloud.points, colors, inside, cloud.channels)
            pixels = np.where(inside[:, None], pixels, np.nan)
        pose = None
        if self._poses is not None and number < len(self._poses):
            pose = np.linalg.inv(self.to_camera) @ self._poses[number] @ self.to_camera
        time = float(self._times[number]) if number < len(self._times) else None
        return Frame(cloud, pose, time, image, pixels)


def ford_campus(folder: str | os.PathLike[str]) -> FordFrames:
    """A run of the Ford Campus data set (Pandey, McBride & Eustice 2011), such as `IJRR-Dataset-1`.

    Args:
        folder: contains `SCANS/Scan####.mat` and, for colours, `IMAGES/Cam{0..4}/image####.ppm` with `Timestamp.log`,
            the times of the images.

    Returns:
        Frames of the Velodyne with the channels red, green and blue, from 0 to 1, valid where one of the five cameras
        saw the point; none is valid if no images were taken within 62 ms of the scan. Scans regenerated from the raw
        data with reflectance have the channel intensity before these, in the file's unit. Poses map the laser
        to the world (North, East, down); they are computed from the poses of the vehicle.

    Raises:
        OSError: if a file is missing; for a scan or image, when its frame is read.
        ValueError: if there are no scans, or a file has the wrong format.
    """
    return FordFrames(Path(folder))


class FordFrames(AbstractFrames):
    """See `ford_campus`."""

    def __init__(self, folder: Path):
        self.folder = folder
        self._scans = sorted((folder / "SCANS").glob("Scan*.mat"))
        if not self._scans:
            raise ValueError(f"{folder}: expected scans in SCANS/Scan*.mat, found none")
        super().__init__(len(self._scans))
        # Number and time in microseconds of each image.
        self._images = np.empty((0, 2))
        log = folder / "Timestamp.log"
        if log.is_file():
            rows = [line.split()[:2] for line in log.read_text().splitlines() if line[:1].isdigit()]
            if not rows:
                raise ValueError(f"{log}: expected rows of image number and time stamp, found none")
            self._images = np.array(rows, float)

    def _frame(self, index: int) -> Frame:
        import scipy.io

        path = self._scans[index]
        try:
            scan = scipy.io.loadmat(path, simplify_cells=True)["SCAN"]
            points = np.asarray(scan["XYZ"], float).reshape(3, -1).T
            vehicle = np.asarray(scan["X_wv"], float).reshape(6)
            time = float(scan["timestamp_laser"])
            cameras = [scan["Cam"]] if isinstance(scan["Cam"], dict) else list(scan["Cam"])
            colors, colored = self._paint(len(points), cameras, float(scan["timestamp_camera"]))
            intensity = None
            if "reflectivity" in scan:
                intensity = np.asarray(scan["reflectivity"], np.float32).reshape(len(points), 1)
        except OSError:
            raise
        except Exception as error:  # SciPy raises arbitrary exceptions for malformed files.
            raise ValueError(f"{path}: cannot be read as a scan of Ford Campus: {error!r}") from error
        cloud = colored_cloud(points.astype(np.float32), colors, colored, intensity)
        # The vehicle's pose is x, y, z in metres and roll, pitch, yaw in radians: Rz(yaw) Ry(pitch) Rx(roll).
        pose = pose_of(Rotation.from_euler("xyz", vehicle[3:]), vehicle[:3]) @ _LASER_IN_VEHICLE
        return Frame(cloud, pose, _MICROSECOND * time)

    def _paint(self, size: int, cameras: list[dict[str, Any]], time: float) -> tuple[Colors, Bool[np.ndarray, "N"]]:
        """Colours of the points and the mask of coloured points; the first camera that saw a point determines it."""
        colors, colored = np.zeros((size, 3), np.float32), np.zeros(size, bool)
        # The image nearest in time, in microseconds, if near enough. (The `image_index` of the scans is always 0.)
        difference = np.abs(self._images[:, 1] - time)
        if not np.any(difference <= _MAX_DIFFERENCE / _MICROSECOND):
            return colors, colored
        image = int(self._images[difference.argmin(), 0])
        for number, camera in enumerate(cameras):
            path = self.folder / "IMAGES" / f"Cam{number}" / f"image{image:04d}.ppm"
            if not path.is_file():
                continue
            rows = np.asarray(camera["points_index"], int).reshape(-1) - 1
            pixels = np.asarray(camera["pixels"], float).reshape(2, -1).T
            # MATLAB indices start at 1, and the images are stored at half their height.
            pixels = np.stack([pixels[:, 0] - 1, pixels[:, 1] / 2 - 0.75], axis=1)
            image_colors, inside = look_up(read_image(path), pixels)
            new = inside & ~colored[rows]
            colors[rows[new]], colored[rows[new]] = image_colors[new], True
        return colors, colored
