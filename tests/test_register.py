"""Registration end to end: right poses, honest outcomes, clear errors."""

import contextlib
import copy
import gc
import weakref

import jax
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import Status
from mcgicp_jax.metrics import pose_error
from tests.precision import in_both_precisions, tolerance
from tests.refusals import refused
from tests.scenes import motion, pair, raw_pair, room_corner, wall

METHODS = {
    "point-to-point": mcg.PointToPoint,
    "point-to-plane": mcg.PointToPlane,
    "gicp": mcg.GICP,
    "color-icp": lambda: mcg.ColorICP(0.3),
    "mc-gicp": lambda: mcg.MultiChannelGICP(0.05, 0.3),
    "mc-gicp from the data": mcg.MultiChannelGICP,
}
# What sampling leaves: 2,000 points with 1 cm of noise; ICP pairs are as far apart as the samples.
ACCURACY = {"point-to-point": 2e-2, "color-icp": 2e-2}


@pytest.fixture(scope="module")
def room(precision):
    return pair()


def tight():
    return dict.fromkeys(("translation_tolerance", "rotation_tolerance"), tolerance(1e-6, 1e-10))


def difference(first, second):
    return max(pose_error(np.asarray(first), np.asarray(second)))


@pytest.mark.parametrize("name", METHODS)
def test_every_method_finds_the_pose(name, room):
    source, target, truth = room
    result = mcg.register(source, target, METHODS[name](), max_distance=0.5)
    assert result.converged and result.status is Status.CONVERGED
    assert difference(result.matrix, truth) < ACCURACY.get(name, 4e-3)
    assert result.num_inliers > 1950
    assert len(result.history["cost"]) == result.num_iterations + 1 and result.history["cost"][-1] == result.cost
    np.testing.assert_allclose(result.T_target_source.as_matrix(), result.matrix, atol=1e-6)
    for array in (result.deviations, result.covariance, result.information, result.directions.twists):
        with pytest.raises(ValueError):
            np.asarray(array)[:] = 0


@in_both_precisions
@pytest.mark.parametrize("name", ["mc-gicp", "point-to-plane"])
def test_moving_a_cloud_moves_the_pose(name, room):
    source, target, _ = room
    move = motion((0.3, -0.2, 0.5, 0.4, -0.7, 1.1))
    back = np.linalg.inv(move)

    def pose(source, target, init=None):
        return mcg.register(source, target, METHODS[name](), init=init, max_distance=0.5, **tight()).matrix

    expected = pose(source, target)
    assert difference(pose(source.transform(move), target, back) @ move, expected) < tolerance(5e-5, 1e-8)
    assert difference(back @ pose(source, target.transform(move), move), expected) < tolerance(5e-5, 1e-8)


def test_the_result_belongs_to_the_returned_pose(room):
    source, target, _ = room
    method = METHODS["mc-gicp"]()
    for iterations, status in ((2, Status.MAX_ITERATIONS), (64, Status.CONVERGED)):
        result = mcg.register(source, target, method, max_distance=0.5, max_iterations=iterations, **tight())
        assert result.status is status and (result.num_iterations == iterations or result.converged)
        matches = mcg.find_correspondences(source, target, result.matrix, method, max_distance=0.5)
        cost = mcg.mahalanobis_cost(result.matrix, source, target, matches, method)
        np.testing.assert_allclose(result.cost, cost, rtol=1e-4)
        assert result.num_inliers == matches.valid.sum()
        np.testing.assert_allclose(result.rmse, np.sqrt(np.mean(matches.distances[matches.valid] ** 2)), rtol=1e-4)


