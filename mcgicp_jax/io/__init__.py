"""Reading and writing of point clouds, poses and pose graphs."""

from mcgicp_jax.io.clouds import FORMATS, Format, read, write
from mcgicp_jax.io.poses import read_g2o, read_poses, write_g2o, write_poses

__all__ = ["FORMATS", "Format", "read", "read_g2o", "read_poses", "write", "write_g2o", "write_poses"]
