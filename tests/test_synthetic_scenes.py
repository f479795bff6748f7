"""Synthetic scenes: points on the surfaces that they are said to lie on, seen from the sensor; lazy sequences."""

import itertools
import pickle

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mcgicp_jax.datasets import box_room, poster_wall, street
from tests.refusals import refused

SCENES = [poster_wall, box_room, street]
LIDAR = [box_room, street]


def in_world(frame):
    return frame.cloud.transform(frame.pose).points


def outside(solid, points):
    """Metres outside of the surface of a box, or of the mantle of an upright cylinder, whose ends are open."""
    if hasattr(solid, "low"):
        return np.maximum(solid.low - points, points - solid.high).max(axis=1)
    x, y, z = (points - solid.foot).T
    return np.where((z >= -1e-9) & (z <= solid.height + 1e-9), np.hypot(x, y) - solid.radius, np.inf)


def assert_seen(solids, sensor, points):
    """No solid lies between the sensor and a point."""
    for share in np.random.default_rng(0).uniform(0.01, 0.99, (30, len(points), 1)):
        between = sensor + share * (points - sensor)
        assert min(outside(solid, between).min() for solid in solids) > -1e-9


# Sequences


@pytest.mark.parametrize("scene", SCENES)
def test_a_frame_is_the_same_however_many_there_are_and_can_be_observed_again(scene):
    two, many = scene(2, points_per_frame=2000, seed=5), scene(9, points_per_frame=2000, seed=5)
    first, frame = two
    np.testing.assert_array_equal(frame.pose, many[1].pose)
    np.testing.assert_array_equal(frame.cloud.channels, many[1].cloud.channels)
    for same in (many[1], many.observe(-8)):
        np.testing.assert_array_equal(frame.cloud.points, same.cloud.points)
    other = scene(1, points_per_frame=2000, seed=6)[0]
    assert not np.allclose(first.pose, other.pose)
    assert not np.array_equal(first.cloud.channels[:100], other.cloud.channels[:100])
    again, once_more, same = many.observe(1, 0), many.observe(1, 1), many.observe(1, 0)
    np.testing.assert_array_equal(again.cloud.points, same.cloud.points)
    np.testing.assert_array_equal(again.pose, frame.pose)
    for one, observed in itertools.combinations((frame, again, once_more), 2):
        # Fresh rays, not the same with other noise.
        assert cKDTree(one.cloud.points).query(observed.cloud.points)[0].min() > 0
    with pytest.raises(IndexError):
        two.observe(2, 0)


def test_a_sequence_is_lazy_and_behaves_like_a_list():
    # However long: nothing is made before it is asked for.
    frames = box_room(10**6, points_per_frame=500)
    assert len(frames) == 10**6 and len(list(frames[:6])) == 6
    np.testing.assert_array_equal(frames[-1].pose, frames[10**6 - 1].pose)
    part = frames[4:1:-2]
    assert [frame.time for frame in part] == [frames[4].time, frames[2].time] and len(part[5:]) == 0
    for index in (10**6, -(10**6) - 1):
        with pytest.raises(IndexError):
            frames[index]
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(frames))[3].cloud.points, frames[3].cloud.points)


@pytest.mark.parametrize("scene", SCENES)
def test_noise_scales(scene):
    clean, noisy, twice = (scene(1, points_per_frame=4000, noise=noise, seed=2)[0].cloud for noise in (0.0, 1.0, 2.0))
    moved, moved_twice = (cloud.points - clean.points for cloud in (noisy, twice))
    np.testing.assert_allclose(moved_twice, 2 * moved, atol=1e-12)
    assert 0.001 < np.linalg.norm(moved, axis=1).mean() < 0.03
    inside = (twice.channels > 0) & (twice.channels < 1)
    changed, changed_twice = ((cloud.channels - clean.channels)[inside] for cloud in (noisy, twice))
    np.testing.assert_allclose(changed_twice, 2 * changed, atol=1e-12)
    assert 0.003 < changed.std() < 0.03
    for named, value in (("noise", -0.1), ("noise", np.nan), ("points_per_frame", 0), ("num_frames", 0)):
        refused(lambda named=named, value=value: scene(**{named: value}), named, value)


@pytest.mark.parametrize("scene", LIDAR)
def test_the_sensor_moves_by_steps_and_poses_are_rigid(scene):
    frames = scene(40, points_per_frame=64, step=0.3)
    poses = np.array([frames.path(i) for i in range(40)])
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2) - np.eye(3), 0, atol=1e-12)
    moves = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert moves.min() > 0.29 and moves.max() < 0.32
    turns = Rotation.from_matrix(rotations[:-1].swapaxes(1, 2) @ rotations[1:]).magnitude()
    assert turns.min() > 0 and turns.max() < np.deg2rad(15)
    np.testing.assert_allclose(np.diff([frame.time for frame in frames[:4]]), 0.1)


# Each scene


@pytest.mark.parametrize("seed", range(2))
def test_the_room_is_closed_and_its_points_are_on_its_walls_and_boxes(seed):
    frames = box_room(30, points_per_frame=3000, noise=0.0, step=0.35, seed=seed)
    boxes = frames.observer.args[0]
    for frame in frames[::12]:
        points = in_world(frame)
        assert len(points) == 3000
        assert np.all(points > -1e-9) and np.all(points < (8 + 1e-9, 6 + 1e-9, 2.8 + 1e-9))
        distances = np.array([outside(box, points) for box in boxes])
        # On the surface of one, inside of none, and behind none.
        np.testing.assert_allclose(distances.min(axis=0), 0, atol=1e-9)
        share = np.mean(np.abs(distances) < 1e-9, axis=1)
        assert share[:6].min() > 0.02 and share[6:].sum() > 0.05
        assert_seen(boxes, frame.pose[:3, 3], points)


