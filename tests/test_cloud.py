"""The point cloud as a container: nothing is lost on the way in, out, through jit, or into a file."""

import pickle
import warnings
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from mcgicp_jax import KDTreeSearch, PointCloud, preprocess
from mcgicp_jax.datasets import Frame
from tests import reference as ref
from tests.precision import tolerance
from tests.refusals import refused

POINTS, CHANNELS = ref.scene(150, 2)
T = ref.pose([0.3, -0.5, 0.8], [1.0, -2.0, 0.5])
UTM = np.array([512_345.6, 5_403_210.9, 312.3])


def covariances(seed=0):
    root = np.random.default_rng(seed).normal(size=(150, 3, 3))
    return (root @ root.swapaxes(1, 2)).astype(np.float32).astype(float)


def partial(seed=0, share=0.4):
    """Which points have which of the two channels."""
    return np.random.default_rng(seed).random((150, 2)) < share


def raw(**kwargs):
    return PointCloud(POINTS, CHANNELS, channel_names=("intensity", "heat"), **kwargs)


def ready(cloud=None):
    return preprocess(raw(covariances=covariances()) if cloud is None else cloud, num_neighbors=4).pad(160)


def foreign(points, colors=()):
    """Like a cloud of Open3D."""
    return SimpleNamespace(points=points, colors=colors)


def assert_same(a, b):
    assert a.channel_names == b.channel_names
    for name in a.__dataclass_fields__.keys() - {"channel_names"}:
        values, others = jax.tree.leaves(getattr(a, name)), jax.tree.leaves(getattr(b, name))
        for array, other in zip(values, others, strict=True):
            assert np.asarray(array).dtype == np.asarray(other).dtype
            np.testing.assert_array_equal(array, other)


def test_a_missing_channel_is_stored_as_zero():
    """Whatever stands there, NaN mostly: it never reaches arithmetic."""
    values = np.where(partial(), CHANNELS, np.nan)
    for form in (np.asarray, jnp.asarray):
        cloud = PointCloud(POINTS, form(values), channel_valid=form(partial()))
        np.testing.assert_array_equal(cloud.channels, np.where(partial(), CHANNELS, 0))
        np.testing.assert_array_equal(cloud.channel_valid, partial())
    # Channels may be a vector, or left out.
    single = PointCloud(POINTS, values[:, 0], channel_valid=partial()[:, 0])
    np.testing.assert_array_equal(single.channels, cloud.channels[:, :1])
    np.testing.assert_array_equal(single.channel_valid, partial()[:, :1])
    assert PointCloud(POINTS).channels.shape == (150, 0) and PointCloud(POINTS).channel_names == ()


def test_a_mask_that_does_not_fit():
    for make in (raw, raw().replace, raw(channel_valid=partial()).replace):
        for mask in (np.ones((150, 1), bool), np.ones((149, 2), bool), np.ones(150, bool), np.ones((150, 2))):
            refused(lambda make=make, mask=mask: make(channel_valid=mask), "channel_valid")


def test_replaced_channels_keep_the_mask():
    cloud = ready(raw(channel_valid=partial()))
    replaced = cloud.replace(channels=jnp.where(cloud.channel_valid, 2 * cloud.channels, jnp.nan))
    np.testing.assert_array_equal(replaced.channels, 2 * cloud.channels)
    np.testing.assert_array_equal(replaced.channel_valid, cloud.channel_valid)
    assert cloud.replace(channel_valid=None).channel_valid is None
    refused(lambda: cloud.replace(channels=jnp.zeros((160, 3))), "channel_valid", (160, 3))
    refused(lambda: cloud.replace(neighbors=cloud.neighbors), "replace", "preprocess(cloud) finds neighbors")
    # What is missing has no gradient.
    gradient = jax.grad(lambda channels: jnp.sum(cloud.replace(channels=channels).channels))(
        jnp.where(cloud.channel_valid, cloud.channels, jnp.nan)
    )
    np.testing.assert_array_equal(gradient, np.asarray(cloud.channel_valid, float))


