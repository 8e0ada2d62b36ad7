"""The light of a landing, and what its campaign builds before its flights."""

from __future__ import annotations

import pytest

from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.pictures import KEPT_GROUNDS, World
from marsyard.scenarios.landing.scenario import LandingScenario
from marsyard.sim.sensor import preset
from marsyard.sim.terrain import site


@pytest.mark.parametrize(("site_name", "camera"), [("gusev", "mer-descent-flown"), ("heli-hazardous", "xc-55")])
def test_a_camera_at_the_place_that_it_is_stated_for_sees_that_places_sun(site_name: str, camera: str) -> None:
    # Mars at 1.5 AU has 0.44 of Earth's sun, whose square is what was counted before.
    air = site(site_name).environment
    assert air.solar_irradiance / preset(camera).detector.sunlight == pytest.approx(1.0, abs=0.02)


def test_a_detectors_electrons_do_not_depend_on_where_the_sun_stood_in_its_datasheet() -> None:
    """Responsivity is stated in proportion to the sunlight that is stated with it."""
    small = {"terrain": {"samples": 256}, "location": {"bank": 1}}
    electrons = []
    for sun_au in (1.0, 1.5, 3.0):
        detector = {"preset": "xc-55", "sun_au": sun_au, "responsivity_e_s": 1e7 / sun_au**2}
        p = LandingScenarioParameters.model_validate({**small, "detector": detector})
        electrons.append(World.of(p).brightness * p.detector.responsivity_e_s)
    assert electrons == pytest.approx([electrons[0]] * 3, rel=1e-12)


@pytest.mark.parametrize(("bank", "built"), [(1, 1), (KEPT_GROUNDS, KEPT_GROUNDS), (KEPT_GROUNDS + 1, 0), (10_000, 0)])
def test_terrains_of_a_bank_too_large_to_keep_are_built_by_their_flights(bank: int, built: int) -> None:
    parameters = LandingScenarioParameters.model_validate({"location": {"bank": bank}})
    assert LandingScenario().shared_inputs(parameters) == tuple(range(built))
