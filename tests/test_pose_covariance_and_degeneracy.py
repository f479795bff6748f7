"""What holds a pose, and how well it is known."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import mcgicp_jax as mcg
from mcgicp_jax import datasets
from mcgicp_jax._pose_solver import covariance
from mcgicp_jax._pose_solver.covariance import Moments, NoiseSample, discounts_and_radius, response_and_scatter
from mcgicp_jax._pose_solver.degeneracy import LEAST_BY_GEOMETRY, find_directions
from mcgicp_jax._pose_solver.sums import Sums
from mcgicp_jax._terms.base import PosedMatches
from tests.batches import raw_pair
from tests.benchmarks.noise_scenes import street
from tests.corridor import corridor
from tests.precision import in_float64
from tests.reference import logarithm, pose, symmetric
from tests.refusals import refused
from tests.scenes import SURFACES, motion, pair, prepare, wall


def mean_evidence(cloud, method):
    surface = prepare(method, cloud, observed=True)
    geometry, channels = surface.observability, surface.channel_observability
    return symmetric(geometry.T).mean(axis=0), None if channels is None else symmetric(channels.T).mean(axis=0)


# Evidence


@pytest.mark.parametrize("turn", [(0, 0, 0, 0, 0, 0), (1, 2, 3, 0.4, -0.7, 0.2)])
@pytest.mark.parametrize("size", [1e-3, 1, 1e3])
def test_a_flat_wall_is_observed_along_its_normal_alone(size, turn):
    points, _ = wall(2000, noise=0.005)
    pose = motion(turn)
    cloud = mcg.preprocess(size * (points @ pose[:3, :3].T + pose[:3, 3]))
    geometry, _ = mean_evidence(cloud, mcg.GICP())
    geometry = pose[:3, :3].T @ geometry @ pose[:3, :3]
    assert geometry[2, 2] > 0.95
    # The normals themselves waver by more than this: what noise makes of them is taken off, and half as much again.
    within = np.linalg.eigvalsh(geometry[:2, :2])
    assert within[0] > -2e-3 and within[1] < 5e-4


@pytest.mark.parametrize("size", [100, 1000])
def test_random_points_are_registered(size):
    """Their neighbourhoods are no surfaces."""
    target, truth = np.random.default_rng(size).random((size, 3)), motion((0.02, -0.01, 0.03, 0.02, -0.03, 0.01))
    result = mcg.register((target - truth[:3, 3]) @ truth[:3, :3], target, mcg.GICP())
    assert result.converged and np.abs(result.matrix - truth).max() < 1e-4


@pytest.mark.parametrize("method", [mcg.GICP(), mcg.MultiChannelGICP(photometric=True)])
def test_padding_changes_no_pose_and_no_deviation(method):
    """Of points so sparse that each has its own cell, by whose number those cells are chosen that share a sum; and of
    fewer than 1,000 points, whose noise is estimated otherwise."""
    clouds = [mcg.preprocess(cloud, 0.3) for cloud in raw_pair(300, 2)[:2]]
    result, padded = (
        mcg.register(*each, method, max_distance=0.5) for each in (clouds, [cloud.pad(1100) for cloud in clouds])
    )
    np.testing.assert_allclose(padded.matrix, result.matrix, atol=1e-6)
    np.testing.assert_allclose(padded.deviations, result.deviations, rtol=1e-4)
    np.testing.assert_allclose(padded.overlap, result.overlap, rtol=0.01)


@pytest.mark.parametrize("noise", [0.25, 1.0])
@pytest.mark.parametrize("name, free", [("plane", (0, 1)), ("crossing planes", (0,)), ("room", ())])
def test_noise_as_large_as_the_spacing_constrains_nothing(name, free, noise):
    """Noise in units of the spacing. With one normal of all neighbours, up to 0.05 of the free motions was observed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        cloud = mcg.preprocess(SURFACES[name](np.random.default_rng(0), 3000, noise), None)
    observed = np.diag(mean_evidence(cloud, mcg.GICP())[0])
    assert np.all(observed[list(free)] < LEAST_BY_GEOMETRY) and np.all(np.delete(observed, free) > 0.02)


