"""Statistics of clouds that methods are adapted to: channel noise, point spacing, gain and offset of channels.

They are computed with NumPy for concrete clouds and with JAX for traced ones.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.cache import cached_with_cloud
from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, constant, numpy_for
from mcgicp_jax._compute.messages import warn
from mcgicp_jax._local_geometry.local_geometry import Geometries
from mcgicp_jax._local_geometry.neighborhoods import check_neighbors
from mcgicp_jax._math.statistics import median, of_known, sampled_rows
from mcgicp_jax._search.base import Correspondences

# Quantiles between which the spread of a channel is measured, so that a few extreme values, of reflectors or flags, do
# not raise the floor of its noise and Λ. Where both are equal, as for rare marks, all values count. They are taken from
# every fourth row of the sample: of 2,000 rows, they are the eleventh from either end.
_INNER, _STRIDE = (0.005, 0.995), 4
# Smallest spread of a channel that is not uniform, in roundings of its largest value: what sums of constants leave.
_ROUNDINGS = 10
# Quantile of the neighbourhoods whose thickness is the noise of the surfaces: where there are edges, curvature and scan
# lines, the flattest ones show it. On simulated streets with exact truth, the median gave errors of 11 instead of 7 mm;
# on noisy walls and depth images both gave the same.
_FLATTEST = 0.25
# Neighbours are nearly coincident up to 1 / (4 k) of the distance of the k-th one, an eighth of the spacing of points
# along a line. Of randomly placed points, 0.3 % have so near a neighbour.
_NEARLY_COINCIDENT = 4
# Quantiles (5 to 95 %) from which gain and offset are estimated: robust against parts that only one cloud sees.
_QUANTILES = tuple(step / 20 for step in range(1, 20))
# Ratio of the ranges of a channel in two clouds above which its units probably differ: files hold intensities from 0 to
# 1, 255 or 65,535, whereas exposures differ by less.
_OTHER_UNIT = 10.0
# Gain between the channels of two clouds from which on matched values are compared. In simulated pairs, it was between
# 0.9 and 1.1 with the same exposure, and 1.8 to 2.2 with half the exposure, which moved the pose by up to 0.1 m.
_OTHER_EXPOSURE = 1.5
# Change of the ends of the range at matched points, over the range, from which on exposures differ. On textured walls
# with one exposure it was 0.006 at most, with a gain of 1.2 up to 0.13 (poses 1 to 6 deviations off), and with gains of
# 1.5 and 1.9 from 0.15 to 0.31 (2 to 9 deviations), also where bright colours were clipped.
_OTHER_LEVEL = 0.15


def channel_noise(
    source: PointCloud, target: PointCloud, geometries: Geometries
) -> tuple[Float[AnyArray, "C"], Bool[AnyArray, "C"], Float[AnyScalar, ""], Float[AnyScalar, ""]]:
    """Noise σ per channel, the median deviation from linear fits (1 for uniform channels), which channels are uniform,
    the median variance λ₀ along the normal, metres², and the quantile `_FLATTEST` of its ratio to the mean variance
    within the surface (NaN if all neighbours coincide); from samples of both clouds."""
    samples = [_noise_rows(cloud) for cloud in (source, target)]
    local_geometries = constant(geometries((samples[0][0], samples[1][0])))
    xp = numpy_for(source, target, local_geometries)
    values = [_channel_values(cloud) for cloud in (source, target)]
    residuals, sampled, across, ratios = [], [], [], []
    for channels, local, (rows, counts) in zip(values, local_geometries, samples, strict=True):
        residuals.append(xp.where(counts[:-1], xp.sqrt(local.fits.residual.T), xp.nan))
        sampled.append(xp.where(counts[:-1].T, channels[rows], xp.nan))
        xx, xy, xz, yy, yz, zz = local.covariance.T
        x, y, z = local.normal.T
        with np.errstate(over="ignore", invalid="ignore"):
            variance = xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)
            inside = 0.5 * (xx + yy + zz - variance)
            ratio = xp.where(inside > 0, variance / xp.where(inside > 0, inside, 1), xp.nan)
        across.append(xp.where(counts[-1], variance, xp.nan))
        ratios.append(xp.where(counts[-1], ratio, xp.nan))
    sigma = median(xp.concatenate(residuals, axis=1))
    # The quantiles `_INNER`; NaN comes last.
    sample = xp.sort(xp.concatenate(sampled)[::_STRIDE], axis=0)
    last = xp.maximum(xp.sum(~xp.isnan(sample), axis=0, keepdims=True) - 1, 0)
    places = (xp.round(last * xp.asarray(q, sample.dtype)).astype(np.int32) for q in _INNER)
    low, high = (xp.take_along_axis(sample, place, axis=0)[0] for place in places)
    clipped = xp.concatenate(values)
    clipped = xp.where(low < high, xp.clip(clipped, low, high), clipped)
    spread = of_known(partial(xp.nanstd, axis=0), clipped)
    largest = of_known(partial(xp.nanmax, axis=0), xp.abs(clipped))
    uniform = ~(spread > _ROUNDINGS * xp.finfo(spread.dtype).eps * largest)
    # Rendered channels have no noise; a floor of a thousandth of their standard deviation keeps α finite and Λ regular.
    sigma = xp.where(uniform, 1, xp.fmax(sigma, 1e-3 * spread))
    ratio = of_known(partial(xp.nanquantile, q=_FLATTEST), xp.concatenate(ratios))
    return sigma, uniform, median(xp.concatenate(across)), ratio


def _noise_rows(cloud: PointCloud) -> tuple[Any, Any]:
    """(n,) sampled rows, and (C + 1, n) booleans: which rows are the sample of each channel, and that of all points."""
    xp = numpy_for(cloud.valid, cloud.channel_valid)
    valid = xp.asarray(cloud.valid)
    if cloud.channel_valid is None:
        rows, counts = sampled_rows(valid)
        return rows, xp.broadcast_to(counts, (cloud.channels.shape[1] + 1, rows.size))
    # A single sample might contain too few points that have a channel.
    samples = []
    for measured in (*(valid & xp.asarray(cloud.channel_valid).T), valid):
        order = xp.argsort(~measured, stable=True)
        rows, counts = sampled_rows(measured[order])
        samples.append((order[rows], counts))
    owner = xp.repeat(xp.arange(len(samples)), samples[0][0].size)
    rows, counts = (xp.concatenate(parts) for parts in zip(*samples, strict=True))
    return rows, (owner == xp.arange(len(samples))[:, None]) & counts


def _channel_values(cloud: PointCloud) -> Float[AnyArray, "N C"]:
    """Channels; NaN where a point lacks them or is padding."""
    xp = numpy_for(cloud)
    valid = xp.asarray(cloud.valid)[:, None]
    if cloud.channel_valid is not None:
        valid = valid & xp.asarray(cloud.channel_valid)
    return xp.where(valid, xp.asarray(cloud.channels), xp.nan)


def point_spacing(cloud: PointCloud) -> Float[AnyScalar, ""]:
    """Median nearest-neighbour distance, metres, ignoring neighbours that are nearly coincident: some files hold points
    twice, some scanners report two returns of one surface, and some report each beam without an echo as a point at the
    origin. 0 if all neighbours coincide."""
    return _spacings(cloud)[0]


def grid_spacing(cloud: PointCloud) -> Float[AnyScalar, ""]:
    """Spacing of a square grid with the density of the points, metres: the median of √(π/k) times the distance of the
    k-th neighbour. For scan lines it exceeds `point_spacing`, the spacing along them."""
    return _spacings(cloud)[1]


@cached_with_cloud
def _spacings(cloud: PointCloud) -> tuple[Float[AnyScalar, ""], Float[AnyScalar, ""]]:
    xp = numpy_for(cloud)
    rows, counts = sampled_rows(xp.asarray(cloud.valid))
    # (k, n): neighbours come first, so that NumPy's loops run over the points.
    neighbors = check_neighbors(cloud, xp)[rows].T.copy()
    near = xp.maximum(neighbors, 0)
    squares = xp.zeros(near.shape, cloud.points.dtype)
    # Distances that overflow become infinite and are ignored.
    with np.errstate(over="ignore", invalid="ignore"):
        for coordinate in xp.asarray(cloud.points).T:
            squares = squares + (xp.take(coordinate, near) - coordinate[rows]) ** 2
    squares = xp.where(counts & (neighbors >= 0) & xp.isfinite(squares), squares, xp.inf)
    # Concrete where only the channels are traced.
    xp = numpy_for(squares)
    measured = xp.isfinite(squares)
    count = xp.sum(measured, axis=0)
    farthest = xp.max(xp.where(measured, squares, 0), axis=0)
    near_duplicate = squares <= farthest / (_NEARLY_COINCIDENT * xp.maximum(count, 1).astype(squares.dtype)) ** 2
    nearest = xp.sqrt(xp.min(xp.where(near_duplicate, xp.inf, squares), axis=0))
    spacing = xp.nan_to_num(median(xp.where(xp.isfinite(nearest), nearest, xp.nan)))
    grid = xp.sqrt(farthest) * xp.sqrt(xp.pi / xp.maximum(count, 1))
    return spacing, xp.nan_to_num(median(xp.where(count > 1, grid, xp.nan))).astype(squares.dtype)


def warn_of_units(source: PointCloud, target: PointCloud) -> None:
    """Warn of channels whose values differ so much between two concrete clouds that their units probably differ."""
    ranges = [_ranges(cloud) for cloud in (source, target)]
    for name, (low, high), (first, last) in zip(source.channel_names, *ranges, strict=False):
        narrow, wide = sorted([high - low, last - first])
        if high < first or last < low or wide > _OTHER_UNIT * narrow > 0:
            warn(
                f"channel {name}: most values lie between {low:.3g} and {high:.3g} in the source, but between "
                f"{first:.3g} and {last:.3g} in the target; if their units differ, scale one, or use equalize_channels"
            )


def changes_of_exposure(
    source: PointCloud, target: PointCloud, matches: Callable[[], Correspondences], by_channels: bool
) -> list[str]:
    """What to say of channels whose values differ at matched points, probably because of another exposure. `matches` is
    called if the ranges of all values differ, too, or if channels alone constrain the pose (`by_channels`)."""
    ranges = [_ranges(cloud) for cloud in (source, target)]
    widths = [sorted([high - low, last - first]) for (low, high), (first, last) in zip(*ranges, strict=False)]
    if not by_channels and not any(_OTHER_EXPOSURE * narrow < wide <= _OTHER_UNIT * narrow for narrow, wide in widths):
        return []
    maps = zip(*map(np.asarray, _gains_and_offsets(source, target, matches())), strict=True)
    return [
        # Without numbers, so that Python shows a warning once.
        f"channel {name}: its values at matched points of source and target differ by more than {_OTHER_LEVEL:.0%} of "
        "their range, which displaces the pose; if the exposure differs, use equalize_channels=True"
        for name, (gain, offset), ends in zip(source.channel_names, maps, ranges[0], strict=True)
        if max(abs(gain * end + offset - end) for end in ends) > _OTHER_LEVEL * (ends[1] - ends[0])
    ]


@cached_with_cloud
def _ranges(cloud: PointCloud) -> list[tuple[float, float]]:
    """The 5 and 95 % quantiles of a sample of each channel; NaN if no point has the channel."""
    rows, valid = sampled_rows(np.asarray(cloud.valid))
    # In float32, differences of quantiles may overflow.
    channels = _channel_values(cloud)[rows].astype(np.float64)
    channels[~(valid[:, None] & np.isfinite(channels))] = np.nan
    quantiles = of_known(partial(np.nanquantile, q=[_QUANTILES[0], _QUANTILES[-1]], axis=0), channels)
    return list(zip(*quantiles.tolist(), strict=True))


def with_channels_matched(
    source: PointCloud, target: PointCloud, matches: Correspondences | None = None
) -> tuple[PointCloud, Float[AnyArray, "C"]]:
    """The source with `gain_and_offset` applied, so that it matches the target; and the gains. Constants to autodiff.

    With `matches`, only matched values count. Noise and matches across edges would bias a regression's gain towards 0.
    """
    gain, offset = _gains_and_offsets(source, target, matches)
    xp, dtype = numpy_for(source, gain), source.channels.dtype
    channels = xp.asarray(source.channels) * gain.astype(dtype) + offset.astype(dtype)
    return source.replace(channels=channels), gain


def _gains_and_offsets(
    source: PointCloud, target: PointCloud, matches: Correspondences | None
) -> tuple[Float[AnyArray, "C"], Float[AnyArray, "C"]]:
    xp = numpy_for(source, target, matches)
    values = [xp.asarray(_channel_values(constant(cloud))) for cloud in (source, target)]
    if matches is not None:
        values[1] = values[1][xp.asarray(matches.indices)]
        matched = xp.asarray(matches.valid)[:, None] & xp.isfinite(values[0]) & xp.isfinite(values[1])
        # Too few points do not determine a distribution.
        matched = matched & (xp.sum(matched, axis=0) > len(_QUANTILES))
        values = [xp.where(matched, channels, xp.nan) for channels in values]
    return gain_and_offset(*values)


def gain_and_offset(
    values: Float[AnyArray, "n C"], wanted: Float[AnyArray, "m C"]
) -> tuple[Float[AnyArray, "C"], Float[AnyArray, "C"]]:
    """Gain and offset of each channel that give its `_QUANTILES` the mean and standard deviation of the wanted ones,
    ignoring NaN; 1 and 0 for channels without usable spread."""
    xp = numpy_for(values, wanted)
    fractions = xp.asarray(_QUANTILES, values.dtype)
    # Channels whose statistics overflow remain as they are.
    with np.errstate(over="ignore", invalid="ignore"):
        quantiles = [of_known(partial(xp.nanquantile, q=fractions, axis=0), channels) for channels in (values, wanted)]
        means = [xp.mean(levels, axis=0) for levels in quantiles]
        spreads = [xp.std(levels, axis=0) for levels in quantiles]
        varying = (spreads[0] > 0) & (spreads[1] > 0)
        gain = xp.where(varying, spreads[1] / xp.where(varying, spreads[0], 1), 1)
        offset = means[1] - gain * means[0]
    finite = xp.isfinite(gain) & xp.isfinite(offset)
    return xp.where(finite, gain, 1), xp.where(finite, offset, 0)
