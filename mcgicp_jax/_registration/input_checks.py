"""Checks of the clouds, matches and extensions of a registration."""

from __future__ import annotations

from typing import Any

import numpy as np

from mcgicp_jax._clouds.point_cloud import LARGEST, PointCloud, same_channels
from mcgicp_jax._clouds.voxel_size import raw_spacing
from mcgicp_jax._compute.concrete import is_concrete
from mcgicp_jax._compute.linear_maps import primal
from mcgicp_jax._compute.messages import warn
from mcgicp_jax._local_geometry.cloud_statistics import point_spacing, warn_of_units
from mcgicp_jax._math.statistics import median, sampled_rows
from mcgicp_jax._methods.base import AbstractMethod
from mcgicp_jax._methods.icp import GICP
from mcgicp_jax._methods.multichannel_gicp import MultiChannelGICP
from mcgicp_jax._pose_solver.matched import Motion
from mcgicp_jax._registration.loop import LoopResult
from mcgicp_jax._registration.on_host import HostExecutor
from mcgicp_jax._registration.options import check_method
from mcgicp_jax._search.base import Correspondences

# Bounds of the trace of covariances given with one of the clouds, relative to the trace of GICP's (2: they are 1 within
# the surface); beyond them a warning is issued. The trace of cells in m² is a sixth of their squared edge.
_LEAST_TRACE, _LARGEST_TRACE = 0.25, 4.0
# Ratio of the extents of two clouds, and of their spacings, above which both together are warned of: √1000, since units
# usually differ by a factor of 1000, and the clouds may differ otherwise as well. A part of a map has a smaller extent,
# a thinned cloud a larger spacing, but rarely do both differ: by at most 4.3 between scans, their far tenth, every
# eighth point, maps of ten scans, and voxels of all of these, and by 13 between patches of a tenth of the extent with
# all points and voxels of the whole.
_OTHER_LENGTHS = 1000**0.5
# Number of points from which the extent is computed, and the fraction of them (one in so many) that is left out on each
# side of an axis, since a few points may be far away.
_SAMPLE, _OUTSIDE = 300, 20


def check_clouds(source: PointCloud, target: PointCloud, method: AbstractMethod) -> None:
    """Raise `ValueError` unless both are single clouds, of one dtype, with channels that fit the method."""
    check_method(method)
    for name, cloud in (("source", source), ("target", target)):
        if not isinstance(cloud, PointCloud):
            raise ValueError(f"{name}: expected a PointCloud, got {type(cloud).__name__}; is the order right?")
        if cloud.points.ndim != 2:
            raise ValueError(
                f"{name}: expected a single cloud, got shape {cloud.points.shape}; use jax.vmap for a batch"
            )
        if name in method.needs_covariances and cloud.covariances is None:
            raise ValueError(
                f"{name}: expected a cloud with covariances for {type(method).__name__}; make it with "
                "mcgicp_jax.voxel_gaussians, or pass voxel_sizes to register"
            )
    if method.uses_channels:
        check_channels(source, target, method)
        if source.channels.shape[-1] == 0:
            warn(f"the clouds have no channels: {type(method).__name__} uses geometry alone")
    if source.points.dtype != target.points.dtype:
        raise ValueError(
            f"points: expected one precision in both clouds, got {source.points.dtype} in the source and "
            f"{target.points.dtype} in the target; make them alike before preprocess, as by points.astype(np.float32)"
        )


def check_channels(source: PointCloud, target: PointCloud, method: AbstractMethod) -> None:
    if source.channels.shape[-1] != target.channels.shape[-1]:
        raise ValueError(
            f"channels: expected as many in the source as in the target for {type(method).__name__}, "
            f"got {source.channels.shape[-1]} and {target.channels.shape[-1]}"
        )
    if not same_channels(source, target):
        raise ValueError(
            f"source: expected the channels of the target, {target.channel_names}, got {source.channel_names}; "
            "give both the same names in the same order"
        )


def check_matches(
    matches: Correspondences, source: PointCloud, target: PointCloud, method: AbstractMethod, temperature: Any
) -> None:
    """Raise unless there is one match per source row, or several for a method that uses several or a `temperature`, and
    the clouds are as `check_clouds` expects."""
    if not isinstance(matches, Correspondences):
        kind = type(matches).__name__
        raise ValueError(f"matches: expected the result of find_correspondences, got {kind}; is the order right?")
    check_clouds(source, target, method)
    rows = source.points.shape[0]
    if matches.indices.ndim > 2 or matches.indices.shape[-1] != rows:
        raise ValueError(f"matches: expected one per source row ({rows}), got shape {matches.indices.shape}")
    if matches.indices.ndim == 2 and temperature is None and method.num_candidates == 1:
        raise ValueError(f"temperature: expected metres to go with {matches.indices.shape[0]} candidates, got None")
    if temperature is not None and is_concrete(temperature) and not np.asarray(temperature) > 0:
        raise ValueError(f"temperature: expected a positive number of metres, got {temperature!r}")


def warn_of_extensions(method: AbstractMethod, executor: HostExecutor, loop: LoopResult) -> None:
    """Warn where numbers of a method, term or kernel from outside of the package are not finite."""
    for side in ("source", "target"):
        covariance = getattr(executor.problem, side).whole().covariance
        rows = np.flatnonzero(~np.isfinite(covariance).all(axis=1))
        if _is_extension(method) and len(rows):
            warn(
                f"{type(method).__name__}.covariance: expected finite numbers, got NaN or infinity at {len(rows)} of "
                f"{len(covariance)} points of the {side}, first at row {rows[0]}"
            )
            return
    motion = Motion.of(loop.state.pose.wxyz_xyz)
    for term in loop.terms:
        sums = executor.sums(motion, loop.matches, (term,), np.bool_(False))
        extensions = [part for part in (term, term.robust) if _is_extension(part)]
        if extensions and not np.isfinite(sums.table).all():
            warn(
                f"{type(extensions[0]).__name__}: expected finite numbers, got NaN or infinity at the matches after "
                f"{int(loop.state.num_iterations)} updates"
            )


