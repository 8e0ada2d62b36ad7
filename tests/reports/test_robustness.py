"""Tests of robust verdicts on limit states with known answers.

A case fails if g(z) < 0 for a standard normal variable z of a dispersion. The rate after a change is known, and so is
the change after which it equals the permitted rate.
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy import optimize
from scipy.stats import norm

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.dispersion_changes import ChangeKind, list_changes
from marsyard.reports.robustness import ALL_DISPERSIONS, ChangeOutcome, Robustness
from marsyard.reports.robustness_evaluation import evaluate_robustness
from marsyard.reports.robustness_wording import reach_text, robustness_text
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.statistics.reweighted_rates import (
    Crossing,
    WeightedRates,
    find_crossing,
    population_divergence,
    weighted_rates,
)
from marsyard.reports.stored import StoredRun
from marsyard.reports.verdicts import Status, Verdict
from marsyard.reports.wording import number

CAMPAIGN = """
name = "limit-state"
scenario = "tests.campaigns.studies.limit_state:LimitStateScenario"
cases = {cases}
seed = 3

[dispersions]
"loads.0" = {{ distribution = "normal", mean = 10.0, sd = 2.0 }}
"loads.1" = {{ distribution = "uniform", low = 20.0, high = 40.0 }}
kind = {{ distribution = "choice", values = ["plain", "rough"], weights = [9.0, 1.0] }}

