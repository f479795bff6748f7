"""`mcgicp paper`: run the experiments of Servos & Waslander (2014), section V, and write a report."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
import tyro
from jaxtyping import Float, Int
from tqdm import tqdm

import mcgicp_jax as mcg
from mcgicp_jax import datasets, metrics, plot
from mcgicp_jax._cli.options import weights_from, with_channels
from mcgicp_jax._methods.base import AbstractMethod

Folder: TypeAlias = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]

_COLORS = ("red", "green", "blue")
_COMBINED = ("intensity", *_COLORS)
# Table I, on Ford Campus: means and standard deviations of the translation error; metres.
_PAPER = {
    "Color ICP": (0.5106, 0.3280),
    "GICP": (0.3082, 0.1446),
    "MC-GICP, intensity": (0.3857, 0.1756),
    "MC-GICP, colour": (0.2941, 0.1409),
    "MC-GICP, combined": (0.2891, 0.1387),
}
_MEASURED = "MC-GICP, combined, Λ measured"
# max_distance while the pose is being found and when it is refined; metres.
_Distances: TypeAlias = tuple[float, float]
_STREET_VOXEL, _KITTI_VOXEL = 0.2, 0.25
_STREET_DISTANCE: _Distances = (2.0, 0.5)
_KITTI_DISTANCE: _Distances = (2.5, 0.6)
# Number of frames, of another street, from which Λ is measured.
_TRAINING = 4
# Voxel size of the map, and the limits of the part shown, along and across the street; metres.
_STREET_MAP, _SHOWN = 0.07, np.array([[-20.0, 20.0], [-9.5, 9.5]])
# Points of the road: within this height, distance to either side, and range. Initial pose: this far ahead. Metres.
_ROAD, _ROAD_VOXEL, _ROAD_START = (0.06, 6.0, 25.0), 0.1, 0.3
_ROAD_DISTANCE: _Distances = (0.6, 0.15)
_WALL_FRAMES, _WALL_POINTS, _WALL_STEP, _WALL_MAP = 100, 12_000, 0.066, 0.006
_WALL_DISTANCE: _Distances = (0.15, 0.04)
# Number of points of the wall in Fig. 1, and of iterations in Fig. 4
_FINE_POINTS = 40_000
_ITERATIONS = 24


@dataclass(frozen=True)
class _Row:
    """A method on some of the channels; `method` is None for Color ICP, whose weights are chosen for each pair."""

    name: str
    channels: tuple[str, ...]
    method: AbstractMethod | None

    def method_for(self, source: mcg.PointCloud, target: mcg.PointCloud) -> AbstractMethod:
        if self.method is not None:
            return self.method
        numbers: dict[str, Any] = {"channel_weights": weights_from(source, target)}
        return mcg.ColorICP(**numbers)


@dataclass(frozen=True, eq=False)
class _Errors:
    """For each pair: errors in metres and radians, number of pose updates, whether it converged."""

    translation: Float[np.ndarray, "N"]
    rotation: Float[np.ndarray, "N"]
    iterations: Float[np.ndarray, "N"]
    converged: Float[np.ndarray, "N"]


def paper(
    output: Path = Path("mcgicp_paper"), kitti: Folder = None, num_frames: int = 50, points_per_frame: int = 30_000
) -> int:
    """Run the experiments of the paper, Table I and Figs. 1 to 4, and write a report with pictures.

    The paper's own data are not available, so they run on simulated scenes: a street seen by a LiDAR with a camera, and
    a wall of posters seen by a Kinect.

    Args:
        output: Folder for report.md and its pictures.
        kitti: Folder of a KITTI odometry sequence, such as sequences/04, to run Table I on real scans too.
        num_frames: Number of frames of the street.
        points_per_frame: Number of points in each frame of the street.
    """
    if num_frames < 3:
        raise ValueError(f"num_frames: expected at least 3, got {num_frames}")
    if kitti is not None:
        # Without true poses, fail before the minutes that the street takes.
        _known(datasets.kitti(kitti)[0])
    output.mkdir(parents=True, exist_ok=True)
    street = datasets.street(num_frames, points_per_frame=points_per_frame)
    parts = [
        "# The experiments of the paper",
        _INTRODUCTION,
        *_tables(street, points_per_frame, kitti),
        *_figure_1(output),
        *_figure_2(output, street),
        *_figure_3(output),
        *_figure_4(output, street),
    ]
    report = output / "report.md"
    report.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    print(f"report:    {report}")
    return 0


# Table I


def _tables(street: datasets.SyntheticFrames, street_points: int, kitti: Path | None) -> Iterator[str]:
    rows = _rows(_measure(datasets.street(_TRAINING, points_per_frame=street_points, seed=1), _STREET_VOXEL))
    yield "## Table I"
    errors = _evaluate(street, rows, _STREET_VOXEL, _STREET_DISTANCE, "street")
    yield f"The street: all pairs of consecutive frames of {len(street)}, 1 m apart, starting from the identity."
    yield _table(rows, errors)
    yield _order(rows, errors)
    road = [datasets.Frame(_road(frame), frame.pose) for frame in street]
    errors = _evaluate(road, rows, _ROAD_VOXEL, _ROAD_DISTANCE, "road", ahead=_ROAD_START)
    yield f"The same frames cropped to the road, a plane, starting {_ROAD_START} m ahead of the true pose."
    yield _table(rows, errors)
    yield _order(rows, errors)
    if kitti is not None:
        frames = datasets.kitti(kitti)
        errors = _evaluate(frames, rows, _KITTI_VOXEL, _KITTI_DISTANCE, "kitti")
        yield f"KITTI, {kitti.name}: {len(frames)} frames. A sixth of the points, in view of the camera, have colours."
        yield _table(rows, errors)
        yield _order(rows, errors)
    yield _WHERE_IT_DIFFERS


def _rows(channel_covariance: Float[np.ndarray, "C C"] | None = None) -> list[_Row]:
    multi_channel = mcg.MultiChannelGICP()
    return [
        _Row("Color ICP", _COLORS, None),
        _Row("GICP", ("intensity",), mcg.GICP()),
        _Row("MC-GICP, intensity", ("intensity",), multi_channel),
        _Row("MC-GICP, colour", _COLORS, multi_channel),
        _Row("MC-GICP, combined", _COMBINED, multi_channel),
        _Row(_MEASURED, _COMBINED, mcg.MultiChannelGICP(channel_covariance)),
    ]


def _measure(street: datasets.SyntheticFrames, voxel_size: float) -> Float[np.ndarray, "C C"]:
    """Λ with its cross terms, as in the paper for combined channels (IV-C)."""
    clouds = [mcg.preprocess(with_channels(frame.cloud, _COMBINED), voxel_size) for frame in street]
    return mcg.estimate_channel_covariance(clouds, [_known(frame) for frame in street])


def _road(frame: datasets.Frame) -> mcg.PointCloud:
    height, aside, reach = _ROAD
    cloud = frame.cloud
    points = np.asarray(cloud.transform(_known(frame)).points)
    near = np.linalg.norm(np.asarray(cloud.points), axis=1) < reach
    keep = near & (np.abs(points[:, 2]) < height) & (np.abs(points[:, 1]) < aside)
    return mcg.PointCloud(cloud.points[keep], cloud.channels[keep], channel_names=cloud.channel_names)


def _known(frame: datasets.Frame) -> Float[np.ndarray, "4 4"]:
    if frame.pose is None:
        raise ValueError("kitti: expected a sequence with poses (00 to 10), got one without")
    return frame.pose


def _evaluate(
    frames: Sequence[datasets.Frame],
    rows: Sequence[_Row],
    voxel_size: float,
    max_distance: _Distances,
    name: str,
    ahead: float = 0.0,
) -> list[_Errors]:
    """Errors of each row on all consecutive pairs, from the identity or from `ahead` metres ahead of the truth."""
    numbers: list[list[tuple[float, float, int, bool]]] = [[] for _ in rows]
    before: dict[tuple[str, ...], mcg.PointCloud] = {}
    pose_before = None
    for frame in tqdm(frames, desc=name, unit="frame", disable=None):
        clouds = {
            channels: mcg.preprocess(with_channels(frame.cloud, channels), voxel_size)
            for channels in {row.channels for row in rows}
        }
        pose = _known(frame)
        if pose_before is not None:
            truth = np.linalg.inv(pose_before) @ pose
            start = np.eye(4)
            if ahead:
                start = truth.copy()
                start[0, 3] += ahead
            for row, found in zip(rows, numbers, strict=True):
                source, target = clouds[row.channels], before[row.channels]
                method = row.method_for(source, target)
                result = _register(source, target, method, init=start, max_distance=max_distance)
                translation, rotation = metrics.pose_error(result.matrix, truth)
                updates = int(np.asarray(result.num_iterations))
                found.append((float(translation), float(rotation), updates, bool(result.converged)))
        before, pose_before = clouds, pose
    return [_Errors(*np.array(found, float).T) for found in numbers]


def _register(
    source: mcg.PointCloud, target: mcg.PointCloud, method: AbstractMethod, **options: Any
) -> mcg.Registration:
    """Register without detection of unconstrained directions, as in the paper."""
    return mcg.register(source, target, method, hold_free_directions=False, **options)


def _table(rows: Sequence[_Row], errors: Sequence[_Errors]) -> str:
    lines = [
        "| method | translation, mm | rotation, degrees | iterations | converged | the paper (Ford), m |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for row, each in zip(rows, errors, strict=True):
        translation, rotation = 1e3 * each.translation, np.degrees(each.rotation)
        theirs = "{:.4f} ± {:.4f}".format(*_PAPER[row.name]) if row.name in _PAPER else "–"
        lines.append(
            f"| {row.name} | {translation.mean():.1f} ± {translation.std():.1f} "
            f"| {rotation.mean():.3f} ± {rotation.std():.3f} | {each.iterations.mean():.1f} "
            f"| {each.converged.sum():.0f} of {len(translation)} | {theirs} |"
        )
    return "\n".join(lines)


def _order(rows: Sequence[_Row], errors: Sequence[_Errors]) -> str:
    """Say whether the methods come in the paper's order."""
    means = {row.name: each.translation.mean() for row, each in zip(rows, errors, strict=True) if row.name in _PAPER}
    ours, theirs = (" < ".join(sorted(means, key=order)) for order in (means.__getitem__, lambda name: _PAPER[name][0]))
    verdict = "The paper's order holds" if ours == theirs else "The paper's order does not hold"
    return f"{verdict}. Here, by mean translation error: {ours}. The paper: {theirs}."


