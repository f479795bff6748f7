"""What is known of an initial pose decides how far matches may be; a right one is not left."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import Status
from mcgicp_jax._math.poses import matrix_of, se3_from_matrix
from mcgicp_jax._registration import start_check
from mcgicp_jax._registration.start_check import SurfaceFit, doubt_of_start
from tests.promise_scenes import office, translation, views
from tests.scenes import motion, room_corner

GICP = mcg.GICP()
# Metres and radians.
PRIOR = np.diag(np.repeat([0.05, np.radians(1)], 3) ** 2)


def error(result, truth=None):
    """Largest distance between the two positions of a point within 3 m of the origin, metres; by default the truth is
    the identity."""
    change = (np.eye(4) if truth is None else np.linalg.inv(truth)) @ np.asarray(result.matrix, np.float64) - np.eye(4)
    return np.linalg.norm(change[:3, 3]) + 3 * np.linalg.norm(change[:3, :3], 2)


# Pairs whose coarse phase leaves the right pose, and the fraction that they have in common.
LEFT = [(1000, 3, 0.8), (2000, 6, 0.8), (2000, 1, 0.8), (4000, 1, 0.8), (2000, 0, 0.67), (4000, 1, 0.5)]


@pytest.mark.parametrize(("count", "seed", "common"), LEFT)
def test_a_right_initial_pose_is_kept(count, seed, common):
    pair = office(seed, count, common)
    for init in (None, motion((0.03, -0.04, 0.01, 0.0, 0.01, -0.02))):
        result = mcg.register(pair.source, pair.target, GICP, init=init)
        assert result.converged and error(result) < 0.08 and result.overlap < 0.75
        if count == 2000 and init is None:
            (same,) = mcg.register_batch([pair.source], [pair.target], GICP)
            np.testing.assert_array_equal(same.matrix, result.matrix)


@pytest.mark.parametrize(("count", "seed", "common"), LEFT[:3])
def test_a_right_initial_pose_is_kept_with_given_distances(count, seed, common):
    pair = office(seed, count, common)
    result = mcg.register(pair.source, pair.target, GICP, max_distance=(1.5, 0.2))
    assert result.status is Status.UNVERIFIED or error(result) < 0.08
    (same,) = mcg.register_batch([pair.source], [pair.target], GICP, max_distance=(1.5, 0.2))
    assert same.status is result.status


# Rooms whose spacing is nearly that of the furniture, so that the default distances lead to poses 1 to 2 m off.
SPARSE = [(330, 2, 0.67), (330, 13, 0.8), (330, 25, 0.5), *((500, seed, 0.5) for seed in (3, 8, 10, 17, 25))]


@pytest.mark.parametrize(("count", "seed", "common"), SPARSE)
def test_a_right_initial_pose_is_kept_or_the_result_unverified_in_sparse_rooms(count, seed, common):
    pair = office(seed, count, common)
    result = mcg.register(pair.source, pair.target, GICP)
    assert result.status is Status.UNVERIFIED or error(result) < 0.15


def test_scan_lines_that_match_themselves_do_not_hold_the_initial_pose(data):
    """16 of 128 beams of a LiDAR, 0.5 m off: more points have matches at the initial pose."""
    clouds = []
    for name in ("source", "target"):
        points = np.asarray(mcg.io.read(data / "lidar_pair" / f"{name}.ply").points, np.float64)
        elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
        low, high = np.quantile(elevation, [0.001, 0.999])
        clouds.append(points[np.floor((elevation - low) / (high - low) * 128) % 8 == 0])
    result = mcg.register(*clouds, GICP)
    assert result.converged and error(result, np.loadtxt(data / "lidar_pair" / "T_target_source.txt")) < 0.05


def test_a_pose_is_unverified_if_another_one_explains_the_surfaces_as_well():
    """A sparse room, 1 m off, where the surfaces coincide as well as at the truth, where the pose begins."""
    pair = office(9, 1000)
    # A prior of a metre does not tell one from the other.
    for prior in (None, (np.eye(4), np.eye(6))):
        with pytest.warns(UserWarning, match=r"one, where the surfaces coincide about as well\. Pass max_distance="):
            result = mcg.register(pair.source, pair.target, GICP, prior=prior)
        assert error(result) > 0.5 and result.status is Status.UNVERIFIED


def corridor(count, low, high, seed):
    """Points on floor, walls and ceiling of a corridor along x, 2 m wide and 2.5 m high, between two x."""
    rng = np.random.default_rng(seed)
    around, x = rng.uniform(0, 9, count), rng.uniform(low, high, count)
    y = np.interp(around, [0, 2, 4.5, 6.5, 9], [0, 2, 2, 0, 0])
    z = np.interp(around, [0, 2, 4.5, 6.5, 9], [0, 0, 2.5, 2.5, 0])
    return np.stack([x, y, z], axis=1) + 0.01 * rng.normal(size=(count, 3))


@pytest.mark.parametrize(("count", "seed", "low"), [(1000, 1, 5), (1500, 4, 5), (800, 4, 3)])
def test_a_degenerate_pose_keeps_its_initial_value(count, seed, low):
    """In the coarse phase the ends of the parts constrain the direction along the corridor."""
    result = mcg.register(corridor(count, low, 11 + low, 2 * seed + 1), corridor(count, 0, 11, 2 * seed), GICP)
    assert result.status is Status.DEGENERATE and error(result) < 0.1


@pytest.mark.parametrize(("count", "seed", "low"), [(300, 31, 3.5), (300, 9, 4.5)])
def test_a_converged_pose_replaces_one_that_is_still_changing(count, seed, low):
    """From the truth the coarse phase slides 3 to 4 m along the corridor, and is at no rest there."""
    with pytest.warns(UserWarning, match="another that is still changing, "):
        result = mcg.register(corridor(count, low, 11 + low, 2 * seed + 1), corridor(count, 0, 11, 2 * seed), GICP)
    assert result.status is Status.UNVERIFIED and error(result) < 0.3


@pytest.mark.parametrize(("count", "seed"), [(300, 1), (600, 11)])
def test_a_pose_far_from_the_initial_one_is_unverified_if_surfaces_coincide_near_it(count, seed):
    with pytest.warns(UserWarning, match=r"4\.\d m from this one, where the surfaces coincide about as well"):
        result = mcg.register(corridor(count, 5, 16, 2 * seed + 1), corridor(count, 0, 11, 2 * seed), GICP)
    assert result.status is Status.UNVERIFIED


@pytest.mark.parametrize(
    ("metres", "by_channels", "is_doubted"), [(3.1, False, True), (2.9, False, False), (3.1, True, False)]
)
def test_a_pose_further_off_than_half_the_coarse_distance_is_doubted(monkeypatch, metres, by_channels, is_doubted):
    """However well surfaces coincide and however many match; in an aisle of shelves, another bay was CONVERGED."""
    calls = []
    monkeypatch.setattr(start_check, "doubt_of_start", lambda *arguments: calls.append(arguments))
    pair = office(0, 500)
    mcg.register(pair.source, pair.target, GICP, max_distance=(6.0, 0.5))
    ((_, state, settings, *_),) = calls
    state = state._replace(
        status=np.int32(Status.CONVERGED),
        record=state.record._replace(num_inliers=10_000),
        directions=replace(state.directions, geometry=np.zeros(6), channels=np.full(6, float(by_channels))),
    )
    away = se3_from_matrix(translation(metres, 0, 0) @ matrix_of(state.pose), np.float32)
    doubt = doubt_of_start(away, state, settings, lambda: SurfaceFit(0.9, 0.9))
    assert (doubt is not None) == is_doubted and (doubt is None or doubt.by_shape)


@pytest.mark.parametrize("shift", [(0.5, 0, 0), (0, 0.5, 0)])
def test_a_pose_that_channels_constrain_may_be_far_from_the_initial_one(shift):
    """On a flat wall of posters surfaces coincide at any pose."""
    target, source = mcg.datasets.poster_wall(num_frames=2)
    clouds = [mcg.preprocess(frame.cloud, 0.08) for frame in (source, target)]
    truth = np.linalg.inv(target.pose) @ source.pose
    result = mcg.register(*clouds, mcg.MultiChannelGICP(), init=translation(*shift) @ truth)
    assert result.converged and error(result, truth) < 0.05


def test_a_wrong_initial_pose_is_left():
    """Without the coarse phase the pose is wrong."""
    target, *_, source = mcg.datasets.box_room(4, seed=2)
    truth = np.linalg.inv(target.pose) @ source.pose
    near = mcg.register(source.cloud, target.cloud, GICP, max_distance=0.15)
    far = mcg.register(source.cloud, target.cloud, GICP)
    assert error(near, truth) > 0.3 and far.converged and error(far, truth) < 0.03


@pytest.mark.parametrize(
    ("search", "seed", "count"), [(None, 1, 4000), pytest.param(mcg.DenseSearch(), 2, 4000, marks=pytest.mark.slow)]
)
def test_right_global_poses_are_kept(search, seed, count):
    pair = office(seed, count)
    (result,) = mcg.register_batch([pair.source], [pair.target], GICP, init="global", search=search)
    assert result.converged and error(result) < 0.05


# --- Priors


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"prior": (np.eye(4), PRIOR)}, id="prior"),
        pytest.param({"prior": (motion((0.05, 0.03, -0.04, 0.01, 0.01, -0.01)), PRIOR)}, id="prior with an error"),
        pytest.param({"voxel_sizes": (0.4,)}, id="voxel sizes"),
    ],
)
def test_priors_and_voxel_sizes_keep_a_right_pose(options):
    pair = office(1, 4000)
    result = mcg.register(pair.source, pair.target, GICP, **options)
    assert result.converged and error(result) < 0.03


@pytest.mark.slow
def test_a_precise_prior_replaces_the_coarse_phase_inside_jit():
    """Where no second attempt is made."""
    clouds, spread = [mcg.preprocess(cloud) for cloud in office(1, 2000)[:2]], PRIOR.astype(np.float32)

    @jax.jit
    def registered(pose, covariance):
        result = mcg.register(*clouds, GICP, prior=(pose, covariance))
        return result.status_code, result.T_target_source.as_matrix()

    status, matrix = registered(np.eye(4, dtype=np.float32), spread)
    assert status == Status.CONVERGED
    np.testing.assert_allclose(matrix, mcg.register(*clouds, GICP, prior=(np.eye(4), PRIOR)).matrix, atol=1e-3)
    # Half a metre off along the room, ten deviations.
    status, _ = registered(translation(0.5, 0, 0).astype(np.float32), spread)
    assert status == Status.UNVERIFIED


@pytest.mark.parametrize(("metres", "status"), [(0.1, Status.CONVERGED), (0.5, Status.UNVERIFIED)])
def test_a_pose_that_contradicts_its_prior_is_unverified(metres, status, recwarn):
    pair = office(3, 4000)
    result = mcg.register(pair.source, pair.target, GICP, init=np.eye(4), prior=(translation(metres, 0, 0), PRIOR))
    told = any("prior: the pose is 9.7 standard deviations" in str(warning.message) for warning in recwarn)
    assert told is (status is Status.UNVERIFIED)
    assert result.status is status and error(result) < 0.03
    assert np.isfinite(result.covariance).all()


# --- Robust kernels


@pytest.fixture(scope="module")
def corner():
    return tuple(mcg.preprocess(room_corner(2000, seed=seed)[0]) for seed in (0, 50))


@pytest.mark.parametrize("kernel", [mcg.Tukey, mcg.Welsch, mcg.GemanMcClure, mcg.Huber])
def test_a_narrow_kernel_leaves_a_wrong_pose(corner, kernel):
    result = mcg.register(*corner, GICP, init=motion((0.08, -0.05, 0.05, 0.01, 0.02, -0.01)), robust=kernel(0.05))
    assert result.converged and error(result) < 0.03


@pytest.mark.slow
def test_narrow_kernels_begin_wide_inside_jit(corner):
    init = motion((0.08, -0.05, 0.05, 0.01, 0.02, -0.01))

    def registered(scale):
        return mcg.register(*corner, GICP, init=init, robust=mcg.Welsch(scale)).T_target_source.as_matrix()

    np.testing.assert_allclose(jax.jit(registered)(0.05), registered(0.05), atol=1e-3)


@pytest.mark.parametrize("field", [1.6, 2.2])
def test_poses_are_unverified_where_a_wrong_one_has_more_inliers(field):
    """1.3 m from the truth more points of these views lie on surfaces than at the truth, where the pose begins."""
    pair = views(2, field)
    with pytest.warns(UserWarning, match=r"fewer than 60% of the source points lie .*\. Pass .* or else a better init"):
        result = mcg.register(pair.source, pair.target, GICP, init=pair.T_target_source)
    assert error(result, pair.T_target_source) > 1 and result.status is Status.UNVERIFIED
    (same,) = mcg.register_batch([pair.source], [pair.target], GICP, init=[pair.T_target_source])
    assert same.status is result.status


def test_views_with_little_overlap_that_agree_converge():
    pair = views(1)
    for init in (None, pair.T_target_source):
        result = mcg.register(pair.source, pair.target, GICP, init=init)
        assert result.converged and error(result, pair.T_target_source) < 0.02
