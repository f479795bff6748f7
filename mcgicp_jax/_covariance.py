"""Local, plane and multi-channel covariances, and the closed-form algebra that they are made of.

Inside, arrays are laid out as structures of arrays: points (3, N), symmetric 3×3 matrices (6, N) in the order
xx, xy, xz, yy, yz, zz, and symmetric 2×2 matrices (3, N) as xx, xy, yy. The compiler then works along N. No LAPACK
call is made per point: besides being slow, batched ones can dead-lock XLA's thread pool on CPUs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# Relative to the trace: what keeps the square root of a collinear neighbourhood's 2×2 covariance regular. Much more
# would be seen in Ω where it is small; as it is, rounding in float32 leaves Ω two digits along a line.
_REGULARISATION = 1e-6
# Neighbourhoods of more points than that are gone through block by block. On CPUs XLA sums over the first axis of
# larger tables column by column, which is twenty times slower, and the tables fall out of the processor's caches.
_LARGEST_WHOLE = 16_000
_LARGEST_BLOCK = 8192
# Rows, at most, that a median is taken of.
_MEDIAN_OF = 4096

Tree = TypeVar("Tree")


def some_rows(valid: Bool[Array, "N"]) -> tuple[Int[Array, "n"], Bool[Array, "n"]]:
    """Rows to take a median of, evenly among those that are valid, and which of them count: padding, which comes last,
    takes no part. Some thousands tell a median as well as all, and far sooner."""
    count = min(valid.size, _MEDIAN_OF)
    rows = jnp.arange(count) * (1 + jnp.sum(valid) // _MEDIAN_OF)
    inside = rows < valid.size
    rows = jnp.where(inside, rows, 0)
    return rows, inside & valid[rows]


def median(values: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Over the last axis; NaN do not count, and where there is nothing else the answer is NaN. Constant to autodiff.

    Sorted as integers, whose order is made that of the numbers: on CPUs XLA takes five times as long to sort floats.
    """
    kind = jnp.int32 if values.dtype == jnp.float32 else jnp.int64
    largest = jnp.iinfo(kind).max

    def turned(bits: Int[Array, "*batch n"]) -> Int[Array, "*batch n"]:
        # Of negative numbers, the larger one has the smaller bits.
        return jnp.where(bits < 0, bits ^ largest, bits)

    absent = jnp.isnan(values)
    # One and the same NaN, which comes last.
    bits = jax.lax.bitcast_convert_type(jnp.where(absent, jnp.nan, values), kind)
    ordered = jax.lax.bitcast_convert_type(turned(jnp.sort(turned(bits))), values.dtype)
    count = jnp.sum(~absent, axis=-1, keepdims=True)
    middle = jnp.concatenate([jnp.maximum(count - 1, 0) // 2, count // 2], axis=-1)
    return jnp.mean(jnp.take_along_axis(ordered, middle, axis=-1), axis=-1)


def symmetric_from_matrix(matrix: Float[Array, "N 3 3"]) -> Float[Array, "6 N"]:
    matrix = 0.5 * (matrix + matrix.swapaxes(-1, -2))
    return jnp.stack([matrix[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))])


def matrix_from_symmetric(symmetric: Float[Array, "6 N"]) -> Float[Array, "N 3 3"]:
    xx, xy, xz, yy, yz, zz = symmetric
    return jnp.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=-1).reshape(-1, 3, 3)


def multiply(symmetric: Float[Array, "6 N"], vector: Float[Array, "3 N"]) -> Float[Array, "3 N"]:
    """Matrix times vector, row by row."""
    xx, xy, xz, yy, yz, zz = symmetric
    x, y, z = vector
    return jnp.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z])


def rotate(rotation: Float[Array, "3 3"], symmetric: Float[Array, "6 N"]) -> Float[Array, "6 N"]:
    """R C Rᵀ."""
    xx, xy, xz, yy, yz, zz = symmetric
    rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    half = [[sum(rotation[i, k] * rows[k][j] for k in range(3)) for j in range(3)] for i in range(3)]
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    return jnp.stack([sum(half[i][k] * rotation[j, k] for k in range(3)) for i, j in pairs])


