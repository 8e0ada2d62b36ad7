from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from reports.overall import exit_code, overall
from reports.sampled import Sampled
from reports.statistics.proportions import proportion_lower, proportion_upper
from reports.verdicts import Status, Verdict, judge_campaign

Rows = Callable[..., pd.DataFrame]


def _rows(n: int, failures: int, *, error: float = 6.0) -> pd.DataFrame:
    """Cases on a terrain each, of which some miss the bound of 5."""
    errors = np.where(np.arange(n) < failures, error, 1.0)
    return pd.DataFrame(
        {
            "case": np.arange(n),
            "outcome": "VALID",
            "answered": True,
            "velocity_error_m_s": errors,
            "terrain": np.arange(n),
        }
    )


def _judge(frame: pd.DataFrame, requirement: dict[str, Any], **changes: Any) -> Verdict:
    (verdict,) = judge_campaign(frame, [{**requirement, **changes}])
    return verdict


def test_fewest_cases_that_pass(velocity: dict[str, Any]) -> None:
    # `design.md`: 99 % at 90 % confidence takes 230 cases without a failure, 388 with one.
    assert _judge(_rows(230, 0), velocity).status is Status.PASS
    assert _judge(_rows(388, 1), velocity).status is Status.PASS
    short = _judge(_rows(229, 0), velocity)
    assert (short.status, short.further_cases) == (Status.INSUFFICIENT, 1)


def test_demo_sized_campaign_is_insufficient(velocity: dict[str, Any]) -> None:
    verdict = _judge(_rows(24, 0), velocity)
    assert (verdict.status, verdict.n, verdict.failures) == (Status.INSUFFICIENT, 24, 0)
    assert verdict.further_cases == 206
    # 0.1 ** (1 / 24): no failure in 24 cases at 90 % confidence.
    assert verdict.lower == pytest.approx(0.1 ** (1 / 24))
    assert (verdict.estimate, verdict.upper) == (1.0, 1.0)


def test_all_cases_failed(velocity: dict[str, Any]) -> None:
    verdict = _judge(_rows(24, 24), velocity)
    assert (verdict.status, verdict.estimate, verdict.lower) == (Status.FAIL, 0.0, 0.0)
    assert verdict.further_cases is None


@given(
    st.integers(1, 300).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, n))),
    st.sampled_from([0.5, 0.9, 0.99]),
    st.sampled_from([0.8, 0.9, 0.95]),
)
def test_status_follows_from_the_bounds(counts: tuple[int, int], probability: float, confidence: float) -> None:
    n, failures = counts
    requirement = {"id": "R", "metric": "velocity_error_m_s", "bound": 5.0, "population": "all"}
    requirement |= {"probability": probability, "confidence": confidence}
    verdict = _judge(_rows(n, failures), requirement)
    lower, upper = proportion_lower(n - failures, n, confidence), proportion_upper(n - failures, n, confidence)
    assert (verdict.lower, verdict.upper) == (lower, upper)
    assert (verdict.status is Status.PASS) == (lower >= probability)
    assert (verdict.status is Status.FAIL) == (upper < probability)
    if verdict.status is Status.INSUFFICIENT:
        assert verdict.further_cases
        more = pd.concat([_rows(n, failures), _rows(verdict.further_cases, 0)], ignore_index=True)
        assert _judge(more.drop(columns="terrain"), requirement).status is Status.PASS


def test_a_metric_exactly_at_the_bound_succeeds(velocity: dict[str, Any]) -> None:
    assert _judge(_rows(5, 5, error=5.0), velocity).failures == 0
    assert _judge(_rows(5, 5, error=math.nextafter(5.0, 6.0)), velocity).failures == 5


def test_signed_metrics_count_by_magnitude(velocity: dict[str, Any]) -> None:
    assert _judge(_rows(5, 2, error=-6.0), velocity).failures == 2


