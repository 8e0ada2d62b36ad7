"""Tests of the joint evidence of confirmations, and of campaigns that are not finished.

The examples have a true success rate exactly at the limit of the requirement: every PASS is wrong.
"""

import bisect
import json

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from marsyard.cli.outcome import evaluate_and_report
from marsyard.cli.terminal import create_console
from marsyard.reports.campaign_report import write_evaluation
from marsyard.reports.case_evidence import CaseEvidence, RequirementEvidence
from marsyard.reports.dashboard.entries import read_entries
from marsyard.reports.decision import collect_evidence, evaluate_requirements
from marsyard.reports.evaluation import evaluate_run
from marsyard.reports.sampling_design import INDEPENDENT, SamplingDesign
from marsyard.reports.verdicts import Status
from marsyard.result import open_result
from tests.reports.synthetic_run import VELOCITY, MakeRun

RATE, CONFIDENCE = 0.9, 0.9
REQUIREMENT = {**VELOCITY, "population": "all", "probability": RATE, "confidence": CONFIDENCE}


def make_frame(rng: np.random.Generator, cases: int) -> pd.DataFrame:
    """Draw rows of which each meets the requirement with the required rate."""
    fails = rng.random(cases) >= RATE
    return pd.DataFrame(
        {
            "case": np.arange(cases),
            "outcome": "VALID",
            "answered": True,
            "terrain": np.arange(cases),
            "velocity_error_m_s": np.where(fails, 9.0, 1.0),
        }
    )


def make_evidence(cases: int, failures: int) -> RequirementEvidence | None:
    """Create the evidence of earlier confirmations, of which the first has 60 cases; None without cases."""
    if not cases:
        return None
    success = np.arange(cases) >= failures
    part = CaseEvidence(success, np.ones(cases, dtype=bool), None, np.arange(cases) < 60, contains_first=True)
    return RequirementEvidence(part, part)


def count_deciding_failures(look: int) -> tuple[int, int]:
    """Return the largest number of failures with PASS, and the smallest with FAIL, after `look` confirmations."""
    frame = make_frame(np.random.default_rng(1), 60)
    frame["velocity_error_m_s"] = 1.0

    def evaluate(failures: int) -> Status:
        own = max(0, failures - 60 * (look - 1))
        frame["velocity_error_m_s"] = np.where(np.arange(60) < own, 9.0, 1.0)
        earlier = make_evidence(60 * (look - 1), failures - own)
        return evaluate_requirements(frame, [REQUIREMENT], earlier=[earlier])[0].status

    counts = range(60 * look + 1)
    largest_pass = bisect.bisect_left(counts, True, key=lambda count: evaluate(count) is not Status.PASS) - 1
    return largest_pass, bisect.bisect_left(counts, True, key=lambda count: evaluate(count) is Status.FAIL)


@pytest.mark.slow
def test_repeated_confirmations_keep_the_risk_of_a_wrong_pass() -> None:
    """Exact probability of PASS in up to 20 confirmations of 60 cases, repeated until one passes; FAIL is final."""
    undecided, passed = np.ones(1), 0.0
    for look in range(1, 21):
        undecided = np.convolve(undecided, stats.binom.pmf(np.arange(61), 60, 1.0 - RATE))
        largest_pass, smallest_fail = count_deciding_failures(look)
        passed += undecided[: largest_pass + 1].sum()
        undecided[: largest_pass + 1] = 0.0
        undecided[smallest_fail:] = 0.0
    assert 0.05 < passed <= 1.0 - CONFIDENCE


CASES = st.tuples(st.booleans(), st.booleans(), st.integers(0, 5), st.booleans())


