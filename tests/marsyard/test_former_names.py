"""Tests of deprecated names of keys, columns and options: they are accepted with a warning."""

from __future__ import annotations

import json
import sys
import tomllib
import warnings
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import RigidTransform

from marsyard.algorithms.interface import TargetUpdate, TrackingState
from marsyard.campaigns.definition.configuration import update_stored_configuration
from marsyard.campaigns.definition.evidence import Evidence, EvidenceKind
from marsyard.campaigns.definition.identity import create_identity
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.errors import ConfigurationError
from marsyard.campaigns.store import record
from marsyard.campaigns.store.products import load_products, pack_products, save_packed
from marsyard.cli.app import main
from marsyard.reports.search import read_search
from marsyard.reports.section_kinds import SectionDeclaration
from marsyard.reports.stored import read_run
from marsyard.scenarios import parts
from marsyard.scenarios.descent.recorded import FlightFile, FlightOrigin
from marsyard.scenarios.landing.parameters import LandingScenarioParameters, NavigationParameters
from marsyard.scenarios.measured.layout import IngestFile
from marsyard.scenarios.systems import System, row_columns, scenario, scenario_names
from marsyard.scenarios.template import LANDING
from marsyard.scenarios.views import Viewpoint
from marsyard.sim import parameters
from marsyard.sim.parameters import DeprecatedNameWarning, current_key
from marsyard.sim.render import PixelRays
from marsyard.sim.sensor import preset
from marsyard.sim.terrain import Surface

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


def test_deprecated_options_of_an_algorithm_are_accepted() -> None:
    with pytest.warns(DeprecatedNameWarning, match="'max_return_px' is now 'max_forward_backward_px'"):
        campaign = load_campaign("hda-benign", ["algorithm=hda-custom", "hda.max_return_px=1.25"])
    stored = campaign.configuration.model_dump(mode="json", round_trip=True, exclude_unset=True)
    options = stored["parameters"]["hda"]
    assert options["max_forward_backward_px"] == 1.25
    options["max_return_px"] = options.pop("max_forward_backward_px")
    assert update_stored_configuration(stored)["parameters"]["hda"]["max_forward_backward_px"] == 1.25


def test_one_deprecated_key_has_a_current_name_in_each_table() -> None:
    with pytest.warns(DeprecatedNameWarning, match="'turn_deg' is now 'rotation_deg'"):
        assert NavigationParameters.model_validate({"turn_deg": 0.2}).rotation_deg == 0.2
    with pytest.warns(DeprecatedNameWarning, match="'turn_deg' is now 'heading_offset_deg'"):
        assert current_key("turn_deg", FlightFile.model_fields) == "heading_offset_deg"
    assert current_key("turn_deg", {"azimuth_deg"}) == "turn_deg"


def test_products_with_deprecated_names_are_read(tmp_path: Path) -> None:
    products = {"true_places": 1, "stop_12_found": 2, "rover_believed_m": 3, "stop_left_found": 4}
    save_packed(tmp_path, pack_products(products), {"case": 0})
    assert load_products(tmp_path) == {
        "true_positions": 1,
        "stop_12_matches": 2,
        "rover_estimated_m": 3,
        "stop_left_found": 4,
    }


def test_deprecated_attribute_of_a_target_update_is_accepted() -> None:
    update = TargetUpdate(TrackingState.NORMAL, (), None)
    with pytest.warns(DeprecatedNameWarning, match=r"found is now TargetUpdate\.tracked"):
        assert update.found
    assert update.tracked


def test_deprecated_names_in_tables_set_the_current_parameters() -> None:
    with pytest.warns(DeprecatedNameWarning, match="is now"):
        campaign = load_campaign("vtt-regression", ["exposure.of=full-frame", "sun.held_s=60.0"])
    parameters = campaign.configuration.parameters
    assert (parameters["exposure"]["metering"], parameters["sun"]["update_interval_s"]) == ("full-frame", 60.0)
    values = {"site": "heli-hazardous", "terrain_of": "heli-hazardous", "flown": {"height_m": 12.0}}
    with pytest.warns(DeprecatedNameWarning, match="is now"):
        landing = LandingScenarioParameters.model_validate(values)
    assert (landing.terrain_site, landing.image_poses.height_m) == ("heli-hazardous", 12.0)
    with pytest.warns(DeprecatedNameWarning, match="'place' is now 'location'"):
        assert FlightOrigin("place") is FlightOrigin.LOCATION


