"""A photometric term: the channels of matched points are compared where the points are, not where samples are.

A match is a sample and lies up to half a spacing beside the spot that it stands for. A local linear fit v + gᵀx of each
channel over the tangent plane predicts the channel between samples (Park, Zhou & Koltun, Colored Point Cloud
Registration Revisited, ICCV 2017). With p = T a and e = p − b, each correspondence has 1 + C residuals:

    r₀ = nᵀe                            metres, n the unit mean of both normals (Rusinkiewicz 2019)
    r_c = v_c^B + h_cᵀe − v_c^A         channel units, h_c = (g_c^B + R g_c^A) / 2, exact at the midpoint of p and b

Both points contribute the fitted value v, not their sample: a sample beside a slope that was smoothed over a
neighbourhood is biased at edges. v averages the neighbours, moved to the point along g, with weights that decrease with
the squared distance (Epanechnikov): at edges, a neighbour then changes v less as it enters the neighbourhood. The
negative log-likelihood is Σ_k q_k/f_k Σ_i ρ(r_k²/σ_k²), so that all residuals count in standard deviations and no
weight is set by hand. At each pose of the fine phase, `Term.adapted` estimates from the residuals themselves

- σ_k, one scale per residual: 1.4826 times the median absolute deviation. It contains the noise of both samples, that
  of the fits, and what interpolation leaves; channels that disagree, as of a camera that is out of step, get a large
  one.
- f_k, the design effect (Kish 1965): by how much the variance of the summed scores exceeds that of independent ones.
  Residuals of neighbours share samples, exposure and relief, so that n of them are worth n/f_k. With the forces summed
  over cells, u_c: f_k = Σ_c |u_c|² / Σ_i w_i |h_i|²/σ_k², at least 1. (The mean eigenvalue of H^{-1/2} (Σ u uᵀ)
  H^{-1/2} over forces and torques differs by a third and changed errors by at most 3 %.)
- q_k, the reliability of the slopes (Fuller, Measurement Error Models, 1987): Σ w g_Bᵀ R g_A / Σ w |h|², at most 1.
  Noise of the gradients is independent in the two clouds, so that the numerator contains the true slopes alone. A
  motion changes the force by the fraction q of its stiffness; the pose that a channel alone would give has the variance
  f/q² times the inverse stiffness, and multiplying the channel by q combines such poses with minimal variance. A
  channel of pure noise has q ≈ 0. Normals are taken as reliable, q_0 = 1.

These numbers are constants to autodiff.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.concrete import AnyArray, AnyScalar, numpy_for
from mcgicp_jax._local_geometry.covariances import fit_linear
from mcgicp_jax._local_geometry.records import Neighborhoods, Table, features_of, points_of
from mcgicp_jax._local_geometry.spacing_and_noise import gain_and_offset
from mcgicp_jax._math import symmetric_matrices as alg
from mcgicp_jax._math.robust_kernels import AbstractKernel, Cauchy
from mcgicp_jax._math.statistics import cell_numbers, median
from mcgicp_jax._terms.base import Forces

# Scale of the default kernel in standard deviations: weights are those of Student's t with k² = 20 degrees of freedom.
# Errors on RGB-D pairs with 10 instead of 20: 1 % less to 11 % more on four sets, a quarter less (0.06 mm) on rendered
# ones; with 5, a fifth more on the recorded table.
_KERNEL_SCALE = 20**0.5
# Edge of the cells of the design effect, spacings. 5 to 20 made little difference.
_CELL = 10.0
# Radius of the weights of fitted values, in distances to the farthest neighbour. With 1 instead, errors are 3 % less on
# posters, 4 % less on the recorded table and 4 % more on 7-Scenes; with 1.4, 1 % more on the former two.
_VALUE_RADIUS = 1.25
# Spacings: a match further off lies outside the neighbourhood that the channels were fitted over (the 20 nearest of
# randomly placed points lie within 5.4).
_REACH = 5.0
# Least σ, as an offset in spacings: rendered scenes leave no residuals.
_LEAST_OFFSET = 1e-4
# Shift of the points to either side to measure the response, spacings: most matches differ between both ends. With 0.5,
# 0.75 and 1, the squared errors on thirty walls of posters were 1.31, 1.07 and 0.85 times their variance, those of the
# box room (84 pairs) 1.19, 1.03 and 0.85 times.
_SHIFT = 0.75
# Lower bound of the response, dimensionless: sampled, it may be 0 by chance.
_LEAST_RESPONSE = 0.1
# Lower bound of the reliability, dimensionless: sampled, that of noise may be 0, and a design effect must be finite.
_LEAST_RELIABILITY = 1e-3
# Standard deviation of a normal variate over its median absolute deviation.
_PER_MEDIAN = 1.4826
# Columns of the features of a point: normal, then for each channel value and gradient.
_NORMAL, _PER_CHANNEL = 3, 4


class Term(eqx.Module):
    """Numbers of the photometric term, for 1 + C residuals; constants to autodiff.

    Attributes:
        spacing: of the target, metres.
        deviations: σ of each residual, metres and channel units; all 0 while the term is off.
        designs: f/q, design effect over reliability, of each residual.
        gains, offsets: applied to the fitted values of the source's channels; 1 and 0 unless `compensates`.
        compensates: whether gains and offsets are estimated.
    """

    spacing: Float[AnyArray, "*batch"]
    deviations: Float[AnyArray, "*batch K"]
    designs: Float[AnyArray, "*batch K"]
    gains: Float[AnyArray, "*batch C"]
    offsets: Float[AnyArray, "*batch C"]
    compensates: bool = eqx.field(static=True, default=False)

    @staticmethod
    def off(spacing: Float[AnyScalar, ""], num_channels: int) -> Term:
        """The term before its numbers are known."""
        xp = numpy_for(spacing)
        spacing = xp.asarray(spacing)
        zeros, ones = (make(1 + num_channels, spacing.dtype) for make in (xp.zeros, xp.ones))
        return Term(spacing, zeros, ones, ones[1:], zeros[1:])

    @property
    def is_on(self) -> Bool[AnyScalar, ""]:
        return self.deviations[0] > 0

    def evidence(
        self,
        source: Table,
        target: Table,
        moved: Float[Array, "3 n"],
        rotation: Float[Array, "3 3"],
        valid: Bool[Array, "n"],
    ) -> Float[Array, "n L"]:
        """One row per correspondence, from which the numbers are estimated; arguments as of `residuals`."""
        residuals = self.residuals(source, target, moved, rotation, valid)
        return jnp.stack([*residuals.rows, *jnp.where(valid, moved, 0)], axis=1)

    def estimated(self, rows: Float[AnyArray, "n L"], counts: Bool[AnyArray, "n"], valid: Bool[AnyArray, "N"]) -> Term:
        """The term with its numbers estimated from rows of `evidence`; with NumPy where these are concrete.

        Args:
            rows: of an even sample of the source points, see `sampled_rows`.
            counts: which of these rows to use.
            valid: which of all source points are no padding.
        """
        xp = numpy_for(counts, valid)
        return self.adapted(xp.where(counts[:, None], rows, xp.nan), xp.sum(counts) / xp.maximum(xp.sum(valid), 1))

    def residuals(
        self,
        source: Table,
        target: Table,
        moved: Float[Array, "3 n"],
        rotation: Float[Array, "3 3"],
        valid: Bool[Array, "n"],
    ) -> Residuals:
        """The residuals of matched rows of the surfaces' tables; T a = `moved`, metres."""
        offset = jnp.where(valid, moved - points_of(target), 0)
        here, there = features_of(source), features_of(target)
        normal = _mean_direction(jnp.dot(rotation, here[:_NORMAL], precision="highest"), there[:_NORMAL])
        near = valid & (alg.inner(offset, offset) <= (_REACH * self.spacing) ** 2)
        values, slopes = [jnp.where(valid, alg.inner(normal, offset), jnp.nan)], [jnp.where(valid, normal, 0)]
        own, products = [], []
        for channel in range(self.gains.shape[0]):
            start = _NORMAL + _PER_CHANNEL * channel
            a, b = here[start : start + _PER_CHANNEL], there[start : start + _PER_CHANNEL]
            known = near & ~jnp.isnan(a[0]) & ~jnp.isnan(b[0])
            turned = self.gains[channel] * jnp.dot(rotation, a[1:], precision="highest")
            slope = 0.5 * (b[1:] + turned)
            fitted = jnp.where(known, a[0], 0)
            predicted = jnp.where(known, b[0], 0) + alg.inner(slope, offset)
            values.append(jnp.where(known, predicted - self.gains[channel] * fitted - self.offsets[channel], jnp.nan))
            slopes.append(jnp.where(known, slope, 0))
            own.append(jnp.where(known, fitted, jnp.nan))
            products.append(jnp.where(known, alg.inner(turned, b[1:]), 0))
        return Residuals(values, slopes, own, products)

    def forces(self, residuals: Residuals, offset: Float[Array, "3 n"], robust: AbstractKernel | None) -> Forces:
        """Sum of the forces of all residuals.

        Args:
            offset: d = b − T a, metres.
            robust: kernel of each residual in standard deviations. Each has its own weight: a reflection is an outlier
                of the channels, but not of the geometry.
        """
        scale: Any = _KERNEL_SCALE
        kernel = Cauchy(scale) if robust is None else robust
        terms = []
        for k, (value, slope) in enumerate(zip(residuals.values, residuals.slopes, strict=True)):
            counts = (self.deviations[k] > 0) & ~jnp.isnan(value)
            deviation = jnp.where(self.deviations[k] > 0, self.deviations[k], 1)
            share = jnp.where(counts, 1 / self.designs[k], 0)
            scaled, direction = jnp.where(counts, value, 0) / deviation, slope / deviation
            weight = kernel.weight(scaled**2)
            information = share * alg.outer(direction)
            force = -share * weight * scaled * direction
            cost = share * kernel.rho(scaled**2)
            terms.append(Forces(force, weight * information, cost, weight, offset, information))
        return sum(terms[1:], start=terms[0])

    def adapted(self, rows: Float[AnyArray, "n L"], fraction: Float[AnyScalar, ""]) -> Term:
        """The term with its numbers estimated from rows of `evidence`.

        Args:
            rows: of an even sample of the correspondences; NaN in rows to ignore.
            fraction: of all correspondences that are in the sample. A cell contains fewer of their products in this
                proportion, so that f of all exceeds 1 by f − 1 of the sample, divided by the fraction.
        """
        xp = numpy_for(self, rows, fraction)
        count = self.designs.shape[0]
        # NumPy takes two thirds of the time for contiguous columns.
        columns = xp.asarray(rows).T.copy()
        values, slopes, own, products, moved = xp.split(columns, np.cumsum([count, 3 * count, count - 1, count - 1]))
        slopes = slopes.reshape(count, 3, -1)
        gains, offsets = self.gains, self.offsets
        if self.compensates:
            predicted = values[1:] + gains[:, None] * own + offsets[:, None]
            gains, offsets = gain_and_offset(own.T, predicted.T)
            values = xp.concatenate([values[:1], predicted - gains[:, None] * own - offsets[:, None]])
        known = ~xp.isnan(values)
        slopes = xp.where(known[:, None], slopes, 0)
        middle = median(values)[:, None]
        spread = _PER_MEDIAN * median(xp.abs(values - middle))
        lengths = xp.sum(slopes**2, axis=1)
        number = xp.maximum(xp.sum(known, axis=1), 1)
        least = _LEAST_OFFSET * self.spacing * xp.sqrt(xp.sum(lengths, axis=1) / number)
        deviations = xp.where(xp.isfinite(spread), xp.maximum(spread, least), 0)
        scale = xp.where(deviations > 0, deviations, 1)[:, None]
        scaled = xp.where(known, values, 0) / scale
        weights = 1 / (1 + scaled**2 / _KERNEL_SCALE**2)
        scores = (weights * scaled / scale)[:, None] * slopes
        expected = xp.sum(weights * lengths / scale**2, axis=1)
        size = xp.where(self.spacing > 0, _CELL * self.spacing, 1)
        cells = cell_numbers(tuple(xp.nan_to_num(xp.floor(moved / size)).astype(np.int32)), rows.shape[0])
        seen = _squared_sums(scores, cells)
        # Of independent scores, `expected` without the factor.
        alone = xp.sum((scores**2).sum(axis=1), axis=1)
        expected = xp.where(expected > 0, expected, 1)
        designs = xp.maximum((alone + (seen - alone) / fraction) / expected, 1)
        agreeing = xp.sum(weights[1:] * xp.where(known[1:], products, 0), axis=1)
        assumed = xp.sum(weights[1:] * lengths[1:], axis=1)
        reliability = xp.clip(agreeing / xp.where(assumed > 0, assumed, 1), _LEAST_RELIABILITY, 1)
        designs = designs / xp.concatenate([xp.ones_like(reliability[:1]), reliability])
        numbers = {"deviations": deviations, "designs": designs, "gains": gains, "offsets": offsets}
        return replace(self, **{name: array.astype(self.spacing.dtype) for name, array in numbers.items()})

    @property
    def shifts(self) -> Float[AnyArray, "6 3"]:
        """Along +x, −x, +y, −y, +z, −z, metres."""
        xp = numpy_for(self)
        signs = np.repeat(np.eye(3), 2, axis=0) * np.array([[1], [-1]] * 3)
        return _SHIFT * xp.asarray(self.spacing) * signs.astype(self.spacing.dtype)

    def responding(self, rows: Float[AnyArray, "6 n L"]) -> Term:
        """The term with designs divided by the response κ of each residual, so that its stiffness is the true one.

        When points move and match anew, the sum of the forces changes by a fraction κ of what the slopes predict: 0.5
        for the colours of posters, 0.5 to 0.75 in the box room, 0.75 for the normals of both. Between two matches,
        fitted values differ by less than the slope at either says where the slope is large.

        Args:
            rows: of `evidence` for the points moved by each of the `shifts` and matched anew.
        """
        xp, count = numpy_for(self, rows), self.designs.shape[0]
        rows = xp.asarray(rows)
        values, slopes = rows[..., :count], rows[..., count : 4 * count].reshape(*rows.shape[:2], count, 3)
        known = ~xp.isnan(values) & (self.deviations > 0)
        scale = xp.where(self.deviations > 0, self.deviations, 1)
        scaled, slopes = xp.where(known, values, 0) / scale, xp.where(known[..., None], slopes, 0) / scale[:, None]
        weights = 1 / (1 + scaled**2 / _KERNEL_SCALE**2)
        forces = xp.sum((weights * scaled)[..., None] * slopes, axis=1)
        change = sum(forces[2 * axis, :, axis] - forces[2 * axis + 1, :, axis] for axis in range(3)) / (
            2 * _SHIFT * self.spacing
        )
        predicted = xp.sum(weights * xp.sum(slopes**2, axis=3), axis=(0, 1)) / len(rows)
        response = change / xp.where(predicted > 0, predicted, 1)
        response = xp.where(predicted > 0, xp.clip(response, _LEAST_RESPONSE, 1), 1)
        return replace(self, designs=self.designs / response.astype(self.designs.dtype))


