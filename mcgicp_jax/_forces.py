"""Force, stiffness and cost of each correspondence: all that update, root, observability and covariance know of it.

Any residual that is linear in T a to first order can be written so: a force is minus the gradient of half its cost with
respect to the moved point T a, a stiffness the Gauss-Newton Hessian.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mcgicp_jax import _algebra as alg
from mcgicp_jax._kernels import AbstractKernel


class Forces(eqx.Module):
    """What each of n correspondences does to a pose. Terms add.

    Attributes:
        force: (3, n) w M d, with the residual d = b − T a.
        stiffness: (6, n) w M, symmetric.
        cost: (n,) ρ(dᵀ M d).
        weight: (n,) w, the robust weight; of the first term, where several were added.
        residual: (3, n) d, metres; likewise.
        information: (6, n) M, symmetric; likewise.
    """

    force: Float[Array, "3 n"]
    stiffness: Float[Array, "6 n"]
    cost: Float[Array, "n"]
    weight: Float[Array, "n"]
    residual: Float[Array, "3 n"]
    information: Float[Array, "6 n"]

    def __add__(self, other: Forces) -> Forces:
        return Forces(
            self.force + other.force,
            self.stiffness + other.stiffness,
            self.cost + other.cost,
            self.weight,
            self.residual,
            self.information,
        )

    def scaled(self, factor: Float[Array, "n"]) -> Forces:
        """Each correspondence counts so many times; 0 for none."""
        return Forces(
            factor * self.force,
            factor * self.stiffness,
            factor * self.cost,
            factor * self.weight,
            self.residual,
            self.information,
        )


def weighed(residual: Float[Array, "3 n"], information: Float[Array, "6 n"], robust: AbstractKernel | None) -> Forces:
    """Forces of residuals d with weight matrices M: cost ρ(dᵀ M d), weight w = ρ′."""
    pull = alg.multiply(information, residual)
    square = alg.inner(residual, pull)
    weight, cost = (jnp.ones_like(square), square) if robust is None else (robust.weight(square), robust.rho(square))
    return Forces(weight * pull, weight * information, cost, weight, residual, information)
