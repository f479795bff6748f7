"""Every notebook runs from a clean kernel, from its first cell to its last, and prints what is stored in it."""

import pathlib
import re

import nbformat
import pytest
from nbclient import NotebookClient

from tests.conftest import DATA

FOLDER = pathlib.Path(__file__).parent.parent / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
# Seconds: for one cell, and for a notebook. A notebook takes two minutes where nothing else runs.
CELL_LIMIT, LIMIT = 480, 900
NUMBER = re.compile(r"[-+]?\d+(?:,\d{3})*(?:\.\d*)?(?:e[-+]?\d+)?")
# Lines that differ from run to run.
TIMES = re.compile("per second|ms per scan|finished in the order")
# Processors round differently. Largest relative difference of a count and of other numbers, and the difference in units
# of the last digit that is small in any case.
COUNTS, OTHERS, LAST = 0.05, 0.3, 2


def printed(notebook):
    """The lines that each cell prints, without those of warnings."""
    for cell in notebook.cells:
        outputs = [output for output in cell.get("outputs", []) if output.get("name") == "stdout"]
        yield [line for line in "".join(output.text for output in outputs).splitlines() if not TIMES.search(line)]


def agree(stored, found):
    """Whether two lines have the same words, such as statuses, and nearly the same numbers."""
    words = ["".join(NUMBER.sub("#", line).split()) for line in (stored, found)]
    pairs = zip(*(NUMBER.findall(line.replace(",", "")) for line in (stored, found)), strict=False)
    return words[0] == words[1] and all(near(*pair) for pair in pairs)


def near(stored, found):
    places = len(stored.partition("e")[0].partition(".")[2])
    exponent = int(stored.partition("e")[2] or 0)
    share = COUNTS if places == 0 else OTHERS
    least = LAST * 10.0 ** (exponent - places)
    return abs(float(found) - float(stored)) <= max(share * abs(float(stored)), least) * (1 + 1e-9)


@pytest.mark.parametrize(
    ("stored", "found", "expected"),
    [
        ("54 edges, cost 17.7", "53 edges, cost 16.1", True),
        ("54 edges", "49 edges", False),
        ("GICP 40.1 mm  CONVERGED", "GICP  49.0 mm CONVERGED", True),
        ("GICP 40.1 mm CONVERGED", "GICP 60.1 mm CONVERGED", False),
        ("CONVERGED", "DEGENERATE", False),
        ("1,166 and 2,369", "1,168 and 2,354", True),
        ("1.31e-06", "1.33e-06", True),
        ("1.31e-06", "1.31e-05", False),
        ("[-0.02  0.001]", "[ 0.00  0.002]", True),
    ],
)
def test_lines_agree_within_their_noise(stored, found, expected):
    assert agree(stored, found) == expected


@pytest.mark.slow
@pytest.mark.timeout(LIMIT)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_prints_what_is_stored(path):
    notebook = nbformat.read(path, as_version=4)
    stored = list(printed(notebook))
    NotebookClient(
        notebook, timeout=CELL_LIMIT, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}
    ).execute()
    if "MCGICP_DATA" in path.read_text() and not DATA.is_dir():
        pytest.skip(f"executed, but the stored outputs are those with the real data in {DATA}")
    for number, (before, now) in enumerate(zip(stored, printed(notebook), strict=True)):
        assert len(before) == len(now), f"cell {number}: {now}"
        for line, again in zip(before, now, strict=True):
            assert agree(line, again), f"cell {number}: stored {line!r}, now {again!r}"
