"""Size classes: padded numbers of rows, for programs whose shapes depend on the number of points."""

from __future__ import annotations

# Rows. Clouds of 100 to 200,000 points then fall into twelve classes, each compiled once.
_SMALLEST_CLASS = 128


def size_class(num_points: int) -> int:
    """The smallest of 128, 256, 512, ... that is at least `num_points`."""
    return max(_SMALLEST_CLASS, 1 << (num_points - 1).bit_length())
