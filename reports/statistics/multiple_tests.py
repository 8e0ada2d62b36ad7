"""Correction of p-values for multiple tests."""

from __future__ import annotations

import math
from collections.abc import Sequence


def correct_holm(p_values: Sequence[float]) -> list[float]:
    """Correct p-values for multiple tests (Holm 1979), which limits the family-wise error rate; NaN remains NaN."""
    sorted_p = sorted((p, index) for index, p in enumerate(p_values) if not math.isnan(p))
    corrected_p, max_p = [math.nan] * len(p_values), 0.0
    for rank, (p, index) in enumerate(sorted_p):
        max_p = max(max_p, min(1.0, p * (len(sorted_p) - rank)))
        corrected_p[index] = max_p
    return corrected_p
