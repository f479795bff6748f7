"""Voxel Gaussians: their statistics, and registration to them."""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import Status, datasets, extend
from mcgicp_jax._clouds.voxels import grid_of
from mcgicp_jax.metrics import pose_error
from tests.compilations import compilations
from tests.differences import GATE, TO_ROUNDING, check_eager_gradient, weigh
from tests.precision import in_both_precisions, in_float64, tolerance
from tests.refusals import refused
from tests.scenes import SURFACES, motion, raw_pair, room_corner, wall

SIZE = 0.4


@pytest.fixture(scope="module")
def raw(precision):
    return raw_pair(size=6000)


@in_both_precisions
def test_statistics_are_those_of_numpy():
    points, channels = room_corner(3000)
    cloud = mcg.PointCloud(points + 100.0, channels)
    cells = extend.voxel_cells(cloud, SIZE)
    found = mcg.voxel_gaussians(cloud, SIZE, min_ratio=0.0)
    assert len(found) == cells.max() + 1 > 20 and found.neighbors is not None
    expected = [np.cov(points[cells == i].T) for i in range(len(found))]
    np.testing.assert_allclose(found.covariances, expected, atol=tolerance(1e-7, 1e-12))
    means = [np.mean(points[cells == i] + 100.0, axis=0) for i in range(len(found))]
    np.testing.assert_allclose(found.coordinates, means, atol=tolerance(1e-5, 1e-12))
    values = [np.mean(channels[cells == i], axis=0) for i in range(len(found))]
    np.testing.assert_allclose(found.channels, values, atol=tolerance(1e-6, 1e-12))
    # Cells are voxels of the turned grid: each is one, and no two are the same.
    voxels = np.floor(grid_of(cloud.coordinates).columns.T / SIZE).astype(int)
    rows = [np.unique(voxels[cells == i], axis=0) for i in range(len(found))]
    assert all(len(row) == 1 for row in rows) and len(np.unique(np.concatenate(rows), axis=0)) == len(found)
    assert np.bincount(cells[cells >= 0]).min() >= 6


def test_counts():
    points, _ = room_corner(3000)
    cloud, counts = mcg.voxel_gaussians(points, SIZE, return_counts=True)
    cells = extend.voxel_cells(points, SIZE)
    np.testing.assert_array_equal(counts, np.unique(cells[cells >= 0], return_counts=True)[1])
    np.testing.assert_array_equal(cloud.points, mcg.voxel_gaussians(points, SIZE).points)
    fuller = mcg.voxel_gaussians(points, SIZE, min_points=20)
    assert len(fuller) == extend.voxel_cells(points, SIZE, min_points=20).max() + 1 == np.sum(counts >= 20) < len(cloud)


def test_flat_cells_are_kept():
    points, _ = wall(3000, noise=0.0)
    found = mcg.voxel_gaussians(points, SIZE, min_ratio=0.02)
    assert len(found) == extend.voxel_cells(points, SIZE).max() + 1
    values = np.linalg.eigvalsh(found.covariances)
    np.testing.assert_allclose(values[:, 0], 0.02 * values[:, 2], rtol=1e-5)


def test_cells_of_one_colour():
    points, _ = wall(4000)
    coloured = mcg.PointCloud(points, (points[:, :1] > 1.1).astype(float))
    # A channel of infinite size does not split.
    whole, unsplit, split = (mcg.voxel_gaussians(coloured, SIZE, channel_size=size) for size in (None, np.inf, 0.5))
    np.testing.assert_array_equal(unsplit.points, whole.points)
    assert np.any((whole.channels > 0.05) & (whole.channels < 0.95))
    assert set(np.unique(split.channels)) == {0.0, 1.0}
    assert len(split) > len(whole)


def test_missing_channels():
    points, channels = room_corner(4000)
    measured = points[:, 0] > 0.5
    cloud = mcg.PointCloud(points, channels, channel_valid=np.repeat(measured[:, None], 2, axis=1))
    numbers, cells = extend.voxel_cells(cloud, SIZE), mcg.voxel_gaussians(cloud, SIZE)
    for i in range(len(cells)):
        inside = (numbers == i) & measured
        assert np.all(cells.channel_valid[i] == inside.any())
        if inside.any():
            np.testing.assert_allclose(cells.channels[i], channels[inside].mean(axis=0), rtol=1e-5)
    # Split by channels, the points of a cell have or lack the same ones.
    split = extend.voxel_cells(cloud, SIZE, channel_size=100.0)
    most, split_most = (max(len(set(measured[rows == i])) for i in range(rows.max() + 1)) for rows in (numbers, split))
    assert most == 2 and split_most == 1


