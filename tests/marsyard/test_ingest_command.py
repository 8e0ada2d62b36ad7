"""Tests of `marsyard ingest`: campaigns from recorded images; invalid input leaves no files."""

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from marsyard.campaigns.definition.loading import create_campaign, load_campaign
from marsyard.campaigns.errors import CampaignError, DefinitionError
from marsyard.campaigns.studies.runner import prepare_campaign
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.scenarios.conformance import inputs
from tests.command import run_command
from tests.scenarios.measured.folders import read_rows, write_landing_folder, write_text_rows, write_velocity_folder


@pytest.mark.slow
def test_ingested_images_are_run_and_reported(tmp_path: Path) -> None:
    folder, cases, run = (
        write_landing_folder(tmp_path / "in", inputs.landing(), "matching"),
        tmp_path / "out",
        tmp_path / "run",
    )
    status, output = run_command("ingest", str(folder), "--out", str(cases))
    assert (status, "1 case of 2 images" in output) == (0, True)
    status, output = run_command("run", str(cases / "campaign.toml"), "--out", str(run), "--jobs", "1")
    assert status == 0, output
    frame = pd.read_parquet(run / "cases.parquet")
    assert frame["outcome"].tolist() == ["MATCHED"]
    report = json.loads((run / "report.json").read_text())
    assert np.isclose(report["sections"]["agreement"]["median_of_medians_px"], frame["residual_median_px"][0])
    page = (run / "report.html").read_text()
    assert "Images compared with measured poses" in page
    assert 'aria-label="Images 1 and 2: ' in page
    status, output = run_command("append", str(run), "1")
    assert (status, "2 cases repeat recorded cases" in " ".join(output.split())) == (2, True)
    status, output = run_command("replay", str(run), "0", "--out", str(tmp_path / "again"))
    assert (status, "the row equals the stored one" in output) == (0, True)
    assert (tmp_path / "again" / "matches-1.png").stat().st_size > 10_000


