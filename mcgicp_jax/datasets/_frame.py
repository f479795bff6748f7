"""What a sensor saw, and sequences of it that are made or read only when asked for."""

from __future__ import annotations

import abc
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from jaxtyping import Float

from mcgicp_jax._cloud import PointCloud


@dataclass(frozen=True, eq=False)
class Frame:
    """What a sensor saw, and from where.

    Two frames give the true relative pose: `T_target_source = inv(target.pose) @ source.pose`.

    Attributes:
        cloud: in the sensor's frame, metres.
        pose: (4, 4), sensor to world; None where it is not known.
        time: seconds, from any start; None where it is not known.
    """

    cloud: PointCloud
    pose: Float[np.ndarray, "4 4"] | None = None
    time: float | None = None


class AbstractFrames(Sequence[Frame]):
    """A sequence of frames, each made or read when it is asked for and not kept.

    It has a length, is indexed from either end and iterated over; a slice of it is as lazy.
    """

    @abc.abstractmethod
    def __len__(self) -> int: ...

    @abc.abstractmethod
    def _frame(self, index: int) -> Frame:
        """Frame `index`, which is from 0 to the length."""

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> AbstractFrames: ...

    def __getitem__(self, index: int | slice) -> Frame | AbstractFrames:
        """Raises `IndexError` beyond the ends."""
        if isinstance(index, slice):
            return _Slice(self, range(len(self))[index])
        return self._frame(self._row(index))

    def _row(self, index: int) -> int:
        """The index counted from the start."""
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
    """Frames of a made-up scene: their truth is exact, and each can be observed again with fresh noise.

    Frame i is the same however many there are.

    Attributes:
        path: the pose of frame i, (4, 4), sensor to world.
        observer: what the sensor sees from a pose; rays and noise come from the generator.
        period: seconds between frames.
        seed: of the rays and the noise of every frame.
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
        """Frame `index` again: the same scene from the same pose, with rays and noise of their own for every seed.

        Args:
            noise_seed: 0 or more; the same number gives the same cloud. None gives `frames[index]`.

        Raises:
            IndexError: beyond the ends.
        """
        row = self._row(index)
        key = (_FIRST_FRAME + row,) if noise_seed is None else (_FIRST_FRAME + row, noise_seed)
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))
        pose = self.path(row)
        return Frame(self.observer(rng, pose), pose, row * self.period)


# The streams of a seed: what the scene is made from, where the sensor goes, and one per frame.
_SCENE, _PATH, _FIRST_FRAME = 0, 1, 2


def scene_and_path_rng(seed: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Generators for the scene and for the sensor's path, independent of those of the frames."""
    scene, path = (np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(key,))) for key in (_SCENE, _PATH))
    return scene, path


def check_noise(noise: float) -> None:
    if not noise >= 0:
        raise ValueError(f"noise: expected 0 or more, got {noise}")


def check_points_per_frame(points: int, most: int) -> None:
    if not 1 <= points <= most:
        raise ValueError(f"points_per_frame: expected 1 to {most}, got {points}")


def rotation_from_vector(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rodrigues' formula."""
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
