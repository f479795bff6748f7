"""`preprocess` of traced clouds: neighbours as those of trees, voxel means, what does not fit, derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import PointCloud, Status
from mcgicp_jax._clouds.preprocess_inside_jit import _voxels_of
from mcgicp_jax._clouds.voxels import VARIATION
from tests.precision import in_float64
from tests.refusals import refused
from tests.scenes import motion, room_corner

SIZE = 700
# Metres.
VOXEL = 0.3


def surface(count=1500, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2, 2, (count, 3))
    points[:, 2] = 0.1 * np.sin(3 * points[:, 0])
    return points.astype(np.float32), rng.normal(size=(count, 2)).astype(np.float32)


def lattice():
    """Nearly all distances are equal to others."""
    points = np.stack(np.meshgrid(*[np.arange(9)] * 3), axis=-1).reshape(-1, 3)
    return np.random.default_rng(0).permutation(points).astype(np.float32)


@pytest.mark.filterwarnings("ignore:points", "ignore:voxel_size")
@pytest.mark.parametrize("search", [None, mcg.DenseSearch()], ids=["trees", "brute force"])
@pytest.mark.parametrize("points", [surface()[0], lattice(), surface(300)[0], surface(15)[0]], ids=len)
def test_neighbours_are_those_of_the_host(points, search):
    inside = jax.jit(partial(mcg.preprocess, voxel_size=None, search=search))(points)
    np.testing.assert_array_equal(inside.neighbors, mcg.preprocess(points, None).neighbors)


def test_rows_that_are_not_finite_become_padding():
    points, channels = surface(600)
    points[[0, 17, 599], [0, 1, 2]] = np.nan, np.inf, -np.inf
    finite = np.isfinite(points).all(axis=1)

    def preprocessed(points, channels=channels):
        return mcg.preprocess(PointCloud(points, channels), None)

    inside, expected = jax.jit(preprocessed)(points), preprocessed(points[finite], channels[finite])
    np.testing.assert_array_equal(inside.valid, np.arange(600) < 597)
    for name in ("points", "channels", "neighbors"):
        np.testing.assert_array_equal(getattr(inside, name)[:597], getattr(expected, name))
    # Features of padding are finite.
    np.testing.assert_array_equal(inside.points[597:], np.broadcast_to(expected.points[-1], (3, 3)))
    slopes = jax.jit(jax.grad(lambda points: jnp.sum(preprocessed(points).points[:597] ** 2)))(points)
    assert np.isfinite(slopes).all() and (slopes[~finite] == 0).all()
    nothing = jax.jit(preprocessed)(np.full_like(points, np.nan))
    assert not nothing.valid.any() and (nothing.points == 0).all()


def averaged(points, channels, channel_valid=None, size=SIZE):
    return mcg.preprocess(PointCloud(points, channels, channel_valid=channel_valid), VOXEL, size=size)


# One program for all tests of these shapes.
averaged_inside = jax.jit(averaged, static_argnums=3)


def test_means_of_voxels():
    points, channels = surface()
    measured = np.random.default_rng(1).random(channels.shape) < 0.7
    inside = averaged_inside(points, channels, measured)
    assert inside.channel_valid.dtype == bool and inside.points.dtype == inside.channels.dtype == np.float32
    voxels_of = jax.jit(partial(_voxels_of, voxel_size=VOXEL))
    order, numbers, count = map(np.asarray, voxels_of(points, np.ones(len(points), bool)))
    assert np.sum(inside.valid) == count == numbers.max() + 1
    for number in range(count):
        rows = order[numbers == number]
        np.testing.assert_allclose(inside.points[number], points[rows].mean(axis=0), atol=1e-6)
        # Edges of a voxel are that long.
        assert np.ptp(points[rows], axis=0).max() < np.sqrt(3) * VOXEL
        for channel, (values, present) in enumerate(zip(channels[rows].T, measured[rows].T, strict=True)):
            assert inside.channel_valid[number, channel] == present.any()
            if present.any():
                np.testing.assert_allclose(inside.channels[number, channel], values[present].mean(), atol=1e-6)
    # As many as on the host, in a grid that is turned otherwise.
    assert count == pytest.approx(len(mcg.preprocess(points, VOXEL)), rel=0.1)
    expected = mcg.preprocess(inside.points[:count], None)
    np.testing.assert_array_equal(inside.neighbors[:count], expected.neighbors)
    # Too many voxels leave no valid row.
    assert not np.any(averaged_inside(points, channels, measured, 100).valid)


@in_float64
def test_means_are_those_of_the_host_in_the_same_grid(monkeypatch):
    points, channels = (array.astype(float) for array in surface())
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    seed = [len(points), *np.sum(points > middle, axis=0)]
    turn = np.random.default_rng(seed).uniform(-VARIATION, VARIATION, 3)
    monkeypatch.setattr(jax.random, "uniform", lambda *_: turn)
    inside = jax.jit(partial(averaged, size=SIZE + 1))(points, channels)
    expected = mcg.preprocess(PointCloud(points, channels), VOXEL)
    assert np.sum(inside.valid) == len(expected)
    np.testing.assert_allclose(inside.points[: len(expected)], expected.points, atol=1e-12)
    np.testing.assert_allclose(inside.channels[: len(expected)], expected.channels, atol=1e-12)


def test_order_and_padding_of_the_points_do_not_matter():
    points, channels = surface()
    rows = np.random.default_rng(2).permutation(len(points))
    one = averaged_inside(points, channels, np.ones(channels.shape, bool))
    padded = PointCloud(points[rows], channels[rows]).pad(2048)
    other = jax.jit(partial(mcg.preprocess, voxel_size=VOXEL, size=SIZE))(padded)
    np.testing.assert_allclose(one.points, other.points, atol=1e-5)
    np.testing.assert_allclose(one.channels, other.channels, atol=1e-5)


@in_float64
def test_derivatives_of_means():
    points, channels = (array.astype(float) for array in surface(200))
    weights = np.random.default_rng(3).normal(size=(SIZE, 5))
    mask = np.random.default_rng(4).random(channels.shape) < 0.8

    @jax.jit
    def weighed(points, channels):
        inside = averaged(points, channels, mask)
        return jnp.sum(weights * jnp.where(inside.valid[:, None], jnp.hstack([inside.points, inside.channels]), 0))

    jax.test_util.check_grads(weighed, (points, channels), order=1, eps=1e-6, atol=1e-7, rtol=1e-7)


@pytest.mark.slow
@in_float64
def test_a_pose_has_a_derivative_by_raw_points_and_tells_what_does_not_fit():
    sides = [np.asarray(room_corner(700, noise=0.01, seed=seed)[0], float) for seed in (1, 2)]
    # From here on the loop converges without a cycle, to a root.
    sides[1] = sides[1] @ motion((0.02, -0.01, 0.015, 0.01, 0.02, -0.01))[:3, :3].T + 0.02
    rng = np.random.default_rng(0)
    weights, step = rng.normal(size=7), 1e-5 * np.array([[0], [1], [-1]])[..., None]
    directions = [direction / np.linalg.norm(direction) for direction in rng.normal(size=(2, 700, 3))]
    tolerances = {"translation_tolerance": 1e-11, "rotation_tolerance": 1e-11}

    def loss(*sides):
        ready = [mcg.preprocess(points, 0.15, size=500) for points in sides]
        result = mcg.register(*ready, mcg.GICP(), max_distance=0.5, **tolerances)
        return result.T_target_source.wxyz_xyz @ weights, result.status_code

    sources, targets = (points + step * direction for points, direction in zip(sides, directions, strict=True))
    # The last source occupies more than 500 voxels.
    sources, targets = (
        np.append(sources, rng.uniform(-3, 3, (1, 700, 3)), axis=0),
        np.append(targets, targets[:1], axis=0),
    )
    program = jax.jit(jax.vmap(jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)))
    (values, statuses), slopes = program(sources, targets)
    assert [Status(int(status)).name for status in statuses] == 3 * ["CONVERGED"] + ["TOO_FEW_CORRESPONDENCES"]
    expected = (values[1] - values[2]) / 2e-5
    derivative = sum(np.sum(slope[0] * direction) for slope, direction in zip(slopes, directions, strict=True))
    np.testing.assert_allclose(derivative, expected, rtol=1e-6)
    assert all(np.isfinite(slope).all() for slope in slopes)


def pose_of(source, target, method):
    return mcg.register(source, target, method, max_distance=0.5, max_iterations=2).matrix


def cost_of(source, target, method):
    matches = mcg.find_correspondences(source, target, None, method, max_distance=0.5)
    return mcg.mahalanobis_cost(np.eye(4), source, target, matches, method)


@pytest.mark.parametrize(
    ("function", "method"),
    [(pose_of, mcg.MultiChannelGICP()), (cost_of, mcg.MultiChannelGICP()), (cost_of, mcg.GICP())],
    ids=["pose, mc-gicp", "cost, mc-gicp", "cost, gicp"],
)
def test_clouds_of_one_program_may_be_constants_of_another(function, method):
    """JAX's arrays, on which any operation would be traced."""
    source, target = (averaged_inside(*surface(seed=seed)) for seed in (0, 1))

    def moved(points):
        return source.replace_rows(points=points)

    # Of both clouds: computed while the program is traced.
    constant = jax.jit(lambda offset: function(source, target, method) + offset)(0.0)
    np.testing.assert_allclose(constant, function(source, target, method), rtol=1e-6, atol=1e-6)
    jax.eval_shape(lambda points: function(moved(points), target, method), source.points)
    # Arrays of both kinds, as after `replace`.
    mixed = target.replace_rows(points=np.asarray(target.points))
    jax.eval_shape(lambda points: function(mixed, moved(points), method), source.points)


def test_what_is_missing_is_said():
    cloud = PointCloud(*surface())
    for named, options in (
        ("voxel_size", {}),
        ("size", {"voxel_size": 0.1}),
        ("size", {"voxel_size": 0.1, "size": 0}),
        ("voxel_size", {"voxel_size": -1.0}),
        ("num_neighbors", {"voxel_size": None, "num_neighbors": 2}),
    ):
        refused(lambda options=options: jax.jit(partial(mcg.preprocess, **options))(cloud), named)
    refused(lambda: jax.jit(partial(mcg.preprocess, voxel_size=None))(cloud.points[None]), "cloud")
    refused(lambda: jax.jit(lambda p: mcg.register(p, p, mcg.GICP()).cost)(cloud.points), "source: cloud")


def test_the_size_of_a_concrete_cloud():
    sized, whole = averaged(*surface()), mcg.preprocess(PointCloud(*surface()), VOXEL)
    assert sized.points.shape[0] == SIZE and len(sized) == len(whole)
    np.testing.assert_array_equal(sized.points[: len(whole)], whole.points)
    refused(lambda: averaged(*surface(), size=100), "size", len(whole), 100)