def test_information_is_the_curvature_of_the_cost_with_fixed_M(room):
    source, target, _ = room
    method = mcg.PointToPoint()
    result = mcg.register(source, target, method, max_distance=0.5)
    matches = mcg.find_correspondences(source, target, result.matrix, method, max_distance=0.5)
    # With M = I, F(T exp(ξ)) ≈ Σ |d − R(v + ω × a)|²: half of its Hessian without the curvature of the residual.
    points = np.asarray(source.points, float)[np.asarray(matches.valid)]
    jacobian = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(points), 3, 3)), np.cross(np.eye(3), points[:, None]).swapaxes(1, 2)], axis=2
    )
    np.testing.assert_allclose(result.information, np.einsum("nia,nib->ab", jacobian, jacobian), rtol=1e-4, atol=1e-1)


def test_identical_clouds_converge_in_one_iteration(room):
    source, _, _ = room
    result = mcg.register(source, source, METHODS["mc-gicp"](), max_distance=0.5)
    assert result.converged and result.num_iterations == 1
    np.testing.assert_allclose(result.matrix, np.eye(4), atol=1e-6)


@pytest.mark.parametrize("robust", [mcg.Huber, mcg.Tukey])
def test_robust_kernels_resist_outliers(robust):
    source, target, truth = raw_pair()
    # A fifth of the source has been lifted, all of it in one direction.
    source.points[:400] += [0.0, 0.0, 0.3] @ truth[:3, :3]
    clouds = mcg.preprocess(source), mcg.preprocess(target)
    plain, kernel = (mcg.register(*clouds, mcg.GICP(), max_distance=0.5, robust=k) for k in (None, robust(1.0)))
    assert kernel.converged
    # They pull along z; what is left across it is the noise of sampling, the same for both.
    pull, resisted = (abs(result.matrix[2, 3] - truth[2, 3]) for result in (plain, kernel))
    assert resisted < 0.3 * pull


# --- Outcomes


def test_a_coarse_phase_without_matches_has_no_covariance():
    """It ends with a part of the source points."""
    points = np.random.default_rng(0).random((8200, 3))
    far = motion((50, 0, 0, 0, 0, 0))
    result = mcg.register(points, points, mcg.PointToPoint(), init=far, max_distance=(0.5, 0.1), max_source_points=None)
    assert result.status is Status.TOO_FEW_CORRESPONDENCES and np.isnan(result.deviations).all()


def test_clouds_without_overlap_do_not_converge(room):
    source, target, _ = room
    result = mcg.register(source, target, mcg.GICP(), init=motion((50, 0, 0, 0, 0, 0)), max_distance=0.5)
    assert result.status is Status.TOO_FEW_CORRESPONDENCES
    assert not result.converged and result.num_inliers == result.overlap == result.cost == 0 and np.isnan(result.rmse)
    assert np.isnan(result.covariance).all() and result.unconstrained_directions == ()
    np.testing.assert_allclose(result.matrix, motion((50, 0, 0, 0, 0, 0)))
    assert "TOO_FEW_CORRESPONDENCES" in repr(result)


def test_every_status_but_converged_has_advice():
    assert [status for status in Status if not status.advice] == [Status.CONVERGED]


@pytest.mark.parametrize("seed", [4, 39])
def test_alternating_matches_end_as_converged(seed):
    clouds = [mcg.PointCloud(*room_corner(500, seed=each)) for each in (seed, seed + 100)]
    result = mcg.register(*clouds, mcg.GICP(), **{"translation_tolerance": 1e-6, "rotation_tolerance": 1e-6})
    assert result.converged and result.num_iterations < 40
    assert result.history["translation_step"][-4:].max() < result.deviations[:3].max()
    assert difference(result.matrix, np.eye(4)) < 4 * result.deviations[:3].max()


def with_value(cloud, name, where, value):
    """A copy with one entry of an array changed."""
    changed = np.array(getattr(cloud, name))
    changed[where] = value
    return cloud.replace(**{name: changed})