@pytest.mark.parametrize("seed", range(2))
def test_a_noisy_street_is_observed_along_the_road(seed):
    """By the 4 % of its points that lie on surfaces across it, such as the ends of parked cars."""
    cloud = mcg.preprocess(street(np.random.default_rng(seed), 3000, 0.5), None)
    assert mean_evidence(cloud, mcg.GICP())[0][0, 0] > LEAST_BY_GEOMETRY


def test_a_line_is_observed_across_alone_and_a_single_spot_not_at_all():
    rng = np.random.default_rng(0)
    along = np.array([1, 2, 3]) / np.sqrt(14)
    line = np.outer(rng.uniform(high=4, size=2000), along) + 1e-3 * rng.normal(size=(2000, 3))
    geometry, _ = mean_evidence(mcg.preprocess(line), mcg.GICP())
    # The normals of both halves of the neighbours turn about the line independently, so that a quarter remains.
    assert abs(along @ geometry @ along) < 1e-3 and np.linalg.eigvalsh(geometry)[1] > 0.05
    geometry, _ = mean_evidence(mcg.preprocess(np.tile([[1.0, 2.0, 3.0]], (2000, 1))), mcg.GICP())
    np.testing.assert_allclose(geometry, 0, atol=1e-6)


def test_channels_are_observed_along_their_gradient():
    """A ramp of slope g is observed by α²g²/(1 + α²g²) along it, and not at all across."""
    points, _ = wall(2000, noise=0.0)
    cloud = mcg.preprocess(mcg.PointCloud(points, 3 * points[:, :1]))
    method = mcg.MultiChannelGICP(channel_covariance=1.0, channel_weights=0.5)
    _, channels = mean_evidence(cloud, method)
    np.testing.assert_allclose(channels, np.diag([1.5**2 / (1 + 1.5**2), 0, 0]), atol=2e-3)


def test_noise_of_channels_is_not_observed():
    points, _ = wall(2000)
    noise = np.random.default_rng(1).normal(size=(2000, 3))
    cloud = mcg.preprocess(mcg.PointCloud(points, noise))
    _, channels = mean_evidence(cloud, mcg.MultiChannelGICP().resolve(cloud, cloud))
    # What is taken off is a little more than the noise leaves behind: below zero, nothing is constrained either.
    assert np.linalg.eigvalsh(channels).min() > -0.05 and np.linalg.eigvalsh(channels).max() < 5e-3


@pytest.mark.slow
def test_channels_that_do_not_agree_constrain_nothing():
    """A wall of posters, half a metre apart: from the identity the pose comes to rest 0.4 m off, where posters lie on
    others."""
    target, source = datasets.poster_wall(2, points_per_frame=12_000, step=0.5, seed=1)
    truth = np.linalg.inv(target.pose) @ source.pose
    clouds = source.cloud, target.cloud
    from_truth, from_identity = (mcg.register(*clouds, mcg.MultiChannelGICP(), init=init) for init in (truth, None))
    assert from_truth.converged and from_identity.status is mcg.Status.DEGENERATE


# Directions


def sums_of(points, radius, weight, **observed):
    """Sums over points (3, n) about zero, of which symmetric matrices (6, n) are observed."""
    h, count = np.concatenate([points, np.ones((1, points.shape[1]))]), points.shape[1]
    observed = {"common": observed["observability"], **observed}
    sums = Sums(
        center=np.zeros(3),
        count=count,
        square_extent=count * radius**2,
        energy=0,
        cost=0,
        square_distance=0,
        num_matched=count,
        force=np.zeros((3, 4)),
        stiffness=np.zeros((6, 4, 4)),
        mass=weight * h @ h.T,
        **{name: np.einsum("rn,in,jn->rij", weight * upper, h, h) for name, upper in observed.items()},
    )
    return jax.tree.map(lambda array: jnp.asarray(array, float), sums)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), constrained=st.integers(0, 6), radius=st.sampled_from([1e-3, 1.0, 300.0]))
