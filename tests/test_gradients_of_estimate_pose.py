"""Gradients of `estimate_pose` inside `jit` against differences; `test_gradients_outside_jit.py` has those outside."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from tests.differences import (
    CASES,
    CONVERGED,
    GATE,
    TO_ROUNDING,
    case,
    check_gradient,
    clouds_with,
    inputs_of,
    weigh,
)
from tests.precision import in_float64
from tests.scenes import motion

pytestmark = in_float64


def answer(source, target, matches, **options):
    """A scalar of the pose of some inputs."""

    def loss(inputs):
        given = {"robust": inputs["robust"], "init": motion()} | TO_ROUNDING | options
        given |= {name: inputs[name] for name in ("temperature",) if name in inputs}
        clouds = clouds_with(inputs, source, target)
        return weigh(mcg.estimate_pose(*clouds, matches, inputs["method"], **given).matrix)

    return loss


@pytest.mark.parametrize(
    "name", [name if name == "gicp" else pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
def test_estimate_pose_has_the_gradient_of_its_answer(name, noisy):
    source, target, _ = noisy
    method, robust = case(name)
    matches = mcg.find_correspondences(source, target, motion(), method, max_distance=GATE)
    check_gradient(answer(source, target, matches), inputs_of(source, target, method, robust))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mc-gicp", "color-icp"])
def test_estimate_pose_has_the_gradient_where_channels_are_missing(name, noisy):
    method, robust = case(name)
    source, target = (
        cloud.replace(channel_valid=np.random.default_rng(i).random(cloud.channels.shape) < 0.7)
        for i, cloud in enumerate(noisy[:2])
    )
    method = method.resolve(source, target)
    matches = mcg.find_correspondences(source, target, motion(), method, max_distance=GATE, num_candidates=2)
    inputs = inputs_of(source, target, method, robust)
    compiled = check_gradient(answer(source, target, matches, temperature=0.1), inputs)
    # What stands where nothing is, NaN for one, is not seen.
    for side, cloud in (("source", source), ("target", target)):
        inputs[f"{side} channels"] = jnp.where(cloud.channel_valid, cloud.channels, jnp.nan)
    gradient = compiled(inputs)
    for side, cloud in (("source", source), ("target", target)):
        assert np.isfinite(gradient[f"{side} channels"]).all()
        np.testing.assert_array_equal(gradient[f"{side} channels"][~np.asarray(cloud.channel_valid)], 0)


@pytest.mark.slow
def test_estimate_pose_has_the_gradient_of_given_covariances(noisy):
    method, robust = case("gicp")
    factors = np.random.default_rng(0).normal(size=(2, 400, 3, 3))
    source, target = (
        cloud.replace(covariances=factor @ factor.swapaxes(1, 2) / 3 + 0.1 * np.eye(3))
        for cloud, factor in zip(noisy[:2], factors, strict=True)
    )
    matches = mcg.find_correspondences(source, target, motion(), method, max_distance=GATE)
    check_gradient(answer(source, target, matches), inputs_of(source, target, method, robust))


@pytest.mark.slow
def test_soft_matches_give_every_number_a_gradient(noisy):
    source, target, _ = noisy
    method = mcg.MultiChannelGICP([[0.05, 0.01], [0.01, 0.08]], [0.3, 0.2], epsilon=1e-2)
    matches = mcg.find_correspondences(source, target, motion(), method, max_distance=GATE, num_candidates=4)
    assert matches.indices.shape == (4, source.points.shape[0])
    inputs = inputs_of(source, target, method, mcg.Cauchy(0.5)) | {"temperature": jnp.asarray(0.1)}
    gradient = check_gradient(answer(source, target, matches), inputs)(inputs)
    assert np.abs(gradient["method"].channel_weights).min() > 1e-4


@pytest.mark.slow
def test_jacobians_agree_forward_and_backward(noisy):
    source, target, _ = noisy
    method, _ = case("point-to-point")
    matches = mcg.find_correspondences(source, target, motion(), method, max_distance=GATE)

    def pose(scale):
        moved = source.replace(points=source.points * scale)
        return mcg.estimate_pose(moved, target, matches, method, init=motion(), **CONVERGED).matrix

    forward, backward = (jax.jit(jacobian(pose))(jnp.ones(3)) for jacobian in (jax.jacfwd, jax.jacrev))
    assert np.abs(forward).max() > 1e-3
    np.testing.assert_allclose(forward, backward, rtol=1e-9, atol=1e-12)
