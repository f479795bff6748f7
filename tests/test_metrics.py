"""Pose errors: against SciPy, near the singularities, and under every transformation."""

import itertools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mcgicp_jax.metrics import ate, kitti_errors, pose_error, rpe
from tests.reference import pose
from tests.refusals import refused


def random_pose(rng):
    return pose(rng.normal(size=3), rng.normal(scale=5, size=3))


@pytest.mark.parametrize("angle", [1e-9, 1e-5, 0.3, 1.7, 3.0, np.pi - 1e-5, np.pi - 1e-9])
def test_a_known_motion_is_measured_to_rounding(angle):
    rng = np.random.default_rng(0)
    for _ in range(20):
        truth, axis, offset = random_pose(rng), rng.normal(size=3), rng.normal(size=3)
        error = pose_error(truth @ pose(angle * axis / np.linalg.norm(axis), offset), truth)
        assert all(isinstance(value, float) for value in error)
        assert error == pytest.approx((np.linalg.norm(offset), angle), abs=1e-14)


def test_the_same_pose_has_no_error():
    T = random_pose(np.random.default_rng(2))
    for same in (T, np.round(T, 4)):
        assert pose_error(same, same) == pytest.approx((0, 0), abs=1e-15)
    assert pose_error(np.eye(4), np.eye(4)) == (0, 0)


def test_a_nan_pose_has_nan_errors():
    nowhere = np.eye(4)
    nowhere[:3] = np.nan
    for lost in (nowhere, jaxlie.SE3(jnp.full(7, jnp.nan))):
        for error in (pose_error, jax.jit(pose_error)):
            assert np.isnan(error(lost, np.eye(4))).all()


def test_wrong_arguments_are_refused_by_name():
    here, partly = [np.eye(4)], np.eye(4)
    partly[0, 0] = np.nan
    for named, shown, call in (
        ("T_true", "", lambda: pose_error(np.eye(4), partly)),
        ("T_true", "", lambda: pose_error(np.eye(4), 2 * np.eye(4))),
        ("T", "", lambda: pose_error(partly, np.eye(4))),
        ("T", (3, 3), lambda: jax.jit(pose_error)(jnp.eye(3), jnp.eye(4))),
        *(("at", "", lambda at=at: pose_error(*here, *here, at=at)) for at in (0.0, np.zeros(2), np.zeros((1, 3)))),
        ("poses", "4 and 5", lambda: ate(here * 4, here * 5)),
        ("poses", "", lambda: ate([], [])),
        ("poses[0]", "", lambda: ate([2 * np.eye(4)], here)),
        ("delta", 2, lambda: rpe(here * 2, here * 2, 2)),
        ("lengths", 0.0, lambda: kitti_errors(here * 2, here * 2)),
        ("lengths", 0.0, lambda: kitti_errors(here * 2, here * 2, lengths=[0.0])),
        ("step", 0, lambda: kitti_errors(here * 2, here * 2, step=0)),
        ("alignment", "best", lambda: ate(here, here, alignment="best")),
    ):
        refused(call, named, shown)


def test_the_error_is_that_of_the_point_asked_for():
    rng, inside = np.random.default_rng(8), jax.jit(lambda *args: pose_error(*args[:2], at=args[2]))
    for _ in range(20):
        T, truth, point = random_pose(rng), random_pose(rng), rng.normal(scale=5, size=3)
        shift = (T - truth)[:3] @ [*point, 1]
        expected = np.linalg.norm(shift), pose_error(T, truth)[1]
        assert pose_error(T, truth, at=point) == pytest.approx(expected, rel=1e-12)
        assert pose_error(T, truth, at=point)[1] == expected[1]
        assert pose_error(T, truth, at=np.zeros(3)) == pose_error(T, truth)
        np.testing.assert_allclose(inside(jnp.asarray(T), truth, point), expected, rtol=1e-5)


def test_jit_and_vmap_agree_with_the_concrete_answer():
    rng = np.random.default_rng(4)
    poses, truths = (np.stack([random_pose(rng) for _ in range(6)]) for _ in range(2))
    expected = np.array([pose_error(T, truth) for T, truth in zip(poses, truths, strict=True)]).T
    T, T_true = jnp.asarray(poses), jnp.asarray(truths)
    for concrete in (pose_error(T[0], truths[0]), pose_error(jaxlie.SE3.from_matrix(T[0]), T_true[0])):
        assert all(isinstance(value, float) for value in concrete)
        assert concrete == pytest.approx(expected[:, 0], abs=2e-5)
    np.testing.assert_allclose(jax.jit(pose_error)(T[0], truths[0]), expected[:, 0], atol=2e-5)
    for form in (T, jax.jit(jax.vmap(jaxlie.SE3.from_matrix))(T)):
        np.testing.assert_allclose(jax.jit(jax.vmap(pose_error))(form, T_true), expected, atol=2e-5)


def test_a_traced_pose_keeps_its_precision():
    with jax.enable_x64():
        truth = random_pose(np.random.default_rng(5))
        T = truth @ pose([0, 1e-9, 0], [1e-9, 0, 0])
        np.testing.assert_allclose(jax.jit(pose_error)(jnp.asarray(T), truth), 1e-9, rtol=0, atol=1e-14)
        single = jax.eval_shape(lambda T: pose_error(T, truth), jnp.asarray(T, jnp.float32))
        assert all(value.dtype == jnp.float32 for value in single)


