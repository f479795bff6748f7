"""Figures of clouds and registrations: 2-D with matplotlib, interactive 3-D with plotly, both imported on demand.

Every function returns its figure; none opens a window or changes matplotlib's global state.
"""

from mcgicp_jax.plot.charts import graph, trajectories
from mcgicp_jax.plot.drawing import check_picture
from mcgicp_jax.plot.pictures import before_after, clouds, maps, surface_covariances

__all__ = ["before_after", "check_picture", "clouds", "graph", "maps", "surface_covariances", "trajectories"]
