"""Compiled programs whose compilation takes half the time."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

Result = TypeVar("Result")

# XLA's fusion emitters take half of the compilation of derivatives and of a step of the loop, and these programs run no
# faster for it (jaxlib 0.10.2). Programs over neighbourhoods run up to 2.4 times as long without.
_OPTIONS = {"xla_cpu_use_fusion_emitters": False}


def quickly_compiled(function: Callable[..., Result], **settings: Any) -> Callable[..., Result]:
    """`jax.jit` of a function that is called outside of other transformations."""

    @functools.cache
    def program() -> Callable[..., Result]:
        return jax.jit(function, compiler_options=_known_options(), **settings)

    return functools.wraps(function)(lambda *arguments: program()(*arguments))


@functools.cache
def _known_options() -> dict[str, bool]:
    """The options, or none if this version of XLA no longer knows them."""
    try:
        jax.jit(jnp.negative, compiler_options=_OPTIONS).lower(0.0).compile()
    except Exception:
        return {}
    return _OPTIONS