def test_the_gradient_is_finite_at_zero_error():
    truth = jnp.asarray(random_pose(np.random.default_rng(6)))
    gradient = jax.jit(jax.vmap(jax.jacrev(lambda pose, truth: jnp.stack(pose_error(pose, truth)))))
    still, shifted = jnp.eye(4), jnp.eye(4).at[0, 3].set(0.5)
    at_truth, at_zero, at_shift = gradient(jnp.stack([truth, still, shifted]), jnp.stack([truth, still, still]))
    assert np.isfinite(at_truth).all() and np.isfinite(at_shift).all()
    np.testing.assert_array_equal(at_zero, 0)
    np.testing.assert_allclose(at_shift[0, 0, 3], 1, atol=1e-6)


def test_the_gradient_along_a_turn_or_a_shift_is_one():
    def error(distance, direction):
        """The error of a pose that is `distance` along a twist away from the truth: (2,), metres and radians."""
        moved = jaxlie.SE3.from_matrix(truth) @ jaxlie.SE3.exp(distance * direction)
        return jnp.stack(pose_error(moved, truth))

    with jax.enable_x64():
        truth = jnp.asarray(random_pose(np.random.default_rng(7)))
        shift, turn = jnp.array([0.6, 0.0, 0.8, 0, 0, 0]), jnp.array([0, 0, 0, 0.0, 0.6, -0.8])
        forward, backward = (jax.jit(jacobian(error)) for jacobian in (jax.jacfwd, jax.jacrev))
        for distance, (i, direction) in itertools.product((1e-7, 1e-3, 0.5, 2.0), enumerate((shift, turn))):
            gradient = forward(distance, direction)
            assert float(gradient[i]) == pytest.approx(1, abs=1e-7)
            np.testing.assert_allclose(backward(distance, direction), gradient, atol=1e-9)


# Trajectories


def walk(rng, size, step=1.0):
    """Poses one after another, each a step ahead of the one before and turned a little."""
    steps = (pose(0.1 * rng.normal(size=3), [step, 0, 0]) for _ in range(size - 1))
    return np.array(list(itertools.accumulate(steps, np.matmul, initial=np.eye(4))))


def disturbed(rng, poses, scale=0.05):
    return np.array([matrix @ pose(0.01 * rng.normal(size=3), scale * rng.normal(size=3)) for matrix in poses])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 30))
def test_the_trajectory_error_does_not_know_the_world(seed, size):
    rng = np.random.default_rng(seed)
    truth = walk(rng, size)
    moved = random_pose(rng) @ truth
    assert ate(moved, truth) == pytest.approx(0, abs=1e-9)
    assert ate(moved, truth, alignment="first") == pytest.approx(0, abs=1e-9)
    noisy = disturbed(rng, truth)
    assert ate(random_pose(rng) @ noisy, truth) == pytest.approx(ate(noisy, truth), abs=1e-9)
    assert ate(noisy, truth) <= ate(noisy, truth, alignment="first") + 1e-9


def test_the_alignment_is_the_best_there_is():
    rng = np.random.default_rng(0)
    truth = walk(rng, 20)
    noisy = disturbed(rng, truth, scale=0.3)
    # SciPy's residual is the root of the sum of squares.
    _, residual = Rotation.align_vectors(*(poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0) for poses in (truth, noisy)))
    assert ate(noisy, truth) == pytest.approx(residual / np.sqrt(20), abs=1e-9)
    # Mirrored, no rotation fits: a reflection would.
    mirrored = noisy.copy()
    mirrored[:, 2, 3] *= -1
    assert ate(mirrored, noisy) > 0.1


def test_aligned_by_the_first_pose_a_turn_there_counts_in_full():
    truth = np.array([pose([0, 0, 0], [i, 0, 0]) for i in range(11)])
    bent = truth.copy()
    bent[0] = truth[0] @ pose([0, 0, 0.1])
    expected = np.sqrt(np.mean([(2 * np.sin(0.05) * i) ** 2 for i in range(11)]))
    assert ate(bent, truth, alignment="first") == pytest.approx(expected)
    assert ate(bent, truth) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("delta", [1, 3])
def test_relative_errors_are_pose_errors_of_the_motions(delta):
    rng = np.random.default_rng(1)
    truth = walk(rng, 8)
    noisy = disturbed(rng, truth)
    motions = ([np.linalg.inv(poses[i]) @ poses[i + delta] for i in range(8 - delta)] for poses in (noisy, truth))
    expected = [pose_error(*both) for both in zip(*motions, strict=True)]
    np.testing.assert_allclose(rpe(random_pose(rng) @ noisy, truth, delta), np.transpose(expected), rtol=0, atol=1e-9)


@pytest.mark.parametrize("step", [10, 7])
def test_kitti_errors_by_their_definition(step):
    rng = np.random.default_rng(2)
    truth = walk(rng, 120, step=0.7)
    noisy = disturbed(rng, truth)
    along = np.cumsum([0, *np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)])
    errors = []
    for first, length in itertools.product(range(0, 120, step), (5, 20, 60)):
        last = next((i for i in range(first, 120) if along[i] > along[first] + length), None)
        if last is not None:
            motions = [np.linalg.inv(poses[first]) @ poses[last] for poses in (noisy, truth)]
            errors.append(np.array(pose_error(*motions)) * [100, np.rad2deg(1)] / length)
    measured = kitti_errors(noisy, truth, lengths=(5.0, 20.0, 60.0), step=step)
    assert measured == pytest.approx(np.mean(errors, axis=0), rel=1e-9)


def test_kitti_errors_of_a_wrong_scale():
    """2 % of the length; the first frame further than 100 m is 101 m away."""
    straight = np.array([pose([0, 0, 0], [i, 0, 0]) for i in range(1000)])
    stretched = straight.copy()
    stretched[:, :3, 3] *= 1.02
    assert kitti_errors(stretched, straight) == pytest.approx((2.0, 0), rel=0.01)
    assert kitti_errors(stretched, straight, lengths=(100.0,)) == pytest.approx((2.02, 0), abs=1e-9)
