"""Deskewing: points of a moving sensor against the exact pose of each, and odometry of a spinning LiDAR."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import datasets, metrics
from mcgicp_jax._math.poses import exponential
from tests.differences import check_eager_gradient, check_gradient
from tests.precision import in_both_precisions, in_float64, tolerance
from tests.refusals import refused

TWIST = np.array([0.8, -0.1, 0.05, 0.02, -0.03, 0.15])


def scan(count=300):
    """Points of a room at rest, in the frame of the sensor at the end, and as it measured them on the way."""
    rng = np.random.default_rng(0)
    still, times = rng.uniform(-3, 3, (count, 3)), rng.permutation(np.linspace(0, 1, count))
    poses = [np.asarray(jaxlie.SE3.exp((time - 1) * TWIST).as_matrix(), np.float64) for time in times]
    seen = np.stack([pose[:3, :3].T @ (point - pose[:3, 3]) for point, pose in zip(still, poses, strict=True)])
    return still, mcg.PointCloud(seen, np.arange(count), times=1.7e9 + 0.1 * times)


def motion():
    return np.asarray(jaxlie.SE3.exp(TWIST).as_matrix(), np.float64)


@in_both_precisions
def test_points_are_where_the_sensor_would_have_seen_them_at_the_end():
    still, cloud = scan()
    moved, inside = mcg.deskew(cloud, motion()), jax.jit(mcg.deskew)(cloud.pad(384), motion())
    for points in (moved.points, inside.points[:300]):
        np.testing.assert_allclose(points, still, atol=tolerance(1e-5, 4e-6))  # the times have 0.2 µs
    assert moved.times is None and moved.points.dtype == np.float64
    np.testing.assert_array_equal(moved.channels, cloud.channels)
    np.testing.assert_allclose(mcg.deskew(cloud, np.eye(4)).points, cloud.points, atol=1e-12)
    refused(lambda: mcg.deskew(moved, motion()), "cloud")
    refused(lambda: mcg.deskew(still, motion()), "cloud")
    refused(lambda: mcg.deskew(cloud, 2 * motion()), "motion")


@pytest.mark.parametrize("placeholder", [0.0, 999.0])
def test_rows_without_return_stay_where_they_are(placeholder):
    still, cloud = scan()
    points = np.concatenate([cloud.points, np.full((30, 3), placeholder)])
    moved = mcg.deskew(mcg.PointCloud(points, times=np.append(cloud.times, np.linspace(0, 1, 30))), motion())
    assert (moved.points[300:] == placeholder).all()
    # One zero may be a measurement.
    with pytest.warns(UserWarning, match=r"left out (29|30) of 330 points"):
        left = mcg.preprocess(moved, None)
    np.testing.assert_allclose(left.points[:300], still, atol=1e-5)


@pytest.mark.slow
@in_float64
@pytest.mark.parametrize("check", [check_eager_gradient, check_gradient])
def test_derivative_by_the_motion_points_and_times(check):
    _, cloud = scan(40)
    weights = np.random.default_rng(1).normal(size=(40, 3))

    def total(inputs):
        moved = mcg.deskew(
            cloud.replace(points=inputs["points"], times=inputs["times"]), jaxlie.SE3.exp(inputs["twist"])
        )
        return jnp.sum(weights * moved.points)

    inputs = jax.tree.map(jnp.asarray, {"twist": TWIST, "points": cloud.points, "times": cloud.times})
    check(total, inputs)
    at_rest = jax.grad(lambda twist: total(inputs | {"twist": twist}))(jnp.zeros(6))
    assert np.isfinite(at_rest).all()


def test_times_are_fractions_of_the_scan_and_follow_their_points():
    points = np.random.default_rng(0).random((5, 3))
    cloud = mcg.PointCloud(points, times=np.array([30, 10, 20, 10, 50], np.uint32))
    np.testing.assert_allclose(cloud.times, [0.5, 0, 0.25, 0, 1])
    np.testing.assert_array_equal(mcg.PointCloud(points, times=np.full(5, 7.0)).times, 1)
    part = cloud.pad(8).replace(valid=np.arange(8) < 3).unpad()
    np.testing.assert_allclose(part.times, [0.5, 0, 0.25])  # not scaled again
    assert mcg.PointCloud.stack([cloud, mcg.PointCloud(points)]).times is None
    assert mcg.PointCloud.stack([cloud, cloud]).times.shape == (2, 128)
    assert mcg.preprocess(cloud, None).times is None
    for wrong in (np.arange(4), [0, 1, 2, 3, np.nan]):
        refused(lambda wrong=wrong: mcg.PointCloud(points, times=wrong), "times")
    refused(lambda: cloud.replace(times=np.arange(4.0)), "times")


def errors(frames, **options):
    """Translation errors from frame to frame, metres, without the first."""
    poses = [step.pose for step in mcg.odometry(frames, mcg.GICP(), max_distance=(2.5, 0.6), **options)]
    return metrics.rpe(poses, [frame.pose for frame in frames])[0]


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"against": "map"}], ids=["previous", "map"])
def test_odometry_of_a_spinning_lidar(options):
    """At 20 m/s, without deskewing stretched scans of a street are off by centimetres; the first pair counts, too."""
    frames = list(datasets.street(3, points_per_frame=8000, step=2.0, spin=True, noise=0.5))
    smeared, deskewed = errors(frames, **options), errors(frames, deskew=True, **options)
    assert deskewed.mean() < 0.5 * smeared.mean() and deskewed.max() < 0.02


def rooms(spin, count=12, size=600):
    """Points of a room with noise, as a slow sensor measures them while it turns, or at once at the end; true poses."""
    rng, twist, frames = np.random.default_rng(0), np.array([0.1, 0, 0, 0, 0, 0.02]), []
    for k in range(count):
        points, axis = rng.uniform(-1, 1, (size, 3)), rng.integers(0, 3, size)
        points[np.arange(size), axis] = np.sign(points[np.arange(size), axis])
        points *= [3, 2.5, 1.5]
        times = 0.5 + np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi)
        poses = exponential((k - 1 + (times if spin else np.ones(size)))[:, None] * twist)
        seen = np.einsum("nji,nj->ni", poses[:, :3, :3], points - poses[:, :3, 3])
        frames.append(mcg.PointCloud(seen + 0.01 * rng.normal(size=seen.shape), times=times))
    return frames, exponential(np.arange(count)[:, None] * twist)


def test_errors_of_motions_do_not_grow_by_deskewing():
    """A motion that is deskewed by itself, or by the whole last one, has errors 1.8 or 1.3 times as large."""
    turns = []
    for spin in (False, True):
        frames, truth = rooms(spin)
        steps = mcg.odometry(frames, mcg.GICP(), max_distance=1.0, deskew=spin)
        turns.append(np.sqrt(np.mean(metrics.rpe([step.pose for step in steps], list(truth))[1][1:] ** 2)))
    assert turns[1] < 1.15 * turns[0]


def test_odometry_needs_times_to_deskew_and_else_ignores_them():
    street = datasets.street(1, points_per_frame=400, spin=True)[0].cloud
    assert street.times.shape == (len(street),) and np.ptp(street.times) == 1
    timed, _ = rooms(spin=True, count=2)
    untimed = [cloud.replace(times=None) for cloud in timed]
    poses = [[step.pose for step in mcg.odometry(clouds, mcg.GICP(), max_distance=1.0)] for clouds in (timed, untimed)]
    np.testing.assert_array_equal(*poses)
    refused(lambda: list(mcg.odometry(untimed, mcg.GICP(), deskew=True)), "frames[0]")
