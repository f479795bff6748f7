"""Threads that stay, for work that lets go of Python's lock: queries of trees, compiled programs."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Answer = TypeVar("Answer")


def num_cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def side_by_side(calls: Sequence[Callable[[], Answer]]) -> list[Answer]:
    """The answers of calls, of which this thread makes the first, and others at the same time the rest.

    The others are those of the whole process. They stay, since a new thread begins on the core of the one that started
    it, and most queries are over before it is given another. What none of them has begun when this thread is ready, it
    does itself, the last first, since they begin with the first: nobody waits for threads that wait.
    """
    others = [(call, _submit(call)) for call in calls[1:]]
    first = calls[0]()
    own = {i: call() for i, (call, answer) in reversed(list(enumerate(others))) if answer.cancel()}
    return [first, *(own[i] if i in own else answer.result() for i, (_, answer) in enumerate(others))]


def _submit(call: Callable[[], Answer]) -> Future[Answer]:
    try:
        return _threads().submit(call)
    except RuntimeError:
        # While the interpreter shuts down, no thread takes anything new: what nobody begins can be cancelled.
        return Future()


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(1, num_cores() - 1), thread_name_prefix="mcgicp")


# A forked process has none of its parent's threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)
