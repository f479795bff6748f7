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
from functools import cache, cached_property, partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_array

from mcgicp_jax._compute.concrete import Deferred, is_concrete, outside_trace
from mcgicp_jax._compute.linear_maps import AbstractLinearMap, primal, with_derivative
from mcgicp_jax._compute.programs import quickly_compiled
from mcgicp_jax._compute.tables import BLOCK, NEIGHBORHOOD_BLOCK, Layout, Packed, RowsOnDemand, blocks
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
Chosen = tuple[tuple[int, ...], ...]


class Rows(NamedTuple):
    """Rows of a table, as a row function sees them.

    Attributes:
        tree: of arrays (n, ...), or (k, n, ...) where each row has k rows of the table.
        index: (n,) or (k, n) numbers of these rows; −1 where there is none.
    """

    tree: Any
    index: Int[Any, "*k n"]


class Input(NamedTuple):
    """What a row function gets of a table: for row i of its result, row i of the table, or the rows `index[i]`.

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
        start = 0
        for leaf in (self._leaves[i] for i in self.columns(moving)):
            stop = start + math.prod(leaf.shape[1:])
            found = cotangents[..., start:stop].swapaxes(0, 1).astype(np.float64)
            into[id(leaf)] = into.get(id(leaf), 0) + found.reshape(len(found), *leaf.shape)
            start = stop

    def jvp(self, tangents: Slopes, moving: Moving, rows: Any) -> np.ndarray:
        leaves = [tangents[id(self._leaves[i])] for i in self.columns(moving)]
        return np.concatenate([leaf.reshape(*leaf.shape[:2], -1) for leaf in leaves], axis=-1).swapaxes(0, 1)[rows]


class RowFunction:
    """A row function with its arguments, on the host.

    `function` is defined at module level or cached, since its programs are kept for it. It returns a sum, a pytree, or
    a tuple of pytrees of arrays with one row each. Rows with the index −1 must not add to a sum (`total`).
    """

    def __init__(self, function: Any, numbers: Any, inputs: Sequence[Input], size: int, total: bool = False):
        self._function, self.size, self._total = function, size, total
        self._inputs = [
            each if isinstance(each.table, Table) else each._replace(table=GivenTable(each.table)) for each in inputs
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
        found = {id(leaf): leaf for leaf in self._leaves}
        for each in self._inputs:
            found |= each.table.arrays
        return found

    @property
    def tracers(self) -> list[Any]:
        return [array for array in self.arrays.values() if not is_concrete(array)]

    def rows(self, rows: Int[np.ndarray, "n"] | None = None, num_threads: int | None = 1) -> tuple[Packed, ...]:
        found = self._over_blocks(rows, num_threads)
        layouts = [part.layout for part in found[0][1]]
        size = found[-1][0].stop
        tables = [np.empty((size, *part.table.shape[1:]), part.table.dtype) for part in found[0][1]]
        for places, parts in found:
            for table, part in zip(tables, parts, strict=True):
                table[places] = np.asarray(part.table)[: places.stop - places.start]
        return tuple(map(Packed, tables, layouts))

    def sums(self, num_threads: int | None = 1, packed: bool = True) -> list[Any]:
        """The sum over each block. Programs may not have ended."""
        return [part for _, part in self._over_blocks(None, num_threads, packed)]

    @with_settings_of_package
    def _over_blocks(self, rows: Any, num_threads: int | None, packed: bool = True) -> list[tuple[slice, Any]]:
        gathered = _Gathered(self._inputs, self.size, rows, num_threads)
        run = _program(self._function, self._total, packed)
        # Worker threads run outside a trace that is active in this thread; this thread leaves it for the same results.
        with outside_trace():
            return list(
                self._in_order(gathered, lambda block, _: run(self._numbers, *block), gathered.size, num_threads)
            )

    def value_and_jacobian(self, wanted: Sequence[int]) -> tuple[np.ndarray, list[np.ndarray]]:
        """A sum, packed, and its derivative (L, ...) by the leaves of `numbers` with these numbers; float64."""
        program = _jacobian_program(self._function, (tuple(wanted), *(() for _ in self._inputs)))
        gathered = _Gathered(self._inputs, self.size, None)
        results = self._in_order(gathered, lambda block, _: program(self._numbers, *block), num_cores())
        parts = [jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), part) for _, part in results]
        return reduce(partial(jax.tree.map, np.add), parts)

    def cotangents(self, cotangents: np.ndarray, leaves: Sequence[Any]) -> list[np.ndarray]:
        """Cotangents (c, ...) of some arrays, from those of the sum or of the rows, as `vjp` takes them."""
        into: Slopes = {}
        self.vjp(cotangents, frozenset(map(id, leaves)), into)
        count = cotangents.shape[0 if self._total else 1]
        return [into.get(id(leaf), np.zeros((count, *np.shape(leaf)))) for leaf in leaves]

    def vjp(self, cotangents: Any, moving: Moving, into: Slopes, rows: Int[np.ndarray, "n"] | None = None) -> None:
        """Add the cotangents of what is moving to `into`.

        Args:
            cotangents: (c, L) of the sum, packed, or (N, c, L) of the rows.
            rows: those whose cotangents are not 0; None for all.
        """
        numbers, *columns = chosen = self._chosen(moving)
        if not any(chosen):
            return
        gathered = _Gathered(self._inputs, self.size, rows)
        program, count = _vjp_program(self._function, self._total, chosen), cotangents.shape[0 if self._total else 1]

        def call(block: Any, places: slice) -> Any:
            some = cotangents
            if not self._total:
                here = cotangents[places if rows is None else rows[places]]
                some = np.zeros((gathered.block_size, *here.shape[1:]), here.dtype)
                some[: len(here)] = here
            return jax.tree.map(np.asarray, program(self._numbers, *block, some)), block[1]

        slopes: dict[int, np.ndarray] = {}
        for places, ((by_numbers, by_rows), indices) in self._in_order(gathered, call, num_cores()):
            for i, by in zip(numbers, by_numbers, strict=True):
                key = id(self._leaves[i])
                into[key] = into.get(key, 0) + by.astype(np.float64)
            live = (..., slice(0, places.stop - places.start))
            for j, by in enumerate(by_rows):
                if columns[j]:
                    if j not in slopes:
                        slopes[j] = np.zeros((self._inputs[j].table.size, count, by.shape[-1]), by.dtype)
                    _add_rows(slopes[j], indices[j][live], np.moveaxis(by, 0, -2)[(*live, slice(None), slice(None))])
        for j, slope in slopes.items():
            self._inputs[j].table.vjp(slope, moving, into, gathered.used(j))

    def jvp(self, tangents: Slopes, moving: Moving, rows: Int[np.ndarray, "n"] | None = None) -> np.ndarray:
        """Tangents (c, L) of the sum, packed, or (n, c, L) of the rows, from those (c, ...) of what is moving. A scalar
        0 if it does not depend on that."""
        numbers, *columns = chosen = self._chosen(moving)
        if not any(chosen):
            return np.zeros(())
        gathered = _Gathered(self._inputs, self.size, rows)
        program = _jvp_program(self._function, self._total, chosen)
        by_numbers = [tangents[id(self._leaves[i])].astype(np.result_type(self._leaves[i])) for i in numbers]
        slopes: dict[int, np.ndarray] = {}
        for j, table in ((j, self._inputs[j].table) for j, some in enumerate(columns) if some):
            used = gathered.used(j)
            found = table.jvp(tangents, moving, used)
            slopes[j] = np.zeros((table.size, *found.shape[1:]), found.dtype)
            slopes[j][used] = found

        def call(block: Any, _: slice) -> Any:
            by_rows = [
                np.moveaxis(slopes[j][np.maximum(index, 0)], -2, 0).astype(pack.table.dtype) if j in slopes else None
                for j, (pack, index) in enumerate(zip(*block, strict=True))
            ]
            return np.asarray(program(self._numbers, *block, by_numbers, by_rows))

        parts = list(self._in_order(gathered, call, num_cores()))
        if self._total:
            return np.sum([part.astype(np.float64) for _, part in parts], axis=0)
        return np.concatenate([part[:, : places.stop - places.start] for places, part in parts], axis=1).swapaxes(0, 1)

    def _chosen(self, moving: Moving) -> Chosen:
        """The places of the numbers, and of the columns of each input, that depend on the moving arrays."""
        numbers = tuple(i for i, leaf in enumerate(self._leaves) if id(leaf) in moving)
        return numbers, *(() if each.part else each.table.columns(moving) for each in self._inputs)

    def _in_order(
        self, gathered: _Gathered, call: Callable[[Any, slice], Any], at_once: int, num_threads: int | None = None
    ) -> Iterator[tuple[slice, Any]]:
        """Results for blocks, in order; only some are computed at once, which bounds the memory."""
        cut = blocks(gathered.size, gathered.block_size)

        def work(places: slice, index: Any) -> Any:
            return call(gathered.block(index, self._total), places)

        for start in range(0, len(cut), at_once):
            some = cut[start : start + at_once]
            results = side_by_side([partial(work, *each) for each in some], num_threads)
            yield from zip((places for places, _ in some), results, strict=True)


class ComputedTable(RowFunction):
    """The result of a row function, whose rows are computed when they are first used. Threads may share it.

    Trees after the first are constants to autodiff; tangents and cotangents are those of the `columns` that move alone.
    `values` is a table with the same values, from which rows are taken.
    """

    def __init__(self, function: Any, numbers: Any, inputs: Sequence[Input], size: int, values: Any = None):
        super().__init__(function, numbers, inputs, size)
        # Not `self.rows`, whose cycle would keep the table until garbage is collected.
        computed = RowFunction(function, numbers, self._inputs, size)
        self._rows = RowsOnDemand(computed.rows, size) if values is None else values._rows

    def computed(self, rows: Int[np.ndarray, "n"] | None = None, num_threads: int | None = 1) -> tuple[Packed, ...]:
        """The packed trees, in which these rows (None: all) are computed, and others may not be."""
        return self._rows.computed(rows, num_threads)

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

    def __init__(self, inputs: Sequence[Input], size: int, rows: Any, num_threads: int | None = 1):
        self.size = size if rows is None else len(rows)
        self._rows = rows
        self.indices, self._packs = [], []
        for table, index, part in inputs:
            # Of all rows at once: neighbours are found on the way.
            chosen = None if index is None else np.asarray(index[slice(None) if rows is None else rows], np.int32)
            used = rows if chosen is None else np.maximum(chosen, 0).reshape(-1)
            self._packs.append(table.computed(used, num_threads)[part])
            self.indices.append(chosen)
        wide = any(index is not None and index.ndim == 2 and index.shape[1] > 1 for index in self.indices)
        self.block_size = NEIGHBORHOOD_BLOCK if wide else BLOCK

    def block(self, index: Any, total: bool) -> tuple[tuple[Packed, ...], tuple[Any, ...]]:
        """The rows of a block (see `blocks`) and their numbers; −1 for padding if it must not add to a sum."""
        own = index if self._rows is None else self._rows[index]
        packs, numbers = [], []
        for pack, chosen in zip(self._packs, self.indices, strict=True):
            if chosen is None:
                packs.append(pack.rows(own))
                number = np.arange(own.start, own.stop, dtype=np.int32) if isinstance(own, slice) else own
                number = np.array(number, np.int32)
            else:
                number = np.array(chosen[index].T, order="C")
                packs.append(pack.rows(np.maximum(number, 0)))
            if total and not isinstance(index, slice):
                number[..., self.size - index[0] :] = -1
            numbers.append(number)
        return tuple(packs), tuple(numbers)

    def used(self, j: int) -> Int[np.ndarray, "n"]:
        index = self.indices[j]
        if index is None:
            return np.arange(self.size) if self._rows is None else self._rows
        return np.unique(index[index >= 0])


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
        What the function returns, for all rows. Of several returned trees of rows, those after the first are constants
        to autodiff. Outside `jit`, first derivatives only.

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
    if not all(isinstance(each, Input) for each in inputs):
        kinds = ", ".join(type(each).__name__ for each in inputs)
        raise ValueError(f"inputs: expected each to be an Input, as Input(array, row_numbers), got {kinds}")
    if not is_concrete(primal((numbers, [each for each in inputs if not isinstance(each.table, Table)]))):
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
        leaves = with_derivative(leaves, _Derivative(applied, total, packs[0].layout), applied.tracers)
    elif total:
        leaves = [jax.device_put(leaf) for leaf in leaves]
    first = jax.tree.unflatten(structure, leaves)
    return first if total else (first, *(each.tree for each in packs[1:]))


def size_of(first: Input) -> int:
    if first.index is not None:
        return len(first.index)
    return first.table.size if isinstance(first.table, Table) else len(jax.tree.leaves(first.table)[0])


class _Derivative(AbstractLinearMap):
    """The derivative of the arrays that a row function returns."""

    def __init__(self, applied: RowFunction, total: bool, layout: Layout):
        self._applied, self._total, self._layout = applied, total, layout
        self._leaves = applied.tracers

    def jvp(self, tangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        slopes = {id(self._leaves[i]): tangent for i, tangent in zip(moving, tangents, strict=True)}
        found = self._applied.jvp(slopes, frozenset(slopes))
        return jax.tree.leaves(Packed(found if self._total else found.swapaxes(0, 1), self._layout).tree)

    def vjp(self, cotangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        packed = Packed.of(list(cotangents), num_axes=1 if self._total else 2).table
        packed = packed if self._total else packed.swapaxes(0, 1)
        return self._applied.cotangents(packed, [self._leaves[i] for i in moving])


def over_whole(function: Callable[..., Any], numbers: Any, inputs: Sequence[Input], total: bool = False) -> Any:
    """A row function of whole arrays, inside transformations; rows of many neighbourhoods are computed in blocks."""
    numbers, inputs = jax.tree.map(jnp.asarray, numbers), [_found(each) for each in inputs]
    num_rows = size_of(inputs[0])
    wide = any(each.index is not None and each.index.ndim == 2 for each in inputs)
    if total or not wide or num_rows <= _LARGEST_WHOLE:
        return function(numbers, *(whole(each, spread=not total) for each in inputs))
    num_blocks = -(-num_rows // _LARGEST_BLOCK)
    size = -(-num_rows // num_blocks)
    padded = jnp.minimum(jnp.arange(num_blocks * size), num_rows - 1).reshape(num_blocks, size)
    found = jax.lax.map(lambda rows: function(numbers, *(whole(each, rows, True) for each in inputs)), padded)
    return jax.tree.map(lambda leaf: leaf.reshape(padded.size, *leaf.shape[2:])[:num_rows], found)


def over_both(function: Callable[..., Any], numbers: Any, one: Sequence[Input], other: Sequence[Input]) -> Any:
    """`over_whole` for two clouds, in one compiled body if their inputs are alike and they are not large."""
    one, other = [_found(each) for each in one], [_found(each) for each in other]
    trees = [[each.table for each in inputs] for inputs in (one, other)]
    sizes = [len(jax.tree.leaves(tree)[0]) for tree in trees]
    structures: list[Any] = [jax.tree.structure(tree) for tree in trees]
    alike = structures[0] == structures[1]
    if not alike or sum(sizes) > _LARGEST_WHOLE or one[0].index is not None:
        return over_whole(function, numbers, one), over_whole(function, numbers, other)

    def stacked(each: Input, next_one: Input) -> Input:
        table = jax.tree.map(lambda *rows: jnp.concatenate(list(map(jnp.asarray, rows))), each.table, next_one.table)
        if each.index is None:
            return Input(table)
        indices = [jnp.asarray(each.index), jnp.asarray(next_one.index)]
        most = max(index.shape[1] for index in indices)
        indices[1] = jnp.where(indices[1] >= 0, indices[1] + sizes[0], -1)
        padded = [jnp.pad(index, [(0, 0), (0, most - index.shape[1])], constant_values=-1) for index in indices]
        return Input(table, jnp.concatenate(padded))

    found = over_whole(function, numbers, list(map(stacked, one, other)))
    return jax.tree.map(lambda rows: rows[: sizes[0]], found), jax.tree.map(lambda rows: rows[sizes[0] :], found)


def _found(given: Input) -> Input:
    return given._replace(index=given.index.whole) if isinstance(given.index, Deferred) else given


def whole(given: Input, rows: Any = None, spread: bool = False) -> Rows:
    """All rows, or some, of a pytree of arrays, some of which are traced. Where there is none it is the first, or with
    `spread` that of the same number: GPUs add the cotangents of a row, zeros included, one after the other."""
    tree, index = jax.tree.map(jnp.asarray, given.table), given.index
    size = len(jax.tree.leaves(tree)[0])
    if index is None and rows is None:
        return Rows(tree, jnp.arange(size))
    index = rows if index is None else jnp.asarray(index)[slice(None) if rows is None else rows].T
    missing = (jnp.arange(index.shape[-1]) if rows is None else rows) % size if spread else 0
    found = jnp.where(index < 0, missing, index)
    return Rows(jax.tree.map(lambda array: array[found], tree), index)


def _add_rows(
    total: Float[np.ndarray, "N c W"], rows: Int[np.ndarray, "*k n"], values: Float[np.ndarray, "*k n c W"]
) -> None:
    """Add values to rows that may repeat; negative ones are left out. `np.add.at` takes ten times as long."""
    rows, values = rows.reshape(-1), values.reshape(rows.size, -1)
    used, places = np.unique(np.maximum(rows, 0), return_inverse=True)
    weights = (rows >= 0).astype(values.dtype)
    sums = csc_array((weights, places.reshape(-1), np.arange(rows.size + 1)), shape=(len(used), rows.size)) @ values
    total[used] += sums.reshape(len(used), *total.shape[1:])


@cache
def _program(function: Callable[..., Any], total: bool, packed: bool) -> Callable[..., Any]:
    """A row function for a block, packed: to pass dozens of arrays takes longer than to use them."""

    def program(numbers: Any, packs: Any, indices: Any) -> Any:
        found = function(numbers, *(Rows(pack.tree, index) for pack, index in zip(packs, indices, strict=True)))
        if not packed:
            return found
        if not total and type(found) is not tuple:
            raise ValueError("function: expected a tuple of pytrees with one row each; with total=True, a sum")
        return Packed.of(found, num_axes=0) if total else tuple(Packed.of(part) for part in found)

    program.__name__ = function.__name__
    return quickly_compiled(program)


def _of_chosen(
    function: Callable[..., Any], total: bool, chosen: Chosen, numbers: Any, packs: Any, indices: Any
) -> tuple[Callable[[Any], Any], list[list[Any]]]:
    """The packed result as a function of the chosen leaves; and these leaves."""
    trees = [jax.tree.flatten(tree) for tree in (numbers, *(pack.tree for pack in packs))]

    def result(moved: list[list[Any]]) -> Any:
        replaced = []
        for (leaves, structure), places, values in zip(trees, chosen, moved, strict=True):
            leaves = leaves.copy()
            for i, value in zip(places, values, strict=True):
                leaves[i] = value
            replaced.append(jax.tree.unflatten(structure, leaves))
        found = function(replaced[0], *map(Rows, replaced[1:], indices))
        return Packed.of(found if total else found[0], num_axes=0 if total else 1).table

    return result, [[leaves[i] for i in places] for (leaves, _), places in zip(trees, chosen, strict=True)]


@cache
def _vjp_program(function: Callable[..., Any], total: bool, chosen: Chosen) -> Callable[..., Any]:
    """The vector-Jacobian product of a block for c cotangents: of the chosen numbers, (c, ...), and of the chosen
    columns of each input side by side, (c, n, W) or (c, k, n, W); None where there are none."""

    def program(numbers: Any, packs: Any, indices: Any, cotangents: Any) -> Any:
        result, here = _of_chosen(function, total, chosen, numbers, packs, indices)
        ((by_numbers, *by_rows),) = jax.vmap(jax.vjp(result, here)[1], in_axes=0 if total else 1)(cotangents)
        return by_numbers, [
            jnp.concatenate([by.reshape(*by.shape[: 1 + index.ndim], -1) for by in columns], axis=-1)
            if columns
            else None
            for columns, index in zip(by_rows, indices, strict=True)
        ]

    program.__name__ = f"vjp_{function.__name__}"
    return quickly_compiled(program)


@cache
def _jvp_program(function: Callable[..., Any], total: bool, chosen: Chosen) -> Callable[..., Any]:
    """Jacobian-vector products of a block, (c, L) or (c, n, L); tangents are shaped as results of `_vjp_program`."""

    def program(numbers: Any, packs: Any, indices: Any, by_numbers: Any, by_rows: Any) -> Any:
        result, here = _of_chosen(function, total, chosen, numbers, packs, indices)
        slopes = [by_numbers]
        for columns, joined, index in zip(here[1:], by_rows, indices, strict=True):
            ends = np.cumsum([math.prod(each.shape[index.ndim :]) for each in columns])
            parts = jnp.split(joined, ends[:-1], axis=-1) if columns else []
            slopes.append([part.reshape(len(part), *each.shape) for part, each in zip(parts, columns, strict=True)])
        return jax.vmap(jax.linearize(result, here)[1])(slopes)

    program.__name__ = f"jvp_{function.__name__}"
    return quickly_compiled(program)


@cache
def _jacobian_program(function: Callable[..., Any], chosen: Chosen) -> Callable[..., Any]:
    """A sum over a block, packed, and its derivative by the chosen numbers."""

    def program(*arguments: Any) -> Any:
        result, here = _of_chosen(function, True, chosen, *arguments)
        value, vjp = jax.vjp(result, here)
        return value, jax.vmap(vjp)(jnp.eye(len(value), dtype=value.dtype))[0][0]

    program.__name__ = f"jacobian_{function.__name__}"
    return quickly_compiled(program)
