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
@pytest.mark.parametrize("failing", [0, 3])
def test_an_error_in_any_thread_is_raised(failing):
    def before(number):
        if number == failing:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        watched(before, 2)


def test_after_an_error_nobody_goes_on():
    def before(_):
        if threading.current_thread() is threading.main_thread():
            time.sleep(0.1)  # The other thread has begun.
            raise ZeroDivisionError
        # Far longer than the call that fails, on a busy machine, too.
        time.sleep(0.5)

    with pytest.raises(ZeroDivisionError):
        watched(before, 2)
    assert len(CALLS) <= 3


@pytest.mark.timeout(60)
def test_users_may_have_threads_of_their_own():
    """More than there are cores, each of which shares its queries with the threads of the package."""
    expected = mcg.KDTreeSearch().neighbors(POINTS, 5)
    with ThreadPoolExecutor(8) as users:
        for found in users.map(lambda _: mcg.KDTreeSearch().neighbors(POINTS, 5), range(16)):
            np.testing.assert_array_equal(found, expected)


def test_threads_may_share_clouds():
    """And what is computed of their rows, by one of them."""
    first, second = (mcg.preprocess(room_corner(2000, seed=seed)[0]) for seed in (0, 1))
    sizes = (200, 500, None, 300) * 2

    def matrix(clouds, size):
        return mcg.register(*clouds, mcg.GICP(), max_distance=0.3, max_source_points=size).matrix

    expected = [matrix((first.replace(), second.replace()), size) for size in sizes[:4]]
    with ThreadPoolExecutor(len(sizes)) as users:
        found = list(users.map(lambda size: matrix((first, second), size), sizes))
    np.testing.assert_array_equal(found, expected * 2)


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
