"""The median of numbers, of which some are NaN or infinite, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcgicp_jax._math.statistics import median


@pytest.mark.filterwarnings("ignore:All-NaN", "ignore:invalid value")
def test_median_is_that_of_numpy_and_has_gradient_0():
    values = np.random.default_rng(0).normal(size=(7, 9)).astype(np.float32)
    values[0, ::3], values[1] = np.nan, np.nan
    values[2, :3], values[3, 3:] = -np.inf, np.inf
    # The mean of the middle two overflows if they are added first.
    values[4], values[4, 0] = 2e38, np.nan
    values[5, 0], values[6, :4] = np.nan, values[6, 4]
    expected = np.nanmedian(values.astype(float), axis=1)
    np.testing.assert_array_equal(median(values.astype(float)), expected)
    np.testing.assert_allclose(jax.jit(median)(values), expected, rtol=1e-6)
    assert jax.grad(lambda scale: jnp.sum(median(scale * jnp.asarray(values[5:]))))(1.0) == 0
