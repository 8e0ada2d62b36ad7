"""Tests of parameter tables: a table that changes some values of a preset keeps the other values of the preset."""

from collections.abc import Iterator, Mapping

import pytest
from pydantic import BaseModel, ValidationError

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios.fieldtest.parameters import FieldTestParameters
from marsyard.scenarios.localisation.camera import LANDER_DETECTOR
from marsyard.scenarios.localisation.instruments import RADAR
from marsyard.scenarios.localisation.parameters import LocalisationScenarioParameters
from marsyard.sim.parameters import merge_parameters
from marsyard.sim.sensor import ImuParameters


def _list_single_values(model: BaseModel) -> Iterator[Mapping[str, object]]:
    """List nested tables with one value of a model, the first number of each of its tables."""
    values = {name: getattr(model, name) for name in type(model).model_fields}
    numbers = [name for name, value in values.items() if isinstance(value, float | int)]
    yield from ({name: values[name]} for name in numbers[:1])
    for name, value in values.items():
        if isinstance(value, BaseModel):
            yield from ({name: table} for table in _list_single_values(value))


#: A campaign of each scenario; presets are in its parameters and in its file.
CAMPAIGNS = ("dimes-offnominal", "dimes-fieldtest", "vtt-montecarlo", "vtt-turn", "hda-faults", "loc-jezero")


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_a_value_that_is_set_to_itself_changes_nothing(name: str) -> None:
    campaign = load_campaign(name)
    parameters = campaign.base_parameters()
    for change in _list_single_values(parameters):
        values = merge_parameters(campaign.definition.parameters, change)
        assert campaign.scenario.parameters_type.model_validate(values) == parameters, change


def test_table_keeps_the_other_values_of_a_preset() -> None:
    p = LocalisationScenarioParameters.model_validate(
        {"detector": {"exposure_s": 0.001}, "altimeter": {"clock": {"offset_s": 0.1}}}
    )
    assert p.detector == LANDER_DETECTOR.model_copy(update={"exposure_s": 0.001})
    clock = RADAR.clock.model_copy(update={"offset_s": 0.1})
    assert p.altimeter == RADAR.model_copy(update={"clock": clock})


def test_instrument_of_the_field_test_keeps_its_class() -> None:
    preset = FieldTestParameters.model_fields["imu"].default
    assert preset != ImuParameters()
    p = load_campaign("dimes-fieldtest", ["imu.gyro_scale_ppm=7"]).parameters(0)
    assert isinstance(p, FieldTestParameters)
    assert p.imu == preset.model_copy(update={"gyro_scale_ppm": 7.0})


def test_complete_preset_can_be_replaced() -> None:
    values = {**LANDER_DETECTOR.model_dump(), "bits": 12}
    assert LocalisationScenarioParameters.model_validate({"detector": values}).detector.bits == 12


def test_unknown_key_in_the_table_of_a_preset_is_rejected() -> None:
    with pytest.raises(ValidationError, match="exposure"):
        LocalisationScenarioParameters.model_validate({"detector": {"exposure": 0.001}})
