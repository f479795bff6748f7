"""`mcgicp odometry FOLDER` or `DATASET PATH`: register each frame of a sequence to the one before it."""

from __future__ import annotations

import contextlib
import inspect
import itertools
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import numpy as np
import tyro
from jaxtyping import Float
from tqdm import tqdm

import mcgicp_jax as mcg
from mcgicp_jax import io, metrics
from mcgicp_jax import plot as plots
from mcgicp_jax._cli import options as cli
from mcgicp_jax._cli.choices import Choices, with_channels
from mcgicp_jax._clouds.voxel_map import VoxelMap
from mcgicp_jax._clouds.voxel_size import map_voxel_size
from mcgicp_jax._compute.messages import check_integer
from mcgicp_jax._sequences.odometry import OdometryStep
from mcgicp_jax.datasets import DATASETS, AbstractFrames

# Folder of clouds, or name of a data set.
if TYPE_CHECKING:
    Frames: TypeAlias = Path | str
else:
    Frames = Literal[tuple(DATASETS)] | Path

Pose: TypeAlias = Float[np.ndarray, "4 4"]
NumFrames: TypeAlias = int | Literal["all"]

_FRAMES_OF_A_SCENE = 20
_RECORDED = [name for name, dataset in DATASETS.items() if not dataset.simulated]
_MAX_DISTANCES = ", ".join(
    f"{far:g} and {near:g} for {cli.enumerated(list(names))}"
    for (far, near), names in itertools.groupby(DATASETS, lambda name: DATASETS[name].max_distance)
)


