"""Force, stiffness and cost of each correspondence: the interface between methods and pose estimation.

The force is minus the gradient of half the cost with respect to the moved point T a, and the stiffness the Gauss-Newton
Hessian of half the cost. Any residual that is linear in T a to first order has this form.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.robust_kernels import AbstractKernel


class Forces(eqx.Module):
    """Forces, stiffnesses and costs of n correspondences. Several terms are combined by `+`.

    Attributes:
        force: (3, n) w M d, with the residual d = b − T a.
        stiffness: (6, n) w M, symmetric.
        cost: (n,) ρ(dᵀ M d).
        weight: (n,) w, the robust weight; of the first term of a sum, as are `residual` and `information`.
        residual: (3, n) d, metres.
        information: (6, n) M, symmetric.
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
        """Force, stiffness, cost and weight of each correspondence multiplied by a factor."""
        return Forces(
            factor * self.force,
            factor * self.stiffness,
            factor * self.cost,
            factor * self.weight,
            self.residual,
            self.information,
        )


def weighed(residual: Float[Array, "3 n"], information: Float[Array, "6 n"], robust: AbstractKernel | None) -> Forces:
    """Forces of residuals d with information matrices M: cost ρ(dᵀ M d), weight w = ρ′(dᵀ M d); None: ρ(s²) = s²."""
    gradient = alg.multiply(information, residual)
    square = alg.inner(residual, gradient)
    weight, cost = (jnp.ones_like(square), square) if robust is None else (robust.weight(square), robust.rho(square))
    return Forces(weight * gradient, weight * information, cost, weight, residual, information)
