"""`max_source_points`: few source points are matched, their neighbourhoods come from all points."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import io
from mcgicp_jax.__main__ import main
from mcgicp_jax._math.statistics import spread_rows
from tests.compilations import compilations
from tests.differences import GATE, TO_ROUNDING, assert_alike, check_eager_gradient, clouds_with, inputs_of, weigh
from tests.precision import in_float64
from tests.reference import logarithm, symmetric
from tests.refusals import refused
from tests.scenes import covariances, pair

pytestmark = in_float64


@pytest.fixture(scope="module")
def clouds(noisy):
    return noisy[:2]


@pytest.mark.parametrize(("size", "count"), [(10, 4), (1000, 999), (34_000, 10_000), (3_000_000, 70_000)])
def test_rows_are_spread_evenly(size, count):
    rows = spread_rows(np.ones(size, bool), count)
    assert rows.shape == (count,) and rows[-1] < size
    assert np.diff(rows).min() >= 1 and np.diff(rows).max() <= 2 * -(-size // count)
    # One of each run; rounding may move its ends by a row.
    runs = np.arange(count) * size / count
    assert np.all(rows >= np.floor(runs) - 1) and np.all(rows <= runs + size / count + 1)


def test_rows_of_organised_scans_are_of_all_lines():
    """Scans store one point of each of 64 lines after the other."""
    assert np.bincount(spread_rows(np.ones(64_000, bool), 1000) % 64, minlength=64).min() > 0


def test_rows_of_padding_come_last_and_are_the_same_inside_jit():
    valid = np.random.default_rng(0).random(1000) < 0.3
    rows = spread_rows(valid, 500)
    total = valid.sum()
    np.testing.assert_array_equal(rows[:total], np.flatnonzero(valid))
    assert not valid[rows[total:]].any()
    assert valid[spread_rows(valid, 100)].all()
    for count in (100, 120, 150, 500):
        np.testing.assert_array_equal(jax.jit(spread_rows, static_argnums=1)(valid, count), spread_rows(valid, count))


def test_the_pose_is_that_of_the_points_alone_with_neighbours_among_all(clouds):
    """With covariances of the whole cloud, given to a cloud of the same rows."""
    source, target = clouds
    rows = spread_rows(source.valid, 150)
    whole = source.unpad().replace(covariances=symmetric(covariances(mcg.GICP(), source)))
    given = np.asarray(mcg.preprocess(whole).covariances)
    few = mcg.preprocess(mcg.PointCloud(source.points[rows], source.channels[rows], covariances=given[rows]))
    options = {"max_distance": GATE, "hold_unconstrained": False, **TO_ROUNDING}
    expected = mcg.register(few, target, mcg.GICP(), **options)
    found = mcg.register(source, target, mcg.GICP(), max_source_points=150, **options)
    np.testing.assert_allclose(found.matrix, expected.matrix, atol=1e-10)
    assert found.num_inliers == expected.num_inliers <= 150
    np.testing.assert_allclose(found.overlap, found.num_inliers / 150)


@pytest.mark.parametrize("count, matched", [(150, 150), (401, 400)])
def test_only_some_points_are_matched_in_every_phase(clouds, count, matched):
    """All, if there are fewer."""
    result = mcg.register(*clouds, mcg.MultiChannelGICP(), max_source_points=count, max_distance=(1.0, 0.5))
    assert max(result.history["num_inliers"]) == matched
    assert result.num_inliers == round(float(result.overlap) * matched)


@pytest.mark.slow
def test_the_pose_of_a_padded_cloud_inside_jit_and_in_batches_is_the_same(clouds):
    """Of new clouds, too, of which nothing is computed yet."""
    options = {"max_distance": GATE, "max_source_points": 150}
    dense = options | {"search": mcg.DenseSearch()}

    def new():
        return [mcg.preprocess(cloud.unpad()) for cloud in clouds]

    def answer(source, target, init=None):
        result = mcg.register(source, target, mcg.GICP(), init=init, **dense)
        return result.matrix, result.overlap, result.covariance

    expected, (source, target) = answer(*new()), new()
    results = {"start": jax.jit(partial(answer, source, target))(np.eye(4))}
    results |= {"padded": answer(source.pad(512), target), "jit": jax.jit(answer)(source.pad(512), target)}
    for name, result in results.items():
        for actual, wanted, rtol in zip(result, expected, (1e-7, 1e-7, 1e-6), strict=True):
            np.testing.assert_allclose(actual, wanted, rtol=rtol, atol=1e-9 * (rtol < 1e-6), err_msg=name)
    batches = mcg.register_batch(*zip(new(), new(), strict=True), mcg.GICP(), **dense)
    with compilations() as compiled:
        batches += mcg.register_batch(*zip(new(), new(), strict=True), mcg.GICP(), **dense)
    assert not compiled
    for result in (*batches, *mcg.register_batch([source], [target], mcg.GICP(), **options)):
        np.testing.assert_allclose(result.matrix, expected[0], atol=1e-6)
        np.testing.assert_allclose(result.overlap, expected[1], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [mcg.MultiChannelGICP([0.05, 0.08], 0.3, epsilon=1e-2), mcg.GICP(epsilon=1e-2), mcg.PointToPoint()],
    ids=["mc-gicp", "gicp", "point-to-point"],
)
def test_gradients_agree_with_differences(clouds, method):
    source, target = clouds
    method = jax.tree.map(lambda number: jnp.asarray(number, float), method)
    options = {"max_distance": GATE, "max_source_points": 150, "soft_matches": False, **TO_ROUNDING}
    start = mcg.register(source, target, method, **options)

    def loss(inputs):
        moved = clouds_with(inputs, source, target)
        return weigh(mcg.register(*moved, inputs["method"], init=start.matrix, **options).matrix)

    inputs = inputs_of(source, target, method, None)
    gradient = check_eager_gradient(loss, inputs)
    used = np.zeros(400, bool)
    used[spread_rows(source.valid, 150)] = True
    others = np.abs(np.asarray(gradient["source points"]))[~used].sum(axis=1)
    # The others matter as neighbours of those, where the method computes covariances.
    assert not others.any() if isinstance(method, mcg.PointToPoint) else (others > 0).mean() > 0.9
    by_points = start.jacobian("source", "points")
    assert by_points.shape == (6, 400, 3) and by_points[:, used].any(axis=(0, 2)).mean() > 0.8


@pytest.mark.slow
def test_gradients_with_given_covariances_and_inside_jit(clouds):
    source, target = clouds
    source = source.replace(covariances=symmetric(covariances(mcg.GICP(), source)))

    def loss(points, covariances):
        cloud = source.replace(points=points, covariances=covariances)
        options = {"max_distance": GATE, "max_source_points": 150, "search": mcg.DenseSearch(), **TO_ROUNDING}
        return weigh(mcg.register(cloud, target, mcg.GICP(), **options).matrix)

    gradient = jax.grad(loss, argnums=(0, 1))
    inside = jax.jit(gradient)(source.points, source.covariances)
    assert all(np.abs(each).max() > 0 for each in inside)
    assert_alike(gradient(source.points, source.covariances), inside, 1e-9)


def test_invalid_numbers_are_named(clouds):
    for wrong in (0, -3, 3):
        options = {"max_source_points": wrong}
        refused(lambda o=options: mcg.register_batch(clouds, clouds, mcg.GICP(), **o), "max_source_points", wrong)


@pytest.mark.slow
def test_odometry_and_multiway_match_at_most_10000_points():
    clouds = pair(size=10_500)[1::-1]
    steps = [list(mcg.odometry(clouds, mcg.PointToPoint(), **given))[1] for given in ({}, {"max_source_points": None})]
    found = [step.registration for step in steps]
    found += mcg.multiway(clouds, mcg.PointToPoint()).registrations.values()
    matched = [round(result.num_inliers / float(result.overlap)) for result in found]
    assert matched == [10_000, 10_500, 10_000]


def test_the_command_line_takes_a_number_or_all(tmp_path):
    """And chooses parameters as `register` does, of the points that are matched."""
    *files, output = (str(tmp_path / name) for name in ("source.npz", "target.npz", "pose.txt"))
    for path, cloud in zip(files, pair(size=400)[:2], strict=True):
        io.write(path, cloud)
    poses = []
    for number, shown in ((150, "150"), (None, "all")):
        arguments = [*files, "--method", "mc-gicp", "--output", output, "--max-source-points", shown]
        assert main(["register", *arguments]) == 0
        expected = mcg.register(*map(io.read, files), mcg.MultiChannelGICP(), max_source_points=number)
        poses.append(io.read_poses(output)[0])
        np.testing.assert_allclose(poses[-1], expected.matrix, atol=1e-9)
    assert np.any(poses[0] != poses[1])


@pytest.mark.slow
def test_the_covariance_is_calibrated():
    """ξᵀ Σ⁻¹ ξ of the pose errors is distributed as χ² with six degrees of freedom: over 40 pairs, its mean of 6 has a
    standard error of 0.55. As for all points, a factor of two either way is the design effect's own error."""
    squares = []
    for seed in range(40):
        source, target, truth = pair(size=3000, seed=2 * seed + 10)
        result = mcg.register(source, target, mcg.MultiChannelGICP(), max_source_points=1000)
        twist = logarithm(np.linalg.inv(truth) @ result.matrix)
        squares.append(twist @ np.linalg.solve(np.asarray(result.covariance), twist))
    assert 3 < np.mean(squares) < 12
