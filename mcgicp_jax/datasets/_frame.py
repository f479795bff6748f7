"""Frames of a sensor, and lazy sequences of frames."""

from __future__ import annotations

import abc
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import overload

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


class AbstractFrames(Sequence[Frame]):
    """A lazy sequence of frames: each is generated or read on access and not kept.

    It supports `len`, iteration, negative indices, and slices, which are lazy too.
    """

    @abc.abstractmethod
    def __len__(self) -> int: ...

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

    def _row(self, index: int) -> int:
        """The non-negative index that is equivalent to `index`."""
        row = operator.index(index)
        if not -len(self) <= row < len(self):
            raise IndexError(f"index: expected {-len(self)} to {len(self) - 1}, got {row}")
        return row % len(self)

    def __repr__(self) -> str:
        return f"{type(self).__name__.lstrip('_')}({len(self)} frames)"


class _Slice(AbstractFrames):
    def __init__(self, whole: AbstractFrames, rows: range):
        self._whole, self._rows = whole, rows

    def __len__(self) -> int:
        return len(self._rows)

    def _frame(self, index: int) -> Frame:
        return self._whole[self._rows[index]]


class SyntheticFrames(AbstractFrames):
    """Frames of a synthetic scene: the poses are exact, and each frame can be observed again with fresh noise.

    Frame i does not depend on the number of frames.

    Attributes:
        path: function from the index i to the pose of frame i, (4, 4), sensor to world, metres.
        observer: function from a random generator, for rays and noise, and a pose to the observed cloud.
        period: seconds between frames.
        seed: seed of the rays and the noise of all frames.
    """

    def __init__(
        self,
        num_frames: int,
        path: Callable[[int], Float[np.ndarray, "4 4"]],
        observer: Callable[[np.random.Generator, Float[np.ndarray, "4 4"]], PointCloud],
        period: float,
        seed: int,
    ):
        if num_frames < 1:
            raise ValueError(f"num_frames: expected at least 1, got {num_frames}")
        self._num_frames = num_frames
        self.path, self.observer, self.period, self.seed = path, observer, period, seed

    def __len__(self) -> int:
        return self._num_frames

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
        pose = self.path(row)
        return Frame(self.observer(rng, pose), pose, row * self.period)


# Independent random streams of one seed: the scene, the path of the sensor, and one per frame.
_SCENE, _PATH, _FIRST_FRAME = 0, 1, 2


def scene_and_path_rng(seed: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Random generators of the scene and of the sensor's path, independent of those of the frames."""
    scene, path = (np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(key,))) for key in (_SCENE, _PATH))
    return scene, path


def check_noise(noise: float) -> None:
    """Raise `ValueError` for a negative or NaN noise scale."""
    if not noise >= 0:
        raise ValueError(f"noise: expected 0 or more, got {noise}")


def check_points_per_frame(points: int, most: int) -> None:
    """Raise `ValueError` unless 1 ≤ `points` ≤ `most`."""
    if not 1 <= points <= most:
        raise ValueError(f"points_per_frame: expected 1 to {most}, got {points}")


def rotation_from_vector(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation by |vector| radians about the vector (Rodrigues' formula)."""
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
