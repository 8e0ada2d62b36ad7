"""Off-nominal cases: valid, invalid or wrong, for every fault and size of fault."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from marsyard.reports.answers import CONFIDENCE, Share, share_of
from marsyard.reports.columns import label, numbers, split_unit
from marsyard.reports.plates import plate
from marsyard.reports.populations import is_flag, members, succeeded
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.svg import REQUIREMENT, SERIES, in_page_style, new_axes
from marsyard.reports.wording import NOTHING, percent, stated

#: Columns that name what is wrong in a case and how large it is.
FAULT, SIZE = "fault", "fault_size"
#: The fault of a case without one.
NO_FAULT = "none"


@dataclass(frozen=True)
class FaultRow:
    """Cases with one fault of one size.

    Attributes
    ----------
    fault, size
        What is wrong, and its size; NaN where faults have none.
    n, valid, invalid, wrong
        Cases; answers within the bound, no answers, answers beyond the bound.
    wrong_share
        Wrong answers of all cases, with its interval.
    commonest_refusal
        The outcome that most of the invalid cases had; empty for none.
    """

    fault: str
    size: float
    n: int
    valid: int
    invalid: int
    wrong: int
    wrong_share: Share
    commonest_refusal: str


def faults_section(subject: Subject) -> Section | None:
    """One table over faults and sizes; None where no row has a fault, or errors have no bound."""
    frame = subject.frame
    if FAULT not in frame or subject.metric is None or subject.bound is None or not is_flag(frame, "answered"):
        return None
    rows = fault_rows(frame, subject.metric, subject.bound)
    if all(row.fault == NO_FAULT for row in rows):
        return None
    unit = split_unit(subject.metric)[1]
    caption = "Full: answers within the bound. Hatched: no answer. Crossed: wrong answers."
    figure = fault_bars(rows)
    drawn = plate(figure, "faults", caption)
    note = (
        f"Valid: answered within {subject.bound:g} {unit}. Invalid: no answer, as the algorithm said, or crashed. "
        f"Wrong: answered, but beyond the bound; with the two-sided Clopper-Pearson interval of its share of "
        f"all cases at {stated(CONFIDENCE)} confidence."
    )
    blocks = [Block(plates=[drawn]), Block(grid=_grid(rows), note=note)]
    return Section("faults", "Faults", "Faults by size", blocks, {"rows": [asdict(row) for row in rows]})


def fault_rows(frame: pd.DataFrame, metric: str, bound: float) -> list[FaultRow]:
    """Cases by fault and size: those without a fault first, then by name and size."""
    sizes = pd.Series(numbers(frame, SIZE), index=frame.index)
    found = []
    for fault in sorted(frame[FAULT].dropna().unique(), key=lambda name: (name != NO_FAULT, str(name))):
        of_fault = frame[FAULT].eq(fault).fillna(False)
        for size in np.unique(sizes[of_fault]):
            same = sizes.isna() if np.isnan(size) else sizes.eq(size)
            found.append(_row(frame[of_fault & same], str(fault), float(size), metric, bound))
    return found


def _row(chosen: pd.DataFrame, fault: str, size: float, metric: str, bound: float) -> FaultRow:
    answered = members(chosen, "valid")
    right = answered & succeeded(chosen, metric, bound)
    wrong = answered & ~right
    refusals = chosen.loc[~answered, "outcome"].value_counts() if "outcome" in chosen else pd.Series(dtype=int)
    return FaultRow(
        fault=fault,
        size=size,
        n=len(chosen),
        valid=int(right.sum()),
        invalid=int((~answered).sum()),
        wrong=int(wrong.sum()),
        wrong_share=share_of(wrong, chosen),
        commonest_refusal=str(refusals.index[0]) if len(refusals) else "",
    )


@in_page_style
def fault_bars(rows: list[FaultRow]) -> Figure:
    """Shares of valid, invalid and wrong cases, a bar each row."""
    figure, axes = new_axes(7.2, 1.0 + 0.27 * len(rows))
    left = np.zeros(len(rows))
    kinds = (
        ("valid", {"color": SERIES[0]}),
        ("invalid", {"color": "none", "edgecolor": SERIES[1], "hatch": "////"}),
        ("wrong", {"color": "none", "edgecolor": REQUIREMENT, "hatch": "xxxx"}),
    )
    for kind, style in kinds:
        share = np.array([100.0 * getattr(row, kind) / row.n for row in rows])
        axes.barh(np.arange(len(rows)), share, left=left, height=0.7, label=kind, **style)  # type: ignore[arg-type]
        left = left + share
    axes.set_yticks(np.arange(len(rows)), [_name(row) for row in rows])
    axes.set(xlabel="% of cases", xlim=(0.0, 100.0))
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    return figure


def _name(row: FaultRow) -> str:
    name = label(row.fault)
    return name if np.isnan(row.size) or row.fault == NO_FAULT else f"{name} {row.size:g}"


def _grid(rows: list[FaultRow]) -> Grid:
    head = ["Fault", "Size", "Cases", "Valid", "Invalid", "Wrong", "Wrong, interval", "Commonest refusal"]
    texts = []
    for row in rows:
        counts = [f"{count:,} ({percent(count / row.n)})" for count in (row.valid, row.invalid, row.wrong)]
        interval = f"{percent(row.wrong_share.lower)} to {percent(row.wrong_share.upper)}"
        size = NOTHING if np.isnan(row.size) or row.fault == NO_FAULT else f"{row.size:g}"
        refusal = row.commonest_refusal or NOTHING
        texts.append([label(row.fault), size, f"{row.n:,}", *counts, interval, refusal])
    return Grid(head, texts)
