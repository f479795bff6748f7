"""Matches of two clouds: by given rows, by features of images, and by features that do not depend on the pose, FPFH and
statistics of the channels.

FPFH (Rusu, Blodow & Beetz, Fast Point Feature Histograms for 3D Registration, ICRA 2009) depends on the signs of the
normals, which are known for single scans at best. Here the normal of each neighbour is flipped to the side of the
point's normal, and histograms are averaged over both signs of the point's normal.
"""

from __future__ import annotations

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.sparse import csr_array

from mcgicp_jax._clouds.point_cloud import Frame, PointCloud
from mcgicp_jax._compute.concrete import AnyArray, AnyScalar
from mcgicp_jax._compute.messages import optional_module
from mcgicp_jax._compute.row_functions import Input, Rows, blockwise
from mcgicp_jax._compute.tables import BLOCK, blocks
from mcgicp_jax._global_pose.robust_pose_fit import NUM_MATCHES, PutativeMatches
from mcgicp_jax._local_geometry.local_geometry import offsets_of, weighted_covariance
from mcgicp_jax._local_geometry.neighborhoods import inputs_of_neighbors, neighborhoods
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._search.kd_tree import nearest_in_position

# Neighbourhood radii in voxels. Normals and histograms: as in Open3D's examples. Statistics of the channels: from the
# nearest neighbours to the radius of histograms.
_NORMAL_RADIUS, _RADIUS, _CHANNEL_RADII = 2.0, 5.0, (1.5, 3.0, 5.0)
# A disc of five voxels radius on a surface has 79 voxels; there are more where the surface is rough.
NUM_NEIGHBORS = 100
# Bins of each of three angles, as in the paper.
NUM_BINS = 11
# Standard deviation of all statistics of the channels together, relative to that of the histogram: at one half, real
# scans have 30 to 50 % more inliers than without channels.
_CHANNEL_WEIGHT = 0.5
# Features are rounded to integers up to this magnitude, and the standard deviation of a bin of the histograms to this
# number. Sums of products of 1,000 such integers are exact in float32, in any order.
_LARGEST, _DEVIATION = 127, 16
# Largest ratio of the distances to the best and the second best match (Lowe 2004).
_RATIO = 0.8
# Largest distance, in pixels, from a key point to the image of its point of the cloud. Points of a depth image are one
# pixel apart, rings of a LiDAR up to ten.
_MAX_PIXELS = 4.0


def normals_of(cloud: PointCloud, voxel_size: float) -> Float[np.ndarray, "N 3"]:
    """Unit normals of arbitrary sign."""
    return blockwise(_normals, np.float32(_NORMAL_RADIUS * voxel_size), *inputs_of_neighbors(cloud, False))[0]


def histograms_of(cloud: PointCloud, normals: Float[np.ndarray, "N 3"], voxel_size: float) -> Float[np.ndarray, "N 33"]:
    """FPFH: eleven bins for each of the angles α, φ, θ, which add up to two; zero without neighbours in the radius."""
    size, radius = cloud.points.shape[0], np.float32(_RADIUS * voxel_size)
    inputs = inputs_of_neighbors(cloud.replace_rows(channels=normals, channel_valid=None), True)
    simple, weights = blockwise(_simple_histograms, radius, *inputs)
    # The point's histogram plus the weighted mean of its neighbours', as a sparse product: gathering takes ten times as
    # long.
    neighbors = np.maximum(np.asarray(cloud.neighbors), 0)
    starts = np.arange(size + 1) * neighbors.shape[1]
    return simple + csr_array((weights.ravel(), neighbors.ravel(), starts), shape=(size, size)) @ simple


def statistics_of(cloud: PointCloud, voxel_size: float) -> Float[np.ndarray, "N D"]:
    """Mean and standard deviation of each channel within each radius; NaN where no point has the channel."""
    return blockwise(_statistics, np.float32(voxel_size), *inputs_of_neighbors(cloud, True))[0]


