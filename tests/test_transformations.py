"""Gradients against finite differences, and registration under jit, vmap and their compositions."""

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
from tests.precision import in_float64, tolerance
from tests.scenes import motion, pair


@in_float64
@pytest.mark.parametrize(
    "name", [name if "gicp" in name else pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
def test_register_has_the_gradient_of_its_answer(name, noisy):
    """Where no match flips within the step of the difference, which is checked."""
    source, target, _ = noisy
    method, robust = case(name)
    start = mcg.register(source, target, method, robust=robust, max_distance=GATE, **CONVERGED)
    assert start.converged

    def result_of(inputs):
        clouds = clouds_with(inputs, source, target)
        return mcg.register(
            *clouds, inputs["method"], robust=inputs["robust"], init=start.matrix, max_distance=GATE, **TO_ROUNDING
        )

    inputs = inputs_of(source, target, method, robust)
    gradient = jax.jit(jax.grad(lambda inputs: weigh(result_of(inputs).matrix)))(inputs)
    before = mcg.find_correspondences(source, target, start.matrix, method, max_distance=GATE)

    def loss(moved):
        """The answer; and no match may differ from those at the start."""
        result = result_of(moved)
        after = mcg.find_correspondences(
            *clouds_with(moved, source, target), result.matrix, moved["method"], max_distance=GATE
        )
        np.testing.assert_array_equal(after.indices, before.indices)
        np.testing.assert_array_equal(after.valid, before.valid)
        return weigh(result.matrix)

    for key, actual, expected in directional_errors(loss, inputs, gradient):
        assert abs(actual - expected) <= 1e-6 * max(abs(expected), 1e-2), key


@in_float64
def test_implicit_gradient_is_that_of_the_unrolled_loop(noisy):
    """Differentiating through 60 updates with M renewed each time reaches the same number, at many times the cost."""
    source, target, _ = noisy
    method, _ = case("gicp")
    from mcgicp_jax._math.poses import move_pose, se3_from_matrix
    from mcgicp_jax._methods.surfaces import surface_pair
    from mcgicp_jax._pose_solver.matched import Motion, match_surfaces
    from mcgicp_jax._pose_solver.sums import sums_of

    matches = mcg.find_correspondences(source, target, motion(), method, max_distance=GATE)

    def unrolled(points):
        pair = surface_pair(method, source.replace(points=points), target, observed=False)
        matched = match_surfaces(pair.source, pair.target, matches)

        def body(pose, _):
            sums = sums_of(Motion(pose.rotation().as_matrix(), pose.translation()), matched, pair.terms)
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


def test_the_start_has_no_influence_on_the_answer(noisy):
    source, target, _ = noisy
    method, _ = case("gicp")
    matches = mcg.find_correspondences(source, target, motion(), method, max_distance=GATE)
    gradient = jax.grad(lambda init: weigh(mcg.estimate_pose(source, target, matches, method, init=init).matrix))
    np.testing.assert_array_equal(gradient(jnp.asarray(motion(), source.points.dtype)), 0)


@in_float64
def test_no_pairs_give_no_gradient_and_say_why(noisy):
    source, target, _ = noisy
    method, _ = case("mc-gicp")

    def loss(points):
        result = mcg.register(source.replace(points=points + 100), target, method, max_distance=GATE)
        return weigh(result.matrix), result

    gradient, result = jax.jit(jax.grad(loss, has_aux=True))(source.points)
    np.testing.assert_array_equal(gradient, 0)
    assert result.status is Status.TOO_FEW_CORRESPONDENCES


@in_float64
def test_identical_clouds_have_a_finite_gradient(noisy):
    source, _, _ = noisy
    method, _ = case("mc-gicp")

    def loss(points):
        result = mcg.register(source.replace(points=points), source, method, max_distance=GATE)
        return mcg.metrics.pose_error(result.matrix, jnp.eye(4, dtype=points.dtype))[0]

    value, gradient = jax.jit(jax.value_and_grad(loss))(source.points)
    assert value < 1e-5 and np.isfinite(gradient).all()


@in_float64
@pytest.mark.timeout(240)
def test_the_traced_loop_is_the_host_loop(noisy):
    source, target, _ = noisy
    method, robust = case("mc-gicp")
    host = mcg.register(source, target, method, robust=robust, max_distance=GATE)

    @eqx.filter_jit
    def traced(source, target, method, robust):
        result = mcg.register(source, target, method, robust=robust, max_distance=GATE)
        return result.matrix, (result.status, result.num_iterations, result.num_inliers), result.history["cost"]

    matrix, counts, costs = traced(source, target, method, robust)
    assert counts == (host.status, host.num_iterations, host.num_inliers)
    np.testing.assert_allclose(matrix, host.matrix, atol=tolerance(1e-6, 1e-9))
    np.testing.assert_allclose(costs[: host.num_iterations], host.history["cost"][:-1], rtol=1e-3)
    assert np.isnan(costs[host.num_iterations + 1 :]).all()
    # jit inside jit, and grad of jit of jit.
    nested = jax.jit(lambda points: jnp.sum(traced(source.replace(points=points), target, method, robust)[0]))
    assert np.isfinite(jax.grad(nested)(source.points)).all()


@in_float64
@pytest.mark.timeout(240)
@pytest.mark.parametrize("name", ["gicp", pytest.param("mc-gicp", marks=pytest.mark.slow)])
def test_a_batch_is_its_lanes(name, noisy):
    source, target, _ = noisy
    method, _ = case(name)
    starts = jnp.asarray(np.stack([motion(), motion((50, 0, 0, 0, 0, 0)), np.eye(4)]), source.points.dtype)

    def lane(start, points):
        result = mcg.register(source.replace(points=points), target, method, init=start, max_distance=GATE)
        return weigh(result.matrix), result.status

    batched = jax.jit(jax.vmap(jax.value_and_grad(lane, argnums=1, has_aux=True), in_axes=(0, None)))
    (values, statuses), gradients = batched(starts, source.points)
    assert list(statuses) == [Status.CONVERGED, Status.TOO_FEW_CORRESPONDENCES, Status.CONVERGED]
    single = jax.jit(jax.value_and_grad(lane, argnums=1, has_aux=True))
    for i, start in enumerate(starts):
        (value, _), gradient = single(start, source.points)
        np.testing.assert_allclose(values[i], value, atol=tolerance(1e-4, 1e-9))
        scale = max(np.abs(gradient).max(), 1e-6)
        np.testing.assert_allclose(gradients[i], gradient, atol=scale * tolerance(5e-2, 1e-6))


@pytest.mark.slow
@pytest.mark.timeout(280)
def test_nothing_dead_locks():
    """Large clouds, two threads, hundreds of calls, gradients under vmap: a hang fails by its time limit."""
    source, target, _ = pair(size=20_000)
    method = mcg.MultiChannelGICP(0.05, 0.3)
    loss = jax.jit(
        jax.value_and_grad(
            lambda channels: weigh(
                mcg.register(
                    source.replace(channels=channels), target, method, max_distance=0.2, max_iterations=4
                ).matrix
            )
        )
    )
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
    batched = jax.jit(
        jax.vmap(
            jax.grad(
                lambda channels: weigh(
                    mcg.register(
                        small.replace(channels=channels), other, method, max_distance=0.2, max_iterations=4
                    ).matrix
                )
            )
        )
    )
    for _ in range(100):
        gradient = jax.block_until_ready(batched(batch))
    assert np.isfinite(gradient).all()


def test_towards_zero_temperature_the_nearest_counts_alone(noisy):
    source, target, _ = noisy
    method, _ = case("mc-gicp")
    rest = tolerance(1e-6, 1e-10)
    tight = {"translation_tolerance": rest, "rotation_tolerance": rest}
    start = mcg.register(source, target, method, max_distance=GATE, **tight).matrix
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
    aligned = mcg.estimate_pose(source, target, hard, method, init=start)
    np.testing.assert_allclose(soft.matrix, aligned.matrix, atol=tolerance(1e-4, 1e-6))


def test_candidates_need_a_temperature(noisy):
    source, target, _ = noisy
    method, _ = case("gicp")
    matches = mcg.find_correspondences(source, target, None, method, max_distance=GATE, num_candidates=2)
    with pytest.raises(ValueError, match="temperature: expected metres to go with 2 candidates, got None"):
        mcg.estimate_pose(source, target, matches, method)
    with pytest.raises(ValueError, match="temperature: expected a positive number"):
        mcg.mahalanobis_cost(np.eye(4), source, target, matches, method, temperature=0.0)
    with pytest.raises(ValueError, match="num_candidates: expected an integer of at least 1, got 0"):
        mcg.find_correspondences(source, target, None, method, max_distance=GATE, num_candidates=0)


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
    with pytest.raises(ValueError, match="log_determinant: expected a method with covariances, got PointToPlane"):
        mcg.mahalanobis_cost(np.eye(4), source, target, matches, mcg.PointToPlane(), log_determinant=True)


@pytest.mark.parametrize("outer", [jax.jacfwd, jax.grad])
def test_second_derivatives_are_refused(outer, noisy):
    source, target, _ = noisy
    matches = mcg.find_correspondences(source, target, motion(), mcg.GICP(1e-2), max_distance=GATE)

    def loss(shift):
        moved = source.replace(points=jnp.asarray(source.points) + shift * jnp.arange(3.0))
        return weigh(mcg.estimate_pose(moved, target, matches, mcg.GICP(1e-2)).matrix)

    jax.make_jaxpr(jax.grad(loss))(0.1)
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.make_jaxpr(outer(jax.grad(loss)))(0.1)


def test_the_pose_alone_carries_a_gradient(noisy):
    source, target, _ = noisy

    def others(points):
        result = mcg.register(source.replace(points=points), target, mcg.GICP(1e-2), max_distance=GATE)
        return jnp.sum(result.deviations) + jnp.sum(result.covariance) + result.cost + result.rmse

    np.testing.assert_array_equal(jax.grad(others)(jnp.asarray(source.points)), 0)