def test_campaign_with_truth_gets_an_error_requirement(tmp_path: Path) -> None:
    descent = inputs.descent()
    folder = write_velocity_folder(
        tmp_path / "in", {"one": descent, "two": descent}, {"two": inputs.DESCENT_VELOCITY_M_S[:2]}
    )
    assert run_command("ingest", str(folder), "--out", str(tmp_path / "out"))[0] == 0
    path = tmp_path / "out" / "campaign.toml"
    tables = tomllib.loads(path.read_text())
    requirement, availability = tables["requirements"]
    assert availability["metric"] == "answered"
    # images of 1024 x 256 pixels with four summed rows are binned to square pixels
    assert tables["parameters"]["dimes"]["binned_size"] == [256, 256]
    assert (requirement["decide_by"], requirement["population"]) == ("estimate", "valid and truth_known")
    campaign = load_campaign(str(path))
    assert campaign.definition.total_cases == 2
    assert [campaign.parameters(case).case.name for case in range(2)] == ["one", "two"]  # type: ignore[attr-defined]
    # the identity of the campaign includes the hash of all images
    assert len(campaign.definition.parameters["cases"]["sha256"]) == 64


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cases": 4}, "4 cases repeat recorded cases, but the same images are no further evidence; allowed here: 2"),
        (
            {"dispersions": {"number": {"distribution": "choice", "values": [0, 1]}}},
            "allowed: a grid of different numbers",
        ),
        (
            {"dispersions": {"number": {"distribution": "grid", "values": [1, 1]}}},
            "allowed: a grid of different numbers",
        ),
        ({"dispersions": {}}, "2 cases repeat recorded cases"),
    ],
)
def test_recorded_cases_are_run_once(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    descent = inputs.descent()
    folder = write_velocity_folder(tmp_path / "in", {"one": descent, "two": descent}, {})
    assert run_command("ingest", str(folder), "--out", str(tmp_path / "out"))[0] == 0
    tables = tomllib.loads((tmp_path / "out" / "campaign.toml").read_text())
    with pytest.raises(DefinitionError, match=message):
        create_campaign(tables | change, "test")
    status, output = run_command("run", str(tmp_path / "out" / "campaign.toml"), "--confirm")
    assert status == 2
    assert "recorded cases are the same for every seed" in " ".join(output.split())
    with pytest.raises(CampaignError, match="has recorded cases, which no study can draw or change"):
        prepare_campaign(load_campaign(str(tmp_path / "out" / "campaign.toml")), 2)
    definition = {"scenario": "measured-velocity", "dispersions": change.get("dispersions", {})}
    assert "recorded cases are not random draws" in read_sampling_design(definition).no_probability_reason


def test_truth_that_is_an_input_and_repeated_images_are_reported(tmp_path: Path) -> None:
    descent = inputs.descent()
    folder = write_velocity_folder(tmp_path / "in", {"one": descent, "two": descent}, {})
    rows = read_rows(folder)
    write_text_rows(folder, [{**row, "true_vx_m_s": row["vx_m_s"], "true_vy_m_s": row["vy_m_s"]} for row in rows])
    status, output = run_command("ingest", str(folder), "--out", str(tmp_path / "out"))
    assert status == 0
    for text in ("The true velocity of 2 of 2 cases is also an input", "Only 1 of 2 cases have different images"):
        assert text in " ".join(output.split())
        assert text in (tmp_path / "out" / "campaign.toml").read_text()


def test_invalid_input_has_status_2_and_leaves_no_files(tmp_path: Path) -> None:
    folder = write_landing_folder(tmp_path / "in", inputs.landing(), "matching")
    rows = read_rows(folder)
    rows[1]["file"] = "lost.png"
    write_text_rows(folder, rows)
    status, output = run_command("ingest", str(folder), "--out", str(tmp_path / "out"))
    assert status == 2
    assert "lost.png: No such file or directory" in output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]
    (tmp_path / "occupied").mkdir()
    (tmp_path / "occupied" / "notes.txt").write_text("notes")
    status, output = run_command("ingest", str(folder), "--out", str(tmp_path / "occupied"))
    assert (status, "is not empty" in output) == (2, True)
    status, output = run_command("ingest", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out"))
    assert (status, "ingest.toml: cannot be read" in output) == (2, True)
    status, output = run_command("ingest", str(folder), "--out", str(tmp_path / "out"), "--system", "vtt")
    assert (status, "unknown system 'vtt'; allowed: measured" in output) == (2, True)


def test_summed_rows_are_inferred_from_the_camera(tmp_path: Path) -> None:
    # the camera sums rows, so its pixels are not square
    descent = inputs.descent()
    rows_summed = descent.images[0].calibration.rows_summed
    assert rows_summed > 1
    folder = write_velocity_folder(tmp_path / "in", {"one": descent}, {})
    text = (folder / "ingest.toml").read_text()
    assert f"rows_summed = {rows_summed}\n" in text
    status, output = run_command("ingest", str(folder), "--out", str(tmp_path / "stated"))
    assert (status, "rows_summed" in output) == (0, False)
    (folder / "ingest.toml").write_text(text.replace(f"rows_summed = {rows_summed}\n", ""))
    status, output = run_command("ingest", str(folder), "--out", str(tmp_path / "inferred"))
    assert status == 0
    assert f"rows_summed = {rows_summed}: computed from the camera" in output
    detectors = [
        json.loads((tmp_path / name / "cases.json").read_text())["detector"] for name in ("stated", "inferred")
    ]
    assert detectors[0] == detectors[1]
    campaigns = [tomllib.loads((tmp_path / name / "campaign.toml").read_text()) for name in ("stated", "inferred")]
    assert campaigns[0]["parameters"]["dimes"] == campaigns[1]["parameters"]["dimes"]
