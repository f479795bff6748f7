"""Readers of data sets, on files written in their form and on the real ones."""

import shutil

import numpy as np
import pytest
import scipy.io
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mcgicp_jax import io, metrics
from mcgicp_jax.datasets import Frame, clouds, ford_campus, kitti, seven_scenes, tum_rgbd
from tests.refusals import refused
from tests.scenes import motion


def ramp(height, width):
    """An image whose values identify its pixels: red goes with the column, green with the row; blue is 51."""
    row, column = np.mgrid[:height, :width]
    return np.stack([255 * column / (width - 1), 255 * row / (height - 1), np.full(row.shape, 51)], axis=-1)


def save_image(path, array):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(array)).save(path)


def colors_differ(first, second, reach):
    """Mean difference of the colours of points that lie at the same place in the world."""

    def colored(frame):
        cloud = frame.cloud.transform(frame.pose)
        rows = slice(None) if cloud.channel_valid is None else cloud.channel_valid[:, -1]
        return cloud.points[rows], cloud.channels[rows, -3:]

    (points, colors), (others, other_colors) = colored(first), colored(second)
    chosen = np.random.default_rng(0).permutation(len(points))[:20_000]
    distance, nearest = cKDTree(others).query(points[chosen])
    return np.abs(colors[chosen] - other_colors[nearest])[distance < reach].mean()


# KITTI

CALIBRATION = {"P0": [100, 0, 50, 0, 0, 100, 20, 0, 0, 0, 1, 0], "P2": [100, 0, 50, 35, 0, 100, 20, 0, 0, 0, 1, 0]}
# From x ahead, y left, z up to x right, y down, z ahead.
TO_CAMERA = [0, -1, 0, 0, 0, 0, -1, 0, 1, 0, 0, -0.5]


@pytest.fixture
def kitti_folder(tmp_path):
    """Scans 3 and 4 of sequence 77: the one ahead of the camera, the other all around."""
    folder = tmp_path / "sequences" / "77"
    (folder / "velodyne").mkdir(parents=True)
    ahead = [[10.5, 0, 0, 0.1], [10.5, 3, 1, 0.2], [5.5, -2, -0.5, 0.3], [-10.5, 0, 0, 0.4], [10.5, 9, 0, 0.5]]
    around = np.random.default_rng(0).uniform([-20, -20, -20, 0], 20, (50, 4))
    for number, scan in ((3, ahead), (4, around)):
        np.asarray(scan, "<f4").tofile(folder / "velodyne" / f"{number:06d}.bin")
        save_image(folder / "image_2" / f"{number:06d}.png", ramp(41, 101).astype(np.uint8))
    lines = [f"{name}: {' '.join(map(str, row))}" for name, row in (CALIBRATION | {"Tr": TO_CAMERA}).items()]
    (folder / "calib.txt").write_text("\n".join([*lines, "calib_time: 09-Jan-2012"]))
    np.savetxt(folder / "times.txt", 0.1 * np.arange(6))
    (tmp_path / "poses").mkdir()
    io.write_poses(tmp_path / "poses" / "77.txt", [motion((i, 0, 0.1 * i, 0, 0.02 * i, 0)) for i in range(6)])
    return folder


def test_kitti_points_get_the_color_of_their_pixel(kitti_folder):
    (kitti_folder / "velodyne" / "of no number.bin").touch()
    first, _ = kitti(kitti_folder)
    assert first.cloud.channel_names == ("intensity", "red", "green", "blue")
    np.testing.assert_allclose(first.cloud.channels[:, 0], [0.1, 0.2, 0.3, 0.4, 0.5], atol=1e-6)
    # Depth 10 and 5; u = (100 x + 50 z + 35) / z, with x = −y of the scan; v = 100 y / z + 20, with y = −z of the scan.
    # The first two lie half way between pixels.
    image = ramp(41, 101).astype(np.uint8) / 255
    expected = [image[20, 53:55].mean(axis=0), image[10, 23:25].mean(axis=0), image[30, 97]]
    np.testing.assert_allclose(first.cloud.channels[:3, 1:], expected, atol=1e-6)
    np.testing.assert_array_equal(first.cloud.channel_valid, [[True] * 4] * 3 + [[True, False, False, False]] * 2)


def test_kitti_times_and_poses_go_by_the_number_of_the_scan(kitti_folder):
    first, second = kitti(str(kitti_folder))
    assert [first.time, second.time] == pytest.approx([0.3, 0.4])
    to_camera = np.vstack([np.reshape(TO_CAMERA, (3, 4)), [0, 0, 0, 1]])
    expected = np.linalg.inv(to_camera) @ motion((4, 0, 0.4, 0, 0.08, 0)) @ to_camera
    np.testing.assert_allclose(second.pose, expected, atol=1e-9)
    # A step of the camera ahead is one of the Velodyne ahead.
    np.testing.assert_allclose(first.pose[:3, 3], [0.3, -3, 0], atol=0.1)
    shutil.rmtree(kitti_folder.parents[1] / "poses")
    shutil.rmtree(kitti_folder / "image_2")
    bare = kitti(kitti_folder)[0]
    assert bare.pose is None and bare.cloud.channel_names == ("intensity",) and bare.cloud.channel_valid is None


