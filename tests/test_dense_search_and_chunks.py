"""Brute force on the device: the tree's answers, and a whole batch as one program, on one device or several."""

import itertools
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mcgicp_jax as mcg
from mcgicp_jax import DenseSearch, KDTreeSearch, Status
from mcgicp_jax._pairs import batch_jobs
from mcgicp_jax._pairs.batch_jobs import BatchJob
from mcgicp_jax._registration import chunks, start_check
from mcgicp_jax.extend import SearchPoints
from mcgicp_jax.metrics import pose_error
from tests import reference as ref
from tests.batches import METHOD, assert_same
from tests.compilations import compilations
from tests.precision import in_both_precisions
from tests.promise_scenes import office, views
from tests.scenes import motion

# Its parameters are computed for each pair.
UNSET = mcg.MultiChannelGICP()


def rows(points, descriptors=None, valid=None, penalty=None):
    descriptors = np.zeros((len(points), 0)) if descriptors is None else descriptors
    valid = np.ones(len(points), bool) if valid is None else valid
    arrays = (np.asarray(array, np.float32) for array in (points, descriptors))
    return SearchPoints(*arrays, valid, None if penalty is None else np.asarray(penalty, np.float32))


def query(search, source, target, num_candidates=1):
    identity = np.array([1, 0, 0, 0, 0, 0, 0], np.float32)
    return np.asarray(search.index(target).nearest(identity, source, np.inf, num_candidates))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), high=st.integers(2, 6), num_channels=st.sampled_from([0, 2]))
def test_ties_are_ordered_by_row(seed, high, num_channels):
    """Few integer coordinates: most distances are shared, and many points coincide."""
    rng = np.random.default_rng(seed)
    points, channels = rng.integers(0, high, (50, 3)), rng.integers(0, 3, (50, num_channels))
    everything = np.hstack([points, channels]).astype(float)
    nearest = query(DenseSearch(), rows(points[:40], channels[:40]), rows(points, channels), 7)
    np.testing.assert_array_equal(nearest.T, ref.nearest(everything[:40], everything, 7))


def test_neighbors_far_from_the_origin_lose_nothing():
    """As a product of matrices the distances would be nothing but rounding here."""
    points = np.random.default_rng(0).random((300, 3)).astype(np.float32) + np.float32(3000)
    np.testing.assert_array_equal(DenseSearch().neighbors(points, 5), KDTreeSearch().neighbors(points, 5))


@pytest.mark.parametrize("lacking", [(True, False), (False, True), (True, True)])
def test_channels_that_are_not_there_add_what_they_would_on_average(lacking):
    rng, penalty, clouds, plain, masks = np.random.default_rng(0), np.array([0.02, 0.1]), [], [], []
    for size, lacks in zip((40, 50), lacking, strict=True):
        points, channels, missing = rng.random((size, 3)), rng.random((size, 2)), rng.random((size, 2)) < 0.5
        missing &= lacks
        clouds.append(rows(points, channels, penalty=np.where(missing, penalty, 0) if lacks else None))
        plain.append(np.hstack([points, channels]))
        masks.append(~missing)
    expected = ref.match_partial(*plain, *masks, penalty, 3)
    np.testing.assert_array_equal(query(DenseSearch(), *clouds, 3).T, expected)


def test_padding_and_what_is_not_finite_match_nothing():
    """And they hide no others."""
    points, valid = np.random.default_rng(0).random((1000, 3)), np.arange(1000) < 900
    source, target = points.copy(), points.copy()
    source[3], target[7], target[500] = np.nan, np.inf, np.nan
    usual = np.setdiff1d(np.arange(900), [7, 500])
    nearest = query(DenseSearch(), rows(source, valid=valid), rows(target, valid=valid), 5)
    assert (nearest[:, 3] == -1).all() and (nearest[:, 900:] == -1).all()
    expected = usual[query(DenseSearch(), rows(points), rows(points[usual]), 5)]
    np.testing.assert_array_equal(np.delete(nearest[:, :900], 3, axis=1), np.delete(expected[:, :900], 3, axis=1))
    assert (query(DenseSearch(), rows(source), rows(target, valid=np.zeros(1000, bool))) == -1).all()


