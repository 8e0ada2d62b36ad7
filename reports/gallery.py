"""Gallery of a report: the cases whose images the page shows, and their views.

Only cases with stored products are shown. `marsyard report --gallery` first reruns further cases to store theirs.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from marsyard.reports.column_selection import primary_metric
from marsyard.reports.column_values import numbers
from marsyard.reports.populations import population_mask
from marsyard.reports.presentation import CaseView, create_case_view
from marsyard.reports.section import SvgFigure, svg_figure
from marsyard.reports.stored import StoredRun
from marsyard.reports.wording import NOTHING

#: Number of selected cases of each group (largest errors, no answer, random); a case has up to half a megabyte.
CASES_PER_GROUP = 2
#: Number of listed stored cases if cases are not grouped: as many as of the three groups.
_UNGROUPED_CASES = 3 * CASES_PER_GROUP
#: Maximum number of violations that the gallery shows.
MAX_SHOWN_VIOLATIONS = 6
#: Fixed seeds of the random selection, for reproducible reports.
_GALLERY_SEED, _RERUN_SEED = 20260301, 20260302


@dataclass(frozen=True)
class GalleryView:
    """A stored case with its outcome, its view, and the figures of the view for the page."""

    case: int
    outcome: str
    view: CaseView
    figures: Sequence[SvgFigure]


def gallery_views(run: StoredRun, violations: Sequence[int]) -> list[GalleryView]:
    """Create the views of the gallery's cases; cases that no system can draw are omitted."""
    return [view for case in gallery_cases(run, violations) if (view := gallery_view(run, case)) is not None]


def gallery_cases(run: StoredRun, violations: Sequence[int] = ()) -> list[int]:
    """List the cases of the gallery, which have stored products: first violations, then the shown case.

    The shown case (`StoredRun.shown_case`) is the one that the campaign recorded for its report; if its products are
    not stored, it is the first stored case. Cases of three groups follow, if fewer than `MAX_SHOWN_VIOLATIONS`
    violations are listed: the largest errors, no answer, and random cases.

    Cases are not grouped if at most one case is stored, if the campaign has no metric, or if its rows have no column
    `case`. Then the first `_UNGROUPED_CASES` stored cases follow the violations; the first of them is the shown case.

    violations: those that the page lists by requirement
    """
    shown_violations = [case for case in violations if case in run.stored_cases][:MAX_SHOWN_VIOLATIONS]
    stored_cases = list(run.stored_cases)
    metric = primary_metric(run.frame, run.requirements)
    if run.shown_case is None or len(stored_cases) == 1 or metric is None or "case" not in run.all_cases:
        return list(dict.fromkeys([*shown_violations, *stored_cases[:_UNGROUPED_CASES]]))
    first = list(dict.fromkeys([*shown_violations, run.shown_case]))
    if len(shown_violations) == MAX_SHOWN_VIOLATIONS:
        return first
    by_error, without_error = _sort_by_error(run.all_cases[run.all_cases["case"].isin(stored_cases)], metric)
    unanswered = [case for case in stored_cases if case in without_error]
    random_order = np.random.default_rng(_GALLERY_SEED).permutation(stored_cases)
    return _select_cases(first, by_error, unanswered, random_order.tolist())


def gallery_candidates(run: StoredRun) -> list[int]:
    """List completed cases to rerun for the gallery: largest errors, first cases without an error, and random cases."""
    rows = run.all_cases[population_mask(run.all_cases, "completed")]
    metric = primary_metric(run.frame, run.requirements)
    if "case" not in rows or metric is None:
        return []
    by_error, without_error = _sort_by_error(rows, metric)
    cases = rows["case"].to_numpy(dtype=np.int64)
    random_order = np.random.default_rng(_RERUN_SEED).permutation(cases.size)
    return _select_cases([], by_error, without_error, cases[random_order].tolist())


def _sort_by_error(rows: pd.DataFrame, metric: str) -> tuple[list[int], list[int]]:
    """List cases with an error, largest first, and cases without an error."""
    cases, magnitudes = rows["case"].to_numpy(dtype=np.int64), np.abs(numbers(rows, metric))
    finite = np.isfinite(magnitudes)
    return cases[finite][np.argsort(-magnitudes[finite], kind="stable")].tolist(), cases[~finite].tolist()


def _select_cases(first: list[int], *groups: list[int]) -> list[int]:
    """List the cases `first`, then up to `CASES_PER_GROUP` further cases of each group."""
    cases = list(first)
    for group in groups:
        cases += [case for case in dict.fromkeys(group) if case not in cases][:CASES_PER_GROUP]
    return cases


def gallery_view(run: StoredRun, case: int) -> GalleryView | None:
    """Create the view of a stored case; None if it has no figure."""
    view = create_case_view(run.products(case), complete=False)
    if not view.figures:
        return None
    figures = [svg_figure(item.figure, f"case{case}{item.name}", item.caption, wide=item.wide) for item in view.figures]
    rows = run.all_cases
    outcomes = rows.loc[rows["case"] == case, "outcome"] if {"case", "outcome"} <= {*rows} else pd.Series(dtype=object)
    return GalleryView(case, str(outcomes.iloc[0]) if len(outcomes) else NOTHING, view, figures)
