"""`mcgicp paper`: the experiments of Servos & Waslander (2014), section V, and a report of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float, Int
from tqdm import tqdm

import mcgicp_jax as mcg
from mcgicp_jax import datasets, metrics, plot
from mcgicp_jax._algebra import matrix_from_symmetric
from mcgicp_jax._commands._options import weights_from, with_channels
from mcgicp_jax._methods import AbstractMethod
from mcgicp_jax._surface import covariance_of
from mcgicp_jax._surfaces import surfaces_of

Folder: TypeAlias = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]

_COLORS = ("red", "green", "blue")
_COMBINED = ("intensity", *_COLORS)
# The translation errors of Table I, on Ford Campus, and their standard deviations; metres.
_PAPER = {
    "Color ICP": (0.5106, 0.3280),
    "GICP": (0.3082, 0.1446),
    "MC-GICP, intensity": (0.3857, 0.1756),
    "MC-GICP, colour": (0.2941, 0.1409),
    "MC-GICP, combined": (0.2891, 0.1387),
}
_MEASURED = "MC-GICP, combined, Λ measured"
# Metres: how far apart two matched points may lie, while the pose is being found and when it is refined.
_Gates: TypeAlias = tuple[float, float]
_STREET_VOXEL, _KITTI_VOXEL = 0.2, 0.25
_STREET_DISTANCE: _Gates = (2.0, 0.5)
_KITTI_DISTANCE: _Gates = (2.5, 0.6)
# Frames that Λ is measured from, of another street.
_TRAINING = 4
# Voxels of the map; what is shown of it, along the street and across it.
_STREET_MAP, _SHOWN = 0.07, np.array([[-20.0, 20.0], [-9.5, 9.5]])
# The road alone: metres above and below it, to either side, and from the sensor; and how far ahead the start is.
_ROAD, _ROAD_VOXEL, _ROAD_START = (0.06, 6.0, 25.0), 0.1, 0.3
_ROAD_DISTANCE: _Gates = (0.6, 0.15)
_WALL_FRAMES, _WALL_POINTS, _WALL_STEP, _WALL_MAP = 100, 12_000, 0.066, 0.006
_WALL_DISTANCE: _Gates = (0.15, 0.04)
# Of the wall, to draw covariances on.
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
    """Of all pairs: metres, radians, updates of the pose, whether it converged."""

    translation: Float[np.ndarray, "N"]
    rotation: Float[np.ndarray, "N"]
    iterations: Float[np.ndarray, "N"]
    converged: Float[np.ndarray, "N"]


def paper(
    output: Path = Path("mcgicp_paper"), kitti: Folder = None, num_frames: int = 50, points_per_frame: int = 30_000
) -> int:
    """Run the experiments of the paper, Table I and Figs. 1 to 4, and write a report with pictures.

    They run on scenes that are made up, since the paper's own data are not at hand: a street for a LiDAR with a camera,
    and a wall of posters for a Kinect.

    Args:
        output: Folder for report.md and its pictures.
        kitti: Folder of a sequence of the KITTI odometry data set, such as sequences/04, for Table I on real scans too.
        num_frames: Frames of the street.
        points_per_frame: Of the street.
    """
    if num_frames < 3:
        raise ValueError(f"num_frames: expected at least 3, got {num_frames}")
    if kitti is not None:
        # Before minutes of work, that of the street.
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
    yield f"The street: {len(street)} frames, every pair of consecutive ones from the identity, 1 m apart."
    yield _table(rows, errors)
    yield _order(rows, errors)
    road = [datasets.Frame(_road(frame), frame.pose) for frame in street]
    errors = _evaluate(road, rows, _ROAD_VOXEL, _ROAD_DISTANCE, "road", ahead=_ROAD_START)
    yield f"The same frames, of which only the road is left: a plane. Starts {_ROAD_START} m ahead of the truth."
    yield _table(rows, errors)
    yield _order(rows, errors)
    if kitti is not None:
        frames = datasets.kitti(kitti)
        errors = _evaluate(frames, rows, _KITTI_VOXEL, _KITTI_DISTANCE, "kitti")
        yield f"KITTI, {kitti.name}: {len(frames)} frames; colours where the camera sees a point, a sixth of them."
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
    """Λ with its cross terms, as the paper has it for combined channels (IV-C)."""
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
    max_distance: _Gates,
    name: str,
    ahead: float = 0.0,
) -> list[_Errors]:
    """Each pair of consecutive frames by each row, from the identity or from `ahead` of the truth, metres."""
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
    """As in the paper, whose methods do not know which directions nothing holds."""
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
    """Whether the paper's order holds, in words."""
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
    covariances = {
        name: matrix_from_symmetric(
            jnp.asarray(covariance_of(surfaces_of(method, cloud, cloud, observed=False)[1].table))
        )
        for name, method in methods.items()
    }
    plot.surface_covariances(cloud, covariances, indices=drawn, path=output / "figure_1.png")
    yield "## Figure 1"
    yield "![Covariances](figure_1.png)"
    yield (
        "Covariances within the surface, one standard deviation, on a wall of posters. GICP's are circles everywhere. "
        "MC-GICP's are thin across an edge of colour: there a point cannot be mistaken for one further on; and round "
        "where the colour is the same all around."
    )


