"""A cache of quantities computed from a cloud, such as its surface, which lives no longer than the cloud."""

from __future__ import annotations

import collections
import threading
import weakref
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

Value = TypeVar("Value")

# Total number of rows of the clouds in the cache: hundreds of scans, some hundred megabytes.
_KEPT_ROWS = 2_000_000
# Number of values kept per cloud and kind, such as its surfaces for two methods.
_KEPT_EACH = 2


class _Keeper:
    """Values computed from clouds, by identity of the cloud; the least recently used clouds are evicted first."""

    def __init__(self, rows: int):
        self._rows = rows
        self._lock = threading.Lock()
        self._kept: collections.OrderedDict[int, tuple[Any, int, dict[str, dict[Hashable, Any]]]] = (
            collections.OrderedDict()
        )
        # Identities of collected clouds. Weak references report them at any moment, even during a lookup.
        self._gone: collections.deque[int] = collections.deque()

    def get(self, cloud: Any, kind: str, key: Hashable, make: Callable[[], Value]) -> Value:
        """The cached value for this cloud, kind and key, or else the result of `make`, which is then cached."""
        number = id(cloud)
        with self._lock:
            self._forget_gone()
            if number in self._kept:
                self._kept.move_to_end(number)
                values = self._kept[number][2].get(kind, {})
                if key in values:
                    return values[key]
        value = make()
        with self._lock:
            self._forget_gone()
            if number not in self._kept:
                alive = weakref.ref(cloud, lambda _: self._gone.append(number))
                self._kept[number] = alive, cloud.points.shape[0], {}
            values = self._kept[number][2].setdefault(kind, {})
            values[key] = value
            while len(values) > _KEPT_EACH:
                del values[next(iter(values))]
            while len(self._kept) > 1 and sum(rows for _, rows, _ in self._kept.values()) > self._rows:
                self._kept.popitem(last=False)
        return value

    def _forget_gone(self) -> None:
        while self._gone:
            self._kept.pop(self._gone.popleft(), None)


keep = _Keeper(_KEPT_ROWS).get
