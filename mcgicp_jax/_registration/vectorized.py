"""Many registrations as lanes of one vectorised program without callbacks, for accelerators.

A lane is one registration of the vectorised batch. When it ends, another pair takes its place. The host reads clouds,
averages them in voxels and leaves out points, whose number decides shapes; all else is done on the devices, for chunks
of pairs.
"""

from __future__ import annotations

import collections
import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._clouds.preprocess_inside_jit import traced_neighbors
from mcgicp_jax._compute.devices import default_devices
from mcgicp_jax._compute.programs import size_class
from mcgicp_jax._compute.tables import Packed
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._math.robust_kernels import AbstractKernel
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._registration.assessment import Assessment
from mcgicp_jax._registration.loop import LoopResult, Problem, Record, State
from mcgicp_jax._registration.options import Options
from mcgicp_jax._registration.pose_derivative import Inputs
from mcgicp_jax._registration.register_pair import problem_of
from mcgicp_jax._registration.traced import TracedExecutor, assess
from mcgicp_jax._search.base import AbstractSearch

Key = TypeVar("Key")

# A problem and its loop, or many stacked ones.
Lanes: TypeAlias = tuple[Problem, LoopResult]

# Lanes per device; few on a CPU, where finished lanes that wait for the others cost as much as active ones.
_LANES = 64
_LANES_ON_CPU = 4
# A group of lanes runs partly filled after this many pairs of other shapes: a stream of pairs yields results
# while it goes on, and unused groups free their memory.
_PATIENCE = 256
# Loop steps of all lanes between two refills. Few registrations take less, and a slow one blocks only its own lane.
_STEPS = 4


class LanePair(NamedTuple):
    """A pair of clouds that waits for a lane, as NumPy arrays.

    Attributes:
        start: initial pose of the centred clouds.
        max_coarse_distance: as in `Options`.
        source, target: finite points, padded to a size class, origin and names left out; neighbours that are None are
            found on the devices.
    """

    start: jaxlie.SE3
    max_coarse_distance: Any
    source: PointCloud
    target: PointCloud


class Ended(NamedTuple, Generic[Key]):
    """A registration that has ended, with the key of its pair."""

    key: Key
    state: State
    assessment: Assessment
    history: Record


class Refused(NamedTuple, Generic[Key]):
    """The key of a pair whose shapes the method refuses, and its reason."""

    key: Key
    reason: ValueError


def run_pairs(
    pairs: Iterable[tuple[Key, LanePair]],
    method: AbstractMethod,
    options: Options,
    search: AbstractSearch,
    num_neighbors: int,
) -> Iterator[Ended[Key] | Refused[Key]]:
    """Register many pairs at a time, and yield each result as soon as it is known. `num_neighbors` is that of
    clouds that have no neighbours yet.

    Pairs of the same shapes share a program. Its number of lanes is fixed, as long as memory suffices, so that a result
    does not depend on the other pairs. The lanes are spread over the `default_devices`.
    """
    # Numbers are traced, so that others compile nothing.
    numbers = options.numbers
    if isinstance(options.max_distance, tuple):
        numbers["max_distance"] = np.asarray(options.max_distance)
    fixed = Options(
        **{name: getattr(options, name) for name in ("max_iterations", "max_source_points", "min_coarse_distance")}
    )

    def begin(*chunk: Any) -> Lanes:
        ready = with_neighbors(*chunk, search, num_neighbors)
        return begin_lanes(ready, method, options.robust, numbers, search, fixed)

    groups: dict[Any, _Group[Key]] = {}
    last: dict[Any, int] = {}
    for number, (key, pair) in enumerate(pairs):
        kind = _shapes(pair)
        if kind not in groups:
            groups[kind] = _Group(begin, search)
        last[kind] = number
        groups[kind].waiting.append((key, pair))
        while groups[kind].is_full():
            yield from groups[kind].run()
        for waiting in [kind for kind in groups if number - last[kind] > _PATIENCE]:
            while groups[waiting].is_busy():
                yield from groups[waiting].run()
            del groups[waiting]
    for group in groups.values():
        while group.is_busy():
            yield from group.run()


