"""The command line, as a stranger meets it: exit codes, files, and messages of one line."""

import os
import re
import subprocess
import sys

import jax
import matplotlib.image
import numpy as np
import pytest
import scipy.spatial

import mcgicp_jax as mcg
from mcgicp_jax import io, metrics, plot
from mcgicp_jax._cli.options import with_flags
from mcgicp_jax.extend import COLOR_SPACES, DATASETS, FORMATS, KERNELS, METHODS
from tests.scenes import motion, room_corner

TRUTH = motion()


def save(path, points, channels=None, names=None):
    io.write(path, mcg.PointCloud(points, channels, channel_names=names))
    return str(path)


def moved_back(points):
    return (points - TRUTH[:3, 3]) @ TRUTH[:3, :3]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Source and target with an intensity, the source without, and the true pose."""
    folder = tmp_path_factory.mktemp("clouds")
    (points, channels), target = (room_corner(1000, seed=seed, channels=1) for seed in (1, 2))
    io.write_poses(folder / "truth.txt", [TRUTH])
    return {
        "source": save(folder / "source.npz", moved_back(points), channels, ["intensity"]),
        "target": save(folder / "target.ply", *target, ["intensity"]),
        "bare": save(folder / "bare.npz", moved_back(points)),
        "truth": str(folder / "truth.txt"),
    }


@pytest.fixture
def register(files, command):
    """Runs `mcgicp register` on two of these files; the exit code, output and errors."""
    return lambda *options, source="source": command("register", files.get(source, source), files["target"], *options)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["register", "compare", "odometry", "multiway", "batch"])
def test_all_commands_read_bin_files_of_given_columns(tmp_path, command, name):
    """x, y, z, intensity and time, which is no known layout."""
    scans = tmp_path / "scans"
    scans.mkdir()
    for seed in (1, 2):
        points, channels = room_corner(1000, seed=seed, channels=1)
        rows = np.column_stack([points, channels - channels.min(), np.linspace(0, 0.1, 1000)])
        rows.astype("<f4").tofile(scans / f"{seed}.bin")
    files = [scans / "2.bin", scans / "1.bin"] if name in ("register", "compare") else [scans]
    files += ["--output", tmp_path / "table.csv"] if name == "batch" else []
    for options, expected, told in (
        ([], 2, "--columns N; "),
        (["--columns", 5], 0, ""),
        (["--columns", 2], 2, "columns: expected"),
    ):
        code, _, errors = command(name, *files, *options)
        assert code == expected and told in errors


@pytest.mark.parametrize("name", ["odometry", "multiway", "batch"])
def test_a_cloud_without_finite_points_is_named(tmp_path, command, name):
    """Also where defaults depend on it."""
    points, channels = room_corner(1000)
    save(tmp_path / "0.npz", points, channels)
    save(tmp_path / "1.npz", np.full_like(points, np.nan), channels)
    options = ["--output", tmp_path / "table.csv"] if name == "batch" else []
    code, _, errors = command(name, tmp_path, *options, "--method", "ndt")
    assert code == 2 and "1.npz" in errors


def close_to_truth(pose, factor=1.0):
    return max(metrics.pose_error(pose, TRUTH)) < 0.01 * factor


def printed_matrix(text):
    return np.array([row.split() for row in text.split("T_target_source:\n")[1].splitlines()[:4]], float)


SLOW = ("photometric-gicp", "color-icp", "point-to-plane", "point-to-point", "ndt")


@pytest.mark.parametrize("method", ["mc-gicp", "gicp", *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_register_prints_the_pose(register, method):
    code, text, errors = register("--method", method)
    assert code == 0 and errors == ""
    # Points lie around the means of their cells.
    rmse = "rmse 0.1" if method == "ndt" else "rmse 0.0"
    assert all(part in text for part in (method, "CONVERGED", "1,000", rmse))
    assert close_to_truth(printed_matrix(text), factor=1 if "gicp" in method or "plane" in method else 4)


def test_register_writes_its_files(files, tmp_path, register):
    paths = [tmp_path / name for name in ("pose.txt", "aligned.ply", "picture.png")]
    outputs = ["--output", paths[0], "--aligned", paths[1], "--plot", paths[2]]
    code, text, _ = register("--voxel-size", "0.1", *outputs)
    assert code == 0 and all(str(path) in text for path in paths)
    (written,) = io.read_poses(paths[0])
    np.testing.assert_allclose(written, printed_matrix(text), atol=1e-8)
    source, moved = io.read(files["source"]), io.read(paths[1])
    # All points, not the voxels
    np.testing.assert_allclose(moved.points, source.points @ written[:3, :3].T + written[:3, 3], atol=1e-6)
    np.testing.assert_array_equal(moved.channels, source.channels)
    assert matplotlib.image.imread(paths[2]).ndim == 3


@pytest.mark.slow
def test_the_start_is_used_and_drawn(files, monkeypatch, tmp_path, register):
    drawn = {}
    monkeypatch.setattr(plot, "before_after", lambda source, target, poses, path: drawn.update(poses))
    code, text, _ = register("--init", files["truth"], "--plot", "x.png", "--method", "gicp")
    assert code == 0
    np.testing.assert_allclose(drawn["start"], TRUTH)
    np.testing.assert_allclose(drawn["gicp"], printed_matrix(text), atol=1e-8)
    drawn.clear()
    # A right pose that so few points do not verify.
    code, text, _ = register("--init", "global", "--plot", "x.png")
    assert code == 1 and "status:    UNVERIFIED" in text and "start" not in drawn
    io.write_poses(tmp_path / "far.txt", [motion((50, 0, 0, 0, 0, 0))])
    assert register("--init", tmp_path / "far.txt")[0] == 1


def test_numbers_reach_the_method(register):
    numbers = ["--channel-covariance", "0.25", "--channel-weights", "0.5", "--epsilon", "0.01"]
    for method, options in (("mc-gicp", numbers), ("color-icp", numbers[2:4])):
        code, text, _ = register("--method", method, *options)
        named = [
            f"{name[2:].replace('-', '_')} {value}" for name, value in zip(options[::2], options[1::2], strict=True)
        ]
        assert code == 0 and ", ".join([method, *named]) + "\n" in text


def test_what_does_not_converge_is_no_success(files, tmp_path, command):
    far = save(tmp_path / "far.npz", room_corner(1000)[0] + 100)
    flat = save(tmp_path / "flat.npz", np.random.default_rng(0).random((500, 3)) * [1, 1, 0])
    for arguments, status in (
        ([far, files["target"], "--method", "gicp"], "TOO_FEW_CORRESPONDENCES"),
        ([files["source"], files["target"], "--max-iterations", "1"], "MAX_ITERATIONS"),
        ([flat, flat, "--method", "point-to-plane"], "unconstrained"),
    ):
        code, text, errors = command("register", *arguments)
        assert code == 1 and "status: " in text and errors.startswith("mcgicp: ") and status in errors
        assert "rmse nan" not in text


@pytest.mark.slow
def test_compare(files, command):
    code, text, _ = command("compare", files["source"], files["target"], "--truth", files["truth"])
    rows = [line.split() for line in text.splitlines() if line.endswith("CONVERGED") or line.startswith("(start)")]
    table = {row[0]: row for row in rows}
    start = table.pop("(start)")
    assert code == 0 and list(table) == list(METHODS)
    middle = np.asarray(io.read(files["source"]).points).mean(axis=0)
    assert float(start[1]) == pytest.approx(1e3 * metrics.pose_error(np.eye(4), TRUTH, at=middle)[0], abs=0.01)
    assert float(table["gicp"][1]) < 10 < float(start[1]) and float(table["gicp"][2]) < 0.6 < float(start[2])
    # Without channels or truth.
    code, text, errors = command("compare", files["bare"], files["target"], "--max-iterations", "1")
    assert code == 1 and "error" not in text and text.count("left out") == 4
    # Methods of one status share a line.
    assert errors.count(": MAX_ITERATIONS: ") == 1


@pytest.mark.slow
def test_compare_leaves_out_methods_that_refuse_the_clouds(tmp_path, command):
    """Of sixty points, cells of six are too few."""
    names = [save(tmp_path / f"{seed}.npz", *room_corner(60, seed=seed)) for seed in (0, 1)]
    lines = command("compare", *names)[1].splitlines()
    assert sum("left out: " in line and "4 cells of 6 points" in line for line in lines) == 3
    assert any(line.startswith("gicp ") and line.endswith("CONVERGED") for line in lines)


@pytest.mark.slow
def test_demo(tmp_path, command):
    folder = tmp_path / "some" / "folder"
    code, text, errors = command("demo", "--output", folder)
    assert code == 0 and errors == "" and str(folder / "before_after.png") in text
    assert min(matplotlib.image.imread(folder / "before_after.png").shape[:2]) > 500
    error = {line.split()[0]: float(line.split()[1]) for line in text.split("status\n")[1].splitlines()[:5]}
    assert error["mc-gicp"] < 5 and error["color-icp"] < 10
    # What the text says: geometry slides.
    assert min(error["gicp"], error["point-to-plane"]) > 20
    (truth,), source = io.read_poses(folder / "truth.txt"), io.read(folder / "source.npz")
    start = metrics.pose_error(np.eye(4), truth, at=source.points.mean(axis=0))[0]
    assert 1e3 * start == pytest.approx(error["(start)"], abs=0.01) and len(source) > 10_000


def test_common_channels_are_used(files, tmp_path, register):
    cloud = io.read(files["source"])
    junk = np.random.default_rng(0).normal(size=(len(cloud), 1))
    several = save(tmp_path / "several.npz", cloud.points, np.hstack([junk, cloud.channels]), ["humidity", "intensity"])
    (code, text, _), (again, other, _) = register(), register(source=several)
    assert code == again == 0 and "channels:  intensity\n" in text and "several.npz has humidity, intensity" in other
    np.testing.assert_allclose(printed_matrix(other), printed_matrix(text), atol=1e-6)


def test_no_common_channels_is_said(register):
    # The last before the search for a pose, which takes seconds.
    for options in (["mc-gicp"], ["color-icp"], ["mc-gicp", "--init", "global"]):
        code, text, error = register("--method", *options, source="bare")
        assert code == 2 and "start:" not in text
        assert all(part in error for part in ("bare.npz", "target.ply has intensity", "--method gicp"))


def test_clouds_without_channels_in_common_are_registered_by_gicp(register, command, tmp_path):
    code, text, errors = register(source="bare")
    assert code == 0 and errors == "" and "\nmethod:    gicp, epsilon" in text
    assert text.count("no channels in common, therefore gicp") == 1
    code, _, errors = register("--channel-weights", "1", source="bare")
    assert code == 2 and "gicp has no --channel-weights" in errors
    folder = tmp_path / "clouds"
    folder.mkdir()
    for k in range(2):
        save(folder / f"{k}.npz", room_corner(1000, seed=k)[0])
    for arguments in (["batch", folder, "--output", tmp_path / "table.csv"], ["multiway", folder]):
        code, text, errors = command(*arguments)
        assert code == 0 and errors == "" and text.count("no channels in common, therefore gicp") == 1


@pytest.mark.slow
@pytest.mark.parametrize("count", [60_000, 5000])
def test_voxels_are_chosen_from_the_data(tmp_path, command, count):
    points = room_corner(count, noise=0.002)[0]
    half, whole = save(tmp_path / "half.npz", points[::2]), save(tmp_path / "whole.npz", points)
    first, *lines = command("register", half, whole, "--method", "point-to-plane")[1].splitlines()
    cloud = mcg.preprocess(io.read(whole))
    assert f"target {len(cloud):,} " in first and str(cloud.voxels) in first
    (second,) = (line for line in lines if line.startswith("matches:"))
    distances = [float(part.split()[0]) for part in second.split("up to ")[1].split("then")]
    near, far = np.median(scipy.spatial.cKDTree(cloud.points).query(cloud.points, k=(2, 20))[0], axis=0)
    # The command takes the median of 4,096 points, whose standard error is 1 %.
    np.testing.assert_allclose(distances, [10 * max(near, np.sqrt(np.pi / 20) * far), 2.5 * near], rtol=0.03)


def test_wrong_input_gets_one_line(tmp_path, command):
    good, nan = save(tmp_path / "good.npz", room_corner(200)[0]), save(tmp_path / "nan.npz", np.full((9, 3), np.nan))
    (tmp_path / "cut.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\n")
    io.write_poses(tmp_path / "two.txt", [TRUTH, TRUTH])
    np.savetxt(tmp_path / "scaled.txt", 2 * np.eye(4))
    wrong = (("epsilon", -1), ("voxel-size", -1), ("num-neighbors", 1), ("max-distance", 0), ("max-iterations", 0))
    for arguments, message in (
        ([tmp_path / "nowhere.ply", good], "nowhere.ply: "),
        ([good, tmp_path / "cut.ply"], "cut.ply: "),
        ([tmp_path, good], str(tmp_path)),
        ([good, nan], "nan.npz: "),
        *(([good, good, "--init", path], str(path)) for path in (good, tmp_path / "two.txt", tmp_path / "scaled.txt")),
        ([good, good, "--channel-weights", 1], "gicp has no --channel-weights"),
        *(([good, good, f"--{name}", value], f"mcgicp: --{name}: ") for name, value in wrong),
        ([good, good, "--max-source-points", 3], "mcgicp: --max-source-points: "),
        ([good, good, "--aligned", tmp_path / "out.doc"], "'.doc'"),
        ([good, good, "--output", tmp_path / "no" / "pose.txt"], "pose.txt"),
        ([good, good, "--output", tmp_path], f"{tmp_path}: "),
        ([good, good, "--output", tmp_path / "moved.ply"], "moved.ply: expected a text file"),
        ([good, good, "--output", tmp_path / "a.txt", "--aligned", tmp_path / "a.txt"], "output: "),
        ([good, good, "--aligned", good], f"{good}: expected a file outside of the input"),
        ([good, good, "--plot", tmp_path / "picture.doc"], "picture.doc: "),
    ):
        code, text, errors = command("register", *arguments, "--method", "gicp")
        assert code == 2 and errors.startswith("mcgicp: ") and errors.count("\n") == 1 and message in errors, errors
        # It is found before any work is done.
        assert text == ""
    code, _, errors = command("compare", good, good, "--truth", tmp_path / "no.txt")
    assert code == 2 and errors.startswith("mcgicp: --truth: ")


def test_messages_have_options_of_the_command_line():
    for message, expected in (
        ('max_distance=(1, 0.2) or init="global"', "--max-distance 1 0.2 or --init global"),
        ("try another max_distance; use equalize_channels=True", "try another --max-distance; use --equalize-channels"),
        ("recover=True finds lost frames again", "--recover finds lost frames again"),
        ("max_distance: expected columns=N", "--max-distance: expected --columns N"),
        *((text, text) for text in ("no channels in common", "/a/max_distance/b: cut", "max_distance.ply: cut")),
        *((text, text) for text in ("channels=3.npz: cut", "max_distance=(1, 0.2).npz: cut (at 3)", "columns=3: cut")),
    ):
        assert with_flags(message) == expected


def test_a_missing_package_is_named(register, monkeypatch):
    monkeypatch.setitem(sys.modules, "plyfile", None)
    code, _, errors = register()
    assert code == 2 and "mcgicp_jax[io]" in errors


def test_points_left_out_are_reported_in_one_line(files, tmp_path, register):
    path = save(tmp_path / "nan.npz", np.vstack([io.read(files["bare"]).points, [[np.nan, 0, 0]]]))
    code, _, errors = register("--method", "gicp", source=path)
    assert code == 0 and errors.startswith(f"mcgicp: {path}: left out 1 of 1001") and errors.count("\n") == 1


def test_help_lists_the_registries(command, capsys):
    """A method, kernel, colour space, format or data set that is registered is an option, with its defaults."""
    for name, registered in (("register", (METHODS, KERNELS, COLOR_SPACES, FORMATS)), ("odometry", (DATASETS,))):
        with pytest.raises(SystemExit):
            command(name, "--help")
        text = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert "None" not in text and not [option for names in registered for option in names if option not in text]
    for dataset in DATASETS.values():
        assert f"{dataset.max_distance[0]:g} and {dataset.max_distance[1]:g} for " in text


def test_a_kernel_is_an_option(register, capsys):
    texts = [
        register("--method", "gicp", *options, source="bare")[1] for options in ([], ["--robust", "cauchy", "0.5"])
    ]
    without, robust = map(printed_matrix, texts)
    assert close_to_truth(without) and close_to_truth(robust) and np.abs(without - robust).max() > 1e-6
    for options in (["huber"], ["hubr", "1"], ["huber", "x"]):
        with pytest.raises(SystemExit):
            register("--robust", *options)
        errors = re.sub(r"[\s│]+", " ", capsys.readouterr().err)
        assert f"and a scale, such as huber 1.0; got {' '.join(options)} " in errors


def test_an_unwritable_cache_is_no_error(register, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    before = jax.config.jax_compilation_cache_dir
    code, _, errors = register("--method", "gicp", source="bare")
    assert code == 0 and errors == "" and jax.config.jax_compilation_cache_dir == before


@pytest.mark.slow
def test_compiled_programs_are_kept(files, tmp_path):
    """As its own process, started in an empty folder with an empty home."""
    hidden = {"JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"}
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    environment |= {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    command = [sys.executable, "-m", "mcgicp_jax", "register", files["source"], files["target"], "--output", "pose.txt"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    # A slow machine has a line about the compilation.
    others = [line for line in done.stderr.splitlines() if "compiling" not in line]
    assert (done.returncode, others) == (0, [])
    assert close_to_truth(io.read_poses(tmp_path / "pose.txt")[0])
    assert len(list((tmp_path / "cache" / "mcgicp_jax").iterdir())) > 5


@pytest.mark.slow
def test_a_reader_that_ends_early_is_no_error():
    """As in `mcgicp register --help | head`."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "mcgicp_jax", "register", "--help"]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, timeout=120)
    os.close(writer)
    assert done.stderr == ""


@pytest.mark.slow
def test_fixed_directions(register, tmp_path):
    start = TRUTH @ motion((0, 0, 0.02, 0.01, 0, 0))
    io.write_poses(tmp_path / "start.txt", [start])
    command = ["--method", "gicp", "--init", str(tmp_path / "start.txt"), "--fix"]
    code, text, _ = register(*command, "roll", "pitch", "--fix", "z")
    change = np.linalg.inv(start) @ printed_matrix(text)
    assert code == 0 and np.abs(change[2] - [0, 0, 1, 0]).max() < 1e-6
    with pytest.raises(SystemExit, match="2"):
        register(*command, "north")
