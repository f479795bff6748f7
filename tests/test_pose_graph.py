"""Pose graphs against gtsam or dense least squares, finite differences, and simulation."""

import importlib.util
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.sparse import csc_array
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import mcgicp_jax as mcg
from mcgicp_jax import metrics
from mcgicp_jax._math.poses import logarithm
from mcgicp_jax._pose_graph import outliers
from mcgicp_jax._pose_graph.edge import AbstractFactor, motion_jacobians
from mcgicp_jax._pose_graph.levenberg_marquardt import Minimum
from mcgicp_jax._pose_graph.marginal_covariances import inverse_blocks
from mcgicp_jax._pose_graph.normal_equations import NormalEquations, factored
from tests.compilations import compilations
from tests.graphs import garage, grid, joined, measured, moved, sphere, with_gtsam, with_priors
from tests.precision import in_float64
from tests.scenes import motion

SMALL = {"sphere": sphere(6, 10), "grid": grid(3), "garage": garage(2, 40)}


def correlated(graph, seed=1, rank=3):
    """The graph with full information matrices, the last one of that rank."""
    rng = np.random.default_rng(seed)
    roots = (np.eye(6) + 0.3 * rng.normal(size=(len(graph.edges), 6, 6))) * [20, 20, 20, 50, 50, 50]
    roots[-1, rank:] = 0
    edges = graph.edges
    return mcg.PoseGraph(
        graph.poses, mcg.Edge(edges.i, edges.j, edges.T_i_j, roots.swapaxes(1, 2) @ roots, uncertain=edges.uncertain)
    )


def shifted(graph, origin):
    """The graph with its world's origin moved to the negative of a position."""
    poses, motions = graph.poses.copy(), graph.edges.T_i_j.copy()
    poses[:, :3, 3] += origin
    motions[graph.edges.i == mcg.WORLD, :3, 3] += origin
    edges = mcg.Edge(graph.edges.i, graph.edges.j, motions, graph.edges.information, uncertain=graph.edges.uncertain)
    return mcg.PoseGraph(poses, edges)


def dense_minimum(graph):
    """Cost at the minimum by SciPy, with rotation vectors of its own and numerical derivatives."""
    start = np.zeros(6 * len(graph.poses) - 6)
    return least_squares(whitened(graph), start, xtol=1e-12, ftol=1e-12, gtol=1e-12).cost


def whitened(graph):
    """Residuals of the edges in standard deviations, as a function of the motions of all poses but the first."""
    edges = graph.edges
    roots = [np.linalg.cholesky(each + 1e-9 * np.eye(6)).T for each in edges.information]

    def residuals(numbers):
        poses = moved(graph.poses, np.concatenate([np.zeros((1, 6)), numbers.reshape(-1, 6)]))
        errors = np.linalg.inv(edges.T_i_j) @ np.linalg.inv(poses[edges.i]) @ poses[edges.j]
        turns = Rotation.from_matrix(errors[:, :3, :3]).as_rotvec()
        shifts = [_log_translation(turn, shift) for turn, shift in zip(turns, errors[:, :3, 3], strict=True)]
        return np.concatenate([root @ [*v, *w] for root, v, w in zip(roots, shifts, turns, strict=True)])

    return residuals


def jacobian(function, size, step=1e-5):
    """Central differences at 0."""
    steps = step * np.eye(size)
    return np.array([(function(each) - function(-each)) / (2 * step) for each in steps]).T


