"""Number of cases by outcome."""

import pandas as pd

from marsyard.campaigns.outcomes import ENGINE_FAILURES
from marsyard.reports.populations import is_flag, population_mask


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
