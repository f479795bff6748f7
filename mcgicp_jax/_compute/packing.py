"""Arrays with one row per point side by side in one array, so that NumPy gathers all their rows at once."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Layout(NamedTuple):
    """How a tree of arrays lies in one: hashable, so that it can be a static argument.

    Attributes:
        structure: of the tree.
        shapes: of each array, without the axes that are kept.
    """

    structure: Any
    shapes: tuple[tuple[int, ...], ...]


def layout_of(tree: Any, num_axes: int = 1) -> Layout:
    """The layout of a tree of arrays that share their first `num_axes` axes."""
    leaves, structure = jax.tree.flatten(tree)
    return Layout(structure, tuple(leaf.shape[num_axes:] for leaf in leaves))


def packed(tree: Any) -> np.ndarray:
    """(N, L): the arrays of a tree, each with N rows, side by side; not copied if they are views of such an array."""
    leaves = jax.tree.leaves(tree)
    base = leaves[0].base
    widths = [math.prod(leaf.shape[1:]) for leaf in leaves]
    if base is not None and base.shape == (len(leaves[0]), sum(widths)) and base.flags.c_contiguous:
        starts = np.cumsum([0, *widths[:-1]]) * base.itemsize + base.ctypes.data
        if all(leaf.base is base and leaf.ctypes.data == start for leaf, start in zip(leaves, starts, strict=True)):
            return base
    return np.concatenate([leaf.reshape(len(leaf), -1) for leaf in leaves], axis=1)


def unpacked(array: Any, layout: Layout) -> Any:
    """The tree with this layout from (..., L); views of a NumPy array where its last axis is split only."""
    leaves, start = [], 0
    for shape in layout.shapes:
        stop = start + math.prod(shape)
        leaves.append(array[..., start:stop].reshape((*array.shape[:-1], *shape)))
        start = stop
    return jax.tree.unflatten(layout.structure, leaves)


def packed_numbers(tree: Any) -> jax.Array:
    """(L,): all numbers of a tree of traced arrays."""
    return jnp.concatenate([leaf.reshape(-1) for leaf in jax.tree.leaves(tree)])
