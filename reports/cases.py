"""Which cases have pictures: kept cases as a page shows them, and cases that a reader wants pictures of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from marsyard.reports.columns import numbers, primary_metric
from marsyard.reports.populations import members
from marsyard.reports.presentation import CaseView, case_kind
from marsyard.reports.stored import StoredRun
from marsyard.reports.wording import NOTHING

#: Kept cases of each kind (the worst, those without an answer, others drawn at random) whose pictures go into the page;
#: each takes about half a megabyte.
_MOST_OF_A_KIND = 2
#: The others are drawn from a fixed seed: the same files give the same page.
_SEED = 20260301


@dataclass(frozen=True)
class ShownCase:
    """A kept case: its number, what became of it, what is shown of it, and its system's legend."""

    case: int
    outcome: str
    view: CaseView
    legend: str


def shown_cases(run: StoredRun) -> list[ShownCase]:
    """Kept cases that can be drawn: the one chosen for the report, the worst, some without an answer, and some
    others at random; each as far as it is kept.
    """
    shown = (shown_case(run, case) for case in gallery_cases(run))
    return [one for one in shown if one is not None]


def gallery_cases(run: StoredRun) -> list[int]:
    """Which of the kept cases a page shows, in its order."""
    kept = list(run.showcases)
    metric = primary_metric(run.frame, run.requirements)
    if len(kept) <= 1 or metric is None or "case" not in run.whole:
        return kept[: 3 * _MOST_OF_A_KIND]
    rows = run.whole[run.whole["case"].isin(kept)]
    sizes = np.abs(numbers(rows, metric))
    cases = rows["case"].to_numpy(dtype=np.int64)
    order = cases[np.argsort(-np.where(np.isfinite(sizes), sizes, -1.0), kind="stable")]
    silent = set(cases[~np.isfinite(sizes)].tolist())
    kinds = [
        [case for case in order.tolist() if case not in silent],
        [case for case in kept if case in silent],
        np.random.default_rng(_SEED).permutation(kept).tolist(),
    ]
    chosen = dict.fromkeys(kept[:1])
    for kind in kinds:
        chosen.update(dict.fromkeys([case for case in kind if case not in chosen][:_MOST_OF_A_KIND]))
    return list(chosen)


def shown_case(run: StoredRun, case: int) -> ShownCase | None:
    """A kept case as a page shows it; None where no system knows its products."""
    products = run.products(case)
    kind = case_kind(products)
    if kind is None:
        return None
    view = kind.view(products, f"case{case}")
    legend = kind.legend if view.legend is None else view.legend
    return ShownCase(case, _outcome(run.whole, case), view, legend)


def write_case_figures(directory: Path, products: Mapping[str, Any]) -> list[Path]:
    """Writes a case's figures into a folder; returns their paths, none where no system knows the products.

    Raises
    ------
    OSError
        Where they cannot be written.
    """
    kind = case_kind(products)
    return [] if kind is None else kind.write(directory, products)


def _outcome(frame: pd.DataFrame, case: int) -> str:
    if "case" not in frame or "outcome" not in frame:
        return NOTHING
    found = frame.loc[frame["case"] == case, "outcome"]
    return str(found.iloc[0]) if len(found) else NOTHING


#: Cases of each kind.
OF_A_KIND = 2
#: The others are drawn from a fixed seed: the same rows give the same cases.
_SEED = 20260302


def notable_cases(run: StoredRun) -> list[int]:
    """Cases that came to their end: those of the largest errors, the first without one, and others at random."""
    rows = run.whole[members(run.whole, "completed")]
    metric = primary_metric(run.frame, run.requirements)
    if "case" not in rows or metric is None:
        return []
    cases, sizes = rows["case"].to_numpy(dtype=np.int64), np.abs(numbers(rows, metric))
    known = np.isfinite(sizes)
    kinds = (
        cases[known][np.argsort(-sizes[known], kind="stable")][:OF_A_KIND],
        cases[~known][:OF_A_KIND],
        cases[np.random.default_rng(_SEED).permutation(cases.size)],
    )
    chosen: dict[int, None] = {}
    for kind in kinds:
        chosen.update(dict.fromkeys([case for case in kind.tolist() if case not in chosen][:OF_A_KIND]))
    return list(chosen)
