"""What a descent's parameters take, and what a site makes of them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from marsyard.scenarios.descent.exposure import World, calibrated_camera, camera_optics
from marsyard.scenarios.descent.parameters import CameraParameters, DescentScenarioParameters, binned_size_for
from marsyard.sim.sensor import CustomCamera
from marsyard.sim.terrain import site

#: A site on Mars and one on Earth.
SITES = ("gusev", "ivanpah")


@pytest.mark.parametrize(
    ("wrong", "names"),
    [
        ({"location": {"bank": 2, "terrain": 2}}, "0 to 1"),
        ({"descent": {"altitude_first_m": -5.0}}, "altitude_first_m"),
        ({"descent": {"wind_south_m_s": 1.0}}, "wind_south_m_s"),
        ({"render": {"backend": "vulkan"}}, "osmesa"),
        ({"site": "mars-yard"}, "gusev"),
        ({"site": "gusev", "terrain": {"sample": 512}}, "terrain.sample"),
        ({"algorithm": "dime"}, "did you mean 'dimes'"),
        ({"algorithm": "marsyard.algorithms.dimes:Nothing"}, "no algorithm"),
        ({"dimes": {"templates": 3}}, "templates"),
        ({"faults": {"hase": 1.0}}, "hase"),
    ],
)
def test_impossible_parameters_are_named(wrong: dict[str, Any], names: str) -> None:
    with pytest.raises(ValidationError, match=names):
        DescentScenarioParameters.model_validate(wrong)


def test_a_site_brings_its_terrain_with_what_is_set_over_it() -> None:
    stated = {"site": "gusev", "terrain": {"samples": 512, "spacing_m": 8.0, "rocks": {"smallest_m": 2.0}}}
    p = DescentScenarioParameters.model_validate(stated)
    of_site = site("gusev").terrain("descent")
    rocks = of_site.rocks
    assert rocks is not None
    changed = {"samples": 512, "spacing_m": 8.0, "rocks": rocks.model_copy(update={"smallest_m": 2.0})}
    assert p.terrain == of_site.model_copy(update=changed)


def test_a_site_is_not_dispersed() -> None:
    """The terrain was completed when the campaign was read: another site's name would only change its light."""
    complete = DescentScenarioParameters.model_validate({"site": "gusev"}).model_dump(mode="json", round_trip=True)
    with pytest.raises(ValidationError, match="the terrain is of gusev"):
        DescentScenarioParameters.model_validate(complete | {"site": "kelso"})


@pytest.mark.parametrize("stated", [{}, {"site": "kelso"}, {"dimes": {"subpixel": False}, "faults": {"haze": 2.0}}])
def test_complete_parameters_are_read_back_as_they_were(stated: dict[str, Any]) -> None:
    """As a campaign's workers do."""
    p = DescentScenarioParameters.model_validate(stated)
    assert DescentScenarioParameters.model_validate(p.model_dump(mode="json", round_trip=True)) == p


def test_a_site_is_lit_as_it_is() -> None:
    """Sunlight and reflectance are the site's; signals follow sunlight and air."""
    small = {"terrain": {"samples": 256, "spacing_m": 16.0}, "location": {"bank": 1}}
    mars, earth = (World.of(DescentScenarioParameters.model_validate({"site": name} | small)) for name in SITES)
    assert mars.ground is not None
    assert mars.sun.angular_radius_rad == pytest.approx(0.00308, rel=0.01)
    # twice the sunlight and more: Mars' air is dusty
    assert earth.brightness / mars.brightness > 1.0 / 0.44
    # of a detector whose responsivity is stated for Earth's sun, Mars' light is 0.44 of that
    stated_for_earth = {"site": SITES[0], "detector": {"sun_au": 1.0}} | small
    dimmer = World.of(DescentScenarioParameters.model_validate(stated_for_earth))
    assert dimmer.brightness == pytest.approx(mars.brightness / 1.5**2)
    scene = mars.scene(0.0, 0.0, 1400.0, 8.2e-4)
    assert scene.photometry == mars.ground.photometry(mars.sun)
    assert len(scene.objects) > 0


def test_own_cameras_stand_in_the_campaign(tmp_path: Path) -> None:
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
    stated = {"camera": {"model": str(calibration)}, "detector": str(sheet), "dimes": {"binned_size": [320, 240]}}
    p = DescentScenarioParameters.model_validate(stated)
    assert p.camera.model is not None
    assert p.camera.model.size == (640, 480)
    again = DescentScenarioParameters.model_validate(p.model_dump(mode="json", round_trip=True))
    calibration.unlink()
    sheet.unlink()
    assert DescentScenarioParameters.model_validate(again.model_dump(mode="json", round_trip=True)) == p
    # the camera as calibrated differs by what the errors say: at the corner by at most some of their sum
    true, believed = camera_optics(p.camera).camera, calibrated_camera(p.camera, np.random.default_rng(1))
    directions = true.rays(np.array([[0.0, 0.0], [320.0, 240.0], [639.0, 479.0]]))[1]
    moved = np.linalg.norm(believed.project(directions)[0] - true.project(directions)[0], axis=1)
    assert 0.0 < moved[1] < 4.0 * p.camera.centre_error_px
    assert moved.max() < 4.0 * (p.camera.centre_error_px + p.camera.distortion_error_px + 400 * p.camera.focal_error)


def test_distortion_errors_of_own_cameras_are_the_corners() -> None:
    p = CameraParameters(focal_error=0.0, centre_error_px=0.0, distortion_error_px=2.0)
    own = p.model_copy(update={"model": CustomCamera.of(camera_optics(p).camera)})
    for one in (p, own):
        rng = np.random.default_rng(3)
        drawn = np.random.default_rng(3).standard_normal(4)[3]
        true, believed = camera_optics(one).camera, calibrated_camera(one, rng)
        corner = true.rays(np.array([0.0, 0.0]))[1]
        outwards = np.linalg.norm(believed.project(corner)[0] - 511.5) - np.linalg.norm(true.project(corner)[0] - 511.5)
        assert outwards == pytest.approx(2.0 * drawn, rel=0.02)


def test_pictures_that_dimes_cannot_bin_are_refused_with_a_size_that_it_can() -> None:
    with pytest.raises(ValidationError, match=r"binned_size \[256, 256\] does not divide .* 752 x 480 .*\[376, 240\]"):
        DescentScenarioParameters.model_validate(
            {"camera": {"columns": 752, "rows": 480}, "detector": {"rows_summed": 1}}
        )
    assert binned_size_for(1024, 1024) == (256, 256)
    assert binned_size_for(641, 480) == (641, 480)


def test_rows_that_cannot_be_summed_are_refused() -> None:
    with pytest.raises(ValidationError, match="rows_summed 4 does not divide the camera's 1023 rows"):
        DescentScenarioParameters.model_validate({"camera": {"rows": 1023}})
