"""Edges from registrations, loops of a sensor, and many clouds registered with each other."""

from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest
from scipy.stats import chi2

import mcgicp_jax as mcg
from mcgicp_jax import datasets, io, metrics
from mcgicp_jax._registration.options import Options
from mcgicp_jax._sequences import loop_closure
from tests.corridor import corridor
from tests.graphs import joined
from tests.reference import logarithm
from tests.refusals import refused
from tests.scenes import motion, pair, wall


@pytest.fixture(scope="module")
def room():
    """Once round and a little further."""
    frames = datasets.box_room(14, points_per_frame=1500, step=2 * np.pi * 1.6 / 12)
    return list(frames), np.array([frames.path(k) for k in range(14)])


def edges_between(target, source, method, **options):
    """The result of registering two clouds, and the edges that follow from it: one or none."""
    result = mcg.multiway([target, source], method, [(0, 1)], init=[np.eye(4)] * 2, **{"max_distance": 0.3} | options)
    return result.registrations[0, 1], result.graph.edges


def test_an_edge_is_what_a_registration_measured(room):
    clouds = [frame.cloud for frame in room[0][:2]]
    result, edges = edges_between(*clouds, mcg.GICP(), max_distance=1.0)
    assert (edges.i, edges.j) == (0, 1)
    np.testing.assert_array_equal(edges.T_i_j[0], result.matrix)
    np.testing.assert_allclose(edges.information[0] @ result.covariance, np.eye(6), atol=1e-6)
    # What failed makes no edge.
    for options in ({"max_distance": 1.0, "max_iterations": 1}, {"max_distance": 1e-6}):
        assert len(edges_between(*clouds, mcg.GICP(), **options)[1]) == 0


def test_an_edge_knows_next_to_nothing_of_free_directions():
    source, target, _ = pair(wall, 2000, motion((0.01, 0.01, 0.0, 0, 0, 0.01)))
    result, edges = edges_between(target, source, mcg.GICP())
    assert result.status == mcg.Status.DEGENERATE
    constrained, twists = (np.asarray(array) for array in (result.directions.constrained, result.directions.twists))
    along = np.einsum("ki,ij,kj->k", twists, edges.information[0], twists)
    assert np.max(along[~constrained]) < 1e-2 * np.min(along[constrained])
    channels, channel_edges = edges_between(target, source, mcg.MultiChannelGICP())
    assert channels.converged
    # The variances scatter by up to 75 % with the cells in which scores are added.
    assert np.linalg.eigvalsh(channel_edges.information[0])[0] > 30 * np.linalg.eigvalsh(edges.information[0])[0]


def test_odometry_closes_loops(room):
    frames, truth = room
    options = {"method": mcg.GICP(), "max_distance": 1.0, "start": truth[0]}
    plain = np.array([step.pose for step in mcg.odometry(frames, **options)])
    steps = list(mcg.odometry(frames, loops=True, **options))
    graph, poses = steps[-1].graph, [step.pose for step in steps]
    assert steps[0].graph is not None and len(graph.poses) == len(frames)
    i, j = (rows[graph.edges.uncertain] for rows in (graph.edges.i, graph.edges.j))
    assert len(i) >= 3 and np.all(j - i > 1) and len(np.unique(j)) == len(j)
    np.testing.assert_allclose(poses[-1], graph.poses[-1], atol=0.02)
    errors = [metrics.ate(trajectory, truth, alignment="first") for trajectory in (graph.poses, plain)]
    assert errors[0] < 0.75 * errors[1]
    # Of the last frames, also the poses that were known at their time.
    last, before = (np.linalg.norm((trajectory - truth)[-4:, :3, 3]) for trajectory in (np.array(poses), plain))
    assert last < 0.6 * before
    # A view would keep the array of all poses in memory.
    assert all(pose.base is None for pose in poses)
    refused(lambda: next(mcg.odometry(frames, mcg.GICP(), loops=True, against="map")), "loops")


@pytest.mark.slow
def test_loops_close_with_cells(room):
    """The default distances are those of the cells."""
    frames, truth = room
    steps = list(mcg.odometry(frames, mcg.NDT(), voxel_sizes=(0.8,), start=truth[0], loops=True))
    assert steps[-1].graph.edges.uncertain.sum() >= 3


