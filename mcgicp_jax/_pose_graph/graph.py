"""Pose graphs: poses, measured motions between them, and other measurements; and initial poses.

Initial poses follow a spanning tree of the edges. Since errors add up along it, they are then replaced by the chordal
relaxation of the trusted edges: two sparse linear least-squares problems, one for rotations as free 3×3 matrices, which
are then made orthonormal, and one for positions (Martinec & Pajdla, CVPR 2007; Carlone et al., ICRA 2015).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int
from scipy.sparse import bsr_array, coo_array

from mcgicp_jax._compute.concrete import is_concrete, numpy_for
from mcgicp_jax._math.poses import Pose, pose_matrices
from mcgicp_jax._pose_graph.edge import WORLD, AbstractFactor, Edge, check_rows, checked_edges
from mcgicp_jax._pose_graph.levenberg_marquardt import factored

# An edge does not measure a direction whose eigenvalue of information is below this fraction of the largest one.
UNMEASURED = 1e-6


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
        if isinstance(edges, Edge):
            self.edges = edges
        elif not edges:
            self.edges = Edge(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))
        else:
            for k, edge in enumerate(edges):
                if not isinstance(edge, Edge) or np.ndim(edge.i):
                    raise ValueError(f"edges[{k}]: expected a single Edge, got {edge!r}")
            xp = numpy_for(*edges)
            self.edges = jax.tree.map(lambda *values: xp.stack(values), *edges)
        if np.ndim(self.edges.i) != 1:
            raise ValueError(f"edges: expected one leading axis, got shape {np.shape(self.edges.i)}")
        matrices: Any = poses
        if poses is None:
            matrices = _initial_poses(self.edges)
        elif is_concrete(poses):
            matrices = pose_matrices(poses)
        elif np.ndim(matrices) != 3 or matrices.shape[1:] != (4, 4):
            raise ValueError(f"poses: expected at least one pose of shape (4, 4), got shape {np.shape(matrices)}")
        self.poses = matrices
        if is_concrete(self.edges):
            self.edges = checked_edges(self.edges, len(self.poses))
        for k, factor in enumerate(factors):
            name = f"factors[{k}]"
            if not isinstance(factor, AbstractFactor):
                raise ValueError(f"{name}: expected an AbstractFactor, got {type(factor).__name__}")
            rows, shape = np.shape(factor.rows), np.shape(factor.information)
            if len(shape) != 3 or shape[1] != shape[2] or rows != (shape[0], 2):
                raise ValueError(f"{name}: expected rows (m, 2) and information (m, d, d), got {rows} and {shape}")
            if is_concrete(factor.rows):
                check_rows(name, np.asarray(factor.rows), len(self.poses))
        self.factors = tuple(factors)


def _initial_poses(edges: Edge) -> Float[np.ndarray, "n 4 4"]:
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    if not is_concrete(edges) or not len(edges):
        raise ValueError("poses: required, since initial poses can only be computed from at least one concrete edge")
    n = int(max(np.max(edges.i), np.max(edges.j))) + 1
    edges = checked_edges(edges, n)
    # The world's row is the last one. Identity edges from the world to every pose join unconnected parts of the graph.
    from_world = np.stack([np.full(n, n), np.arange(n)], axis=1)
    ends = np.concatenate([np.where(edges.rows == WORLD, n, edges.rows), from_world])
    motions = np.concatenate([edges.T_i_j, np.tile(np.eye(4), (n, 1, 1))])
    # A spanning tree of lowest rank: it prefers certain edges (rank 0) to uncertain ones (1), then to those with an
    # unmeasured direction (2 and 3), and uses the identity edges last.
    eigenvalues = np.linalg.eigvalsh(edges.information)
    unmeasured = eigenvalues[:, 0] <= UNMEASURED * eigenvalues[:, -1]
    rank = np.concatenate([edges.uncertain + 2 * unmeasured, np.full(n, 4)])
    order = np.argsort(rank, kind="stable")
    # Of several edges between two poses, the first one in order of rank. Weights are places in this order, from 1.
    _, places = np.unique((ends.min(axis=1) * (n + 1) + ends.max(axis=1))[order], return_index=True)
    tree = minimum_spanning_tree(coo_array((places + 1.0, tuple(ends[order[places]].T)), (n + 1, n + 1)))
    tree = (tree + tree.T).tocsr()
    # Poses along the tree from the world.
    nodes, parents = breadth_first_order(tree, n)
    in_tree = order[tree[parents[nodes[1:]], nodes[1:]].astype(int) - 1]
    poses = np.tile(np.eye(4), (n + 1, 1, 1))
    for node, edge in zip(nodes[1:], in_tree, strict=True):
        motion = motions[edge] if ends[edge, 1] == node else np.linalg.inv(motions[edge])
        poses[node] = poses[parents[node]] @ motion
    # The relaxation uses the certain edges and those of the tree.
    trusted = rank == 0
    trusted[in_tree] = True
    if trusted.sum() <= n:
        return poses[:n]
    # Mean information in translation and in rotation.
    means = np.diagonal(edges.information, axis1=1, axis2=2).reshape(-1, 2, 3).mean(axis=2)
    means = np.concatenate([np.where(means > 0, means, 1), np.ones((n, 2))])
    return _chordal_relaxation(ends[trusted], motions[trusted], np.sqrt(means[trusted]), n)


def _chordal_relaxation(
    ends: Int[np.ndarray, "m 2"], motions: Float[np.ndarray, "m 4 4"], roots: Float[np.ndarray, "m 2"], n: int
) -> Float[np.ndarray, "n 4 4"]:
    """`roots`: square roots of the information in translation and in rotation."""

    def least_squares(blocks: Float[np.ndarray, "m 2 b b"], right: np.ndarray, world: np.ndarray) -> np.ndarray:
        """The solution of a sparse system with two blocks in each row, for the last pose `world`."""
        m, _, b, _ = blocks.shape
        pointers = 2 * np.arange(m + 1)
        matrix = bsr_array((blocks.reshape(-1, b, b), ends.ravel(), pointers), (b * m, b * (n + 1))).tocsc()
        free, right = matrix[:, : b * n], right - matrix[:, b * n :] @ world
        solver = factored((free.T @ free).tocsc(), "MMD_AT_PLUS_A")
        return np.concatenate([solver.solve(free.T @ right), world])

    # R_jᵀ = R_i_jᵀ R_iᵀ, for the three columns at once.
    transposed = motions[:, :3, :3].swapaxes(1, 2)
    identities = np.broadcast_to(np.eye(3), transposed.shape)
    blocks = roots[:, 1, None, None, None] * np.stack([-transposed, identities], axis=1)
    columns = least_squares(blocks, np.zeros((3 * len(ends), 3)), np.eye(3))
    left, _, right = np.linalg.svd(columns.reshape(n + 1, 3, 3).swapaxes(1, 2))
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    rotations = left @ right
    # t_j − t_i = R_i t_i_j.
    blocks = roots[:, 0, None, None, None] * np.array([-1.0, 1.0])[:, None, None]
    steps = roots[:, :1] * np.einsum("mij,mj->mi", rotations[ends[:, 0]], motions[:, :3, 3])
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = rotations[:-1]
    poses[:, :3, 3] = least_squares(blocks, steps, np.zeros((1, 3)))[:-1]
    return poses
