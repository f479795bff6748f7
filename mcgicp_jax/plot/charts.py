"""Charts of trajectories and pose graphs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from mcgicp_jax._math.poses import Pose, checked_pose_matrix
from mcgicp_jax._pose_graph.edge import WORLD
from mcgicp_jax._pose_graph.optimize import PoseGraphResult
from mcgicp_jax.plot.drawing import Figure, File, by_name, new_figure, plotting, saved

# Residual at the end of the colour scale of a graph, standard deviations: loops beyond it are rejected.
_LARGEST_RESIDUAL = 4.1


def trajectories(
    trajectories: Mapping[str, Sequence[Pose] | Float[np.ndarray, "N 4 4"]], *, path: File = None
) -> Figure:
    """Plot trajectories in the principal plane of the first one.

    Args:
        trajectories: poses by name, sensor to a common world, metres.
        path: file to save the figure to; its suffix selects the format.

    Raises:
        ValueError: if a trajectory is empty, or a pose is no rigid motion.
        ImportError: if matplotlib is missing.
    """
    figure, panel = _chart()
    plane, start = None, None
    for name, poses in by_name("trajectories", trajectories, '{"odometry": poses}').items():
        positions = np.array(
            [checked_pose_matrix(pose, f"trajectories[{name!r}][{i}]")[:3, 3] for i, pose in enumerate(poses)]
        )
        if not len(positions):
            raise ValueError(f"trajectories[{name!r}]: expected at least one pose, got none")
        if plane is None or start is None:
            start = positions[0]
            plane = np.linalg.svd(positions - positions.mean(axis=0))[2][:2]
            # The first axis points in the direction of travel.
            plane[0] *= 1 if (positions[-1] - start) @ plane[0] >= 0 else -1
        along, across = plane @ (positions - start).T
        panel.plot(along, across, marker=".", markersize=4, linewidth=1, label=name)
    panel.legend()
    return saved(figure, path)


def graph(graph: PoseGraphResult, *, path: File = None) -> Figure:
    """Plot the poses of a graph in their principal plane, and its edges coloured by residual in standard deviations.

    Rejected loops are dashed. A prior is drawn from the position that it measured.

    Args:
        graph: result of `optimize_poses`, such as `MultiwayResult.graph`.
        path: file to save the figure to; its suffix selects the format.

    Raises:
        ImportError: if matplotlib is missing.
    """
    collections = plotting("matplotlib.collections")
    positions = np.asarray(graph.poses)[:, :3, 3]
    centre = positions.mean(axis=0)
    # The eigenvectors of the two largest eigenvalues, which come last.
    axes = np.linalg.eigh((positions - centre).T @ (positions - centre))[1][:, :0:-1]
    accepted, residuals, i = np.asarray(graph.kept), np.asarray(graph.residuals), np.asarray(graph.edges.i)
    priors = i == WORLD
    measured = np.asarray(graph.edges.T_i_j)[:, :3, 3]
    starts = np.where(priors[:, None], measured, positions[np.where(priors, 0, i)])
    segments = (np.stack([starts, positions[np.asarray(graph.edges.j)]], axis=1) - centre) @ axes
    figure, panel = _chart()
    for edges, style in ((accepted, "solid"), (~accepted, "dashed")):
        lines = collections.LineCollection(segments[edges], linestyles=style, linewidths=1, cmap="viridis")
        lines.set_array(residuals[edges])
        lines.set_clim(0, _LARGEST_RESIDUAL)
        panel.add_collection(lines)
        if style == "solid":
            figure.colorbar(lines, ax=panel, label="residual, standard deviations", extend="max")
    panel.plot(*((positions - centre) @ axes).T, marker=".", markersize=4, linestyle="none", color="black")
    return saved(figure, path)


def _chart() -> tuple[Figure, Any]:
    figure = new_figure(7, 5)
    panel = figure.subplots()
    panel.set(xlabel="metres", ylabel="metres", aspect="equal", adjustable="datalim")
    panel.grid(alpha=0.3)
    return figure, panel
