"""The Mahalanobis cost of matched pairs, robust kernels, and the 73 numbers that one pose update needs of them."""

from __future__ import annotations

import abc
from functools import partial
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax import _covariance as cov
from mcgicp_jax._cloud import PointCloud
from mcgicp_jax._methods import AbstractGeneralized, AbstractMethod, Numbers, Surface, prepare
from mcgicp_jax._pose import Pose, is_concrete, pose_matrix
from mcgicp_jax._search import Correspondences, Rows


class AbstractKernel(Numbers):
    """A robust kernel ρ of the squared Mahalanobis distance s² of one pair; ρ(s²) ≈ s² for small distances.

    Attributes:
        scale: k, the Mahalanobis distance from which a pair counts less; dimension metres, as GICP's covariances are
            relative (1 within the surface).
    """

    scale: Float[Array, ""]

    def __init__(self, scale: ArrayLike):
        """Raises `ValueError` unless the scale is positive."""
        self.scale = jnp.asarray(scale, float) if is_concrete(scale) else jnp.asarray(scale)
        if self.scale.shape != () or (is_concrete(self.scale) and not 0 < float(self.scale) < np.inf):
            raise ValueError(f"scale: expected one positive number, got {scale!r}")

    @abc.abstractmethod
    def _rho(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]: ...

    @abc.abstractmethod
    def _weight(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]: ...

    def rho(self, square: Float[Array, "N"]) -> Float[Array, "N"]:
        """The cost of pairs with squared distance s²."""
        return self._rho(square, self.scale.astype(square.dtype))

    def weight(self, square: Float[Array, "N"]) -> Float[Array, "N"]:
        """dρ/d(s²): the weight of a pair."""
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
    """k²/3 (1 − (1 − s²/k²)³) up to k, constant beyond: such pairs have no weight."""

    def _rho(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return scale**2 / 3 * (1 - jnp.maximum(1 - square / scale**2, 0) ** 3)

    def _weight(self, square: Float[Array, "N"], scale: Float[Array, ""]) -> Float[Array, "N"]:
        return jnp.maximum(1 - square / scale**2, 0) ** 2


class Pairs(eqx.Module):
    """Matched pairs at a pose; rows without a match have weight 0.

    Attributes:
        moved: (3, N) T a.
        residual: (3, N) d = b − T a.
        information: (6, N) M.
        valid: (N,) whether there is a match.
        weight: (N,) robust weight, times the share of a soft match; 0 without a match.
        cost: (N,) ρ(dᵀ M d), times that share; 0 without a match.
        share: (N,) what this pair counts of all that its source point has: 1, or less with several candidates.
    """

    moved: Float[Array, "3 N"]
    residual: Float[Array, "3 N"]
    information: Float[Array, "6 N"]
    valid: Bool[Array, "N"]
    weight: Float[Array, "N"]
    cost: Float[Array, "N"]
    share: Float[Array, "N"]


def move_points(rotation: Float[Array, "3 3"], translation: Float[Array, "3"], source: Surface) -> Float[Array, "3 N"]:
    """T a for every source row."""
    return jnp.dot(rotation, source.points, precision="highest") + translation[:, None]


def evaluate_pairs(
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    source: Surface,
    target: Surface,
    matches: Correspondences,
    method: AbstractMethod,
    robust: AbstractKernel | None,
    temperature: Float[Array, ""] | None,
) -> Pairs:
    """Residual, weight matrix and cost of every pair at a pose, with M at that pose.

    With m candidates per source point there are m N pairs, candidate by candidate.
    """
    candidates = matches.indices.reshape(-1, source.valid.size)
    times = len(candidates)
    if times > 1:
        source = Surface(
            points=jnp.tile(source.points, (1, times)),
            covariance=jnp.tile(source.covariance, (1, times)),
            descriptors=jnp.tile(source.descriptors, (times, 1)),
            valid=jnp.tile(source.valid, times),
            absence=None if source.absence is None else jnp.tile(source.absence, (times, 1)),
        )
    indices, valid = candidates.reshape(-1), matches.valid.reshape(-1)
    moved = move_points(rotation, translation, source)
    # A row without a match may point anywhere: zero it before it is squared, so that its gradient is zero and not NaN.
    residual = jnp.where(valid, target.points[:, indices] - moved, 0)
    information = method.information(target.covariance[:, indices], source.covariance, rotation)
    square = cov.inner(residual, cov.multiply(information, residual))
    weight, cost = (jnp.ones_like(square), square) if robust is None else (robust.weight(square), robust.rho(square))
    share = valid.astype(square.dtype)
    if temperature is not None:
        far = cov.inner(residual, residual) + _square_apart(source.rows, target.rows, indices)
        share = _softmax(-0.5 * far / temperature**2, valid, candidates.shape)
    return Pairs(
        moved=moved,
        residual=residual,
        information=information,
        valid=valid,
        weight=share * weight,
        cost=share * cost,
        share=share,
    )


def _square_apart(source: Rows, target: Rows, indices: Int[Array, "N"]) -> Float[Array, "N"]:
    """Squared distance of the pairs in their descriptors, metres²."""
    square = (source.descriptors - target.descriptors[indices]) ** 2
    for absence in (source.absence, None if target.absence is None else target.absence[indices]):
        if absence is not None:
            square = jnp.where(absence > 0, absence, square)
    return jnp.sum(square, axis=1)


def _softmax(logits: Float[Array, "N"], valid: Bool[Array, "N"], shape: tuple[int, ...]) -> Float[Array, "N"]:
    """Over the valid candidates of each source point; 0 where it has none."""
    logits, valid = logits.reshape(shape), valid.reshape(shape)
    highest = jax.lax.stop_gradient(jnp.max(jnp.where(valid, logits, -jnp.inf), axis=0))
    shifted = jnp.where(valid, logits - jnp.where(jnp.isfinite(highest), highest, 0), 0)
    powers = jnp.where(valid, jnp.exp(shifted), 0)
    total = jnp.sum(powers, axis=0)
    return (powers / jnp.where(total > 0, total, 1)).reshape(-1)


# All that decides how a pose is weighed, in the order of `evaluate_pairs`.
Model: TypeAlias = tuple[
    Surface, Surface, Correspondences, AbstractMethod, AbstractKernel | None, Float[Array, ""] | None
]


class Moments(eqx.Module):
    """All that one pose update needs to know of the pairs.

    With D = [ΔR − I | Δt] the change of pose about `center` and h = (p, 1), p the moved source point relative to it:
    Σ w (d − D h)ᵀ M (d − D h) = e − 2⟨D, G⟩ + ⟨D, Q(D)⟩. Relative to the centre and about the current pose, no digits
    are lost in float32.

    Attributes:
        center: (3,) centroid of the moved source points that have a match.
        radius: their root mean square distance from it, metres; the characteristic length of rotations.
        e: Σ w dᵀ M d.
        G: (3, 4) Σ w M d hᵀ.
        Q: (6, 10) Σ w M ⊗ h hᵀ, both symmetric and stored by their upper triangles.
    """

    center: Float[Array, "3"]
    radius: Float[Array, ""]
    e: Float[Array, ""]
    G: Float[Array, "3 4"]
    Q: Float[Array, "6 10"]


def moments(pairs: Pairs) -> Moments:
    """The 73 numbers, in one pass over the pairs."""
    mask = pairs.valid.astype(pairs.moved.dtype)
    count = jnp.maximum(jnp.sum(mask), 1)
    center = jnp.sum(mask * pairs.moved, axis=1) / count
    p = mask * (pairs.moved - center[:, None])
    radius = jnp.sqrt(jnp.sum(p * p) / count)
    weighted = pairs.weight * pairs.information
    force = cov.multiply(weighted, pairs.residual)
    h = jnp.concatenate([p, jnp.ones_like(p[:1])])
    return Moments(
        center=center,
        radius=radius,
        e=jnp.sum(pairs.residual * force),
        G=jnp.dot(force, h.T, precision="highest"),
        Q=jnp.dot(weighted, powers(p).T, precision="highest"),
    )


def powers(p: Float[Array, "3 N"]) -> Float[Array, "10 N"]:
    """The upper triangle of h hᵀ with h = (p, 1)."""
    x, y, z = p
    return jnp.stack([x * x, x * y, x * z, x, y * y, y * z, y, z * z, z, jnp.ones_like(x)])


def mahalanobis_cost(
    pose: Pose,
    source: PointCloud,
    target: PointCloud,
    matches: Correspondences,
    method: AbstractMethod,
    *,
    robust: AbstractKernel | None = None,
    temperature: ArrayLike | None = None,
    log_determinant: bool = False,
) -> Float[Array, ""]:
    """F(T) = Σ ρ(dᵀ M d) with d = b − T a and M = (C^B + R C^A Rᵀ)⁻¹ (Servos & Waslander 2014, eq. 3, whose inverse is
    missing in print).

    Pure JAX, differentiable in everything but the matches. M follows the rotation here, so that F is the cost itself;
    the pose that `align` returns holds M during an update, as every GICP does, and is not exactly F's minimum.

    Args:
        pose: T_target_source, `jaxlie.SE3` or (4, 4).
        source, target: preprocessed clouds.
        matches: from `find_correspondences`.
        method: which covariances; open numbers are chosen from the data.
        robust: kernel of each pair's Mahalanobis distance.
        temperature: metres; with several candidates per source point (`num_candidates`), each pair counts by a softmax
            of −½ (distance / temperature)², distances in position and α · channel. This gives α a gradient. Towards 0
            the nearest candidate alone counts.
        log_determinant: add Σ log det (C^B + R C^A Rᵀ). Together with the squared distance that is a Gaussian
            likelihood; without it, a loss that learns covariances (or ε, or Λ) is lowered by inflating them. For `GICP`
            and `MultiChannelGICP`.

    Returns:
        The cost; metres² for the methods with M = I, otherwise in units of GICP's relative covariances.

    Raises:
        ValueError: if the matches do not belong to the source, a cloud lacks the neighbours that the method needs, or
            the method has no determinant.
    """
    check_matches(matches, source, temperature)
    if log_determinant and not isinstance(method, AbstractGeneralized):
        raise ValueError(f"log_determinant: expected a method with covariances, got {type(method).__name__}")
    method = method.resolve(source, target)
    dtype = source.points.dtype
    matrix = centred_pose(pose_matrix(pose, "pose"), source, target)
    rotation, translation = jnp.asarray(matrix[:3, :3], dtype), jnp.asarray(matrix[:3, 3], dtype)
    surfaces = prepare(method, source), prepare(method, target)
    temperature = None if temperature is None else jnp.asarray(temperature, dtype)
    return _total_cost(rotation, translation, *surfaces, matches, method, robust, temperature, log_determinant)


def check_matches(matches: Correspondences, source: PointCloud, temperature: ArrayLike | None) -> None:
    """Raise `ValueError` unless there is a match, or a softened choice of candidates, for every source row."""
    rows = source.points.shape[0]
    if matches.indices.ndim > 2 or matches.indices.shape[-1] != rows:
        raise ValueError(f"matches: expected one per source row ({rows}), got shape {matches.indices.shape}")
    if matches.indices.ndim == 2 and temperature is None:
        raise ValueError(f"temperature: expected metres to go with {matches.indices.shape[0]} candidates, got None")
    if temperature is not None and is_concrete(temperature) and not np.asarray(temperature) > 0:
        raise ValueError(f"temperature: expected a positive number of metres, got {temperature!r}")


@partial(jax.jit, static_argnames="log_determinant")
def _total_cost(
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    source: Surface,
    target: Surface,
    matches: Correspondences,
    method: AbstractMethod,
    robust: AbstractKernel | None,
    temperature: Float[Array, ""] | None,
    log_determinant: bool,
) -> Float[Array, ""]:
    pairs = evaluate_pairs(rotation, translation, source, target, matches, method, robust, temperature)
    cost = jnp.sum(pairs.cost)
    if log_determinant:
        determinant = jnp.where(pairs.valid, cov.determinant(pairs.information), 1)
        cost = cost - jnp.sum(pairs.share * jnp.log(determinant))
    return cost


def centred_pose(matrix: Array | np.ndarray, source: PointCloud, target: PointCloud) -> Array | np.ndarray:
    """The same motion between the clouds' own origins: T(−o_t) · T · T(o_s), in the precision that it comes in."""
    rotation, translation = matrix[:3, :3], matrix[:3, 3]
    # In this order two far origins cancel before they meet the rotation.
    shifted = (rotation - np.eye(3)) @ source.origin + (source.origin - target.origin) + translation
    if isinstance(shifted, np.ndarray) and isinstance(matrix, np.ndarray):
        result = matrix.copy()
        result[:3, 3] = shifted
        return result
    return jnp.asarray(matrix).at[:3, 3].set(shifted)
