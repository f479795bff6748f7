"""Pose graphs: poses, and measurements of the motion between two of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._math.poses import Pose, pose_matrix
from mcgicp_jax._pose_graph.initialization import initial_poses

# What `Edge.i` is for a measurement in the world's frame. Unlike −1, it is not a row of any array.
WORLD = -(2**31)

# Largest negative eigenvalue of an information matrix that counts as rounding, as a fraction of the largest one; and
# largest asymmetry. g2o files have six digits.
_ROUNDING = 1e-6


class Edge(eqx.Module):
    """A measured motion between two poses of a graph, with its information matrix; a pytree.

    If all fields have a leading axis of length m, one `Edge` holds m edges. A prior on a pose, such as a known start or
    a position from GNSS, is an edge from the world: `Edge(WORLD, j, T_world_j, covariance=...)`.

    Attributes:
        i, j: rows of the two poses in `PoseGraph.poses`, integers. `i` may be `WORLD`.
        T_i_j: (4, 4), the measured T_i⁻¹ T_j, which maps coordinates of frame j to frame i; metres. For a position
            without a rotation give one near the true one, such as that of the first poses, and no information about
            it; v is along its axes.
        information: (6, 6), inverse covariance of ξ = (v, ω) in T_i_j exp(ξ), the tangent of `Registration.covariance`,
            metres and radians; symmetric, positive semidefinite. Zero along directions that were not measured.
        uncertain: whether the measurement may be an outlier, so that `optimize_poses` may reject the edge.
    """

    i: Int[Array, "*batch"] | Int[np.ndarray, "*batch"]
    j: Int[Array, "*batch"] | Int[np.ndarray, "*batch"]
    T_i_j: Float[Array, "*batch 4 4"] | Float[np.ndarray, "*batch 4 4"]
    information: Float[Array, "*batch 6 6"] | Float[np.ndarray, "*batch 6 6"]
    uncertain: Bool[Array, "*batch"] | Bool[np.ndarray, "*batch"]

    def __init__(
        self,
        i: ArrayLike,
        j: ArrayLike,
        T_i_j: Pose,
        information: ArrayLike | None = None,
        *,
        covariance: ArrayLike | None = None,
        uncertain: ArrayLike = False,
    ):
        """Create one edge, or several from arguments with a leading axis (a single `uncertain` then holds for all).

        Args:
            i, j, T_i_j, information, uncertain: see the class. `T_i_j` may be a `jaxlie.SE3`.
            covariance: (6, 6), positive definite; its inverse becomes the information. Give this or `information`.

        Raises:
            ValueError: if not exactly one of `information` and `covariance` is given, if a covariance is not positive
                definite, if `i` or `j` is not an integer, or if the shapes do not fit.
        """
        if (information is None) == (covariance is None):
            raise ValueError("information: expected either an information or a covariance matrix, got both or neither")
        self.i, self.j = _rows("i", i), _rows("j", j)
        self.T_i_j = _as_float("T_i_j", T_i_j.as_matrix() if isinstance(T_i_j, jaxlie.SE3) else T_i_j)
        self.information = _inverse(covariance) if information is None else _as_float("information", information)
        shape = np.shape(self.i)
        known = not isinstance(uncertain, jax.Array)
        self.uncertain = np.broadcast_to(np.asarray(uncertain, bool), shape) if known else uncertain
        for name, tail in (("i", ()), ("j", ()), ("T_i_j", (4, 4)), ("information", (6, 6)), ("uncertain", ())):
            if np.shape(getattr(self, name)) != shape + tail:
                raise ValueError(f"{name}: expected shape {shape + tail}, got {np.shape(getattr(self, name))}")

    def __len__(self) -> int:
        return len(self.i)

    def __getitem__(self, rows: Any) -> Edge:
        """One edge, or those of a slice, mask or list of rows."""
        return jax.tree.map(lambda values: values[rows], self)


class PoseGraph(eqx.Module):
    """Poses of a sensor and measured motions between them; a pytree.

    Attributes:
        poses: (n, 4, 4), sensor to world, metres. `optimize_poses` starts from these poses. It holds the first one,
            unless there are edges from the world.
        edges: the m measured motions: one `Edge` whose fields have a leading axis of length m.
    """

    poses: Float[Array, "n 4 4"] | Float[np.ndarray, "n 4 4"]
    edges: Edge

    def __init__(self, poses: ArrayLike | Sequence[Pose] | None, edges: Sequence[Edge] | Edge):
        """Create a graph.

        Args:
            poses: an array (n, 4, 4), or a sequence of n `jaxlie.SE3` or (4, 4) matrices. With None, they are found
                from the edges by chordal relaxation (Carlone et al. 2015). Loops, which may be false, and edges without
                information on some direction only connect what others do not. Each part of the graph that has no prior
                then begins at the identity.
            edges: a sequence of single edges, or one `Edge` with a leading axis. Several edges may join the same poses.

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
        elif not isinstance(poses, jax.Array):
            poses = np.array([pose_matrix(pose, f"poses[{k}]") for k, pose in enumerate(poses)])  # type: ignore
        if np.ndim(poses) != 3 or np.shape(poses)[1:] != (4, 4):
            raise ValueError(f"poses: expected at least one pose of shape (4, 4), got shape {np.shape(poses)}")
        self.poses = poses
        if is_concrete(self.edges):
            self.edges = _checked(self.edges, len(poses))


