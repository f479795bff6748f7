"""Nearest neighbours against brute force: ties, padding, channels, the gate."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import mcgicp_jax as mcg
from mcgicp_jax import (
    ColorICP,
    KDTreeSearch,
    MultiChannelGICP,
    PointCloud,
    PointToPoint,
    find_correspondences,
    preprocess,
)
from mcgicp_jax.extend import SearchPoints
from tests import reference as ref
from tests.precision import tolerance
from tests.refusals import refused

T = ref.pose([0.1, -0.2, 0.3], [0.05, 0.1, -0.02])


def clouds(num_channels=3):
    pair = [ref.scene(size, num_channels, seed) for seed, size in enumerate((150, 140))]
    return [preprocess(PointCloud(*arrays), num_neighbors=4) for arrays in pair], pair


def integers(shape, high, seed):
    return np.random.default_rng(seed).integers(0, high, shape).astype(float)


def search_points(points, descriptors=None):
    """All rows valid."""
    descriptors = np.zeros((len(points), 0)) if descriptors is None else descriptors
    return SearchPoints(points, descriptors, np.ones(len(points), bool))


def query(pose, source, target, num_candidates=1):
    parameters = np.concatenate([Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]], pose[:3, 3]])
    return KDTreeSearch().index(target).nearest(parameters, source, np.inf, num_candidates)


@settings(max_examples=50, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    k=st.integers(1, 25),
    num_points=st.integers(4, 80),
    high=st.sampled_from([None, 2, 3, 5]),
)
def test_neighbors_by_brute_force(seed, k, num_points, high):
    """Of random points, and of few integers: there most distances are shared, and many points coincide."""
    points = np.random.default_rng(seed).normal(size=(num_points, 3)) if high is None else integers((80, 3), high, seed)
    np.testing.assert_array_equal(KDTreeSearch().neighbors(points, k), ref.nearest(points, points, k))


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**31), k=st.integers(1, 25))
def test_many_equal_distances(seed, k):
    """Zeros for what a sensor did not see, and a sphere about one point: more than any lattice has."""
    rng = np.random.default_rng(seed)
    sphere = np.array([x for x in np.ndindex(21, 21, 21) if np.sum((np.array(x) - 10) ** 2) == 81]) - 10.0
    points = rng.permutation(np.concatenate([np.zeros((300, 3)), sphere, rng.integers(-2, 3, (40, 3))]))
    # In float32, too, and where the distances of the tie are not whole numbers.
    tilted = (points @ Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix() + [0.1, 0.2, 0.3]).astype(np.float32)
    for cloud in (points, np.concatenate([tilted, np.zeros((300, 3), np.float32)])):
        np.testing.assert_array_equal(KDTreeSearch().neighbors(cloud, k), ref.nearest(cloud, cloud, k))
    queries = np.concatenate([np.zeros((5, 3)), points[np.any(points, axis=1)][:20]])
    nearest = query(np.eye(4), search_points(queries), search_points(sphere), k)
    np.testing.assert_array_equal(nearest.T, ref.nearest(queries, sphere, k))


@pytest.mark.parametrize("k", [5, 40])
def test_trees_hold_few_of_many_equal_points(k, monkeypatch):
    """A leaf of n equal points, each of which asks for its neighbours, would cost n²."""
    built, build = [], KDTreeSearch.build
    monkeypatch.setattr(KDTreeSearch, "build", lambda self, points: built.append(len(points)) or build(self, points))
    points = np.random.default_rng(0).normal(size=(300, 3))
    points[::2] = [-0.0, 0.0, 1.0]
    points[::4] = [0.0, 0.0, 1.0]
    np.testing.assert_array_equal(KDTreeSearch().neighbors(points, k), ref.nearest(points, points, k))
    assert built[-1] == 150 + max(32, k + 1)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**31), high=st.integers(2, 6), num_channels=st.integers(0, 3), k=st.sampled_from([1, 2, 7, 60])
)
def test_nearest_with_ties_in_position_and_channels(seed, high, num_channels, k):
    """Candidates by distance and row; −1 where the target has no more points."""
    source, target = integers((40, 3), high, seed), integers((50, 3), high, seed + 1)
    channels = integers((40, num_channels), 3, seed + 2), integers((50, num_channels), 3, seed + 3)
    half_turn = np.diag([-1.0, -1, 1, 1])
    half_turn[:3, 3] = [high - 1, high - 1, 0]
    moved = source @ half_turn[:3, :3].T + half_turn[:3, 3]
    expected = ref.nearest(np.hstack([moved, channels[0]]), np.hstack([target, channels[1]]), k)
    nearest = query(half_turn, search_points(source, channels[0]), search_points(target, channels[1]), k)
    np.testing.assert_array_equal(nearest.T, expected)


def shifted(metres):
    """A pose as quaternion and translation, along x."""
    return np.array([1.0, 0, 0, 0, metres, 0, 0])


STILL = shifted(0)


def rows_with_missing_channels(seed, sizes, high, squares, share):
    """Integers everywhere, hence with ties: as plain rows with their masks, and as what is searched."""
    rows = [integers((size, 3 + len(squares)), high, seed + i) for i, size in enumerate(sizes)]
    masks = np.split(np.random.default_rng(seed).random((sum(sizes), len(squares))) < share, [sizes[0]])
    searched = [
        SearchPoints(row[:, :3], np.where(mask, row[:, 3:], 0), np.ones(len(row), bool), np.where(mask, 0, squares))
        for row, mask in zip(rows, masks, strict=True)
    ]
    return [*rows, *masks], searched


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), share=st.floats(0, 1), k=st.sampled_from([1, 3]), missing=st.integers(1, 4))
def test_nearest_with_missing_channels(seed, share, k, missing):
    squares = np.array([float(missing), 2.0])
    plain, (source, target) = rows_with_missing_channels(seed, (40, 50), 4, squares, share)
    nearest = KDTreeSearch().index(target).nearest(STILL, source, np.inf, k)
    np.testing.assert_array_equal(nearest.T, ref.match_partial(*plain, squares, k))
    # One of the two clouds may lack nothing.
    whole = target._replace(penalty=None)
    plain[1], plain[3] = np.hstack([whole.points, whole.descriptors]), True
    nearest = KDTreeSearch().index(whole).nearest(STILL, source, np.inf, k)
    np.testing.assert_array_equal(nearest.T, ref.match_partial(*plain, squares, k))


@pytest.mark.parametrize("k", [1, 3])
def test_many_sets_of_missing_channels(k):
    """Five channels, each there or not at random, hence more sets than have their trees kept."""
    squares = np.arange(1.0, 6.0)
    plain, (source, target) = rows_with_missing_channels(0, (80, 200), 50, squares, 0.6)
    index = KDTreeSearch().index(target)
    np.testing.assert_array_equal(index.nearest(STILL, source, np.inf, k).T, ref.match_partial(*plain, squares, k))
    # From pose to pose, too, where what is known from the pose before is used.
    follow = index.follow(source, np.inf, k)
    for pose in map(shifted, 0.3 * np.arange(5)):
        # Several are found in any order.
        rows = [np.sort(nearest, axis=0) for nearest in (follow(pose), index.nearest(pose, source, np.inf, k))]
        np.testing.assert_array_equal(*rows)


@pytest.mark.parametrize(
    "method",
    [ColorICP([0.1, 0.0, 2.0]), MultiChannelGICP([0.1, 0.2, 0.3], 0.3), MultiChannelGICP(0.2 * np.eye(3) + 0.1, 0.3)],
    ids=["ColorICP", "variances", "full"],
)
def test_missing_channels_count_as_in_a_true_match(method):
    """A camera sees some of the points: channel 0 is everywhere, the others come and go together."""
    _, pair = clouds()
    (a, ca), (b, cb) = pair
    masks = [np.random.default_rng(i).random((len(points), 1)) < [1, 0.5, 0.5] for i, (points, _) in enumerate(pair)]
    source, target = (
        preprocess(PointCloud(*arrays, channel_valid=mask), num_neighbors=4)
        for arrays, mask in zip(pair, masks, strict=True)
    )
    resolved = method.resolve(source, target)
    variance = resolved.missing_variance if isinstance(method, ColorICP) else resolved.channel_covariance
    variance = np.diag(variance) if np.ndim(variance) == 2 else np.asarray(variance)
    weights = np.asarray(resolved.channel_weights)
    rows = np.hstack([a @ T[:3, :3].T + T[:3, 3], weights * ca]), np.hstack([b, weights * cb])
    expected = ref.match_partial(*rows, *masks, weights**2 * variance)[:, 0]
    found = find_correspondences(source, target, T, method, max_distance=np.inf)
    np.testing.assert_array_equal(np.asarray(found.indices)[:150], expected)


@pytest.mark.parametrize("max_distance", [0.05, 0.2, np.inf])
@pytest.mark.parametrize("weights", [None, 0.3, np.array([0.1, 0.0, 2.0])], ids=str)
def test_correspondences_against_the_reference(weights, max_distance):
    """Only the position turns; channels take part in the search, if the method uses them, and not in the gate."""
    (source, target), ((a, ca), (b, cb)) = clouds()
    method = PointToPoint() if weights is None else ColorICP(weights)
    found = find_correspondences(source, target, T, method, max_distance=max_distance)
    expected = ref.match(a, b, T, max_distance, *(() if weights is None else (ca, cb, weights)))
    valid = np.asarray(found.valid)[:150]
    np.testing.assert_array_equal(np.where(valid, found.indices[:150], -1), expected)
    distances = np.linalg.norm(b[expected] - a @ T[:3, :3].T - T[:3, 3], axis=1)[valid]
    np.testing.assert_allclose(np.asarray(found.distances)[:150][valid], distances, atol=tolerance(1e-6, 1e-12))


def test_padding_is_never_matched():
    """Here, padding of the target lies at the origin, right on top of the source."""
    points, channels = ref.scene(140, 3)
    target = preprocess(PointCloud(points + np.array([3.0, 0, 0]), channels), num_neighbors=4).pad(160)
    target = target.replace(points=np.where(target.valid[:, None], target.points, 0))
    source = preprocess(PointCloud(0.01 * points[:100], channels[:100]), num_neighbors=4).pad(160)
    for method in (PointToPoint(), ColorICP(0.1)):
        found = find_correspondences(source, target, None, method, max_distance=10.0)
        assert np.asarray(found.indices)[:100].max() < 140
        np.testing.assert_array_equal(found.valid, np.arange(160) < 100)


@pytest.mark.parametrize("empty", [("source",), ("target",), ("source", "target")])
def test_a_cloud_without_valid_rows_has_no_matches(empty):
    pair = dict(zip(("source", "target"), clouds()[0], strict=True))
    pair |= {name: pair[name].replace(valid=np.zeros_like(pair[name].valid)) for name in empty}
    for method in (PointToPoint(), ColorICP(0.1)):
        assert not np.any(find_correspondences(*pair.values(), T, method, max_distance=1.0).valid)


@pytest.mark.parametrize("what", ["points", "channels"])
@pytest.mark.parametrize("which", ["source", "target"])
def test_values_that_are_not_finite_match_nothing(which, what):
    """As when a network returns NaN: a status reports it, not an exception from inside the tree."""
    pair = dict(zip(("source", "target"), clouds()[0], strict=True))
    array = np.array(getattr(pair[which], what))
    array[3, 1] = np.nan
    pair[which] = pair[which].replace(**{what: array})
    found = find_correspondences(*pair.values(), T, ColorICP(0.3), max_distance=1.0)
    rows = np.flatnonzero(found.valid)
    assert 3 not in (rows if which == "source" else np.asarray(found.indices)[rows]) and len(rows) > 50


def test_invalid_arguments_are_named():
    (source, target), (_, single) = clouds()[0], clouds(1)[0]
    for gate in (0, -1.0, np.nan, np.ones(2)):
        refused(lambda g=gate: find_correspondences(source, target, T, PointToPoint(), max_distance=g), "max_distance")
    refused(lambda: find_correspondences(source, single, T, ColorICP(0.1), max_distance=1.0), "channels", "3 and 1")
    find_correspondences(source, single, T, PointToPoint(), max_distance=1.0)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    step=st.sampled_from([0.0, 1e-4, 0.01, 0.3]),
    num_channels=st.sampled_from([0, 2]),
    max_distance=st.sampled_from([0.2, 0.5]),
    lacking=st.booleans(),
    k=st.sampled_from([1, 3, 60]),
)
def test_matches_that_are_followed_are_those_found_anew(seed, step, num_channels, max_distance, lacking, k):
    """At every pose of a walk, of small steps and large, ties and points without a match among them."""
    rng = np.random.default_rng(seed)
    clouds = []
    for size in (60, 50):
        points = np.where(rng.random((size, 1)) < 0.5, rng.random((size, 3)), rng.integers(0, 3, (size, 3)) / 2)
        valid = rng.random(size) < 0.9
        channels = rng.integers(0, 2, (size, num_channels)) * 0.1
        penalty = 0.01 * (rng.random(channels.shape) < 0.3) if lacking else None
        clouds.append(SearchPoints(points, channels, valid, penalty))
    index = KDTreeSearch().index(clouds[1])
    nearest = index.follow(clouds[0], max_distance, k)
    pose = STILL
    for _ in range(8):
        moved = clouds[0].points @ Rotation.from_quat(pose[[1, 2, 3, 0]]).as_matrix().T + pose[4:]
        # Several are found in any order. Beyond the gate there may be a match or none.
        expected, found = (
            np.sort(np.where(np.linalg.norm(moved - clouds[1].points[rows], axis=-1) <= max_distance, rows, -1), axis=0)
            for rows in (index.nearest(pose, clouds[0], max_distance, k), nearest(pose))
        )
        np.testing.assert_array_equal(found, expected)
        pose = pose + step * rng.normal(size=7) * [0.1, 0.1, 0.1, 0.1, 1, 1, 1]
        pose[:4] /= np.linalg.norm(pose[:4])


def test_a_pose_that_is_not_finite_matches_nothing():
    nearest = KDTreeSearch().index(search_points(ref.scene(140)[0])).follow(search_points(ref.scene(150)[0]), 1.0, 2)
    assert (nearest(np.full(7, np.nan)) == -1).all()
    assert (nearest(shifted(np.inf)) == -1).all()
    assert (nearest(STILL) >= 0).any(axis=1).all()


@pytest.mark.slow
def test_lanes_that_have_ended_are_not_searched():
    """In a batched loop the body runs for them, too."""
    (source, target), _ = clouds()
    poses = np.stack([np.eye(4), ref.pose([0.08, -0.05, 0.1], [0.02, 0.05, -0.03])]).astype(source.points.dtype)
    asked = []

    class Counted(KDTreeSearch):
        def query(self, *arguments):
            asked.append(1)
            return super().query(*arguments)

    def register(init):
        options = {"max_distance": 0.3, "max_iterations": 30, "search": Counted(workers=1)}
        return mcg.register(source, target, PointToPoint(), init=init, **options).num_iterations

    single, alone = [int(jax.jit(register)(pose)) for pose in poses], len(asked)
    assert abs(single[0] - single[1]) > 1
    assert list(jax.block_until_ready(jax.jit(jax.vmap(register))(poses))) == single
    assert len(asked) == 2 * alone