@pytest.mark.parametrize("num_candidates", [1, 20])
def test_no_table_of_pairs_is_stored(num_candidates):
    """In lanes, each of which has a table."""

    def nearest(pose, cloud):
        return DenseSearch().nearest_traced(pose, cloud, cloud, jnp.float32(1), jnp.array(True), num_candidates)

    # For several candidates, the distances of some queries to parts of the target are, however large it is.
    size = 2000 if num_candidates == 1 else 20_000
    cloud = rows(np.zeros((3, size, 3)), np.zeros((3, size, 2)), np.ones((3, size), bool))
    lowered = jax.jit(jax.vmap(nearest)).lower(np.zeros((3, 7), np.float32), cloud)
    # A sixteenth of a table is stored, the nearest rows of runs, where the compiler does not fuse it.
    assert lowered.compile().memory_analysis().temp_size_in_bytes < 0.1 * 4 * size**2 * 3


@pytest.fixture(scope="module")
def clouds(raw):
    """With fewer neighbours than raw clouds get, which shows where given ones are lost."""
    return [[mcg.preprocess(pair[side], None, num_neighbors=15) for pair in raw] for side in (0, 1)]


def test_preprocess_and_register_agree_with_the_tree(raw):
    results = []
    for search in (KDTreeSearch(), DenseSearch()):
        source, target = (mcg.preprocess(cloud, search=search) for cloud in raw[0][:2])
        results.append(mcg.register(source, target, METHOD, max_distance=0.5, search=search))
    assert max(pose_error(results[0].matrix, results[1].matrix)) < 1e-5
    assert results[0].num_inliers == results[1].num_inliers


def in_chunks(sources, targets, **options):
    return mcg.register_batch(sources, targets, UNSET, max_distance=0.5, search=DenseSearch(), **options)


@pytest.mark.slow
def test_a_batch_in_chunks_is_its_pairs(raw, clouds):
    """Of two shapes, the pairs of one of which fill more than one chunk."""
    results = in_chunks(*clouds)
    for result, *pair in zip(results, *clouds, strict=True):
        alone = mcg.register(*pair, UNSET, max_distance=0.5, max_iterations=64)
        assert result.status is alone.status and list(result.history) == list(alone.history)
        if alone.converged:
            assert max(pose_error(result.matrix, alone.matrix)) < 1e-5
            assert result.num_iterations == alone.num_iterations
            np.testing.assert_allclose(result.history["cost"], alone.history["cost"], rtol=1e-3)
            np.testing.assert_allclose(result.information, alone.information, rtol=1e-2, atol=1)
    # In another order, and without one of the others. Where a large pair comes first, smaller ones have more padding.
    order = sorted(np.random.default_rng(0).permutation(len(raw))[1:], key=lambda i: len(clouds[0][i]) > 400)
    assert_same(in_chunks(*([side[i] for i in order] for side in clouds)), [results[i] for i in order])
    order.reverse()
    for i, again in zip(order, in_chunks(*([side[i] for i in order] for side in clouds)), strict=True):
        assert again.status is results[i].status and max(pose_error(again.matrix, results[i].matrix)) < 1e-6


@pytest.mark.slow
def test_raw_clouds_in_chunks_are_prepared_as_one_by_one(raw, monkeypatch):
    """Neighbours, surfaces and parameters are computed on the device, by one program for pairs that fill at least half
    of the size of the first. A pair without enough points does no harm."""
    shapes, program = set(), chunks._registered

    def noted(chunk, *arguments, **named):
        shapes.update((chunk.source.valid.shape[1], chunk.target.valid.shape[1]))
        return program(chunk, *arguments, **named)

    monkeypatch.setattr(chunks, "_registered", noted)
    sources, targets = (
        [raw[2][side].replace_rows(valid=np.arange(len(raw[2][side])) < size).unpad() for size in (490, 400, 260, 310)]
        for side in (0, 1)
    )
    sources[1] = np.zeros((3, 3))
    targets[2] = targets[2].replace(points=np.where(np.arange(260)[:, None] % 10, targets[2].points, np.nan))
    with pytest.warns(mcg.PairWarning, match="pair 1"), ThreadPoolExecutor(1) as executor:
        results = in_chunks(sources, targets, covariances=False)
        expected = in_chunks(sources, targets, executor=executor)
    assert shapes == {512}
    for i, (result, alone) in enumerate(zip(results, expected, strict=True)):
        assert result.status is alone.status and result.converged is (i != 1)
        if result.converged:
            assert max(pose_error(result.matrix, alone.matrix)) < 1e-5 and result.overlap == alone.overlap
            assert np.isnan(result.covariance).all() and np.isfinite(alone.covariance).all()


