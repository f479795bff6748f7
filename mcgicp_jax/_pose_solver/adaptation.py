"""Numbers that terms estimate from the residuals at a pose."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from mcgicp_jax._compute.concrete import AnyArray, constant, numpy_for
from mcgicp_jax._math.statistics import sampled_rows
from mcgicp_jax._pose_solver.matched import Matched, Motion
from mcgicp_jax._terms.base import AbstractAdaptiveTerm, AbstractTerm


def adapted(
    terms: tuple[AbstractTerm, ...],
    valid: Bool[AnyArray, "N"],
    sample: Callable[[AbstractAdaptiveTerm, Int[AnyArray, "n"]], Any],
) -> tuple[AbstractTerm, ...]:
    """The terms with their numbers estimated; constants to autodiff.

    Args:
        valid: which source points are no padding.
        sample: computes `sample_of_term` for the matches of some source points.
    """
    rows, counts = sampled_rows(valid)
    xp = numpy_for(counts, valid)
    fraction = xp.sum(counts) / xp.maximum(xp.sum(valid), 1)

    def only(column: Float[AnyArray, "n *_"]) -> Float[AnyArray, "n *_"]:
        missing = np.asarray(np.nan, column.dtype)
        return numpy_for(column, counts).where(counts.reshape(-1, *[1] * (column.ndim - 1)), column, missing)

    # Huge coordinates or channels lead to the status NON_FINITE; NumPy need not warn of them.
    with np.errstate(over="ignore", invalid="ignore"):
        return tuple(
            constant(term.adapt(jax.tree.map(only, sample(term, rows)), fraction))
            if isinstance(term, AbstractAdaptiveTerm)
            else term
            for term in terms
        )


def sample_of_term(motion: Motion, matched: Matched, term: AbstractAdaptiveTerm) -> Any:
    """`AbstractAdaptiveTerm.sample` of matched points."""
    return term.sample(matched.at(motion))
