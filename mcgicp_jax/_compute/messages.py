"""Checks of arguments, and warnings and errors that name the argument that they are about."""

from __future__ import annotations

import contextlib
import importlib
import sys
import traceback
import warnings
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any, TypeAlias

import numpy as np

from mcgicp_jax._compute.concrete import is_concrete

# A line of code at which a warning is shown, as `warnings.warn_explicit` takes it: file, number, module and registry.
Line: TypeAlias = tuple[str, int, str, dict[Any, Any]]

_PACKAGE = __name__.split(".", maxsplit=1)[0]
_prefix: ContextVar[str] = ContextVar("prefix", default="")
_line: ContextVar[Line | None] = ContextVar("line", default=None)


@contextlib.contextmanager
def warnings_named(name: str) -> Iterator[None]:
    """Context in which warnings by `warn` start with the name of an argument."""
    before = _prefix.set(f"{_prefix.get()}{name}: ")
    try:
        yield
    finally:
        _prefix.reset(before)


@contextlib.contextmanager
def messages_named(name: str) -> Iterator[None]:
    """`warnings_named`; a `ValueError` or `OSError` becomes a `ValueError` that starts with the name."""
    try:
        with warnings_named(name):
            yield
    except (ValueError, OSError) as error:
        raise ValueError(f"{name}: {reason_of(error)}") from error


def reason_of(error: Exception) -> str:
    """The message in one line; of an error of the system, the file and the cause."""
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


def calling_line() -> Line:
    """The line that called the package; in a thread of the package, the one that caused its work."""
    if (line := _line.get()) is not None:
        return line
    frames = [frame for frame, _ in traceback.walk_stack(sys._getframe())]
    names = [frame.f_globals.get("__name__", "") for frame in frames]
    inside = [i for i, name in enumerate(names) if name.split(".", maxsplit=1)[0] == _PACKAGE]
    frame = frames[min(inside[-1] + 1, len(frames) - 1)]
    registry = frame.f_globals.setdefault("__warningregistry__", {})
    return frame.f_code.co_filename, frame.f_lineno, frame.f_globals.get("__name__", ""), registry


@contextlib.contextmanager
def shown_at(line: Line) -> Iterator[None]:
    """Context in which warnings by `warn` are shown at a line."""
    before = _line.set(line)
    try:
        yield
    finally:
        _line.reset(before)


def warn(message: str | Warning) -> None:
    """Issue a warning, of `UserWarning` if it is a text, at the line that called the package."""
    text = f"{_prefix.get()}{message}" if isinstance(message, str) else message
    warnings.warn_explicit(text, UserWarning, *calling_line())


def optional_module(module: str, extra: str, use: str) -> Any:
    """Import a package of an extra of this one; the error message begins with the `use`, such as "plotting"."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        name = module.partition(".")[0]
        raise ImportError(f"{use} needs {name}: pip install 'mcgicp_jax[{extra}]'") from error


def check_concrete(name: str, *values: object) -> None:
    if not is_concrete(*values):
        raise ValueError(f"{name}: expected concrete arrays, got tracers; call this outside of jit, vmap and grad")


def check_positive(name: str, value: Any, expected: str = "a positive number") -> None:
    if is_concrete(value) and not (is_number(value) and np.asarray(value) > 0):
        raise ValueError(f"{name}: expected {expected}, got {value!r}")


def check_integer(name: str, value: Any, minimum: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < minimum:
        raise ValueError(f"{name}: expected an integer of at least {minimum}, got {value!r}")


def is_number(value: Any) -> bool:
    return np.ndim(value) == 0 and np.asarray(value).dtype.kind in "fiu"
