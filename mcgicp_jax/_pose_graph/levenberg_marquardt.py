"""Levenberg-Marquardt on pose graphs of any size, on the host, with sparse normal equations.

The equations have blocks of six unknowns per pose; SciPy factors them. The Gauss-Newton matrix is H = Σ w JᵀΛJ, for
twists ξ of T exp(ξ). The damping is λD, where D = Σ CᵀSC measures changes Cξ of the motions between poses that share a
measurement, with a typical information S. Damped steps are then small in *relative* motions, and directions that no
measurement observes, such as the way along a corridor, are distributed evenly over the edges.

optimistix solves for its steps inside a compiled program, which cannot contain a factorisation on the host and would be
compiled for every graph; so the loop is written out here.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Inexact, Int

from mcgicp_jax._math.poses import exponential
from mcgicp_jax._pose_graph.edge import WORLD, AbstractFactor, motion_jacobians

# Poses of the graph and, with measurements in the world's frame, the world's; a number for every measurement.
Poses: TypeAlias = Float[np.ndarray, "n 4 4"]
PerMeasurement: TypeAlias = Float[np.ndarray, "m"]

# Least damping, as a fraction of the information of a typical edge. Directions that no measurement observes are then
# 3e4 times as uncertain as a typical edge, and the factorisation loses half of the digits of float64.
LEAST_DAMPING = 1e-9
# Damping, as a fraction of the information of a typical edge: at the start, the factor by which it changes, and the
# largest one, beyond which the loop ends.
_START_DAMPING, _DAMPING_FACTOR, _MOST_DAMPING = 1e-4, 10.0, 1e12
# A step is the last one if it lowers the cost by less than this fraction, as predicted. Next to the minimum of noisy
# graphs a step was seen to lower it by 1e-2 to 1e-3 of the previous decrease: the cost is then right to 1e-8.
_TOLERANCE = 1e-6
# The same in σ², for graphs without contradiction: a step of a millionth of a standard deviation.
_LEAST_DECREASE = 1e-12
# Largest number of steps of `refine`, each of which reduces the error by a factor of 10 or more, and the relative size
# of the last one.
_REFINEMENTS, _ROUNDING = 10, 1e-13
# Weight of the measurements of the start in `settle`. From an exact start, poses in corridors slide by up to 0.49 m
# without `settle`, and by 0.12, 0.03 and 0.01 m with weights of 1, 2 and 3. More holds back what loops measure: on a
# sphere started from odometry, with edges that know nothing of x, errors are 8.8 m without, and 7.8, 10.5 and 12.7 m.
_START_WEIGHT = 2.0


class Terms(NamedTuple):
    """Squared residuals, gradients and Gauss-Newton blocks of all measurements at given poses.

    Attributes:
        squares: rᵀΛr of every measurement, the squared Mahalanobis distance.
        gradient: JᵀΛr, for both poses of every measurement.
        blocks: JᵀΛJ of every measurement, by first and second pose.
    """

    squares: PerMeasurement
    gradient: Float[np.ndarray, "m 2 6"]
    blocks: Float[np.ndarray, "m 2 2 6 6"]

    def cost(self, weights: PerMeasurement) -> float:
        """½ Σ w rᵀΛr."""
        return 0.5 * float(weights @ self.squares)


class NormalEquations:
    """The sparse equations (H + λD) ξ = −g of a graph.

    If there are measurements in the world's frame, the last pose is that of the world, the identity, and is fixed. Of
    every other connected part, the first pose is fixed. The elimination order (minimum degree on the graph of poses)
    and the place of every block in the matrix are computed once. Measurements that are not in use have no place: false
    loops between distant poses would fill the factors.

    Attributes:
        factors: all measurements, the edges first. Measurements are numbered in this order.
        rows: (m, 2) rows of the poses of every measurement.
        used: (m,) which measurements are in use.
        place: place of each pose in the elimination order; −1 for poses that are fixed.
        fixed: which poses do not move.
        parts: number of the connected part of each pose.
        root: the fixed pose to which covariances refer: the first one, or the world.
        metric: the sparse matrix D, at the given poses.
    """

    def __init__(self, factors: tuple[AbstractFactor, ...], poses: Poses, used: Bool[np.ndarray, "m"] | None = None):
        # Imported late, as SciPy's sparse matrices take a tenth of the import time of the package.
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        self.factors, self._start, num_poses = factors, poses, len(poses)
        rows = np.concatenate([np.asarray(factor.rows) for factor in factors])
        self.root = num_poses - 1 if np.any(rows == WORLD) else 0
        self.rows = np.where(rows == WORLD, self.root, rows)
        self.used = np.ones(len(rows), bool) if used is None else used
        # Poses of the rows and of the columns of the four blocks of each measurement.
        self._first, self._second = np.repeat(self.rows, 2, axis=1), np.tile(self.rows, 2)
        ends = self._first[self.used].ravel(), self._second[self.used].ravel()
        graph = coo_array((np.ones(len(ends[0])), ends), (num_poses, num_poses))
        _, self.parts = connected_components(graph, directed=False)
        fixed = np.unique(self.parts, return_index=True)[1]
        fixed[self.parts[self.root]] = self.root
        self.fixed = np.zeros(num_poses, bool)
        self.fixed[fixed] = True
        self.place = np.full(num_poses, -1)
        self.place[~self.fixed] = _elimination_order(graph, self.fixed)
        self._lay_out()
        typical = typical_information(*factors)[..., None] * np.eye(6)
        self.metric = self.matrix(normal_blocks(motion_jacobians(poses[self.rows]), typical))

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 6 * int((~self.fixed).sum())

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """Values of all measurements, by kind."""
        return np.split(values, np.cumsum([len(factor.information) for factor in self.factors])[:-1])

    def restricted(self, used: Bool[np.ndarray, "m"]) -> NormalEquations:
        """The equations of some of the measurements."""
        return self if np.array_equal(used, self.used) else NormalEquations(self.factors, self._start, used)

    def terms(self, poses: Poses) -> Terms:
        """Evaluate all measurements."""
        found = []
        for factor, rows in zip(self.factors, self.split(self.rows), strict=True):
            residuals, jacobians = factor.linearize(poses[rows])
            information = np.asarray(factor.information)
            forces = (information @ residuals[..., None])[..., 0]
            gradient = (jacobians.swapaxes(2, 3) @ forces[:, None, :, None])[..., 0]
            blocks = normal_blocks(jacobians, information)
            found.append((np.einsum("mi,mi->m", residuals, forces), gradient, blocks))
        return Terms(*(np.concatenate(each) for each in zip(*found, strict=True)))

    def gradient(self, terms: Terms, weights: PerMeasurement) -> Float[np.ndarray, "size"]:
        """g, in the elimination order."""
        weighted = (weights[:, None, None] * terms.gradient).reshape(-1, 6)
        ends, number = self.rows.ravel(), len(self.place)
        return self.gathered(np.stack([np.bincount(ends, each, number) for each in weighted.T], axis=1))

    def gathered(self, rows: Float[np.ndarray, "n *k"]) -> Float[np.ndarray, "size"]:
        """Rows of the poses as a vector of the unknowns."""
        vector = np.empty(((~self.fixed).sum(), *rows.shape[1:]))
        vector[self.place[~self.fixed]] = rows[~self.fixed]
        return vector.reshape(-1)

    def spread(self, vector: Float[np.ndarray, "size *k"]) -> Float[np.ndarray, "n 6 *k"]:
        """A vector of the unknowns as rows of the poses, 0 for fixed poses."""
        rows = np.zeros((len(self.place), 6, *vector.shape[1:]))
        rows[~self.fixed] = vector.reshape(-1, *rows.shape[1:])[self.place[~self.fixed]]
        return rows

    def weighted(self, blocks: Float[np.ndarray, "m 2 2 6 6"], weights: Inexact[np.ndarray, "m"]) -> Any:
        """The sparse matrix of the blocks of all measurements, such as H."""
        return self.matrix(weights[:, None, None, None, None] * blocks)

    def matrix(self, blocks: Inexact[np.ndarray, "m 2 2 6 6"]) -> Any:
        """The sparse symmetric matrix of the sum of all blocks."""
        from scipy.sparse import bsr_array, csc_array

        if not self.size:
            return csc_array((0, 0))
        summed = np.add.reduceat(blocks.reshape(-1, 6, 6)[self._order], self._starts)
        rows = bsr_array((summed, self._columns, self._pointers), (self.size, self.size)).tocsr()
        # Rows of a symmetric matrix are its columns.
        return csc_array((rows.data, rows.indices, rows.indptr), rows.shape)

    def damped(self, matrix: Any, damping: float = LEAST_DAMPING) -> Any:
        """H + λD; all matrices have their entries at the same places."""
        total = matrix.copy()
        total.data += damping * self.metric.data
        return total

    def _lay_out(self) -> None:
        """Places of the blocks in compressed rows of blocks."""
        rows, columns = self.place[self._first].ravel(), self.place[self._second].ravel()
        inside = np.flatnonzero((rows >= 0) & (columns >= 0) & np.repeat(self.used, 4))
        self._order = inside[np.lexsort((columns[inside], rows[inside]))]
        rows, columns = rows[self._order], columns[self._order]
        new = np.ones(len(rows), bool)
        new[1:] = (rows[1:] != rows[:-1]) | (columns[1:] != columns[:-1])
        self._starts, self._columns = np.flatnonzero(new), columns[new].astype(np.int32)
        counts = np.bincount(rows[new], minlength=self.size // 6)
        self._pointers = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)


def factored(matrix: Any) -> Any:
    """`SuperLU` of a sparse symmetric positive definite matrix whose unknowns are in the elimination order.

    Raises:
        RuntimeError: if the matrix is singular.
    """
    from scipy.sparse.linalg import splu

    return splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def normal_blocks(
    jacobians: Float[np.ndarray, "m 2 d 6"], information: Float[np.ndarray, "m d d"]
) -> Float[np.ndarray, "m 2 2 6 6"]:
    """JᵀΛJ of every measurement, by first and second pose."""
    weighted = information[:, None] @ jacobians
    return jacobians.swapaxes(2, 3)[:, :, None] @ weighted[:, None]


def typical_information(*factors: AbstractFactor) -> Float[np.ndarray, "m 6"]:
    """Diagonal of S for every measurement: the median over edges of the mean information, in translation and rotation.

    Measurements in the world's frame have their own: next to motions known to millimetres, positions known to metres
    would else look unconstrained.
    """
    of_world = np.concatenate([(np.asarray(factor.rows) == WORLD).any(axis=1) for factor in factors])
    diagonal = np.diagonal(np.asarray(factors[0].information), axis1=1, axis2=2).reshape(-1, 2, 3).mean(axis=2)
    typical, edges_of_world = np.ones((len(of_world), 2)), of_world[: len(diagonal)]
    for counted, chosen in ((~edges_of_world, slice(None)), (edges_of_world, of_world)):
        for kind, values in enumerate(diagonal.T):
            known = values[counted & (values > 0)]
            if len(known):
                typical[chosen, kind] = np.median(known)
    return np.repeat(typical, 3, axis=1)


def _elimination_order(graph: Any, fixed: Bool[np.ndarray, "n"]) -> Int[np.ndarray, "k"]:
    """Place of each free pose in an elimination order with little fill, minimum degree by SuperLU."""
    from scipy.sparse import eye_array
    from scipy.sparse.linalg import splu

    free = ~fixed
    if not free.any():
        return np.zeros(0, int)
    pattern = graph.tocsr()[free][:, free]
    pattern.data[:] = -1.0
    # Diagonally dominant, so that the factorisation exists.
    dominant = pattern + eye_array(pattern.shape[0]) * (2.0 + np.diff(pattern.indptr).max())
    options = {"SymmetricMode": True}
    factors = splu(dominant.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return factors.perm_c


class Minimum(NamedTuple):
    """State at the end of the loop.

    Attributes:
        poses: those of the graph and, with measurements in the world's frame, the world's.
        terms: of all measurements at these poses.
        num_iterations: number of steps, rejected ones included.
        converged: whether the last step was small.
        damping: λ for a next step.
    """

    poses: Poses
    terms: Terms
    num_iterations: int = 0
    converged: bool = False
    damping: float = _START_DAMPING


def minimize(equations: NormalEquations, start: Minimum, weights: PerMeasurement, max_iterations: int) -> Minimum:
    """Lower ½ Σ w rᵀΛr by Levenberg-Marquardt steps until one lowers it by no more than tolerance and rounding.

    The weights of measurements that are not in use are 0.
    """
    poses, terms, count, _, damping = start
    cost, system = terms.cost(weights), None
    end = count + max_iterations
    if not equations.size:
        return start._replace(converged=True)
    while count < end and damping < _MOST_DAMPING and np.isfinite(cost):
        if system is None:
            gradient, system = equations.gradient(terms, weights), equations.weighted(terms.blocks, weights)
        count += 1
        try:
            step = -factored(equations.damped(system, damping)).solve(gradient)
        except RuntimeError:
            damping *= _DAMPING_FACTOR
            continue
        decrease = -0.5 * float(gradient @ step)
        trial = poses @ exponential(equations.spread(step))
        there = equations.terms(trial)
        after = there.cost(weights)
        small = decrease <= _TOLERANCE * cost + _LEAST_DECREASE
        # Rounding decides whether the computed cost becomes lower by so little.
        if after <= cost * (1 + (_TOLERANCE if small else 1e-14)) + _LEAST_DECREASE:
            poses, terms, cost, system = trial, there, after, None
            damping = max(damping / _DAMPING_FACTOR, LEAST_DAMPING)
            if small:
                return Minimum(poses, terms, count, True, damping)
        else:
            damping *= _DAMPING_FACTOR
    return Minimum(poses, terms, count, False, damping)


def refine(equations: NormalEquations, found: Minimum, weights: PerMeasurement) -> Minimum:
    """The minimum to rounding, by more Gauss-Newton steps: derivatives are as exact as the poses."""
    for _ in range(_REFINEMENTS):
        after = minimize(equations, found._replace(damping=LEAST_DAMPING), weights, 1)
        step = np.abs(after.poses - found.poses).max()
        found = after._replace(num_iterations=found.num_iterations, converged=True)
        if step <= _ROUNDING * np.abs(found.poses).max():
            break
    return found


def settle(
    equations: NormalEquations, found: Minimum, weights: PerMeasurement, start: Bool[np.ndarray, "m"]
) -> Minimum:
    """Take back what noise has moved along directions that only the measurements of the `start` constrain.

    Against these, measurements that leak information μ there would weigh μ/ε, with ε that of the start. If ε is
    imaginary, the real part of the step is −(μg + ε²b)/(μ² + ε²), for gradients g and εb of both: where it vanishes,
    they weigh (μ/ε)², and the start weighs no more than (ε/μ)² along the directions that are measured.
    """
    size, started = np.inf, _START_WEIGHT * start
    for _ in range(_REFINEMENTS):
        system = equations.weighted(found.terms.blocks, weights * ~start + 1j * started)
        gradient = equations.gradient(found.terms, weights * ~start) + 1j * equations.gradient(found.terms, started)
        step = -factored(equations.damped(system)).solve(gradient).real
        # Rounding, or no contraction.
        if not np.abs(step).max() < size:
            break
        size = np.abs(step).max()
        poses = found.poses @ exponential(equations.spread(step))
        found = found._replace(poses=poses, terms=equations.terms(poses))
    return found
