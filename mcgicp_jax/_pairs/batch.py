"""Registration of many pairs of clouds, independently of each other, by threads, on a device or by any executor."""

from __future__ import annotations

import itertools
from collections.abc import Generator, Iterable, Iterator
from typing import Any, Literal, TypeAlias, Unpack

import jaxlie
import numpy as np

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._clouds.voxel_size import NUM_NEIGHBORS, VoxelSize
from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._math.poses import Pose, checked_pose_matrix, matrix_of
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._pairs.batch_executors import GivenExecutor, checked_executor, run, run_differentiated
from mcgicp_jax._pairs.batch_jobs import BatchJob, Cloud, Pair
from mcgicp_jax._registration.options import GivenOptions, options_of
from mcgicp_jax._registration.result import RegistrationResult
from mcgicp_jax._registration.tie_points_and_prior import GivenPrior

Start: TypeAlias = Pose | Literal["global"] | None


def register_batch(
    sources: Iterable[Cloud] | Cloud,
    targets: Iterable[Cloud] | Cloud,
    method: AbstractMethod,
    *,
    init: Iterable[Start] | Start = None,
    priors: Iterable[GivenPrior | None] | None = None,
    voxel_size: VoxelSize = "auto",
    num_neighbors: int = NUM_NEIGHBORS,
    executor: GivenExecutor = None,
    covariances: bool = True,
    **options: Unpack[GivenOptions],
) -> list[RegistrationResult]:
    """Register many pairs of clouds of any sizes; return one `RegistrationResult` per pair, in the order of the pairs.

    Waits for all pairs. See `register_as_completed` for arguments, errors and warnings.

    Outside `jit`, the poses have derivatives, as those of `register`, by the points and channels of the clouds, the
    parameters of the method and the priors. They are computed side by side, so that `jax.value_and_grad` of a loss over
    the poses of many pairs is one call. Other processes return those of their pairs as (7, n) matrices. Clouds and
    priors must be given in lists then. Inside `jit` and `vmap`, use `register`.
    """
    checked_options = options_of(register_batch, options)
    job = BatchJob(method, checked_options, voxel_size, num_neighbors, covariances, priors is not None)
    workers, (pairs, count) = checked_executor(executor), _pairs(job, sources, targets, init, priors)
    # A look at an iterator would use it up.
    clouds = [side for side in (sources, targets) if isinstance(side, list | tuple | PointCloud)]
    inputs = clouds, job.method, job.options.robust, priors if isinstance(priors, list | tuple) else None
    if not is_concrete(primal(inputs)):
        raise ValueError(
            "sources, targets: expected concrete arrays, got tracers; call register_batch outside of jit and vmap, "
            "or register inside of them"
        )
    if not is_concrete(inputs):
        return run_differentiated(job, pairs, workers, count)
    return [result for _, result in sorted(run(job, pairs, workers, count), key=lambda item: item[0])]


