"""Files of pose graphs."""

import numpy as np
import pytest

import mcgicp_jax as mcg
from tests.graphs import SMALL, Distance, correlated, grid, measured, with_priors
from tests.refusals import refused

GRID = SMALL["grid"]


@pytest.mark.parametrize(
    ("graph", "num_priors"),
    [(correlated(measured(*GRID, false=0.2)[0]), 0), (with_priors(measured(*GRID)[0], GRID[0]), 14)],
)
def test_graphs_come_back_from_their_files(tmp_path, graph, num_priors):
    mcg.io.write_g2o(tmp_path / "a.g2o", graph)
    again = mcg.io.read_g2o(tmp_path / "a.g2o")
    np.testing.assert_allclose(again.poses, graph.poses, atol=1e-12)
    for name in ("i", "j", "T_i_j"):
        np.testing.assert_allclose(getattr(again.edges, name), getattr(graph.edges, name), atol=1e-12)
    np.testing.assert_allclose(again.edges.information, graph.edges.information, rtol=1e-12)
    prior = again.edges.i == mcg.WORLD
    assert prior.sum() == num_priors
    np.testing.assert_array_equal(again.edges.uncertain, ~prior & (np.abs(graph.edges.i - graph.edges.j) != 1))


def test_files_of_results_hold_the_edges_that_are_kept(tmp_path):
    found = mcg.optimize_poses(measured(*GRID, false=0.2)[0])
    mcg.io.write_g2o(tmp_path / "a.g2o", found)
    assert len(mcg.io.read_g2o(tmp_path / "a.g2o").edges) == found.kept.sum()


IDENTITY = "VERTEX_SE3:QUAT 0 1 0 0 0 0 0 1\n"
NUMBERS = "0 0 0 0 0 0 0 1" + 21 * " 1"


@pytest.mark.parametrize(
    "text, shown",
    [
        ("", "none"),
        ("EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1" + 21 * " 1", "EDGE_SE3:QUAT"),
        ("\nVERTEX_SE3:QUAT 0 1 0 0 0 0 0", "line 2: expected 8"),
        (IDENTITY + "VERTEX_SE3:QUAT 1 1 0 0 0 0 x 1", "line 2"),
        (f"{IDENTITY}EDGE_SE3:QUAT 0 2 {NUMBERS[2:]}", "line 2"),
        ("VERTEX_SE3:QUAT 0 1 0 0 0 0 0 0", "line 1"),
        ("VERTEX_SE2 0 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", "EDGE_SE2, VERTEX_SE2"),
        (f"{IDENTITY}PARAMS_SE3OFFSET 0 1 0 0 0 0 0 1\nEDGE_SE3_PRIOR 0 {NUMBERS}", "PARAMS_SE3OFFSET"),
        (f"VERTEX_SE3:QUAT {97 << 56} 0 0 0 0 0 0 1", f"{97 << 56}"),
    ],
)
def test_files_that_are_no_graphs_are_refused(text, shown, tmp_path):
    (tmp_path / "a.g2o").write_text(text)
    refused(lambda: mcg.io.read_g2o(tmp_path / "a.g2o"), str(tmp_path / "a.g2o"), shown)


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


def test_only_graphs_of_edges_are_written(tmp_path):
    graph, _ = measured(*grid(2))
    distance = Distance(np.array([[0, 1]]), np.ones((1, 1, 1)), np.zeros(1, bool), np.ones(1))
    for wrong, shown in ((mcg.PoseGraph(graph.poses, graph.edges, [distance]), "1 further"), (None, "NoneType")):
        refused(lambda wrong=wrong: mcg.io.write_g2o(tmp_path / "graph.g2o", wrong), "graph", shown)
