"""A toy of every kind of extension, each in one place and without an import of a private module."""

import pathlib
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax import extend
from mcgicp_jax.extend import symmetric_matrices as alg
from tests.compilations import compilations
from tests.refusals import refused
from tests.scenes import motion, pair

ROOT = pathlib.Path(__file__).parent.parent


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
        lengths = np.linalg.norm(queries[:, None] - tree, axis=2)
        rows = np.argpartition(lengths, min(k, len(tree)) - 1, axis=1)[:, :k]
        rows = np.take_along_axis(rows, np.argsort(np.take_along_axis(lengths, rows, axis=1), axis=1), axis=1)
        distances = np.take_along_axis(lengths, rows, axis=1)
        near = distances < bound
        return np.where(near, distances, np.inf), np.where(near, rows, len(tree))


class PseudoHuber(mcg.AbstractKernel):
    """A robust kernel: ρ = 2k² (√(1 + s²/k²) − 1)."""

    def _rho(self, square, scale):
        return 2 * scale**2 * (jnp.sqrt(1 + square / scale**2) - 1)

    def _weight(self, square, scale):
        return 1 / jnp.sqrt(1 + square / scale**2)


# A file format: coordinates as text.
TOY = mcg.io.Format(
    lambda file, size: mcg.PointCloud(np.loadtxt(file)), lambda file, cloud: np.savetxt(file, cloud.points)
)


class Folder(mcg.datasets.AbstractFrames):
    """A data set: the clouds of a folder, without poses."""

    def __init__(self, folder):
        self.paths = sorted(folder.iterdir())
        super().__init__(len(self.paths))

    def _frame(self, index):
        return mcg.datasets.Frame(mcg.io.read(self.paths[index]))


class Inclination(extend.AbstractFactor):
    """A graph factor: the vertical as a sensor measures it in its own frame, unit vectors (m, 3)."""

    rows: Any
    information: Any
    uncertain: Any
    vertical: Any

    def linearize(self, poses):
        measured = poses[:, 1, 2, :3]
        x, y, z = measured.T
        jacobians = np.zeros((len(poses), 2, 3, 6))
        # T exp(ξ) turns the vertical in the sensor's frame by −ω.
        jacobians[:, 1, :, 3:] = np.moveaxis(np.array([[0 * x, -z, y], [z, 0 * x, -x], [-y, x, 0 * x]]), 2, 0)
        return measured - self.vertical, jacobians


def test_a_method():
    source, target, truth = pair(size=400)
    result = mcg.register(source, target, Ridge(), max_distance=0.3)
    assert result.converged and max(mcg.metrics.pose_error(result.matrix, truth)) < 0.02
    assert np.isfinite(result.covariance).all()
    options = {"max_distance": 0.3, "search": mcg.DenseSearch()}
    inside = jax.jit(lambda s, t: mcg.register(s, t, Ridge(), **options).matrix)(source, target)
    np.testing.assert_allclose(inside, result.matrix, atol=1e-6)


def test_a_term():
    source, target, truth = pair(size=400)
    plain, both = (mcg.register(source, target, method, max_distance=0.3) for method in (mcg.GICP(), Prior()))
    assert both.converged and max(mcg.metrics.pose_error(both.matrix, truth)) < 0.02
    assert np.abs(both.matrix - plain.matrix).max() > 1e-5
    assert np.all(np.linalg.eigvalsh(both.information - plain.information) > 0)

    def balance(points):
        """The pose rests where all forces do, and has the derivative of that."""
        matrix = mcg.register(source.replace(points=points), target, Prior(), max_distance=0.3).matrix
        return jnp.sum(matrix[:3] * jnp.arange(12.0).reshape(3, 4))

    gradient = jax.grad(balance)(jnp.asarray(source.points))
    assert np.isfinite(gradient).all()
    # To move the whole source is to move the pose the other way.
    np.testing.assert_allclose(
        np.sum(np.asarray(gradient), axis=0), -np.asarray([3.0, 7.0, 11.0]) @ np.asarray(both.matrix)[:3, :3], atol=2e-2
    )