@pytest.mark.parametrize("dtype", [np.float32, np.int16])
def test_masked_arrays_keep_their_mask(dtype):
    """The data under a mask is arbitrary, often a fill value such as 9999."""
    masked, measured = np.arange(150) % 10 == 3, partial()
    points, channels = (100 * POINTS).astype(dtype), (100 * CHANNELS).astype(dtype)
    coordinate = np.column_stack([np.zeros(150, bool), masked, np.zeros(150, bool)])
    hidden = np.ma.masked_array(np.where(coordinate, 9999, points).astype(dtype), coordinate)
    values = np.ma.masked_array(channels, ~measured)
    cloud = PointCloud(hidden, values)
    assert cloud.points.dtype == (np.float64 if dtype == np.int16 else dtype)
    np.testing.assert_array_equal(cloud.points, np.where(coordinate, np.nan, points))
    np.testing.assert_array_equal(cloud.channel_valid, measured)
    np.testing.assert_array_equal(cloud.channels, np.where(measured, channels, 0))
    with pytest.warns(UserWarning, match="left out 15 of 150 points"):
        assert len(preprocess(cloud, None)) == 135
    # With another mask, in a vector, in its replacement, without any masked value, and in a cloud of another library.
    both = PointCloud(points, values, channel_valid=np.ma.masked_array(np.ones((150, 2), bool), partial(1)))
    np.testing.assert_array_equal(both.channel_valid, measured & ~partial(1))
    np.testing.assert_array_equal(PointCloud(points, values[:, 0]).channel_valid, measured[:, :1])
    replaced = PointCloud(points, channels, channel_valid=~partial(1)).replace(channels=values)
    np.testing.assert_array_equal(replaced.channel_valid, measured & ~partial(1))
    np.testing.assert_array_equal(replaced.channels, np.where(measured & ~partial(1), channels, 0))
    single = PointCloud(points, channels[:, 0], channel_valid=np.ones(150, bool)).replace(channels=values[:, 0])
    np.testing.assert_array_equal(single.channel_valid, measured[:, :1])
    assert PointCloud(np.ma.masked_array(points), np.ma.masked_array(channels)).channel_valid is None
    np.testing.assert_array_equal(PointCloud(foreign(hidden)).points, cloud.points)
    structured = np.ma.masked_array(np.zeros(5, [(axis, dtype) for axis in "xyz"]))
    structured["x"] = np.ma.masked
    refused(lambda: PointCloud(structured), "points")


def test_padding_repeats_the_last_row_and_can_be_undone():
    for cloud in (raw(covariances=covariances(), channel_valid=partial()), ready()):
        padded = cloud.pad(343)
        assert padded.points.shape == (343, 3) and len(padded) == 150 and not padded.valid[150:].any()
        for name in ("points", "channels", "covariances"):
            rows = np.asarray(getattr(padded, name))
            np.testing.assert_array_equal(rows[150:], np.broadcast_to(rows[149], rows[150:].shape))
        assert_same(padded.unpad(), cloud.unpad())
    np.testing.assert_array_equal(padded.neighbors[:160], cloud.neighbors)
    assert (padded.neighbors[150:] == -1).all() and isinstance(padded.unpad().points, np.ndarray)
    np.testing.assert_array_equal(padded.unpad().points, POINTS)
    assert not raw(channel_valid=partial()).pad(160).channel_valid[150:].any()
    assert PointCloud(np.zeros((0, 3))).pad(4).points.shape == (4, 3)
    refused(PointCloud.stack([ready()] * 2).unpad, "points", "(2, 192, 3)")
    refused(lambda: raw().pad(149), "size")


def test_features_of_padded_clouds_have_the_derivatives_of_unpadded_ones():
    """The features are not defined at the origin: a NaN in a row that nothing reads would be one in each gradient."""

    def loss(weights, cloud):
        x, y, z = cloud.points.T
        features = jnp.stack([x / z, y / z, jnp.linalg.norm(cloud.points, axis=1), jnp.log(cloud.channels[:, 0])])
        return jnp.sum(jnp.where(cloud.valid, jnp.sin(weights @ features), 0))

    cloud, weights = PointCloud(POINTS + 2, np.abs(CHANNELS) + 0.5), jnp.array([0.3, -0.2, 0.1, 0.5])
    expected, gradient = jax.grad(loss)(weights, cloud), jax.grad(loss)
    batch = PointCloud.stack([cloud, cloud])
    for slopes in (
        gradient(weights, cloud.pad(200)),
        jax.jit(gradient)(weights, cloud.pad(200)),
        *jax.jit(jax.vmap(gradient, (None, 0)))(weights, batch),
        jax.jit(lambda weights, cloud: gradient(weights, cloud.pad(200)))(weights, cloud),
    ):
        np.testing.assert_allclose(slopes, expected, rtol=1e-4)


