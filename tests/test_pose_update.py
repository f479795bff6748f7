"""The update from 73 numbers, against least squares on all residuals."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scipy.optimize
from scipy.spatial.transform import Rotation

from mcgicp_jax import Status
from mcgicp_jax._pose_solver import update as _solve
from mcgicp_jax._pose_solver.matched import Matched, Motion
from mcgicp_jax._pose_solver.sums import sums_of
from mcgicp_jax._registration.loop import update
from mcgicp_jax._registration.settings import COARSE, RUNNING, SETTLED, Settings
from mcgicp_jax.extend import AbstractTerm, Surface, linearize_residual
from mcgicp_jax.extend import symmetric_matrices as cov
from tests.precision import in_both_precisions, tolerance

pytestmark = in_both_precisions
N = 2000


def random_pairs(seed: int, scale: float = 1.0, offset: float = 0.0, noise: float = 0.05):
    """Pairs displaced by a rotation and a translation, with anisotropic M, some without a match."""
    rng = np.random.default_rng(seed)
    moved = scale * rng.normal(size=(N, 3)) + offset
    turn = Rotation.from_rotvec(0.1 * rng.normal(size=3))
    center = moved.mean(axis=0)
    residual = turn.apply(moved - center) + center + scale * 0.2 * rng.normal(size=3) - moved
    residual += scale * noise * rng.normal(size=(N, 3))
    factor = rng.normal(size=(N, 3, 3)) * np.array([1, 1, 20])
    information = factor @ factor.swapaxes(1, 2)
    weight = rng.random(N)
    valid = rng.random(N) < 0.9
    residual[~valid] = 0
    weight[~valid] = 0
    return moved, residual, information, weight, valid


class Given(AbstractTerm):
    """Forces of given weight matrices."""

    information: jax.Array
    weight: jax.Array

    def linearize(self, matches):
        found = linearize_residual(matches.residual, cov.symmetric_from_matrix(self.information), None)
        return found.scaled(self.weight)


# With data as arguments, so that all tests share a program.
measure = jax.jit(
    lambda matched, term: sums_of(Motion(jnp.eye(3), jnp.zeros(3)), matched, (term,), 0.0, np.bool_(True))
)
update_of = jax.jit(_solve.solve_update)


def solve(moved, residual, information, weight, valid):
    points = (jnp.asarray(rows, float) for rows in (moved, moved + residual))
    surfaces = [Surface(rows, jnp.zeros((len(rows), 6)), None, None, {}) for rows in points]
    term = Given(jnp.asarray(information, float), jnp.asarray(weight, float))
    measured = measure(Matched(*surfaces, jnp.asarray(valid)), term)
    return measured, update_of(measured, jnp.eye(6))


def whitened(twist, moved, residual, information, weight, center):
    """The 3N residuals: a square root of w M times d − D h."""
    root = np.linalg.cholesky(information * weight[:, None, None] + 1e-300 * np.eye(3)).swapaxes(1, 2)
    arm = moved - center
    change = Rotation.from_rotvec(twist[3:]).apply(arm) - arm + twist[:3]
    return np.einsum("nij,nj->ni", root, residual - change).ravel()


@pytest.mark.parametrize("scale, offset", [(1, 0), (1, 300), (1e-3, 0), (1e3, 1e4)])
def test_update_is_the_least_squares_answer_on_all_residuals(scale, offset):
    moved, residual, information, weight, valid = random_pairs(0, scale, offset)
    measured, update = solve(moved, residual, information, weight, valid)
    center = moved[valid].mean(axis=0)
    units = np.array([scale, scale, scale, 1, 1, 1])
    used = valid & (weight > 0)
    data = (moved[used], residual[used], information[used], weight[used], center)
    expected = scipy.optimize.least_squares(
        lambda twist: whitened(units * twist, *data) / scale, np.zeros(6), method="lm", xtol=1e-15, ftol=1e-15
    )
    np.testing.assert_allclose(measured.center, center, rtol=tolerance(1e-5, 1e-12))
    np.testing.assert_allclose(update.twist / units, expected.x, atol=tolerance(1e-5, 1e-9))
    assert not update.degenerate


@pytest.mark.parametrize("before", [COARSE, RUNNING, SETTLED])
@pytest.mark.parametrize("count", [0, 1, 3, 4])
def test_too_few_matches_are_the_status_even_after_convergence(before, count):
    """The last update may move matches beyond `max_distance`: three determine a pose, but one not to be believed."""
    moved, residual, information, weight, _ = random_pairs(3, noise=0.0)
    measured, _ = solve(moved, 0 * residual, information, weight, np.arange(N) < count)
    number = measured.center.dtype.type
    yes = np.bool_(True)
    settings = Settings(
        *map(number, (0.5, 0.5)), np.int32(1), *map(number, [1e-3] * 4), np.int32(9), yes, yes, *map(number, (0, 0))
    )
    start = jaxlie.SE3(jnp.array([1, 0, 0, 0, 0, 0, 0], number))
    still = jnp.zeros(6, number), jnp.zeros((), number)
    status = update(start, np.int32(before), np.int32(1), *still, measured, settings).status
    enough = {COARSE: RUNNING, RUNNING: SETTLED, SETTLED: Status.CONVERGED}
    assert status == (enough[before] if count >= 4 else Status.TOO_FEW_CORRESPONDENCES)
