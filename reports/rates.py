"""Populations of stored rows, and rates and numbers of them with intervals and texts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from marsyard.campaigns.errors import UNFINISHED
from marsyard.reports.statistics.proportions import Interval, clustered_evidence, proportion_interval
from marsyard.reports.wording import NOTHING, number, numbers, percent

#: Outcomes of cases that the engine could not finish.
ENGINE_FAILURES = UNFINISHED


def success_mask(frame: pd.DataFrame, metric: str, bound: float, scale: float = 1.0) -> Bool[np.ndarray, " n"]:
    """Mask of the cases with |scale * metric| <= bound, or with a true metric if the bound is NaN.

    False for missing values and unfinished cases. A metric may be a sum of columns, joined by " + ".
    """
    finished = ~engine_failed(frame)
    if math.isnan(bound):
        return np.asarray(flag(frame, metric) & finished, dtype=np.bool_)
    values = sum((numbers(frame, part) for part in metric.split(" + ")), np.zeros(len(frame)))
    return np.asarray((np.abs(scale * values) <= bound) & finished, dtype=np.bool_)


def members(frame: pd.DataFrame, population: str) -> Bool[np.ndarray, " n"]:
    """Mask of a population: `all`, `completed`, `valid`, a column of true and false, or several joined by " and ".

    A case of unknown membership, such as a crashed case, is a member. Raises ValueError if no row has the column.
    """
    return members_and_unknown(frame, population.split(" and "))[0]


def members_and_unknown(
    frame: pd.DataFrame, parts: Sequence[str]
) -> tuple[Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Members of the intersection of populations, and members of unknown membership."""
    chosen, unknown = np.ones(len(frame), dtype=np.bool_), np.zeros(len(frame), dtype=np.bool_)
    for part in parts:
        if part == "completed":
            chosen &= ~engine_failed(frame)
        elif part != "all":
            column = "answered" if part == "valid" else part
            if not is_flag(frame, column):
                raise ValueError(
                    f"the rows have no column '{column}' of true and false, by which a population is known"
                )
            missing = frame[column].isna().to_numpy(dtype=np.bool_)
            chosen &= flag(frame, column) | missing
            unknown |= missing
    return chosen, chosen & unknown


def is_flag(frame: pd.DataFrame, column: str) -> bool:
    """Whether a column holds only true, false and missing values."""
    return column in frame and all(isinstance(value, bool | np.bool_) for value in frame[column].dropna().unique())


def engine_failed(frame: pd.DataFrame) -> Bool[np.ndarray, " n"]:
    """Cases that the engine could not finish."""
    if "outcome" not in frame:
        return np.zeros(len(frame), dtype=np.bool_)
    return frame["outcome"].isin(ENGINE_FAILURES).to_numpy(dtype=np.bool_)


def members_if_answered(frame: pd.DataFrame, population: str) -> Bool[np.ndarray, " n"]:
    """Members of a population, and unfinished cases that a valid answer would make members."""
    others = [part for part in population.split(" and ") if part not in ("valid", "completed")]
    return np.asarray(members(frame, population) | (members_and_unknown(frame, others)[0] & engine_failed(frame)))


def terrain_groups(chosen: pd.DataFrame) -> Int[np.ndarray, " n"] | None:
    """Terrain index of each case from 0; None if unknown for all. A case of unknown terrain has its own index."""
    if "terrain" not in chosen or bool(chosen["terrain"].isna().all()):
        return None
    codes, terrain_names = pd.factorize(chosen["terrain"])
    groups = np.array(codes, dtype=np.int64)
    alone = groups < 0
    groups[alone] = len(terrain_names) + np.arange(int(alone.sum()))
    return groups


#: Confidence of the two-sided intervals.
CONFIDENCE = 0.9
_RESAMPLES = 1000
#: The same rows give the same page.
_SEED = 2005


@dataclass(frozen=True)
class Share:
    """A fraction of cases with its two-sided intervals at `CONFIDENCE`; NaN for no cases.

    lower, upper: Clopper-Pearson interval for independent cases
    shared_lower, shared_upper: interval that allows for shared terrains; None where no terrain is shared
    """

    n: int
    hits: int
    share: float
    lower: float
    upper: float
    shared_lower: float | None = None
    shared_upper: float | None = None

    @property
    def sound(self) -> tuple[float, float]:
        """The interval that allows for shared terrains."""
        if self.shared_lower is None or self.shared_upper is None:
            return self.lower, self.upper
        return self.shared_lower, self.shared_upper


def fraction_of(hit: Bool[np.ndarray, " n"], frame: pd.DataFrame) -> Share:
    """The fraction of the cases of `frame` that `hit` marks."""
    n, hits = hit.size, int(hit.sum())
    if n == 0:
        return Share(0, 0, math.nan, 0.0, 1.0)
    groups, shared = terrain_groups(frame), None
    if groups is not None and int(groups.max()) + 1 < n:
        evidence = clustered_evidence(hit, groups, 0.5 * (1.0 + CONFIDENCE))
        shared = evidence.lower, evidence.upper
    return Share(n, hits, hits / n, *proportion_interval(hits, n, CONFIDENCE), *(shared or (None, None)))