def test_replace_exchanges_and_leaves_the_rest():
    cloud = ready()
    replaced = cloud.replace(channels=jnp.ones_like(cloud.channels))
    assert replaced.points is cloud.points and not np.any(np.asarray(cloud.channels)[:150] == 1)
    # Also where JAX has no float64: without a warning of its own.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        PointCloud(np.zeros((5, 3))).replace(points=jnp.ones((5, 3), jnp.float32))
    assert len(cloud.replace(channels=jnp.zeros((160, 5))).channel_names) == 5
    assert cloud.replace(channels=np.zeros(160)).channels.shape == (160, 1)
    assert cloud.replace(covariances=None).covariances is None
    assert not cloud.replace(valid=[False] * 160, origin=[1, 2, 3]).pad(200).valid.any()
    times = np.linspace(0, 1, 160)
    assert cloud.replace(times=times).times is times and isinstance(cloud.replace(times=list(times)).times, np.ndarray)
    whole = np.round(100 * np.asarray(cloud.channels))
    assert_same(cloud.replace(channels=whole.astype(int)), cloud.replace(channels=whole))


def test_replace_refuses_what_does_not_fit():
    shapes = {"points": [(159, 3), (160, 2)], "channels": [(159, 2), (159,)], "covariances": [(160, 3), (5,)]}
    for name in shapes:
        for shape in shapes[name]:
            refused(lambda name=name, shape=shape: ready().replace(**{name: np.zeros(shape)}), name)
    refused(lambda: ready().replace(times=np.full(160, np.nan)), "times")
    refused(lambda: ready().replace(valid=np.ones(160)), "valid", "booleans")
    refused(lambda: ready().replace(origin="here"), "origin")
    refused(lambda: ready().replace(colour=np.zeros((160, 3))), "replace")


@pytest.mark.parametrize("form", ["numpy", "jax", "jaxlie"])
@pytest.mark.parametrize("cloud", [raw(covariances=covariances()), ready()], ids=["raw", "ready"])
def test_transform_moves_points_and_turns_covariances(form, cloud):
    pose = {"numpy": T, "jax": jnp.asarray(T), "jaxlie": jaxlie.SE3.from_matrix(jnp.asarray(T))}[form]
    moved = cloud.transform(pose)
    R, t = T[:3, :3], T[:3, 3]
    atol = tolerance(2e-6, 1e-12)
    np.testing.assert_allclose(np.asarray(moved.points)[:150], POINTS @ R.T + t, atol=atol)
    np.testing.assert_allclose(np.asarray(moved.covariances)[:150], R @ covariances() @ R.T, atol=10 * atol)
    np.testing.assert_array_equal(moved.channels, cloud.channels)
    assert moved.points.dtype == cloud.points.dtype


def test_transform_keeps_the_digits_of_large_coordinates():
    points, far = POINTS + UTM, T.copy()
    moved = ready(PointCloud(points)).transform(T).unpad().points
    np.testing.assert_allclose(moved, points @ T[:3, :3].T + T[:3, 3], rtol=0, atol=tolerance(2e-6, 1e-8))
    # By kilometres: a raw cloud has other points, a preprocessed one keeps its precision, and says where it is.
    far[:3, 3] += UTM
    expected = POINTS @ far[:3, :3].T + far[:3, 3]
    of_raw, of_ready = raw().transform(far), ready().transform(far)
    assert not np.any(of_raw.origin)
    np.testing.assert_allclose(of_raw.points, expected, rtol=0, atol=1e-8)
    for moved in (of_ready.coordinates[:150], of_ready.unpad().points):
        np.testing.assert_allclose(moved, expected, rtol=0, atol=tolerance(2e-6, 1e-8))


