"""Run-time checks of annotated shapes, a plugin of pytest: `python -m pytest -p tests.checks`."""

from collections.abc import Callable
from typing import Any

import beartype
from jaxtyping import install_import_hook


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its annotations checked at every call; functions inside functions are left as they are.

    Those would be decorated anew whenever the outer function runs. That takes most of the time of a registration, and
    while beartype decorates, it intercepts the warnings of all threads.
    """
    return function if "<locals>" in function.__qualname__ else beartype.beartype(function)


install_import_hook("mcgicp_jax", "tests.checks.checked")
