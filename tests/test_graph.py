"""Pose graphs against gtsam or dense least squares, finite differences, and simulation."""

import importlib.util

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import mcgicp_jax as mcg
from mcgicp_jax import _graph, metrics
from tests.differences import X64, needs_x64
from tests.graphs import garage, grid, measured, moved, sphere, with_gtsam
from tests.test_programs import compilations

SMALL = {"sphere": sphere(6, 10), "grid": grid(3), "garage": garage(2, 40)}


def correlated(graph, seed=1, rank=3):
    """The graph with full information matrices, the last one of that rank."""
    rng = np.random.default_rng(seed)
    roots = (np.eye(6) + 0.3 * rng.normal(size=(len(graph.edges), 6, 6))) * [20, 20, 20, 50, 50, 50]
    roots[-1, rank:] = 0
    edges = graph.edges
    return mcg.PoseGraph(
        graph.poses, mcg.Edge(edges.i, edges.j, edges.T_i_j, roots.swapaxes(1, 2) @ roots, loop=edges.loop)
    )


def dense_minimum(graph):
    """Cost at the minimum by SciPy, with rotation vectors of its own and numerical derivatives."""
    edges = graph.edges
    roots = [np.linalg.cholesky(each + 1e-9 * np.eye(6)).T for each in edges.information]

    def residuals(numbers):
        poses = moved(graph.poses, np.concatenate([np.zeros((1, 6)), numbers.reshape(-1, 6)]))
        errors = np.linalg.inv(edges.T_i_j) @ np.linalg.inv(poses[edges.i]) @ poses[edges.j]
        turns = Rotation.from_matrix(errors[:, :3, :3]).as_rotvec()
        shifts = [_log_translation(turn, shift) for turn, shift in zip(turns, errors[:, :3, 3], strict=True)]
        return np.concatenate([root @ [*v, *w] for root, v, w in zip(roots, shifts, turns, strict=True)])

    found = least_squares(residuals, np.zeros(6 * len(graph.poses) - 6), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    return found.cost


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


def se3s(matrices):
    return jaxlie.SE3.from_matrix(jnp.asarray(matrices))


@pytest.fixture(scope="module")
def both():
    """A graph, its result, and that of a compiled program."""
    graph, _ = measured(*SMALL["grid"])
    compiled = jax.jit(lambda graph: mcg.optimize_poses(graph, robust=False))
    return graph, mcg.optimize_poses(graph, robust=False), compiled(graph)


def test_covariances_are_blocks_of_the_inverse(both, monkeypatch):
    graph, found, inside = both
    dense = np.asarray(inside.covariance)
    deviations = np.sqrt(np.diagonal(found.covariance, 0, 1, 2))[1:]
    difference = (found.covariance - dense)[1:] / deviations[:, :, None] / deviations[:, None]
    assert np.abs(difference).max() < (1e-4 if X64 else 0.05)
    monkeypatch.setattr(_graph, "_COLUMNS", 18)
    monkeypatch.setattr(_graph, "_DENSE", 0)
    again = mcg.optimize_poses(graph, robust=False)
    np.testing.assert_allclose(again.covariance, found.covariance, rtol=1e-6, atol=1e-12)


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
    assert found.kept[~graph.edges.loop].all()
    np.testing.assert_array_equal(found.weights, found.kept)
    assert np.all(found.residuals[~true] > np.sqrt(chi2.ppf(0.99, 6)))
    plain = mcg.optimize_poses(graph, robust=False)
    assert plain.kept.all() and metrics.ate(plain.poses, poses, alignment="first") > 2 * best


def test_the_threshold_is_that_of_the_99_percent():
    np.testing.assert_allclose(_graph.LARGEST_SQUARE, chi2.ppf(0.99, 6), rtol=1e-12)


def test_other_sizes_compile_nothing():
    mcg.optimize_poses(measured(*SMALL["grid"], false=0.3)[0]).covariance  # noqa: B018
    with compilations() as found:
        for name in ("sphere", "garage"):
            mcg.optimize_poses(measured(*SMALL[name], false=0.2)[0]).covariance  # noqa: B018
    assert not found


def test_transformations_give_the_same_poses(both):
    graph, expected, found = both
    assert found.converged and found.status == mcg.Status.CONVERGED
    np.testing.assert_allclose(found.poses, expected.poses, atol=2e-3)
    np.testing.assert_allclose(found.residuals, expected.residuals, atol=0.05)
    with pytest.raises(ValueError, match="robust: expected False inside transformations"):
        jax.jit(mcg.optimize_poses)(graph)


@pytest.mark.slow
@needs_x64
def test_gradients_reach_motions_and_informations():
    graph = correlated(measured(*grid(2))[0])
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
    found = mcg.optimize_poses(mcg.PoseGraph(poses, [*edges, mcg.Edge(0, n - 1, end, sure, loop=True)]))
    assert found.status == mcg.Status.DEGENERATE and found.kept.all()
    np.testing.assert_allclose(found.poses[:, 0, 3], 1.1 * np.arange(n), atol=1e-3)
    np.testing.assert_allclose(found.poses[:, 1:3, 3], 0, atol=1e-6)


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
    with pytest.raises(ValueError, match="information: expected either"):
        mcg.Edge(0, 1, eye)
    with pytest.raises(ValueError, match="covariance: expected a finite positive definite"):
        mcg.Edge(0, 1, eye, covariance=indefinite)
    with pytest.raises(ValueError, match=r"information: expected shape \(6, 6\), got \(3, 3\)"):
        mcg.Edge(0, 1, eye, np.eye(3))
    with pytest.raises(ValueError, match="i: expected the row of a pose"):
        mcg.Edge(0.5, 1, eye, np.eye(6))
    with pytest.raises(ValueError, match="max_iterations: expected an integer of at least 1"):
        mcg.optimize_poses(mcg.PoseGraph([eye], []), max_iterations=0)


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
    np.testing.assert_array_equal(again.edges.loop, np.abs(graph.edges.i - graph.edges.j) != 1)
    found = mcg.optimize_poses(measured(*SMALL["grid"], false=0.2)[0])
    mcg.io.write_g2o(tmp_path / "b.g2o", found)
    assert len(mcg.io.read_g2o(tmp_path / "b.g2o").edges) == found.kept.sum()
    if importlib.util.find_spec("gtsam"):
        import gtsam

        factors, values = gtsam.readG2o(str(tmp_path / "a.g2o"), True)
        assert factors.size() == len(graph.edges)
        own = 0.5 * np.sum(mcg.optimize_poses(graph, robust=False, max_iterations=1).residuals ** 2)
        assert own <= factors.error(values)
    for text, message in (
        ("EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1" + 21 * " 1", "expected a vertex for each end"),
        ("VERTEX_SE3:QUAT 0 1 0 0 0 0 0", "cannot be read as a pose graph"),
        ("VERTEX_SE3:QUAT 0 1 0 0 0 0 0 0", "quaternions other than 0"),
        ("", "expected a vertex"),
    ):
        (tmp_path / "c.g2o").write_text(text)
        with pytest.raises(ValueError, match=message):
            mcg.io.read_g2o(tmp_path / "c.g2o")
