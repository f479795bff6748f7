"""Odometry over sequences with exact truth, and the maps made of them."""

import gc
import itertools
import threading
import weakref

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mcgicp_jax as mcg
from mcgicp_jax import datasets, metrics
from tests.corridor import corridor
from tests.refusals import refused
from tests.scenes import motion, room_corner


@pytest.fixture(scope="module")
def room():
    frames = datasets.box_room(5, points_per_frame=2000, step=0.08)
    return list(frames), [frames.path(i) for i in range(5)]


def test_poses_follow_the_truth(room):
    frames, truth = room
    steps = list(mcg.odometry(frames, mcg.GICP(), max_distance=0.5, start=truth[0]))
    assert steps[0].registration is None and all(step.registration.converged for step in steps[1:])
    poses = [step.pose for step in steps]
    np.testing.assert_array_equal(poses[0], truth[0])
    assert metrics.ate(poses, truth, alignment="first") < 0.03
    assert np.max(metrics.rpe(poses, truth)[0]) < 0.015
    assert all(pose.dtype == np.float64 for pose in poses)
    assert [len(step.cloud) for step in steps] == [len(frame.cloud) for frame in frames]


def test_clouds_do_as_well_as_frames_and_preprocessed_ones_are_kept(room):
    frames, _ = room
    clouds = [mcg.preprocess(frame.cloud) for frame in frames[:2]]
    steps = list(mcg.odometry(clouds, mcg.GICP(), max_distance=0.5))
    assert steps[0].cloud is clouds[0] and steps[1].cloud is clouds[1]
    np.testing.assert_array_equal(steps[0].pose, np.eye(4))
    again = list(mcg.odometry((frame.cloud for frame in frames[:2]), mcg.GICP(), max_distance=0.5))
    np.testing.assert_array_equal(again[1].pose, steps[1].pose)
    np.testing.assert_allclose(steps[1].pose, steps[1].registration.matrix, atol=1e-7)
    assert repr(steps[0]) == f"OdometryStep(position (0.000, 0.000, 0.000) m, {clouds[0]!r})"


def test_frames_are_read_one_ahead_and_no_further(room):
    taken, fourth = [], threading.Event()

    def stream():
        for i in itertools.count():
            taken.append(i)
            if i == 3:
                fourth.set()
            yield room[0][i % 2]

    endless = mcg.odometry(stream(), mcg.GICP(), max_distance=0.5)
    assert taken == []
    for count in range(1, 4):
        next(endless)
        assert count <= len(taken) <= count + 1
    # Nothing asks for it.
    assert fourth.wait(60)
    assert taken == [0, 1, 2, 3]


@pytest.mark.parametrize("against, radius", [("previous", None), ("map", None), ("map", 1.0)])
def test_a_target_has_one_tree_and_a_map_slides(room, against, radius):
    trees, asked = [], []

    class Counting(mcg.KDTreeSearch):
        def build(self, points):
            trees.append(len(points))
            return super().build(points)

        def query(self, tree, queries, k, bound):
            asked.append(len(queries))
            return super().query(tree, queries, k, bound)

    options = {"against": against, "map_radius": radius, "max_source_points": 300, "search": Counting(workers=1)}
    _, *steps = mcg.odometry(room[0], mcg.GICP(), max_distance=0.5, voxel_size=None, **options)
    assert len(trees) == len(steps)
    if against == "previous":
        assert trees == [len(frame.cloud) for frame in room[0][:-1]]
    else:
        assert np.all(np.diff(trees) > 0) == (radius is None)
    assert sum(asked) <= 300 * sum(int(step.registration.num_iterations) + 1 for step in steps)


def test_rows_computed_when_they_are_used_change_nothing(room):
    """And each pair starts from the motion before."""
    frames, init = room[0][:3], motion((0.05, 0, 0, 0, 0, 0.05))
    options = {"method": mcg.MultiChannelGICP(), "max_distance": 0.5, "max_source_points": 300}
    steps = list(mcg.odometry(frames, init=init, voxel_size=0.05, **options))
    clouds = [mcg.preprocess(frame.cloud, 0.05) for frame in frames]
    for step, source, target in zip(steps[1:], clouds[1:], clouds, strict=False):
        result = mcg.register(source, target, init=init, **options)
        init = result.matrix
        np.testing.assert_array_equal(step.registration.matrix, init)
        np.testing.assert_array_equal(step.registration.covariance, result.covariance)
    for step, cloud in zip(steps, clouds, strict=True):
        assert not step.cloud.neighbors.flags.writeable
        np.testing.assert_array_equal(step.cloud.neighbors, cloud.neighbors)
        np.testing.assert_array_equal(step.cloud.points, cloud.points)


