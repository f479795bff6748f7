"""Accelerators, without one: where programs run, on which devices, in what precision, and for how many pairs."""

import importlib.util
import os
import pathlib
import re
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh

import mcgicp_jax as mcg
from mcgicp_jax import extend
from mcgicp_jax._registration import chunks
from mcgicp_jax.metrics import pose_error
from tests.batches import METHOD, assert_same, raw_pair
from tests.scenes import pair


@pytest.fixture(scope="module")
def clouds():
    return [mcg.preprocess(cloud.unpad()) for cloud in pair(size=300)[:2]]


@pytest.mark.slow
def test_concrete_clouds_are_registered_on_the_cpu():
    """The default device is one that is not there: a program that runs on it raises an error."""
    raw = [cloud.unpad() for cloud in pair(size=300)[:2]]
    prior = (np.eye(4), np.diag([1e-4] * 5 + [0]))
    with jax.default_device("tpu"), ThreadPoolExecutor(1) as executor:
        source, target = (mcg.preprocess(cloud) for cloud in raw)
        results = mcg.register_batch([source], [target], mcg.MultiChannelGICP(), executor=executor)
        results += [mcg.register(source, target, mcg.GICP(), prior=given) for given in (None, prior)]
        assert all(result.converged and np.isfinite(result.deviations).all() for result in results)
        assert np.isfinite(results[1].jacobian("source")).all()
        assert mcg.find_correspondences(source, target, None, mcg.GICP(), max_distance=0.5).valid.any()


def test_rows_that_are_missing_do_not_share_one_row():
    table, index = jnp.arange(5.0) + 10, jnp.array([[1, -1], [-1, -1], [0, 2], [-1, 3], [4, -1]])

    def gathered(table, index):
        return extend.blockwise(
            lambda _, own, near: (near.tree.T,), None, extend.Input(table), extend.Input(table, index)
        )[0]

    np.testing.assert_array_equal(jax.jit(gathered)(table, index) - 10, [[1, 0], [1, 1], [0, 2], [3, 3], [4, 4]])


@pytest.mark.slow
def test_products_are_in_full_precision_and_nothing_is_called_back(clouds):
    """By default, GPUs round the factors of products to 11 bits."""
    source, target = (cloud.pad() for cloud in clouds)

    def loss(points, others, origin, init):
        moving, still = source.replace(points=points, origin=origin), target.replace(points=others)
        result = mcg.register(moving, still, METHOD, init=init, prior=(np.eye(4), np.eye(6)), search=mcg.DenseSearch())
        constants = jax.lax.stop_gradient((result.covariance, result.deviations))
        numbers = *constants, result.matrix, result.information
        return sum(map(jnp.sum, (*numbers, moving.transform(result.T_target_source).points)))

    arrays = source.points, target.points, np.zeros(3, np.float32), np.eye(4, dtype=np.float32)
    gradient = jax.vmap(jax.grad(jax.jit(loss), argnums=(0, 1)))
    text = jax.jit(gradient).lower(*(jnp.stack([array] * 2) for array in arrays)).as_text()
    products = [line for line in text.splitlines() if re.search(r"stablehlo\.(dot|convolution)", line)]
    # Of products without a sum, XLA makes multiplications.
    inexact = [line for line in products if not re.search(r"HIGHEST, HIGHEST|contracting_dims = \[\] x \[\]", line)]
    assert len(products) > 100 and not inexact and "callback" not in text


def test_executors_register_pairs_one_by_one(clouds):
    """One pair would have a whole chunk for itself."""
    source, target = clouds
    options = {"search": mcg.DenseSearch(), "max_distance": 0.5}
    with ThreadPoolExecutor(2) as executor:
        found = mcg.register_batch([source] * 2, [target] * 2, mcg.GICP(), executor=executor, **options)
    assert_same(found, [mcg.register(source, target, mcg.GICP(), **options)] * 2)


# Number of pairs and rows of source and target of each search that is compiled.
COMPILED = []


class ForFewPairs(mcg.DenseSearch):
    """A search for which memory suffices for some pairs."""

    most: int = eqx.field(static=True)

    def nearest_traced(self, pose, source, target, *rest):
        same = jax.custom_batching.custom_vmap(lambda indices: indices)

        @same.def_vmap
        def _(count, batched, indices):
            COMPILED.append((count, source.valid.size, target.valid.size))
            if count > self.most:
                raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")
            return indices, batched[0]

        return same(super().nearest_traced(pose, source, target, *rest))


@pytest.mark.parametrize(
    ("memory", "size"),
    [
        (None, 256),
        ({"bytes_limit": 80e9, "bytes_in_use": 1e9}, 256),
        ({"bytes_limit": 80e9, "bytes_in_use": 79e9}, 64),
        ({"bytes_limit": 1e8}, 16),
    ],
)
def test_chunks_are_as_large_as_memory_allows(memory, size):
    device = SimpleNamespace(platform="gpu", memory_stats=lambda: memory)
    group = chunks._Group(print, mock.Mock(spec=Mesh, devices=[device]), 64)
    cloud = SimpleNamespace(valid=np.ones(2048))
    group.waiting.append((0, (None, None, cloud, cloud)))
    assert group.largest() == size


@pytest.mark.slow
def test_smaller_chunks_where_memory_does_not_suffice():
    """No pair is lost. The surfaces are padded to a size class of each side."""
    sides = [[mcg.preprocess(raw_pair(185 + i, i)[side]) for i in range(3)] for side in (0, 1)]
    few = jax.local_device_count()
    COMPILED.clear()
    results = mcg.register_batch(*sides, mcg.GICP(), max_distance=0.5, search=ForFewPairs(few))
    for result, *clouds in zip(results, *sides, strict=True):
        alone = mcg.register(*clouds, mcg.GICP(), max_distance=0.5)
        assert result.status is alone.status and max(pose_error(result.matrix, alone.matrix)) < 1e-5
    assert {tuple(rows) for _, *rows in COMPILED} == {(192, 256)}
    assert COMPILED[0][0] > few == COMPILED[-1][0]


