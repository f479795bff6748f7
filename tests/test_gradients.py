"""Gradients of poses: against central differences, each way to differentiate; and what has none, or is refused."""

import re
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial

import mcgicp_jax as mcg
from mcgicp_jax import Status
from tests.compilations import compilations
from tests.differences import (
    GATE,
    METHODS,
    TO_ROUNDING,
    assert_alike,
    assert_slopes,
    case,
    check_eager_gradient,
    clouds_with,
    eager_gradient,
    inputs_of,
    slopes,
    weigh,
)
from tests.precision import cached, in_float64
from tests.refusals import refused
from tests.scenes import motion, pair, room_corner

pytestmark = in_float64
PADDED = 512
METHOD, _ = case("mc-gicp")
HARD = {"max_distance": GATE, "soft_matches": False, **TO_ROUNDING}
FUNCTIONS = ("register", "register_batch", "estimate_pose", "mahalanobis_cost")


@pytest.fixture(scope="module")
def clouds(noisy):
    return noisy[:2]


def posed(clouds, method=METHOD, **options):
    """A scalar that depends on all entries of the pose, registered to rounding. Its differences are over hard matches,
    as those of the registration itself do not change over small steps."""
    return weigh(mcg.register(*clouds, method, **HARD | options).matrix)


def with_covariances(cloud, seed):
    factor = np.random.default_rng(seed).normal(size=(400, 3, 3))
    return cloud.replace(covariances=factor @ factor.swapaxes(1, 2) / 3 + 0.1 * np.eye(3))


def with_missing_channels(cloud, seed):
    return cloud.replace(channel_valid=np.random.default_rng(seed).random(cloud.channels.shape) < 0.7)


class Case(NamedTuple):
    """What is differentiated, by all of its inputs. Several candidates are soft matches."""

    # Method and robust kernel, which have the precision in which they are made
    make: Callable[[], tuple[Any, Any]]
    num_candidates: int = 1
    changed: Callable[..., Any] | None = None


def soft_mc_gicp():
    return mcg.MultiChannelGICP([[0.05, 0.01], [0.01, 0.08]], [0.3, 0.2], epsilon=1e-2), mcg.Cauchy(0.5)


HARD_CASES = {name: Case(partial(case, name)) for name in METHODS}
CASES = HARD_CASES | {
    "covariances": Case(partial(case, "gicp"), changed=with_covariances),
    "soft mc-gicp": Case(soft_mc_gicp, 4),
    "soft color-icp": Case(lambda: (mcg.ColorICP(0.3), mcg.Cauchy(0.5)), 3),
    "mc-gicp, missing channels": Case(partial(case, "mc-gicp"), 2, with_missing_channels),
    "color-icp, missing channels": Case(partial(case, "color-icp"), 2, with_missing_channels),
}


class Problem:
    """The inputs of a case, its functions, and their central differences."""

    def __init__(self, name):
        make, count, changed = CASES[name]
        method, robust = make()
        self.clouds = pair(size=400, noise=0.05, channel_noise=0.05)[:2]
        if changed is not None:
            self.clouds = [changed(cloud, seed) for seed, cloud in enumerate(self.clouds)]
            method = method.resolve(*self.clouds)
        self.inputs, self.start = inputs_of(*self.clouds, method, robust), motion()
        if count == 1:
            self.start = mcg.register(*self.clouds, method, robust=robust, max_distance=GATE, **TO_ROUNDING).matrix
        else:
            self.inputs["temperature"] = jnp.asarray(0.1)
        options = {"max_distance": GATE, "num_candidates": count}
        self.matches = mcg.find_correspondences(*self.clouds, self.start, method, **options)
        assert self.matches.indices.shape == (count, 400)[count == 1 :]
        self.slopes = slopes(self.registered if count == 1 else self.aligned, self.inputs)

    def registered(self, inputs):
        return posed(clouds_with(inputs, *self.clouds), inputs["method"], robust=inputs["robust"], init=self.start)

    def aligned(self, inputs):
        """From elsewhere, to the matches at the start."""
        options = TO_ROUNDING | {name: inputs[name] for name in ("robust", "temperature") if name in inputs}
        clouds = clouds_with(inputs, *self.clouds)
        return weigh(mcg.estimate_pose(*clouds, self.matches, inputs["method"], init=motion(), **options).matrix)