def test_overflow_is_reported(room):
    # In float32, also where x64 is on: its range is soon left.
    source, target = (mcg.preprocess(np.asarray(cloud.unpad().points, np.float32)) for cloud in room[:2])
    huge = with_value(source, "points", 0, 1e30)
    result = mcg.register(huge, target, mcg.PointToPoint(), max_distance=np.inf)
    assert result.status is Status.NON_FINITE and not result.converged


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_points_that_are_not_finite_are_reported(value, room):
    source, target, _ = room
    broken = with_value(source, "points", (3, 0), value)
    assert mcg.register(broken, target, mcg.PointToPoint(), max_distance=0.5).status is Status.NON_FINITE
    broken = with_value(target, "channels", (3, 0), value)
    lost, whole = (mcg.register(source, cloud, METHODS["color-icp"](), max_distance=0.5) for cloud in (broken, target))
    # The pairs of its row go to others, and no other pair is lost.
    assert lost.status is Status.CONVERGED and abs(lost.num_inliers - whole.num_inliers) <= 2
    assert difference(lost.matrix, whole.matrix) < 1e-3


# --- Input


@pytest.mark.parametrize(
    "name, value",
    [
        *(("max_distance", bad) for bad in (0.0, -1.0, np.nan, (0.2, 0.5), (0.5, 0.0), (np.nan, 0.1), np.ones(3))),
        *(("init", bad) for bad in (np.eye(3), np.diag([1.0, 1, -1, 1]), np.full((4, 4), np.nan), 2 * np.eye(4))),
        ("translation_tolerance", -1.0),
        ("rotation_tolerance", np.nan),
        ("voxel_sizes", (0.5, -1.0)),
        ("robust", 1.0),
        ("search", "tree"),
        ("hold_unconstrained", 2),
        ("equalize_channels", "yes"),
    ],
)
def test_a_bad_argument_is_named(name, value, room):
    refused(lambda: mcg.register(*room[:2], mcg.GICP(), **{"max_distance": 0.5, name: value}), name)


def test_two_distances_are_two_registrations_in_a_row(room):
    def registered(max_distance, **options):
        return mcg.register(*room[:2], mcg.GICP(), max_distance=max_distance, **options)

    # The first needs to come to rest nearly.
    first = registered(0.5, translation_tolerance=5e-3, rotation_tolerance=5e-3)
    second, result = registered(0.08, init=first.matrix), registered((0.5, 0.08))
    assert result.converged and result.num_iterations == first.num_iterations + second.num_iterations
    assert result.num_inliers == second.num_inliers < first.num_inliers
    # The first stops a step earlier: its last pose is not measured once more.
    assert difference(result.matrix, second.matrix) < 1e-4
    np.testing.assert_array_equal(registered((0.5, 0.5)).matrix, registered(0.5).matrix)


@pytest.fixture(scope="module")
def large(precision):
    """A source of more than twice 4,096 points, every other one of which is matched at first; and its options."""
    truth = motion()
    source = (room_corner(8400, seed=1)[0] - truth[:3, 3]) @ truth[:3, :3]
    # Points further apart come to rest within 1e-4; test_agrees_with_small_gicp.py has large scans.
    options = {"max_distance": 0.3, "max_source_points": None} | dict.fromkeys(tight(), 1e-4)
    return mcg.preprocess(source, None), mcg.preprocess(room_corner(2000, seed=2)[0], None), options


def test_large_sources_start_with_every_other_point_and_end_with_all(large):
    source, target, options = large
    result = mcg.register(source, target, mcg.GICP(), **options)
    numbers = result.history["num_inliers"]
    assert result.converged and numbers[0] == 4200 and numbers[-1] == result.num_inliers == 8400
    matches = mcg.find_correspondences(source, target, result.matrix, mcg.GICP(), max_distance=0.3)
    settled = mcg.estimate_pose(source, target, matches, mcg.GICP(), init=result.matrix)
    assert difference(settled.matrix, result.matrix) < 1e-4
    half = mcg.register(source, target, mcg.GICP(), **options | {"max_source_points": 4200})
    assert difference(half.matrix, result.matrix) > 1e-3
    # What is measured last is measured with all points, wherever the iterations have run out.
    stopped = mcg.register(source, target, mcg.GICP(), **options, max_iterations=1)
    assert stopped.status == Status.MAX_ITERATIONS and stopped.num_inliers == 8400


