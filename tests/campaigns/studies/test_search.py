"""Tests of the search for violations: a planted defect is found and reduced; continuation, files, report and errors."""

import json
import math
import tomllib
from collections.abc import Sequence
from pathlib import Path

import pytest
from scipy.special import ndtri

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.replay import replay
from marsyard.campaigns.sampling.study_points import POINT_COLUMN, StudyPoint
from marsyard.campaigns.store import record
from marsyard.campaigns.studies.rare import continue_rare
from marsyard.campaigns.studies.results import SearchParameters, SearchResult
from marsyard.campaigns.studies.runner import prepare_campaign
from marsyard.campaigns.studies.search import SearchStudy, start_search
from tests.campaigns.fake_campaign import RecordingWatch, campaign_fixture
from tests.campaigns.killing import kill_and_resume
from tests.campaigns.studies import limit_state
from tests.campaigns.studies.planted_defect import CAMPAIGN
from tests.command import run_command
from tests.inline_workers import inline_workers_fixture

_inline_workers = inline_workers_fixture()
campaign_path = campaign_fixture(CAMPAIGN)


def run_search(
    path: Path, directory: Path, parameters: SearchParameters, *, seed: int = 1, max_cases: int = 5000
) -> SearchResult:
    campaign = load_campaign(str(path), (), None, seed)
    return start_search(campaign, parameters, max_cases, directory, ExecutorConfig(1), RecordingWatch())


def assert_reduced_to_causes(result: SearchResult) -> None:
    """Assert that the search found the defect within 300 cases, and that its first failure has only the two causes."""
    assert result.first_violation is not None
    assert result.first_violation <= result.search_cases <= 300
    failure = result.failures[0]
    assert set(failure.values) == {"sun_deg", "yaw_deg"}
    assert 10.0 <= failure.values["sun_deg"] < 15.0
    assert 80.0 <= failure.values["yaw_deg"] <= 100.0
    # the case violates the requirement in all four repetitions with new random streams
    assert failure.repeated == failure.repetitions == 4


def test_planted_defect_is_found_and_reduced_to_its_two_causes(campaign_path: Path, tmp_path: Path) -> None:
    result = run_search(campaign_path, tmp_path / "run", SearchParameters("VELOCITY"))
    assert_reduced_to_causes(result)
    assert replay(tmp_path / "run", result.failures[0].case).differing == ()


def test_search_in_one_dispersion_uses_all_its_cases(tmp_path: Path) -> None:
    other_dispersions = ('"loads.1" =', "kind =")
    lines = [line for line in limit_state.CAMPAIGN.splitlines() if not line.startswith(other_dispersions)]
    (tmp_path / "campaign.toml").write_text("\n".join(lines))
    campaign = prepare_campaign(load_campaign(str(tmp_path / "campaign.toml"), ["beta=2"]), 5000)
    study = SearchStudy(campaign, SearchParameters("LOAD", cases=100), DirectRunner(campaign))  # type: ignore[arg-type]
    result = study.run(RecordingWatch())
    # a generation of three strategies has 12 cases
    assert 100 - 12 < result.search_cases <= 100
    assert set(result.failures[0].values) == {"loads.0"}


class DirectRunner:
    """Runs the cases of a study in this process, without a store."""

    def __init__(self, campaign: Campaign) -> None:
        self.campaign, self.n_cases = campaign, 0

    def run(self, points: Sequence[StudyPoint]) -> list[dict[str, object]]:
        rows: list[dict[str, object]] = []
        for new_point in points:
            point = new_point.with_numbers(self.n_cases)
            result = self.campaign.scenario.run(
                self.campaign.with_values(self.campaign.draws_at(point)), self.campaign.streams(point.stream)
            )
            rows.append({"outcome": result.outcome, "answered": True, **result.row, POINT_COLUMN: point.text})
            self.n_cases += 1
        return rows


