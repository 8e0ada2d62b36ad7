"""Explorer of a report: data of the two interactive scatter plots, and their script."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Int
from markupsafe import Markup

from marsyard.reports.column_selection import axis_columns
from marsyard.reports.column_values import is_number, numbers
from marsyard.reports.populations import engine_failed
from marsyard.reports.provenance import replay_command
from marsyard.reports.stored import StoredRun
from marsyard.reports.wording import label

#: Maximum number of points of the explorer, without violations, and of violations. Maximum number of extreme cases of
#: each kind: largest errors, no answer, crashed.
MAX_POINTS, MAX_VIOLATIONS, MAX_EXTREME = 2000, 4000, 150
_SCRIPT = Path(__file__).parent / "templates" / "explorer.js"
#: Columns that are not quantities of a case.
_NOT_EXPLORED = ("case", "image_hash", "gl_backend", "gl_version", "processor_features", "error", "traceback")


class ExploredStatus(IntEnum):
    """Result of a case for a requirement, as in the explorer's script."""

    MET = 0
    VIOLATED = 1
    NOT_COUNTED = 2


@dataclass(frozen=True)
class ExploredRequirement:
    """A requirement in the explorer, with the `ExploredStatus` of each case."""

    name: str
    metric: str
    bound: float
    status: Int[np.ndarray, " n"]


def explorer_data(
    run: StoredRun, metric: str, requirements: Sequence[ExploredRequirement], with_images: Collection[str]
) -> dict[str, Any]:
    """Create the data of the explorer: numeric columns of the points with labels, initial axes, and requirements.

    In a large campaign, `run.frame` contains all columns of the first cases, and `run.all_cases` some columns of all
    cases; the other columns of the other cases are missing values.

    Keys of `templates/explorer.js`: values of each point by column (`columns`), indices of columns (`metric`; `parts`,
    the components of an error; `axes`, x and y of the two plots), indices of outcomes (`outcome`), and numbers of
    points and of all cases (`shown`, `all`).
    """
    first_cases, all_cases = run.frame, run.all_cases
    components = axis_columns(metric, [str(name) for name in first_cases.columns])[:2]
    drivers = run.driver_columns(metric)
    first = [*components, metric, *drivers]
    explored = [
        str(name)
        for name in first_cases.columns
        if name not in _NOT_EXPLORED and is_number(first_cases, str(name)) and first_cases[name].nunique() > 1
    ]
    names = list(dict.fromkeys([*first, *explored]))
    is_violation = np.zeros(len(all_cases), dtype=np.bool_)
    for item in requirements:
        is_violation |= item.status == ExploredStatus.VIOLATED
    rows = choose_points(all_cases, metric, is_violation)
    points = all_cases.iloc[rows]
    cases = points["case"].tolist() if "case" in points else rows.tolist()
    is_numbered = "case" in first_cases
    complete = first_cases.set_index("case").reindex(cases) if is_numbered else first_cases.iloc[rows]
    outcomes = points["outcome"].astype(str) if "outcome" in points else pd.Series("", index=points.index)
    distinct_outcomes = list(dict.fromkeys(outcomes))

    def column_values(name: str) -> list[float | None]:
        values = numbers(points, name) if name in points else numbers(complete, name)
        return [float(f"{value:.4g}") if math.isfinite(value) else None for value in values]

    metric_index, condition_index = names.index(metric), names.index(drivers[0] if drivers else metric)
    second_axes = [condition_index, metric_index]
    first_axes = [names.index(name) for name in components] if len(components) == 2 else second_axes
    return {
        "labels": [label(name) for name in names],
        "columns": [column_values(name) for name in names],
        "metric": metric_index,
        "parts": [names.index(component) for component in components] if len(components) == 2 else [],
        "axes": [first_axes, second_axes],
        "requirements": [
            {
                "name": item.name,
                "column": names.index(item.metric) if item.metric in names else None,
                "bound": item.bound if math.isfinite(item.bound) else None,
                "status": item.status[rows].tolist(),
            }
            for item in requirements
        ],
        "cases": [int(case) for case in cases],
        "outcomes": [str(outcome) for outcome in distinct_outcomes],
        "outcome": [distinct_outcomes.index(outcome) for outcome in outcomes],
        "with_images": sorted(int(case) for case in with_images),
        "replay": replay_command(run, "CASE"),
        "shown": len(points),
        "all": len(all_cases),
    }


def choose_points(
    frame: pd.DataFrame, metric: str, is_violation: Bool[np.ndarray, " n"] | None = None
) -> Int[np.ndarray, " points"]:
    """Select the rows of the explorer: all up to `MAX_POINTS`; else violations, extreme cases, and the first others."""
    if len(frame) <= MAX_POINTS:
        return np.arange(len(frame))
    violations = np.zeros(0, dtype=np.int64) if is_violation is None else np.flatnonzero(is_violation)[:MAX_VIOLATIONS]
    magnitude = np.abs(numbers(frame, metric))
    finite = np.isfinite(magnitude)
    is_crashed = engine_failed(frame)
    worst = np.argsort(-np.where(finite, magnitude, -1.0), kind="stable")
    extreme = [
        group[:MAX_EXTREME] for group in (worst, np.flatnonzero(~finite & ~is_crashed), np.flatnonzero(is_crashed))
    ]
    others = np.setdiff1d(pd.unique(np.concatenate([*extreme, np.arange(len(frame))]))[:MAX_POINTS], violations)
    return np.sort(np.concatenate([violations, others]))


def read_script() -> Markup:
    """Read the explorer's JavaScript, marked as safe for the template."""
    return Markup(_SCRIPT.read_text(encoding="utf-8"))  # noqa: S704
