"""Gradients of poses with unconstrained directions: those within the constrained ones, with the subspace a constant."""

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import Status
from mcgicp_jax._pose_solver.matched import linearize_at
from tests.differences import CONVERGED, GATE, assert_alike, assert_slopes, clouds_with, inputs_of, slopes, weigh
from tests.precision import cached, in_both_precisions, in_float64, tolerance
from tests.reference import exponential
from tests.scenes import matched_at, motion, pair, wall

SIZE = 400
# With some others, matches alternate for ever at these tolerances.
TRUTH = motion((0.02, -0.01, 0.02, 0.01, -0.01, 0.005))


def plane(size, seed):
    """2 m wide, with 2 cm of noise."""
    return wall(size, 0.02, seed)


def corridor(size, seed):
    """4 m long, 1 m wide and high."""
    return walls(size, seed, ((1, 0), (1, 1), (2, 0), (2, 1)), (4, 1, 1))


def corner(size, seed):
    """Two walls 2 m long and high, without a floor."""
    return walls(size, seed, ((0, 0), (1, 0)), (2, 2, 2))


def walls(size, seed, planes, lengths):
    rng = np.random.default_rng(seed)
    points = rng.random((size, 3)) * lengths
    for i, (axis, height) in enumerate(planes):
        points[i :: len(planes), axis] = height
    return points + 0.02 * rng.normal(size=points.shape), rng.normal(size=(size, 1))


def edge(size, seed):
    """A plane with stripes, between which the channel changes from −1 to 1 within 10 cm."""
    points, _ = wall(size, 0.01, seed)
    stripes = np.tanh(np.sin(4 * np.pi * points[:, :1]) / 0.3)
    return points, stripes + 0.01 * np.random.default_rng(seed).normal(size=(size, 1))


# Scene, method, and number of unconstrained directions.
CASES = {
    "plane": (plane, mcg.GICP(1e-2), 3),
    "plane, point-to-plane": (plane, mcg.PointToPlane(), 3),
    "corridor": (corridor, mcg.GICP(1e-2), 1),
    "corridor, point-to-plane": (corridor, mcg.PointToPlane(), 1),
    "L": (corner, mcg.GICP(1e-2), 1),
    "L, point-to-plane": (corner, mcg.PointToPlane(), 1),
    "edge of a channel": (edge, mcg.MultiChannelGICP(0.05, 0.1), 1),
}


@cached
def clouds_of(scene):
    return pair(scene, SIZE, TRUTH)[:2]


def registered(clouds, method, **options):
    return mcg.register(*clouds, method, **{"max_distance": GATE, "soft_matches": False} | CONVERGED | options)


