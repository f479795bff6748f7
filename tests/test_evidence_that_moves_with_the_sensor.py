"""Channels and points that move with the sensor fit perfectly where it has not moved; they constrain no motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax._local_geometry.sensor_patterns import channels_may_move, explained, without_patterns
from tests.promise_scenes import (
    CORRIDOR,
    FLOOR_AND_WALL,
    MOVING_CHANNELS,
    box,
    in_frames,
    moved,
    on_vehicle,
    seen,
    tiles,
    translation,
)
from tests.reference import pose
from tests.scenes import wall

METHOD = mcg.MultiChannelGICP()
# Where a channel is left out, or simple but not left out.
HONEST = (mcg.Status.DEGENERATE, mcg.Status.UNVERIFIED)
# Far from the sensor, and turned.
ELSEWHERE = pose([0.4, 0.5, 1.0], [15, 8, 3])


def status(pair, **options):
    with pytest.warns(UserWarning, match="may move|seems to move"):
        return mcg.register(pair.source, pair.target, METHOD, **options).status


@pytest.mark.parametrize(
    ("sides", "channel", "frames", "init"),
    [
        *(
            (CORRIDOR, name, (np.eye(4), np.eye(4)), None)
            for name in ("range", "elevation", "azimuth", "time", "vignetting", "coordinate", "ring")
        ),
        *((FLOOR_AND_WALL, name, (ELSEWHERE, ELSEWHERE), None) for name in ("range", "time")),
        pytest.param(FLOOR_AND_WALL, "ring", (np.eye(4), ELSEWHERE), ELSEWHERE, id="the target is a map"),
    ],
)
def test_a_pattern_that_moves_with_the_sensor_constrains_nothing_in_any_frame(sides, channel, frames, init):
    assert status(in_frames(seen(sides, 0, MOVING_CHANNELS[channel]), *frames), init=init) in HONEST


@pytest.mark.parametrize("frame", [np.eye(4), ELSEWHERE])
def test_gradients_along_the_lines_of_sight_from_the_source_constrain_nothing(frame):
    """A road with lanes nearly as strong as the pattern of ranges that moves with the sensor, so that ranges alone do
    not explain the channel. The lines of sight are not those from the centroid, nor from the origin of a map."""
    rng = np.random.default_rng(0)
    clouds = []
    for _ in range(2):
        points = np.column_stack([rng.uniform(-4, 8, 8000), rng.uniform(-4, 4, 8000), 0.01 * rng.normal(size=8000) - 2])
        pattern = 0.7 * np.sin(3 * points[:, 1]) + np.sin(4 * np.hypot(*points[:, :2].T))
        clouds.append(mcg.PointCloud(points, pattern + 0.05 * rng.normal(size=8000)))
    source, target = clouds
    assert not channels_may_move(source)
    target = target.replace(points=moved(frame, target.points))
    init = frame @ translation(0.1, 0, 0)
    assert mcg.register(source, target, METHOD, init=init).status == mcg.Status.DEGENERATE


def test_tiles_beside_a_pattern_do_not_hide_it():
    faint = tiles(0.05)
    pair = seen(
        CORRIDOR, 0, lambda points, world: MOVING_CHANNELS["azimuth"](points, world) * (1 + faint(points, world))
    )
    assert status(pair) == mcg.Status.DEGENERATE


@pytest.mark.parametrize("step", [0.0, 0.3])
@pytest.mark.parametrize("frame", [np.eye(4), ELSEWHERE])
def test_a_texture_holds_a_sensor_at_rest_and_in_motion(step, frame):
    pair = in_frames(seen(CORRIDOR, 0, tiles(0.05, 1.0), step=step), frame, frame)
    result = mcg.register(pair.source, pair.target, METHOD)
    assert result.status == mcg.Status.CONVERGED
    assert mcg.metrics.pose_error(result.matrix, pair.T_target_source)[0] < 0.05


def test_columns_of_the_sensor_are_left_out_beside_a_texture():
    """Which finds the pose alone; distance and azimuth would hold it where the sensor stands still."""
    faint = tiles(0.05, 1.0)
    pair = seen(CORRIDOR, 0, faint)
    columns = [
        cloud.replace(
            channels=np.column_stack([cloud.channels, *(MOVING_CHANNELS[name](cloud.points, None) for name in names)]),
            channel_names=("reflectance", *names),
        )
        for cloud, names in ((pair.source, ("distance", "azimuth")), (pair.target, ("distance", "azimuth")))
    ]
    alone = mcg.register(pair.source, pair.target, METHOD)
    with pytest.warns(UserWarning, match="channel distance: 100% .* is left out"):
        result = mcg.register(*columns, METHOD)
    assert result.status == mcg.Status.CONVERGED
    np.testing.assert_allclose(result.matrix, alone.matrix, atol=2e-3)


def test_inside_jit_the_same_channels_are_left_out_and_the_status_is_the_same():
    pair = seen(CORRIDOR, 0, MOVING_CHANNELS["range"], count=1000)
    clouds = [mcg.preprocess(cloud, None) for cloud in (pair.source, pair.target)]
    far = clouds[0].replace(points=moved(ELSEWHERE, clouds[0].points))

    @jax.jit
    def inside(source, target, far):
        return [cloud.channels for cloud in without_patterns(source, target)], channels_may_move(far), explained(far)

    channels, may_move, traced = inside(*clouds, far)
    assert not np.any(channels) and may_move and channels_may_move(far)
    np.testing.assert_allclose(traced, explained(far), atol=0.01)


def shares(points, channels, **fields):
    return explained(mcg.preprocess(mcg.PointCloud(points, channels, **fields), None))


def test_shares_do_not_depend_on_units_gains_padding_or_missing_values():
    points, paint = wall(2000)
    paint = np.column_stack([paint, points[:, 0]])
    expected = shares(points, paint)
    assert np.all(expected.smooth[:3] < 0.65) and expected.smooth[3] > 0.99
    scaled = shares(1e3 * points, 50 + 7 * paint)
    padded = explained(mcg.preprocess(mcg.PointCloud(points, paint), None).pad(2500))
    # A fifth of the values of all channels but the last are missing.
    present = np.random.default_rng(0).random(paint.shape) < [0.8, 0.8, 0.8, 1]
    missing = shares(points, np.where(present, paint, np.nan), channel_valid=present)
    for found, tolerance in ((scaled, 0.01), (padded, 0.05), (missing, 0.1)):
        np.testing.assert_allclose(found.smooth, expected.smooth, atol=tolerance)


def test_a_polynomial_of_position_is_smooth_in_any_frame_and_noise_is_not():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3000, 3))
    x, y, z = points.T
    channels = np.column_stack([x * y - z**2 + x, rng.normal(size=3000), np.ones(3000)])
    for frame in (np.eye(4), ELSEWHERE):
        _, smooth = shares(moved(frame, points), channels)
        assert smooth[0] > 0.95 and smooth[1] < 0.05 and smooth[2] == 1


def test_from_afar_range_and_angles_are_coordinates():
    """Stripes across the line of sight are then a function of range, and remain a texture."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1, 1, (3000, 2)), np.zeros(3000)])
    stripes = np.sin(20 * points[:, 0])
    near, far = (shares(points + np.array([distance, 0, -1]), stripes).by_angles[0] for distance in (0, 5))
    assert near < 0.5 and far == 0


