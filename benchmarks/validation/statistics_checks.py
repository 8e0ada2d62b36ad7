"""Checks of statistics: coverage of intervals, error rates of sequential stopping, false alarms of nightly runs.

The coverage of an interval is the fraction of simulated samples whose interval contains the true value.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from scipy import stats

from benchmarks.validation.nights import (
    CASES,
    EARLIER_NIGHTS,
    ERROR_FACTOR,
    KINDS,
    count_detections,
    count_false_alarms,
)
from benchmarks.validation.records import Check, Measure
from marsyard.reports.history import MAX_EARLIER_NIGHTS
from marsyard.reports.statistics.proportions import (
    Interval,
    clustered_evidence,
    confidence_at,
    planned_looks,
    proportion_lower,
    proportion_upper,
)
from marsyard.reports.statistics.samples import (
    error_ellipse,
    mean_interval,
    quantile_bounds,
    standard_deviation_interval,
)

#: One-sided confidence of the checked bounds.
CONFIDENCE = 0.9
#: Cases per terrain.
_CASES_PER_TERRAIN = 8


def _min_coverage(nominal: float, trials: int) -> float:
    """Minimum of a simulated coverage: nominal coverage minus three standard deviations of the simulation."""
    return nominal - 3.0 * math.sqrt(nominal * (1.0 - nominal) / trials)


def _fraction(successes: Iterator[bool], trials: int) -> float:
    """Return the fraction of successful trials."""
    return sum(bool(success) for success in successes) / trials


def run_intervals(quick: bool) -> Iterator[Measure]:
    """Measure the coverage of intervals of independent values."""
    trials = 200 if quick else 1000
    rng = np.random.default_rng(1)
    draws: tuple[tuple[str, Callable[[int], np.ndarray], float, float], ...] = (
        ("normal errors", lambda size: rng.normal(size=size), 0.0, 1.0),
        ("radial errors", lambda size: rng.rayleigh(size=size), math.sqrt(math.pi / 2), math.sqrt(2.0 - math.pi / 2)),
    )
    intervals: tuple[tuple[str, Callable[[np.ndarray, float], Interval]], ...] = (
        ("mean", mean_interval),
        ("standard deviation", standard_deviation_interval),
    )
    for name, draw, mean, deviation in draws:
        for statistic, interval in intervals:
            truth = mean if statistic == "mean" else deviation
            interval_pairs = (interval(draw(30), 0.95) for _ in range(trials))
            coverage = _fraction((low <= truth <= high for low, high in interval_pairs), trials)
            how = f"{trials} samples of 30; BCa, widened; limit: nominal minus three deviations of the simulation"
            yield Measure(
                f"95 % interval of the {statistic}, {name}", coverage, "", _min_coverage(0.95, trials), how, "at least"
            )
    truth = float(stats.norm.ppf(0.95))
    bounds = [quantile_bounds(rng.normal(size=80), 0.95, CONFIDENCE) for _ in range(20 * trials)]
    bound_coverage = min(np.mean([low <= truth for low, _ in bounds]), np.mean([high >= truth for _, high in bounds]))
    how = f"{20 * trials} samples of 80; the worse of the lower and the upper bound"
    yield Measure(
        "90 % bounds of a 95 % quantile", float(bound_coverage), "", _min_coverage(0.9, 20 * trials), how, "at least"
    )
    inside_count = 0
    for _ in range(4 * trials):
        # 21 correlated normal errors (x, y) of arbitrary scale: 20 define the ellipse, the last one is tested
        points = rng.normal(size=(21, 2)) @ np.array([[2.0, 0.0], [0.9, 0.4]])
        ellipse = error_ellipse(points[:20], 0.95)
        assert ellipse is not None
        angle = math.radians(ellipse.angle_deg)
        x, y = points[20] - ellipse.centre
        major, minor = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
        inside_count += (major / ellipse.semi_major) ** 2 + (minor / ellipse.semi_minor) ** 2 <= 1.0
    how = f"{4 * trials} samples of 20 errors, each with one further error"
    yield Measure(
        "95 % ellipse contains the next error",
        inside_count / (4 * trials),
        "",
        _min_coverage(0.95, 4 * trials),
        how,
        "at least",
    )


def _draw_successes(
    rng: np.random.Generator, rate: float, correlation: float, terrains: int
) -> tuple[np.ndarray, np.ndarray]:
    """Draw successes on terrains with beta-distributed rates; return the successes and their terrains.

    The beta distribution has the parameters rate * weight and (1 - rate) * weight. The correlation of two cases on one
    terrain is then 1 / (weight + 1).
    """
    weight = (1.0 - correlation) / correlation
    rates = rng.beta(rate * weight, (1.0 - rate) * weight, terrains)
    terrain = np.repeat(np.arange(terrains), _CASES_PER_TERRAIN)
    return rng.random(terrain.size) < rates[terrain], terrain


def run_correlated_rates(quick: bool) -> Iterator[Measure]:
    """Measure the coverage of the bounds of a success rate of cases that share terrains."""
    trials = 400 if quick else 3000
    rng = np.random.default_rng(2)
    for rate in (0.99, 0.95, 0.8):
        for correlation in (0.05, 0.3, 0.9):
            for terrains in (20, 60, 250):
                evidence = [
                    clustered_evidence(*_draw_successes(rng, rate, correlation, terrains), CONFIDENCE)
                    for _ in range(trials)
                ]
                lower = float(np.mean([bounds.lower <= rate for bounds in evidence]))
                upper = float(np.mean([bounds.upper >= rate for bounds in evidence]))
                claim = f"90 % bounds, rate {rate}, correlation {correlation}, {terrains} terrains"
                how = f"{trials} campaigns, {_CASES_PER_TERRAIN} cases per terrain; the worse of both bounds"
                yield Measure(claim, min(lower, upper), "", _min_coverage(CONFIDENCE, trials), how, "at least")


def run_correlated_errors(quick: bool) -> Iterator[Measure]:
    """Measure the coverage of intervals of errors that share terrains: mean, standard deviation, quantile."""
    trials = 100 if quick else 600
    rng = np.random.default_rng(6)
    truths = {"mean": 0.0, "standard deviation": 1.0, "95 % quantile": float(stats.norm.ppf(0.95))}
    for correlation in (0.05, 0.3, 0.9):
        for terrains in (12, 60, 250):
            trial_coverage = [_check_coverage(*_draw_errors(rng, correlation, terrains), truths) for _ in range(trials)]
            for statistic, nominal in (("mean", 0.95), ("standard deviation", 0.95), ("95 % quantile", CONFIDENCE)):
                coverage = float(np.min(np.mean([covers[statistic] for covers in trial_coverage], axis=0)))
                interval = "bounds" if statistic.endswith("quantile") else "interval"
                claim = f"{100 * nominal:.0f} % {interval} of the {statistic}, "
                claim += f"correlation {correlation}, {terrains} terrains"
                how = f"{trials} campaigns, 1 to 14 normal errors per terrain"
                yield Measure(claim, coverage, "", _min_coverage(nominal, trials), how, "at least")


def _draw_errors(rng: np.random.Generator, correlation: float, terrains: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw standard normal errors that are correlated within a terrain, and their terrains."""
    terrain = np.repeat(np.arange(terrains), rng.integers(1, 15, terrains))
    common_errors, independent_errors = rng.normal(size=terrains)[terrain], rng.normal(size=terrain.size)
    return math.sqrt(correlation) * common_errors + math.sqrt(1.0 - correlation) * independent_errors, terrain


