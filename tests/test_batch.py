"""Many pairs: each as if it were alone, whatever the others, their order and the workers."""

import copy
import os
import pickle
import re
import threading
import warnings
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import partial

import jax
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import Status, datasets
from mcgicp_jax.metrics import pose_error
from tests.batches import METHOD, assert_same, batch, prepared
from tests.refusals import refused
from tests.scenes import motion, room_corner


def test_each_pair_is_as_if_it_were_alone(raw, alone):
    results = batch(*prepared(raw))
    assert_same(results, alone)
    for result, (_, _, truth) in zip(results, raw, strict=True):
        assert max(pose_error(result.matrix, truth)) < 0.02
    # Matches of one of them circle.
    assert sum(result.converged for result in results) >= 5


def test_results_without_covariances(raw):
    expected, found = (batch(*prepared(raw[:2]), covariances=wanted) for wanted in (True, False))
    for one, other in zip(expected, found, strict=True):
        assert np.isfinite(one.covariance).all() and np.isnan([*other.covariance.ravel(), *other.deviations]).all()
        assert_same([other.build(**vars(other) | {"uncertainty": one.uncertainty})], [one])


def test_every_option_of_register_is_one_of_a_batch(raw):
    options = {"equalize_channels": True, "voxel_sizes": (0.2,), "robust": mcg.Huber(1.0), "max_iterations": 20}
    source, target = (mcg.preprocess(cloud) for cloud in raw[0][:2])
    expected = mcg.register(source, target, METHOD, **options)
    assert_same(batch([source], [target], max_distance=None, **options), [expected])


@pytest.mark.slow
def test_raw_clouds_are_prepared_by_the_workers(raw):
    sources, targets = [[pair[side] for pair in raw] for side in (0, 1)]
    ready = [[mcg.preprocess(cloud, 0.1, 12) for cloud in side] for side in (sources, targets)]
    assert_same(batch(sources, targets, voxel_size=0.1, num_neighbors=12), batch(*ready))


def test_order_and_number_of_workers_change_nothing(raw, alone):
    order = np.random.default_rng(0).permutation(len(raw))
    sides = [[side[i] for i in order] for side in prepared(raw)]
    for num_workers in (1, 5):
        with ThreadPoolExecutor(num_workers) as threads:
            assert_same(batch(*sides, executor=threads), [alone[i] for i in order])


class Broken(mcg.GICP):
    """A method of a user that raises."""

    def covariance(self, around, local):
        raise TypeError("a mistake")


def test_mistakes_of_a_method_are_raised_while_a_batch_is_differentiated():
    cloud = mcg.preprocess(np.random.default_rng(0).random((300, 3)), None)

    def loss(points):
        return mcg.register_batch([cloud.replace(points=points)], [cloud], Broken())[0].matrix.sum()

    with pytest.raises(TypeError, match="a mistake"):
        jax.grad(loss)(cloud.points)


SPOILED = {
    "empty": np.zeros((0, 3)),
    "one point": np.zeros((1, 3)),
    "too few": np.eye(3),
    "not a number": np.full((50, 3), np.nan),
    "no cloud": np.zeros((50, 2)),
    "no channels": np.random.default_rng(0).random((300, 3)),
}


@pytest.mark.parametrize("side", [0, 1])
def test_bad_pairs_have_their_status_and_spoil_no_others(raw, alone, side):
    clouds = prepared(raw)
    for cloud in SPOILED.values():
        clouds[side].insert(2, cloud)
        clouds[1 - side].insert(2, clouds[1 - side][2])
    with pytest.warns(mcg.PairWarning) as caught:
        results = batch(*clouds)
    last = 2 + len(SPOILED)
    assert sorted(warning.message.index for warning in caught) == list(range(2, last))
    assert all(re.match("(source|target|channels)", warning.message.reason) for warning in caught)
    for result in results[2:last]:
        assert result.status is Status.INVALID_INPUT and not result.converged
        assert np.isnan(result.matrix).any() and "INVALID_INPUT" in repr(result)
    assert_same(results[:2] + results[last:], alone)