def test_a_frame_that_is_lost_is_joined_by_edges_without_information(room):
    first, second, third = (frame.cloud for frame in room[0][:3])
    lost = first.replace(points=first.points + 1000)
    *_, last = mcg.odometry([first, second, lost, third], mcg.GICP(), max_distance=1.0, loops=True)
    poses, edges = last.graph.poses, last.graph.edges[~last.graph.edges.uncertain]
    assert np.isfinite(poses).all() and len(poses) == 4
    np.testing.assert_array_equal(np.any(edges.information, axis=(1, 2)), [True, False, False])


def test_many_clouds_get_one_map(room):
    frames, truth = room
    result = mcg.multiway([frame.cloud for frame in frames], mcg.GICP(), max_distance=1.0)
    assert result.converged and result.graph.kept.mean() > 0.9 and result.graph.edges.uncertain.any()
    assert {(k, k + 1) for k in range(len(frames) - 1)} <= result.registrations.keys()
    plain = [step.pose for step in mcg.odometry(result.clouds, mcg.GICP(), max_distance=1.0)]
    assert metrics.ate(result.poses, truth) < metrics.ate(plain, truth)
    np.testing.assert_allclose(result.poses[0], np.eye(4), atol=1e-12)
    assert 0 < len(result.map) < sum(len(cloud) for cloud in result.clouds)


def test_pairs_are_those_of_largest_overlap_at_ever_larger_gaps():
    square = np.random.default_rng(0).random((1500, 3)) * [1, 1, 0]
    clouds = [square] * 7 + [square[(square < 0.3).all(axis=1)]]
    poses = np.tile(np.eye(4), (8, 1, 1))
    # Where the squares begin. The overlap of the third with the first, 0.3, is too small. The last square is a small
    # one within the others.
    poses[:, 0, 3] = [0, 0.4, 0.7, 0, 0.4, 5, 0.3, 0.5]
    # Matches so near leave the poses as they are.
    result = mcg.multiway(clouds, mcg.PointToPoint(), init=poses, voxel_size=None, max_distance=1e-7)
    consecutive = [(k, k + 1) for k in range(7)]
    assert result.registrations.keys() == {*consecutive, (0, 3), (1, 4), (0, 4), (4, 6), (1, 6), (4, 7), (0, 7)}


def test_pairs_starts_and_an_executor_can_be_given(room):
    frames, truth = room
    clouds = [frame.cloud for frame in frames[:3]]
    with ThreadPoolExecutor(1) as threads:
        options = {"init": truth[:3], "max_distance": 1.0, "executor": threads}
        result = mcg.multiway(clouds, mcg.GICP(), [(0, 1), (0, 2)], **options)
    assert threads._threads and result.converged and set(result.registrations) == {(0, 1), (0, 2)}
    np.testing.assert_allclose(result.poses[2], truth[0] @ result.registrations[0, 2].matrix, atol=1e-6)
    alone = mcg.multiway(clouds, mcg.GICP(), [(0, 1)], init=truth[:3], max_distance=1.0)
    assert alone.graph.status == mcg.Status.DEGENERATE
    np.testing.assert_allclose(alone.poses[2], truth[2], atol=1e-12)


def test_clouds_are_preprocessed_once_and_mapped_in_voxels():
    points = np.random.default_rng(0).uniform(-1, 1, (300, 3))
    start = motion((5, 0, 0, 0, 0, 1.0))
    result = mcg.multiway([points], mcg.GICP(), init=[start], voxel_size=0.2, num_neighbors=7)
    assert result.converged and result.registrations == {} and result.clouds[0].neighbors.shape[1] == 7
    expected = mcg.merge_clouds(result.clouds, [start], 0.2)
    np.testing.assert_allclose(result.map.coordinates, expected.coordinates, atol=1e-9)
    again = mcg.multiway(result.clouds, mcg.GICP(), init=[start], voxel_size=1.0)
    assert again.clouds[0] is result.clouds[0] and len(again.map) < 0.3 * len(result.map)


