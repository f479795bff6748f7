"""Clouds of every size run the same few programs: compilations are counted."""

import gc
import weakref
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mcgicp_jax as mcg
from mcgicp_jax._compute import programs
from mcgicp_jax._compute.cache import Lazy
from mcgicp_jax._compute.concrete import outside_trace
from tests.compilations import compilations
from tests.scenes import room_corner

METHODS = {
    "mc-gicp": mcg.MultiChannelGICP(),
    "photometric": mcg.MultiChannelGICP(photometric=True),
    "gicp": mcg.GICP(),
    "color-icp": mcg.ColorICP(0.3),
    "point-to-plane": mcg.PointToPlane(),
    "point-to-point": mcg.PointToPoint(),
}
# Less than a block of 2,048 rows or 1,024 neighbourhoods, less than the first alone, and several of each.
SIZES = (37, 1500, 4500)


def clouds(size, names=("red", "green"), more=0, seed=0):
    """Two raw clouds of about that size, with channels that no method uses if there are `more`."""
    raw = []
    for i, number in enumerate((size, size + size // 7)):
        points, channels = room_corner(number, seed=2 * seed + i)
        channels = np.hstack([channels, np.ones((number, more))])
        raw.append(mcg.PointCloud(points, channels, channel_names=(*names, *(f"other_{j}" for j in range(more)))))
    return raw


def everything(method, raw):
    """Each function that is called outside of transformations, and everything that a result can be asked."""
    source, target = (mcg.preprocess(cloud) for cloud in raw)
    mcg.find_correspondences(source, target, np.eye(4), method, max_distance=0.5)
    result = mcg.register(source, target, method, max_distance=0.5)
    results = [result, mcg.register(*raw, method)]
    results += mcg.register_batch([source, target], [target, source], method, max_distance=0.5)
    results += [result for _, result in mcg.register_as_completed(raw, raw[::-1], method)]
    results += [step.registration for step in mcg.odometry(raw, method)][1:]
    for found in results:
        assert found.covariance.shape == found.information.shape == (6, 6)
        assert repr(found) and found.matrix.shape == (4, 4)


@pytest.mark.parametrize(
    "name", [name if name in ("mc-gicp", "gicp") else pytest.param(name, marks=pytest.mark.slow) for name in METHODS]
)
def test_other_sizes_and_names_and_unused_channels_compile_nothing(name):
    method = METHODS[name]
    everything(method, clouds(400))
    for i, size in enumerate(SIZES):
        with compilations() as found:
            everything(method, clouds(size, names=(f"x{i}", f"y{i}"), seed=i))
        assert not found, size
    if not method.uses_channels:
        with compilations() as found:
            everything(method, clouds(500, more=1))
            everything(method, clouds(400, more=4))
        assert not found


def test_cells_of_other_sizes_compile_nothing():
    def everything(seed, points, voxel_size):
        source, target = (mcg.PointCloud(*room_corner(points, seed=2 * seed + i)) for i in (0, 1))
        moving, cells = (mcg.voxel_gaussians(cloud, voxel_size) for cloud in (source, target))
        results = [mcg.register(source, cells, mcg.NDT()), mcg.register(moving, cells, mcg.D2DNDT())]
        results.append(mcg.register(source, target, mcg.NDT(), voxel_sizes=(0.8, 0.5)))
        assert all(result.covariance.shape == (6, 6) for result in results)

    everything(0, 3000, 0.4)
    with compilations() as found:
        everything(1, 5000, 0.3)
    assert not found


def test_numbers_compile_nothing():
    source, target = (mcg.preprocess(cloud) for cloud in clouds(400))
    mcg.register(source, target, mcg.GICP(), robust=mcg.Cauchy(1.0))
    with compilations() as found:
        for i in range(3):
            options = {"max_distance": 0.4 + 0.01 * i, "max_iterations": 9 + i, "robust": mcg.Cauchy(0.5 + i)}
            mcg.register(source, target, mcg.GICP(1e-3 * (i + 1)), hold_unconstrained=i > 1, **options)
    assert not found


class Leaf:
    """A tree that weak references can follow."""

    def __init__(self, tree):
        self.tree = tree


class Watched(mcg.KDTreeSearch):
    """A search that keeps weak references to its trees, with their sizes."""

    trees: ClassVar[list[Any]] = []

    def build(self, points):
        tree = Leaf(super().build(points))
        self.trees.append((len(points), weakref.ref(tree)))
        return tree

    def query(self, tree, queries, k, bound):
        return super().query(tree.tree, queries, k, bound)


def test_a_cloud_has_one_tree_as_long_as_it_is_used():
    first, second, third = (mcg.preprocess(room_corner(size, seed=size)[0]) for size in (300, 310, 320))
    Watched.trees.clear()
    search = Watched()
    for _ in range(3):
        mcg.register(first, second, mcg.GICP(), search=search)
    mcg.register(second, third, mcg.GICP(), search=search)
    mcg.register_batch([first, third], second, mcg.GICP(), search=search)
    sizes, trees = zip(*Watched.trees, strict=True)
    assert sizes == (310, 320) and all(tree() is not None for tree in trees)
    # Of another cloud nothing is taken, though all but its points are the same.
    moved = first.replace(points=first.points + np.float32(0.01))
    result = mcg.register(moved, second, mcg.GICP(), search=search)
    assert np.abs(result.matrix - mcg.register(first, second, mcg.GICP()).matrix).max() > 5e-3
    assert len(Watched.trees) == 2
    del second, third, result
    gc.collect()
    # With the next lookup.
    mcg.register(first, moved, mcg.GICP(), search=search)
    assert not any(tree() for tree in trees)


def test_settings_of_a_block_of_code_hold_in_all_threads():
    """Nine blocks, of which other threads take some."""
    points = room_corner(9000)[0]
    with jax.enable_x64(True):
        cloud, other = (mcg.preprocess(points + shift) for shift in (0, 0.01))
        result = mcg.register(cloud, other, mcg.GICP(), max_distance=0.3)
    alone = mcg.KDTreeSearch(workers=1)
    with jax.enable_x64(True):
        cloud, other = (mcg.preprocess(points + shift, search=alone) for shift in (0, 0.01))
        expected = mcg.register(cloud, other, mcg.GICP(), max_distance=0.3, search=alone)
    assert cloud.points.dtype == np.float64
    np.testing.assert_array_equal(result.matrix, expected.matrix)


@pytest.mark.slow
def test_a_first_gradient_compiles_each_program_once():
    """Inside `grad`, JAX's context is another one than in threads; programs called in both would be compiled twice."""
    raw = [(points, np.hstack([channels] * 3)) for points, channels in (room_corner(300, seed=i) for i in (0, 1))]
    source, target = (mcg.preprocess(mcg.PointCloud(*arrays)) for arrays in raw)

    def loss(channels):
        # In one thread: two that call a new program at the same time may both compile it.
        options = {"max_distance": 0.5, "search": mcg.KDTreeSearch(workers=1)}
        return mcg.register(source.replace(channels=channels), target, mcg.MultiChannelGICP(), **options).matrix[0, 3]

    # Other tests may have compiled some of them.
    jax.clear_caches()
    with compilations() as found:
        jax.grad(loss)(source.channels)
    programs = ("_geometry", "surface", "_update", "root_of", "jacobian__score_of_rows", "vjp__score_of_rows")
    assert [found.count(f"jit({name})") for name in (*programs, "vjp_surface")] == [1] * 7, found
    # The last sums have slopes of the channels, too.
    assert found.count("jit(sums_of)") == 2, found


def test_find_correspondences_computes_nothing_that_it_does_not_use():
    source, target = (mcg.preprocess(cloud) for cloud in clouds(400))
    # No program that was compiled before serves here.
    with jax.default_matmul_precision("float32"), compilations() as found:
        mcg.find_correspondences(source, target, None, mcg.GICP(), max_distance=0.5)
        mcg.find_correspondences(source, target, None, mcg.ColorICP(0.3), max_distance=0.5)
    assert not found


def test_long_compilation_is_logged_once(caplog, monkeypatch):
    monkeypatch.setattr(programs, "_LONG", 1e-9)
    monkeypatch.setattr(programs.LOGGER, "disabled", False)
    monkeypatch.setattr(programs.COMPILATIONS, "seconds", 0.0)
    with caplog.at_level("INFO", "mcgicp_jax"):
        for constant in (1.25, 2.25):
            jax.jit(lambda x, constant=constant: x + constant)(1.0)
    (record,) = caplog.records
    assert record.name == "mcgicp_jax" and "programs are kept in" in record.getMessage()


def test_what_is_computed_outside_of_a_trace_stays_outside():
    """A `jit` that is traced within the context is one."""
    lazy = Lazy(lambda: jnp.arange(3.0) + 1)
    with outside_trace():
        assert jax.jit(lambda x: x + lazy.value.sum())(1.0) == 7
    assert not isinstance(lazy.value, jax.core.Tracer)
