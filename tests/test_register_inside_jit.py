"""Registration and alignment inside `jit` and other transformations: as outside; `test_gradients.py` has gradients."""

import re
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from tests.differences import GATE, case, weigh
from tests.precision import in_float64
from tests.scenes import motion, pair


def test_gradient_by_the_initial_pose_is_0(noisy):
    source, target, _ = noisy
    method = mcg.PointToPoint()
    matches = mcg.find_correspondences(source, target, motion(), method, max_distance=GATE)
    gradient = jax.grad(lambda init: weigh(mcg.estimate_pose(source, target, matches, method, init=init).matrix))
    np.testing.assert_array_equal(gradient(jnp.asarray(motion(), source.points.dtype)), 0)


def solves_single_matrices(program):
    """Whether no matrices are solved in batches by LAPACK: on two cores, two such calls at once wait for each other
    forever (jax 0.10.2)."""
    operands = re.findall(r"@lapack_\w+\(.*?: \(tensor<([^>]*)>", program.as_text())
    return operands and {operand.count("x") for operand in operands} == {2}


def test_photometric_program_solves_no_batches_of_matrices_by_lapack():
    program = jax.jit(lambda *clouds: mcg.register(*clouds, mcg.MultiChannelGICP(photometric=True)))
    assert solves_single_matrices(program.lower(*pair(size=200)[:2]))


@in_float64
@pytest.mark.timeout(240)
def test_traced_loop_is_the_host_loop(noisy):
    source, target, _ = noisy
    method, robust = case("gicp")
    host = mcg.register(source, target, method, robust=robust, max_distance=GATE)

    @jax.jit
    def traced(source, target, method, robust):
        result = mcg.register(source, target, method, robust=robust, max_distance=GATE)
        return result.matrix, (result.status, result.num_iterations, result.num_inliers), result.history["cost"]

    assert solves_single_matrices(traced.lower(source, target, method, robust))
    matrix, counts, costs = traced(source, target, method, robust)
    assert counts == (host.status, host.num_iterations, host.num_inliers)
    np.testing.assert_allclose(matrix, host.matrix, atol=1e-9)
    np.testing.assert_allclose(costs[: host.num_iterations], host.history["cost"][:-1], rtol=1e-3)
    assert np.isnan(costs[host.num_iterations + 1 :]).all()
    # jit inside jit, and grad of jit of jit: no value may be one of the other trace.
    nested = jax.jit(lambda points: jnp.sum(traced(source.replace(points=points), target, method, robust)[0]))
    jax.eval_shape(jax.grad(nested), source.points)


@pytest.mark.slow
@pytest.mark.timeout(280)
def test_nothing_dead_locks():
    """Large clouds, two threads, over a thousand callbacks, gradients under vmap: a hang fails by its time limit."""

    def of(source, target):
        def loss(channels):
            options = {"max_distance": 0.2, "max_iterations": 4}
            moved = source.replace(channels=channels)
            return weigh(mcg.register(moved, target, mcg.MultiChannelGICP(0.05, 0.3), **options).matrix)

        return loss

    source, target, _ = pair(size=20_000)
    loss = jax.jit(jax.value_and_grad(of(source, target)))
    expected = loss(source.channels)[0]
    with ThreadPoolExecutor(2) as threads:
        values = list(threads.map(lambda _: loss(source.channels)[0], range(20)))
    assert values == [expected] * 20

    source, target, _ = pair(size=2000)
    batch = jnp.stack([source.channels + 0.01 * i for i in range(8)])
    batched = jax.jit(jax.vmap(jax.grad(of(source, target))))
    for _ in range(30):
        gradient = jax.block_until_ready(batched(batch))
    assert np.isfinite(gradient).all()


def test_second_derivatives_of_estimate_pose_are_refused(noisy):
    source, target, _ = noisy
    matches = mcg.find_correspondences(source, target, motion(), mcg.PointToPoint(), max_distance=GATE)

    def loss(shift):
        moved = source.replace(points=jnp.asarray(source.points) + shift * jnp.arange(3.0))
        return weigh(mcg.estimate_pose(moved, target, matches, mcg.PointToPoint()).matrix)

    for outer in (jax.jacfwd, jax.grad):
        with pytest.raises(NotImplementedError):
            jax.make_jaxpr(outer(jax.grad(loss)))(0.1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pmap", "shard_map"])
def test_pairs_are_registered_on_several_devices(kind):
    """Here on one: what differs from `vmap` is how arrays are traced."""
    clouds = pair(size=200)[:2]

    def poses(source, target):
        return mcg.register(source, target, mcg.GICP(), max_distance=0.3).matrix

    if kind == "pmap":
        several = jax.pmap(poses)
    else:
        mesh, spec = jax.sharding.Mesh(jax.devices()[:1], ("pairs",)), jax.sharding.PartitionSpec("pairs")
        several = jax.jit(jax.shard_map(jax.vmap(poses), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))
    (matrix,) = several(*jax.tree.map(lambda array: jnp.asarray(array)[None], clouds))
    np.testing.assert_allclose(matrix, poses(*clouds), atol=1e-5)
