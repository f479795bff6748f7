"""Pairs of several sizes, for the tests of batches."""

import jax
import numpy as np

import mcgicp_jax as mcg
from tests.scenes import motion, room_corner

METHOD = mcg.MultiChannelGICP(0.05, 0.3)
# Two size classes, both of other tests.
SIZES = (300, 310, 490, 290, 480, 305)


def raw_pair(size, seed):
    truth = motion(0.02 * np.random.default_rng(seed).normal(size=6))
    points, channels = room_corner(size, seed=2 * seed + 1)
    source = mcg.PointCloud((points - truth[:3, 3]) @ truth[:3, :3], channels)
    return source, mcg.PointCloud(*room_corner(size + 20, seed=2 * seed + 2)), truth


def prepared(raw):
    return [[mcg.preprocess(pair[side]) for pair in raw] for side in (0, 1)]


def batch(sources, targets, **settings):
    return mcg.register_batch(sources, targets, METHOD, **{"max_distance": 0.5} | settings)


def assert_same(first, second):
    """Bit for bit, NaN included."""
    assert len(first) == len(second)
    for one, other in zip(first, second, strict=True):
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
