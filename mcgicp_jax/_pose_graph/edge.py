"""Measurements in a pose graph: their interface, and edges, which measure the motion between two poses."""

from __future__ import annotations

import abc
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.concrete import is_concrete, numpy_for
from mcgicp_jax._math.poses import Pose, adjoint, inverse, logarithm, logarithm_derivative, matrix_of, pose_matrices

# Row of the world's frame, whose pose is the identity. Unlike −1, it is not a row of any array.
WORLD = -(2**31)
# Rounding of an information matrix: its largest asymmetry and negative eigenvalue, as fractions of its largest
# eigenvalue. g2o files have six digits.
_ROUNDING = 1e-6
# The edges of a graph, and then its `AbstractFactor`s of other kinds.
Factors: TypeAlias = tuple[Any, ...]


class AbstractFactor(eqx.Module):
    """m measurements of one kind, each a function of two poses; a pytree of arrays with a leading axis of length m.

    The cost of a measurement is ½ rᵀΛr. A subclass provides the fields below and `linearize`.

    Attributes:
        rows: (m, 2), rows of the two poses of each measurement. For measurements in the world's frame, such as heights,
            the first one is `WORLD`.
        information: (m, d, d), Λ, the inverse covariance of the residual; symmetric, positive semidefinite.
        uncertain: (m,), whether the measurement may be an outlier, so that `optimize_poses` may reject it.
    """

    rows: eqx.AbstractVar[Int[Array, "*m 2"] | Int[np.ndarray, "*m 2"]]
    information: eqx.AbstractVar[Float[Array, "*m d d"] | Float[np.ndarray, "*m d d"]]
    uncertain: eqx.AbstractVar[Bool[Array, "*m"] | Bool[np.ndarray, "*m"]]

    @abc.abstractmethod
    def linearize(
        self, poses: Float[np.ndarray, "m 2 4 4"]
    ) -> tuple[Float[np.ndarray, "m d"], Float[np.ndarray, "m 2 d 6"]]:
        """Residuals r, and their derivatives with respect to the twists ξ = (v, ω) of both poses T exp(ξ).

        Called on the host with NumPy arrays in float64, also by compiled programs: it must not call JAX.

        Args:
            poses: sensor to world, metres; the identity for `WORLD`.
        """


def check_rows(name: str, rows: Int[np.ndarray, "m 2"], num_poses: int) -> None:
    outside = ((rows < 0) & (rows != WORLD)) | (rows >= num_poses)
    if outside.any():
        raise ValueError(f"{name}: expected rows from 0 to {num_poses - 1} or WORLD, got {rows[outside][0]}")


