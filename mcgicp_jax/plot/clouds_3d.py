"""Interactive figures in three dimensions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax.plot.drawing import drawable, has_everywhere, optional_module, rgb_of

if TYPE_CHECKING:
    import plotly.graph_objects

# These constants affect only how figures look: points drawn in one figure, and colours of clouds without channels.
_MOST_POINTS = 50_000
_COLORS = ("#1f77d0", "#e8741c", "#2b9c5a", "#b03a8c", "#7a5230", "#707070")


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
    layout = {"scene": {"aspectmode": "data"}, "legend": {"itemsizing": "constant"}, "margin": dict.fromkeys("lrtb", 0)}
    figure = graphs.Figure(layout=layout)
    for i, (cloud, name) in enumerate(zip(clouds, names, strict=True)):
        figure.add_trace(_scatter(graphs, cloud, name, _COLORS[i % len(_COLORS)], fraction))
    return figure


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
