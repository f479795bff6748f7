"""Closed-form algebra of packed symmetric matrices, against NumPy: 512 matrices at a time, of every kind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcgicp_jax.extend import symmetric_matrices as cov
from tests import reference as ref
from tests.precision import in_both_precisions, tolerance

pytestmark = in_both_precisions
SEEDS = st.integers(0, 2**31)
SCALES = st.floats(-6, 6).map(lambda power: 10.0**power)
KINDS = ("random", "flat", "line", "near line", "isotropic", "near isotropic", "zero")
EXAMPLES = settings(max_examples=8, deadline=None)


def dtype():
    return jnp.zeros(()).dtype


def random_symmetric(seed, size, eigenvalues):
    """Matrices with the given (N, size) eigenvalues, rounded to the precision of the run."""
    orthogonal = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(eigenvalues), size, size)))[0]
    packed = jnp.asarray(ref.packed(orthogonal * eigenvalues[:, None, :] @ orthogonal.swapaxes(1, 2)), dtype())
    return packed, ref.symmetric(packed)


def eigenvalues_of(kind, seed):
    a, b, c = np.random.default_rng(seed).uniform(0.1, 1, (3, 512))
    zero = np.zeros(512)
    values = {
        "random": (a, b, c),
        "flat": (a, b, zero),
        "line": (a, zero, zero),
        "near line": (a, 1e-4 * b, 1e-6 * c),
        "isotropic": (a, a, a),
        "near isotropic": (a, a * (1 + 1e-5), a * (1 - 1e-5)),
        "zero": (zero, zero, zero),
    }[kind]
    return np.stack(values, axis=1)


smallest_eigenvector = jax.jit(cov.smallest_eigenvector)
eigenvector_gradient = jax.jit(jax.grad(lambda packed: jnp.sum(cov.smallest_eigenvector(packed) ** 3)))


@pytest.mark.parametrize("kind", KINDS)
@EXAMPLES
@given(seed=SEEDS, scale=SCALES)
def test_smallest_eigenvector_is_backward_stable_with_a_finite_gradient(kind, seed, scale):
    packed, matrices = random_symmetric(seed, 3, scale * eigenvalues_of(kind, seed))
    normal = np.asarray(smallest_eigenvector(packed), float).T
    eps = np.finfo(dtype()).eps
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=16 * eps)
    # Backward stable: it has the smallest eigenvalue to rounding, whatever the gap.
    trace = np.trace(matrices, axis1=1, axis2=2)
    quotient = np.einsum("ni,nij,nj->n", normal, matrices, normal)
    values, vectors = np.linalg.eigh(matrices)
    assert np.all(np.abs(quotient - values[:, 0]) <= 64 * eps * trace)
    # And where there is a gap, it is the vector.
    gap = (values[:, 1] - values[:, 0]) / np.where(trace > 0, trace, 1)
    assert np.all(np.linalg.norm(np.cross(normal, vectors[:, :, 0]), axis=1) * gap <= 64 * eps)
    assert np.isfinite(eigenvector_gradient(packed)).all()


def test_gradients_at_equal_eigenvalues_are_0_or_finite():
    identity = jnp.tile(jnp.array([[1.0], [0.0], [0.0], [1.0], [0.0], [1.0]]), (1, 512))
    np.testing.assert_array_equal(eigenvector_gradient(identity), 0)
    np.testing.assert_array_equal(eigenvector_gradient(jnp.zeros((6, 512))), 0)
    packed = jnp.array([[1.0, 0, -1, 0.5], [0, 0, 0, 0], [1.0, 0, -1, 0.5]])
    floored = jax.grad(lambda p: jnp.sum(cov.floor_eigenvalues(p, jnp.asarray(0.5)) ** 2))
    assert np.isfinite(jax.jit(floored)(packed)).all()


@EXAMPLES
@given(seed=SEEDS, scale=SCALES)
def test_orthonormal_basis(seed, scale):
    normal = np.random.default_rng(seed).normal(size=(3, 512))
    normal[:2, :100] *= min(scale, 1)
    normal[:, :6] = np.concatenate([np.eye(3), -np.eye(3)], axis=1)
    normal /= np.linalg.norm(normal, axis=0)
    u, v = jax.jit(cov.orthonormal_basis)(jnp.asarray(normal, dtype()))
    frames = np.stack([u, v, jnp.asarray(normal, dtype())], axis=-1).transpose(1, 0, 2).astype(float)
    eps = np.finfo(dtype()).eps
    np.testing.assert_allclose(frames.swapaxes(1, 2) @ frames, np.broadcast_to(np.eye(3), (512, 3, 3)), atol=16 * eps)
    np.testing.assert_allclose(np.linalg.det(frames), 1, atol=16 * eps)


def positive(seed, size):
    return np.random.default_rng(seed).uniform(0.05, 1, (512, size))


@EXAMPLES
@given(seed=SEEDS, scale=SCALES)
def test_inverse_inverse_square_root_and_sandwich(seed, scale):
    packed, matrices = random_symmetric(seed, 3, scale * positive(seed, 3))
    product = ref.symmetric(jax.jit(cov.inverse)(packed)) @ matrices
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), (512, 3, 3)), atol=tolerance(5e-4, 1e-11))
    outside, W = random_symmetric(seed, 2, scale * positive(seed, 2))
    root = ref.symmetric(jax.jit(cov.inverse_square_root)(outside))
    np.testing.assert_allclose(root @ W @ root, np.broadcast_to(np.eye(2), W.shape), atol=tolerance(1e-4, 1e-12))
    assert np.all(np.linalg.eigvalsh(root) > 0)
    inside, A = random_symmetric(seed + 1, 2, positive(seed + 1, 2))
    actual = ref.symmetric(jax.jit(cov.congruence)(outside, inside)) / scale**2
    np.testing.assert_allclose(actual, W @ A @ W / scale**2, atol=tolerance(1e-6, 1e-14))


@EXAMPLES
@given(seed=SEEDS, scale=SCALES, low=st.floats(-1, 1))
def test_floor_eigenvalues(seed, scale, low):
    values = scale * np.random.default_rng(seed).uniform(-1, 1, (512, 2))
    values[:50] = values[:50, :1]
    packed, matrices = random_symmetric(seed, 2, values)
    floor = jnp.asarray(scale * low, dtype())
    actual = jax.jit(cov.floor_eigenvalues)(packed, floor)
    values, vectors = np.linalg.eigh(matrices)
    expected = vectors * np.maximum(values, float(floor))[:, None, :] @ vectors.swapaxes(1, 2)
    eps = np.finfo(dtype()).eps
    np.testing.assert_allclose(ref.symmetric(actual), expected, atol=16 * eps * scale)
    above = values[:, 0] > float(floor) + 16 * eps * scale
    np.testing.assert_array_equal(np.asarray(actual)[:, above], np.asarray(packed)[:, above])


@EXAMPLES
@given(seed=SEEDS, scale=SCALES)
def test_solve(seed, scale):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(4, 35, 40))
    matrices = np.asarray(scale * (rows @ rows.swapaxes(1, 2) + np.eye(35)), dtype())
    sides = np.asarray(rng.normal(size=(4, 35)), dtype())
    expected = cov.solve(matrices.astype(float), sides.astype(float))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", matrices, expected), sides, atol=1e-6)
    actual = jax.jit(cov.solve)(jnp.asarray(matrices), jnp.asarray(sides))
    np.testing.assert_allclose(actual, expected, atol=tolerance(1e-3, 1e-11) * np.abs(expected).max())


@EXAMPLES
@given(seed=SEEDS)
def test_rotate_multiply_and_outer(seed):
    rng = np.random.default_rng(seed)
    packed, matrices = random_symmetric(seed, 3, positive(seed, 3))
    R, vectors = ref.rotation(rng.normal(size=3)), rng.normal(size=(512, 3))
    turn, columns = jnp.asarray(R, dtype()), jnp.asarray(vectors.T, dtype())
    rotated, moved = jax.jit(cov.rotate)(turn, packed), jax.jit(cov.multiply)(packed, columns)
    products = jax.jit(cov.outer)(columns)
    atol = tolerance(2e-6, 1e-14)
    np.testing.assert_allclose(ref.symmetric(rotated), R @ matrices @ R.T, atol=atol)
    np.testing.assert_allclose(moved.T, np.einsum("nij,nj->ni", matrices, vectors), atol=atol)
    np.testing.assert_allclose(ref.symmetric(products), vectors[:, :, None] * vectors[:, None, :], atol=2 * atol)
    np.testing.assert_allclose(cov.matrix_from_symmetric(packed), matrices, atol=0)
    np.testing.assert_allclose(cov.symmetric_from_matrix(jnp.asarray(matrices, dtype())), packed, atol=0)
