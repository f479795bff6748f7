"""From raw clouds to ready ones: voxels, size classes, far origins, and what is turned away."""

import contextlib
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcgicp_jax import PointCloud, datasets, preprocess
from mcgicp_jax._clouds.coordinate_steps import harmful_steps
from mcgicp_jax._clouds.voxels import grid_of
from tests import reference as ref
from tests.precision import tolerance

POINTS, CHANNELS = ref.scene(150, 2)
UTM = np.array([512_345.6, 5_403_210.9, 312.3])


def in_grid(points):
    """Coordinates along the axes of the voxels."""
    return grid_of(points).columns.T


def ready(values=POINTS, **kwargs):
    return preprocess(values, **{"num_neighbors": 4} | kwargs)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), voxel_size=st.floats(0.05, 5), shift=st.floats(-50, 50))
def test_voxels_hold_the_mean_of_what_falls_into_them(seed, voxel_size, shift):
    rng = np.random.default_rng(seed)
    points = (rng.uniform(-10, 10, (150, 3)) + shift).astype(np.float32).astype(float)
    channels = rng.normal(size=(150, 2)).astype(np.float32).astype(float)
    cloud = ready(PointCloud(points, channels), voxel_size=voxel_size).unpad()
    expected = ref.voxel_means(np.hstack([points, channels]), in_grid(points), voxel_size)
    actual = np.hstack([cloud.points, cloud.channels]).astype(float)
    # The order of the rows is the library's own affair.
    actual = actual[np.lexsort(np.round(actual, 3).T[::-1])]
    expected = expected[np.lexsort(np.round(expected, 3).T[::-1])]
    np.testing.assert_allclose(actual, expected, atol=tolerance(3e-5, 1e-9))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), voxel_size=st.floats(0.05, 5), share=st.sampled_from([0.1, 0.5, 0.9]))
def test_a_voxel_averages_each_channel_over_the_points_that_have_it(seed, voxel_size, share):
    present = np.random.default_rng(seed).random((150, 2)) < share
    present[0] = False
    cloud = ready(PointCloud(POINTS, np.where(present, CHANNELS, np.nan), channel_valid=present), voxel_size=voxel_size)
    # Large voxels may leave nothing missing.
    mask = np.ones(cloud.channels.shape, bool) if cloud.channel_valid is None else cloud.channel_valid
    for i in range(2):
        # A cloud of the points with this channel alone has the same means in the same cells.
        expected = ref.voxel_means(CHANNELS[present[:, i], i : i + 1], in_grid(POINTS)[present[:, i]], voxel_size)
        means = np.sort(cloud.channels[mask[:, i], i])
        np.testing.assert_allclose(means, np.sort(expected[:, 0]), atol=tolerance(1e-6, 1e-12))
        np.testing.assert_array_equal(cloud.channels[~mask[:, i], i], 0)
    np.testing.assert_array_equal(cloud.points, ready(PointCloud(POINTS, CHANNELS), voxel_size=voxel_size).points)


@pytest.mark.parametrize(("point", "channel"), [(False, False), (True, False), (False, True)])
def test_the_mask_is_that_of_the_points_that_are_kept(point, channel):
    """A channel that is said to be there must be finite; of a cloud that lacks nothing there is no mask."""
    points, channels, present = POINTS.copy(), CHANNELS.copy(), np.ones((150, 2), bool)
    if point:
        points[3], present[3] = np.nan, False
    if channel:
        channels[3:5, 1], present[3] = np.nan, [True, False]
    with pytest.warns(UserWarning, match="1 of 150") if point or channel else contextlib.nullcontext():
        cloud = ready(PointCloud(points, channels, channel_valid=present))
    assert len(cloud) == 150 - (point or channel) and (cloud.channel_valid is None) == (not channel)
    assert not channel or np.sum(~cloud.channel_valid) == 1