problem_of = cached(Problem)


@jax.jit
def gradients_in_lanes(inputs, source, target, starts):
    """And the results, in a batch of starts; by dense search, as programs with callbacks are not kept on disk."""

    def loss(inputs, start):
        options = {"init": start, "robust": inputs["robust"], "search": mcg.DenseSearch(), **HARD}
        result = mcg.register(*clouds_with(inputs, source, target), inputs["method"], **options)
        return weigh(result.matrix), result

    return jax.vmap(jax.grad(loss, has_aux=True), in_axes=(None, 0))(inputs, starts)


def lane(lanes, i):
    return jax.tree.map(lambda each: each[i], lanes)


def gradient_in_lanes(problem):
    """That of padded clouds, where one lane has no matches, and one starts beside the answer."""
    source, target = (cloud.pad(PADDED) for cloud in problem.clouds)
    starts = np.stack([problem.start, motion((50, 0, 0, 0, 0, 0)), problem.start @ motion(1e-7 * np.ones(6))])
    inputs = inputs_of(source, target, problem.inputs["method"], problem.inputs["robust"])
    lanes, results = gradients_in_lanes(inputs, source, target, starts)
    assert list(results.status) == [Status.CONVERGED, Status.TOO_FEW_CORRESPONDENCES, Status.CONVERGED]
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(lane(lanes, 1)))
    np.testing.assert_allclose(results.matrix[2], problem.start, atol=1e-9)
    for leaf in jax.tree.leaves(lanes):
        np.testing.assert_allclose(leaf[2], leaf[0], atol=1e-6 * np.abs(leaf[0]).max())
    # Without the padding
    return jax.tree.map(lambda leaf, of: leaf[tuple(map(slice, np.shape(of)))], lane(lanes, 0), problem.inputs)


WAYS = {
    "register outside": lambda problem: eager_gradient(problem.registered, problem.inputs),
    "register in lanes": gradient_in_lanes,
    "estimate_pose outside": lambda problem: eager_gradient(problem.aligned, problem.inputs),
    "estimate_pose inside": lambda problem: eager_gradient(jax.jit(problem.aligned), problem.inputs),
}
QUICK = [*((name, "register outside") for name in (*HARD_CASES, "covariances"))]
# Of `estimate_pose` inside `jit`, test_gradients_of_degenerate_poses.py has a quick one.
QUICK += [("gicp", "register in lanes")]
SLOW = [(name, way) for name in HARD_CASES for way in ("register in lanes", "estimate_pose inside")]
SLOW += [("covariances", "estimate_pose inside")]
SOFT = [name for name in CASES if CASES[name].num_candidates > 1]
SLOW += [(name, f"estimate_pose {way}") for name in SOFT for way in ("outside", "inside")]


@pytest.mark.parametrize(
    "name, way", QUICK + [pytest.param(*each, marks=pytest.mark.slow) for each in SLOW if each not in QUICK]
)
def test_gradient_by_every_input_agrees_with_central_differences(name, way):
    problem = problem_of(name)
    gradient = WAYS[way](problem)
    # Poses of a whole registration are rounded to some 1e-15, and their differences over 1e-6 to some 1e-9.
    assert_slopes(gradient, problem.slopes, 1e-2 if CASES[name].num_candidates == 1 else 1e-3)
    if "temperature" in problem.inputs:
        assert np.abs(gradient["method"].channel_weights).min() > 1e-4 and gradient["temperature"] != 0


@pytest.fixture(scope="module")
def padded(noisy):
    return [cloud.pad(PADDED) for cloud in noisy[:2]]


# They share the program of the test above. test_surface_covariances.py has a quick test of what channels add.
INSIDE = ("gicp", pytest.param("mc-gicp", marks=pytest.mark.slow))


def in_first_lane(inputs, source, target, start):
    return lane(gradients_in_lanes(inputs, source, target, np.stack([start] * 3)), 0)


