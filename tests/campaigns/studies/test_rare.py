"""Tests of studies of rare violations: estimates, continuation after kill -9, replay, replicates, report and errors."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from scipy.stats import norm

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError, DefinitionError, StoreError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.replay import replay
from marsyard.campaigns.store import record
from marsyard.campaigns.studies.budget import start_budget
from marsyard.campaigns.studies.rare import continue_rare, start_rare
from marsyard.campaigns.studies.rare_decision import Basis, RareVerdict
from marsyard.campaigns.studies.results import BudgetParameters, RareParameters, RareResult, SearchParameters
from marsyard.reports.evaluation import evaluate_run
from tests.campaigns.fake_campaign import RecordingWatch, campaign_fixture, continuing_commands, read_case_rows, run
from tests.campaigns.killing import kill_and_resume
from tests.campaigns.studies.limit_state import CAMPAIGN
from tests.command import run_command
from tests.inline_workers import inline_workers_fixture

#: With a confidence of 0.99, the intervals of the fixed seeds contain the true probability norm.sf(3) = 0.00135.
PARAMETERS = RareParameters("LOAD", 5e-2, samples=100, replicates=(4,), random_cases=(50,), confidence=0.99)
#: Columns that differ between repeated runs.
TIMES = ("wall_time_s", "cpu_time_s")


_inline_workers = inline_workers_fixture()
campaign_path = campaign_fixture(CAMPAIGN)


def run_study(
    path: Path, directory: Path, parameters: RareParameters = PARAMETERS, *overrides: str, max_cases: int = 5000
) -> RareResult:
    campaign = load_campaign(str(path), overrides)
    return start_rare(campaign, parameters, max_cases, directory, ExecutorConfig(1), RecordingWatch())


@pytest.fixture
def finished_study(campaign_path: Path, tmp_path: Path) -> Path:
    assert run_study(campaign_path, tmp_path / "run").exit_code == 0
    return tmp_path / "run"


def rows_without_times(directory: Path) -> list[dict[str, object]]:
    return [{name: value for name, value in row.items() if name not in TIMES} for row in read_case_rows(directory)]


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.6])
def test_interval_contains_the_probability(campaign_path: Path, tmp_path: Path, noise: float) -> None:
    result = run_study(campaign_path, tmp_path / "run", PARAMETERS, f"noise={noise}")
    interval, counting = result.decision.interval, result.decision.counting
    assert interval.lower < norm.sf(3.0) < interval.upper
    # 50 random cases, and 100 of the first level of each of 4 replicates
    assert counting.cases == counting.units == 450
    assert counting.upper > norm.sf(3.0)
    assert result.verdict is RareVerdict.PASS
    assert result.decision.basis is Basis.COUNTING
    assert 0 < result.cases == len(read_case_rows(tmp_path / "run"))
    assert result.violations == sum(row["load"] > 100.0 for row in read_case_rows(tmp_path / "run"))


@pytest.mark.slow
def test_importance_sampling_interval_contains_the_probability(campaign_path: Path, tmp_path: Path) -> None:
    parameters = replace(PARAMETERS, max_probability=1e-2, method="importance", replicates=(3,), importance_cases=300)
    result = run_study(campaign_path, tmp_path / "run", parameters)
    assert result.decision.effective_violations is not None
    assert result.decision.effective_violations > 30.0
    with pytest.raises(CampaignError, match="no replicates can be added to a study with importance sampling"):
        continue_rare(tmp_path / "run", ExecutorConfig(1), RecordingWatch(), replicates=2)
    assert result.decision.interval.lower < norm.sf(3.0) < result.decision.interval.upper
    extended = continue_rare(tmp_path / "run", ExecutorConfig(1), RecordingWatch(), random_cases=40)
    assert extended.decision.counting.cases == result.decision.counting.cases + 40
    assert extended.decision.effective_violations == result.decision.effective_violations


@pytest.mark.slow
def test_margin_column_replaces_a_boolean_metric(campaign_path: Path, tmp_path: Path) -> None:
    by_bound = run_study(campaign_path, tmp_path / "bound")
    by_margin = run_study(campaign_path, tmp_path / "margin", replace(PARAMETERS, requirement="MARGIN"))
    assert by_margin.decision == by_bound.decision


@pytest.mark.slow
def test_killed_study_resumes_with_the_same_result(campaign_path: Path, tmp_path: Path) -> None:
    killed_run, reference_run = tmp_path / "killed", tmp_path / "whole"
    sizes = ["--samples", "50", "--replicates", "2", "--set", "sleep_s=0.03"]
    sizes += ["--random-cases", "20"]
    arguments = ["rare", str(campaign_path), "--requirement", "LOAD", "--max-probability", "0.1", *sizes]
    resume_result = kill_and_resume(arguments, killed_run, log_bytes=12_000)
    parameters = RareParameters("LOAD", 0.1, samples=50, replicates=(2,), random_cases=(20,))
    reference = run_study(campaign_path, reference_run, parameters, "sleep_s=0.03", max_cases=20_000)
    assert resume_result.returncode == reference.exit_code, resume_result.stderr
    assert "Probability of a violation per case" in resume_result.stdout
    assert rows_without_times(killed_run) == rows_without_times(reference_run)
    assert record.read(killed_run)["study"]["result"] == record.read(reference_run)["study"]["result"]


@pytest.mark.slow
def test_additional_replicates_narrow_the_interval(campaign_path: Path, tmp_path: Path) -> None:
    first = run_study(campaign_path, tmp_path / "run")
    rows = rows_without_times(tmp_path / "run")
    second = continue_rare(tmp_path / "run", ExecutorConfig(1), RecordingWatch(), replicates=5)
    assert len(second.replicates) == 9
    assert second.replicates[:4] == first.replicates
    # the second evaluation may use half of the risk of the first one, which has 0.5 % per side
    intervals = first.decision.interval, second.decision.interval
    assert [item.confidence for item in intervals] == pytest.approx([0.995, 0.9975])
    assert second.decision.counting.cases == first.decision.counting.cases + 500
    assert rows_without_times(tmp_path / "run")[: len(rows)] == rows
    assert intervals[1].upper / intervals[1].lower < intervals[0].upper / intervals[0].lower


@pytest.mark.slow
def test_case_of_a_study_replays(campaign_path: Path, tmp_path: Path) -> None:
    run_study(campaign_path, tmp_path / "run", PARAMETERS, "noise=0.5")
    # a late case of a Markov chain, in general with the random streams of an earlier case
    cases = [row["case"] for row in read_case_rows(tmp_path / "run")]
    for case in cases[-3:]:
        assert replay(tmp_path / "run", case).differing == ()
    with pytest.raises(CampaignError, match="has not run case"):
        replay(tmp_path / "run", cases[-1] + 1)


@pytest.mark.slow
def test_verdict_is_insufficient_at_the_limit_of_cases(campaign_path: Path, tmp_path: Path) -> None:
    parameters = replace(PARAMETERS, max_probability=1e-3)
    result = run_study(campaign_path, tmp_path / "run", parameters, max_cases=350)
    assert result.verdict is RareVerdict.INSUFFICIENT
    assert "limit of cases" in result.decision.reason
    # the random cases are run nevertheless, and those that are added later
    assert len(read_case_rows(tmp_path / "run")) <= 350 + 50
    counting = continue_rare(tmp_path / "run", ExecutorConfig(1), RecordingWatch(), random_cases=30).decision.counting
    assert counting.cases == result.decision.counting.cases + 30


@pytest.mark.slow
def test_finished_study_is_protected(finished_study: Path) -> None:
    """Commands of campaigns, another program, and a result without its decision."""
    executor, watch = ExecutorConfig(1), RecordingWatch()
    for command in continuing_commands(finished_study, watch):
        with pytest.raises(CampaignError, match="contains a study"):
            command()
    stored = record.read(finished_study)
    record.update(finished_study, {"identity": {**stored["identity"], "code": "other"}})
    with pytest.raises(CampaignError, match="another program"):
        continue_rare(finished_study, executor, watch)
    record.update(finished_study, {"identity": stored["identity"]})
    assert evaluate_run(finished_study).exit_code == 0
    result = {name: value for name, value in stored["study"]["result"].items() if name != "decision"}
    record.update(finished_study, {"study": {**stored["study"], "result": result}})
    with pytest.raises(StoreError):
        evaluate_run(finished_study)


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (RareParameters, {"samples": 10}, "--samples 10: at least 50"),
        (RareParameters, {"method": "guess"}, "--method guess: allowed: subset, importance"),
        (RareParameters, {"random_cases": (-1,)}, "--random-cases -1: at least 0"),
        (RareParameters, {"replicates": (1,)}, "--replicates 1: at least 2"),
        (RareParameters, {"max_probability": 0.0}, "--max-probability 0.0: allowed"),
        (RareParameters, {"importance_cases": 49}, "--importance-cases 49: at least 50"),
        (SearchParameters, {"cases": 19}, "--cases 19: at least 20"),
        (SearchParameters, {"restarts": 0}, "--restarts 0: at least 1"),
        (SearchParameters, {"max_failures": 0}, "--failures 0: at least 1"),
        (BudgetParameters, {"cases": 19}, "--cases 19: at least 20"),
        (BudgetParameters, {"sobol": 24}, "--sobol 24: allowed: 0, or a power of 2 from 16"),
        (BudgetParameters, {"confidence": 1.0}, "--confidence 1.0: allowed"),
    ],
)
def test_invalid_parameters_of_studies_are_reported(kind: type, values: dict[str, object], message: str) -> None:
    valid = {"requirement": "LOAD"} | ({"max_probability": 1e-2} if kind is RareParameters else {})
    with pytest.raises(CampaignError, match=message):
        kind(**valid | values)


@pytest.mark.parametrize(("requirement", "message"), [("LOADS", "did you mean 'LOAD'"), ("FLAG", "only true or false")])
def test_unsuitable_requirement_is_reported(
    campaign_path: Path, tmp_path: Path, requirement: str, message: str
) -> None:
    campaign, executor = load_campaign(str(campaign_path)), ExecutorConfig(1)
    with pytest.raises(CampaignError, match=message):
        start_rare(campaign, RareParameters(requirement, 1e-2), 5000, tmp_path / "run", executor, RecordingWatch())
    with pytest.raises(CampaignError, match=message):
        start_budget(campaign, BudgetParameters(requirement), tmp_path / "run", executor, RecordingWatch())
    assert not (tmp_path / "run").exists()


def test_grid_dispersions_are_rejected(campaign_path: Path, tmp_path: Path) -> None:
    grid = 'kind = { distribution = "grid", values = ["plain", "rough"] }'
    campaign_path.write_text(CAMPAIGN.replace('kind = { distribution = "choice", values = ["plain", "rough"] }', grid))
    with pytest.raises(CampaignError, match=r"dispersions\.kind: is a distribution 'grid'"):
        run_study(campaign_path, tmp_path / "run")


def test_campaign_file_cannot_be_adaptive(campaign_path: Path) -> None:
    with pytest.raises(DefinitionError, match="adaptive is for studies"):
        load_campaign(str(campaign_path), ["design.kind=adaptive"])


@pytest.mark.slow
def test_report_shows_the_verdict_of_the_study(campaign_path: Path, tmp_path: Path) -> None:
    options = ["--requirement", "LOAD", "--max-probability", "1e-2", "--samples", "100", "--jobs", "1"]
    status, output = run_command("rare", campaign_path, *options, "--out", tmp_path / "run")
    assert status == 0, output
    assert "LOAD: PASS, by counting independent cases." in output
    assert "independent random cases" in output
    data = json.loads((tmp_path / "run" / "report.json").read_text())
    assert (data["verdict"], data["exit_code"], data["verdicts"]) == ("PASS", 0, [])
    assert data["sections"]["rare"]["decision"]["interval"]["lower"] < norm.sf(3.0)
    page = (tmp_path / "run" / "report.html").read_text()
    assert "Probability of a rare violation" in page
    assert "No requirement is evaluated" not in page


def test_verdict_on_a_calibration_seed_cannot_be_pass(campaign_path: Path, tmp_path: Path) -> None:
    run = '[[calibration.runs]]\noptions = ["beta"]\ncampaign = "limit-state"\nseed = 3'
    campaign_path.write_text(f"{CAMPAIGN}\n[calibration]\n\n{run}\n")
    result = run_study(campaign_path, tmp_path / "run")
    assert (result.verdict, result.exit_code) == (RareVerdict.INSUFFICIENT, 3)
    assert result.decision.reason.startswith("The verdict would be PASS. Calibrated on these cases")


@pytest.mark.slow
def test_cases_on_one_terrain_are_not_counted_as_independent(campaign_path: Path, tmp_path: Path) -> None:
    parameters = RareParameters("LOAD", 5e-2, samples=100, replicates=(2,), random_cases=(50,))
    # without terrains, 250 cases without a violation are enough for a limit of 5 %
    assert run_study(campaign_path, tmp_path / "cases", parameters, "beta=5").verdict is RareVerdict.PASS
    terrain = 'terrain = { distribution = "integer", low = 0, high = 9 }'
    campaign_path.write_text(CAMPAIGN.replace("[dispersions]", f"[dispersions]\n{terrain}"))
    result = run_study(campaign_path, tmp_path / "terrains", parameters, "beta=5")
    assert result.verdict is RareVerdict.INSUFFICIENT
    assert (result.decision.counting.cases, result.decision.counting.units) == (250, 10)
    assert result.decision.additional_random_cases is not None


@pytest.mark.slow
def test_printed_number_of_random_cases_decides(campaign_path: Path, tmp_path: Path) -> None:
    directory = tmp_path / "run"
    options = ["--max-probability", "1e-2", "--samples", "50", "--replicates", "2", "--random-cases", "50"]
    options += ["--set", "beta=5", "--jobs", "1", "--max-cases", "1500"]
    status, output = run_command("rare", campaign_path, "--requirement", "LOAD", *options, "--out", directory)
    assert status == 3, output
    # the second evaluation has a risk of 2.5 %: 367.0 = ln(0.025) / ln(0.99) cases, of which 150 are finished
    advice = re.search(r"marsyard append DIR (\d+) --random", output)
    assert advice is not None
    assert int(advice[1]) == 368 - 150
    status, output = run_command("append", directory, advice[1], "--random", "--jobs", 1)
    assert status == 0, output
    assert "from 0 violations in 368 independent random cases" in output


def test_random_cases_are_rejected_for_a_campaign(campaign_path: Path, tmp_path: Path) -> None:
    run(campaign_path, tmp_path / "run", RecordingWatch(), "cases=1")
    status, output = run_command("append", tmp_path / "run", 10, "--random")
    assert (status, "--random is for studies" in " ".join(output.split())) == (2, True)
