"""Files: what is written comes back, what others write is understood, and what is broken says so in one ValueError."""

import dataclasses
import gzip
import io as stdio
import pickle
import struct
import sys
import tracemalloc
import zipfile

import laspy
import numpy as np
import plyfile
import pypcd4
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mcgicp_jax import PointCloud, io
from mcgicp_jax.io.clouds import is_cloud
from tests.refusals import refused

RNG = np.random.default_rng(0)
N = 40
INTENSITY = ("intensity",)
RGB = ("red", "green", "blue")
FORMATS = (".ply", ".pcd", ".las", ".laz", ".bin", ".npy", ".npz", ".xyz", ".txt", ".csv")
NAMED = (".ply", ".pcd", ".npz", ".xyz", ".txt", ".csv")
LAS = (".las", ".laz")
TEXT = (".xyz", ".txt", ".csv")


def make(names=INTENSITY, dtype=np.float32, num_points=N):
    """Points within 10 m; whole intensities, colours that are 255ths."""
    scale = {"intensity": 1} | dict.fromkeys(RGB, 255)
    channels = [
        RNG.integers(0, 256, num_points).astype(dtype) / dtype(scale[n]) if n in scale else RNG.random(num_points)
        for n in names
    ]
    points = RNG.uniform(-10, 10, (num_points, 3)).astype(dtype)
    return PointCloud(points, np.array(channels, dtype).reshape(len(names), num_points).T, channel_names=names)


def through(path, cloud):
    """The cloud, written and read."""
    io.write(path, cloud)
    return io.read(path)


def same(actual, expected, points_atol=0.0, channels_atol=0.0):
    """The values are those expected, whatever the order of the channels."""
    assert sorted(actual.channel_names) == sorted(expected.channel_names)
    order = [actual.channel_names.index(name) for name in expected.channel_names]
    np.testing.assert_allclose(actual.points, expected.points, rtol=0, atol=points_atol)
    np.testing.assert_allclose(actual.channels[:, order], expected.channels, rtol=0, atol=channels_atol)


def reads_as(path, expected, names=(), rtol=0.0, **options):
    """The file has these rows of x, y, z and channels, where a channel that is NaN is missing."""
    cloud, expected = io.read(path, **options), np.asarray(expected, float)
    measured = np.ones(cloud.channels.shape, bool) if cloud.channel_valid is None else cloud.channel_valid
    assert is_cloud(path) and cloud.channel_names == tuple(names) and not cloud.channels[~measured].any()
    np.testing.assert_array_equal(cloud.points, expected[:, :3])
    np.testing.assert_allclose(np.where(measured, cloud.channels, np.nan), expected[:, 3:], rtol=rtol)
    return cloud