@pytest.mark.slow
def test_large_sources_start_with_every_other_point_inside_jit(large):
    source, target, options = large
    expected = mcg.register(source, target, mcg.GICP(), **options)
    traced = jax.jit(lambda s: mcg.register(s, target, mcg.GICP(), search=mcg.DenseSearch(), **options))(source)
    assert traced.status == Status.CONVERGED and difference(traced.matrix, expected.matrix) < 1e-4
    numbers = expected.history["num_inliers"]
    np.testing.assert_allclose(traced.history["num_inliers"][: len(numbers)], numbers, rtol=1e-2)


def test_the_default_distances_come_from_the_spacing(room):
    source, target, truth = room
    points, rows = np.asarray(target.points), np.asarray(target.neighbors)[: len(target)]
    spacing, last = np.median(np.linalg.norm(points[rows[:, [1, 19]]] - points[: len(target), None], axis=2), axis=0)
    grid = np.sqrt(np.pi / 20) * last
    assert grid > 1.2 * spacing
    result, expected = (
        mcg.register(source, target, METHODS["mc-gicp"](), max_distance=distances)
        for distances in (None, (10 * max(spacing, grid), 2.5 * spacing))
    )
    assert result.converged and difference(result.matrix, truth) < 4e-3
    assert difference(result.matrix, expected.matrix) < 1e-6


def test_default_distances_bridge_the_gaps_between_scan_lines():
    """Points 2 cm apart along lines that are 14 cm apart; the start is off by several lines."""
    rng = np.random.default_rng(0)

    def scan():
        along, line = np.meshgrid(np.arange(-2, 2, 0.02), np.arange(-2, 2, 0.14))
        flat = np.stack([along, line + 0.14 * rng.random(), np.zeros_like(along)], axis=-1).reshape(-1, 3)
        walls = [np.roll(flat, i, axis=1) + shift for i, shift in enumerate(([0, 0, 0], [-2, 0, 2], [0, 2, 2]))]
        return mcg.preprocess(np.concatenate(walls) + 0.003 * rng.normal(size=(3 * len(flat), 3)))

    source, target = scan(), scan()
    start = motion((0.4, -0.4, 0.4, 0.0, 0.0, 0.05))
    result = mcg.register(source, target, mcg.GICP(), init=start)
    assert result.converged and difference(result.matrix, np.eye(4)) < 5e-3
    near = mcg.register(source, target, mcg.GICP(), init=start, max_distance=(0.2, 0.05))
    assert difference(near.matrix, np.eye(4)) > 0.1


@pytest.mark.slow
def test_voxel_sizes_register_a_start_that_is_far_off():
    truth = motion((2, 1.5, -1, 0.1, 0.1, -0.4))
    source, target, _ = pair(truth=truth, noise=0.003)
    method = METHODS["mc-gicp"]()
    assert difference(mcg.register(source, target, method, max_distance=(0.4, 0.1)).matrix, truth) > 1
    far = mcg.register(source, target, method, max_distance=(0.4, 0.1), voxel_sizes=(0.3, 0.15))
    assert far.converged and difference(far.matrix, truth) < 4e-3
    inside = jax.jit(lambda source: mcg.register(source, target, method, voxel_sizes=(0.2,)).matrix)
    refused(lambda: inside(source), "voxel_sizes", "inside jit")


def test_equalized_channels_undo_gain_and_offset():
    source, target, truth = pair(wall)
    other = source.replace(channels=source.channels * np.array([0.8, 1.3, 0.5]) + np.array([0.1, -0.2, 0.3]))
    expected, result, plain = (
        mcg.register(cloud, target, mcg.MultiChannelGICP(), equalize_channels=equalize)
        for cloud, equalize in ((source, True), (other, True), (other, False))
    )
    assert result.converged and difference(result.matrix, expected.matrix) < 1e-5
    assert difference(result.matrix, truth) < 6e-3
    assert difference(plain.matrix, truth) > 2 * difference(result.matrix, truth)


