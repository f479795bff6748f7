"""Comparison of derivatives with finite differences, shared by the tests of transformations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg

X64 = bool(jax.config.jax_enable_x64)
needs_x64 = pytest.mark.skipif(not X64, reason="finite differences need float64: JAX_ENABLE_X64=1")
GATE = 0.4
# (method, robust kernel): the tests differentiate with respect to all their parameters.
CASES = {
    "mc-gicp": (mcg.MultiChannelGICP([[0.05, 0.01], [0.01, 0.08]], 0.3, epsilon=1e-2), mcg.Cauchy(0.5)),
    "gicp": (mcg.GICP(1e-2), mcg.Huber(0.3)),
    "point-to-plane": (mcg.PointToPlane(), mcg.GemanMcClure(0.5)),
    "point-to-point": (mcg.PointToPoint(), mcg.Tukey(1.0)),
    "color-icp": (mcg.ColorICP(0.3), None),
}
CONVERGED = {"translation_tolerance": 1e-12, "rotation_tolerance": 1e-12, "max_iterations": 200}
# Differences over 4e-7 need poses to the last digit: no update is below these tolerances.
TO_ROUNDING = {"translation_tolerance": 1e-15, "rotation_tolerance": 1e-15, "max_iterations": 60}


def weigh(matrix):
    """A scalar that depends on all entries of a pose."""
    return jnp.sum(jnp.asarray(np.random.default_rng(0).normal(size=(3, 4))) * matrix[:3])


def inputs_of(source, target, method, robust):
    """All inputs with respect to which a pose can be differentiated, by name."""
    inputs = {
        "source points": source.points,
        "target points": target.points,
        "source channels": source.channels,
        "target channels": target.channels,
        "method": method,
        "robust": robust,
    }
    if source.covariances is not None:
        inputs |= {"source covariances": source.covariances, "target covariances": target.covariances}
    return inputs


def clouds_with(inputs, source, target):
    def filled(name, cloud):
        arrays = {key.split()[1]: value for key, value in inputs.items() if key.startswith(name)}
        return cloud.replace(**arrays)

    return filled("source", source), filled("target", target)


def directional_errors(loss, inputs, gradient):
    """Yield name, derivative and fourth-order difference along a random direction in each input."""
    rng = np.random.default_rng(1)
    for name, value in inputs.items():
        leaves, structure = jax.tree.flatten(value)
        for i, leaf in enumerate(leaves):
            direction = rng.normal(size=leaf.shape)
            if name == "method" and leaf.ndim == 2:
                direction = direction + direction.T
            if name == "method" or name == "robust":
                direction = direction * np.abs(np.asarray(leaf))

            def at(step, name=name, leaves=leaves, structure=structure, i=i, leaf=leaf, direction=direction):
                moved = [*leaves[:i], leaf + step * direction, *leaves[i + 1 :]]
                return float(loss(inputs | {name: jax.tree.unflatten(structure, moved)}))

            # Short, so that no match crosses the kink of a kernel.
            step = 5e-7
            expected = (8 * (at(step) - at(-step)) - (at(2 * step) - at(-2 * step))) / (12 * step)
            actual = float(jnp.sum(jax.tree.leaves(gradient[name])[i] * direction))
            yield f"{name}[{i}]", actual, expected


def check_gradient(loss, inputs):
    """Compare the gradient with differences and forward mode; return the compiled value and gradient."""
    # Forward mode, along one random direction in all inputs.
    tangent = jax.tree.map(lambda leaf: jnp.asarray(np.random.default_rng(2).normal(size=leaf.shape)), inputs)

    # One program for all, since compilation takes most of the time.
    @jax.jit
    def compiled(inputs):
        return *jax.value_and_grad(loss)(inputs), jax.jvp(loss, (inputs,), (tangent,))[1]

    _, gradient, forward = compiled(inputs)
    scale = 1e-3
    for name, actual, expected in directional_errors(lambda moved: compiled(moved)[0], inputs, gradient):
        assert np.isfinite(actual)
        assert abs(actual - expected) <= 1e-6 * max(abs(expected), scale), name
    reverse = sum(jax.tree.leaves(jax.tree.map(lambda a, b: jnp.sum(a * b), gradient, tangent)))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)
    return lambda inputs: compiled(inputs)[:2]
