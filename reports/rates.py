"""Rates and numbers of stored rows, with their intervals, and the words in which tables show them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from marsyard.reports.columns import numbers
from marsyard.reports.populations import is_flag, terrain_groups
from marsyard.reports.section import Subject
from marsyard.reports.statistics.clusters import clustered_evidence
from marsyard.reports.statistics.proportions import Interval, proportion_interval
from marsyard.reports.stored import table
from marsyard.reports.wording import NOTHING, number, percent

#: Confidence of the two-sided intervals.
CONFIDENCE = 0.9
_RESAMPLES = 1000
#: The same rows give the same page.
_SEED = 2005


@dataclass(frozen=True)
class Share:
    """A share of some cases, with its intervals at `CONFIDENCE`.

    Attributes
    ----------
    n, hits
        Cases, and those that count.
    share
        hits / n; NaN for no cases.
    lower, upper
        Clopper-Pearson interval, as for independent cases.
    shared_lower, shared_upper
        The interval that allows for cases on one terrain; None where none is shared.
    """

    n: int
    hits: int
    share: float
    lower: float
    upper: float
    shared_lower: float | None = None
    shared_upper: float | None = None

    @property
    def sound_lower(self) -> float:
        """The lower end of the interval that holds however the cases are spread over terrains."""
        return self.lower if self.shared_lower is None else self.shared_lower

    @property
    def sound_upper(self) -> float:
        """The upper end of it."""
        return self.upper if self.shared_upper is None else self.shared_upper


def share_of(hit: Bool[np.ndarray, " n"], frame: pd.DataFrame) -> Share:
    """The share of the cases of `frame` that `hit` marks, shape (n,)."""
    n, hits = hit.size, int(hit.sum())
    if n == 0:
        return Share(0, 0, math.nan, 0.0, 1.0)
    groups, shared = terrain_groups(frame), None
    if groups is not None and int(groups.max()) + 1 < n:
        evidence = clustered_evidence(hit, groups, 0.5 * (1.0 + CONFIDENCE))
        shared = evidence.lower, evidence.upper
    return Share(n, hits, hits / n, *proportion_interval(hits, n, CONFIDENCE), *(shared or (None, None)))


def flag_share(frame: pd.DataFrame, name: str, *, wanted: bool = True) -> Share:
    """The share of rows whose flag is as wanted."""
    return share_of(frame[name].eq(wanted).fillna(False).to_numpy(dtype=np.bool_), frame)


@dataclass(frozen=True)
class PooledRate:
    """A share of things counted in every case, pooled over cases; within one case they are not independent.

    Attributes
    ----------
    hits, of
        Things that count, and all.
    share
        hits / of; NaN for none.
    lower, upper
        By bootstrap over cases, or over terrains where cases share them; NaN where no case has a hit, for which a
        bootstrap shows nothing.
    flights, flights_hit
        Cases with such things, and those with a hit.
    """

    hits: int
    of: int
    share: float
    lower: float
    upper: float
    flights: int
    flights_hit: int


def pooled_rate(frame: pd.DataFrame, hits: str, of: str) -> PooledRate:
    """Pooled share of two columns of counts; a case without the first has no hit."""
    top, bottom = (np.nan_to_num(numbers(frame, name)) for name in (hits, of))
    asked = bottom > 0
    cases, cases_hit = int(asked.sum()), int((asked & (top > 0)).sum())
    total = int(bottom.sum())
    if total == 0:
        return PooledRate(0, 0, math.nan, math.nan, math.nan, 0, 0)
    lower = upper = math.nan
    if cases_hit and cases > 1:
        lower, upper = _bootstrap_ratio(frame[asked], top[asked], bottom[asked])
    return PooledRate(int(top.sum()), total, float(top.sum() / total), lower, upper, cases, cases_hit)


def _bootstrap_ratio(frame: pd.DataFrame, top: Float[np.ndarray, " n"], bottom: Float[np.ndarray, " n"]) -> Interval:
    groups = terrain_groups(frame)
    drawn = np.arange(len(frame)) if groups is None or int(groups.max()) < 1 else groups
    weights = bootstrap_weights(drawn, np.random.default_rng(_SEED))[1:]
    sums = weights @ bottom
    known = sums > 0
    return percentile_interval((weights @ top)[known] / sums[known])


def bootstrap_weights(groups: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "resamples n"]:
    """How often each case is drawn when whole groups are drawn with replacement; the first row is the sample itself."""
    count = int(groups.max()) + 1
    drawn = rng.multinomial(count, np.full(count, 1.0 / count), size=_RESAMPLES)
    return np.concatenate([np.ones((1, groups.size)), drawn[:, groups]]).astype(np.float64)


def percentile_interval(resampled: Float[np.ndarray, " b"]) -> Interval:
    """The two-sided percentile interval of a statistic over resamples."""
    low, high = np.quantile(resampled, (0.5 * (1.0 - CONFIDENCE), 0.5 * (1.0 + CONFIDENCE)))
    return float(low), float(high)


def flag(frame: pd.DataFrame, name: str) -> Bool[np.ndarray, " n"]:
    """A column of true and false; false where it is missing or not known."""
    if not is_flag(frame, name):
        return np.zeros(len(frame), dtype=np.bool_)
    return np.asarray(frame[name].eq(True).fillna(False).to_numpy(dtype=np.bool_))


def all_flags(frame: pd.DataFrame, *names: str) -> Bool[np.ndarray, " n"]:
    """Which rows have all of these flags; a flag that the rows do not have is left out."""
    chosen = [flag(frame, name) for name in names if is_flag(frame, name)]
    return np.asarray(np.logical_and.reduce([np.ones(len(frame), dtype=np.bool_), *chosen]))


def known(frame: pd.DataFrame, column: str, scale: float = 1.0) -> Float[np.ndarray, " n"]:
    """A column's finite numbers, times a factor."""
    values = numbers(frame, column)
    return np.asarray(scale * values[np.isfinite(values)])