@pytest.mark.parametrize("error", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_fails(velocity: dict[str, Any], error: float) -> None:
    assert _judge(_rows(5, 2, error=error), velocity).failures == 2


def test_populations(make_rows: Rows, velocity: dict[str, Any]) -> None:
    frame = make_rows(100, answered=0.8, crashed=3)
    answered, crashed = int(frame["answered"].sum()), 3
    of_each = {name: _judge(frame, velocity, population=name) for name in ("all", "completed", "valid")}
    assert [verdict.n for verdict in of_each.values()] == [100, 100 - crashed, answered]
    beyond = int((frame["velocity_error_m_s"] > 5.0).sum())
    # A case without an answer has no velocity: where it belongs to the population it fails.
    failures = [verdict.failures for verdict in of_each.values()]
    assert failures == [100 - answered + beyond, 100 - crashed - answered + beyond, beyond]


def test_empty_population_is_insufficient(make_rows: Rows, velocity: dict[str, Any]) -> None:
    verdict = _judge(make_rows(24, answered=0.0), velocity)
    assert (verdict.status, verdict.n, verdict.further_cases) == (Status.INSUFFICIENT, 0, 230)
    assert math.isnan(verdict.estimate)
    assert "No case" in verdict.note


def test_no_rows_at_all(velocity: dict[str, Any]) -> None:
    assert _judge(pd.DataFrame(), velocity, population="all").status is Status.INSUFFICIENT
    assert _judge(_rows(0, 0), velocity).n == 0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"metric": "velocity_eror_m_s"}, "velocity_eror_m_s"),
        ({"population": "everyone"}, "everyone"),
        ({"probability": 1.0}, "probability"),
        ({"confidence": "high"}, "confidence"),
        ({"bound": None}, "bound"),
        ({"bound": [5]}, "bound"),
    ],
)
def test_what_cannot_be_judged_is_said(velocity: dict[str, Any], changes: dict[str, Any], said: str) -> None:
    verdict = _judge(_rows(500, 0), velocity, **changes)
    assert verdict.status is Status.INSUFFICIENT
    assert said in verdict.note


def test_a_share_is_asked_of_a_column_of_true_and_false() -> None:
    frame = _rows(100, 0).assign(answered=np.arange(100) >= 10, room=np.arange(100) >= 5)
    availability = {"id": "AVAIL", "metric": "answered", "probability": 0.9, "confidence": 0.9}
    of_all, of_room = (_judge(frame, availability, population=name) for name in ("all", "room"))
    assert (of_all.n, of_all.failures, of_room.n, of_room.failures) == (100, 10, 95, 5)
    assert (of_all.status, of_room.status) == (Status.INSUFFICIENT, Status.PASS)
    # Decided by the estimate, 90 of 100 is 90 %; the bounds stay what they are.
    by_estimate = _judge(frame, availability, decide_by="estimate")
    assert (by_estimate.status, by_estimate.lower) == (Status.PASS, of_all.lower)
    assert _judge(frame, availability, decide_by="estimate", probability=0.91).status is Status.FAIL


def test_populations_of_columns_and_of_several() -> None:
    frame = _rows(100, 20).assign(answered=np.arange(100) >= 10, room=np.arange(100) < 50)
    asked = {"id": "R", "metric": "velocity_error_m_s", "bound": 5.0, "probability": 0.9, "confidence": 0.9}
    both = _judge(frame, asked, population="valid and room")
    assert (both.n, both.failures) == (40, 10)
    assert "room" in _judge(frame.assign(room=np.arange(100.0)), asked, population="room").note


@pytest.mark.parametrize("outcome", ["VALID", "CRASHED", "BAD_ANSWER", "TIMED_OUT"])
def test_a_case_of_unknown_membership_is_a_member_and_a_failure(outcome: str) -> None:
    frame = _rows(100, 0).assign(room=np.arange(100) < 50).astype({"room": object})
    frame.loc[90:93, "outcome"] = outcome
    frame.loc[90:93, "room"] = None
    asked = {"id": "R", "metric": "velocity_error_m_s", "bound": 5.0, "probability": 0.9, "confidence": 0.9}
    found = _judge(frame, asked, population="room")
    assert (found.n, found.failures) == (54, 4)
    # the other part of the population is known, and false
    frame["near"] = np.arange(100) < 92
    found = _judge(frame, asked, population="room and near")
    assert (found.n, found.failures) == (52, 2)


