"""Gradients against finite differences, and registration under jit, vmap and their compositions."""

import re
import threading

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import Status
from tests.differences import (
    CASES,
    CONVERGED,
    GATE,
    TO_ROUNDING,
    case,
    clouds_with,
    directional_errors,
    inputs_of,
    weigh,
)
from tests.precision import in_float64
from tests.refusals import refused
from tests.scenes import matched_at, motion, pair, sums_at

PADDED = 512


@pytest.fixture(scope="module")
def padded(noisy):
    source, target, truth = noisy
    return source.pad(PADDED), target.pad(PADDED), truth


@jax.jit
def gradients_of_register(inputs, source, target, starts):
    """And the results, in a batch of starts; by dense search, as programs with callbacks are not kept on disk."""

    def loss(inputs, start):
        result = registered(inputs, source, target, start, mcg.DenseSearch())
        return weigh(result.matrix), result

    return jax.vmap(jax.grad(loss, has_aux=True), in_axes=(None, 0))(inputs, starts)


def gradient_of_register(inputs, source, target, start):
    return jax.tree.map(lambda each: each[0], gradients_of_register(inputs, source, target, np.stack([start] * 3)))


def registered(inputs, source, target, start, search=None):
    options = {"init": start, "max_distance": GATE, "search": search, "soft_matches": False, **TO_ROUNDING}
    clouds = clouds_with(inputs, source, target)
    return mcg.register(*clouds, inputs["method"], robust=inputs["robust"], **options)


@in_float64
@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_register_has_the_gradient_of_its_answer(name, padded):
    """Where no match flips within the step of the difference, which is checked; in each lane of a batch."""
    source, target, _ = padded
    method, robust = case(name)
    start = mcg.register(source, target, method, robust=robust, max_distance=GATE, **CONVERGED)
    assert start.converged
    inputs = inputs_of(source, target, method, robust)
    near = start.matrix @ motion(1e-7 * np.ones(6))
    starts = np.stack([start.matrix, motion((50, 0, 0, 0, 0, 0)), near])
    gradients, results = gradients_of_register(inputs, source, target, starts)
    assert list(results.status) == [Status.CONVERGED, Status.TOO_FEW_CORRESPONDENCES, Status.CONVERGED]
    gradient, none, other = (jax.tree.map(lambda each, i=i: each[i], gradients) for i in range(3))
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(none))
    np.testing.assert_allclose(results.matrix[2], start.matrix, atol=1e-9)
    for one, leaf in zip(jax.tree.leaves(other), jax.tree.leaves(gradient), strict=True):
        np.testing.assert_allclose(one, leaf, atol=1e-6 * np.abs(leaf).max())
    before = mcg.find_correspondences(source, target, start.matrix, method, max_distance=GATE)

    def loss(moved):
        """The answer; and no match may differ from those at the start."""
        result = registered(moved, source, target, start.matrix)
        after = mcg.find_correspondences(
            *clouds_with(moved, source, target), result.matrix, moved["method"], max_distance=GATE
        )
        np.testing.assert_array_equal(after.indices, before.indices)
        np.testing.assert_array_equal(after.valid, before.valid)
        return weigh(result.matrix)

    for key, actual, expected in directional_errors(loss, inputs, gradient):
        assert abs(actual - expected) <= 1e-6 * max(abs(expected), 1e-2), key


@in_float64
def test_no_pairs_give_no_gradient_and_say_why(padded):
    source, target, truth = padded
    inputs = inputs_of(source, target, *case("mc-gicp"))
    inputs["source points"] = inputs["source points"] + 100
    gradient, result = gradient_of_register(inputs, source, target, truth)
    for leaf in jax.tree.leaves(gradient):
        np.testing.assert_array_equal(leaf, 0)
    assert result.status is Status.TOO_FEW_CORRESPONDENCES


@in_float64
def test_identical_clouds_have_a_finite_gradient(padded):
    source, _, _ = padded
    inputs = inputs_of(source, source, *case("mc-gicp"))
    gradient, result = gradient_of_register(inputs, source, source, np.eye(4))
    assert np.isfinite(gradient["source points"]).all()
    np.testing.assert_allclose(result.matrix, np.eye(4), atol=1e-5)


@in_float64
def test_padding_has_no_gradient_and_degenerate_neighborhoods_a_finite_one(padded):
    source, target, truth = padded
    # Coincident, collinear and isotropic neighbourhoods.
    points = np.array(source.unpad().points)
    points[:25] = points[0]
    points[25:50] = points[25] + np.linspace(0, 0.1, 25)[:, None] * [1.0, 2.0, 3.0]
    grid = np.stack(np.meshgrid(*[np.arange(3) * 0.05] * 3), axis=-1).reshape(-1, 3)
    points[50:77] = points[50] + grid
    cloud = mcg.preprocess(mcg.PointCloud(points, source.unpad().channels)).pad(PADDED)
    gradients, _ = gradient_of_register(inputs_of(cloud, target, *case("mc-gicp")), cloud, target, truth)
    for name in ("source points", "source channels"):
        assert np.isfinite(gradients[name]).all()
        assert np.abs(gradients[name][: len(cloud)]).max() > 0
        np.testing.assert_array_equal(gradients[name][len(cloud) :], 0)


