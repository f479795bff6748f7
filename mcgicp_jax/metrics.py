"""How far a pose is from the truth."""

from __future__ import annotations

from types import ModuleType
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mcgicp_jax._pose import Pose, is_concrete, pose_matrix

Scalar: TypeAlias = float | Float[Array, ""]


def pose_error(T: Pose, T_true: Pose) -> tuple[Scalar, Scalar]:
    """The length and the angle of the motion `T_true⁻¹ T` that is left over.

    Concrete poses are compared in float64. Under `jit`, `grad` and `vmap` the errors have the precision of the traced
    pose; both are differentiable, with gradient 0 where the error itself is 0.

    Args:
        T: `jaxlie.SE3` or (4, 4).
        T_true: `jaxlie.SE3` or (4, 4).

    Returns:
        Translation in metres and rotation in radians, 0 to π: plain floats, or JAX scalars where a pose is traced.

    Raises:
        ValueError: if a pose has another shape or is no rigid motion; the message names it.
    """
    matrix, true = pose_matrix(T, "T"), pose_matrix(T_true, "T_true")
    if is_concrete(matrix, true):
        translation, rotation = _errors(matrix, true, np)
        return float(translation), float(rotation)
    dtype = jnp.result_type(*(each.dtype for each in (matrix, true) if not is_concrete(each)))
    with jax.default_matmul_precision("highest"):
        return _errors(jnp.asarray(matrix, dtype), jnp.asarray(true, dtype), jnp)


def _errors(matrix: Any, true: Any, numpy: ModuleType) -> tuple[Any, Any]:
    """For float arrays of `numpy`, which is NumPy or `jax.numpy`."""
    left = true[:3, :3].T @ matrix[:3, :3]
    # sin(angle) · axis and cos(angle): unlike either alone, the two together are accurate at every angle.
    sine = numpy.stack([left[2, 1] - left[1, 2], left[0, 2] - left[2, 0], left[1, 0] - left[0, 1]]) / 2
    cosine = (numpy.trace(left) - 1) / 2
    return _norm(matrix[:3, 3] - true[:3, 3], numpy), numpy.arctan2(_norm(sine, numpy), cosine)


def _norm(vector: Any, numpy: ModuleType) -> Any:
    """The Euclidean norm, whose gradient at 0 is 0 rather than NaN."""
    squared = (vector**2).sum()
    positive = squared > 0
    return numpy.where(positive, numpy.sqrt(numpy.where(positive, squared, 1)), 0)
