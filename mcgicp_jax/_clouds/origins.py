"""Poses between coordinates relative to the origins of two clouds, and between the user's coordinates."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._compute.linear_maps import AbstractLinearMap, primal, with_derivative
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._math.poses import Pose, checked_pose_matrix, matrices_of, rotation_from_quaternion, turn_by_quaternion


def are_zero(*origins: Array | np.ndarray) -> bool:
    """Whether origins are zero, which a tracer may not be."""
    # Operations on JAX's arrays are traced inside `jit`, those of a cloud that another `jit` returned among them.
    return is_concrete(origins) and not any(map(np.any, map(np.asarray, origins)))


@with_settings_of_package
def centred_pose(pose: Pose | None, source: PointCloud, target: PointCloud, name: str = "init") -> Array | np.ndarray:
    """T(−o_t) · T · T(o_s), (4, 4): the pose between centred coordinates, in its own precision; `name`: for errors."""
    distance = 0.0
    if is_concrete(source.origin, source.points) and not are_zero(source.origin):
        radius = float(np.abs(np.asarray(source.points)).max(initial=0))
        distance = float(np.linalg.norm(source.origin)) / radius if radius > 0 else 0.0
    if isinstance(pose, jaxlie.SE3) and not is_concrete(pose):
        # Outside of `jit` this compiles nothing.
        pose = pose_in_user_frame(pose, np.zeros(3), np.zeros(3))
    matrix = checked_pose_matrix(pose, name, distance)
    if are_zero(source.origin, target.origin):
        return matrix
    # In this form two far origins cancel exactly before either is rotated.
    shifted = (matrix[:3, :3] - np.eye(3)) @ source.origin + (source.origin - target.origin) + matrix[:3, 3]
    if isinstance(shifted, np.ndarray) and isinstance(matrix, np.ndarray):
        matrix = matrix.copy()
        matrix[:3, 3] = shifted
        return matrix
    return jnp.asarray(matrix).at[:3, 3].set(shifted)


@with_settings_of_package
def pose_in_user_frame(
    centred: jaxlie.SE3, source_origin: Array | np.ndarray, target_origin: Array | np.ndarray
) -> Array | np.ndarray:
    """T(o_t) · T · T(−o_s) as (4, 4), with translations T(o) by the origins; float64 NumPy for concrete arrays."""
    values = primal((centred.wxyz_xyz, source_origin, target_origin))
    if not is_concrete(values):
        return _in_user_frame(centred, source_origin, target_origin)
    # Origins returned by `jit` are float32 (exactly so); the arithmetic with them must be float64.
    parameters, start, end = (np.asarray(value, np.float64) for value in values)
    rotation = rotation_from_quaternion(parameters[..., :4])
    matrix = matrices_of(parameters)
    matrix[..., :3, 3] += end - start - np.einsum("...ij,...j->...i", rotation - np.eye(3), start)
    inputs = [centred.wxyz_xyz, source_origin, target_origin]
    if is_concrete(inputs):
        return matrix
    derivative = _InUserFrame(parameters, rotation, start)
    (traced,) = with_derivative([matrix.astype(centred.wxyz_xyz.dtype)], derivative, inputs)
    return traced


class _InUserFrame(AbstractLinearMap):
    """Derivative of `pose_in_user_frame` by `wxyz_xyz`, source origin (`start`) and target origin; compiles nothing."""

    def __init__(self, parameters: np.ndarray, rotation: np.ndarray, start: np.ndarray):
        turn = turn_by_quaternion(parameters[..., :4])
        by_pose, by_source, by_target = (np.zeros((*parameters.shape[:-1], 4, 4, n)) for n in (7, 3, 3))
        turned = np.cross(turn[..., :, None, :], rotation[..., None], axisa=-3, axisb=-3, axisc=-3)
        by_pose[..., :3, :3, :4] = turned
        by_pose[..., :3, 3, :4] = -np.einsum("...ijp,...j->...ip", turned, start)
        by_pose[..., :3, 3, 4:] = by_target[..., :3, 3, :] = np.eye(3)
        by_source[..., :3, 3, :] = -rotation
        self._slopes = by_pose, by_source, by_target

    def jvp(self, tangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        inputs = zip(moving, tangents, strict=True)
        return [sum(np.einsum("...ijp,m...p->m...ij", self._slopes[i], tangent) for i, tangent in inputs)]

    def vjp(self, cotangents: Sequence[np.ndarray], moving: tuple[int, ...]) -> list[np.ndarray]:
        return [np.einsum("...ijp,m...ij->m...p", self._slopes[i], cotangents[0]) for i in moving]


@jax.jit
def _in_user_frame(centred: jaxlie.SE3, source_origin: Array, target_origin: Array) -> Array:
    traced = centred.as_matrix().astype(centred.wxyz_xyz.dtype)
    turned = jnp.einsum("...ij,...j->...i", traced[..., :3, :3] - jnp.eye(3), source_origin, precision="highest")
    shift = target_origin - source_origin - turned
    return traced.at[..., :3, 3].add(shift.astype(traced.dtype))
