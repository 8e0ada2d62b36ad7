"""Tests of verdicts on requirements: populations, bounds, shared terrains, crashes and repeated evaluations."""

import math
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.overall import combine_verdicts, compute_exit_code, find_remedy
from marsyard.reports.sampling_design import SamplingDesign, read_sampling_design
from marsyard.reports.statistics.proportions import proportion_lower, proportion_upper
from marsyard.reports.verdicts import Status
from tests.reports.single_verdict import evaluate, make_cases
from tests.reports.synthetic_run import VELOCITY, make_rows

VELOCITY_90, VELOCITY_95 = ({**VELOCITY, "probability": rate, "population": "all"} for rate in (0.9, 0.95))


def test_verdict_passes_at_the_minimum_number_of_cases() -> None:
    # 99 % at 90 % confidence needs 230 cases without failure, 388 with one (binomial distribution)
    assert evaluate(make_cases(230, 0), VELOCITY).status is Status.PASS
    assert evaluate(make_cases(388, 1), VELOCITY).status is Status.PASS
    undecided = evaluate(make_cases(229, 0), VELOCITY)
    # After a first look that cannot pass, the second look needs 297 cases without failure at the corrected risk.
    assert (undecided.status, undecided.additional_cases) == (Status.INSUFFICIENT, 297 - 229)


@given(
    st.integers(1, 300).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, n))),
    st.sampled_from([0.5, 0.9, 0.99]),
    st.sampled_from([0.8, 0.9, 0.95]),
)
def test_status_follows_from_the_bounds(counts: tuple[int, int], probability: float, confidence: float) -> None:
    n, failures = counts
    requirement = {"id": "R", "metric": "velocity_error_m_s", "bound": 5.0, "population": "all"}
    requirement |= {"probability": probability, "confidence": confidence}
    verdict = evaluate(make_cases(n, failures), requirement)
    lower, upper = proportion_lower(n - failures, n, confidence), proportion_upper(n - failures, n, confidence)
    assert (verdict.lower, verdict.upper) == (lower, upper)
    assert (verdict.status is Status.PASS) == (lower >= probability)
    assert (verdict.status is Status.FAIL) == (upper < probability)
    if verdict.status is Status.INSUFFICIENT:
        assert verdict.additional_cases
        extended_rows = pd.concat([make_cases(n, failures), make_cases(verdict.additional_cases, 0)], ignore_index=True)
        extended_rows = extended_rows.drop(columns="terrain").assign(case=np.arange(len(extended_rows)))
        (later,) = evaluate_requirements(extended_rows, [requirement], SamplingDesign(first_look=n))
        assert later.status is Status.PASS
        (too_few,) = evaluate_requirements(extended_rows[:-1], [requirement], SamplingDesign(first_look=n))
        assert too_few.status is Status.INSUFFICIENT
    else:
        assert verdict.additional_cases is None


@pytest.mark.parametrize(
    ("error", "failures"),
    [(math.nan, 2), (math.inf, 2), (-math.inf, 2), (-6.0, 2), ("good", 2), (5.0, 0), (math.nextafter(5.0, 6.0), 2)],
)
def test_metric_is_compared_by_magnitude_and_may_equal_the_bound(error: float | str, failures: int) -> None:
    frame = make_cases(5, 0).astype({"velocity_error_m_s": object})
    frame.loc[:1, "velocity_error_m_s"] = error
    assert evaluate(frame, VELOCITY).failures == failures


def test_remedy_states_whether_more_cases_help_at_the_observed_rate() -> None:
    texts = [
        find_remedy(evaluate_requirements(make_cases(100, failures), [{**VELOCITY, "probability": 0.95}]), 100).text
        for failures in (0, 2, 6)
    ]
    assert "rate so far" not in texts[0]
    assert "continue at their rate so far (2.00 %), about " in texts[1]
    assert texts[1].endswith(" more are needed.")
    assert texts[2].endswith("(6.00 %), more cases are not expected to lead to PASS: it permits 5.00 %.")


def test_remedy_at_the_observed_rate_uses_the_first_look() -> None:
    """Further cases with failures cannot be fewer than those without; planned looks have no number."""
    frame = make_cases(300, 1).drop(columns="terrain").assign(case=np.arange(300))
    (verdict,) = evaluate_requirements(frame, [VELOCITY], SamplingDesign(first_look=230))
    assert verdict.additional_cases == 749
    assert find_remedy([verdict], 300).text.endswith("about 2,204 more are needed.")
    (planned,) = evaluate_requirements(frame, [VELOCITY], SamplingDesign(max_cases=1000))
    assert "rate so far" not in find_remedy([planned], 300).text
    # appended cases would be a look that was not planned
    overall = combine_verdicts([planned], frame, SamplingDesign(max_cases=1000))
    assert "planned up to 1,000 cases; a new campaign" in overall.sentence
    assert "additional" not in overall.sentence