@pytest.mark.slow
def test_pairs_that_begin_again_keep_their_order():
    source, target = (mcg.preprocess(cloud) for cloud in raw_pair(185, 0)[:2])
    search = ForFewPairs(jax.local_device_count())
    ended = mcg.register_as_completed([source] * 9, [target] * 9, mcg.GICP(), max_distance=0.5, search=search)
    assert [number for number, _ in ended] == list(range(9))


@pytest.mark.slow
def test_one_line_says_that_memory_does_not_suffice_for_one_pair():
    source, target = (mcg.preprocess(cloud) for cloud in raw_pair(185, 0)[:2])
    with pytest.raises(MemoryError, match="padded to 192 and 256 points"):
        mcg.register_batch([source], [target], mcg.GICP(), max_distance=0.5, search=ForFewPairs(0))


IN_CHUNKS = """
    import jax, numpy as np
    import mcgicp_jax as mcg
    from tests.batches import raw_pair

    def registered(num_devices):
        # More than two chunks of four pairs for each device: while the first results are read, others are computed.
        clouds = [[raw_pair(100, number % 5)[side] for number in range(9 * num_devices)] for side in (0, 1)]
        poses, devices = {}, set()
        options = {"max_distance": 0.5, "search": mcg.DenseSearch()}
        for number, result in mcg.register_as_completed(*clouds, mcg.GICP(), **options):
            poses[number] = result.matrix
            chunks = [array for array in jax.live_arrays() if array.ndim and len(array) == 4 * num_devices]
            devices |= {device.id for array in chunks for device in array.devices()}
        return [poses[number] for number in range(5)], devices

    with jax.default_device(jax.local_devices()[2]):
        alone, devices = registered(1)
    assert devices == {2}, devices
    everywhere, devices = registered(4)
    assert devices == {0, 1, 2, 3}, devices
    np.testing.assert_allclose(alone, everywhere, atol=1e-5)
"""


def run(script, folder, **environment):
    root = pathlib.Path(__file__).parents[1]
    environment = os.environ | environment | {"PYTHONPATH": os.pathsep.join([str(root), *sys.path])}
    subprocess.run([sys.executable, "-c", textwrap.dedent(script)], cwd=folder, env=environment, check=True)


@pytest.mark.slow
def test_chunks_follow_the_default_device(tmp_path):
    dump = f" --xla_dump_to={tmp_path} --xla_dump_hlo_module_re=.*registered.*"
    run(IN_CHUNKS, tmp_path, XLA_FLAGS=f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=4 {dump}")
    programs = [path.read_text() for path in tmp_path.glob("*after_optimizations.txt")]
    # No device waits for another one.
    assert programs and not any(re.search("all-reduce|all-gather|all-to-all|permute[(]", text) for text in programs)


FOR_H100 = """
    import re
    import jax, numpy as np
    import mcgicp_jax as mcg
    from jax.experimental import topologies
    from jax.sharding import SingleDeviceSharding
    from tests.batches import METHOD
    from tests.scenes import room_corner

    TARGET = '''
        gpu_device_info {
            threads_per_block_limit: 1024 threads_per_warp: 32 shared_memory_per_block: 49152
            shared_memory_per_core: 233472 shared_memory_per_block_optin: 232448 threads_per_core_limit: 2048
            core_count: 132 fpus_per_core: 128 block_dim_limit_x: 2147483647 block_dim_limit_y: 65535
            block_dim_limit_z: 65535 memory_bandwidth: 3352320000000 l2_cache_size: 52428800 clock_rate_ghz: 1.98
            device_memory_size: 84978434048 registers_per_core_limit: 65536 registers_per_block_limit: 65536
            cuda_compute_capability { major: 9 }
        }
        platform_name: "CUDA" device_description_str: "NVIDIA H100 80GB HBM3"
    '''
    PAIRS, SIZE = 4, 4096
    clouds = [mcg.PointCloud(*room_corner(SIZE, seed=seed)) for seed in (0, 1)]
    source, target = (mcg.preprocess(cloud, voxel_size=None) for cloud in clouds)

    def pose(points):
        moving = source.replace(points=points)
        return mcg.register(moving, target, METHOD, max_distance=0.5, search=mcg.DenseSearch()).matrix

    (device,) = topologies.get_topology_desc("", "cuda", target_config=TARGET, topology="1x1x1").devices
    points = jax.ShapeDtypeStruct((PAIRS, SIZE, 3), np.float32, sharding=SingleDeviceSharding(device))
    program = jax.jit(jax.vmap(pose)).lower(points).compile()
    products = re.findall(" dot[(].*", program.as_text())
    assert products and all("operand_precision={highest,highest}" in product for product in products)
    assert "callback" not in program.as_text()
    # The distances of all pairs of points are never stored.
    assert program.memory_analysis().temp_size_in_bytes < 0.2 * PAIRS * 4 * SIZE**2
"""


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("jax_cuda12_plugin") is None, reason="needs jax[cuda12], whose compiler needs no GPU"
)
def test_program_for_an_h100(tmp_path):
    run(FOR_H100, tmp_path, JAX_PLATFORMS="cpu", JAX_SKIP_CUDA_CONSTRAINTS_CHECK="1", XLA_FLAGS="")
