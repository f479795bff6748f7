"""Registration of many pairs of clouds, independently of each other, by threads, lanes or any executor."""

from __future__ import annotations

import collections
import itertools
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from concurrent.futures import wait as wait_for
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from typing import Any, Literal, TypeAlias

import equinox as eqx
import jax
import jaxlie
import numpy as np

from mcgicp_jax._clouds.point_cloud import PointCloud, Values
from mcgicp_jax._clouds.preprocess import check_preprocessing, preprocess
from mcgicp_jax._compute.size_classes import size_class
from mcgicp_jax._compute.threads import num_cores, with_settings
from mcgicp_jax._math.poses import Pose, pose_matrix
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pairs.register import register_from, start_from_anywhere
from mcgicp_jax._registration.make_result import registration_of
from mcgicp_jax._registration.options import Options, check_method, options_of
from mcgicp_jax._registration.register_pair import pose_problem
from mcgicp_jax._registration.result import Registration, Status, computed
from mcgicp_jax._registration.step import Problem
from mcgicp_jax._registration.vectorized import run_problems
from mcgicp_jax._search.base import AbstractSearch
from mcgicp_jax._search.brute_force import DenseSearch, default_search

Cloud: TypeAlias = PointCloud | Values | Callable[[], PointCloud | Values]

# Number of pairs per chunk sent to a worker that is not a thread, and maximum number of submitted chunks.
_CHUNK = 8
_CHUNKS_UNDER_WAY = 64


def register_batch(
    sources: Iterable[Cloud] | Cloud,
    targets: Iterable[Cloud] | Cloud,
    method: AbstractMethod,
    *,
    init: Iterable[Pose | Literal["global"] | None] | Pose | Literal["global"] | None = None,
    voxel_size: float | None = None,
    num_neighbors: int = 20,
    executor: Executor | None = None,
    **options: Any,
) -> list[Registration]:
    """Register many pairs of clouds of any sizes and return one `Registration` per pair, in the order of the pairs.

    Waits for all pairs; arguments, errors and warnings are those of `register_as_completed`.
    """
    completed = register_as_completed(
        sources,
        targets,
        method,
        init=init,
        voxel_size=voxel_size,
        num_neighbors=num_neighbors,
        executor=executor,
        **options,
    )
    return [result for _, result in sorted(completed, key=lambda item: item[0])]


def register_as_completed(
    sources: Iterable[Cloud] | Cloud,
    targets: Iterable[Cloud] | Cloud,
    method: AbstractMethod,
    *,
    init: Iterable[Pose | Literal["global"] | None] | Pose | Literal["global"] | None = None,
    voxel_size: float | None = None,
    num_neighbors: int = 20,
    executor: Executor | None = None,
    **options: Any,
) -> Generator[tuple[int, Registration], None, None]:
    """Register many pairs of clouds of any sizes and yield each result as soon as it is computed.

    Pairs are independent: a result is bitwise the same whatever the other pairs, their order and the number of workers,
    and a slow pair does not delay others. Invalid pairs (too few finite points, mismatched channels, unreadable file)
    get the status `INVALID_INPUT` and a warning. Iterators are consumed lazily.

    Args:
        sources, targets: iterables of equal length, of clouds from `preprocess`, raw clouds or (N, 3) arrays, metres;
            one side may be a single cloud for all pairs. An item may also be a function without arguments that returns
            a cloud, such as `functools.partial(mcgicp_jax.io.read, path)`, which the worker calls.
        method: as in `register`; parameters left None are estimated for each pair.
        init: T_target_source to start from: one for all pairs, or an iterable with one per pair; None is the identity,
            and "global" finds it by `global_pose`.
        voxel_size, num_neighbors: as in `preprocess`, for raw clouds, which the workers preprocess.
        executor: any `concurrent.futures.Executor`, such as a `ProcessPoolExecutor` with the start method "spawn" or
            Dask's `Client.get_executor()`; by default one thread per core. A pair whose worker dies is sent once more,
            and gets the status `LOST` and a warning if that fails too.
        options: options of `register`, except for `tie_points` and `prior`. `search` is also used to preprocess; by
            default SciPy's k-d tree with one thread per pair. With `DenseSearch`, the default on accelerators, pairs
            run as lanes of one vectorised program, spread over all local devices (not with `match_channels` or
            `scales`).

    Returns:
        A generator of the index of the pair, from 0, and its `Registration`.

    Raises:
        ValueError: if an argument common to all pairs is malformed, or the iterables differ in length.
    Warns:
        PairWarning: the reason for each pair with the status `INVALID_INPUT` or `LOST`; a `UserWarning`.
    """
    check_method(method)
    check_preprocessing(voxel_size, num_neighbors)
    _check_executor(executor)
    job = _Job(method, options_of(register_batch, options), voxel_size, num_neighbors)
    return _run(job, _pairs(job, sources, targets, init), executor)