@pytest.mark.parametrize("name", INSIDE)
def test_inside_jit_identical_clouds_have_a_finite_gradient(padded, name):
    source, _ = padded
    gradient, result = in_first_lane(inputs_of(source, source, *case(name)), source, source, np.eye(4))
    assert np.isfinite(gradient["source points"]).all()
    np.testing.assert_allclose(result.matrix, np.eye(4), atol=1e-5)


@pytest.mark.parametrize("name", INSIDE)
def test_inside_jit_padding_has_no_gradient_and_degenerate_neighborhoods_a_finite_one(padded, name):
    source, target = padded
    # Coincident, collinear and isotropic neighbourhoods.
    points = np.array(source.unpad().points)
    points[:25] = points[0]
    points[25:50] = points[25] + np.linspace(0, 0.1, 25)[:, None] * [1.0, 2.0, 3.0]
    points[50:77] = points[50] + np.stack(np.meshgrid(*[np.arange(3) * 0.05] * 3), axis=-1).reshape(-1, 3)
    cloud = mcg.preprocess(mcg.PointCloud(points, source.unpad().channels)).pad(PADDED)
    gradients, _ = in_first_lane(inputs_of(cloud, target, *case(name)), cloud, target, motion())
    for by in ("source points", "source channels"):
        assert np.isfinite(gradients[by]).all()
        assert (np.abs(gradients[by][: len(cloud)]).max() > 0) == (by == "source points" or name == "mc-gicp")
        np.testing.assert_array_equal(gradients[by][len(cloud) :], 0)


@pytest.mark.parametrize("name", [pytest.param("mc-gicp", marks=pytest.mark.slow), "color-icp"])
def test_where_channels_are_matched_the_derivative_is_that_of_soft_matches(name, clouds):
    """Differences of `estimate_pose` over the eight candidates at the pose of the hard matches, which is returned."""
    method, robust = case(name)
    options = {"init": motion(), "robust": robust}
    hard = mcg.register(*clouds, method, **HARD | options).matrix
    default = mcg.register(*clouds, method, **HARD | options | {"soft_matches": None}).matrix
    np.testing.assert_array_equal(default, hard)
    candidates = mcg.find_correspondences(*clouds, hard, method, max_distance=GATE, num_candidates=8)
    spacing = np.median(scipy.spatial.cKDTree(clouds[1].points).query(clouds[1].points, 2)[0][:, 1])
    # Updates of soft matches converge linearly.
    soft = TO_ROUNDING | {"init": hard, "temperature": spacing, "max_iterations": 300}
    root = mcg.estimate_pose(*clouds, candidates, method, robust=robust, **soft).matrix
    assert np.linalg.norm(root - hard) > 1e-3

    def at_root(inputs):
        """A motion of the root moves the pose alike."""
        pair, method, robust = clouds_with(inputs, *clouds), inputs["method"], inputs["robust"]
        moved = mcg.estimate_pose(*pair, candidates, method, robust=robust, **soft).matrix
        return weigh(moved @ np.linalg.inv(root) @ hard)

    def loss(inputs):
        options = {"robust": inputs["robust"], "init": hard, "soft_matches": None}
        return posed(clouds_with(inputs, *clouds), inputs["method"], **options)

    gradient = check_eager_gradient(loss, inputs_of(*clouds, method, robust), differences_of=at_root)
    assert abs(gradient["method"].channel_weights) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mc-gicp", "color-icp"])
def test_derivative_of_soft_matches_is_the_same_inside_jit_and_vmap(name, clouds):
    method, _ = case(name)
    channels = jnp.stack([clouds[0].channels, 1.1 * clouds[0].channels])

    def loss(channels, method, search=None):
        moved = clouds[0].replace(channels=channels), clouds[1]
        return posed(moved, method, search=search, init=motion(), soft_matches=None)

    first, second = (jax.grad(loss, (0, 1))(values, method) for values in channels)
    assert_alike(jax.jit(jax.grad(loss, (0, 1)))(channels[0], method), first, 1e-8)
    dense = jax.grad(partial(loss, search=mcg.DenseSearch()), (0, 1))
    several = jax.jit(jax.vmap(dense, in_axes=(0, None)))(channels, method)
    assert_alike([lane(several, i) for i in (0, 1)], [first, second], 1e-8)