def test_registrations_that_are_kept_release_their_clouds(room):
    alive = []

    def stream():
        for frame in room[0]:
            cloud = mcg.preprocess(frame.cloud)
            alive.append(weakref.ref(cloud))
            yield cloud

    kept = [step.deferred_registration for step in mcg.odometry(stream(), mcg.GICP(), max_distance=0.5)]
    gc.collect()
    # Those of the last two steps may be read later.
    assert [cloud() is None for cloud in alive] == [True, True, False, False, False]
    assert all(registration.value.converged for registration in kept[1:])
    gc.collect()
    assert all(cloud() is None for cloud in alive)


@pytest.mark.parametrize("against", ["previous", "map"])
def test_a_frame_that_does_not_overlap_is_passed_by_at_constant_velocity(room, against):
    clouds = [frame.cloud for frame in room[0][:4]]
    clouds[2] = clouds[0].replace(points=clouds[0].points + 1000)
    _, first, lost, last = mcg.odometry(clouds, mcg.GICP(), max_distance=0.5, against=against)
    before = first.registration.matrix
    assert lost.registration.status == mcg.Status.TOO_FEW_CORRESPONDENCES
    np.testing.assert_allclose(lost.pose, before @ before, atol=1e-6)
    if against == "previous":
        assert last.registration.status == mcg.Status.TOO_FEW_CORRESPONDENCES
        np.testing.assert_allclose(last.pose, before @ before @ before, atol=1e-6)
    else:
        # A registration without matches ends at its start, whose rotation is rounded to float32, at 1,700 m.
        np.testing.assert_allclose(lost.registration.matrix, before @ before, atol=1e-4)
        assert last.registration.converged


def test_a_frame_that_hardly_overlaps_is_warned_of():
    target, near = (room_corner(size, seed=seed)[0] for size, seed in ((2000, 0), (60, 1)))
    frames = [target, np.concatenate([near, target[:1940] + 50])]
    with pytest.warns(UserWarning, match=r"frames\[1\]: only .* %"):
        last = list(mcg.odometry(frames, mcg.PointToPlane(), max_distance=0.3))[-1]
    assert 0 < last.registration.overlap < 0.1 and last.registration.status is mcg.Status.UNVERIFIED and not last.lost


def test_rotations_stay_rotations():
    cloud = mcg.preprocess(datasets.box_room(1, points_per_frame=1000)[0].cloud)
    steps = mcg.odometry([cloud] * 2, mcg.GICP(), max_distance=0.5)
    # What rounding makes of the product of many motions.
    steps.pose = next(steps).pose @ np.diag([1 + 1e-9, 1, 1, 1])
    last = next(steps)
    np.testing.assert_allclose(last.pose[:3, :3] @ last.pose[:3, :3].T, np.eye(3), rtol=0, atol=1e-14)


# Maps


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 4), st.floats(0.05, 3), st.booleans())
def test_a_map_is_the_mean_of_each_voxel(seed, count, voxel_size, partial):
    rng = np.random.default_rng(seed)
    clouds, poses, rows = [], [motion(rng.normal(size=6)) for _ in range(count)], []
    for pose in poses:
        values = rng.normal(size=(rng.integers(1, 60), 5))
        valid = rng.random((len(values), 2)) < 0.6 if partial else np.ones((len(values), 2), bool)
        mask = valid if partial else None
        clouds.append(mcg.PointCloud(values[:, :3], values[:, 3:], channel_valid=mask, channel_names=["a", "b"]))
        world = values[:, :3] @ pose[:3, :3].T + pose[:3, 3]
        rows.append(np.hstack([world, np.where(valid, values[:, 3:], np.nan)]))
    rows = np.concatenate(rows)
    voxels = np.floor(rows[:, :3] / voxel_size)
    made = mcg.merge_clouds(iter(clouds), iter(poses), voxel_size)
    assert len(made) == len(np.unique(voxels, axis=0)) and made.channel_names == ("a", "b")
    there = np.ones((len(made), 2), bool) if made.channel_valid is None else made.channel_valid
    for mean, present in zip(np.hstack([made.points, np.where(there, made.channels, np.nan)]), there, strict=True):
        members = rows[(voxels == np.floor(mean[:3] / voxel_size)).all(axis=1)]
        np.testing.assert_array_equal(present, np.isfinite(members[:, 3:]).any(axis=0))
        measured = np.append([True] * 3, present)
        np.testing.assert_allclose(mean[measured], np.nanmean(members[:, measured], axis=0), atol=1e-9)