@pytest.mark.slow
def test_equalized_channels_are_not_fooled_by_what_one_cloud_sees():
    """A fifth of the source, far off to the side, is bright: by all points its gain would be wrong."""
    source, target, truth = pair(wall)
    points, channels = (np.array(array[:2000]) for array in (source.points, source.channels))
    points[:400, 0] += 5
    channels[:400] = 1.75
    right, source = (mcg.preprocess(mcg.PointCloud(points, values)) for values in (channels, 0.8 * channels + 0.1))
    method, options = mcg.MultiChannelGICP(), {"equalize_channels": True, "search": mcg.DenseSearch()}
    result = mcg.register(source, target, method, equalize_channels=True)
    assert result.converged and difference(result.matrix, truth) < 6e-3
    assert difference(result.matrix, mcg.register(right, target, method).matrix) < 2e-3
    assert len(result.history["cost"]) == result.num_iterations + 1
    jitted = jax.jit(lambda source: mcg.register(source, target, method, **options).matrix)(source)
    assert difference(jitted, result.matrix) < 2e-4


def test_clouds_that_do_not_fit_are_named(room):
    source, target, _ = room
    fewer = source.replace(channels=source.channels[:, :1])
    given = target.replace(covariances=np.broadcast_to(np.eye(3), (*target.points.shape, 3)))
    for named, shown, *arguments in (
        ("channels", "1 and 2", fewer, target, METHODS["mc-gicp"]()),
        ("channel_covariance", "(3,)", source, target, mcg.MultiChannelGICP(np.ones(3), 0.1)),
        ("channel_weights", "(3,)", source, target, mcg.ColorICP(np.ones(3))),
        ("source", "jax.vmap", mcg.PointCloud.stack([source, source]), target, mcg.GICP()),
        ("source: cloud", "got 0", np.zeros((0, 3)), target, mcg.GICP()),
        ("source: points", "(10, 2)", np.zeros((10, 2)), target, mcg.GICP()),
    ):
        refused(lambda arguments=arguments: mcg.register(*arguments, max_distance=0.5), named, shown)
    refused(lambda: mcg.register(source, given, mcg.GICP(), voxel_sizes=(0.2,)), "voxel_sizes")
    # Geometry alone does not look at channels.
    assert mcg.register(fewer, target, mcg.GICP(), max_distance=0.5).converged


def test_a_coarse_pose_that_is_degenerate_is_the_next_start():
    """Geometry holds the wall's distance and tilt; the coarse pose must not be thrown away for what slides."""
    truth = motion((0.0, 0.0, 0.25, 0.12, 0.0, 0.0))
    source, target, _ = pair(wall, truth=truth)
    result = mcg.register(source, target, mcg.GICP(), max_distance=0.06, voxel_sizes=(0.2,))
    assert result.status is Status.DEGENERATE
    # Across the wall the pose is found, though the fine gate alone would see nothing.
    normal = np.asarray(result.matrix) @ np.linalg.inv(truth)
    assert abs(normal[2, 3]) < 0.01 and np.degrees(np.arccos(normal[2, 2])) < 1
    assert mcg.register(source, target, mcg.GICP(), max_distance=0.06).num_inliers < result.num_inliers


@pytest.mark.slow
def test_jit_gives_the_pose_of_the_host_before_it_has_converged(room):
    options = {"max_distance": 0.5, "max_iterations": 1, "search": mcg.DenseSearch()}
    host = mcg.register(*room[:2], mcg.GICP(), **options)
    inside = jax.jit(lambda *clouds: mcg.register(*clouds, mcg.GICP(), **options))(*room[:2])
    assert host.status is inside.status is Status.MAX_ITERATIONS
    np.testing.assert_allclose(inside.matrix, host.matrix, atol=tolerance(1e-5, 1e-9))