def test_the_start_has_no_influence_on_the_answer(noisy):
    source, target, _ = noisy
    method, _ = case("gicp")
    matches = mcg.find_correspondences(source, target, motion(), method, max_distance=GATE)
    gradient = jax.grad(lambda init: weigh(mcg.estimate_pose(source, target, matches, method, init=init).matrix))
    np.testing.assert_array_equal(gradient(jnp.asarray(motion(), source.points.dtype)), 0)


@in_float64
@pytest.mark.timeout(240)
def test_the_traced_loop_is_the_host_loop(noisy):
    source, target, _ = noisy
    method, robust = case("gicp")
    host = mcg.register(source, target, method, robust=robust, max_distance=GATE)

    @eqx.filter_jit
    def traced(source, target, method, robust):
        result = mcg.register(source, target, method, robust=robust, max_distance=GATE)
        return result.matrix, (result.status, result.num_iterations, result.num_inliers), result.history["cost"]

    matrix, counts, costs = traced(source, target, method, robust)
    assert counts == (host.status, host.num_iterations, host.num_inliers)
    np.testing.assert_allclose(matrix, host.matrix, atol=1e-9)
    np.testing.assert_allclose(costs[: host.num_iterations], host.history["cost"][:-1], rtol=1e-3)
    assert np.isnan(costs[host.num_iterations + 1 :]).all()
    # jit inside jit, and grad of jit of jit: no value may be one of the other trace.
    nested = jax.jit(lambda points: jnp.sum(traced(source.replace(points=points), target, method, robust)[0]))
    jax.eval_shape(jax.grad(nested), source.points)


@pytest.mark.parametrize("photometric", [False, True])
def test_no_program_solves_batches_of_matrices_by_lapack(photometric):
    """On two cores, two such calls at once wait for each other forever (jax 0.10.2)."""
    source, target, _ = pair(size=200)
    method = mcg.MultiChannelGICP(photometric=photometric)
    program = jax.jit(lambda source, target: mcg.register(source, target, method)).lower(source, target).as_text()
    operands = re.findall(r"@lapack_\w+\(.*?: \(tensor<([^>]*)>", program)
    assert operands and {operand.count("x") for operand in operands} == {2}, operands


@pytest.mark.slow
@pytest.mark.timeout(280)
def test_nothing_dead_locks():
    """Large clouds, two threads, over a thousand callbacks, gradients under vmap: a hang fails by its time limit."""
    source, target, _ = pair(size=20_000)
    method = mcg.MultiChannelGICP(0.05, 0.3)

    def of(source, target):
        def loss(channels):
            moved = source.replace(channels=channels)
            return weigh(mcg.register(moved, target, method, max_distance=0.2, max_iterations=4).matrix)

        return loss

    loss = jax.jit(jax.value_and_grad(of(source, target)))
    expected = loss(source.channels)[0]
    failures = []

    def work():
        for _ in range(10):
            if loss(source.channels)[0] != expected:
                failures.append("another value")

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures

    small, other, _ = pair(size=2000)
    batch = jnp.stack([small.channels + 0.01 * i for i in range(8)])
    batched = jax.jit(jax.vmap(jax.grad(of(small, other))))
    for _ in range(30):
        gradient = jax.block_until_ready(batched(batch))
    assert np.isfinite(gradient).all()


@in_float64
def test_towards_zero_temperature_the_nearest_counts_alone(noisy):
    source, target, _ = noisy
    method, _ = case("gicp")
    start = mcg.register(source, target, method, max_distance=GATE, **CONVERGED).matrix
    hard, many = (
        mcg.find_correspondences(source, target, start, method, max_distance=GATE, num_candidates=m) for m in (1, 4)
    )
    np.testing.assert_array_equal(hard.indices, many.indices[0])
    cost = mcg.mahalanobis_cost(start, source, target, hard, method)
    costs = [mcg.mahalanobis_cost(start, source, target, many, method, temperature=t) for t in (1.0, 0.1, 1e-4)]
    assert costs[0] > costs[1] > costs[2] * (1 + 1e-3)
    np.testing.assert_allclose(costs[2], cost, rtol=1e-4)
    # At a pose that the hard matches balance, so do the soft ones.
    soft = mcg.estimate_pose(source, target, many, method, init=start, temperature=1e-4)
    expected = mcg.estimate_pose(source, target, hard, method, init=start)
    np.testing.assert_allclose(soft.matrix, expected.matrix, atol=1e-6)


def test_candidates_need_a_temperature(noisy):
    source, target, _ = noisy
    method, _ = case("gicp")
    matches = mcg.find_correspondences(source, target, None, method, max_distance=GATE, num_candidates=2)
    of_pair = source, target, matches, method
    refused(lambda: mcg.estimate_pose(*of_pair), "temperature", 2, None)
    refused(lambda: mcg.mahalanobis_cost(np.eye(4), *of_pair, temperature=0.0), "temperature", 0.0)
    options = {"max_distance": GATE, "num_candidates": 0}
    refused(lambda: mcg.find_correspondences(source, target, None, method, **options), "num_candidates", 0)


