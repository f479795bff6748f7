"""`mcgicp odometry`, on scenes and on real scans."""

import itertools
import sys

import matplotlib.image
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import PointCloud, datasets, io


def number_after(text, label):
    return float(text.split(label)[1].split()[0].strip("%,°"))


def test_a_scene_is_followed_and_its_files_are_written(tmp_path, command):
    poses, map, way = (tmp_path / name for name in ("poses.txt", "map.ply", "way.png"))
    options, files = ["--num-frames", "3", "--method", "gicp", "--output", poses], ["--map", map, "--plot", way]
    code, text, errors = command("odometry", "box-room", *options, *files)
    assert code == 0 and errors == "" and "pairs:     2 of 2 converged" in text
    assert number_after(text, "per pair: ") < 15 and number_after(text, "drift: ") < 20
    written, frames = io.read_poses(poses), datasets.box_room(3)
    assert len(written) == 3
    np.testing.assert_allclose(written[0], frames.path(0), atol=1e-12)
    np.testing.assert_allclose(written[2][:3, 3], frames.path(2)[:3, 3], atol=0.03)
    assert command("odometry", "box-room", *options, "--pose-format", "tum")[0] == 0
    rows = np.loadtxt(poses)
    np.testing.assert_allclose(rows[:, 0], [frame.time for frame in frames])
    np.testing.assert_allclose(rows[:, 1:4], written[:, :3, 3], atol=1e-6)
    made = io.read(map)
    assert made.channel_names == ("red", "green", "blue") and 2000 < len(made) < 15_000
    # In the world: the room.
    assert np.all(made.points > -0.1) and np.all(made.points < (8.1, 6.1, 2.9))
    assert matplotlib.image.imread(way).ndim == 3
    assert all(str(path) in text for path in (poses, map, way))


def test_what_does_not_converge_is_no_success(command):
    options = ["--num-frames", "2", "--method", "gicp", "--max-distance", "1e-6"]
    code, text, errors = command("odometry", "box-room", *options)
    assert code == 1 and "pairs:     0 of 1 converged" in text and "matches up to 1e-06 m apart" in text
    assert "lost:      1 of 2 frames" in text and ". --recover finds lost frames again" in errors
    first, second = errors.splitlines()
    assert first.startswith("mcgicp: frames[1]: TOO_FEW_CORRESPONDENCES")
    assert second == "mcgicp: 1 of 1 registrations did not converge (TOO_FEW_CORRESPONDENCES)"


@pytest.mark.slow
def test_channels_can_be_chosen(command):
    options = ["--num-frames", "2", "--channels", "intensity", "--voxel-size", "0.4"]
    code, text, _ = command("odometry", "street", *options)
    assert code == 0 and "channels:  intensity\n" in text and number_after(text, "per pair: ") < 100
    assert command("odometry", "street", *options, "--method", "color-icp")[0] == 0
    code, _, errors = command("odometry", "street", "--channels", "humidity")
    assert code == 2 and "humidity; there are intensity, red, green, blue" in errors


def test_wrong_input_gets_one_line(tmp_path, command):
    alone = tmp_path / "alone"
    alone.mkdir()
    (alone / "frame-000000.depth.png").touch()
    for args, message in (
        (["kitti", tmp_path], str(tmp_path)),
        (["kitti"], "mcgicp odometry kitti PATH"),
        (["box-room", alone], "PATH: expected none after box-room"),
        ([alone, alone], "PATH: expected none after"),
        (["kitti", tmp_path, "--map", tmp_path / "velodyne" / "000000.bin"], "000000.bin: "),
        (["tum", tmp_path], "depth.txt: "),
        (["7-scenes", alone], "2 frames, got 1"),
        (["box-room", "--num-frames", "1"], "mcgicp: --num-frames: "),
        (["box-room", "--every", "0"], "mcgicp: --every: "),
        (["box-room", "--min-range", "9", "--max-range", "3"], "mcgicp: --min-range: "),
        (["box-room", "--pose-frame", "camera"], "mcgicp: --pose-frame: "),
        (["box-room", "--columns", "5"], "mcgicp: --columns: "),
        ([alone], f"mcgicp odometry 7-scenes {alone}"),
        # Options that contradict each other are named as flags.
        (["box-room", "--against", "map", "--loops"], "mcgicp: --loops: expected --against previous"),
        (["box-room", "--recover", "--loops"], "registrations become edges, got --recover"),
        (["box-room", "--map-radius", "5"], "mcgicp: --map-radius: expected --against map"),
        (["box-room", "--deskew"], "mcgicp: --deskew: expected points with times"),
        (["box-room", "--deskew", "--every", "2"], "mcgicp: --deskew: expected scans that follow each other"),
    ):
        code, _, errors = command("odometry", *args)
        assert code == 2 and errors.startswith("mcgicp: ") and errors.count("\n") == 1 and message in errors


