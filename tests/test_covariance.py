"""Covariances and their closed-form algebra, against NumPy; compiled, at the sizes that are met in use."""

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mcgicp_jax import GICP, MultiChannelGICP, PointCloud, PointToPlane, preprocess
from mcgicp_jax._local_geometry import local_statistics as _local
from mcgicp_jax._local_geometry.local_geometry import weighted_covariance
from mcgicp_jax._local_geometry.local_statistics import local_geometries
from mcgicp_jax._local_geometry.spacing_and_noise import channel_noise
from mcgicp_jax._math import statistics as _statistics
from mcgicp_jax._math import symmetric_matrices as cov
from mcgicp_jax._methods.surfaces import surface_pair
from tests import reference as ref
from tests import scenes
from tests.reference import tolerance
from tests.scenes import prepare

K = 20
EPSILON = 1e-3
REGULARISATION = 1e-6


@functools.cache
def cloud_of(num_points, num_channels):
    points, channels = ref.scene(num_points, num_channels, seed=num_channels)
    cloud = preprocess(PointCloud(points, channels), num_neighbors=K)
    return cloud.pad(num_points + 10)


@functools.cache
def neighbors_of(num_points, num_channels):
    points, _ = ref.scene(num_points, num_channels, seed=num_channels)
    return ref.nearest(points, points, K)


def covariances(method, cloud):
    """As the step sees them: compiled."""
    return ref.symmetric(prepare(method, cloud).covariance.T)[: len(cloud)]


def compare(actual, expected, f32=3e-4, f64=1e-9):
    np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance(f32, f64))


def full_lambda(num_channels, seed=0):
    root = np.random.default_rng(seed).normal(size=(num_channels, num_channels))
    return 0.2 * (root @ root.T / num_channels + 0.3 * np.eye(num_channels))


@pytest.mark.parametrize("num_points", [150, 2000])
def test_gicp_against_the_reference(num_points):
    points, _ = ref.scene(num_points, 3, seed=3)
    expected = ref.gicp_covariances(points, neighbors_of(num_points, 3), EPSILON)
    compare(covariances(GICP(EPSILON), cloud_of(num_points, 3)), expected)


def test_point_to_plane_against_the_reference():
    points, _ = ref.scene(2000, 3, seed=3)
    normals = np.array([ref.normal(points[row]) for row in neighbors_of(2000, 3)])
    compare(covariances(PointToPlane(), cloud_of(2000, 3)), normals[:, :, None] * normals[:, None, :])


@pytest.mark.parametrize(
    "num_points, num_channels, channel_covariance",
    [
        (150, 3, full_lambda(3)),
        (2000, 1, 0.3),
        (2000, 3, 0.3),
        (2000, 3, np.array([0.1, 0.3, 0.9])),
        (2000, 3, full_lambda(3)),
        (2000, 5, full_lambda(5)),
    ],
    ids=["small", "1-scalar", "3-scalar", "3-variances", "3-full", "5-full"],
)
def test_multichannel_against_the_reference(num_points, num_channels, channel_covariance):
    points, channels = ref.scene(num_points, num_channels, seed=num_channels)
    args = (points, channels, neighbors_of(num_points, num_channels), channel_covariance, EPSILON)
    method = MultiChannelGICP(channel_covariance, 0.1, EPSILON, min_eigenvalue=1e-3)
    actual = covariances(method, cloud_of(num_points, num_channels))
    compare(actual, ref.multi_channel_covariances(*args, 1e-3, REGULARISATION))
    # Against the paper's own formula, without the regularisation that ours needs elsewhere.
    compare(actual, ref.multi_channel_covariances(*args, 1e-3), 3e-4, 2e-4)