def test_directions_are_the_eigenvectors_of_the_share_of_motion(seed, constrained, radius):
    """Against SciPy's generalised eigenvalues of random pairs that constrain `constrained` random twists."""
    import scipy.linalg

    rng = np.random.default_rng(seed)
    p = radius * rng.normal(size=(3, 200))
    weight = rng.uniform(0.5, 1.5, 200)
    normals = rng.normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    matrices = np.einsum("ni,nj->nij", normals, normals) * (constrained / 6)
    upper = matrices[:, *np.triu_indices(3)].T
    found = jax.jit(find_directions)(sums_of(p, radius, weight, observability=upper))
    arms = p.T / radius
    jacobians = np.concatenate([np.tile(np.eye(3), (200, 1, 1)), -np.cross(arms[:, None, :], np.eye(3)[None])], axis=2)
    jacobians[:, :, 3:] = np.stack([np.cross(axis, arms) for axis in np.eye(3)], axis=2)
    observed_motion = np.einsum("n,nai,nab,nbj->ij", weight, jacobians, matrices, jacobians)
    all_motion = np.einsum("n,nai,naj->ij", weight, jacobians, jacobians)
    expected = scipy.linalg.eigvalsh(observed_motion, all_motion)
    np.testing.assert_allclose(found.geometry, expected, atol=2e-4)
    twists = np.asarray(found.twists, np.float64)
    np.testing.assert_allclose(twists @ all_motion @ twists.T / weight.sum(), np.eye(6), atol=2e-3)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_face_that_one_scan_does_not_show_constrains_nothing(seed):
    """Of a box, the source shows two faces and the target one more. Along their edge, the points that lie beyond the
    end match that face, and a pose off by 4 cm had deviations of 3 mm."""
    rng = np.random.default_rng(seed)

    def faces(count, *fixed):
        points = rng.uniform(-1, 1, (len(fixed), count, 3))
        for face, axis in zip(points, fixed, strict=True):
            face[:, axis] = 1
        return points.reshape(-1, 3) * [0.5, 0.35, 0.25] + 0.003 * rng.normal(size=(len(fixed) * count, 3))

    for shown, other in (((1, 2), (0, 1, 2)), ((0, 1, 2), (1, 2))):
        source, target = faces(3000, *shown), faces(3000, *other)
        result = mcg.register(source, target, mcg.GICP(), init=motion((0.04, 0.01, 0, 0.02, -0.02, 0.03)))
        assert result.status is mcg.Status.DEGENERATE and len(result.unconstrained_directions) == 1


def test_channels_constrain_a_plane_as_measured():
    """At right poses slopes agree to 0.7 of what each cloud observes, at wrong ones to 0.3. The markings of a road are
    observed to 0.008, noise to 0.003."""
    points = np.random.default_rng(0).normal(size=(3, 200)) * [[1], [1], [0]]
    normal, within = (np.tile(np.array(upper)[:, None], 200) for upper in ([0, 0, 0, 0, 0, 1], [1, 0, 0, 1, 0, 0]))
    directions = jax.jit(find_directions)
    for observed, agreed, constrains in ((0.1, 0.07, 1), (0.1, 0.03, 0), (0.008, 0.008, 1), (0.003, 0.003, 0)):
        channels = {"channel_observability": observed * within, "agreement": agreed * within, "surplus": 0 * within}
        found = directions(sums_of(points, 1.0, np.ones(200), observability=normal, **channels))
        assert np.sum(found.free) == 3
        np.testing.assert_array_equal(found.constrained_by_matches[np.asarray(found.free)], bool(constrains))


@pytest.fixture(scope="module")
def flat():
    return pair(wall, truth=motion((0.03, -0.02, 0.01, 0.01, -0.01, 0.02)))


def in_plane_shift_of_centroid(result):
    centroid = result.directions.center
    return np.linalg.norm((result.matrix[:3, :3] @ centroid + result.matrix[:3, 3] - centroid)[:2])


def test_unconstrained_directions_of_a_wall_keep_the_initial_pose(flat):
    source, target, truth = flat
    result = mcg.register(source, target, mcg.GICP(), max_distance=0.3)
    assert result.status is mcg.Status.DEGENERATE and not result.converged
    free = result.unconstrained_directions
    assert [(each.is_rotation, each.constrained_by_channels) for each in free] == [
        (False, False),
        (False, False),
        (True, False),
    ]
    assert all(abs(each.axis[2]) < 0.05 for each in free[:2]) and abs(free[2].axis[2]) > 0.99
    # Height and tilt are found. The way along the wall and the turn about its normal, not constrained, are unchanged.
    left = np.linalg.inv(truth) @ result.matrix
    assert abs(left[2, 3]) < 2e-3 and np.abs(left[:2, 2]).max() < 2e-3
    assert in_plane_shift_of_centroid(result) < 2e-3 and abs(result.matrix[1, 0]) < 1e-3
    assert "constrained by channels: none" in repr(result)


