"""Pose graphs against dense least squares."""

import warnings

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

import mcgicp_jax as mcg
from tests.compilations import compilations
from tests.graphs import SMALL, Height, correlated, grid, joined, measured, moved, shifted, with_factors, with_priors
from tests.reference import exponential, logarithm
from tests.refusals import refused
from tests.scenes import motion


def whitened(graph):
    """Residuals of the edges in standard deviations, as a function of the motions of all poses, or of all but the first
    where no edge is a prior."""
    edges = graph.edges
    roots = [np.linalg.cholesky(each + 1e-9 * np.eye(6)).T for each in edges.information]

    def residuals(numbers):
        poses = moved(graph.poses, np.pad(numbers, (6 * len(graph.poses) - numbers.size, 0)).reshape(-1, 6))
        # The world's pose is the last.
        before = np.array([*poses, np.eye(4)])[edges.i.clip(-1)]
        errors = np.linalg.inv(edges.T_i_j) @ np.linalg.inv(before) @ poses[edges.j]
        return np.concatenate([root @ twist for root, twist in zip(roots, logarithm(errors), strict=True)])

    return residuals


def jacobian(function, size, step=1e-5):
    """Central differences at 0."""
    steps = step * np.eye(size)
    return np.array([(function(each) - function(-each)) / (2 * step) for each in steps]).T