def test_what_is_wrong_is_named(room):
    cloud = room[0][0].cloud
    for named, shown, clouds, options in (
        ("clouds", "none", [], {}),
        ("clouds[1]: cloud", "got 2", [cloud, np.zeros((2, 3))], {}),
        *(("pairs[1]", "0 to 1", [cloud] * 2, {"pairs": [(0, 1), wrong]}) for wrong in ((0, 2), (-1, 0), (1, 1))),
        ("init", "got 1", [cloud] * 2, {"init": [np.eye(4)]}),
        ("init", "'global'", [cloud] * 2, {"init": "global"}),
        ("init[1]", "rigid", [cloud] * 2, {"init": [np.eye(4), 2 * np.eye(4)]}),
    ):
        refused(lambda clouds=clouds, options=options: mcg.multiway(clouds, mcg.GICP(), **options), named, shown)


def test_the_command(room, tmp_path, command):
    folder, options = tmp_path / "clouds", ["--method", "gicp", "--max-distance", "1.0"]
    folder.mkdir()
    for k in range(3):
        io.write(folder / f"{k}.ply", room[0][k].cloud)
    poses, map, graph, plot = (tmp_path / name for name in ("poses.txt", "map.ply", "graph.g2o", "graph.png"))
    outputs = ["--output", poses, "--map", map, "--graph", graph, "--plot", plot]
    code, text, errors = command("multiway", folder, *options, *outputs)
    assert code == 0 and errors == "" and "clouds:    3" in text and "poses:     CONVERGED" in text
    assert all(str(path) in text and path.exists() for path in (poses, map, graph, plot))
    assert len(io.read_poses(poses)) == len(io.read_g2o(graph).poses) == 3 and len(io.read(map)) > 1000
    code, _, errors = command("multiway", folder, "--glob", "*.las")
    assert code == 2 and "expected clouds *.las, found none" in errors
    code, text, errors = command("multiway", folder, *options, "--glob", "[01].ply", "--max-iterations", "1")
    assert code == 1 and "chi²:      unknown" in text and "some of them unknown" in text
    assert "0.ply: no registration holds its pose (MAX_ITERATIONS)" in errors


@pytest.mark.parametrize(
    ("seed", "alien", "step"),
    [
        # The wrong first motion led all others astray: they agreed with each other.
        pytest.param(108, 0, 0.4, marks=pytest.mark.slow),
        # It fits at 0.87 of the usual overlap per distance; later clouds agreed with it in a wrong minimum.
        (128, 4, 0.4),
        # The registration across it ends at the right pose, but as MAX_ITERATIONS.
        pytest.param(102, 3, 0.4, marks=pytest.mark.slow),
        pytest.param(30, 0, 0.6, marks=pytest.mark.slow),
    ],
)
def test_a_cloud_of_another_place_does_not_spoil_the_motions_that_follow(seed, alien, step):
    frames, other = (datasets.box_room(7, seed=place, points_per_frame=900, step=step) for place in (seed, seed + 1000))
    clouds = [np.asarray((other if k == alien else frames)[k].cloud.points, np.float32) for k in range(7)]
    result = mcg.multiway(clouds, mcg.GICP(), max_distance=1.0)
    others = [k for k in range(7) if k != alien]
    assert all(result.statuses[k] == mcg.Status.CONVERGED for k in others)
    truth, poses = np.array([frames.path(k) for k in others]), result.poses[others]
    np.testing.assert_allclose(np.linalg.inv(poses[0]) @ poses, np.linalg.inv(truth[0]) @ truth, atol=0.05)


