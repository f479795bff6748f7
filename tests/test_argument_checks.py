"""Arguments of the wrong kind are named."""

import inspect

import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax._compute.argument_checks import check_integer, check_positive
from mcgicp_jax._registration.options import check_method


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


def test_frequent_mistakes_are_named():
    points = np.random.default_rng(0).random((50, 3))
    with pytest.raises(ValueError, match="voxel_sizes: expected the coarsest first"):
        mcg.register(points, points, mcg.NDT(), voxel_sizes=(0.25, 1.0))
    # The check of annotations, which tests may have, would refuse a class first.
    with pytest.raises(ValueError, match=r"method: expected GICP\(\), got the class GICP"):
        inspect.unwrap(check_method)(mcg.GICP)
