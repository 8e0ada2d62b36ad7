"""Numbers of terrains by their number of cases, and the scores of events on a terrain."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

#: Numbers of terrains by their number of cases: pairs (cases on a terrain, terrains with this number).
Sizes = tuple[tuple[int, int], ...]
#: Number of cases on a terrain up to which the squares of numbers of events are not rounded.
_MAX_SQUARED = 16


def number_terrains(terrain: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Number the terrains consecutively from 0, in the order of their original numbers."""
    lowest, highest = int(terrain.min()), int(terrain.max())
    if highest - lowest > 4 * terrain.size:
        return np.unique(terrain, return_inverse=True)[1]
    # for dense numbers: count instead of sorting, which is slow for a million cases
    shifted = terrain - lowest
    return np.asarray((np.cumsum(np.bincount(shifted) > 0) - 1)[shifted])


def count_sizes(cases_on_terrain: Int[np.ndarray, " terrains"]) -> Sizes:
    """Count the terrains with each number of cases."""
    cases, terrains = np.unique(cases_on_terrain[cases_on_terrain > 0], return_counts=True)
    return tuple(zip(cases.tolist(), terrains.tolist(), strict=True))


def event_scores(sizes: Sizes) -> Int[np.ndarray, " _"]:
    """Return the score of 0 to n events on a terrain, for the largest number of cases n.

    It is k^2 for k events if n is at most 16, otherwise k^2 in units of (n / 16)^2, rounded up.
    """
    largest = max(cases for cases, _ in sizes)
    events = np.arange(largest + 1, dtype=np.int64)
    scale = max(largest, _MAX_SQUARED)
    # integers: -(-a // b) rounds a / b up
    return np.asarray(-(-(events**2) * _MAX_SQUARED**2 // scale**2))


def largest_statistic(sizes: Sizes) -> int:
    """Return the statistic if all cases have the event."""
    scores = event_scores(sizes)
    return sum(terrains * int(scores[cases]) for cases, terrains in sizes)