def structured(**columns):
    rows = np.empty(len(next(iter(columns.values()))), [(name, np.asarray(v).dtype) for name, v in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    return rows


def xyz(dtype=np.float32):
    return dict(zip("xyz", RNG.uniform(-10, 10, (3, N)).astype(dtype), strict=True))


def write_ply(path, rows, text=False, byte_order="<", more=()):
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex"), *more], text=text, byte_order=byte_order).write(path)


def faces():
    """Triangles, as they follow the vertices of a mesh."""
    rows = np.array([((0, 1, 2),), ((2, 3, 4),)], [("vertex_indices", "i4", (3,))])
    return [plyfile.PlyElement.describe(rows, "face")]


def write_pcd(path, encoding=pypcd4.Encoding.BINARY, counts=None, **columns):
    values = [np.asarray(column) for column in columns.values()]
    types = [column.dtype for column in values]
    pypcd4.PointCloud.from_points(values, list(columns), types, counts).save(path, encoding)


def las_data(point_format=2, num_points=N, **columns):
    header = laspy.LasHeader(point_format=point_format)
    header.scales, header.offsets = np.full(3, 1e-3), np.array([500_000.0, 5_400_000.0, 100.0])
    las = laspy.LasData(header)
    las.xyz = header.offsets + RNG.integers(0, 10**6, (num_points, 3)) * 1e-3
    for name, values in columns.items():
        las[name] = values
    return las


def small_files(folder):
    """Small valid files of every format and encoding, by name."""
    for suffix in FORMATS:
        io.write(folder / f"ours{suffix}", make(INTENSITY if suffix == ".bin" else INTENSITY + RGB))
    for kind in ("text", "binary"):
        write_ply(folder / f"{kind}.ply", structured(**xyz()), kind == "text", more=faces())
    for encoding in pypcd4.Encoding:
        write_pcd(folder / f"{encoding.value}.pcd", encoding, **dict.fromkeys("xyz", np.zeros(N)))
    for point_format in (2, 7):
        las_data(point_format, red=np.arange(N)).write(str(folder / f"{point_format}.laz"))
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    return small_files(tmp_path_factory.mktemp("seeds"))


# Round trips


NAMES = [(), INTENSITY, INTENSITY + RGB, ("channel_0", "heat", *INTENSITY)]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    ("suffix", "names"),
    [(suffix, names) for suffix in FORMATS for names in (NAMES[:3] if suffix in LAS else NAMES) if suffix != ".bin"]
    + [(".bin", INTENSITY)],
)
def test_round_trip(tmp_path, suffix, names, dtype):
    cloud = make(names, dtype)
    back = through(tmp_path / f"cloud{suffix.upper()}", cloud)
    if suffix == ".npy":
        cloud = cloud.replace(channel_names=tuple(f"channel_{i}" for i in range(len(names))))
    atol = 1e-7 * (suffix in LAS) + 1e-6 * (suffix == ".bin")
    same(back, cloud, atol, atol)
    if suffix in (".ply", ".pcd", ".npz", ".npy"):
        assert back.points.dtype == dtype
        assert back.channels.dtype == dtype or not names


@pytest.mark.parametrize("suffix", NAMED)
def test_names_and_values_survive(tmp_path, suffix):
    taken = ("x", "X", "Red", "r", "rgb", "_", "list", "scalar_a", "1")
    extreme = make((*RGB, "heat"), np.float64)
    extreme.points[:4, 0] = [np.nan, np.inf, -np.inf, 5_400_000.123456789]
    extreme.channels[:5] = np.array([[np.inf], [1e308], [-1], [-0.0], [1 / 3]])
    mixed_precision = PointCloud(make().points, make(RGB, np.float64).channels, channel_names=RGB)
    for cloud in (make(("time", "reflectance", "intensity", "channel_time", *taken)), extreme, mixed_precision):
        same(through(tmp_path / f"c{suffix}", cloud), cloud)
    names = ("heat", *RGB, "intensity", "dust")
    ordered = names if suffix == ".npz" else ("intensity", *RGB, "heat", "dust")
    assert through(tmp_path / f"c{suffix}", make(names)).channel_names == ordered


def test_npz_keeps_everything(tmp_path):
    covariances = RNG.random((N, 3, 3))
    cloud = PointCloud(make().points, RNG.random((N, 2)), covariances=covariances, channel_names=("two words", "ü"))
    back = through(tmp_path / "c.npz", cloud)
    same(back, cloud)
    np.testing.assert_array_equal(back.covariances, covariances)


@pytest.mark.parametrize("suffix", [*NAMED, ".npy", ".bin"])
@pytest.mark.parametrize("share", [0.5, 1.0])
def test_a_missing_channel_is_missing_in_the_file(tmp_path, suffix, share):
    cloud, path = make(INTENSITY if suffix == ".bin" else ("intensity", *RGB)), tmp_path / f"c{suffix}"
    present = RNG.random(cloud.channels.shape) < share
    io.write(path, cloud.replace(channel_valid=present))
    expected = np.column_stack([cloud.points, np.where(present, cloud.channels, np.nan)])
    names = [f"channel_{i}" for i in range(4)] if suffix == ".npy" else cloud.channel_names
    assert (reads_as(path, expected, names).channel_valid is None) == (share == 1)


@pytest.mark.parametrize("suffix", FORMATS)
def test_only_valid_rows_in_the_users_frame(tmp_path, suffix):
    raw, valid = make(), np.arange(N) % 3 > 0
    origin = np.zeros(3) if suffix == ".bin" else np.array([500_000.0, 5_400_000.0, 0.0])
    back = through(tmp_path / f"c{suffix}", raw.replace_rows(valid=valid, origin=origin))
    atol = 1e-6 if suffix == ".bin" else 2e-8
    np.testing.assert_allclose(back.points, raw.points[valid].astype(np.float64) + origin, rtol=0, atol=atol)
    # Written again, it stays as it is.
    same(through(tmp_path / f"d{suffix}", back), back)


# PLY


@pytest.mark.parametrize(
    ("text", "byte_order", "dtype"), [(True, "=", np.float32), (False, "<", np.float64), (False, ">", np.float32)]
)
def test_ply_of_a_mesh_with_normals_and_colours(tmp_path, text, byte_order, dtype):
    points, intensity, colour = xyz(dtype), RNG.random(N).astype(dtype), np.arange(N, dtype=np.uint8)
    noise = dict.fromkeys(("nx", "ny", "nz", "alpha", "label", "ring", "time", "curvature"), np.ones(N, np.float32))
    columns = dict.fromkeys(RGB, colour) | {"heat": np.full(N, 3, dtype), "scalar_intensity": intensity}
    write_ply(tmp_path / "c.ply", structured(**points, **noise, **columns), text, byte_order, faces())
    expected = [*points.values(), intensity, *[colour.astype(dtype) / dtype(255)] * 3, columns["heat"]]
    cloud = reads_as(tmp_path / "c.ply", np.column_stack(expected), ("intensity", *RGB, "heat"))
    assert cloud.points.dtype == cloud.channels.dtype == dtype
    assert cloud.points.dtype.isnative and cloud.points.flags.writeable


@pytest.mark.parametrize(("dtype", "scale"), [(np.float32, 1), (np.uint8, 255), (np.uint16, 65535), (np.int32, 255)])
def test_names_of_intensities_and_colours(tmp_path, dtype, scale):
    def check(names, channels, rtol=0.0, **columns):
        points = xyz()
        write_ply(tmp_path / "c.ply", structured(**points, **columns))
        reads_as(tmp_path / "c.ply", np.column_stack([*points.values(), *channels]), names, rtol)

    intensity, other = np.arange(2 * N).astype(dtype).reshape(2, N)
    for name in ("intensity", "scalar_Intensity", "reflectance", "scalar_Reflectance", "reflectivity", "remission"):
        check(INTENSITY, [intensity], **{name: intensity})
    check(("intensity", "reflectivity"), [intensity, other], reflectivity=other, intensity=intensity)
    values = RNG.integers(0, 2, (3, N)) * (scale if scale > 1 else 0.5)
    for colours in ("r g b", "diffuse_red diffuse_green diffuse_blue", "Red Green Blue"):
        check(RGB, values / scale, 1e-6, **dict(zip(colours.split(), values.astype(dtype), strict=True)))


@pytest.mark.parametrize("newline", [b"\r\n", b"\r"])
def test_ply_newlines(tmp_path, newline):
    header = b"ply\nformat ascii 1.0\nelement vertex 2\n%send_header\n" % b"".join(
        b"property float %c\n" % axis for axis in b"xyz"
    )
    (tmp_path / "c.ply").write_bytes(header.replace(b"\n", newline) + b"1 2 3\n4 5 6\n")
    reads_as(tmp_path / "c.ply", ROWS)


def test_colours_are_written_as_others_read_them(tmp_path):
    cloud = make(("intensity", *RGB))
    colours = np.rint(cloud.channels[:, 1:] * 255).astype(np.uint8)
    for suffix in (".ply", ".pcd"):
        io.write(tmp_path / f"c{suffix}", cloud)
    ply, pcd = plyfile.PlyData.read(tmp_path / "c.ply"), pypcd4.PointCloud.from_path(tmp_path / "c.pcd")
    types = {column.name: column.val_dtype for column in ply["vertex"].properties}
    assert not ply.text and types == dict.fromkeys(("x", "y", "z", *INTENSITY), "f4") | dict.fromkeys(RGB, "u1")
    np.testing.assert_array_equal(np.column_stack([ply["vertex"][name] for name in RGB]), colours)
    assert pcd.fields == ("x", "y", "z", "intensity", "rgb")
    np.testing.assert_array_equal(pypcd4.PointCloud.decode_rgb(pcd.pc_data["rgb"]), colours)


# PCD


@pytest.mark.parametrize("encoding", pypcd4.Encoding)
@pytest.mark.parametrize(("field", "dtype"), [("rgb", np.float32), ("rgba", np.uint32)])
def test_pcd_encodings_and_packed_colours(tmp_path, encoding, field, dtype):
    colours = RNG.integers(0, 256, (N, 3), np.uint8)
    packed = colours.astype(np.uint32) @ np.array([65536, 256, 1], "u4") + (field == "rgba") * np.uint32(0xFE000000)
    points, counter = (RNG.integers(-9, 9, (3, N)) / 4).astype(np.float32), np.arange(N)
    columns = dict(zip("xyz", points, strict=True)) | {"intensity": counter.astype(np.float32)}
    # As text, a float of these bits has too few digits.
    text = encoding is pypcd4.Encoding.ASCII
    columns |= {"ring": counter.astype(np.uint16), field: packed.astype("u4").view(np.uint32 if text else dtype)}
    write_pcd(tmp_path / "c.pcd", encoding, **columns)
    expected = np.column_stack([*points, counter, colours / np.float32(255)])
    reads_as(tmp_path / "c.pcd", expected, ("intensity", *RGB))


def pcd(fields, types, body, start=""):
    """Two points in a file; a type has a letter, a number of bytes and a number of values."""
    sizes, letters, counts = (" ".join(word[k] for word in types.split()) for k in (1, 0, 2))
    header = f"{start}FIELDS {fields}\nSIZE {sizes}\nTYPE {letters}\nCOUNT {counts}\nWIDTH 2\nHEIGHT 1\nPOINTS 2\n"
    kind = "ascii" if body.startswith(b"1 ") else "binary"
    return f"{header}DATA {kind}\n".encode("latin-1") + body


ROWS, NAN = np.array([[1, 2, 3], [4, 5, 6]], "<f4"), np.nan
MARK = "\xef\xbb\xbf"
MISSING = np.c_[ROWS, [4, NAN]].astype("<f4").tobytes()
GREY = f"1 2 3 {np.uint32(0x808080).view(np.float32)!s}\n4 5 6 ".encode()
VECTORS = struct.pack("<3f4xf2fx3f4xf2fx", 1, 2, 3, 7, 0, 0, 4, 5, 6, 8, 0, 0)


@pytest.mark.parametrize(
    ("content", "names", "channels"),
    [
        # As PCL's own `bun4.pcd`: no viewpoint.
        *((pcd("x y z", "F41 F41 F41", body, "VERSION .5\n"), (), None) for body in (b"1 2 3\n4 5 6", ROWS.tobytes())),
        *(
            (pcd("x y z", "F41 F41 F41", body, "VERSION .6\n").replace(b"COUNT 1 1 1\n", b""), (), None)
            for body in (b"1 2 3\n4 5 6", ROWS.tobytes())
        ),
        # Any white space; a byte order mark, a comment in another encoding, and a field without values.
        (pcd("x y z i _", "F41 F41 F41 F41 U11", b"1  2\t3 4 0 \n4 5 nan 8 0\r\n"), INTENSITY, [4, 8]),
        (pcd("x y z i none", "F41 F41 F41 F41 F80", b"1 2 3 4\n4 5 6 -nan(ind)\n", MARK), INTENSITY, [4, NAN]),
        (pcd("x y z i none", "F41 F41 F41 F41 F80", MISSING, f"{MARK}# Stra\xdfe\n"), INTENSITY, [4, NAN]),
        # A packed colour that is no number is missing.
        *(
            (pcd("x y z rgb", "F41 F41 F41 F41", GREY + nan), RGB, [3 * [128 / 255], 3 * [NAN]])
            for nan in (b"nan", b"-nan")
        ),
        # Padding and vectors are no channels.
        (pcd("x y z _ intensity fpfh _", "F41 F41 F41 U14 F41 F42 U11", VECTORS, "# a comment\n"), INTENSITY, [7, 8]),
    ],
)
def test_pcd_of_others(tmp_path, content, names, channels):
    (tmp_path / "c.pcd").write_bytes(content)
    points = np.where(b"5 nan" in content, [[1, 2, 3], [4, 5, NAN]], ROWS)
    columns = points if channels is None else np.column_stack([points, channels])
    reads_as(tmp_path / "c.pcd", columns, names, rtol=1e-6 * (names == RGB))


@pytest.mark.parametrize("text", [True, False])
def test_ply_with_comments_of_any_kind(tmp_path, text):
    rows = structured(**xyz(), heat=np.arange(N, dtype=np.float32))
    write_ply(tmp_path / "plain.ply", rows, text)
    for comment in (b"comment Stra\xdfe", b"comment end_header", b"obj_info end_header \xff"):
        for mark in (b"", b"\xef\xbb\xbf"):
            content = (tmp_path / "plain.ply").read_bytes().replace(b"element", comment + b"\nelement", 1)
            (tmp_path / "c.ply").write_bytes(mark + content)
            same(io.read(tmp_path / "c.ply"), io.read(tmp_path / "plain.ply"))


# LAS


@pytest.mark.parametrize(("suffix", "point_format"), [(".las", 3), (".laz", 2), (".laz", 6), (".laz", 7)])
def test_las_in_utm_is_exact(tmp_path, suffix, point_format):
    """In several chunks."""
    names = INTENSITY + RGB * (point_format != 6)
    columns = {name: RNG.integers(0, 65536, 120_000) for name in names}
    las = las_data(point_format, 120_000, **columns)
    if point_format == 6:
        las.add_extra_dim(laspy.ExtraBytesParams("amplitude", np.float64))
    las.write(str(tmp_path / f"c{suffix}"))
    channels = [values / (1 if name == "intensity" else 65535) for name, values in columns.items()]
    assert reads_as(tmp_path / f"c{suffix}", np.column_stack([las.xyz, *channels]), names).points.dtype == np.float64


def test_las_rounds_intensities(tmp_path):
    cloud = PointCloud(np.eye(3), np.array([[3.6], [250.5], [65535.0]]), channel_names=INTENSITY)
    np.testing.assert_array_equal(through(tmp_path / "c.las", cloud).channels, np.rint(cloud.channels))


@pytest.mark.parametrize(
    ("columns", "names", "channels"),
    [
        # Colours that are all black are none.
        ({"red": np.zeros(N), "intensity": np.arange(N)}, INTENSITY, [np.arange(N)]),
        # Colours of 8 bits; an intensity that is 0 is none.
        ({"red": np.arange(N), "green": np.full(N, 255)}, RGB, [np.arange(N) / 255, np.ones(N), np.zeros(N)]),
    ],
)
def test_las_of_others(tmp_path, columns, names, channels):
    las = las_data(3, **columns)
    las.write(str(tmp_path / "c.las"))
    reads_as(tmp_path / "c.las", np.column_stack([las.xyz, *channels]), names, rtol=1e-7)


# KITTI, NumPy, text


def test_kitti(tmp_path, data):
    rows = (RNG.uniform(-50, 50, (N, 4)) * [1, 1, 1, 0] + RNG.random((N, 4)) * [0, 0, 0, 1]).astype("<f4")
    rows.tofile(tmp_path / "c.bin")
    reads_as(tmp_path / "c.bin", rows, INTENSITY)
    scan = io.read(data / "kitti/sequences/04/velodyne/000000.bin")
    assert len(scan) > 100_000 and scan.channels.min() >= 0 and scan.channels.max() < 1
    # A channel of one of these names, or without a name, is taken for the intensity.
    for names in (["Reflectance"], None):
        cloud = PointCloud(np.ones((2, 3)), np.ones(2), channel_names=names)
        assert through(tmp_path / "c.bin", cloud).channel_names == INTENSITY


def scan(num_points=480):
    """Rays of four rings around a sensor, in the order of a scan: x, y, z, intensity, ring, time."""
    time = np.linspace(0, 0.1, num_points)
    angle, ring = 80 * np.pi * time, np.floor(40 * time)
    radius = 5 + np.sin(5 * angle)
    columns = [radius * np.cos(angle), radius * np.sin(angle), ring - 1.7, RNG.integers(0, 256, num_points), ring, time]
    return np.stack(columns, axis=1)


LAYOUTS = {
    "KITTI": lambda rows: rows[:, :4],
    "nuScenes": lambda rows: rows[:, :5],
    "ring and time": lambda rows: rows,
    "PCL": lambda rows: np.insert(np.insert(rows[:, :4], 3, 1, axis=1), [5, 5, 5], 0, axis=1),
    "x, y, z": lambda rows: rows[:, :3],
}


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_of_floats_are_told_apart(tmp_path, name, shuffled):
    rows = RNG.permutation(scan()) if shuffled and name != "x, y, z" else scan()
    LAYOUTS[name](rows).astype("<f4").tofile(tmp_path / "c.bin")
    expected = rows[:, : 3 + (name != "x, y, z")].astype(np.float32)
    reads_as(tmp_path / "c.bin", expected, INTENSITY[: expected.shape[1] - 3])


@pytest.mark.parametrize("columns", [[0, 1, 2, 3, 5], [5, 0, 1, 2], [0, 1, 2, 3, 5, 5, 5], [0, 1, 2]])
def test_unknown_layouts_of_floats_are_refused(tmp_path, columns):
    """The sensor would stand still in them; of shuffled points, nothing tells x, y, z from other columns."""
    rows = RNG.permutation(scan()) if len(columns) == 3 else scan()
    rows[:, columns].astype("<f4").tofile(tmp_path / "c.bin")
    with pytest.raises(ValueError, match=rf"columns=N; (.*\b)?{len(columns)}\b.* fit"):
        io.read(tmp_path / "c.bin")


@pytest.mark.parametrize("name", ["PCL", "x, y, z", "intensity, time", "velocity, time"])
def test_a_given_number_of_columns(tmp_path, name):
    """A negative fourth value is no intensity."""
    rows = RNG.permutation(scan())
    others = {"intensity, time": rows[:, [0, 1, 2, 3, 5, 5, 5]], "velocity, time": rows[:, [0, 1, 2, 0, 5]]}
    columns = (others[name] if name in others else LAYOUTS[name](rows)).astype("<f4")
    names = INTENSITY if name in ("PCL", "intensity, time") else ()
    wrong = {11: "rows of 11 float32 values", 2: "columns: expected an integer of at least 3, got 2"}
    for path, opened in ((tmp_path / "c.bin", open), (tmp_path / "c.bin.gz", gzip.open)):
        with opened(path, "wb") as file:
            file.write(columns.tobytes())
        reads_as(path, rows[:, : 3 + len(names)].astype(np.float32), names, columns=columns.shape[1])
        for number, message in wrong.items():
            with pytest.raises(ValueError, match=message):
                io.read(path, columns=number)


def test_nuscenes_by_suffix(tmp_path):
    rows = scan()[:, [0, 1, 2, 3, 5]].astype("<f4")
    rows.tofile(tmp_path / "scan.PCD.bin")
    reads_as(tmp_path / "scan.PCD.bin", rows[:, :4], INTENSITY)
    refuses(tmp_path / "other.pcd.bin", rows.tobytes()[:-4], "five")


@pytest.mark.parametrize("suffix", [suffix for suffix in FORMATS if suffix not in LAS])
def test_gzip(tmp_path, seeds, suffix):
    plain, path, whole = tmp_path / f"c{suffix}", tmp_path / f"c{suffix}.gz", seeds[f"ours{suffix}"]
    plain.write_bytes(whole)
    path.write_bytes(gzip.compress(whole))
    same(io.read(path), io.read(plain))
    assert is_cloud(path)
    refuses(path, gzip.compress(whole)[:-20])


def test_npz_of_others(tmp_path, data):
    points, colours = make().points, RNG.integers(0, 256, (N, 4), np.uint8)
    np.savez_compressed(tmp_path / "c.npz", points=points, colors=colours, Intensity=np.arange(N), labels=np.ones(N))
    expected = np.column_stack([points, np.arange(N), colours[:, :3] / 255])
    reads_as(tmp_path / "c.npz", expected, ("intensity", *RGB), rtol=1e-6)
    frame = io.read(data / "icl_livingroom1/frame_000000.npz")
    assert frame.channel_names == RGB and frame.points.dtype == np.float32


@pytest.mark.parametrize(
    ("array", "names"),
    [
        (np.arange(12).reshape(4, 3), ()),
        (np.asfortranarray(RNG.random((5, 6))), ("channel_0", "channel_1", "channel_2")),
        (np.ones((2, 4), ">f4"), ("channel_0",)),
        (structured(**xyz(np.float64), intensity=np.arange(N), ring=np.arange(N)), INTENSITY),
    ],
)
def test_npy_of_others(tmp_path, array, names):
    np.save(tmp_path / "c.npy", array)
    rows = array if array.dtype.names is None else np.array(array[[*"xyz", *names]].tolist())
    reads_as(tmp_path / "c.npy", rows, names)


# Columns that sensors write, all but the last of which are no channels.
SENSOR = (
    "distance depth azimuth elevation time_stamp timestamp ScanAngleRank laser_id GpsTime return_type distance_to_wall"
)


@pytest.mark.parametrize(
    ("text", "names", "channels"),
    [
        ("1 2 3\n4 5 6\n", (), np.empty((2, 0))),
        ("1,2,3,.5\n4, 5, 6, .6", ("channel_0",), [[0.5], [0.6]]),
        ("X [m];Y [m];Z (m);Intensity [0-255];time [s]\n1;2;3;8;0\n4;5;6;9;0\n", INTENSITY, [[8], [9]]),
        ("\ufeffX;Y;Z;i;time\n1;2;3;8;0\n4;5;6;9;0\n", INTENSITY, [[8], [9]]),
        ("//X Y Z R G B\n1 2 3 0 51 255\n4 5 6 255 0 0\n", RGB, [[0, 0.2, 1], [1, 0, 0]]),
        ("# hand-made\n\n# x y z red green blue\n1 2 3 0 65535 0\n4 5 6 1 0 0\n", RGB, [[0, 1, 0], [1 / 65535, 0, 0]]),
        ("x y z r g b\n1 2 3 0.0 1.0 0.0\n4 5 6 1.0 1.0 1.0\n", RGB, [[0, 1, 0], [1, 1, 1]]),
        ("x y z r g b\n1 2 3 0 1 0\n4 5 6 0.5 1 1\n", RGB, [[0, 1, 0], [0.5, 1, 1]]),
        ("z,y,x,heat\n3,2,1,7\n6,5,4,8\n", ("heat",), [[7], [8]]),
        # Names only where their number fits.
        ("# format: x y z\n1 2 3 .5\n4 5 6 .6\n", ("channel_0",), [[0.5], [0.6]]),
        ("// x, y, z, intensity\n1, 2, 3, 8\n4, 5, 6, 9\n", INTENSITY, [[8], [9]]),
        # The index of pandas, and of R with its quotes.
        (",x,y,z,intensity\n0,1,2,3,8\n1,4,5,6,9\n", INTENSITY, [[8], [9]]),
        ('"x" "y" "z" "heat"\n"1" 1 2 3 8\n"2" 4 5 6 9\n', ("heat",), [[8], [9]]),
        # The number of points, as CloudCompare writes it.
        ("2\n1 2 3 8\n4 5 6 9\n", ("channel_0",), [[8], [9]]),
        ("//X Y Z i\n2\n1 2 3 8\n4 5 6 9\n", INTENSITY, [[8], [9]]),
        # Missing values.
        ("x,y,z,i,heat\n1,2,3,,7\n4,5,6,9,\n", (*INTENSITY, "heat"), [[None, 7], [9, None]]),
        ("x y z i\n1 2 3 -nan(ind)\n4 5 6 9\n", INTENSITY, [[None], [9]]),
        ("x y z i\n1 2 3 1.#QNAN\n4 5 6 NA\n", INTENSITY, [[None], [None]]),
        (
            f"x y z i {SENSOR}\n1 2 3 8{10 * ' 0'} 1\n4 5 6 9{10 * ' 0'} 2\n",
            ("intensity", "distance_to_wall"),
            [[8, 1], [9, 2]],
        ),
        # Any encoding.
        ("# Straße\n1 2 3\n4 5 6\n".encode("latin-1"), (), np.empty((2, 0))),
        ("x,y,z,intensity\n1,2,3,8\n4,5,6,9\n".encode("utf-16"), INTENSITY, [[8], [9]]),
    ],
)
def test_text_of_others(tmp_path, text, names, channels):
    for suffix in TEXT:
        (tmp_path / f"c{suffix}").write_bytes(text if isinstance(text, bytes) else text.encode())
        reads_as(tmp_path / f"c{suffix}", np.hstack([ROWS, np.array(channels, float)]), names)


# Broken files


def refuses(path, content, shown=""):
    """One ValueError that starts with the path of a file of this content, and no memory of the size that a header
    claims."""
    path.write_bytes(content)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError) as caught:
            io.read(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    message = str(caught.value)
    assert message.startswith(str(path)) and shown in message
    # Those of checks of annotations have several.
    assert "\n" not in message or "Type-check error" in message
    assert peak < 50e6


@pytest.mark.parametrize("name", ["c.obj", "c", "c.obj.gz", ".ply"])
def test_unknown_suffix(tmp_path, name):
    refuses(tmp_path / name, b"1 2 3")
    refused(lambda: io.write(tmp_path / name, make()), str(tmp_path / name))


CONTENTS = {
    "empty": b"",
    "prose": b"It was a bright cold day in April, and the clocks were striking.\n" * 20,
    "numbers": b"1 2 3\n4 5 6\n" * 20,
    "noise": np.random.default_rng(5).bytes(1600),
    "ply": b"ply\n" + b"x" * 2000,
    "pickle": pickle.dumps([print]),
}


@pytest.mark.parametrize("suffix", FORMATS)
def test_no_cloud(tmp_path, seeds, suffix):
    """Neither what is no cloud nor a cloud in another format."""
    kind = {".laz": ".las", ".xyz": ".csv", ".txt": ".csv"}
    others = [other for other in FORMATS if kind.get(suffix, suffix) != kind.get(other, other)]
    for name, content in (CONTENTS | {other: seeds[f"ours{other}"] for other in others}).items():
        if name != "numbers" or suffix not in TEXT:
            refuses(tmp_path / f"c{suffix}", content)


@pytest.mark.parametrize("suffix", [s for s in FORMATS if s not in TEXT])
def test_truncated(tmp_path, seeds, suffix):
    whole = seeds[f"ours{suffix}"]
    for fraction in (0.02, 0.2, 0.5, 0.9, 0.999):
        refuses(tmp_path / f"c{suffix}", whole[: int(fraction * len(whole)) - 1 | 1])  # odd: within a row


# Numbers in headers of text; some of N points or less leave bytes at the end, which are no harm.
NUMBERS = {name: ["face 2", f"vertex {N}"] for name in ("text.ply", "binary.ply")} | {
    f"{encoding.value}.pcd": ["COUNT 1 1 1", f"POINTS {N}"] for encoding in pypcd4.Encoding
}


@pytest.mark.parametrize(("name", "number"), [(name, number) for name in NUMBERS for number in NUMBERS[name]])
def test_a_wrong_number_in_a_header(tmp_path, seeds, name, number):
    assert seeds[name].count(number.encode()) == 1
    for claim in (0, N - 1, N + 1, 2 * N, 10**6, 10**9, 10**15):
        # The bytes of the faces make up one more vertex.
        if claim > N + 1 or name in ("ascii.pcd", "binary_compressed.pcd") or (number, claim) == (f"POINTS {N}", 0):
            changed = f"{number.rpartition(' ')[0]} {claim}"
            refuses(tmp_path / name, seeds[name].replace(number.encode(), changed.encode()))


def test_lying_compressed_pcd(tmp_path, seeds):
    path, (head, body) = tmp_path / "c.pcd", seeds["binary_compressed.pcd"].split(b"compressed\n")
    head += b"compressed\n"
    for lengths in [(2**32 - 1, 24 * N), (2**20, 24 * N), (20, 2**32 - 1), (0, 0), (0, 24 * N)]:
        refuses(path, head + struct.pack("<II", *lengths) + body[8:])
    claim = head.replace(f"POINTS {N}".encode(), b"POINTS 100000000")
    refuses(path, claim + body[:4] + struct.pack("<I", 24 * 10**8) + body[8:])


def claims(path, whole, at, form, *values):
    """Each value, alone, at a place of a binary file is refused."""
    for value in values:
        changed = bytearray(whole)
        struct.pack_into(form, changed, at, *[value] * (len(form) - 1))
        refuses(path, changed)


@pytest.mark.parametrize("suffix", LAS)
def test_lying_las(tmp_path, seeds, suffix):
    path, whole = tmp_path / f"c{suffix}", seeds[f"ours{suffix}"]
    # Where the points start, the number of records before them, the number of points; bytes per point; the scale of x.
    for at in (96, 100, 107):
        claims(path, whole, at, "<I", 10**4, 10**9, 2**32 - 1)
    claims(path, whole, 105, "<H", 10**4, 2**16 - 1)
    claims(path, whole, 131, "<d", 1e305)


@pytest.mark.parametrize("point_format", [2, 7])
def test_lying_laz_tables(tmp_path, seeds, point_format):
    resource = pytest.importorskip("resource")  # lazrs allocates out of tracemalloc's sight
    path, whole = tmp_path / "c.laz", seeds[f"{point_format}.laz"]
    header_size, start = struct.unpack_from("<HI", whole, 94)
    (table,) = struct.unpack_from("<q", whole, start)
    before, large = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, (10**5, 2**31 - 1, 2**32 - 1)
    # The place of the chunk table, its length, the bytes per point that LASzip knows of.
    claims(path, whole, start, "<q", *large)
    claims(path, whole, table + 4, "<I", *large)
    claims(path, whole, header_size + 54 + 36, "<H", 10**4, 2**16 - 1)
    if point_format == 7:  # the lengths of the layers, and one point more or less
        claims(path, whole, start + 12 + laspy.PointFormat(7).size, "<IIII", *large)
        claims(path, whole, 247, "<Q", N - 1, N + 1)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 500_000  # KiB


def written(save, *args, **kwargs):
    """What a function writes to an open file."""
    stream = stdio.BytesIO()
    save(stream, *args, **kwargs)
    return stream.getvalue()


def claiming(array, shape):
    """A .npy file, its header claiming another shape."""
    header = {"descr": np.lib.format.dtype_to_descr(array.dtype), "fortran_order": False, "shape": shape}
    return written(np.lib.format.write_array_header_1_0, header) + array.tobytes()


class Trap:
    def __reduce__(self):
        return exit, (3,)


STRANGE = np.array([[Trap()] * 3], object), np.array([["1", "2", "3"]]), np.ones((2, 3), complex)
ARRAYS = [claiming(make().points, shape) for shape in ((N + 1, 3), (10**9, 3), (2**62, 3), (N * 3,), (N, 1, 3))]
ARRAYS += [written(np.save, array) for array in STRANGE]


@pytest.mark.parametrize("content", ARRAYS)
def test_lying_arrays_and_arrays_of_no_numbers(tmp_path, content):
    refuses(tmp_path / "c.npy", content)
    with zipfile.ZipFile(stream := stdio.BytesIO(), "w") as archive:
        archive.writestr("points.npy", content)
    refuses(tmp_path / "c.npz", stream.getvalue())


def npz(names=None, **shapes):
    arrays = {name: np.ones(shape) for name, shape in shapes.items()}
    return written(np.savez, **arrays if names is None else arrays | {"channel_names": np.array(names)})


def ply(element, **columns):
    return written(plyfile.PlyData([plyfile.PlyElement.describe(structured(**columns), element)]).write)


@pytest.mark.parametrize(
    ("suffix", "content", "shown"),
    [
        *((".csv", text, "") for text in (b"1 2\n3 4\n", b"1 2 3\n4 5\n", b"1 2 3\n4 5 six\n", b"x,y,z\n")),
        *((".csv", text, "") for text in (b"lat lon\n1 2\n", b"x y z i\n1 2 3\n", b"x,y,z\n1,2,3,4,5\n")),
        *(
            (".csv", f"x,y,z,i\n1,2,3,4\n\n1,2,3,5\n{row}\n".encode(), f"line 5: expected 4 numbers, got '{row}'")
            for row in ("1,2,hello,4", "1,2,4")
        ),
        *(
            (".pcd", pcd("x y z", "F41 F41 F41", b"1 2 3\n4 5 6").replace(*change), "as .pcd: its header is damaged")
            for change in ((b"x y z", b"x y"), (b"4 4 4", b"4 4 3"), (b"F F F", b"F F Q"))
        ),
        (".xyz", b"1 2\n3 4\n", "at least three columns, x, y and z, got 2"),
        (".npy", written(np.save, np.ones((4, 100))), "got (4, 100); transpose it"),
        *((".npz", npz(**{name: (N, 1)}), "") for name in ("channels", "points")),
        *((".npz", npz(points=shape), "") for shape in ((N, 2), (0, 3))),
        *((".npz", npz(points=(N, 3), **{name: (N + 1, 1)}), "") for name in ("channels", "intensity")),
        (".npz", npz(points=(N, 3), rgb=(N, 2)), ""),
        (".npz", npz(["a", "b"], points=(N, 3), channels=(N, 1)), ""),
        (".ply", ply("vertex", x=np.ones(3), y=np.ones(3), intensity=np.ones(3)), ""),
        (".ply", ply("face", a=np.ones(3)), ""),
    ],
)
def test_broken_content_is_refused(tmp_path, suffix, content, shown):
    refuses(tmp_path / f"c{suffix}", content, shown)


def test_what_a_library_raises(tmp_path, monkeypatch):
    def fail(file, size):
        raise error

    monkeypatch.setitem(io.FORMATS, ".laz", dataclasses.replace(io.FORMATS[".laz"], read=fail))
    (tmp_path / "c.laz").write_bytes(b"LASF")
    for error in (type("PanicException", (BaseException,), {}), AssertionError, KeyboardInterrupt, ImportError):
        with pytest.raises(error if error in (KeyboardInterrupt, ImportError) else ValueError):
            io.read(tmp_path / "c.laz")


def two_points(names, channels, points=1.0):
    return PointCloud(np.full((2, 3), points), np.array(channels), channel_names=names)


@pytest.mark.parametrize(
    ("suffix", "cloud", "named", "shown"),
    [
        *((".las", two_points(INTENSITY, [[value], [1]]), "channels", ".ply") for value in (0.5, -1, 70_000, np.nan)),
        *((suffix, make(("heat",)), "channel_names", ".ply") for suffix in LAS),
        *((".bin", make(names), "channels", ".ply") for names in ((), INTENSITY + RGB)),
        *((".las", two_points(RGB, np.full((2, 3), value)), "channels", ".ply") for value in (1.5, 0.001)),
        (".las", two_points(("red", "green"), np.ones((2, 2))), "channel_names", ".ply"),
        (".las", two_points((), np.ones((2, 0)), np.nan), "points", ".ply"),
        (".bin", two_points(None, np.ones(2), 5e5), "points", ".ply"),
        # They would be read as an intensity.
        *((".bin", two_points([name], np.ones(2)), "channels", f"{name} .ply") for name in ("time", "ring")),
        (".pcd.bin", make(), "path", ".ply"),
        *((f"{suffix}.gz", make(), "path", ".ply") for suffix in FORMATS if suffix not in LAS),
        *(
            (suffix, make(names), "channel_names", "npz")
            for suffix in NAMED
            if suffix != ".npz"
            for names in (("two words",), ("naïve",), ("a,b",), ("",))
        ),
        (".ply", make(num_points=0), "cloud", ""),
        (".ply", PointCloud.stack([make(), make()]), "cloud", ""),
    ],
)
def test_what_a_format_cannot_hold_is_refused(tmp_path, suffix, cloud, named, shown):
    refused(lambda: io.write(tmp_path / f"c{suffix}", cloud), named, *shown.split())
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "c.ply"
    path.write_bytes(b"old")

    def fail(file, cloud):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setitem(io.FORMATS, ".ply", dataclasses.replace(io.FORMATS[".ply"], write=fail))
    with pytest.raises(OSError, match="disk full"):
        io.write(path, make())
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("suffix", "package"), [(".ply", "plyfile"), (".pcd", "pypcd4"), (".las", "laspy"), (".laz", "lazrs")]
)
def test_missing_extra(tmp_path, suffix, package, monkeypatch):
    io.write(tmp_path / f"c{suffix}", make())
    monkeypatch.setitem(sys.modules, package, None)
    for call in (io.read, lambda path: io.write(path, make())):
        with pytest.raises(ImportError, match=rf"{package}.*mcgicp_jax\[io\]"):
            call(tmp_path / f"c{suffix}")


