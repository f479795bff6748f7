"""The README is run: its snippets, in order, in one namespace. The other reference is `help`."""

import pathlib
import pydoc
import re
import sys

import pytest

import mcgicp_jax as mcg

README = pathlib.Path(__file__).parent.parent / "README.md"


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_snippets_run_as_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    snippets = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    assert len(snippets) == 4
    namespace = {}
    for snippet in snippets:
        exec(compile(snippet, str(README), "exec"), namespace)
    assert "CONVERGED" in capsys.readouterr().out
    gradient = namespace["gradient"]
    assert gradient.shape == namespace["source_cloud"].channels.shape
    assert abs(gradient).max() > 0
    assert namespace["error"] < 0.02 and len(namespace["world"]) > 5000
    assert len(namespace["results"]) == 4


def test_it_is_short_and_has_two_set_up_commands():
    text = README.read_text()
    # 90 lines, and 30 of limits, extras and citation.
    assert 60 <= len(text.splitlines()) <= 120
    assert max(map(len, text.splitlines())) <= 120
    assert len(re.findall(r"^pip install .*$", text, flags=re.MULTILINE)) == 2


@pytest.mark.parametrize("name", [name for name in mcg.__all__ if callable(getattr(mcg, name))])
def test_help_fits_on_two_screens(name):
    """Types are printed by their names. Classes inherit up to a screen and a half of members, which come last."""
    thing = getattr(mcg, name)
    # Without the members of `int`.
    lines = pydoc.plain(pydoc.render_doc(thing)).split("Methods inherited from builtins.int")[0].splitlines()
    # Since 3.13, Python gives each parameter of a long signature a line.
    parameters = 40 if sys.version_info >= (3, 13) else 0
    assert len(lines) <= (180 if isinstance(thing, type) else 100) + parameters
    assert max(map(len, lines)) < 800
