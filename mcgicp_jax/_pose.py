"""Poses at the border: what a user may hand in, and what every module inside receives."""

from __future__ import annotations

import contextlib
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float

# Arrays of NumPy, outside of transformations, or of JAX; and single numbers of either.
if TYPE_CHECKING:
    AnyArray: TypeAlias = Any
    AnyScalar: TypeAlias = Any
else:
    AnyArray = Array | np.ndarray
    AnyScalar = ArrayLike

Pose: TypeAlias = "jaxlie.SE3 | Float[Array, '*batch 4 4'] | Float[np.ndarray, '*batch 4 4']"

# Largest entry of R Rᵀ − I: a matrix that a user typed with four digits is still a rotation.
_ROTATION_TOLERANCE = 1e-3
# In radii of a cloud: by how much the digits of a rotation may displace a cloud that lies far from zero.
_DISPLACEMENT_TOLERANCE = 0.1


def is_concrete(*trees: object) -> bool:
    """Whether every array in the trees holds numbers now, rather than standing for them under a transformation."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def computed_now() -> contextlib.AbstractContextManager[None]:
    """What is computed within is computed now, even while a caller's `jit` is traced, of which it would become a part.

    Only then: what JAX evaluates at compile time is evaluated operation by operation.
    """
    staged = isinstance(jnp.array(np.zeros(())), jax.core.Tracer)
    return jax.ensure_compile_time_eval() if staged else contextlib.nullcontext()


def canonical_float() -> Any:
    """JAX's default precision: float64 where x64 is on."""
    return jax.dtypes.canonicalize_dtype(np.float64)


def pose_matrix(
    pose: Pose | None, name: str = "init", distance: float = 0.0
) -> Float[np.ndarray, "4 4"] | Float[Array, "4 4"]:
    """The (4, 4) matrix of a pose, in the precision that it came in (float64 for NumPy); `None` is the identity.

    A concrete matrix gets the nearest rotation, so that it does not scale what it moves.

    Args:
        name: of the argument, for messages.
        distance: from zero of the cloud that the pose will move, in radii of that cloud.

    Raises:
        ValueError: where the values are concrete, if the shape is wrong, the matrix is no rigid motion, or its digits
            are too few for a cloud at that distance.
    """
    if pose is None:
        return np.eye(4)
    matrix = pose.as_matrix() if isinstance(pose, jaxlie.SE3) else pose
    if not is_concrete(matrix):
        if matrix.shape != (4, 4):
            raise ValueError(f"{name}: expected a jaxlie.SE3 or a (4, 4) matrix, got shape {matrix.shape}")
        return matrix
    try:
        matrix = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected a jaxlie.SE3 or a (4, 4) matrix, got {type(pose).__name__}") from error
    if matrix.shape != (4, 4):
        raise ValueError(f"{name}: expected a jaxlie.SE3 or a (4, 4) matrix, got shape {matrix.shape}")
    rotation = matrix[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    # Written so that NaN fails as well.
    rigid = off <= _ROTATION_TOLERANCE and np.linalg.det(rotation) > 0
    if not (rigid and np.isfinite(matrix).all() and np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0])):
        raise ValueError(
            f"{name}: expected a rigid motion (rotation of determinant 1, last row 0 0 0 1), got\n{matrix}"
        )
    if off * distance > _DISPLACEMENT_TOLERANCE:
        raise ValueError(
            f"{name}: expected a rotation with more digits: R Rᵀ differs from the identity by {off:.1g}, which "
            f"displaces a cloud so far from the origin by {off * distance:.1g} of its radius"
        )
    return nearest_rotation(matrix)


def nearest_rotation(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The rigid motion whose rotation is the nearest one to that of a matrix (Frobenius norm); the same translation."""
    rotation = matrix[:3, :3]
    # A rotation to the last bits stays as it is.
    if np.abs(rotation @ rotation.T - np.eye(3)).max() <= 1e-14:
        return matrix
    left, _, right = np.linalg.svd(rotation)
    matrix = matrix.copy()
    matrix[:3, :3] = left @ right
    return matrix


def se3_from_matrix(matrix: Float[ArrayLike, "4 4"], dtype: DTypeLike) -> jaxlie.SE3:
    """`jaxlie.SE3` in the given precision, its quaternion normalised; of NumPy arrays where the matrix is concrete."""
    if not is_concrete(matrix):
        return _se3_from_traced(matrix, dtype)
    matrix = np.asarray(matrix, np.float64)
    if not np.isfinite(matrix).all():
        return se3(np.full(7, np.nan, dtype))
    xyzw = np.array([0.0, 0, 0, 1])
    if np.any(matrix[:3, :3] != np.eye(3)):
        # Imported where it is needed: it takes a fifth of the time that the package takes.
        from scipy.spatial.transform import Rotation

        xyzw = Rotation.from_matrix(matrix[:3, :3]).as_quat(canonical=True)
    return se3(np.concatenate([xyzw[3:], xyzw[:3], matrix[:3, 3]]).astype(dtype))


@partial(jax.jit, static_argnames="dtype")
def _se3_from_traced(matrix: Float[Array, "4 4"], dtype: DTypeLike) -> jaxlie.SE3:
    pose = jaxlie.SE3.from_matrix(jnp.asarray(matrix, dtype))
    return cast_pose(pose.normalize(), dtype)


def se3(parameters: AnyArray) -> jaxlie.SE3:
    """A pose of NumPy's numbers, too: (7,) quaternion wxyz and translation."""
    return jaxlie.SE3(parameters)


def cast_pose(pose: jaxlie.SE3, dtype: DTypeLike) -> jaxlie.SE3:
    """jaxlie computes some constants in the default precision; this undoes the promotion."""
    return jaxlie.SE3(pose.wxyz_xyz.astype(dtype))


def rotation_from_quaternion(wxyz: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """In float64 from the outset: jaxlie would compute it in float32 where x64 is off."""
    w, x, y, z = (wxyz / np.sqrt(np.sum(wxyz * wxyz, axis=-1, keepdims=True))).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    # The batch comes last here, and in reverse, as do rows and columns once transposed.
    return np.array(rows).swapaxes(0, 1).T