def inner(a: Float[Array, "3 N"], b: Float[Array, "3 N"]) -> Float[Array, "N"]:
    """aᵀ b, row by row. Written out for the pairs of a whole cloud, since sums over a first axis are slow there.

    Not for neighbourhoods: there sums keep XLA from computing what they are made of again for each use, and are faster.
    """
    x, y, z = a * b
    return x + y + z


def inverse(symmetric: Float[Array, "6 N"]) -> Float[Array, "6 N"]:
    """The inverse by cofactors; the matrices must be regular."""
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


def orthonormal_basis(normal: Float[Array, "3 N"]) -> tuple[Float[Array, "3 N"], Float[Array, "3 N"]]:
    """Two unit vectors that complete the normal to a right-handed frame.

    Duff et al., Building an Orthonormal Basis, Revisited, JCGT 2017.
    """
    x, y, z = normal
    sign = jnp.where(z >= 0, 1.0, -1.0).astype(z.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = jnp.stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    second = jnp.stack([b, sign + y * y * a, -y])
    return first, second


# Compiled by itself, as is `fit_linear`, so that it is traced once for all neighbourhoods of a size.
@jax.jit
def smallest_eigenvector(symmetric: Float[Array, "6 N"]) -> Float[Array, "3 N"]:
    """The unit eigenvector of the smallest eigenvalue: the normal of a neighbourhood with this covariance.

    Closed form, after Eberly, A Robust Eigensolver for 3×3 Symmetric Matrices (Geometric Tools, 2014): first the
    eigenvector of the eigenvalue that stands apart from the other two, then the rest in the plane across it. Its
    derivative is written in terms of the gaps between the eigenvalues and is zero where there is none (an isotropic
    neighbourhood has no normal that could move).
    """
    return _smallest_eigenvector(symmetric)


@jax.custom_jvp
def _smallest_eigenvector(symmetric: Float[Array, "6 N"]) -> Float[Array, "3 N"]:
    symmetric = _scale_to_one(symmetric)
    xx, xy, xz, yy, yz, zz = symmetric
    mean = (xx + yy + zz) / 3
    ax, ay, az = xx - mean, yy - mean, zz - mean
    spread = jnp.sqrt((ax * ax + ay * ay + az * az + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    isotropic = spread <= jnp.finfo(symmetric.dtype).eps
    scale = 1 / jnp.where(isotropic, 1, spread)
    # The matrix (A − mean)/spread has the eigenvalues 2 cos(φ + 2πk/3).
    bxx, bxy, bxz, byy, byz, bzz = ax * scale, xy * scale, xz * scale, ay * scale, yz * scale, az * scale
    half_determinant = 0.5 * (
        bxx * (byy * bzz - byz * byz) + bxy * (bxz * byz - bxy * bzz) + bxz * (bxy * byz - bxz * byy)
    )
    angle = jnp.arccos(jnp.clip(half_determinant, -1, 1)) / 3
    largest, smallest = 2 * jnp.cos(angle), 2 * jnp.cos(angle + 2 * jnp.pi / 3)
    apart = jnp.where(half_determinant >= 0, largest, smallest)
    first = _null_vector(bxx - apart, bxy, bxz, byy - apart, byz, bzz - apart)
    # Where the smallest eigenvalue stands apart that is the answer. Elsewhere it is in the plane across.
    u, v = orthonormal_basis(first)
    shifted = jnp.stack([bxx, bxy, bxz, byy, byz, bzz])
    a, b, c = project(shifted, u, v)
    # Eigenvector of [[a, b], [b, c]] for its smaller eigenvalue, by half of the angle of the larger one.
    direction = 0.5 * jnp.arctan2(2 * b, a - c)
    across = -jnp.sin(direction) * u + jnp.cos(direction) * v
    normal = jnp.where(half_determinant >= 0, across, first)
    return jnp.where(isotropic, jnp.array([[0.0], [0.0], [1.0]], symmetric.dtype), normal)


def _scale_to_one(symmetric: Float[Array, "6 N"]) -> Float[Array, "6 N"]:
    """Divided by the trace: 1e-6 m or 1e6 m apart, products of entries stay within float32."""
    trace = symmetric[0] + symmetric[3] + symmetric[5]
    return symmetric / jnp.where(trace > 0, trace, 1)


def _null_vector(xx: Array, xy: Array, xz: Array, yy: Array, yz: Array, zz: Array) -> Float[Array, "3 N"]:
    """Unit null vector of a symmetric matrix of rank two: the longest cross product of two of its rows."""
    rows = (jnp.stack([xx, xy, xz]), jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz]))
    crosses = [jnp.cross(rows[i], rows[j], axis=0) for i, j in ((0, 1), (0, 2), (1, 2))]
    squares = [jnp.sum(cross * cross, axis=0) for cross in crosses]
    best, length = crosses[0], squares[0]
    for cross, square in zip(crosses[1:], squares[1:], strict=True):
        best = jnp.where(square > length, cross, best)
        length = jnp.maximum(square, length)
    unit = best / jnp.sqrt(jnp.where(length > 0, length, 1))
    return jnp.where(length > 0, unit, jnp.array([[0.0], [0.0], [1.0]], best.dtype))


@_smallest_eigenvector.defjvp
def _smallest_eigenvector_jvp(
    primals: tuple[Float[Array, "6 N"]], tangents: tuple[Float[Array, "6 N"]]
) -> tuple[Float[Array, "3 N"], Float[Array, "3 N"]]:
    """dn = −B (Bᵀ A B − λ)⁻¹ Bᵀ dA n, with B a basis of the plane across n and λ = nᵀ A n."""
    (symmetric,), (tangent,) = primals, tangents
    normal = _smallest_eigenvector(symmetric)
    trace = symmetric[0] + symmetric[3] + symmetric[5]
    scale = 1 / jnp.where(trace > 0, trace, 1)
    scaled = symmetric * scale
    u, v = orthonormal_basis(normal)
    a, b, c = project(scaled, u, v)
    eigenvalue = jnp.sum(normal * multiply(scaled, normal), axis=0)
    a, c = a - eigenvalue, c - eigenvalue
    # The product of the two gaps and their sum tell the smaller one: where it is lost in rounding there is no
    # derivative, and the answer is zero rather than NaN.
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


def sandwich(outside: Float[Array, "3 N"], inside: Float[Array, "3 N"]) -> Float[Array, "3 N"]:
    """W A W for symmetric 2×2 matrices."""
    p, q, r = outside
    a, b, c = inside
    return jnp.stack(
        [
            p * p * a + 2 * p * q * b + q * q * c,
            p * q * a + (p * r + q * q) * b + q * r * c,
            q * q * a + 2 * q * r * b + r * r * c,
        ]
    )


def floor_eigenvalues(symmetric: Float[Array, "3 N"], floor: Float[Array, ""]) -> Float[Array, "3 N"]:
    """Raise the eigenvalues of 2×2 matrices to at least `floor`; matrices above it stay as they are, bit by bit."""
    a, b, c = symmetric
    mean, half = 0.5 * (a + c), 0.5 * (a - c)
    square = half * half + b * b
    radius = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    below = mean - radius < floor
    low, high = jnp.maximum(mean - radius, floor), jnp.maximum(mean + radius, floor)
    middle, ratio = 0.5 * (high + low), 0.5 * (high - low) / jnp.where(radius > 0, radius, 1)
    raised = jnp.stack([middle + ratio * half, ratio * b, middle - ratio * half])
    return jnp.where(below, raised, symmetric)


# One (k, N) array per coordinate. Kept apart on purpose: jaxlib 0.10.2 on CPUs miscompiles, in float32, the reduction
# of a (3, k, N) array over its middle axis where the result is broadcast back and subtracted.
Offsets: TypeAlias = tuple[Float[Array, "k N"], Float[Array, "k N"], Float[Array, "k N"]]


class Neighborhoods(NamedTuple):
    """Some points of a cloud, and what lies around them.

    Attributes:
        rows: of the points in the cloud.
        neighbors: (n, k) rows of their neighbours; −1 for none.
        offsets: of the neighbours from the points, metres; 0 where there is none.
        present: (k, n) which neighbours there are.
        covariance: (6, n) of the neighbours about their mean, metres².
        normal: (3, n) unit vectors, the eigenvectors of the smallest eigenvalue.
    """

    rows: Int[Array, "n"]
    neighbors: Int[Array, "n k"]
    offsets: Offsets
    present: Bool[Array, "k n"]
    covariance: Float[Array, "6 n"]
    normal: Float[Array, "3 n"]


def by_neighborhoods(
    function: Callable[[Neighborhoods], Tree],
    points: Float[Array, "3 M"],
    neighbors: Int[Array, "N k"],
    rows: Int[Array, "N"] | None = None,
) -> Tree:
    """What a function makes of points and what lies around them; many are gone through block by block.

    Args:
        function: its arrays have the points as their last dimension.
        neighbors: of the rows.
        rows: of the points; all by default.
    """

    def of_block(rows: Int[Array, "n"], neighbors: Int[Array, "n k"]) -> Tree:
        offsets, present = _gather(points, rows, neighbors)
        local = weighted_covariance(offsets, present.astype(points.dtype))
        return function(Neighborhoods(rows, neighbors, offsets, present, local, smallest_eigenvector(local)))

    rows = jnp.arange(points.shape[1]) if rows is None else rows
    num_points = rows.size
    if num_points <= _LARGEST_WHOLE:
        return of_block(rows, neighbors)
    num_blocks = -(-num_points // _LARGEST_BLOCK)
    size = -(-num_points // num_blocks)
    missing = num_blocks * size - num_points
    rows = jnp.pad(rows, (0, missing)).reshape(num_blocks, size)
    neighbors = jnp.pad(neighbors, [(0, missing), (0, 0)], constant_values=-1).reshape(num_blocks, size, -1)
    blocks = jax.lax.map(lambda block: of_block(*block), (rows, neighbors))
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -2).reshape(*leaf.shape[1:-1], -1)[..., :num_points], blocks)


def _gather(
    points: Float[Array, "3 M"], rows: Int[Array, "N"], neighbors: Int[Array, "N k"]
) -> tuple[Offsets, Bool[Array, "k N"]]:
    """The neighbours of some rows as offsets from these, and which of them there are."""
    present = neighbors.T >= 0
    near = jnp.where(present, neighbors.T, 0)
    x, y, z = (jnp.where(present, coordinate[near] - coordinate[rows], 0) for coordinate in points)
    return (x, y, z), present


def weighted_covariance(offsets: Offsets, weights: Float[Array, "k N"]) -> Float[Array, "6 N"]:
    """Covariance about the weighted mean; zero where all weights are."""
    total = jnp.sum(weights, axis=0)
    weights = weights / jnp.where(total > 0, total, 1)
    x, y, z = (offset - jnp.sum(weights * offset, axis=0) for offset in offsets)
    pairs = ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))
    return jnp.stack([jnp.sum(weights * p * q, axis=0) for p, q in pairs])


