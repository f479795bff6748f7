"""Poses from any start: features against plain loops, poses against SciPy, honest verdicts, and no compilations."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import mcgicp_jax as mcg
from mcgicp_jax import datasets
from mcgicp_jax.__main__ import main
from mcgicp_jax._global_pose import features
from mcgicp_jax._global_pose.global_pose import Candidate
from mcgicp_jax._global_pose.robust_pose_fit import NUM_MATCHES, PutativeMatches, _support, fit_pose, hypotheses
from mcgicp_jax.datasets._raycast import Box, Cylinder, cast
from mcgicp_jax.metrics import pose_error
from tests.compilations import compilations
from tests.promise_scenes import NOISE, office, rects
from tests.promise_scenes import box as furniture
from tests.refusals import refused
from tests.scenes import room_corner, wall

VOXEL = 0.2


def anywhere(seed=0, distance=10.0):
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    pose[:3, 3] = distance * rng.normal(size=3)
    return pose


def rooms(first=0, second=2, seed=0):
    """Two frames of a simulated room, the source moved far away, and the true pose."""
    frames = datasets.box_room(3, points_per_frame=3000, seed=0)
    away = anywhere(seed)
    truth = np.linalg.inv(frames[first].pose) @ frames[second].pose @ np.linalg.inv(away)
    return frames[second].cloud.transform(away), frames[first].cloud, truth


def bare(cloud):
    return mcg.PointCloud(cloud.points)


def strangers(count):
    """Clouds of two rooms without channels, the source moved far away."""
    source, target = (datasets.box_room(3, points_per_frame=count, seed=seed)[0].cloud for seed in (0, 1))
    return bare(source.transform(anywhere())), bare(target)


def found(result, truth, source):
    translation, rotation = pose_error(result.matrix, truth, at=np.mean(source.coordinates, axis=0))
    return translation < 0.05 and rotation < 0.01


# Features


@pytest.fixture(scope="module")
def small():
    points, channels = room_corner(200, noise=0.02, seed=3)
    cloud = mcg.preprocess(mcg.PointCloud(points, channels), num_neighbors=50)
    return cloud, features.normals_of(cloud, VOXEL)


def angles(p, n, q, m):
    """Rusu's α, φ, θ (k, 3) of a point and k others, with the point whose normal is closer to the line first."""
    m = np.where((m @ n < 0)[:, None], -m, m)
    d = (q - p) / np.linalg.norm(q - p, axis=1, keepdims=True)
    swapped = (np.abs(d @ n) < np.abs(np.sum(m * d, axis=1)))[:, None]
    n, m, d = np.where(swapped, m, n), np.where(swapped, n, m), np.where(swapped, -d, d)
    v = np.cross(d, n)
    length = np.linalg.norm(v, axis=1)
    n, m, d, v = (each[length > 1e-6] for each in (n, m, d, v / np.maximum(length, 1e-9)[:, None]))
    alpha, phi, x, y = (np.sum(a * b, axis=1) for a, b in ((v, m), (n, d), (n, m), (np.cross(n, v), m)))
    return np.stack([alpha, phi, np.arctan2(y, x)], axis=1)


def test_histograms_are_those_of_their_definition(small):
    cloud, normals = small
    points = np.asarray(cloud.points, float)
    near = [
        [j for j in rows if 0 < np.linalg.norm(points[j] - points[i]) <= 5 * VOXEL]
        for i, rows in enumerate(cloud.neighbors)
    ]
    simple = np.zeros((len(points), 3, 11))
    for i, rows in enumerate(near):
        measured = angles(points[i], normals[i], points[rows], normals[rows])
        for sign in (1, -1):
            parts = (measured * [1, sign, sign] + [1, 1, np.pi / 2]) / [2, 2, np.pi]
            for axis in range(3):
                np.add.at(simple[i, axis], np.minimum(11 * parts[:, axis], 10).astype(int), 0.5 / len(measured))
    expected = simple.copy()
    for i, rows in enumerate(near):
        if rows:
            weights = 1 / np.sum((points[rows] - points[i]) ** 2, axis=1)
            expected[i] += np.tensordot(weights / weights.sum(), simple[rows], axes=1)
    made = features.histograms_of(cloud, normals, VOXEL).reshape(-1, 3, 11)
    np.testing.assert_allclose(made.sum(axis=2), expected.sum(axis=2), atol=1e-5)
    # Angles at the edge of two bins may fall into either one.
    assert np.quantile(np.abs(made - expected).max(axis=(1, 2)), 0.7) < 1e-5
    assert np.abs(made - expected).max() < 0.2


