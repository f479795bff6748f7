"""Multi-Channel Generalized ICP in JAX: registration of point clouds with channels (intensity, colour, any numbers).

`T_target_source` maps source coordinates into the target's frame. Units are metres and radians throughout.
"""

from mcgicp_jax import datasets, io, metrics, plot
from mcgicp_jax._batch import PairWarning, register_as_completed, register_batch
from mcgicp_jax._channel_covariance import estimate_channel_covariance
from mcgicp_jax._cloud import PointCloud
from mcgicp_jax._cost import mahalanobis_cost
from mcgicp_jax._dense import DenseSearch
from mcgicp_jax._gaussians import cell_moments, gaussians, voxel_cells
from mcgicp_jax._global import GlobalPose
from mcgicp_jax._graph import PoseGraphResult, optimize_poses
from mcgicp_jax._image_matches import image_matches
from mcgicp_jax._kernels import AbstractKernel, Cauchy, GemanMcClure, Huber, Tukey, Welsch
from mcgicp_jax._map import aggregate
from mcgicp_jax._methods import GICP, AbstractMethod, ColorICP, MultiChannelGICP, PointToPlane, PointToPoint
from mcgicp_jax._multiway import Multiway, multiway
from mcgicp_jax._ndt import D2DNDT, NDT, ColorNDT
from mcgicp_jax._odometry import odometry
from mcgicp_jax._pose_graph import WORLD, Edge, PoseGraph
from mcgicp_jax._preprocess import preprocess
from mcgicp_jax._register import align, find_correspondences, global_pose, register
from mcgicp_jax._result import Registration, Status
from mcgicp_jax._search import AbstractSearch, Correspondences
from mcgicp_jax._spaces import rgb_to_hsv, rgb_to_lab, rgb_to_yuv
from mcgicp_jax._trees import AbstractTreeSearch, KDTreeSearch

__all__ = [
    "D2DNDT",
    "GICP",
    "NDT",
    "WORLD",
    "AbstractKernel",
    "AbstractMethod",
    "AbstractSearch",
    "AbstractTreeSearch",
    "Cauchy",
    "ColorICP",
    "ColorNDT",
    "Correspondences",
    "DenseSearch",
    "Edge",
    "GemanMcClure",
    "GlobalPose",
    "Huber",
    "KDTreeSearch",
    "MultiChannelGICP",
    "Multiway",
    "PairWarning",
    "PointCloud",
    "PointToPlane",
    "PointToPoint",
    "PoseGraph",
    "PoseGraphResult",
    "Registration",
    "Status",
    "Tukey",
    "Welsch",
    "aggregate",
    "align",
    "cell_moments",
    "datasets",
    "estimate_channel_covariance",
    "find_correspondences",
    "gaussians",
    "global_pose",
    "image_matches",
    "io",
    "mahalanobis_cost",
    "metrics",
    "multiway",
    "odometry",
    "optimize_poses",
    "plot",
    "preprocess",
    "register",
    "register_as_completed",
    "register_batch",
    "rgb_to_hsv",
    "rgb_to_lab",
    "rgb_to_yuv",
    "voxel_cells",
]
__version__ = "0.1.0"
