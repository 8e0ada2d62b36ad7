"""How descents are presented: their sections, and a DIMES case as its image pairs, its velocities and its tracks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from marsyard.reports.columns import label
from marsyard.reports.dimes.case_figures import (
    Track,
    delivered_pictures,
    draw_dimes_pair,
    has_dimes_details,
    is_dimes_case,
    tracks,
    write_dimes_figures,
)
from marsyard.reports.dimes.sections import FIRING, LANDING, field_test_section, sensitivity_section
from marsyard.reports.dimes.stream import STREAM_CASE
from marsyard.reports.presentation import CaseKind, CaseView, Presentation, TableRow
from marsyard.reports.section import plate
from marsyard.reports.svg import draw_pictures
from marsyard.reports.wording import number

#: Columns of the tracks that the page has no room for, or says otherwise.
_NOT_SHOWN = ("pair", "template", "valid", "ground_east_m", "ground_north_m")
_LEGEND = (
    "Below, the pictures as delivered, columns binned: squares mark templates (red) and tracked places (green), not "
    "their size; dotted yellow outlines the overlap, a yellow cross the zero-phase spot. Above, both pictures of a "
    "pair rectified to one camera that looks straight down, north up, with templates, search windows (blue) and "
    "tracked places to scale. Between, templates and windows as they are correlated. Dashed: a validity check was not "
    "passed."
)

_PLAIN_LEGEND = (
    "Pictures as delivered, columns binned. Tracks and templates are drawn of algorithms whose answers have the "
    "details of DIMES (docs/own-algorithms.md)."
)


def view(products: Mapping[str, Any], key: str) -> CaseView:
    """A DIMES case; of an algorithm without DIMES' details its pictures alone."""
    if not has_dimes_details(products):
        pictures = draw_pictures(delivered_pictures(products))
        shown = plate(pictures, f"{key}pictures", "The three pictures that the algorithm was given.", wide=True)
        return CaseView(_velocities(products), [shown], [], [], _PLAIN_LEGEND)
    pairs = enumerate(("first and second picture", "second and third picture"))
    plates = [plate(draw_dimes_pair(products, k), f"{key}pair{k}", f"Pair {k + 1}: {name}.") for k, name in pairs]
    of_each = tracks(products)
    quantities = list(dict.fromkeys(name for track in of_each for name in track.values))
    quantities = [name for name in quantities if name not in _NOT_SHOWN and not _is_check(name)]
    return CaseView(
        facts=_velocities(products),
        plates=plates,
        head=["Pair", "Template", "Failed checks", *(label(name) for name in quantities)],
        rows=[_track_row(track, quantities) for track in of_each],
    )


DIMES_CASE = CaseKind(is_dimes_case, view, write_dimes_figures, _LEGEND)
DIMES = Presentation(cases=(STREAM_CASE, DIMES_CASE), sections=(FIRING, LANDING, sensitivity_section))
FIELD_TEST = Presentation(first=(field_test_section,))


def _track_row(track: Track, quantities: Sequence[str]) -> TableRow:
    values = [number(track.values.get(name, float("nan"))) for name in quantities]
    failed = [_check_words(name) for name, value in track.values.items() if _is_check(name) and value == 1.0]
    said = ", ".join(failed) or ("none" if track.valid else "unknown")
    return TableRow([str(track.pair + 1), str(track.template + 1), said, *values], track.valid)


def _is_check(name: str) -> bool:
    return name.startswith("failed_")


def _check_words(name: str) -> str:
    return name.removeprefix("failed_").replace("_", " ")


def _velocities(products: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Estimated and true velocity, where the products hold them."""
    facts = []
    for key, name in (("velocity_estimated_m_s", "Estimated velocity"), ("velocity_true_m_s", "True velocity")):
        try:
            velocity = np.asarray(products.get(key, ()), dtype=np.float64).ravel()
        except (TypeError, ValueError):
            continue
        if velocity.size >= 2 and np.isfinite(velocity[:2]).all():
            facts.append((name, f"{velocity[0]:+.2f} m/s east, {velocity[1]:+.2f} m/s north"))
    return facts
