"""Derivatives of values that NumPy computed from concrete arrays: linear maps that compile nothing for any shape."""

from __future__ import annotations

import abc
import itertools
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Float, Int
from scipy.sparse import csr_array

from mcgicp_jax._compute.concrete import AnyArray, has_rows, is_concrete, is_tracer
from mcgicp_jax._compute.threads import in_new_thread, side_by_side, with_settings_of_package


class AbstractLinearMap(abc.ABC):
    """The derivative of values by inputs, in NumPy. The first axis of all arrays counts the tangents or cotangents."""

    # Whether compiled programs run.
    runs_programs = False

    @abc.abstractmethod
    def jvp(self, tangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> Sequence[np.ndarray]:
        """Tangents of the values, one array (m, ...) for each, from those of the inputs with numbers `moving`."""

    @abc.abstractmethod
    def vjp(self, cotangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> Sequence[np.ndarray]:
        """Cotangents of the inputs with numbers `moving`, one array (m, ...) for each, from those of the values."""


@dataclass(frozen=True, eq=False)
class KnownJacobian(AbstractLinearMap):
    """The derivative of one value of k numbers, (k, ...) by each of several arrays."""

    blocks: Sequence[np.ndarray]

    def jvp(self, tangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        pairs = zip(tangents, [self.blocks[i] for i in moving], strict=True)
        return [sum(slope.reshape(len(slope), -1) @ block.reshape(len(block), -1).T for slope, block in pairs)]

    def vjp(self, cotangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        return [np.tensordot(cotangents[0], self.blocks[i], 1) for i in moving]


class SideBySide(AbstractLinearMap):
    """Several maps, each with one value and its own inputs, of which `counts` are the numbers; computed in threads."""

    runs_programs = True

    def __init__(self, maps: Sequence[AbstractLinearMap], counts: Sequence[int]):
        self._maps, self._starts = maps, np.cumsum([0, *counts])

    def _parts(self, moving: tuple[int, ...]) -> Iterator[tuple[AbstractLinearMap, tuple[int, ...]]]:
        """Each map with the numbers of its inputs that are moving."""
        for linear, (start, stop) in zip(self._maps, itertools.pairwise(self._starts.tolist()), strict=True):
            yield linear, tuple(i - start for i in moving if start <= i < stop)

    def jvp(self, tangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        rest, parts = iter(tangents), self._parts(moving)
        values = side_by_side([partial(linear.jvp, [next(rest) for _ in inputs], inputs) for linear, inputs in parts])
        return [value for (value,) in values]

    def vjp(self, cotangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        parts = zip(cotangents, self._parts(moving), strict=True)
        results = side_by_side([partial(linear.vjp, [cotangent], inputs) for cotangent, (linear, inputs) in parts])
        return list(itertools.chain.from_iterable(results))


def primal(tree: Any) -> Any:
    """The tree with NumPy values in place of tracers of `grad` and `jvp`. Tracers of `jit` and `vmap` remain."""
    # Deferred rows are integers, which derivatives do not trace.
    leaves, structure = jax.tree.flatten(tree, is_leaf=has_rows)
    if not any(map(is_tracer, leaves)):
        return tree
    for i, leaf in enumerate(leaves):
        if is_tracer(leaf):
            fixed = jax.lax.stop_gradient(leaf)
            leaves[i] = leaf if is_tracer(fixed) else np.asarray(fixed)
    return jax.tree.unflatten(structure, leaves)


def with_derivative(values: Sequence[np.ndarray], linear: AbstractLinearMap, inputs: Sequence[Any]) -> list[jax.Array]:
    """The values with a derivative by `inputs`, which differentiation traces; an outer one raises an error."""

    @jax.custom_jvp
    def attached(*inputs: Any) -> list[jax.Array]:
        return [jnp.asarray(value) for value in values]

    @partial(attached.defjvp, symbolic_zeros=True)
    @with_settings_of_package
    def rule(inputs: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[list[jax.Array], list[jax.Array]]:
        # An outer differentiation, even by other inputs, would see constants.
        for array in inputs:
            differentiable_once(array)
        outputs = [jnp.asarray(value) for value in values]
        moving = tuple(i for i, tangent in enumerate(tangents) if not is_symbolic_zero(tangent))
        if not moving:
            return outputs, [jnp.zeros_like(value) for value in outputs]
        # Inside differentiation JAX compiles programs separately: they would compile again here and in their threads.
        run = in_new_thread if linear.runs_programs else operator.call
        slopes = _linear.bind(
            *(tangents[i] for i in moving),
            function=lambda arrays: run(partial(linear.jvp, arrays, moving)),
            transpose=lambda arrays: run(partial(linear.vjp, arrays, moving)),
            inputs=tuple(jax.typeof(inputs[i]) for i in moving),
            outputs=tuple(map(jax.typeof, outputs)),
            batch=(),
        )
        return outputs, slopes

    return attached(*inputs)


class RowAverage(AbstractLinearMap):
    """Each row of the result is the mean of some rows: `rows[i]` of the array counts in row `groups[i]` of the result,
    with those of its entries that are `counted`, (n, C) or (n, 1). `sizes`: numbers of rows of array and result."""

    def __init__(self, rows: Int[np.ndarray, "n"], groups: Int[np.ndarray, "n"], counted: Any, sizes: tuple[int, int]):
        ones = np.ones(len(rows))
        self._sum = csr_array((ones, (groups, np.arange(len(rows)))), shape=(sizes[1], len(rows)))
        counts = np.maximum(self._sum @ counted.astype(np.float64), 1)
        self._rows, self._weights, self._size = rows, counted / counts[groups], sizes[0]

    def jvp(self, tangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        (tangent,) = tangents
        shape, size = tangent.shape[2:], self._sum.shape[0]
        flat = tangent.reshape(*tangent.shape[:2], math.prod(shape))[:, self._rows]
        return [np.stack([(self._sum @ (self._weights * rows)).reshape(size, *shape) for rows in flat])]

    def vjp(self, cotangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        (cotangent,) = cotangents
        shape = cotangent.shape[2:]
        by_rows = np.zeros((len(cotangent), self._size, *shape), cotangent.dtype)
        for rows, by in zip(by_rows, cotangent.reshape(*cotangent.shape[:2], math.prod(shape)), strict=True):
            rows[self._rows] = (self._weights * (self._sum.T @ by)).reshape(len(self._rows), *shape)
        return [by_rows]


@with_settings_of_package
def averaged(values: Float[AnyArray, "N D"], groups: Int[np.ndarray, "N"]) -> Float[AnyArray, "M D"]:
    """The mean of the rows of each group; −1: of none. Outside of `jit` summed in float64, and nothing is compiled."""
    rows = np.flatnonzero(groups >= 0)
    groups = groups[rows]
    counts, fixed = np.bincount(groups), primal(values)
    if not is_concrete(fixed):
        sums = jax.ops.segment_sum(values[rows], groups, len(counts))
        return sums / np.maximum(counts, 1)[:, None].astype(values.dtype)
    average = RowAverage(rows, groups, np.ones((len(rows), 1)), (len(fixed), len(counts)))
    (mean,) = average.jvp([np.asarray(fixed)[None]], (0,))
    mean = mean[0].astype(fixed.dtype)
    return mean if is_concrete(values) else with_derivative([mean], average, [values])[0]


def is_symbolic_zero(tangent: object) -> bool:
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


@jax.custom_jvp
def differentiable_once(value: Any) -> Any:
    """The value. Its derivative raises an error, because second derivatives would be wrong."""
    return value


@partial(differentiable_once.defjvp, symbolic_zeros=True)
def _differentiable_once_jvp(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
    if not is_symbolic_zero(tangents[0]):
        raise NotImplementedError("poses have first derivatives only; costs have second ones inside jit alone")
    return primals[0], jnp.zeros_like(primals[0])


# Applies `function`, a linear map of NumPy arrays with one leading axis; `transpose` is its transpose. The shapes of
# `inputs` and `outputs` are without the axes `batch`, which `vmap` adds in front.
_linear = Primitive("mcgicp_linear")
_linear.multiple_results = True


@_linear.def_impl
@with_settings_of_package
def _call(*operands: Any, function: Callable, transpose: Callable, inputs: Any, outputs: Any, batch: Any) -> list[Any]:
    count = math.prod(batch)
    arrays = [np.asarray(array).reshape((count, *aval.shape)) for array, aval in zip(operands, inputs, strict=True)]
    return [
        jax.device_put(np.asarray(result, aval.dtype).reshape((*batch, *aval.shape)))
        for result, aval in zip(function(arrays), outputs, strict=True)
    ]


def _transposed(cotangents: Any, *_: Any, function: Any, transpose: Any, inputs: Any, outputs: Any, batch: Any) -> Any:
    swapped = {"function": transpose, "transpose": function, "inputs": outputs, "outputs": inputs}
    return _linear.bind(*map(ad.instantiate_zeros, cotangents), **swapped, batch=batch)


def _batched(operands: Any, axes: Any, *, batch: Any, **parameters: Any) -> Any:
    (size,) = {array.shape[axis] for array, axis in zip(operands, axes, strict=True) if axis is not None}
    first = [
        jnp.broadcast_to(array, (size, *array.shape)) if axis is None else jnp.moveaxis(array, axis, 0)
        for array, axis in zip(operands, axes, strict=True)
    ]
    results = _linear.bind(*first, batch=(size, *batch), **parameters)
    return results, [0] * len(results)


def _refused(*_: Any, message: str, **__: Any) -> Any:
    raise NotImplementedError(message)


_linear.def_abstract_eval(lambda *_, outputs, batch, **__: [a.update(shape=(*batch, *a.shape)) for a in outputs])
ad.deflinear2(_linear, _transposed)
batching.primitive_batchers[_linear] = _batched
# A callback would run compiled programs, which was seen to deadlock.
_ADVICE = "the derivative of a registration outside of jit was to be compiled; put the registration inside the jit, too"
mlir.register_lowering(_linear, partial(_refused, message=_ADVICE))


def without_derivative(tree: Any, inputs: Any, message: str) -> Any:
    """The arrays of a tree, which depend on `inputs`, but have no derivative by them: reverse mode raises
    `NotImplementedError` with the message where it would use it, and forward mode gives NaN."""
    leaves = jax.tree.leaves(inputs, is_leaf=has_rows)
    tracers = [leaf for leaf in leaves if is_tracer(leaf) and _is_float(leaf)]
    if not tracers:
        return tree

    @jax.custom_jvp
    def constant_by(value: Any, *inputs: Any) -> Any:
        return value

    @partial(constant_by.defjvp, symbolic_zeros=True)
    def rule(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
        value = primals[0]
        moving = [tangent for tangent in tangents if not is_symbolic_zero(tangent)]
        tangent = _unknown.bind(*moving, aval=jax.typeof(value), message=message) if moving else jnp.zeros_like(value)
        return value, tangent

    return jax.tree.map(lambda leaf: constant_by(jnp.asarray(leaf), *tracers) if _is_float(leaf) else leaf, tree)


def _is_float(leaf: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(leaf), jnp.floating)


# The tangent of what has no derivative.
_unknown = Primitive("mcgicp_unknown")

_nan = _unknown.def_impl(lambda *_, aval, message: jnp.full(aval.shape, jnp.nan, aval.dtype))
_unknown.def_abstract_eval(lambda *_, aval, message: aval)


def _unknown_batched(operands: Any, axes: Any, *, aval: Any, message: str) -> Any:
    (size,) = {array.shape[axis] for array, axis in zip(operands, axes, strict=True) if axis is not None}
    return _unknown.bind(*operands, aval=aval.update(shape=(size, *aval.shape)), message=message), 0


ad.primitive_transposes[_unknown] = _refused
batching.primitive_batchers[_unknown] = _unknown_batched
mlir.register_lowering(_unknown, mlir.lower_fun(_nan, multiple_results=False))