def _check_coverage(errors: np.ndarray, terrain: np.ndarray, truths: dict[str, float]) -> dict[str, tuple[bool, ...]]:
    """Return whether each interval contains the true value; the two bounds of the quantile are checked separately.

    - errors, terrain: error and terrain number of each case
    - truths: true value of each statistic
    """
    lower, upper = quantile_bounds(errors, 0.95, CONFIDENCE, terrain)
    contains_truth: dict[str, tuple[bool, ...]] = {
        "95 % quantile": (lower <= truths["95 % quantile"], upper >= truths["95 % quantile"])
    }
    for statistic, interval in (("mean", mean_interval), ("standard deviation", standard_deviation_interval)):
        low, high = interval(errors, 0.95, terrain)
        contains_truth[statistic] = (low <= truths[statistic] <= high,)
    return contains_truth


def run_sequential(quick: bool) -> Iterator[Measure]:
    """Measure error rates of sequential campaigns whose true rate is the required rate: every verdict is an error."""
    trials = 300 if quick else 2000
    rng = np.random.default_rng(3)
    for required, max_cases in ((0.9, 512), (0.99, 1000)):
        for correlation in (None, 0.2):
            wrong = np.mean([_simulate_decision(rng, required, max_cases, correlation) for _ in range(trials)], axis=0)
            kind = "independent cases" if correlation is None else f"cases on terrains, correlation {correlation}"
            how = (
                f"{trials} campaigns of up to {max_cases} cases at a true rate of {required}; Monte Carlo error allowed"
            )
            limit = 1.0 - _min_coverage(CONFIDENCE, trials)
            for verdict, fraction in zip(("PASS", "FAIL"), wrong.tolist(), strict=True):
                yield Measure(f"false {verdict} of {required} at 90 %, {kind}", fraction, "", limit, how)