def _normals(radius: Float[AnyScalar, ""], points: Rows, neighbors: Rows) -> tuple[Float[Array, "n 3"]]:
    around = neighborhoods(points, neighbors)
    offsets = offsets_of(around)
    square = alg.dot(offsets, offsets)
    weights = (around.present & (square <= radius * radius)).astype(square.dtype)
    return (alg.smallest_eigenvector(weighted_covariance(offsets, weights)).T,)


def _simple_histograms(
    radius: Float[AnyScalar, ""], points: Rows, neighbors: Rows
) -> tuple[Float[Array, "n 33"], Float[Array, "n k"]]:
    """SPFH of points whose channels are their normals; and the weights of their neighbours in FPFH, 1/d².

    In each pair of point and neighbour, the first point is the one whose normal is closer to the line between them.
    Let u be its normal, d the unit vector to the second point, n the normal of the second point, v = d × u / |d × u|
    and w = u × v. The angles are α = v·n, φ = u·d and θ = atan2(w·n, u·n).
    """
    around = neighborhoods(points, neighbors)
    offsets = offsets_of(around)
    square = alg.dot(offsets, offsets)
    near = around.present & (square > 0) & (square <= radius * radius)
    distance = jnp.sqrt(jnp.where(near, square, 1))
    line = [offset / distance for offset in offsets]
    normal, near_normal = [axis[None] for axis in around.own_channels], list(around.near_channels)
    side = jnp.where(alg.dot(normal, near_normal) >= 0, 1, -1).astype(square.dtype)
    near_normal = [side * axis for axis in near_normal]
    cosine, near_cosine = alg.dot(normal, line), alg.dot(near_normal, line)
    swapped = jnp.abs(cosine) < jnp.abs(near_cosine)
    u = [jnp.where(swapped, b, a) for a, b in zip(normal, near_normal, strict=True)]
    n = [jnp.where(swapped, a, b) for a, b in zip(normal, near_normal, strict=True)]
    line = [jnp.where(swapped, -axis, axis) for axis in line]
    phi = jnp.where(swapped, -near_cosine, cosine)
    v = alg.cross(line, u)
    length = jnp.sqrt(alg.dot(v, v))
    # Where a normal is the line between the points, the frame is undefined.
    counted = near & (length > 1e-6)
    v = [axis / jnp.where(counted, length, 1) for axis in v]
    w = alg.cross(u, v)
    # The angle between the flipped normals is at most π/2.
    theta = jnp.arctan2(alg.dot(w, n), alg.dot(u, n)) / jnp.pi
    # Fractions of the neighbours in each bin, by differences of cumulative counts: XLA may compute a value anew for
    # each bin, with other rounding, and the value would fall into two bins, or none.
    total, histograms = jnp.sum(counted, axis=0), []
    for angle in (0.5 + 0.5 * alg.dot(v, n), 0.5 + 0.5 * phi, 0.5 + theta):
        below = [jnp.sum(counted & (NUM_BINS * angle < i), axis=0) for i in range(1, NUM_BINS)]
        cumulative = jnp.stack([jnp.zeros_like(total), *below, total], axis=1)
        histograms.append(jnp.diff(cumulative, axis=1) / jnp.maximum(total, 1)[:, None].astype(square.dtype))
    alpha, *others = histograms
    # With the other sign of both normals, φ and θ change theirs.
    even = [0.5 * (histogram + histogram[:, ::-1]) for histogram in others]
    weights = jnp.where(near, 1 / jnp.where(near, square, 1), 0)
    weights = weights / jnp.where(jnp.any(near, axis=0), jnp.sum(weights, axis=0), 1)
    return jnp.concatenate([alpha, *even], axis=1), weights.T


def _statistics(voxel_size: Float[AnyScalar, ""], points: Rows, neighbors: Rows) -> tuple[Float[Array, "n D"]]:
    around = neighborhoods(points, neighbors)
    offsets = offsets_of(around)
    square = alg.dot(offsets, offsets)
    columns = []
    for channel in range(around.num_channels):
        valid, difference, here = around.measured(channel), around.difference(channel), around.own_channels[channel]
        for radius in _CHANNEL_RADII:
            weights = (valid & (square <= (radius * voxel_size) ** 2)).astype(square.dtype)
            total = jnp.sum(weights, axis=0)
            count = jnp.maximum(total, 1)
            mean = jnp.sum(weights * difference, axis=0) / count
            variance = jnp.sum(weights * (difference - mean) ** 2, axis=0) / count
            columns += [jnp.where(total > 0, value, jnp.nan) for value in (here + mean, jnp.sqrt(variance))]
    return (jnp.stack(columns, axis=1),)