# The figures


def _figure_1(output: Path) -> Iterator[str]:
    (frame,) = datasets.poster_wall(1, points_per_frame=_FINE_POINTS)
    cloud = mcg.preprocess(frame.cloud, num_neighbors=40)
    drawn = _spread(np.asarray(cloud.points)[np.asarray(cloud.valid), :2], 0.06)
    methods = {"GICP": mcg.GICP(), "MC-GICP, colour": mcg.MultiChannelGICP()}
    plot.surface_covariances(cloud, methods, indices=drawn, path=output / "figure_1.png")
    yield "## Figure 1"
    yield "![Covariances](figure_1.png)"
    yield (
        "Covariances within the surface of a wall of posters, one standard deviation. GICP's are circles everywhere. "
        "MC-GICP's are thin across a colour edge, where the colour distinguishes a point from its neighbours, "
        "and round where the colour is uniform."
    )


def _spread(points: Float[np.ndarray, "N 2"], distance: float) -> Int[np.ndarray, "M"]:
    """Index of one point in each cell of a grid."""
    cells = np.floor(points / distance).astype(int)
    return np.sort(np.unique(cells, axis=0, return_index=True)[1])


def _figure_2(output: Path, street: datasets.SyntheticFrames) -> Iterator[str]:
    rows = [row for row in _rows() if row.name in ("Color ICP", "GICP", "MC-GICP, combined")]
    maps, ends = {}, []
    truth = [_known(frame) for frame in street]
    for row in rows:
        poses = _follow(street, row, _STREET_VOXEL, _STREET_DISTANCE)
        maps[row.name] = mcg.aggregate((frame.cloud for frame in street), poses, _STREET_MAP)
        ends.append(f"{row.name} {1e3 * metrics.ate(poses, truth, alignment='first'):.0f} mm")
    plot.maps(maps, limits=_SHOWN, path=output / "figure_2.png")
    yield "## Figure 2"
    yield "![Maps of the street](figure_2.png)"
    yield (
        f"The middle 40 m of the street from above: {len(street)} frames merged by odometry alone. Root mean square "
        f"position error, aligned at the first pose: {', '.join(ends)}."
    )