def test_transform_under_jit_and_grad():
    cloud = ready()
    pose = jnp.asarray(T, cloud.points.dtype)
    moved = jax.jit(PointCloud.transform)(cloud, pose)
    np.testing.assert_allclose(moved.points, cloud.transform(T).points, atol=tolerance(2e-6, 1e-12))
    gradient = jax.grad(lambda pose: jnp.sum(cloud.transform(pose).points[:150]))(pose)
    np.testing.assert_allclose(gradient[:3, 3], 150, rtol=1e-6)


def test_stack():
    moved = preprocess(raw(covariances=covariances()).transform(T), num_neighbors=4).pad(200)
    clouds = [ready(), moved]
    stacked = PointCloud.stack(clouds)
    assert stacked.points.shape == (2, 256, 3) and "2" in repr(stacked)
    for i, cloud in enumerate(clouds):
        lane = jax.tree.map(lambda leaf, i=i: leaf[i], stacked)
        assert_same(lane.unpad(), cloud.unpad())
        np.testing.assert_array_equal(lane.neighbors[:150], cloud.neighbors[:150])
        assert not np.any(lane.valid[150:])
    far = [ready(PointCloud(POINTS + UTM)), ready(PointCloud(POINTS - UTM))]
    origins = PointCloud.stack(far).origin
    np.testing.assert_array_equal(origins, [cloud.origin for cloud in far])
    assert np.asarray(origins).dtype == np.float64
    refused(lambda: PointCloud.stack([]), "clouds")
    for of_single_clouds in (stacked.pad, stacked.unpad, lambda: stacked.transform(T)):
        refused(of_single_clouds, "points", (2, 256, 3))


def test_stack_of_whole_and_partial_channels():
    clouds, masks = [ready(raw()), ready(raw(channel_valid=partial()))], [np.ones((150, 2), bool), partial()]
    assert PointCloud.stack(clouds[:1] * 2).channel_valid is None
    for order in (slice(None), slice(None, None, -1)):
        stacked = PointCloud.stack(clouds[order])
        np.testing.assert_array_equal(stacked.channel_valid[:, :150], masks[order])
        np.testing.assert_array_equal(stacked.channels[:, :160], [cloud.channels for cloud in clouds[order]])


def test_a_cloud_is_pickled_whose_search_is_defined_in_a_function():
    class Search(KDTreeSearch):
        pass

    # So many that not all neighbours are found yet.
    cloud = preprocess(np.random.default_rng(0).random((5000, 3)), search=Search())
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(cloud)).neighbors, cloud.neighbors)


def test_a_cloud_goes_through_jit():
    cloud = ready()
    through = jax.jit(lambda cloud: cloud)(cloud)
    assert isinstance(through, PointCloud)
    assert_same(through.replace(origin=cloud.origin), cloud)
    assert not np.any(through.origin)
    flat, structure = jax.tree.flatten(cloud)
    assert_same(jax.tree.unflatten(structure, flat), cloud)


def test_clouds_whose_neighbours_are_still_to_be_found_have_the_structure_of_others():
    fresh = preprocess(raw(), num_neighbors=4)
    compiled = jax.jit(lambda cloud: cloud.neighbors).lower(fresh).compile()
    np.testing.assert_array_equal(compiled(fresh), fresh.neighbors)
    inside = jax.jit(lambda points: preprocess(PointCloud(points, CHANNELS), None, num_neighbors=4))(POINTS)
    np.testing.assert_array_equal(inside.neighbors, fresh.neighbors)
    (moved,), _ = jax.lax.scan(lambda carry, _: ((carry[0].transform(np.eye(4)),), None), (fresh,), length=2)
    both = jax.tree.map(lambda one, other: one.shape == other.shape, preprocess(raw(), num_neighbors=4), moved)
    assert all(jax.tree.leaves(both))


def test_repr_is_short_and_says_what_matters():
    for cloud, *expected in (
        (raw(), "150", "intensity, heat"),
        (ready(), "150", "160", "4"),
        (ready(raw(channel_valid=partial())), "33%", "35%"),
        (ready(PointCloud(POINTS + UTM)), "e+06"),
    ):
        text = repr(cloud)
        assert len(text) < 160 and text.startswith("PointCloud(") and all(part in text for part in expected)
        inside = []
        jax.jit(lambda cloud, inside=inside: inside.append(repr(cloud)) or cloud.points)(cloud)
        assert str(len(cloud.points)) in inside[0]
        # Leaves that are no arrays.
        assert f"points=({len(cloud.points)}, 3)" in repr(jax.tree.map(np.shape, cloud))
        assert "ShapeDtypeStruct" in repr(jax.eval_shape(lambda cloud: cloud, cloud))


