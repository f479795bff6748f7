"""Queries in several threads: every answer in its place, and no waiting for those who wait."""

import subprocess
import sys
import textwrap
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial import cKDTree

import mcgicp_jax as mcg
from tests.scenes import room_corner

# Some blocks of queries.
POINTS = room_corner(9000)[0]


class Watched(mcg.KDTreeSearch):
    """Each query first calls `before` with its number."""

    def query(self, *arguments):
        with LOCK:
            CALLS.append(len(CALLS))
            number = CALLS[-1]
        BEFORE[0](number)
        return super().query(*arguments)


CALLS, BEFORE, LOCK = [], [None], threading.Lock()


def watched(before, workers):
    """Neighbours of the points by some workers."""
    CALLS.clear()
    BEFORE[0] = before
    return Watched(workers=workers, backend="scipy").neighbors(POINTS, 5)


@pytest.mark.parametrize("workers", [1, 2, -1])
def test_answers_come_in_order_from_no_more_threads_than_asked_for(workers):
    running, peak = [], []

    def before(number):
        running.append(1)
        peak.append(len(running))
        # The first one ends after the next.
        time.sleep(0.01 if number else 0.1)
        running.pop()

    np.testing.assert_array_equal(watched(before, workers), cKDTree(POINTS).query(POINTS, 5)[1])
    assert workers == -1 or max(peak) <= workers < max(len(CALLS), 2)


@pytest.mark.timeout(60)
def test_an_error_in_any_thread_is_raised_and_stops_the_others():
    def fails(number):
        if number == 3:
            raise ZeroDivisionError

    def fails_late(_):
        if threading.current_thread() is threading.main_thread():
            time.sleep(0.1)  # The other thread has begun.
            raise ZeroDivisionError
        # Far longer than the call that fails, on a busy machine, too.
        time.sleep(0.5)

    for before in (fails, fails_late):
        with pytest.raises(ZeroDivisionError):
            watched(before, 2)
    assert len(CALLS) <= 3


@pytest.mark.timeout(60)
def test_users_may_have_threads_of_their_own_that_share_clouds():
    """More than there are cores, each of which shares its queries with the threads of the package."""
    first, second = (mcg.preprocess(room_corner(2000, seed=seed)[0]) for seed in (0, 1))
    sizes = (200, 500, None, 300) * 2

    def matrix(clouds, size):
        return mcg.register(*clouds, mcg.GICP(), max_distance=0.3, max_source_points=size).matrix

    expected = [matrix((first.replace(), second.replace()), size) for size in sizes[:4]]
    with ThreadPoolExecutor(len(sizes)) as users:
        found = list(users.map(lambda size: matrix((first, second), size), sizes))
        neighbors = list(users.map(lambda _: mcg.KDTreeSearch().neighbors(POINTS, 5), sizes))
    np.testing.assert_array_equal(found, expected * 2)
    np.testing.assert_array_equal(neighbors, [cKDTree(POINTS).query(POINTS, 5)[1]] * len(sizes))


@pytest.mark.slow
def test_the_interpreter_does_not_wait_for_a_source_of_frames():
    """Which is read ahead while the odometry of the last frame is in use."""
    code = """
        import time, numpy as np, mcgicp_jax as mcg
        def frames():
            for seed in (0, 1):
                yield np.random.default_rng(seed).normal(size=(50, 3))
            time.sleep(1e6)
        steps = mcg.odometry(frames(), mcg.PointToPoint(), max_distance=1.0)
        next(steps), next(steps)
        time.sleep(0.5)
        print("the end", flush=True)
    """
    ended = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=120)
    assert ended.returncode == 0 and ended.stdout == "the end\n", ended.stderr
