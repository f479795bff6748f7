"""Running the pairs of a batch: on a device, by threads, by processes from where these pay, or by any executor, whose
workers may die."""

from __future__ import annotations

import collections
import contextlib
import itertools
import pathlib
import time
from collections.abc import Callable, Generator, Iterator
from concurrent import futures
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import current_process, get_context
from pickle import PicklingError
from typing import Any, Literal, TypeAlias

import cloudpickle
import jax
import jaxlie
import numpy as np
import psutil

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import is_concrete, is_deferred
from mcgicp_jax._compute.linear_maps import KnownJacobian, primal, with_derivative
from mcgicp_jax._compute.messages import warn
from mcgicp_jax._compute.programs import COMPILATIONS, LOGGER
from mcgicp_jax._compute.threads import num_cores, with_settings
from mcgicp_jax._pairs.batch_jobs import NUM_CHECKED, BatchJob, Pair, PairResult, PreparedPair, RanPair
from mcgicp_jax._pairs.processes import Processes
from mcgicp_jax._registration.assessment import with_traced_pose
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.pose_derivative import Run
from mcgicp_jax._registration.register_pair import results_of
from mcgicp_jax._registration.result import RegistrationResult, Status, verified

GivenExecutor: TypeAlias = Executor | Literal["processes", "threads"] | None
# An executor; threads; or, if None, what is faster.
ChosenExecutor: TypeAlias = Executor | Literal["threads"] | None

# Number of pairs per chunk for a worker that is not a thread, and maximum number of submitted chunks.
_CHUNK_SIZE, _MAX_SUBMITTED = 8, 64
# Number of pairs per chunk for a process of this machine: 1 to 8 are equally fast, and few pairs are shared evenly.
_SMALL_CHUNK = 2
# Processes start if the time that they save is so many times their start: how much quicker they are is an estimate.
_PAYS = 1.5
# Seconds in which two workers start on two cores, besides what they compile; and memory of a worker, bytes, with pairs
# of some 10,000 points.
_START, _MEMORY = 3.2, 2**29
# Limits of the memory of a container, in two versions of Linux's control groups.
_MEMORY_LIMITS = [pathlib.Path("/sys/fs/cgroup", name) for name in ("memory.max", "memory/memory.limit_in_bytes")]


def checked_executor(executor: GivenExecutor) -> ChosenExecutor:
    """The executor to use; `ValueError` unless it is None, "processes", "threads" or an executor that may run JAX."""
    if isinstance(executor, str) and executor == "processes":
        return Processes(num_cores())
    if isinstance(executor, str) and executor == "threads":
        return "threads"
    if executor is not None and (isinstance(executor, type) or not hasattr(executor, "submit")):
        raise ValueError(
            f'executor: expected a concurrent.futures.Executor, "processes", "threads" or None, got {executor!r}'
        )
    context = getattr(executor, "_mp_context", None)
    if isinstance(executor, ProcessPoolExecutor) and context is not None and context.get_start_method() == "fork":
        raise ValueError(
            "executor: expected the start method spawn, got fork, with which JAX may hang; "
            'use "processes" or ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"))'
        )
    return executor


def run(
    job: BatchJob, pairs: Iterator[Pair], executor: ChosenExecutor, count: int | None
) -> Generator[tuple[int, RegistrationResult], None, None]:
    """`register_as_completed` for pairs, whose number is `count`, if it is known."""

    def concrete(pair: Pair) -> Pair:
        if not is_concrete(pair.source, pair.target, pair.prior):
            raise ValueError(
                f"pair {pair.index}: expected concrete arrays, got tracers; for derivatives, call register_batch "
                "outside of jit with lists of clouds"
            )
        return pair

    with contextlib.closing(_results(job, map(concrete, pairs), executor, count)) as results:
        for result in results:
            yield result.index, result.registration