def answer(of, pair, method, matches=None, init=None, **options):
    """A scalar of what a function returns, and its result."""
    if of == "mahalanobis_cost":
        return mcg.mahalanobis_cost(motion() if init is None else init, *pair, matches, method, **options), None
    if of == "estimate_pose":
        result = mcg.estimate_pose(*pair, matches, method, init=init, **options)
    elif of == "register":
        result = mcg.register(*pair, method, init=init, max_distance=GATE, **options)
    else:
        one = [None if init is None else [init]]
        (result,) = mcg.register_batch([pair[0]], [pair[1]], method, init=one[0], max_distance=GATE, **options)
    return weigh(result.matrix), result


@pytest.mark.parametrize("of", FUNCTIONS)
def test_poses_and_costs_have_gradients_by_origins_of_both_clouds(of, clouds):
    """Poses in the user's frame depend on the origins, and so does the cost of a pose; as inside `jit`."""
    method, origins = mcg.PointToPoint(), (np.array([30.0, -20, 10]), np.array([10.0, 40, -20]))
    inputs = {"source origin": origins[0], "target origin": origins[1], "source points": clouds[0].points}
    inputs = jax.tree.map(jnp.asarray, inputs)
    init = motion()
    init[:3, 3] += origins[1] - init[:3, :3] @ origins[0]
    matches = mcg.find_correspondences(*clouds_with(inputs, *clouds), init, method, max_distance=GATE)
    # The cost away from its minimum, so that its gradient is not 0.
    options = {"init": init @ motion((0.01,) * 6)} if of == "mahalanobis_cost" else {"init": init, **TO_ROUNDING}

    def loss(inputs):
        value, result = answer(of, clouds_with(inputs, *clouds), method, matches, **options)
        if result is None:
            return value
        assert f"{result.status.name}: translation" in repr(result)
        return value + weigh(result.T_target_source.as_matrix()[::-1])

    if of == "mahalanobis_cost":
        assert_alike(check_eager_gradient(loss, inputs), jax.jit(jax.grad(loss))(inputs), 1e-9)


def test_zero_origin_of_a_raw_cloud_has_a_gradient(clouds):
    """As `eqx.filter_grad` by a cloud has it: to move the origin is to move all points."""
    source, target = (mcg.PointCloud(cloud.points) for cloud in clouds)
    target = mcg.preprocess(target, None)

    def loss(inputs):
        return posed((mcg.preprocess(source.replace(**inputs), None), target), mcg.PointToPoint())

    check_eager_gradient(loss, {"origin": jnp.zeros(3)})


@pytest.mark.parametrize("soft_matches", [pytest.param(False, marks=pytest.mark.slow), None])
def test_gains_of_equalized_channels_are_constants_of_which_gradients_warn(soft_matches, clouds):
    """Another offset changes no gradient, and twice the contrast makes it half as large."""
    source, target = clouds
    options = HARD | {"soft_matches": soft_matches, "equalize_channels": True}

    def registered(channels, method=METHOD):
        return mcg.register(source.replace(channels=channels), target, method, **options)

    def by_a_worker(channels):
        with ThreadPoolExecutor(1) as worker:
            moved = [source.replace(channels=channels)]
            return mcg.register_batch(moved, [target], METHOD, executor=worker, **options)[0]

    def gradient(channels, register=registered):
        with pytest.warns(UserWarning, match="equalize_channels: gain and offset"):
            return jax.grad(lambda channels: weigh(register(channels).matrix))(channels)

    channels = source.channels + 0.3
    for derivative in (gradient, lambda channels: registered(channels).jacobian("source", "channels")):
        whole, half = derivative(channels), derivative(2 * source.channels - 0.7)
        assert np.any(whole)
        np.testing.assert_allclose(half, 0.5 * whole, rtol=1e-6, atol=1e-9)
    gradient(channels, partial(registered, method=mcg.ColorICP(0.3)))
    np.testing.assert_allclose(gradient(channels, by_a_worker), gradient(channels), rtol=1e-6, atol=1e-9)