def test_means_of_covariances():
    """Voxelised GICP: the covariances are dimensionless, and GICP uses them beside its own."""
    source, target, truth = raw_pair(size=6000)
    cells = mcg.voxel_gaussians(target, SIZE, of="covariances")
    values = np.linalg.eigvalsh(cells.covariances)
    assert values.min() >= 1e-3 and values.max() < 1.0001
    result = mcg.register(source, cells, mcg.GICP(), max_distance=1.0)
    assert result.converged and max(pose_error(result.matrix, truth)) < 0.02
    given = mcg.preprocess(target)
    given = given.replace(covariances=np.tile(np.eye(3), (len(given), 1, 1)))
    np.testing.assert_allclose(mcg.voxel_gaussians(given, SIZE, of="covariances").covariances[3], np.eye(3), atol=1e-6)


def test_covariances_in_square_metres_beside_those_of_gicp():
    source, target, _ = raw_pair()
    cells = mcg.voxel_gaussians(target, SIZE)
    for clouds, name in (((source, cells), "target"), ((cells, source), "source")):
        with pytest.warns(UserWarning, match=f"^{name}: "):
            mcg.register(*clouds, mcg.GICP())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mcg.register(cells, cells, mcg.GICP())
        mcg.register(source, mcg.voxel_gaussians(target, SIZE, of="covariances"), mcg.GICP())


@in_float64
def test_moments_in_jax():
    points, channels = room_corner(3000)
    cloud = mcg.PointCloud(points, channels)
    cells, expected = extend.voxel_cells(cloud, SIZE), mcg.voxel_gaussians(cloud, SIZE, min_ratio=0.1)
    moments = partial(extend.cell_moments, cells=cells, min_ratio=0.1)
    for function in (jax.jit(moments), moments):
        for found, name in zip(function(points, channels), ("points", "channels", "covariances"), strict=True):
            assert found.dtype == expected.points.dtype
            np.testing.assert_allclose(found, getattr(expected, name), atol=1e-12)


@in_float64
def test_the_gradient_of_a_cell_that_is_as_wide_as_long_is_finite():
    points, channels = jnp.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]), jnp.zeros((4, 0))
    gradient = jax.grad(lambda points: jnp.sum(extend.cell_moments(points, channels, np.zeros(4, int))[2][:, 0, 0]))
    np.testing.assert_allclose(gradient(points), 2 / 3 * points * jnp.array([1, 0, 0]), atol=1e-12)


def test_moments_of_cells_without_channels():
    points, _ = room_corner(900)
    cells = extend.voxel_cells(points, SIZE)
    means, channels, covariances = extend.cell_moments(points, np.zeros((len(points), 0)), cells)
    assert channels.shape == (len(means), 0) and covariances.shape == (len(means), 3, 3)
    assert means.dtype == covariances.dtype == jnp.zeros(()).dtype


def test_moments_of_what_is_no_array_of_points_are_refused_by_name():
    given = {"points": np.zeros((4, 3)), "channels": np.zeros((4, 1)), "cells": np.zeros(4, int)}
    for name, *values in (
        ("points", np.zeros((4, 2)), [["a", "b", "c"]] * 4, None),
        ("channels", np.zeros(4), np.zeros((3, 1))),
        ("cells", np.zeros(4), np.zeros(3, int)),
    ):
        for value in values:
            refused(lambda wrong={name: value}: extend.cell_moments(**given | wrong), name)
    traced = jax.jit(partial(extend.cell_moments, given["points"], given["channels"]))
    refused(lambda: traced(given["cells"]), "cells", "concrete")


@in_float64
def test_gradients_of_moments_compile_nothing_for_another_size():
    def loss(points, channels, cells):
        return sum(jnp.vdot(part, part) for part in extend.cell_moments(points, channels, cells))

    gradient = jax.value_and_grad(loss, argnums=(0, 1))
    for size in (900, 1100):
        points, channels = room_corner(size)
        cells = extend.voxel_cells(mcg.PointCloud(points, channels), SIZE)
        points, channels = map(jnp.asarray, (points, channels))
        with compilations() as compiled:
            gradient(points, channels, cells)
    # The loss itself is compiled, operation by operation.
    assert not [name for name in compiled if "products" in name or "raised" in name or "segment" in name]


