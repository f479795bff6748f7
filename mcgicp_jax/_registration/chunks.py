"""Many registrations as chunks of one program without callbacks, for accelerators.

The host reads clouds, averages them in voxels and leaves out points, whose number decides shapes; it stacks the arrays
of a chunk of pairs. All else is done on the devices: neighbours, surfaces, the loop, its assessment.
"""

from __future__ import annotations

import collections
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import jaxlie
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._clouds.preprocess_inside_jit import traced_neighbors
from mcgicp_jax._compute.concrete import DeferredRows
from mcgicp_jax._compute.devices import default_devices
from mcgicp_jax._compute.tables import Packed
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._registration.assessment import Assessment, assessment_of
from mcgicp_jax._registration.loop import Record, State
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.pose_derivative import Inputs
from mcgicp_jax._registration.register_pair import problem_of, without_sensor_patterns
from mcgicp_jax._registration.start_check import doubt_of_start, surface_fit
from mcgicp_jax._registration.traced import TracedExecutor, assess
from mcgicp_jax._search.base import AbstractSearch

# Numbers of pairs of a chunk per device: with a sketch on an H200, chunks of 256 pairs took 0.7 (2,000 points) to 0.95
# (6,000 points) of the time of chunks of 64. Batches of fewer pairs have smaller chunks. Each size compiles.
_SIZES = (16, 64, 256)
# Most rows of both clouds of all pairs of a chunk per device: 256 pairs of two clouds of 4,096 rows. Temporary memory
# of a row, bytes (MC-GICP with covariances, compiled for an H100): a chunk may use half of what is free on a device.
_ROWS, _MEMORY_PER_ROW = 2**21, 1000
# On a CPU, where pairs that have ended cost as much as others until all have.
_SIZE_ON_CPU = 4
# Updates of the pose after which pairs that have not ended leave their chunk and begin again in a chunk of such pairs:
# of 1,024 pairs of 2,000 points, 19 took up to 64 updates. The number is doubled for further chunks if more than this
# fraction of the pairs had to leave.
_FIRST_UPDATES, _MANY = 24, 0.1
# Largest number of chunks for which such pairs wait: a partly filled chunk of 64 updates takes as long as 2.7 chunks of
# 24 updates, a twelfth of 32.
_CHUNKS_BETWEEN = 32
# Chunks that are dispatched before the results of the first are fetched: the host prepares one while the devices work.
_DISPATCHED = 2
# A chunk runs partly filled after this many pairs of other shapes: a stream of pairs yields results while it goes on.
_PATIENCE = 256
# Rows up to which padding costs little: of pairs of 2,048 rows the loop's search took a third of the device's time
# (H200), and with 1,024 there are a quarter of the distances.
_FEW_ROWS = 1024
# Rows whose neighbours are found at a time: 0.5 GB with 20 neighbours (compiled for an H100).
_ROWS_WITH_NEIGHBORS = 2**16


class ChunkPair(NamedTuple):
    """A pair that waits for a chunk, NumPy arrays: finite points, padded to a size class, without origin and names.
    `start` is between the centred clouds. Neighbours that are None are found on the devices."""

    start: jaxlie.SE3
    max_coarse_distance: Any
    source: PointCloud
    target: PointCloud


class Ended(NamedTuple):
    """A registration that has ended, with the key of its pair; and whether it may have left a right initial pose."""

    key: Any
    state: State
    assessment: Assessment
    history: Record
    has_doubt: bool


class Refused(NamedTuple):
    """The key of a pair whose shapes the method refuses, and its reason."""

    key: Any
    reason: ValueError


