"""What is measured of channels: Λ from aligned clouds, gain and offset."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax._local_geometry.cloud_statistics import with_channels_matched
from tests import reference as ref
from tests.precision import tolerance
from tests.refusals import refused
from tests.scenes import motion, room_corner

NOISE = np.array([[0.04, 0.03, 0.0], [0.03, 0.09, -0.02], [0.0, -0.02, 0.01]])
POSES = [np.eye(4), motion((0.5, -0.2, 0.1, 0.1, 0.2, -0.1)), motion((1, 2, 3, 0.3, 0, 0.2))]


def seen_again(num_points=1500, present=None, exposure=0.0):
    """The same spots, seen from each of the poses with noise of known covariance."""
    points, channels = ref.scene(num_points, 3)
    clouds = []
    for i, pose in enumerate(POSES):
        rng = np.random.default_rng(i)
        noise = rng.multivariate_normal(np.zeros(3), NOISE, num_points) + exposure * i
        mask = None if present is None else rng.random((num_points, 3)) < present
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        clouds.append(mcg.PointCloud(local + 1e-4 * rng.normal(size=local.shape), channels + noise, channel_valid=mask))
    return clouds


@pytest.mark.parametrize("prepared, present", [(False, None), (True, 0.7)])
def test_the_covariance_of_a_difference_is_found(present, prepared):
    clouds = seen_again(present=present, exposure=0.4)
    clouds = [mcg.preprocess(cloud) for cloud in clouds] if prepared else clouds
    found = mcg.estimate_channel_covariance(clouds, POSES)
    np.testing.assert_allclose(found, 2 * NOISE, atol=0.015)
    assert np.linalg.eigvalsh(found).min() > 0


def test_channels_that_are_never_seen_together_have_no_covariance():
    clouds = seen_again()
    half = np.arange(1500) < 750
    mask = np.stack([half, ~half, ~half], axis=1)
    found = mcg.estimate_channel_covariance([cloud.replace(channel_valid=mask) for cloud in clouds], POSES)
    np.testing.assert_allclose(found, 2 * NOISE * [[1, 0, 0], [0, 1, 1], [0, 1, 1]], atol=0.02)


def test_channels_without_noise_have_a_covariance_that_can_be_inverted():
    points, channels = ref.scene(500, 2)
    found = mcg.estimate_channel_covariance([mcg.PointCloud(points, channels)] * 2, POSES[:1] * 2)
    assert np.isfinite(found).all() and np.linalg.eigvalsh(found).min() > 0


def test_what_cannot_be_measured():
    clouds = seen_again()
    for named, *given in (
        ("poses", clouds, POSES[:2]),
        ("poses", clouds[:1], POSES[:1]),
        ("poses[1]", clouds[:2], [np.eye(4), 2 * np.eye(4)]),
        ("clouds[1]", [clouds[0], mcg.PointCloud(POSES[0][:, :3])], POSES[:2]),
        ("clouds", clouds[:2], POSES[1:]),
    ):
        refused(lambda given=given: mcg.estimate_channel_covariance(*given), named)


def target_and_source(present):
    """The same points; the source's channels have another gain and offset."""
    points, channels = ref.scene(500, 3)
    mask = None if present is None else np.random.default_rng(0).random(channels.shape) < present
    target = mcg.preprocess(mcg.PointCloud(points, channels, channel_valid=mask))
    return target, target.channels * np.array([0.5, 3.0, 1.0]) + np.array([7.0, 0.0, -1.0])


@pytest.mark.parametrize("present", [None, 0.5])
def test_gain_and_offset_are_undone(present):
    target, channels = target_and_source(present)
    matched, _ = with_channels_matched(target.replace(channels=channels), target)
    np.testing.assert_allclose(matched.channels, target.channels, atol=tolerance(2e-5, 1e-12))


