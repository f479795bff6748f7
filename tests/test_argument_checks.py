"""Arguments of the wrong kind are named."""

import dataclasses
import inspect

import jax
import numpy as np
import pytest
from jaxtyping import TypeCheckError

import mcgicp_jax as mcg
from mcgicp_jax._cli.options import Options as CommandOptions
from mcgicp_jax._compute.messages import check_integer, check_positive
from mcgicp_jax._registration.options import GivenOptions, Options, check_method


@pytest.mark.parametrize("value", ["x", None, [1.0], np.nan, 0, -1.0])
def test_numbers_are_checked(value):
    with pytest.raises(ValueError, match=r"^voxel_size: expected a positive number, got"):
        check_positive("voxel_size", value)
    with pytest.raises(ValueError, match=r"^num_neighbors: expected an integer of at least 3, got"):
        check_integer("num_neighbors", value, 3)
    check_positive("voxel_size", np.float32(0.1))
    check_integer("num_neighbors", np.int64(3), 3)


@pytest.mark.parametrize("function", [mcg.register_batch, mcg.odometry, mcg.multiway])
def test_unknown_options_are_named(function):
    clouds = [np.random.default_rng(0).random((20, 3))] * 2
    given = (clouds, clouds, mcg.GICP()) if function is mcg.register_batch else (clouds, mcg.GICP())
    name = function.__name__
    with pytest.raises(
        TypeError, match=rf"^{name}: got an unexpected argument 'max_distanc'; did you mean max_distance"
    ):
        list(function(*given, max_distanc=1.0).__iter__())
    # Only one pair can have tie points.
    with pytest.raises(
        TypeError, match=rf"^{name}: got an unexpected argument 'tie_points'; expected one of .*voxel_sizes"
    ):
        list(function(*given, tie_points=None).__iter__())


def test_options_are_declared_alike():
    """By `register`, for batches and sequences, and on the command line."""
    declared = {each.name: (each.type, each.default) for each in dataclasses.fields(Options) if each.name != "reach"}
    parameters = inspect.signature(mcg.register).parameters
    assert {name: (parameters[name].annotation, parameters[name].default) for name in declared} == declared
    assert {name: (hint.__forward_arg__, declared[name][1]) for name, hint in GivenOptions.__annotations__.items()} == (
        declared
    )
    assert Options(**CommandOptions().registration()) == Options()


def test_frequent_mistakes_are_named():
    points = np.random.default_rng(0).random((50, 3))
    with pytest.raises(ValueError, match="voxel_sizes: expected the coarsest first"):
        mcg.register(points, points, mcg.NDT(), voxel_sizes=(0.25, 1.0))
    # The check of annotations, which tests may have, would refuse a class first.
    with pytest.raises(ValueError, match=r"method: expected GICP\(\), got the class GICP"):
        inspect.unwrap(check_method)(mcg.GICP)


def test_swapped_arguments_are_named():
    cloud = mcg.preprocess(np.random.default_rng(0).normal(size=(50, 3)))
    matches = mcg.find_correspondences(cloud, cloud, None, mcg.GICP(), max_distance=1.0)
    # Checks of annotations, where they are on, come first.
    errors = ValueError, TypeCheckError
    with pytest.raises(
        errors, match=r"matches: expected the result of find_correspondences, got .*order|parameters of"
    ):
        mcg.mahalanobis_cost(cloud, cloud, np.eye(4), cloud, mcg.GICP())
    with pytest.raises(errors, match=r"pose: expected a jaxlie\.SE3|parameters of"):
        mcg.mahalanobis_cost(cloud, cloud, cloud, matches, mcg.GICP())
    with pytest.raises(errors, match=r"^target: expected a PointCloud, got ndarray; is the order|parameters of"):
        mcg.mahalanobis_cost(cloud, cloud, np.eye(4), matches, mcg.GICP())
    with pytest.raises(errors, match=r"^source: expected a PointCloud, got ndarray; is the order|parameters of"):
        mcg.find_correspondences(np.eye(4), cloud, cloud, mcg.GICP(), max_distance=1.0)
    with pytest.raises(ValueError, match="num_candidates: expected an integer"):
        mcg.D2DNDT(num_candidates=True)


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
    with pytest.raises(ValueError, match="init: expected a rigid motion"):
        mcg.register(cloud, cloud, mcg.GICP(), init=pose + 1e-3 * np.eye(4)[3:])
