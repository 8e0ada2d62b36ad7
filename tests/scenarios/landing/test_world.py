"""The light of a landing."""

from __future__ import annotations

import pytest

from scenarios.landing.world import camera_sunlight
from sim.sensor import OwnCamera
from sim.terrain import site


@pytest.mark.parametrize(("site_name", "camera"), [("gusev", "mer-descent-flown"), ("heli-hazardous", "xc-55")])
def test_a_camera_at_the_place_that_it_is_stated_for_sees_that_places_sun(site_name: str, camera: str) -> None:
    # Mars at 1.5 AU has 0.44 of Earth's sun, whose square is what was counted before.
    air = site(site_name).environment
    assert air.solar_irradiance / camera_sunlight(camera) == pytest.approx(1.0, abs=0.02)


def test_an_own_camera_is_stated_for_one_astronomical_unit() -> None:
    assert camera_sunlight(OwnCamera.model_construct(file="camera.cahvor")) == 1.0
