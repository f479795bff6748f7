"""The Mahalanobis cost of matched pairs, robust kernels, and the 73 numbers that one pose update needs of them."""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from mcgicp_jax import _covariance as cov
from mcgicp_jax._cloud import PointCloud
from mcgicp_jax._methods import AbstractMethod, Surface, prepare
from mcgicp_jax._pose import Pose, is_concrete, pose_matrix
from mcgicp_jax._search import Correspondences


class AbstractKernel(eqx.Module):
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
        square: (N,) dᵀ M d.
        weight: (N,) robust weight; 0 without a match.
        cost: (N,) ρ(dᵀ M d); 0 without a match.
    """

    moved: Float[Array, "3 N"]
    residual: Float[Array, "3 N"]
    information: Float[Array, "6 N"]
    square: Float[Array, "N"]
    weight: Float[Array, "N"]
    cost: Float[Array, "N"]


def match_residual(
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    source: Surface,
    target: Surface,
    indices: Int[Array, "N"],
) -> tuple[Float[Array, "3 N"], Float[Array, "3 N"]]:
    """T a and d = b − T a for every source row."""
    moved = jnp.dot(rotation, source.points, precision="highest") + translation[:, None]
    return moved, target.points[:, indices] - moved


def evaluate_pairs(
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    source: Surface,
    target: Surface,
    matches: Correspondences,
    method: AbstractMethod,
    robust: AbstractKernel | None,
) -> Pairs:
    """Residual, weight matrix and cost of every pair at a pose, with M at that pose."""
    moved, residual = match_residual(rotation, translation, source, target, matches.indices)
    # A row without a match may point anywhere: zero it before it is squared, so that its gradient is zero and not NaN.
    residual = jnp.where(matches.valid, residual, 0)
    information = method.information(target.covariance[:, matches.indices], source.covariance, rotation)
    square = jnp.sum(residual * cov.multiply(information, residual), axis=0)
    weight, cost = (jnp.ones_like(square), square) if robust is None else (robust.weight(square), robust.rho(square))
    return Pairs(
        moved=moved,
        residual=residual,
        information=information,
        square=square,
        weight=jnp.where(matches.valid, weight, 0),
        cost=jnp.where(matches.valid, cost, 0),
    )


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


def moments(pairs: Pairs, matches: Correspondences) -> Moments:
    mask = matches.valid.astype(pairs.moved.dtype)
    count = jnp.maximum(jnp.sum(mask), 1)
    center = jnp.sum(mask * pairs.moved, axis=1) / count
    p = mask * (pairs.moved - center[:, None])
    radius = jnp.sqrt(jnp.sum(p * p) / count)
    weighted = pairs.weight * pairs.information
    force = cov.multiply(weighted, pairs.residual)
    x, y, z = p
    h = jnp.stack([x, y, z, jnp.ones_like(x)])
    hh = jnp.stack([x * x, x * y, x * z, x, y * y, y * z, y, z * z, z, jnp.ones_like(x)])
    return Moments(
        center=center,
        radius=radius,
        e=jnp.sum(pairs.residual * force),
        G=jnp.dot(force, h.T, precision="highest"),
        Q=jnp.dot(weighted, hh.T, precision="highest"),
    )


def mahalanobis_cost(
    pose: Pose,
    source: PointCloud,
    target: PointCloud,
    matches: Correspondences,
    method: AbstractMethod,
    *,
    robust: AbstractKernel | None = None,
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

    Returns:
        The cost; metres² for the methods with M = I, otherwise in units of GICP's relative covariances.

    Raises:
        ValueError: if the matches do not belong to the source, or a cloud lacks the neighbours that the method needs.
    """
    if matches.indices.shape != source.points.shape[:1]:
        raise ValueError(
            f"matches: expected one per source row ({source.points.shape[0]}), got shape {matches.indices.shape}"
        )
    method = method.resolve(source, target)
    dtype = source.points.dtype
    matrix = centred_pose(pose_matrix(pose, "pose"), source, target)
    rotation, translation = jnp.asarray(matrix[:3, :3], dtype), jnp.asarray(matrix[:3, 3], dtype)
    return _total_cost(rotation, translation, prepare(method, source), prepare(method, target), matches, method, robust)


@jax.jit
def _total_cost(
    rotation: Float[Array, "3 3"],
    translation: Float[Array, "3"],
    source: Surface,
    target: Surface,
    matches: Correspondences,
    method: AbstractMethod,
    robust: AbstractKernel | None,
) -> Float[Array, ""]:
    return jnp.sum(evaluate_pairs(rotation, translation, source, target, matches, method, robust).cost)


def centred_pose(matrix: Array | np.ndarray, source: PointCloud, target: PointCloud) -> Array | np.ndarray:
    """The same motion between the clouds' own origins: T(−o_t) · T · T(o_s), in the precision that it comes in."""
    rotation, translation = matrix[:3, :3], matrix[:3, 3]
    shifted = rotation @ source.origin + translation - target.origin
    if isinstance(shifted, np.ndarray) and isinstance(matrix, np.ndarray):
        result = matrix.copy()
        result[:3, 3] = shifted
        return result
    return jnp.asarray(matrix).at[:3, 3].set(shifted)
