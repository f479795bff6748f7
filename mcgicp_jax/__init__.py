"""Multi-channel generalized ICP in JAX."""

from mcgicp_jax._cloud import PointCloud as PointCloud

__version__ = "0.1.0"