def test_gradients_by_channels_that_are_left_out_are_zero():
    """Also by those that Λ compares with another one."""
    pair, rng = seen(CORRIDOR, 0, MOVING_CHANNELS["range"], count=1000), np.random.default_rng(0)
    source, target = (
        mcg.preprocess(mcg.PointCloud(cloud.points, np.column_stack([cloud.channels, rng.random(1000)])), None)
        for cloud in (pair.source, pair.target)
    )
    method = mcg.MultiChannelGICP(np.array([[0.05, 0.01], [0.01, 0.08]]), np.array([0.3, 0.2]))

    def along(channels):
        return mcg.register(source.replace(channels=channels), target, method).T_target_source.translation()[0]

    with pytest.warns(UserWarning, match="is left out"):
        gradient = jax.grad(along)(jnp.asarray(source.channels))
        jacobian = mcg.register(source, target, method).jacobian("source", "channels")
    for derivative in (gradient, jacobian):
        np.testing.assert_array_equal(np.any(derivative.reshape(-1, 2), axis=0), [False, True])


def test_a_pose_that_smooth_channels_hold_has_a_derivative_by_them():
    """Training may find what makes them move with the sensor."""
    rng, clouds = np.random.default_rng(0), []
    for _ in range(2):
        points = rng.uniform(-1, 1, (1000, 3)) * [1, 1, 0.003] + [0, 0, 4]
        paint = np.sin(2 * points[:, 0]) + np.cos(2 * points[:, 1])
        clouds.append(mcg.preprocess(mcg.PointCloud(points, paint), None))
    source, target = clouds

    def along(channels):
        result = mcg.register(source.replace(channels=channels), target, METHOD)
        return result.T_target_source.translation()[0], result.status_code

    with pytest.warns(UserWarning, match="may move"):
        slope, code = jax.grad(along, has_aux=True)(jnp.asarray(source.channels))
    assert code == mcg.Status.UNVERIFIED and np.abs(slope @ np.ones(1)).max() > 1e-6


