"""UTM coordinates, 5,000 km from zero, lose nothing: not in float32, not in batches, files and commands."""

import jax
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import io
from mcgicp_jax.__main__ import main
from mcgicp_jax.metrics import pose_error
from tests.refusals import refused
from tests.scenes import motion, raw_pair

UTM = np.array([4.5e5, 5.2e6, 300.0])
TRUTH = motion()
TO_UTM = motion((*UTM, 0, 0, 0))
UTM_TRUTH = TO_UTM @ TRUTH @ np.linalg.inv(TO_UTM)
OPTIONS = ["--max-distance", "0.5", "--voxel-size", "off"]


def scene(offset):
    """Source and target, raw, moved away by an offset that leaves the points' own digits as they are."""
    # What UTM coordinates can hold, and LAS: a tenth of a millimetre.
    arrays = [(np.round(c.points, 4), np.round(100 * (c.channels + 2))) for c in raw_pair(size=1000, channels=1)[:2]]
    return [mcg.PointCloud(points + offset, values, channel_names=["intensity"]) for points, values in arrays]


@pytest.fixture(scope="module")
def near():
    source, target = scene(np.zeros(3))
    return mcg.register(source, target, mcg.MultiChannelGICP(), max_distance=0.5)


def assert_as_near(matrix, near):
    """Every point of the cloud goes where it goes near the origin, to 1e-4 m."""
    matrix = np.asarray(matrix)
    assert matrix.dtype == np.float64
    points = np.asarray(scene(np.zeros(3))[0].points)
    expected = points @ near.matrix[:3, :3].T + near.matrix[:3, 3]
    moved = (points + UTM) @ matrix[:3, :3].T + (matrix[:3, 3] - UTM)
    assert np.abs(moved - expected).max() < 1e-4


def test_a_start_of_too_few_digits_is_refused():
    source, target = scene(UTM)
    typed = UTM_TRUTH.copy()
    typed[:3, :3] = np.round(typed[:3, :3], 6)
    refused(lambda: mcg.register(source, target, mcg.GICP(), init=typed), "init", "digits")


def test_register_from_raw_clouds_and_arrays(near):
    source, target = scene(UTM)
    result = mcg.register(source, target, mcg.MultiChannelGICP(), max_distance=0.5)
    assert result.converged
    assert_as_near(result.matrix, near)
    # From a start that is itself one of UTM.
    again = mcg.register(source, target, mcg.MultiChannelGICP(), init=result.matrix, max_distance=0.5)
    assert again.converged and again.num_iterations <= 2
    assert max(pose_error(again.matrix, result.matrix, at=UTM)) < 5e-4
    points = [cloud.points.tolist() for cloud in (source, target)]
    assert pose_error(mcg.register(*points, mcg.GICP(), max_distance=0.5).matrix, UTM_TRUTH, at=UTM)[0] < 1e-2


def test_one_of_the_clouds_may_be_far(near):
    source, target = scene(np.zeros(3))[0], scene(UTM)[1]
    result = mcg.register(source, target, mcg.MultiChannelGICP(), init=TO_UTM, max_distance=0.5)
    assert result.converged
    assert_as_near(result.matrix @ np.linalg.inv(TO_UTM), near)


@pytest.mark.slow
def test_lanes_find_the_pose(near):
    source, target = scene(UTM)
    options = {"max_distance": 0.5, "search": mcg.DenseSearch()}
    for result in mcg.register_batch([source] * 3, [target] * 3, mcg.MultiChannelGICP(), **options):
        assert result.converged
        assert_as_near(result.matrix, near)


@pytest.mark.slow
def test_jit_finds_the_pose():
    @jax.jit
    def pose(source, target):
        result = mcg.register(source, target, mcg.GICP(), max_distance=0.5, search=mcg.DenseSearch())
        return result, result.matrix

    # The pose is refined there, so its like is one that is, too.
    (near, _), (far, matrix) = (pose(*map(mcg.preprocess, scene(offset))) for offset in (np.zeros(3), UTM))
    # Inside, positions of 5,000 km have steps of half a metre.
    np.testing.assert_allclose(matrix, far.matrix, atol=1)
    assert far.converged
    assert_as_near(far.matrix, near)


@pytest.fixture(scope="module", params=[".las", ".txt"])
def files(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("utm")
    for name, cloud in zip(("source", "target"), scene(UTM), strict=True):
        io.write(folder / f"{name}{request.param}", cloud)
    io.write_poses(folder / "truth.txt", [UTM_TRUTH])
    return folder, [str(folder / f"{name}{request.param}") for name in ("source", "target")]


def test_files_and_the_command(files, near, capsys):
    folder, pair = files
    outputs = ["--output", str(folder / "pose.txt"), "--aligned", str(folder / "moved.ply")]
    assert main(["register", *pair, *OPTIONS, *outputs]) == 0
    (written,) = io.read_poses(folder / "pose.txt")
    assert_as_near(written, near)
    # Copied from the screen, it is as good.
    rows = capsys.readouterr().out.split("T_target_source:\n")[1].splitlines()[:4]
    assert_as_near(np.array([row.split() for row in rows], float), near)
    expected = np.asarray(scene(np.zeros(3))[0].points) @ near.matrix[:3, :3].T + near.matrix[:3, 3]
    assert np.abs(io.read(folder / "moved.ply").points - UTM - expected).max() < 1e-4
    assert main(["register", *pair, *OPTIONS, "--init", str(folder / "pose.txt"), "--max-iterations", "3"]) == 0


@pytest.mark.slow
@pytest.mark.parametrize("files", [".las"], indirect=True)
def test_compare_measures_at_the_cloud(files, capsys):
    folder, pair = files
    assert main(["compare", *pair, *OPTIONS, "--truth", str(folder / "truth.txt")]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    far = {row[0]: float(row[1]) for row in rows if row and row[0] in ("(start)", "mc-gicp", "gicp")}
    middle = scene(np.zeros(3))[0].points.mean(axis=0)
    assert far["(start)"] == pytest.approx(1e3 * pose_error(np.eye(4), TRUTH, at=middle)[0], abs=0.02)
    assert far["mc-gicp"] < 5 and far["gicp"] < 5
