"""Numerical settings of the registration loop: from the options, and by default from the target."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._clouds.coordinate_steps import harmful_steps
from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, constant, numpy_for
from mcgicp_jax._local_geometry.cloud_statistics import grid_spacing, point_spacing
from mcgicp_jax._local_geometry.local_geometry import cell_edge
from mcgicp_jax._math.statistics import median, sampled_rows
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._registration.options import ROTATION_TOLERANCE, Options

# Statuses while the loop runs. COARSE: the coarse phase, with every `coarse_stride`-th source point and the larger
# maximum correspondence distance. RUNNING: the fine phase, with all points and the smaller distance. SETTLED: the last
# update was below the tolerances; the sums at its pose remain to be computed.
COARSE, RUNNING, SETTLED = -3, -1, -2
# Default maximum correspondence distances of the coarse and the fine phase, in spacings of the target. With the larger
# one, initial poses several spacings off converge, but matches across edges and the border of the overlap bias the
# final pose; the smaller one rejects these. The coarse phase also considers the spacing between scan lines: with the
# spacing along the lines alone, raw scans of KITTI, 1.3 m apart, stayed at the identity.
_COARSE_SPACINGS, _FINE_SPACINGS = 10.0, 2.5
# Default translation tolerance, in spacings of the target: 0.5 mm at 0.1 m, chosen like `ROTATION_TOLERANCE`.
_TOLERANCE_IN_SPACINGS = 0.005
# Tolerances of the coarse phase, as a multiple of the tolerances or of their defaults, whichever is larger. With
# smaller ones, the small cycles of nearest-neighbour matching would keep the coarse phase from ending.
_COARSE_TOLERANCE = 10.0
# Distance from the sensor, in median distances of the source's points, within which they may be the sensor's own
# vehicle. A vehicle of 0.8 × 0.6 × 0.6 m extends to 0.17 in a corridor, and a pole 1 m from the sensor is at 0.22. Of
# KITTI 1.7 % of the voxels are nearer, of 7-Scenes and tables none: what constrains rooms and streets is further away.
_NEAR = 0.2


class Settings(NamedTuple):
    """Numerical settings of the loop, as arrays, so that changing one does not recompile.

    Attributes:
        max_distance, fine_distance: maximum correspondence distances, metres; the fine one is not larger.
        translation_tolerance, rotation_tolerance: an update below both is the last; metres and radians.
        coarse_translation_tolerance, coarse_rotation_tolerance: an update below both ends the coarse phase.
        max_iterations: maximum number of updates, both phases together.
        channels_may_move: whether the channels may move with the sensor, so that a pose that they hold is UNVERIFIED.
        rounding: variances of the coordinates of source and target, metres², that are rounded to coarse steps.
        near: source points within this distance of the sensor, metres, constrain no direction of motion.
    """

    max_distance: Float[AnyArray, "*batch"]
    fine_distance: Float[AnyArray, "*batch"]
    coarse_stride: Int[AnyArray, "*batch"]
    translation_tolerance: Float[AnyArray, "*batch"]
    rotation_tolerance: Float[AnyArray, "*batch"]
    coarse_translation_tolerance: Float[AnyArray, "*batch"]
    coarse_rotation_tolerance: Float[AnyArray, "*batch"]
    max_iterations: Int[AnyArray, "*batch"]
    hold_unconstrained: Bool[AnyArray, "*batch"]
    channels_may_move: Bool[AnyArray, "*batch"]
    rounding: Float[AnyArray, "*batch 2 3"]
    near: Float[AnyArray, "*batch"]

    def stride(self, status: Int[AnyScalar, ""], num_iterations: Int[AnyScalar, ""]) -> Int[AnyScalar, ""]:
        """Stride of the source points at this status. Once `max_iterations` are done, all points are measured."""
        return either((status == COARSE) & (num_iterations < self.max_iterations), self.coarse_stride, np.int32(1))


def either(condition: Bool[AnyScalar, ""], one: AnyScalar, other: Any) -> Any:
    """`where` for numbers; on the host without a call of NumPy, which would take longer than the rest."""
    return (one if condition else other) if isinstance(condition, np.bool_) else jnp.where(condition, one, other)


def spacing_of(method: AbstractMethod, target: PointCloud) -> Any:
    """The spacing of the target, metres: of its points, or the edge of its cells."""
    cells = method.needs_covariances and target.covariances is not None
    return cell_edge(target) if cells else point_spacing(target)


def default_distances(spacing: Any, target: PointCloud) -> tuple[Any, Any]:
    """Default `max_distance` of the coarse and the fine phase, metres, for a target with this spacing."""
    # Cells have the spacing of their grid.
    between = spacing if target.covariances is not None else constant(grid_spacing(target))
    return _COARSE_SPACINGS * numpy_for(spacing, between).maximum(spacing, between), _FINE_SPACINGS * spacing


def settings_for(
    options: Options, method: AbstractMethod, source: PointCloud, target: PointCloud, stride: Any, may_move: Any
) -> Settings:
    # Settings are constants to autodiff, even if they are derived from a differentiated cloud.
    spacing = constant(spacing_of(method, target))
    max_distance: Any = default_distances(spacing, target) if options.max_distance is None else options.max_distance
    least = spacing * _TOLERANCE_IN_SPACINGS
    tolerance: Any = least if options.translation_tolerance is None else options.translation_tolerance
    steps = [harmful_steps(constant(cloud), spacing) for cloud in (source, target)]
    fixed, dtype = constant(source), source.points.dtype
    rows, counts = sampled_rows(fixed.valid)
    coarse, fine = max_distance if isinstance(max_distance, tuple) or np.shape(max_distance) else [max_distance] * 2
    limits, turn = (options.min_coarse_distance, options.max_coarse_distance), options.rotation_tolerance
    # Squares of huge coordinates and of their steps overflow.
    with np.errstate(over="ignore"):
        xp: Any = numpy_for(fixed, counts)
        near = _NEAR * median(xp.where(counts, xp.linalg.norm(xp.asarray(fixed.points)[rows], axis=1), np.nan))
        others = options.hold_unconstrained, may_move, stride
        xp = numpy_for(coarse, fine, limits, tolerance, least, turn, others, steps, near)
        # An error that is uniform over a step. It does not average out: points on lattices match the lattice.
        rounding = xp.stack(steps) ** 2 / 12
    return Settings(
        max_distance=xp.asarray(xp.maximum(xp.clip(coarse, *limits), fine), dtype),
        fine_distance=xp.asarray(fine, dtype),
        coarse_stride=xp.asarray(stride, np.int32),
        translation_tolerance=xp.asarray(tolerance, dtype),
        rotation_tolerance=xp.asarray(turn, dtype),
        coarse_translation_tolerance=xp.asarray(_COARSE_TOLERANCE * xp.maximum(tolerance, least), dtype),
        coarse_rotation_tolerance=xp.asarray(_COARSE_TOLERANCE * xp.maximum(turn, ROTATION_TOLERANCE), dtype),
        max_iterations=xp.asarray(options.max_iterations, np.int32),
        hold_unconstrained=xp.asarray(options.hold_unconstrained, bool),
        channels_may_move=xp.asarray(may_move, bool),
        rounding=xp.asarray(rounding, dtype),
        near=xp.asarray(near, dtype),
    )
