"""What has been computed of a cloud is kept as long as the cloud is used."""

from __future__ import annotations

import collections
import threading
import weakref
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

from mcgicp_jax._cloud import PointCloud

Value = TypeVar("Value")

# Rows of the clouds that something is kept of: hundreds of scans, some hundred megabytes.
_KEPT_ROWS = 2_000_000
# What is kept of one cloud for each kind of thing, such as surfaces of different methods.
_KEPT_EACH = 2


class _Keeper:
    """What has been computed of clouds, by the identity of the cloud; of the least recently used, it goes first."""

    def __init__(self, rows: int):
        self._rows = rows
        self._lock = threading.Lock()
        self._kept: collections.OrderedDict[int, tuple[Any, int, dict[str, dict[Hashable, Any]]]] = (
            collections.OrderedDict()
        )
        # Identities of clouds that are no more. Their end may come at any moment, as in the middle of a lookup.
        self._gone: collections.deque[int] = collections.deque()

    def get(self, cloud: PointCloud, kind: str, key: Hashable, make: Callable[[], Value]) -> Value:
        """What was made before for this cloud, kind and key, or else what `make` returns."""
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