def _simulate_decision(
    rng: np.random.Generator, required: float, max_cases: int, correlation: float | None
) -> tuple[bool, bool]:
    """Simulate a campaign with planned interim evaluations (looks); return whether its verdict is PASS, and FAIL.

    correlation: correlation of two cases on one terrain; None for independent cases
    """
    if correlation is None:
        success, terrain = rng.random(max_cases) < required, np.arange(max_cases)
    else:
        success, terrain = _draw_successes(rng, required, correlation, -(-max_cases // _CASES_PER_TERRAIN))
        order = rng.permutation(success.size)
        success, terrain = success[order][:max_cases], terrain[order][:max_cases]
    for look in planned_looks(max_cases):
        confidence, first_successes = confidence_at(CONFIDENCE, look.risk_fraction), success[: look.cases]
        if correlation is None:
            counts = int(first_successes.sum()), look.cases, confidence
            lower, upper = proportion_lower(*counts), proportion_upper(*counts)
        else:
            evidence = clustered_evidence(first_successes, terrain[: look.cases], confidence)
            lower, upper = evidence.lower, evidence.upper
        if lower >= required or upper < required:
            return lower >= required, upper < required
    return False, False


def run_nights(quick: bool) -> Iterator[Measure]:
    """Measure false alarms of nightly runs without a change, and detection of simulated regressions."""
    nights_without_change, nights_with_change = (100, 100) if quick else (2000, 1000)
    alarms = count_false_alarms(nights_without_change, seed=4)
    campaigns = f"three campaigns of {CASES} cases: {', '.join(KINDS)}"
    comparison = f"each compared with up to {MAX_EARLIER_NIGHTS} earlier nights"
    how = f"{alarms} of {nights_without_change} successive nights, {comparison}; {campaigns}"
    yield Measure("nights with a false alarm", alarms / nights_without_change, "", 0.01, how)
    if not quick:
        upper_bound = proportion_upper(alarms, nights_without_change, 0.95)
        yield Measure(
            "nights with a false alarm, upper bound at 95 % confidence", upper_bound, "", 0.01, "the same nights"
        )
    for kind, nights in ((KINDS[0], nights_with_change), (KINDS[1], nights_with_change // 4)):
        detection_rate = count_detections(kind, nights, seed=5) / nights
        claim = f"nights that detect a regression, errors {ERROR_FACTOR:g} times as large, {kind}"
        how = f"{nights} nights, each compared with {EARLIER_NIGHTS} earlier nights; {campaigns}"
        yield Measure(claim, detection_rate, "", 0.95, how, "at least")


CHECKS = (
    Check("intervals", "Statistics", run_intervals),
    Check("clustered", "Statistics", run_correlated_rates),
    Check("shared", "Statistics", run_correlated_errors),
    Check("sequential", "Statistics", run_sequential),
    Check("nights", "Statistics", run_nights),
)
