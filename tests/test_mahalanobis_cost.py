"""The cost, its kernels and its gradients, against NumPy and central differences."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax.extend import KERNELS
from tests import reference as ref
from tests.compilations import compilations
from tests.differences import GATE, TO_ROUNDING
from tests.precision import cached, in_both_precisions, in_float64, tolerance
from tests.refusals import refused
from tests.scenes import motion

pytestmark = in_float64
in_float32 = pytest.mark.precision("float32")
N, K, ROWS = 150, 12, 160
EPSILON, FLOOR, REGULARISATION = 0.02, 1e-3, 1e-6
LAMBDA = np.array([[0.5, 0.2, 0.0], [0.2, 0.4, -0.1], [0.0, -0.1, 0.6]])
T = ref.pose([0.05, -0.08, 0.1], [0.03, 0.05, -0.04])
SCALE = 0.4
METHODS = {
    "PointToPoint": mcg.PointToPoint,
    "PointToPlane": mcg.PointToPlane,
    "ColorICP": lambda: mcg.ColorICP(0.2),
    "GICP": lambda: mcg.GICP(EPSILON),
    "MultiChannelGICP": lambda: mcg.MultiChannelGICP(LAMBDA, 0.2, EPSILON, FLOOR),
}


def ready(*arrays, **covariances):
    return mcg.preprocess(mcg.PointCloud(*arrays, **covariances), num_neighbors=K).pad(ROWS)


@cached
def problem():
    """Two clouds, their neighbours, and matches of which some are none."""
    raw = [ref.scene(N, 3, seed) for seed in (0, 1)]
    neighbors = [ref.nearest(points, points, K) for points, _ in raw]
    clouds = [ready(*arrays) for arrays in raw]
    (a, ca), (b, cb) = raw
    matched = ref.match(a, b, T, 0.3, ca, cb, 0.2)
    assert 30 < np.sum(matched >= 0) < 140
    rows = np.full(ROWS, -1)
    rows[:N] = matched
    # What has no match points at padding, of all rows the least useful.
    matches = mcg.Correspondences(
        indices=jnp.asarray(np.where(rows >= 0, rows, ROWS - 1), jnp.int32),
        distances=jnp.zeros(ROWS, clouds[0].points.dtype),
        valid=jnp.asarray(rows >= 0),
    )
    return raw, neighbors, clouds, matches, matched


def information(name, source, target, neighbors, channel_covariance=LAMBDA, epsilon=EPSILON):
    """The reference's M, from points and channels of both clouds."""
    if name in ("PointToPoint", "ColorICP"):
        return ref.identity_information
    if name == "PointToPlane":
        return ref.plane_information([ref.normal(target[0][row]) for row in neighbors[1]])
    sides = zip((source, target), neighbors, strict=True)
    if name == "GICP":
        return ref.pair_information(*(ref.gicp_covariances(side[0], rows, epsilon) for side, rows in sides))
    return ref.pair_information(
        *(
            ref.multi_channel_covariances(*side, rows, channel_covariance, epsilon, FLOOR, REGULARISATION)
            for side, rows in sides
        )
    )


def rho_of(kernel):
    """The reference's ρ at the scale of the tests."""
    return None if kernel is None else functools.partial(ref.ROBUST[kernel], c=SCALE)


def reference_cost(name, pose=T, source=None, target=None, rho=None, **numbers):
    raw, neighbors, _, _, matched = problem()
    source, target = source or raw[0], target or raw[1]
    return ref.cost(pose, source[0], target[0], matched, information(name, source, target, neighbors, **numbers), rho)


@in_both_precisions
@pytest.mark.parametrize(
    ("name", "kernel"), [*((name, None) for name in METHODS), *(("MultiChannelGICP", kernel) for kernel in KERNELS)]
)
def test_cost_against_the_reference(name, kernel):
    _, _, clouds, matches, _ = problem()
    robust = None if kernel is None else KERNELS[kernel](SCALE)
    actual = mcg.mahalanobis_cost(T, *clouds, matches, METHODS[name](), robust=robust)
    assert actual.dtype == clouds[0].points.dtype
    assert float(actual) == pytest.approx(reference_cost(name, rho=rho_of(kernel)), rel=tolerance(1e-4, 1e-10))


