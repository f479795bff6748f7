"""Gradients of concrete clouds, outside `jit`: against central differences, in every mode; nothing compiled anew."""

import warnings
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import Status
from tests.compilations import compilations
from tests.differences import (
    CASES,
    GATE,
    TO_ROUNDING,
    case,
    check_eager_gradient,
    clouds_with,
    directional_errors,
    inputs_of,
    weigh,
)
from tests.precision import in_float64
from tests.refusals import refused
from tests.scenes import motion, pair, room_corner

pytestmark = in_float64
METHOD, _ = case("mc-gicp")


@pytest.fixture(scope="module")
def clouds(noisy):
    return noisy[:2]


def posed(clouds, method=METHOD, **options):
    """A scalar that depends on all entries of the pose, registered to rounding. Its differences are over hard matches,
    as those of the registration itself do not change over small steps."""
    settings = {"max_distance": GATE, "soft_matches": False} | TO_ROUNDING
    return weigh(mcg.register(*clouds, method, **settings | options).matrix)


@pytest.mark.parametrize("name", CASES)
def test_every_input_of_every_method(name, clouds):
    method, robust = case(name)
    start = mcg.register(*clouds, method, robust=robust, max_distance=GATE, **TO_ROUNDING).matrix

    def loss(inputs):
        return posed(clouds_with(inputs, *clouds), inputs["method"], robust=inputs["robust"], init=start)

    check_eager_gradient(loss, inputs_of(*clouds, method, robust))


@pytest.mark.slow
def test_a_soft_assignment_has_gradients_by_weights_and_temperature(clouds):
    method, robust = mcg.ColorICP(0.3), mcg.Cauchy(0.5)
    matches = mcg.find_correspondences(*clouds, motion(), method, max_distance=GATE, num_candidates=3)

    def loss(inputs):
        options = {"robust": inputs["robust"], "temperature": inputs["temperature"], **TO_ROUNDING}
        return weigh(mcg.estimate_pose(*clouds_with(inputs, *clouds), matches, inputs["method"], **options).matrix)

    gradient = check_eager_gradient(loss, inputs_of(*clouds, method, robust) | {"temperature": jnp.asarray(0.1)})
    assert gradient["method"].channel_weights != 0 and gradient["temperature"] != 0