def test_a_rotation_of_few_digits_becomes_one():
    typed = np.round(T, 4)
    assert np.abs(typed[:3, :3] @ typed[:3, :3].T - np.eye(3)).max() > 1e-6
    moved = raw().transform(typed)
    lengths = [np.linalg.norm(points[1:] - points[:-1], axis=1) for points in (np.asarray(moved.points), POINTS)]
    np.testing.assert_allclose(*lengths, rtol=1e-6)


def test_clouds_of_other_libraries_are_taken(tmp_path):
    points = np.random.default_rng(0).normal(size=(5, 3))
    fields = [(name, "f4") for name in ("x", "y", "z", "rgb")] + [(name, "u2") for name in ("ring", "reflectivity")]
    structured = np.zeros((1, 5), [*fields, ("name", "U3")])
    structured["x"], structured["y"], structured["z"] = points.T[:, None]
    structured["reflectivity"] = np.arange(5)
    # As of PCL and ROS: 0x00RRGGBB in the bits of a float.
    structured["rgb"] = np.full(5, 0x00FF3300, np.uint32).view(np.float32)
    cloud = PointCloud(structured)
    # As in files, rings and other metadata are no channels.
    assert cloud.channel_names == ("intensity", "red", "green", "blue")
    np.testing.assert_allclose(cloud.points, points, atol=1e-6)
    np.testing.assert_allclose(cloud.channels, [[i, 1, 0.2, 0] for i in range(5)], atol=1e-7)
    colored = PointCloud(foreign(points, 0.5 * np.abs(points)))
    assert colored.channel_names == ("red", "green", "blue")
    np.testing.assert_array_equal(colored.points, points)
    for none in ([], np.zeros((0, 3))):
        assert PointCloud(foreign(points, none)).channels.shape == (5, 0)
    rows = np.zeros(5, [(name, "f4") for name in ("x", "y", "z", "heat", "dust")])
    rows["heat"] = [1, np.nan, 3, 4, np.nan]
    cloud = PointCloud(rows)
    np.testing.assert_array_equal(cloud.channel_valid, np.stack([~np.isnan(rows["heat"]), np.ones(5, bool)], axis=1))
    np.testing.assert_array_equal(cloud.channels[:, 0], [1, 0, 3, 4, 0])
    for wrong, shown in (
        ("scan.ply", "scan.ply"),
        (tmp_path / "scan.ply", "io.read"),
        ({"x": points}, "dict"),
        (Frame(cloud), "Frame"),
        (cloud, "PointCloud"),
        (points.T, (3, 5)),
        (np.hstack([points, points]), (5, 6)),
        (np.zeros((2, 4, 3)), (2, 4, 3)),
        (structured[["x", "y", "ring"]], "x, y, ring"),
    ):
        refused(lambda wrong=wrong: PointCloud(wrong), "points", shown)
    refused(lambda: PointCloud(points, points[:, :2], channel_names="ab"), "channel_names", "ab")


def test_what_other_libraries_have_instead_of_arrays():
    laspy, small_gicp = pytest.importorskip("laspy"), pytest.importorskip("small_gicp")
    las = laspy.LasData(laspy.LasHeader(point_format=3))
    las.xyz = points = np.random.default_rng(0).normal(size=(5, 3))
    for wrong in (las, las.points, las.points.array):
        refused(lambda wrong=wrong: PointCloud(wrong), "points", "las.xyz")
    refused(lambda: PointCloud(small_gicp.PointCloud(points)), "points", "cloud.points()[:, :3]")
    refused(lambda: PointCloud(points[None]), "points", "register_batch")

    class Tensor:
        """As one of torch that requires a gradient."""

        def __array__(self, *_, **__):
            raise RuntimeError("Can't call numpy() on Tensor that requires grad.")

        def __len__(self):
            return 5

    refused(lambda: PointCloud(Tensor()), "points", "requires grad", ".detach()")
    refused(lambda: PointCloud(points, Tensor()), "channels", "requires grad", ".detach()")


