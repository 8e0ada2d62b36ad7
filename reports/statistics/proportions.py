"""Success rates of independent cases: exact binomial bounds, consumer risk, and numbers of cases that they need.

`marsyard.reports.statistics.clustered_cases` computes bounds for cases that share terrains.

The bounds are those of Clopper & Pearson, "The use of confidence or fiducial limits illustrated in the case of the
binomial", Biometrika 26, 1934.
"""

import bisect

from scipy import stats

#: Maximum number of cases of `minimum_sample_size`.
_MAX_SAMPLE_SIZE = 2**40
#: A lower and an upper bound.
Interval = tuple[float, float]


def check_confidence(confidence: float) -> None:
    """Raise ValueError if a confidence does not lie between 0 and 1."""
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"the confidence is {confidence}; it must lie between 0 and 1, both excluded")


def _check_counts(successes: float | int, n: float | int) -> None:
    if not 0 <= successes <= n:
        raise ValueError(f"{successes} successes of {n} cases; allowed: 0 to {n}")


def proportion_lower(successes: float | int, n: float | int, confidence: float) -> float:
    """One-sided lower Clopper-Pearson bound of a success rate, by the beta quantile; 0 for no cases.

    The numbers can be fractional (effective sample sizes). Raises ValueError if they or the confidence are
    out of range.
    """
    check_confidence(confidence)
    _check_counts(successes, n)
    return 0.0 if successes <= 0 else float(stats.beta.ppf(1.0 - confidence, successes, n - successes + 1.0))


def proportion_upper(successes: float | int, n: float | int, confidence: float) -> float:
    """One-sided upper Clopper-Pearson bound of a success rate; see `proportion_lower`. 1 for no cases."""
    check_confidence(confidence)
    _check_counts(successes, n)
    return 1.0 - proportion_lower(n - successes, n, confidence)


def proportion_interval(successes: float | int, n: float | int, confidence: float) -> Interval:
    """Two-sided Clopper-Pearson interval with equal tails; see `proportion_lower`."""
    check_confidence(confidence)
    one_sided = 0.5 * (1.0 + confidence)
    return proportion_lower(successes, n, one_sided), proportion_upper(successes, n, one_sided)


def minimum_sample_size(reliability: float, confidence: float, failures: int = 0) -> int:
    """Minimum number of cases that demonstrates a reliability at a confidence with a given number of failures.

    The one-sided lower Clopper-Pearson bound reaches the reliability: without failures at the textbook
    ln(1 - confidence) / ln(reliability), rounded up. Raises ValueError if reliability or confidence do not lie
    strictly between 0 and 1, or if the failures are negative.
    """
    check_confidence(confidence)
    if not 0.0 < reliability < 1.0:
        raise ValueError(f"the reliability is {reliability}; it must lie between 0 and 1, both excluded")
    if failures < 0:
        raise ValueError(f"{failures} failures; the number must not be negative")

    def is_sufficient(cases: int) -> bool:
        return proportion_lower(cases - failures, cases, confidence) >= reliability

    upper = failures + 1
    while not is_sufficient(upper):
        upper *= 2
        if upper > _MAX_SAMPLE_SIZE:
            raise ValueError(f"no sample of practical size demonstrates a reliability of {reliability}")
    cases = range(failures + 1, upper)
    return cases.start + bisect.bisect_left(cases, True, key=is_sufficient)


def additional_cases_needed(n: int, failures: int, reliability: float, confidence: float) -> int:
    """Return the number of additional cases without failure that demonstrate the reliability; 0 if already shown."""
    return max(0, minimum_sample_size(reliability, confidence, failures) - n)


def consumer_risk(successes: float | int, n: float | int, rate: float) -> float:
    """Compute the probability of as many successes or more if the true rate equals `rate`; 1 for no successes.

    The risk is at most 1 - confidence if and only if the one-sided lower Clopper-Pearson bound at that confidence is at
    least `rate` (Hanson & Beard, NASA/TP-2010-216447).
    """
    _check_counts(successes, n)
    return 1.0 if successes <= 0 else float(stats.beta.cdf(rate, successes, n - successes + 1.0))
