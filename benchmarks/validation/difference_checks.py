"""Checks of intervals of skewed quantities: contributions to an error budget, and differences of two algorithms."""

import math
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float64

from benchmarks.validation.records import Check, Measure
from marsyard.campaigns.studies.contributions import compute_budget
from marsyard.reports.statistics.paired_tests import compare_errors
from marsyard.sim.error_sources import ErrorSource

#: Two-sided confidence of the checked intervals, and largest permitted shortfall of the coverage for skewed values.
CONFIDENCE, _SHORTFALL = 0.9, 0.05
#: Standard deviations of two sources of error; that of the remaining error is 1.
_DEVIATIONS = {"a": 3.0, "b": 2.0}
_SOURCES = tuple(ErrorSource(name, name) for name in _DEVIATIONS)
#: Factor of the product of both errors, if they interact.
_INTERACTION = 0.5
#: Degrees of freedom of Student's t for errors with heavy tails.
_FREEDOM = 5.0

Errors = Float64[np.ndarray, "3 n"]
Draw = Callable[[np.random.Generator, int], Errors]


def _draw_normal(rng: np.random.Generator, cases: int) -> Errors:
    return rng.standard_normal((3, cases))


def _draw_heavy_tails(rng: np.random.Generator, cases: int) -> Errors:
    return rng.standard_t(_FREEDOM, (3, cases)) * math.sqrt((_FREEDOM - 2.0) / _FREEDOM)


def _is_covered(rng: np.random.Generator, draw: Draw, interaction: float, cases: int) -> np.ndarray:
    """Whether the intervals of both contributions and of the total contain the true value, for one sample."""
    floor, a, b = draw(rng, cases) * np.array([1.0, *_DEVIATIONS.values()])[:, None]
    # all sources, none, without a, without b, only a, only b
    errors = np.array([floor + a + b + interaction * a * b, floor, floor + b, floor + a, floor + a, floor + b])
    budget = compute_budget(errors, np.arange(cases), _SOURCES, is_centred=False, confidence=CONFIDENCE)
    assert budget is not None
    squares = {name: deviation**2 for name, deviation in _DEVIATIONS.items()}
    product = interaction**2 * math.prod(squares.values())
    bounds = {item.source: (item.lower, item.upper) for item in budget.contributions}
    covered = [low <= squares[name] + 0.5 * product <= high for name, (low, high) in bounds.items()]
    return np.array([*covered, budget.total_lower <= 1.0 + sum(squares.values()) + product <= budget.total_upper])


def run_budgets(quick: bool) -> Iterator[Measure]:
    """Measure the coverage of the intervals of error budgets."""
    trials = 50 if quick else 300
    rng = np.random.default_rng(11)
    kinds: tuple[tuple[str, Draw, float], ...] = (
        ("normal errors", _draw_normal, 0.0),
        ("normal errors that interact", _draw_normal, _INTERACTION),
        (f"errors with heavy tails (Student's t, {_FREEDOM:g})", _draw_heavy_tails, 0.0),
    )
    for name, draw, interaction in kinds:
        for cases in (50, 100):
            covered = np.mean([_is_covered(rng, draw, interaction, cases) for _ in range(trials)])
            claim = f"90 % interval of a contribution to an error budget, {name}, {cases} cases"
            how = f"{trials} budgets of two sources; contributions and total"
            yield Measure(claim, float(covered), "", CONFIDENCE - _SHORTFALL, how, "at least")


def run_differences(quick: bool) -> Iterator[Measure]:
    """Measure the coverage of the interval of a mean difference, and the agreement of interval and p-value."""
    trials = 100 if quick else 1000
    rng = np.random.default_rng(12)
    for text, groups in (("", None), (" on 50 terrains", np.repeat(np.arange(50), 2))):
        results = np.array([compare_errors(rng.exponential(size=100) - 1.0, groups, CONFIDENCE) for _ in range(trials)])
        _, lower, upper, p_value = results.T
        claim, how = f"100 skewed (exponential) paired differences{text}", f"{trials} samples with a true mean of 0"
        covered = float(np.mean((lower <= 0.0) & (upper >= 0.0)))
        yield Measure(f"90 % interval of the mean, {claim}", covered, "", CONFIDENCE - _SHORTFALL, how, "at least")
        disagreement = float(np.mean(((lower > 0.0) | (upper < 0.0)) != (p_value <= 1.0 - CONFIDENCE + 1e-9)))
        yield Measure(f"90 % interval and p-value disagree, {claim}", disagreement, "", 0.0, how)


CHECKS = (Check("budgets", "Statistics", run_budgets), Check("differences", "Statistics", run_differences))
