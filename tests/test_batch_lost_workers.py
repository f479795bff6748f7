"""A worker or process that is lost costs no pair of a batch; executors of other processes."""

import multiprocessing
import os
import pathlib
import signal
import warnings
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor

import jax
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import Status
from tests.batches import METHOD, assert_same, batch, prepared
from tests.scenes import room_corner


class Unlucky(Executor):
    """Whose worker dies with some of the pairs, always or at first."""

    def __init__(self, deadly, times, at_submit=False):
        self.deadly, self.times, self.sent = deadly, times, []

    def submit(self, function, chunk):
        future = Future()
        numbers = [pair.index for pair in chunk]
        self.sent.append(numbers)
        if self.deadly in numbers and self.times > 0:
            self.times -= 1
            future.set_exception(BrokenExecutor("a worker died"))
        else:
            future.set_result(function(chunk))
        return future


def test_a_worker_that_dies_costs_a_retry(raw, alone):
    executor = Unlucky(deadly=2, times=1)
    with pytest.warns(UserWarning, match=r"a worker failed \(BrokenExecutor: a worker died\)"):
        results = batch(*prepared(raw), executor=executor)
    assert_same(results, alone)
    assert executor.sent == [[0, 1, 2, 3, 4, 5], [0], [1], [2], [3], [4], [5]]


def test_a_pair_that_kills_its_workers_is_given_up_alone(raw, alone):
    with pytest.warns(UserWarning, match="pair 2: its worker failed twice"), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "a worker failed")
        results = batch(*prepared(raw), executor=Unlucky(deadly=2, times=9))
    assert results[2].status is Status.WORKER_FAILED
    del results[2]
    assert_same(results, alone[:2] + alone[3:])


def test_a_worker_that_dies_causes_one_warning(raw, alone):
    """As in a pool, the chunks of other workers fail with it."""

    class Pool(Unlucky):
        def submit(self, function, chunk):
            self.deadly = chunk[0].index
            return super().submit(function, chunk)

    sources, targets = prepared(raw)
    with pytest.warns(UserWarning) as caught:
        results = batch(4 * sources, 4 * targets, executor=Pool(deadly=0, times=3))
    assert_same(results, 4 * alone)
    assert len(caught) == 1


def die():
    """The first process that comes here is gone."""
    try:
        pathlib.Path("marker").touch(exist_ok=False)
    except FileExistsError:
        return mcg.PointCloud(*room_corner(300, seed=1))
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_spawned_processes_and_one_that_is_killed(raw, alone, tmp_path):
    sources, targets = prepared(raw)
    context = multiprocessing.get_context("spawn")
    # Its initializer runs in the pool that takes its place, too: only there is the marker found.
    with ProcessPoolExecutor(1, context, os.chdir, (tmp_path,)) as processes:
        assert_same(batch(sources, targets, executor=processes), alone)
        # What is set for a block of code holds in the other processes, too.
        with jax.enable_x64(True):
            again = [[cloud.unpad() for cloud in side] for side in (sources, targets)]
            results = batch(*again, executor=processes)
            assert results[0].T_target_source.wxyz_xyz.dtype == again[0][0].points.dtype
            assert_same(results, batch(*again))
        with pytest.warns(UserWarning, match="BrokenProcessPool"):
            results = batch([die, *sources], [targets[0], *targets], executor=processes)
    assert results[0].converged
    assert_same(results[1:], alone)


def test_forked_processes_are_refused(raw):
    with (
        ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork")) as processes,
        pytest.raises(ValueError, match="spawn"),
    ):
        batch(*prepared(raw), executor=processes)


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker(raw, alone):
    """Processes of Dask's, one of which is killed while it works."""
    distributed = pytest.importorskip("distributed")
    sources, targets = prepared(raw)
    repeats = 12
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        numbers = []
        completed = mcg.register_as_completed(
            sources * repeats, targets * repeats, METHOD, max_distance=0.5, executor=client.get_executor()
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for number, result in completed:
                if not numbers:
                    os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)
                numbers.append(number)
                assert_same([result], [alone[number % len(raw)]])
    assert sorted(numbers) == list(range(repeats * len(raw)))