def test_a_tree():
    source, target, _ = pair(size=400, truth=motion((0.02, 0.01, 0, 0, 0.01, 0.02)))
    searches = BruteForce(), mcg.KDTreeSearch()
    np.testing.assert_array_equal(*(search.neighbors(target.points, 20) for search in searches))
    for method in (mcg.GICP(), mcg.MultiChannelGICP()):
        results = [mcg.register(source, target, method, search=search).matrix for search in searches]
        np.testing.assert_array_equal(*results)


def test_a_robust_kernel():
    *clouds, truth = pair(size=400)
    squares = jnp.linspace(0, 9, 7)
    slopes = jax.jit(jax.vmap(jax.grad(lambda square: PseudoHuber(1.5).rho(square[None])[0])))(squares)
    np.testing.assert_allclose(PseudoHuber(1.5).weight(squares), slopes, rtol=1e-5)
    # A tenth of the source is off by 0.2 m.
    points = np.array(clouds[0].points)
    points[::10] += 0.2
    clouds[0], options = clouds[0].replace(points=points), {"max_distance": 1.0, "init": truth}
    plain, robust = (
        mcg.register(*clouds, mcg.PointToPoint(), robust=kernel, **options) for kernel in (None, PseudoHuber(0.02))
    )
    assert plain.converged and robust.converged
    errors = [mcg.metrics.pose_error(result.matrix, truth)[0] for result in (robust, plain)]
    assert errors[0] < 0.7 * errors[1]


def test_a_file_format(tmp_path, monkeypatch):
    monkeypatch.setitem(extend.FORMATS, ".toy", TOY)
    cloud = mcg.PointCloud(np.random.default_rng(0).normal(size=(40, 3)))
    mcg.io.write(tmp_path / "cloud.TOY", cloud)
    np.testing.assert_allclose(mcg.io.read(tmp_path / "cloud.TOY").points, cloud.points, rtol=1e-12)


def test_a_data_set(tmp_path):
    source, target, truth = pair(size=400)
    for name, cloud in (("0.npy", target), ("1.npy", source)):
        mcg.io.write(tmp_path / name, cloud)
    frames = Folder(tmp_path)
    assert len(frames) == len(frames[:]) == 2 and "Folder(2 frames)" in repr(frames)
    _, second = mcg.odometry(frames, mcg.GICP(), max_distance=0.3)
    assert second.registration.converged and max(mcg.metrics.pose_error(second.pose, truth)) < 0.02


def test_a_graph_factor():
    truth, start = motion((1, 2, 0.5, 0.1, -0.2, 0.3)), motion((1.1, 2, 0.6, 0.3, 0, 0.2))
    prior = mcg.Edge(mcg.WORLD, 0, np.eye(4), 1e4 * np.eye(6))
    # It does not measure rotations about x and y.
    edge = mcg.Edge(0, 1, truth, 1e4 * np.diag([1.0, 1, 1, 0, 0, 1]))
    level = Inclination(np.array([[mcg.WORLD, 1]]), 1e4 * np.eye(3)[None], np.zeros(1, bool), truth[None, 2, :3])
    alone, both = (
        mcg.optimize_poses(mcg.PoseGraph([np.eye(4), start], [prior, edge], factors)) for factors in ([], [level])
    )
    assert alone.status == mcg.Status.DEGENERATE and both.converged
    np.testing.assert_allclose(both.poses, [np.eye(4), truth], atol=1e-6)
    assert both.factor_weights[0] == 1 and both.factor_residuals[0] < 1e-3 and np.isfinite(both.covariance).all()


def feature_cost(scale, source, target):
    """Geman-McClure's kernel of the difference of the features of matched points."""
    square = jnp.sum((source.tree - target.tree) ** 2, axis=-1) / scale**2
    return jnp.sum(jnp.where(target.index >= 0, square / (1 + square), 0))


