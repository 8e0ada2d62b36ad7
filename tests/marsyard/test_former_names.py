"""Tests of deprecated names of keys, columns and options: they are accepted with a warning."""

from __future__ import annotations

import json
import sys
import tomllib
import warnings
from pathlib import Path

import pandas as pd
import pytest

from marsyard.campaigns.definition.identity import create_identity
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import ConfigurationError
from marsyard.campaigns.store import record
from marsyard.cli.app import main
from marsyard.reports.stored import read_run
from marsyard.scenarios.systems import row_columns, scenario, scenario_names
from marsyard.sim import parameters
from marsyard.sim.parameters import DeprecatedNameWarning

RENAMED_NAMES = tomllib.loads(Path(parameters.__file__).with_name("renamed.toml").read_text())
CAMPAIGN = """
name = "deprecated"
scenario = "descent"
cases = 2
seed = 3
[parameters.place]
bank = 2
[dispersions]
"place.terrain" = { distribution = "integer", low = 0, high = "place.bank - 1", source = "test" }
"descent.cone_minor_share" = { distribution = "uniform", low = -1.0, high = 1.0, source = "test" }
[[requirements]]
id = "v"
metric = "velocity_error_m_s"
bound = 5.0
probability = 0.9
confidence = 0.9
population = "valid and room"
"""

#: Pairs (deprecated name, current name) in `CAMPAIGN`.
NAMES = (("place", "location"), ("cone_minor_share", "cone_minor_fraction"), ("room", "feasible_overlap"))


def replace_deprecated_names(text: str) -> str:
    for deprecated_name, current_name in NAMES:
        text = text.replace(deprecated_name, current_name)
    return text


@pytest.fixture
def campaign_files(tmp_path: Path) -> tuple[Path, Path]:
    """Write one campaign with deprecated names and one with current names; return their paths."""
    paths = tmp_path / "deprecated.toml", tmp_path / "current.toml"
    paths[0].write_text(CAMPAIGN)
    paths[1].write_text(replace_deprecated_names(CAMPAIGN))
    return paths


def test_campaign_with_deprecated_names_equals_the_current_one(campaign_files: tuple[Path, Path]) -> None:
    with warnings.catch_warnings(record=True) as warning_records:
        warnings.simplefilter("always", DeprecatedNameWarning)
        campaign = load_campaign(str(campaign_files[0]))
    expected = load_campaign(str(campaign_files[1]))
    assert campaign.configuration == expected.configuration
    assert campaign.draws(1) == expected.draws(1)
    texts = {str(warning.message) for warning in warning_records}
    assert "'place' is now 'location'; the former name is accepted until 0.2" in texts
    assert {text.split("'")[1] for text in texts} == {"place", "cone_minor_share", "room"}


def test_deprecated_value_of_an_option_sets_the_current_value() -> None:
    deprecated_value = "where level ground at the measured range would move it by the on-board poses"
    with pytest.warns(DeprecatedNameWarning, match="is now 'poses'"):
        campaign = load_campaign("hda-benign", ["algorithm=hda-custom", f'hda.track_seed="{deprecated_value}"'])
    assert campaign.configuration.parameters["hda"]["track_seed"] == "poses"
    with pytest.raises(ConfigurationError, match="input should be 'unchanged' or 'poses'"):
        load_campaign("hda-benign", ["hda.track_seed=nothing"])


def test_override_with_a_deprecated_name_sets_the_parameter(campaign_files: tuple[Path, Path]) -> None:
    with pytest.warns(DeprecatedNameWarning, match="'place' is now 'location'"):
        campaign = load_campaign(str(campaign_files[1]), ["place.terrain=1"])
    assert campaign.configuration.parameters["location"]["terrain"] == 1
    assert set(campaign.configuration.dispersions) == {"descent.cone_minor_fraction"}


