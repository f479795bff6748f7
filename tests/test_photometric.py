"""The photometric term: residuals, estimates, gradients, and what it does for a pose."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax._local_geometry.sensor_patterns import without_constant_part
from mcgicp_jax._pose_solver.matched import Matched, adapted, sample_of_term
from mcgicp_jax._terms.photometric import Photometric, Residuals
from mcgicp_jax.extend import AbstractTerm, Mahalanobis
from tests.differences import (
    CONVERGED,
    GATE,
    TO_ROUNDING,
    assert_alike,
    check_eager_gradient,
    clouds_with,
    inputs_of,
    weigh,
)
from tests.precision import in_float64, tolerance
from tests.scenes import matched_at, motion, pair, wall

PHOTOMETRIC = mcg.MultiChannelGICP(photometric=True)
SMALL = motion((0.03, -0.02, 0.01, 0.01, -0.01, 0.02))


class Still(AbstractTerm):
    """A photometric term with its numbers as they are."""

    name = "photometric"
    columns = staticmethod(Photometric.columns)
    term: Photometric

    def linearize(self, matches):
        return self.term.linearize(matches)


class WithFixedTerm(mcg.MultiChannelGICP):
    """The photometric term alone, with its numbers as they are."""

    term: Any

    def __init__(self, method, term):
        super().__init__(method.channel_covariance, method.channel_weights, photometric=True)
        self.term = term

    def terms(self, source, target, robust, equalize_channels):
        return (Still(self.term, robust=robust),)


@jax.jit
def numbers_at(motion, matched, terms, valid):
    """The terms with their numbers from the matches."""

    def sample(term, rows):
        some = jax.tree.map(lambda array: array[rows], Matched(matched.source, matched.target, matched.valid))
        return sample_of_term(motion, some, term)

    return adapted(terms, valid, sample)


@jax.jit
def sampled(term, matched, motion):
    return term.sample(matched.at(motion))


def with_fixed_numbers(source, target, method, pose, matches):
    """The method with its numbers fixed to those of the matches at a pose; and the term with these."""
    matched, both, motion = matched_at(source, target, method, pose, matches)
    (term,) = numbers_at(motion, matched, both.terms, source.valid)
    return WithFixedTerm(both.method, term), term


def raised(size, **settings):
    """The wall in the middle of a layer of cells; at their border, the cells would sort points by their noise."""
    points, channels = wall(size, **settings)
    return points + 0.09, channels


def at_truth(scene=wall, size=900, truth=SMALL, **settings):
    source, target, truth = pair(scene, size, truth=truth, **settings)
    matches = mcg.find_correspondences(source, target, truth, mcg.PointToPoint(), max_distance=0.1)
    return source, target, truth, matches


def test_samples_are_interpolated():
    """On a smooth picture the error is far below the spacing, with which that of matched samples grows."""
    source, target, truth = pair(wall, 900, truth=SMALL)
    plain, fine = (mcg.register(source, target, method) for method in (mcg.MultiChannelGICP(), PHOTOMETRIC))
    errors = [mcg.metrics.pose_error(result.matrix, truth)[0] for result in (plain, fine)]
    assert plain.converged and fine.converged
    assert errors[1] < 3e-4 < 2e-3 < errors[0]
    assert all(direction.constrained_by_channels for direction in fine.unconstrained_directions)


@pytest.mark.parametrize(("seed", "method", "largest"), [(24, PHOTOMETRIC, 1e-3), (104, mcg.MultiChannelGICP(), 5e-3)])
def test_a_wall_of_sharp_edges_is_constrained(seed, method, largest):
    """Variance that edges leave about the fits is no evidence against the channels; it was, and nothing moved."""
    target, source = mcg.datasets.poster_wall(2, seed=seed)
    truth = np.linalg.inv(target.pose) @ source.pose
    result = mcg.register(source.cloud, target.cloud, method)
    assert result.converged and mcg.metrics.pose_error(result.matrix, truth)[0] < largest


@pytest.mark.slow
def test_transformations_and_lanes_find_the_same_pose():
    """Also of channels with a gain and an offset, which are estimated there too."""
    source, target, _ = pair(wall, 900, truth=SMALL)
    source = source.replace(channels=np.float32(0.7) * source.channels - np.float32(0.2))
    options = {"equalize_channels": True, "search": mcg.DenseSearch()}
    outside = mcg.register(source, target, PHOTOMETRIC, **options)
    clouds = source, target.pad(1024)
    compiled = jax.jit(lambda *clouds: mcg.register(*clouds, PHOTOMETRIC, **options))(*clouds)
    (lane,) = mcg.register_batch([source], [target], PHOTOMETRIC, **options)
    for inside in (compiled, lane):
        np.testing.assert_allclose(inside.matrix, outside.matrix, atol=2e-6)
        assert inside.status == outside.status and inside.num_iterations == outside.num_iterations
        for name, rtol, atol in (("information", 1e-2, 1e-3), ("covariance", 0.05, 0.02)):
            actual, expected = getattr(inside, name), getattr(outside, name)
            np.testing.assert_allclose(actual, expected, rtol=rtol, atol=atol * expected.max())


@pytest.mark.slow
def test_the_cost_of_matches_is_that_of_estimate_pose():
    source, target, truth, matches = at_truth()
    # The numbers of the term are those at the start: the solution, near which the cost hardly changes.
    start = mcg.estimate_pose(source, target, matches, PHOTOMETRIC, init=truth).matrix
    found = mcg.estimate_pose(source, target, matches, PHOTOMETRIC, init=start)
    cost = mcg.mahalanobis_cost(start, source, target, matches, PHOTOMETRIC)
    assert found.converged and float(cost) == pytest.approx(float(found.cost), rel=1e-5)


@pytest.mark.slow
def test_forces_are_the_gradient_of_the_cost():
    source, target, truth, matches = at_truth()
    _, term = with_fixed_numbers(source, target, PHOTOMETRIC, truth, matches)
    matched, _, motion = matched_at(source, target, PHOTOMETRIC, truth, matches)
    moved = motion.move(matched.source.points)

    def of(moved, name):
        return getattr(term.linearize(matched.at(motion)._replace(moved=moved)), name)

    gradient = jax.jit(jax.grad(lambda moved: jnp.sum(of(moved, "cost"))))(moved)
    force = jax.jit(lambda moved: of(moved, "force"))(moved)
    np.testing.assert_allclose(force, -0.5 * gradient, atol=1e-4 * np.abs(force).max())
    # The stiffness is the Gauss-Newton Hessian: close to the true one where weights hardly fall.
    axis = jnp.array([1.0, 0.0, 0.0])[:, None] * jnp.ones_like(moved)
    change = jax.jit(lambda moved: jax.jvp(lambda moved: of(moved, "force"), (moved,), (axis,))[1])(moved)
    stiffness = jax.jit(lambda moved: of(moved, "stiffness"))(moved)
    np.testing.assert_allclose(np.sum(stiffness[0]), -np.sum(change[0]), rtol=0.15)


def test_gains_and_offsets_apply_to_values_and_slopes():
    source, target, truth, matches = at_truth()
    _, term = with_fixed_numbers(source, target, PHOTOMETRIC, truth, matches)
    darker = source.replace(channels=np.float32(0.7) * source.channels - np.float32(0.2))
    brighter = replace(term, gains=term.gains / 0.7, offsets=term.offsets + 0.2 / 0.7)
    samples = []
    for cloud, each in ((source, term), (darker, brighter)):
        matched, _, motion = matched_at(cloud, target, PHOTOMETRIC, truth, matches)
        samples.append(sampled(each, matched, motion))
    for name in ("values", "slopes", "products"):
        expected, found = (np.asarray(getattr(each, name)) for each in samples)
        np.testing.assert_allclose(found, expected, atol=1e-3 * np.nanmax(np.abs(expected)), err_msg=name)


@pytest.mark.slow
def test_estimates_are_scales_and_correlations_of_the_residuals():
    source, target, truth, matches = at_truth(raised, size=2500)
    _, term = with_fixed_numbers(source, target, PHOTOMETRIC, truth, matches)
    matched, _, motion = matched_at(source, target, PHOTOMETRIC, truth, matches)
    moved = motion.move(matched.source.points)
    residuals = sampled(term, matched, motion)
    for k, values in enumerate(residuals.values.T):
        scatter = 1.4826 * np.nanmedian(np.abs(values - np.nanmedian(values)))
        np.testing.assert_allclose(term.deviations[k], scatter, rtol=1e-4)
    # By definition, cell by cell, with the weights of the default kernel.
    cells = np.floor(np.asarray(moved) / (10 * float(term.spacing))).astype(int)
    _, cell = np.unique(cells, axis=1, return_inverse=True)
    for k in range(4):
        values = residuals.values[:, k]
        z = np.where(~np.isnan(values), values, 0) / term.deviations[k]
        slope = np.asarray(residuals.slopes[:, k]).T / term.deviations[k]
        weights = 1 / (1 + z**2 / 20)
        sums = np.stack([np.bincount(cell.ravel(), weights * z * axis) for axis in slope])
        design = max(np.sum(sums**2) / np.sum(weights * np.sum(slope**2, axis=0)), 1)
        # Some cells share a number.
        np.testing.assert_allclose(term.designs[k], design, rtol=0.3)


def photometric(spacing):
    """The term of one channel before its numbers are known."""
    coarse = Mahalanobis(mcg.GICP())
    return Photometric.before_estimate(np.float64(spacing), 1, coarse, robust=None, equalizes_channels=False)


def test_a_sample_has_the_design_effect_of_all():
    """Twice as many samples of one picture are not worth twice as much."""
    rng = np.random.default_rng(0)
    moved = np.concatenate([rng.random((40_000, 2)), np.zeros((40_000, 1))], axis=1)
    # Errors that neighbours share, and noise.
    shared = rng.normal(size=(50, 50))[tuple((50 * moved[:, :2]).astype(int).T)]
    values = np.stack([rng.normal(size=40_000), 0.5 * shared + rng.normal(size=40_000)], axis=1)
    slopes = np.tile([[0, 0, 1.0], [1.0, 0, 0]], (40_000, 1, 1))
    rows = Residuals(values, slopes, values[:, 1:], np.ones((40_000, 1)), moved)
    whole = photometric(0.01).adapt(rows, 1.0)
    sample = photometric(0.01).adapt(Residuals(*(column[::3] for column in rows)), 1 / 3)
    assert whole.designs[0] < 1.3 and whole.designs[1] > 3
    np.testing.assert_allclose(sample.designs[1], whole.designs[1], rtol=0.3)


def test_the_response_is_that_to_shifts_in_all_directions():
    """Values that change by half of what slopes in any direction predict."""
    term = replace(photometric(1.0), deviations=np.full(2, 100.0))
    slopes = np.random.default_rng(0).normal(size=(500, 2, 3))
    values = 0.5 * np.einsum("nki,si->snk", slopes, term.shifts)
    others = np.zeros((6, 500, 1)), np.zeros((6, 500, 1)), np.zeros((6, 500, 3))
    responding = term.with_response(Residuals(values, np.stack([slopes] * 6), *others))
    np.testing.assert_allclose(responding.designs, 2 * term.designs, rtol=1e-2)


@pytest.mark.parametrize("noise", [0.0, 1.0, 100.0])
def test_noise_of_slopes_is_discounted(noise):
    """The reliability is the share of the true slope in the squared mean of two noisy ones: s² / (s² + n²/2)."""
    rng = np.random.default_rng(0)
    values, moved = rng.normal(size=(40_000, 2)), rng.random((40_000, 3))
    here, there = np.array([1.0, 0, 0]) + noise * rng.normal(size=(2, 40_000, 3)) * np.array([1, 0, 0])
    normals, products = np.tile([0, 0, 1.0], (40_000, 1)), np.sum(here * there, axis=1, keepdims=True)
    slopes = np.stack([normals, (here + there) / 2], axis=1)
    designs = photometric(0.002).adapt(Residuals(values, slopes, values[:, 1:], products, moved), 1.0).designs
    np.testing.assert_allclose(designs[0] / designs[1], 1 / (1 + noise**2 / 2), rtol=0.15, atol=0.03)


@in_float64
@pytest.mark.slow
def test_gradients_are_those_of_estimate_pose_at_the_same_matches():
    """With the numbers of the term that they lead to: its scales are constants to autodiff."""
    source, target, _ = pair(size=400, noise=0.02, channel_noise=0.02)
    options = {"max_distance": GATE, **CONVERGED}
    result = mcg.register(source, target, PHOTOMETRIC, **options)
    assert result.converged
    start = result.matrix
    matches = mcg.find_correspondences(source, target, start, mcg.PointToPoint(), max_distance=GATE)
    method, _ = with_fixed_numbers(source, target, PHOTOMETRIC, start, matches)

    def registered(inputs, search=None):
        clouds = clouds_with(inputs, source, target)
        return weigh(mcg.register(*clouds, PHOTOMETRIC, init=start, search=search, **options).matrix)

    def estimated(inputs):
        clouds = clouds_with(inputs, source, target)
        return weigh(mcg.estimate_pose(*clouds, matches, method, init=start, **TO_ROUNDING).matrix)

    inputs = {name: value for name, value in inputs_of(source, target, None, None).items() if value is not None}
    expected = check_eager_gradient(estimated, inputs)
    assert all(np.abs(gradient).max() > 0 for gradient in expected.values())
    outside = jax.grad(registered)(inputs)
    assert_alike(outside, expected, 1e-6)
    assert_alike(jax.jit(jax.grad(partial(registered, search=mcg.DenseSearch())))(inputs), outside, 1e-9)


@pytest.mark.slow
def test_missing_channels_and_padding_have_no_gradient():
    source, target, truth = pair(wall, 400, truth=SMALL)
    known = np.random.default_rng(0).random(source.channels.shape) < 0.7
    source = source.replace(channel_valid=known).pad(512)
    matches = mcg.find_correspondences(source, target, truth, mcg.PointToPoint(), max_distance=0.1)

    def loss(points, channels):
        moved = source.replace(points=points, channels=channels)
        return weigh(mcg.estimate_pose(moved, target, matches, PHOTOMETRIC).matrix)

    for gradient in jax.jit(jax.grad(loss, argnums=(0, 1)))(source.points, source.channels):
        assert np.isfinite(gradient).all() and np.abs(gradient[:400]).max() > 0
        np.testing.assert_array_equal(gradient[400:], 0)
    np.testing.assert_array_equal(gradient[:400][~known], 0)


@pytest.mark.parametrize("change", ["units", pytest.param("noise", marks=pytest.mark.slow)])
def test_units_and_useless_channels_do_not_matter(change):
    target, source = (mcg.preprocess(frame.cloud) for frame in mcg.datasets.poster_wall(2, seed=2))
    before = mcg.register(source, target, PHOTOMETRIC)
    rng, clouds = np.random.default_rng(0), []
    for cloud in (source, target):
        channels = np.asarray(cloud.channels)
        noise = rng.normal(size=(len(channels), 1)).astype(np.float32)
        channels = 255 * channels if change == "units" else np.concatenate([channels, noise], axis=1)
        clouds.append(mcg.preprocess(mcg.PointCloud(cloud.points, channels)))
    after = mcg.register(*clouds, PHOTOMETRIC)
    assert after.converged and mcg.metrics.pose_error(after.matrix, before.matrix)[0] < 1e-4


def black(size, **settings):
    """Seven tenths of the wall have no channels but 0."""
    points, channels = wall(size, **settings)
    return points, np.where(points[:, :1] < 1.4, 0, channels)


@pytest.mark.slow
def test_constant_parts_do_not_set_the_scale():
    """Their residuals are 0 at any pose."""
    source, target, truth = pair(black, 2000, truth=SMALL)
    result = mcg.register(source, target, PHOTOMETRIC, max_distance=0.2)
    assert result.status == mcg.Status.CONVERGED
    shift = (result.matrix - truth)[:3] @ np.append(result.directions.center, 1)
    assert (np.abs(shift) < 4 * result.deviations[:3]).all() and (result.deviations[:3] < 0.02).all()


def seen_by_a_camera(frame, share, shape):
    """A share of the points is black, since they lie outside of the image, a disc or a half."""
    angles = frame.cloud.points[:, :2] / frame.cloud.points[:, 2:]
    middle = angles - np.median(angles, axis=0)
    place = np.hypot(*middle.T) if shape == "disc" else middle[:, 0]
    outside = place > np.quantile(place, 1 - share)
    return mcg.PointCloud(frame.cloud.points, np.where(outside[:, None], 0, frame.cloud.channels))


@pytest.mark.parametrize(
    ("share", "shape"),
    [(0.6, "disc"), *(pytest.param(*each, marks=pytest.mark.slow) for each in ((0.75, "disc"), (0.6, "half")))],
)
def test_the_edge_of_an_image_moves_with_the_camera(share, shape):
    """It held the pose of this wall where the camera was."""
    frames = mcg.datasets.poster_wall(2, seed=1)
    truth = np.linalg.inv(frames[0].pose) @ frames[1].pose
    target, source = (seen_by_a_camera(frame, share, shape) for frame in frames)
    with pytest.warns(UserWarning, match="as outside of an image"):
        result = mcg.register(source, target, PHOTOMETRIC)
    assert result.converged and mcg.metrics.pose_error(result.matrix, truth, at=source.points.mean(axis=0))[0] < 3e-3


def test_only_values_that_lie_together_are_no_texture():
    """Posters of two levels, of which one is that of most points, remain."""
    cloud = mcg.datasets.poster_wall(1, seed=1)[0].cloud
    red = cloud.channels[:, :1]
    for share in (0.4, 0.6, 0.9):
        levels = mcg.preprocess(mcg.PointCloud(cloud.points, red > np.quantile(red, share)), None)
        assert without_constant_part(levels) is levels


def test_gain_and_offset_are_estimated_with_the_pose():
    source, target, truth = pair(wall, 2000, truth=SMALL)
    darker = source.replace(channels=np.float32(0.7) * source.channels - np.float32(0.2))
    without, matched = (mcg.register(darker, target, PHOTOMETRIC, equalize_channels=match) for match in (False, True))
    errors = [mcg.metrics.pose_error(result.matrix, truth)[0] for result in (without, matched)]
    assert matched.converged and errors[1] < 1e-3 < 5e-3 < errors[0]


def test_without_channels_the_term_is_off():
    source, target, _ = pair(size=400)
    bare = [mcg.preprocess(mcg.PointCloud(cloud.points)) for cloud in (source, target)]
    with pytest.warns(UserWarning):
        result = mcg.register(*bare, PHOTOMETRIC)
    # Each method has programs of its own, which may round differently.
    expected = mcg.register(*bare, mcg.GICP()).matrix
    np.testing.assert_allclose(result.matrix, expected, atol=tolerance(1e-6, 1e-12))


@pytest.mark.slow
def test_the_covariance_covers_every_direction_of_a_small_cloud():
    """The error in units of the covariance, direction by direction: on small clouds, a few large cells said of one
    direction that it hardly scatters (122 times too small a variance here)."""

    def sphere(seed):
        rng = np.random.default_rng(seed)
        points = rng.normal(size=(1000, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        x, y, z = points.T
        channels = np.column_stack([np.sin(3 * x) * np.cos(4 * y) + np.sin(5 * z) / 2, np.cos(5 * x - 2 * y + 3 * z)])
        noise = rng.normal(size=points.shape) * 0.005, rng.normal(size=channels.shape) * 0.02
        return mcg.PointCloud(points + noise[0], channels / 2 + noise[1])

    squares = []
    for k in range(12):
        result = mcg.register(sphere(2 * k).transform(np.linalg.inv(SMALL)), sphere(2 * k + 1), PHOTOMETRIC)
        error = np.asarray(jaxlie.SE3.from_matrix(np.linalg.inv(SMALL) @ result.matrix).log(), np.float64)
        variances, directions = np.linalg.eigh(result.covariance)
        squares.append((directions.T @ error) ** 2 / variances)
    assert (np.mean(squares, axis=0) < 3).all(), np.mean(squares, axis=0)