# Mutations


CHANGE = st.tuples(
    st.sampled_from(["put", "cut", "insert", "digits"]),
    st.floats(0, 1, exclude_max=True),
    st.binary(min_size=1, max_size=8),
)


@settings(max_examples=300, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(which=st.integers(0, 99), header=st.booleans(), changes=st.lists(CHANGE, min_size=1, max_size=4))
@example(which=3, header=False, changes=[("put", 0.9, b"\xff" * 8)])
def test_mutations(seeds, tmp_path, which, header, changes):
    name = sorted(seeds)[which % len(seeds)]
    content = seeds[name]
    for kind, place, new in changes:
        at = int(place * min(len(content), 600 if header else len(content)))
        if kind == "digits":
            content = content[:at] + content[at:].replace(b"0", b"9" * len(new), 1)
        else:
            content = content[:at] + (b"" if kind == "cut" else new) + content[at + len(new) * (kind != "insert") :]
    path = tmp_path / name
    path.write_bytes(content)
    try:
        cloud = io.read(path)
    except ValueError as error:
        assert str(error).startswith(str(path))
    else:
        same(io.read(path), cloud)


# Poses


@pytest.mark.parametrize("num_poses", [1, 4, 50])
def test_poses_round_trip(tmp_path, num_poses):
    """Any rotations, half turns and the smallest ones among them; translations of kilometres."""
    quaternions = RNG.normal(size=(50, 4))
    quaternions[:8] = np.vstack([np.eye(4), [1, 1, 0, 1e-9], [0, 1, 1, 0], [1e-9, 0, 0, 1], [1e-5, 0, 1, 0]])
    matrices, times = np.tile(np.eye(4), (num_poses, 1, 1)), 1305031102.175304 + np.arange(num_poses)
    matrices[:, :3, :3] = Rotation.from_quat(quaternions[:num_poses]).as_matrix()
    matrices[:, :3, 3] = RNG.uniform(-1e4, 1e4, (num_poses, 3))
    io.write_poses(tmp_path / "kitti.txt", matrices)
    io.write_poses(tmp_path / "tum.txt", list(matrices), timestamps=times)
    np.testing.assert_array_equal(io.read_poses(tmp_path / "kitti.txt"), matrices)
    np.testing.assert_allclose(io.read_poses(tmp_path / "tum.txt"), matrices, rtol=0, atol=1e-14)
    rows = np.loadtxt(tmp_path / "tum.txt", ndmin=2)
    np.testing.assert_array_equal(rows[:, 0], times)
    assert (rows[:, 7] >= 0).all()


def test_pose_conventions(tmp_path):
    quarter = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])  # about z
    (tmp_path / "tum.txt").write_text("# timestamp tx ty tz qx qy qz qw\n0 1 2 3 0 0 2 2\n")
    (tmp_path / "bare.txt").write_text("1 2 3 0 0 -0.5 -0.5\n")
    (tmp_path / "kitti.txt").write_text("0 -1 0 1 1 0 0 2 0 0 1 3\n")
    np.savetxt(tmp_path / "matrix.txt", quarter)
    for name in ("tum", "bare", "kitti", "matrix"):
        read = io.read_poses(tmp_path / f"{name}.txt")
        assert read.dtype == np.float64
        np.testing.assert_allclose(read, quarter[None], atol=1e-15)


