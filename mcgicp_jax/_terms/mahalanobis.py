"""The Mahalanobis distance of matched points, the term of every ICP: dᵀ M d with d = b − T a."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from jaxtyping import Array, Float

from mcgicp_jax._terms.base import AbstractTerm, Linearization, PosedMatches, linearize_residual


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

    def linearize(self, matches: PosedMatches) -> Linearization:
        target, source = matches.target.covariance.T, matches.source.covariance.T
        information = self.method.information(target, source, matches.rotation)
        return linearize_residual(matches.residual, information, self.robust)