class LinearFit(NamedTuple):
    """Of values over a plane, by weighted least squares.

    Attributes:
        gradient: of the values along x and y; 0 where the points lie on a line.
        residual: variance of the values about the fit; meaningless for three points or fewer.
        inverse: (3, N) symmetric; times `residual` it is the covariance of the gradient. 0 on a line.
        weight: sum of the weights.
    """

    gradient: tuple[Float[Array, "N"], Float[Array, "N"]]
    residual: Float[Array, "N"]
    inverse: Float[Array, "3 N"]
    weight: Float[Array, "N"]


@jax.jit
def fit_linear(
    x: Float[Array, "k N"], y: Float[Array, "k N"], values: Float[Array, "k N"], weights: Float[Array, "k N"]
) -> LinearFit:
    """Fit a + b x + c y to the values of each neighbourhood; weights are 1 or, for what does not count, 0."""
    count = jnp.sum(weights, axis=0)

    def centred(values: Float[Array, "k N"]) -> Float[Array, "k N"]:
        return weights * (values - jnp.sum(weights * values, axis=0) / jnp.maximum(count, 1))

    x, y, values = centred(x), centred(y), centred(values)
    xx, xy, yy = jnp.sum(x * x, axis=0), jnp.sum(x * y, axis=0), jnp.sum(y * y, axis=0)
    determinant = xx * yy - xy * xy
    planar = determinant > 1e-6 * (xx + yy) ** 2
    inverse = jnp.where(planar, jnp.stack([yy, -xy, xx]) / jnp.where(planar, determinant, 1), 0)
    p, q, r = inverse
    xv, yv = jnp.sum(x * values, axis=0), jnp.sum(y * values, axis=0)
    gx, gy = p * xv + q * yv, q * xv + r * yv
    square = jnp.maximum(jnp.sum(values * values, axis=0) - gx * xv - gy * yv, 0)
    return LinearFit((gx, gy), square / jnp.maximum(count - 3, 1), inverse, count)


