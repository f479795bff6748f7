"""Running the pairs of a batch: in lanes, by threads, or in chunks by any executor whose workers may die."""

from __future__ import annotations

import collections
import itertools
from collections.abc import Generator, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from concurrent.futures import wait as wait_for
from dataclasses import replace
from multiprocessing import get_context
from typing import Any

import jax
import numpy as np

from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._compute.messages import warn
from mcgicp_jax._compute.threads import num_cores, with_settings
from mcgicp_jax._pairs.batch_jobs import BatchJob, Pair, PairResult
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.result import RegistrationResult, Status

# Number of pairs per chunk for a worker that is not a thread, and maximum number of submitted chunks.
_CHUNK_SIZE, _MAX_SUBMITTED = 8, 64


def check_executor(executor: Executor | None) -> None:
    """Raises `ValueError` unless it is None or an executor that may run JAX."""
    if executor is not None and not hasattr(executor, "submit"):
        raise ValueError(f"executor: expected a concurrent.futures.Executor or None, got {executor!r}")
    context = getattr(executor, "_mp_context", None)
    if isinstance(executor, ProcessPoolExecutor) and context is not None and context.get_start_method() == "fork":
        raise ValueError(
            "executor: expected the start method spawn, got fork, with which JAX may hang; "
            'use ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"))'
        )


def run(
    job: BatchJob, pairs: Iterator[Pair], executor: Executor | None
) -> Generator[tuple[int, RegistrationResult], None, None]:
    """Register the pairs and yield index and result of each as soon as it is computed; see `register_as_completed`."""
    num_workers, pairs = num_cores(), map(_concrete, pairs)
    if executor is None and job.uses_lanes:
        yield from map(PairResult.with_warning, job.register_in_lanes(pairs, num_workers))
    elif executor is None:
        with ThreadPoolExecutor(num_workers, thread_name_prefix="mcgicp") as threads:
            yield from ChunkedExecutor(job, threads).run(pairs, 1, 2 * num_workers)
    else:
        chunk_size = 1 if isinstance(executor, ThreadPoolExecutor) else _CHUNK_SIZE
        yield from ChunkedExecutor(job, executor).run(pairs, chunk_size, _MAX_SUBMITTED)


def _concrete(pair: Pair) -> Pair:
    if not is_concrete(pair.source, pair.target):
        raise ValueError(
            f"pair {pair.index}: expected concrete arrays, got tracers; for derivatives, call register_batch outside "
            "of jit with lists of clouds"
        )
    return pair


class ChunkedExecutor:
    """Chunks of pairs submitted to an executor, and pairs to retry.

    A chunk may fail because one of its pairs killed the worker, or because another chunk broke the pool. The pairs of
    failed chunks are suspects, submitted again at the end one by one: only those that fail alone get `WORKER_FAILED`.
    """

    def __init__(self, job: BatchJob, executor: Executor):
        self._executor = executor
        self._replacement: Executor | None = None
        self._pickled = not isinstance(executor, ThreadPoolExecutor)
        if self._pickled:
            job = _as_numpy(job)
        self._register = with_settings(job.register_chunk, pickled=self._pickled)
        self._suspects: collections.deque[Pair] = collections.deque()
        self._submitted: dict[Future[list[PairResult]], list[Pair]] = {}

    def run(
        self, pairs: Iterator[Pair], chunk_size: int, max_submitted: int
    ) -> Iterator[tuple[int, RegistrationResult]]:
        """Submit chunks, at most `max_submitted` at a time, and yield their results."""
        try:
            while chunk := list(itertools.islice(pairs, chunk_size)):
                self._submit(chunk)
                while len(self._submitted) >= max_submitted:
                    yield from self._receive()
            while self._submitted:
                yield from self._receive()
            while self._suspects:
                yield self._retried(self._suspects.popleft())
        finally:
            for future in self._submitted:
                future.cancel()
            if self._replacement is not None:
                self._replacement.shutdown(cancel_futures=True)

    def _submit(self, chunk: list[Pair]) -> None:
        sent = [_as_numpy(pair) for pair in chunk] if self._pickled else chunk
        try:
            future = self._executor.submit(self._register, sent)
        except BrokenExecutor:
            self._replacement = self._executor = executor_like(self._executor)
            future = self._executor.submit(self._register, sent)
        self._submitted[future] = chunk

    def _receive(self) -> Iterator[tuple[int, RegistrationResult]]:
        """Wait for at least one chunk and yield its results; the pairs of failed chunks become suspects."""
        done, _ = wait_for(self._submitted, return_when=FIRST_COMPLETED)
        for future in done:
            chunk = self._submitted.pop(future)
            try:
                results = future.result()
            except Exception as error:
                # A worker that dies breaks its pool, and so all chunks that were submitted.
                if not self._suspects:
                    warn(f"a worker failed ({_words(error)}); its pairs are submitted again, one by one, at the end")
                self._suspects.extend(chunk)
            else:
                yield from map(PairResult.with_warning, results)

    def _retried(self, pair: Pair) -> tuple[int, RegistrationResult]:
        """Submit a suspect alone and wait for its result."""
        self._submit([pair])
        future, _ = self._submitted.popitem()
        try:
            (result,) = future.result()
        except Exception as error:
            failed = RegistrationResult.without_pose(Status.WORKER_FAILED)
            result = PairResult(pair.index, failed, f"its worker failed twice ({_words(error)})")
        return result.with_warning()


def executor_like(executor: Executor) -> Executor:
    """A new process pool like a broken one: the death of any worker breaks its pool."""
    return ProcessPoolExecutor(
        getattr(executor, "_max_workers", None),
        getattr(executor, "_mp_context", None) or get_context("spawn"),
        getattr(executor, "_initializer", None),
        getattr(executor, "_initargs", ()),
    )


def _as_numpy(sent: Any) -> Any:
    """Convert the JAX arrays in the fields of a dataclass to NumPy, for pickling.

    float64 JAX arrays would become float32 if unpickled before x64 is switched on.
    """

    def convert(value: Any) -> Any:
        if isinstance(value, Options):
            return _as_numpy(value)
        return np.asarray(value) if isinstance(value, jax.Array) else value

    fields = {name: getattr(sent, name) for name in sent.__dataclass_fields__}
    return replace(sent, **{name: jax.tree.map(convert, value) for name, value in fields.items()})


def _words(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".rstrip(": ")
