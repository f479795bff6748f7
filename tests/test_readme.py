"""The README is run: its snippets, in order, in one namespace."""

import pathlib
import re

import numpy as np
import pytest

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
    # It trains: the error before is 0.014.
    assert namespace["error"] < 0.005 and abs(namespace["weights"][0] - 1.5) < 0.5
    assert len(namespace["world"]) > 5000
    assert len(namespace["results"]) == 4
    # Of the box room; its second frame is also 3 mm lower, and tilted by 0.026 rad.
    before, after = (frame.pose for frame in namespace["frames"][:2])
    assert namespace["planar"].converged
    np.testing.assert_allclose(namespace["planar"].matrix[:2], (np.linalg.inv(before) @ after)[:2], atol=0.03)
