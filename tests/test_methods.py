"""The five methods: what they weigh a pair with, what they search, and the numbers that they choose from the data."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcgicp_jax import GICP, ColorICP, MultiChannelGICP, PointCloud, PointToPlane, PointToPoint, preprocess
from tests import reference as ref
from tests.precision import in_both_precisions, in_float64, tolerance
from tests.refusals import refused
from tests.scenes import prepare

NOISE = np.array([0.02, 3.0])
pytestmark = in_float64
METHODS = {
    "PointToPoint": PointToPoint,
    "PointToPlane": PointToPlane,
    "GICP": GICP,
    "ColorICP": lambda: ColorICP([0.0, 0.5, 3.0]),
    "MultiChannelGICP": lambda: MultiChannelGICP(0.3, 0.1),
}


def ready(num_points=150, num_channels=3, seed=0, **kwargs):
    points, channels = ref.scene(num_points, num_channels, seed)
    cloud = preprocess(PointCloud(points, channels, **kwargs), num_neighbors=20)
    return cloud.pad(num_points + 10)


def noisy(seed, num_points=2000, noise=NOISE):
    """Channels that are linear in the position, and noise of known size."""
    rng = np.random.default_rng(seed)
    points, _ = ref.scene(num_points, 0, seed)
    channels = points[:, :2] * [1.0, -40.0] + rng.normal(size=(num_points, 2)) * noise
    return points, preprocess(PointCloud(points, channels), num_neighbors=20).pad(num_points + 10)


@in_both_precisions
@pytest.mark.parametrize("name", METHODS)
def test_information(name):
    """M in the target's frame, from the covariances of both, the source's turned."""
    method = METHODS[name]()
    rng = np.random.default_rng(0)
    root = rng.normal(size=(2, 150, 3, 3))
    source, target = root @ root.swapaxes(2, 3) + 0.1 * np.eye(3)
    R = ref.rotation(rng.normal(size=3))
    dtype = jnp.zeros(()).dtype
    packed = [jnp.asarray(ref.packed(side), dtype) for side in (target, source)]
    actual = ref.symmetric(jax.jit(lambda *args: method.information(*args))(*packed, jnp.asarray(R, dtype)))
    generalised = isinstance(method, GICP | MultiChannelGICP)
    expected = np.linalg.inv(target + R @ source @ R.T) if generalised else target
    np.testing.assert_allclose(actual, expected, atol=tolerance(2e-4, 1e-11))


@pytest.mark.parametrize("name", METHODS)
def test_descriptors_are_channels_in_metres(name):
    method = METHODS[name]()
    cloud = ready()
    surface = prepare(method, cloud)
    if isinstance(method, ColorICP | MultiChannelGICP):
        np.testing.assert_allclose(surface.search.descriptors, cloud.channels * method.channel_weights, rtol=1e-6)
    else:
        assert surface.search.descriptors.shape == (160, 0)
    np.testing.assert_array_equal(surface.points, cloud.points)
    np.testing.assert_array_equal(surface.search.valid, cloud.valid)


@pytest.mark.parametrize("name", ["PointToPoint", "ColorICP"])
def test_points_alone_weigh_alike_in_all_directions(name):
    method = METHODS[name]()
    found = ref.symmetric(prepare(method, ready()).covariance.T)
    np.testing.assert_array_equal(found, np.broadcast_to(np.eye(3), found.shape))


@pytest.mark.parametrize("name", ["GICP", "MultiChannelGICP"])
def test_given_covariances_are_taken(name):
    method = METHODS[name]()
    root = np.random.default_rng(0).normal(size=(150, 3, 3))
    given = (root @ root.swapaxes(1, 2)).astype(np.float32)
    found = ref.symmetric(prepare(method, ready(covariances=given)).covariance.T)[:150]
    np.testing.assert_allclose(found, given, rtol=1e-6, atol=1e-6)


@in_both_precisions
def test_normals_of_given_covariances():
    root = np.random.default_rng(0).normal(size=(150, 3, 3))
    given = (root @ root.swapaxes(1, 2)).astype(np.float32).astype(float)
    normals = np.linalg.eigh(given)[1][:, :, 0]
    found = ref.symmetric(prepare(PointToPlane(), ready(covariances=given)).covariance.T)[:150]
    clear = np.diff(np.linalg.eigvalsh(given))[:, 0] > 0.1
    expected = normals[:, :, None] * normals[:, None, :]
    np.testing.assert_allclose(found[clear], expected[clear], atol=tolerance(1e-4, 1e-11))


@in_both_precisions
@pytest.mark.parametrize("unit", [1.0, 1e-4, 1e4])
def test_noise_is_found(unit):
    """Λ = 2 (1.5 σ)², and α = 2.5 spacing/σ, where a slope of the channel is not noise."""
    points, target = noisy(0, noise=unit * NOISE)
    _, source = noisy(1, noise=unit * NOISE)
    slope = (1 - unit) * np.array([1.0, -40.0])
    target, source = (
        cloud.replace(channels=cloud.channels - cloud.points[:, :2] * jnp.asarray(slope, cloud.points.dtype))
        for cloud in (target, source)
    )
    method = MultiChannelGICP().resolve(source, target)
    sigma = np.sqrt(np.asarray(method.channel_covariance, float) / 2) / 1.5
    np.testing.assert_allclose(sigma, unit * NOISE, rtol=0.06)
    nearest = ref.nearest(points, points, 2)[:, 1]
    spacing = np.median(np.linalg.norm(points[nearest] - points, axis=1))
    np.testing.assert_allclose(np.asarray(method.channel_weights) * sigma, 2.5 * spacing, rtol=1e-4)


@in_both_precisions
@pytest.mark.parametrize("roughness, expected", [(1.0, 0.005), (0.03, None), (0.0, 1.0)])
def test_the_floor_of_omega_rises_on_smooth_surfaces(roughness, expected):
    """ε · 0.72 spacing² by twice the variance across the surface; where Λ is given it stays."""
    rng = np.random.default_rng(0)
    points = np.pad(rng.random((2000, 2)), [(0, 0), (0, 1)])
    spacing = np.median(np.linalg.norm(points[ref.nearest(points, points, 2)[:, 1]] - points, axis=1))
    points[:, 2] = roughness * spacing * rng.normal(size=2000)
    cloud = preprocess(PointCloud(points, rng.random(2000)), num_neighbors=20)
    found = MultiChannelGICP().resolve(cloud, cloud).min_eigenvalue
    # The plane that fits 20 noisy neighbours takes three degrees of freedom from their variance.
    expected = expected or 1e-3 * 0.72 / (2 * roughness**2 * 17 / 20)
    np.testing.assert_allclose(found, expected, rtol=0.05)
    assert MultiChannelGICP(0.3).resolve(cloud, cloud).min_eigenvalue is None
    assert MultiChannelGICP(min_eigenvalue=0.2).resolve(cloud, cloud).min_eigenvalue == jnp.asarray(0.2)


def test_noise_is_found_where_the_channel_is():
    """Each channel by the points that have it, and at their neighbours that do."""
    (_, target), (_, source) = noisy(0), noisy(1)
    rng = np.random.default_rng(2)
    clouds = []
    for cloud in (source, target):
        present = np.stack([rng.random(len(cloud)) < 0.7, np.asarray(cloud.points)[: len(cloud), 0] > 0.5], axis=1)
        mask = np.pad(present, [(0, cloud.points.shape[0] - len(cloud)), (0, 0)])
        clouds.append(cloud.replace(channel_valid=mask))
    method = MultiChannelGICP().resolve(*clouds)
    np.testing.assert_allclose(np.sqrt(np.asarray(method.channel_covariance) / 2) / 1.5, NOISE, rtol=0.1)


def test_a_channel_that_nobody_has_says_nothing():
    cloud = ready()
    mask = np.ones(cloud.channels.shape, bool)
    mask[:, 1] = False
    method = MultiChannelGICP().resolve(*[cloud.replace(channel_valid=mask)] * 2)
    assert np.isfinite(method.channel_covariance).all()
    np.testing.assert_array_equal(np.asarray(method.channel_weights) > 0, [True, False, True])


@in_both_precisions
def test_a_few_extreme_values_change_little():
    """The files of some scanners hold them. Without a bound, Λ is 160 times as large."""
    clouds = [noisy(seed)[1] for seed in (0, 1)]
    extreme = [np.array(cloud.channels) for cloud in clouds]
    for channels in extreme:
        channels[[3, 500, 1200]] = 1e5
    plain = MultiChannelGICP().resolve(*clouds)
    found = MultiChannelGICP().resolve(*(c.replace(channels=new) for c, new in zip(clouds, extreme, strict=True)))
    np.testing.assert_allclose(found.channel_covariance, plain.channel_covariance, rtol=0.1)
    np.testing.assert_allclose(found.channel_weights, plain.channel_weights, rtol=0.05)


@in_both_precisions
def test_an_offset_of_a_channel_changes_nothing():
    """As long as rounding leaves some of the channel."""
    clouds = [noisy(seed)[1] for seed in (0, 1)]
    plain = MultiChannelGICP().resolve(*clouds)
    found = MultiChannelGICP().resolve(*(c.replace(channels=c.channels + np.float32(1e4)) for c in clouds))
    np.testing.assert_allclose(found.channel_covariance, plain.channel_covariance, rtol=0.01)
    np.testing.assert_allclose(found.channel_weights, plain.channel_weights, rtol=0.01)


def test_rare_marks_have_a_spread():
    """One point in a thousand differs: no quantile shows it, and all values count."""
    cloud = ready(2000, 1)
    channels = np.zeros((len(cloud.points), 1))
    channels[[700, 1500]] = 1
    method = MultiChannelGICP().resolve(*[cloud.replace(channels=channels)] * 2)
    assert np.all(np.isfinite(method.channel_weights) & (np.asarray(method.channel_weights) > 0))


def test_padding_takes_no_part_in_the_choice():
    (_, target), (_, source) = noisy(0), noisy(1)
    method = MultiChannelGICP().resolve(source, target)
    padded = MultiChannelGICP().resolve(source.pad(3000), target.pad(3000))
    np.testing.assert_allclose(padded.channel_covariance, method.channel_covariance, rtol=1e-5)
    np.testing.assert_allclose(padded.channel_weights, method.channel_weights, rtol=1e-5)


def test_a_constant_channel_says_nothing():
    cloud = ready()
    channels = np.array(cloud.channels)
    channels[:, 1] = np.where(cloud.valid, 255, 0)
    cloud = cloud.replace(channels=channels)
    method = MultiChannelGICP().resolve(cloud, cloud)
    assert method.channel_weights[1] == 0
    assert np.all(np.asarray(method.channel_weights)[[0, 2]] > 0)
    without = cloud.replace(channels=channels[:, [0, 2]])
    expected = prepare(MultiChannelGICP().resolve(without, without), without).covariance
    np.testing.assert_allclose(prepare(method, cloud).covariance, expected, atol=tolerance(1e-5, 1e-12))


def test_a_channel_without_noise_stays_finite():
    """Rendered: a step between two flat colours, most neighbourhoods of one colour alone."""
    points, _ = ref.scene(150, 0)
    cloud = preprocess(PointCloud(points, (points[:, 0] > 0).astype(float)), num_neighbors=4)
    method = MultiChannelGICP().resolve(cloud, cloud)
    for number in (method.channel_covariance, method.channel_weights):
        assert np.all(np.isfinite(number) & (np.asarray(number) > 0))


def test_without_channels_nothing_is_to_be_chosen():
    cloud = ready(num_channels=0)
    method = MultiChannelGICP().resolve(cloud, cloud)
    assert method.channel_covariance.shape == method.channel_weights.shape == (0,)
    np.testing.assert_allclose(
        prepare(method, cloud).covariance, prepare(GICP(), cloud).covariance, atol=tolerance(1e-6, 1e-15)
    )


def test_what_is_given_is_kept():
    cloud = ready()
    method = MultiChannelGICP(0.5).resolve(cloud, cloud)
    assert method.channel_covariance == 0.5
    assert method.channel_weights.shape == (3,)
    method = MultiChannelGICP(channel_weights=0.25).resolve(cloud, cloud)
    assert method.channel_weights == 0.25
    assert method.channel_covariance.shape == (3,)
    done = MultiChannelGICP(0.5, 0.25)
    assert done.resolve(cloud, cloud) is done


def test_what_is_chosen_is_constant_to_autodiff():
    cloud = ready()

    def chosen(points, channels):
        moved = cloud.replace(points=points, channels=channels)
        method = MultiChannelGICP().resolve(moved, moved)
        return jnp.sum(method.channel_covariance) + jnp.sum(method.channel_weights)

    for gradient in jax.jit(jax.grad(chosen, argnums=(0, 1)))(cloud.points, cloud.channels):
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


@in_float64
@pytest.mark.parametrize(
    "make, named",
    [
        *((lambda v=v: GICP(v), "epsilon") for v in (0, -1e-3, np.nan, np.inf, np.array([1e-3, 1e-3]))),
        (lambda: MultiChannelGICP(epsilon=-1), "epsilon"),
        *((lambda v=v: MultiChannelGICP(min_eigenvalue=v), "min_eigenvalue") for v in (0, -1.0)),
        *(
            (lambda v=v: MultiChannelGICP(v), "channel_covariance")
            for v in (0.0, -1.0, np.nan, [1.0, 0.0], [[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.5], [0.1, 1.0]], "auto")
        ),
        *((lambda v=v: MultiChannelGICP(np.ones(v)), "channel_covariance") for v in ((2, 3), (1, 2, 2))),
        *((lambda v=v: MultiChannelGICP(1.0, v), "channel_weights") for v in (-0.1, [0.1, np.inf], np.ones((2, 2)))),
        *((lambda v=v: ColorICP(v), "channel_weights") for v in (-1.0, "red", np.nan)),
        (lambda: prepare(ColorICP(np.array([1.0, 2.0])), ready()), "channel_weights"),
        (lambda: prepare(MultiChannelGICP(np.array([1.0, 2.0]), 0.1), ready()), "channel_covariance"),
        (lambda: prepare(MultiChannelGICP(np.eye(2), 0.1), ready()), "channel_covariance"),
        (lambda: prepare(MultiChannelGICP(), ready()), "channel_covariance"),
        (lambda: prepare(MultiChannelGICP(1.0), ready()), "channel_weights"),
        *((lambda m=m: prepare(m, PointCloud(np.zeros((5, 3)))), "cloud") for m in (GICP(), PointToPlane())),
    ],
)
def test_numbers_that_make_no_sense(make, named):
    refused(make, named)