def _figure_3(output: Path) -> Iterator[str]:
    wall = datasets.poster_wall(_WALL_FRAMES, points_per_frame=_WALL_POINTS, step=_WALL_STEP, heading=np.pi)
    rows = [
        _Row("Color ICP", _COLORS, None),
        _Row("GICP", _COLORS, mcg.GICP()),
        _Row("MC-GICP", _COLORS, mcg.MultiChannelGICP()),
    ]
    truth = [_known(frame) for frame in wall]
    maps = {"truth": mcg.aggregate((frame.cloud for frame in wall), truth, _WALL_MAP)}
    ends = []
    for row in rows:
        poses = _follow(wall, row, None, _WALL_DISTANCE)
        maps[row.name] = mcg.aggregate((frame.cloud for frame in wall), poses, _WALL_MAP)
        ends.append(f"{row.name} {1e3 * metrics.ate(poses, truth, alignment='first'):.0f} mm")
    plot.maps(maps, path=output / "figure_3.png")
    yield "## Figure 3"
    yield "![Maps of the wall](figure_3.png)"
    yield (
        f"A camera moves from right to left along a flat wall, {(_WALL_FRAMES - 1) * _WALL_STEP:.1f} m in "
        f"{_WALL_FRAMES} frames. Geometry does not constrain this motion, so GICP piles the frames up. Root mean "
        f"square position error, aligned at the first pose: {', '.join(ends)}. (The posters repeat every 3.36 m.)"
    )


