"""What is added to the package is one new thing: a method, a term, a tree; none needs an edit anywhere else."""

import jax
import jax.numpy as jnp
import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax import extend
from mcgicp_jax.extend import symmetric_matrices as alg
from tests.scenes import motion, pair


class Ridge(extend.AbstractOneSided):
    """A method: the inverse of the target's local covariance weighs a residual, as NDT's cells do."""

    def covariance(self, around, local):
        scatter = local.covariance.T if around.given is None else around.given_covariance
        floor = 1e-3 * (scatter[0] + scatter[3] + scatter[5]) + 1e-12
        return alg.inverse(scatter.at[jnp.array([0, 3, 5])].add(floor))


class Attraction(extend.AbstractTerm):
    """A term: three times plain ICP's force."""

    def linearize(self, matches):
        one, zero = jnp.ones_like(matches.moved[0]), jnp.zeros_like(matches.moved[0])
        return extend.linearize_residual(
            matches.residual, 3 * jnp.stack([one, zero, zero, one, zero, one]), self.robust
        )


class Prior(mcg.GICP):
    """GICP with the further term."""

    def terms(self, source, target, robust, equalize_channels):
        return (*super().terms(source, target, robust, equalize_channels), Attraction())


class BruteForce(mcg.AbstractTreeSearch):
    """A tree: none at all."""

    def build(self, points):
        return points

    def query(self, tree, queries, k, bound):
        apart = np.linalg.norm(queries[:, None] - tree, axis=2)
        rows = np.argpartition(apart, min(k, len(tree)) - 1, axis=1)[:, :k]
        rows = np.take_along_axis(rows, np.argsort(np.take_along_axis(apart, rows, axis=1), axis=1), axis=1)
        distances = np.take_along_axis(apart, rows, axis=1)
        near = distances < bound
        return np.where(near, distances, np.inf), np.where(near, rows, len(tree))


def test_a_method():
    source, target, truth = pair(size=400)
    result = mcg.register(source, target, Ridge(), max_distance=0.3)
    assert result.converged and max(mcg.metrics.pose_error(result.matrix, truth)) < 0.02
    assert np.isfinite(result.covariance).all()
    inside = jax.jit(lambda s, t: mcg.register(s, t, Ridge(), max_distance=0.3).matrix)(source, target)
    np.testing.assert_allclose(inside, result.matrix, atol=1e-6)


def test_a_term():
    source, target, truth = pair(size=400)
    plain, both = (mcg.register(source, target, method, max_distance=0.3) for method in (mcg.GICP(), Prior()))
    assert both.converged and max(mcg.metrics.pose_error(both.matrix, truth)) < 0.02
    assert np.abs(both.matrix - plain.matrix).max() > 1e-5
    assert np.all(np.linalg.eigvalsh(both.information - plain.information) > 0)

    def balance(points):
        """The pose rests where all forces do, and has the derivative of that."""
        found = mcg.register(source.replace(points=points), target, Prior(), max_distance=0.3).matrix
        return jnp.sum(found[:3] * jnp.arange(12.0).reshape(3, 4))

    gradient = jax.grad(balance)(jnp.asarray(source.points))
    assert np.isfinite(gradient).all()
    # To move the whole source is to move the pose the other way.
    np.testing.assert_allclose(
        np.sum(np.asarray(gradient), axis=0), -np.asarray([3.0, 7.0, 11.0]) @ np.asarray(both.matrix)[:3, :3], atol=2e-2
    )


def test_a_tree():
    source, target, _ = pair(size=400, truth=motion((0.02, 0.01, 0, 0, 0.01, 0.02)))
    np.testing.assert_array_equal(
        BruteForce().neighbors(target.points, 20), mcg.KDTreeSearch().neighbors(target.points, 20)
    )
    for method in (mcg.GICP(), mcg.MultiChannelGICP()):
        results = [mcg.register(source, target, method, search=search) for search in (BruteForce(), mcg.KDTreeSearch())]
        np.testing.assert_array_equal(results[0].matrix, results[1].matrix)
    traced = jax.jit(lambda s, t: mcg.register(s, t, mcg.GICP(), search=BruteForce()).matrix)(source, target)
    np.testing.assert_allclose(traced, mcg.register(source, target, mcg.GICP(), search=BruteForce()).matrix, atol=1e-6)
