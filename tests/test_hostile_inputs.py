"""Whatever comes in, there is an error that names it or an outcome that can be believed; and it stays as it was."""

import copy
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mcgicp_jax as mcg
from mcgicp_jax import Status
from mcgicp_jax.metrics import pose_error
from tests.scenes import motion, pair, room_corner

METHODS = {
    "point-to-point": mcg.PointToPoint(),
    "point-to-plane": mcg.PointToPlane(),
    "gicp": mcg.GICP(),
    "color-icp": mcg.ColorICP(0.1),
    "mc-gicp": mcg.MultiChannelGICP(),
    "photometric": mcg.MultiChannelGICP(photometric=True),
}
# All clouds fit into the smallest size class: one program per method serves them.
MOST = 128
UTM = np.array([4.5e5, 5.2e6, 300.0])
# What an error may be about.
NAMED = re.compile("(source|target|init|points|channels|channel_valid|max_distance): ")


SHAPES = {
    "room": lambda size, rng: room_corner(size, seed=int(rng.integers(100)))[0],
    "ball": lambda size, rng: rng.normal(size=(size, 3)),
    "plane": lambda size, rng: rng.normal(size=(size, 3)) * [1, 1, 0],
    "line": lambda size, rng: rng.normal(size=(size, 1)) * [1, 2, 3],
    "axis": lambda size, rng: rng.normal(size=(size, 1)) * [1, 0, 0],
    "one place": lambda size, rng: np.tile(rng.normal(size=3), (size, 1)),
    "few places": lambda size, rng: np.resize(rng.normal(size=(5, 3)), (size, 3)),
    "grid": lambda size, rng: np.rint(rng.normal(scale=2, size=(size, 3))),
}
PAINTS = {
    "noise": lambda size, rng: rng.normal(size=(size, 2)),
    "constant": lambda size, rng: np.ones((size, 2)),
    "one of them constant": lambda size, rng: rng.normal(size=(size, 2)) * [1, 0],
    "NaN": lambda size, rng: np.full((size, 2), np.nan),
    "some NaN": lambda size, rng: spoiled(rng.normal(size=(size, 2)), np.nan, 0.2, rng),
    "huge": lambda size, rng: rng.normal(scale=1e38, size=(size, 2)),
    "beyond float32": lambda size, rng: rng.normal(scale=1e300, size=(size, 2)),
    "tiny": lambda size, rng: rng.normal(scale=1e-40, size=(size, 2)),
    "integers": lambda size, rng: np.rint(rng.normal(scale=100, size=(size, 2))),
}


def spoiled(points, value, share, rng):
    return np.where(rng.random((len(points), 1)) < share, value, points)


def frozen(array):
    array = array.copy()
    array.setflags(write=False)
    return array


LAYOUTS = {
    "plain": lambda array: array,
    "columns": np.asfortranarray,
    "every other": lambda array: np.repeat(array, 2, axis=0)[::2],
    "backwards": lambda array: array[::-1].copy()[::-1],
    "read-only": frozen,
    "list": lambda array: array.tolist(),
    "jax": lambda array: jnp.asarray(array, jnp.float32),
    "big-endian": lambda array: array.astype(array.dtype.newbyteorder(">")),
}
DTYPES = (float, np.float32, np.float16, np.longdouble, int, np.uint8, bool)