def plane_covariance(
    local: Float[Array, "6 N"], normal: Float[Array, "3 N"], epsilon: Float[Array, ""]
) -> Float[Array, "6 N"]:
    """GICP's covariance I − (1−ε) n nᵀ: 1 in the surface, ε across it (Segal et al., Generalized-ICP, RSS 2009).

    Neighbours that all coincide span no surface: the identity.
    """
    spread = local[0] + local[3] + local[5] > 0
    identity = jnp.array([[1.0], [0.0], [0.0], [1.0], [0.0], [1.0]], local.dtype)
    return identity - jnp.where(spread, (1 - epsilon) * outer(normal), 0)


def channel_kernel(whitened: Float[Array, "M C"], around: Neighborhoods) -> Float[Array, "k N"]:
    """How alike each neighbour and its point look: exp(−½ |Δ|²) (Servos & Waslander 2014, eq. 7).

    Args:
        whitened: channels divided by the Cholesky factor of Λ.
    """
    near = jnp.where(around.present, around.neighbors.T, 0)
    square = jnp.zeros(near.shape, whitened.dtype)
    for channel in whitened.T:
        difference = channel[near] - channel[around.rows]
        square = square + difference * difference
    return jnp.exp(-0.5 * square)


def partial_channel_kernel(
    channels: Float[Array, "M C"],
    channel_valid: Bool[Array, "M C"],
    covariance: Float[Array, "..."],
    around: Neighborhoods,
) -> Float[Array, "k N"]:
    """The kernel of eq. 7 where points lack channels: over those that both have, with the marginal of Λ on them.

    A channel that a neighbour lacks counts as it does, on average, with the neighbours that have it. A factor of 1
    would say that the neighbour looks the same, and draw Ω out across the border of a camera's view; leaving the
    neighbour out would cut Ω off there. Measured at such borders, drawn through scans whose channels were all known,
    this choice leaves Ω the least biased.

    Args:
        covariance: Λ, scalar or (C,) or (C, C), channel units².
    """
    rows, near = around.rows, jnp.where(around.present, around.neighbors.T, 0)
    # The point itself says nothing about how alike its neighbours look.
    others = around.present & (rows != near)
    common = [valid[near] & valid[rows] for valid in channel_valid.T]
    differences = [
        jnp.where(both, channel[near] - channel[rows], 0) for channel, both in zip(channels.T, common, strict=True)
    ]
    count = len(common)
    matrix = covariance if covariance.ndim == 2 else jnp.diag(jnp.broadcast_to(covariance, (count,)))
    squares = [difference * difference / matrix[i, i] for i, difference in enumerate(differences)]
    kernel = jnp.exp(-0.5 * (_marginal_square(differences, common, matrix) if covariance.ndim == 2 else sum(squares)))
    for square, both in zip(squares, common, strict=True):
        known = both & others
        number = jnp.sum(known, axis=0)
        average = jnp.sum(jnp.where(known, jnp.exp(-0.5 * square), 0), axis=0) / jnp.maximum(number, 1)
        kernel = kernel * jnp.where(both, 1, jnp.where(number > 0, average, 1))
    return kernel


