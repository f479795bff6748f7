"""`mcgicp batch`: a table that grows row by row, is completed when the command is run again, and loses nothing."""

import csv
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import io
from mcgicp_jax.metrics import pose_error
from tests.scenes import motion, room_corner

NUM_FILES = 5
OPTIONS = ["--max-distance", "0.5", "--voxel-size", "off"]
POSE = [f"m{i}{j}" for i in range(3) for j in range(4)]


def pose(i):
    return motion(0.01 * i * np.arange(1, 7))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Clouds of one room, seen from one place after another."""
    folder = tmp_path_factory.mktemp("scans")
    for i in range(NUM_FILES):
        points, channels = room_corner(1000, seed=i)
        seen = (points - pose(i)[:3, 3]) @ pose(i)[:3, :3]
        io.write(folder / f"scan_{i}.ply", mcg.PointCloud(seen, channels, channel_names=["intensity", "heat"]))
    (folder / "notes.txt").write_text("no cloud\n")
    return folder


def table(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write_pairs(path, rows, columns=("source", "target")):
    with open(path, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([columns, *rows])
    return path


def matrix(row):
    return np.vstack([np.reshape([float(row[name]) for name in POSE], (3, 4)), [0, 0, 0, 1]])


@pytest.fixture
def batch(command):
    """Runs `mcgicp batch` on pairs or a folder, to a table; the exit code, output and errors."""
    return lambda pairs, output, *options: command("batch", pairs, "--output", output, *OPTIONS, *options)


def test_a_folder_is_registered_file_by_file(folder, tmp_path, batch):
    code, text, _ = batch(folder, tmp_path / "results.csv", "--glob", "*.ply")
    assert code == 0 and f"{NUM_FILES - 1} CONVERGED" in text and "intensity" in text
    rows = sorted(table(tmp_path / "results.csv"), key=lambda row: row["source"])
    assert len(rows) == NUM_FILES - 1
    for i, row in enumerate(rows):
        assert (row["source"], row["target"]) == (f"scan_{i + 1}.ply", f"scan_{i}.ply")
        assert row["status"] == "CONVERGED" and row["reason"] == ""
        assert max(pose_error(matrix(row), np.linalg.inv(pose(i)) @ pose(i + 1))) < 0.03
        assert int(row["inliers"]) > 900
        assert np.float32(row["overlap"]) == np.float32(int(row["inliers"]) / 1000)
        deviations = np.array([float(row[f"deviation_{axis}"]) for axis in ("x", "y", "z", "rx", "ry", "rz")])
        assert np.all(deviations > 1e-5) and np.all(deviations < 0.01)


@pytest.mark.slow
def test_processes_write_the_table_of_threads(folder, tmp_path, batch):
    tables = [tmp_path / "threads.csv", tmp_path / "processes.csv"]
    for path, options in zip(tables, ([], ["--workers", 2]), strict=True):
        assert batch(folder, path, "--glob", "*.ply", *options)[0] == 0
    assert tables[0].read_text() == tables[1].read_text()
    code, _, errors = batch(folder, tmp_path / "none.csv", "--glob", "*.ply", "--workers", 0)
    assert code == 2 and "workers: " in errors


def test_a_second_run_does_what_is_missing_or_could_not_be_registered(folder, tmp_path, batch):
    for i in (0, 1):
        shutil.copy2(folder / f"scan_{i}.ply", tmp_path)
    names, output = [f"scan_{i}.ply" for i in range(3)], tmp_path / "results.csv"
    pairs = write_pairs(tmp_path / "pairs.csv", [names[:2], names[1:]])
    assert batch(pairs, output)[0] == 1
    before, first = table(output), "".join(output.read_text().splitlines(keepends=True)[:2])
    assert [row["status"] for row in before] == ["CONVERGED", "INVALID_INPUT"]
    # As a process leaves it that is killed while it writes.
    output.write_text(first + "scan_1.ply,scan_2.p")
    code, text, _ = batch(pairs, output)
    assert code == 1 and "2, of which 1 are in" in text
    assert output.read_text().startswith(first) and table(output) == before
    shutil.copy2(folder / names[2], tmp_path)
    code, text, _ = batch(pairs, output)
    assert code == 0 and "2, of which 1 are in" in text and output.read_text().startswith(first)
    assert [(row["source"], row["status"]) for row in table(output)] == [(name, "CONVERGED") for name in names[:2]]
    complete = output.read_text()
    assert batch(pairs, output)[0] == 0 and output.read_text() == complete


def test_pairs_that_fail_have_messages_of_their_own(folder, tmp_path, batch):
    far, start = motion((50.0, 0, 0, 0, 0, 0))[:3].ravel(), np.eye(4)[:3].ravel()
    sources = {"missing.ply": start, "scan_1.ply": start, "notes.txt": start, "scan_2.ply": far}
    lines = [(source, "scan_0.ply", *pose) for source, pose in sources.items()]
    pairs, output = write_pairs(folder / "bad.csv", lines, ("source", "target", *POSE)), tmp_path / "results.csv"
    code, text, errors = batch(pairs, output)
    assert code == 1 and "done:      4 of 4, " in text and f"table:     {output}\n" in text
    assert "mcgicp: missing.ply scan_0.ply: source:" in errors and "3 of 4 pairs" in errors and "Errno" not in errors
    rows = {row["source"]: row for row in table(output)}
    assert rows["scan_1.ply"]["status"] == "CONVERGED"
    assert rows["scan_2.ply"]["status"] == "TOO_FEW_CORRESPONDENCES"
    assert "fewer than four points have a match" in rows["scan_2.ply"]["reason"]
    for name in ("missing.ply", "notes.txt"):
        assert rows[name]["status"] == "INVALID_INPUT" and name in rows[name]["reason"]
    # Files that cannot be read have no rate.
    code, text, _ = batch(pairs, output)
    assert code == 1 and "done:      2 of 2\n" in text


def test_a_degenerate_pair_names_its_unconstrained_directions(tmp_path, batch):
    for seed in range(2):
        noise = np.random.default_rng(seed).normal(size=(1000, 3))
        io.write(tmp_path / f"floor_{seed}.ply", mcg.PointCloud(noise * [1, 1, 0.01]))
    output = tmp_path / "results.csv"
    assert batch(tmp_path, output)[0] == 1
    (row,) = table(output)
    assert row["status"] == "DEGENERATE" and row["reason"].startswith("unconstrained: translation along (")
    output.write_text(output.read_text().replace("DEGENERATE", "unknown"))
    code, _, errors = batch(tmp_path, output)
    assert code == 2 and "such as CONVERGED, got unknown" in errors


def test_a_pair_from_several_starts(folder, tmp_path, batch):
    """Rows are in the order of the pairs, which tells the starts apart; a start that is added is run alone."""
    starts = [motion((50.0, 0, 0, 0, 0, 0)), np.eye(4), pose(1)]
    lines = [[folder / "scan_1.ply", folder / "scan_0.ply", *start[:3].ravel()] for start in starts]
    for rows, done in ((lines[::2], 0), (lines, 2)):
        pairs = write_pairs(tmp_path / "pairs.csv", rows, ("source", "target", *POSE))
        code, text, _ = batch(pairs, tmp_path / "results.csv")
        assert code == 1 and (f"of which {done}" in text) == bool(done)
    statuses = [row["status"] for row in table(tmp_path / "results.csv")]
    assert statuses == ["TOO_FEW_CORRESPONDENCES", "CONVERGED", "CONVERGED"]


def test_a_list_that_makes_no_sense(tmp_path, batch):
    unreadable, posed = "source,target\nx.ply,y.ply\nz.ply,y.ply\n", ",".join(["source,target", *POSE])
    for content, message in (
        ("a,b\n1,2\n", "source and target"),
        ("source,target\n", "pairs"),
        ("source,target\nx.ply,\n", "line 2"),
        ("source,target\nx.ply,y.ply\nx.ply,y.ply\n", "once"),
        (unreadable, "0 of 2 pairs can be read; the first error: "),
        (unreadable, "x.ply"),
        (posed + "\nx.ply,y.ply" + 12 * ",a", "line 2"),
        (posed.replace("m23", "m32") + "\nx.ply,y.ply" + 12 * ",1", "or none, got no m23"),
        (posed.replace("m", "M"), "or none, got no m00"),
        ("\x80\xff", "pairs.csv: "),
    ):
        (tmp_path / "pairs.csv").write_bytes(content.encode("latin-1"))
        code, _, errors = batch(tmp_path / "pairs.csv", tmp_path / "results.csv")
        assert code == 2 and message in errors and errors.count("\n") == 1


def test_warnings_name_the_files_of_their_pair(folder, tmp_path, batch):
    """In a list of a spreadsheet, with a byte order mark and blanks after the commas."""
    cloud = io.read(folder / "scan_1.ply")
    points = np.array(cloud.points)
    points[3] = np.nan
    io.write(tmp_path / "broken.npz", cloud.replace(points=points))
    shutil.copy2(folder / "scan_0.ply", tmp_path)
    pairs = tmp_path / "pairs.csv"
    pairs.write_text("source, target\nscan_0.ply, scan_0.ply\nbroken.npz, scan_0.ply\n", encoding="utf-8-sig")
    code, _, errors = batch(pairs, tmp_path / "results.csv")
    assert code == 0 and "broken.npz scan_0.ply: source: left out 1 of 1000" in errors


def test_a_table_must_be_a_csv_file_of_results(folder, tmp_path, batch):
    (tmp_path / "precious.csv").write_text("a,b\n1,2\n")
    names = dict.fromkeys(("table.npz", "table.ply", "results.txt"), "output: expected a .csv file")
    for name, message in (names | {"precious.csv": "precious.csv: "}).items():
        code, _, errors = batch(folder, tmp_path / name)
        assert code == 2 and message in errors
    assert (tmp_path / "precious.csv").read_text() == "a,b\n1,2\n"


@pytest.mark.slow
def test_control_c_loses_nothing_that_is_done(folder, tmp_path):
    names = [f"scan_{i}.ply" for i in range(NUM_FILES)]
    repeated = [(a, f"../{folder.name}/{'./' * k}{b}") for k in range(60) for a in names for b in names if a != b]
    pairs, output = write_pairs(folder / "many.csv", repeated), tmp_path / "results.csv"
    command = [sys.executable, "-m", "mcgicp_jax", "batch", pairs, "--output", output, *OPTIONS]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while (not output.exists() or output.read_text().count("\n") < 20) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    text, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and "run the same command again" in errors and "Traceback" not in errors
    rows = table(output)
    assert 19 <= len(rows) < len(repeated) and f"done:      {len(rows):,} of {len(repeated):,}" in text


class Interrupts:
    """Interrupted by Control-C while it is collected, Python loses the exception."""

    def __del__(self):
        signal.raise_signal(signal.SIGINT)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("lost", [False, True])
def test_an_interrupted_run_is_completed_by_the_next(folder, tmp_path, batch, monkeypatch, lost):
    for path in sorted(folder.glob("*.ply"))[:3]:
        shutil.copy(path, tmp_path)
    # Neither these nor the table of the first runs is a cloud.
    io.write_poses(tmp_path / "poses.txt", [pose(1), pose(2)])
    (tmp_path / ".0123.tmp").write_text("left by a killed process")
    completed, before = mcg.register_as_completed, signal.getsignal(signal.SIGINT)

    def interrupted(*arguments, **options):
        answers = completed(*arguments, **options)
        if lost:
            Interrupts()
        yield next(answers)
        if not lost:
            raise KeyboardInterrupt
        yield from answers

    with monkeypatch.context() as patch:
        patch.setattr(mcg, "register_as_completed", interrupted)
        code, _, errors = batch(tmp_path, tmp_path / "results.csv")
    assert code == 130 and signal.getsignal(signal.SIGINT) is before and "interrupted" in errors
    code, text, _ = batch(tmp_path, tmp_path / "results.csv")
    assert code == 0 and "2, of which 1 are in" in text
    assert batch(tmp_path, tmp_path / "results.csv")[0] == 0


def test_each_pair_has_voxels_of_its_own(tmp_path, command):
    """As in `register_batch`; one size for all would suit the first pair only."""
    rng, lines = np.random.default_rng(0), np.stack(np.meshgrid(np.arange(0, 2, 0.01), np.arange(0, 2, 0.1)), -1)
    corner = np.concatenate([np.insert(lines.reshape(-1, 2), axis, 0, axis=1) for axis in range(3)])
    sources, targets = (
        [mcg.PointCloud(scale * (corner + 0.002 * rng.normal(size=corner.shape))) for scale in (1, 4)] for _ in "st"
    )
    for side, clouds in (("s", sources), ("t", targets)):
        for i, cloud in enumerate(clouds):
            io.write(tmp_path / f"{side}{i}.npz", cloud)
    listed = write_pairs(tmp_path / "pairs.csv", [(f"s{i}.npz", f"t{i}.npz") for i in range(2)])
    command("batch", listed, "--output", tmp_path / "out.csv", "--method", "gicp")
    first, second = (mcg.preprocess(target).voxel_size for target in targets)
    assert first is not None and second > 2 * first
    results = mcg.register_batch(sources, targets, mcg.GICP())
    for row, result in zip(table(tmp_path / "out.csv"), results, strict=True):
        np.testing.assert_array_equal(matrix(row)[:3], result.matrix[:3])
