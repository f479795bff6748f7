"""Arguments of the wrong kind are named."""

import warnings
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import extend
from tests.refusals import refused
from tests.scenes import motion

POINTS = np.random.default_rng(0).random((50, 3))


@pytest.mark.parametrize("value", ["x", None, [1.0], np.nan, 0, -1.0])
def test_numbers_are_checked(value):
    refused(lambda: mcg.register(POINTS, POINTS, mcg.GICP(), max_iterations=value), "max_iterations")
    refused(lambda: mcg.voxel_gaussians(POINTS, value), "voxel_size")


@pytest.mark.parametrize("function", [mcg.register, mcg.register_batch, mcg.odometry, mcg.multiway])
def test_unknown_options_are_named(function):
    clouds = [POINTS] * 2
    arguments = (clouds, clouds, mcg.GICP()) if function in (mcg.register, mcg.register_batch) else (clouds, mcg.GICP())
    # Only `register` takes tie points, and it alone does not take `voxel_size`.
    other = ("voxel_size", "average .* by preprocess") if function is mcg.register else ("tie_points", "voxel_sizes")
    for option, told in (("max_distanc", "did you mean max_distance or max_iter"), other):
        with pytest.raises(TypeError, match=rf"^{function.__name__}: .*'{option}'.*{told}"):
            list(function(*arguments, **{option: None}).__iter__())


def test_arguments_that_are_swapped_or_in_the_wrong_form_are_named():
    raw, cloud, method, still = mcg.PointCloud(POINTS, POINTS), mcg.preprocess(POINTS), mcg.GICP(), np.eye(4)
    matches = mcg.find_correspondences(cloud, cloud, None, method, max_distance=1.0)
    result = mcg.RegistrationResult.without_pose(mcg.Status.CONVERGED)
    for named, call, *told in (
        ("matches", lambda: mcg.mahalanobis_cost(cloud, cloud, still, cloud, method)),
        ("pose", lambda: mcg.mahalanobis_cost(cloud, cloud, cloud, matches, method)),
        ("target", lambda: mcg.mahalanobis_cost(cloud, cloud, still, matches, method)),
        ("source", lambda: mcg.find_correspondences(still, cloud, cloud, method, max_distance=1.0)),
        ("num_candidates", lambda: mcg.D2DNDT(num_candidates=True)),
        ("voxel_sizes", lambda: mcg.register(POINTS, POINTS, mcg.NDT(), voxel_sizes=(0.25, 1.0))),
        ("method", lambda: mcg.register(POINTS, POINTS, mcg.GICP)),
        ("method", lambda: mcg.register(method, raw, raw), "Clouds come first"),
        ("init", lambda: mcg.register(cloud, cloud, method, init=np.diag([1, 1, 1, 1.001]))),
        ("init", lambda: mcg.register(POINTS, POINTS, method, init=result), "pass its .matrix"),
        ("robust", lambda: mcg.register(cloud, cloud, method, robust=mcg.Huber)),
        ("executor", lambda: mcg.register_batch([cloud], [cloud], method, executor=ThreadPoolExecutor)),
        ("cloud", lambda: mcg.io.write("cloud.ply", POINTS)),
        ("cloud", lambda: mcg.io.write(cloud, "cloud.ply")),
        ("source", lambda: mcg.register((POINTS, POINTS), raw, method), "PointCloud(points, channels)"),
        ("source", lambda: mcg.register(POINTS[:, :2], raw, method), "copies", "prior"),
        ("points", lambda: mcg.PointCloud([POINTS, POINTS[:, 0]]), "PointCloud(points, channels)"),
        ("pose", lambda: raw.transform("left")),
        ("pose", lambda: raw.transform(still + 1)),
        ("frames", lambda: mcg.odometry(raw, method), "one PointCloud"),
        ("frames", lambda: mcg.odometry(POINTS, method), "one ndarray"),
        ("clouds", lambda: mcg.multiway(mcg.datasets.Frame(raw), method), "one Frame"),
        ("poses", lambda: mcg.plot.before_after(raw, raw, [still]), "poses by name", "list"),
        ("channel_names", lambda: raw.replace(channels=POINTS, channel_names=()), 3, 0),
        ("channel_names", lambda: raw.replace(channels=POINTS, channel_names=("a", "b", "a")), "different names"),
        ("points", lambda: mcg.PointCloud((POINTS > 0).tolist()), "bool"),
        ("frames", lambda: mcg.odometry("scans", method), "mcgicp_jax.datasets.clouds('scans')"),
        ("photometric", lambda: mcg.MultiChannelGICP(photometric="no"), "'no'"),
        ("clouds[1]", lambda: mcg.PointCloud.stack([raw, "b.ply"]), "mcgicp_jax.io.read('b.ply')"),
    ):
        refused(call, named, *told)
    with pytest.raises(AttributeError, match=r"^points: .* cloud\.replace\(points=\.\.\.\)"):
        raw.points = POINTS