def test_few_points_and_huge_values_explain_nothing():
    rng = np.random.default_rng(0)
    few = shares(rng.random((12, 3)), rng.random(12))
    huge = shares(rng.random((500, 3)), 1e37 * rng.random(500).astype(np.float32))
    assert not np.any(few.by_angles > 0.7) and not np.any(huge.by_angles > 0.7)


@pytest.mark.parametrize("method", [mcg.GICP(), METHOD])
@pytest.mark.parametrize("frame", [np.eye(4), ELSEWHERE])
def test_returns_from_the_own_vehicle_constrain_nothing(method, frame):
    pair = in_frames(on_vehicle(seen(CORRIDOR, 0, count=2000), 0, 0.05), np.eye(4), frame)
    source, target = pair.source, pair.target
    if method is METHOD:
        # A channel that is nothing but noise.
        rng = np.random.default_rng(0)
        source, target = (cloud.replace(channels=rng.normal(size=(2000, 1))) for cloud in (source, target))
    with pytest.warns(UserWarning, match=r"within 0.\d* m of the origin .* PointCloud.crop"):
        result = mcg.register(source, target, method, init=frame)
    assert result.status == mcg.Status.DEGENERATE
    (direction,) = (each for each in result.unconstrained_directions if not each.constrained_by_channels)
    assert not direction.is_rotation and abs(direction.axis[0]) > 0.999


def test_a_cabinet_holds_the_pose_beside_the_own_vehicle():
    cabinet = box((1.5, 0.2, 0), (2.3, 1, 2), lid=False)
    pair = on_vehicle(seen([*CORRIDOR, *cabinet], 0, count=2000), 0, 0.02)
    result = mcg.register(pair.source, pair.target, mcg.GICP(), init=pair.T_target_source)
    assert result.status == mcg.Status.CONVERGED
    assert mcg.metrics.pose_error(result.matrix, pair.T_target_source)[0] < 0.05


def test_a_pole_that_says_less_than_the_own_vehicle_does_not_hold_the_pose():
    pole = box((2.4, 0.4, 0), (2.6, 0.6, 2.5), lid=False)
    pair = seen([*CORRIDOR, *pole], 0, count=2000)
    alone = mcg.register(pair.source, pair.target, mcg.GICP(), init=pair.T_target_source)
    assert alone.status == mcg.Status.CONVERGED
    with pytest.warns(UserWarning, match="little but points within"):
        result = mcg.register(*on_vehicle(pair, 0, 0.05)[:2], mcg.GICP(), init=pair.T_target_source)
    assert result.status == mcg.Status.DEGENERATE


@pytest.mark.slow
def test_the_own_vehicle_is_found_out_inside_jit_in_lanes_and_beside_a_prior():
    pair = on_vehicle(seen(CORRIDOR, 0, count=1000), 0, 0.05)
    source, target = (mcg.preprocess(cloud, None) for cloud in (pair.source, pair.target))
    inside = jax.jit(lambda source, target: mcg.register(source, target, mcg.GICP()).status)(source, target)
    (lane,) = mcg.register_batch([source], [target], mcg.GICP(), search=mcg.DenseSearch())
    assert inside == lane.status == mcg.Status.DEGENERATE
    result = mcg.register(source, target, mcg.GICP(), prior=(pair.T_target_source, np.diag([0.02**2] * 6)))
    assert result.status == mcg.Status.CONVERGED
    assert mcg.metrics.pose_error(result.matrix, pair.T_target_source)[0] < 0.03