def test_real_kitti_scans_have_the_colors_of_the_road(data):
    frames = kitti(data / "kitti" / "sequences" / "04")
    assert len(frames) == 10
    first, second = frames[:2]
    assert np.mean(first.cloud.channel_valid[:, 1]) == pytest.approx(0.16, abs=0.02)
    np.testing.assert_allclose((np.linalg.inv(first.pose) @ second.pose)[:3, 3], [1.31, 0, 0], atol=0.05)
    assert second.time - first.time == pytest.approx(0.104, abs=0.01)
    # Where the two see the same spot it has the same colour, more so than in the colours of other pixels.
    right = colors_differ(first, second, 0.1)
    swapped = Frame(second.cloud.replace(channels=second.cloud.channels[::-1]), second.pose)
    assert right < 0.07 and right < 0.5 * colors_differ(first, swapped, 0.1)


# TUM RGB-D


@pytest.fixture
def tum_folder(tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg2_made_up"
    depth = np.zeros((480, 640), np.uint16)
    depth[100, 200], depth[300, 400] = 5000, 10_000
    for name in ("1.0", "1.1", "1.2"):
        save_image(folder / "depth" / f"{name}.png", depth)
        save_image(folder / "rgb" / f"{name}.png", ramp(480, 640).astype(np.uint8))
    (folder / "depth.txt").write_text("# depth maps\n1.000 depth/1.0.png\n1.100 depth/1.1.png\n1.200 depth/1.2.png\n")
    # One is too far in time from any; they are not in step.
    (folder / "rgb.txt").write_text("# colour\n0.985 rgb/1.0.png\n1.111 rgb/1.1.png\n1.300 rgb/1.2.png\n")
    poses = [motion((0.1 * i, 0, 0, 0, 0, 0.2 * i)) for i in range(3)]
    io.write_poses(folder / "groundtruth.txt", poses, [0.96, 1.04, 1.09])
    return folder


def test_tum_frames_are_put_together_by_time(tum_folder):
    first, second = tum_rgbd(tum_folder)
    assert [first.time, second.time] == [1.0, 1.1]
    pixels, depth = np.array([[200, 100], [400, 300]]), np.array([[1], [2]])
    rays = (pixels - [325.1, 249.7]) / [520.9, 521.0]
    np.testing.assert_allclose(first.cloud.points, np.hstack([depth * rays, depth]), rtol=1e-5)
    np.testing.assert_allclose(first.cloud.channels[:, :2], pixels / [639, 479], atol=0.005)
    assert first.cloud.channel_valid is None
    # Half way between two poses; and beyond the last of them.
    np.testing.assert_allclose(first.pose, motion((0.05, 0, 0, 0, 0, 0.1)), atol=1e-9)
    assert second.pose is None
    # Between two poses more than 0.1 s apart, the motion is not known.
    io.write_poses(tum_folder / "groundtruth.txt", [np.eye(4)] * 2, [0.93, 1.04])
    assert tum_rgbd(tum_folder)[0].pose is None
    (tum_folder / "groundtruth.txt").unlink()
    assert tum_rgbd(tum_folder)[0].pose is None


def test_the_real_tum_pair_in_the_layout_of_the_data_set(data, tmp_path):
    real, folder = data / "tum_fr1_xyz", tmp_path / "rgbd_dataset_freiburg1_xyz"
    shutil.copytree(real, folder)
    (folder / "depth.txt").write_text("0 dep_prev.png\n1 dep_curr.png\n")
    (folder / "rgb.txt").write_text("0.01 img_prev.png\n1.01 img_curr.png\n")
    rows = [f"{i} {(real / f'pose_{name}.txt').read_text().strip()}\n" for i, name in enumerate(("prev", "curr"))]
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "".join(rows))
    target, source = tum_rgbd(folder)
    shift, turn = metrics.pose_error(source.pose, target.pose)
    assert 0.01 < shift < 0.05 and turn < 0.05 and len(source.cloud) > 150_000
    # The measured poses make the colours agree; moved poses do not.
    right = colors_differ(source, target, 0.01)
    for axis in range(2):
        moved = Frame(source.cloud, source.pose @ motion(0.03 * np.eye(6)[axis]))
        assert right < 0.8 * colors_differ(moved, target, 0.01)


# 7-Scenes


