"""The interface of the measurements in a pose graph."""

from __future__ import annotations

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

# Row of the world's frame, whose pose is the identity. Unlike −1, it is not a row of any array.
WORLD = -(2**31)


class AbstractFactor(eqx.Module):
    """m measurements of one kind, each a function of two poses; a pytree of arrays with a leading axis of length m.

    The cost of a measurement is ½ rᵀΛr. A subclass provides the fields below and `linearize`; the solver and the
    covariances need nothing else.

    Attributes:
        rows: (m, 2), rows of the poses that each measurement depends on. The first one of a measurement in the world's
            frame, such as a height, is `WORLD`.
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

        Called on the host with NumPy arrays in float64, also from within compiled programs: it must not call JAX.

        Args:
            poses: sensor to world, metres; the identity for `WORLD`.
        """


def check_rows(name: str, rows: Int[np.ndarray, "m 2"], num_poses: int) -> None:
    """Raise `ValueError` for rows of poses outside of the graph."""
    outside = ((rows < 0) & (rows != WORLD)) | (rows >= num_poses)
    if outside.any():
        raise ValueError(f"{name}: expected rows from 0 to {num_poses - 1} or WORLD, got {rows[outside][0]}")
