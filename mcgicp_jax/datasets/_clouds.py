"""A folder of point clouds, one file per frame."""

from __future__ import annotations

import os
import re
from pathlib import Path

from mcgicp_jax import io
from mcgicp_jax._clouds.frame import Frame
from mcgicp_jax.datasets._frames import AbstractFrames
from mcgicp_jax.io.clouds import is_cloud


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
