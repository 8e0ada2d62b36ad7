"""Selection of cases whose pictures are shown: kept cases on a report's page, and notable cases of a gallery."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from marsyard.reports.columns import numbers, primary_metric
from marsyard.reports.presentation import CaseView, case_kind
from marsyard.reports.rates import members
from marsyard.reports.stored import StoredRun
from marsyard.reports.wording import NOTHING

#: Cases of each kind (largest errors, no answer, random); the pictures of one take about half a megabyte of a page.
CASES_OF_A_KIND = 2
#: Fixed seeds of the random choice: the same files give the same cases.
_GALLERY_SEED, _NOTABLE_SEED = 20260301, 20260302


@dataclass(frozen=True)
class ShownCase:
    """A kept case with its outcome, its view and its legend."""

    case: int
    outcome: str
    view: CaseView
    legend: str


def shown_cases(run: StoredRun) -> list[ShownCase]:
    """The kept cases of the page that a system can draw, as far as their products were kept."""
    return [shown for case in gallery_cases(run) if (shown := shown_case(run, case)) is not None]


def gallery_cases(run: StoredRun) -> list[int]:
    """Kept cases in the order of the page: the one chosen for the report, largest errors, no answer, random ones."""
    kept = list(run.showcases)
    metric = primary_metric(run.frame, run.requirements)
    if len(kept) <= 1 or metric is None or "case" not in run.whole:
        return kept[: 3 * CASES_OF_A_KIND]
    by_error, silent = _by_error(run.whole[run.whole["case"].isin(kept)], metric)
    unanswered = [case for case in kept if case in silent]
    return _pick(kept[:1], by_error, unanswered, np.random.default_rng(_GALLERY_SEED).permutation(kept).tolist())


def notable_cases(run: StoredRun) -> list[int]:
    """Completed cases: the largest errors, the first without one, and others at random."""
    rows = run.whole[members(run.whole, "completed")]
    metric = primary_metric(run.frame, run.requirements)
    if "case" not in rows or metric is None:
        return []
    by_error, silent = _by_error(rows, metric)
    cases = rows["case"].to_numpy(dtype=np.int64)
    return _pick([], by_error, silent, cases[np.random.default_rng(_NOTABLE_SEED).permutation(cases.size)].tolist())


def _by_error(rows: pd.DataFrame, metric: str) -> tuple[list[int], list[int]]:
    """Cases with an error, largest first, and cases without one."""
    cases, sizes = rows["case"].to_numpy(dtype=np.int64), np.abs(numbers(rows, metric))
    known = np.isfinite(sizes)
    return cases[known][np.argsort(-sizes[known], kind="stable")].tolist(), cases[~known].tolist()


def _pick(first: list[int], *kinds: list[int]) -> list[int]:
    """The first cases, then up to `CASES_OF_A_KIND` further ones of each kind."""
    chosen = list(first)
    for kind in kinds:
        chosen += [case for case in dict.fromkeys(kind) if case not in chosen][:CASES_OF_A_KIND]
    return chosen


def shown_case(run: StoredRun, case: int) -> ShownCase | None:
    """A kept case with its view; None if no system recognizes its products."""
    products = run.products(case)
    kind = case_kind(products)
    if kind is None:
        return None
    view = kind.view(products, f"case{case}")
    rows = run.whole
    outcomes = rows.loc[rows["case"] == case, "outcome"] if {"case", "outcome"} <= {*rows} else pd.Series(dtype=object)
    outcome = str(outcomes.iloc[0]) if len(outcomes) else NOTHING
    return ShownCase(case, outcome, view, kind.legend if view.legend is None else view.legend)


def write_case_figures(directory: Path, products: Mapping[str, Any]) -> list[Path]:
    """Write a case's figures into a folder; returns their paths, none if no system recognizes the products.

    Raises OSError if they cannot be written.
    """
    kind = case_kind(products)
    return [] if kind is None else kind.write(directory, products)