@pytest.mark.slow
def test_pairs_that_may_have_left_a_right_pose_are_registered_again(monkeypatch):
    """Parts of rooms whose coarse phase leaves it, views with too little in common for a promise, and a whole room that
    is hardly moved."""
    pairs = [office(0, 500), office(2, 500), views(2, count=500), office(0, 500, common=1)]
    sources, targets, _ = map(list, zip(*pairs, strict=True))
    starts = [None, None, pairs[2].T_target_source, motion((0.06, -0.04, 0.02, 0.02, 0.01, 0.02))]
    doubt_of_start, register_prepared = chunks.doubt_of_start, BatchJob._register_prepared
    on_host, traced, again = [], [], []

    def noted(fits, start, state, settings, fit, at_scales=False):
        fits.append(fit())
        return doubt_of_start(start, state, settings, lambda: fits[-1], at_scales)

    def counted(job, pair):
        again.append(pair.index)
        return register_prepared(job, pair)

    def batch(rows):
        given = ([side[i] for i in rows] for side in (sources, targets))
        return mcg.register_batch(*given, mcg.GICP(), init=[starts[i] for i in rows], search=DenseSearch())

    with monkeypatch.context() as patched:
        patched.setattr(start_check, "doubt_of_start", partial(noted, on_host))
        cases = zip(sources, targets, starts, strict=True)
        expected = [mcg.register(source, target, mcg.GICP(), init=start) for source, target, start in cases]
    monkeypatch.setattr(chunks, "doubt_of_start", partial(noted, traced))
    monkeypatch.setattr(BatchJob, "_register_prepared", counted)
    results = batch(range(4))
    assert [result.status.name for result in results] == ["CONVERGED", "CONVERGED", "UNVERIFIED", "CONVERGED"]
    assert sorted(again) == [0, 1, 2]
    assert_same([result.T_target_source for result in results[:3]], [each.T_target_source for each in expected[:3]])
    assert max(pose_error(results[3].matrix, expected[3].matrix)) < 1e-5
    np.testing.assert_allclose(sorted(traced), sorted(on_host), rtol=1e-3)
    assert_same(batch([3, 1]), [results[3], results[1]])


def test_pairs_of_shapes_that_the_method_refuses(raw):
    sides = [[pair[side] for pair in raw[:2]] for side in (0, 1)]
    method = mcg.MultiChannelGICP(0.05, [0.1, 0.2, 0.3])
    with pytest.warns(mcg.PairWarning, match="pair [01]: channel_weights: "):
        results = mcg.register_batch(*sides, method, max_distance=0.5, search=DenseSearch())
    assert [result.status for result in results] == [Status.INVALID_INPUT] * 2