def test_real_frames_of_7_scenes(data):
    folder = data / "sevenscenes_redkitchen"
    first, *_, last = frames = seven_scenes(folder)
    assert len(frames) == 5 and [frame.time for frame in frames] == pytest.approx([n / 30 for n in range(560, 581, 5)])
    np.testing.assert_allclose(first.pose, np.loadtxt(folder / "frame-000560.pose.txt"), atol=1e-4)
    assert 200_000 < len(first.cloud) < 307_200
    assert np.mean(first.cloud.channel_valid) > 0.99
    assert colors_differ(first, last, 0.005) < 0.072


def test_7_scenes_know_where_there_is_no_depth_and_no_color(tmp_path):
    depth = np.full((480, 640), 65535, np.uint16)
    depth[240, 320], depth[0, 0], depth[100, 100], depth[50, 2] = 2000, 0, 1000, 300
    save_image(tmp_path / "frame-000030.depth.png", depth)
    save_image(tmp_path / "frame-000030.color.png", ramp(480, 640).astype(np.uint8))
    np.savetxt(tmp_path / "frame-000030.pose.txt", motion())
    (frame,) = seven_scenes(tmp_path)
    assert len(frame.cloud) == 3 and frame.time == pytest.approx(1)
    np.testing.assert_allclose(sorted(frame.cloud.points[:, 2]), [0.3, 1, 2])
    np.testing.assert_allclose(frame.pose, motion(), atol=1e-9)
    ahead = np.argmax(frame.cloud.points[:, 2])
    np.testing.assert_allclose(frame.cloud.points[ahead], [0, 0, 2])
    # 26 mm aside at 2 m, and turned by 0.45°.
    expected = 320 + 525 * (2 * -0.0079041 - 0.025559) / 2.0018
    assert 639 * frame.cloud.channels[ahead, 0] == pytest.approx(expected, abs=2.6)
    # So near, the colour camera looks past the corner.
    assert not frame.cloud.channel_valid[np.argmin(frame.cloud.points[:, 2])].any()
    (tmp_path / "frame-000030.depth.png").write_bytes(b"no image")
    refused(lambda: seven_scenes(tmp_path)[0], str(tmp_path / "frame-000030.depth.png"))


# Ford Campus


@pytest.fixture
def ford_folder(tmp_path):
    """Two scans of five points; cameras 1 and 3 of five see some of them; the second scan is too late for an image."""
    folder = tmp_path / "ford"
    (folder / "SCANS").mkdir(parents=True)
    cameras = [
        {"points_index": np.zeros((1, 0)), "pixels": np.zeros((2, 0)), "xyz": np.zeros((3, 0))} for _ in range(5)
    ]
    cameras[1] |= {"points_index": np.array([[1, 3]]), "pixels": np.array([[1.0, 1616], [1.5, 1231.5]])}
    cameras[3] |= {"points_index": np.array([[3, 5]]), "pixels": np.array([[1.0, 809], [1.5, 617.5]])}
    records = np.array([[tuple(camera.values()) for camera in cameras]], [(name, object) for name in cameras[0]])
    # The second has reflectances, too.
    for number, late, more in ((75, 0.0, {}), (76, 1e6, {"reflectivity": np.array([[9.0, 8, 7, 6, 5]])})):
        scan = {
            "XYZ": np.array([[1.0, 2, 3, 4, 5], [0, 1, 0, 1, 0], [0.5, 0.5, 0.5, 0.5, -0.5]]),
            "X_wv": np.array([[10.0], [20], [-1], [0.1], [0.2], [0.3]]),
            "timestamp_camera": 1.2e9 * 1e6 + 30_000 + late,
            "timestamp_laser": 1.2e9 * 1e6 + late,
            "image_index": 0,
            "Cam": records,
        }
        scipy.io.savemat(folder / "SCANS" / f"Scan{number:04d}.mat", {"SCAN": scan | more})
    for camera in range(5):
        save_image(folder / "IMAGES" / f"Cam{camera}" / "image0011.ppm", ramp(616, 1616).astype(np.uint8))
    (folder / "Timestamp.log").write_text(
        "frame curr_timestamp_sync\n10 1199999999900000 1 2\n11 1200000000020000 1 2\n12 1200000000140000 1 2\n"
    )
    return folder