@pytest.mark.parametrize("name", ["GICP", "MultiChannelGICP"])
def test_the_determinant_against_the_reference(name):
    """Σ dᵀMd + log det (C^B + R C^A Rᵀ): twice a negative log-likelihood, up to a constant."""
    raw, neighbors, clouds, matches, matched = problem()
    weigh = information(name, *raw, neighbors)
    determinants = [np.linalg.slogdet(weigh(i, j, T[:3, :3]))[1] for i, j in enumerate(matched) if j >= 0]
    actual = mcg.mahalanobis_cost(T, *clouds, matches, METHODS[name](), log_determinant=True)
    assert float(actual) == pytest.approx(reference_cost(name) - sum(determinants), rel=tolerance(1e-4, 1e-10))


@pytest.mark.parametrize("name", ["PointToPlane", "ColorICP", "MultiChannelGICP"])
def test_soft_matches_against_the_reference(name):
    """Each candidate counts by exp(−½ (distance/τ)²), in position and weighted channels, over its point's sum."""
    raw, neighbors, clouds, _, _ = problem()
    temperature, gate, num_candidates = 0.15, 0.3, 4
    found = mcg.find_correspondences(*clouds, T, METHODS[name](), max_distance=gate, num_candidates=num_candidates)
    actual = mcg.mahalanobis_cost(T, *clouds, found, METHODS[name](), robust=mcg.Cauchy(SCALE), temperature=temperature)
    (a, ca), (b, cb) = raw
    alpha = 0.0 if name == "PointToPlane" else 0.2
    moved = a @ T[:3, :3].T + T[:3, 3]
    rows = ref.nearest(np.hstack([moved, alpha * ca]), np.hstack([b, alpha * cb]), num_candidates)
    weigh, expected = information(name, *raw, neighbors), 0.0
    for i, candidates in enumerate(rows):
        kept = [j for j in candidates if np.linalg.norm(b[j] - moved[i]) <= gate]
        far = np.array([np.sum((b[j] - moved[i]) ** 2) + np.sum((alpha * (cb[j] - ca[i])) ** 2) for j in kept])
        shares = np.exp(-0.5 * far / temperature**2)
        for j, share in zip(kept, shares / shares.sum(), strict=True):
            d = b[j] - moved[i]
            expected += share * ref.ROBUST["cauchy"](d @ weigh(i, j, T[:3, :3]) @ d, SCALE)
    assert float(actual) == pytest.approx(expected, rel=tolerance(1e-4, 1e-10))


def test_at_large_coordinates_the_cost_is_the_same():
    utm = np.array([512_345.6, 5_403_210.9, 312.3])
    raw, _, _, matches, _ = problem()
    clouds = [ready(points + utm, channels) for points, channels in raw]
    pose = motion((*utm, 0, 0, 0)) @ T @ motion((*-utm, 0, 0, 0))
    actual = mcg.mahalanobis_cost(pose, *clouds, matches, METHODS["MultiChannelGICP"](), robust=mcg.Cauchy(SCALE))
    expected = reference_cost("MultiChannelGICP", rho=rho_of("cauchy"))
    assert float(actual) == pytest.approx(expected, rel=tolerance(1e-3, 1e-6))


SQUARES = np.concatenate([[0.0, 1e-12], np.geomspace(1e-4, 1e4, 60)])


@jax.jit
def values_weights_and_slopes(kernel, squares):
    slopes = jax.vmap(jax.grad(lambda s2: kernel.rho(s2[None])[0]))(squares)
    return kernel.rho(squares), kernel.weight(squares), slopes