@pytest.mark.parametrize("present", [None, 0.5])
def test_what_only_one_cloud_sees_does_not_count_with_matches(present):
    target, channels = target_and_source(present)
    alien = np.arange(len(target.points)) >= 300
    source = target.replace(channels=np.where(alien[:, None], 9.0, channels))
    indices = jnp.asarray(np.roll(np.arange(len(alien)), 7), jnp.int32)
    rolled = target.replace(
        channels=np.roll(target.channels, -7, axis=0),
        channel_valid=None if present is None else np.roll(target.channel_valid, -7, axis=0),
        valid=np.roll(target.valid, -7),
    )
    matches = mcg.Correspondences(indices=indices, distances=jnp.zeros(len(alien)), valid=jnp.asarray(~alien))
    matched, _ = with_channels_matched(source, rolled, matches)
    np.testing.assert_allclose(matched.channels[:300], target.channels[:300], atol=tolerance(2e-5, 1e-12))
    fooled, _ = with_channels_matched(source, rolled)
    assert np.abs(fooled.channels[:300] - target.channels[:300]).max() > 0.3


def test_a_few_matches_change_nothing():
    cloud = mcg.preprocess(mcg.PointCloud(*ref.scene(500, 3)))
    rows = jnp.arange(len(cloud.points), dtype=jnp.int32)
    for count in (0, 3):
        matches = mcg.Correspondences(indices=rows, distances=jnp.zeros(rows.size), valid=rows < count)
        matched, _ = with_channels_matched(cloud.replace(channels=2 * cloud.channels), cloud, matches)
        np.testing.assert_array_equal(matched.channels, 2 * cloud.channels)


def test_channels_that_say_nothing_are_not_matched():
    """Constant, or seen by nobody: at most shifted, and finite."""
    points, channels = ref.scene(500, 3)
    channels[:, 1] = 4.0
    mask = np.ones(channels.shape, bool)
    mask[:, 2] = False
    target = mcg.preprocess(mcg.PointCloud(points, channels, channel_valid=mask))
    source = target.replace(channels=target.channels + 1)
    matched, _ = with_channels_matched(source, target)
    np.testing.assert_allclose(matched.channels[:500], target.channels[:500], atol=1e-5)
    gradient = jax.grad(lambda values: with_channels_matched(source.replace(channels=values), target)[0].channels.sum())
    assert np.isfinite(gradient(source.channels)).all()


@pytest.mark.parametrize("photometric", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_another_exposure_is_told(photometric):
    target, source = (
        mcg.preprocess(frame.cloud, voxel_size=0.03) for frame in mcg.datasets.poster_wall(num_frames=2, seed=1)
    )
    method = mcg.MultiChannelGICP(photometric=photometric)
    dark, bright = (source.replace(channels=np.minimum(gain * np.asarray(source.channels), 1)) for gain in (0.5, 1.5))
    for changed in (dark, bright):
        with pytest.warns(UserWarning, match="channel red: "):
            # The wall constrains only half of the directions, its posters the others.
            assert not mcg.register(changed, target, method).converged
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert mcg.register(source, target, method).converged
        assert mcg.register(dark, target, method, equalize_channels=True).converged
        mcg.register(dark, target, mcg.GICP())


def test_parameters_are_chosen_from_the_channels_as_they_are_equalised():
    """A fourth of the source is alien, so that all of its points give another gain than those that match."""
    points, channels = room_corner(600, seed=1)
    target = mcg.preprocess(mcg.PointCloud(points, channels), None)
    seen = np.concatenate([points, points[:200] + 20]), np.concatenate([2 * channels, channels[:200] + 3])
    errors = []

    class Recorded(mcg.MultiChannelGICP):
        def resolve(self, source, target, geometries=None):
            assert self.channel_covariance is None
            errors.append(np.abs(source.channels[:600] - channels).max())
            return super().resolve(source, target, geometries)

    mcg.register(mcg.preprocess(mcg.PointCloud(*seen), None), target, Recorded(), equalize_channels=True)
    by_all, by_matches = errors
    assert by_matches < 1e-3 < 0.1 < by_all


def test_without_channels_there_is_nothing_to_equalize(recwarn):
    clouds = [mcg.preprocess(room_corner(300, seed=seed)[0]) for seed in (0, 1)]
    results = [mcg.register(*clouds, mcg.GICP(), max_distance=0.5, equalize_channels=value) for value in (True, False)]
    np.testing.assert_array_equal(results[0].matrix, results[1].matrix)
    assert not recwarn.list
