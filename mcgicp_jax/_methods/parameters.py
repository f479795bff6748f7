"""Checks of the parameters of methods."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mcgicp_jax._clouds.point_cloud import Values
from mcgicp_jax._compute.concrete import AnyArray, canonical_float, is_concrete, numpy_for
from mcgicp_jax._compute.devices import put_on_cpu


def per_channel(name: str, numbers: Float[AnyArray, "..."], num_channels: int) -> Float[AnyArray, "C"]:
    """The numbers broadcast to one per channel; `name` is the name of the parameter, for the error message."""
    if numbers.shape not in ((), (num_channels,)):
        raise ValueError(
            f"{name}: expected a scalar or shape ({num_channels},), for clouds of {num_channels} channels, "
            f"got {numbers.shape}"
        )
    xp = numpy_for(numbers)
    return xp.broadcast_to(xp.asarray(numbers), (num_channels,))


def check_covariance_fits(covariance: Float[AnyArray, "..."], count: int) -> None:
    if covariance.shape not in ((), (count,), (count, count)):
        raise ValueError(
            f"channel_covariance: expected a scalar, shape ({count},) or ({count}, {count}), for clouds of {count} "
            f"channels, got {covariance.shape}"
        )


def _number(name: str, value: Values) -> Array:
    try:
        # NumPy converts concrete values without compiling a program.
        return put_on_cpu(np.asarray(value, canonical_float())) if is_concrete(value) else jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected numbers, got {value!r}") from error


def positive_scalar(name: str, value: ArrayLike) -> Float[Array, ""]:
    number = _number(name, value)
    if number.shape != () or (is_concrete(number) and not 0 < float(number) < np.inf):
        raise ValueError(f"{name}: expected one positive number, got {value!r}")
    return number


def epsilon_of(value: ArrayLike) -> Float[Array, ""]:
    epsilon = positive_scalar("epsilon", value)
    # For smaller ε, 1 − (1 − ε) loses it to rounding, and the covariance becomes singular.
    least = 100 * float(jnp.finfo(epsilon.dtype).eps)
    if is_concrete(epsilon) and float(epsilon) < least:
        raise ValueError(f"epsilon: expected at least {least:.2g} in {epsilon.dtype}, got {value!r}")
    return epsilon


def weights_of(value: Values) -> Float[Array, "..."]:
    weights = _number("channel_weights", value)
    if weights.ndim > 1:
        raise ValueError(f"channel_weights: expected a scalar or shape (C,), got {weights.shape}")
    if is_concrete(weights) and not np.all((np.asarray(weights) >= 0) & np.isfinite(weights)):
        raise ValueError(f"channel_weights: expected finite numbers of at least 0, got {value!r}")
    return weights


def covariance_of(value: Values) -> Float[Array, "..."]:
    covariance = _number("channel_covariance", value)
    if covariance.ndim > 2 or (covariance.ndim == 2 and covariance.shape[0] != covariance.shape[1]):
        raise ValueError(f"channel_covariance: expected a scalar, shape (C,) or (C, C), got {covariance.shape}")
    if is_concrete(covariance):
        matrix = np.asarray(covariance, np.float64)
        matrix = matrix if matrix.ndim == 2 else np.diag(np.atleast_1d(matrix))
        finite = bool(np.isfinite(matrix).all())
        symmetric = finite and np.allclose(matrix, matrix.T, rtol=1e-5, atol=1e-6 * np.abs(matrix).max(initial=0))
        # An empty matrix (no channels) is positive definite; NaN is not.
        if not (symmetric and np.all(np.linalg.eigvalsh(matrix) > 0)):
            raise ValueError(f"channel_covariance: expected it symmetric and positive definite, got {value!r}")
    return covariance
