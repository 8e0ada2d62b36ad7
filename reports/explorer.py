"""The cases as points that a reader can explore: hover shows a case, a click opens it. Data for `explorer.js`."""

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

from marsyard.reports.columns import axis_columns, driver_columns, label, numbers
from marsyard.reports.populations import ENGINE_FAILURES
from marsyard.reports.sections import replay_command
from marsyard.reports.stored import StoredRun

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
