"""`mcgicp paper`: run the experiments of Servos & Waslander (2014), section V, and write a report."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

import mcgicp_jax as mcg
from mcgicp_jax import datasets, metrics, plot
from mcgicp_jax._cli.options import shown, weights_from, with_channels
from mcgicp_jax._methods.base import AbstractMethod

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
# Voxel size, and max_distance while the pose is being found and when it is refined; metres.
_STREET, _KITTI = (0.2, datasets.DATASETS["street"].max_distance), (0.25, datasets.DATASETS["kitti"].max_distance)
_ROAD, _WALL = (0.1, (0.6, 0.15)), (None, (0.15, 0.04))
# Metres. Points of the road: height, distance to either side, range; its initial poses are this far ahead of the truth.
_ROAD_LIMITS, _ROAD_START = (0.06, 6.0, 25.0), 0.3
# Metres. Voxel sizes of the maps; part of the street that is shown; step along the wall; distance of drawn covariances.
_STREET_MAP, _WALL_MAP, _SHOWN = 0.07, 0.006, np.array([[-20.0, 20.0], [-9.5, 9.5]])
_WALL_STEP, _BETWEEN = 0.066, 0.06


class Row(NamedTuple):
    """A method on some of the channels; `method` is None for Color ICP, whose weights are chosen for each pair."""

    name: str
    channels: tuple[str, ...]
    method: AbstractMethod | None

    def preprocess(self, frame: datasets.Frame, voxel_size: float | None) -> mcg.PointCloud:
        return mcg.preprocess(with_channels(frame.cloud, self.channels), voxel_size)

    def method_for(self, source: mcg.PointCloud, target: mcg.PointCloud) -> AbstractMethod:
        return mcg.ColorICP(weights_from(source, target)) if self.method is None else self.method

    def register(self, source: mcg.PointCloud, target: mcg.PointCloud, **options: Any) -> Any:
        """Register without detection of unconstrained directions, as in the paper."""
        return mcg.register(source, target, self.method_for(source, target), hold_unconstrained=False, **options)


def rows_of_table(channel_covariance: Float[np.ndarray, "C C"] | None = None) -> list[Row]:
    """The rows of Table I, and a last one with a measured Λ."""
    return [
        Row("Color ICP", _COLORS, None),
        Row("GICP", ("intensity",), mcg.GICP()),
        Row("MC-GICP, intensity", ("intensity",), mcg.MultiChannelGICP()),
        Row("MC-GICP, colour", _COLORS, mcg.MultiChannelGICP()),
        Row("MC-GICP, combined", _COMBINED, mcg.MultiChannelGICP()),
        Row("MC-GICP, combined, Λ measured", _COMBINED, mcg.MultiChannelGICP(channel_covariance)),
    ]


def paper(
    output: Path = Path("mcgicp_paper"),
    kitti: Annotated[Path | None, shown("PATH")] = None,
    num_frames: int = 50,
    points_per_frame: int = 30_000,
    wall_frames: int = 100,
    wall_points: int = 12_000,
) -> int:
    """Run the experiments of the paper, Table I and Figs. 1 to 4, and write a report with pictures.

    The paper's own data are not available, so they run on simulated scenes: a street seen by a LiDAR with a camera, and
    a wall of posters seen by a Kinect. They take some five minutes.

    Args:
        output: Folder for report.md and its pictures.
        kitti: Folder of a KITTI odometry sequence, such as sequences/04, to run Table I on real scans too.
        num_frames: Number of frames of the street.
        points_per_frame: Number of points in each frame of the street.
        wall_frames: Number of frames of the wall.
        wall_points: Number of points in each frame of the wall.
    """
    if num_frames < 3:
        raise ValueError(f"num_frames: expected at least 3, got {num_frames}")
    street = datasets.street(num_frames, points_per_frame=points_per_frame)
    wall = datasets.poster_wall(wall_frames, points_per_frame=wall_points, step=_WALL_STEP, heading=np.pi)
    tables: list[tuple[str, Sequence[datasets.Frame], Any, float]] = [
        (f"the street, {num_frames} frames 1 m apart", street, _STREET, 0.0),
        (f"its road alone, from {_ROAD_START} m ahead of the truth", [*map(_road, street)], _ROAD, _ROAD_START),
    ]
    if kitti is not None:
        tables += [(f"KITTI, {kitti.name}", datasets.kitti(kitti), _KITTI, 0.0)]
        if tables[-1][1][0].pose is None:
            raise ValueError("kitti: expected a sequence with poses (00 to 10), got one without")
    output.mkdir(parents=True, exist_ok=True)
    # Λ with its cross terms, as in the paper for combined channels (IV-C), from another street.
    others: Any = datasets.street(4, points_per_frame=points_per_frame, seed=1)
    clouds = [rows_of_table()[-1].preprocess(frame, _STREET[0]) for frame in others]
    rows = rows_of_table(mcg.estimate_channel_covariance(clouds, [frame.pose for frame in others]))
    parts = [_INTRODUCTION]
    for title, frames, (voxel_size, max_distance), ahead in tables:
        parts += [f"## Table I: {title}", *table(rows, _errors(frames, rows, voxel_size, max_distance, ahead))]
    parts += _figures(output, rows, street, wall, 3 * wall_points)
    (output / "report.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    print(f"report:    {output / 'report.md'}")
    return 0


def _figures(output: Path, rows: Sequence[Row], street: Any, wall: Any, num_points: int) -> Iterator[str]:
    (frame,) = datasets.poster_wall(1, points_per_frame=num_points)
    cloud = mcg.preprocess(frame.cloud, num_neighbors=40)
    cells = np.floor(np.asarray(cloud.points)[np.asarray(cloud.valid), :2] / _BETWEEN)
    drawn = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    methods = {"GICP": mcg.GICP(), "MC-GICP, colour": mcg.MultiChannelGICP()}
    plot.surface_covariances(cloud, methods, indices=drawn, path=output / "figure_1.png")
    yield "## Figure 1: covariances within the surface, one standard deviation\n\n![Covariances](figure_1.png)"
    colored = [row._replace(channels=_COLORS) for row in (rows[0], rows[1], rows[3])]
    yield from _maps(output / "figure_2.png", street, [*rows[:2], rows[4]], *_STREET, _STREET_MAP, _SHOWN)
    yield from _maps(output / "figure_3.png", wall, colored, *_WALL, _WALL_MAP)
    results = {}
    for row in colored:
        target, source = (row.preprocess(frame, _WALL[0]) for frame in wall[:2])
        results[row.name] = np.asarray(row.register(source, target, max_distance=_WALL[1]).history["rmse"])
    plot.convergence(results, ylabel="rms distance of the matches, m").savefig(output / "figure_4.png")
    yield "## Figure 4: convergence on the wall\n\n![Residual](figure_4.png)"


def _road(frame: Any) -> datasets.Frame:
    height, side, distance = _ROAD_LIMITS
    cloud, world = frame.cloud, np.asarray(frame.cloud.transform(frame.pose).points)
    keep = (np.abs(world[:, 2]) < height) & (np.abs(world[:, 1]) < side)
    keep &= np.linalg.norm(np.asarray(cloud.points), axis=1) < distance
    cloud = mcg.PointCloud(cloud.points[keep], cloud.channels[keep], channel_names=cloud.channel_names)
    return datasets.Frame(cloud, frame.pose)


def _errors(
    frames: Any, rows: Sequence[Row], voxel_size: float | None, max_distance: Any, ahead: float
) -> Float[np.ndarray, "rows N 4"]:
    """For each row and pair of consecutive frames: errors in metres and radians, updates, and whether it converged.

    The initial pose is the identity, or `ahead` metres ahead of the true one.
    """
    errors: list[list[tuple[Any, ...]]] = [[] for _ in rows]
    before: Any = None
    for frame in tqdm(frames, unit="frame", disable=None):
        clouds = {row.channels: row.preprocess(frame, voxel_size) for row in rows}
        if before is not None:
            truth = np.linalg.inv(before[0]) @ frame.pose
            start = truth + ahead * np.eye(4, k=3) if ahead else np.eye(4)
            for row, found in zip(rows, errors, strict=True):
                source, target = clouds[row.channels], before[1][row.channels]
                result = row.register(source, target, init=start, max_distance=max_distance)
                found.append((*metrics.pose_error(result.matrix, truth), result.num_iterations, result.converged))
        before = frame.pose, clouds
    return np.array(errors, float)


def table(rows: Sequence[Row], errors: Float[np.ndarray, "rows N 4"]) -> Iterator[str]:
    """Table I in Markdown, and whether the methods come in the paper's order."""
    lines = ["| method | translation, mm | rotation, degrees | iterations | converged | the paper (Ford), m |"]
    lines += ["| --- | ---: | ---: | ---: | ---: | ---: |"]
    for row, each in zip(rows, errors * [1e3, 180 / np.pi, 1, 1], strict=True):
        (shift, turn, updates, _), (shift_spread, turn_spread, *_) = each.mean(axis=0), each.std(axis=0)
        theirs = "{:.4f} ± {:.4f}".format(*_PAPER[row.name]) if row.name in _PAPER else "–"
        lines.append(
            f"| {row.name} | {shift:.1f} ± {shift_spread:.1f} | {turn:.3f} ± {turn_spread:.3f} | {updates:.1f} "
            f"| {each[:, 3].sum():.0f} of {len(each)} | {theirs} |"
        )
    yield "\n".join(lines)
    means = {row.name: each[:, 0].mean() for row, each in zip(rows, errors, strict=True) if row.name in _PAPER}
    ours, theirs = (" < ".join(sorted(means, key=order)) for order in (means.__getitem__, _PAPER.__getitem__))
    verdict = "The paper's order holds" if ours == theirs else "The paper's order does not hold"
    yield f"{verdict}. Here, by mean translation error: {ours}. The paper: {theirs}."


