"""Figures: what they show, not only that they appear."""

import sys

import matplotlib.image
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import PointCloud, merge_clouds, plot
from mcgicp_jax.datasets import poster_wall
from tests.graphs import grid, measured
from tests.refusals import refused
from tests.scenes import motion, rectangles


@pytest.fixture(scope="module")
def wall():
    target, source = poster_wall(2, seed=0)
    return source.cloud, target.cloud, np.linalg.inv(target.pose) @ source.pose


@pytest.fixture(scope="module")
def rooms():
    """Without channels: a floor and four walls, the source 0.3 m off in both directions."""
    rng = np.random.default_rng(0)
    sample = rectangles(
        ((-4, -3, -1), (8, 0, 0), (0, 6, 0)),
        *(((x, -3, -1), (0, 6, 0), (0, 0, 2)) for x in (-4, 4)),
        *(((-4, y, -1), (8, 0, 0), (0, 0, 2)) for y in (-3, 3)),
    )
    T = motion((0.3, 0.3, 0, 0, 0, 0))
    return PointCloud(sample(rng, 20_000, 0.0) - T[:3, 3]), PointCloud(sample(rng, 20_000, 0.0)), T


def shown(panel):
    return np.asarray(panel.images[0].get_array())


def test_a_fitting_pose_leaves_less_difference_of_color(wall, tmp_path):
    source, target, truth = wall
    figure = plot.before_after(source, target, {"truth": truth}, path=tmp_path / "wall.png")
    panels = np.array(figure.axes).reshape(2, 3)
    assert [panel.get_ylabel() for panel in panels[:, 0]] == ["start", "truth"]
    start, fitted = (float(panel.get_xlabel().split()[-1]) for panel in panels[:, 2])
    assert fitted < 0.6 * start
    picture = matplotlib.image.imread(tmp_path / "wall.png")
    assert picture.shape[1] > 1000 and picture.shape[0] > 500 and picture.std() > 0.1