def test_normals_are_those_of_the_neighbours(small):
    cloud, normals = small
    points = np.asarray(cloud.points, float)
    for i in range(0, len(points), 7):
        near = points[np.linalg.norm(points - points[i], axis=1) <= 2 * VOXEL]
        values, vectors = np.linalg.eigh(np.cov(near.T, bias=True)) if len(near) > 5 else (None, None)
        if values is not None and values[1] > 3 * values[0]:
            assert abs(vectors[:, 0] @ normals[i]) > 0.999


def test_statistics_are_those_of_the_neighbours_that_have_the_channel(small):
    cloud, _ = small
    valid = np.random.default_rng(0).random(cloud.channels.shape) < 0.7
    cloud = cloud.replace(channel_valid=valid)
    made = features.statistics_of(cloud, VOXEL)
    points = np.asarray(cloud.points, float)
    for i in range(0, len(points), 5):
        expected = []
        for channel in range(2):
            for radius in (1.5, 3.0, 5.0):
                near = np.linalg.norm(points - points[i], axis=1) <= radius * VOXEL
                near[np.setdiff1d(np.arange(len(points)), cloud.neighbors[i])] = False
                values = np.asarray(cloud.channels)[near & valid[:, channel], channel]
                expected += [values.mean(), values.std()] if valid[i, channel] else [np.nan] * 2
        np.testing.assert_allclose(made[i], expected, atol=1e-4)


def test_mutual_neighbours_are_those_of_a_tree():
    rng = np.random.default_rng(0)
    source, target = (rng.integers(-127, 128, (size, 6)).astype(np.float32) for size in (5000, 6000))
    rows, matched = features.mutual_nearest(source, target, 5000)
    (distances, nearest), (back, row) = cKDTree(target).query(source, 2), cKDTree(source).query(target)
    # Of rows at the same distance, the tree may find another one.
    matched_distances = np.linalg.norm(source[rows].astype(float) - target[matched], axis=1)
    np.testing.assert_allclose(matched_distances, distances[rows, 0], rtol=1e-12)
    np.testing.assert_allclose(matched_distances, back[matched], rtol=1e-12)
    expected = np.flatnonzero(row[nearest[:, 0]] == np.arange(5000))
    assert len(np.intersect1d(expected, rows)) > 0.98 * len(expected)
    ratios = (distances[rows, 0] / np.maximum(distances[rows, 1], 1)) ** 2
    assert np.all(np.diff(ratios) >= -1e-6)
    # Where few are wanted, they are the first ones.
    for found, expected in zip(features.mutual_nearest(source, target, 50), (rows, matched), strict=True):
        assert 50 <= len(found) < len(expected)
        np.testing.assert_array_equal(found, expected[: len(found)])


# Poses


