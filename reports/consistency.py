"""Whether the covariances that came with estimates agree with their errors: normalised estimation error squared (NEES).

For a consistent estimator e' P^-1 e is distributed as chi-square with as many degrees of freedom as the error has parts
(Bar-Shalom, Li & Kirubarajan 2001, section 5.4.2): of n independent cases n times the mean lies within bounds of the
chi-square with n times as many. A mean above them says that the estimator is too sure of itself.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy import stats

from marsyard.reports.columns import numbers
from marsyard.reports.comparison import compared_names, own_frame
from marsyard.reports.section import Block, Section, Subject
from marsyard.reports.sections import Grid
from marsyard.reports.statistics.proportions import proportion_interval
from marsyard.reports.wording import number, percent

#: The column, and the parts that the error behind it has.
NEES, PARTS = "velocity_nees", 2
#: Probability of the bands, and of the ellipse whose hits are counted.
CONFIDENCE = 0.95
#: Confidence of the interval of the ellipse's hits.
HITS_CONFIDENCE = 0.9


@dataclass(frozen=True)
class Consistency:
    """What the covariances of one algorithm are worth.

    Attributes
    ----------
    name
        Its label.
    n
        Estimates with a covariance.
    mean, lower, upper
        Mean NEES, and the band in which it lies with 95 % probability if the covariances are right.
    inside, inside_lower, inside_upper
        Share of errors within their 95 % ellipse, and its 90 % interval (Clopper-Pearson).
    word
        "consistent", "too sure" (errors larger than stated) or "too cautious".
    """

    name: str
    n: int
    mean: float
    lower: float
    upper: float
    inside: float
    inside_lower: float
    inside_upper: float
    word: str


def consistency(name: str, nees: Float[np.ndarray, " n"], parts: int = PARTS) -> Consistency:
    """The consistency of estimates from their NEES, shape (n,), of errors of so many parts; n must be at least 1."""
    n = nees.size
    if n == 0:
        raise ValueError("no estimate has a covariance")
    tail = 0.5 * (1.0 - CONFIDENCE)
    lower, upper = (float(stats.chi2.ppf(q, parts * n)) / n for q in (tail, 1.0 - tail))
    inside = int((nees <= stats.chi2.ppf(CONFIDENCE, parts)).sum())
    mean = float(nees.mean())
    word = "too sure" if mean > upper else "too cautious" if mean < lower else "consistent"
    bounds = proportion_interval(inside, n, HITS_CONFIDENCE)
    return Consistency(name, n, mean, lower, upper, inside / n, *bounds, word)


def consistencies(frame: pd.DataFrame) -> list[Consistency]:
    """Those of all algorithms in the rows that state covariances."""
    judged = str(frame["algorithm"].iloc[0]) if "algorithm" in frame and len(frame) else "judged"
    frames = {judged: frame, **{name: own_frame(frame, name) for name in compared_names(frame)}}
    told = {name: numbers(own, NEES) for name, own in frames.items() if NEES in own}
    known = {name: nees[np.isfinite(nees)] for name, nees in told.items()}
    return [consistency(name, nees) for name, nees in known.items() if nees.size]


def consistency_section(subject: Subject) -> Section | None:
    """How stated covariances agree with errors; None where no algorithm states any."""
    found = consistencies(subject.frame)
    if not found:
        return None
    head = ["Algorithm", "Estimates", "Mean NEES", "95 % band", "Within 95 % ellipse", "Covariances are"]
    rows = [
        [
            one.name,
            f"{one.n:,}",
            number(one.mean),
            f"{number(one.lower)} to {number(one.upper)}",
            f"{percent(one.inside)} ({percent(one.inside_lower)} to {percent(one.inside_upper)})",
            one.word,
        ]
        for one in found
    ]
    note = (
        f"NEES: the squared error in units of the stated covariance; {PARTS} on average where the covariance is right. "
        "The band takes cases as independent and errors as normal; the share within the ellipse has a 90 % interval. "
        "Too sure: errors are larger than stated."
    )
    data = {one.name: {key: value for key, value in asdict(one).items() if key != "name"} for one in found}
    block = Block(grid=Grid(head, rows), note=note)
    return Section("consistency", "Consistency", "Stated covariances against errors", [block], data)
