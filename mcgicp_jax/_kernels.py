"""Robust kernels of the Mahalanobis distance of one correspondence."""

from __future__ import annotations

import abc
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mcgicp_jax._pose import canonical_float, is_concrete


class Numbers(eqx.Module):
    """A module of a few numbers, whose `repr` shows them."""

    def __repr__(self) -> str:
        parts = []
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if value is None or not is_concrete(value):
                parts.append(f"{field.name}={value}")
            else:
                parts.append(f"{field.name}={np.array2string(np.asarray(value), precision=4, separator=', ')}")
        return f"{type(self).__name__}({', '.join(parts)})"


class AbstractKernel(Numbers):
    """A robust kernel ρ of the squared Mahalanobis distance s² of one correspondence; ρ(s²) ≈ s² for small distances.

    Attributes:
        scale: k, the Mahalanobis distance from which a correspondence counts less; metres, as GICP's covariances are
            relative (1 within the surface).
    """

    scale: Float[Array, ""]

    def __init__(self, scale: ArrayLike):
        """Raises `ValueError` unless the scale is positive."""
        known = is_concrete(scale)
        self.scale = jax.device_put(np.asarray(scale, canonical_float())) if known else jnp.asarray(scale)
        if self.scale.shape != () or (is_concrete(self.scale) and not 0 < float(self.scale) < np.inf):
            raise ValueError(f"scale: expected one positive number, got {scale!r}")

    @abc.abstractmethod
    def _rho(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]: ...

    @abc.abstractmethod
    def _weight(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]: ...

    def rho(self, square: Float[Array, "N"]) -> Float[Array, "N"]:
        """The cost of correspondences with squared distance s²."""
        return self._rho(square, self.scale.astype(square.dtype))

    def weight(self, square: Float[Array, "N"]) -> Float[Array, "N"]:
        """dρ/d(s²): the weight of a correspondence."""
        return self._weight(square, self.scale.astype(square.dtype))


class Huber(AbstractKernel):
    """s² up to k, 2ks − k² beyond."""

    def _rho(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        beyond = square > scale**2
        distance = jnp.sqrt(jnp.where(beyond, square, 1))
        return jnp.where(beyond, 2 * scale * distance - scale**2, square)

    def _weight(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        beyond = square > scale**2
        return jnp.where(beyond, scale / jnp.sqrt(jnp.where(beyond, square, 1)), 1)


class Cauchy(AbstractKernel):
    """k² log(1 + s²/k²)."""

    def _rho(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return scale**2 * jnp.log1p(square / scale**2)

    def _weight(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return 1 / (1 + square / scale**2)


class GemanMcClure(AbstractKernel):
    """s² / (1 + s²/k²)."""

    def _rho(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return square / (1 + square / scale**2)

    def _weight(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return 1 / (1 + square / scale**2) ** 2


class Tukey(AbstractKernel):
    """k²/3 (1 − (1 − s²/k²)³) up to k, constant beyond: such correspondences have no weight."""

    def _rho(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return scale**2 / 3 * (1 - jnp.maximum(1 - square / scale**2, 0) ** 3)

    def _weight(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return jnp.maximum(1 - square / scale**2, 0) ** 2