@pytest.mark.parametrize("priors", [False, True])
def test_the_minimum_is_that_of_dense_least_squares(priors):
    """By SciPy, with rotation vectors of its own and numerical derivatives. A prior moves the first pose, too."""
    graph = correlated(measured(*grid(2))[0])
    graph = with_priors(graph, grid(2)[0]) if priors else graph
    found = mcg.optimize_poses(graph, robust=False)
    assert found.converged
    start = np.zeros(6 * len(graph.poses) - 6 * (not priors))
    dense = least_squares(whitened(graph), start, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    np.testing.assert_allclose(found.cost, dense.cost, rtol=1e-6)
    np.testing.assert_allclose(found.cost, 0.5 * np.sum(found.residuals**2), rtol=1e-12)
    assert (np.abs(found.poses[0] - graph.poses[0]).max() > 1e-3) == priors


def test_a_prior_alone_moves_the_graph_and_makes_it_uncertain():
    """Next to motions known to a millimetre, a start known to 100 m: no pose is fixed, and no digit is lost."""
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


def test_rounding_of_poses_in_float32_is_warned_of():
    graph, _ = measured(*SMALL["grid"])
    far, solve = shifted(graph, (5e5, 5e6, 100)), jax.jit(lambda each: mcg.optimize_poses(each).poses)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        near = solve(graph)
        mcg.optimize_poses(far)
        with jax.enable_x64(True):
            np.testing.assert_allclose(np.subtract(solve(far), near)[1:, :3, 3] - (5e5, 5e6, 100), 0, atol=1e-4)
    with pytest.warns(UserWarning, match=r"poses .* 0\.5 m") as caught:
        jax.block_until_ready(solve(far))
    # Run-time checks of annotations wrap each function of the package.
    assert caught[0].filename == __file__ or "jaxtyping" in caught[0].filename


def test_parts_that_are_not_connected_need_priors_each():
    poses, loops = SMALL["grid"]
    graph, _ = measured(poses, loops)
    parts = graph.edges[(graph.edges.i < 13) == (graph.edges.j < 13)]
    none = mcg.optimize_poses(mcg.PoseGraph(graph.poses, parts))
    assert none.status == mcg.Status.DEGENERATE and not none.converged
    assert np.isfinite(none.poses).all()
    np.testing.assert_allclose(none.poses[13], graph.poses[13], atol=1e-14)
    assert np.all(np.isfinite(none.covariance[:13])) and np.all(np.isinf(np.diagonal(none.covariance[13:], 0, 1, 2)))
    covariance = np.diag([1e-4] * 6)
    priors = [mcg.Edge(mcg.WORLD, k, poses[k], covariance=covariance)[None] for k in (3, 20)]
    found = mcg.optimize_poses(mcg.PoseGraph(graph.poses, joined(parts, *priors)))
    assert found.converged and np.isfinite(found.covariance).all()
    np.testing.assert_allclose(found.poses[[3, 20]], poses[[3, 20]], atol=1e-4)
    np.testing.assert_allclose(found.covariance[[3, 20]], np.array([covariance] * 2), rtol=1e-4, atol=1e-9)
    one = mcg.optimize_poses(mcg.PoseGraph(graph.poses, joined(parts, priors[1])))
    assert one.status == mcg.Status.DEGENERATE
    assert np.all(np.isinf(np.diagonal(one.covariance[:13], 0, 1, 2))) and np.all(np.isfinite(one.covariance[13:]))
    # A wrong prior is rejected like a loop.
    wrong = mcg.Edge(mcg.WORLD, 5, motion((50, 0, 0, 0, 0, 1)), covariance=covariance, uncertain=True)[None]
    again = mcg.optimize_poses(mcg.PoseGraph(graph.poses, joined(parts, *priors, wrong)))
    assert not again.kept[-1]
    np.testing.assert_array_equal(again.kept[:-1], found.kept)
    np.testing.assert_allclose(again.poses, found.poses, atol=1e-6)


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
    parts = mcg.PoseGraph(None, joined(exact[gap], prior[None])).poses
    np.testing.assert_allclose(parts[:30], np.linalg.inv(poses[0]) @ poses[:30], atol=1e-9)
    np.testing.assert_allclose(parts[30:], poses[30:], atol=1e-9)
    blind = mcg.Edge(0, 1, motion((9, 9, 9, 0, 0, 1)), np.diag([1.0, 1, 1, 1, 1, 0]))
    sure = mcg.Edge(0, 1, motion((1, 0, 0, 0, 0, 0)), np.eye(6), uncertain=True)
    np.testing.assert_allclose(mcg.PoseGraph(None, [blind, sure]).poses[1], sure.T_i_j, atol=1e-12)


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
    np.testing.assert_array_equal(found.covariance[0], 0)


def test_other_sizes_compile_nothing():
    mcg.optimize_poses(measured(*SMALL["grid"], false=0.3)[0]).covariance  # noqa: B018
    with compilations() as found:
        for name in ("sphere", "garage"):
            mcg.optimize_poses(measured(*SMALL[name], false=0.2)[0]).covariance  # noqa: B018
    assert not found


def test_other_kinds_of_measurements_take_part():
    """Against dense least squares of all residuals."""
    graph, _ = with_factors()
    found = mcg.optimize_poses(graph)
    assert found.converged and len(found.residuals) == len(graph.edges)
    np.testing.assert_array_equal(found.factor_weights[0], [1, 1, 0])
    assert found.factor_weights[1].all() and found.factor_residuals[0][2] > np.sqrt(chi2.ppf(0.99, 1))
    n, (distances, heights) = len(graph.poses), graph.factors

    def residuals(numbers):
        poses = moved(graph.poses, numbers.reshape(-1, 6))
        between = np.linalg.norm(poses[distances.rows[:2, 0], :3, 3] - poses[distances.rows[:2, 1], :3, 3], axis=1)
        further = 100 * (between - distances.metres[:2]), 50 * (poses[4:, 2, 3] - heights.metres)
        return np.concatenate([whitened(graph)(numbers), *further])

    dense = least_squares(residuals, np.zeros(6 * n), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    np.testing.assert_allclose(found.cost, dense.cost, rtol=1e-6)
    np.testing.assert_allclose(found.poses, moved(graph.poses, dense.x.reshape(-1, 6)), atol=1e-5)
    graph = mcg.PoseGraph(found.poses, graph.edges, graph.factors)
    slope = jacobian(residuals, 6 * n)
    expected = np.linalg.inv(slope.T @ slope).reshape(n, 6, n, 6)[np.arange(n), :, np.arange(n)]
    np.testing.assert_allclose(found.covariance, expected, atol=1e-3 * expected.max())
    for rows, shown in ((heights.rows + np.array([0, 2]), "got 8"), (np.arange(4), "(m, 2)")):
        wrong = Height(rows, *jax.tree.leaves(heights)[1:])
        refused(lambda wrong=wrong: mcg.PoseGraph(graph.poses, graph.edges, [wrong]), "factors[0]", shown)


def test_one_pose_and_no_edges():
    found = mcg.optimize_poses(mcg.PoseGraph([np.eye(4)], []))
    assert found.converged and found.cost == 0 and "1 poses, 0 edges" in repr(found)
    np.testing.assert_array_equal(found.covariance, np.zeros((1, 6, 6)))
    refused(lambda: mcg.optimize_poses(mcg.PoseGraph([np.eye(4)], []), max_iterations=0), "max_iterations")


EYE, SIX = np.eye(4), np.eye(6)
INDEFINITE, SKEWED = np.diag([1.0, 1, 1, 1, 1, -1]), np.eye(6) + 0.1 * np.eye(6, k=1)
EDGE = mcg.Edge(0, 1, EYE, SIX)


@pytest.mark.parametrize(
    "poses, edges, named, shown",
    [
        (2, [EDGE, mcg.Edge(0, 2, EYE, SIX)], "edges[1]: j", "got 2"),
        (2, [mcg.Edge(-1, 1, EYE, SIX)], "edges[0]: i", "got -1"),
        (2, EDGE, "edges", "()"),
        (2, [mcg.Edge(1, 1, EYE, SIX)], "edges[0]", "got 1"),
        (2, [mcg.Edge(0, 1, 2 * EYE, SIX)], "edges[0].T_i_j", "rigid"),
        (2, [EDGE, mcg.Edge(0, 1, EYE, INDEFINITE)], "edges[1]: information", "semidefinite"),
        (2, [mcg.Edge(0, 1, EYE, np.nan * SIX)], "edges[0]: information", "finite"),
        (2, [mcg.Edge(0, 1, EYE, SKEWED)], "edges[0]: information", "symmetric"),
        (2, [EDGE, EDGE[None]], "edges[1]", "single"),
        ([], [], "poses", ""),
        (None, [], "poses", "edge"),
        (jnp.eye(4), [], "poses", "(4, 4)"),
        (jnp.stack([2 * EYE, EYE]), [EDGE], "poses[0]", "rigid"),
    ],
)
def test_a_graph_that_is_wrong_is_refused(poses, edges, named, shown):
    refused(lambda: mcg.PoseGraph([EYE] * poses if isinstance(poses, int) else poses, edges), named, shown)


@pytest.mark.parametrize(
    "change, named, shown",
    [
        ({"T_i_j": np.array("a")}, "T_i_j", "numbers"),
        ({"information": np.array("a")}, "information", "numbers"),
        ({"information": np.eye(3)}, "information", "(3, 3)"),
        ({"information": None}, "information", "either"),
        ({"covariance": SIX}, "information", "either"),
        *(
            ({"information": None, "covariance": value}, "covariance", shown)
            for value, shown in (
                (np.array("a"), "numbers"),
                (np.eye(3), "(3, 3)"),
                (INDEFINITE, "definite"),
                (np.nan * SIX, "finite"),
                (SKEWED, "symmetric"),
            )
        ),
        ({"i": 0.5}, "i", "row"),
    ],
)
def test_an_edge_that_is_wrong_is_refused(change, named, shown):
    refused(lambda: mcg.Edge(**{"i": 0, "j": 1, "T_i_j": EYE, "information": SIX} | change), named, shown)


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
    wrong = mcg.Edge(0, 1, transform, asymmetric)
    refused(lambda: mcg.PoseGraph([np.eye(4)] * 2, [wrong]), "edges[0]: information", "symmetric")


def test_overflow_and_too_few_iterations_are_statuses():
    graph, _ = measured(*SMALL["sphere"])
    assert mcg.optimize_poses(graph, robust=False, max_iterations=1).status == mcg.Status.MAX_ITERATIONS
    huge = mcg.Edge(graph.edges.i, graph.edges.j, graph.edges.T_i_j, 1e304 * graph.edges.information)
    assert mcg.optimize_poses(mcg.PoseGraph(graph.poses, huge)).status == mcg.Status.NON_FINITE


def test_chi_squared_tells_whether_the_information_is_right():
    graph, _ = measured(*SMALL["grid"])
    found = mcg.optimize_poses(graph)
    assert 0.7 < found.chi_squared < 1.4
    edges = graph.edges
    precise = mcg.Edge(edges.i, edges.j, edges.T_i_j, 100 * edges.information)
    assert mcg.optimize_poses(mcg.PoseGraph(graph.poses, precise), robust=False).chi_squared > 50
    assert np.isnan(mcg.optimize_poses(mcg.PoseGraph(graph.poses, edges[: len(graph.poses) - 1])).chi_squared)
    # Measurements in the world's frame count the same, be they edges or factors, and let the first pose move.
    prior = mcg.Edge(mcg.WORLD, 0, graph.poses[0] @ exponential(np.full(6, 0.1)), information=np.eye(6))
    two = [prior, mcg.Edge(mcg.WORLD, 1, graph.poses[1], information=np.eye(6))]
    joined = jax.tree.map(lambda *values: np.concatenate([values[0], np.stack(values[1:])]), edges, *two)
    expected = mcg.optimize_poses(mcg.PoseGraph(graph.poses, joined), robust=False)
    assert expected.num_redundant == 6 * (len(joined) - len(graph.poses)) and expected.factor_residuals == ()
    stacked = jax.tree.map(lambda *values: np.stack(values), *two)
    with_factor = mcg.optimize_poses(mcg.PoseGraph(graph.poses, edges, [stacked]), robust=False)
    np.testing.assert_allclose(with_factor.chi_squared, expected.chi_squared, rtol=1e-9)


def test_an_exact_graph_ends_at_the_truth():
    poses, loops = SMALL["sphere"]
    graph, _ = measured(poses, loops, deviations=(0.05, 0.02))
    i, j = graph.edges.i, graph.edges.j
    exact = mcg.Edge(i, j, np.linalg.inv(poses[i]) @ poses[j], graph.edges.information)
    found = mcg.optimize_poses(mcg.PoseGraph(graph.poses, exact))
    assert found.converged and found.cost < 1e-10
    np.testing.assert_allclose(found.poses, poses, atol=1e-7)


def test_double_edges_count_twice():
    graph, _ = measured(*grid(2))
    twice = mcg.PoseGraph(graph.poses, [graph.edges[k] for k in range(len(graph.edges))] * 2)
    found, expected = (mcg.optimize_poses(each, robust=False) for each in (twice, graph))
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-6)
    np.testing.assert_allclose(found.covariance, expected.covariance / 2, rtol=1e-4, atol=1e-12)
