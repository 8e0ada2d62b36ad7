"""Presentation of real cases: agreement, pictures with matches, and the figures of their task's system."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.reports.dimes.presentation import DIMES_CASE
from marsyard.reports.hda.case_figures import FIGURES, figures_reached
from marsyard.reports.measured.agreement import agreement_section
from marsyard.reports.measured.case_figures import (
    MatchedPair,
    draw_pair,
    is_measured_case,
    matched_pairs,
    write_measured_figures,
)
from marsyard.reports.presentation import CaseKind, CaseView, Presentation, TableRow, save_figures
from marsyard.reports.section import plate
from marsyard.reports.wording import number

#: Maximum number of pairs in the page.
_MAX_PAIRS = 4
#: Figures of a landing that need no truth.
_WITHOUT_TRUTH = ("fig1-tracks", "fig3-epipolar", "fig4-elevation")
_LEGEND = (
    "Features matched between one picture and the next, coloured by how far they lie from where the measured poses "
    "allow them; grey crosses: matches that no rigid motion explains, which are left out. Offsets are those of the "
    "later picture: their spread shows errors of matching and lens, a common offset an attitude error. "
)


def view(products: Mapping[str, Any], key: str) -> CaseView:
    """View of a real case."""
    pairs = matched_pairs(products)
    plates = [plate(draw_pair(pair), f"{key}matches{pair.number}", f"{pair.caption}.", wide=True) for pair in pairs]
    left_out = len(plates) - _MAX_PAIRS
    facts = [("Pairs not shown", str(left_out))] if left_out > 0 else []
    plates = plates[:_MAX_PAIRS]
    if DIMES_CASE.is_case(products) and "tracks" in products:
        theirs = DIMES_CASE.view(products, key)
        return CaseView([*facts, *theirs.facts], [*plates, *theirs.plates], theirs.head, theirs.rows)
    plates += [plate(FIGURES[name](products), f"{key}{name[:4]}", f"{name}.", wide=True) for name in _landing(products)]
    head = ["Pictures", "Matches", "Wrong", "Median residual (px)", "90 % (px)"]
    head += ["Offset right (px)", "Offset down (px)"]
    return CaseView(facts, plates, head, [_row(pair) for pair in pairs])


def _row(pair: MatchedPair) -> TableRow:
    residuals, offsets = pair.residuals_px, pair.offsets[pair.right]
    cells = [f"{pair.number} and {pair.number + 1}", f"{residuals.size:,}", f"{int((~pair.right).sum()):,}"]
    if not residuals.size:
        return TableRow([*cells, *4 * ["–"]], succeeded=False)
    values = [np.median(residuals), np.quantile(residuals, 0.9, method="higher"), *np.nanmedian(offsets, axis=0)]
    return TableRow([*cells, *(number(float(value)) for value in values)], succeeded=True)


def _landing(products: Mapping[str, Any]) -> list[str]:
    return [name for name in figures_reached(products) if name in _WITHOUT_TRUTH]


def _write(directory: Path, products: Mapping[str, Any]) -> list[Path]:
    written = write_measured_figures(directory, products)
    if DIMES_CASE.is_case(products) and "tracks" in products:
        return [*written, *DIMES_CASE.write(directory, products)]
    return [*written, *save_figures(directory, {name: FIGURES[name](products) for name in _landing(products)}, dpi=130)]


MEASURED = Presentation(cases=(CaseKind(is_measured_case, view, _write, _LEGEND),), first=(agreement_section,))