@pytest.mark.filterwarnings("error")
def test_broken_poses(tmp_path):
    path = tmp_path / "poses.txt"
    for content in (
        *(b"# nothing\n", b"\xff\xfe\x00", b"1 2 3\n", b"0 1 2 3 0 0 0 0\n", b"0 1 2 3 0 0 nan 1\n"),
        *(b"2 0 0 0 0 1 0 0 0 0 1 0\n", b"1 0 0 0 0 1 0 0 0 0 -1 0\n", b"1 0 0 inf 0 1 0 0 0 0 1 0\n"),
        *(b"1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0\n", b"1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 2\n", b"1 0 0 0\n0 1 0 0\n0 0 1 0\n"),
    ):
        path.write_bytes(content)
        refused(lambda: io.read_poses(path), str(path).removesuffix(": "))


def test_no_such_file(tmp_path):
    for read in (io.read_poses, io.read):
        with pytest.raises(FileNotFoundError):
            read(tmp_path / "none.txt")


def test_poses_that_do_not_fit(tmp_path):
    refused(lambda: io.write_poses(tmp_path / "p.txt", np.array([np.eye(4), 2 * np.eye(4)])), "poses[1]")
    refused(lambda: io.write_poses(tmp_path / "p.txt", [np.eye(4)] * 8, timestamps=[1.0, 2.0]), "timestamps")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npz", ".csv", ".xyz"])
def test_times_are_no_channel_and_come_back(tmp_path, suffix):
    cloud = PointCloud(RNG.random((6, 3)), RNG.random(6), channel_names=INTENSITY, times=RNG.permutation(6))
    back = through(tmp_path / f"c{suffix}", cloud)
    assert back.channel_names == INTENSITY
    np.testing.assert_allclose(back.times, cloud.times, atol=1e-7)


def test_times_of_other_programs(tmp_path):
    """Whole nanoseconds of a clock, or of LAS; a column of equal numbers is no time."""
    (tmp_path / "c.csv").write_text("x,y,z,timestamp\n" + "".join(f"{i},0,1,{1_700_000_000 + i}\n" for i in range(5)))
    np.testing.assert_allclose(io.read(tmp_path / "c.csv").times, np.arange(5) / 4)
    las_data(3, gps_time=np.arange(N)[::-1]).write(str(tmp_path / "c.las"))
    np.testing.assert_allclose(io.read(tmp_path / "c.las").times, np.linspace(1, 0, N))
    (tmp_path / "d.csv").write_text("x,y,z,t\n0,0,1,7\n1,0,1,7\n")
    assert io.read(tmp_path / "d.csv").times is None
