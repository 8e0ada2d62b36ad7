"""Tests of the inputs of a campaign: shared inputs such as terrains, hashes of input files, estimated cost."""

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marsyard.campaigns.definition.identity import create_identity
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running import estimate
from marsyard.campaigns.running.engine import append_cases, resume_campaign
from marsyard.campaigns.running.estimate import estimate_campaign
from marsyard.campaigns.running.replay import replay
from marsyard.campaigns.running.shared_inputs import find_shared_inputs, plan_inputs
from marsyard.campaigns.store import record
from marsyard.scenarios.interface import SelectsInputs
from marsyard.scenarios.systems import scenario, scenario_names
from tests.campaigns.fake_campaign import (
    TOP_LEVEL_KEYS,
    CampaignFile,
    RecordingWatch,
    continuing_commands,
    read_case_rows,
    run,
)
from tests.inline_workers import inline_workers_fixture

_inline_workers = inline_workers_fixture()
DISPERSION = '[dispersions]\nterrain = {distribution = "integer", low = 0, high = 5}'


@pytest.fixture
def selecting_campaign(campaign_file: CampaignFile, tmp_path: Path) -> Path:
    """Write a campaign with eight cases and ten terrains; each case uses one terrain."""
    top_level_keys = TOP_LEVEL_KEYS.replace("FakeScenario", "SelectingScenario").replace("cases = 12", "cases = 8")
    folder = tmp_path / "inputs"
    folder.mkdir()
    return campaign_file(f'shared = 10\ncache = "{folder}"', top_level_keys=top_level_keys, dispersions=DISPERSION)