@pytest.mark.slow
@in_float64
@pytest.mark.parametrize("method", [mcg.NDT, mcg.D2DNDT], ids=["ndt", "d2d-ndt"])
def test_gradients_reach_the_points(method):
    *clouds, start = raw_pair()
    cells = [mcg.voxel_gaussians(cloud, SIZE) for cloud in clouds]
    numbers = [extend.voxel_cells(cloud, SIZE) for cloud in clouds]
    matches = mcg.find_correspondences(*cells, start, method(), max_distance=GATE)
    # Those of the source inside `jit`, those of the target outside.
    functions = jax.jit(partial(extend.cell_moments, cells=numbers[0])), partial(extend.cell_moments, cells=numbers[1])

    def loss(inputs):
        moved = []
        for i, moments in enumerate(functions):
            means, channels, spread = moments(inputs["points"][i], clouds[i].channels)
            moved.append(cells[i].replace(points=means, channels=channels, covariances=spread))
        return weigh(mcg.estimate_pose(*moved, matches, inputs["method"], init=start, **TO_ROUNDING).matrix)

    check_eager_gradient(loss, {"points": [jnp.asarray(cloud.points) for cloud in clouds], "method": method()})


@pytest.mark.parametrize("method", [mcg.NDT, mcg.D2DNDT, lambda: mcg.ColorNDT(0.1)], ids=["ndt", "d2d-ndt", "colour"])
def test_the_pose_is_found(method, raw):
    method = method()
    source, target, truth = raw
    cells = mcg.voxel_gaussians(target, SIZE)
    moving = source if method.needs_covariances == ("target",) else mcg.voxel_gaussians(source, SIZE)
    result = mcg.register(moving, cells, method)
    assert result.converged and np.isfinite(result.covariance).all()
    assert max(pose_error(result.matrix, truth)) < (0.02 if isinstance(method, mcg.D2DNDT) else 0.01)


def test_voxel_sizes_make_the_cells(raw):
    source, target, truth = raw
    far = motion((0.15, -0.1, 0.1, 0.05, -0.05, 0.1))
    moved = source.transform(np.linalg.inv(far))
    thinned, cells = mcg.preprocess(moved, 0.05), mcg.voxel_gaussians(target, SIZE)
    for moving, end, method in ((moved, mcg.voxel_gaussians(moved, SIZE), mcg.D2DNDT()), (thinned, thinned, mcg.NDT())):
        result = mcg.register(moving, target, method, voxel_sizes=(0.8, SIZE))
        assert result.converged and max(pose_error(result.matrix, truth @ far)) < 0.03
        # The last size is the result.
        again = mcg.register(end, cells, method, init=result.matrix)
        np.testing.assert_allclose(again.matrix, result.matrix, atol=1e-3)
        assert again.num_inliers == result.num_inliers


def test_coarse_sizes_register_voxels_of_a_quarter(raw):
    coarse = mcg.register(*(mcg.preprocess(cloud, 0.2) for cloud in raw[:2]), mcg.GICP())
    expected = mcg.register(*cells_of(raw), mcg.D2DNDT(), init=coarse.matrix)
    result = mcg.register(*raw[:2], mcg.D2DNDT(), voxel_sizes=(0.8, SIZE))
    np.testing.assert_array_equal(result.matrix, expected.matrix)


@pytest.mark.parametrize("method", [mcg.NDT, mcg.D2DNDT], ids=["ndt", "d2d-ndt"])
def test_views_that_overlap_in_part_are_not_pulled_over_each_other(method):
    """A yard with a ground, two walls and a box; each view ends where the other one goes on."""
    rng = np.random.default_rng(0)

    def view(keep):
        ground, wall = (rng.random((6000, 3)) * size for size in ([20, 16, 0], [20, 0, 5]))
        side, box = (rng.random((3000, 3)) * size for size in ([0, 16, 4], [3, 0, 2.5]))
        wall += np.array([0, 16, 0])
        boxes = np.concatenate([box, box[:, [1, 0, 2]]]) + np.array([6, 5, 0])
        points = np.concatenate([ground, wall, side, boxes])
        return mcg.PointCloud(points[keep(points[:, 0])] + 0.01 * rng.normal(size=(np.sum(keep(points[:, 0])), 3)))

    target, source = view(lambda x: x < 15), view(lambda x: x > 3)
    result = mcg.register(source, target, method(), voxel_sizes=(2.0, 1.0), init=motion((1.0, 0.8, 0, 0, 0, 0.15)))
    assert result.converged and np.linalg.norm(result.matrix[:3, 3]) < 0.1


