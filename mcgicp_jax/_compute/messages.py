"""Warnings and errors that name the argument that they are about."""

from __future__ import annotations

import contextlib
import sys
import traceback
import warnings
from collections.abc import Iterator
from contextvars import ContextVar

_PACKAGE = __name__.split(".", maxsplit=1)[0]
_prefix: ContextVar[str] = ContextVar("prefix", default="")


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
        raise ValueError(f"{name}: {error}") from error


def warn(message: str | Warning) -> None:
    """Issue a warning, of `UserWarning` if it is a text, at the line that called the package."""
    frames = (frame for frame, _ in traceback.walk_stack(sys._getframe()))
    names = [frame.f_globals.get("__name__", "") for frame in frames]
    inside = [level for level, name in enumerate(names, 1) if name.split(".", maxsplit=1)[0] == _PACKAGE]
    warnings.warn(f"{_prefix.get()}{message}" if isinstance(message, str) else message, stacklevel=max(inside) + 1)