def test_noise_along_the_rays_keeps_their_directions():
    clean, free, along = (box_room(1, **noise)[0].cloud.points for noise in ({"noise": 0.0}, {}, {"along_rays": True}))
    directions = clean / np.linalg.norm(clean, axis=1, keepdims=True)
    across = [np.linalg.norm(np.cross(points - clean, directions), axis=1).mean() for points in (free, along)]
    assert across[0] > 0.01 and across[1] < 1e-12
    assert np.std(np.sum((along - clean) * directions, axis=1)) == pytest.approx(0.01, rel=0.05)
    assert np.std(free - clean) == pytest.approx(0.01, rel=0.02)


@pytest.mark.parametrize("seed", range(2))
def test_the_points_of_the_street_lie_on_its_things(seed):
    frames = street(20, points_per_frame=6400, noise=0.0, seed=seed)
    frame, things = frames[7], frames.observer.args[0]
    points = in_world(frame)
    distances = np.array([outside(thing.solid, points) for thing in things])
    nearest = np.argmin(np.abs(distances), axis=0)
    distance, kinds = distances[nearest, np.arange(len(points))], np.array([thing.kind for thing in things])[nearest]
    within = np.abs(distance) >= 1e-9
    # All but what lies in windows, which are set back from the façade by up to 25 cm.
    assert set(kinds[within]) == {"building"} and 0.02 < within.mean() < 0.3
    assert np.all((distance[within] > -0.25 - 1e-9) & (distance[within] < 0))
    present = {kind: np.mean(kinds == kind) for kind in {thing.kind for thing in things}}
    assert present["ground"] > 0.2 and min(present.values()) > 1e-3
    assert len(points) > 0.9 * 6400 and np.linalg.norm(frame.cloud.points, axis=1).max() < 80.3
    assert_seen([thing.solid for thing in things if thing.kind != "building"], frame.pose[:3, 3], points)


def test_two_views_of_the_street_agree_about_its_colors():
    first, second = street(2, points_per_frame=64_000, noise=0.0)
    distance, nearest = cKDTree(in_world(second)).query(in_world(first))
    close = distance < 0.03
    assert close.mean() > 0.02
    difference = np.abs(first.cloud.channels - second.cloud.channels[nearest])[close]
    assert np.median(difference[:, 1:]) < 0.02 and np.median(difference[:, 0]) < 0.03


# The poster wall: exact truth, noise as stated, and a scene in which colour alone can tell the motion


@pytest.mark.parametrize("size", [1, 100, 12_000, 50_000])
def test_a_frame_has_about_as_many_points_as_asked_for(size):
    cloud = poster_wall(1, points_per_frame=size)[0].cloud
    assert len(cloud) == pytest.approx(size, rel=0.06) and cloud.channel_names == ("red", "green", "blue")
    assert cloud.channels.min() >= 0 and cloud.channels.max() <= 1


def test_without_noise_every_point_lies_on_the_wall_and_has_its_color():
    frames = poster_wall(3, noise=0.0, seed=1)
    first, second, third = map(in_world, frames)
    np.testing.assert_allclose(np.concatenate([first, second, third])[:, 2], 0, atol=1e-12)
    # Two frames agree about the colour of a place, as far as their points lie apart: exactly, where nothing is painted.
    distance, nearest = cKDTree(second).query(first)
    difference = np.abs(frames[0].cloud.channels - frames[1].cloud.channels[nearest]).max(axis=1)
    assert np.median(difference[distance < 0.005]) < 1e-3


def test_the_noise_is_that_of_a_kinect():
    clean, noisy = (poster_wall(1, noise=noise, seed=2)[0].cloud for noise in (0.0, 1.0))
    error = noisy.points[:, 2] - clean.points[:, 2]
    sigma = 0.0012 + 0.0019 * (clean.points[:, 2] - 0.4) ** 2
    assert np.std(error / sigma) == pytest.approx(1, abs=0.03)
    assert abs(np.mean(error / sigma)) < 0.04
    # The point stays on its ray.
    np.testing.assert_allclose(noisy.points[:, :2] / noisy.points[:, 2:], clean.points[:, :2] / clean.points[:, 2:])
    inside = np.abs(clean.channels - 0.5) < 0.4
    assert np.std((noisy.channels - clean.channels)[inside]) == pytest.approx(0.02, rel=0.03)


@pytest.mark.parametrize("seed", range(2))
def test_the_camera_moves_along_the_wall(seed):
    poses = np.array([frame.pose for frame in poster_wall(12, points_per_frame=100, step=0.04, seed=seed)])
    rotations, moves = poses[:, :3, :3], np.diff(poses[:, :3, 3], axis=0)
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2) - np.eye(3), 0, atol=1e-12)
    assert np.all((poses[:, 2, 3] <= -1.2) & (poses[:, 2, 3] >= -1.5))
    np.testing.assert_allclose(np.linalg.norm(moves[:, :2], axis=1), 0.04, rtol=1e-6)
    assert np.abs(moves[:, 2]).max() <= 0.3 * 0.04
    turns = Rotation.from_matrix(rotations[:-1].swapaxes(1, 2) @ rotations[1:]).magnitude()
    np.testing.assert_allclose(np.rad2deg(turns), 1.5, rtol=0, atol=0.01)
