"""Clouds filled up to a size, as inside transformations: what fills them changes nothing."""

import jax
import numpy as np
import pytest

import mcgicp_jax as mcg
from tests.differences import CASES, GATE, weigh
from tests.scenes import pair


def test_padding_has_no_gradient_and_degenerate_neighborhoods_a_finite_one():
    source, target, _ = pair(size=400)
    # Coincident, collinear and isotropic neighbourhoods.
    points = np.array(source.points)
    points[:25] = points[0]
    points[25:50] = points[25] + np.linspace(0, 0.1, 25)[:, None] * [1.0, 2.0, 3.0]
    grid = np.stack(np.meshgrid(*[np.arange(3) * 0.05] * 3), axis=-1).reshape(-1, 3)
    points[50:77] = points[50] + grid
    cloud = mcg.preprocess(mcg.PointCloud(points, source.channels)).pad(512)
    method = CASES["mc-gicp"][0]

    def loss(points, channels):
        moved = cloud.replace(points=points, channels=channels)
        return weigh(mcg.register(moved, target, method, max_distance=GATE).matrix)

    gradients = jax.jit(jax.grad(loss, argnums=(0, 1)))(cloud.points, cloud.channels)
    for gradient in gradients:
        assert np.isfinite(gradient).all()
        assert np.abs(gradient[:400]).max() > 0
        np.testing.assert_array_equal(gradient[400:], 0)


@pytest.mark.timeout(240)
def test_stacked_clouds_go_through_vmap():
    pairs = [pair(size=400), pair(size=350), pair(size=300)]
    sources, targets = (mcg.PointCloud.stack([p[i] for p in pairs]) for i in (0, 1))
    register = jax.jit(jax.vmap(lambda s, t: mcg.register(s, t, mcg.GICP(1e-2), max_distance=GATE)))
    results = register(sources, targets)
    for i, (source, target, _) in enumerate(pairs):
        single = mcg.register(source, target, mcg.GICP(1e-2), max_distance=GATE)
        np.testing.assert_allclose(results.matrix[i], single.matrix, atol=1e-3)
        assert results.status[i] == single.status