def run_pairs(
    pairs: Iterable[tuple[Any, ChunkPair]],
    method: AbstractMethod,
    options: Options,
    search: AbstractSearch,
    num_neighbors: int,
    covariances: bool,
) -> Iterator[Ended | Refused]:
    """Register many pairs, spread over the `default_devices`, and yield their results.

    `num_neighbors` is for clouds without neighbours. Pairs of similar sizes share a program: to compile one takes as
    long as to register thousands of pairs.
    """
    # Numbers are traced, so that others compile nothing.
    numbers = options.numbers
    if isinstance(options.max_distance, tuple):
        numbers["max_distance"] = np.asarray(options.max_distance)
    fixed = Options(
        **{name: getattr(options, name) for name in ("max_iterations", "max_source_points", "min_coarse_distance")}
    )
    mesh = Mesh(np.array(default_devices()), ("pairs",))

    def program(chunk: ChunkPair, max_updates: Any) -> Any:
        common = method, options.robust, numbers, max_updates, search
        return _registered(chunk, common, fixed, num_neighbors, covariances, mesh)

    groups: dict[Any, _Group] = {}
    last: dict[Any, int] = {}
    sizes: list[tuple[int, int]] = []
    for number, (key, pair) in enumerate(pairs):
        rows = pair.source.valid.size, pair.target.valid.size
        if rows not in sizes:
            # Padded to the smallest sizes of earlier pairs that suit; without such, its own ones join them.
            most = [max(_FEW_ROWS, 2 * count) for count in rows]
            suitable = [size for size in sizes if all(a <= b <= c for a, b, c in zip(rows, size, most, strict=True))]
            if suitable:
                source, target = min(suitable, key=np.prod)
                pair = pair._replace(source=pair.source.pad(source), target=pair.target.pad(target))
            else:
                sizes.append(rows)
        leaves, structure = jax.tree.flatten(pair)
        kind = structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        if kind not in groups:
            groups[kind] = _Group(program, mesh, fixed.max_iterations)
        last[kind] = number
        group = groups[kind]
        group.waiting.append((key, pair))
        while len(group.waiting) >= (group.per_device or group.largest()) * mesh.size:
            yield from group.run()
        for rare in [kind for kind in groups if number - last[kind] > _PATIENCE]:
            yield from groups.pop(rare).finish()
    for group in groups.values():
        yield from group.finish()


