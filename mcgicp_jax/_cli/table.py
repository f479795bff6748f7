"""The result table of `mcgicp batch`, written row by row so that a later run can resume it."""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from mcgicp_jax.io.files import replacing

Row: TypeAlias = dict[str, str]
# Source, target and initial pose.
Key: TypeAlias = tuple[str, str, str]

# Columns of the upper three rows of the pose matrix
POSE = tuple(f"m{row}{column}" for row in range(3) for column in range(4))
COLUMNS = ("source", "target", "init", "status", "iterations", "inliers", "cost", "rmse", *POSE, "reason")
_TEXTS = ("source", "target", "init", "status", "reason")


class Table:
    """Rows in a .csv file, or arrays in an .npz file, whose rows are collected in a .csv beside it until the end."""

    def __init__(self, path: Path):
        if path.suffix.lower() not in (".csv", ".npz"):
            raise ValueError(f"output: expected a .csv or .npz file, got {path}")
        self._path = path
        self._rows = path if path.suffix.lower() == ".csv" else path.with_name(f"{path.name}.csv")

    def read(self) -> list[Row]:
        """Return the rows written so far."""
        rows = self._read_arrays() if self._rows != self._path and self._path.exists() else []
        return rows + (self._read_rows() if self._rows.exists() else [])

    @contextlib.contextmanager
    def appending(self, rows: Iterable[Row]) -> Iterator[Callable[[Row], None]]:
        """Replace all rows, and yield a function that appends one more and flushes it to the file."""
        self._write_rows(rows)
        if self._rows != self._path:
            self._path.unlink(missing_ok=True)
        with open(self._rows, "ab", buffering=0) as file:

            def append(row: Row) -> None:
                file.write(_line(row).encode())

            yield append

    def finish(self, rows: Sequence[Row]) -> None:
        """Write all rows in this order."""
        if self._rows == self._path or not rows:
            self._write_rows(rows)
            return
        arrays: dict[str, Any] = {name: np.array([row[name] for row in rows]) for name in _TEXTS}
        arrays |= {name: np.array([float(row[name]) for row in rows]) for name in ("cost", "rmse")}
        arrays |= {name: np.array([int(row[name]) for row in rows]) for name in ("iterations", "inliers")}
        arrays["T_target_source"] = np.stack([pose_of(row) for row in rows])
        with replacing(self._path) as file:
            np.savez_compressed(file, **arrays)
        self._rows.unlink(missing_ok=True)

    def _write_rows(self, rows: Iterable[Row]) -> None:
        with replacing(self._rows) as file:
            file.write((",".join(COLUMNS) + "\n" + "".join(map(_line, rows))).encode())

    def _read_rows(self) -> list[Row]:
        with open(self._rows, newline="", encoding="utf-8") as file:
            lines = file.readlines()
        # A killed process may have left an incomplete last line.
        reader = csv.DictReader(line for line in lines if line.endswith("\n"))
        if lines and tuple(reader.fieldnames or ()) != COLUMNS:
            raise ValueError(f"{self._rows}: expected a table of mcgicp batch, got the columns {reader.fieldnames}")
        return list(reader)

    def _read_arrays(self) -> list[Row]:
        with np.load(self._path, allow_pickle=False) as arrays:
            if "T_target_source" not in arrays:
                raise ValueError(f"{self._path}: expected a table of mcgicp batch, got the arrays {arrays.files}")
            poses = arrays["T_target_source"]
            columns: dict[str, list[Any]] = {name: arrays[name].tolist() for name in COLUMNS if name in arrays}
        columns |= {name: poses[:, i // 4, i % 4].tolist() for i, name in enumerate(POSE)}
        rows = zip(*(columns[name] for name in COLUMNS), strict=True)
        return [dict(zip(COLUMNS, map(str, row), strict=True)) for row in rows]


def key_of(row: Row) -> Key:
    return row["source"], row["target"], row["init"]


def pose_of(row: Row) -> Float[np.ndarray, "4 4"]:
    matrix = np.eye(4)
    matrix[:3] = np.array([float(row[name]) for name in POSE]).reshape(3, 4)
    return matrix


def _line(row: Row) -> str:
    line = io.StringIO()
    csv.DictWriter(line, COLUMNS, lineterminator="\n").writerow(row)
    return line.getvalue()
