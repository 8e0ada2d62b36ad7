"""Success rates: exact binomial bounds, and how many cases a reliability takes.

Bounds are those of Clopper & Pearson ("The use of confidence or fiducial limits illustrated in the case of the
binomial", Biometrika 26, 1934).
"""

from __future__ import annotations

from scipy import stats

_LARGEST_SAMPLE_SIZE = 2**40

#: A lower and an upper bound.
Interval = tuple[float, float]


def check_confidence(confidence: float) -> None:
    """Raises a ValueError where a confidence does not lie between 0 and 1."""
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"the confidence is {confidence}; it must lie between 0 and 1, both excluded")


def _check_counts(successes: float | int, n: float | int) -> None:
    if not 0 <= successes <= n:
        raise ValueError(f"{successes} successes of {n} cases; there can be none to all")


def proportion_lower(successes: float | int, n: float | int, confidence: float) -> float:
    """The one-sided lower Clopper-Pearson bound of a success rate.

    Parameters
    ----------
    successes, n
        Successes and cases; need not be whole (an effective sample size is not).
    confidence
        Probability, at least, that the bound lies below the true rate.

    Raises
    ------
    ValueError
        Where the counts or the confidence are out of range.

    Notes
    -----
    Clopper & Pearson 1934, by the quantile of the beta distribution. With no cases the bound is 0.
    """
    check_confidence(confidence)
    _check_counts(successes, n)
    if successes <= 0:
        return 0.0
    return float(stats.beta.ppf(1.0 - confidence, successes, n - successes + 1.0))


def proportion_upper(successes: float | int, n: float | int, confidence: float) -> float:
    """The one-sided upper Clopper-Pearson bound of a success rate; see `proportion_lower`. With no cases it is 1."""
    check_confidence(confidence)
    _check_counts(successes, n)
    return 1.0 - proportion_lower(n - successes, n, confidence)


def proportion_interval(successes: float | int, n: float | int, confidence: float) -> Interval:
    """The two-sided Clopper-Pearson interval with equal tails; see `proportion_lower`."""
    check_confidence(confidence)
    one_sided = 0.5 * (1.0 + confidence)
    return proportion_lower(successes, n, one_sided), proportion_upper(successes, n, one_sided)


def minimum_sample_size(reliability: float, confidence: float, failures: int = 0) -> int:
    """The fewest cases that show a reliability at a confidence although so many of them failed.

    Notes
    -----
    The smallest n whose one-sided lower Clopper-Pearson bound with `failures` failures reaches `reliability`: for no
    failures the textbook ln(1 - confidence) / ln(reliability), rounded up.

    Raises
    ------
    ValueError
        Where the reliability or the confidence does not lie strictly between 0 and 1, or the failures are negative.
    """
    check_confidence(confidence)
    if not 0.0 < reliability < 1.0:
        raise ValueError(f"the reliability is {reliability}; it must lie between 0 and 1, both excluded")
    if failures < 0:
        raise ValueError(f"{failures} failures; there cannot be fewer than none")
    enough = failures + 1
    while proportion_lower(enough - failures, enough, confidence) < reliability:
        enough *= 2
        if enough > _LARGEST_SAMPLE_SIZE:
            raise ValueError(f"no sample of practical size shows a reliability of {reliability}")
    too_few = failures
    while enough - too_few > 1:
        middle = (enough + too_few) // 2
        shown = proportion_lower(middle - failures, middle, confidence) >= reliability
        enough, too_few = (middle, too_few) if shown else (enough, middle)
    return enough


def further_cases_needed(n: int, failures: int, reliability: float, confidence: float) -> int:
    """How many more cases show the reliability at the confidence if none of them fails; 0 when it is shown."""
    return max(0, minimum_sample_size(reliability, confidence, failures) - n)


def consumer_risk(successes: float | int, n: float | int, rate: float) -> float:
    """The chance of evidence at least as good from a true rate that is only just the one asked.

    Notes
    -----
    The risk of the one who accepts it (Hanson & Beard, NASA/TP-2010-216447): it is at most 1 - confidence exactly where
    the one-sided lower Clopper-Pearson bound at that confidence reaches the rate. With no successes it is 1.
    """
    _check_counts(successes, n)
    return 1.0 if successes <= 0 else float(stats.beta.cdf(rate, successes, n - successes + 1.0))