def test_renamed_parameters_keep_their_draws(campaign_files: tuple[Path, Path]) -> None:
    campaign = load_campaign(str(campaign_files[1]))
    uniform = campaign.streams(0).generator("dispersion:descent.cone_minor_share").random()
    assert campaign.draws(0)["descent.cone_minor_fraction"] == pytest.approx(2.0 * uniform - 1.0, abs=1e-12)


def test_stored_campaign_is_read_with_current_names(campaign_files: tuple[Path, Path], tmp_path: Path) -> None:
    expected = load_campaign(str(campaign_files[1])).configuration
    record.write_first_record(tmp_path, expected, create_identity(expected), "test")
    text = (tmp_path / "campaign.json").read_text()
    for deprecated_name, current_name in (*NAMES, ("most_cases", "max_cases")):
        # names follow a quotation mark, a point of a path, or a space of an expression
        for character in '". ':
            text = text.replace(f"{character}{current_name}", f"{character}{deprecated_name}")
    assert "place.terrain" in text
    assert "valid and room" in text
    (tmp_path / "campaign.json").write_text(text)
    pd.DataFrame({"case": [0], "room": [True], "place_east_m": [1.0]}).to_parquet(tmp_path / "cases.parquet")
    assert record.stored_configuration(tmp_path) == expected
    run = read_run(tmp_path)
    assert list(run.frame.columns) == ["case", "feasible_overlap", "location_east_m"]
    assert run.parameter("location", "bank") == 2
    assert run.record["requirements"][0]["population"] == "valid and feasible_overlap"


def test_former_names_of_faults_are_accepted(campaign_files: tuple[Path, Path], tmp_path: Path) -> None:
    path = campaign_files[1]
    dispersion = 'faults = { distribution = "grid", values = [{ black_picture = 2 }], source = "test" }'
    path.write_text(path.read_text().replace("[dispersions]", f"[dispersions]\n{dispersion}"))
    with pytest.warns(DeprecatedNameWarning, match="'black_picture' is now 'black_image'"):
        campaign = load_campaign(str(path))
    with pytest.warns(DeprecatedNameWarning, match="'black_picture' is now 'black_image'"):
        parameters = campaign.parameters(0)
    assert parameters.model_dump()["faults"]["black_image"] == 2
    record.write_first_record(tmp_path, campaign.configuration, create_identity(campaign.configuration), "test")
    pd.DataFrame({"case": [0], "fault": ["black_picture"]}).to_parquet(tmp_path / "cases.parquet")
    assert list(read_run(tmp_path).frame["fault"]) == ["black_image"]


def test_deprecated_option_is_accepted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "argv", ["marsyard", "replay", str(tmp_path), "0", "--step"])
    with (
        pytest.warns(DeprecatedNameWarning, match="'--step' is now '--save-stages'"),
        pytest.raises(SystemExit) as error_info,
    ):
        main()
    assert error_info.value.code == 2
    assert sys.argv[-1] == "--save-stages"


def test_current_names_exist_and_deprecated_names_do_not() -> None:
    """Each current key of the table is a parameter of a scenario, and each current column a column of a scenario."""
    schemas = " ".join(json.dumps(scenario(name).parameters_type.model_json_schema()) for name in scenario_names())
    schemas += json.dumps(type(load_campaign("dimes-smoke").configuration).model_json_schema())
    for deprecated_name, current_name in RENAMED_NAMES["keys"].items():
        assert f'"{current_name}": {{' in schemas, current_name
        assert deprecated_name in ("own", "least", "most") or f'"{deprecated_name}": {{' not in schemas, deprecated_name
    column_sets = [columns for name in scenario_names() if (columns := row_columns(name)) is not None]
    for deprecated_name, current_name in RENAMED_NAMES["columns"].items():
        assert any(current_name in (*columns.flags, *columns.numbers) for columns in column_sets), current_name
        assert not any(deprecated_name in (*columns.flags, *columns.numbers) for columns in column_sets), (
            deprecated_name
        )
