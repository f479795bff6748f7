"""Batches in processes, asked for or chosen: the results of threads, and no trace of the workers that made them."""

import ast
import contextlib
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import psutil
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import Status
from mcgicp_jax._compute.threads import num_cores
from mcgicp_jax._pairs import batch_executors, processes
from mcgicp_jax._pairs.processes import Processes
from tests.batches import METHOD, assert_same, batch, prepared

pytestmark = [pytest.mark.slow, pytest.mark.timeout(240)]


@pytest.fixture(scope="module", autouse=True)
def workers():
    """All tests share them."""
    yield
    Processes(num_cores()).shutdown(cancel_futures=True)


def in_processes(sources, targets, **settings):
    return batch(sources, targets, executor="processes", **settings)


def told(function):
    """What a function returns in a worker, as a text."""

    def tell():
        raise ValueError(repr(function()))

    with pytest.warns(mcg.PairWarning) as caught:
        (result,) = in_processes([tell], [np.eye(3)])
    assert result.status is Status.INVALID_INPUT
    return caught[0].message.reason.removeprefix("source: ")


def test_the_results_of_threads(raw, alone):
    assert_same(in_processes(*prepared(raw)), alone)
    sides = [[pair[side] for pair in raw] for side in (0, 1)]
    assert_same(in_processes(*sides), batch(*sides))
    functions = [lambda cloud=cloud: cloud for cloud in sides[0]]
    assert_same(in_processes(functions, sides[1][0]), batch(*prepared(raw)[:1], sides[1][0]))
    with jax.enable_x64(True):
        double = [[cloud.unpad() for cloud in side] for side in prepared(raw[:2])]
        assert_same(in_processes(*double), batch(*double))


@pytest.fixture
def pays(monkeypatch):
    """Processes start as soon as the time of a pair is known."""
    monkeypatch.setattr(batch_executors, "_PAYS", 0.0)


def in_turn(folder, cloud, count, lock=None):
    """Functions that note in which process they ran; those with a lock cannot be sent to another one."""

    def load(i):
        with lock or contextlib.nullcontext():
            (folder / f"{i}.txt").write_text(str(os.getpid()))
        time.sleep(0.02)
        return cloud

    return [lambda i=i: load(i) for i in range(count)]


def pids_in(folder):
    return {int(path.read_text()) for path in folder.glob("*.txt")}


def test_processes_take_over_where_they_pay(raw, tmp_path, pays, caplog, monkeypatch):
    """Of an iterator, too, whose length is not known."""
    (source,), (target,) = prepared(raw[:1])
    monkeypatch.setattr(batch_executors.LOGGER, "disabled", False)
    with caplog.at_level(logging.INFO, "mcgicp_jax"):
        results = batch(iter(in_turn(tmp_path, source, 500)), iter([target] * 500))
    assert_same(results, 500 * batch([source], target, executor="threads"))
    assert os.getpid() in pids_in(tmp_path) and len(pids_in(tmp_path)) == 1 + num_cores()
    assert f"{num_cores()} processes start" in caplog.text
    with caplog.at_level(logging.INFO, "mcgicp_jax"):
        batch([source] * 4, [target] * 4)
    assert "4 pairs by threads" in caplog.text


def test_processes_do_not_start_beyond_the_memory_of_a_container(raw, tmp_path, pays, monkeypatch):
    (source,), (target,) = prepared(raw[:1])
    limit = tmp_path / "memory.max"
    limit.write_text(f"{psutil.Process().memory_info().rss + 2**29}\n")
    monkeypatch.setattr(batch_executors, "_MEMORY_LIMITS", [limit, tmp_path / "none"])
    batch(in_turn(tmp_path, source, 40), target)
    assert pids_in(tmp_path) == {os.getpid()}


@pytest.mark.parametrize("sendable", [0, 1000])
def test_what_cannot_be_sent_stays_at_home(raw, tmp_path, pays, sendable):
    """All pairs, or those after the processes have started."""
    (source,), (target,) = prepared(raw[:1])
    functions = in_turn(tmp_path, source, sendable) + in_turn(tmp_path, source, 40, threading.Lock())
    assert all(result.converged for result in batch(functions, target))
    assert (len(pids_in(tmp_path)) > 1) == (sendable > 0)