def run_differentiated(
    job: BatchJob, pairs: Iterator[Pair], executor: ChosenExecutor, count: int | None
) -> list[RegistrationResult]:
    """The results of pairs whose arrays differentiation traces; workers compute the poses and their derivatives. Those
    of pairs that threads have run are computed side by side, once all have."""
    results: dict[int, RegistrationResult] = {}
    prepared: dict[int, PreparedPair] = {}
    runs: dict[int, Run] = {}
    if executor is None and job.has_priors:
        # Other processes return no derivatives by priors.
        executor = "threads"
    at_home = executor == "threads"

    def sent() -> Iterator[Pair]:
        """The values of pairs, each prepared while workers have those before it."""
        for pair in pairs:
            if not at_home and not is_concrete(pair.prior):
                raise ValueError(f"priors[{pair.index}]: expected concrete arrays with an executor, got tracers")
            ready = job.prepare(pair, at_home or executor is None or pair.index < NUM_CHECKED)
            if isinstance(ready, PairResult):
                results[pair.index] = ready.with_warning().registration
                continue
            # With a prior, whose pose is in the user's frames, the equation of the centred pose depends on the origins.
            origins = [cloud.origin for cloud in ready.inputs[:2]]
            if not at_home and ready.prior is not None and not is_concrete(*origins):
                raise ValueError(
                    f"priors[{pair.index}]: expected clouds with concrete origins with an executor, got tracers"
                )
            prepared[pair.index] = ready
            values = ready.inputs.values()
            source, target = values[:2]
            # Threads take the prior as it was checked, perhaps as a tracer; workers check its values.
            prior: Any = values.prior if at_home else ready.prior
            traced = tuple(i for i, leaf in enumerate(ready.leaves) if not is_concrete(leaf))
            start = ready.init, prior, traced, ready.doubt, ready.max_coarse_distance
            yield Pair(pair.index, source, target, *start)

    options = replace(job.options, robust=primal(job.options.robust))
    fixed = replace(job, method=primal(job.method), options=options, is_differentiated=True)
    for answer in _results(fixed, sent(), executor, count):
        if isinstance(answer, RanPair):
            runs[answer.index] = answer.run
            continue
        ready, result = prepared[answer.index], answer.registration
        if answer.jacobian:
            inputs = [leaf for leaf in ready.leaves if not is_concrete(leaf)]
            linear, value = KnownJacobian(answer.jacobian), np.asarray(result.centred.wxyz_xyz)
            (pose,) = with_derivative([value], linear, inputs)
            origins = ready.inputs.source.origin, ready.inputs.target.origin
            if is_concrete(origins):
                origins = result.source_origin, result.target_origin
            result = with_traced_pose(result, jaxlie.SE3(pose), *origins, ready.inputs)
        results[answer.index] = result
    differentiated = results_of(list(runs.values()), [prepared[index].inputs for index in runs])
    for (index, run), result in zip(runs.items(), differentiated, strict=True):
        ready = prepared[index]
        result = job.with_wanted_fields(verified(result, not ready.doubt))
        results[index] = PairResult(index, result, ready.doubt or run.doubt).with_warning().registration
    return [results[index] for index in sorted(results)]


def _results(
    job: BatchJob, pairs: Iterator[Pair], executor: ChosenExecutor, count: int | None
) -> Generator[Any, None, None]:
    if executor is None and job.uses_chunks:
        yield from map(PairResult.with_warning, job.register_in_chunks(pairs, num_cores()))
    elif executor is None:
        yield from _by_threads_then_processes(job, pairs, count)
    elif executor == "threads":
        yield from _by_threads(job, pairs)
    else:
        yield from ChunkedExecutor(job, executor).run(pairs)


def _by_threads(job: BatchJob, pairs: Iterator[Pair]) -> Iterator[Any]:
    with ThreadPoolExecutor(num_cores(), thread_name_prefix="mcgicp") as threads:
        yield from ChunkedExecutor(job, threads, own_threads=True).run(pairs)


def _by_threads_then_processes(job: BatchJob, pairs: Iterator[Pair], count: int | None) -> Iterator[Any]:
    """Threads register the first pairs, and are timed. If processes pay, they start meanwhile and register the rest."""
    rest: Iterator[Pair] | None = None
    start = _Start(job, count)

    def until_processes_run() -> Iterator[Pair]:
        nonlocal rest
        while True:
            begin = time.perf_counter()
            pair = next(pairs, None)
            start.idle += time.perf_counter() - begin
            if pair is None:
                return
            if start.has_ended(pair):
                rest = itertools.chain([pair], pairs)
                return
            yield pair

    try:
        for result in _by_threads(job, until_processes_run()):
            start.finished += 1
            begin = time.perf_counter()
            yield result
            start.idle += time.perf_counter() - begin
    finally:
        if rest is None and start.processes is not None:
            start.processes.shutdown(cancel_futures=True)
    if rest is not None and start.processes is not None:
        yield from ChunkedExecutor(job, start.processes, at_home=True).run(rest)
    elif start.possible and start.finished and start.processes is None:
        LOGGER.info("register_batch: %d pairs by threads; to start processes would not pay", start.finished)