class PairWarning(UserWarning):
    """A pair of a batch could not be registered.

    Attributes:
        index: of the pair, from 0.
        reason: why the pair has no pose.
    """

    # Not arguments of the constructor: code that copies or repeats warnings may construct them from a message alone.
    index: int | None = None
    reason: str = ""


@dataclass(frozen=True)
class _Pair:
    index: int
    source: Cloud
    target: Cloud
    init: Pose | Literal["global"] | None


@dataclass(frozen=True)
class _Job:
    """Settings common to all pairs."""

    method: AbstractMethod
    options: Options
    voxel_size: float | None
    num_neighbors: int

    def chosen_search(self) -> AbstractSearch:
        """The requested search, or the default of the machine that registers the pair."""
        return self.options.search or default_search(workers=1)

    @property
    def uses_lanes(self) -> bool:
        """Whether pairs run as lanes of one vectorised program."""
        several = self.options.match_channels or len(self.options.scales) > 0
        return isinstance(self.chosen_search(), DenseSearch) and not several

    def ready(self, name: str, cloud: Cloud) -> PointCloud:
        """The cloud, read and preprocessed if necessary; errors become a `ValueError` that starts with `name`."""
        try:
            if not isinstance(cloud, PointCloud) and callable(cloud):
                cloud = cloud()
            if not isinstance(cloud, PointCloud):
                cloud = PointCloud(cloud)
            if cloud.neighbors is None and not self.options.takes_raw(self.method, name):
                cloud = preprocess(cloud, self.voxel_size, self.num_neighbors, search=self.chosen_search())
        except (ValueError, OSError) as error:
            raise ValueError(f"{name}: {error}") from error
        return cloud

    def register(self, pair: _Pair) -> _Outcome:
        try:
            source, target = self.ready("source", pair.source), self.ready("target", pair.target)
            options = replace(self.options, search=self.chosen_search())
            result = register_from(source, target, self.method, pair.init, options)
        except ValueError as error:
            return _invalid(pair, error)
        return _Outcome(pair.index, computed(result))

    def problem(self, pair: _Pair) -> _Outcome | tuple[_Problem, Problem]:
        """The pair as input of a lane, both surfaces padded to one size class so that few programs are compiled."""
        try:
            source, target = self.ready("source", pair.source), self.ready("target", pair.target)
            init = pair.init
            if isinstance(init, str):
                start = start_from_anywhere(init, source, target)
                if not start.success:
                    return _Outcome(pair.index, Registration.without_pose(Status.TOO_FEW_CORRESPONDENCES))
                init = start.matrix
            problem, _ = pose_problem(source, target, self.method, init, self.options, num_threads=1)
            problem = _padded(problem, size_class(max(len(source.points), len(target.points))))
        except ValueError as error:
            return _invalid(pair, error)
        return _Problem(pair.index, source, target), problem

    def register_all(self, pairs: Iterable[_Pair], num_threads: int) -> Iterator[_Outcome]:
        """Register pairs in lanes on this machine; threads preprocess them."""
        with ThreadPoolExecutor(num_threads, thread_name_prefix="mcgicp") as threads:
            rejected: list[_Outcome] = []

            def problems() -> Iterator[tuple[_Problem, Problem]]:
                for problem in _ahead(threads, with_settings(self.problem), pairs, 2 * num_threads):
                    if isinstance(problem, _Outcome):
                        rejected.append(problem)
                    else:
                        yield problem

            limit = self.options.max_iterations
            for ended in run_problems(problems(), self.chosen_search(), limit):
                pair = ended.key
                result = registration_of(ended.state, ended.assessment, ended.history, pair.source, pair.target)
                yield _Outcome(pair.index, result)
            yield from rejected


def _padded(problem: Problem, size: int) -> Problem:
    """Pad both surfaces to `size` rows; padding matches nothing."""

    def grow(array: np.ndarray) -> np.ndarray:
        return np.pad(array, [(0, size - len(array))] + [(0, 0)] * (array.ndim - 1))

    source, target = (jax.tree.map(grow, surface) for surface in (problem.source, problem.target))
    return eqx.tree_at(lambda problem: (problem.source, problem.target), problem, (source, target))


