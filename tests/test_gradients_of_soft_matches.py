"""Soft matches, the default where channels are used: the pose of hard ones has the derivative of soft ones at it."""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial

import mcgicp_jax as mcg
from tests.compilations import compilations
from tests.differences import GATE, TO_ROUNDING, case, check_eager_gradient, clouds_with, inputs_of, weigh
from tests.precision import in_float64
from tests.scenes import motion, pair

pytestmark = in_float64
METHOD, _ = case("mc-gicp")


@pytest.fixture(scope="module")
def clouds(noisy):
    return noisy[:2]


def registered(clouds, method=METHOD, **options):
    settings = {"init": motion(), "max_distance": GATE} | TO_ROUNDING
    return mcg.register(*clouds, method, **settings | options)


def posed(clouds, method=METHOD, **options):
    return weigh(registered(clouds, method, **options).matrix)


def spacing_of(cloud):
    return np.median(scipy.spatial.cKDTree(cloud.points).query(cloud.points, 2)[0][:, 1])


@pytest.mark.parametrize("name", [pytest.param("mc-gicp", marks=pytest.mark.slow), "color-icp"])
def test_the_derivative_is_that_of_one_soft_root(name, clouds):
    """Differences of `estimate_pose` over the eight candidates at the pose of the hard matches, which is returned."""
    method, robust = case(name)
    hard = registered(clouds, method, robust=robust, soft_matches=False).matrix
    np.testing.assert_array_equal(registered(clouds, method, robust=robust).matrix, hard)
    candidates = mcg.find_correspondences(*clouds, hard, method, max_distance=GATE, num_candidates=8)
    # Updates of soft matches converge linearly.
    soft = {"init": hard, "temperature": spacing_of(clouds[1])} | TO_ROUNDING | {"max_iterations": 300}
    root = mcg.estimate_pose(*clouds, candidates, method, robust=robust, **soft).matrix
    assert np.linalg.norm(root - hard) > 1e-3

    def at_root(inputs):
        """A motion of the root moves the pose alike."""
        given = clouds_with(inputs, *clouds), inputs["method"], inputs["robust"]
        moved = mcg.estimate_pose(*given[0], candidates, given[1], robust=given[2], **soft).matrix
        return weigh(moved @ np.linalg.inv(root) @ hard)

    def loss(inputs):
        return posed(clouds_with(inputs, *clouds), inputs["method"], robust=inputs["robust"], init=hard)

    inputs = inputs_of(*clouds, method, robust)
    gradient = check_eager_gradient(loss, inputs, differences_of=at_root)
    assert abs(gradient["method"].channel_weights) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mc-gicp", "color-icp"])
def test_inside_jit_and_vmap_the_derivative_is_the_same(name, clouds):
    method, _ = case(name)
    channels = jnp.stack([clouds[0].channels, 1.1 * clouds[0].channels])

    def loss(channels, method, search=None):
        return posed((clouds[0].replace(channels=channels), clouds[1]), method, search=search)

    expected = [jax.grad(loss, (0, 1))(each, method) for each in channels]
    one = jax.jit(jax.grad(loss, (0, 1)))(channels[0], method)
    dense = jax.grad(partial(loss, search=mcg.DenseSearch()), (0, 1))
    several = jax.jit(jax.vmap(dense, in_axes=(0, None)))(channels, method)
    for i, each in enumerate(expected):
        for found in [jax.tree.map(lambda leaf, i=i: leaf[i], several)] + [one] * (i == 0):
            for actual, wanted in zip(*map(jax.tree.leaves, (found, each)), strict=True):
                np.testing.assert_allclose(actual, wanted, atol=1e-8 * np.abs(wanted).max())


def test_a_batch_has_the_gradients_of_its_pairs():
    """Of different sizes, and with fewer points of the source than it has."""
    sources, targets, _ = zip(*(pair(size=size) for size in (300, 400)), strict=True)
    options = {"max_distance": GATE, "max_source_points": 250}

    def loss(channels):
        moved = [source.replace(channels=each) for source, each in zip(sources, channels, strict=True)]
        return sum(weigh(each.matrix) for each in mcg.register_batch(moved, list(targets), METHOD, **options))

    gradients = jax.grad(loss)([source.channels for source in sources])
    for source, target, gradient in zip(sources, targets, gradients, strict=True):

        def alone(each, source=source, target=target):
            return weigh(mcg.register(source.replace(channels=each), target, METHOD, **options).matrix)

        expected = jax.grad(alone)(source.channels)
        assert np.any(expected)
        np.testing.assert_array_equal(gradient, expected)


def test_another_size_compiles_nothing():
    """But for a copy of the argument, which `jax.grad` itself makes."""

    def gradient(size):
        source, target, _ = pair(size=size)
        options = {"init": None, "max_iterations": 3}
        return jax.grad(lambda each: posed((source.replace(channels=each), target), **options))(source.channels)

    gradient(300)
    with compilations() as compiled:
        gradient(310)
    assert len(compiled) <= 1


def test_hard_matches_are_warned_of_where_channels_are_differentiated(clouds):
    """Not where they are soft, nor in gradients by points; parameters that are estimated are, in either case."""

    def loss(inputs, method=METHOD, **options):
        return posed(clouds_with(inputs, *clouds), method, max_iterations=1, **options)

    channels, points = {"source channels": clouds[0].channels}, {"source points": clouds[0].points}
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        jax.vjp(loss, channels)
        jax.vjp(partial(loss, soft_matches=False), points)
    for method in (METHOD, mcg.ColorICP(0.3)):
        with pytest.warns(UserWarning, match=r"^channels: .* soft_matches=False") as caught:
            jax.vjp(partial(loss, method=method, soft_matches=False), channels)
        assert len(caught) == 1
    with pytest.warns(UserWarning, match=r"^channel_weights: estimated"):
        jax.vjp(partial(loss, method=mcg.MultiChannelGICP(0.05)), channels)