def _spread(points: Float[np.ndarray, "N 2"], distance: float) -> Int[np.ndarray, "M"]:
    """One point of each cell of a grid."""
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
        f"The street from above, {len(street)} frames laid together by odometry alone; the middle 40 m. Root mean "
        f"square error of the positions, from the first pose: {', '.join(ends)}."
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
        f"{_WALL_FRAMES} frames. Geometry says nothing of this motion: GICP piles the frames up. Root mean square "
        f"error of the positions, from the first pose: {', '.join(ends)}. (The posters repeat after 3.36 m.)"
    )


def _follow(
    frames: Sequence[datasets.Frame], row: _Row, voxel_size: float | None, max_distance: _Gates
) -> list[Float[np.ndarray, "4 4"]]:
    """The poses of an odometry."""
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
        f"One pair of each scene. Updates until the pose moves by less than 0.5 mm and 0.5 mrad: {'; '.join(counts)}. "
        "The residual, which the paper draws, is mostly the distance between the points: it tells how soon a method "
        "comes to rest, not how near the truth that is. So the error of the pose is drawn beside it."
    )


def _error_by_iteration(
    source: mcg.PointCloud,
    target: mcg.PointCloud,
    method: AbstractMethod,
    max_distance: _Gates,
    truth: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "I"]:
    """Metres, at the start and after each update, until the pose rests."""
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
        labels = "rms distance of the pairs, m", "error of the pose, m"
        for panel, values, label in zip(panels[scenes.index(scene)], (residual, error), labels, strict=True):
            panel.plot(values[: _ITERATIONS + 1], marker="o", markersize=3, label=name)
            panel.set(title=scene, xlabel="iteration", ylabel=label, yscale="log")
            panel.grid(alpha=0.3)
            panel.legend()
    figure.savefig(path, dpi=120)


# What the report says about them

_INTRODUCTION = """Servos & Waslander, *Multi Channel Generalized-ICP*, ICRA 2014, section V, run anew. The paper used
Ford Campus scans and Kinect frames of its own; this report uses made-up scenes whose truth is exact, a street (LiDAR
with a panoramic camera) and a wall of posters (Kinect). All methods get the same points and start from the same pose,
and every number of theirs comes from the data: Λ and α as `MultiChannelGICP()` chooses them, Color ICP with the same α.
As in the paper, a pose is not held in directions that nothing holds (`hold_free_directions=False`)."""

_WHERE_IT_DIFFERS = """Where these numbers differ from the paper's, and why. On the street with all its things, the
paper's errors are some two hundred times larger than GICP's here, and its methods differ by less than their standard
deviations: whatever sets that level, it is common to all methods. Likely it is the truth itself (a GPS), the motion
of the car during a scan, and things that move; none of these is in this street. Without them geometry alone, held
from all sides by kerbs, cars, poles and the reveals of windows, gives millimetres, and channels cannot better that.
They can do harm: the covariances of MC-GICP are smaller than GICP's along a surface, so that a match that is half a
metre off because the rings of two scans lie elsewhere counts for more. Where geometry leaves a direction free, as on
the road alone, the channels decide it: with colours MC-GICP is far nearer the truth than GICP, by more than in the
paper. Intensity alone does not get there in the iterations that it has: most of what it could hold on to runs along
the road."""
