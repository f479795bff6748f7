"""Pose graphs: poses, measured motions between them, and other measurements; and poses to start from.

The start is a spanning tree of the edges, and a chordal relaxation of those that are trusted. The relaxation solves two
sparse linear least-squares problems in closed form: rotations as free 3×3 matrices, which are then made orthonormal,
and positions at these rotations (Martinec & Pajdla, CVPR 2007; Carlone et al., ICRA 2015). It comes near the minimum
where a tree, whose errors add up, does not. Edges that keep the poses near the start act along directions that are not
measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._math.poses import Pose, inverse, pose_matrices
from mcgicp_jax._pose_graph.edge import WORLD, AbstractFactor, Edge, check_rows, checked_edges

# Eigenvalues of an edge's information below this fraction of the largest count as zero.
_BLIND = 1e-6
# Information about the start, as a multiple of what leaks, and at most as a fraction of that of a typical edge. Largest
# slides in corridors of 3 to 40 poses, with σ = 0.02: 559 m without, 0.8 m with a multiple of 10, 0.4 m with 30 or 100.
_OF_LEAK, _MOST = 30.0, 1e-2


class PoseGraph(eqx.Module):
    """Poses of a sensor, measured motions between them, and other measurements; a pytree.

    Attributes:
        poses: (n, 4, 4), sensor to world, metres, the initial poses of `optimize_poses`. The first one is fixed,
            unless there are measurements in the world's frame.
        edges: the m measured motions: one `Edge` whose fields have a leading axis of length m.
        factors: measurements of other kinds; none by default.
    """

    poses: Float[Array, "n 4 4"] | Float[np.ndarray, "n 4 4"]
    edges: Edge
    factors: tuple[AbstractFactor, ...]

    def __init__(
        self,
        poses: ArrayLike | Sequence[Pose] | None,
        edges: Sequence[Edge] | Edge,
        factors: Sequence[AbstractFactor] = (),
    ):
        """Create a graph.

        Args:
            poses: an array (n, 4, 4), or a sequence of n `jaxlie.SE3` or (4, 4) matrices. If None, initial poses are
                computed from the edges by chordal relaxation (Carlone et al. 2015). Uncertain edges, and edges without
                information on some direction, are used only where no others connect two poses. Each part of the graph
                without a prior begins at the identity.
            edges: a sequence of single edges, or one `Edge` with a leading axis. Several edges may join the same poses.
            factors: measurements of other kinds, instances of subclasses of `AbstractFactor`.

        Raises:
            ValueError: if there is no pose, a pose or a measured motion is not rigid, an edge joins a pose to itself or
                to a row outside of the graph, or an information matrix is not finite, symmetric and positive
                semidefinite. Of traced arrays, only the shapes are checked.
        """
        self.edges = edges if isinstance(edges, Edge) else _stacked(edges)
        if np.ndim(self.edges.i) != 1:
            raise ValueError(f"edges: expected one leading axis, got shape {np.shape(self.edges.i)}")
        if poses is None:
            poses = _initial(self.edges)
        elif is_concrete(poses):
            poses = pose_matrices(poses)
        if np.ndim(poses) != 3 or np.shape(poses)[1:] != (4, 4):  # type: ignore
            raise ValueError(f"poses: expected at least one pose of shape (4, 4), got shape {np.shape(poses)}")  # type: ignore
        self.poses = poses  # type: ignore
        if is_concrete(self.edges):
            self.edges = checked_edges(self.edges, len(self.poses))
        for k, factor in enumerate(factors):
            _check_factor(f"factors[{k}]", factor, len(self.poses))
        self.factors = tuple(factors)


def _stacked(edges: Sequence[Edge]) -> Edge:
    if not edges:
        none = np.zeros(0, int)
        return Edge(none, none, np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))
    for k, edge in enumerate(edges):
        if not isinstance(edge, Edge) or np.ndim(edge.i):
            raise ValueError(f"edges[{k}]: expected a single Edge, got {edge!r}")
    xp = np if is_concrete(*edges) else jnp
    return jax.tree.map(lambda *values: xp.stack(values), *edges)


def _check_factor(name: str, factor: Any, num_poses: int) -> None:
    if not isinstance(factor, AbstractFactor):
        raise ValueError(f"{name}: expected an AbstractFactor, got {type(factor).__name__}")
    rows, information = np.shape(factor.rows), np.shape(factor.information)
    if len(information) != 3 or information[1] != information[2] or rows != (information[0], 2):
        raise ValueError(f"{name}: expected rows (m, 2) and information (m, d, d), got {rows} and {information}")
    if is_concrete(factor.rows):
        check_rows(name, np.asarray(factor.rows), num_poses)


def _initial(edges: Edge) -> Float[np.ndarray, "n 4 4"]:
    """Poses to start from.

    A spanning tree prefers edges that are no loops, then loops, then edges without information on some direction. Parts
    that are not connected with the world begin at the identity.
    """
    if not is_concrete(edges) or not len(edges):
        raise ValueError("poses: required, since initial poses can only be computed from at least one concrete edge")
    number = int(max(np.max(edges.i), np.max(edges.j))) + 1
    edges = checked_edges(edges, number)
    information: Any = edges.information
    # An edge of the identity from the world to each pose, to be used last, keeps other parts.
    i = np.concatenate([np.where(edges.i == WORLD, number, edges.i), np.full(number, number)])
    j = np.concatenate([edges.j, np.arange(number)])
    motions = np.concatenate([edges.T_i_j, np.tile(np.eye(4), (number, 1, 1))])
    values = np.linalg.eigvalsh(information)
    rank = np.concatenate([edges.uncertain + 2 * (values[:, 0] <= _BLIND * values[:, -1]), np.full(number, 4)])
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
