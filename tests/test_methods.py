"""The five methods: what they weigh a pair with, what they search, and the numbers that they choose from the data."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial

import mcgicp_jax as mcg
from tests import reference as ref
from tests.precision import cached, in_both_precisions, in_float64, tolerance
from tests.refusals import refused
from tests.scenes import prepare

NOISE = np.array([0.02, 3.0])
pytestmark = in_float64
METHODS = {
    "PointToPoint": mcg.PointToPoint,
    "PointToPlane": mcg.PointToPlane,
    "GICP": mcg.GICP,
    "ColorICP": lambda: mcg.ColorICP([0.0, 0.5, 3.0]),
    "MultiChannelGICP": lambda: mcg.MultiChannelGICP(0.3, 0.1),
}


def ready(num_points=150, num_channels=3, seed=0, **kwargs):
    points, channels = ref.scene(num_points, num_channels, seed)
    cloud = mcg.preprocess(mcg.PointCloud(points, channels, **kwargs), num_neighbors=20)
    return cloud.pad(num_points + 10)


@cached
def noisy(seed, unit=1.0):
    """Points, and a cloud whose channels are linear in the position, with noise of known size."""
    rng = np.random.default_rng(seed)
    points, _ = ref.scene(2000, 0, seed)
    channels = points[:, :2] * [1.0, -40.0] + rng.normal(size=(2000, 2)) * unit * NOISE
    return points, mcg.preprocess(mcg.PointCloud(points, channels), num_neighbors=20).pad(2010)


def pair():
    return noisy(1)[1], noisy(0)[1]


def chosen(*clouds):
    return mcg.MultiChannelGICP().resolve(*clouds)


def sigma(method):
    """Standard deviations of the channels, from Λ = 2 (1.5 σ)²."""
    return np.sqrt(np.asarray(method.channel_covariance, float) / 2) / 1.5


def median_spacing(points):
    """Nearly coincident neighbours do not count."""
    distances = scipy.spatial.KDTree(points).query(points, 20)[0]
    return np.median(np.min(np.where(distances > distances[:, -1:] / 80, distances, np.inf), axis=1))


def given_covariances():
    root = np.random.default_rng(0).normal(size=(150, 3, 3))
    return (root @ root.swapaxes(1, 2)).astype(np.float32).astype(float)


@pytest.mark.parametrize("name", ["GICP", "MultiChannelGICP"])
def test_given_covariances_are_taken(name):
    found = prepare(METHODS[name](), ready(covariances=given_covariances())).covariance.T
    np.testing.assert_allclose(ref.symmetric(found)[:150], given_covariances(), rtol=1e-6, atol=1e-6)


@in_both_precisions
def test_normals_are_those_of_given_covariances():
    given = given_covariances()
    values, vectors = np.linalg.eigh(given)
    found = ref.symmetric(prepare(mcg.PointToPlane(), ready(covariances=given)).covariance.T)[:150]
    clear = np.diff(values)[:, 0] > 0.1
    expected = vectors[:, :, :1] * vectors[:, None, :, 0]
    np.testing.assert_allclose(found[clear], expected[clear], atol=tolerance(1e-4, 1e-11))


@in_both_precisions
@pytest.mark.parametrize("unit", [1.0, 1e-4, 1e4])
def test_covariance_and_weights_follow_the_noise_of_channels(unit):
    """Λ = 2 (1.5 σ)², and α = 2.5 spacing/σ, where a slope of the channel is not noise."""
    slope = (1 - unit) * np.array([1.0, -40.0])
    source, target = (
        cloud.replace(channels=cloud.channels - cloud.points[:, :2] * jnp.asarray(slope, cloud.points.dtype))
        for _, cloud in (noisy(1, unit), noisy(0, unit))
    )
    method = chosen(source, target)
    np.testing.assert_allclose(sigma(method), unit * NOISE, rtol=0.06)
    weights = np.asarray(method.channel_weights) * sigma(method)
    np.testing.assert_allclose(weights, 2.5 * median_spacing(noisy(0)[0]), rtol=1e-4)


@in_both_precisions
@pytest.mark.parametrize("roughness, expected", [(1.0, 0.005), (0.03, None), (0.0, 1.0)])
def test_the_floor_of_omega_rises_on_smooth_surfaces(roughness, expected):
    """ε · 0.72 spacing² by twice the variance across the surface; where Λ is given it stays."""
    rng = np.random.default_rng(0)
    points = np.pad(rng.random((2000, 2)), [(0, 0), (0, 1)])
    points[:, 2] = roughness * median_spacing(points) * rng.normal(size=2000)
    cloud = mcg.preprocess(mcg.PointCloud(points, rng.random(2000)), num_neighbors=20)
    # The plane that fits 20 noisy neighbours takes three degrees of freedom from their variance.
    expected = expected or 1e-3 * 0.72 / (2 * roughness**2 * 17 / 20)
    np.testing.assert_allclose(chosen(cloud, cloud).min_eigenvalue, expected, rtol=0.05)
    assert mcg.MultiChannelGICP(0.3).resolve(cloud, cloud).min_eigenvalue is None
    assert mcg.MultiChannelGICP(min_eigenvalue=0.2).resolve(cloud, cloud).min_eigenvalue == jnp.asarray(0.2)


@in_both_precisions
def test_epsilon_is_the_variance_along_the_normal_by_that_within_the_surface():
    rng = np.random.default_rng(0)
    points = np.pad(rng.random((2000, 2)), [(0, 0), (0, 1)])
    points[:, 2] = 0.3 * median_spacing(points) * rng.normal(size=2000)
    cloud = mcg.preprocess(mcg.PointCloud(points, rng.random(2000)), num_neighbors=20)
    near = points[scipy.spatial.KDTree(points).query(points, 20)[1]]
    offsets = near - near.mean(axis=1, keepdims=True)
    smallest, *others = np.linalg.eigvalsh(offsets.swapaxes(1, 2) @ offsets).T
    expected = np.quantile(smallest / np.mean(others, axis=0), 0.25)
    assert 2e-3 < expected < 0.1
    # From samples.
    np.testing.assert_allclose(chosen(cloud, cloud).epsilon, expected, rtol=0.05)
    uniform = cloud.replace(channels=0 * np.asarray(cloud.channels))
    np.testing.assert_allclose(chosen(uniform, uniform).epsilon, 1e-3)
    assert mcg.MultiChannelGICP(0.3).resolve(cloud, cloud).epsilon is None
    np.testing.assert_allclose(mcg.MultiChannelGICP(epsilon=2e-3).resolve(cloud, cloud).epsilon, 2e-3)


def test_noise_is_that_of_the_points_that_have_the_channel():
    rng, clouds = np.random.default_rng(2), []
    for cloud in pair():
        present = np.stack([rng.random(2000) < 0.7, np.asarray(cloud.points)[:2000, 0] > 0.5], axis=1)
        clouds.append(cloud.replace(channel_valid=np.pad(present, [(0, 10), (0, 0)])))
    np.testing.assert_allclose(sigma(chosen(*clouds)), NOISE, rtol=0.1)


def test_a_channel_that_no_point_has_gets_no_weight():
    mask = np.tile([True, False], (2010, 1))
    method = chosen(*(cloud.replace(channel_valid=mask) for cloud in pair()))
    assert np.isfinite(method.channel_covariance).all()
    np.testing.assert_array_equal(np.asarray(method.channel_weights) > 0, [True, False])


def with_extreme_values(cloud):
    """As files of some scanners hold them. Without a bound, Λ is 160 times as large."""
    channels = np.array(cloud.channels)
    channels[[3, 500, 1200]] = 1e5
    return cloud.replace(channels=channels)


@in_both_precisions
@pytest.mark.parametrize(
    "change, covariance_rtol, weights_rtol",
    [
        pytest.param(with_extreme_values, 0.1, 0.05, id="extreme values"),
        # Rounding leaves enough of the channel.
        pytest.param(lambda c: c.replace(channels=c.channels + np.float32(1e4)), 0.01, 0.01, id="offset"),
        pytest.param(lambda cloud: cloud.pad(3000), 1e-5, 1e-5, id="padding"),
    ],
)
def test_covariance_and_weights_hardly_depend_on(change, covariance_rtol, weights_rtol):
    expected, found = chosen(*pair()), chosen(*map(change, pair()))
    np.testing.assert_allclose(found.channel_covariance, expected.channel_covariance, rtol=covariance_rtol)
    np.testing.assert_allclose(found.channel_weights, expected.channel_weights, rtol=weights_rtol)


@pytest.mark.parametrize("kind", ["one point in a thousand differs", "a step between two flat colours"])
def test_channels_without_noise_have_finite_numbers(kind):
    """No quantile shows the first, and most neighbourhoods of the second have one colour alone."""
    points = noisy(0)[0]
    marked = np.isin(np.arange(2000), [700, 1500]) if kind.startswith("one") else points[:, 0] > 0
    method = chosen(*[mcg.preprocess(mcg.PointCloud(points, marked.astype(float)), num_neighbors=20)] * 2)
    for number in (method.channel_covariance, method.channel_weights):
        assert np.all(np.isfinite(number) & (np.asarray(number) > 0))


def test_a_constant_channel_changes_nothing():
    cloud = noisy(0)[1]
    channels = np.array(cloud.channels)
    channels[:, 1] = np.where(cloud.valid, 255, 0)
    cloud, without = cloud.replace(channels=channels), cloud.replace(channels=channels[:, :1])
    method = chosen(cloud, cloud)
    assert method.channel_weights[1] == 0 < method.channel_weights[0]
    expected = prepare(chosen(without, without), without).covariance
    np.testing.assert_allclose(prepare(method, cloud).covariance, expected, atol=tolerance(1e-5, 1e-12))


def test_given_numbers_are_kept():
    cloud = ready()
    method = mcg.MultiChannelGICP(0.5).resolve(cloud, cloud)
    assert method.channel_covariance == 0.5 and method.channel_weights.shape == (3,)
    method = mcg.MultiChannelGICP(channel_weights=0.25).resolve(cloud, cloud)
    assert method.channel_weights == 0.25 and method.channel_covariance.shape == (3,)
    done = mcg.MultiChannelGICP(0.5, 0.25)
    assert done.resolve(cloud, cloud) is done


def test_chosen_numbers_are_constant_to_autodiff():
    cloud = ready()

    def total(points, channels):
        method = chosen(*[cloud.replace(points=points, channels=channels)] * 2)
        return jnp.sum(method.channel_covariance) + jnp.sum(method.channel_weights)

    for gradient in jax.jit(jax.grad(total, argnums=(0, 1)))(cloud.points, cloud.channels):
        np.testing.assert_array_equal(gradient, 0)


@in_both_precisions
@pytest.mark.parametrize("name", METHODS)
def test_the_numbers_of_a_method_are_arrays(name):
    method = METHODS[name]()
    for leaf in jax.tree.leaves(method):
        assert isinstance(leaf, jax.Array)
        assert leaf.dtype == jnp.zeros(()).dtype
    assert jax.tree.structure(jax.tree.map(lambda leaf: 2 * leaf, method)) == jax.tree.structure(method)
    assert len(repr(method)) < 400


def test_the_fields_of_a_method_are_its_arguments():
    for method in (
        mcg.ColorICP([0.5, 3]),
        mcg.ColorICP(0.5, 0.1),
        mcg.ColorNDT(0.5, 2),
        mcg.NDT(None),
        mcg.D2DNDT(3),
        mcg.MultiChannelGICP(0.3),
    ):
        pasted = eval(repr(method), vars(mcg))
        assert repr(pasted) == repr(dataclasses.replace(pasted)) == repr(method)


@pytest.mark.parametrize(
    "make, named",
    [
        *((lambda v=v: mcg.GICP(v), "epsilon") for v in (0, -1e-3, np.nan, np.inf, np.array([1e-3, 1e-3]))),
        (lambda: mcg.MultiChannelGICP(epsilon=-1), "epsilon"),
        *((lambda v=v: mcg.MultiChannelGICP(min_eigenvalue=v), "min_eigenvalue") for v in (0, -1.0)),
        *(
            (lambda v=v: mcg.MultiChannelGICP(v), "channel_covariance")
            for v in (0.0, -1.0, np.nan, [1.0, 0.0], [[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.5], [0.1, 1.0]], "auto")
        ),
        *((lambda v=v: mcg.MultiChannelGICP(np.ones(v)), "channel_covariance") for v in ((2, 3), (1, 2, 2))),
        *((lambda v=v: mcg.MultiChannelGICP(1, v), "channel_weights") for v in (-0.1, [0.1, np.inf], np.ones((2, 2)))),
        *((lambda v=v: mcg.ColorICP(v), "channel_weights") for v in (-1.0, "red", np.nan)),
        (lambda: mcg.ColorICP(1.0, -1.0), "missing_variance"),
        (lambda: prepare(mcg.ColorICP(np.array([1.0, 2.0])), ready()), "channel_weights"),
        (lambda: prepare(mcg.MultiChannelGICP(np.array([1.0, 2.0]), 0.1), ready()), "channel_covariance"),
        (lambda: prepare(mcg.MultiChannelGICP(np.eye(2), 0.1), ready()), "channel_covariance"),
        (lambda: prepare(mcg.MultiChannelGICP(), ready()), "channel_covariance"),
        (lambda: prepare(mcg.MultiChannelGICP(1.0), ready()), "channel_weights"),
        *((lambda m=m: prepare(m(), mcg.PointCloud(np.zeros((5, 3)))), "cloud") for m in (mcg.GICP, mcg.PointToPlane)),
    ],
)
def test_invalid_numbers_are_named(make, named):
    refused(make, named)