@partial(
    cli.with_names,
    datasets=cli.enumerated(_RECORDED, "or"),
    scenes=cli.enumerated([name for name, dataset in DATASETS.items() if dataset.simulated], "or"),
    max_distances=_MAX_DISTANCES,
)
def odometry(
    dataset: Annotated[Frames, tyro.conf.Positional, tyro.conf.arg(metavar="{FOLDER,DATASET}")],
    path: Annotated[Path | None, tyro.conf.Positional, cli.shown("PATH")] = None,
    *,
    shared: cli.Options,
    method: cli.Method = None,
    num_frames: NumFrames = "all",
    every: int = 1,
    min_range: float = 0.0,
    max_range: float = float("inf"),
    against: Literal["previous", "map"] = "previous",
    map_radius: Annotated[float | None, cli.shown("FLOAT")] = None,
    recover: bool = False,
    loops: bool = False,
    deskew: bool = False,
    output: cli.File = None,
    pose_format: Literal["kitti", "tum"] = "kitti",
    pose_frame: Literal["sensor", "camera"] = "sensor",
    map: cli.File = None,
    plot: cli.File = None,
) -> int:
    """Estimate the sensor's trajectory by registering each frame of a sequence to the one before it, or to a map.

    FOLDER holds a cloud per frame; files that are no clouds are left out. DATASET is {datasets}, with the sequence in
    the folder PATH; or a simulated scene ({scenes}), which needs no PATH. Errors are printed if the true poses are
    known. The exit code is 0 only if all registrations converged; output files are written in any case: after an
    invalid frame or Ctrl-C, of the frames before it.

    Defaults of --max-distance: {max_distances}.

    Args:
        dataset: Folder of clouds in order of name, such as ./scans, or format of a data set, or simulated scene.
        path: Folder of the sequence, such as sequences/04.
        method: {channel_methods} use channels, the others geometry alone.
        num_frames: Number of frames to use, from the start; all means 20 for a simulated scene.
        every: Use every n-th frame.
        min_range: Metres; points nearer to the sensor are left out, such as those on its own vehicle.
        max_range: Metres; points further from the sensor are left out.
        against: Register each frame to the one before it, or to a map of all frames before it, which drifts less.
        map_radius: Metres; points further from the sensor leave the map. By default the range of the first frame.
        recover: Find frames again in the map of all frames before them where tracking is lost, as after a jump.
        loops: Register frames with earlier ones that saw the same place, and correct all poses. Not with --recover.
        deskew: Undo the motion of the sensor during each scan, whose points have times; the street is simulated so.
        output: File for the poses, sensor to world.
        pose_format: kitti writes the upper three rows of each matrix on one line; tum writes time, position and
            quaternion, for frames whose times are known.
        pose_frame: camera writes the poses of camera 0, as the true poses of KITTI are, by the calibration of the
            sequence; the world is camera 0 at the start.
        map: File for the map in the world frame, such as map.ply. Its voxels have the size used for registration; if
            that is off, the spacing of the points.
        plot: File for a picture of the trajectory in its principal plane, such as way.png.
    """
    cli.check_outputs(output, cloud=map, picture=plot, inputs=[path] if path else [])
    shared.check(method)
    check_integer("every", every, 1)
    if loops and (against == "map" or recover):
        other = "--against map" if against == "map" else "--recover"
        raise ValueError(f"--loops: expected --against previous, whose registrations become edges, got {other}")
    if map_radius is not None and against != "map":
        raise ValueError(f"--map-radius: expected --against map with {map_radius:g}, got --against {against}")
    if shared.columns is not None and isinstance(dataset, str):
        raise ValueError(f"columns: expected none, since {dataset} has a layout of its own, got {shared.columns}")
    if deskew and every > 1:
        raise ValueError(f"--deskew: expected scans that follow each other without gaps, got --every {every}")
    frames = _open(dataset, path, num_frames, every, map, shared.columns, deskew)
    if (min_range, max_range) != (0, np.inf):
        frames = frames.crop(min_range, max_range)
    if pose_frame == "camera" and frames.to_camera is None:
        raise ValueError(f"pose_frame: expected sensor, since {dataset} has no calibration of a camera, got camera")
    first = frames[0]
    if pose_format == "tum" and first.time is None:
        raise ValueError(f"pose_format: expected kitti, since the frames of {dataset} have no times, got tum")
    if deskew and first.cloud.times is None:
        raise ValueError(f"--deskew: expected points with times, such as a column time in files, got none in {dataset}")

    print(f"frames:    {len(frames)} of {dataset}, {len(first.cloud):,} points in the first")
    start = [first.cloud]
    # If the second frame cannot be read, `mcg.odometry` raises the error and names the frame.
    with contextlib.suppress(ValueError, OSError):
        start.append(frames[1].cloud)
    names = frames.name(0), frames.name(1)
    choices = Choices(shared, names, start, target=0)
    name = choices.method_name(method)
    print(f"points:    {choices.voxels}")
    defaults = {"max_distance": DATASETS[dataset].max_distance} if isinstance(dataset, str) else {}
    resolved_method, options = choices.method_and_arguments(name, **defaults)
    options |= {"num_neighbors": shared.num_neighbors, "against": against, "map_radius": map_radius}
    options |= {"recover": recover, "loops": loops, "deskew": deskew, "start": first.pose}
    truth: list[Pose | None] = []
    times: list[Any] = []

    def clouds() -> Iterator[mcg.PointCloud]:
        for frame in frames:
            truth.append(frame.pose)
            times.append(frame.time)
            yield with_channels(frame.cloud, choices.channels)

    steps = mcg.odometry(clouds(), resolved_method, voxel_size=choices.voxels.size, **options)
    poses, results, failure = _follow(steps, frames, loops, map)
    del truth[len(poses) :], times[len(poses) :]
    _report(poses, truth, results)

    if output is not None:
        camera = frames.to_camera if pose_frame == "camera" else None
        written = poses if camera is None else [camera @ pose @ np.linalg.inv(camera) for pose in poses]
        io.write_poses(output, written, None if pose_format == "kitti" else times)
        print(f"poses:     {output}")
    if plot is not None:
        true_poses = [pose for pose in truth if pose is not None]
        plots.trajectories(({"truth": true_poses} if true_poses else {}) | {name: poses}, path=plot)
        print(f"picture:   {plot}")

    if failure:
        print(f"mcgicp: {failure}; stopped after {len(poses)} of {len(frames)} frames", file=sys.stderr)
    if failed := [result.status.name for result in results if not result.converged]:
        statuses = ", ".join(sorted(set(failed)))
        print(f"mcgicp: {len(failed)} of {len(results)} registrations did not converge ({statuses})", file=sys.stderr)
    return 1 if failed or failure else 0


