"""Terms: the cost of each correspondence, with its force and stiffness.

The force is minus the gradient of half the cost with respect to the moved point T a, and the stiffness the Gauss-Newton
Hessian of half the cost. Any residual that is linear in T a to first order has this form, and terms add.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar
from mcgicp_jax._local_geometry.local_geometry import LocalGeometry, Surface
from mcgicp_jax._local_geometry.neighborhoods import Neighborhoods
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.robust_kernels import AbstractKernel, Numbers


class Linearization(eqx.Module):
    """Forces, stiffnesses and costs of n correspondences. Terms are combined by `+`.

    Attributes:
        force: (3, n) w M d, with the residual d = b − T a.
        stiffness: (6, n) w M, symmetric.
        cost: (n,) ρ(dᵀ M d).
        weight: (n,) robust weight w. In a sum, `weight`, `residual` and `information` are those of the first term.
        residual: (3, n) d, metres.
        information: (6, n) M, symmetric.
    """

    force: Float[Array, "3 n"]
    stiffness: Float[Array, "6 n"]
    cost: Float[Array, "n"]
    weight: Float[Array, "n"]
    residual: Float[Array, "3 n"]
    information: Float[Array, "6 n"]

    def __add__(self, other: Linearization) -> Linearization:
        force, stiffness, cost = self.force + other.force, self.stiffness + other.stiffness, self.cost + other.cost
        return Linearization(force, stiffness, cost, self.weight, self.residual, self.information)

    def scaled(self, factor: Float[Array, "n"]) -> Linearization:
        """Force, stiffness, cost and weight of each correspondence multiplied by a factor."""
        force, stiffness, cost, weight = (factor * x for x in (self.force, self.stiffness, self.cost, self.weight))
        return Linearization(force, stiffness, cost, weight, self.residual, self.information)


def linearize_residual(
    residual: Float[Array, "3 n"], information: Float[Array, "6 n"], robust: AbstractKernel | None
) -> Linearization:
    """Linearization of the cost ρ(dᵀ M d) of residuals d with information matrices M; None: ρ(s²) = s²."""
    gradient = alg.multiply(information, residual)
    square = alg.inner(residual, gradient)
    weight, cost = (jnp.ones_like(square), square) if robust is None else (robust.weight(square), robust.rho(square))
    return Linearization(weight * gradient, weight * information, cost, weight, residual, information)


class PosedMatches(NamedTuple):
    """n matched points at a pose.

    Attributes:
        source, target: the surfaces at the matched points, in the frame of each cloud.
        moved: T a, the moved source points, metres.
        rotation: of T_target_source.
        valid: which correspondences count; the residual of the others is 0.
    """

    source: Surface
    target: Surface
    moved: Float[Array, "3 n"]
    rotation: Float[Array, "3 3"]
    valid: Bool[AnyArray, "n"]

    @property
    def residual(self) -> Float[Array, "3 n"]:
        """d = b − T a, metres."""
        return jnp.where(self.valid, self.target.points.T - self.moved, 0)


class AbstractTerm(Numbers):
    """A residual of each correspondence. A subclass defines `linearize`; the other members have defaults.

    Attributes:
        robust: kernel of the residuals; None for squares.
    """

    # Key in `Surface.columns`, for terms that define `columns`.
    name: ClassVar[str] = ""
    # Whether matches of the fine phase are nearest in position alone, even if the method also searches in channels.
    by_position: ClassVar[bool] = False
    # Edge of the cells within which scores are treated as correlated, in distances to the farthest neighbour. Values
    # from 1 to 4 hardly change the covariance of a pose.
    correlation_length: ClassVar[float] = 2.0

    robust: AbstractKernel | None = eqx.field(default=None, kw_only=True)

    @staticmethod
    def columns(around: Neighborhoods, local: LocalGeometry | None) -> Any:
        """Further values of each point for `linearize`, in `Surface.columns[name]`: a pytree of (n, ...) arrays, or
        None."""
        return None

    @property
    def estimates_gains(self) -> bool:
        """Whether the term estimates gains and offsets of the channels."""
        return False

    @property
    def matches_slide(self) -> bool:
        """True if nearest neighbours slide along the surface with the pose (points); False if they stay (cells)."""
        return True

    @abc.abstractmethod
    def linearize(self, matches: PosedMatches) -> Linearization:
        """Force, stiffness and cost of each correspondence."""


class AbstractAdaptiveTerm(AbstractTerm):
    """A term that estimates numbers, such as a scale, from the residuals at each pose of the fine phase.

    The numbers are constants to autodiff. A registration with such a term always starts with a coarse phase, in which
    the term has its initial numbers.
    """

    @abc.abstractmethod
    def sample(self, matches: PosedMatches) -> Any:
        """Input of `adapt` for each correspondence, a pytree of arrays (n, ...)."""

    @abc.abstractmethod
    def adapt(self, sample: Any, fraction: Float[AnyScalar, ""]) -> AbstractTerm:
        """The term with its numbers estimated from a sample; computed by NumPy if the sample is concrete.

        Args:
            sample: result of `sample` for an even sample of the source points, NaN for points without a match.
            fraction: fraction of all source points that are in the sample and have a match.
        """

    @abc.abstractmethod
    def with_numbers_of(self, other: AbstractTerm) -> AbstractTerm:
        """The term with the estimated numbers of another one, as constants to autodiff."""

    @property
    @abc.abstractmethod
    def shifts(self) -> Float[AnyArray, "s 3"]:
        """Translations of the source, metres, at which `with_response` needs samples."""

    @abc.abstractmethod
    def with_response(self, samples: Any) -> AbstractTerm:
        """The term for the covariance of the pose. Its stiffness is the change of the force when the points move and
        are matched again; `samples` are stacked results of `sample` at each of the `shifts`, with new matches."""


def is_adaptive(terms: tuple[AbstractTerm, ...]) -> bool:
    return any(isinstance(term, AbstractAdaptiveTerm) for term in terms)


def with_numbers_of(terms: tuple[AbstractTerm, ...], others: tuple[AbstractTerm, ...]) -> tuple[AbstractTerm, ...]:
    return tuple(
        term.with_numbers_of(other) if isinstance(term, AbstractAdaptiveTerm) else term
        for term, other in zip(terms, others, strict=True)
    )


def linearize(terms: tuple[AbstractTerm, ...], matches: PosedMatches) -> Linearization:
    first, *others = (term.linearize(matches) for term in terms)
    return sum(others, start=first)


class Mahalanobis(AbstractTerm):
    """ρ(dᵀ M d), where a method defines M.

    Attributes:
        method: an `AbstractMethod`.
    """

    method: Any

    @property
    def matches_slide(self) -> bool:
        return not self.method.needs_covariances

    def linearize(self, matches: PosedMatches) -> Linearization:
        target, source = matches.target.covariance.T, matches.source.covariance.T
        information = self.method.information(target, source, matches.rotation)
        return linearize_residual(matches.residual, information, self.robust)
