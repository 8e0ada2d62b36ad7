"""What rows of landing campaigns hold, and the words in which all of their sections tell it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from marsyard.reports.answers import CONFIDENCE, Share
from marsyard.reports.columns import numbers
from marsyard.reports.dimes.sensitivity import bootstrap_weights
from marsyard.reports.populations import is_flag, terrain_groups
from marsyard.reports.section import Subject
from marsyard.reports.stored import table
from marsyard.reports.wording import NOTHING, percent

#: Columns that every row of a landing case has.
_OWN = ("site_safe", "site_reported", "no_site_reported", "truly_safe_share")
#: The same rows give the same page.
_SEED = 2005


@dataclass(frozen=True)
class Rate:
    """A share of footprints over all flights, which within one flight are not independent.

    Attributes
    ----------
    hits, of
        Footprints that count, and all.
    share
        hits / of; NaN for none.
    lower, upper
        By bootstrap over flights, or over terrains where flights share them; NaN where no flight has a hit, for which a
        bootstrap shows nothing.
    flights, flights_hit
        Flights with such footprints, and those with a hit.
    """

    hits: int
    of: int
    share: float
    lower: float
    upper: float
    flights: int
    flights_hit: int


def is_landing(frame: pd.DataFrame) -> bool:
    """Whether rows are those of landing cases."""
    return all(name in frame for name in _OWN) and len(frame) > 0


def flag(frame: pd.DataFrame, name: str) -> Bool[np.ndarray, " n"]:
    """A column of true and false; false where it is missing or not known."""
    if not is_flag(frame, name):
        return np.zeros(len(frame), dtype=np.bool_)
    return np.asarray(frame[name].fillna(False).to_numpy(dtype=np.bool_))


def varies(frame: pd.DataFrame, name: str) -> bool:
    """Whether a column of numbers has more than one value."""
    values = numbers(frame, name)
    known = values[np.isfinite(values)]
    return known.size > 1 and bool(np.ptp(known) > 0.0)


def stated_parameter(subject: Subject, *path: str) -> Any:
    """A parameter as the campaign's file states it for all cases; None where it does not."""
    value: Any = table(subject.run.configuration).get("parameters")
    for name in path:
        value = table(value).get(name)
    return value


def rate(frame: pd.DataFrame, hits: str, of: str) -> Rate:
    """Pooled share of two columns of counts."""
    top, bottom = (np.nan_to_num(numbers(frame, name)) for name in (hits, of))
    asked = bottom > 0
    flights, flights_hit = int(asked.sum()), int((asked & (top > 0)).sum())
    total = int(bottom.sum())
    if total == 0:
        return Rate(0, 0, float("nan"), float("nan"), float("nan"), 0, 0)
    lower = upper = float("nan")
    if flights_hit and flights > 1:
        lower, upper = _bootstrap(frame[asked], top[asked], bottom[asked])
    return Rate(int(top.sum()), total, float(top.sum() / total), lower, upper, flights, flights_hit)


def _bootstrap(
    frame: pd.DataFrame, top: Float[np.ndarray, " n"], bottom: Float[np.ndarray, " n"]
) -> tuple[float, float]:
    groups = terrain_groups(frame)
    chosen = np.arange(len(frame)) if groups is None or int(groups.max()) < 1 else groups
    weights = bootstrap_weights(chosen, np.random.default_rng(_SEED))[1:]
    sums = weights @ bottom
    known = sums > 0
    shares = (weights @ top)[known] / sums[known]
    low, high = np.quantile(shares, (0.5 * (1.0 - CONFIDENCE), 0.5 * (1.0 + CONFIDENCE)))
    return float(low), float(high)


def rate_text(one: Rate) -> str:
    """A rate with its interval: ``2.0 % (1.1 % to 3.2 %)``."""
    if one.of == 0:
        return NOTHING
    if np.isnan(one.lower):
        return percent(one.share)
    return f"{percent(one.share)} ({percent(one.lower)} to {percent(one.upper)})"


def share_text(share: Share) -> str:
    """Hits, cases and share: ``19 of 20 (95.00 %)``."""
    return f"{share.hits:,} of {share.n:,} ({percent(share.share)})" if share.n else NOTHING


def interval_text(share: Share) -> str:
    """A share's interval as for independent cases."""
    return f"{percent(share.lower)} to {percent(share.upper)}" if share.n else NOTHING
