"""The page's figures with their captions, and the pictures of the cases that were kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from reports.columns import driver_columns, label, numbers, rank_correlation
from reports.dimes_figures import Track, draw_dimes_pair, is_dimes_case, tracks
from reports.figures import (
    error_against,
    error_distribution,
    error_histogram,
    error_scatter,
    off_scale,
    outcome_bars,
    worth_a_closer_look,
)
from reports.stored import StoredRun
from reports.svg import svg_markup
from reports.wording import NOTHING, count, number

#: Kept cases whose pictures go into the page; each takes about half a megabyte.
_MOST_SHOWN = 2
#: Columns of the tracks that the page has no room for, or says otherwise.
_NOT_SHOWN = ("pair", "template", "valid", "ground_east_m", "ground_north_m")


@dataclass(frozen=True)
class Plate:
    """A figure as SVG, and its caption."""

    svg: Markup
    caption: str


@dataclass(frozen=True)
class TrackRow:
    """A track's numbers as texts, and whether it passed the validity checks."""

    values: Sequence[str]
    valid: bool


@dataclass(frozen=True)
class ShownCase:
    """A kept case: its number, what became of it, its pictures and its tracks."""

    case: int
    outcome: str
    facts: Sequence[tuple[str, str]]
    plates: Sequence[Plate]
    track_head: Sequence[str]
    track_rows: Sequence[TrackRow]


def error_plates(frame: pd.DataFrame, metric: str, bound: float | None) -> list[Plate]:
    """Scatter and distribution of a metric."""
    beyond = off_scale(frame, metric, bound)
    scatter = "Errors of single cases; the dashed circle is the requirement."
    if beyond:
        scatter += f" {count(beyond, 'error')} too large for these axes: drawn at their edge."
    plates: list[tuple[str, Figure | None, str]] = [
        ("scatter", error_scatter(frame, metric, bound), scatter),
        ("histogram", error_histogram(frame, metric, bound), "How often each magnitude of error occurred."),
        ("distribution", error_distribution(frame, metric, bound), "Fraction of cases up to each magnitude."),
    ]
    if worth_a_closer_look(frame, metric, bound):
        closer = ("close", error_scatter(frame, metric, bound, close=True), "The same errors seen closely.")
        plates.insert(1, closer)
    return _plates(plates)


def driver_plates(frame: pd.DataFrame, metric: str, bound: float | None) -> list[Plate]:
    """A metric against what may drive it."""
    drivers = enumerate(driver_columns(frame, metric))
    return _plates(
        [(f"driver{k}", error_against(frame, metric, d, bound), _ranks(frame, metric, d)) for k, d in drivers]
    )


def _ranks(frame: pd.DataFrame, metric: str, driver: str) -> str:
    correlation = rank_correlation(numbers(frame, driver), np.abs(numbers(frame, metric)))
    if np.isnan(correlation):
        return f"{label(driver)}."
    return f"{label(driver)}: rank correlation {number(correlation)}."


def outcome_plates(frame: pd.DataFrame) -> list[Plate]:
    """How the cases ended."""
    caption = "Plain bars: an answer was given. Hatched: none was, as the algorithm said. Crossed: the case crashed."
    return _plates([("outcomes", outcome_bars(frame), caption)])


def shown_cases(run: StoredRun) -> list[ShownCase]:
    """The kept cases whose pictures can be drawn, the one chosen for the report first."""
    shown: list[ShownCase] = []
    for case in run.showcases:
        products = run.products(case)
        if len(shown) < _MOST_SHOWN and is_dimes_case(products):
            shown.append(_dimes_case(run, case, products))
    return shown


def _dimes_case(run: StoredRun, case: int, products: dict[str, object]) -> ShownCase:
    pairs = enumerate(("first and second picture", "second and third picture"))
    plates = [(f"case{case}pair{k}", draw_dimes_pair(products, k), f"Pair {k + 1}: {name}.") for k, name in pairs]
    of_each = tracks(products)
    quantities = list(dict.fromkeys(name for track in of_each for name in track.values))
    quantities = [name for name in quantities if name not in _NOT_SHOWN and not _is_check(name)]
    return ShownCase(
        case=case,
        outcome=_outcome(run.frame, case),
        facts=_velocities(products),
        plates=_plates(plates),
        track_head=["Pair", "Template", "Failed checks", *(label(name) for name in quantities)],
        track_rows=[_track_row(track, quantities) for track in of_each],
    )


def _track_row(track: Track, quantities: Sequence[str]) -> TrackRow:
    values = [number(track.values.get(name, float("nan"))) for name in quantities]
    failed = [_check_words(name) for name, value in track.values.items() if _is_check(name) and value == 1.0]
    said = ", ".join(failed) or ("none" if track.valid else "unknown")
    return TrackRow([str(track.pair + 1), str(track.template + 1), said, *values], track.valid)


def _is_check(name: str) -> bool:
    return name.startswith("failed_")


def _check_words(name: str) -> str:
    return name.removeprefix("failed_").replace("_", " ")


def _outcome(frame: pd.DataFrame, case: int) -> str:
    if "case" not in frame or "outcome" not in frame:
        return NOTHING
    found = frame.loc[frame["case"] == case, "outcome"]
    return str(found.iloc[0]) if len(found) else NOTHING


def _velocities(products: dict[str, object]) -> list[tuple[str, str]]:
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


def _plates(wanted: Sequence[tuple[str, Figure | None, str]]) -> list[Plate]:
    plates = []
    for key, figure, caption in wanted:
        if figure is not None:
            # Matplotlib has escaped the texts inside; the description is escaped where it is put in.
            plates.append(Plate(Markup(svg_markup(figure, key, caption)), caption))  # noqa: S704
    return plates
