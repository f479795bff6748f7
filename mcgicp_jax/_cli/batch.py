"""`mcgicp batch PAIRS`: register many pairs of files and write a table of poses, which a later run can resume."""

from __future__ import annotations

import collections
import contextlib
import csv
import itertools
import re
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from functools import partial
from io import StringIO
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
import tyro
from jaxtyping import Float
from tqdm import tqdm

import mcgicp_jax as mcg
from mcgicp_jax import io
from mcgicp_jax._cli import options as cli
from mcgicp_jax._cli.choices import Choices, listed, with_channels
from mcgicp_jax._compute.messages import check_integer
from mcgicp_jax._pairs.processes import Processes
from mcgicp_jax._pose_solver.degeneracy import as_text
from mcgicp_jax.io.files import replacing

Row: TypeAlias = dict[str, str]
# Source, target and initial pose, as in the first columns of the table.
Key: TypeAlias = tuple[str, str, str]
# Number and result of each pair, as it is completed.
Completed: TypeAlias = Generator[tuple[int, mcg.RegistrationResult], None, None]

# Columns of the table: the upper three rows of the pose matrix.
_POSE = tuple(f"m{row}{column}" for row in range(3) for column in range(4))
# Columns of `RegistrationResult.deviations`, metres and radians.
_DEVIATIONS = tuple(f"deviation_{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))
_NUMBERS = ("iterations", "inliers", "overlap", "cost", "rmse", *_POSE, *_DEVIATIONS)
_COLUMNS = ("source", "target", "init", "status", *_NUMBERS, "reason")
# Exit code after Ctrl-C: 128 + SIGINT, as shells have it.
_INTERRUPTED = 130
# Statuses of pairs that could not be registered; a later run tries them again.
_TRIED_AGAIN = (mcg.Status.INVALID_INPUT.name, mcg.Status.WORKER_FAILED.name)


@cli.with_names
def batch(
    pairs: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PAIRS")],
    output: Path,
    method: cli.Method = None,
    glob: str = "*",
    workers: int | Literal["auto"] = "auto",
    *,
    shared: cli.Options,
) -> int:
    """Register many pairs of clouds and write a table of their poses T_target_source.

    PAIRS is a CSV file or a folder. The CSV file has the columns source and target, with paths relative to its folder,
    and optionally m00 m01 ... m23, the upper three rows of the initial pose; a pair may occur with several initial
    poses. In a folder, each cloud is registered to the one before it in order of name; files that are no clouds are
    left out. To resume after Ctrl-C, or to add pairs, run the same command again: it skips pairs that are in the table,
    except those that could not be registered, for instance since a file is missing. For other options, write another
    table. Channels, and defaults that depend on clouds, are those of the first pair that can be read. The exit code
    is 0 only if all pairs converged.

    Args:
        pairs: CSV file or folder.
        output: Table to write or to resume, .csv. A row per pair, at the end in the order of PAIRS: source,
            target, initial pose if given, status, iterations, inliers, overlap, cost, rmse, the upper three rows of the
            pose, its deviations (m, rad), and why it has not converged, or what to try.
        method: {channel_methods} use channels (intensity, colours, ...), the others geometry alone.
        glob: Pattern for the files of a folder, such as "*.ply".
        workers: Number of processes. auto: threads, or one process per core where that is faster.
    """
    shared.check(method)
    if workers != "auto":
        check_integer("workers", workers, 1)
    if output.suffix.lower() != ".csv":
        raise ValueError(f"output: expected a .csv file, got {output}")
    cli.check_outputs(output)
    wanted = _pairs_in(pairs, glob)
    rows = {(row["source"], row["target"], row["init"]): row for row in _read_rows(output)}
    rows = {key: row for key, row in rows.items() if key not in wanted or row["status"] not in _TRIED_AGAIN}
    folder = pairs if pairs.is_dir() else pairs.parent
    read, arguments = _reader_and_arguments(folder, wanted, method, shared)
    executor = None if workers == "auto" else Processes(workers)
    missing = {key: init for key, init in wanted.items() if key not in rows}
    sources, targets = ([partial(read, folder / key[side]) for key in missing] for side in (0, 1))
    arguments |= {"init": list(missing.values()), "executor": executor}
    register = partial(mcg.register_as_completed, sources, targets, **arguments)

    finished = len(wanted) - len(missing)
    resumed = f", of which {finished:,} are in {output} and are kept, whatever the options were" if finished else ""
    print(f"pairs:     {len(wanted):,}{resumed}")
    interrupted = bool(missing) and _register_missing(list(missing), register, output, rows, finished)
    rows = {key: rows[key] for key in wanted if key in rows} | rows
    _write_rows(output, rows.values())
    print(f"table:     {output}")
    counts = collections.Counter(rows[key]["status"] for key in wanted if key in rows)
    print("status:    " + ", ".join(f"{count:,} {status}" for status, count in counts.most_common()))
    if interrupted:
        print("mcgicp: interrupted; run the same command again to continue", file=sys.stderr)
        return _INTERRUPTED
    failed = counts.total() - counts[mcg.Status.CONVERGED.name]
    if failed:
        print(f"mcgicp: {failed} of {len(wanted)} pairs did not converge; see {output}", file=sys.stderr)
    return 1 if failed else 0


def _pairs_in(path: Path, glob: str) -> dict[Key, Float[np.ndarray, "4 4"] | None]:
    """The pairs and their initial poses."""
    if path.is_dir():
        names = [cloud.name for cloud in cli.clouds_in(path, glob).paths]
        return {(source, target, ""): None for target, source in itertools.pairwise(names)}
    # Spreadsheets write a byte order mark, people a blank after the comma.
    with open(path, newline="", encoding="utf-8-sig") as file:
        try:
            lines = file.readlines()
        except UnicodeError as error:
            raise ValueError(f"{path}: expected a CSV file or a folder; the file is not text") from error
    reader = csv.DictReader(lines, skipinitialspace=True)
    columns = reader.fieldnames or []
    if not any(map(str.strip, lines)):
        raise ValueError(f"{path}: the file is empty")
    if not {"source", "target"} <= set(columns):
        raise ValueError(f"{path}: expected the columns source and target, got {listed(columns)}")
    missing = [name for name in _POSE if name not in columns]
    # Or else a misspelt column would leave out all initial poses.
    if missing and any(re.fullmatch(r"m\d\d", name.lower()) for name in columns):
        raise ValueError(f"{path}: expected all of the columns m00 ... m23, or none, got no {missing[0]}")
    pairs: list[tuple[Key, Any]] = []
    for row in reader:
        line = f"{path}: line {reader.line_num}"
        if not row["source"] or not row["target"]:
            raise ValueError(f"{line}: expected two files in the columns source and target")
        init, numbers = None, list[float]()
        if not missing:
            try:
                numbers = [float(row[name]) for name in _POSE]
            except (TypeError, ValueError) as error:
                raise ValueError(f"{line}: expected numbers in the columns m00 ... m23") from error
            init = np.vstack([np.reshape(numbers, (3, 4)), [0, 0, 0, 1]])
        pairs.append(((row["source"], row["target"], " ".join(map(repr, numbers))), init))
    if not pairs:
        raise ValueError(f"{path}: expected pairs of clouds, got none")
    (source, target, _), count = collections.Counter(key for key, _ in pairs).most_common(1)[0]
    if count > 1:
        raise ValueError(f"{path}: expected each pair once from each initial pose, got {source} {target} several times")
    return dict(pairs)


def _reader_and_arguments(
    folder: Path, pairs: Iterable[Key], method: cli.Method, options: cli.Options
) -> tuple[Callable[[Path], mcg.PointCloud], dict[str, Any]]:
    """Function that reads a cloud, and arguments of `register_as_completed`, from the first pair that can be read."""
    errors: list[Exception] = []
    for *names, _ in pairs:
        try:
            source, target = (io.read(folder / name, columns=options.columns) for name in names)
            break
        except (ValueError, OSError) as error:
            errors.append(error)
    else:
        raise ValueError(f"0 of {len(errors):,} pairs can be read; the first error: {errors[0]}")
    choices = Choices(options, names, (source, target))
    name = choices.method_name(method)
    size = None if options.voxel_size == "off" else options.voxel_size
    print(f"points:    {choices.voxels}{' in the first pair' if size == 'auto' else ''}")
    resolved_method, arguments = choices.method_and_arguments(name)
    arguments |= {"method": resolved_method, "voxel_size": size, "num_neighbors": options.num_neighbors}
    return partial(_read, choices.channels, options.columns), arguments


def _read(channels: Sequence[str], columns: int | None, path: Path) -> mcg.PointCloud:
    try:
        return with_channels(io.read(path, columns=columns), channels)
    except ValueError as error:
        raise error if str(path) in str(error) else ValueError(f"{path}: {error}") from error


def _register_missing(
    keys: list[Key], register: Callable[[], Completed], output: Path, rows: dict[Key, Row], finished: int
) -> bool:
    """Register pairs, add their rows to the table and to `rows`, and return whether Ctrl-C stopped it."""
    reasons: dict[int, str] = {}
    interrupted, begin = False, time.perf_counter()
    _write_rows(output, rows.values())
    with (
        # Each row is written at once.
        open(output, "a", newline="", encoding="utf-8", buffering=1) as file,
        tqdm(total=finished + len(keys), initial=finished, unit="pair", disable=None) as bar,
        warnings.catch_warnings(),
        _interrupts() as pressed,
    ):
        writer, show = csv.DictWriter(file, _COLUMNS, lineterminator="\n"), warnings.showwarning

        # Reasons for failure go into the row and to stderr.
        def note_reason(message: Warning | str, *rest: Any, **options: Any) -> None:
            if isinstance(message, mcg.PairWarning) and message.index is not None:
                reasons[message.index] = message.reason
            text = re.sub(r"^pair (\d+)(?=:)", lambda number: " ".join(keys[int(number[1])][:2]), str(message))
            with bar.external_write_mode(file=sys.stderr):
                show(text, *rest, **options)

        warnings.simplefilter("always", mcg.PairWarning)
        warnings.showwarning = note_reason
        try:
            with contextlib.closing(register()) as completed:
                for index, result in completed:
                    row = rows[keys[index]] = _row(keys[index], result, reasons.pop(index, ""))
                    writer.writerow(row)
                    bar.update()
                    if pressed:
                        raise KeyboardInterrupt
        except KeyboardInterrupt:
            interrupted = True
    statuses = [rows[key]["status"] for key in keys if key in rows]
    registered = sum(status not in _TRIED_AGAIN for status in statuses)
    rate = f", {registered / (time.perf_counter() - begin):.3g} pairs per second" if registered else ""
    print(f"done:      {len(statuses):,} of {len(keys):,}{rate}")
    return interrupted


@contextlib.contextmanager
def _interrupts() -> Iterator[list[int]]:
    """A list that records each Ctrl-C: Python swallows `KeyboardInterrupt` during JAX's garbage-collection callback."""
    pressed: list[int] = []

    def notice(number: int, frame: FrameType | None) -> None:
        pressed.append(number)
        signal.default_int_handler(number, frame)

    if threading.current_thread() is not threading.main_thread():
        # Python delivers signals to the main thread only.
        yield pressed
        return
    before = signal.signal(signal.SIGINT, notice)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, before)