def test_the_warning_can_be_sent_copied_and_repeated():
    with pytest.warns(mcg.PairWarning) as caught:
        batch([np.zeros((50, 2))], [np.zeros((50, 3))])
    warning = caught[0].message
    for same in (warning, pickle.loads(pickle.dumps(warning)), copy.deepcopy(warning)):
        assert same.index == 0 and str(same) == f"pair 0: {same.reason}" and "source" in same.reason
    bare = mcg.PairWarning(str(warning))
    assert str(bare) == str(warning) and bare.index is None and bare.reason == ""


@pytest.mark.parametrize("search", [None, pytest.param(mcg.DenseSearch(), marks=pytest.mark.slow)])
def test_a_pose_from_a_small_overlap_is_warned_of_with_its_pair(search):
    target, near = (room_corner(size, seed=seed)[0] + 40 for size, seed in ((2000, 0), (60, 1)))
    source = np.concatenate([near, target[:1940] - 50])
    with pytest.warns(mcg.PairWarning, match="pair 1: only .* %") as caught:
        results = mcg.register_batch(
            [target, source], [target] * 2, mcg.PointToPlane(), max_distance=0.3, search=search
        )
    assert len(caught) == 1 and 0 < results[1].overlap < 0.1 < results[0].overlap
    assert [result.status.name for result in results] == ["CONVERGED", "UNVERIFIED"]


def test_pairs_without_overlap_or_far_from_rest_have_the_status_of_register(raw, alone):
    sources, targets = prepared(raw)
    starts = [motion((100.0, 0, 0, 0, 0, 0)), *[np.eye(4)] * (len(raw) - 2), 2 * np.eye(4)]
    with pytest.warns(mcg.PairWarning, match="pair 5: init: "):
        results = batch(sources, targets, init=starts)
    assert results[0].status is Status.TOO_FEW_CORRESPONDENCES and results[5].status is Status.INVALID_INPUT
    assert_same(results[1:5], alone[1:5])
    assert {result.status for result in batch(sources, targets, max_iterations=1)} == {Status.MAX_ITERATIONS}


def test_one_target_for_all(raw):
    (*sources,), (target, *_) = prepared(raw[:3])
    expected = batch(sources, [target] * 3)
    assert_same(batch(sources, target), expected)
    assert_same(batch(sources, raw[0][1]), expected)
    assert_same(batch(target, sources), batch([target] * 3, sources))
    points = np.random.default_rng(0).normal(size=(60, 3))
    table = np.rec.fromarrays(points.T, names="x,y,z")
    results = mcg.register_batch([points + 0.01, points - 0.01], table, mcg.PointToPoint())
    assert [result.num_inliers for result in results] == [60, 60]


def test_starts_for_all_or_for_each(raw):
    sources, targets = prepared(raw[:3])
    starts = np.stack([motion(0.01 * np.arange(6) * i) for i in range(3)])
    cases = zip(sources, targets, starts, strict=True)
    expected = [mcg.register(*clouds, METHOD, init=start, max_distance=0.5) for *clouds, start in cases]
    assert_same(batch(sources, targets, init=starts), expected)
    assert_same(batch(sources, targets, init=iter(starts)), expected)
    assert_same(batch(sources[1:2], targets[1:2], init=starts[1]), expected[1:2])


def test_iterators_are_consumed_as_needed(raw):
    """Never many more pairs are held than there are workers."""
    (source,), (target,) = prepared(raw[:1])
    taken, held = [], []
    sources = (taken.append(1) or source for _ in range(60))
    options = {"max_distance": 0.5, "max_iterations": 1}
    for finished, _ in enumerate(mcg.register_as_completed(sources, target, mcg.PointToPoint(), **options)):
        held.append(len(taken) - finished)
    assert len(held) == 60 and max(held) <= 4 * os.cpu_count() + 4


