"""pykdtree in place of SciPy's tree: the same matches, bit for bit."""

import subprocess
import sys
import textwrap

import numpy as np
import pytest
import scipy.spatial
from hypothesis import example, given, settings
from hypothesis import strategies as st

import mcgicp_jax as mcg
from mcgicp_jax.extend import SearchPoints
from tests.refusals import refused

pytest.importorskip("pykdtree")
SCIPY, PYKDTREE = (mcg.KDTreeSearch(backend=name) for name in ("scipy", "pykdtree"))
STILL = np.array([1.0, 0, 0, 0, 0, 0, 0])


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    size=st.integers(4, 300),
    k=st.one_of(st.integers(1, 25), st.sampled_from([100, 300])),
    num_channels=st.integers(0, 3),
    high=st.sampled_from([3, 50, None]),
    max_distance=st.sampled_from([0.7, 3.0, np.inf]),
)
@example(seed=0, size=400, k=100, num_channels=0, high=None, max_distance=np.inf)
@example(seed=0, size=400, k=300, num_channels=0, high=None, max_distance=np.inf)
def test_pykdtree_and_scipy_find_the_same_neighbours(seed, size, k, num_channels, high, max_distance):
    """Few integers, so that most distances are shared and points coincide; and random numbers."""
    rng = np.random.default_rng(seed)

    def draw(count, columns):
        return (
            rng.normal(size=(count, columns)) if high is None else rng.integers(0, high, (count, columns)).astype(float)
        )

    points = draw(size, 3)
    np.testing.assert_array_equal(PYKDTREE.neighbors(points, k), SCIPY.neighbors(points, k))
    source, target = (SearchPoints(draw(n, 3), draw(n, num_channels), np.ones(n, bool)) for n in (40, size))
    found = [search.index(target).nearest(STILL, source, max_distance, 2) for search in (PYKDTREE, SCIPY)]
    np.testing.assert_array_equal(*found)


def test_pykdtree_is_used_for_three_columns_alone():
    points = np.random.default_rng(0).normal(size=(50, 6))
    for search, columns, used in (
        (mcg.KDTreeSearch(), 3, True),
        (PYKDTREE, 3, True),
        (mcg.KDTreeSearch(), 6, False),
        (PYKDTREE, 6, False),
        (SCIPY, 3, False),
    ):
        assert isinstance(search.build(points[:, :columns]), scipy.spatial.cKDTree) != used
    refused(lambda: mcg.KDTreeSearch(backend="nanoflann"), "backend")


@pytest.mark.slow
def test_without_pykdtree_its_extra_is_named():
    """In a process of its own: whether the package is installed is looked up once."""
    code = """
        import importlib.util
        find, importlib.util.find_spec = importlib.util.find_spec, lambda name, *rest: name != "pykdtree" and find(name)
        import numpy as np, mcgicp_jax as mcg
        mcg.KDTreeSearch().neighbors(np.eye(3), 2)
        try:
            mcg.KDTreeSearch(backend="pykdtree")
        except ValueError as error:
            assert "pip install 'mcgicp_jax[fast]'" in str(error)
        else:
            raise AssertionError
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=True, timeout=120)
