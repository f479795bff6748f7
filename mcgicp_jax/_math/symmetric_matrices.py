"""Closed-form algebra of symmetric 3×3 and 2×2 matrices, one per point, with gradients that are never NaN.

Arrays are laid out as structures of arrays: vectors (3, N), symmetric 3×3 matrices (6, N) in the order xx, xy, xz, yy,
yz, zz, and symmetric 2×2 matrices (3, N) as xx, xy, yy. The compiler then vectorises along N. LAPACK is not called: it
is slow for small matrices, and two concurrent batched calls can deadlock XLA's thread pool on CPUs (jax 0.10.2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mcgicp_jax._compute.concrete import AnyArray, numpy_for
from mcgicp_jax._compute.threads import with_settings_of_package

# Vectors and matrices given by their entries, each an array of one number per point.
Entries: TypeAlias = Sequence[Array]

# Row and column of each entry of a symmetric matrix.
_ROWS, _COLUMNS = np.array([[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]], np.int32)


def symmetric_from_matrix(matrix: Float[Array, "N 3 3"]) -> Float[Array, "6 N"]:
    matrix = 0.5 * (matrix + matrix.swapaxes(-1, -2))
    return matrix[:, _ROWS, _COLUMNS].T


def matrix_from_symmetric(symmetric: Float[Array, "6 N"]) -> Float[Array, "N 3 3"]:
    xx, xy, xz, yy, yz, zz = symmetric
    return jnp.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=-1).reshape(-1, 3, 3)


def multiply(symmetric: Float[Array, "6 N"], vector: Float[Array, "3 N"]) -> Float[Array, "3 N"]:
    """A v for each point."""
    return jnp.stack(_times(tuple(symmetric), tuple(vector)))


def rotate(rotation: Float[Array, "3 3"], symmetric: Float[Array, "6 N"]) -> Float[Array, "6 N"]:
    """R C Rᵀ."""
    # One 6×6 matrix for all points. Written out by entry, the derivative took three times as long to compile.
    first, second = rotation[:, _ROWS], rotation[:, _COLUMNS]
    both = first[:, None] * second + first * second[:, None]
    by_entry = jnp.where(_ROWS == _COLUMNS, 0.5, 1).astype(both.dtype) * both[_ROWS, _COLUMNS]
    return jnp.matmul(by_entry, symmetric, precision="highest")


def inner(a: Float[Array, "3 N"], b: Float[Array, "3 N"]) -> Float[Array, "N"]:
    """aᵀ b of each point of a whole cloud, where `jnp.sum` over a first axis is slow on CPUs.

    Programs over neighbourhoods use `jnp.sum`: it keeps XLA from recomputing its operands for each use, and is faster.
    """
    x, y, z = a * b
    return x + y + z


def inverse(symmetric: Float[Array, "6 N"]) -> Float[Array, "6 N"]:
    """The inverse by cofactors; the matrices must be nonsingular."""
    xx, xy, xz, yy, yz, zz = symmetric
    cxx, cxy, cxz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    determinant = xx * cxx + xy * cxy + xz * cxz
    cofactors = jnp.stack([cxx, cxy, cxz, xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy])
    return cofactors / determinant


def determinant(symmetric: Float[Array, "6 N"]) -> Float[Array, "N"]:
    xx, xy, xz, yy, yz, zz = symmetric
    return xx * (yy * zz - yz * yz) + xy * (xz * yz - xy * zz) + xz * (xy * yz - xz * yy)


def outer(vector: Float[Array, "3 N"]) -> Float[Array, "6 N"]:
    x, y, z = vector
    return jnp.stack([x * x, x * y, x * z, y * y, y * z, z * z])


def symmetric_outer(a: Float[Array, "C 3 N"], b: Float[Array, "C 3 N"]) -> Float[Array, "6 N"]:
    """Σ (a bᵀ + b aᵀ) / 2."""
    pairs = zip(_ROWS, _COLUMNS, strict=True)
    return jnp.stack([0.5 * jnp.sum(a[:, i] * b[:, j] + a[:, j] * b[:, i], axis=0) for i, j in pairs])


def orthonormal_basis(normal: Float[Array, "3 N"]) -> tuple[Float[Array, "3 N"], Float[Array, "3 N"]]:
    """Two unit vectors that complete the normal to a right-handed frame (Duff et al., Building an Orthonormal Basis,
    Revisited, JCGT 2017)."""
    first, second = _basis(*normal)
    return jnp.stack(first), jnp.stack(second)


def _basis(x: Array, y: Array, z: Array) -> tuple[Entries, Entries]:
    sign = jnp.where(z >= 0, 1.0, -1.0).astype(z.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    return (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


@jax.jit
def smallest_eigenvector(symmetric: Float[Array, "6 N"]) -> Float[Array, "3 N"]:
    """The unit eigenvector of the smallest eigenvalue: the normal of a neighbourhood with this covariance.

    Closed form, after Eberly, A Robust Eigensolver for 3×3 Symmetric Matrices (Geometric Tools, 2014): first the
    eigenvector of the best separated eigenvalue, then the others in the plane orthogonal to it. The derivative depends
    on the gaps between the smallest eigenvalue and the others, and is zero where one of them vanishes (neighbours along
    a line or isotropic, whose normal is undetermined).
    """
    return _smallest_eigenvector(symmetric)


@jax.custom_jvp
def _smallest_eigenvector(symmetric: Float[Array, "6 N"]) -> Float[Array, "3 N"]:
    # Written out by entry: XLA fuses this into few loops, and stacked arrays into many.
    xx, xy, xz, yy, yz, zz = symmetric
    # Divided by the trace, products of entries stay in the range of float32 from 1e-6 m to 1e6 m.
    trace = xx + yy + zz
    scale = 1 / jnp.where(trace > 0, trace, 1)
    xx, xy, xz, yy, yz, zz = (entry * scale for entry in (xx, xy, xz, yy, yz, zz))
    mean = (xx + yy + zz) / 3
    ax, ay, az = xx - mean, yy - mean, zz - mean
    spread = jnp.sqrt((ax * ax + ay * ay + az * az + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    isotropic = spread <= jnp.finfo(symmetric.dtype).eps
    scale = 1 / jnp.where(isotropic, 1, spread)
    # The matrix B = (A − mean)/spread has the eigenvalues 2 cos(φ + 2πk/3).
    xx, xy, xz, yy, yz, zz = ax * scale, xy * scale, xz * scale, ay * scale, yz * scale, az * scale
    half_determinant = 0.5 * (xx * (yy * zz - yz * yz) + xy * (xz * yz - xy * zz) + xz * (xy * yz - xz * yy))
    # The best separated eigenvalue: the largest if the determinant is positive, else the smallest (the largest of −B).
    # It is the root of t³ − 3 t − |det B| between √3 and 2. Three Newton steps from the chord leave an error of 1e-15;
    # cosine and arc cosine take several times as long, since XLA does not vectorise them.
    positive = half_determinant >= 0
    size = jnp.minimum(jnp.abs(half_determinant), 1)
    separated = math.sqrt(3) + (2 - math.sqrt(3)) * size
    for _ in range(3):
        square = separated * separated
        separated = (2 * separated * square + 2 * size) / (3 * square - 3)
    separated = jnp.where(positive, separated, -separated)
    first = _null_vector(xx - separated, xy, xz, yy - separated, yz, zz - separated)
    # If that eigenvalue is the smallest, `first` is the normal; otherwise the normal is orthogonal to `first`.
    u, v = _basis(*first)
    bu, bv = (_times((xx, xy, xz, yy, yz, zz), axis) for axis in (u, v))
    a, b, c = dot(u, bu), dot(u, bv), dot(v, bv)
    # Eigenvector of [[a, b], [b, c]] for its smaller eigenvalue, in the one of two forms that is free of cancellation.
    half = 0.5 * (a - c)
    radius = jnp.sqrt(half * half + b * b)
    along, across = jnp.where(half >= 0, -b, half - radius), jnp.where(half >= 0, radius + half, b)
    square = along * along + across * across
    regular = square > 0
    length = jnp.sqrt(jnp.where(regular, square, 1))
    along, across = along / length, jnp.where(regular, across / length, 1)
    normal = [jnp.where(positive, along * p + across * q, n) for p, q, n in zip(u, v, first, strict=True)]
    return jnp.stack([jnp.where(isotropic, default, axis) for axis, default in zip(normal, (0, 0, 1), strict=True)])


def dot(a: Entries, b: Entries) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _times(symmetric: Entries, vector: Entries) -> Entries:
    xx, xy, xz, yy, yz, zz = symmetric
    x, y, z = vector
    return xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z


def cross(a: Entries, b: Entries) -> Entries:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _null_vector(xx: Array, xy: Array, xz: Array, yy: Array, yz: Array, zz: Array) -> Entries:
    """Unit null vector of a symmetric matrix of rank two: the longest cross product of two of its rows."""
    rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    crosses = [cross(rows[i], rows[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    best, length = crosses[0], dot(crosses[0], crosses[0])
    for other in crosses[1:]:
        square = dot(other, other)
        longer = square > length
        best = tuple(jnp.where(longer, new, old) for new, old in zip(other, best, strict=True))
        length = jnp.maximum(square, length)
    regular = length > 0
    root = jnp.sqrt(jnp.where(regular, length, 1))
    return tuple(jnp.where(regular, axis / root, default) for axis, default in zip(best, (0, 0, 1), strict=True))


@_smallest_eigenvector.defjvp
@with_settings_of_package
def _smallest_eigenvector_jvp(
    primals: tuple[Float[Array, "6 N"]], tangents: tuple[Float[Array, "6 N"]]
) -> tuple[Float[Array, "3 N"], Float[Array, "3 N"]]:
    """dn = −B (Bᵀ A B − λ)⁻¹ Bᵀ dA n, with B a basis of the plane orthogonal to n and λ = nᵀ A n."""
    (symmetric,), (tangent,) = primals, tangents
    normal = _smallest_eigenvector(symmetric)
    trace = symmetric[0] + symmetric[3] + symmetric[5]
    scale = 1 / jnp.where(trace > 0, trace, 1)
    scaled = symmetric * scale
    u, v = orthonormal_basis(normal)
    a, b, c = project(scaled, u, v)
    eigenvalue = jnp.sum(normal * multiply(scaled, normal), axis=0)
    a, c = a - eigenvalue, c - eigenvalue
    # The product of the two gaps over their sum is about the smaller gap. Where it is below rounding (64 eps of the
    # trace), the derivative is undefined and set to zero.
    determinant = a * c - b * b
    gap = determinant > 64 * jnp.finfo(symmetric.dtype).eps * (a + c)
    determinant = jnp.where(gap, determinant, 1)
    turned = multiply(tangent * scale, normal)
    du, dv = jnp.sum(u * turned, axis=0), jnp.sum(v * turned, axis=0)
    along_u, along_v = (c * du - b * dv) / determinant, (a * dv - b * du) / determinant
    return normal, jnp.where(gap, -(along_u * u + along_v * v), 0)


def project(symmetric: Float[Array, "6 N"], u: Float[Array, "3 N"], v: Float[Array, "3 N"]) -> Float[Array, "3 N"]:
    """The 2×2 matrix Bᵀ C B in the basis B = [u v]."""
    cu, cv = multiply(symmetric, u), multiply(symmetric, v)
    return jnp.stack([jnp.sum(u * cu, axis=0), jnp.sum(u * cv, axis=0), jnp.sum(v * cv, axis=0)])


def inverse_square_root(symmetric: Float[Array, "3 N"]) -> Float[Array, "3 N"]:
    """A^{-1/2} of positive definite 2×2 matrices, by trace and determinant (Cayley-Hamilton)."""
    a, b, c = symmetric
    s = jnp.sqrt(a * c - b * b)
    t = jnp.sqrt(a + c + 2 * s)
    return jnp.stack([(c / s + 1) / t, -b / s / t, (a / s + 1) / t])


def congruence(outside: Float[Array, "3 N"], inside: Float[Array, "3 N"]) -> Float[Array, "3 N"]:
    """W A W for symmetric 2×2 matrices."""
    p, q, r = outside
    a, b, c = inside
    xx = p * p * a + 2 * p * q * b + q * q * c
    xy = p * q * a + (p * r + q * q) * b + q * r * c
    yy = q * q * a + 2 * q * r * b + r * r * c
    return jnp.stack([xx, xy, yy])


def floor_eigenvalues(symmetric: Float[Array, "3 N"], floor: Float[Array, "*N"]) -> Float[Array, "3 N"]:
    """2×2 matrices with eigenvalues raised to at least `floor`; matrices above it are returned bit for bit."""
    a, b, c = symmetric
    mean, half = 0.5 * (a + c), 0.5 * (a - c)
    square = half * half + b * b
    radius = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    below = mean - radius < floor
    low, high = jnp.maximum(mean - radius, floor), jnp.maximum(mean + radius, floor)
    middle, ratio = 0.5 * (high + low), 0.5 * (high - low) / jnp.where(radius > 0, radius, 1)
    raised = jnp.stack([middle + ratio * half, ratio * b, middle - ratio * half])
    return jnp.where(below, raised, symmetric)


def embed(symmetric: Float[Array, "3 N"], u: Float[Array, "3 N"], v: Float[Array, "3 N"]) -> Float[Array, "6 N"]:
    """B A Bᵀ in the basis B = [u v]: a 2×2 matrix of the tangent plane as a 3×3 one."""
    a, b, c = symmetric
    first, second = a * u + b * v, b * u + c * v
    return jnp.stack([first[i] * u[j] + second[i] * v[j] for i, j in zip(_ROWS, _COLUMNS, strict=True)])


def symmetric_product(a: Float[Array, "6 N"], b: Float[Array, "6 N"]) -> Float[Array, "6 N"]:
    """(A B + B A) / 2."""
    axes = jnp.eye(3, dtype=a.dtype)[:, :, None]
    columns = [multiply(a, multiply(b, jnp.broadcast_to(axis, (3, a.shape[1])))) for axis in axes]
    return jnp.stack([0.5 * (columns[j][i] + columns[i][j]) for i in range(3) for j in range(i, 3)])


def inverse_3(matrices: Float[AnyArray, "*n 3 3"]) -> Float[AnyArray, "*n 3 3"]:
    """Inverses of symmetric positive definite matrices: cross products of rows over the determinant."""
    xp = numpy_for(matrices)
    matrices = 0.5 * (matrices + matrices.swapaxes(-1, -2))
    # Divided by the trace, so that the determinant of variances of 1e-10 does not underflow float32.
    size = xp.einsum("...ii->...", matrices)[..., None, None]
    first, second, third = (matrices[..., i, :] / size[..., 0] for i in range(3))
    rows = xp.stack([xp.cross(second, third), xp.cross(third, first), xp.cross(first, second)], axis=-2)
    return rows / (xp.sum(rows[..., 0, :] * first, axis=-1)[..., None, None] * size)


def inverse_6(matrix: Float[AnyArray, "6 6"]) -> Float[AnyArray, "6 6"]:
    """Inverse of a symmetric positive definite matrix by blocks."""
    xp = numpy_for(matrix)
    matrix = 0.5 * (matrix + matrix.T)
    mixed, corner = matrix[:3, 3:], inverse_3(matrix[3:, 3:])
    ratio = mixed @ corner
    first = inverse_3(matrix[:3, :3] - ratio @ mixed.T)
    across = -first @ ratio
    return xp.block([[first, across], [across.T, corner - ratio.T @ across]])


def solve(matrices: Float[AnyArray, "*n m m"], sides: Float[AnyArray, "*n m"]) -> Float[AnyArray, "*n m"]:
    """A⁻¹ b of positive definite matrices A."""
    if numpy_for(matrices, sides) is np:
        return np.linalg.solve(matrices, sides[..., None])[..., 0]

    def eliminate(i: Int[Array, ""], rows: Float[Array, "*n m k"]) -> Float[Array, "*n m k"]:
        pivot = rows[..., i, :] / rows[..., i, i, None]
        rest = rows - rows[..., i, None] * pivot[..., None, :]
        return rest.at[..., i, :].set(pivot)

    # Gauss-Jordan elimination; positive definite matrices need no pivoting.
    rows = jnp.concatenate([matrices, sides[..., None]], axis=-1)
    return jax.lax.fori_loop(0, sides.shape[-1], eliminate, rows)[..., -1]
