"""Tie points and priors: against plain sums, SciPy and Gaussian fusion; what they constrain; derivatives; honesty."""

import contextlib
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mcgicp_jax as mcg
from mcgicp_jax import Status
from mcgicp_jax._pose_solver.matched import Motion
from mcgicp_jax._pose_solver.pose_measurements import Fusion, Prior, TiePoints, form_at
from mcgicp_jax._registration.tie_points_and_prior import checked_measurements
from tests.benchmarks.tie_points import OPTIONS, covariance, measured, simulate, tie_points, twist_error
from tests.compilations import compilations
from tests.corridor import bare_pair
from tests.differences import TO_ROUNDING, assert_alike, check_gradient, eager_gradient, weigh
from tests.precision import in_float64
from tests.reference import exponential, logarithm
from tests.refusals import refused
from tests.scenes import motion, pair


@pytest.fixture(scope="module")
def corner(precision):
    return pair()


@pytest.fixture(scope="module")
def hall(precision):
    return bare_pair()


# Algebra


@pytest.mark.parametrize("kind", ["tie points", "prior"])
def test_the_form_is_the_cost(kind):
    """The force and the stiffness of plain sums, at a pose that is not the one to which the form refers."""
    rng = np.random.default_rng(1)
    start, pose, center, radius = motion(0.3 * rng.normal(size=6)), motion(0.3 * rng.normal(size=6)), np.ones(3), 2.0
    ties = TiePoints(*rng.normal(size=(2, 4, 3)), np.array([covariance(rng, 3, 0.3) for _ in range(4)]))
    belief = motion(0.2 * rng.normal(size=6)), covariance(rng, 6, 0.3)
    prior = Prior(belief[0][:3, :3], belief[0][:3, 3], np.linalg.inv(belief[1]))
    ties, prior = (ties, None) if kind == "tie points" else (None, prior)

    def residuals(twist):
        turn = motion([0, 0, 0, *twist[3:]])[:3, :3]
        rotation = turn @ pose[:3, :3]
        translation = center + turn @ (pose[:3, 3] - center) + radius * twist[:3]
        if ties is not None:
            differences = ties.target - ties.source @ rotation.T - translation
            roots = np.linalg.cholesky(np.linalg.inv(ties.covariances))
            return np.einsum("nji,nj->ni", roots, differences).ravel()
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = rotation, translation
        return np.linalg.cholesky(np.linalg.inv(belief[1])).T @ logarithm(np.linalg.inv(belief[0]) @ moved)

    slope = np.stack([(residuals(1e-5 * e) - residuals(-1e-5 * e)) / 2e-5 for e in np.eye(6)], axis=1)
    form = form_at(start[:3, :3], start[:3, 3], center, radius, ties, prior)
    nothing = np.zeros((6, 6))
    fusion = Fusion(start[:3, :3], start[:3, 3], center, radius, form, np.eye(6), nothing, nothing, np.ones(6, bool))
    with jax.enable_x64(True):
        force, stiffness = jax.jit(Fusion.force_and_stiffness)(fusion, Motion(pose[:3, :3], pose[:3, 3]))
        cost = fusion.cost_of_ties(Motion(pose[:3, :3], pose[:3, 3]))
    np.testing.assert_allclose(cost, 0 if ties is None else np.sum(residuals(np.zeros(6)) ** 2), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(force, -slope.T @ residuals(np.zeros(6)), rtol=1e-6)
    np.testing.assert_allclose(stiffness, slope.T @ slope, rtol=1e-6)


# Fusion


def test_precise_tie_points_decide(corner):
    """Against SciPy's fit, a few millimetres from where the clouds alone would be; they contradict each other."""
    source, target, truth = corner
    points, targets, _ = tie_points(motion((0.004, -0.003, 0.002, 0.002, 0.001, -0.002)) @ truth, source.points, 1e-3)
    precise = np.tile(1e-12 * np.eye(3), (6, 1, 1))
    with pytest.warns(UserWarning, match="tie_points: their squared residuals"):
        result = mcg.register(source, target, mcg.GICP(), tie_points=(points, targets, precise), **OPTIONS)
    means = targets.mean(axis=0), points.mean(axis=0)
    expected, _ = Rotation.align_vectors(targets - means[0], points - means[1])
    np.testing.assert_allclose(result.matrix[:3, :3], expected.as_matrix(), atol=2e-5)
    np.testing.assert_allclose(result.matrix[:3, 3], means[0] - expected.apply(means[1]), atol=4e-5)
    assert result.status is Status.UNVERIFIED and result.deviations.max() < 1e-5


def test_a_precise_prior_has_the_same_effect_and_checks_where_points_are_differentiated(corner):
    """In float32, the inverse of such a covariance is rounded by far more than the least variances."""
    source, target, truth = corner
    variances = np.square([1e-4, 1e-3, 1e-7, 1e-9, 1e-2, 1e-8])

    def pose(points, covariance):
        prior = truth @ motion((0.01, 0, 0, 0, 0, 0.003)), covariance
        return mcg.register(source.replace(points=points), target, mcg.GICP(), prior=prior, **OPTIONS).matrix

    points = jnp.asarray(source.points)
    value, _ = jax.vjp(lambda points: pose(points, np.diag(variances)), points)
    np.testing.assert_allclose(value, pose(source.points, np.diag(variances)), atol=1e-6)
    skewed = np.diag(variances) + 1e-4 * np.eye(6, k=1)
    refused(lambda: jax.vjp(lambda points: pose(points, skewed), points), "prior: covariance", "not symmetric")


# Standard deviations (v, ω), from far below the least ones to those of directions that are not measured.
UNEVEN = {
    "tight": 3 * [1e-7] + 3 * [1e-9],
    "mixed": [1e-4, 1e-3, 1e-7, 1e-9, 1e3, 1e-8],
    "position": 3 * [1e-6] + 3 * [1e6],
    "rotation": 3 * [1e6] + 3 * [1e-7],
}


@pytest.mark.slow
def test_an_uneven_prior_has_the_same_effect_where_its_covariance_is_traced(corner):
    source, target, truth = corner

    def pose(given):
        prior = (truth @ motion((0.01, 0, 0, 0, 0, 0.003))).astype(np.float32), given
        result = mcg.register(source, target, mcg.GICP(), prior=prior, **OPTIONS)
        return result.matrix, result.status_code

    inside = jax.jit(pose)
    for deviations in UNEVEN.values():
        given = (0.9 * np.eye(6) + 0.1) * np.outer(deviations, deviations)
        expected, code = pose(given)
        matrix, traced_code = inside(given.astype(np.float32))
        np.testing.assert_allclose(matrix, expected, atol=2e-6)
        assert code == traced_code


@pytest.mark.parametrize(
    "method", [mcg.GICP(), mcg.PointToPlane(), mcg.D2DNDT()], ids=["gicp", "point-to-plane", "d2d-ndt"]
)
def test_a_prior_is_weighed_by_its_covariance(corner, method):
    """The product of two Gaussians: that of the registration alone, and the prior."""
    source, target, _ = corner
    options = OPTIONS | {"translation_tolerance": 1e-5, "rotation_tolerance": 1e-5}
    cells = isinstance(method, mcg.D2DNDT)
    if cells:
        source, target = (mcg.voxel_gaussians(cloud, 0.2) for cloud in (source, target))
    alone = mcg.register(source, target, method, **options)
    prior = measured(alone.matrix, 3 * np.sqrt(np.diagonal(alone.covariance)), seed=2)
    result = mcg.register(source, target, method, prior=prior, **options)
    information = np.linalg.inv(np.asarray(alone.covariance)), np.linalg.inv(prior[1])
    covariance = np.linalg.inv(sum(information))
    expected = covariance @ information[1] @ twist_error(prior[0], alone.matrix)
    deviations = np.sqrt(np.diagonal(covariance))
    # Other matches at another pose, and the loop stops when updates are small.
    assert np.all(np.abs(twist_error(result.matrix, alone.matrix) - expected) < 0.25 * deviations)
    np.testing.assert_allclose(np.sqrt(np.diagonal(result.covariance)), deviations, rtol=0.02)
    added = np.asarray(result.information) - np.asarray(alone.information)
    # At another pose, the kernel of D2D-NDT gives its few cells other weights.
    assert cells or np.all(np.linalg.eigvalsh(added) > -0.05 * np.linalg.norm(added))


@pytest.mark.parametrize(("deviation", "count"), [(1e4, 6), (1.0, 0)])
def test_uncertain_or_no_tie_points_hardly_change_the_pose(corner, deviation, count):
    source, target, truth = corner
    ties = tie_points(truth, source.points, deviation, count=count)
    alone, result = (mcg.register(source, target, mcg.GICP(), tie_points=t, **OPTIONS) for t in (None, ties))
    assert result.converged and np.abs(twist_error(result.matrix, alone.matrix)).max() < 5e-4
    np.testing.assert_allclose(result.deviations, alone.deviations, rtol=0.01)
    np.testing.assert_allclose(result.information, alone.information, rtol=0.02, atol=30)


@jax.jit
def status_inside(source, target, init, ties, max_distance):
    """One program for all tests with six tie points."""
    options = {"init": init, "tie_points": ties, "max_distance": max_distance}
    return mcg.register(source, target, mcg.GICP(), **options).status_code


@pytest.mark.parametrize("wrong", ["none", "one", "all"])
def test_wrong_tie_points_are_told(corner, wrong):
    """Of six with deviations of 1 cm, one 0.2 m off along each axis, or all of other points."""
    source, target, truth = corner
    points, targets, covariances = tie_points(truth, source.points, 0.01)
    if wrong == "one":
        targets = targets + np.where(np.arange(len(targets)) == 0, 0.2, 0)[:, None]
    elif wrong == "all":
        targets = np.roll(targets, 1, axis=0)
    ties = points, targets, covariances
    expected = Status.CONVERGED if wrong == "none" else Status.UNVERIFIED
    with contextlib.nullcontext() if wrong == "none" else pytest.warns(UserWarning, match="^tie_points: .*UNVERIFIED"):
        assert mcg.register(source, target, mcg.GICP(), init=truth, tie_points=ties, **OPTIONS).status is expected
    assert Status(int(status_inside(source, target, truth, ties, **OPTIONS))) is expected


def test_rounding_does_not_contradict_precise_tie_points(corner):
    """Exact ones with deviations of a micrometre in a scene of 100 m, where float32 has steps of 8 µm."""
    cloud, turn = corner[0].unpad(), motion((1, -2, 0.5, 0.02, -0.01, 0.03))
    points = 50 * np.asarray(cloud.points, float)
    moved = points @ turn[:3, :3].T + turn[:3, 3]
    source, target = (mcg.preprocess(mcg.PointCloud(side, cloud.channels), None) for side in (points, moved))
    ties = points[:1800:300], moved[:1800:300], np.tile(1e-12 * np.eye(3), (6, 1, 1))
    options = {"init": turn, "tie_points": ties, "max_distance": 20.0}
    outside = mcg.register(source, target, mcg.GICP(), **options)
    inside = status_inside(source, target, turn, ties, max_distance=20.0)
    assert outside.status is Status(int(inside)) is Status.CONVERGED
    # They may be constants of a program, too.
    jax.eval_shape(lambda cloud: mcg.register(cloud, target, mcg.GICP(), **options).status_code, source)


def test_tie_points_at_large_coordinates_lose_nothing(corner):
    """They decide the pose, with a source far from its origin and a target at UTM coordinates."""
    source, target, truth = corner
    moves = motion((500, 300, 10, 0, 0, 0.5)), motion((4e5, 5e6, 0, 0.3, 0, 0))
    clouds = [
        np.asarray(cloud.points, np.float64) @ move[:3, :3].T + move[:3, 3]
        for cloud, move in zip((source, target), moves, strict=True)
    ]
    there = moves[1] @ truth @ np.linalg.inv(moves[0])
    points, targets, covariances = tie_points(there, clouds[0], 1e-4)
    result = mcg.register(*clouds, mcg.GICP(), init=there, tie_points=(points, targets, covariances), **OPTIONS)
    moved = points @ result.matrix[:3, :3].T + result.matrix[:3, 3]
    assert result.converged and np.abs(moved - targets).max() < 5e-4


@pytest.mark.parametrize("at_cloud", [True, False])
def test_the_information_of_a_prior_belongs_to_the_origin_of_the_cloud(corner, at_cloud):
    """The same error of a pose has the same Mahalanobis distance in the user's coordinates and in the cloud's."""
    rng, far = np.random.default_rng(0), np.array([300.0, -400.0, 100.0])
    source, target = (mcg.preprocess(np.asarray(cloud.points, np.float64) + far) for cloud in corner[:2])
    assert np.any(source.origin)
    # At the cloud, a deviation is 4e-5: 4 times the least one.
    given = covariance(rng, 6, 0.03)
    if at_cloud:
        there = np.eye(6)
        there[:3, 3:] = np.cross(far, np.eye(3)).T
        given = there @ given @ there.T
    pose = motion((1, 2, 3, 0.1, 0.2, 0.3))
    _, prior = checked_measurements(None, (pose, given), source, target)
    inside = jax.jit(lambda spread: checked_measurements(None, (pose, spread), source, target)[1].information)
    with jax.enable_x64(True):
        traced = np.asarray(inside(given))
    # So small that the transport of the error is linear.
    for twist in np.linalg.cholesky(given).T * 1e-3:
        start, end = (
            motion((*-target.origin, 0, 0, 0)) @ each @ motion((*source.origin, 0, 0, 0))
            for each in (pose, pose @ exponential(twist))
        )
        error = logarithm(np.linalg.inv(start) @ end)
        expected = twist @ np.linalg.solve(given, twist)
        for information in (prior.information, traced):
            np.testing.assert_allclose(error @ information @ error, expected, rtol=1e-4)


@pytest.mark.slow
def test_rounding_of_a_precise_prior_constrains_nothing():
    """Of a prior that knows x and y to 0.1 mm and nothing else, float32 leaves some information on the yaw."""
    target, source = mcg.datasets.poster_wall(num_frames=2)
    clouds = [mcg.preprocess(frame.cloud, 0.03) for frame in (source, target)]
    truth = (np.linalg.inv(target.pose) @ source.pose).astype(np.float32)

    def register(variances):
        return mcg.register(*clouds, mcg.GICP(), prior=(truth, variances))

    inside = jax.jit(lambda variances: register(jnp.diag(variances)))
    for loose in (1e4, 1e12):
        variances = np.array([1e-8, 1e-8, *4 * [loose]])
        for result in (register(np.diag(variances)), inside(variances)):
            assert result.status == mcg.Status.DEGENERATE and result.deviations[5] > 1
            assert max(mcg.metrics.pose_error(truth, result.matrix)) < 1e-3
            yaw, *translations = result.unconstrained_directions
            assert yaw.is_rotation and not yaw.constrained_by_ties
            assert all(direction.constrained_by_ties for direction in translations)


# What geometry leaves free


def test_a_tie_point_constrains_the_axis_of_a_corridor(hall):
    source, target, truth, axis = hall
    start = truth.copy()
    start[:3, 3] += 0.1 * truth[:3, :3] @ axis
    options = OPTIONS | {"init": start}
    alone = mcg.register(source, target, mcg.GICP(), **options)
    assert alone.status is mcg.Status.DEGENERATE and alone.deviations.max() > 1
    one = tie_points(truth, source.points, 0.01, count=1)
    result = mcg.register(source, target, mcg.GICP(), tie_points=one, **options)
    assert result.converged and result.deviations.max() < 0.03
    (direction,) = result.unconstrained_directions
    assert direction.constrained_by_ties and not direction.constrained_by_channels
    assert abs(direction.axis @ axis) > 0.995
    assert "constrained by tie points or prior" in repr(direction) and "by tie points or prior" in repr(result)
    assert abs(twist_error(result.matrix, truth)[:3] @ axis) < 0.03
    # A prior across the corridor alone does not tell the way along it.
    across = (np.eye(3) - np.outer(axis, axis)) * 1e-4 + 1e6 * np.outer(axis, axis)
    given = np.block([[across, np.zeros((3, 3))], [np.zeros((3, 3)), 1e-4 * np.eye(3)]])
    result = mcg.register(source, target, mcg.GICP(), prior=(start, given), **OPTIONS)
    assert result.status is mcg.Status.DEGENERATE
    assert abs(twist_error(result.matrix, start)[:3] @ axis) < 5e-3


def test_a_prior_is_the_initial_pose_unless_one_is_given(corner):
    source, target, truth = corner
    away = motion((7, 0, 0, 0, 0, 0))
    moved = mcg.preprocess(np.asarray(source.points) + np.float32(7))
    shift = np.eye(4)
    shift[:3, 3] = -7
    result = mcg.register(moved, target, mcg.GICP(), prior=(truth @ shift, np.eye(6)), **OPTIONS)
    assert result.converged and np.abs(twist_error(result.matrix @ np.linalg.inv(shift), truth)).max() < 0.01
    lost = mcg.register(moved, target, mcg.GICP(), init=away, prior=(truth @ shift, 1e-6 * np.eye(6)), **OPTIONS)
    assert lost.status is mcg.Status.TOO_FEW_CORRESPONDENCES


# Derivatives


@in_float64
@pytest.mark.slow
@pytest.mark.parametrize("scene", ["corner", "corridor"])
def test_gradients_of_tie_points_and_prior(scene, noisy, hall):
    """By what was measured, and its variances, on which the weights of the matches from a first registration do not
    depend."""
    source, target, truth = noisy if scene == "corner" else hall[:3]
    weak, offset, gate = (0.02, 0.05, 0.15) if scene == "corner" else (0.05, 0.0, 0.4)
    points, targets, covariances = tie_points(truth, source.points, weak)
    pose, given = measured(truth, np.repeat([weak, 0.5 * weak], 3), seed=3)
    # Variances are about 1, so that one step of the differences suits all inputs.
    size = weak**2

    def result(inputs):
        ties, spread = inputs["ties"], inputs["covariance"]
        ties = *ties[:2], size * 0.5 * (ties[2] + ties[2].swapaxes(1, 2))
        prior = jaxlie.SE3.from_matrix(pose) @ jaxlie.SE3.exp(inputs["twist"]), size * 0.5 * (spread + spread.T)
        options = {"init": truth, "tie_points": ties, "prior": prior, "max_distance": gate}
        return mcg.register(source, target, mcg.GICP(1e-2), **options, **TO_ROUNDING)

    # Off, the corner has fewer matches than without: the unit of length is not that of the first registration.
    inputs = {"ties": (points, targets + offset, covariances / size), "twist": np.zeros(6), "covariance": given / size}
    inputs = jax.tree.map(jnp.asarray, inputs)
    compiled = check_gradient(lambda inputs: weigh(result(inputs).matrix), inputs)
    if scene == "corner":
        alone = mcg.register(source, target, mcg.GICP(1e-2), init=truth, max_distance=gate)
        assert result(inputs).num_inliers < alone.num_inliers
        assert_alike(eager_gradient(lambda inputs: weigh(result(inputs).matrix), inputs), compiled(inputs), 1e-6)


def test_priors_of_a_batch(corner):
    """Each pair as by `register`, by threads, by an executor and where lanes would run; with its derivatives."""
    source, target, truth = corner
    away = truth @ motion((0.01, 0, 0, 0, 0.01, 0))
    priors = [(away, 1e-6 * np.eye(6)), None, (jaxlie.SE3.from_matrix(away), np.eye(5))]
    alone = [mcg.register(source, target, mcg.GICP(), prior=prior, **OPTIONS) for prior in priors[:2]]
    for how in ({}, {"executor": ThreadPoolExecutor(1)}, {"search": mcg.DenseSearch()}):
        with pytest.warns(mcg.PairWarning, match=r"pair 2: prior: covariance: expected shape \(6, 6\)"):
            found = mcg.register_batch([source] * 3, target, mcg.GICP(), priors=iter(priors), **OPTIONS, **how)
        for result, expected in zip(found[:2], alone, strict=True):
            np.testing.assert_allclose(result.matrix, expected.matrix, atol=1e-5 if "search" in how else 0)
        assert found[2].status is mcg.Status.INVALID_INPUT
    refused(lambda: mcg.register_batch([source], target, mcg.GICP(), priors=priors), "sources", "3 priors")
    refused(lambda: mcg.register_batch([source], target, mcg.GICP(), priors=5), "priors")
    given = {"priors": [None], "hold_unconstrained": False}
    refused(lambda: mcg.register_batch([source], target, mcg.GICP(), **given), "hold_unconstrained")


@pytest.mark.slow
def test_derivatives_of_a_batch_with_priors(corner):
    source, target, truth = corner
    points, spread, origin = source.points, 1e-6 * np.eye(6), source.origin

    def alone(points, spread):
        moved = source.replace(points=points)
        return weigh(mcg.register(moved, target, mcg.GICP(), prior=(truth, spread), **OPTIONS).matrix)

    def batch(points, spread, origin=origin, executor=None):
        moved, options = source.replace(points=points, origin=origin), {"executor": executor} | OPTIONS
        return weigh(mcg.register_batch([moved], [target], mcg.GICP(), priors=[(truth, spread)], **options)[0].matrix)

    expected = jax.grad(alone, (0, 1))(points, spread)
    for one, other in zip(expected, jax.grad(batch, (0, 1))(points, spread), strict=True):
        np.testing.assert_array_equal(one, other)
    assert np.abs(expected[1]).max() > 0
    with ThreadPoolExecutor(1) as executor:
        elsewhere = partial(batch, executor=executor)
        by_points = jax.grad(elsewhere)(points, spread)
        refused(lambda: jax.grad(elsewhere, (0, 1))(points, spread), "priors[0]")
        by_origin = jax.grad(partial(elsewhere, points, spread))
        refused(lambda: by_origin(jnp.zeros(3)), "priors[0]", "concrete origins")
    np.testing.assert_allclose(by_points, expected[0], rtol=1e-3, atol=1e-5 * np.abs(expected[0]).max())


@pytest.mark.slow
def test_batches_of_tie_points(corner):
    """Under vmap and jit, the answers are those of the host."""
    source, target, truth = corner
    several = [tie_points(truth, source.points, 2e-3, seed=seed) for seed in range(2)]

    def pose(given):
        result = mcg.register(source, target, mcg.GICP(), tie_points=given, **OPTIONS)
        return result.matrix, result.deviations, result.status_code

    lanes = jax.jit(jax.vmap(pose))(jax.tree.map(lambda *arrays: jnp.stack(arrays), *several))
    for given, matrix, deviations, code in zip(several, *lanes, strict=True):
        expected, expected_deviations, status = pose(given)
        np.testing.assert_allclose(matrix, expected, atol=5e-5)
        np.testing.assert_allclose(deviations, expected_deviations, rtol=0.02)
        assert code == status


# Use


def test_other_numbers_of_tie_points_compile_nothing(corner):
    source, target, truth = corner
    given = tie_points(truth, source.points, 0.01)
    assert mcg.register(source, target, mcg.GICP(), tie_points=given, **OPTIONS).covariance.shape == (6, 6)
    with compilations() as found:
        for count in (1, 4, 300):
            given = tie_points(truth, source.points, 0.01, count=count)
            result = mcg.register(source, target, mcg.GICP(), tie_points=given, **OPTIONS)
            prior = measured(truth, np.full(6, 0.1 / count))
            mcg.register(source, target, mcg.GICP(), tie_points=given, prior=prior, **OPTIONS)
            assert result.covariance.shape == (6, 6)
    assert not found


def test_malformed_arguments_are_named(corner):
    source, target, truth = corner
    points, targets, covariances = tie_points(truth, source.points, 0.01)
    negative, skewed = covariances.copy(), covariances.copy()
    negative[1] *= -1
    skewed[2, 0, 1] += 1e-3
    for named, shown, *given in (
        ("tie_points", "source_points", points, targets),
        ("tie_points: source_points", "numbers", "abc", targets, covariances),
        ("tie_points: source_points", "(6, 3)", points[:, :2], targets, covariances),
        ("tie_points: target_points", "(6, 3)", points, targets[:4], covariances),
        ("tie_points: target_points", "finite", points, targets * np.nan, covariances),
        ("tie_points: covariances", "finite", points, targets, covariances * np.inf),
        ("tie_points: covariances", "(6, 3, 3)", points, targets, 0.1),
        ("tie_points: covariances", "definite", points, targets, negative),
        ("tie_points: covariances", "symmetric", points, targets, skewed),
        ("prior", "(pose, covariance)", *truth),
        ("prior: pose", "rigid", 2 * truth, np.eye(6)),
        ("prior: covariance", "(6, 6)", truth, np.eye(3)),
        ("prior: covariance", "semidefinite", truth, -np.eye(6)),
        ("prior: covariance", "finite", truth, np.full((6, 6), np.nan)),
    ):
        options = {named.split(":")[0]: tuple(given)}
        refused(lambda options=options: mcg.register(source, target, mcg.GICP(), **options), named, shown)
    free = {"prior": (truth, np.eye(6)), "hold_unconstrained": False}
    refused(lambda: mcg.register(source, target, mcg.GICP(), **free), "hold_unconstrained")


# Calibration


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["room", "corridor"])
def test_covariances_are_right(scene):
    """40 simulated pairs: normalised error squared, and errors smaller than those of each source alone."""
    errors, nees, converged = simulate(scene, 40)
    assert converged == 1 and all(0.5 < value < 2 for value in nees.values()), nees
    for name in ("tie points", "prior"):
        assert errors[name] < min(errors["clouds alone"], errors[f"{name} alone"]), errors