@pytest.mark.parametrize("kind", ["any", "plane", "three", "mirrored"])
def test_poses_are_those_of_scipy(kind):
    rng = np.random.default_rng(4)
    for _ in range(20):
        source = rng.normal(size=(3 if kind == "three" else 30, 3)) * (1, 0.7, 0 if kind == "plane" else 0.4)
        truth = anywhere(int(rng.integers(1000)), 2.0)
        target = source @ truth[:3, :3].T + truth[:3, 3] + 0.05 * rng.normal(size=source.shape)
        if kind == "mirrored":
            target = target * (1, 1, -1)
        weights = rng.random(len(source))
        given = (np.asarray(each, np.float32) for each in (source, target, weights))
        rotation, translation = map(np.asarray, jax.jit(fit_pose)(*given))
        means = [np.average(each, axis=0, weights=weights) for each in (source, target)]
        expected, _ = Rotation.align_vectors(target - means[1], source - means[0], weights)
        # For mirrored points, two poses may fit about equally well.
        error = np.sum(weights * np.sum((source @ rotation.T + translation - target) ** 2, axis=1))
        moved = (source - means[0]) @ expected.as_matrix().T + means[1]
        assert error <= np.sum(weights * np.sum((moved - target) ** 2, axis=1)) * (1 + 1e-3) + 1e-8
        if kind != "mirrored":
            np.testing.assert_allclose(rotation, expected.as_matrix(), atol=2e-3)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
        assert np.linalg.det(rotation) > 0.99


def test_matches_whose_normals_differ_do_not_support_each_other():
    columns = np.zeros((4, NUM_MATCHES, 3), np.float32)
    columns[:2, :4] = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    columns[2:, :4] = [0, 0, 1]
    # Of two of the four matches, the other two.
    for support in (2, 0):
        matches = PutativeMatches(*columns, np.arange(NUM_MATCHES) < 4)
        assert np.max(_support(matches, np.float32(0.05))) == support
        columns[3, :2] = [1, 0, 0]


def test_padding_is_no_match():
    points = np.zeros((NUM_MATCHES, 3), np.float32)
    points[:40] = np.random.default_rng(0).uniform(-2, 2, (40, 3))
    none = np.zeros_like(points)
    matches = PutativeMatches(points, points, none, none, np.arange(NUM_MATCHES) < 40)
    # They fit as they are, and so would zeros.
    assert 30 < hypotheses(matches, np.float32(0.05), np.float32(2.0)).score.max() <= 40.001


# Clouds