def _follow(
    frames: Sequence[datasets.Frame], row: _Row, voxel_size: float | None, max_distance: _Distances
) -> list[Float[np.ndarray, "4 4"]]:
    """Poses of the frames by odometry."""
    clouds = (with_channels(frame.cloud, row.channels) for frame in frames)
    first, second = (mcg.preprocess(with_channels(frame.cloud, row.channels), voxel_size) for frame in frames[:2])
    steps = mcg.odometry(
        clouds,
        row.method_for(second, first),
        voxel_size=voxel_size,
        max_distance=max_distance,
        start=_known(frames[0]),
        hold_free_directions=False,
    )
    return [step.pose for step in tqdm(steps, total=len(frames), desc=row.name, unit="frame", disable=None)]


def _figure_4(output: Path, street: datasets.SyntheticFrames) -> Iterator[str]:
    wall = datasets.poster_wall(2, points_per_frame=_WALL_POINTS)
    scenes = {
        "street": (street[:2], _STREET_VOXEL, _STREET_DISTANCE, _COMBINED),
        "wall of posters": (wall, None, _WALL_DISTANCE, _COLORS),
    }
    figure_lines, counts = {}, []
    for scene, (frames, voxel_size, max_distance, channels) in scenes.items():
        target, source = (mcg.preprocess(with_channels(frame.cloud, channels), voxel_size) for frame in frames)
        truth = np.linalg.inv(_known(frames[0])) @ _known(frames[1])
        rows = [
            _Row("Color ICP", channels, None),
            _Row("GICP", channels, mcg.GICP()),
            _Row("MC-GICP", channels, mcg.MultiChannelGICP()),
        ]
        needed = []
        for row in rows:
            method = row.method_for(source, target)
            result = _register(source, target, method, max_distance=max_distance)
            needed.append(f"{row.name} {int(np.asarray(result.num_iterations))}")
            figure_lines[scene, row.name] = (
                np.asarray(result.history["rmse"]),
                _error_by_iteration(source, target, method, max_distance, truth),
            )
        counts.append(f"on the {scene} {', '.join(needed)}")
    _draw_figure_4(figure_lines, output / "figure_4.png")
    yield "## Figure 4"
    yield "![Convergence](figure_4.png)"
    yield (
        f"One pair of each scene. Updates until one is below the tolerances: {'; '.join(counts)}. The residual, which "
        "the paper plots, is mostly due to the spacing of the points: it shows how soon a method converges, not "
        "how close to the truth. The pose error is therefore plotted beside it."
    )