def test_populations_select_cases() -> None:
    frame = make_rows(100, answer_rate=0.8, n_crashed=3)
    n_answered, n_crashed = int(frame["answered"].sum()), 3
    verdicts = {name: evaluate(frame, VELOCITY, population=name) for name in ("all", "completed", "valid")}
    assert [verdict.n for verdict in verdicts.values()] == [100, 100 - n_crashed, n_answered]
    n_beyond = int((frame["velocity_error_m_s"] > 5.0).sum())
    # a case without an answer fails if it belongs to the population
    failures = [verdict.failures for verdict in verdicts.values()]
    assert failures == [100 - n_answered + n_beyond, 100 - n_crashed - n_answered + n_beyond, n_beyond]


def test_empty_population_is_insufficient() -> None:
    verdict = evaluate(make_rows(24, answer_rate=0.0), VELOCITY)
    assert (verdict.status, verdict.n, verdict.additional_cases) == (Status.INSUFFICIENT, 0, 297)
    assert math.isnan(verdict.estimate)
    assert "No case" in verdict.note


def test_empty_table_is_insufficient() -> None:
    assert evaluate(pd.DataFrame(), VELOCITY, population="all").status is Status.INSUFFICIENT
    assert evaluate(make_cases(0, 0), VELOCITY).n == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"metric": "velocity_eror_m_s"}, "velocity_eror_m_s"),
        ({"population": "everyone"}, "everyone"),
        ({"population": "valid"}, "answered"),
        ({"probability": 1.0}, "probability"),
        ({"confidence": "high"}, "confidence"),
        ({"bound": None}, "bound"),
        ({"bound": [5]}, "bound"),
    ],
)
def test_invalid_requirements_are_insufficient_with_a_note(changes: dict[str, Any], message: str) -> None:
    verdict = evaluate(make_cases(500, 0).drop(columns="answered"), VELOCITY, **{"population": "all", **changes})
    assert verdict.status is Status.INSUFFICIENT
    assert message in verdict.note


def test_boolean_metric_counts_true_as_success() -> None:
    frame = make_cases(100, 0).assign(answered=np.arange(100) >= 10, feasible_overlap=np.arange(100) >= 5)
    availability = {"id": "AVAIL", "metric": "answered", "probability": 0.9, "confidence": 0.9}
    all_cases, feasible_cases = (evaluate(frame, availability, population=name) for name in ("all", "feasible_overlap"))
    assert (all_cases.n, all_cases.failures, feasible_cases.n, feasible_cases.failures) == (100, 10, 95, 5)
    assert (all_cases.status, feasible_cases.status) == (Status.INSUFFICIENT, Status.PASS)
    # if the estimate decides, 90 of 100 cases meet 90 %; the bounds do not change
    by_estimate = evaluate(frame, availability, decide_by="estimate")
    assert (by_estimate.status, by_estimate.lower) == (Status.MET_BY_RATE, all_cases.lower)
    assert evaluate(frame, availability, decide_by="estimate", probability=0.91).status is Status.FAIL


def test_populations_combine_columns() -> None:
    frame = make_cases(100, 20).assign(answered=np.arange(100) >= 10, feasible_overlap=np.arange(100) < 50)
    verdict = evaluate(frame, VELOCITY_90, population="valid and feasible_overlap")
    assert (verdict.n, verdict.failures) == (40, 10)
    assert (
        "feasible_overlap"
        in evaluate(frame.assign(feasible_overlap=np.arange(100.0)), VELOCITY_90, population="feasible_overlap").note
    )


@pytest.mark.parametrize("outcome", ["VALID", "CRASHED", "BAD_ANSWER", "TIMED_OUT"])
def test_unknown_membership_counts_as_failure(outcome: str) -> None:
    frame = make_cases(100, 0).assign(feasible_overlap=np.arange(100) < 50).astype({"feasible_overlap": object})
    frame.loc[90:93, "outcome"] = outcome
    frame.loc[90:93, "feasible_overlap"] = None
    verdict = evaluate(frame, VELOCITY_90, population="feasible_overlap")
    assert (verdict.n, verdict.failures) == (54, 4)
    # cases 92 and 93 are excluded by the second condition
    frame["is_near"] = np.arange(100) < 92
    verdict = evaluate(frame, VELOCITY_90, population="feasible_overlap and is_near")
    assert (verdict.n, verdict.failures) == (52, 2)


