"""Checks of statistics: coverage of intervals, error rates of sequential stopping, false alarms of nightly runs.

The coverage of an interval is the fraction of simulated samples whose interval contains the true value.
"""

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
from benchmarks.validation.records import Check, Measure, min_coverage
from marsyard.reports.night_history import MAX_EARLIER_NIGHTS
from marsyard.reports.statistics.clustered_cases import ClusteredCases
from marsyard.reports.statistics.clusters import Sizes, event_scores, max_statistic, number_terrains
from marsyard.reports.statistics.error_summary import error_ellipse
from marsyard.reports.statistics.proportions import Interval, proportion_lower, proportion_upper
from marsyard.reports.statistics.samples import mean_interval, quantile_bounds, standard_deviation_interval
from marsyard.reports.statistics.sequential import confidence_at, planned_looks
from marsyard.reports.validation_rows import Conditions

#: One-sided confidence of the checked bounds.
CONFIDENCE = 0.9
#: Cases per terrain.
_CASES_PER_TERRAIN = 8


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
                f"95 % interval of the {statistic}, {name}", coverage, "", min_coverage(0.95, trials), how, "at least"
            )
    truth = float(stats.norm.ppf(0.95))
    bounds = [quantile_bounds(rng.normal(size=80), 0.95, CONFIDENCE) for _ in range(20 * trials)]
    bound_coverage = min(np.mean([low <= truth for low, _ in bounds]), np.mean([high >= truth for _, high in bounds]))
    how = f"{20 * trials} samples of 80; the worse of the lower and the upper bound"
    yield Measure(
        "90 % bounds of a 95 % quantile", float(bound_coverage), "", min_coverage(0.9, 20 * trials), how, "at least"
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
        min_coverage(0.95, 4 * trials),
        how,
        "at least",
    )


#: Designs of cases that share terrains: (cases on a terrain, number of terrains).
_DESIGNS: dict[str, Sizes] = {
    "8 terrains of 3 cases": ((3, 8),),
    "250 terrains of 4 cases": ((4, 250),),
    "60 terrains of 8 cases": ((8, 60),),
    "138 terrains of 1 to 16 cases": ((1, 60), (2, 40), (5, 30), (16, 8)),
}
_CORRELATIONS = (0.0, 0.05, 0.3, 1.0)


def _draw_events(rng: np.random.Generator, sizes: Sizes, rate: float, correlation: float, trials: int) -> np.ndarray:
    """Draw the number of events on each terrain, for each trial; the rates of terrains have a beta distribution.

    The beta distribution has the parameters rate * weight and (1 - rate) * weight. The correlation of two cases on one
    terrain is then 1 / (weight + 1).
    """
    cases = np.repeat([size for size, _ in sizes], [terrains for _, terrains in sizes])
    shape = trials, cases.size
    if correlation == 0.0:
        return rng.binomial(cases, rate, shape)
    if correlation == 1.0:
        return np.where(rng.random(shape) < rate, cases, 0)
    weight = (1.0 - correlation) / correlation
    return rng.binomial(cases, rng.beta(rate * weight, (1.0 - rate) * weight, shape))


def _statistics(events: np.ndarray, sizes: Sizes) -> np.ndarray:
    """Compute the statistic of the events of each trial."""
    return np.asarray(event_scores(sizes)[events].sum(axis=1))


def run_correlated_rates(quick: bool) -> Iterator[Measure]:
    """Measure the coverage of the bounds of a failure rate of cases that share terrains."""
    trials = 2000 if quick else 20_000
    rng = np.random.default_rng(2)
    for design, sizes in _DESIGNS.items():
        cases = np.repeat([size for size, _ in sizes], [terrains for _, terrains in sizes])
        for rate in (0.01, 0.05, 0.2):
            limits = max_statistic(sizes, rate, 1.0 - CONFIDENCE), max_statistic(sizes, 1.0 - rate, 1.0 - CONFIDENCE)
            for correlation in _CORRELATIONS:
                events = _draw_events(rng, sizes, rate, correlation, trials)
                too_low = float(np.mean(_statistics(events, sizes) <= limits[0]))
                too_high = float(np.mean(_statistics(cases - events, sizes) <= limits[1]))
                claim = f"90 % bounds, failure rate {rate}, correlation {correlation:g}, {design}"
                how = f"{trials} campaigns; the worse of both bounds"
                limit = min_coverage(CONFIDENCE, trials)
                yield Measure(claim, 1.0 - max(too_low, too_high), "", limit, how, "at least")


def run_power(quick: bool) -> Iterator[Measure]:
    """Report the probability of PASS if the true failure rate is half of the permitted rate, and a tenth of it."""
    trials = 2000 if quick else 20_000
    rng = np.random.default_rng(7)
    designs = {f"{250 * cases} cases on 250 terrains": ((cases, 250),) for cases in (1, 4, 16)}
    designs |= {f"{cases} cases on as many terrains": ((1, cases),) for cases in (1000, 4000)}
    for name, sizes in designs.items():
        limit = max_statistic(sizes, 0.01, 1.0 - CONFIDENCE)
        for rate, text in ((0.005, "half"), (0.001, "a tenth")):
            for correlation in (0.0, 0.3):
                passed = _statistics(_draw_events(rng, sizes, rate, correlation, trials), sizes) <= limit
                claim = f"probability of PASS of 99 % at 90 %, {text} of the permitted failures, "
                claim += f"correlation {correlation:g}, {name}"
                yield Measure(claim, float(passed.mean()), "", None, f"{trials} campaigns", "at least")


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
                yield Measure(claim, coverage, "", min_coverage(nominal, trials), how, "at least")


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
            limit = 1.0 - min_coverage(CONFIDENCE, trials)
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
        sizes = ((_CASES_PER_TERRAIN, -(-max_cases // _CASES_PER_TERRAIN)),)
        failures = _draw_events(rng, sizes, 1.0 - required, correlation, 1)[0]
        success = (np.arange(_CASES_PER_TERRAIN) >= failures[:, None]).ravel()
        order = rng.permutation(success.size)
        terrain = np.repeat(np.arange(failures.size), _CASES_PER_TERRAIN)[order][:max_cases]
        success = success[order][:max_cases]
    for look in planned_looks(max_cases):
        confidence, first_successes = confidence_at(CONFIDENCE, look.risk_fraction), success[: look.cases]
        if correlation is None:
            counts = int(first_successes.sum()), look.cases, confidence
            lower, upper = proportion_lower(*counts), proportion_upper(*counts)
        else:
            cases = ClusteredCases.of(first_successes, number_terrains(terrain[: look.cases]))
            lower = 1.0 - cases.max_failure_rate(1.0 - confidence)
            upper = 1.0 - cases.min_failure_rate(1.0 - confidence)
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
    Check("power", "Statistics", run_power),
    Check("shared", "Statistics", run_correlated_errors),
    Check("sequential", "Statistics", run_sequential),
    # the comparison of nights decides no verdict
    Check("nights", "Statistics", run_nights, conditions=(Conditions(systems=()),)),
)
