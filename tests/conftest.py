"""Fixtures, and run-time checks of annotated shapes: beartype checks every call into the package during the tests."""

import os
import pathlib

from jaxtyping import install_import_hook

import tests.checks  # noqa: F401

# Keep compiled programs between runs: compilation takes most of the tests' time.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(pathlib.Path(__file__).parent.parent / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")

with install_import_hook("mcgicp_jax", "tests.checks.checked"):
    import mcgicp_jax
    import mcgicp_jax.__main__  # noqa: F401

import jax
import pytest

DATA = pathlib.Path(os.environ.get("MCGICP_DATA", pathlib.Path(__file__).parents[2] / "shared" / "data"))


# Modules that depend on the precision; only these run in float64 too.
_IN_FLOAT64 = (
    *(
        "align_gradients",
        "cost",
        "covariance",
        "gaussians",
        "graph",
        "large_coordinates",
        "methods",
        "photometric",
        "reference",
        "register",
        "solve",
        "tie_points",
    ),
    "transformations",
)


def pytest_collection_modifyitems(config, items):
    if jax.config.jax_enable_x64:
        modules = {f"test_{name}.py" for name in _IN_FLOAT64}
        config.hook.pytest_deselected(items=[item for item in items if item.path.name not in modules])
        items[:] = [item for item in items if item.path.name in modules]


# Each compiled program takes dozens of memory maps. Linux allows a process 65,530, and beyond that the compiler aborts;
# tests of transformations compile for many shapes.
_MAPS = pathlib.Path("/proc/self/maps")
_MANY_MAPS = 30_000


@pytest.fixture(autouse=True, scope="module")
def programs_are_let_go():
    yield
    if _MAPS.exists() and len(_MAPS.read_bytes().splitlines()) > _MANY_MAPS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def data() -> pathlib.Path:
    """Folder of the real clouds; skips the test if there is none."""
    if not DATA.is_dir():
        pytest.skip(f"no real data in {DATA} (set MCGICP_DATA)")
    return DATA


@pytest.fixture(scope="module")
def noisy():
    """A pair with 5 cm of noise on a 2 m cloud, so that terms missing from a gradient show."""
    from tests.scenes import pair

    return pair(size=400, noise=0.05, channel_noise=0.05)
