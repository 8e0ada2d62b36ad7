"""Tests of the input files of a campaign: their hashes belong to its identity.

`resume` and `append` compare the identity, and reject changed files.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from marsyard.campaigns.definition.identity import create_identity
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.running.engine import append_cases, resume_campaign
from marsyard.campaigns.running.replay import replay
from marsyard.campaigns.store import record
from tests.campaigns.fake_campaign import RecordingWatch, run

#: Linear (CAHV) camera model with a focal length of 1200 px.
CAMERA = (
    "Model = CAHV = perspective, linear\nDimensions = 1024 1024\nC = 0 0 0\nA = 0 0 1\nH = 1200 0 512\nV = 0 1200 512\n"
)
DATASHEET = """
pixel_pitch_um = 12.0
full_well_e = 170000
read_noise_e = 25.0
bits = 12
quantum_efficiency = 0.4
dark_current_e_s = 10.0
dark_temperature_c = 0.0
rows = 1024
readout_s = 5.0
[lens]
f_number = 4.0
band_nm = [420.0, 680.0]
"""
CampaignFile = Callable[..., Path]


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "table.csv"
    path.write_text("1,2,3\n")
    return path


@pytest.fixture
def finished_campaign(campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch, table: Path) -> Path:
    """Run a campaign with one input file."""
    return run(campaign_file(f'table = "{table}"'), tmp_path / "done", watch, "cases=2", jobs=1)


@pytest.mark.slow
def test_changed_input_file_is_detected(finished_campaign: Path, table: Path, watch: RecordingWatch) -> None:
    assert list(record.read(finished_campaign)["identity"]["inputs"]) == [str(table)]
    resume_campaign(finished_campaign, ExecutorConfig(1), watch)
    table.write_text("1,2,4\n")
    commands: tuple[Callable[[], None], ...] = (
        lambda: resume_campaign(finished_campaign, ExecutorConfig(1), watch),
        lambda: append_cases(finished_campaign, 1, ExecutorConfig(1), watch),
    )
    for command in commands:
        with pytest.raises(CampaignError, match=r"Changed:\n  .*table.csv \(\w{12}, now \w{12}\)\nTo continue"):
            command()
    assert replay(finished_campaign, 0).changed[0].startswith(str(table))
    append_cases(finished_campaign, 1, ExecutorConfig(1), watch, allow_changed=True)
    (change,) = record.read(finished_campaign)["changes"]
    assert "table.csv" in change["in"][0]
    append_cases(finished_campaign, 1, ExecutorConfig(1), watch)


def test_missing_input_hashes_are_added_when_a_campaign_continues(
    finished_campaign: Path, table: Path, watch: RecordingWatch
) -> None:
    stored_record = json.loads((finished_campaign / "campaign.json").read_text())
    del stored_record["identity"]["inputs"]
    (finished_campaign / "campaign.json").write_text(json.dumps(stored_record))
    append_cases(finished_campaign, 1, ExecutorConfig(1), watch)
    assert any("table.csv" in note and "no hash is stored" in note for note in watch.notes)
    assert record.read(finished_campaign)["identity"]["inputs"]
    table.write_text("other\n")
    with pytest.raises(CampaignError, match=r"table\.csv"):
        resume_campaign(finished_campaign, ExecutorConfig(1), watch)


def test_dispersed_input_files_belong_to_the_identity(campaign_file: CampaignFile, tmp_path: Path, table: Path) -> None:
    second_table = tmp_path / "second.csv"
    second_table.write_text("4,5,6\n")
    dispersions = f'[dispersions]\ntable = {{distribution = "choice", values = ["{table}", "{second_table}"]}}\n'
    campaign = load_campaign(str(campaign_file(f'table = "{table}"', dispersions=dispersions)))
    assert set(create_identity(campaign.configuration).inputs or {}) == {str(table), str(second_table)}


def test_terrain_camera_and_datasheet_belong_to_the_identity(tmp_path: Path) -> None:
    files = {name: tmp_path / name for name in ("site.npz", "cam.cahv", "sensor.toml")}
    rng = np.random.default_rng(1)
    np.savez(files["site.npz"], dem=rng.normal(size=(64, 64)), dem_gsd=4.0)
    files["cam.cahv"].write_text(CAMERA)
    files["sensor.toml"].write_text(DATASHEET)
    overrides = [
        f"terrain.source.dtm={files['site.npz']}",
        f"camera.model={files['cam.cahv']}",
        f"detector.file={files['sensor.toml']}",
    ]
    configuration = load_campaign("dimes-gusev", overrides).configuration
    initial_identity = create_identity(configuration)
    assert set(initial_identity.inputs or {}) == {str(path) for path in files.values()}
    np.savez(files["site.npz"], dem=rng.normal(size=(64, 64)), dem_gsd=4.0)
    files["cam.cahv"].write_text(CAMERA.replace("1200", "1201"))
    files["sensor.toml"].write_text(DATASHEET.replace("25.0", "26.0"))
    differences = initial_identity.differences(create_identity(configuration))
    # each difference starts with the path of the file
    assert [line.split(" ")[0] for line in differences] == sorted(str(path) for path in files.values())
    # the campaign stores the content of the camera file and datasheet, so these files may be deleted
    files["cam.cahv"].unlink()
    files["sensor.toml"].unlink()
    assert list(create_identity(configuration).inputs or {}) == [str(files["site.npz"])]
    files["site.npz"].unlink()
    with pytest.raises(CampaignError, match=r"are no longer valid: .*site.npz: no such file"):
        create_identity(configuration)