def test_deprecated_names_of_classes_are_accepted() -> None:
    with pytest.warns(DeprecatedNameWarning, match="'DescentPlace' is now 'MotionInputs'"):
        assert parts.DescentPlace is parts.MotionInputs
    with pytest.raises(AttributeError):
        _ = parts.unknown
    camera = preset("xc-55").cameras()[0].bin(columns=16, rows=16)
    with pytest.warns(DeprecatedNameWarning, match="from_camera"):
        rays = PixelRays.of(camera)
    ground = Surface.from_samples(np.zeros((16, 16, 2), dtype=np.float32), 1.0)
    pose = RigidTransform.from_translation([3.0, 4.0, 100.0])
    with pytest.warns(DeprecatedNameWarning, match="from_pose"):
        viewpoint = Viewpoint.of(rays, pose, ground)
    assert viewpoint == Viewpoint.from_pose(rays, pose, ground)


def test_renamed_table_keeps_its_draws() -> None:
    """Random streams have the deprecated names: the climb is uniform from -0.15 to 0, the tilt from 0 to 10 deg."""
    campaign = load_campaign("hda-mars")
    uniform = campaign.streams(0).generator("dispersion:flown.climb_share").random()
    assert campaign.draws(0)["image_poses.climb_fraction"] == pytest.approx(-0.15 * (1.0 - uniform), abs=1e-12)
    uniform = campaign.streams(0).generator("dispersion:flown.tilt_deg").random()
    assert campaign.draws(0)["image_poses.tilt_deg"] == pytest.approx(10.0 * uniform, abs=1e-12)


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


def test_deprecated_names_of_faults_are_accepted(campaign_files: tuple[Path, Path], tmp_path: Path) -> None:
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


def test_deprecated_arguments_of_systems_and_templates_are_accepted() -> None:
    with pytest.warns(DeprecatedNameWarning, match="'compiled_by' is now 'compilation_campaigns'"):
        system = System("s", "S", "", {}, compiled_by={"campaign": ("cases=1",)})
    assert system.compilation_campaigns == {"campaign": ("cases=1",)}
    with pytest.warns(DeprecatedNameWarning, match="'refused' is now 'unsupported_options'"):
        template = replace(LANDING, refused={"camera": "no camera"})
    assert template.unsupported_options == {"camera": "no camera"}


def test_deprecated_module_of_section_kinds_is_importable() -> None:
    sys.modules.pop("marsyard.reports.kinds", None)
    with pytest.warns(DeprecatedNameWarning, match="'marsyard.reports.kinds' is now 'marsyard.reports.section_kinds'"):
        module = import_module("marsyard.reports.kinds")
    assert module.SectionDeclaration is SectionDeclaration


def test_stored_results_with_deprecated_keys_are_read() -> None:
    stored = {"kind": "confirmation", "namespace": "confirmation", "number": 2, "of_algorithm": 3, "record": "c.jsonl"}
    assert Evidence.read(stored) == Evidence(EvidenceKind.CONFIRMATION, 2, record="c.jsonl")
    result = {"searched": 20, "failures": [{"case": 7, "found_case": 4}]}
    study = read_search({"study": {"kind": "search", "requirement": "V", "result": result}})
    assert study["result"] == {"search_cases": 20, "failures": [{"case": 7, "original_case": 4}]}


def test_current_names_exist_and_deprecated_names_do_not() -> None:
    """Each current key of the table is a parameter of a scenario, and each current column a column of a scenario."""
    schemas = " ".join(json.dumps(scenario(name).parameters_type.model_json_schema()) for name in scenario_names())
    schemas += json.dumps(type(load_campaign("dimes-smoke").configuration).model_json_schema())
    schemas += json.dumps(IngestFile.model_json_schema())
    for deprecated_name, current_names in RENAMED_NAMES["keys"].items():
        for current_name in [current_names] if isinstance(current_names, str) else current_names:
            assert f'"{current_name}": {{' in schemas, current_name
        # short words may also be current keys of other tables, such as `placed` of rocks
        assert deprecated_name == "placed" or f'"{deprecated_name}": {{' not in schemas, deprecated_name
    column_sets = [columns for name in scenario_names() if (columns := row_columns(name)) is not None]
    for deprecated_name, current_name in RENAMED_NAMES["columns"].items():
        assert any(current_name in (*columns.flags, *columns.numbers) for columns in column_sets), current_name
        assert not any(deprecated_name in (*columns.flags, *columns.numbers) for columns in column_sets), (
            deprecated_name
        )