def _read_rows(path: Path) -> list[Row]:
    if not path.exists():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        lines = file.readlines()
    # A killed process may have left an incomplete last line.
    reader = csv.DictReader(line for line in lines if line.endswith("\n"))
    if lines and tuple(reader.fieldnames or ()) != _COLUMNS:
        raise ValueError(f"{path}: expected a table of mcgicp batch, got the columns {reader.fieldnames}")
    rows = list(reader)
    if unknown := {row["status"] for row in rows} - set(mcg.Status.__members__):
        raise ValueError(f"{path}: expected statuses of mcgicp batch, such as CONVERGED, got {listed(sorted(unknown))}")
    return rows


def _write_rows(path: Path, rows: Iterable[Row]) -> None:
    table = StringIO()
    writer = csv.DictWriter(table, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    with replacing(path) as file:
        file.write(table.getvalue().encode())


def _row(key: Key, result: mcg.RegistrationResult, reason: str) -> Row:
    quality = result.num_iterations, result.num_inliers, result.overlap, result.cost, result.rmse
    values = (np.asarray(number).item() for number in (*quality, *result.matrix[:3].ravel(), *result.deviations))
    if not reason and result.status is mcg.Status.DEGENERATE:
        reason = f"unconstrained: {as_text(result.unconstrained_directions)}"
    reason = cli.with_flags(" ".join((reason or result.status.advice).split()))
    texts = (*key, result.status.name, *map(repr, values), reason)
    return dict(zip(_COLUMNS, texts, strict=True))
