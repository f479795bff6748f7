"""Statistics that ignore what is not a number, against NumPy."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mcgicp_jax._math import statistics as _statistics

NUMBERS = st.floats(width=32, allow_nan=True, allow_infinity=True)


@settings(deadline=None, max_examples=100)
@given(st.lists(NUMBERS, min_size=7, max_size=7))
@example(values=[0.0, 0.0, 0.0, 2e38, 2e38, 2e38, 2e38])
def test_median_is_that_of_numpy(values):
    values = np.array(values, float)
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        np.testing.assert_array_equal(_statistics.median(values), np.nanmedian(values))
        expected = np.nanmedian(values.astype(np.float32).astype(float))
    actual = jax.jit(_statistics.median)(jnp.asarray(values, float))
    # XLA takes the smallest numbers for zero.
    np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-37)


def test_median_of_several_and_of_nothing():
    values = np.random.default_rng(0).normal(size=(4, 1000))
    values[0, ::3], values[1] = np.nan, np.nan
    actual = jax.jit(_statistics.median)(jnp.asarray(values, float))
    np.testing.assert_allclose(np.asarray(actual)[[0, 2, 3]], np.nanmedian(values[[0, 2, 3]], axis=1), rtol=1e-6)
    assert np.isnan(actual[1])
    slope = jax.grad(lambda scale: jnp.sum(_statistics.median(scale * jnp.asarray(values[2:], float))))(1.0)
    assert slope == 0
