"""Tests of parameter tables: a table that changes some values of a preset keeps the other values of the preset."""

import pytest
from pydantic import ValidationError

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios.fieldtest.parameters import FieldTestParameters
from marsyard.scenarios.localisation.camera import LANDER_DETECTOR
from marsyard.scenarios.localisation.instruments import RADAR
from marsyard.scenarios.localisation.parameters import LocalisationScenarioParameters
from marsyard.sim.sensor import ImuParameters


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
