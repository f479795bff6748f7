"""Matches at a pose, and the search index of a cloud."""

from __future__ import annotations

from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from mcgicp_jax._clouds.origins import centred_pose
from mcgicp_jax._clouds.point_cloud import PointCloud, with_constants
from mcgicp_jax._compute.cache import cached_with_cloud
from mcgicp_jax._compute.concrete import constant, constants_computed, is_concrete, numpy_for
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.messages import check_integer, check_positive
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._math.poses import Pose, rotated, se3_from_matrix
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._methods.surfaces import search_numbers, search_rows, searchable
from mcgicp_jax._pose_solver.matched import Motion, distances_within
from mcgicp_jax._registration.input_checks import check_clouds
from mcgicp_jax._search.base import AbstractIndex, AbstractSearch, Correspondences
from mcgicp_jax._search.default_search import default_search


@with_settings_of_package
@constants_computed
def find_correspondences(
    source: PointCloud,
    target: PointCloud,
    pose: Pose | None,
    method: AbstractMethod,
    *,
    max_distance: ArrayLike,
    num_candidates: int | None = None,
    search: AbstractSearch | None = None,
) -> Correspondences:
    """Find the target point nearest to each moved source point in position and α · channel (Servos & Waslander, IV-A).

    Args:
        source, target: preprocessed clouds.
        pose: T_target_source, `jaxlie.SE3` or (4, 4); None is the identity.
        method: defines α, the channel weights of the search; without α the search is in position alone.
        max_distance: maximum correspondence distance, metres of position; matches beyond it are not `valid`.
        num_candidates: m, number of target points to find for each source point; more than one for the soft assignment
            of `estimate_pose` and `mahalanobis_cost`. None: as many as the method matches, one but for NDT.
        search: nearest-neighbour search; by default `KDTreeSearch`, and inside `jit` or `vmap` on accelerators
            `DenseSearch`.

    Returns:
        One match per source row; for m > 1 arrays of shape (m, N), nearest first. Constant to autodiff.

    Raises:
        ValueError: if `max_distance` is not positive, `num_candidates` is below 1, `pose` is not a rigid motion, or
            channels or dtypes do not fit.
    """
    # Matches are constants to autodiff.
    source, target, pose, method, max_distance = map(primal, (source, target, pose, method, max_distance))
    traced = not is_concrete(source, target, pose, method, max_distance)
    search = search or default_search(traced)
    check_clouds(source, target, method)
    source, target = with_constants(source), with_constants(target)
    method = method.resolve(source, target)
    check_positive("max_distance", max_distance)
    num_candidates = method.num_candidates if num_candidates is None else num_candidates
    check_integer("num_candidates", num_candidates, 1)
    matrix = centred_pose(pose, source, target, "pose")
    matrix, max_distance, method = constant((matrix, max_distance, method))
    nearest: Any
    rows, target_rows = (searchable(method, constant(cloud)) for cloud in (source, target))
    dtype = rows.points.dtype
    start = se3_from_matrix(matrix, dtype).wxyz_xyz
    if not traced:
        gate = float(np.asarray(max_distance))
        nearest = index_of(search, method, target).nearest(np.asarray(start), rows, gate, num_candidates)
        indices = np.maximum(nearest, 0).astype(np.int32)
        matrix = np.asarray(matrix)
        # By NumPy, so that nothing is compiled. Distances beyond float32 are infinite.
        with np.errstate(invalid="ignore", over="ignore"):
            moved: Any = rotated(rows.points.astype(np.float64), matrix[:3, :3]) + matrix[:3, 3]
            distances = np.linalg.norm(target_rows.points[indices] - moved, axis=-1).astype(dtype)
            near = distances <= gate
    else:
        limit = jnp.asarray(max_distance, dtype)
        nearest = search.nearest_traced(jnp.asarray(start), rows, target_rows, limit, jnp.bool_(True), num_candidates)
        indices = jnp.maximum(nearest, 0)
        moved = Motion(jnp.asarray(matrix[:3, :3], dtype), jnp.asarray(matrix[:3, 3], dtype)).move(rows.points)
        targets = jnp.asarray(target_rows.points)[indices]
        within = [distances_within(moved, candidate, limit) for candidate in targets]
        distances, near = map(jnp.stack, zip(*within, strict=True))
    counts = (nearest >= 0) & rows.valid & numpy_for(nearest).asarray(target_rows.valid)[indices]
    matches = Correspondences(indices, distances, counts & near)
    return matches if num_candidates > 1 else jax.tree.map(itemgetter(0), matches)


def index_of(search: AbstractSearch, method: AbstractMethod, target: PointCloud) -> AbstractIndex:
    """Search index of the target, cached with the cloud; methods that search with the same numbers share it."""
    return _index(target, search, *search_numbers(method, target.channels, target.channel_valid))


@cached_with_cloud
def _index(target: PointCloud, search: AbstractSearch, weights: Any, missing_variances: Any) -> AbstractIndex:
    columns = target.points, target.channels, target.channel_valid, target.valid
    return search.index(search_rows(weights, missing_variances, *columns))