@pytest.mark.parametrize("method", [mcg.NDT, mcg.D2DNDT], ids=["ndt", "d2d-ndt"])
def test_the_unit_of_length_does_not_matter(method, raw):
    metres, millimetres = (
        mcg.register(*(mcg.voxel_gaussians(unit * cloud.points, unit * SIZE) for cloud in raw[:2]), method()).matrix
        for unit in (1.0, 1000.0)
    )
    np.testing.assert_allclose(metres[:3], millimetres[:3] / [1, 1, 1, 1000], atol=tolerance(2e-5, 1e-9))


def cells_of(raw):
    return [mcg.voxel_gaussians(cloud, SIZE) for cloud in raw[:2]]


@in_both_precisions
def test_the_cost_is_the_sum_over_the_nearest_cells(raw):
    """By brute force: each of four cells with its own residual, information and Welsch weight."""
    source, target = cells_of(raw)
    method, gate = mcg.D2DNDT(2.0), 3 * SIZE
    pose = motion((0.06, -0.02, 0.03, 0.03, -0.02, 0.04))
    residuals = target.points - (np.asarray(source.points, float) @ pose[:3, :3].T + pose[:3, 3])[:, None]
    distances = np.linalg.norm(residuals, axis=2)
    rows = np.argsort(distances, axis=1)[:, :4]
    cost, square = 0.0, 0.0
    for i in range(len(source)):
        near = [j for j in rows[i] if distances[i, j] <= gate]
        for j in near:
            spread = target.covariances[j] + pose[:3, :3] @ source.covariances[i] @ pose[:3, :3].T
            cost += 4 * (1 - np.exp(-residuals[i, j] @ np.linalg.solve(spread, residuals[i, j]) / 4))
        square += np.mean(distances[i, near] ** 2)
    matches = mcg.find_correspondences(source, target, pose, method, max_distance=gate)
    np.testing.assert_array_equal(np.sort(matches.indices.T, axis=1), np.sort(rows, axis=1))
    rtol = tolerance(1e-3, 1e-9)
    np.testing.assert_allclose(mcg.mahalanobis_cost(pose, source, target, matches, method), cost, rtol=rtol)
    result = mcg.register(source, target, method, init=pose, max_distance=gate, max_iterations=1)
    np.testing.assert_allclose(result.history["cost"][0], cost, rtol=rtol)
    np.testing.assert_allclose(result.history["rmse"][0], np.sqrt(square / len(source)), rtol=rtol)
    assert result.history["num_inliers"][0] == len(source) and result.overlap <= 1


def test_the_sum_is_more_accurate_than_the_nearest_cell():
    errors = []
    for i in range(4):
        source, target, truth = raw_pair(size=6000, truth=motion(0.3 * np.random.default_rng(i).normal(size=6)))
        clouds = [mcg.voxel_gaussians(cloud, SIZE) for cloud in (source, target)]
        each = [mcg.register(*clouds, mcg.D2DNDT(num_candidates=k), init=truth) for k in (1, 4)]
        errors.append([float(pose_error(result.matrix, truth)[0]) for result in each])
    one, four = np.mean(errors, axis=0)
    assert four < 0.6 * one and four < 0.005


@pytest.mark.slow
def test_colours_are_the_same_inside_jit(raw):
    source, target, _ = raw
    method, cells = mcg.ColorNDT(0.1), mcg.voxel_gaussians(target, SIZE)
    traced = jax.jit(lambda a, b: mcg.register(a, b, method, search=mcg.DenseSearch()).matrix)
    expected = mcg.register(source, cells, method).matrix
    np.testing.assert_allclose(traced(mcg.preprocess(source), cells), expected, atol=1e-4)


@pytest.mark.slow
def test_the_sum_is_the_same_everywhere(raw):
    """On the host, inside `jit`, in batches, in lanes, and in the alignment to its final matches."""
    clouds, method, atol = cells_of(raw), mcg.D2DNDT(), tolerance(1e-4, 1e-9)
    alone = mcg.register(*clouds, method, max_distance=1.0)
    dense = {"max_distance": 1.0, "search": mcg.DenseSearch()}
    inside = jax.jit(lambda *clouds: mcg.register(*clouds, method, **dense))(*clouds)
    np.testing.assert_allclose(inside.matrix, alone.matrix, atol=atol)
    np.testing.assert_allclose(inside.covariance, alone.covariance, rtol=tolerance(0.05, 1e-6), atol=1e-9)
    lanes = mcg.register_batch(clouds[:1] * 2, clouds[1], method, **dense)
    for result in (*mcg.register_batch(clouds[:1], clouds[1], method, max_distance=1.0), *lanes):
        np.testing.assert_allclose(result.matrix, alone.matrix, atol=atol)
        assert result.num_inliers == alone.num_inliers
    matches = mcg.find_correspondences(*clouds, alone.matrix, method, max_distance=1.0)
    again = mcg.estimate_pose(*clouds, matches, method, init=alone.matrix)
    np.testing.assert_allclose(again.matrix, alone.matrix, atol=1e-3)
    refused(lambda: mcg.estimate_pose(*clouds, matches, mcg.NDT()), "temperature", 4)


