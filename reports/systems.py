"""The papers' systems whose cases can be drawn: for the page, and for `marsyard replay`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from marsyard.reports.columns import numbers, primary_metric
from marsyard.reports.dimes.shown import DIMES
from marsyard.reports.dimes.stream import STREAM
from marsyard.reports.hda.shown import HDA
from marsyard.reports.measured.shown import MEASURED
from marsyard.reports.shown import CaseView, System
from marsyard.reports.stored import StoredRun
from marsyard.reports.vtt.shown import VTT
from marsyard.reports.wording import NOTHING

#: Those whose products are looked for in a case, in this order.
SYSTEMS: tuple[System, ...] = (MEASURED, STREAM, DIMES, VTT, HDA)
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
    system = _system(products)
    if system is None:
        return None
    view = system.view(products, f"case{case}")
    legend = system.legend if view.legend is None else view.legend
    return ShownCase(case, _outcome(run.whole, case), view, legend)


def write_case_figures(directory: Path, products: Mapping[str, Any]) -> list[Path]:
    """Writes a case's figures into a folder; returns their paths, none where no system knows the products.

    Raises
    ------
    OSError
        Where they cannot be written.
    """
    system = _system(products)
    return [] if system is None else system.write(directory, products)


def _system(products: Mapping[str, Any]) -> System | None:
    return next((one for one in SYSTEMS if one.is_case(products)), None)


def _outcome(frame: pd.DataFrame, case: int) -> str:
    if "case" not in frame or "outcome" not in frame:
        return NOTHING
    found = frame.loc[frame["case"] == case, "outcome"]
    return str(found.iloc[0]) if len(found) else NOTHING
