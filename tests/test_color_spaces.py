"""Channel spaces against independent values, and their derivatives."""

import colorsys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from tests.scenes import wall

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
    h, s, v = np.array([colorsys.rgb_to_hsv(*rgb) for rgb in colors]).T
    expected = np.stack([s * np.cos(2 * np.pi * h), s * np.sin(2 * np.pi * h), v], axis=1)
    np.testing.assert_allclose(mcg.rgb_to_hsv(colors), expected, atol=1e-12)
    # Continuous at red.
    np.testing.assert_allclose(*mcg.rgb_to_hsv(np.array([[1, 0, 1e-9], [1, 1e-9, 0]])), atol=1e-8)


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
    outside = SPACES[name](colors)
    assert isinstance(outside, np.ndarray) and outside.dtype == np.float32
    np.testing.assert_allclose(jax.jit(jax.vmap(SPACES[name]))(colors), outside, atol=2e-4)


@pytest.mark.parametrize("name", SPACES)
def test_derivatives(name):
    """Finite at black, greys and ties; elsewhere those of differences."""
    slopes = jax.jit(jax.vmap(jax.jacobian(SPACES[name])))(jnp.asarray(np.concatenate([SPECIAL, COLORS]), jnp.float32))
    assert np.isfinite(slopes).all()
    for i, step in enumerate(1e-6 * np.eye(3)):
        expected = (SPACES[name](COLORS + step) - SPACES[name](COLORS - step)) / 2e-6
        atol = 2e-3 * np.abs(expected).max()
        np.testing.assert_allclose(slopes[len(SPECIAL) :, :, i], expected, rtol=2e-3, atol=atol)


def test_shapes():
    for convert in SPACES.values():
        with pytest.raises(ValueError, match=r"^rgb: .*\(4,\)"):
            convert(np.zeros(4))


def test_the_command_line_converts(tmp_path, command):
    points, colors = wall(800)
    for name, cloud in (
        ("cloud.ply", mcg.PointCloud(points, 0.5 + 0.4 * colors, channel_names=("red", "green", "blue"))),
        ("grey.ply", mcg.PointCloud(points, colors[:, :1], channel_names=("intensity",))),
    ):
        mcg.io.write(tmp_path / name, cloud)
    code, text, _ = command("register", *[tmp_path / "cloud.ply"] * 2, "--channels", "lab")
    assert code == 0 and "channels:  lab\n" in text
    code, _, errors = command("register", *[tmp_path / "grey.ply"] * 2, "--channels", "lab")
    assert code == 2 and "no channel red, green, blue" in errors