def _log_translation(turn, shift):
    """v of log(R, t): t = V v with V = ∫ exp(s ω×) ds, by Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    matrices = Rotation.from_rotvec(np.outer((nodes + 1) / 2, turn)).as_matrix()
    return np.linalg.solve(np.einsum("k,kij->ij", weights / 2, matrices), shift)


@pytest.mark.parametrize("name", SMALL)
def test_the_minimum_is_that_of_gtsam(name):
    pytest.importorskip("gtsam")
    graph, _ = measured(*SMALL[name])
    # gtsam factors information, so none may be singular.
    for each in (graph, correlated(graph, rank=6)):
        found = mcg.optimize_poses(each, robust=False)
        poses, cost, _ = with_gtsam(each)
        assert found.converged
        np.testing.assert_allclose(found.cost, cost, rtol=1e-6)
        np.testing.assert_allclose(found.poses, poses, atol=1e-3)


def test_the_minimum_is_that_of_dense_least_squares():
    graph = correlated(measured(*grid(2))[0])
    found = mcg.optimize_poses(graph, robust=False)
    assert found.converged
    np.testing.assert_allclose(found.cost, dense_minimum(graph), rtol=1e-6)
    np.testing.assert_allclose(found.cost, 0.5 * np.sum(found.residuals**2), rtol=1e-12)
    np.testing.assert_allclose(found.poses[0], graph.poses[0], atol=1e-15)


def test_priors_give_the_minimum_and_the_covariances_of_gtsam():
    pytest.importorskip("gtsam")
    poses, loops = SMALL["garage"]
    clean, _ = measured(poses, loops)
    # As gtsam cannot take singular information, positions get some information about rotations.
    graph = with_priors(clean, poses)
    edges = graph.edges
    known = edges.information + 1e-2 * np.diag([0, 0, 0, 1, 1, 1])
    graph = mcg.PoseGraph(graph.poses, mcg.Edge(edges.i, edges.j, edges.T_i_j, known))
    found = mcg.optimize_poses(graph)
    expected, cost, covariances = with_gtsam(graph, covariances=True)
    assert found.converged and len(found.poses) == len(poses)
    np.testing.assert_allclose(found.cost, cost, rtol=1e-6)
    np.testing.assert_allclose(found.poses, expected, atol=1e-4)
    np.testing.assert_allclose(found.covariance, covariances, atol=1e-3 * np.abs(covariances).max())
    assert np.abs(found.poses[0] - graph.poses[0]).max() > 1e-3


def test_a_prior_alone_moves_the_graph_and_makes_it_uncertain():
    """Next to motions known to a millimetre, a start known to 100 m: no pose is held, and no digit is lost."""
    graph, _ = measured(*grid(2), deviations=(1e-3, 1e-3))
    start = motion((3e5, 5e6, 100, 0.1, 0.2, -2.0))
    covariance = np.diag([1e4, 1e4, 1e4, 0.1, 0.1, 0.2])
    prior = mcg.Edge(mcg.WORLD, 0, start, covariance=covariance)
    found = mcg.optimize_poses(mcg.PoseGraph(None, joined(graph.edges, prior[None])))
    alone = mcg.optimize_poses(graph)
    assert found.converged
    np.testing.assert_allclose(found.cost, alone.cost, rtol=1e-6)
    np.testing.assert_allclose(found.poses[0], start, atol=0.1)
    inner, expected = (np.linalg.inv(poses[0]) @ poses for poses in (found.poses, alone.poses))
    np.testing.assert_allclose(inner, expected, atol=1e-5)
    deviations = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.covariance[0] / deviations / deviations[:, None], np.eye(6), atol=1e-3)
    # A position alone leaves the direction open.
    free = mcg.Edge(mcg.WORLD, 0, start, np.diag([1e-4, 1e-4, 1e-4, 0, 0, 0]))
    turning = mcg.optimize_poses(mcg.PoseGraph(None, joined(graph.edges, free[None])))
    assert turning.status == mcg.Status.DEGENERATE


@pytest.mark.parametrize("name", SMALL)
def test_rounding_does_not_decide_the_status(name):
    """At UTM coordinates as about the origin; with motions so precise that costs near the minimum round alike."""
    poses, loops = SMALL[name]
    position = mcg.Edge(mcg.WORLD, 0, poses[0], np.diag([1e-4, 1e-4, 1e-4, 0, 0, 0]))[None]
    for seed in range(3):
        graph, _ = measured(poses, loops, deviations=(1e-4, 1e-5), seed=seed)
        open_ended = mcg.PoseGraph(graph.poses, joined(graph.edges, position))
        for each in (graph, with_priors(graph, poses), open_ended):
            near, far = (mcg.optimize_poses(g, robust=False) for g in (each, shifted(each, (3e5, 5e6, 100))))
            status = mcg.Status.DEGENERATE if each is open_ended else mcg.Status.CONVERGED
            assert near.status == far.status == status
            # Positions of 5e6 m have a rounding of 1e-9 m.
            inner, expected = (np.linalg.inv(found.poses[0]) @ found.poses for found in (far, near))
            np.testing.assert_allclose(inner, expected, atol=1e-8)
            np.testing.assert_allclose(far.cost, near.cost, rtol=1e-4)


@in_float64
def test_rounding_does_not_decide_the_status_inside_transformations():
    poses, loops = grid(2)
    solve = jax.jit(lambda graph: mcg.optimize_poses(graph, robust=False).status_code)
    for seed in range(10):
        graph = with_priors(measured(poses, loops, deviations=(1e-3, 1e-3), seed=seed)[0], poses)
        assert solve(shifted(graph, (3e5, 5e6, 100))) == mcg.Status.CONVERGED


def test_rounding_of_poses_in_float32_is_warned_of():
    graph, _ = measured(*SMALL["grid"])
    far, solve = shifted(graph, (5e5, 5e6, 100)), jax.jit(lambda each: mcg.optimize_poses(each).poses)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        near = solve(graph)
        mcg.optimize_poses(far)
        with jax.enable_x64(True):
            np.testing.assert_allclose(np.subtract(solve(far), near)[1:, :3, 3] - (5e5, 5e6, 100), 0, atol=1e-4)
    with pytest.warns(UserWarning, match=r"poses up to 5e\+06 m .* rounded to 0.5 m in float32. Subtract") as caught:
        jax.block_until_ready(solve(far))
    # Run-time checks of annotations wrap each function of the package.
    assert caught[0].filename == __file__ or "jaxtyping" in caught[0].filename


def test_parts_that_have_priors_are_well_defined():
    poses, loops = SMALL["grid"]
    graph, _ = measured(poses, loops)
    apart = graph.edges[(graph.edges.i < 13) == (graph.edges.j < 13)]
    covariance = np.diag([1e-4] * 6)
    priors = [mcg.Edge(mcg.WORLD, k, poses[k], covariance=covariance)[None] for k in (3, 20)]
    found = mcg.optimize_poses(mcg.PoseGraph(graph.poses, joined(apart, *priors)))
    assert found.converged and np.isfinite(found.covariance).all()
    np.testing.assert_allclose(found.poses[[3, 20]], poses[[3, 20]], atol=1e-4)
    np.testing.assert_allclose(found.covariance[[3, 20]], np.array([covariance] * 2), rtol=1e-4, atol=1e-9)
    one = mcg.optimize_poses(mcg.PoseGraph(graph.poses, joined(apart, priors[1])))
    assert one.status == mcg.Status.DEGENERATE
    assert np.all(np.isinf(np.diagonal(one.covariance[:13], 0, 1, 2))) and np.all(np.isfinite(one.covariance[13:]))
    # A wrong prior is rejected like a loop.
    wrong = mcg.Edge(mcg.WORLD, 5, motion((50, 0, 0, 0, 0, 1)), covariance=covariance, uncertain=True)[None]
    again = mcg.optimize_poses(mcg.PoseGraph(graph.poses, joined(apart, *priors, wrong)))
    assert not again.kept[-1]
    np.testing.assert_array_equal(again.kept[:-1], found.kept)
    np.testing.assert_allclose(again.poses, found.poses, atol=1e-6)


def test_a_start_from_trusted_loops_is_near_the_minimum():
    """Where odometry alone leads to another minimum."""
    graph, _ = measured(*grid(4), deviations=(0.2, 0.3))
    edges = mcg.Edge(graph.edges.i, graph.edges.j, graph.edges.T_i_j, graph.edges.information)
    start = mcg.PoseGraph(None, edges).poses
    np.testing.assert_allclose(start[0], np.eye(4), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(start[:, :3, :3]), 1, atol=1e-9)
    found = mcg.optimize_poses(mcg.PoseGraph(start, edges))
    truth = mcg.optimize_poses(mcg.PoseGraph(grid(4)[0], edges))
    odometry = mcg.optimize_poses(mcg.PoseGraph(graph.poses, edges))
    np.testing.assert_allclose(found.cost, truth.cost, rtol=1e-6)
    assert found.num_iterations < odometry.num_iterations and odometry.cost > 1.1 * found.cost


def test_a_start_is_composed_from_the_edges():
    poses, loops = SMALL["garage"]
    graph, _ = measured(poses, loops)
    rng = np.random.default_rng(0)
    # Odometry comes first, in whatever order and direction the edges are given.
    edges, order = graph.edges, rng.permutation(len(graph.edges))
    turned = rng.random(len(edges)) < 0.5
    i, j = np.where(turned, edges.j, edges.i), np.where(turned, edges.i, edges.j)
    motions = np.where(turned[:, None, None], np.linalg.inv(edges.T_i_j), edges.T_i_j)
    mixed = mcg.Edge(i, j, motions, edges.information, uncertain=edges.uncertain)[order]
    expected = np.linalg.inv(graph.poses[0]) @ graph.poses
    np.testing.assert_allclose(mcg.PoseGraph(None, mixed).poses, expected, atol=1e-9)
    # Across a gap by a loop, and into the world by a prior.
    gap = (mixed.i < 30) == (mixed.j < 30)
    prior = mcg.Edge(mcg.WORLD, 40, poses[40], np.eye(6))
    exact = mcg.Edge(
        mixed.i, mixed.j, np.linalg.inv(poses[mixed.i]) @ poses[mixed.j], mixed.information, uncertain=mixed.uncertain
    )
    np.testing.assert_allclose(
        mcg.PoseGraph(None, joined(exact[gap | mixed.uncertain], prior[None])).poses, poses, atol=1e-9
    )
    # What has no prior begins at the identity; an edge that knows no heading comes last.
    apart = mcg.PoseGraph(None, joined(exact[gap], prior[None])).poses
    np.testing.assert_allclose(apart[:30], np.linalg.inv(poses[0]) @ poses[:30], atol=1e-9)
    np.testing.assert_allclose(apart[30:], poses[30:], atol=1e-9)
    blind = mcg.Edge(0, 1, motion((9, 9, 9, 0, 0, 1)), np.diag([1.0, 1, 1, 1, 1, 0]))
    sure = mcg.Edge(0, 1, motion((1, 0, 0, 0, 0, 0)), np.eye(6), uncertain=True)
    np.testing.assert_allclose(mcg.PoseGraph(None, [blind, sure]).poses[1], sure.T_i_j, atol=1e-12)
    with pytest.raises(
        ValueError, match="poses: required, since initial poses can only be computed from at least one concrete edge"
    ):
        mcg.PoseGraph(None, [])


def test_an_exact_graph_ends_at_the_truth():
    poses, loops = SMALL["sphere"]
    graph, _ = measured(poses, loops, deviations=(0.05, 0.02))
    i, j = graph.edges.i, graph.edges.j
    exact = mcg.Edge(i, j, np.linalg.inv(poses[i]) @ poses[j], graph.edges.information)
    found = mcg.optimize_poses(mcg.PoseGraph(graph.poses, exact))
    assert found.converged and found.cost < 1e-10
    np.testing.assert_allclose(found.poses, poses, atol=1e-7)


def test_covariances_are_those_of_simulation():
    """NEES of the poses over many noises; and the spread, pose by pose."""
    poses, loops = grid(2)
    squares, twists = [], []
    for seed in range(60):
        found = mcg.optimize_poses(measured(poses, loops, seed=seed)[0], robust=False)
        error = np.asarray(jax.vmap(lambda a, b: (a.inverse() @ b).log())(*map(se3s, (found.poses, poses))))
        twists.append(error)
        squares.append([e @ np.linalg.solve(c, e) for e, c in zip(error[1:], found.covariance[1:], strict=True)])
    assert 0.9 < np.mean(squares) / 6 < 1.1
    np.testing.assert_allclose(np.std(twists, axis=0)[-1], np.sqrt(np.diag(found.covariance[-1])), rtol=0.35)
    np.testing.assert_array_equal(found.covariance[0], np.zeros((6, 6)))


def test_covariances_are_those_of_finite_differences():
    """By the edges that are kept."""
    graph = correlated(measured(*grid(2), false=0.3)[0], rank=6)
    found = mcg.optimize_poses(graph)
    assert 0 < found.kept.sum() < len(graph.edges)
    kept = mcg.PoseGraph(found.poses, graph.edges[found.kept])
    size = 6 * len(graph.poses) - 6
    derivative = jacobian(whitened(kept), size)
    covariance = np.linalg.inv(derivative.T @ derivative)
    expected = covariance.reshape(size // 6, 6, size // 6, 6)[np.arange(size // 6), :, np.arange(size // 6)]
    np.testing.assert_allclose(found.covariance[1:], expected, atol=1e-3 * expected.max())


def test_rejected_loops_leave_no_trace():
    graph, _ = measured(*grid(2), false=0.3)
    found = mcg.optimize_poses(graph)
    assert not found.kept.all()
    expected = mcg.optimize_poses(mcg.PoseGraph(found.poses, graph.edges[found.kept]), robust=False)
    np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-6)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-4)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-2, atol=1e-9)


def test_a_loop_is_rejected_only_beyond_its_own_uncertainty_and_that_of_the_others(monkeypatch):
    """Edges of variances 1 and 1 that contradict each other by d: d² alone, d²/2 together."""
    squares = np.array([20.0, 30.0, 40.0, 60.0, 80.0])
    motions = np.tile(motion((0, 10, 0, 0, 0, 0)), (10, 1, 1))
    poses = np.concatenate([np.eye(4)[None], motions[:5]])
    motions[5:, 0, 3] = np.sqrt(squares)
    edges = mcg.Edge(
        np.zeros(10, int),
        np.tile(np.arange(1, 6), 2),
        motions,
        np.tile(np.eye(6), (10, 1, 1)),
        uncertain=np.arange(10) >= 5,
    )
    equations = NormalEquations((edges,), poses)
    terms = equations.terms(poses)
    np.testing.assert_allclose(terms.squares[5:], squares)
    again = outliers._wrongly_rejected(equations, Minimum(poses, terms), 1.0 * (np.arange(10) < 5))
    np.testing.assert_array_equal(again, [5, 6])
    # Without the edge to the fourth pose, nothing contradicts the loop to it.
    used = np.isin(np.arange(10), [0, 1, 2, 4])
    again = outliers._wrongly_rejected(equations.restricted(used), Minimum(poses, terms), 1.0 * used)
    np.testing.assert_array_equal(again, [5, 6, 8])
    # Rejected at first, these two are kept in the end, and half of what contradicts is left in both edges.
    monkeypatch.setattr(outliers, "truncated_weights", lambda ratio, _: 1.0 * (ratio >= 1))
    found = mcg.optimize_poses(mcg.PoseGraph(poses, edges))
    np.testing.assert_array_equal(np.flatnonzero(~found.kept), [7, 8, 9])
    np.testing.assert_allclose(found.cost, squares[:2].sum() / 4, rtol=1e-6)


def se3s(matrices):
    return jaxlie.SE3.from_matrix(jnp.asarray(matrices))


@jax.jit
def differentiated(graph, twists, change):
    """The result of a compiled program, and its derivative as motions move by twists and information changes."""

    def at(step):
        edges = graph.edges
        motions = edges.T_i_j @ jax.vmap(lambda x: jaxlie.SE3.exp(x).as_matrix())(step * twists)
        information = edges.information + step * change
        moving = mcg.PoseGraph(graph.poses, mcg.Edge(edges.i, edges.j, motions, information))
        found = mcg.optimize_poses(moving, robust=False)
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
def test_covariances_are_blocks_of_the_inverse(both):
    _, found, inside, _ = both
    dense = np.asarray(inside.covariance)
    deviations = np.sqrt(np.diagonal(found.covariance, 0, 1, 2))[1:]
    difference = (found.covariance - dense)[1:] / deviations[:, :, None] / deviations[:, None]
    assert np.abs(difference).max() < 1e-4


def test_blocks_of_a_sparse_inverse_are_those_of_the_dense_one():
    rng = np.random.default_rng(0)
    number = 25
    linked = rng.random((number, number)) < 0.08
    pattern = np.kron(linked | linked.T | np.eye(number, dtype=bool), np.ones((6, 6)))
    matrix = pattern * rng.normal(size=pattern.shape)
    matrix = matrix + matrix.T + np.diag(np.abs(matrix).sum(axis=1) * 2)
    dense = np.linalg.inv(matrix).reshape(number, 6, number, 6)
    diagonal = inverse_blocks(factored(csc_array(matrix)))
    np.testing.assert_allclose(diagonal, dense[np.arange(number), :, np.arange(number)], atol=1e-12)


@pytest.mark.parametrize("name", SMALL)
@pytest.mark.parametrize("fraction", [0.1, 0.3, 0.5])
def test_false_loops_are_rejected(name, fraction):
    poses, loops = SMALL[name]
    clean, _ = measured(poses, loops)
    best = metrics.ate(mcg.optimize_poses(clean).poses, poses, alignment="first")
    graph, true = measured(poses, loops, false=fraction)
    found = mcg.optimize_poses(graph)
    assert found.converged
    assert metrics.ate(found.poses, poses, alignment="first") <= 1.1 * best
    assert not found.kept[~true].any() and found.kept[true].mean() >= 0.98
    assert found.kept[~graph.edges.uncertain].all()
    np.testing.assert_array_equal(found.weights, found.kept)
    assert np.all(found.residuals[~true] > np.sqrt(chi2.ppf(0.99, 6)))
    plain = mcg.optimize_poses(graph, robust=False)
    assert plain.kept.all() and metrics.ate(plain.poses, poses, alignment="first") > 2 * best


def test_the_threshold_is_the_99_percent_quantile():
    graph, _ = measured(*grid(2))
    np.testing.assert_allclose(outliers.thresholds(NormalEquations((graph.edges,), graph.poses)), chi2.ppf(0.99, 6))


def test_other_sizes_compile_nothing():
    mcg.optimize_poses(measured(*SMALL["grid"], false=0.3)[0]).covariance  # noqa: B018
    with compilations() as found:
        for name in ("sphere", "garage"):
            mcg.optimize_poses(measured(*SMALL[name], false=0.2)[0]).covariance  # noqa: B018
    assert not found


@in_float64
def test_transformations_give_the_same_poses(both):
    _, expected, found, _ = both
    assert found.converged and found.status == mcg.Status.CONVERGED
    np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-4)
    np.testing.assert_allclose(found.poses, expected.poses, atol=2e-3)
    np.testing.assert_allclose(found.residuals, expected.residuals, atol=0.05)


@in_float64
def test_the_derivative_is_that_of_finite_differences(both):
    graph, _, _, slope = both
    check_slope(graph, slope)


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
    check_slope(graph, slope)


def check_slope(graph, slope):
    twists, change = direction(graph)
    edges, h = graph.edges, 0.02

    def poses(step):
        motions = edges.T_i_j @ np.asarray(se3s_of(step * twists))
        moving = mcg.Edge(edges.i, edges.j, motions, edges.information + step * change)
        return mcg.optimize_poses(mcg.PoseGraph(graph.poses, moving), robust=False).poses

    expected = (poses(h) - poses(-h)) / (2 * h)
    np.testing.assert_allclose(slope, expected, atol=0.005 * np.abs(expected).max())


def se3s_of(twists):
    return jax.vmap(lambda x: jaxlie.SE3.exp(x).as_matrix())(jnp.asarray(twists))


def test_failures_inside_transformations_are_statuses(both):
    graph = both[0]
    edges, last = graph.edges, len(graph.poses) - 1
    apart = (edges.i != last) & (edges.j != last)
    cut = mcg.Edge(edges.i, edges.j, edges.T_i_j, apart[:, None, None] * edges.information)
    found, _ = differentiated(mcg.PoseGraph(graph.poses, cut), *direction(graph))
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
    edges = graph.edges
    moving = mcg.Edge(edges.i, edges.j, edges.T_i_j @ se3s_of(step * twists), edges.information)
    return jnp.sum(scale * mcg.optimize_poses(mcg.PoseGraph(graph.poses, moving), robust=False).poses)


compiled_gradient = jax.jit(jax.grad(weighted_sum))


@pytest.mark.parametrize("seed", range(8))
def test_gradients_of_precise_graphs_are_right_in_float32(seed):
    graph, rng = circle(seed), np.random.default_rng(seed)
    twists, scale = 1e-3 * rng.normal(size=(len(graph.edges), 6)), rng.normal(size=(len(graph.poses), 4, 4))

    def poses(step):
        edges = graph.edges
        # Rotation vectors equal twists to first order.
        moving = mcg.Edge(edges.i, edges.j, moved(edges.T_i_j, step * twists), edges.information)
        return mcg.optimize_poses(mcg.PoseGraph(graph.poses, moving), robust=False).poses

    expected = (poses(0.01) - poses(-0.01)) / 0.02
    found, slope = differentiated(graph, twists, np.zeros((len(graph.edges), 6, 6)))
    assert found.converged and found.num_iterations <= 5
    np.testing.assert_allclose(slope, expected, atol=1e-3 * np.abs(expected).max())
    gradient = compiled_gradient(0.0, graph, twists, scale)
    assert gradient != 0
    np.testing.assert_allclose(gradient, np.sum(scale * slope), atol=1e-3 * np.sum(np.abs(scale * slope)))


def test_eager_gradients_and_batches_are_those_of_compiled_programs():
    graph, _ = measured(*grid(2))
    edges = graph.edges

    def loss(information):
        moving = mcg.PoseGraph(graph.poses, mcg.Edge(edges.i, edges.j, edges.T_i_j, information))
        return jnp.sum(mcg.optimize_poses(moving).poses[-1, :3, 3])

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
    with pytest.raises(ValueError, match="do not support JVP"):
        jax.hessian(loss)(information)


def test_outliers_are_the_same_inside_transformations():
    graph, _ = measured(*SMALL["grid"], false=0.3)
    expected, found = mcg.optimize_poses(graph), jax.jit(mcg.optimize_poses)(graph)
    assert found.converged and not expected.kept.all()
    np.testing.assert_array_equal(found.kept, expected.kept)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-4)


def test_degenerate_graphs_are_finite_inside_transformations():
    graph, _ = measured(*grid(2))
    position = mcg.Edge(mcg.WORLD, 0, graph.poses[0], np.diag([1.0, 1, 1, 0, 0, 0]))[None]
    open_ended = mcg.PoseGraph(graph.poses, joined(graph.edges, position))
    edges = graph.edges
    apart = mcg.PoseGraph(graph.poses, edges[(edges.i < 4) == (edges.j < 4)])
    for each in (open_ended, apart):
        expected, (found, slope) = mcg.optimize_poses(each, robust=False), differentiated(each, *direction(each))
        assert found.status == expected.status == mcg.Status.DEGENERATE
        np.testing.assert_allclose(found.poses, expected.poses, atol=1e-4)
        assert not np.any(slope)
        np.testing.assert_array_equal(np.isinf(found.covariance), np.isinf(expected.covariance))
    assert np.isinf(np.diagonal(expected.covariance, 0, 1, 2)[4:]).all() and np.isfinite(expected.covariance[:4]).all()


class Distance(AbstractFactor):
    """Distances between two positions, metres."""

    rows: Any
    information: Any
    uncertain: Any
    metres: Any

    def linearize(self, poses):
        between = poses[:, 1, :3, 3] - poses[:, 0, :3, 3]
        length = np.linalg.norm(between, axis=1)
        towards = np.einsum("mi,mkij->mkj", between / length[:, None], poses[:, :, :3, :3]) * [[[-1], [1]]]
        jacobians = np.concatenate([towards, np.zeros_like(towards)], axis=2)
        return (length - self.metres)[:, None], jacobians[:, :, None]


class Height(AbstractFactor):
    """Heights of positions in the world, metres."""

    rows: Any
    information: Any
    uncertain: Any
    metres: Any

    def linearize(self, poses):
        jacobians = np.zeros((len(poses), 2, 1, 6))
        jacobians[:, 1, 0, :3] = poses[:, 1, 2, :3]
        return poses[:, 1, 2, 3:] - self.metres[:, None], jacobians


def with_factors():
    """A graph anchored by a prior, with distances, the last of which is wrong, and heights; and its truth."""
    truth, loops = grid(2)
    graph, _ = measured(truth, loops)
    prior = mcg.Edge(mcg.WORLD, 0, truth[0], 1e4 * np.eye(6))[None]
    a, b = np.array([0, 1, 2]), np.array([6, 5, 7])
    metres = np.linalg.norm(truth[a, :3, 3] - truth[b, :3, 3], axis=1) + np.array([0.003, -0.005, 2.0])
    distances = Distance(np.stack([a, b], axis=1), np.full((3, 1, 1), 1e4), np.ones(3, bool), metres)
    rows = np.stack([np.full(4, mcg.WORLD), np.arange(4, 8)], axis=1)
    heights = Height(rows, np.full((4, 1, 1), 2.5e3), np.zeros(4, bool), truth[4:, 2, 3] + [0.01, -0.02, 0.01, 0.0])
    return mcg.PoseGraph(graph.poses, joined(graph.edges, prior), [distances, heights]), truth


def test_other_kinds_of_measurements_take_part():
    """Against dense least squares of all residuals."""
    graph, _ = with_factors()
    found = mcg.optimize_poses(graph)
    assert found.converged and len(found.residuals) == len(graph.edges)
    np.testing.assert_array_equal(found.factor_weights[0], [1, 1, 0])
    assert found.factor_weights[1].all() and found.factor_residuals[0][2] > np.sqrt(chi2.ppf(0.99, 1))
    n, edges = len(graph.poses), graph.edges
    distances, heights = graph.factors

    def residuals(numbers):
        poses = moved(graph.poses, numbers.reshape(-1, 6))
        motions = (
            np.linalg.inv(np.where((edges.i >= 0)[:, None, None], poses[edges.i.clip(0)], np.eye(4))) @ poses[edges.j]
        )
        errors = logarithm(np.linalg.inv(edges.T_i_j) @ motions)
        between = np.linalg.norm(poses[distances.rows[:2, 0], :3, 3] - poses[distances.rows[:2, 1], :3, 3], axis=1)
        return np.concatenate(
            [
                (np.sqrt(edges.information.diagonal(0, 1, 2)) * errors).reshape(-1),
                100 * (between - distances.metres[:2]),
                50 * (poses[4:, 2, 3] - heights.metres),
            ]
        )

    dense = least_squares(residuals, np.zeros(6 * n), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    np.testing.assert_allclose(found.cost, dense.cost, rtol=1e-6)
    np.testing.assert_allclose(found.poses, moved(graph.poses, dense.x.reshape(-1, 6)), atol=1e-5)
    graph = mcg.PoseGraph(found.poses, graph.edges, graph.factors)
    slope = jacobian(residuals, 6 * n)
    expected = np.linalg.inv(slope.T @ slope).reshape(n, 6, n, 6)[np.arange(n), :, np.arange(n)]
    np.testing.assert_allclose(found.covariance, expected, atol=1e-3 * expected.max())
    with pytest.raises(ValueError, match=r"factors\[0\]: expected rows from 0 to 7 or WORLD, got 8"):
        mcg.PoseGraph(
            graph.poses, graph.edges, [Height(heights.rows + np.array([0, 2]), *jax.tree.leaves(heights)[1:])]
        )
    with pytest.raises(ValueError, match=r"factors\[0\]: expected rows \(m, 2\) and information"):
        mcg.PoseGraph(graph.poses, graph.edges, [Height(np.arange(4), *jax.tree.leaves(heights)[1:])])


def test_other_kinds_of_measurements_take_part_inside_transformations_without_derivatives():
    graph, _ = with_factors()
    expected, found = mcg.optimize_poses(graph), jax.jit(mcg.optimize_poses)(graph)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-4)
    np.testing.assert_array_equal(found.factor_weights[0], expected.factor_weights[0])

    def height(motions):
        edges = graph.edges
        moving = mcg.Edge(edges.i, edges.j, motions, edges.information, uncertain=edges.uncertain)
        return mcg.optimize_poses(mcg.PoseGraph(graph.poses, moving, graph.factors)).poses[:, 2, 3].sum()

    with pytest.raises(ValueError, match=r"^graph: poses have derivatives only if edges"):
        jax.grad(height)(jnp.asarray(graph.edges.T_i_j))


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
        motions = edges.T_i_j @ jax.vmap(lambda x: jaxlie.SE3.exp(x).as_matrix())(steps[0] * directions["motions"])
        information = edges.information + steps[1] * directions["information"]
        moving = mcg.PoseGraph(graph.poses, mcg.Edge(edges.i, edges.j, motions, information))
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


def test_one_pose_and_no_edges():
    found = mcg.optimize_poses(mcg.PoseGraph([np.eye(4)], []))
    assert found.converged and found.cost == 0 and "1 poses, 0 edges" in repr(found)
    np.testing.assert_array_equal(found.covariance, np.zeros((1, 6, 6)))


def test_parts_that_are_not_connected():
    graph, _ = measured(*SMALL["grid"])
    cut = (graph.edges.i < 13) == (graph.edges.j < 13)
    found = mcg.optimize_poses(mcg.PoseGraph(graph.poses, graph.edges[cut]))
    assert found.status == mcg.Status.DEGENERATE and not found.converged
    assert np.isfinite(found.poses).all()
    np.testing.assert_allclose(found.poses[13], graph.poses[13], atol=1e-14)
    assert np.all(np.isfinite(found.covariance[:13])) and np.all(np.isinf(np.diagonal(found.covariance[13:], 0, 1, 2)))


def test_what_no_edge_measures_is_spread_evenly():
    """A corridor: edges know nothing of x, the loop at its end says that it is 1 m longer."""
    n = 11
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = np.arange(n)
    blind, sure = np.diag([0, 1e4, 1e4, 1e4, 1e4, 1e4]), 1e4 * np.eye(6)
    step, end = np.eye(4), np.eye(4)
    step[0, 3], end[0, 3] = 1, n
    edges = [mcg.Edge(k, k + 1, step, blind) for k in range(n - 1)]
    alone = mcg.optimize_poses(mcg.PoseGraph(poses, edges))
    assert alone.status == mcg.Status.DEGENERATE
    np.testing.assert_allclose(alone.poses, poses, atol=1e-9)
    found = mcg.optimize_poses(mcg.PoseGraph(poses, [*edges, mcg.Edge(0, n - 1, end, sure, uncertain=True)]))
    assert found.status == mcg.Status.DEGENERATE and found.kept.all()
    np.testing.assert_allclose(found.poses[:, 0, 3], 1.1 * np.arange(n), atol=1e-3)
    np.testing.assert_allclose(found.poses[:, 1:3, 3], 0, atol=1e-6)
    end[1, 3] = 5
    rejected = mcg.optimize_poses(mcg.PoseGraph(poses[:2], [edges[0], mcg.Edge(0, 1, end, sure, uncertain=True)]))
    assert rejected.status == mcg.Status.DEGENERATE and not rejected.kept.all()


def test_double_edges_count_twice():
    graph, _ = measured(*grid(2))
    twice = mcg.PoseGraph(graph.poses, [graph.edges[k] for k in range(len(graph.edges))] * 2)
    found, expected = (mcg.optimize_poses(each, robust=False) for each in (twice, graph))
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-6)
    np.testing.assert_allclose(found.covariance, expected.covariance / 2, rtol=1e-4, atol=1e-12)


def test_what_is_wrong_is_named():
    eye = np.eye(4)
    edge = mcg.Edge(0, 1, eye, np.eye(6))
    indefinite = np.diag([1.0, 1, 1, 1, 1, -1])
    for edges, message in (
        ([edge, mcg.Edge(0, 2, eye, np.eye(6))], r"edges\[1\]: j: expected a row from 0 to 1, got 2"),
        ([mcg.Edge(-1, 1, eye, np.eye(6))], r"edges\[0\]: i: expected a row from 0 to 1, got -1"),
        (edge, r"edges: expected one leading axis, got shape \(\)"),
        ([mcg.Edge(1, 1, eye, np.eye(6))], r"edges\[0\]: expected two different poses, got 1"),
        ([mcg.Edge(0, 1, 2 * eye, np.eye(6))], r"edges\[0\].T_i_j: expected a rigid motion"),
        ([edge, mcg.Edge(0, 1, eye, indefinite)], r"edges\[1\]: information: expected a positive semidefinite"),
        ([mcg.Edge(0, 1, eye, np.full((6, 6), np.nan))], r"edges\[0\]: information: expected finite numbers"),
        ([mcg.Edge(0, 1, eye, np.triu(np.ones((6, 6))))], r"edges\[0\]: information: expected a symmetric"),
        ([edge, edge[None]], r"edges\[1\]: expected a single Edge"),
    ):
        with pytest.raises(ValueError, match=message):
            mcg.PoseGraph([eye, eye], edges)
    with pytest.raises(ValueError, match="poses: expected at least one pose"):
        mcg.PoseGraph([], [])
    with pytest.raises(ValueError, match=r"poses: expected at least one pose of shape \(4, 4\), got shape \(4, 4\)"):
        mcg.PoseGraph(jnp.eye(4), [])
    for name in ("T_i_j", "information", "covariance"):
        numbers = {"T_i_j": eye, **({} if name == "covariance" else {"information": np.eye(6)})}
        with pytest.raises(ValueError, match=f"{name}: expected an array of numbers, got array"):
            mcg.Edge(0, 1, **numbers | {name: np.array("a")})
    for matrices in ({}, {"information": np.eye(6), "covariance": np.eye(6)}):
        with pytest.raises(ValueError, match="information: expected either"):
            mcg.Edge(0, 1, eye, **matrices)
    with pytest.raises(ValueError, match=r"covariance: expected shape \(6, 6\), got \(3, 3\)"):
        mcg.Edge(0, 1, eye, covariance=np.eye(3))
    with pytest.raises(ValueError, match="covariance: expected a positive definite matrix"):
        mcg.Edge(0, 1, eye, covariance=indefinite)
    with pytest.raises(ValueError, match="covariance: expected finite numbers"):
        mcg.Edge(0, 1, eye, covariance=np.full((6, 6), np.nan))
    with pytest.raises(ValueError, match=r"information: expected shape \(6, 6\), got \(3, 3\)"):
        mcg.Edge(0, 1, eye, np.eye(3))
    with pytest.raises(ValueError, match="i: expected the row of a pose"):
        mcg.Edge(0.5, 1, eye, np.eye(6))
    with pytest.raises(ValueError, match="max_iterations: expected an integer of at least 1"):
        mcg.optimize_poses(mcg.PoseGraph([eye], []), max_iterations=0)


def test_an_edge_takes_what_describes_it():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6)) + 3 * np.eye(6)
    covariance, transform = root @ root.T, moved(np.eye(4)[None], rng.normal(size=(1, 6)))[0]
    edge = mcg.Edge(1, 0, jaxlie.SE3.from_matrix(jnp.asarray(transform)), covariance=covariance)
    np.testing.assert_allclose(edge.information @ covariance, np.eye(6), atol=1e-12)
    np.testing.assert_array_equal(edge.information, edge.information.T)
    np.testing.assert_allclose(edge.T_i_j, transform, atol=1e-6)
    assert not edge.uncertain
    inside = jax.jit(lambda values: mcg.Edge(1, 0, transform, covariance=values).information)(covariance)
    np.testing.assert_allclose(inside, edge.information, atol=1e-4)
    # Asymmetry within rounding, as in files, is removed.
    rounded = edge.information + 1e-8 * np.triu(np.ones((6, 6)), 1)
    graph = mcg.PoseGraph([np.eye(4)] * 2, [edge, mcg.Edge(0, 1, transform, rounded, uncertain=True)])
    np.testing.assert_allclose(graph.edges.information[1], edge.information, atol=1e-7)
    np.testing.assert_array_equal(graph.edges.information, graph.edges.information.swapaxes(1, 2))
    np.testing.assert_array_equal(graph.edges.uncertain, [False, True])
    asymmetric = edge.information + 1e-4 * np.triu(np.ones((6, 6)), 1)
    with pytest.raises(ValueError, match=r"edges\[0\]: information: expected a symmetric"):
        mcg.PoseGraph([np.eye(4)] * 2, [mcg.Edge(0, 1, transform, asymmetric)])


def test_overflow_and_too_few_iterations_are_statuses():
    graph, _ = measured(*SMALL["sphere"])
    assert mcg.optimize_poses(graph, robust=False, max_iterations=1).status == mcg.Status.MAX_ITERATIONS
    huge = mcg.Edge(graph.edges.i, graph.edges.j, graph.edges.T_i_j, 1e304 * graph.edges.information)
    assert mcg.optimize_poses(mcg.PoseGraph(graph.poses, huge)).status == mcg.Status.NON_FINITE


def test_files(tmp_path):
    graph = correlated(measured(*SMALL["grid"], false=0.2)[0])
    mcg.io.write_g2o(tmp_path / "a.g2o", graph)
    again = mcg.io.read_g2o(tmp_path / "a.g2o")
    np.testing.assert_allclose(again.poses, graph.poses, atol=1e-12)
    np.testing.assert_allclose(again.edges.T_i_j, graph.edges.T_i_j, atol=1e-12)
    np.testing.assert_allclose(again.edges.information, graph.edges.information, rtol=1e-12)
    np.testing.assert_array_equal(again.edges.uncertain, np.abs(graph.edges.i - graph.edges.j) != 1)
    found = mcg.optimize_poses(measured(*SMALL["grid"], false=0.2)[0])
    mcg.io.write_g2o(tmp_path / "b.g2o", found)
    assert len(mcg.io.read_g2o(tmp_path / "b.g2o").edges) == found.kept.sum()
    if importlib.util.find_spec("gtsam"):
        import gtsam

        factors, values = gtsam.readG2o(str(tmp_path / "a.g2o"), True)
        assert factors.size() == len(graph.edges)
        own = 0.5 * np.sum(mcg.optimize_poses(graph, robust=False, max_iterations=1).residuals ** 2)
        assert own <= factors.error(values)
    vertex = "VERTEX_SE3:QUAT 0 1 0 0 0 0 0 1\n"
    for text, message in (
        ("EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1" + 21 * " 1", "got EDGE_SE3:QUAT"),
        (
            "\nVERTEX_SE3:QUAT 0 1 0 0 0 0 0",
            r"c\.g2o: cannot be read as a pose graph: line 2: expected 8 numbers .* got 7",
        ),
        (vertex + "VERTEX_SE3:QUAT 1 1 0 0 0 0 x 1", "line 2: could not convert string to float: 'x'"),
        (
            vertex + "EDGE_SE3:QUAT 0 2 1 0 0 0 0 0 1" + 21 * " 1",
            "line 2: expected a vertex for each end, got none of number 2",
        ),
        ("VERTEX_SE3:QUAT 0 1 0 0 0 0 0 0", "line 1: expected finite numbers and a quaternion other than 0"),
        ("VERTEX_SE2 0 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", "poses in space, got EDGE_SE2, VERTEX_SE2"),
        (
            vertex + "PARAMS_SE3OFFSET 0 1 0 0 0 0 0 1\nEDGE_SE3_PRIOR 0 0 0 0 0 0 0 0 1" + 21 * " 1",
            "got PARAMS_SE3OFFSET",
        ),
        ("", "expected lines VERTEX_SE3:QUAT, poses in space, got none"),
    ):
        (tmp_path / "c.g2o").write_text(text)
        with pytest.raises(ValueError, match=message):
            mcg.io.read_g2o(tmp_path / "c.g2o")


def test_files_hold_priors(tmp_path):
    poses, loops = SMALL["grid"]
    graph = with_priors(measured(poses, loops)[0], poses)
    mcg.io.write_g2o(tmp_path / "a.g2o", graph)
    again = mcg.io.read_g2o(tmp_path / "a.g2o")
    for name in ("i", "j", "T_i_j", "information"):
        np.testing.assert_allclose(getattr(again.edges, name), getattr(graph.edges, name), atol=1e-12)
    prior = again.edges.i == mcg.WORLD
    assert prior.sum() == 14 and not again.edges.uncertain[prior].any()
    with pytest.raises(ValueError, match="graph: expected a PoseGraph or a PoseGraphResult, got NoneType"):
        mcg.io.write_g2o(tmp_path / "b.g2o", None)


def test_files_are_those_of_others(tmp_path):
    """Vertices in any order and with any numbers, a quaternion of any length, and distinct numbers everywhere."""
    upper = [100, 1, 2, 3, 4, 5, 200, 6, 7, 8, 9, 300, 10, 11, 12, 400, 13, 14, 500, 15, 600]
    lines = [
        "VERTEX_SE3:QUAT 7 1 2 3 0 0 1 1",
        "FIX 3",
        "VERTEX_SE3:QUAT 3 4 5 6 0.2 0 0 0",
        "VERTEX_SE3:QUAT 4 0 0 0 0 0 0 1",
        "EDGE_SE3:QUAT 3 7 7 8 9 0 0.6 0 0.8 " + " ".join(map(str, upper)),
        "EDGE_SE3:QUAT 4 3 0 0 0 0 0 0 1 " + " ".join(map(str, upper)),
    ]
    (tmp_path / "a.g2o").write_text("\n".join(lines))
    graph = mcg.io.read_g2o(tmp_path / "a.g2o")
    turned = [[[1, 0, 0, 4], [0, -1, 0, 5], [0, 0, -1, 6]], np.eye(3, 4), [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]]
    np.testing.assert_allclose(graph.poses[:, :3], turned, atol=1e-15)
    np.testing.assert_allclose(graph.edges.T_i_j[0, :3], [[0.28, 0, 0.96, 7], [0, 1, 0, 8], [-0.96, 0, 0.28, 9]])
    for field, expected in (("i", [0, 1]), ("j", [2, 0]), ("uncertain", [True, False])):
        np.testing.assert_array_equal(getattr(graph.edges, field), expected)
    information = graph.edges.information[0]
    np.testing.assert_array_equal(np.diag(information), [100, 200, 300, 400, 500, 600])
    np.testing.assert_array_equal(information[0, 1:], [1, 2, 3, 4, 5])
    np.testing.assert_array_equal(information, information.T)
    mcg.io.write_g2o(tmp_path / "b.g2o", graph)
    vertex, *_, edge, _ = (tmp_path / "b.g2o").read_text().splitlines()
    assert vertex.split()[0] == "VERTEX_SE3:QUAT" and edge.split()[0] == "EDGE_SE3:QUAT"
    np.testing.assert_allclose(np.array(vertex.split()[1:], float), [0, 4, 5, 6, 1, 0, 0, 0], atol=1e-15)
    np.testing.assert_allclose(np.array(edge.split()[1:], float), [0, 2, 7, 8, 9, 0, 0.6, 0, 0.8, *upper], rtol=1e-12)


def partly_blind(seed, kind, number=8):
    """A ring of poses with loops; edges know nothing of x or, in a corridor, of its direction seen to 0.02 rad."""
    rng, sigma = np.random.default_rng(seed), np.repeat([0.05, 0.02], 3)
    angles = 2 * np.pi * np.arange(number) / number * (kind == "ring")
    poses = np.array([motion((10 * np.cos(a), 10 * np.sin(a), k, 0, 0, a)) for k, a in enumerate(angles)])
    i, j = np.array([(k, k + step) for step in (1, 2, number - 1) for k in range(number - step)]).T
    motions = moved(np.linalg.inv(poses[i]) @ poses[j], sigma * rng.normal(size=(len(i), 6)))
    information = np.tile(np.diag(sigma**-2.0), (len(i), 1, 1))
    for each in information:
        along = Rotation.from_rotvec(0.02 * rng.normal(size=3) * (kind == "corridor")).apply([1.0, 0, 0])
        others = np.eye(6)
        others[:3, :3] -= np.outer(along, along)
        each[:] = others @ each @ others
    start = [poses[0]]
    for step in motions[: number - 1]:
        start.append(start[-1] @ step)
    return mcg.PoseGraph(np.array(start), mcg.Edge(i, j, motions, information)), poses


@pytest.mark.parametrize("kind", ["ring", "corridor"])
def test_poses_do_not_slide_along_what_edges_do_not_measure(kind):
    for seed in range(5):
        graph, truth = partly_blind(seed, kind)
        found = mcg.optimize_poses(graph)
        before, after = (np.linalg.norm((each - truth)[:, :3, 3], axis=1).max() for each in (graph.poses, found.poses))
        assert found.status == mcg.Status.DEGENERATE
        assert after < max(before, 1.0)
        # What is measured is no further from the measurements than the noise.
        assert found.cost < 3 * len(graph.edges)
        inside = jax.jit(mcg.optimize_poses)(graph)
        np.testing.assert_allclose(inside.poses, found.poses, atol=0.05)


def unmeasured_motion(graph, truth, poses):
    """Twists from the true poses to others: the part along motions that no edge would measure if it saw x exactly."""
    ends = np.stack([truth[graph.edges.i], truth[graph.edges.j]], axis=1)
    jacobians = motion_jacobians(ends)
    rows = np.zeros((len(ends), 6, len(truth), 6))
    for end, each in enumerate((graph.edges.i, graph.edges.j)):
        rows[np.arange(len(ends)), :, each] = jacobians[:, end]
    rows = rows[:, :, 1:].reshape(len(ends), 6, -1)
    _, values, motions = np.linalg.svd(rows[:, 1:].reshape(-1, rows.shape[2]))
    free = motions[values < 1e-9].T
    twists = logarithm(np.linalg.inv(truth) @ poses)[1:].reshape(-1)
    return free @ np.linalg.lstsq(rows[:, 0] @ free, rows[:, 0] @ twists)[0]


@pytest.mark.parametrize(("kind", "metres"), [("ring", 0.005), ("corridor", 0.03)])
def test_poses_stay_at_an_exact_start_along_what_no_edge_measures(kind, metres):
    for seed in range(12):
        graph, truth = partly_blind(seed, kind)
        found = mcg.optimize_poses(mcg.PoseGraph(truth, graph.edges))
        assert found.status == mcg.Status.DEGENERATE
        # Next to noise of 0.05 m in the other directions, and over lengths of 7 m.
        assert np.abs(unmeasured_motion(graph, truth, found.poses)).max() < metres


def test_directions_that_only_some_edges_measure_do_not_depend_on_the_start():
    poses, loops = grid(2)
    graph, _ = measured(poses, loops)
    edges = graph.edges
    information = edges.information.copy()
    information[::2, 0] = information[::2, :, 0] = 0
    found = mcg.optimize_poses(mcg.PoseGraph(poses, mcg.Edge(edges.i, edges.j, edges.T_i_j, information)))
    away = moved(poses, 0.3 * np.random.default_rng(1).normal(size=(len(poses), 6)))
    away[0] = poses[0]
    other = mcg.optimize_poses(mcg.PoseGraph(away, mcg.Edge(edges.i, edges.j, edges.T_i_j, information)))
    assert found.converged and other.converged
    np.testing.assert_allclose(other.poses, found.poses, atol=1e-4)


def test_concrete_arrays_of_jax_are_checked():
    graph, _ = measured(*grid(2))
    for wrong, message in ((2 * graph.poses, "rigid"), (np.nan * graph.poses, "rigid")):
        with pytest.raises(ValueError, match=rf"^poses\[0\]: expected a {message}"):
            mcg.PoseGraph(jnp.asarray(wrong), graph.edges)
    skewed = np.eye(6)
    skewed[0, 1] = 0.1
    with pytest.raises(ValueError, match=r"^covariance: expected a symmetric matrix"):
        mcg.Edge(0, 1, np.eye(4), covariance=skewed)


def test_rows_outside_of_the_graph_are_named_inside_transformations():
    graph, _ = measured(*grid(2))
    edges = graph.edges

    def solve(j):
        return mcg.optimize_poses(mcg.PoseGraph(graph.poses, mcg.Edge(edges.i, j, edges.T_i_j, edges.information)))

    assert jax.jit(solve)(jnp.asarray(edges.j)).converged
    with pytest.raises(Exception, match="edges: expected rows from 0 to 7"):
        jax.block_until_ready(jax.jit(solve)(jnp.asarray(edges.j).at[3].set(8)).poses)


def test_files_refuse_what_they_cannot_hold(tmp_path):
    graph, _ = measured(*grid(2))
    distance = Distance(np.array([[0, 1]]), np.ones((1, 1, 1)), np.zeros(1, bool), np.ones(1))
    with pytest.raises(ValueError, match=r"^graph: expected edges alone, .* got 1 further factors"):
        mcg.io.write_g2o(tmp_path / "graph.g2o", mcg.PoseGraph(graph.poses, graph.edges, [distance]))
    key = 97 << 56
    lines = [f"VERTEX_SE3:QUAT {key + k} 0 0 0 0 0 0 1" for k in range(2)]
    (tmp_path / "keys.g2o").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=f"vertex numbers below 2.53, got {key}"):
        mcg.io.read_g2o(tmp_path / "keys.g2o")


def test_chi_squared_tells_whether_the_information_is_right():
    graph, _ = measured(*SMALL["grid"])
    found = mcg.optimize_poses(graph)
    assert 0.7 < found.chi_squared < 1.4
    edges = graph.edges
    precise = mcg.Edge(edges.i, edges.j, edges.T_i_j, 100 * edges.information)
    assert mcg.optimize_poses(mcg.PoseGraph(graph.poses, precise), robust=False).chi_squared > 50
    assert np.isnan(mcg.optimize_poses(mcg.PoseGraph(graph.poses, edges[: len(graph.poses) - 1])).chi_squared)
