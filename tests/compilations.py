"""Counting of compilations."""

import contextlib

import jax


@contextlib.contextmanager
def compilations():
    """The durations of the compilations within; empty if there are none."""
    found = []

    def listen(event, duration, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            found.append(duration)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield found
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