@dataclass(frozen=True)
class _Problem:
    """A pair in a lane: its index and its preprocessed clouds."""

    index: int
    source: PointCloud
    target: PointCloud


@dataclass(frozen=True)
class _Outcome:
    index: int
    result: Registration
    reason: str | None = None


def _invalid(pair: _Pair, error: ValueError) -> _Outcome:
    return _Outcome(pair.index, Registration.without_pose(Status.INVALID_INPUT), str(error))


def _register_chunk(job: _Job, chunk: list[_Pair]) -> list[_Outcome]:
    if job.uses_lanes:
        return list(job.register_all(chunk, 1))
    return [job.register(pair) for pair in chunk]


def _ahead(executor: Executor, function: Callable[[_Pair], Any], pairs: Iterable[_Pair], most: int) -> Iterator[Any]:
    """Yield `function(pair)` in order, with at most `most` calls computed ahead."""
    futures: collections.deque[Future[Any]] = collections.deque()
    for pair in pairs:
        futures.append(executor.submit(function, pair))
        if len(futures) > most:
            yield futures.popleft().result()
    while futures:
        yield futures.popleft().result()


def _run(
    job: _Job, pairs: Iterator[_Pair], executor: Executor | None
) -> Generator[tuple[int, Registration], None, None]:
    num_workers = num_cores()
    if executor is None and job.uses_lanes:
        yield from map(_report, job.register_all(pairs, num_workers))
    elif executor is None:
        with ThreadPoolExecutor(num_workers, thread_name_prefix="mcgicp") as threads:
            yield from _dispatch(_Shipping(job, threads), pairs, 1, 2 * num_workers)
    elif isinstance(executor, ThreadPoolExecutor):
        yield from _dispatch(_Shipping(job, executor), pairs, 1, _CHUNKS_UNDER_WAY)
    else:
        yield from _dispatch(_Shipping(job, executor), pairs, _CHUNK, _CHUNKS_UNDER_WAY)


def _dispatch(
    shipping: _Shipping, pairs: Iterator[_Pair], chunk_size: int, most: int
) -> Iterator[tuple[int, Registration]]:
    """Submit chunks, at most `most` at a time, and yield their results."""
    try:
        while chunk := list(itertools.islice(pairs, chunk_size)):
            shipping.send(chunk)
            while len(shipping.under_way) >= most:
                yield from shipping.receive()
        while shipping.under_way:
            yield from shipping.receive()
        yield from shipping.receive_suspects()
    finally:
        shipping.stop()


class _Shipping:
    """Chunks submitted to an executor, and pairs to retry.

    A chunk may fail because one of its pairs killed the worker, or because another chunk broke the pool. The pairs of
    failed chunks are suspects, submitted again at the end one by one, so that only those that fail alone become `LOST`.
    """

    def __init__(self, job: _Job, executor: Executor):
        self._executor = executor
        self._replacement: Executor | None = None
        self._pickled = not isinstance(executor, ThreadPoolExecutor)
        if self._pickled:
            job = _as_numpy(job)
        self._register = with_settings(partial(_register_chunk, job), pickled=self._pickled)
        self._suspects: collections.deque[_Pair] = collections.deque()
        self.under_way: dict[Future[list[_Outcome]], list[_Pair]] = {}

    def send(self, chunk: list[_Pair]) -> None:
        sent = [_as_numpy(pair) for pair in chunk] if self._pickled else chunk
        try:
            future = self._executor.submit(self._register, sent)
        except BrokenExecutor:
            self._replacement = self._executor = _like(self._executor)
            future = self._executor.submit(self._register, sent)
        self.under_way[future] = chunk

    def receive(self) -> Iterator[tuple[int, Registration]]:
        """Wait for at least one chunk and yield its results; the pairs of failed chunks become suspects."""
        done, _ = wait_for(self.under_way, return_when=FIRST_COMPLETED)
        for future in done:
            chunk = self.under_way.pop(future)
            try:
                outcomes = future.result()
            except Exception as error:
                numbers = ", ".join(str(pair.index) for pair in chunk)
                message = f"the worker of the pairs {numbers} failed ({_words(error)}); they are submitted again"
                warnings.warn(message, UserWarning, stacklevel=2)
                self._suspects.extend(chunk)
            else:
                yield from map(_report, outcomes)

    def receive_suspects(self) -> Iterator[tuple[int, Registration]]:
        """Submit suspects one by one and yield their results."""
        while self._suspects:
            pair = self._suspects.popleft()
            self.send([pair])
            future, _ = self.under_way.popitem()
            try:
                outcomes = future.result()
            except Exception as error:
                result = Registration.without_pose(Status.LOST)
                outcomes = [_Outcome(pair.index, result, f"its worker failed twice ({_words(error)})")]
            yield from map(_report, outcomes)

    def stop(self) -> None:
        """Cancel chunks that have not started."""
        for future in self.under_way:
            future.cancel()
        if self._replacement is not None:
            self._replacement.shutdown(cancel_futures=True)


