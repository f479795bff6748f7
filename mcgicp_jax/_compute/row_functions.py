"""Row functions: one way over the rows of clouds of any size, on the host and inside transformations, with derivatives.

A *row function* is pure JAX: `function(numbers, *rows)` maps some numbers, a pytree, and the `Rows` of one or more
tables to one row each, or to a sum over them. A *table* is a pytree of arrays that share their rows: given, or computed
by a row function from the rows of other tables when they are first used.

JAX compiles a program for every shape of its arguments. On the host, row functions are therefore called for blocks of a
fixed number of rows, gathered by NumPy, and so are their vector-Jacobian and Jacobian-vector products: a cloud of
another size compiles nothing. Sums are added in float64 in the order of the blocks: they are bitwise the same for any
number of threads. Inside `jit` and `vmap` the function is applied to whole arrays.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_array

from mcgicp_jax._compute.concrete import is_concrete, is_tracer, outside_trace
from mcgicp_jax._compute.linear_maps import AbstractLinearMap, primal, with_derivative
from mcgicp_jax._compute.programs import quickly_compiled
from mcgicp_jax._compute.tables import BLOCK, NEIGHBORHOOD_BLOCK, Block, Layout, Packed, RowsOnDemand, blocks
from mcgicp_jax._compute.threads import in_new_thread, num_cores, side_by_side, with_settings_of_package

# Points. Inside transformations, neighbourhoods of more points are processed in blocks, too: on CPUs XLA sums over the
# first axis of a wider table column by column, which is twenty times slower.
_LARGEST_WHOLE = 16_000
# Largest number of points in such a block; below the limit above.
_LARGEST_BLOCK = 8192

# Arrays by which a derivative is taken, by identity; and (c, ...) or (N, c, ...) tangents or cotangents of these.
Moving = frozenset[int]
Slopes = dict[int, Any]
# The places of the leaves of the numbers, and of the leaves of each input, by which a derivative is taken.
Places = tuple[tuple[int, ...], ...]


class Rows(NamedTuple):
    """Rows of a table, as a row function sees them.

    Attributes:
        tree: of arrays (n, ...), or (k, n, ...) where each row has k rows of the table.
        index: (n,) or (k, n) numbers of these rows; −1 where there is none.
    """

    tree: Any
    index: Int[Any, "*k n"]


class Input(NamedTuple):
    """A table and the rows of it that row i of the result uses: row i, or the rows `index[i]`.

    Attributes:
        table: a `Table`, or a pytree of arrays, also traced ones.
        index: None, or (N,) or (N, k) row numbers, −1 where there is none; anything that row numbers select from.
        part: which of the trees of the table.
    """

    table: Any
    index: Any = None
    part: int = 0


class GivenTable:
    """A table of NumPy arrays, some of which differentiation may trace. Methods are as of `ComputedTable`."""

    def __init__(self, tree: Any):
        self._leaves = jax.tree.leaves(tree)
        self._packed = (Packed.of(jax.tree.map(np.asarray, primal(tree))),)
        self.size = len(self._packed[0].table)

    @property
    def arrays(self) -> dict[int, Any]:
        return {id(leaf): leaf for leaf in self._leaves}

    def computed(self, rows: Any = None, num_threads: int | None = 1) -> tuple[Packed, ...]:
        return self._packed

    def columns(self, moving: Moving) -> tuple[int, ...]:
        return tuple(i for i, leaf in enumerate(self._leaves) if id(leaf) in moving)

    def vjp(self, cotangents: Any, moving: Moving, into: Slopes, rows: Any = None) -> None:
        leaves = [self._leaves[i] for i in self.columns(moving)]
        ends = np.cumsum([math.prod(leaf.shape[1:]) for leaf in leaves])
        for leaf, part in zip(leaves, np.split(cotangents, ends[:-1], axis=-1), strict=True):
            slope = part.swapaxes(0, 1).astype(np.float64, copy=False)
            slope, before = slope.reshape(len(slope), *leaf.shape), into.get(id(leaf))
            into[id(leaf)] = slope if before is None else before + slope

    def jvp(self, tangents: Slopes, rows: Any) -> np.ndarray:
        leaves = [tangents[id(self._leaves[i])] for i in self.columns(frozenset(tangents))]
        return np.concatenate([leaf.reshape(*leaf.shape[:2], -1) for leaf in leaves], axis=-1).swapaxes(0, 1)[rows]


class RowFunction:
    """A row function with its arguments, on the host.

    `function` is defined at module level or cached, since its programs are kept for it. It returns a sum, a pytree, or
    a tuple of pytrees of arrays with one row each. Rows with the index −1 must not add to a sum (`total`).
    """

    def __init__(self, function: Any, numbers: Any, inputs: Sequence[Input], size: int, total: bool = False):
        self._function, self.size, self.total = function, size, total
        self._inputs = [
            entry if isinstance(entry.table, Table) else entry._replace(table=GivenTable(entry.table))
            for entry in inputs
        ]
        self._leaves = jax.tree.leaves(numbers)
        self._numbers = primal(numbers)

    def at(self, first: Sequence[Any]) -> RowFunction:
        """The same with other values of the first leaves of the numbers, which are concrete."""
        moved = copy.copy(self)
        leaves, structure = jax.tree.flatten(self._numbers)
        moved._numbers = jax.tree.unflatten(structure, [*first, *leaves[len(first) :]])
        return moved

    @cached_property
    def arrays(self) -> dict[int, Any]:
        """The numbers, and the arrays on which the tables depend, by identity."""
        arrays = {id(leaf): leaf for leaf in self._leaves}
        for entry in self._inputs:
            arrays |= entry.table.arrays
        return arrays

    @cached_property
    def tracers(self) -> list[Any]:
        return [array for array in self.arrays.values() if is_tracer(array)]

    def rows(self, rows: Int[np.ndarray, "n"] | None = None, num_threads: int | None = 1) -> tuple[Packed, ...]:
        row_blocks, results = self._over_blocks(rows, num_threads)
        size = row_blocks[-1][0].stop
        tables = [np.empty((size, *part.table.shape[1:]), part.table.dtype) for part in results[0]]
        for (places, _), parts in zip(row_blocks, results, strict=True):
            for table, part in zip(tables, parts, strict=True):
                table[places] = np.asarray(part.table)[: places.stop - places.start]
        return tuple(map(Packed, tables, [part.layout for part in results[0]]))

    def sums(self, num_threads: int | None = 1, packed: bool = True) -> list[Any]:
        """The sum over each block. Programs may not have ended."""
        return self._over_blocks(None, num_threads, packed)[1]

    @with_settings_of_package
    def _over_blocks(self, rows: Any, num_threads: int | None, packed: bool = True) -> tuple[list[Block], list[Any]]:
        """The blocks, and the result for each."""
        gathered = _Gathered(self._inputs, self.size, self.total, rows, num_threads)
        program = _program(self._function, self.total, packed)

        def run(_: slice, index: Any) -> Any:
            return program(self._numbers, *gathered.block(index))

        # Worker threads run outside a trace that is active in this thread; this thread leaves it for the same results.
        with outside_trace():
            return gathered.blocks, side_by_side([partial(run, *block) for block in gathered.blocks], num_threads)

    def value_and_jacobian(self, wanted: Sequence[int]) -> tuple[np.ndarray, list[np.ndarray]]:
        """A sum, packed, and its derivative (L, ...) by the leaves of `numbers` with these numbers; float64."""
        program = _jacobian_program(self._function, (tuple(wanted), *(() for _ in self._inputs)))
        gathered = _Gathered(self._inputs, self.size, self.total)
        results = gathered.in_order(lambda _, index: program(self._numbers, *gathered.block(index)))
        parts = [jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), part) for part in results]
        return reduce(partial(jax.tree.map, np.add), parts)

    def cotangents(self, cotangents: np.ndarray, leaves: Sequence[Any]) -> list[np.ndarray]:
        """Cotangents (c, ...) of some arrays, from those of the sum or of the rows, as `vjp` takes them."""
        into: Slopes = {}
        self.vjp(cotangents, frozenset(map(id, leaves)), into)
        count = cotangents.shape[0 if self.total else 1]
        return [into.get(id(leaf), np.zeros((count, *np.shape(leaf)))) for leaf in leaves]

    def vjp(self, cotangents: Any, moving: Moving, into: Slopes, rows: Int[np.ndarray, "n"] | None = None) -> None:
        """Add the cotangents of what is moving to `into`, from those of the sum, (c, L), packed, or of the rows,
        (N, c, L). `rows`: those whose cotangents are not 0; None for all."""
        numbers, *columns = places_of_leaves = self._places_of(moving)
        if not any(places_of_leaves):
            return
        gathered = _Gathered(self._inputs, self.size, self.total, rows)
        program = _vjp_program(self._function, self.total, places_of_leaves)

        def run(places: slice, index: Any) -> Any:
            packs, indices = gathered.block(index)
            of_block = cotangents
            if not self.total:
                of_rows = cotangents[places if rows is None else rows[places]]
                of_block = np.zeros((gathered.block_size, *of_rows.shape[1:]), of_rows.dtype)
                of_block[: len(of_rows)] = of_rows
            return places, indices, *jax.tree.map(np.asarray, program(self._numbers, packs, indices, of_block))

        rows_of_tables = {j: gathered.rows_of_table(j) for j, places in enumerate(columns) if places}
        slopes: dict[int, np.ndarray] = {}
        scratch: dict[int, np.ndarray] = {}
        for places, indices, by_numbers, by_rows in gathered.in_order(run):
            for i, by in zip(numbers, by_numbers, strict=True):
                key = id(self._leaves[i])
                into[key] = into.get(key, 0) + by.astype(np.float64)
            count = places.stop - places.start
            for j, rows_of_table in rows_of_tables.items():
                of_rows, by = indices[j][..., :count], by_rows[j][..., :count, :, :]
                if j not in slopes:
                    size = self._inputs[j].table.size
                    slopes[j], scratch[j] = np.zeros((size, *by.shape[-2:]), by.dtype), np.empty(size, int)
                index = gathered.indices[j]
                if index is None or index.size == rows_of_table.size:
                    # No row occurs twice, and none is missing (−1).
                    slopes[j][of_rows] = by
                else:
                    _add_rows(slopes[j], of_rows, by, scratch[j])
        for j, slope in slopes.items():
            self._inputs[j].table.vjp(slope, moving, into, rows_of_tables[j])

    def jvp(self, tangents: Slopes, rows: Int[np.ndarray, "n"] | None = None) -> np.ndarray:
        """Tangents (c, L) of the sum, packed, or (n, c, L) of the rows, from those (c, ...) of arrays. A scalar 0 if it
        depends on none of them."""
        numbers, *columns = places_of_leaves = self._places_of(frozenset(tangents))
        if not any(places_of_leaves):
            return np.zeros(())
        gathered = _Gathered(self._inputs, self.size, self.total, rows)
        program = _jvp_program(self._function, self.total, places_of_leaves)
        by_numbers = [tangents[id(self._leaves[i])].astype(np.result_type(self._leaves[i])) for i in numbers]
        slopes: dict[int, np.ndarray] = {}
        for j, table in ((j, self._inputs[j].table) for j, places in enumerate(columns) if places):
            rows_of_table = gathered.rows_of_table(j)
            by = table.jvp(tangents, rows_of_table)
            slopes[j] = np.zeros((table.size, *by.shape[1:]), by.dtype)
            slopes[j][rows_of_table] = by

        def run(places: slice, index: Any) -> np.ndarray:
            packs, indices = gathered.block(index)
            by_rows = [
                np.moveaxis(slopes[j][np.maximum(index, 0)], -2, 0).astype(pack.table.dtype) if j in slopes else None
                for j, (pack, index) in enumerate(zip(packs, indices, strict=True))
            ]
            result = np.asarray(program(self._numbers, packs, indices, by_numbers, by_rows))
            return result.astype(np.float64) if self.total else result[:, : places.stop - places.start]

        results = list(gathered.in_order(run))
        return np.sum(results, axis=0) if self.total else np.concatenate(results, axis=1).swapaxes(0, 1)

    def _places_of(self, moving: Moving) -> Places:
        """The places of the numbers, and of the columns of each input, that depend on the moving arrays."""
        numbers = tuple(i for i, leaf in enumerate(self._leaves) if id(leaf) in moving)
        return numbers, *(() if entry.part else entry.table.columns(moving) for entry in self._inputs)


class ComputedTable(RowFunction):
    """The result of a row function, whose rows are computed when they are first used. Threads may share it.

    Only the first tree is differentiable. Derivatives cover the `columns` that depend on differentiated inputs.
    `values` is a table with the same values, from which rows are taken. `computed` gives the packed trees, in which
    some rows (None: all) are computed, and others may not be.
    """

    def __init__(self, function: Any, numbers: Any, inputs: Sequence[Input], size: int, values: Any = None):
        super().__init__(function, numbers, inputs, size)
        # Of a copy: the cycle of `self.rows` would keep the table until garbage is collected.
        table = RowsOnDemand(copy.copy(self).rows, size)
        self.computed = table.computed if values is None else values.computed

    def trees(self, rows: Int[np.ndarray, "n"] | None = None, num_threads: int | None = 1) -> tuple[Any, ...]:
        """The trees: of all rows, views that must not be changed, or copies of some rows."""
        packs = self.computed(rows, num_threads)
        return tuple((part if rows is None else part.rows(rows)).tree for part in packs)

    def columns(self, moving: Moving) -> tuple[int, ...]:
        """The numbers of the arrays of the first tree that depend on those that are moving."""
        if moving.isdisjoint(self.arrays):
            return ()
        layout = self.computed(np.zeros(0, int))[0].layout
        return tuple(i for i, dtype in enumerate(layout.dtypes) if dtype is None or jnp.issubdtype(dtype, jnp.floating))


Table = GivenTable | ComputedTable


class _Gathered:
    """The inputs of a row function for some rows (None: all), from which blocks are gathered."""

    def __init__(self, inputs: Sequence[Input], size: int, total: bool, rows: Any = None, num_threads: int | None = 1):
        self._total, self._whole = total, rows is None
        self._rows = np.arange(size, dtype=np.int32) if rows is None else rows
        self.size, self.block_size = len(self._rows), BLOCK
        self.indices, self._packs = [], []
        for table, index, part in inputs:
            rows_of_table = rows
            if index is not None:
                # Of all rows at once: neighbours are found on the way.
                index = np.asarray(index[slice(None) if rows is None else rows], np.int32)
                rows_of_table = np.maximum(index, 0).reshape(-1)
                if index.ndim == 2 and index.shape[1] > 1:
                    self.block_size = NEIGHBORHOOD_BLOCK
            self._packs.append(table.computed(rows_of_table, num_threads)[part])
            self.indices.append(index)
        self.blocks = blocks(self.size, self.block_size)

    def block(self, rows: Any) -> tuple[tuple[Packed, ...], tuple[Any, ...]]:
        """The rows of a block (see `blocks`) and their numbers; −1 for padding, which must not add to a sum."""
        packs, numbers = [], []
        for pack, index in zip(self._packs, self.indices, strict=True):
            if index is None:
                packs.append(pack.rows(rows if self._whole else self._rows[rows]))
                number = np.array(self._rows[rows], np.int32)
            else:
                number = np.array(index[rows].T, order="C")
                packs.append(pack.rows(np.maximum(number, 0)))
            if self._total and not isinstance(rows, slice):
                number[..., self.size - rows[0] :] = -1
            numbers.append(number)
        return tuple(packs), tuple(numbers)

    def in_order(self, run: Callable[[slice, Any], Any]) -> Iterator[Any]:
        """Results of `run` for each of the `blocks`; only some are computed at once, which bounds the memory."""
        at_once = num_cores()
        for start in range(0, len(self.blocks), at_once):
            yield from side_by_side([partial(run, *block) for block in self.blocks[start : start + at_once]])

    def rows_of_table(self, j: int) -> Int[np.ndarray, "n"]:
        """The rows of the table of input `j` that are used."""
        index = self.indices[j]
        if index is None:
            return self._rows
        occurs = np.zeros(len(self._packs[j].table), bool)
        occurs[index[index >= 0]] = True
        return np.flatnonzero(occurs)


@with_settings_of_package
def blockwise(function: Callable[..., Any], numbers: Any, *inputs: Input, total: bool = False) -> Any:
    """Apply a row function, outside or inside of transformations.

    Outside of `jit` and `vmap` it runs in blocks on the host, and a derivative does, too: nothing is compiled for the
    number of rows.

    Args:
        function: `function(numbers, *rows)`, with `Rows` of each input: pure JAX, defined at module level. It returns a
            sum, to which rows with the index −1 must not add, or a tuple of pytrees of arrays with one row each.
        numbers: a pytree of arrays.
        inputs: tables, or pytrees of arrays; the first is indexed as the result is, unless it has an `index`.
        total: whether the function returns a sum.

    Returns:
        What the function returns, for all rows. Of several trees of rows, only the first is differentiable. Outside
        `jit`, first derivatives only.

    Raises:
        ValueError: if an input is no `Input`; if the function returns no tuple of trees, and `total` is False; if it is
            differentiated and returns integers or booleans in the first tree, or in the sum.

    Example: the sum of squared differences of matched channels.

        def difference(scale, source, target):
            square = jnp.sum((source.tree - target.tree) ** 2, axis=-1) / scale**2
            return jnp.sum(jnp.where(target.index >= 0, square, 0))

        rows = np.where(matches.valid, matches.indices, -1)
        blockwise(difference, 0.1, Input(source.channels), Input(target.channels, rows), total=True)
    """
    if not all(isinstance(entry, Input) for entry in inputs):
        kinds = ", ".join(type(entry).__name__ for entry in inputs)
        raise ValueError(f"inputs: expected each to be an Input, as Input(array, row_numbers), got {kinds}")
    if not is_concrete(primal((numbers, [entry for entry in inputs if not isinstance(entry.table, Table)]))):
        return over_whole(function, numbers, inputs, total)
    applied = RowFunction(function, numbers, inputs, size_of(inputs[0]), total)
    call = partial(applied.sums, None) if total else partial(applied.rows, None, None)
    # Differentiation is a transformation, too: inside it, calls of programs take longer.
    packs = in_new_thread(call) if applied.tracers else call()
    if total:
        table = np.sum([np.asarray(part.table, np.float64) for part in packs], axis=0)
        packs = [Packed(table.astype(packs[0].table.dtype), packs[0].layout)]
    leaves, structure = jax.tree.flatten(packs[0].tree)
    if applied.tracers:
        for leaf in leaves:
            if not jnp.issubdtype(leaf.dtype, jnp.floating):
                raise ValueError(
                    f"function: expected floats to differentiate, and others in a second tree, got {leaf.dtype}"
                )
        leaves = with_derivative(leaves, _Derivative(applied, packs[0].layout), applied.tracers)
    elif total:
        leaves = [jax.device_put(leaf) for leaf in leaves]
    first = jax.tree.unflatten(structure, leaves)
    return first if total else (first, *(part.tree for part in packs[1:]))


def size_of(first: Input) -> int:
    if first.index is not None:
        return len(first.index)
    return first.table.size if isinstance(first.table, Table) else len(jax.tree.leaves(first.table)[0])


@dataclass(frozen=True, eq=False)
class _Derivative(AbstractLinearMap):
    """The derivative of the arrays that a row function returns, which lie in a table as `layout` says."""

    runs_programs = True

    applied: RowFunction
    layout: Layout

    def jvp(self, tangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        leaves = [self.applied.tracers[i] for i in moving]
        table = self.applied.jvp({id(leaf): by for leaf, by in zip(leaves, tangents, strict=True)})
        return jax.tree.leaves(Packed(table if self.applied.total else table.swapaxes(0, 1), self.layout).tree)

    def vjp(self, cotangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        table = Packed.of(list(cotangents), num_axes=1 if self.applied.total else 2).table
        table = table if self.applied.total else table.swapaxes(0, 1)
        return self.applied.cotangents(table, [self.applied.tracers[i] for i in moving])


def over_whole(function: Callable[..., Any], numbers: Any, inputs: Sequence[Input], total: bool = False) -> Any:
    """A row function of whole arrays, inside transformations; rows of many neighbourhoods are computed in blocks."""
    numbers, inputs = jax.tree.map(jnp.asarray, numbers), _as_arrays(inputs)
    num_rows = size_of(inputs[0])
    wide = any(entry.index is not None and entry.index.ndim == 2 for entry in inputs)
    if total or not wide or num_rows <= _LARGEST_WHOLE:
        return function(numbers, *(whole(entry, spread=not total) for entry in inputs))
    num_blocks = -(-num_rows // _LARGEST_BLOCK)
    size = -(-num_rows // num_blocks)
    padded = jnp.minimum(jnp.arange(num_blocks * size), num_rows - 1).reshape(num_blocks, size)
    results = jax.lax.map(lambda rows: function(numbers, *(whole(entry, rows, True) for entry in inputs)), padded)
    return jax.tree.map(lambda leaf: leaf.reshape(padded.size, *leaf.shape[2:])[:num_rows], results)


def _as_arrays(inputs: Sequence[Input]) -> list[Input]:
    whole = [entry if entry.index is None else entry._replace(index=entry.index[:]) for entry in inputs]
    return jax.tree.map(jnp.asarray, whole)


def over_both(function: Callable[..., Any], numbers: Any, one: Sequence[Input], other: Sequence[Input]) -> Any:
    """`over_whole` for two clouds, in one compiled body if their inputs are alike and they are not large."""
    one, other = _as_arrays(one), _as_arrays(other)
    trees = [[entry.table for entry in inputs] for inputs in (one, other)]
    sizes = [len(jax.tree.leaves(tree)[0]) for tree in trees]
    structures: list[Any] = [jax.tree.structure(tree) for tree in trees]
    if structures[0] != structures[1] or sum(sizes) > _LARGEST_WHOLE or one[0].index is not None:
        return over_whole(function, numbers, one), over_whole(function, numbers, other)

    def stacked(entry: Input, next_one: Input) -> Input:
        table = jax.tree.map(lambda *rows: jnp.concatenate(rows), entry.table, next_one.table)
        if entry.index is None:
            return Input(table)
        indices = [entry.index, jnp.where(next_one.index >= 0, next_one.index + sizes[0], -1)]
        most = max(index.shape[1] for index in indices)
        padded = [jnp.pad(index, [(0, 0), (0, most - index.shape[1])], constant_values=-1) for index in indices]
        return Input(table, jnp.concatenate(padded))

    both = over_whole(function, numbers, list(map(stacked, one, other)))
    return jax.tree.map(lambda rows: rows[: sizes[0]], both), jax.tree.map(lambda rows: rows[sizes[0] :], both)


def whole(entry: Input, rows: Any = None, spread: bool = False) -> Rows:
    """All rows, or some, of a pytree of arrays, some of which are traced. Missing ones (−1) read row 0; with `spread`,
    different rows, because GPUs add the cotangents of one row, zeros included, one after the other."""
    tree, index = jax.tree.map(jnp.asarray, (entry.table, entry.index))
    size = len(jax.tree.leaves(tree)[0])
    if index is None and rows is None:
        return Rows(tree, jnp.arange(size))
    index = rows if index is None else index[slice(None) if rows is None else rows].T
    missing = (jnp.arange(index.shape[-1]) if rows is None else rows) % size if spread else 0
    read = jnp.where(index < 0, missing, index)
    return Rows(jax.tree.map(lambda array: array[read], tree), index)


def _add_rows(
    total: Float[np.ndarray, "N c W"],
    rows: Int[np.ndarray, "*k n"],
    values: Float[np.ndarray, "*k n c W"],
    scratch: Int[np.ndarray, "N"],
) -> None:
    """Add values to rows that may repeat; negative ones are left out. `np.add.at` takes ten times as long.

    `scratch` has any values; it is reused, since a new array for each block would cost page faults (0.6 ms).
    """
    rows, values = rows.reshape(-1), values.reshape(rows.size, -1)
    weights, rows, numbers = (rows >= 0).astype(values.dtype), np.maximum(rows, 0), np.arange(rows.size + 1)
    # Distinct rows: each has the number of its last entry. Sorting would take three times as long as the sum.
    scratch[rows] = numbers[:-1]
    last = scratch[rows]
    is_last = last == numbers[:-1]
    places = (np.cumsum(is_last) - 1)[last]
    distinct = rows[is_last]
    sums = csc_array((weights, places, numbers), shape=(len(distinct), rows.size)) @ values
    total[distinct] += sums.reshape(len(distinct), *total.shape[1:])


@cache
def _program(function: Callable[..., Any], total: bool, packed: bool) -> Callable[..., Any]:
    """A row function for a block, packed: to pass dozens of arrays takes longer than to use them."""

    def program(numbers: Any, packs: Any, indices: Any) -> Any:
        result = function(numbers, *(Rows(pack.tree, index) for pack, index in zip(packs, indices, strict=True)))
        if not packed:
            return result
        if not total and type(result) is not tuple:
            raise ValueError("function: expected a tuple of pytrees with one row each; with total=True, a sum")
        return Packed.of(result, num_axes=0) if total else tuple(map(Packed.of, result))

    program.__name__ = function.__name__
    return quickly_compiled(program)


def _of_leaves(
    function: Callable[..., Any], total: bool, places_of_leaves: Places, numbers: Any, packs: Any, indices: Any
) -> tuple[Callable[[Any], Any], list[list[Any]]]:
    """The packed result as a function of the leaves at these places; and these leaves."""
    trees = [jax.tree.flatten(tree) for tree in (numbers, *(pack.tree for pack in packs))]

    def result(moved: list[list[Any]]) -> Any:
        replaced = []
        for (leaves, structure), places, values in zip(trees, places_of_leaves, moved, strict=True):
            leaves = leaves.copy()
            for i, value in zip(places, values, strict=True):
                leaves[i] = value
            replaced.append(jax.tree.unflatten(structure, leaves))
        value = function(replaced[0], *map(Rows, replaced[1:], indices))
        return Packed.of(value if total else value[0], num_axes=0 if total else 1).table

    return result, [[leaves[i] for i in places] for (leaves, _), places in zip(trees, places_of_leaves, strict=True)]


@cache
def _vjp_program(function: Callable[..., Any], total: bool, places: Places) -> Callable[..., Any]:
    """The vector-Jacobian product of a block for c cotangents: of the numbers at these places, (c, ...), and of the
    columns of each input side by side, (n, c, W) or (k, n, c, W); None where there are none."""

    def program(numbers: Any, packs: Any, indices: Any, cotangents: Any) -> Any:
        result, here = _of_leaves(function, total, places, numbers, packs, indices)
        ((by_numbers, *by_columns),) = jax.vmap(jax.vjp(result, here)[1], in_axes=0 if total else 1)(cotangents)
        by_rows = []
        for columns, index in zip(by_columns, indices, strict=True):
            columns = [by.reshape(*by.shape[: 1 + index.ndim], -1) for by in columns]
            by_rows.append(jnp.moveaxis(jnp.concatenate(columns, axis=-1), 0, -2) if columns else None)
        return by_numbers, by_rows

    program.__name__ = f"vjp_{function.__name__}"
    return quickly_compiled(program)


@cache
def _jvp_program(function: Callable[..., Any], total: bool, places: Places) -> Callable[..., Any]:
    """Jacobian-vector products of a block, (c, L) or (c, n, L); tangents are (c, n, W) or (c, k, n, W)."""

    def program(numbers: Any, packs: Any, indices: Any, by_numbers: Any, by_rows: Any) -> Any:
        result, here = _of_leaves(function, total, places, numbers, packs, indices)
        slopes = [by_numbers]
        for columns, joined, index in zip(here[1:], by_rows, indices, strict=True):
            ends = np.cumsum([math.prod(column.shape[index.ndim :]) for column in columns])
            parts = jnp.split(joined, ends[:-1], axis=-1) if columns else []
            slopes.append([part.reshape(len(part), *leaf.shape) for part, leaf in zip(parts, columns, strict=True)])
        return jax.vmap(jax.linearize(result, here)[1])(slopes)

    program.__name__ = f"jvp_{function.__name__}"
    return quickly_compiled(program)


@cache
def _jacobian_program(function: Callable[..., Any], places: Places) -> Callable[..., Any]:
    """A sum over a block, packed, and its derivative by the numbers at these places."""

    def program(*arguments: Any) -> Any:
        result, here = _of_leaves(function, True, places, *arguments)
        value, vjp = jax.vjp(result, here)
        return value, jax.vmap(vjp)(jnp.eye(len(value), dtype=value.dtype))[0][0]

    program.__name__ = f"jacobian_{function.__name__}"
    return quickly_compiled(program)