def test_a_map_may_lie_at_utm_coordinates(room):
    clouds, utm = [frame.cloud for frame in room[0][:2]], motion((500_000, 5_400_000, 100, 0, 0, 0))
    near, far = (mcg.merge_clouds(clouds, [world @ pose for pose in room[1][:2]], 0.125) for world in (np.eye(4), utm))
    np.testing.assert_allclose(far.points - utm[:3, 3], near.points, atol=1e-8)


def test_what_makes_no_map_is_refused_by_name(room):
    clouds, truth = [frame.cloud for frame in room[0][:2]], room[1]
    bare, away = mcg.PointCloud(clouds[0].points), motion((1e6, 0, 0, 0, 0, 0))
    for named, shown, *arguments in (
        ("clouds", "none", [], [], 0.1),
        ("voxel_size", 0.0, clouds[:1], truth[:1], 0.0),
        ("poses", "more", clouds[:1], truth[:2], 0.1),
        ("poses", 1, clouds, truth[:1], 0.1),
        ("clouds[1]", "channels", [clouds[0], bare], truth[:2], 0.1),
        ("poses[0]", "rigid", clouds[:1], [2 * np.eye(4)], 0.1),
        ("clouds[1]", "10000011 voxels of 0.1 m", clouds, [truth[0], away], 0.1),
    ):
        refused(lambda arguments=arguments: mcg.merge_clouds(*arguments), named, shown)


@pytest.mark.slow
def test_a_map_drifts_less():
    # Of 2,000 points, a cell has hardly the six from which it is made.
    few, many = (datasets.box_room(10, points_per_frame=size, step=0.08) for size in (2000, 4000))
    truth = [few.path(i) for i in range(10)]
    options = {"max_distance": 0.5, "start": truth[0], "voxel_size": 0.05}
    steps = list(mcg.odometry(few, mcg.GICP(), against="map", **options))
    # The registration is that to the map, in the world's frame.
    np.testing.assert_allclose(steps[-1].registration.matrix, steps[-1].pose, atol=1e-6)
    cells = list(mcg.odometry(many, mcg.NDT(), against="map", voxel_sizes=(0.5,), **options | {"max_distance": 1.0}))
    assert all(step.registration.converged for step in steps[1:] + cells[1:])
    to_map, by_pairs, by_cells = (
        metrics.ate([step.pose for step in trajectory], truth, alignment="first")
        for trajectory in (steps, mcg.odometry(few, mcg.GICP(), **options), cells)
    )
    assert to_map < 0.8 * by_pairs and by_cells < 0.01


def test_the_frames_after_an_invalid_one_go_on(room):
    frames, truth = room
    broken = [*frames[:2], mcg.PointCloud(np.zeros((2, 3))), *frames[2:4]]
    steps = mcg.odometry(broken, mcg.GICP(), max_distance=0.5, start=truth[0], num_neighbors=12)
    first, second = next(steps), next(steps)
    assert first.cloud.neighbors.shape[1] == 12
    refused(lambda: next(steps), "frames[2]: cloud", "got 2")
    poses = [step.pose for step in (first, second, *steps)]
    assert len(poses) == 4 and metrics.ate(poses, truth[:4], alignment="first") < 0.03


@pytest.mark.slow
def test_a_sensor_that_moves_on_after_a_rest_is_not_lost():
    """Its overlap falls once."""
    frames = datasets.box_room(4, points_per_frame=1500, step=1.2)
    clouds = [frames[k].cloud for k in (0, 0, 1, 2, 3)]
    steps = list(mcg.odometry(clouds, mcg.GICP(), recover=True, max_distance=(2.0, 0.2)))
    overlaps = [float(step.registration.overlap) for step in steps[1:]]
    assert overlaps[0] == 1 and max(overlaps[1:]) < 0.8
    assert not any(step.lost for step in steps)