@pytest.mark.parametrize("channels", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_room_is_found_from_anywhere(channels):
    source, target, truth = rooms()
    clouds = (source, target) if channels else (bare(source), bare(target))
    result = mcg.global_pose(*clouds)
    assert result.success and not result.ambiguous and found(result, truth, source)
    assert "success" in repr(result) and result.num_inliers <= result.num_matches
    registered = mcg.register(*clouds, mcg.GICP(), init=result.matrix)
    assert registered.converged and found(registered, truth, source)


def test_on_a_plane_channels_of_any_unit_decide():
    walls = ((points, 1e-3 * channels) for points, channels in (wall(3000, seed=seed) for seed in (1, 2)))
    source, target = (mcg.PointCloud(*each) for each in walls)
    away = anywhere(3)
    source, truth = source.transform(away), np.linalg.inv(away)
    result = mcg.global_pose(source, target)
    assert result.success and found(result, truth, source)
    # Channels that are named differently are not compared.
    named = (source.replace(channel_names=("r", "g", "b")), target.replace(channel_names=("g", "b", "r")))
    for clouds in (named, (bare(source), bare(target))):
        alone = mcg.global_pose(*clouds)
        assert not alone.success and not alone.ambiguous


def test_given_matches_replace_features():
    """Nine of ten may be wrong."""
    points, _ = wall(3000, seed=1)
    away = anywhere(4)
    source, target = mcg.PointCloud(points).transform(away), mcg.PointCloud(points)
    rng = np.random.default_rng(0)
    rows = rng.permutation(3000)[:600]
    matched = np.where(np.arange(600) < 60, rows, rng.integers(0, 3000, 600))
    result = mcg.global_pose(source, target, correspondences=(rows, matched))
    assert result.success and found(result, np.linalg.inv(away), source) and result.num_matches == 600
    many = np.tile(rows, 100)
    assert mcg.global_pose(source, target, correspondences=(many, many)).num_matches == NUM_MATCHES
    assert not mcg.global_pose(source, target, correspondences=(rows[:0], rows[:0])).success


def test_large_coordinates_lose_nothing():
    source, target, truth = rooms()
    far = np.eye(4)
    far[:3, 3] = (5e5, 5.4e6, 100)
    result = mcg.global_pose(source, target.transform(far))
    assert result.success and found(result, far @ truth, source)


# Verdicts


@pytest.mark.slow
def test_different_rooms_with_channels_do_not_match():
    clouds = [datasets.box_room(1, points_per_frame=3000, seed=seed)[0].cloud for seed in (0, 1)]
    assert not mcg.global_pose(*clouds).success


def weight(result):
    """Inliers × overlap per √matches, which alone tell right poses from wrong ones badly."""
    return result.num_inliers * result.overlap / np.sqrt(result.num_matches)


def test_few_matches_suffice_where_surfaces_coincide():
    """Views of 200° of a room, of which two thirds overlap, without channels."""

    def view(index, start):
        frame = datasets.box_room(61, points_per_frame=6000, seed=4)[index]
        x, y, _ = frame.cloud.points.T
        return frame.cloud.points[(np.degrees(np.arctan2(y, x)) - start) % 360 < 200], frame.pose

    (points, pose), (target, target_pose) = view(4, 110), view(0, 40)
    source = mcg.PointCloud(points).transform(anywhere(7))
    result = mcg.global_pose(source, target)
    truth = np.linalg.inv(target_pose) @ pose @ np.linalg.inv(anywhere(7))
    assert result.success and result.support > 1 and found(result, truth, source)
    assert weight(result) < 1


def test_many_matches_do_not_suffice_where_surfaces_differ():
    first, second = (datasets.street(121, points_per_frame=15_000, seed=seed)[0].cloud for seed in (0, 2))
    result = mcg.global_pose(bare(first), bare(second))
    assert not result.success and not result.ambiguous and result.support < 1
    # Their number turns on rounding: 54 on one processor.
    assert result.num_inliers > 30


def box(size, seed, count=9000):
    """Points on the faces of a box."""
    rng, size = np.random.default_rng(seed), np.array(size)
    points = rng.uniform(-1, 1, (count, 3)) * size
    rows, face = np.arange(count), rng.integers(0, 3, count)
    points[rows, face] = size[face] * np.sign(points[rows, face])
    return points + 0.005 * rng.normal(size=points.shape)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1.5, 1.4, 0.7), (2.2, 1.2, 1)])
def test_two_boxes_do_not_match(size):
    source = mcg.PointCloud(box((2, 1.2, 1), 1)).transform(anywhere(6))
    assert not mcg.global_pose(source, box(size, 2)).success


def parted(seed, count, common, place=0):
    """Two parts of a furnished room, the source moved far away, and the true pose."""
    pair, away = office(seed, count, common), anywhere(1000 * place + seed)
    return pair.source.transform(away), pair.target, np.linalg.inv(away)


@pytest.mark.parametrize(
    ("seed", "common", "place"), [(4, 0.8, 0), (4, 0.67, 0), (4, 0.5, 0), (6, 0.8, 7), (6, 0.67, 5), (6, 0.5, 7)]
)
def test_walls_alone_do_not_suffice_in_sparse_clouds(seed, common, place):
    """After half a turn the walls of two parts of a room coincide, and in voxels of 0.25 m furniture hardly shows. It
    may be nearly the same after the turn, and most matches agree with that."""
    source, target, truth = parted(seed, 2000, common, place)
    result = mcg.global_pose(source, target)
    # It may find the right pose.
    assert not result.success or found(result, truth, source)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "common"), [(3, 0.67), (1, 0.5)])
def test_furniture_decides_where_walls_coincide_twice(seed, common):
    """The wrong pose has more overlap and half of the inliers, or more, but its surfaces coincide less."""
    source, target, truth = parted(seed, 8000, common)
    result = mcg.global_pose(source, target)
    assert result.success and found(result, truth, source)
    other = result.runner_up
    assert other.num_inliers >= 0.5 * result.num_inliers and other.overlap > 1.2 * result.overlap


