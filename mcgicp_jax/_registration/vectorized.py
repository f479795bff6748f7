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
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._registration.assessment import Assessment
from mcgicp_jax._registration.loop import LoopResult, Problem, Record, State, step
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
    """Lanes for problems of the same shapes, and problems that wait for one.

    Where memory does not suffice, half of the lanes are left, and the problems that were in lanes begin again.
    """

    def __init__(self, search: AbstractSearch, max_iterations: int):
        self._search = search
        self._max_iterations = max_iterations
        self._devices = default_devices()
        self._per_device = _LANES_ON_CPU if self._devices[0].platform == "cpu" else _LANES
        self.waiting: collections.deque[tuple[Key, Problem]] = collections.deque()
        self._running: dict[int, tuple[Key, Problem]] = {}
        self._lanes: Any = None
        sharding = NamedSharding(Mesh(np.array(self._devices), ("lanes",)), PartitionSpec("lanes"))
        self._empty = jax.jit(_empty, static_argnums=1, out_shardings=sharding)
        self._put = jax.jit(_put, donate_argnums=0, out_shardings=sharding)

    def is_full(self) -> bool:
        return len(self.waiting) + len(self._running) >= self._per_device * len(self._devices)

    def is_busy(self) -> bool:
        return bool(self.waiting or self._running)

    def run(self) -> Iterator[Ended[Key]]:
        """Fill free lanes and run `_STEPS` steps of all; yield the results of finished lanes and free these lanes."""
        try:
            found = self._run()
        except jax.errors.JaxRuntimeError as error:
            if self._per_device == 1 or "RESOURCE_EXHAUSTED" not in str(error):
                raise
            self._per_device //= 2
            self.waiting.extendleft(self._running.values())
            self._running, self._lanes, found = {}, None, None
        for lane in [] if found is None else [lane for lane in self._running if found[0].status[lane] >= 0]:
            state, assessed, history = jax.tree.map(lambda leaf, lane=lane: leaf[lane], found)
            # One history entry per update, and one at the returned pose.
            count = int(state.num_iterations) + 1
            history = jax.tree.map(lambda entries, count=count: entries[:count], history)
            yield Ended(self._running.pop(lane)[0], state, assessed, history)

    def _run(self) -> tuple[State, Assessment, Record] | None:
        """Those of all lanes; None if none of the running ones has finished."""
        count = self._per_device * len(self._devices)
        for lane in [lane for lane in range(count) if lane not in self._running][: len(self.waiting)]:
            self._running[lane] = _, problem = self.waiting.popleft()
            begun = problem, begin_lane(problem, self._search, self._max_iterations)
            self._lanes = self._put(self._lanes or self._empty(begun, count), begun, lane)
        problems, loops = self._lanes
        loops = run_lanes(problems, loops, self._search, _STEPS)
        self._lanes = problems, loops
        # The matches are not copied to the host.
        if not (np.asarray(loops.state.status)[list(self._running)] >= 0).any():
            return None
        return jax.device_get((loops.state, assess_lanes(problems, loops, self._search), loops.history))


def _empty(lane: Lanes, count: int) -> Lanes:
    """Lanes without a problem: their status is 0, which counts as finished."""
    return jax.tree.map(lambda leaf: jnp.zeros((count, *leaf.shape), leaf.dtype), lane)


def _put(lanes: Lanes, lane: Lanes, number: Int[Array, ""]) -> Lanes:
    return jax.tree.map(lambda leaves, leaf: leaves.at[number].set(leaf), lanes, lane)


@with_settings_of_package
@partial(jax.jit, static_argnames="max_iterations")
def begin_lane(problem: Problem, search: AbstractSearch, max_iterations: int) -> LoopResult:
    """The loop before its first step, compiled."""
    return TracedExecutor(problem, search, max_iterations).begin()


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
def assess_lanes(problems: Problem, loops: LoopResult, search: AbstractSearch) -> Assessment:
    """Information matrices, directions and covariances of stacked loops, at their current poses."""

    return jax.vmap(lambda problem, loop: assess(loop, problem, search))(problems, loops)
