"""Normal-distributions transforms: registration to voxel Gaussians, and of voxel Gaussians to each other."""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from mcgicp_jax._clouds.point_cloud import PointCloud, Values
from mcgicp_jax._compute.messages import check_integer
from mcgicp_jax._local_geometry.local_geometry import LocalGeometry
from mcgicp_jax._local_geometry.neighborhoods import Neighborhoods
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.robust_kernels import AbstractKernel, Welsch
from mcgicp_jax._methods.base import AbstractGeneralized, AbstractMethod, AbstractOneSided, identity
from mcgicp_jax._methods.icp import ColorICP
from mcgicp_jax._terms.base import AbstractTerm, Mahalanobis

# Scale k of the kernel, standard deviations. The usual score is −exp(−d₂ s²/2), so that k² = 2/d₂. Magnusson's formula
# for d₂ (2009) depends on the unit of length; with the usual 55 % of outliers and cells of 1 m it gives k = 2.15. For
# cells against cells Stoyanov et al. (2012) use d₂ = 0.05, k = 6.3; in a sum over several cells, distant ones then have
# too much weight: the error on KITTI with cells of 1 m is 14 mm with 2.15, 15 with 3, 18 with 4 and 28 with 6.3.
_SCALE = 2.15
# Number of the target's cells that a cell is matched with. The voxels of the two clouds are not aligned, and the pose
# follows the nearest cells of the other grid: on KITTI with cells of 1 m, the error is 60 mm with one, 14 with 4 and 14
# with 7. For points against cells, a sum over seven changes nothing (16 mm with one, 4 or 7), and with cells of one
# colour it costs accuracy (10.7 mm with one and 18.8 with 7 on a flat table).
_NUM_CANDIDATES = 4


class AbstractNDT(AbstractMethod):
    """Methods for clouds of `voxel_gaussians`, whose covariances are in m².

    Attributes:
        kernel: robust kernel, its scale in standard deviations, if `register` is not given another one.
    """

    kernel: AbstractKernel | None

    def covariance(self, around: Neighborhoods, local: LocalGeometry | None) -> Float[Array, "6 n"]:
        """The covariances given with the cloud."""
        given = around.given_covariance
        return identity(around) if given is None else given

    def terms(
        self, source: PointCloud, target: PointCloud, robust: AbstractKernel | None, equalize_channels: bool
    ) -> tuple[AbstractTerm, ...]:
        return (Mahalanobis(self, robust=self.kernel if robust is None else robust),)


class NDT(AbstractNDT, AbstractOneSided):
    """Normal-distributions transform (Biber & Strasser 2003; Magnusson 2009): points against cells, M = C⁻¹.

    C is the covariance of the target's cell, from `voxel_gaussians`. Each point is matched to the nearest cell: the sum
    over several cells takes longer and is no more accurate. With `voxel_sizes`, all registrations but the last are by
    `GICP`.

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

    For cells of one colour each: `voxel_gaussians` with `channel_size`. With `voxel_sizes`, a cell extends as far in
    α · channel as in position.

    Args:
        channel_weights: α, scalar or (C,), metres per channel unit.
        scale: as of `NDT`.
    """

    def __init__(self, channel_weights: Values, scale: ArrayLike | None = _SCALE):
        """Raises `ValueError` if a weight is negative or not finite or of the wrong shape, or `scale` not positive."""
        ColorICP.__init__(self, channel_weights)
        self.kernel = _welsch(scale)


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
        check_integer("num_candidates", num_candidates, 1)
        self.kernel = _welsch(scale)
        self.num_candidates = num_candidates


def _welsch(scale: Any) -> Welsch | None:
    return None if scale is None else Welsch(scale)