def _list_built_inputs(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def _name_shared_inputs(rows: Iterable[Mapping[str, Any]]) -> set[str]:
    uses = Counter(row["terrain"] for row in rows)
    return {f"shared-{number}" for number, count in uses.items() if count > 1}


@pytest.mark.slow
def test_only_inputs_of_many_cases_are_built(selecting_campaign: Path, tmp_path: Path, watch: RecordingWatch) -> None:
    directory = run(selecting_campaign, tmp_path / "run", watch)
    expected = _name_shared_inputs(read_case_rows(directory))
    assert _list_built_inputs(tmp_path / "inputs") == expected
    # the campaign has shared inputs, and inputs of a single case
    assert 0 < watch.steps["preparing"] == len(expected) < len({row["terrain"] for row in read_case_rows(directory)})
    # appended cases build the inputs that several of them use
    append_cases(directory, 8, ExecutorConfig(1), watch)
    expected |= _name_shared_inputs(read_case_rows(directory)[8:])
    assert _list_built_inputs(tmp_path / "inputs") == expected


@pytest.mark.parametrize("cases", [4, 10])
def test_cache_does_not_grow_with_inputs_in_turn(
    selecting_campaign: Path, tmp_path: Path, watch: RecordingWatch, cases: int
) -> None:
    text = selecting_campaign.read_text().replace('"integer", low = 0, high = 5', '"in-turn", low = 0, high = 9')
    selecting_campaign.write_text(text)
    directory = run(selecting_campaign, tmp_path / "run", watch, f"cases={cases}")
    assert [row["terrain"] for row in read_case_rows(directory)] == list(range(cases))
    assert not _list_built_inputs(tmp_path / "inputs")


def test_cache_warnings_are_recorded_as_notes(selecting_campaign: Path, tmp_path: Path, watch: RecordingWatch) -> None:
    run(selecting_campaign, tmp_path / "run", watch)
    assert {note for note in watch.notes if "was damaged" in note} == {
        f"input {name.removeprefix('shared-')} was damaged" for name in _list_built_inputs(tmp_path / "inputs")
    }


def test_estimate_includes_inputs_to_build(selecting_campaign: Path, tmp_path: Path) -> None:
    campaign = load_campaign(str(selecting_campaign))
    n_inputs = len(find_shared_inputs(campaign, range(8)))
    first_estimate = estimate_campaign(campaign, jobs=1)
    assert (first_estimate.inputs, first_estimate.inputs_bytes) == (n_inputs, n_inputs * 1e6)
    assert first_estimate.input_s > 0.0
    assert first_estimate.time_s == pytest.approx(8 * first_estimate.case_s + n_inputs * first_estimate.input_s)
    # the trial cases have built the inputs
    assert len(_list_built_inputs(tmp_path / "inputs")) == n_inputs > 0
    second_estimate = estimate_campaign(campaign, jobs=1)
    assert (second_estimate.inputs, second_estimate.inputs_bytes, second_estimate.input_s) == (0, 0, 0.0)


def test_inputs_beyond_cache_limit_are_built_by_cases(
    selecting_campaign: Path, tmp_path: Path, watch: RecordingWatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MARSYARD_CACHE_GB", "0.0015")  # one input of 1 MB fits
    directory = run(selecting_campaign, tmp_path / "run", watch, "cases=16")
    assert len(_list_built_inputs(tmp_path / "inputs")) == 1
    assert any("more than the cache limit" in note for note in watch.notes)
    assert len(read_case_rows(directory)) == 16


def test_invalid_cache_limit_is_reported(selecting_campaign: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARSYARD_CACHE_GB", "plenty")
    with pytest.raises(CampaignError, match="MARSYARD_CACHE_GB is 'plenty'"):
        plan_inputs(load_campaign(str(selecting_campaign)), range(8))


def test_all_inputs_are_built_if_scenario_has_no_case_inputs(
    campaign_file: CampaignFile, tmp_path: Path, watch: RecordingWatch
) -> None:
    """The method `case_inputs` is optional in custom scenarios."""
    folder = tmp_path / "inputs"
    folder.mkdir()
    path = campaign_file(f'shared = 4\ncache = "{folder}"')
    run(path, tmp_path / "run", watch, "cases=2")
    assert len(_list_built_inputs(folder)) == 4


def test_each_gusev_descent_has_a_terrain_of_its_own() -> None:
    campaign = load_campaign("dimes-gusev")
    parameters: list[Any] = [campaign.parameters(case) for case in range(0, 1000, 7)]
    terrains = {case_parameters.location.terrain for case_parameters in parameters}
    assert len(terrains) == len(parameters)
    # the descents build their terrains in memory
    assert plan_inputs(campaign, range(1000)).to_prepare == ()


@pytest.mark.parametrize(
    ("name", "overrides"),
    [("hda-hazardous", []), ("vtt-montecarlo", []), ("dimes-fieldtest", []), ("dimes-smoke", ["location.bank=2"])],
)
def test_shared_inputs_are_those_of_several_cases(name: str, overrides: list[str]) -> None:
    campaign = load_campaign(name, overrides)
    all_inputs = campaign.scenario.shared_inputs(campaign.base_parameters())
    assert isinstance(campaign.scenario, SelectsInputs)
    used_inputs = find_shared_inputs(campaign, range(4))
    assert set(used_inputs) <= set(all_inputs)
    assert not all_inputs or used_inputs
    parameters = campaign.base_parameters()
    assert all(campaign.scenario.missing_bytes(parameters, shared_input) >= 0 for shared_input in used_inputs)


def test_every_scenario_with_shared_inputs_lists_those_of_a_case() -> None:
    """`SelectsInputs` is the interface of scenarios that list the inputs of a case; measured images have no inputs."""
    names_without_selection = [name for name in scenario_names() if not isinstance(scenario(name), SelectsInputs)]
    assert names_without_selection == [name for name in scenario_names() if name.startswith("measured")]


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
    for command in continuing_commands(finished_campaign, watch):
        with pytest.raises(CampaignError, match=r"Changed:\n  .*table.csv \(\w{12}, now \w{12}\)\nTo continue"):
            command()
    assert replay(finished_campaign, 0).changed[0].startswith(str(table))
    append_cases(finished_campaign, 1, ExecutorConfig(1), watch, allow_changed=True)
    (change,) = record.read(finished_campaign)["changes"]
    assert "table.csv" in change["in"][0]
    append_cases(finished_campaign, 1, ExecutorConfig(1), watch)


def test_dispersed_input_files_belong_to_the_identity(campaign_file: CampaignFile, tmp_path: Path, table: Path) -> None:
    second_table = tmp_path / "second.csv"
    second_table.write_text("4,5,6\n")
    dispersions = f'[dispersions]\ntable = {{distribution = "choice", values = ["{table}", "{second_table}"]}}\n'
    campaign = load_campaign(str(campaign_file(f'table = "{table}"', dispersions=dispersions)))
    assert set(create_identity(campaign.definition).inputs or {}) == {str(table), str(second_table)}


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
    definition = load_campaign("dimes-gusev", overrides).definition
    initial_identity = create_identity(definition)
    assert set(initial_identity.inputs or {}) == {str(path) for path in files.values()}
    np.savez(files["site.npz"], dem=rng.normal(size=(64, 64)), dem_gsd=4.0)
    files["cam.cahv"].write_text(CAMERA.replace("1200", "1201"))
    files["sensor.toml"].write_text(DATASHEET.replace("25.0", "26.0"))
    differences = initial_identity.differences(create_identity(definition))
    # each difference starts with the path of the file
    assert [line.split(" ")[0] for line in differences] == sorted(str(path) for path in files.values())
    # the campaign stores the content of the camera file and datasheet, so these files may be deleted
    files["cam.cahv"].unlink()
    files["sensor.toml"].unlink()
    assert list(create_identity(definition).inputs or {}) == [str(files["site.npz"])]
    files["site.npz"].unlink()
    with pytest.raises(CampaignError, match=r"are no longer valid: .*site.npz: no such file"):
        create_identity(definition)


def test_estimate_follows_from_trial_cases(campaign_file: CampaignFile) -> None:
    campaign = load_campaign(str(campaign_file("sleep_s = 0.05")), ["cases=1000", "retain.products=all"])
    cost = estimate_campaign(campaign, jobs=2)
    # an estimate runs at most 9 trial cases
    assert (cost.trials, cost.unfinished) == (9, 0)
    assert 0.05 <= cost.case_s < 0.5
    assert cost.time_s == pytest.approx(1000 * cost.case_s / 2)
    # 1000 rows of about 15 columns (0.1 to 1 kB each), and products of 0.5 to 5 kB per case
    assert 1e5 < cost.rows_bytes < 1e6
    assert 5e5 < cost.products_bytes < 5e6


def test_time_of_the_first_trial_case_is_left_out(campaign_file: CampaignFile, monkeypatch: pytest.MonkeyPatch) -> None:
    # the first trial case includes the start of the worker and the compilation of kernels
    monkeypatch.setattr(estimate, "_MAX_TRIAL_TIME_S", 0.0)
    cost = estimate_campaign(load_campaign(str(campaign_file("sleep_s = 0.05")), ["cases=1000"]), jobs=1)
    assert cost.trials == 2
    assert cost.case_range_s[0] == cost.case_range_s[1]
