"""Fixtures, and how the tests compile."""

import gc
import importlib.metadata
import os
import pathlib

# Compilation takes most of the tests' time, and on CPUs four times as much where it optimizes. Unless XLA_FLAGS is set,
# the tests do without, and a fifth faster where LLVM compiles a program in one part instead of up to 32. CI sets it for
# the slow tests of what users run, and for a second run of all quick tests.
# XLA aborts at flags that it does not know; jaxlib 0.11.1 no longer knows the last one.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
    + " --xla_cpu_use_fusion_emitters=false"
    * (tuple(map(int, importlib.metadata.version("jaxlib").split(".")[:3])) < (0, 11, 1)),
)
# Many tests are about the host. JAX_PLATFORMS=cuda,cpu runs all on a GPU.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Keep all compiled programs between runs.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(pathlib.Path(__file__).parent.parent / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# There is a worker for each core. Where each has further threads for BLAS, these wait for each other: 3 % of the time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import pytest

import mcgicp_jax
from mcgicp_jax._compute.programs import LOGGER

# Its record of a long compilation would be a line of whichever command a process runs then.
LOGGER.disabled = True

DATA = pathlib.Path(os.environ.get("MCGICP_DATA", pathlib.Path(__file__).parents[2] / "shared" / "data"))


def pytest_collection_finish():
    """Tracing makes many objects that stay: at Python's usual thresholds, 700, 10 and 10, the search for garbage among
    them is 29 % of the time to trace and lower the gradient of `register`."""
    gc.freeze()
    gc.set_threshold(100_000, 20, 100)


def pytest_generate_tests(metafunc):
    marker = metafunc.definition.get_closest_marker("precision")
    if marker is not None:
        metafunc.parametrize("precision", marker.args, indirect=True, scope="module")


@pytest.fixture(autouse=True, scope="module")
def precision(request):
    """Fixtures of modules whose tests run in both precisions depend on it."""
    jax.config.update("jax_enable_x64", getattr(request, "param", "float32") == "float64")
    yield
    jax.config.update("jax_enable_x64", False)


# Each compiled program takes some twenty memory maps, the quick tests of a module up to 7,500. Linux allows a process
# 65,530, and beyond that the compiler aborts.
_MAPS = pathlib.Path("/proc/self/maps")
_MANY_MAPS = 40_000


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


@pytest.fixture
def command(capsys):
    """Runs the command line with its arguments, numbers and paths among them; its exit code, output and errors."""
    from mcgicp_jax.__main__ import main

    def run(*arguments):
        return main([str(argument) for argument in arguments]), *capsys.readouterr()

    return run


@pytest.fixture(scope="module")
def noisy(precision):
    """A pair with 5 cm of noise on a 2 m cloud, so that terms missing from a gradient show."""
    from tests.scenes import pair

    return pair(size=400, noise=0.05, channel_noise=0.05)


@pytest.fixture(scope="module")
def raw():
    """Pairs of a batch, and the true poses."""
    from tests.batches import SIZES, raw_pair

    return [raw_pair(size, seed) for seed, size in enumerate(SIZES)]


@pytest.fixture(scope="module")
def alone(raw):
    """Each pair by `register`."""
    from tests.batches import METHOD

    return [
        mcgicp_jax.register(mcgicp_jax.preprocess(source), mcgicp_jax.preprocess(target), METHOD, max_distance=0.5)
        for source, target, _ in raw
    ]