def test_the_time_of_the_caller_is_not_that_of_the_pairs(raw, tmp_path, monkeypatch):
    """Processes would not save it."""
    (source,), (target,) = prepared(raw[:1])
    monkeypatch.setattr(Processes, "are_warm", False)
    functions = in_turn(tmp_path, source, 1000)

    def slow():
        for function in functions:
            time.sleep(1.0)
            yield function

    for turn, pause in ((slow(), 0.0), (functions, 1.0)):
        # Enough pairs for several answers; each would seem to take a second.
        completed = mcg.register_as_completed(turn, target, METHOD, max_distance=0.5)
        for _ in range(2 * num_cores() + 4):
            next(completed)
            time.sleep(pause)
        completed.close()
    assert pids_in(tmp_path) == {os.getpid()}


def test_threads_go_on_if_processes_cannot_start(raw, tmp_path, pays, monkeypatch):
    (source,), (target,) = prepared(raw[:1])

    def refuse(*_, **__):
        raise OSError("no semaphores")

    monkeypatch.setattr(processes, "get_reusable_executor", refuse)
    results = batch(in_turn(tmp_path, source, 40), target)
    assert all(result.converged for result in results) and pids_in(tmp_path) == {os.getpid()}


def test_an_early_end_while_processes_start_ends_them(raw, tmp_path, pays):
    (source,), (target,) = prepared(raw[:1])
    Processes(num_cores()).shutdown(cancel_futures=True)
    completed = mcg.register_as_completed(in_turn(tmp_path, source, 1000), target, METHOD, max_distance=0.5)
    for _ in range(3 * num_cores()):
        next(completed)
    completed.close()
    assert not Processes._unfinished
    children = psutil.Process().children(recursive=True)
    assert not [child for child in children if "loky.backend.popen" in " ".join(child.cmdline())]


def test_a_worker_starts_no_processes(raw, tmp_path, pays):
    (source,), (target,) = prepared(raw[:1])

    def inside():
        batch_executors._PAYS = 0.0
        return all(result.converged for result in batch(in_turn(tmp_path, source, 60), target))

    assert told(inside) == "True" and len(pids_in(tmp_path)) == 1


def test_workers_stay_and_have_one_thread_and_the_settings_of_the_caller(monkeypatch):
    workers = {told(os.getpid) for _ in range(2 * num_cores() + 2)}
    assert len(workers) <= num_cores() and str(os.getpid()) not in workers
    assert told(lambda: (num_cores(), os.environ["PJRT_NPROC"], os.environ["OMP_NUM_THREADS"])) == "(1, '1', '1')"
    # Each worker would reserve memory of an accelerator.
    assert told(lambda: jax.config.jax_platforms) == "'cpu'"
    settings = lambda: (  # noqa: E731
        jax.config.jax_compilation_cache_dir,
        jax.config.jax_persistent_cache_min_compile_time_secs,
        jax.enable_x64.value,
        jax.default_matmul_precision.value,
        jax.debug_nans.value,
    )
    with jax.enable_x64(True), jax.default_matmul_precision("highest"), jax.debug_nans(True):
        assert ast.literal_eval(told(settings)) == settings()


def test_a_pair_that_ends_its_workers_is_given_up_alone(raw, alone):
    sources, targets = prepared(raw)
    sources[2] = lambda: os._exit(1)
    with pytest.warns(UserWarning) as caught:
        results = in_processes(sources, targets)
    first, second = (str(each.message) for each in caught)
    assert "a worker failed (TerminatedWorkerError" in first and "pair 2: its worker failed twice" in second
    assert "\n" not in first + second
    assert results[2].status is Status.WORKER_FAILED
    assert_same(results[:2] + results[3:], alone[:2] + alone[3:])


def test_what_cannot_be_sent_is_named(raw):
    sources, targets = prepared(raw)
    lock = threading.Lock()
    sources[3] = lambda: lock
    with pytest.raises(ValueError, match=r"^pairs 2 to 3: [^\n]*_thread\.lock[^\n]*$"):
        in_processes(sources, targets)