def _marginal_square(
    differences: list[Float[Array, "k N"]], common: list[Bool[Array, "k N"]], covariance: Float[Array, "C C"]
) -> Float[Array, "k N"]:
    """Δᵀ Λ⁻¹ Δ over the common channels: rows and columns of the others are those of the identity, and their Δ is 0.

    By Cholesky's recurrence, written out over the channels.
    """
    root: list[list[Array]] = []
    solution: list[Array] = []
    for i, both in enumerate(common):
        row: list[Array] = []
        for j in range(i):
            entry = jnp.where(both & common[j], covariance[i, j], 0)
            row.append((entry - sum(a * b for a, b in zip(row, root[j], strict=False))) / root[j][j])
        pivot = jnp.sqrt(jnp.where(both, covariance[i, i], 1) - sum(a * a for a in row))
        solution.append((differences[i] - sum(a * y for a, y in zip(row, solution, strict=True))) / pivot)
        root.append([*row, pivot])
    return sum((y * y for y in solution), start=jnp.zeros_like(differences[0]))


def multichannel_covariance(
    around: Neighborhoods, kernel: Float[Array, "k N"], epsilon: Float[Array, ""], min_eigenvalue: Float[Array, ""]
) -> Float[Array, "6 N"]:
    """Ω in the tangent plane and ε across it (Servos & Waslander 2014, eqs. 6-10).

    Args:
        kernel: λ_j of the neighbours.
        min_eigenvalue: floor for the eigenvalues of Ω, which reach 0 where only the point itself looks like it.

    Ω = Σ_w^{-1/2} Σ_t Σ_w^{-1/2} is written as I + Σ_w^{-1/2} (Σ_t − Σ_w) Σ_w^{-1/2}: uniform channels then give
    GICP's covariance to rounding, whatever the neighbourhood.
    """
    local, normal = around.covariance, around.normal
    alike = weighted_covariance(around.offsets, jnp.where(around.present, kernel, 0))
    u, v = orthonormal_basis(normal)
    unweighted, weighted = project(local, u, v), project(alike, u, v)
    trace = unweighted[0] + unweighted[2]
    spread = trace > 0
    scale = 1 / jnp.where(spread, trace, 1)
    regular = unweighted * scale + _REGULARISATION * jnp.array([[1.0], [0.0], [1.0]], local.dtype)
    regular = jnp.where(spread, regular, jnp.array([[1.0], [0.0], [1.0]], local.dtype))
    change = sandwich(inverse_square_root(regular), (weighted - unweighted) * scale)
    inside = embed(floor_eigenvalues(change, min_eigenvalue - 1), u, v)
    return plane_covariance(local, normal, epsilon) + inside


def embed(symmetric: Float[Array, "3 N"], u: Float[Array, "3 N"], v: Float[Array, "3 N"]) -> Float[Array, "6 N"]:
    """B A Bᵀ in the basis B = [u v]: a 2×2 matrix of the tangent plane as a 3×3 one."""
    a, b, c = symmetric
    cross = jnp.stack([2 * u[i] * v[j] if i == j else u[i] * v[j] + u[j] * v[i] for i in range(3) for j in range(i, 3)])
    return a * outer(u) + b * cross + c * outer(v)