[[requirements]]
id = "LOAD"
metric = "is_safe"
population = "{population}"
probability = {probability}
confidence = 0.9
"""

Fails = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def evaluate(
    folder: Path, cases: int, probability: float, fails: Fails, population: str = "all", **changes: Any
) -> tuple[list[Verdict], dict[tuple[str, ChangeKind], Robustness], tuple[Robustness, ...]]:
    """Evaluate cases of a limit state; `fails` are functions of both loads as standard normal numbers, and of kind."""
    path = folder / "campaign.toml"
    path.write_text(CAMPAIGN.format(cases=cases, probability=probability, population=population))
    campaign = load_campaign(str(path))
    rows = [{"case": case, "outcome": "VALID", "answered": True, **campaign.draws(case)} for case in range(cases)]
    frame = pd.DataFrame(rows)
    loads = (frame["loads.0"] - 10.0) / 2.0, norm.ppf((frame["loads.1"] - 20.0) / 20.0)
    frame["is_safe"] = ~fails(np.array(loads[0]), np.array(loads[1]), frame["kind"].to_numpy())
    frame = frame.assign(**changes)
    definition = campaign.definition.model_dump(mode="json")
    run = StoredRun(folder, frame, frame, {"definition": definition, "requirements": definition["requirements"]}, ())
    sampling = read_sampling_design(definition)
    verdicts = evaluate_requirements(frame, run.requirements, sampling)
    records = evaluate_robustness(run, verdicts, sampling)
    return verdicts, {(item.parameter + item.value, item.kind): item for item in records}, records


#: Limit states with 2 % of failures, which have 5 % after a known change: failures, and the change in assumed spreads.
TAIL, HALF, CORE = norm.isf(0.02), norm.isf(0.01), norm.ppf(0.51)
LIMIT_STATES: dict[ChangeKind, tuple[Callable[[np.ndarray], np.ndarray], float]] = {
    # the rate is 1 - Phi(TAIL - d) for a mean of d
    ChangeKind.MEAN_UP: (lambda z: z > TAIL, TAIL - norm.isf(0.05)),
    ChangeKind.MEAN_DOWN: (lambda z: z < -TAIL, TAIL - norm.isf(0.05)),
    # it is 2 - 2 Phi(HALF / s), or 2 Phi(CORE / s) - 1, for a standard deviation of s
    ChangeKind.WIDER: (lambda z: np.abs(z) > HALF, HALF / norm.isf(0.025) - 1.0),
    ChangeKind.NARROWER: (lambda z: np.abs(z) < CORE, 1.0 - CORE / norm.ppf(0.525)),
}


def find_crossings(z: np.ndarray) -> dict[ChangeKind, Crossing]:
    """Find the changes to FAIL, of more than 5 % of failures, of the limit states."""
    crossings = {}
    for change in list_changes(None, z):
        fails = LIMIT_STATES[change.kind][0](z)
        rates = weighted_rates(change.weights, fails, None, (0.9, 0.9), efficiency=change.efficiency)
        crossings[change.kind] = find_crossing(change.sizes, rates, 0.05)
    return crossings


def test_change_to_fail_is_within_10_percent() -> None:
    """The standard deviation of the estimates is 5 to 7 % for 20,000 cases, and 2 to 2.5 % for 150,000."""
    crossings = find_crossings(np.random.default_rng(58).standard_normal(150_000))
    for kind, (_, exact) in LIMIT_STATES.items():
        assert crossings[kind].change == pytest.approx(exact, rel=0.1), kind


@pytest.mark.parametrize("cases", [300, 1000])
def test_interval_covers_the_change_to_fail(cases: int) -> None:
    """The bounds of the interval hold with at least their confidence of 90 %, for each kind of change.

    The standard deviation of the fraction of 200 samples is 2.1 %. The median of the estimates of 1,000 cases is within
    10 %.
    """
    rng = np.random.default_rng(4)
    covered = {kind: np.zeros(2) for kind in LIMIT_STATES}
    errors: dict[ChangeKind, list[float]] = {kind: [] for kind in LIMIT_STATES}
    for _ in range(200):
        for kind, crossing in find_crossings(rng.standard_normal(cases)).items():
            exact = LIMIT_STATES[kind][1]
            # a missing bound (NaN) claims nothing
            covered[kind] += [not crossing.lower > exact, not crossing.upper < exact]
            errors[kind].append(crossing.change / exact - 1.0)
    for kind, counts in covered.items():
        assert (counts / 200 >= 0.9 - 2.5 * 0.021).all(), (kind, counts / 200)
        assert cases < 1000 or abs(np.nanmedian(errors[kind])) < 0.1, kind


def test_changes_have_the_units_of_the_parameters(tmp_path: Path) -> None:
    """The cases fail if z0 > 2 or z1 < -2.2 for a normal load 0 (10, 2) and a uniform load 1 (20 to 40)."""
    fails = lambda first, second, kind: (first > 2.0) | (second < -2.2)  # noqa: E731
    _, records, _ = evaluate(tmp_path, 3000, 0.9, fails)
    up, wider = records["loads.0", ChangeKind.MEAN_UP], records["loads.0", ChangeKind.WIDER]
    assert (up.assumed, up.spread, wider.assumed) == pytest.approx((10.0, 2.0, 2.0), abs=1e-6)
    assert up.fails_at == pytest.approx(10.0 + 2.0 * up.change)
    assert up.passes_at == pytest.approx(10.0 + 2.0 * up.lower)
    assert wider.passes_at == pytest.approx(2.0 * (1.0 + wider.lower))
    down = records["loads.1", ChangeKind.MEAN_DOWN]
    assert down.spread == pytest.approx(20.0 / math.sqrt(12.0), rel=1e-3)
    assert down.passes_at == pytest.approx(30.0 - down.spread * down.lower, rel=1e-3)
    assert up.outcome is down.outcome is ChangeOutcome.FOUND
    # the other direction does not lead to FAIL within the reach of the cases
    other = records["loads.0", ChangeKind.MEAN_DOWN]
    assert other.outcome is ChangeOutcome.REFUSED
    assert math.isnan(other.change)


def test_probability_of_a_value(tmp_path: Path) -> None:
    """A fifth of the rough cases fail, and no other: the rate is 5 % if 25 % are rough (10 % assumed)."""
    rng = np.random.default_rng(1)
    fails = lambda first, second, kind: (kind == "rough") & (rng.random(kind.size) < 0.2)  # noqa: E731
    _, records, _ = evaluate(tmp_path, 4000, 0.95, fails)
    rough, plain = records["kindrough", ChangeKind.MORE_FREQUENT], records["kindplain", ChangeKind.MORE_FREQUENT]
    assert rough.assumed == pytest.approx(0.1)
    # 80 failures: the standard deviation of their fraction is 0.02
    assert rough.fails_at == pytest.approx(0.25, rel=0.2)
    assert 0.1 < rough.passes_at < 0.25
    assert plain.outcome is ChangeOutcome.NONE


def test_unobserved_value_is_no_evidence() -> None:
    """No case of a value with a probability of 10 % is stored: PASS does not hold if the value is more frequent.

    The upper bound without a failure is 2.3 / 400 times the largest weight, 1 + 9 a divided by the mean weight 1 - a
    of the stored cases. It is 5 % for 1 + 9 a = 8.7 (1 - a), a = 0.435.
    """
    steps = np.linspace(0.0, 0.9, 41)
    weights = np.outer(1.0 - steps, np.ones(400))
    rates = weighted_rates(weights, np.zeros(400, dtype=np.bool_), None, (0.9, 0.9), 1.0 + 9.0 * steps)
    assert find_crossing(steps, rates, 0.05).lower == pytest.approx(0.435, abs=0.02)


@pytest.mark.parametrize(("probability", "rate"), [(0.9, 0.1), (0.95, 0.05)])
def test_rate_that_equals_the_permitted_one_is_met_without_a_change(probability: float, rate: float) -> None:
    """The binary number 1 - 0.9 is below 0.1, and 1 - 0.95 is above 0.05."""
    estimate, sizes = np.array([rate, 2.0 * rate]), np.array([0.0, 1.0])
    rates = WeightedRates(estimate, estimate - 0.01, estimate + 0.01, np.full(2, 100.0))
    assert find_crossing(sizes, rates, 1.0 - probability, decides_by_rate=True).lower == pytest.approx(0.0, abs=1e-12)
    assert math.isnan(find_crossing(sizes, rates, 1.0 - probability).lower)


def test_divergence_of_all_dispersions() -> None:
    """The largest rate of all distributions with a divergence r is that of the binary divergence.

    The least favourable distribution multiplies the density in the failure region by a factor, which is checked here
    against a numeric maximum over distributions on 40 points.
    """
    rate, cells = 0.02, 40
    p = np.full(cells, (1.0 - rate) / (cells - 4))
    p[:4] = rate / 4
    radius = 0.01

    def excess(weight: float) -> float:
        q = p * np.where(np.arange(cells) < 4, weight, 1.0)
        q /= q.sum()
        return float(np.sum(q * np.log(q / p))) - radius

    weight = optimize.brentq(excess, 1.0, 50.0)
    worst = weight * rate / (weight * rate + 1.0 - rate)
    assert population_divergence(worst, rate, 1.0) == pytest.approx(radius, rel=1e-6)
    rng = np.random.default_rng(2)
    for _ in range(200):  # no other distribution within the ball has a larger rate
        q = p * np.exp(rng.normal(0.0, 0.5, cells))
        q /= q.sum()
        if float(np.sum(q * np.log(q / p))) <= radius:
            assert q[:4].sum() <= worst
    assert population_divergence(0.01, 0.02, 1.0) == 0.0
    assert population_divergence(0.01, 0.0, 1.0) == math.inf


def test_divergence_of_a_population_is_smaller_than_that_of_all_cases() -> None:
    """Half of all cases belong to a population, of which 4 % fail; permitted are 10 %.

    The smallest divergence for which the mean of f = failure - 0.1 member reaches 0 is the maximum of -log E exp(t f).
    """
    member, rate, permitted = 0.5, 0.04, 0.1
    probabilities = np.array([member * rate, member * (1.0 - rate), 1.0 - member])
    scores = np.array([1.0 - permitted, -permitted, 0.0])
    tilt = np.linspace(0.0, 5.0, 5001)
    smallest = float((-np.log(np.exp(tilt[:, None] * scores) @ probabilities)).max())
    assert population_divergence(permitted, rate, member) == pytest.approx(smallest, rel=1e-5)
    assert population_divergence(permitted, rate, member) < 0.51 * population_divergence(permitted, rate, 1.0)


def test_divergence_of_a_population_is_that_of_all_cases(tmp_path: Path) -> None:
    """A third of the cases answers: PASS is claimed for a third of the divergence within the answers, or less."""
    answered = np.arange(900) % 3 == 0
    fails = lambda first, second, kind: first > 2.3  # noqa: E731
    verdicts, records, _ = evaluate(tmp_path, 900, 0.95, fails, population="valid", answered=answered)
    item = records[ALL_DISPERSIONS, ChangeKind.DIVERGENCE]
    assert verdicts[0].n == 300
    assert 0.0 < item.passes_at < 0.34 * population_divergence(0.05, 1.0 - verdicts[0].lower, 1.0)


def test_divergence_follows_from_the_bounds_of_the_verdict(tmp_path: Path) -> None:
    verdicts, records, _ = evaluate(tmp_path, 1000, 0.95, lambda first, second, kind: first > 2.0)
    item = records[ALL_DISPERSIONS, ChangeKind.DIVERGENCE]
    assert verdicts[0].status is Status.PASS
    assert item.passes_at == pytest.approx(population_divergence(0.05, 1.0 - verdicts[0].lower, 1.0))
    # a shift of one normal dispersion by d has the divergence d^2 / 2: PASS then holds for any direction
    assert item.lower <= records["loads.0", ChangeKind.MEAN_UP].lower


def test_number_of_a_terrain_is_not_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    terrain = '[dispersions]\nterrain = {{ distribution = "integer", low = 0, high = 7 }}'
    monkeypatch.setattr(f"{__name__}.CAMPAIGN", CAMPAIGN.replace("[dispersions]", terrain))
    _, records, _ = evaluate(tmp_path, 300, 0.9, lambda first, second, kind: first > 2.5)
    assert {parameter for parameter, _ in records} == {ALL_DISPERSIONS, "loads.0", "loads.1", "kindplain", "kindrough"}


def test_few_cases_are_refused(tmp_path: Path) -> None:
    """Of 29 cases, nothing is said about any change, except about those of bounded divergence."""
    _, _, records = evaluate(tmp_path, 29, 0.9, lambda first, second, kind: first > 9.0)
    assert [item.kind for item in records] == [ChangeKind.DIVERGENCE]
    assert records[0].outcome is ChangeOutcome.REFUSED


def test_change_is_refused_below_30_effective_cases(tmp_path: Path) -> None:
    """Of 200 cases, a shift d leaves 200 exp(-d^2) effective cases: at most d = 1.377."""
    _, records, _ = evaluate(tmp_path, 200, 0.9, lambda first, second, kind: first > 9.0)
    item = records["loads.0", ChangeKind.MEAN_UP]
    assert item.outcome is ChangeOutcome.REFUSED
    assert 0.0 < item.lower < item.reach <= math.sqrt(math.log(200.0 / 30.0)) + 1e-9
    assert item.effective_cases >= 30.0 * (1.0 - 1e-6)


@pytest.mark.parametrize("failures", [0, 3, 8, 15, 25])
def test_pass_at_no_change_is_that_of_the_verdict(tmp_path: Path, failures: int) -> None:
    verdicts, records, all_ = evaluate(
        tmp_path, 300, 0.95, lambda first, second, kind: np.argsort(np.argsort(-first)) < failures
    )
    assert verdicts[0].status is (
        Status.PASS if failures <= 8 else Status.INSUFFICIENT if failures <= 15 else Status.FAIL
    )
    if verdicts[0].status is Status.FAIL:
        assert not records
    else:
        is_pass = verdicts[0].status is Status.PASS
        assert {item.lower > 0.0 for item in records.values()} == {is_pass}
        assert is_pass or "These cases do not show PASS. Nearest changes to FAIL" in robustness_text(verdicts[0], all_)


def test_shared_terrains_widen_the_bounds_as_in_the_verdict(tmp_path: Path) -> None:
    """Pairs of failures on few terrains: PASS is not claimed under a change if the verdict has no PASS."""
    terrains = np.arange(600) // 3
    for failures in range(2, 24, 7):
        is_failed = np.arange(600) < failures
        verdicts, records, _ = evaluate(tmp_path, 600, 0.95, partial(_given, is_failed), terrain=terrains)
        assert {item.lower > 0.0 for item in records.values()} <= {verdicts[0].status is Status.PASS}, failures


def _given(failed: np.ndarray, *_: np.ndarray) -> np.ndarray:
    return failed


@pytest.mark.parametrize("failures", [0, 2, 6])
def test_shared_terrains_are_the_units(tmp_path: Path, failures: int) -> None:
    """600 cases on 200 terrains: the effective number is that of terrains, and PASS holds where the verdict has it."""
    verdicts, records, _ = evaluate(
        tmp_path, 600, 0.9, lambda first, second, kind: np.argsort(np.argsort(-first)) < failures,
        terrain=np.arange(600) // 3,
    )  # fmt: skip
    assert verdicts[0].status is Status.PASS
    item = records["loads.0", ChangeKind.MEAN_UP]
    independent = evaluate(tmp_path, 600, 0.9, lambda first, second, kind: np.argsort(np.argsort(-first)) < failures)[
        1
    ]["loads.0", ChangeKind.MEAN_UP]
    assert 0.0 < item.lower < independent.lower
    assert item.effective_cases <= 200.0


def test_unfinished_cases_are_failures(tmp_path: Path) -> None:
    """Crashed cases with large z0 count as failures at their weights, although their metric is unknown."""
    first = evaluate(tmp_path, 400, 0.9, lambda first, second, kind: first > 9.0)[1]["loads.0", ChangeKind.MEAN_UP]
    frame_outcomes = ["CRASHED" if case % 40 == 0 else "VALID" for case in range(400)]
    crashed = evaluate(tmp_path, 400, 0.9, lambda first, second, kind: first > 9.0, outcome=frame_outcomes)[1]
    assert crashed["loads.0", ChangeKind.MEAN_UP].lower < first.lower


def test_rows_with_other_draws_are_not_weighted(tmp_path: Path) -> None:
    """If the rows do not contain the values that the definition draws, only the divergence remains."""
    draws: dict[str, Any] = {"loads.0": np.linspace(0.0, 20.0, 300)}
    _, _, records = evaluate(tmp_path, 300, 0.9, lambda first, second, kind: first > 9.0, **draws)
    assert [item.kind for item in records] == [ChangeKind.DIVERGENCE]


def test_sentence_states_the_reach_of_the_pass(tmp_path: Path) -> None:
    verdicts, records, all_records = evaluate(tmp_path, 2000, 0.95, lambda first, second, kind: first > 2.0)
    text = robustness_text(verdicts[0], all_records)
    means = [item.lower for key, item in records.items() if key[1] in (ChangeKind.MEAN_UP, ChangeKind.MEAN_DOWN)]
    assert f"(90 % confidence, one change at a time) for a shift of any mean by {min(means):.4f}"[:-1] in text
    assert "any change of all dispersions up to a divergence of 0.0" in text
    wider, up = records["loads.0", ChangeKind.WIDER], records["loads.0", ChangeKind.MEAN_UP]
    nearest = wider if wider.change < up.change else up
    assert f"by chance on average): {nearest.fail_text}" in text
    assert " assumed; PASS up to " in nearest.fail_text
    # ten changes of three dispersions at 90 %: one of them can show FAIL by chance
    assert "(of 10 examined, of which at most 1 appear by chance on average)" in text


def test_withheld_pass_is_not_stated(tmp_path: Path) -> None:
    """The verdict of a calibration is never PASS: the sentence does not say that PASS holds."""
    verdicts, _, records = evaluate(tmp_path, 400, 0.95, lambda first, second, kind: first > 9.0)
    withheld = replace(verdicts[0], status=Status.INSUFFICIENT, withheld_status=Status.PASS)
    assert robustness_text(withheld, records).startswith("PASS would hold for another kind of evidence (90 % ")


def test_change_of_few_failures_is_not_named(tmp_path: Path) -> None:
    """Three failures give estimates of changes to FAIL, but do not show FAIL: the sentence does not name them."""
    verdicts, records, all_records = evaluate(
        tmp_path, 1000, 0.98, lambda first, second, kind: np.argsort(np.argsort(-first)) < 3
    )
    assert records["loads.0", ChangeKind.MEAN_UP].outcome is ChangeOutcome.FOUND
    assert records["loads.0", ChangeKind.MEAN_UP].effective_cases >= 30.0
    assert math.isnan(records["loads.0", ChangeKind.WIDER].upper)
    assert "standard deviation of loads 0" not in robustness_text(verdicts[0], all_records)


def test_rate_has_no_confidence(tmp_path: Path) -> None:
    """A requirement that is evaluated by its observed rate has a reach, but not at a confidence."""
    verdicts, _, records = evaluate(tmp_path, 400, 0.95, lambda first, second, kind: first > 2.2)
    text = robustness_text(replace(verdicts[0], decide_by="estimate", status=Status.MET_BY_RATE), records)
    assert text.startswith("Met by the rate (no confidence, one change at a time) for a shift of ")


def test_reach_is_the_smallest_change_that_loses_the_verdict(tmp_path: Path) -> None:
    verdicts, records, all_records = evaluate(tmp_path, 1000, 0.95, lambda first, second, kind: first > 2.0)
    distributions = {key: item.lower for key, item in records.items() if key[1] is not ChangeKind.DIVERGENCE}
    key = min(distributions, key=lambda name: distributions[name])
    text = reach_text(verdicts[0], all_records)
    assert text == f"holds up to {number(distributions[key])} spreads ({records[key].name}, {key[1]})"
    assert "loads 0" in text
    assert reach_text(verdicts[0], [item for item in all_records if item.kind is ChangeKind.DIVERGENCE]) == ""
    assert reach_text(replace(verdicts[0], status=Status.INSUFFICIENT), all_records) == ""


def test_too_few_terrains_for_any_change_are_stated(tmp_path: Path) -> None:
    """60 cases on 20 terrains without a failure have PASS at 80 %, but fewer than 30 effective terrains."""
    verdicts, _, records = evaluate(
        tmp_path, 60, 0.8, lambda first, second, kind: first > 9.0, terrain=np.arange(60) // 3
    )
    assert verdicts[0].status is Status.PASS
    (ball,) = [item for item in records if item.kind is ChangeKind.DIVERGENCE]
    refused = [item for item in records if item is not ball] + [replace(ball, lower=math.nan)]
    text = robustness_text(verdicts[0], refused)
    assert text.startswith("The cases are too few to state how far PASS reaches (effective number: 20).")


@pytest.mark.slow
def test_time_of_a_thousand_cases() -> None:
    """The robustness of 1,000 cases of a campaign with 27 dispersions takes at most 60 core-s."""
    campaign = load_campaign("dimes-gusev")
    rng, rows = np.random.default_rng(1), []
    for case in range(1000):
        draws = campaign.draws(case)
        rows.append({"case": case, "outcome": "VALID", "answered": True, "feasible_overlap": True, **draws})
    frame = pd.DataFrame(rows).assign(velocity_error_m_s=np.abs(rng.normal(0.0, 1.6, 1000)))
    definition = campaign.definition.model_dump(mode="json")
    run = StoredRun(Path(), frame, frame, {"definition": definition, "requirements": definition["requirements"]}, ())
    sampling = read_sampling_design(definition)
    verdicts = evaluate_requirements(frame, run.requirements, sampling)
    start = time.process_time()
    records = evaluate_robustness(run, verdicts, sampling)
    assert time.process_time() - start < 60.0
    assert len({item.parameter for item in records}) == 28
    assert json.dumps([item.pass_text for item in records])