class _Group:
    """Pairs of the same shapes, in chunks. Where memory does not suffice, chunks are halved and begin again."""

    def __init__(self, program: Callable[..., Any], mesh: Mesh, max_iterations: int):
        self._program, self._mesh = program, mesh
        # A loop that has not ended has made at most one update less.
        self._all_updates = max_iterations + 1
        self._first_updates = min(_FIRST_UPDATES, self._all_updates)
        # Number of pairs of a chunk per device; 0 before the first.
        self.per_device = 0
        self.waiting: collections.deque[tuple[Any, ChunkPair]] = collections.deque()
        self._slow: collections.deque[tuple[Any, ChunkPair]] = collections.deque()
        # Number of chunks for which slow pairs have waited.
        self._chunks_waited = 0
        self._dispatched: collections.deque[tuple[list[tuple[Any, ChunkPair]], bool, Any]] = collections.deque()

    def largest(self) -> int:
        """The largest number of pairs of a chunk per device."""
        if self._mesh.devices[0].platform == "cpu":
            return _SIZE_ON_CPU
        rows = sum(cloud.valid.size for cloud in self.waiting[0][1][2:])
        memories = [device.memory_stats() or {} for device in self._mesh.devices]
        free = min((memory.get("bytes_limit") or np.inf) - memory.get("bytes_in_use", 0) for memory in memories)
        most = min(_ROWS, 0.5 * free / _MEMORY_PER_ROW)
        return max(size for size in _SIZES if size * rows <= most or size == _SIZES[0])

    def finish(self) -> Iterator[Ended | Refused]:
        while self.waiting or self._slow or self._dispatched:
            yield from self.run()

    def run(self) -> Iterator[Ended | Refused]:
        """Dispatch a chunk, if pairs wait, and yield the results of the oldest one if enough are dispatched."""
        ended: list[Ended | Refused] = []
        try:
            waits = bool(self.waiting or (self._slow and not self._dispatched))
            if waits:
                ended += self._dispatch()
            if not waits or len(self._dispatched) >= _DISPATCHED:
                ended += self._fetched()
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            begun = [pair for pairs, *_ in self._dispatched for pair in pairs]
            if self.per_device == 1:
                rows = " and ".join(str(cloud.valid.size) for cloud in begun[0][1][2:])
                raise MemoryError(
                    f"the memory of the device does not suffice for a pair padded to {rows} points; average the points "
                    "in larger voxels, or use KDTreeSearch()"
                ) from error
            self.per_device //= 2
            self.waiting.extendleft(reversed(begun))
            self._dispatched.clear()
        yield from ended

    def _dispatch(self) -> list[Any]:
        """Start the program for the next pairs, or refuse them; copies of the last one fill up the chunk."""
        if not self.per_device:
            most = self.largest()
            wanted = -(-len(self.waiting) // self._mesh.size)
            self.per_device = next((size for size in _SIZES if wanted <= size < most), most)
        size = self.per_device * self._mesh.size
        late = len(self._slow) >= size or self._chunks_waited >= _CHUNKS_BETWEEN
        first = bool(self.waiting) and not late
        self._chunks_waited = self._chunks_waited + 1 if first and self._slow else 0
        queue = self.waiting if first else self._slow
        pairs = [queue.popleft() for _ in range(min(len(queue), size))]
        # Before the program starts, so that no pair is lost if memory does not suffice.
        self._dispatched.append((pairs, first, None))
        filled = [pair for _, pair in pairs] + [pairs[-1][1]] * (size - len(pairs))
        sharding = NamedSharding(self._mesh, PartitionSpec("pairs"))
        chunk = jax.device_put(jax.tree.map(lambda *leaves: np.stack(leaves), *filled), sharding)
        limit = np.int32(self._first_updates if first else self._all_updates)
        try:
            self._dispatched[-1] = pairs, first, self._program(chunk, limit)
        except ValueError as error:
            # While the program is traced: no pair of these shapes can be registered.
            self._dispatched.pop()
            return [Refused(key, error) for key, _ in pairs]
        return []

    def _fetched(self) -> list[Any]:
        """The results of the oldest chunk; those of its pairs that have not ended join the slow ones."""
        pairs, first, packed = self._dispatched[0]
        leaves, structure = jax.tree.flatten(jax.device_get(packed).tree)
        self._dispatched.popleft()
        ended: list[Ended | Refused] = []
        for (key, pair), *row in zip(pairs, *leaves, strict=False):
            state, assessment, history, check = jax.tree.unflatten(structure, row)
            if state.status < 0:
                self._slow.append((key, pair))
                continue
            # One history entry per update, and one at the returned pose.
            count = int(state.num_iterations) + 1
            history = Record(*(entries[:count] for entries in history))
            # Settings and fit; None for a single `max_distance`.
            fit = partial(itemgetter(1), check)
            in_doubt = check is not None and doubt_of_start(pair.start, state, check[0], fit) is not None
            ended.append(Ended(key, state, assessment, history, in_doubt))
        if first and len(pairs) - len(ended) > _MANY * len(pairs):
            self._first_updates = min(2 * self._first_updates, self._all_updates)
        return ended


@with_settings_of_package
@partial(jax.jit, static_argnames=("options", "num_neighbors", "covariances", "mesh"))
def _registered(
    chunk: ChunkPair, common: tuple[Any, ...], options: Options, num_neighbors: int, covariances: bool, mesh: Mesh
) -> Packed[tuple[State, Assessment, Record, Any]]:
    """States, assessments, histories, and settings and fits for `doubt_of_start`, of stacked pairs, packed; a status is
    negative where a loop has not ended after `max_updates`. `common`: the method, the kernel, the options that are
    numbers, `max_updates` and the search."""

    def registered(pair: ChunkPair, common: Any) -> Any:
        method, robust, numbers, max_updates, search = common
        complete = replace(options, **numbers | {"max_coarse_distance": pair.max_coarse_distance})
        source, target = pair.source, pair.target
        if method.uses_channels:
            source, target = without_sensor_patterns(source, target, method)
        problem, inputs = problem_of(Inputs(source, target, method, robust), None, complete, 1)
        problem = replace(problem, start=pair.start)
        executor = TracedExecutor(problem, search, options.max_iterations)
        loop = executor.run(max_updates)
        check = (problem.settings, surface_fit(inputs, executor, loop)) if complete.has_two_distances else None
        assessment = assess(loop, problem, search) if covariances else assessment_of(executor, loop, False)
        return loop.state, assessment, loop.history, check

    def on_a_device(chunk: ChunkPair, common: Any) -> Any:
        *_, search = common
        find = partial(traced_neighbors, num_neighbors=num_neighbors, search=search)
        for name in ("source", "target"):
            clouds = getattr(chunk, name)
            if clouds.deferred_neighbors is None:
                at_a_time = max(1, _ROWS_WITH_NEIGHBORS // clouds.valid.shape[-1])
                neighbors = jax.lax.map(find, clouds, batch_size=at_a_time)
                chunk = chunk._replace(**{name: clouds.replace_rows(deferred_neighbors=DeferredRows.of(neighbors))})
        return Packed.of(jax.vmap(registered, (0, None))(chunk, common))

    if mesh.size == 1:
        return on_a_device(chunk, common)
    # No device waits for the loops of the others.
    pairs = PartitionSpec("pairs")
    sharded = jax.shard_map(on_a_device, mesh=mesh, in_specs=(pairs, PartitionSpec()), out_specs=pairs, check_vma=False)
    return sharded(chunk, common)
