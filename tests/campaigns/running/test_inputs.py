"""Only the shared inputs (terrains) that a campaign's own cases use are built, and a trial counts their cost."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.running.engine import append_cases
from marsyard.campaigns.running.preparation import estimate, find_used_inputs, plan_inputs
from marsyard.scenarios.interface import SelectsInputs
from marsyard.scenarios.systems import scenario, scenario_names
from tests.campaigns.fake_campaign import HEAD, Silence, rows_of, run

CampaignFile = Callable[..., Path]
DRAWN = '[dispersions]\nterrain = {distribution = "integer", low = 0, high = 9}'


@pytest.fixture
def selecting(campaign_file: CampaignFile, tmp_path: Path) -> Path:
    """Three cases over ten terrains."""
    head = HEAD.replace("FakeScenario", "SelectingScenario").replace("cases = 12", "cases = 3")
    folder = tmp_path / "inputs"
    folder.mkdir()
    return campaign_file(f'shared = 10\ncache = "{folder}"', head=head, dispersions=DRAWN)


def _built(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_only_inputs_that_cases_draw_are_built(selecting: Path, tmp_path: Path, watch: Silence) -> None:
    directory = run(selecting, tmp_path / "run", watch)
    drawn = {f"shared-{row['terrain']}" for row in rows_of(directory)}
    assert _built(tmp_path / "inputs") == drawn
    assert watch.steps["preparing"] == len(drawn) <= 3
    # cases that are added build those of their own
    append_cases(directory, 3, ExecutorConfig(1), watch)
    assert _built(tmp_path / "inputs") == {f"shared-{row['terrain']}" for row in rows_of(directory)}


def test_warnings_of_the_cache_while_preparing_become_notes(selecting: Path, tmp_path: Path, watch: Silence) -> None:
    run(selecting, tmp_path / "run", watch)
    assert {note for note in watch.notes if "was damaged" in note} == {
        f"input {name.removeprefix('shared-')} was damaged" for name in _built(tmp_path / "inputs")
    }


def test_a_trial_counts_the_inputs_to_be_built_and_their_size(selecting: Path, tmp_path: Path) -> None:
    campaign = load_campaign(str(selecting))
    drawn = len(find_used_inputs(campaign, range(3)))
    found = estimate(campaign, jobs=1)
    assert (found.inputs, found.inputs_bytes) == (drawn, drawn * 1e6)
    assert found.input_s > 0.0
    assert found.time_s == pytest.approx(3 * found.case_s + drawn * found.input_s)
    # the trial has built them
    assert len(_built(tmp_path / "inputs")) == drawn
    again = estimate(campaign, jobs=1)
    assert (again.inputs, again.inputs_bytes, again.input_s) == (0, 0, 0.0)


def test_inputs_beyond_the_limit_of_the_cache_are_left_to_the_cases(
    selecting: Path, tmp_path: Path, watch: Silence, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MARSYARD_CACHE_GB", "0.0015")
    directory = run(selecting, tmp_path / "run", watch)
    assert len(_built(tmp_path / "inputs")) == 1
    assert any("more than the cache may" in note for note in watch.notes)
    assert len(rows_of(directory)) == 3


def test_a_limit_that_is_no_number_is_one_message(selecting: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARSYARD_CACHE_GB", "plenty")
    with pytest.raises(CampaignError, match="MARSYARD_CACHE_GB is 'plenty'"):
        plan_inputs(load_campaign(str(selecting)), range(3))


def test_a_scenario_that_states_nothing_has_all_of_its_inputs_built(
    campaign_file: CampaignFile, tmp_path: Path, watch: Silence
) -> None:
    """Scenarios of users keep working as they are."""
    folder = tmp_path / "inputs"
    folder.mkdir()
    path = campaign_file(f'shared = 4\ncache = "{folder}"')
    run(path, tmp_path / "run", watch, "cases=2")
    assert len(_built(folder)) == 4


def test_eight_descents_over_gusev_need_eight_terrains() -> None:
    campaign = load_campaign("dimes-gusev", [], 8)
    assert len(find_used_inputs(campaign, range(8))) == 8
    parameters: list[Any] = [campaign.parameters(case) for case in range(8)]
    assert {one.location.terrain for one in parameters} == set(find_used_inputs(campaign, range(8)))


@pytest.mark.parametrize("name", ["hda-hazardous", "vtt-montecarlo", "vtt-accuracy", "dimes-fieldtest", "dimes-smoke"])
def test_cases_use_terrains_of_their_campaign(name: str) -> None:
    campaign = load_campaign(name)
    every = campaign.scenario.shared_inputs(campaign.base_parameters())
    assert isinstance(campaign.scenario, SelectsInputs)
    used = find_used_inputs(campaign, range(3))
    assert set(used) <= set(every)
    assert not every or used
    assert all(campaign.scenario.missing_bytes(campaign.base_parameters(), one) >= 0 for one in used)


def test_every_scenario_with_shared_inputs_selects_them() -> None:
    assert [name for name in scenario_names() if not isinstance(scenario(name), SelectsInputs)] == [
        name for name in scenario_names() if name.startswith("measured")
    ]