def varies(frame: pd.DataFrame, name: str) -> bool:
    """Whether a column of numbers has more than one value."""
    values = known(frame, name)
    return values.size > 1 and bool(np.ptp(values) > 0.0)


def rms(values: Float[np.ndarray, " n"]) -> float:
    """Root mean square; NaN for none."""
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


def quantile(values: Float[np.ndarray, " n"], probability: float) -> float:
    """A quantile; NaN for no values."""
    return float(np.quantile(values, probability)) if values.size else math.nan


def by_size(frame: pd.DataFrame, column: str, size: str, first: str) -> Iterator[tuple[str, float, pd.DataFrame]]:
    """Rows by the kinds in a column and by their sizes, in order; the kind named `first` comes before all others."""
    sizes = numbers(frame, size)
    for kind in sorted(frame[column].dropna().unique(), key=lambda name: (name != first, str(name))):
        of_kind = frame[column].eq(kind).fillna(False).to_numpy(dtype=np.bool_)
        for value in np.unique(sizes[of_kind]):
            same = np.isnan(sizes) if np.isnan(value) else sizes == value
            yield str(kind), float(value), frame[of_kind & same]


def stated_parameter(subject: Subject, *path: str) -> Any:
    """A parameter as the campaign's file states it for all cases; None where it does not."""
    value: Any = table(subject.run.configuration).get("parameters")
    for name in path:
        value = table(value).get(name)
    return value


def share_text(share: Share) -> str:
    """Hits, cases and share: ``19 of 20: 95.00 %``."""
    return f"{share.hits:,} of {share.n:,}: {percent(share.share)}" if share.n else NOTHING


def interval_text(share: Share, *, shared: bool = False) -> str:
    """A share's interval as for independent cases, or the one that allows for `shared` terrains."""
    if not share.n:
        return NOTHING
    return range_text(share.sound_lower, share.sound_upper) if shared else range_text(share.lower, share.upper)


def range_text(lower: float, upper: float) -> str:
    """Two bounds of a share."""
    return f"{percent(lower)} to {percent(upper)}"


def rate_text(one: PooledRate) -> str:
    """A rate with its interval: ``2.0 % (1.1 % to 3.2 %)``."""
    if one.of == 0:
        return NOTHING
    return percent(one.share) if math.isnan(one.lower) else f"{percent(one.share)} ({range_text(one.lower, one.upper)})"


def spread_text(values: Float[np.ndarray, " n"], digits: int | None = None) -> str:
    """Median, and least to greatest in brackets; a dash for none, one number where all are alike."""
    if values.size == 0:
        return NOTHING
    low, middle, high = (float(one) for one in (values.min(), np.median(values), values.max()))
    texts = [number(one) if digits is None else f"{one:.{digits}f}".replace("-", "−") for one in (middle, low, high)]
    return texts[0] if texts[1] == texts[2] else f"{texts[0]} ({texts[1]} to {texts[2]})"