@pytest.mark.parametrize("offset", [0, np.array([4e5, 5e6, 0])], ids=["near", "far"])
def test_gradients_are_those_of_threads(raw, offset):
    """Poses and Jacobians to the last bit; a gradient adds the rows of the Jacobian in another order."""
    sources, targets = ([pair[side].replace(points=pair[side].points + offset) for pair in raw[:3]] for side in (0, 1))
    sources[2], weights = np.zeros((3, 3)), np.random.default_rng(0).normal(size=7)

    def poses(points, executor, pose="T_target_source"):
        moved = [sources[0].replace(points=points), *sources[1:]]
        method = mcg.MultiChannelGICP(0.05, 0.3 + 1e-3 * points[0, 0])
        results = mcg.register_batch(moved, targets, method, max_distance=0.5, executor=executor)
        assert results[2].status is Status.INVALID_INPUT
        return jnp.stack([getattr(result, pose).wxyz_xyz for result in results[:2]])

    points, executors = sources[0].points, (None, "processes")
    with pytest.warns(mcg.PairWarning):
        expected, found = (
            jax.jacrev(lambda points, executor=executor: poses(points, executor, "centred")[0])(points)
            for executor in executors
        )
        losses = [lambda points, executor=executor: (poses(points, executor) @ weights).sum() for executor in executors]
        (value, gradient), (other, by_workers) = (jax.value_and_grad(loss)(points) for loss in losses)
    np.testing.assert_array_equal(found, expected)
    assert value == other and np.abs(expected).max() > 0
    np.testing.assert_allclose(by_workers, gradient, rtol=1e-4, atol=1e-6 * np.abs(gradient).max())
    with pytest.warns(mcg.PairWarning):
        _, slope = jax.jvp(losses[1], (jnp.asarray(points),), (by_workers / np.linalg.norm(by_workers),))
    np.testing.assert_allclose(slope, np.linalg.norm(by_workers), rtol=1e-4)


def test_gradients_by_default_where_processes_pay(raw, pays, monkeypatch):
    """Threads run the first pairs, which are differentiated here, and processes the others, with their Jacobians."""
    (source,), (target,) = prepared(raw[:1])
    by_workers = mock.Mock(wraps=batch_executors.KnownJacobian)
    monkeypatch.setattr(batch_executors, "KnownJacobian", by_workers)

    def loss(points, executor, count):
        clouds = [source.replace_rows(points=points)] * count
        results = mcg.register_batch(clouds, target, METHOD, max_distance=0.5, executor=executor)
        return sum(jnp.sum(result.matrix[:3, 3]) for result in results) / count

    # Workers that wait take over at once.
    told(os.getpid)
    gradient = jax.grad(loss)(source.points, None, 30 * num_cores())
    assert 0 < by_workers.call_count < 30 * num_cores()
    results = []

    def cost(points, executor):
        clouds = [source.replace_rows(points=points)] * 2
        results.extend(
            mcg.register_batch(clouds, target, METHOD, executor=executor, covariances=False, max_distance=0.5)
        )
        return results[-1].cost

    # Wherever a pair ran.
    for executor in ("threads", "processes"):
        with pytest.raises(NotImplementedError):
            jax.grad(cost)(source.points, executor)
    assert all(np.isnan(np.asarray(jax.lax.stop_gradient(result.deviations))).all() for result in results)
    expected = jax.grad(loss)(source.points, "threads", 2)
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


def test_warnings_of_workers_are_shown_here():
    cloud = np.random.default_rng(0).random((300, 3))
    cloud[0] = np.nan
    with pytest.warns(UserWarning, match="^pair 1: source: .*300") as caught:
        mcg.register_batch([cloud[1:], cloud], cloud[1:], mcg.PointToPoint(), executor="processes")
    assert len(caught) == 1 and caught[0].filename == __file__


def test_an_early_end_ends_the_workers(raw):
    sources, targets = prepared(raw)
    pid = int(told(os.getpid))
    completed = mcg.register_as_completed(20 * sources, 20 * targets, METHOD, max_distance=0.5, executor="processes")
    next(completed)
    completed.close()
    assert not is_running(pid)


def test_an_early_end_does_not_disturb_other_batches(raw, recwarn):
    sources, targets = prepared(raw)
    completed = mcg.register_as_completed(20 * sources, 20 * targets, METHOD, max_distance=0.5, executor="processes")
    other = mcg.register_as_completed(8 * sources, 8 * targets, METHOD, max_distance=0.5, executor="processes")
    next(completed), next(other)
    completed.close()
    assert sum(1 for _, result in other if result.converged) == 8 * len(sources) - 1
    assert not recwarn.list


def is_running(pid):
    with contextlib.suppress(psutil.NoSuchProcess):
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    return False