class _Start:
    """The start of processes for the rest of a batch, if they pay."""

    def __init__(self, job: BatchJob, count: int | None):
        self._job, self._count = job, count
        # Pairs that threads have registered, and seconds in which the caller had the results, or made the next pair:
        # processes would not save them.
        self.finished, self.idle = 0, 0.0
        # None until they are started, and if they cannot run the job.
        self.processes: Processes | None = None
        # At the first call, and once each thread has compiled.
        self._begun: tuple[int, float] | None = None
        self._first: Future[int] | None = None
        # Seconds that it takes to send a pair, once it is known.
        self._sending: float | None = None
        # In a container, further processes may use what this one does not of its limit, bytes.
        available = psutil.virtual_memory().available
        for path in _MEMORY_LIMITS:
            # There is no such file, or no limit.
            with contextlib.suppress(OSError, ValueError):
                available = min(available, int(path.read_text()) - psutil.Process().memory_info().rss)
        self._num_workers = min(num_cores(), available // _MEMORY)
        # Workers of other pools have their cores to themselves.
        self.possible = self._num_workers > 1 and current_process().name == "MainProcess"

    def has_ended(self, pair: Pair) -> bool:
        """Whether the processes run; starts them if they pay and can be sent the next pair."""
        if not self.possible:
            return False
        try:
            if self._first is None and self._pays(pair):
                text = "register_batch: %d processes start, and take over from threads once they run"
                LOGGER.info(text, self._num_workers)
                self.processes = Processes(self._num_workers)
                # `len` only tests whether a worker can unpickle the job and the pair.
                self._first = self.processes.submit(len, (_as_numpy(self._job), _as_numpy(pair)))
            if self._first is None or not self._first.done():
                return False
            self._first.result()
        # Not what can be pickled, or imported by a worker; or this platform starts none.
        except Exception as error:
            LOGGER.info("register_batch: pairs stay in threads; %s", _words(error))
            self.possible = False
            if self.processes is not None:
                self.processes.shutdown(cancel_futures=True)
                self.processes = None
        return self.possible

    def _pays(self, pair: Pair) -> bool:
        now = time.perf_counter() - self.idle
        if self._begun is None and self.finished >= num_cores():
            self._begun = self.finished, now
        if self._begun is None or self.finished < self._begun[0] + num_cores():
            return False
        by_threads = (now - self._begun[1]) / (self.finished - self._begun[0])
        # As many as were sent, if nobody knows.
        left = pair.index if self._count is None else self._count - pair.index
        # n processes were (n + 1) / 2 times as quick as threads: 1.5 times on two cores, 8.6 times on sixteen.
        saved = by_threads * (1 - 2 / (self._num_workers + 1))
        start = 0.0 if Processes.are_warm else _START + COMPILATIONS.seconds
        if self._sending is None and left * saved > _PAYS * start:
            begin = time.perf_counter()
            # Functions are sent with all that they refer to.
            cloudpickle.dumps(_as_numpy(pair))
            self._sending = time.perf_counter() - begin
        return self._sending is not None and left * (saved - self._sending) > _PAYS * start


class ChunkedExecutor:
    """Chunks of pairs submitted to an executor, and pairs to retry.

    A chunk may fail because one of its pairs killed the worker, or because another chunk broke the pool. The pairs of
    failed chunks are suspects, submitted again at the end one by one: only those that fail alone get `WORKER_FAILED`.
    `at_home`: whether pairs that cannot be sent to another process are registered in this one, instead of an error.
    `own_threads`: whether the executor is that of `_by_threads`, where errors of differentiated pairs are raised.
    """

    def __init__(self, job: BatchJob, executor: Executor, at_home: bool = False, own_threads: bool = False):
        self._executor, self._at_home = executor, job if at_home else None
        self._replacement: Executor | None = None
        self._pickled = not isinstance(executor, ThreadPoolExecutor)
        self._chunk_size = _CHUNK_SIZE if self._pickled else 1
        self._max_submitted = 2 * num_cores() if own_threads else _MAX_SUBMITTED
        job = _as_numpy(job) if self._pickled else job
        work: Callable[..., Any] = job.register_chunk
        self._raises = own_threads and job.is_differentiated
        if self._raises:
            work = job.run_chunk
        elif isinstance(executor, Processes):
            work = job.register_chunk_alone
            # More submitted chunks than loky's queue holds, so that no worker waits.
            self._chunk_size, self._max_submitted = _SMALL_CHUNK, 4 * executor.num_workers
        self._register = with_settings(work, pickled=self._pickled)
        self._suspects: collections.deque[Pair] = collections.deque()
        self._submitted: dict[Future[list[PairResult | RanPair]], list[Pair]] = {}

    def run(self, pairs: Iterator[Pair]) -> Iterator[PairResult | RanPair]:
        try:
            while chunk := list(itertools.islice(pairs, self._chunk_size)):
                self._submit(chunk)
                while len(self._submitted) >= self._max_submitted:
                    yield from self._receive()
            while self._submitted:
                yield from self._receive()
            while self._suspects:
                self._submit([self._suspects.popleft()])
                yield from self._receive(last_try=True)
            if isinstance(self._executor, Processes):
                Processes.are_warm = True
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
            # The death of any worker breaks its process pool; one like it takes its place.
            broken = self._executor
            self._replacement = self._executor = ProcessPoolExecutor(
                getattr(broken, "_max_workers", None),
                getattr(broken, "_mp_context", None) or get_context("spawn"),
                getattr(broken, "_initializer", None),
                getattr(broken, "_initargs", ()),
            )
            future = self._executor.submit(self._register, sent)
        self._submitted[future] = chunk

    def _receive(self, last_try: bool = False) -> Iterator[PairResult | RanPair]:
        done, _ = futures.wait(self._submitted, return_when=futures.FIRST_COMPLETED)
        for future in done:
            chunk = self._submitted.pop(future)
            try:
                results = future.result()
            except Exception as error:
                if self._raises:
                    raise
                reason, results = _words(error), []
                if last_try:
                    failed = RegistrationResult.without_pose(Status.WORKER_FAILED)
                    results = [PairResult(chunk[0].index, failed, f"its worker failed twice ({reason})")]
                elif isinstance(error, PicklingError) and self._at_home is not None:
                    results = [*self._at_home.register_chunk(chunk)]
                elif isinstance(error, PicklingError):
                    # The message of the error in loky's thread, whose traceback is the text of the cause.
                    lines = [line for line in str(error.__cause__ or error).splitlines() if line.strip(' "')]
                    raise ValueError(
                        f"pairs {chunk[0].index} to {chunk[-1].index}: expected clouds and functions that can be sent "
                        f"to other processes; {lines[-1] if lines else type(error).__name__}"
                    ) from error
                else:
                    # A worker that dies breaks its pool, and so all chunks that were submitted.
                    if not self._suspects:
                        warn(f"a worker failed ({reason}); its pairs are submitted again, one by one, at the end")
                    self._suspects.extend(chunk)
            yield from (result.with_warning() if isinstance(result, PairResult) else result for result in results)


def _as_numpy(sent: Any) -> Any:
    """JAX arrays as NumPy, for pickling: float64 ones would become float32 if unpickled before x64 is switched on."""

    def convert(value: Any) -> Any:
        if isinstance(value, Options):
            return _as_numpy(value)
        if isinstance(value, PointCloud):
            # As a pytree it would lose its voxel size, in which a raw cloud of the same pair is averaged.
            return jax.tree.map(convert, value, is_leaf=is_deferred).replace_rows(voxels=value.voxels)
        return np.asarray(value) if isinstance(value, jax.Array) else value

    def is_leaf(value: Any) -> bool:
        return is_deferred(value) or isinstance(value, PointCloud)

    return replace(sent, **jax.tree.map(convert, dict(vars(sent)), is_leaf=is_leaf))


def _words(error: BaseException) -> str:
    # The first line: loky goes on with exit codes and advice.
    return f"{type(error).__name__}: {error}".partition("\n")[0].rstrip(": ")