class Reference:
    """The pose near that of a result at which the forces along its constrained directions vanish, by NumPy.

    The pose moves along these directions alone. They are fixed in the target's frame, and the matches are fixed, too:
    the nearest ones, or with a temperature the eight candidates of soft ones.
    """

    def __init__(self, clouds, method, result, temperature=None):
        self._pose, self._temperature = result.matrix, temperature
        count = 1 if temperature is None else 8
        self._matches = mcg.find_correspondences(*clouds, self._pose, method, max_distance=GATE, num_candidates=count)
        directions, adjoint = result.directions, jaxlie.SE3.from_matrix(result.matrix).adjoint()
        self._along = np.asarray(adjoint) @ directions.twists[directions.constrained].T
        for _ in range(0 if temperature is None else 4):
            self._measure_slope(clouds, method)
            self._pose = self.pose(clouds, method)
        self._measure_slope(clouds, method)

    def _measure_slope(self, clouds, method):
        steps = 1e-5 * np.eye(self._along.shape[1])
        forces = [self._force(clouds, method, step) - self._force(clouds, method, -step) for step in steps]
        self._slope = np.stack(forces, axis=1) / 2e-5

    def _force(self, clouds, method, moved):
        pose = self._at(moved)
        matched, both, there = matched_at(*clouds, method, pose, self._matches, temperature=self._temperature)
        force = np.asarray(_forces(there, matched, both.terms)).T
        points = np.asarray(clouds[0].points) @ pose[:3, :3].T + pose[:3, 3]
        points = np.tile(points, (len(force) // len(points), 1))
        return self._along.T @ np.append(force.sum(axis=0), np.cross(points, force).sum(axis=0))

    def _at(self, moved):
        return exponential(self._along @ moved) @ self._pose

    def pose(self, clouds, method):
        moved = np.zeros(self._along.shape[1])
        # The slope is off by a millionth, the displacement.
        for _ in range(4):
            moved = moved - np.linalg.solve(self._slope, self._force(clouds, method, moved))
        return self._at(moved)


_forces = jax.jit(lambda motion, matched, terms: linearize_at(motion, matched, terms)[1].force)


def check(loss, reference, clouds, method, after=None, accuracy=1e-6):
    """The gradient of a loss of the pose of some inputs agrees with differences of the reference."""
    inputs = inputs_of(*clouds, method, None)
    if not method.uses_channels:
        inputs = {name: value for name, value in inputs.items() if not name.endswith("channels")}
    gradient = jax.grad(loss)(inputs)

    def expected(inputs):
        pose = reference.pose(clouds_with(inputs, *clouds), inputs["method"])
        return weigh(pose if after is None else pose @ after)

    assert_slopes(gradient, slopes(expected, inputs), accuracy=accuracy)
    assert np.abs(gradient["source points"]).max() > 1e-4


@in_float64
@pytest.mark.filterwarnings("ignore:channel_weights")
@pytest.mark.parametrize(
    "name, hold",
    [pytest.param(name, True, marks=[pytest.mark.slow] * (name == "edge of a channel")) for name in CASES]
    + [("L", False)],
)
def test_gradient_is_that_within_the_constrained_directions(name, hold):
    scene, method, free = CASES[name]
    clouds = clouds_of(scene)
    result = registered(clouds, method, hold_unconstrained=hold)
    assert result.status == Status.DEGENERATE

    def loss(inputs):
        options = {"init": result.matrix, "hold_unconstrained": hold}
        return weigh(registered(clouds_with(inputs, *clouds), inputs["method"], **options).matrix)

    check(loss, Reference(clouds, method, result), clouds, method)
    constrained, directions = result.directions.constrained, np.asarray(result.directions.twists)
    assert (~constrained).sum() == free
    along = np.tensordot(np.linalg.inv(directions.T), result.jacobian("source", "points"), 1)
    assert np.abs(along[~constrained]).max() < 1e-12 < 1e-4 < np.abs(along[constrained]).max(axis=(1, 2)).min()


@in_float64
@pytest.mark.slow
def test_gradient_of_soft_matches_is_that_within_the_constrained_directions():
    scene, method, free = CASES["edge of a channel"]
    clouds = clouds_of(scene)
    result = registered(clouds, method, soft_matches=True)
    assert result.status == Status.DEGENERATE and (~result.directions.constrained).sum() == free
    near = np.asarray(clouds[1].neighbors)[:, 1]
    spacing = np.median(np.linalg.norm(clouds[1].points[near] - clouds[1].points, axis=1))
    reference = Reference(clouds, method, result, spacing)
    root = reference.pose(clouds, method)

    def loss(inputs):
        moved = clouds_with(inputs, *clouds), inputs["method"]
        return weigh(registered(*moved, init=result.matrix, soft_matches=True).matrix)

    # A motion of the root moves the pose alike. Along the free direction, the root, 22 mm away, depends on the steps
    # that led to it, to second order, and the derivative with it: by up to 3 %. That of hard matches is off by half and
    # more.
    check(loss, reference, clouds, method, np.linalg.inv(root) @ result.matrix, accuracy=0.05)


@in_float64
def test_gradient_after_max_iterations_is_that_of_the_nearby_root():
    clouds, method = clouds_of(plane), mcg.GICP()
    start = registered(clouds, method).matrix

    def height(points, **options):
        return registered((clouds[0].replace(points=points), clouds[1]), method, init=start, **options).matrix[2, 3]

    ended = jax.grad(height)(clouds[0].points)
    stopped = jax.grad(partial(height, max_iterations=1, translation_tolerance=0.0))(clouds[0].points)
    np.testing.assert_allclose(stopped, ended, atol=1e-9)
    assert np.abs(ended).max() > 1e-4


@pytest.mark.slow
@in_both_precisions
def test_lanes_inside_jit_have_the_gradients_outside(precision):
    """One program for several pairs; the last of them has no matches, and the gradient 0."""
    tolerances = {f"{name}_tolerance": tolerance(1e-5, 1e-12) for name in ("translation", "rotation")}
    points = [[np.asarray(cloud.points) for cloud in clouds_of(scene)] for scene in (plane, corridor, corner)]
    points.append([points[0][0], points[0][1] + 100])
    pairs = [[mcg.preprocess(mcg.PointCloud(each)) for each in pair_of_points] for pair_of_points in points]

    def gradient(source, target, search=None):
        def loss(points):
            moved = source.replace(points=points), target
            result = registered(moved, mcg.GICP(1e-2), search=search, **tolerances)
            return weigh(result.matrix), result.status_code

        return jax.grad(loss, has_aux=True)(source.points)

    sources, targets = (jax.tree.map(lambda *leaves: jnp.stack(leaves), *clouds) for clouds in zip(*pairs, strict=True))
    several, statuses = jax.jit(jax.vmap(lambda *clouds: gradient(*clouds, mcg.DenseSearch())))(sources, targets)
    assert statuses.tolist() == [Status.DEGENERATE] * 3 + [Status.TOO_FEW_CORRESPONDENCES]
    for clouds, found in zip(pairs, several, strict=True):
        expected, _ = gradient(*clouds)
        np.testing.assert_allclose(found, expected, atol=tolerance(2e-3, 1e-9))
    assert not np.any(several[3]) and np.abs(several[:3]).max(axis=(1, 2)).min() > 1e-3


@pytest.mark.slow
@in_float64
def test_tie_points_and_a_prior_have_gradients_where_clouds_constrain_nothing():
    """Differences of the registration itself, by what was measured: the directions do not depend on it.

    The measurements agree with the clouds, so that the pose begins where it ends: elsewhere the pose along the
    unconstrained directions depends on the path, to second order.
    """
    clouds, method = clouds_of(plane), mcg.GICP()
    start = registered(clouds, method).matrix
    points = np.asarray(clouds[0].points)[[7]]
    # About the normal of the plane, nearly, it tells nothing.
    loose = np.diag([1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e8])

    def loss(inputs, search=None):
        options = {"init": start, "search": search}
        if "target" in inputs:
            options["tie_points"] = (points, inputs["target"], 1e-4 * np.eye(3)[None])
        else:
            options["prior"] = (jaxlie.SE3.from_matrix(start) @ jaxlie.SE3.exp(inputs["twist"]), loose)
        moved = clouds[0].replace(points=inputs.get("points", clouds[0].points)), clouds[1]
        result = registered(moved, method, **options)
        return weigh(result.matrix), (result.status_code, result.directions.constrained)

    gradient = jax.grad(loss, has_aux=True)
    for inputs in ({"target": points @ start[:3, :3].T + start[:3, 3]}, {"twist": np.zeros(6)}):
        found, (status, constrained) = gradient(inputs)
        assert status == Status.DEGENERATE and constrained.sum() == 5
        assert_slopes(found, slopes(lambda inputs: loss(inputs)[0], inputs), floor=0)


@in_float64
@pytest.mark.slow
def test_gradients_that_channels_constrain_are_the_same_inside_jit():
    scene, method, _ = CASES["edge of a channel"]
    clouds = clouds_of(scene)
    start = registered(clouds, method).matrix

    def loss(arrays, search=None):
        moved = clouds[0].replace(points=arrays[0], channels=arrays[1]), clouds[1]
        result = registered(moved, method, search=search, init=start)
        return weigh(result.matrix), result.status_code

    gradient, arrays = jax.grad(loss, has_aux=True), (clouds[0].points, clouds[0].channels)
    compiled, status = jax.jit(lambda arrays: gradient(arrays, mcg.DenseSearch()))(arrays)
    assert status == Status.DEGENERATE
    assert_alike(compiled, gradient(arrays)[0], 1e-9)


@in_float64
def test_estimate_pose_of_points_on_a_line_has_a_gradient_inside_and_outside_jit():
    """A turn about the line of the points changes nothing: `information` is singular."""
    line = np.linspace(0, 1, 40)[:, None] * [0.6, 0.0, 0.8]
    noise = 0.01 * np.random.default_rng(0).normal(size=line.shape)
    source, target = (mcg.preprocess(mcg.PointCloud(points)) for points in (line, line + noise))
    matches = mcg.Correspondences(np.arange(40), np.zeros(40), np.ones(40, bool))
    # No update is below 0: the status is MAX_ITERATIONS.
    stopped = {"translation_tolerance": 0.0, "max_iterations": 1}

    def loss(inputs, **options):
        moved = target.replace(points=inputs["points"])
        result = mcg.estimate_pose(source, moved, matches, mcg.PointToPoint(), **options)
        return weigh(result.matrix), result.status_code

    inputs, gradient = {"points": target.points}, jax.grad(loss, has_aux=True)
    found, status = gradient(inputs)
    assert status == Status.DEGENERATE
    compiled, status = jax.jit(lambda inputs: gradient(inputs, **stopped))(inputs)
    assert status == Status.MAX_ITERATIONS
    np.testing.assert_allclose(compiled["points"], found["points"], atol=1e-12)
    options = CONVERGED | {"init": mcg.estimate_pose(source, target, matches, mcg.PointToPoint(), **CONVERGED).matrix}
    found, _ = gradient(inputs, **options)
    assert_slopes(found, slopes(lambda inputs: loss(inputs, **options)[0], inputs), floor=0)
