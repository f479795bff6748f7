"""Statistics of the data that methods are adapted to: channel noise, point spacing, and gain and offset of channels.

They are computed with NumPy for concrete clouds and with JAX for traced ones.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.cache import cached_with
from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, constant, is_concrete, numpy_for
from mcgicp_jax._local_geometry.covariances import check_neighbors
from mcgicp_jax._local_geometry.records import Local
from mcgicp_jax._math.statistics import median, of_known, sampled_rows
from mcgicp_jax._search.base import Correspondences

# Quantiles (5 to 95 %) from which gain and offset are estimated: robust against parts that only one cloud sees.
_QUANTILES = tuple(step / 20 for step in range(1, 20))
# Ratio of the ranges of a channel in two clouds above which its units probably differ: files hold intensities from 0 to
# 1, 255 or 65,535, whereas exposures differ by less.
_OTHER_UNIT = 10.0


def channel_noise(
    source: PointCloud, target: PointCloud, locals: tuple[Local, Local]
) -> tuple[Float[AnyArray, "C"], Bool[AnyArray, "C"], Float[AnyScalar, ""]]:
    """Noise σ per channel, which channels are uniform (σ = 1), and the variance λ₀ along the normal, metres².

    Both are medians over both clouds: σ of the residuals of linear fits, λ₀ of the variances of the neighbours.
    """
    xp = numpy_for(source, target, locals)
    residuals, values, across = [], [], []
    for cloud, local in zip((source, target), locals, strict=True):
        valid = xp.asarray(cloud.valid)
        # Where points lack channels, a sample might contain too few that have one.
        rows, counts = (xp.arange(valid.size), valid) if cloud.channel_valid is not None else sampled_rows(valid)
        variances = [local.fit(channel)[2][rows] for channel in range(local.num_channels)]
        deviations = xp.sqrt(xp.stack(variances)) if variances else xp.zeros((0, rows.size), local.shape.dtype)
        residuals.append(xp.where(counts, deviations, xp.nan))
        values.append(_known_values(cloud))
        across.append(xp.where(counts, _smallest_variance(local, xp)[rows], xp.nan))
    sigma = median(xp.concatenate(residuals, axis=1))
    everything = xp.concatenate(values)
    spread = of_known(partial(xp.nanstd, axis=0), everything)
    largest = of_known(partial(xp.nanmax, axis=0), xp.abs(everything))
    uniform = ~(spread > 1e3 * xp.finfo(spread.dtype).eps * largest)
    # Rendered channels have no noise; a floor of a thousandth of their standard deviation keeps α finite and Λ regular.
    return xp.where(uniform, 1, xp.fmax(sigma, 1e-3 * spread)), uniform, median(xp.concatenate(across))


def warn_of_units(source: PointCloud, target: PointCloud) -> None:
    """Warn of channels of two concrete clouds whose values are so different that their units probably are, too."""
    ranges = [cached_with(cloud, "ranges", None, partial(_ranges, cloud)) for cloud in (source, target)]
    for name, (low, high), (first, last) in zip(source.channel_names, *ranges, strict=False):
        narrow, wide = sorted([high - low, last - first])
        if high < first or last < low or wide > _OTHER_UNIT * narrow > 0:
            warnings.warn(
                f"channel {name}: most values lie between {low:.3g} and {high:.3g} in the source, but between "
                f"{first:.3g} and {last:.3g} in the target; if their units differ, scale one, or use match_channels",
                UserWarning,
                stacklevel=4,
            )


def _ranges(cloud: PointCloud) -> list[tuple[float, float]]:
    """For each channel, the values between which most of a sample lie (5 to 95 %); NaN if no point has it."""
    rows, counts = sampled_rows(np.asarray(cloud.valid))
    rows = rows[counts]
    channels, known = np.asarray(cloud.channels)[rows], np.isfinite(np.asarray(cloud.channels)[rows])
    if cloud.channel_valid is not None:
        known &= np.asarray(cloud.channel_valid)[rows]
    ranges = []
    for values in (column[there] for column, there in zip(channels.T, known.T, strict=True)):
        low, high = np.quantile(values, [_QUANTILES[0], _QUANTILES[-1]]) if values.size else (np.nan, np.nan)
        ranges.append((float(low), float(high)))
    return ranges


def _smallest_variance(local: Local, xp: Any) -> Float[AnyArray, "N"]:
    """λ₀ = nᵀ C n, the variance of the neighbours along the normal, metres²."""
    xx, xy, xz, yy, yz, zz = local.covariance
    x, y, z = local.normal
    with np.errstate(over="ignore", invalid="ignore"):
        return xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)


def _known_values(cloud: PointCloud) -> Float[AnyArray, "N C"]:
    """Channels, NaN where a point lacks them or is padding."""
    xp = numpy_for(cloud)
    valid = xp.asarray(cloud.valid)[:, None]
    if cloud.channel_valid is not None:
        valid = valid & xp.asarray(cloud.channel_valid)
    return xp.where(valid, xp.asarray(cloud.channels), xp.nan)


def point_spacing(cloud: PointCloud) -> Float[AnyScalar, ""]:
    """Median nearest-neighbour distance, metres, ignoring coincident neighbours; 0 if all neighbours coincide.

    Some files hold points twice, and some scanners report each beam without an echo as a point at the origin.
    """
    return _spacings(cloud)[0]


def grid_spacing(cloud: PointCloud) -> Float[AnyScalar, ""]:
    """Spacing of a square grid with the density of the points, metres: √(π/k) times the median distance of the k-th
    neighbour.

    Where points lie on scan lines, it is larger than `point_spacing`, which is the spacing along the lines.
    """
    return _spacings(cloud)[1]


def _spacings(cloud: PointCloud) -> tuple[Float[AnyScalar, ""], Float[AnyScalar, ""]]:
    """`point_spacing` and `grid_spacing`; cached with a concrete cloud."""
    if is_concrete(cloud):
        return cached_with(cloud, "spacings", None, lambda: _measured_spacings(cloud))
    return _measured_spacings(cloud)


def _measured_spacings(cloud: PointCloud) -> tuple[Float[AnyScalar, ""], Float[AnyScalar, ""]]:
    distances = _neighbor_distances(cloud)
    xp = numpy_for(distances)
    nearest = xp.min(xp.where(distances > 0, distances, xp.inf), axis=1)
    spacing = xp.nan_to_num(median(xp.where(xp.isfinite(nearest), nearest, xp.nan)))
    known = xp.isfinite(distances)
    count = xp.sum(known, axis=1)
    grid = xp.max(xp.where(known, distances, 0), axis=1) * xp.sqrt(xp.pi / xp.maximum(count, 1))
    return spacing, xp.nan_to_num(median(xp.where(count > 1, grid, xp.nan))).astype(distances.dtype)


def _neighbor_distances(cloud: PointCloud) -> Float[AnyArray, "n k"]:
    """Distances between sampled points and their neighbours, metres; infinite where there is none."""
    check_neighbors(cloud)
    xp = numpy_for(cloud)
    rows, counts = sampled_rows(xp.asarray(cloud.valid))
    neighbors = xp.asarray(cloud.neighbors)[rows]
    square = xp.zeros(neighbors.shape, cloud.points.dtype)
    # Distances that overflow become infinite and are ignored.
    with np.errstate(over="ignore", invalid="ignore"):
        for coordinate in xp.asarray(cloud.points).T:
            square = square + (coordinate[xp.maximum(neighbors, 0)] - coordinate[rows, None]) ** 2
    return xp.sqrt(xp.where(counts[:, None] & (neighbors >= 0) & xp.isfinite(square), square, xp.inf))


def with_channels_matched(source: PointCloud, target: PointCloud, matches: Correspondences | None = None) -> PointCloud:
    """The source with a gain and an offset applied to each channel, so that its distribution matches the target's.

    Gain and offset equalise mean and standard deviation of the quantiles from 5 to 95 %, which is robust against small
    parts that only one cloud sees. Regression over matches is not used: noise, and matches across edges, would bias the
    gain towards 0. With `matches`, only values of valid matches are used. Gain and offset are constants to autodiff;
    they are 1 and 0 for channels without usable spread.
    """
    xp = numpy_for(source, target, matches)
    values = [_known_values(constant(cloud)) for cloud in (source, target)]
    values = [xp.asarray(each) for each in values]
    if matches is not None:
        values[1] = values[1][xp.asarray(matches.indices)]
        matched = xp.asarray(matches.valid)[:, None] & xp.isfinite(values[0]) & xp.isfinite(values[1])
        # Too few points do not determine a distribution.
        matched = matched & (xp.sum(matched, axis=0) > len(_QUANTILES))
        values = [xp.where(matched, each, xp.nan) for each in values]
    gain, offset = gain_and_offset(*values)
    dtype = source.channels.dtype
    return source.replace(channels=xp.asarray(source.channels) * gain.astype(dtype) + offset.astype(dtype))


def gain_and_offset(
    values: Float[AnyArray, "n C"], wanted: Float[AnyArray, "m C"]
) -> tuple[Float[AnyArray, "C"], Float[AnyArray, "C"]]:
    """Gain and offset of each channel that equalise mean and standard deviation of its quantiles with those wanted.

    NaNs are ignored; 1 and 0 for channels without usable spread.
    """
    xp = numpy_for(values, wanted)
    levels = xp.asarray(_QUANTILES, values.dtype)
    quantiles = [of_known(partial(xp.nanquantile, q=levels, axis=0), each) for each in (values, wanted)]
    means = [xp.mean(each, axis=0) for each in quantiles]
    spreads = [xp.std(each, axis=0) for each in quantiles]
    varying = (spreads[0] > 0) & (spreads[1] > 0)
    gain = xp.where(varying, spreads[1] / xp.where(varying, spreads[0], 1), 1)
    offset = means[1] - gain * means[0]
    known = xp.isfinite(gain) & xp.isfinite(offset)
    return xp.where(known, gain, 1), xp.where(known, offset, 0)
