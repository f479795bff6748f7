"""The same clouds give the same numbers, to the last bit: again, with other threads, in another process."""

import os
import subprocess
import sys

import numpy as np
import pytest

import mcgicp_jax as mcg
from tests.scenes import pair

METHODS = {"gicp": mcg.GICP(), "mc-gicp": mcg.MultiChannelGICP()}
_IN_ANOTHER_PROCESS = """
from tests.test_bitwise_repeatability import METHODS, bits, clouds
import mcgicp_jax as mcg
for method in METHODS.values():
    print(bits(mcg.register(*clouds(), method)))
print(mcg.global_pose(*clouds()).matrix.tobytes().hex())
"""


def clouds():
    # Rounded, so that many distances are equal.
    raw = [cloud.unpad() for cloud in pair(size=1000)[:2]]
    return [mcg.preprocess(mcg.PointCloud(np.round(cloud.points, 2), cloud.channels)) for cloud in raw]


def bits(result):
    numbers = (result.matrix, result.cost, result.rmse, result.information, result.covariance, result.overlap)
    return b"".join(np.asarray(number).tobytes() for number in numbers).hex() + result.status.name


@pytest.fixture(scope="module")
def expected():
    return {name: bits(mcg.register(*clouds(), method)) for name, method in METHODS.items()}


@pytest.mark.parametrize("name", METHODS)
def test_repeated_runs_with_any_number_of_workers_agree(name, expected):
    prepared = clouds()
    for turn in range(15):
        search = mcg.KDTreeSearch(workers=(-1, 1, 2, 3, 8)[turn % 5])
        if turn % 5 == 0:
            prepared = [mcg.preprocess(cloud.unpad(), search=search) for cloud in prepared]
        assert bits(mcg.register(*prepared, METHODS[name], search=search)) == expected[name]


@pytest.mark.slow
def test_another_process_agrees(expected):
    """On as many cores: what XLA compiles depends on their number. Compiled anew, not loaded from the cache."""
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    command = [sys.executable, "-c", _IN_ANOTHER_PROCESS]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    anywhere = mcg.global_pose(*clouds()).matrix.tobytes().hex()
    assert done.stdout.split() == [*expected.values(), anywhere]