@pytest.mark.parametrize("seed", range(5))
def test_the_grid_is_turned_away_from_the_axes_and_from_that_of_other_clouds(seed):
    rng = np.random.default_rng(seed)
    points, other = (np.append(np.eye(3), rng.normal(size=(rng.integers(1, 500), 3)), axis=0) for _ in range(2))
    moved = in_grid(points)
    np.testing.assert_allclose(moved @ moved.T, points @ points.T, atol=1e-12)
    assert np.linalg.det(moved[:3]) > 0 and np.abs(moved[:3]).max() < np.cos(np.deg2rad(17))
    np.testing.assert_allclose(in_grid(points[::-1])[::-1], moved, atol=1e-12)
    assert np.linalg.norm(moved[0] - in_grid(other)[0]) > 0.01


@pytest.mark.parametrize("normal", [0, 1, 2])
def test_means_of_voxels_along_a_plane_are_not_biased(normal):
    noise, height = 0.02, 0.09
    points = 10 * np.random.default_rng(normal).random((100_000, 3))
    points[:, normal] = height + noise * np.random.default_rng(3).normal(size=len(points))
    error = np.asarray(ready(points, voxel_size=0.1).points[:, normal], float) - height
    # Along the grid, where the noise extends 10 mm beyond a face of the voxels, it is 0.3 times the noise.
    assert abs(error.mean()) < 0.03 * noise


def test_size_classes():
    numbers = [*range(1, 600), *range(600, 200_000, 997)]
    sizes = [len(PointCloud(np.zeros((number, 3))).pad().points) for number in numbers]
    assert all(size >= number for size, number in zip(sizes, numbers, strict=True)) and sizes == sorted(sizes)
    assert len({size for size, number in zip(sizes, numbers, strict=True) if number >= 100}) == 21
    assert all(len(PointCloud(np.zeros((size, 3))).pad().points) == size for size in set(sizes))


@pytest.mark.parametrize("num_points", [4, 129])
def test_rows_and_neighbours_are_those_of_the_raw_cloud(num_points):
    cloud = ready(PointCloud(POINTS[:num_points], CHANNELS[:num_points]), num_neighbors=6)
    assert cloud.valid.all() and len(cloud) == num_points
    np.testing.assert_array_equal(cloud.points, POINTS[:num_points])
    np.testing.assert_array_equal(cloud.channels, CHANNELS[:num_points])
    np.testing.assert_array_equal(cloud.neighbors, ref.nearest(POINTS[:num_points], POINTS[:num_points], 6))


def test_arrays_are_not_to_be_changed_in_place():
    """What is computed of a cloud is kept as long as it is used."""
    cloud = ready(PointCloud(POINTS, CHANNELS))
    for array in (cloud.points, cloud.channels, cloud.neighbors):
        with pytest.raises(ValueError):
            array[0] = 0


def test_rows_that_are_not_finite_are_left_out_with_one_warning():
    """Nor are those that are finite in float64 alone; the arithmetic does not warn."""
    points, channels, covariances = POINTS.copy(), CHANNELS.copy(), np.tile(np.eye(3), (150, 1, 1))
    points[3, 1], points[9, 2], points[11, 0], covariances[20, 1, 1] = np.nan, -np.inf, 1e39, np.nan
    channels[3, 1], channels[17, 0], channels[18, 1] = np.nan, np.inf, -1e300
    for array in (points, channels, covariances):
        array.setflags(write=False)
    with pytest.warns(UserWarning, match="6 of 150") as caught:
        cloud = ready(PointCloud(points, channels, covariances=covariances))
    assert len(caught) == 1
    keep = ~np.isin(np.arange(150), [3, 9, 11, 17, 18, 20])
    np.testing.assert_array_equal(cloud.unpad().points, POINTS[keep])
    np.testing.assert_array_equal(cloud.unpad().channels, CHANNELS[keep])


