"""Caches stay small, and values computed from a cloud live no longer than the cloud."""

import copy
import gc
import time
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax._compute.cache import Cache, cached_with_cloud
from mcgicp_jax._compute.tables import RowsOnDemand
from tests.scenes import motion, room_corner

METHOD = mcg.MultiChannelGICP(0.05, 0.3)


@pytest.fixture
def cloud():
    return mcg.preprocess(mcg.PointCloud(*room_corner(400)))


def test_the_least_recently_used_are_evicted_by_size():
    made = []

    def get(cache, key):
        return cache.get(key, lambda: made.append(key) or key)

    cache = Cache(10, size=lambda value: value)
    # A 4 is used again before 5 is made, so that 3 is evicted.
    assert [get(cache, key) for key in (4, 3, 4, 5, 4, 3)] == [4, 3, 4, 5, 4, 3]
    assert made == [4, 3, 5, 3]
    # A value that is too large alone is cached, too.
    assert [get(cache, key) for key in (99, 99)] == [99, 99] and made == [4, 3, 5, 3, 99]


def test_values_cached_with_a_cloud_are_told_apart_by_all_arguments():
    cloud, made = mcg.PointCloud(np.eye(3)), []
    compute = cached_with_cloud(lambda cloud, *arguments, **named: made.append(1))
    weights = np.array([1.0, 2.0])
    arrays = weights, weights.astype(np.float32), weights[:, None]
    methods = [mcg.ColorICP(each) for each in (weights, weights[::-1].copy())]
    methods += [mcg.MultiChannelGICP(*each) for each in ((0.1, weights), (0.2, weights))]
    methods += [mcg.MultiChannelGICP(0.2, weights, photometric=True)]
    searches = [mcg.KDTreeSearch(*each) for each in ((1,), (2,), (1, "scipy"))]
    several = [(jnp.asarray(weights), None), (None, jnp.asarray(weights)), (1, True), (1.0, True), (1, False)]
    several += [((mcg.GICP,), True), ((mcg.GICP, mcg.NDT), True)]
    different = [*((each,) for each in (*arrays, *methods, *searches)), *several]
    for i, arguments in enumerate(different):
        for _ in range(2):
            compute(cloud, *copy.deepcopy(arguments))
            assert len(made) == i + 1, arguments
    compute(cloud, flag=True), compute(cloud, flag=False)
    assert len(made) == len(different) + 2


def test_a_new_cloud_in_the_place_of_an_old_one_has_no_values():
    """Objects are told apart by identity, which a collected one leaves to others."""
    numbers = set()
    number = cached_with_cloud(lambda cloud: now)
    for i in range(50):
        cloud = mcg.PointCloud(np.eye(3))
        numbers.add(id(cloud))
        now = i
        assert number(cloud) == i
        del cloud
        gc.collect(0)
    assert len(numbers) < 50


@pytest.mark.slow
def test_a_registration_after_others_of_the_same_clouds_is_that_of_new_clouds(cloud):
    """The cost of matches, photometric terms and another noise each want surfaces of other columns."""
    methods = mcg.MultiChannelGICP(0.5, 0.3), mcg.MultiChannelGICP(0.05, 0.3, photometric=True), METHOD

    def directions(source, target, method):
        return mcg.register(source, target, method, max_distance=0.2).directions.twists

    used = cloud.replace(), cloud.replace()
    matches = mcg.find_correspondences(*used, None, METHOD, max_distance=0.2)
    mcg.mahalanobis_cost(np.eye(4), *used, matches, METHOD)
    for method in methods * 2:
        np.testing.assert_array_equal(directions(*used, method), directions(cloud.replace(), cloud.replace(), method))


class Shifted(mcg.KDTreeSearch):
    """Finds what is nearest to a place beside each point."""

    shift: float = eqx.field(static=True, default=0.0)

    def index(self, target):
        return super().index(target._replace(points=target.points + np.float32(self.shift)))


@pytest.mark.parametrize(
    "arguments",
    [
        [{"method": mcg.MultiChannelGICP(variance, 0.3)} for variance in (1e-4, 1.0)],
        [{"method": mcg.MultiChannelGICP(0.05, weight)} for weight in (0.01, 0.3)],
        [
            {"method": METHOD, "search": search}
            for search in (Shifted(shift=0.0), Shifted(shift=0.2), mcg.KDTreeSearch())
        ],
    ],
    ids=["missing variances", "weights", "number and type of a search"],
)
def test_matches_of_a_cloud_are_those_of_a_new_one(cloud, arguments):
    known = np.random.default_rng(1).random(cloud.channels.shape) < 0.7
    source, target = cloud.replace(channel_valid=known[::-1]), cloud.replace(channel_valid=known)

    def rows(source, target, given):
        return mcg.find_correspondences(source, target, motion(), max_distance=1.0, **given).indices

    found = [rows(source, target, given) for given in arguments]
    assert np.any(found[0] != found[1])
    for given, each in zip(arguments, found, strict=True):
        np.testing.assert_array_equal(each, rows(source, target.replace(), given))
        # There, trees are cached by the content of the target.
        inside = jax.jit(lambda *clouds, given=given: rows(*clouds, given))(source, target)
        np.testing.assert_array_equal(each, inside)


def test_rows_are_computed_once_by_threads_that_share_a_table():
    computed = []

    def compute(rows, _):
        rows = np.arange(20) if rows is None else rows
        time.sleep(0.02)
        computed.extend(rows.tolist())
        return 10 * rows

    table = RowsOnDemand(compute, 20)
    wanted = [np.arange(k, k + 10) for k in (0, 5, 0, 10, 5, 3, 0, 10)]
    with ThreadPoolExecutor(len(wanted)) as threads:
        found = list(threads.map(lambda rows: table.computed(rows)[rows], wanted))
    np.testing.assert_array_equal(found, 10 * np.array(wanted))
    assert sorted(computed) == list(range(20))
