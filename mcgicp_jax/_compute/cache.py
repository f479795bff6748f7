"""Values that are kept: caches of bounded size, one of what is computed from clouds, and lazy parts of results."""

from __future__ import annotations

import collections
import threading
import weakref
from collections.abc import Callable, Hashable
from functools import partial, wraps
from typing import Any, Generic, ParamSpec, TypeVar

import jax
import numpy as np

from mcgicp_jax._compute.concrete import is_concrete, outside_trace
from mcgicp_jax._compute.threads import with_settings_of_package

Value = TypeVar("Value")
Parameters = ParamSpec("Parameters")

# Total number of rows of the clouds or trees in a cache: hundreds of scans, some hundred megabytes.
MAX_ROWS = 2_000_000
# Number of values of a function cached per cloud, such as its surfaces for two methods.
_VALUES_PER_FUNCTION = 2


class Cache:
    """Values by key. The least recently used are evicted while the sum of all sizes exceeds a maximum."""

    def __init__(self, max_size: int, size: Callable[[Any], int] = lambda _: 1):
        self._max_size, self._size = max_size, size
        self._lock = threading.Lock()
        self._values: collections.OrderedDict[Hashable, Any] = collections.OrderedDict()
        self._dropped: collections.deque[Hashable] = collections.deque()

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The cached value, or else the result of `make`, which is then cached. Several threads may call this."""
        with self._lock:
            while self._dropped:
                self._values.pop(self._dropped.popleft(), None)
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
        value = make()
        with self._lock:
            self._values[key] = value
            while len(self._values) > 1 and sum(map(self._size, self._values.values())) > self._max_size:
                self._values.popitem(last=False)
        return value

    def drop(self, key: Hashable) -> None:
        """Remove a value at the next `get`. Takes no lock: weak references may call it at any moment."""
        self._dropped.append(key)


class _CachedWithCloud:
    """The cached values of one cloud, by function; dropped when the cloud is collected."""

    def __init__(self, cloud: Any):
        # The callback holds the identity, not the cloud.
        self.num_rows, key = cloud.points.shape[0], id(cloud)
        self.alive = weakref.ref(cloud, lambda _: _clouds.drop(key))
        self.values: dict[Callable[..., Any], Cache] = {}


_clouds = Cache(MAX_ROWS, lambda cached: cached.num_rows)


def cached_with_cloud(compute: Callable[Parameters, Value]) -> Callable[Parameters, Value]:
    """Decorator of functions whose first argument is a cloud. The key of a result is the cloud, by identity, and all
    other arguments, pytrees that are compared by value: nothing that the result depends on can be missing in it. With
    traced arguments nothing is cached.

    Values live no longer than their cloud, any object with `points` that can be referenced weakly, unless they refer to
    it themselves.
    """

    @wraps(compute)
    def cached(*arguments: Parameters.args, **named: Parameters.kwargs) -> Value:
        if not is_concrete(arguments, named):
            return compute(*arguments, **named)
        cloud, *rest = arguments
        leaves, structure = jax.tree.flatten((rest, named))
        for i, leaf in enumerate(leaves):
            if isinstance(leaf, np.ndarray | np.generic | jax.Array | bool | int | float):
                array = np.asarray(leaf)
                leaves[i] = array.dtype.str, array.shape, array.tobytes()
        caches = _clouds.get(id(cloud), partial(_CachedWithCloud, cloud)).values
        cache = caches.get(compute) or caches.setdefault(compute, Cache(_VALUES_PER_FUNCTION))
        return cache.get((structure, *leaves), partial(compute, *arguments, **named))

    return cached


class Lazy(Generic[Value]):
    """A pytree that is computed on first access: by `value`, or when it is flattened, copied or pickled."""

    def __init__(self, compute: Callable[[], Value], finish: Callable[[Value], Value] | None = None):
        """`finish` is applied to the value inside the caller's transformations, `compute` outside of them."""
        self._compute: Callable[[], Value] | None = compute
        self._finish = finish
        self._lock = threading.Lock()
        self._value: Value

    @classmethod
    def of(cls, value: Value) -> Lazy[Value]:
        lazy = cls(lambda: value)
        lazy._compute, lazy._value = None, value
        return lazy

    @property
    def value(self) -> Value:
        with self._lock:
            if self._compute is not None:
                with outside_trace():
                    value = with_settings_of_package(self._compute)()
                self._value = value if self._finish is None else self._finish(value)
                # Frees the arrays that the closures hold.
                self._compute = self._finish = None
        return self._value

    def __reduce__(self) -> Any:
        return Lazy.of, (self.value,)


class Held(Generic[Value]):
    """A value that is dropped when the pytree is copied, pickled or returned by `jit`."""

    def __init__(self, value: Value | None = None):
        self.value = value

    def __reduce__(self) -> Any:
        return Held, ()


jax.tree_util.register_pytree_node(Lazy, lambda lazy: ((lazy.value,), None), lambda _, children: Lazy.of(*children))
jax.tree_util.register_pytree_node(Held, lambda _: ((), None), lambda *_: Held())