def test_colours_hold_what_geometry_does_not():
    source, target, truth = raw_pair(wall, 8000, motion((0.02, -0.015, 0.0, 0.0, 0.0, 0.01)))
    colour = mcg.register(source, mcg.voxel_gaussians(target, 0.2, channel_size=1.0), mcg.ColorNDT(0.2))
    assert colour.converged and max(pose_error(colour.matrix, truth)) < 0.01
    assert mcg.register(source, mcg.voxel_gaussians(target, SIZE), mcg.NDT()).status == mcg.Status.DEGENERATE


def test_what_is_wrong_is_named(raw):
    source, target, _ = raw
    cells = mcg.voxel_gaussians(target, SIZE)
    for named, shown, moving, fixed, method, sizes in (
        ("target", "NDT", source, target, mcg.NDT(), ()),
        ("source", "D2DNDT", source, cells, mcg.D2DNDT(), ()),
        ("voxel_sizes", "covariances", source, cells, mcg.NDT(), (1.0,)),
        ("target: voxel_size", "4 cells of 6 points", source, target, mcg.NDT(), (1e-3,)),
    ):
        refused(lambda c=(moving, fixed, method), s=sizes: mcg.register(*c, voxel_sizes=s), named, shown)
    for name, value in (
        *(("voxel_size", -1.0), ("voxel_size", np.nan), ("min_points", 2), ("min_ratio", 2.0)),
        *(("channel_size", 0.0), ("channel_size", [1.0, 2.0, 3.0])),
    ):
        refused(lambda given={name: value}: mcg.voxel_gaussians(target, **{"voxel_size": SIZE} | given), name)
    traced = jax.jit(lambda points: mcg.voxel_gaussians(target.replace(points=points), SIZE).points)
    refused(lambda: traced(target.points), "cloud", "concrete")


@pytest.mark.parametrize("noise", [pytest.param(0.25, marks=pytest.mark.slow), 1.0])
@pytest.mark.parametrize("scene", ["plane", "floor and wall", "corridor", "crossing planes", "room"])
def test_cells_of_noisy_surfaces_hold_nothing_by_chance(scene, noise):
    """Noise in spacings of the points. The truth is the start."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        source, target = (SURFACES[scene](rng, 10_000, noise) for _ in range(2))
        cells = [mcg.voxel_gaussians(points, np.ptp(source, axis=0).max() / 16) for points in (source, target)]
        for moving, method in ((cells[0], mcg.D2DNDT()), (mcg.preprocess(source, None), mcg.NDT())):
            result = mcg.register(moving, cells[1], method)
            assert result.status is (Status.CONVERGED if scene == "room" else Status.DEGENERATE)


@pytest.mark.parametrize(("count", "cell"), [(3000, 0.25), (10_000, 0.15), (1000, 0.4)])
@pytest.mark.parametrize("method", [mcg.NDT, mcg.D2DNDT])
def test_a_plane_as_thick_as_the_cells_holds_nothing(method, count, cell):
    """Its cells have normals in all directions."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        source, target = (np.c_[rng.uniform(-3, 3, (count, 2)), rng.normal(0, cell / 4, count)] for _ in range(2))
        result = mcg.register(source + np.array([0.1, 0.05, 0.02]), target, method(), voxel_sizes=[cell])
        assert result.status is Status.DEGENERATE


@pytest.mark.parametrize("seed", range(2))
def test_large_cells_leave_a_wrong_start(seed):
    """At the start, cells that are matched have little in common."""
    target, source = datasets.street(2, seed=seed, points_per_frame=8000)
    truth = np.linalg.inv(target.pose) @ source.pose
    start = truth @ motion((0.4, -0.3, 0, 0.01, -0.02, 0.09))
    result = mcg.register(source.cloud, target.cloud, mcg.D2DNDT(), init=start, voxel_sizes=[3.0])
    assert max(pose_error(result.matrix, truth)) < 0.1
