"""Tests of the illumination of a landing and of the terrains that a campaign builds in advance."""

from __future__ import annotations

import pytest

from marsyard.scenarios.landing.images import World
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.scenario import LandingScenario
from marsyard.sim.sensor import preset
from marsyard.sim.terrain import site


@pytest.mark.parametrize(("site_name", "camera"), [("gusev", "mer-descent-flown"), ("heli-hazardous", "xc-55")])
def test_camera_preset_refers_to_the_sunlight_on_the_planet_of_its_site(site_name: str, camera: str) -> None:
    # The responsivity of a preset already contains the factor of 0.44 for sunlight on Mars (1.5 au), or 1 on Earth.
    environment = site(site_name).environment
    assert environment.solar_irradiance / preset(camera).detector.sunlight == pytest.approx(1.0, abs=0.02)


def test_electron_count_does_not_depend_on_the_sun_distance_of_the_responsivity() -> None:
    """The responsivity (electrons/s) decreases with the square of the distance from the sun for which it is given."""
    small_terrain = {"terrain": {"samples": 256}, "location": {"bank": 1}}
    electrons = []
    for sun_au in (1.0, 1.5, 3.0):
        detector = {"preset": "xc-55", "sun_au": sun_au, "responsivity_e_s": 1e7 / sun_au**2}
        parameters = LandingScenarioParameters.model_validate({**small_terrain, "detector": detector})
        electrons.append(World.from_parameters(parameters).brightness * parameters.detector.responsivity_e_s)
    assert electrons == pytest.approx([electrons[0]] * 3, rel=1e-12)


@pytest.mark.parametrize(("bank", "n_built"), [(1, 1), (64, 64), (65, 0), (10_000, 0)])
def test_only_small_banks_are_built_in_advance(bank: int, n_built: int) -> None:
    parameters = LandingScenarioParameters.model_validate({"location": {"bank": bank}})
    assert LandingScenario().shared_inputs(parameters) == tuple(range(n_built))