def test_neighbourhoods_of_pairs_that_a_worker_differentiates_are_looked_at(clouds):
    points, channels = (np.repeat(array, 2, axis=0) for array in (clouds[0].points, clouds[0].channels))

    def loss(points):
        options = {"executor": worker, "voxel_size": None, "max_distance": GATE}
        (result,) = mcg.register_batch([mcg.PointCloud(points, channels)], [clouds[1]], mcg.GICP(), **options)
        return weigh(result.matrix)

    with ThreadPoolExecutor(1) as worker, pytest.warns(UserWarning, match="^pair 0: source: .* exactly on another"):
        assert np.isfinite(jax.grad(loss)(points)).all()


def test_gradients_of_equalized_channels_do_not_depend_on_what_else_is_differentiated(clouds):
    """Outside `jit`, what is not differentiated is equalised, too."""
    clouds = clouds[0].replace(channels=2 * clouds[0].channels - 0.7), clouds[1]
    inputs = inputs_of(*clouds, METHOD, None)

    def loss(inputs):
        options = {"equalize_channels": True, "soft_matches": None}
        return posed(clouds_with(inputs, *clouds), inputs["method"], **options)

    with pytest.warns(UserWarning, match="equalize_channels: gain and offset"):
        together = jax.grad(loss)(inputs)
    for name in ("source points", "target points", "method"):
        alone = jax.grad(lambda value, name=name: loss(inputs | {name: value}))(inputs[name])
        for one, other in zip(*map(jax.tree.leaves, (alone, together[name])), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)


def test_preprocessing_has_a_derivative():
    """Raw points, with rows to drop, padding among them and missing channels, through the voxels."""
    points, channels = room_corner(900, noise=0.02, seed=1)
    points = (points - motion()[:3, 3]) @ motion()[:3, :3]
    points[7] = np.nan
    rng, others = np.random.default_rng(3), np.arange(900) != 7
    measured, valid = rng.random(channels.shape) > 0.1, rng.random(900) > 0.1
    target = mcg.preprocess(mcg.PointCloud(*room_corner(900, noise=0.02, seed=2)), 0.1)
    inputs = jax.tree.map(jnp.asarray, {"points": points[others], "channels": channels})

    def loss(inputs):
        # The NaN stays where it is.
        whole = jnp.asarray(points).at[others].set(inputs["points"])
        cloud = mcg.PointCloud(whole, inputs["channels"], channel_valid=measured).replace(valid=valid)
        return posed((mcg.preprocess(cloud, 0.1), target), max_distance=0.5)

    with pytest.warns(UserWarning, match=f"1 of {valid.sum()}"):
        gradient = jax.tree.map(np.asarray, eager_gradient(loss, inputs))
        assert not np.any(gradient["channels"][~(measured & (valid & others)[:, None])])
        assert not np.any(gradient["points"][~valid[others]])
        assert_slopes(gradient, slopes(loss, inputs), 1e-2, 1e-5)


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


def test_another_size_compiles_nothing():
    """But for a copy of each of the two arguments, which `jax.grad` itself makes. Beyond 2,048 points there are two
    blocks, the second one padded."""

    def compiled(size):
        source, target, _ = pair(size=size, noise=0.03)

        def loss(points, channels):
            moved = source.replace(points=points, channels=channels), target
            return posed(moved, max_iterations=3, soft_matches=None)

        with compilations() as programs:
            jax.grad(loss, (0, 1))(source.points, source.channels)
        return programs

    compiled(2500)
    assert len(compiled(2610)) <= 2


