"""What the page draws of all rows: figures with their captions, and points that a reader can explore."""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Int
from markupsafe import Markup
from matplotlib.figure import Figure

from marsyard.reports.columns import axis_columns, driver_columns, label, numbers
from marsyard.reports.figures import (
    beyond_the_axis,
    error_against,
    error_distribution,
    error_histogram,
    error_scatter,
    outcome_bars,
    worth_a_closer_look,
)
from marsyard.reports.populations import ENGINE_FAILURES, terrain_groups
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Plate, plate
from marsyard.reports.sections import replay_command
from marsyard.reports.statistics.drivers import Driver, driver
from marsyard.reports.stored import StoredRun
from marsyard.reports.wording import coefficient, count, stated


def error_plates(frame: pd.DataFrame, whole: pd.DataFrame, metric: str, bound: float | None) -> list[Plate]:
    """Scatter of a metric over some rows, and its distribution over all."""
    scatter = "Errors of single cases; the dashed circle is the requirement. Hollow: beyond the axes, at their edge."
    plates: list[tuple[str, Figure | None, str]] = [
        ("scatter", error_scatter(frame, metric, bound), scatter),
        (
            "histogram",
            error_histogram(whole, metric, bound),
            "How often each magnitude of error occurred; hatched: beyond the axis.",
        ),
        ("distribution", error_distribution(whole, metric, bound), "Fraction of cases up to each magnitude."),
    ]
    if worth_a_closer_look(frame, metric, bound):
        closer = ("close", error_scatter(frame, metric, bound, close=True), "The same errors seen closely.")
        plates.insert(1, closer)
    return _plates(plates)


def driver_plates(frame: pd.DataFrame, metric: str, bound: float | None) -> list[Plate]:
    """A metric against what may drive it."""
    drivers = enumerate(driver_columns(frame, metric))
    return _plates(
        [
            (f"driver{k}", error_against(frame, metric, d, bound), _driver_caption(frame, metric, d, bound))
            for k, d in drivers
        ]
    )


def _driver_caption(frame: pd.DataFrame, metric: str, column: str, bound: float | None) -> str:
    """The condition's name, its rank correlation with the errors, and how many of them lie beyond the axis."""
    found = driver(numbers(frame, column), np.abs(numbers(frame, metric)), terrain_groups(frame), CONFIDENCE)
    text = f"{label(column)}."
    if found is not None:
        text = f"{label(column)}: rank correlation {rank_text(found)}."
    beyond = beyond_the_axis(frame, metric, column, bound)
    return f"{text} {count(beyond, 'error')} beyond the axis: hollow, at its upper edge." if beyond else text


def rank_text(found: Driver) -> str:
    """A rank correlation with its interval: ``0.310 (0.120 to 0.480 at 90 % confidence)``."""
    lower, upper = coefficient(found.lower), coefficient(found.upper)
    return f"{coefficient(found.correlation)} ({lower} to {upper} at {stated(CONFIDENCE)} confidence)"


def outcome_plates(frame: pd.DataFrame) -> list[Plate]:
    """How the cases ended."""
    caption = "Plain bars: an answer was given. Hatched: none was, as the algorithm said. Crossed: the case crashed."
    return _plates([("outcomes", outcome_bars(frame), caption)])


def _plates(wanted: Sequence[tuple[str, Figure | None, str]]) -> list[Plate]:
    return [plate(figure, key, caption) for key, figure, caption in wanted if figure is not None]


#: Most points, and how many of the worst, of those without an answer and of the crashed are among them in any event.
MOST_POINTS, MOST_NOTABLE = 2000, 150
_SCRIPT = Path(__file__).parent / "templates" / "explorer.js"


def explorer_data(run: StoredRun, metric: str, bound: float | None, pictured: Collection[str]) -> dict[str, Any]:
    """What the page's script draws: the points' columns, their labels, which axes come first, and the bound."""
    frame = run.frame
    parts = axis_columns(metric, [str(name) for name in frame.columns])[:2]
    drivers = driver_columns(frame, metric)
    names = list(dict.fromkeys([*parts, *drivers, metric]))
    chosen = frame.iloc[points_of(frame, metric)]
    outcomes = chosen["outcome"].astype(str) if "outcome" in chosen else pd.Series("", index=chosen.index)
    kinds = list(dict.fromkeys(outcomes))
    cases = chosen["case"].tolist() if "case" in chosen else chosen.index.tolist()
    return {
        "labels": [label(name) for name in names],
        "columns": [_plain(numbers(chosen, name)) for name in names],
        "metric": names.index(metric),
        "parts": [names.index(part) for part in parts] if len(parts) == 2 else [],
        "axes": [names.index(name) for name in (parts if len(parts) == 2 else [(drivers or [metric])[0], metric])],
        "bound": bound,
        "cases": [int(case) for case in cases],
        "outcomes": [str(kind) for kind in kinds],
        "outcome": [kinds.index(kind) for kind in outcomes],
        "pictured": sorted(int(case) for case in pictured),
        "replay": replay_command(run, "CASE"),
        "shown": len(chosen),
        "all": len(run.whole),
    }


def points_of(frame: pd.DataFrame, metric: str) -> Int[np.ndarray, " n"]:
    """Which rows are drawn: all, or of many the notable ones and the first others, in their order."""
    if len(frame) <= MOST_POINTS:
        return np.arange(len(frame))
    magnitude = np.abs(numbers(frame, metric))
    known = np.isfinite(magnitude)
    crashed = frame["outcome"].isin(ENGINE_FAILURES).to_numpy() if "outcome" in frame else np.zeros(len(frame), bool)
    worst = np.argsort(-np.where(known, magnitude, -1.0), kind="stable")[:MOST_NOTABLE]
    notable = np.concatenate(
        [worst, np.flatnonzero(~known & ~crashed)[:MOST_NOTABLE], np.flatnonzero(crashed)[:MOST_NOTABLE]]
    )
    order = np.concatenate([notable, np.arange(len(frame))])
    _, first = np.unique(order, return_index=True)
    return np.sort(order[np.sort(first)][:MOST_POINTS])


def script() -> Markup:
    """The script that draws them; ours, and so put into the page as it is."""
    return Markup(_SCRIPT.read_text(encoding="utf-8"))  # noqa: S704


def script_hash(text: str) -> str:
    """A script as a page's security policy names it."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def embedded(data: Any) -> Markup:
    """Data as JSON that cannot end the element that it stands in."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    for letter in "<>&\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return Markup(text)  # noqa: S704


def _plain(values: Sequence[float] | np.ndarray) -> list[float | None]:
    """Numbers with the digits that a screen shows; None for NaN."""
    return [float(f"{value:.4g}") if math.isfinite(value) else None for value in values]
