"""The precision in which tests run: float32, unless they or their module are marked otherwise."""

import functools

import jax
import pytest

in_float64 = pytest.mark.precision("float64")
in_both_precisions = pytest.mark.precision("float32", "float64")


def tolerance(f32: float, f64: float) -> float:
    """`f32`, or `f64` in a test that runs in float64."""
    return f64 if jax.config.jax_enable_x64 else f32


def cached(function):
    """`functools.cache`, where each precision has its own results."""
    kept = functools.cache(lambda precision, *args: function(*args))
    return lambda *args: kept(jax.config.jax_enable_x64, *args)