def test_crashes_do_not_meet_an_availability() -> None:
    """4 of 20 cases crash before anything is known of them; by the others alone the rate is 100 %."""
    frame = _rows(20, 0).assign(room=True).astype({"room": object})
    frame.loc[:3, ["outcome", "answered", "room"]] = ["CRASHED", False, None]
    asked = {"id": "AVAIL", "metric": "answered", "probability": 0.95, "confidence": 0.9, "population": "room"}
    found = _judge(frame, asked, decide_by="estimate")
    assert (found.status, found.n, found.failures) == (Status.FAIL, 20, 4)


def test_a_crashed_case_that_was_scored_fails_nevertheless() -> None:
    frame = _rows(20, 0).assign(outcome=["CRASHED"] * 2 + ["VALID"] * 18)
    asked = {"id": "R", "metric": "velocity_error_m_s", "bound": 5.0, "probability": 0.95, "confidence": 0.9}
    assert _judge(frame, asked, population="all", decide_by="estimate").failures == 2


@pytest.mark.parametrize("population", ["valid", "completed", "valid and near"])
def test_crashes_withhold_a_verdict_on_answers_that_they_might_have_failed(population: str) -> None:
    """A crash is no answer; but where crashes instead of wrong answers would earn a PASS, there is none."""
    asked = {"id": "R", "metric": "velocity_error_m_s", "bound": 5.0, "probability": 0.9, "confidence": 0.9}
    frame = _rows(50, 0).assign(near=True)
    frame.loc[:9, ["outcome", "answered"]] = ["CRASHED", False]
    for how in ("confidence", "estimate"):
        found = _judge(frame, asked, population=population, decide_by=how)
        assert (found.status, found.n, found.failures) == (Status.INSUFFICIENT, 40, 0)
        assert "10 cases did not come to an end" in found.note
    # crashes that are too few to matter, or that belong elsewhere, withhold nothing
    few = _rows(200, 0).assign(near=True)
    few.loc[:1, ["outcome", "answered"]] = ["CRASHED", False]
    assert _judge(few, asked, population=population).status is Status.PASS
    elsewhere = frame.assign(near=frame["answered"])
    assert _judge(elsewhere, asked, population="valid and near").status is Status.PASS


def test_the_estimate_decides_among_shared_terrains_too(velocity: dict[str, Any]) -> None:
    verdict = _judge(_rows(400, 0).assign(terrain=np.arange(400) % 8), velocity, decide_by="estimate")
    assert (verdict.status, verdict.plain_status) == (Status.PASS, None)
    assert "8 terrains" in verdict.note


def test_what_the_estimate_decides_says_what_confidence_would(velocity: dict[str, Any]) -> None:
    found = _judge(_rows(24, 0), velocity, decide_by="estimate")
    assert (found.status, found.confident_status) == (Status.PASS, Status.INSUFFICIENT)
    assert "at 90 % confidence it would be INSUFFICIENT" in found.note
    assert "1 of them by the rate seen alone" in overall([found], _rows(24, 0)).sentence