def test_ford_scans_are_colored_by_the_image_of_their_time(ford_folder):
    first, second = ford_campus(ford_folder)
    cloud, late = first.cloud, second.cloud
    assert cloud.channel_names == ("red", "green", "blue")
    np.testing.assert_allclose(cloud.points[:, 0], [1, 2, 3, 4, 5])
    np.testing.assert_array_equal(cloud.channel_valid[:, 0], [True, False, True, False, True])
    # The corners of the image; the third point is seen by two cameras, of which the first counts.
    np.testing.assert_allclose(cloud.channels[[0, 2, 4], :2], [[0, 0], [1, 1], [808 / 1615, 308 / 615]], atol=0.005)
    assert second.time - first.time == pytest.approx(1)
    assert late.channel_names == ("intensity", "red", "green", "blue")
    np.testing.assert_allclose(late.channels[:, 0], [9, 8, 7, 6, 5])
    assert late.channel_valid[:, 0].all() and not late.channel_valid[:, 1:].any()
    # Without images, the points alone.
    for remove in (lambda: shutil.rmtree(ford_folder / "IMAGES"), (ford_folder / "Timestamp.log").unlink):
        remove()
        assert not ford_campus(ford_folder)[0].cloud.channel_valid.any()


def test_ford_poses_are_those_of_the_laser(ford_folder):
    vehicle, laser = np.eye(4), np.eye(4)
    vehicle[:3, :3] = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix()
    # The laser's axes: ahead is the vehicle's right ... its z axis is up, the vehicle's is down.
    laser[:3, :3] = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]
    vehicle[:3, 3], laser[:3, 3] = [10, 20, -1], [2.4, -0.01, -2.3]
    np.testing.assert_allclose(ford_campus(ford_folder)[0].pose, vehicle @ laser, atol=1e-9)


@pytest.mark.parametrize(
    ("reader", "file", "content"),
    [
        (kitti, "calib.txt", b"P2: 1 2 3\n"),
        (kitti, "times.txt", b"0.1\nlater\n"),
        (tum_rgbd, "rgb.txt", b"9.0\n"),
        (tum_rgbd, "rgb.txt", b"# colour\n"),
        (tum_rgbd, ".", b"9.0 rgb/1.0.png\n"),
        (ford_campus, "SCANS/Scan0075.mat", b"no such thing"),
        (ford_campus, "Timestamp.log", b"nothing\n"),
    ],
)
def test_a_broken_file_of_a_data_set_is_named(request, reader, file, content):
    folder = request.getfixturevalue(f"{reader.__name__.split('_')[0]}_folder")
    (folder / ("rgb.txt" if file == "." else file)).write_bytes(content)
    refused(lambda: reader(folder)[0], str(folder / file))


@pytest.mark.parametrize("reader", [kitti, tum_rgbd, seven_scenes, ford_campus, clouds])
def test_a_folder_without_a_data_set_is_named(tmp_path, reader):
    with pytest.raises((ValueError, FileNotFoundError), match="nothing"):
        reader(tmp_path / "nothing")


def test_a_folder_of_clouds(tmp_path):
    rng = np.random.default_rng(0)
    points, poses = rng.normal(size=(50, 3)), [motion(rng.normal(size=6)) for _ in range(5)]
    normals = rng.normal(size=(50, 3))
    seven = np.hstack([points, normals / np.linalg.norm(normals, axis=1)[:, None], rng.uniform(0, 0.01, (50, 1))])
    rows = {
        "2.xyz": points,
        "10.txt": np.hstack([points, rng.normal(size=(50, 9))]),
        "11.txt": seven,
        "12.txt": np.insert(seven, 3, 0.5, axis=1),
        "14.npy": points,
        "matrix.txt": poses[0],
        "matrix.npy": poses[0],
        "poses.npy": poses,
    }
    texts = {
        "16.ply": "broken",
        "calibration.txt": "P0: 1 0 0 0\n",
        "empty.txt": "",
        "picture.png": "",
        "table.csv": "source,target\na.ply,b.ply\n",
        "times.txt": "0.0\n0.1\n",
        ".hidden.ply": "",
    }
    for name, array in rows.items():
        (np.save if name.endswith(".npy") else np.savetxt)(tmp_path / name, array)
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    np.savez(tmp_path / "15.npz", points=points)
    np.savez(tmp_path / "table.npz", T_target_source=poses)
    io.write_poses(tmp_path / "kitti.txt", poses)
    io.write_poses(tmp_path / "tum.txt", poses, np.arange(5.0))
    (tmp_path / "folder.ply").mkdir()
    frames = clouds(tmp_path)
    assert [path.stem for path in frames.paths] == ["2", "10", "11", "12", "14", "15", "16"]
    names = {path.name for path in tmp_path.iterdir()} - {".hidden.ply", "folder.ply"}
    assert {path.name for path in frames.left_out} == names - {path.name for path in frames.paths}
    np.testing.assert_allclose(frames[0].cloud.points, points)
    assert frames[0].pose is None and len(clouds(tmp_path, "*.npz")) == 1
    refused(lambda: frames[-1], str(tmp_path / "16.ply"))
    refused(lambda: clouds(tmp_path, "*.las"), str(tmp_path), "*.las")
