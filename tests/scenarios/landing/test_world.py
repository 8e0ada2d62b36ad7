"""Tests of the light of a landing and of the terrain bank built before a campaign."""

from __future__ import annotations

import pytest

from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.pictures import MAX_GROUNDS, World
from marsyard.scenarios.landing.scenario import LandingScenario
from marsyard.sim.sensor import preset
from marsyard.sim.terrain import site


@pytest.mark.parametrize(("site_name", "camera"), [("gusev", "mer-descent-flown"), ("heli-hazardous", "xc-55")])
def test_camera_at_its_specified_planet_has_unit_sun_factor(site_name: str, camera: str) -> None:
    # Mars at 1.5 AU has 0.44 of Earth's sunlight; the factor must not be applied twice.
    air = site(site_name).environment
    assert air.solar_irradiance / preset(camera).detector.sunlight == pytest.approx(1.0, abs=0.02)


def test_electron_count_is_independent_of_datasheet_sun() -> None:
    """Responsivity scales with the sunlight stated in the datasheet."""
    small = {"terrain": {"samples": 256}, "location": {"bank": 1}}
    electrons = []
    for sun_au in (1.0, 1.5, 3.0):
        detector = {"preset": "xc-55", "sun_au": sun_au, "responsivity_e_s": 1e7 / sun_au**2}
        p = LandingScenarioParameters.model_validate({**small, "detector": detector})
        electrons.append(World.from_parameters(p).brightness * p.detector.responsivity_e_s)
    assert electrons == pytest.approx([electrons[0]] * 3, rel=1e-12)


@pytest.mark.parametrize(("bank", "built"), [(1, 1), (MAX_GROUNDS, MAX_GROUNDS), (MAX_GROUNDS + 1, 0), (10_000, 0)])
def test_large_bank_terrains_are_built_per_flight(bank: int, built: int) -> None:
    parameters = LandingScenarioParameters.model_validate({"location": {"bank": bank}})
    assert LandingScenario().shared_inputs(parameters) == tuple(range(built))
