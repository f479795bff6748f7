"""Sizes to which clouds are padded, so that few are compiled."""

# Rows. Clouds of 100 to 200,000 points then fall into 23 classes, each compiled once, and brute force takes at most
# 2.25 times as long for a padded cloud. With powers of two alone, it would take up to 4 times as long.
_SMALLEST_CLASS = 128


def size_class(count: int) -> int:
    """The smallest of 128, 192, 256, 384, 512, ... that is at least `count`."""
    count = max(count, _SMALLEST_CLASS)
    power = 1 << (count - 1).bit_length()
    return 3 * power // 4 if count <= 3 * power // 4 else power
