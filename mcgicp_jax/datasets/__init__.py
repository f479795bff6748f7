"""Synthetic scenes whose truth is exact."""

from mcgicp_jax.datasets._box_room import box_room as box_room
from mcgicp_jax.datasets._corridor import corridor as corridor
from mcgicp_jax.datasets._frame import AbstractFrames as AbstractFrames
from mcgicp_jax.datasets._frame import Frame as Frame
from mcgicp_jax.datasets._frame import SyntheticFrames as SyntheticFrames
from mcgicp_jax.datasets._poster_wall import poster_wall as poster_wall
from mcgicp_jax.datasets._street import street as street