def _error_by_iteration(
    source: mcg.PointCloud,
    target: mcg.PointCloud,
    method: AbstractMethod,
    max_distance: _Distances,
    truth: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "I"]:
    """Translation error at the start and after each update until convergence; metres."""
    errors = [float(metrics.pose_error(np.eye(4), truth)[0])]
    for most in range(1, _ITERATIONS + 1):
        result = _register(source, target, method, max_distance=max_distance, max_iterations=most)
        if int(np.asarray(result.num_iterations)) < most:
            break
        errors.append(float(metrics.pose_error(result.matrix, truth)[0]))
    return np.array(errors)


def _draw_figure_4(lines: dict[tuple[str, str], tuple[Any, Any]], path: Path) -> None:
    import matplotlib.figure

    scenes = list(dict.fromkeys(scene for scene, _ in lines))
    figure = matplotlib.figure.Figure((9, 3.2 * len(scenes)), layout="constrained")
    panels = figure.subplots(len(scenes), 2, squeeze=False)
    for (scene, name), (residual, error) in lines.items():
        labels = "rms distance of the matches, m", "pose error, m"
        for panel, values, label in zip(panels[scenes.index(scene)], (residual, error), labels, strict=True):
            panel.plot(values[: _ITERATIONS + 1], marker="o", markersize=3, label=name)
            panel.set(title=scene, xlabel="iteration", ylabel=label, yscale="log")
            panel.grid(alpha=0.3)
            panel.legend()
    figure.savefig(path, dpi=120)


# Text of the report

_INTRODUCTION = """Servos & Waslander, *Multi Channel Generalized-ICP*, ICRA 2014, section V, repeated. The paper used
Ford Campus scans and Kinect frames of its own; this report uses simulated scenes whose true poses are exact: a street
(LiDAR with a panoramic camera) and a wall of posters (Kinect). All methods get the same points and the same initial
pose, and their parameters come from the data: Λ and α as `MultiChannelGICP()` chooses them, Color ICP with the same α.
As in the paper, unconstrained directions are not held at the initial pose (`hold_free_directions=False`)."""

_WHERE_IT_DIFFERS = """Where these numbers differ from the paper's, and why. On the whole street, the paper's errors are
some two hundred times larger than GICP's here, and its methods differ by less than their standard deviations, so the
cause is common to all methods. It is likely the truth itself (GPS), the motion of the car during a scan, and moving
objects; this street has none of these. Without them geometry alone, constrained in all directions by kerbs, cars,
poles and the reveals of windows, reaches millimetres, and channels cannot improve on that. They can do harm:
MC-GICP's covariances are smaller than GICP's along a surface, which gives more weight to a match that is half a metre
off because the rings of two scans lie elsewhere. Where geometry leaves a direction unconstrained, as on the road
alone, the channels decide: with colours MC-GICP is far closer to the truth than GICP, by more than in the paper.
Intensity alone does not converge within the iterations allowed: most of its edges run along the road."""
