"""Concrete arrays, which NumPy computes with at once, and traced ones, inside JAX's transformations."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from itertools import chain
from operator import attrgetter
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


class DeferredRows:
    """An array, such as the neighbours of points, whose rows may be computed when they are needed.

    As a pytree it is a node with the whole array: flattening it computes all rows, as do transformations, whose results
    hold nodes with traced or whole arrays. `compute` is as of `RowsOnDemand`. `anew` makes the same object for pickles,
    so that a worker computes it; with None, pickles hold the whole array.
    """

    _table: RowsOnDemand[np.ndarray] | None
    _whole: Any = None

    def __init__(
        self, compute: Callable[[Any, int | None], np.ndarray], shape: tuple[int, ...], anew: Callable[[], Any] | None
    ):
        self.shape, self._anew, self._table = shape, anew, RowsOnDemand(compute, shape[0])

    @classmethod
    def of(cls, whole: Any) -> DeferredRows:
        """Rows that are known: a concrete or traced array, or what stands for one, such as its shape."""
        rows = object.__new__(cls)
        rows.shape, rows._table, rows._whole = getattr(whole, "shape", ()), None, whole
        return rows

    def __getitem__(self, rows: Any) -> Any:
        return self._whole[rows] if self._table is None else self._table.computed(rows)[rows]

    @property
    def whole(self) -> Any:
        """All rows; those that were computed as a read-only array."""
        if self._table is None:
            return self._whole
        rows = self._table.computed()
        rows.setflags(write=False)
        return rows

    def __reduce__(self) -> Any:
        if self._table is None or self._table.complete or self._anew is None:
            return DeferredRows.of, (self.whole,)
        return self._anew, ()


jax.tree_util.register_pytree_node(
    DeferredRows, lambda rows: ((rows.whole,), None), lambda _, children: DeferredRows.of(*children)
)


def is_deferred(node: object) -> bool:
    """Whether a node of a tree is a concrete array of which some rows may not be computed yet."""
    return isinstance(node, DeferredRows) and node._table is not None


# `isinstance` without a Python function, since these are asked of every array and of every node of a tree.
is_tracer: Callable[[object], bool] = jax.core.Tracer.__instancecheck__
has_rows: Callable[[object], bool] = DeferredRows.__instancecheck__
_known_rows = attrgetter("_whole")


def is_concrete(*trees: object) -> bool:
    """Whether every array in the trees is concrete, that is, none is a tracer of a JAX transformation."""
    leaves = jax.tree.leaves(trees, is_leaf=has_rows)
    return not any(map(is_tracer, chain(leaves, map(_known_rows, filter(has_rows, leaves)))))


# Traced inside a trace. The call of a program takes a quarter of the time of an operation.
_zero = jax.jit(lambda: jnp.zeros(()))


def with_numpy_constants(tree: Any) -> Any:
    """The tree with its concrete JAX arrays, but those of `DeferredRows`, in NumPy inside a trace, where the result of
    any operation on them would be a tracer."""
    leaves, structure = jax.tree.flatten(tree, is_leaf=has_rows)
    constants = {i for i, leaf in enumerate(leaves) if isinstance(leaf, jax.Array) and not is_tracer(leaf)}
    if not constants or not is_tracer(_zero()):
        return tree
    leaves = [np.asarray(leaf) if i in constants else leaf for i, leaf in enumerate(leaves)]
    return jax.tree.unflatten(structure, leaves)


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


def constants_computed(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator of functions whose concrete arguments are constants: computed at once, even while a caller's `jit` is
    traced."""

    @functools.wraps(function)
    def computed(*arguments: Any, **named: Any) -> Any:
        with outside_trace() if is_concrete(arguments, named) else contextlib.nullcontext():
            return function(*arguments, **named)

    return computed


def numpy_for(*trees: object) -> ModuleType:
    """NumPy if every array is concrete, so that nothing is compiled; `jax.numpy` if one is traced."""
    # `is_concrete` written out: most formulas ask this.
    leaves = jax.tree.leaves(trees, is_leaf=has_rows)
    return jnp if any(map(is_tracer, chain(leaves, map(_known_rows, filter(has_rows, leaves))))) else np


def constant(tree: Any) -> Any:
    """The tree with gradients stopped; concrete arrays carry none and are returned unchanged (NumPy stays NumPy)."""
    return tree if is_concrete(tree) else jax.lax.stop_gradient(tree)
