"""Poses from matches with many outliers: hypotheses from triplets, refined by graduated non-convexity.

All programs have fixed shapes: a fixed number of matches, padded, and of hypotheses.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.robust_kernels import truncated_weights

# Maximum number of matches. Real pairs of 5,000 voxels have 200 to 2,400 mutual ones.
NUM_MATCHES = 1024
# For each match as the first of a triplet: number of partners with the most support, and of triplets with two of them.
_NUM_PARTNERS, _NUM_TRIPLETS = 24, 16
# Number of hypotheses, all of different poses, that are refined.
NUM_REFINED = 16
# Voxels: largest distance between two matched points, and largest difference between the edges of matched triangles.
# Mean points of voxels in two clouds are about half a voxel apart.
TOLERANCE = 1.5
# Voxels: shortest edge of a triangle. The pose from a shorter one is uncertain, and neighbouring points have similar
# features, right or wrong.
_SHORTEST_EDGE = 4.0
# Largest difference between the clouds of the cosine between two normals: in real scans it is up to 0.2.
_NORMAL_TOLERANCE = 0.3
# Voxels: poses that move points by less than this relative to each other are the same.
MIN_SEPARATION = 5.0
# Graduated non-convexity: the first control parameter μ, with which matches count up to √5 tolerances away, its growth
# by each step (Yang et al. 2020), and the number of steps, after which matches count up to 1.05 tolerances.
_FIRST_CONTROL, _GROWTH, _NUM_STEPS = 0.25, 1.4, 12


class PutativeMatches(NamedTuple):
    """Matches, padded to `NUM_MATCHES`: positions in metres about their centres, and unit normals of any sign, or zeros
    where they are not to be compared."""

    source: Float[AnyArray, "M 3"]
    target: Float[AnyArray, "M 3"]
    source_normals: Float[AnyArray, "M 3"]
    target_normals: Float[AnyArray, "M 3"]
    valid: Bool[AnyArray, "M"]


class PoseHypotheses(NamedTuple):
    """Poses R a + t, and the score of each: the number of inliers, weighted by 1 − (distance / tolerance)²."""

    rotation: Float[AnyArray, "n 3 3"]
    translation: Float[AnyArray, "n 3"]
    score: Float[AnyArray, "n"]


def fit_pose(
    source: Float[AnyArray, "M 3"], target: Float[AnyArray, "M 3"], weights: Float[AnyArray, "M"]
) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """Rotation R and translation t that minimise Σ w |R a + t − b|², in closed form.

    The rotation maximises tr(Rᵀ H), H = Σ w b aᵀ about the means. With the right singular vector n of the smallest
    singular value, from HᵀH, and a right-handed basis (p, q, n), R maps n to the direction of H p × H q, and within
    the planes orthogonal to these it is the rotation that fits best in two dimensions. This includes the correction of
    reflections (Umeyama 1991). Points on a line, or fewer than three, give some rotation that fits.
    """
    total = jnp.sum(weights)
    fractions = (weights / jnp.where(total > 0, total, 1))[:, None]
    means = [jnp.sum(fractions * points, axis=0) for points in (source, target)]
    a, b = (points - mean for points, mean in zip((source, target), means, strict=True))
    product = jnp.sum((fractions * b)[:, :, None] * a[:, None, :], axis=0)
    square = jnp.sum(product[:, :, None] * product[:, None, :], axis=0)
    normal = alg.smallest_eigenvector(alg.symmetric_from_matrix(square[None]))
    p, q = (axis[:, 0] for axis in alg.orthonormal_basis(normal))
    moved = [jnp.sum(product * axis, axis=1) for axis in (p, q)]
    across = jnp.cross(moved[0], moved[1])
    length = jnp.sqrt(jnp.sum(across * across))
    regular = length > 0
    across = jnp.where(regular, across / jnp.where(regular, length, 1), normal[:, 0])
    u, v = (axis[:, 0] for axis in alg.orthonormal_basis(across[:, None]))
    angle = jnp.arctan2(jnp.sum(v * moved[0]) - jnp.sum(u * moved[1]), jnp.sum(u * moved[0]) + jnp.sum(v * moved[1]))
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    columns = (cosine * u + sine * v, cosine * v - sine * u, across)
    rotation = sum(x[:, None] * y for x, y in zip(columns, (p, q, normal[:, 0]), strict=True))
    return rotation, means[1] - jnp.sum(rotation * means[0], axis=1)


@jax.jit
def hypotheses(
    matches: PutativeMatches, voxel_size: Float[AnyScalar, ""], radius: Float[AnyScalar, ""]
) -> PoseHypotheses:
    """The best `NUM_REFINED` different poses among those of 16,384 triplets of matches with consistent distances.

    Two matches agree if the distance and the angle between their normals are the same in both clouds. The support of
    two matches that agree is the number of matches that agree with both (Chen et al., SC²-PCR, CVPR 2022): two wrong
    matches agree by chance, three seldom do. Each match forms triplets with two of the partners with which it has most
    support, by a fixed draw. `radius` is that of the source, metres.
    """
    support = _support(matches, voxel_size)
    _, partners = jax.lax.top_k(support, _NUM_PARTNERS)
    draw = np.random.default_rng(0).permutation(np.transpose(np.triu_indices(_NUM_PARTNERS, 1)))[:_NUM_TRIPLETS]
    first = jnp.repeat(jnp.arange(NUM_MATCHES), _NUM_TRIPLETS)
    second, third = (partners[:, draw[:, i]].reshape(-1) for i in (0, 1))

    def unit(vectors: Float[Array, "T 3"]) -> Float[Array, "T 3"]:
        length = jnp.sqrt(jnp.sum(vectors * vectors, axis=-1, keepdims=True))
        return vectors / jnp.where(length > 0, length, 1)

    # The frame of each triangle (columns: along the first edge, across it in the plane, normal; meaningless if
    # collinear) and its centroid, in both clouds.
    frames, centroids = [], []
    for points in (matches.source, matches.target):
        p, q, r = (points[rows] for rows in (first, second, third))
        along = unit(q - p)
        normal = unit(jnp.cross(along, r - p))
        frames.append(jnp.stack([along, jnp.cross(normal, along), normal], axis=-1))
        centroids.append((p + q + r) / 3)
    rotation = jnp.sum(frames[1][:, :, None, :] * frames[0][:, None, :, :], axis=-1)
    translation = centroids[1] - jnp.sum(rotation * centroids[0][:, None, :], axis=-1)
    agree = (support[first, second] > 0) & (support[first, third] > 0) & (support[second, third] > 0)
    edges = [matches.source[rows] - matches.source[first] for rows in (second, third)]
    area = jnp.sqrt(jnp.sum(jnp.cross(edges[0], edges[1]) ** 2, axis=-1))
    agree = agree & (area > (_SHORTEST_EDGE * voxel_size) ** 2)
    score = jnp.where(agree, _scores(rotation, translation, matches, voxel_size), 0)

    # The best pose, the best of those that differ from it, and so on.
    def step(score: Float[Array, "n"], _: None) -> tuple[Float[Array, "n"], tuple[Array, Array]]:
        best = jnp.argmax(score)
        separation = squared_separation(rotation - rotation[best], translation - translation[best], radius)
        different = separation > (MIN_SEPARATION * voxel_size) ** 2
        return jnp.where(different, score, 0), (best, score[best])

    _, (rows, score) = jax.lax.scan(step, score, None, NUM_REFINED)
    return PoseHypotheses(rotation[rows], translation[rows], score)


def _support(matches: PutativeMatches, voxel_size: Float[AnyScalar, ""]) -> Float[Array, "M M"]:
    lengths, cosines = [], []
    for points, normals in ((matches.source, matches.source_normals), (matches.target, matches.target_normals)):
        lengths.append(jnp.sqrt(sum((axis[:, None] - axis) ** 2 for axis in jnp.asarray(points).T)))
        cosines.append(jnp.abs(sum(axis[:, None] * axis for axis in jnp.asarray(normals).T)))
    agree = (
        (matches.valid[:, None] & matches.valid)
        & (jnp.minimum(*lengths) > _SHORTEST_EDGE * voxel_size)
        & (jnp.abs(lengths[0] - lengths[1]) < TOLERANCE * voxel_size)
        & (jnp.abs(cosines[0] - cosines[1]) < _NORMAL_TOLERANCE)
    ).astype(jnp.float32)
    # Counts are exact in float32, in any order of the sum.
    return agree * jnp.matmul(agree, agree, precision="highest")


def _scores(
    rotation: Float[Array, "n 3 3"], translation: Float[Array, "n 3"], matches: PutativeMatches, voxel_size: AnyScalar
) -> Float[Array, "n"]:
    square = _squared_distances(rotation, translation, matches) / (TOLERANCE * voxel_size) ** 2
    return jnp.sum(jnp.where(matches.valid, jnp.maximum(1 - square, 0), 0), axis=-1)


def _squared_distances(
    rotation: Float[Array, "n 3 3"], translation: Float[Array, "n 3"], matches: PutativeMatches
) -> Float[Array, "n M"]:
    x, y, z = jnp.asarray(matches.source).T
    square = jnp.zeros((), x.dtype)
    for i in range(3):
        row = rotation[:, i, :, None]
        moved = row[:, 0] * x + row[:, 1] * y + row[:, 2] * z + translation[:, i, None]
        square = square + (moved - matches.target[:, i]) ** 2
    return square


def squared_separation(turn: Float[AnyArray, "*n 3 3"], shift: Float[AnyArray, "*n 3"], radius: AnyScalar) -> Any:
    """About the squared distance, m², by which two poses move points apart, from the differences R − R' and t − t'."""
    # |R − R'| = √8 sin(angle / 2), about √2 times the angle.
    return (shift**2).sum(axis=-1) + 0.5 * radius**2 * (turn**2).sum(axis=(-1, -2))


@jax.jit
def refined(poses: PoseHypotheses, matches: PutativeMatches, voxel_size: Float[AnyScalar, ""]) -> PoseHypotheses:
    """Truncated least squares over all matches by graduated non-convexity (Yang et al., RA-L 2020, eq. 14), from each
    pose; the identity for poses with a score of 0."""
    tolerance = TOLERANCE * voxel_size

    def fit(rotation: Float[Array, "3 3"], translation: Float[Array, "3"]) -> tuple[Array, Array]:
        def step(i: Array, pose: tuple[Array, Array]) -> tuple[Array, Array]:
            square = _squared_distances(pose[0][None], pose[1][None], matches)[0]
            control = _FIRST_CONTROL * _GROWTH ** i.astype(square.dtype)
            ratio = tolerance / jnp.sqrt(jnp.maximum(square, jnp.finfo(square.dtype).tiny))
            weights = truncated_weights(ratio, control)
            return fit_pose(matches.source, matches.target, jnp.where(matches.valid, weights, 0))

        return jax.lax.fori_loop(0, _NUM_STEPS, step, (rotation, translation))

    matches = jax.tree.map(jnp.asarray, matches)
    rotation, translation = jax.vmap(fit)(poses.rotation, poses.translation)
    supported = poses.score > 0
    rotation = jnp.where(supported[:, None, None], rotation, jnp.eye(3, dtype=rotation.dtype))
    translation = jnp.where(supported[:, None], translation, 0)
    score = jnp.where(supported, _scores(rotation, translation, matches, voxel_size), 0)
    return PoseHypotheses(rotation, translation, score)
