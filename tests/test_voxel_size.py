"""The automatic voxel size: chosen from the shape of neighbourhoods, one for all clouds of a call, and said."""

import pickle

import jax
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import datasets
from mcgicp_jax._clouds.voxel_size import Shape, _Averages, _without_lines
from tests.precision import in_float64
from tests.refusals import refused

RNG = np.random.default_rng(0)


def lines(spacing=0.5, along=0.02, size=8.0, seed=0):
    """A floor and a wall, seen as scan lines: points every 2 cm along lines that are half a metre apart."""
    rng = np.random.default_rng(seed)
    along, across = np.meshgrid(np.arange(0, size, along), np.arange(0, size, spacing) + rng.random() * spacing)
    flat = np.stack([along.ravel(), across.ravel(), np.zeros(along.size)], axis=1)
    wall = flat[:, [0, 2, 1]] + [0, 8.0, 0]
    return np.concatenate([flat, wall]) + rng.normal(scale=0.002, size=(2 * along.size, 3))


def even(count=3000, noise=0.0, seed=0):
    """A square of 10 m with points spread evenly."""
    rng = np.random.default_rng(seed)
    return np.column_stack([10 * rng.random((count, 2)), noise * rng.normal(size=count)])


def extents(points, k=20):
    """Brute force: the three extents of the k nearest points of some points, the largest first."""
    points = np.asarray(points, float)
    sample = points[:: max(len(points) // 400, 1)]
    rows = np.argsort(((sample[:, None] - points) ** 2).sum(-1), axis=1)[:, :k]
    offsets = points[rows] - points[rows].mean(axis=1, keepdims=True)
    return np.linalg.svd(offsets, compute_uv=False).T


def fraction_of_lines(points):
    first, second, _ = extents(points)
    return np.mean(second < 0.2 * first)


def test_scan_lines_are_averaged_until_their_neighbourhoods_are_no_lines():
    raw = lines()
    assert fraction_of_lines(raw) > 0.9
    cloud = mcg.preprocess(raw)
    assert 0.05 < cloud.voxel_size < 0.5 and fraction_of_lines(cloud.points) < 0.1
    finer = mcg.preprocess(raw, cloud.voxel_size / 2)
    assert fraction_of_lines(finer.points) > 0.05
    with pytest.warns(UserWarning, match=r"^voxel_size: .*\d+%"):
        mcg.preprocess(raw, None)


def test_points_that_are_spread_evenly_are_kept():
    raw = even(noise=0.02)
    cloud = mcg.preprocess(raw)
    assert cloud.voxel_size is None and "voxels" not in repr(cloud)
    np.testing.assert_array_equal(cloud.points, raw.astype(np.float32))
    # As are clouds with covariances, small ones and planar scans.
    with_covariances = mcg.PointCloud(lines(), covariances=np.tile(np.eye(3), (len(lines()), 1, 1)))
    angle = np.linspace(0, 2 * np.pi, 1081)
    planar = np.stack([5 * np.cos(angle), 3 * np.sin(angle), np.zeros(1081)], axis=1)
    assert all(mcg.preprocess(cloud).voxel_size is None for cloud in (with_covariances, lines()[:499], planar))
    for wrong in ("large", 0.0, -1.0, (1.0,), float("nan")):
        refused(lambda wrong=wrong: mcg.preprocess(raw, wrong), "voxel_size")


def test_noise_is_averaged_and_warned_of_where_no_voxels_are_asked_for():
    thick = even(20_000, noise=0.1)
    cloud = mcg.preprocess(thick)
    assert "times as thick as wide" in repr(cloud)
    before, after = (np.median(third / second) for _, second, third in map(extents, (thick[::4], cloud.points)))
    assert before > 0.4 and after < 0.35
    with pytest.warns(UserWarning, match=r"^voxel_size: .*0\.\d+ times"):
        mcg.preprocess(thick, None)


def test_large_clouds_keep_at_most_40_000_voxels():
    raw = even(100_000)
    cloud = mcg.preprocess(raw)
    assert 20_000 < len(cloud) <= 40_000
    assert f"{cloud.voxel_size:g} m: at most 40,000 of 100,000 points" in repr(cloud)


def test_the_size_goes_with_the_unit_and_not_with_far_points_or_the_order():
    raw = lines()
    size = mcg.preprocess(raw).voxel_size
    assert mcg.preprocess(1000 * raw).voxel_size == pytest.approx(1000 * size)
    assert mcg.preprocess(np.append(raw, [[1e5, 0, 0]], axis=0)).voxel_size == size
    # The grid lies elsewhere in the cloud, and other points are sampled.
    for other in (raw + np.array([500_000, 5_000_000, 100]), np.random.default_rng(1).permutation(raw)):
        cloud = mcg.preprocess(other)
        assert 0.05 < cloud.voxel_size < 0.5 and fraction_of_lines(cloud.points) < 0.1


def test_degenerate_clouds_have_a_positive_size_or_none():
    one_place, one_line = np.zeros((600, 3)), RNG.random((600, 3)) * [1, 0, 0]
    duplicates = np.repeat(RNG.random((100, 3)), 6, axis=0)
    # The smallest size for this extent, rounded to two digits, has more voxels than can be numbered.
    far_point = np.append(lines(spacing=0.3), [[703_630, 0, 0]], axis=0)
    for raw in (one_place, duplicates, one_line, 1e30 * even(), far_point):
        size = mcg.preprocess(raw).voxel_size
        assert size is None or size > 0


def test_sparse_lines_are_averaged_as_far_as_500_points_remain():
    sparse = lines(spacing=1.0, along=0.05, size=16.0)
    assert fraction_of_lines(sparse) == 1
    cloud = mcg.preprocess(sparse)
    assert len(cloud) >= 500 and fraction_of_lines(cloud.points) < 0.5


def test_one_size_for_both_clouds_of_a_pair():
    coarse, fine = lines(0.6), lines(0.25)
    size = mcg.preprocess(coarse).voxel_size
    assert size > mcg.preprocess(fine).voxel_size
    ready, method = [mcg.preprocess(cloud, size) for cloud in (coarse, fine)], mcg.PointToPlane()
    expected = mcg.register(*ready, method).matrix
    # Also where the raw cloud has the voxels of a preprocessed one, and in a batch.
    results = [mcg.register(coarse, fine, method), mcg.register(coarse, ready[1], method)]
    for result in results + mcg.register_batch([coarse] * 2, [fine] * 2, method):
        np.testing.assert_array_equal(result.matrix, expected)


@pytest.mark.filterwarnings("ignore:.*left out 1 of")
def test_points_without_a_finite_channel_are_left_out_of_voxels_of_a_pair():
    raw = lines()
    channels = np.append(np.nan, np.zeros(len(raw) - 1))
    whole = mcg.PointCloud(raw[1:], channels[1:])
    results = [mcg.register(cloud, whole, mcg.PointToPlane()) for cloud in (mcg.PointCloud(raw, channels), whole)]
    np.testing.assert_array_equal(*(result.matrix for result in results))


def test_one_size_for_a_sequence_and_its_map():
    frames = [lines(spacing, seed=seed) for seed, spacing in enumerate((0.3, 0.5, 0.4))]
    steps = list(mcg.odometry(frames, mcg.PointToPlane()))
    assert {step.cloud.voxel_size for step in steps} == {mcg.preprocess(frames[0]).voxel_size}
    world = mcg.merge_clouds([step.cloud for step in steps], [step.pose for step in steps])
    assert world.voxel_size == steps[0].cloud.voxel_size
    result = mcg.multiway(frames, mcg.PointToPlane())
    assert len({cloud.voxel_size for cloud in result.clouds} | {result.voxel_size}) == 1


def test_raw_clouds_of_cells_keep_all_points():
    target, source = datasets.box_room(2, seed=3, points_per_frame=2000)
    result = mcg.register(source.cloud, target.cloud, mcg.NDT(), voxel_sizes=(0.5,))
    cells = mcg.voxel_gaussians(target.cloud, 0.5)
    np.testing.assert_array_equal(result.matrix, mcg.register(source.cloud, cells, mcg.NDT()).matrix)


def test_the_size_survives_what_users_do_with_clouds():
    cloud = mcg.preprocess(lines())
    assert pickle.loads(pickle.dumps(cloud)).voxel_size == cloud.voxel_size
    moved = cloud.transform(np.eye(4)).replace(channels=np.zeros((len(cloud), 1)))
    assert moved.voxel_size == cloud.voxel_size
    assert jax.tree.structure(cloud) == jax.tree.structure(mcg.preprocess(lines(), 0.3))


@in_float64
def test_derivatives_by_raw_points_go_through_the_means():
    """In voxels of a size that is chosen anew."""
    raw = lines(along=0.04)
    direction = RNG.normal(size=raw.shape)
    assert mcg.preprocess(raw).voxel_size is not None
    _, slopes = jax.jvp(lambda step: mcg.preprocess(raw + step * direction).points, (0.0,), (1.0,))
    # The means are linear in the points, as long as no point changes its voxel.
    ends = [mcg.preprocess(raw + step * direction).points for step in (1e-7, -1e-7)]
    np.testing.assert_allclose(slopes, (ends[0] - ends[1]) / 2e-7, atol=1e-6)


def test_neighbours_are_found_when_they_are_used():
    asked = []

    class Counted(mcg.KDTreeSearch):
        def query(self, tree, queries, k, bound):
            asked.append(len(queries) if k > 1 else 0)
            return super().query(tree, queries, k, bound)

    raw = even(30_000)
    clouds = [mcg.preprocess(cloud, search=Counted()) for cloud in (raw, raw)]
    mcg.register(*clouds, mcg.GICP(), max_source_points=500)
    assert sum(asked) < 0.5 * 2 * len(raw)
    whole = mcg.KDTreeSearch().neighbors(np.asarray(clouds[0].points), 20)
    sent = pickle.loads(pickle.dumps(mcg.preprocess(raw)))
    for cloud in (clouds[0], sent, jax.tree.map(lambda leaf: leaf, clouds[1])):
        np.testing.assert_array_equal(cloud.neighbors, whole)
    assert not clouds[0].neighbors.flags.writeable
    # By default, ten thousand points are matched.
    assert mcg.register(*clouds, mcg.GICP()).num_inliers == 10_000


@pytest.mark.slow
@pytest.mark.parametrize("rows", [(2, 0), (7, 5)])
def test_raw_scans_two_frames_apart_are_registered(data, rows):
    frames = datasets.kitti(data / "kitti" / "sequences" / "04")
    source, target = (frames[row] for row in rows)
    truth = np.linalg.inv(target.pose) @ source.pose
    for method in (mcg.PointToPlane(), mcg.GICP(), mcg.MultiChannelGICP()):
        result = mcg.register(source.cloud, target.cloud, method)
        assert result.converged and mcg.metrics.pose_error(result.matrix, truth)[0] < 0.06


class Measured(_Averages):
    """A cloud whose neighbourhoods have these fractions of lines and thicknesses, by the number of the voxel size."""

    def __init__(self, lines, thickness):
        self._shapes = [Shape(*shape, 0.01) for shape in zip(lines, thickness, strict=True)]

    def shows_scene(self, step):
        return step < 6

    def shape(self, step):
        return self._shapes[-1 if step is None else step]


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        # The last size has few, but makes neighbourhoods thick; that of all points comes last.
        pytest.param([0.24, 0.17, 0.13, 0.10, 0.12, 0.03, 0.25], 2, id="posts and edges"),
        pytest.param([0.24, 0.17, 0.04, 0.03, 0.02, 0.01, 0.25], 2, id="few"),
        pytest.param([0.9, 0.9, 0.8, 0.7, 0.6, 0.03, 0.9], None, id="a planar scan"),
    ],
)
def test_a_small_size_with_nearly_the_fewest_lines(lines, expected):
    cloud = Measured(lines, [0.1, 0.1, 0.2, 0.25, 0.28, 0.5, 0.1])
    assert _without_lines([cloud], None, range(7)) == expected
