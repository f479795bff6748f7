"""All data sets and simulated scenes by name, and lists of clouds in a folder."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcgicp_jax import io
from mcgicp_jax._clouds.point_cloud import Frame
from mcgicp_jax.datasets._box_room import box_room
from mcgicp_jax.datasets._frames import AbstractFrames
from mcgicp_jax.datasets._lidar import ford_campus, kitti
from mcgicp_jax.datasets._poster_wall import poster_wall
from mcgicp_jax.datasets._rgbd import seven_scenes, tum_rgbd
from mcgicp_jax.datasets._street import street
from mcgicp_jax.io.clouds import is_cloud


@dataclass(frozen=True)
class Dataset:
    """A data set, or a simulated scene, with options of `odometry` that suit its sensor and its motion.

    Attributes:
        frames: function of the folder of a sequence; of the number of frames if `simulated`.
        max_distance: metres, while the pose is being found and when it is refined.
        simulated: whether it is a simulated scene.
    """

    frames: Callable[[Any], AbstractFrames]
    max_distance: tuple[float, float]
    simulated: bool = False


DATASETS = {
    "kitti": Dataset(kitti, (2.5, 0.6)),
    "ford": Dataset(ford_campus, (2.5, 0.6)),
    "tum": Dataset(tum_rgbd, (0.2, 0.06)),
    "7-scenes": Dataset(seven_scenes, (0.2, 0.06)),
    "street": Dataset(street, (2.0, 0.5), simulated=True),
    "box-room": Dataset(box_room, (0.5, 0.25), simulated=True),
    "poster-wall": Dataset(poster_wall, (0.1, 0.04), simulated=True),
}


def clouds(folder: str | os.PathLike[str], glob: str = "*") -> CloudFiles:
    """The clouds of a folder in order of name, where numbers count by value: `scan_9.ply` precedes `scan_10.ply`.

    Args:
        folder: contains files that `mcgicp_jax.io.read` reads.
        glob: pattern for their names, such as "*.ply".

    Returns:
        Frames without poses and times. Hidden files are ignored; the attribute `left_out` lists others that are no
        clouds by their suffix or, for text and arrays of NumPy, by their content, such as poses, tables and logs.

    Raises:
        OSError: if there is no such folder.
        ValueError: if there are no clouds; for an invalid cloud, when its frame is read.
    """
    return CloudFiles(Path(folder), glob)


class CloudFiles(AbstractFrames):
    """See `clouds`.

    Attributes:
        paths: files of the frames.
        left_out: files that are no clouds.
    """

    def __init__(self, folder: Path, glob: str):
        # Raises if there is no such folder.
        os.scandir(folder).close()
        visible = (path for path in folder.glob(glob) if path.is_file() and not path.name.startswith("."))
        paths = sorted(visible, key=_by_number)
        self.paths = [path for path in paths if is_cloud(path)]
        self.left_out = [path for path in paths if path not in self.paths]
        if not self.paths:
            raise ValueError(f"{folder}: expected clouds {glob}, found none")
        super().__init__(len(self.paths))

    def _frame(self, index: int) -> Frame:
        return Frame(io.read(self.paths[index]))


def _by_number(path: Path) -> list[tuple[str, int]]:
    return [(text, int(number or 0)) for text, number in re.findall(r"(\D*)(\d*)", path.name)]