def test_unconstrained_directions_move_unless_they_are_held(flat):
    source, target, _ = flat
    options = {"max_distance": 0.3, "hold_unconstrained": False}
    result = mcg.register(source, target, mcg.GICP(), **options)
    (batched,) = mcg.register_batch([source], [target], mcg.GICP(), **options)
    np.testing.assert_array_equal(batched.matrix, result.matrix)
    assert result.status in (mcg.Status.DEGENERATE, mcg.Status.MAX_ITERATIONS)
    assert in_plane_shift_of_centroid(result) > 2e-3


def test_channels_constrain_directions_that_geometry_does_not(flat):
    source, target, truth = flat
    result = mcg.register(source, target, mcg.MultiChannelGICP(), max_distance=0.3)
    assert result.converged
    assert [direction.constrained_by_channels for direction in result.unconstrained_directions] == [True] * 3
    assert mcg.metrics.pose_error(result.matrix, truth)[0] < 3e-3
    assert repr(result).count("constrained by channels: all") == 1


@pytest.mark.parametrize("textured", [True, False])
def test_a_corridor_is_free_along_its_axis(textured):
    target, source = corridor(2, textured=textured)
    truth = np.linalg.inv(target.pose) @ source.pose
    clouds = [mcg.preprocess(frame.cloud) for frame in (source, target)]
    result = mcg.register(*clouds, mcg.MultiChannelGICP(), max_distance=0.5)
    (direction,) = result.unconstrained_directions
    assert not direction.is_rotation and direction.constrained_by_channels == textured
    axis = source.pose[:3, :3].T @ [1, 0, 0]
    assert abs(direction.axis @ axis) > 0.995
    assert result.status is (mcg.Status.CONVERGED if textured else mcg.Status.DEGENERATE)
    if textured:
        # Of 0.2 m, with points 0.15 m apart; what it claims to know is no better.
        assert mcg.metrics.pose_error(result.matrix, truth)[0] < 0.1


def directions_of_wall(scale, shift):
    clouds = [
        mcg.preprocess(mcg.PointCloud(scale * (points + shift), channels))
        for points, channels in (wall(2000), wall(2000, seed=1))
    ]
    options = {"max_distance": 0.3 * scale, "translation_tolerance": 5e-4 * scale}
    return mcg.register(*clouds, mcg.MultiChannelGICP(), **options).directions


@pytest.mark.parametrize("scale, shift", [(1, 6), (1e-4, 3), (1e4, 6)])
def test_units_and_origin_do_not_change_directions(scale, shift):
    """But for an origin, the place of the sensor, within the wall."""
    first, second = directions_of_wall(1, 3), directions_of_wall(scale, shift)
    np.testing.assert_allclose(first.geometry, second.geometry, atol=5e-3)
    np.testing.assert_allclose(first.channels, second.channels, atol=5e-3)


@pytest.mark.slow
def test_unconstrained_directions_of_real_scenes(data):
    """A flat table and a road leave three directions free, a street none."""
    file = np.load(data / "planar_table" / "pair_000015_000025.npz")
    table = [
        mcg.preprocess(mcg.PointCloud(file[f"{which}_points_flat"], file[f"{which}_rgb"]), 0.01)
        for which in ("source", "target")
    ]
    scans = [np.fromfile(data / f"kitti/sequences/04/velodyne/{i:06d}.bin", np.float32).reshape(-1, 4) for i in (1, 0)]
    street = [mcg.preprocess(mcg.PointCloud(scan[:, :3], scan[:, 3:]), 0.25) for scan in scans]
    road = [mcg.preprocess(mcg.PointCloud(scan[:, :3], scan[:, 3:]), 0.1) for scan in map(on_the_road, scans)]

    result = mcg.register(*table, mcg.GICP(), max_distance=0.1)
    assert result.status is mcg.Status.DEGENERATE
    assert [direction.is_rotation for direction in result.unconstrained_directions] == [False, False, True]
    result = mcg.register(*table, mcg.MultiChannelGICP(), max_distance=0.1)
    assert result.converged and [each.constrained_by_channels for each in result.unconstrained_directions] == [True] * 3

    result = mcg.register(*road, mcg.GICP(), init=motion((1.3, 0, 0, 0, 0, 0)), max_distance=0.5)
    assert result.status is mcg.Status.DEGENERATE
    forward, sideways, yaw = result.unconstrained_directions
    assert abs(forward.axis[0]) > 0.99 and abs(sideways.axis[1]) > 0.99
    assert yaw.is_rotation and abs(yaw.axis[2]) > 0.99

    result = mcg.register(*street, mcg.GICP(), max_distance=1.5)
    assert result.converged and result.unconstrained_directions == ()