def flag_fraction(frame: pd.DataFrame, name: str, *, wanted: bool = True) -> Share:
    """The fraction of rows whose flag is as wanted."""
    return fraction_of(frame[name].eq(wanted).fillna(False).to_numpy(dtype=np.bool_), frame)


@dataclass(frozen=True)
class PooledRate:
    """A fraction of items counted in every case, pooled over cases; items within a case are correlated.

    hits, of: counted items, and all
    lower, upper: by bootstrap over cases, or over shared terrains; NaN if no case has a hit
    flights, flights_hit: cases with items, and with a hit
    """

    hits: int
    of: int
    share: float
    lower: float
    upper: float
    flights: int
    flights_hit: int


def pooled_rate(frame: pd.DataFrame, hits: str, of: str) -> PooledRate:
    """Pooled fraction of two columns of counts; missing hits count as 0."""
    top, bottom = (np.nan_to_num(numbers(frame, name)) for name in (hits, of))
    asked = bottom > 0
    cases, cases_hit = int(asked.sum()), int((asked & (top > 0)).sum())
    total = int(bottom.sum())
    if total == 0:
        return PooledRate(0, 0, math.nan, math.nan, math.nan, 0, 0)
    lower = upper = math.nan
    if cases_hit and cases > 1:
        groups = terrain_groups(frame[asked])
        drawn = np.arange(cases) if groups is None or int(groups.max()) < 1 else groups
        weights = bootstrap_weights(drawn, np.random.default_rng(_SEED))[1:]
        sums = weights @ bottom[asked]
        lower, upper = percentile_interval((weights @ top[asked])[sums > 0] / sums[sums > 0])
    return PooledRate(int(top.sum()), total, float(top.sum() / total), lower, upper, cases, cases_hit)


def bootstrap_weights(groups: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "resamples n"]:
    """Multiplicity of each case if whole groups are drawn with replacement; the first row is the sample itself."""
    count = int(groups.max()) + 1
    drawn = rng.multinomial(count, np.full(count, 1.0 / count), size=_RESAMPLES)
    return np.concatenate([np.ones((1, groups.size)), drawn[:, groups]]).astype(np.float64)


def percentile_interval(resampled: Float[np.ndarray, " b"]) -> Interval:
    """Two-sided percentile interval of a resampled statistic."""
    low, high = np.quantile(resampled, (0.5 * (1.0 - CONFIDENCE), 0.5 * (1.0 + CONFIDENCE)))
    return float(low), float(high)


def flag(frame: pd.DataFrame, name: str) -> Bool[np.ndarray, " n"]:
    """A column of true and false; missing values are false."""
    if not is_flag(frame, name):
        return np.zeros(len(frame), dtype=np.bool_)
    return np.asarray(frame[name].eq(True).fillna(False).to_numpy(dtype=np.bool_))


def all_flags(frame: pd.DataFrame, *names: str) -> Bool[np.ndarray, " n"]:
    """Mask of the rows with all flags that exist as columns."""
    chosen = [flag(frame, name) for name in names if is_flag(frame, name)]
    return np.asarray(np.logical_and.reduce([np.ones(len(frame), dtype=np.bool_), *chosen]))


def known(frame: pd.DataFrame, column: str, scale: float = 1.0) -> Float[np.ndarray, " n"]:
    """Finite numbers of a column, scaled."""
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
    """Rows by kind and size in order; the kind named `first` comes first."""
    sizes = numbers(frame, size)
    for kind in sorted(frame[column].dropna().unique(), key=lambda name: (name != first, str(name))):
        of_kind = frame[column].eq(kind).fillna(False).to_numpy(dtype=np.bool_)
        for value in np.unique(sizes[of_kind]):
            same = np.isnan(sizes) if np.isnan(value) else sizes == value
            yield str(kind), float(value), frame[of_kind & same]


def fraction_text(share: Share) -> str:
    """Hits, cases and share: ``19 of 20: 95.00 %``."""
    return f"{share.hits:,} of {share.n:,}: {percent(share.share)}" if share.n else NOTHING


def interval_text(share: Share, *, shared: bool = False) -> str:
    """Interval of a share for independent cases, or allowing for `shared` terrains."""
    if not share.n:
        return NOTHING
    return range_text(*share.sound) if shared else range_text(share.lower, share.upper)


def range_text(lower: float, upper: float) -> str:
    """Two bounds of a fraction."""
    return f"{percent(lower)} to {percent(upper)}"


def rate_text(one: PooledRate) -> str:
    """A rate with its interval: ``2.0 % (1.1 % to 3.2 %)``."""
    if one.of == 0:
        return NOTHING
    return percent(one.share) if math.isnan(one.lower) else f"{percent(one.share)} ({range_text(one.lower, one.upper)})"


def spread_text(values: Float[np.ndarray, " n"], digits: int | None = None) -> str:
    """Median, and minimum to maximum in brackets; one number for equal values, a dash for none."""
    if values.size == 0:
        return NOTHING
    low, middle, high = (float(one) for one in (values.min(), np.median(values), values.max()))
    texts = [number(one) if digits is None else f"{one:.{digits}f}".replace("-", "−") for one in (middle, low, high)]
    return texts[0] if texts[1] == texts[2] else f"{texts[0]} ({texts[1]} to {texts[2]})"
