"""`mcgicp odometry DATASET PATH`: register each frame of a sequence to the one before it."""

from __future__ import annotations

import collections
import itertools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
import tyro
from jaxtyping import Float
from tqdm import tqdm

import mcgicp_jax as mcg
from mcgicp_jax import datasets, io, metrics, plot
from mcgicp_jax._cli.options import (
    METHODS,
    File,
    MethodName,
    Options,
    check_outputs,
    listed,
    round_voxel_size,
    weights_from,
    with_channels,
)
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._sequences.odometry import OdometryStep

DatasetName: TypeAlias = Literal["kitti", "ford", "tum", "7-scenes", "street", "corridor", "box-room", "poster-wall"]
Dataset: TypeAlias = Annotated[DatasetName, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")]
Folder: TypeAlias = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PATH", help_behavior_hint="")]
Distances: TypeAlias = tuple[float, float]
Names: TypeAlias = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAMES", help_behavior_hint="(default: all)")]

# Function of a folder or of a number of frames; defaults of voxel size and of max_distance (at first, and when the pose
# is refined) that suit the sensor and its motion; metres.
_READERS: dict[str, tuple[Callable[[Path], datasets.AbstractFrames], float, Distances]] = {
    "kitti": (datasets.kitti, 0.25, (2.5, 0.6)),
    "ford": (datasets.ford_campus, 0.25, (2.5, 0.6)),
    "tum": (datasets.tum_rgbd, 0.03, (0.2, 0.06)),
    "7-scenes": (datasets.seven_scenes, 0.03, (0.2, 0.06)),
}
_SCENES: dict[str, tuple[Callable[[int], datasets.AbstractFrames], float | None, Distances]] = {
    "street": (datasets.street, 0.2, (2.0, 0.5)),
    "corridor": (datasets.corridor, None, (0.5, 0.25)),
    "box-room": (datasets.box_room, None, (0.5, 0.25)),
    "poster-wall": (datasets.poster_wall, None, (0.1, 0.04)),
}
_FRAMES_OF_A_SCENE = 20
_KITTI_LENGTHS = np.arange(100.0, 900, 100)


def odometry(
    dataset: Dataset,
    path: Folder = Path(),
    *,
    shared: Options,
    method: MethodName = "mc-gicp",
    channels: Names = (),
    num_frames: int | Literal["all"] = "all",
    against: Literal["previous", "map"] = "previous",
    map_radius: Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="")] = None,
    loops: bool = False,
    output: File = None,
    map: File = None,
    plot: File = None,
) -> int:
    """Estimate the sensor's trajectory by registering each frame of a sequence to the one before it, or to a map.

    DATASET is kitti, ford, tum or 7-scenes, with the sequence in the folder PATH; or a simulated scene (street,
    corridor, box-room or poster-wall), which needs no PATH. Errors are printed if the true poses are known. The exit
    code is 0 only if all registrations converged; output files are written in any case.

    Defaults of --voxel-size: 0.25 for kitti and ford, 0.2 for street, 0.03 for tum and 7-scenes, off for the others.
    Defaults of --max-distance: 2.5 and 0.6 for kitti and ford, 2 and 0.5 for street, 0.5 and 0.25 for corridor and
    box-room, 0.2 and 0.06 for tum and 7-scenes, 0.1 and 0.04 for poster-wall.

    Args:
        dataset: Format of the data set, or simulated scene.
        path: Folder of the sequence, such as sequences/04.
        method: mc-gicp, color-icp and color-ndt use channels, the others geometry alone.
        channels: Channels to use, such as intensity, or red green blue, or lab, hsv or yuv computed from these three.
        num_frames: Number of frames to use, from the start; all means 20 for a simulated scene.
        against: Register each frame to the one before it, or to a map of all frames before it, which drifts less.
        map_radius: Metres; points further from the sensor leave the map. By default the range of the first frame.
        loops: Register frames with earlier ones that saw the same place, and correct all poses.
        output: File for the poses, sensor to world, in KITTI format: the upper three rows of each matrix on one line.
        map: File for the map in the world frame, such as map.ply. Its voxels have the size used for registration; if
            that is off, a size that keeps at most half of the first cloud.
        plot: File for a picture of the trajectory from above, such as way.png.
    """
    check_outputs(output, cloud=map, picture=plot)
    shared.check()
    shared.check_method(method)
    frames, usual_voxel, usual_distance = _open(dataset, path, num_frames)
    given = shared.voxel_size
    voxel = given if not isinstance(given, str) else usual_voxel if given == "auto" else None
    options: dict[str, Any] = {
        "max_distance": usual_distance,
        "num_neighbors": shared.num_neighbors,
        "against": against,
        "map_radius": map_radius,
        "loops": loops,
    } | shared.registration()
    first = frames[0]
    names = channels or first.cloud.channel_names
    print(f"frames:    {len(frames)} of {dataset}, {len(first.cloud):,} points in the first")
    print(f"channels:  {listed(names)}")
    truth: list[Float[np.ndarray, "4 4"] | None] = []
    chosen = _method(method, shared.numbers_of(method), frames, names, voxel)
    steps = mcg.odometry(_clouds(frames, names, truth), chosen, voxel_size=voxel, start=first.pose, **options)
    map_voxel = round_voxel_size([first.cloud], len(first.cloud) // 2) if map and voxel is None else voxel
    follow = _follow_loops if loops else _follow
    poses, results = follow(steps, len(frames), map, map_voxel)
    _report(poses, truth, results)
    if output is not None:
        io.write_poses(output, poses)
    if plot is not None:
        _draw(plot, method, poses, truth)
    if failed := sum(not result.converged for result in results):
        print(f"mcgicp: {failed} of {len(results)} registrations did not converge", file=sys.stderr)
    return 1 if failed else 0


def _open(
    dataset: DatasetName, path: Path, num_frames: int | Literal["all"]
) -> tuple[datasets.AbstractFrames, float | None, Distances]:
    if num_frames != "all" and num_frames < 2:
        raise ValueError(f"num_frames: expected at least 2, got {num_frames}")
    if dataset in _SCENES:
        scene, voxel, distance = _SCENES[dataset]
        return scene(_FRAMES_OF_A_SCENE if num_frames == "all" else num_frames), voxel, distance
    reader, voxel, distance = _READERS[dataset]
    frames = reader(path)
    if len(frames) < 2:
        raise ValueError(f"{path}: expected at least 2 frames, got {len(frames)}")
    return frames if num_frames == "all" else frames[:num_frames], voxel, distance


def _follow(
    steps: Iterator[OdometryStep], num_frames: int, map: Path | None, voxel_size: float | None
) -> tuple[list[Float[np.ndarray, "4 4"]], list[mcg.Registration]]:
    """Run the odometry, write the map if it has a file, and return the poses and the registrations."""
    poses, results = [], []

    def followed() -> Iterator[tuple[mcg.PointCloud, Float[np.ndarray, "4 4"]]]:
        for step in tqdm(steps, total=num_frames, unit="frame", disable=None):
            poses.append(step.pose)
            if step.registration is not None:
                results.append(step.registration)
            yield step.cloud, step.pose

    if map is None or voxel_size is None:
        collections.deque(followed(), maxlen=0)
    else:
        # A stream: no cloud is kept once it is in the map.
        with_clouds, with_poses = itertools.tee(followed())
        world = mcg.aggregate((cloud for cloud, _ in with_clouds), (pose for _, pose in with_poses), voxel_size)
        _write_map(map, world, voxel_size)
    return poses, results


def _follow_loops(
    steps: Iterator[OdometryStep], num_frames: int, map: Path | None, voxel_size: float | None
) -> tuple[list[Float[np.ndarray, "4 4"]], list[mcg.Registration]]:
    """As `_follow`, with the poses as the last loop left them."""
    followed = list(tqdm(steps, total=num_frames, unit="frame", disable=None))
    graph: Any = followed[-1].graph
    print(f"loops:     {int(np.asarray(graph.edges.uncertain).sum())} closed")
    if map is not None and voxel_size is not None:
        _write_map(map, mcg.aggregate((step.cloud for step in followed), graph.poses, voxel_size), voxel_size)
    return list(graph.poses), [step.registration for step in followed if step.registration is not None]


def _write_map(path: Path, world: mcg.PointCloud, voxel_size: float) -> None:
    io.write(path, world)
    print(f"map:       {path}, {len(world):,} points, voxels of {voxel_size:g} m")


def _clouds(
    frames: datasets.AbstractFrames, names: tuple[str, ...], truth: list[Float[np.ndarray, "4 4"] | None]
) -> Iterator[mcg.PointCloud]:
    """Yield the cloud of each frame, and append its true pose to `truth`."""
    for frame in frames:
        truth.append(frame.pose)
        yield with_channels(frame.cloud, names)


def _method(
    name: MethodName,
    numbers: dict[str, Any],
    frames: datasets.AbstractFrames,
    channels: tuple[str, ...],
    voxel_size: float | None,
) -> AbstractMethod:
    kind = METHODS[name]
    if numbers or not issubclass(kind, mcg.ColorICP):
        return kind(**numbers)
    # Channel weights from the first two frames, as mc-gicp would choose them.
    first, second = (mcg.preprocess(with_channels(frame.cloud, channels), voxel_size) for frame in frames[:2])
    return kind(channel_weights=weights_from(second, first))


def _report(
    poses: list[Float[np.ndarray, "4 4"]],
    truth: list[Float[np.ndarray, "4 4"] | None],
    results: list[mcg.Registration],
) -> None:
    iterations = np.mean([np.asarray(result.num_iterations) for result in results])
    converged = sum(bool(result.converged) for result in results)
    print(f"pairs:     {converged} of {len(results)} converged, {iterations:.1f} iterations on average")
    known = [row for row, pose in enumerate(truth) if pose is not None]
    if len(known) < 2:
        print("errors:    unknown, since there are no true poses")
        return
    estimated, true = [poses[row] for row in known], [truth[row] for row in known]
    translation, rotation = metrics.rpe(estimated, true)
    print(f"per pair:  {1e3 * translation.mean():.1f} mm, {np.degrees(rotation.mean()):.3f} deg on average")
    whole = metrics.ate(estimated, true)
    first = metrics.ate(estimated, true, alignment="first")
    print(
        f"ATE:       {1e3 * whole:.1f} mm rms after the best alignment, {1e3 * first:.1f} mm aligned at the first pose"
    )
    length = float(np.linalg.norm(np.diff(np.array(true)[:, :3, 3], axis=0), axis=1).sum())
    segments = _KITTI_LENGTHS[length > _KITTI_LENGTHS] if length > _KITTI_LENGTHS[0] else np.array([length / 2])
    percent, degrees = metrics.kitti_errors(estimated, true, lengths=segments.tolist(), step=1)
    shown = ", ".join(f"{segment:.3g}" for segment in segments)
    print(f"drift:     {percent:.2f} %, {degrees:.4f} deg/m over segments of {shown} m")


def _draw(
    path: Path,
    method: MethodName,
    poses: list[Float[np.ndarray, "4 4"]],
    truth: list[Float[np.ndarray, "4 4"] | None],
) -> None:
    known = [pose for pose in truth if pose is not None]
    plot.trajectories(({"truth": known} if known else {}) | {method: poses}, path=path)
    print(f"picture:   {path}")
