"""Counting of compilations."""

import contextlib

import jax


@contextlib.contextmanager
def compilations():
    """The names of the programs compiled within; empty if there are none."""
    found = []

    def listen(event, _, fun_name=None, **__):
        if event == "/jax/core/compile/backend_compile_duration":
            found.append(fun_name)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield found
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
