"""Where small_gicp calls `converged` what is nothing, or loses what is there: there, and here."""

import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import Status
from mcgicp_jax.metrics import pose_error
from tests.scenes import motion, room_corner

small_gicp = pytest.importorskip("small_gicp")

TRUTH = motion()
POINTS, TARGET = (room_corner(1000, seed=seed)[0] for seed in (1, 2))
SOURCE = (POINTS - TRUTH[:3, 3]) @ TRUTH[:3, :3]
AWAY = motion((50, 0, 0, 0, 0, 0))
UTM = np.array([4.5e5, 5.2e6, 300.0])
METHODS = {"ICP": mcg.PointToPoint(), "PLANE_ICP": mcg.PointToPlane(), "GICP": mcg.GICP()}


def theirs(source, target, kind="GICP", init=None):
    return small_gicp.align(
        target,
        source,
        init_T_target_source=np.eye(4) if init is None else init,
        registration_type=kind,
        downsampling_resolution=0.02,
        max_correspondence_distance=0.5,
    )


def ours(source, target, kind="GICP", init=None):
    clouds = [mcg.preprocess(points, voxel_size=0.02) for points in (source, target)]
    return mcg.register(*clouds, METHODS[kind], init=init, max_distance=0.5)


def test_both_find_a_pose_that_is_there():
    for register in (theirs, ours):
        result = register(SOURCE, TARGET)
        assert result.converged and max(pose_error(result.T_target_source, TRUTH)) < 1e-2


@pytest.mark.parametrize("kind", METHODS)
def test_clouds_without_overlap(kind):
    result = theirs(SOURCE, TARGET, kind, AWAY)
    assert result.converged and result.num_inliers == 0
    result = ours(SOURCE, TARGET, kind, AWAY)
    assert result.status is Status.TOO_FEW_CORRESPONDENCES and not result.converged


@pytest.mark.parametrize("size", [0, 1])
def test_clouds_of_no_point_and_of_one(size):
    assert theirs(SOURCE[:size], TARGET).converged
    with pytest.raises(ValueError, match=f"expected at least 4 finite points, got {size} of {size}"):
        ours(SOURCE[:size], TARGET)
    with pytest.warns(UserWarning, match="pair 1: source: cloud: expected at least 4 finite points"):
        good, bad = mcg.register_batch([SOURCE, SOURCE[:size]], TARGET, mcg.GICP(), max_distance=0.5)
    assert good.converged and bad.status is Status.INVALID_INPUT and not bad.converged


def test_utm_coordinates():
    """Voxel numbers of theirs run out there: a single point is left, the start is returned, and it is converged."""
    shift = motion((*UTM, 0, 0, 0))
    truth = shift @ TRUTH @ np.linalg.inv(shift)
    result = theirs(SOURCE + UTM, TARGET + UTM)
    assert result.converged and result.num_inliers == 0 and pose_error(result.T_target_source, truth, at=UTM)[0] > 0.05
    result = ours(SOURCE + UTM, TARGET + UTM)
    assert result.converged and max(pose_error(result.matrix, truth, at=UTM)) < 1e-2
