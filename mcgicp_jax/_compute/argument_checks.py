"""Checks of arguments; the `ValueError` names the argument, the expected and the given value."""

from __future__ import annotations

from typing import Any

import numpy as np

from mcgicp_jax._compute.concrete import is_concrete


def check_positive(name: str, value: Any, expected: str = "a positive number") -> None:
    if is_concrete(value) and not (is_number(value) and np.asarray(value) > 0):
        raise ValueError(f"{name}: expected {expected}, got {value!r}")


def check_integer(name: str, value: Any, minimum: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < minimum:
        raise ValueError(f"{name}: expected an integer of at least {minimum}, got {value!r}")


def is_number(value: Any) -> bool:
    return np.ndim(value) == 0 and np.asarray(value).dtype.kind in "fiu"
