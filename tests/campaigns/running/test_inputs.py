"""Tests of shared inputs (such as terrains): inputs of several cases are built, and the cost estimate includes them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.running.engine import append_cases
from marsyard.campaigns.running.preparation import estimate_campaign, find_shared_inputs, plan_inputs
from marsyard.scenarios.interface import SelectsInputs
from marsyard.scenarios.systems import scenario, scenario_names
from tests.campaigns.fake_campaign import TOP_LEVEL_KEYS, RecordingWatch, read_case_rows, run

CampaignFile = Callable[..., Path]
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


def test_only_inputs_of_several_cases_are_built(
    selecting_campaign: Path, tmp_path: Path, watch: RecordingWatch
) -> None:
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
    ("name", "settings"),
    [("hda-hazardous", []), ("vtt-montecarlo", []), ("dimes-fieldtest", []), ("dimes-smoke", ["location.bank=2"])],
)
def test_shared_inputs_are_those_of_several_cases(name: str, settings: list[str]) -> None:
    campaign = load_campaign(name, settings)
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
