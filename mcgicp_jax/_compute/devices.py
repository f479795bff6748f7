"""The devices that JAX computes on by default, and the CPU, on which programs between host code run."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax

Answer = TypeVar("Answer")
Parameters = ParamSpec("Parameters")


def default_devices() -> list[jax.Device]:
    """JAX's default device if one is chosen, else all local devices of its default platform."""
    default = jax.default_device.value
    return [default] if isinstance(default, jax.Device) else jax.local_devices(backend=default)


def on_accelerator() -> bool:
    default = jax.default_device.value
    return getattr(default, "platform", default or jax.default_backend()) != "cpu"


def on_cpu() -> contextlib.AbstractContextManager[Any]:
    """Context in which JAX computes on the CPU: with small programs, a GPU mostly launches and transfers."""
    if on_accelerator():
        # `jax_platforms` may leave the CPU out.
        with contextlib.suppress(RuntimeError):
            return jax.default_device(jax.local_devices(backend="cpu")[0])
    return contextlib.nullcontext()


def computed_on_cpu(function: Callable[Parameters, Answer]) -> Callable[Parameters, Answer]:
    @functools.wraps(function)
    def computed(*arguments: Parameters.args, **named: Parameters.kwargs) -> Answer:
        # To enter a context of JAX takes longer than to ask.
        with on_cpu() if on_accelerator() else contextlib.nullcontext():
            return function(*arguments, **named)

    return computed


# Makes a JAX array that host code reads without a transfer, and that programs on any device may use.
put_on_cpu = computed_on_cpu(jax.device_put)
