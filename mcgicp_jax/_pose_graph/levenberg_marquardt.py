"""Levenberg-Marquardt on pose graphs of any size, on the host, with sparse normal equations.

The Gauss-Newton matrix is H = Σ w JᵀΛJ, for twists ξ of T exp(ξ). The damping is λD, where D = Σ CᵀSC measures changes
Cξ of the motions between poses that share a measurement, with a typical information S. Damped steps are then small in
*relative* motions, and unobserved motions, such as along a corridor, are distributed evenly over the edges. (optimistix
would compile its loop for every graph.)
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.sparse import bsr_array, coo_array, csc_array, eye_array

from mcgicp_jax._math.poses import exponential
from mcgicp_jax._pose_graph.edge import WORLD, Factors, motion_jacobians

# Poses of the graph and, if measurements are in the world's frame, of the world. A number and a choice per measurement.
Poses: TypeAlias = Float[np.ndarray, "n 4 4"]
PerMeasurement: TypeAlias = Float[np.ndarray, "m"]
Mask: TypeAlias = Bool[np.ndarray, "m"]

# Least damping, as a fraction of the information of a typical edge: unobserved directions are 3e4 times as uncertain as
# such an edge, and the factorisation loses half of the digits of float64.
LEAST_DAMPING = 1e-9
# Initial damping (same fraction), the factor by which it changes, and largest damping.
_START_DAMPING, _DAMPING_FACTOR, _MOST_DAMPING = 1e-4, 10.0, 1e12
# A step is the last one if it is predicted to lower the cost by less than this fraction. Near the minimum of noisy
# graphs, each step was seen to lower it by 1e-2 to 1e-3 of the previous decrease: the cost is then right to 1e-8.
_TOLERANCE = 1e-6
# The same in σ², for graphs without contradiction: a step of a millionth of a standard deviation.
_LEAST_DECREASE = 1e-12


class Terms(NamedTuple):
    """Squared residuals rᵀΛr, gradients JᵀΛr and Gauss-Newton blocks JᵀΛJ of all measurements at given poses."""

    squares: PerMeasurement
    gradient: Float[np.ndarray, "m 2 6"]
    blocks: Float[np.ndarray, "m 2 2 6 6"]


class NormalEquations:
    """The sparse equations (H + λD) ξ = −g of a graph.

    With measurements in the world's frame, the last pose is that of the world, the identity, and is fixed. The first
    pose of every other connected part is fixed. Measurements that are not in use have no place in the matrix: false
    loops between distant poses would fill the factors.

    Attributes:
        factors: all measurements, numbered in this order, the edges first; `rows` (m, 2) and `in_use` (m,) are theirs.
        order: the poses that move, in the elimination order, which is that of the unknowns.
        parts: number of the connected part of each pose.
        root: the fixed pose to which covariances refer: the first one, or the world.
        metric: the sparse matrix D at the initial poses.
    """

    def __init__(self, factors: Factors, poses: Poses, in_use: Mask):
        from scipy.sparse.csgraph import connected_components

        self.factors, self.initial_poses, self.in_use, num_poses = factors, poses, in_use, len(poses)
        rows = np.concatenate([np.asarray(factor.rows) for factor in factors])
        self.root = num_poses - 1 if np.any(rows == WORLD) else 0
        self.rows = np.where(rows == WORLD, self.root, rows)
        # Row and column, as poses, of the four blocks of each measurement.
        block_rows, block_columns = np.repeat(self.rows, 2, axis=1), np.tile(self.rows, 2)
        entries = block_rows[in_use].ravel(), block_columns[in_use].ravel()
        graph = coo_array((np.ones(len(entries[0])), entries), (num_poses, num_poses))
        _, self.parts = connected_components(graph, directed=False)
        first_of_parts = np.unique(self.parts, return_index=True)[1]
        first_of_parts[self.parts[self.root]] = self.root
        self.order = np.delete(np.arange(num_poses), first_of_parts)
        self.size = 6 * len(self.order)
        if self.size:
            # SuperLU's minimum-degree order has little fill. A dominant diagonal lets the factorisation exist.
            pattern = graph.tocsr()[self.order][:, self.order]
            pattern.data[:] = -1.0
            dominant = pattern + eye_array(pattern.shape[0]) * (2.0 + np.diff(pattern.indptr).max())
            self.order = self.order[np.argsort(factored(dominant.tocsc(), "MMD_AT_PLUS_A").perm_c)]
        place = np.full(num_poses, -1)
        place[self.order] = np.arange(len(self.order))
        # Places of the blocks in compressed rows of blocks; blocks at the same place are summed.
        rows, columns = place[block_rows].ravel(), place[block_columns].ravel()
        inside = np.flatnonzero((rows >= 0) & (columns >= 0) & np.repeat(in_use, 4))
        keys = rows[inside] * num_poses + columns[inside]
        by_place = np.argsort(keys, kind="stable")
        self._blocks = inside[by_place]
        keys, self._starts = np.unique(keys[by_place], return_index=True)
        self._columns = (keys % num_poses).astype(np.int32)
        self._pointers = np.searchsorted(keys, num_poses * np.arange(len(self.order) + 1)).astype(np.int32)
        typical = typical_information(factors)[..., None] * np.eye(6)
        self.metric = self.matrix(normal_blocks(motion_jacobians(poses[self.rows]), typical), in_use)

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """Views of the values of the measurements of each factor."""
        return np.split(values, np.cumsum([len(factor.information) for factor in self.factors])[:-1])

    def terms(self, poses: Poses) -> Terms:
        by_factor = []
        for factor, rows in zip(self.factors, self.split(self.rows), strict=True):
            residuals, jacobians = factor.linearize(poses[rows])
            information = np.asarray(factor.information)
            forces = (information @ residuals[..., None])[..., 0]
            squares = np.einsum("mi,mi->m", residuals, forces)
            gradient = (jacobians.swapaxes(2, 3) @ forces[:, None, :, None])[..., 0]
            by_factor.append((squares, gradient, normal_blocks(jacobians, information)))
        return Terms(*map(np.concatenate, zip(*by_factor, strict=True)))

    def gradient(self, terms: Terms, weights: PerMeasurement) -> Float[np.ndarray, "_"]:
        """g, in the elimination order."""
        weighted = (weights[:, None, None] * terms.gradient).reshape(-1, 6)
        sums = [np.bincount(self.rows.ravel(), column, len(self.parts)) for column in weighted.T]
        return np.stack(sums, axis=1)[self.order].reshape(-1)

    def spread(self, vector: Float[np.ndarray, "_ *k"]) -> Float[np.ndarray, "n 6 *k"]:
        """A vector of the unknowns as rows of all poses, 0 for fixed ones."""
        rows = np.zeros((len(self.parts), 6, *vector.shape[1:]))
        rows[self.order] = vector.reshape(-1, *rows.shape[1:])
        return rows

    def matrix(self, blocks: Float[np.ndarray, "m 2 2 6 6"], weights: Shaped[np.ndarray, "m"]) -> Any:
        """The sparse symmetric sum of the weighted blocks of all measurements; with JᵀΛJ, it is H."""
        if not self.size:
            return csc_array((0, 0))
        weighted = weights[:, None, None, None, None] * blocks
        summed = np.add.reduceat(weighted.reshape(-1, 6, 6)[self._blocks], self._starts)
        matrix = bsr_array((summed, self._columns, self._pointers), (self.size, self.size)).tocsr()
        # Rows of a symmetric matrix are its columns.
        return csc_array((matrix.data, matrix.indices, matrix.indptr), matrix.shape)

    def damped(self, matrix: Any, damping: float = LEAST_DAMPING) -> Any:
        """H + λD; all matrices have their entries at the same places."""
        total = matrix.copy()
        total.data += damping * self.metric.data
        return total


def factored(matrix: Any, order: str = "NATURAL") -> Any:
    """`SuperLU` of a sparse symmetric positive definite matrix. Raises `RuntimeError` if it is singular."""
    from scipy.sparse.linalg import splu

    return splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def normal_blocks(
    jacobians: Float[np.ndarray, "m 2 d 6"], information: Float[np.ndarray, "m d d"]
) -> Float[np.ndarray, "m 2 2 6 6"]:
    weighted = information[:, None] @ jacobians
    return jacobians.swapaxes(2, 3)[:, :, None] @ weighted[:, None]


def typical_information(factors: Factors) -> Float[np.ndarray, "m 6"]:
    """Diagonal of S for every measurement: the median over edges of the mean information in translation and rotation.
    Measurements in the world's frame have the median over priors: next to motions known to millimetres, positions known
    to metres would else look unconstrained."""
    of_world = np.concatenate([(np.asarray(factor.rows) == WORLD).any(axis=1) for factor in factors])
    means = np.diagonal(np.asarray(factors[0].information), axis1=1, axis2=2).reshape(-1, 2, 3).mean(axis=2)
    typical, priors = np.ones((len(of_world), 2)), of_world[: len(means)]
    for edges, measurements in ((~priors, slice(None)), (priors, of_world)):
        for column, values in enumerate(means.T):
            positive = values[edges & (values > 0)]
            if len(positive):
                typical[measurements, column] = np.median(positive)
    return np.repeat(typical, 3, axis=1)


class GraphState(NamedTuple):
    """A state of the optimisation; `converged` if the last step was small."""

    equations: NormalEquations
    # 0 for measurements that are not in use.
    weights: PerMeasurement
    poses: Poses
    terms: Terms
    # Rejected steps included.
    num_iterations: int = 0
    converged: bool = False
    # λ of the next step.
    damping: float = _START_DAMPING

    @classmethod
    def at(
        cls, factors: Factors, weights: PerMeasurement, poses: Poses, initial_poses: Poses | None = None
    ) -> GraphState:
        """`initial_poses`: those at which damping measures motions; `poses` by default."""
        equations = NormalEquations(factors, poses if initial_poses is None else initial_poses, weights > 0)
        return cls(equations, weights, poses, equations.terms(poses))

    def weighted(self, weights: PerMeasurement) -> GraphState:
        equations, in_use = self.equations, weights > 0
        if not np.array_equal(in_use, equations.in_use):
            equations = NormalEquations(equations.factors, equations.initial_poses, in_use)
        return self._replace(weights=weights, equations=equations)

    def moved(self, step: Float[np.ndarray, "_"]) -> GraphState:
        poses = self.poses @ exponential(self.equations.spread(step))
        return self._replace(poses=poses, terms=self.equations.terms(poses))

    @property
    def cost(self) -> float:
        return 0.5 * float(self.weights @ self.terms.squares)

    @property
    def hessian(self) -> Any:
        return self.equations.matrix(self.terms.blocks, self.weights)


def minimize(state: GraphState, max_iterations: int) -> GraphState:
    """Lower ½ Σ w rᵀΛr by Levenberg-Marquardt steps until one lowers it by no more than tolerance and rounding."""
    equations, damping, count, system = state.equations, state.damping, 0, None
    if not equations.size:
        return state._replace(converged=True)
    state, cost = state._replace(converged=False), state.cost
    while not state.converged and count < max_iterations and damping < _MOST_DAMPING and np.isfinite(cost):
        if system is None:
            gradient, system = equations.gradient(state.terms, state.weights), state.hessian
        count += 1
        try:
            step = -factored(equations.damped(system, damping)).solve(gradient)
        except RuntimeError:
            damping *= _DAMPING_FACTOR
            continue
        decrease = -0.5 * float(gradient @ step)
        trial = state.moved(step)
        small = decrease <= _TOLERANCE * cost + _LEAST_DECREASE
        # Rounding decides whether the computed cost becomes lower by so little.
        if trial.cost <= cost * (1 + (_TOLERANCE if small else 1e-14)) + _LEAST_DECREASE:
            state, cost, system = trial._replace(converged=small), trial.cost, None
            damping = max(damping / _DAMPING_FACTOR, LEAST_DAMPING)
        else:
            damping *= _DAMPING_FACTOR
    return state._replace(num_iterations=state.num_iterations + count, damping=damping)
