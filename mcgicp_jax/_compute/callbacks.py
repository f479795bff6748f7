"""Calls of the host from within compiled programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

# Bytes. JAX (jaxlib 0.10.2) copies smaller arrays for a callback in the calling thread, up to 100 KiB.
_LARGEST_PIECE = 64 * 1024


def call_host(function: Callable[..., Any], shapes: Any, *arguments: Any) -> Any:
    """`jax.pure_callback` of a function of NumPy arrays; one lane at a time under `vmap`.

    JAX copies the arguments of a callback, large arrays in a thread of the pool that also runs programs. If callbacks
    of as many programs as there are threads wait for such copies, they deadlock (seen with two programs on two cores).
    So large arrays are passed in pieces, and a batch of lanes, whose pieces would be large again, is not passed at
    once. The function must not call JAX, which was seen to deadlock as well.

    Args:
        function: maps pytrees of NumPy arrays to a pytree of arrays.
        shapes: the pytree of its results, as `jax.ShapeDtypeStruct`.
        arguments: pytrees of arrays.
    """
    leaves, structure = jax.tree.flatten(arguments)
    pieces = [_pieces(leaf) for leaf in leaves]

    def joined(*given: list[Any]) -> Any:
        whole = [np.concatenate([np.asarray(piece) for piece in each]) if len(each) > 1 else each[0] for each in given]
        return function(*structure.unflatten([np.asarray(each) for each in whole]))

    return jax.pure_callback(joined, shapes, *pieces, vmap_method="sequential")


def _pieces(array: Any) -> list[Any]:
    """An array split along its rows into pieces of at most `_LARGEST_PIECE` bytes."""
    array = jnp.asarray(array)
    count = -(-array.nbytes // _LARGEST_PIECE)
    return [array] if count <= 1 else jnp.array_split(array, count)