@in_both_precisions
@pytest.mark.parametrize("scale", [0.1, 1.0, 7.0])
@pytest.mark.parametrize("name", KERNELS)
def test_kernels_against_the_reference(name, scale):
    """And the weight is the derivative of ρ."""
    values, weights, slopes = values_weights_and_slopes(KERNELS[name](scale), SQUARES)
    expected = [ref.ROBUST[name](s2, scale) for s2 in SQUARES]
    np.testing.assert_allclose(values, expected, rtol=tolerance(2e-5, 1e-9), atol=tolerance(3e-7, 1e-15) * scale**2)
    # Away from the corners of Huber and Tukey, where a central difference straddles two branches.
    away = (SQUARES > 1e-5) & (np.abs(SQUARES / scale**2 - 1) > 0.01)
    squares, step = SQUARES[away], 3e-4 * SQUARES[away]
    expected = [
        (ref.ROBUST[name](s2 + h, scale) - ref.ROBUST[name](s2 - h, scale)) / (2 * h)
        for s2, h in zip(squares, step, strict=True)
    ]
    np.testing.assert_allclose(weights[SQUARES == 0], 1)
    np.testing.assert_allclose(weights[away], expected, rtol=tolerance(1e-4, 1e-5), atol=tolerance(1e-6, 1e-8))
    np.testing.assert_allclose(slopes[away], weights[away], rtol=tolerance(1e-4, 1e-10), atol=1e-6)


@in_both_precisions
@pytest.mark.parametrize("name", KERNELS)
def test_gradients_of_kernels_are_finite(name):
    kernel, squares = KERNELS[name](1.0), jnp.array([0.0, 1.0, 1e-30, 1e30])
    for function in (kernel.rho, kernel.weight):
        assert np.isfinite(jax.jit(jax.grad(lambda s2, function=function: jnp.sum(function(s2))))(squares)).all()


@pytest.mark.parametrize("name", KERNELS)
def test_a_scale_that_makes_no_sense(name):
    for scale in (0, -1.0, np.nan, np.inf, np.ones(2)):
        refused(lambda scale=scale: KERNELS[name](scale), "scale")


ARGUMENTS = ("pose", "source points", "target points", "source channels", "target channels", "Λ", "ε")


@functools.partial(jax.jit, static_argnums=0)
def value_and_gradients(name, *arguments):
    _, _, clouds, matches, _ = problem()

    def value(pose, source_points, target_points, source_channels, target_channels, channel_covariance, epsilon):
        source = clouds[0].replace(points=source_points, channels=source_channels)
        target = clouds[1].replace(points=target_points, channels=target_channels)
        method = METHODS[name]()
        if name == "GICP":
            method = mcg.GICP(epsilon)
        elif name == "MultiChannelGICP":
            method = mcg.MultiChannelGICP(channel_covariance, 0.2, epsilon, FLOOR)
        return mcg.mahalanobis_cost(pose, source, target, matches, method, robust=mcg.Cauchy(SCALE))

    return jax.value_and_grad(value, argnums=tuple(range(7)))(*arguments)


@cached
def gradients(name):
    _, _, (source, target), _, _ = problem()
    numbers = (source.points, target.points, source.channels, target.channels, LAMBDA, EPSILON)
    _, found = value_and_gradients(name, *(jnp.asarray(a, source.points.dtype) for a in (T, *numbers)))
    return dict(zip(ARGUMENTS, found, strict=True))


