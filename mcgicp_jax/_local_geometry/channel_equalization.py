"""Gain and offset of the channels of two clouds, and a warning of units that differ."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from jaxtyping import Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.cache import cached_with_cloud
from mcgicp_jax._compute.concrete import AnyArray, constant, numpy_for
from mcgicp_jax._compute.messages import warn
from mcgicp_jax._local_geometry.spacing_and_noise import known_values
from mcgicp_jax._math.statistics import of_known, sampled_rows
from mcgicp_jax._search.base import Correspondences

# Quantiles (5 to 95 %) from which gain and offset are estimated: robust against parts that only one cloud sees.
_QUANTILES = tuple(step / 20 for step in range(1, 20))
# Ratio of the ranges of a channel in two clouds above which its units probably differ: files hold intensities from 0 to
# 1, 255 or 65,535, whereas exposures differ by less.
_OTHER_UNIT = 10.0
# Gain between the channels of two clouds from which on a warning is issued. In simulated pairs, it was between 0.9 and
# 1.1 with the same exposure, and 1.8 to 2.2 with half the exposure, which moved the pose by up to 0.1 m.
_OTHER_EXPOSURE = 1.5


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


def warn_of_exposure(source: PointCloud, target: PointCloud, matches: Callable[[], Correspondences]) -> None:
    """Warn of channels that differ by a gain between matched points; these are sought if the ranges differ as much."""
    ranges = [_ranges(cloud) for cloud in (source, target)]
    widths = [sorted([high - low, last - first]) for (low, high), (first, last) in zip(*ranges, strict=False)]
    if not any(_OTHER_EXPOSURE * narrow < wide <= _OTHER_UNIT * narrow for narrow, wide in widths):
        return
    for name, gain in zip(source.channel_names, np.asarray(_gain(source, target, matches())[0]), strict=True):
        if not 1 / _OTHER_EXPOSURE < gain < _OTHER_EXPOSURE:
            # Without the number, so that Python shows it once.
            warn(
                f"channel {name}: the spreads of its values at matched points of source and target differ by a factor "
                f"of more than {_OTHER_EXPOSURE}, which displaces the pose; if the exposure differs, use "
                "equalize_channels=True"
            )


@cached_with_cloud
def _ranges(cloud: PointCloud) -> list[tuple[float, float]]:
    """The 5 and 95 % quantiles of a sample of each channel; NaN if no point has the channel."""
    rows, counts = sampled_rows(np.asarray(cloud.valid))
    rows = rows[counts]
    # In float32, differences of quantiles may overflow.
    channels = np.asarray(cloud.channels, np.float64)[rows]
    known = np.isfinite(channels)
    if cloud.channel_valid is not None:
        known &= np.asarray(cloud.channel_valid)[rows]
    ranges = []
    for values in (column[there] for column, there in zip(channels.T, known.T, strict=True)):
        low, high = np.quantile(values, [_QUANTILES[0], _QUANTILES[-1]]) if values.size else (np.nan, np.nan)
        ranges.append((float(low), float(high)))
    return ranges


def with_channels_matched(
    source: PointCloud, target: PointCloud, matches: Correspondences | None = None
) -> tuple[PointCloud, Float[AnyArray, "C"]]:
    """The source with a gain and an offset applied to each channel, so that its distribution matches the target's; and
    the gains.

    Gain and offset equalise mean and standard deviation of the quantiles from 5 to 95 %, which is robust against small
    parts that only one cloud sees. Regression over matches is not used: noise, and matches across edges, would bias the
    gain towards 0. With `matches`, only values of valid matches are used. Gain and offset are constants to autodiff;
    they are 1 and 0 for channels without usable spread.
    """
    gain, offset = _gain(source, target, matches)
    xp, dtype = numpy_for(source, gain), source.channels.dtype
    channels = xp.asarray(source.channels) * gain.astype(dtype) + offset.astype(dtype)
    return source.replace(channels=channels), gain


def _gain(
    source: PointCloud, target: PointCloud, matches: Correspondences | None
) -> tuple[Float[AnyArray, "C"], Float[AnyArray, "C"]]:
    """Gain and offset of each channel of the source."""
    xp = numpy_for(source, target, matches)
    values = [xp.asarray(known_values(constant(cloud))) for cloud in (source, target)]
    if matches is not None:
        values[1] = values[1][xp.asarray(matches.indices)]
        matched = xp.asarray(matches.valid)[:, None] & xp.isfinite(values[0]) & xp.isfinite(values[1])
        # Too few points do not determine a distribution.
        matched = matched & (xp.sum(matched, axis=0) > len(_QUANTILES))
        values = [xp.where(matched, each, xp.nan) for each in values]
    return gain_and_offset(*values)


def gain_and_offset(
    values: Float[AnyArray, "n C"], wanted: Float[AnyArray, "m C"]
) -> tuple[Float[AnyArray, "C"], Float[AnyArray, "C"]]:
    """Gain and offset of each channel that give its quantiles the mean and standard deviation of the wanted ones.

    NaNs are ignored; 1 and 0 for channels without usable spread.
    """
    xp = numpy_for(values, wanted)
    levels = xp.asarray(_QUANTILES, values.dtype)
    # What overflows is not finite, and leaves its channel as it is.
    with np.errstate(over="ignore", invalid="ignore"):
        quantiles = [of_known(partial(xp.nanquantile, q=levels, axis=0), each) for each in (values, wanted)]
        means = [xp.mean(each, axis=0) for each in quantiles]
        spreads = [xp.std(each, axis=0) for each in quantiles]
        varying = (spreads[0] > 0) & (spreads[1] > 0)
        gain = xp.where(varying, spreads[1] / xp.where(varying, spreads[0], 1), 1)
        offset = means[1] - gain * means[0]
    known = xp.isfinite(gain) & xp.isfinite(offset)
    return xp.where(known, gain, 1), xp.where(known, offset, 0)