def test_tiles_of_the_source_alternate_with_tiles_of_the_target(wall):
    source, target, truth = wall
    colors = ([1.0, 0, 0], [0, 1.0, 0])
    painted = [
        cloud.replace(channels=np.tile(color, (len(cloud), 1)))
        for cloud, color in zip((source, target), colors, strict=True)
    ]
    picture = shown(plot.before_after(*painted, {"truth": truth}).axes[3])
    is_red, is_green = (np.all(picture == color, axis=-1) for color in colors)
    assert 0.4 < is_red.mean() < 0.55 and 0.4 < is_green.mean() < 0.55
    # About a dozen tiles across: as often does the colour change along a row.
    middle = is_red[len(is_red) // 2 - 5]
    assert 9 <= np.sum(middle[1:] != middle[:-1]) <= 13


def test_the_wall_is_seen_upright_from_the_camera(wall):
    source, target, truth = wall
    (panel, *others) = plot.before_after(source, target, {"start": truth}).axes
    assert len(others) == 2
    picture = shown(panel)
    # The camera's x is to the right and its y down; rows of the picture go up.
    x, y = target.points[:, 0], -target.points[:, 1]
    corner = target.channels[(x > 0.45) & (x < 0.65) & (y > 0.3) & (y < 0.5)].mean(axis=0)
    columns, rows = (
        np.interp(ends, np.percentile(values, [2, 98]), [0, size]).round().astype(int)
        for ends, values, size in (([0.45, 0.65], x, picture.shape[1]), ([0.3, 0.5], y, picture.shape[0]))
    )
    np.testing.assert_allclose(picture[slice(*rows), slice(*columns)].mean(axis=(0, 1)), corner, atol=0.04)


def test_clouds_without_color_are_overlaid_and_black_where_they_fit(rooms):
    source, target, truth = rooms

    def black(panel):
        picture = shown(panel)
        dark = picture.min(axis=-1) < 0.2
        return np.sum(picture.max(axis=-1)[dark] < 0.2) / dark.sum()

    start, _, fitted, _ = plot.before_after(source, target, {"fitted": truth}).axes
    assert black(start) < 0.2 and black(fitted) > 0.6


def test_a_sparse_cloud_is_not_hidden_by_a_dense_one(rooms):
    *clouds, truth = rooms
    for i, sparse in enumerate(clouds):
        rows = np.random.default_rng(0).permutation(len(sparse))[: len(sparse) // 50]
        pair = [PointCloud(sparse.points[rows]) if cloud is sparse else cloud for cloud in clouds]
        colors = 1 - shown(plot.before_after(*pair, {"fitted": truth}).axes[2])
        # The source takes away blue, the target red.
        assert np.sum(colors[..., 2 - 2 * i] > 0.1) > 0.3 * np.sum(colors[..., 2 * i] > 0.1)


def test_poses_without_overlap_and_odd_clouds_are_drawn(wall):
    source, target, _ = wall
    figure = plot.before_after(source, target, {f"away {i}": motion((100, 0, 0, 0, 0, 0)) for i in range(8)})
    assert "no overlap" in [panel.get_xlabel() for panel in figure.axes]
    assert {panel.get_ylabel() for panel in figure.axes} >= {"start", *(f"away {i}" for i in range(8))}
    points = np.array(target.points)
    points[::7] = np.nan
    plot.before_after(source, target.replace(points=points), {})
    plot.before_after(PointCloud(np.zeros((0, 3))), PointCloud(np.ones((5, 3))), {})


def test_arrays_are_clouds():
    points = np.asarray(CLOUD.unpad().points)
    assert len(plot.clouds(points).data) == 1 and plot.maps({"points": points}).axes


def test_padding_and_origin_change_nothing(wall):
    source, target, truth = wall
    utm = motion((4e5, 5e6, 100.0, 0, 0, 0))
    moved = target.replace_rows(origin=utm[:3, 3])
    plain = plot.before_after(source, target, {"start": truth})
    same = plot.before_after(source.pad(16_000), moved.pad(16_000), {"start": utm @ truth})
    assert np.nan_to_num(np.abs(shown(plain.axes[2]) - shown(same.axes[2]))).mean() < 1e-3


CLOUD, WRONG = PointCloud(np.eye(3)), np.ones((2, 3, 3))


def test_what_cannot_be_drawn_is_named():
    for named, shown, draw in (
        ("poses['mirror']", "", lambda: plot.before_after(CLOUD, CLOUD, {"mirror": np.diag([1.0, 1, -1, 1])})),
        ("target", 2, lambda: plot.before_after(CLOUD, PointCloud(np.eye(3)[:2]), {})),
        ("names", 2, lambda: plot.clouds(CLOUD, CLOUD, names=["one"])),
        ("trajectories['none']", "", lambda: plot.trajectories({"none": []})),
        ("maps", "", lambda: plot.maps({})),
        ("maps", "list", lambda: plot.maps([CLOUD])),
        ("maps['bare']", "(5,)", lambda: plot.maps({"bare": np.zeros(5)})),
        ("trajectories", "ndarray", lambda: plot.trajectories(np.eye(4))),
        ("covariances['short']", "(3, 3,", lambda: plot.surface_covariances(CLOUD, {"short": WRONG}, indices=[0])),
    ):
        refused(draw, named, shown)


@pytest.mark.parametrize(
    ("package", "draw"),
    [("matplotlib", lambda: plot.before_after(CLOUD, CLOUD, {})), ("plotly", lambda: plot.clouds(CLOUD))],
)
def test_a_missing_package_is_named(monkeypatch, package, draw):
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=rf"{package}.*pip install 'mcgicp_jax\[plot\]'"):
        draw()


def test_clouds_take_their_own_colors(wall):
    source, _, _ = wall
    intense = PointCloud(np.eye(3), np.array([1.0, 2.0, 3.0]), channel_names=["intensity"])
    figure = plot.clouds(source, intense, CLOUD, names=["wall", "scan", "plain"])
    wall_trace, scan, bare = figure.data
    assert [trace.name for trace in figure.data] == ["wall", "scan", "plain"]
    where = np.flatnonzero(np.all(source.points == [wall_trace.x[0], wall_trace.y[0], wall_trace.z[0]], axis=1))[0]
    red, green, blue = np.round(255 * source.channels[where]).astype(int)
    assert wall_trace.marker.color[0] == f"rgb({red},{green},{blue})"
    assert dict(zip(scan.marker.color, scan.x, strict=True))[1.0] == 1
    assert isinstance(bare.marker.color, str) and bare.marker.color.startswith("#")
    assert figure.layout.scene.aspectmode == "data"


@pytest.mark.parametrize("scale", [1, 255, 65535])
def test_colors_may_be_bytes_or_words(scale):
    cloud = PointCloud(np.eye(3), scale * np.eye(3), channel_names=["red", "green", "blue"])
    (trace,) = plot.clouds(cloud).data
    assert set(trace.marker.color) == {"rgb(255,0,0)", "rgb(0,255,0)", "rgb(0,0,255)"}


def test_large_clouds_are_thinned_and_padding_is_left_out():
    rng = np.random.default_rng(0)
    large, small = PointCloud(rng.normal(size=(90_000, 3))), PointCloud(rng.normal(size=(10_000, 3))).pad(20_000)
    drawn = [len(trace.x) for trace in plot.clouds(large, small).data]
    assert drawn == [45_000, 5_000]
    assert [len(trace.x) for trace in plot.clouds(small).data] == [10_000]


def test_trajectories_are_drawn_in_their_plane(tmp_path):
    poses = np.array([motion((7, 3 * i + 7, 4 * i + 7, 0, 0, 0)) for i in range(5)])
    (panel,) = plot.trajectories({"truth": poses, "gicp": list(poses)}, path=tmp_path / "way.png").axes
    for line in panel.lines:
        np.testing.assert_allclose(line.get_xdata(), 5 * np.arange(5), atol=1e-9)
        np.testing.assert_allclose(line.get_ydata(), 0, atol=1e-9)
    assert [text.get_text() for text in panel.get_legend().get_texts()] == ["truth", "gicp"]
    assert (tmp_path / "way.png").stat().st_size > 1000


def test_maps_show_the_same_part_of_the_world():
    frames = poster_wall(2, points_per_frame=2000)
    whole = merge_clouds([frame.cloud for frame in frames], [frame.pose for frame in frames], 0.01)
    maps = {"one": whole, "moved": whole.transform(motion((0.3, 0, 0, 0, 0, 0)))}
    maps |= {"bare": PointCloud(whole.points), "nothing": PointCloud(np.full((5, 3), np.nan))}
    panels = plot.maps(maps).axes
    one, other, grey, white = map(shown, panels)
    assert np.all(white == 1) and one.shape == other.shape == grey.shape
    assert [panel.get_title() for panel in panels] == list(maps)
    assert {label for panel in panels for label in (panel.get_xlabel(), panel.get_ylabel())} == {"metres"}
    # Where the moved map has left, the paper is white; without channels it is grey.
    assert np.mean(np.all(other == 1, axis=-1)) > np.mean(np.all(one == 1, axis=-1)) + 0.1
    assert np.ptp(one, axis=-1).max() > 0.3 and np.ptp(grey, axis=-1).max() == 0
    # Points without intensity are grey, not black.
    valid = np.arange(len(whole)) % 2 == 0
    dark = PointCloud(whole.points, 0.1 + whole.channels[:, 0], channel_valid=valid)
    picture = shown(plot.maps({"": dark.replace(channel_names=["intensity"])}).axes[0])
    assert np.mean(np.isclose(picture, 0.85 / 2)) > 0.1 > np.mean(picture == 0)
    part = plot.maps({"part": whole}, limits=np.array([[-0.2, 0.3], [-0.1, 0.1]])).axes[0]
    assert part.get_xlim()[1] == pytest.approx(0.5, rel=0.1) and part.get_ylim()[1] == pytest.approx(0.2, rel=0.1)


def test_covariances_within_a_surface_are_drawn_as_they_are():
    x, y = np.meshgrid(np.arange(20) * 0.1, np.arange(10) * 0.1)
    cloud = PointCloud(np.stack([x.ravel(), y.ravel(), np.zeros(200)], axis=1))
    along, slanted = np.tile(np.diag([1.0, 0.25, 1e-3]), (200, 1, 1)), np.tile(np.diag([1.0, 1.0, 1e-3]), (200, 1, 1))
    slanted[:, 0, 1] = slanted[:, 1, 0] = 0.6
    figure = plot.surface_covariances(cloud, {"along": along, "slanted": slanted}, indices=[0, 5, 10])
    # Each is black with a white rim.
    (_, first), (_, second) = (panel.collections for panel in figure.axes)
    np.testing.assert_allclose(first.get_widths() / first.get_heights(), 2)
    np.testing.assert_allclose(np.abs(np.sin(np.radians(first.get_angles()))), 0, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.tan(np.radians(second.get_angles()))), 1)
    np.testing.assert_allclose(np.diff(first.get_offsets()[:, 0]), [0.5, 0.5])


def test_graphs_show_poses_and_edges(tmp_path):
    graph = mcg.optimize_poses(measured(*grid(3), false=0.2)[0])
    figure = plot.graph(graph, path=tmp_path / "graph.png")
    kept, rejected = figure.axes[0].collections
    assert len(kept.get_segments()) == graph.kept.sum() and len(rejected.get_segments()) == (~graph.kept).sum() > 0
    np.testing.assert_allclose(kept.get_array(), graph.residuals[graph.kept])
    assert (tmp_path / "graph.png").stat().st_size > 1000
    prior = mcg.Edge(mcg.WORLD, 0, np.eye(4), np.eye(6))
    lines = plot.graph(mcg.optimize_poses(mcg.PoseGraph([np.eye(4)], [prior]))).axes[0].collections
    assert [len(edges.get_segments()) for edges in lines] == [1, 0]
    assert len(plot.graph(mcg.optimize_poses(mcg.PoseGraph([np.eye(4)], []))).axes[0].lines) == 1
