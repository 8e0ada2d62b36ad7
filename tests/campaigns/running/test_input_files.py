"""Files that a campaign's parameters name belong to its identity: a changed one is noticed by `resume` and `append`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from marsyard.campaigns.definition.identity import identity_of
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.running.engine import append_cases, resume_campaign
from marsyard.campaigns.running.replay import replay
from marsyard.campaigns.store import record
from tests.campaigns.fake_campaign import Silence, run

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
def done(campaign_file: CampaignFile, tmp_path: Path, watch: Silence, table: Path) -> Path:
    """A finished campaign whose parameters name a file."""
    return run(campaign_file(f'table = "{table}"'), tmp_path / "done", watch, "cases=2", jobs=1)


def test_a_changed_file_is_noticed_by_resume_and_append(done: Path, table: Path, watch: Silence) -> None:
    assert list(record.read(done)["identity"]["inputs"]) == [str(table)]
    resume_campaign(done, ExecutorConfig(1), watch)
    table.write_text("1,2,4\n")
    acts: tuple[Callable[[], None], ...] = (
        lambda: resume_campaign(done, ExecutorConfig(1), watch),
        lambda: append_cases(done, 1, ExecutorConfig(1), watch),
    )
    for act in acts:
        with pytest.raises(CampaignError, match=r"Changed:\n  .*table.csv \(\w{12}, now \w{12}\)\nTo continue"):
            act()
    assert replay(done, 0).changed[0].startswith(str(table))
    append_cases(done, 1, ExecutorConfig(1), watch, allow_changed=True)
    (change,) = record.read(done)["changes"]
    assert "table.csv" in change["in"][0]
    append_cases(done, 1, ExecutorConfig(1), watch)


def test_campaigns_of_earlier_versions_resume_and_store_hashes(done: Path, table: Path, watch: Silence) -> None:
    stored = json.loads((done / "campaign.json").read_text())
    del stored["identity"]["inputs"]
    (done / "campaign.json").write_text(json.dumps(stored))
    append_cases(done, 1, ExecutorConfig(1), watch)
    assert any("table.csv" in note and "not known" in note for note in watch.notes)
    assert record.read(done)["identity"]["inputs"]
    table.write_text("other\n")
    with pytest.raises(CampaignError, match=r"table\.csv"):
        resume_campaign(done, ExecutorConfig(1), watch)


def test_files_that_are_dispersed_over_belong_to_it(campaign_file: CampaignFile, tmp_path: Path, table: Path) -> None:
    other = tmp_path / "other.csv"
    other.write_text("4,5,6\n")
    drawn = f'[dispersions]\ntable = {{distribution = "choice", values = ["{table}", "{other}"]}}\n'
    campaign = load_campaign(str(campaign_file(f'table = "{table}"', dispersions=drawn)))
    assert set(identity_of(campaign.configuration).inputs or {}) == {str(table), str(other)}


def test_terrain_camera_and_datasheet_belong_to_a_descent(tmp_path: Path) -> None:
    files = {name: tmp_path / name for name in ("site.npz", "cam.cahv", "sensor.toml")}
    rng = np.random.default_rng(1)
    np.savez(files["site.npz"], dem=rng.normal(size=(64, 64)), dem_gsd=4.0)
    files["cam.cahv"].write_text(CAMERA)
    files["sensor.toml"].write_text(DATASHEET)
    stated = [
        f"terrain.source.dtm={files['site.npz']}",
        f"camera.model={files['cam.cahv']}",
        f"detector.file={files['sensor.toml']}",
    ]
    configuration = load_campaign("dimes-gusev", stated).configuration
    before = identity_of(configuration)
    assert set(before.inputs or {}) == {str(path) for path in files.values()}
    np.savez(files["site.npz"], dem=rng.normal(size=(64, 64)), dem_gsd=4.0)
    files["cam.cahv"].write_text(CAMERA.replace("1200", "1201"))
    files["sensor.toml"].write_text(DATASHEET.replace("25.0", "26.0"))
    changed = before.differences(identity_of(configuration))
    assert [line.split(" ")[0] for line in changed] == sorted(str(path) for path in files.values())
    # what was read from a camera's file and a datasheet is kept with the campaign: it does without the files
    files["cam.cahv"].unlink()
    files["sensor.toml"].unlink()
    assert list(identity_of(configuration).inputs or {}) == [str(files["site.npz"])]
    files["site.npz"].unlink()
    with pytest.raises(CampaignError, match=r"cannot be used any more: .*site.npz: no such file"):
        identity_of(configuration)
