"""Memory of one process over many registrations.

    python -m tests.benchmarks.soak [--registrations 10000]

Registers clouds of 100 to 288 points of random sizes by GICP, and by MC-GICP with a robust kernel; every fifth pair is
at UTM coordinates, every hundredth inside `jax.jit`. Prints resident memory after a garbage collection, the number of
memory maps (Linux allows 65,530), of compilations, and of trees cached for callbacks. Only the trees should grow, up to
their limit.
"""

from __future__ import annotations

import argparse
import collections
import gc
import logging
import pathlib
import resource
import time

import jax
import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax._compute.size_classes import size_class
from mcgicp_jax._search import kd_tree as _trees
from tests.scenes import room_corner

_METHODS = ((mcg.GICP(), None), (mcg.MultiChannelGICP(), mcg.Huber(1.0)))
_SIZES = (100, 288)
_REPORTS = 10
_TRACED_EVERY = 100
_UTM = np.array([4.5e5, 5.2e6, 300.0])


class Compilations(logging.Handler):
    """Count compilations from JAX's log."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.count = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.count += record.getMessage().startswith("Compiling ")


def clouds(rng: np.random.Generator, turn: int) -> tuple[mcg.PointCloud, mcg.PointCloud]:
    offset = _UTM if turn % 5 == 0 else np.zeros(3)
    made = []
    for seed in (2 * turn, 2 * turn + 1):
        points, channels = room_corner(int(rng.integers(_SIZES[0], _SIZES[1] + 1)), seed=seed)
        made.append(mcg.preprocess(mcg.PointCloud(points + offset, channels)))
    return made[0], made[1]


def resident_mib() -> float:
    gc.collect()
    return int(pathlib.Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


def num_maps() -> int:
    return len(pathlib.Path("/proc/self/maps").read_bytes().splitlines())


@jax.jit
def traced(source: mcg.PointCloud, target: mcg.PointCloud) -> jax.Array:
    return mcg.register(source, target, mcg.GICP(), max_distance=0.5).status_code


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--registrations", type=int, default=10_000)
    options = parser.parse_args()
    compilations = Compilations()
    for name in ("jax._src.interpreters.pxla", "jax._src.dispatch", "jax._src.compiler"):
        logger = logging.getLogger(name)
        logger.addHandler(compilations)
        logger.propagate = False
    jax.config.update("jax_log_compiles", True)
    rng = np.random.default_rng(0)
    outcomes: collections.Counter[str] = collections.Counter()
    begin = time.perf_counter()
    print("| registrations | resident, MiB |   maps | compilations | trees kept |    time |")
    print("| ------------: | ------------: | -----: | -----------: | ---------: | ------: |")
    for turn in range(options.registrations):
        source, target = clouds(rng, turn)
        if turn % _TRACED_EVERY == 0:
            padded = [cloud.pad(size_class(_SIZES[1])) for cloud in (source, target)]
            outcomes[mcg.Status(int(traced(*padded))).name] += 1
        else:
            method, robust = _METHODS[turn % 2]
            result = mcg.register(source, target, method, max_distance=0.5, robust=robust)
            outcomes[result.status.name] += 1
        if (turn + 1) % (options.registrations // _REPORTS) == 0:
            trees = len(_trees._indices._values)
            print(
                f"| {turn + 1:13,} | {resident_mib():13.0f} | {num_maps():6,} | {compilations.count:12,} | {trees:10} "
                f"| {time.perf_counter() - begin:5.0f} s |",
                flush=True,
            )
    print(", ".join(f"{count:,} {name}" for name, count in outcomes.most_common()))


if __name__ == "__main__":
    main()
