"""`mcgicp batch PAIRS`: register many pairs of files and write a table of poses, which a later run can resume."""

from __future__ import annotations

import collections
import contextlib
import csv
import itertools
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
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
from mcgicp_jax._cli.choices import Choices, listed, with_channels
from mcgicp_jax._cli.options import Method, Options, check_outputs, clouds_in, with_names
from mcgicp_jax._compute.messages import check_integer
from mcgicp_jax._pairs.processes import Processes
from mcgicp_jax.io.files import replacing

Row: TypeAlias = dict[str, str]
# Source, target and initial pose.
Key: TypeAlias = tuple[str, str, str]

# Columns of the upper three rows of the pose matrix
POSE = tuple(f"m{row}{column}" for row in range(3) for column in range(4))
# Columns of `RegistrationResult.deviations`, metres and radians.
DEVIATIONS = tuple(f"deviation_{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))
NUMBERS = ("iterations", "inliers", "overlap", "cost", "rmse", *POSE, *DEVIATIONS)
COLUMNS = ("source", "target", "init", "status", *NUMBERS, "reason")
Pairs: TypeAlias = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PAIRS")]

_INTERRUPTED = 130
# Status of pairs that could not be registered.
_TRIED_AGAIN = ("invalid_input", "worker_failed")


class Table:
    """Rows in a .csv file."""

    def __init__(self, path: Path):
        if path.suffix.lower() != ".csv":
            raise ValueError(f"output: expected a .csv file, got {path}")
        self._path = path

    def read(self) -> list[Row]:
        """Return the rows written so far."""
        if not self._path.exists():
            return []
        with open(self._path, newline="", encoding="utf-8") as file:
            lines = file.readlines()
        # A killed process may have left an incomplete last line.
        reader = csv.DictReader(line for line in lines if line.endswith("\n"))
        if lines and tuple(reader.fieldnames or ()) != COLUMNS:
            raise ValueError(f"{self._path}: expected a table of mcgicp batch, got the columns {reader.fieldnames}")
        return list(reader)

    def write(self, rows: Iterable[Row]) -> None:
        """Replace all rows."""
        with replacing(self._path) as file:
            file.write((",".join(COLUMNS) + "\n" + "".join(map(_line, rows))).encode())

    @contextlib.contextmanager
    def appending(self) -> Iterator[Callable[[Row], Any]]:
        """Yield a function that appends a row and flushes it to the file."""
        with open(self._path, "ab", buffering=0) as file:
            yield lambda row: file.write(_line(row).encode())


def key_of(row: Row) -> Key:
    return row["source"], row["target"], row["init"]


def pose_of(row: Row) -> Float[np.ndarray, "4 4"]:
    matrix = np.eye(4)
    matrix[:3] = np.array([float(row[name]) for name in POSE]).reshape(3, 4)
    return matrix


def _line(row: Row) -> str:
    line = StringIO()
    csv.DictWriter(line, COLUMNS, lineterminator="\n").writerow(row)
    return line.getvalue()


@dataclass(frozen=True)
class FilePair:
    """Two cloud files, relative to `folder`, and the initial pose, if given."""

    folder: Path
    source: str
    target: str
    init: Float[np.ndarray, "4 4"] | None = None

    @property
    def key(self) -> Key:
        start = [] if self.init is None else self.init[:3].ravel().tolist()
        return self.source, self.target, " ".join(map(repr, start))

    def paths(self) -> tuple[Path, Path]:
        return self.folder / self.source, self.folder / self.target


@with_names
def batch(
    pairs: Pairs,
    output: Path,
    method: Method = None,
    glob: str = "*",
    workers: int | Literal["auto"] = "auto",
    *,
    shared: Options,
) -> int:
    """Register many pairs of clouds and write a table of their poses T_target_source.

    PAIRS is a CSV file or a folder. The CSV file has the columns source and target, with paths relative to its folder,
    and optionally m00 m01 ... m23, the upper three rows of the initial pose; a pair may occur with several initial
    poses. In a folder, each cloud is registered to the one before it in order of name; files that are no clouds are
    left out. To resume after Ctrl-C, or to add pairs, run the same command again: it skips pairs that are in the table,
    except those that could not be registered, for instance since a file is missing. For other options, write another
    table. The exit code is 0 only if all pairs converged.

    Args:
        pairs: CSV file or folder.
        output: Table to write or to resume, .csv. A row per pair, at the end in the order of PAIRS: source,
            target, initial pose if given, status, iterations, inliers, overlap, cost, rmse, the upper three rows of the
            pose, its deviations (m, rad), and the reason if it could not be registered or its pose is doubtful.
        method: {channel_methods} use channels (intensity, colours, ...), the others geometry alone.
        glob: Pattern for the files of a folder, such as "*.ply".
        workers: Number of processes. auto: threads, or one process per core where that is faster.
    """
    shared.check(method)
    if workers != "auto":
        check_integer("workers", workers, 1)
    check_outputs(output)
    table = Table(output)
    everything = _pairs_of_folder(pairs, glob) if pairs.is_dir() else _pairs_of_table(pairs)
    wanted = {pair.key: pair for pair in everything}
    rows = {key_of(row): row for row in table.read()}
    rows = {key: row for key, row in rows.items() if key not in wanted or row["status"] not in _TRIED_AGAIN}
    settings = _settings(everything, method, shared)
    missing = {key: pair for key, pair in wanted.items() if key not in rows}
    settings["executor"] = None if workers == "auto" else Processes(workers)
    finished = len(wanted) - len(missing)
    kept = f", of which {finished:,} are in {output} and are kept, whatever the options were" if finished else ""
    print(f"pairs:     {len(wanted):,}{kept}")
    interrupted = bool(missing) and _register_missing(missing, settings, table, rows, finished)
    rows = {key: rows[key] for key in wanted if key in rows} | rows
    table.write(rows.values())
    counts = collections.Counter(rows[key]["status"] for key in wanted if key in rows)
    print("status:    " + ", ".join(f"{count:,} {name}" for name, count in counts.most_common()))
    if interrupted:
        print("mcgicp: interrupted; run the same command again to continue", file=sys.stderr)
        return _INTERRUPTED
    failed = counts.total() - counts[_word(mcg.Status.CONVERGED)]
    if failed:
        print(f"mcgicp: {failed} of {len(everything)} pairs did not converge; see {output}", file=sys.stderr)
    return 1 if failed else 0


def _register_missing(
    pairs: Mapping[Key, FilePair], settings: dict[str, Any], table: Table, rows: dict[Key, Row], finished: int
) -> bool:
    """Register pairs, adding their rows to the table and to `rows`; return whether Ctrl-C stopped it."""
    interrupted, begin = False, time.perf_counter()
    table.write(rows.values())
    with (
        table.appending() as append,
        tqdm(total=finished + len(pairs), initial=finished, unit="pair", disable=None) as bar,
        contextlib.closing(_rows(pairs, settings, bar)) as completed,
        _interrupts() as pressed,
    ):
        try:
            for row in completed:
                append(row)
                rows[key_of(row)] = row
                bar.update()
                if pressed:
                    raise KeyboardInterrupt
        except KeyboardInterrupt:
            interrupted = True
    done = sum(key in rows for key in pairs)
    print(f"done:      {done:,} of {len(pairs):,}, {done / (time.perf_counter() - begin):.3g} pairs per second")
    return interrupted


@contextlib.contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Record each Ctrl-C in a list, besides raising `KeyboardInterrupt`.

    Python swallows the exception during a callback of the garbage collector, and JAX installs one.
    """
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


def _pairs_of_table(path: Path) -> list[FilePair]:
    # Spreadsheets write a byte order mark, people a blank after the comma.
    with open(path, newline="", encoding="utf-8-sig") as file:
        try:
            lines = file.readlines()
        except UnicodeError as error:
            raise ValueError(f"{path}: expected a CSV file or a folder; the file is not text") from error
        reader = csv.DictReader(lines, skipinitialspace=True)
        columns = reader.fieldnames or []
        if not {"source", "target"} <= set(columns):
            raise ValueError(f"{path}: expected the columns source and target, got {listed(columns)}")
        with_start = set(POSE) <= set(columns)
        pairs = []
        for row in reader:
            if not row["source"] or not row["target"]:
                raise ValueError(f"{path}: line {reader.line_num}: expected two files, got {row}")
            try:
                start = pose_of(row) if with_start else None
            except (TypeError, ValueError) as error:
                raise ValueError(
                    f"{path}: line {reader.line_num}: expected numbers in m00 ... m23, got {row}"
                ) from error
            pairs.append(FilePair(path.parent, row["source"], row["target"], start))
    return _checked(path, pairs)


def _pairs_of_folder(folder: Path, glob: str) -> list[FilePair]:
    names = [path.name for path in clouds_in(folder, glob).paths]
    return _checked(folder, [FilePair(folder, source, target) for target, source in itertools.pairwise(names)])


def _checked(path: Path, pairs: list[FilePair]) -> list[FilePair]:
    if not pairs:
        raise ValueError(f"{path}: expected pairs of clouds, got none")
    (source, target, _), count = collections.Counter(pair.key for pair in pairs).most_common(1)[0]
    if count > 1:
        names = f"{source} {target}"
        raise ValueError(f"{path}: expected each pair once from each initial pose, got {names} several times")
    return pairs


def _settings(pairs: Sequence[FilePair], method: Method, options: Options) -> dict[str, Any]:
    """Options common to all pairs, with defaults chosen from the first pair whose files can be read."""
    for pair in pairs:
        try:
            clouds = [io.read(path, columns=options.columns) for path in pair.paths()]
            break
        except (ValueError, OSError) as error:
            reason = error
    else:
        raise reason
    choices = Choices.of(options, *clouds)
    name = choices.method_name(method, dict(zip((pair.source, pair.target), clouds, strict=True)))
    size = None if options.voxel_size == "off" else options.voxel_size
    print(f"points:    {choices.voxels}{' in the first pair' if size == 'auto' else ''}")

    def ready() -> tuple[mcg.PointCloud, mcg.PointCloud]:
        source, target = map(choices.preprocess, clouds)
        return source, target

    return choices.arguments(name, ready) | {
        "method": choices.method(name, ready),
        "channels": choices.channels,
        "columns": options.columns,
        "voxel_size": size,
        "num_neighbors": options.num_neighbors,
    }


def _rows(pairs: Mapping[Key, FilePair], settings: dict[str, Any], bar: tqdm) -> Generator[Row, None, None]:
    """Yield the row of each pair as it finishes. Reasons for failure go into the row and to stderr."""
    keys, reasons = list(pairs), dict[int, str]()
    show = warnings.showwarning

    def keep(message: Warning | str, *rest: Any, **options: Any) -> None:
        if isinstance(message, mcg.PairWarning) and message.index is not None:
            reasons[message.index] = message.reason
            message = f"{' '.join(keys[message.index][:2])}: {message.reason}"
        with bar.external_write_mode(file=sys.stderr):
            show(message, *rest, **options)

    arguments = settings.copy()
    method, read = arguments.pop("method"), partial(_read, *map(arguments.pop, ("channels", "columns")))
    sources, targets = ([partial(read, pair.paths()[side]) for pair in pairs.values()] for side in (0, 1))
    starts = [pair.init for pair in pairs.values()]
    completed = mcg.register_as_completed(sources, targets, method, init=starts, **arguments)
    with warnings.catch_warnings(), contextlib.closing(completed):
        warnings.simplefilter("always", mcg.PairWarning)
        warnings.showwarning = keep
        for index, result in completed:
            yield _row(keys[index], result, reasons.pop(index, ""))


def _read(channels: Sequence[str], columns: int | None, path: Path) -> mcg.PointCloud:
    try:
        return with_channels(io.read(path, columns=columns), channels)
    except ValueError as error:
        raise error if str(path) in str(error) else ValueError(f"{path}: {error}") from error


def _row(key: Key, result: mcg.RegistrationResult, reason: str) -> Row:
    quality = result.num_iterations, result.num_inliers, result.overlap, result.cost, result.rmse
    numbers = *quality, *result.matrix[:3].ravel(), *result.deviations
    values = (np.asarray(number).item() for number in numbers)
    texts = (*key, _word(result.status), *map(repr, values), " ".join(reason.split()))
    return dict(zip(COLUMNS, texts, strict=True))


def _word(status: mcg.Status) -> str:
    return status.name.lower()
