"""Pose graphs inside transformations: the same poses and covariances, and derivatives against finite differences."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

import mcgicp_jax as mcg
from tests.compilations import compilations
from tests.graphs import SMALL, correlated, grid, joined, measured, moved, shifted, with_factors, with_priors
from tests.precision import in_float64
from tests.refusals import refused
from tests.scenes import motion


def changed(graph, motions=None, information=None):
    """The graph with other measurements."""
    edges = graph.edges
    motions = edges.T_i_j if motions is None else motions
    information = edges.information if information is None else information
    return mcg.PoseGraph(graph.poses, mcg.Edge(edges.i, edges.j, motions, information), graph.factors)


def se3s_of(twists):
    return jax.vmap(lambda x: jaxlie.SE3.exp(x).as_matrix())(jnp.asarray(twists))


@jax.jit
def differentiated(graph, twists, change):
    """The result of a compiled program, and its derivative as motions move by twists and information changes."""

    def at(step):
        motions, information = graph.edges.T_i_j @ se3s_of(step * twists), graph.edges.information + step * change
        found = mcg.optimize_poses(changed(graph, motions, information), robust=False)
        return found.poses, found

    _, slope, found = jax.jvp(at, (0.0,), (1.0,), has_aux=True)
    return found, slope


@pytest.fixture(scope="module")
def both(precision):
    """A graph, its result, and that of a compiled program with its derivative in some direction."""
    graph, _ = measured(*SMALL["grid"])
    return graph, mcg.optimize_poses(graph, robust=False), *differentiated(graph, *direction(graph))


def direction(graph):
    rng = np.random.default_rng(3)
    change = rng.normal(size=(len(graph.edges), 6, 6))
    twists = rng.normal(size=(len(graph.edges), 6))
    return 0.1 * twists, 20 * (change + change.swapaxes(1, 2))


@in_float64
def test_rounding_does_not_decide_the_status_inside_transformations():
    poses, loops = grid(2)
    solve = jax.jit(lambda graph: mcg.optimize_poses(graph, robust=False).status_code)
    for seed in range(10):
        graph = with_priors(measured(poses, loops, deviations=(1e-3, 1e-3), seed=seed)[0], poses)
        assert solve(shifted(graph, (3e5, 5e6, 100))) == mcg.Status.CONVERGED


@in_float64
def test_transformations_give_the_same_poses_and_derivatives(both):
    graph, expected, found, slope = both
    check_slope(graph, slope, *direction(graph))
    assert found.converged and found.status == mcg.Status.CONVERGED
    np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-4)
    np.testing.assert_allclose(found.poses, expected.poses, atol=2e-3)
    np.testing.assert_allclose(found.residuals, expected.residuals, atol=0.05)
    deviations = np.sqrt(np.diagonal(expected.covariance, 0, 1, 2))[1:]
    difference = np.asarray(expected.covariance - found.covariance)[1:] / deviations[:, :, None] / deviations[:, None]
    assert np.abs(difference).max() < 1e-4


def test_priors_give_the_same_inside_transformations(both):
    """In the same program: some of the edges are priors now."""
    edges, poses = both[0].edges, SMALL["grid"][0]
    i, motions = edges.i.copy(), edges.T_i_j.copy()
    i[-4:] = mcg.WORLD
    motions[-4:] = moved(poses[edges.j[-4:]], np.repeat((0.05, 0.02), 3) * np.random.default_rng(4).normal(size=(4, 6)))
    graph = mcg.PoseGraph(both[0].poses, mcg.Edge(i, edges.j, motions, edges.information))
    found, slope = differentiated(graph, *direction(graph))
    expected = mcg.optimize_poses(graph, robust=False)
    assert found.converged and expected.converged
    np.testing.assert_allclose(found.poses, expected.poses, atol=2e-3)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-3 * expected.covariance.max())
    check_slope(graph, slope, *direction(graph))


def test_a_rejected_edge_has_no_gradient():
    poses, i, j = np.tile(np.eye(4), (3, 1, 1)), np.array([0, 1, 0, 0]), np.array([1, 2, 2, 2])
    motions, information = np.tile(np.eye(4), (4, 1, 1)), np.tile(100 * np.eye(6), (4, 1, 1))
    motions[3, 0, 3] = 10

    def along(motions):
        edges = mcg.Edge(i, j, motions, information, uncertain=np.arange(4) == 3)
        return mcg.optimize_poses(mcg.PoseGraph(poses, edges)).poses[2, 0, 3]

    gradient = jax.grad(along)(jnp.asarray(motions))
    assert np.any(gradient[:3]) and not np.any(gradient[3])


def check_slope(graph, slope, twists, change=0.0, h=0.02, share=0.005):
    def poses(step):
        # Rotation vectors equal twists to first order.
        motions, information = moved(graph.edges.T_i_j, step * twists), graph.edges.information + step * change
        return mcg.optimize_poses(changed(graph, motions, information), robust=False).poses

    expected = (poses(h) - poses(-h)) / (2 * h)
    np.testing.assert_allclose(slope, expected, atol=share * np.abs(expected).max())


def test_failures_inside_transformations_are_statuses(both):
    graph = both[0]
    edges, last = graph.edges, len(graph.poses) - 1
    others = (edges.i != last) & (edges.j != last)
    cut = changed(graph, information=others[:, None, None] * edges.information)
    found, _ = differentiated(cut, *direction(graph))
    assert found.status == mcg.Status.DEGENERATE and not found.converged
    twists, change = direction(graph)
    found, slope = differentiated(graph, twists, np.nan * change)
    assert found.status == mcg.Status.NON_FINITE and not np.any(slope)


def circle(seed, number=20, step=30.0):
    """A closed path, with a millimetre and a milliradian of noise."""
    angles = 2 * np.pi * np.arange(number) / number
    poses = np.array(
        [motion((*(step * number / (2 * np.pi) * np.array([np.sin(a), -np.cos(a)])), 0, 0, 0, a)) for a in angles]
    )
    return measured(poses, [(0, number - 1)], deviations=(1e-3, 1e-3), seed=seed)[0]


def weighted_sum(step, graph, twists, scale):
    moving = changed(graph, graph.edges.T_i_j @ se3s_of(step * twists))
    return jnp.sum(scale * mcg.optimize_poses(moving, robust=False).poses)


compiled_gradient = jax.jit(jax.grad(weighted_sum))


@pytest.mark.parametrize("seed", range(3))
def test_gradients_of_precise_graphs_are_right_in_float32(seed):
    graph, rng = circle(seed), np.random.default_rng(seed)
    twists, scale = 1e-3 * rng.normal(size=(len(graph.edges), 6)), rng.normal(size=(len(graph.poses), 4, 4))
    found, slope = differentiated(graph, twists, np.zeros((len(graph.edges), 6, 6)))
    assert found.converged and found.num_iterations <= 5
    check_slope(graph, slope, twists, h=0.01, share=1e-3)
    gradient = compiled_gradient(0.0, graph, twists, scale)
    assert gradient != 0
    np.testing.assert_allclose(gradient, np.sum(scale * slope), atol=1e-3 * np.sum(np.abs(scale * slope)))


def test_eager_gradients_and_batches_are_those_of_compiled_programs():
    graph, _ = measured(*grid(2))
    edges = graph.edges

    def loss(information):
        return jnp.sum(mcg.optimize_poses(changed(graph, information=information)).poses[-1, :3, 3])

    information = jnp.asarray(edges.information) * (1 + jnp.arange(len(edges))[:, None, None] / len(edges))
    expected = jax.jit(jax.grad(loss))(information)
    assert np.abs(expected).max() > 0
    with compilations() as programs:
        eager = jax.grad(loss)(information)
    assert len(programs) < 20
    np.testing.assert_allclose(eager, expected, rtol=1e-5, atol=1e-9)
    both = jnp.stack([information, 2 * information])
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(loss)))(both)
    np.testing.assert_allclose(values[0], loss(information), rtol=1e-5)
    np.testing.assert_allclose(gradients, np.array([expected, expected / 2]), rtol=1e-3, atol=1e-9)
    with pytest.raises(ValueError, match="JVP"):
        jax.hessian(loss)(information)


def test_degenerate_graphs_are_finite_inside_transformations():
    graph, _ = measured(*grid(2))
    position = mcg.Edge(mcg.WORLD, 0, graph.poses[0], np.diag([1.0, 1, 1, 0, 0, 0]))[None]
    open_ended = mcg.PoseGraph(graph.poses, joined(graph.edges, position))
    edges = graph.edges
    parts = mcg.PoseGraph(graph.poses, edges[(edges.i < 4) == (edges.j < 4)])
    for each in (open_ended, parts):
        expected, (found, slope) = mcg.optimize_poses(each, robust=False), differentiated(each, *direction(each))
        assert found.status == expected.status == mcg.Status.DEGENERATE
        np.testing.assert_allclose(found.poses, expected.poses, atol=1e-4)
        assert not np.any(slope)
        np.testing.assert_array_equal(np.isinf(found.covariance), np.isinf(expected.covariance))
    assert np.isinf(np.diagonal(expected.covariance, 0, 1, 2)[4:]).all() and np.isfinite(expected.covariance[:4]).all()


def test_other_kinds_of_measurements_take_part_inside_transformations_without_derivatives():
    graph, _ = with_factors()
    expected, found = mcg.optimize_poses(graph), jax.jit(mcg.optimize_poses)(graph)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-4)
    np.testing.assert_array_equal(found.factor_weights[0], expected.factor_weights[0])

    def height(motions):
        edges = graph.edges
        moving = mcg.Edge(edges.i, edges.j, motions, edges.information, uncertain=edges.uncertain)
        return mcg.optimize_poses(mcg.PoseGraph(graph.poses, moving, graph.factors)).poses[:, 2, 3].sum()

    refused(lambda: jax.grad(height)(jnp.asarray(graph.edges.T_i_j)), "graph")


@pytest.mark.slow
@in_float64
@pytest.mark.parametrize("priors", [False, True])
def test_gradients_reach_motions_and_informations(priors):
    graph = correlated(measured(*grid(2))[0])
    graph = with_priors(graph, grid(2)[0]) if priors else graph
    rng = np.random.default_rng(2)
    scale = rng.normal(size=(len(graph.poses), 3, 4))
    edges, m = graph.edges, len(graph.edges)
    change = rng.normal(size=(m, 6, 6))
    directions = {"motions": rng.normal(size=(m, 6)), "information": 10 * (change + change.swapaxes(1, 2))}

    def loss(steps):
        motions = edges.T_i_j @ se3s_of(steps[0] * directions["motions"])
        moving = changed(graph, motions, edges.information + steps[1] * directions["information"])
        return jnp.sum(scale * mcg.optimize_poses(moving, robust=False).poses[:, :3])

    value, (forward, gradient) = (
        jax.jit(loss),
        jax.jit(lambda x: (jax.jacfwd(loss)(x), jax.grad(loss)(x)))(jnp.zeros(2)),
    )
    for k, h in ((0, 1e-4), (1, 1e-3)):
        near = [float(value(jnp.zeros(2).at[k].set(step * h))) for step in (1, -1, 2, -2)]
        expected = (8 * (near[0] - near[1]) - (near[2] - near[3])) / (12 * h)
        np.testing.assert_allclose(gradient[k], expected, rtol=1e-6)
    np.testing.assert_allclose(forward, gradient, rtol=1e-9)


def test_rows_outside_of_the_graph_are_named_inside_transformations():
    graph, _ = measured(*grid(2))
    edges = graph.edges

    def solve(j):
        return mcg.optimize_poses(mcg.PoseGraph(graph.poses, mcg.Edge(edges.i, j, edges.T_i_j, edges.information)))

    assert jax.jit(solve)(jnp.asarray(edges.j)).converged
    with pytest.raises(Exception, match=r"edges: .* 7"):
        jax.block_until_ready(jax.jit(solve)(jnp.asarray(edges.j).at[3].set(8)).poses)
