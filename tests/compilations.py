"""What is compiled."""

import contextlib
import re

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


def solves_single_matrices(program):
    """Whether a lowered program solves no matrices in batches by LAPACK: on two cores, two such calls at once wait for
    each other forever (jax 0.10.2)."""
    operands = re.findall(r"@lapack_\w+\(.*?: \(tensor<([^>]*)>", program.as_text())
    return operands and {operand.count("x") for operand in operands} == {2}
