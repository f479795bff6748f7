"""Arguments of the wrong kind are named."""

import warnings
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

import mcgicp_jax as mcg
from tests.refusals import refused

POINTS = np.random.default_rng(0).random((50, 3))


@pytest.mark.parametrize("value", ["x", None, [1.0], np.nan, 0, -1.0])
def test_numbers_are_checked(value):
    refused(lambda: mcg.register(POINTS, POINTS, mcg.GICP(), max_iterations=value), "max_iterations")
    refused(lambda: mcg.voxel_gaussians(POINTS, value), "voxel_size")


@pytest.mark.parametrize("function", [mcg.register_batch, mcg.odometry, mcg.multiway])
def test_unknown_options_are_named(function):
    clouds = [POINTS] * 2
    given = (clouds, clouds, mcg.GICP()) if function is mcg.register_batch else (clouds, mcg.GICP())
    # Only one pair can have tie points.
    for option, told in (("max_distanc", "did you mean max_distance"), ("tie_points", "voxel_sizes")):
        with pytest.raises(TypeError, match=rf"^{function.__name__}: .*'{option}'.*{told}"):
            list(function(*given, **{option: None}).__iter__())


def test_swapped_arguments_are_named():
    cloud = mcg.preprocess(POINTS)
    matches = mcg.find_correspondences(cloud, cloud, None, mcg.GICP(), max_distance=1.0)
    for named, call in (
        ("matches", lambda: mcg.mahalanobis_cost(cloud, cloud, np.eye(4), cloud, mcg.GICP())),
        ("pose", lambda: mcg.mahalanobis_cost(cloud, cloud, cloud, matches, mcg.GICP())),
        ("target", lambda: mcg.mahalanobis_cost(cloud, cloud, np.eye(4), matches, mcg.GICP())),
        ("source", lambda: mcg.find_correspondences(np.eye(4), cloud, cloud, mcg.GICP(), max_distance=1.0)),
        ("num_candidates", lambda: mcg.D2DNDT(num_candidates=True)),
        ("voxel_sizes", lambda: mcg.register(POINTS, POINTS, mcg.NDT(), voxel_sizes=(0.25, 1.0))),
        ("method", lambda: mcg.register(POINTS, POINTS, mcg.GICP)),
        ("init", lambda: mcg.register(cloud, cloud, mcg.GICP(), init=np.diag([1, 1, 1, 1.001]))),
        ("robust", lambda: mcg.register(cloud, cloud, mcg.GICP(), robust=mcg.Huber)),
        ("tie_points", lambda: mcg.register(cloud, cloud, mcg.GICP(), tie_points=(POINTS, POINTS))),
        ("executor", lambda: mcg.register_batch([cloud], [cloud], mcg.GICP(), executor=ThreadPoolExecutor)),
        ("cloud", lambda: mcg.io.write("cloud.ply", POINTS)),
        ("cloud", lambda: mcg.io.write(cloud, "cloud.ply")),
    ):
        refused(call, named)


def test_channels_are_told_apart_by_name():
    """Names of arrays that have none fit any; methods without channels do not ask."""
    points, channels = np.random.default_rng(0).normal(size=(2, 50, 3))
    one, other, unnamed = (
        mcg.preprocess(mcg.PointCloud(points, channels, channel_names=names))
        for names in (("r", "g", "b"), ("g", "b", "r"), None)
    )
    method = mcg.MultiChannelGICP(1.0, 0.1)
    moved = other.replace(channels=other.channels + 100)
    with warnings.catch_warnings():
        # Values of different channels are not compared before.
        warnings.simplefilter("error")
        refused(lambda: mcg.register(one, moved, method), "source", ("g", "b", "r"), ("r", "g", "b"))
    with pytest.warns(mcg.PairWarning, match="pair 0: source: "):
        (result,) = mcg.register_batch([one], [other], method)
    assert result.status == mcg.Status.INVALID_INPUT
    for source, target, allowed in ((one, unnamed, method), (unnamed, one, method), (one, other, mcg.GICP())):
        assert mcg.register(source, target, allowed).num_inliers == 50


def test_poses_with_rounding_in_the_last_row_and_of_three_rows():
    cloud = mcg.preprocess(np.random.default_rng(0).normal(size=(50, 3)))
    pose = np.eye(4)
    pose[:3, 3] = 0.01
    expected = mcg.register(cloud, cloud, mcg.GICP(), init=pose).matrix
    rounded = pose.copy()
    rounded[3] += [1e-17, -1e-17, 0, 2e-16]
    for given in (rounded, pose[:3]):
        np.testing.assert_array_equal(mcg.register(cloud, cloud, mcg.GICP(), init=given).matrix, expected)
    matches = mcg.find_correspondences(cloud, cloud, pose, mcg.GICP(), max_distance=1.0)
    inside = jax.jit(lambda pose: mcg.mahalanobis_cost(pose, cloud, cloud, matches, mcg.PointToPoint()))(pose[:3])
    np.testing.assert_allclose(inside, mcg.mahalanobis_cost(pose, cloud, cloud, matches, mcg.PointToPoint()), rtol=1e-5)


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

        def inside(points, call=call):
            call(cloud.replace(points=points), still + 0 * points[0, 0])
            return 0.0

        refused(lambda inside=inside: transformation(inside)(cloud.points), named, "tracers")