def test_crashed_cases_are_failures_of_availability() -> None:
    """4 of 20 cases crash before their conditions are known; the other 16 succeed."""
    frame = make_cases(20, 0).assign(feasible_overlap=True).astype({"feasible_overlap": object})
    frame.loc[:3, ["outcome", "answered", "feasible_overlap"]] = ["CRASHED", False, None]
    requirement = {
        "id": "AVAIL",
        "metric": "answered",
        "probability": 0.95,
        "confidence": 0.9,
        "population": "feasible_overlap",
    }
    verdict = evaluate(frame, requirement, decide_by="estimate")
    assert (verdict.status, verdict.n, verdict.failures) == (Status.FAIL, 20, 4)


def test_crashed_case_with_a_small_error_fails() -> None:
    frame = make_cases(20, 0).assign(outcome=["CRASHED"] * 2 + ["VALID"] * 18)
    assert evaluate(frame, VELOCITY_95, population="all", decide_by="estimate").failures == 2


@pytest.mark.parametrize("population", ["valid", "answered", "completed", "valid and is_near"])
def test_crashed_cases_outside_the_population_prevent_a_pass(population: str) -> None:
    """The verdict is INSUFFICIENT if it depends on whether crashed cases belong to the population."""
    frame = make_cases(50, 0).assign(is_near=True)
    frame.loc[:9, "outcome"] = "CRASHED"
    frame.loc[:9, "answered"] = False
    for rule in ("confidence", "estimate"):
        verdict = evaluate(frame, VELOCITY_90, population=population, decide_by=rule)
        assert (verdict.status, verdict.n, verdict.failures) == (Status.INSUFFICIENT, 40, 0)
        assert "10 cases did not finish" in verdict.note
    # too few crashes, or crashes outside the population, do not change the verdict
    few_crashes = make_cases(200, 0).assign(is_near=True)
    few_crashes.loc[:1, "outcome"] = "CRASHED"
    few_crashes.loc[:1, "answered"] = False
    assert evaluate(few_crashes, VELOCITY_90, population=population).status is Status.PASS
    # cases that finished only in a second attempt count like crashed ones
    repeated = make_cases(50, 0).assign(is_near=True, case_attempts=np.where(np.arange(50) < 10, 2, 1))
    for rule in ("confidence", "estimate"):
        verdict = evaluate(repeated, VELOCITY_90, population=population, decide_by=rule)
        assert (verdict.status, verdict.n, verdict.failures) == (Status.INSUFFICIENT, 50, 0)
        assert verdict.note.startswith("10 cases finished only in a second attempt.")
    assert evaluate(repeated, VELOCITY_90, population="all").status is Status.INSUFFICIENT
    assert evaluate(repeated.assign(is_near=repeated["case"] >= 10), VELOCITY_90, population="is_near").n == 40
    assert evaluate(few_crashes.assign(case_attempts=2 - few_crashes["answered"]), VELOCITY_90).status is Status.PASS
    outside_population = frame.assign(is_near=frame["answered"])
    assert evaluate(outside_population, VELOCITY_90, population="valid and is_near").status is Status.PASS


def test_estimate_decides_with_shared_terrains() -> None:
    verdict = evaluate(make_cases(400, 0).assign(terrain=np.arange(400) % 8), VELOCITY, decide_by="estimate")
    assert (verdict.status, verdict.plain_status) == (Status.MET_BY_RATE, None)
    assert "8 terrains" in verdict.note


def test_estimate_verdict_reports_the_confidence_verdict() -> None:
    verdict = evaluate(make_cases(120, 1), VELOCITY, decide_by="estimate")
    assert (verdict.status, verdict.confident_status) == (Status.MET_BY_RATE, Status.INSUFFICIENT)
    assert "at 90 % confidence the verdict would be INSUFFICIENT" in verdict.note
    summary = combine_verdicts([verdict], make_cases(120, 1))
    assert summary.word == "MET BY RATE"
    assert "1 of 1 requirement met by the rate only, not at the required confidence" in summary.sentence
    assert verdict.statement.endswith("(evaluated by observed rate).")