def test_a_pose_with_as_much_support_is_a_rival():
    """Two poses of `office(6, 8000, 0.5)`, half a turn apart: fewer matches agree with the right one, more surfaces."""
    wrong = Candidate(np.eye(4), num_inliers=33, overlap=0.97, agreement=0.247, support=1.24)
    right = Candidate(np.eye(4), num_inliers=13, overlap=0.44, agreement=0.409, support=1.24)
    assert right.rivals(wrong) and not replace(right, support=1.0).rivals(wrong)


def test_a_pose_with_fewer_points_in_free_space_is_a_rival():
    wrong = Candidate(np.eye(4), num_inliers=60, overlap=0.87, agreement=0.8, support=8.0, in_free_space=0.008)
    right = Candidate(np.eye(4), num_inliers=1, overlap=0.7, agreement=0.2, support=0.1, in_free_space=0.0004)
    assert right.rivals(wrong)
    for change in ({"in_free_space": 0.002}, {"overlap": 0.3}, {"agreement": 0.05}):
        assert not replace(right, **change).rivals(wrong)
    assert not right.rivals(replace(wrong, in_free_space=0.002))


def bays(seed, number=3, period=2.0):
    """Equal bays in front of a wall."""
    rng, length = np.random.default_rng(seed), number * period
    sides = [((0, 0, 0), (length, 0, 0), (0, 3, 0)), ((0, 3, 0), (length, 0, 0), (0, 0, 3))]
    for x in period * np.arange(number):
        sides += furniture((x + 0.3, 2.2, 0), (x + 1, 3, 1.1)) + furniture((x + 1.3, 1, 0), (x + 1.6, 1.3, 2))
        sides += furniture((x + 0.2, 0.4, 0), (x + 0.5, 1.2, 0.5))
    return mcg.PointCloud(rects(rng, 8000, sides) + NOISE * rng.normal(size=(8000, 3)))


def hall(seed):
    """Scans from two corners of a hall with boxes and pillars, which is the same after half a turn but for those."""
    rng = np.random.default_rng(seed)
    solids = [
        Box(np.array(low, float), np.array(high, float))
        for low, high in (
            ((-16, -11, -1), (16, 11, 0)),
            ((-16, -11, 6), (16, 11, 7)),
            ((-16, -11, 0), (-15, 11, 6)),
            ((15, -11, 0), (16, 11, 6)),
            ((-15, -11, 0), (15, -10, 6)),
            ((-15, 10, 0), (15, 11, 6)),
        )
    ]
    stations = np.array([[-11, -7, 1.6], [10, 7, 1.6]])
    while len(solids) < 24:
        corner = np.append(rng.uniform((-13, -8), (13, 8)), 0)
        if np.linalg.norm(corner - stations, axis=1).min() < 4:
            continue
        size = rng.uniform((0.3, 0.3, 0.5), (2.5, 2.5, 3))
        solids.append(Box(corner, corner + size) if len(solids) < 18 else Cylinder(corner, 0.1 * size[2], 6.0))
    elevation, azimuth = np.meshgrid(np.radians(np.linspace(-60, 85, 150)), np.arange(0, 2 * np.pi, np.pi / 180))
    rays = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    poses, clouds = [np.eye(4), np.eye(4)], []
    for pose, station in zip(poses, stations, strict=True):
        pose[:3, :3] = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_matrix()
        pose[:3, 3] = station
        hits = cast(pose, rays, solids, 80.0)
        clouds.append(hits.sensor_rays * (hits.distance + 0.003 * rng.normal(size=len(hits.distance)))[:, None])
    return clouds[1], clouds[0], np.linalg.inv(poses[0]) @ poses[1]


def test_a_hall_is_not_turned_where_furniture_would_stand_in_free_space():
    """Furniture looks different from the opposite corner, and features find only the pose that is half a turn off."""
    source, target, truth = hall(seed=0)
    result = mcg.global_pose(source, target)
    assert result.ambiguous and found(result.runner_up, truth, mcg.PointCloud(source))