def test_planted_defect_is_found_with_other_seeds(campaign_path: Path) -> None:
    for seed in range(2, 12):
        campaign = prepare_campaign(load_campaign(str(campaign_path), (), None, seed), 5000)
        runner = DirectRunner(campaign)
        study = SearchStudy(campaign, SearchParameters("VELOCITY"), runner)  # type: ignore[arg-type]  # no store
        assert_reduced_to_causes(study.run(RecordingWatch()))


def test_reduced_violation_has_the_distance_of_its_values_also_in_a_correlated_group(tmp_path: Path) -> None:
    """Sun elevation follows the dust, which is not a cause; the distance is that of the sun elevation itself."""
    group = '[[correlations]]\nparameters = ["dust", "sun_deg"]\nrank = [[1.0, 0.95], [0.95, 1.0]]\n'
    path = tmp_path / "campaign.toml"
    path.write_text(CAMPAIGN.replace("[[requirements]]", f"{group}\n[[requirements]]"))
    campaign = prepare_campaign(load_campaign(str(path)), 5000)
    study = SearchStudy(campaign, SearchParameters("VELOCITY"), DirectRunner(campaign))  # type: ignore[arg-type]
    result = study.run(RecordingWatch())
    assert_reduced_to_causes(result)
    failure = result.failures[0]
    numbers = ndtri([(failure.values["sun_deg"] - 10.0) / 50.0, failure.values["yaw_deg"] / 360.0])
    assert failure.distance == pytest.approx(math.hypot(*numbers))


def test_campaign_without_violation_reports_the_smallest_margin(tmp_path: Path) -> None:
    path = tmp_path / "limit-state.toml"
    path.write_text(limit_state.CAMPAIGN)
    campaign = load_campaign(str(path), ["beta=20.0"])
    result = start_search(
        campaign, SearchParameters("LOAD", 60), 999, tmp_path / "run", ExecutorConfig(1), RecordingWatch()
    )
    assert (result.violations, result.failures, result.exit_code) == (0, (), 0)
    # the evolution strategies approach the corner (4, 4) of the allowed coordinates, at a margin of 20 - 8 / sqrt(2)
    assert 14.3 < result.min_margin < 18.0


def test_limit_of_cases_ends_the_search(campaign_path: Path, tmp_path: Path) -> None:
    result = run_search(campaign_path, tmp_path / "run", SearchParameters("VELOCITY"), max_cases=200)
    assert "limit of cases" in result.reason
    assert result.cases <= 200


@pytest.mark.slow
def test_killed_search_resumes_with_the_same_result(campaign_path: Path, tmp_path: Path) -> None:
    killed_run, reference_run = tmp_path / "killed", tmp_path / "whole"
    arguments = ["search", str(campaign_path), "--requirement", "VELOCITY", "-n", "150"]
    resume_result = kill_and_resume(arguments, killed_run, log_bytes=20_000)
    reference = run_search(campaign_path, reference_run, SearchParameters("VELOCITY", 150))
    assert resume_result.returncode == reference.exit_code == 1, resume_result.stderr
    assert record.read(killed_run)["study"]["result"] == record.read(reference_run)["study"]["result"]
    # the campaign file of the reduced violation violates the requirement in each of its cases
    (plan,) = tomllib.loads((killed_run / "failures" / "nightly.toml").read_text())["campaigns"][:1]
    file = killed_run / "failures" / plan["campaign"]
    assert run_command("run", file, "--out", tmp_path / "regression", "--jobs", 1)[0] == 1
    data = json.loads((killed_run / "report.json").read_text())
    assert data["verdict"] == "FAIL"
    assert data["sections"]["search"]["failures"][0]["values"].keys() == {"sun_deg", "yaw_deg"}
    assert "Reduced violations" in (killed_run / "report.html").read_text()


def test_search_has_no_replicates_and_no_rates(campaign_path: Path, tmp_path: Path) -> None:
    run_search(campaign_path, tmp_path / "run", SearchParameters("VELOCITY", 20))
    with pytest.raises(CampaignError, match="does not contain a study of rare violations"):
        continue_rare(tmp_path / "run", ExecutorConfig(1), RecordingWatch())
    status, output = run_command("compare", tmp_path / "run", tmp_path / "run")
    assert (status, "contains a study" in output) == (2, True)