def all_ended(pids):
    """Whether no process is running, ten seconds from now at the latest."""
    deadline = time.monotonic() + 10
    while any(map(is_running, pids)) and time.monotonic() < deadline:
        time.sleep(0.1)
    return not any(map(is_running, pids))


SCRIPT = """
import os, signal, sys, time
import numpy as np
import mcgicp_jax as mcg

# Shells start what they run in the background with this signal ignored, and the tests may be among that.
signal.signal(signal.SIGINT, signal.default_int_handler)

def cloud():
    # One write: lines of several processes must not mix.
    os.write(1, b"%d\\n" % os.getpid())
    time.sleep(0.05)
    return np.random.default_rng(0).random((100, 3))

count = int(sys.argv[1])
print(os.getpid(), flush=True)
executor = {"by default": None}.get(sys.argv[2], sys.argv[2])
# By default, they start as soon as the time of a pair is known.
mcg._pairs.batch_executors._PAYS = 0.0
results = mcg.register_batch([cloud] * count, cloud, mcg.PointToPoint(), max_iterations=1, executor=executor)
print("done", len(results), flush=True)
"""


@contextlib.contextmanager
def started(folder, count, executor="processes"):
    """A process group of its own that runs the script."""
    script = folder / "script.py"
    script.write_text(SCRIPT)
    command, pipes = (
        [sys.executable, str(script), str(count), executor],
        {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE},
    )
    with subprocess.Popen(command, text=True, start_new_session=True, **pipes) as process:
        yield process


def test_workers_that_are_starting_do_not_report_an_interrupt(tmp_path):
    with started(tmp_path, 100_000) as process:
        process.stdout.readline()
        # They import NumPy and JAX for some seconds.
        time.sleep(0.7)
        os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert errors.count("KeyboardInterrupt") == 1, errors


@pytest.mark.parametrize("number", [None, signal.SIGINT, signal.SIGKILL])
def test_a_script_without_a_guard_leaves_no_process(tmp_path, number):
    """At its end, interrupted as by Ctrl-C in a terminal, and killed."""
    with started(tmp_path, 6 if number is None else 100_000) as process:
        pids = {int(process.stdout.readline()) for _ in range(7)} - {process.pid}
        assert 1 <= len(pids) <= num_cores()
        if number is signal.SIGINT:
            # The terminal sends it to the whole group.
            os.killpg(process.pid, number)
        elif number is not None:
            process.send_signal(number)
        if number is signal.SIGKILL:
            process.stdout.close()
            process.stderr.close()
            process.wait()
        else:
            text, errors = process.communicate(timeout=60)
            assert ("done 6" in text) == (number is None)
            assert errors.count("Traceback") == (number is not None), errors
    assert all_ended(pids)


def test_a_script_that_is_interrupted_after_processes_took_over_leaves_none(tmp_path):
    with started(tmp_path, 100_000, "by default") as process:
        pids = iter(lambda: int(process.stdout.readline()), None)
        worker = next(pid for pid in pids if pid != process.pid)
        os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert errors.count("KeyboardInterrupt") == errors.count("Traceback") == 1, errors
    assert all_ended({worker})


CELL = """
import os, signal, threading
import numpy as np
import mcgicp_jax as mcg

def cloud():
    return np.random.default_rng(0).random((100, 3))

def register(count):
    results = mcg.register_batch([cloud] * count, cloud, mcg.PointToPoint(), max_iterations=1, executor="processes")
    print(len(results))
"""
INTERRUPTED = """
threading.Timer(1, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
try:
    register(100_000)
except KeyboardInterrupt:
    print("interrupted")
"""
# The workers are children of the kernel.
CHILDREN = """
with open(f"/proc/self/task/{os.getpid()}/children") as file:
    print(file.read())
"""


def test_cells_of_a_notebook_share_workers_that_end_with_it():
    """Functions of a cell are sent to the workers, and after an interrupted cell the next one runs."""
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    sources = [CELL, "register(6)", INTERRUPTED, "register(6)", CHILDREN]
    notebook = nbformat.v4.new_notebook(cells=list(map(nbformat.v4.new_code_cell, sources)))
    nbclient.NotebookClient(notebook, timeout=120).execute()
    _, first, interrupted, second, children = ("".join(o.get("text", "") for o in c.outputs) for c in notebook.cells)
    assert first == second == "6\n" and interrupted == "interrupted\n"
    pids = set(map(int, children.split()))
    assert pids and all_ended(pids)
