"""Many registrations as lanes of one vectorised program without callbacks, for accelerators.

A lane is one registration of the vectorised batch. When it ends, another problem takes its place.
"""

from __future__ import annotations

import collections
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Int

from mcgicp_jax._compute.devices import default_devices
from mcgicp_jax._compute.tables import Packed
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._registration.assessment import Assessment
from mcgicp_jax._registration.loop import LoopResult, step
from mcgicp_jax._registration.step import Problem, Record, State
from mcgicp_jax._registration.traced import TracedExecutor, assess, recorded
from mcgicp_jax._search.base import AbstractSearch

Key = TypeVar("Key")

# A problem and its loop, or many stacked ones.
Lanes: TypeAlias = tuple[Problem, LoopResult]

# Lanes per device; few on a CPU, where finished lanes that wait for the others cost as much as active ones.
_LANES = 64
_LANES_ON_CPU = 4
# A group of lanes runs partly filled after this many problems of other shapes: a stream of problems yields results
# while it goes on, and unused groups free their memory.
_PATIENCE = 256
# Loop steps of all lanes between two refills. Few registrations take less, and a slow one blocks only its own lane.
_STEPS = 4


class Ended(NamedTuple, Generic[Key]):
    """A registration that has ended, with the key of its problem."""

    key: Key
    state: State
    assessment: Assessment
    history: Record


def run_problems(
    problems: Iterable[tuple[Key, Problem]], search: AbstractSearch, max_iterations: int
) -> Iterator[Ended[Key]]:
    """Run the loop of `register` on many problems at a time, and yield each result as soon as it is known.

    Problems of the same shapes share a program. Its number of lanes is fixed, as long as memory suffices, so that a
    result does not depend on the other problems. The lanes are spread over the `default_devices`.
    """
    groups: dict[Any, _Group[Key]] = {}
    last: dict[Any, int] = {}
    for number, (key, problem) in enumerate(problems):
        leaves, structure = jax.tree.flatten(problem)
        kind = structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        if kind not in groups:
            groups[kind] = _Group(search, max_iterations)
        last[kind] = number
        groups[kind].waiting.append((key, problem))
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
    """Lanes for problems of the same shapes, a chunk of problems on the devices that are the next to enter a lane, and
    problems on the host that wait for the next chunk. A chunk has as many problems as there are lanes.

    Where memory does not suffice, half of the lanes are left, and the problems on the devices begin again.
    """

    def __init__(self, search: AbstractSearch, max_iterations: int):
        self._search = search
        self._max_iterations = max_iterations
        self._devices = default_devices()
        self._per_device = _LANES_ON_CPU if self._devices[0].platform == "cpu" else _LANES
        self.waiting: collections.deque[tuple[Key, Problem]] = collections.deque()
        self._chunk: collections.deque[tuple[int, tuple[Key, Problem]]] = collections.deque()
        self._running: dict[int, tuple[Key, Problem]] = {}
        self._begun: Any = None
        self._lanes: Any = None
        self._sharding = NamedSharding(Mesh(np.array(self._devices), ("lanes",)), PartitionSpec("lanes"))
        self._put = jax.jit(_put, donate_argnums=0, out_shardings=self._sharding)

    @property
    def _size(self) -> int:
        return self._per_device * len(self._devices)

    def is_full(self) -> bool:
        """Whether the lanes are filled, and once the chunk is used up, enough problems wait to fill the next one."""
        return len(self.waiting) + len(self._chunk) + len(self._running) >= 2 * self._size

    def is_busy(self) -> bool:
        return bool(self.waiting or self._chunk or self._running)

    def run(self) -> Iterator[Ended[Key]]:
        """Fill free lanes and run `_STEPS` steps of all; yield the results of finished lanes and free these lanes."""
        try:
            found = self._run()
        except jax.errors.JaxRuntimeError as error:
            if self._per_device == 1 or "RESOURCE_EXHAUSTED" not in str(error):
                raise
            self._per_device //= 2
            begun = [*self._running.values(), *(problem for _, problem in self._chunk)]
            self.waiting.extendleft(reversed(begun))
            self._chunk.clear()
            self._running, self._begun, self._lanes, found = {}, None, None, None
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
        """Move the next problems from the host to the devices; the last one fills up the chunk."""
        count = min(len(self.waiting), self._size)
        self._chunk.extend(enumerate(self.waiting.popleft() for _ in range(count)))
        problems = [problem for _, (_, problem) in self._chunk]
        problems += problems[-1:] * (self._size - count)
        stacked = jax.device_put(jax.tree.map(lambda *leaves: np.stack(leaves), *problems), self._sharding)
        self._begun = stacked, begin_lanes(stacked, self._search, self._max_iterations)

    def _fill(self) -> bool:
        """Move problems of the chunk to free lanes; whether any lane is left free."""
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


def _put(lanes: Lanes, chunk: Lanes, numbers: Int[Array, "n"], rows: Int[Array, "n"]) -> Lanes:
    """Rows of the chunk as the lanes with these numbers."""
    return jax.tree.map(lambda old, new: old.at[numbers].set(new[rows], mode="drop"), lanes, chunk)


@with_settings_of_package
@partial(jax.jit, static_argnames="max_iterations")
def begin_lanes(problems: Problem, search: AbstractSearch, max_iterations: int) -> LoopResult:
    """Many stacked loops before their first step, compiled."""
    return jax.vmap(lambda problem: TracedExecutor(problem, search, max_iterations).begin())(problems)


@with_settings_of_package
@partial(jax.jit, static_argnames="num_steps")
def run_lanes(problems: Problem, loops: LoopResult, search: AbstractSearch, num_steps: int) -> LoopResult:
    """Run at most `num_steps` steps of many stacked loops; finished loops do not change."""

    def run(problem: Problem, loop: LoopResult) -> LoopResult:
        executor = TracedExecutor(problem, search, 0)

        def unfinished(counted: tuple[LoopResult, Int[Array, ""]]) -> Bool[Array, ""]:
            return (counted[0].state.status < 0) & (counted[1] < num_steps)

        return jax.lax.while_loop(
            unfinished, lambda counted: (recorded(step(executor, counted[0])), counted[1] + 1), (loop, jnp.int32(0))
        )[0]

    return jax.vmap(run)(problems, loops)


@with_settings_of_package
@jax.jit
def results_of_lanes(
    problems: Problem, loops: LoopResult, search: AbstractSearch
) -> Packed[tuple[State, Assessment, Record]]:
    """States, assessments at their poses and histories of stacked loops, in one array."""
    assessed = jax.vmap(lambda problem, loop: assess(loop, problem, search))(problems, loops)
    return Packed.of((loops.state, assessed, loops.history))
