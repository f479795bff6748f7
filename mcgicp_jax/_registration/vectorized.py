"""Many registrations as lanes of one vectorised program without callbacks, for accelerators.

A lane is one registration of the vectorised batch. When it ends, another problem takes its place.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, Generic, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Int

from mcgicp_jax._pose_solver.sums import matched_rows
from mcgicp_jax._registration.step import Assessment, Problem, State, history_of
from mcgicp_jax._registration.traced import Carry, assess, begin, cleaned, step_of_lane
from mcgicp_jax._search.base import AbstractSearch

Key = TypeVar("Key")
Ended: TypeAlias = tuple[Key, State, Assessment, dict[str, np.ndarray]]

# Lanes per device; few on a CPU, where finished lanes that wait for the others cost as much as active ones.
_LANES = 64
_LANES_ON_CPU = 4
# A group of lanes runs partly filled after this many problems of other shapes: a stream of problems yields results
# while it goes on, and unused groups free their memory.
_PATIENCE = 256
# Loop steps of all lanes between two refills. Few registrations take less, and a slow one blocks only its own lane.
_STEPS = 4


def run_problems(
    problems: Iterable[tuple[Key, Problem]], search: AbstractSearch, max_iterations: int
) -> Iterator[Ended[Key]]:
    """Run the loop of `register` on many problems at a time, and yield each result as soon as it is known.

    Problems of the same shapes share a program. Its number of lanes is fixed, so that a result does not depend on the
    other problems. The lanes are spread over all local devices. Yields key, final state, assessment and history.
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
        self._lanes: tuple[Problem, Carry] = jax.jit(_empty, static_argnums=1, out_shardings=sharding)(
            lane, len(self._keys)
        )

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
        problems, carries = self._lanes
        carries = run_lanes(problems, carries, self._search, _STEPS)
        self._lanes = problems, carries
        # The matches are not copied to the host.
        ended = np.asarray(carries[0].status) >= 0
        if not any(ended[lane] and key is not None for lane, key in enumerate(self._keys)):
            return
        states, records, assessments = jax.device_get(
            (carries[0], carries[2], assess_lanes(problems, carries, self._search))
        )
        for lane, key in enumerate(self._keys):
            if key is not None and ended[lane]:
                self._keys[lane] = None
                state, assessed = jax.tree.map(lambda leaf, lane=lane: leaf[lane], (states, assessments))
                # One history entry per update, and one at the returned pose.
                count = int(state.num_iterations) + 1
                yield key, state, assessed, history_of(records[lane, :count])


def _empty(lane: tuple[Problem, Carry], count: int) -> tuple[Problem, Carry]:
    """Lanes without a problem: their status is 0, which counts as finished."""
    return jax.tree.map(lambda leaf: jnp.zeros((count, *leaf.shape), leaf.dtype), lane)


def _put(lanes: tuple[Problem, Carry], lane: tuple[Problem, Carry], number: Int[Array, ""]) -> tuple[Problem, Carry]:
    return jax.tree.map(lambda leaves, leaf: leaves.at[number].set(leaf), lanes, lane)


@partial(jax.jit, static_argnames="max_iterations")
def begin_lane(problem: Problem, search: AbstractSearch, max_iterations: int) -> Carry:
    """Initial carry of the loop of `register`, compiled."""
    return begin(problem, search, max_iterations)


@partial(jax.jit, static_argnames="num_steps")
def run_lanes(problems: Problem, carries: Carry, search: AbstractSearch, num_steps: int) -> Carry:
    """Run at most `num_steps` steps of many stacked loops; finished loops do not change."""

    def run(problem: Problem, carry: Carry) -> Carry:
        return jax.lax.while_loop(
            lambda counted: (counted[0][0].status < 0) & (counted[1] < num_steps),
            lambda counted: (step_of_lane(counted[0], problem, search), counted[1] + 1),
            (carry, jnp.int32(0)),
        )[0]

    return jax.vmap(run)(problems, carries)


@jax.jit
def assess_lanes(problems: Problem, carries: Carry, search: AbstractSearch) -> Assessment:
    """Information matrices, directions and covariances of stacked loops, at their current poses."""

    def of_lane(problem: Problem, carry: Carry) -> Assessment:
        state, matches, _, estimates = carry
        matches = cleaned(matches)
        problem = replace(problem, method=problem.method.with_estimates(estimates))
        return assess(state, problem, matched_rows(problem.source, problem.target, matches), matches, search)

    return jax.vmap(of_lane)(problems, carries)