@pytest.mark.slow
def test_lost_frames_are_named_and_follow_each_other(room):
    """In another, larger room, poses follow an extrapolated one until the first is seen again."""
    frames, truth = room
    others = datasets.box_room(3, points_per_frame=2000, step=0.02, seed=5)
    away = [frame.cloud.replace(points=4 * frame.cloud.points) for frame in others]
    clouds = [frames[0].cloud, frames[1].cloud, *away, frames[2].cloud]
    steps = list(mcg.odometry(clouds, mcg.GICP(), start=truth[0], recover=True))
    assert [step.lost for step in steps] == [False, False, True, True, True, False]
    for before, after in itertools.pairwise(steps[2:5]):
        motion_between = np.linalg.inv(before.pose) @ after.pose
        np.testing.assert_allclose(motion_between, after.registration.matrix, atol=1e-6)
        assert after.registration.converged
    np.testing.assert_allclose(steps[-1].pose[:3, 3], truth[2][:3, 3], atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("against", ["previous", "map"])
def test_a_jump_to_a_street_that_was_never_seen_is_lost(against):
    """Two streets have ground and house fronts in common: registration converges, with half of the overlap or more."""
    seen = datasets.street(4, points_per_frame=12_000, seed=3)
    elsewhere = datasets.street(60, points_per_frame=12_000, seed=13)[50]
    clouds = [frame.cloud for frame in (*seen[:3], elsewhere, seen[3])]
    steps = list(mcg.odometry(clouds, mcg.GICP(), recover=True, against=against, start=seen[0].pose))
    assert steps[3].registration.status != mcg.Status.TOO_FEW_CORRESPONDENCES
    assert steps[3].registration.overlap > 0.6
    assert [step.lost for step in steps] == [False, False, False, True, False]
    assert metrics.pose_error(steps[-1].pose, seen[3].pose)[0] < 0.1


def test_exact_planes_are_not_lost():
    """Their neighbourhoods have no thickness, so that distances in these units are rounding."""
    frames = datasets.box_room(3, points_per_frame=3000, noise=0.0)
    clouds = [frames[k].cloud for k in (0, 0, 1, 2)]
    assert not any(step.lost for step in mcg.odometry(clouds, mcg.GICP(), recover=True))


@pytest.mark.slow
@pytest.mark.parametrize("against", ["previous", "map"])
def test_no_real_frame_is_lost(data, against):
    kitti = [frame.cloud for frame in datasets.kitti(data / "kitti/sequences/04")]
    rooms = [frame.cloud for frame in datasets.seven_scenes(data / "sevenscenes_redkitchen")]
    # Also every third frame, and a car that moves on after a rest.
    for clouds in (kitti, kitti[::3], [kitti[0], *kitti[:3]], rooms):
        assert not any(step.lost for step in mcg.odometry(clouds, mcg.GICP(), recover=True, against=against))


@pytest.mark.parametrize("radius, against", [(3.0, "previous"), (-1.0, "map"), (0.01, "map")])
def test_a_radius_without_a_map_or_points_is_refused(room, radius, against):
    refused(lambda: list(mcg.odometry(room[0], mcg.GICP(), against=against, map_radius=radius)), "map_radius", radius)


@pytest.mark.slow
@pytest.mark.parametrize("against", ["previous", "map"])
def test_priors_hold_what_a_corridor_does_not(against):
    """Wheels measure the way along a bare corridor to 1 cm and know no rotation."""
    frames = list(corridor(3, points_per_frame=2000, textured=False))
    clouds, covariance = [frame.cloud for frame in frames], np.diag(np.r_[[1e-4] * 3, [1.0] * 3])
    moves = [(np.linalg.inv(a.pose) @ b.pose)[:3, 3] for a, b in itertools.pairwise(frames)]
    priors = [None, *((motion((*move, 0, 0, 0)), covariance) for move in moves)]
    options = {"against": against, "max_distance": 0.5, "start": frames[0].pose}
    steps = list(mcg.odometry(clouds, mcg.GICP(), priors=priors, **options))
    assert all(step.registration.status == mcg.Status.CONVERGED for step in steps[1:])
    np.testing.assert_allclose([step.pose for step in steps], [frame.pose for frame in frames], atol=0.03)
    # None is no prior.
    (_, alone) = mcg.odometry(clouds[:2], mcg.GICP(), priors=[None, None], **options)
    assert alone.registration.status == mcg.Status.DEGENERATE


def test_priors_that_do_not_fit_are_refused(room):
    for named, wrong in (("priors[1]", [None]), ("priors[1]: pose", [None, (2 * np.eye(4), np.eye(6))])):
        steps = mcg.odometry(room[0][:2], mcg.GICP(), priors=wrong)
        next(steps)
        refused(lambda steps=steps: next(steps), named)
    refused(lambda: next(mcg.odometry(room[0], mcg.GICP(), priors=[3])), "priors[0]")
    refused(lambda: mcg.odometry(room[0], mcg.GICP(), priors=[], hold_unconstrained=False), "hold_unconstrained")
