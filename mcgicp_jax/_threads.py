"""Threads that stay, for work that lets go of Python's lock: queries of trees, compiled programs."""

from __future__ import annotations

import collections
import contextlib
import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, TypeVar

import jax

Answer = TypeVar("Answer")

# What can be set for a block of code, and changes what is computed in it.
_SETTINGS: tuple[Any, ...] = (jax.enable_x64, jax.default_device, jax.default_matmul_precision, jax.debug_nans)


def num_cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def side_by_side(calls: Sequence[Callable[[], Answer]], most: int | None = None) -> list[Answer]:
    """The answers of calls, of which this thread makes the first and others take their share of the rest.

    The others are those of the whole process. They stay, since a new thread begins on the core of the one that started
    it, and most queries are over before it is given another. Whoever is ready takes the next call, so that nobody waits
    for threads that come late, or that wait themselves.

    Args:
        most: threads at work, this one among them; as many as there are calls by default.
    """
    answers: dict[int, Answer] = {}
    waiting = collections.deque(enumerate(calls))
    first, call = waiting.popleft()

    def work() -> None:
        while waiting:
            try:
                i, call = waiting.popleft()
            except IndexError:
                # Another one was quicker.
                return
            answers[i] = call()

    count = min(len(calls), most or len(calls)) - 1
    elsewhere = with_settings(work) if count else work
    helpers = [_submit(elsewhere) for _ in range(count)]
    try:
        answers[first] = call()
        work()
    finally:
        # After an error nobody goes on.
        waiting.clear()
        begun = [helper for helper in helpers if not helper.cancel()]
        wait(begun)
    for helper in begun:
        helper.result()
    return [answers[i] for i in range(len(calls))]


def with_settings(work: Callable[..., Answer], *, pickled: bool = False) -> Callable[..., Answer]:
    """The function with JAX's settings of this thread, to be called in another one: settings belong to a thread.

    Args:
        pickled: for another process, which has no such device; it takes the first of the same platform.
    """
    values: list[Any] = [setting.value for setting in _SETTINGS]
    if pickled:
        values = [value.platform if isinstance(value, jax.Device) else value for value in values]
    return functools.partial(_run_with, values, work)


def _run_with(values: list[Any], work: Callable[..., Answer], *arguments: Any) -> Answer:
    with contextlib.ExitStack() as stack:
        for setting, value in zip(_SETTINGS, values, strict=True):
            stack.enter_context(setting(value))
        return work(*arguments)


def _submit(work: Callable[[], None]) -> Future[None]:
    try:
        return _threads().submit(work)
    except RuntimeError:
        # No new thread can be had, as while the interpreter shuts down: what nobody begins can be cancelled.
        return Future()


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(1, num_cores() - 1), thread_name_prefix="mcgicp")


# A forked process has none of its parent's threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)
