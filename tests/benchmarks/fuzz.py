"""Fuzz test of the readers of `mcgicp_jax.io`: every mutated file must give a cloud or a proper error.

    python -m tests.benchmarks.fuzz [--minutes 10] [--seed 0] [--findings FOLDER]

Seeds are valid files of every format and encoding, and the heads of real scans if there are any. Mutations flip, cut,
splice and exchange bytes, and put enormous numbers into headers. A file is a finding if its reader

- raises anything but `ValueError` or `OSError`, or an error that does not name the path;
- runs out of 1 GiB of memory, or makes the process grow by more than 256 MiB;
- takes more than 20 seconds, or ends the process;
- runs code: unpickles an object, starts a process, or loads marshalled code.

Findings are saved as files. A separate process reads the files, so that crashes are findings too.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing as mp
import os
import pathlib
import re
import resource
import signal
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import Any

import numpy as np
import pypcd4

from mcgicp_jax import io
from tests.conftest import DATA
from tests.test_file_formats import N, las_data, small_files, write_pcd, xyz

_SECONDS = 20
_MEMORY = 2**30
_GROWTH_KIB = 2**18
# Audit events of operations that run code, or could
_EVENTS = (
    "pickle.find_class",
    "os.system",
    "os.exec",
    "os.spawn",
    "os.posix_spawn",
    "subprocess.Popen",
    "marshal.loads",
)
_NUMBERS = [0, 1, 2, 39, 41, 127, 255, 2**15, 2**16 - 1, 2**31 - 1, 2**32 - 1, 10**12, 2**63 - 1]
_WORDS = [
    b"nan",
    b"inf",
    b"-1",
    b"1e400",
    b"1_0",
    b"0x10",
    b"\x00",
    b"\xff\xfe",
    b"\n",
    b" ",
    b"property list uchar int q",
]

Seeds = list[tuple[str, bytes]]


def seeds() -> Seeds:
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        files = [(pathlib.Path(name).suffix, content) for name, content in small_files(folder).items()]
        files += [(".las", bytes_of_las(folder, point_format)) for point_format in (1, 3, 6, 8)]
        write_pcd(folder / "b.pcd", pypcd4.Encoding.BINARY, **xyz(np.float64), rgb=np.zeros(N, "f4"))
        files.append((".pcd", (folder / "b.pcd").read_bytes()))
        np.save(folder / "object.npy", np.array([[print, 1, 2]], object), allow_pickle=True)
        files.append((".npy", (folder / "object.npy").read_bytes()))
        if DATA.is_dir():
            files += real_heads(folder)
    return files


def bytes_of_las(folder: pathlib.Path, point_format: int) -> bytes:
    las_data(point_format, intensity=np.arange(N)).write(str(folder / "seed.las"))
    return (folder / "seed.las").read_bytes()


def real_heads(folder: pathlib.Path) -> Seeds:
    """The heads of files written by other programs: the first 40 points, with a header adapted to them."""
    rows = 40
    files: Seeds = []
    for path in [*DATA.glob("lidar_pair/*.ply"), *DATA.glob("lidar_pair/*.pcd")]:
        content = path.read_bytes()
        (count,) = re.findall(rb"(?:element vertex|POINTS) (\d+)", content[:1000])
        header, end, body = content.partition(b"end_header\n" if path.suffix == ".ply" else b"DATA binary\n")
        files.append((path.suffix, header.replace(count, b"%d" % rows) + end + body[: 16 * rows]))
    files += [(".bin", path.read_bytes()[: 16 * rows]) for path in sorted(DATA.rglob("velodyne/*.bin"))[:2]]
    for path in sorted(DATA.glob("planar_table/*.npz"))[:1]:
        with np.load(path) as arrays:
            np.savez(folder / "real.npz", points=arrays["source_points"][:rows], rgb=arrays["source_rgb"][:rows])
        files.append((".npz", (folder / "real.npz").read_bytes()))
    return files


def mutated(content: bytes, others: list[bytes], rng: np.random.Generator) -> bytes:
    """The file after one to five mutations, most of them in the first 600 bytes."""
    for _ in range(rng.integers(1, 6)):
        change = MUTATIONS[rng.integers(len(MUTATIONS))]
        within = min(len(content), 600) if rng.random() < 0.7 else len(content)
        content = change(content, int(rng.integers(within + 1)), others, rng)
    return content


def _flip(content: bytes, at: int, others: list[bytes], rng: np.random.Generator) -> bytes:
    return content[:at] + bytes([byte ^ (1 << rng.integers(8)) for byte in content[at : at + 1]]) + content[at + 1 :]


def _put(content: bytes, at: int, others: list[bytes], rng: np.random.Generator) -> bytes:
    new = rng.bytes(rng.integers(1, 9))
    return content[:at] + new + content[at + len(new) :]


def _put_number(content: bytes, at: int, others: list[bytes], rng: np.random.Generator) -> bytes:
    width = int(2 ** rng.integers(1, 4))
    number = _NUMBERS[rng.integers(len(_NUMBERS))] % 2 ** (8 * width)
    at -= at % 2
    return content[:at] + number.to_bytes(width, "little" if rng.random() < 0.8 else "big") + content[at + width :]


def _put_word(content: bytes, at: int, others: list[bytes], rng: np.random.Generator) -> bytes:
    return content[:at] + _WORDS[rng.integers(len(_WORDS))] + content[at + rng.integers(4) :]


def _lie(content: bytes, at: int, others: list[bytes], rng: np.random.Generator) -> bytes:
    """Replace a number in a text header."""
    number = b"%d" % _NUMBERS[rng.integers(len(_NUMBERS))]
    return content[:at] + re.sub(rb"\d+", number, content[at:], count=1)


def _swap_words(content: bytes, at: int, others: list[bytes], rng: np.random.Generator) -> bytes:
    words = content[:600].split(b" ")
    first, second = rng.integers(len(words), size=2)
    words[first], words[second] = words[second], words[first]
    return b" ".join(words) + content[600:]


def _cut(content: bytes, at: int, others: list[bytes], rng: np.random.Generator) -> bytes:
    return content[:at] + content[at + rng.integers(1, 33) :]


def _end(content: bytes, at: int, others: list[bytes], rng: np.random.Generator) -> bytes:
    return content[: rng.integers(len(content) + 1)]


def _repeat(content: bytes, at: int, others: list[bytes], rng: np.random.Generator) -> bytes:
    return content[: at + rng.integers(1, 65)] + content[at:]


def _splice(content: bytes, at: int, others: list[bytes], rng: np.random.Generator) -> bytes:
    return content[:at] + others[rng.integers(len(others))][at:]


def _within_zip(content: bytes, at: int, others: list[bytes], rng: np.random.Generator) -> bytes:
    """Mutate an array inside an .npz, whose checksums stay right."""
    try:
        with zipfile.ZipFile(BytesIO(content)) as archive:
            parts = [(name, archive.read(name)) for name in archive.namelist()]
    except Exception:
        return content
    changed = BytesIO()
    kind = zipfile.ZIP_DEFLATED if rng.random() < 0.5 else zipfile.ZIP_STORED
    with zipfile.ZipFile(changed, "w", kind) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        chosen = rng.integers(len(parts)) if parts else -1
        for i, (name, part) in enumerate(parts):
            archive.writestr(name, mutated(part, [part], rng) if i == chosen else part)
    return changed.getvalue()


MUTATIONS: list[Callable[[bytes, int, list[bytes], np.random.Generator], bytes]] = [
    *(_flip, _put, _put_number, _put_number, _put_word, _lie, _lie, _swap_words),
    *(_cut, _end, _repeat, _splice, _within_zip),
]


def files(valid: Seeds, seed: int, first: int) -> Iterator[tuple[int, str, bytes]]:
    """Endless mutated files: number, suffix and content."""
    for number in itertools.count(first):
        rng = np.random.default_rng((seed, number))
        suffix, content = valid[number % len(valid)]
        others = [other for kind, other in valid if kind == suffix]
        yield number, suffix, mutated(content, others, rng)


def read_all(seed: int, first: int, folder: str, progress: Any, findings: Any) -> None:
    """Read mutated files until the process is killed; runs in a separate process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    # Let libraries do now what they import with their first file.
    valid = seeds()
    for suffix, content in valid:
        path = pathlib.Path(folder, f"file{suffix}")
        path.write_bytes(content)
        read(path)
    ran: list[str] = []
    watching = [False]

    def watch(event: str, args: tuple[Any, ...]) -> None:
        if watching[0] and event in _EVENTS:
            ran.append(f"{event} {args}"[:200])

    sys.addaudithook(watch)
    in_use = int(pathlib.Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (in_use + _MEMORY, in_use + _MEMORY))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number, suffix, content in files(valid, seed, first):
        path = pathlib.Path(folder, f"file{suffix}")
        path.write_bytes(content)
        with progress.get_lock():
            progress[0], progress[1] = number, 1
        watching[0] = True
        outcome = read(path)
        watching[0] = False
        before, peak = peak, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        if peak > before + _GROWTH_KIB:
            outcome = f"FINDING: {(peak - before) // 1024} MiB more"
        if ran:
            outcome = f"FINDING: ran {ran[0]}"
            ran.clear()
        with progress.get_lock():
            progress[1] = 0
            progress[2 if outcome == "a cloud" else 3] += 1
        if outcome.startswith("FINDING"):
            findings.put((f"{number}{suffix}", outcome, content))


