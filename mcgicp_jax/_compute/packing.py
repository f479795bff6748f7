"""Trees of arrays side by side in one array: one argument or result of a program, and one gather of all their rows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

Tree = TypeVar("Tree")


class Layout(NamedTuple):
    """How a tree of arrays lies in one.

    Attributes:
        structure: of the tree.
        shapes: of each array, without the axes that they share.
        dtypes: of each array; None if it is that of the table.
    """

    structure: Any
    shapes: tuple[tuple[int, ...], ...]
    dtypes: tuple[Any, ...]


@partial(jax.tree_util.register_dataclass, data_fields=("table",), meta_fields=("layout",))
@dataclass(frozen=True)
class Packed(Generic[Tree]):
    """A tree of arrays in one; a pytree, whose layout is static.

    Attributes:
        table: (..., L). Its dtype is that of the first array; integers up to 2²⁴ and booleans are exact in it.
    """

    table: Any
    layout: Layout

    @staticmethod
    def of(tree: Tree, num_axes: int = 1) -> Packed[Tree]:
        """Pack NumPy or traced arrays that share their first `num_axes` axes."""
        leaves, structure = jax.tree.flatten(tree)
        dtype = leaves[0].dtype
        layout = Layout(
            structure,
            tuple(leaf.shape[num_axes:] for leaf in leaves),
            tuple(None if leaf.dtype == dtype else leaf.dtype for leaf in leaves),
        )
        xp: Any = np if isinstance(leaves[0], np.ndarray) else jnp
        shared = leaves[0].shape[:num_axes]
        table = xp.concatenate([xp.asarray(leaf, dtype).reshape((*shared, -1)) for leaf in leaves], axis=-1)
        return Packed(table, layout)

    @property
    def tree(self) -> Tree:
        """The tree of arrays; views of a NumPy array."""
        leaves, start, shared = [], 0, self.table.shape[:-1]
        for shape, dtype in zip(self.layout.shapes, self.layout.dtypes, strict=True):
            stop = start + math.prod(shape)
            leaf = self.table[..., start:stop].reshape((*shared, *shape))
            leaves.append(leaf if dtype is None else leaf.astype(dtype))
            start = stop
        return jax.tree.unflatten(self.layout.structure, leaves)

    def rows(self, index: Any) -> Packed[Tree]:
        """Some rows of a NumPy array."""
        # `take` takes a quarter of the time of an index array.
        table = self.table[index] if isinstance(index, slice) else self.table.take(index, axis=0)
        return Packed(table, self.layout)