def matches_of_features(source: PointCloud, target: PointCloud, voxel_size: float) -> PutativeMatches:
    """The mutual nearest neighbours in feature space; the most distinctive ones, if there are too many."""
    clouds = source, target
    normals = [normals_of(cloud, voxel_size) for cloud in clouds]
    histograms = [histograms_of(clouds[i], normals[i], voxel_size) for i in (0, 1)]
    # On one scale in both clouds.
    joined = np.concatenate(histograms).astype(np.float64)
    scale = _DEVIATION / max(float(joined.std()), float(np.finfo(np.float32).tiny))
    center = joined.mean(axis=0)
    parts = [[scale * (histogram - center)] for histogram in histograms]
    if source.channels.shape[1]:
        # Divided by their standard deviations in both clouds; missing ones are set to the mean.
        statistics = [statistics_of(cloud, voxel_size) for cloud in clouds]
        joined = np.concatenate(statistics).astype(np.float64)
        finite = np.isfinite(joined)
        count = np.maximum(finite.sum(axis=0), 1)
        mean = np.where(finite, joined, 0).sum(axis=0) / count
        spread = np.sqrt(np.where(finite, (joined - mean) ** 2, 0).sum(axis=0) / count)
        varying = spread > 1e3 * np.finfo(np.float32).eps * np.abs(mean)
        weight = _CHANNEL_WEIGHT * _DEVIATION * np.sqrt(histograms[0].shape[1] / joined.shape[1])
        scales = np.where(varying, weight / np.where(varying, spread, 1), 0)
        for values, part in zip(statistics, parts, strict=True):
            part.append(np.nan_to_num((values - mean) * scales))
    # Integers in float32, whose distances are exact.
    features = [np.clip(np.rint(np.hstack(part)), -_LARGEST, _LARGEST).astype(np.float32) for part in parts]
    sources, targets = mutual_nearest(features[0], features[1], NUM_MATCHES)
    points = np.asarray(source.points)[sources], np.asarray(target.points)[targets]
    return _padded(*points, normals[0][sources], normals[1][targets])


