"""Deskewing: points of a scan that a moving sensor measured one after the other, as if it had measured them at once."""

from __future__ import annotations

import jax
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from mcgicp_jax._clouds.point_cloud import PointCloud, as_cloud
from mcgicp_jax._clouds.rays_without_return import measured_rows
from mcgicp_jax._compute.cache import cached_with_cloud
from mcgicp_jax._compute.concrete import is_concrete, numpy_for
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.row_functions import Input, Rows, blockwise
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._math.poses import Pose, checked_pose_matrix, logarithm, se3_from_matrix

# Odometry deskews a scan up to three times.
_measured_rows = cached_with_cloud(measured_rows)


@with_settings_of_package
def deskew(cloud: PointCloud, motion: Pose) -> PointCloud:
    """Move the points of a scan to where the sensor would have measured them at the end of the scan.

    The sensor is taken to move with constant velocity: a point of the time s, from 0 to 1, moves by exp((s − 1) ξ),
    ξ = log(motion). Differentiable by the motion, the points and the times, outside of `jit` and inside. Outside of it,
    rows that sensors report for rays without return stay where they are, so that `preprocess` finds them.

    Args:
        cloud: a raw scan with `times`, in the frame of the sensor.
        motion: pose of the sensor at the end of the scan in its frame at the start, `jaxlie.SE3` or (4, 4), metres. In
            a sequence of scans without gaps, the motion between two frames.

    Returns:
        The cloud at the end of the scan, without `times`.

    Raises:
        ValueError: if the cloud has no times, or a concrete pose is no rigid motion.
    """
    cloud = as_cloud("cloud", cloud)
    if cloud.times is None:
        raise ValueError(
            "cloud: expected times of its points, PointCloud(points, times=...), got none; preprocess keeps none"
        )
    matrix, dtype = checked_pose_matrix(motion, "motion"), jax.dtypes.canonicalize_dtype(cloud.points.dtype)
    twist = logarithm(np.asarray(matrix)).astype(dtype) if is_concrete(matrix) else se3_from_matrix(matrix, dtype).log()
    points = (cloud.points + cloud.origin).astype(dtype)
    (shifts,) = blockwise(_shift, twist, Input(points), Input(cloud.times.astype(dtype)[:, None]))
    values, xp = primal(cloud), numpy_for(cloud.points, shifts)
    if is_concrete(values):
        # `measured_rows` counts the first of many zeros as a measurement.
        moving = _measured_rows(values) & np.any(values.points, axis=1)
        shifts = xp.where(moving[:, None], shifts, 0)
    return cloud.replace_rows(points=xp.asarray(cloud.points) + shifts, times=None)


def _shift(twist: Float[Array, "6"], points: Rows, times: Rows) -> tuple[Float[Array, "n 3"]]:
    shift = jax.vmap(lambda point, time: jaxlie.SE3.exp((time - 1) * twist) @ point - point)
    return (shift(points.tree, times.tree),)