def correlated_slopes(
    source: Table, target: Table, rotation: Float[Array, "3 3"], weights: Float[Array, "C"]
) -> Float[Array, "6 n"]:
    """Observability of correspondences by the channels: A / (1 + mean of both traces), A = Σ α² (g_B g_Aᵀ + g_A g_Bᵀ)/2

    Noise of the slopes is independent in the two clouds, so that it does not contribute on average. (To subtract its
    variance from one cloud's slopes instead, as `_observability` does, also subtracts what sharp edges leave.)
    """
    here, there = features_of(source), features_of(target)
    total: Any = 0.0
    length: Any = 0.0
    for channel in range(weights.shape[0]):
        start = _NORMAL + _PER_CHANNEL * channel + 1
        a = weights[channel] * jnp.dot(rotation, here[start : start + 3], precision="highest")
        b = weights[channel] * there[start : start + 3]
        total = total + 0.5 * (alg.outer(a + b) - alg.outer(a) - alg.outer(b))
        length = length + 0.5 * (alg.inner(a, a) + alg.inner(b, b))
    return total / (1 + length)


def _squared_sums(scores: Float[AnyArray, "K 3 n"], cells: Int[AnyArray, "n"]) -> Float[AnyArray, "K"]:
    """Σ_c |u_c|², with u_c the sum of the scores in a cell."""
    columns = scores.reshape(-1, scores.shape[-1])
    if numpy_for(scores, cells) is np:
        sums: Any = np.stack([np.bincount(cells, column) for column in columns], axis=1)
    else:
        sums = jnp.zeros_like(columns.T).at[cells].add(columns.T)
    return (sums**2).sum(axis=0).reshape(scores.shape[:2]).sum(axis=1)


