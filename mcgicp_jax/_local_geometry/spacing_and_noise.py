"""Statistics of the data that methods are adapted to: channel noise and point spacing.

They are computed with NumPy for concrete clouds and with JAX for traced ones.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mcgicp_jax._clouds.point_cloud import PointCloud
from mcgicp_jax._compute.cache import cached_with_cloud
from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, constant, is_concrete, numpy_for
from mcgicp_jax._local_geometry.local_geometry import Geometries, LocalGeometry
from mcgicp_jax._local_geometry.neighborhoods import check_neighbors
from mcgicp_jax._math.statistics import median, of_known, sampled_rows


def channel_noise(
    source: PointCloud, target: PointCloud, geometries: Geometries
) -> tuple[Float[AnyArray, "C"], Bool[AnyArray, "C"], Float[AnyScalar, ""]]:
    """Noise σ per channel, which channels are uniform (σ = 1), and the variance λ₀ along the normal, metres².

    Both are medians over a sample of both clouds: σ of the residuals of linear fits, λ₀ of the variances of the
    neighbours.
    """
    samples = [_noise_rows(cloud) for cloud in (source, target)]
    found = constant(geometries((samples[0][0], samples[1][0])))
    xp = numpy_for(source, target, found)
    residuals, values, across = [], [], []
    for cloud, local, (_, counts) in zip((source, target), found, samples, strict=True):
        deviations = xp.sqrt(local.fits.residual.T)
        residuals.append(xp.where(counts[:-1], deviations, xp.nan))
        values.append(known_values(cloud))
        across.append(xp.where(counts[-1], _smallest_variance(local, xp), xp.nan))
    sigma = median(xp.concatenate(residuals, axis=1))
    everything = xp.concatenate(values)
    spread = of_known(partial(xp.nanstd, axis=0), everything)
    largest = of_known(partial(xp.nanmax, axis=0), xp.abs(everything))
    uniform = ~(spread > 1e3 * xp.finfo(spread.dtype).eps * largest)
    # Rendered channels have no noise; a floor of a thousandth of their standard deviation keeps α finite and Λ regular.
    return xp.where(uniform, 1, xp.fmax(sigma, 1e-3 * spread)), uniform, median(xp.concatenate(across))


def _noise_rows(cloud: PointCloud) -> tuple[Any, Any]:
    """(n,) sampled rows, and (C + 1, n) booleans: which of them are the sample of each channel, and of all points."""
    xp = numpy_for(cloud.valid, cloud.channel_valid)
    valid = xp.asarray(cloud.valid)
    if cloud.channel_valid is None:
        rows, counts = sampled_rows(valid)
        return rows, xp.broadcast_to(counts, (cloud.channels.shape[1] + 1, rows.size))
    # One sample of all points might contain too few that have a channel.
    samples = []
    for known in (*(valid & xp.asarray(cloud.channel_valid).T), valid):
        order = xp.argsort(~known, stable=True)
        rows, counts = sampled_rows(known[order])
        samples.append((order[rows], counts))
    owner = xp.repeat(xp.arange(len(samples)), samples[0][0].size)
    rows, counts = (xp.concatenate(each) for each in zip(*samples, strict=True))
    return rows, (owner == xp.arange(len(samples))[:, None]) & counts


def _smallest_variance(local: LocalGeometry, xp: Any) -> Float[AnyArray, "N"]:
    """λ₀ = nᵀ C n, the variance of the neighbours along the normal, metres²."""
    xx, xy, xz, yy, yz, zz = local.covariance.T
    x, y, z = local.normal.T
    with np.errstate(over="ignore", invalid="ignore"):
        return xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)


def known_values(cloud: PointCloud) -> Float[AnyArray, "N C"]:
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
    return _known_spacings(cloud) if is_concrete(cloud) else _measured_spacings(cloud)


def _measured_spacings(cloud: PointCloud) -> tuple[Float[AnyScalar, ""], Float[AnyScalar, ""]]:
    squares = _squared_neighbor_distances(cloud)
    xp = numpy_for(squares)
    nearest = xp.sqrt(xp.min(xp.where(squares > 0, squares, xp.inf), axis=0))
    spacing = xp.nan_to_num(median(xp.where(xp.isfinite(nearest), nearest, xp.nan)))
    known = xp.isfinite(squares)
    count = xp.sum(known, axis=0)
    grid = xp.sqrt(xp.max(xp.where(known, squares, 0), axis=0)) * xp.sqrt(xp.pi / xp.maximum(count, 1))
    return spacing, xp.nan_to_num(median(xp.where(count > 1, grid, xp.nan))).astype(squares.dtype)


_known_spacings = cached_with_cloud(_measured_spacings)


def _squared_neighbor_distances(cloud: PointCloud) -> Float[AnyArray, "k n"]:
    """Squared distances between the neighbours of sampled points and the points, metres²; infinite where there is none.

    Neighbours come first, so that NumPy's loops run over the points.
    """
    xp = numpy_for(cloud)
    rows, counts = sampled_rows(xp.asarray(cloud.valid))
    neighbors = check_neighbors(cloud, xp)[rows].T.copy()
    near = xp.maximum(neighbors, 0)
    square = xp.zeros(near.shape, cloud.points.dtype)
    # Distances that overflow become infinite and are ignored.
    with np.errstate(over="ignore", invalid="ignore"):
        for coordinate in xp.asarray(cloud.points).T:
            square = square + (xp.take(coordinate, near) - coordinate[rows]) ** 2
    return xp.where(counts & (neighbors >= 0) & xp.isfinite(square), square, xp.inf)
