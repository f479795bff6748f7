"""Synthetic scenes whose truth is exact."""

from mcgicp_jax.datasets._poster_wall import Frame as Frame
from mcgicp_jax.datasets._poster_wall import poster_wall as poster_wall