def test_a_ragged_batch_has_the_gradients_of_its_pairs():
    sources, targets, _ = zip(*(pair(size=size) for size in (300, 500, 2100)), strict=True)

    def batch(channels):
        moved = [source.replace(channels=values) for source, values in zip(sources, channels, strict=True)]
        return sum(weigh(result.matrix) for result in mcg.register_batch(moved, targets, METHOD, max_distance=GATE))

    gradients = jax.grad(batch)([source.channels for source in sources])
    for source, target, gradient in zip(sources, targets, gradients, strict=True):

        def alone(channels, source=source, target=target):
            return weigh(mcg.register(source.replace(channels=channels), target, METHOD, max_distance=GATE).matrix)

        assert np.any(gradient)
        np.testing.assert_array_equal(gradient, jax.grad(alone)(source.channels))


def test_pairs_that_are_invalid_or_have_no_matches_have_no_gradient():
    source, target, _ = pair(size=300)

    def loss(points):
        sources = [source.replace(points=points), np.zeros((3, 3))]
        with pytest.warns(mcg.PairWarning, match="pair 1"):
            found = mcg.register_batch(sources, target, mcg.GICP(), max_distance=GATE)
        assert [each.status for each in found] == [Status.CONVERGED, Status.INVALID_INPUT]
        return weigh(found[0].matrix)

    def without_matches(points):
        found = mcg.register(source.replace(points=points), target, mcg.GICP(), max_distance=1e-6)
        assert found.status == Status.TOO_FEW_CORRESPONDENCES
        return weigh(found.matrix)

    assert np.any(jax.grad(loss)(source.points))
    np.testing.assert_array_equal(jax.grad(without_matches)(source.points), 0)


def test_jacobian_is_that_of_small_motions(clouds):
    """Also at a far origin: ξ refers to the user's frame."""
    for shift in (np.zeros(3), np.array([300.0, 400.0, 100.0])):
        source, target = (mcg.preprocess(mcg.PointCloud(cloud.points + shift, cloud.channels)) for cloud in clouds)
        result = mcg.register(source, target, METHOD, **HARD)
        assert result.history["translation_step"][-1] < 1e-12
        for field in ("points", "channels"):
            array = np.asarray(getattr(source, field))
            direction, step = np.random.default_rng(0).normal(size=array.shape), 1e-6
            plus, minus = (
                mcg.register(source.replace(**{field: array + each * direction}), target, METHOD, **HARD).matrix
                for each in (step, -step)
            )
            change = np.linalg.inv(result.matrix) @ (plus - minus) / (2 * step)
            expected = np.append(change[:3, 3], change[[2, 0, 1], [1, 2, 0]])
            found = np.tensordot(result.jacobian("source", field), direction, array.ndim)
            np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    with pytest.raises(ValueError, match="copy"):
        jax.tree.map(lambda leaf: leaf, result).jacobian("source", "points")
    refused(lambda: result.jacobian("source", "covariances"), "covariances")


def test_jacobian_is_by_the_named_cloud_where_both_share_an_array(clouds):
    source, target = clouds
    shared, copied = (source.replace(channels=channels) for channels in (target.channels, np.array(target.channels)))
    assert shared.channels is target.channels and copied.channels is not target.channels
    results = [mcg.register(cloud, target, METHOD, **HARD) for cloud in (shared, copied)]
    for side in ("source", "target"):
        one, other = (result.jacobian(side, "channels") for result in results)
        np.testing.assert_array_equal(one, other)
        assert np.any(one)


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
    def loss(points, **options):
        moved = clouds[0].replace(points=points), clouds[1]
        return mcg.register(*moved, mcg.PointToPoint(), **{"max_distance": GATE} | options).matrix[0, 3]

    points = clouds[0].points
    expected = jax.grad(loss)(points)
    for name, value in (("max_distance", GATE), ("rotation_tolerance", 5e-4), ("init", np.eye(4))):
        derived = jax.grad(lambda points, name=name, value=value: loss(points, **{name: value + 0 * points[0, 0]}))
        np.testing.assert_allclose(derived(points), expected, rtol=1e-6, atol=1e-9)


def test_a_batch_of_a_generator_is_refused_in_a_gradient(clouds):
    source, target = clouds

    def loss(points):
        sources = (source.replace(points=points) for _ in range(2))
        return mcg.register_batch(sources, [target, target], mcg.GICP())[0].matrix[0, 3]

    refused(lambda: jax.grad(loss)(source.points), "pair 0", "tracers")


