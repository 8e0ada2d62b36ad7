"""Section on the consistency of covariances: whether the errors of estimates agree with the reported covariances.

The normalised estimation error squared (NEES) of an estimate is its error, weighted by the inverse of its covariance.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy import stats

from marsyard.reports import rates
from marsyard.reports.comparison import list_compared_algorithms, select_algorithm
from marsyard.reports.rates import CONFIDENCE
from marsyard.reports.section import Block, Grid, Section, Subject
from marsyard.reports.statistics.proportions import proportion_interval
from marsyard.reports.wording import format_fraction, note_text, number, percent

#: Columns of NEES, of which a system has at most one, and their degrees of freedom.
NEES, NEES_DIMENSION = ("velocity_nees", "position_nees"), 2
#: Probability of the band of the mean NEES, and of the error ellipse.
BAND_PROBABILITY = 0.95


@dataclass(frozen=True)
class Consistency:
    """Agreement of the errors of estimates with their covariances.

    - n, mean: number of estimates, and mean of their NEES
    - lower, upper: band of the mean for correct covariances
    - inside, inside_lower, inside_upper: fraction of errors inside their ellipse, and its interval
    - word: "consistent", "optimistic" (errors larger than the covariances) or "pessimistic"
    """

    n: int
    mean: float
    lower: float
    upper: float
    inside: float
    inside_lower: float
    inside_upper: float
    word: str


def evaluate_consistency(nees: Float[np.ndarray, " n"]) -> Consistency:
    """Evaluate from the NEES of at least one estimate whether the errors agree with their covariances."""
    n, mean = nees.size, float(nees.mean())
    tail = 0.5 * (1.0 - BAND_PROBABILITY)
    # for correct covariances, the sum of n NEES has a chi-square distribution with n * dimension degrees of freedom
    lower, upper = (float(stats.chi2.ppf(level, NEES_DIMENSION * n)) / n for level in (tail, 1.0 - tail))
    n_inside = int((nees <= stats.chi2.ppf(BAND_PROBABILITY, NEES_DIMENSION)).sum())
    word = "optimistic" if mean > upper else "pessimistic" if mean < lower else "consistent"
    return Consistency(n, mean, lower, upper, n_inside / n, *proportion_interval(n_inside, n, CONFIDENCE), word)


def evaluate_consistencies(frame: pd.DataFrame) -> dict[str, Consistency]:
    """Evaluate the consistency of all algorithms with covariances in the rows, by name."""
    tested_name = str(frame["algorithm"].iloc[0]) if "algorithm" in frame and len(frame) else "tested"
    frames = {tested_name: frame, **{name: select_algorithm(frame, name) for name in list_compared_algorithms(frame)}}
    values = {name: [rates.finite_values(rows, column) for column in NEES] for name, rows in frames.items()}
    return {name: evaluate_consistency(nees) for name, columns in values.items() for nees in columns if nees.size}


def consistency_section(subject: Subject) -> Section | None:
    """Create the section that compares reported covariances with errors; None without covariances."""
    results = evaluate_consistencies(subject.frame)
    if not results:
        return None
    rows = []
    for name, result in results.items():
        inside = f"{percent(result.inside)} ({rates.range_text(result.inside_lower, result.inside_upper)})"
        band = f"{number(result.lower)} to {number(result.upper)}"
        rows.append([name, f"{result.n:,}", number(result.mean), band, inside, result.word])
    band_text = format_fraction(BAND_PROBABILITY)
    head = [
        "Algorithm",
        "Estimates",
        "Mean NEES",
        f"{band_text} band",
        f"Within {band_text} ellipse",
        "Covariances are",
    ]
    blocks = [Block(grid=Grid(head, rows), note=note_text("common.consistency", parts=NEES_DIMENSION))]
    return Section("consistency", "Consistency", "Reported covariances against errors", blocks, results)
