"""Caches stay small, and values computed from a cloud live no longer than the cloud."""

import copy
import gc
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax._compute.cache import Cache, Lazy, cached_with_cloud
from mcgicp_jax._compute.tables import RowsOnDemand
from mcgicp_jax._methods.surfaces import surface_table
from mcgicp_jax._terms.photometric import Photometric
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


def test_a_dropped_value_is_made_again():
    cache, made = Cache(10), []
    for _ in range(2):
        cache.get("a", lambda: made.append(1))
        cache.drop("a")
    assert len(made) == 2


def test_making_a_value_does_not_block_other_threads():
    cache = Cache(10)

    def slow():
        other = threading.Thread(target=cache.get, args=("fast", lambda: 1))
        other.start()
        other.join(10)
        assert not other.is_alive()
        return 2

    assert cache.get("slow", slow) == 2


def test_a_lazy_value_is_computed_once():
    calls = []
    lazy = Lazy(lambda: calls.append(time.sleep(0.05)))
    with ThreadPoolExecutor(8) as threads:
        assert list(threads.map(lambda _: lazy.value, range(8))) == [None] * 8
    assert len(calls) == 1


def test_two_values_of_each_function_are_cached_with_a_cloud():
    cloud, made = mcg.PointCloud(np.eye(3)), []

    def compute(cloud, number):
        made.append(number)
        return number

    first, second = cached_with_cloud(compute), cached_with_cloud(lambda cloud, number: compute(cloud, number))
    assert [first(cloud, number) for number in (1, 2, 1, 2, 3, 1)] == [1, 2, 1, 2, 3, 1]
    assert made == [1, 2, 3, 1] and second(cloud, 3) == 3 and made[-1] == 3 and len(made) == 5
    first(cloud.replace(), 1)
    assert len(made) == 6


def test_values_cached_with_a_cloud_are_told_apart_by_all_arguments():
    cloud, made = mcg.PointCloud(np.eye(3)), []
    compute = cached_with_cloud(lambda cloud, *arguments, **named: made.append(1))
    weights = np.array([1.0, 2.0])
    different = [
        (mcg.ColorICP(weights),),
        (mcg.ColorICP(weights[::-1].copy()),),
        (mcg.MultiChannelGICP(0.1, weights),),
        (mcg.MultiChannelGICP(0.2, weights),),
        (mcg.MultiChannelGICP(0.2, weights, photometric=True),),
        (mcg.KDTreeSearch(workers=1),),
        (mcg.KDTreeSearch(workers=2),),
        (mcg.KDTreeSearch(workers=1, backend="scipy"),),
        (weights,),
        (weights.astype(np.float32),),
        (weights[:, None],),
        (jnp.asarray(weights), None),
        (None, jnp.asarray(weights)),
        (1, True),
        (1.0, True),
        (1, False),
        ((mcg.GICP,), True),
        ((mcg.GICP, mcg.NDT), True),
    ]
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


def surface_of(cloud, kinds, observed, method=METHOD):
    """What the surface of a cloud has beyond points and covariances, and the covariances."""
    surface, *_ = surface_table(cloud, method, kinds, True, observed).trees()
    return set(surface.columns), surface.observability is not None, surface.covariance


def test_surfaces_of_a_cloud_have_what_was_asked_for(cloud):
    """One after the other, as the cost of matches, a registration and photometric terms ask for them."""
    wanted = [((), False), ((), True), ((Photometric,), True), ((Photometric,), False)]
    for kinds, observed in wanted * 2:
        columns, observability, _ = surface_of(cloud, kinds, observed)
        assert columns == {kind.name for kind in kinds} and observability == observed
    other = surface_of(cloud, (), True, mcg.MultiChannelGICP(0.5, 0.3))[2]
    assert np.abs(other - surface_of(cloud, (), True)[2]).max() > 0.01


def test_a_registration_after_the_cost_of_its_matches_is_that_of_new_clouds(cloud):
    def directions(before):
        source, target = cloud.replace(), cloud.replace()
        if before:
            matches = mcg.find_correspondences(source, target, None, METHOD, max_distance=0.2)
            mcg.mahalanobis_cost(np.eye(4), source, target, matches, METHOD)
        return mcg.register(source, target, METHOD, max_distance=0.2).directions.twists

    np.testing.assert_array_equal(directions(True), directions(False))


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
        [{"method": METHOD, "search": Shifted(shift=shift)} for shift in (0.0, 0.2)],
        [{"method": METHOD, "search": search} for search in (mcg.KDTreeSearch(), Shifted(shift=0.2))],
    ],
    ids=["missing variances", "weights", "number of a search", "type of a search"],
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
        found = list(threads.map(lambda rows: table.known(rows)[rows], wanted))
    np.testing.assert_array_equal(found, 10 * np.array(wanted))
    assert sorted(computed) == list(range(20))
