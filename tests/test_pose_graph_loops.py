"""Outliers among the loops of pose graphs, and directions that no edge measures."""

import functools

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import mcgicp_jax as mcg
from mcgicp_jax import metrics
from tests.graphs import SMALL, grid, joined, measured, moved
from tests.reference import logarithm
from tests.scenes import motion


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


@pytest.mark.parametrize(("right", "others", "trusted"), [(4, 3, False), (6, 3, True), (1, 0, True)])
def test_loops_that_alone_connect_two_parts_are_trusted_if_enough_agree(right, others, trusted):
    """Wrong loops between places that look alike agree with each other, too."""
    rng = np.random.default_rng(0)
    truth, _ = grid(2)
    chain = [(k, k + 1) for k in range(len(truth) - 1)]
    loops = [(k % 4, 4 + k // 2 % 4) for k in range(right + others)]
    i, j = np.array(chain + loops).T
    motions = moved(np.linalg.inv(truth[i]) @ truth[j], 1e-3 * rng.normal(size=(len(i), 6)))
    motions[len(motions) - others :] @= motion((5, 3, 0, 0, 0, 1))
    motions[len(motions) - others :, :3, 3] += rng.normal(size=(others, 3))
    information = np.tile(1e6 * np.eye(6), (len(i), 1, 1))
    # The motion from pose 3 to pose 4 is assumed, as after a lost frame.
    information[3] = 0
    edges = mcg.Edge(i, j, motions, information, uncertain=np.arange(len(i)) >= len(chain))
    found = mcg.optimize_poses(mcg.PoseGraph(truth, edges))
    assert found.status is (mcg.Status.CONVERGED if trusted else mcg.Status.DEGENERATE)
    assert found.kept[len(chain) :].sum() == right
    # With precise positions of all poses, the parts need no loops.
    everywhere = np.diag([1e6, 1e6, 1e6, 0, 0, 0])[None].repeat(len(truth), axis=0)
    priors = mcg.Edge(np.full(len(truth), mcg.WORLD), np.arange(len(truth)), truth, everywhere)
    assert mcg.optimize_poses(mcg.PoseGraph(truth, joined(edges, priors))).converged


def test_parts_that_other_loops_join_need_no_agreement_of_theirs():
    truth, _ = grid(2)
    chain, loops = [(0, 1), (2, 3), (4, 5), (6, 7)], [(k, k + 2) for k in range(6)] * 3 + [(0, 6)]
    i, j = np.array(chain + loops).T
    motions = np.linalg.inv(truth[i]) @ truth[j]
    motions[-1, :3, 3] += 1
    edges = mcg.Edge(i, j, motions, np.tile(1e6 * np.eye(6), (len(i), 1, 1)), uncertain=np.arange(len(i)) >= len(chain))
    found = mcg.optimize_poses(mcg.PoseGraph(truth, joined(edges, edges[len(edges) - 1 :], edges[4:5])))
    assert found.converged and (~found.kept).sum() == 2


def test_rejected_loops_leave_no_trace():
    graph, _ = measured(*grid(2), false=0.3)
    found = mcg.optimize_poses(graph)
    assert not found.kept.all()
    expected = mcg.optimize_poses(mcg.PoseGraph(found.poses, graph.edges[found.kept]), robust=False)
    np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-6)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-4)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-2, atol=1e-9)


@pytest.mark.parametrize("information", [1.0, 1e9])
def test_a_loop_is_rejected_only_beyond_its_own_uncertainty_and_that_of_the_others(information):
    """Loops of variance 1 contradict edges by d: d² has the variance 1, or with edges of variance 1, that of 2."""
    threshold = chi2.ppf(0.99, 6) * (1 + 1 / information)
    squares = threshold * np.array([0.6, 0.9, 0.99, 1.01, 1.2, 2, 3])
    number = len(squares)
    motions = np.tile(motion((0, 10, 0, 0, 0, 0)), (2 * number, 1, 1))
    poses = np.concatenate([np.eye(4)[None], motions[:number]])
    motions[number:, 0, 3] = np.sqrt(squares)
    uncertain = np.arange(2 * number) >= number
    known = np.where(uncertain, 1, information)[:, None, None] * np.eye(6)
    rows = np.tile(np.arange(1, number + 1), 2)
    found = mcg.optimize_poses(mcg.PoseGraph(poses, mcg.Edge(0 * rows, rows, motions, known, uncertain=uncertain)))
    np.testing.assert_array_equal(found.kept[number:], squares < threshold)
    # Each kept loop and its edge share d in proportion to their variances.
    np.testing.assert_allclose(found.cost, 0.5 * squares[squares < threshold].sum() / (1 + 1 / information), rtol=1e-6)


@functools.cache
def error_without_false_loops(name):
    poses, loops = SMALL[name]
    return metrics.ate(mcg.optimize_poses(measured(poses, loops)[0]).poses, poses, alignment="first")


@pytest.mark.parametrize("name", SMALL)
@pytest.mark.parametrize("fraction", [0.1, 0.5])
def test_false_loops_are_rejected(name, fraction):
    (poses, loops), best = SMALL[name], error_without_false_loops(name)
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


def test_outliers_are_the_same_inside_transformations():
    graph, _ = measured(*SMALL["grid"], false=0.3)
    expected, found = mcg.optimize_poses(graph), jax.jit(mcg.optimize_poses)(graph)
    assert found.converged and not expected.kept.all()
    np.testing.assert_array_equal(found.kept, expected.kept)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-4)


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
    i, j = graph.edges.i, graph.edges.j
    exact = mcg.Edge(i, j, np.linalg.inv(truth[i]) @ truth[j], graph.edges.information)
    _, jacobians = exact.linearize(np.stack([truth[i], truth[j]], axis=1))
    rows = np.zeros((len(i), 6, len(truth), 6))
    for end, each in enumerate((i, j)):
        rows[np.arange(len(i)), :, each] = jacobians[:, end]
    rows = rows[:, :, 1:].reshape(len(i), 6, -1)
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
