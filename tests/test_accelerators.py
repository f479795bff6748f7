"""Accelerators, without one: where programs run, on which devices, in what precision, and with how many lanes."""

import os
import pathlib
import re
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import extend
from mcgicp_jax.metrics import pose_error
from tests.batches import METHOD, assert_same, raw_pair
from tests.scenes import pair


@pytest.fixture(scope="module")
def clouds():
    return [mcg.preprocess(cloud.unpad()) for cloud in pair(size=300)[:2]]


def test_concrete_clouds_are_registered_on_the_cpu():
    """The default device is one that is not there: a program that runs on it raises an error."""
    raw = [cloud.unpad() for cloud in pair(size=300)[:2]]
    prior = (np.eye(4), np.diag([1e-4] * 5 + [0]))
    with jax.default_device("tpu"), ThreadPoolExecutor(1) as executor:
        source, target = (mcg.preprocess(cloud) for cloud in raw)
        results = [mcg.register(source, target, mcg.MultiChannelGICP(), prior=given) for given in (None, prior)]
        results += mcg.register_batch([source], [target], mcg.GICP(), executor=executor)
        assert all(result.converged and np.isfinite(result.deviations).all() for result in results)
        assert np.isfinite(results[0].jacobian("source")).all()
        assert mcg.find_correspondences(source, target, None, mcg.GICP(), max_distance=0.5).valid.any()


def test_rows_that_are_missing_do_not_share_one_row():
    table, index = jnp.arange(5.0) + 10, jnp.array([[1, -1], [-1, -1], [0, 2], [-1, 3], [4, -1]])

    def gathered(table, index):
        return extend.blockwise(
            lambda _, own, near: (near.tree.T,), None, extend.Input(table), extend.Input(table, index)
        )[0]

    np.testing.assert_array_equal(jax.jit(gathered)(table, index) - 10, [[1, 0], [1, 1], [0, 2], [3, 3], [4, 4]])


@pytest.mark.slow
def test_products_are_in_full_precision(clouds):
    """By default, GPUs round the factors of products to 11 bits."""
    source, target = (cloud.pad() for cloud in clouds)

    def loss(points, others, origin, init):
        moving, still = source.replace(points=points, origin=origin), target.replace(points=others)
        result = mcg.register(moving, still, METHOD, init=init, prior=(np.eye(4), np.eye(6)), search=mcg.DenseSearch())
        numbers = result.matrix, result.covariance, result.deviations, result.information
        return sum(map(jnp.sum, (*numbers, moving.transform(result.T_target_source).points)))

    arrays = source.points, target.points, np.zeros(3, np.float32), np.eye(4, dtype=np.float32)
    gradient = jax.vmap(jax.grad(jax.jit(loss), argnums=(0, 1)))
    text = jax.jit(gradient).lower(*(jnp.stack([array] * 2) for array in arrays)).as_text()
    products = [line for line in text.splitlines() if re.search(r"stablehlo\.(dot|convolution)", line)]
    # Of products without a sum, XLA makes multiplications.
    inexact = [line for line in products if not re.search(r"HIGHEST, HIGHEST|contracting_dims = \[\] x \[\]", line)]
    assert len(products) > 100 and not inexact


def test_executors_do_not_run_lanes(clouds):
    """One pair of a chunk would have all lanes for itself."""
    source, target = clouds
    options = {"search": mcg.DenseSearch(), "max_distance": 0.5}
    with ThreadPoolExecutor(2) as executor:
        found = mcg.register_batch([source] * 2, [target] * 2, mcg.GICP(), executor=executor, **options)
    alone = mcg.register(source, target, mcg.GICP(), **options)
    assert_same(found, [alone] * 2)


# Number of lanes and rows of source and target of each search that is compiled.
COMPILED = []


class ForFewLanes(mcg.DenseSearch):
    """A search for which memory suffices in some lanes."""

    most: int = eqx.field(static=True)

    def nearest_traced(self, pose, source, target, *rest):
        found = super().nearest_traced(pose, source, target, *rest)

        @jax.custom_batching.custom_vmap
        def within_memory(indices):
            return indices

        @within_memory.def_vmap
        def _(count, batched, indices):
            COMPILED.append((count, source.valid.size, target.valid.size))
            if count > self.most:
                raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")
            return indices, batched[0]

        return within_memory(found)


def test_fewer_lanes_where_memory_does_not_suffice():
    """No pair is lost. The surfaces are padded to a size class of each side."""
    sides = [[mcg.preprocess(raw_pair(185 + i, i)[side]) for i in range(7)] for side in (0, 1)]
    expected = mcg.register_batch(*sides, mcg.GICP(), max_distance=0.5, search=ForFewLanes(1000))
    first = COMPILED.copy()
    few = jax.local_device_count()
    found = mcg.register_batch(*sides, mcg.GICP(), max_distance=0.5, search=ForFewLanes(few))
    assert [result.status for result in found] == [result.status for result in expected]
    for one, other in zip(found, expected, strict=True):
        assert max(pose_error(one.matrix, other.matrix)) < 1e-5
    assert {tuple(rows) for _, *rows in first} == {(192, 256)}
    assert min(count for count, *_ in first) > few == COMPILED[-1][0]


IN_LANES = """
    import jax, numpy as np
    import mcgicp_jax as mcg
    from tests.batches import raw_pair

    def registered():
        clouds = [[mcg.preprocess(raw_pair(120, seed)[side]) for seed in range(5)] for side in (0, 1)]
        poses, devices, before = {}, set(), jax.live_arrays()
        options = {"max_distance": 0.5, "search": mcg.DenseSearch()}
        for number, result in mcg.register_as_completed(*clouds, mcg.GICP(), **options):
            poses[number] = result.matrix
            arrays = [array for array in jax.live_arrays() if not any(array is each for each in before)]
            devices |= {device.id for array in arrays for device in array.devices()}
        return [poses[number] for number in sorted(poses)], devices

    with jax.default_device(jax.local_devices()[2]):
        alone, devices = registered()
    assert devices == {2}, devices
    everywhere, devices = registered()
    assert devices == {0, 1, 2, 3}, devices
    np.testing.assert_allclose(alone, everywhere, atol=1e-5)
"""


@pytest.mark.slow
def test_lanes_follow_the_default_device(tmp_path):
    root = pathlib.Path(__file__).parents[1]
    flags = os.environ["XLA_FLAGS"] + " --xla_force_host_platform_device_count=4"
    environment = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": os.pathsep.join([str(root), *sys.path])}
    subprocess.run([sys.executable, "-c", textwrap.dedent(IN_LANES)], cwd=tmp_path, env=environment, check=True)
