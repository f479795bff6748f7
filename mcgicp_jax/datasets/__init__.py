"""Sequences of frames: synthetic scenes whose truth is exact, and readers of public data sets."""

from mcgicp_jax.datasets._box_room import box_room as box_room
from mcgicp_jax.datasets._corridor import corridor as corridor
from mcgicp_jax.datasets._ford import ford_campus as ford_campus
from mcgicp_jax.datasets._frame import AbstractFrames as AbstractFrames
from mcgicp_jax.datasets._frame import Frame as Frame
from mcgicp_jax.datasets._frame import SyntheticFrames as SyntheticFrames
from mcgicp_jax.datasets._kitti import kitti as kitti
from mcgicp_jax.datasets._poster_wall import poster_wall as poster_wall
from mcgicp_jax.datasets._seven_scenes import seven_scenes as seven_scenes
from mcgicp_jax.datasets._street import street as street
from mcgicp_jax.datasets._tum_rgbd import tum_rgbd as tum_rgbd
