"""Pose graphs: poses, measured motions between them, and other measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._math.poses import Pose, pose_matrices
from mcgicp_jax._pose_graph.edge import WORLD, AbstractFactor, Edge, check_rows, checked_edges
from mcgicp_jax._pose_graph.initialization import initial_poses


class PoseGraph(eqx.Module):
    """Poses of a sensor, measured motions between them, and other measurements; a pytree.

    Attributes:
        poses: (n, 4, 4), sensor to world, metres, the initial poses of `optimize_poses`. The first one is held fixed,
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


def _initial(edges: Edge) -> Float[np.ndarray, "n 4 4"]:
    if not is_concrete(edges) or not len(edges):
        raise ValueError("poses: required, since initial poses can only be computed from at least one concrete edge")
    number = int(max(np.max(edges.i), np.max(edges.j))) + 1
    edges = checked_edges(edges, number)
    i, j = np.where(edges.i == WORLD, number, edges.i), np.asarray(edges.j)
    uncertain = np.asarray(edges.uncertain)
    return initial_poses(i, j, np.asarray(edges.T_i_j), np.asarray(edges.information), uncertain, number)


def _check_factor(name: str, factor: Any, num_poses: int) -> None:
    if not isinstance(factor, AbstractFactor):
        raise ValueError(f"{name}: expected an AbstractFactor, got {type(factor).__name__}")
    rows, information = np.shape(factor.rows), np.shape(factor.information)
    if len(information) != 3 or information[1] != information[2] or rows != (information[0], 2):
        raise ValueError(f"{name}: expected rows (m, 2) and information (m, d, d), got {rows} and {information}")
    if is_concrete(factor.rows):
        check_rows(name, np.asarray(factor.rows), num_poses)
