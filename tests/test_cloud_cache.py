"""Caches stay small, and values computed from a cloud live no longer than the cloud."""

import gc
import time
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
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
    made, cache = [], Cache(10, size=lambda value: value)
    # A 4 is used again before 5 is made, so that 3 is evicted. A value that is too large alone is cached, too.
    keys = [4, 3, 4, 5, 4, 3, 99, 99]
    assert [cache.get(key, lambda key=key: made.append(key) or key) for key in keys] == keys
    assert made == [4, 3, 5, 3, 99]


def test_a_new_cloud_in_the_place_of_an_old_one_has_no_values():
    """Objects are told apart by identity, which a collected one leaves to others."""
    identities = set()
    number = cached_with_cloud(lambda cloud: i)
    for i in range(50):
        cloud = mcg.PointCloud(np.eye(3))
        identities.add(id(cloud))
        assert number(cloud) == i
        del cloud
        gc.collect(0)
    assert len(identities) < 50


@pytest.mark.slow
def test_a_registration_after_others_of_the_same_clouds_is_that_of_new_clouds(cloud):
    """The cost of matches, photometric terms and another noise each want surfaces of other columns."""
    used = cloud.replace(), cloud.replace()
    matches = mcg.find_correspondences(*used, None, METHOD, max_distance=0.2)
    mcg.mahalanobis_cost(np.eye(4), *used, matches, METHOD)
    for method in (mcg.MultiChannelGICP(0.5, 0.3), mcg.MultiChannelGICP(0.05, 0.3, photometric=True), METHOD) * 2:
        clouds = used, (cloud.replace(), cloud.replace())
        results = [mcg.register(*pair, method, max_distance=0.2) for pair in clouds]
        np.testing.assert_array_equal(*(result.directions.twists for result in results))


class Shifted(mcg.KDTreeSearch):
    """Finds what is nearest to a place beside each point."""

    shift: float = eqx.field(static=True, default=0.0)

    def index(self, target):
        return super().index(target._replace(points=target.points + np.float32(self.shift)))


@pytest.mark.parametrize(
    "options",
    [
        [{"method": mcg.MultiChannelGICP(variance, 0.3)} for variance in (1e-4, 1.0)],
        [{"method": mcg.MultiChannelGICP(0.05, weight)} for weight in (0.01, 0.3)],
        [{"search": search} for search in (Shifted(shift=0.0), Shifted(shift=0.2), mcg.KDTreeSearch())],
    ],
    ids=["missing variances", "weights", "number and type of a search"],
)
def test_matches_of_a_cloud_are_those_of_a_new_one(cloud, options):
    measured = np.random.default_rng(1).random(cloud.channels.shape) < 0.7
    source, target = cloud.replace(channel_valid=measured[::-1]), cloud.replace(channel_valid=measured)

    def rows(source, target, option):
        options = {"method": METHOD, "max_distance": 1.0} | option
        return mcg.find_correspondences(source, target, motion(), **options).indices

    matched = [rows(source, target, option) for option in options]
    assert np.any(matched[0] != matched[1])
    for option, expected in zip(options, matched, strict=True):
        np.testing.assert_array_equal(rows(source, target.replace(), option), expected)
        # There, trees are cached by the content of the target.
        np.testing.assert_array_equal(jax.jit(lambda *clouds, o=option: rows(*clouds, o))(source, target), expected)


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
        values = list(threads.map(lambda rows: table.computed(rows)[rows], wanted))
    np.testing.assert_array_equal(values, 10 * np.array(wanted))
    assert sorted(computed) == list(range(20))
