"""Pose errors: against SciPy, near the singularities, and under every transformation."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mcgicp_jax.metrics import pose_error

EASY_ANGLES = [1e-9, 1e-5, 0.3, 1.7, 3.0, np.pi - 1e-5, np.pi - 1e-9]


def pose(rotation_vector, translation=(0.0, 0.0, 0.0)):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    matrix[:3, 3] = translation
    return matrix


def random_pose(rng):
    return pose(rng.normal(size=3), rng.normal(scale=5, size=3))


@pytest.mark.parametrize("angle", EASY_ANGLES)
def test_a_known_motion_is_measured_to_rounding(angle):
    rng = np.random.default_rng(0)
    for _ in range(20):
        truth = random_pose(rng)
        axis, offset = rng.normal(size=3), rng.normal(size=3)
        left_over = pose(angle * axis / np.linalg.norm(axis), offset)
        translation, rotation = pose_error(truth @ left_over, truth)
        assert isinstance(translation, float) and isinstance(rotation, float)
        assert translation == pytest.approx(np.linalg.norm(offset), abs=1e-14)
        assert rotation == pytest.approx(angle, abs=1e-14)


def test_agrees_with_scipy():
    rng = np.random.default_rng(1)
    for _ in range(50):
        T, truth = random_pose(rng), random_pose(rng)
        left_over = np.linalg.inv(truth) @ T
        expected = Rotation.from_matrix(left_over[:3, :3]).magnitude()
        assert pose_error(T, truth) == pytest.approx((np.linalg.norm(left_over[:3, 3]), expected), abs=1e-12)


def test_the_same_pose_has_no_error():
    T = random_pose(np.random.default_rng(2))
    assert pose_error(T, T) == pytest.approx((0, 0), abs=1e-15)
    assert pose_error(np.eye(4), np.eye(4)) == (0, 0)
    rounded = np.round(T, 4)
    assert pose_error(rounded, rounded) == pytest.approx((0, 0), abs=1e-15)


@pytest.mark.parametrize("make", [jnp.asarray, lambda T: jaxlie.SE3.from_matrix(jnp.asarray(T))])
def test_takes_every_form_of_pose(make):
    rng = np.random.default_rng(3)
    T, truth = random_pose(rng), random_pose(rng)
    expected = pose_error(T, truth)
    for got in (pose_error(make(T), truth), pose_error(T, make(truth)), pose_error(make(T), make(truth))):
        assert all(isinstance(value, float) for value in got)
        assert got == pytest.approx(expected, abs=1e-5)


def test_jit_and_vmap_agree_with_the_concrete_answer():
    rng = np.random.default_rng(4)
    poses = np.stack([random_pose(rng) for _ in range(6)])
    truths = np.stack([random_pose(rng) for _ in range(6)])
    expected = np.array([pose_error(T, truth) for T, truth in zip(poses, truths, strict=True)]).T
    T, T_true = jnp.asarray(poses), jnp.asarray(truths)
    np.testing.assert_allclose(jax.vmap(pose_error)(T, T_true), expected, atol=2e-5)
    np.testing.assert_allclose(jax.jit(pose_error)(T[0], truths[0]), expected[:, 0], atol=2e-5)
    as_se3 = jax.vmap(jaxlie.SE3.from_matrix)(T)
    np.testing.assert_allclose(jax.jit(jax.vmap(pose_error))(as_se3, T_true), expected, atol=2e-5)


def test_a_traced_pose_keeps_its_precision():
    with jax.enable_x64():
        truth = random_pose(np.random.default_rng(5))
        T = truth @ pose([0, 1e-9, 0], [1e-9, 0, 0])
        translation, rotation = jax.jit(pose_error)(jnp.asarray(T), truth)
        assert float(translation) == pytest.approx(1e-9, abs=1e-14)
        assert float(rotation) == pytest.approx(1e-9, abs=1e-14)
        single = jax.jit(lambda T: pose_error(T, truth))(jnp.asarray(T, jnp.float32))
        assert all(value.dtype == jnp.float32 for value in single)


def along(direction, distance, truth):
    """The error of a pose that is `distance` along a twist away from `truth`: (2,), metres and radians."""
    moved = jaxlie.SE3.from_matrix(truth) @ jaxlie.SE3.exp(distance * direction)
    return jnp.stack(pose_error(moved, truth))


def test_the_gradient_is_zero_at_zero_error():
    truth = jnp.asarray(random_pose(np.random.default_rng(6)))
    for T in (truth, jnp.eye(4)):
        gradients = jax.jacrev(lambda M, T=T: jnp.stack(pose_error(M, T)))(T)
        assert np.isfinite(gradients).all()
    np.testing.assert_array_equal(jax.jacrev(lambda M: jnp.stack(pose_error(M, jnp.eye(4))))(jnp.eye(4)), 0)


@pytest.mark.parametrize("distance", [1e-7, 1e-3, 0.5, 2.0])
def test_the_gradient_along_a_turn_or_a_shift_is_one(distance):
    with jax.enable_x64():
        truth = jnp.asarray(random_pose(np.random.default_rng(7)))
        shift, turn = jnp.array([0.6, 0.0, 0.8, 0, 0, 0]), jnp.array([0, 0, 0, 0.0, 0.6, -0.8])
        for i, direction in enumerate((shift, turn)):
            gradient = jax.jacfwd(along, argnums=1)(direction, distance, truth)
            assert float(gradient[i]) == pytest.approx(1, abs=1e-7)
            backward = jax.jacrev(along, argnums=1)(direction, distance, truth)
            np.testing.assert_allclose(backward, gradient, atol=1e-9)


def test_vmap_of_grad_is_finite_where_some_lanes_have_no_error():
    truth = jnp.eye(4)
    poses = jnp.stack([truth, truth.at[0, 3].set(0.5)])
    gradients = jax.jit(jax.vmap(jax.grad(lambda T: sum(pose_error(T, truth)))))(poses)
    assert np.isfinite(gradients).all()
    np.testing.assert_allclose(gradients[1, 0, 3], 1, atol=1e-6)


def test_malformed_poses_are_refused_by_name():
    with pytest.raises(ValueError, match=r"T_true: .*rigid"):
        pose_error(np.eye(4), 2 * np.eye(4))
    with pytest.raises(ValueError, match=r"^T: .*shape"):
        jax.jit(pose_error)(jnp.eye(3), jnp.eye(4))
