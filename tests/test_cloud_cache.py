"""Caches stay small, and values computed from a cloud live no longer than the cloud."""

import gc
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax._compute.cache import Cache, cached_with
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


def test_two_values_of_each_kind_are_cached_with_a_cloud():
    cloud, made = mcg.PointCloud(np.eye(3)), []

    def get(kind, key):
        return cached_with(cloud, kind, key, lambda: made.append(key) or key)

    assert [get("a", key) for key in (1, 2, 1, 2, 3, 1)] == [1, 2, 1, 2, 3, 1]
    assert made == [1, 2, 3, 1] and get("b", 3) == 3 and made[-1] == 3 and len(made) == 5
    same = cloud.replace()
    assert cached_with(same, "a", 1, lambda: "of the other cloud") == "of the other cloud"


def test_a_new_cloud_in_the_place_of_an_old_one_has_no_values():
    """Objects are told apart by identity, which a collected one leaves to others."""
    numbers = set()
    for i in range(50):
        cloud = mcg.PointCloud(np.eye(3))
        numbers.add(id(cloud))
        assert cached_with(cloud, "number", None, lambda i=i: i) == i
        del cloud
        gc.collect(0)
    assert len(numbers) < 50
