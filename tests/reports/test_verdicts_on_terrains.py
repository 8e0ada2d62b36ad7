"""Tests of verdicts on cases that share terrains, and of their advice."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from marsyard.reports.decision import evaluate_requirements
from marsyard.reports.overall import combine_verdicts
from marsyard.reports.sampling_design import SamplingDesign, read_sampling_design
from marsyard.reports.statistics.proportions import proportion_lower
from marsyard.reports.verdicts import Status
from tests.reports.single_verdict import evaluate, make_cases
from tests.reports.synthetic_run import VELOCITY


def test_shared_terrains_count_as_single_cases() -> None:
    verdict = evaluate(make_cases(400, 0).assign(terrain=np.arange(400) % 8), VELOCITY)
    # without failures each terrain counts as one case: 99 % at 90 % needs 230 terrains
    assert (verdict.status, verdict.terrains, verdict.plain_status) == (Status.INSUFFICIENT, 8, Status.PASS)
    assert verdict.lower == proportion_lower(8, 8, 0.9)
    assert verdict.plain_lower == proportion_lower(400, 400, 0.9)
    assert verdict.additional_cases == 297 - 8
    for message in ("8 terrains", "every distribution of failure rates", "289 additional cases", "PASS"):
        assert message in verdict.note
    many_terrains = evaluate(make_cases(460, 0).assign(terrain=np.arange(460) % 230), VELOCITY)
    assert many_terrains.status is Status.PASS


def test_additional_cases_lead_to_pass_on_new_terrains() -> None:
    # 6 of 50 terrains fail with one of their 5 cases
    frame = make_cases(250, 0).assign(terrain=np.arange(250) // 5)
    frame.loc[5 * np.arange(6), "velocity_error_m_s"] = 6.0
    verdict = evaluate(frame, VELOCITY, probability=0.95)
    assert verdict.status is Status.INSUFFICIENT
    assert (verdict.clustered.failed_terrains, verdict.clustered.failure_pairs) == (6, 0)
    assert verdict.additional_cases
    extended_rows = pd.concat(
        [frame, make_cases(verdict.additional_cases, 0).assign(terrain=lambda rows: 60 + rows.index)]
    )
    extended_rows["case"] = np.arange(len(extended_rows))
    requirements, design = [{**VELOCITY, "probability": 0.95}], SamplingDesign(first_look=250)
    (later,) = evaluate_requirements(extended_rows, requirements, design)
    assert later.status is Status.PASS
    (earlier,) = evaluate_requirements(extended_rows.iloc[:-1], requirements, design)
    assert earlier.status is Status.INSUFFICIENT


def test_verdict_of_925_answers_on_243_terrains_with_one_failure() -> None:
    """1,000 descents on 250 terrains drawn at random, 925 answers, one wrong: a terrain is missing for a PASS.

    Independent cases would need 388 answers. With 243 terrains, 0.99^243 = 0.087 without a failure leaves nearly no
    room for one failure and for the rate of answers, which the terrains can also determine.
    """
    rng = np.random.default_rng(250)
    terrain, answered = rng.integers(0, 250, 1000), rng.permutation(1000) < 925
    frame = make_cases(1000, 0).assign(terrain=terrain, answered=answered)
    frame.loc[np.flatnonzero(answered)[0], "velocity_error_m_s"] = 6.0
    verdict = evaluate(frame, VELOCITY)
    assert (verdict.status, verdict.plain_status) == (Status.INSUFFICIENT, Status.PASS)
    assert 0.98 < verdict.lower < 0.99
    # one case on each of 1,000 terrains: the bound of independent cases
    assert evaluate(frame.assign(terrain=np.arange(1000)), VELOCITY).status is Status.PASS


def _make_terrain_design(bank: int, **dispersion: Any) -> SamplingDesign:
    return read_sampling_design(
        {
            "parameters": {"location": {"bank": bank}},
            "dispersions": {"location.terrain": dispersion} if dispersion else {},
        }
    )


def test_advice_contains_the_necessary_number_of_terrains() -> None:
    """8 terrains cannot show 99 % at 90 % confidence, so no number of additional cases is given."""
    frame = make_cases(400, 0).assign(terrain=np.arange(400) % 8)
    design = _make_terrain_design(8, distribution="integer", low=0, high="location.bank - 1")
    (verdict,) = evaluate_requirements(frame, [VELOCITY], design)
    assert (verdict.status, verdict.additional_cases) == (Status.INSUFFICIENT, None)
    message = (
        "To show a success rate of 99 % at 90 % confidence, the cases must include at least 230 different terrains. "
        "The campaign has only 8 terrains (location.bank = 8). Run the campaign again with 230 cases, each on a "
        "terrain of its own: --set location.bank=230 --set "
        """'dispersions."location.terrain"={distribution="in-turn",low=0,high=229}' -n 230."""
    )
    assert message in verdict.note
    assert message in combine_verdicts([verdict], frame).sentence
    assert "additional case" not in combine_verdicts([verdict], frame).sentence
    in_turn = _make_terrain_design(8, distribution="in-turn", low=0, high="location.bank - 1")
    assert "--set location.bank=230 -n 230" in evaluate_requirements(frame, [VELOCITY], in_turn)[0].note
    fixed_terrain = evaluate_requirements(frame.assign(terrain=0), [VELOCITY], _make_terrain_design(8))[0]
    assert "has only 1 terrain (location.terrain = 1)" in fixed_terrain.note
    narrow_dispersion = _make_terrain_design(100, distribution="integer", low=0, high=7)
    assert 'dispersions."location.terrain"' in evaluate_requirements(frame, [VELOCITY], narrow_dispersion)[0].note
    large_bank = _make_terrain_design(1000, distribution="integer", low=0, high="location.bank - 1")
    assert evaluate_requirements(frame, [VELOCITY], large_bank)[0].additional_cases == 289


def test_evaluations_of_an_adaptive_campaign_share_the_risk() -> None:
    # evaluations at 20, 40, 80, 160, 320 and 640 cases; the last has half of the cases and spends half of the risk
    design = SamplingDesign(max_cases=640)
    (early,) = evaluate_requirements(make_cases(320, 0), [VELOCITY], design)
    assert early.bounds_confidence == pytest.approx(1.0 - 0.1 * 160 / 640)
    assert early.lower == proportion_lower(320, 320, early.bounds_confidence)
    (last,) = evaluate_requirements(make_cases(640, 0), [VELOCITY], design)
    assert last.status is Status.PASS
    assert last.bounds_confidence == pytest.approx(0.95)
    assert "evaluated more than once" in last.note


def test_one_terrain_per_case_gives_no_note() -> None:
    verdict = evaluate(make_cases(20, 0), VELOCITY)
    assert (verdict.terrains, verdict.clustered, verdict.note) == (20, None, "")


def test_cases_of_unknown_terrain_are_independent() -> None:
    frame = make_cases(20, 3).assign(terrain=[np.nan, np.nan, *range(18)])
    assert evaluate(frame, VELOCITY).clustered is None
    assert evaluate(frame.assign(terrain=np.nan), VELOCITY).terrains is None
