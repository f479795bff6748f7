"""The surface around each point as a registration sees it."""

from __future__ import annotations

from typing import Any, NamedTuple

from jaxtyping import Float

from mcgicp_jax._compute.concrete import AnyArray
from mcgicp_jax._search.base import SearchPoints


class SurfaceNoise(NamedTuple):
    """What is used at the final pose alone, for its status and covariance; one row per point.

    Attributes:
        descriptors: variance of the descriptors α · channel about their linear fits, metres², summed over the channels.
        normal: unit normal.
        roughness: half the squared height difference along the normal between a point and a neighbour, metres².
        reach: distance to the farthest neighbour, metres.
        slopes: gradients of the descriptors; None where channels are not used, and for cells.
    """

    descriptors: Float[AnyArray, "*batch N"]
    normal: Float[AnyArray, "*batch N 3"]
    roughness: Float[AnyArray, "*batch N"]
    reach: Float[AnyArray, "*batch N"]
    slopes: Float[AnyArray, "*batch N C 3"] | None = None


class Surface(NamedTuple):
    """The points of a cloud with the values that one method needs of each; one row per point.

    Rows come first, so that those of matched points can be gathered; formulas work on the transposes. Symmetric 3×3
    matrices are stored as upper triangles.

    Attributes:
        points: positions, metres.
        covariance: result of `AbstractMethod.covariance`.
        observability: by the shape of the surface, see `_local_geometry.observability`; None if not needed.
        channel_observability: by the channels; None if not needed, or if the method does not use channels.
        columns: `AbstractTerm.columns` by name of the term, for terms that define them.
        noise: for the covariance of the pose; None if not needed.
        search: the points as input to the search; None for matched rows where it is not needed.
    """

    points: Float[AnyArray, "*batch N 3"]
    covariance: Float[AnyArray, "*batch N 6"]
    observability: Float[AnyArray, "*batch N 6"] | None
    channel_observability: Float[AnyArray, "*batch N 6"] | None
    columns: dict[str, Any]
    noise: SurfaceNoise | None = None
    search: SearchPoints | None = None

    @property
    def num_points(self) -> int:
        return self.points.shape[-2]

    @property
    def observed(self) -> bool:
        return self.observability is not None

    @property
    def observes_channels(self) -> bool:
        return self.channel_observability is not None


def searched(surface: Surface) -> SearchPoints:
    """The input of the search of a surface of a whole cloud."""
    if surface.search is None:
        raise ValueError("surface: expected one with the input of the search")
    return surface.search
