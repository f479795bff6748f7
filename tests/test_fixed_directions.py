"""Directions that a prior fixes by a variance of 0: planar, 4-DoF and yaw-only registration, their derivatives."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax.metrics import pose_error
from tests.corridor import bare_pair
from tests.differences import TO_ROUNDING, assert_alike, check_eager_gradient, weigh
from tests.precision import in_float64
from tests.reference import logarithm
from tests.scenes import motion, pair

OPTIONS = {"max_distance": 0.5}
# A standard deviation of a million metres or radians.
UNKNOWN = 1e12
NAMES = {"x": 0, "y": 1, "z": 2, "roll": 3, "pitch": 4, "yaw": 5}
CASES = {"planar": "z roll pitch", "4-dof": "roll pitch", "yaw": "x y z roll pitch", "without yaw": "yaw"}


def covariance_fixing(names, turn=None):
    """Of ξ whose components along the axes, turned, are fixed or unknown."""
    variances = np.full(6, UNKNOWN)
    variances[[NAMES[name] for name in names.split()]] = 0
    axes = np.kron(np.eye(2), np.eye(3) if turn is None else turn)
    return axes @ np.diag(variances) @ axes.T


def remaining(matrix, pose):
    return logarithm(np.linalg.inv(pose) @ np.asarray(matrix, float))


def planar(seed=1):
    """Clouds of a corner whose true motion is planar, and this motion."""
    return pair(truth=motion((0.05, -0.03, 0, 0, 0, 0.05)), seed=seed)


@pytest.mark.parametrize("name", CASES)
def test_fixed_directions_are_those_of_the_prior(name):
    source, target, truth = pair()
    names = CASES[name].split()
    fixed = np.isin(list(NAMES), names)
    # Where the prior and the start are wrong, what is fixed is that of the prior.
    prior = truth @ motion(np.array([0.02, -0.01, 0.015, 0.01, -0.015, 0.02]))
    start = truth @ motion((0.05, 0.05, -0.05, 0.03, 0.03, -0.05))
    given = prior, covariance_fixing(CASES[name])
    result = mcg.register(source, target, mcg.GICP(), init=start, prior=given, **OPTIONS)
    assert result.converged
    twist = remaining(result.matrix, prior)
    assert np.abs(twist[fixed]).max() < 1e-6
    assert np.abs(twist[~fixed]).max() > 1e-3
    assert np.isinf(result.directions.ties).sum() == len(names)
    values = np.linalg.eigvalsh(np.asarray(result.covariance))
    assert np.abs(values[: len(names)]).max() < 1e-10 and values[len(names)] > 1e-8
    if name != "without yaw":
        # The free directions form a group, whose motions these are at every pose.
        assert np.abs(np.asarray(result.covariance)[fixed]).max() < 1e-10


def lifted(scan, spacing, seed):
    """A planar scan with noise of 5 mm in 3-D, as the message for points (N, 2) says."""
    seen = scan + 0.005 * np.random.default_rng(seed).normal(size=scan.shape)
    return np.concatenate([np.c_[seen, np.full(len(seen), z)] for z in 5 * spacing * np.arange(5)])


LINE = np.linspace(0, 3, 250)
# Two walls.
SCAN = np.concatenate([np.stack([LINE, 0 * LINE], axis=1), np.stack([0 * LINE, LINE], axis=1)]) + 0.3


def test_a_planar_scan_lifted_to_3d_is_registered_without_a_warning(recwarn):
    truth = motion((0.05, -0.03, 0, 0, 0, 0.05))
    source = mcg.PointCloud(lifted(SCAN, 0.012, 0)).transform(np.linalg.inv(truth))
    prior = np.eye(4), covariance_fixing("z roll pitch")
    result = mcg.register(source, lifted(SCAN, 0.012, 1), mcg.GICP(), max_distance=(0.5, 0.1), prior=prior)
    assert result.converged and max(pose_error(result.matrix, truth)) < 5e-3
    # The heights of the copies are no rounding of coordinates.
    assert not recwarn


@pytest.mark.parametrize("voxel_size", ["auto", None])
def test_a_planar_scan_in_3d_is_warned_of(voxel_size, recwarn):
    """And not a flat picture."""
    mcg.preprocess(np.c_[np.random.default_rng(0).random((1000, 2)), np.zeros(1000)], voxel_size)
    assert not recwarn
    with pytest.warns(UserWarning, match="same z, and most lie on lines; lift a planar scan to 3-D"):
        mcg.preprocess(np.c_[SCAN, np.full(len(SCAN), 1.5)], voxel_size)


@pytest.mark.parametrize("seed", range(4))
def test_walls_of_a_planar_scan_hold_nothing_along_them(seed):
    """Points of copies one spacing apart are matched across copies, and errors are up to 15 deviations."""
    rng = np.random.default_rng(seed)
    truth = motion((0.2, 0.01, 0, 0, 0, 0.01))
    # Of a sensor in the middle, whose points are denser near it; each scan with its own rays.
    angles = [np.linspace(-np.pi, np.pi, 720, endpoint=False) + rng.uniform(0, 0.01) for _ in range(2)]
    scans = [np.stack([1 / np.tan(each), np.ones_like(each)], 1) * np.sign(np.sin(each))[:, None] for each in angles]
    target, source = (scan[np.abs(scan[:, 0]) < 6] for scan in scans)
    clouds = [lifted(scan, 0.011, seed + 10 * i) for i, scan in enumerate((target, source))]
    source = mcg.PointCloud(clouds[1] + [0.2, 0, 0]).transform(np.linalg.inv(truth))
    wheels = truth @ motion((*rng.normal(0, 0.02, 2), 0, 0, 0, 0))
    prior = wheels, np.diag([0.02**2, 0.02**2, 0, 0, 0, 0.01**2])
    result = mcg.register(source, clouds[0], mcg.GICP(), prior=prior)
    assert abs(remaining(result.matrix, truth)[0]) < 4 * np.sqrt(result.covariance[0, 0])


def test_fixed_axes_may_be_tilted():
    """Gravity is no axis of the source: what turns the axes of the covariance turns the answer."""
    source, target, truth = planar()
    turn = motion((0, 0, 0, 0.3, -0.2, 0.1))
    tilted = source.transform(np.linalg.inv(turn))
    upright = mcg.register(source, target, mcg.GICP(), prior=(np.eye(4), covariance_fixing("z roll pitch")), **OPTIONS)
    given = turn, covariance_fixing("z roll pitch", turn[:3, :3].T)
    result = mcg.register(tilted, target, mcg.GICP(), prior=given, **OPTIONS)
    assert result.converged and upright.converged
    np.testing.assert_allclose(result.matrix, upright.matrix @ turn, atol=2e-4)
    assert np.abs(remaining(upright.matrix, truth)).max() < 5e-3


def test_all_directions_may_be_fixed():
    source, target, truth = pair()
    result = mcg.register(source, target, mcg.GICP(), prior=(truth, np.zeros((6, 6))), **OPTIONS)
    assert result.converged and np.abs(remaining(result.matrix, truth)).max() < 1e-6
    assert not np.abs(result.covariance).max() > 1e-12


def test_directions_are_fixed_at_large_coordinates():
    """A plane z = 0 of a source at UTM coordinates."""
    source, target, truth = planar()
    far = motion((4e5, 5e6, 20, 0, 0, 0))
    clouds = [np.asarray(cloud.points, np.float64) + far[:3, 3] for cloud in (source, target)]
    there = far @ truth @ np.linalg.inv(far)
    prior = there, covariance_fixing("z roll pitch")
    result = mcg.register(*clouds, mcg.GICP(), init=there, prior=prior, **OPTIONS)
    twist = remaining(np.linalg.inv(far) @ result.matrix @ far, truth)
    assert result.converged and np.abs(twist[2:5]).max() < 1e-6 and np.abs(twist).max() < 5e-3


@pytest.mark.parametrize("traced", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_direction_is_fixed_at_the_origin_of_the_users_coordinates(traced):
    """Where a rotation at the cloud moves by metres, and not at the origin of the cloud."""
    source, target, truth = pair()
    far = motion((300, -400, 100, 0, 0, 0))
    clouds = [mcg.preprocess(np.asarray(cloud.points, np.float64) + far[:3, 3]) for cloud in (source, target)]
    assert np.any(clouds[0].origin)
    error = motion((0.02, -0.01, 0.015, 0.01, -0.015, 0.02))
    start, prior = (far @ truth @ each @ np.linalg.inv(far) for each in (np.eye(4), error))

    def register(source, target):
        given = prior, covariance_fixing("z")
        return mcg.register(source, target, mcg.GICP(), init=start, prior=given, **OPTIONS).matrix

    twist = remaining((jax.jit(register) if traced else register)(*clouds), prior)
    # float32 has steps of 3e-5 m there.
    assert abs(twist[2]) < 2e-3 and np.abs(twist[:2]).min() > 1


def test_fixed_directions_need_no_data():
    """A floor constrains neither x, y nor yaw, a corridor not the way along it; the status asks for the rest alone."""
    *clouds, truth, axis = bare_pair()
    given = np.zeros((6, 6))
    given[:3, :3] = UNKNOWN * (np.eye(3) - np.outer(axis, axis))
    given[3:, 3:] = UNKNOWN * np.eye(3)
    result = mcg.register(*clouds, mcg.GICP(), prior=(truth, given), **OPTIONS)
    assert result.converged and abs(remaining(result.matrix, truth)[:3] @ axis) < 1e-6
    (direction,) = result.unconstrained_directions
    assert direction.constrained_by_ties and abs(direction.axis @ axis) > 0.995
    # Fixed directions do not hold the others.
    result = mcg.register(*clouds, mcg.GICP(), prior=(truth, covariance_fixing("roll pitch")), **OPTIONS)
    assert result.status is mcg.Status.DEGENERATE


@in_float64
@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_gradients_with_fixed_directions(name, noisy):
    """By points, and by the prior's pose, which is wrong along the fixed directions."""
    source, target, truth = noisy
    pose, given = truth @ motion(0.02 * np.ones(6)), covariance_fixing(CASES[name])

    def loss(inputs):
        prior = jaxlie.SE3.from_matrix(pose) @ jaxlie.SE3.exp(inputs["twist"]), given
        moved = [cloud.replace(points=inputs[side]) for side, cloud in (("source", source), ("target", target))]
        options = {"init": truth, "prior": prior, "max_distance": 0.4}
        return weigh(mcg.register(*moved, mcg.GICP(1e-2), **options, **TO_ROUNDING).matrix)

    inputs = jax.tree.map(jnp.asarray, {"source": source.points, "target": target.points, "twist": np.zeros(6)})
    if name == "without yaw":
        # The free directions are no group: the free twists depend on the pose. One compilation of a minute suffices.
        assert_alike(jax.jit(jax.grad(loss))(inputs), check_eager_gradient(loss, inputs), 1e-9)


