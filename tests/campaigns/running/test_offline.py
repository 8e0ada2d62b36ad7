"""Tests of offline evaluation: measurements are exported, and the answers of an external algorithm are scored."""

from pathlib import Path
from typing import NamedTuple

import pytest

from marsyard.algorithms.dimes.baselines import HomographyEstimator
from marsyard.algorithms.exchange import read_case
from marsyard.algorithms.interface import VelocityEstimate
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError, StoreError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.campaigns.running.export_scoring import (
    create_scoring_campaign,
    export_campaign,
    find_cases_with_changed_images,
    truth_folder,
)
from marsyard.campaigns.running.replay import differing_columns
from marsyard.sim.measurements import DescentMeasurements
from tests.campaigns.fake_campaign import RecordingWatch, read_case_rows
from tests.inline_workers import inline_workers_fixture

_inline_workers = inline_workers_fixture()
N_CASES = 3
CAMPAIGN = f"""
name = "fake-velocity"
scenario = "tests.campaigns.fake_velocity:FakeVelocityScenario"
cases = {N_CASES}
seed = 3
[[requirements]]
id = "v"
metric = "velocity_error_m_s"
bound = 5.0
probability = 0.5
confidence = 0.5
"""


class ExportFolders(NamedTuple):
    """Folders of an exported campaign: measurements of the cases, and ground truth."""

    directory: Path
    truth: Path


@pytest.fixture(scope="module")
def export(tmp_path_factory: pytest.TempPathFactory) -> ExportFolders:
    """Export a campaign of three cases."""
    folder = tmp_path_factory.mktemp("offline")
    (folder / "fake.toml").write_text(CAMPAIGN)
    folders = ExportFolders(folder / "out", truth_folder(folder / "out"))
    export_campaign(load_campaign_to_export(folders), *folders, ExecutorConfig(1), RecordingWatch())
    return folders


def load_campaign_to_export(export: ExportFolders, *overrides: str) -> Campaign:
    """Load the campaign with the algorithm `export:FOLDER`, which writes the measurements of the cases to a folder."""
    path = str(export.directory.parent / "fake.toml")
    return load_campaign(path, ["retain.showcase=none", *overrides], None, None, [f"export:{export.directory}"])


def estimate_exported_cases(export: ExportFolders) -> dict[int, VelocityEstimate]:
    """Run an estimator on the exported files only."""
    estimates = {}
    for folder in sorted((export.directory / "cases").iterdir()):
        measurements = read_case(folder)
        assert isinstance(measurements, DescentMeasurements)
        estimates[int(folder.name)] = HomographyEstimator().estimate(measurements)
    return estimates


def write_answers(path: Path, answers: dict[int, VelocityEstimate]) -> Path:
    """Write a table of answers in the format of external algorithms."""
    lines = ["case,outcome,velocity_east_m_s,velocity_north_m_s"]
    for case, estimate in answers.items():
        numbers = ["", ""] if estimate.velocity_m_s is None else [repr(float(value)) for value in estimate.velocity_m_s]
        lines.append(",".join([str(case), estimate.outcome.name, *numbers]))
    path.write_text("\n".join(lines))
    return path


@pytest.mark.slow
def test_external_answers_are_scored_as_in_a_normal_run(export: ExportFolders, tmp_path: Path) -> None:
    watch = RecordingWatch()
    answers = write_answers(tmp_path / "external.csv", estimate_exported_cases(export))
    scoring_campaign = create_scoring_campaign(*export, answers)
    run_campaign(scoring_campaign, tmp_path / "scored", ExecutorConfig(1), watch)
    normal_campaign = load_campaign(str(export.directory.parent / "fake.toml"))
    run_campaign(normal_campaign, tmp_path / "normal", ExecutorConfig(1), watch)
    for row, normal_row in zip(read_case_rows(tmp_path / "scored"), read_case_rows(tmp_path / "normal"), strict=True):
        assert differing_columns(row, normal_row) == ("algorithm",)
        assert row["algorithm"] == "external"
        assert row["velocity_error_m_s"] < 1.0
    assert find_cases_with_changed_images(export.truth, tmp_path / "scored") == []
    assert watch.notes == []


def test_truth_is_stored_in_a_separate_folder(export: ExportFolders) -> None:
    rows = read_case_rows(export.truth)
    # the true east velocity of the fake descent is 12 m/s
    assert [row["velocity_true_x_m_s"] for row in rows] == [12.0] * N_CASES
    files = sorted(path.relative_to(export.directory).as_posix() for path in export.directory.rglob("*"))
    assert {name for name in files if "/" not in name} == {"README.md", "cases", "export.json"}
    assert not any("12.0" in path.read_text() for path in export.directory.glob("*.*"))
    with pytest.raises(CampaignError, match="is inside"):
        export_campaign(
            load_campaign_to_export(export),
            export.directory,
            export.directory / "truth",
            ExecutorConfig(1),
            RecordingWatch(),
        )


def test_export_resumes_and_rejects_other_exports(export: ExportFolders) -> None:
    times = {path: path.stat().st_mtime_ns for path in (export.directory / "cases").rglob("*")}
    export_campaign(load_campaign_to_export(export), *export, ExecutorConfig(1), RecordingWatch())
    assert {path: path.stat().st_mtime_ns for path in times} == times
    with pytest.raises(StoreError, match="contains the truth of another export"):
        export_campaign(load_campaign_to_export(export, "seed=4"), *export, ExecutorConfig(1), RecordingWatch())
    new_truth = ExportFolders(export.directory, export.truth.with_name("new-truth"))
    with pytest.raises(StoreError, match="already exists and is not empty"):
        export_campaign(load_campaign_to_export(export), *new_truth, ExecutorConfig(1), RecordingWatch())


def test_tables_with_missing_or_unknown_cases_are_rejected(export: ExportFolders, tmp_path: Path) -> None:
    answers = estimate_exported_cases(export)
    incomplete = write_answers(tmp_path / "incomplete.csv", {case: answers[case] for case in (0, 2)})
    with pytest.raises(CampaignError, match=r"no answer to 1 of 3 cases: 1; .*such as NO_TEMPLATE_AREA"):
        create_scoring_campaign(*export, incomplete)
    unknown_case = write_answers(tmp_path / "unknown-case.csv", {**answers, 7: answers[0]})
    with pytest.raises(CampaignError, match="unknown case 7; allowed: 0 to 2"):
        create_scoring_campaign(*export, unknown_case)
    with pytest.raises(CampaignError, match="No such file"):
        create_scoring_campaign(*export, tmp_path / "none.csv")
    with pytest.raises(StoreError, match="contains no finished export"):
        create_scoring_campaign(tmp_path, export.truth, incomplete)


def test_target_trackers_cannot_be_exported(tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match="a target tracker cannot run offline"):
        load_campaign("vtt-checkout-1", [], 1, None, [f"export:{tmp_path}"])
