"""The papers' systems whose cases can be drawn: for the page, and for `marsyard replay`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from reports.dimes.shown import DIMES
from reports.hda.shown import HDA
from reports.shown import CaseView, System
from reports.stored import StoredRun
from reports.vtt.shown import VTT
from reports.wording import NOTHING

#: Those whose products are looked for in a case, in this order.
SYSTEMS: tuple[System, ...] = (DIMES, VTT, HDA)
#: Kept cases whose pictures go into the page; each takes about half a megabyte.
_MOST_SHOWN = 2


@dataclass(frozen=True)
class ShownCase:
    """A kept case: its number, what became of it, what is shown of it, and its system's legend."""

    case: int
    outcome: str
    view: CaseView
    legend: str


def shown_cases(run: StoredRun) -> list[ShownCase]:
    """The kept cases whose pictures can be drawn, the one chosen for the report first."""
    shown: list[ShownCase] = []
    for case in run.showcases:
        if len(shown) == _MOST_SHOWN:
            break
        one = shown_case(run, case)
        if one is not None:
            shown.append(one)
    return shown


def shown_case(run: StoredRun, case: int) -> ShownCase | None:
    """A kept case as a page shows it; None where no system knows its products."""
    products = run.products(case)
    system = _system(products)
    if system is None:
        return None
    return ShownCase(case, _outcome(run.whole, case), system.view(products, f"case{case}"), system.legend)


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
