"""Checks of robust verdicts: limit states whose change to FAIL is known.

A case fails in a region of standard normal variables z; a change shifts or scales the first one. The changed rate is
known, and so is the change after which it equals the permitted rate.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy import integrate, optimize
from scipy.special import ndtr, ndtri
from scipy.stats import norm, poisson, truncnorm

from benchmarks.validation.records import Check, Measure, min_coverage
from marsyard.reports.case_evidence import CaseEvidence
from marsyard.reports.dispersion_changes import Change, ChangeKind, list_changes
from marsyard.reports.robustness_evaluation import change_rates
from marsyard.reports.statistics.clustered_cases import ClusteredCases
from marsyard.reports.statistics.reweighted_rates import MIN_EFFECTIVE, Crossing, find_crossing, weighted_rates
from marsyard.reports.verdicts import Verdict

_CONFIDENCE = 0.9
#: Variables of a case: the one that changes, and another.
_VARIABLES = 2


def _all_cases(z: np.ndarray) -> np.ndarray:
    return np.ones(len(z), dtype=np.bool_)


@dataclass(frozen=True)
class _State:
    """A limit state: kind of change, permitted rate, region of failures, and rate after a change of a size."""

    name: str
    kind: ChangeKind
    permitted: float
    fails: Callable[[np.ndarray], np.ndarray]
    rate: Callable[[float], float]
    belongs: Callable[[np.ndarray], np.ndarray] = _all_cases

    @property
    def exact(self) -> float:
        """The change at which the rate reaches the permitted one."""
        return float(optimize.brentq(lambda size: self.rate(size) - self.permitted, 0.0, 0.99))

    def find(self, z: np.ndarray) -> Crossing:
        """Find the change from cases."""
        change = next(item for item in list_changes(None, z[:, 0]) if item.kind is self.kind)
        member, fails = self.belongs(z), self.fails(z)
        confidences = _CONFIDENCE, _CONFIDENCE
        rates = weighted_rates(
            change.weights[:, member], fails[member], None, confidences, efficiency=change.efficiency
        )
        return find_crossing(change.sizes, rates, self.permitted)


def _conditional_rate(shift: float) -> float:
    """Rate of z0 + exp(z0 / 2) z1 > 4.4: the second variable is drawn with a deviation that depends on the first."""
    return float(
        integrate.quad(lambda x: norm.sf((4.4 - x) * math.exp(-0.5 * x)) * norm.pdf(x - shift), -10.0, 12.0)[0]
    )


_LIMIT, _COUNT, _TRUNCATED = norm.isf(0.02), ndtri(poisson.cdf(4, 2.0)), ndtri(truncnorm.cdf(1.42, -1.0, 1.5))
_CORE, _SPREAD = norm.ppf(0.51), math.hypot(1.8, 0.6)
_STATES = (
    _State(
        "mean of a normal load", ChangeKind.MEAN_UP, 0.05, lambda z: z[:, 0] > _LIMIT, lambda d: norm.sf(_LIMIT - d)
    ),
    _State(
        "standard deviation of a normal load, wider", ChangeKind.WIDER, 0.05,
        lambda z: np.abs(z[:, 0]) > 2.4, lambda d: 2.0 * norm.sf(2.4 / (1.0 + d)),
    ),
    _State(
        "standard deviation of a normal load, narrower", ChangeKind.NARROWER, 0.05,
        lambda z: np.abs(z[:, 0]) < _CORE, lambda d: 2.0 * ndtr(_CORE / (1.0 - d)) - 1.0,
    ),
    _State(
        "mean of a log-normal load (heavy tail)", ChangeKind.MEAN_UP, 0.05,
        lambda z: np.exp(z[:, 0] + 0.5 * z[:, 1]) > 10.0, lambda d: norm.sf((math.log(10.0) - d) / math.sqrt(1.25)),
    ),
    _State(
        "mean of a Poisson number (discrete)", ChangeKind.MEAN_UP, 0.05,
        lambda z: (poisson.ppf(ndtr(z[:, 0]), 2.0) >= 5) & (z[:, 1] > 0.0), lambda d: 0.5 * norm.sf(_COUNT - d),
    ),
    _State(
        "mean of a truncated normal load", ChangeKind.MEAN_UP, 0.05,
        lambda z: truncnorm.ppf(ndtr(z[:, 0]), -1.0, 1.5) > 1.42, lambda d: norm.sf(_TRUNCATED - d),
    ),
    _State(
        "mean of one of two loads with the correlation 0.8", ChangeKind.MEAN_UP, 0.05,
        lambda z: 1.8 * z[:, 0] + 0.6 * z[:, 1] > _LIMIT * _SPREAD, lambda d: norm.sf(_LIMIT - 1.8 * d / _SPREAD),
    ),
    _State(
        "mean on which another dispersion depends", ChangeKind.MEAN_UP, 0.05,
        lambda z: z[:, 0] + np.exp(0.5 * z[:, 0]) * z[:, 1] > 4.4, _conditional_rate,
    ),
    _State(
        "mean of a load, population of 31 %", ChangeKind.MEAN_UP, 0.1,
        lambda z: z[:, 0] > 2.2, lambda d: norm.sf(2.2 - d) / norm.sf(0.5 - d), lambda z: z[:, 0] > 0.5,
    ),
)  # fmt: skip


def run_changes(quick: bool) -> Iterator[Measure]:
    """Measure errors and coverage of changes to FAIL, coverage with shared terrains, and the refusal."""
    rng = np.random.default_rng(58)
    cases, trials = (40_000, 100) if quick else (150_000, 400)
    found: list[tuple[Crossing, int]] = []
    for state in _STATES:
        # a sample of 40,000 cases has a standard deviation of up to 5 %, so that a quick check averages four
        changes = [state.find(rng.standard_normal((cases, _VARIABLES))).change for _ in range(150_000 // cases + 1)]
        error = abs(float(np.mean(changes)) / state.exact - 1.0)
        yield Measure(
            f"change to FAIL, {state.name}: relative error", error, "", 0.1, f"{len(changes)} x {cases:,} cases"
        )
    for size in (300, 1000):
        for state in _STATES:
            samples = [state.find(rng.standard_normal((size, _VARIABLES))) for _ in range(trials)]
            found += [(item, size) for item in samples]
            # a missing end claims nothing
            lost = float(np.mean([not item.lower > state.exact for item in samples]))
            shown = float(np.mean([not item.upper < state.exact for item in samples]))
            claim = f"90 % interval of the change to FAIL, {state.name}, {size} cases"
            how = f"{trials} campaigns; the worse of both ends"
            yield Measure(claim, min(lost, shown), "", min_coverage(_CONFIDENCE, trials), how, "at least")
    fewest = min(item.effective_cases for item, _ in found if item.lower > 0.0 or not math.isnan(item.change))
    yield Measure(
        "fewest effective cases of a stated change",
        fewest,
        "1",
        MIN_EFFECTIVE * (1.0 - 1e-9),
        "the same campaigns",
        "at least",
    )
    yield from _run_terrains(rng, trials)


def _run_terrains(rng: np.random.Generator, trials: int) -> Iterator[Measure]:
    """Measure the coverage of PASS under a shift, for failures that are correlated within terrains."""
    terrains, cases, shift, permitted = 200, 3, 0.4, 0.05
    groups = np.repeat(np.arange(terrains), cases)
    sizes = np.array([0.0, shift])
    for correlation in (0.0, 0.5, 0.9):
        # the load is a part of the terrain and one of the case, whose mean is shifted
        common, own = math.sqrt(correlation), math.sqrt(1.0 - correlation)
        is_covered = []
        for _ in range(trials):
            z, terrain = rng.standard_normal(groups.size), rng.standard_normal(terrains)
            success = common * terrain[groups] + own * z <= norm.isf(permitted) + own * shift
            weights = np.exp(sizes[:, None] * z - 0.5 * sizes[:, None] ** 2)
            change = Change(ChangeKind.MEAN_UP, sizes, weights, np.exp(-(sizes**2)))
            rates = change_rates(_judge(success, groups, permitted), _evidence(success, groups), change)
            is_covered.append(float(rates.upper[1]) >= permitted)
        claim = (
            f"90 % bound of the failure rate after a shift of {shift}, terrains with a correlation of {correlation:g}"
        )
        how = f"{trials} campaigns of {terrains} terrains with {cases} cases"
        yield Measure(claim, float(np.mean(is_covered)), "", min_coverage(_CONFIDENCE, trials), how, "at least")


def _judge(success: np.ndarray, groups: np.ndarray, permitted: float) -> Verdict:
    bounds = ClusteredCases.of(success, groups)
    lower, upper = 1.0 - bounds.max_failure_rate(0.1), 1.0 - bounds.min_failure_rate(0.1)
    return Verdict(
        "LOAD", "", "", math.nan, 1.0 - permitted, _CONFIDENCE, "all", lower=lower, upper=upper,
        bounds_confidence=_CONFIDENCE, upper_confidence=_CONFIDENCE,
    )  # fmt: skip


def _evidence(success: np.ndarray, groups: np.ndarray) -> CaseEvidence:
    everywhere = np.ones(success.size, dtype=np.bool_)
    return CaseEvidence(success, everywhere, groups, everywhere)


CHECKS = (Check("robust", "Statistics", run_changes),)