@pytest.mark.parametrize("argument", ARGUMENTS)
@pytest.mark.parametrize("name", ["PointToPlane", "ColorICP", "GICP", "MultiChannelGICP"])
def test_gradients_against_differences_of_the_reference(name, argument):
    (a, ca), (b, cb) = problem()[0]
    gradient, which = np.asarray(gradients(name)[argument], float), ARGUMENTS.index(argument)
    at = (T, a, b, ca, cb, LAMBDA, np.array(EPSILON))
    rng = np.random.default_rng(which)
    direction = rng.normal(size=at[which].shape)
    if argument == "pose":
        # A pose that leaves SO(3) has no cost to speak of: along the group, δT = ξ^ T.
        w = rng.normal(size=3)
        hat = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        direction[:3], direction[3] = np.hstack([hat @ T[:3, :3], rng.normal(size=(3, 1))]), 0
    if argument == "Λ":
        direction += direction.T

    def value(changed):
        x = [*at[:which], changed, *at[which + 1 :]]
        numbers = {"channel_covariance": x[5], "epsilon": x[6]}
        return reference_cost(name, x[0], (x[1], x[3]), (x[2], x[4]), rho_of("cauchy"), **numbers)

    expected = ref.difference(value, at[which], direction, 1e-5 * (EPSILON if argument == "ε" else 0.1))
    if gradient.shape[:1] == (ROWS,):
        np.testing.assert_array_equal(gradient[N:], 0)
        gradient = gradient[:N]
    assert np.sum(gradient * direction) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_gradients_are_zero_by_what_a_method_does_not_use_alone():
    sensitive = {name: {a for a, g in gradients(name).items() if np.any(g)} for name in METHODS}
    points = {"pose", "source points", "target points"}
    assert sensitive["PointToPoint"] == sensitive["ColorICP"] == sensitive["PointToPlane"] == points
    assert sensitive["GICP"] == points | {"ε"}
    assert sensitive["MultiChannelGICP"] == set(ARGUMENTS)


def test_rows_without_a_match_add_nothing():
    """Whatever they point at, and whatever lies there, even NaN: the value and the gradient do not move."""
    _, _, (source, target), matches, matched = problem()
    free = np.flatnonzero(matched < 0)[:5]
    elsewhere = replace(matches, indices=matches.indices.at[free].set(3))
    none = replace(matches, valid=jnp.zeros(ROWS, bool))
    for method in (make() for make in METHODS.values()):
        costs = [mcg.mahalanobis_cost(T, source, target, rows, method) for rows in (matches, elsewhere, none)]
        np.testing.assert_allclose(costs[1], costs[0], rtol=1e-6)
        assert costs[2] == 0

    @jax.jit
    @jax.value_and_grad
    def cost(points):
        moved = source.replace(points=points)
        return mcg.mahalanobis_cost(T, moved, target, matches, mcg.PointToPoint(), robust=mcg.Huber(SCALE))

    nowhere = jnp.asarray(source.points).at[free].set(jnp.nan)
    for actual, expected in zip(cost(nowhere), cost(source.points), strict=True):
        np.testing.assert_array_equal(actual, expected)


def test_padding_of_given_covariances_adds_nothing():
    """Their padding is zero, and a pair of two such rows has no inverse: no NaN may come of it."""
    raw, _, _, matches, _ = problem()
    given = np.tile(np.diag([1.0, 1.0, 0.01]), (N, 1, 1))
    source, target = (ready(points, covariances=given) for points, _ in raw)

    def cost(points, covariances):
        moved = source.replace(points=points, covariances=covariances)
        return mcg.mahalanobis_cost(T, moved, target, matches, mcg.GICP())

    with compilations() as programs:
        value, gradients = jax.value_and_grad(cost, argnums=(0, 1))(source.points, source.covariances)
    # Outside of `jit` too, not each operation alone.
    assert len(programs) < 10
    assert np.isfinite(value)
    for gradient in gradients:
        assert np.isfinite(gradient).all()
        np.testing.assert_array_equal(gradient[N:], 0)


def test_matches_of_another_cloud_and_clouds_that_do_not_fit_are_refused():
    _, _, clouds, matches, _ = problem()
    refused(lambda: mcg.mahalanobis_cost(T, clouds[0].pad(200), clouds[1], matches, mcg.GICP()), "matches")
    refused(lambda: mcg.mahalanobis_cost(T, *clouds, matches, mcg.GICP), "method")
    other = clouds[1].replace(channels=clouds[1].channels[:, :1])
    refused(lambda: mcg.mahalanobis_cost(T, clouds[0], other, matches, mcg.MultiChannelGICP()), "channels")