def test_overlap_decides_where_a_scene_repeats():
    """One bay further along the wall all surfaces coincide as well, but one bay of three has no counterpart."""
    source, target, away = bays(0), bays(1), anywhere(0)
    source = source.transform(away)
    result = mcg.global_pose(source, target)
    assert result.success and found(result, np.linalg.inv(away), source)
    other = result.runner_up
    assert other.num_inliers >= 0.5 * result.num_inliers and other.overlap < 0.8 * result.overlap


def test_a_symmetric_scene_is_ambiguous():
    """A box, or hall, whose painted walls are the same after half a turn."""

    def seen(seed):
        points = box((2, 1.2, 1), seed, 7000)
        x, y, z = points.T
        # The same at (−x, −y, z); three channels, one of them twice, as the programs of other tests take them.
        first, second = np.sin(3 * x * y + 2 * z), np.cos(2 * x * y - z) + np.sin(3 * x * x - y * y)
        return mcg.PointCloud(points, np.stack([first, second, first], axis=1))

    result = mcg.global_pose(seen(1).transform(anywhere(5)), seen(2))
    assert result.ambiguous and not result.success and result.runner_up is not None
    assert "ambiguous" in repr(result)


@pytest.mark.filterwarnings("ignore:left out")
@pytest.mark.parametrize("kind", ["ten", "line", "coincident", "noise", "nan", "huge", "tiny"])
def test_hopeless_clouds_have_no_success(kind):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(10 if kind == "ten" else 600, 3))
    if kind == "line":
        points *= (1, 0, 0)
    if kind == "coincident":
        points *= 0
    if kind == "nan":
        points[rng.random(600) < 0.9] = np.nan
    points = points * {"huge": 1e30, "tiny": 1e-30}.get(kind, 1)
    other = rng.permutation(points) if kind in ("line", "coincident") else points + rng.normal(size=points.shape)
    result = mcg.global_pose(points, other)
    assert not result.success and np.isfinite(result.matrix).all()
    np.testing.assert_allclose(result.matrix[:3, :3] @ result.matrix[:3, :3].T, np.eye(3), atol=1e-6)


def test_malformed_arguments_are_named():
    source, target, _ = rooms()
    for named, shown, *clouds, options in (
        ("voxel_size", 0.0, source, target, {"voxel_size": 0.0}),
        ("target: cloud", 3, source, np.zeros((3, 3)), {}),
        ("source: points", (3,), np.zeros(3), target, {}),
        *(
            ("correspondences", "", source, target, {"correspondences": rows})
            for rows in (([0, 1], [0]), ([0.5], [1.0]), ([0], [10**6]))
        ),
    ):
        refused(lambda clouds=clouds, options=options: mcg.global_pose(*clouds, **options), named, shown)


