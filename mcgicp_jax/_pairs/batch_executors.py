"""Running the pairs of a batch: in lanes, by threads, or in chunks by any executor whose workers may die."""

from __future__ import annotations

import collections
import contextlib
import itertools
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator
from concurrent import futures
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context, resource_tracker
from pickle import PicklingError
from typing import Any, ClassVar, Literal, TypeAlias

import jax
import jaxlie
import numpy as np

from mcgicp_jax._compute.concrete import is_concrete, is_deferred
from mcgicp_jax._compute.linear_maps import KnownJacobian, primal, with_derivative
from mcgicp_jax._compute.messages import warn
from mcgicp_jax._compute.threads import num_cores, with_settings
from mcgicp_jax._pairs.batch_jobs import BatchJob, Pair, PairResult, PreparedPair
from mcgicp_jax._registration.assessment import fields_of_pose
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.result import RegistrationResult, Status

GivenExecutor: TypeAlias = Executor | Literal["processes"] | None

# Number of pairs per chunk for a worker that is not a thread, and maximum number of submitted chunks.
_CHUNK_SIZE, _MAX_SUBMITTED = 8, 64
# Number of pairs per chunk for a process of this machine: 1 to 8 are equally fast, and few pairs are shared evenly.
_SMALL_CHUNK = 2
# Environment of a worker of `Processes`: one thread each for XLA, the tree search and BLAS, and no accelerator, three
# quarters of whose memory each would reserve. loky would take memory that grows with the clouds for a leak, and start
# another worker.
_ENVIRONMENT = {
    "JAX_PLATFORMS": "cpu",
    "PJRT_NPROC": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "LOKY_MAX_MEMORY_LEAK_SIZE": "1e18",
}
# Settings of JAX for a whole process, which may differ from the environment. `with_settings` sends the others.
_SETTINGS = (
    "jax_enable_compilation_cache",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)
# Seconds between looks of a worker at its parent.
_LOOK = 1.0


class Processes(Executor):
    """Single-threaded workers in other processes, from loky: they need no `__main__` guard, and wait for further calls
    until the interpreter ends. All batches of this process share them."""

    # Chunks of all batches that have not ended, with their batches.
    _unfinished: ClassVar[dict[Future[Any], Processes]] = {}

    def __init__(self, num_workers: int):
        try:
            from loky import get_reusable_executor
        except ImportError as error:
            raise ImportError("executor: processes need loky: pip install 'mcgicp_jax[processes]'") from error
        values = {name.upper(): getattr(jax.config, name) for name in _SETTINGS}
        environment = _ENVIRONMENT | {name: str(value) for name, value in values.items() if value is not None}
        begin = {"initializer": _begin_worker, "initargs": (os.getpid(),), "env": environment}
        self._current = partial(get_reusable_executor, num_workers, timeout=None, **begin)
        self._pool, self.num_workers = self._current(), num_workers
        # Or else this would begin beside the first worker, and let Ctrl-C through.
        resource_tracker.ensure_running()

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        # loky starts workers here, and later one for each that has died.
        with _without_interrupt():
            try:
                future = self._pool.submit(function, *arguments, **named)
            except RuntimeError:
                # A worker died, or another batch that ended early has ended the workers.
                self._pool = self._current()
                future = self._pool.submit(function, *arguments, **named)
        self._unfinished[future] = self
        future.add_done_callback(self._unfinished.pop)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Cancel the futures of this batch, if so wanted. Those in loky's queue cannot be cancelled: the workers are
        ended instead, unless they are at work for another batch."""
        if not cancel_futures:
            return
        unfinished = dict(self._unfinished)
        # Ended workers fail all futures, which loky cannot do to cancelled ones.
        if all(batch is self for batch in unfinished.values()):
            self._pool.shutdown(wait, kill_workers=True)
        for future, batch in unfinished.items():
            if batch is self:
                future.cancel()


@contextlib.contextmanager
def _without_interrupt() -> Iterator[None]:
    """Context in which Ctrl-C waits. Processes that start in it never get it, so they do not report it either."""
    if not hasattr(signal, "pthread_sigmask"):
        # On Windows.
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin_worker(parent: int) -> None:
    """Leave Ctrl-C to the parent, and end when it does, even if it is killed."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_LOOK)
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=watch, daemon=True).start()


def executor_of(executor: GivenExecutor) -> Executor | None:
    """The executor to use; `ValueError` unless it is None, "processes" or an executor that may run JAX."""
    if isinstance(executor, str) and executor == "processes":
        return Processes(num_cores())
    if executor is not None and (isinstance(executor, type) or not hasattr(executor, "submit")):
        raise ValueError(f'executor: expected a concurrent.futures.Executor, "processes" or None, got {executor!r}')
    context = getattr(executor, "_mp_context", None)
    if isinstance(executor, ProcessPoolExecutor) and context is not None and context.get_start_method() == "fork":
        raise ValueError(
            "executor: expected the start method spawn, got fork, with which JAX may hang; "
            'use "processes" or ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"))'
        )
    return executor


def run(
    job: BatchJob, pairs: Iterator[Pair], executor: Executor | None
) -> Generator[tuple[int, RegistrationResult], None, None]:
    """Register the pairs and yield index and result of each as soon as it is computed; see `register_as_completed`."""

    def concrete(pair: Pair) -> Pair:
        if not is_concrete(pair.source, pair.target, pair.prior):
            raise ValueError(
                f"pair {pair.index}: expected concrete arrays, got tracers; for derivatives, call register_batch "
                "outside of jit with lists of clouds"
            )
        return pair

    for result in _results(job, map(concrete, pairs), executor):
        yield result.index, result.registration


