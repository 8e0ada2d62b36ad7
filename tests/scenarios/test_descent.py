"""Whole descents: truth, measurement and score hang together."""

import math
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from scenarios.descent import DescentScenario, DescentScenarioParameters
from scenarios.descent.world import World
from scenarios.interface import CaseResult
from sim.streams import Streams
from sim.terrain import site

#: A site on Mars and one on Earth.
SITES = ("gusev", "ivanpah")

#: A small world that is built in a moment.
WORLD = {"terrain": {"samples": 1024, "spacing_m": 3.0}, "place": {"bank": 1}}
#: Instruments without errors.
PERFECT = {
    "camera": {"alignment_error_deg": 0.0},
    "altimeter": {"scale_error": 0.0, "noise": 0.0},
    "navigation": {
        "attitude_bias_deg": 0.0,
        "attitude_noise_deg": 0.0,
        "velocity_noise_m_s": 0.0,
        "image_time_jitter_s": 0.0,
    },
}
DESCENT = {
    "wind_east_m_s": 14.0,
    "wind_north_m_s": -9.0,
    "cone_angle_deg": 12.0,
    "nod_rate_deg_s": 30.0,
    "heading_deg": 70.0,
}


def _run(case: int = 0, **parts: dict[str, Any]) -> CaseResult:
    parameters = DescentScenarioParameters.model_validate(WORLD | {"descent": DESCENT} | parts)
    return DescentScenario().run(parameters, Streams(1, "test", case))


@pytest.fixture(scope="module")
def nominal() -> CaseResult:
    return _run()


def _timeless(row: Any) -> dict[str, Any]:
    return {name: value for name, value in row.items() if "time" not in name}


def test_a_case_is_a_function_of_its_parameters_and_streams(nominal) -> None:
    other = _run(case=1)
    again = _run()
    assert _timeless(again.row) == _timeless(nominal.row)
    assert other.row["image_hash"] != nominal.row["image_hash"]


def test_the_error_is_the_estimate_less_the_truth(nominal) -> None:
    row = nominal.row
    assert nominal.answered
    for axis in "xy":
        assert row[f"velocity_error_{axis}_m_s"] == pytest.approx(
            row[f"velocity_estimated_{axis}_m_s"] - row[f"velocity_true_{axis}_m_s"], abs=1e-12
        )
    assert row["velocity_error_m_s"] == pytest.approx(
        math.hypot(row["velocity_error_x_m_s"], row["velocity_error_y_m_s"])
    )
    np.testing.assert_allclose(
        nominal.products["velocity_true_m_s"], [row["velocity_true_x_m_s"], row["velocity_true_y_m_s"]]
    )


def test_truth_is_the_mean_velocity_of_the_camera() -> None:
    """Without swing the lander's mean velocity over the second interval is the wind's, by formula."""
    row = _run(descent=DESCENT | {"cone_angle_deg": 0.0, "nod_rate_deg_s": 0.0, "gust_east_m_s2": 0.4}).row
    assert row["velocity_true_x_m_s"] == pytest.approx(14.0 + 0.4 * 1.5 * 3.75, abs=1e-9)
    assert row["velocity_true_y_m_s"] == pytest.approx(-9.0, abs=1e-9)


@pytest.mark.parametrize("wind", [(25.0, 0.0), (0.0, 25.0), (-18.0, -18.0)])
def test_with_perfect_instruments_over_flat_ground_the_velocity_is_right(wind) -> None:
    """Signs and axes of the whole chain: 0.15 m/s is a tenth of a binned pixel over 3.75 s."""
    east, north = wind
    result = _run(
        **PERFECT,
        terrain=WORLD["terrain"] | {"rms_slope_deg": 0.0, "craters_per_km2": 0.0},
        descent=DESCENT | {"wind_east_m_s": east, "wind_north_m_s": north},
    )
    assert result.outcome == "VALID"
    assert result.row["velocity_error_m_s"] < 0.15


def test_an_attitude_error_makes_the_velocity_error_it_must() -> None:
    """An error of attitude common to all pictures turns the displacement that the pictures show, descent and all.

    First order in the error b: ``b x v``. Tolerance: a template 20 deg from nadir adds 13 % to the descent's share.
    """
    flat = WORLD["terrain"] | {"rms_slope_deg": 0.0, "craters_per_km2": 0.0}
    steady = DESCENT | {"cone_angle_deg": 0.0, "nod_rate_deg_s": 0.0}
    errors, expected = [], []
    for case in range(4):
        navigation = PERFECT["navigation"] | {"attitude_bias_deg": 0.6}
        row = _run(case, **(PERFECT | {"navigation": navigation}), terrain=flat, descent=steady).row
        fallen = float(row["altitude_2_m"]) - float(row["altitude_3_m"])
        velocity = [row["velocity_true_x_m_s"], row["velocity_true_y_m_s"], -fallen / 3.75]
        errors.append([row["velocity_error_x_m_s"], row["velocity_error_y_m_s"]])
        expected.append(np.cross(_bias_of(case, 0.6), velocity)[:2])
    np.testing.assert_allclose(errors, expected, atol=0.15, rtol=0.13)
    assert np.abs(expected).max() > 1.0


