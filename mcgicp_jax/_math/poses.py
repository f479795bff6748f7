"""Poses: validation of user input, conversions between matrices and `jaxlie.SE3`, and frames of twists.

A twist ξ = (v, ω) is a small motion: v in metres (or in units of a radius), ω in radians.
"""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, is_concrete, numpy_for

if TYPE_CHECKING:
    # A pose that a user passes.
    Pose: TypeAlias = jaxlie.SE3 | Array | np.ndarray
else:
    # Not checked at run time: `checked_pose_matrix` has better messages.
    Pose = Any

# Tolerance on the largest entry of R Rᵀ − I: a matrix typed with four digits still counts as a rotation.
_ROTATION_TOLERANCE = 1e-3
# The same for a rotation that is exact to rounding.
_EXACT = 1e-14
# Tolerance on the last row, which rounding may change, as in products of matrices.
_LAST_ROW_TOLERANCE = 1e-9
# Largest displacement, in radii of the cloud, that rounding of R may cause for a cloud far from the origin.
_DISPLACEMENT_TOLERANCE = 0.1


def checked_pose_matrix(
    pose: Pose | None, name: str = "init", distance: float = 0.0
) -> Float[np.ndarray, "4 4"] | Float[Array, "4 4"]:
    """The (4, 4) matrix of a pose: in float64 if the pose is concrete, in its own precision if it is traced.

    The rotation of a concrete matrix is replaced by the nearest exact one, so that the pose does not scale the cloud.
    It must have enough digits for a cloud at this `distance` from the origin, in radii of the cloud. Errors
    (`ValueError`) begin with `name`.
    """
    if pose is None:
        return np.eye(4)
    expected, kind = f"{name}: expected a jaxlie.SE3 or a (4, 4) matrix", type(pose).__name__
    if not isinstance(pose, jaxlie.SE3) and hasattr(pose, "matrix"):
        raise ValueError(f"{expected}, got {kind}; pass its .matrix")
    matrix = matrix_of(pose)
    xp = numpy_for(matrix)
    if xp is np:
        try:
            matrix = np.asarray(matrix, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{expected}, got {kind}") from error
    if matrix.shape not in ((4, 4), (3, 4)):
        raise ValueError(f"{expected}, got shape {matrix.shape}")
    if len(matrix) == 3:
        matrix = xp.concatenate([matrix, xp.eye(4, dtype=matrix.dtype)[3:]])
    if xp is not np:
        return matrix
    rotation = matrix[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    # Written so that NaN fails as well.
    rigid = off <= _ROTATION_TOLERANCE and np.linalg.det(rotation) > 0
    last = np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max()
    if not (rigid and np.isfinite(matrix).all() and last <= _LAST_ROW_TOLERANCE):
        raise ValueError(
            f"{name}: expected a rigid motion (rotation of determinant 1, last row 0 0 0 1), got\n{matrix}"
        )
    if off * distance > _DISPLACEMENT_TOLERANCE:
        raise ValueError(
            f"{name}: expected a rotation with more digits: R Rᵀ differs from the identity by {off:.1g}, which "
            f"displaces a cloud so far from the origin by {off * distance:.1g} of its radius"
        )
    if last > 0:
        matrix = np.concatenate([matrix[:3], np.eye(4)[3:]])
    return nearest_rotation(matrix)


def pose_matrices(poses: Any, name: str = "poses[{}]") -> Float[np.ndarray, "n 4 4"]:
    """`checked_pose_matrix` of each concrete pose; `name` has a place for the number of the pose in error messages."""
    if not isinstance(poses, np.ndarray | jax.Array):
        poses = [checked_pose_matrix(pose, name.format(k)) for k, pose in enumerate(poses)]
    matrices = np.array(poses, np.float64)
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4) or not len(matrices):
        raise ValueError(
            f"{name.split('[')[0]}: expected at least one pose of shape (4, 4), got shape {matrices.shape}"
        )
    with np.errstate(invalid="ignore", over="ignore"):
        off = np.abs(matrices[:, :3, :3] @ matrices[:, :3, :3].swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
        exact = (off <= _EXACT) & (np.linalg.det(matrices[:, :3, :3]) > 0)
    exact &= np.isfinite(matrices).all(axis=(1, 2)) & (matrices[:, 3] == [0, 0, 0, 1]).all(axis=1)
    for k in np.flatnonzero(~exact):
        matrices[k] = checked_pose_matrix(matrices[k], name.format(k))
    return matrices


def nearest_rotation(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The matrix with its rotation replaced by the nearest exact one (Frobenius norm)."""
    rotation = matrix[:3, :3]
    # A rotation that is exact to rounding stays, so that the function is idempotent.
    if np.abs(rotation @ rotation.T - np.eye(3)).max() <= _EXACT:
        return matrix
    left, _, right = np.linalg.svd(rotation)
    matrix = matrix.copy()
    matrix[:3, :3] = left @ right
    return matrix


def se3_from_matrix(matrix: Float[ArrayLike, "4 4"], dtype: DTypeLike) -> jaxlie.SE3:
    """`jaxlie.SE3` in the given precision with a unit quaternion; a concrete matrix gives one of NumPy arrays."""
    if not is_concrete(matrix):
        return _se3_from_traced(matrix, dtype)
    matrix = np.asarray(matrix, np.float64)
    if not np.isfinite(matrix).all():
        return se3(np.full(7, np.nan, dtype))
    if np.all(matrix[:3, :3] == np.eye(3)):
        return se3(np.concatenate([[1.0, 0, 0, 0], matrix[:3, 3]]).astype(dtype))
    return se3(parameters_of(matrix).astype(dtype))


def parameters_of(matrices: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 7"]:
    """Unit quaternions wxyz and translations of rigid motions; float64."""
    return np.concatenate([quaternion_from_rotation(matrices[..., :3, :3]), matrices[..., :3, 3]], axis=-1)


def matrix_of(pose: Pose) -> Any:
    """The (4, 4) matrices of `jaxlie.SE3`, in float64 by NumPy where it is concrete; matrices as they are."""
    if not isinstance(pose, jaxlie.SE3):
        return pose
    return matrices_of(np.asarray(pose.wxyz_xyz, np.float64)) if is_concrete(pose) else pose.as_matrix()


def matrices_of(parameters: Float[np.ndarray, "*batch 7"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Inverse of `parameters_of`."""
    matrices = np.tile(np.eye(4), (*parameters.shape[:-1], 1, 1))
    matrices[..., :3, :3] = rotation_from_quaternion(parameters[..., :4])
    matrices[..., :3, 3] = parameters[..., 4:]
    return matrices


@partial(jax.jit, static_argnames="dtype")
def _se3_from_traced(matrix: Float[Array, "4 4"], dtype: DTypeLike) -> jaxlie.SE3:
    pose = jaxlie.SE3.from_matrix(jnp.asarray(matrix, dtype)).normalize()
    return jaxlie.SE3(pose.wxyz_xyz.astype(dtype))


def se3(parameters: AnyArray) -> jaxlie.SE3:
    """`jaxlie.SE3` from (7,) parameters, quaternion wxyz and translation; NumPy arrays stay NumPy arrays."""
    return jaxlie.SE3(parameters)


def rotation_from_quaternion(wxyz: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrices in the precision of the quaternions: jaxlie would use float32 where x64 is off."""
    if wxyz.ndim == 1 and wxyz.dtype == np.float64:
        # Python's floats are float64, and ten times as fast as NumPy's scalars.
        w, x, y, z = wxyz.tolist()
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = (w / norm, x / norm, y / norm, z / norm) if norm else [math.nan] * 4
    else:
        w, x, y, z = (wxyz / np.sqrt(np.sum(wxyz * wxyz, axis=-1, keepdims=True))).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    # The entries are stacked as (3, 3, reversed batch); the transpose restores the batch and the order of the rows.
    return np.array(rows).swapaxes(0, 1).T


def rotated(points: Float[np.ndarray, "n 3"], rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "n 3"]:
    # Not `points @ rotation.T`: the threads of BLAS keep their cores busy for a while after each product, which was a
    # third of the processor time of odometry.
    return np.einsum("ij,jn->in", rotation, np.ascontiguousarray(points.T)).T


def quaternion_from_rotation(rotations: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 4"]:
    """Unit quaternions wxyz of rotation matrices, with w ≥ 0."""
    r = np.moveaxis(rotations, (-2, -1), (0, 1))
    x, y, z = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[1, 0] + r[0, 1], r[0, 2] + r[2, 0], r[2, 1] + r[1, 2]
    signs = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    a, b, c, d = 1 + np.einsum("ki,ii...->k...", signs, r)
    # Rows of 4 q qᵀ; the row with the largest diagonal entry has the most digits.
    products = np.array([[a, x, y, z], [x, b, xy, xz], [y, xy, c, yz], [z, xz, yz, d]])
    largest = np.argmax([a, b, c, d], axis=0)
    wxyz = np.moveaxis(np.take_along_axis(products, largest[None, None], axis=0)[0], 0, -1)
    return wxyz * (np.where(wxyz[..., :1] < 0, -1, 1) / np.linalg.norm(wxyz, axis=-1, keepdims=True))


def turn_by_quaternion(wxyz: Float[AnyArray, "*batch 4"]) -> Float[AnyArray, "*batch 3 4"]:
    """Derivative of the rotation vector in the axes of the target, the vector part of 2 δq q*, by a unit quaternion."""
    xp, w, vector = numpy_for(wxyz), wxyz[..., :1, None], wxyz[..., 1:]
    return 2 * xp.concatenate([-vector[..., None], w * xp.eye(3) + skew(vector)], axis=-1)


def move_pose(pose: jaxlie.SE3, twist: Float[Array, "6"], center: Float[Array, "3"]) -> jaxlie.SE3:
    """The pose that maps a to c + exp(ω)(T a − c) + v; v in metres, ω in radians."""
    turn = jaxlie.SO3.exp(twist[3:])
    rotation = (turn @ pose.rotation()).normalize()
    translation = center + turn @ (pose.translation() - center) + twist[:3]
    moved = jaxlie.SE3.from_rotation_and_translation(rotation, translation)
    # jaxlie promotes to the default precision.
    return jaxlie.SE3(moved.wxyz_xyz.astype(pose.wxyz_xyz.dtype))


def adjoint_to_center(pose: jaxlie.SE3, center: Float[Array, "3"]) -> Float[Array, "6 6"]:
    """Matrix from ξ of T exp(ξ), in the source's frame, to twists about the centre in the target's frame."""
    return (jaxlie.SE3.from_translation(-center) @ pose).adjoint().astype(pose.wxyz_xyz.dtype)


def adjoint_to_source(pose: jaxlie.SE3, center: Float[Array, "3"]) -> Float[Array, "6 6"]:
    """Inverse of `adjoint_to_center`."""
    return (jaxlie.SE3.from_translation(-center) @ pose).inverse().adjoint().astype(pose.wxyz_xyz.dtype)


def units(radius: Float[AnyScalar, ""]) -> Float[AnyArray, "6"]:
    """Factors that convert a twist from units of the radius to metres; ω stays in radians."""
    xp = numpy_for(radius)
    return xp.stack([radius] * 3 + [xp.ones_like(radius)] * 3)


def parameters_by_twist(pose: Float[AnyArray, "7"], center: Float[AnyArray, "3"]) -> Float[AnyArray, "7 6"]:
    """Derivative of pose parameters `wxyz_xyz` by a twist: the pose turns by ω about the centre and shifts by v."""
    xp = numpy_for(pose, center)
    by_turn = turn_by_quaternion(pose[:4]).T / 4
    quaternion = xp.concatenate([xp.zeros_like(by_turn), by_turn], axis=1)
    return xp.concatenate([quaternion, translation_adjoint(center - pose[4:])[:3]])


def inverse(matrices: Float[AnyArray, "*batch 4 4"]) -> Float[AnyArray, "*batch 4 4"]:
    """Inverses of rigid motions."""
    xp = numpy_for(matrices)
    turned = xp.swapaxes(matrices[..., :3, :3], -1, -2)
    last = xp.broadcast_to(xp.eye(4, dtype=matrices.dtype)[3:], (*matrices.shape[:-2], 1, 4))
    return xp.concatenate([xp.concatenate([turned, -turned @ matrices[..., :3, 3:]], axis=-1), last], axis=-2)


def adjoint(matrices: Float[AnyArray, "*batch 4 4"]) -> Float[AnyArray, "*batch 6 6"]:
    """Adjoints of rigid motions: T exp(ξ) T⁻¹ = exp(Ad ξ), for twists ξ = (v, ω)."""
    xp = numpy_for(matrices)
    rotations = matrices[..., :3, :3]
    # The columns of t × R.
    crossed = xp.swapaxes(xp.cross(matrices[..., None, :3, 3], xp.swapaxes(rotations, -1, -2)), -1, -2)
    return xp.block([[rotations, crossed], [xp.zeros_like(rotations), rotations]])


def translation_adjoint(offset: Float[AnyArray, "3"]) -> Float[AnyArray, "6 6"]:
    xp = numpy_for(offset)
    return xp.block([[xp.eye(3), skew(offset)], [xp.zeros((3, 3)), xp.eye(3)]])


def skew(vectors: Float[AnyArray, "*batch 3"]) -> Float[AnyArray, "*batch 3 3"]:
    xp = numpy_for(vectors)
    x, y, z = xp.moveaxis(vectors, -1, 0)
    zero = xp.zeros_like(x)
    return xp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape, 3)


# ζ(2k) for k = 1 to 28: the generating function of the Bernoulli numbers, which inverts the derivative of exp, is a
# series in (θ/2π)² with these coefficients. At θ = π the remainder is below 4e-16.
_POWERS = np.arange(1, 29)
_ZETA = np.array([np.pi**2 / 6, np.pi**4 / 90, *(np.sum(np.arange(1.0, 999) ** (-2.0 * k)) for k in _POWERS[2:])])


def exponential(twists: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 4 4"]:
    omega = skew(twists[..., 3:])
    square = omega @ omega
    angle = np.linalg.norm(twists[..., 3:], axis=-1)[..., None, None]
    sine, half = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    # (θ − sin θ)/θ³; its rounding, ε/θ², is multiplied by θ².
    third = np.where(angle > 0, (1 - sine) / np.where(angle > 0, angle, 1) ** 2, 0)
    matrices = np.tile(np.eye(4), (*twists.shape[:-1], 1, 1))
    matrices[..., :3, :3] = np.eye(3) + sine * omega + half * square
    matrices[..., :3, 3] = ((np.eye(3) + half * omega + third * square) @ twists[..., :3, None])[..., 0]
    return matrices


def logarithm(matrices: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 6"]:
    """ξ with exp(ξ) = T and a rotation angle of at most π."""
    quaternions = quaternion_from_rotation(matrices[..., :3, :3])
    sine = np.linalg.norm(quaternions[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quaternions[..., :1])
    small = sine < 1e-150
    turn = np.where(small, 2, angle / np.where(small, 1, sine)) * quaternions[..., 1:]
    omega = skew(turn)
    ratio = np.sum(turn * turn, axis=-1)[..., None, None] / (2 * np.pi) ** 2
    factor = 2 * np.polynomial.polynomial.polyval(ratio, _ZETA) / (2 * np.pi) ** 2
    inverse = np.eye(3) - 0.5 * omega + factor * (omega @ omega)
    return np.concatenate([(inverse @ matrices[..., :3, 3:])[..., 0], turn], axis=-1)


def logarithm_derivative(twists: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 6 6"]:
    """∂ log(exp(ξ) exp(η)) / ∂η at η = 0, the inverse of the right Jacobian.

    It is I + ad/2 + Σ B₂ₖ ad²ᵏ/(2k)!, with the Bernoulli numbers B. Since ad⁵ = −2θ²ad³ − θ⁴ad (Bullo & Murray, ECC
    1995), powers of ad above the fourth reduce to the second and the fourth.
    """
    first, second = skew(twists[..., 3:]), skew(twists[..., :3])
    ad = np.block([[first, second], [np.zeros_like(first), first]])
    square = ad @ ad
    ratio = np.sum(twists[..., 3:] ** 2, axis=-1)[..., None, None] / (2 * np.pi) ** 2
    polynomial = np.polynomial.polynomial.polyval
    of_square = -2 * polynomial(ratio, (_POWERS - 2) * _ZETA) / (2 * np.pi) ** 2
    of_fourth = -2 * polynomial(ratio, ((_POWERS - 1) * _ZETA)[1:]) / (2 * np.pi) ** 4
    return np.eye(6) + 0.5 * ad + of_square * square + of_fourth * (square @ square)
