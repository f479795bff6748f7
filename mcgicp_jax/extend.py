"""Base classes and registries for those who add a method, a term, a search, a kernel, a format, a data set,
a factor or a loss.

Each is one class or function:

- a method: a subclass of `AbstractMethod`, or of `AbstractOneSided` or `AbstractGeneralized`, which define M;
- a term, a further residual of each correspondence: a subclass of `AbstractTerm`, or of `AbstractAdaptiveTerm` if it
  estimates numbers from the residuals; listed in `AbstractMethod.terms`;
- a search on the host: a subclass of `AbstractTreeSearch` with `build` and `query`; any other: of `AbstractSearch`;
- a robust kernel: a subclass of `AbstractKernel` with `_rho` and `_weight`;
- a file format: two functions in a `mcgicp_jax.io.Format`, registered by the suffix;
- a data set: a subclass of `mcgicp_jax.datasets.AbstractFrames` with `_frame`, in a `mcgicp_jax.datasets.Dataset`;
- a factor of a pose graph: a subclass of `AbstractFactor`;
- a loss over points or matches: a function of `Rows` of `Input`s, applied by `blockwise`, which has its derivative.

`voxel_cells` and `cell_moments` are the parts of `mcgicp_jax.voxel_gaussians`; `cell_moments` is differentiable.

The command line offers the entries that the registries `METHODS` (each a `RegisteredMethod`), `KERNELS`, `FORMATS`,
`DATASETS` and `COLOR_SPACES` have when `mcgicp_jax.__main__` is imported.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from mcgicp_jax._clouds.color_spaces import COLOR_SPACES
from mcgicp_jax._compute.row_functions import Input, Rows, blockwise
from mcgicp_jax._local_geometry.local_geometry import LocalGeometry, Surface
from mcgicp_jax._local_geometry.neighborhoods import Neighborhoods
from mcgicp_jax._math import symmetric_matrices
from mcgicp_jax._math.robust_kernels import KERNELS, AbstractKernel
from mcgicp_jax._methods.base import AbstractGeneralized, AbstractMethod, AbstractOneSided
from mcgicp_jax._methods.icp import GICP, ColorICP, PointToPlane, PointToPoint
from mcgicp_jax._methods.multichannel_gicp import MultiChannelGICP
from mcgicp_jax._methods.ndt import D2DNDT, NDT, ColorNDT, cell_moments, voxel_cells
from mcgicp_jax._pose_graph.edge import AbstractFactor
from mcgicp_jax._search.base import AbstractIndex, AbstractSearch, Correspondences, SearchPoints
from mcgicp_jax._search.kd_tree import AbstractTreeSearch
from mcgicp_jax._terms.base import (
    AbstractAdaptiveTerm,
    AbstractTerm,
    Linearization,
    Mahalanobis,
    PosedMatches,
    linearize_residual,
)
from mcgicp_jax.datasets import DATASETS
from mcgicp_jax.io.clouds import FORMATS

__all__ = [
    "COLOR_SPACES",
    "DATASETS",
    "FORMATS",
    "KERNELS",
    "METHODS",
    "AbstractAdaptiveTerm",
    "AbstractFactor",
    "AbstractGeneralized",
    "AbstractIndex",
    "AbstractKernel",
    "AbstractMethod",
    "AbstractOneSided",
    "AbstractSearch",
    "AbstractTerm",
    "AbstractTreeSearch",
    "Correspondences",
    "Input",
    "Linearization",
    "LocalGeometry",
    "Mahalanobis",
    "Neighborhoods",
    "PosedMatches",
    "RegisteredMethod",
    "Rows",
    "SearchPoints",
    "Surface",
    "blockwise",
    "cell_moments",
    "linearize_residual",
    "symmetric_matrices",
    "voxel_cells",
]


@dataclass(frozen=True)
class RegisteredMethod:
    """A class of methods, and the arguments of its constructor that select the method of this name."""

    kind: type[AbstractMethod]
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, **parameters: Any) -> AbstractMethod:
        return self.kind(**self.arguments, **parameters)


METHODS = {
    "mc-gicp": RegisteredMethod(MultiChannelGICP),
    "photometric-gicp": RegisteredMethod(MultiChannelGICP, {"photometric": True}),
    "gicp": RegisteredMethod(GICP),
    "color-icp": RegisteredMethod(ColorICP),
    "point-to-plane": RegisteredMethod(PointToPlane),
    "point-to-point": RegisteredMethod(PointToPoint),
    "ndt": RegisteredMethod(NDT),
    "color-ndt": RegisteredMethod(ColorNDT),
    "d2d-ndt": RegisteredMethod(D2DNDT),
}