class Edge(AbstractFactor):
    """A measured motion between two poses of a graph, with its information matrix; a pytree.

    One `Edge` holds m edges if all fields have a leading axis of length m. A prior on a pose, such as a known start or
    a GNSS position, is an edge from the world: `Edge(WORLD, j, T_world_j, covariance=...)`.

    Attributes:
        i, j: rows of the two poses in `PoseGraph.poses`, integers. `i` may be `WORLD`.
        T_i_j: (4, 4), the measured T_i⁻¹ T_j, which maps coordinates of frame j to frame i; metres. For a position-only
            measurement, set the rotation to an estimate (for instance that of a nearby pose) and its rows and columns
            of `information` to zero. v is expressed in the axes of this rotation.
        information: (6, 6), inverse covariance of ξ = (v, ω) in T_i_j exp(ξ), the tangent of
            `RegistrationResult.covariance`, metres and radians; symmetric, positive semidefinite. Zero along directions
            that were not measured.
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
                definite, `i` or `j` is not an integer, or the shapes do not fit.
        """
        if (information is None) == (covariance is None):
            raise ValueError("information: expected either an information or a covariance matrix, got both or neither")
        self.i, self.j = _rows("i", i), _rows("j", j)
        self.T_i_j = _as_float("T_i_j", matrix_of(T_i_j))
        if information is not None:
            self.information = _as_float("information", information)
        elif not is_concrete(covariance):
            self.information = jnp.linalg.inv(covariance)
        else:
            matrix = np.asarray(_as_float("covariance", covariance))
            if matrix.shape[-2:] != (6, 6):
                raise ValueError(f"covariance: expected shape (6, 6), got {matrix.shape}")
            if not np.isfinite(matrix).all():
                raise ValueError("covariance: expected finite numbers, got NaN or infinity")
            sigma = np.sqrt(np.abs(np.diagonal(matrix, 0, -2, -1)))
            limit = _ROUNDING * sigma[..., :, None] * sigma[..., None, :]
            if np.any(np.abs(matrix - matrix.swapaxes(-1, -2)) > limit):
                raise ValueError(f"covariance: expected a symmetric matrix, got {matrix}")
            try:
                np.linalg.cholesky(matrix)
            except np.linalg.LinAlgError as error:
                raise ValueError("covariance: expected a positive definite matrix") from error
            inverted = np.linalg.inv(matrix)
            self.information = 0.5 * (inverted + inverted.swapaxes(-1, -2))
        shape = np.shape(self.i)
        traced = isinstance(uncertain, jax.Array)
        self.uncertain = jnp.asarray(uncertain) if traced else np.broadcast_to(np.asarray(uncertain, bool), shape)
        for name, tail in (("i", ()), ("j", ()), ("T_i_j", (4, 4)), ("information", (6, 6)), ("uncertain", ())):
            if np.shape(getattr(self, name)) != shape + tail:
                raise ValueError(f"{name}: expected shape {shape + tail}, got {np.shape(getattr(self, name))}")

    @property  # type: ignore[misc]
    def rows(self) -> Any:  # type: ignore[override]
        """(m, 2), `i` and `j`."""
        return numpy_for(self.i, self.j).stack([self.i, self.j], axis=-1)

    def linearize(
        self, poses: Float[np.ndarray, "m 2 4 4"]
    ) -> tuple[Float[np.ndarray, "m 6"], Float[np.ndarray, "m 2 6 6"]]:
        """r = log(T_i_j⁻¹ T_i⁻¹ T_j), and ∂r/∂ξ_i and ∂r/∂ξ_j."""
        residual = logarithm(inverse(np.asarray(self.T_i_j)) @ (inverse(poses[:, 0]) @ poses[:, 1]))
        return residual, logarithm_derivative(residual)[:, None] @ motion_jacobians(poses)

    def __len__(self) -> int:
        return len(self.i)

    def __getitem__(self, rows: Any) -> Edge:
        """One edge, or those of a slice, mask or list of rows."""
        return jax.tree.map(lambda values: values[rows], self)


def motion_jacobians(poses: Float[np.ndarray, "m 2 4 4"]) -> Float[np.ndarray, "m 2 6 6"]:
    """Derivatives of the twist of the motion T_i⁻¹ T_j with respect to those of both poses."""
    by_first = -adjoint(inverse(poses[:, 1]) @ poses[:, 0])
    return np.stack([by_first, np.broadcast_to(np.eye(6), by_first.shape)], axis=1)


def checked_edges(edges: Edge, num_poses: int) -> Edge:
    """The edges as NumPy arrays, with exact rotations and symmetric information; raises `ValueError` for a bad one."""
    i, j = np.asarray(edges.i), np.asarray(edges.j)
    _refuse(f"i: expected a row from 0 to {num_poses - 1}", (i != WORLD) & ((i < 0) | (i >= num_poses)), i)
    _refuse(f"j: expected a row from 0 to {num_poses - 1}", (j < 0) | (j >= num_poses), j)
    _refuse("expected two different poses", i == j, i)
    transforms = pose_matrices(edges.T_i_j, "edges[{}].T_i_j") if len(i) else np.zeros((0, 4, 4))
    information = np.asarray(edges.information, np.float64)
    _refuse("information: expected finite numbers", np.isnan(information.sum(axis=(1, 2)) * 0.0), information)
    symmetric = 0.5 * (information + information.swapaxes(1, 2))
    eigenvalues = np.linalg.eigvalsh(symmetric)
    limit = _ROUNDING * np.abs(eigenvalues).max(axis=1, initial=0)
    asymmetry = np.abs(information - symmetric).max(axis=(1, 2), initial=0)
    _refuse("information: expected a symmetric matrix", asymmetry > limit, information)
    negative = eigenvalues[:, 0] < -limit
    _refuse("information: expected a positive semidefinite matrix; eigenvalues", negative, eigenvalues)
    return Edge(i, j, transforms, symmetric, uncertain=np.asarray(edges.uncertain, bool))


def _refuse(expected: str, wrong: Bool[np.ndarray, "m"], values: np.ndarray) -> None:
    if wrong.any():
        k = int(np.argmax(wrong))
        raise ValueError(f"edges[{k}]: {expected}, got {values[k]}")


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
