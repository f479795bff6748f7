"""Exponential, logarithm and adjoints of rigid motions against SciPy and finite differences, also near 0 and π."""

import jax.numpy as jnp
import numpy as np
import pytest

from mcgicp_jax._math.poses import adjoint, exponential, inverse, logarithm, logarithm_derivative, translation_adjoint
from tests import reference


def twists(angle):
    found = np.random.default_rng(0).normal(size=(20, 6))
    found[:, 3:] *= angle / np.linalg.norm(found[:, 3:], axis=1, keepdims=True)
    return found


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-5, 1e-3, 0.1, 1.0, 2.5, 3.1, np.pi - 1e-9])
def test_exponential_and_logarithm(angle):
    given, h = twists(angle), 1e-3
    matrices = exponential(given)
    np.testing.assert_allclose(matrices, [reference.exponential(each) for each in given], atol=1e-14)
    np.testing.assert_allclose(logarithm(matrices), given, atol=1e-13)
    np.testing.assert_allclose(inverse(matrices) @ matrices, np.broadcast_to(np.eye(4), matrices.shape), atol=1e-14)
    if angle < 3.14:
        near = [logarithm(matrices[:, None] @ exponential(k * h * np.eye(6))) for k in (1, -1, 2, -2)]
        expected = (8 * (near[0] - near[1]) - (near[2] - near[3])) / (12 * h)
        np.testing.assert_allclose(logarithm_derivative(given), expected.swapaxes(1, 2), atol=1e-9)


def test_adjoint_moves_twists():
    matrices, given = exponential(twists(1.0)), twists(0.3)
    moved = [reference.exponential(each) for each in (adjoint(matrices) @ given[..., None])[..., 0]]
    np.testing.assert_allclose(moved, matrices @ exponential(given) @ inverse(matrices), atol=1e-13)
    for function in (adjoint, inverse):
        np.testing.assert_allclose(function(jnp.asarray(matrices)), function(matrices), atol=1e-5)
    shift = np.eye(4)
    shift[:3, 3] = (1, 2, 3)
    np.testing.assert_allclose(translation_adjoint(shift[:3, 3]), adjoint(shift), atol=1e-15)
