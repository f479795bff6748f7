"""A persistent thread pool for work that releases Python's global lock: tree queries and compiled programs."""

from __future__ import annotations

import collections
import contextlib
import functools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from operator import attrgetter
from typing import Any, ParamSpec, TypeVar

import jax
import loky

from mcgicp_jax._compute.messages import calling_line, shown_at

Answer = TypeVar("Answer")
Parameters = ParamSpec("Parameters")

# JAX settings that are local to a thread and change what a program computes.
_SETTINGS: tuple[Any, ...] = (
    jax.enable_x64,
    jax.default_device,
    jax.default_matmul_precision,
    jax.debug_nans,
    jax.debug_infs,
    jax.numpy_dtype_promotion,
    jax.numpy_rank_promotion,
)
_TO_DEVICE: Any = jax.transfer_guard_host_to_device
_BETWEEN_DEVICES: Any = jax.transfer_guard_device_to_device
_TO_HOST: Any = jax.transfer_guard_device_to_host
# Values of guards that are not set.
_OPEN = {None, "allow"}


def with_settings_of_package(function: Callable[Parameters, Answer]) -> Callable[Parameters, Answer]:
    """Decorator of functions in which JAX has the settings that the package needs, whatever users chose for their code.

    Optional checks are off: `debug_nans` and `debug_infs`, since NaN marks missing values here, strict promotion of
    dtypes and ranks, and guards of transfers, since the host computes between programs. Products of matrices are in
    full precision: by default, GPUs round factors to 11 bits (TF32), that is 5 cm at 100 m.
    """

    @functools.wraps(function)
    def configured(*arguments: Parameters.args, **named: Parameters.kwargs) -> Answer:
        # To ask takes a tenth of the time of entering the contexts.
        promotion: Any = jax.numpy_dtype_promotion.value
        if (
            jax.default_matmul_precision.value == "highest"
            and not (jax.debug_nans.value or jax.debug_infs.value)
            and getattr(promotion, "value", promotion) == "standard"
            and jax.numpy_rank_promotion.value == "allow"
            and {_TO_DEVICE.value, _BETWEEN_DEVICES.value, _TO_HOST.value} <= _OPEN
        ):
            return function(*arguments, **named)
        with (
            jax.debug_nans(False),
            jax.debug_infs(False),
            jax.numpy_dtype_promotion("standard"),
            jax.numpy_rank_promotion("allow"),
            jax.default_matmul_precision("highest"),
            jax.transfer_guard("allow"),
        ):
            return function(*arguments, **named)

    return configured


def num_cores() -> int:
    """Number of cores that this process may use, at most as many as XLA or the quota of a container allows."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get("PJRT_NPROC", "")
    return min(count, _quota(), int(limit) if limit.isdecimal() and int(limit) else count)


# Read once. Affinity and LOKY_MAX_CPU_COUNT at that time count, too.
_quota = functools.cache(loky.cpu_count)


def side_by_side(calls: Sequence[Callable[[], Answer]], max_threads: int | None = None) -> list[Answer]:
    """Run one or more calls in parallel; the results are in order. The calling thread runs the first call itself.

    The other threads belong to a persistent pool of the process: a new thread starts on its parent's core, and most
    queries end before the scheduler moves it to another. Idle threads take the next call from a queue, so that no call
    waits for a thread that is late or blocked. An error of a call is raised once all started calls have ended.
    `max_threads` includes the calling one.
    """
    if len(calls) == 1:
        return [calls[0]()]
    answers: list[Any] = [None] * len(calls)
    waiting = collections.deque(range(1, len(calls)))

    def work() -> None:
        while waiting:
            try:
                i = waiting.popleft()
            except IndexError:
                # Another thread took the last call.
                return
            answers[i] = calls[i]()

    helpers = []
    # On a single core, other threads would only take turns with this one.
    if max_threads != 1 and num_cores() > 1:
        elsewhere = functools.partial(_run_with, _settings(), work)
        # No thread may be available, e.g. at interpreter shutdown.
        with contextlib.suppress(RuntimeError):
            for _ in range(min(len(calls), max_threads or len(calls)) - 1):
                helpers.append(_threads().submit(elsewhere))
    try:
        answers[0] = calls[0]()
        work()
    finally:
        # After an error in this thread, calls still in the queue are dropped.
        waiting.clear()
        begun = [helper for helper in helpers if not helper.cancel()]
        wait(begun)
    for helper in begun:
        helper.result()
    return answers


def in_new_thread(call: Callable[[], Answer]) -> Answer:
    """The result of a call in a thread of its own, where no transformation of this one is active: inside `jax.grad`,
    each call of a compiled program takes half a millisecond longer."""
    return started(call).result()


def started(call: Callable[[], Answer]) -> Future[Answer]:
    """The future result of a call in a daemon thread of its own, since a source of frames may block for ever."""
    future, bound = Future[Answer](), with_settings(call)

    def work() -> None:
        try:
            future.set_result(bound())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=work, name="mcgicp", daemon=True).start()
    return future


class ReadAhead(Iterator[Answer]):
    """The results of `read` until it raises `StopIteration`; a thread reads one ahead while the last one is in use. An
    error is raised in the place of its result, and the iteration may go on."""

    def __init__(self, read: Callable[[], Answer]):
        self._read = read
        self._next: Future[Answer] | None = None

    def __next__(self) -> Answer:
        self._next = self._next or started(self._read)
        # An interruption while waiting loses nothing.
        wait([self._next])
        done, self._next = self._next, None
        result = done.result()
        self._next = started(self._read)
        return result


def with_settings(work: Callable[..., Answer], *, pickled: bool = False) -> Callable[..., Answer]:
    """The function with this thread's JAX settings and line of warnings, for calls in another thread, or `pickled`, in
    another process, to which neither devices nor the line can be sent: it uses its first device of the platform."""
    if not pickled:
        return functools.partial(_run_with, _settings(), shown_at(calling_line())(work))
    values = [value.platform if isinstance(value, jax.Device) else value for value in _settings()]
    return functools.partial(_run_with, values, work)


def _settings() -> list[Any]:
    return list(map(attrgetter("value"), _SETTINGS))


def _run_with(values: list[Any], work: Callable[..., Answer], *arguments: Any) -> Answer:
    with contextlib.ExitStack() as stack:
        # Contexts are entered only where needed: one takes 30 µs, the others 50 µs.
        if not {_TO_DEVICE.value, _BETWEEN_DEVICES.value, _TO_HOST.value} <= _OPEN:
            stack.enter_context(jax.transfer_guard("allow"))
        if values != _settings():
            for setting, value in zip(_SETTINGS, values, strict=True):
                stack.enter_context(setting(value))
        return work(*arguments)


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(1, num_cores() - 1), thread_name_prefix="mcgicp")


# A forked process does not inherit its parent's threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)
