"""Padded sizes, for programs whose shapes depend on the number of points: inside transformations, and in lanes."""

from __future__ import annotations

_SMALLEST_CLASS = 128


def size_class(num_points: int) -> int:
    """The smallest of 128, 256, 512, ... that holds `num_points` rows.

    Clouds of 100 to 200,000 points are of twelve classes.
    """
    return max(_SMALLEST_CLASS, 1 << (num_points - 1).bit_length())
