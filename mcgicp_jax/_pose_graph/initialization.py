"""Poses to start a pose graph from: a spanning tree of its edges, and a chordal relaxation of those that are trusted;
and edges that hold the poses near the start along directions that are not measured.

The relaxation solves two sparse linear least-squares problems in closed form: rotations as free 3×3 matrices, which are
then made orthonormal, and positions at these rotations (Martinec & Pajdla, CVPR 2007; Carlone et al., ICRA 2015). It
comes near the minimum where a tree, whose errors add up, does not.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._math.poses import inverse
from mcgicp_jax._pose_graph.edge import WORLD, Edge

# Eigenvalues of an edge's information below this fraction of the largest count as zero.
_BLIND = 1e-6
# Information about the start, as a multiple of what leaks, and at most as a fraction of that of a typical edge. Largest
# slides in corridors of 3 to 40 poses, with σ = 0.02: 559 m without, 0.8 m with a multiple of 10, 0.4 m with 30 or 100.
_OF_LEAK, _MOST = 30.0, 1e-2


def initial_poses(
    i: Int[np.ndarray, "m"],
    j: Int[np.ndarray, "m"],
    motions: Float[np.ndarray, "m 4 4"],
    information: Float[np.ndarray, "m 6 6"],
    loop: Bool[np.ndarray, "m"],
    number: int,
) -> Float[np.ndarray, "number 4 4"]:
    """Poses from edges, whose row `i` is `number` for the world.

    A spanning tree prefers edges that are no loops, then loops, then edges without information on some direction. Parts
    that are not connected with the world begin at the identity.
    """
    # An edge of the identity from the world to each pose, to be used last, keeps other parts.
    i, j = np.concatenate([i, np.full(number, number)]), np.concatenate([j, np.arange(number)])
    motions = np.concatenate([motions, np.tile(np.eye(4), (number, 1, 1))])
    values = np.linalg.eigvalsh(information)
    rank = np.concatenate([loop + 2 * (values[:, 0] <= _BLIND * values[:, -1]), np.full(number, 4)])
    poses, used = _along_tree(i, j, motions, rank, number)
    used |= rank == 0
    if used.sum() > number:
        scales = np.diagonal(information, axis1=1, axis2=2).reshape(-1, 2, 3).mean(axis=2)
        scales = np.concatenate([np.where(scales > 0, scales, 1), np.ones((number, 2))])[used]
        poses = _relaxed(i[used], j[used], motions[used], np.sqrt(scales), number)
    return poses


def _along_tree(
    i: Int[np.ndarray, "m"],
    j: Int[np.ndarray, "m"],
    motions: Float[np.ndarray, "m 4 4"],
    rank: Int[np.ndarray, "m"],
    number: int,
) -> tuple[Float[np.ndarray, "number 4 4"], Bool[np.ndarray, "m"]]:
    """Poses along a spanning tree from the world, of edges of lowest rank, and which edges it has."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    order = np.argsort(rank, kind="stable")
    # Of several edges between two poses, the first in this order.
    _, first = np.unique((np.minimum(i, j) * (number + 1) + np.maximum(i, j))[order], return_index=True)
    rows = order[first]
    size = (number + 1, number + 1)
    tree = minimum_spanning_tree(coo_array((first + 1.0, (i[rows], j[rows])), size)).tocoo()
    edges = order[tree.data.astype(int) - 1]
    between = {frozenset(ends): edge for *ends, edge in zip(tree.row, tree.col, edges, strict=True)}
    nodes, before = breadth_first_order(tree.tocsr(), number, directed=False)
    poses = np.tile(np.eye(4), (number + 1, 1, 1))
    for node in nodes[1:]:
        edge = between[frozenset((before[node], node))]
        motion = motions[edge] if j[edge] == node else np.linalg.inv(motions[edge])
        poses[node] = poses[before[node]] @ motion
    return poses[:number], np.isin(np.arange(len(i)), edges)


def _relaxed(
    i: Int[np.ndarray, "m"],
    j: Int[np.ndarray, "m"],
    motions: Float[np.ndarray, "m 4 4"],
    roots: Float[np.ndarray, "m 2"],
    number: int,
) -> Float[np.ndarray, "number 4 4"]:
    """The chordal relaxation; `roots` are those of the information, of translation and rotation."""
    m, three = len(i), np.arange(3)
    turns, shifts = motions[:, :3, :3], motions[:, :3, 3]
    # R_jᵀ = R_i_jᵀ R_iᵀ, for the three columns at once.
    rows = 3 * np.arange(m)[:, None, None] + three[:, None]
    entries = [
        (roots[:, 1, None, None] * np.eye(3), rows + 0 * three, 3 * j[:, None, None] + three),
        (-roots[:, 1, None, None] * turns.swapaxes(1, 2), rows + 0 * three, 3 * i[:, None, None] + three),
    ]
    columns = _least_squares(entries, np.zeros((3 * m, 3)), np.eye(3), (3 * m, 3 * number + 3))
    free = columns.reshape(number + 1, 3, 3).swapaxes(1, 2)
    left, _, right = np.linalg.svd(free)
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    rotations = left @ right
    # t_j − t_i = R_i t_i_j.
    rows, weights = np.arange(m), roots[:, 0]
    aims = weights[:, None] * np.einsum("mij,mj->mi", rotations[i], shifts)
    positions = _least_squares([(weights, rows, j), (-weights, rows, i)], aims, np.zeros((1, 3)), (m, number + 1))
    poses = np.tile(np.eye(4), (number, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations[:-1], positions[:-1]
    return poses


def _least_squares(
    entries: list[tuple[Any, Any, Any]], aims: Float[np.ndarray, "r 3"], last: Float[np.ndarray, "h 3"], shape: Any
) -> Float[np.ndarray, "c 3"]:
    """Least squares of a sparse system, of which the last unknowns are given."""
    from scipy.sparse import coo_array
    from scipy.sparse.linalg import splu

    values, rows, columns = (
        np.concatenate([np.broadcast_to(each[k], each[0].shape).ravel() for each in entries]) for k in range(3)
    )
    whole = coo_array((values, (rows, columns)), shape).tocsc()
    count = shape[1] - len(last)
    system, aims = whole[:, :count], aims - whole[:, count:] @ last
    normal = (system.T @ system).tocsc()
    options = {"SymmetricMode": True}
    factors = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.concatenate([factors.solve(system.T @ aims), last])


def unmeasured(edges: Edge, poses: Float[np.ndarray, "n 4 4"], typical: Float[np.ndarray, "m 6"]) -> Edge:
    """Edges between the same poses that measure the motions at the start, along unmeasured directions alone.

    The axes of an edge are only known to its standard deviation σ of rotation, in radians, so that a fraction σ² of its
    information leaks into the directions that it does not measure: poses would slide along these by many metres to
    explain the noise in the others.

    Args:
        edges: those of the graph. Priors get no information, since the world's axes are exact.
        poses: at the start.
        typical: `typical_information` of the edges.
    """
    between, roots = edges.i != WORLD, np.sqrt(typical)
    i = np.where(between, edges.i, edges.j)
    values, vectors = np.linalg.eigh(np.nan_to_num(edges.information) / (roots[:, :, None] * roots[:, None]))
    blind = between[:, None] & (values <= _BLIND * values[:, -1:])
    some = np.minimum(_OF_LEAK / typical[:, 5:], _MOST)
    scaled = roots[:, :, None] * vectors
    information = (scaled * (blind * some)[:, None]) @ scaled.swapaxes(1, 2)
    return Edge(edges.i, edges.j, inverse(poses[i]) @ poses[edges.j], information)
