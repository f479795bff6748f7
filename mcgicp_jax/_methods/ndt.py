"""Normal-distributions transforms: registration to voxel Gaussians, and of voxel Gaussians to each other."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mcgicp_jax._clouds.point_cloud import PointCloud, Values
from mcgicp_jax._clouds.preprocess import finite_rows, with_neighbors
from mcgicp_jax._compute.concrete import AnyScalar, numpy_for
from mcgicp_jax._local_geometry.observability import geometry_observability
from mcgicp_jax._local_geometry.records import Local, Neighborhoods, local_of
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.robust_kernels import AbstractKernel, Welsch
from mcgicp_jax._math.statistics import median, sampled_rows
from mcgicp_jax._methods.base import GICP, AbstractGeneralized, AbstractMethod, AbstractOneSided, ColorICP, identity
from mcgicp_jax._methods.voxel_gaussians import gaussians

# Scale k of the kernel, standard deviations. The usual score is −exp(−d₂ s²/2), so that k² = 2/d₂. Magnusson's formula
# for d₂ (2009) depends on the unit of length; with the usual 55 % of outliers and cells of 1 m it gives k = 2.15. For
# cells against cells Stoyanov et al. (2012) use d₂ = 0.05, k = 6.3; in a sum over several cells, far ones then pull too
# strongly: the error on KITTI with cells of 1 m is 14 mm with 2.15, 15 with 3, 18 with 4 and 28 with 6.3.
_SCALE = 2.15
# Number of the target's cells that a cell is matched with. The voxels of the two clouds are not aligned, and the pose
# follows the nearest cells of the other grid: on KITTI with cells of 1 m, the error is 60 mm with one, 14 with 4 and 14
# with 7. For points against cells, a sum over seven changes nothing (16 mm with one, 4 or 7), and with cells of one
# colour it costs accuracy (10.7 mm with one and 18.8 with 7 on a flat table).
_NUM_CANDIDATES = 4
# Edge of the voxels, per edge of a cell, at all scales but the last, where GICP registers the clouds. At these scales
# cells against cells pull clouds that overlap in part over each other: from 1.3 m and 10° off, two views of a yard with
# an overlap of three quarters ended 4 m off, and end at 0 m by GICP. On KITTI, from 5 m and 30° off, GICP leads to 7
# of 8 poses, cells to 4.
_COARSE_VOXEL = 0.25
# Square of the edge of a cell over the trace of its covariance, if it is a square filled uniformly: 2 edge²/12.
_SQUARE_EDGE = 6.0
# Number of points that the normal of a cell is taken to be estimated from: that of a neighbourhood.
_COUNT = 20


class AbstractNDT(AbstractMethod):
    """Methods for clouds of `gaussians`, whose covariances are in m².

    Attributes:
        kernel: robust kernel, its scale in standard deviations, if `register` is not given another one.
    """

    matches_slide: ClassVar[bool] = False

    kernel: AbstractKernel | None

    def covariance(
        self,
        points: Float[Array, "3 n"],
        around: Neighborhoods | None,
        local: Local | None,
        given: Float[Array, "6 n"] | None,
    ) -> Float[Array, "6 n"]:
        """The covariances given; those of points are not used."""
        return identity(points) if given is None else given

    def spacing(self, target: PointCloud) -> Float[AnyScalar, ""]:
        """The median edge of the cells. (Where a plane lies between two layers of voxels, cells lie close together.)"""
        if target.covariances is None:
            return super().spacing(target)
        xp = numpy_for(target)
        rows, counts = sampled_rows(xp.asarray(target.valid))
        traces = xp.trace(xp.asarray(target.covariances)[rows], axis1=1, axis2=2)
        return median(xp.where(counts, xp.sqrt(_SQUARE_EDGE * traces), xp.nan))

    def default_kernel(self) -> AbstractKernel | None:
        return self.kernel

    def described(self, local: Local, given: Float[Array, "6 n"] | None) -> Local:
        """The surface in a cell from its own covariance: its neighbours are other cells."""
        if given is None:
            return local
        given = jax.lax.stop_gradient(given)
        normal = alg.smallest_eigenvector(given)
        basis = alg.orthonormal_basis(normal)
        across = alg.inner(normal, alg.multiply(given, normal))
        count = jnp.full_like(across, _COUNT)
        reach = 0.5 * jnp.sqrt(self.num_candidates * _SQUARE_EDGE * (given[0] + given[3] + given[5]))
        geometry = geometry_observability(given, normal, basis, count)
        return local_of(given, normal, geometry, across, reach, local.fits)

    def stages(
        self, source: PointCloud, target: PointCloud, scales: Sequence[float]
    ) -> Iterator[tuple[AbstractMethod, PointCloud, PointCloud]]:
        """One registration per scale, the last one to cells of this size, the others by `GICP` in smaller voxels."""
        if not scales:
            yield self, source, target
        for i, size in enumerate(scales):
            last = i == len(scales) - 1
            sides = [
                self._in_cells(name, cloud, size) if last else _in_voxels(name, cloud, _COARSE_VOXEL * size)
                for name, cloud in (("source", source), ("target", target))
            ]
            yield self if last else GICP(), sides[0], sides[1]

    def _in_cells(self, name: str, cloud: PointCloud, size: float) -> PointCloud:
        if name not in self.needs_covariances:
            return cloud
        with _named(name):
            return gaussians(cloud, size, channel_size=self._channel_size(cloud, size))

    def _channel_size(self, cloud: PointCloud, voxel_size: float) -> Any:
        return None


def _in_voxels(name: str, cloud: PointCloud, size: float) -> PointCloud:
    with _named(name):
        return with_neighbors(finite_rows(cloud), size, _COUNT)


@contextlib.contextmanager
def _named(name: str) -> Iterator[None]:
    """Begin messages of errors with the name of the cloud."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


