"""Verdicts and outcomes as the page shows them."""

import math
from enum import Enum
from typing import Any

import pandas as pd

from marsyard.algorithms.faults import Fault
from marsyard.reports.outcome_counts import outcome_counts
from marsyard.reports.presentation import presentations, system_presentation
from marsyard.reports.requirement_wording import requirement_text
from marsyard.reports.section import Grid
from marsyard.reports.verdicts import Verdict
from marsyard.reports.wording import NOTHING, count, percent


def verdict_row(verdict: Verdict) -> dict[str, Any]:
    """Format a verdict for the page.

    `strip` contains the data of the small diagram of rate, bounds and required rate: positions on its horizontal axis,
    in per cent of the length of the axis, and the label of its left end (`left`). None without bounds.
    """
    bounds_text, diagram = f"{percent(verdict.lower)} to {percent(verdict.upper)}", None
    if math.isnan(verdict.lower):
        bounds_text = NOTHING if math.isnan(verdict.estimate) else f"{percent(verdict.estimate)} observed"
    else:
        lowest = min(verdict.lower, verdict.probability)
        # the scale starts below the lower bound and the required rate, and ends at 100 %
        scale_start = max(0.0, lowest - 0.25 * (1.0 - lowest))
        rates = {"estimate": verdict.estimate, "required": verdict.probability}
        rates |= {"lower": verdict.lower, "upper": verdict.upper}
        scale = 100.0 / max(1.0 - scale_start, 1e-12)
        diagram = {"left": f"{100.0 * scale_start:.3g} %"} | {
            name: scale * (rate - scale_start) for name, rate in rates.items()
        }
    return {
        "verdict": verdict,
        "requirement": requirement_text(verdict),
        "evidence": [count(verdict.n, "case"), f"{verdict.failures:,} failed"],
        "bounds": bounds_text,
        "risk": "" if math.isnan(verdict.consumer_risk) else f"consumer's risk {percent(verdict.consumer_risk)}",
        "additional": NOTHING if verdict.additional_cases is None else f"{verdict.additional_cases:,}",
        "strip": diagram,
    }


def outcome_grid(frame: pd.DataFrame, scenario: str) -> Grid:
    """Count the cases by outcome, with the meaning of each outcome in the system of the scenario.

    Several systems have outcomes of the same name: the meaning in the scenario's own system takes precedence.
    """
    own_presentation = system_presentation(scenario)
    others = [presentation for presentation in presentations().values() if presentation is not own_presentation]
    # later meanings replace earlier ones
    ordered = others if own_presentation is None else [*others, own_presentation]
    kinds: list[type[Enum]] = [Fault, *(kind for presentation in ordered for kind in presentation.outcomes)]
    meanings = {member.name: str(member.value) for kind in kinds for member in kind}
    n_cases, counts = len(frame), outcome_counts(frame)
    rows = [[name, f"{cases:,}", percent(cases / n_cases), meanings.get(name, NOTHING)] for name, cases in counts]
    return Grid(["Outcome", "Cases", "Fraction", "Meaning"], rows)
