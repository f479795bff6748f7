"""The poster wall: exact truth, noise as stated, and a scene in which colour alone can tell the motion."""

import itertools

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mcgicp_jax.datasets import Frame, poster_wall
from mcgicp_jax.datasets._poster_wall import _paint_wall


def in_world(frame: Frame) -> np.ndarray:
    return frame.cloud.transform(frame.pose).points


def relative(source: Frame, target: Frame) -> np.ndarray:
    return np.linalg.inv(target.pose) @ source.pose


def test_the_same_seed_gives_the_same_frames_however_many():
    two, three, other = poster_wall(2, seed=5), poster_wall(3, seed=5), poster_wall(2, seed=6)
    for first, second in zip(two, three, strict=False):
        np.testing.assert_array_equal(first.pose, second.pose)
        np.testing.assert_array_equal(first.cloud.points, second.cloud.points)
        np.testing.assert_array_equal(first.cloud.channels, second.cloud.channels)
    assert not np.allclose(two[0].pose, other[0].pose)
    assert not np.array_equal(two[0].cloud.channels, other[0].cloud.channels)


@pytest.mark.parametrize("size", [1, 100, 12_000, 50_000])
def test_a_frame_has_about_as_many_points_as_asked_for(size):
    (frame,) = poster_wall(1, points_per_frame=size)
    assert len(frame.cloud) == pytest.approx(size, rel=0.06)
    assert frame.cloud.channel_names == ("red", "green", "blue")
    assert frame.cloud.channels.min() >= 0 and frame.cloud.channels.max() <= 1


def test_without_noise_every_point_lies_on_the_wall_and_has_its_color():
    frames = poster_wall(3, noise=0.0, seed=1)
    for frame in frames:
        np.testing.assert_allclose(in_world(frame)[:, 2], 0, atol=1e-12)
    # Two frames agree about the colour of a place, as far as their points lie apart: exactly, where nothing is painted.
    first, second = (in_world(frame) for frame in frames[:2])
    distance, nearest = cKDTree(second).query(first)
    difference = np.abs(frames[0].cloud.channels - frames[1].cloud.channels[nearest]).max(axis=1)
    assert np.median(difference[distance < 0.005]) < 1e-3


def test_a_wrong_pose_spoils_the_agreement_of_colors():
    target, source = poster_wall(2, noise=0.0, seed=1)
    tree = cKDTree(target.cloud.points)

    def disagreement(T):
        distance, nearest = tree.query(source.cloud.transform(T).points)
        close = distance < 0.02
        return np.abs(source.cloud.channels - target.cloud.channels[nearest])[close].mean()

    truth = relative(source, target)
    for axis in (0, 1):
        shifted = truth.copy()
        shifted[axis, 3] += 0.02
        assert disagreement(shifted) > 1.5 * disagreement(truth)
    assert disagreement(np.linalg.inv(truth)) > 1.5 * disagreement(truth)


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


@pytest.mark.parametrize("seed", range(5))
def test_the_camera_moves_along_the_wall(seed):
    frames = poster_wall(12, points_per_frame=100, step=0.04, seed=seed)
    for frame in frames:
        np.testing.assert_allclose(frame.pose[:3, :3] @ frame.pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert 1.2 <= -frame.pose[2, 3] <= 1.5
    for before, after in itertools.pairwise(frames):
        move = after.pose[:3, 3] - before.pose[:3, 3]
        assert np.linalg.norm(move[:2]) == pytest.approx(0.04)
        assert abs(move[2]) <= 0.3 * 0.04
        turn = Rotation.from_matrix(relative(after, before)[:3, :3]).magnitude()
        assert np.rad2deg(turn) == pytest.approx(1.5, abs=0.01)


def test_the_rays_of_two_frames_fall_differently_within_their_pixels():
    first, second = (525 * frame.cloud.points[:, :2] / frame.cloud.points[:, 2:] for frame in poster_wall(2))
    # The grids are shifted against each other ...
    cell = 640 / 126
    shift = (second - first).mean(axis=0)
    assert np.all(np.abs(shift) > 0.1) and np.all(np.abs(shift) < cell)
    # ... and within each, every ray is anywhere in a pixel.
    for pixels in (first, second):
        off_grid = np.diff(pixels[:126, 0]) - cell
        assert off_grid.std() == pytest.approx(np.sqrt(2 / 12), rel=0.2)


def test_neighboring_frames_overlap_and_share_no_point():
    target, source = poster_wall(2, noise=0.0, seed=3)
    distance, _ = cKDTree(in_world(target)).query(in_world(source))
    assert np.mean(distance < 0.015) > 0.9
    assert distance.min() > 0
    # Points of the two grids do not fall in step anywhere: half of the spacing is as usual as any less.
    assert 0.003 < np.median(distance) < 0.008


@pytest.mark.parametrize("seed", range(4))
def test_the_wall_has_edges_in_every_direction_and_bare_places(seed):
    wall = _paint_wall(np.random.default_rng(seed))
    # Smoothed over three texels, for a slanted edge is a staircase of upright ones.
    down, right = np.gradient(gaussian_filter(wall.mean(axis=-1, dtype=float), 3, mode="wrap"))
    strength = np.hypot(down, right)
    edges = strength > 0.01
    direction = np.rad2deg(np.arctan2(down, right))[edges] % 180
    count, _ = np.histogram((direction + 11.25) % 180, bins=8, range=(0, 180))
    assert count.min() > 0.01 * count.sum()
    for diagonal in (45, 135):
        assert np.mean(np.abs(direction - diagonal) < 3) > 0.025
    assert np.mean(strength < 1e-6) > 0.3
    assert 0.02 < edges.mean() < 0.4
    assert wall.min() >= 0.1 and wall.max() <= 0.95


def test_the_wall_repeats_without_a_seam():
    # A long way, past several repetitions: still nothing but wall, and as colourful.
    frames = poster_wall(3, points_per_frame=2000, step=4.0, noise=0.0, seed=4)
    for frame in frames:
        np.testing.assert_allclose(in_world(frame)[:, 2], 0, atol=1e-12)
        assert frame.cloud.channels.std(axis=0).min() > 0.05


@pytest.mark.parametrize(
    ("argument", "values"),
    [("num_frames", [0, -1]), ("points_per_frame", [0, 10**6]), ("noise", [-0.1, np.nan])],
)
def test_numbers_out_of_range_are_refused_by_name(argument, values):
    for value in values:
        with pytest.raises(ValueError, match=rf"^{argument}: expected .* got {value}"):
            poster_wall(**{argument: value})
