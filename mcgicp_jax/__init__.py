"""Multi-channel generalized ICP in JAX: registration of point clouds that carry channels.

Frames: `T_target_source` maps source coordinates into the target's frame. Metres and radians throughout.
"""

from mcgicp_jax import datasets as datasets
from mcgicp_jax import io as io
from mcgicp_jax import metrics as metrics
from mcgicp_jax import plot as plot
from mcgicp_jax._batch import PairWarning as PairWarning
from mcgicp_jax._batch import register_as_completed as register_as_completed
from mcgicp_jax._batch import register_batch as register_batch
from mcgicp_jax._channel_covariance import estimate_channel_covariance as estimate_channel_covariance
from mcgicp_jax._cloud import PointCloud as PointCloud
from mcgicp_jax._cost import mahalanobis_cost as mahalanobis_cost
from mcgicp_jax._dense import DenseSearch as DenseSearch
from mcgicp_jax._kernels import AbstractKernel as AbstractKernel
from mcgicp_jax._kernels import Cauchy as Cauchy
from mcgicp_jax._kernels import GemanMcClure as GemanMcClure
from mcgicp_jax._kernels import Huber as Huber
from mcgicp_jax._kernels import Tukey as Tukey
from mcgicp_jax._methods import GICP as GICP
from mcgicp_jax._methods import AbstractMethod as AbstractMethod
from mcgicp_jax._methods import ColorICP as ColorICP
from mcgicp_jax._methods import MultiChannelGICP as MultiChannelGICP
from mcgicp_jax._methods import PointToPlane as PointToPlane
from mcgicp_jax._methods import PointToPoint as PointToPoint
from mcgicp_jax._odometry import aggregate as aggregate
from mcgicp_jax._odometry import odometry as odometry
from mcgicp_jax._preprocess import preprocess as preprocess
from mcgicp_jax._register import align as align
from mcgicp_jax._register import find_correspondences as find_correspondences
from mcgicp_jax._register import register as register
from mcgicp_jax._result import Registration as Registration
from mcgicp_jax._result import Status as Status
from mcgicp_jax._search import AbstractSearch as AbstractSearch
from mcgicp_jax._search import Correspondences as Correspondences
from mcgicp_jax._trees import AbstractTreeSearch as AbstractTreeSearch
from mcgicp_jax._trees import KDTreeSearch as KDTreeSearch

__version__ = "0.1.0"
