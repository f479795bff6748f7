"""Caches stay small, and values computed from a cloud live no longer than the cloud."""

import copy
import gc
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax._compute.cache import Cache, cached_with_cloud
from mcgicp_jax._compute.lazy import Lazy


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