@pytest.mark.parametrize(("place", "count", "kept"), [(0.0, 2, 1), (0.0, 70, 1), (-0.0, 70, 1), (999.0, 6, 0)])
def test_rays_without_return_are_left_out(place, count, kept):
    """They lie at exactly one place; a single point at zero may be one of the sensor."""
    rows = np.random.default_rng(0).permutation(150)[:count]
    keep = np.ones(150, bool)
    keep[np.sort(rows)[kept:]] = False
    points = POINTS.copy()
    points[rows] = place
    with pytest.warns(UserWarning, match=f"^left out {count - kept} of 150 points that lie at exactly one place"):
        cloud = ready(PointCloud(points, CHANNELS))
    np.testing.assert_array_equal(cloud.points, points[keep])
    np.testing.assert_array_equal(cloud.channels, CHANNELS[keep])
    slopes = jax.grad(lambda points: jnp.sum(ready(points).points))(jnp.asarray(points))
    np.testing.assert_array_equal(slopes, np.tile(keep[:, None], 3))


# How many rows of a cloud lie at which place, beside 400 points of two walls.
PLACES = {
    "zeros and one place": [((0, 0, 0), 90), ((9, 9, 9), 40)],
    "two places": [((9, 9, 9), 40), ((-9, 9, 9), 30)],
    "a frequent and a rare place": [((9, 9, 9), 300), ((-9, 9, 9), 8)],
    "a place beside zeros": [((0, 0, 0), 90), ((0.01, 0, 0), 8)],
    "a place beside a double point": [((2, 2, 2), 8), ((2.01, 2, 2), 2)],
    "a place, and a double point elsewhere": [((2, 2, 2), 8), ((-2, 2, 2), 2)],
    "places on a line": [((2, y, 2), 6) for y in np.linspace(-2, 2, 9)],
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", PLACES)
def test_placeholders_are_the_places_that_many_more_rows_share_than_any_near_one(name):
    rng = np.random.default_rng(0)
    shared = [np.broadcast_to(place, (count, 3)) for place, count in PLACES[name]]
    walls = rng.uniform(-3, 3, (400, 3))
    walls[:, 0] = 2 * np.sign(walls[:, 0])
    points = rng.permutation(np.concatenate([walls, *shared]).astype(np.float32))
    places, position, counts = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    nearest = np.argsort(np.linalg.norm(places[:, None] - places, axis=2), axis=1)[:, 1:9]
    many = (counts > 5) & (counts > 5 * counts[nearest].max(axis=1))
    zero = (points == 0).all(axis=1)
    measured = np.where(zero, np.cumsum(zero) == 1, ~many[position.ravel()])
    np.testing.assert_array_equal(preprocess(points, None).points, points[measured])


@pytest.mark.parametrize(("count", "distance"), [(25, 50), (25, 300), (250, 300)])
def test_far_surfaces_are_kept_and_far_points_are_not(count, distance):
    """Of a room of 4 m; a window shows a facade a third as wide as it is far."""
    rng = np.random.default_rng(0)
    room = rng.uniform(-2, 2, (2000, 3))
    facade = np.column_stack([np.full(count, distance), distance * rng.uniform(-0.15, 0.15, (count, 2))])
    # Moved clouds are transposed arrays.
    moved = PointCloud(np.concatenate([room, facade])).transform(np.eye(4))
    np.testing.assert_allclose(*(np.sort(cloud.points, axis=0) for cloud in (ready(moved), moved)), rtol=1e-6)
    with pytest.warns(UserWarning, match="left out 19 of 2019 points .* far from all others"):
        assert len(ready(np.concatenate([room, facade[:19]]))) == 2000


def test_points_that_are_far_only_without_others_are_averaged_too():
    """A room of 2 m and returns through a window: the median distance is computed anew without those left out."""
    rng = np.random.default_rng(4)
    face = rng.integers(0, 6, 12_000)
    points = rng.uniform(-1, 1, (12_000, 3))
    points[np.arange(12_000), face % 3] = np.where(face < 3, -1, 1)
    points += 0.02 * rng.normal(size=points.shape)
    outside = rng.normal(size=(100, 3))
    outside *= rng.uniform(15, 60, (100, 1)) / np.linalg.norm(outside, axis=1, keepdims=True)
    points = rng.permutation(np.concatenate([points, outside]))
    with pytest.warns(UserWarning, match="far from all others"):
        chosen = preprocess(points)
        expected = preprocess(points, chosen.voxel_size)
    np.testing.assert_array_equal(chosen.points, expected.points)


def test_the_far_end_of_a_sparse_scan_is_kept():
    points = np.asarray(datasets.street(num_frames=2)[0].cloud.points)[::14]
    assert len(ready(points, voxel_size=None)) == len(points)


@pytest.mark.parametrize("step", [0.5, 1.0])
def test_equal_points_of_rounded_clouds_are_measurements(step):
    points = np.rint(4 * POINTS / step)[np.arange(900) % 150] * step + 100
    assert np.unique(points, axis=0, return_counts=True)[1].max() > 5
    assert len(ready(points)) == 900


def height_map(size=60):
    x, y = np.mgrid[:size, :size].reshape(2, -1)
    return np.stack([x, y, np.round(np.sin(x / 5) + np.cos(y / 7), 3)], axis=1)


SPREAD = np.random.default_rng(0).random((3000, 3)) * [60, 60, 3] @ ref.pose([0.3, 0.2, 0.1], np.zeros(3))[:3, :3]
# A room of 30 m, and circles on a sphere of 5 m.
ROOM = 10 * np.asarray(datasets.box_room(1, points_per_frame=3000)[0].cloud.points, np.float64)
LEVELS, AROUND = np.clip(np.rint(SPREAD[:, 0] / 6) - 5, -5, 5), 2 * np.pi * np.random.default_rng(0).random(3000)
# A planar scan in a hall, 1.5 m from a wall, and its copies, too far apart to be among the neighbours.
RAYS = np.stack([np.cos(2 * np.pi * np.arange(0.1, 600) / 600), np.sin(2 * np.pi * np.arange(0.1, 600) / 600)])
WALLS = np.where(RAYS > 0, [[12], [12.5]], [[12], [1.5]])
HALL = (RAYS / np.max(np.abs(RAYS) / WALLS, axis=0)).T + 0.02 * np.random.default_rng(0).normal(size=(600, 2))
COPIES = np.concatenate([np.insert(HALL, 2, height, axis=1) for height in 3.0 * np.arange(5)])
# Rays from a sensor at a height of 1.6 m that end on the floor or above it.
FLOOR = np.stack([*SPREAD.T[:2], np.where(LEVELS > 0, SPREAD[:, 2], 1.1e-16 * (np.rint(AROUND) % 4 - 1))], axis=1)
# Points, and the step to which they are rounded, metres; 0 where it does no harm.
ROUNDED = {
    "as they are": (SPREAD, 0),
    "voxel centres": (np.unique(np.floor(SPREAD / 0.7), axis=0) * 0.7 + 0.35, 0.7),
    "whole metres of UTM": (np.rint(SPREAD + UTM), 1),
    "integers": (np.rint(SPREAD).astype(int), 1),
    "six digits": (np.array([[float(f"{x:g}") for x in row] for row in SPREAD + UTM]), 10),
    "float32": ((SPREAD + UTM).astype(np.float32), 0.5),
    "float32 as float64": ((SPREAD + UTM).astype(np.float32).astype(float), 0.5),
    "centimetres": (np.round(SPREAD + UTM, 2), 0),
    "float32 at a kilometre": ((SPREAD + 1000).astype(np.float32), 0),
    "float32 near zero": (SPREAD.astype(np.float32), 0),
    "heights of a room": (np.stack([*ROOM.T[:2], np.rint(ROOM.T[2])], axis=1), 1),
    "directions of a room": (np.stack([*np.rint(ROOM.T[:2] / 2) * 2, ROOM.T[2]], axis=1), 2),
    "height map": (height_map(), 0),
    "height map of more points than are sampled": (height_map(70), 0),
    "sections": (np.stack([*np.sqrt(25 - LEVELS**2) * [np.cos(AROUND), np.sin(AROUND)], LEVELS], axis=1), 0),
    "height map in float32": ((height_map() + np.rint(UTM)).astype(np.float32), 0),
    "copies of a planar scan": (COPIES, 0),
    "each of ten points five times": (np.tile(POINTS[:10], (5, 1)), 0),
    "a floor at 0 up to rounding": (FLOOR, 0),
}


@pytest.mark.parametrize("name", ROUNDED)
def test_coarse_steps_of_coordinates_are_found(name):
    points, step = ROUNDED[name]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cloud = preprocess(points, None)
    told = [str(warning.message) for warning in caught if "rounded" in str(warning.message)]
    assert [float(re.search("steps of ([^ ]*) m", text)[1]) for text in told] == [step] * (step > 0)
    spacing = np.float32(0.7 * np.sqrt(60 * 60 / 3000))
    assert harmful_steps(cloud, spacing).max() == pytest.approx(step, rel=1e-4)
    np.testing.assert_array_equal(jax.jit(harmful_steps)(cloud.pad(4900), spacing), harmful_steps(cloud, spacing))


def test_large_coordinates_lose_nothing():
    points = POINTS + UTM
    cloud, local = ready(points, num_neighbors=20), ready(num_neighbors=20)
    assert np.abs(cloud.points).max() < 5
    assert np.asarray(cloud.origin).dtype == np.float64
    np.testing.assert_allclose(cloud.unpad().points, points, rtol=0, atol=tolerance(2e-7, 1e-9))
    np.testing.assert_array_equal(cloud.neighbors, local.neighbors)
    # In voxels, and preprocessed again.
    expected = ref.voxel_means(points, in_grid(points), 0.5)
    actual = ready(points, voxel_size=0.5).unpad().points
    np.testing.assert_allclose(actual[np.lexsort(actual.T[::-1])], expected, rtol=0, atol=tolerance(2e-7, 1e-8))
    again = preprocess(cloud, num_neighbors=6)
    np.testing.assert_allclose(again.unpad().points, points, rtol=0, atol=tolerance(5e-7, 1e-9))
    assert again.neighbors.shape == (150, 6)
    # About zero, a cloud keeps its origin.
    assert not np.any(local.origin) and not np.any(ready(POINTS + np.array([5.0, -5, 0])).origin)


FORMS = {
    "float64": lambda a: a,
    "float32": lambda a: a.astype(np.float32),
    "int64": lambda a: np.round(100 * a).astype(np.int64),
    "uint8": lambda a: np.round(10 * (a - a.min())).astype(np.uint8),
    "big-endian": lambda a: a.astype(">f4"),
    "lists": lambda a: a.tolist(),
    "non-contiguous": lambda a: np.repeat(a, 2, axis=0)[::2],
    "jax": jnp.asarray,
    "jax bfloat16": lambda a: jnp.asarray(a, jnp.bfloat16),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_real_form_of_numbers_is_taken(form):
    values = [FORMS[form](array) for array in (POINTS, CHANNELS)]
    cloud = ready(PointCloud(*values))
    assert cloud.points.dtype == cloud.channels.dtype and cloud.points.dtype in (jnp.float32, jnp.float64)
    for array, expected in zip((cloud.points, cloud.channels), values, strict=True):
        np.testing.assert_array_equal(np.asarray(array)[:150], np.asarray(expected, float))


BAD_CLOUDS = {
    "two columns": ("points", lambda: PointCloud(np.zeros((5, 2)))),
    "complex": ("points", lambda: PointCloud(POINTS.astype(complex))),
    "strings": ("points", lambda: PointCloud(np.full((5, 3), "1"))),
    "ragged": ("points", lambda: PointCloud([[0, 0, 0], [0, 0]])),
    "nothing": ("points", lambda: PointCloud([])),
    "channel rows": ("channels", lambda: PointCloud(POINTS, np.zeros((149, 1)))),
    "channel shape": ("channels", lambda: PointCloud(POINTS, np.zeros((150, 1, 1)))),
    "channel strings": ("channels", lambda: PointCloud(POINTS, np.full((150, 1), "red"))),
    "covariance shape": ("covariances", lambda: PointCloud(POINTS, covariances=np.zeros((150, 3)))),
    "covariance dtype": ("covariances", lambda: PointCloud(POINTS, covariances=np.full((150, 3, 3), "x"))),
    "names": ("channel_names", lambda: PointCloud(POINTS, CHANNELS, channel_names=["intensity"])),
    "three points": ("4 finite points.*3", lambda: ready(POINTS[:3])),
    "nothing finite": ("4 finite points.*0 of 150", lambda: ready(POINTS * np.nan)),
    "beyond float32": ("4 finite points.*0 of 150", lambda: ready(POINTS + 1e40)),
    "channels NaN": ("0 of 150, .*channel_valid", lambda: ready(PointCloud(POINTS, np.nan * CHANNELS))),
    "three finite": ("4 finite points.*3 of 5", lambda: ready(np.add(POINTS[:5], [[np.inf], [np.nan], [0], [0], [0]]))),
    "k of 2": ("num_neighbors", lambda: ready(num_neighbors=2)),
    "k of -1": ("num_neighbors", lambda: ready(num_neighbors=-1)),
    "voxels of infinity": ("voxel_size", lambda: ready(voxel_size=np.inf)),
    "too many voxels": ("voxel_size", lambda: ready(voxel_size=1e-9)),
    "too few voxels": ("voxel_size", lambda: ready(POINTS + 50, voxel_size=100.0)),
    "voxels and covariances": (
        "voxel_size",
        lambda: ready(PointCloud(POINTS, covariances=np.tile(np.eye(3), (150, 1, 1))), voxel_size=0.1),
    ),
    "tracers": ("voxel_size.*auto", lambda: jax.jit(lambda points: ready(points).points)(jnp.asarray(POINTS))),
}


@pytest.mark.parametrize("case", BAD_CLOUDS)
def test_malformed_input_is_turned_away_by_name(case):
    message, make = BAD_CLOUDS[case]
    with pytest.raises(ValueError, match=message):
        make()


def test_losses_are_warned_of():
    many, twice = np.random.default_rng(0).random((500, 3)), np.repeat(POINTS, 2, axis=0)
    channels = np.where(np.arange(300).reshape(150, 2) < 10, [0, np.nan], CHANNELS)
    for told, make, silent in (
        ("voxel_size: 1.0 m leaves 8 of 500", lambda: preprocess(many, 1.0), lambda: preprocess(many, 1.0, 5)),
        ("points: 100% .*voxel_size=", lambda: ready(twice), lambda: ready(twice, voxel_size=1e-3)),
        ("left out 5 of 150 .* 5 of them .*channel_valid", lambda: ready(PointCloud(POINTS, channels)), ready),
    ):
        with pytest.warns(UserWarning, match=f"^{told}"):
            make()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            silent()


@pytest.mark.parametrize("first", [True, False])
def test_the_share_of_duplicates_is_that_of_all_points(first):
    # 4,096 points are sampled with a stride of 2.
    points = np.random.default_rng(0).random((4096, 3)) * [1, 1, 0]
    few, many = points.copy(), points.copy()
    few[1] = few[0]
    rows = np.arange(2458) if first else np.arange(4096 - 2458, 4096)
    many[rows] = np.repeat(many[rows[::2]], 2, axis=0)
    with pytest.warns(UserWarning, match="^points: (59|60|61)% lie exactly"):
        preprocess(many, None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        preprocess(few, None)


def test_the_first_zero_that_is_complete_is_kept():
    points, channels = POINTS.copy(), CHANNELS.copy()
    points[[3, 4, 5]], channels[3] = 0, np.nan
    with pytest.warns(UserWarning, match="left out 1 of 150 points"):
        kept = ready(PointCloud(points, channels)).points
    assert len(kept) == 148 and np.sum((kept == 0).all(axis=1)) == 1
