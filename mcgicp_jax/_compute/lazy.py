"""Lazily computed parts of results."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import jax

from mcgicp_jax._compute.concrete import outside_trace

Value = TypeVar("Value")


@jax.tree_util.register_pytree_node_class
class Lazy(Generic[Value]):
    """A pytree that is computed on first access: by `value`, or when it is flattened, copied or pickled."""

    def __init__(self, compute: Callable[[], Value]):
        self._compute: Callable[[], Value] | None = compute
        self._lock = threading.Lock()
        self._value: Value

    @classmethod
    def of(cls, value: Value) -> Lazy[Value]:
        """A `Lazy` whose value is known already."""
        return cls.tree_unflatten(None, (value,))

    @property
    def value(self) -> Value:
        with self._lock:
            if self._compute is not None:
                with outside_trace():
                    self._value = self._compute()
                # Frees the arrays that the closure holds.
                self._compute = None
        return self._value

    def tree_flatten(self) -> tuple[tuple[Value], None]:
        return (self.value,), None

    @classmethod
    def tree_unflatten(cls, _: None, children: tuple[Value]) -> Lazy[Value]:
        deferred = object.__new__(cls)
        deferred._compute, deferred._lock, deferred._value = None, threading.Lock(), children[0]
        return deferred

    def __reduce__(self) -> Any:
        return Lazy.of, (self.value,)


@jax.tree_util.register_pytree_node_class
class Held(Generic[Value]):
    """A value, or None, that copies of the pytree do not have, so that it lives no longer than the original."""

    def __init__(self, value: Value | None = None):
        self.value = value

    def tree_flatten(self) -> tuple[tuple[()], None]:
        return (), None

    @classmethod
    def tree_unflatten(cls, _: None, __: tuple[()]) -> Held[Value]:
        return cls()

    def __reduce__(self) -> Any:
        return Held, ()