@given(st.lists(CASES, min_size=1, max_size=40), st.booleans())
def test_counts_in_the_record_keep_the_evidence(cases: list[tuple[bool, bool, int, bool]], is_labelled: bool) -> None:
    success, member, terrain, in_first_look = (np.array(values) for values in zip(*cases, strict=True))
    names, groups = np.unique(terrain, return_inverse=True)
    labels = tuple(f"terrain {name}" for name in names) if is_labelled else None
    evidence = CaseEvidence(success & member, member, groups, in_first_look, labels)
    rows = json.loads(json.dumps(evidence.to_rows()))
    restored = CaseEvidence.from_rows(rows, is_first=True)
    assert sorted(restored.to_rows()) == sorted(rows)
    assert (restored.n, restored.failures) == (evidence.n, evidence.failures)
    assert restored.success.size == len(cases)
    joined = evidence.join(restored)
    assert len(np.unique(joined.terrain_groups)) == len(names) * (1 if is_labelled else 2)
    assert not CaseEvidence.from_rows(rows, is_first=False).in_first_look.any()
    # the terrains whose first case belongs to the population: the record cannot add one
    terrains = [
        {int(part.groups[first]) for first in np.unique(part.groups, return_index=True)[1] if part.member[first]}
        for part in (evidence, restored)
        if part.groups is not None
    ]
    assert len(terrains[1]) <= len(terrains[0])


def test_all_confirmations_have_the_same_verdict_if_answers_depend_on_the_terrain() -> None:
    """1 % of the terrains have only wrong answers, the others few answers: 9 % of the answers are wrong, not 3 %."""
    requirement = {**REQUIREMENT, "population": "valid", "probability": 0.97}

    def rows(terrains: int) -> pd.DataFrame:
        terrain, case = np.divmod(np.arange(10 * terrains), 10)
        is_wrong, has_answer = terrain % 100 == 99, case == 1 + terrain % 9
        return pd.DataFrame(
            {
                "case": np.arange(10 * terrains),
                "outcome": "VALID",
                "answered": is_wrong | has_answer,
                "terrain": terrain,
                "velocity_error_m_s": np.where(is_wrong, 9.0, 1.0),
            }
        )

    frames = [rows(40), rows(900), rows(50)]
    parts = [collect_evidence(frame, requirement, INDEPENDENT, has_own_terrains=True) for frame in frames]
    verdicts = []
    for own, frame in enumerate(frames):
        others = [
            RequirementEvidence.from_table(part.to_table(), is_first=number == 0)
            for number, part in enumerate(parts)
            if part is not None and number != own
        ]
        verdicts += evaluate_requirements(frame, [requirement], earlier=[others[0].join(others[1])])
    assert len({(verdict.status, verdict.lower, verdict.upper) for verdict in verdicts}) == 1
    assert not verdicts[0].status.is_met


def test_confirmations_share_terrains_also_if_a_case_has_none() -> None:
    """A crashed case without a terrain changes the type of the column, but not the terrains of the others."""
    frame = make_frame(np.random.default_rng(1), 10)
    with_crashes = frame.assign(terrain=[*range(8), np.nan, np.nan])
    first, second = (
        collect_evidence(rows, REQUIREMENT, INDEPENDENT, has_own_terrains=False) for rows in (frame, with_crashes)
    )
    assert first is not None
    assert second is not None
    # ten terrains of the first confirmation, and two unknown ones of the second
    assert first.join(second).population.terrains == 12


def test_later_confirmations_use_the_sequential_test() -> None:
    """The first look keeps the ordinary bounds; the same cases after an earlier look need more evidence."""
    frame = make_frame(np.random.default_rng(1), 22)
    frame["velocity_error_m_s"] = 1.0
    (first,) = evaluate_requirements(frame, [REQUIREMENT])
    part = collect_evidence(frame.head(5), REQUIREMENT, INDEPENDENT, has_own_terrains=True)
    part = RequirementEvidence.from_table(part.to_table(), is_first=True)
    (later,) = evaluate_requirements(frame.tail(17), [REQUIREMENT], earlier=[part])
    assert (first.n, later.n, first.status, later.status) == (22, 22, Status.PASS, Status.INSUFFICIENT)
    assert later.bounds_confidence > first.bounds_confidence == CONFIDENCE


