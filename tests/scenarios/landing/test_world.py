"""Tests of the illumination of a landing and of the terrains that a campaign builds in advance."""

from __future__ import annotations

import pytest

from marsyard.scenarios.landing.images import MAX_GROUNDS, World
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.scenario import LandingScenario
from marsyard.sim.sensor import preset
from marsyard.sim.terrain import site


@pytest.mark.parametrize(("site_name", "camera"), [("gusev", "mer-descent-flown"), ("heli-hazardous", "xc-55")])
def test_sun_factor_is_1_at_the_planet_of_the_camera_specification(site_name: str, camera: str) -> None:
    # The datasheet refers to sunlight on the same planet, so the factor of 0.44 for Mars (1.5 au) is not applied again.
    environment = site(site_name).environment
    assert environment.solar_irradiance / preset(camera).detector.sunlight == pytest.approx(1.0, abs=0.02)


def test_electron_count_is_independent_of_the_datasheet_sun_distance() -> None:
    """A datasheet for a more distant sun specifies a smaller responsivity (electrons/s), by the inverse square law."""
    small_terrain = {"terrain": {"samples": 256}, "location": {"bank": 1}}
    electrons = []
    for sun_au in (1.0, 1.5, 3.0):
        detector = {"preset": "xc-55", "sun_au": sun_au, "responsivity_e_s": 1e7 / sun_au**2}
        parameters = LandingScenarioParameters.model_validate({**small_terrain, "detector": detector})
        electrons.append(World.from_parameters(parameters).brightness * parameters.detector.responsivity_e_s)
    assert electrons == pytest.approx([electrons[0]] * 3, rel=1e-12)


@pytest.mark.parametrize(
    ("bank", "n_terrains"), [(1, 1), (MAX_GROUNDS, MAX_GROUNDS), (MAX_GROUNDS + 1, 0), (10_000, 0)]
)
def test_only_small_banks_are_built_in_advance(bank: int, n_terrains: int) -> None:
    parameters = LandingScenarioParameters.model_validate({"location": {"bank": bank}})
    assert LandingScenario().shared_inputs(parameters) == tuple(range(n_terrains))
