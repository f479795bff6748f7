"""Messages of the Python functions in the words of the command line."""

from __future__ import annotations

import re
from collections.abc import Sequence

from mcgicp_jax._cli.options import PairOptions

# Arguments of Python that are options of commands, and may occur in messages.
_OPTIONS = {*PairOptions.__dataclass_fields__, "recover"}


def with_flags(message: str, args: Sequence[str] = ()) -> str:
    """The message with arguments of Python, such as max_distance=(1, 0.2), as options of the command line; also the
    name with which it begins, if that is an option among `args`."""
    name, *rest = message.split(": ", maxsplit=1)
    option = f"--{name.replace('_', '-')}"
    if any(argument.split("=")[0] == option for argument in args):
        message = ": ".join([option, *rest])

    def flag(match: re.Match[str]) -> str:
        name, value = match.groups("")
        # Some names are words, too.
        if name not in _OPTIONS or not (value or "_" in name):
            return match[0]
        value = re.sub(r'[(),"]|True', "", value)
        return f"--{name.replace('_', '-')} {value}".rstrip()

    # Not within paths, also those of files such as max_distance=(1, 0.2).npz.
    value = r'\([\d., ]+\)|"\w+"|[\d.]*\d|True|N'
    return re.sub(rf"(?<![\w./-])([a-z_]+)(?:=({value})(?!:))?(?![\w/=-]|\.\w)", flag, message)