def _bias_of(case: int, sd_deg: float) -> np.ndarray:
    """The attitude bias of a case, drawn as the scenario draws it."""
    return np.radians(sd_deg) * Streams(1, "test", case).generator("navigation bias").standard_normal(3)


def test_conditions_are_read_from_the_simulated_objects(nominal) -> None:
    row = nominal.row
    assert row["altitude_1_m"] == pytest.approx(2000.0, abs=20.0)
    assert row["off_nadir_max_deg"] == max(row[f"off_nadir_{k}_deg"] for k in (1, 2, 3))
    assert 0.0 < row["off_nadir_max_deg"] < 12.0 + 30.0 * 1.2 / (2 * np.pi) + 0.1
    assert row["sun_azimuth_deg"] == pytest.approx(270.0)
    assert row["sun_elevation_deg"] == pytest.approx(40.0)
    assert len(row["image_hash"]) == 64
    assert row["descent_wind_east_m_s"] == 14.0
    assert row["descent_heading_deg"] == 70.0


def test_a_site_brings_its_terrain_with_what_is_set_over_it() -> None:
    """Also when complete parameters are read back, as a campaign's workers do."""
    stated = {"site": "gusev", "terrain": {"samples": 512, "spacing_m": 8.0, "rocks": {"smallest_m": 2.0}}}
    p = DescentScenarioParameters.model_validate(stated)
    of_site = site("gusev").terrain("descent")
    rocks = of_site.rocks
    assert rocks is not None
    changed = {"samples": 512, "spacing_m": 8.0, "rocks": rocks.model_copy(update={"smallest_m": 2.0})}
    assert p.terrain == of_site.model_copy(update=changed)
    assert DescentScenarioParameters.model_validate(p.model_dump(mode="json", round_trip=True)) == p


def test_a_site_is_lit_as_it_is() -> None:
    """Gravity, sunlight and reflectance are the site's; signals follow sunlight and air."""
    small = {"terrain": {"samples": 256, "spacing_m": 16.0}, "place": {"bank": 1}}
    mars, earth = (World.of(DescentScenarioParameters.model_validate({"site": name} | small)) for name in SITES)
    assert mars.ground is not None
    assert mars.sun.angular_radius_rad == pytest.approx(0.00308, rel=0.01)
    # twice the sunlight and more: Mars' air is dusty
    assert earth.brightness / mars.brightness > 1.0 / 0.44
    scene = mars.scene(0.0, 0.0, 1400.0, 8.2e-4, 10.9)
    assert scene.caster_diameter_m == 10.9
    assert scene.photometry == mars.ground.photometry(mars.sun)
    assert len(scene.objects) > 0


def test_over_a_site_the_velocity_is_right() -> None:
    result = _run(site="gusev", **PERFECT)
    assert result.outcome == "VALID"
    assert result.row["site"] == "gusev"
    # relief of 2 deg slopes moves a template against the plane below the lander, by 1 m/s at worst here
    assert result.row["velocity_error_m_s"] < 1.0


def test_no_room_for_a_template_is_an_outcome_without_velocity() -> None:
    """Looking 40 deg aside and turned between pictures, the pictures do not share enough ground."""
    swinging = {"cone_angle_deg": 40.0, "cone_phase_deg": 0.0, "cone_period_s": 7.5, "cone_minor_share": 0.0}
    result = _run(descent=DESCENT | swinging)
    assert result.outcome == "NO_TEMPLATE_AREA"
    assert not result.answered
    assert math.isnan(float(result.row["velocity_error_m_s"]))
    assert math.isfinite(float(result.row["velocity_true_x_m_s"]))


def test_in_the_dark_nothing_is_reported() -> None:
    result = _run(detector={"responsivity_e_s": 1.0})
    assert result.outcome == "NO_VALID_TRACK"
    assert not result.answered


@pytest.mark.parametrize(
    ("wrong", "names"),
    [
        ({"place": {"bank": 2, "terrain": 2}}, "0 to 1"),
        ({"descent": {"altitude_first_m": -5.0}}, "altitude_first_m"),
        ({"descent": {"wind_south_m_s": 1.0}}, "wind_south_m_s"),
        ({"render": {"backend": "vulkan"}}, "osmesa"),
        ({"site": "mars-yard"}, "gusev"),
        ({"site": "gusev", "terrain": {"sample": 512}}, "terrain.sample"),
    ],
)
def test_impossible_parameters_are_named(wrong, names) -> None:
    with pytest.raises(ValidationError, match=names):
        DescentScenarioParameters.model_validate(wrong)
