"""How often an answer is given, and how often it is wrong: availability and "do no harm"."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool

from marsyard.reports.columns import split_unit
from marsyard.reports.populations import is_flag, members, succeeded, terrain_groups
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.statistics.clusters import clustered_evidence
from marsyard.reports.statistics.proportions import Interval, proportion_interval
from marsyard.reports.wording import NOTHING, percent, stated

#: Column of true and false that says whether a case's geometry leaves room for the algorithm to work at all.
ROOM = "room"
#: Confidence of the two-sided intervals.
CONFIDENCE = 0.9


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
    lower, upper = proportion_interval(hits, n, CONFIDENCE)
    return Share(n, hits, hits / n, lower, upper, *(_shared_interval(hit, frame) or (None, None)))


def answers_section(subject: Subject) -> Section | None:
    """Shares of cases with an answer, with room, and of answers beyond the bound; None where rows tell no answers."""
    shares = answer_shares(subject)
    if not shares:
        return None
    rows = [
        [name, f"{one.hits:,} of {one.n:,}", percent(one.share), _interval(one.lower, one.upper), _shared(one)]
        for name, one in shares.items()
    ]
    confidence = stated(CONFIDENCE)
    head = ["", "Cases", "Share", f"{confidence} interval", "Allowing for shared terrains"]
    note = (
        "Intervals: two-sided, Clopper and Pearson for independent cases; allowing for shared terrains by an effective "
        "number of cases, or by whole terrains where failures are too few to estimate it. A wrong answer is one that "
        "was reported although its error is beyond the bound: the harm that an estimator can do."
    )
    data = {name: asdict(one) for name, one in shares.items()}
    return Section(
        "answers", "Answers", "Answers given and answers wrong", [Block(grid=Grid(head, rows), note=note)], data
    )


def answer_shares(subject: Subject) -> Mapping[str, Share]:
    """The shares by name; those alone that the rows tell."""
    frame = subject.whole
    if not is_flag(frame, "answered") or frame.empty:
        return {}
    answered = members(frame, "valid")
    shares = {"answered, of all cases": share_of(answered, frame)}
    if is_flag(frame, ROOM):
        room, completed = members(frame, ROOM), members(frame, "completed")
        shares["answered, of cases whose geometry leaves room"] = share_of(answered[room], frame[room])
        shares["geometry leaves no room, of completed cases"] = share_of(~room[completed], frame[completed])
    if subject.metric is not None and subject.bound is not None:
        wrong = ~succeeded(frame[answered], subject.metric, subject.bound)
        name = f"wrong by more than {subject.bound:g} {split_unit(subject.metric)[1]}, of answers"
        shares[name] = share_of(wrong, frame[answered])
    return shares


def _shared_interval(hit: Bool[np.ndarray, " n"], frame: pd.DataFrame) -> Interval | None:
    """The interval that allows for shared terrains; None where no case shares one."""
    groups = terrain_groups(frame)
    if groups is None or int(groups.max()) + 1 == hit.size:
        return None
    evidence = clustered_evidence(hit, groups, 0.5 * (1.0 + CONFIDENCE))
    return evidence.lower, evidence.upper


def _interval(lower: float, upper: float) -> str:
    return f"{percent(lower)} to {percent(upper)}"


def _shared(share: Share) -> str:
    if share.shared_lower is None or share.shared_upper is None:
        return NOTHING
    return _interval(share.shared_lower, share.shared_upper)
