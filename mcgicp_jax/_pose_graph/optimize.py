"""`optimize_poses` and its result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from mcgicp_jax._compute.cache import Lazy
from mcgicp_jax._compute.concrete import AnyArray, is_concrete, numpy_for
from mcgicp_jax._compute.messages import check_integer
from mcgicp_jax._compute.threads import with_settings_of_package
from mcgicp_jax._pose_graph.edge import WORLD, Edge
from mcgicp_jax._pose_graph.graph import PoseGraph
from mcgicp_jax._pose_graph.implicit_derivative import covariances_traced, solve_traced
from mcgicp_jax._pose_graph.robust_solver import solve, uncertainty
from mcgicp_jax._registration.result import Status


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False, repr=False)
class PoseGraphResult:
    """Result of `optimize_poses`; a pytree.

    Attributes:
        poses: (n, 4, 4), sensor to world, metres; without measurements in the world's frame, the first one is that of
            the graph.
        edges: the m edges of the graph, rejected ones included.
        status_code: integer value of `status`.
        num_iterations: number of Levenberg-Marquardt steps.
        cost: ½ Σ w rᵀΛr over all measurements, with w = 0 for rejected ones; of edges, r = log(T_i_j⁻¹ T_i⁻¹ T_j).
        residuals: (m,) √(rᵀΛr), the Mahalanobis distance of each edge, in standard deviations.
        weights: (m,) 1 for edges that were kept and 0 for those that were rejected.
        factor_residuals, factor_weights: the same for each element of `PoseGraph.factors`.
        num_redundant: number of components of all kept residuals, less six per pose that may move.
        uncertainty: deferred value of `covariance`.
    """

    poses: Float[Array, "n 4 4"] | Float[np.ndarray, "n 4 4"]
    edges: Edge
    status_code: Int[ArrayLike, ""]
    num_iterations: Int[ArrayLike, ""]
    cost: Float[ArrayLike, ""]
    residuals: Float[Array, "m"] | Float[np.ndarray, "m"]
    weights: Float[Array, "m"] | Float[np.ndarray, "m"]
    factor_residuals: tuple[AnyArray, ...]
    factor_weights: tuple[AnyArray, ...]
    num_redundant: Any
    uncertainty: Lazy[Any]

    @property
    def kept(self) -> Bool[Array, "m"] | Bool[np.ndarray, "m"]:
        """(m,) False for edges that were rejected."""
        return self.weights > 0.5

    @property
    def chi_squared(self) -> Any:
        """χ² of the kept measurements, divided by `num_redundant`: about 1 for independent errors and right information
        matrices; NaN if that is not positive.

        Registrations of the same clouds share their noise, which partly cancels around loops: graphs of `odometry` and
        `multiway` have 0.2 to 0.5.
        """
        xp = numpy_for(self.cost, self.num_redundant)
        positive = self.num_redundant > 0
        return xp.where(positive, 2 * self.cost / xp.where(positive, self.num_redundant, 1), xp.nan)[()]

    @property
    def covariance(self) -> Float[Array, "n 6 6"] | Float[np.ndarray, "n 6 6"]:
        """(n, 6, 6) covariance of every pose: of ξ = (v, ω) in T exp(ξ), metres and radians; computed when first read.

        It is the inverse of the Gauss-Newton matrix of the kept measurements, relative to the first pose or, with
        measurements in the world's frame, to the world. It is right if the information matrices are, and does not cover
        the risk that an outlier was kept or a true measurement rejected. The diagonal is infinite for poses that are
        not connected with the first pose or the world.
        """
        return self.uncertainty.value

    @property
    def status(self) -> Any:
        """The `Status`; inside a transformation the array `status_code`.

        CONVERGED; MAX_ITERATIONS; NON_FINITE: poses or residuals overflow; DEGENERATE: the measurements do not connect
        all poses with each other or with the world, or leave a direction of motion of at least one pose unconstrained.
        Along such directions, relative motions stay near those of the initial poses. Also DEGENERATE: uncertain edges
        alone join two parts of the graph, and more than 40 % of them were rejected; wrong loops agree with each other
        where places look alike.
        """
        return Status(int(np.asarray(self.status_code))) if is_concrete(self.status_code) else self.status_code

    @property
    def converged(self) -> Any:
        """Whether the status is CONVERGED."""
        return self.status == Status.CONVERGED

    def __repr__(self) -> str:
        if not is_concrete(self.poses):
            return f"PoseGraphResult({len(self.poses)} poses, traced)"
        rejected = int((~np.asarray(self.kept)).sum())
        return (
            f"PoseGraphResult({self.status.name}: {len(self.poses)} poses, {len(self.edges)} edges, "
            f"{rejected} rejected, cost {np.asarray(self.cost):.4g}, {self.num_iterations} iterations)"
        )


@with_settings_of_package
def optimize_poses(graph: PoseGraph, *, robust: bool = True, max_iterations: int = 100) -> PoseGraphResult:
    """Find the poses that minimise Σ rᵀΛr over all measurements of a graph.

    The residual of an edge is r = log(T_i_j⁻¹ T_i⁻¹ T_j). Levenberg-Marquardt starts from the poses of the graph; it
    runs on the host with sparse factorisations, also inside transformations. The first pose is fixed, unless there
    are measurements in the world's frame, such as priors.

    Inside transformations the poses are differentiable with respect to the motions and information matrices of edges,
    by the implicit function theorem, but not with respect to the initial poses; second derivatives raise, and so do
    derivatives of graphs with factors. Rejected edges count as constants. The derivative is 0 unless the status is
    CONVERGED. Its memory grows with n², which suits some hundreds of poses. Poses have the precision of the given
    arrays: in float32, 0.5 m at UTM coordinates. Outside of transformations they are float64.

    Args:
        graph: poses and measurements.
        robust: whether uncertain measurements may be rejected as outliers: those whose squared Mahalanobis distance at
            the minimum exceeds the 99 % quantile of χ² (for edges, a distance of 4.1). They are found by graduated
            non-convexity with truncated squares (Yang et al. 2020). The threshold presumes that the information
            matrices are right.
        max_iterations: largest number of steps, at least 1. Steps of the graduated non-convexity are not limited by it.

    Returns:
        The poses with status and covariances, and the residual and weight of each measurement.

    Raises:
        ValueError: if `graph` is not a `PoseGraph` or `max_iterations` is not an integer of at least 1. Failures on
            well-formed graphs show in the status.

    Warns:
        UserWarning: when a transformed or compiled program runs, if its poses are rounded by more than the standard
            deviation of a typical edge. Subtract an origin from poses and priors before.
    """
    if not isinstance(graph, PoseGraph):
        raise ValueError(f"graph: expected a PoseGraph, got {type(graph).__name__}")
    check_integer("max_iterations", max_iterations, 1)
    factors = graph.edges, *graph.factors
    if is_concrete(graph):
        poses, factors = jax.tree.map(np.asarray, (graph.poses, factors))
        solution, state = solve(poses, factors, bool(robust), int(max_iterations))
        covariances = Lazy(lambda: uncertainty(state)[: len(poses)])
    else:
        solution = solve_traced(graph.poses, factors, bool(robust), int(max_iterations))
        covariances = covariances_traced(solution.poses, factors, solution.weights)
    ends = np.cumsum([len(factor.information) for factor in factors])[:-1]
    xp = numpy_for(solution)
    residuals, *factor_residuals = xp.split(solution.residuals, ends)
    weights, *factor_weights = xp.split(solution.weights, ends)
    sizes = np.concatenate([np.full(len(factor.information), factor.information.shape[-1]) for factor in factors])
    num_free = len(graph.poses) - 1 + xp.any(xp.concatenate([xp.ravel(factor.rows) for factor in factors]) == WORLD)
    return PoseGraphResult(
        poses=solution.poses,
        edges=graph.edges,
        status_code=solution.status,
        num_iterations=solution.num_iterations,
        cost=solution.cost,
        residuals=residuals,
        weights=weights,
        factor_residuals=tuple(factor_residuals),
        factor_weights=tuple(factor_weights),
        num_redundant=xp.sum(solution.weights * sizes) - 6 * num_free,
        uncertainty=covariances,
    )