def test_neighbourhoods_of_large_clouds_are_summed_inside_jit():
    """Block by block beyond 16,000 rows."""
    raw = [ref.scene(16_500, 0, seed)[0] for seed in (0, 1)]
    source, target = (mcg.preprocess(points, None) for points in raw)
    matches = mcg.find_correspondences(source, target, T, mcg.PointToPoint(), max_distance=0.3, num_candidates=3)

    def cost(points):
        moved = source.replace(points=points)
        return mcg.mahalanobis_cost(T, moved, target, matches, mcg.PointToPoint(), temperature=0.1)

    np.testing.assert_allclose(jax.jit(cost)(source.points), cost(source.points), rtol=1e-9)


def test_a_batch_is_its_lanes():
    _, _, clouds, matches, _ = problem()
    poses = jnp.asarray(np.stack([T, ref.pose([0.02, 0, 0], [0, 0.1, 0]), np.eye(4)]))
    cost = jax.value_and_grad(lambda pose: mcg.mahalanobis_cost(pose, *clouds, matches, mcg.PointToPlane()))
    values, slopes = jax.jit(jax.vmap(cost))(poses)
    np.testing.assert_allclose(values, [reference_cost("PointToPlane", np.asarray(pose)) for pose in poses], rtol=1e-6)
    assert np.isfinite(slopes).all()


@pytest.mark.parametrize("name, kernel", [("PointToPlane", None), *(("PointToPoint", name) for name in KERNELS)])
def test_estimate_pose_ends_where_the_cost_is_least(name, kernel):
    """Of methods whose M does not depend on the pose: the gradient of the cost by a motion is 0 there."""
    _, _, clouds, matches, _ = problem()
    options = {"robust": None if kernel is None else KERNELS[kernel](SCALE)}
    least = mcg.estimate_pose(*clouds, matches, METHODS[name](), init=T, **options, **TO_ROUNDING).matrix

    def cost(twist, pose):
        moved = jaxlie.SE3.from_matrix(pose) @ jaxlie.SE3.exp(twist)
        return mcg.mahalanobis_cost(moved, *clouds, matches, METHODS[name](), **options)

    slopes = [jax.grad(cost)(jnp.zeros(6), jnp.asarray(pose)) for pose in (least, T)]
    assert np.abs(slopes[0]).max() < 1e-6 * np.abs(slopes[1]).max()


@in_float32
def test_candidates_need_a_temperature(noisy):
    source, target, _ = noisy
    method = mcg.GICP(1e-2)
    matches = mcg.find_correspondences(source, target, None, method, max_distance=GATE, num_candidates=2)
    of_pair = source, target, matches, method
    refused(lambda: mcg.estimate_pose(*of_pair), "temperature", 2, None)
    refused(lambda: mcg.mahalanobis_cost(np.eye(4), *of_pair, temperature=0.0), "temperature", 0.0)
    options = {"max_distance": GATE, "num_candidates": 0}
    refused(lambda: mcg.find_correspondences(source, target, None, method, **options), "num_candidates", 0)


@in_float32
def test_the_determinant_keeps_learned_covariances_from_growing(noisy):
    """Without it, a larger ε is always better; with it, there is a best one."""
    source, target, _ = noisy
    matches = mcg.find_correspondences(source, target, motion(), mcg.GICP(), max_distance=GATE)

    def loss(log_epsilon, method=None, log_determinant=True):
        method = mcg.GICP(jnp.exp(log_epsilon)) if method is None else method
        return mcg.mahalanobis_cost(motion(), source, target, matches, method, log_determinant=log_determinant)

    least, usual, most = np.log([1e-4, 1e-2, 1.0])
    assert all(jax.grad(loss)(epsilon, None, False) < 0 for epsilon in (least, usual, most))
    assert jax.grad(loss)(least) < 0 < jax.grad(loss)(most)
    refused(lambda: loss(0, mcg.PointToPlane()), "log_determinant", "PointToPlane")
    # M of a residual of rank 1 has no determinant.
    refused(lambda: loss(0, mcg.MultiChannelGICP(photometric=True)), "log_determinant", "photometric=True")
