"""The Mahalanobis distance of matched points, the term of every ICP: dᵀ M d with d = b − T a."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mcgicp_jax._local_geometry.surface import Surface
from mcgicp_jax._terms.base import AbstractTerm, Linearization, linearize_residual


@runtime_checkable
class HasInformation(Protocol):
    """The members of an `AbstractMethod` that the term uses."""

    @property
    def needs_covariances(self) -> tuple[str, ...]: ...

    def information(
        self, target: Float[Array, "6 n"], source: Float[Array, "6 n"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 n"]: ...


class Mahalanobis(AbstractTerm):
    """ρ(dᵀ M d), where a method defines M.

    Attributes:
        method: an `AbstractMethod`.
    """

    method: HasInformation

    @property
    def matches_slide(self) -> bool:
        """True for points, False for voxel cells."""
        return not self.method.needs_covariances

    def linearize(
        self,
        source: Surface,
        target: Surface,
        moved: Float[Array, "3 n"],
        rotation: Float[Array, "3 3"],
        valid: Bool[Array, "n"],
    ) -> Linearization:
        residual = jnp.where(valid, target.points.T - moved, 0)
        information = self.method.information(target.covariance.T, source.covariance.T, rotation)
        return linearize_residual(residual, information, self.robust)
