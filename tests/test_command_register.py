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
from mcgicp_jax.__main__ import main
from mcgicp_jax._cli.flags import with_flags
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
    points, channels = room_corner(1000, seed=1, channels=1)
    target_points, target_channels = room_corner(1000, seed=2, channels=1)
    io.write_poses(folder / "truth.txt", [TRUTH])
    return {
        "source": save(folder / "source.npz", moved_back(points), channels, ["intensity"]),
        "target": save(folder / "target.ply", target_points, target_channels, ["intensity"]),
        "bare": save(folder / "bare.npz", moved_back(points)),
        "truth": str(folder / "truth.txt"),
        "folder": folder,
    }


@pytest.fixture
def register(files, capsys):
    """Runs the command on two of these files; the exit code, output and errors."""

    def run(*options, source="source"):
        code = main(["register", files.get(source, source), files["target"], *options])
        return code, *capsys.readouterr()

    return run


@pytest.mark.slow
@pytest.mark.parametrize("command", ["register", "compare", "odometry", "multiway", "batch"])
def test_all_commands_read_bin_files_of_given_columns(tmp_path, capsys, command):
    """x, y, z, intensity and time, which is no known layout."""
    scans = tmp_path / "scans"
    scans.mkdir()
    for seed in (1, 2):
        points, channels = room_corner(1000, seed=seed, channels=1)
        rows = np.column_stack([points, channels - channels.min(), np.linspace(0, 0.1, 1000)])
        rows.astype("<f4").tofile(scans / f"{seed}.bin")
    files = [str(scans / "2.bin"), str(scans / "1.bin")] if command in ("register", "compare") else [str(scans)]
    options = ["--output", str(tmp_path / "table.csv")] if command == "batch" else []
    assert main([command, *files, *options]) == 2
    assert "--columns N; " in capsys.readouterr().err
    assert main([command, *files, *options, "--columns", "5"]) == 0
    assert main([command, *files, *options, "--columns", "2"]) == 2
    assert "columns: expected" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["odometry", "multiway", "batch"])
def test_a_cloud_without_finite_points_is_named(tmp_path, capsys, command):
    """Also where defaults depend on it."""
    points, channels = room_corner(1000)
    io.write(tmp_path / "0.npz", mcg.PointCloud(points, channels))
    io.write(tmp_path / "1.npz", mcg.PointCloud(np.full_like(points, np.nan), channels))
    options = ["--output", str(tmp_path / "table.csv")] if command == "batch" else []
    assert main([command, str(tmp_path), *options, "--method", "ndt"]) == 2
    assert "1.npz" in capsys.readouterr().err


def close_to_truth(pose, factor=1.0):
    translation, rotation = metrics.pose_error(pose, TRUTH)
    return translation < 0.01 * factor and rotation < 0.01 * factor


def printed_matrix(text):
    rows = text.split("T_target_source:\n")[1].splitlines()[:4]
    return np.array([row.split() for row in rows], float)


@pytest.mark.parametrize(
    "method",
    [
        "mc-gicp",
        "gicp",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("photometric-gicp", "color-icp", "point-to-plane", "point-to-point", "ndt")
        ),
    ],
)
def test_register_prints_the_pose(register, method):
    code, text, errors = register("--method", method)
    assert code == 0 and errors == ""
    # Points lie around the means of their cells.
    rmse = "rmse 0.1" if method == "ndt" else "rmse 0.0"
    assert all(part in text for part in (method, "CONVERGED", "1,000", rmse))
    assert close_to_truth(printed_matrix(text), factor=1 if "gicp" in method or "plane" in method else 4)