def _is_extension(part: object) -> bool:
    return part is not None and not type(part).__module__.startswith("mcgicp_jax.")


def warn_of_hard_matches(method: AbstractMethod, source: PointCloud, target: PointCloud) -> None:
    """Warn if α or channels are differentiated outside of `jit`, with hard matches, which are constant to autodiff."""
    if _is_differentiated(getattr(method, "channel_weights", None)):
        warn(
            "channel_weights: the derivative is 0, since they decide matches alone, which are constant in derivatives; "
            "leave out soft_matches=False"
        )
    compared = isinstance(method, MultiChannelGICP) and method.photometric
    if method.uses_channels and not compared and _is_differentiated((source.channels, target.channels)):
        warn(
            "channels: they act mostly by the matches, which are constant in derivatives, so that this one is often a "
            "hundred times too small; leave out soft_matches=False"
        )


def warn_of_estimated_parameters(
    method: AbstractMethod, source: PointCloud, target: PointCloud, soft: bool, equalize_channels: bool = False
) -> None:
    """Warn if inputs are differentiated outside `jit` from which parameters, constant to autodiff, are estimated: from
    channels Λ, gains, and α of soft matches (α of hard ones decides the matches alone); from points and channels the
    numbers of the photometric term."""
    channels = source.channels, target.channels
    if isinstance(method, MultiChannelGICP) and method.photometric:
        if _is_differentiated((source.points, target.points, channels)):
            warn(
                "photometric: standard deviations, gains and offsets are estimated from the residuals, but constant in "
                "the derivative by points and channels, which is therefore not that of the result"
            )
        return
    if not (method.uses_channels and _is_differentiated(channels)):
        return
    if equalize_channels:
        warn(
            "equalize_channels: gain and offset are estimated from the channels, but constant in the derivative by "
            "channels, which is therefore not that of the result; equalise the channels before"
        )
    names = ["channel_covariance", "channel_weights"] if soft else ["channel_covariance"]
    unset = [name for name in names if isinstance(method, MultiChannelGICP) and getattr(method, name) is None]
    if unset:
        warn(
            f"{' and '.join(unset)}: estimated from the channels, but constant in the derivative by channels, which is "
            "therefore not that of the result; pass a method resolved beforehand, method.resolve(source, target)"
        )


def _is_differentiated(tree: object) -> bool:
    """Whether arrays are traced by differentiation outside of `jit` and `vmap`."""
    return not is_concrete(tree) and is_concrete(primal(tree))


def warn_of_lengths(source: PointCloud, target: PointCloud) -> None:
    """Warn of clouds outside `jit` whose extents and spacings both differ so much that their units probably differ."""
    clouds = [primal(cloud) for cloud in (source, target)]
    if not is_concrete(clouds) or any(cloud.points.ndim != 2 for cloud in clouds):
        return
    # The largest extent of most of the points along an axis, metres; 0 if there are none.
    extents = []
    for cloud in clouds:
        rows, counts = sampled_rows(cloud.valid)
        points = np.asarray(cloud.points)[rows[counts][:: 1 + rows.size // _SAMPLE]]
        points = points[(np.abs(points) <= LARGEST).all(axis=1)]
        # A tenth of the time of `np.quantile`.
        ordered, outside = np.sort(points, axis=0).astype(np.float64), len(points) // _OUTSIDE
        extents.append(float((ordered[-1 - outside] - ordered[outside]).max()) if len(points) else 0.0)
    if not 0 < min(extents) < max(extents) / _OTHER_LENGTHS:
        return
    # More costly for raw clouds.
    spacings = [
        raw_spacing(cloud) if cloud.deferred_neighbors is None else float(point_spacing(cloud)) for cloud in clouds
    ]
    differ = 0 < min(spacings) < max(spacings) / _OTHER_LENGTHS
    if differ and (extents[0] < extents[1]) == (spacings[0] < spacings[1]):
        warn(
            f"points: the source extends over {extents[0]:.2g} with a spacing of {spacings[0]:.2g}, the target over "
            f"{extents[1]:.2g} with a spacing of {spacings[1]:.2g}; are both in the same unit, metres?"
        )


def warn_of_inputs(source: PointCloud, target: PointCloud, method: AbstractMethod, equalize_channels: bool) -> None:
    """Warn of channels in different units, and with GICP of covariances of one cloud that are not in its unit."""
    for name, cloud, other in (("source", source, target), ("target", target, source)):
        if isinstance(method, GICP) and cloud.covariances is not None and other.covariances is None:
            rows, counts = sampled_rows(cloud.valid)
            trace = float(median(np.trace(np.asarray(cloud.covariances)[rows[counts]], axis1=1, axis2=2)))
            if not _LEAST_TRACE <= trace / 2 <= _LARGEST_TRACE:
                warn(
                    f"{name}: covariances look like m² (median trace {trace:.2g}; GICP's are dimensionless with trace "
                    '2). For voxel cells use NDT or D2DNDT, or voxel_gaussians(..., of="covariances")'
                )
    if method.uses_channels and not equalize_channels:
        check_channels(source, target, method)
        warn_of_units(source, target)
