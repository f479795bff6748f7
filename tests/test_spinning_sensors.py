"""Scans of 16 beams, whose neighbourhoods are scan lines near the sensor and far from it."""

import numpy as np

import mcgicp_jax as mcg
from mcgicp_jax.datasets._raycast import Box, Cylinder, Solid, cast
from tests.scenes import motion


def two_scans(rng, solids, height):
    """Source and target as seen by a moving sensor, and the true pose."""
    elevation, azimuth = np.meshgrid(np.radians(np.linspace(-15, 15, 16)), np.arange(0, 2 * np.pi, np.pi / 900))
    across = np.cos(elevation) * np.stack([np.cos(azimuth), np.sin(azimuth)])
    rays = np.stack([*across, np.sin(elevation)], axis=-1).reshape(-1, 3)
    poses = motion((0.6, 0.1, height, 0.01, -0.01, 0.05)), motion((0, 0, height, 0, 0, 0))
    hits = [cast(pose, rays, solids, 80.0) for pose in poses]
    points = (seen.sensor_rays * (seen.distance + 0.02 * rng.normal(size=len(seen.distance)))[:, None] for seen in hits)
    return *points, np.linalg.inv(poses[1]) @ poses[0]


def box(*bounds) -> Solid:
    return Box(np.array(bounds[:3], float), np.array(bounds[3:], float))


def test_voxels_are_not_so_large_that_they_mix_trunks_with_the_ground():
    """In a forest, neighbourhoods of trunks are lines in any voxels that show them. In voxels so large that few are,
    the pose is 0.24 m off."""
    rng = np.random.default_rng(0)
    feet = [place for place in rng.uniform(-40, 40, (150, 2)) if np.hypot(*place) > 3]
    trunks = [Cylinder(np.append(foot, 0), rng.uniform(0.1, 0.35), rng.uniform(5, 12)) for foot in feet]
    source, target, truth = two_scans(rng, [*trunks, box(-100, -100, -1, 100, 100, 0)], 1.7)
    result = mcg.register(source, target, mcg.GICP())
    assert result.converged and mcg.metrics.pose_error(result.matrix, truth)[0] < 0.05


def test_scan_lines_that_bend_do_not_constrain_the_pose_along_a_tunnel():
    """Where wall and floor meet, their plane is across the tunnel."""
    sides = box(-200, -4, -1, 200, 4, 0), box(-200, -5, 0, 200, -4, 5), box(-200, 4, 0, 200, 5, 5)
    for seed in (4, 6):
        clouds = two_scans(np.random.default_rng(seed), [*sides, box(-200, -4, 5, 200, 4, 6)], 1.7)[:2]
        result = mcg.register(*(mcg.preprocess(cloud, 0.2) for cloud in clouds), mcg.GICP())
        assert result.status is mcg.Status.DEGENERATE