@pytest.mark.slow
def test_errors_of_the_free_directions_have_the_deviations():
    """Normalised squared errors of 40 pairs in x, y and yaw."""
    errors = []
    for seed in range(40):
        *clouds, truth = planar(2 * seed)
        prior = np.eye(4), covariance_fixing("z roll pitch")
        result = mcg.register(*clouds, mcg.GICP(), prior=prior, **OPTIONS)
        free = [0, 1, 5]
        error = remaining(result.matrix, truth)[free]
        errors.append(error @ np.linalg.solve(np.asarray(result.covariance)[np.ix_(free, free)], error) / 3)
        assert result.converged
    assert 0.5 < np.mean(errors) < 2, np.mean(errors)


@pytest.mark.slow
@pytest.mark.parametrize("fixed", ["z roll pitch", "roll pitch"])
@pytest.mark.parametrize("variance", [0, 1e-10])
def test_a_planar_scan_from_far_off(data, fixed, variance):
    """One beam of a LiDAR, without heights, on a whole cloud, in the plane that the prior knows; the start is off by a
    metre and 20°."""
    folder = data / "lidar_pair"
    source, target = (np.asarray(mcg.io.read(folder / f"{name}.ply").points) for name in ("source", "target"))
    truth = np.loadtxt(folder / "T_target_source.txt")
    ranges = np.linalg.norm(source[:, :2], axis=1)
    beam = source[(np.hypot(ranges, source[:, 2]) > 0.5) & (np.abs(np.degrees(np.arctan2(source[:, 2], ranges))) < 0.2)]
    clouds = mcg.preprocess((beam * [1, 1, 0])[:: len(beam) // 316], None), mcg.preprocess(target)
    # Nothing else is known to better than a hundred metres or radians.
    prior = truth, np.maximum(np.minimum(covariance_fixing(fixed), 1e4), variance * np.eye(6))

    def is_near(result, metres):
        shift, turn = pose_error(result.matrix, truth)
        return result.converged and shift < metres and turn < np.radians(1)

    right, rng = 0, np.random.default_rng(0)
    for _ in range(20):
        angle, sign = rng.uniform(0, 2 * np.pi), np.sign(rng.normal())
        start = truth @ motion((np.cos(angle), np.sin(angle), 0, 0, 0, sign * np.radians(20)))
        result = mcg.register(*clouds, mcg.PointToPoint(), init=start, prior=prior, max_distance=(5, 0.2))
        # Walls hardly tell the height. From three starts the first registration, before the prior is weighed, ends
        # 1.3 m off and DEGENERATE. The second one does not move along what the first leaves unconstrained.
        is_right = is_near(result, 0.05 if "z" in fixed else 0.1)
        assert is_right or not result.converged
        right += is_right
        # The default distances find fewer poses, and others are not CONVERGED.
        by_default = mcg.register(*clouds, mcg.PointToPoint(), init=start, prior=prior)
        assert by_default.status is not mcg.Status.CONVERGED or is_near(by_default, 0.1)
    assert right >= 17