def test_functions_that_make_clouds_are_called_by_the_workers(raw, alone):
    threads = []

    def make(cloud):
        threads.append(threading.current_thread())
        return cloud

    sources, targets = [partial(make, pair[0]) for pair in raw], [pair[1] for pair in raw]
    assert_same(batch(sources, targets), alone)
    assert threading.main_thread() not in threads and len(threads) == len(raw)


class Elsewhere(Executor):
    """Runs what is submitted at once, as in a process without x64, to which it is sent."""

    def __init__(self, sends=False):
        self.sends = sends

    def submit(self, function, chunk):
        future = Future()
        with jax.enable_x64(False):
            job = pickle.loads(pickle.dumps((function, chunk))) if self.sends else (function, chunk)
            future.set_result(job[0](job[1]))
        return future


PLACE = rf"\({re.escape(__file__)}, line \d+\)"


@pytest.mark.parametrize(
    "error, reason",
    [
        pytest.param(KeyError("scan"), f"KeyError: 'scan' {PLACE}", id="error"),
        pytest.param(SystemExit("scan"), f"SystemExit: scan {PLACE}", id="exit"),
        pytest.param(FileNotFoundError(2, "No such file", "scan.ply"), r".*scan\.ply", id="file"),
    ],
)
def test_any_error_of_a_function_is_the_reason_of_its_pair(error, reason, raw, alone):
    calls = []

    def broken():
        calls.append(None)
        raise error

    sources, targets = prepared(raw[:3])
    sources[1] = broken
    for executor in (None, Elsewhere()):
        with pytest.warns(mcg.PairWarning, match=f"pair 1: source: {reason}") as caught:
            results = batch(sources, targets, executor=executor)
        assert len(caught) == len(calls) == 1 and results[1].status is Status.INVALID_INPUT
        assert_same([results[0], results[2]], [alone[0], alone[2]])
        calls.clear()


def test_results_come_as_they_finish(raw):
    sources, targets = prepared(raw)
    gate = threading.Event()

    def slow():
        gate.wait(60)
        return sources[0]

    numbers = []
    options = {"max_distance": 0.5, "executor": ThreadPoolExecutor(2)}
    for number, result in mcg.register_as_completed([slow, *sources[1:3]], targets[:3], METHOD, **options):
        numbers.append(number)
        gate.set()
        assert result.num_inliers > 250
    assert sorted(numbers) == [0, 1, 2] and numbers[0] != 0


def test_what_concerns_all_pairs_is_raised_at_once(raw):
    sides = prepared(raw)
    for name, value in (
        *(("max_distance", -1.0), ("translation_tolerance", -1.0), ("max_iterations", 0), ("voxel_size", 0.0)),
        *(("num_neighbors", 2), ("init", 2 * np.eye(4)), ("init", "local"), ("executor", "thread")),
    ):
        options = {"max_distance": 0.5, name: value}
        refused(lambda options=options: mcg.register_as_completed(*sides, METHOD, **options), name)


def test_sides_that_do_not_fit(raw):
    sources, targets = prepared(raw)
    for named, shown, *sides in (
        ("sources", 2, sources, targets[:2]),
        ("targets", 2, iter(sources), iter(targets[:2])),
        ("sources", "", sources[0], targets[0]),
        ("targets: cloud", 3, sources, np.eye(3)),
    ):
        refused(lambda sides=sides: batch(*sides), named, shown)
    assert batch([], []) == []


def test_everything_survives_pickle_and_deepcopy(raw, alone):
    for thing in (mcg.preprocess(raw[0][0]), raw[0][0], METHOD, alone[0], mcg.KDTreeSearch(1), mcg.Huber(1.0)):
        for twin in (pickle.loads(pickle.dumps(thing)), copy.deepcopy(thing)):
            assert type(twin) is type(thing)
            assert_same([twin], [thing])
            assert repr(twin) == repr(thing)


