"""Tests of descent parameters and of the effect of a site on them."""

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from marsyard.algorithms.dimes.views import binned_size_for
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.sim.sensor import preset
from marsyard.sim.terrain import site

#: A site on Mars and a site on Earth.
SITES = ("gusev", "ivanpah")


@pytest.mark.parametrize(
    ("invalid", "message"),
    [
        ({"location": {"bank": 2, "terrain": 2}}, "0 to 1"),
        ({"descent": {"altitude_first_m": -5.0}}, "altitude_first_m"),
        ({"descent": {"wind_south_m_s": 1.0}}, "wind_south_m_s"),
        ({"render": {"backend": "vulkan"}}, "osmesa"),
        ({"site": "mars-yard"}, "gusev"),
        ({"site": "gusev", "terrain": {"sample": 512}}, "terrain.sample"),
        ({"algorithm": "dime"}, "did you mean 'dimes'"),
        ({"algorithm": "marsyard.algorithms.dimes:Nothing"}, "cannot import algorithm"),
        ({"dimes": {"templates": 3}}, "templates"),
        ({"faults": {"hase": 1.0}}, "hase"),
        ({"clock": {"offset_s": -6.0}}, r"clock: .* 6.01 s in all; allowed: at most 4.9 s"),
        ({"imu": {"clock": {"offset_sd_s": 1.0}}}, "allowed: at most 4.9 s"),
        ({"faults": {"altitude_error": 0.1}, "exact_instruments": True}, "altitude_error has no effect with exact"),
    ],
)
def test_invalid_parameters_are_reported(invalid: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        DescentScenarioParameters.model_validate(invalid)


def test_site_terrain_can_be_overridden() -> None:
    values = {"site": "gusev", "terrain": {"samples": 512, "spacing_m": 8.0, "rocks": {"smallest_m": 2.0}}}
    parameters = DescentScenarioParameters.model_validate(values)
    site_terrain = site("gusev").terrain("descent")
    rocks = site_terrain.rocks
    site_changes = {"samples": 512, "spacing_m": 8.0, "rocks": rocks.model_copy(update={"smallest_m": 2.0})}
    assert parameters.terrain == site_terrain.model_copy(update=site_changes)


def test_site_cannot_be_dispersed() -> None:
    """The terrain of the site is read with the campaign. A dispersed site name would change only the illumination."""
    complete = DescentScenarioParameters.model_validate({"site": "gusev"}).model_dump(mode="json", round_trip=True)
    with pytest.raises(ValidationError, match="terrain is of gusev"):
        DescentScenarioParameters.model_validate(complete | {"site": "kelso"})


@pytest.mark.parametrize("values", [{}, {"site": "kelso"}, {"dimes": {"subpixel": False}, "faults": {"haze": 2.0}}])
def test_complete_parameters_round_trip(values: dict[str, Any]) -> None:
    """Workers of a campaign receive the parameters as JSON."""
    parameters = DescentScenarioParameters.model_validate(values)
    assert DescentScenarioParameters.model_validate(parameters.model_dump(mode="json", round_trip=True)) == parameters


def test_illumination_follows_the_site() -> None:
    """The site defines sunlight and reflectance; the brightness depends on sunlight and atmosphere."""
    small_terrain = {"terrain": {"samples": 256, "spacing_m": 16.0}, "location": {"bank": 1}}
    parameters = [DescentScenarioParameters.model_validate({"site": name} | small_terrain) for name in SITES]
    mars, earth = (DescentWorld.from_parameters(site_parameters) for site_parameters in parameters)
    # the sun's radius at 1.5 au
    assert mars.sun.angular_radius_rad == pytest.approx(0.00308, rel=0.01)
    # Earth receives 1 / 0.44 of the sunlight on Mars; dust in the atmosphere of Mars increases the ratio.
    assert earth.brightness / mars.brightness > 1.0 / 0.44
    # A detector specified for the sun at 1 au receives 1 / 1.5^2 = 0.44 of its light on Mars.
    earth_detector = {"site": SITES[0], "detector": {"sun_au": 1.0}} | small_terrain
    world_with_earth_detector = DescentWorld.from_parameters(DescentScenarioParameters.model_validate(earth_detector))
    assert world_with_earth_detector.brightness == pytest.approx(mars.brightness / 1.5**2)
    # scene below the origin, for a last image at 1400 m with pixels of 0.82 mrad
    scene = mars.scene(0.0, 0.0, 1400.0, 8.2e-4)
    assert scene.photometry == mars.ground.photometry(mars.sun)
    assert len(scene.objects) > 0


def test_custom_cameras_are_stored_in_the_campaign(tmp_path: Path) -> None:
    calibration, sheet = tmp_path / "camera.yaml", tmp_path / "sensor.toml"
    calibration.write_text(
        "image_width: 640\nimage_height: 480\ncamera_matrix: {data: [800, 0, 320, 0, 800, 240, 0, 0, 1]}\n"
        "distortion_coefficients: {data: [-0.2, 0.05, 0, 0]}\n"
    )
    sheet.write_text(
        "pixel_pitch_um = 4.8\nfull_well_e = 10000\nread_noise_e = 5\nbits = 10\nquantum_efficiency = 0.5\n"
        "dark_current_e_s = 20\ndark_temperature_c = 20\nrows = 480\nreadout_s = 0.02\n"
        "[lens]\nf_number = 4\nband_nm = [450, 700]\n"
    )
    values = {"camera": {"model": str(calibration)}, "detector": str(sheet), "dimes": {"binned_size": [320, 240]}}
    parameters = DescentScenarioParameters.model_validate(values)
    assert parameters.camera.model.size == (640, 480)
    round_trip = DescentScenarioParameters.model_validate(parameters.model_dump(mode="json", round_trip=True))
    calibration.unlink()
    sheet.unlink()
    assert DescentScenarioParameters.model_validate(round_trip.model_dump(mode="json", round_trip=True)) == parameters


def test_indivisible_image_size_is_rejected_with_suggestion() -> None:
    values = {"camera": {"columns": 752, "rows": 480}, "detector": {"rows_summed": 1}}
    with pytest.raises(ValidationError, match=r"binned_size \[256, 256\] does not divide .* 752 x 480 .*\[376, 240\]"):
        DescentScenarioParameters.model_validate(values)
    # only DIMES bins the images
    DescentScenarioParameters.model_validate({**values, "algorithm": "phase-correlation"})
    assert binned_size_for(1024, 1024) == (256, 256)
    assert binned_size_for(641, 480) == (641, 480)


def test_indivisible_row_summing_is_rejected() -> None:
    with pytest.raises(ValidationError, match="rows_summed 4 does not divide the 1023 camera rows"):
        DescentScenarioParameters.model_validate({"camera": {"rows": 1023}})


def test_default_detector_is_that_of_the_flown_camera() -> None:
    """The flown images contain a pattern of the response that the calibration lacks; other values keep it."""
    assert DescentScenarioParameters().detector == preset("mer-descent-flown").detector
    campaign = load_campaign("dimes-gusev")
    residual = campaign.parameters(0).model_dump()["detector"]["residual_spread"]
    assert residual == preset("mer-descent-flown").detector.residual_spread > 0.0
