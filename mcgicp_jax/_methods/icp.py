"""ICP: point to point, point to plane, plane to plane (GICP), and with matches nearest in position and colour."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mcgicp_jax._clouds.point_cloud import PointCloud, Values
from mcgicp_jax._compute.concrete import AnyArray
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._local_geometry.channel_covariances import plane_covariance
from mcgicp_jax._local_geometry.local_geometry import Geometries, LocalGeometry
from mcgicp_jax._local_geometry.neighborhoods import Neighborhoods
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._methods import base
from mcgicp_jax._methods.multichannel_gicp import MultiChannelGICP


class GICP(base.AbstractGeneralized):
    """Generalized ICP (Segal, Haehnel & Thrun 2009), plane to plane.

    With tight tolerances, poses of LiDAR scans agree with those of small_gicp to 1e-5 m.

    Attributes:
        epsilon: ε, the variance along the normal, relative to the variance of 1 within the surface.
    """

    epsilon: Float[Array, ""]

    def __init__(self, epsilon: ArrayLike = 1e-3):
        """Raises `ValueError` unless ε is positive, and large enough for the precision (1.2e-5 in float32)."""
        self.epsilon = base.epsilon_of(epsilon)

    def covariance(self, around: Neighborhoods, local: LocalGeometry | None) -> Float[Array, "6 n"]:
        if around.given_covariance is not None:
            return around.given_covariance
        return plane_covariance(base.known_geometry(local), self.epsilon.astype(around.own.dtype))


class PointToPoint(base.AbstractOneSided):
    """Plain ICP (Besl & McKay 1992): M = I."""

    def covariance(self, around: Neighborhoods, local: LocalGeometry | None) -> Float[Array, "6 n"]:
        return base.identity(around)


class PointToPlane(base.AbstractOneSided):
    """Point-to-plane ICP (Chen & Medioni 1991): M = n nᵀ with the normals n of the target."""

    def covariance(self, around: Neighborhoods, local: LocalGeometry | None) -> Float[Array, "6 n"]:
        covariance = around.given_covariance
        if covariance is not None:
            return alg.outer(alg.smallest_eigenvector(covariance))
        return alg.outer(base.known_geometry(local).normal.T)


class ColorICP(base.AbstractOneSided):
    """ICP whose matches are nearest in position and channels (Johnson & Kang 1999): M = I.

    Attributes:
        channel_weights: α, scalar or (C,), metres per channel unit.
        missing_variance: scalar or (C,), channel units²: the squared difference that the search assumes for a channel
            if a point of a correspondence lacks it. None: set by `resolve` if points lack channels.
    """

    uses_channels: ClassVar[bool] = True

    channel_weights: Float[Array, "..."]
    missing_variance: Float[Array, "..."] | None

    def __init__(self, channel_weights: Values, missing_variance: Values | None = None):
        """Raises `ValueError` if a weight or variance is negative or not finite, or has the wrong shape."""
        self.channel_weights = base.weights_of(channel_weights)
        if missing_variance is not None:
            missing_variance = base.weights_of(missing_variance, "missing_variance")
        self.missing_variance = missing_variance

    @with_settings_of_package
    def resolve(self, source: PointCloud, target: PointCloud, geometries: Geometries | None = None) -> ColorICP:
        """The method with `missing_variance` set to the Λ that `MultiChannelGICP` chooses, if points lack channels;
        constant to autodiff."""
        if self.missing_variance is not None or (source.channel_valid is None and target.channel_valid is None):
            return self
        variance = MultiChannelGICP(channel_weights=0.0).resolve(source, target, geometries).channel_covariance
        return eqx.tree_at(lambda method: method.missing_variance, self, variance, is_leaf=lambda leaf: leaf is None)

    def covariance(self, around: Neighborhoods, local: LocalGeometry | None) -> Float[Array, "6 n"]:
        return base.identity(around)

    def weights(self, num_channels: int) -> Float[AnyArray, "C"]:
        return base.per_channel("channel_weights", self.channel_weights, num_channels)

    def missing_variances(self, num_channels: int) -> Float[AnyArray, "C"]:
        if self.missing_variance is None:
            raise ValueError("missing_variance: not chosen yet; call method.resolve(source, target) first")
        return base.per_channel("missing_variance", self.missing_variance, num_channels)
