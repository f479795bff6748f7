"""The poster wall: exact truth, noise as stated, and a scene in which colour alone can tell the motion."""

import itertools

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mcgicp_jax.datasets import Frame, poster_wall


def in_world(frame: Frame) -> np.ndarray:
    return frame.cloud.transform(frame.pose).points


def relative(source: Frame, target: Frame) -> np.ndarray:
    return np.linalg.inv(target.pose) @ source.pose


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


def test_neighboring_frames_overlap_and_share_no_point():
    target, source = poster_wall(2, noise=0.0, seed=3)
    distance, _ = cKDTree(in_world(target)).query(in_world(source))
    assert np.mean(distance < 0.015) > 0.9
    assert distance.min() > 0
    # Points of the two grids do not fall in step anywhere: half of the spacing is as usual as any less.
    assert 0.003 < np.median(distance) < 0.008


def test_the_wall_repeats_without_a_seam():
    # A long way, past several repetitions: still nothing but wall, and as colourful.
    frames = poster_wall(3, points_per_frame=2000, step=4.0, noise=0.0, seed=4)
    for frame in frames:
        np.testing.assert_allclose(in_world(frame)[:, 2], 0, atol=1e-12)
        assert frame.cloud.channels.std(axis=0).min() > 0.05
