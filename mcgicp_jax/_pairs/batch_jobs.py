"""One pair of a batch: how it is prepared and registered, alone or in a chunk of one program."""

from __future__ import annotations

import collections
import contextlib
import functools
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias, cast

import jax
import numpy as np

from mcgicp_jax._clouds.origins import centred_pose
from mcgicp_jax._clouds.point_cloud import PointCloud, Values, as_cloud
from mcgicp_jax._clouds.preprocess import check_preprocessing
from mcgicp_jax._clouds.voxel_size import VoxelSize
from mcgicp_jax._compute.concrete import is_deferred
from mcgicp_jax._compute.devices import computed_on_cpu, on_accelerator
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.messages import messages_named, warn, warnings_named
from mcgicp_jax._compute.threads import with_settings
from mcgicp_jax._local_geometry.sensor_patterns import doubt_of_patterns
from mcgicp_jax._math.poses import Pose, se3_from_matrix
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pairs.register import doubt_of, doubt_of_global_pose, start_from_anywhere
from mcgicp_jax._pose_solver.pose_measurements import Prior
from mcgicp_jax._registration import input_checks
from mcgicp_jax._registration.assessment import registration_of
from mcgicp_jax._registration.chunks import ChunkPair, Refused, run_pairs
from mcgicp_jax._registration.options import Options, check_method
from mcgicp_jax._registration.pose_derivative import Inputs, Run, parameters_by
from mcgicp_jax._registration.register_pair import prepared, preprocessed, results_of, run_pair, without_sensor_patterns
from mcgicp_jax._registration.result import RegistrationResult, Status, computed, unknown_uncertainty, verified
from mcgicp_jax._registration.tie_points_and_prior import GivenPrior, checked_measurements
from mcgicp_jax._search.brute_force import DenseSearch
from mcgicp_jax._search.default_search import default_search

# Number of pairs whose neighbourhoods are looked at, for warnings, where a device or a worker finds the neighbours: of
# 6.1 ms in which the host prepared a pair of 2,000 points, this took 4.7, and the pairs of a batch are mostly alike.
NUM_CHECKED = 8

# Rows of clouds that one thread prepares for chunks: most of this work is Python's, whose threads wait for each other
# (on 16 cores, 433 pairs of 2,000 points per second by one thread, 310 by four, 260 by 16; of 6,000 points 270, 280,
# 217). As many pairs are prepared ahead as the largest chunk has.
_SMALL, _SMALL_AHEAD = 8192, 256

Cloud: TypeAlias = PointCloud | Values | Callable[[], PointCloud | Values]


class PairWarning(UserWarning):
    """A pair of a batch could not be registered, or its pose is probably wrong.

    Attributes:
        index: of the pair, from 0.
        reason: why.
    """

    # Not arguments of the constructor: code that copies or repeats warnings may construct them from a message alone.
    index: int | None = None
    reason: str = ""


@dataclass(frozen=True)
class Pair:
    """The arguments of one pair. `traced` numbers the leaves of clouds, method and kernel by which the pose is to be
    differentiated; if there are any, the other fields are those of a `PreparedPair`. `prior` may be a `Prior`, too."""

    index: int
    source: Cloud
    target: Cloud
    init: Pose | Literal["global"] | None
    prior: GivenPrior | None = None
    traced: tuple[int, ...] = ()
    doubt: str = ""
    max_coarse_distance: float = np.inf


@dataclass(frozen=True)
class PairResult:
    """The result of one pair.

    Attributes:
        reason: why it has no pose or a doubtful one; "" if it has a good one, or the status is the reason.
        warnings: issued in another process.
        jacobian: (7, ...) derivative of the centred pose by each leaf in `Pair.traced`.
    """

    index: int
    registration: RegistrationResult
    reason: str = ""
    warnings: tuple[str, ...] = ()
    jacobian: tuple[np.ndarray, ...] = ()

    def with_warning(self) -> PairResult:
        """The result; issues the warnings, and a `PairWarning` if there is a reason for it."""
        for message in self.warnings:
            warn(message)
        reason = self.reason or doubt_of(self.registration)
        if reason:
            warning = PairWarning(f"pair {self.index}: {reason}")
            warning.index, warning.reason = self.index, reason
            warn(warning)
        return self


@dataclass(frozen=True)
class RanPair:
    """A pair registered in this process, whose result has yet to be computed, with its derivative."""

    index: int
    run: Run