@st.composite
def clouds(draw):
    """Points and channels as a user may have them, and whether they are said where channels are missing."""
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    size = draw(st.sampled_from([0, 1, 3, 4, 5, 20, 100, MOST]))
    scale = draw(st.sampled_from([1.0, 1.0, 1.0, 1e-6, 1e-3, 1e3, 1e6, 1e-300, 1e-30, 1e18, 1e30, 1e39]))
    offset = draw(st.sampled_from([np.zeros(3), np.zeros(3), UTM, np.full(3, 1e12)]))
    points = scale * SHAPES[draw(st.sampled_from(list(SHAPES)))](size, rng) + offset
    value = draw(st.sampled_from([None, None, np.nan, np.inf, -np.inf, 0.0, 1e30, 1e200]))
    if value is not None:
        points = spoiled(points, value, draw(st.sampled_from([0.02, 0.5, 1.0])), rng)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        points = points.astype(draw(st.sampled_from(DTYPES)))
        layout = draw(st.sampled_from(list(LAYOUTS)))
        points = LAYOUTS[layout](points) if size or layout != "list" else np.zeros((0, 3))
    values = PAINTS[draw(st.sampled_from(list(PAINTS)))](size, rng)
    return points, LAYOUTS[draw(st.sampled_from(["plain", "columns", "read-only"]))](values), draw(st.booleans())


