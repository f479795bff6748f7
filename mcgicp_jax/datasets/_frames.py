"""Lazy sequences of frames; and images: reading and colour look-up."""

from __future__ import annotations

import abc
import operator
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias, overload

import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8, UInt16
from scipy.spatial.transform import Rotation

from mcgicp_jax import io
from mcgicp_jax._clouds.columns import COLORS
from mcgicp_jax._clouds.point_cloud import Frame, PointCloud
from mcgicp_jax._compute.concrete import AnyArray
from mcgicp_jax._compute.messages import optional_module
from mcgicp_jax.io.clouds import is_cloud

Matrix: TypeAlias = Float[np.ndarray, "4 4"]
Picture: TypeAlias = UInt8[np.ndarray, "height width 3"]
# Column and row, from (0, 0) in the centre of the first pixel.
Pixels: TypeAlias = Float[np.ndarray, "N 2"]
Colors: TypeAlias = Float[np.ndarray, "N 3"]
Mask: TypeAlias = Bool[np.ndarray, "N"]

# Independent random streams of one seed: the scene, the path of the sensor, and one per frame from this number on.
_FIRST_FRAME = 2


class AbstractFrames(Sequence[Frame]):
    """A lazy sequence of frames: each is generated or read on access and not kept.

    It supports `len`, iteration, negative indices, and slices, which are lazy too.

    Attributes:
        to_camera: (4, 4) from the sensor to the camera whose poses the data set has; None if these are the sensor's.
    """

    to_camera: Matrix | None = None

    def __init__(self, num_frames: int):
        self._num_frames = num_frames

    def __len__(self) -> int:
        return self._num_frames

    @abc.abstractmethod
    def _frame(self, index: int) -> Frame:
        """Frame `index`, 0 ≤ `index` < length."""

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> AbstractFrames: ...

    def __getitem__(self, index: int | slice) -> Frame | AbstractFrames:
        """Frame `index`, or a lazy slice; raises `IndexError` if the index is out of range."""
        if isinstance(index, slice):
            return _Slice(self, range(len(self))[index])
        return self._frame(self._row(index))

    def name(self, index: int) -> str:
        """Frame `index` in messages."""
        return f"frame {index}"

    def crop(self, min_range: float = 0.0, max_range: float = np.inf) -> AbstractFrames:
        """The frames, lazily, with the points whose distance from the sensor is in a range, metres; without images."""
        return _Cropped(self, min_range, max_range)

    def _row(self, index: int) -> int:
        row = operator.index(index)
        if not -len(self) <= row < len(self):
            raise IndexError(f"index: expected {-len(self)} to {len(self) - 1}, got {row}")
        return row % len(self)

    def __repr__(self) -> str:
        return f"{type(self).__name__.lstrip('_')}({len(self)} frames)"


class _Slice(AbstractFrames):
    def __init__(self, whole: AbstractFrames, rows: range):
        super().__init__(len(rows))
        self._whole, self._rows, self.to_camera = whole, rows, whole.to_camera

    def _frame(self, index: int) -> Frame:
        return self._whole[self._rows[index]]

    def name(self, index: int) -> str:
        return self._whole.name(self._rows[index])


class _Cropped(_Slice):
    def __init__(self, whole: AbstractFrames, min_range: float, max_range: float):
        super().__init__(whole, range(len(whole)))
        self._range = min_range, max_range

    def _frame(self, index: int) -> Frame:
        frame = super()._frame(index)
        return Frame(frame.cloud.crop(*self._range), frame.pose, frame.time)


class SyntheticFrames(AbstractFrames):
    """Frames of a synthetic scene: the poses are exact, and each frame can be observed again with fresh noise.

    Frame i does not depend on the number of frames.

    Attributes:
        path: function from the index i, or a time between two, to the pose of frame i, (4, 4), sensor to world, metres.
        observer: function from a random generator, for rays and noise, and a pose to the observed cloud; or poses
            (num_poses, 4, 4).
        period: seconds between frames.
        seed: seed of the rays and the noise of all frames.
        num_poses: number of poses of a scan, from that of the frame before to that of its own, evenly in time; 1 if all
            points are measured at once.
    """

    def __init__(
        self,
        num_frames: int,
        path: Callable[[float], Matrix],
        observer: Callable[[np.random.Generator, Any], PointCloud],
        period: float,
        seed: int,
        num_poses: int = 1,
    ):
        if num_frames < 1:
            raise ValueError(f"num_frames: expected at least 1, got {num_frames}")
        super().__init__(num_frames)
        self.path, self.observer, self.period, self.seed, self.num_poses = path, observer, period, seed, num_poses

    def _frame(self, index: int) -> Frame:
        return self.observe(index)

    def observe(self, index: int, noise_seed: int | None = None) -> Frame:
        """Observe frame `index` again: the same scene and pose, with other rays and noise.

        Args:
            index: index of the frame, negative to count from the end.
            noise_seed: seed of the rays and the noise, 0 or more. None gives `frames[index]`.

        Returns:
            The frame, with the true pose and time.

        Raises:
            IndexError: if the index is out of range.
        """
        row = self._row(index)
        key = (_FIRST_FRAME + row,) if noise_seed is None else (_FIRST_FRAME + row, noise_seed)
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))
        pose = poses_of_scan = self.path(row)
        if self.num_poses > 1:
            poses_of_scan = np.stack([self.path(row - float(time)) for time in np.linspace(1, 0, self.num_poses)])
        return Frame(self.observer(rng, poses_of_scan), pose, row * self.period)


