"""Multi-Channel Generalized ICP in JAX: registration of point clouds with channels (intensity, colour, any numbers).

`T_target_source` maps source coordinates into the target's frame. Units are metres and radians throughout.

JAX keeps compiled programs for other processes if the environment has `JAX_COMPILATION_CACHE_DIR=folder` and
`JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0`. The command line does so by itself. Once compilation has taken two
seconds in a process, the logger "mcgicp_jax" has a record of the level INFO.

Clouds
    PointCloud                      points (N, 3) with channels (N, C)
    deskew                          undo the motion of the sensor during a scan
    preprocess                      average in voxels, find neighbours
    merge_clouds                    one map of many clouds
    voxel_gaussians                 a cloud of the means and covariances of its cells
    rgb_to_hsv, rgb_to_lab, rgb_to_yuv
                                    channels in another colour space
    io, datasets                    files; public data sets, folders and simulated scenes

Pairs
    register                        the pose that moves a source onto a target
    register_batch                  the poses of many pairs, in a list
    register_as_completed           the same, as they are computed
    global_pose                     a pose from any start, by local features
    image_matches                   tie points from images
    find_correspondences            matches at a given pose
    estimate_pose                   the pose of given matches
    mahalanobis_cost                the cost of given matches, for losses

Methods
    MultiChannelGICP, GICP, PointToPlane, PointToPoint, ColorICP
                                    for points
    NDT, D2DNDT, ColorNDT           for cells of raw clouds
    estimate_channel_covariance     their parameter Λ from clouds at known poses
    Huber, Cauchy, GemanMcClure, Tukey, Welsch
                                    robust kernels
    KDTreeSearch, DenseSearch       searches, on CPUs and on accelerators

Sequences and graphs
    odometry                        frame to frame or to a map, with loops
    multiway                        one pose for each of many clouds
    Edge, PoseGraph, WORLD          measured motions between poses
    optimize_poses                  the poses of a graph

Results
    RegistrationResult, Status      of a pair: pose, status, covariance
    GlobalPoseResult, OdometryStep, MultiwayResult, PoseGraphResult
                                    of the functions above
    UnconstrainedDirection          a motion that the clouds leave open
    Correspondences                 matches
    PairWarning                     why a pair of a batch is invalid, or its pose doubtful
    metrics, plot                   errors of poses; pictures

To read
    guide                           phases, derivatives and priors explained

To extend (see mcgicp_jax.extend)
    AbstractMethod, AbstractKernel, AbstractSearch, AbstractTreeSearch
"""

from mcgicp_jax import datasets, guide, io, metrics, plot
from mcgicp_jax._clouds.color_spaces import rgb_to_hsv, rgb_to_lab, rgb_to_yuv
from mcgicp_jax._clouds.deskew import deskew
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._clouds.preprocess import preprocess
from mcgicp_jax._clouds.voxel_map import merge_clouds
from mcgicp_jax._global_pose.features import image_matches
from mcgicp_jax._global_pose.global_pose import GlobalPoseResult, global_pose
from mcgicp_jax._math.robust_kernels import AbstractKernel, Cauchy, GemanMcClure, Huber, Tukey, Welsch
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._methods.icp import GICP, ColorICP, PointToPlane, PointToPoint
from mcgicp_jax._methods.multichannel_gicp import MultiChannelGICP, estimate_channel_covariance
from mcgicp_jax._methods.ndt import D2DNDT, NDT, ColorNDT, voxel_gaussians
from mcgicp_jax._pairs.batch import register_as_completed, register_batch
from mcgicp_jax._pairs.batch_jobs import PairWarning
from mcgicp_jax._pairs.given_matches import estimate_pose, mahalanobis_cost
from mcgicp_jax._pairs.register import register
from mcgicp_jax._pose_graph.edge import WORLD, Edge
from mcgicp_jax._pose_graph.graph import PoseGraph
from mcgicp_jax._pose_graph.optimize import PoseGraphResult, optimize_poses
from mcgicp_jax._pose_solver.degeneracy import UnconstrainedDirection
from mcgicp_jax._registration.correspondences import find_correspondences
from mcgicp_jax._registration.result import RegistrationResult, Status
from mcgicp_jax._search.base import AbstractSearch, Correspondences
from mcgicp_jax._search.brute_force import DenseSearch
from mcgicp_jax._search.kd_tree import AbstractTreeSearch, KDTreeSearch
from mcgicp_jax._sequences.multiway import MultiwayResult, multiway
from mcgicp_jax._sequences.odometry import OdometryStep, odometry

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
    "GlobalPoseResult",
    "Huber",
    "KDTreeSearch",
    "MultiChannelGICP",
    "MultiwayResult",
    "OdometryStep",
    "PairWarning",
    "PointCloud",
    "PointToPlane",
    "PointToPoint",
    "PoseGraph",
    "PoseGraphResult",
    "RegistrationResult",
    "Status",
    "Tukey",
    "UnconstrainedDirection",
    "Welsch",
    "datasets",
    "deskew",
    "estimate_channel_covariance",
    "estimate_pose",
    "find_correspondences",
    "global_pose",
    "guide",
    "image_matches",
    "io",
    "mahalanobis_cost",
    "merge_clouds",
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
    "voxel_gaussians",
]
__version__ = "0.7.1"