def test_the_determinant_keeps_learned_covariances_from_growing(noisy):
    source, target, _ = noisy
    matches = mcg.find_correspondences(source, target, motion(), mcg.GICP(), max_distance=GATE)

    def loss(log_epsilon, log_determinant):
        method = mcg.GICP(jnp.exp(log_epsilon))
        return mcg.mahalanobis_cost(motion(), source, target, matches, method, log_determinant=log_determinant)

    # Without it, a larger ε is always better; with it, there is a best one.
    epsilons = np.log([1e-4, 1e-2, 1.0])
    plain, likelihood = ([jax.grad(loss)(e, flag) for e in epsilons] for flag in (False, True))
    assert all(slope < 0 for slope in plain)
    assert likelihood[0] < 0 < likelihood[-1]
    of_plane = np.eye(4), source, target, matches, mcg.PointToPlane()
    refused(lambda: mcg.mahalanobis_cost(*of_plane, log_determinant=True), "log_determinant", "PointToPlane")


@pytest.mark.parametrize("outer", [jax.jacfwd, jax.grad])
def test_second_derivatives_are_refused(outer, noisy):
    source, target, _ = noisy
    matches = mcg.find_correspondences(source, target, motion(), mcg.GICP(1e-2), max_distance=GATE)

    def loss(shift):
        moved = source.replace(points=jnp.asarray(source.points) + shift * jnp.arange(3.0))
        return weigh(mcg.estimate_pose(moved, target, matches, mcg.GICP(1e-2)).matrix)

    jax.make_jaxpr(jax.grad(loss))(0.1)
    with pytest.raises(NotImplementedError):
        jax.make_jaxpr(outer(jax.grad(loss)))(0.1)


def test_the_pose_alone_carries_a_gradient(noisy):
    source, target, _ = noisy

    def others(points):
        result = mcg.register(source.replace(points=points), target, mcg.GICP(1e-2), max_distance=GATE)
        return jnp.sum(result.deviations) + jnp.sum(result.covariance) + result.cost + result.rmse

    with pytest.raises(NotImplementedError, match="only the pose has a derivative"):
        jax.grad(others)(jnp.asarray(source.points))


@pytest.mark.slow
@in_float64
def test_implicit_gradient_is_that_of_the_unrolled_loop(noisy):
    """Differentiating through 60 updates with M renewed each time reaches the same number, at many times the cost."""
    source, target, _ = noisy
    method, _ = case("gicp")
    from mcgicp_jax._math.poses import move_pose, se3_from_matrix

    matches = mcg.find_correspondences(source, target, motion(), method, max_distance=GATE)

    def unrolled(points):
        matched, both, _ = matched_at(source.replace(points=points), target, method, motion(), matches)

        def body(pose, _):
            sums = sums_at(pose.as_matrix(), matched, both)
            information, gradient = _normal_equations(sums)
            twist = jnp.linalg.solve(information, gradient)
            return move_pose(pose, twist, sums.center), None

        pose, _ = jax.lax.scan(body, se3_from_matrix(motion(), points.dtype), length=60)
        return weigh(pose.as_matrix())

    def implicit(points):
        return weigh(
            mcg.estimate_pose(source.replace(points=points), target, matches, method, init=motion(), **CONVERGED).matrix
        )

    expected, actual = jax.jit(jax.grad(unrolled))(source.points), jax.jit(jax.grad(implicit))(source.points)
    np.testing.assert_allclose(actual, expected, atol=1e-8 * np.abs(expected).max())


def _normal_equations(sums):
    """Gauss-Newton's information and right-hand side of a (v, ω) twist, from the sums."""
    from mcgicp_jax._pose_solver import update as _solve

    tangent = jnp.asarray(_solve._TANGENT, sums.force.dtype)
    form = _solve._quadratic_form(sums, jnp.ones_like(sums.radius))
    return tangent.T @ form[:12, :12] @ tangent, -tangent.T @ form[:12, 12]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pmap", "shard_map"])
def test_pairs_are_registered_on_several_devices(kind):
    """Here on one: what differs from `vmap` is how arrays are traced."""
    source, target, _ = pair(size=200)
    clouds = [jax.tree.map(lambda array: jnp.asarray(array)[None], cloud) for cloud in (source, target)]

    def poses(source, target):
        return mcg.register(source, target, mcg.GICP(), max_distance=0.3).matrix

    if kind == "pmap":
        found = jax.pmap(poses)(*clouds)
    else:
        mesh, spec = jax.sharding.Mesh(jax.devices()[:1], ("pairs",)), jax.sharding.PartitionSpec("pairs")
        sharded = jax.shard_map(jax.vmap(poses), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
        found = jax.jit(sharded)(*clouds)
    expected = mcg.register(source, target, mcg.GICP(), max_distance=0.3).matrix
    np.testing.assert_allclose(found[0], expected, atol=1e-5)