def scene_and_path_rng(seed: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Random generators of the scene and of the sensor's path, independent of the frames' generators."""
    scene, path = np.random.default_rng(seed).spawn(_FIRST_FRAME)
    return scene, path


def pose_of(rotation: Rotation, position: Any) -> Matrix:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), position
    return pose


def check_scene(points_per_frame: int, noise: float, most: int = 10_000_000) -> None:
    if not noise >= 0:
        raise ValueError(f"noise: expected 0 or more, got {noise}")
    if not 1 <= points_per_frame <= most:
        raise ValueError(f"points_per_frame: expected 1 to {most}, got {points_per_frame}")


def read_image(path: str | os.PathLike[str]) -> Picture:
    return np.asarray(_open(path).convert("RGB"))


def read_depth(path: str | os.PathLike[str]) -> UInt16[np.ndarray, "height width"]:
    """Read a 16-bit depth image, in the unit of the file; raises `ValueError` for another kind of image."""
    depth = np.asarray(_open(path))
    if depth.ndim != 2 or depth.dtype != np.uint16:
        raise ValueError(f"{path}: expected a 16-bit depth image, got {depth.dtype} of shape {depth.shape}")
    return depth


def look_up(image: Picture, pixels: Pixels) -> tuple[Colors, Mask]:
    """Bilinear colours from 0 to 1 in float32, and the mask of pixels inside the image."""
    height, width, _ = image.shape
    # NaN compares false and is outside.
    inside = np.all((pixels >= 0) & (pixels <= (width - 1, height - 1)), axis=1)
    colors = bilinear(image, np.where(inside[:, None], pixels, 0), "nearest") / 255
    return colors.astype(np.float32), inside


def bilinear(image: Shaped[np.ndarray, "height width 3"], pixels: Pixels, mode: str) -> Colors:
    """Values at pixels of an image; `mode` says how SciPy's `map_coordinates` continues it."""
    from scipy.ndimage import map_coordinates

    channels = np.moveaxis(image, 2, 0)
    values = [map_coordinates(channel, pixels.T[::-1], float, order=1, mode=mode) for channel in channels]
    return np.stack(values, axis=1)


def colored_cloud(
    points: Float[AnyArray, "N 3"], colors: Colors, colored: Mask, intensity: Float[AnyArray, "N 1"] | None = None
) -> PointCloud:
    """A cloud whose colours are valid where `colored`; an intensity becomes the first channel, valid everywhere."""
    valid = np.repeat(colored[:, None], 3, axis=1)
    if intensity is None:
        return PointCloud(points, colors, channel_valid=valid, channel_names=COLORS)
    channels, valid = np.hstack([intensity, colors]), np.hstack([np.ones_like(intensity, bool), valid])
    return PointCloud(points, channels, channel_valid=valid, channel_names=("intensity", *COLORS))


def _open(path: str | os.PathLike[str]) -> Any:
    Image = optional_module("PIL.Image", "io", "reading images")
    try:
        return Image.open(path)
    except Image.UnidentifiedImageError as error:
        raise ValueError(f"{path}: cannot be read as an image") from error


def clouds(folder: str | os.PathLike[str], glob: str = "*", *, columns: int | None = None) -> CloudFiles:
    """The clouds of a folder in order of name, where numbers count by value: `scan_9.ply` precedes `scan_10.ply`.

    Args:
        folder: contains files that `mcgicp_jax.io.read` reads.
        glob: pattern for their names, such as "*.ply".
        columns: of `.bin` files, as in `mcgicp_jax.io.read`.

    Returns:
        Frames without poses and times. Hidden files are ignored; the attribute `left_out` lists others that are no
        clouds by their suffix or, for text and arrays of NumPy, by their content, such as poses, tables and logs.

    Raises:
        OSError: if there is no such folder.
        ValueError: if there are no clouds; for an invalid cloud, when its frame is read.
    """
    return CloudFiles(Path(folder), glob, columns)


class CloudFiles(AbstractFrames):
    """See `clouds`.

    Attributes:
        paths: files of the frames.
        left_out: files that are no clouds.
    """

    def __init__(self, folder: Path, glob: str, columns: int | None = None):
        # Raises if there is no such folder.
        os.scandir(folder).close()
        visible = (path for path in folder.glob(glob) if path.is_file() and not path.name.startswith("."))
        # Numbers count by value: scan_10.ply is ordered as ("scan_", 10), (".ply", 0).
        runs = re.compile(r"(\D*)(\d*)")
        paths = sorted(visible, key=lambda path: [(text, int(digits or 0)) for text, digits in runs.findall(path.name)])
        self.paths = [path for path in paths if is_cloud(path)]
        read = set(self.paths)
        self.left_out = [path for path in paths if path not in read]
        if not self.paths:
            pattern = "" if glob == "*" else f" {glob}"
            raise ValueError(f"{folder}: expected clouds{pattern}, found none")
        self._columns = columns
        super().__init__(len(self.paths))

    def _frame(self, index: int) -> Frame:
        return Frame(io.read(self.paths[index], columns=self._columns))

    def name(self, index: int) -> str:
        return f"frame {index} ({self.paths[index].name})"
