"""Work side by side: every answer in its place, and no waiting for those who wait."""

import subprocess
import sys
import textwrap
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import pytest

from mcgicp_jax._compute import threads as _threads
from mcgicp_jax._compute.threads import ReadAhead, side_by_side


@pytest.fixture(autouse=True)
def cores(monkeypatch):
    """On a single core, no other threads take part."""
    monkeypatch.setattr(_threads, "num_cores", lambda: 3)


def test_answers_come_in_order_and_the_first_from_this_thread():
    calls = [partial(lambda i: (i, threading.get_ident()), i) for i in range(20)]
    answers = side_by_side(calls)
    assert [i for i, _ in answers] == list(range(20))
    assert answers[0][1] == threading.get_ident()


@pytest.mark.timeout(30)
def test_other_threads_have_the_settings_of_this_one():
    both = threading.Barrier(2)

    def setting():
        both.wait()
        return jax.enable_x64.value

    with jax.enable_x64(True):
        assert side_by_side([setting] * 2) == [True, True]


@pytest.mark.timeout(30)
def test_calls_may_themselves_work_side_by_side():
    def fan(depth):
        return 1 if depth == 0 else sum(side_by_side([partial(fan, depth - 1)] * 3))

    with ThreadPoolExecutor(8) as users:
        assert list(users.map(fan, [4] * 8)) == [81] * 8


def test_without_threads_this_one_does_it_all(monkeypatch):
    ended = ThreadPoolExecutor(1)
    ended.shutdown()
    monkeypatch.setattr(_threads, "_threads", lambda: ended)
    assert side_by_side([partial(int, text) for text in "123"]) == [1, 2, 3]


def test_an_error_is_raised():
    with pytest.raises(ZeroDivisionError):
        side_by_side([lambda: 1, lambda: 1 // 0])


def test_no_more_threads_than_asked_for_are_at_work(monkeypatch):
    running, peak = [], []

    def work():
        running.append(1)
        peak.append(len(running))
        time.sleep(0.01)
        running.pop()

    with ThreadPoolExecutor(8) as threads:
        monkeypatch.setattr(_threads, "_threads", lambda: threads)
        monkeypatch.setattr(_threads, "num_cores", lambda: 8)
        side_by_side([work] * 20, 3)
        assert max(peak) == 3
        peak.clear()
        side_by_side([work] * 20, 1)
        assert max(peak) == 1
        peak.clear()
        monkeypatch.setattr(_threads, "num_cores", lambda: 1)
        side_by_side([work] * 20)
        assert max(peak) == 1


@pytest.mark.timeout(30)
def test_an_error_in_another_thread_is_raised():
    started = threading.Event()

    def fail():
        started.set()
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        side_by_side([lambda: started.wait(10), fail])


def test_after_an_error_nobody_goes_on(monkeypatch):
    calls = []

    def fail():
        raise ZeroDivisionError

    def slow():
        calls.append(1)
        # Far longer than the first call, on a busy machine, too.
        time.sleep(0.5)

    with ThreadPoolExecutor(1) as threads:
        monkeypatch.setattr(_threads, "_threads", lambda: threads)
        with pytest.raises(ZeroDivisionError):
            side_by_side([fail, *[slow] * 50])
    assert len(calls) <= 1


def test_what_is_read_ahead_survives_an_interruption_and_an_error_is_raised_in_its_place(monkeypatch):
    numbers = iter([1, 2, 0, 4])
    ahead = ReadAhead(lambda: 1 / next(numbers))
    assert next(ahead) == 1
    with monkeypatch.context() as patch:
        patch.setattr(_threads, "wait", lambda futures: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            next(ahead)
    assert next(ahead) == 0.5
    with pytest.raises(ZeroDivisionError):
        next(ahead)
    assert list(ahead) == [0.25]


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
