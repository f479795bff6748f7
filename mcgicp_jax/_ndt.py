"""Normal-distributions transforms: registration to voxel Gaussians, and of voxel Gaussians to each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mcgicp_jax import _algebra as alg
from mcgicp_jax._cloud import PointCloud, Values
from mcgicp_jax._gaussians import gaussians
from mcgicp_jax._kernels import AbstractKernel, Welsch
from mcgicp_jax._methods import AbstractGeneralized, AbstractMethod, AbstractOneSided, ColorICP, identity
from mcgicp_jax._observability import geometry_observability
from mcgicp_jax._pose import AnyScalar
from mcgicp_jax._preprocess import preprocess
from mcgicp_jax._statistics import median, namespace, sampled_rows
from mcgicp_jax._surface import Local, Neighborhoods, local_of

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
# All scales but the last: `min_ratio`, scale of the kernel and number of candidates. Rounder cells, a wide kernel and
# many candidates find poses from further off: on KITTI, from 5 m and 30°, D2D-NDT finds 10 of 12 with these values, 4
# with 4 candidates, 7 with 4 and a scale of 30, 8 without a kernel and with one; NDT finds 9, 7 with a scale of 6.3,
# and 8 without a kernel. From 4 m and 20°, without a kernel, 10 converge with a ratio of 0.1 and 4 with 0.01.
_COARSE_RATIO, _COARSE_SCALE, _COARSE_CANDIDATES = 0.1, 15.0, 7
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
        xp = namespace(target)
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
        """One registration per scale, at which cells are made: all but the last of rounder cells, by `D2DNDT`."""
        if not scales:
            yield self, source, target
        for i, voxel_size in enumerate(scales):
            last = i == len(scales) - 1
            method = self if last else D2DNDT(_COARSE_SCALE, _COARSE_CANDIDATES)
            options: dict[str, Any] = {} if last else {"min_ratio": _COARSE_RATIO}
            coarse, coarse_target = (
                method._at_scale(name, cloud, voxel_size, options)
                for name, cloud in (("source", source), ("target", target))
            )
            yield method, coarse, coarse_target

    def _at_scale(self, name: str, cloud: PointCloud, voxel_size: float, options: dict[str, Any]) -> PointCloud:
        try:
            if name in self.needs_covariances:
                return gaussians(cloud, voxel_size, channel_size=self._channel_size(cloud, voxel_size), **options)
            # At a coarse scale, the mean points of the voxels suffice.
            return preprocess(cloud, voxel_size) if options else cloud
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error

    def _channel_size(self, cloud: PointCloud, voxel_size: float) -> Any:
        return None


class NDT(AbstractNDT, AbstractOneSided):
    """Normal-distributions transform (Biber & Strasser 2003; Magnusson 2009): points against cells, M = C⁻¹.

    C is the covariance of the target's cell, from `gaussians`. Each point is matched to the nearest cell: the sum over
    several cells takes longer and is no more accurate. With `scales`, all registrations but the last are of cells
    against cells, as by `D2DNDT`.

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
