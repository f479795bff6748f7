"""How programs are compiled: in half the time, and with calls of the host."""

from __future__ import annotations

import contextlib
import functools
import logging
import threading
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from mcgicp_jax._compute.devices import on_accelerator, on_cpu

Result = TypeVar("Result")

LOGGER = logging.getLogger("mcgicp_jax")
# Seconds of compilation in a process, after which one log record says what takes so long.
_LONG = 2.0
_COMPILATION = "/jax/core/compile/backend_compile_duration"


class _Compilations:
    """Listener to JAX's compilations, those of programs in its cache on disk included."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._lock = threading.Lock()

    def __call__(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event != _COMPILATION:
            return
        with self._lock:
            before, self.seconds = self.seconds, self.seconds + duration_secs
        if before <= _LONG < self.seconds:
            folder = jax.config.values["jax_compilation_cache_dir"]
            kept = f"programs are kept in {folder}" if folder else "help(mcgicp_jax) says how to keep programs"
            LOGGER.info("compiling, mostly once for each method; %s", kept)


COMPILATIONS = _Compilations()
jax.monitoring.register_event_duration_secs_listener(COMPILATIONS)


def quickly_compiled(function: Callable[..., Result], *, level: int | None = None) -> Callable[..., Result]:
    """`jax.jit` of a function that is called outside of other transformations; it runs on the CPU.

    `level`: of LLVM's optimizations, for programs of a few small matrices: without (0), they compile in half the time,
    and with few (1), they also run as fast as with all.
    """
    program = functools.cache(lambda: jax.jit(function, compiler_options=_options(level)))

    @functools.wraps(function)
    def run(*arguments: Any) -> Result:
        with on_cpu() if on_accelerator() else contextlib.nullcontext():
            return program()(*arguments)

    return run


@functools.cache
def _options(level: int | None) -> dict[str, bool | int]:
    """Options of the compiler; none if this version of XLA no longer knows them."""
    # XLA's fusion emitters take a third to half of the time of compilation, and save at most a tenth of the time to run
    # (jaxlib 0.10.2): 1,024 neighbourhoods take 0.64 ms with them and 0.70 without, with two channels 1.06 and 1.15.
    options: dict[str, bool | int] = {"xla_cpu_use_fusion_emitters": False}
    if level is not None:
        options["xla_backend_optimization_level"] = level
    try:
        jax.jit(jnp.negative, compiler_options=options).lower(0.0).compile()
    except Exception:
        return {}
    return options


# Bytes. JAX (jaxlib 0.10.2) copies smaller arrays for a callback in the calling thread, up to 100 KiB.
_LARGEST_PIECE = 64 * 1024


def call_host(function: Callable[..., Any], shapes: Any, *arguments: Any) -> Any:
    """`jax.pure_callback` of a function of NumPy arrays; one lane at a time under `vmap`.

    JAX copies the arguments of a callback, large arrays in a thread of the pool that also runs programs. If callbacks
    of as many programs as there are threads wait for such copies, they deadlock (seen with two programs on two cores).
    So large arrays are passed in pieces, and a batch of lanes, whose pieces would be large again, is not passed at
    once. The function must not call JAX, which was seen to deadlock as well.
    """
    leaves, structure = jax.tree.flatten(arguments)
    pieces = []
    for array in map(jnp.asarray, leaves):
        count = -(-array.nbytes // _LARGEST_PIECE)
        pieces.append([array] if count <= 1 else jnp.array_split(array, count))

    def joined(*split: list[Any]) -> Any:
        whole = [np.concatenate(parts) if len(parts) > 1 else np.asarray(parts[0]) for parts in split]
        return function(*jax.tree.unflatten(structure, whole))

    return jax.pure_callback(joined, shapes, *pieces, vmap_method="sequential")