def test_register_writes_its_files(files, tmp_path, capsys):
    pose, aligned, picture = tmp_path / "pose.txt", tmp_path / "aligned.ply", tmp_path / "picture.png"
    outputs = ["--output", str(pose), "--aligned", str(aligned), "--plot", str(picture)]
    assert main(["register", files["source"], files["target"], "--voxel-size", "0.1", *outputs]) == 0
    text = capsys.readouterr().out
    (written,) = io.read_poses(pose)
    np.testing.assert_allclose(written, printed_matrix(text), atol=1e-8)
    source, moved = io.read(files["source"]), io.read(aligned)
    # All points, not the voxels
    np.testing.assert_allclose(moved.points, source.points @ written[:3, :3].T + written[:3, 3], atol=1e-6)
    np.testing.assert_array_equal(moved.channels, source.channels)
    assert matplotlib.image.imread(picture).ndim == 3
    assert all(str(path) in text for path in (pose, aligned, picture))
    # The pose is one to start from: few updates are needed.
    again = ["register", files["source"], files["target"], "--init", str(pose), "--max-iterations", "4"]
    assert main(again) == 0


@pytest.mark.slow
def test_the_start_is_used_and_drawn(files, monkeypatch, tmp_path, capsys):
    drawn = {}
    monkeypatch.setattr(plot, "before_after", lambda source, target, poses, path: drawn.update(poses))
    options = ["--init", files["truth"], "--plot", "x.png", "--method", "gicp"]
    assert main(["register", files["source"], files["target"], *options]) == 0
    np.testing.assert_allclose(drawn["start"], TRUTH)
    np.testing.assert_allclose(drawn["gicp"], printed_matrix(capsys.readouterr().out), atol=1e-8)
    drawn.clear()
    # A right pose that so few points do not verify.
    assert main(["register", files["source"], files["target"], "--init", "global", "--plot", "x.png"]) == 1
    assert "status:    UNVERIFIED" in capsys.readouterr().out
    assert "start" not in drawn
    io.write_poses(tmp_path / "far.txt", [motion((50, 0, 0, 0, 0, 0))])
    assert main(["register", files["source"], files["target"], "--init", str(tmp_path / "far.txt")]) == 1


def test_numbers_reach_the_method(register):
    numbers = ["--channel-covariance", "0.25", "--channel-weights", "0.5", "--epsilon", "0.01"]
    for method, given in (("mc-gicp", numbers), ("color-icp", numbers[2:4])):
        code, text, _ = register("--method", method, *given)
        named = [f"{name[2:].replace('-', '_')} {value}" for name, value in zip(given[::2], given[1::2], strict=True)]
        assert code == 0 and ", ".join([method, *named]) + "\n" in text


def test_what_does_not_converge_is_no_success(files, tmp_path, capsys):
    far = save(tmp_path / "far.npz", room_corner(1000)[0] + 100)
    flat = save(tmp_path / "flat.npz", np.random.default_rng(0).random((500, 3)) * [1, 1, 0])
    for arguments, status in (
        ([far, files["target"], "--method", "gicp"], "TOO_FEW_CORRESPONDENCES"),
        ([files["source"], files["target"], "--max-iterations", "1"], "MAX_ITERATIONS"),
        ([flat, flat, "--method", "point-to-plane"], "unconstrained"),
    ):
        assert main(["register", *arguments]) == 1
        text, errors = capsys.readouterr()
        assert "status: " in text and errors.startswith("mcgicp: ") and status in errors
        assert "rmse nan" not in text


@pytest.mark.slow
def test_compare(files, capsys):
    assert main(["compare", files["source"], files["target"], "--truth", files["truth"]]) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split()[0]: line.split()[1:] for line in lines if line.endswith("CONVERGED")}
    assert list(rows) == list(METHODS)
    start = next(line.split() for line in lines if line.startswith("(start)"))
    middle = np.asarray(io.read(files["source"]).points).mean(axis=0)
    assert float(start[1]) == pytest.approx(1e3 * metrics.pose_error(np.eye(4), TRUTH, at=middle)[0], abs=0.01)
    assert float(rows["gicp"][0]) < 10 < float(start[1])
    assert float(rows["gicp"][1]) < 0.6 < float(start[2])
    # Without channels or truth.
    assert main(["compare", files["bare"], files["target"], "--max-iterations", "1"]) == 1
    text, errors = capsys.readouterr()
    assert "error" not in text and text.count("left out") == 4
    # Methods of one status share a line.
    assert errors.count(": MAX_ITERATIONS: ") == 1