def _like(executor: Executor) -> Executor:
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
        return np.asarray(value) if isinstance(value, jax.Array) else value

    fields = {name: getattr(sent, name) for name in sent.__dataclass_fields__}
    return replace(
        sent,
        **{
            name: _as_numpy(value) if isinstance(value, Options) else jax.tree.map(convert, value)
            for name, value in fields.items()
        },
    )


def _report(outcome: _Outcome) -> tuple[int, Registration]:
    if outcome.reason is not None:
        warning = PairWarning(f"pair {outcome.index}: {outcome.reason}")
        warning.index, warning.reason = outcome.index, outcome.reason
        warnings.warn(warning, stacklevel=2)
    return outcome.index, outcome.result


def _words(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".rstrip(": ")


def _pairs(
    job: _Job,
    sources: Iterable[Cloud] | Cloud,
    targets: Iterable[Cloud] | Cloud,
    init: Iterable[Pose | Literal["global"] | None] | Pose | Literal["global"] | None,
) -> Iterator[_Pair]:
    """Iterate lazily over the pairs; arguments common to all are checked immediately."""
    if isinstance(init, str) and init != "global":
        raise ValueError(f'init: expected a pose, "global", or one per pair, got {init!r}')
    sides: dict[str, Any] = {"sources": sources, "targets": targets, "init": init}
    one_for_all = {"sources": _is_one_cloud(sources), "targets": _is_one_cloud(targets), "init": _is_one_pose(init)}
    if one_for_all["sources"] and one_for_all["targets"]:
        raise ValueError("sources: expected several clouds on at least one side, got one on each; call register")
    for name in sides:
        if one_for_all[name]:
            if name != "init":
                sides[name] = job.ready(name, sides[name])
            elif not isinstance(init, str):
                sides[name] = pose_matrix(sides[name])
            sides[name] = itertools.repeat(sides[name])
        elif isinstance(sides[name], jaxlie.SE3):
            sides[name] = np.asarray(sides[name].as_matrix())
        elif not isinstance(sides[name], Iterable):
            raise ValueError(f"{name}: expected an iterable with one per pair, got {type(sides[name]).__name__}")
    several = {name: values for name, values in sides.items() if not one_for_all[name]}
    sizes = {name: len(values) for name, values in several.items() if hasattr(values, "__len__")}
    if len(set(sizes.values())) > 1:
        raise ValueError(f"{next(iter(sizes))}: expected one per pair on all sides, got {sizes}")
    return _zip_pairs(sides, tuple(several))


def _zip_pairs(sides: dict[str, Any], several: tuple[str, ...]) -> Iterator[_Pair]:
    iterators = {name: iter(values) for name, values in sides.items()}
    end: Any = object()
    for index in itertools.count():
        values = {name: next(iterator, end) for name, iterator in iterators.items()}
        ended = [name for name in several if values[name] is end]
        if ended:
            if len(ended) < len(several):
                raise ValueError(f"{ended[0]}: expected one per pair, got {index}, fewer than on the other side")
            return
        yield _Pair(index, values["sources"], values["targets"], values["init"])


def _is_one_cloud(given: object) -> bool:
    if isinstance(given, PointCloud):
        return True
    return callable(given) or getattr(given, "ndim", None) == 2


def _is_one_pose(given: object) -> bool:
    if isinstance(given, jaxlie.SE3):
        return given.wxyz_xyz.ndim == 1
    return given is None or isinstance(given, str) or getattr(given, "ndim", None) == 2


def _check_executor(executor: Executor | None) -> None:
    if executor is not None and not hasattr(executor, "submit"):
        raise ValueError(f"executor: expected a concurrent.futures.Executor or None, got {executor!r}")
    context = getattr(executor, "_mp_context", None)
    if isinstance(executor, ProcessPoolExecutor) and context is not None and context.get_start_method() == "fork":
        raise ValueError(
            "executor: expected the start method spawn, got fork, with which JAX may hang; "
            'use ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"))'
        )