def outcome(function):
    """A registration that can be believed, or None for an error that names what is wrong. No arithmetic warns."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        warnings.simplefilter("error", RuntimeWarning)
        try:
            result = function()
        except ValueError as error:
            assert NAMED.match(str(error)), str(error)
            return None
    status, rotation = result.status, result.matrix[:3, :3]
    assert isinstance(status, Status) and status not in (Status.INVALID_INPUT, Status.WORKER_FAILED)
    if status is not Status.NON_FINITE:
        assert np.isfinite(result.matrix).all()
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
    if status is Status.TOO_FEW_CORRESPONDENCES:
        assert result.num_inliers < 4
    if status is Status.CONVERGED:
        assert result.num_inliers >= 4 and 0 < result.overlap <= 1
        assert np.isfinite([result.cost, result.rmse]).all() and np.isfinite(result.information).all()
        assert all(direction.constrained_by_channels for direction in result.unconstrained_directions)
    assert status.name in repr(result)
    return result


@pytest.mark.parametrize("size", [1e18, 1e38])
@pytest.mark.parametrize("name", ["mc-gicp", "photometric"])
def test_squares_of_channels_may_overflow(name, size):
    points = np.random.default_rng(0).normal(size=(40, 3))
    channels = size * np.random.default_rng(1).uniform([-1, 0.5], 1, (40, 2))
    for gain in (1, 1.8):
        clouds = mcg.PointCloud(points, channels), mcg.PointCloud(points, gain * channels)
        assert outcome(lambda clouds=clouds: mcg.register(*clouds, METHODS[name]))


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_distances_may_overflow():
    points = np.float32(2e38) * np.random.default_rng(0).choice([-1.0, 1.0], (40, 3)).astype(np.float32)
    clouds = mcg.PointCloud(points), mcg.PointCloud(-points[:1])
    matches = mcg.find_correspondences(*clouds, np.eye(4), mcg.GICP(), max_distance=1e38)
    assert not np.any(matches.valid & np.isinf(matches.distances)) and np.any(np.isinf(matches.distances))


@pytest.mark.parametrize("equalize", [False, True])
def test_differences_of_channels_may_overflow(equalize):
    points = np.random.default_rng(0).uniform(size=(4, 3))
    cloud = mcg.PointCloud(points, np.float32([[-9e37], [3.3e38], [-4e37], [-3.2e37]]))
    assert outcome(lambda: mcg.register(cloud, cloud, METHODS["color-icp"], equalize_channels=equalize))


@settings(max_examples=80, deadline=None)
@given(st.data())
def test_register_survives_anything(data):
    method = METHODS[data.draw(st.sampled_from(list(METHODS)))]
    usual = (room_corner(100, seed=5)[0], room_corner(100, seed=6)[1], False)
    source = data.draw(clouds())
    target = data.draw(st.one_of(st.just(source), st.just(usual), clouds()))
    if data.draw(st.booleans()):
        source, target = target, source
    inits = [None, None, motion(), motion((1e6, 0, 0, 0, 0, 3)), motion((1e30, 0, 0, 0, 0, 1))]
    options = {
        "init": data.draw(st.sampled_from(inits)),
        "max_distance": data.draw(st.sampled_from([None, None, 0.5, (1.0, 0.1), 1e-9, np.inf])),
    }
    values = [array for cloud in (source, target) for array in cloud[:2]]
    before = [copy.deepcopy(np.asarray(array)) for array in values]

    def register():
        raw = [
            mcg.PointCloud(points, channels, channel_valid=np.isfinite(channels) if masked else None)
            for points, channels, masked in (source, target)
        ]
        return mcg.register(*raw, method, **options)

    outcome(register)
    for array, kept in zip(values, before, strict=True):
        np.testing.assert_array_equal(np.asarray(array), kept)


@pytest.mark.parametrize("kind", ["copies", "beams without an echo", "second returns"])
def test_points_in_one_place_do_not_set_the_default_distance(kind):
    """The spacing seemed to be the distance of the two returns, and the fine phase found no matches."""
    *clouds, truth = pair(size=1000)
    source, target = (np.asarray(cloud.unpad().points) for cloud in clouds)
    if kind == "second returns":
        rng = np.random.default_rng(0)
        source, target = (np.concatenate([side, side + rng.normal(0, 1e-4, side.shape)]) for side in (source, target))
    else:
        target = np.concatenate([target, target if kind == "copies" else np.zeros((1200, 3))])
    result = mcg.register(source, target, mcg.GICP())
    assert result.converged and max(pose_error(result.matrix, truth)) < 1e-2


def around(radius, count):
    """Places at a distance from the sensor, metres."""
    directions = np.random.default_rng(0).normal(size=(count, 3))
    return radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def room(precision):
    """A pair, its true pose, and the registration of the two clouds."""
    *clouds, truth = pair(size=2000)
    return clouds, truth, mcg.register(*clouds, mcg.GICP())


@pytest.mark.parametrize(
    ("place", "count"),
    [(0.0, 700), (999.0, 10), (-9999.0, 10), (999.0, 1), (65.535, 5), (around(999, 20), 20), (around(100, 5), 5)],
)
def test_rays_without_return_do_not_change_the_pose(place, count, room):
    """They lie at one place in both clouds, wherever the sensor is, and far ones beyond all points, few ones also at
    different places."""
    clouds, truth, expected = room
    rows = np.broadcast_to(place, (count, 3)).astype(np.float32)
    with pytest.warns(UserWarning, match="as sensors report rays without return"):
        result = mcg.register(*(np.concatenate([cloud.points, rows]) for cloud in clouds), mcg.GICP())
    assert result.status == expected.status == Status.CONVERGED
    assert max(pose_error(result.matrix, truth)) < 1.1 * max(pose_error(expected.matrix, truth)) + 1e-3


def test_warnings_name_the_cloud_and_show_the_line_of_the_caller():
    clouds = [np.vstack([room_corner(100, seed=seed)[0], [[np.nan, 0, 0]]]) for seed in (0, 1)]
    with pytest.warns(UserWarning, match="left out") as caught:
        mcg.register(*clouds, mcg.GICP(), max_distance=0.5)
        mcg.register_batch(clouds[:1], clouds[1:], mcg.GICP(), max_distance=0.5)
    texts = [str(warning.message).split(" left")[0] for warning in caught]
    assert texts == ["source:", "target:", "pair 0: source:", "pair 0: target:"]
    # Run-time checks of annotations wrap each function of the package.
    assert all(warning.filename == __file__ or "jaxtyping" in warning.filename for warning in caught)


OTHER_UNIT = r"points: the source extends over .* the target over .* unit"


@pytest.mark.parametrize("unit", [1e-3, 1e2])
def test_different_units_of_length_are_warned_of(unit):
    """Of raw and preprocessed clouds, cells, and of one pair in a batch, which the warning names."""
    source, target = unit * room_corner(600)[0], room_corner(600, seed=1)[0]
    ready = [mcg.preprocess(cloud) for cloud in (source, target)]
    cells = [mcg.voxel_gaussians(cloud, 0.3 * size) for cloud, size in ((source, unit), (target, 1))]
    options = {"max_distance": 0.5, "max_iterations": 1}
    for clouds, method in (((source, target), mcg.GICP()), (ready, mcg.GICP()), (cells, mcg.D2DNDT())):
        with pytest.warns(UserWarning, match=rf"^{OTHER_UNIT}"):
            mcg.register(*clouds, method, **options)
    with pytest.warns(UserWarning, match=f"^pair 1: {OTHER_UNIT}") as caught:
        mcg.register_batch([target, ready[0]], [target, ready[1]], mcg.GICP(), **options)
    (text,) = (str(cloud.message) for cloud in caught if "same unit" in str(cloud.message))
    extents = [float(number) for number in re.findall(r"over (\S+) with", text)]
    assert extents == pytest.approx([np.ptp(source, axis=0).max(), np.ptp(source, axis=0).max() / unit], rel=0.2)


def unit_warnings(source, target):
    """Of a registration, as far as they are about the unit of length."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mcg.register(source, target, mcg.PointToPoint(), max_distance=0.5, max_iterations=1, max_source_points=100)
    return [warning for warning in caught if re.search(OTHER_UNIT, str(warning.message))]


