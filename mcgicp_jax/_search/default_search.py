"""The search that is used where none is given."""

from __future__ import annotations

from mcgicp_jax._compute.devices import on_accelerator
from mcgicp_jax._search.base import AbstractSearch
from mcgicp_jax._search.brute_force import DenseSearch
from mcgicp_jax._search.kd_tree import KDTreeSearch


def default_search(traced: bool = False, workers: int = -1) -> AbstractSearch:
    return DenseSearch() if traced and on_accelerator() else KDTreeSearch(workers)
