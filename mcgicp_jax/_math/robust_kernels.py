"""Robust kernels: costs and weights as functions of the Mahalanobis distance of one correspondence."""

from __future__ import annotations

import abc
import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, canonical_float, is_concrete, numpy_for
from mcgicp_jax._compute.devices import put_on_cpu


class Numbers(eqx.Module):
    """An equinox module with numeric fields, whose `repr` shows their values."""

    # As in `PointCloud`.
    __getattribute__ = object.__getattribute__

    def __repr__(self) -> str:
        parts = []
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value is not None and is_concrete(value):
                value = np.array2string(np.asarray(value), precision=4, separator=", ")
            parts.append(f"{field.name}={value}")
        return f"{type(self).__name__}({', '.join(parts)})"


def number_of(name: str, value: Any) -> Array:
    """`value` as an array in the default precision; `ValueError` for the parameter `name` if it is no number."""
    try:
        # NumPy converts concrete values without compiling a program.
        return put_on_cpu(np.asarray(value, canonical_float())) if is_concrete(value) else jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected numbers, got {value!r}") from error


def positive_scalar(name: str, value: ArrayLike) -> Float[Array, ""]:
    number = number_of(name, value)
    if number.shape != () or (is_concrete(number) and not 0 < float(number) < np.inf):
        raise ValueError(f"{name}: expected one positive number, got {value!r}")
    return number


class AbstractKernel(Numbers):
    """A robust kernel: cost ρ(s²) and weight dρ/d(s²) of a correspondence with Mahalanobis distance s; ρ ≈ s² near 0.

    Attributes:
        scale: k, the Mahalanobis distance at which weights fall (`Huber`: beyond it). Covariances of GICP are
            dimensionless, 1 within the surface and ε = 0.001 across it: k = 1 is 1.4 m within the surface, but 4.5 cm
            across it, and √(2 ε) m with the larger ε that `MultiChannelGICP` chooses on noisy surfaces.
    """

    scale: Float[Array, ""]

    def __init__(self, scale: ArrayLike):
        """`scale` is k. Raises `ValueError` unless it is one positive, finite number."""
        self.scale = positive_scalar("scale", scale)

    @abc.abstractmethod
    def _rho(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]: ...

    @abc.abstractmethod
    def _weight(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]: ...

    def rho(self, square: Float[Array, "N"]) -> Float[Array, "N"]:
        """ρ(s²), the cost of each correspondence; `square` is s², metres²."""
        return self._rho(square, self.scale.astype(square.dtype))

    def weight(self, square: Float[Array, "N"]) -> Float[Array, "N"]:
        """dρ/d(s²), the weight of each correspondence, 1 at s = 0; `square` is s², metres²."""
        return self._weight(square, self.scale.astype(square.dtype))


class Huber(AbstractKernel):
    """Huber kernel: ρ = s² for s up to k, 2ks − k² beyond."""

    def _rho(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        beyond = square > scale**2
        distance = jnp.sqrt(jnp.where(beyond, square, 1))
        return jnp.where(beyond, 2 * scale * distance - scale**2, square)

    def _weight(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        beyond = square > scale**2
        return jnp.where(beyond, scale / jnp.sqrt(jnp.where(beyond, square, 1)), 1)


class Cauchy(AbstractKernel):
    """Cauchy kernel: ρ = k² log(1 + s²/k²)."""

    def _rho(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return scale**2 * jnp.log1p(square / scale**2)

    def _weight(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return 1 / (1 + square / scale**2)


class GemanMcClure(AbstractKernel):
    """Geman-McClure kernel: ρ = s² / (1 + s²/k²)."""

    def _rho(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return square / (1 + square / scale**2)

    def _weight(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return 1 / (1 + square / scale**2) ** 2


class Welsch(AbstractKernel):
    """Welsch kernel: ρ = k² (1 − exp(−s²/k²)). The score of an NDT is a sum of such terms."""

    def _rho(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return -(scale**2) * jnp.expm1(-square / scale**2)

    def _weight(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return jnp.exp(-square / scale**2)


class Tukey(AbstractKernel):
    """Tukey's biweight kernel: ρ = k²/3 (1 − (1 − s²/k²)³) for s up to k; constant beyond, with weight 0."""

    def _rho(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return scale**2 / 3 * (1 - jnp.maximum(1 - square / scale**2, 0) ** 3)

    def _weight(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return jnp.maximum(1 - square / scale**2, 0) ** 2


def truncated_weights(ratio: Float[AnyArray, "*batch"], control: AnyScalar) -> Float[AnyArray, "*batch"]:
    """Weights of truncated squares in graduated non-convexity (Yang et al., RA-L 2020, eq. 14): `ratio` is the
    threshold over the residual; the larger `control`, μ, the steeper they fall from 1 to 0 around the threshold."""
    xp = numpy_for(ratio, control)
    return xp.clip(ratio * xp.sqrt(control * (control + 1)) - control, 0, 1)


KERNELS: dict[str, type[AbstractKernel]] = {
    "huber": Huber,
    "cauchy": Cauchy,
    "geman-mcclure": GemanMcClure,
    "tukey": Tukey,
    "welsch": Welsch,
}