def matches_of_rows(
    source: Float[np.ndarray, "N 3"], target: Float[np.ndarray, "M 3"], rows: Int[np.ndarray, "2 n"]
) -> PutativeMatches:
    """Matches of given rows, without normals; evenly spaced ones, if there are too many."""
    points = source[rows[0]], target[rows[1]]
    finite = np.flatnonzero(np.isfinite(points).all(axis=(0, 2)))
    if finite.size > NUM_MATCHES:
        finite = finite[np.arange(NUM_MATCHES) * finite.size // NUM_MATCHES]
    unknown = np.zeros((finite.size, 3), np.float32)
    return _padded(*(side[finite].astype(np.float32) for side in points), unknown, unknown)


def _padded(*columns: Float[np.ndarray, "n 3"]) -> PutativeMatches:
    """The first `NUM_MATCHES` matches, from the points of both clouds and the normals of both."""
    padded = np.zeros((len(columns), NUM_MATCHES, 3), np.float32)
    count = min(len(columns[0]), NUM_MATCHES)
    padded[:, :count] = [column[:count] for column in columns]
    return PutativeMatches._make([*padded, np.arange(NUM_MATCHES) < count])


def mutual_nearest(
    source: Float[np.ndarray, "N L"], target: Float[np.ndarray, "M L"], count: int
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Mutual nearest rows, the most distinctive matches first, by the ratio of the squared distances to the nearest and
    to the second nearest target row; ties by row. The search ends when it has `count` matches. Trees are no faster in
    so many dimensions."""
    nearest, squares = _two_nearest(source, target)
    order = np.argsort(squares[:, 0] / np.maximum(squares[:, 1], 1), kind="stable")
    matched = nearest[order, 0]
    # Matched target rows in the order of their most distinctive match: the first blocks may yield enough matches.
    targets, first, number = np.unique(matched, return_index=True, return_inverse=True)
    search_order = np.argsort(first)
    back = np.full(len(targets), -1)
    for start in range(0, len(targets), BLOCK):
        rows = search_order[start : start + BLOCK]
        back[rows] = _two_nearest(target[targets[rows]], source)[0][:, 0]
        searched = first[search_order[start + BLOCK]] if start + BLOCK < len(targets) else len(order)
        mutual = np.flatnonzero(back[number[:searched]] == order[:searched])
        if len(mutual) >= count:
            break
    return order[mutual], matched[mutual]


def _two_nearest(
    queries: Float[np.ndarray, "N L"], rows: Float[np.ndarray, "M L"]
) -> tuple[Int[np.ndarray, "N 2"], Float[np.ndarray, "N 2"]]:
    """The two nearest rows of each query, by row where distances tie; and the squared distances."""
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    for _, index in blocks(len(rows)):
        # The last block is filled by repeating its last row, which must count once.
        counted = np.ones(BLOCK, bool) if isinstance(index, slice) else np.diff(index, prepend=-1) > 0
        square, number = blockwise(_two_nearest_of_block, (rows[index], counted), Input(queries))
        parts.append((square, number + len(parts) * BLOCK))
    squares, numbers = map(np.hstack, zip(*parts, strict=True))
    best = np.argsort(squares, axis=1, kind="stable")[:, :2]
    return np.take_along_axis(numbers, best, axis=1), np.take_along_axis(squares, best, axis=1)


def _two_nearest_of_block(
    block: tuple[Float[AnyArray, "n L"], Bool[AnyArray, "n"]], queries: Rows
) -> tuple[Float[Array, "m 2"], Int[Array, "m 2"]]:
    """Squared distances and numbers of the two nearest rows. All terms are integers, hence exact."""
    rows, counted = block
    squares = [jnp.sum(values * values, axis=1) for values in (queries.tree, rows)]
    product = jnp.matmul(queries.tree, rows.T, precision="highest")
    square = squares[0][:, None] + jnp.where(counted, squares[1], jnp.inf) - 2 * product
    # XLA's top_k takes a third of the time of its argmin.
    nearest, numbers = jax.lax.top_k(-square, 2)
    return -nearest, numbers


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
    cv2 = optional_module("cv2", "images", "matching images")
    # Positions of the key points of both images, (column, row), and their features.
    pixels, features = [], []
    for frame in (source, target):
        gray = cv2.cvtColor(cast(Any, frame.image), cv2.COLOR_RGB2GRAY)
        key_points, descriptors = cv2.SIFT_create().detectAndCompute(gray, None)
        pixels.append(np.array([point.pt for point in key_points], float).reshape(-1, 2))
        features.append(descriptors)
    if min(len(pixels[0]), len(pixels[1])) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    matcher = cv2.BFMatcher()
    back = {match.queryIdx: match.trainIdx for match in matcher.match(features[1], features[0])}
    good = [
        (first.queryIdx, first.trainIdx)
        for first, second in matcher.knnMatch(features[0], features[1], k=2)
        if first.distance < _RATIO * second.distance and back[first.trainIdx] == first.queryIdx
    ]
    matches = np.array(good, np.int64).reshape(-1, 2).T
    rows = []
    for frame, positions, matched in zip((source, target), pixels, matches, strict=True):
        # The search is in three dimensions.
        queries = np.pad(positions[matched], ((0, 0), (0, 1)))
        points = np.pad(np.asarray(frame.pixels, float), ((0, 0), (0, 1)))
        rows.append(nearest_in_position(queries, points, _MAX_PIXELS).astype(np.int64))
    both = (rows[0] >= 0) & (rows[1] >= 0)
    return rows[0][both], rows[1][both]
