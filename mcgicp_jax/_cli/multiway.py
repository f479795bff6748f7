"""`mcgicp multiway FOLDER`: register all clouds of a folder with each other and make one map of them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

import mcgicp_jax as mcg
from mcgicp_jax import io
from mcgicp_jax import plot as plots
from mcgicp_jax._cli import options as cli
from mcgicp_jax._cli.choices import Choices


@cli.with_names
def multiway(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    *,
    shared: cli.Options,
    method: cli.Method = None,
    glob: str = "*",
    init: cli.File = None,
    output: cli.File = None,
    map: cli.File = None,
    graph: cli.File = None,
    plot: cli.File = None,
) -> int:
    """Register the clouds of a folder with each other and find one pose for each.

    Clouds that overlap are registered in pairs; a pose graph weighs the results by their covariances and rejects pairs
    that contradict the others. The exit code is 0 only if one pose was found for each cloud.

    Args:
        folder: Folder of clouds of one scene; in order of name, each should overlap the one before it. Files that are
            no clouds are left out.
        method: {channel_methods} use channels (intensity, colours, ...), the others geometry alone.
        glob: Pattern for the files of the folder, such as "*.ply".
        init: File with a pose to start from for each cloud: 12 numbers (KITTI) or 8 (TUM) on each line.
        output: File for the poses, cloud to world, in KITTI format.
        map: File for the map in the frame of the first cloud, such as map.ply.
        graph: File for the poses and the pairs that were kept, in g2o format.
        plot: File for a picture of poses and pairs in their principal plane, such as graph.png.
    """
    cli.check_outputs(output, graph, cloud=map, picture=plot)
    shared.check(method)
    paths = cli.clouds_in(folder, glob, map).paths
    raw = [io.read(path, columns=shared.columns) for path in paths]
    names = [path.name for path in paths]
    choices = Choices(shared, names, raw, target=0)
    others = zip(names[2:], raw[2:], strict=True)
    clouds = [*choices.preprocessed, *(choices.preprocess(name, cloud) for name, cloud in others)]
    print(f"clouds:    {len(clouds)}, {len(raw[0]):,} points in the first, {len(clouds[0]):,} used ({choices.voxels})")
    name = choices.method_name(method)
    initial_poses = None if init is None else list(io.read_poses(init))
    resolved_method, arguments = choices.method_and_arguments(name)
    result = mcg.multiway(clouds, resolved_method, init=initial_poses, voxel_size=choices.voxels.size, **arguments)

    edges, rejected = result.graph.edges, int((~np.asarray(result.graph.kept)).sum())
    print(f"pairs:     {len(result.registrations)} registered, {len(edges)} with a result, {rejected} of them rejected")
    fit = f"{result.graph.chi_squared:.3g} per redundant number (1: as the covariances predict)"
    print(f"chi²:      {fit if np.isfinite(result.graph.chi_squared) else 'unknown, since no number is redundant'}")
    deviations = np.sqrt(np.diagonal(np.asarray(result.graph.covariance), 0, 1, 2))
    millimetres, degrees = 1e3 * deviations[:, :3].max(), np.degrees(deviations[:, 3:].max())
    uncertainty = "some of them unknown"
    if np.isfinite(millimetres) and np.isfinite(degrees):
        uncertainty = f"at most {millimetres:.1f} mm and {degrees:.3f} deg uncertain"
    print(f"poses:     {result.graph.status.name}, {uncertainty}")

    if output is not None:
        io.write_poses(output, result.poses)
        print(f"poses:     {output}")
    if map is not None:
        io.write(map, result.map)
        print(f"map:       {map}, {len(result.map):,} points")
    if graph is not None:
        io.write_g2o(graph, result.graph)
        print(f"graph:     {graph}")
    if plot is not None:
        plots.graph(result.graph, path=plot)
        print(f"picture:   {plot}")

    if not result.graph.converged:
        status = result.graph.status
        why = ": no pair constrains some directions of motion" if status == mcg.Status.DEGENERATE else ""
        print(f"mcgicp: the poses are {status.name}{why}", file=sys.stderr)
    for i, (path, status) in enumerate(zip(paths, result.statuses, strict=True)):
        if status == mcg.Status.CONVERGED:
            continue
        why = f"{status.name}, its pose contradicts the others or is not known"
        statuses = {registration.status.name for pair, registration in result.registrations.items() if i in pair}
        if status == mcg.Status.TOO_FEW_CORRESPONDENCES and statuses:
            why = f"no registration holds its pose ({', '.join(sorted(statuses))})"
        print(f"mcgicp: {path}: {why}", file=sys.stderr)
    return 0 if result.converged else 1
