"""Matches of two clouds by features of their images: `image_matches`."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from mcgicp_jax._clouds.point_cloud import Frame
from mcgicp_jax._search.kd_tree import nearest_in_position

# Largest ratio of the distances to the best and the second best match (Lowe 2004).
_RATIO = 0.8
# Largest distance, in pixels, from a key point to the image of its point of the cloud. Points of a depth image are one
# pixel apart, rings of a LiDAR up to ten.
_MAX_PIXELS = 4.0


def image_matches(source: Frame, target: Frame) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Match points of two frames by features of their images, as `correspondences` for `global_pose`.

    SIFT features (Lowe 2004) match if they are mutual nearest neighbours and pass the ratio test. Each matched pixel is
    replaced by the point whose image is nearest, within four pixels; pixels without such a point are left out. Many
    matches may be wrong. Needs the extra `images`.

    Args:
        source, target: frames with `image` and `pixels`, as from `datasets.kitti`, `datasets.tum_rgbd` and
            `datasets.seven_scenes`.

    Returns:
        Rows (n,) of the source's cloud and rows (n,) of the target's, one of each per match.

    Raises:
        ValueError: if a frame has no image.
        ImportError: if OpenCV is not installed.
    """
    for name, frame in (("source", source), ("target", target)):
        if frame.image is None or frame.pixels is None:
            raise ValueError(f"{name}: expected a frame with an image, got one without")
    (pixels, features), (target_pixels, target_features) = _sift(source.image), _sift(target.image)
    rows, matched = _matched(features, target_features)
    source_rows, target_rows = _nearest(source, pixels[rows]), _nearest(target, target_pixels[matched])
    found = (source_rows >= 0) & (target_rows >= 0)
    return source_rows[found], target_rows[found]


def _sift(image: Any) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 128"]]:
    """Pixels (column, row) and SIFT features of the key points."""
    cv2 = _opencv()
    found, features = cv2.SIFT_create().detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
    if not found:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    return np.array([point.pt for point in found], float), features


def _matched(
    source: Float[np.ndarray, "n 128"], target: Float[np.ndarray, "m 128"]
) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
    if min(len(source), len(target)) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    matcher = _opencv().BFMatcher()
    back = {match.queryIdx: match.trainIdx for match in matcher.match(target, source)}
    good = [
        (first.queryIdx, first.trainIdx)
        for first, second in matcher.knnMatch(source, target, k=2)
        if first.distance < _RATIO * second.distance and back[first.trainIdx] == first.queryIdx
    ]
    rows, matched = np.array(good, np.int64).reshape(-1, 2).T
    return rows, matched


def _nearest(frame: Frame, pixels: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n"]:
    """The row of the cloud nearest to each pixel, −1 for none."""
    queries, points = (np.pad(np.asarray(each, float), ((0, 0), (0, 1))) for each in (pixels, frame.pixels))
    return nearest_in_position(queries, points, _MAX_PIXELS).astype(np.int64)


def _opencv() -> Any:
    try:
        import cv2
    except ImportError as error:
        raise ImportError("image features need OpenCV: pip install 'mcgicp_jax[images]'") from error
    return cv2
