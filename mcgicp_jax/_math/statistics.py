"""Statistics of rows, with NumPy for concrete arrays and with JAX inside transformations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, is_concrete, numpy_for

# Largest sample for a median, rows: the median of 4,096 normal variates has a standard error of 2 % of σ.
MEDIAN_ROWS = 4096
# Multipliers of the spatial hash: the primes of Teschner et al. 2003 for the coordinates, and one for the cell size.
_HASH = np.array([73856093, 19349663, 83492791, 50331653], np.int32)
# Odd multiplier of a hash of the bits of float64: 2⁶⁴ over the golden ratio (Knuth 1973).
_BITS = np.uint64(0x9E3779B97F4A7C15)


def sampled_rows(valid: Any, most: int = MEDIAN_ROWS) -> tuple[Any, Any]:
    """At most `most` evenly spaced rows of a cloud whose padding comes last, and which of them are valid."""
    xp = numpy_for(valid)
    count = min(valid.size, most)
    rows = xp.arange(count) * (1 + xp.sum(valid) // most)
    inside = rows < valid.size
    rows = xp.where(inside, rows, 0)
    return rows, inside & valid[rows]


def spread_rows(valid: Any, count: int) -> Any:
    """`count` valid rows of a cloud with more rows than that, in order: one from each of `count` equal runs.

    Rows sorted by voxel, as `preprocess` leaves them, are spread evenly in space, others as densely as the points. The
    place in each run is random with a fixed seed: with a constant stride, all rows of an organised scan could be from
    one scan line. `valid`, (N,), is False for padding; if fewer than `count` are True, rows of padding follow.
    """
    xp = numpy_for(valid)
    valid_first = xp.argsort(~xp.asarray(valid), stable=True)
    total = xp.maximum(xp.sum(valid), count)
    # Products of whole numbers would overflow int32. Rounding moves the ends of runs by a row, but keeps their order.
    fractions, rest = (np.arange(count + 1) / count).astype(np.float32), (total % count).astype(np.float32)
    ends = xp.arange(count + 1) * (total // count) + xp.floor(fractions * rest).astype(np.int32)
    places = np.random.default_rng(0).random(count, np.float32)
    return valid_first[ends[:-1] + xp.floor(places * xp.diff(ends)).astype(np.int32)]


def median(values: Any) -> Any:
    """Median over the last axis that ignores NaN; NaN where all values are NaN. Not meant to be differentiated."""
    if is_concrete(values):
        values = np.asarray(values)
        result = np.full(values.shape[:-1], np.nan, values.dtype)
        for index in np.ndindex(values.shape[:-1]):
            numbers = values[index][~np.isnan(values[index])]
            if numbers.size:
                # In float64, in which the sum of the two middle values does not overflow.
                result[index] = np.median(numbers.astype(np.float64))
        return result[()]
    # Floats are sorted as integers of the same order: XLA on CPUs takes five times as long to sort floats.
    kind = jnp.int32 if values.dtype == jnp.float32 else jnp.int64

    def reordered(bits: Int[Array, "*batch n"]) -> Int[Array, "*batch n"]:
        # Of two negative floats, the larger one has the smaller bit pattern.
        return jnp.where(bits < 0, bits ^ jnp.iinfo(kind).max, bits)

    missing: Bool[Array, "*batch n"] = jnp.isnan(values)
    # One canonical bit pattern for NaN, which sorts last.
    bits = jax.lax.bitcast_convert_type(jnp.where(missing, jnp.nan, values), kind)
    ordered = jax.lax.bitcast_convert_type(reordered(jnp.sort(reordered(bits))), values.dtype)
    count = jnp.sum(~missing, axis=-1, keepdims=True)
    middle = jnp.concatenate([jnp.maximum(count - 1, 0) // 2, count // 2], axis=-1)
    # The sum of two large values would overflow.
    return jnp.sum(0.5 * jnp.take_along_axis(ordered, middle, axis=-1), axis=-1)


def of_known(statistic: Callable[[Any], Any], values: Float[AnyArray, "n *C"]) -> Float[AnyArray, "..."]:
    """A statistic over the first axis that ignores NaN, such as `nanstd`; NaN for columns of NaN."""
    xp = numpy_for(values)
    # NumPy would warn of columns of NaN, and its warning cannot be suppressed in one thread alone.
    missing = xp.all(xp.isnan(values), axis=0)
    # Squares of huge values overflow to infinity.
    with np.errstate(over="ignore", invalid="ignore"):
        return xp.where(missing, xp.nan, statistic(xp.where(missing, 0, values)))


def cell_numbers(keys: Sequence[Int[AnyArray, "n"]], num_cells: Int[AnyScalar, ""] | int) -> Int[AnyArray, "n"]:
    """Hash of integer cell coordinates, below `num_cells`."""
    # Collisions do no harm: scores of different cells are independent, so their products cancel on average.
    xp = numpy_for(keys, num_cells)
    products = [xp.asarray(key, np.int32) * prime for key, prime in zip(keys, _HASH, strict=False)]
    return xp.abs(sum(products[1:], start=products[0])) % num_cells


def upper_median(values: Float[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch"]:
    """The median; of an even number of values, the upper middle one. For few values, three times as fast as NumPy's."""
    middle = values.shape[-1] // 2
    return np.partition(values, middle)[..., middle]


def equal_rows(points: Float[np.ndarray, "N D"], most: int) -> Int[np.ndarray, "N"] | None:
    """The number of each point's position, if more than `most` finite points share one; None otherwise."""
    # The sort of a hash takes a twentieth of the time of a k-d tree. The sum turns −0 into 0, whose bits differ. The
    # lower bits of coordinates that were float32 are zero, so that the upper ones are mixed into them. Arrays are
    # changed in place, since fresh memory takes longer than the arithmetic.
    size = len(points)
    columns = np.ascontiguousarray(points.T, np.float64) + 0.0
    keys = np.zeros(size, np.uint64)
    for column in columns.view(np.uint64):
        keys ^= keys >> np.uint64(32)
        keys += column
        keys *= _BITS
    # The lower bits give way to the row: one sort yields the order, too. In one of 30,000 clouds of 100,000 points two
    # positions share the 47 bits that are left, and may get several numbers each.
    shift = np.uint64(size.bit_length())
    keys >>= shift
    keys <<= shift
    keys |= np.arange(size, dtype=np.uint64)
    keys.sort()
    if size <= most or ((keys[most:] ^ keys[:-most]) >> shift).all():
        return None
    order = (keys & ((np.uint64(1) << shift) - np.uint64(1))).astype(np.intp)
    differs = np.zeros(size, bool)
    for column in columns:
        ordered = column.take(order)
        differs[1:] |= ordered[1:] != ordered[:-1]
    numbers = np.empty(size, np.intp)
    numbers[order] = np.cumsum(differs)
    return numbers
