"""The Ford Campus vision and lidar data set."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mcgicp_jax._clouds.point_cloud import Frame, PointCloud
from mcgicp_jax.datasets._frames import AbstractFrames, pose_of
from mcgicp_jax.datasets._images import look_up, read_image

# Pose of the laser in the vehicle's frame: x, y, z in metres; roll, pitch, yaw in radians.
_LASER_IN_VEHICLE = np.array([2.4, -0.01, -2.3, np.pi, 0, np.pi / 2])
# Seconds: the unit of the time stamps.
_MICROSECOND = 1e-6
# Seconds between a scan and its images: half the interval of the cameras, which take about eight images a second.
_MAX_DIFFERENCE = 0.0625


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
        log = folder / "Timestamp.log"
        # Number and time in microseconds of each image.
        self._images = _read_log(log) if log.is_file() else np.empty((0, 2))

    def _frame(self, index: int) -> Frame:
        import scipy.io

        path = self._scans[index]
        try:
            scan = scipy.io.loadmat(path, simplify_cells=True)["SCAN"]
            points = np.asarray(scan["XYZ"], float).reshape(3, -1).T
            vehicle = np.asarray(scan["X_wv"], float).reshape(6)
            time = float(scan["timestamp_laser"])
            image = self._image_number(float(scan["timestamp_camera"]))
            cameras = [scan["Cam"]] if isinstance(scan["Cam"], dict) else list(scan["Cam"])
            colors, seen = self._paint(len(points), cameras, image)
        except OSError:
            raise
        except Exception as error:  # SciPy raises arbitrary exceptions for malformed files.
            raise ValueError(f"{path}: cannot be read as a scan of Ford Campus: {error!r}") from error
        channels, valid, names = colors, np.repeat(seen[:, None], 3, axis=1), ["red", "green", "blue"]
        if "reflectivity" in scan:
            intensity = np.asarray(scan["reflectivity"], float).reshape(-1, 1)
            channels = np.hstack([intensity, channels])
            valid = np.hstack([np.ones_like(intensity, bool), valid])
            names = ["intensity", *names]
        cloud = PointCloud(
            points.astype(np.float32), channels.astype(np.float32), channel_valid=valid, channel_names=names
        )
        return Frame(cloud, _pose(vehicle) @ _pose(_LASER_IN_VEHICLE), _MICROSECOND * time)

    def _image_number(self, time: float) -> int | None:
        """The image nearest in time, in microseconds, if near enough. (The `image_index` of the scans is always 0.)"""
        if not len(self._images):
            return None
        difference = np.abs(self._images[:, 1] - time)
        nearest = int(difference.argmin())
        return int(self._images[nearest, 0]) if difference[nearest] <= _MAX_DIFFERENCE / _MICROSECOND else None

    def _paint(
        self, size: int, cameras: list[dict[str, Any]], image: int | None
    ) -> tuple[Float[np.ndarray, "N 3"], np.ndarray]:
        """Colours of the points and the mask of coloured points; the first camera that saw a point determines it."""
        colors, seen = np.zeros((size, 3)), np.zeros(size, bool)
        if image is None:
            return colors, seen
        for number, camera in enumerate(cameras):
            path = self.folder / "IMAGES" / f"Cam{number}" / f"image{image:04d}.ppm"
            if not path.is_file():
                continue
            rows = np.asarray(camera["points_index"], int).reshape(-1) - 1
            pixels = np.asarray(camera["pixels"], float).reshape(2, -1).T
            # MATLAB indices start at 1, and the images are stored at half their height.
            found, inside = look_up(read_image(path), np.stack([pixels[:, 0] - 1, pixels[:, 1] / 2 - 0.75], axis=1))
            new = inside & ~seen[rows]
            colors[rows[new]], seen[rows[new]] = found[new], True
        return colors, seen


def _read_log(path: Path) -> Float[np.ndarray, "N 2"]:
    rows = [line.split()[:2] for line in path.read_text().splitlines() if line[:1].isdigit()]
    if not rows:
        raise ValueError(f"{path}: expected rows of image number and time stamp, found none")
    return np.array(rows, float)


def _pose(numbers: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
    """The pose Rz(yaw) Ry(pitch) Rx(roll) from x, y, z in metres and roll, pitch, yaw in radians."""
    return pose_of(Rotation.from_euler("xyz", numbers[3:]), numbers[:3])