@pytest.mark.slow
def test_pairs_of_many_updates_leave_their_chunk_and_lose_nothing(clouds, monkeypatch):
    expected = in_chunks(*clouds)
    updates = sorted(int(result.num_iterations) for result in expected)
    monkeypatch.setattr(chunks, "_FIRST_UPDATES", updates[len(updates) // 2])
    with compilations() as found:
        assert_same(in_chunks(*clouds), expected)
    assert not found


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:channel channel_0")
@pytest.mark.parametrize("num_checked", [8, 0])
def test_given_neighbours_stay_where_a_channel_is_left_out(raw, num_checked, monkeypatch):
    """Its first channel moves with the sensor: `register` works on copies of the clouds. Of the first pairs the host
    finds out, and warns; of others the program does."""
    monkeypatch.setattr(batch_jobs, "NUM_CHECKED", num_checked)
    sides = []
    for cloud in raw[0][:2]:
        points = np.asarray(cloud.points) - np.array([0.7, 0.8, 0.9])
        channels = np.column_stack([np.linalg.norm(points, axis=1), cloud.channels[:, 0]])
        sides.append([mcg.preprocess(mcg.PointCloud(points, channels), None, num_neighbors=15)])
    (result,), (expected,) = in_chunks(*sides), in_chunks(*sides, executor="threads")
    assert result.status is expected.status and result.overlap == expected.overlap
    assert max(pose_error(result.matrix, expected.matrix)) < 1e-5


@pytest.mark.slow
def test_units_are_warned_of_in_chunks_too(raw):
    source, target, _ = raw[0]
    source = mcg.PointCloud(source.points, covariances=np.tile(1e-3 * np.eye(3), (len(source), 1, 1)))
    with pytest.warns(UserWarning, match="covariances look like m²"):
        mcg.register_batch([source], [target], mcg.GICP(), max_distance=0.5, search=DenseSearch())


@pytest.mark.slow
def test_a_stream_yields_invalid_pairs_and_those_of_many_updates_on_the_way(clouds, monkeypatch):
    sources, targets = ([side[1]] * 63 for side in clouds)
    sources[2] = np.zeros((3, 3))
    starts = [motion((0.2, -0.2, 0.1, 0.05, 0, 0.1)), *[None] * 62]
    slow, usual = in_chunks(sources[:2], targets[:2], init=starts[:2])
    assert slow.num_iterations > usual.num_iterations
    monkeypatch.setattr(chunks, "_FIRST_UPDATES", int(slow.num_iterations))
    monkeypatch.setattr(chunks, "_MANY", 1)
    monkeypatch.setattr(chunks, "_CHUNKS_BETWEEN", 2)
    options = {"init": starts, "max_distance": 0.5, "search": DenseSearch()}
    with pytest.warns(mcg.PairWarning, match="pair 2"):
        ended = dict(mcg.register_as_completed(sources, targets, UNSET, **options))
    assert sorted(ended) == list(range(63))
    assert_same([ended[0]], [slow])
    assert max(list(ended).index(number) for number in (0, 2)) < 40


@pytest.mark.slow
def test_pairs_that_nobody_waits_for_are_not_prepared(clouds, monkeypatch):
    prepared_pair, indices = BatchJob._chunk_pair, []

    def slowly(job, pair):
        indices.append(pair.index)
        time.sleep(0.02)
        return prepared_pair(job, pair)

    monkeypatch.setattr(BatchJob, "_chunk_pair", slowly)
    endless = (itertools.repeat(side[0]) for side in clouds)
    completed = mcg.register_as_completed(*endless, UNSET, max_distance=0.5, search=DenseSearch())
    next(completed)
    count = len(indices)
    completed.close()
    # Some may begin meanwhile, but not all that wait.
    assert len(indices) < count + 50


@pytest.mark.slow
def test_a_rare_size_does_not_wait_for_the_end(clouds, monkeypatch):
    monkeypatch.setattr(chunks, "_PATIENCE", 2)
    # 490 points fill the larger size class, the others the smaller, whose pairs do not come first: they would join.
    rare, usual = 2, [0, 1, 3, 5] * 3
    order = [usual[0], rare, *usual[1:]]

    def ended():
        completed = mcg.register_as_completed(
            *([side[i] for i in order] for side in clouds), UNSET, max_distance=0.5, search=DenseSearch()
        )
        return [number for number, _ in completed]

    first = ended()
    assert sorted(first) == list(range(len(order)))
    assert first.index(1) < len(order) - 4
    # Another batch uses the programs of the first.
    with compilations() as found:
        assert ended() == first
    assert not found


@in_both_precisions
@pytest.mark.parametrize("size", [1500, 2990])
def test_several_neighbours_are_those_of_trees(size):
    """More than 2,560 points are sought in two steps."""
    points = np.random.default_rng(0).normal(size=(size, 3)).astype(float if jax.enable_x64.value else np.float32)
    np.testing.assert_array_equal(DenseSearch().neighbors(points, 20), KDTreeSearch().neighbors(points, 20))


@pytest.mark.parametrize("num_candidates", [1, 3])
def test_no_row_finds_nothing(num_candidates):
    nothing, here = rows(np.zeros((0, 3))), jnp.array([1, 0, 0, 0, 0, 0, 0], jnp.float32)
    arguments = here, nothing, rows(np.zeros((20, 3))), jnp.float32(1), jnp.array(True), num_candidates
    assert DenseSearch().nearest_traced(*arguments).shape == (num_candidates, 0)