def test_verdict_by_rate_is_not_pass() -> None:
    """8 cases without failure have a rate of 100 %, but a consumer's risk of 97.6 % at a required rate of 99.7 %."""
    requirement_99_7 = {**VELOCITY, "probability": 0.997, "decide_by": "estimate"}
    eight_cases = evaluate(make_cases(8, 0), requirement_99_7)
    # a failure rate of 0.003 allows one failure in 1 / 0.003 = 334 cases
    assert (eight_cases.status, eight_cases.additional_cases) == (Status.INSUFFICIENT, 334 - 8)
    assert "needs at least 334 cases" in eight_cases.note
    assert evaluate(make_cases(333, 0), requirement_99_7).status is Status.INSUFFICIENT
    assert evaluate(make_cases(334, 1), requirement_99_7).status is Status.MET_BY_RATE
    assert evaluate(make_cases(334, 2), requirement_99_7).status is Status.FAIL
    # 99.7 % at 90 % confidence needs 767 cases without failure
    assert evaluate(make_cases(767, 0), requirement_99_7).status is Status.PASS
    by_rate = evaluate(make_cases(334, 1), requirement_99_7)
    assert compute_exit_code([by_rate], crashed=False) == 3
    assert compute_exit_code([evaluate(make_cases(334, 1), requirement_99_7, accept_rate=True)], crashed=False) == 0
    passing = evaluate(make_cases(230, 0), VELOCITY)
    assert combine_verdicts([passing, by_rate], make_cases(334, 1)).word == "MET BY RATE"
    assert combine_verdicts([passing, by_rate, eight_cases], make_cases(334, 1)).word == "INSUFFICIENT"


@pytest.mark.parametrize(("probability", "min_cases"), [(0.5, 2), (0.9, 10), (0.92, 13), (0.95, 20), (0.99, 100)])
def test_minimum_cases_of_a_rate_allow_one_failure(probability: float, min_cases: int) -> None:
    requirement = {**VELOCITY, "probability": probability, "decide_by": "estimate"}
    assert evaluate(make_cases(min_cases, 1), requirement).status is Status.MET_BY_RATE
    assert evaluate(make_cases(min_cases - 1, 1), requirement).status is Status.FAIL
    assert evaluate(make_cases(min_cases - 1, 0), requirement).status is Status.INSUFFICIENT


def test_appended_cases_share_the_risk_of_two_evaluations() -> None:
    """388 cases with one failure pass in a single evaluation, but not in a second evaluation after one at 230 cases."""
    design = read_sampling_design({"cases": 230, "appended": [158]})
    frame = make_cases(388, 1)
    (first,) = evaluate_requirements(frame[:230], [VELOCITY], design)
    (later,) = evaluate_requirements(frame, [VELOCITY], design)
    assert evaluate(frame, VELOCITY).status is Status.PASS
    assert (first.status, first.bounds_confidence) == (Status.INSUFFICIENT, 0.9)
    assert (later.status, later.bounds_confidence > 0.99) == (Status.INSUFFICIENT, True)
    assert "evaluated more than once" in later.note
    # with one failure, the second look needs 1049 cases at the corrected risk
    assert first.additional_cases == 1049 - 230
    (sufficient,) = evaluate_requirements(make_cases(1049, 1), [VELOCITY], design)
    assert (sufficient.status, sufficient.n) == (Status.PASS, 1049)
    # 388 cases with 60 failures fail also in the second evaluation
    assert evaluate_requirements(make_cases(388, 60), [VELOCITY], design)[0].status is Status.FAIL