@pytest.mark.parametrize("degrees", [80, 150])
def test_a_prior_is_reached_from_initial_poses_far_off(degrees):
    """A round room, whose yaw only the prior knows."""
    rng, clouds = np.random.default_rng(0), []
    radii = np.append(np.full(1500, 2.0), 2 * np.sqrt(rng.uniform(size=1500)))
    heights = np.where(radii == 2, rng.uniform(0, 2, 3000), 0)
    for _ in range(2):
        angles = rng.uniform(0, 2 * np.pi, 3000)
        points = np.stack([radii * np.cos(angles), radii * np.sin(angles), heights], axis=1)
        clouds.append(mcg.preprocess(points + 0.002 * rng.normal(size=points.shape)))
    options = {"init": motion([0, 0, 0, 0, 0, np.radians(degrees)]), "prior": (np.eye(4), 4e-4 * np.eye(6))}
    result = mcg.register(*clouds, mcg.GICP(), **options, **OPTIONS)
    assert result.converged and np.abs(twist_error(result.matrix, np.eye(4))).max() < 2e-3


@pytest.mark.parametrize("far", [1e5, 5e6])
def test_results_at_large_coordinates_are_priors(corner, far):
    source, target, truth = corner
    move = motion((0.1 * far, far, 10, 0, 0, 0))
    clouds = [np.asarray(cloud.points, np.float64) + move[:3, 3] for cloud in (source, target)]
    there = move @ truth @ np.linalg.inv(move)
    alone = mcg.register(*clouds, mcg.GICP(), init=there, **OPTIONS)
    both = mcg.register(*clouds, mcg.GICP(), init=there, prior=(alone.matrix, alone.covariance), **OPTIONS)
    assert both.converged
    found, expected = (np.linalg.inv(move) @ result.matrix @ move for result in (both, alone))
    assert np.abs(twist_error(found, expected)).max() < 1e-4
    np.testing.assert_allclose(both.deviations, alone.deviations / np.sqrt(2), rtol=0.02)
    # Independent deviations at the far origin: at the clouds, rotation and position are strongly correlated.
    weak = mcg.register(*clouds, mcg.GICP(), init=there, prior=(there, 1e-4 * np.eye(6)), **OPTIONS)
    error = twist_error(np.linalg.inv(move) @ weak.matrix @ move, truth)
    assert weak.converged and np.all(np.abs(error) < 5 * alone.deviations.max())


def test_equal_clouds_overrule_a_weak_prior(corner):
    cloud = corner[0]
    result = mcg.register(cloud, cloud, mcg.GICP(), prior=(motion(1e-3 * np.ones(6)), 1e-4 * np.eye(6)), **OPTIONS)
    assert result.converged and np.abs(twist_error(result.matrix, np.eye(4))).max() < 1e-5


def test_tie_points_far_from_the_clouds_leave_no_matches(corner):
    source, target, truth = corner
    away = motion((30, 0, 0, 0, 0, 0)) @ truth
    result = mcg.register(source, target, mcg.GICP(), tie_points=tie_points(away, source.points, 1e-6), **OPTIONS)
    assert result.status is mcg.Status.TOO_FEW_CORRESPONDENCES and np.isnan(result.covariance).all()