class _Group(Generic[Key]):
    """Lanes for pairs of the same shapes, a chunk of pairs prepared on the devices that are the next to enter a lane,
    and pairs on the host that wait for the next chunk. A chunk has as many pairs as there are lanes.

    Where memory does not suffice, half of the lanes are left, and the pairs on the devices begin again.
    """

    def __init__(self, begin: Callable[..., Lanes], search: AbstractSearch):
        self._begin_lanes, self._search = begin, search
        self._devices = default_devices()
        self._per_device = _LANES_ON_CPU if self._devices[0].platform == "cpu" else _LANES
        self.waiting: collections.deque[tuple[Key, LanePair]] = collections.deque()
        self._chunk: collections.deque[tuple[int, tuple[Key, LanePair]]] = collections.deque()
        self._running: dict[int, tuple[Key, LanePair]] = {}
        self._begun: Any = None
        self._lanes: Any = None
        self._sharding = NamedSharding(Mesh(np.array(self._devices), ("lanes",)), PartitionSpec("lanes"))
        self._put = jax.jit(_put, donate_argnums=0, out_shardings=self._sharding)

    @property
    def _size(self) -> int:
        return self._per_device * len(self._devices)

    def is_full(self) -> bool:
        """Whether the lanes are filled, and once the chunk is used up, enough pairs wait to fill the next one."""
        return len(self.waiting) + len(self._chunk) + len(self._running) >= 2 * self._size

    def is_busy(self) -> bool:
        return bool(self.waiting or self._chunk or self._running)

    def run(self) -> Iterator[Ended[Key] | Refused[Key]]:
        """Fill free lanes and run `_STEPS` steps of all; yield the results of finished lanes and free these lanes."""
        try:
            found = self._run()
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            begun = [*self._running.values(), *(pair for _, pair in self._chunk)]
            if self._per_device == 1:
                rows = " and ".join(str(cloud.valid.size) for cloud in begun[0][1][2:])
                raise MemoryError(
                    f"the memory of the device does not suffice for a pair padded to {rows} points; average the points "
                    "in larger voxels, or use KDTreeSearch()"
                ) from error
            self._per_device //= 2
            self.waiting.extendleft(reversed(begun))
            self._chunk.clear()
            self._running, self._begun, self._lanes, found = {}, None, None, None
        except ValueError as error:
            if self._running:
                raise
            # While the program of the first chunk is traced: no pair of these shapes can be registered.
            yield from (Refused(key, error) for _, (key, _) in self._chunk)
            self._chunk.clear()
            return
        for lane in [] if found is None else [lane for lane in self._running if found[0].status[lane] >= 0]:
            state, assessed, history = jax.tree.map(lambda leaf, lane=lane: leaf[lane], found)
            # One history entry per update, and one at the returned pose.
            count = int(state.num_iterations) + 1
            history = jax.tree.map(lambda entries, count=count: entries[:count], history)
            yield Ended(self._running.pop(lane)[0], state, assessed, history)

    def _run(self) -> tuple[State, Assessment, Record] | None:
        """Those of all lanes; None if none of the running ones has finished."""
        while self._fill() and self.waiting:
            self._begin()
        problems, loops = self._lanes
        loops = run_lanes(problems, loops, self._search, _STEPS)
        self._lanes = problems, loops
        if not self._chunk and self.waiting:
            # While the devices work.
            self._begin()
        # The matches are not copied to the host.
        if not (np.asarray(loops.state.status)[list(self._running)] >= 0).any():
            return None
        return jax.device_get(results_of_lanes(problems, loops, self._search)).tree

    def _begin(self) -> None:
        """Prepare the next pairs on the devices; the last one fills up the chunk."""
        count = min(len(self.waiting), self._size)
        self._chunk.extend(enumerate(self.waiting.popleft() for _ in range(count)))
        pairs = [pair for _, (_, pair) in self._chunk]
        pairs += pairs[-1:] * (self._size - count)
        alike = _shapes(pairs[0].source) == _shapes(pairs[0].target)
        starts, distances, *sides = zip(*pairs, strict=True)
        # A cloud that is the source of one pair and the target of another one is prepared once.
        distinct = [_distinct(clouds, len(self._devices)) for clouds in ([sides[0] + sides[1]] if alike else sides)]
        clouds, rows = zip(*distinct, strict=True)
        chunk = _stacked(starts), np.stack(distances), clouds, np.concatenate(rows).reshape(2, self._size).T
        self._begun = self._begin_lanes(*jax.device_put(chunk, self._sharding))

    def _fill(self) -> bool:
        """Move pairs of the chunk to free lanes; whether any lane is left free."""
        free = [lane for lane in range(self._size) if lane not in self._running]
        # Of as many numbers as there are lanes, so that one program serves; this one is out of range.
        lanes, rows = np.full(self._size, self._size, np.int32), np.zeros(self._size, np.int32)
        for place, lane in enumerate(free[: len(self._chunk)]):
            rows[place], self._running[lane] = self._chunk.popleft()
            lanes[place] = lane
        if self._lanes is None and self._begun is not None:
            # Lanes without a problem: their status is 0, which counts as finished.
            self._lanes = jax.tree.map(jnp.zeros_like, self._begun)
        if lanes[0] < self._size:
            self._lanes = self._put(self._lanes, self._begun, lanes, rows)
        return len(self._running) < self._size


