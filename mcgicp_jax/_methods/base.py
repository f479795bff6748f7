"""The interface of registration methods, and checks of their parameters."""

from __future__ import annotations

import abc
from typing import ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mcgicp_jax._clouds.point_cloud import PointCloud, Values
from mcgicp_jax._compute.concrete import AnyArray, is_concrete, numpy_for
from mcgicp_jax._local_geometry.local_geometry import Geometries, LocalGeometry
from mcgicp_jax._local_geometry.neighborhoods import NO_NEIGHBORS, Neighborhoods
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.robust_kernels import AbstractKernel, Numbers, number_of, positive_scalar
from mcgicp_jax._terms.base import AbstractTerm, Mahalanobis


def per_channel(name: str, numbers: Float[AnyArray, "..."], num_channels: int) -> Float[AnyArray, "C"]:
    if numbers.shape not in ((), (num_channels,)):
        raise ValueError(
            f"{name}: expected a scalar or shape ({num_channels},), for clouds of {num_channels} channels, "
            f"got {numbers.shape}"
        )
    xp = numpy_for(numbers)
    return xp.broadcast_to(xp.asarray(numbers), (num_channels,))


def epsilon_of(value: ArrayLike) -> Float[Array, ""]:
    epsilon = positive_scalar("epsilon", value)
    # For smaller ε, 1 − (1 − ε) loses it to rounding, and the covariance becomes singular.
    least = 100 * float(jnp.finfo(epsilon.dtype).eps)
    if is_concrete(epsilon) and float(epsilon) < least:
        raise ValueError(f"epsilon: expected at least {least:.2g} in {epsilon.dtype}, got {value!r}")
    return epsilon


def weights_of(value: Values, name: str = "channel_weights") -> Float[Array, "..."]:
    weights = number_of(name, value)
    if weights.ndim > 1:
        raise ValueError(f"{name}: expected a scalar or shape (C,), got {weights.shape}")
    if is_concrete(weights) and not np.all((np.asarray(weights) >= 0) & np.isfinite(weights)):
        raise ValueError(f"{name}: expected finite numbers of at least 0, got {value!r}")
    return weights


def covariance_of(value: Values) -> Float[Array, "..."]:
    covariance = number_of("channel_covariance", value)
    if covariance.ndim > 2 or (covariance.ndim == 2 and covariance.shape[0] != covariance.shape[1]):
        raise ValueError(f"channel_covariance: expected a scalar, shape (C,) or (C, C), got {covariance.shape}")
    if is_concrete(covariance):
        matrix = np.asarray(covariance, np.float64)
        matrix = matrix if matrix.ndim == 2 else np.diag(np.atleast_1d(matrix))
        finite = bool(np.isfinite(matrix).all())
        symmetric = finite and np.allclose(matrix, matrix.T, rtol=1e-5, atol=1e-6 * np.abs(matrix).max(initial=0))
        # An empty matrix (no channels) is positive definite; NaN is not.
        if not (symmetric and np.all(np.linalg.eigvalsh(matrix) > 0)):
            raise ValueError(f"channel_covariance: expected it symmetric and positive definite, got {value!r}")
    return covariance


class AbstractMethod(Numbers):
    """A registration method. Its parameters are arrays, so that gradients can be taken with respect to them.

    A subclass defines the covariance of a point, and the information matrix of a correspondence given those of its two
    points. Parameters that are None are chosen from the data by `resolve`.
    """

    uses_channels: ClassVar[bool] = False
    # Whether `covariance` needs the individual neighbours, beyond their local geometry.
    uses_neighborhoods: ClassVar[bool] = False
    # Number of target points matched with each source point, whose cost is the sum over them.
    num_candidates: ClassVar[int] = 1
    # Which of "source" and "target" must be clouds of `voxel_gaussians`.
    needs_covariances: ClassVar[tuple[str, ...]] = ()

    @abc.abstractmethod
    def covariance(self, around: Neighborhoods, local: LocalGeometry | None) -> Float[Array, "6 n"]:
        """A symmetric 3×3 matrix for each of n points: the input of `information`.

        Args:
            around: the points, and the covariances given with the cloud, if any; with neighbours only if the method
                `uses_neighborhoods`.
            local: their local geometry; None for a cloud that was not preprocessed.

        Raises:
            ValueError: if neighbours or a parameter that the method needs are missing.
        """

    @abc.abstractmethod
    def information(
        self, target: Float[Array, "6 N"], source: Float[Array, "6 N"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        """M of each correspondence: the information matrix of its residual b − T a, in the target's frame.

        Args:
            target, source: matrices from `covariance` of the matched points, each in the frame of its own cloud.
            rotation: of T_target_source.
        """

    def terms(
        self, source: PointCloud, target: PointCloud, robust: AbstractKernel | None, equalize_channels: bool
    ) -> tuple[AbstractTerm, ...]:
        """The residuals of each correspondence, by default the Mahalanobis distance alone.

        Args:
            source, target: preprocessed clouds; of the source, as for `resolve`, perhaps only the points used.
            robust: kernel given by the user; None: the kernel of the method, if it has any.
            equalize_channels: option of `register`; a term may estimate gains and offsets of the channels itself.
        """
        return (Mahalanobis(self, robust=robust),)

    def resolve(self, source: PointCloud, target: PointCloud, geometries: Geometries | None = None) -> AbstractMethod:
        """The method with every unset parameter chosen from two preprocessed clouds; constants to autodiff.

        Args:
            source: if `max_source_points` is smaller, only the points used, without neighbours.
            geometries: computes the local geometry of some rows of both clouds; given by callers that need it too.

        Raises:
            ValueError: if a parameter is unset and a cloud was not preprocessed.
        """
        return self

    def weights(self, num_channels: int) -> Float[AnyArray, "C"] | None:
        """α of each channel, metres per channel unit; None if the method searches in position alone."""
        return None

    def missing_variances(self, num_channels: int) -> Float[AnyArray, "C"]:
        """Expected squared difference of each channel in a true match, channel units²: the penalty for a missing one.

        A subclass that defines `weights` defines this too.
        """
        raise NotImplementedError(f"{type(self).__name__} defines weights, but not missing_variances")


Method = TypeVar("Method", bound=AbstractMethod)


def with_unset_from(method: Method, resolved: Method) -> Method:
    return jax.tree.map(
        lambda value, other: other if value is None else value, method, resolved, is_leaf=lambda leaf: leaf is None
    )


class AbstractOneSided(AbstractMethod):
    """Methods whose information matrix M depends on the target alone."""

    def information(
        self, target: Float[Array, "6 N"], source: Float[Array, "6 N"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        return target


class AbstractGeneralized(AbstractMethod):
    """Methods that use the covariances of both points of a correspondence: M = (C^B + R C^A Rᵀ)⁻¹."""

    def information(
        self, target: Float[Array, "6 N"], source: Float[Array, "6 N"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        return alg.inverse(target + alg.rotate(rotation, source))


def identity(around: Neighborhoods) -> Float[Array, "6 n"]:
    identity = jnp.array([[1.0], [0.0], [0.0], [1.0], [0.0], [1.0]], around.own.dtype)
    return jnp.broadcast_to(identity, (6, around.own.shape[1]))


def known_geometry(local: LocalGeometry | None) -> LocalGeometry:
    if local is None:
        raise ValueError(NO_NEIGHBORS)
    return local
