"""Populations (subsets of a campaign's cases) as masks, margins of cases, and the number of cases by outcome."""

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from marsyard.campaigns.definition.margins import MAX_VIOLATION_MARGIN
from marsyard.campaigns.outcomes import CRASHED, ENGINE_FAILURES
from marsyard.reports.column_values import numbers
from marsyard.reports.verdicts import Verdict


def success_mask(frame: pd.DataFrame, metric: str, bound: float, scale: float = 1.0) -> Bool[np.ndarray, " n"]:
    """Create the mask of the cases with |scale * metric| <= bound, or with a true metric if the bound is NaN.

    Cases with a missing value and unfinished cases are failures. A metric may be a sum of columns, joined by " + ":
    the magnitude is that of the sum.
    """
    is_finished = ~engine_failed(frame)
    if math.isnan(bound):
        return np.asarray(flag_mask(frame, metric) & is_finished, dtype=np.bool_)
    values = sum((numbers(frame, column) for column in metric.split(" + ")), np.zeros(len(frame)))
    return np.asarray((np.abs(scale * values) <= bound) & is_finished, dtype=np.bool_)


def population_mask(frame: pd.DataFrame, population: str) -> Bool[np.ndarray, " n"]:
    """Create the mask of a population: `all`, `completed`, `valid`, a flag column, or several joined by " and ".

    A case with a missing flag, such as a crashed case, belongs to the population. Raises ValueError without the column.
    """
    return population_and_unknown_masks(frame, population.split(" and "))[0]


def population_and_unknown_masks(
    frame: pd.DataFrame, populations: Sequence[str]
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Create the masks of the intersection of populations, and of its cases with a missing flag."""
    is_member, is_unknown = np.ones(len(frame), dtype=np.bool_), np.zeros(len(frame), dtype=np.bool_)
    for population in populations:
        if population == "completed":
            is_member &= ~engine_failed(frame)
        elif population != "all":
            column = "answered" if population == "valid" else population
            if not is_flag(frame, column):
                raise ValueError(f"the rows have no column '{column}' of true and false, which defines a population")
            is_missing = frame[column].isna().to_numpy(dtype=np.bool_)
            is_member &= flag_mask(frame, column) | is_missing
            is_unknown |= is_missing
    return is_member, is_member & is_unknown


def is_flag(frame: pd.DataFrame, column: str) -> bool:
    """Whether a column exists and contains only true, false and missing values."""
    return column in frame and all(isinstance(value, bool | np.bool_) for value in frame[column].dropna().unique())


def engine_failed(frame: pd.DataFrame) -> Bool[np.ndarray, " n"]:
    """Create the mask of the cases that the engine could not finish."""
    if "outcome" not in frame:
        return np.zeros(len(frame), dtype=np.bool_)
    return frame["outcome"].isin(ENGINE_FAILURES).to_numpy(dtype=np.bool_)


def repeated_mask(frame: pd.DataFrame) -> Bool[np.ndarray, " n"]:
    """Create the mask of the finished cases that were run more than once: an earlier attempt may have failed."""
    is_finished = ~engine_failed(frame) & ("outcome" in frame)
    return np.asarray((numbers(frame, "case_attempts") > 1.0) & is_finished, dtype=np.bool_)


def mark_repeated_as_unfinished(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with the repeated cases as crashed, as if an earlier attempt had been stored."""
    is_repeated = repeated_mask(frame)
    return frame.assign(outcome=frame["outcome"].mask(is_repeated, CRASHED)) if is_repeated.any() else frame


def population_mask_if_answered(frame: pd.DataFrame, population: str) -> Bool[np.ndarray, " n"]:
    """Create the mask of a population, extended by the unfinished cases that would belong to it with a valid answer.

    The populations `valid` (also under the name of its column, `answered`) and `completed` exclude unfinished cases;
    here only the other flags decide for such cases.
    """
    flags = [name for name in population.split(" and ") if name not in ("valid", "answered", "completed")]
    return np.asarray(
        population_mask(frame, population) | (population_and_unknown_masks(frame, flags)[0] & engine_failed(frame))
    )


def flag_mask(frame: pd.DataFrame, name: str) -> Bool[np.ndarray, " n"]:
    """Create the mask of the true values of a column; missing values are false."""
    if not is_flag(frame, name):
        return np.zeros(len(frame), dtype=np.bool_)
    return np.asarray(frame[name].eq(True).fillna(False).to_numpy(dtype=np.bool_))


def all_flags(frame: pd.DataFrame, *names: str) -> Bool[np.ndarray, " n"]:
    """Create the mask of the rows in which all flags are true; names that are not flag columns are ignored."""
    masks = [flag_mask(frame, name) for name in names if is_flag(frame, name)]
    return np.asarray(np.logical_and.reduce([np.ones(len(frame), dtype=np.bool_), *masks]))


def outcome_counts(frame: pd.DataFrame) -> list[tuple[str, int]]:
    """Count cases by outcome: answers first, unfinished cases last, larger numbers first."""
    if "outcome" not in frame:
        return []
    counts = frame["outcome"].astype("object").fillna("(none)").astype(str).value_counts()
    pairs = [(str(name), int(count)) for name, count in counts.items()]
    outcomes_with_answer = answered_outcomes(frame)
    return sorted(
        pairs, key=lambda pair: (pair[0] in ENGINE_FAILURES, pair[0] not in outcomes_with_answer, -pair[1], pair[0])
    )


def answered_outcomes(frame: pd.DataFrame) -> set[str]:
    """Return the outcomes of cases with an answer; VALID if the rows have no column `answered`."""
    if "outcome" not in frame or not is_flag(frame, "answered"):
        return {"VALID"}
    return {str(name) for name in frame.loc[population_mask(frame, "valid"), "outcome"].dropna().unique()}


def compute_margins(frame: pd.DataFrame, verdict: Verdict, margin_column: str | None) -> Float[np.ndarray, " n"] | None:
    """Compute the margin of each row; None if the rows lack a column of the requirement.

    The result equals `marsyard.campaigns.definition.margins.compute_margin` of each row: negative for a violation,
    infinite outside the population.
    """
    columns = verdict.metric.split(" + ") if math.isfinite(verdict.bound) else [verdict.metric]
    if any(column not in frame for column in columns):
        return None
    is_met = success_mask(frame, verdict.metric, verdict.bound, verdict.scale)
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
        is_member, is_unknown = population_and_unknown_masks(frame, flags)
    except ValueError:
        return None
    margins = np.where(np.isnan(margins) | is_unknown, -np.inf, margins)
    return np.where(engine_failed(frame), -np.inf, np.where(is_member, margins, np.inf))
