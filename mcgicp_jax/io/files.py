"""Shared by readers and writers: optional packages, size checks, reasons of errors, and files that replace others."""

from __future__ import annotations

import contextlib
import importlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO


def optional_module(module: str, use: str) -> Any:
    """Import a package of the extra `io`. `use`, such as "reading .ply", is part of the error message."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{use} files needs {module}: pip install 'mcgicp_jax[io]'") from error


def check_size(claimed: int, size: int) -> None:
    """Raise `ValueError` if a header claims more bytes than there are, before a library allocates them."""
    if claimed > size:
        raise ValueError(f"the header claims more than the file can hold ({claimed} bytes in {size})")


def reason_of(error: BaseException) -> str:
    return "it is not text" if isinstance(error, UnicodeError) else str(error) or type(error).__name__


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a temporary file that replaces `path` when the block succeeds."""
    path = Path(path)
    temporary = path.with_name(f".{uuid.uuid4().hex}.tmp")
    try:
        with open(temporary, "x+b") as file:
            yield file
        os.replace(temporary, path)
    except OSError as error:
        if error.filename != str(temporary):
            raise
        raise type(error)(error.errno, error.strerror, str(path)) from None
    finally:
        temporary.unlink(missing_ok=True)
