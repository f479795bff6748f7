"""A photometric term: the channels of matched points are interpolated to a common position and compared.

A matched target point lies up to half a spacing from the surface point that the source measured. A local linear fit v +
gᵀx of each channel over the tangent plane predicts the channel between samples (Park, Zhou & Koltun, Colored Point
Cloud Registration Revisited, ICCV 2017). With p = T a and e = p − b, each correspondence has 1 + C residuals:

    r₀ = nᵀe                            metres, n the unit mean of both normals (Rusinkiewicz 2019)
    r_c = v_c^B + h_cᵀe − v_c^A         channel units, h_c = (g_c^B + R g_c^A) / 2, exact at the midpoint of p and b

Both points contribute the fitted value v instead of the measured one, since a measured value combined with a slope that
is smoothed over a neighbourhood is biased at edges. v is the mean of the neighbours' values, extrapolated to the point
along g, with weights that decrease with the squared distance (Epanechnikov), so that a neighbour that enters the
neighbourhood at an edge changes v less. The negative log-likelihood is Σ_k q_k/f_k Σ_i ρ(r_k²/σ_k²): all residuals
count in standard deviations, and no weight is set by hand. At each pose of the fine phase, `adapt` estimates from the
residuals, as constants to autodiff,

- σ_k, one scale per residual: 1.4826 times the median absolute deviation where there is a slope. It contains the noise
  of both measurements and of the fits, and the error of the interpolation. Channels that disagree, as from a camera
  that is not synchronised, get a large σ.
- f_k, the design effect (Kish 1965): the variance of the summed scores over that of independent ones. Residuals of
  neighbours share samples, exposure and relief, so that n of them count as n/f_k. With the forces u_c summed over
  cells, f_k = Σ_c |u_c|² / Σ_i w_i |h_i|²/σ_k², at least 1. (The mean eigenvalue of H^{-1/2} (Σ u uᵀ) H^{-1/2} over
  forces and torques differs by a third and changed errors by at most 3 %.)
- q_k, the reliability of the slopes (Fuller, Measurement Error Models, 1987): Σ w g_Bᵀ R g_A / Σ w |h|², at most 1. The
  noise of the gradients is independent in the two clouds, so that the numerator contains the true slopes alone. A
  motion changes the force by the fraction q of its stiffness. The pose from one channel alone has a covariance of f/q²
  times the inverse stiffness; multiplying each channel by q combines such poses with minimal variance. A channel of
  pure noise has q ≈ 0. Normals count as reliable, q_0 = 1.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, numpy_for
from mcgicp_jax._local_geometry.cloud_statistics import gain_and_offset
from mcgicp_jax._local_geometry.local_geometry import LocalGeometry, offsets_of
from mcgicp_jax._local_geometry.neighborhoods import NO_NEIGHBORS, Neighborhoods, fit_linear
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.robust_kernels import AbstractKernel, Cauchy
from mcgicp_jax._math.statistics import cell_numbers, median
from mcgicp_jax._terms.base import AbstractAdaptiveTerm, AbstractTerm, Linearization, PosedMatches

# Scale of the default kernel in standard deviations: weights are those of Student's t with k² = 20 degrees of freedom.
# Errors on RGB-D pairs with 10 instead of 20: from 1 % less to 11 % more on four sets, a quarter less (0.06 mm) on
# rendered ones; with 5, a fifth more on the recorded table.
_KERNEL_SCALE = 20**0.5
# Edge of the cells of the design effect, spacings. 5 to 20 made little difference.
_CELL = 10.0
# Radius of the weights of fitted values, in distances to the farthest neighbour. With 1, errors are 3 % less on
# posters, 4 % less on the recorded table and 4 % more on 7-Scenes; with 1.4, 1 % more on the former two.
_VALUE_RADIUS = 1.25
# Largest distance of matches whose channels are compared, spacings: others lie outside the neighbourhood of the fits
# (the 20 nearest of randomly placed points lie within 5.4).
_MAX_OFFSET = 5.0
# Least slope of a residual that counts for its σ, relative to the root mean square: slopes of a constant part, as black
# outside an image, are 0 up to rounding, and slopes of noise fall below it once in 10⁶. (1e-4 to 0.03 differ by 3 % on
# posters of which 0 to 60 % are black.)
_LEAST_SLOPE = 1e-3
# Least σ, as an offset in spacings: rendered scenes leave no residuals.
_LEAST_OFFSET = 1e-4
# Shift of the points to either side to measure the response, spacings: most matches differ between both ends. With 0.5,
# 0.75 and 1, the squared errors on thirty walls of posters were 1.31, 1.07 and 0.85 times their variance, those of the
# box room (84 pairs) 1.19, 1.03 and 0.85 times.
_SHIFT = 0.75
# Lower bound of the response, dimensionless: its estimate may be 0 by chance.
_LEAST_RESPONSE = 0.1
# Lower bound of the reliability, dimensionless: its estimate for noise may be 0, and f/q must be finite.
_LEAST_RELIABILITY = 1e-3
# Standard deviation of a normal variate over its median absolute deviation.
_PER_MEDIAN = 1.4826


class FittedChannels(NamedTuple):
    """The columns of the term: linear fits of the channels at each point."""

    normal: Float[AnyArray, "n 3"]
    value: Float[AnyArray, "n C"]  # NaN where unknown
    gradient: Float[AnyArray, "n C 3"]  # in the tangent plane, channel units per metre; 0 where unknown


class Residuals(NamedTuple):
    """The 1 + C = K residuals of n correspondences; NaN and slope 0 where there is none."""

    values: Float[AnyArray, "*some n K"]  # r_k, metres and channel units
    slopes: Float[AnyArray, "*some n K 3"]  # derivatives of the residuals with respect to T a
    fitted: Float[AnyArray, "*some n C"]  # channels of the source points
    products: Float[AnyArray, "*some n C"]  # g_Bᵀ R g_A, the gradient of the source multiplied by its gain
    moved: Float[AnyArray, "*some n 3"]  # T a, metres; 0 where there is no match


class Photometric(AbstractAdaptiveTerm):
    """The photometric term, see the module. Its numbers are constants to autodiff.

    Attributes:
        spacing: of the target, metres.
        deviations: σ of each residual, metres and channel units; 0 before the first estimate, when `coarse` is used.
        designs: f/q, design effect over reliability, of each residual.
        gains, offsets: applied to the fitted values of the source's channels; 1 and 0 unless `equalizes_channels`.
        robust: kernel of each residual in standard deviations; None: Cauchy's with k² = 20. Each residual has its own
            weight: a reflection is an outlier of the channels, but not of the geometry.
    """

    name: ClassVar[str] = "photometric"
    by_position: ClassVar[bool] = True
    # Both points of a correspondence contribute fits over their neighbourhoods. With 2, 4 and 8, the squared errors on
    # thirty walls of posters were 2.8, 1.8 and 1.6 times their variance (with half of the shift below); with 12, where
    # some walls have few cells, 1.7.
    correlation_length: ClassVar[float] = 8.0

    spacing: Float[AnyArray, "*batch"]
    deviations: Float[AnyArray, "*batch K"]
    designs: Float[AnyArray, "*batch K"]
    gains: Float[AnyArray, "*batch C"]
    offsets: Float[AnyArray, "*batch C"]
    coarse: AbstractTerm
    equalizes_channels: bool = eqx.field(static=True, default=False)

    @classmethod
    def before_estimate(
        cls,
        spacing: Float[AnyScalar, ""],
        num_channels: int,
        coarse: AbstractTerm,
        robust: AbstractKernel | None,
        equalizes_channels: bool,
    ) -> Photometric:
        xp = numpy_for(spacing)
        spacing = xp.asarray(spacing)
        zeros, ones = (make(1 + num_channels, spacing.dtype) for make in (xp.zeros, xp.ones))
        return cls(spacing, zeros, ones, ones[1:], zeros[1:], coarse, equalizes_channels, robust=robust)

    @staticmethod
    def columns(around: Neighborhoods, local: LocalGeometry | None) -> FittedChannels:
        """Fit each channel over the tangent plane of each point; differentiable by points and channels."""
        if local is None:
            raise ValueError(NO_NEIGHBORS)
        offsets, basis = offsets_of(around), alg.orthonormal_basis(local.normal.T)
        x, y = (sum(offset * b for offset, b in zip(offsets, axis, strict=True)) for axis in basis)
        square: Any = sum(offset * offset for offset in offsets)
        farthest = _VALUE_RADIUS**2 * jnp.max(square, axis=0)
        kernel = 1 - square / jnp.where(farthest > 0, farthest, 1)
        fitted, gradients = [], []
        for channel in range(around.num_channels):
            measured, values = around.measured(channel), around.difference(channel)
            fit = fit_linear(x, y, values, measured.astype(x.dtype))
            gx, gy = fit.gradient
            weights = jnp.where(measured, kernel, 0)
            total = jnp.sum(weights, axis=0)
            value = jnp.sum(weights * (values - gx * x - gy * y), axis=0) / jnp.where(total > 0, total, 1)
            enough = (fit.weight > 3) & (fit.inverse[0] > 0)
            if around.own_measured is not None:
                enough = enough & around.own_measured[channel]
            fitted.append(jnp.where(enough, around.own_channels[channel] + value, jnp.nan))
            gradients.append(jnp.where(enough, gx * basis[0] + gy * basis[1], 0))
        return FittedChannels(local.normal, jnp.stack(fitted, axis=1), jnp.stack(gradients).transpose(2, 0, 1))

    @property
    def estimates_gains(self) -> bool:
        return self.equalizes_channels

    def linearize(self, matches: PosedMatches) -> Linearization:
        def photometric() -> Linearization:
            values, slopes, *_ = self._residuals(matches)
            residual = matches.target.points.T - matches.moved
            scale: Any = _KERNEL_SCALE
            robust = Cauchy(scale) if self.robust is None else self.robust
            parts = []
            for k, (value, slope) in enumerate(zip(values, slopes, strict=True)):
                counts = (self.deviations[k] > 0) & ~jnp.isnan(value)
                deviation = jnp.where(self.deviations[k] > 0, self.deviations[k], 1)
                effective = jnp.where(counts, 1 / self.designs[k], 0)
                scaled, direction = jnp.where(counts, value, 0) / deviation, slope / deviation
                weight = robust.weight(scaled**2)
                information = effective * alg.outer(direction)
                force = -effective * weight * scaled * direction
                cost = effective * robust.rho(scaled**2)
                parts.append(Linearization(force, weight * information, cost, weight, residual, information))
            return sum(parts[1:], start=parts[0])

        # Before the first estimate the deviations are 0.
        return jax.lax.cond(self.deviations[0] > 0, photometric, lambda: self.coarse.linearize(matches))

    def _residuals(self, matches: PosedMatches) -> tuple[list[Any], list[Any], list[Any], list[Any]]:
        """The fields of `Residuals` but `moved`, each as a list of arrays (n,) or (3, n)."""
        source, target, moved, rotation, valid = matches
        offset = jnp.where(valid, moved - target.points.T, 0)
        a, b = source.columns[self.name], target.columns[self.name]
        # The unit mean of both normals, whose signs are arbitrary. The sum is at least √2 long: the angle between two
        # lines is at most 90°.
        source_normal, target_normal = jnp.dot(rotation, a.normal.T, precision="highest"), b.normal.T
        total = target_normal + jnp.where(alg.inner(source_normal, target_normal) < 0, -1, 1) * source_normal
        normal = total / jnp.sqrt(alg.inner(total, total))
        near = valid & (alg.inner(offset, offset) <= (_MAX_OFFSET * self.spacing) ** 2)
        values, slopes = [jnp.where(valid, alg.inner(normal, offset), jnp.nan)], [jnp.where(valid, normal, 0)]
        fitted, products = [], []
        for channel in range(self.gains.shape[0]):
            measured = near & ~jnp.isnan(a.value[:, channel]) & ~jnp.isnan(b.value[:, channel])
            source_value, target_value = (jnp.where(measured, fit.value[:, channel], 0) for fit in (a, b))
            turned = self.gains[channel] * jnp.dot(rotation, a.gradient[:, channel].T, precision="highest")
            gradient = b.gradient[:, channel].T
            slope = 0.5 * (gradient + turned)
            predicted = target_value + alg.inner(slope, offset)
            residual = predicted - self.gains[channel] * source_value - self.offsets[channel]
            values.append(jnp.where(measured, residual, jnp.nan))
            slopes.append(jnp.where(measured, slope, 0))
            fitted.append(jnp.where(measured, source_value, jnp.nan))
            products.append(jnp.where(measured, alg.inner(turned, gradient), 0))
        return values, slopes, fitted, products

    def sample(self, matches: PosedMatches) -> Residuals:
        values, slopes, fitted, products = self._residuals(matches)
        moved, rows = jnp.where(matches.valid, matches.moved, 0).T, partial(jnp.stack, axis=1)
        return Residuals(rows(values), jnp.stack(slopes).transpose(2, 0, 1), rows(fitted), rows(products), moved)

    def adapt(self, sample: Residuals, fraction: Float[AnyScalar, ""]) -> Photometric:
        xp = numpy_for(self, sample, fraction)
        # NumPy takes two thirds of the time for contiguous columns.
        values, slopes, fitted, products, moved = (xp.moveaxis(xp.asarray(rows), 0, -1).copy() for rows in sample)
        gains, offsets = self.gains, self.offsets
        if self.equalizes_channels:
            predicted = values[1:] + gains[:, None] * fitted + offsets[:, None]
            gains, offsets = gain_and_offset(fitted.T, predicted.T)
            values = xp.concatenate([values[:1], predicted - gains[:, None] * fitted - offsets[:, None]])
        measured = ~xp.isnan(values)
        slopes = xp.where(measured[:, None], slopes, 0)
        lengths = xp.sum(slopes**2, axis=1)
        number = xp.maximum(xp.sum(measured, axis=1), 1)
        # σ. Residuals of constant parts, which are 0 at any pose, do not count.
        sloping = lengths * number[:, None] > _LEAST_SLOPE**2 * xp.sum(lengths, axis=1, keepdims=True)
        sloping_values = xp.where(sloping, values, xp.nan)
        spread = _PER_MEDIAN * median(xp.abs(sloping_values - median(sloping_values)[:, None]))
        least = _LEAST_OFFSET * self.spacing * xp.sqrt(xp.sum(lengths, axis=1) / number)
        deviations = xp.where(xp.isfinite(spread), xp.maximum(spread, least), 0)
        scale = xp.where(deviations > 0, deviations, 1)[:, None]
        scaled = xp.where(measured, values, 0) / scale
        weights = 1 / (1 + scaled**2 / _KERNEL_SCALE**2)
        scores = (weights * scaled / scale)[:, None] * slopes
        expected = xp.sum(weights * lengths / scale**2, axis=1)
        # The design effects f. Cells are counted without the NaNs of padding, which thus does not change which cells
        # collide; a sample of a part of the points always has the same number of rows.
        size = xp.where(self.spacing > 0, _CELL * self.spacing, 1)
        num_points = xp.maximum(xp.sum(~xp.isnan(moved[0])), 1)
        num_cells = xp.where(fraction < 1, moved.shape[1], num_points).astype(np.int32)
        cells = cell_numbers(tuple(xp.nan_to_num(xp.floor(moved / size)).astype(np.int32)), num_cells)
        # |u|² of each residual, summed over the cells.
        columns = scores.reshape(-1, cells.size)
        if numpy_for(scores, cells) is np:
            sums: Any = np.stack([np.bincount(cells, column) for column in columns], axis=1)
        else:
            sums = jnp.zeros_like(columns.T).at[cells].add(columns.T)
        correlated = (sums**2).sum(axis=0).reshape(scores.shape[:2]).sum(axis=1)
        independent = xp.sum((scores**2).sum(axis=1), axis=1)
        expected = xp.where(expected > 0, expected, 1)
        # In a sample, a cell holds fewer pairs of correlated residuals, by the factor `fraction`.
        designs = xp.maximum((independent + (correlated - independent) / fraction) / expected, 1)
        # The reliabilities q.
        agreeing = xp.sum(weights[1:] * xp.where(measured[1:], products, 0), axis=1)
        assumed = xp.sum(weights[1:] * lengths[1:], axis=1)
        reliability = xp.clip(agreeing / xp.where(assumed > 0, assumed, 1), _LEAST_RELIABILITY, 1)
        designs = designs / xp.concatenate([xp.ones_like(reliability[:1]), reliability])
        numbers = {"deviations": deviations, "designs": designs, "gains": gains, "offsets": offsets}
        return replace(self, **{name: array.astype(self.spacing.dtype) for name, array in numbers.items()})

    def with_numbers_of(self, other: AbstractTerm) -> Photometric:
        names = ("deviations", "designs", "gains", "offsets")
        return replace(self, **{name: jax.lax.stop_gradient(getattr(other, name)) for name in names})

    @property
    def shifts(self) -> Float[AnyArray, "6 3"]:
        """Along +x, −x, +y, −y, +z, −z, metres."""
        xp = numpy_for(self)
        signs = np.repeat(np.eye(3), 2, axis=0) * np.array([[1], [-1]] * 3)
        return _SHIFT * xp.asarray(self.spacing) * signs.astype(self.spacing.dtype)

    def with_response(self, samples: Residuals) -> Photometric:
        """The term with designs divided by the response κ of each residual, so that its stiffness is the true one.

        When points move and are matched again, the sum of the forces changes by a fraction κ of what the slopes
        predict: 0.5 for the colours of posters, 0.5 to 0.75 in the box room, 0.75 for the normals of both. Where slopes
        are large, the fitted values of two neighbouring matches differ by less than the slopes predict.
        """
        xp = numpy_for(self, samples)
        values, slopes = xp.asarray(samples.values), xp.asarray(samples.slopes)
        measured = ~xp.isnan(values) & (self.deviations > 0)
        scale = xp.where(self.deviations > 0, self.deviations, 1)
        scaled = xp.where(measured, values, 0) / scale
        slopes = xp.where(measured[..., None], slopes, 0) / scale[:, None]
        weights = 1 / (1 + scaled**2 / _KERNEL_SCALE**2)
        forces = xp.sum((weights * scaled)[..., None] * slopes, axis=1)
        differences = sum(forces[2 * axis, :, axis] - forces[2 * axis + 1, :, axis] for axis in range(3))
        change = differences / (2 * _SHIFT * self.spacing)
        predicted = xp.sum(weights * xp.sum(slopes**2, axis=3), axis=(0, 1)) / len(values)
        response = change / xp.where(predicted > 0, predicted, 1)
        response = xp.where(predicted > 0, xp.clip(response, _LEAST_RESPONSE, 1), 1)
        return replace(self, designs=self.designs / response.astype(self.designs.dtype))