def test_tables_with_named_columns_and_clouds_of_tensors():
    """Stand-ins with the members that pandas and Open3D have."""
    rng = np.random.default_rng(0)
    points, colors = rng.normal(size=(5, 3)).astype(np.float32), rng.integers(0, 256, (5, 3)).astype(np.uint8)

    class Table:
        def to_records(self, index):
            assert not index
            return np.rec.fromarrays([*points.T, colors[:, 0] / 255], names="x,y,z,intensity")

    cloud = PointCloud(Table())
    assert cloud.channel_names == ("intensity",)
    np.testing.assert_array_equal(cloud.points, points)

    class Attributes(dict):
        __getattr__ = dict.__getitem__

    positions = SimpleNamespace(numpy=lambda: points)
    for array in (colors, 257 * colors.astype(np.uint16), (colors / 255).astype(np.float32)):
        tensor = SimpleNamespace(numpy=lambda array=array: array)
        cloud = PointCloud(SimpleNamespace(point=Attributes(positions=positions, colors=tensor)))
        assert cloud.channel_names == ("red", "green", "blue")
        np.testing.assert_allclose(cloud.channels, colors / 255, rtol=1e-6)
    assert PointCloud(SimpleNamespace(point=Attributes(positions=positions))).channels.shape == (5, 0)


def test_points_of_a_depth_image():
    """For whole millimetres and for metres."""
    rng = np.random.default_rng(0)
    depth = rng.integers(300, 4000, (5, 7)).astype(np.uint16)
    depth[0, 1], depth[2, 3] = 0, 65535
    color, (fx, fy, cx, cy) = rng.integers(0, 256, (5, 7, 3)).astype(np.uint8), (6.5, 6.0, 3.1, 2.2)
    camera = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    row, column = np.nonzero((depth > 0) & (depth <= 3000))
    z = depth[row, column] / 1000
    points, colors = np.stack([(column - cx) * z / fx, (row - cy) * z / fy, z], axis=1), color[row, column] / 255
    cloud = PointCloud.from_depth(depth, (fx, fy, cx, cy), color, max_depth=3)
    np.testing.assert_allclose(cloud.points, points, rtol=1e-6)
    np.testing.assert_allclose(cloud.channels, colors, rtol=1e-6)
    assert cloud.channel_names == ("red", "green", "blue") and cloud.points.dtype == np.float32
    metres = np.where(np.isin(depth, (0, 65535)), np.nan, depth / 1000)
    grey = PointCloud.from_depth(metres, camera, color[..., 0] / 255, max_depth=3)
    np.testing.assert_allclose(grey.points, points, rtol=1e-12)
    np.testing.assert_allclose(grey.channels[:, 0], colors[:, 0])
    assert grey.channel_names == ("intensity",)
    half = PointCloud.from_depth(depth, camera, scale=2000, max_depth=1.5)
    np.testing.assert_allclose(half.points, points / 2, rtol=1e-6)
    refused(lambda: PointCloud.from_depth(depth[None], camera), "depth")
    refused(lambda: PointCloud.from_depth(depth, np.eye(4)), "intrinsics")
    refused(lambda: PointCloud.from_depth(depth, camera, color[:, :3]), "color")
    refused(lambda: PointCloud.from_depth(depth, camera, scale=0), "scale")


def test_crop_keeps_points_of_a_range():
    cloud, ranges = raw(covariances=covariances(), channel_valid=partial()), np.linalg.norm(POINTS, axis=1)
    low, high = np.quantile(ranges, [0.2, 0.7])
    kept = (ranges >= low) & (ranges <= high)
    for cropped in (cloud.crop(low, high), cloud.pad(160).crop(low, high)):
        np.testing.assert_array_equal(cropped.points, POINTS[kept])
        np.testing.assert_array_equal(cropped.channel_valid, partial()[kept])
        np.testing.assert_array_equal(cropped.covariances, covariances()[kept])
    assert_same(cloud.crop(), cloud)
    refused(lambda: cloud.crop(2, 1), "min_range")