def test_clouds_of_one_unit_and_different_extents_are_not_warned_of():
    """A small part of a map, and a thinned cloud."""
    source, target = np.tile(room_corner(20_000)[0], (2, 1)), room_corner(200, seed=1)[0]
    part = source[np.linalg.norm(source, axis=1) < 0.045]
    far = np.vstack([source, np.full((10, 3), 1e6), np.full((10, 3), np.nan), np.full((10, 3), 1e300)])
    for clouds in ((part, source), (source, part), (source, target), (far, target)):
        assert not unit_warnings(*clouds)


@pytest.mark.slow
def test_real_clouds_of_one_scene_are_in_one_unit(data):
    """A scan, its half, its far end, and voxels of it against a map; but not in millimetres."""
    scans = [mcg.io.read(data / f"kitti/sequences/04/velodyne/{i:06d}.bin").points for i in (0, 4, 8)]
    pairs = [[scans[0], np.concatenate(scans)]]
    pairs += [[mcg.io.read(data / f"lidar_pair/{side}.ply").points for side in ("source", "target")]]
    for scan, whole in pairs:
        target = mcg.preprocess(whole, 0.2)
        for form in (scan, scan[::8], scan[scan[:, 0] > np.quantile(scan[:, 0], 0.9)], mcg.preprocess(scan, 1.0)):
            assert not unit_warnings(form, target) and not unit_warnings(target, form)
        assert unit_warnings(scan * 1e-3, target)


@pytest.fixture
def checks():
    with jax.debug_nans(True), jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield


@pytest.mark.parametrize("name", ["mc-gicp", pytest.param("photometric", marks=pytest.mark.slow)])
def test_register_passes_under_strict_checks_of_jax(name, checks):
    (points, channels), target = (room_corner(600, seed=seed) for seed in (1, 2))
    measured = np.random.default_rng(0).random(channels.shape) < 0.8
    # Gradients of JAX's own functions fail under this guard.
    with jax.transfer_guard("disallow"):
        source = mcg.PointCloud(points, channels, channel_valid=measured)
        result = mcg.register(source, mcg.PointCloud(*target), METHODS[name])
        assert np.isfinite(result.covariance).all() and np.isfinite(result.deviations).all()


@pytest.mark.slow
def test_gradients_pass_under_strict_checks_of_jax(checks):
    source, target, truth = pair(size=600)
    method = METHODS["mc-gicp"].resolve(source, target)
    matches = mcg.find_correspondences(source, target, truth, method, max_distance=0.2)

    def height(points):
        return mcg.register(source.replace(points=points), target, method).centred.translation()[2]

    def cost(points):
        return mcg.mahalanobis_cost(truth, source.replace(points=points), target, matches, method)

    for function in (height, cost, jax.jit(cost)):
        gradient = jax.grad(function)(jnp.asarray(source.points))
        assert np.isfinite(gradient).all() and np.any(gradient)
