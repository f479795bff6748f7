"""Levenberg-Marquardt on pose graphs of any size: residuals in blocks of edges, normal equations factored by SciPy.

optimistix solves for its steps inside a compiled program, of which a factorisation on the host cannot be part, and it
would compile for every graph; so the loop is written out here. The residual of an edge is r = log(T_i_j⁻¹ T_i⁻¹ T_j),
and poses move by T exp(ξ). The Gauss-Newton matrix is H = Σ w Jᵀ Λ J. The damping is λ D, where D = Σ Jᵀ S J with a
typical information S for all edges: steps are then small where they change *relative* motions, and what no edge
measures, as the way along a corridor, is spread evenly over the edges.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._blocks import map_rows
from mcgicp_jax._pose import parameters_of
from mcgicp_jax._pose_graph import WORLD, Edge

# Edges or poses of a block: small, since most graphs are. Blocks of 2,048 take 4 times as long for 300 edges.
_BLOCK = 256
# Damping, as a fraction of the information of a typical edge: at the start, least, and the factor by which it changes.
# The least one leaves what no edge measures 3e4 times as uncertain as a typical edge, and the factorisation half of
# the digits of float64.
START_DAMPING, LEAST_DAMPING, DAMPING_FACTOR = 1e-4, 1e-9, 10.0
_MOST_DAMPING = 1e12
# A direction of motion is unconstrained if its information is less than this fraction of that of a typical edge.
UNCONSTRAINED = 10 * LEAST_DAMPING
# A step is the last one if it lowers the cost by less than this fraction, as predicted. Next to the minimum of noisy
# graphs a step was seen to lower it by 1e-2 to 1e-3 of what the one before did: the cost is then right to 1e-8.
TOLERANCE = 1e-6
# Entries of the factors per entry of the matrix beyond which conjugate gradients are quicker. With half of the loops
# false, the sphere of 2,500 poses has 53 and the garage of 1,600 has 38: conjugate gradients then take a tenth of the
# time. At 12 to 20 they take as long as the factorisation. Without false loops they have 6 and 2.
_LARGEST_FILL = 20.0
# Relative residual of conjugate gradients, which serve for steps far from the minimum, and largest number of products.
_RESIDUAL, _MOST_PRODUCTS = 1e-2, 300
# The same in σ², for graphs without contradiction: a step of a millionth of a standard deviation.
LEAST_DECREASE = 1e-12


def residual_of(
    start: Float[Array, "7"], end: Float[Array, "7"], measured: Float[Array, "7"]
) -> tuple[Float[Array, "6"], Float[Array, "6 6"], Float[Array, "6 6"]]:
    """Residual of an edge, its derivative by the twist of the end, and that of the end's twist by the start's.

    Poses are quaternion wxyz and translation. The derivative of the logarithm is that of autodiff: the closed form
    `jaxlie.SE3.jlog` (1.5) loses all digits at rotations of 1e-5.
    """
    motion = jaxlie.SE3(start).inverse() @ jaxlie.SE3(end)
    error = jaxlie.SE3(measured).inverse() @ motion

    def moved(twist: Float[Array, "6"]) -> Float[Array, "6"]:
        return (error @ jaxlie.SE3.exp(twist)).log()

    dtype = start.dtype
    by_end, change = jax.jacfwd(moved)(jnp.zeros_like(start[:6])), -motion.inverse().adjoint()
    return error.log().astype(dtype), by_end.astype(dtype), change.astype(dtype)


@jax.jit
@jax.vmap
def _terms(
    start: Float[Array, "7"], end: Float[Array, "7"], measured: Float[Array, "7"], information: Float[Array, "6 6"]
) -> tuple[Float[Array, ""], Float[Array, "2 6"], Float[Array, "3 6 6"]]:
    """rᵀΛr; the gradient of half of it by both twists; and the blocks ii, jj, ij of JᵀΛJ."""
    residual, by_end, change = residual_of(start, end, measured)
    force = by_end.T @ (information @ residual)
    at_end = by_end.T @ information @ by_end
    mixed = change.T @ at_end
    blocks = jnp.stack([mixed @ change, at_end, mixed])
    return residual @ information @ residual, jnp.stack([change.T @ force, force]), blocks


@jax.jit
@jax.vmap
def _residuals(start: Float[Array, "7"], end: Float[Array, "7"], measured: Float[Array, "7"]) -> Float[Array, "6"]:
    return residual_of(start, end, measured)[0]


@jax.jit
@jax.vmap
def _moved(pose: Float[Array, "7"], twist: Float[Array, "6"]) -> Float[Array, "7"]:
    return (jaxlie.SE3(pose) @ jaxlie.SE3.exp(twist)).normalize().wxyz_xyz


def moved_by(poses: Float[np.ndarray, "n 7"], twists: Float[np.ndarray, "n 6"]) -> Float[np.ndarray, "n 7"]:
    """T exp(ξ) for every pose; in float64."""
    with jax.enable_x64(True):
        return map_rows(lambda rows: _moved(poses[rows], twists[rows]), len(poses), size=_BLOCK)


@jax.jit
@jax.vmap
def _relative_twists(start: Float[Array, "7"], end: Float[Array, "7"]) -> Float[Array, "6 6"]:
    return -(jaxlie.SE3(end).inverse() @ jaxlie.SE3(start)).adjoint()


def relative_twists(start: Float[np.ndarray, "k 7"], end: Float[np.ndarray, "k 7"]) -> Float[np.ndarray, "k 6 6"]:
    """Derivative of the twist of T_start⁻¹ T_end by that of T_start; in float64."""
    with jax.enable_x64(True):
        return map_rows(lambda rows: _relative_twists(start[rows], end[rows]), len(start), size=_BLOCK)


@dataclass(frozen=True, eq=False)
class Terms:
    """What the edges say at some poses.

    Attributes:
        squares: rᵀΛr of every edge, the squared Mahalanobis distance.
        gradient: of half of it, by the twists of both poses.
        blocks: see `_terms`.
    """

    squares: Float[np.ndarray, "m"]
    gradient: Float[np.ndarray, "m 2 6"]
    blocks: Float[np.ndarray, "m 3 6 6"]

    def cost(self, weights: Float[np.ndarray, "m"]) -> float:
        """½ Σ w rᵀΛr."""
        return 0.5 * float(weights @ self.squares)


class NormalEquations:
    """The sparse equations (H + λD) ξ = −g of a graph.

    Edges from the world start at the last pose, the identity, which is then held. Of every other connected part, the
    first pose is held. The order of elimination is found once, by minimum degree on the
    graph of poses, and so is the place of every block in the matrix.

    Only edges in use have a place: false loops between distant poses would fill the factors with numbers.

    Attributes:
        edges: all edges.
        used: which edges are in use.
        place: place of each pose in the order of elimination; -1 for those that are held.
        fill: entries of the factors per entry of the matrix, in blocks.
        held: which poses do not move.
        parts: number of the connected part of each pose.
        root: the held pose to which covariances refer: the first one, or the world.
        information: Λ of every edge.
        metric: the sparse matrix D of the damping, at the poses given.
    """

    def __init__(self, edges: Edge, poses: Float[np.ndarray, "n 7"], used: Bool[np.ndarray, "m"] | None = None):
        # Imported late, as SciPy's sparse matrices take a tenth of the import time of the package.
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        self.edges, self._start = edges, poses
        self.used = np.ones(len(edges), bool) if used is None else used
        num_poses, of_world = len(poses), np.asarray(edges.i) == WORLD
        self.root = num_poses - 1 if of_world.any() else 0
        self._i, self._j = np.where(of_world, self.root, edges.i), np.asarray(edges.j)
        self._measured = parameters_of(np.asarray(edges.T_i_j))
        self.information = np.asarray(edges.information)
        ends = self._i[self.used], self._j[self.used]
        graph = coo_array((np.ones(len(ends[0])), ends), (num_poses, num_poses))
        _, self.parts = connected_components(graph, directed=False)
        held = np.unique(self.parts, return_index=True)[1]
        held[self.parts[self.root]] = self.root
        self.held = np.zeros(num_poses, bool)
        self.held[held] = True
        self.place = np.full(num_poses, -1)
        self.place[~self.held], self.fill = _elimination_order(graph, self.held)
        self._lay_out()
        self.metric = self.matrix(self._evaluated(poses, _typical(self.information, of_world)).blocks)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 6 * int((~self.held).sum())

    def restricted(self, used: Bool[np.ndarray, "m"]) -> NormalEquations:
        """The equations of some of the edges."""
        return self if np.array_equal(used, self.used) else NormalEquations(self.edges, self._start, used)

    def terms(self, poses: Float[np.ndarray, "n 7"]) -> Terms:
        """Evaluate all edges."""
        return self._evaluated(poses, self.information)

    def ends(self, edges: Int[np.ndarray, "k"]) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
        """Rows of both poses of some edges."""
        return self._i[edges], self._j[edges]

    def residuals(self, poses: Float[np.ndarray, "n 7"], edges: Int[np.ndarray, "k"]) -> Float[np.ndarray, "k 6"]:
        """r of some edges."""
        start, end, measured = poses[self._i[edges]], poses[self._j[edges]], self._measured[edges]
        with jax.enable_x64(True):
            return map_rows(lambda k: _residuals(start[k], end[k], measured[k]), len(edges), size=_BLOCK)

    def _evaluated(self, poses: Float[np.ndarray, "n 7"], information: Float[np.ndarray, "m 6 6"]) -> Terms:
        if not len(self._i):
            return Terms(np.zeros(0), np.zeros((0, 2, 6)), np.zeros((0, 3, 6, 6)))
        a, b, measured = self._i, self._j, self._measured
        with jax.enable_x64(True):
            found = map_rows(
                lambda k: _terms(poses[a[k]], poses[b[k]], measured[k], information[k]), len(a), None, _BLOCK
            )
        return Terms(*found)

    def gradient(self, terms: Terms, weights: Float[np.ndarray, "m"]) -> Float[np.ndarray, "size"]:
        """g, in the order of elimination."""
        total = np.zeros((len(self.place), 6))
        for side, rows in enumerate((self._i, self._j)):
            for axis in range(6):
                total[:, axis] += np.bincount(rows, weights * terms.gradient[:, side, axis], len(total))
        return self.gathered(total)

    def gathered(self, rows: Float[np.ndarray, "n *k"]) -> Float[np.ndarray, "size"]:
        """Rows of the poses as a vector of the unknowns."""
        free = ~self.held
        vector = np.empty((free.sum(), *rows.shape[1:]))
        vector[self.place[free]] = rows[free]
        return vector.reshape(-1)

    def spread(self, vector: Float[np.ndarray, "size *k"]) -> Float[np.ndarray, "n 6 *k"]:
        """A vector of the unknowns as rows of the poses, 0 for those that are held."""
        rows = np.zeros((len(self.place), 6, *vector.shape[1:]))
        rows[~self.held] = vector.reshape(-1, *rows.shape[1:])[self.place[~self.held]]
        return rows

    def matrix(self, blocks: Float[np.ndarray, "m 3 6 6"]) -> Any:
        """The sparse symmetric matrix of the blocks of all edges."""
        from scipy.sparse import csc_array

        contributions = np.concatenate([*blocks.swapaxes(0, 1), blocks[:, 2].swapaxes(1, 2)])
        if not self.size:
            return csc_array((0, 0))
        summed = np.add.reduceat(contributions[self._order], self._starts)
        data = np.empty(summed.size)
        data[self._where] = summed.reshape(-1)
        return csc_array((data, self._indices, self._pointers), (self.size, self.size))

    def weighted(self, terms: Terms, weights: Float[np.ndarray, "m"]) -> Any:
        """The sparse matrix H."""
        return self.matrix(weights[:, None, None, None] * terms.blocks)

    def damped(self, matrix: Any, damping: float = LEAST_DAMPING) -> Any:
        """H + λD; all matrices have their entries at the same places."""
        total = matrix.copy()
        total.data += damping * self.metric.data
        return total

    def _lay_out(self) -> None:
        """Places of the contributions of the edges in the compressed columns of the matrix."""
        a, b = self.place[self._i], self.place[self._j]
        rows, columns = np.concatenate([a, b, a, b]), np.concatenate([a, b, b, a])
        inside = np.flatnonzero((rows >= 0) & (columns >= 0) & np.tile(self.used, 4))
        self._order = inside[np.lexsort((rows[inside], columns[inside]))]
        rows, columns = rows[self._order], columns[self._order]
        new = np.ones(len(rows), bool)
        new[1:] = (rows[1:] != rows[:-1]) | (columns[1:] != columns[:-1])
        self._starts = np.flatnonzero(new)
        rows, columns = rows[new], columns[new]
        counts = np.bincount(columns, minlength=self.size // 6)
        before = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int)
        along, across = np.arange(6)[:, None], np.arange(6)
        inner = (np.arange(len(rows)) - before[columns])[:, None, None]
        each = counts[columns][:, None, None]
        self._where = (36 * before[columns][:, None, None] + 6 * each * across + 6 * inner + along).reshape(-1)
        self._indices = np.empty(len(self._where), np.int32)
        self._indices[self._where] = np.broadcast_to(6 * rows[:, None, None] + along, (len(rows), 6, 6)).reshape(-1)
        starts = 36 * before[:, None] + 6 * counts[:, None] * across
        self._pointers = np.append(starts.reshape(-1), len(self._where)).astype(np.int32)


def factored(matrix: Any) -> Any:
    """`SuperLU` of a sparse symmetric positive definite matrix whose unknowns are in the order of elimination.

    Raises:
        RuntimeError: if the matrix is singular.
    """
    from scipy.sparse.linalg import splu

    options = {"SymmetricMode": True}
    return splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options=options)


def _solver(
    equations: NormalEquations,
    core: NormalEquations,
    matrix: Any,
    terms: Terms,
    weights: Float[np.ndarray, "m"],
    damping: float,
) -> Callable[[np.ndarray], np.ndarray]:
    """Solver of (H + λD) x = b, by the factors of the core and, if there are other edges, conjugate gradients."""
    from scipy.sparse.linalg import LinearOperator, cg

    if core is equations:
        return factored(equations.damped(matrix, damping)).solve
    factors = factored(core.damped(core.weighted(terms, weights), damping))

    def approximate(vector: Float[np.ndarray, "size"]) -> Float[np.ndarray, "size"]:
        return equations.gathered(core.spread(factors.solve(core.gathered(equations.spread(vector)))))

    whole, operator = equations.damped(matrix, damping), LinearOperator(matrix.shape, approximate, dtype=float)
    return lambda vector: cg(whole, vector, rtol=_RESIDUAL, maxiter=_MOST_PRODUCTS, M=operator)[0]


def _typical(information: Float[np.ndarray, "m 6 6"], of_world: Bool[np.ndarray, "m"]) -> Float[np.ndarray, "m 6 6"]:
    """S of every edge: on the diagonal, the median over edges of the mean information, of translation and of rotation.

    Edges from the world have their own: next to motions that are known to millimetres, positions known to metres would
    else look unconstrained.
    """
    diagonal = np.diagonal(information, axis1=1, axis2=2).reshape(-1, 2, 3).mean(axis=2)
    typical = np.ones_like(diagonal)
    for counted, edges in ((~of_world, slice(None)), (of_world, of_world)):
        for kind, values in enumerate(diagonal.T):
            known = values[counted & (values > 0)]
            if len(known):
                typical[edges, kind] = np.median(known)
    return np.repeat(typical, 3, axis=1)[:, :, None] * np.eye(6)


def _elimination_order(graph: Any, held: Bool[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "k"], float]:
    """Place of each free pose in an elimination order with little fill, minimum degree by SuperLU; and the fill."""
    from scipy.sparse import eye_array
    from scipy.sparse.linalg import splu

    free = ~held
    if not free.any():
        return np.zeros(0, int), 1.0
    pattern = (graph + graph.T).tocsr()[free][:, free]
    pattern.data[:] = -1.0
    # Dominated by its diagonal, so that the factorisation exists.
    dominated = pattern + eye_array(pattern.shape[0]) * (2.0 + np.diff(pattern.indptr).max())
    factors = splu(
        dominated.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    return factors.perm_c, factors.nnz / dominated.nnz


class Minimum(NamedTuple):
    """Where the loop ended.

    Attributes:
        poses: quaternions wxyz and translations.
        terms: what the edges say there.
        num_iterations: number of steps, rejected ones included.
        converged: whether the last step was small.
        damping: λ for a next step.
    """

    poses: Float[np.ndarray, "n 7"]
    terms: Terms
    num_iterations: int = 0
    converged: bool = False
    damping: float = START_DAMPING


def minimize(
    equations: NormalEquations,
    start: Minimum,
    weights: Float[np.ndarray, "m"],
    max_iterations: int,
    core: Bool[np.ndarray, "m"] | None = None,
) -> Minimum:
    """Lower ½ Σ w rᵀΛr by Levenberg-Marquardt steps until one lowers it by no more than tolerance and rounding.

    The weights of edges that are not in use are 0. With a `core` of edges, only these are factored if the factors of
    all would be much larger than the matrix; conjugate gradients account for the others, inexactly.
    """
    within = equations if core is None or equations.fill <= _LARGEST_FILL else equations.restricted(core)
    solver = partial(_solver, equations, equations if np.any(within.held != equations.held) else within)
    poses, terms, count, _, damping = start
    cost, system = terms.cost(weights), None
    end = count + max_iterations
    if not equations.size:
        return start._replace(converged=True)
    while count < end and damping < _MOST_DAMPING and np.isfinite(cost):
        if system is None:
            gradient, system = equations.gradient(terms, weights), equations.weighted(terms, weights)
        count += 1
        try:
            step = -solver(system, terms, weights, damping)(gradient)
        except RuntimeError:
            damping *= DAMPING_FACTOR
            continue
        decrease = -0.5 * float(gradient @ step)
        trial = moved_by(poses, equations.spread(step))
        there = equations.terms(trial)
        after = there.cost(weights)
        small = decrease <= TOLERANCE * cost + LEAST_DECREASE
        # Rounding decides whether the computed cost becomes lower by so little.
        if after <= cost * (1 + (TOLERANCE if small else 1e-14)) + LEAST_DECREASE:
            poses, terms, cost, system = trial, there, after, None
            damping = max(damping / DAMPING_FACTOR, LEAST_DAMPING)
            if small:
                return Minimum(poses, terms, count, True, damping)
        else:
            damping *= DAMPING_FACTOR
    return Minimum(poses, terms, count, False, damping)