def register_as_completed(
    sources: Iterable[Cloud] | Cloud,
    targets: Iterable[Cloud] | Cloud,
    method: AbstractMethod,
    *,
    init: Iterable[Start] | Start = None,
    priors: Iterable[GivenPrior | None] | None = None,
    voxel_size: VoxelSize = "auto",
    num_neighbors: int = NUM_NEIGHBORS,
    executor: GivenExecutor = None,
    covariances: bool = True,
    **options: Unpack[GivenOptions],
) -> Generator[tuple[int, RegistrationResult], None, None]:
    """Register many pairs of clouds of any sizes and yield each result as soon as it is computed.

    Pairs are independent: a result is the same for any other pairs, any order and any number of workers, bitwise with
    trees and to rounding with `DenseSearch`, and a slow pair does not delay others. Invalid pairs (too few finite
    points, mismatched channels, unreadable file, a function that raises) get the status `INVALID_INPUT` and a warning.
    Iterators are consumed lazily.

    Args:
        sources, targets: iterables of equal length, of clouds from `preprocess`, raw clouds or (N, 3) arrays, metres;
            one side may be a single cloud for all pairs. An item may also be a function without arguments that returns
            a cloud, such as `functools.partial(mcgicp_jax.io.read, path)`, which the worker calls.
        method: as in `register`; parameters left None are estimated for each pair.
        init: initial T_target_source: one for all pairs, or an iterable with one per pair. None is the pose of the
            prior, if there is one, or the identity, and "global" the pose found by `global_pose`.
        priors: one per pair: a measurement of T_target_source, in the form of the `prior` of `register`, or None. Pairs
            with priors run on the CPU. With an `executor`, the poses have no derivatives by them, nor by origins then.
        voxel_size, num_neighbors: as in `preprocess`, for raw clouds, which the workers preprocess. "auto": one size
            for both clouds of a pair; that of a single cloud for all pairs, if it has any, applies to all.
        executor: None: threads, one per core, until the time that processes would save on the other pairs is 1.5 times
            that of their start; then these. The logger `mcgicp_jax` says so (INFO). Functions that return clouds then
            run there, on copies of what they refer to. "threads"; "processes", one per core, which need no `__main__`
            guard, start in 3 to 16 s, and wait for further calls until this process ends; or any
            `concurrent.futures.Executor`, such as Dask's `Client.get_executor()`. A pair whose worker dies is sent once
            more, and gets the status `WORKER_FAILED` and a warning if that fails too.
        covariances: False saves a tenth of the time, and compilation on accelerators: `covariance` and `deviations` are
            NaN.
        options: options of `register`, except for `tie_points` and `prior`. `search` is also used to preprocess; by
            default `KDTreeSearch` with one thread per pair. With `DenseSearch`, or without a search on accelerators,
            pairs run in chunks of one vectorised program on `jax.default_device`, or spread over all local devices (not
            with an `executor`, `priors`, `equalize_channels` or `voxel_sizes`), which finds neighbours by brute force.
            It compiles for each combination of sizes, rounded up to 128, 192, 256, 384, ... points, for 20 to 40 s,
            but not for one that fits in an earlier one of at most 1,024 points, or fills half of it. Only the first
            eight pairs are looked at for warnings of neighbourhoods, units and patterns in channels. Pairs that may
            have left a right initial pose (`mcgicp_jax.guide`) are registered again on the CPU.

    Returns:
        A generator of the index of the pair, from 0, and its `RegistrationResult`.

    Raises:
        ValueError: if an argument common to all pairs is malformed, or the iterables differ in length.
    Warns:
        PairWarning: the reason for each pair with the status `INVALID_INPUT`, `WORKER_FAILED` or `UNVERIFIED`, or for
            which `global_pose` finds no pose; a `UserWarning`.
    """
    checked_options = options_of(register_as_completed, options)
    job = BatchJob(method, checked_options, voxel_size, num_neighbors, covariances, priors is not None)
    workers, (pairs, count) = checked_executor(executor), _pairs(job, sources, targets, init, priors)
    return run(job, pairs, workers, count)


def _pairs(
    job: BatchJob,
    sources: Iterable[Cloud] | Cloud,
    targets: Iterable[Cloud] | Cloud,
    init: Iterable[Start] | Start,
    priors: Iterable[GivenPrior | None] | None,
) -> tuple[Iterator[Pair], int | None]:
    """A lazy iterator of the pairs, and their number if it is known; what is common to all pairs is checked at once."""
    if isinstance(init, str) and init != "global":
        raise ValueError(f'init: expected a pose, "global", or one per pair, got {init!r}')
    sides: dict[str, Any] = {"sources": sources, "targets": targets, "init": init, "priors": priors}
    num_dimensions = init.wxyz_xyz.ndim + 1 if isinstance(init, jaxlie.SE3) else getattr(init, "ndim", None)
    is_one_pose = init is None or isinstance(init, str) or num_dimensions == 2
    common = {"init": is_one_pose, "priors": priors is None}
    for name in ("sources", "targets"):
        side = sides[name]
        structured = getattr(getattr(side, "dtype", None), "names", None) is not None
        flat = structured or getattr(side, "ndim", None) == 2
        common[name] = isinstance(side, PointCloud) or callable(side) or flat
    if common["sources"] and common["targets"]:
        raise ValueError("sources: expected several clouds on at least one side, got one on each; call register")
    for name, value in sides.items():
        if common[name]:
            if name in ("sources", "targets"):
                (value,) = job.ready({name: value})
            elif name == "init" and value is not None and not isinstance(value, str):
                value = checked_pose_matrix(value)
            sides[name] = value
        elif isinstance(value, jaxlie.SE3):
            sides[name] = np.asarray(matrix_of(value))
        elif not isinstance(value, Iterable):
            raise ValueError(f"{name}: expected an iterable with one per pair, got {type(value).__name__}")
    several = [name for name in sides if not common[name]]
    sizes = {name: len(sides[name]) for name in several if hasattr(sides[name], "__len__")}
    if len(set(sizes.values())) > 1:
        counts = ", ".join(f"{count} {name}" for name, count in sizes.items())
        raise ValueError(f"{next(iter(sizes))}: expected one per pair, got {counts}")

    def pairs() -> Iterator[Pair]:
        end: Any = object()
        iterables = [sides[name] for name in several]
        for index, values in enumerate(itertools.zip_longest(*iterables, fillvalue=end)):
            ended = [name for name, value in zip(several, values, strict=True) if value is end]
            if ended:
                raise ValueError(f"{ended[0]}: expected one per pair, got {index}, fewer than on the other side")
            yield Pair(index, *(sides | dict(zip(several, values, strict=True))).values())

    return pairs(), next(iter(sizes.values()), None)