def _open(
    dataset: Frames, path: cli.File, num_frames: NumFrames, every: int, map: cli.File, columns: int | None, deskew: bool
) -> AbstractFrames:
    if num_frames != "all" and num_frames < 2:
        raise ValueError(f"num_frames: expected at least 2, got {num_frames}")
    if path is not None and dataset not in _RECORDED:
        raise ValueError(f"PATH: expected none after {dataset}, got {path}")
    if isinstance(dataset, str) and DATASETS[dataset].simulated:
        simulate: Any = DATASETS[dataset].frames
        if deskew and "spin" in inspect.signature(simulate).parameters:
            simulate = partial(simulate, spin=True)
        return simulate(every * (_FRAMES_OF_A_SCENE if num_frames == "all" else num_frames))[::every]
    if isinstance(dataset, str):
        if path is None:
            raise ValueError(f"{dataset}: expected the folder of a sequence after it, mcgicp odometry {dataset} PATH")
        frames = DATASETS[dataset].frames(path)
    elif dataset.is_dir():
        try:
            frames = cli.clouds_in(dataset, map=map, columns=columns)
        except ValueError as error:
            # Suggest the format of a data set whose files are in the folder.
            for name in _RECORDED:
                try:
                    DATASETS[name].frames(dataset)
                except (ValueError, OSError):
                    continue
                raise ValueError(f"{error}; it is a sequence: mcgicp odometry {name} {dataset}") from error
            raise
    else:
        raise ValueError(f"{dataset}: expected a folder of clouds or one of {cli.enumerated(list(DATASETS), 'or')}")
    frames = frames if every == 1 else frames[::every]
    if len(frames) < 2:
        raise ValueError(f"{path or dataset}: expected at least 2 frames, got {len(frames)}")
    return frames if num_frames == "all" else frames[:num_frames]


def _follow(
    steps: Iterator[OdometryStep], frames: AbstractFrames, loops: bool, map: Path | None
) -> tuple[list[Pose], list[mcg.RegistrationResult], str]:
    """Run the odometry and write the map; return the poses, the registrations, and why it stopped early, or ''."""
    poses: list[Pose] = []
    results: list[mcg.RegistrationResult] = []
    clouds: list[mcg.PointCloud] = []
    world, last, failure, num_lost = None, None, "", 0
    try:
        for step in tqdm(steps, total=len(frames), unit="frame", disable=None):
            # Loops change all poses until the end. Without loops, clouds go into the map at once, to save memory.
            if map is not None and loops:
                clouds.append(step.cloud)
            elif map is not None:
                world = world or VoxelMap(map_voxel_size(step.cloud))
                world.add(f"frame {len(poses)}", step.cloud, step.pose)
            poses.append(step.pose)
            num_lost += step.lost
            if step.registration is not None:
                results.append(step.registration)
            last = step
    except (ValueError, OSError, KeyboardInterrupt) as error:
        # An error of the first frame is raised.
        if not poses:
            raise
        failure = "interrupted" if isinstance(error, KeyboardInterrupt) else f"{frames.name(len(poses))}: {error}"
    if num_lost:
        print(f"lost:      {num_lost} of {len(poses)} frames, to which the motion is not known")
    if loops and last is not None:
        graph: Any = last.graph
        print(f"loops:     {int(np.asarray(graph.edges.uncertain).sum())} closed")
        poses[:] = graph.poses
    if map is not None:
        merged = mcg.merge_clouds(clouds, poses) if world is None else world.cloud()
        io.write(map, merged)
        print(f"map:       {map}, {len(merged):,} points, {merged.voxels}")
    return poses, results, failure


def _report(poses: list[Pose], truth: list[Pose | None], results: list[mcg.RegistrationResult]) -> None:
    if not results:
        print("pairs:     none were registered")
        return
    iterations = np.mean([np.asarray(result.num_iterations) for result in results])
    converged = sum(bool(result.converged) for result in results)
    print(f"pairs:     {converged} of {len(results)} converged, {iterations:.1f} iterations on average")
    rows = [row for row, pose in enumerate(truth) if pose is not None]
    if len(rows) < 2:
        print("errors:    unknown, since there are no true poses")
        return
    estimated, true = [poses[row] for row in rows], [truth[row] for row in rows]
    translation, rotation = metrics.rpe(estimated, true)
    print(f"per pair:  {1e3 * translation.mean():.1f} mm, {np.degrees(rotation.mean()):.3f} deg on average")
    best, first = 1e3 * metrics.ate(estimated, true), 1e3 * metrics.ate(estimated, true, alignment="first")
    print(f"ATE:       {best:.1f} mm rms after the best alignment, {first:.1f} mm aligned at the first pose")
    length = float(np.linalg.norm(np.diff(np.array(true)[:, :3, 3], axis=0), axis=1).sum())
    if not length:
        print("drift:     unknown, since the sensor does not move")
        return
    segments = [segment for segment in metrics.KITTI_LENGTHS if segment < length] or [length / 2]
    percent, degrees = metrics.kitti_errors(estimated, true, lengths=segments, step=1)
    lengths = ", ".join(f"{segment:.3g}" for segment in segments)
    print(f"drift:     {percent:.2f} %, {degrees:.4f} deg/m over segments of {lengths} m")
