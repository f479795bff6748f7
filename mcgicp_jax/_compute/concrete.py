"""Concrete arrays, which NumPy computes with at once, and traced ones, inside JAX's transformations."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import get_opaque_trace_state
from jax.typing import ArrayLike
from jaxtyping import Array

from mcgicp_jax._compute.devices import on_cpu
from mcgicp_jax._compute.tables import RowsOnDemand

# NumPy arrays (outside transformations) or JAX arrays, and scalars of either kind.
if TYPE_CHECKING:
    AnyArray: TypeAlias = Any
    AnyScalar: TypeAlias = Any
else:
    AnyArray = Array | np.ndarray
    AnyScalar = ArrayLike


@jax.tree_util.register_pytree_node_class
class DeferredRows:
    """A concrete array, such as the neighbours of points, whose rows are computed when they are needed.

    As a pytree it is the whole array: flattening it computes all rows, as do transformations and copies. `compute` is
    as of `RowsOnDemand`. `anew` makes the same object for pickles, so that a worker computes it; with None, pickles
    hold the whole array.
    """

    def __init__(
        self, compute: Callable[[Any, int | None], np.ndarray], shape: tuple[int, ...], anew: Callable[[], Any] | None
    ):
        self.shape, self._anew = shape, anew
        self._table = RowsOnDemand(compute, shape[0])
        self._stand_in: Any = None

    def __getitem__(self, rows: Any) -> np.ndarray:
        return self._table.computed(rows)[rows]

    @property
    def whole(self) -> np.ndarray:
        """All rows, as a read-only array."""
        rows = self._table.computed()
        rows.setflags(write=False)
        return rows

    def tree_flatten(self) -> tuple[tuple[Any], None]:
        return (self.whole if self._stand_in is None else self._stand_in,), None

    @classmethod
    def tree_unflatten(cls, _: None, children: tuple[Any]) -> Any:
        (rows,) = children
        if isinstance(rows, np.ndarray | jax.Array):
            return rows
        # What stands for the array, such as its shape in `jit(...).lower`, keeps the structure of the tree.
        node = object.__new__(cls)
        node._stand_in = rows
        return node

    def __reduce__(self) -> Any:
        return (np.asarray, (self.whole,)) if self._anew is None or self._table.complete else (self._anew, ())


# `isinstance` without a Python function: the first is asked of every node of a tree, the second of every array.
is_deferred: Callable[[object], bool] = DeferredRows.__instancecheck__
is_tracer: Callable[[object], bool] = jax.core.Tracer.__instancecheck__


def is_concrete(*trees: object) -> bool:
    """Whether every array in the trees is concrete, that is, none is a tracer of a JAX transformation."""
    return not any(map(is_tracer, jax.tree.leaves(trees, is_leaf=is_deferred)))


# Traced inside a trace. The call of a program takes a quarter of the time of an operation.
_zero = jax.jit(lambda: jnp.zeros(()))
# The state of JAX's transformations inside the context below; None outside of it.
_outside: ContextVar[Any] = ContextVar("outside", default=None)


@contextlib.contextmanager
def outside_trace() -> Iterator[None]:
    """Context in which concrete arrays are computed at once and on the CPU, even while a caller's `jit` is traced."""
    # Nested contexts are frequent. A `jit` may be traced between them, too.
    if _outside.get() == get_opaque_trace_state():
        yield
        return
    # The second context only inside a trace, since it evaluates operation by operation.
    with on_cpu(), jax.ensure_compile_time_eval() if is_tracer(_zero()) else contextlib.nullcontext():
        before = _outside.set(get_opaque_trace_state())
        try:
            yield
        finally:
            _outside.reset(before)


def canonical_float() -> Any:
    """JAX's default precision: float64 where x64 is on."""
    return jax.dtypes.canonicalize_dtype(np.float64)


def numpy_for(*trees: object) -> ModuleType:
    """NumPy if every array is concrete, so that nothing is compiled; `jax.numpy` if one is traced."""
    # `is_concrete` written out: most formulas ask this.
    return jnp if any(map(is_tracer, jax.tree.leaves(trees, is_leaf=is_deferred))) else np


def constant(tree: Any) -> Any:
    """The tree with gradients stopped; concrete arrays carry none and are returned unchanged (NumPy stays NumPy)."""
    return tree if is_concrete(tree) else jax.lax.stop_gradient(tree)