@pytest.mark.slow
def test_compare_leaves_out_methods_that_refuse_the_clouds(tmp_path, capsys):
    """Of sixty points, cells of six are too few."""
    names = [str(tmp_path / f"{name}.npz") for name in ("source", "target")]
    for seed, name in enumerate(names):
        io.write(name, mcg.PointCloud(*room_corner(60, seed=seed)))
    assert main(["compare", *names]) in (0, 1)
    lines = capsys.readouterr().out.splitlines()
    assert sum("left out: " in line and "4 cells of 6 points" in line for line in lines) == 3
    assert any(line.startswith("gicp ") and line.endswith("CONVERGED") for line in lines)


@pytest.mark.slow
def test_demo(tmp_path, capsys):
    folder = tmp_path / "some" / "folder"
    assert main(["demo", "--output", str(folder)]) == 0
    text, errors = capsys.readouterr()
    assert errors == "" and str(folder / "before_after.png") in text
    height, width, _ = matplotlib.image.imread(folder / "before_after.png").shape
    assert min(height, width) > 500
    error = {line.split()[0]: float(line.split()[1]) for line in text.split("status\n")[1].splitlines()[:5]}
    assert error["mc-gicp"] < 5 and error["color-icp"] < 10
    # What the text says: geometry slides.
    assert min(error["gicp"], error["point-to-plane"]) > 20
    (truth,) = io.read_poses(folder / "truth.txt")
    source = io.read(folder / "source.npz")
    middle = source.points.mean(axis=0)
    assert 1e3 * metrics.pose_error(np.eye(4), truth, at=middle)[0] == pytest.approx(error["(start)"], abs=0.01)
    assert len(source) > 10_000


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


def test_clouds_without_channels_in_common_are_registered_by_gicp(files, tmp_path, capsys):
    assert main(["register", files["bare"], files["target"]]) == 0
    text, errors = capsys.readouterr()
    assert errors == "" and "\nmethod:    gicp, epsilon" in text
    assert text.count("no channels in common, therefore gicp") == 1
    assert main(["register", files["bare"], files["target"], "--channel-weights", "1"]) == 2
    assert "gicp has no --channel-weights" in capsys.readouterr().err
    folder = tmp_path / "clouds"
    folder.mkdir()
    for k in range(2):
        save(folder / f"{k}.npz", room_corner(1000, seed=k)[0])
    for command in (["batch", str(folder), "--output", str(tmp_path / "table.csv")], ["multiway", str(folder)]):
        assert main(command) == 0
        text, errors = capsys.readouterr()
        assert errors == "" and text.count("no channels in common, therefore gicp") == 1


@pytest.mark.slow
def test_voxels_are_chosen_from_the_data(tmp_path, capsys):
    for size, rows, voxels in ((1.0, 60_000, "voxels of "), (1000.0, 60_000, "voxels of "), (1.0, 5000, "all points")):
        points = size * room_corner(rows, noise=0.002)[0]
        half = save(tmp_path / "half.npz", points[::2])
        whole = save(tmp_path / "whole.npz", points)
        assert main(["register", half, whole, "--method", "point-to-plane"]) in (0, 1)
        first, *lines = capsys.readouterr().out.splitlines()
        (second,) = (line for line in lines if line.startswith("matches:"))
        used = int(first.split("target ")[1].split()[0].replace(",", ""))
        assert voxels in first
        distances = [float(part.split()[0]) for part in second.split("up to ")[1].split("then")]
        assert used == rows if voxels == "all points" else 16_000 < used <= 40_000
        chosen = None if voxels == "all points" else float(first.split(voxels)[1].split()[0])
        assert chosen is None or "at most 40,000 of 60,000 points" in first
        kept = mcg.preprocess(io.read(whole), chosen).points
        assert len(kept) == used
        near, far = np.median(scipy.spatial.cKDTree(kept).query(kept, k=(2, 20))[0], axis=0)
        # The command takes the median of 4,096 points, whose standard error is 1 %.
        np.testing.assert_allclose(distances, [10 * max(near, np.sqrt(np.pi / 20) * far), 2.5 * near], rtol=0.03)