def test_a_plain_folder_is_followed(tmp_path, command):
    frames = datasets.box_room(3, points_per_frame=1500)
    for k, suffix in enumerate((".xyz", ".pcd", ".npz")):
        io.write(tmp_path / f"scan_{8 + k}{suffix}", PointCloud(frames[k].cloud.points))
    for name in ("readme.md", "run_log.txt"):
        (tmp_path / name).write_text("no cloud\n")
    arguments = ["odometry", tmp_path, "--max-distance", "0.5", "--output", tmp_path / "poses.txt"]
    for left_out in ("readme.md, run_log.txt", "poses.txt, readme.md, run_log.txt"):
        code, text, errors = command(*arguments)
        assert code == 0 and errors == "" and f"left out:  {left_out} (not clouds)\n" in text
        assert "frames:    3 of " in text and "therefore gicp" in text and "2 of 2 converged" in text
    truth = [frames.path(0) @ pose for pose in io.read_poses(tmp_path / "poses.txt")]
    np.testing.assert_allclose(truth, [frames.path(k) for k in range(3)], atol=0.03)
    kept = (tmp_path / "scan_8.xyz").read_bytes()
    for wrong, message in (
        ([*arguments, "--output", tmp_path / "scan_8.xyz"], "scan_8.xyz: "),
        ([*arguments, "--map", tmp_path / "map.ply"], "map.ply: expected a map outside of"),
        (["odometry", tmp_path / "nothing"], "nothing: expected a folder of clouds or one of kitti, "),
    ):
        code, _, errors = command(*wrong)
        assert code == 2 and message in errors
    assert (tmp_path / "scan_8.xyz").read_bytes() == kept


def test_frames_are_cropped_and_left_out(tmp_path, command):
    poses, map = tmp_path / "poses.txt", tmp_path / "map.ply"
    options = ["--min-range", "1", "--max-range", "6", "--every", "2", "--num-frames", "2", "--loops"]
    code, text, _ = command("odometry", "box-room", "--method", "gicp", *options, "--output", poses, "--map", map)
    assert code == 0 and "loops:     " in text
    first, second = io.read_poses(poses)
    np.testing.assert_allclose(second[:3, 3], datasets.box_room(3).path(2)[:3, 3], atol=0.03)
    distance = np.linalg.norm(io.read(map).points - np.stack([first, second])[:, None, :3, 3], axis=2).min(axis=0)
    # From either pose, and averaged in voxels.
    assert distance.min() > 0.8 and distance.max() < 6.1


@pytest.mark.slow
def test_real_scans_are_followed(data, tmp_path, command):
    folder, poses = data / "kitti" / "sequences" / "04", tmp_path / "poses.txt"
    options = ["--method", "gicp", "--num-frames", "4", "--voxel-size", "0.5", "--pose-frame", "camera"]
    code, text, _ = command("odometry", "kitti", folder, *options, "--output", poses)
    assert code == 0 and "pairs:     3 of 3 converged" in text and number_after(text, "per pair: ") < 50
    # The benchmark's own poses are of camera 0, whose axes are not the scanner's.
    truth = io.read_poses(data / "kitti" / "poses" / "04.txt")[:4]
    np.testing.assert_allclose(io.read_poses(poses)[:, :3, 3], truth[:, :3, 3], atol=0.1)


@pytest.mark.parametrize("reason", ["frames[3]: ", "interrupted"])
def test_frames_before_an_invalid_one_are_written(tmp_path, command, monkeypatch, reason):
    def interrupted(*arguments, **options):
        yield from itertools.islice(odometry(*arguments, **options), 3)
        raise KeyboardInterrupt

    scans, poses, map, odometry = tmp_path / "scans", tmp_path / "poses.txt", tmp_path / "map.ply", mcg.odometry
    scans.mkdir()
    for k, frame in enumerate(datasets.box_room(3, points_per_frame=1500)):
        io.write(scans / f"{k}.npz", frame.cloud)
    last = PointCloud(np.eye(3), np.eye(3), channel_names=frame.cloud.channel_names)
    if reason == "interrupted":
        last = frame.cloud
        monkeypatch.setattr(mcg, "odometry", interrupted)
    io.write(scans / "3.npz", last)
    options = ["--method", "gicp", "--max-distance", "0.5", "--output", poses, "--map", map]
    code, text, errors = command("odometry", scans, *options)
    assert code == 1 and reason in errors and "3 of 4 frames" in errors
    assert "pairs:     2 of 2 converged" in text and len(io.read_poses(poses)) == 3 and len(io.read(map)) > 1000


@pytest.mark.skipif("tests.checks" in sys.modules, reason="checks of annotations read any frame of a sequence")
def test_a_second_frame_that_cannot_be_read_is_named(tmp_path, command):
    """Also where defaults depend on two clouds."""
    (frame,), poses = datasets.box_room(1, points_per_frame=1500), tmp_path / "poses.txt"
    io.write(tmp_path / "0.npz", frame.cloud)
    (tmp_path / "1.npz").write_bytes(b"nothing")
    code, text, errors = command("odometry", tmp_path, "--method", "color-icp", "--output", poses)
    assert code == 1 and "mcgicp: frame 1 (1.npz): " in errors and len(io.read_poses(poses)) == 1
    assert "pairs:     none were registered" in text and "errors:" not in text


@pytest.mark.slow
def test_cells_have_default_sizes(command):
    code, text, _ = command("odometry", "box-room", "--num-frames", "2", "--method", "ndt")
    assert code == 0 and "1 of 1 converged" in text


@pytest.mark.parametrize("method", [[], ["--method", "gicp"]])
def test_frames_without_common_channels_are_registered_by_gicp(tmp_path, command, method):
    for frame, names in zip(datasets.box_room(2, points_per_frame=2000), ("rgb", "uvw"), strict=True):
        io.write(tmp_path / f"{names}.npz", frame.cloud.replace(channel_names=list(names)))
    code, text, _ = command("odometry", tmp_path, *method)
    assert code == 0 and "1 of 1 converged" in text and "channels:  no" in text