def test_a_cloud_whose_registrations_contradict_each_other_is_named():
    """One half of it is moved against the other one, and each half lies in two of the others."""
    left, middle, right = np.random.default_rng(0).random((3, 500, 3)) + np.arange(3)[:, None, None] * [2, 0, 0]
    near, far = np.concatenate([left, middle]), np.concatenate([middle, right])
    bent = np.concatenate([left, right + np.array([0, 0.03, 0])])
    pairs = [(i, j) for j in range(5) for i in range(j)]
    options = {"init": [np.eye(4)] * 5, "voxel_size": None, "max_distance": 0.04}
    for wanted, status in ((pairs, "DEGENERATE"), ([p for p in pairs if 2 not in p], "TOO_FEW_CORRESPONDENCES")):
        result = mcg.multiway([near, near, bent, far, far], mcg.PointToPoint(), wanted, **options)
        assert [reached.name for reached in result.statuses] == ["CONVERGED"] * 2 + [status] + ["CONVERGED"] * 2


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_an_edge_of_equal_clouds_is_as_precise_as_their_rounding(seed):
    """On a plane, rounding makes small variances negative; along it, edges have no information."""
    cloud = mcg.preprocess(datasets.poster_wall(1, points_per_frame=1000, seed=seed)[0].cloud)
    result, edges = edges_between(cloud, cloud, mcg.GICP(), max_distance=0.1)
    (information,) = edges.information
    values = np.linalg.eigvalsh(information)
    assert values.min() > -1e-12 * values.max() and np.isfinite(result.deviations).all()
    deviation = 1 / np.sqrt(np.linalg.eigvalsh(information[:3, :3]).max())
    assert deviation > 0.1 * np.finfo(np.float32).eps * np.abs(cloud.points).max()


def test_far_points_cost_no_registrations():
    """Twenty-one, as many as a surface."""
    clouds = [frame.cloud for frame in datasets.box_room(3, points_per_frame=800)]
    points = np.array(clouds[1].points)
    points[:21] = 1e8 * (1 + 0.01 * np.random.default_rng(0).random((21, 3)))
    clouds[1] = clouds[1].replace(points=points)
    result = mcg.multiway(clouds, mcg.GICP(), max_distance=1.0)
    assert np.isfinite(result.poses).all() and len(result.registrations) >= 2
    refused(lambda: result.map, "clouds[1]", "voxels")


def test_outputs_in_the_folder_are_no_inputs(room, tmp_path, command):
    frames = room[0][:2]
    for k, frame in enumerate(frames):
        io.write(tmp_path / f"{k}.ply", frame.cloud)
    io.write_poses(tmp_path / "init.txt", [np.linalg.inv(frames[0].pose) @ frame.pose for frame in frames])
    options = ["--init", tmp_path / "init.txt", "--method", "gicp", "--max-distance", "1.0"]
    options += ["--output", tmp_path / "poses.txt"]
    for _ in range(2):
        assert command("multiway", tmp_path, *options)[0] == 0
        assert len(io.read_poses(tmp_path / "poses.txt")) == 2
    # Without its option in a later run, a map would be a cloud among the others.
    options += ["--map", tmp_path / "map.ply"]
    code, _, errors = command("multiway", tmp_path, *options)
    assert code == 2 and "map.ply: expected a map outside of" in errors
    assert command("multiway", tmp_path, *options, "--glob", "?.ply")[0] == 0


@pytest.fixture(scope="module")
def bare_corridor():
    """Five frames of a corridor along which nothing constrains a pose, and what `multiway` makes of them."""
    frames = corridor(5, textured=False, step=0.3, points_per_frame=2500)
    clouds = [frame.cloud for frame in frames]
    return clouds, np.linalg.inv(frames[0].pose) @ [frame.pose for frame in frames], mcg.multiway(clouds, mcg.GICP())


@pytest.mark.parametrize("kind", ["multiway", "loops"])
def test_poses_that_hang_on_free_directions_are_degenerate(bare_corridor, kind):
    clouds, truth, result = bare_corridor
    if kind == "multiway":
        assert all(registration.status == mcg.Status.DEGENERATE for registration in result.registrations.values())
        assert [status.name for status in result.statuses] == ["CONVERGED"] + 4 * [
            "DEGENERATE"
        ] and not result.converged
        graph = result.graph
    else:
        *_, last = mcg.odometry(clouds, mcg.GICP(), loops=True)
        graph = mcg.optimize_poses(last.graph)
    assert graph.status == mcg.Status.DEGENERATE
    error = logarithm(np.linalg.inv(graph.poses) @ truth)
    assert np.abs(error[-1, 0]) > 1
    # In units of their deviations. The others are known to centimetres: the direction of the corridor is to 2 mrad.
    assert np.all(np.einsum("ki,kij,kj->k", error[1:], np.linalg.inv(graph.covariance[1:]), error[1:]) < 20)
    values = np.linalg.eigvalsh(graph.covariance[1:, :3, :3])
    assert np.all(values[:, 2] > 1) and np.all(values[:, :2] < 0.03**2)
    # Those along the corridor leave the poses where they started.
    assert np.abs(graph.poses[:, 0, 3]).max() < 0.05
    inside = jax.jit(mcg.optimize_poses)(mcg.PoseGraph(graph.poses, graph.edges))
    assert inside.status == mcg.Status.DEGENERATE
    np.testing.assert_allclose(inside.covariance[1:, 0, 0], graph.covariance[1:, 0, 0], rtol=0.2)