def _shapes(tree: Any) -> Any:
    leaves, structure = jax.tree.flatten(tree)
    return structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)


def _stacked(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def _distinct(clouds: Sequence[PointCloud], num_devices: int) -> tuple[PointCloud, Int[np.ndarray, "n"]]:
    """The clouds stacked, equal ones once, the last one repeated up to a size class for each device; and their rows."""
    digests = [
        hashlib.blake2b(b"".join(leaf.tobytes() for leaf in jax.tree.leaves(cloud))).digest() for cloud in clouds
    ]
    different = dict(zip(digests, clouds, strict=True))
    place = {digest: row for row, digest in enumerate(different)}
    some = list(different.values())
    # No fewer than an eighth, so that few programs are compiled for chunks that are not full.
    size = num_devices * size_class(-(-len(some) // num_devices), max(1, len(clouds) // num_devices // 8))
    return _stacked(some + some[-1:] * (size - len(some))), np.array([place[digest] for digest in digests], np.int32)


def _put(lanes: Lanes, chunk: Lanes, numbers: Int[Array, "n"], rows: Int[Array, "n"]) -> Lanes:
    """Rows of the chunk as the lanes with these numbers."""
    return jax.tree.map(lambda old, new: old.at[numbers].set(new[rows], mode="drop"), lanes, chunk)


@with_settings_of_package
@partial(jax.jit, static_argnames="num_neighbors")
def with_neighbors(
    starts: jaxlie.SE3,
    max_coarse_distances: Float[Array, "n"],
    clouds: tuple[PointCloud, ...],
    rows: Int[Array, "pairs 2"],
    search: AbstractSearch,
    num_neighbors: int,
) -> LanePair:
    """Stacked pairs with neighbours. This program, which is small, depends on the number of distinct clouds.

    Args:
        clouds: the distinct clouds of both sides, stacked; or, if their shapes differ, of the source and of the target.
        rows: those of source and target in them.
    """

    def with_own(cloud: PointCloud) -> PointCloud:
        if cloud.deferred_neighbors is not None:
            return cloud
        return cloud.replace_rows(deferred_neighbors=traced_neighbors(cloud, num_neighbors, search))

    ready = [jax.vmap(with_own)(stacked) for stacked in clouds]
    sides = zip((ready[0], ready[-1]), rows.T, strict=True)
    return LanePair(
        starts, max_coarse_distances, *(jax.tree.map(itemgetter(numbers), stacked) for stacked, numbers in sides)
    )


@with_settings_of_package
@partial(jax.jit, static_argnames="options")
def begin_lanes(
    pairs: LanePair,
    method: AbstractMethod,
    robust: AbstractKernel | None,
    numbers: dict[str, Any],
    search: AbstractSearch,
    options: Options,
) -> Lanes:
    """Stacked pairs as problems with their loops before the first step: surfaces and parameters in one program.
    `numbers` are the options that are numbers, by name."""
    options = replace(options, **numbers)

    def begin(pair: LanePair) -> Lanes:
        own = replace(options, max_coarse_distance=pair.max_coarse_distance)
        problem, _ = problem_of(Inputs(pair.source, pair.target, method, robust), None, own, 1)
        problem = replace(problem, start=pair.start)
        return problem, TracedExecutor(problem, search, options.max_iterations).begin()

    return jax.vmap(begin)(pairs)


@with_settings_of_package
@partial(jax.jit, static_argnames="num_steps")
def run_lanes(problems: Problem, loops: LoopResult, search: AbstractSearch, num_steps: int) -> LoopResult:
    """Run at most `num_steps` steps of many stacked loops; finished loops do not change."""

    def run(problem: Problem, loop: LoopResult) -> LoopResult:
        executor = TracedExecutor(problem, search, 0)

        def unfinished(counted: tuple[LoopResult, Int[Array, ""]]) -> Bool[Array, ""]:
            return (counted[0].state.status < 0) & (counted[1] < num_steps)

        start = loop, jnp.int32(0)
        return jax.lax.while_loop(unfinished, lambda counted: (executor.step(counted[0]), counted[1] + 1), start)[0]

    return jax.vmap(run)(problems, loops)


@with_settings_of_package
@jax.jit
def results_of_lanes(
    problems: Problem, loops: LoopResult, search: AbstractSearch
) -> Packed[tuple[State, Assessment, Record]]:
    """States, assessments at their poses and histories of stacked loops, in one array."""
    assessments = jax.vmap(lambda problem, loop: assess(loop, problem, search))(problems, loops)
    return Packed.of((loops.state, assessments, loops.history))