def test_appended_terrains_share_the_risk_of_two_evaluations() -> None:
    design = SamplingDesign(first_look=460)
    frame = make_cases(776, 0).assign(terrain=np.arange(776) // 2)
    frame.loc[0, "velocity_error_m_s"] = 6.0
    (first,) = evaluate_requirements(frame[:460], [VELOCITY], design)
    (later,) = evaluate_requirements(frame, [VELOCITY], design)
    # the first look at 230 terrains can use a risk of 9.9 %; little is left for later looks
    assert first.status is Status.INSUFFICIENT
    assert first.additional_cases is not None
    assert first.additional_cases > 800
    assert evaluate(frame, VELOCITY).status is Status.PASS
    assert later.status is Status.INSUFFICIENT


def test_consumer_risk_is_exact_at_the_minimum_number_of_cases() -> None:
    # 0.99^230 = 0.0991 is below 10 %
    assert evaluate(make_cases(230, 0), VELOCITY).consumer_risk == pytest.approx(0.99**230)
    # ten cases on each of 230 terrains count as 230 cases
    verdict = evaluate(make_cases(2300, 0).assign(terrain=np.arange(2300) // 10), VELOCITY)
    assert verdict.consumer_risk == pytest.approx(0.99**230)


@pytest.mark.parametrize("changes", [{"metric": "velocity_error_m_s"}, {"metric": "site_safe", "bound": None}])
def test_campaign_without_a_finished_case_fails(changes: dict[str, Any]) -> None:
    """The columns of metric and population are missing if every case crashed; that is no reason for INSUFFICIENT."""
    frame = make_cases(30, 0).assign(outcome="CRASHED", answered=False).drop(columns="velocity_error_m_s")
    verdict = evaluate(frame, {**VELOCITY, **changes}, population="selectable")
    assert (verdict.status, verdict.failures) == (Status.FAIL, 30)


def test_evaluation_does_not_change_its_inputs() -> None:
    frame, requirement = make_rows(50), dict(VELOCITY)
    frame_before = frame.copy()
    evaluate_requirements(frame, [requirement])
    pd.testing.assert_frame_equal(frame, frame_before)
    assert requirement == VELOCITY


def test_overall_verdict_and_exit_code_are_those_of_the_worst_verdict() -> None:
    frame = make_cases(230, 0)
    passing, failing = evaluate(frame, VELOCITY), evaluate(frame, VELOCITY, bound=0.5)
    undecided = evaluate(frame, VELOCITY, probability=0.999)
    assert combine_verdicts([passing], frame).word == "PASS"
    assert combine_verdicts([passing, undecided], frame).word == "INSUFFICIENT"
    assert combine_verdicts([passing, undecided, failing], frame).word == "FAIL"
    assert combine_verdicts([], frame).status is None
    assert "1 of 3 requirements not met, 1 undecided" in combine_verdicts([passing, undecided, failing], frame).sentence
    for verdicts, crashed, code in (
        ([], False, 0), ([passing], False, 0), ([passing, undecided], False, 3), ([undecided, failing], False, 1),
        ([undecided], True, 1), ([], True, 1),
    ):  # fmt: skip
        assert compute_exit_code(verdicts, crashed=crashed) == code


def test_crashed_cases_are_counted_in_the_summary() -> None:
    summary = combine_verdicts([], make_rows(24, n_crashed=2))
    assert summary.crashed == 2
    assert "2 cases crashed" in summary.sentence


def test_repeated_cases_are_counted_in_the_summary() -> None:
    frame = make_cases(20, 0).assign(outcome=["CRASHED"] + ["VALID"] * 19, case_attempts=[2] * 3 + [1] * 17)
    overall = combine_verdicts([evaluate(frame, VELOCITY)], frame)
    # the crashed case is no repeated one: it crashed again
    assert (overall.crashed, overall.repeated) == (1, 2)
    assert overall.sentence.endswith("1 case crashed. 2 cases finished only in a second attempt.")


def test_population_defined_by_truth_is_named_and_compared_with_all_cases() -> None:
    frame = make_cases(20, 2)
    frame["lit"] = np.arange(20) >= 10
    requirement = {**VELOCITY, "population": "lit", "statement": "The error is small."}
    (verdict,) = evaluate_requirements(frame, [requirement], from_truth={"lit": "the sun is up"})
    assert verdict.statement == "Given truth (lit): The error is small."
    assert (verdict.n, verdict.all_cases.n, verdict.all_cases.failures) == (10, 20, 2)
    assert verdict.note == (
        "'lit' means: the sun is up. For comparison: if all 20 cases counted, and cases without a value were failures, "
        f"18 (90.00 %) would meet the criterion, and the verdict would be {verdict.all_cases.status}."
    )
    (not_from_truth,) = evaluate_requirements(frame, [requirement])
    assert not_from_truth.statement == "The error is small."
    (over_all_cases,) = evaluate_requirements(
        frame, [{**requirement, "population": "all"}], from_truth={"lit": "the sun is up"}
    )
    assert (over_all_cases.all_cases, over_all_cases.statement) == (None, "The error is small.")


def test_configured_conditions_also_restrict_the_result_of_all_cases() -> None:
    frame = make_cases(20, 2)
    frame["lit"], frame["navcam"] = np.arange(20) >= 10, np.arange(20) % 2 == 0
    requirement = {**VELOCITY, "population": "lit and navcam"}
    (verdict,) = evaluate_requirements(frame, [requirement], from_truth={"lit": "the sun is up"}, configured=("nav*",))
    assert (verdict.n, verdict.all_cases.n, verdict.all_cases.configured) == (5, 10, ("navcam",))
    assert verdict.all_cases.text.startswith("For comparison: if all 10 cases with the navcam counted, ")
    # the population is the definition itself
    (configured_population,) = evaluate_requirements(
        frame, [{**VELOCITY, "population": "navcam"}], configured=("nav*",)
    )
    assert configured_population.all_cases is None