@pytest.mark.slow
def test_other_sizes_compile_nothing():
    def pair(size, seed):
        return [mcg.PointCloud(*room_corner(size + size // 7 * i, seed=seed + i)) for i in (0, 1)]

    for clouds in (pair(3000, 0), [bare(cloud) for cloud in pair(3000, 0)]):
        mcg.global_pose(*clouds)
    with compilations() as found:
        for size in (300, 5000):
            for clouds in (pair(size, size), [bare(cloud) for cloud in pair(size, size)]):
                mcg.global_pose(*clouds)
        mcg.global_pose(*pair(12_000, 12_000))
        mcg.global_pose(*pair(2000, 5), correspondences=(np.arange(50), np.arange(50)))
    assert not found


def test_register_starts_from_anywhere():
    source, target, truth = rooms()
    result = mcg.register(source, target, mcg.GICP(), init="global")
    assert result.converged and found(result, truth, source)
    refused(lambda: mcg.register(source, target, mcg.GICP(), init="local"), "init")
    ready = mcg.preprocess(source)
    traced = jax.jit(lambda points: mcg.register(ready.replace(points=points), ready, mcg.GICP(), init="global").cost)
    refused(lambda: traced(ready.points), "init")


@pytest.mark.slow
def test_a_global_pose_that_is_unsure_leaves_the_registration_unverified():
    clouds = strangers(1000)
    start = mcg.global_pose(*clouds)
    assert not start.success and start.num_inliers
    with pytest.warns(UserWarning, match="global pose: too little evidence .* 10 and 1 are needed") as caught:
        unsure = mcg.register(*clouds, mcg.GICP(), init="global")
    # And nothing of the poses that were tried.
    assert len(caught) == 1
    assert unsure.status is mcg.Status.UNVERIFIED and not unsure.converged
    registered = mcg.register(*clouds, mcg.GICP(), init=start.matrix)
    np.testing.assert_array_equal(unsure.matrix, registered.matrix)
    np.testing.assert_array_equal(unsure.covariance, registered.covariance)
    # Whatever the registration says of itself.
    stopped = mcg.register(*clouds, mcg.GICP(), init=start.matrix, max_iterations=1)
    unsure = mcg.register(*clouds, mcg.GICP(), init="global", max_iterations=1)
    assert stopped.status is mcg.Status.MAX_ITERATIONS and unsure.status is mcg.Status.UNVERIFIED
    noise = np.random.default_rng(0).normal(size=(2, 10, 3))
    with pytest.warns(UserWarning, match="global pose: none found, 0 of .* pass a pose as init"):
        lost = mcg.register(*noise, mcg.GICP(), init="global")
    assert lost.status is mcg.Status.TOO_FEW_CORRESPONDENCES and np.isnan(lost.matrix[:3]).all()


@pytest.mark.slow
@pytest.mark.parametrize("sure", [True, False])
def test_a_worker_that_differentiates_knows_how_sure_the_start_is(sure):
    """A sure start limits the coarse `max_distance`, and of one that is not, a warning tells, traced or not."""
    ours = office(1, 4000)
    source, target = (ours.source, ours.target) if sure else map(mcg.preprocess, strangers(1000))

    def registered(points, executor):
        options = {"init": "global", "executor": executor}
        sources = source.replace(points=points), source
        result, untraced = mcg.register_batch(sources, [target] * 2, mcg.GICP(), **options)
        assert (untraced.status is mcg.Status.UNVERIFIED) != sure
        return result

    def poses(executor):
        doubtful = pytest.warns(mcg.PairWarning, match="^pair 0: global pose: too little evidence")
        with nullcontext() if sure else doubtful:
            matrix, back = jax.vjp(lambda points: registered(points, executor).matrix, jnp.asarray(source.points))
        return matrix, *back(jnp.ones((4, 4)))

    with ThreadPoolExecutor(1) as worker:
        (matrix, gradient), (by_worker, gradient_by_worker) = poses(None), poses(worker)
    np.testing.assert_array_equal(by_worker, matrix)
    np.testing.assert_allclose(gradient_by_worker, gradient, atol=1e-5 * np.abs(gradient).max())


@pytest.mark.slow
@pytest.mark.parametrize("against", ["previous", "map"])
def test_a_lost_frame_is_found_in_the_map(against):
    """The sensor is carried away, looks at nothing it knows, and comes back turned round."""
    frames = list(datasets.box_room(6, points_per_frame=1500, step=0.08))
    away = np.eye(4)
    away[:3, :3] = Rotation.from_euler("xyz", [100, 10, 140], degrees=True).as_matrix()
    away[:3, 3] = (3, -2, 1)
    elsewhere = datasets.box_room(1, points_per_frame=1500, seed=5)[0].cloud
    elsewhere = elsewhere.replace(points=elsewhere.points + 100)
    turned = [frame.cloud.transform(away) for frame in frames[1:3]]
    clouds = [frame.cloud for frame in frames[:4]] + [elsewhere, *turned]
    options = {"max_distance": 0.5, "start": frames[0].pose, "against": against}
    steps = list(mcg.odometry(clouds, mcg.GICP(), recover=True, **options))
    assert steps[4].registration.status == mcg.Status.TOO_FEW_CORRESPONDENCES
    for step, frame in zip(steps[5:], frames[1:3], strict=True):
        assert step.registration.converged
        translation, rotation = pose_error(step.pose, frame.pose @ np.linalg.inv(away))
        assert translation < 0.05 and rotation < 0.01
    drifting = list(mcg.odometry(clouds, mcg.GICP(), **options))
    assert pose_error(drifting[-1].pose, frames[2].pose @ np.linalg.inv(away))[0] > 0.5


@pytest.mark.slow
def test_the_command_line_starts_from_anywhere(tmp_path, capsys):
    names = [str(tmp_path / name) for name in ("source.npz", "target.npz", "pose.txt")]
    command = ["register", *names[:2], "--method", "gicp", "--init", "global", "--output", names[2]]
    for name, cloud in zip(names, strangers(1000), strict=False):
        mcg.io.write(name, cloud)
    assert main(command) == 1
    printed = capsys.readouterr()
    assert "start:     unsure, " in printed.out and "status:    UNVERIFIED" in printed.out
    assert "gicp: UNVERIFIED: " in printed.err and len(mcg.io.read_poses(names[2])) == 1
    for name, points in zip(names, np.random.default_rng(0).normal(size=(2, 10, 3)), strict=False):
        mcg.io.write(name, mcg.PointCloud(points))
    assert main(command) == 2
    assert "global pose: none found, " in capsys.readouterr().err


def seen(shift, seed=0):
    """A frame of a picture on a plane 2 m away, moved sideways by a number of pixels of 4 mm."""
    rng = np.random.default_rng(seed)
    picture = np.kron(rng.integers(0, 255, (40, 50, 3)), np.ones((6, 6, 1)))[:160, shift : shift + 200].astype(np.uint8)
    row, column = (each.ravel() for each in np.mgrid[:160, :200])
    points = np.column_stack([0.004 * column, 0.004 * row, np.full(row.size, 2.0)])
    return datasets.Frame(mcg.PointCloud(points), image=picture, pixels=np.column_stack([column, row]).astype(float))


def test_images_match_points_that_are_the_same():
    pytest.importorskip("cv2")
    source, target = seen(0), seen(20)
    rows, matched = mcg.image_matches(source, target)
    offsets = target.cloud.points[matched] - source.cloud.points[rows]
    good = np.linalg.norm(offsets - (-0.08, 0, 0), axis=1) < 0.006
    assert len(rows) > 40 and good.mean() > 0.8
    # A plane without channels is found by its picture.
    result = mcg.global_pose(source.cloud, target.cloud, correspondences=(rows, matched))
    assert result.success and np.abs(result.matrix[:3, 3] - (-0.08, 0, 0)).max() < 0.02
    unseen = datasets.Frame(source.cloud, image=source.image, pixels=np.full_like(source.pixels, np.nan))
    assert len(mcg.image_matches(unseen, target)[0]) == 0
    left = np.where(source.pixels[:, :1] < 100, source.pixels, np.nan)
    few, matched = mcg.image_matches(datasets.Frame(source.cloud, image=source.image, pixels=left), target)
    offsets = target.cloud.points[matched] - source.cloud.points[few]
    assert 10 < len(few) < len(rows) and np.mean(np.linalg.norm(offsets - (-0.08, 0, 0), axis=1) < 0.02) > 0.8
    blank = datasets.Frame(source.cloud, image=np.zeros_like(source.image), pixels=source.pixels)
    assert len(mcg.image_matches(source, blank)[0]) == 0
    refused(lambda: mcg.image_matches(source, datasets.Frame(source.cloud)), "target", "image")


def test_images_of_real_frames(data):
    pytest.importorskip("cv2")
    frames = datasets.seven_scenes(data / "sevenscenes_redkitchen")
    source, target = frames[4], frames[0]
    truth = np.linalg.inv(target.pose) @ source.pose
    result = mcg.global_pose(source.cloud, target.cloud, correspondences=mcg.image_matches(source, target))
    assert result.success and found(result, truth, source.cloud)
