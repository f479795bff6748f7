"""Calls that are refused, and the argument that their error names."""

from collections.abc import Callable
from typing import Any

import pytest
from jaxtyping import TypeCheckError


def refused(call: Callable[[], Any], named: str, *shown: object) -> None:
    """Check that a call raises a ValueError whose message begins with the argument's name and has these numbers.

    Run-time checks of annotations (tests/checks.py) may refuse the call first.
    """
    with pytest.raises((ValueError, TypeCheckError)) as caught:
        call()
    message = str(caught.value)
    if not isinstance(caught.value, TypeCheckError):
        assert message.startswith(f"{named}: ") and all(str(each) in message for each in shown), message
