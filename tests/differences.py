"""Comparison of derivatives with finite differences, shared by the tests of transformations."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mcgicp_jax as mcg

GATE = 0.4
METHODS = ("mc-gicp", "gicp", "point-to-plane", "point-to-point", "color-icp")


def case(name):
    """A method and a robust kernel: the tests differentiate with respect to all their parameters."""
    if name == "mc-gicp":
        return mcg.MultiChannelGICP([[0.05, 0.01], [0.01, 0.08]], 0.3, epsilon=1e-2), mcg.Cauchy(0.5)
    if name == "gicp":
        return mcg.GICP(1e-2), mcg.Huber(0.3)
    if name == "point-to-plane":
        return mcg.PointToPlane(), mcg.GemanMcClure(0.5)
    return (mcg.PointToPoint(), mcg.Tukey(1.0)) if name == "point-to-point" else (mcg.ColorICP(0.3), None)


CONVERGED = {"translation_tolerance": 1e-12, "rotation_tolerance": 1e-12, "max_iterations": 200}
# Differences over 1e-6 need poses to the last digit: no update is below these tolerances.
TO_ROUNDING = {"translation_tolerance": 1e-15, "rotation_tolerance": 1e-15, "max_iterations": 30}


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


class Slope(NamedTuple):
    """The central difference of a loss along a random direction in a leaf of an input."""

    name: str
    leaf: int
    direction: np.ndarray
    difference: float


def slopes(loss, inputs):
    """Central differences along a random direction in each input."""
    rng, found = np.random.default_rng(1), []
    for name, value in inputs.items():
        leaves, structure = jax.tree.flatten(value)
        for i, leaf in enumerate(leaves):
            direction = rng.normal(size=leaf.shape)
            if name == "method" and leaf.ndim == 2:
                direction = direction + direction.T
            if name in ("method", "robust"):
                direction = direction * np.abs(np.asarray(leaf))
            # Short, so that no match crosses the kink of a kernel, and that the next term of the series, of the step's
            # square, is far below rounding.
            values, step = [], 5e-7
            for each in (step, -step):
                moved = [*leaves[:i], np.asarray(leaf + each * direction), *leaves[i + 1 :]]
                values.append(float(loss(inputs | {name: jax.tree.unflatten(structure, moved)})))
            found.append(Slope(name, i, direction, (values[0] - values[1]) / (2 * step)))
    return found


def assert_slopes(gradient, expected, floor=1e-3, accuracy=1e-6):
    """The gradient has these slopes, relative to each, or to `floor` where it is less."""
    for name, leaf, direction, difference in expected:
        actual = np.sum(np.asarray(jax.tree.leaves(gradient[name])[leaf]) * direction)
        assert abs(actual - difference) <= accuracy * max(abs(difference), floor), f"{name}[{leaf}]"


def assert_alike(actual, expected, accuracy):
    """Trees of arrays agree, relative to the largest number of each."""
    for one, other in zip(*map(jax.tree.leaves, (actual, expected)), strict=True):
        np.testing.assert_allclose(one, other, atol=accuracy * np.abs(other).max())


def check_gradient(loss, inputs):
    """Compare the gradient with differences of values outside of transformations; return the compiled gradient."""
    compiled = jax.jit(jax.grad(loss))
    assert_slopes(compiled(inputs), slopes(loss, inputs))
    return compiled


def eager_gradient(loss, inputs):
    """The gradient outside of `jit`, with which forward mode agrees."""
    gradient = jax.grad(loss)(inputs)
    tangent = jax.tree.map(lambda leaf: jnp.asarray(np.random.default_rng(2).normal(size=leaf.shape)), inputs)
    _, forward = jax.jvp(loss, (inputs,), (tangent,))
    reverse = jax.tree.map(lambda a, b: np.sum(np.asarray(a) * np.asarray(b)), gradient, tangent)
    np.testing.assert_allclose(forward, sum(jax.tree.leaves(reverse)), rtol=1e-9)
    return gradient


def check_eager_gradient(loss, inputs, scale=1e-2, differences_of=None):
    """The gradient agrees with central differences along a random direction in each input, and with forward mode."""
    gradient = eager_gradient(loss, inputs)
    assert_slopes(gradient, slopes(differences_of or loss, inputs), scale)
    return gradient