def run_differentiated(job: BatchJob, pairs: Iterator[Pair], executor: Executor) -> list[RegistrationResult]:
    """The results of pairs whose arrays differentiation traces; workers compute the poses and their derivatives."""
    outcomes = {}
    for pair in pairs:
        if not is_concrete(pair.prior):
            raise ValueError(f"priors[{pair.index}]: expected concrete arrays with an executor, got tracers")
        outcomes[pair.index] = job.prepare(pair)
    ready = {index: pair for index, pair in outcomes.items() if isinstance(pair, PreparedPair)}
    fixed = replace(job, method=primal(job.method), options=replace(job.options, robust=primal(job.options.robust)))
    sent = (Pair(each.index, *each.inputs.values()[:2], each.init, each.prior, each.traced) for each in ready.values())
    results = {index: result.with_warning() for index, result in outcomes.items() if index not in ready}
    results |= {result.index: result for result in _results(fixed, sent, executor)}
    return [
        _differentiable(results[index], ready[index]) if index in ready else results[index].registration
        for index in outcomes
    ]


def _differentiable(answer: PairResult, pair: PreparedPair) -> RegistrationResult:
    """The result with the derivative of its pose."""
    result = pair.checked(answer.registration)
    if not answer.jacobian:
        return result
    values, inputs = [np.asarray(result.centred.wxyz_xyz)], [pair.leaves[i] for i in pair.traced]
    (pose,) = with_derivative(values, KnownJacobian(answer.jacobian), inputs)
    origins = pair.inputs.source.origin, pair.inputs.target.origin
    if is_concrete(origins):
        origins = result.source_origin, result.target_origin
    return result.build(**vars(result) | fields_of_pose(jaxlie.SE3(pose), *origins))


def _results(job: BatchJob, pairs: Iterator[Pair], executor: Executor | None) -> Iterator[PairResult]:
    num_workers = num_cores()
    if executor is None and job.uses_lanes:
        yield from map(PairResult.with_warning, job.register_in_lanes(pairs, num_workers))
    elif executor is None:
        with ThreadPoolExecutor(num_workers, thread_name_prefix="mcgicp") as threads:
            yield from ChunkedExecutor(job, threads).run(pairs, 1, 2 * num_workers)
    elif isinstance(executor, Processes):
        # More than loky's queue holds, so that no worker waits.
        yield from ChunkedExecutor(job, executor).run(pairs, _SMALL_CHUNK, 4 * executor.num_workers)
    else:
        chunk_size = 1 if isinstance(executor, ThreadPoolExecutor) else _CHUNK_SIZE
        yield from ChunkedExecutor(job, executor).run(pairs, chunk_size, _MAX_SUBMITTED)


class ChunkedExecutor:
    """Chunks of pairs submitted to an executor, and pairs to retry.

    A chunk may fail because one of its pairs killed the worker, or because another chunk broke the pool. The pairs of
    failed chunks are suspects, submitted again at the end one by one: only those that fail alone get `WORKER_FAILED`.
    """

    def __init__(self, job: BatchJob, executor: Executor):
        self._executor = executor
        self._replacement: Executor | None = None
        self._pickled = not isinstance(executor, ThreadPoolExecutor)
        job = _as_numpy(job) if self._pickled else job
        work = job.register_chunk_alone if isinstance(executor, Processes) else job.register_chunk
        self._register = with_settings(work, pickled=self._pickled)
        self._suspects: collections.deque[Pair] = collections.deque()
        self._submitted: dict[Future[list[PairResult]], list[Pair]] = {}

    def run(self, pairs: Iterator[Pair], chunk_size: int, max_submitted: int) -> Iterator[PairResult]:
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
            if isinstance(self._executor, Processes):
                self._executor.shutdown(cancel_futures=bool(self._submitted))
            else:
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

    def _receive(self) -> Iterator[PairResult]:
        """Wait for at least one chunk and yield its results; the pairs of failed chunks become suspects."""
        done, _ = futures.wait(self._submitted, return_when=futures.FIRST_COMPLETED)
        for future in done:
            chunk = self._submitted.pop(future)
            try:
                results = future.result()
            except PicklingError as error:
                raise ValueError(
                    f"pairs {chunk[0].index} to {chunk[-1].index}: expected clouds and functions that can be sent to "
                    f"other processes; {_reason(error)}"
                ) from error
            except Exception as error:
                # A worker that dies breaks its pool, and so all chunks that were submitted.
                if not self._suspects:
                    warn(f"a worker failed ({_words(error)}); its pairs are submitted again, one by one, at the end")
                self._suspects.extend(chunk)
            else:
                yield from map(PairResult.with_warning, results)

    def _retried(self, pair: Pair) -> PairResult:
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

    return replace(sent, **jax.tree.map(convert, dict(vars(sent)), is_leaf=is_deferred))


def _reason(error: PicklingError) -> str:
    """The message of the error in loky's thread, whose traceback is the text of the cause."""
    lines = [line for line in str(error.__cause__ or error).splitlines() if line.strip(' "')]
    return lines[-1] if lines else type(error).__name__


def _words(error: BaseException) -> str:
    # The first line: loky goes on with exit codes and advice.
    return f"{type(error).__name__}: {error}".partition("\n")[0].rstrip(": ")
