"""Which cases belong to a population, which of them succeed, and which share a terrain."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
from jaxtyping import Bool, Int

from marsyard.campaigns.outcomes import UNFINISHED
from marsyard.reports.columns import numbers

#: Outcomes of cases that the engine could not finish; the algorithm under test may be innocent of them.
ENGINE_FAILURES = UNFINISHED


def crashed_cases(frame: pd.DataFrame) -> int:
    """How many cases the engine could not finish."""
    return int(engine_failed(frame).sum())


def succeeded(frame: pd.DataFrame, metric: str, bound: float, scale: float = 1.0) -> Bool[np.ndarray, " n"]:
    """Whether |scale * metric| <= bound, or the metric is true where the bound is NaN, case by case; False where
    missing, and of every case that the engine could not finish. A metric may be a sum of columns, joined by " + ".
    """
    finished = ~engine_failed(frame)
    if math.isnan(bound):
        return np.asarray(_true(frame, metric) & finished, dtype=np.bool_)
    values = sum((numbers(frame, part) for part in metric.split(" + ")), np.zeros(len(frame)))
    return np.asarray((np.abs(scale * values) <= bound) & finished, dtype=np.bool_)


def members(frame: pd.DataFrame, population: str) -> Bool[np.ndarray, " n"]:
    """Which cases belong to a population: `all`, `completed`, `valid`, a column of true and false, or several of these
    joined by " and ".

    A case whose membership is unknown, as that of a crashed case without the column, is a member.

    Raises
    ------
    ValueError
        Where no row has the column.
    """
    return members_and_unknown(frame, population.split(" and "))[0]


def members_and_unknown(
    frame: pd.DataFrame, parts: Sequence[str]
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Members of the intersection of populations, and those of them whose membership is unknown."""
    chosen, unknown = np.ones(len(frame), dtype=np.bool_), np.zeros(len(frame), dtype=np.bool_)
    for part in parts:
        if part == "completed":
            chosen &= ~engine_failed(frame)
        elif part != "all":
            column = "answered" if part == "valid" else part
            if not is_flag(frame, column):
                raise ValueError(
                    f"the rows have no column '{column}' of true and false, by which a population is known"
                )
            missing = frame[column].isna().to_numpy(dtype=np.bool_)
            chosen &= _true(frame, column) | missing
            unknown |= missing
    return chosen, chosen & unknown


def is_flag(frame: pd.DataFrame, column: str) -> bool:
    """Whether a column holds true and false, and nothing else but gaps."""
    return column in frame and all(isinstance(value, bool | np.bool_) for value in frame[column].dropna().unique())


def _true(frame: pd.DataFrame, column: str) -> Bool[np.ndarray, " n"]:
    return np.asarray(frame[column].eq(True).fillna(False).to_numpy(dtype=np.bool_))


def engine_failed(frame: pd.DataFrame) -> Bool[np.ndarray, " n"]:
    """Cases that the engine could not finish."""
    if "outcome" not in frame:
        return np.zeros(len(frame), dtype=np.bool_)
    return frame["outcome"].isin(ENGINE_FAILURES).to_numpy(dtype=np.bool_)


def members_if_answered(frame: pd.DataFrame, population: str) -> Bool[np.ndarray, " n"]:
    """The members of a population, and the cases that would be if the engine had finished them with an answer."""
    others = [part for part in population.split(" and ") if part not in ("valid", "completed")]
    return np.asarray(members(frame, population) | (members_and_unknown(frame, others)[0] & engine_failed(frame)))


def terrain_groups(chosen: pd.DataFrame) -> Int[np.ndarray, " n"] | None:
    """Which cases share a terrain, from 0; None where no row says. A case of unknown terrain stands alone."""
    if "terrain" not in chosen or bool(chosen["terrain"].isna().all()):
        return None
    codes, known = pd.factorize(chosen["terrain"])
    groups = np.array(codes, dtype=np.int64)
    alone = groups < 0
    groups[alone] = len(known) + np.arange(int(alone.sum()))
    return groups