UNSET, NO_WEIGHTS = mcg.MultiChannelGICP(), mcg.MultiChannelGICP(0.05)
PHOTOMETRIC = mcg.MultiChannelGICP(0.05, 0.3, photometric=True)
CANDIDATES = {"temperature": 0.1}
ONE_UPDATE = {"max_iterations": 1, **{name: value for name, value in TO_ROUNDING.items() if "tolerance" in name}}
HARD_UPDATE = ONE_UPDATE | {"soft_matches": False}
# Function, method (None: all parameters estimated beforehand), what is differentiated, options, and the only warning.
WARNINGS = [
    *((of, None, "channels", {}, None) for of in FUNCTIONS),
    *((of, UNSET, "points", {}, None) for of in FUNCTIONS),
    *((of, UNSET, "channels", {}, "channel_covariance.*: estimated .* resolve") for of in FUNCTIONS),
    # Of hard matches, α decides the matches alone.
    *((of, NO_WEIGHTS, "channels", {}, None) for of in ("estimate_pose", "mahalanobis_cost")),
    ("mahalanobis_cost", NO_WEIGHTS, "channels", CANDIDATES, "channel_weights: "),
    *(("mahalanobis_cost", PHOTOMETRIC, by, CANDIDATES, "photometric: ") for by in ("channels", "points")),
    ("register", METHOD, "channels", ONE_UPDATE, None),
    ("register", METHOD, "points", HARD_UPDATE, None),
    *(
        ("register", method, "channels", HARD_UPDATE, "channels: .* soft_matches=False")
        for method in (METHOD, mcg.ColorICP(0.3))
    ),
    ("register", NO_WEIGHTS, "channels", ONE_UPDATE, "channel_weights: estimated"),
]


@pytest.mark.parametrize(
    "of, method, by, options, warning",
    [
        pytest.param(*each, marks=[pytest.mark.slow] * (each[0] != "mahalanobis_cost" and each[3] == {}))
        for each in WARNINGS
    ],
)
def test_what_is_constant_to_a_gradient_is_warned_of_once(of, method, by, options, warning, clouds):
    """Estimated parameters, scales of photometric residuals, and hard matches, as far as they depend on the inputs."""
    method = UNSET.resolve(*clouds) if method is None else method
    count = 3 if options is CANDIDATES else 1
    matches = mcg.find_correspondences(*clouds, motion(), method, max_distance=GATE, num_candidates=count)

    def loss(inputs):
        return answer(of, clouds_with(inputs, *clouds), method, matches, **options)[0]

    inputs = {f"{side} {by}": getattr(cloud, by) for side, cloud in zip(("source", "target"), clouds, strict=True)}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        jax.vjp(loss, inputs)
    found = [str(each.message) for each in caught if each.category is UserWarning]
    assert len(found) == (warning is not None), found
    assert warning is None or re.match(warning, found[0]), found


def test_inside_jit_the_cost_estimates_parameters_without_a_warning(clouds):
    matches = mcg.find_correspondences(*clouds, motion(), METHOD, max_distance=GATE)

    def loss(channels):
        return answer("mahalanobis_cost", (clouds[0].replace(channels=channels), clouds[1]), UNSET, matches)[0]

    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        jax.eval_shape(jax.jit(jax.grad(loss)), clouds[0].channels)


def test_a_gradient_by_weights_of_hard_matches_is_0_and_warned_of(clouds):
    def loss(weights):
        method = mcg.MultiChannelGICP(METHOD.channel_covariance, weights)
        return mcg.register(*clouds, method, max_distance=0.5, soft_matches=False).matrix[0, 3]

    with pytest.warns(UserWarning, match="channel_weights: the derivative is 0"):
        gradient = jax.grad(loss)(jnp.full(2, 0.1))
    np.testing.assert_array_equal(gradient, 0)


def test_only_the_pose_has_a_derivative_and_nothing_is_0_without_a_word(clouds):
    source, target = clouds
    kept = []

    def result(points):
        kept.append(mcg.register(source.replace(points=points), target, mcg.GICP(), max_distance=0.4))
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