def on_the_road(scan):
    """Points of the ground ahead: within 25 m, 6 m to each side, 6 cm of its plane."""
    scan = scan[(np.abs(scan[:, 1]) < 6) & (np.hypot(scan[:, 0], scan[:, 1]) < 25)]
    plane, near = None, np.abs(scan[:, 2] + 1.73) < 0.3
    for _ in range(10):
        x, y, z = scan[near, :3].T
        plane = np.linalg.lstsq(np.stack([x, y, np.ones_like(x)], axis=1), z, rcond=None)[0]
        near = np.abs(scan[:, 2] - scan[:, :2] @ plane[:2] - plane[2]) < 0.06
    return scan[near]


# Covariance


@in_float64
def test_the_pose_takes_six_degrees_of_freedom_of_few_correspondences():
    """n of them, each several times: 1 / (n − 6), not 1 / n."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(10, 3))
    clouds, variances = (points, points + 0.01 * rng.normal(size=(10, 3))), {}
    for number in (10, 20, 50):
        source, target = (mcg.preprocess(np.tile(rows, (number // 10, 1)), num_neighbors=4) for rows in clouds)
        rows = np.arange(number, dtype=np.int32)
        matches = mcg.Correspondences(indices=rows, distances=np.zeros(number), valid=np.ones(number, bool))
        found = mcg.estimate_pose(source, target, matches, mcg.PointToPoint())
        variances[number] = np.diagonal(found.covariance)
    np.testing.assert_allclose(variances[10] / variances[20], 14 / 4, rtol=1e-6)
    np.testing.assert_allclose(variances[20] / variances[50], 44 / 14, rtol=1e-6)


def test_the_bias_of_matching_is_one_more_score():
    root, bias = np.random.default_rng(0).normal(size=(6, 6)), np.arange(1.0, 7.0)
    moments = Moments(jnp.zeros((6, 4, 4)), bias, root @ root.T, np.int32(10))
    _, scatter = jax.jit(response_and_scatter)(moments, jnp.asarray(1.0))
    np.testing.assert_allclose(scatter, 10 / 4 * root @ root.T + np.outer(bias, bias), rtol=1e-5)


def test_geometry_and_channels_have_discounts_of_their_own(monkeypatch):
    """Matches of rough surfaces follow 0.6 of a motion, and those of noisy channels 0.3."""
    rng = np.random.default_rng(0)
    squares = rng.normal(size=(6, 100_000)) ** 2
    sample = NoiseSample(0.4 * squares[0], squares[1:3].mean(axis=0), 0.7 * squares[3:].mean(axis=0), squares[0])
    discount, _ = discounts_and_radius(sample, 3)
    np.testing.assert_allclose(discount, [0.4, 0.7], rtol=0.02)
    information = rng.random((6, 5))
    trace = information[[0, 3, 5]].sum(axis=0)
    fractions = {"observability": information, "channel_observability": information / (1 + trace)}
    monkeypatch.setattr(covariance, "observability", lambda *_: fractions)
    posed = PosedMatches._make([None] * len(PosedMatches._fields))
    shown = covariance._discounted_observability(posed, jnp.array([0.4, 0.7]), ())
    np.testing.assert_allclose(shown, 0.4 * information + 0.7 * information / (1 + 0.7 * trace), rtol=1e-5)


@pytest.mark.slow
def test_the_covariance_is_a_covariance():
    source, target, _ = pair()
    matches = mcg.find_correspondences(source, target, motion(), mcg.GICP(), max_distance=0.5)
    for result in (
        mcg.register(source, target, mcg.GICP(), max_distance=0.5),
        mcg.register(source, target, mcg.MultiChannelGICP(), max_distance=0.5, robust=mcg.Cauchy(0.3)),
        mcg.estimate_pose(source, target, matches, mcg.GICP(), init=motion()),
    ):
        covariance = np.asarray(result.covariance)
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance / np.sqrt(np.outer(*[np.diagonal(covariance)] * 2))).min() > 0
        # 2000 points of 1 cm noise: millimetres, milliradians
        assert np.all(np.sqrt(np.diagonal(covariance)) < 6e-3) and np.all(np.sqrt(np.diagonal(covariance)) > 1e-4)
        assert result.converged and result.unconstrained_directions == () and "unconstrained" not in repr(result)


@in_float64
def test_the_covariance_follows_the_unit_of_length_and_a_shift():
    # The frame of the source stays as it is, since the covariance refers to it.
    source, target = (np.asarray(cloud.unpad().points, np.float64) for cloud in pair()[:2])
    variances = []
    for factor, shift in ((1, 0), (1e3, 3e3)):
        clouds = mcg.preprocess(factor * source), mcg.preprocess(factor * target + shift)
        options = {"max_distance": 0.5 * factor, "translation_tolerance": 5e-4 * factor}
        result = mcg.register(*clouds, mcg.GICP(), init=motion((shift, shift, shift, 0, 0, 0)), **options)
        variances.append(np.diagonal(result.covariance) / np.repeat([factor**2, 1], 3))
    np.testing.assert_allclose(*variances, rtol=1e-3)


def test_deviations_are_huge_along_unconstrained_directions(flat):
    # Points near the origin would not count.
    source, target = (mcg.preprocess(mcg.PointCloud(cloud.points).crop(0.2), None) for cloud in flat[:2])
    result = mcg.register(source, target, mcg.GICP(), max_distance=0.3)
    points = np.asarray(source.points)
    radius = np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1)))
    # Ten radii along the wall, and ten radians about its normal.
    np.testing.assert_allclose(result.deviations[[0, 1, 5]], [10 * radius, 10 * radius, 10], rtol=0.01)
    for direction in result.unconstrained_directions:
        deviation = np.sqrt(direction.twist @ np.linalg.pinv(np.asarray(result.information)) @ direction.twist)
        assert np.isfinite(deviation)
        # A motion of one metre, of ten times the radius
        scaled = direction.twist / (direction.twist @ direction.twist)
        assert scaled @ np.asarray(result.covariance) @ scaled > 1


def test_large_coordinates_keep_the_covariance_of_the_points():
    """In UTM the twist is about a zero point far away; seen from the cloud it is the same covariance, but for the cells
    of space, which are cut elsewhere."""
    source, target, _ = pair()
    offset = np.array([4.5e5, 5.2e6, 100.0])
    near = mcg.register(source, target, mcg.GICP(), max_distance=0.5)
    clouds = [mcg.preprocess(np.asarray(c.unpad().points, np.float64) + offset) for c in (source, target)]
    far = mcg.register(*clouds, mcg.GICP(), max_distance=0.5)
    to_near = np.eye(6)
    to_near[:3, 3:] = -np.cross(np.eye(3), offset)
    brought = to_near @ far.covariance @ to_near.T
    np.testing.assert_allclose(np.diagonal(brought), np.diagonal(near.covariance), rtol=0.5)
    from_near = np.linalg.inv(to_near)
    scale = np.abs(near.information).max()
    np.testing.assert_allclose(from_near.T @ far.information @ from_near, near.information, atol=1e-2 * scale)
    assert far.unconstrained_directions == near.unconstrained_directions == ()
    # Of the points themselves, wherever zero is.
    np.testing.assert_allclose(far.deviations, near.deviations, rtol=0.3)
    assert far.deviations.max() < 5e-3 < np.sqrt(far.covariance[0, 0])


@pytest.mark.parametrize("step", [0.05, 0.2])
def test_deviations_contain_the_steps_of_coordinates(step):
    """Lattices match lattices: the error does not average out over the points."""
    source, target, truth = pair(size=2000)
    rounded = [mcg.preprocess(np.rint(cloud.coordinates / step) * step, None) for cloud in (source, target)]
    result = mcg.register(*rounded, mcg.GICP(), init=truth)
    least = step / np.sqrt(12)
    assert (result.deviations[:3] > 1.4 * least).all() and (result.deviations[:3] < 2 * least + 0.01).all()
    # Of one of them, and of neither.
    one = mcg.register(source, rounded[1], mcg.GICP(), init=truth).deviations[:3]
    assert (one > 0.99 * least).all() and (one < result.deviations[:3]).all()
    assert (mcg.register(source, target, mcg.GICP(), init=truth).deviations[:3] < 0.005).all()


def test_deviations_contain_the_steps_of_one_axis():
    """Of the source, whose heights are along y of the target: along this axis, and about the others."""
    target, source, truth = pair(size=2000)
    turn, step = pose([np.pi / 2, 0, 0]), 0.1
    points = np.asarray(source.coordinates) @ turn[:3, :3]
    rounded = points.copy()
    rounded[:, 2] = np.rint(points[:, 2] / step) * step
    fine, coarse = (
        mcg.register(mcg.preprocess(each, None), target, mcg.GICP(), init=truth @ turn) for each in (points, rounded)
    )
    assert (fine.deviations < 0.005).all()
    assert coarse.deviations[1] > 0.99 * step / np.sqrt(12) and (coarse.deviations[[0, 2, 4]] < 0.005).all()
    assert (coarse.deviations[[3, 5]] > 0.005).all()


def test_deviations_contain_the_steps_of_whole_disparities():
    """As of a stereo camera that looks along z: a step s of 1/z is one of z² s, and no step of z fits."""
    source, target, truth = pair(size=2000)
    ahead, step = motion((0, 0, 3, 0, 0, 0)), 1 / 60
    points = np.asarray(source.coordinates) + ahead[:3, 3]
    depth = points[:, 2:]
    rounded = points * (1 / (np.rint(1 / depth / step) * step)) / depth
    start = truth @ np.linalg.inv(ahead)
    fine, coarse = (
        mcg.register(mcg.preprocess(each, None), target, mcg.GICP(), init=start) for each in (points, rounded)
    )
    assert (fine.deviations < 0.005).all()
    assert coarse.deviations[2] > 0.9 * np.median(depth) ** 2 * step / np.sqrt(12)


@pytest.mark.slow
def test_traced_and_batched_results_agree_with_single_ones():
    """Clouds of several sizes, stacked."""
    clouds = [pair(size=500 - 50 * i, truth=motion((0.02 * i, 0.01, 0, 0.01, 0, 0.02)))[:2] for i in range(3)]
    stacked = [mcg.PointCloud.stack([clouds[i][which] for i in range(3)]) for which in (0, 1)]
    options = {"max_distance": 0.5, "search": mcg.DenseSearch()}
    batch = jax.jit(jax.vmap(lambda s, t: mcg.register(s, t, mcg.GICP(), **options)))(*stacked)
    refused(lambda: batch.unconstrained_directions, "unconstrained_directions")
    for i, (source, target) in enumerate(clouds):
        alone = mcg.register(source, target, mcg.GICP(), **options)
        assert batch.status[i] == alone.status
        np.testing.assert_allclose(batch.matrix[i], alone.matrix, atol=1e-3)
        np.testing.assert_allclose(batch.directions.geometry[i], alone.directions.geometry, atol=1e-3)
        np.testing.assert_allclose(batch.deviations[i], alone.deviations, rtol=0.05)


@pytest.mark.parametrize(
    "method",
    [
        pytest.param(mcg.GICP(), id="gicp"),
        pytest.param(mcg.NDT(), id="ndt", marks=pytest.mark.slow),
        pytest.param(mcg.D2DNDT(), id="d2d-ndt", marks=pytest.mark.slow),
    ],
)
def test_normalised_squared_errors_are_one_on_average(method):
    """A few simulated pairs: enough to see a covariance that is wrong by a factor of two in standard deviation."""
    room = datasets.box_room(2, points_per_frame=2000 if method.needs_covariances == () else 5000)
    squares = []
    for seed in range(20):
        target, source = (room.observe(i, noise_seed=2 * seed + i) for i in (0, 1))
        truth = np.linalg.inv(target.pose) @ source.pose
        clouds = [
            mcg.voxel_gaussians(frame.cloud, 0.5) if name in method.needs_covariances else mcg.preprocess(frame.cloud)
            for name, frame in (("source", source), ("target", target))
        ]
        result = mcg.register(*clouds, method, init=truth, max_distance=0.5)
        error = logarithm(np.linalg.inv(truth) @ result.matrix)
        squares.append(error @ np.linalg.solve(np.asarray(result.covariance, np.float64), error) / 6)
    assert 0.5 < np.mean(squares) < 1.9


def test_noise_across_a_textured_wall_does_not_move_the_pose_along_it():
    """Raw, with all defaults. With GICP's ε the errors were 8 mm, 2.4 times the deviations: tilted normals pushed the
    points along the wall more than the texture held them."""
    waves, phases = np.random.default_rng(7).normal(0, 2.5, (12, 3)), np.random.default_rng(8).uniform(0, 6.28, 12)
    errors, deviations = [], []
    for seed in range(6):
        rng, clouds = np.random.default_rng(seed), []
        for _ in range(2):
            points = np.column_stack([rng.uniform(-3, 3, 20_000), np.full(20_000, 3.0), rng.uniform(-1.2, 1.4, 20_000)])
            paint = np.sin(points @ waves.T + phases).mean(axis=1) + rng.normal(0, 0.02, 20_000)
            clouds.append(mcg.PointCloud(points + rng.normal(0, 0.005, points.shape), paint))
        result = mcg.register(*clouds, mcg.MultiChannelGICP())
        assert result.status == mcg.Status.CONVERGED
        errors.append((result.matrix @ [0, 3, 0.1, 1])[[0, 2]] - [0, 0.1])
        deviations.append(result.deviations[[0, 2]])
    assert np.sqrt(np.mean(np.square(errors))) < 3e-3
    assert np.sqrt(np.mean(np.square(errors) / np.square(deviations))) < 1.5


def test_deviations_are_those_of_the_centroid_of_matched_points():
    """By sampling: poses drawn from the covariance move the centroid, and turn, as much as the deviations say."""
    source, target, _ = pair(truth=motion((0.1, -0.2, 0.05, 0.3, 0.2, 1.2)))
    result = mcg.register(source, target, mcg.GICP(), init=motion((0.1, -0.2, 0.05, 0.3, 0.2, 1.2)), max_distance=0.5)
    matches = mcg.find_correspondences(source, target, result.matrix, mcg.GICP(), max_distance=0.5)
    centroid = np.append(np.asarray(source.points, np.float64)[np.asarray(matches.valid)].mean(axis=0), 1)
    np.testing.assert_allclose(result.directions.center, centroid[:3], atol=1e-3)
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(6), np.asarray(result.covariance, float), 4000)
    matrix = np.asarray(result.matrix)
    moved = matrix @ np.stack([motion(draw) for draw in draws])
    shifts = moved @ centroid - matrix @ centroid
    turns = Rotation.from_matrix(moved[:, :3, :3] @ matrix[:3, :3].T).as_rotvec()
    np.testing.assert_allclose(result.deviations, [*np.std(shifts, axis=0)[:3], *np.std(turns, axis=0)], rtol=0.06)


def test_constrained_directions_keep_their_variances_beside_free_ones():
    """In float32, variances of square millimetres would vanish beside those of 100 m² along free directions."""
    turned = motion((0, 0, 0, 0.3, -0.2, 0.1))
    source, target = (mcg.preprocess(wall(3000, seed=seed)[0] @ turned[:3, :3].T) for seed in (1, 2))
    result = mcg.register(source, target, mcg.GICP(), max_distance=0.3)
    assert result.status == mcg.Status.DEGENERATE and result.covariance.dtype == np.float64
    constrained = np.linalg.inv(np.asarray(result.directions.twists, np.float64).T)[
        np.asarray(result.directions.constrained)
    ]
    values = np.linalg.eigvalsh(constrained @ result.covariance @ constrained.T)
    assert len(values) == 3 and values.min() > 0 and np.sqrt(values.max()) < 1e-3
    assert np.linalg.eigvalsh(result.covariance).max() > 1