def broken(folder):
    """Arguments that are wrong, and what the message must name."""
    good = save(folder / "good.npz", room_corner(200)[0])
    (folder / "cut.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\n")
    io.write_poses(folder / "two.txt", [TRUTH, TRUTH])
    np.savetxt(folder / "scaled.txt", 2 * np.eye(4))
    nan = save(folder / "nan.npz", np.full((9, 3), np.nan))
    return [
        ([str(folder / "nowhere.ply"), good], "nowhere.ply: "),
        ([good, str(folder / "cut.ply")], "cut.ply: "),
        ([str(folder), good], str(folder)),
        ([good, nan], "nan.npz: "),
        *(([good, good, "--init", path], path) for path in (good, str(folder / "two.txt"), str(folder / "scaled.txt"))),
        ([good, good, "--channel-weights", "1"], "gicp has no --channel-weights"),
        *(
            ([good, good, f"--{name}", value], f"mcgicp: --{name}: ")
            for name, value in (
                *(("epsilon", "-1"), ("voxel-size", "-1"), ("num-neighbors", "1"), ("max-distance", "0")),
                *(("max-iterations", "0"), ("max-source-points", "3")),
            )
        ),
        ([good, good, "--aligned", str(folder / "out.doc")], "'.doc'"),
        ([good, good, "--output", str(folder / "no" / "pose.txt")], "pose.txt"),
        ([good, good, "--output", str(folder)], f"{folder}: "),
        ([good, good, "--output", str(folder / "moved.ply")], "moved.ply: expected a text file"),
        ([good, good, "--output", str(folder / "a.txt"), "--aligned", str(folder / "a.txt")], "output: "),
        ([good, good, "--aligned", good], f"{good}: expected a file outside of the input"),
        ([good, good, "--plot", str(folder / "picture.doc")], "picture.doc: "),
    ]


def test_wrong_input_gets_one_line(tmp_path, capsys):
    for args, message in broken(tmp_path):
        assert main(["register", *args, "--method", "gicp"]) == 2, args
        text, errors = capsys.readouterr()
        assert errors.startswith("mcgicp: ") and errors.count("\n") == 1, errors
        assert message in errors
        # It is found before any work is done.
        assert text == ""
    good = str(tmp_path / "good.npz")
    assert main(["compare", good, good, "--truth", str(tmp_path / "no.txt")]) == 2
    assert capsys.readouterr().err.startswith("mcgicp: --truth: ")


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


def test_help_lists_the_registries(capsys):
    """A method, kernel, colour space, format or data set that is registered is an option, with its defaults."""
    for command, registered in (("register", (METHODS, KERNELS, COLOR_SPACES, FORMATS)), ("odometry", (DATASETS,))):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        text = " ".join(capsys.readouterr().out.replace("│", " ").split())
        for names in registered:
            assert not [name for name in names if name not in text]
        assert "None" not in text
    for name, dataset in DATASETS.items():
        assert f"{dataset.max_distance[0]:g} and {dataset.max_distance[1]:g} for " in text, name


def test_a_kernel_is_an_option(register, capsys):
    texts = [register("--method", "gicp", *given, source="bare")[1] for given in ([], ["--robust", "cauchy", "0.5"])]
    without, robust = map(printed_matrix, texts)
    assert close_to_truth(without) and close_to_truth(robust) and np.abs(without - robust).max() > 1e-6
    for given in (["huber"], ["hubr", "1"], ["huber", "x"]):
        with pytest.raises(SystemExit):
            main(["register", "a.ply", "b.ply", "--robust", *given])
        assert f"and a scale, such as huber 1.0; got {' '.join(given)} " in re.sub(
            r"[\s│]+", " ", capsys.readouterr().err
        )


def test_an_unwritable_cache_is_no_error(files, monkeypatch, capsys, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    before = jax.config.jax_compilation_cache_dir
    assert main(["register", files["bare"], files["target"], "--method", "gicp"]) == 0
    assert capsys.readouterr().err == ""
    assert jax.config.jax_compilation_cache_dir == before


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
