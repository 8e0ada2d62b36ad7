"""Margin of each case of a requirement, from the stored rows.

The margin is that of `marsyard.campaigns.definition.margins`: negative for a violation, infinite outside the
population.
"""

import math

import numpy as np
import pandas as pd
from jaxtyping import Float

from marsyard.campaigns.definition.margins import MAX_VIOLATION_MARGIN
from marsyard.reports import populations
from marsyard.reports.column_values import numbers
from marsyard.reports.verdicts import Verdict


def compute_margins(frame: pd.DataFrame, verdict: Verdict, margin_column: str | None) -> Float[np.ndarray, " n"] | None:
    """Compute the margin of each row; None if the rows lack a column of the requirement.

    The result equals `marsyard.campaigns.definition.margins.compute_margin` of each row.
    """
    columns = verdict.metric.split(" + ") if math.isfinite(verdict.bound) else [verdict.metric]
    if any(column not in frame for column in columns):
        return None
    is_met = populations.success_mask(frame, verdict.metric, verdict.bound, verdict.scale)
    if math.isfinite(verdict.bound):
        values = np.sum([numbers(frame, column) for column in columns], axis=0)
        margins = verdict.bound - np.abs(verdict.scale * values)
    else:
        graded = numbers(frame, margin_column) if margin_column else np.full(len(frame), np.nan)
        limited = np.where(is_met, np.maximum(graded, 0.0), np.minimum(graded, MAX_VIOLATION_MARGIN))
        margins = np.where(np.isnan(graded), np.where(is_met, 1.0, -1.0), limited)
    try:
        # unfinished cases are violations in every population, also in `completed`, which excludes them
        flags = [name for name in verdict.population.split(" and ") if name != "completed"]
        is_member, is_unknown = populations.population_and_unknown_masks(frame, flags)
    except ValueError:
        return None
    margins = np.where(np.isnan(margins) | is_unknown, -np.inf, margins)
    return np.where(populations.engine_failed(frame), -np.inf, np.where(is_member, margins, np.inf))