def test_a_loss():
    """It has its derivatives outside of jit, where another size compiles nothing, and inside."""
    for size in (2500, 300, 310):
        source, target, truth = pair(size=size)
        matches = mcg.find_correspondences(source, target, truth, mcg.GICP(), max_distance=0.06)
        rows = np.where(matches.valid, matches.indices, -1)
        assert 0 < np.sum(rows < 0) < len(rows)

        def loss(channels, scale, rows=rows, target=target):
            features = extend.Input(channels), extend.Input(target.channels, rows)
            return extend.blockwise(feature_cost, scale, *features, total=True)

        arguments = jnp.asarray(source.channels), jnp.asarray(0.3)
        with compilations() as compiled:
            value, gradients = jax.value_and_grad(loss, (0, 1))(*arguments)
        expected, slopes = jax.jit(jax.value_and_grad(loss, (0, 1)))(*arguments)
        np.testing.assert_allclose(value, expected, rtol=1e-5)
        for actual, slope in zip(gradients, slopes, strict=True):
            np.testing.assert_allclose(actual, slope, rtol=1e-4, atol=1e-5 * np.abs(slope).max())
        forward = jax.jvp(loss, arguments, (gradients[0], jnp.asarray(0.0)))[1]
        np.testing.assert_allclose(forward, np.sum(gradients[0] ** 2, dtype=np.float64), rtol=1e-4)
    assert not compiled


def test_a_loss_that_is_written_wrongly_is_refused():
    points = np.zeros((5, 3))
    refused(lambda: extend.blockwise(feature_cost, 1.0, points, total=True), "inputs")
    refused(lambda: extend.blockwise(lambda _, rows: rows.tree, 1.0, extend.Input(points)), "function")


def counted(scale, rows):
    """The integers come first."""
    return ({"above": jnp.sum(rows.tree > 0, axis=1), "mean": scale * jnp.mean(rows.tree, axis=1)},)


def test_integers_beside_other_numbers_leave_these_as_they_are():
    points = np.random.default_rng(0).normal(size=(2500, 3)).astype(np.float32)
    (rows,) = extend.blockwise(counted, 0.5, extend.Input(points))
    np.testing.assert_array_equal(rows["above"], np.sum(points > 0, axis=1))
    np.testing.assert_allclose(rows["mean"], 0.5 * points.mean(axis=1), atol=1e-6)

    def loss(points):
        return jnp.sum(extend.blockwise(counted, 0.5, extend.Input(points))[0]["mean"])

    refused(lambda: jax.grad(loss)(points), "function", "int32")


@pytest.mark.slow
def test_the_command_line_has_what_is_registered(tmp_path):
    """If it is registered before the commands are imported."""
    source, target, _ = pair(size=400)
    scans, poses = tmp_path / "scans", tmp_path / "poses.txt"
    scans.mkdir()
    for name, cloud in (("0.toy", target), ("1.toy", source)):
        np.savetxt(scans / name, cloud.points)
    script = f"""
import sys
import mcgicp_jax as mcg
from mcgicp_jax import extend
from tests.test_extensions import TOY, Folder, PseudoHuber, Ridge

extend.METHODS["ridge"] = extend.RegisteredMethod(Ridge)
extend.KERNELS["pseudo-huber"] = PseudoHuber
extend.FORMATS[".toy"] = TOY
extend.DATASETS["folder"] = mcg.datasets.Dataset(Folder, (0.3, 0.3))
from mcgicp_jax.__main__ import main

options = ["--method", "ridge", "--robust", "pseudo-huber", "1.0", "--output", {str(poses)!r}]
sys.exit(main(["odometry", "folder", {str(scans)!r}, *options]))
"""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT)
    assert ended.returncode == 0 and len(mcg.io.read_poses(poses)) == 2, ended.stderr