def partial(num_points, num_channels, share=0.6, seed=0):
    """Which points have which channels: some all, some none, some here and there."""
    present = np.random.default_rng(seed).random((num_points, num_channels)) < share
    present[: num_points // 4] = True
    present[num_points // 4 : num_points // 3] = False
    return present


@pytest.mark.parametrize(
    "num_points, channel_covariance",
    [(150, 0.3), (150, np.array([0.1, 0.3, 0.9])), (150, full_lambda(3)), (2000, full_lambda(3))],
    ids=["scalar", "variances", "full", "full-2000"],
)
def test_missing_channels_against_the_reference(num_points, channel_covariance):
    points, channels = ref.scene(num_points, 3, seed=3)
    present = partial(num_points, 3)
    args = (points, channels, neighbors_of(num_points, 3), channel_covariance, EPSILON, 1e-3, REGULARISATION)
    cloud = preprocess(PointCloud(points, np.where(present, channels, np.nan), channel_valid=present), num_neighbors=K)
    actual = covariances(MultiChannelGICP(channel_covariance, 0.1, EPSILON, min_eigenvalue=1e-3), cloud)
    compare(actual, ref.multi_channel_covariances(*args, present))


@pytest.mark.parametrize("channel_covariance", [0.3, full_lambda(3)], ids=["scalar", "full"])
def test_a_mask_that_misses_nothing_changes_nothing(channel_covariance):
    cloud, method = cloud_of(150, 3), MultiChannelGICP(channel_covariance, 0.1)
    whole = cloud.replace(channel_valid=np.ones(cloud.channels.shape, bool))
    compare(covariances(method, whole), covariances(method, cloud), 1e-5, 1e-12)


def test_a_channel_that_nobody_has_changes_nothing():
    """Nor does one that is seen at a single point of each neighbourhood, or nowhere near."""
    cloud = cloud_of(150, 3)
    method = MultiChannelGICP(full_lambda(3), 0.1)
    some = np.ones(cloud.channels.shape, bool)
    some[:, 2] = False
    without = cloud.replace(channels=cloud.channels[:, :2])
    expected = covariances(MultiChannelGICP(full_lambda(3)[:2, :2], 0.1), without)
    compare(covariances(method, cloud.replace(channel_valid=some)), expected, 1e-5, 1e-12)
    some[7, 2] = True
    compare(covariances(method, cloud.replace(channel_valid=some)), expected, 1e-5, 1e-12)
    nothing = cloud.replace(channel_valid=np.zeros_like(some))
    compare(covariances(method, nothing), covariances(GICP(), cloud), 1e-6, 1e-12)


@pytest.mark.parametrize("channels", ["none", "uniform"])
def test_without_contrast_it_is_gicp(channels):
    """To rounding: the two are different programs, which round differently."""
    points, _ = ref.scene(2000, 3, seed=3)
    values = None if channels == "none" else np.full((2000, 3), [0.1, 77.7, -3e4])
    cloud = preprocess(PointCloud(points, values), num_neighbors=K)
    method = MultiChannelGICP(0.3, 0.1, EPSILON)
    compiled = prepare(method, cloud).covariance, prepare(GICP(EPSILON), cloud).covariance
    np.testing.assert_allclose(*compiled, rtol=0, atol=8 * np.finfo(dtype()).eps)


def test_a_wide_kernel_tends_to_gicp():
    cloud = cloud_of(2000, 3)
    compare(covariances(MultiChannelGICP(1e12, 0.1, EPSILON), cloud), covariances(GICP(EPSILON), cloud), 1e-5, 1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_it_turns_with_the_cloud(seed):
    """Which orthonormal tangent basis was chosen cannot be seen from outside."""
    R = ref.rotation(np.random.default_rng(seed).normal(size=3) * 2)
    cloud = cloud_of(2000, 3)
    method = MultiChannelGICP(full_lambda(3), 0.1, EPSILON)
    turned = cloud.replace(points=jnp.asarray(np.asarray(cloud.points, float) @ R.T, cloud.points.dtype))
    compare(covariances(method, turned), R @ covariances(method, cloud) @ R.T, 5e-4, 1e-9)


@functools.cache
def edge(angle):
    """A flat grid, half of it of another colour; the line between runs at the angle through the middle."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-7, 8) * 0.1, np.arange(-7, 8) * 0.1))
    across = -np.sin(angle) * x + np.cos(angle) * y
    cloud = preprocess(PointCloud(np.stack([x, y, 0 * x], axis=1), (across > -1e-9).astype(float)), num_neighbors=25)
    return covariances(MultiChannelGICP(0.02, 0.1, EPSILON), cloud)[7 * 15 + 7]


def test_an_edge_at_45_degrees_is_seen_in_the_off_diagonal():
    C = edge(np.pi / 4)
    along, across = np.array([1, 1, 0]) / np.sqrt(2), np.array([-1, 1, 0]) / np.sqrt(2)
    assert C[0, 1] > 0.2
    assert along @ C @ along > 0.9 > 0.6 > across @ C @ across
    assert across @ C @ along == pytest.approx(0, abs=1e-5)
    assert C[2, 2] == pytest.approx(EPSILON, abs=1e-6)


def test_an_edge_along_an_axis_is_on_the_diagonal():
    C = edge(0.0)
    assert C[0, 0] > 0.9 > 0.6 > C[1, 1]
    assert C[0, 1] == pytest.approx(0, abs=1e-5)


def test_eigenvalues_of_omega_may_exceed_one():
    """No cap: a point in the middle of a dark neighbourhood whose like lie at its rim varies more than all of it."""
    largest = np.linalg.eigvalsh(covariances(MultiChannelGICP(0.3, 0.1, EPSILON), cloud_of(2000, 3)))[:, 2]
    assert largest.max() > 1.5
    points, channels = ref.scene(2000, 3, seed=3)
    expected = ref.multi_channel_covariances(points, channels, neighbors_of(2000, 3), 0.3, EPSILON, 1e-3)
    compare(largest, np.linalg.eigvalsh(expected)[:, 2], 3e-4, 2e-4)


@pytest.mark.parametrize("floor", [1e-4, 1e-2, 0.3])
def test_the_floor_of_omega(floor):
    """Every point unlike all others: Ω would be 0, the covariance singular."""
    rng = np.random.default_rng(0)
    points, _ = ref.scene(2000, 3, seed=3)
    cloud = cloud_of(2000, 3)
    channels = np.zeros(cloud.channels.shape)
    channels[:2000] = rng.permutation(2000)[:, None]
    cloud = cloud.replace(channels=jnp.asarray(channels, cloud.points.dtype))
    actual = covariances(MultiChannelGICP(1e-6, 0.1, EPSILON, min_eigenvalue=floor), cloud)
    normals = np.array([ref.normal(points[row]) for row in neighbors_of(2000, 3)])
    plane = np.eye(3) - normals[:, :, None] * normals[:, None, :]
    compare(actual, floor * plane + EPSILON * (np.eye(3) - plane), 1e-5, 2e-4 * floor)


def test_a_doubled_channel_with_doubled_variances_changes_nothing():
    """dᵀΛ⁻¹d = 2 dᵀ(2Λ)⁻¹d."""
    cloud, single = cloud_of(2000, 3), full_lambda(3)
    doubled = np.kron(np.eye(2), 2 * single)
    twice = cloud.replace(channels=jnp.concatenate([cloud.channels, cloud.channels], axis=1))
    actual = covariances(MultiChannelGICP(doubled, 0.1, EPSILON), twice)
    compare(actual, covariances(MultiChannelGICP(single, 0.1, EPSILON), cloud), 1e-5, 1e-9)


def test_the_unit_of_a_channel_does_not_matter():
    cloud, single = cloud_of(2000, 3), full_lambda(3)
    units = np.array([1e-3, 1.0, 255.0])
    scaled = cloud.replace(channels=cloud.channels * jnp.asarray(units, cloud.points.dtype))
    actual = covariances(MultiChannelGICP(single * np.outer(units, units), 0.1, EPSILON), scaled)
    compare(actual, covariances(MultiChannelGICP(single, 0.1, EPSILON), cloud), 2e-5, 1e-9)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_the_unit_of_length_does_not_matter(scale):
    cloud, method = cloud_of(2000, 3), MultiChannelGICP(0.3, 0.1, EPSILON)
    scaled = cloud.replace(points=cloud.points * jnp.asarray(scale, cloud.points.dtype))
    compare(covariances(method, scaled), covariances(method, cloud), 5e-4, 1e-9)


@pytest.mark.parametrize("argument", [1, 2], ids=["channels", "Λ"])
def test_gradients_through_missing_channels(argument):
    """Exact where there is something, and 0, never NaN, where there is not."""
    rng = np.random.default_rng(argument)
    points, channels = ref.scene(150, 3, seed=3)
    present, neighbors = partial(150, 3), neighbors_of(150, 3)
    cloud = preprocess(PointCloud(points, channels, channel_valid=present), num_neighbors=K).pad(160)
    weights = rng.normal(size=(150, 3, 3))
    weights += weights.swapaxes(1, 2)
    at = [channels, full_lambda(3)]
    direction = rng.normal(size=at[argument - 1].shape)
    direction = direction + direction.T if argument == 2 else direction

    def expected_sum(value):
        args = [points, *at[: argument - 1], value, *at[argument:]]
        args.insert(2, neighbors)
        found = ref.multi_channel_covariances(*args, EPSILON, 1e-3, REGULARISATION, present)
        return np.sum(weights * found)

    expected = ref.difference(expected_sum, at[argument - 1], direction, 1e-6)
    packed = np.zeros((6, cloud.points.shape[0]))
    packed[:, :150] = ref.packed(2 * weights * (1 - np.eye(3)) + weights * np.eye(3))
    dtype = cloud.points.dtype
    inputs = [jnp.full((160, 3), jnp.nan, dtype).at[:150].set(channels.astype(dtype)), jnp.asarray(at[1], dtype)]
    inputs[0] = jnp.where(cloud.channel_valid, inputs[0], jnp.nan)
    _, gradients = weighted_sum_and_gradients(
        cloud.points, *inputs, jnp.asarray(EPSILON, dtype), cloud, jnp.asarray(packed, dtype), False
    )
    gradient = np.asarray(gradients[argument], float)
    if argument == 1:
        np.testing.assert_array_equal(gradient[~np.asarray(cloud.channel_valid)], 0)
        gradient = gradient[:150]
    assert np.sum(gradient * direction) == pytest.approx(expected, rel=tolerance(3e-3, 1e-6))


def weighted_sum(points, channels, channel_covariance, epsilon, cloud, weights, as_gicp):
    method = GICP(epsilon) if as_gicp else MultiChannelGICP(channel_covariance, 0.1, epsilon, min_eigenvalue=1e-3)
    return jnp.sum(weights * scenes.covariances(method, cloud.replace(points=points, channels=channels)))


weighted_sum_and_gradients = jax.jit(jax.value_and_grad(weighted_sum, argnums=(0, 1, 2, 3)), static_argnums=6)


def awkward(kind):
    rng = np.random.default_rng(0)
    points, channels = ref.scene(150, 3, seed=3)
    if kind == "collinear along an axis":
        points[:, 1:] = 0
    elif kind == "collinear":
        points = points[:, :1] * np.array([[0.3, -0.5, 0.81]])
    elif kind == "coincident":
        points[:] = [1.0, 2.0, 3.0]
    elif kind == "half coincident":
        points[:75] = points[0]
    elif kind == "flat":
        points[:, 2] = 0
    elif kind == "isotropic":
        points = np.concatenate([sign * radius * np.eye(3) for sign in (1, -1) for radius in range(1, 26)])
    elif kind == "fewer than k":
        points, channels = points[:7], channels[:7]
    elif kind == "four points":
        points, channels = points[:4], channels[:4]
    elif kind == "far":
        points = points + np.array([3e3, -2e3, 1e3])
    elif kind == "wild channels":
        channels = channels * 10.0 ** rng.integers(-15, 15, size=channels.shape)
    cloud = preprocess(PointCloud(points, channels), num_neighbors=K)
    return cloud.pad(160)


AWKWARD = [
    *("collinear along an axis", "collinear", "coincident", "half coincident", "flat", "isotropic"),
    *("fewer than k", "four points", "far", "wild channels"),
]


@pytest.mark.parametrize("kind", AWKWARD)
@pytest.mark.parametrize("as_gicp", [False, True])
def test_awkward_neighbourhoods_stay_finite_in_value_and_gradient(kind, as_gicp):
    cloud = awkward(kind)
    dtype = cloud.points.dtype
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(6, cloud.points.shape[0])), dtype)
    arguments = (cloud.points, cloud.channels, 0.3 * jnp.eye(3, dtype=dtype), jnp.asarray(EPSILON, dtype))
    value, gradients = weighted_sum_and_gradients(*arguments, cloud, weights, as_gicp)
    assert np.isfinite(value)
    for gradient in gradients:
        assert np.isfinite(gradient).all()
    method = GICP(EPSILON) if as_gicp else MultiChannelGICP(0.3 * np.eye(3), 0.1, EPSILON)
    values = np.linalg.eigvalsh(covariances(method, cloud))
    assert values.min() > 0.5 * EPSILON
    assert values.max() < 10


@pytest.mark.parametrize("as_gicp", [False, True])
def test_fewer_points_than_neighbours(as_gicp):
    points, channels = (array[:7] for array in ref.scene(150, 3, seed=3))
    everyone = np.tile(np.arange(7), (7, 1))
    method = GICP(EPSILON) if as_gicp else MultiChannelGICP(0.3 * np.eye(3), 0.1, EPSILON)
    expected = ref.gicp_covariances(points, everyone, EPSILON)
    if not as_gicp:
        expected = ref.multi_channel_covariances(points, channels, everyone, 0.3, EPSILON, 1e-3, REGULARISATION)
    compare(covariances(method, awkward("fewer than k")), expected)


def test_on_a_line_omega_is_one_across_it():
    """Along it, the ratio of the weighted to the plain variance; across it the points say nothing."""
    cloud = awkward("collinear")
    line = np.array([0.3, -0.5, 0.81]) / np.linalg.norm([0.3, -0.5, 0.81])
    found = covariances(MultiChannelGICP(0.3 * np.eye(3), 0.1, EPSILON), cloud)
    points, channels = (np.asarray(array, float)[:150] for array in (cloud.points, cloud.channels))
    expected = []
    for i, row in enumerate(np.asarray(cloud.neighbors)[:150]):
        along = (points[row] - points[i]) @ line
        kernel = np.exp(-0.5 * np.sum((channels[row] - channels[i]) ** 2, axis=1) / 0.3)
        kernel /= kernel.sum()
        expected.append(kernel @ (along - kernel @ along) ** 2 / along.var())
    # In float32 the variance across the line is rounding: over twelve clouds and two sets of instructions the errors
    # reach 0.029 along it and 0.13 across it.
    np.testing.assert_allclose(line @ found @ line, np.maximum(expected, 1e-3), atol=tolerance(5e-2, 1e-4))
    across = np.trace(found, axis1=1, axis2=2) - line @ found @ line
    np.testing.assert_allclose(across, 1 + EPSILON, atol=tolerance(0.2, 1e-4))


def test_coincident_neighbours_make_the_identity_and_no_gradient():
    found = covariances(MultiChannelGICP(0.3 * np.eye(3), 0.1), awkward("coincident"))
    np.testing.assert_array_equal(found, np.broadcast_to(np.eye(3), (150, 3, 3)))


def test_padding_makes_the_identity():
    surface = prepare(MultiChannelGICP(0.3 * np.eye(3), 0.1), cloud_of(150, 3))
    np.testing.assert_array_equal(ref.symmetric(surface.covariance.T)[150:], np.broadcast_to(np.eye(3), (10, 3, 3)))


@pytest.mark.parametrize("argument", range(4), ids=["points", "channels", "Λ", "ε"])
@pytest.mark.parametrize("as_gicp", [False, True])
def test_gradients_against_differences_of_the_reference(argument, as_gicp):
    if as_gicp and argument in (1, 2):
        pytest.skip("GICP has none")
    rng = np.random.default_rng(argument)
    cloud, neighbors = cloud_of(150, 3), neighbors_of(150, 3)
    points, channels = ref.scene(150, 3, seed=3)
    weights = rng.normal(size=(150, 3, 3))
    weights += weights.swapaxes(1, 2)
    at = [points, channels, full_lambda(3), np.array(EPSILON)]
    direction = rng.normal(size=at[argument].shape)
    if argument == 2:
        direction = direction + direction.T

    def expected_sum(value):
        args = [*at[:argument], value, *at[argument + 1 :]]
        if as_gicp:
            return np.sum(weights * ref.gicp_covariances(args[0], neighbors, args[3]))
        found = ref.multi_channel_covariances(args[0], args[1], neighbors, args[2], args[3], 1e-3, REGULARISATION)
        return np.sum(weights * found)

    expected = ref.difference(expected_sum, at[argument], direction, 1e-6)
    dtype = cloud.points.dtype
    twice = 2 * weights * (1 - np.eye(3)) + weights * np.eye(3)
    packed = np.zeros((6, cloud.points.shape[0]))
    packed[:, :150] = ref.packed(twice)
    inputs = [cloud.points, cloud.channels, *(jnp.asarray(value, dtype) for value in at[2:])]
    _, gradients = weighted_sum_and_gradients(*inputs, cloud, jnp.asarray(packed, dtype), as_gicp)
    gradient = np.asarray(gradients[argument], float)
    if argument < 2:
        assert not gradient[150:].any()
        gradient = gradient[:150]
    assert np.sum(gradient * direction) == pytest.approx(expected, rel=tolerance(3e-3, 1e-6))


# Algebra: 512 matrices at a time, of every kind.
SEEDS = st.integers(0, 2**31)
SCALES = st.floats(-6, 6).map(lambda power: 10.0**power)
KINDS = ("random", "flat", "line", "near line", "isotropic", "near isotropic", "zero")
EXAMPLES = settings(max_examples=15, deadline=None)


def dtype():
    return jnp.zeros(()).dtype


def random_symmetric(seed, size, eigenvalues):
    """Matrices with the given (N, size) eigenvalues, rounded to the precision of the run."""
    orthogonal = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(eigenvalues), size, size)))[0]
    matrices = orthogonal * eigenvalues[:, None, :] @ orthogonal.swapaxes(1, 2)
    packed = jnp.asarray(ref.packed(matrices), dtype())
    return packed, ref.symmetric(packed)


def eigenvalues_of(kind, seed):
    rng = np.random.default_rng(seed)
    a, b, c = rng.uniform(0.1, 1, (3, 512))
    zero = np.zeros(512)
    values = {
        "random": (a, b, c),
        "flat": (a, b, zero),
        "line": (a, zero, zero),
        "near line": (a, 1e-4 * b, 1e-6 * c),
        "isotropic": (a, a, a),
        "near isotropic": (a, a * (1 + 1e-5), a * (1 - 1e-5)),
        "zero": (zero, zero, zero),
    }[kind]
    return np.stack(values, axis=1)


smallest_eigenvector = jax.jit(cov.smallest_eigenvector)


@pytest.mark.parametrize("kind", KINDS)
@EXAMPLES
@given(seed=SEEDS, scale=SCALES)
def test_smallest_eigenvector(kind, seed, scale):
    packed, matrices = random_symmetric(seed, 3, scale * eigenvalues_of(kind, seed))
    normal = np.asarray(smallest_eigenvector(packed), float).T
    eps = np.finfo(dtype()).eps
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=16 * eps)
    # Backward stable: it has the smallest eigenvalue to rounding, whatever the gap.
    trace = np.trace(matrices, axis1=1, axis2=2)
    quotient = np.einsum("ni,nij,nj->n", normal, matrices, normal)
    values, vectors = np.linalg.eigh(matrices)
    assert np.all(np.abs(quotient - values[:, 0]) <= 64 * eps * trace)
    # And where there is a gap, it is the vector.
    gap = (values[:, 1] - values[:, 0]) / np.where(trace > 0, trace, 1)
    error = np.linalg.norm(np.cross(normal, vectors[:, :, 0]), axis=1)
    assert np.all(error * gap <= 64 * eps)


def test_derivative_of_the_smallest_eigenvector():
    packed, matrices = random_symmetric(3, 3, np.random.default_rng(3).uniform(0.1, 1, (512, 3)) * [[1, 0.8, 0.05]])
    change = np.random.default_rng(4).normal(size=(512, 3, 3))
    change = change + change.swapaxes(1, 2)
    tangent = jnp.asarray(ref.packed(change), dtype())
    normal, derivative = jax.jit(lambda p, t: jax.jvp(cov.smallest_eigenvector, (p,), (t,)))(packed, tangent)
    normal = np.asarray(normal, float).T

    def vector(A):
        found = np.linalg.eigh(A)[1][:, :, 0]
        return found * np.sign(np.sum(found * normal, axis=1))[:, None]

    gaps = np.diff(np.linalg.eigvalsh(matrices))[:, 0]
    expected = ref.difference(vector, matrices, change, 1e-6)
    error = np.abs(np.asarray(derivative).T - expected).max(axis=1)
    clear = gaps > 0.05
    assert clear.sum() > 200
    assert np.all(error[clear] <= tolerance(1e-3, 1e-6) * (1 + np.abs(expected).max(axis=1)[clear]))


@pytest.mark.parametrize("kind", KINDS)
@EXAMPLES
@given(seed=SEEDS, scale=SCALES)
def test_derivative_of_the_smallest_eigenvector_is_finite(kind, seed, scale):
    packed, _ = random_symmetric(seed, 3, scale * eigenvalues_of(kind, seed))
    assert np.isfinite(eigenvector_gradient(packed)).all()


eigenvector_gradient = jax.jit(jax.grad(lambda packed: jnp.sum(cov.smallest_eigenvector(packed) ** 3)))


def test_an_isotropic_neighbourhood_has_no_derivative():
    identity = jnp.tile(jnp.array([[1.0], [0.0], [0.0], [1.0], [0.0], [1.0]]), (1, 512))
    np.testing.assert_array_equal(eigenvector_gradient(identity), 0)
    np.testing.assert_array_equal(eigenvector_gradient(jnp.zeros((6, 512))), 0)


@EXAMPLES
@given(seed=SEEDS, scale=SCALES)
def test_orthonormal_basis(seed, scale):
    normal = np.random.default_rng(seed).normal(size=(3, 512))
    normal[:2, :100] *= min(scale, 1)
    normal[:, :6] = np.concatenate([np.eye(3), -np.eye(3)], axis=1)
    normal /= np.linalg.norm(normal, axis=0)
    u, v = jax.jit(cov.orthonormal_basis)(jnp.asarray(normal, dtype()))
    frames = np.stack([u, v, jnp.asarray(normal, dtype())], axis=-1).transpose(1, 0, 2).astype(float)
    eps = np.finfo(dtype()).eps
    np.testing.assert_allclose(frames.swapaxes(1, 2) @ frames, np.broadcast_to(np.eye(3), (512, 3, 3)), atol=16 * eps)
    np.testing.assert_allclose(np.linalg.det(frames), 1, atol=16 * eps)


def positive(seed, size):
    return np.random.default_rng(seed).uniform(0.05, 1, (512, size))


@EXAMPLES
@given(seed=SEEDS, scale=SCALES)
def test_inverse_of_3x3(seed, scale):
    packed, matrices = random_symmetric(seed, 3, scale * positive(seed, 3))
    actual = ref.symmetric(jax.jit(cov.inverse)(packed))
    np.testing.assert_allclose(actual @ matrices, np.broadcast_to(np.eye(3), (512, 3, 3)), atol=tolerance(5e-4, 1e-11))


@EXAMPLES
@given(seed=SEEDS, scale=SCALES)
def test_inverse_square_root_of_2x2(seed, scale):
    packed, matrices = random_symmetric(seed, 2, scale * positive(seed, 2))
    root = ref.symmetric(jax.jit(cov.inverse_square_root)(packed))
    product = root @ matrices @ root
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(2), (512, 2, 2)), atol=tolerance(1e-4, 1e-12))
    assert np.all(np.linalg.eigvalsh(root) > 0)


@EXAMPLES
@given(seed=SEEDS, scale=SCALES)
def test_sandwich(seed, scale):
    outside, W = random_symmetric(seed, 2, scale * positive(seed, 2))
    inside, A = random_symmetric(seed + 1, 2, positive(seed + 1, 2))
    actual = ref.symmetric(jax.jit(cov.sandwich)(outside, inside)) / scale**2
    np.testing.assert_allclose(actual, W @ A @ W / scale**2, atol=tolerance(1e-6, 1e-14))


@EXAMPLES
@given(seed=SEEDS, scale=SCALES, low=st.floats(-1, 1))
def test_floor_eigenvalues(seed, scale, low):
    values = scale * np.random.default_rng(seed).uniform(-1, 1, (512, 2))
    values[:50] = values[:50, :1]
    packed, matrices = random_symmetric(seed, 2, values)
    floor = jnp.asarray(scale * low, dtype())
    actual = jax.jit(cov.floor_eigenvalues)(packed, floor)
    values, vectors = np.linalg.eigh(matrices)
    expected = vectors * np.maximum(values, float(floor))[:, None, :] @ vectors.swapaxes(1, 2)
    eps = np.finfo(dtype()).eps
    np.testing.assert_allclose(ref.symmetric(actual), expected, atol=16 * eps * scale)
    above = values[:, 0] > float(floor) + 16 * eps * scale
    np.testing.assert_array_equal(np.asarray(actual)[:, above], np.asarray(packed)[:, above])


def test_gradient_of_the_floor_is_finite():
    packed = jnp.array([[1.0, 0, -1, 0.5], [0, 0, 0, 0], [1.0, 0, -1, 0.5]])
    gradient = jax.grad(lambda p: jnp.sum(cov.floor_eigenvalues(p, jnp.asarray(0.5)) ** 2))(packed)
    assert np.isfinite(gradient).all()


@EXAMPLES
@given(seed=SEEDS)
def test_rotate_multiply_and_outer(seed):
    rng = np.random.default_rng(seed)
    packed, matrices = random_symmetric(seed, 3, positive(seed, 3))
    R, vectors = ref.rotation(rng.normal(size=3)), rng.normal(size=(512, 3))
    atol = tolerance(2e-6, 1e-14)
    rotated = jax.jit(cov.rotate)(jnp.asarray(R, dtype()), packed)
    np.testing.assert_allclose(ref.symmetric(rotated), R @ matrices @ R.T, atol=atol)
    columns = jnp.asarray(vectors.T, dtype())
    moved = np.asarray(jax.jit(cov.multiply)(packed, columns)).T
    np.testing.assert_allclose(moved, np.einsum("nij,nj->ni", matrices, vectors), atol=atol)
    products = ref.symmetric(jax.jit(cov.outer)(columns))
    np.testing.assert_allclose(products, vectors[:, :, None] * vectors[:, None, :], atol=2 * atol)
    np.testing.assert_allclose(cov.matrix_from_symmetric(packed), matrices, atol=0)
    np.testing.assert_allclose(cov.symmetric_from_matrix(jnp.asarray(matrices, dtype())), packed, atol=0)


@pytest.mark.parametrize(
    "method, masked",
    [(GICP(), False), (MultiChannelGICP(0.3 * np.eye(3), 0.1), True)],
    ids=["GICP", "MultiChannelGICP, some channels missing"],
)
def test_surfaces_are_the_same_block_by_block_and_inside_transformations(method, masked, monkeypatch):
    """Blocks that do not come out even, on the host; whole arrays, and the blocks of large ones, inside; gradients."""
    points, channels = ref.scene(700, 3, seed=4)
    mask = np.random.default_rng(0).random((700, 3)) < 0.8 if masked else None
    cloud = preprocess(PointCloud(points, channels, channel_valid=mask), num_neighbors=K)
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(700, 9)), cloud.points.dtype)
    everything = jax.tree.leaves(surface_pair(method, cloud, cloud, observed=True).source)

    def traced():
        def surface(points):
            found = surface_pair(method, cloud.replace(points=points), cloud, observed=True).source
            return jnp.sum(weights * jnp.concatenate([found.points, found.covariance], axis=1)), found

        return jax.jit(jax.grad(surface, has_aux=True))(jnp.asarray(cloud.points))

    slope, whole = traced()
    monkeypatch.setattr(_local, "_LARGEST_WHOLE", 100)
    monkeypatch.setattr(_local, "_LARGEST_BLOCK", 128)
    slope_by_blocks, by_blocks = traced()
    for found in (whole, by_blocks):
        for one, other in zip(jax.tree.leaves(found), everything, strict=True):
            np.testing.assert_allclose(one, other, rtol=tolerance(1e-3, 1e-9), atol=tolerance(2e-4, 1e-9))
    scale = np.abs(slope).max()
    np.testing.assert_allclose(slope_by_blocks, slope, atol=scale * tolerance(1e-4, 1e-9))


def test_noise_is_the_same_inside_transformations():
    points, channels = ref.scene(700, 3, seed=4)
    clouds = [preprocess(PointCloud(points, channels + i), num_neighbors=K) for i in (0, 1)]
    expected = channel_noise(*clouds, local_geometries(*clouds, with_channels=True))
    actual = jax.jit(lambda a, b: channel_noise(a, b, local_geometries(a, b, with_channels=True)))(*clouds)
    for one, other in zip(actual, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=tolerance(1e-4, 1e-9))


def test_weighted_covariance_is_that_of_numpy():
    """At a size at which jaxlib 0.10.2 miscompiled the reduction over stacked coordinates."""
    rng = np.random.default_rng(0)
    offsets, weights = rng.normal(size=(3, 20, 2000)), rng.random((20, 2000))
    found = jax.jit(weighted_covariance)(
        tuple(jnp.asarray(each, float) for each in offsets), jnp.asarray(weights, float)
    )
    expected = [np.cov(offsets[:, :, i], aweights=weights[:, i], ddof=0) for i in range(2000)]
    np.testing.assert_allclose(ref.symmetric(found), expected, atol=tolerance(1e-5, 1e-12))


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
    np.testing.assert_allclose(
        np.asarray(actual)[[0, 2, 3]], np.nanmedian(values[[0, 2, 3]], axis=1), rtol=tolerance(1e-6, 1e-12)
    )
    assert np.isnan(actual[1])
    slope = jax.grad(lambda scale: jnp.sum(_statistics.median(scale * jnp.asarray(values[2:], float))))(1.0)
    assert slope == 0
