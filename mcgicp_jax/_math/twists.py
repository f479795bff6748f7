"""Rigid motions and their twists ξ = (v, ω) on the host: exponential, logarithm and its derivative; float64 NumPy.

jaxlie computes in JAX's default precision and compiles for every shape; these functions do neither, and may be called
inside callbacks. Rotation angles of logarithms are at most π, where the series below have converged.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mcgicp_jax._math.poses import quaternion_from_rotation, skew

# ζ(2k) for k = 1 to 28: the generating function of the Bernoulli numbers, which inverts the derivative of exp, is a
# series in (θ/2π)² with these coefficients. At θ = π the remainder is below 4e-16.
_POWERS = np.arange(1, 29)
_ZETA = np.array([np.pi**2 / 6, np.pi**4 / 90, *(np.sum(np.arange(1.0, 999) ** (-2.0 * k)) for k in _POWERS[2:])])


def exponential(twists: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 4 4"]:
    """exp(ξ), as matrices."""
    omega = skew(twists[..., 3:])
    square = omega @ omega
    angle = np.linalg.norm(twists[..., 3:], axis=-1)[..., None, None]
    sine, half = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    # (θ − sin θ)/θ³; its rounding, ε/θ², is multiplied by θ².
    third = np.where(angle > 0, (1 - sine) / np.where(angle > 0, angle, 1) ** 2, 0)
    matrices = np.zeros((*twists.shape[:-1], 4, 4))
    matrices[..., :3, :3] = np.eye(3) + sine * omega + half * square
    matrices[..., :3, 3] = ((np.eye(3) + half * omega + third * square) @ twists[..., :3, None])[..., 0]
    matrices[..., 3, 3] = 1
    return matrices


def logarithm(matrices: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 6"]:
    """ξ with exp(ξ) = T and a rotation angle of at most π."""
    turn = _rotation_vectors(matrices[..., :3, :3])
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
    ad = np.concatenate(
        [np.concatenate([first, second], axis=-1), np.concatenate([np.zeros_like(first), first], axis=-1)], axis=-2
    )
    square = ad @ ad
    ratio = np.sum(twists[..., 3:] ** 2, axis=-1)[..., None, None] / (2 * np.pi) ** 2
    polynomial = np.polynomial.polynomial.polyval
    of_square = -2 * polynomial(ratio, (_POWERS - 2) * _ZETA) / (2 * np.pi) ** 2
    of_fourth = -2 * polynomial(ratio, ((_POWERS - 1) * _ZETA)[1:]) / (2 * np.pi) ** 4
    return np.eye(6) + 0.5 * ad + of_square * square + of_fourth * (square @ square)


def _rotation_vectors(rotations: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Axis times angle, of angles up to π."""
    quaternions = quaternion_from_rotation(rotations)
    sine = np.linalg.norm(quaternions[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quaternions[..., :1])
    small = sine < 1e-150
    return np.where(small, 2, angle / np.where(small, 1, sine)) * quaternions[..., 1:]