def test_free_directions_that_other_edges_measure_are_known(bare_corridor):
    _, truth, result = bare_corridor
    priors = mcg.Edge(np.zeros(4, int), np.arange(1, 5), truth[1:], np.tile(1e6 * np.eye(6), (4, 1, 1)))
    measured = mcg.optimize_poses(mcg.PoseGraph(result.poses, joined(result.graph.edges, priors)))
    assert measured.converged
    np.testing.assert_allclose(measured.poses, truth, atol=0.01)
    assert np.sqrt(np.linalg.eigvalsh(measured.covariance)[:, -1]).max() < 0.002


def test_the_command_says_that_poses_hang_on_free_directions(bare_corridor, tmp_path, command):
    for k, cloud in enumerate(bare_corridor[0][:3]):
        io.write(tmp_path / f"{k}.ply", cloud)
    code, text, errors = command("multiway", tmp_path, "--method", "gicp")
    assert code == 1 and "poses:     DEGENERATE" in text and "no pair constrains some directions" in errors
    assert "1.ply: DEGENERATE" in errors and "2.ply: DEGENERATE" in errors and "0.ply" not in errors


def test_a_loop_moves_the_last_pose_as_an_optimisation_of_all_would(monkeypatch):
    """Once round a circle, with edges that know some directions best. The first loop, which is optimised, is vague."""
    rng, sigma = np.random.default_rng(0), np.array([0.02, 0.002, 0.005, 0.002, 0.001, 0.004])
    step, mixed = motion((0.6, 0, 0.05, 0, 0, 2 * np.pi / 21)), np.eye(6) + 0.3 * rng.normal(size=(6, 6))
    loops = {20: (step, 1e-4 * np.eye(6)), 21: (motion((0.2, 0.1, 1.05, 0.01, 0, 0.02)), 400 * mixed @ mixed.T)}
    clouds = [mcg.preprocess(2 * rng.normal(size=(50, 3))) for _ in range(22)]
    poses, tries = [], []

    def register_pair(source, target, method, init, options):
        tries.append(([cloud is target for cloud in clouds].index(True), len(poses), options.min_coarse_distance))
        return loops.get(len(poses))

    registered = mcg.RegistrationResult.without_pose(mcg.Status.CONVERGED)

    def edge_from(i, j, result, uncertain=False):
        measured = (step, np.diag(sigma**-2)) if result is registered else result
        return None if measured is None else mcg.Edge(i, j, *measured, uncertain=uncertain)

    monkeypatch.setattr(loop_closure, "register_pair", register_pair)
    monkeypatch.setattr(loop_closure, "edge_from", edge_from)
    trajectory = loop_closure.Trajectory(mcg.GICP(), Options())
    for k, cloud in enumerate(clouds):
        pose = poses[-1] @ step if poses else np.eye(4)
        poses.append(trajectory.add(cloud, pose, registered if k else None))
    assert np.linalg.norm(poses[-1][:3, 3] - pose[:3, 3]) > 0.1
    np.testing.assert_allclose(poses[-1], trajectory.graph().poses[-1], atol=1e-3)
    # 99 % of χ² with three degrees of freedom, in the direction of the largest deviation.
    assert {number for _, number, _ in tries} >= {10, 19, 21}
    for i, number, distance in tries:
        rows = np.arange(number - i)
        path = mcg.Edge(rows, rows + 1, *(np.tile(matrix, (len(rows), 1, 1)) for matrix in (step, np.diag(sigma**-2))))
        variance = np.linalg.eigvalsh(mcg.optimize_poses(mcg.PoseGraph(None, path)).covariance[-1, :3, :3])[-1]
        np.testing.assert_allclose(distance, np.sqrt(chi2.ppf(0.99, 3) * variance), rtol=0.01)