def _rows(name: str, values: ArrayLike) -> Any:
    array = values if isinstance(values, jax.Array) else np.asarray(values)
    if array.dtype.kind not in "iu":
        raise ValueError(f"{name}: expected the row of a pose, got {values!r}")
    return array


def _as_float(name: str, values: Any) -> Any:
    if isinstance(values, jax.Array):
        return values
    try:
        return np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected an array of numbers, got {values!r}") from error


def _inverse(covariance: Any) -> Any:
    if not is_concrete(covariance):
        return jnp.linalg.inv(covariance)
    covariance = np.asarray(_as_float("covariance", covariance))
    if covariance.shape[-2:] != (6, 6):
        raise ValueError(f"covariance: expected shape (6, 6), got {covariance.shape}")
    if not np.isfinite(covariance).all():
        raise ValueError("covariance: expected finite numbers, got NaN or infinity")
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as error:
        raise ValueError("covariance: expected a positive definite matrix") from error
    inverse = np.linalg.inv(covariance)
    return 0.5 * (inverse + np.swapaxes(inverse, -1, -2))


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
        raise ValueError("poses: expected poses, since the edges are none or traced")
    number = int(max(np.max(edges.i), np.max(edges.j))) + 1
    edges = _checked(edges, number)
    i, j = np.where(edges.i == WORLD, number, edges.i), np.asarray(edges.j)
    uncertain = np.asarray(edges.uncertain)
    return initial_poses(i, j, np.asarray(edges.T_i_j), np.asarray(edges.information), uncertain, number)


def _checked(edges: Edge, num_poses: int) -> Edge:
    """The edges as NumPy arrays, with exact rotations and symmetric information."""
    i, j = np.asarray(edges.i), np.asarray(edges.j)
    for name, rows, other in (("i", i, i == WORLD), ("j", j, False)):
        outside = ((rows < 0) | (rows >= num_poses)) & ~np.asarray(other)
        _refuse(f"{name}: expected a row from 0 to {num_poses - 1}", outside, rows)
    _refuse("expected two different poses", i == j, i)
    transforms = np.asarray(edges.T_i_j, np.float64)
    transforms = np.array([pose_matrix(each, f"edges[{k}].T_i_j") for k, each in enumerate(transforms)])
    information = np.asarray(edges.information, np.float64)
    _refuse("information: expected finite numbers", np.isnan(information.sum(axis=(1, 2)) * 0.0), information)
    symmetric = 0.5 * (information + information.swapaxes(1, 2))
    values = np.linalg.eigvalsh(symmetric)
    limit = _ROUNDING * np.abs(values).max(axis=1, initial=0)
    asymmetry = np.abs(information - symmetric).max(axis=(1, 2), initial=0)
    _refuse("information: expected a symmetric matrix", asymmetry > limit, information)
    _refuse("information: expected a positive semidefinite matrix; eigenvalues", values[:, 0] < -limit, values)
    return Edge(i, j, transforms.reshape(-1, 4, 4), symmetric, uncertain=np.asarray(edges.uncertain, bool))


def _refuse(what: str, bad: np.ndarray, values: np.ndarray) -> None:
    if bad.any():
        k = int(np.argmax(bad))
        raise ValueError(f"edges[{k}]: {what}, got {values[k]}")