def test_consumers_risk_is_what_the_confidence_leaves_at_the_least_cases_that_pass(velocity: dict[str, Any]) -> None:
    # 0.99 ** 230 = 0.0991: the least n of the design's table for 99 % at 90 %.
    assert _judge(_rows(230, 0), velocity).consumer_risk == pytest.approx(0.99**230)
    # ten cases on each of 230 terrains are worth no more
    found = _judge(_rows(2300, 0).assign(terrain=np.arange(2300) // 10), velocity)
    assert found.consumer_risk == pytest.approx(0.99**230)
    assert "the design effect taken for 10" in found.note


def test_valid_cannot_be_told_without_its_column(velocity: dict[str, Any]) -> None:
    assert "answered" in _judge(_rows(5, 0).drop(columns="answered"), velocity).note


def test_metric_of_texts_fails_throughout(velocity: dict[str, Any]) -> None:
    assert _judge(_rows(5, 0).assign(velocity_error_m_s="good"), velocity).failures == 5


def test_shared_terrains_decide(velocity: dict[str, Any]) -> None:
    verdict = _judge(_rows(400, 0).assign(terrain=np.arange(400) % 8), velocity)
    # Issue 8: with too few failures to estimate the correlation terrains are counted; 99 % at 90 % takes 230 of them.
    assert (verdict.status, verdict.terrains, verdict.plain_status) == (Status.INSUFFICIENT, 8, Status.PASS)
    assert verdict.lower == proportion_lower(8, 8, 0.9)
    assert verdict.plain_lower == proportion_lower(400, 400, 0.9)
    assert verdict.further_cases == 222
    for said in ("8 terrains", "not independent", "222 further terrains", "PASS"):
        assert said in verdict.note
    enough = _judge(_rows(460, 0).assign(terrain=np.arange(460) % 230), velocity)
    assert enough.status is Status.PASS


def test_further_cases_of_correlated_cases_count_what_they_are_worth(velocity: dict[str, Any]) -> None:
    # 200 terrains of 5 cases that fail together, 40 of them: each case is worth a fifth.
    frame = _rows(1000, 0).assign(terrain=np.arange(1000) // 5)
    frame.loc[frame["terrain"] < 40, "velocity_error_m_s"] = 6.0
    verdict = _judge(frame, velocity, probability=0.82)
    assert verdict.status is Status.INSUFFICIENT
    assert verdict.clustered is not None
    assert verdict.clustered.design_effect == pytest.approx(5.0, rel=0.02)
    assert verdict.further_cases
    more = pd.concat(
        [frame, _rows(verdict.further_cases, 0).assign(terrain=1000 + np.arange(verdict.further_cases) // 5)]
    )
    assert _judge(more, velocity, probability=0.82).status is Status.PASS


def test_looks_of_a_campaign_that_stops_itself_share_the_risk(velocity: dict[str, Any]) -> None:
    # Of 640 cases the looks are at 20, 40, 80, 160, 320 and 640; the last adds half of them and has half of 10 %.
    how = Sampled(most_cases=640)
    (early,) = judge_campaign(_rows(320, 0), [velocity], how)
    assert early.bounds_confidence == pytest.approx(1.0 - 0.1 * 160 / 640)
    assert early.lower == proportion_lower(320, 320, early.bounds_confidence)
    (last,) = judge_campaign(_rows(640, 0), [velocity], how)
    assert (last.status, last.bounds_confidence) == (Status.PASS, pytest.approx(0.95))
    assert "stops itself" in last.note


def test_a_terrain_each_needs_no_word(velocity: dict[str, Any]) -> None:
    verdict = _judge(_rows(20, 0), velocity)
    assert (verdict.terrains, verdict.clustered, verdict.note) == (20, None, "")


def test_a_case_of_unknown_terrain_stands_alone(velocity: dict[str, Any]) -> None:
    frame = _rows(20, 3).assign(terrain=[np.nan, np.nan, *range(18)])
    assert _judge(frame, velocity).clustered is None
    assert _judge(frame.assign(terrain=np.nan), velocity).terrains is None


def test_judging_changes_nothing(make_rows: Rows, velocity: dict[str, Any]) -> None:
    frame, requirement = make_rows(50), dict(velocity)
    before = frame.copy()
    judge_campaign(frame, [requirement])
    pd.testing.assert_frame_equal(frame, before)
    assert requirement == velocity


def test_overall_verdict_is_the_worst(velocity: dict[str, Any]) -> None:
    frame = _rows(230, 0)
    passing, failing = _judge(frame, velocity), _judge(frame, velocity, bound=0.5)
    undecided = _judge(frame, velocity, probability=0.999)
    assert overall([passing], frame).word == "PASS"
    assert overall([passing, undecided], frame).word == "INSUFFICIENT"
    assert overall([passing, undecided, failing], frame).word == "FAIL"
    assert overall([], frame).status is None
    assert "1 of 3 requirements not met" in overall([passing, undecided, failing], frame).sentence


def test_exit_codes(velocity: dict[str, Any]) -> None:
    frame = _rows(230, 0)
    passing, failing = _judge(frame, velocity), _judge(frame, velocity, bound=0.5)
    undecided = _judge(frame, velocity, probability=0.999)
    assert exit_code([], crashed=False) == 0
    assert exit_code([passing], crashed=False) == 0
    assert exit_code([passing, undecided], crashed=False) == 3
    assert exit_code([undecided, failing], crashed=False) == 1
    assert exit_code([undecided], crashed=True) == 1
    assert exit_code([], crashed=True) == 1


def test_crashed_cases_are_said(make_rows: Rows) -> None:
    whole = overall([], make_rows(24, crashed=2))
    assert whole.crashed == 2
    assert "2 cases crashed" in whole.sentence