def test_workers_have_the_settings_of_the_caller(raw):
    """Such as `jax.enable_x64`, which belong to a thread."""
    source, target, _ = raw[0]
    seen = []

    def make():
        seen.append((jax.enable_x64.value, jax.default_matmul_precision.value))
        return source

    options = {"method": mcg.PointToPoint(), "max_distance": 0.5, "robust": mcg.Huber(0.3)}
    with jax.enable_x64(True), jax.default_matmul_precision("highest"):
        (result,) = mcg.register_batch([make], [target], **options)
        # Numbers of float64 stay what they are on the way to another process.
        sent, expected = (
            mcg.register_batch([source], [target], executor=executor, **options)
            for executor in (Elsewhere(sends=True), None)
        )
        assert_same(sent, expected)
    assert seen == [(True, "highest")]
    assert result.T_target_source.wxyz_xyz.dtype == np.float64


def test_workers_average_raw_clouds_in_the_voxels_of_preprocessed_ones(raw):
    """The voxel size of a cloud is no leaf of its pytree."""
    (source, target, _), options = raw[0], {"max_distance": 0.5}
    sides = [source], [mcg.preprocess(target, 0.4)]
    sent, expected = (
        mcg.register_batch(*sides, mcg.GICP(), executor=executor, **options)
        for executor in (Elsewhere(sends=True), None)
    )
    assert_same(sent, expected)


def test_workers_leave_the_filters_of_warnings_alone(raw, monkeypatch):
    """Threads share them: a worker that changed them would hide the warnings of others."""
    sources, targets = prepared(raw[:2])
    # In a context: pytest itself uses what is taken away here when it reports a failure.
    with monkeypatch.context() as patch:
        patch.setattr(warnings, "catch_warnings", None)
        results = mcg.register_batch(sources, targets, mcg.MultiChannelGICP(), equalize_channels=True)
    assert not {Status.INVALID_INPUT, Status.WORKER_FAILED} & {result.status for result in results}


@pytest.mark.slow
@pytest.mark.parametrize("search", [None, mcg.DenseSearch()])
def test_a_batch_starts_from_anywhere(search):
    """A room seen from afar, another room, and ten points; with threads and with lanes."""
    target, source = datasets.box_room(2, points_per_frame=4000)
    away = motion((3, -2, 1, 1.0, 2.0, -0.5))
    other = datasets.box_room(1, points_per_frame=4000, seed=1)[0].cloud
    sources = [source.cloud.transform(away), other, np.random.default_rng(0).normal(size=(10, 3))]
    options = {"init": "global", "max_distance": 0.5}
    with pytest.warns(mcg.PairWarning) as caught:
        right, unsure, lost = mcg.register_batch(sources, target.cloud, mcg.GICP(), search=search, **options)
    messages = sorted(str(warning.message).split(" (")[0].split(",")[0] for warning in caught)
    assert messages == ["pair 1: global pose: too little evidence", "pair 2: global pose: none found"]
    truth = np.linalg.inv(target.pose) @ source.pose @ np.linalg.inv(away)
    assert right.converged and pose_error(right.matrix, truth)[0] < 0.05
    assert unsure.status is Status.UNVERIFIED and not unsure.converged and np.isfinite(unsure.matrix).all()
    assert lost.status is Status.TOO_FEW_CORRESPONDENCES and np.isnan(lost.matrix[:3]).all()
    if search is None:
        alone = mcg.register(*map(mcg.preprocess, (sources[0], target.cloud)), mcg.GICP(), **options)
        np.testing.assert_array_equal(right.matrix, alone.matrix)
    with pytest.warns(mcg.PairWarning, match="pair 0: init: "):
        mcg.register_batch(sources[:1], target.cloud, mcg.GICP(), init=["local"])


def test_inside_transformations_a_batch_says_what_to_use(raw):
    (source,), targets = prepared(raw[:1])

    def cost(channels):
        return batch([source.replace(channels=channels)], targets)[0].cost

    for transformed in (jax.jit(cost), jax.jit(jax.grad(cost)), lambda channels: jax.vmap(cost)(channels[None])):
        refused(lambda transformed=transformed: transformed(np.asarray(source.channels)), "sources, targets")