def test_confirmation_until_decided_has_an_open_end() -> None:
    design = SamplingDesign(max_cases=1000).with_open_end
    assert (design.max_cases, design.first_look) == (None, 31)
    assert INDEPENDENT.with_open_end is INDEPENDENT


def test_pass_needs_verified_rows(make_run: MakeRun) -> None:
    frame = make_frame(np.random.default_rng(1), 60).assign(velocity_error_m_s=1.0)
    directory = make_run(
        frame, [REQUIREMENT, {**REQUIREMENT, "id": "RATE", "decide_by": "estimate", "accept_rate": True}]
    )
    assert evaluate_run(directory).exit_code == 0
    (directory / "cases.sqlite").unlink()
    evaluation = evaluate_run(directory)
    assert (evaluation.overall_verdict.word, evaluation.exit_code) == ("PASS (unverified)", 4)
    page = write_evaluation(evaluation)
    report = json.loads((directory / "report.json").read_text())
    assert (report["verdict"], report["exit_code"], report["verdicts"][0]["status"]) == (
        "PASS (unverified)", 4, "PASS (unverified)"
    )  # fmt: skip
    assert "The rows are not verified" in page.read_text()
    (entry,), _ = read_entries([directory], directory.parent / "pages")
    assert entry.report.verdict == "PASS (unverified)"


@pytest.mark.parametrize("cases", [[*range(46)], [0] * 60, [*range(1, 61)], [*range(59), 60]])
def test_pass_needs_one_row_for_each_case(make_run: MakeRun, cases: list[int]) -> None:
    """Removed, repeated and renumbered rows; without them 46 of 60 cases would be PASS."""
    frame = make_frame(np.random.default_rng(1), 60).assign(velocity_error_m_s=1.0)
    rows = frame.head(len(cases)).assign(case=cases)
    evaluation = evaluate_run(make_run(rows, [REQUIREMENT], cases=60))
    assert (evaluation.overall_verdict.word, evaluation.exit_code) == ("INSUFFICIENT", 3)
    assert evaluation.overall_verdict.sentence.startswith("The rows are not those of 60 cases")


def test_removed_entry_of_appended_cases_gives_no_verdict(make_run: MakeRun) -> None:
    """Bounds of one look would be tighter."""
    frame = make_frame(np.random.default_rng(1), 60).assign(velocity_error_m_s=1.0)
    directory = make_run(frame, [REQUIREMENT], cases=60)
    path = directory / "campaign.json"
    record = json.loads(path.read_text())
    for blocks, word in (({"cases": 40, "appended": [20]}, "PASS (exploration)"), ({"cases": 40}, "INSUFFICIENT")):
        path.write_text(json.dumps(record | {"definition": record["definition"] | blocks}))
        assert evaluate_run(directory).overall_verdict.word == word


@pytest.mark.parametrize("state", ["running", "interrupted", "shard"])
def test_unfinished_campaign_is_insufficient_everywhere(make_run: MakeRun, state: str) -> None:
    frame = make_frame(np.random.default_rng(1), 60)
    frame["velocity_error_m_s"] = 1.0
    directory = make_run(frame, [REQUIREMENT])
    assert evaluate_run(directory).overall_verdict.status is Status.PASS
    path = directory / "campaign.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"state": state, "cases": 400}))
    evaluation = evaluate_run(directory)
    assert (evaluation.overall_verdict.word, evaluation.exit_code) == ("INSUFFICIENT", 3)
    (verdict,) = evaluation.verdicts
    assert (verdict.status, np.isnan(verdict.lower)) == (Status.INSUFFICIENT, True)
    assert verdict.reason == "The campaign is not finished (60 of 400 cases): a verdict needs all cases."
    assert open_result(directory).verdict == "INSUFFICIENT"
    if state == "interrupted":
        assert evaluate_and_report(directory, create_console()) == 3
    (entry,), problems = read_entries([directory], directory.parent / "pages")
    assert (entry.report.verdict, entry.report.verdicts[0].status, problems) == ("INSUFFICIENT", "INSUFFICIENT", [])