class NDT(AbstractNDT, AbstractOneSided):
    """Normal-distributions transform (Biber & Strasser 2003; Magnusson 2009): points against cells, M = C⁻¹.

    C is the covariance of the target's cell, from `gaussians`. Each point is matched to the nearest cell: the sum over
    several cells takes longer and is no more accurate. With `scales`, all registrations but the last are by `GICP`.

    Args:
        scale: k of the Welsch kernel, in standard deviations, if `register` is not given another kernel; None: none.
    """

    needs_covariances: ClassVar[tuple[str, ...]] = ("target",)

    def __init__(self, scale: ArrayLike | None = _SCALE):
        """Raises `ValueError` unless `scale` is positive."""
        self.kernel = _welsch(scale)

    def information(
        self, target: Float[Array, "6 N"], source: Float[Array, "6 N"], rotation: Float[Array, "3 3"]
    ) -> Float[Array, "6 N"]:
        return alg.inverse(target)


class ColorNDT(NDT, ColorICP):
    """NDT whose matches are nearest in position and channels, as the colour NDT of Huhle & Magnusson (2008).

    For cells of one colour each: `gaussians` with `channel_size`. With `scales`, a cell extends as far in
    α · channel as in position.

    Args:
        channel_weights: α, scalar or (C,), metres per channel unit.
        scale: as of `NDT`.
    """

    def __init__(self, channel_weights: Values, scale: ArrayLike | None = _SCALE):
        """Raises `ValueError` if a weight is negative or not finite or of the wrong shape, or `scale` not positive."""
        ColorICP.__init__(self, channel_weights)
        self.kernel = _welsch(scale)

    def _channel_size(self, cloud: PointCloud, voxel_size: float) -> Any:
        with np.errstate(divide="ignore"):
            return voxel_size / np.asarray(self.weights(cloud.channels.shape[1]), np.float64)


class D2DNDT(AbstractNDT, AbstractGeneralized):
    """Distribution-to-distribution NDT (Stoyanov et al. 2012): cells against cells, M = (C^B + R C^A Rᵀ)⁻¹.

    The cost of a cell is the sum over the nearest cells of the target, each with its own weight.

    Args:
        scale: k of the Welsch kernel, in standard deviations, if `register` is not given another kernel; None: none.
        num_candidates: number of cells of the target that are matched with each cell of the source.
    """

    needs_covariances: ClassVar[tuple[str, ...]] = ("source", "target")
    num_candidates: int = eqx.field(static=True)  # type: ignore[misc]

    def __init__(self, scale: ArrayLike | None = _SCALE, num_candidates: int = _NUM_CANDIDATES):
        """Raises `ValueError` unless `scale` is positive and `num_candidates` at least 1."""
        if num_candidates < 1:
            raise ValueError(f"num_candidates: expected at least 1, got {num_candidates}")
        self.kernel = _welsch(scale)
        self.num_candidates = num_candidates


def _welsch(scale: Any) -> Welsch | None:
    return None if scale is None else Welsch(scale)