@pytest.mark.parametrize("of", ["register", "register_batch", "estimate_pose", "mahalanobis_cost"])
def test_origins_of_both_clouds(of, clouds):
    """Poses in the user's frame depend on the origins, and so does the cost of a pose; as inside `jit`."""
    method, origins = mcg.PointToPoint(), (np.array([30.0, -20, 10]), np.array([10.0, 40, -20]))
    inputs = dict(zip(("source origin", "target origin"), map(jnp.asarray, origins), strict=True))
    inputs |= {"source points": clouds[0].points}
    init = motion()
    init[:3, 3] += origins[1] - init[:3, :3] @ origins[0]
    matches = mcg.find_correspondences(*clouds_with(inputs, *clouds), init, method, max_distance=GATE)
    # Away from the minimum of the cost, so that its gradient is not 0.
    pose = init @ motion((0.01,) * 6)

    def loss(inputs):
        pair = clouds_with(inputs, *clouds)
        if of == "mahalanobis_cost":
            return mcg.mahalanobis_cost(pose, *pair, matches, method)
        if of == "estimate_pose":
            result = mcg.estimate_pose(*pair, matches, method, init=init, **TO_ROUNDING)
        elif of == "register_batch":
            (result,) = mcg.register_batch([pair[0]], [pair[1]], method, init=[init], max_distance=GATE, **TO_ROUNDING)
        else:
            result = mcg.register(*pair, method, init=init, max_distance=GATE, **TO_ROUNDING)
        assert f"{result.status.name}: translation" in repr(result)
        return weigh(result.matrix) + weigh(result.T_target_source.as_matrix()[::-1])

    gradient = check_eager_gradient(loss, inputs)
    if of == "mahalanobis_cost":
        for name, expected in jax.jit(jax.grad(loss))(inputs).items():
            np.testing.assert_allclose(gradient[name], expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


def test_a_zero_origin_of_a_raw_cloud_has_a_gradient(clouds):
    """As `eqx.filter_grad` by a cloud has it: to move the origin is to move all points."""
    source, target = (mcg.PointCloud(cloud.points) for cloud in clouds)
    target = mcg.preprocess(target, None)

    def loss(inputs):
        return posed((mcg.preprocess(source.replace(**inputs), None), target), mcg.PointToPoint())

    check_eager_gradient(loss, {"origin": jnp.zeros(3)})


@pytest.mark.slow
def test_the_photometric_term_has_the_gradient_of_jit(clouds):
    """Its scales are constants to autodiff, which differences would see."""
    method = mcg.MultiChannelGICP(0.05, 0.3, photometric=True)

    def loss(points, search=None):
        return posed((clouds[0].replace(points=points), clouds[1]), method, search=search)

    expected = jax.jit(jax.grad(lambda points: loss(points, mcg.DenseSearch())))(clouds[0].points)
    np.testing.assert_allclose(jax.grad(loss)(clouds[0].points), expected, atol=1e-9 * np.abs(expected).max())


def test_given_covariances(clouds):
    roots = np.random.default_rng(0).normal(size=(2, 400, 3, 3))
    source, target = (
        cloud.replace(covariances=0.1 * root @ root.swapaxes(1, 2) + 0.1 * np.eye(3))
        for cloud, root in zip(clouds, roots, strict=True)
    )
    inputs = {"source points": source.points}
    inputs |= {"source covariances": source.covariances, "target covariances": target.covariances}
    check_eager_gradient(lambda inputs: posed(clouds_with(inputs, source, target), mcg.GICP()), inputs)


@pytest.mark.slow
def test_tie_points_and_a_prior(clouds):
    """By what was measured, and its variances, on which the weights of the matches from a first registration do not
    depend."""
    points = np.asarray(clouds[0].points[:5])

    @jax.jit
    def measurements(inputs):
        ties = inputs["tie source"], inputs["tie target"], inputs["tie variance"] * jnp.tile(jnp.eye(3), (5, 1, 1))
        pose = jaxlie.SE3.from_matrix(motion()) @ jaxlie.SE3.exp(inputs["prior twist"])
        return ties, (pose, inputs["prior variance"] * jnp.eye(6))

    def loss(inputs):
        ties, prior = measurements(inputs)
        return posed(clouds, mcg.PointToPoint(), tie_points=ties, prior=prior, max_distance=0.15)

    # So far off that fewer points are matched than without: the unit of length is not that of the first registration.
    target = points @ motion()[:3, :3].T + motion()[:3, 3] + 0.05
    inputs = {"tie source": points, "tie target": target, "tie variance": 1e-3}
    inputs |= {"prior twist": np.zeros(6), "prior variance": 1e-3}
    check_eager_gradient(loss, jax.tree.map(jnp.asarray, inputs))


def test_gains_of_equalized_channels_are_constants(clouds):
    """Twice the contrast: a gradient half as large."""
    source, target = clouds

    def loss(channels):
        return posed((source.replace(channels=channels), target), equalize_channels=True)

    def jacobian(channels):
        options = {"max_distance": GATE, "soft_matches": False, "equalize_channels": True, **TO_ROUNDING}
        return mcg.register(source.replace(channels=channels), target, METHOD, **options).jacobian("source", "channels")

    for derivative in (jax.grad(loss), jacobian):
        once, twice = (derivative(gain * source.channels + 0.3) for gain in (1.0, 2.0))
        assert np.any(once)
        np.testing.assert_allclose(twice, 0.5 * once, rtol=1e-6, atol=1e-9)


def test_preprocessing_has_a_derivative():
    """Raw points, with rows to drop and missing channels, through the voxels."""
    points, channels = room_corner(900, noise=0.02, seed=1)
    points = (points - motion()[:3, 3]) @ motion()[:3, :3]
    points[7] = np.nan
    known = np.random.default_rng(3).random(channels.shape) > 0.1
    target = mcg.preprocess(mcg.PointCloud(*room_corner(900, noise=0.02, seed=2)), 0.1)
    others = np.arange(900) != 7
    inputs = {"points": points[others], "channels": channels}

    def loss(inputs):
        # The NaN stays where it is.
        whole = jnp.asarray(points).at[others].set(inputs["points"])
        cloud = mcg.PointCloud(whole, inputs["channels"], channel_valid=known)
        return posed((mcg.preprocess(cloud, 0.1), target), max_distance=0.5)

    with pytest.warns(UserWarning, match="1 of 900"):
        gradient = jax.tree.map(np.asarray, jax.grad(loss)(inputs))
        assert not np.any(gradient["channels"][~known]) and not np.any(gradient["channels"][7])
        for name, actual, expected in directional_errors(loss, inputs, gradient):
            assert abs(actual - expected) <= 1e-5 * max(abs(expected), 1e-2), name


def test_means_of_voxels_have_a_forward_derivative():
    """They are linear in points and channels, as long as no point changes its voxel. Padding, here among the points,
    does not count."""
    points, channels = room_corner(300, noise=0.02, seed=1)
    known, valid = (np.random.default_rng(3).random(shape) > 0.1 for shape in (channels.shape, 300))

    def means(step):
        cloud = mcg.PointCloud(points + step * directions[0], channels + step * directions[1], channel_valid=known)
        found = mcg.preprocess(cloud.replace(valid=valid), 0.3)
        return found.points, found.channels

    directions = [np.random.default_rng(4).normal(size=array.shape) for array in (points, channels)]
    _, slopes = jax.jvp(means, (0.0,), (1.0,))
    for slope, plus, minus in zip(slopes, means(1e-6), means(-1e-6), strict=True):
        np.testing.assert_allclose(slope, (plus - minus) / 2e-6, atol=1e-8)


def test_all_modes_agree_and_second_derivatives_are_refused(clouds):
    source, target = clouds

    def pose(channels):
        return mcg.register(source.replace(channels=channels), target, METHOD, max_distance=GATE).centred.wxyz_xyz

    channels, direction = source.channels, np.random.default_rng(0).normal(size=source.channels.shape)
    jacobian = jax.jacrev(pose)(channels)
    assert jacobian.shape == (7, *channels.shape)
    expected = np.tensordot(jacobian, direction, 2)
    _, forward = jax.jvp(pose, (channels,), (direction,))
    _, linear = jax.linearize(pose, channels)
    few = jax.jacfwd(lambda scale: pose(channels + scale * direction))(jnp.zeros(()))
    for found in (forward, linear(direction), few):
        np.testing.assert_allclose(found, expected, rtol=1e-9)
    _, pull = jax.vjp(pose, channels)
    columns = np.random.default_rng(1).normal(size=(7, 2))
    (several,) = jax.vmap(pull, in_axes=1)(columns)
    np.testing.assert_allclose(several, np.tensordot(columns.T, jacobian, 1), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(pull(columns[:, 0])[0], several[0], rtol=1e-6, atol=1e-12)
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.hessian(lambda scale: pose(channels + scale * direction)[0])(0.0)
    with pytest.raises(NotImplementedError, match="inside the jit"):
        jax.jit(pull)(jnp.arange(7.0))


@pytest.fixture(scope="module")
def two_blocks(precision):
    """2,500 points are two blocks, the second one padded."""
    return pair(size=2500, noise=0.03)


def test_another_size_compiles_nothing(two_blocks):
    """But for a copy of each of the two arguments, which `jax.grad` itself makes."""

    def gradient(source, target, *_):
        def loss(points, channels):
            return posed((source.replace(points=points, channels=channels), target), max_iterations=3)

        return jax.grad(loss, (0, 1))(source.points, source.channels)

    gradient(*two_blocks)
    other = pair(size=2600, noise=0.03)
    with compilations() as compiled:
        gradient(*other)
    assert len(compiled) <= 2


@pytest.mark.slow
def test_several_blocks_of_rows(two_blocks):
    source, target, truth = two_blocks
    # Of so many matches, some would flip.
    matches = mcg.find_correspondences(source, target, truth, METHOD, max_distance=GATE)

    def loss(inputs):
        return weigh(mcg.estimate_pose(*clouds_with(inputs, source, target), matches, METHOD, **TO_ROUNDING).matrix)

    check_eager_gradient(loss, {"source points": source.points, "target channels": target.channels})


def test_a_ragged_batch_has_the_gradients_of_its_pairs():
    sources, targets, _ = zip(*(pair(size=size) for size in (300, 500, 2100)), strict=True)

    def loss(channels):
        moved = [source.replace(channels=each) for source, each in zip(sources, channels, strict=True)]
        found = mcg.register_batch(moved, list(targets), METHOD, max_distance=GATE)
        return sum(weigh(each.matrix) for each in found)

    gradients = jax.grad(loss)([source.channels for source in sources])
    for source, target, gradient in zip(sources, targets, gradients, strict=True):

        def alone(each, source=source, target=target):
            return weigh(mcg.register(source.replace(channels=each), target, METHOD, max_distance=GATE).matrix)

        np.testing.assert_array_equal(gradient, jax.grad(alone)(source.channels))


def test_an_invalid_pair_has_no_gradient():
    source, target, _ = pair(size=300)

    def loss(points):
        sources = [source.replace(points=points), np.zeros((3, 3))]
        with pytest.warns(mcg.PairWarning, match="pair 1"):
            found = mcg.register_batch(sources, target, mcg.GICP(), max_distance=GATE)
        assert [each.status for each in found] == [Status.CONVERGED, Status.INVALID_INPUT]
        return weigh(found[0].matrix)

    assert np.any(jax.grad(loss)(source.points))


def test_a_pose_without_matches_has_no_gradient():
    source, target, _ = pair(size=300)

    def loss(points):
        found = mcg.register(source.replace(points=points), target, mcg.GICP(), max_distance=1e-6)
        assert found.status == Status.TOO_FEW_CORRESPONDENCES
        return weigh(found.matrix)

    np.testing.assert_array_equal(jax.grad(loss)(source.points), 0)


def test_the_jacobian_is_that_of_small_motions(clouds):
    """Also at a far origin: ξ refers to the user's frame."""
    options = {"max_distance": GATE, "soft_matches": False, **TO_ROUNDING}
    for shift in (np.zeros(3), np.array([300.0, 400.0, 100.0])):
        source, target = (mcg.preprocess(mcg.PointCloud(cloud.points + shift, cloud.channels)) for cloud in clouds)
        result = mcg.register(source, target, METHOD, **options)
        assert result.history["translation_step"][-1] < 1e-12
        for field in ("points", "channels"):
            array = np.asarray(getattr(source, field))
            direction, step = np.random.default_rng(0).normal(size=array.shape), 1e-6
            plus, minus = (
                mcg.register(source.replace(**{field: array + each * direction}), target, METHOD, **options).matrix
                for each in (step, -step)
            )
            change = np.linalg.inv(result.matrix) @ (plus - minus) / (2 * step)
            expected = np.append(change[:3, 3], change[[2, 0, 1], [1, 2, 0]])
            found = np.tensordot(result.jacobian("source", field), direction, array.ndim)
            np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    copied = jax.tree.map(lambda leaf: leaf, result)
    with pytest.raises(ValueError, match="copy"):
        copied.jacobian("source", "points")
    refused(lambda: result.jacobian("source", "covariances"), "covariances")


def test_nested_differentiation_is_refused(clouds):
    """By other inputs, too: the inner value would be a constant to the outer differentiation."""
    source, target = clouds

    def pose(scale, other):
        moved = source.replace(points=source.points * scale), target.replace(points=target.points * other)
        return mcg.register(*moved, mcg.GICP(), max_distance=GATE).matrix[0, 3]

    for inner in (
        lambda scale: jax.grad(lambda other: pose(scale, other))(1.0),
        lambda scale: jax.jvp(lambda other: pose(scale, other), (1.0,), (1.0,))[0],
    ):
        with pytest.raises(NotImplementedError, match="first derivatives only"):
            jax.grad(inner)(1.0)


def test_options_are_constants_wherever_they_come_from(clouds):
    for name, value in (("max_distance", GATE), ("rotation_tolerance", 5e-4), ("init", np.eye(4))):
        loss = partial(pose_in_x, clouds)
        derived = jax.grad(
            lambda points, loss=loss, name=name, value=value: loss(points, **{name: value + 0 * points[0, 0]})
        )
        expected = jax.grad(loss)(clouds[0].points)
        np.testing.assert_allclose(derived(clouds[0].points), expected, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_starts_that_vmap_traces_compile_the_gradient(clouds):
    """With `jit`, as one program."""
    points, starts = clouds[0].points, jnp.tile(jnp.eye(4), (2, 1, 1))
    gradient = jax.grad(partial(pose_in_x, clouds))

    several = jax.jit(jax.vmap(lambda init: gradient(points, init=init, search=mcg.DenseSearch())))(starts)
    np.testing.assert_allclose(several[1], gradient(points), rtol=1e-6, atol=1e-9)


def pose_in_x(clouds, points, **options):
    moved = clouds[0].replace(points=points), clouds[1]
    return mcg.register(*moved, mcg.PointToPoint(), **{"max_distance": GATE} | options).matrix[0, 3]


def test_a_batch_of_a_generator_is_refused_in_a_gradient(clouds):
    source, target = clouds

    def loss(points):
        sources = (source.replace(points=points) for _ in range(2))
        return mcg.register_batch(sources, [target, target], mcg.GICP())[0].matrix[0, 3]

    refused(lambda: jax.grad(loss)(source.points), "pair 0", "tracers")


@pytest.mark.parametrize(
    "of",
    [pytest.param(name, marks=pytest.mark.slow) for name in ("register", "estimate_pose", "register_batch")]
    + ["mahalanobis_cost"],
)
def test_estimated_parameters_are_warned_of_where_channels_are_differentiated(of, clouds):
    """Not of parameters resolved beforehand, nor in gradients by points."""
    unset = mcg.MultiChannelGICP()
    resolved = unset.resolve(*clouds)
    matches = mcg.find_correspondences(*clouds, motion(), resolved, max_distance=GATE)

    def loss(inputs, method=resolved):
        pair = clouds_with(inputs, *clouds)
        if of == "mahalanobis_cost":
            return mcg.mahalanobis_cost(motion(), *pair, matches, method)
        if of == "estimate_pose":
            return weigh(mcg.estimate_pose(*pair, matches, method).matrix)
        if of == "register":
            return weigh(mcg.register(*pair, method, max_distance=GATE).matrix)
        return weigh(mcg.register_batch([pair[0]], [pair[1]], method, max_distance=GATE)[0].matrix)

    inputs = {f"{side} channels": cloud.channels for side, cloud in zip(("source", "target"), clouds, strict=True)}
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        jax.vjp(loss, inputs)
        jax.vjp(partial(loss, method=unset), {"source points": clouds[0].points})
        # Of hard matches, α decides the matches alone.
        if not of.startswith("register"):
            jax.vjp(partial(loss, method=mcg.MultiChannelGICP(0.05)), inputs)
        if of == "mahalanobis_cost":
            jax.eval_shape(jax.jit(jax.grad(partial(loss, method=unset))), inputs)
    with pytest.warns(UserWarning, match=r"^channel_covariance.*: estimated .* resolve") as caught:
        jax.vjp(partial(loss, method=unset), inputs)
    assert len(caught) == 1


@pytest.mark.parametrize(
    "named, method",
    [
        ("channel_weights", mcg.MultiChannelGICP(0.05)),
        ("photometric", mcg.MultiChannelGICP(0.05, 0.3, photometric=True)),
    ],
)
def test_estimated_weights_of_matches_and_scales_of_residuals_are_warned_of(named, method, clouds):
    """The scales of photometric residuals in a gradient by points, too."""
    matches = mcg.find_correspondences(*clouds, motion(), method, max_distance=GATE, num_candidates=3)

    def loss(inputs):
        pair = clouds_with(inputs, *clouds)
        return mcg.mahalanobis_cost(motion(), *pair, matches, method, temperature=0.1)

    for given in ({"source channels": clouds[0].channels}, {"source points": clouds[0].points}):
        if named == "photometric" or "source channels" in given:
            with pytest.warns(UserWarning, match=f"^{named}: ") as caught:
                jax.vjp(loss, given)
            assert len(caught) == 1


def test_a_gradient_by_weights_of_the_matches_is_warned_of():
    source, target, _ = pair(size=300)

    def loss(weights):
        method = mcg.MultiChannelGICP(channel_weights=weights)
        return mcg.register(source, target, method, max_distance=0.5, soft_matches=False).matrix[0, 3]

    with pytest.warns(UserWarning, match="channel_weights: the derivative is 0"):
        gradient = jax.grad(loss)(jnp.full(2, 0.1))
    np.testing.assert_array_equal(gradient, 0)


def test_only_the_pose_has_a_derivative_and_nothing_is_0_without_a_word(clouds):
    source, target = clouds[:2]
    method, kept = mcg.GICP(), []

    def result(points):
        kept.append(mcg.register(source.replace(points=points), target, method, max_distance=0.4))
        return kept[-1]

    points = jnp.asarray(source.points)
    for name in ("cost", "rmse", "covariance", "deviations"):

        def loss(points, name=name):
            return jnp.sum(getattr(result(points), name))

        with pytest.raises(NotImplementedError, match=r"only the pose has a derivative.*mahalanobis_cost"):
            jax.grad(loss)(points)
        assert np.isnan(jax.jvp(loss, (points,), (points,))[1])

    def both(points):
        found = result(points)
        assert "rmse" in repr(found)
        return found.centred.translation()[0] + jax.lax.stop_gradient(found.cost)

    assert np.any(jax.grad(both)(points))
    # After the differentiation, what is no derivative can still be read.
    assert np.isfinite(kept[-1].covariance).all()


def test_gradients_by_channels_that_are_equalised_are_warned_of(clouds):
    source, target = clouds[:2]

    def loss(channels):
        moved = source.replace(channels=channels)
        method = mcg.MultiChannelGICP(0.1, 0.1)
        return mcg.register(moved, target, method, max_distance=0.4, equalize_channels=True).matrix[0, 3]

    with pytest.warns(UserWarning, match="equalize_channels: gain and offset"):
        jax.grad(loss)(jnp.asarray(source.channels))