@pytest.mark.parametrize("unit", [1e-2, 1e3])
def test_the_unit_of_length_does_not_matter(unit, room):
    """A small part is registered as closely, relative to its size, as a room."""
    scaled = ([mcg.preprocess(np.asarray(cloud.points, float) * scale) for cloud in room[:2]] for scale in (1, unit))
    expected, result = (mcg.register(*clouds, mcg.GICP()) for clouds in scaled)
    assert result.num_iterations == expected.num_iterations and result.status is expected.status
    np.testing.assert_allclose(result.matrix[:3, 3] / unit, expected.matrix[:3, 3], atol=tolerance(1e-5, 1e-10))
    np.testing.assert_allclose(result.matrix[:3, :3], expected.matrix[:3, :3], atol=tolerance(1e-5, 1e-10))


@pytest.mark.parametrize("gain, offset, warned", [(1, 0, False), (3, 0.1, False), (255, 0, True), (1, 50, True)])
def test_channels_in_other_units_are_warned_of_once_per_channel(gain, offset, warned, room, recwarn):
    source, target, _ = room
    changed, method = source.replace(channels=gain * source.channels + offset), METHODS["mc-gicp"]()
    mcg.register(changed, target, method, max_distance=0.5, max_iterations=1)
    mcg.register(changed, target, mcg.GICP(), max_distance=0.5, max_iterations=1)
    mcg.register(changed, target, method, equalize_channels=True, max_iterations=1)
    assert (0 < sum("units differ" in str(warning.message) for warning in recwarn) <= 2) == warned


def test_tight_tolerances_do_not_keep_the_coarse_phase_from_ending(room):
    zero = dict.fromkeys(tight(), 0.0)
    usual, exact, never = (mcg.register(*room[:2], mcg.GICP(), **options) for options in ({}, tight(), zero))
    assert never.num_inliers == exact.num_inliers == usual.num_inliers
    np.testing.assert_allclose(never.matrix, exact.matrix, atol=1e-6)


def test_translation_and_rotation_must_both_be_below_their_tolerances(room):
    loose, translation, rotation = (
        mcg.register(*room[:2], mcg.GICP(), translation_tolerance=a, rotation_tolerance=b).num_iterations
        for a, b in ((1.0, 1.0), (1e-6, 1.0), (1.0, 1e-6))
    )
    assert loose < min(translation, rotation)


def test_a_copied_result_holds_no_clouds():
    source, target, _ = pair()
    clouds = [weakref.ref(cloud) for cloud in (source, target)]
    result = mcg.register(source, target, mcg.GICP(), max_distance=0.5)
    del source, target
    gc.collect()
    assert all(cloud() is not None for cloud in clouds)
    result = copy.deepcopy(result)
    gc.collect()
    assert all(cloud() is None for cloud in clouds) and np.isfinite(result.covariance).all()


@pytest.mark.parametrize("way", ["outside", *(pytest.param(way, marks=pytest.mark.slow) for way in ("jit", "vjp"))])
def test_a_pose_from_a_small_overlap_is_unverified(way):
    target, near = (room_corner(size, seed=seed)[0] + 40 for size, seed in ((300, 0), (25, 1)))
    source, target = (mcg.preprocess(points, None) for points in (np.concatenate([near, target[:275] - 50]), target))

    def registered(points):
        result = mcg.register(source.replace(points=points), target, mcg.PointToPlane(), max_distance=1.0)
        return result.matrix, result

    with contextlib.nullcontext() if way == "jit" else pytest.warns(UserWarning, match='such as init="global"$'):
        if way == "vjp":
            *_, result = jax.vjp(registered, source.points, has_aux=True)
        else:
            _, result = (jax.jit(registered) if way == "jit" else registered)(source.points)
    assert result.status == Status.UNVERIFIED and 0 < result.overlap < 0.1 and np.isfinite(result.matrix).all()
    with pytest.warns(UserWarning, match="of the source points have a match, .* pass a better init$"):
        mcg.register(source, target, mcg.PointToPlane(), init=np.eye(4), max_distance=1.0)
