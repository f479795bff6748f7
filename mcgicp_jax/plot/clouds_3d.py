"""Interactive figures in three dimensions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Int

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax.plot.drawing import CLOUD_COLORS, drawable, has_everywhere, optional_module, rgb_of, spacing_of

if TYPE_CHECKING:
    import plotly.graph_objects

# Points drawn in one figure; affects only how it looks.
_MOST_POINTS = 50_000


def clouds(*clouds: PointCloud, names: Sequence[str] | None = None) -> plotly.graph_objects.Figure:
    """Show clouds in one 3-D view, coloured by red, green and blue, else by intensity, else in one colour per cloud.

    If the clouds have more than 50,000 points in total, a reproducible random subset of that size is drawn.

    Args:
        clouds: clouds in a common frame.
        names: one per cloud, for the legend.

    Raises:
        ValueError: if the number of names differs from that of the clouds.
        ImportError: if plotly is missing.
    """
    graphs = optional_module("plotly.graph_objects")
    if names is None:
        names = [f"cloud {i}" for i in range(len(clouds))]
    if len(names) != len(clouds):
        raise ValueError(f"names: expected {len(clouds)}, one per cloud, got {len(names)}")
    fraction = min(1.0, _MOST_POINTS / max(sum(len(cloud) for cloud in clouds), 1))
    figure = _figure(graphs)
    for i, (cloud, name) in enumerate(zip(clouds, names, strict=True)):
        figure.add_trace(_scatter(graphs, cloud, name, CLOUD_COLORS[i % len(CLOUD_COLORS)], fraction))
    return figure


def covariances(
    cloud: PointCloud, covariances: Float[ArrayLike, "N 3 3"], *, indices: Sequence[int] | Int[np.ndarray, "M"]
) -> plotly.graph_objects.Figure:
    """Show covariances of selected points as ellipsoids, as in Fig. 1 of Servos & Waslander (2014).

    The semi-axes are proportional to the standard deviations, with a common scale at which neighbouring ellipsoids
    just do not overlap.

    Args:
        cloud: raw or preprocessed cloud.
        covariances: (N, 3, 3) for the rows of `cloud.points`, dimensionless.
        indices: rows to draw.

    Raises:
        ValueError: if the covariances have the wrong shape, or an index is out of range.
        ImportError: if plotly is missing.
    """
    graphs = optional_module("plotly.graph_objects")
    matrices, rows = np.asarray(covariances, float), np.asarray(indices, int)
    size = cloud.points.shape[0]
    if matrices.shape != (size, 3, 3):
        raise ValueError(f"covariances: expected shape ({size}, 3, 3), got {matrices.shape}")
    if rows.ndim != 1 or rows.size == 0 or rows.min() < 0 or rows.max() >= size:
        raise ValueError(f"indices: expected rows of the cloud, from 0 to {size - 1}, got {indices}")
    centers = cloud.coordinates[rows]
    extent = float(np.ptp(drawable(cloud).points, axis=0).max())
    figure = _figure(graphs)
    figure.add_trace(_scatter(graphs, cloud, "points", "#a0a0a0", min(1.0, _MOST_POINTS / max(len(cloud), 1))))
    figure.add_trace(_ellipsoids(graphs, centers, matrices[rows], spacing_of(centers, extent)))
    return figure


def _figure(graphs: Any) -> plotly.graph_objects.Figure:
    layout = {"scene": {"aspectmode": "data"}, "legend": {"itemsizing": "constant"}, "margin": dict.fromkeys("lrtb", 0)}
    return graphs.Figure(layout=layout)


def _scatter(graphs: Any, cloud: PointCloud, name: str, color: str, fraction: float) -> Any:
    """Draw a reproducible random fraction of the points, in `color` if the cloud has neither colours nor intensity."""
    cloud = drawable(cloud)
    kept = np.random.default_rng(0).permutation(len(cloud))[: round(fraction * len(cloud))]
    rgb = rgb_of(cloud)
    marker: dict[str, Any] = {"size": 1.5, "color": color}
    if rgb is not None:
        marker["color"] = [f"rgb({r},{g},{b})" for r, g, b in np.round(255 * rgb[kept]).astype(int)]
    elif has_everywhere(cloud, ("intensity",)) and len(cloud):
        intensity = np.asarray(cloud.channels)[:, cloud.channel_names.index("intensity")]
        low, high = np.nanpercentile(intensity, [2, 98])
        marker |= {"color": intensity[kept], "colorscale": "Viridis", "cmin": low, "cmax": high}
    x, y, z = np.asarray(cloud.points)[kept].T
    return graphs.Scatter3d(x=x, y=y, z=z, mode="markers", name=name, marker=marker, showlegend=True)


def _ellipsoids(
    graphs: Any, centers: Float[np.ndarray, "M 3"], matrices: Float[np.ndarray, "M 3 3"], room: float
) -> Any:
    """One mesh of all ellipsoids, scaled so that the longest semi-axis has `room` metres."""
    sphere, faces = _sphere()
    values, vectors = np.linalg.eigh(matrices)
    axes = vectors * np.sqrt(np.maximum(values, 0))[:, None, :]
    scale = room / np.sqrt(max(values.max(), np.finfo(float).tiny))
    vertices = centers[:, None] + scale * sphere @ np.swapaxes(axes, 1, 2)
    i, j, k = (faces + len(sphere) * np.arange(len(centers))[:, None, None]).reshape(-1, 3).T
    x, y, z = vertices.reshape(-1, 3).T
    return graphs.Mesh3d(
        x=x, y=y, z=z, i=i, j=j, k=k, name="covariances", color=CLOUD_COLORS[1], opacity=0.7, showlegend=True
    )


def _sphere(rings: int = 8, segments: int = 16) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Vertices and triangles of a mesh of the unit sphere."""
    polar, azimuth = np.meshgrid(
        np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, segments, endpoint=False), indexing="ij"
    )
    vertices = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    ring, segment = np.mgrid[:rings, :segments]
    here, beside = ring * segments + segment, ring * segments + (segment + 1) % segments
    below, across = here + segments, beside + segments
    faces = np.concatenate([np.stack([here, below, beside], -1), np.stack([beside, below, across], -1)])
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)