def read(path: pathlib.Path) -> str:
    """Read a file; return "a cloud", "an error" or the finding."""
    try:
        io.read(path)
    except (ValueError, OSError) as error:
        if isinstance(error.__cause__, MemoryError):
            return f"FINDING: {error!r}"
        return "an error" if str(path) in str(error) else f"FINDING: without the path, {error!r}"
    except BaseException as error:
        return f"FINDING: {error!r}"
    return "a cloud"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--findings", type=pathlib.Path, default=pathlib.Path("fuzz_findings"))
    options = parser.parse_args()
    context = mp.get_context("spawn")
    # Number of the file, whether it is being read, clouds so far, errors so far
    progress, findings = context.Array("q", 4), context.Queue()
    kept: list[tuple[str, str, bytes]] = []
    end, first = time.monotonic() + 60 * options.minutes, 0
    memory = "/dev/shm" if os.path.isdir("/dev/shm") else None
    with tempfile.TemporaryDirectory(dir=memory) as folder:
        while time.monotonic() < end:
            worker = context.Process(target=read_all, args=(options.seed, first, folder, progress, findings))
            worker.start()
            reason = watch_over(worker, progress, end)
            while not findings.empty():
                kept.append(findings.get())
            worker.kill()
            worker.join()
            if reason:
                path = max(pathlib.Path(folder).iterdir(), key=lambda path: path.stat().st_mtime_ns)
                kept.append((f"{progress[0]}{path.suffix}", reason, path.read_bytes()))
            first, progress[1] = progress[0] + 1, 0
    print(f"{progress[2] + progress[3]:,} files: {progress[2]:,} clouds, {progress[3]:,} errors; {len(kept)} findings")
    options.findings.mkdir(parents=True, exist_ok=True)
    for name, outcome, content in kept[:100]:
        (options.findings / name).write_bytes(content)
        print(f"{options.findings / name}: {outcome[:300]}")
    sys.exit(1 if kept else 0)


def watch_over(worker: Any, progress: Any, end: float) -> str:
    """Return "" when the time is up, or the finding if the reader crashes or hangs."""
    since, last = time.monotonic(), -1
    while time.monotonic() < end:
        worker.join(0.5)
        if not worker.is_alive():
            return f"FINDING: ended the process ({worker.exitcode})"
        number, reading = progress[0], progress[1]
        if not reading or number != last:
            since, last = time.monotonic(), number
        elif time.monotonic() - since > _SECONDS:
            return f"FINDING: more than {_SECONDS} seconds"
    return ""


if __name__ == "__main__":
    main()