@pytest.mark.parametrize(
    ("method", "same"), [(mcg.ColorICP(0.1), mcg.PointToPoint()), (mcg.MultiChannelGICP(), mcg.GICP())]
)
def test_methods_of_channels_warn_that_they_use_geometry_alone(method, same):
    with pytest.warns(UserWarning, match=f"no channels: {type(method).__name__} uses geometry alone"):
        result = mcg.register(POINTS, POINTS, method)
    np.testing.assert_allclose(result.matrix, mcg.register(POINTS, POINTS, same).matrix, atol=1e-6)


class NoNumbers(mcg.GICP):
    def covariance(self, around, local):
        return super().covariance(around, local).at[:, :5].set(jnp.nan)


class NoResidual(extend.AbstractTerm):
    def linearize(self, matches):
        infinite = jnp.full_like(matches.moved[0], jnp.inf)
        return extend.linearize_residual(matches.residual, jnp.stack([infinite] * 6), self.robust)


class WithNoResidual(mcg.GICP):
    def terms(self, source, target, robust, equalize_channels):
        return (*super().terms(source, target, robust, equalize_channels), NoResidual())


@pytest.mark.parametrize(
    ("method", "told"),
    [
        (NoNumbers(), r"^NoNumbers\.covariance: .* at \d+ of 50 points of the source, first at row 0"),
        (WithNoResidual(), "^NoResidual: .* after 0 updates"),
    ],
    ids=["method", "term"],
)
def test_extensions_whose_numbers_are_not_finite_are_named(method, told):
    with pytest.warns(UserWarning, match=told):
        assert mcg.register(POINTS, POINTS, method).status is mcg.Status.NON_FINITE


def test_channels_are_told_apart_by_name():
    """Names of arrays that have none fit any; methods without channels do not ask."""
    method, unnamed = mcg.MultiChannelGICP(1.0, 0.1), mcg.preprocess(mcg.PointCloud(POINTS, POINTS[:, :2]))
    one, other = (unnamed.replace(channel_names=names) for names in (("r", "g"), ("g", "r")))
    moved = other.replace(channels=other.channels + 100)
    with warnings.catch_warnings():
        # Values of different channels are not compared before.
        warnings.simplefilter("error")
        refused(lambda: mcg.register(one, moved, method), "source", ("g", "r"), ("r", "g"))
    with pytest.warns(mcg.PairWarning, match="pair 0: source: "):
        (result,) = mcg.register_batch([one], [other], method)
    assert result.status == mcg.Status.INVALID_INPUT
    for source, target, allowed in ((one, unnamed, method), (unnamed, one, method), (one, other, mcg.GICP())):
        assert mcg.register(source, target, allowed).num_inliers == 50


def test_poses_with_rounding_in_the_last_row_and_of_three_rows():
    cloud, pose = mcg.preprocess(POINTS), motion((0.01, 0.01, 0.01, 0, 0, 0))
    expected = mcg.register(cloud, cloud, mcg.GICP(), init=pose).matrix
    for init in (pose + np.outer([0, 0, 0, 1], [1e-17, -1e-17, 0, 2e-16]), pose[:3]):
        np.testing.assert_array_equal(mcg.register(cloud, cloud, mcg.GICP(), init=init).matrix, expected)
    matches = mcg.find_correspondences(cloud, cloud, pose, mcg.GICP(), max_distance=1.0)

    def cost(pose):
        return mcg.mahalanobis_cost(pose, cloud, cloud, matches, mcg.PointToPoint())

    np.testing.assert_allclose(jax.jit(cost)(pose[:3]), cost(pose), rtol=1e-5)


@pytest.mark.parametrize("transformation", [jax.jit, jax.grad])
def test_functions_of_many_clouds_name_what_is_traced(transformation):
    cloud, method, still = mcg.PointCloud(POINTS.astype(np.float32)), mcg.GICP(), np.eye(4)
    for named, call in (
        ("frames[1]", lambda traced, _: list(mcg.odometry([cloud, traced], method))),
        ("start", lambda _, pose: mcg.odometry([cloud, cloud], method, start=pose)),
        ("clouds[1]", lambda traced, _: mcg.multiway([cloud, traced], method)),
        ("init", lambda _, pose: mcg.multiway([cloud, cloud], method, init=[still, pose])),
        ("clouds[0]", lambda traced, _: mcg.merge_clouds([traced, cloud], [still, still])),
        ("poses[1]", lambda _, pose: mcg.merge_clouds([cloud, cloud], [still, pose])),
        ("clouds[1]", lambda traced, _: mcg.estimate_channel_covariance([cloud, traced], [still, still])),
        ("poses[0]", lambda _, pose: mcg.estimate_channel_covariance([cloud, cloud], [pose, still])),
    ):

        @transformation
        def inside(points, call=call):
            call(cloud.replace(points=points), still + 0 * points[0, 0])
            return 0.0

        refused(lambda inside=inside: inside(cloud.points), named, "tracers")
