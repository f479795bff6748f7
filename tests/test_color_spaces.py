"""Channel spaces against independent values, and their derivatives."""

import colorsys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax.__main__ import main

SPACES = {"lab": mcg.rgb_to_lab, "hsv": mcg.rgb_to_hsv, "yuv": mcg.rgb_to_yuv}
COLORS = np.random.default_rng(0).random((500, 3))
# Black, white, a dark grey in the linear part of both curves of Lab, a grey, and colours with equal parts.
SPECIAL = np.array([[0, 0, 0], [1, 1, 1], [0.01, 0.01, 0.01], [0.5, 0.5, 0.5], [1, 0, 0], [0, 1, 1], [0.3, 0.3, 0.8]])


def test_lab_of_known_colors():
    """Bruce Lindbloom's calculator, sRGB and D65."""
    primaries = mcg.rgb_to_lab([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    expected = [[53.24, 80.09, 67.20], [87.73, -86.18, 83.18], [32.30, 79.19, -107.86], [100, 0, 0], [0, 0, 0]]
    np.testing.assert_allclose(primaries, expected, atol=0.02)


def test_hsv_is_that_of_the_standard_library():
    colors = np.concatenate([COLORS, SPECIAL])
    for rgb, (x, y, value) in zip(colors, mcg.rgb_to_hsv(colors), strict=True):
        h, s, v = colorsys.rgb_to_hsv(*rgb)
        np.testing.assert_allclose([x, y, value], [s * np.cos(2 * np.pi * h), s * np.sin(2 * np.pi * h), v], atol=1e-12)
    # Continuous at red.
    below, above = mcg.rgb_to_hsv(np.array([[1, 0, 1e-9], [1, 1e-9, 0]]))
    np.testing.assert_allclose(below, above, atol=1e-8)


def test_lab_and_yuv_are_those_of_opencv():
    cv2 = pytest.importorskip("cv2")
    image = np.concatenate([COLORS, SPECIAL]).astype(np.float32)[None]
    # OpenCV approximates the cube root of Lab by a spline.
    np.testing.assert_allclose(mcg.rgb_to_lab(image), cv2.cvtColor(image, cv2.COLOR_RGB2Lab), atol=0.4)
    shift = np.array([0, 0.5, 0.5])
    np.testing.assert_allclose(mcg.rgb_to_yuv(image), cv2.cvtColor(image, cv2.COLOR_RGB2YUV) - shift, atol=2e-3)


@pytest.mark.parametrize("name", SPACES)
def test_the_same_inside_transformations(name):
    colors = COLORS.astype(np.float32)
    inside = jax.jit(jax.vmap(SPACES[name]))(colors)
    assert isinstance(SPACES[name](colors), np.ndarray) and SPACES[name](colors).dtype == np.float32
    np.testing.assert_allclose(inside, SPACES[name](colors), atol=2e-4)


@pytest.mark.parametrize("name", SPACES)
def test_derivatives(name):
    """Finite at black, greys and ties; elsewhere those of differences."""
    slopes = jax.jit(jax.vmap(jax.jacobian(SPACES[name])))(jnp.asarray(np.concatenate([SPECIAL, COLORS]), jnp.float32))
    assert np.isfinite(slopes).all()
    step = 1e-6
    for i, axis in enumerate(np.eye(3)):
        ends = [np.asarray(SPACES[name](COLORS + sign * step * axis)) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * step)
        tolerance = 2e-3 * np.abs(expected).max()
        np.testing.assert_allclose(slopes[len(SPECIAL) :, :, i], expected, rtol=2e-3, atol=tolerance)


@pytest.mark.parametrize("name", SPACES)
def test_shapes(name):
    with pytest.raises(ValueError, match=r"^rgb: .*\(4,\)"):
        SPACES[name](np.zeros(4))


def test_the_command_line_converts(tmp_path, capsys):
    rng = np.random.default_rng(0)
    points = np.hstack([2 * rng.random((800, 2)), 0.002 * rng.normal(size=(800, 1))])
    x, y, _ = points.T
    colors = 0.5 + 0.4 * np.stack([np.sin(7 * x), np.cos(6 * y), np.sin(5 * (x + y))], axis=1)
    cloud = mcg.PointCloud(points, colors, channel_names=("red", "green", "blue"))
    path = tmp_path / "cloud.ply"
    mcg.io.write(path, cloud)
    assert main(["register", str(path), str(path), "--channels", "lab"]) == 0
    assert "channels:  lab\n" in capsys.readouterr().out
    grey = tmp_path / "grey.ply"
    mcg.io.write(grey, mcg.PointCloud(points, colors[:, :1], channel_names=("intensity",)))
    assert main(["register", str(grey), str(grey), "--channels", "lab"]) == 2
    assert "no channel red, green, blue" in capsys.readouterr().err