@dataclass(frozen=True)
class PreparedPair:
    """A pair of preprocessed clouds. `doubt`: why the initial pose of `global_pose` is doubtful; "" if it is not."""

    index: int
    inputs: Inputs
    init: Pose | None
    prior: GivenPrior | None = None
    doubt: str = ""
    max_coarse_distance: float = np.inf

    @property
    def leaves(self) -> list[Any]:
        """Those of clouds, method and kernel."""
        return jax.tree.leaves(self.inputs[:4], is_leaf=is_deferred)


def _of_a_pair(work: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator of methods for one pair: a `ValueError` becomes the reason of its result."""

    @functools.wraps(work)
    def caught(self: BatchJob, pair: Pair | PreparedPair, *arguments: Any) -> Any:
        try:
            return work(self, pair, *arguments)
        except ValueError as error:
            return PairResult(pair.index, RegistrationResult.without_pose(Status.INVALID_INPUT), str(error))

    return caught


@dataclass(frozen=True)
class BatchJob:
    """Settings of all pairs. `checked`: whether to look at neighbourhoods, units and patterns in channels, and warn.
    Patterns are left out in any case; chunks find them on the device. `is_differentiated`: see `run_differentiated`."""

    method: AbstractMethod
    options: Options
    voxel_size: VoxelSize
    num_neighbors: int
    covariances: bool = True
    has_priors: bool = False
    checked: bool = True
    is_differentiated: bool = False

    def __post_init__(self) -> None:
        check_method(self.method)
        check_preprocessing(self.voxel_size, self.num_neighbors)
        if self.has_priors and not self.options.hold_unconstrained:
            raise ValueError("hold_unconstrained: expected True with priors, got False")

    @property
    def _options(self) -> Options:
        """The options, with the default search outside of chunks."""
        return self.options if self.options.search else replace(self.options, search=default_search(workers=1))

    @property
    def uses_chunks(self) -> bool:
        """Whether pairs run in chunks of one program, if no executor is given."""
        repeated = self.options.equalize_channels or len(self.options.voxel_sizes) > 0 or self.has_priors
        search = self.options.search
        on_device = on_accelerator() if search is None else isinstance(search, DenseSearch)
        return on_device and not repeated and not self.is_differentiated

    def ready(self, clouds: dict[str, Cloud], checked: bool = True) -> list[PointCloud]:
        """Clouds by their names, read and preprocessed if necessary; errors become a `ValueError` that names one."""
        options = self._options, self.voxel_size, self.num_neighbors, self.checked and checked
        return preprocessed(_read(clouds), self.method, *options)

    @_of_a_pair
    def prepare(self, pair: Pair, neighborhoods_checked: bool = True) -> PreparedPair | PairResult:
        with warnings_named(f"pair {pair.index}"):
            source, target = self.ready({"source": pair.source, "target": pair.target}, neighborhoods_checked)
            if self.checked:
                input_checks.warn_of_lengths(source, target)
        options, soft = self.options, self.options.soft_matches is not False
        # Warnings from here on do not name the pair, so that Python shows each once.
        input_checks.warn_of_estimated_parameters(self.method, source, target, soft, options.equalize_channels)
        inputs = prepared(source, target, self.method, options, prior=pair.prior, channels_checked=self.checked)
        if not isinstance(pair.init, str):
            init = pair.prior[0] if pair.init is None and pair.prior is not None else pair.init
            return PreparedPair(pair.index, inputs, primal(init), pair.prior)
        start, distance = start_from_anywhere(pair.init, primal(source), primal(target), options)
        doubt = doubt_of_global_pose(start)
        if not start.num_inliers:
            return PairResult(pair.index, RegistrationResult.without_pose(Status.TOO_FEW_CORRESPONDENCES), doubt)
        return PreparedPair(pair.index, inputs, start.matrix, pair.prior, doubt, distance)

    @computed_on_cpu
    def register_chunk(self, chunk: list[Pair]) -> list[PairResult]:
        """Register the pairs one after the other, on the CPU: workers would compete for an accelerator."""
        return [self._register_with_jacobian(pair) if pair.traced else self._register(pair) for pair in chunk]

    def register_chunk_alone(self, chunk: list[Pair]) -> list[PairResult]:
        """`register_chunk` in a process without other threads; the first result has the warnings."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            first, *others = self.register_chunk(chunk)
        return [replace(first, warnings=tuple(str(warning.message) for warning in caught)), *others]

    @_of_a_pair
    def _register(self, pair: Pair) -> PairResult:
        ready = self.prepare(pair)
        if isinstance(ready, PairResult):
            return ready
        # A pair of `run_differentiated` may start at a pose of `global_pose`, with its doubt and coarse distance.
        distance = min(ready.max_coarse_distance, pair.max_coarse_distance)
        return self._register_prepared(replace(ready, doubt=ready.doubt or pair.doubt, max_coarse_distance=distance))

    @_of_a_pair
    def _register_with_jacobian(self, pair: Pair) -> PairResult:
        ready = self._sent(pair)
        run = self._run(ready)
        if isinstance(run, PairResult):
            return run
        arrays = [ready.leaves[i] for i in pair.traced]
        slopes = parameters_by(ready.inputs, run, arrays)
        blocks = tuple(slope.astype(array.dtype) for slope, array in zip(slopes, arrays, strict=True))
        return replace(self._result(ready, results_of([run], [run.inputs])[0], run.doubt), jacobian=blocks)

    @computed_on_cpu
    def run_chunk(self, chunk: list[Pair]) -> list[RanPair | PairResult]:
        """`register_chunk` in a thread, for pairs that are differentiated: in this process, their derivatives take less
        time without a Jacobian."""
        runs = ((pair.index, self._run(self._sent(pair))) for pair in chunk)
        return [RanPair(index, run) if isinstance(run, Run) else run for index, run in runs]

    def _sent(self, pair: Pair) -> PreparedPair:
        """A pair of `run_differentiated`, of values."""
        source, target, prior = cast(Any, (pair.source, pair.target, pair.prior))
        if not isinstance(prior, Prior):
            _, prior = checked_measurements(None, prior, source, target)
        inputs = Inputs(source, target, self.method, self.options.robust, prior=prior)
        return PreparedPair(pair.index, inputs, cast(Pose, pair.init), None, pair.doubt, pair.max_coarse_distance)

    @_of_a_pair
    def _run(self, pair: PreparedPair) -> PairResult | Run:
        options = replace(self._options, max_coarse_distance=pair.max_coarse_distance)
        return run_pair(pair.inputs, pair.init, options)

    @computed_on_cpu
    def _register_prepared(self, pair: PreparedPair) -> PairResult:
        if self.method.uses_channels and not self.checked:
            source, target = without_sensor_patterns(*pair.inputs[:2], self.method)
            pair = replace(pair, inputs=pair.inputs._replace(source=source, target=target))
        run = self._run(pair)
        if isinstance(run, PairResult):
            return run
        return self._result(pair, results_of([run], [run.inputs])[0], run.doubt)

    def register_in_chunks(self, pairs: Iterable[Pair], num_threads: int) -> Iterator[PairResult]:
        """Register the pairs in chunks on this machine. One thread prepares those of small clouds, several the others;
        these also register pairs again that may have left a right initial pose."""
        # On the host neighbours are needed for warnings alone, of a sample of points.
        on_host = replace(self, options=replace(self.options, search=default_search(workers=1)))
        unchecked = replace(on_host, checked=False)
        search, most = self.options.search or DenseSearch(), self.options.max_source_points
        one, threads = (ThreadPoolExecutor(count, thread_name_prefix="mcgicp") for count in (1, num_threads))
        with contextlib.ExitStack() as stack:
            # Waiting calls do not begin once this is left, be it by an error or an early end.
            for pool in (one, threads):
                stack.callback(pool.shutdown, cancel_futures=True)
            rejected: list[PairResult] = []
            again: collections.deque[Future[PairResult]] = collections.deque()
            register = with_settings(unchecked._register_prepared)
            prepare = with_settings(lambda pair: (on_host if pair.index < NUM_CHECKED else unchecked)._chunk_pair(pair))

            def ready() -> Iterator[tuple[PreparedPair, ChunkPair]]:
                for pair in _computed_ahead(prepare, pairs, one, threads, 2 * num_threads):
                    if isinstance(pair, PairResult):
                        rejected.append(pair)
                    else:
                        yield pair

            for ended in run_pairs(ready(), self.method, self.options, search, self.num_neighbors, self.covariances):
                while rejected:
                    yield rejected.pop(0)
                while again and again[0].done():
                    yield again.popleft().result()
                pair = ended.key
                if isinstance(ended, Refused):
                    invalid = RegistrationResult.without_pose(Status.INVALID_INPUT)
                    yield PairResult(pair.index, invalid, str(ended.reason))
                elif ended.has_doubt:
                    again.append(threads.submit(register, pair))
                else:
                    source, target = pair.inputs[:2]
                    matchable = np.ones(min(len(source), most or len(source)), bool)
                    result = registration_of(ended.state, ended.assessment, ended.history, source, target, matchable)
                    doubt = doubt_of_patterns(source) if result.status is Status.UNVERIFIED else ""
                    yield self._result(pair, result, doubt)
            yield from rejected
            yield from (future.result() for future in again)

    @_of_a_pair
    def _chunk_pair(self, pair: Pair) -> PairResult | tuple[PreparedPair, ChunkPair]:
        """The pair of a chunk, with each cloud padded to a size class so that few programs are compiled."""
        with warnings_named(f"pair {pair.index}"):
            clouds = _read({"source": pair.source, "target": pair.target})
        ready = self.prepare(replace(pair, source=clouds["source"], target=clouds["target"]))
        if isinstance(ready, PairResult):
            return ready
        source, target = ready.inputs[:2]
        input_checks.check_clouds(source, target, self.method)
        if self.checked:
            input_checks.warn_of_inputs(source, target, self.method, self.options.equalize_channels)
        pose = se3_from_matrix(centred_pose(ready.init, source, target), source.points.dtype)
        # `preprocess` returns clouds that have neighbours as they are; the others get theirs on the devices.
        sides = []
        for before, cloud in zip(clouds.values(), (source, target), strict=True):
            arrays: dict[str, Any] = {"origin": np.zeros(3, cloud.points.dtype), "channel_names": ()}
            if not self.method.uses_channels:
                arrays |= {"channels": cloud.points[:, :0], "channel_valid": None}
            if before.deferred_neighbors is None:
                arrays["deferred_neighbors"] = None
            sides.append(cloud.replace_rows(**arrays).pad())
        return ready, ChunkPair(pose, source.points.dtype.type(ready.max_coarse_distance), *sides)

    def _result(self, pair: PreparedPair, result: RegistrationResult, doubt: str) -> PairResult:
        """The result without references to the clouds; UNVERIFIED if the initial pose is, or the overlap is small."""
        result = self.with_wanted_fields(verified(result, not pair.doubt))
        return PairResult(pair.index, computed(result), pair.doubt or doubt)

    def with_wanted_fields(self, result: RegistrationResult) -> RegistrationResult:
        """The result, without covariance if so wanted."""
        return result if self.covariances else result.build(**vars(result) | {"uncertainty": unknown_uncertainty()})


def _read(clouds: dict[str, Cloud]) -> dict[str, PointCloud]:
    sides = dict[str, PointCloud]()
    for name, cloud in clouds.items():
        if callable(cloud) and not isinstance(cloud, PointCloud):
            with messages_named(name):
                try:
                    cloud = cloud()
                except (ValueError, OSError):
                    raise
                # `sys.exit` in the reader of one cloud must not end the batch.
                except (Exception, SystemExit) as error:
                    place = traceback.extract_tb(error.__traceback__)[-1]
                    reason = f"{type(error).__name__}: {error}".rstrip(": ")
                    raise ValueError(f"{reason} ({place.filename}, line {place.lineno})") from error
        sides[name] = as_cloud(name, cloud)
    return sides


def _computed_ahead(
    function: Callable[[Pair], Any], pairs: Iterable[Pair], for_small: Executor, for_others: Executor, count: int
) -> Iterator[Any]:
    """Yield `function(pair)` in order, with up to `count` calls ahead, or `_SMALL_AHEAD` where pairs are small."""
    futures: collections.deque[Future[Any]] = collections.deque()
    for pair in pairs:
        # Quickly prepared: arrays, not what is still to be read, and a pose that need not be found.
        arrays = (cloud.points if isinstance(cloud, PointCloud) else cloud for cloud in (pair.source, pair.target))
        shapes = [array.shape if isinstance(array, np.ndarray | jax.Array) else () for array in arrays]
        small = not isinstance(pair.init, str) and all(0 < len(shape) <= 2 and shape[0] <= _SMALL for shape in shapes)
        futures.append((for_small if small else for_others).submit(function, pair))
        while len(futures) > (_SMALL_AHEAD if small else count):
            yield futures.popleft().result()
    while futures:
        yield futures.popleft().result()
