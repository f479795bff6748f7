"""The columns of files of float32 values without a header: KITTI's, and others that have the same suffix."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

# Bound of the whole numbers of rings; the densest LiDARs have 128, and some count from 1.
_MOST_RINGS = 256
# Numbers of columns whose repetition is compared. A file is not of four columns if it repeats with another period that
# is no multiple, so that values that far apart differ by less than this fraction of what those four apart do. (Of
# periods that are not those of the file, 1.5 and more: KITTI, streets and rooms in scan order and shuffled.)
_PERIODS, _REPEATS = (3, 5, 6, 7, 9, 10), 0.5
# Values that are compared.
_SAMPLE = 120_000
# Numbers of columns that a refusal suggests where they fill the file.
_SIZES = range(3, 11)

# Padding of PCL's points is 0, or the bits of small integers, such as a ring, as float32.
_PADDING = 1e-30


def columns_of_floats(values: Float[np.ndarray, "n"], width: int | None = None) -> dict[str, Float[np.ndarray, "N"]]:
    """x, y, z and perhaps intensity, by the layout whose columns fit: KITTI (x, y, z, intensity), nuScenes (ring last),
    ring and time last, PCL's points of 32 bytes (x, y, z, padding, intensity, padding), or x, y, z. Of rows of a given
    `width`, the first are x, y, z, and the fourth is the intensity unless it has negative values. Raises
    `ValueError` if none fits."""

    def split(size: int) -> Any:
        return values.reshape(-1, size).T if values.size % size == 0 else None

    def named(columns: Any, *others: int) -> dict[str, Float[np.ndarray, "N"]]:
        return dict(zip(("x", "y", "z", "intensity"), [*columns[:3], *(columns[i] for i in others)], strict=False))

    columns = split(8) if width in (None, 8) else None
    if columns is not None and _is_constant(columns[3]) and (np.abs(columns[5:]) < _PADDING).all():
        return named(columns, 4)
    if width is not None:
        columns = split(width)
        if columns is None:
            raise ValueError(f"expected rows of {width} float32 values, got {4 * values.size} bytes")
        return named(columns, *([3] if width > 3 and _is_intensity(columns[3]) else []))
    for size in (6, 5):
        columns = split(size)
        if columns is not None and _is_intensity(columns[3]) and not _is_constant(columns[4]):
            ring = columns[4]
            if ((ring == np.rint(ring)) & (ring >= 0) & (ring < _MOST_RINGS)).all():
                return named(columns, 3)
    # Median difference of values that are so many columns apart.
    sample, steps = values[:_SAMPLE], {}
    for size in (4, *_PERIODS):
        differences = np.abs(sample[size:] - sample[:-size])
        finite = differences[np.isfinite(differences)]
        steps[size] = float(np.median(finite)) if finite.size else np.inf
    columns = split(4)
    if columns is not None and _is_intensity(columns[3]) and min(steps.values()) >= _REPEATS * steps[4]:
        return named(columns, 3)
    columns = split(3)
    if columns is not None and steps[3] < _REPEATS * min(steps[size] for size in (4, 5, 7, 10)):
        return named(columns)
    fitting = [str(size) for size in _SIZES if values.size % size == 0]
    advice = f"if they begin with x, y, z, say how many there are, columns=N; {', '.join(fitting)} fit"
    raise ValueError(
        "its columns are neither those of KITTI (x, y, z, intensity) nor of another known layout; "
        + (advice if fitting else f"no number of {_SIZES[0]} to {_SIZES[-1]} fills {4 * values.size} bytes")
    )


def _is_constant(column: Float[np.ndarray, "N"]) -> bool:
    return bool((column == column[:1]).all())


def _is_intensity(column: Float[np.ndarray, "N"]) -> bool:
    return not (column < 0).any()
