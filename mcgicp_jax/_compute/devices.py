"""The devices that JAX computes on by default, and the CPU, on which programs between host code run."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import jax


def default_devices() -> list[jax.Device]:
    """JAX's default device if one is chosen, else all local devices of its default platform."""
    chosen = jax.default_device.value
    return [chosen] if isinstance(chosen, jax.Device) else jax.local_devices(backend=chosen)


def on_accelerator() -> bool:
    """Whether JAX computes on a GPU or TPU by default."""
    chosen = jax.default_device.value
    return getattr(chosen, "platform", chosen or jax.default_backend()) != "cpu"


@contextlib.contextmanager
def on_cpu() -> Iterator[None]:
    """Context, and as `on_cpu()` a decorator, in which JAX computes on the CPU.

    Programs between host code are small: a GPU would spend most of the time on launches and transfers.
    """
    cpu: jax.Device | None = None
    if on_accelerator():
        # `jax_platforms` may leave the CPU out.
        with contextlib.suppress(RuntimeError):
            (cpu, *_) = jax.local_devices(backend="cpu")
    with contextlib.nullcontext() if cpu is None else jax.default_device(cpu):
        yield


# Makes a JAX array that host code reads without a transfer, and that programs on any device may use.
put_on_cpu = on_cpu()(jax.device_put)