def _maps(
    path: Path, frames: Any, rows: Sequence[Row], voxel_size: Any, max_distance: Any, size: float, limits: Any = None
) -> Iterator[str]:
    """Maps, with voxels of a size in metres, of frames merged by odometry alone; and the errors of the trajectories."""
    truth, errors = [frame.pose for frame in frames], []
    maps = {"truth": mcg.merge_clouds((frame.cloud for frame in frames), truth, size)}
    options: Any = {"voxel_size": voxel_size, "max_distance": max_distance, "hold_unconstrained": False}
    for row in rows:
        method = row.method_for(row.preprocess(frames[1], voxel_size), row.preprocess(frames[0], voxel_size))
        clouds = (with_channels(frame.cloud, row.channels) for frame in frames)
        steps = mcg.odometry(clouds, method, start=truth[0], **options)
        poses = [step.pose for step in tqdm(steps, total=len(frames), desc=row.name, unit="frame", disable=None)]
        maps[row.name] = mcg.merge_clouds((frame.cloud for frame in frames), poses, size)
        errors.append(f"{row.name} {1e3 * metrics.ate(poses, truth, alignment='first'):.0f} mm")
    plot.maps(maps, limits=limits, path=path)
    yield f"## Figure {path.stem[-1]}: {len(frames)} frames merged by odometry"
    yield f"![Maps]({path.name})"
    yield f"Root mean square position error, aligned at the first pose: {', '.join(errors)}."


_INTRODUCTION = """# The experiments of the paper

Servos & Waslander, *Multi Channel Generalized-ICP*, ICRA 2014, section V, on simulated scenes whose true poses are
exact: a street (LiDAR with a panoramic camera) and a wall of posters (Kinect). As in the paper, unconstrained
directions are not held at the initial pose. The notebook `paper.ipynb` discusses the results."""