class Residuals(NamedTuple):
    """Residuals of n correspondences; NaN and slope 0 where there is none.

    Attributes:
        values: 1 + C arrays (n,) r_k, metres and channel units.
        slopes: 1 + C arrays (3, n), derivatives of the residuals with respect to T a.
        own: C arrays (n,), fitted channels of the source points.
        products: C arrays (n,), g_Bᵀ R g_A, that of the source multiplied by its gain.
    """

    values: list[Float[Array, "n"]]
    slopes: list[Float[Array, "3 n"]]
    own: list[Float[Array, "n"]]
    products: list[Float[Array, "n"]]

    @property
    def rows(self) -> list[Float[Array, "n"]]:
        """The columns of `Term.evidence`, without the moved points that follow them."""
        return [*self.values, *(axis for slope in self.slopes for axis in slope), *self.own, *self.products]


def features_of_points(around: Neighborhoods, normal: Float[Array, "3 n"]) -> Float[Array, "L n"]:
    """Normal, and for each channel its value at the point (NaN where unknown) and the gradient of its linear fit.

    The gradient, per metre, lies in the tangent plane. Differentiable with respect to points and channels.
    """
    offsets = [around.offset(axis) for axis in range(3)]
    basis = alg.orthonormal_basis(normal)
    x, y = (sum(offset * b for offset, b in zip(offsets, axis, strict=True)) for axis in basis)
    square: Any = sum(offset * offset for offset in offsets)
    farthest = _VALUE_RADIUS**2 * jnp.max(square, axis=0)
    kernel = 1 - square / jnp.where(farthest > 0, farthest, 1)
    columns = [normal]
    for channel in range(around.num_channels):
        known = around.present if around.near_known is None else around.near_known[channel]
        values = around.difference(channel)
        fit = fit_linear(x, y, values, known.astype(x.dtype))
        gx, gy = fit.gradient
        weights = jnp.where(known, kernel, 0)
        total = jnp.sum(weights, axis=0)
        value = jnp.sum(weights * (values - gx * x - gy * y), axis=0) / jnp.where(total > 0, total, 1)
        enough = (fit.weight > 3) & (fit.inverse[0] > 0)
        if around.own_known is not None:
            enough = enough & around.own_known[channel]
        value = jnp.where(enough, around.own_channels[channel] + value, jnp.nan)
        columns += [value[None], jnp.where(enough, gx * basis[0] + gy * basis[1], 0)]
    return jnp.concatenate(columns)


def _mean_direction(a: Float[Array, "3 n"], b: Float[Array, "3 n"]) -> Float[Array, "3 n"]:
    """Unit mean of two lines, given by unit vectors of either sign."""
    total = b + jnp.where(alg.inner(a, b) < 0, -1, 1) * a
    # At least √2 long: the angle between two lines is at most 90°.
    return total / jnp.sqrt(alg.inner(total, total))
