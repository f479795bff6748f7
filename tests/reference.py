"""Reference implementation in NumPy and float64, point by point, with which the tests compare the package.

Nothing here is fast, batched or differentiable, and nothing is imported from the package. Inputs are plain arrays;
`neighbors` is (N, k) with the point itself among its neighbours and −1 where there is none.
"""

import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation


def scene(num_points: int, num_channels: int = 0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A wavy sheet of 4 × 4 m with channels that have edges, slopes and noise; values are exact in float32."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-2, 2, (2, num_points))
    points = np.stack([x, y, 0.3 * np.sin(1.3 * x) * np.cos(y) + rng.normal(scale=0.01, size=num_points)], axis=1)
    directions = rng.normal(size=(num_channels, 2))
    along = np.stack([x, y], axis=1) @ directions.T
    channels = 0.5 * np.sign(np.sin(2 * along)) + 0.3 * along + rng.normal(scale=0.2, size=along.shape)
    return points.astype(np.float32).astype(float), channels.astype(np.float32).astype(float)


def symmetric(packed) -> np.ndarray:
    """Unpack (6, N) as xx, xy, xz, yy, yz, zz, or (3, N) as xx, xy, yy, to (N, 3, 3) or (N, 2, 2)."""
    packed = np.asarray(packed, float)
    size = {6: 3, 3: 2}[len(packed)]
    matrices = np.zeros((packed.shape[1], size, size))
    rows, columns = np.triu_indices(size)
    matrices[:, rows, columns] = matrices[:, columns, rows] = packed.T
    return matrices


def packed(matrices) -> np.ndarray:
    """The inverse of `symmetric`."""
    matrices = np.asarray(matrices, float)
    rows, columns = np.triu_indices(matrices.shape[-1])
    return matrices[:, rows, columns].T


def difference(function, at, direction, step: float) -> float:
    """The central difference of a function of arrays along a direction."""
    return (function(at + step * direction) - function(at - step * direction)) / (2 * step)


def rotation(axis_angle) -> np.ndarray:
    """Rodrigues' formula."""
    w = np.asarray(axis_angle, float)
    angle = np.linalg.norm(w)
    if angle == 0:
        return np.eye(3)
    x, y, z = w / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def pose(axis_angle, translation=(0, 0, 0)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation(axis_angle), translation
    return matrix


def exponential(twist) -> np.ndarray:
    """exp(ξ) of ξ = (v, ω), (4, 4)."""
    v, (x, y, z) = np.split(np.asarray(twist, float), 2)
    matrix = np.zeros((4, 4))
    matrix[:3] = np.column_stack([[0, z, -y], [-z, 0, x], [y, -x, 0], v])
    return scipy.linalg.expm(matrix)


def logarithm(motions) -> np.ndarray:
    """Twists (..., 6) of motions (..., 4, 4): t = V v with V = ∫ exp(s ω×) ds, by Gauss-Legendre quadrature."""
    motions = np.asarray(motions, float)
    turns = Rotation.from_matrix(motions[..., :3, :3].reshape(-1, 3, 3))
    nodes, weights = np.polynomial.legendre.leggauss(12)
    V = sum(w / 2 * (turns ** ((s + 1) / 2)).as_matrix() for s, w in zip(nodes, weights, strict=True))
    shifts = np.linalg.solve(V, motions[..., :3, 3].reshape(-1, 3, 1))[..., 0]
    return np.hstack([shifts, turns.as_rotvec()]).reshape(*motions.shape[:-2], 6)


def nearest(queries, targets, k: int = 1) -> np.ndarray:
    """Indices of the k nearest targets, nearest first, ties by index; −1 where there are fewer than k."""
    queries, targets = np.asarray(queries, float), np.asarray(targets, float)
    found = np.full((len(queries), k), -1)
    for i, query in enumerate(queries):
        squared = ((targets - query) ** 2).sum(axis=1)
        order = np.argsort(squared, kind="stable")[:k]
        found[i, : len(order)] = order
    return found


def match(source, target, T, max_distance, source_channels=None, target_channels=None, weights=0.0):
    """Index of the nearest target of every moved source point in position and weighted channels; −1 if the match found
    is further away than `max_distance` in position (metres)."""
    T = np.asarray(T, float)
    moved = np.asarray(source, float) @ T[:3, :3].T + T[:3, 3]
    a, b = moved, np.asarray(target, float)
    if source_channels is not None:
        a = np.concatenate([a, weights * np.asarray(source_channels, float)], axis=1)
        b = np.concatenate([b, weights * np.asarray(target_channels, float)], axis=1)
    index = nearest(a, b)[:, 0]
    distances = np.linalg.norm(np.asarray(target, float)[index] - moved, axis=1)
    return np.where(distances <= max_distance, index, -1)


def match_partial(source, target, source_present, target_present, penalty, k: int = 1) -> np.ndarray:
    """Indices of the k nearest targets, ties by index, of rows of positions and descriptors, (N, 3 + D). A descriptor
    missing in either row adds its `penalty`, (D,), to the squared distance."""
    found = []
    for row, present in zip(source, source_present, strict=True):
        both = present & target_present
        squared = ((target[:, :3] - row[:3]) ** 2).sum(axis=1)
        squared = squared + np.where(both, (target[:, 3:] - row[3:]) ** 2, penalty).sum(axis=1)
        found.append(np.lexsort((np.arange(len(target)), squared))[:k])
    return np.array(found)


def voxel_means(rows, points, size: float) -> np.ndarray:
    """Mean row of every occupied voxel, sorted."""
    cells: dict[tuple, list] = {}
    for row, point in zip(np.asarray(rows, float), np.asarray(points, float), strict=True):
        cells.setdefault(tuple(np.floor(point / size)), []).append(row)
    return np.array(sorted(np.mean(cell, axis=0).tolist() for cell in cells.values()))


def local_covariance(members) -> np.ndarray:
    members = np.asarray(members, float)
    centred = members - members.mean(axis=0)
    return centred.T @ centred / len(members)


def normal(members) -> np.ndarray:
    return np.linalg.eigh(local_covariance(members))[1][:, 0]


def gicp_covariances(points, neighbors, epsilon: float) -> np.ndarray:
    """I − (1−ε) n nᵀ."""
    points = np.asarray(points, float)
    result = []
    for row in neighbors:
        n = normal(points[row[row >= 0]])
        result.append(np.eye(3) - (1 - epsilon) * np.outer(n, n))
    return np.array(result)


def power(matrix, exponent: float) -> np.ndarray:
    """Real power of a symmetric matrix, by its eigenvalues."""
    values, vectors = np.linalg.eigh(matrix)
    return vectors @ np.diag(values**exponent) @ vectors.T


def full_covariance(value, num_channels: int) -> np.ndarray:
    """Λ as (C, C), given as one variance, one per channel, or a full matrix."""
    value = np.asarray(value, float)
    return value if value.ndim == 2 else np.diag(np.broadcast_to(value, (num_channels,)))


def kernel(differences, common, others, channel_covariance) -> np.ndarray:
    """Eq. 7 for the neighbours of one point, given the `differences` of channels, (k, C), valid where `common`.

    Uses the marginal of Λ on the common channels. For a missing channel, the factor is the mean over the `others`
    (the neighbours without the point itself) that have it.
    """
    full = full_covariance(channel_covariance, differences.shape[1])
    result = np.ones(len(differences))
    for j, both in enumerate(common):
        d = differences[j, both]
        result[j] = np.exp(-0.5 * d @ np.linalg.inv(full[np.ix_(both, both)]) @ d)
        for c in np.flatnonzero(~both):
            known = common[:, c] & others
            if known.any():
                result[j] *= np.mean(np.exp(-0.5 * differences[known, c] ** 2 / full[c, c]))
    return result


def omega(members, kernel, regularisation=0.0):
    """Eqs. 6-10 for one point: Ω, the tangent basis (3, 2) and the normal.

    `regularisation` times the trace of Σ_w is added to its diagonal; Ω is then I + Σ_w^{-1/2} (Σ_t − Σ_w) Σ_w^{-1/2}.
    """
    members = np.asarray(members, float)
    _, vectors = np.linalg.eigh(local_covariance(members))
    n, tangent = vectors[:, 0], vectors[:, 1:]
    z = (members - members.mean(axis=0)) @ tangent  # eq. 6
    mean = kernel @ z / kernel.sum()  # eq. 8
    weighted = (z - mean).T @ (kernel[:, None] * (z - mean)) / kernel.sum()  # eq. 9
    unweighted = local_covariance(z)
    half = power(unweighted + regularisation * np.trace(unweighted) * np.eye(2), -0.5)
    return np.eye(2) + half @ (weighted - unweighted) @ half, tangent, n  # eq. 10


def multi_channel_covariances(
    points, channels, neighbors, channel_covariance, epsilon, floor=0.0, regularisation=0.0, present=None
) -> np.ndarray:
    """Ω in the tangent plane + ε n nᵀ, with the eigenvalues of Ω raised to at least `floor`."""
    points, channels = np.asarray(points, float), np.asarray(channels, float)
    present = np.ones(channels.shape, bool) if present is None else present
    result = []
    for i, row in enumerate(neighbors):
        row = row[row >= 0]
        alike = kernel(channels[row] - channels[i], present[row] & present[i], row != i, channel_covariance)  # eq. 7
        plane, tangent, n = omega(points[row], alike, regularisation)
        values, vectors = np.linalg.eigh(plane)
        plane = vectors @ np.diag(np.maximum(values, floor)) @ vectors.T
        result.append(tangent @ plane @ tangent.T + epsilon * np.outer(n, n))
    return np.array(result)


# ρ as a function of the squared Mahalanobis distance s² and the kernel's scale c.
ROBUST = {
    "huber": lambda s2, c: s2 if s2 <= c * c else 2 * c * np.sqrt(s2) - c * c,
    "cauchy": lambda s2, c: c * c * np.log1p(s2 / (c * c)),
    "geman-mcclure": lambda s2, c: s2 / (1 + s2 / (c * c)),
    "tukey": lambda s2, c: c * c / 3 * (1 - max(0.0, 1 - s2 / (c * c)) ** 3),
    "welsch": lambda s2, c: c * c * (1 - np.exp(-s2 / (c * c))),
}


def cost(T, source, target, matches, information, rho=None) -> float:
    """Σ ρ(dᵀ M d), d = b − T a, over the matches. `information(i, j, R)` gives M of source i and target j."""
    T, source, target = np.asarray(T, float), np.asarray(source, float), np.asarray(target, float)
    total = 0.0
    for i, j in enumerate(matches):
        if j >= 0:
            d = target[j] - (T[:3, :3] @ source[i] + T[:3, 3])
            s2 = d @ information(i, j, T[:3, :3]) @ d
            total += s2 if rho is None else rho(s2)
    return total


def identity_information(i, j, R) -> np.ndarray:
    """ICP and Color ICP: C^B = I, C^A = 0."""
    return np.eye(3)


def plane_information(target_normals):
    """Point to plane: M = n nᵀ of the target."""
    return lambda i, j, R: np.outer(target_normals[j], target_normals[j])


def pair_information(source_covariances, target_covariances):
    """The generalised methods: M = (C^B + R C^A Rᵀ)⁻¹."""
    return lambda i, j, R: np.linalg.inv(target_covariances[j] + R @ source_covariances[i] @ R.T)
