"""Putative matches of two clouds: mutual nearest neighbours in feature space, or given rows."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import AnyArray
from mcgicp_jax._compute.row_functions import Input, Rows, blockwise
from mcgicp_jax._compute.tables import BLOCK, blocks
from mcgicp_jax._global_pose.fpfh import comparable, histograms_of, normals_of, statistics_of
from mcgicp_jax._global_pose.robust_pose_fit import NUM_MATCHES, PutativeMatches


def matches_of_features(source: PointCloud, target: PointCloud, voxel_size: float) -> PutativeMatches:
    """The mutual nearest neighbours in feature space; the most distinctive ones, if there are too many."""
    clouds = source, target
    normals = [normals_of(cloud, voxel_size) for cloud in clouds]
    histograms = [histograms_of(cloud, each, voxel_size) for cloud, each in zip(clouds, normals, strict=True)]
    statistics = None
    if source.channels.shape[1]:
        statistics = statistics_of(source, voxel_size), statistics_of(target, voxel_size)
    rows = mutual_nearest(*comparable((histograms[0], histograms[1]), statistics), NUM_MATCHES)
    points = [np.asarray(cloud.points)[each] for cloud, each in zip(clouds, rows, strict=True)]
    return _padded(*points, *(each[chosen] for each, chosen in zip(normals, rows, strict=True)))


def matches_of_rows(
    source: Float[np.ndarray, "N 3"], target: Float[np.ndarray, "M 3"], rows: Int[np.ndarray, "2 n"]
) -> PutativeMatches:
    """Matches of given rows of the points; evenly spaced ones, if there are too many. They have no normals."""
    points = source[rows[0]], target[rows[1]]
    finite = np.flatnonzero(np.isfinite(points).all(axis=(0, 2)))
    if finite.size > NUM_MATCHES:
        finite = finite[np.arange(NUM_MATCHES) * finite.size // NUM_MATCHES]
    unknown = np.zeros((finite.size, 3), np.float32)
    return _padded(*(each[finite].astype(np.float32) for each in points), unknown, unknown)


def _padded(*columns: Float[np.ndarray, "n 3"]) -> PutativeMatches:
    """The first `NUM_MATCHES` matches."""
    count = min(len(columns[0]), NUM_MATCHES)
    points, targets, normals, target_normals = np.zeros((4, NUM_MATCHES, 3), np.float32)
    for array, column in zip((points, targets, normals, target_normals), columns, strict=True):
        array[:count] = column[:count]
    return PutativeMatches(points, targets, normals, target_normals, np.arange(NUM_MATCHES) < count)


def mutual_nearest(
    source: Float[np.ndarray, "N L"], target: Float[np.ndarray, "M L"], count: int
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Source and target rows that are nearest to each other in feature space; the most distinctive matches first.

    A match is the more distinctive, the smaller its squared distance is relative to the squared distance of the second
    nearest target row. Ties go to the first row. All pairs of rows are compared in blocks: trees are no faster in so
    many dimensions.

    Args:
        source, target: features, integers as float32.
        count: the search ends when so many matches are found.
    """
    nearest, squares = _two_nearest(source, target)
    order = np.argsort(squares[:, 0] / np.maximum(squares[:, 1], 1), kind="stable")
    matched = nearest[order, 0]
    # Matched target rows in the order of their most distinctive match: the first blocks may yield enough matches.
    hit, first, number = np.unique(matched, return_index=True, return_inverse=True)
    wanted = np.argsort(first)
    back = np.full(len(hit), -1)
    for start in range(0, len(hit), BLOCK):
        rows = wanted[start : start + BLOCK]
        back[rows] = _two_nearest(target[hit[rows]], source)[0][:, 0]
        known = first[wanted[start + BLOCK]] if start + BLOCK < len(hit) else len(order)
        mutual = np.flatnonzero(back[number[:known]] == order[:known])
        if len(mutual) >= count:
            break
    return order[mutual], matched[mutual]


def _two_nearest(
    queries: Float[np.ndarray, "N L"], rows: Float[np.ndarray, "M L"]
) -> tuple[Int[np.ndarray, "N 2"], Float[np.ndarray, "N 2"]]:
    """The two nearest rows of each query, the first one first where distances tie; and the squared distances."""
    # The last block is filled by repeating its last row, which must count once.
    parts = [
        (rows[index], np.ones(BLOCK, bool) if isinstance(index, slice) else np.diff(index, prepend=-1) > 0)
        for _, index in blocks(len(rows))
    ]

    found = [blockwise(_two_nearest_of_block, part, Input(queries)) for part in parts]
    squares = np.hstack([square for square, _ in found])
    numbers = np.hstack([number + i * BLOCK for i, (_, number) in enumerate(found)])
    best = np.argsort(squares, axis=1, kind="stable")[:, :2]
    return np.take_along_axis(numbers, best, axis=1), np.take_along_axis(squares, best, axis=1)


def _two_nearest_of_block(
    block: tuple[Float[AnyArray, "n L"], Bool[AnyArray, "n"]], own: Rows
) -> tuple[Float[Array, "m 2"], Int[Array, "m 2"]]:
    """Squared distances and numbers of the two nearest rows. All terms are integers, hence exact."""
    (rows, counted), queries = block, own.tree
    squares = [jnp.sum(each * each, axis=1) for each in (queries, rows)]
    product = jnp.matmul(queries, rows.T, precision="highest")
    square = squares[0][:, None] + jnp.where(counted, squares[1], jnp.inf) - 2 * product
    # XLA's top_k takes a third of the time of its argmin.
    nearest, numbers = jax.lax.top_k(-square, 2)
    return -nearest, numbers
