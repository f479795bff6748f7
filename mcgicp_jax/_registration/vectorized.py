"""Many registrations as lanes of one vectorised program without callbacks, for accelerators.

A lane is one registration of the vectorised batch. When it ends, another problem takes its place.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Int

from mcgicp_jax._compute.threads import without_checks_of_jax
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

    Problems of the same shapes share a program. Its number of lanes is fixed, so that a result does not depend on the
    other problems. The lanes are spread over all local devices.
    """
    groups: dict[Any, _Group[Key]] = {}
    last: dict[Any, int] = {}
    for number, (key, problem) in enumerate(problems):
        leaves, structure = jax.tree.flatten(problem)
        kind = structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        if kind not in groups:
            groups[kind] = _Group(problem, search, max_iterations)
        last[kind] = number
        groups[kind].add(key, problem)
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
    """Lanes for problems of the same shapes."""

    def __init__(self, example: Problem, search: AbstractSearch, max_iterations: int):
        self._search = search
        self._max_iterations = max_iterations
        devices = jax.local_devices()
        per_device = _LANES_ON_CPU if devices[0].platform == "cpu" else _LANES
        self._keys: list[Key | None] = [None] * (per_device * len(devices))
        sharding = NamedSharding(Mesh(np.array(devices), ("lanes",)), PartitionSpec("lanes"))
        self._put = jax.jit(_put, donate_argnums=0, out_shardings=sharding)
        lane = example, begin_lane(example, search, max_iterations)
        self._lanes: Lanes = jax.jit(_empty, static_argnums=1, out_shardings=sharding)(lane, len(self._keys))

    def is_full(self) -> bool:
        return None not in self._keys

    def is_busy(self) -> bool:
        return any(key is not None for key in self._keys)

    def add(self, key: Key, problem: Problem) -> None:
        free = self._keys.index(None)
        self._keys[free] = key
        self._lanes = self._put(self._lanes, (problem, begin_lane(problem, self._search, self._max_iterations)), free)

    def run(self) -> Iterator[Ended[Key]]:
        """Run `_STEPS` steps of all lanes; yield the results of finished lanes and free these lanes."""
        problems, loops = self._lanes
        loops = run_lanes(problems, loops, self._search, _STEPS)
        self._lanes = problems, loops
        # The matches are not copied to the host.
        ended = np.asarray(loops.state.status) >= 0
        if not any(ended[lane] and key is not None for lane, key in enumerate(self._keys)):
            return
        found = jax.device_get((loops.state, assess_lanes(problems, loops, self._search), loops.history))
        for lane, key in enumerate(self._keys):
            if key is not None and ended[lane]:
                self._keys[lane] = None
                state, assessed, history = jax.tree.map(lambda leaf, lane=lane: leaf[lane], found)
                # One history entry per update, and one at the returned pose.
                count = int(state.num_iterations) + 1
                yield Ended(key, state, assessed, jax.tree.map(lambda entries, count=count: entries[:count], history))


def _empty(lane: Lanes, count: int) -> Lanes:
    """Lanes without a problem: their status is 0, which counts as finished."""
    return jax.tree.map(lambda leaf: jnp.zeros((count, *leaf.shape), leaf.dtype), lane)


def _put(lanes: Lanes, lane: Lanes, number: Int[Array, ""]) -> Lanes:
    return jax.tree.map(lambda leaves, leaf: leaves.at[number].set(leaf), lanes, lane)


@without_checks_of_jax
@partial(jax.jit, static_argnames="max_iterations")
def begin_lane(problem: Problem, search: AbstractSearch, max_iterations: int) -> LoopResult:
    """The loop before its first step, compiled."""
    return TracedExecutor(problem, search, max_iterations).begin()


@without_checks_of_jax
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


@without_checks_of_jax
@jax.jit
def assess_lanes(problems: Problem, loops: LoopResult, search: AbstractSearch) -> Assessment:
    """Information matrices, directions and covariances of stacked loops, at their current poses."""

    return jax.vmap(lambda problem, loop: assess(loop, problem, search))(problems, loops)
